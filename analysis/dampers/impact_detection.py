"""Impacts of dampers, found in the channels alone: an impact is a jump of its body's velocity."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.dampers.jump_search import RANGE, SIGMAS, JumpSearch, least_sure
from analysis.dampers.jump_signature import Signature, signature
from analysis.decays.sensor_correction import corrected
from analysis.recordings.slices import read_slices
from analysis.responses.frf import MOTIONS
from analysis.responses.measurands import named
from rig.errors import RecordingError
from rig.numerics.runs import runs_of
from rig.scene.damper import Landing, Walls

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.damper import Damper

Array = NDArray[np.float64]

# Where less than this part of a stretch can be searched, nothing is told of it.
_LEAST_SEARCHED = 0.5
# A landing of no more than this part of a sample interval is a jump.
_INSTANT = 0.25
# Below the lowest frequency of interest, Hz; up to this share of the sample rate.
_LOW, _HIGH = 2.0, 0.4
# Acceleration at an impact: from so much time on either side, s, less so many decay times of the sensor's
# resonance, by a polynomial of this order.
_AROUND, _FEWEST_AROUND, _RUNG_OUT, _BENDS = 2e-3, 8, 4.0, 3
# Orders of the polynomial the acceleration follows around a jump: a higher one is taken where it leaves clearly less.
_CURVATURES = (2, 4, 6, 8)
_CLEARLY = 0.7
# Where the largest jump is less than so many times the noise, that may be other jumps: it is then told from this part
# of the windows, those in which there is least.
_DOUBTFUL, _CALMEST = 40.0, 0.1


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
    """Impacts nearer to each other than this may be seen as one, the largest, s."""
    ringing: float
    """How long the channel rings about an impact, s: there one smaller than `LEFT_OVER` of it may be missed."""
    searched: float
    """Length of what was searched, s: the stretch without its ends and without `left_out`."""
    left_out: Array
    """Where no impact is told, begin and end of each stretch, s; shape (m, 2): samples were lost or overloaded, or
    impacts are so near to each other that no set of them explains what is seen."""

    @property
    def threshold(self) -> float:
        """Smallest jump that is not missed, m/s: the noise taken `SIGMAS` + 3 times, or a part of the largest one.

        Beside a larger one, while that rings, it is more: see `ringing`.
        """
        return least_sure(self.noise, float(abs(self.jump).max(initial=0.0)))

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
        If the channel measures no motion or is blind to blows, the stretch is too short, damaged or without any
        reading, or contact on its body lasts.
    """
    info = _sensitive(rec, channel)
    stop = rec.samples if stop is None else min(stop, rec.samples)
    choices = [_signature(json.dumps(info.to_metadata()), order) for order in _CURVATURES]
    least = 4 * max(one.reach for one in choices)
    if stop - start < least:
        raise RecordingError(
            f"{stop - start} samples are too few to tell impacts from noise: take at least {least}"
        )
    samples = next(read_slices(rec, [info.name], [(start, stop)]))[0]
    good = _good(rec, info.name, samples, start, choices[0].ring)
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
    searches = [JumpSearch(one, samples, good, floor, rec.rate) for one in choices]
    if not all(search.open.any() for search in searches):
        raise RecordingError(
            f"lost or overloaded samples leave no {least} samples of {info.name} together: choose another "
            "stretch, or record with a lower level or a larger converter range"
        )
    search, place, jump = _searched(searches)
    noise = _noise(search)
    if place.size and abs(jump).max() < _DOUBTFUL * noise:
        # Blows that come every few windows pass for noise in most of them, and hide one another.
        calmer = _searched([JumpSearch(one, samples, good, floor, rec.rate, _CALMEST) for one in choices])
        less = _noise(calmer[0])
        if less < _CLEARLY * noise:
            (search, place, jump), noise = calmer, less
    clear = abs(jump) > max(SIGMAS * noise, RANGE * float(abs(jump).max(initial=0.0)))
    unread = (start + np.array(runs_of(~good), dtype=float).reshape(-1, 2)) / rec.rate
    entangled = search.entangled()
    untold = ((place[:, None] >= entangled[:, 0]) & (place[:, None] < entangled[:, 1])).any(axis=1)
    place, jump = place[clear & ~untold], jump[clear & ~untold]
    return Impacts(
        info.name,
        (start + place) / rec.rate - info.delay,
        jump,
        _acceleration(_without_high_pass(filled, info), place, info),
        noise,
        search.resolution() / rec.rate,
        (search.signature.reach + search.signature.ring) / rec.rate,
        float(search.told.sum() - np.sum(entangled[:, 1] - entangled[:, 0])) / rec.rate,
        np.concatenate([unread, (start + entangled) / rec.rate - info.delay]),
    )


