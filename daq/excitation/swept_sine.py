"""Swept sine: a tone whose frequency moves steadily, its force held from the channels as it goes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.control import AmplitudeControl
from daq.excitation.gauge import Gauge
from daq.excitation.station import Excitation, Station
from daq.excitation.stepped_sine import GLIDE, settle
from daq.excitation.tone import Tone

if TYPE_CHECKING:
    from rig.excitation_settings import SweptSine

Array = NDArray[np.float64]

# The control looks at so many periods at a time. From look to look it raises the drive a little at most, as a
# gain that falls may soon rise again, and lowers it quickly.
_LOOK, _LOOK_PERIODS = 0.05, 3
_RISE, _FALL = 1.25, 0.4
# The sweep begins from a steady state, to this tolerance, at its first frequency.
_TOLERANCE, _LONGEST = 0.01, 60.0


def excite(station: Station, test: SweptSine) -> Excitation:
    """Run a swept sine."""
    controlled = test.force is not None and not station.force_is_drive
    return _run(station, test, Gauge(station, force=controlled), controlled)


def _run(station: Station, test: SweptSine, gauge: Gauge, controlled: bool) -> Excitation:
    level = test.force or test.drive or 0.0
    tone = Tone(station.rate, test.from_)
    control = AmplitudeControl(level, station.drive_limit) if controlled else None
    drive = level * station.cautious_drive if controlled else level
    facts = {"from": test.from_, "to": test.to, "spacing": test.spacing, "level": level}
    station.report(0.0, f"settling at {test.from_:.2f} Hz")
    first = station.now
    settled = yield from settle(station, tone, gauge, control, test.from_, drive, _TOLERANCE, _LONGEST)
    station.mark("settle", first, station.now, frequency=test.from_, level=level, settled=settled)

    first, total, done = station.now, station.samples(test.duration), 0
    start = tone.phase
    control = AmplitudeControl(level, station.drive_limit) if controlled else None
    before = tone.amplitude
    while done < total:
        here = sweep_frequency(test, done / total)
        look = min(total - done, max(station.samples(_LOOK), station.samples(_LOOK_PERIODS / here)))
        phase = start + 2 * np.pi * sweep_turns(test, np.arange(done, done + look) / total)
        rise = (1 - np.cos(np.pi * np.arange(look) / look)) / 2
        samples = yield station.drive((before + (tone.amplitude - before) * rise) * np.sin(phase))
        middle = sweep_frequency(test, (done + look / 2) / total)
        done += look
        station.report(done / total, f"{middle:.2f} Hz")
        used, before = (before + tone.amplitude) / 2, tone.amplitude
        if control is not None:
            force = float(abs(gauge.sweeping(samples, middle, phase)[0]))
            # Along a sweep each look has another gain, so the slope of a secant would mean nothing.
            control.restart()
            tone.amplitude = min(before * _RISE, max(before * _FALL, control.next(used, force)))
    tone.amplitude, tone.frequency = before, test.to
    tone.phase = float(np.fmod(start + 2 * np.pi * sweep_turns(test, np.ones(1))[0], 2 * np.pi))
    station.mark("measure", first, station.now, duration=test.duration, settled=settled, **facts)
    yield station.drive(tone.glide(station.samples(GLIDE), test.to, 0.0))


def sweep_frequency(test: SweptSine, part: float) -> float:
    """Frequency in Hz when a part, 0 to 1, of the sweep is done."""
    if test.spacing == "linear":
        return test.from_ + (test.to - test.from_) * part
    return float(test.from_ * (test.to / test.from_) ** part)


def sweep_turns(test: SweptSine, part: Array) -> Array:
    """Give the turns of the tone since the sweep began, when parts, 0 to 1, of it are done."""
    if test.spacing == "linear":
        return test.duration * (test.from_ * part + (test.to - test.from_) * part**2 / 2)
    stretch = np.log(test.to / test.from_)
    return test.duration * test.from_ * np.expm1(stretch * part) / stretch
