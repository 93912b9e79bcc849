"""Sine test with profile control: a sweep whose drive follows the amplitudes of control and limited channels.

After each window, the drive amplitude d changes by ln d += gain * clip(ln ratio), where the ratio is the smallest of
profile / control and limit / response of the limited channels (notching; S. Ricci, B. Peeters, R. Fetter, D. Boland,
J. Debille, Virtual shaker testing, IMAC 2009). `profile_checks.py` contains the stability of this loop.
"""

from collections.abc import Generator, Iterable, Sequence
from math import log
from typing import Any, NamedTuple

import numpy as np

from daq.core.excitation.procedure import Form
from daq.core.excitation.profiles.identification import EXPECTED_PERIODS, identify
from daq.core.excitation.profiles.profile_checks import (
    OBSERVATION_PERIODS,
    WINDOW_PERIODS,
    SweepLoop,
    check_sweep,
    in_band,
    widened,
)
from daq.core.excitation.profiles.spectrum_shaping import lines_between
from daq.core.excitation.profiles.sweep_control import estimate_amplitudes, observation_samples
from daq.core.excitation.station import AbortedTest, Excitation, Station
from daq.core.excitation.swept_sine import SweepProcedure
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.numerics.decibels import in_decibels
from rig.core.numerics.runs import runs_of
from rig.core.results.text import format_decimals
from rig.core.scene.excitation import SineControl
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import structural_model

# The drive changes at the earliest after this number of samples, from which an amplitude and a phase can be estimated.
_MIN_WINDOW_SAMPLES = 4
# Largest decrease of the logarithmic drive in a window, divided by the gain.
_MAX_DECREASE = log(4.0)
# Largest increase, smaller than the largest decrease.
_MAX_INCREASE = log(1.5)
# Shortest period of the identification [s].
_IDENTIFICATION_S = 2.0
# Shortest period of the identification, in periods of the lowest frequency.
_IDENTIFICATION_PERIODS = 8.0
# End of the identification above the band, relative to the sample rate: the converter attenuates higher frequencies.
_HIGHEST_RATIO = 0.45
# The sweep begins when the amplitudes deviate by less than this value [dB] ...
_START_DB = 0.5
# ... in this number of successive windows, ...
_START_WINDOWS = 6
# ... or after this time [s].
_MAX_START_S = 30.0
# Time in which the drive rises at the start and falls at the end [s].
_RISE_S = 0.25
# The control oscillates if the logarithmic error changes sign and by more than this value.
_MIN_OSCILLATION = 0.05
# Factor of the gain at an oscillation.
_GAIN_REDUCTION = 0.7
# Without an oscillation, the total factor of the gain is raised to this power, so it returns to 1.
_RECOVERY_EXPONENT = 0.95
# Smallest total factor of the gain.
_MIN_GAIN_FACTOR = 0.02
# An error is the next extreme of an oscillation if its magnitude exceeds this fraction of the last extreme.
_MIN_SWING = 0.25


class Observation(NamedTuple):
    """Amplitudes in the samples from `first` on, in the sweep."""

    first: int
    stop: int
    frequency: float  # Hz
    deviation: float  # deviation of the control channels from the profile [dB]
    limiting: int  # index of the limit that determines the drive; -1: the profile


def limited_error(ratio: float) -> float:
    """Return the logarithm of required over measured amplitude, limited to the largest steps."""
    return min(max(log(max(ratio, 1e-12)), -_MAX_DECREASE), _MAX_INCREASE)


def _observation_samples(frequency: float, rate: float) -> int:
    """Return the number of samples of an observation at a frequency in Hz."""
    return max(observation_samples(frequency, rate), round(OBSERVATION_PERIODS * rate / frequency))


