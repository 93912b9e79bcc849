"""Detection of damper impacts in the channels alone: each is a jump of its body's velocity, or a pulse of force."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.impact_model import impact_models
from analysis.damper_motion.landing_pulse import landing_pulse
from analysis.damper_motion.matching_pursuit import (
    CALM_SHARE,
    DETECTION_MARGIN_SIGMAS,
    DETECTION_SIGMAS,
    MODEL_ERROR,
    NOISE_REDUCTION,
    RESIDUAL_SHARE,
    MatchingPursuit,
)
from analysis.decays.sensor_correction import corrected
from analysis.responses.measurands import named
from rig.errors import RecordingError
from rig.numerics.runs import runs_of
from rig.results.response import MOTIONS

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from daq.signal_chain.channel import ChannelInfo

Array = NDArray[np.float64]

# Where less than this share of a stretch can be searched, it has no result.
_MIN_SEARCHED = 0.5
# A bed's weight delays the release of a landing: within so many durations of it, a jump below this share of it is its
# release. While it rings, a jump below this share of it is part of the residual.
RELEASE_DURATIONS = 1.6
_RELEASE_SHARE = 0.5
_CONTACT_RESIDUAL_SHARE = 0.15
# What the model of a landing of finite duration does not explain: a share of the largest one near it, which also
# displaces it by shares of the landing's width and of a sample interval.
_CONTACT_JUMP_ERROR = 0.03
_CONTACT_TIME_ERROR = 0.04
_CONTACT_SAMPLE_ERROR = 0.05
# Readings in the time of nine tenths of a landing: samples of a higher rate are averaged.
_PULSE_READINGS = 8
# Band in which a body's motion is determined: below the lowest frequency of interest, Hz; share of the sample rate.
_LOW_HZ = 2.0
_HIGH_SHARE = 0.4
# Acceleration at an impact: from so much time on either side, s, at least so many samples, after so many decay times
# of the sensor's resonance, by a polynomial of this order.
_SIDE_TIME = 2e-3
_MIN_SIDE_SAMPLES = 8
_DECAY_TIMES = 4.0
_SIDE_ORDER = 3
# Where the largest jump is below so many times the noise, the noise may be other jumps: it is estimated again from this
# share of the windows.
_UNCERTAIN_SIGMAS = 40.0
_CALMEST_SHARE = 0.1


@dataclass(frozen=True)
class Impacts:
    """Impacts detected in one channel."""

    channel: str
    time: Array
    """s after sample 0; shape (n,)."""
    time_error: Array
    """Standard deviation of `time`, s; shape (n,). Of the fit and, where contact has a duration, of what its ending and
    larger impacts near it leave open."""
    jump: Array
    """Velocity jump of the body, m/s: negative at the floor, positive at the ceiling; shape (n,). Times the body's mass
    it is the impulse. Where contact has a duration, in proportion to the duration that the scene gives it."""
    jump_error: Array
    """Standard deviation of `jump`, m/s, without the error of the sensor's sensitivity; shape (n,)."""
    acceleration: Array
    """Smooth acceleration of the body at the impact, m/s²; NaN where the stretch ends too early; shape (n,)."""
    noise: float
    """Standard deviation of a jump's estimate where there is none, m/s; where it varies, its 95th percentile."""
    resolution: float
    """Shortest interval between two impacts that the channel resolves, s."""
    ringing: float
    """Time during which the channel rings around an impact, s: an impact below `masked_share` of it may be missed."""
    threshold: float
    """Detection limit: the smallest jump that is not missed, m/s; higher near a larger impact (see `ringing`)."""
    contact_duration: float
    """Duration of a landing, s; 0: instant. After a landing of finite duration a jump may be its end."""
    searched: float
    """Length of what was searched, s: the stretch without its ends and without `left_out`."""
    left_out: Array
    """Begin and end of stretches without detection, s; shape (m, 2): samples were lost or overloaded, or impacts are
    too close to be resolved."""

    @property
    def min_interval(self) -> float:
        """Impacts closer than this may be detected as one, the largest, s."""
        return self.resolution + RELEASE_DURATIONS * self.contact_duration

    @property
    def masked_share(self) -> float:
        """Share of an impact below which another one near it may be missed."""
        return _CONTACT_RESIDUAL_SHARE if self.contact_duration else RESIDUAL_SHARE

    @property
    def kind(self) -> NDArray[np.str_]:
        """``"floor"`` or ``"ceiling"``, from the direction of the jump."""
        return np.where(self.jump < 0, "floor", "ceiling")


