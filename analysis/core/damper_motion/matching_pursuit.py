"""Orthogonal matching pursuit of velocity jumps in a segment of one channel, the largest first.

Method: Y. C. Pati, R. Rezaiifar, P. S. Krishnaprasad, Asilomar 1993. The test statistic 2 ln L of the generalized
likelihood ratio L of a jump (S. M. Kay, *Detection Theory*, 1998) is computed at every sample. Each local maximum above
the detection threshold is a jump, which is fitted and subtracted. Overlapping jumps are fitted again jointly. The
search is then repeated in the residual.

The readings are differenced, so the response to a jump is short. A *window* is a range of these differences in
which one jump is fitted. A *step* and a *slope change* are changes of the acceleration and of its slope (see
`impact_model`). A *bed* is the filling of a damper, which moves as one mass.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.core.damper_motion.group_search import cost, search_group
from analysis.core.damper_motion.impact_model import ImpactModel, legendre_basis, with_order
from analysis.core.damper_motion.simultaneous_fit import (
    ITERATIONS,
    Deviations,
    Jump,
    add_jump,
    estimate_errors,
    fit_group,
    fit_within,
    jump_std,
    range_of,
)
from analysis.core.recordings.slices import interpolated
from rig.core.base.arrays import Array
from rig.core.numerics.runs import runs_of

# Detection threshold in standard deviations: about two false alarms in 1e9 samples of Gaussian noise.
DETECTION_SIGMAS = 6.0
# The detection limit exceeds the threshold by this number of standard deviations, because noise may reduce a jump.
DETECTION_MARGIN_SIGMAS = 3.0
# The model of a jump has an error of this fraction of the largest jump.
MODEL_ERROR = 3e-3
# Model error of a finite-duration contact, relative to the largest jump: the weight of the bed changes the pulse.
_CONTACT_MODEL_ERROR = 2e-2
# After the subtraction of a jump, this fraction of the jump remains while the sensor rings.
RESIDUAL_RATIO = 0.02
# An impact on a neighboring body causes a slightly curved change of the slope of the acceleration, which the fit can
# mistake for a jump. Jumps below this multiple of the velocity change due to the slope change within one sample are
# rejected.
_SLOPE_CHANGE_JUMP_RATIO = 1.0
# For finite-duration contact, this fraction of its duration replaces the sample interval in the rejection above.
_SLOPE_CHANGE_DURATION_RATIO = 1.0 / 6.0
# Maximum number of searches of the residual; each subtracts all jumps found in it, so few are needed and the limit only
# ends a cycle.
_MAX_ROUNDS = 12
# Maximum number of iterations that center a window on a jump; the limit only ends an oscillation between two windows.
_MAX_CENTERINGS = 4
# Minimum distance of two jumps in the search for single jumps [samples].
_MIN_DISTANCE_SAMPLES = 4
# Minimum distance at which two jumps may be resolved [samples].
MIN_RESOLVED_SAMPLES = 6
# Two jumps are resolved if a joint fit increases the standard uncertainty of the size of each jump by at most this
# factor, compared with a fit of this jump alone. Their times are then still well determined.
_MAX_RESOLVED_ERROR_RATIO = 1.1
# A segment is searched for groups of jumps if its residual exceeds this multiple of the detection limit.
_GROUP_SEARCH_RATIO = 3.0
# Maximum number of windows of a segment that is searched for groups of jumps; the computing time increases with the
# cube of this number.
_MAX_WINDOWS = 4
# Residual sum of squares that ends the search for groups, relative to that of a jump at the detection limit.
_SUFFICIENT_RATIO = 0.1
# A segment is unresolved if its residual exceeds this multiple of the detection limit ...
_UNRESOLVED_LIMIT_RATIO = 10.0
# ... and this fraction of its largest jump.
_UNRESOLVED_JUMP_RATIO = 0.5
# Additional polynomial orders for the smooth motion.
_HIGHER_ORDERS = (2, 4, 6)
# A higher order must reduce the residual variance by this factor, more than its additional coefficients do by chance.
_MIN_VARIANCE_REDUCTION = 2.0
# A filter of higher order is used if the noise of the jumps is below this fraction of that with the current filter.
NOISE_REDUCTION = 0.7
# Maximum number of jumps in a joint fit; the computing time increases with the cube of this number.
_MAX_JOINT_JUMPS = 5
# Offsets from which the time of a new jump is fitted [samples].
_START_OFFSETS = (0.0, -2.5, 2.5, -5.0, 5.0)
# Two fitted jumps that are closer than this may represent a single jump.
_SAME_JUMP_SAMPLES = 10.0
# Prior standard deviation of steps of the acceleration, relative to the 90th percentile of the smoothed acceleration.
_STEP_PRIOR_RATIO = 0.2
# The acceleration is smoothed over this number of samples for the prior standard deviation above.
_SMOOTHING_SAMPLES = 8
# The prior standard deviation of slope changes is that of steps, times 2 pi and this frequency [Hz].
_SLOPE_CHANGE_PRIOR_HZ = 100.0
# The weight of a bed causes steps of at most this multiple of their prior standard deviation.
_MAX_STEP_SIGMAS = 3.0
# Smallest detectable jump of a finite-duration contact, relative to the prior deviation of steps times its duration.
_MIN_JUMP_STEP_RATIO = 0.02
# The noise is assumed to be constant over this number of windows.
_NOISE_WINDOWS = 8
# Quantile of the jump filter's output from which the noise is estimated: the median is insensitive to impacts.
NOISE_QUANTILE = 0.5
# Number of samples in one matrix product: small enough for the cache, and for BLAS to use a single thread.
_BLOCK_SAMPLES = 256


class MatchingPursuit:
    """Search of one segment: its differenced residual, and the jumps that were subtracted.

    `models`: one model for each order of the smooth motion, from which the search chooses; `readings`: samples, or
    averages of samples; `is_valid`: whether each reading is valid; `noise_floor`: minimum standard deviation of a
    reading; `rate`: readings per second; `noise_quantile`: quantile of the filter output from which the noise is
    estimated.
    """

    def __init__(
        self,
        models: Sequence[ImpactModel],
        readings: Array,
        is_valid: NDArray[np.bool_],
        noise_floor: float,
        rate: float,
        noise_quantile: float = NOISE_QUANTILE,
    ) -> None:
        from scipy.ndimage import minimum_filter1d

        self.noise_floor, self.rate, self.noise_quantile = noise_floor, rate, noise_quantile
        if not is_valid.all():
            readings = interpolated(readings, is_valid)
        self.model = model = models[0]  # for the jump filters
        self.residual = np.diff(readings, model.difference_order)  # differenced readings minus all jumps
        # Prior standard deviations of steps [m/s²] and slope changes [m/s³].
        self.prior = self._prior_deviations(readings)
        # Distance of a window's sample 0 from its first difference.
        self.window_offset = model.difference_order - model.window_start
        invalid_in_window = np.convolve(~is_valid, np.ones(model.min_separation), mode="full")
        has_invalid = invalid_in_window[model.min_separation - 1 :] != 0
        # Whether the window that begins at a difference contains only valid readings.
        self.valid = ~has_invalid[: self.residual.size - model.window_length + 1]
        # Whether a jump in the middle of that window can be detected.
        # A jump in the last readings of a segment is outside all windows and appears in the nearest window as a jump at
        # another time.
        self.searchable = minimum_filter1d(self.valid, model.window_length, mode="constant", cval=False)
        self.jumps: list[Jump] = []
        self._cache: dict[object, Array] = {}
        smallest_noise = np.inf
        for model in models if self.valid.any() else ():
            level = self._noise_level(model, noise_quantile)
            noise = model.noise_gain * float(_quantile(level, 0.5))
            if noise < NOISE_REDUCTION * smallest_noise:
                smallest_noise, self.model = noise, model
                self._cache["noise", noise_quantile] = level
        self.window_model = self.model  # for the residual of whole windows

    def run(self) -> list[Jump]:
        """Detect the jumps; return them in chronological order, with standard uncertainties."""
        for _ in range(_MAX_ROUNDS):
            if not self._subtract_jumps():
                break
        for jump in sorted(self.jumps, key=lambda jump: abs(jump.velocity_jump)):
            # An earlier refinement may have replaced the jump with a new fit.
            current = min(self.jumps, key=lambda other: abs(other.time - jump.time))
            self._refine(current, self.noise(self.noise_quantile))
        lowest_order, smallest_variance = self.model.polynomial_order, np.inf
        for order in (lowest_order, *(lowest_order + increase for increase in _HIGHER_ORDERS)):
            variance = float(_quantile(self._residual_squares(order), 0.5)) / (self.model.window_length - order - 1)
            if _MIN_VARIANCE_REDUCTION * variance < smallest_variance:
                smallest_variance, self.window_model = variance, with_order(self.model, order)
        limit = self._detection_limit
        for first, last in self._unexplained_segments(_GROUP_SEARCH_RATIO * limit):
            self._search_jointly(first, last, limit)
        self.jumps.sort(key=lambda jump: jump.time)
        # With finite-duration contact, a bed that is pressed or released causes slope changes of the same duration.
        contact = self.model.contact_samples
        slope_change_time = max(1.0, _SLOPE_CHANGE_DURATION_RATIO * contact) / self.rate
        accepted = [
            jump
            for jump in self.jumps
            if self.searchable[self.window_of(jump)]
            and (contact or abs(jump.velocity_jump) > DETECTION_SIGMAS * jump.error)
            and abs(jump.velocity_jump) > _SLOPE_CHANGE_JUMP_RATIO * abs(jump.slope_change) * slope_change_time**2
        ]
        noise = self.noise()[[self.window_of(jump) for jump in accepted]]
        fitted = estimate_errors(self.residual, self.model, accepted, noise, self.prior)
        # The noise of earlier fits included other finite-duration impacts, so their threshold is applied here.
        return [jump for jump in fitted if not contact or abs(jump.velocity_jump) > DETECTION_SIGMAS * jump.error]

    def _subtract_jumps(self) -> bool:
        """Detect, fit and subtract the largest jump in each neighborhood; return whether a jump was detected."""
        from scipy.ndimage import maximum_filter1d

        model = self.model
        ratio, noise = self._likelihood_ratio()
        # Sum of squares that the subtracted jump of each window explains, in noise variances.
        explained, blocked = np.zeros(ratio.size), ~self.valid
        for jump in self.jumps:
            index = self.window_of(jump)
            explained[index] = max(explained[index], jump.explained)
            blocked[max(index - _MIN_DISTANCE_SAMPLES, 0) : index + _MIN_DISTANCE_SAMPLES + 1] = True
        candidate_ratio = np.where(blocked, 0.0, ratio)
        peaks = candidate_ratio > DETECTION_SIGMAS**2
        if not peaks.any():
            return False
        peaks &= candidate_ratio >= maximum_filter1d(candidate_ratio, 2 * model.min_separation + 1)
        if self.jumps:
            ringing = maximum_filter1d(explained, 2 * (model.min_separation + model.settling_samples) + 1)
            peaks &= candidate_ratio > RESIDUAL_RATIO**2 * ringing
        peak_windows = np.flatnonzero(peaks)
        added = False
        for first in peak_windows[np.argsort(-ratio[peak_windows], kind="stable")]:
            jump = self._fit_centered(int(first), float(noise[first]))
            if any(abs(jump.time - other.time) < _MIN_DISTANCE_SAMPLES for other in self.jumps):
                continue
            self._add(jump, -1.0)
            self.jumps.append(jump)
            self._refine(jump, noise, _START_OFFSETS)
            added = True
        return added

    def _add(self, jump: Jump, factor: float) -> None:
        """Add a multiple of a jump to the residual."""
        add_jump(self.residual, self.model, jump, factor)
        self._cache.clear()

    def window_of(self, jump: Jump) -> int:
        """Return the index of the first difference of the window of a jump."""
        return min(max(int(np.floor(jump.time)) - self.window_offset, 0), self.residual.size - self.model.window_length)

    def _refine(self, jump: Jump, noise: Array, starts: tuple[float, ...] = (0.0,)) -> None:
        """Fit a jump jointly with overlapping jumps, from the best of the times `starts`; remove a superfluous jump."""
        model = self.model
        group = [other for other in self.jumps if abs(other.time - jump.time) < model.min_separation]
        if len(group) == 1 and not self._step_exceeds_weight(jump):
            return
        group.sort(key=lambda other: abs(other.time - jump.time))
        group, others = group[:_MAX_JOINT_JUMPS], group[1:_MAX_JOINT_JUMPS]
        for other in group:
            self._add(other, 1.0)
        deviation = float(noise[self.window_of(jump)])
        prior = Deviations(deviation, *self.prior)
        # All fits are evaluated over the same differences, because their residuals are compared.
        shared_range = range_of(group, model, self.residual.size)
        fits = [
            fit_within(self.residual, model, [replace(jump, time=jump.time + start), *others], shared_range, prior)
            for start in starts
            if not start or all(abs(jump.time + start - other.time) >= _MIN_DISTANCE_SAMPLES for other in others)
        ]
        best_jumps, residual_square = min(fits, key=lambda fit: fit[1])
        if any(abs(other.time - jump.time) < _SAME_JUMP_SAMPLES for other in others):
            reduced, reduced_square = fit_within(self.residual, model, others, shared_range, prior)
            if reduced_square < residual_square + (DETECTION_SIGMAS * deviation) ** 2:
                best_jumps = reduced
        self._replace(group, fit_group(self.residual, model, best_jumps, prior)[0])

    def _replace(self, old: list[Jump], new: list[Jump]) -> None:
        """Replace `old` jumps, which were added back to the residual, by `new` jumps, which are subtracted."""
        self.jumps = [jump for jump in self.jumps if all(jump is not other for other in old)] + new
        for jump in new:
            self._add(jump, -1.0)

    @property
    def jump_noise(self) -> float:
        """Standard deviation of the estimated jump without an impact [m/s]: 95th percentile over the segment."""
        if "jump" not in self._cache:
            self._cache["jump"] = np.asarray(_quantile(self.noise(), 0.95) * self.model.noise_gain)
        return float(self._cache["jump"])

    @property
    def _detection_limit(self) -> float:
        return self.detection_limit(self.jump_noise, max((abs(jump.velocity_jump) for jump in self.jumps), default=0.0))

    def detection_limit(self, noise: float, largest: float) -> float:
        """Return the smallest jump that is reliably detected [m/s], except next to a larger jump."""
        duration = self.model.contact_samples / self.rate
        model_error = _CONTACT_MODEL_ERROR if duration else MODEL_ERROR
        sigmas = DETECTION_SIGMAS + DETECTION_MARGIN_SIGMAS
        return max(sigmas * noise, model_error * largest, _MIN_JUMP_STEP_RATIO * self.prior[0] * duration)

    def resolution(self) -> int:
        """Return the distance beyond which a second jump has a negligible effect on the error of a jump [samples]."""
        noise = Deviations(float(_quantile(self.noise(), 0.5)), *self.prior)
        max_error = _MAX_RESOLVED_ERROR_RATIO * jump_std(self.window_model, None, noise)
        distance = MIN_RESOLVED_SAMPLES
        max_distance = self.window_model.min_separation
        while distance < max_distance and jump_std(self.window_model, distance, noise) > max_error:
            distance += 1
        return distance

    def _windows(self) -> NDArray[np.int64]:
        """Return the index of the first difference of each window, with 50 % overlap."""
        first = np.flatnonzero(self.valid)
        return first[first % (self.model.window_length // 2) == 0]

    def _residual_squares(self, order: int) -> Array:
        """Return the residual sum of squares of each of `_windows` without the best polynomial of an order."""
        if order not in self._cache:
            if "readings" not in self._cache:
                windows = np.lib.stride_tricks.sliding_window_view(self.residual, self.model.window_length)
                self._cache["readings"] = self.model.readings(windows[self._windows()], self.model.polynomial_order)
            rows = self._cache["readings"]
            if order > self.model.polynomial_order:
                additional = legendre_basis(self.model.window_length, order)[:, self.model.polynomial_order + 1 :]
                rows = rows - (rows @ additional) @ additional.T
            self._cache[order] = np.einsum("ij,ij->i", rows, rows)
        return self._cache[order]

    def _unexplained_segments(self, jump_size: float) -> list[tuple[int, int]]:
        """Return the first and the last window of each segment whose residual exceeds that of a velocity jump [m/s]."""
        first = self._windows()
        squares, jump_norm = self._residual_squares(self.window_model.polynomial_order), self.window_model.jump_norm
        is_above = squares > (jump_size * jump_norm) ** 2
        return [(int(first[begin]), int(first[end - 1])) for begin, end in runs_of(is_above)]

    def unresolved(self) -> Array:
        """Return the limits of segments with a residual far above the detection limit [samples]; shape (n, 2)."""
        model, limits = self.window_model, list[tuple[float, float]]()
        limit, half_window = self._detection_limit, 0.5 * model.window_length
        for first, last in self._unexplained_segments(_UNRESOLVED_LIMIT_RATIO * limit):
            begin, end = first + self.window_offset - half_window, last + self.window_offset + half_window
            inside = [abs(jump.velocity_jump) for jump in self.jumps if begin <= jump.time < end]
            residual_norm = np.linalg.norm(model.readings(self.residual[first : last + model.window_length]))
            if residual_norm > _UNRESOLVED_JUMP_RATIO * max(inside, default=0.0) * model.jump_norm:
                limits.append((begin, end))
        limits += [
            (jump.time - half_window, jump.time + half_window)
            for jump in self.jumps
            if self._step_exceeds_weight(jump) and abs(jump.velocity_jump) > limit
        ]
        return np.array(limits).reshape(-1, 2)

    def _step_exceeds_weight(self, jump: Jump) -> bool:
        """Return whether a finite-duration impact changes the acceleration by more than the weight of a bed does."""
        # The contact may then have ended early, and the sign of the velocity jump is undetermined.
        return self.model.contact_samples > 0 and abs(jump.step) > _MAX_STEP_SIGMAS * self.prior[0]

    def _search_jointly(self, first: int, last: int, limit: float) -> None:
        """Search for all jumps between two windows jointly; keep the new set of jumps if its cost is lower."""
        model = self.window_model
        half = model.window_length // 2
        if last - first > _MAX_WINDOWS * model.window_length:
            return
        difference_range = max(first - half, 0), min(last + model.window_length + half, self.residual.size)
        time_range = (
            float(difference_range[0] + self.window_offset),
            float(difference_range[1] - model.window_length + self.window_offset),
        )
        old_jumps = [jump for jump in self.jumps if time_range[0] <= jump.time <= time_range[1]]
        for jump in old_jumps:
            self._add(jump, 1.0)
        sufficient = _SUFFICIENT_RATIO * (limit * model.jump_norm) ** 2
        # The tolerated residual is included in the noise; otherwise the residual would be fitted by steps and slope
        # changes.
        noise = max(float(self.noise()[first]), (sufficient / model.window_length) ** 0.5)

        def fit(jumps: list[Jump], iterations: int) -> tuple[list[Jump], float]:
            return fit_within(self.residual, model, jumps, difference_range, Deviations(noise, *self.prior), iterations)

        new_jumps, residual_square = search_group(fit, time_range, MIN_RESOLVED_SAMPLES, sufficient)
        if old_jumps:
            new_jumps = min(
                (new_jumps, residual_square), fit(old_jumps, ITERATIONS), key=lambda candidate: cost(*candidate)
            )[0]
        self._replace(old_jumps, new_jumps)

    def _prior_deviations(self, readings: Array) -> tuple[float, float]:
        """Estimate prior standard deviations of steps and slope changes from the acceleration, or from rounding."""
        integrations = self.model.difference_order - 2
        acceleration = np.diff(readings, integrations) * self.rate**integrations
        acceleration = acceleration - _quantile(acceleration, 0.5)
        acceleration = np.convolve(acceleration, np.full(_SMOOTHING_SAMPLES, 1.0 / _SMOOTHING_SAMPLES), "valid")
        # If the readings are constant, the acceleration is at most that which the rounding of the readings can hide.
        large_acceleration = float(_quantile(abs(acceleration), 0.9))
        step = _STEP_PRIOR_RATIO * max(large_acceleration, self.noise_floor * self.rate**integrations)
        return step, step * 2 * np.pi * _SLOPE_CHANGE_PRIOR_HZ

    def noise(self, noise_quantile: float = NOISE_QUANTILE) -> Array:
        """Estimate the standard deviation of a reading in each window from the jump filter output; (windows,)."""
        # The result is cached until the residual changes.
        key = "noise", noise_quantile
        if key not in self._cache:
            self._cache[key] = self._noise_level(self.model, noise_quantile)
        return self._cache[key]

    def _noise_level(self, model: ImpactModel, noise_quantile: float) -> Array:
        """Estimate the standard deviation of a reading, over a few windows each, from a quantile of filter outputs."""
        from scipy.ndimage import maximum_filter1d
        from scipy.special import ndtri

        magnitude = abs(np.correlate(self.residual, model.middle_filter, "valid"))
        typical = float(_quantile(magnitude[self.valid], noise_quantile))
        magnitude[~self.valid] = typical
        parts = max(1, magnitude.size // (_NOISE_WINDOWS * model.window_length))
        # The first parts have one sample more than the others.
        length, long_parts = divmod(magnitude.size, parts)
        lengths = np.full(parts, length) + (np.arange(parts) < long_parts)
        split = long_parts * (length + 1)
        rows = magnitude[:split].reshape(long_parts, length + 1), magnitude[split:].reshape(-1, length)
        levels = np.concatenate([_quantile(row, noise_quantile) for row in rows if row.size])
        local_level = np.maximum(maximum_filter1d(levels, 3), typical)
        return np.maximum(np.repeat(local_level, lengths) / ndtri(0.5 + 0.5 * noise_quantile), self.noise_floor)

    def _likelihood_ratio(self) -> tuple[Array, Array]:
        """Return the test statistic 2 ln L of a jump at every sample, and the noise.

        It is the sum of squares that the jump explains, divided by the noise variance.
        """
        # The filters of all sub-sample times span a space of few dimensions. The projections of a window on this space
        # bound the outputs of all filters, which are therefore computed only where a jump may be detected.
        noise = self.noise(self.noise_quantile)
        basis, weights = self.model.search_basis
        windows = np.lib.stride_tricks.sliding_window_view(self.residual, self.model.window_length)
        projected = np.empty((len(basis), len(windows)))
        for begin in range(0, len(windows), _BLOCK_SAMPLES):
            block_range = slice(begin, begin + _BLOCK_SAMPLES)
            np.matmul(basis, np.ascontiguousarray(windows[block_range].T), out=projected[:, block_range])
        bound = np.abs(weights).max(axis=0) @ np.abs(projected)
        ratio = np.zeros(noise.size)
        candidates = np.flatnonzero(bound > DETECTION_SIGMAS * noise)
        for block in np.array_split(candidates, 1 + candidates.size // _BLOCK_SAMPLES):
            ratio[block] = np.square(weights @ projected[:, block]).max(axis=0)
        return ratio / np.square(noise), noise

    def _fit_centered(self, first: int, noise: float) -> Jump:
        """Fit the best jump near a window, in a window that is centered on the jump."""
        last = self.residual.size - self.model.window_length
        for _ in range(_MAX_CENTERINGS):
            window = self.residual[first : first + self.model.window_length]
            instant, amplitudes, error, explained = self.model.fit_jump(window, noise)
            time = first + self.window_offset + instant
            centered = min(max(int(np.floor(time)) - self.window_offset, 0), last)
            if centered == first:
                break
            first = centered
        return Jump(time, amplitudes, error, explained)


def _quantile(rows: NDArray[np.floating[Any]], share: float) -> Array:
    """Compute the linear quantile along the last axis; for short rows, `numpy.quantile` takes ten times as long."""
    position = share * (rows.shape[-1] - 1)
    low = int(position)
    partitioned = np.partition(rows, low, axis=-1)
    value = partitioned[..., low]
    if position == low:
        return np.asarray(value)
    return np.asarray(value + (position - low) * (partitioned[..., low + 1 :].min(axis=-1) - value))
