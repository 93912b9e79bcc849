"""Complex amplitudes of channels at one or several frequencies (lock-in), by least squares over a window of samples."""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np

from rig.core.base.arrays import Array, ComplexArray

# Smallest number of periods, also of a difference of tones, in a window: fewer do not separate tones and offset.
MIN_PERIODS = 2
# A window has at least this number of samples: more than the six fitted terms of a tone without harmonics.
_MIN_SAMPLES = 8
# Smallest number of beats in a window: part of a beat near half the sample rate hides amplitude and phase.
_MIN_BEATS = 0.5
# Order of the highest harmonic that is fitted with the tone.
_MAX_HARMONIC = 6
# Harmonics are fitted up to this fraction of the sample rate, below the transition band of the converter.
_MAX_HARMONIC_RATIO = 0.4
# A harmonic is fitted if its frequency differs from all other fitted frequencies by at least this number of periods in
# the window: about one, because windows are rounded to whole samples.
_MIN_HARMONIC_PERIODS = 0.9
# A longer window is evaluated in pieces of this number of samples, which limits the memory.
_PIECE_SAMPLES = 1 << 16


def min_samples(frequencies: Sequence[float], rate: float) -> int:
    """Return the minimum number of samples for estimates of amplitudes without much noise amplification.

    `frequencies`: frequencies of the simultaneous tones [Hz]; `rate`: sample rate [Hz].

    >>> [min_samples([frequency], 100.0) for frequency in (1.0, 20.0, 40.0, 49.0)]
    [200, 10, 8, 25]
    >>> min_samples([20.0, 25.0], 100.0)
    40
    """
    # Duration of the minimum number of beats [samples].
    beat = _MIN_BEATS / (1.0 - 2.0 * max(frequencies) / rate)
    differences = (upper - lower for lower, upper in pairwise(sorted(frequencies)))
    lowest = min([*frequencies, *differences])
    return max(_MIN_SAMPLES, math.ceil(max(MIN_PERIODS * rate / lowest, beat) - 1e-9))


