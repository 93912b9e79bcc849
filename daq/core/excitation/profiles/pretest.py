"""Pretest: identify, from the channels, the drive that the shaker needs for a given table motion and spring force.

The result is used to control the force of a swept sine.
"""

from collections.abc import Generator
from dataclasses import dataclass
from math import comb, pi, sqrt

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from daq.core.excitation.controlled import Controlled
from daq.core.excitation.profiles.spectrum_shaping import lines_between, sum_of_tones
from daq.core.excitation.station import Station
from rig.core.base.arrays import Array, ComplexArray

# Shortest analyzed burst [s]: it resolves slow modes.
_MIN_BURST_S = 4.0
# Shortest analyzed burst, in periods of the lowest tone: they separate it from its neighbors.
_MIN_BURST_PERIODS = 12.0
# Duration of the rise and of the fall of the burst [s].
_EDGE_S = 0.25
# Duration of zero drive after the burst, in which the motion decays [s].
_DECAY_S = 1.0
# The tones extend beyond both limits of the test's band by this factor, so the estimate is valid at the limits.
_BAND_MARGIN = 1.3
# Maximum drive of the burst, relative to the cautious first drive: it exceeds the noise without overloads.
_MAX_DRIVE_RATIO = 5.0
# The amplitudes of the tones are proportional to (1 / frequency) to this power.
_SPECTRUM_EXPONENT = 1.0
# Number of coefficients of the polynomial P for the table motion (see `ShakerLaw`).
_MOTION_TERMS = 4
# Number of coefficients of the polynomial Q for the spring force (see `ShakerLaw`).
_FORCE_TERMS = 2
# Delays between drive and channels are searched up to this delay [s].
_MAX_DELAY_S = 0.05


@dataclass(frozen=True)
class ShakerLaw:
    """Drive of a shaker: D = e^(s delay) (P(s) X0 + Q(s) F), for table motion X0 e^(st) and spring force F e^(st).

    A moving coil has P = Z (m s^2 + c s + k) / Bl + Bl s and Q = Z / Bl with Z = R + L s, per amplifier gain; a
    table with a servo has P = (1 + s / w)^2 and Q = 0. P and Q are independent of the structure.
    """

    motion: Array  # coefficients of P, drive/m, ascending powers of s
    force: Array  # coefficients of Q, drive/N, ascending powers of s
    spring: float  # stiffness of the coil spring [N/m]
    delay: float  # delay of the channels relative to the drive [s]
    misfit: float  # relative RMS residual of the drive in the pretest

    def at(self, s: complex) -> tuple[complex, complex]:
        """Return the drive per newton of spring force, and per meter of displacement X1 of the body.

        The displacement of the table is X0 = X1 + F / k0, with the stiffness k0 of the coil spring.
        """
        delay_factor = np.exp(s * self.delay)
        per_meter = delay_factor * polynomial.polyval(s, self.motion)
        per_newton = per_meter / self.spring + delay_factor * polynomial.polyval(s, self.force)
        return complex(per_newton), complex(per_meter)

    def slope(self, s: complex) -> tuple[complex, complex]:
        """Return the derivatives of `at` with respect to s, for the additional drive of a changing amplitude."""
        step = 1e-3 * abs(s)
        upper, lower = self.at(s + step), self.at(s - step)
        return (upper[0] - lower[0]) / (2 * step), (upper[1] - lower[1]) / (2 * step)


def pretest(
    station: Station, spring_force: Controlled, lowest: float, highest: float, level: float
) -> Generator[Array, Array, ShakerLaw]:
    """Output a short burst of weak tones and estimate the drive of the shaker, for a band in Hz and a level in N."""
    period = station.samples(max(_MIN_BURST_S, _MIN_BURST_PERIODS / lowest))
    lines = lines_between(lowest / _BAND_MARGIN, min(_BAND_MARGIN * highest, 0.45 * station.rate), period, station.rate)
    # Random phases avoid a high peak. The lowest tones are the largest, because noise affects them most.
    phases = station.generator("pretest").uniform(0.0, 2 * pi, lines.size)
    wave = sum_of_tones(lines, np.asarray(lines**-_SPECTRUM_EXPONENT, dtype=np.float64), phases, period)
    edge = station.samples(_EDGE_S)
    # The burst consists of one period of the tones, extended by a rise and a fall.
    wave = np.concatenate([wave[-edge:], wave, wave[:edge]])
    wave *= np.minimum(1.0, np.minimum(np.arange(wave.size), np.arange(wave.size)[::-1]) / edge)
    wave *= min(_MAX_DRIVE_RATIO * level * station.cautious_drive, station.drive_limit) / abs(wave).max()
    first = station.now
    readings = yield station.drive(wave)
    analyzed = slice(edge, edge + period)
    law = _fit(spring_force, wave[analyzed], readings[:, analyzed], lines)
    yield station.zero_drive(station.samples(_DECAY_S))
    station.mark("pretest", first, station.now, delay=law.delay, misfit=law.misfit)
    return law


