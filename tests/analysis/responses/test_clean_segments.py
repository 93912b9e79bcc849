"""Segments of a recording without overloads and lost samples, compared with a classification of each sample."""

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.core.responses.checks.clean_segments import Flaw, clean_segments, describe_flaws, find_flaws, remedy
from daq.core.recording.markers import Gap, Marker
from daq.core.signal_chain.channel import ChannelInfo

CHANNELS = ("a1", "a2", "force")
SPANS = st.tuples(st.integers(0, 30), st.integers(0, 8))


class StandIn(SimpleNamespace):
    """Stand-in for a recording, which identifies stored results."""

    __hash__ = object.__hash__


@st.composite
def recordings(draw):
    """Draw a recording with overloads and lost samples."""
    overloads = [
        Marker("overload", first, first + length, {"channel": draw(st.sampled_from(CHANNELS))})
        for first, length in draw(st.lists(SPANS, max_size=4))
    ]
    gaps = [
        Gap(first, first + length, draw(st.sampled_from([("a1",), ("a2", "force"), CHANNELS])), "lost")
        for first, length in draw(st.lists(SPANS, max_size=4))
    ]
    return StandIn(overloads=overloads, gaps=gaps, rate=10.0, markers=[], channels={})


@given(
    rec=recordings(),
    used_channels=st.sets(st.sampled_from(CHANNELS)),
    first=st.integers(0, 20),
    length=st.integers(1, 25),
)
def test_clean_segments_exclude_overloads_and_gaps(rec, used_channels, first, length):
    stop = first + length
    flawed_samples = set()
    for marker in rec.overloads:
        if marker.fields["channel"] in used_channels:
            flawed_samples |= set(range(marker.first_sample, marker.last_sample + 1))
    for gap in rec.gaps:
        if used_channels & set(gap.channels):
            flawed_samples |= set(range(gap.first_sample, gap.last_sample + 1))
    listed_flaws = find_flaws(rec, used_channels, first, stop)
    segments = clean_segments(listed_flaws, first, stop)
    clean_samples = [sample for begin, end in segments for sample in range(begin, end)]
    assert clean_samples == [sample for sample in range(first, stop) if sample not in flawed_samples]
    assert all(begin < end for begin, end in segments)
    # Flaws outside the segment are not listed.
    assert all(flaw.first < stop and flaw.stop > first and flaw.channel in used_channels for flaw in listed_flaws)
    assert [flaw.first for flaw in listed_flaws] == sorted(flaw.first for flaw in listed_flaws)
    assert {flaw.reason for flaw in listed_flaws} <= {"overloaded", "lost"}


def test_flaws_are_listed_by_kind():
    rec = SimpleNamespace(rate=10.0)
    listed_flaws = [Flaw(10 * k, 10 * k + 1, "a1", "overloaded") for k in range(3)] + [Flaw(70, 75, "a2", "lost")]
    assert describe_flaws(rec, listed_flaws) == "a1 overloaded (at 0 s, 1 s, 2 s), samples of a2 lost (at 7 s)"
    listed_flaws += [Flaw(80, 81, "a1", "overloaded"), Flaw(91, 92, "a1", "overloaded")]
    assert (
        describe_flaws(rec, listed_flaws)
        == "a1 overloaded (at 0 s, 1 s, 2 s and 2 other times), samples of a2 lost (at 7 s)"
    )


@pytest.mark.parametrize(
    ("sensitivity", "volts", "limit", "is_reached_first"),
    [
        # 5 V at 0.1 V per m/s² are 50 m/s²: a limit of the sensor of 49 is reached first, a limit of 51 is not.
        (0.1, 5.0, "49 m/s^2", True),
        (0.1, 5.0, "51 m/s^2", False),
        (0.1, None, "51 m/s^2", True),
    ],
)
def test_remedy_names_the_limit_that_is_reached_first(sensitivity, volts, limit, is_reached_first):
    info = ChannelInfo(
        "a1", "body 1", "acceleration", sensitivity, 1e3, range=volts, sensor={"accelerometer.saturation": limit}
    )
    rec = SimpleNamespace(channels={"a1": info})
    assert (limit in remedy(rec, [Flaw(3, 5, "a1", "overloaded")])) == is_reached_first
    lost_samples = Flaw(3, 5, "a1", "lost")
    assert remedy(rec, [lost_samples]) == "Check the recording with `daq info`"
