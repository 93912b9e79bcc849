"""Correction of sampled data for the frequency response of sensor, amplifier and converter."""

import numpy as np
from scipy import fft

from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.results.response import MOTIONS

# Number of spectral lines that are corrected at a time, to limit the memory.
_BLOCK_LINES = 1 << 16


def correct_motion(info: ChannelInfo, samples: Array, motion: str, low: float, high: float) -> Array:
    """Return the band-limited true displacement, velocity or acceleration of a segment in SI; force channels: force.

    The samples are mirrored at both ends before the Fourier transform, so the periodic continuation has no step
    between the last sample and the first. If the samples are differentiated, the mirror image is also inverted (odd
    extension), which removes the slope change at the ends. The inversion changes the mean value, but differentiation
    removes the mean.

    `samples`, shape (n,): uncorrected samples in the channel's unit, evenly spaced; `low`, `high`: limits of the
    pass band [Hz]. The correction is exact inside the pass band, and fades out over half an octave outside.
    """
    count, quantity = samples.size, info.quantity
    # Number of differentiations; negative for integrations.
    order = MOTIONS.index(motion) - MOTIONS.index(quantity) if quantity in MOTIONS else 0
    size = fft.next_fast_len(3 * count - 2, real=True)
    spectrum = fft.rfft(_extended(samples, size, is_odd=order > 0))
    step = 1.0 / (size * (1.0 / info.rate))
    for first in range(0, spectrum.size, _BLOCK_LINES):
        block = spectrum[first : first + _BLOCK_LINES]
        frequency = np.arange(first, first + block.size) * step
        weights = _band_weights(frequency, low, high)
        is_passed = weights != 0.0
        frequency = frequency[is_passed]
        factor = weights[is_passed] / info.response(frequency)
        factor = factor if order == 0 else factor * (2j * np.pi * frequency) ** order
        block[is_passed] *= factor
        block[~is_passed] = 0.0
    return fft.irfft(spectrum, size)[count - 1 : 2 * count - 1].copy()


def _extended(samples: Array, size: int, is_odd: bool) -> Array:
    """Return the samples between their mirror images, which fade in and out, with zeros up to `size`."""
    count, extended = samples.size, np.zeros(size)
    before, after = extended[: count - 1], extended[2 * count - 1 : 3 * count - 2]
    before[:], extended[count - 1 : 2 * count - 1], after[:] = samples[:0:-1], samples, samples[-2::-1]
    if is_odd:
        before[:], after[:] = 2.0 * samples[0] - before, 2.0 * samples[-1] - after
    fade_length = count // 2
    fade_in = np.hanning(2 * fade_length + 1)[:fade_length]
    before[:fade_length] *= fade_in
    after[after.size - fade_length :] *= fade_in[::-1]
    return extended


def _band_weights(frequency: Array, low: float, high: float) -> Array:
    """Return weights: 1 from `low` to `high`, cosine tapers of half an octave, and 0 at zero frequency if `low` > 0."""
    weights = np.ones(frequency.size)
    if low > 0:
        below = frequency < low
        taper = np.clip(np.log2(np.maximum(frequency[below], 1e-300) / low) * 2.0 + 1.0, 0.0, 1.0)
        weights[below] = 0.5 - 0.5 * np.cos(np.pi * taper)
    above = frequency >= high
    taper = np.clip(np.log2(np.maximum(frequency[above], 1e-300) / high) * 2.0, 0.0, 1.0)
    weights[above] *= 0.5 + 0.5 * np.cos(np.pi * taper)
    return weights
