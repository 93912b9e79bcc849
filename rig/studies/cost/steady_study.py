"""Work-precision study of the steady state: time integration to steady state, shooting, approximate method."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import get_args

import numpy as np

from rig.core.base.errors import RunError, ShotrigError
from rig.core.orbits.orbit import Orbit
from rig.core.orbits.periodic_orbit import periodic_orbit
from rig.core.scene.scene import Scene
from rig.core.steady_response.frequency_response import frequency_response
from rig.core.system.open_loop_drive import with_ideal_force
from rig.core.system.structural_model import receptance, structural_model
from rig.studies.cost.high_precision import DIGITS, ExactOrbit, exact_orbit
from rig.studies.cost.motion_study import MIN_REFERENCE_MARGIN, Point, failure_reason, timed
from rig.studies.single_mode.approximate_response import approximate_response
from rig.studies.single_mode.reduction import Weighting

#: Model of `bed_models` with a different packing of the grains. Errors below its deviation are not significant.
OTHER_PACKING = "grains, other packing"
#: Tolerances of time integration to steady state.
TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
#: If the motion is irregular, periodic motion is searched at frequencies with these relative offsets, small ones first.
FREQUENCY_OFFSETS = (0.0, 0.01, -0.01, 0.02, -0.02, 0.03, -0.03, 0.05, -0.05, 0.08, -0.08)
#: Relative half-width of the band of the approximate method around the frequency.
BAND_HALF_WIDTH = 0.04


@dataclass(frozen=True)
class SteadyStudy:
    """Result of `steady_study` or `bed_models`."""

    points: tuple[Point, ...]  # error: largest compliance error of any body, relative to the largest compliance
    frequency: float  # Hz
    motion_type: str  # type of motion at this frequency; "" without steady state
    reference: str  # reference of the errors; without periodic motion, the reason why there are no errors


def steady_study(scene: Scene, frequency: float, progress: Callable[[str], None] | None = None) -> SteadyStudy:
    """Measure error and CPU time of every method for a scene's steady response at one frequency.

    `scene`: if its test controls the amplitude of the spring force, that force acts on the body as a pure sinusoid;
    `frequency`: Hz; if the motion is irregular there, the nearest of several frequencies with periodic motion. Raises
    `RunError` if the reference is not `MIN_REFERENCE_MARGIN` times better than the best method.
    """
    report = progress if progress is not None else lambda computation: None
    scene = with_ideal_force(scene)
    report("shooting")
    try:
        orbit = _orbit_near(scene, frequency)
        # Repeated for the measurement, because the first call includes compilation.
        cpu, orbit = timed(partial(periodic_orbit, scene, orbit.frequency))
        report("reference for the steady state")
        reference = exact_orbit(scene, orbit)
    except ShotrigError as error:
        return SteadyStudy((), frequency, "", f"no steady state to compare with: {error}")
    frequency = orbit.frequency
    newton_error = reference.error(orbit.compliance)
    points = [Point("shooting", f"Newton to {orbit.residual:.0e}", cpu, newton_error, note=orbit.motion_type)]
    for tolerance in TOLERANCES:
        report(f"time integration to steady state, {tolerance:.0e}")
        cpu, response = timed(partial(frequency_response, scene, [frequency], tolerance=tolerance))
        point = Point("time integration", f"tolerance {tolerance:.0e}", cpu, reference.error(response.compliance[:, 0]))
        points.append(replace(point, is_correct=bool(response.converged[0]), note=str(response.motion_type[0])))
    report("approximate method")
    points.append(_approximate(scene, frequency, reference))
    all_dampers = tuple(range(1, len(scene.dampers) + 1))
    for case, dampers in (("riding dampers", all_dampers), ("no dampers", ())):
        cpu, linear = timed(partial(receptance, scene, [frequency], riding=dampers))
        points.append(Point("linear", case, cpu, reference.error(linear[:, 0]), is_correct=False))
    smallest_error = min((point.error for point in points if point.error > 0.0), default=np.inf)
    margin = smallest_error / max(reference.agreement, 10.0**-DIGITS)
    if margin < MIN_REFERENCE_MARGIN:
        raise RunError(
            f"the error of the reference of the steady state is only {margin:.0f} times smaller than that of the "
            f"best method; expected at least {MIN_REFERENCE_MARGIN:.0f} times. Please report this as a bug, and attach "
            "the scene."
        )
    return SteadyStudy(
        tuple(points),
        frequency,
        orbit.motion_type,
        f"the periodic orbit in decimal arithmetic of {DIGITS} digits. Its state after a period differs from the "
        f"initial state by {reference.residual:.0e}, relative to the motion. With fewer digits, the compliance changes "
        f"by {reference.agreement:.0e} (relative). The error of the most accurate method is {margin:.0e} times this "
        "change.",
    )


def _orbit_near(scene: Scene, frequency: float) -> Orbit:
    """Compute the periodic motion at a frequency or, if there is none, at a frequency nearby."""
    first_error: ShotrigError | None = None
    for offset in FREQUENCY_OFFSETS:
        try:
            return periodic_orbit(scene, frequency * (1.0 + offset))
        except RunError as error:
            first_error = first_error or error
    assert first_error is not None
    raise first_error


def _approximate(scene: Scene, frequency: float, reference: ExactOrbit) -> Point:
    """Evaluate the approximate one-mode method for the nearest mode; it computes the whole response curve."""
    mode = int(np.argmin(np.abs(structural_model(scene).modes.frequency - frequency))) + 1
    band = (frequency * (1 - BAND_HALF_WIDTH), frequency * (1 + BAND_HALF_WIDTH))
    reasons = []
    for weighting in get_args(Weighting):
        try:
            cpu, response = timed(partial(approximate_response, scene, mode, band, weighting=weighting))
        except ShotrigError as failure:
            reasons.append(failure_reason(failure))
            continue
        compliances = [
            branch.compliance[k] * response.mode.shape
            for branch in response.branches
            for k in np.flatnonzero(branch.valid & branch.stable & (np.abs(branch.frequency / frequency - 1) < 2e-3))
        ]
        if compliances:
            error = min(reference.error(compliance) for compliance in compliances)
            return Point("approximate", f"mode {mode}, {weighting} weights", cpu, error, note="whole response curve")
        reasons.append("failed: no stable motion at this frequency")
    return Point("approximate", f"mode {mode}", np.nan, np.nan, is_correct=False, note=reasons[-1])
