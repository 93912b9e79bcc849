"""A tone that settles at points of a response curve: without feedback at a level, or with feedback at an amplitude."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daq.core.excitation.controlled import Controlled, displacement
from daq.core.excitation.station import Station
from daq.core.excitation.tones.envelope_control import AVERAGED_WINDOWS, MAX_POLE_TIMES_DEAD_TIME, EnvelopeTone
from daq.core.excitation.tones.steady_tone import TRANSITION_S, AmplitudeControl
from rig.core.base.arrays import Array, ComplexArray

if TYPE_CHECKING:
    from rig.core.scene.excitation import Continuation

# The input gain is estimated from this number of points measured without feedback: several, because each has noise.
_FLANK_POINTS = 3
# Maximum number of drives that correct a point; more are needed only if the control has lost the curve.
_MAX_DRIVES = 8
# A change of the frequency (in Hz) of less than this number divided by the dead time (in s) is made within one window.
_SMALL_TURN = 0.05


class Point(NamedTuple):
    """A point of a response curve, measured in steady state."""

    frequency: float  # frequency of the tone [Hz]
    motion: float  # displacement amplitude [m]
    level: float  # amplitude of the force or drive
    pole: complex  # pole of the mode relative to the tone [1/s]; 0 before it is known


class CurveTone(EnvelopeTone):
    """A tone that settles at points of a curve; `force`: the quantity at the level, None if it is the drive."""

    # Shorter windows permit control of unstable motions that grow faster.
    periods = 2.0

    def __init__(self, station: Station, test: Continuation, force: Controlled | None) -> None:
        super().__init__(station, test.from_, displacement(station, test.at), test.settle)
        self._test = test
        self._force = force
        self._forces = deque[float](maxlen=AVERAGED_WINDOWS)
        self.forget_mode()

    def forget_mode(self) -> None:
        """Discard the model of the mode."""
        super().forget_mode()
        self._flank = deque[tuple[float, complex]](maxlen=_FLANK_POINTS)  # angular frequency and ratio X / U of points
        self._is_flank = True  # until feedback begins

    def _add(self, motion: complex, drive: complex, samples: int) -> None:
        """Do nothing: the mode depends on the amplitude, so transients do not determine it (see `_learn_gain`)."""

    def _learn_gain(self) -> None:
        """Estimate the input gain b and the pole s of the mode by least squares.

        At points measured without feedback, displacement X and drive U obey (i w - s) X = b U. Beyond the flank, where
        feedback has begun, impacts change the ratio of X and U more than the frequency does.
        """
        if not self._is_flank:
            return
        self._flank.append((2.0 * math.pi * self.frequency, self.motion / self.envelope))
        if len(self._flank) >= 2:
            omega, response = np.array(self._flank).T
            # i w = s + b U / X, weighted by X / U
            columns = np.stack([response, np.ones_like(response)], axis=1)
            self._pole, self._gain = map(complex, np.linalg.lstsq(columns, 1j * omega.real * response)[0])

    def start(self, level: float) -> float:
        """Forget the mode of the last level; return the amplitude of the first drive."""
        self.forget_mode()
        self.frequency = self._test.from_
        return level if self._force is None else level * self.station.cautious_drive

    def amplitudes(self, readings: Array, phases: Sequence[float]) -> ComplexArray:
        """Return the complex amplitudes (tones, quantities) in a window, and store the amplitude of the force."""
        if self._force is not None:
            self._forces.append(float(abs(self._force.amplitudes(readings, [self.frequency], phases)[0])))
        return super().amplitudes(readings, phases)

    def point(self) -> Point:
        """Return the current point, which has settled."""
        level = self.amplitude if self._force is None else float(np.mean(self._forces))
        return Point(self.frequency, abs(self.motion), level, -self._gain * self.envelope / self.motion)

    def drive_to(self, frequency: float, drive: float, level: float) -> Generator[Array, Array, Point | None]:
        """Settle at a frequency in Hz and the level, without feedback; return the point, None if it did not settle."""
        self.control, control = None, AmplitudeControl(level, self.station.drive_limit)
        settle = self._settle
        for _ in range(_MAX_DRIVES):
            settled = yield from self.settle({frequency: drive}, settle.tolerance, settle.longest)
            # The force is averaged without the transients before the steady state.
            self._forces.clear()
            windows = 1 if self._force is None else AVERAGED_WINDOWS
            yield from self.observe(windows * self.window)
            if not settled or not self.motion:
                return None
            point = self.point()
            if self._force is None or control.is_at_level(point.level):
                self._learn_gain()
                return self.point()
            drive = control.next_drive(self.amplitude, point.level)
        return None

    def hold_at(self, frequency: float, motion: float) -> Generator[Array, Array, Point | None]:
        """Settle at a frequency in Hz and an amplitude in m by feedback; return the point, None if it did not settle.

        A small change of frequency needs a short transition, in which the growth of an unstable motion is negligible.
        """
        if not self._gain:
            # The model of the mode was discarded, because the control lost the motion.
            return None
        self._is_flank = False
        transition_s = 0.0 if abs(frequency - self.frequency) * self.dead_time < _SMALL_TURN else TRANSITION_S
        settled = yield from self.settle_envelope(frequency, self.amplitude, motion, self._settle.longest, transition_s)
        return self.point() if settled else None

    def is_holdable(self, point: Point, ratio: float) -> bool:
        """Return whether feedback can hold a point: |pole| times dead time is at most `ratio` times its limit."""
        return 0.0 < abs(point.pole) * self.dead_time <= ratio * MAX_POLE_TIMES_DEAD_TIME
