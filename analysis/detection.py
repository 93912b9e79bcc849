"""Impacts of dampers, found in the channels alone: an impact is a jump of its body's velocity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.measurands import named
from analysis.spans import spans
from rig.errors import RecordingError

if TYPE_CHECKING:
    from daq.channel import ChannelInfo
    from daq.recording import Recording

Array = NDArray[np.float64]

# Samples on either side from which the velocity is extrapolated to the jump, per 5 kHz of sample rate.
_SIDE_PER_HZ = 1e-3
_FEWEST_SIDE = 5
# A jump counts when it exceeds the noise of its estimate by this factor: one false alarm in some 1e9
# samples of Gaussian noise, and room for what is not Gaussian.
SIGMAS = 6.0
# Of a large jump so much may be left after it was taken out; jumps smaller than that are not told from it.
_LEFT_OVER = 0.05
# With its velocity a body's acceleration jumps too; that kink reads as a small jump a few samples off the
# large one.
_SHADOW = 0.25
_PASSES = 12
_EDGE_SIDES = 8
# After a blow, a sensor's resonance is waited for during so many of its decay times; read at a random
# phase, it shows at least this part of its amplitude nine times out of ten.
_HOLD = 8.0
_RANDOM_PHASE = 0.15


@dataclass(frozen=True)
class Impacts:
    """Impacts found in one channel.

    Attributes
    ----------
    channel : str
        Name.
    time : ndarray, shape (n,)
        s after sample 0.
    jump : ndarray, shape (n,)
        Velocity jump of the body, m/s: down (negative) from a blow on the floor, up from one on the
        ceiling. NaN where the sensor rings above half the sample rate and only the time can be told.
    threshold : float
        Smallest jump told from noise, m/s: `SIGMAS` standard deviations of the estimate, or 1 % of the
        largest.
    noise : float
        That standard deviation, m/s.
    searched : float
        Length of the stretch searched, s.
    """

    channel: str
    time: Array
    jump: Array
    threshold: float
    noise: float
    searched: float

    @property
    def kind(self) -> NDArray[np.str_]:
        """``"floor"`` or ``"ceiling"``, from the direction of the jump; ``"unknown"`` without one."""
        known = np.where(self.jump < 0, "floor", "ceiling")
        return np.where(np.isnan(self.jump), "unknown", known)


def impacts(rec: Recording, channel: str, start: int = 0, stop: int | None = None) -> Impacts:
    """Find impacts in a stretch of one channel.

    The velocity is extrapolated by straight lines from a millisecond before and a millisecond after each
    sample; the difference at the sample is its jump (curvature cancels between the two sides). The
    velocity at the jump's own sample, between those before and after, tells where inside the sample the
    jump was. Jumps are taken out, largest of each neighbourhood first, so that they do not hide each
    other; then the smooth rest is taken off too, and what is left is the noise.

    Parameters
    ----------
    rec : daq.recording.Recording
        The recording.
    channel : str
        Channel on a body, of acceleration, velocity or displacement.
    start, stop : int
        First and one-past-last sample.

    Returns
    -------
    Impacts
    """
    info = named(rec, channel)
    stop = rec.samples if stop is None else min(stop, rec.samples)
    side = max(_FEWEST_SIDE, round(_SIDE_PER_HZ * rec.rate))
    if stop - start < 20 * side:
        raise RecordingError(
            f"{stop - start} samples are too few to tell impacts from noise: take at least {20 * side}"
        )
    samples = next(spans(rec, [info.name], [(start, stop)]))[0]
    velocity, offset = _velocity(info, samples)
    position, jumps, after, noise, threshold = _jumps(velocity, side, np.isfinite(velocity))
    time = (start + position + offset - after) / rec.rate - _delay(info)
    searched = (samples.size - 2 * _EDGE_SIDES * side) / rec.rate
    ringing = _ringing(info)
    if ringing is None:
        return Impacts(info.name, time, jumps, threshold, noise, searched)
    decay, gain = ringing
    largest = _largest_of_groups(time, jumps, _HOLD * decay)
    if info.average:
        return Impacts(info.name, time[largest], jumps[largest], threshold, noise, searched)
    unknown = np.full(largest.size, np.nan)
    return Impacts(info.name, time[largest], unknown, threshold / gain, noise / gain, searched)


def _velocity(info: ChannelInfo, samples: Array) -> tuple[Array, float]:
    """Velocity whose value n is that of an interval; and the end of interval n, in samples."""
    if info.quantity == "displacement":
        return np.diff(samples) * info.rate, 1.0
    if info.quantity == "velocity":
        return samples, 0.5
    if info.quantity == "acceleration":
        filled = np.where(np.isfinite(samples), samples, 0.0)
        return np.where(np.isfinite(samples), np.cumsum(filled - np.mean(filled)) / info.rate, np.nan), 0.5
    raise RecordingError(
        f"channel {info.name!r} measures {info.quantity}: impacts show in motion channels only"
    )


def _delay(info: ChannelInfo) -> float:
    """Delay of the chain at low frequencies, beyond the averaging that the velocity accounts for."""
    frequency = 0.05 * info.rate
    phase = np.angle(info.response(np.array([frequency, 2.0 * frequency])))
    total = -np.diff(np.unwrap(phase))[0] / (2 * np.pi * frequency)
    return float(total)


def _ringing(info: ChannelInfo) -> tuple[float, float] | None:
    """Find the decay time in s of a resonance above half the sample rate, and what a unit jump reads, if any.

    After a blow such a sensor rings on over several samples. Averaged, the readings still add up to the jump;
    taken at instants, they catch the ringing at random phases: the blow shows, but its size is lost.
    """
    fast = [pole for pole in info.poles if pole.imag > np.pi * info.rate]
    if info.quantity != "acceleration" or not fast:
        return None
    pole = max(fast, key=lambda pole: pole.real)
    return -1.0 / pole.real, _RANDOM_PHASE * abs(pole) / info.rate


def _largest_of_groups(time: Array, jump: Array, hold: float) -> NDArray[np.int64]:
    """Index of the largest jump in each group of times less than `hold` after the group's first."""
    out: list[int] = []
    first = -np.inf
    for index, value in enumerate(time):
        if value - first > hold:
            out.append(index)
            first = value
        elif abs(jump[index]) > abs(jump[out[-1]]):
            out[-1] = index
    return np.array(out, dtype=np.int64)


