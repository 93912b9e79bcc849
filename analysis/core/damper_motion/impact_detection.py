"""Detection of damper impacts in a motion channel.

An impact is an instantaneous velocity jump of the damper's body or, with *finite-duration contact*, the velocity change
by a force pulse, which ends at the *release*.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.core.damper_motion.impact_model import impact_models
from analysis.core.damper_motion.landing_pulse import Pulse, landing_pulse
from analysis.core.damper_motion.matching_pursuit import (
    DETECTION_MARGIN_SIGMAS,
    DETECTION_SIGMAS,
    MODEL_ERROR,
    NOISE_QUANTILE,
    NOISE_REDUCTION,
    RESIDUAL_RATIO,
    MatchingPursuit,
)
from analysis.core.decays.sensor_correction import correct_motion
from analysis.core.recordings.slices import interpolated
from analysis.core.responses.measurands import find_channel
from daq.core.recording.recording import Recording
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError
from rig.core.base.renamed import renamed
from rig.core.numerics.runs import runs_of
from rig.core.results.response import MOTIONS

# Smallest valid fraction of a segment's samples; with fewer, more than half of the impacts would be missed.
_MIN_VALID_RATIO = 0.5
# Longest contact in nominal contact durations: gravity on the bed delays the release.
RELEASE_DURATIONS = 1.6
# A jump after an impact may be its release if it is below this fraction of the impact.
_MAX_RELEASE_RATIO = 0.5
# A jump after a finite-duration impact, below this fraction of it, may be a residual of its fit: the sensor rings.
_CONTACT_RESIDUAL_RATIO = 0.15
# Standard uncertainty of a finite-duration jump due to the model, relative to the largest impact near it.
_CONTACT_JUMP_UNCERTAINTY = 0.03
# Standard uncertainty of the time due to the largest impact nearby, relative to the time to 90 % of the pulse.
_CONTACT_TIME_UNCERTAINTY = 0.04
# Additional standard uncertainty of the time due to the same impact, relative to a sample interval.
_CONTACT_SAMPLE_UNCERTAINTY = 0.05
# Number of samples until 90 % of an impact pulse; at higher rates, samples are averaged: more do not improve the fit.
_PULSE_SAMPLES = 8
# Lowest frequency of the band in which the motion of a body is determined, below the modes of most structures.
_LOW_HZ = 2.0
# Highest frequency of the band in which the motion is determined, relative to the sample rate: below the transition
# band of converters.
_HIGH_RATE_RATIO = 0.4
# Time on either side of an impact whose samples determine the polynomial for the acceleration at the impact.
_SIDE_TIME_S = 2e-3
# Minimum number of samples on either side: two for each coefficient of the polynomial.
_MIN_SIDE_SAMPLES = 8
# Order of the polynomial.
_SIDE_ORDER = 3
# After the impact, this number of decay times of the sensor resonance is skipped: it has decayed to exp(-4) = 2 %.
_DECAY_TIMES = 4.0
# If no jump exceeds this multiple of the noise, frequent impacts may have raised the noise estimate.
_UNCERTAIN_SIGMAS = 40.0
# Quantile of the jump filter's output from which the noise is then estimated again.
_LOW_NOISE_QUANTILE = 0.1


@dataclass(frozen=True)
class Impacts:
    """Impacts detected in one channel."""

    channel: str
    time: Array
    """Times of the impacts after sample 0, s; shape (n,)."""
    time_std: Array
    """Standard uncertainty of `time` [s]; shape (n,). For finite-duration contact it includes the uncertain release and
    the effect of larger impacts nearby.
    """
    jump: Array
    """Velocity jump of the body [m/s]: negative at the floor, positive at the ceiling; shape (n,). The impulse is the
    jump times the mass of the body. For finite-duration contact the estimated jump is proportional to the contact
    duration of the scene.
    """
    jump_std: Array
    """Standard uncertainty of `jump` [m/s] without the tolerance of the sensor's sensitivity; shape (n,)."""
    acceleration: Array
    """Smooth acceleration of the body at the impact [m/s²]; NaN too close to the ends of the segment; shape (n,)."""
    noise: float
    """Standard deviation of the estimated jump where there is no impact [m/s]: 95th percentile over the segment."""
    resolution: float
    """Shortest interval between two impacts that the channel resolves [s]."""
    ringing: float
    """Time for which the channel rings around an impact [s]. A second impact within this time may be missed if it is
    below `masked_share` of the first impact.
    """
    detection_limit: float
    """Smallest jump that is reliably detected [m/s]; higher near a larger impact (see `ringing`)."""
    contact_duration: float
    """Duration of contact in an impact [s]; 0: instantaneous. A jump after a finite-duration impact may be the release
    of this impact.
    """
    searched_duration: float
    """Duration of the segment without its ends and without `unsearched` [s]."""
    unsearched: Array
    """Start and end of intervals without detection [s]; shape (m, 2): samples are lost or overloaded, or impacts are
    too closely spaced to be resolved."""

    time_error = renamed("time_error", "time_std")
    jump_error = renamed("jump_error", "jump_std")

    @property
    def min_interval(self) -> float:
        """Time interval [s] within which several impacts may be detected as one impact."""
        return self.resolution + RELEASE_DURATIONS * self.contact_duration

    @property
    def masked_share(self) -> float:
        """Fraction of a previous impact below which an impact may be missed while the channel still rings."""
        return _CONTACT_RESIDUAL_RATIO if self.contact_duration else RESIDUAL_RATIO

    @property
    def wall(self) -> NDArray[np.str_]:
        """``"floor"`` or ``"ceiling"``, from the direction of the jump."""
        return np.where(self.jump < 0, "floor", "ceiling")


