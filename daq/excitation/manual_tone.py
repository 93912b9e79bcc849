"""A tone whose frequency and force an operator sets while it plays."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from daq.excitation import Excitation, Station
from daq.excitation.amplitude_control import AmplitudeControl
from daq.excitation.lock_in import whole_periods
from daq.excitation.stepped_sine import GLIDE, settle
from daq.excitation.tone import Tone
from daq.excitation.tone_measurement import Gauge
from rig.errors import SceneError

# Relative transient at which a level counts as reached; an operator changes the setting before the last percent.
TOLERANCE = 0.01
LONGEST = 60.0
# A force is readjusted if it deviates by more than this fraction in several successive observations.
STRAYED = 0.05
PATIENCE = 5
_LOOK = 0.1


class Knobs:
    """Settings of the operator, Hz and N; they take effect with the next window of the drive.

    >>> knobs = Knobs(13.0, 0.0, highest=1000.0)
    >>> knobs.turn("f 34.8"), knobs.turn("F 2.6"), knobs.asked
    (True, True, (34.8, 2.6))
    >>> knobs.turn("q"), knobs.off
    (True, True)
    """

    HELP = "f 34.8  frequency in Hz;  F 2.6  force amplitude in N;  q  quit"

    def __init__(self, frequency: float, force: float, highest: float) -> None:
        self.highest = highest
        self.off = False
        self.asked = self._frequency(frequency), _force(force)

    def turn(self, line: str) -> bool:
        """Execute a command line; an empty line changes nothing."""
        key, _, value = line.strip().partition(" ")
        frequency, force = self.asked
        if key in ("q", "quit", "exit") and not value:
            self.off = True
        elif key == "f":
            self.asked = self._frequency(_number(value)), force
        elif key == "F":
            self.asked = frequency, _force(_number(value))
        elif key:
            raise SceneError(f"{line.strip()!r}: expected  {self.HELP}")
        return bool(key)

    def _frequency(self, value: float) -> float:
        if not 0.0 < value <= self.highest:
            raise SceneError(f"f {value:g}: expected a frequency above 0 and up to {self.highest:g} Hz")
        return value


def _force(value: float) -> float:
    if not 0.0 <= value < np.inf:
        raise SceneError(f"F {value:g}: expected a force amplitude of 0 N or more")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise SceneError(f"{text!r} is no number; expected  {Knobs.HELP}") from None


@dataclass(frozen=True)
class ToneReading:
    """Readings of the tone in one window."""

    frequency: float
    level: float
    """Requested settings, Hz and N."""
    held: bool
    """Whether the level has been reached and the motion is steady."""
    drive: float
    """Amplitude of the drive, in its unit."""
    force: complex
    """Force of the coil spring, or the drive where the drive is the force, N."""
    displacement: dict[str, complex]
    """Displacement by channel, m; phases have the same reference as `force`."""

    def receptance(self, channel: str) -> complex:
        """Return displacement over force, m/N."""
        return self.displacement[channel] / self.force if self.force else complex(np.nan)


@dataclass
class HandTone:
    """The excitation that follows the knobs; `report` is called after every window."""

    knobs: Knobs
    report: Callable[[ToneReading], None]
    _held: bool = field(default=False, init=False)
    _level: float = field(default=0.0, init=False)

    def excite(self, station: Station) -> Excitation:
        """Play until the knobs are turned off; steady points are marked as in a stepped sine."""
        # Raises without a shaker, before the channels of the spring force are checked.
        station.drive(np.zeros(1))
        return self._play(station, Gauge(station, force=not station.force_is_drive))

    def _play(self, station: Station, gauge: Gauge) -> Excitation:
        tone = Tone(station.rate, self.knobs.asked[0])
        while not self.knobs.off:
            asked = self.knobs.asked
            # The held interval is marked at once, whether the knobs or the run ends it.
            with closing(self._at(station, tone, gauge, *asked)) as work:
                phase, window = tone.phase, next(work)
                while True:
                    readings = yield window
                    self.report(self._reading(station, tone, gauge, readings, phase, asked))
                    if self.knobs.off or self.knobs.asked != asked:
                        break
                    phase, window = tone.phase, work.send(readings)
        yield station.drive(tone.glide(station.samples(GLIDE), tone.frequency, 0.0))

    def _at(self, station: Station, tone: Tone, gauge: Gauge, frequency: float, level: float) -> Excitation:
        """Go to a setting and hold it until the generator is closed."""
        self._held = False
        look = whole_periods(frequency, station.rate, _LOOK)
        if level == 0.0:
            yield station.drive(tone.glide(max(station.samples(GLIDE), look), frequency, 0.0))
            while True:
                yield station.quiet(look)
        control, drive = None, level
        if not station.force_is_drive:
            control = AmplitudeControl(level, station.drive_limit)
            # The drive of the last level is scaled in proportion to the level.
            drive = tone.amplitude * level / (self._level or level) or level * station.cautious_drive
            drive = min(drive, station.drive_limit)
        self._level = level
        while True:
            first, facts = station.now, {"frequency": frequency, "level": level}
            settled = False
            try:
                settled = yield from settle(
                    station, tone, gauge, control, frequency, drive, TOLERANCE, LONGEST
                )
            finally:
                if station.now > first:
                    station.mark("settle", first, station.now, drive=tone.amplitude, settled=settled, **facts)
            yield from self._hold(station, tone, gauge, look, control, settled, facts)
            drive = tone.amplitude

    def _hold(
        self,
        station: Station,
        tone: Tone,
        gauge: Gauge,
        look: int,
        control: AmplitudeControl | None,
        settled: bool,
        facts: dict[str, float],
    ) -> Excitation:
        """Hold until the force deviates, or the operator changes a setting."""
        self._held, strayed, force = settled, 0, facts["level"]
        first = station.now
        try:
            while strayed < PATIENCE:
                phase = tone.phase
                readings = yield station.drive(tone.hold(look))
                if control is not None:
                    force = float(abs(gauge.steady(readings, tone.frequency, phase)[0]))
                strayed = strayed + 1 if abs(force / facts["level"] - 1.0) > STRAYED else 0
        finally:
            self._held = False
            if station.now > first:
                station.mark(
                    "measure", first, station.now, drive=tone.amplitude, force=force, settled=settled, **facts
                )

    def _reading(
        self,
        station: Station,
        tone: Tone,
        gauge: Gauge,
        readings: NDArray[np.float64],
        phase: float,
        asked: tuple[float, float],
    ) -> ToneReading:
        values = gauge.steady(readings, tone.frequency, phase)
        # The drive is amplitude * sin(phase), and a complex amplitude A represents Re(A e^{i phase}).
        force = -1j * tone.amplitude if station.force_is_drive else complex(values[0])
        motions = values if station.force_is_drive else values[1:]
        names = [info.name for info in station.channels if info.quantity not in ("force", "voltage")]
        moved = {name: complex(value) for name, value in zip(names, motions, strict=True)}
        return ToneReading(*asked, self._held, tone.amplitude, force, moved)
