"""Swept sine test: a tone with a continuously changing frequency and a force controlled from the channels.

In sweeps from 10 to 55 Hz (one body: to 40 Hz) in 60 to 300 s, up or down, the force stays within 5 % of its level
through modes with damping ratios of 0.5 to 2 %, and within 10 % for a table without damping. With dampers it stays
within 10 %, except for at most 1 % of the time, when their motion jumps or becomes irregular, or in the first second,
before a mode near the first frequency is identified. Deviations above 10 % have a ``level`` marker, and the run reports
them in a warning. Sweeps from 10 to 55 Hz in 20 s have larger deviations at some frequencies, because the time before a
resonance then contains fewer periods than the identification of its mode requires.
"""

from collections.abc import Generator
from typing import ClassVar, TypeVar

import numpy as np

from daq.core.excitation.controlled import Controlled, controlled
from daq.core.excitation.procedure import Form, Procedure
from daq.core.excitation.profiles.pretest import pretest
from daq.core.excitation.profiles.sweep_control import (
    Observation,
    SweepControl,
    estimate_amplitudes,
    observation_samples,
)
from daq.core.excitation.station import Excitation, Station
from daq.core.excitation.tones.steady_tone import SteadyTone
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.text import format_decimals, format_percent
from rig.core.scene.excitation import SweptSine
from rig.core.scene.excitation.swept_sine import FrequencySweep

SweepT = TypeVar("SweepT", bound=FrequencySweep)

# Number of periods between updates of the drive for a controlled force; fewer do not determine the amplitude.
_WINDOW_PERIODS = 0.5
# The drive is updated after at least this number of samples, from which an amplitude and a phase can be estimated.
_MIN_WINDOW_SAMPLES = 4
# Length of the windows in open loop [s].
_WINDOW_S = 0.1
# Largest transient before the sweep, relative to the amplitude; the transient of the sweep itself is larger.
_TOLERANCE = 0.01
# Longest wait for the steady state at the first frequency [s]; irregular motion of dampers never reaches it.
_MAX_WAIT_S = 60.0
# The force may deviate from its level by at most this fraction.
ALLOWED_DEVIATION = 0.1
# Two intervals of excessive deviation are merged if the gap between them is shorter than this value [s].
_MIN_GAP_S = 0.5
# Remedy if the channels do not measure the force.
_SENSITIVITY_HINT = "Choose more sensitive sensors, a smaller converter.range, or more force."


def _sweep_controlled(
    force: Controlled,
    test: SweptSine,
    start_phase: float,
    amplitude: complex,
    control: SweepControl,
    monitor: "LevelMonitor",
) -> Generator[Array, Array, complex]:
    """Sweep from a phase and complex amplitude of the drive with constant force; return the final amplitude."""
    station, rows, stiffness = force.station, list(force.rows), force.factors[0]
    total, completed, rate = station.samples(test.duration), 0, station.rate
    # Readings at both ends of the coil spring, and phases of the tone, in the latest samples.
    recent, phases = np.zeros((2, 0)), np.zeros(0)
    next_amplitude = amplitude
    while completed < total:
        frequency = test.frequency_at(completed / total)
        window = min(total - completed, max(_MIN_WINDOW_SAMPLES, round(_WINDOW_PERIODS * rate / frequency)))
        phase = _phase(test, start_phase, completed, window, total)
        envelope = amplitude + (next_amplitude - amplitude) * np.arange(window) / window
        readings = yield station.drive(np.real(envelope * np.exp(1j * phase)))
        completed, amplitude = completed + window, next_amplitude
        control.add_drive(completed / rate, amplitude)
        length = observation_samples(frequency, rate)
        recent = np.concatenate([recent, readings[rows]], axis=1)[:, -length:]
        phases = np.concatenate([phases, phase])[-length:]
        if phases.size < length:
            continue
        middle_frequency = test.frequency_at((completed - length / 2) / total)
        table, body = _displacements(station, rows, middle_frequency, *estimate_amplitudes(recent, phases, rate))
        spring_force = stiffness * (table - body)
        monitor.add(station.now - length, station.now, middle_frequency, abs(spring_force))
        newest_frequency = test.frequency_at(completed / total)
        sweep_rate = (newest_frequency - middle_frequency) / (length / 2 / rate)
        observation = Observation(completed / rate, middle_frequency, sweep_rate, length / rate, body, spring_force)
        next_amplitude = control.next_drive(observation, window / rate)
        station.report(completed / total, f"{format_decimals(newest_frequency, 2)} Hz")
    return amplitude


