"""Envelope of one mode of a free decay, and its damping ratio and natural frequency as functions of amplitude."""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import scipy
from scipy import fft

from analysis.core.decays.band_pass import band_pass
from analysis.core.decays.overlap import NO_OVERLAP, Overlap
from analysis.core.decays.rounding import damping_error, rounding_noise
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.figure_types import Axes
from rig.core.base.renamed import renamed
from rig.core.results import Result, complete_style, format_interval, format_limited, format_quantity
from rig.core.results.uncertainty import expand

#: Largest relative difference of two spectral peaks of one mode: dampers shift a frequency during the decay.
SAME_MODE_RATIO = 0.1
# Largest relative standard uncertainty, due to noise, of a reported damping ratio: 10 % expanded is still useful.
MAX_RELATIVE_UNCERTAINTY = 0.05
# The damping ratio at an amplitude is proportional to the slope of the log envelope over 6 dB around this amplitude.
# This constant is half of the fall, in nepers. The amplitudes are 1.5 dB apart.
_HALF_FALL_NEPERS = 3.0 / 20.0 * np.log(10.0)
# The band-pass and the fit over 6 dB average a damping ratio that depends on amplitude. The bias is estimated by two
# more fits. In the first fit, the impulse response of the band-pass is longer by this factor.
_RESPONSE_RATIO = 2.0**0.5
# The second fit uses a fall of the envelope that is larger by this factor.
_FALL_RATIO = 1.5
# The bias grows with the square of the length of the impulse response if damping changes smoothly with amplitude, and
# linearly if the dependence of damping on amplitude has a slope change. In the linear case the bias is the observed
# difference times 1 / (sqrt(2) - 1), rounded up.
_RESPONSE_BIAS_FACTOR = 2.5
# Error of the slope due to a slope change in the middle of the fall, as a multiple of the parabola's rms residual.
_SLOPE_CHANGE_LIMIT_FACTOR = 8.0
# Number of neighboring amplitudes on either side that a change of damping affects.
_AFFECTED_AMPLITUDES = 2
# Maximum number of envelope points in the fit of one damping ratio: more do not reduce its uncertainty, because
# neighbors are correlated.
_MAX_POINTS = 64
# Largest change of the damping ratio of a linear mode between two amplitudes, in standard uncertainties: the largest of
# some twenty amplitudes.
_MAX_LINEAR_CHANGE = 3.0


