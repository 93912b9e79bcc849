"""Control of the drive of a swept tone for a constant force amplitude despite the transient response."""

from cmath import exp, pi
from collections import deque
from dataclasses import dataclass
from math import ceil

import numpy as np

from daq.core.excitation.profiles.pretest import ShakerLaw
from daq.core.excitation.tones.nearest_mode import NearestMode, mean_exponential
from rig.core.base.arrays import Array, ComplexArray

# An observation (see `Observation`) has at least this number of periods; shorter observations amplify the noise.
_MIN_PERIODS = 2.0
# An observation has at least this number of samples: the number of fitted terms.
_MIN_SAMPLES = 6
# An observation has at least this number of periods of the beat between the tone and the Nyquist frequency.
_MIN_BEATS = 1.5
# The memory of the mode estimate is the time after which the weight of an observation has decreased to 1 / e. It is
# this factor times 1 / sqrt(sweep rate in Hz/s), the time in which a sweep passes a lightly damped mode.
_MEMORY_FACTOR = 0.5
# The memory is at least this number of periods; a shorter memory amplifies the noise.
_MIN_MEMORY_PERIODS = 6.0
# Longest memory in periods: more does not improve a slow sweep, and the motion with dampers may change.
_MAX_MEMORY_PERIODS = 20.0
# Integration steps from the middle of an observation to its end, which compensate its delay.
_STEPS = 6
# Largest change of the drive between windows, relative to the largest stored amplitude: no overload by an error.
_MAX_CHANGE_RATIO = 0.5
# Number of the last drive amplitudes that are stored.
_STORED_DRIVES = 12
# The drive is not increased above this multiple of the force level: a wrong estimate must not overload the rig.
_MAX_FORCE_RATIO = 1.5
# Hann window over an observation, at instants from -1/2 to 1/2 of its length.
_INSTANTS = (np.arange(64) + 0.5) / 64 - 0.5
_HANN = (1 + np.cos(2 * pi * _INSTANTS)) / 64


@dataclass(frozen=True)
class Observation:
    """Estimates of amplitudes from the readings of the last periods."""

    end: float  # time of the end [s]
    frequency: float  # frequency of the tone in the middle [Hz]
    sweep_rate: float  # Hz/s
    length: float  # duration [s]
    motion: complex  # amplitude of the driven body's displacement [m]
    force: complex  # amplitude of the spring force [N]

    @property
    def middle(self) -> float:
        """Time of the middle of the observation [s]."""
        return self.end - self.length / 2

    def angular_frequency(self, time: float) -> float:
        """Return the angular frequency of the tone at a time [rad/s]."""
        return 2 * pi * (self.frequency + self.sweep_rate * (time - self.middle))


