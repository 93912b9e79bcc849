"""Comparison of controlled motion with its profile, on constructed densities."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from analysis.core.signals.profile_check import Level, ProfileCheck, _early_overloads
from daq.core.recording.markers import Marker

FREQUENCY = np.arange(10.0, 20.0)
NONE = np.full(10, np.nan)


def check(control, unit):
    """A check with the profile 1 and the limit 2 of a channel."""
    limited = Level("unit", "body 1", unit, NONE, NONE, np.full(10, 2.0), 1.0, 3.0)
    controlled = Level("table", "table", control, NONE, NONE, np.ones(10), 1.0, 3.0)
    return ProfileCheck("test", "(m/s²)²/Hz", FREQUENCY, control, np.ones(10), (controlled,), (limited,), 3.0, 6.0)


def test_summary_states_limits_and_their_excess():
    control, unit = np.ones(10), np.full(10, 0.1)
    control[3:5], unit[3:5] = 0.1, [2.0, 2.52]
    text = check(control, unit).summary()
    assert "80.0 % of the frequencies within 3 dB" in text and "20.0 % below it because of limits" in text
    assert "unit up to 1.0 dB above its limit, at 14 Hz" in text


def test_low_control_without_limit_is_outside():
    control = np.ones(10)
    control[3] = 0.1
    result = check(control, np.full(10, 0.1))
    assert result.within == 0.9 and not result.is_reduced.any()


def test_notches_are_the_marked_strips():
    control, unit = np.full(10, 0.6), np.full(10, 2.0)
    control[[2, 3, 6]] = 0.1
    result = check(control, unit)
    assert result.notches() == [("unit", 12.0, 13.0), ("unit", 16.0, 16.0)]
    assert FREQUENCY[result.strips()[0][0]].tolist() == [12.0, 13.0, 16.0]


def test_excess_at_end_of_limit_is_named():
    unit, limit = np.ones(10), np.full(10, np.nan)
    limit[:6], unit[5] = 2.0, 20.0
    result = check(np.ones(10), unit)
    result = replace(result, limited=(replace(result.limited[0], limit=limit),))
    assert result.excesses() == ["unit up to 10.0 dB above its limit, at 15 Hz, where the limit ends"]


def test_overloads_of_identification_are_reported():
    overloads = [Marker("overload", first, first + 10, {"channel": name}) for first, name in
                 ((100, "table"), (8000, "unit"), (9000, "unit"), (30_000, "table"))]  # fmt: skip
    rec = SimpleNamespace(markers=[Marker("settle", 0, 5000), *overloads], rate=1000.0)
    [warning] = _early_overloads(rec, 20_000)
    assert "before the full level: unit (from 8.00 s)." in warning
    assert _early_overloads(rec, 6000) == []
