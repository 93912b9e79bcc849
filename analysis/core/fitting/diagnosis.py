"""Search for the cause of a misfit between a scene and recordings.

Each trial corrects the curves for one supposed mistake, such as a reversed sign, and fits the structure again. The
most likely mistake whose correction makes the scene fit is reported. Points that a fit omits are listed with their
reasons.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations, islice
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.fitting.estimate import mean_square, solve
from analysis.core.fitting.measured import Curves, Sensor, inverse_root
from analysis.core.fitting.parameters import free_parameters
from analysis.core.fitting.problem import Problem
from analysis.core.fitting.start import initial_unknowns
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results import format_number
from rig.core.scene.structure import Dashpots, ModalDamping
from rig.core.system.structural_model import structural_model

# Largest ratio of residual to stated variance: stated uncertainties may be too small by a factor of 2.
_MAX_NOISE_VARIANCE = 4.0
# The ratio is multiplied by the reduced chi-square that is exceeded by noise with this probability.
_NOISE_PROBABILITY = 1e-4
# Common mistakes in a channel: the ratio of its reading to the true value, and the cause.
_SCALE_MISTAKES = {
    9.80665: "m/s² read as g",
    1.0 / 9.80665: "g read as m/s²",
    1000.0: "values in mV declared as V, or in mm declared as m",
    0.001: "values in V declared as mV, or in m declared as mm",
    39.3701: "values in inches, declared as m",
    0.0254: "values in m, declared as inches",
    25.4: "values in mm, declared as inches",
    1.0 / 25.4: "values in inches, declared as mm",
    2.0: "peak-to-peak values, declared as amplitudes, or a factor of 2 in the sensitivity",
    0.5: "amplitudes, declared as peak-to-peak values, or a factor of 1/2 in the sensitivity",
    np.sqrt(2.0): "amplitudes, declared as rms values",
    np.sqrt(0.5): "rms values, declared as amplitudes",
}
# Common mistakes in a force channel: the ratio of its reading to the true value, and the cause.
_FORCE_MISTAKES = {
    4.44822: "values in N, declared as pounds-force",
    1.0 / 4.44822: "values in pounds-force, declared as N",
}
# Number of time derivatives between the stated quantity and the quantity of the reading, and the cause.
_DERIVATIVE_MISTAKES = {
    1: "it is the derivative of the stated quantity, such as acceleration declared as velocity",
    -1: "it is the integral of the stated quantity, such as velocity declared as acceleration",
    2: "it is the second derivative of the stated quantity, such as acceleration declared as displacement",
    -2: "it is the second integral of the stated quantity, such as displacement declared as acceleration",
}
# Number of mistakes of a sensor and of swapped pairs that are fitted: those with the smallest initial cost.
_MAX_FITTED_MISTAKES = 4
# Model error in the initial cost, relative to the local peak: initial values do not fit the curves yet.
_MODEL_ERROR = 0.1
# Limit of a squared normalized residual (30²) in the initial cost: a few outliers must not decide.
_MAX_SQUARE = 900.0
# The structure is fitted with each of these model errors in turn: larger errors smooth the cost far from the solution.
_MODEL_ERRORS = (0.1, 0.01, 0.0)
# Two explanations are not distinguished if their sums of squares differ by at most this multiple of the mean square
# (likelihood ratio 90). A free factor adds an unknown, so it is preferred only if its sum of squares is smaller by
# more.
_CLOSE_SQUARE = 9.0
# Largest ratio of the factor of the masses to that of a unit error: people estimate the mean mass so well.
_UNIT_TOLERANCE = 1.25
_NO_UNIT_ERROR = (
    " (the factor does not correspond to a common unit error; the structure may also differ from the scene)"
)
# Delays of a channel that are tried for the first estimate [s].
_TRIAL_DELAYS = np.arange(-5e-3, 5.01e-3, 2e-5)
# Radius of the interval in which a delay is searched [s]: the estimate is uncertain with few points off resonance.
_SEARCH_RADIUS = 1e-4
# Maximum number of search intervals: if the minimum is near an end of an interval, the next is centered there.
_MAX_SEARCHES = 3
# Tolerance of a delay [s]: it turns a phase at 1 kHz by 6e-5 rad.
_DELAY_TOLERANCE = 1e-8
# A shorter delay than this is not reported [s].
_MIN_DELAY = 5e-6
# Relative tolerance of a sensor whose sensitivity is fitted freely: so large that it has no effect.
_FREE_TOLERANCE = 1e4
# Largest plausible ratio of fitted to initial masses: people estimate masses better; beyond it, a unit is wrong.
_MAX_MASS_RATIO = 2.5
# Maximum number of pairs of channels tested for a swap: all pairs of six channels; each pair takes a fit.
_MAX_PAIRS = 15
# At least this number of responses must remain without the omitted sensor, because a fit to fewer always succeeds.
_MIN_RESPONSES = 2


def find_cause(problem: Problem, x: Array) -> tuple[bool, str]:
    """Return whether a single mistake is the cause of the misfit, and a text with this mistake or with the next steps.

    Only the recordings without moving dampers are searched. `x`: the fitted unknowns.
    """
    linear_curves = [group.curves for group in problem.groups if group.orbits is None]
    if not linear_curves:
        return False, (
            "All recordings have moving dampers. Add a recording without dampers, which determines the structure."
        )
    uncorrected = _Refit(problem, x).with_curves(linear_curves).solved((0.0,))
    if uncorrected.fits:
        return False, (
            "The scene agrees with the recordings without moving dampers, but not with the others. Correct the dampers "
            "in the scene (body, mass, clearance, restitution), because the fit begins with them."
        )
    explanations: list[_Explanation] = []
    for trials in (_try_swaps, _try_channels, _try_damping, _try_delays):
        explanations += trials(uncorrected, linear_curves)
        is_complete = trials is not _try_swaps  # swapped channels and scale mistakes are compared
        if is_complete and any(item.is_known_mistake and item.refit.fits for item in explanations):
            break
    if explaining := [item for item in explanations if item.refit.fits]:
        return _most_likely(explaining)
    contradicting = [
        sensor.name
        for sensor in _sensors(linear_curves)
        if _has_enough_responses(remaining := _omit_sensor(linear_curves, sensor))
        and _solve_from_both(uncorrected, remaining).fits
    ]
    if len(contradicting) == 1:
        return True, (
            f"{contradicting[0]} contradicts the other channels: it may be delayed, loose, or mounted at a location "
            "that differs from the scene. Without this channel, the scene fits. Check its mounting and settings."
        )
    return False, (
        "The cause is unknown: it is not the sign, the unit or the delay of a single channel, two swapped channels, or "
        "the form of damping. Check the number of bodies, the driven body and the springs of the scene. "
        "The figure shows the frequencies with the largest residuals."
    )


def mass_scale_error(problem: Problem, x: Array) -> str:
    """Describe the mean factor of the fitted masses if it is so large that a unit must be wrong; "" otherwise."""
    masses = [k for k, parameter in enumerate(problem.parameters) if parameter.quantity == "masses"]
    if not masses:
        return ""
    factor = float(np.exp(np.mean((x - problem.start)[masses])))
    if 1.0 / _MAX_MASS_RATIO < factor < _MAX_MASS_RATIO:
        return ""
    # Masses that are too large by a factor result from motion read too small, or force read too large, by this factor.
    unit_errors = {1.0 / ratio: cause for ratio, cause in _SCALE_MISTAKES.items()} | _FORCE_MISTAKES
    nearest = min(unit_errors, key=lambda ratio: abs(np.log(factor / ratio)))
    is_near = abs(np.log(factor / nearest)) < np.log(_UNIT_TOLERANCE)
    unit_error = f" ({unit_errors[nearest]})" if is_near else ""
    return (
        f"The curves fit with {factor:.4g} times the masses of the scene{unit_error}: the unit of force or motion "
        "differs from that in the recording, or the masses of the scene are wrong. Correct the unit or the masses."
    )


@dataclass(frozen=True)
class _Explanation:
    """A supposed mistake whose correction was tried."""

    refit: _Refit
    text: str
    is_known_mistake: bool = True

    @property
    def square(self) -> float:
        """Sum of squares of the residuals (-2 ln likelihood), plus `margin` if this is not a common mistake."""
        return self.refit.square + (0.0 if self.is_known_mistake else self.margin)

    @property
    def margin(self) -> float:
        """Difference of the sums of squares up to which another explanation is nearly as likely."""
        return _CLOSE_SQUARE * max(self.refit.mean_square, 1.0)


_Explanations = Iterator[_Explanation]


class _Mistake(NamedTuple):
    """A mistake in a channel, which multiplies its reading by ``factor (j omega)^derivatives``."""

    factor: float
    derivatives: int
    text: str  # text with a field for the name of the channel

    def gain(self, frequency: Array) -> ComplexArray:
        """Return the ratio of the reading to the true value, shape (n,)."""
        return np.asarray(self.factor * (2j * np.pi * frequency) ** self.derivatives)


def _most_likely(explanations: list[_Explanation]) -> tuple[bool, str]:
    """Return whether the most likely explanation is a known mistake, and a text with the most likely explanations."""
    best, *others = sorted(explanations, key=attrgetter("square"))
    text = f"{best.text}. If this is corrected, the scene fits."
    limit = best.square + best.margin
    close = [other.text for other in others if other.is_known_mistake and other.square < limit]
    if close:
        text += f" Nearly as likely: {close[0]}."
    return best.is_known_mistake, text


def _fit_best(starts: list[_Explanation]) -> _Explanations:
    """Fit the supposed mistakes with the smallest initial cost."""
    for start in sorted(starts, key=lambda start: start.refit.cost)[:_MAX_FITTED_MISTAKES]:
        yield replace(start, refit=start.refit.solved())


def _try_swaps(uncorrected: _Refit, linear_curves: list[Curves]) -> _Explanations:
    names = dict.fromkeys(sensor.name for curves in linear_curves for sensor in curves.sensors)
    starts = []
    for pair in islice(combinations(names, 2), _MAX_PAIRS):
        partner = dict(zip(pair, reversed(pair), strict=True))
        swapped = []
        for curves in linear_curves:
            sensors = [sensor.name for sensor in curves.sensors]
            body = dict(zip(sensors, curves.bodies, strict=True))
            has_both = body.keys() >= partner.keys()
            swapped_names = [partner.get(name, name) if has_both else name for name in sensors]
            swapped.append(replace(curves, bodies=tuple(body[name] for name in swapped_names)))
        starts.append(_Explanation(_start(uncorrected, swapped), f"{pair[0]} and {pair[1]} are swapped"))
    return _fit_best(starts)


def _try_channels(uncorrected: _Refit, linear_curves: list[Curves]) -> _Explanations:
    """Yield the common mistakes in each sensor, and its best-fitting factor."""
    # The structure starts from its fit to the other responses if there are enough, otherwise from its modes.
    references = dict.fromkeys(curves.reference_sensor for curves in linear_curves)
    force_sensors = {curves.reference_sensor for curves in linear_curves if curves.reference == "force"}
    for sensor in (*references, *_sensors(linear_curves)):
        remaining = [] if sensor in references else _omit_sensor(linear_curves, sensor)
        others = _solve_from_both(uncorrected, remaining) if _has_enough_responses(remaining) else None
        starts = []
        for mistake in _mistakes(sensor in force_sensors):
            corrected = _corrected(linear_curves, sensor, mistake)
            start = others.with_curves(corrected) if others else _start(uncorrected, corrected)
            starts.append((start.cost, mistake.factor, _Explanation(start, mistake.text.format(sensor.name))))
        yield from _fit_best([explanation for _, _, explanation in starts])
        _, factor, nearest = min(starts, key=lambda start: start[0])
        yield _free_factor(nearest.refit, linear_curves, sensor, factor)


def _mistakes(is_force: bool) -> list[_Mistake]:
    """List the common mistakes in a channel."""
    factors = _SCALE_MISTAKES | (_FORCE_MISTAKES if is_force else {})
    return [
        _Mistake(-1.0, 0, "The sign of {} is reversed"),
        *(
            _Mistake(factor, 0, f"{{}} reads {factor:.4g} times what the scene predicts ({cause})")
            for factor, cause in factors.items()
        ),
        *(_Mistake(1.0, order, f"{{}}: {cause}") for order, cause in _DERIVATIVE_MISTAKES.items()),
    ]


def _corrected(linear_curves: list[Curves], sensor: Sensor, mistake: _Mistake) -> list[Curves]:
    """Return the curves with the readings of a sensor corrected for a mistake."""
    corrected = []
    for curves in linear_curves:
        gain = mistake.gain(curves.frequency)
        factors = np.array([1.0 / gain if other == sensor else np.ones_like(gain) for other in curves.sensors])
        corrected.append(_multiply(curves, factors * gain if curves.reference_sensor == sensor else factors))
    return corrected


def _free_factor(start: _Refit, linear_curves: list[Curves], sensor: Sensor, factor: float) -> _Explanation:
    """Fit the gain factor of a sensor, starting from `factor`, together with the structure."""
    freed_sensor = replace(sensor, tolerance=_FREE_TOLERANCE)
    freed = [
        replace(
            curves,
            sensors=tuple(freed_sensor if other == sensor else other for other in curves.sensors),
            reference_sensor=freed_sensor if curves.reference_sensor == sensor else curves.reference_sensor,
        )
        for curves in _corrected(linear_curves, sensor, _Mistake(factor, 0, ""))
    ]
    refit = start.with_curves(freed).solved()
    factor *= 1.0 + refit.problem.deviation(refit.x, freed_sensor)
    return _Explanation(refit, f"{sensor.name} reads {factor:.4g} times what the scene predicts{_NO_UNIT_ERROR}", False)


def _try_damping(uncorrected: _Refit, linear_curves: list[Curves]) -> _Explanations:
    """Try dashpots instead of modal damping, or the reverse, on a chain of masses and springs."""
    problem = uncorrected.problem
    structure = problem.initial_scene.structure
    if structure.masses is None or structure.springs is None:
        return
    modes = structural_model(problem.initial_scene).modes
    form: ModalDamping | Dashpots
    if isinstance(structure.damping, ModalDamping):
        per_stiffness = 2.0 * float(modes.damping_ratio.mean()) / modes.omega[0]
        form = Dashpots(dashpots=tuple(per_stiffness * k for k in structure.springs))
        text = "dashpots fit: give structure.damping: {dashpots: [...]}"
    else:
        form = ModalDamping(modal=tuple(float(max(ratio, 1e-4)) for ratio in modes.damping_ratio))
        text = "a ratio for each mode fits: give structure.damping: {modal: [...]}"
    model = problem.initial_scene.replace(structure=structure.replace(damping=form))
    # The values of the new form of damping are free too.
    free_keys = {parameter.key for parameter in problem.parameters}
    parameters = [
        parameter
        for parameter in free_parameters(model)
        if parameter.key in free_keys or parameter.key_path[:2] == ("structure", "damping")
    ]
    refit = _start_from_modes(Problem(model, parameters, linear_curves)).solved()
    yield _Explanation(refit, f"The damping is not of the scene's form; {text}")


def _try_delays(undelayed: _Refit, linear_curves: list[Curves]) -> _Explanations:
    """Yield the best-fitting delay of each sensor; `undelayed`: the fit without a correction."""
    for sensor in dict.fromkeys((*_sensors(linear_curves), *(curves.reference_sensor for curves in linear_curves))):
        initial_delay, trial = _estimate_delay(linear_curves, sensor), undelayed
        if initial_delay:
            advanced = [_compensate_delay(curves, sensor, initial_delay) for curves in linear_curves]
            trial = _start(undelayed, advanced).solved()
        if trial.square > undelayed.square:
            trial, initial_delay = undelayed, 0.0

        def square(delay: float, trial: _Refit = trial, sensor: Sensor = sensor) -> float:
            return trial.refit([_compensate_delay(curves, sensor, delay) for curves in linear_curves]).square

        delay = minimize_near(square, initial_delay)
        if abs(delay) > _MIN_DELAY:
            direction = "late" if delay > 0.0 else "early"
            text = f"{sensor.name} reads {format_number(abs(delay) * 1e6)} µs {direction} (delay in the table)"
            corrected = [_compensate_delay(curves, sensor, delay) for curves in linear_curves]
            yield _Explanation(trial.refit(corrected), text)


def minimize_near(square: Callable[[float], float], delay: float) -> float:
    """Return the delay with the smallest sum of squares; the search continues from the end of an interval."""
    for _ in range(_MAX_SEARCHES):
        center, bounds = delay, (delay - _SEARCH_RADIUS, delay + _SEARCH_RADIUS)
        best = scipy.optimize.minimize_scalar(square, bounds=bounds, options={"xatol": _DELAY_TOLERANCE})
        delay = float(best.x)
        if abs(delay - center) < 0.9 * _SEARCH_RADIUS:
            break
    return delay


def _sensors(linear_curves: list[Curves]) -> list[Sensor]:
    return list(dict.fromkeys(sensor for curves in linear_curves for sensor in curves.sensors))


def _multiply(curves: Curves, factor: float | ComplexArray | Array) -> Curves:
    """Multiply responses and their errors by factors, shape (responses, n) or broadcastable to it."""
    # The covariance `errors` is unchanged, because it affects intervals but not the fit.
    factors = np.broadcast_to(np.asarray(factor, dtype=complex), curves.value.shape)
    return replace(
        curves,
        value=curves.value * factors,
        whitening=curves.whitening / factors.T[:, None],
        line_limit=curves.line_limit * abs(factors),
        correlated_limit=curves.correlated_limit * abs(factors),
        correction=curves.correction * factors,
    )


def _estimate_delay(linear_curves: list[Curves], sensor: Sensor) -> float:
    """Return the delay of a sensor [s] that brings the phases closest to 0 or 180 degrees; 0 without responses."""
    # Away from resonances the phase is near 0 or 180 degrees; a delay adds a phase proportional to frequency.
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
    """Return the curves without the responses of a sensor; empty if no response of a curve would remain."""
    without_sensor = []
    for curves in linear_curves:
        rows = [k for k, channel_sensor in enumerate(curves.sensors) if channel_sensor != sensor]
        if not rows:
            return []
        root = np.linalg.inv(curves.whitening)
        covariance = (root @ root.conj().swapaxes(1, 2))[:, rows][:, :, rows]
        remaining: dict[str, Any] = {
            name: getattr(curves, name)[rows] for name in ("value", "line_limit", "correlated_limit", "correction")
        }
        for name in ("sensors", "bodies", "frfs"):
            remaining[name] = tuple(getattr(curves, name)[k] for k in rows)
        errors = curves.errors.select(rows)
        without_sensor.append(replace(curves, whitening=inverse_root(covariance), errors=errors, **remaining))
    return without_sensor


def _has_enough_responses(linear_curves: list[Curves]) -> bool:
    """Return whether the curves have enough responses to contradict a scene."""
    return bool(linear_curves) and min(len(curves.sensors) for curves in linear_curves) >= _MIN_RESPONSES


def list_omitted_points(curves: Curves, is_fitted: NDArray[np.bool_], uncovered: Mapping[int, str]) -> list[str]:
    """List the points that are not fitted, with reasons, such as why a motion has no computed orbit (`uncovered`)."""
    reasons: dict[str, list[str]] = {}
    for k in np.flatnonzero(~is_fitted).tolist():
        if k in uncovered:
            reason = f"{uncovered[k]}, which a fit cannot compute (contact: {{duration: ...}} avoids this)"
        else:
            reason = "the motion of the rig is irregular, or its type differs from that of the predicted motion"
        reasons.setdefault(reason, []).append(f"{curves.frequency[k]:.4g}")
    return [
        f"{curves.label}: omitted {', '.join(frequencies)} Hz, where {reason}."
        for reason, frequencies in reasons.items()
    ]


@dataclass(frozen=True)
class _Refit:
    """A fit of the structure to curves that are corrected for a supposed mistake."""

    problem: Problem
    x: Array  # unknowns

    @property
    def residual(self) -> Array:
        """Normalized residuals, then normalized deviations from the priors."""
        return self.problem.residual(self.x, self.problem.groups)

    @property
    def square(self) -> float:
        """Sum of squares of the residuals."""
        return float(np.sum(self.residual**2))

    @property
    def cost(self) -> float:
        """Sum of squared residuals with a model error, each limited; used to rank initial values."""
        residual = self.problem.residual(self.x, self.problem.groups, _MODEL_ERROR)
        return float(np.sum(np.minimum(residual**2, _MAX_SQUARE)))

    @property
    def mean_square(self) -> float:
        """Mean square of the residuals without the priors (reduced chi-square)."""
        return mean_square(self.problem, self.x, self.problem.groups)

    @property
    def fits(self) -> bool:
        """Whether stated uncertainties explain the residuals (chi-square test) and tolerances the errors of sensors."""
        problem, count = self.problem, self.residual.size - self.problem.size
        limit = _MAX_NOISE_VARIANCE * float(scipy.stats.chi2.isf(_NOISE_PROBABILITY, count)) / count
        return self.mean_square < limit and not problem.implausible_sensors(self.x)

    def with_curves(self, curves: list[Curves]) -> _Refit:
        """Return a refit of other curves that starts from these values of structure, sensors and clock."""
        parameters = {k: value for k, value in enumerate(self.problem.parameters) if value.key_path[0] != "dampers"}
        problem = Problem(self.problem.initial_scene, list(parameters.values()), curves)
        deviations = [self.problem.deviation(self.x, sensor) for sensor in problem.sensors]
        clock = self.x[self.x.size - (problem.clock_tolerance > 0.0) :]
        return _Refit(problem, np.concatenate([self.x[list(parameters)], deviations, clock]))

    def refit(self, curves: list[Curves]) -> _Refit:
        """Fit slightly different curves, starting from these values."""
        return self.with_curves(curves).solved((0.0,), max_evaluations=5)

    def solved(self, model_errors: tuple[float, ...] = _MODEL_ERRORS, max_evaluations: int = 15) -> _Refit:
        """Fit the structure from these initial values, with these model errors in turn."""
        problem, x = self.problem, self.x
        for model_error in model_errors:
            x = solve(problem, x, problem.groups, model_error, max_evaluations=max_evaluations)
        return _Refit(problem, x)


def _start(uncorrected: _Refit, curves: list[Curves]) -> _Refit:
    """Return initial values of the structure from the modes of curves, or from the uncorrected fit if better."""
    restarted = uncorrected.with_curves(curves)
    return min(_start_from_modes(restarted.problem), restarted, key=lambda start: start.cost)


def _solve_from_both(uncorrected: _Refit, curves: list[Curves]) -> _Refit:
    """Fit curves from two starts, their modes and the result of the uncorrected fit; return the better fit."""
    # The uncorrected fit may have the smaller initial cost and yet lead to a local minimum.
    restarted = uncorrected.with_curves(curves)
    fits = (start.solved() for start in (_start_from_modes(restarted.problem), restarted))
    return min(fits, key=attrgetter("square"))


def _start_from_modes(problem: Problem) -> _Refit:
    return _Refit(problem, initial_unknowns(problem, problem.groups))
