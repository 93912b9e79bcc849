"""Search for the cause of a misfit between a scene and recordings.

Each trial corrects the curves for one supposed mistake, such as a reversed sign, and fits the structure again. The
mistake whose correction makes the scene fit is reported. The *misfit variance* is the mean square of the residuals in
standard deviations (reduced chi-square) or, if larger, the largest squared deviation of a sensor or clock from its
prior. Points that a fit omits are listed with their reasons.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, islice
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.fitting.estimate import mean_square, solve
from analysis.core.fitting.measured import Curves, Sensor, inverse_root
from analysis.core.fitting.parameters import free_parameters
from analysis.core.fitting.predicted import linear_response, scene_of_test
from analysis.core.fitting.problem import Problem
from analysis.core.fitting.start import initial_unknowns
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results import format_number
from rig.core.scene.scene import Scene
from rig.core.scene.structure import Dashpots, ModalDamping
from rig.core.system.structural_model import structural_model

# A correction explains the misfit if it reduces the misfit variance below this fraction.
_EXPLAINED_RATIO = 0.02
# The stated errors explain the residuals up to this misfit variance.
_MAX_NOISE_VARIANCE = 4.0
# Common errors of a sensor: the ratio of its reading to the true value, and the cause.
_UNIT_ERRORS = {
    -1.0: "its sign is reversed",
    9.80665: "m/s² read as g",
    1.0 / 9.80665: "g read as m/s²",
    1000.0: "a factor of 1000, such as mV instead of V or mm instead of m",
    0.001: "a factor of 1/1000, such as V instead of mV or m instead of mm",
    39.3701: "inches instead of metres",
    0.0254: "metres instead of inches",
    25.4: "millimetres instead of inches",
    1.0 / 25.4: "inches instead of millimetres",
    2.0: "peak-to-peak value instead of amplitude, or a factor of 2 in the sensitivity",
    0.5: "amplitude instead of peak-to-peak value, or a factor of 1/2 in the sensitivity",
    2.0**0.5: "amplitude instead of rms value",
    0.5**0.5: "rms value instead of amplitude",
}
# Number of integrations of a reading that a scene states wrongly, and the cause.
_WRONG_QUANTITIES = {
    -2: "it is the second derivative of the stated quantity, such as acceleration instead of displacement",
    -1: "it is the derivative of the stated quantity, such as acceleration instead of velocity",
    1: "it is the integral of the stated quantity, such as velocity instead of acceleration",
    2: "it is the second integral of the stated quantity, such as displacement instead of acceleration",
}
# Common errors of a force sensor: the ratio of its reading to the true value, and the cause.
_FORCE_UNIT_ERRORS = {
    4.44822: "newtons instead of pounds",
    1.0 / 4.44822: "pounds instead of newtons",
}
# Another mistake is nearly as probable as the best if its misfit variance is at most this multiple.
_CLOSE_RATIO = 1.5
# Number of known errors of a sensor with which the structure is fitted, the best agreement first.
_MAX_KNOWN_ERRORS = 2
# A fitted factor indicates a unit error if the relative difference from the factor of the unit error is at most this.
_UNIT_TOLERANCE = 0.06
_NO_UNIT_ERROR = (
    " (the factor does not correspond to a common unit error; the structure may also differ from the scene)"
)
# Delays of a channel that are tried for the first estimate, s.
_TRIAL_DELAYS = np.arange(-1.2e-3, 1.21e-3, 2e-5)
# The first estimate of a delay has an error of at most this, s.
_MAX_DELAY_ERROR = 1e-4
# A shorter delay than this is not reported, s.
_MIN_DELAY = 5e-6
# A sensitivity is fitted freely if the sensor has this relative tolerance.
_FREE_TOLERANCE = 1e4
# A unit is probably wrong if fitted and initial masses differ by more than this factor.
_MAX_MASS_RATIO = 2.5
# Maximum number of pairs of channels tested for a swap.
_MAX_PAIRS = 15
# At least this number of responses must remain without the omitted sensor, because a fit to fewer always succeeds.
_MIN_RESPONSES = 2


def find_cause(problem: Problem) -> tuple[bool, str]:
    """Return whether a single mistake explains the misfit, and a text with the mistake or else with the next steps.

    Only the recordings without moving dampers are searched.
    """
    linear_curves = [group.curves for group in problem.groups if group.orbits is None]
    if not linear_curves:
        return False, (
            "All recordings have moving dampers. Add a recording without dampers, which determines the structure."
        )
    uncorrected = _fit_structure(problem, linear_curves)
    if uncorrected.variance < _MAX_NOISE_VARIANCE:
        return False, (
            "The recordings without moving dampers fit, so the dampers of the scene differ from those of the rig. "
            "Correct the bodies and initial values of the dampers in the scene."
        )
    limit = max(_MAX_NOISE_VARIANCE, _EXPLAINED_RATIO * uncorrected.variance)
    explanations: list[_Explanation] = []
    try_delays = partial(_try_delays, undelayed=uncorrected)
    for trials in (_try_reversed_signs, _try_known_errors, _try_swaps, _try_factors, _try_damping, try_delays):
        explanations += [explanation for explanation in trials(problem, linear_curves) if explanation.variance < limit]
        if any(item.variance < _MAX_NOISE_VARIANCE and item.is_known_mistake for item in explanations):
            break
    if explanations:
        best, *others = sorted(explanations)
        text = f"{best.text}. If this is corrected, the scene fits."
        close = [other for other in others if other.is_known_mistake and other.variance < _CLOSE_RATIO * best.variance]
        if close:
            text += f" Nearly as probable: {close[0].text}."
        return best.is_known_mistake, text
    contradicting = [
        sensor.name
        for sensor in _sensors(linear_curves)
        if (remaining := _omit_sensor(linear_curves, sensor)) and _fit_structure(problem, remaining).variance < limit
    ]
    if len(contradicting) == 1:
        return True, (
            f"{contradicting[0]} contradicts the other channels: it may be delayed, loose, or mounted at another "
            "location than in the scene. Without this channel, the scene fits. Check its mounting and settings."
        )
    return False, (
        "No single mistake explains the misfit: neither a channel's sign, unit or delay, nor two swapped channels, nor "
        "the form of damping. Check the number of bodies, the driven body and the springs of the scene. The figure "
        "shows the frequencies with the largest residuals."
    )


def mass_scale_error(problem: Problem, x: Array) -> str:
    """Describe the mean factor of the fitted masses if it is so large that a unit must be wrong; "" otherwise."""
    masses = [k for k, parameter in enumerate(problem.parameters) if parameter.quantity == "masses"]
    if not masses:
        return ""
    factor = float(np.exp(np.mean((x - problem.start)[masses])))
    if 1.0 / _MAX_MASS_RATIO < factor < _MAX_MASS_RATIO:
        return ""
    # Receptances are displacements over forces: such masses need lower motion or higher force by the factor.
    unit_error = _unit_error(1.0 / factor) or _unit_error(factor, _FORCE_UNIT_ERRORS)
    return (
        f"The curves fit with {factor:.4g} times the masses of the scene{unit_error}: the unit of force or motion "
        "differs from that in the recording, or the masses of the scene are wrong. Correct the unit or the masses."
    )


class _Explanation(NamedTuple):
    """A supposed mistake whose correction was tried."""

    variance: float  # misfit variance with the correction
    text: str
    is_known_mistake: bool


_Explanations = Iterator[_Explanation]


def _try_reversed_signs(problem: Problem, linear_curves: list[Curves]) -> _Explanations:
    references = dict.fromkeys(curves.reference_sensor for curves in linear_curves)
    for sensor in (*references, *_sensors(linear_curves)):
        reversed_sign = []
        for curves in linear_curves:
            signs = np.array([-1.0 if channel_sensor == sensor else 1.0 for channel_sensor in curves.sensors])[:, None]
            reversed_sign.append(_multiply(curves, -signs if curves.reference_sensor == sensor else signs))
        variance = _fit_structure(problem, reversed_sign).variance
        yield _Explanation(variance, f"The sign of {sensor.name} is reversed", True)


def _try_swaps(problem: Problem, linear_curves: list[Curves]) -> _Explanations:
    names = dict.fromkeys(sensor.name for curves in linear_curves for sensor in curves.sensors)
    for pair in islice(combinations(names, 2), _MAX_PAIRS):
        partner = dict(zip(pair, reversed(pair), strict=True))
        swapped = []
        for curves in linear_curves:
            sensors = [sensor.name for sensor in curves.sensors]
            body = dict(zip(sensors, curves.bodies, strict=True))
            has_both = body.keys() >= partner.keys()
            swapped_names = [partner.get(name, name) if has_both else name for name in sensors]
            swapped.append(replace(curves, bodies=tuple(body[name] for name in swapped_names)))
        yield _Explanation(_fit_structure(problem, swapped).variance, f"{pair[0]} and {pair[1]} are swapped", True)


def _try_factors(problem: Problem, linear_curves: list[Curves]) -> _Explanations:
    """Yield the best-fitting factor of each sensor; without a matching unit error the structure may also differ."""
    references = [curves.reference_sensor for curves in linear_curves]
    force_sensors = [curves.reference_sensor for curves in linear_curves if curves.reference == "force"]
    for sensor in dict.fromkeys((*_sensors(linear_curves), *references)):
        freed_sensor = replace(sensor, tolerance=_FREE_TOLERANCE)
        refit = _fit_structure(
            problem,
            [
                replace(
                    curves,
                    sensors=tuple(freed_sensor if other == sensor else other for other in curves.sensors),
                    reference_sensor=freed_sensor if curves.reference_sensor == sensor else curves.reference_sensor,
                )
                for curves in linear_curves
            ],
        )
        factor = 1.0 + refit.problem.deviation(refit.x, freed_sensor)
        force_errors = _FORCE_UNIT_ERRORS if sensor in force_sensors else {}
        unit_error = _unit_error(factor, _UNIT_ERRORS | force_errors)
        text = f"{sensor.name} reads {factor:.4g} times the value that fits{unit_error or _NO_UNIT_ERROR}"
        yield _Explanation(refit.variance, text, bool(unit_error))


def _try_known_errors(problem: Problem, linear_curves: list[Curves]) -> _Explanations:
    """Yield the known errors of each response sensor that agree best with its readings.

    A structure fitted to the other sensors predicts the readings, from which the errors to be fitted are chosen.
    """
    for sensor in _sensors(linear_curves):
        others = _omit_sensor(linear_curves, sensor)
        if not others:
            continue
        refit = _fit_structure(problem, others)
        predicted = _predict_sensor(refit, linear_curves, sensor)
        errors = sorted(_KNOWN_ERRORS, key=lambda error: _misfit(error, linear_curves, sensor, predicted))
        for error in errors[:_MAX_KNOWN_ERRORS]:
            corrected = [_correct(curves, sensor, error) for curves in linear_curves]
            yield _Explanation(_fit_structure(problem, corrected).variance, f"{sensor.name}: {error.text}", True)


class _KnownError(NamedTuple):
    """An error that multiplies the readings of a sensor by `factor` (2 pi i f) ** -`integrations`."""

    text: str
    factor: float
    integrations: int

    def ratio(self, frequency: Array) -> ComplexArray:
        """Return the ratio of the reading to the true value at frequencies, Hz; shape (n,)."""
        return np.asarray(self.factor * (2j * np.pi * frequency) ** -self.integrations)


#: The known errors of a response sensor.
_KNOWN_ERRORS = (
    *(
        _KnownError(f"it reads {factor:.4g} times the true value ({text})", factor, 0)
        for factor, text in _UNIT_ERRORS.items()
    ),
    *(_KnownError(text, 1.0, order) for order, text in _WRONG_QUANTITIES.items()),
)


def _predict_sensor(refit: _Refit, linear_curves: list[Curves], sensor: Sensor) -> list[ComplexArray]:
    """Predict the responses of a sensor by a structure that was fitted without it; shapes (rows of the sensor, n)."""
    scene = refit.problem.scene(refit.x)
    predicted = []
    for curves in linear_curves:
        bodies = [body for body, other in zip(curves.bodies, curves.sensors, strict=True) if other == sensor]
        predicted.append(linear_response(scene_of_test(scene, curves), curves, curves.frequency)[0][bodies])
    return predicted


def _misfit(error: _KnownError, linear_curves: list[Curves], sensor: Sensor, predicted: list[ComplexArray]) -> float:
    """Return the median deviation between the logarithms of the readings and of the predictions with an error.

    Neither the noise nor the resonances, where a structure fitted without the sensor is least accurate, dominate it.
    """
    deviations = []
    for curves, values in zip(linear_curves, predicted, strict=True):
        rows = [k for k, other in enumerate(curves.sensors) if other == sensor]
        ratio = curves.value[rows] / (values * error.ratio(curves.frequency))
        deviations.append(abs(np.log(ratio)).ravel())
    return float(np.nanmedian(np.concatenate(deviations)))


def _correct(curves: Curves, sensor: Sensor, error: _KnownError) -> Curves:
    """Remove an error from the readings of a sensor."""
    factors = np.ones(curves.value.shape, dtype=complex)
    factors[[other == sensor for other in curves.sensors]] = 1.0 / error.ratio(curves.frequency)
    return _multiply(curves, factors)


def _try_damping(problem: Problem, linear_curves: list[Curves]) -> _Explanations:
    """Try dashpots instead of modal damping, or the reverse, on a chain of masses and springs."""
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
        form = ModalDamping(modal=tuple(float(max(ratio, 1e-4)) for ratio in modes.damping_ratio))
        text = "a ratio for each mode fits: give structure.damping: {modal: [...]}"
    model = problem.model.replace(structure=structure.replace(damping=form))
    variance = _fit_structure(problem, linear_curves, model).variance
    yield _Explanation(variance, f"The damping is not of the scene's form; {text}", True)


def _try_delays(problem: Problem, linear_curves: list[Curves], undelayed: _Refit) -> _Explanations:
    """Yield the best-fitting delay of each sensor; `undelayed`: the fit without a correction."""
    for sensor in dict.fromkeys((*_sensors(linear_curves), *(curves.reference_sensor for curves in linear_curves))):
        initial_delay, trial = _estimate_delay(linear_curves, sensor), undelayed
        if initial_delay:
            trial = _fit_structure(
                problem, [_compensate_delay(curves, sensor, initial_delay) for curves in linear_curves]
            )
        if trial.variance > undelayed.variance:
            trial, initial_delay = undelayed, 0.0

        def variance(delay: float, trial: _Refit = trial, sensor: Sensor = sensor) -> float:
            return trial.refit([_compensate_delay(curves, sensor, delay) for curves in linear_curves]).variance

        bounds = (initial_delay - _MAX_DELAY_ERROR, initial_delay + _MAX_DELAY_ERROR)
        best = scipy.optimize.minimize_scalar(variance, bounds=bounds, options={"xatol": 1e-6})
        delay = float(best.x)
        if abs(delay) > _MIN_DELAY:
            direction = "late" if delay > 0.0 else "early"
            text = f"{sensor.name} reads {format_number(abs(delay) * 1e6)} µs {direction} (delay in the table)"
            yield _Explanation(float(best.fun), text, True)


def _sensors(linear_curves: list[Curves]) -> list[Sensor]:
    """Return the sensors of all responses."""
    return list(dict.fromkeys(sensor for curves in linear_curves for sensor in curves.sensors))


def _multiply(curves: Curves, factor: float | ComplexArray | Array) -> Curves:
    """Multiply responses by factors, shape (responses, n) or broadcastable to it."""
    factors = np.broadcast_to(np.asarray(factor, dtype=complex), curves.value.shape)
    return replace(
        curves,
        value=curves.value * factors,
        whitening=curves.whitening / factors.T[:, None],
        line_bound=curves.line_bound * abs(factors),
        correlated_bound=curves.correlated_bound * abs(factors),
        frfs=tuple(frf.scaled(row) for frf, row in zip(curves.frfs, factors, strict=True)),
    )


def _estimate_delay(linear_curves: list[Curves], sensor: Sensor) -> float:
    """Return the delay of a sensor, s, that brings the phases closest to 0 or 180 degrees; 0 without responses.

    Away from resonances the phase of a response is near these values; a delay adds a phase proportional to frequency.
    """
    alignment = np.zeros(_TRIAL_DELAYS.size)
    sign = -1.0 if any(curves.reference_sensor == sensor for curves in linear_curves) else 1.0
    for curves in linear_curves:
        is_reference = curves.reference_sensor == sensor
        rows = [k for k, channel_sensor in enumerate(curves.sensors) if is_reference or channel_sensor == sensor]
        # The doubled phase is near 0 for both signs of the response.
        rotation = np.exp(sign * 4j * np.pi * np.outer(_TRIAL_DELAYS, curves.frequency))
        for k in rows:
            direction = (curves.value[k] / np.maximum(abs(curves.value[k]), 1e-300)) ** 2
            weight = np.minimum(abs(curves.whitening[:, k, k] * curves.value[k]), 30.0)
            alignment += (rotation @ (weight * direction)).real
    return float(_TRIAL_DELAYS[int(np.argmax(alignment))]) if alignment.any() else 0.0


def _compensate_delay(curves: Curves, sensor: Sensor, delay: float) -> Curves:
    """Remove a delay from the readings of a sensor."""
    delays = np.array([float(channel_sensor == sensor) for channel_sensor in curves.sensors])
    delays -= float(curves.reference_sensor == sensor)
    return _multiply(curves, np.exp(2j * np.pi * delay * np.outer(delays, curves.frequency)))


def _omit_sensor(linear_curves: list[Curves], sensor: Sensor) -> list[Curves]:
    """Return the curves without the responses of a sensor; empty if fewer than two responses would remain."""
    without_sensor = []
    for curves in linear_curves:
        rows = [k for k, channel_sensor in enumerate(curves.sensors) if channel_sensor != sensor]
        if len(rows) < _MIN_RESPONSES:
            return []
        root = np.linalg.inv(curves.whitening)
        covariance = (root @ root.conj().swapaxes(1, 2))[:, rows][:, :, rows]
        remaining: dict[str, Any] = {
            name: getattr(curves, name)[rows] for name in ("value", "line_bound", "correlated_bound")
        }
        for name in ("sensors", "bodies", "frfs"):
            remaining[name] = tuple(getattr(curves, name)[k] for k in rows)
        errors = curves.errors.select(rows)
        without_sensor.append(replace(curves, whitening=inverse_root(covariance), errors=errors, **remaining))
    return without_sensor


def list_omitted_points(curves: Curves, is_fitted: NDArray[np.bool_], uncovered: Mapping[int, str]) -> list[str]:
    """List the points that a fit omits, with the reasons.

    `is_fitted` has the shape (n,); `uncovered`: reason why no orbit can be computed for the motion at a point.
    """
    reasons: dict[str, list[str]] = {}
    for k in np.flatnonzero(~is_fitted).tolist():
        if k in uncovered:
            reason = (
                f"{uncovered[k]}, which a fit cannot compute (restitution 0 or contact: {{duration: ...}} avoids this)"
            )
        else:
            reason = "the motion of the rig is irregular, or has another type than the motion of the model"
        reasons.setdefault(reason, []).append(f"{curves.frequency[k]:.4g}")
    return [
        f"{curves.label}: omitted {', '.join(frequencies)} Hz, where {reason}."
        for reason, frequencies in reasons.items()
    ]


@dataclass(frozen=True)
class _Refit:
    """The structure fitted to curves that are corrected for a supposed mistake."""

    problem: Problem
    x: Array  # unknowns

    @property
    def variance(self) -> float:
        """Misfit variance."""
        problem = self.problem
        normalized_deviation = ((self.x - problem.start) / problem.prior_sd)[len(problem.parameters) :]
        return max(mean_square(problem, self.x, problem.groups), *(normalized_deviation**2), 0.0)

    def refit(self, curves: list[Curves]) -> _Refit:
        """Fit slightly different curves, starting from these values."""
        trial = Problem(self.problem.model, self.problem.parameters, curves)
        return _Refit(trial, solve(trial, self.x, trial.groups, 0.0, max_evaluations=5))


def _fit_structure(problem: Problem, curves: list[Curves], model: Scene | None = None) -> _Refit:
    """Fit the structure of a scene (by default the problem's) to curves."""
    parameters = [parameter for parameter in problem.parameters if parameter.key_path[0] != "dampers"]
    if model is not None:
        # The values of the new form of damping are free too.
        free_keys = {parameter.key for parameter in parameters}
        parameters = [
            parameter
            for parameter in free_parameters(model)
            if parameter.key in free_keys or parameter.key_path[:2] == ("structure", "damping")
        ]
    trial = Problem(model or problem.model, parameters, curves)
    x = initial_unknowns(trial, trial.groups)
    for model_error in (0.1, 0.01, 0.0):
        x = solve(trial, x, trial.groups, model_error, max_evaluations=15)
    return _Refit(trial, x)


def _unit_error(factor: float, unit_errors: Mapping[float, str] = _UNIT_ERRORS) -> str:
    for unit_factor, text in unit_errors.items():
        if abs(factor / unit_factor - 1.0) < _UNIT_TOLERANCE:
            return f" ({text})"
    return ""
