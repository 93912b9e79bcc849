"""Noise with the density of a data sheet: white, or with a power density that rises as 1/f below a corner."""

from functools import lru_cache
from itertools import pairwise
from zlib import crc32

import numpy as np

from rig.core.base.arrays import Array
from rig.core.numerics.fma import update_states
from rig.core.numerics.jit import unfused_kernel
from rig.core.numerics.simd import aligned_zeros, padded_length

# Variance of uniform random numbers between -1/2 and 1/2. They represent the variation of noise within an interval. A
# filter sums many of them, so that its output is practically normally distributed.
_UNIFORM_VARIANCE = 1.0 / 12.0
# Lowest frequency of 1/f noise [Hz]. At lower frequencies (periods of hours), the noise is white.
LOWEST = 1e-4
# First-order sections approximate 1/f noise if successive corner frequencies have at most this ratio.
_MAX_CORNER_RATIO = 4.0


def generator(seed: int, channel: str, stage: str) -> np.random.Generator:
    """Return the random number generator of a source of noise (`stage`) of a channel.

    Its numbers do not depend on the other channels and settings of the scene.

    >>> generator(1, "body1", "noise").integers(100) == generator(1, "body1", "noise").integers(100)
    np.True_
    """
    words = [seed, crc32(channel.encode()), crc32(stage.encode())]
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(words)))


class Noise:
    """Noise with a one-sided density in V/sqrt(Hz); each sample is the mean over its sample interval.

    At the corner frequency in Hz, the 1/f part is as strong as the white part. Without a corner, the noise is white.

    >>> source = Noise(1e-6, None, 5120.0, generator(1, "body1", "noise"))
    >>> samples = np.empty(100_000)
    >>> source.fill(samples)
    >>> f"{samples.std():.3g}"  # 1 uV/sqrt(Hz) over 2560 Hz
    '5.06e-05'
    """

    def __init__(self, density: float, corner: float | None, rate: float, random: np.random.Generator) -> None:
        self._deviation = density * np.sqrt(0.5 * rate)
        self._random = random
        self.states = 0  # number of states of the filter that yields 1/f noise
        if corner is not None:
            loss, weight, self._gain = flicker_filter(corner, rate)
            self.states = loss.size
            self._poles, self._weight, self._states = (aligned_zeros(padded_length(loss.size)) for _ in range(3))
            self._poles[: loss.size], self._weight[: loss.size] = 1.0 - loss, weight

    def fill(self, samples: Array) -> None:
        """Fill in the next samples [V], shape (samples,)."""
        self._random.standard_normal(out=samples)
        samples *= self._deviation
        if self.states:
            _color(samples, self._poles, self._weight, self._gain, self._states)


class FastNoise:
    """Variation of noise within a sample interval, in addition to its mean (`Noise`).

    Each value is the voltage of a Legendre polynomial of degree 1 or 2 over the interval. With the means alone, the
    density of noise after a filter would decrease by 3.9 dB towards half the sample rate; with these polynomials it
    decreases by 0.04 dB.
    """

    def __init__(
        self, density: float, corner: float | None, rate: float, random: np.random.Generator, degree: int
    ) -> None:
        colored = 1.0 + 2.0 * (corner or 0.0) / rate
        self._amplitude = density * np.sqrt(colored * 0.5 * rate * (2 * degree + 1) / _UNIFORM_VARIANCE)
        self._random = random

    def fill(self, samples: Array) -> None:
        """Fill in the next voltages, shape (samples,)."""
        self._random.random(out=samples)
        samples -= 0.5
        samples *= self._amplitude


# Cached, because sensors of the same type have the same filter.
@lru_cache(maxsize=16)
def flicker_filter(corner: float, rate: float) -> tuple[Array, Array, float]:
    """Return the filter that multiplies the density of white noise by ``sqrt(1 + corner / f)``.

    Returns for each first-order state the loss per sample (the pole is ``1 - loss``) and the weight in the output, and
    the gain. The 1/f spectrum is approximated by a sum of first-order low-pass spectra with logarithmically spaced
    corners, and the filter is its spectral factor. As functions of y = 4 sin^2(pi f / rate), all spectra are rational
    with real poles, and the sum has real zeros between the poles. The density is accurate to 0.3 % for corners up to a
    hundredth of the rate. For corners up to twice the rate, it is accurate to 3 % below 0.45 of the rate, and to 6 % at
    0.5.
    """
    # Imported here, because the import is slow and few scenes have 1/f noise.
    from scipy.optimize import brentq, nnls

    highest = 0.25 * rate
    lowest = min(LOWEST, 0.1 * corner, 0.01 * rate)
    corners = np.geomspace(lowest, highest, 2 + int(np.log(highest / lowest) / np.log(_MAX_CORNER_RATIO)))
    poles = 4 * np.sin(np.pi * corners / rate) ** 2
    # The grid is dense near half the rate, where the low-pass spectra are flat but 1/f is not.
    grid = np.concatenate([np.geomspace(10 * lowest, 0.5 * rate, 400), np.linspace(0.3, 0.5, 400) * rate])
    y = 4 * np.sin(np.pi * grid / rate) ** 2
    target = corner / grid
    # Low-pass spectra relative to the total power density, which includes the white part.
    low_pass = poles / (poles + y[:, None]) / (1 + target)[:, None]
    scale = corner / corners
    strength, _ = nnls(low_pass * scale, target / (1 + target))
    present = strength > 0
    poles, strength = poles[present], (strength * scale)[present]

    def spectrum(y: float) -> float:
        return 1.0 + float(np.sum(strength * poles / (poles + y)))

    # Zeros of the spectrum at negative y: one between neighboring poles, one beyond the last.
    bracket_ends = np.append(poles, poles[-1] + 2 * np.sum(strength * poles))
    spectrum_zeros = np.array(
        [
            brentq(lambda z: spectrum(-z), low * (1 + 1e-13), high * (1 - 1e-13), xtol=1e-300, rtol=1e-14)
            for low, high in pairwise(bracket_ends)
        ]
    )
    pole_loss, zero_loss = _loss(poles), _loss(spectrum_zeros)
    gain = float(np.sqrt(np.prod((1 - pole_loss) / (1 - zero_loss))))
    weight = zero_loss - pole_loss
    for i in range(poles.size):
        for j in range(poles.size):
            if j != i:
                weight[i] *= (zero_loss[j] - pole_loss[i]) / (pole_loss[j] - pole_loss[i])
    return pole_loss, weight, gain


def _loss(y: Array) -> Array:
    """Solve ``loss^2 / (1 - loss) = y`` for the loss of a first-order state per sample."""
    return np.asarray(2 * y / (y + np.sqrt(y * (y + 4))))


@unfused_kernel
def _color(samples: Array, poles: Array, weight: Array, gain: float, states: Array) -> None:
    """Filter samples by first-order states in parallel, in place."""
    for i in range(samples.size):
        white = samples[i]
        samples[i] = gain * (white + update_states(states, poles, weight, white))
