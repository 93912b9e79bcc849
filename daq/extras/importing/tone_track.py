"""Track of the strongest tone of a reference channel, block by block: frequency, phase, amplitude, and ratios to it.

The frequency is interpolated between the lines of a Hann-windowed spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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
LENGTH_RATIO = 2**0.5
# The bands overlap by this factor, so no tone lies between two bands.
_BAND_OVERLAP = 1.1


@dataclass(frozen=True)
class Track:
    """The blocks of one length that resolve the strongest tone of the reference."""

    hop: int  # samples from one block to the next; a block consists of `HOPS_PER_BLOCK` hops
    number: NDArray[np.int64]  # Numbers of the blocks, from 0
    frequency: Array  # Approximate frequency of the tone in each block, periods per hop
    phase: Array  # Phase at the middle of each block, unwrapped between successive blocks by their frequency [rad]
    amplitude: Array  # Amplitude in each block, in the unit of the reference
    ratio: ComplexArray  # Complex ratio of every channel to the reference, shape (channels, blocks)
    levels: NDArray[np.float32]  # rms of the reference about its mean in all blocks, even without a tone

    @property
    def first_sample(self) -> int:
        """Sample in the middle of the first block; its first half may still contain the previous tone."""
        return int((self.number[0] + HOPS_PER_BLOCK / 2) * self.hop)

    @property
    def stop_sample(self) -> int:
        """Sample in the middle of the last block."""
        return int((self.number[-1] + HOPS_PER_BLOCK / 2) * self.hop)

    def part(self, first: int, stop: int | None = None) -> Track:
        """Return the blocks from the position `first` to before `stop`."""
        blocks = slice(first, stop)
        values = {
            name: getattr(self, name)[..., blocks] for name in ("number", "frequency", "phase", "amplitude", "ratio")
        }
        return replace(self, **values)


class ToneTracker:
    """Computes the track of blocks of one length, for tones from `low` to `low` times `LENGTH_RATIO` [Hz].

    A block contains four to six periods of these tones. Its samples are averaged in small groups. `rate` is in Hz;
    `channels` is the number of channels, `reference` the index of the reference channel.
    """

    def __init__(self, rate: float, low: float, channels: int, reference: int) -> None:
        self._reference = reference
        self._samples_per_average = max(1, int(rate / (_AVERAGES_PER_HOP * low)))
        self._hop = max(_AVERAGES_PER_HOP // 2, round(rate / (low * self._samples_per_average)))
        self._size = HOPS_PER_BLOCK * self._hop
        # Spectral lines of a block per Hz.
        lines_per_hz = self._size * self._samples_per_average / rate
        self._lowest_line = low / _BAND_OVERLAP * lines_per_hz
        self._highest_line = low * LENGTH_RATIO * _BAND_OVERLAP * lines_per_hz
        # The samples that are not yet averaged, and the averages that begin the next block.
        self._unaveraged = self._averages = np.empty((channels, 0))
        self._n_blocks = 0
        self._levels = [np.empty(0, np.float32)]
        no_tone = (np.empty(0, np.int64), *(np.empty(0),) * 3, np.empty((channels, 0), complex))
        self._tones: list[tuple[NDArray[np.int64], Array, Array, Array, ComplexArray]] = [no_tone]

    def add(self, samples: Array) -> None:
        """Add the next samples of all channels, shape (channels, samples); lost samples are NaN."""
        unaveraged = np.concatenate([self._unaveraged, samples], axis=1)
        stop = unaveraged.shape[1] // self._samples_per_average * self._samples_per_average
        self._unaveraged = unaveraged[:, stop:].copy()
        averages = unaveraged[:, :stop].reshape(len(samples), -1, self._samples_per_average).mean(axis=2)
        averages = np.concatenate([self._averages, averages], axis=1)
        if averages.shape[1] >= self._size:
            blocks = np.lib.stride_tricks.sliding_window_view(averages, self._size, axis=1)[:, :: self._hop]
            self._analyze(blocks)
            self._n_blocks += blocks.shape[1]
            averages = averages[:, blocks.shape[1] * self._hop :].copy()
        self._averages = averages

    def _analyze(self, blocks: Array) -> None:
        """Add the tones and levels of blocks, shape (channels, blocks, samples)."""
        reference, window = blocks[self._reference], np.hanning(self._size + 1)[:-1]
        self._levels.append(np.nan_to_num(reference.std(axis=1)).astype(np.float32))
        magnitude = np.asarray(np.nan_to_num(abs(np.fft.rfft(reference * window, axis=1))), dtype=float)
        # The first two spectral lines contain the mean of the block, so the search begins after them.
        peak = np.argmax(magnitude[:, 2:-1], axis=1) + 2
        # Distance of the tone from the highest line, in lines, by interpolation for a Hann window: (2 r - 1) / (r + 1)
        # with the ratio r of the higher neighbor to the highest line (T. Grandke, IEEE Trans. Instrum. Meas. 32 (1983)
        # 350-355).
        below, peak_magnitude, above = (magnitude[np.arange(peak.size), peak + k] for k in (-1, 0, 1))
        neighbor_ratio = np.maximum(below, above) / np.maximum(peak_magnitude, 1e-300)
        direction = np.where(above > below, 1.0, -1.0)
        offset = np.asarray(direction * np.clip((2 * neighbor_ratio - 1) / (neighbor_ratio + 1), 0.0, 0.5))
        line = peak + offset
        resolved = np.flatnonzero((peak_magnitude > 0.0) & (line >= self._lowest_line) & (line < self._highest_line))
        peak, offset = peak[resolved], offset[resolved]
        spectra = np.fft.rfft(blocks[:, resolved] * window, axis=2)[:, np.arange(peak.size), peak]
        gain = 0.25 * self._size * np.sinc(offset) / (1.0 - offset**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = spectra / spectra[self._reference]
        # Phases refer to the middle of the block, where they are the same at each line around the tone.
        phase = np.angle(spectra[self._reference] * (-1.0) ** peak)
        number, frequency = self._n_blocks + resolved, line[resolved] / HOPS_PER_BLOCK
        self._tones.append((number, frequency, phase, peak_magnitude[resolved] / gain, ratio))

    def track(self) -> Track:
        """Return the track of the samples so far."""
        number, frequency, phase, amplitude, ratio = (
            np.concatenate(parts, axis=-1) for parts in zip(*self._tones, strict=True)
        )
        periods = (frequency[1:] + frequency[:-1]) / 2.0 - np.diff(phase) / (2.0 * np.pi)
        phase[1:] += 2.0 * np.pi * np.cumsum(np.round(periods))
        hop = self._hop * self._samples_per_average
        return Track(hop, number, frequency, phase, amplitude, ratio, np.concatenate(self._levels))
