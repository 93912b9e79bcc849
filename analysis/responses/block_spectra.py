"""Windowed and averaged spectra of blocks of a recording, for the estimators H1, H2 and Hv."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy
from scipy import fft

from analysis.recordings.slices import read_slices
from analysis.responses.clean_stretches import Flaw, flaws
from analysis.responses.estimators import Averages, independent_blocks
from rig.arrays import Array, ComplexArray
from rig.errors import SceneError

if TYPE_CHECKING:
    from analysis.responses.whole_stretches import WholeStretches
    from daq.recording.recording import Recording


@dataclass(frozen=True)
class CrossSpectra:
    """Spectral matrix of the channels, averaged over the blocks without flaws."""

    channels: tuple[str, ...]
    frequency: Array  # Hz; shape (n,)
    cross: ComplexArray  # mean of Y_i conj(Y_j), shape (n, channels, channels)
    window: Array
    used: int  # number of blocks
    weight: float  # equivalent number of equally weighted blocks, relative to `used`
    flaws: Sequence[Flaw]  # flaws of the blocks that were left out
    left: float  # largest residual motion of any channel at the end of a block, as a share of its motion
    squares: Array  # mean square of each channel within a block, less its mean; shape (channels,)

    def averages(
        self,
        step: int,
        resolution: float,
        label: str,
        warnings: tuple[str, ...],
        gain: Array,
        unsmeared: WholeStretches | None = None,
    ) -> Averages:
        """Return the averages; blocks begin every `step` samples; for `gain` see `rounding_part`."""
        independent = independent_blocks(self.window, step, self.used) * self.weight
        return Averages(
            self.channels,
            self.frequency,
            self.cross,
            independent,
            resolution,
            label,
            warnings,
            gain=gain,
            unsmeared=unsmeared,
        )


def cross_spectra(
    rec: Recording,
    channels: Sequence[str],
    starts: Sequence[int],
    window: Array,
    low: float,
    high: float,
    forgetting: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CrossSpectra:
    """Average the spectra of blocks after removal of each block's mean.

    `starts`: first samples of the blocks, in rising order; `window` has the shape (samples of a block,); `low`,
    `high`: frequency band, Hz; `forgetting`: weight of each block relative to the next block; omitted: equal
    weights.
    """
    names, size = list(channels), window.size
    found = flaws(rec, names, starts[0], starts[-1] + size)
    edges = np.array([[flaw.first, flaw.stop] for flaw in found]).reshape(-1, 2)
    frequency = fft.rfftfreq(size, 1.0 / rec.rate)
    keep = (frequency >= low) & (frequency <= min(high, 0.45 * rec.rate)) & (frequency > 0)
    cross: ComplexArray = np.zeros((int(keep.sum()), len(names), len(names)), dtype=complex)
    total = squares = left = 0.0
    power = np.zeros(len(names))
    used = 0
    fade = 1.0 if forgetting is None else forgetting
    blocks = read_slices(rec, names, ((begin, begin + size) for begin in starts))
    for index, (begin, samples) in enumerate(zip(starts, blocks, strict=True)):
        if progress is not None:
            progress(index + 1, len(starts))
        if np.any((edges[:, 0] < begin + size) & (edges[:, 1] > begin)):
            continue
        samples = samples - samples.mean(axis=1, keepdims=True)
        spectra = fft.rfft(samples * window, axis=1)[:, keep]
        cross = cross * fade + np.einsum("in,jn->nij", spectra, spectra.conj())
        total, squares = fade * total + 1.0, fade * fade * squares + 1.0
        used += 1
        power += np.mean(np.square(samples), axis=1)
        size_now = np.maximum(abs(samples).max(axis=1), 1e-300)
        left = max(left, float(np.max(abs(samples[:, -max(1, size // 50) :]).max(axis=1) / size_now)))
    weight = total**2 / squares / used if used else 0.0
    mean = np.asarray(cross / max(total, 1e-300), dtype=complex)
    return CrossSpectra(
        tuple(names), frequency[keep], mean, window, used, weight, found, left, power / max(used, 1)
    )


def window_of(name: str, size: int) -> Array:
    """Return a periodic window by its scipy name; ``none`` is a rectangular window.

    Raises `SceneError` if scipy has no window of that name.
    """
    try:
        return np.asarray(scipy.signal.get_window("boxcar" if name == "none" else name, size), dtype=float)
    except ValueError:
        raise SceneError(
            f"unknown window {name!r}: expected none, hann, hamming, flattop, blackmanharris or another of scipy's"
        ) from None


def bins_of(window: Array) -> float:
    """Effective noise bandwidth of a window in bins (Harris 1978, eq. 11).

    >>> round(bins_of(window_of("hann", 1000)), 6), bins_of(window_of("none", 10))
    (1.5, 1.0)
    """
    return float(window.size * np.sum(window**2) / np.sum(window) ** 2)