class Caution:
    """Reduction of the gain while the logarithmic error oscillates: at an antiresonance, sidebands are amplified."""

    def __init__(self) -> None:
        self._factor, self._swing = 1.0, 0.0

    def factor(self, error: float) -> float:
        """Return the factor of the gain for the next error."""
        is_oscillating = error * self._swing < 0.0 and abs(error - self._swing) > _MIN_OSCILLATION
        if is_oscillating:
            self._factor = max(self._factor * _GAIN_REDUCTION, _MIN_GAIN_FACTOR)
        else:
            self._factor **= _RECOVERY_EXPONENT
        # After a change of sign, the error is the new reference, however small: if all errors were compared with a
        # large first error, the gain would remain at its smallest value.
        if is_oscillating or abs(error) > _MIN_SWING * abs(self._swing):
            self._swing = error
        return self._factor


class SineSweep:
    """A sweep with its controller."""

    def __init__(self, station: Station, test: SineControl, rows: Sequence[int], loop: SweepLoop) -> None:
        self.station, self.test, self._rows, self._loop = station, test, list(rows), loop
        self.total, self.completed = station.samples(test.duration), 0
        self.drive, self.phase = 0.0, 0.0
        self.observations: list[Observation] = []
        self._recent, self._phases = np.zeros((len(rows), 0)), np.zeros(0)
        self.limited = False  # whether the output limited the drive
        self._caution = Caution()

    def first_drive(self) -> float:
        """Return the drive at the first frequency; abort if the output cannot drive the sweep."""
        inside = self._loop.inside
        frequency, drive = self._loop.frequency[inside], self._loop.required[:, inside].min(axis=0).tolist()
        worst = int(np.argmax(drive))
        self.station.check_output(drive[worst], f"at {frequency[worst]:.4g} Hz the profile", "Lower the profile there.")
        return drive[int(np.argmin(abs(frequency - self.test.from_)))]

    def window(self, samples: int, frequency: float, drive: float) -> Generator[Array, Array, None]:
        """Output a window, in which the drive changes to a new amplitude, and store its readings."""
        if 0 < self.completed < self.total:
            fractions = np.arange(self.completed, self.completed + samples + 1) / self.total
            periods = self.test.periods_at(np.minimum(fractions, 1.0))
            periods = periods - periods[0]
        else:
            periods = np.asarray(np.arange(samples + 1) * (frequency / self.station.rate), dtype=np.float64)
        phase = self.phase + 2.0 * np.pi * periods
        envelope = self.drive + (drive - self.drive) * np.arange(samples) / samples
        self.phase, self.drive = float(phase[-1]), drive
        readings = yield self.station.drive(envelope * np.sin(phase[:-1]))
        length = self.station.latency + 2 * _observation_samples(frequency, self.station.rate)
        self._recent = np.concatenate([self._recent, readings[self._rows]], axis=1)[:, -length:]
        self._phases = np.concatenate([self._phases, phase[:-1]])[-length:]

    def observe(self, frequency: float) -> Array | None:
        """Return the accelerations' amplitudes in the last periods [m/s²]; None before enough periods."""
        length, latency = _observation_samples(frequency, self.station.rate), self.station.latency
        if self._phases.size < length + latency:
            return None
        # The readings are earlier than the drive by the latency.
        phases = self._phases[self._phases.size - length - latency : self._phases.size - latency]
        amplitudes = estimate_amplitudes(self._recent[:, -length:], phases, self.station.rate)[0]
        return np.array([
            abs(self.station.acceleration_factor(row, frequency) * amplitude)
            for row, amplitude in zip(self._rows, amplitudes, strict=True)
        ])  # fmt: skip

    def step(self, frequency: float, samples: int) -> Generator[Array, Array, Observation | None]:
        """Output a window with the current drive, observe, and update the drive of the next window."""
        amplitudes = self.observe(frequency)
        drive, observation = self.drive, None
        if amplitudes is not None:
            ratios = self.test.required(amplitudes[:, None], np.array([frequency]))[:, 0]
            limiting = int(ratios.argmin())
            ratio = float(ratios[limiting])
            gain, error = self._loop.gain(self.drive * ratio, frequency, limiting), limited_error(ratio)
            drive *= float(np.exp(gain * self._caution.factor(error) * error))
            self.limited |= drive > self.station.output_limit
            drive = min(drive, self.station.output_limit)
            deviation, now = -float(in_decibels(ratios[0])), self.station.now - self.station.latency
            length = _observation_samples(frequency, self.station.rate)
            observation = Observation(max(now - length, 0), now, frequency, deviation, limiting - 1)
            if deviation > self.test.abort and drive > 0.0:
                names = " and ".join(self.test.control.channels)
                raise AbortedTest(
                    f"aborted at {format_decimals(frequency, 1)} Hz: {names} is {deviation:.1f} dB above the profile. "
                    "Sweep more slowly, or add a limit."
                )
        yield from self.window(samples, frequency, drive)
        return observation

    def mark(self, first: int) -> None:
        """Mark the sweep, its deviations from the profile, and the bands in which a limit determines the drive."""
        station, test, seen = self.station, self.test, self.observations
        outside = np.array([abs(each.deviation) > test.tolerance and each.limiting < 0 for each in seen], dtype=bool)
        largest = []
        for start, stop in runs_of(outside):
            worst = max(seen[start:stop], key=lambda each: abs(each.deviation))
            fields: dict[str, Any] = {"worst": round(worst.deviation, 2), "frequency": worst.frequency}
            station.mark("tolerance", seen[start].first, seen[stop - 1].stop, **fields)
            largest.append(worst)
        for index, limit in enumerate(test.limits):
            for start, stop in runs_of(np.array([each.limiting == index for each in seen], dtype=bool)):
                band = {"from": seen[start].frequency, "to": seen[stop - 1].frequency}
                station.mark("notch", seen[start].first, seen[stop - 1].stop, channel=limit.channel, **band)
        level, share = float(test.profile.at(np.array(test.from_))), float(np.mean(outside)) if seen else 0.0
        fields = {"outside": round(share, 4), "from": test.from_, "to": test.to, "spacing": test.spacing}
        station.mark("measure", first, station.now, duration=test.duration, settled=True, level=level, **fields)
        if largest:
            worst = max(largest, key=lambda each: abs(each.deviation))
            station.warn(
                f"the control deviates from the profile by more than {test.tolerance:g} dB in {100 * share:.1f} % "
                f"of the sweep, most at {worst.frequency:.4g} Hz ({worst.deviation:+.1f} dB). Sweep more slowly."
            )


