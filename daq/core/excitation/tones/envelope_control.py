"""Control of the complex envelope of a motion at constant frequency, by the complex amplitude of the drive.

The envelopes X of the motion and U of the drive are relative to the phase of the tone: x = Re(X e^{i phase}), drive =
Im(U e^{i phase}). Near a mode with the decay rate d = zeta w0 they obey

    X' = l X + b U,    l = -d + i (w0(|X|) - w)

In steady state U is constant, so the drive is a pure tone even if the motion has harmonics: the control does not
change the motion that it holds. (J. Sieber, B. Krauskopf, Nonlinear Dynamics 51 (2008) 365.)
"""

from collections import deque
from collections.abc import Generator, Sequence
from typing import Any, NamedTuple

import numpy as np

from daq.core.excitation.controlled import Controlled
from daq.core.excitation.lock_in import min_samples
from daq.core.excitation.station import Station
from daq.core.excitation.tones.nearest_mode import NearestMode
from daq.core.excitation.tones.repeating_tone import RepeatingTone
from daq.core.excitation.tones.settling import Settling
from daq.core.excitation.tones.steady_tone import MAX_TOLERANCE, TRANSITION_S, half_cosine
from rig.core.base.arrays import Array, ComplexArray
from rig.core.scene.excitation import FORCE_TOLERANCE
from rig.core.scene.excitation.kind import Settle

# Largest product of |l| and dead time at which the control is used. From 0.54 on, the stability limit is in error.
MAX_POLE_TIMES_DEAD_TIME = 0.5
# Largest product of open-loop growth and dead time that the control stabilizes: with the scene `continuation`, 0.28 was
# held and 0.31 lost.
MAX_GROWTH_TIMES_DEAD_TIME = 0.3
# An observation updates the model of the mode if motion or drive changed by more than this fraction; smaller changes
# are noise.
_MIN_CHANGE = 0.01
# Number of latest drives that determine the limit of the next drive, so a single small drive does not stop the control.
_LATEST_DRIVES = 12
# The drive changes between windows by at most this fraction of the largest of the latest drives: a wrong model must not
# overload the rig.
_MAX_CHANGE_RATIO = 0.5
# Time after which the weight of an observation of the mode has decreased to 1 / e, windows. The observations of several
# steps at one level have the same mode.
_MEMORY_WINDOWS = 100.0
# Above this multiple of the target, the drive is limited to the largest of the latest drives, to protect the rig.
_MAX_EXCESS = 1.5
# The control is lost above this multiple of the target: the model of the mode is wrong.
_LOST_RATIO = 3.0
# The gain is too high if an alternating error grows from one group of this number of updates to the next.
_COMPARED_ERRORS = 5
# The gain is then reduced to this fraction of the initial gain, which still holds most unstable orbits.
_REDUCED_GAIN = 0.5
# Number of last windows over which the drive is averaged in steady state, to reduce its noise.
AVERAGED_WINDOWS = 12
# In steady state, the drives of these windows have at most this relative standard deviation.
_MAX_SCATTER = 0.01
# The motion has left its target if it deviates by more than this multiple of the tolerance; it scatters by less.
_LEFT_RATIO = 2.0


