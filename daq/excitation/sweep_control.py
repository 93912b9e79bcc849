"""Control of a swept tone: drive that keeps the force amplitude while the structure is never steady."""

from __future__ import annotations

from cmath import exp, pi
from collections import deque
from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from daq.excitation.nearest_mode import NearestMode, integral
from daq.excitation.pretest import ShakerLaw

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Periods of one observation of the channels; its samples, which must determine six terms; and beats, as which a tone
# near half the rate appears: fewer multiply the noise.
_PERIODS, _FEWEST, _BEATS = 2.0, 6, 1.5
# What is known of the nearest mode fades within the time in which a sweep passes a sharp one, 1 / sqrt(rate of
# the frequency), times this; not within fewer periods than these, and within more of them at the latest: a slow
# sweep has seen enough by then, and the motion with dampers may be another.
_MEMORY, _SHORTEST_MEMORY, _LONGEST_MEMORY = 0.5, 6.0, 20.0
# Steps in which the delay of a look, half of it, is made up for.
_STEPS = 6
# Largest change of the drive from window to window, over the largest of the last ones.
_LONGEST = 0.5
_REMEMBERED = 12
# Force over level above which the drive is not raised.
_TOO_MUCH = 1.5


@dataclass(frozen=True)
class Look:
    """Estimates from the channels in the last periods."""

    end: float  # When they ended, s
    frequency: float
    rate: float
    """Of the tone in their middle, Hz; and how fast it changes, Hz/s."""
    length: float  # Duration, s
    motion: complex
    force: complex
    """Amplitudes of the body's displacement in m and the spring force in N."""

    @property
    def middle(self) -> float:
        """Time that it speaks of, s."""
        return self.end - self.length / 2

    def turn(self, time: float) -> float:
        """Angular frequency of the tone at a time, rad/s."""
        return 2 * pi * (self.frequency + self.rate * (time - self.middle))


class SweepControl:
    """Chooses the complex amplitude of the drive at the end of the next window.

    A force that is read as an amplitude over some periods cannot be held by feedback alone: a mode with damping
    ratio zeta settles in 1 / (zeta w), and a sweep passes it in less. So the drive is computed from what it has to
    be spent on. The shaker takes D = a F + b X for the wanted force F and the body's motion X (`ShakerLaw`,
    measured in the pretest), in a transient D = a F + a' dF/dt + b X + b' dX/dt with the derivatives of a and b
    by s; and X at the end of the next window is foretold by the mode next to the tone (`NearestMode`). What the
    looks lag behind is made up for by going through the drive that has been played since.

    Parameters
    ----------
    law : ShakerLaw
        Of the shaker.
    drive : complex
        Amplitude of the drive when the sweep begins, at time 0: the drive is Re(amplitude e^{i phase}).
    """

    def __init__(self, law: ShakerLaw, level: float, limit: float, drive: complex) -> None:
        self._law, self._level, self._limit = law, level, limit
        self._mode = NearestMode()
        self._goal: complex | None = None
        self._played: deque[tuple[float, complex]] = deque([(0.0, drive)], maxlen=_REMEMBERED)

    def played(self, time: float, drive: complex) -> None:
        """Note the amplitude that the drive reached at a time in s, in a straight line from the one before."""
        self._played.append((time, drive))

    def next(self, look: Look, window: float) -> complex:
        """Choose the drive amplitude at the end of a window of so many seconds, which begins as the look ends."""
        if not look.force:
            # Readings that stay within one count say nothing of what the drive should be.
            return self._played[-1][1]
        if self._goal is None:
            # The phase of the force does not matter; kept, it asks for the least change.
            self._goal = self._level * look.force / abs(look.force)
        passing = _MEMORY * look.frequency / max(abs(look.rate), 1e-9) ** 0.5
        memory = min(max(passing, _SHORTEST_MEMORY), _LONGEST_MEMORY) / look.frequency
        self._mode.add(look.middle, look.turn(look.middle), look.motion, look.force, memory)
        envelope, force = self._caught_up(look)
        return self._careful(self._wanted(look, window, envelope, force), abs(look.force))

    def _caught_up(self, look: Look) -> tuple[complex, complex]:
        """Envelopes of mode and force at the end of the look, by the drive played since its middle."""
        mode, law, force = self._mode, self._law, look.force
        centre = 1j * look.turn(look.middle)
        (per_force, per_motion), (force_slope, motion_slope) = law.at(centre), law.slope(centre)
        envelope = self._unsmeared(look.motion - mode.rest * force, force, mode.pole - centre, look.length)
        times, drives = (np.array(row) for row in zip(*self._played, strict=True))
        step = look.length / 2 / _STEPS
        for time in look.middle + step * np.arange(1, _STEPS + 1):
            drive = complex(np.interp(time, times, drives))
            moved = 1j * look.turn(time - step / 2) - centre
            decay = mode.pole - centre - moved
            kept, fed = exp(decay * step), mode.gain * step * integral(decay * step)
            free = kept * envelope + fed * force
            # X = c F + x; the rate of the force's change is taken at the end of the step, as it may be fast.
            motion = per_motion + moved * motion_slope
            stiff = per_force + moved * force_slope + motion * mode.rest + motion_slope * mode.gain
            inert = (force_slope + motion_slope * mode.rest) / step
            after = (drive - (motion + motion_slope * decay) * free + inert * force) / (stiff + inert)
            envelope = kept * envelope + fed * (force + after) / 2
            force = after
        return envelope, force

    def _wanted(self, look: Look, window: float, envelope: complex, force: complex) -> complex:
        """Drive that takes a steady force at the level when the window has passed."""
        assert self._goal is not None
        mode, goal = self._mode, self._goal
        decay = mode.pole - 1j * look.turn(look.end + window / 2)
        fed = mode.gain * window * integral(decay * window)
        envelope = exp(decay * window) * envelope + fed * (force + goal) / 2
        there = 1j * look.turn(look.end + window)
        (per_force, per_motion), (_, motion_slope) = self._law.at(there), self._law.slope(there)
        change = (mode.pole - there) * envelope + mode.gain * goal
        return (per_force + per_motion * mode.rest) * goal + per_motion * envelope + motion_slope * change

    def _unsmeared(self, envelope: complex, force: complex, decay: complex, length: float) -> complex:
        """Mode's envelope in the middle of a look, from its mean under the look's window."""
        spread = _mean_of_exponential(decay * length)
        return envelope / spread + self._mode.gain * force * (1 / spread - 1) / decay

    def _careful(self, wanted: complex, force: float) -> complex:
        """Keep the drive from leaping, from growing where there is too much force, and within its limit."""
        drive = self._played[-1][1]
        longest = _LONGEST * max(abs(played) for _, played in self._played)
        change = wanted - drive
        if abs(change) > longest:
            wanted = drive + change * longest / abs(change)
        most = min(self._limit, abs(drive)) if force > _TOO_MUCH * self._level else self._limit
        return wanted * min(1.0, most / abs(wanted)) if wanted else wanted


