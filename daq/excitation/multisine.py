"""Multisine: periodic sums of tones with random phases; several realizations of several periods."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.excitation.spectrum_shaping import (
    Lines,
    closed_loop,
    crossfade,
    equalise,
    flat,
    generator,
    lines_between,
    wave_of,
    within_limit,
)
from daq.excitation.station import Excitation, Station

if TYPE_CHECKING:
    from rig.scene.excitation import Multisine

Array = NDArray[np.float64]

# Relative difference of successive periods in the steady state; maximum wait in s and in periods.
_TOLERANCE, _LONGEST, _MOST_PERIODS = 1e-4, 60.0, 8
_NOISE = 0.9


def excite(station: Station, test: Multisine) -> Excitation:
    """Run a multisine test."""
    if test.period is not None:
        period = station.samples(test.period)
        lines = lines_between(test.from_, test.to, period, station.rate)
    else:
        count = test.lines or 2
        period = station.samples(count / (test.to - test.from_))
        lines = lines_between(test.from_, test.to, period, station.rate)[:count]
    return _run(station, test, lines, period, closed_loop(station, test))


def _run(station: Station, test: Multisine, lines: Lines, period: int, closed: bool) -> Excitation:
    level = test.force or test.drive or 0.0
    random = generator(station, "multisine")
    shakers = station.shakers
    playing = np.zeros((len(shakers), period))
    amplitudes = flat(level, lines)
    for realisation in range(1, test.realisations + 1):
        phases = random.uniform(0.0, 2 * np.pi, lines.size)
        if closed and realisation == 1:
            shaped = yield from equalise(station, lines, period, level, phases)
            amplitudes, playing[0] = shaped.amplitudes, shaped.wave
        others = [
            generator(station, f"multisine {number} {realisation}").uniform(0.0, 2 * np.pi, lines.size)
            for number in shakers[1:]
        ]
        for experiment in range(len(shakers)):
            turn = 2.0 * np.pi * experiment / len(shakers)
            waves = np.stack(
                [
                    wave_of(lines, amplitudes, each + turn * k, period)
                    for k, each in enumerate([phases, *others])
                ]
            )
            factor = min(within_limit(station, wave) for wave in waves)
            number = realisation if len(shakers) == 1 else f"{realisation}, experiment {experiment + 1}"
            message = f"realisation {number} of {test.realisations}"
            done = (realisation - 1 + experiment / len(shakers)) / test.realisations
            step = 1.0 / test.realisations / len(shakers)
            if factor < 1.0:
                station.warn(
                    f"{message}: the amplifier's limit keeps the drive at {factor:.0%} of what was asked"
                )
            several = {} if len(shakers) == 1 else {"experiment": experiment, "shakers": list(shakers)}
            yield from _measured(
                station, test, lines, playing, factor * waves, message, (done, step),
                {"realisation": realisation, **several}, level,
            )  # fmt: skip
            playing = factor * waves
    yield station.drives(np.stack([crossfade(each, np.zeros(period)) for each in playing]))


def _measured(
    station: Station, test: Multisine, lines: Lines, playing: Array, waves: Array, message: str,
    progress: tuple[float, float], fields: Mapping[str, object], level: float,
) -> Generator[Array, Array, None]:  # fmt: skip
    """Play waves of the driven shakers until the response is periodic, then measure periods."""
    done, step = progress
    period = waves.shape[1]
    station.report(done, f"{message}, settling")
    first = station.now
    yield station.drives(np.stack([crossfade(a, b) for a, b in zip(playing, waves, strict=True)]))
    settled = yield from _settle(station, waves)
    station.mark("settle", first, station.now, realisation=fields["realisation"], settled=settled)
    if not settled:
        station.warn(f"{message}: not periodic within {_longest(station, period) / station.rate:g} s")
    first = station.now
    for turn in range(test.periods):
        station.report(done + turn / test.periods * step, f"{message}, period {turn + 1}")
        yield station.drives(waves)
    station.mark(
        "measure",
        first,
        station.now,
        **fields,
        period=period,
        periods=test.periods,
        lines=[int(lines[0]), int(lines[-1])],
        level=level,
        settled=settled,
    )


def _settle(station: Station, waves: Array) -> Generator[Array, Array, bool]:
    """Play periods until successive periods agree, or until their difference is noise."""
    end = station.now + _longest(station, waves.shape[1])
    before = yield station.drives(waves)
    smallest, level = np.inf, 0
    while station.now < end:
        now = yield station.drives(waves)
        size = np.sqrt(np.mean((now - now.mean(axis=1, keepdims=True)) ** 2, axis=1))
        change = float(np.max(np.sqrt(np.mean((now - before) ** 2, axis=1)) / np.maximum(size, 1e-300)))
        ratio = change / smallest if smallest > 0.0 else 0.0
        # A transient decreases by this ratio from period to period; noise does not decrease.
        level += ratio > _NOISE
        fading = np.isfinite(smallest) and ratio < _NOISE
        if level >= 2 or (fading and change * ratio / (1.0 - ratio) < _TOLERANCE):
            return True
        before, smallest = now, min(smallest, change)
    return False


def _longest(station: Station, period: int) -> int:
    """Return the maximum number of samples to wait for a periodic response."""
    return max(station.samples(_LONGEST), _MOST_PERIODS * period)