def impacts(
    rec: Recording, channel: str, start: int = 0, stop: int | None = None, samples: Array | None = None
) -> Impacts:
    """Detect impacts in a stretch of one channel.

    The reading of a velocity jump follows from the channel's data sheet: sensor resonance, integrator, averaging and
    decimation included. At every sample that reading, a step and a kink of the acceleration (both come with an
    impact, on the body itself and on its neighbours) and a smooth motion are fitted by least squares. An impact is
    detected where the jump exceeds `DETECTION_SIGMAS` standard deviations; it is subtracted and the search is repeated
    (orthogonal matching pursuit). Overlapping impacts are fitted jointly. Where contact has a duration, the
    spring-dashpot of the scene's contact transmits jump, step and kink; times are those of touches.

    Parameters
    ----------
    channel : str
        Channel on a body, of acceleration, velocity or displacement.
    start, stop : int
        First and one-past-last sample.
    samples : ndarray, optional
        Samples of the stretch, if the caller has read them.

    Raises
    ------
    RecordingError
        If the channel measures no motion or does not respond to impacts, the stretch is too short, damaged or zero, or
        the body contains grains, or landings of different duration.
    """
    info = _motion_channel(rec, channel)
    stop = rec.samples if stop is None else min(stop, rec.samples)
    pulse = landing_pulse(rec.scene, info.at, info.rate)
    decimation = 1 if pulse is None else max(1, int(pulse.width * info.rate / _PULSE_READINGS))
    if decimation == 1 and _misses_impacts(info):
        raise RecordingError(
            f"{info.name}: The converter samples the acceleration at instants, so that impacts between them leave "
            "no trace (sampling: point). Record with sampling: average, a filter, an integrator, a sensor "
            "resonance, or a higher rate"
        )
    models = impact_models(info, pulse, decimation)
    least = 4 * models[0].reach * decimation
    if stop - start < least:
        raise RecordingError(
            f"{stop - start} samples are too few to distinguish impacts from noise. Take at least {least}"
        )
    if samples is None:
        samples = rec.read(info.name, start, stop)
    good = _good(rec, info.name, samples, start, models[0].ring * decimation)
    if np.sum(good) < max(least, _MIN_SEARCHED * good.size):
        raise RecordingError(
            f"{info.name}: all but {np.sum(good)} of {good.size} samples in this stretch are lost or overloaded. "
            "Choose another stretch, or record at a lower level, with a larger converter range or longer contacts"
        )
    if not good.all():
        samples = np.interp(np.arange(samples.size), np.flatnonzero(good), samples[good])
    # Rounding in the converter is noise too, even where a steady reading hides it.
    rounding = 0.0 if info.volts_per_count is None else info.unit_per_count / 12.0**0.5
    floor = max(rounding, 1e-14 * float(abs(samples).max()))
    if floor == 0.0:
        raise RecordingError(f"{info.name} reads zero throughout this stretch. Check what it is connected to")
    rate, floor = rec.rate / decimation, floor / decimation**0.5
    readings, valid = _means(samples, decimation), _means(good, decimation) == 1.0
    search = MatchingPursuit(models, readings, valid, floor, rate, CALM_SHARE)
    if not search.open.any():
        raise RecordingError(
            f"{info.name}: lost or overloaded samples leave no {least} samples in a row. Choose another stretch, or "
            "record at a lower level or with a larger converter range"
        )
    jumps = search.run()
    noise = search.jump_noise
    largest = max((abs(jump.sizes[0]) for jump in jumps), default=0.0 if pulse else np.inf)
    if largest < _UNCERTAIN_SIGMAS * noise:
        # Impacts in every few windows look like noise in most of them, and mask each other.
        calmer = MatchingPursuit(models, readings, valid, floor, rate, _CALMEST_SHARE)
        calmer_jumps = calmer.run()
        if calmer.jump_noise < NOISE_REDUCTION * noise:
            search, jumps, noise = calmer, calmer_jumps, calmer.jump_noise
    place, place_error, jump, error = (
        np.array([[each.place, each.place_error, each.sizes[0], each.error] for each in jumps])
        .reshape(-1, 4)
        .T
    )
    largest = float(abs(jump).max(initial=0.0))
    threshold = search.detection_limit(noise, largest)
    clear = abs(jump) > max(DETECTION_SIGMAS * noise, MODEL_ERROR * largest)
    if pulse is not None:
        # A jump near the limit may have the wrong sign.
        clear, threshold = abs(jump) > threshold, threshold + DETECTION_MARGIN_SIGMAS * noise
    lost = (start + np.array(runs_of(~good), dtype=float).reshape(-1, 2)) / rec.rate
    unresolved = search.unresolved()
    clear &= ~((place[:, None] >= unresolved[:, 0]) & (place[:, None] < unresolved[:, 1])).any(axis=1)
    resolution, duration = search.resolution() / rate, 0.0 if pulse is None else pulse.duration
    ringing = (search.model.reach + search.model.ring) / rate
    if pulse is not None:
        time = place / rate
        clear &= ~_secondary(time, jump, resolution + RELEASE_DURATIONS * duration, ringing)
        near = np.where(abs(time[:, None] - time) < ringing, abs(jump), 0.0).max(axis=1, initial=0.0)
        error = np.hypot(error, _CONTACT_JUMP_ERROR * near)
        width = _CONTACT_TIME_ERROR * pulse.width * rate + _CONTACT_SAMPLE_ERROR
        place_error = np.hypot(place_error, width * near / abs(jump))
    place, place_error, jump, error = (each[clear] for each in (place, place_error, jump, error))
    # The time of a mean is that of its last reading.
    place, unresolved = ((each + 1.0) * decimation - 1.0 for each in (place, unresolved))
    return Impacts(
        channel=info.name,
        time=(start + place) / rec.rate - info.delay,
        time_error=place_error / rate,
        jump=jump,
        jump_error=error,
        acceleration=_acceleration(_without_high_pass(samples, info), place, info, duration)
        if place.size
        else place,
        noise=noise,
        resolution=resolution,
        ringing=ringing,
        threshold=threshold,
        contact_duration=duration,
        searched=float(search.searchable.sum()) / rate
        - float(np.sum(unresolved[:, 1] - unresolved[:, 0])) / rec.rate,
        left_out=np.concatenate([lost, (start + unresolved) / rec.rate - info.delay]),
    )


