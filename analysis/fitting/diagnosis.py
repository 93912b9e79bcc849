"""Causes of a misfit: mistakes in channels, another form of damping, motions that cannot be computed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations, islice
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.fitting.estimate import mean_square, solved
from analysis.fitting.measured import Curves, Sensor, inverse_root
from analysis.fitting.parameters import free_parameters
from analysis.fitting.problem import Problem
from analysis.fitting.start import start
from rig.arrays import Array, ComplexArray
from rig.results import format_number
from rig.scene.scene import Scene
from rig.scene.structure import Dashpots, ModalDamping
from rig.system.structural_model import structural_model

# A cause explains a misfit if it leaves less than this share of it, and fully if it leaves no more than this multiple
# of the stated variance.
_EXPLAINED = 0.02
_FULLY_EXPLAINED = 4.0
# Factors of common mistakes of units, with the mistake.
_FACTORS = {
    -1.0: "its sign is reversed",
    9.80665: "m/s² read as g, or the other way round",
    1.0 / 9.80665: "g read as m/s²",
    1000.0: "a factor of 1000, such as mV instead of V",
    0.001: "a factor of 1/1000, such as V instead of mV",
    39.3701: "inches instead of metres",
    0.0254: "metres instead of inches",
    4.44822: "pounds instead of newtons",
    1.0 / 4.44822: "newtons instead of pounds",
}
# Relative deviation within which a factor is attributed to a mistake of units.
_FACTOR_TOLERANCE = 0.06
_NO_UNIT = " (not a common mistake of units: the structure may differ from the scene)"
# Delays of a channel that are tried, s.
_DELAYS = np.arange(-1.2e-3, 1.21e-3, 2e-5)
# Smallest reported delay, and maximum error of the first guess, s.
_MIN_DELAY = 5e-6
_MAX_DELAY_ERROR = 1e-4
# Sensitivity tolerance of a suspected sensor during its trial fit.
_SUSPECT_TOLERANCE = 1e4
# If all masses change by at least this factor, a unit is suspected.
_SUSPICIOUS_MASS_FACTOR = 2.5
# Maximum number of pairs of channels that are swapped.
_MAX_PAIRS = 15
# With fewer responses, a fit always succeeds, so that a trial without a sensor is not conclusive.
_MIN_RESPONSES = 2


def cause(problem: Problem) -> tuple[bool, str]:
    """Try single mistakes in the recordings without moving dampers, and name the one that explains the misfit best.

    Returns whether a mistake explains the misfit, and a text that names it or lists the mistakes that were tried.
    """
    bare = [group.curves for group in problem.groups if group.tones is None]
    if not bare:
        return False, (
            "No recording without moving dampers is among them. Add one, so that the structure can be fitted alone."
        )
    before = _refit(problem, bare).variance
    if before < _FULLY_EXPLAINED:
        return False, (
            "The recordings without moving dampers fit, so the dampers differ from the scene's, or their start values "
            "are too far off."
        )
    limit = max(_FULLY_EXPLAINED, _EXPLAINED * before)
    found: list[tuple[float, str, bool]] = []
    for kind in (_reverse_signs, _swap_channels, _free_sensitivities, _change_damping, _remove_delays):
        found += [each for each in kind(problem, bare) if each[0] < limit]
        if any(left < _FULLY_EXPLAINED and is_certain for left, _, is_certain in found):
            break
    if found:
        _, text, is_certain = min(found)
        return is_certain, f"{text}: corrected, the rest fits."
    alone = [
        sensor.name
        for sensor in _sensors(bare)
        if (rest := _leave_out(bare, sensor)) and _refit(problem, rest).variance < limit
    ]
    if len(alone) == 1:
        return True, (
            f"{alone[0]} contradicts the other channels: it may be delayed, loose or at another place "
            "than in the scene. Without it the scene fits."
        )
    return False, (
        "Tried without success: each channel's sign, unit and delay, two channels swapped, another form of damping. "
        "Check the number of bodies, the driven body and further springs; the figure of the residuals shows where."
    )


def report_mass_scale(problem: Problem, x: Array) -> str:
    """Say whether all masses are off their guess by so much that a unit must be wrong."""
    masses = [k for k, one in enumerate(problem.parameters) if one.what == "masses"]
    if not masses:
        return ""
    factor = float(np.exp(np.mean((x - problem.start)[masses])))
    if 1.0 / _SUSPICIOUS_MASS_FACTOR < factor < _SUSPICIOUS_MASS_FACTOR:
        return ""
    return (
        f"The curves fit with {factor:.4g} times the masses of the scene{_unit_mistake(1.0 / factor)}: the "
        "unit of force or motion differs from that in the recording, or the masses of the scene are "
        "wrong. Correct either."
    )


# Hypotheses of one kind: the residual variance of each, its description, and whether it is a known mistake.
_Explanations = Iterator[tuple[float, str, bool]]


def _reverse_signs(problem: Problem, bare: list[Curves]) -> _Explanations:
    references = dict.fromkeys(curves.reference_sensor for curves in bare)
    for sensor in (*references, *_sensors(bare)):
        reversed_sign = []
        for curves in bare:
            signs = np.array([-1.0 if each == sensor else 1.0 for each in curves.sensors])[:, None]
            reversed_sign.append(_multiply(curves, -signs if curves.reference_sensor == sensor else signs))
        yield _refit(problem, reversed_sign).variance, f"The sign of {sensor.name} is reversed", True


def _swap_channels(problem: Problem, bare: list[Curves]) -> _Explanations:
    names = dict.fromkeys(sensor.name for curves in bare for sensor in curves.sensors)
    for pair in islice(combinations(names, 2), _MAX_PAIRS):
        other = dict(zip(pair, reversed(pair), strict=True))
        swapped = []
        for curves in bare:
            sensors = [sensor.name for sensor in curves.sensors]
            at = dict(zip(sensors, curves.bodies, strict=True))
            names_there = [other.get(name, name) if at.keys() >= other.keys() else name for name in sensors]
            swapped.append(replace(curves, bodies=tuple(at[name] for name in names_there)))
        yield _refit(problem, swapped).variance, f"{pair[0]} and {pair[1]} are swapped", True


def _free_sensitivities(problem: Problem, bare: list[Curves]) -> _Explanations:
    """Yield the factor of each sensor that fits best; a factor that is no unit may also mean another structure."""
    references = [curves.reference_sensor for curves in bare]
    for sensor in dict.fromkeys((*_sensors(bare), *references)):
        free = replace(sensor, tolerance=_SUSPECT_TOLERANCE)
        trial = _refit(
            problem,
            [
                replace(
                    curves,
                    sensors=tuple(free if each == sensor else each for each in curves.sensors),
                    reference_sensor=free if curves.reference_sensor == sensor else curves.reference_sensor,
                )
                for curves in bare
            ],
        )
        factor = 1.0 + trial.problem.deviation(trial.x, free)
        meaning = _unit_mistake(factor)
        text = f"{sensor.name} reads {factor:.4g} times what fits{meaning or _NO_UNIT}"
        yield trial.variance, text, bool(meaning)


def _change_damping(problem: Problem, bare: list[Curves]) -> _Explanations:
    """Try the other form of damping of a chain, of the same strength."""
    structure = problem.model.structure
    if structure.masses is None or structure.springs is None:
        return
    modes = structural_model(problem.model).modes
    form: ModalDamping | Dashpots
    if isinstance(structure.damping, ModalDamping):
        per_stiffness = 2.0 * float(modes.damping_ratio.mean()) / modes.omega[0]
        form = Dashpots(dashpots=tuple(per_stiffness * k for k in structure.springs))
        text = "dashpots fit: give structure.damping: {dashpots: [...]}"
    else:
        form = ModalDamping(modal=tuple(float(max(each, 1e-4)) for each in modes.damping_ratio))
        text = "a ratio for each mode fits: give structure.damping: {modal: [...]}"
    model = problem.model.replace(structure=structure.replace(damping=form))
    yield _refit(problem, bare, model).variance, f"The damping is not of the scene's form; {text}", True


def _remove_delays(problem: Problem, bare: list[Curves]) -> _Explanations:
    undelayed = _refit(problem, bare)
    for sensor in dict.fromkeys((*_sensors(bare), *(curves.reference_sensor for curves in bare))):
        guess = _estimate_delay(bare, sensor)
        trial_fit = (
            _refit(problem, [_compensate_delay(curves, sensor, guess) for curves in bare])
            if guess
            else undelayed
        )
        if trial_fit.variance > undelayed.variance:
            trial_fit, guess = undelayed, 0.0

        def variance(delay: float, trial_fit: _Refit = trial_fit, sensor: Sensor = sensor) -> float:
            return trial_fit.adjusted([_compensate_delay(curves, sensor, delay) for curves in bare]).variance

        bounds = (guess - _MAX_DELAY_ERROR, guess + _MAX_DELAY_ERROR)
        best = scipy.optimize.minimize_scalar(variance, bounds=bounds, options={"xatol": 1e-6})
        delay = float(best.x)
        if abs(delay) > _MIN_DELAY:
            late = "late" if delay > 0.0 else "early"
            text = f"{sensor.name} reads {format_number(abs(delay) * 1e6)} µs {late} (delay in the table)"
            yield float(best.fun), text, True


def _sensors(bare: list[Curves]) -> list[Sensor]:
    """All sensors of responses."""
    return list(dict.fromkeys(sensor for curves in bare for sensor in curves.sensors))


def _multiply(curves: Curves, factor: float | ComplexArray | Array) -> Curves:
    """Multiply responses by phase factors, shape (responses, n) or broadcastable to it."""
    factors = np.broadcast_to(np.asarray(factor, dtype=complex), curves.value.shape)
    return replace(
        curves,
        value=curves.value * factors,
        whiten=curves.whiten * factors.conj().T[:, None],
        frfs=tuple(frf.scaled(row) for frf, row in zip(curves.frfs, factors, strict=True)),
    )


def _estimate_delay(bare: list[Curves], sensor: Sensor) -> float:
    """Return the delay of a sensor, s, that aligns its phase best with the others.

    A delay adds a phase proportional to frequency; without it the phase is trial_fit 0 or 180 degrees away from modes.
    """
    alignment = np.zeros(_DELAYS.size)
    sign = -1.0 if any(curves.reference_sensor == sensor for curves in bare) else 1.0
    for curves in bare:
        reference = curves.reference_sensor == sensor
        rows = [k for k, one in enumerate(curves.sensors) if reference or one == sensor]
        # The doubled phase does not depend on the sign.
        phase_factors = np.exp(sign * 4j * np.pi * np.outer(_DELAYS, curves.frequency))
        for k in rows:
            unit = (curves.value[k] / np.maximum(abs(curves.value[k]), 1e-300)) ** 2
            weight = np.minimum(abs(curves.whiten[:, k, k] * curves.value[k]), 30.0)
            alignment += (phase_factors @ (weight * unit)).real
    return float(_DELAYS[int(np.argmax(alignment))]) if alignment.any() else 0.0


def _compensate_delay(curves: Curves, sensor: Sensor, delay: float) -> Curves:
    """Remove a delay from the readings of a sensor."""
    delayed = np.array([float(each == sensor) for each in curves.sensors])
    delayed -= float(curves.reference_sensor == sensor)
    return _multiply(curves, np.exp(2j * np.pi * delay * np.outer(delayed, curves.frequency)))


def _leave_out(bare: list[Curves], sensor: Sensor) -> list[Curves]:
    """Leave out the responses of a sensor; empty if fewer than two responses would remain."""
    out = []
    for curves in bare:
        rows = [k for k, each in enumerate(curves.sensors) if each != sensor]
        if len(rows) < _MIN_RESPONSES:
            return []
        color = np.linalg.inv(curves.whiten)
        covariance = (color @ color.conj().swapaxes(1, 2))[:, rows][:, :, rows]
        rest: dict[str, Any] = {name: getattr(curves, name)[rows] for name in ("value", "rough", "smooth")}
        for name in ("sensors", "bodies", "frfs"):
            rest[name] = tuple(getattr(curves, name)[k] for k in rows)
        out.append(
            replace(curves, whiten=inverse_root(covariance), errors=curves.errors.select(rows), **rest)
        )
    return out


def omitted_points(curves: Curves, used: NDArray[np.bool_], uncovered: Mapping[int, str]) -> list[str]:
    """List the points that were left out of a fit, with the reasons.

    `used` has the shape (n,); `uncovered`: reason why no orbit can be computed for the motion at a point.
    """
    why: dict[str, list[str]] = {}
    for k in np.flatnonzero(~used).tolist():
        reason = "the motion of the rig is irregular, or of another type than that of the model"
        if k in uncovered:
            reason = (
                f"{uncovered[k]}, which a fit cannot compute (restitution 0 or contact: {{duration: "
                "...} avoids this)"
            )
        why.setdefault(reason, []).append(f"{curves.frequency[k]:.4g}")
    return [f"{curves.label}: left out {', '.join(at)} Hz, where {reason}." for reason, at in why.items()]


@dataclass(frozen=True)
class _Refit:
    """The scene fitted to curves that are corrected for a supposed mistake."""

    problem: Problem
    x: Array

    @property
    def variance(self) -> float:
        """Residual variance, or the squared deviation of a sensor in tolerances if that is larger."""
        problem = self.problem
        deviations = ((self.x - problem.start) / problem.spread)[len(problem.parameters) :]
        return max(mean_square(problem, self.x, problem.groups), *(deviations**2), 0.0)

    def adjusted(self, curves: list[Curves]) -> _Refit:
        """Fit slightly different curves, starting from these values."""
        trial = Problem(self.problem.model, self.problem.parameters, curves)
        return _Refit(trial, solved(trial, self.x, trial.groups, 0.0, most=5))


def _refit(problem: Problem, curves: list[Curves], model: Scene | None = None) -> _Refit:
    """Fit the structure of a scene to curves."""
    parameters = [one for one in problem.parameters if one.place[0] != "dampers"]
    if model is not None:
        # The free values stay free, and so are those of the new form of damping.
        free = {one.key for one in parameters}
        new = ("structure", "damping")
        parameters = [one for one in free_parameters(model) if one.key in free or one.place[:2] == new]
    trial = Problem(model or problem.model, parameters, curves)
    x = start(trial, trial.groups)
    for distrust in (0.1, 0.01, 0.0):
        x = solved(trial, x, trial.groups, distrust, most=15)
    return _Refit(trial, x)


def _unit_mistake(factor: float) -> str:
    for known, text in _FACTORS.items():
        if abs(factor / known - 1.0) < _FACTOR_TOLERANCE:
            return f" ({text})"
    return ""
