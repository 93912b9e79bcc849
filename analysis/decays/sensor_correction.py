"""Undo what sensor, amplifier and converter did to a stretch of samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from analysis.responses.frf import MOTIONS

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo

Array = NDArray[np.float64]


def corrected(info: ChannelInfo, samples: Array, motion: str, low: float, high: float) -> Array:
    """Give the true motion behind a stretch of samples, inside a band.

    Parameters
    ----------
    samples : ndarray, shape (n,)
        As read, in the channel's unit, at even intervals.
    motion : str
        ``"displacement"``, ``"velocity"`` or ``"acceleration"`` (ignored for a force channel).
    low, high : float
        Hz. Inside, the result is exact; it fades out over half an octave beyond either end.

    Returns
    -------
    ndarray, shape (n,)
        In m, m/s, m/s² or N.

    Notes
    -----
    The samples are mirrored at both ends before the transform, so that there is no jump between the last
    sample and the first. Where they are to be differentiated, the mirror image is turned upside down as well:
    then there is no kink either, but the mean differs from side to side, which differentiation does not see.
    """
    count = samples.size
    order = MOTIONS.index(motion) - MOTIONS.index(info.quantity) if info.quantity in MOTIONS else 0
    head, tail = samples[:0:-1], samples[-2::-1]
    if order > 0:
        head, tail = 2.0 * samples[0] - head, 2.0 * samples[-1] - tail
    longer = np.concatenate([head, samples, tail])
    fade = np.hanning(2 * (count // 2) + 1)[: count // 2]
    longer[: fade.size] *= fade
    longer[-fade.size :] *= fade[::-1]
    size = fft.next_fast_len(longer.size, real=True)
    frequency = fft.rfftfreq(size, 1.0 / info.rate)
    window = _band(frequency, low, high)
    inside = window > 0
    factor = np.zeros(frequency.size, dtype=complex)
    factor[inside] = (
        window[inside] * (2j * np.pi * frequency[inside]) ** order / info.response(frequency[inside])
    )
    return fft.irfft(fft.rfft(longer, size) * factor, size)[count - 1 : 2 * count - 1]


def _band(frequency: Array, low: float, high: float) -> Array:
    """One between `low` and `high`, falling like a cosine over half an octave outside; never at zero."""
    out = np.ones(frequency.size)
    if low > 0:
        below = np.clip(np.log2(np.maximum(frequency, 1e-300) / low) * 2.0 + 1.0, 0.0, 1.0)
        out *= 0.5 - 0.5 * np.cos(np.pi * below)
    above = np.clip(np.log2(np.maximum(frequency, 1e-300) / high) * 2.0, 0.0, 1.0)
    out *= 0.5 + 0.5 * np.cos(np.pi * above)
    if low > 0:
        out[0] = 0.0
    return out