def detect_impacts(
    rec: Recording, channel: str, start: int = 0, stop: int | None = None, samples: Array | None = None
) -> Impacts:
    """Detect impacts in a segment of one channel.

    The channel's response to a velocity jump is computed from its data sheet, including sensor resonance, integrator,
    averaging and decimation. At every sample, four contributions are fitted by least squares: this response, a step and
    a slope change of the acceleration, and a smooth motion. Step and slope change accompany impacts on the body and on
    its neighbors. An impact is detected if the jump exceeds `DETECTION_SIGMAS` standard deviations. The impact is
    subtracted, and the search is repeated (orthogonal matching pursuit). Overlapping impacts are fitted jointly. For
    finite-duration contact, the pulse shape of the scene's spring-dashpot contact replaces the jump, and times are the
    instants of first contact.

    `channel`: acceleration, velocity or displacement channel on a body; `start`, `stop`: first and one-past-last
    sample; `samples`: samples of the segment, if already read. Raises `RecordingError` if the channel measures no
    motion or does not respond to impacts, or if the segment is too short, damaged or zero. The error is also raised if
    the body contains grains, or dampers with different contact durations.
    """
    info, pulse, decimation = _impact_channel(rec, channel)
    stop = rec.samples if stop is None else min(stop, rec.samples)
    models = impact_models(info, pulse, decimation)
    min_samples = 4 * models[0].min_separation * decimation
    if stop - start < min_samples:
        raise RecordingError(
            f"{info.name}: {stop - start} samples are too few to distinguish impacts from noise. Choose a segment of "
            f"at least {min_samples} samples, or measure for longer."
        )
    if samples is None:
        samples = rec.read(info.name, start, stop)
    valid_samples = _valid_samples(rec, info.name, samples, start, models[0].settling_samples * decimation)
    if np.sum(valid_samples) < max(min_samples, _MIN_VALID_RATIO * valid_samples.size):
        raise RecordingError(
            f"{info.name}: only {np.sum(valid_samples)} of {valid_samples.size} samples in this segment are usable; "
            "the others are lost or overloaded. Choose another segment, or record at a lower level or with a larger "
            "converter range."
        )
    if not valid_samples.all():
        samples = interpolated(samples, valid_samples)
    # Constant readings have quantization noise too.
    quantization_noise = 0.0 if info.volts_per_count is None else info.unit_per_count / 12.0**0.5
    noise_floor = max(quantization_noise, 1e-14 * float(abs(samples).max()))
    if noise_floor == 0.0:
        raise RecordingError(f"{info.name} reads zero throughout this segment. Check its sensor and cable.")
    rate, noise_floor = rec.rate / decimation, noise_floor / decimation**0.5
    averages, valid = _average_groups(samples, decimation), _average_groups(valid_samples, decimation) == 1.0
    search = MatchingPursuit(models, averages, valid, noise_floor, rate, NOISE_QUANTILE)
    if not search.valid.any():
        raise RecordingError(
            f"{info.name}: every part without lost or overloaded samples is shorter than {min_samples} samples. "
            "Choose another segment, or record at a lower level or with a larger converter range."
        )
    jumps = search.run()
    largest = max((abs(jump.velocity_jump) for jump in jumps), default=0.0 if pulse else np.inf)
    if largest < _UNCERTAIN_SIGMAS * search.jump_noise:
        second_search = MatchingPursuit(models, averages, valid, noise_floor, rate, _LOW_NOISE_QUANTILE)
        second_jumps = second_search.run()
        if second_search.jump_noise < NOISE_REDUCTION * search.jump_noise:
            search, jumps = second_search, second_jumps
    noise = search.jump_noise
    fitted = [(item.time, item.time_std, item.velocity_jump, item.error) for item in jumps]
    # Positions are in averaged samples here; they are converted to samples below.
    position, position_uncertainty, jump, error = np.array(fitted).reshape(-1, 4).T
    largest = float(abs(jump).max(initial=0.0))
    limit = search.detection_limit(noise, largest)
    accepted = abs(jump) > max(DETECTION_SIGMAS * noise, MODEL_ERROR * largest)
    if pulse is not None:
        # A jump below the limit may have the wrong sign.
        accepted, limit = abs(jump) > limit, limit + DETECTION_MARGIN_SIGMAS * noise
    lost = (start + np.array(runs_of(~valid_samples), dtype=float).reshape(-1, 2)) / rec.rate
    unresolved = search.unresolved()
    accepted &= ~((position[:, None] >= unresolved[:, 0]) & (position[:, None] < unresolved[:, 1])).any(axis=1)
    resolution, duration = search.resolution() / rate, 0.0 if pulse is None else pulse.duration
    ringing = (search.model.min_separation + search.model.settling_samples) / rate
    if pulse is not None:
        time = position / rate
        accepted &= ~_is_secondary(time, jump, resolution + RELEASE_DURATIONS * duration, ringing)
        largest_nearby = np.where(abs(time[:, None] - time) < ringing, abs(jump), 0.0).max(axis=1, initial=0.0)
        error = np.hypot(error, _CONTACT_JUMP_UNCERTAINTY * largest_nearby)
        added_uncertainty = _CONTACT_TIME_UNCERTAINTY * pulse.time_to_90_percent * rate + _CONTACT_SAMPLE_UNCERTAINTY
        position_uncertainty = np.hypot(position_uncertainty, added_uncertainty * largest_nearby / abs(jump))
    position, position_uncertainty, jump, error = (
        values[accepted] for values in (position, position_uncertainty, jump, error)
    )
    # The time of an average is the time of its last sample.
    position, unresolved = ((values + 1.0) * decimation - 1.0 for values in (position, unresolved))
    unresolved_duration = float(np.sum(unresolved[:, 1] - unresolved[:, 0])) / rec.rate
    return Impacts(
        channel=info.name,
        time=(start + position) / rec.rate - info.delay,
        time_std=position_uncertainty / rate,
        jump=jump,
        jump_std=error,
        acceleration=_acceleration(samples, position, info, duration) if position.size else position,
        noise=noise,
        resolution=resolution,
        ringing=ringing,
        detection_limit=limit,
        contact_duration=duration,
        searched_duration=float(search.searchable.sum()) / rate - unresolved_duration,
        unsearched=np.concatenate([lost, (start + unresolved) / rec.rate - info.delay]),
    )


