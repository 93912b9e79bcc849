"""Samples that a recording lacks, with the reason."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from daq.recording.markers import Marker
from rig.errors import RecordingError


@dataclass(frozen=True)
class Gap:
    """Samples that a recording lacks; they read as NaN."""

    first_sample: int  # the range, both included
    last_sample: int  # the range, both included
    channels: tuple[str, ...]  # names of the channels that lack them; of true motion, its topics
    reason: str  # `never acquired`, or how they were lost


def gaps_of(markers: Iterable[Marker], channels: Sequence[str]) -> list[Gap]:
    """Gaps that markers report, in their order; all channels lack the samples where a marker names none."""
    gaps = []
    for marker in markers:
        if marker.kind in ("gap", "lost"):
            names = marker.fields.get("channels", channels)
            if not isinstance(names, list):
                raise RecordingError(
                    f"a marker {marker.kind} has the channels {names!r}; expected a list of names"
                )
            reason = str(marker.fields.get("reason", "never acquired"))
            gaps.append(Gap(marker.first_sample, marker.end, tuple(map(str, names)), reason))
    return gaps


def unmarked(holes: Iterable[tuple[int, int]], gaps: Sequence[Gap]) -> Iterator[tuple[int, int]]:
    """Yield the missing ranges [first, stop) that no gap explains; both in rising order.

    >>> list(unmarked([(10, 20), (30, 40)], [Gap(12, 15, ("a1",), "lost"), Gap(30, 39, ("a1",), "lost")]))
    [(10, 20)]
    """
    place = 0
    for first, stop in holes:
        while first < stop and place < len(gaps) and gaps[place].first_sample <= first:
            end = gaps[place].last_sample + 1
            first = max(first, end)
            place += end <= stop
        if first < stop:
            yield first, stop
