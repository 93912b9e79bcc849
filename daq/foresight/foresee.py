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
from daq.foresight.linear import drive_needed, least_signals
from daq.foresight.rehearsal import Rehearsal, recording_size
from daq.foresight.shortened import (
    Shortened,
    about_peaks,
    affordable_seconds,
    around_extreme,
    at_level,
    expected_seconds,
    level_key,
    shortened,
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

# Multiple of the affordable time after which a rehearsal that takes longer than expected is ended.
_LONGEST = 1.5
# Share of the drive limit from which the drive is limited.
_AT_LIMIT = 0.999
# Rehearsals at other levels in search of the largest level that fits, where dampers fly; and relative tolerance.
_TRIALS, _TOLERANCE = 3, 0.02
# Share of the settling time of a bias within which a maximum is the power-on transient.
_POWER_ON_SHARE = 0.5
# Ratio to the test's level beyond which the level that fits is extrapolated in proportion.
_FARTHEST = 4.0


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
    >>> found = daq.foresee("fig10b-no-damper")
    >>> found.fits, found["body1"].unit
    (True, 'm/s^2')
    """
    loaded = scene if isinstance(scene, Scene) else load(scene)
    loaded = loaded.replace(dampers=tuple(damper.replace(grains=None) for damper in loaded.dampers))
    test_of(loaded)
    bench = Bench(loaded)
    played = play(loaded, bench)
    free = played
    if any(part.aborted or any(part.overloaded) for part in played.parts):
        free = play(without_limits(loaded), bench)
    return _Assessment(loaded, bench, played, free).foresight()


@dataclass(frozen=True)
class Played:
    """Rehearsals of the parts of a test; whether they are the whole test, and which parts are left out."""

    parts: tuple[Rehearsal, ...]
    whole: bool
    left_out: str = ""
    extension: float = 1.0  # factor on the extremes of a random test that was rehearsed in part

    @property
    def aborted(self) -> str | None:
        """Reason for which the test would abort."""
        return next((part.aborted for part in self.parts if part.aborted is not None), None)

    def largest(self, quantity: str, row: int) -> tuple[float, float | None, float | None]:
        """Largest extreme of all parts in a row of a quantity, with its frequency or its time."""
        part = max(self.parts, key=lambda each: getattr(each, quantity).size[row])
        size, sample = float(getattr(part, quantity).size[row]), int(getattr(part, quantity).sample[row])
        frequency = part.frequency_at(sample)
        return size * self.extension, frequency, sample / part.rate if frequency is None else None

    def reading_time(self, row: int) -> float:
        """Time of the largest reading, s from the start of the test; infinite in a part that begins later."""
        part = max(self.parts, key=lambda each: float(each.readings.size[row]))
        return float(part.readings.sample[row] / part.rate) if part is self.parts[0] else np.inf


def play(scene: Scene, bench: Bench) -> Played:
    """Rehearse a test, or its affordable parts."""
    chosen, seconds = shortened(scene, bench.channels), affordable_seconds(scene)
    parts = _rehearsed(chosen, _LONGEST * max(seconds, expected_seconds(chosen.parts[0][0])))
    test = scene.test
    if chosen.whole and (parts[0].complete or parts[0].aborted is not None):
        return Played(parts, True)
    if isinstance(test, SteppedSine | SweptSine):
        if chosen.whole:
            # It took longer than expected: the rest is rehearsed about its peaks.
            chosen = about_peaks(scene, test, bench.channels, seconds)
            parts += _rehearsed(chosen, _LONGEST * seconds)
        steps = sum(len(part.steps) // 2 for part in parts)
        return Played(parts, False, f"{steps} steps about the peaks of the linear response")
    if parts[0].aborted is not None:
        # The rest of the test does not happen.
        return Played(parts, True)
    extension = 1.0
    if not chosen.whole and isinstance(test, Random):
        # Expected extremes of a Gaussian process in the whole test and in a part, by its zero crossings.
        crossings = test.from_ + test.to
        whole, part = (np.log(max(crossings * time, 3.0)) for time in (test.duration, parts[0].seconds))
        extension = float(max(np.sqrt(whole / part), 1.0))
    return Played(parts, False, f"{sum(part.seconds for part in parts):.3g} s of it", extension)


def _rehearsed(chosen: Shortened, longest: float) -> tuple[Rehearsal, ...]:
    """Rehearse the parts one after another, up to an abort."""
    parts: list[Rehearsal] = []
    for scene, ahead in chosen.parts:
        parts.append(Rehearsal(scene, ahead).run(longest))
        if parts[-1].aborted is not None:
            break
    return tuple(parts)


class _Assessment:
    """Comparison of rehearsals with the limits of a scene."""

    def __init__(self, scene: Scene, bench: Bench, played: Played, free: Played) -> None:
        self.scene, self.bench, self.played, self.free = scene, bench, played, free
        self.system = assemble(scene)
        self.key, self.level, self.level_unit = level_key(scene)

    def foresight(self) -> Foresight:
        """Assemble the prediction."""
        rows = (*self._channels(), *self._sensors(), *self._outputs(), *self._tables())
        nonlinear = any(any(part.strikes) for part in self.free.parts)
        ranked = sorted(rows, key=lambda row: row.driven_share)
        limiting = ranked[-1] if ranked else None
        largest_level = np.nan
        if limiting is not None and limiting.driven_share > 0.0 and self.key:
            largest_level, nonlinear = self._largest_level(limiting, nonlinear)
            # The second nearest limit must hold as well.
            following = ranked[-2].driven_share if len(ranked) > 1 else 0.0
            if following > 0.0:
                others = max(self.level / following, self.level / limiting.driven_share)
                largest_level = min(largest_level, others)
        seconds = self._seconds()
        stored = chain.from_iterable(part.last_blocks for part in self.played.parts)
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
            signals=least_signals(self.scene, self.bench.channels),
            unread=tuple(self._unread(rows)),
            flights=flight_lines(self.scene, self.system, self.level, self.free.parts),
            seconds=seconds,
            disk=recording_size(self.scene, self.bench, stored, seconds),
            rehearsed=self.played.left_out,
            outside=outside_band(self.scene),
        )

    def _channels(self) -> Iterable[Expectation]:
        settings = {channel.name: channel for channel in self.scene.channels or ()}
        for row, info in enumerate(self.bench.channels):
            largest, frequency, time = self.free.largest("readings", row)
            driven = None
            limit, part = reading_limit(settings.get(info.name), info)
            if _POWER_ON_SHARE * settling_time(info) > self.free.reading_time(row):
                # The reading of a sensor while its bias settles is no response to the tone.
                frequency, time = None, self.free.reading_time(row)
                driven = max(
                    (float(part.readings.size[row]) for part in self.free.parts[1:]), default=largest
                )
            recorded = min(self.played.largest("readings", row)[0], np.inf if info.range is None else limit)
            yield Expectation(
                info.name, info.unit, largest, frequency, time, limit, part, largest > limit, recorded, driven
            )

    def _unread(self, rows: Iterable[Expectation]) -> Iterable[str]:
        """Name channels whose signal is below the resolution of the converter."""
        sizes = {row.name: row.largest for row in rows}
        places = controlled_places(self.scene)
        for info in self.bench.channels:
            count = info.unit_per_count
            if info.volts_per_count is not None and sizes[info.name] < 2.0 * count:
                lost = ""
                if info.at in places:
                    lost = ", so that the force cannot be controlled and all maxima are uncertain"
                yield (
                    f"{info.name} reads less than two counts of the converter ({in_words(count, info.unit)} each)"
                    f"{lost}. Choose a smaller range or a higher sensitivity."
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
            smooth, frequency, time = self.free.largest("accelerations", row)
            landing = impact_acceleration(self.system, row, speeds.tolist(), sensor.resonance)
            reached = any(part.overloaded[names.index(channel.name)] for part in self.played.parts)
            largest = max(smooth, landing)
            # A sample does not show which limit it met; the acceleration does.
            over = reached and largest > sensor.saturation
            name, limit = f"{channel.name} sensor", sensor.saturation
            yield Expectation(name, "m/s^2", largest, frequency, time, limit, "sensor", over)

    def _outputs(self) -> Iterable[Expectation]:
        """Give the output that drives the shaker, in volts, and the power amplifier in front of a coil."""
        shaker = self.scene.driven_shaker
        for row, (name, unit) in enumerate(zip(self.bench.inputs, self.bench.drive_units, strict=True)):
            if shaker is None or name != self.scene.at_driven("shaker") or self.scene.driven is None:
                continue
            drive, frequency, time = self.free.largest("drives", row)
            if drive == 0.0:
                continue
            output = complete_from_preset(shaker.output).range
            amplifier = shaker.amplifier if isinstance(shaker, ElectrodynamicShaker) else None
            most = np.inf if amplifier is None else amplifier.limit / amplifier.gain
            if drive >= _AT_LIMIT * most:
                # The control gives no more than the limit; the linear response gives the required drive.
                needed = drive_needed(self.scene, self.system)
                drive, frequency = (needed[0] * self.level, needed[1]) if needed else (drive, frequency)
            volts = drive / DRIVE_PER_VOLT[unit]
            limit, name = np.inf if output is None else output, f"ao{self.scene.driven - 1}"
            yield Expectation(name, "V", volts, frequency, time, limit, "output", volts > limit)
            if amplifier is not None:
                size, unit, limit = (
                    amplifier.gain * drive,
                    "V" if amplifier.mode == "voltage" else "A",
                    amplifier.limit,
                )
                yield Expectation("amplifier", unit, size, frequency, time, limit, "amplifier", drive > most)

    def _tables(self) -> Iterable[Expectation]:
        for row, name in enumerate(self.bench.points):
            size, frequency, time = self.free.largest("displacements", row)
            if name.startswith("table") and size > 0.0:
                yield Expectation(f"{name} travel", "m", size, frequency, time)

    def _largest_level(self, limiting: Expectation, nonlinear: bool) -> tuple[float, bool]:
        """Largest level that fits, and whether dampers fly at it or at the test's."""
        onset = onset_level(self.scene, self.system)
        if not np.isfinite(limiting.driven_share):
            return onset, True
        level = self.level / limiting.driven_share
        flies = nonlinear or level > onset
        names = [info.name for info in self.bench.channels]
        if not flies or limiting.name not in names or not 1.0 / _FARTHEST < limiting.driven_share < _FARTHEST:
            return level, flies
        return self._secant(limiting, names.index(limiting.name), level), True

    def _secant(self, limiting: Expectation, row: int, level: float) -> float:
        """Rehearse the part with the largest reading of a channel at other levels: secant method in logarithms."""
        part = max(self.free.parts, key=lambda each: float(each.readings.size[row]))
        seconds = affordable_seconds(self.scene) / (2 * _TRIALS)
        scene, ahead = around_extreme(part.scene, limiting.frequency, seconds)
        if scene is None:
            return level
        free, tried = without_limits(scene), [(np.log(self.level), np.log(limiting.driven_share))]
        for _ in range(_TRIALS):
            run = Rehearsal(at_level(free, level), ahead).run(4.0 * seconds)
            share = max(float(run.readings.size[row]) / limiting.limit, 1e-12)
            tried.append((np.log(level), np.log(share)))
            if abs(share - 1.0) < _TOLERANCE:
                break
            (before, high), (here, low) = tried[-2:]
            slope = (low - high) / (here - before) if here != before else 1.0
            level = float(np.exp(here - low / np.clip(slope, 0.5, 2.0)))
        return level

    def _seconds(self) -> float:
        """Time that the test takes, s."""
        played, test = self.played, self.scene.test
        done = sum(part.seconds for part in played.parts)
        if played.whole or (played.aborted is not None and len(played.parts) == 1):
            return done
        if isinstance(test, Multisine):
            # Each realisation settles for about the same time; the measured time is known.
            once = played.parts[0].scene.test
            assert isinstance(once, Multisine)
            period = estimate(self.scene).seconds / (test.realisations * test.periods)
            again = test.realisations / once.realisations
            return again * done + test.realisations * (test.periods - once.periods) * period
        if not isinstance(test, SteppedSine):
            shorter = sum(estimate(part.scene).seconds for part in played.parts)
            if isinstance(test, SweptSine):
                return estimate(self.scene).seconds
            return done + max(estimate(self.scene).seconds - shorter, 0.0)
        # A step between the peaks waits as long as the quicker steps about them.
        waits = [wait for part in played.parts for wait in self._waits(part, test)] or [1.0]
        steps = len(test.levels) * len(test.order)
        typical = float(np.percentile(waits, 25))
        extra = sum(wait - typical for wait in waits)
        whole = estimate(self.scene).seconds + steps * typical + max(extra, 0.0)
        if played.aborted is None:
            return whole
        # The test ends near the tone that was played last.
        last = played.parts[-1].frequency_at(round(played.parts[-1].seconds * played.parts[-1].rate))
        order = np.array(test.order)
        place = int(np.argmin(abs(order - last))) if last is not None else 0
        return max(done, whole * (place + 1) / steps) if place > 1 else done

    def _waits(self, part: Rehearsal, test: SteppedSine) -> Iterable[float]:
        """Return the times until the tones of a part are steady, s.

        A tone that did not settle in a rehearsal may take a little longer or all the time that the test allows:
        the geometric mean of the two is assumed.
        """
        for settle, measure in zip(part.steps[::2], part.steps[1::2], strict=False):
            wait = (settle.stop - settle.first) / self.bench.rate
            irregular = not measure.settled and any(part.strikes)
            yield float(np.sqrt(wait * max(test.settle.longest, wait))) if irregular else wait