_ABOUT = (np.arange(64) + 0.5) / 64 - 0.5
_HANN = (1 + np.cos(2 * pi * _ABOUT)) / 64


def _mean_of_exponential(exponent: complex) -> complex:
    """Mean of e^(exponent u), u from -1/2 to 1/2, under Hann's window."""
    return complex(_HANN @ np.exp(exponent * _ABOUT))


def look_samples(frequency: float, rate: float) -> int:
    """Choose how many samples a look takes in, of a tone in Hz at a rate in Hz above twice that.

    >>> [look_samples(frequency, 100.0) for frequency in (2.0, 35.0, 43.0, 49.0)]
    [100, 6, 11, 75]
    """
    beat = 1.0 / (1.0 - 2.0 * frequency / rate)
    return max(round(_PERIODS * rate / frequency), _FEWEST, ceil(_BEATS * beat - 1e-9))


def look_at(samples: Array, phase: Array, rate: float) -> tuple[ComplexArray, ComplexArray]:
    """Complex amplitudes X, in the middle, in x = Re(X e^{i phase}) + straight drift, under Hann's window.

    Parameters
    ----------
    samples : ndarray, shape (channels, samples)
        `look_samples` or more.
    phase : ndarray, shape (samples,)
        Of the tone, rad.

    Returns
    -------
    amplitude, slope : ndarray of complex, shape (channels,)
        X, and what it changes by per second.
    """
    part = (np.arange(phase.size) + 0.5) / phase.size
    time = (part - 0.5) * phase.size / rate
    cosine, sine = np.cos(phase), -np.sin(phase)
    model = np.column_stack([cosine, sine, time * cosine, time * sine, np.ones(phase.size), part - 0.5])
    weighted = model * (1 - np.cos(2 * np.pi * part))[:, None]
    # Readings that never change are then exactly nothing.
    changed = samples - samples[:, :1]
    found = np.linalg.solve(weighted.T @ model, weighted.T @ changed.T)
    return found[0] + 1j * found[1], found[2] + 1j * found[3]