def whole_periods(frequency: float, rate: float, shortest_s: float) -> int:
    """Return the length in samples of the window that is closest to whole periods.

    The window is at least `shortest_s` s long, and at most a third or one period longer. In a window with a fraction of
    a period, harmonics and offsets would leak into the fundamental.

    >>> whole_periods(10.0, 1000.0, 0.15)
    200
    >>> whole_periods(12.5, 100.0, 0.2)
    24
    >>> whole_periods(10.0, 25.0, 0.15)
    10
    """
    min_periods = math.ceil(min_samples([frequency], rate) * frequency / rate - 1e-9)
    min_n_periods = max(min_periods, math.ceil(shortest_s * frequency - 1e-9))
    n_periods = range(min_n_periods, min_n_periods + max(1, min_n_periods // 3) + 1)
    lengths = [count * rate / frequency for count in n_periods]
    deviations = [round(abs(length - round(length)) / length, 9) for length in lengths]
    return round(lengths[deviations.index(min(deviations))])


# Cached, because a test uses only a few window lengths per frequency.
@lru_cache(maxsize=8)
def lock_in_weights(frequencies: tuple[float, ...], rate: float, samples: int) -> Array:
    """Return the least-squares weights of the samples for the real and imaginary parts of each amplitude.

    The result has the shape (2 tones, samples).
    """
    model = _model(frequencies, rate, samples, 0, samples)
    # Over two periods or more, the fitted terms are nearly orthogonal, so the normal equations are accurate. Sums
    # use einsum: for matrices of this size, BLAS threads would only add overhead.
    normal = np.einsum("in,jn->ij", model, model)
    return np.einsum("ki,in->kn", np.linalg.inv(normal)[: 2 * len(frequencies)], model)


def lock_in_of_signals(frequency: float, rate: float, signals: ComplexArray) -> tuple[ComplexArray, float]:
    """Return the amplitudes of one tone that the lock-in estimates in a window of complex signals, and its noise gain.

    `signals`: shape (samples, signals). The noise gain is the ratio of the standard deviation of the amplitude to that
    of white noise in each sample, where the variance of the amplitude is the sum over the real and imaginary parts.
    """
    n_samples = len(signals)
    model = _model((frequency,), rate, n_samples, 0, n_samples)
    inverse = np.linalg.inv(model @ model.T)[:2]
    real, imaginary = inverse @ (model @ signals.view(float)).view(complex)
    return np.asarray(real + 1j * imaginary), math.sqrt(inverse[0, 0] + inverse[1, 1])


def _fitted_harmonics(frequencies: Sequence[float], rate: float, samples: int) -> list[tuple[int, int]]:
    """Return the tone's index and the order of each fitted harmonic; no two terms have nearly the same frequency."""
    fitted, harmonics, min_difference = (
        list(frequencies),
        list[tuple[int, int]](),
        _MIN_HARMONIC_PERIODS * rate / samples,
    )
    for number, frequency in enumerate(frequencies):
        for order in range(2, min(_MAX_HARMONIC, int(_MAX_HARMONIC_RATIO * rate / frequency)) + 1):
            if min(abs(order * frequency - other) for other in fitted) > min_difference:
                fitted.append(order * frequency)
                harmonics.append((number, order))
    return harmonics


def _model(frequencies: Sequence[float], rate: float, samples: int, first: int, stop: int) -> Array:
    """Return the tones, a drift, and the harmonics at samples [first, stop) of a window; shape (terms, n)."""
    harmonics, tones = _fitted_harmonics(frequencies, rate, samples), 2 * len(frequencies)
    periods = np.outer(np.divide(frequencies, rate), np.arange(first, stop))
    phases = 2 * np.pi * (periods - np.trunc(periods))
    model = np.empty((tones + 4 + 2 * len(harmonics), stop - first))
    np.cos(phases, out=model[:tones:2])
    np.negative(np.sin(phases), out=model[1:tones:2])
    # Integrated channels drift and dampers shift the mean: Legendre polynomials up to the third degree model this
    # drift. Without harmonics in the model, the polynomials would also fit part of the harmonics, which would bias the
    # amplitude of the tone.
    u = np.linspace(-1.0, 1.0, samples)[first:stop]
    quadratic = (3 * (u * u) - 1) / 2
    model[tones : tones + 4] = np.ones_like(u), u, quadratic, (5 * (quadratic * u) - 2 * u) / 3
    for row, (number, order) in zip(range(tones + 4, len(model), 2), harmonics, strict=True):
        np.cos(order * phases[number], out=model[row])
        np.sin(order * phases[number], out=model[row + 1])
    return model


def _amplitude_parts(samples: Array, frequencies: Sequence[float], rate: float) -> Array:
    """Return the real and imaginary parts of each amplitude in a long window, read in pieces; (channels, 2 tones)."""
    n_samples = samples.shape[1]
    normal, projection = 0.0, 0.0
    for first in range(0, n_samples, _PIECE_SAMPLES):
        model = _model(frequencies, rate, n_samples, first, min(first + _PIECE_SAMPLES, n_samples))
        normal = normal + np.einsum("in,jn->ij", model, model)
        projection = projection + np.einsum("cn,in->ci", samples[:, first : first + _PIECE_SAMPLES], model)
    return np.asarray(np.einsum("ci,ki->ck", projection, np.linalg.inv(normal)[: 2 * len(frequencies)]))


def lock_in(
    samples: Array, frequencies: Sequence[float], rate: float, phases: Array | Sequence[float] = (0.0,)
) -> ComplexArray:
    """Estimate complex amplitudes X of simultaneous steady tones: x(t) = sum of Re(X e^{i(phase + 2 pi f t)}) + drift.

    `samples` has shape (channels, at least `min_samples`); t is 0 at its first sample. `frequencies` and `rate` are in
    Hz, `phases`, of each tone or of all, are in rad. The result has the shape (channels, tones).

    >>> t = np.arange(512) / 5120.0
    >>> samples = 3.0 * np.cos(2 * np.pi * 20 * t + 0.5) + np.sin(2 * np.pi * 60 * t) + 7.0 + t
    >>> amplitudes = lock_in(samples[None], [20.0, 60.0], 5120.0, [0.5, -np.pi / 2])
    >>> [f"{abs(amplitude):.9f}" for amplitude in amplitudes[0]], bool(abs(np.angle(amplitudes)).max() < 1e-9)
    (['3.000000000', '1.000000000'], True)
    """
    n_samples = samples.shape[1]
    if n_samples <= _PIECE_SAMPLES:
        parts = np.einsum("cn,kn->ck", samples, lock_in_weights(tuple(frequencies), rate, n_samples))
    else:
        parts = _amplitude_parts(samples, frequencies, rate)
    return np.asarray((parts[:, ::2] + 1j * parts[:, 1::2]) * np.exp(-1j * np.asarray(phases)))


def snr_gain(periods: float, frequency: Array) -> Array:
    """Return the signal-to-noise ratio over some periods [sqrt(s)], for unit amplitude and unit noise density."""
    return np.asarray(np.sqrt(periods / frequency / 2.0))
