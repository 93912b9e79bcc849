"""Work and precision of the steady state: waiting for it, shooting at it, and the approximate one-mode method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from rig.approximate import approximate_response
from rig.cost import Point, timed
from rig.errors import ShotrigError
from rig.open_loop import with_force_itself
from rig.orbit import periodic_orbit
from rig.receptance import receptance
from rig.response import frequency_response
from rig.scene import Scene
from rig.single_mode import Weighting
from rig.structure import natural_modes, structure_matrices

#: Tolerances to wait for.
TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
#: The approximate method looks at this band around the frequency, relative.
BAND = 0.04

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class SteadyStudy:
    """What `steady_study` found.

    Attributes
    ----------
    points : tuple of Point
        Errors are of the compliance of all bodies, relative to the largest.
    motion_type : str
    reference : str
        What the errors refer to; why there are none, if there is no periodic motion.
    """

    points: tuple[Point, ...]
    motion_type: str
    reference: str


def steady_study(
    scene: Scene, frequency: float, progress: Callable[[str], None] | None = None
) -> SteadyStudy:
    """Measure the ways to a scene's steady response at one frequency.

    Parameters
    ----------
    scene : Scene
        Where its test holds the amplitude of the spring force, that force acts on the body as a pure tone.
    frequency : float
        Hz.
    progress : callable, optional
        Called with the name of each method before it runs.
    """
    say = progress if progress is not None else lambda name: None
    scene = with_force_itself(scene)
    say("shooting")
    try:
        # Once unmeasured: what is compiled is compiled or loaded then.
        periodic_orbit(scene, frequency)
        cpu, orbit = timed(partial(periodic_orbit, scene, frequency))
    except ShotrigError as error:
        return SteadyStudy((), "", f"no steady state to compare with: {error}")
    true = orbit.compliance
    points = [
        Point(
            "shooting", f"Newton to {orbit.residual:.0e}", cpu, float(orbit.residual), np.nan, True,
            "error: what the orbit misses its start by",
        )
    ]  # fmt: skip
    for tolerance in TOLERANCES:
        say(f"waiting, {tolerance:.0e}")
        cpu, response = timed(partial(frequency_response, scene, [frequency], tolerance=tolerance))
        points.append(
            Point(
                "waiting", f"tolerance {tolerance:.0e}", cpu, _miss(response.compliance[:, 0], true), np.nan,
                bool(response.converged[0]), str(response.motion_type[0]),
            )
        )  # fmt: skip
    say("approximate method")
    points.append(_approximate(scene, frequency, true))
    riding = tuple(range(1, len(scene.dampers) + 1))
    for name, dampers in (("dampers riding", riding), ("no dampers", ())):
        cpu, linear = timed(partial(receptance, scene, [frequency], riding=dampers))
        points.append(Point("linear", name, cpu, _miss(linear[:, 0], true), np.nan, False))
    return SteadyStudy(
        tuple(points),
        orbit.motion_type,
        f"the periodic orbit, by shooting; it misses its start by {orbit.residual:.0e} of the motion",
    )


def _miss(value: Complex, true: Complex) -> float:
    return float(np.abs(value - true).max() / np.abs(true).max())


def _approximate(scene: Scene, frequency: float, true: Complex) -> Point:
    """Use the one-mode method for the mode nearest by; it finds the whole curve at once."""
    mass, _, stiffness = structure_matrices(scene.structure)
    omega = natural_modes(mass, stiffness)[0]
    mode = int(np.argmin(np.abs(omega / (2 * np.pi) - frequency))) + 1
    band = (frequency * (1 - BAND), frequency * (1 + BAND))
    reasons = []
    for weighting in get_args(Weighting):
        try:
            cpu, found = timed(partial(approximate_response, scene, mode, band, weighting=weighting))
        except ShotrigError as refusal:
            reasons.append(str(refusal))
            continue
        values = [
            branch.compliance[k] * found.mode.shape
            for branch in found.branches
            for k in np.flatnonzero(
                branch.valid & branch.stable & (np.abs(branch.frequency / frequency - 1) < 2e-3)
            )
        ]
        if values:
            error = min(_miss(value, true) for value in values)
            return Point(
                "approximate",
                f"mode {mode}, {weighting} weights",
                cpu,
                error,
                np.nan,
                True,
                "the whole curve",
            )
        reasons.append("finds no stable motion here")
    return Point("approximate", f"mode {mode}", np.nan, np.nan, np.nan, False, reasons[-1])