def _kernel(side: int) -> Array:
    """Weights that turn velocities around a sample into the jump there; the sample itself has none."""
    t = np.arange(1, side + 1, dtype=float)
    fit = np.linalg.pinv(np.stack([np.ones(side), t], axis=1))[0]
    return np.concatenate([-fit[::-1], [0.0], fit])


def _jumps(
    velocity: Array, side: int, good: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], Array, Array, float, float]:
    """Find samples with a jump, its size, the part of its interval after it; and noise and threshold."""
    from scipy.signal import savgol_filter

    kernel = _kernel(side)
    filled = np.where(good, velocity, 0.0)
    usable = np.convolve(~good, np.ones(2 * side + 1), mode="same") == 0
    # At the ends the smooth part is extrapolated, and no smaller than what is looked for.
    usable[: _EDGE_SIDES * side] = usable[-_EDGE_SIDES * side :] = False
    steps = np.zeros(filled.size + 1)
    size, after = np.zeros(filled.size), np.zeros(filled.size)
    noise = threshold = 0.0
    for number in range(_PASSES):
        smooth = filled - np.cumsum(steps)[:-1]
        # Without the jumps the velocity is smooth: taking its smooth part off leaves the noise to compare
        # with.
        rest = smooth - savgol_filter(smooth, 16 * side + 1, 5) if number else smooth
        estimate = np.where(usable, np.correlate(rest, kernel, mode="same"), 0.0)
        noise = float(1.4826 * np.median(abs(estimate[usable]))) if usable.any() else 0.0
        threshold = max(SIGMAS * noise, _LEFT_OVER * max(abs(size).max(), abs(estimate).max()), 1e-12)
        peaks = _peaks(abs(estimate), threshold, side)
        if not peaks.size:
            if number:
                break
            continue
        jump = estimate[peaks]
        part = _after(rest, peaks, jump, side)
        both = size[peaks] + jump
        shared = np.where(abs(both) > 1e-12, (size[peaks] * after[peaks] + jump * part) / both, 0.0)
        size[peaks], after[peaks] = both, np.clip(shared, 0.0, 1.0)
        steps[:-1] = size * after
        steps[1:] += size * (1.0 - after)
    place, jump, part = _merged(size, after, threshold)
    own = _own(place, jump, 2 * side)
    return place[own], jump[own], part[own], noise, threshold


def _peaks(size: Array, threshold: float, apart: int) -> NDArray[np.int64]:
    """Find samples that exceed the threshold and everything within `apart` samples of them."""
    from scipy.ndimage import maximum_filter1d

    return np.flatnonzero((size > threshold) & (size >= maximum_filter1d(size, 2 * apart + 1)))


def _merged(size: Array, after: Array, threshold: float) -> tuple[NDArray[np.int64], Array, Array]:
    """Put together what was taken out of one sample and the next: a jump near their border shows in both."""
    positions = np.flatnonzero(size)
    groups = np.split(positions, np.flatnonzero(np.diff(positions) > 2) + 1) if positions.size else []
    place, jump, part = [], [], []
    for group in groups:
        total = float(size[group].sum())
        if abs(total) <= threshold:
            continue
        # Where the jump was, as the centre of its pieces, each `after` before the end of its interval.
        at = float(np.sum(size[group] * (group - after[group])) / total)
        at = min(max(at, group[0] - 1.0), float(group[-1]))
        place.append(int(np.ceil(at)))
        part.append(float(np.ceil(at) - at))
        jump.append(total)
    return np.array(place, dtype=np.int64), np.array(jump), np.array(part)


def _own(place: NDArray[np.int64], jump: Array, reach: int) -> NDArray[np.bool_]:
    """Tell jumps of their own from shadows of a much larger one near by."""
    own = np.ones(place.size, dtype=bool)
    for index in range(place.size):
        low, high = np.searchsorted(place, [place[index] - reach, place[index] + reach + 1])
        own[index] = abs(jump[index]) >= _SHADOW * abs(jump[low:high]).max()
    return own


def _after(velocity: Array, position: NDArray[np.int64], jump: Array, side: int) -> Array:
    """Part of the jump's own interval that was left after the jump, 0 to 1."""
    t = np.arange(1, side + 1, dtype=float)
    fit = np.linalg.pinv(np.stack([np.ones(side), t], axis=1))[0]
    before = velocity[position[:, None] - t.astype(int)] @ fit
    return np.clip((velocity[position] - before) / jump, 0.0, 1.0)


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
    found_matched, true_matched : ndarray of bool

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
