"""Largest responses of single-degree-of-freedom oscillators to an acceleration of their base.

Ramp-invariant filter for the absolute acceleration: D. O. Smallwood, Shock Vib. Bull. 51 (1981) 279; ISO 18431-4. The
filter joins samples by straight lines, which attenuate the frequency f by sinc^2(f / rate). A filter of five samples
compensates for the attenuation.
"""

from collections.abc import Iterable, Iterator
from itertools import chain
from math import ceil

import numpy as np
import scipy

from rig.core.base.arrays import Array

# Minimum number of samples in a period of an oscillator. A parabola through three samples then gives its extremes with
# an error below 0.1 %, also where impacts cause sharp peaks.
_SAMPLES_PER_PERIOD = 20.0
# Length of the interpolation filter on each side, in samples of the motion, and shape of its Kaiser window. The band up
# to 0.46 times the sample rate passes, so motions with impacts have errors below 0.2 %.
_FILTER_SAMPLES, _FILTER_SHAPE = 40, 8.0
# Taps of the filter that compensates for the attenuation by straight lines, 1 + s^2 / 12 + s^4 / 90 with s = 2 sin(pi f
# / rate). Its error is below 0.01 % at a tenth of the sample rate.
_COMPENSATION = np.array([1.0, -11.5, 111.0, -11.5, 1.0]) / 90.0
# Number of samples of the motion that are filtered at a time, to limit the memory.
_PIECE_SAMPLES = 1 << 16


def shock_response(pieces: Iterable[Array], rate: float, frequency: Array, q: float) -> tuple[Array, Array]:
    """Return the largest and the smallest acceleration of oscillators, during and after a motion of their base.

    `pieces`: successive parts of the acceleration of the base, from rest; `rate`: Hz; `frequency`: natural frequencies
    [Hz], shape (n,); `q`: quality factor, 1 / (2 damping ratio), above 0.5. Results in the unit of the acceleration,
    shape (n,).

    >>> largest, smallest = shock_response([np.ones(1000)], 1000.0, np.array([10.0]), q=10.0)
    >>> f"{largest[0]:.2f}"  # a step of the base
    '1.86'
    """
    # After the motion, the extremes of an oscillator occur within one period.
    motion = _equal_pieces(chain(pieces, [np.zeros(ceil(rate / float(np.min(frequency))) + 4)]))
    highest = float(np.max(frequency))
    factor = max(ceil(_SAMPLES_PER_PERIOD * highest / rate), 1)
    damping = 0.5 / q
    oscillators = []
    for omega in 2.0 * np.pi * np.asarray(frequency) / (rate * factor):  # rad per sample
        damped = omega * np.sqrt(1.0 - damping**2)
        e = np.exp(-damping * omega)
        c, s = e * np.cos(damped), e * np.sin(damped) / damped
        oscillators.append(([1.0 - s, 2.0 * (s - c), e**2 - s], [1.0, -2.0 * c, e**2]))
    states, last = [np.zeros(2)] * len(oscillators), [np.zeros(0)] * len(oscillators)
    extremes = np.full((len(oscillators), 2, 2), -np.inf)  # largest and smallest: sample, vertex
    for piece in _compensated(_upsampled(motion, factor)):
        for k, (numerator, denominator) in enumerate(oscillators):
            response, states[k] = scipy.signal.lfilter(numerator, denominator, piece, zi=states[k])
            # The last sample of the piece before is compared again, now with both neighbors.
            response = np.concatenate([last[k], response])
            last[k] = response[-2:]
            extremes[k] = [
                max(pair) for pair in zip(extremes[k].tolist(), map(_largest, (response, -response)), strict=True)
            ]
    # Comparisons ignore NaN, but the states of the filters keep it.
    extremes[np.isnan(states).any(axis=1)] = np.nan
    return extremes[:, 0, 1], -extremes[:, 1, 1]


def _equal_pieces(pieces: Iterable[Array]) -> Iterator[Array]:
    """Yield a motion in pieces of equal length, except for the last."""
    rest = np.zeros(0)
    for piece in pieces:
        rest = np.concatenate([rest, piece])
        while rest.size >= _PIECE_SAMPLES:
            yield rest[:_PIECE_SAMPLES]
            rest = rest[_PIECE_SAMPLES:]
    if rest.size:
        yield rest


def _upsampled(pieces: Iterator[Array], factor: int) -> Iterator[Array]:
    """Yield pieces of a motion with `factor` times the sample rate."""
    if factor == 1:
        yield from pieces
        return
    taps = scipy.signal.firwin(2 * _FILTER_SAMPLES * factor + 1, 1.0 / factor, window=("kaiser", _FILTER_SHAPE))
    motion = next(pieces)
    # A shorter motion is reflected as a whole; zeros before its reflection are outside the range of the filter.
    first = min(_FILTER_SAMPLES, motion.size - 1)
    motion = _reflected(motion, first)
    for piece in chain(pieces, [np.zeros(_FILTER_SAMPLES)]):
        motion = np.concatenate([motion, piece])
        stop = motion.size - _FILTER_SAMPLES
        yield scipy.signal.resample_poly(motion, factor, 1, window=taps)[first * factor : stop * factor]
        motion, first = motion[max(stop - _FILTER_SAMPLES, 0) :], min(stop, _FILTER_SAMPLES)


def _compensated(pieces: Iterator[Array]) -> Iterator[Array]:
    """Yield pieces with the compensation of the attenuation by straight lines."""
    before = None
    for piece in pieces:
        samples = _reflected(piece, _COMPENSATION.size // 2) if before is None else np.concatenate([before, piece])
        before = samples[1 - _COMPENSATION.size :]
        yield np.convolve(samples, _COMPENSATION, "valid")


def _reflected(values: Array, count: int) -> Array:
    """Return values preceded by `count` samples reflected through the first value, so the slope is continuous."""
    return np.concatenate([2.0 * values[0] - values[count:0:-1], values])


def _largest(values: Array) -> list[float]:
    """Return the largest value, and the vertex of the parabola through it and its neighbors."""
    index = int(np.argmax(values))
    if not 0 < index < values.size - 1:
        return [float(values[index])] * 2
    before, here, after = values[index - 1 : index + 2]
    curvature = 2.0 * here - before - after
    return [float(here), float(here + ((after - before) ** 2 / (8.0 * curvature) if curvature > 0.0 else 0.0))]
