"""Excitation by a tone whose frequency and force the operator changes during the test."""

from contextlib import closing
from dataclasses import dataclass, field

import numpy as np

from daq.core.excitation.controlled import controlled
from daq.core.excitation.lock_in import whole_periods
from daq.core.excitation.station import Excitation, Station
from daq.core.excitation.tones.steady_tone import TRANSITION_S, WINDOW_S, SteadyTone
from rig.core.base.errors import SceneError

# The steady state is reached when the transient is below this fraction of the amplitude. The tolerance is coarse,
# because an operator does not wait for a smaller transient.
_TOLERANCE = 0.01
# Longest wait for the steady state [s]; irregular motion of dampers never reaches it.
_MAX_WAIT_S = 60.0
# The drive is readjusted if the force deviates from its level by more than this fraction, which an operator would
# notice.
_MAX_DEVIATION = 0.05
# Number of successive windows with a larger deviation that cause a readjustment; a single impact does not.
_DEVIATING_WINDOWS = 5


class ToneControls:
    """Frequency [Hz] and force amplitude [N] of the operator; they take effect with the next window of the drive.

    `highest`: highest permitted frequency [Hz].

    >>> controls = ToneControls(13.0, 0.0, highest=1000.0)
    >>> controls.set(34.8, 2.6)
    >>> controls.settings
    (34.8, 2.6)
    """

    def __init__(self, frequency: float, force: float, highest: float) -> None:
        self.highest = highest
        self.set(frequency, force)

    def set(self, frequency: float, force: float) -> None:
        """Change frequency and force; raise `SceneError` if a value is out of range."""
        if not 0.0 < frequency <= self.highest:
            raise SceneError(
                f"frequency: {frequency:g} Hz is out of range. Give a frequency above 0 and up to {self.highest:g} Hz."
            )
        if not 0.0 <= force < np.inf:
            raise SceneError(f"force: {force:g} N is out of range. Give a force amplitude of 0 N or more.")
        self.settings = frequency, force


@dataclass
class ManualTone:
    """Excitation by a tone with the operator's settings."""

    controls: ToneControls
    _level: float = field(default=0.0, init=False)

    def excite(self, station: Station) -> Excitation:
        """Output the tone until the run ends; mark steady intervals as a stepped sine does."""
        # This raises `SceneError` without a shaker, before the channels of the spring force are checked.
        station.drive(np.zeros(1))
        tone = SteadyTone(station, self.controls.settings[0], controlled(station))
        while True:
            requested = self.controls.settings
            # Closing the generator marks the steady-state interval, even if the run ends early.
            with closing(self._hold_setting(tone, *requested)) as drives:
                readings = yield next(drives)
                while self.controls.settings == requested:
                    readings = yield drives.send(readings)

    def _hold_setting(self, tone: SteadyTone, frequency: float, level: float) -> Excitation:
        """Change to a frequency in Hz and a force level in N, and hold both until the generator is closed."""
        station = tone.station
        window = whole_periods(frequency, station.rate, WINDOW_S)
        if level == 0.0:
            yield station.drive(tone.transition(max(station.samples(TRANSITION_S), window), frequency, 0.0))
            while True:
                yield station.zero_drive(window)
        previous_drive, drive = tone.amplitude, tone.start(level)
        if tone.control is not None:
            # First estimate: the drive is proportional to the level. Without a previous drive, `tone.start` returns the
            # first estimate.
            drive = min(previous_drive * level / (self._level or level) or drive, station.drive_limit)
        self._level = level
        fields = {"frequency": frequency, "level": level}
        while True:
            first, settled = station.now, False
            try:
                settled = yield from tone.settle({frequency: drive}, _TOLERANCE, _MAX_WAIT_S)
            finally:
                if station.now > first:
                    station.mark("settle", first, station.now, drive=tone.amplitude, settled=settled, **fields)
            yield from self._hold_drive(tone, window, settled, fields)
            drive = tone.amplitude

    def _hold_drive(self, tone: SteadyTone, window: int, settled: bool, fields: dict[str, float]) -> Excitation:
        """Hold the drive until the force deviates from its level, and mark the interval."""
        deviating_windows, force, station = 0, fields["level"], tone.station
        first = station.now
        try:
            while deviating_windows < _DEVIATING_WINDOWS:
                phase = tone.phase
                readings = yield station.drive(tone.hold(window))
                if tone.control is not None:
                    force = float(abs(tone.amplitudes(readings, [phase])[0, 0]))
                deviating_windows = deviating_windows + 1 if abs(force / fields["level"] - 1.0) > _MAX_DEVIATION else 0
        finally:
            if station.now > first:
                station.mark(
                    "measure", first, station.now, drive=tone.amplitude, force=force, settled=settled, **fields
                )
