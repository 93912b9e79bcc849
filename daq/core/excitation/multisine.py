"""Multisine test: periodic sum of tones with random phases, in several realizations of several periods.

Each realization has new random phases. With n shakers, it consists of n experiments.
"""

from collections.abc import Generator

import numpy as np

from daq.core.excitation.controlled import controlled
from daq.core.excitation.procedure import Procedure
from daq.core.excitation.profiles.spectrum_shaping import (
    crossfade,
    equal_amplitudes,
    equalize,
    limit_factor,
    lines_between,
    sum_of_tones,
)
from daq.core.excitation.station import Excitation, Station
from rig.core.base.arrays import Array
from rig.core.results import format_percent
from rig.core.scene.excitation import Multisine
from rig.core.scene.scene import Scene

# Largest relative difference of successive periods in steady state: the remaining transient is of this order.
_TOLERANCE = 1e-4
# Longest wait for the steady state [s], or `_MAX_WAIT_PERIODS` if longer: dampers may move irregularly.
_MAX_WAIT_S = 60.0
# Longest wait for the steady state, in periods.
_MAX_WAIT_PERIODS = 8
# Expected duration of the iterations that shape the drive for a controlled force [s].
_EQUALIZING_S = 8.0
# Ratio of successive differences to the smallest one above which they are noise, not a transient.
_MIN_NOISE_RATIO = 0.9


def _settle(station: Station, waves: Array) -> Generator[Array, Array, bool]:
    """Output periods until successive readings agree or differ only by noise; return whether they do."""
    end = station.now + _max_wait(station, waves.shape[1])
    previous = yield station.drives(waves)
    min_change, noise_count = np.inf, 0
    while station.now < end:
        readings = yield station.drives(waves)
        rms = np.sqrt(np.mean((readings - readings.mean(axis=1, keepdims=True)) ** 2, axis=1))
        change = float(np.max(np.sqrt(np.mean((readings - previous) ** 2, axis=1)) / np.maximum(rms, 1e-300)))
        ratio = change / min_change if min_change > 0.0 else 0.0
        # A transient decreases by this ratio from period to period; noise does not decrease.
        noise_count += ratio > _MIN_NOISE_RATIO
        is_decaying = np.isfinite(min_change) and ratio < _MIN_NOISE_RATIO
        if noise_count >= 2 or (is_decaying and change * ratio / (1.0 - ratio) < _TOLERANCE):
            return True
        previous, min_change = readings, min(min_change, change)
    return False


def _max_wait(station: Station, period: int) -> int:
    """Return the maximum number of samples to wait for a periodic response; `period` is in samples."""
    return max(station.samples(_MAX_WAIT_S), _MAX_WAIT_PERIODS * period)


