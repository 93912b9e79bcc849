"""Impacts of dampers, found in the channels alone: an impact is a jump of its body's velocity, or a pulse of force."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.joint_fit import Jump
from analysis.damper_motion.jump_search import CALM, CERTAINTY, LEFT_OVER, RANGE, SIGMAS, JumpSearch
from analysis.damper_motion.jump_signature import Signature, signature
from analysis.damper_motion.landing_pulse import Pulse, landing_pulse
from analysis.decays.sensor_correction import corrected
from analysis.responses.frf import MOTIONS
from analysis.responses.measurands import named
from rig.errors import RecordingError
from rig.numerics.runs import runs_of

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo

Array = NDArray[np.float64]

# Where less than this part of a stretch can be searched, it has no result.
_LEAST_SEARCHED = 0.5
# A bed's weight puts off the end of a landing that lasts: so many durations beside it, less than such a part of it is
# its release. While it rings, less than this share of it cannot be distinguished from the residual of the fit.
RELEASED, _OF_RELEASE, HIDES = 1.6, 0.5, 0.15
# Such a part of a landing that lasts is not known of it and those beside it, which puts it off by such a part of its
# width and of a sample interval.
_MISFIT, _LATE, _BETWEEN = 0.03, 0.04, 0.05
# Readings in the time in which nine tenths of a landing are over: samples of a higher rate are taken together.
_WIDTH = 8
# Below the lowest frequency of interest, Hz; up to this share of the sample rate.
_LOW, _HIGH = 2.0, 0.4
# Acceleration at an impact: from so much time on either side, s, less so many decay times of the sensor's
# resonance, by a polynomial of this order.
_AROUND, _FEWEST_AROUND, _RUNG_OUT, _BENDS = 2e-3, 8, 4.0, 3
# Orders of the polynomial the acceleration follows around a jump: a higher one is taken where it leaves clearly less.
_CURVATURES = (2, 4, 6, 8)
_CLEARLY = 0.7
# Where the largest jump is less than so many times the noise, that may be other jumps: it is then estimated from this
# share of the windows, the quietest ones.
_DOUBTFUL, _CALMEST = 40.0, 0.1


@dataclass(frozen=True)
class Impacts:
    """Impacts found in one channel."""

    channel: str
    time: Array
    """s after sample 0; shape (n,)."""
    time_error: Array
    """Standard deviation of that, s; shape (n,). Of the fit and, where a landing lasts, of what its other ending and
    larger ones beside it leave open."""
    jump: Array
    """Velocity jump of the body, m/s: down (negative) from a blow on the floor, up from one on the ceiling;
    shape (n,). Times the body's mass it is the impulse. Where a landing lasts, in proportion to the duration that the
    scene gives it; time and direction hardly depend on that."""
    jump_error: Array
    """Standard deviation of that likewise, m/s, without what the sensor's sensitivity is off; shape (n,)."""
    acceleration: Array
    """Smooth acceleration of the body then, m/s²; NaN where the stretch ends too early; shape
    (n,)."""
    noise: float
    """Standard deviation of a jump's estimate where there is none, m/s: from the channel's noise, as found
    between the impacts, through the filter that looks for jumps. Where the noise varies, its 95th
    percentile."""
    resolution: float
    """Shortest interval between two impacts that the channel resolves, s."""
    ringing: float
    """How long the channel rings about an impact, s: there one smaller than `hidden` of it may be missed."""
    threshold: float
    """Smallest jump that is not missed, m/s: the noise taken `SIGMAS` + 3 times, or a part of the largest one; more
    where a landing lasts. Beside a larger one, while that rings, it is more: see `ringing`."""
    lasts: float
    """How long a landing lasts, s; 0 where it is instant. Beside a landing that lasts a jump may be its end."""
    searched: float
    """Length of what was searched, s: the stretch without its ends and without `left_out`."""
    left_out: Array
    """Begin and end of stretches without detection, s; shape (m, 2): samples were lost or overloaded, or
    impacts are so near to each other that no set of them explains what is seen."""

    @property
    def apart(self) -> float:
        """Impacts nearer to each other than this may be seen as one, the largest, s."""
        return self.resolution + RELEASED * self.lasts

    @property
    def hidden(self) -> float:
        """Share of an impact beside which a smaller one may be missed."""
        return HIDES if self.lasts else LEFT_OVER

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
    smaller ones; those that ring into each other are fitted together. Where contact lasts, jump, step and kink come
    about as the spring-dashpot of the scene's contact passes them on until a landing ends under no other force; times
    are those of touches.

    Parameters
    ----------
    channel : str
        Channel on a body, of acceleration, velocity or displacement.
    start, stop : int
        First and one-past-last sample.

    Raises
    ------
    RecordingError
        If the channel measures no motion or is blind to blows, the stretch is too short, damaged or without any
        reading, or on its body are grains, or landings that differ in how they last.
    """
    info = _measures_motion(rec, channel)
    stop = rec.samples if stop is None else min(stop, rec.samples)
    pulse = landing_pulse(rec.scene, info.at, info.rate)
    together = 1 if pulse is None else max(1, int(pulse.width * info.rate / _WIDTH))
    if together == 1 and _blind(info):
        raise RecordingError(
            f"{info.name} takes the acceleration at instants (converter: sampling), and nothing in it spreads a blow "
            "over time: an impact between two instants leaves little or no trace; record with sampling: average, a "
            "filter, an integrator or the resonance of a sensor, or at a rate at which landings last many samples"
        )
    choices = [_signature(json.dumps(info.to_metadata()), order, pulse, together) for order in _CURVATURES]
    least = 4 * max(one.reach for one in choices) * together
    if stop - start < least:
        raise RecordingError(
            f"{stop - start} samples are too few to distinguish impacts from noise. Take at least {least}"
        )
    samples = rec.read(info.name, start, stop)
    good = _good(rec, info.name, samples, start, choices[0].ring * together)
    if np.sum(good) < max(least, _LEAST_SEARCHED * good.size):
        raise RecordingError(
            f"all but {np.sum(good)} of {good.size} samples of {info.name} in this stretch are lost or overloaded: "
            "choose another stretch, or record with a lower level, a larger converter range, or contacts that last"
        )
    filled = np.interp(np.arange(samples.size), np.flatnonzero(good), samples[good])
    scale = float(abs(samples[good]).max())
    # Rounding in the converter is noise too, even where a steady reading hides it.
    floor = max(0.0 if info.volts_per_count is None else info.unit_per_count / 12.0**0.5, 1e-14 * scale)
    if floor == 0.0:
        raise RecordingError(f"{info.name} reads zero throughout this stretch: check what it is connected to")
    rate, read, whole = rec.rate / together, _means(samples, together), _means(good, together) == 1.0
    floor /= together**0.5
    first = JumpSearch(choices[0], read, whole, floor, rate)
    if not first.open.any():
        raise RecordingError(
            f"lost or overloaded samples leave no {least} samples of {info.name} together: choose another "
            "stretch, or record with a lower level or a larger converter range"
        )
    search, detected = _searched([first.with_signature(each, CALM) for each in choices])
    noise = _noise(search)
    found = max((abs(one.sizes[0]) for one in detected), default=0.0 if pulse else np.inf)
    if found < _DOUBTFUL * noise:
        # Blows that come every few windows pass for noise in most of them, and hide one another.
        calmer = _searched([first.with_signature(each, _CALMEST) for each in choices])
        less = _noise(calmer[0])
        if less < _CLEARLY * noise:
            (search, detected), noise = calmer, less
    place, adrift, jump, error = (
        np.array([[one.place, one.adrift, one.sizes[0], one.error] for one in detected]).reshape(-1, 4).T
    )
    largest = float(abs(jump).max(initial=0.0))
    threshold = search.least_sure(noise, largest)
    clear = abs(jump) > max(SIGMAS * noise, RANGE * largest)
    if pulse is not None:
        # One that is hardly seen may pass for one on the other wall.
        clear, threshold = abs(jump) > threshold, threshold + CERTAINTY * noise
    unread = (start + np.array(runs_of(~good), dtype=float).reshape(-1, 2)) / rec.rate
    entangled = search.entangled()
    unresolved = ((place[:, None] >= entangled[:, 0]) & (place[:, None] < entangled[:, 1])).any(axis=1)
    clear &= ~unresolved
    resolution, lasts = search.resolution() / rate, 0.0 if pulse is None else pulse.duration
    ringing = (search.signature.reach + search.signature.ring) / rate
    if pulse is not None:
        clear &= ~_left_over(place / rate, jump, resolution + RELEASED * lasts, ringing)
        others = _largest_beside(place / rate, jump, ringing)
        error = np.hypot(error, _MISFIT * others)
        adrift = np.hypot(adrift, (_LATE * pulse.width * rate + _BETWEEN) * others / abs(jump))
    place, adrift, jump, error = (each[clear] for each in (place, adrift, jump, error))
    # The mean of readings stands at the last of them.
    place, entangled = ((each + 1.0) * together - 1.0 for each in (place, entangled))
    return Impacts(
        info.name,
        (start + place) / rec.rate - info.delay,
        adrift / rate,
        jump,
        error,
        _acceleration(_without_high_pass(filled, info), place, info, lasts),
        noise,
        resolution,
        ringing,
        threshold,
        lasts,
        float(search.searchable.sum()) / rate - float(np.sum(entangled[:, 1] - entangled[:, 0])) / rec.rate,
        np.concatenate([unread, (start + entangled) / rec.rate - info.delay]),
    )


def _left_over(time: Array, jump: Array, ended: float, ringing: float) -> NDArray[np.bool_]:
    """Which jumps may be what the bed's weight makes of a larger landing: it lasts longer, and ends otherwise."""
    apart, size = abs(time[:, None] - time), abs(jump)
    ends = (apart < ended) & (size[:, None] < _OF_RELEASE * size)
    return np.asarray((ends | (apart < ringing) & (size[:, None] < HIDES * size)).any(axis=1))


