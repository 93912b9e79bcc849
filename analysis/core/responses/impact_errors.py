"""Errors of the force and the gains in impact tests due to noise, rounding and sampling jitter."""

from collections.abc import Iterable, Sequence

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import fft

from analysis.core.responses.errors.systematic import quantization_steps, reproducible_rounding
from analysis.core.responses.force_pulse import samples_after_impact
from analysis.core.responses.hammer_impacts import PRE_IMPACT_S, HammerImpacts
from analysis.core.responses.local_models.local_rational import ORDER
from analysis.core.responses.local_models.local_spectra import FIT_HALF_WIDTH
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray

# Number of sections of the force window with independent noise.
_NOISE_SECTIONS = 16
# The readings are rounded again to coarser steps, to estimate the effect of rounding: step in counts, and mean square
# of the change, relative to that of the original rounding error (1/12 count²).
_COARSER_CONVERTERS = ((2.0, 6.0), (3.0, 8.0))
# Signals below this number of counts are rounded again only if they contain noise, which acts as dither.
_MIN_COUNTS = 6.0
# Largest fraction of the rounding error that is equal in all impacts, if noise dithers the signal: that of noise with
# a standard deviation of half a count, exp(-2 pi² 0.5²).
_MAX_REPRODUCIBLE = 0.007

# Order of a polynomial that is as flexible as the fitted ratio of two polynomials: the sum of their orders.
_FIT_ORDER = 2 * ORDER


def force_noise(
    impacts: HammerImpacts, rec: Recording, segments: Sequence[tuple[int, int]], frequency: Array
) -> ComplexArray:
    """Compute the relative change of the force due to noise during the impacts, shape (lines, sections).

    The force window is divided into successive sections. The noise of each section is multiplied by an independent
    normal coefficient of variance 1. The noise of a short window changes slowly from line to line, so the scatter
    between lines does not show it. Over a peak it changes nevertheless, and therefore shifts a pole.
    """
    info = rec.channels[impacts.channel]
    n_after, n_taper = samples_after_impact(info)
    # The taper counts as half of its length, because it reduces the noise power to about a half.
    n_window = n_after + n_taper // 2 + 1
    longest = max((end + n_window - begin for span in segments for begin, end in impacts.inside(*span)), default=0)
    power, noise, total = np.zeros(frequency.size), [], np.zeros(frequency.size, dtype=complex)
    phases = np.exp(-2j * np.pi / rec.rate * frequency[:, None] * np.arange(longest))
    # Rounding adds 1/12 count² even if it is not visible before the impact.
    rounding_variance = 0.0 if info.volts_per_count is None else info.unit_per_count**2 / 12.0
    for start, stop in segments:
        for begin, end in impacts.inside(start, stop):
            before = rec.read(impacts.channel, max(start, begin - int(PRE_IMPACT_S * rec.rate)), begin)
            pulse = rec.read(impacts.channel, begin, end + 1)
            spectrum = phases[:, : pulse.size] @ (pulse - before.mean() if before.size else pulse)
            power, total = power + abs(spectrum) ** 2, total + spectrum
            if before.size > 2:
                # Differences between samples are insensitive to the tail of an earlier impact.
                variance = max(float(np.mean(np.diff(before) ** 2)) / 2.0, rounding_variance)
                noise.append((end + n_window - begin) * variance)
    n_sections = min(longest, _NOISE_SECTIONS)
    if not noise or not n_sections:
        return np.zeros((frequency.size, 1), dtype=complex)
    size = np.sqrt(float(np.mean(noise)) / n_sections / np.maximum(power, 1e-300))
    centers = (np.arange(n_sections) + 0.5) * longest / n_sections - 0.5
    shifts = np.exp(-2j * np.pi / rec.rate * frequency[:, None] * centers)
    return np.asarray((size * np.exp(-1j * np.angle(total)))[:, None] * shifts)