class EnvelopeControl:
    """PI control of an envelope: the SIMC rules for an integrating plant with dead time.

    The gain margin is 3, the phase margin 47 degrees (S. Skogestad, J. Process Control 13 (2003) 291). `target`:
    required envelope; `drive`: present envelope of the drive; `window`: time from one update to the next [s];
    `dead_time`: s; `limit`: largest drive.

    >>> control, motion, drive = EnvelopeControl(1.0, 0j, 0.1, 0.15), 0j, 0.1j
    >>> for _ in range(200):
    ...     drive, applied = control.next_drive(motion, 2.0), drive
    ...     motion += 0.1 * (0.3 * motion + 2.0 * applied)  # open loop: unstable
    >>> bool(abs(motion - 1.0) < 1e-3)
    True
    """

    def __init__(self, target: complex, drive: complex, window: float, dead_time: float, limit: float = np.inf) -> None:
        self.target = target
        self._integral, self._drive, self._limit = drive, drive, limit
        self._errors: list[complex] = []
        self._latest = deque([drive], maxlen=_LATEST_DRIVES)
        self._lowest_gain = _REDUCED_GAIN / (2.0 * dead_time)
        self._gain, self._integral_ratio = 1.0 / (2.0 * dead_time), window / (8.0 * dead_time)

    def next_drive(self, motion: complex, input_gain: complex) -> complex:
        """Compute the next drive from the envelope of the motion and the input gain b of the plant."""
        self._errors.append(self.target - motion)
        if len(self._errors) == 2 * _COMPARED_ERRORS:
            before, latest = np.split(np.array(self._errors), 2)
            rms = float(np.sqrt(np.mean(abs(latest) ** 2)))
            if abs(np.mean(latest)) < 0.5 * rms and rms > np.sqrt(np.mean(abs(before) ** 2)):
                self._gain = self._lowest_gain
            self._errors.clear()
        correction = self._gain * (self.target - motion) / input_gain
        step = self._integral_ratio * correction
        previous, requested = self._drive, self._integral + step + correction
        change = requested - previous
        largest = max(map(abs, self._latest))
        if largest and abs(change) > _MAX_CHANGE_RATIO * largest:
            change *= _MAX_CHANGE_RATIO * largest / abs(change)
        self._drive = previous + change
        limit = min(self._limit, largest) if abs(motion) > _MAX_EXCESS * abs(self.target) else self._limit
        if abs(self._drive) > limit:
            self._drive *= limit / abs(self._drive)
        self._latest.append(self._drive)
        # The part of the drive beyond the limit is not integrated, so the integral does not wind up.
        self._integral += step + self._drive - requested
        return self._drive


class Held(NamedTuple):
    """A measurement at constant envelope."""

    first: int  # first sample
    motion: complex  # mean envelope [m]
    drive: complex  # mean envelope
    invasive: float  # root mean square of the changes of the drive by the control, relative to the drive
    growth: float  # rate at which the motion left its target with a constant drive [1/s]; 0 if it stayed
    repetition: int  # number of periods of the tone after which the motion repeats, as far as noise permits; 0: none


