"""Check of tests that control motion or phase: points lie within their 95 % intervals of exact orbits or modes."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

import analysis
import rig
from daq.core.recording.markers import Marker
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import ShotrigError
from rig.core.results.response import Response
from tests.gauntlet.checks.modes import true_modes
from tests.gauntlet.controlled_tones import BACKBONE, CURVE, FOLDS, HELD, LINEAR_BACKBONE, bands_between_folds
from tests.gauntlet.result import Case, CheckResult

# Name of the check for sensors without tolerances.
EXACT_SENSORS = "orbits, exact sensors"
# At least this fraction of the points of a scene must lie within their intervals.
_MIN_COVERAGE = 0.7
# A point is misleading if its error exceeds both this multiple of its bound and `_MISLEADING_ERROR`.
_MISLEADING_BOUNDS = 3.0
_MISLEADING_ERROR = 0.05
# Largest relative error of the exact force: the branches are interpolated.
_EXACT_ERROR = 1e-4
# The exact force is computed up to this relative deviation of the amplitude, and extrapolated.
_MAX_PROBED = 0.06
# Numbers of searches for orbits: where many motions repeat, some are found only by a larger number.
_SEARCHES = 2, 4, 16
# Orbits are followed over the drive, relative to that of the point, and over the frequency.
_DRIVES, _FREQUENCIES = (0.75, 1.33), (0.97, 1.03)
# Orbits are followed again in this range about a phase resonance, where the phase changes much between their points.
_NEAR_FREQUENCIES = 0.999, 1.001

# Measured value, half of its interval, exact value, and the scale of relative errors.
_Point = tuple[float, float, float, float]
# Function of the parameter, the response and the amplitude along a branch.
_Offset = Callable[[Array, ComplexArray, Array], Array]


def check(case: Case, kind: str) -> list[CheckResult]:
    """Compare forces of held motion, or frequencies and amplitudes of phase resonance, with orbits or modes."""
    if kind not in _POINTS:
        return []
    found = [point for points_of in _POINTS[kind] for point in points_of(case)]
    turns = _missed_folds(case, kind) if kind == FOLDS else []
    points = [point for point in found if point is not None and np.isfinite(point[1])]
    tolerances = [getattr(channel.accelerometer, "sensitivity_tolerance", None) for channel in case.scene.channels]
    name = "modes" if kind == LINEAR_BACKBONE else "orbits" if any(tolerances) else EXACT_SENSORS
    if not points:
        reason = f"{len(found)} points without orbit or interval" if found else "no point settled"
        return [CheckResult(name, kind, "refused", note="; ".join([reason, *case.warnings])), *turns]
    measured, bound, exact, scale = np.array(points).T
    error = abs(measured - exact)
    inside = error <= bound
    misleading = (error > _MISLEADING_BOUNDS * bound) & (error > _MISLEADING_ERROR * scale)
    worst = int(np.argmax(error / bound))
    outcome = "correct" if inside.mean() >= _MIN_COVERAGE and not misleading.any() else "wrong"
    note = f"worst {measured[worst]:.6g} ± {bound[worst]:.2g}, exact {exact[worst]:.6g}"
    if len(found) > len(points):
        note += f"; {len(found) - len(points)} without orbit or interval"
    relative_bound = float(np.median(bound / scale))
    return [CheckResult(name, kind, outcome, int(inside.sum()), inside.size, relative_bound, note), *turns]


class _Crossing(NamedTuple):
    """A point of a branch."""

    value: float  # of the parameter
    amplitude: float  # of the body, m
    force: float  # amplitude of its first harmonic, N
    repetition: int  # number of periods after which the motion repeats


def _orbits(
    case: Case,
    drive: float,
    frequency: float,
    over_drive: bool,
    searches: int = _SEARCHES[0],
    frequencies: tuple[float, float] = _FREQUENCIES,
) -> rig.OrbitCurve | None:
    """Follow the orbits about a drive and a frequency, over the drive or the frequency; None if it fails."""
    shaker, rate = case.scene.driven_shaker, case.scene.converter.rate
    # The output joins its samples by straight lines.
    drive *= float(np.sinc(frequency / rate)) ** 2
    key = "force" if shaker is not None and shaker.drive_is_force else "drive"
    theory = case.scene.replace(test={"kind": "sine", "frequency": frequency, key: drive}, channels=None)
    ratios, parameter, value = (_DRIVES, key, drive) if over_drive else (frequencies, "frequency", frequency)
    options = {"frequency": frequency} if over_drive else {}
    try:
        return rig.follow_orbits(
            theory, parameter, tuple(ratio * value for ratio in ratios), searches=searches, **options
        )
    except ShotrigError:
        return None


def _crossings(curve: rig.OrbitCurve, body: int, offset_of: _Offset) -> Iterator[_Crossing]:
    """Yield where an offset along a branch is zero, interpolated by cubics along the branch."""
    for branch in curve.branches:
        force = np.array([orbit.reference_amplitude for orbit in branch.orbits])
        frf = branch.frf[body]
        amplitude = abs(frf) * force
        offset = offset_of(branch.value, frf, amplitude)
        lengths = np.hypot(np.diff(branch.value) / np.ptp(branch.value), np.diff(np.log(amplitude)))
        chosen = np.flatnonzero(np.append(True, lengths > 1e-9))
        if chosen.size < 4:
            continue
        along = np.append(0.0, np.cumsum(lengths))[chosen]
        curves = CubicSpline(along, np.array([branch.value, np.log(amplitude), np.log(force)]).T[chosen])
        for value, height, level_there in curves(CubicSpline(along, offset[chosen]).solve(0.0, extrapolate=False)):
            repetition = branch.orbits[0].repetition
            yield _Crossing(float(value), float(np.exp(height)), float(np.exp(level_there)), repetition)


def _at_amplitude(curve: rig.OrbitCurve, body: int, level: float) -> list[_Crossing]:
    """Return where a branch has an amplitude in m."""
    return list(_crossings(curve, body, lambda _value, _frf, amplitude: np.log(amplitude / level)))


def _at_value(curve: rig.OrbitCurve, body: int, wanted: float) -> list[_Crossing]:
    """Return where a branch has a value of the parameter."""
    return list(_crossings(curve, body, lambda value, _frf, _amplitude: value - wanted))


def _phase_offset(_value: Array, frf: ComplexArray, _amplitude: Array) -> Array:
    """Return the deviation of the phase from -90 degrees, rad."""
    return np.unwrap(np.angle(1j * frf))


def _measured(case: Case) -> Iterator[tuple[Response, int, Marker]]:
    """Yield each settled point: the response of its level, its line there, and its marker."""
    markers = [mark for mark in case.recording.markers if mark.kind == "measure" and mark.fields["settled"]]
    for level in dict.fromkeys(mark.fields["level"] for mark in markers):
        for response in analysis.frequency_responses(case.recording, level=level):
            for mark in markers:
                if mark.fields["level"] == level:
                    yield response, int(np.argmin(abs(response.frequency - mark.fields["frequency"]))), mark


def _surface_points(case: Case) -> Iterator[_Point | None]:
    """Yield the force of each settled point, and that of the orbit with its frequency and amplitude."""
    surface = analysis.force_surface(case.recording)
    body = case.scene.structure.labels.index(surface.body)
    for response, line, mark in _measured(case):
        [k] = np.flatnonzero(
            (surface.frequency == response.frequency[line]) & (surface.force == response.amplitude[line])
        )
        force, drive = float(surface.force[k]), float(mark.fields["drive"])
        curve = _orbits(case, drive, float(surface.frequency[k]), over_drive=True)
        found = [] if curve is None else _at_amplitude(curve, body, float(surface.amplitude[k]))
        found = [each for each in found if each.repetition == mark.fields["repetition"]]
        if not found:
            yield None
            continue
        exact = min(found, key=lambda each: abs(each.value - drive)).force
        yield force, float(surface.force_expanded[k]) + _EXACT_ERROR * force, exact, force


def _curve_points(case: Case) -> Iterator[_Point | None]:
    """Yield the force of each settled point, and that of the orbit with its frequency and amplitude."""
    [location] = case.scene.controlled_terms
    for response, line, mark in _measured(case):
        k = [output.at for output in response.outputs].index(location)
        point = None
        for searches in _SEARCHES:
            point = _curve_point(case, response, line, k, mark.fields, searches) or point
            if point is not None and abs(point[0] - point[2]) <= point[1]:
                break
        yield point


def _curve_point(
    case: Case, response: Response, line: int, k: int, fields: Mapping[str, Any], searches: int
) -> _Point | None:
    """Return the force of a settled point, and that of the orbit with its frequency, amplitude and period.

    `k`: output. The orbits do not switch branches at a doubling of the period: without an orbit of the measured period,
    there is nothing to compare.
    """
    body, shaker = int(response.outputs[k].at.removeprefix("body ")) - 1, case.scene.driven_shaker
    force, drive = float(response.amplitude[line]), float(fields["drive"])
    value, frequency = abs(response.value[line, k, 0]), float(response.frequency[line])
    curve = _orbits(case, drive, frequency, over_drive=True, searches=searches)
    relative = float(response.expanded()[line, k, 0] / value)
    # Within the interval of the amplitude the exact force changes, by more where the response is nonlinear.
    probed = min(relative, _MAX_PROBED)
    amplitudes = [value * force * (1.0 + error) for error in (-probed, 0.0, probed)]
    at_amplitudes = [[] if curve is None else _at_amplitude(curve, body, amplitude) for amplitude in amplitudes]
    found = [[each for each in some if each.repetition == fields["repetition"]] for some in at_amplitudes]
    if not all(found):
        return None
    exact = [min(some, key=lambda each: abs(each.value - drive)).force for some in found]
    bound = float(np.ptp(exact)) / 2.0 * relative / probed
    if shaker is None or not shaker.drive_is_force:
        # The error of the response can also be that of the force.
        bound = max(bound, relative * force)
    # Feedback changes the force during the measurement.
    bound += (_EXACT_ERROR + float(fields["invasive"])) * force
    return force, bound, (max(exact) + min(exact)) / 2.0, force


def _phase_points(case: Case) -> Iterator[_Point | None]:
    """Yield frequency and amplitude of each locked level."""
    result = analysis.backbone(case.recording)
    body = case.scene.structure.labels.index(result.body)
    for k, (_, _, mark) in zip(np.flatnonzero(result.settled), _measured(case), strict=True):
        measured = float(result.frequency[k])
        curve = _orbits(case, float(mark.fields["drive"]), measured, over_drive=False)
        found = [] if curve is None else list(_crossings(curve, body, _phase_offset))
        if not found:
            yield None
            continue
        exact = min(found, key=lambda each: abs(each.value - measured))
        near = _orbits(case, float(mark.fields["drive"]), exact.value, over_drive=False, frequencies=_NEAR_FREQUENCIES)
        found = [] if near is None else list(_crossings(near, body, _phase_offset))
        exact = min(found, key=lambda each: abs(each.value - measured), default=exact)
        width = max(float(result.damping[k]) * exact.value, 1e-6 * exact.value)
        yield measured, float(result.frequency_expanded[k]), exact.value, width
        # At a coil spring, the force changes much with the frequency.
        there = [each.amplitude for each in _at_value(curve, body, measured)]
        amplitude = min(there, key=lambda each, known=exact.amplitude: abs(each - known))
        yield float(result.amplitude[k]), float(result.amplitude_expanded[k]), amplitude, amplitude


def _folds(case: Case) -> Iterator[_Point | None]:
    """Yield the frequency of each fold; the scale is a tenth of the band."""
    shaker = case.scene.driven_shaker
    if shaker is None or not shaker.drive_is_force:
        # Orbits have a constant drive, so that their folds are others.
        return
    for fold in analysis.continuation(case.recording).folds:
        curve = _orbits(case, fold.level, fold.frequency, over_drive=False)
        exact = [value for branch in (curve.branches if curve else ()) for value in branch.folds.tolist()]
        # Where impacts begin or end, a fold is a corner.
        exact += [end for band in (bands_between_folds(curve) if curve else ()) for end in band]
        if not exact:
            yield None
            continue
        nearest = min(exact, key=lambda value: abs(value - fold.frequency))
        yield fold.frequency, fold.expanded, nearest, 0.01 * fold.frequency


def _missed_folds(case: Case, kind: str) -> list[CheckResult]:
    """Check that both folds of each band that the steps resolve were measured, or that a gap or the end was named."""
    test, result = case.scene.test, analysis.continuation(case.recording)
    theory = case.scene.replace(test={"kind": "sine", "frequency": test.from_, "force": test.force}, channels=None)
    resolution = result.resolution(test.force)
    # Without a point in steady state nothing is resolved, and every band is missed.
    width = resolution if np.isfinite(resolution) else 0.0
    bands = [
        band
        for band in bands_between_folds(rig.follow_orbits(theory, "frequency", test.band))
        if band[1] - band[0] > width
    ]
    missed = [
        f"{low:.6g} to {high:.6g} Hz"
        for low, high in bands
        if sum(low - width < fold.frequency < high + width for fold in result.folds) < 2
    ]
    ends = [mark.fields["reason"] for mark in case.recording.markers if mark.kind == "abort"]
    outcome = "correct" if not missed else "warned" if ends or case.warnings else "wrong"
    note = f"{len(result.folds)} folds" + (f", missed {', '.join(missed)}" if missed else "")
    return [CheckResult("folds", kind, outcome, note="; ".join([note, *ends, *case.warnings]))]


def _linear_points(case: Case) -> Iterator[_Point | None]:
    """Yield natural frequency and damping ratio of each locked level, of a structure without dampers."""
    result = analysis.backbone(case.recording)
    frequencies, ratios = true_modes(case.scene)
    for k in np.flatnonzero(result.settled):
        nearest = int(np.argmin(abs(frequencies - result.frequency[k])))
        frequency, ratio = float(frequencies[nearest]), float(ratios[nearest])
        yield (
            float(result.natural_frequency[k]), float(result.natural_frequency_expanded[k]),
            frequency, ratio * frequency,
        )  # fmt: skip
        yield float(result.damping[k]), float(result.damping_expanded[k]), ratio, ratio


# Functions that yield the compared points of each kind of test.
_POINTS: dict[str, tuple[Callable[[Case], Iterator[_Point | None]], ...]] = {
    HELD: (_surface_points,),
    BACKBONE: (_phase_points,),
    CURVE: (_curve_points, _folds),
    FOLDS: (_curve_points, _folds),
    LINEAR_BACKBONE: (_linear_points,),
}