def rounding_gain_error(
    impacts: HammerImpacts,
    rec: Recording,
    names: Sequence[str],
    segments: Sequence[tuple[int, int]],
    readings: Iterable[tuple[Array, ComplexArray]],
    lines: NDArray[np.int64],
    half_width: int,
) -> Array:
    """Compute the maximum relative change of each channel's gain due to rounding, shape (channels, lines).

    Equal impacts give equal counts, so averaging does not reduce the rounding error. Rounding errors shortly after
    an impact resemble a response, and are not visible in the scatter. The error is estimated from the change of the
    readings when they are rounded again, to every second and every third count (coarser converters). Noise of s
    counts reduces the error by ``exp(-2 pi^2 s^2)`` (as in `noise_gain_error`). The result is infinite for readings
    of too few counts to be rounded again.

    `readings`: readings and their spectra for each of `segments`; `lines`: bins of the result;
    `half_width`: bins on either side of a line that a local fit uses.
    """
    steps = quantization_steps(rec, names)[:, None]
    step = np.where(steps > 0.0, steps, 1.0)
    # Summed power spectra of errors that end `n_after_impact` samples after impacts: a short transform suffices.
    errors, noise, max_counts = [np.zeros((1, 1)) for _ in _COARSER_CONVERTERS], [], np.zeros(steps.shape)
    power = np.zeros((1, 1))
    for (block, spectra), (start, stop) in zip(readings, segments, strict=True):
        power = power + abs(spectra) ** 2
        n_samples = 2 * (spectra.shape[1] - 1)
        # Within this number of samples after an impact, the polynomials of a local fit represent errors as a response.
        n_after_impact = int(n_samples * (ORDER + 1) / half_width)
        n_transform = fft.next_fast_len(2 * n_after_impact, real=True)
        for begin, _ in impacts.inside(start, stop):
            first = begin - (stop - block.shape[1])
            counts = np.rint(block[:, first : first + n_after_impact] / step)
            max_counts = np.maximum(max_counts, abs(counts).max(axis=1, keepdims=True))
            for k, (coarse_step, ratio) in enumerate(_COARSER_CONVERTERS):
                added_rounding = coarse_step * np.rint(counts / coarse_step) - counts
                errors[k] = errors[k] + abs(fft.rfft(added_rounding, n_transform, axis=1)) ** 2 / ratio
            before = [rec.read(name, max(start, begin - int(PRE_IMPACT_S * rec.rate)), begin) for name in names]
            if before[0].size > 2:
                noise.append(np.mean(np.diff(before, axis=1) ** 2, axis=1, keepdims=True) / 2.0)
    reproducible = reproducible_rounding(np.mean(noise, axis=0) / step**2 if noise else np.zeros(steps.shape))
    # The spectrum of several impacts is a comb. The power is averaged over one spacing of the comb's teeth. A wider
    # average would mix the power in peaks and in valleys of the response.
    n_bins = 2 * -(-half_width // FIT_HALF_WIDTH) + 1  # rounded up
    mean_power = scipy.ndimage.uniform_filter1d(power, n_bins, axis=1, mode="nearest")
    mean_errors = np.max(
        [
            scipy.ndimage.uniform_filter1d(
                _longer_transform(error, n_transform, n_samples), half_width, axis=1, mode="nearest"
            )
            for error in errors
        ],
        axis=0,
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        # The squared magnitude of a complex normal error is below three times its mean with a probability of 95 %.
        gain_error = (step * np.sqrt(3.0 * mean_errors / mean_power))[:, lines]
    gain_error = np.where((max_counts < _MIN_COUNTS) & (reproducible > _MAX_REPRODUCIBLE), np.inf, gain_error)
    gain_error = np.nan_to_num(gain_error, nan=np.inf, posinf=np.inf)
    return np.asarray(np.where(steps > 0.0, reproducible * gain_error, 0.0))


def jitter_factor(
    rec: Recording, names: Sequence[str], impacts: Sequence[tuple[int, int]], size: int, half_width: int
) -> Array:
    """Compute the square-root factor of the covariance of jitter errors that resemble a response to an impact.

    A sample with a delay t has an error of t times the slope of its signal. Slopes are steepest during an impact and
    shortly after it. Errors of these samples are as smooth over the lines as the response, so the scatter does not show
    them. Each sample is weighted by its effect on a local fit to `half_width` bins on either side of a line. All
    channels have the same delay. `impacts`: first and last sample of each impact; `size`: samples of the Fourier
    transform. The result has the shape (rows, channels).
    """
    deviation_samples = (rec.scene.converter.jitter or 0.0) * rec.rate
    factor = np.zeros((0, len(names)))
    if not deviation_samples:
        return factor
    # A polynomial fit weights the samples: from the impact, weights fall to zero in this number of samples.
    n_samples = size * (_FIT_ORDER + 1) // (2 * half_width + 1)
    weights = scipy.signal.savgol_coeffs(2 * half_width + 1, _FIT_ORDER)
    cosines = np.cos(2.0 * np.pi / size * np.arange(n_samples)[:, None] * np.arange(-half_width, half_width + 1))
    sample_weights = cosines @ weights
    for begin, _ in impacts:
        readings = np.stack([rec.read(name, max(begin - 1, 0), begin + n_samples) for name in names])
        slopes = np.diff(readings, axis=1)
        slopes *= deviation_samples * sample_weights[: slopes.shape[1]]
        rows = np.concatenate([factor, slopes.T / np.sqrt(len(impacts))])
        factor = np.asarray(np.linalg.qr(rows, mode="r"))
    return factor


def _longer_transform(power: Array, size: int, new_size: int) -> Array:
    """Interpolate the power spectrum of signals of at most `size` / 2 samples to the bins for `new_size` samples."""
    correlation = fft.irfft(power, size, axis=1)
    n_lags = (size + 1) // 2
    padded = np.zeros((len(power), new_size))
    padded[:, :n_lags] = correlation[:, :n_lags]
    padded[:, new_size - n_lags + 1 :] = correlation[:, size - n_lags + 1 :]
    return np.maximum(fft.rfft(padded, axis=1).real, 0.0)
