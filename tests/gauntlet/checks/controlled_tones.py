"""Check of tests that control motion or phase: points lie within their 95 % intervals of exact orbits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import analysis
import rig
from rig.core.base.errors import ShotrigError
from tests.gauntlet.controlled_tones import BACKBONE, CURVE, HELD
from tests.gauntlet.result import Case, CheckResult

# At least this fraction of the points of a scene must lie within their intervals.
_MIN_COVERAGE = 0.7
# A point is misleading if its error exceeds both this multiple of its bound and `_MISLEADING_ERROR`.
_MISLEADING_BOUNDS = 3.0
_MISLEADING_ERROR = 0.05
# Largest relative error of the exact force: the branches are interpolated linearly.
_FORCE_ERROR = 1e-3
# Orbits are followed over the force, relative to that of the point, and over the frequency.
_FORCES, _FREQUENCIES = (0.75, 1.33), (0.97, 1.03)

# Measured value, half of its interval, exact value, and the scale of relative errors.
_Point = tuple[float, float, float, float]


def check(case: Case, kind: str) -> list[CheckResult]:
    """Compare forces of held motion, or frequencies and amplitudes of phase resonance, with exact orbits."""
    if kind not in (HELD, BACKBONE, CURVE):
        return []
    if kind == BACKBONE:
        points = list(_phase_points(case))
    else:
        points = list(_force_points(case))
        points += list(_folds(case)) if kind == CURVE else []
    if not points:
        return [CheckResult("orbits", kind, "refused", note="; ".join(case.warnings) or "no point settled")]
    measured, bound, exact, scale = np.array(points).T
    error = abs(measured - exact)
    inside = error <= bound
    misleading = (error > _MISLEADING_BOUNDS * bound) & (error > _MISLEADING_ERROR * scale)
    worst = int(np.argmax(error / bound))
    outcome = "correct" if inside.mean() >= _MIN_COVERAGE and not misleading.any() else "wrong"
    note = f"worst {measured[worst]:.6g} ± {bound[worst]:.2g}, exact {exact[worst]:.6g}"
    return [CheckResult("orbits", kind, outcome, int(inside.sum()), inside.size, float(np.median(bound / scale)), note)]


def _orbits(case: Case, parameter: str, value: float, **tone: float) -> rig.OrbitCurve | None:
    """Follow the orbits about a value of a parameter; None if they cannot be computed."""
    ratios = np.array(_FORCES if parameter == "force" else _FREQUENCIES)
    theory = case.scene.replace(test={"kind": "sine", **tone, parameter: value}, channels=None)
    options = {"frequency": tone["frequency"]} if parameter == "force" else {}
    try:
        return rig.follow_orbits(theory, parameter, tuple((ratios * value).tolist()), searches=2, **options)
    except ShotrigError:
        return None


def _crossings(curve: rig.OrbitCurve, body: int, level: float, phase: bool = False) -> Iterator[tuple[float, float]]:
    """Yield parameter and amplitude (m) where a branch has an amplitude, or a phase of -90 degrees."""
    for branch in curve.branches:
        amplitude = abs(branch.frf[body]) * [orbit.reference_amplitude for orbit in branch.orbits]
        offset = np.angle(1j * branch.frf[body]) if phase else amplitude - level
        for k in np.flatnonzero((offset[1:] * offset[:-1] <= 0.0) & (abs(np.diff(offset)) < 1.0)):
            share = offset[k] / (offset[k] - offset[k + 1])
            value, height = (each[k] + share * (each[k + 1] - each[k]) for each in (branch.value, amplitude))
            yield float(value), float(height)


def _force_points(case: Case) -> Iterator[_Point]:
    """Yield the force of each settled point, relative to that of the orbit with its frequency and amplitude."""
    location = next(iter(case.scene.controlled_terms))
    body = int(location.removeprefix("body ")) - 1
    for response in analysis.frequency_responses(case.recording):
        k = [output.at for output in response.outputs].index(location)
        expanded = response.expanded()
        for line in np.flatnonzero(
            np.ones(len(response.frequency), bool) if response.unsteady is None else ~response.unsteady
        ):
            force = float(response.amplitude[line])
            value, frequency = abs(response.value[line, k, 0]), float(response.frequency[line])
            curve = _orbits(case, "force", force, frequency=frequency)
            relative = float(expanded[line, k, 0] / value)
            # Within the interval of the amplitude, the exact force changes, by more where the response is nonlinear.
            amplitudes = [value * force * (1.0 + share * relative) for share in (-1.0, 0.0, 1.0)]
            found = [[] if curve is None else list(_crossings(curve, body, amplitude)) for amplitude in amplitudes]
            if all(found):
                exact = [min((each for each, _ in some), key=lambda each: abs(each - force)) for some in found]
                yield force, float(np.ptp(exact)) / 2.0 + _FORCE_ERROR * force, (max(exact) + min(exact)) / 2.0, force


def _phase_points(case: Case) -> Iterator[_Point]:
    """Yield frequency and amplitude of each locked level."""
    result = analysis.backbone(case.recording)
    body = case.scene.structure.labels.index(result.body)
    for k in np.flatnonzero(result.settled):
        curve = _orbits(case, "frequency", float(result.frequency[k]), force=float(result.level[k]))
        found = [] if curve is None else list(_crossings(curve, body, 0.0, phase=True))
        if found:
            frequency, amplitude = min(found, key=lambda each: abs(each[0] - result.frequency[k]))
            width = max(float(result.damping[k]) * frequency, 1e-6 * frequency)
            yield float(result.frequency[k]), float(result.frequency_bound[k]), frequency, width
            yield float(result.amplitude[k]), float(result.amplitude_bound[k]), amplitude, amplitude


def _folds(case: Case) -> Iterator[_Point]:
    """Yield the frequency of each fold; the scale is a tenth of the band."""
    for fold in analysis.continuation(case.recording).folds:
        curve = _orbits(case, "frequency", fold.frequency, force=fold.level)
        exact = [value for branch in (curve.branches if curve else ()) for value in branch.folds.tolist()]
        if exact:
            nearest = min(exact, key=lambda value: abs(value - fold.frequency))
            yield fold.frequency, fold.bound, nearest, 0.01 * fold.frequency