def _impact_channel(rec: Recording, channel: str) -> tuple[ChannelInfo, Pulse | None, int]:
    """Return a channel that responds to impacts, the force pulse of a contact, and the samples in each average."""
    info = find_channel(rec, channel)
    if info.quantity not in MOTIONS:
        raise RecordingError(
            f"{info.name} measures {info.quantity}, but impacts show in motion channels only. Choose a channel of "
            "acceleration, velocity or displacement."
        )
    pulse = landing_pulse(rec.scene, info.at, info.rate)
    decimation = 1 if pulse is None else max(1, int(pulse.time_to_90_percent * info.rate / _PULSE_SAMPLES))
    between_samples = info.average or info.filter or len(info.poles) > len(info.zeros)
    if decimation == 1 and info.quantity == "acceleration" and not between_samples:
        raise RecordingError(
            f"{info.name}: the acceleration is sampled at instants (sampling: point), so impacts between samples leave "
            "no trace. Set converter.sampling: average, or add a filter, an integrator or a sensor resonance, "
            "and record again."
        )
    return info, pulse, decimation


def _is_secondary(time: Array, jump: Array, release_time: float, ringing: float) -> NDArray[np.bool_]:
    """Return whether each jump may be the delayed release, or the residual, of a larger impact nearby."""
    distance, magnitude = abs(time[:, None] - time), abs(jump)
    is_release = (distance < release_time) & (magnitude[:, None] < _MAX_RELEASE_RATIO * magnitude)
    is_residual = (distance < ringing) & (magnitude[:, None] < _CONTACT_RESIDUAL_RATIO * magnitude)
    return np.asarray((is_release | is_residual).any(axis=1))