def check_control(test: SineControl, at_start: Observation) -> None:
    """Abort if the control channels are far below the profile at the start, though nothing limits the drive."""
    if at_start.limiting < 0 and at_start.deviation < -test.abort:
        names = " and ".join(test.control.channels)
        raise AbortedTest(
            f"aborted at {format_decimals(at_start.frequency, 1)} Hz: after {_MAX_START_S:g} s of control, {names} is "
            f"more than {test.abort:g} dB below the profile. Check that the sensor is connected, and that the profile "
            "exceeds a count of the converter: use a more sensitive sensor or a smaller range."
        )


def _identification_seconds(test: SineControl) -> float:
    """Return the period of the identification [s]."""
    return max(_IDENTIFICATION_S, _IDENTIFICATION_PERIODS / test.band[0])


def _window_samples(frequency: float, rate: float) -> int:
    """Return the number of samples of a window at a frequency in Hz."""
    return max(_MIN_WINDOW_SAMPLES, round(WINDOW_PERIODS * rate / frequency))


class SineControlProcedure(SweepProcedure["SineControl"]):
    """A sweep with profile control."""

    period_cpu_s = 0.3e-3
    form = Form("sine control of the scene", ())
    waits_for_sensors = True

    def excite(self, station: Station, test: SineControl) -> Excitation:
        """Run the sweep.

        Markers: `measure` for the sweep, `tolerance` for deviations, `notch` for bands in which a limit sets the drive.
        """
        latency_s = station.latency / station.rate
        if warning := check_sweep(test, station.scene, station.channels, latency_s).warning:
            station.warn(warning)
        rows = [station.row_of(name) for _, name in test.named_channels]
        period = station.samples(_identification_seconds(test))
        low, high = widened(test)
        highest = max(test.band[1], min(high, _HIGHEST_RATIO * station.rate))
        lines = lines_between(low, highest, period, station.rate)
        frequency = lines * station.rate / period
        inside = in_band(test, frequency)
        # The sum of the tones in the band is as large as the profile.
        required = np.where(inside, test.profile.at(frequency), 0.0) / np.sqrt(np.sum(inside))
        limits = [np.nanmin(limit.at(frequency[inside]), initial=np.inf) / np.sqrt(2.0) for limit in test.limits]
        largest = np.array([np.inf] * len(test.control.channels) + limits)
        gain, _ = yield from identify(station, rows, lines, period, required, largest, "sine control")
        sweep = SineSweep(station, test, rows, SweepLoop(test, frequency, np.abs(gain), latency_s))
        first, target = station.now, sweep.first_drive()
        samples = _window_samples(test.from_, station.rate)
        rise = -(-station.samples(_RISE_S) // samples)
        for k in range(rise):
            yield from sweep.window(samples, test.from_, target * (k + 1) / rise)
        settled_windows, at_start = 0, None
        while settled_windows < _START_WINDOWS and station.now < first + station.samples(_MAX_START_S):
            station.report(0.0, f"settling at {format_decimals(test.from_, 2)} Hz")
            at_start = yield from sweep.step(test.from_, samples)
            reached = at_start is not None and (at_start.limiting >= 0 or abs(at_start.deviation) < _START_DB)
            settled_windows = settled_windows + 1 if reached else 0
        station.mark("settle", first, station.now, frequency=test.from_, settled=settled_windows >= _START_WINDOWS)
        if at_start is not None and settled_windows < _START_WINDOWS and not sweep.limited:
            check_control(test, at_start)
        first = station.now
        try:
            while sweep.completed < sweep.total:
                now_at = float(test.frequency_at(sweep.completed / sweep.total))
                samples = min(sweep.total - sweep.completed, _window_samples(now_at, station.rate))
                observation = yield from sweep.step(now_at, samples)
                sweep.completed += samples
                if observation is not None:
                    sweep.observations.append(observation)
                station.report(sweep.completed / sweep.total, f"{format_decimals(now_at, 2)} Hz")
        finally:
            # The measurement is marked even if the test ends early.
            if station.now > first:
                sweep.mark(first)
        yield from sweep.window(station.samples(_RISE_S), test.to, 0.0)
        if sweep.limited:
            station.warn("the output limited the drive, so that the profile was not reached. Lower the profile.")

    def check(self, test: SineControl, scene: Scene, channels: Sequence[ChannelInfo]) -> Iterable[str]:
        """Describe the expected deviation from the profile, and the frequency bands in which a limit sets the drive."""
        return check_sweep(test, scene, channels).lines()

    def waits(self, test: SineControl, scene: Scene) -> float:
        """Return the expected time of the identification and of the start [s]."""
        return EXPECTED_PERIODS * _identification_seconds(test) + 2.0 * _RISE_S + _START_WINDOWS / test.from_

    def part(self, test: SineControl, seconds: float, scene: Scene) -> SineControl:
        """Return a shorter sweep over the first resonance, at the same sweep rate."""
        low, high = test.band
        inside = [f for f in structural_model(scene).modes.frequency.tolist() if low < f < high]
        fractions = np.linspace(0.0, 1.0, 1001)
        center = float(fractions[int(np.argmin(abs(test.frequency_at(fractions) - inside[0])))]) if inside else 0.5
        half = min(0.5, 0.5 * seconds / test.duration)
        start = min(max(center - half, 0.0), 1.0 - 2.0 * half)
        ends = {"from_": float(test.frequency_at(start)), "to": float(test.frequency_at(start + 2.0 * half))}
        return test.replace(**ends, duration=2.0 * half * test.duration)


PROCEDURE = SineControlProcedure()
