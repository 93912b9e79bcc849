"""A steady sine tone."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.excitation.amplitude_control import AmplitudeControl
from daq.excitation.lock_in import fewest_samples, whole_periods
from daq.excitation.settling import Settling
from daq.excitation.station import Excitation, Station
from daq.excitation.stepped_sine import GLIDE, settle
from daq.excitation.tone import Tone
from daq.excitation.tone_measurement import Gauge, held

if TYPE_CHECKING:
    from rig.scene.excitation import Sine

_TOLERANCE, _LONGEST = 1e-3, 60.0
_LOOK = 0.1


def excite(station: Station, test: Sine) -> Excitation:
    """Run a tone of constant frequency, in open loop with full amplitude from the first sample.

    With a controlled spring force, the duration of the test begins when the force is steady at its level.
    """
    if test.force is not None and not station.force_is_drive:
        return _controlled(station, test, test.force)
    return _open_loop(station, test, test.force or test.drive or 0.0)


def _open_loop(station: Station, test: Sine, level: float) -> Excitation:
    tone = Tone(station.rate, test.frequency)
    tone.amplitude = level
    gauge = Gauge(station, force=False)
    judge = Settling(_TOLERANCE)
    look = whole_periods(test.frequency, station.rate, _LOOK)
    total, steady = station.samples(test.duration), None
    while station.now < total:
        station.report(station.now / total, f"{test.frequency:.2f} Hz, level {level:g}")
        size, phase = min(look, total - station.now), tone.phase
        samples = yield station.drive(tone.hold(size))
        if size == look and steady is None:
            judge.add(gauge.steady(samples, test.frequency, phase))
            steady = station.now if judge.settled else None
    settled = steady is not None and total - steady >= look
    station.mark(
        "measure",
        steady if settled else total // 2,
        total,
        frequency=test.frequency,
        level=level,
        drive=level,
        settled=settled,
    )


def _controlled(station: Station, test: Sine, force: float) -> Excitation:
    tone = Tone(station.rate, test.frequency)
    gauge = Gauge(station, force=True)
    control = AmplitudeControl(force, station.drive_limit)
    facts = {"frequency": test.frequency, "level": force}
    station.report(0.0, f"{test.frequency:.2f} Hz, settling at {force:g} N")
    settled = yield from settle(
        station, tone, gauge, control, test.frequency, force * station.cautious_drive, _TOLERANCE, _LONGEST
    )
    station.mark("settle", 0, station.now, drive=tone.amplitude, settled=settled, **facts)
    if not settled:
        station.warn(f"{test.frequency:.3f} Hz, {force:g} N: no steady state within {_LONGEST:g} s")
    station.report(0.5, f"{test.frequency:.2f} Hz, measuring")
    first = station.now
    window = max(station.samples(test.duration), fewest_samples(test.frequency, station.rate))
    read = yield from held(station, tone, gauge, window)
    measured = float(abs(read[0]))
    station.mark(
        "measure", first, station.now, drive=tone.amplitude, force=measured, settled=settled, **facts
    )
    yield station.drive(tone.glide(station.samples(GLIDE), test.frequency, 0.0))
