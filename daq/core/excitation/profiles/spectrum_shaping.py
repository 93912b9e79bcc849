"""Equalization of a multisine drive: iterations adjust the amplitude of each tone until the force spectrum is flat.

The force is measured by the channels. A spectral line is a multiple of the fundamental frequency (the inverse of the
period); the multiple is its number.
"""

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from daq.core.excitation.controlled import Controlled
from daq.core.excitation.station import Station
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError

# Numbers of spectral lines; shape (lines,).
Lines = NDArray[np.int64]

# Maximum number of iterations; each divides the deviation by several, so more are needed only without convergence.
_MAX_ITERATIONS = 8
# Largest change of a line's drive in one iteration: an estimate from noise must not overload the rig.
_MAX_STEP_RATIO = 4.0
# Largest drive of a line, relative to the median of all lines: at an antiresonance no drive gives the force.
_MAX_LINE_RATIO = 100.0
# Tolerance of the lines' rms and median force, below the usual tolerance of sensors.
_LEVEL_TOLERANCE = 0.03
# A test is warned of a level that differs by more than this fraction: the response refers to the measured force.
_WARNED_DEVIATION = 5.0 * _LEVEL_TOLERANCE


def lines_between(first: float, last: float, period: int, rate: float) -> Lines:
    """Return the numbers of the lines from `first` to `last` [Hz] for a period in samples and a sample rate in Hz."""
    low = np.ceil(first * period / rate - 1e-9)
    high = np.floor(min(last * period / rate + 1e-9, (period - 1) // 2))
    lines = np.arange(max(1, int(low)), int(high) + 1)
    if lines.size == 0:
        raise SceneError(
            f"test: no spectral line between {first:g} and {last:g} Hz at a sample rate of {rate:g} Hz. "
            "Widen the band, lengthen the period or raise converter.rate."
        )
    return lines


def sum_of_tones(lines: Lines, amplitudes: Array | ComplexArray, phases: Array, period: int) -> Array:
    """Return one period of a sum of cosines at `lines`, with phases in rad; shape (period,)."""
    spectrum = np.zeros(period // 2 + 1, dtype=complex)
    spectrum[lines] = amplitudes * np.exp(1j * phases) * (period / 2)
    return np.fft.irfft(spectrum, period)


def crossfade(old: Array, new: Array) -> Array:
    """Return one period with a crossfade between two periodic waves; shape (period,)."""
    rise = (1 - np.cos(np.pi * np.arange(old.size) / old.size)) / 2
    return old * (1 - rise) + new * rise


def limit_factor(station: Station, wave: Array) -> float:
    """Return the factor, at most 1, that scales a wave to the range of the amplifier."""
    return min(1.0, station.drive_limit / float(abs(wave).max()))


def equal_amplitudes(level: float, lines: Lines) -> Array:
    """Return amplitudes of equal tones whose sum has the RMS value `level`."""
    return np.full(lines.size, level * np.sqrt(2.0 / lines.size))


def equalize(
    station: Station, controlled: Controlled, lines: Lines, period: int, phases: Array
) -> Generator[Array, Array, tuple[Array, Array, Array]]:
    """Compute the drive with a flat spring force over the lines, by iteration with measurements.

    `phases`: phases of the lines [rad]. Returns, for each line, the drive amplitude and the ratio of force to drive;
    and the current period of the drive, shape (period,).
    """
    level = station.level
    target = equal_amplitudes(level, lines)
    weights = controlled.weights(lines * station.rate / period)
    # `amplitudes` is the requested drive, `limited` the drive within the range of the amplifier.
    amplitudes = limited = target * station.cautious_drive
    present_wave = np.zeros(period)
    force, rms, first = target, 0.0, station.now
    for iteration in range(_MAX_ITERATIONS):
        station.report(0.0, f"equalizing the drive, iteration {iteration + 1}")
        wave = sum_of_tones(lines, amplitudes, phases, period)
        factor = limit_factor(station, wave)
        limited, wave = amplitudes * factor, wave * factor
        yield station.drive(crossfade(present_wave, wave))
        samples = yield station.drive(wave)
        present_wave = wave
        spectrum = np.fft.rfft(samples, axis=1)[:, lines] * (2 / period)
        force = abs(np.einsum("cl,cl->l", weights, spectrum))
        rms = float(np.sqrt(np.sum(force**2) / 2))
        median_deviation = float(np.median(abs(force / target - 1)))
        if abs(rms / level - 1) < _LEVEL_TOLERANCE and median_deviation < _LEVEL_TOLERANCE:
            break
        ratio = np.clip(target / np.maximum(force, 1e-12 * target), 1 / _MAX_STEP_RATIO, _MAX_STEP_RATIO)
        amplitudes = np.minimum(limited * ratio, _MAX_LINE_RATIO * np.median(limited * ratio))
    is_at_level = abs(rms / level - 1) < _WARNED_DEVIATION
    station.mark("settle", first, station.now, level=level, force=rms, settled=is_at_level)
    if not is_at_level:
        station.warn(
            f"the spring force is {rms:.3g} N rms; expected its level of {level:g} N rms. Lower the level if the "
            "drive is at the limit of the amplifier; raise it if the noise of the channels is as large as the force."
        )
    return limited, force / limited, present_wave
