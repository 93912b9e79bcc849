"""Delays of channels, from the phases of the modes that all responses have in common.

A delay t multiplies a response by ``exp(-i w t)`` and does not change its poles. The poles are therefore fitted to all
curves together. The modes of a lightly damped structure then have compliances with residues whose phase is 90 degrees
or -90 degrees. For each trial delay, a curve is corrected and fitted by least squares with these poles; other phases of
the residues are penalized like errors with the standard deviation that nonproportional damping causes [1]_. The
increase of the sum of squares from its minimum to zero delay is twice the logarithm of the likelihood ratio.

References
----------
.. [1] First-order perturbation: T. K. Hasselman, Modal coupling in lightly damped structures, AIAA Journal 14 (1976)
   1627-1628.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from analysis.core.modal_models.lscf import merge_charts, stabilization_diagram
from analysis.core.modal_models.order_selection import initial_model, select_model
from analysis.core.modal_models.pole_residue import Curves, real_rows, residual_terms, terms_of_modes
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import Response
from rig.core.results.text import format_quantity
from rig.core.results.uncertainty import COVERAGE_FACTOR

# Minimum number of points from which a delay is estimated.
_MIN_LINES = 6
# Of more points, this number of evenly selected points is evaluated.
_MAX_LINES = 400
# Poles are fitted to at most this number of curves.
_MAX_CURVES = 8
# Maximum number of initial poles, and of further candidates.
_MAX_CANDIDATES = 24
# A point is evaluated if its relative expanded uncertainty is at most this value.
_MAX_UNCERTAINTY = 0.5
# Relative model errors that select poles; a larger model error is tried if the misfit exceeds this multiple of its
# expectation.
_MODEL_ERRORS = (0.001, 0.01, 0.05)
_MAX_MISFIT_RATIO = 4.0
# Largest magnitude of a pole, relative to the highest frequency: rounding errors determine poles far above the band,
# which the residual terms represent.
_MAX_POLE_RATIO = 2.0
# Smallest standard deviation of a curve from its model, relative to the curve.
_MODEL_ERROR = 0.005
# Smallest standard deviation of the phases of residues [rad], due to modes outside the band and phases of sensors.
_PHASE_DEVIATION = 0.05
# Standard deviation of the phases of the residual terms [rad], due to the damping of modes outside the band.
_RESIDUAL_PHASE = 0.1
# Standard deviation of the damping coupling of two modes, relative to the largest coupling that dashpots can cause.
_MEAN_COUPLING = 0.3
# Residuals of neighboring lines are correlated: a curve has the weight of at most this number of independent values.
_MAX_VALUES = 40.0
# Largest trial delay, in periods of the highest frequency.
_MAX_PERIODS = 2.0
# Largest trial delay [s], if it is longer than `_MAX_PERIODS` periods.
_MAX_DELAY_S = 5e-3
# Spacing of the trial delays, in periods of the highest frequency.
_SPACING_PERIODS = 0.1
# The trial delays are refined around the best by this number of intervals.
_N_REFINED_INTERVALS = 20
# A delay is significant if the sum of squares without a delay, and at other delays, is larger by this value: a
# likelihood ratio of exp(10).
_MIN_REDUCTION = 20.0
# Another delay is a competing solution if it differs by more than this fraction of a period of the highest frequency,
# and by more than twice the expanded uncertainty.
_SEPARATION = 0.25
# Number of parts of the lines that must confirm the delay; each part omits every third line.
_N_PARTS = 3
# Two curves are late by the same time, or a curve is not late, within this fraction of the delay.
_MAX_OTHER_DELAY = 0.2
# Words by which the warning of a constant delay is recognized.
CONSTANT_DELAY = "the phases of the modes increase in proportion to frequency"


class _Delay(NamedTuple):
    """Delay of a curve [s]."""

    time: float
    expanded: float  # expanded uncertainty
    reduction: float  # reduction of the sum of squares compared with no delay
    margin: float  # smallest increase of the sum of squares at other delays

    @property
    def is_determined(self) -> bool:
        return self.margin > _MIN_REDUCTION

    @property
    def is_significant(self) -> bool:
        return min(self.margin, self.reduction) > _MIN_REDUCTION


def delayed_channels(curves: Sequence[Response], source: str) -> str:
    """Return a warning that names late or early channels; "" if there are none, or if the phases do not determine them.

    `curves`: responses to one reference, measured together; `source`: name of the reference. If all responses are late
    by the same time, the reference is early.
    """
    estimates = _estimate_delays(curves)
    known = {curve.response: delay for curve, delay in zip(curves, estimates, strict=True) if delay is not None}
    delayed = {name: delay for name, delay in known.items() if delay.is_significant}
    others = [delay.time for name, delay in known.items() if name not in delayed and delay.is_determined]
    if not delayed or (others and len(delayed) > 1):
        return ""
    name, delay = next(iter(delayed.items()))
    # A single late response differs from all others. A late reference makes all responses early by the same time.
    expected = [0.0] * len(others) or [delay.time] * len(delayed)
    times = others or [each.time for each in delayed.values()]
    tolerance = _MAX_OTHER_DELAY * abs(delay.time)
    if not np.allclose(times, expected, rtol=0.0, atol=tolerance) or not _are_confirmed(curves, delayed):
        return ""
    opposite = delay._replace(time=-delay.time)
    if others:
        late = f"{name} seems to be {_describe(delay)}"
    elif len(delayed) > 1:
        late = f"{source} seems to be {_describe(opposite)}"
    else:
        late = f"{name} seems to be {_describe(delay)}, or {source} {_sense(opposite)}"
    # A force without a name of its own has an article, the names of channels keep their letters.
    late = "The " + late.removeprefix("the ") if late.startswith("the ") else late
    return (
        f"{late}: {CONSTANT_DELAY}. Check cable, filter and time base of this channel, and give its delay in the table "
        "of `daq import`."
    )


def _are_confirmed(curves: Sequence[Response], delayed: dict[str, _Delay]) -> bool:
    """Return whether parts of the lines give the same delays, and corrected curves none; if not, poles are missing."""
    corrected = [
        curve.scaled(np.exp(2j * np.pi * curve.frequency * delayed[curve.response].time))
        if curve.response in delayed
        else curve
        for curve in curves
    ]
    lines = np.arange(curves[0].frequency.size)
    variants = [(corrected, 0.0)] + [
        ([curve.at(lines % _N_PARTS != part) for curve in curves], 1.0) for part in range(_N_PARTS)
    ]
    for variant, factor in variants:
        for curve, delay in zip(curves, _estimate_delays(variant), strict=True):
            if curve.response not in delayed:
                continue
            time = delayed[curve.response].time
            if delay is None or abs(delay.time - factor * time) > _MAX_OTHER_DELAY * abs(time):
                return False
    return True


def _describe(delay: _Delay) -> str:
    return f"{format_quantity(1e3 * abs(delay.time), 1e3 * delay.expanded, 'ms')} {_sense(delay)}"


def _sense(delay: _Delay) -> str:
    return "late" if delay.time > 0.0 else "early"


def _estimate_delays(curves: Sequence[Response]) -> list[_Delay | None]:
    """Return the delay of each curve; None if the curve has too few points or modes."""
    if not curves:
        return []
    receptances = [curve.to("displacement").sorted() for curve in curves]
    value = np.stack([curve.value for curve in receptances])
    magnitude = abs(value)
    valid = np.isfinite(value) & (magnitude > 0.0)
    # A failed channel determines no delay, and must not remove the lines of the other channels.
    is_valid = 2 * valid.sum(axis=1) > valid.shape[1]
    if not is_valid.all():
        found = iter(_estimate_delays([curve for curve, is_used in zip(curves, is_valid, strict=True) if is_used]))
        return [next(found) if is_used else None for is_used in is_valid]
    lines = np.flatnonzero(valid.all(axis=0))
    lines = lines[np.unique(np.linspace(0, lines.size - 1, min(lines.size, _MAX_LINES)).astype(int))]
    if lines.size < _MIN_LINES:
        return [None] * len(curves)
    frequency, value, magnitude = receptances[0].frequency[lines], value[:, lines], magnitude[:, lines]
    expanded = np.stack([np.nan_to_num(curve.bound()[lines]) for curve in receptances])
    error = np.where(expanded <= _MAX_UNCERTAINTY * magnitude, 0.5 * expanded, np.inf)
    precise = np.flatnonzero(np.isfinite(error).sum(axis=1) >= _MIN_LINES)
    if not precise.size:
        return [None] * len(curves)
    fitted = precise[np.unique(np.linspace(0, precise.size - 1, min(precise.size, _MAX_CURVES)).astype(int))]
    poles = _common_poles(frequency, value[fitted], error[fitted])
    return [_estimate_delay(frequency, *rows, poles) for rows in zip(value, error, strict=True)]


def _common_poles(frequency: Array, value: ComplexArray, error: Array) -> ComplexArray:
    """Return the poles of the modal model of curves with the smallest consistent model error [rad/s]."""
    magnitude = abs(value)
    equal_weight = np.ones(value.shape) / magnitude.max(axis=1, keepdims=True)
    equal_chart, models = stabilization_diagram(frequency, value, equal_weight), []
    for model_error in _MODEL_ERRORS:
        weight = 1.0 / np.hypot(error, model_error * magnitude)
        charts = [equal_chart, stabilization_diagram(frequency, value, weight)]
        limit = min(_MAX_CANDIDATES, (frequency.size - 2) // 2)
        stable, candidates = (poles[:limit] for poles in merge_charts(frequency, charts))
        curves = Curves(frequency, value, weight, has_model_error=True)
        model = select_model(curves, initial_model(curves, stable), candidates)
        # The misfits of different weights are compared as deviations relative to the curves.
        relative = np.divide(model.residual, weight * magnitude, out=np.zeros_like(value), where=weight > 0.0)
        models.append((float(np.sum(abs(relative) ** 2)), model.poles))
        if model.misfit < _MAX_MISFIT_RATIO * curves.degrees_of_freedom(model.poles.size):
            break
    poles = min(models, key=lambda model: model[0])[1]
    return poles[abs(poles) < _MAX_POLE_RATIO * 2.0 * np.pi * frequency.max()]


def _estimate_delay(frequency: Array, value: ComplexArray, error: Array, poles: ComplexArray) -> _Delay | None:
    """Return the delay of a curve with the smallest sum of squares."""
    used = np.isfinite(error)
    frequency, value, error = frequency[used], value[used], error[used]
    if used.sum() < _MIN_LINES or poles.size < 1:
        return None
    highest = frequency.max()
    limit = max(_MAX_PERIODS / highest, _MAX_DELAY_S)
    count = np.ceil(limit * highest / _SPACING_PERIODS)
    delays = np.arange(-count, count + 1) * _SPACING_PERIODS / highest
    fit = _DelayFit(frequency, value, error, poles)
    fit.prepare(delays)
    squares = fit.squares(delays)
    best = int(np.argmin(squares))
    fine = delays[best] + np.linspace(-1.0, 1.0, 2 * _N_REFINED_INTERVALS + 1) * _SPACING_PERIODS / highest
    near = fit.squares(fine)
    time, least = float(fine[np.argmin(near)]), float(near.min())
    curvature = (near[0] + near[-1] - 2.0 * near[_N_REFINED_INTERVALS]) / (_SPACING_PERIODS / highest) ** 2
    expanded = float(COVERAGE_FACTOR * np.sqrt(2.0 / max(curvature, 1e-300)))
    is_other = abs(delays - time) > max(_SEPARATION / highest, 2.0 * expanded)
    margin = squares[is_other].min(initial=np.inf) - least if is_other.any() else 0.0
    return _Delay(time, expanded, float(fit.squares(np.zeros(1))[0]) - least, float(margin))


class _DelayFit:
    """Least-squares fits of a curve, corrected by trial delays, with given poles and penalized phases of residues."""

    def __init__(self, frequency: Array, value: ComplexArray, error: Array, poles: ComplexArray) -> None:
        s = np.asarray(2j * np.pi * frequency, dtype=complex)
        self._s, self._value, self._poles = s, value, poles
        # A few lines do not determine the terms for modes above the band that are beyond the first.
        few = Curves(frequency, value[None], np.ones((1, value.size)))
        self._terms = np.concatenate(
            [terms_of_modes(s, poles, (1,)), np.stack(residual_terms(s)[: 1 + few.upper_terms])]
        )
        # Terms of modes above the band are real with even powers of s, and due to damping with odd powers.
        self._even_terms = np.arange(2 * poles.size + 1, len(self._terms), 2)
        self._odd_terms = self._even_terms[: few.upper_terms // 2] + 1
        self._weight = 1.0 / np.hypot(error, _MODEL_ERROR * abs(value))

    def prepare(self, delays: Array) -> None:
        """Scale the weights so that the least misfit is that of the independent values, and determine the penalties."""
        freedom = max(2 * self._value.size - len(self._terms), 1)
        self._weight = self._weight * np.sqrt(min(_MAX_VALUES / freedom, 1.0))
        columns, size = self._columns()
        targets = self._targets(delays)
        misfits = _misfits(columns, targets)
        best = int(np.argmin(misfits))
        fitted = np.linalg.lstsq(columns, targets[best])[0]
        unknown = fitted / size
        residue = np.hypot(unknown[: 2 * self._poles.size : 2], unknown[1 : 2 * self._poles.size : 2])
        # A mode contains other modes in quadrature, in proportion to their coupling by damping.
        mixed = _damping_coupling(self._poles) * np.sqrt(residue[:, None] * np.maximum(residue, residue[:, None]))
        # The force of a dashpot between a table and the structure rotates a residue by 2 ζ.
        phase = np.hypot(_PHASE_DEVIATION, -2.0 * self._poles.real / abs(self._poles))
        self._deviation = np.hypot(phase * residue, _MEAN_COUPLING * np.linalg.norm(mixed, axis=1))
        expected = min(freedom, _MAX_VALUES)
        reduction = np.sqrt(min(expected / max(float(misfits[best]), 1e-300), 1.0))
        self._weight = self._weight * reduction
        even = columns[:, self._even_terms] @ fitted[self._even_terms]
        self._residual_deviation = _RESIDUAL_PHASE * reduction * float(np.linalg.norm(even))

    def squares(self, delays: Array) -> Array:
        """Return the sum of squares of weighted residuals and penalties at each delay [s]."""
        columns, size = self._columns()
        modes = np.arange(self._poles.size)
        penalties = np.zeros((modes.size, size.size))
        # In a real mode, the real part of the residue is zero.
        penalties[modes, 2 * modes] = 1.0 / np.maximum(self._deviation * size[2 * modes], 1e-300)
        damped = np.eye(size.size)[self._odd_terms] / max(self._residual_deviation, 1e-300)
        return _misfits(np.concatenate([columns, penalties, damped]), self._targets(delays))

    def _columns(self) -> tuple[Array, Array]:
        """Return the weighted terms of the model as columns of unit length, and their lengths."""
        terms = self._terms * self._weight
        size = np.linalg.norm(terms, axis=1)
        return real_rows(terms / size[:, None]).T, np.asarray(size)

    def _targets(self, delays: Array) -> Array:
        return real_rows(self._value * self._weight * np.exp(np.outer(delays, self._s)))


def _damping_coupling(poles: ComplexArray) -> Array:
    """Return the largest share of each other mode in a mode due to nonproportional damping, shape (modes, modes)."""
    natural = abs(poles)
    widths = np.sqrt(np.outer(-2.0 * poles.real, -2.0 * poles.real))
    distance = abs(natural[:, None] ** 2 - natural**2)
    share = widths * natural[:, None] / np.maximum(distance, 1e-12 * natural**2)
    np.fill_diagonal(share, 0.0)
    return np.asarray(np.minimum(share, 1.0))


def _misfits(columns: Array, targets: Array) -> Array:
    """Return the smallest sum of squares of each target; the target of additional rows of the columns is zero."""
    basis = np.linalg.qr(columns)[0][: targets.shape[1]]
    return np.asarray(np.sum(targets**2, axis=1) - np.sum((targets @ basis) ** 2, axis=1))
