"""Stepped sine: at each frequency wait for the steady state, measure whole periods, and glide to the next."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.excitation.amplitude_control import AmplitudeControl
from daq.excitation.lock_in import fewest_samples, whole_periods
from daq.excitation.settling import FEWEST_LOOKS, Settling
from daq.excitation.station import Excitation, Station
from daq.excitation.tone import Tone
from daq.excitation.tone_measurement import Gauge, held

if TYPE_CHECKING:
    from rig.scene.excitation import SteppedSine

Array = NDArray[np.float64]

# A glide of this length does not excite modes more than a few hertz away: only the nearest modes must decay, s.
GLIDE = 0.4
_LOOK = 0.1
LONGEST_GLIDE = 3.0
# A transient force above the level by this factor is reduced immediately, before the steady state.
_TOO_MUCH = 3.0
# A drive change, as log ratio, with a negligible transient.
_SMALL = 0.03
# Largest change, as log ratio, for which an extrapolated drive is used.
_TRUSTED = 0.2
_LISTED = 8


def excite(station: Station, test: SteppedSine) -> Excitation:
    """Run a stepped sine."""
    controlled = test.force is not None and not station.force_is_drive
    return _run(station, test, Gauge(station, force=controlled), controlled)


def _run(station: Station, test: SteppedSine, gauge: Gauge, controlled: bool) -> Excitation:
    steps = list(test.order)
    turn = len(steps) // 2 if test.direction == "both" else len(steps)
    names = ["down" if test.direction == "down" or index >= turn else "up" for index in range(len(steps))]
    total, done = len(test.levels) * len(steps), 0
    tone = Tone(station.rate, steps[0])
    unsettled: list[str] = []
    for level in test.levels:
        control = AmplitudeControl(level, station.drive_limit) if controlled else None
        drive = level * station.cautious_drive if controlled else level
        reached: list[tuple[float, float]] = []
        tone.frequency = steps[0]
        for frequency, direction in zip(steps, names, strict=True):
            # The unit of the drive depends on the shaker.
            at_level = f"{level:g} N" if control is not None else f"level {level:g}"
            station.report(done / total, f"{frequency:.2f} Hz {direction}, {at_level}")
            if control is not None and reached:
                drive = min(extrapolated(reached, frequency), station.drive_limit)
            settled = yield from _point(
                station, tone, gauge, control, frequency, drive, level, direction, test
            )
            if not settled:
                unsettled.append(f"{frequency:.4g} Hz {direction} at {at_level}")
            drive = tone.amplitude
            reached = [*reached[-2:], (frequency, drive)]
            done += 1
        yield station.drive(tone.glide(station.samples(GLIDE), tone.frequency, 0.0))
    if unsettled:
        station.warn(
            f"{len(unsettled)} of {total} steps found no steady state at the level within "
            f"{test.settle.longest:g} s: {', '.join(unsettled[:_LISTED])}"
            + (", ..." if len(unsettled) > _LISTED else "")
        )
    station.report(1.0, "done")


def _point(
    station: Station,
    tone: Tone,
    gauge: Gauge,
    control: AmplitudeControl | None,
    frequency: float,
    drive: float,
    level: float,
    direction: str,
    test: SteppedSine,
) -> Generator[Array, Array, bool]:
    """Settle and measure at one frequency; return whether it settled. The tone keeps the final drive."""
    facts = {"frequency": frequency, "level": level, "direction": direction}
    first = station.now
    settled = yield from settle(
        station, tone, gauge, control, frequency, drive, test.settle.tolerance, test.settle.longest
    )
    station.mark("settle", first, station.now, drive=tone.amplitude, settled=settled, **facts)
    first = station.now
    asked = round(test.measure.periods * station.rate / frequency)
    window = max(asked, fewest_samples(frequency, station.rate))
    read = yield from held(station, tone, gauge, window)
    force = level if station.force_is_drive else None
    if control is not None:
        force = float(abs(read[0]))
    station.mark("measure", first, station.now, drive=tone.amplitude, force=force, settled=settled, **facts)
    return settled


def settle(
    station: Station,
    tone: Tone,
    gauge: Gauge,
    control: AmplitudeControl | None,
    frequency: float,
    drive: float,
    tolerance: float,
    longest: float,
) -> Generator[Array, Array, bool]:
    """Glide to a frequency in Hz and wait for the steady state; return whether it was reached at the level.

    Without a control the drive amplitude stays; `tolerance` is the permitted relative change, `longest` the wait
    in s.
    """
    end = station.now + station.samples(longest)
    look = whole_periods(frequency, station.rate, _LOOK)
    judge = Settling(tolerance)
    if control is not None:
        control.restart()
    yield station.drive(tone.glide(max(station.samples(GLIDE), look), frequency, drive))
    while station.now + look <= end:
        phase = tone.phase
        samples = yield station.drive(tone.hold(look))
        judge.add(gauge.steady(samples, frequency, phase))
        change = None if control is None else _change(control, judge, tone.amplitude)
        if change is not None:
            hurried = abs(np.log(change / tone.amplitude)) < _SMALL
            glide = look if hurried else _unhurried(judge, look, station.samples(LONGEST_GLIDE))
            judge.restart()
            yield station.drive(tone.glide(glide, frequency, change))
        elif judge.settled:
            return control is None or control.holds(float(abs(judge.expected()[0])), float(judge.doubt()[0]))
    return False


def _change(control: AmplitudeControl, judge: Settling, drive: float) -> float | None:
    """Return a new drive amplitude; None if the present drive suffices, or the force is not yet known."""
    force, doubt = float(abs(judge.expected()[0])), float(judge.doubt()[0])
    if judge.looks < FEWEST_LOOKS + 1:
        too_much = judge.rising and abs(judge.latest[0]) > _TOO_MUCH * control.level
        return control.cut(drive, float(abs(judge.latest[0]))) if too_much else None
    # The predicted force is usable long before the transient has decayed, as soon as the prediction is constant.
    known = judge.settled or float(judge.wavering()[0]) < 0.3 * abs(force / control.level - 1.0)
    if not known or control.holds(force, doubt):
        return None
    change = control.next(drive, force)
    # At the limit of the amplifier, the point is measured as not settled.
    return None if change == drive else change


def extrapolated(reached: Sequence[tuple[float, float]], frequency: float) -> float:
    """Extrapolate the drive by the parabola through the logarithms of the last (frequency, drive).

    Return the last drive if the curvature is too large.

    >>> round(extrapolated([(10.0, 1.0), (11.0, 1.1), (12.0, 1.2)], 13.0), 3)
    1.298
    >>> extrapolated([(12.0, 1.0), (13.0, 2.0), (14.0, 40.0)], 15.0)
    40.0
    """
    frequencies, drives = np.array([point[0] for point in reached]), np.log([point[1] for point in reached])
    if len(reached) < 3 or len(set(frequencies)) < 3:
        return float(np.exp(drives[-1]))
    weights = [
        np.prod([(frequency - other) / (own - other) for other in frequencies if other != own])
        for own in frequencies
    ]
    change = float(np.dot(weights, drives) - drives[-1])
    return float(np.exp(drives[-1] + (change if abs(change) < _TRUSTED else 0.0)))


def _unhurried(judge: Settling, look: int, longest: int) -> int:
    """Return the samples of a glide of two beats, which hardly excites the mode that beats with the drive."""
    return max(look, min(longest, round(look * 4 * np.pi / float(judge.beat()[0]))))