def _searched(searches: list[JumpSearch]) -> tuple[JumpSearch, Array, Array]:
    """Search with the polynomial that the motion follows: which, where in samples, and how large the jumps are, m/s."""
    quiet = [search.signature.gain * float(np.median(search.noise(search.calm)[2])) for search in searches]
    taken = 0
    for k, left in enumerate(quiet):
        if left < _CLEARLY * quiet[taken]:
            taken = k
    return searches[taken], *searches[taken].run()


def _noise(search: JumpSearch) -> float:
    """Give the standard deviation of a jump's estimate where there is none, m/s: 95th percentile along a stretch."""
    return float(np.percentile(search.noise()[2], 95.0)) * search.signature.gain


def band(rate: float) -> tuple[float, float]:
    """Frequencies between which the motion of a damper's body is told at a sample rate, Hz."""
    return _LOW, _HIGH * rate


def _sensitive(rec: Recording, channel: str) -> ChannelInfo:
    """Give a channel in which the blows on its body show; raises `RecordingError` where they do not."""
    info = named(rec, channel)
    if info.quantity not in MOTIONS:
        raise RecordingError(
            f"channel {info.name!r} measures {info.quantity}: impacts show in motion channels only"
        )
    if _blind(info):
        raise RecordingError(
            f"{info.name} takes the acceleration at instants (converter: sampling), and nothing in it spreads a blow "
            "over time: one between two instants leaves no trace; record with sampling: average, a filter, an "
            "integrator or the resonance of a sensor"
        )
    for damper in rec.scene.dampers:
        if info.at == f"body {damper.body}" and _lasts(damper, info.rate):
            raise RecordingError(
                f"{info.name}: the contact of the damper in body {damper.body} lasts (see its scene), so that "
                "its landings are no jumps of velocity and are not told from a channel; rig.frequency_response tells "
                "its motion"
            )
    return info


def _good(rec: Recording, name: str, samples: Array, start: int, ring: int) -> NDArray[np.bool_]:
    """Where samples of a channel tell its motion: neither lost nor overloaded, nor ringing after that."""
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


def _lasts(damper: Damper, rate: float) -> bool:
    """Whether a landing is seen to last: only one named by a time well within a sample interval is not."""
    if damper.grains is not None and not damper.locked:
        return True
    contact = damper.contact
    walls = (contact.floor, contact.ceiling) if isinstance(contact, Walls) else (contact,)
    longest = (
        max(wall.duration if isinstance(wall, Landing) else np.inf for wall in walls if wall)
        if contact
        else 0.0
    )
    return not damper.locked and longest * rate > _INSTANT


def _without_high_pass(samples: Array, info: ChannelInfo) -> Array:
    """Undo the high passes that integrators need: they turn slow motion. What is fast stays as read, and short."""
    zeros, poles = (
        tuple(root for root in roots if abs(root) < info.rate) for roots in (info.zeros, info.poles)
    )
    slow = replace(info, zeros=zeros, poles=poles, gain=1.0, average=False, filter={}, delay=0.0)
    return corrected(slow, samples, info.quantity, band(info.rate)[0], info.rate)


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
