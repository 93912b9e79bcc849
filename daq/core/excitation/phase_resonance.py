"""Phase resonance: the frequency of a tone follows a resonance while the level is raised (backbone curve)."""

import math
from collections import deque
from collections.abc import Generator
from typing import Any, NamedTuple

import numpy as np

from daq.core.excitation.controlled import controlled, displacement, measured_force
from daq.core.excitation.lock_in import whole_periods
from daq.core.excitation.procedure import Form
from daq.core.excitation.station import AbortedTest, Excitation, Station
from daq.core.excitation.stepped_sine import SteadyTonesProcedure
from daq.core.excitation.tones.phase_loop import PhaseLoop, loop_settings
from daq.core.excitation.tones.repeating_tone import RepeatingTone
from daq.core.excitation.tones.settling import Settling
from daq.core.excitation.tones.steady_tone import TRANSITION_S, WINDOW_S
from rig.core.base.arrays import Array
from rig.core.results.text import format_decimals
from rig.core.scene.excitation import PhaseResonance
from rig.core.scene.scene import Scene

# Number of successive windows within the tolerance that lock the phase; the frequency is averaged over them.
_LOCKED_WINDOWS = 8
# Largest mean deviation of a locked phase, relative to the tolerance; the rest of the tolerance is for its scatter.
_LOCKED_RATIO = 0.7
# Without a lock, the motion is assumed to be unsteady if the phase is within this multiple of the tolerance; if it is
# farther away, the band is assumed to contain no resonance.
_MAX_SCATTER_RATIO = 5.0
# Maximum number of locks at a level: the phase can leave the tolerance again while the frequency is constant.
_MAX_LOCKS = 4
# Maximum number of changes of the drive at a level; more are needed only if the force jumps.
_MAX_DRIVES = 12
# Smallest force [counts of the converter] whose phase is determined, above the steps of quantization.
_MIN_COUNTS = 2.0
# The expected wait at a level, periods, measured with the bundled scenes.
_PERIODS_OF_LOCK = 400.0


class _Window(NamedTuple):
    """Amplitudes in a window, and the phase of the displacement relative to the force."""

    frequency: float  # of the tone [Hz]
    motion: complex  # m
    force: complex  # N
    phase: float  # rad


class _Measured(NamedTuple):
    """A measurement at constant frequency."""

    first: int  # first sample
    window: _Window
    repetition: int  # number of periods of the tone after which the motion repeats, as far as noise permits; 0: none
    is_resonant: bool  # whether the phase is within its tolerance


class _PhaseTone(RepeatingTone):
    """A tone whose frequency follows the phase."""

    def __init__(self, station: Station, test: PhaseResonance) -> None:
        super().__init__(station, test.frequency, controlled(station), displacement(station, test.at), test.settle)
        self._test, self._quantities = test, (self._quantity, measured_force(station))
        self._samples = np.empty(0)  # of the first channel of the motion, in the last window
        self._settings = loop_settings(station.scene, station.latency / station.rate)

    def window_of(self, samples: int) -> Generator[Array, Array, _Window]:
        """Hold the tone for a window."""
        tone = [self.frequency], [self.phase]
        readings = yield self.station.drive(self.hold(samples))
        self._samples = readings[self._quantity.rows[0]]
        motion, force = (
            -1j * self.amplitude if quantity is None else complex(quantity.amplitudes(readings, *tone)[0])
            for quantity in self._quantities
        )
        return _Window(self.frequency, motion, force, float(np.angle(motion / force)) if force else 0.0)

    def measure_resonance(self) -> Generator[Array, Array, tuple[_Measured, bool]]:
        """Measure at constant frequency; return the result, and whether another measurement can be steadier."""
        first = self.station.now
        shortest_s = round(self._test.measure.periods * self.station.rate / self.frequency) / self.rate
        window = yield from self.window_of(whole_periods(self.frequency, self.rate, shortest_s))
        repetition = self.repetition(self._samples, abs(window.motion))
        is_resonant = abs(self.loop.error(window.phase)) <= self._test.tolerance
        return _Measured(first, window, repetition, is_resonant), is_resonant and repetition != 1

    def lock(self) -> Generator[Array, Array, tuple[bool, float]]:
        """Lock the phase by the frequency; return whether it is locked and steady, and the amplitude of the force."""
        detector, test = Settling(self._test.settle.tolerance), self._test
        windows = deque[_Window](maxlen=_LOCKED_WINDOWS)
        loop = self.loop = PhaseLoop(self.frequency, test.from_, test.to, test.phase, test.tolerance, self._settings)
        end = self.station.now + self.station.samples(test.settle.longest)
        while self.station.now < end:
            samples = whole_periods(self.frequency, self.rate, WINDOW_S * loop.settings.slowness)
            window = yield from self.window_of(samples)
            windows.append(window)
            if window.force:
                # The frequency of the tone changes the phases of the amplitudes; only their ratio is steady.
                detector.add(np.array([window.motion / window.force * abs(window.force), abs(window.force) + 0j]))
            mean_error = float(np.mean([loop.error(each.phase) for each in windows]))
            is_locked = len(windows) == _LOCKED_WINDOWS and abs(mean_error) < _LOCKED_RATIO * test.tolerance
            if detector.settled and is_locked:
                self.frequency = float(np.mean([each.frequency for each in windows]))
                return True, float(np.mean([abs(each.force) for each in windows]))
            self._settings = loop.settings
            dead_time = (1.5 * samples + self.station.latency) / self.rate
            self.frequency = loop.next_frequency(window.phase, samples / self.rate, dead_time)
        return False, abs(windows[-1].force) if windows else 0.0

    def failure(self, measured: _Window) -> str:
        """Describe why a level has no lock."""
        test, (_, quantity) = self._test, self._quantities
        count = None if quantity is None else self.station.channels[quantity.rows[0]].unit_per_count
        if quantity is not None and count is not None and quantity.factors == (1.0,):
            counts = abs(measured.force) / count
            if counts < _MIN_COUNTS:
                return f"the force is {counts:.2g} counts of the converter. Use a more sensitive force sensor."
        cause = (
            f". No resonance lies between {test.from_:g} and {test.to:g} Hz, the damping falls too fast with the "
            "amplitude (test constant_response), or the motion is irregular."
        )
        if abs(self.loop.error(measured.phase)) <= _MAX_SCATTER_RATIO * test.tolerance:
            cause = (
                "; phase, motion or force is not steady. The motion may be irregular. Choose another level, or "
                "increase test.settle.longest or test.settle.tolerance."
            )
        return (
            f"no lock within {test.settle.longest:g} s: the phase is {math.degrees(measured.phase):.0f}° at "
            f"{self.frequency:.4g} Hz{cause}"
        )


