"""Selection of the order of a modal model: poles are added while they reduce the misfit more than noise could.

The *misfit* is the sum of squares of the residuals, each divided by its standard uncertainty.

References
----------
.. [1] G. Schwarz, Estimating the dimension of a model, Annals of Statistics 6 (1978) 461-464.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from analysis.core.modal_models.lscf import MAX_DAMPING
from analysis.core.modal_models.pole_residue import (
    MAX_EVALUATIONS,
    Curves,
    ModalModel,
    fit,
    misfits_with,
    misfits_without,
)
from rig.core.base.arrays import Array, ComplexArray

# Maximum number of modes inside the band; the time of a fit increases with its cube.
MAX_MODES = 12
# The residuals need at least this number of degrees of freedom; with fewer, a model fits any data.
_MIN_DEGREES = 8
# A pole must reduce the misfit by this multiple of the penalty term of Schwarz's criterion (BIC) [1]_.
_PENALTY_FACTOR = 2.0
# With a single reference, two poles of similar shapes are resolved if their distance is at least this value, in mean
# half-power widths. With several references, closer poles are distinguished by their shapes.
_MIN_DISTANCE_WIDTHS = 0.4
# The smallest distance of two resolved poles if a model error is assumed, or if curves state no uncertainty. Closer
# poles may represent an error, because two poles fit a peak of any shape. Tuned on a measured milling tool: at 0.4 its
# modes depended on the band.
_MIN_ERRONEOUS_DISTANCE_WIDTHS = 0.8
# Poles at any distance are resolved if the MAC of their shapes is at most this value: the responses then have different
# resonances. Two poles that are fitted to one peak have nearly the same shape. The peaks of a nonlinear structure,
# where the residual exceeds stated errors, may differ between responses; their poles require the distance.
_MAX_RESOLVED_MAC = 0.5
# Two poles are close if their distance is at most this value, in mean half-power widths. Close poles are accepted only
# if their local misfit is at noise level, because two close poles can fit the skewed peak of a nonlinear structure.
_CLOSE_POLE_WIDTHS = 4.0
# The local misfit of close poles is at noise level if it is at most this multiple of its expected value for noise.
_MAX_NOISE_RATIO = 4.0
# Distance of poles, in frequency resolutions, below which both may be fitted to one narrow, broadened peak.
_SAME_PEAK_RATIO = 1.5
# The poles of two fits are the same up to this distance, in half-widths.
_SAME_POLE_RATIO = 1e-3
# Number of candidates that are fitted at each step: those with the largest predicted improvement.
_FITTED_CANDIDATES = 4
# The fit of a candidate is completed only if its approximate fit has at least this fraction of the necessary reduction
# of the misfit. In 550 fits of simulated curves, the smallest fraction of an accepted pole was 0.96.
_MIN_APPROXIMATE_REDUCTION = 0.3
# Maximum number of evaluations of models for comparison; 4 to 25 gave the same modes for 116 sets of curves.
_APPROXIMATE_EVALUATIONS = 5


def half_width(poles: ComplexArray) -> Array:
    """Compute half of the half-power widths [Hz]."""
    return np.asarray(-poles.real / (2 * np.pi))


def have_same_poles(first: ModalModel, second: ModalModel) -> bool:
    """Return whether two models have the same poles, within a small fraction of their half-widths."""
    if first.poles.size != second.poles.size:
        return False
    return bool(np.all(abs(first.poles - second.poles) <= -_SAME_POLE_RATIO * first.poles.real))


def are_in_band(curves: Curves, poles: ComplexArray) -> NDArray[np.bool_]:
    """Return whether poles are inside the measured band."""
    frequency = poles.imag / (2 * np.pi)
    return np.asarray((frequency > curves.frequency[0]) & (frequency < curves.frequency[-1]))


def are_narrower_than_resolution(curves: Curves, poles: ComplexArray) -> NDArray[np.bool_]:
    """Return whether the peaks of poles are narrower than the resolution, so their widths are undetermined."""
    return np.asarray(2.0 * half_width(poles) < curves.resolution)


def initial_model(curves: Curves, initial: ComplexArray) -> ModalModel:
    """Fit a model with those poles of `initial` [rad/s] that are significant and not computational."""
    # Most insignificant poles are recognized after few evaluations; only the fits of the other poles are completed.
    approximate = _fit_without_computational_poles(curves, initial, _APPROXIMATE_EVALUATIONS)
    poles, _ = _significant_poles(curves, approximate)
    return _prune(curves, _fit_without_computational_poles(curves, poles, MAX_EVALUATIONS))


def select_model(
    curves: Curves, initial: ModalModel, candidates: ComplexArray, max_modes: int = MAX_MODES
) -> ModalModel:
    """Add all significant poles [1]_ to an initial model, at most `max_modes` inside the band.

    `candidates`: poles that may be added [rad/s].
    """
    current = initial
    # Candidates below and above the band, for out-of-band modes that the residual terms do not represent.
    low, high = curves.frequency[0], curves.frequency[-1]
    frequency = np.array([0.5 * low, 0.8 * low, 0.95 * low, 1.05 * high, 1.25 * high, 2.0 * high])
    outside = np.asarray(2 * np.pi * frequency * (-0.01 + 1j), dtype=complex)
    while are_in_band(curves, current.poles).sum() < max_modes:
        if curves.degrees_of_freedom(current.poles.size + 1) < _MIN_DEGREES:
            break
        all_candidates = np.concatenate([candidates, _poles_at_residual(curves, current), outside])
        larger = _with_best_added_pole(curves, current, all_candidates)
        if larger is None and not current.poles.size and max_modes > 1 and curves.degrees_of_freedom(2) >= _MIN_DEGREES:
            larger = _best_pair(curves, current, all_candidates)
        if larger is None:
            break
        current = larger
    return current if current is initial else _prune(curves, current)


def _fit_without_computational_poles(curves: Curves, poles: ComplexArray, max_evaluations: int) -> ModalModel:
    """Fit a model, and remove computational poles in steps: the least significant pole of each group of neighbors."""
    # Without this pole, the other poles of the group may be modes.
    model = fit(curves, poles, max_evaluations)
    while (rejected := computational_poles(curves, model)).size:
        misfits = misfits_without(curves, model.poles)
        groups = np.split(rejected, np.flatnonzero(np.diff(rejected) > 1) + 1)
        removed = [group[np.argmin(misfits[group])] for group in groups]
        model = fit(curves, np.delete(model.poles, removed), max_evaluations)
    return model


def _with_best_added_pole(curves: Curves, current: ModalModel, candidates: ComplexArray) -> ModalModel | None:
    """Return the best model with another pole that is significant and not computational; None without such a pole."""
    misfits = misfits_with(curves, current.poles, candidates)
    approximate: list[ModalModel] = []
    tried: list[complex] = []
    for index in np.argsort(misfits, kind="stable"):
        pole = candidates[index]
        if any(abs(pole - other) < 0.5 * min(-pole.real, -other.real) for other in tried):
            continue
        tried.append(pole)
        approximate.append(fit(curves, np.append(current.poles, pole), _APPROXIMATE_EVALUATIONS))
        if len(tried) == _FITTED_CANDIDATES:
            break
    # A pole may become significant only when its fit is completed, for example with five lines in each peak.
    for model in sorted(approximate, key=lambda model: model.misfit):
        necessary = _reduction_by_noise(curves, model, current.poles.size)
        if current.misfit - model.misfit < _MIN_APPROXIMATE_REDUCTION * necessary:
            continue
        larger = fit(curves, model.poles)
        if is_significant(curves, current, larger) and not computational_poles(curves, larger).size:
            return larger
    return None


def _best_pair(curves: Curves, empty: ModalModel, candidates: ComplexArray) -> ModalModel | None:
    """Return a model with two poles that are significant together; None if there is none or if all is noise."""
    # On the side of the peak of another mode, a single pole reduces the misfit too little to be significant.
    if empty.misfit <= _MAX_NOISE_RATIO * curves.degrees_of_freedom(0):
        return None
    single = fit(curves, candidates[[np.argmin(misfits_with(curves, empty.poles, candidates))]])
    pair = _with_best_added_pole(curves, single, np.concatenate([candidates, _poles_at_residual(curves, single)]))
    return pair if pair is not None and is_significant(curves, empty, pair) else None


def is_significant(curves: Curves, smaller: ModalModel, larger: ModalModel) -> bool:
    """Return whether the additional poles of the larger model reduce the misfit by more than noise does."""
    return smaller.misfit - larger.misfit > _reduction_by_noise(curves, larger, smaller.poles.size)


def better_model(curves: Curves, first: ModalModel, second: ModalModel) -> ModalModel:
    """Return the model with more poles if they are significant; of equal numbers, that with the smaller misfit."""
    smaller, larger = sorted((first, second), key=lambda model: model.poles.size)
    if smaller.poles.size == larger.poles.size:
        return min(first, second, key=lambda model: model.misfit)
    return larger if is_significant(curves, smaller, larger) else smaller


def _reduction_by_noise(curves: Curves, larger: ModalModel, n_poles: int) -> float:
    """Compute the largest reduction of the misfit by noise, from a model of `n_poles` poles to a larger model."""
    added_unknowns = curves.unknowns(larger.poles.size) - curves.unknowns(n_poles)
    scale = max(larger.misfit / curves.degrees_of_freedom(larger.poles.size), 1.0) * correlation_length(larger.residual)
    return float(_PENALTY_FACTOR * added_unknowns * np.log(curves.n_values) * scale)


def correlation_length(residual: ComplexArray) -> float:
    """Estimate the correlation length of the residual, in spectral lines; 1 for independent noise."""
    power = float(np.sum(abs(residual) ** 2))
    if power == 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, max(2, residual.shape[1] // 8)):
        correlation = float(np.sum((residual[:, lag:] * residual[:, :-lag].conj()).real)) / power
        if correlation < 0.1:
            break
        total += 2.0 * correlation
    return total


def computational_poles(curves: Curves, model: ModalModel) -> NDArray[np.intp]:
    """Return the indices of poles with a damping ratio above `MAX_DAMPING`, and of two poles fitted to one peak."""
    poles, width = model.poles, half_width(model.poles)
    is_inside = are_in_band(curves, poles)
    rejected = {int(i) for i in np.flatnonzero(is_inside & (-poles.real > MAX_DAMPING * abs(poles)))}
    order = [int(i) for i in np.argsort(poles.imag) if is_inside[i]]
    for low, high in pairwise(order):
        distance = (poles[high].imag - poles[low].imag) / (2 * np.pi)
        mean_width = width[low] + width[high]
        # The window broadens a narrow peak, but to less than twice the frequency resolution.
        is_same_peak = mean_width < 2.0 * curves.resolution and distance < _SAME_PEAK_RATIO * curves.resolution
        is_nonlinear = curves.are_errors_stated and curves.has_model_error
        is_exact = curves.are_errors_stated and not curves.has_model_error
        min_distance = _MIN_DISTANCE_WIDTHS if is_exact else _MIN_ERRONEOUS_DISTANCE_WIDTHS
        is_unresolved = (
            curves.references == 1
            and distance < min_distance * mean_width
            and (is_nonlinear or not _shape_mac(curves, model.residue[:, [low, high]]) <= _MAX_RESOLVED_MAC)
        )
        is_close = distance < _CLOSE_POLE_WIDTHS * mean_width
        if (
            is_same_peak
            or is_unresolved
            or (is_close and _local_misfit(curves, model, poles[[low, high]]) > _MAX_NOISE_RATIO)
        ):
            rejected |= {low, high}
    return np.array(sorted(rejected), dtype=np.intp)


def _shape_mac(curves: Curves, residue: ComplexArray) -> float:
    """Return the MAC of two shapes, shape (responses, 2), of responses that are divided by their largest magnitudes."""
    largest = np.maximum(abs(curves.value).max(axis=1), np.finfo(float).tiny)
    first, second = (residue / largest[:, None]).T
    return float(abs(np.vdot(first, second)) ** 2 / (np.vdot(first, first) * np.vdot(second, second)).real)


def _local_misfit(curves: Curves, model: ModalModel, poles: ComplexArray) -> float:
    """Compute the misfit around poles, relative to its expected value for noise."""
    bandwidth = 2.0 * half_width(poles)
    frequency = poles.imag / (2 * np.pi)
    is_near = (curves.frequency > np.min(frequency - 2 * bandwidth)) & (
        curves.frequency < np.max(frequency + 2 * bandwidth)
    )
    n_values = 2 * is_near.sum() * curves.value.shape[0]
    degrees_of_freedom = max(n_values - curves.unknowns(poles.size), 0.3 * n_values, 1.0)
    return float(np.sum(abs(model.residual[:, is_near]) ** 2) / degrees_of_freedom)


def _prune(curves: Curves, model: ModalModel) -> ModalModel:
    """Remove poles that are not significant."""
    while model.poles.size:
        poles, least_significant = _significant_poles(curves, model)
        if poles.size < model.poles.size:
            model = fit(curves, poles)
            continue
        smaller = fit(curves, np.delete(poles, least_significant))
        if is_significant(curves, smaller, model):
            return model
        model = smaller
    return model


def _significant_poles(curves: Curves, model: ModalModel) -> tuple[ComplexArray, int]:
    """Return the significant poles of a model, and the index of the least significant of them."""
    # The increase of the misfit without a pole is overestimated, because the other poles are not fitted again. A pole
    # that is not significant here is therefore not significant after a new fit either.
    poles, least_significant = model.poles, 0
    while poles.size:
        misfits = misfits_without(curves, poles)
        least_significant = int(np.argmin(misfits))
        if misfits[least_significant] - model.misfit > _reduction_by_noise(curves, model, poles.size - 1):
            break
        poles = np.delete(poles, least_significant)
    return poles, least_significant


def _poles_at_residual(curves: Curves, model: ModalModel) -> ComplexArray:
    """Return candidate poles of several widths at the three lines of largest residual [rad/s]."""
    frequency = curves.frequency
    power = np.sum(abs(model.residual) ** 2, axis=0)
    candidates = []
    for index in np.argsort(power)[::-1][:3]:
        spacing = frequency[min(index + 1, frequency.size - 1)] - frequency[max(index - 1, 0)]
        for half_width_hz in (0.5 * spacing, 2.0 * spacing, 0.003 * frequency[index], 0.02 * frequency[index]):
            candidates.append(2 * np.pi * (-half_width_hz + 1j * frequency[index]))
    return np.array(candidates, dtype=complex)
