"""Sine sources that estimate the amplitudes of channels in steady state, and control the amplitude of the force.

`SteadyTones` are simultaneous tones, `SteadyTone` is one tone.

A *transition* is a smooth change to another frequency and amplitude. The *level* is the required amplitude of the
force. If the force is not controlled, the level is the amplitude of the drive. Each of several tones has the level.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from functools import lru_cache, reduce
from types import MappingProxyType
from typing import Any

import numpy as np

from daq.core.excitation.controlled import Controlled
from daq.core.excitation.lock_in import min_samples, whole_periods
from daq.core.excitation.station import Excitation, Station
from daq.core.excitation.tones.settling import MIN_OBSERVATIONS, Settling
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.results.text import format_decimals
from rig.core.scene.excitation import FORCE_TOLERANCE, Settle

# Duration of a transition to a new frequency [s]. It is so slow that it does not excite modes more than a few hertz
# away.
TRANSITION_S = 0.4
# A transition to a new amplitude lasts at most this time [s]: a longer transition would only extend the test.
_MAX_TRANSITION_S = 3.0
# An amplitude is estimated from a window of at least this duration [s].
WINDOW_S = 0.1
# Above this multiple of the force level, the drive is reduced before the steady state, to protect the rig.
_MAX_FORCE_RATIO = 3.0
# Largest sudden change of the drive with a negligible transient, as ln(new / old).
_MAX_SUDDEN_CHANGE = 0.03
# The drive is updated once the predicted force is stable: its change over the last observations is below this fraction
# of its deviation from the level.
_MAX_PREDICTION_CHANGE = 0.3
# A measurement longer than twice this number of samples is evaluated in blocks of this size or more, to limit the
# memory.
_BLOCK_SAMPLES = 1 << 16
# Maximum number of steps that a warning lists; a longer list would hide the remedy.
_MAX_LISTED = 8


class Tone:
    """Source of amplitude * sin(phase), with frequency in Hz and the phase in rad at the next sample.

    >>> tone = Tone(1000.0, 10.0)
    >>> change, constant = tone.transition(200, 10.0, 2.0), tone.hold(100)
    >>> float(round(abs(np.diff(np.concatenate([change, constant]))).max(), 3))  # as the final tone: 2 (2 pi 10 / 1000)
    0.126
    """

    def __init__(self, rate: float, frequency: float) -> None:
        self.rate = rate
        self.frequency = frequency
        self.amplitude = 0.0
        self.phase = 0.0
        self.level = 0.0
        self.control: AmplitudeControl | None = None

    def hold(self, samples: int) -> Array:
        """Generate samples of constant frequency and amplitude; shape (samples,)."""
        return self.amplitude * np.sin(self._advance(_elapsed_phases(self.frequency / self.rate, samples)))

    def transition(self, samples: int, frequency: float, amplitude: float) -> Array:
        """Generate a transition along half a cosine to a frequency and an amplitude; shape (samples,)."""
        u, rise, integrated_rise = half_cosine(samples)
        # Phase in periods: the integral of f0 + (f1 - f0) rise.
        periods = (self.frequency * samples * u + (frequency - self.frequency) * integrated_rise) / self.rate
        envelope = self.amplitude + (amplitude - self.amplitude) * rise
        wave = envelope * np.sin(self._advance(_phases(periods)))
        self.frequency, self.amplitude = frequency, amplitude
        return wave

    def _advance(self, elapsed: Array) -> Array:
        """Return the phases of a window [rad] and move `phase` to the next window.

        `elapsed`: phase since the start of the window, at each of its samples and at the first sample of the next
        window.
        """
        phase = self.phase + elapsed
        self.phase = math.fmod(phase[-1], 2 * math.pi)
        return phase[:-1]


def _phases(periods: Array) -> Array:
    """Return the phases [rad] that correspond to numbers of periods; whole periods are removed."""
    return 2 * np.pi * (periods - np.trunc(periods))


# Cached, because most transitions have one of a few lengths.
@lru_cache(maxsize=4)
def half_cosine(samples: int) -> tuple[Array, Array, Array]:
    """Return relative times from 0 to 1, a rise from 0 to 1 along half a cosine, and its integral [samples].

    The relative times and the integral have one more value, at the end.
    """
    u = np.arange(samples + 1) / samples
    return u, (1 - np.cos(np.pi * u[:-1])) / 2, samples * (u / 2 - np.sin(np.pi * u) / (2 * np.pi))


# Cached, because all windows in which a tone settles have the same length.
@lru_cache(maxsize=2)
def _elapsed_phases(frequency: float, samples: int) -> Array:
    """Return the phases since the start of a window and at its end [rad]; `frequency`: in periods per sample."""
    return _phases(frequency * np.arange(samples + 1, dtype=float))


def _window(frequencies: Sequence[float], rate: float, shortest_s: float) -> int:
    """Return the length of a window in samples: whole periods of the lowest tone, and at least two beats of tones."""
    return max(whole_periods(min(frequencies), rate, shortest_s), min_samples(frequencies, rate))


def check_spacing(frequencies: Sequence[float], max_wait_s: float) -> None:
    """Raise `SceneError` if simultaneous tones in Hz are too close to settle within a time in s."""
    for problem in Settle(longest=max_wait_s).check_spacing((), frequencies):
        raise SceneError(f"test: {problem.message}")


def listed(steps: Sequence[str]) -> str:
    """Return the first steps of a test as text."""
    return ", ".join(steps[:_MAX_LISTED]) + (", ..." if len(steps) > _MAX_LISTED else "")


class SteadyTones:
    """Tones that drive a shaker simultaneously, and the response's complex amplitude at the frequency of each tone.

    The amplitudes are the spring force in N, if it is controlled, and the displacements in m at the motion channels.
    """

    def __init__(self, station: Station, tones: Sequence[Tone], controlled: Controlled | None) -> None:
        self.station, self.tones, self._controlled = station, tones, controlled
        self._motion_rows = [
            row for row, info in enumerate(station.channels) if info.quantity not in ("force", "voltage")
        ]
        self._weights_frequencies: list[float] = []
        self._weights: list[ComplexArray] = []  # of each tone, (quantities, channels)

    def start(self, level: float) -> float:
        """Start the control of the spring force, if prescribed, at a level in N; return the first drive of a tone."""
        return self.start_each([level] * len(self.tones))[0]

    def start_each(self, levels: Sequence[float]) -> list[float]:
        """Start the control as `start`, with a level for each tone; return the first drives.

        The limit of the drive is divided equally among the tones.
        """
        for tone, level in zip(self.tones, levels, strict=True):
            tone.level = level
            if self._controlled is not None:
                tone.control = AmplitudeControl(level, self.station.drive_limit / len(self.tones))
        return [level if self._controlled is None else level * self.station.cautious_drive for level in levels]

    def run(
        self,
        groups: Sequence[Sequence[float]],
        levels: Sequence[float],
        settle: Settle,
        measured_s: Sequence[float],
        fields: Mapping[str, Any] = MappingProxyType({}),
    ) -> Excitation:
        """Settle and measure groups of simultaneous tones, one group after another, and end the tones.

        `groups`: frequencies in Hz of each group, in the order of the tones; `levels`: of the tones; `measured_s`:
        duration of the measurement of each group [s]; `fields`: further fields of the markers, or a common `level` of
        tones that belong to one curve. Raises `SceneError` as `check_spacing`.
        """
        for group in groups:
            check_spacing(group, settle.longest)
        station, drives, unsettled = self.station, self.start_each(levels), list[str]()
        for number, (group, seconds) in enumerate(zip(groups, measured_s, strict=True)):
            text = f"{' and '.join(format_decimals(frequency, 2) for frequency in group)} Hz"
            station.report(number / len(groups), f"{text}, settling")
            targets = dict(zip(group, drives, strict=True))
            settled = yield from self.settle_and_mark(targets, settle.tolerance, settle.longest, fields)
            station.report((number + 0.5) / len(groups), f"{text}, measuring")
            yield from self.measure(station.samples(seconds), settled, fields)
            drives = [tone.amplitude for tone in self.tones]
            unsettled += [] if settled else [text]
        yield self.end()
        if unsettled:
            station.warn(
                f"{listed(unsettled)}: no steady state at the level within {settle.longest:g} s. The measurements are "
                "marked as not settled. Choose other frequencies or levels."
            )

    def _drive(self, waves: Sequence[Array]) -> Array:
        """Return the drive whose wave is the sum of the waves of the tones."""
        return self.station.drive(reduce(np.add, waves))

    def _transition(self, samples: int, drives: Mapping[float, float]) -> Array:
        """Return the drive of a transition to other tones.

        `drives`: amplitudes by frequency in Hz, in the order of the tones.
        """
        return self._drive(
            [tone.transition(samples, *target) for tone, target in zip(self.tones, drives.items(), strict=True)]
        )

    def end(self) -> Array:
        """Return the drive of a transition to zero amplitude."""
        return self._transition(self.station.samples(TRANSITION_S), {tone.frequency: 0.0 for tone in self.tones})

    def amplitudes(self, readings: Array, phases: Sequence[float]) -> ComplexArray:
        """Return the complex amplitudes (tones, quantities) in a window; `phases`: of the tones at its start [rad]."""
        frequencies = [tone.frequency for tone in self.tones]
        if frequencies != self._weights_frequencies:
            self._weights_frequencies = frequencies
            self._weights = [self._weights_at(frequency) for frequency in frequencies]
        amplitudes = self.station.amplitudes(readings, frequencies, phases)
        return np.array([weights @ tone for weights, tone in zip(self._weights, amplitudes.T, strict=True)])

    def _weights_at(self, frequency: float) -> ComplexArray:
        """Return the weights of the channels in each quantity at a frequency in Hz, (quantities, channels)."""
        channels = len(self.station.channels)
        force = [] if self._controlled is None else [self._controlled.weights(frequency)]
        motions = np.zeros((len(self._motion_rows), channels), dtype=complex)
        for weights, row in zip(motions, self._motion_rows, strict=True):
            weights[row] = self.station.displacement_factor(row, frequency)
        return np.array([*force, *motions]).reshape(-1, channels)

    def observe(self, samples: int) -> Generator[Array, Array, ComplexArray]:
        """Hold the tones for a window; return the amplitudes (tones, quantities)."""
        phases = [tone.phase for tone in self.tones]
        return self.amplitudes((yield self._drive([tone.hold(samples) for tone in self.tones])), phases)

    def settle(
        self, drives: Mapping[float, float], tolerance: float, max_wait_s: float
    ) -> Generator[Array, Array, bool]:
        """Change frequencies and drives, and wait for the steady state; return whether it was reached at the level.

        `drives`: amplitude of the drive at each frequency in Hz after the transition; `tolerance`: permitted remaining
        relative change of any amplitude.
        """
        station, observed = self.station, [(tone, Settling(tolerance)) for tone in self.tones]
        end = station.now + station.samples(max_wait_s)
        window = _window([*drives], station.rate, WINDOW_S)
        for tone in self.tones:
            if tone.control is not None:
                tone.control.restart()
        yield self._transition(max(station.samples(TRANSITION_S), window), drives)
        while station.now + window <= end:
            for (_, detector), amplitudes in zip(observed, (yield from self.observe(window)), strict=True):
                detector.add(amplitudes)
            new_drives = [_new_drive(tone, detector) for tone, detector in observed]
            if new_drives != [tone.amplitude for tone in self.tones]:
                samples = window
                for (tone, detector), new_drive in zip(observed, new_drives, strict=True):
                    if abs(math.log(new_drive / tone.amplitude)) >= _MAX_SUDDEN_CHANGE:
                        # The transient of a mode beats with the drive. A transition of two beat periods has
                        # little effect on that mode.
                        two_beats = round(window * 4 * np.pi / detector.phase_change())
                        samples = max(samples, min(station.samples(_MAX_TRANSITION_S), two_beats))
                    detector.restart()
                yield self._transition(samples, dict(zip(drives, new_drives, strict=True)))
            elif all(detector.settled for _, detector in observed):
                return all(
                    tone.control is None
                    or tone.control.is_at_level(float(abs(detector.predicted_final())), detector.standard_error())
                    for tone, detector in observed
                )
        return False

    def settle_and_mark(
        self, drives: Mapping[float, float], tolerance: float, max_wait_s: float, fields: Mapping[str, Any]
    ) -> Generator[Array, Array, bool]:
        """Call `settle`, and mark the interval in the recording for each tone; return the result of `settle`.

        `fields`: further fields of the markers.
        """
        first = self.station.now
        settled = yield from self.settle(drives, tolerance, max_wait_s)
        for tone in self.tones:
            marked = {"frequency": tone.frequency, "level": tone.level, **fields}
            self.station.mark("settle", first, self.station.now, drive=tone.amplitude, settled=settled, **marked)
        return settled

    def measure(self, samples: int, settled: bool, fields: Mapping[str, Any]) -> Generator[Array, Array, None]:
        """Hold the tones for at least a number of samples; mark the interval with the force amplitude of each in N.

        `settled` and `fields` are fields of the markers.
        """
        frequencies = [tone.frequency for tone in self.tones]
        first, samples = self.station.now, max(samples, min_samples(frequencies, self.station.rate))
        # The tones are generated in blocks to limit the memory. The amplitudes in the blocks are used only in the
        # marks, if the force is controlled.
        block_samples, remaining = _window(frequencies, self.station.rate, _BLOCK_SAMPLES / self.station.rate), samples
        is_evaluated = self.station.evaluates_marks and any(tone.control is not None for tone in self.tones)
        amplitudes = np.zeros(len(self.tones), dtype=complex)
        while remaining:
            window = block_samples if remaining >= 2 * block_samples else remaining
            remaining -= window
            if is_evaluated:
                amplitudes += window / samples * (yield from self.observe(window))[:, 0]
            else:
                yield self._drive([tone.hold(window) for tone in self.tones])
        for tone, amplitude in zip(self.tones, amplitudes, strict=True):
            marked = {"frequency": tone.frequency, "level": tone.level, **fields}
            force = tone.amplitude if self.station.force_is_drive else None
            if is_evaluated:
                force = float(abs(amplitude))
            self.station.mark(
                "measure", first, self.station.now, drive=tone.amplitude, force=force, settled=settled, **marked
            )


class SteadyTone(Tone, SteadyTones):
    """One tone that drives a shaker, and the complex amplitudes of the response."""

    def __init__(self, station: Station, frequency: float, controlled: Controlled | None) -> None:
        Tone.__init__(self, station.rate, frequency)
        SteadyTones.__init__(self, station, [self], controlled)


def _new_drive(tone: Tone, detector: Settling) -> float:
    """Return the next drive of a tone: the current one if it is correct, or if the force is not yet predictable."""
    control, drive = tone.control, tone.amplitude
    if control is None:
        return drive
    force = float(abs(detector.predicted_final()))
    if detector.count < MIN_OBSERVATIONS + 1:
        latest_force = float(abs(detector.latest))
        is_excessive = detector.is_rising and latest_force > _MAX_FORCE_RATIO * control.level
        return (is_excessive and control.reduce_drive(drive, latest_force)) or drive
    if control.is_at_level(force):
        return drive
    # The predicted force is usable long before the transient has decayed, as soon as the prediction is constant.
    max_change = _MAX_PREDICTION_CHANGE * abs(force / control.level - 1.0)
    is_predictable = detector.settled or detector.prediction_change() < max_change
    if not is_predictable or control.is_at_level(force, detector.standard_error()):
        return drive
    # At the limit of the amplifier the drive remains, and the point is measured as not settled.
    return control.next_drive(drive, force)


#: If the force scatters, its relative tolerance is twice its standard error, up to this value.
MAX_TOLERANCE = 0.02
# Smallest assumed slope d log(force) / d log(drive). When dampers begin to impact, the force can rise slowly or even
# fall with the drive.
_MIN_SLOPE = 0.3
# Largest assumed slope. When dampers begin to impact, the force can also rise steeply.
_MAX_SLOPE = 3.0
# A slope is computed only from drives whose logarithms differ by at least this.
_MIN_LOG_DIFFERENCE = 1e-3
# Smallest width of the bracket in log(drive). In a narrower bracket that does not contain the level, the force jumps or
# has changed; the bracket is then discarded.
_MIN_BRACKET = 2e-3
# The next drive is at least this fraction of the width of the bracket from both ends: each step then reduces the
# bracket.
_BRACKET_MARGIN = 0.1
# log(drive) changes by at most this from one drive to the next.
_MAX_LOG_STEP = math.log(3.0)
# `_MAX_LOG_STEP` is multiplied by this factor if the slope is below `_MIN_SLOPE`.
_FLAT_STEP_FACTOR = 0.5
# If the force is still too large after the drive was reduced to this fraction, the drive is not the cause.
_MIN_REDUCTION_RATIO = 1e-4
# A smaller force is replaced by this fraction of the level, so its logarithm is finite.
_MIN_FORCE_RATIO = 1e-9


class AmplitudeControl:
    """Control of a force amplitude in N: secant method in log(drive) and log(force), with a bracket.

    The bracket is the interval between the nearest drives with forces below and above the level. `level`: required
    force [N]; `limit`: largest drive.

    >>> control, drive = AmplitudeControl(2.6), 0.1
    >>> for step in range(12):
    ...     force = 3 * drive**1.5
    ...     if control.is_at_level(force):
    ...         break
    ...     drive = control.next_drive(drive, force)
    >>> step, abs(force / 2.6 - 1) < 0.005
    (3, True)
    """

    def __init__(self, level: float, limit: float = math.inf) -> None:
        self.level = level
        self.limit = limit
        self.restart()

    def restart(self) -> None:
        """Discard all observations: the frequency has changed."""
        self._previous: tuple[float, float] | None = None  # log(drive), log(level / force)
        # Natural logarithms of the drives below and above the required drive, as far as they are known.
        self._low, self._high = -math.inf, math.inf
        self._largest_reduced_drive = 0.0

    def is_at_level(self, force: float, standard_error: float = 0.0) -> bool:
        """Return whether a force amplitude in N, with a relative standard error, is at the level within tolerance."""
        return abs(force / self.level - 1.0) <= min(max(FORCE_TOLERANCE, 2.0 * standard_error), MAX_TOLERANCE)

    def reduce_drive(self, drive: float, force: float) -> float | None:
        """Return a smaller drive for an excessive force in N; None if a much smaller drive did not reduce the force."""
        self._largest_reduced_drive = max(self._largest_reduced_drive, drive)
        if drive < _MIN_REDUCTION_RATIO * self._largest_reduced_drive:
            return None
        return drive * max(math.exp(-_MAX_LOG_STEP), min(1.0, self.level / force))

    def next_drive(self, drive: float, force: float) -> float:
        """Compute the next drive amplitude, at most `limit`, from the current drive and its steady force in N."""
        log_drive, error = math.log(drive), math.log(self.level / max(force, _MIN_FORCE_RATIO * self.level))
        slope = 1.0
        if self._previous is not None and abs(log_drive - self._previous[0]) > _MIN_LOG_DIFFERENCE:
            slope = (self._previous[1] - error) / (log_drive - self._previous[0])
        self._previous = log_drive, error
        # Update the bracket: the nearest drives with forces below and above the level.
        if error > 0.0:
            self._low, self._high = log_drive, self._high if self._high > log_drive else math.inf
        else:
            self._low, self._high = self._low if self._low < log_drive else -math.inf, log_drive
        if self._high - self._low < _MIN_BRACKET:
            self._low, self._high = -math.inf, math.inf
        max_step, step = _FLAT_STEP_FACTOR * _MAX_LOG_STEP, error
        if slope >= _MIN_SLOPE:
            max_step, step = _MAX_LOG_STEP, error / min(slope, _MAX_SLOPE)
        next_log_drive = log_drive + max(-max_step, min(max_step, step))
        if math.isfinite(self._high - self._low):
            margin = _BRACKET_MARGIN * (self._high - self._low)
            next_log_drive = max(self._low + margin, min(self._high - margin, next_log_drive))
        return min(math.exp(next_log_drive), self.limit)
