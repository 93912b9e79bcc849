"""Correction of sampled data for the frequency response of sensor, amplifier and converter."""

from collections.abc import Callable, Iterator

import numpy as np
from scipy import fft

from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import MOTIONS

# Number of spectral lines that are corrected at a time, to limit the memory.
_BLOCK_LINES = 1 << 16
# Memory of a correction, in multiples of the memory of its samples (measured): half of it is inside the transform.
COPIES = 15.0


def correct_motion(info: ChannelInfo, samples: Array, motion: str, low: float, high: float) -> Array:
    """Return displacement, velocity, acceleration or force of a segment [SI], corrected, and limited to a band.

    The samples are mirrored at both ends before the Fourier transform, so the periodic continuation has no step
    between the last sample and the first. If the samples are differentiated, the mirror image is also inverted (odd
    extension), which removes the slope change at the ends. The inversion changes the mean value, but differentiation
    removes the mean.

    `samples`, shape (n,): uncorrected samples in the channel's unit, evenly spaced; `low`, `high`: limits of the
    pass band [Hz]. The correction is exact inside the pass band, and fades out over half an octave outside.
    """
    count, order = samples.size, _derivative_order(info, motion)
    size = fft.next_fast_len(3 * count - 2, real=True)
    spectrum = fft.rfft(_extended(samples, size, is_odd=order > 0))
    return _filtered(info, spectrum, size, order, low, high)[count - 1 : 2 * count - 1].copy()


def count_of_motion(info: ChannelInfo, frequency: Array, motion: str) -> Array:
    """Return the size of a count as a motion at frequencies in Hz [SI]; 0 for an analog channel."""
    count = 0.0 if info.volts_per_count is None else info.unit_per_count
    conversion = (2.0 * np.pi * frequency) ** _derivative_order(info, motion)
    return np.asarray(count * abs(conversion / info.response(frequency)))


def corrected_pieces(
    info: ChannelInfo,
    read: Callable[[int, int], Array],
    count: int,
    motion: str,
    low: float,
    high: float,
    margin: int,
) -> Iterator[Array]:
    """Yield successive parts of a corrected segment of any length (overlap-save method).

    `read`: returns the samples from one index of the segment to another; `count`: samples of the segment; `margin`:
    length of a part, and of the samples on either side from which it is computed; for the others see `correct_motion`.
    """
    order = _derivative_order(info, motion)
    if count <= margin:
        yield correct_motion(info, read(0, count), motion, low, high)
        return
    fade_in = np.hanning(2 * (margin // 2) + 1)[: margin // 2]
    for first in range(0, count, margin):
        begin, stop = first - margin, min(first + margin, count) + margin
        samples = read(max(begin, 0), min(stop, count))
        missing = (max(-begin, 0), max(stop - count, 0))
        samples = np.pad(samples, missing, mode="reflect", reflect_type="odd" if order > 0 else "even")
        samples[: fade_in.size] *= fade_in
        samples[-fade_in.size :] *= fade_in[::-1]
        size = fft.next_fast_len(samples.size, real=True)
        yield _filtered(info, fft.rfft(samples, size), size, order, low, high)[margin : stop - begin - margin].copy()


def _derivative_order(info: ChannelInfo, motion: str) -> int:
    """Return the number of differentiations; negative for integrations."""
    return MOTIONS.index(motion) - MOTIONS.index(info.quantity) if info.quantity in MOTIONS else 0


def _filtered(info: ChannelInfo, spectrum: ComplexArray, size: int, order: int, low: float, high: float) -> Array:
    """Return samples from their spectrum, which is corrected in place; `order`: number of differentiations."""
    # As in `fft.rfftfreq`, with the same rounding.
    step = 1.0 / (size * (1.0 / info.rate))
    for first in range(0, spectrum.size, _BLOCK_LINES):
        block = spectrum[first : first + _BLOCK_LINES]
        frequency = np.arange(first, first + block.size, dtype=np.float64) * step
        weights = _band_weights(frequency, low, high)
        is_passed = weights != 0.0
        frequency = frequency[is_passed]
        factor = weights[is_passed] / info.response(frequency)
        factor = factor if order == 0 else factor * (2j * np.pi * frequency) ** order
        block[is_passed] *= factor
        block[~is_passed] = 0.0
    return np.asarray(fft.irfft(spectrum, size))


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
