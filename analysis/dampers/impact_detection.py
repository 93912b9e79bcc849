"""Impacts of dampers, found in the channels alone: an impact is a jump of its body's velocity."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.dampers.joint_fit import Jump, fit_together, put
from analysis.dampers.jump_signature import SHIFT, Signature, signature
from analysis.recordings.slices import read_slices
from analysis.responses.frf import MOTIONS
from analysis.responses.measurands import named
from rig.errors import RecordingError
from rig.scene.contact import Landing, Walls

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.damper import Damper

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# A jump counts when it exceeds the standard deviation of its estimate by this factor: one false alarm in
# some 1e9 samples of Gaussian noise. One larger by so much more is found for certain, as noise may take off
# three standard deviations.
SIGMAS = 6.0
_CERTAINTY = 3.0
# So much smaller than the largest one, a jump is not told from what the model of a channel leaves out.
_RANGE = 3e-3
# What is left of a jump after it was taken out; smaller ones in its ringing are not told from that.
_LEFT_OVER = 0.02
# An impact on a neighbour kinks the acceleration of a body, and the kink is bent a little; the bend passes for
# a jump of at most this part of the velocity that the kink brings about in a sample.
_BEND = 1.0
# Rounds of the search, each for the largest of what is left within reach; and of putting a window around a jump.
_ROUNDS, _PASSES = 12, 4
# A landing of no more than this part of a sample interval is a jump.
_INSTANT = 0.25
# Jumps nearer to each other than so many samples are taken for one; told apart for certain from so many on.
_APART, RESOLVED = 4, 6
# So many are fitted together at a time; what is left of one that was fitted alone misleads by so many samples.
_TOGETHER, _STARTS, _BESIDE = 5, (0.0, -2.5, 2.5, -5.0, 5.0), 10.0
# Steps of the acceleration are such a part of what it goes through, smoothed over so many samples; kinks bring
# it back at such a frequency, Hz.
_PART, _CALM, _QUICK = 0.2, 8, 100.0
# Acceleration at an impact: from so much time on either side, s, less so many decay times of the sensor's
# resonance, by a polynomial of this order.
_AROUND, _FEWEST_AROUND, _RUNG_OUT, _BENDS = 2e-3, 8, 4.0, 3
# Noise is taken to be the same over so many windows; it is told from the share of them in which there is least, and
# what normal deviates are below in as many.
_STEADY = 8
_QUANTILE, _OF_NORMAL = 0.5, 0.6745
# Orders of the polynomial the acceleration follows around a jump: a higher one is taken where it leaves clearly less.
_CURVATURES = (2, 4, 6, 8)
_CLEARLY = 0.7


@dataclass(frozen=True)
class Impacts:
    """Impacts found in one channel."""

    channel: str
    time: Array
    """s after sample 0; shape (n,)."""
    jump: Array
    """Velocity jump of the body, m/s: down (negative) from a blow on the floor, up from one on the ceiling;
    shape (n,)."""
    acceleration: Array
    """Smooth acceleration of the body then, m/s²; NaN where the stretch ends before it can be told; shape
    (n,)."""
    noise: float
    """Standard deviation of a jump's estimate where there is none, m/s: from the channel's noise, as found
    between the impacts, through the filter that looks for jumps. Where the noise varies, its 95th
    percentile."""
    resolution: float
    """Impacts nearer to each other than this are seen as one, the largest, s."""
    searched: float
    """Length of what was searched, s: the stretch without its ends, lost samples and overloads."""

    @property
    def threshold(self) -> float:
        """Smallest jump that is not missed, m/s: the noise taken `SIGMAS` + 3 times, or a part of the largest one."""
        return max((SIGMAS + _CERTAINTY) * self.noise, _RANGE * float(abs(self.jump).max(initial=0.0)))

    @property
    def kind(self) -> NDArray[np.str_]:
        """``"floor"`` or ``"ceiling"``, from the direction of the jump."""
        return np.where(self.jump < 0, "floor", "ceiling")


def impacts(rec: Recording, channel: str, start: int = 0, stop: int | None = None) -> Impacts:
    """Find impacts in a stretch of one channel.

    How the channel reads a jump of velocity at any instant follows from its data sheet: sensor resonance,
    integrator, averaging and decimation included. At every sample that reading, together with a step and
    a kink of the acceleration (both come with an impact, on the body itself and on its neighbours) and a
    smooth motion, is fitted to the samples around by least squares. Where a jump explains them best and
    exceeds `SIGMAS` standard deviations, it is an impact. It is then taken out and the search repeated for
    smaller ones; those that ring into each other are fitted together.

    Parameters
    ----------
    channel : str
        Channel on a body, of acceleration, velocity or displacement.
    start, stop : int
        First and one-past-last sample.

    Raises
    ------
    RecordingError
        If the channel measures no motion, the stretch is too short or damaged, or contact on its body lasts.
    """
    info = named(rec, channel)
    if info.quantity not in MOTIONS:
        raise RecordingError(
            f"channel {info.name!r} measures {info.quantity}: impacts show in motion channels only"
        )
    for damper in rec.scene.dampers:
        if info.at == f"body {damper.body}" and _lasts(damper, info.rate):
            raise RecordingError(
                f"{info.name}: the contact of the damper in body {damper.body} lasts (contact: in its scene), so that "
                "its landings are no jumps of velocity and are not told from a channel; rig.frequency_response tells "
                "its motion"
            )
    stop = rec.samples if stop is None else min(stop, rec.samples)
    choices = [_signature(json.dumps(info.to_metadata()), order) for order in _CURVATURES]
    least = 4 * max(one.reach for one in choices)
    if stop - start < least:
        raise RecordingError(
            f"{stop - start} samples are too few to tell impacts from noise: take at least {least}"
        )
    samples = next(read_slices(rec, [info.name], [(start, stop)]))[0]
    good = np.isfinite(samples)
    for marker in rec.overloads:
        if marker.fields.get("channel") == info.name:
            # What follows is ringing whose beginning is not known.
            good[max(marker.first_sample - start, 0) : max(marker.end + 1 + choices[0].ring - start, 0)] = (
                False
            )
    if np.sum(good) < least:
        raise RecordingError(
            f"all but {np.sum(good)} samples of {info.name} in this stretch are lost or overloaded: choose "
            "another stretch, or record with a lower level or a larger converter range"
        )
    scale = float(abs(samples[good]).max())
    # Rounding in the converter is noise too, even where a steady reading hides it.
    floor = max(0.0 if info.volts_per_count is None else info.unit_per_count / 12.0**0.5, 1e-14 * scale)
    searches = [_Search(one, samples, good, floor, rec.rate) for one in choices]
    if not all(search.open.any() for search in searches):
        raise RecordingError(
            f"lost or overloaded samples leave no {least} samples of {info.name} together: choose another "
            "stretch, or record with a lower level or a larger converter range"
        )
    quiet = [search.signature.gain * float(np.median(search.noise()[2])) for search in searches]
    taken = 0
    for k, left in enumerate(quiet):
        if left < _CLEARLY * quiet[taken]:
            taken = k
    search = searches[taken]
    place, jump = search.run()
    noise = float(np.percentile(search.noise()[2], 95.0)) * search.signature.gain
    clear = abs(jump) > max(SIGMAS * noise, _RANGE * float(abs(jump).max(initial=0.0)))
    return Impacts(
        info.name,
        (start + place[clear]) / rec.rate - info.delay,
        jump[clear],
        _acceleration(samples, place[clear], info),
        noise,
        RESOLVED / rec.rate,
        float(search.open.sum()) / rec.rate,
    )


def _lasts(damper: Damper, rate: float) -> bool:
    """Whether a landing is seen to last: only one named by a time well within a sample interval is not."""
    contact = damper.contact
    walls = (contact.floor, contact.ceiling) if isinstance(contact, Walls) else (contact,)
    longest = (
        max(wall.duration if isinstance(wall, Landing) else np.inf for wall in walls if wall)
        if contact
        else 0.0
    )
    return not damper.locked and longest * rate > _INSTANT


def _acceleration(samples: Array, places: Array, info: ChannelInfo) -> Array:
    """Acceleration at jumps at places in samples: a polynomial through what is around, across the jump."""
    order = 2 - MOTIONS.index(info.quantity)
    # What the sensor rings on for is left out; and the average over an interval belongs to its middle.
    slowest = min((-pole.real for pole in info.poles if abs(pole) > info.rate), default=np.inf)
    gap = 2 + int(np.ceil(_RUNG_OUT * info.rate / slowest))
    side = max(_FEWEST_AROUND, round(_AROUND * info.rate))
    out = np.full(places.size, np.nan)
    for index, place in enumerate(places):
        whole = int(np.floor(place))
        if whole < side or whole + gap + side > samples.size:
            continue
        around = np.concatenate([np.arange(whole - side, whole), np.arange(whole + gap, whole + gap + side)])
        time = (around - place - 0.5 * info.average) / (side + gap)
        columns = [time**power for power in range(order + _BENDS + 1)]
        if order:
            columns.append(np.maximum(time, 0.0) ** (order - 1) * (time > 0))
        fit = np.linalg.lstsq(np.stack(columns, axis=1), samples[around], rcond=None)[0]
        out[index] = fit[order] * (1.0, 1.0, 2.0)[order] * (info.rate / (side + gap)) ** order
    return out


@lru_cache(maxsize=16)
def _signature(metadata: str, curvature: int) -> Signature:
    from daq.signal_chain.channel import ChannelInfo

    return signature(ChannelInfo.from_metadata(json.loads(metadata)), curvature)


class _Search:
    """Search of one stretch: what is left of its differences, and what was taken out."""

    def __init__(
        self, of: Signature, samples: Array, good: NDArray[np.bool_], floor: float, rate: float
    ) -> None:
        self.signature, self.floor, self.rate = of, floor, rate
        filled = np.interp(np.arange(samples.size), np.flatnonzero(good), samples[good])
        self.rest = np.diff(filled, of.difference)
        self.usual = self.typical(filled)
        # Position i of a window's first difference, of its sample 0, and of the sample itself.
        self.zero = of.difference - of.window_start
        self.open = np.convolve(~good, np.ones(of.reach), mode="full")[of.reach - 1 :] == 0
        self.open = self.open[: self.rest.size - of.window + 1]
        self.found: list[Jump] = []

    def run(self) -> tuple[Array, Array]:
        """Places in samples, and sizes in m/s."""
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
            peaks &= free > _LEFT_OVER**2 * rings
            where = np.flatnonzero(peaks)
            if not where.size:
                break
            for first in where[np.argsort(-strength[where], kind="stable")]:
                one = self.fitted(int(first), float(noise[2, first]))
                if any(abs(one.place - other.place) < _APART for other in self.found):
                    continue
                put(self.rest, of, one, -1.0)
                self.found.append(one)
                self.settle(one, noise, _STARTS)
        for one in sorted(self.found, key=lambda one: abs(one.sizes[0])):
            now = min(self.found, key=lambda other: abs(other.place - one.place))
            self.settle(now, noise)
        self.found.sort(key=lambda one: one.place)
        real = [
            one
            for one in self.found
            if abs(one.sizes[0]) > SIGMAS * one.error
            and abs(one.sizes[0]) > _BEND * abs(one.sizes[2]) / self.rate**2
        ]
        return np.array([one.place for one in real]), np.array([one.sizes[0] for one in real])

    def at(self, one: Jump) -> int:
        """Where the window of a jump begins, among those that there are."""
        return min(max(int(np.floor(one.place)) - self.zero, 0), self.rest.size - self.signature.window)

    def settle(self, one: Jump, noise: Array, starts: tuple[float, ...] = (0.0,)) -> None:
        """Fit a jump anew together with those that it rings into, from where it lies and from places beside that.

        One that lies beside a larger one is left out where that one explains both as well by itself.
        """
        of = self.signature
        group = [other for other in self.found if abs(other.place - one.place) < of.reach]
        if len(group) == 1:
            return
        group.sort(key=lambda other: abs(other.place - one.place))
        group, others = group[:_TOGETHER], group[1:_TOGETHER]
        for other in group:
            put(self.rest, of, other, 1.0)
        deviation = float(noise[2, self.at(one)])
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
            put(self.rest, of, new, -1.0)

    def typical(self, samples: Array) -> tuple[float, float]:
        """Size of steps and kinks: a part of what the motion itself goes through."""
        order = self.signature.difference - 2
        motion = np.diff(samples, order) * self.rate**order
        motion = np.convolve(motion - np.median(motion), np.ones(_CALM) / _CALM, "valid")
        step = _PART * float(np.percentile(abs(motion), 90.0))
        return step, step * 2 * np.pi * _QUICK

    def coordinates(self, row: int) -> Array:
        """Kink, step and jump coordinates at every place, shape (3, places), for one instant."""
        from scipy import signal

        long = self.rest.size * self.signature.window > 1 << 20
        how = "fft" if long and self.signature.window > 32 else "direct"
        return np.stack(
            [signal.correlate(self.rest, part, "valid", how) for part in self.signature.filters[row]]
        )

    def noise(self) -> Array:
        """Find the standard deviation of the coordinates at every place, shape (3, places), from medians."""
        from scipy.ndimage import maximum_filter1d

        of = self.signature
        size = abs(self.coordinates((2 * SHIFT + 1) * of.instants // 2))
        middle = np.quantile(size[:, self.open], _QUANTILE, axis=1)[:, None]
        parts = np.array_split(
            np.where(self.open, size, middle), max(1, size.shape[1] // (_STEADY * of.window)), axis=1
        )
        medians = np.stack([np.quantile(part, _QUANTILE, axis=1) for part in parts], axis=1)
        steady = np.maximum(maximum_filter1d(medians, 3, axis=1), middle)
        return np.maximum(
            np.repeat(steady, [part.shape[1] for part in parts], axis=1) / _OF_NORMAL, self.floor
        )

    def scan(self) -> tuple[Array, Array]:
        """Largest squared jump coordinate at every place, in variances, and the noise."""
        of = self.signature
        noise = self.noise()
        best = np.zeros(noise.shape[1])
        first = SHIFT * of.instants + of.coarse // 2
        for row in range(first, first + of.instants, of.coarse):
            np.maximum(best, (self.coordinates(row)[2] / noise[2]) ** 2, out=best)
        return best, noise

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


def score(found: Array, true: Array, tolerance: float) -> tuple[float, NDArray[np.bool_], NDArray[np.bool_]]:
    """Match detected times with true ones, each at most once, nearest pairs first.

    Parameters
    ----------
    found, true : ndarray
        Times, s.
    tolerance : float
        Largest distance of a pair, s.

    Returns
    -------
    f1 : float
        2 hits / (detected + true); 1 when both are empty.

    Examples
    --------
    >>> score(np.array([1.0, 2.0, 5.0]), np.array([1.01, 2.0, 3.0]), 0.05)[0]
    0.6666666666666666
    """
    found_matched, true_matched = np.zeros(found.size, dtype=bool), np.zeros(true.size, dtype=bool)
    if not found.size and not true.size:
        return 1.0, found_matched, true_matched
    if found.size and true.size:
        pairs = []
        for i, time in enumerate(found):
            low, high = np.searchsorted(true, [time - tolerance, time + tolerance])
            pairs += [(abs(true[j] - time), i, j) for j in range(low, high)]
        for _, i, j in sorted(pairs):
            if not found_matched[i] and not true_matched[j]:
                found_matched[i] = true_matched[j] = True
    return float(2 * found_matched.sum() / (found.size + true.size)), found_matched, true_matched
