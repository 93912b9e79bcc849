"""Control of the power spectral density of noise: averages, update of the drive spectrum, and Gaussian noise with it.

The update of the drive density D per line is ln D += speed * min(ln R/C, ln L/Y) with the profile R, the density C of
the control channels, and the limits L of the densities Y of other channels (notching). With the slope s = d ln C / d ln
D, an update multiplies the error by 1 - speed s, which is stable for speed s < 2. The noise of N averages would make
the true density scatter by 4.34 sqrt(speed / ((2 - speed) N)) dB. The actual scatter is smaller, because deviations
within the noise are corrected less.
"""

import numpy as np

from daq.core.excitation.profiles.spectrum_shaping import Lines
from rig.core.base.arrays import Array

#: Standard uncertainty of the density of a single spectrum, converted to dB to first order (10 / ln 10); that of N
#: averages is this value over sqrt(N).
SCATTER_DB = 4.34
# Largest change [dB] of the density of a line in one update: scatter of a few averages must not overload the rig.
_MAX_STEP_DB = 6.0


class NoiseSource:
    """Stationary Gaussian noise from overlapping frames with random lines, whose density may change between frames.

    The frames have the window sqrt(Hann) and overlap by half, so the sum of their powers is constant.
    """

    def __init__(self, generator: np.random.Generator, lines: Lines, period: int, rate: float) -> None:
        self._generator, self._lines, self._period, self._rate = generator, lines, period, rate
        self._window = np.sin(np.pi * (np.arange(period) + 0.5) / period)
        self._tail = np.zeros(period - period // 2)

    def next_half(self, density: Array) -> Array:
        """Return the next half frame, shape (period // 2,), with a one-sided density per Hz at the lines."""
        half, parts = self._period // 2, self._generator.standard_normal((2, self._lines.size))
        spectrum = np.zeros(self._period // 2 + 1, dtype=complex)
        power = density * self._rate / self._period
        spectrum[self._lines] = (parts[0] + 1j * parts[1]) * np.sqrt(power / 2.0) * self._period / np.sqrt(2.0)
        frame = np.fft.irfft(spectrum, self._period) * self._window
        output = frame[:half] + self._tail[:half]
        self._tail = frame[half:]
        return output


class AveragedSpectra:
    """Averages of the power spectral densities of half-overlapping frames with a Hann window."""

    def __init__(self, factors: Array, lines: Lines, period: int, rate: float) -> None:
        """`factors`: squared factors from reading to acceleration, shape (channels, lines)."""
        self._factors, self._lines, self._period = factors, lines, period
        self._window = (1.0 - np.cos(2.0 * np.pi * np.arange(period) / period)) / 2.0
        self._scale = 2.0 / (rate * float(np.sum(self._window**2)))
        self._recent = np.zeros((factors.shape[0], 0))
        self.restart()

    def restart(self) -> None:
        """Start a new average."""
        self.count, self._sum = 0, np.zeros(self._factors.shape)

    def add(self, readings: Array) -> None:
        """Add the readings of half a frame, shape (channels, period // 2)."""
        self._recent = np.concatenate([self._recent, readings], axis=1)[:, -self._period :]
        if self._recent.shape[1] == self._period:
            frame = self._recent - self._recent.mean(axis=1, keepdims=True)
            spectra = np.fft.rfft(frame * self._window, axis=1)[:, self._lines]
            self._sum += abs(spectra) ** 2 * self._scale
            self.count += 1

    @property
    def density(self) -> Array:
        """One-sided power spectral densities of the accelerations, (m/s²)²/Hz, shape (channels, lines)."""
        return np.asarray(self._factors * self._sum / max(self.count, 1))


def updated(drive: Array, correction: Array, speed: float, averages: float = np.inf) -> Array:
    """Return the drive density after an update.

    `correction`: required ratio of the densities at each line; `averages`: number of spectra from which it was
    computed. A deviation within twice its standard deviation is mostly noise, and is corrected less.
    """
    deviation = 10.0 * np.log10(np.maximum(correction, 1e-30))
    noise = 2.0 * SCATTER_DB / np.sqrt(averages)
    step = speed * deviation * deviation**2 / np.maximum(deviation**2 + noise**2, 1e-30)
    return np.asarray(drive * 10.0 ** (np.clip(step, -_MAX_STEP_DB, _MAX_STEP_DB) / 10.0))