class MultisineProcedure(Procedure["Multisine"]):
    """A periodic sum of tones."""

    # The extremes of different parts of the test differ by about 10 %.
    budget = 4.0

    def excite(self, station: Station, test: Multisine) -> Excitation:
        """Run a multisine test; each experiment is marked with its settling (`settle`) and its periods (`measure`)."""
        period = station.samples(test.period_s)
        lines = lines_between(test.from_, test.to, period, station.rate)
        if test.period is None:
            lines = lines[: test.lines or 2]
        random, shakers = station.generator("multisine"), station.shakers
        present_waves = np.zeros((len(shakers), period))
        amplitudes, force = equal_amplitudes(station.level, lines), controlled(station)
        for realisation in range(1, test.realisations + 1):
            phases = [random.uniform(0.0, 2 * np.pi, lines.size)]
            if force is not None and realisation == 1:
                amplitudes, _, present_waves[0] = yield from equalize(station, force, lines, period, phases[0])
            for number in shakers[1:]:
                generator = station.generator(f"multisine {number} {realisation}")
                phases.append(generator.uniform(0.0, 2 * np.pi, lines.size))
            for experiment in range(len(shakers)):
                # Orthogonal multisines: between experiments, phases of shaker k increase by 2 pi k / shakers.
                phase_step = 2.0 * np.pi * experiment / len(shakers)
                waves = np.stack(
                    [sum_of_tones(lines, amplitudes, phase + phase_step * k, period) for k, phase in enumerate(phases)]
                )
                factor = min(limit_factor(station, wave) for wave in waves)
                experiment_fields: dict[str, object] = {}  # fields of the marker
                message = f"realization {realisation} of {test.realisations}"
                if len(shakers) > 1:
                    experiment_fields = {"experiment": experiment, "shakers": list(shakers)}
                    message += f", experiment {experiment + 1} of {len(shakers)}"
                if factor < 1.0:
                    station.warn(
                        f"{message}: the amplifier delivers only {format_percent(factor)} of the drive that the level "
                        "requires. Lower the level of the test."
                    )
                waves *= factor
                fraction = (realisation - 1 + experiment / len(shakers)) / test.realisations
                station.report(fraction, f"{message}, settling")
                first = station.now
                yield station.drives(np.stack([crossfade(a, b) for a, b in zip(present_waves, waves, strict=True)]))
                settled = yield from _settle(station, waves)
                station.mark("settle", first, station.now, realisation=realisation, settled=settled)
                if not settled:
                    max_wait_s = _max_wait(station, period) / station.rate
                    station.warn(
                        f"{message}: the response did not become periodic within {max_wait_s:g} s. The periods of this "
                        "realization are marked as not settled. Choose a level at which the motion is periodic, such "
                        "as a lower one."
                    )
                first, n_experiments = station.now, test.realisations * len(shakers)
                for period_index in range(test.periods):
                    station.report(
                        fraction + period_index / test.periods / n_experiments, f"{message}, period {period_index + 1}"
                    )
                    yield station.drives(waves)
                station.mark(
                    "measure", first, station.now, realisation=realisation, **experiment_fields, period=period,
                    periods=test.periods, lines=[int(lines[0]), int(lines[-1])], level=station.level, settled=settled,
                )  # fmt: skip
                present_waves = waves
        yield station.drives(np.stack([crossfade(wave, np.zeros(period)) for wave in present_waves]))

    def snr_gain(self, test: Multisine, frequency: Array) -> Array:
        """Return the signal-to-noise ratio of a line [sqrt(s)], for unit level and unit noise density."""
        period, band = test.period_s, test.to - test.from_
        amplitude = np.sqrt(2.0 / max(1.0, band * period))
        return np.full(frequency.size, amplitude * np.sqrt(period * test.periods / 2.0))

    def waits(self, test: Multisine, scene: Scene) -> float:
        """Return the expected time of crossfades and waits for periodic responses [s]."""
        # Each realization takes three further periods: a crossfade, and at least two until successive periods agree.
        return 3.0 * test.realisations * test.period_s + (_EQUALIZING_S if scene.controlled_terms else 0.0)

    def stored(self, test: Multisine) -> float:
        """Return the period, which is the part of the drive stored in memory [s]."""
        return test.period_s

    def part(self, test: Multisine, seconds: float, scene: Scene) -> Multisine:
        """Return realizations of one period, as many as take `seconds`, at least one."""
        part = test.replace(periods=1)
        fraction = seconds / (part.shortest + self.waits(part, scene))
        return part.replace(realisations=max(1, min(test.realisations, int(fraction * test.realisations))))

    def seconds(self, test: Multisine, part: Multisine, part_seconds: float) -> float:
        """Return the expected duration of the test [s] if a part of it takes `part_seconds`."""
        # Each realization takes about the same time to settle; the duration of the measurement is known.
        remaining_periods = test.realisations * (test.periods - part.periods)
        return test.realisations / part.realisations * part_seconds + remaining_periods * test.period_s


PROCEDURE = MultisineProcedure()
