"""The strongest tone of a signal, block by block: frequency, phase, amplitude, and the ratio of other channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array, ComplexArray

# Hops of a block; a hop is about one period of the lowest tone that the block resolves.
HOPS = 4
# Samples of a hop after averaging: enough for the tone, and few enough for recordings at high rates.
_SAMPLES_PER_HOP = 24
# Ratio of successive block lengths.
_LENGTH_RATIO = 2**0.5
# Ratio by which their bands overlap, so that no tone lies between two.
_BAND_OVERLAP = 1.1
# Highest frequency as a ratio to the rate.
_MAX_FREQUENCY_RATIO = 0.35


@dataclass(frozen=True)
class Track:
    """Blocks of one length that resolve the strongest tone of the reference."""

    hop: int  # Samples from one block to the next; a block is `HOPS` as long
    number: NDArray[np.int64]  # Of the blocks, from 0
    frequency: Array  # Of the tone in each block, approximately, periods per hop
    phase: Array  # At the middle of each block, rad
    amplitude: Array  # In each block, in the unit of the reference
    ratio: ComplexArray  # Every channel over the reference, (channels, blocks)
    levels: NDArray[np.float32]  # Standard deviation of the reference in each block of the signal


class ToneTracker:
    """Follows the tone of the channel `reference` in blocks of several lengths, fed piece by piece.

    Blocks with a Hann window have four to six periods of the tones that they resolve, so that higher tones are
    resolved by shorter blocks. A block is a row of averages over a few samples. `rate`, `low` and `high` (band of the
    tones) are in Hz.
    """

    def __init__(self, rate: float, low: float, high: float, reference: int) -> None:
        high = min(high, _MAX_FREQUENCY_RATIO * rate)
        count = max(1, int(np.ceil(np.log(max(high / low, 1.0)) / np.log(_LENGTH_RATIO))))
        self._lengths = [_Blocks(rate, low * _LENGTH_RATIO**k, reference) for k in range(count)]

    def add(self, samples: Array) -> None:
        """Add the next samples of all channels, shape (channels, samples); NaN where there are none."""
        for each in self._lengths:
            each.add(samples)

    def tracks(self) -> list[Track]:
        """Return the track of each length of blocks, longest first."""
        return [each.track() for each in self._lengths]


class _Blocks:
    """Blocks of one length."""

    def __init__(self, rate: float, low: float, reference: int) -> None:
        self._reference = reference
        self._averaged = max(1, int(rate / (_SAMPLES_PER_HOP * low)))
        self._hop = max(_SAMPLES_PER_HOP // 2, round(rate / (low * self._averaged)))
        self._size = HOPS * self._hop
        # A frequency in lines of a block's spectrum.
        lines = self._size * self._averaged / rate
        self._lowest, self._highest = low / _BAND_OVERLAP * lines, low * _LENGTH_RATIO * _BAND_OVERLAP * lines
        self._window = window = np.hanning(self._size + 1)[:-1]
        bins = np.arange(int(self._lowest), int(np.ceil(self._highest)) + 1)
        turn = np.exp(-2j * np.pi * bins[:, None] * np.arange(self._size) / self._size)
        # Relative to the middle of the block, so that the phase is the same at each line around the tone.
        self._first_bin, self._kernels = int(bins[0]), window * turn * (-1.0) ** bins[:, None]
        self._unaveraged: Array | None = None
        self._averages: Array | None = None
        self._n_blocks = 0
        self._levels: list[NDArray[np.float32]] = []
        self._tones: list[tuple[NDArray[np.int64], Array, Array, Array, ComplexArray]] = []

    def add(self, samples: Array) -> None:
        unaveraged = samples if self._unaveraged is None else np.concatenate([self._unaveraged, samples], axis=1)
        n_averages = unaveraged.shape[1] // self._averaged
        self._unaveraged = unaveraged[:, n_averages * self._averaged :].copy()
        averages = (
            unaveraged[:, : n_averages * self._averaged]
            .reshape(len(unaveraged), n_averages, self._averaged)
            .mean(axis=2)
        )
        pending = averages if self._averages is None else np.concatenate([self._averages, averages], axis=1)
        blocks = (pending.shape[1] - self._size) // self._hop + 1
        if blocks > 0:
            self._analyze(pending, blocks)
            self._n_blocks += blocks
            pending = pending[:, blocks * self._hop :].copy()
        self._averages = pending

    def _analyze(self, pending: Array, blocks: int) -> None:
        view = np.lib.stride_tricks.sliding_window_view(pending, self._size, axis=1)[:, :: self._hop]
        reference = view[self._reference, :blocks]
        self._levels.append(np.nan_to_num(reference.std(axis=1)).astype(np.float32))
        size = np.asarray(np.nan_to_num(abs(np.fft.rfft(reference * self._window, axis=1))), dtype=float)
        # A constant is in the first two lines.
        peak = np.argmax(size[:, 2:-1], axis=1) + 2
        rows = np.arange(blocks)
        # Distance of the tone from its highest line, in lines, by the higher neighbor under a Hann window.
        below, at, above = (size[rows, peak + k] for k in (-1, 0, 1))
        neighbor = np.maximum(below, above) / np.maximum(at, 1e-300)
        side = np.where(above > below, 1.0, -1.0)
        offset = np.asarray(side * np.clip((2 * neighbor - 1) / (neighbor + 1), 0.0, 0.5))
        line = peak + offset
        resolved = np.flatnonzero((at > 0.0) & (line >= self._lowest) & (line < self._highest))
        if not resolved.size:
            return
        bins = np.clip(peak[resolved] - self._first_bin, 0, len(self._kernels) - 1)
        spectra = np.empty((len(pending), resolved.size), dtype=complex)
        for line_number in np.unique(bins):
            selected = bins == line_number
            spectra[:, selected] = view[:, resolved[selected]] @ self._kernels[line_number]
        reference_spectrum = spectra[self._reference]
        line_offset = offset[resolved]
        gain = 0.25 * self._size * np.sinc(line_offset) / (1.0 - line_offset**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = spectra / reference_spectrum
        self._tones.append(
            (
                self._n_blocks + resolved,
                line[resolved] / HOPS,
                np.angle(reference_spectrum),
                at[resolved] / gain,
                ratio,
            )
        )

    def track(self) -> Track:
        channels = 1 if self._averages is None else len(self._averages)
        no_tone = (np.empty(0, np.int64), *(np.empty(0),) * 3, np.empty((channels, 0), complex))
        columns = zip(no_tone, *self._tones, strict=True)
        number, frequency, phase, amplitude, ratio = (np.concatenate(each, axis=-1) for each in columns)
        levels = np.concatenate([np.empty(0, np.float32), *self._levels])
        return Track(self._hop * self._averaged, number, frequency, phase, amplitude, ratio, levels)
