"""Complex amplitudes of channels at one frequency (lock-in), by least squares over a nearly whole number of periods."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rig.core.base.arrays import Array, ComplexArray

# A window has at least this number of periods.
_MIN_PERIODS = 2
# A window has at least this number of samples: more than the six fitted terms of a tone without harmonics.
_MIN_SAMPLES = 8
# A window has at least this number of beats. Near half the sample rate, the samples of a tone beat, and amplitude and
# phase cannot be separated in a shorter part of a beat.
_MIN_BEATS = 0.5
# Order of the highest harmonic that is fitted with the tone.
_MAX_HARMONIC = 6
# Harmonics are fitted up to this fraction of the sample rate.
_MAX_HARMONIC_RATIO = 0.4
# A longer window is evaluated in pieces of this number of samples, which limits the memory.
_PIECE_SAMPLES = 1 << 16


def min_samples(frequency: float, rate: float) -> int:
    """Return the minimum number of samples for an amplitude estimate without much noise amplification.

    `frequency`: frequency of the tone, Hz; `rate`: sample rate, Hz.

    >>> [min_samples(frequency, 100.0) for frequency in (1.0, 20.0, 40.0, 49.0)]
    [200, 10, 8, 25]
    """
    # Duration of the minimum number of beats, samples.
    beat = _MIN_BEATS / (1.0 - 2.0 * frequency / rate)
    return max(_MIN_SAMPLES, int(np.ceil(max(_MIN_PERIODS * rate / frequency, beat) - 1e-9)))


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
    min_periods = int(np.ceil(min_samples(frequency, rate) * frequency / rate - 1e-9))
    min_n_periods = max(min_periods, int(np.ceil(shortest_s * frequency - 1e-9)))
    n_periods = np.arange(min_n_periods, min_n_periods + max(1, min_n_periods // 3) + 1)
    samples = n_periods * rate / frequency
    deviation = abs(samples - np.round(samples)) / samples
    return round(float(samples[np.argmin(np.round(deviation, 9))]))


# Cached, because a test uses only a few window lengths per frequency.
@lru_cache(maxsize=8)
def lock_in_weights(frequency: float, rate: float, samples: int) -> Array:
    """Return the least-squares weights of the samples for real and imaginary part of the amplitude, (2, samples)."""
    model = _model(frequency, rate, samples, 0, samples)
    # Over two periods or more, the fitted terms are nearly orthogonal, so that the normal equations are accurate. Sums
    # use einsum: for matrices of this size, BLAS threads would only add overhead.
    normal = np.einsum("in,jn->ij", model, model)
    return np.einsum("ki,in->kn", np.linalg.inv(normal)[:2], model)


def _model(frequency: float, rate: float, samples: int, first: int, stop: int) -> Array:
    """Return the tone, its harmonics and a drift at samples [first, stop) of a window; shape (terms, n)."""
    phase = 2 * np.pi * np.fmod(frequency / rate * np.arange(first, stop), 1.0)
    highest = max(1, min(_MAX_HARMONIC, int(_MAX_HARMONIC_RATIO * rate / frequency)))
    model = np.empty((4 + 2 * highest, phase.size))
    np.cos(phase, out=model[0])
    np.negative(np.sin(phase), out=model[1])
    # Integrated channels drift and dampers shift the mean: Legendre polynomials up to the third degree model this
    # drift. Without harmonics in the model, the polynomials would also fit part of the harmonics, which would bias the
    # amplitude of the tone.
    u = np.linspace(-1.0, 1.0, samples)[first:stop]
    quadratic = (3 * (u * u) - 1) / 2
    model[2], model[3], model[4], model[5] = 1.0, u, quadratic, (5 * (quadratic * u) - 2 * u) / 3
    for h in range(2, highest + 1):
        np.cos(h * phase, out=model[2 * h + 2])
        np.sin(h * phase, out=model[2 * h + 3])
    return model


def _amplitude_parts(samples: Array, frequency: float, rate: float) -> Array:
    """Return real and imaginary part of the amplitude in a long window, shape (channels, 2).

    The normal equations are summed over pieces of the window.
    """
    n_samples = samples.shape[1]
    normal, projection = 0.0, 0.0
    for first in range(0, n_samples, _PIECE_SAMPLES):
        model = _model(frequency, rate, n_samples, first, min(first + _PIECE_SAMPLES, n_samples))
        normal = normal + np.einsum("in,jn->ij", model, model)
        projection = projection + np.einsum("cn,in->ci", samples[:, first : first + _PIECE_SAMPLES], model)
    return np.asarray(np.einsum("ci,ki->ck", projection, np.linalg.inv(normal)[:2]))


def lock_in(samples: Array, frequency: float, rate: float, phase: float = 0.0) -> ComplexArray:
    """Estimate complex amplitudes X (channels,) of a steady tone: x(t) = Re(X e^{i(phase + 2 pi f t)}) + slow drift.

    `samples` has shape (channels, at least `min_samples`); t is 0 at its first sample. `frequency` and `rate` are in
    Hz, `phase` is in rad.

    >>> t = np.arange(512) / 5120.0
    >>> amplitude = lock_in(3.0 * np.cos(2 * np.pi * 20 * t + 0.5)[None] + 7.0 + t, 20.0, 5120.0, phase=0.5)
    >>> f"{abs(amplitude[0]):.9f}", bool(abs(np.angle(amplitude[0])) < 1e-9)
    ('3.000000000', True)
    """
    n_samples = samples.shape[1]
    if n_samples <= _PIECE_SAMPLES:
        parts = np.einsum("cn,kn->ck", samples, lock_in_weights(frequency, rate, n_samples))
    else:
        parts = _amplitude_parts(samples, frequency, rate)
    return (parts[:, 0] + 1j * parts[:, 1]) * np.exp(-1j * phase)


def noise_gain(periods: float, frequency: Array) -> Array:
    """Return the gain from a noise density to the noise of an amplitude measured over some periods, sqrt(s)."""
    return np.asarray(np.sqrt(periods / frequency / 2.0))