def _secondary(time: Array, jump: Array, released: float, ringing: float) -> NDArray[np.bool_]:
    """Which jumps may be the release of a larger landing, which the bed's weight delays, or its residual."""
    distance, size = abs(time[:, None] - time), abs(jump)
    ends = (distance < released) & (size[:, None] < _RELEASE_SHARE * size)
    masked = (distance < ringing) & (size[:, None] < _CONTACT_RESIDUAL_SHARE * size)
    return np.asarray((ends | masked).any(axis=1))


def _means(row: Array | NDArray[np.bool_], count: int) -> Array:
    """Means of so many samples each; the rest at the end is dropped."""
    if count == 1:
        return np.asarray(row, dtype=np.float64)
    return np.asarray(row[: row.size - row.size % count].reshape(-1, count).mean(axis=1))


def band(rate: float) -> tuple[float, float]:
    """Frequencies between which the motion of a damper's body is determined at a sample rate, Hz."""
    return _LOW_HZ, _HIGH_SHARE * rate


def _motion_channel(rec: Recording, channel: str) -> ChannelInfo:
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
            # The ringing that follows began at an unknown time.
            good[max(marker.first_sample - start, 0) : max(marker.end + 1 + ring - start, 0)] = False
    return good


def _misses_impacts(info: ChannelInfo) -> bool:
    """Whether a pulse of acceleration between two samples leaves no trace."""
    spread = info.average or info.filter or len(info.poles) > len(info.zeros)
    return info.quantity == "acceleration" and not spread


def _without_high_pass(samples: Array, info: ChannelInfo) -> Array:
    """Undo the high passes that integrators need: they distort slow motion. Fast motion stays as read."""
    zeros, poles = (
        tuple(root for root in roots if abs(root) < info.rate) for roots in (info.zeros, info.poles)
    )
    slow = replace(info, zeros=zeros, poles=poles, gain=1.0, average=False, filter={}, delay=0.0)
    return corrected(slow, samples, info.quantity, band(info.rate)[0], info.rate)


def _acceleration(samples: Array, places: Array, info: ChannelInfo, duration: float) -> Array:
    """Acceleration at jumps: a polynomial through the samples on both sides, without those during contact, s."""
    integrations = 2 - MOTIONS.index(info.quantity)
    # Samples during which the sensor rings are left out; the average over an interval belongs to its middle.
    slowest = min((-pole.real for pole in info.poles if abs(pole) > info.rate), default=np.inf)
    gap = 2 + int(np.ceil(_DECAY_TIMES * info.rate / slowest + duration * info.rate))
    side = max(_MIN_SIDE_SAMPLES, round(_SIDE_TIME * info.rate))
    out = np.full(places.size, np.nan)
    whole = np.floor(places).astype(np.intp)
    inside = np.flatnonzero((whole >= side) & (whole + gap + side <= samples.size))
    around = np.concatenate([np.arange(-side, 0), np.arange(gap, gap + side)])
    for index in inside:
        at = whole[index] + around
        time = (at - places[index] - 0.5 * info.average) / (side + gap)
        columns = [time**power for power in range(integrations + _SIDE_ORDER + 1)]
        if integrations:
            columns.append(np.maximum(time, 0.0) ** (integrations - 1) * (time > 0))
        fit = np.linalg.lstsq(np.stack(columns, axis=1), samples[at], rcond=None)[0]
        scale = (info.rate / (side + gap)) ** integrations
        out[index] = fit[integrations] * (1.0, 1.0, 2.0)[integrations] * scale
    return out


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
