"""Orthogonal matching pursuit of velocity jumps in a stretch of one channel, the largest first.

Method: Y. C. Pati, R. Rezaiifar, P. S. Krishnaprasad, Asilomar 1993. Where the likelihood ratio of a jump (S. M. Kay,
*Detection Theory*, 1998) is largest and exceeds the detection threshold, the jump is fitted and subtracted; those that
overlap are fitted again jointly; then the search is repeated in the residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.group_search import Stretch, cost
from analysis.damper_motion.impact_model import SHIFT, ImpactModel, legendre_basis
from analysis.damper_motion.joint_fit import Jump, Noise, add, fit_group, jump_error, with_errors
from rig.numerics.runs import runs_of

Array = NDArray[np.float64]

# A jump is detected where it exceeds so many standard deviations: one false alarm in 1e9 samples of Gaussian noise.
DETECTION_SIGMAS = 6.0
# Noise may reduce an impact by so many standard deviations.
DETECTION_MARGIN_SIGMAS = 3.0
# Share of the largest jump that the channel's model does not explain; where contact has a duration, the bed's weight
# changes its pulse.
MODEL_ERROR = 3e-3
_CONTACT_MODEL_ERROR = 2e-2
# Share of a jump that remains while it rings, after it was subtracted.
RESIDUAL_SHARE = 0.02
# An impact on a neighbour is a kink of the acceleration, slightly bent. That looks like a jump of at most this share of
# the velocity that the kink causes within a sample, or within a share of a landing's duration.
_KINK_SHARE = 1.0
_CONTACT_SHARE = 1.0 / 6.0
# Rounds of the search, and of centring a window on a jump.
_MAX_ROUNDS = 12
_CENTRINGS = 4
# Jumps nearer than this count as one; from the second distance on they may be resolved, samples.
_MIN_DISTANCE = 4
MIN_RESOLVED = 6
# Two jumps are resolved where the other one adds no more than this to the standard deviation.
_RESOLVED_ERROR = 1.1
# A residual of so many detection limits is searched again for groups, over at most so many windows, until it is below a
# share of the limit. What still exceeds this and a share of the largest jump there is unresolved.
_GROUP_LIMITS = 3.0
_MAX_WINDOWS = 4
_SUFFICIENT_SHARE = 0.1
_UNRESOLVED_LIMITS = 10.0
_UNRESOLVED_SHARE = 0.5
# A polynomial of a higher order (up to so much) is compared with where it halves the remaining squares.
_HIGHER_ORDERS = (2, 4, 6)
_ORDER_REDUCTION = 2.0
# A filter of higher order is used where it reduces the noise of a jump to this share.
NOISE_REDUCTION = 0.7
# Jumps fitted jointly after each detection, starts of the new one, and the distance below which one may be spurious.
_MAX_JOINT = 5
_STARTS = (0.0, -2.5, 2.5, -5.0, 5.0)
_SPURIOUS_DISTANCE = 10.0
# Prior of steps: share of the 90th percentile of the acceleration, smoothed over some samples. Prior of kinks: they
# return a step at this frequency, Hz.
_STEP_PRIOR = 0.2
_SMOOTHING_SAMPLES = 8
_KINK_PRIOR_HZ = 100.0
# No bed's weight causes a step of more than so many times its prior.
_MAX_STEP = 3.0
# A landing slower than this share of the velocity that such a step causes during its contact is not detected.
_SLOW_LANDING = 0.02
# The noise is constant over so many windows; it is estimated from the calmest share of them.
_NOISE_WINDOWS = 8
CALM_SHARE = 0.5
# Places in one matrix product: so small a product stays in the cache, and BLAS starts no threads for it.
_PLACES_AT_ONCE = 256


class MatchingPursuit:
    """Search of one stretch: its residual differences, and the jumps that were subtracted.

    Parameters
    ----------
    models : sequence of ImpactModel
        For each order of the smooth motion; the search chooses one.
    samples, good : ndarray
        Readings, and where they are valid.
    noise_floor : float
        Least standard deviation of a reading.
    calm_share : float
        Share of the windows from which the noise of the search is estimated.
    """

    def __init__(
        self,
        models: Sequence[ImpactModel],
        samples: Array,
        good: NDArray[np.bool_],
        noise_floor: float,
        rate: float,
        calm_share: float = CALM_SHARE,
    ) -> None:
        from scipy.ndimage import minimum_filter1d

        self.floor, self.rate, self.calm_share = noise_floor, rate, calm_share
        if not good.all():
            samples = np.interp(np.arange(samples.size), np.flatnonzero(good), samples[good])
        self.model = model = models[0]
        self.residual = np.diff(samples, model.difference)
        self.usual = self._usual_sizes(samples)
        # Difference of a window's sample 0 from its first one.
        self.zero = model.difference - model.window_start
        lost = np.convolve(~good, np.ones(model.reach), mode="full")[model.reach - 1 :]
        self.open = (lost == 0)[: self.residual.size - model.window + 1]
        # A jump beyond the windows, in the last samples of a stretch, looks like another one in the nearest of them.
        self.searchable = minimum_filter1d(self.open, model.window, mode="constant", cval=False)
        self.jumps: list[Jump] = []
        self._stored: dict[object, Array] = {}
        if self.open.any():
            self._choose_order(models)

    def _choose_order(self, models: Sequence[ImpactModel]) -> None:
        quietest = np.inf
        for model in models:
            noise = model.gain * float(np.median(self._noise_level(model, self.calm_share)))
            if noise < NOISE_REDUCTION * quietest:
                quietest, self.model = noise, model
        # With what all that is read is compared: the smooth motion may bend where jumps alone do not show it.
        self.whole = self.model

    def run(self) -> list[Jump]:
        """Detect the jumps; return them in their order, with errors."""
        for _ in range(_MAX_ROUNDS):
            if not self._subtract_largest():
                break
        for jump in sorted(self.jumps, key=lambda jump: abs(jump.sizes[0])):
            nearest = min(self.jumps, key=lambda other: abs(other.place - jump.place))
            self._fit_again(nearest, self.noise(self.calm_share))
        self._choose_whole_order()
        limit = self._limit
        for first, last in self._unexplained(_GROUP_LIMITS * limit):
            self._search_group(first, last, limit)
        self.jumps.sort(key=lambda jump: jump.place)
        # Where contact has a duration, so do kinks: a bed is pressed, or released.
        contact = self.model.contact_samples
        within = max(1.0, _CONTACT_SHARE * contact) / self.rate
        real = [
            jump
            for jump in self.jumps
            if self.searchable[self.window_of(jump)]
            and (contact or abs(jump.sizes[0]) > DETECTION_SIGMAS * jump.error)
            and abs(jump.sizes[0]) > _KINK_SHARE * abs(jump.sizes[2]) * within**2
        ]
        noise = self.noise()[[self.window_of(jump) for jump in real]]
        resolved = with_errors(self.residual, self.model, real, noise, self.usual)
        # When landings of finite duration were fitted first, others were still part of the noise.
        return [
            jump for jump in resolved if not contact or abs(jump.sizes[0]) > DETECTION_SIGMAS * jump.error
        ]

    def _subtract_largest(self) -> bool:
        """Detect the largest jump within each reach, fit and subtract it; whether there was any."""
        from scipy.ndimage import maximum_filter1d

        model = self.model
        ratio, noise = self._likelihood_ratio()
        explained, near = np.zeros(ratio.size), ~self.open
        for jump in self.jumps:
            at = self.window_of(jump)
            explained[at] = max(explained[at], jump.explained)
            near[max(at - _MIN_DISTANCE, 0) : at + _MIN_DISTANCE + 1] = True
        free = np.where(near, 0.0, ratio)
        peaks = free > DETECTION_SIGMAS**2
        if not peaks.any():
            return False
        peaks &= free >= maximum_filter1d(free, 2 * model.reach + 1)
        if self.jumps:
            rings = maximum_filter1d(explained, 2 * (model.reach + model.ring) + 1)
            peaks &= free > RESIDUAL_SHARE**2 * rings
        places = np.flatnonzero(peaks)
        for first in places[np.argsort(-ratio[places], kind="stable")]:
            jump = self._centred(int(first), float(noise[first]))
            if any(abs(jump.place - other.place) < _MIN_DISTANCE for other in self.jumps):
                continue
            self._add(jump, -1.0)
            self.jumps.append(jump)
            self._fit_again(jump, noise, _STARTS)
        return bool(places.size)

    def _add(self, jump: Jump, factor: float) -> None:
        """Add a multiple of a jump to the residual."""
        add(self.residual, self.model, jump, factor)
        self._stored.clear()

    def window_of(self, jump: Jump) -> int:
        """First difference of the window of a jump."""
        return min(max(int(np.floor(jump.place)) - self.zero, 0), self.residual.size - self.model.window)

    def _fit_again(self, jump: Jump, noise: Array, starts: tuple[float, ...] = (0.0,)) -> None:
        """Fit a jump jointly with those that it overlaps, from several starts.

        It is dropped where the others explain the readings as well without it.
        """
        model = self.model
        group = [other for other in self.jumps if abs(other.place - jump.place) < model.reach]
        if len(group) == 1 and not self._too_large_step(jump):
            return
        group.sort(key=lambda other: abs(other.place - jump.place))
        group, others = group[:_MAX_JOINT], group[1:_MAX_JOINT]
        for other in group:
            self._add(other, 1.0)
        deviation = float(noise[self.window_of(jump)])
        places = [jump.place + start for start in starts]
        tries = [
            fit_group(self.residual, model, [replace(jump, place=place), *others], self._prior(deviation))
            for place in places
            if place == jump.place or all(abs(place - other.place) >= _MIN_DISTANCE for other in others)
        ]
        best, remaining = min(tries, key=lambda fit: fit[1])
        if any(abs(other.place - jump.place) < _SPURIOUS_DISTANCE for other in others):
            without, more = fit_group(self.residual, model, others, self._prior(deviation))
            if more < remaining + (DETECTION_SIGMAS * deviation) ** 2:
                best = without
        self._replace(group, best)

    def _replace(self, old: list[Jump], new: list[Jump]) -> None:
        """Replace jumps that are in the residual again."""
        self.jumps = [jump for jump in self.jumps if all(jump is not other for other in old)] + new
        for jump in new:
            self._add(jump, -1.0)

    def _prior(self, readings: float) -> Noise:
        return Noise(readings, *self.usual)

    @property
    def jump_noise(self) -> float:
        """Standard deviation of a jump's estimate where there is none, m/s; 95th percentile along the stretch."""
        if "jump" not in self._stored:
            self._stored["jump"] = np.asarray(_quantile(self.noise(), 0.95) * self.model.gain)
        return float(self._stored["jump"])

    @property
    def _limit(self) -> float:
        return self.detection_limit(
            self.jump_noise, max((abs(jump.sizes[0]) for jump in self.jumps), default=0.0)
        )

    def detection_limit(self, noise: float, largest: float) -> float:
        """Smallest jump that is not missed, m/s, except next to a larger one.

        Limited by noise and by the model's errors; where contact has a duration, by the motion's usual steps as well.
        """
        duration = self.model.contact_samples / self.rate
        share = _CONTACT_MODEL_ERROR if duration else MODEL_ERROR
        sigmas = DETECTION_SIGMAS + DETECTION_MARGIN_SIGMAS
        return max(sigmas * noise, share * largest, _SLOW_LANDING * self.usual[0] * duration)

    def resolution(self) -> int:
        """Distance from which on another jump adds little to the error of a jump, samples."""
        noise = self._prior(float(np.median(self.noise())))
        most = _RESOLVED_ERROR * jump_error(self.whole, None, noise)
        distance = MIN_RESOLVED
        while distance < self.whole.reach and jump_error(self.whole, distance, noise) > most:
            distance += 1
        return distance

    def _choose_whole_order(self) -> None:
        """Choose the order of the polynomial that the smooth motion between jumps follows."""
        base = self.model.order
        least = np.inf
        for order in (base, *(base + more for more in _HIGHER_ORDERS)):
            degrees = self.model.window - order - 1
            remaining = float(np.median(self._remaining(order))) / degrees
            if _ORDER_REDUCTION * remaining < least:
                least, self.whole = remaining, self.model.with_order(order)

    def _windows(self) -> NDArray[np.int64]:
        """First differences of windows that half overlap."""
        first = np.flatnonzero(self.open)
        return first[first % (self.model.window // 2) == 0]

    def _remaining(self, order: int) -> Array:
        """Squares that remain of each of `_windows` beside a polynomial."""
        if order not in self._stored:
            if "readings" not in self._stored:
                windows = np.lib.stride_tricks.sliding_window_view(self.residual, self.model.window)
                self._stored["readings"] = self.model.readings(windows[self._windows()], self.model.order)
            rows = self._stored["readings"]
            if order > self.model.order:
                more = legendre_basis(self.model.window, order)[:, self.model.order + 1 :]
                rows = rows - (rows @ more) @ more.T
            self._stored[order] = np.einsum("ij,ij->i", rows, rows)
        return self._stored[order]

    def _unexplained(self, jump: float) -> list[tuple[int, int]]:
        """First and last window of each stretch with a residual larger than that of a jump, m/s."""
        first = self._windows()
        large = self._remaining(self.whole.order) > (jump * self.whole.template_norm) ** 2
        return [(int(first[begin]), int(first[end - 1])) for begin, end in runs_of(large)]

    def unresolved(self) -> Array:
        """Between which places a residual far above the detection limit remains, samples; shape (n, 2)."""
        model, out = self.whole, []
        limit = self._limit
        for first, last in self._unexplained(_UNRESOLVED_LIMITS * limit):
            ends = first + self.zero - model.window / 2, last + self.zero + model.window / 2
            largest = max(
                (abs(jump.sizes[0]) for jump in self.jumps if ends[0] <= jump.place < ends[1]), default=0.0
            )
            remaining = np.linalg.norm(model.readings(self.residual[first : last + model.window]))
            if remaining > _UNRESOLVED_SHARE * largest * model.template_norm:
                out.append(ends)
        half = 0.5 * model.window
        out += [
            (jump.place - half, jump.place + half)
            for jump in self.jumps
            if self._too_large_step(jump) and abs(jump.sizes[0]) > limit
        ]
        return np.array(out).reshape(-1, 2)

    def _too_large_step(self, jump: Jump) -> bool:
        """Whether a landing of finite duration has a step that no bed's weight causes; it may have ended early.

        Its jump may then have either sign.
        """
        return self.model.contact_samples > 0 and abs(jump.sizes[1]) > _MAX_STEP * self.usual[0]

    def _search_group(self, first: int, last: int, limit: float) -> None:
        """Search between two windows for all jumps jointly; keep what explains more, old or new."""
        model = self.whole
        half = model.window // 2
        if last - first > _MAX_WINDOWS * model.window:
            return
        within = max(first - half, 0), min(last + model.window + half, self.residual.size)
        places = float(within[0] + self.zero), float(within[1] - model.window + self.zero)
        old = [jump for jump in self.jumps if places[0] <= jump.place <= places[1]]
        for jump in old:
            self._add(jump, 1.0)
        sufficient = _SUFFICIENT_SHARE * (limit * model.template_norm) ** 2
        # What may remain counts as noise; otherwise steps and kinks explain what is far above the noise.
        noise = max(float(self.noise()[first]), (sufficient / model.window) ** 0.5)
        stretch = Stretch(self.residual, model, within, self._prior(noise))
        new, remaining = stretch.search(places, MIN_RESOLVED, sufficient)
        if old:
            new = min((new, remaining), stretch.fit(old), key=lambda fit: cost(*fit))[0]
        self._replace(old, new)

    def _usual_sizes(self, samples: Array) -> tuple[float, float]:
        """Give standard deviations of steps and kinks: a share of the motion's own acceleration, or of its rounding."""
        order = self.model.difference - 2
        motion = np.diff(samples, order) * self.rate**order
        motion = motion - np.median(motion)
        motion = np.convolve(motion, np.full(_SMOOTHING_SAMPLES, 1.0 / _SMOOTHING_SAMPLES), "valid")
        # A reading that does not change moves by no more than its rounding.
        large = float(_quantile(abs(motion), 0.9))
        step = _STEP_PRIOR * max(large, self.floor * self.rate**order)
        return step, step * 2 * np.pi * _KINK_PRIOR_HZ

    def noise(self, calm_share: float = CALM_SHARE) -> Array:
        """Estimate the standard deviation of a reading at every place, through the jump's filter; shape (places,).

        Stored until the residual changes.
        """
        key = "noise", calm_share
        if key not in self._stored:
            self._stored[key] = self._noise_level(self.model, calm_share)
        return self._stored[key]

    def _noise_level(self, model: ImpactModel, calm_share: float) -> Array:
        """From the quantile of the filter's outputs that impacts do not reach, in some windows at a time."""
        from scipy.ndimage import maximum_filter1d
        from scipy.special import ndtri

        middle = model.filters[(2 * SHIFT + 1) * model.instants // 2, 2]
        size = abs(np.correlate(self.residual, middle, "valid"))
        typical = float(_quantile(size[self.open], calm_share))
        size[~self.open] = typical
        parts = max(1, size.size // (_NOISE_WINDOWS * model.window))
        # The first parts have a place more than the others.
        length, longer = divmod(size.size, parts)
        lengths = np.full(parts, length) + (np.arange(parts) < longer)
        split = longer * (length + 1)
        rows = size[:split].reshape(longer, length + 1), size[split:].reshape(-1, length)
        levels = np.concatenate([_quantile(row, calm_share) for row in rows if row.size])
        steady = np.maximum(maximum_filter1d(levels, 3), typical)
        return np.maximum(np.repeat(steady, lengths) / ndtri(0.5 + 0.5 * calm_share), self.floor)

    def _likelihood_ratio(self) -> tuple[Array, Array]:
        """Largest squared jump at every place, in variances (GLRT), and the noise.

        The filters of all instants lie in a space of few dimensions. The projections of a window on it bound the
        outputs of all filters, so that these are computed only where a jump may be detected.
        """
        noise = self.noise(self.calm_share)
        basis, weights = self.model.scan_space
        windows = np.lib.stride_tricks.sliding_window_view(self.residual, self.model.window)
        projected = np.empty((len(basis), len(windows)))
        for begin in range(0, len(windows), _PLACES_AT_ONCE):
            part = slice(begin, begin + _PLACES_AT_ONCE)
            np.matmul(basis, np.ascontiguousarray(windows[part].T), out=projected[:, part])
        bound = np.abs(weights).max(axis=0) @ np.abs(projected)
        ratio = np.zeros(noise.size)
        places = np.flatnonzero(bound > DETECTION_SIGMAS * noise)
        for some in np.array_split(places, 1 + places.size // _PLACES_AT_ONCE):
            ratio[some] = np.square(weights @ projected[:, some]).max(axis=0)
        return ratio / np.square(noise), noise

    def _centred(self, first: int, noise: float) -> Jump:
        """Fit the best jump near a window, in the window that has it in its middle."""
        last = self.residual.size - self.model.window
        for _ in range(_CENTRINGS):
            window = self.residual[first : first + self.model.window]
            instant, sizes, error, explained = self.model.best_instant(window, noise)
            place = first + self.zero + instant
            middle = min(max(int(np.floor(place)) - self.zero, 0), last)
            if middle == first:
                break
            first = middle
        return Jump(place, sizes, error, explained)


def _quantile(rows: NDArray[np.floating[Any]], share: float) -> Array:
    """Linear quantile along the last axis, as `numpy.quantile` in a tenth of its time for short rows."""
    place = share * (rows.shape[-1] - 1)
    low = int(place)
    parts = np.partition(rows, low, axis=-1)
    value = parts[..., low]
    if place == low:
        return np.asarray(value)
    return np.asarray(value + (place - low) * (parts[..., low + 1 :].min(axis=-1) - value))
