"""Valid and damaged segments against a count sample by sample."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.responses.clean_segments import Flaw, clean_segments, describe_flaws, flaws, remedy
from daq.recording.markers import Gap, Marker
from daq.signal_chain.channel import ChannelInfo

CHANNELS = ("a1", "a2", "force")
SPANS = st.tuples(st.integers(0, 30), st.integers(0, 8))


@st.composite
def recordings(draw):
    """Overloads and lost samples stated in a recording, including first and last sample."""
    overloads = [
        Marker("overload", first, first + length, {"channel": draw(st.sampled_from(CHANNELS))})
        for first, length in draw(st.lists(SPANS, max_size=4))
    ]
    gaps = [
        Gap(first, first + length, draw(st.sampled_from([("a1",), ("a2", "force"), CHANNELS])), "lost")
        for first, length in draw(st.lists(SPANS, max_size=4))
    ]
    return SimpleNamespace(overloads=overloads, gaps=gaps, rate=10.0)


@given(
    rec=recordings(),
    wanted=st.sets(st.sampled_from(CHANNELS)),
    first=st.integers(0, 20),
    size=st.integers(1, 25),
)
def test_clean_segments_exclude_overloads_and_gaps(rec, wanted, first, size):
    stop = first + size
    spoilt = set()
    for marker in rec.overloads:
        if marker.fields["channel"] in wanted:
            spoilt |= set(range(marker.first_sample, marker.last_sample + 1))
    for gap in rec.gaps:
        if wanted & set(gap.channels):
            spoilt |= set(range(gap.first_sample, gap.last_sample + 1))
    found = flaws(rec, wanted, first, stop)
    segments = clean_segments(found, first, stop)
    covered = [sample for begin, end in segments for sample in range(begin, end)]
    assert covered == [sample for sample in range(first, stop) if sample not in spoilt]
    assert all(begin < end for begin, end in segments)
    # Damage outside the segment does not count.
    assert all(flaw.first < stop and flaw.stop > first and flaw.channel in wanted for flaw in found)
    assert [flaw.first for flaw in found] == sorted(flaw.first for flaw in found)
    assert {flaw.reason for flaw in found} <= {"overloaded", "lost"}


def test_flaws_are_listed_by_kind():
    rec = SimpleNamespace(rate=10.0)
    found = [Flaw(10 * k, 10 * k + 1, "a1", "overloaded") for k in range(3)] + [Flaw(70, 75, "a2", "lost")]
    assert describe_flaws(rec, found) == "a1 overloaded (at 0 s, 1 s, 2 s), a2 lost (at 7 s)"
    found += [Flaw(80, 81, "a1", "overloaded"), Flaw(91, 92, "a1", "overloaded")]
    assert describe_flaws(rec, found) == "a1 overloaded (at 0 s, 1 s, 2 s and 2 times more), a2 lost (at 7 s)"


@pytest.mark.parametrize(
    ("sensitivity", "volts", "limit", "named"),
    [
        # 5 V at 0.1 V per m/s² are 50 m/s²: a limit of the sensor of 49 is reached first, a limit of 51 is not.
        (0.1, 5.0, "49 m/s^2", True),
        (0.1, 5.0, "51 m/s^2", False),
        (0.1, None, "51 m/s^2", True),
    ],
)
def test_remedy_names_the_first_limit(sensitivity, volts, limit, named):
    info = ChannelInfo(
        "a1",
        "body 1",
        "acceleration",
        sensitivity,
        1e3,
        range=volts,
        sensor={"accelerometer.saturation": limit},
    )
    rec = SimpleNamespace(channels={"a1": info})
    assert (limit in remedy(rec, [Flaw(3, 5, "a1", "overloaded")])) == named
    assert limit not in remedy(rec, [Flaw(3, 5, "a1", "lost")])