def _largest_beside(time: Array, jump: Array, ringing: float) -> Array:
    """Size of the largest jump so near to each, m/s; its own, if there is none."""
    near = abs(time[:, None] - time) < ringing
    return np.asarray(np.where(near, abs(jump), 0.0).max(axis=1, initial=0.0))


def _means(row: Array | NDArray[np.bool_], together: int) -> Array:
    """Means of so many samples each; what is over at the end is left out."""
    return np.asarray(row[: row.size - row.size % together].reshape(-1, together).mean(axis=1))


def _searched(searches: list[JumpSearch]) -> tuple[JumpSearch, list[Jump]]:
    """Search with the polynomial that the motion follows: which, and the jumps."""
    quiet = [search.signature.gain * float(np.median(search.noise(search.calm))) for search in searches]
    taken = 0
    for k, left in enumerate(quiet):
        if left < _CLEARLY * quiet[taken]:
            taken = k
    return searches[taken], searches[taken].run()


def _noise(search: JumpSearch) -> float:
    """Give the standard deviation of a jump's estimate where there is none, m/s: 95th percentile along a stretch."""
    return float(np.percentile(search.noise(), 95.0)) * search.signature.gain


def band(rate: float) -> tuple[float, float]:
    """Frequencies between which the motion of a damper's body is determined at a sample rate, Hz."""
    return _LOW, _HIGH * rate


