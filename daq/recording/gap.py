"""Samples that a recording lacks, and what is said of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from daq.recording.markers import Marker
from rig.errors import RecordingError


@dataclass(frozen=True)
class Gap:
    """Samples that a recording lacks; they read as NaN.

    Attributes
    ----------
    first_sample, last_sample : int
        The range, both included.
    channels : tuple of str
        Names of the channels that lack them; of true motion, its topics.
    reason : str
        `never acquired`, or what became of them.
    """

    first_sample: int
    last_sample: int
    channels: tuple[str, ...]
    reason: str


def gaps_of(markers: Iterable[Marker], channels: Sequence[str]) -> list[Gap]:
    """Gaps that markers report, in their order; all channels lack the samples where a marker names none."""
    gaps = []
    for marker in markers:
        if marker.kind in ("gap", "lost"):
            names = marker.fields.get("channels", channels)
            if not isinstance(names, list):
                raise RecordingError(f"a marker {marker.kind} names the channels {names!r}")
            reason = str(marker.fields.get("reason", "never acquired"))
            gaps.append(Gap(marker.first_sample, marker.end, tuple(map(str, names)), reason))
    return gaps


def unnoted(holes: Iterable[tuple[int, int]], noted: Sequence[Gap]) -> Iterator[tuple[int, int]]:
    """Yield the ranges [first, stop) of samples that are missing and are no part of gaps, both in rising order.

    >>> list(unnoted([(10, 20), (30, 40)], [Gap(12, 15, ("a1",), "lost"), Gap(30, 39, ("a1",), "lost")]))
    [(10, 20)]
    """
    place = 0
    for first, stop in holes:
        while first < stop and place < len(noted) and noted[place].first_sample <= first:
            end = noted[place].last_sample + 1
            first = max(first, end)
            place += end <= stop
        if first < stop:
            yield first, stop