class LevelMonitor:
    """Marks intervals in which the force deviates by more than 10 % from its level in N as ``level``.

    `lowest` and `highest` are the extremes of the force relative to the level.
    """

    def __init__(self, station: Station, level: float) -> None:
        self._station, self._level = station, level
        self.lowest = self.highest = 1.0
        # Intervals: first sample, sample after the last, largest force / level, and its frequency [Hz].
        self._interval: tuple[int, int, float, float] | None = None  # the current interval
        self._marked: list[tuple[int, int, float, float]] = []

    def add(self, first: int, stop: int, frequency: float, force: float) -> None:
        """Add the force amplitude in N of the samples first to stop - 1, at a frequency in Hz."""
        ratio = force / self._level
        self.lowest, self.highest = min(self.lowest, ratio), max(self.highest, ratio)
        if self._interval is not None and first - self._interval[1] >= self._station.samples(_MIN_GAP_S):
            self._end_interval()
        if abs(ratio - 1.0) <= ALLOWED_DEVIATION:
            return
        begin, _, worst, worst_frequency = self._interval or (first, stop, 1.0, frequency)
        if abs(ratio - 1.0) > abs(worst - 1.0):
            worst, worst_frequency = ratio, frequency
        self._interval = begin, stop, worst, worst_frequency

    def close(self, samples: int) -> None:
        """Mark an open interval, and warn if the force deviated from its level; `samples`: length of the sweep."""
        if self._interval is not None:
            self._end_interval()
        if self._marked:
            _, _, worst, worst_frequency = max(self._marked, key=lambda interval: abs(interval[2] - 1.0))
            outside, count = sum(stop - first for first, stop, *_ in self._marked), len(self._marked)
            remedy = "Sweep more slowly, or use a stepped sine."
            if self.lowest == 0.0:
                remedy = f"At times the signals are below one count of the converter. {_SENSITIVITY_HINT}"
            self._station.warn(
                f"the spring force deviates from its level of {self._level:g} N by more than "
                f"{format_percent(ALLOWED_DEVIATION)} in {count} interval{'s' if count > 1 else ''}, "
                f"{format_percent(outside / samples)} of the sweep, and most at {format_decimals(worst_frequency, 2)} "
                f"Hz ({worst:.3g} times the level). The intervals are marked 'level' in the recording. {remedy}"
            )

    def _end_interval(self) -> None:
        """Mark the current interval."""
        assert self._interval is not None
        first, stop, worst, worst_frequency = self._interval
        self._station.mark("level", first, stop, worst=worst, frequency=worst_frequency, level=self._level)
        self._marked.append(self._interval)
        self._interval = None


def _displacements(
    station: Station, rows: list[int], frequency: float, amplitudes: ComplexArray, slopes: ComplexArray
) -> list[complex]:
    """Return displacements in m at a frequency in Hz, from the channels' amplitudes and their slopes (per second)."""
    step = 1e-3 * frequency
    displacements = []
    for row, amplitude, slope in zip(rows, amplitudes, slopes, strict=True):
        lower, center, upper = station.displacement_factor(row, frequency + step * np.array([-1.0, 0.0, 1.0]))
        # First-order expansion of the conversion about the frequency, because the amplitude changes.
        displacements.append(complex(center * amplitude + (upper - lower) / (4j * np.pi * step) * slope))
    return displacements


def _phase(test: SweptSine, start_phase: float, completed: int, window: int, total: int) -> Array:
    """Return the phase [rad] at the next `window` samples after `completed` of `total` samples of a sweep."""
    return start_phase + 2 * np.pi * test.periods_at(np.arange(completed, completed + window) / total)