def _measures_motion(rec: Recording, channel: str) -> ChannelInfo:
    """Give a channel of motion; raises `RecordingError` where it is another."""
    info = named(rec, channel)
    if info.quantity not in MOTIONS:
        raise RecordingError(
            f"channel {info.name!r} measures {info.quantity}: impacts show in motion channels only"
        )
    return info


def _good(rec: Recording, name: str, samples: Array, start: int, ring: int) -> NDArray[np.bool_]:
    """Where samples of a channel measure its motion: neither lost nor overloaded, nor ringing after that."""
    good = np.isfinite(samples)
    for marker in rec.overloads:
        if marker.fields.get("channel") == name:
            # What follows is ringing whose beginning is not known.
            good[max(marker.first_sample - start, 0) : max(marker.end + 1 + ring - start, 0)] = False
    return good


def _blind(info: ChannelInfo) -> bool:
    """Whether a pulse of acceleration between two samples goes unseen."""
    spread = info.average or info.filter or len(info.poles) > len(info.zeros)
    return info.quantity == "acceleration" and not spread


def _without_high_pass(samples: Array, info: ChannelInfo) -> Array:
    """Undo the high passes that integrators need: they turn slow motion. What is fast stays as read, and short."""
    zeros, poles = (
        tuple(root for root in roots if abs(root) < info.rate) for roots in (info.zeros, info.poles)
    )
    slow = replace(info, zeros=zeros, poles=poles, gain=1.0, average=False, filter={}, delay=0.0)
    return corrected(slow, samples, info.quantity, band(info.rate)[0], info.rate)


def _acceleration(samples: Array, places: Array, info: ChannelInfo, lasts: float) -> Array:
    """Acceleration at jumps at places in samples: a polynomial through what is around, across the jump.

    That is left out for as long as it lasts, s.
    """
    order = 2 - MOTIONS.index(info.quantity)
    # What the sensor rings on for is left out; and the average over an interval belongs to its middle.
    slowest = min((-pole.real for pole in info.poles if abs(pole) > info.rate), default=np.inf)
    gap = 2 + int(np.ceil(_RUNG_OUT * info.rate / slowest + lasts * info.rate))
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
def _signature(metadata: str, curvature: int, pulse: Pulse | None, together: int) -> Signature:
    from daq.signal_chain.channel import ChannelInfo

    return signature(ChannelInfo.from_metadata(json.loads(metadata)), curvature, pulse, together)


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
