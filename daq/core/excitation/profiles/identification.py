"""Frequency responses of control channels to the drive, from a weak multisine of increasing level.

The responses are accelerations per unit of drive. The responses of sensor, integrator and converter are removed, but
their delay is included.
"""

from collections.abc import Generator, Sequence

import numpy as np

from daq.core.excitation.profiles.spectrum_shaping import Lines, crossfade, sum_of_tones
from daq.core.excitation.sensor_settling import wait_for_sensors
from daq.core.excitation.station import AbortedTest, Station
from rig.core.base.arrays import Array, ComplexArray

#: Lines with a lower coherence are not used.
MIN_COHERENCE = 0.9
# The level is raised until the response has this fraction of the response in the test, or a larger fraction if noise
# requires it.
_RESPONSE_RATIO = 0.1
# First level, relative to that of a table or 1 kg: an unknown rig must not be overloaded.
_FIRST_RATIO = 0.1
# Largest factor by which the drive of a line, or of all lines, changes in a step: a larger one could overload the rig.
_MAX_STEP = 10.0
# Maximum number of increases of the level until a response is detected: ten steps by a factor of 10 exceed any range.
_MAX_SEARCHES = 10
# Maximum number of corrections of the drive spectrum after a response is detected.
_MAX_SHAPINGS = 3
# A response is detected above this multiple of the noise; below, the estimate is mostly noise.
_MIN_SIGNAL_TO_NOISE = 4.0
# Part of the range of the output that the peak of the drive may use.
_OUTPUT_RATIO = 0.3
# Number of periods in which the transient decays.
_SETTLING_PERIODS = 2
# Number of measured periods, whose spectra are averaged.
_PERIODS = 4
#: Expected number of periods of an identification.
EXPECTED_PERIODS = 16
# The test aborts if the coherent lines contain less than this part of the required power.
_MIN_SHARE = 0.5


def accelerations(station: Station, rows: Sequence[int], readings: Array, lines: Lines, period: int) -> ComplexArray:
    """Return the complex amplitudes of the accelerations in one period of readings, shape (rows, lines), m/s²."""
    frequency = lines * station.rate / period
    factors = np.array([station.acceleration_factor(row, frequency) for row in rows])
    # The first reading is subtracted, so constant readings are exactly zero.
    changes = readings[list(rows)] - readings[list(rows), :1]
    return np.asarray(factors * np.fft.rfft(changes, axis=1)[:, lines] * (2.0 / period))