class EnvelopeTone(RepeatingTone):
    """A tone with a complex amplitude, and a model of the mode nearest to it (`NearestMode`)."""

    # Length of a control window, periods. Three periods contain the impacts of several cycles.
    periods = 3.0

    def __init__(self, station: Station, frequency: float, controlled: Controlled, settle: Settle) -> None:
        super().__init__(station, frequency, controlled, controlled, settle)
        self.forget_mode()
        self.direction = 1.0 + 0j  # phase of the drive relative to that of the envelopes, as e^{i phase}
        self.motion = 0j  # last envelope of the controlled motion [m]
        self.scatter = 0.0  # relative standard deviation of the last drives
        self._readings: list[Array] = []  # of the first channel of the motion, since the last measurement began
        self._observed = 0.0, 0j, 0j  # frequency and envelopes of motion and drive in the last observation of the mode

    def forget_mode(self) -> None:
        """Discard the model of the mode: the level has changed, or the model is wrong."""
        self._mode, self._pole, self._gain = NearestMode(), 0j, 0j

    @property
    def window(self) -> int:
        """Length of a control window."""
        return self._window_at(self.frequency)

    def _window_at(self, frequency: float) -> int:
        """Return the length of a control window in samples at a frequency in Hz."""
        return max(min_samples([frequency], self.rate), round(self.periods * self.rate / frequency))

    @property
    def dead_time(self) -> float:
        """Half a window of measurement, a window of transition, and the latency; s."""
        return (1.5 * self.window + self.station.latency) / self.rate

    @property
    def envelope(self) -> complex:
        """Envelope of the drive."""
        return self.amplitude * self.direction

    def is_controllable(self, frequency: float) -> bool:
        """Return whether the dead time is short enough for control of the envelope at a frequency in Hz."""
        dead_time = (1.5 * self._window_at(frequency) + self.station.latency) / self.rate
        relative_pole = self._pole - 2j * np.pi * frequency
        return self._gain != 0.0 and abs(relative_pole) * dead_time <= MAX_POLE_TIMES_DEAD_TIME

    def amplitudes(self, readings: Array, phases: Sequence[float]) -> ComplexArray:
        """Return the complex amplitudes (tones, quantities) in a window, and store the readings of the motion."""
        self._readings.append(readings[self._quantity.rows[0]].copy())
        return super().amplitudes(readings, phases)

    def observe(self, samples: int) -> Generator[Array, Array, ComplexArray]:
        """Hold the tone for a window; return the amplitudes (tones, quantities), and update motion and mode."""
        amplitudes = yield from super().observe(samples)
        self.motion = amplitudes[0, 0] * self.direction
        self._add(self.motion, self.envelope, samples)
        return amplitudes

    def steer(self, drive: complex) -> Generator[Array, Array, ComplexArray]:
        """Change the envelope of the drive to `drive` in one control window; return the envelopes of all quantities."""
        samples, start, direction = self.window, self.envelope, self.direction
        target = drive / direction
        phase = self.phase + 2.0 * np.pi * np.fmod(self.frequency / self.rate * np.arange(samples + 1), 1.0)
        # The envelope changes along half a cosine.
        amplitude = self.amplitude + (target - self.amplitude) * half_cosine(samples)[1]
        turn = float(np.angle(target))
        self.amplitude, self.direction = abs(target), direction * complex(np.exp(1j * turn))
        self.phase = float(np.fmod(phase[-1] + turn, 2.0 * np.pi))
        readings = yield self.station.drive(np.asarray((amplitude * np.exp(1j * phase[:-1])).imag))
        envelopes = self.amplitudes(readings, [float(phase[0])])[0] * direction
        self._add(envelopes[0], (start + drive) / 2.0, samples)
        return envelopes

    def _add(self, motion: complex, drive: complex, samples: int) -> None:
        """Add the mean envelopes of the last window to the model of the mode."""
        previous, self._observed = self._observed, (self.frequency, motion, drive)
        is_same = previous[0] == self.frequency and all(
            abs(value - before) <= _MIN_CHANGE * abs(value)
            for value, before in zip((motion, drive), previous[1:], strict=True)
        )
        if not motion or not drive or is_same:
            # In steady state, the observations determine only the ratio of the pole l and the input gain b.
            self._observed = previous
            return
        time, omega = self.station.now - samples / 2.0, 2.0 * np.pi * self.frequency
        self._mode.add(time / self.rate, omega, motion, drive, _MEMORY_WINDOWS * samples / self.rate)
        if self._mode.gain:
            self._pole, self._gain = self._mode.pole, self._mode.gain

    def settle_envelope(
        self,
        frequency: float,
        drive: float,
        target: float,
        max_wait_s: float,
        transition_s: float = TRANSITION_S,
    ) -> Generator[Array, Array, bool]:
        """Change to a frequency in Hz and bring the motion to an amplitude in m by feedback.

        Return whether this succeeded.

        `drive`: amplitude of the drive after the transition, which lasts at least a window. At the end the drive is
        constant.
        """
        station = self.station
        end = station.now + station.samples(max_wait_s)
        yield station.drive(self.transition(max(station.samples(transition_s), self.window), frequency, drive))
        yield from self.observe(self.window)
        if not self.motion:
            return False
        self.control = None
        control = self._control_to(target)
        detector, drives = Settling(self._settle.tolerance), deque([self.envelope], maxlen=AVERAGED_WINDOWS)
        while station.now + self.window <= end:
            envelopes = yield from self.steer(control.next_drive(self.motion, self._gain))
            self.motion = complex(envelopes[0])
            if abs(self.motion) > _LOST_RATIO * target:
                self.forget_mode()
                yield from self.steer(self.envelope * target / abs(self.motion))
                return False
            drives.append(self.envelope)
            self.scatter = float(np.std(drives)) / max(float(abs(np.mean(drives))), 1e-300)
            detector.add(np.array([*envelopes, self.envelope]))
            error = abs(detector.predicted_final() / control.target - 1.0)
            largest = min(max(FORCE_TOLERANCE, 2.0 * detector.standard_error()), MAX_TOLERANCE)
            if detector.settled and error < largest and self.scatter < _MAX_SCATTER:
                yield from self.steer(complex(np.mean(drives)))
                return True
        return False

    def _control_to(self, amplitude: float) -> EnvelopeControl:
        """Return the controller of the motion to an amplitude in m, at its present phase."""
        target, window = amplitude * self.motion / abs(self.motion), self.window / self.rate
        return EnvelopeControl(target, self.envelope, window, self.dead_time, self.station.drive_limit)

    def hold_envelope(self, samples: int, target: float, feedback: bool) -> Generator[Array, Array, Held]:
        """Measure for at least a number of samples, with constant drive, or with feedback to an amplitude in m."""
        window, motions, drives = self.window, [], []
        control = self._control_to(target) if feedback else None
        samples = max(samples, min_samples([self.frequency], self.rate))
        self._readings.clear()
        first = self.station.now
        for _ in range(-(-samples // window)):
            if control is None:
                yield from self.observe(window)
            else:
                self.motion = complex((yield from self.steer(control.next_drive(self.motion, self._gain)))[0])
            motions.append(self.motion)
            drives.append(self.envelope)
        motion, drive = complex(np.mean(motions)), complex(np.mean(drives))
        invasive = float(np.sqrt(np.mean(abs(np.array(drives) - drive) ** 2))) / max(abs(drive), 1e-300)
        tolerance = float(np.hypot(FORCE_TOLERANCE, self.relative_noise(abs(motion))))
        growth = _growth(np.array(motions), target, window / self.rate, tolerance)
        # Changes of the drive change the motion by |b dU| = |l X dU / U| a second, until the motion repeats.
        pole = abs(self._gain * drive) / max(abs(motion), 1e-300)
        changes = pole / self.frequency * invasive if feedback else 0.0
        repetition = self.repetition(np.concatenate(self._readings), abs(motion), changes)
        return Held(first, motion, drive, invasive, growth, repetition)

    def hold_until_decayed(self, samples: int, target: float, feedback: bool) -> Generator[Array, Array, Held]:
        """Measure as `hold_envelope`, again while other modes decay."""

        def measure() -> Generator[Array, Array, tuple[Held, bool]]:
            held = yield from self.hold_envelope(samples, target, feedback)
            return held, held.repetition != 1 and not held.growth

        return (yield from self.until_decayed(measure))

    def mark_measured(self, held: Held, settled: bool, **fields: Any) -> None:
        """Mark a measurement that ends at the current sample; `settled`: whether its envelope is steady."""
        self.station.mark(
            "measure", held.first, self.station.now, drive=abs(held.drive),
            force=abs(held.drive) if self.station.force_is_drive else None,
            settled=settled and held.repetition > 0, invasive=held.invasive, repetition=held.repetition, **fields,
        )  # fmt: skip
        if settled:
            self.add_repetition(fields["level"], held.repetition)


def _growth(motions: ComplexArray, target: float, window: float, tolerance: float) -> float:
    """Return the rate at which a motion leaves its target amplitude [1/s]; 0 if the motion stays.

    `window`: s; `tolerance`: relative tolerance of the amplitude.
    """
    deviation = abs(abs(motions) / target - 1.0)
    if deviation[-1] < _LEFT_RATIO * tolerance or deviation.size < 3:
        return 0.0
    latest = np.maximum(deviation, 1e-9)
    middle = latest.size // 2
    return float(max(np.log(latest[-1] / latest[middle]) / ((latest.size - 1 - middle) * window), 1e-9))