def _fit(spring_force: Controlled, drive: Array, readings: Array, lines: NDArray[np.int64]) -> ShakerLaw:
    """Estimate the coefficients by least squares over the lines; the delay minimizes the residual."""
    station, stiffness, period = spring_force.station, spring_force.factors[0], drive.size
    frequency = lines * station.rate / period
    table_row, body_row = spring_force.rows
    windows = _windows(period, station.rate)
    s = np.asarray(2j * pi * frequency, dtype=np.complex128)
    # s is normalized by the middle of the band, so its powers have similar magnitudes.
    middle_s = 2 * pi * sqrt(frequency[0] * frequency[-1])
    # The subtraction makes constant readings exactly zero.
    changes = readings - readings[:, :1]
    spectra = [np.fft.rfft(changes * window, axis=1)[:, lines] for window in windows]

    def derivative(row: int, order: int) -> ComplexArray:
        """Return the windowed spectrum of the time derivative of a displacement.

        Partial integration moves the derivatives to the window, which is exact even for transients. The derivative is
        divided by `middle_s` to the power `order`.
        """
        parts = (comb(order, j) * (-1) ** j * s ** (order - j) * spectra[j][row] for j in range(order + 1))
        return np.asarray(station.displacement_factor(row, frequency) * np.asarray(sum(parts)) / middle_s**order)

    terms = [derivative(table_row, order) for order in range(_MOTION_TERMS)]
    for order in range(_FORCE_TERMS):
        terms.append(terms[order] - derivative(body_row, order))
    drive_spectrum = np.fft.rfft(drive * windows[0])[lines]
    model = np.array(terms).T / abs(drive_spectrum)[:, None]
    target = drive_spectrum / abs(drive_spectrum)

    def solve(delay: float) -> tuple[float, Array]:
        """Return the relative RMS residual of the drive and the coefficients, for a delay in s."""
        delayed_model = model * np.exp(s * delay)[:, None]
        rows = np.concatenate([delayed_model.real, delayed_model.imag])
        target_parts = np.concatenate([target.real, target.imag])
        coefficients = np.linalg.lstsq(rows, target_parts, rcond=None)[0]
        return float(np.sqrt(2 * np.mean((rows @ coefficients - target_parts) ** 2))), coefficients

    step = 1.0 / (16.0 * frequency[-1])
    coarse_delay = min(np.arange(0.0, _MAX_DELAY_S, step), key=lambda delay: solve(delay)[0])
    delay = float(min(coarse_delay + step * np.linspace(-1.0, 1.0, 17), key=lambda delay: solve(delay)[0]))
    misfit, coefficients = solve(delay)
    motion = coefficients[:_MOTION_TERMS] / middle_s ** np.arange(_MOTION_TERMS)
    force = coefficients[_MOTION_TERMS:] / middle_s ** np.arange(_FORCE_TERMS) / stiffness
    return ShakerLaw(motion, force, stiffness, delay, misfit)


def _windows(samples: int, rate: float) -> list[Array]:
    """Return the Hann window and its first three time derivatives."""
    angle, angular_frequency = 2 * pi * np.arange(samples) / samples, 2 * pi * rate / samples
    return [
        (1 - np.cos(angle)) / 2,
        angular_frequency * np.sin(angle) / 2,
        angular_frequency**2 * np.cos(angle) / 2,
        -(angular_frequency**3) * np.sin(angle) / 2,
    ]
