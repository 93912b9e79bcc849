"""Overload and alarm markers, aborts, and the end of a test without valid inputs: compared with a check of all samples.

In the scene, channels t and a have abort limits of 5 and 4 m/s^2. Channels t and b have alarm limits of 3 and 2 m/s^2.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rig
from daq.core.measurement.limits import ControlLoss, FlaggedIntervals, Limits
from daq.core.signal_chain.channel import ChannelInfo

RATE = 8.0  # Hz
INFOS = [
    ChannelInfo(name, at, "acceleration", 1.0, RATE) for name, at in (("t", "table"), ("a", "body 1"), ("b", "body 2"))
]
SCENE = """
structure: {{masses: [1 kg, 1 kg], springs: [4 kN/m, 4 kN/m]}}
shaker: {{kind: {shaker}}}
test: {{kind: sine, frequency: 10 Hz, {level}}}
channels:
  - {{name: t, at: table, alarm: 3, abort: 5}}
  - {{name: a, at: body 1, abort: 4}}
  - {{name: b, at: body 2, alarm: 2}}
"""


def make_scene(shaker="table, body: 1, spring: 6 kN/m", level="force: 1 N"):
    """Return the scene with this shaker and this level of the test."""
    return rig.loads(SCENE.format(shaker=shaker, level=level), where="a test")


def blocks_between(boundaries, values):
    """Yield values (channels, samples) in blocks between the boundaries, each with the index of its first sample."""
    first = 0
    for block in np.split(values, boundaries, axis=1):
        yield first, block
        first += block.shape[1]


def flagged_intervals_of(flags):
    """Return the intervals (first, stop) of flagged samples; gaps shorter than half a second do not divide them."""
    intervals = []
    for sample in np.flatnonzero(flags).tolist():
        if intervals and sample - intervals[-1][1] < 0.5 * RATE:
            intervals[-1] = (intervals[-1][0], sample + 1)
        else:
            intervals.append((sample, sample + 1))
    return intervals


@settings(max_examples=50)
@given(
    flags=st.lists(st.lists(st.booleans(), min_size=40, max_size=40), min_size=3, max_size=3),
    flag_spacing=st.integers(1, 7),
    boundaries=st.lists(st.integers(0, 40), max_size=5).map(sorted),
)
def test_interval_of_overloads_is_marked_once(flags, flag_spacing, boundaries):
    flags = np.array(flags) & (np.arange(40) % flag_spacing == 0)
    marked = {info.name: [] for info in INFOS}
    intervals = FlaggedIntervals("overload", INFOS, lambda kind, *span, channel: marked[channel].append(span))
    for first, block in blocks_between(boundaries, flags):
        intervals.add(first, block)
    intervals.close()
    assert marked == {info.name: flagged_intervals_of(row) for info, row in zip(INFOS, flags, strict=True)}


def test_interval_is_marked_half_a_second_later():
    marked = []
    intervals = FlaggedIntervals("alarm", INFOS[:1], lambda *mark, channel: marked.append((*mark, channel)))
    intervals.add(100, np.array([[False, True, True]]))
    intervals.add(103, np.zeros((1, 3), dtype=bool))
    assert not marked
    intervals.add(106, np.zeros((1, 1), dtype=bool))
    assert marked == [("alarm", 101, 103, "t")]
    intervals.close()
    assert len(marked) == 1


def test_gap_at_slow_rate_divides_intervals():
    slow_channel, marked = ChannelInfo("s", "body 1", "acceleration", 1.0, 0.5), []
    intervals = FlaggedIntervals("overload", [slow_channel], lambda kind, *span, channel: marked.append(span))
    intervals.add(0, np.array([[True, True, False, True]]))
    intervals.add(4, np.array([[True, False]]))
    assert marked == [(0, 2), (3, 5)]


@settings(max_examples=50)
@given(st.lists(st.lists(st.integers(-6, 6).map(float), min_size=12, max_size=12), min_size=3, max_size=3))
def test_first_reading_above_limit_aborts(readings):
    readings, marked = np.array(readings), []
    limits = Limits(make_scene(), INFOS, lambda kind, *span, channel: marked.append((kind, channel, *span)))
    exceedance = limits.watch(1000, readings)
    limits.close()
    abort_limits = (5.0, 4.0)  # of channels t and a
    exceeding = [(k, row) for k in range(12) for row in (0, 1) if abs(readings[row, k]) > abort_limits[row]]
    if exceeding:
        sample, row = exceeding[0]
        assert (exceedance.sample, exceedance.channel, exceedance.value) == (
            1000 + sample,
            INFOS[row],
            readings[row, sample],
        )
        assert exceedance.limit == abort_limits[row]
        # Sample 1000 is at 125 s, at 8 samples per second.
        assert f"channel {'ta'[row]}: {readings[row, sample]:.4g} m/s^2 at {125 + sample / 8:.3f} s" in str(exceedance)
    else:
        assert exceedance is None
    expected = [
        ("alarm", INFOS[row].name, 1000 + first, 1000 + stop)
        for row, limit in ((0, 3.0), (2, 2.0))
        for first, stop in flagged_intervals_of(abs(readings[row]) > limit)
    ]
    assert sorted(marked) == sorted(expected)


def test_channels_without_limits_are_not_monitored():
    limits = Limits(make_scene().replace(channels=None), INFOS, lambda *_, **__: pytest.fail("a mark"))
    assert not limits.has_limits
    assert limits.watch(0, np.full((3, 4), 1e9)) is None


@pytest.mark.parametrize(
    ("changes", "rows"),  # rows of the channels that measure the controlled force
    [
        ({}, {0, 1}),
        ({"level": "drive: 1 V", "shaker": "electrodynamic, body: 2, spring: 6 kN/m"}, set()),
        ({"shaker": "electrodynamic, body: 2, spring: 6 kN/m"}, {0, 2}),
    ],
)
def test_long_overload_ends_controlled_test(changes, rows, monkeypatch):
    scene, calls = make_scene(**changes), []
    monkeypatch.setattr("daq.core.measurement.limits.bias_overload", lambda *arguments: calls.append(arguments))
    for row, info in enumerate(INFOS):
        clipped, clean = np.zeros((2, 3, 4), dtype=bool)
        clipped[row, 2] = True
        loss = ControlLoss(scene, INFOS)
        # The limit is more than one second; two blocks of 4 samples are exactly one second.
        messages = [loss.watch(first, clipped) for first in (16, 20, 24)]
        assert messages[:2] == [None, None]
        assert (messages[2] is not None) == (row in rows)
        if row in rows:
            # The overload begins at sample 16, and is reported at the end of the third block, sample 28.
            assert f"input {info.name}: overloaded since 2.00 s" in messages[2]
            assert calls.pop() == (scene, row, 3.5)
            # If several channels are clipped, the first is reported.
            clipped[sorted(rows)] = True
            loss.watch(40, clean)
            messages = [loss.watch(first, clipped) for first in (44, 52, 60)]
            assert INFOS[min(rows)].name in messages[2] and calls.pop()[1] == min(rows)
            assert loss.watch(28, clean) is None
            assert [loss.watch(first, clipped) for first in (32, 36)] == [None, None]


@pytest.mark.parametrize(("limits", "expected"), [("", False), (", alarm: 3", True), (", abort: 3", True)])
def test_alarm_and_abort_limits_are_independent(limits, expected):
    text = f"structure: {{masses: [1 kg], springs: [4 kN/m]}}\nchannels: [{{name: a, at: body 1{limits}}}]\n"
    marks = []
    monitor = Limits(rig.loads(text), INFOS[1:2], lambda *mark, **fields: marks.append(mark))
    assert monitor.has_limits == expected
    exceedance = monitor.watch(0, np.array([[1.0, 4.0, 1.0]]))
    monitor.close()
    assert (exceedance is not None) == ("abort" in limits)
    assert marks == ([("alarm", 1, 2)] if "alarm" in limits else [])
