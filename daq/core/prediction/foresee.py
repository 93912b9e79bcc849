"""Prediction of a test: the parts with its extremes are rehearsed, and the extremes compared with the limits.

A rehearsal simulates the test on the virtual bench without a recording.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from daq.core.excitation import procedure_of, test_of
from daq.core.excitation.controlled import controlled
from daq.core.excitation.sensor_settling import settling_time
from daq.core.excitation.station import Station
from daq.core.measurement.estimate import estimate
from daq.core.measurement.impact_remedy import instantaneous_impact_remedy
from daq.core.prediction.chain_limits import reading_limit, without_limits
from daq.core.prediction.flights import flight_lines, flying_tones, onset_level, outside_band
from daq.core.prediction.force_difference import unresolved_force
from daq.core.prediction.foresight import Expectation, Foresight, format_quantity
from daq.core.prediction.linear import LowestSignalToNoise, lowest_signal_to_noise, required_drive
from daq.core.prediction.linear_waits import linear_waits
from daq.core.prediction.rehearsal import POWER_ON_RATIO, Rehearsal, loads_of, recording_size
from daq.core.prediction.rehearsal_plan import (
    RehearsalPlan,
    affordable_seconds,
    expected_seconds,
    highest_level,
    plan_about_peaks,
    plan_rehearsal,
    with_level,
)
from daq.core.signal_chain.channel import ChannelInfo
from daq.core.virtual_bench.bench import Bench
from rig.core.scene.loading import load
from rig.core.scene.measurement_chain import Channel
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import DRIVE_PER_VOLT
from rig.core.system.assembly import assemble
from rig.core.system.impact_acceleration import impact_acceleration

# A rehearsal may take at most this multiple of the duration that the CPU time permits, or of the expected duration.
_MAX_TIME_RATIO = 1.5
# A drive above this fraction of its limit counts as limited.
_LIMITED_DRIVE_RATIO = 0.999
# If the amplifier clips the drive, the level is reduced by this factor, at most this number of times.
_LEVEL_REDUCTION, _MAX_LEVEL_REDUCTIONS = 0.1, 3
# Limit of error of the predicted settling time of the tones that are not rehearsed: this fraction of the predicted
# time, plus `_WAIT_SIGMAS` standard deviations. Complete rehearsals of 12 scenes differed by 5.5 %, at most by 15 %.
_LINEAR_WAIT_ERROR = 0.15
_WAIT_SIGMAS = 2.5
# Smallest completed fraction of a test with feedback for an extrapolation of its duration, to ten times.
_MIN_FRACTION = 0.1
# The time of an abort may differ by this ratio from the time that rehearsed parts of the test predict.
_ABORT_RATIO = 1.5


@dataclass(frozen=True)
class _Duration:
    """Expected, shortest and longest probable duration [s]."""

    expected: float
    shortest: float
    longest: float

    @classmethod
    def within(cls, seconds: float, ratio: float = 1.0) -> _Duration:
        """Return a duration that may differ by a ratio; by default it is exact."""
        return cls(seconds, seconds / ratio, seconds * ratio)

    def __add__(self, other: _Duration) -> _Duration:
        return _Duration(self.expected + other.expected, self.shortest + other.shortest, self.longest + other.longest)


def foresee(scene: Scene | str | Path, cpu_seconds: float = 0.0) -> Foresight:
    """Predict the maxima of a test and their limits, its duration, and the size of its recording.

    A short test is rehearsed completely, with noise, so its duration is exact. Of a long test, the parts with the
    largest linear response are rehearsed. A bed of grains is treated as one mass.

    Parameters
    ----------
    scene : Scene or str or Path
        Scene, name of a bundled scene, or path of a scene file.
    cpu_seconds : float, optional
        A test that needs at most about this CPU time, s, is rehearsed completely; a test of less than 0.7 s always is.

    Returns
    -------
    Foresight
        Largest values with their limits, duration of the test, and size of its recording.

    Raises
    ------
    SceneError
        If the scene has no test, or the test cannot be run on its bench.

    Examples
    --------
    >>> import daq
    >>> foresight = daq.foresee("fig10b-no-damper")
    >>> foresight.fits, foresight["body1"].unit
    (True, 'm/s^2')
    """
    loaded = scene if isinstance(scene, Scene) else load(scene)
    impact_remedy = instantaneous_impact_remedy(loaded)
    if any(damper.grains is not None for damper in loaded.dampers):
        loaded = loaded.replace(dampers=tuple(damper.replace(grains=None) for damper in loaded.dampers))
    test_of(loaded)
    bench = Bench(loaded)
    # The stepped sine that represents a sweep in the rehearsal may need fewer channels than the sweep.
    controlled(Station(loaded, bench.channels, bench.inputs, bench.rate, mark=lambda *arguments, **fields: None))
    rehearsed_test = rehearse_test(loaded, bench.channels, bench, cpu_seconds)
    unlimited_test = rehearsed_test
    if any(part.aborted or any(part.overloaded) for part in rehearsed_test.parts):
        unlimited_test = rehearse_test(without_limits(loaded), bench.channels, None, cpu_seconds)
    return _Assessment(loaded, bench, rehearsed_test, unlimited_test).foresight(impact_remedy)


@dataclass(frozen=True)
class RehearsedTest:
    """Rehearsals of the parts of a test."""

    parts: tuple[Rehearsal, ...]
    is_complete: bool  # the parts are the complete test
    rehearsed: str = ""  # description of the rehearsed part; "" for the complete test
    extension: float = 1.0  # ratio of the extremes of the whole test to those of the rehearsed part

    @property
    def aborted(self) -> str | None:
        """Reason why the test would abort; None if it would run to its end."""
        return next((part.aborted for part in self.parts if part.aborted is not None), None)

    def largest(self, quantity: str, row: int) -> tuple[float, float | None, float | None]:
        """Return the largest magnitude of a quantity in a row, with its frequency [Hz] or else its time [s].

        `quantity`: attribute of `Rehearsal`, such as ``readings``; `row`: row of the channel, input or point.
        """
        part = max(self.parts, key=lambda rehearsal: getattr(rehearsal, quantity).magnitude[row])
        magnitude, sample = (float(getattr(part, quantity).magnitude[row]), int(getattr(part, quantity).sample[row]))
        frequency = part.frequency_at(sample)
        return magnitude * self.extension, frequency, sample / part.rate if frequency is None else None

    def reading_time(self, row: int) -> float:
        """Return the time of a channel's largest reading, s from the start; infinite if it is not in the first part."""
        part = max(self.parts, key=lambda rehearsal: float(rehearsal.readings.magnitude[row]))
        return float(part.readings.sample[row] / part.rate) if part is self.parts[0] else np.inf


