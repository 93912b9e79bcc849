"""Track of the strongest tone of a reference channel, block by block: frequency, phase, amplitude, and ratios to it.

The frequency is interpolated between the lines of a Hann-windowed spectrum.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray

# Blocks overlap: each block begins one hop after the previous block. A hop is about one period of the lowest tone that
# the blocks resolve.
HOPS_PER_BLOCK = 4
# Number of decimated samples in a hop (each is the mean of a group of samples): enough to resolve the tone, few enough
# for fast analysis at high sample rates.
_AVERAGES_PER_HOP = 24
# Ratio of successive block lengths, and of the limits of the frequency band of each length.
_LENGTH_RATIO = 2**0.5
# The bands overlap by this factor, so no tone lies between two bands.
_BAND_OVERLAP = 1.1
# Highest frequency, as a ratio to the sample rate.
_MAX_FREQUENCY_RATIO = 0.35


@dataclass(frozen=True)
class Track:
    """The blocks of one length that resolve the strongest tone of the reference."""

    hop: int  # samples from one block to the next; a block consists of `HOPS_PER_BLOCK` hops
    number: NDArray[np.int64]  # Numbers of the blocks, from 0
    frequency: Array  # Approximate frequency of the tone in each block, periods per hop
    phase: Array  # Phase at the middle of each block [rad]
    amplitude: Array  # Amplitude in each block, in the unit of the reference
    ratio: ComplexArray  # Complex ratio of every channel to the reference, shape (channels, blocks)
    levels: NDArray[np.float32]  # rms of the reference about its mean in each block, even without a tone


class ToneTracker:
    """Tracks the tone of the channel `reference` in blocks of several lengths.

    A block contains four to six periods of the tones that it resolves: shorter blocks resolve higher tones. Its samples
    are averaged in small groups. `rate`, and the band of the tones from `low` to `high`, are in Hz.
    """

    def __init__(self, rate: float, low: float, high: float, reference: int) -> None:
        high = min(high, _MAX_FREQUENCY_RATIO * rate)
        count = max(1, int(np.ceil(np.log(max(high / low, 1.0)) / np.log(_LENGTH_RATIO))))
        self._analyzers = [_BlockAnalyzer(rate, low * _LENGTH_RATIO**k, reference) for k in range(count)]

    def add(self, samples: Array) -> None:
        """Add the next samples of all channels, shape (channels, samples); lost samples are NaN."""
        for analyzer in self._analyzers:
            analyzer.add(samples)

    def tracks(self) -> list[Track]:
        """Return the track of each block length, longest blocks first."""
        return [analyzer.track() for analyzer in self._analyzers]


def _append(waiting: Array | None, samples: Array) -> Array:
    """Append samples, shape (channels, samples), to the samples that are not yet processed."""
    return samples if waiting is None else np.concatenate([waiting, samples], axis=1)


class _BlockAnalyzer:
    """Computes the track of blocks of one length, for tones from `low` to `low` times `_LENGTH_RATIO` [Hz]."""

    def __init__(self, rate: float, low: float, reference: int) -> None:
        self._reference = reference
        self._samples_per_average = max(1, int(rate / (_AVERAGES_PER_HOP * low)))
        self._hop = max(_AVERAGES_PER_HOP // 2, round(rate / (low * self._samples_per_average)))
        self._size = HOPS_PER_BLOCK * self._hop
        # Spectral lines of a block per Hz.
        lines_per_hz = self._size * self._samples_per_average / rate
        self._lowest_line = low / _BAND_OVERLAP * lines_per_hz
        self._highest_line = low * _LENGTH_RATIO * _BAND_OVERLAP * lines_per_hz
        self._window = window = np.hanning(self._size + 1)[:-1]
        lines = np.arange(int(self._lowest_line), int(np.ceil(self._highest_line)) + 1)
        rotation = np.exp(-2j * np.pi * lines[:, None] * np.arange(self._size) / self._size)
        # Phases refer to the middle of the block, where they are the same at each line around the tone.
        self._first_line, self._kernels = int(lines[0]), window * rotation * (-1.0) ** lines[:, None]
        self._waiting_samples: Array | None = None
        self._waiting_averages: Array | None = None
        self._n_blocks = 0
        self._levels: list[NDArray[np.float32]] = []
        self._tones: list[tuple[NDArray[np.int64], Array, Array, Array, ComplexArray]] = []

    def add(self, samples: Array) -> None:
        unaveraged = _append(self._waiting_samples, samples)
        n_averages = unaveraged.shape[1] // self._samples_per_average
        stop = n_averages * self._samples_per_average
        self._waiting_samples = unaveraged[:, stop:].copy()
        averages = unaveraged[:, :stop].reshape(len(unaveraged), n_averages, self._samples_per_average).mean(axis=2)
        pending = _append(self._waiting_averages, averages)
        blocks = (pending.shape[1] - self._size) // self._hop + 1
        if blocks > 0:
            self._analyze(pending, blocks)
            self._n_blocks += blocks
            pending = pending[:, blocks * self._hop :].copy()
        self._waiting_averages = pending

    def _analyze(self, pending: Array, blocks: int) -> None:
        blocks_view = np.lib.stride_tricks.sliding_window_view(pending, self._size, axis=1)[:, :: self._hop]
        reference = blocks_view[self._reference, :blocks]
        self._levels.append(np.nan_to_num(reference.std(axis=1)).astype(np.float32))
        magnitude = np.asarray(np.nan_to_num(abs(np.fft.rfft(reference * self._window, axis=1))), dtype=float)
        # The first two spectral lines contain the mean of the block, so the search begins after them.
        peak = np.argmax(magnitude[:, 2:-1], axis=1) + 2
        rows = np.arange(blocks)
        # Distance of the tone from the highest line, in lines, by interpolation for a Hann window: (2 r - 1) / (r + 1)
        # with the ratio r of the higher neighbor to the highest line (T. Grandke, IEEE Trans. Instrum. Meas. 32 (1983)
        # 350-355).
        below, peak_magnitude, above = (magnitude[rows, peak + k] for k in (-1, 0, 1))
        neighbor_ratio = np.maximum(below, above) / np.maximum(peak_magnitude, 1e-300)
        direction = np.where(above > below, 1.0, -1.0)
        offset = np.asarray(direction * np.clip((2 * neighbor_ratio - 1) / (neighbor_ratio + 1), 0.0, 0.5))
        line = peak + offset
        resolved = np.flatnonzero((peak_magnitude > 0.0) & (line >= self._lowest_line) & (line < self._highest_line))
        if not resolved.size:
            return
        kernel_numbers = np.clip(peak[resolved] - self._first_line, 0, len(self._kernels) - 1)
        spectra = np.empty((len(pending), resolved.size), dtype=complex)
        for kernel_number in np.unique(kernel_numbers):
            selected = kernel_numbers == kernel_number
            spectra[:, selected] = blocks_view[:, resolved[selected]] @ self._kernels[kernel_number]
        reference_spectrum = spectra[self._reference]
        line_offset = offset[resolved]
        gain = 0.25 * self._size * np.sinc(line_offset) / (1.0 - line_offset**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = spectra / reference_spectrum
        number, frequency = self._n_blocks + resolved, line[resolved] / HOPS_PER_BLOCK
        amplitude = peak_magnitude[resolved] / gain
        self._tones.append((number, frequency, np.angle(reference_spectrum), amplitude, ratio))

    def track(self) -> Track:
        channels = 1 if self._waiting_averages is None else len(self._waiting_averages)
        no_tone = (np.empty(0, np.int64), *(np.empty(0),) * 3, np.empty((channels, 0), complex))
        columns = zip(no_tone, *self._tones, strict=True)
        number, frequency, phase, amplitude, ratio = (np.concatenate(parts, axis=-1) for parts in columns)
        levels = np.concatenate([np.empty(0, np.float32), *self._levels])
        return Track(self._hop * self._samples_per_average, number, frequency, phase, amplitude, ratio, levels)
