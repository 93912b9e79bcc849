"""Spectra of a long segment, computed only at low frequencies, because most tests excite a small part of the band.

Higher frequencies are removed by a low-pass filter before decimation, and the spectrum is divided by the filter's
response (Crochiere and Rabiner, Multirate Digital Signal Processing, 1983, chapter 2). The memory is nearly independent
of the duration of the recording; the computation takes about as long as reading the samples.
"""

from collections.abc import Sequence

import numpy as np
import scipy
from scipy import fft

from analysis.core.recordings.slices import PIECE_SAMPLES
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.numerics.memory import require_memory_with_program

# The result extends up to this fraction of the decimated sample rate: the pass band of a filter of `_FILTER_LENGTH`.
_MAX_FREQUENCY_RATIO = 0.15
# Length of the low-pass filter in samples of the decimated rate.
_FILTER_LENGTH = 24
# Parameter of the Kaiser window of the filter: 0.1102 (A - 8.7) for an attenuation A of 240 dB, so that
# aliasing is below the rounding of a spectrum.
_KAISER_BETA = 25.5
# Maximum number of multiplications of a matrix product that BLAS computes in a single thread, without overhead.
_MAX_MULTIPLICATIONS = 1 << 18
# Number of values of a group of channels that are in memory at a time, unless a single channel has more.
_MAX_ELEMENTS = 1 << 24
# Number of copies of the spectra that are in memory at a time: those of a group, and the result.
_COPIES = 2


def low_spectra(
    rec: Recording, names: Sequence[str], start: int, stop: int, size: int, bins: int
) -> tuple[ComplexArray, Array]:
    """Compute spectra and variances of a segment without lost or overloaded samples, about the mean of each channel.

    The spectra, shape (channels, bins), equal the first bins of `numpy.fft.rfft` of the segment with zeros in front, up
    to `size` samples. The variances have the shape (channels,).
    """
    require_memory_with_program(
        _COPIES * 16 * bins * len(names), f"{rec.path}: the spectra of {len(names)} channels (`response` selects fewer)"
    )
    spectra, squares = np.empty((len(names), bins), dtype=complex), np.empty(len(names))
    decimation = _decimation(size, bins)
    # Decimated samples, and values of a piece: samples, deviations, and three copies of the partial sums of the filter.
    piece = min(PIECE_SAMPLES, size) * (2 + 3 * _FILTER_LENGTH / decimation)
    step = max(1, int(_MAX_ELEMENTS / max(size / decimation, piece)))
    for first in range(0, len(names), step):
        group = slice(first, first + step)
        spectra[group], squares[group] = _spectra_of_group(rec, names[group], start, stop, size, bins)
    return spectra, squares


def _spectra_of_group(
    rec: Recording, names: Sequence[str], start: int, stop: int, size: int, bins: int
) -> tuple[ComplexArray, Array]:
    """Compute the result of `low_spectra` for channels whose samples are in memory at a time."""
    decimation = _decimation(size, bins)
    taps = np.ones((1, 1))
    if decimation > 1:
        taps = scipy.signal.firwin(_FILTER_LENGTH * decimation, 1.0 / decimation, window=("kaiser", _KAISER_BETA))
    polyphase_filters = taps.reshape(-1, decimation).T
    n_rows = max(1, _MAX_MULTIPLICATIONS // polyphase_filters.size)
    # The transform is periodic, so the filter's output beyond the ends is added at the other end.
    n_taps, padding = polyphase_filters.shape[1], size - (stop - start)
    piece_samples = max(1, PIECE_SAMPLES // decimation) * decimation
    filtered = np.zeros((len(names), n_taps + size // decimation))
    total, squares = np.zeros((2, len(names)))
    # Squares are relative to the first sample: rounding errors of a large offset would hide the variation.
    offset = np.array([rec.read(name, start, start + 1)[0] for name in names])
    for first in range(padding // decimation * decimation, size, piece_samples):
        block = np.zeros((len(names), min(piece_samples, size - first)))
        begin, end = max(first, padding), first + block.shape[1]
        for row, name in enumerate(names):
            block[row, begin - first :] = rec.read(name, begin - padding + start, end - padding + start)
        total += block.sum(axis=1)
        deviation = block[:, begin - first :] - offset[:, None]
        squares += np.einsum("cn,cn->c", deviation, deviation)
        rows = np.arange(0, block.shape[1] // decimation, n_rows)
        frames = np.split(block.reshape(len(names), -1, decimation), rows[1:], axis=1)
        outputs = np.concatenate([frame @ polyphase_filters for frame in frames], axis=1)
        for k in range(n_taps):
            column = n_taps + first // decimation - k
            filtered[:, column : column + outputs.shape[1]] += outputs[:, :, k]
    filtered[:, -n_taps:] += filtered[:, :n_taps]
    exponent = -2j * np.pi / size * np.arange(bins)
    filter_response = np.conj(scipy.signal.zoom_fft(taps.ravel(), [0, bins], m=bins, fs=size)) / decimation
    spectra = fft.rfft(filtered[:, n_taps:], axis=1)[:, :bins] / filter_response
    # The mean is subtracted from the segment, but not from the zeros before the segment.
    mean = total / (stop - start)
    spectra[:, 0] = 0.0
    spectra[:, 1:] += mean[:, None] * (np.expm1(padding * exponent[1:]) / np.expm1(exponent[1:]))
    return spectra, np.maximum(squares / (stop - start) - (mean - offset) ** 2, 0.0)


def _decimation(size: int, bins: int) -> int:
    """Return the largest ratio of sample rates that divides `size` and retains a number of bins."""
    largest = max(1, int(_MAX_FREQUENCY_RATIO * size / bins))
    return max(divisor for divisor in range(1, largest + 1) if size % divisor == 0)
