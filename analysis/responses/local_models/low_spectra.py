"""Spectra of a long stretch at its lowest frequencies; a test usually excites only a small part of the band.

Higher frequencies are removed by a low-pass filter before decimation, and the spectrum is divided by the filter's
response (Crochiere and Rabiner, Multirate Digital Signal Processing, 1983, chapter 2). Memory hardly depends on the
duration of the recording; the computation takes about as long as reading the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import scipy
from scipy import fft

from analysis.recordings.slices import PIECE
from rig.arrays import Array, ComplexArray

if TYPE_CHECKING:
    from daq.recording.recording import Recording


# Highest bin as a share of the lower rate; length of the filter in samples of that rate; and parameter of its Kaiser
# window, which attenuates aliasing in these bins by 240 dB.
_REACH, _LENGTH, _BETA = 0.15, 24, 25.5
# BLAS computes matrix products of up to this number of multiplications in a single thread, without synchronization.
_SMALL = 1 << 18


def low_spectra(
    rec: Recording, names: Sequence[str], start: int, stop: int, size: int, bins: int
) -> tuple[ComplexArray, Array]:
    """Compute spectra and mean square of a clean stretch without its mean, after zeros that extend it to `size`.

    The spectra are those of `numpy.fft.rfft`, shape (channels, bins); the mean squares have the shape (channels,).
    """
    step = max(each for each in range(1, max(1, int(_REACH * size / bins)) + 1) if size % each == 0)
    taps = (
        np.ones((1, 1))
        if step == 1
        else scipy.signal.firwin(_LENGTH * step, 1.0 / step, window=("kaiser", _BETA))
    )
    filters = taps.reshape(-1, step).T
    few = max(1, _SMALL // filters.size)
    # The filter extends beyond both ends of the stretch; the transform is periodic.
    beyond, before, piece = filters.shape[1], size - (stop - start), max(1, PIECE // step) * step
    kept = np.zeros((len(names), beyond + size // step))
    total, squares = np.zeros((2, len(names)))
    # Squares are computed relative to the first sample, because a large offset would hide the variation by rounding.
    offset = np.array([rec.read(name, start, start + 1)[0] for name in names])
    for first in range(before // step * step, size, piece):
        read = np.zeros((len(names), min(piece, size - first)))
        begin, end = max(first, before), first + read.shape[1]
        for row, name in enumerate(names):
            read[row, begin - first :] = rec.read(name, begin - before + start, end - before + start)
        total += read.sum(axis=1)
        varies = read[:, begin - first :] - offset[:, None]
        squares += np.einsum("cn,cn->c", varies, varies)
        rows = np.arange(0, read.shape[1] // step, few)
        frames = np.split(read.reshape(len(names), -1, step), rows[1:], axis=1)
        parts = np.concatenate([each @ filters for each in frames], axis=1)
        for k in range(beyond):
            place = beyond + first // step - k
            kept[:, place : place + parts.shape[1]] += parts[:, :, k]
    kept[:, -beyond:] += kept[:, :beyond]
    turn = -2j * np.pi / size * np.arange(bins)
    through = np.conj(scipy.signal.zoom_fft(taps.ravel(), [0, bins], m=bins, fs=size)) / step
    spectra = fft.rfft(kept[:, beyond:], axis=1)[:, :bins] / through
    mean = total / (stop - start)
    spectra[:, 0] = 0.0
    spectra[:, 1:] += mean[:, None] * (np.expm1(before * turn[1:]) / np.expm1(turn[1:]))
    return spectra, np.maximum(squares / (stop - start) - (mean - offset) ** 2, 0.0)