def identify(
    station: Station, rows: Sequence[int], lines: Lines, period: int, required: Array, limits: Array, purpose: str
) -> Generator[Array, Array, tuple[ComplexArray, Array]]:
    """Identify the responses of channels; return them [m/s² per unit of drive] and the coherence; (channels, lines).

    `rows`: rows of the channels, a control channel first; `period`: samples; `required`: amplitude of the first channel
    at each line in the test [m/s²]; `limits`: largest root mean square of each channel in the test [m/s²]; `purpose`:
    name for the generator of the random phases.
    """
    phases = station.generator(purpose).uniform(0.0, 2.0 * np.pi, lines.size)
    yield from wait_for_sensors(station)
    first = station.now
    station.report(0.0, "measuring the noise")
    noise = _rms(accelerations(station, rows, (yield station.zero_drive(period)), lines, period))
    full_level = _rms(required[None])[0]
    response_ratio = float(np.clip(2.0 * _MIN_SIGNAL_TO_NOISE * noise[0] / full_level, _RESPONSE_RATIO, 1.0))
    # Lines without power in the test are measured too.
    floor = 0.1 * float(np.sqrt(np.mean(required**2)))
    desired = response_ratio * np.sqrt(required**2 + floor**2)
    amplitudes, max_increase = _first_drive(station, lines, period, desired, response_ratio)
    wave, shapings = np.zeros(period), 0
    for _ in range(_MAX_SEARCHES + _MAX_SHAPINGS):
        station.report(0.0, "searching the level of the identification")
        previous, wave = wave, sum_of_tones(lines, amplitudes, phases, period)
        largest = float(abs(wave).max())
        is_limited = largest > _OUTPUT_RATIO * station.output_limit
        if is_limited:
            factor = _OUTPUT_RATIO * station.output_limit / largest
            amplitudes, wave = factor * amplitudes, factor * wave
        yield station.drive(crossfade(previous, wave))
        response = np.abs(accelerations(station, rows, (yield station.drive(wave)), lines, period))
        size = _rms(response)
        if size[0] <= _MIN_SIGNAL_TO_NOISE * noise[0]:
            # No response may exceed that in the test.
            allowed = np.min(np.minimum(limits, full_level)[size > 0.0] / size[size > 0.0], initial=np.inf)
            step = float(min(_MAX_STEP, max_increase, allowed))
            if is_limited or step <= 1.0:
                break
            amplitudes, max_increase = step * amplitudes, max_increase / step
            continue
        if shapings == _MAX_SHAPINGS:
            break
        shapings += 1
        ratio = desired / np.maximum(response[0], np.finfo(float).tiny)
        # No channel may exceed this fraction of its limit.
        excess = float(np.max(_rms(np.asarray(response * ratio)) / (response_ratio * limits)))
        amplitudes = amplitudes * np.clip(ratio / max(excess, 1.0), 1.0 / _MAX_STEP, _MAX_STEP)
    station.report(0.0, "identifying the responses to the drive")
    for _ in range(_SETTLING_PERIODS):
        yield station.drive(wave)
    spectra = []
    for _ in range(_PERIODS):
        spectra.append(accelerations(station, rows, (yield station.drive(wave)), lines, period))
    yield station.drive(crossfade(wave, np.zeros(period)))
    measured, drive = np.array(spectra), np.fft.rfft(wave)[lines] * (2.0 / period)
    mean, power = measured.mean(axis=0), np.mean(abs(measured) ** 2, axis=0)
    coherence = np.clip(abs(mean) ** 2 / np.maximum(power, np.finfo(float).tiny), 0.0, 1.0)
    share = float(np.sum(required[coherence[0] >= MIN_COHERENCE] ** 2) / np.sum(required**2))
    level = float(np.sqrt(np.mean(wave**2)))
    station.mark("identification", first, station.now, drive=level, coherent=round(share, 3))
    if not abs(measured[:, 0]).any():
        raise AbortedTest(
            f"the readings of {station.channels[rows[0]].name} are constant while the drive changes. Check its cable, "
            "whether it is at the end of its range, and for an IEPE sensor converter.excitation and converter.coupling."
        )
    if share < _MIN_SHARE:
        raise AbortedTest(
            f"{station.channels[rows[0]].name} does not follow the drive: for {100 * (1 - share):.0f} % of the "
            f"required power, the coherence is below {MIN_COHERENCE:g}. Use a more sensitive sensor, a smaller "
            "converter.range, or a higher level."
        )
    return np.asarray(mean / drive), coherence


def _first_drive(
    station: Station, lines: Lines, period: int, desired: Array, response_ratio: float
) -> tuple[Array, float]:
    """Return amplitudes of a weak drive, and the largest factor by which they may rise (rough estimate: infinite)."""
    # The drive of a table follows from its model, for `response_ratio` times the response of the test. The drive of a
    # force is equal at all lines, estimated for a mass of 1 kg.
    shaker = station.scene.driven_shaker
    assert shaker is not None
    if shaker.prescribed:
        s = np.asarray(2j * np.pi * lines * station.rate / period)
        drive = np.asarray(_FIRST_RATIO * desired * abs(shaker.required_drive(s)[0] / s**2))
        return drive, 1.0 / (_FIRST_RATIO * response_ratio)
    return np.full(lines.size, _FIRST_RATIO * float(np.sqrt(np.mean(desired**2))) / shaker.newtons_per_drive), np.inf


def _rms(amplitudes: Array | ComplexArray) -> Array:
    """Return the root mean square of sums of tones, shape (rows,), from their amplitudes, shape (rows, lines)."""
    return np.asarray(np.sqrt(np.sum(abs(amplitudes) ** 2, axis=1) / 2.0))