class SweepControl:
    """Computes the complex amplitude of the drive Re(amplitude e^{i phase}) at the end of the next update interval.

    Feedback alone is too slow, because the amplitude of the force is measured over some periods: a mode with damping
    ratio ζ and angular frequency ω settles in 1 / (ζ ω), and a sweep passes it in a shorter time. The drive is thus
    feedforward. For force F and motion X the shaker requires D = a F + b X (`ShakerLaw`), in a transient D = a F
    + a' dF/dt + b X + b' dX/dt, where a' and b' are the derivatives with respect to s = i ω. The mode nearest the tone
    (`NearestMode`) predicts X. The delay of the observations is compensated by a simulation with the drive that was
    output since then.
    """

    def __init__(self, law: ShakerLaw, level: float, limit: float, drive: complex) -> None:
        self._law, self._level, self._limit = law, level, limit
        self._mode = NearestMode()
        self._target_force: complex | None = None
        self._drives: deque[tuple[float, complex]] = deque([(0.0, drive)], maxlen=_STORED_DRIVES)

    def add_drive(self, time: float, drive: complex) -> None:
        """Add the amplitude of the drive at a time in s; the amplitude changes linearly between the added times."""
        self._drives.append((time, drive))

    def next_drive(self, observation: Observation, window: float) -> complex:
        """Return the drive amplitude at the end of the update interval of `window` s after the observation."""
        if not observation.force:
            # Readings that vary by less than one converter count do not determine the drive.
            return self._drives[-1][1]
        if self._target_force is None:
            # The phase of the force is arbitrary; the current phase requires the smallest change of the drive.
            self._target_force = self._level * observation.force / abs(observation.force)
        memory_periods = _MEMORY_FACTOR * observation.frequency / max(abs(observation.sweep_rate), 1e-9) ** 0.5
        memory = min(max(memory_periods, _MIN_MEMORY_PERIODS), _MAX_MEMORY_PERIODS) / observation.frequency
        self._mode.add(
            observation.middle,
            observation.angular_frequency(observation.middle),
            observation.motion,
            observation.force,
            memory,
        )
        envelope, force = self._present_envelopes(observation)
        return self._limit_drive(self._target_drive(observation, window, envelope, force), abs(observation.force))

    def _present_envelopes(self, observation: Observation) -> tuple[complex, complex]:
        """Return the envelopes of the mode [m] and of the force [N] at the end of the observation."""
        # The envelopes are simulated from the middle of the observation on, with the drive that was output since then.
        mode, law, force = self._mode, self._law, observation.force
        center = 1j * observation.angular_frequency(observation.middle)
        (per_force, per_motion), (force_slope, motion_slope) = law.at(center), law.slope(center)
        # The envelope in the middle of the observation, from its windowed mean.
        relative_pole = mode.pole - center
        window_mean = complex(_HANN @ np.exp(relative_pole * observation.length * _INSTANTS))
        envelope = (observation.motion - mode.residual_term * force) / window_mean + mode.gain * force * (
            1 / window_mean - 1
        ) / relative_pole
        times, drives = (np.array(row) for row in zip(*self._drives, strict=True))
        step = observation.length / 2 / _STEPS
        for time in observation.middle + step * np.arange(1, _STEPS + 1):
            drive = complex(np.interp(time, times, drives))
            frequency_offset = 1j * observation.angular_frequency(time - step / 2) - center
            relative_pole = mode.pole - center - frequency_offset
            decay_factor = exp(relative_pole * step)
            forced_gain = mode.gain * step * mean_exponential(relative_pole * step)
            free_envelope = decay_factor * envelope + forced_gain * force
            # X = c F + x is integrated by backward Euler, because the force may change fast within a step.
            motion_coefficient = per_motion + frequency_offset * motion_slope
            force_coefficient = (
                per_force
                + frequency_offset * force_slope
                + motion_coefficient * mode.residual_term
                + motion_slope * mode.gain
            )
            force_rate_coefficient = (force_slope + motion_slope * mode.residual_term) / step
            next_force = (
                drive
                - (motion_coefficient + motion_slope * relative_pole) * free_envelope
                + force_rate_coefficient * force
            ) / (force_coefficient + force_rate_coefficient)
            envelope = decay_factor * envelope + forced_gain * (force + next_force) / 2
            force = next_force
        return envelope, force

    def _target_drive(self, observation: Observation, window: float, envelope: complex, force: complex) -> complex:
        """Return the drive amplitude that gives the requested force at the end of the window."""
        assert self._target_force is not None
        mode, target_force = self._mode, self._target_force
        relative_pole = mode.pole - 1j * observation.angular_frequency(observation.end + window / 2)
        forced_gain = mode.gain * window * mean_exponential(relative_pole * window)
        envelope = exp(relative_pole * window) * envelope + forced_gain * (force + target_force) / 2
        end = 1j * observation.angular_frequency(observation.end + window)
        (per_force, per_motion), (_, motion_slope) = self._law.at(end), self._law.slope(end)
        change = (mode.pole - end) * envelope + mode.gain * target_force
        return (
            (per_force + per_motion * mode.residual_term) * target_force + per_motion * envelope + motion_slope * change
        )

    def _limit_drive(self, target: complex, force: float) -> complex:
        """Limit the steps of the drive, its growth at an excessive force in N, and its amplitude."""
        drive = self._drives[-1][1]
        max_change = _MAX_CHANGE_RATIO * max(abs(amplitude) for _, amplitude in self._drives)
        change = target - drive
        if abs(change) > max_change:
            target = drive + change * max_change / abs(change)
        max_drive = min(self._limit, abs(drive)) if force > _MAX_FORCE_RATIO * self._level else self._limit
        return target * min(1.0, max_drive / abs(target)) if target else target


def observation_samples(frequency: float, rate: float) -> int:
    """Return the number of samples of an observation, for a tone in Hz below half the sample rate in Hz.

    >>> [observation_samples(frequency, 100.0) for frequency in (2.0, 35.0, 43.0, 49.0)]
    [100, 6, 11, 75]
    """
    beat = 1.0 / (1.0 - 2.0 * frequency / rate)
    return max(round(_MIN_PERIODS * rate / frequency), _MIN_SAMPLES, ceil(_MIN_BEATS * beat - 1e-9))


def estimate_amplitudes(samples: Array, phase: Array, rate: float) -> tuple[ComplexArray, ComplexArray]:
    """Estimate complex amplitudes X in the middle and their change per second: x = Re(X e^{i phase}) + linear drift.

    A Hann window weighs the samples, shape (channels, at least `observation_samples`). `phase`: phase of each sample,
    rad. Both results have the shape (channels,).
    """
    position = (np.arange(phase.size) + 0.5) / phase.size
    time = (position - 0.5) * phase.size / rate
    cosine, sine = np.cos(phase), -np.sin(phase)
    model = np.column_stack([cosine, sine, time * cosine, time * sine, np.ones(phase.size), position - 0.5])
    weighted = model * (1 - np.cos(2 * np.pi * position))[:, None]
    # The subtraction makes constant readings exactly zero.
    changes = samples - samples[:, :1]
    fit = np.linalg.solve(weighted.T @ model, weighted.T @ changes.T)
    return fit[0] + 1j * fit[1], fit[2] + 1j * fit[3]