class PhaseResonanceProcedure(SteadyTonesProcedure["PhaseResonance"]):
    """A tone that follows a resonance."""

    form = Form("phase resonance", ("level", "frequency", "low", "high"))
    waits_for_sensors = True
    duration_ratio = 2.0

    def excite(self, station: Station, test: PhaseResonance) -> Excitation:
        """Lock the phase at each level, and measure at constant frequency; raise `AbortedTest` without any lock."""
        tone, failures = _PhaseTone(station, test), list[str]()
        frequency, drive = test.frequency, 0.0
        yield from tone.measure_noise()
        for number, level in enumerate(test.levels):
            at_level = f"level {station.level_text(level)}"
            station.report(number / len(test.levels), f"{at_level}, {format_decimals(tone.frequency, 3)} Hz")
            first_drive = tone.start(level)
            drive = first_drive if not number or not station.is_controlled else drive * level / test.levels[number - 1]
            first = station.now
            yield station.drive(tone.transition(station.samples(TRANSITION_S), frequency, drive))
            locked = False
            for _ in range(_MAX_DRIVES):
                locked, force = yield from tone.lock()
                if not locked or tone.control is None or tone.control.is_at_level(force):
                    break
                locked, drive = False, tone.control.next_drive(tone.amplitude, force)
                yield station.drive(tone.transition(station.samples(TRANSITION_S), tone.frequency, drive))
            fields: dict[str, Any] = {"level": level, "direction": "up"}
            station.mark(
                "settle", first, station.now, drive=tone.amplitude, settled=locked, frequency=tone.frequency, **fields
            )
            for attempt in range(_MAX_LOCKS):
                measured = yield from tone.until_decayed(tone.measure_resonance)
                if not locked or measured.is_resonant or attempt == _MAX_LOCKS - 1:
                    locked = locked and measured.is_resonant
                    break
                locked, _ = yield from tone.lock()
            station.mark(
                "measure", measured.first, station.now, drive=tone.amplitude, force=abs(measured.window.force),
                settled=locked and measured.repetition > 0, frequency=tone.frequency, phase=measured.window.phase,
                repetition=measured.repetition, **fields,
            )  # fmt: skip
            if locked:
                frequency, drive = tone.frequency, tone.amplitude
                tone.add_repetition(level, measured.repetition)
            else:
                failures.append(f"{at_level}: {tone.failure(measured.window)}")
        yield tone.end()
        if len(failures) == len(test.levels):
            raise AbortedTest(failures[0])
        for message in failures:
            station.warn(message)
        tone.warn_of_repetitions()
        station.report(1.0, "done")

    def waits(self, test: PhaseResonance, scene: Scene) -> float:
        """Return the expected time of all locks [s]."""
        return len(test.levels) * min(_PERIODS_OF_LOCK / test.frequency, test.settle.longest)


PROCEDURE = PhaseResonanceProcedure()