class SweepProcedure(Procedure[SweepT]):
    """A sine whose frequency sweeps; `period_cpu_s`: CPU time of a controlled period on one core of 2 GHz [s]."""

    period_cpu_s: ClassVar[float]

    def control_seconds(self, test: SweepT) -> float:
        """Return the CPU time of the controller, which works in each period [s]."""
        return self.period_cpu_s * (test.from_ + test.to) / 2.0 * test.duration

    def frequency_at(self, test: SweepT, fraction: float) -> float:
        """Return the frequency [Hz] after a `fraction`, 0 to 1, of the duration."""
        return float(test.frequency_at(fraction))


class SweptSineProcedure(SweepProcedure["SweptSine"]):
    """A sweep of constant force or drive."""

    period_cpu_s = 1.2e-3
    rehearsal = "peaks"
    form = Form("sweep", ("level", "low", "high", "duration"))

    def excite(self, station: Station, test: SweptSine) -> Excitation:
        """Run a swept sine.

        With a controlled spring force, a pretest identifies the shaker (`ShakerLaw`), and the sweep begins when the
        force is at its level.
        """
        force = controlled(station)
        tone = SteadyTone(station, test.from_, force)
        level, law = station.level, None
        if force is not None:
            station.report(0.0, "measuring the shaker")
            law = yield from pretest(station, force, *test.band, level)
        station.report(0.0, f"settling at {format_decimals(test.from_, 2)} Hz")
        first = station.now
        settled = yield from tone.settle({test.from_: tone.start(level)}, _TOLERANCE, _MAX_WAIT_S)
        station.mark("settle", first, station.now, frequency=test.from_, level=level, settled=settled)

        first, start_phase = station.now, tone.phase
        amplitude, extremes = -1j * tone.amplitude, {}
        # All motion coefficients are zero if the table's channel did not change in the pretest.
        if force is not None and law is not None and law.motion.any():
            monitor = LevelMonitor(station, level)
            sweep = SweepControl(law, level, station.drive_limit, amplitude)
            amplitude = yield from _sweep_controlled(force, test, start_phase, amplitude, sweep, monitor)
            monitor.close(station.now - first)
            extremes = {"lowest": monitor.lowest, "highest": monitor.highest}
        else:
            if force is not None:
                station.warn(
                    f"the spring force was not controlled at {level:g} N: channel "
                    f"{station.channels[force.rows[0]].name} at the {station.scene.at_driven('table')} did not change "
                    f"in the pretest, because its signal is below one count of the converter. {_SENSITIVITY_HINT}"
                )
            total, completed = station.samples(test.duration), 0
            while completed < total:
                window = min(total - completed, station.samples(_WINDOW_S))
                phase = _phase(test, start_phase, completed, window, total)
                yield station.drive((amplitude * np.exp(1j * phase)).real)
                completed += window
                station.report(completed / total, f"{format_decimals(test.frequency_at(completed / total), 2)} Hz")
        tone.amplitude, tone.frequency = abs(amplitude), test.to
        periods = float(test.periods_at(np.ones(1))[0])
        tone.phase = float(np.fmod(start_phase + 2 * np.pi * periods + np.angle(1j * amplitude), 2 * np.pi))
        fields = {"from": test.from_, "to": test.to, "spacing": test.spacing, "level": level, **extremes}
        station.mark("measure", first, station.now, duration=test.duration, settled=settled, **fields)
        yield tone.end()

    def snr_gain(self, test: SweptSine, frequency: Array) -> Array:
        """Return the signal-to-noise ratio while the sweep passes its resolution bandwidth [sqrt(s)]."""
        # A sweep of the rate r (Hz/s) stays within its resolution bandwidth sqrt(r) for the time 1 / sqrt(r).
        rate = np.broadcast_to(abs(test.frequency_slope(frequency)), frequency.shape)
        return np.asarray(np.sqrt(1.0 / np.sqrt(rate) / 2.0))


PROCEDURE = SweptSineProcedure()
