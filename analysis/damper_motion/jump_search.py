"""Search of a stretch of one channel for jumps of velocity, largest first, each taken out before the next."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.entangled_jumps import cost, grow
from analysis.damper_motion.joint_fit import (
    Jump,
    error_beside,
    fit_together,
    fit_within,
    put,
    readings,
    with_errors,
)
from analysis.damper_motion.jump_signature import SHIFT, Signature
from rig.numerics.runs import runs_of

Array = NDArray[np.float64]

# A jump counts when it exceeds the standard deviation of its estimate by this factor: one false alarm in
# some 1e9 samples of Gaussian noise.
SIGMAS = 6.0
# A jump larger than the least that counts by so many standard deviations is found for certain, as noise may take
# off three.
CERTAINTY = 3.0
# A jump smaller than this share of the largest cannot be distinguished from errors of the channel's model.
RANGE = 3e-3
# Or from what a bed's weight makes of a landing that lasts.
_RANGE_LASTING = 0.02
# What is left of a jump after it was taken out; smaller ones in its ringing cannot be distinguished from it.
LEFT_OVER = 0.02
# An impact on a neighbour kinks the acceleration of a body, and the kink is bent a little; the bend passes for
# a jump of at most this part of the velocity that the kink brings about in a sample.
_BEND = 1.0
# That, in such a part of the time that a landing lasts.
_OF_LANDING = 1.0 / 6.0
# Rounds of the search, each for the largest of what is left within reach; and of putting a window around a jump.
_ROUNDS, _PASSES = 12, 4
# Jumps nearer to each other than so many samples count as one; they are resolved with certainty from so many on.
_APART, RESOLVED = 4, 6
# What another jump may add to the standard deviation of one that is resolved from it.
_BESIDE_ANOTHER = 1.1
# What jumps leave unexplained is searched anew from so many times what is not missed on, over at most so many windows.
# Where so many times of it are left after that, and such a part of the largest jump there, no jump is detected.
_UNTOLD, _MISFIT = 10.0, 0.5
_TANGLED, _LONGEST, _LEAVES = 3.0, 4, 0.1
# Where a polynomial of an order higher by two leaves so many times less, in squares, the smooth motion follows it.
_BENDS, _BEND_PAYS = 4, 2.0
# So many are fitted together at a time; what is left of one that was fitted alone misleads by so many samples.
_TOGETHER, _STARTS, _BESIDE = 5, (0.0, -2.5, 2.5, -5.0, 5.0), 10.0
# Steps of the acceleration are such a part of what it goes through, smoothed over so many samples; kinks bring
# it back at such a frequency, Hz.
_PART, _CALM, _QUICK = 0.2, 8, 100.0
# A step of so many times that size is none.
_NO_WEIGHT = 3.0
# A landing slower than this part of the velocity that such a step causes during its contact is not detected.
_SLOW = 0.02
# Noise is taken to be the same over so many windows; it is estimated from the quietest share of them, and
# what normal deviates are below in as many.
_STEADY = 8
CALM = 0.5
# Places in one matrix product: so small a product stays in the cache, and BLAS starts no threads for it.
_PLACES_AT_ONCE = 256


class JumpSearch:
    """Search of one stretch: what is left of its differences, and what was taken out."""

    def __init__(
        self,
        of: Signature,
        samples: Array,
        good: NDArray[np.bool_],
        floor: float,
        rate: float,
        calm: float = CALM,
    ) -> None:
        from scipy.ndimage import minimum_filter1d

        self.signature, self.floor, self.rate, self.calm = of, floor, rate, calm
        filled = np.interp(np.arange(samples.size), np.flatnonzero(good), samples[good])
        self.rest = np.diff(filled, of.difference)
        self.usual = self.typical(filled)
        # Position i of a window's first difference, of its sample 0, and of the sample itself.
        self.zero = of.difference - of.window_start
        self.open = np.convolve(~good, np.ones(of.reach), mode="full")[of.reach - 1 :] == 0
        self.open = self.open[: self.rest.size - of.window + 1]
        # A jump beyond the windows, in the last samples of a stretch, passes for another one in the nearest of them.
        self.searchable = minimum_filter1d(self.open, of.window, mode="constant", cval=False)
        self.found: list[Jump] = []
        self.levels: dict[float, Array] = {}
        # What all that is read is held against: the smooth motion may bend where jumps alone do not see it.
        self.whole = of

    def with_signature(self, of: Signature, calm: float) -> JumpSearch:
        """Copy a search that has not begun, with another order of the smooth motion's polynomial and share of calm."""
        other = copy(self)
        other.signature = other.whole = of
        other.calm, other.rest, other.found, other.levels = calm, self.rest.copy(), [], {}
        return other

    def run(self) -> list[Jump]:
        """Jumps in their order, with their errors."""
        from scipy.ndimage import maximum_filter1d

        of = self.signature
        for _ in range(_ROUNDS):
            strength, noise = self.scan()
            taken, near = np.zeros(strength.size), ~self.open
            for one in self.found:
                at = self.at(one)
                taken[at] = max(taken[at], one.explains)
                near[max(at - _APART, 0) : at + _APART + 1] = True
            rings = maximum_filter1d(taken, 2 * (of.reach + of.ring) + 1)
            free = np.where(near, 0.0, strength)
            peaks = (free >= maximum_filter1d(free, 2 * of.reach + 1)) & (free > SIGMAS**2)
            peaks &= free > LEFT_OVER**2 * rings
            where = np.flatnonzero(peaks)
            if not where.size:
                break
            for first in where[np.argsort(-strength[where], kind="stable")]:
                one = self.fitted(int(first), float(noise[first]))
                if any(abs(one.place - other.place) < _APART for other in self.found):
                    continue
                self._add(one, -1.0)
                self.found.append(one)
                self.settle(one, noise, _STARTS)
        for one in sorted(self.found, key=lambda one: abs(one.sizes[0])):
            now = min(self.found, key=lambda other: abs(other.place - one.place))
            self.settle(now, noise)
        self.whole = self.bent()
        sure = self.threshold
        for first, last in self.unexplained(_TANGLED * sure):
            self.untangle(first, last, sure)
        self.found.sort(key=lambda one: one.place)
        # Where a landing lasts, so do kinks: a bed is pressed, or let go.
        within = max(1.0, _OF_LANDING * self.signature.lasts) / self.rate
        real = [
            one
            for one in self.found
            if self.searchable[self.at(one)]
            and (self.signature.lasts or abs(one.sizes[0]) > SIGMAS * one.error)
            and abs(one.sizes[0]) > _BEND * abs(one.sizes[2]) * within**2
        ]
        noise = self.noise()
        resolved = [
            with_errors(self.rest, self.signature, one, float(noise[self.at(one)]), self.usual)
            for one in real
        ]
        # When landings that last were found, others still passed for noise.
        return [one for one in resolved if not self.signature.lasts or abs(one.sizes[0]) > SIGMAS * one.error]

    def _add(self, one: Jump, share: float) -> None:
        """Add a share of a jump to the residual."""
        put(self.rest, self.signature, one, share)
        self.levels.clear()

    def at(self, one: Jump) -> int:
        """Where the window of a jump begins, among those that there are."""
        return min(max(int(np.floor(one.place)) - self.zero, 0), self.rest.size - self.signature.window)

    def settle(self, one: Jump, noise: Array, starts: tuple[float, ...] = (0.0,)) -> None:
        """Fit a jump anew together with those that it rings into, from where it lies and from places beside that.

        One that lies beside a larger one is left out where that one explains both as well by itself.
        """
        of = self.signature
        group = [other for other in self.found if abs(other.place - one.place) < of.reach]
        if len(group) == 1 and not self._odd(one):
            return
        group.sort(key=lambda other: abs(other.place - one.place))
        group, others = group[:_TOGETHER], group[1:_TOGETHER]
        for other in group:
            self._add(other, 1.0)
        deviation = float(noise[self.at(one)])
        places = [one.place + start for start in starts]
        tries = [
            fit_together(self.rest, of, [replace(one, place=place), *others], deviation, self.usual)
            for place in places
            if place == one.place or all(abs(place - other.place) >= _APART for other in others)
        ]
        best, left = min(tries, key=lambda fit: fit[1])
        if any(abs(other.place - one.place) < _BESIDE for other in others):
            alone, more = fit_together(self.rest, of, others, deviation, self.usual)
            if more < left + (SIGMAS * deviation) ** 2:
                best = alone
        self.found = [other for other in self.found if all(other is not old for old in group)] + best
        for new in best:
            self._add(new, -1.0)

    @property
    def threshold(self) -> float:
        """Smallest jump that is not missed, m/s, but beside a larger one."""
        noise = float(np.percentile(self.noise(), 95.0)) * self.signature.gain
        return self.least_sure(noise, max((abs(one.sizes[0]) for one in self.found), default=0.0))

    def least_sure(self, noise: float, largest: float) -> float:
        """Smallest jump that is not missed, m/s: the noise taken `SIGMAS` + 3 times, or a part of the largest one.

        Where a landing lasts, it is no less than a part of what the motion's usual steps make of that time.
        """
        lasts = self.signature.lasts / self.rate
        part = _RANGE_LASTING if lasts else RANGE
        return max((SIGMAS + CERTAINTY) * noise, part * largest, _SLOW * self.usual[0] * lasts)

    def resolution(self) -> int:
        """Return the distance from which on another jump adds little to the error of one, samples."""
        of, noise = self.whole, float(np.median(self.noise()))
        most = _BESIDE_ANOTHER * error_beside(of, None, noise, self.usual)
        apart = RESOLVED
        while apart < of.reach and error_beside(of, apart, noise, self.usual) > most:
            apart += 1
        return apart

    def bent(self) -> Signature:
        """Signature with the order of the polynomial that the smooth motion between jumps follows."""
        of = best = self.signature
        least = self._typically_left(of)
        for bends in range(1, _BENDS):
            more = replace(of, curvature=of.curvature + 2 * bends)
            left = self._typically_left(more)
            if _BEND_PAYS * left < least:
                best, least = more, left
        return best

    def _typically_left(self, of: Signature) -> float:
        """Squares that are left of most windows, for each of their degrees of freedom."""
        _, squares = self._left(of)
        return float(np.median(squares)) / (of.window - of.curvature - 1)

    def _left(self, of: Signature) -> tuple[NDArray[np.int64], Array]:
        """Windows that half overlap, and the squares that are left of each."""
        first = np.flatnonzero(self.open)
        first = first[first % (of.window // 2) == 0]
        windows = np.lib.stride_tricks.sliding_window_view(self.rest, of.window)[first]
        return first, np.asarray(np.sum(readings(windows, of, of.window) ** 2, axis=1))

    def unexplained(self, least: float) -> list[tuple[int, int]]:
        """First and last window of each stretch in which as much is left as a jump of so many m/s would leave."""
        first, squares = self._left(self.whole)
        return [
            (int(first[begin]), int(first[end - 1]))
            for begin, end in runs_of(squares > (least * self.unit()) ** 2)
        ]

    def entangled(self) -> Array:
        """Between which places far more is left than a jump would leave that is not missed, samples; shape (n, 2)."""
        of, out = self.whole, []
        for first, last in self.unexplained(_UNTOLD * self.threshold):
            ends = first + self.zero - of.window / 2, last + self.zero + of.window / 2
            largest = max(
                (abs(one.sizes[0]) for one in self.found if ends[0] <= one.place < ends[1]), default=0.0
            )
            left = readings(self.rest[None, first : last + of.window], of, last - first + of.window)
            if np.linalg.norm(left) > _MISFIT * largest * self.unit():
                out.append(ends)
        odd = [one.place for one in self.found if self._odd(one) and abs(one.sizes[0]) > self.threshold]
        out += [(place - 0.5 * of.window, place + 0.5 * of.window) for place in odd]
        return np.array(out).reshape(-1, 2)

    def _odd(self, one: Jump) -> bool:
        """Whether what lasts comes with a step that no bed's weight brings about: one that ends early passes for that.

        Its jump may then go either way.
        """
        return self.signature.lasts > 0 and abs(one.sizes[1]) > _NO_WEIGHT * self.usual[0]

    def unit(self) -> float:
        """Root of the squares of a jump of 1 m/s in the middle of a window."""
        of = self.whole
        row = np.zeros(of.window)
        put(row, of, Jump(self.zero + 0.5, np.array([1.0, 0.0, 0.0]), 1.0, 0.0), 1.0)
        return float(np.linalg.norm(readings(row[None], of, of.window)))

    def untangle(self, first: int, last: int, sure: float) -> None:
        """Search anew between two windows, for all jumps there at once; what explains more of it is kept.

        What is left need not be less than a part of what a jump of `sure` m/s would leave.
        """
        of = self.whole
        half = of.window // 2
        if last - first > _LONGEST * of.window:
            return
        within = max(first - half, 0), min(last + of.window + half, self.rest.size)
        places = float(within[0] + self.zero), float(within[1] - of.window + self.zero)
        old = [one for one in self.found if places[0] <= one.place <= places[1]]
        for one in old:
            self._add(one, 1.0)
        enough = _LEAVES * (sure * self.unit()) ** 2
        # As noise counts what may be left: steps and kinks are else free to explain what is far above the noise.
        noise = max(float(self.noise()[first]), (enough / of.window) ** 0.5)
        new, left = grow(self.rest, of, within, places, RESOLVED, enough, noise, self.usual)
        if old:
            before = fit_within(self.rest, of, old, within, noise, self.usual)
            new = min((new, left), before, key=lambda fit: cost(*fit))[0]
        self.found = [one for one in self.found if all(one is not other for other in old)] + new
        for one in new:
            self._add(one, -1.0)

    def typical(self, samples: Array) -> tuple[float, float]:
        """Size of steps and kinks: a part of what the motion itself goes through, or of what its reading hides."""
        order = self.signature.difference - 2
        motion = np.diff(samples, order) * self.rate**order
        motion = np.convolve(motion - np.median(motion), np.ones(_CALM) / _CALM, "valid")
        # A reading that stands still moves by no more than what it is rounded to.
        step = _PART * max(float(np.percentile(abs(motion), 90.0)), self.floor * self.rate**order)
        return step, step * 2 * np.pi * _QUICK

    def noise(self, calm: float = CALM) -> Array:
        """Estimate the standard deviation of the jump coordinate at every place, from quantiles; shape (places,).

        Stored until a jump is put into the residual or taken out of it.
        """
        if calm not in self.levels:
            self.levels[calm] = self._noise_level(calm)
        return self.levels[calm]

    def _noise_level(self, calm: float) -> Array:
        from scipy.ndimage import maximum_filter1d
        from scipy.special import ndtri

        of = self.signature
        middle = of.filters[(2 * SHIFT + 1) * of.instants // 2, 2]
        size = abs(self._correlated(middle[None])[0])
        typical = np.quantile(size[self.open], calm)
        size[~self.open] = typical
        parts = max(1, size.size // (_STEADY * of.window))
        # The first parts have a place more than the others.
        length, longer = divmod(size.size, parts)
        lengths = np.full(parts, length) + (np.arange(parts) < longer)
        split = longer * (length + 1)
        rows = size[:split].reshape(longer, length + 1), size[split:].reshape(-1, length)
        levels = np.concatenate([np.quantile(row, calm, axis=1) for row in rows if row.size])
        steady = np.maximum(maximum_filter1d(levels, 3), typical)
        return np.asarray(np.maximum(np.repeat(steady, lengths) / ndtri(0.5 + 0.5 * calm), self.floor))

    def _correlated(self, filters: Array) -> Array:
        """Correlate filters with the residual; shape (filters, places)."""
        windows = np.lib.stride_tricks.sliding_window_view(self.rest, self.signature.window)
        out = np.empty((len(filters), len(windows)))
        for begin in range(0, len(windows), _PLACES_AT_ONCE):
            part = slice(begin, begin + _PLACES_AT_ONCE)
            np.matmul(filters, np.ascontiguousarray(windows[part].T), out=out[:, part])
        return out

    def scan(self) -> tuple[Array, Array]:
        """Largest squared jump coordinate at every place, in variances, and the noise.

        The filters of all instants lie in a space of few dimensions. The coordinates of a window there bound its
        coordinates along every filter, so that these are computed only where a jump may count.
        """
        noise = self.noise(self.calm)
        basis, weights = self.signature.scan_space
        projected = self._correlated(basis)
        bound = np.abs(weights).max(axis=0) @ np.abs(projected)
        strength = np.zeros(noise.size)
        places = np.flatnonzero(bound > SIGMAS * noise)
        for part in np.array_split(places, 1 + places.size // _PLACES_AT_ONCE):
            strength[part] = np.square(weights @ projected[:, part]).max(axis=0)
        return strength / np.square(noise), noise

    def fitted(self, first: int, noise: float) -> Jump:
        """Best jump near a place, in a window that has it in its middle."""
        last = self.rest.size - self.signature.window
        for _ in range(_PASSES):
            one = self.best(first, noise)
            middle = min(max(int(np.floor(one.place)) - self.zero, 0), last)
            if middle == first:
                break
            first = middle
        return one

    def best(self, first: int, noise: float) -> Jump:
        """Best jump in the window that begins at a place: the instant that explains most of it."""
        of = self.signature
        window = self.rest[first : first + of.window]
        rough = of.filters[of.coarse // 2 :: of.coarse] @ window
        best = int(np.argmax(np.sum(rough**2, axis=1))) * of.coarse + of.coarse // 2
        low = max(best - of.coarse, 0)
        near = of.filters[low : best + of.coarse + 1] @ window
        explains = np.sum(near**2, axis=1) / noise**2
        best = int(np.argmax(explains))
        row, toward = low + best, 0.0
        if 0 < best < explains.size - 1:
            left, mid, right = explains[best - 1 : best + 2]
            bend = left - 2.0 * mid + right
            toward = float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if bend < 0 else 0.0
        sizes = self.sizes(row, near[best])
        if toward:
            side = 1 if toward > 0 else -1
            sizes = (1.0 - abs(toward)) * sizes + abs(toward) * self.sizes(row + side, near[best + side])
        place = first + self.zero + (row + toward + 0.5) / of.instants - SHIFT
        error = noise / abs(self.signature.triangles[row, 2, 2])
        return Jump(place, sizes, error, float(explains[best]))

    def sizes(self, row: int, coordinates: Array) -> Array:
        """Jump [m/s], step [m/s²] and kink [m/s³] from coordinates."""
        return np.asarray(np.linalg.solve(self.signature.triangles[row], coordinates)[::-1])
