"""Prediction of a test: a rehearsal of the parts with its extremes, compared with the limits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from daq.excitation import test_of
from daq.excitation.impulse import settling_time
from daq.foresight.chain_limits import reading_limit, without_limits
from daq.foresight.flights import flight_lines, onset_level, outside_band
from daq.foresight.foresight import Expectation, Foresight, in_words
from daq.foresight.linear import lowest_signal_to_noise, required_drive
from daq.foresight.rehearsal import Rehearsal, recording_size
from daq.foresight.rehearsal_plan import (
    RehearsalPlan,
    affordable_seconds,
    expected_seconds,
    level_key,
    plan_about_peaks,
    plan_rehearsal,
    tones_up_to,
    with_level,
)
from daq.measurement.estimate import estimate
from daq.measurement.limits import controlled_places
from daq.virtual_bench.bench import Bench
from rig.damper_design.overloads import impact_acceleration
from rig.scene.excitation import Multisine, Random, SteppedSine, SweptSine
from rig.scene.loading import load
from rig.scene.presets import complete_from_preset
from rig.scene.scene import Scene
from rig.scene.shaker import DRIVE_PER_VOLT, ElectrodynamicShaker
from rig.system.assembly import assemble

# A rehearsal is ended after this multiple of the affordable or expected time.
_MAX_TIME_RATIO = 1.5
# The drive counts as limited from this ratio to its limit.
_LIMITED_DRIVE_RATIO = 0.999
# Largest number of rehearsals at other levels that compute the largest level that fits, where dampers fly.
_MAX_SECANT_STEPS = 3
# Relative tolerance of that level.
_LEVEL_TOLERANCE = 0.02
# A maximum within this ratio to the settling time of a bias is the power-on transient.
_POWER_ON_RATIO = 0.5
# Beyond this ratio to the test's level, the level that fits is extrapolated in proportion.
_MAX_LEVEL_RATIO = 4.0


def foresee(scene: Scene | str | Path) -> Foresight:
    """Predict the maxima of a test, their margin to the limits, its duration and the size of its recording.

    A short test is rehearsed completely on the scene's bench, with its noise; of a long test the parts with the
    largest linear response. A bed of grains is treated as one mass.

    Parameters
    ----------
    scene : Scene or str or Path
        Scene, name of a bundled one, or path of a scene file.

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
    loaded = loaded.replace(dampers=tuple(damper.replace(grains=None) for damper in loaded.dampers))
    test_of(loaded)
    bench = Bench(loaded)
    played = rehearse_test(loaded, bench)
    free = played
    if any(part.aborted or any(part.overloaded) for part in played.parts):
        free = rehearse_test(without_limits(loaded), bench)
    return _Assessment(loaded, bench, played, free).foresight()


@dataclass(frozen=True)
class RehearsedTest:
    """Rehearsals of the parts of a test."""

    parts: tuple[Rehearsal, ...]
    is_complete: bool  # the parts are the complete test
    rehearsed: str = ""  # the rehearsed part in words; "" for the complete test
    extension: float = 1.0  # factor on the extremes of a random test that was rehearsed in part

    @property
    def aborted(self) -> str | None:
        """Reason for which the test would abort."""
        return next((part.aborted for part in self.parts if part.aborted is not None), None)

    def largest(self, quantity: str, row: int) -> tuple[float, float | None, float | None]:
        """Return the largest extreme of all parts in a row of a quantity, with its frequency or its time."""
        part = max(self.parts, key=lambda rehearsal: getattr(rehearsal, quantity).magnitude[row])
        magnitude, sample = (float(getattr(part, quantity).magnitude[row]), int(getattr(part, quantity).sample[row]))
        frequency = part.frequency_at(sample)
        return magnitude * self.extension, frequency, sample / part.rate if frequency is None else None

    def reading_time(self, row: int) -> float:
        """Return the time of the largest reading from the start of the test, s; infinite in later parts."""
        part = max(self.parts, key=lambda each: float(each.readings.magnitude[row]))
        return float(part.readings.sample[row] / part.rate) if part is self.parts[0] else np.inf