@dataclass(frozen=True, repr=False)
class ModalDecay(Result):
    """Decay of one mode after a band-pass filter.

    Standard uncertainties include noise, rounding to counts, other modes, the bias of averaging over neighboring
    amplitudes, and the clock.
    """

    # natural frequency at the amplitude with the smallest uncertainty [Hz]; `center` if no amplitude determines it
    frequency: float
    frequency_std: float  # Hz; NaN if no amplitude determines the frequency
    center: float  # center frequency of the band-pass [Hz]: the peak of the spectrum
    time: Array  # time after the impact [s]
    envelope: Array  # amplitude of the acceleration [m/s²]
    noise: float  # noise of the band-passed acceleration, rms [m/s²]
    # acceleration amplitudes in descending order [m/s²]; noise causes a relative uncertainty below
    # `MAX_RELATIVE_UNCERTAINTY`
    amplitude: Array
    damping: Array  # damping ratio at each of `amplitudes`
    damping_std: Array
    damping_bias_limit: Array  # limit of the bias of `damping` due to averaging over neighboring amplitudes
    natural_frequency: Array  # natural frequency at each of `amplitudes` [Hz]
    natural_frequency_std: Array  # Hz

    frequency_error = renamed("frequency_error", "frequency_std")
    damping_error = renamed("damping_error", "damping_std")
    damping_smear = renamed("damping_smear", "damping_bias_limit")
    natural = renamed("natural", "natural_frequency")
    natural_error = renamed("natural_error", "natural_frequency_std")

    @property
    def is_linear(self) -> bool:
        """Whether the damping ratio is equal at all amplitudes, within its uncertainties."""
        difference = self.damping[:, None] - self.damping
        std = np.hypot(self.damping_std[:, None], self.damping_std)
        return bool(np.all(abs(difference) <= _MAX_LINEAR_CHANGE * std))

    def undetermined(self) -> Self:
        """Return the decay without the amplitudes, whose damping ratios are not those of the mode."""
        none = np.empty(0)
        return replace(
            self, frequency=self.center, frequency_std=float("nan"), amplitude=none, damping=none, damping_std=none,
            damping_bias_limit=none, natural_frequency=none, natural_frequency_std=none,
        )  # fmt: skip

    def summary(self) -> str:
        """Return the natural frequency, and the damping ratio at the largest and at small amplitudes."""
        heading = f"{self.frequency_text()}, {self.damping.size} amplitudes"
        if not self.damping.size:
            return heading
        return (
            f"{heading}, damping ratio {100 * self.damping[0]:.3g} % at {self.amplitude[0]:.3g} m/s², "
            f"{100 * self.small_damping():.3g} % at small amplitudes"
        )

    def columns(self) -> dict[str, Array]:
        """Return amplitude, damping ratio and natural frequency, with standard uncertainties."""
        return {
            "amplitude_m/s²": self.amplitude,
            "damping_ratio": self.damping,
            "damping_ratio_std": self.damping_std,
            "frequency_Hz": self.natural_frequency,
            "frequency_std_Hz": self.natural_frequency_std,
        }

    @property
    def percent(self) -> tuple[Array, Array]:
        """Damping ratio at each amplitude and its expanded uncertainty [%]."""
        return 100.0 * self.damping, 100.0 * expand(self.damping_std)

    def cells(self) -> tuple[str, ...]:
        """Write frequency, damping ratio at the largest and smallest amplitude, and noise, for a table."""
        frequency = f"{self.center:.4g}"
        if np.isfinite(self.frequency):
            frequency = format_interval(self.frequency, float(expand(self.frequency_std)))
        percent, expanded = self.percent
        ends = [
            (format_limited(percent[k], expanded[k]), f"{self.amplitude[k]:.3g}")
            if self.damping.size
            else ("too short or too noisy", "-")
            for k in (0, -1)
        ]
        return frequency, *ends[0], *ends[1], f"{self.noise:.1g}"

    def frequency_text(self) -> str:
        """Format the natural frequency with its expanded uncertainty."""
        return format_quantity(self.frequency, float(expand(self.frequency_std)), "Hz")

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the damping ratio as a function of amplitude with its expanded uncertainty."""
        percent, expanded = self.percent
        style = complete_style(style, ms=3, label=self.frequency_text())
        (line,) = ax.semilogx(self.amplitude, percent, "o-", **style)
        bounds = percent - expanded, percent + expanded
        ax.fill_between(self.amplitude, *bounds, color=line.get_color(), alpha=0.2, lw=0)
        ax.set(xlabel="amplitude / (m/s²)", ylabel="damping ratio / %")

    @property
    def decrement(self) -> Array:
        """Logarithmic decrement at each amplitude: ln of the ratio of successive maxima."""
        return 2.0 * np.pi * self.damping / np.sqrt(1.0 - np.minimum(self.damping, 0.99) ** 2)

    def small_damping(self) -> float:
        """Return the damping ratio at small amplitudes: median over the lowest third of the amplitudes."""
        count = max(1, self.damping.size // 3)
        return float(np.median(self.damping[-count:])) if self.damping.size else np.nan

    def at(self, amplitude: float) -> float:
        """Interpolate the damping ratio at an amplitude; NaN outside the measured range."""
        if not self.damping.size:
            return float("nan")
        # The amplitudes are in descending order.
        rising, damping = self.amplitude[::-1], self.damping[::-1]
        return float(np.interp(amplitude, rising, damping, left=np.nan, right=np.nan))


def spectral_peaks(acceleration: Array, rate: float, max_peaks: int | None, low: float, high: float) -> Array:
    """Return the frequencies of the `max_peaks` (None: all) highest resonances of a decay in ascending order [Hz].

    A resonance is a peak of the spectrum with a prominence of 10 dB and a height of 15 dB above the median of the band.
    Noise exceeds this height at one of a billion lines. Without noise, the median is on the flank of a mode. The
    frequency is refined by a parabola through the logarithm of three bins.
    """
    padded_length = fft.next_fast_len(4 * acceleration.size, real=True)
    taper = np.cos(np.linspace(0.0, np.pi / 2, acceleration.size)) ** 2
    magnitude_db = 20.0 * np.log10(abs(fft.rfft(acceleration * taper, padded_length)) + 1e-300)
    frequency = fft.rfftfreq(padded_length, 1.0 / rate)
    inside = (frequency >= low) & (frequency <= high)
    magnitude_db, frequency = magnitude_db[inside], frequency[inside]
    indices, _ = scipy.signal.find_peaks(magnitude_db, prominence=10.0, height=float(np.median(magnitude_db)) + 15.0)
    distinct: list[int] = []
    for peak in indices[np.argsort(magnitude_db[indices], kind="stable")[::-1]]:
        # Dampers that come to rest shift the natural frequency. This smears or splits the peak of a single mode.
        if all(abs(frequency[peak] / frequency[other] - 1.0) > SAME_MODE_RATIO for other in distinct):
            distinct.append(int(peak))
    indices = np.sort(np.array(distinct[:max_peaks], dtype=int))
    left, mid, right = magnitude_db[indices - 1], magnitude_db[indices], magnitude_db[indices + 1]
    shift = 0.5 * (left - right) / (left - 2.0 * mid + right)
    return frequency[indices] + shift * (frequency[1] - frequency[0])


def modal_decay(
    acceleration: Array,  # m/s², from before the impact
    rate: float,
    frequency: float,  # center of the band-pass [Hz]
    width: float,  # standard deviation of the band-pass [Hz]
    begin: int,  # sample at which the free decay begins
    amplitudes: Array | None = None,  # m/s²; omitted: every 1.5 dB down to the noise
    clock: float = 0.0,  # limit of the relative error of the sample rate
    overlap: Overlap = NO_OVERLAP,
    count: float = 0.0,  # size of a count of the converter; 0: analog channel [m/s²]
) -> ModalDecay:
    """Estimate the envelope of one mode, and its damping ratio as a function of amplitude.

    A Gaussian band-pass over positive frequencies yields the analytic signal directly. The band-pass multiplies an
    exponential decay by a constant factor. The slope of the envelope is therefore unbiased from three standard
    deviations of the impulse response after the impact. The damping ratio at an amplitude is the slope of the logarithm
    of the envelope while it falls by 6 dB around that amplitude.
    """
    analytic, affected = band_pass(acceleration, rate, frequency, width)
    envelope = np.abs(analytic)
    time = (np.arange(acceleration.size) - begin) / rate
    usable = slice(begin + affected, max(acceleration.size - affected, begin + affected))
    bandwidth = np.sqrt(np.pi) * width / rate
    noise = max(_noise(analytic[usable], rate, frequency, width), overlap.noise, rounding_noise(count, bandwidth))
    log_amplitudes = _log_amplitudes(envelope[usable]) if amplitudes is None else np.log(amplitudes)
    damping, natural, slope_change_limit = _damping(analytic[usable], log_amplitudes, _HALF_FALL_NEPERS)
    # Half of the noise power is in phase and changes the envelope, independently at both ends of the fall.
    amplitude = np.exp(log_amplitudes)
    noise_of_fall = np.hypot(np.exp(-_HALF_FALL_NEPERS), np.exp(_HALF_FALL_NEPERS)) * noise / np.sqrt(2.0)
    # Relative uncertainty of the damping ratio.
    noise_uncertainty = noise_of_fall / amplitude / (2.0 * _HALF_FALL_NEPERS)
    narrower, affected = band_pass(acceleration, rate, frequency, width / _RESPONSE_RATIO)
    narrower = narrower[begin + affected : max(acceleration.size - affected, begin + affected)]
    damping_narrower, natural_narrower, _ = _damping(narrower, log_amplitudes, _HALF_FALL_NEPERS)
    damping_larger_fall, natural_larger_fall, _ = _damping(
        analytic[usable], log_amplitudes, _FALL_RATIO * _HALF_FALL_NEPERS
    )
    # Subtract the residual that noise alone causes.
    slope_change_of_noise = _SLOPE_CHANGE_LIMIT_FACTOR * np.sqrt(1.5) * noise / amplitude / _HALF_FALL_NEPERS
    slope_change_limit = np.sqrt(np.maximum(slope_change_limit**2 - slope_change_of_noise**2, 0.0))
    bias = _bias_limit(damping, damping_narrower, damping_larger_fall, slope_change_limit)
    uncertainty = np.hypot(noise_uncertainty * damping, 0.5 * bias)
    # Phase [rad] and logarithm of the envelope have the same uncertainty, but the phase changes much more in a decay.
    natural_bias = np.full(natural.size, np.nan)
    # The bias is determined only if both fits are determined.
    if np.isfinite(natural_narrower - natural).any() and np.isfinite(natural_larger_fall - natural).any():
        natural_bias = _bias_limit(natural, natural_narrower, natural_larger_fall, np.zeros(natural.size))
    natural_uncertainty = np.hypot(np.hypot(noise_uncertainty * damping, 0.5 * clock) * natural, 0.5 * natural_bias)
    first, last = _fall(envelope[usable], log_amplitudes, _HALF_FALL_NEPERS)
    rate_error, frequency_error = overlap.rate_errors(amplitude, usable.start + first, usable.start + last)
    systematic = rate_error / (natural * damping) + damping_error(amplitude, _HALF_FALL_NEPERS, noise, count, bandwidth)
    uncertainty, natural_uncertainty = (
        np.hypot(uncertainty, 0.5 * systematic * damping),
        np.hypot(natural_uncertainty, 0.5 * frequency_error),
    )
    reported = np.ones(log_amplitudes.size, dtype=bool)
    if amplitudes is None:
        reported = np.isfinite(damping) & (damping > 0) & (noise_uncertainty < MAX_RELATIVE_UNCERTAINTY)
        reported &= 0.5 * systematic < MAX_RELATIVE_UNCERTAINTY
    to_hz = rate / (2.0 * np.pi)  # converts rad per sample to Hz
    natural, natural_uncertainty = to_hz * natural[reported], to_hz * natural_uncertainty[reported]
    # At small amplitudes an unresolved neighboring mode with less damping may dominate; its frequency is rejected.
    plausible = np.flatnonzero(np.isfinite(natural_uncertainty) & (abs(natural / frequency - 1.0) < SAME_MODE_RATIO))
    frequency_estimate = frequency, float("nan")
    if plausible.size:
        k = plausible[np.argmin(natural_uncertainty[plausible])]
        frequency_estimate = float(natural[k]), float(natural_uncertainty[k])
    return ModalDecay(
        *frequency_estimate, frequency, time[begin:], envelope[begin:], noise,
        amplitude[reported], damping[reported], uncertainty[reported], bias[reported], natural, natural_uncertainty,
    )  # fmt: skip


def _noise(analytic: ComplexArray, rate: float, frequency: float, width: float) -> float:
    """Estimate the noise, rms, from an exponential fit to the last quarter, where dampers are usually at rest."""
    step = max(1, int(rate / (8.0 * width)))
    last_quarter = analytic[-(analytic.size // 4) :][::step]
    if last_quarter.size < 8:
        return 0.0
    t = np.arange(last_quarter.size) * step / rate
    baseband = last_quarter * np.exp(-2j * np.pi * frequency * t)
    weight = abs(baseband)
    decay, log_amplitude = np.polyfit(t, np.log(np.maximum(weight, 1e-300)), 1, w=weight)
    rotation, angle = np.polyfit(t, np.unwrap(np.angle(baseband)), 1, w=weight)
    residual = baseband - np.exp(decay * t + log_amplitude + 1j * (rotation * t + angle))
    # The fit has four real parameters, that is two complex degrees of freedom.
    n_independent = max(t[-1] * np.sqrt(np.pi) * width, 3.0)
    return float(np.sqrt(np.mean(abs(residual) ** 2) * n_independent / (n_independent - 2.0)))


def _log_decay_envelope(envelope: Array) -> Array:
    """Return the logarithm of the largest amplitude from each sample on: it never rises, and crosses a value once."""
    return np.log(np.maximum(np.maximum.accumulate(envelope[::-1])[::-1], 1e-300))


def _log_amplitudes(envelope: Array) -> Array:
    """Return the logarithms of the amplitudes at which the damping ratio is estimated."""
    if envelope.size < 8 or envelope.max() <= 0:
        return np.empty(0)
    log_envelope = _log_decay_envelope(envelope)
    return np.arange(
        log_envelope[0] - 1.25 * _HALF_FALL_NEPERS, log_envelope[-1] + _HALF_FALL_NEPERS, -_HALF_FALL_NEPERS / 2.0
    )


def _fall(envelope: Array, log_amplitudes: Array, half_fall: float) -> tuple[Array, Array]:
    """Return the samples between which the envelope falls around each amplitude; NaN outside the decay."""
    if envelope.size < 8 or envelope.max() <= 0:
        return np.full(log_amplitudes.size, np.nan), np.full(log_amplitudes.size, np.nan)
    log_envelope = _log_decay_envelope(envelope)
    return _crossings(log_envelope, log_amplitudes + half_fall), _crossings(log_envelope, log_amplitudes - half_fall)


def _damping(analytic: ComplexArray, log_amplitudes: Array, half_fall: float) -> tuple[Array, Array, Array]:
    """Return damping ratio, natural frequency [rad/sample] (NaN outside the decay), and error due to a slope change."""
    # They are estimated from the fall of the envelope by `half_fall` nepers on either side of that amplitude.
    envelope = np.abs(analytic)
    first, last = _fall(envelope, log_amplitudes, half_fall)
    if not np.isfinite(last - first).any():
        undetermined = np.full(log_amplitudes.size, np.nan)
        return undetermined, undetermined, np.zeros(log_amplitudes.size)
    logarithm, phase = np.log(np.maximum(envelope, 1e-300)), np.unwrap(np.angle(analytic))
    sample = np.arange(envelope.size)
    phase_change = np.interp(last, sample, phase) - np.interp(first, sample, phase)
    rates = [_decay_rate(logarithm, *fall) for fall in zip(first, last, log_amplitudes, strict=True)]
    decay_rate, residual = np.array(rates).reshape(-1, 2).T
    with np.errstate(divide="ignore", invalid="ignore"):
        natural = np.hypot(phase_change / (last - first), decay_rate)
        return np.asarray(decay_rate / natural), natural, _SLOPE_CHANGE_LIMIT_FACTOR * residual / half_fall


def _decay_rate(logarithm: Array, first: float, last: float, log_amplitude: float) -> tuple[float, float]:
    """Fit a logarithmic envelope; return the decay rate in its middle [nepers per sample] and the rms residual."""
    # A straight line would yield the mean of a varying slope. Beats average out.
    if not (np.isfinite(first) and np.isfinite(last)) or last - first < 4.0:
        return float("nan"), 0.0
    samples = np.arange(round(first), round(last) + 1, max(1, int((last - first) / _MAX_POINTS)))
    middle, half_length = 0.5 * (first + last), 0.5 * (last - first)
    position = (samples - middle) / half_length
    curvature, slope, value = np.polyfit(position, logarithm[samples] - log_amplitude, 2)
    residual = logarithm[samples] - log_amplitude - (curvature * position**2 + slope * position + value)
    # Crossing of the parabola with `log_amplitude`: one Newton step from the crossing of its linear part.
    crossing = -value / slope if slope < 0 else 0.0
    slope_at_crossing = slope + 2.0 * curvature * crossing
    if slope_at_crossing < 0:
        crossing -= (value + slope * crossing + curvature * crossing**2) / slope_at_crossing
    decay_rate = float(-(slope + 2.0 * curvature * float(np.clip(crossing, -0.5, 0.5))) / half_length)
    return decay_rate, float(np.sqrt(np.mean(residual**2)))


def _bias_limit(values: Array, narrower: Array, larger_fall: Array, slope_change_limit: Array) -> Array:
    """Estimate a limit of the bias at each amplitude from the change with a narrower band-pass and a larger fall."""
    bias = np.nan_to_num(slope_change_limit * values)
    for alternative, factor in ((narrower, _RESPONSE_BIAS_FACTOR), (larger_fall, 1.0)):
        difference = abs(alternative - values)
        determined = np.flatnonzero(np.isfinite(difference))
        if determined.size:
            # At the first and last amplitudes, a larger fall is undetermined; the nearest difference is used.
            bias += factor * np.interp(np.arange(difference.size), determined, difference[determined])
    return np.asarray(scipy.ndimage.maximum_filter1d(bias, 2 * _AFFECTED_AMPLITUDES + 1) if bias.size else bias)


def _crossings(curve: Array, log_amplitudes: Array) -> Array:
    """Interpolate the sample index at which a falling curve crosses each level; NaN without a crossing."""
    after = curve.size - np.searchsorted(curve[::-1], log_amplitudes, side="left")
    inside = (after > 0) & (after < curve.size)
    after = np.clip(after, 1, curve.size - 1)
    high, low = curve[after - 1], curve[after]
    fraction = np.divide(high - log_amplitudes, high - low, out=np.zeros(log_amplitudes.shape), where=high > low)
    at_start = abs(log_amplitudes - curve[0]) <= 1e-9
    return np.where(inside, after - 1 + fraction, np.where(at_start, 0.0, np.nan))