def _average_groups(row: Array | NDArray[np.bool_], count: int) -> Array:
    """Average groups of `count` consecutive samples; an incomplete group at the end is dropped."""
    if count == 1:
        return np.asarray(row, dtype=np.float64)
    return np.asarray(row[: row.size - row.size % count].reshape(-1, count).mean(axis=1))


def band(rate: float) -> tuple[float, float]:
    """Return the frequency band in which the motion of a body is determined at a sample rate [Hz]."""
    return _LOW_HZ, _HIGH_RATE_RATIO * rate


def _valid_samples(rec: Recording, name: str, samples: Array, start: int, settling_samples: int) -> NDArray[np.bool_]:
    """Return whether each sample is valid: neither lost nor overloaded, and settled after an overload."""
    valid = np.isfinite(samples)
    for marker in rec.overloads:
        if marker.fields.get("channel") == name:
            # The ringing after an overload cannot be modeled, because the overload hides its beginning.
            settled = marker.end + 1 + settling_samples
            valid[max(marker.first_sample - start, 0) : max(settled - start, 0)] = False
    return valid


def _acceleration(samples: Array, impact_samples: Array, info: ChannelInfo, duration: float) -> Array:
    """Estimate the acceleration at jumps [m/s²] by a polynomial fitted to both sides; NaN too close to the ends."""
    integrations = 2 - MOTIONS.index(info.quantity)
    # The high-pass filters of integrators distort slow motion, so their slow poles and zeros are corrected.
    zeros, poles = (tuple(root for root in roots if abs(root) < info.rate) for roots in (info.zeros, info.poles))
    without_fast_poles = replace(info, zeros=zeros, poles=poles, gain=1.0, average=False, filter={}, delay=0.0)
    samples = correct_motion(without_fast_poles, samples, info.quantity, _LOW_HZ, info.rate)
    # Samples during which the sensor rings are excluded. The average over an interval is assigned to its middle.
    decay_rate = min((-pole.real for pole in info.poles if abs(pole) > info.rate), default=np.inf)
    excluded = 2 + int(np.ceil(_DECAY_TIMES * info.rate / decay_rate + duration * info.rate))
    side = max(_MIN_SIDE_SAMPLES, round(_SIDE_TIME_S * info.rate))  # number of samples on each side
    acceleration = np.full(impact_samples.size, np.nan)
    jump_sample = np.floor(impact_samples).astype(np.intp)
    evaluable = (jump_sample >= side) & (jump_sample + excluded + side <= samples.size)
    offsets = np.concatenate([np.arange(-side, 0), np.arange(excluded, excluded + side)])
    indices = jump_sample[evaluable, None] + offsets
    time = (indices - impact_samples[evaluable, None] - 0.5 * info.average) / (side + excluded)
    columns = [time**power for power in range(integrations + _SIDE_ORDER + 1)]
    if integrations:
        # The regressor of the jump of the velocity, or of the slope change of the displacement.
        columns.append(np.maximum(time, 0.0) ** (integrations - 1) * (time > 0))
    basis, factor = np.linalg.qr(np.stack(columns, axis=2))
    coefficients = np.linalg.solve(factor, basis.mT @ samples[indices, None])[:, integrations, 0]
    # The acceleration is the derivative of this order at the impact: the coefficient times the factorial.
    factorial = (1.0, 1.0, 2.0)[integrations]
    acceleration[evaluable] = coefficients * factorial * (info.rate / (side + excluded)) ** integrations
    return acceleration