def rehearse_test(scene: Scene, bench: Bench) -> RehearsedTest:
    """Rehearse a test, or its affordable parts."""
    plan, seconds = plan_rehearsal(scene, bench.channels), affordable_seconds(scene)
    parts = _rehearse_parts(plan, _MAX_TIME_RATIO * max(seconds, expected_seconds(plan.parts[0][0])))
    test = scene.test
    if plan.is_complete and (parts[0].complete or parts[0].aborted is not None):
        return RehearsedTest(parts, True)
    if isinstance(test, SteppedSine | SweptSine):
        if plan.is_complete:
            # The rehearsal took longer than expected: the rest of the test is rehearsed about its peaks.
            plan = plan_about_peaks(scene, test, bench.channels, seconds)
            parts += _rehearse_parts(plan, _MAX_TIME_RATIO * seconds)
        steps = sum(len(part.steps) // 2 for part in parts)
        return RehearsedTest(parts, False, f"{steps} steps about the peaks of the linear response")
    if parts[0].aborted is not None:
        # The test ends here.
        return RehearsedTest(parts, True)
    extension = 1.0
    if not plan.is_complete and isinstance(test, Random):
        # Expected extremes of a Gaussian process in the whole test and in a part, by its zero crossings.
        crossings = test.from_ + test.to
        log_whole, log_part = (np.log(max(crossings * time, 3.0)) for time in (test.duration, parts[0].seconds))
        extension = float(max(np.sqrt(log_whole / log_part), 1.0))
    return RehearsedTest(parts, False, f"{sum(part.seconds for part in parts):.3g} s of it", extension)


def _rehearse_parts(plan: RehearsalPlan, max_seconds: float) -> tuple[Rehearsal, ...]:
    """Rehearse the parts one after another, up to an abort."""
    parts: list[Rehearsal] = []
    for scene, excluded_steps in plan.parts:
        parts.append(Rehearsal(scene, excluded_steps).run(max_seconds))
        if parts[-1].aborted is not None:
            break
    return tuple(parts)


class _Assessment:
    """Comparison of rehearsals with the limits of a scene."""

    def __init__(self, scene: Scene, bench: Bench, played: RehearsedTest, free: RehearsedTest) -> None:
        self.scene, self.bench, self.played, self.free = scene, bench, played, free
        self.system = assemble(scene)
        self.key, self.level, self.level_unit = level_key(scene)

    def foresight(self) -> Foresight:
        """Assemble the prediction."""
        rows = (*self._channels(), *self._sensors(), *self._outputs(), *self._tables())
        nonlinear = any(any(part.impact_times) for part in self.free.parts)
        ranked = sorted(rows, key=lambda row: row.driven_share)
        limiting = ranked[-1] if ranked else None
        largest_level = np.nan
        if limiting is not None and limiting.driven_share > 0.0 and self.key:
            largest_level, nonlinear = self._largest_level(limiting, nonlinear)
            # The second nearest limit must not be exceeded either.
            second_ratio = ranked[-2].driven_share if len(ranked) > 1 else 0.0
            if second_ratio > 0.0:
                second_level = max(self.level / second_ratio, self.level / limiting.driven_share)
                largest_level = min(largest_level, second_level)
        seconds = self._test_duration()
        last_blocks = chain.from_iterable(part.last_blocks for part in self.played.parts)
        return Foresight(
            scene=self.scene.name,
            expectations=rows,
            key=self.key,
            level=self.level,
            largest_level=largest_level,
            level_unit=self.level_unit,
            limited_by=limiting if np.isfinite(largest_level) else None,
            nonlinear=nonlinear,
            aborts=self.played.aborted,
            signals=lowest_signal_to_noise(self.scene, self.bench.channels),
            unread=tuple(self._below_resolution(rows)),
            flights=flight_lines(self.scene, self.system, self.level, self.free.parts),
            seconds=seconds,
            disk=recording_size(self.scene, self.bench, last_blocks, seconds),
            rehearsed=self.played.rehearsed,
            outside=outside_band(self.scene),
        )

    def _channels(self) -> Iterable[Expectation]:
        settings = {channel.name: channel for channel in self.scene.channels or ()}
        for row, info in enumerate(self.bench.channels):
            largest, frequency, time = self.free.largest("readings", row)
            driven = None
            limit, part = reading_limit(settings.get(info.name), info)
            if _POWER_ON_RATIO * settling_time(info) > self.free.reading_time(row):
                # The reading of a sensor while its bias settles is no response to the tone.
                frequency, time = None, self.free.reading_time(row)
                driven = max((float(part.readings.magnitude[row]) for part in self.free.parts[1:]), default=largest)
            recorded = min(self.played.largest("readings", row)[0], np.inf if info.range is None else limit)
            yield Expectation(
                info.name, info.unit, largest, frequency, time, limit, part, largest > limit, recorded, driven
            )

    def _below_resolution(self, rows: Iterable[Expectation]) -> Iterable[str]:
        """Name channels whose signal is below the resolution of the converter."""
        maxima = {row.name: row.largest for row in rows}
        places = controlled_places(self.scene)
        for info in self.bench.channels:
            count = info.unit_per_count
            if info.volts_per_count is not None and maxima[info.name] < 2.0 * count:
                consequence = ""
                if info.at in places:
                    consequence = ", so that the force cannot be controlled and all maxima are uncertain"
                yield (
                    f"{info.name} reads less than two counts of the converter ({in_words(count, info.unit)} each)"
                    f"{consequence}. Choose a smaller range or a higher sensitivity."
                )

    def _sensors(self) -> Iterable[Expectation]:
        """Compare accelerometers with their limit: acceleration of the smooth motion and of landings."""
        closing = np.max([part.closing_speed for part in self.free.parts], axis=0)
        speeds = closing[self.system.damper_number - 1]
        names = [info.name for info in self.bench.channels]
        for channel in self.scene.channels or ():
            sensor = None if channel.accelerometer is None else complete_from_preset(channel.accelerometer)
            if sensor is None or sensor.saturation is None:
                continue
            row = self.system.points.index(channel.at)
            motion_peak, frequency, time = self.free.largest("accelerations", row)
            landing_peak = impact_acceleration(self.system, row, speeds.tolist(), sensor.resonance)
            is_flagged = any(part.overloaded[names.index(channel.name)] for part in self.played.parts)
            largest = max(motion_peak, landing_peak)
            # A sample does not show which limit it met; the acceleration does.
            is_overloaded = is_flagged and largest > sensor.saturation
            name, limit = f"{channel.name} sensor", sensor.saturation
            yield Expectation(name, "m/s^2", largest, frequency, time, limit, "sensor", is_overloaded)

    def _outputs(self) -> Iterable[Expectation]:
        """Return the output that drives the shaker, in volts, and the power amplifier in front of a coil."""
        shaker = self.scene.driven_shaker
        for row, (name, unit) in enumerate(zip(self.bench.inputs, self.bench.drive_units, strict=True)):
            if shaker is None or name != self.scene.at_driven("shaker") or self.scene.driven is None:
                continue
            drive, frequency, time = self.free.largest("drives", row)
            if drive == 0.0:
                continue
            output = complete_from_preset(shaker.output).range
            amplifier = shaker.amplifier if isinstance(shaker, ElectrodynamicShaker) else None
            drive_limit = np.inf if amplifier is None else amplifier.limit / amplifier.gain
            if drive >= _LIMITED_DRIVE_RATIO * drive_limit:
                # The control gives no more than the limit; the linear response gives the required drive.
                required = required_drive(self.scene, self.system)
                drive, frequency = (required[0] * self.level, required[1]) if required else (drive, frequency)
            volts = drive / DRIVE_PER_VOLT[unit]
            limit, name = np.inf if output is None else output, f"ao{self.scene.driven - 1}"
            yield Expectation(name, "V", volts, frequency, time, limit, "output", volts > limit)
            if amplifier is not None:
                magnitude, unit, limit = (
                    amplifier.gain * drive,
                    "V" if amplifier.mode == "voltage" else "A",
                    amplifier.limit,
                )
                yield Expectation(
                    "amplifier", unit, magnitude, frequency, time, limit, "amplifier", drive > drive_limit
                )

    def _tables(self) -> Iterable[Expectation]:
        for row, name in enumerate(self.bench.points):
            magnitude, frequency, time = self.free.largest("displacements", row)
            if name.startswith("table") and magnitude > 0.0:
                yield Expectation(f"{name} travel", "m", magnitude, frequency, time)

    def _largest_level(self, limiting: Expectation, nonlinear: bool) -> tuple[float, bool]:
        """Return the largest level that fits, and whether dampers fly at this level or at the test's level."""
        onset = onset_level(self.scene, self.system)
        if not np.isfinite(limiting.driven_share):
            return onset, True
        level = self.level / limiting.driven_share
        flies = nonlinear or level > onset
        names = [info.name for info in self.bench.channels]
        if (
            not flies
            or limiting.name not in names
            or not 1.0 / _MAX_LEVEL_RATIO < limiting.driven_share < _MAX_LEVEL_RATIO
        ):
            return level, flies
        return self._solve_level(limiting, names.index(limiting.name), level), True

    def _solve_level(self, limiting: Expectation, row: int, level: float) -> float:
        """Return the level at which a channel reaches its limit: rehearsals of a part, secant method in logarithms."""
        part = max(self.free.parts, key=lambda each: float(each.readings.magnitude[row]))
        seconds = affordable_seconds(self.scene) / (2 * _MAX_SECANT_STEPS)
        scene, excluded_steps = tones_up_to(part.scene, limiting.frequency, seconds)
        if scene is None:
            return level
        free, log_points = without_limits(scene), [(np.log(self.level), np.log(limiting.driven_share))]
        for _ in range(_MAX_SECANT_STEPS):
            rehearsal = Rehearsal(with_level(free, level), excluded_steps).run(4.0 * seconds)
            reading_ratio = max(float(rehearsal.readings.magnitude[row]) / limiting.limit, 1e-12)
            log_points.append((np.log(level), np.log(reading_ratio)))
            if abs(reading_ratio - 1.0) < _LEVEL_TOLERANCE:
                break
            (level_1, ratio_1), (level_2, ratio_2) = log_points[-2:]
            slope = (ratio_2 - ratio_1) / (level_2 - level_1) if level_2 != level_1 else 1.0
            level = float(np.exp(level_2 - ratio_2 / np.clip(slope, 0.5, 2.0)))
        return level

    def _test_duration(self) -> float:
        """Return the duration of the test, s."""
        played, test = self.played, self.scene.test
        rehearsed_seconds = sum(part.seconds for part in played.parts)
        if played.is_complete or (played.aborted is not None and len(played.parts) == 1):
            return rehearsed_seconds
        if isinstance(test, Multisine):
            # Each realisation settles for about the same time; the measured time is known.
            rehearsed = played.parts[0].scene.test
            assert isinstance(rehearsed, Multisine)
            period = estimate(self.scene).seconds / (test.realisations * test.periods)
            realisation_ratio = test.realisations / rehearsed.realisations
            return (
                realisation_ratio * rehearsed_seconds + test.realisations * (test.periods - rehearsed.periods) * period
            )
        if not isinstance(test, SteppedSine):
            parts_seconds = sum(estimate(part.scene).seconds for part in played.parts)
            if isinstance(test, SweptSine):
                return estimate(self.scene).seconds
            return rehearsed_seconds + max(estimate(self.scene).seconds - parts_seconds, 0.0)
        # A step between the peaks is assumed to settle as fast as the faster steps about them.
        settling_times = [wait for part in played.parts for wait in self._settling_times(part, test)] or [1.0]
        steps = len(test.levels) * len(test.order)
        typical_time = float(np.percentile(settling_times, 25))
        excess = sum(wait - typical_time for wait in settling_times)
        complete_s = estimate(self.scene).seconds + steps * typical_time + max(excess, 0.0)
        if played.aborted is None:
            return complete_s
        # The test ends near the tone that was played last.
        last_tone = played.parts[-1].frequency_at(round(played.parts[-1].seconds * played.parts[-1].rate))
        order = np.array(test.order)
        index = int(np.argmin(abs(order - last_tone))) if last_tone is not None else 0
        return max(rehearsed_seconds, complete_s * (index + 1) / steps) if index > 1 else rehearsed_seconds

    def _settling_times(self, part: Rehearsal, test: SteppedSine) -> Iterable[float]:
        """Return the times until the tones of a part are steady, s.

        A tone that did not settle in a rehearsal may take a little longer or all the time that the test allows:
        the geometric mean of the two is assumed.
        """
        for settle, measure in zip(part.steps[::2], part.steps[1::2], strict=False):
            wait = (settle.stop - settle.first) / self.bench.rate
            irregular = not measure.settled and any(part.impact_times)
            yield float(np.sqrt(wait * max(test.settle.longest, wait))) if irregular else wait