def rehearse_test(
    scene: Scene, channels: tuple[ChannelInfo, ...], bench: Bench | None = None, cpu_seconds: float = 0.0
) -> RehearsedTest:
    """Rehearse a test, or the parts of it for which the CPU time suffices.

    `channels`: channels of its bench; `bench`: an existing bench of the scene, at rest; `cpu_seconds`: as `foresee`.
    """
    plan, seconds = plan_rehearsal(scene, channels, cpu_seconds), affordable_seconds(scene, cpu_seconds)
    expected = expected_seconds(plan.parts[0][0], channels)
    parts = _rehearse_parts(plan, bench, _MAX_TIME_RATIO * max(seconds, expected))
    if plan.is_complete and (parts[0].complete or parts[0].aborted is not None):
        return RehearsedTest(parts, True)
    procedure = procedure_of(test_of(scene))
    if procedure.rehearsal == "peaks":
        if plan.is_complete:
            # The rehearsal took longer than expected. Therefore only the peaks of the test are rehearsed.
            seconds = affordable_seconds(scene)
            plan = plan_about_peaks(scene, channels, seconds)
            parts += _rehearse_parts(plan, None, _MAX_TIME_RATIO * seconds)
        dwells = sum(len(part.steps) // 2 for part in parts)
        return RehearsedTest(parts, False, f"{dwells} dwells about the peaks of the linear response")
    if parts[0].aborted is not None:
        # The test aborts in this part, so later parts are not reached.
        return RehearsedTest(parts, True)
    extension = 1.0 if plan.is_complete else procedure.extension(test_of(scene), parts[0].seconds)
    return RehearsedTest(parts, False, f"{sum(part.seconds for part in parts):.3g} s of the test", extension)


def _rehearse_parts(plan: RehearsalPlan, bench: Bench | None, max_seconds: float) -> tuple[Rehearsal, ...]:
    """Rehearse the parts one after another, up to an abort; each part lasts at most `max_seconds` of bench time."""
    parts: list[Rehearsal] = []
    for scene, excluded_dwells in plan.parts:
        part = Rehearsal(scene, excluded_dwells, bench if plan.is_complete else None)
        parts.append(part.run(max_seconds))
        if parts[-1].aborted is not None:
            break
    return tuple(parts)


class _Assessment:
    """Comparison of a rehearsed test with the limits of its scene; `unlimited` is the test without these limits."""

    def __init__(self, scene: Scene, bench: Bench, rehearsed: RehearsedTest, unlimited: RehearsedTest) -> None:
        self.scene, self.bench, self.rehearsed_test, self.unlimited_test = scene, bench, rehearsed, unlimited
        self.system = assemble(scene)
        self.key, self.level, self.level_unit = highest_level(scene)

    def foresight(self, impact_remedy: str) -> Foresight:
        """Return the prediction; `impact_remedy`: setting to change if impacts of zero duration overload a sensor."""
        expectations = (*self._channels(), *self._sensors(), *self._outputs(), *self._loads())
        is_nonlinear = any(any(part.event_times) for part in self.unlimited_test.parts)
        by_ratio_to_limit = sorted(expectations, key=lambda row: row.driven_share)
        limiting = by_ratio_to_limit[-1] if by_ratio_to_limit else None
        largest_level = np.nan
        if limiting is not None and limiting.driven_share > 0.0 and self.key:
            largest_level, is_nonlinear = self._largest_level(limiting, is_nonlinear)
            # At the level of the nearest limit, another may be exceeded; the second nearest is therefore checked too.
            second_ratio = by_ratio_to_limit[-2].driven_share if len(by_ratio_to_limit) > 1 else 0.0
            if second_ratio > 0.0:
                second_level = max(self.level / second_ratio, self.level / limiting.driven_share)
                largest_level = min(largest_level, second_level)
        duration = self._duration()
        signals, sensors = lowest_signal_to_noise(self.scene, self.bench.channels), self._limited_sensors()
        test = test_of(self.scene)
        last_blocks = chain.from_iterable(part.last_blocks for part in self.rehearsed_test.parts)
        return Foresight(
            scene=self.scene.name,
            expectations=expectations,
            key=self.key,
            level=self.level,
            largest_level=largest_level,
            level_unit=self.level_unit,
            limited_by=limiting if np.isfinite(largest_level) else None,
            nonlinear=is_nonlinear,
            aborts=self.rehearsed_test.aborted,
            signals=signals,
            hidden=(
                *self._below_resolution(expectations),
                *self._below_noise(signals),
                *([impact_remedy] if impact_remedy and any(peak > limit for _, limit, peak in sensors) else []),
                *unresolved_force(self.scene, self.system, self.bench.channels),
            ),
            flights=flight_lines(self.scene, self.system, self.level, self.unlimited_test.parts),
            seconds=duration.expected,
            seconds_range=(duration.shortest, duration.longest),
            settled_sensors=self.rehearsed_test.parts[0].settled_sensors_s,
            disk=recording_size(self.scene, self.bench, last_blocks, duration.expected),
            rehearsed=self.rehearsed_test.rehearsed,
            outside=outside_band(self.scene),
            checks=tuple(procedure_of(test).check(test, self.scene, self.bench.channels)),
        )

    def _channels(self) -> Iterable[Expectation]:
        """Yield the largest reading of each channel, and its limit."""
        settings = {channel.name: channel for channel in self.scene.channels or ()}
        for row, info in enumerate(self.bench.channels):
            largest, frequency, time = self.unlimited_test.largest("readings", row)
            driven = None
            limit, limiting_part = reading_limit(settings.get(info.name), info)
            if POWER_ON_RATIO * settling_time(info) > self.unlimited_test.reading_time(row):
                # While the bias of a sensor settles, the reading is not a response to the tone.
                frequency, time = None, self.unlimited_test.reading_time(row)
                first, *later = self.unlimited_test.parts
                later_peaks = (float(part.readings.magnitude[row]) for part in later)
                driven = max(later_peaks, default=float(first.driven_readings.magnitude[row])) or largest
            steady = max(float(part.measured_readings[row]) for part in self.unlimited_test.parts)
            recorded = min(self.rehearsed_test.largest("readings", row)[0], np.inf if info.range is None else limit)
            yield Expectation(
                info.name, info.unit, largest, frequency, time, limit, limiting_part, largest > limit, recorded, driven,
                steady,
            )  # fmt: skip

    def _below_resolution(self, expectations: Iterable[Expectation]) -> Iterable[str]:
        """Yield a warning for each channel whose signal is below the resolution of the converter."""
        maxima = {row.name: row.largest for row in expectations}
        controlled_positions = self.scene.controlled_terms
        for info in self.bench.channels:
            count = info.unit_per_count
            if info.volts_per_count is not None and maxima[info.name] < 2.0 * count:
                consequence = ""
                if info.at in controlled_positions:
                    consequence = ", so the level cannot be controlled and all maxima are uncertain"
                yield (
                    f"{info.name}: the largest reading is below two counts of the converter "
                    f"({format_quantity(count, info.unit)} each){consequence}. Choose a smaller range or a higher "
                    "sensitivity."
                )

    def _below_noise(self, signals: Mapping[str, LowestSignalToNoise]) -> Iterable[str]:
        """Yield a warning for each channel whose noise exceeds its signal at a frequency of the test."""
        for name, lowest in signals.items():
            if lowest.ratio < 1.0:
                yield (
                    f"{name}: at {lowest.frequency:.4g} Hz, the signal is {-lowest.decibels:.0f} dB below the noise. "
                    f"Raise {self.key or 'the level of the test'}, or use a sensor with a higher sensitivity."
                )

    def _limited_sensors(self) -> Iterable[tuple[Channel, float, float]]:
        """Yield each channel of an accelerometer with a limit, this limit, and the largest damper impact [m/s²]."""
        closing_speeds = np.max([part.closing_speed for part in self.unlimited_test.parts], axis=0)
        speeds = closing_speeds[self.system.damper_number - 1].tolist()
        for channel in self.scene.channels or ():
            sensor = None if channel.accelerometer is None else complete_from_preset(channel.accelerometer)
            if sensor is not None and sensor.saturation is not None:
                row = self.system.points.index(channel.at)
                yield channel, sensor.saturation, impact_acceleration(self.system, row, speeds, sensor.resonance)

    def _sensors(self) -> Iterable[Expectation]:
        """Yield the largest acceleration, of the motion or of an impact, at each accelerometer with a limit."""
        names = [info.name for info in self.bench.channels]
        for channel, saturation, landing_peak in self._limited_sensors():
            row = self.system.points.index(channel.at)
            motion_peak, frequency, time = self.unlimited_test.largest("accelerations", row)
            is_overload_marked = any(part.overloaded[names.index(channel.name)] for part in self.rehearsed_test.parts)
            largest = max(motion_peak, landing_peak)
            # An overload marker does not distinguish an overload of the sensor from an overload of the input.
            is_overloaded = is_overload_marked and largest > saturation
            name = f"{channel.name} sensor"
            yield Expectation(name, "m/s^2", largest, frequency, time, saturation, "sensor", is_overloaded)

    def _outputs(self) -> Iterable[Expectation]:
        """Yield the voltage of the output that drives the shaker, and the voltage or current of its power amplifier."""
        shaker = self.scene.driven_shaker
        for row, (name, unit) in enumerate(zip(self.bench.inputs, self.bench.drive_units, strict=True)):
            if shaker is None or name != self.scene.at_driven("shaker") or self.scene.driven is None:
                continue
            drive, frequency, time = self.unlimited_test.largest("drives", row)
            if drive == 0.0:
                continue
            output = complete_from_preset(shaker.output).range
            amplifier, drive_limit = shaker.power_amplifier, shaker.drive_limit
            if drive >= _LIMITED_DRIVE_RATIO * drive_limit:
                # The drive cannot exceed the limit; the linear response gives the required drive.
                required = required_drive(self.scene, self.system)
                if required is not None:
                    drive, frequency = required[0] * self.level, required[1]
                elif self.key:
                    drive = self._unclipped_drive(row, drive_limit)
            volts = drive / DRIVE_PER_VOLT[unit]
            limit, name = np.inf if output is None else output, f"ao{self.scene.driven - 1}"
            yield Expectation(name, "V", volts, frequency, time, limit, "output", volts > limit)
            if amplifier is not None:
                unit, magnitude, is_limited = amplifier.unit, amplifier.gain * drive, drive > drive_limit
                yield Expectation(
                    "amplifier", unit, magnitude, frequency, time, amplifier.limit, "amplifier", is_limited
                )

    def _unclipped_drive(self, row: int, limit: float) -> float:
        """Extrapolate the largest drive of a test without tones from a rehearsal at a lower level without clipping."""
        scene, level = self.unlimited_test.parts[0].scene, self.level
        for _ in range(_MAX_LEVEL_REDUCTIONS):
            level *= _LEVEL_REDUCTION
            rehearsal = Rehearsal(with_level(scene, level)).run(4.0 * affordable_seconds(self.scene))
            drive = float(rehearsal.drives.magnitude[row])
            if drive < _LIMITED_DRIVE_RATIO * limit:
                break
        return drive * self.level / level * self.unlimited_test.extension

    def _loads(self) -> Iterable[Expectation]:
        """Yield the largest value of each quantity that loads a shaker, with its limit."""
        for row, (name, quantity, *_) in enumerate(loads_of(self.scene, self.bench.points)):
            magnitude, frequency, time = self.unlimited_test.largest("loads", row)
            if magnitude > 0.0:
                unit, limit = quantity.unit, quantity.limit
                yield Expectation(name, unit, magnitude, frequency, time, limit, "shaker", magnitude > limit)

    def _largest_level(self, limiting: Expectation, is_nonlinear: bool) -> tuple[float, bool]:
        """Return the largest level without overload, and whether a damper or joint acts at it or at the test level."""
        onset = onset_level(self.scene, self.system)
        if not np.isfinite(limiting.driven_share):
            return onset, True
        level = self.level / limiting.driven_share
        return level, is_nonlinear or level > onset

    def _duration(self) -> _Duration:
        rehearsed_test, test = self.rehearsed_test, test_of(self.scene)
        rehearsed_seconds = sum(part.seconds for part in rehearsed_test.parts)
        if rehearsed_test.is_complete or (rehearsed_test.aborted is not None and len(rehearsed_test.parts) == 1):
            return _Duration.within(rehearsed_seconds)
        procedure = procedure_of(test)
        if procedure.rehearsal == "part":
            [part] = rehearsed_test.parts
            if not part.complete:
                rehearsed_seconds /= max(part.fraction, _MIN_FRACTION)
            seconds = procedure.seconds(test, part.scene.test, rehearsed_seconds)
            return _Duration.within(seconds, procedure.duration_ratio)
        if not test.dwells:
            return _Duration.within(test.shortest)
        order, dwells = np.array(test.dwells), len(test.levels) * len(test.dwells)
        linear = linear_waits(self.scene, self.system, self.bench.channels)
        rehearsed, flights = np.full(order.size, False), list[_Duration]()
        for number, part in enumerate(rehearsed_test.parts):
            for frequency, wait in self._rehearsed_waits(part, is_beginning=number == 0):
                equal = np.isclose(order, frequency) & ~rehearsed
                flights += [wait] * (len(test.levels) * int(equal.sum()))
                rehearsed |= equal
        waits = linear.expected.copy()
        errors = linear.scatter * waits
        flies = [flying_tones(self.scene, self.system, level, order) for level in test.levels] & ~rehearsed
        if flights:
            # Tones with flying dampers that were not rehearsed are away from the peaks, so few settle slowly.
            expected = np.array([wait.expected for wait in flights])
            waits[flies] = np.maximum(waits[flies], np.exp(np.log(expected).mean()))
            errors[flies] = expected.std()
        waits, errors = waits[:, ~rehearsed], errors[:, ~rehearsed]
        error = _LINEAR_WAIT_ERROR * waits.sum() + _WAIT_SIGMAS * float(np.linalg.norm(errors))
        total = estimate(self.scene).seconds + waits.sum()
        complete = sum(flights, start=_Duration(total, total - min(error, waits.sum()), total + error))
        if rehearsed_test.aborted is None:
            return complete
        # The test aborts near the last rehearsed tone.
        last_part = rehearsed_test.parts[-1]
        last_tone = last_part.frequency_at(round(last_part.seconds * last_part.rate))
        index = int(np.argmin(abs(order - last_tone))) if last_tone is not None else 0
        seconds = max(rehearsed_seconds, complete.expected * (index + 1) / dwells) if index > 1 else rehearsed_seconds
        return _Duration.within(seconds, _ABORT_RATIO)

    def _rehearsed_waits(self, part: Rehearsal, is_beginning: bool) -> Iterable[tuple[float, _Duration]]:
        """Yield the frequency of each tone of a part at which a damper or joint acts, and the wait for it.

        A part at the beginning of the test settles exactly as the test does, so its settled tones without flights are
        included too. A tone that did not settle in the rehearsal may settle soon after, or take the longest wait that
        the test permits. The mean of the two is assumed. In scenes of the paper, 40 such tones took 37 s on average;
        the two limits were 10 and 60 s.
        """
        longest = test_of(self.scene).steady_state.longest
        times = np.array([time for element in part.event_times for time in element]) * self.bench.rate
        for settle, measure in zip(part.steps[::2], part.steps[1::2], strict=False):
            wait = (settle.stop - settle.first) / self.bench.rate
            latest = wait if measure.settled else max(longest, wait)
            if ((times >= settle.first) & (times < measure.stop)).any() or (is_beginning and measure.settled):
                yield settle.frequency, _Duration((wait + latest) / 2.0, wait, latest)
