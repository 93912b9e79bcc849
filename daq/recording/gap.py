"""Samples that a recording lacks, and what is said of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
    """Gaps that markers tell of, in their order; all channels lack the samples where a marker names none."""
    gaps = []
    for marker in markers:
        if marker.kind in ("gap", "lost"):
            names = marker.fields.get("channels", channels)
            if not isinstance(names, list):
                raise RecordingError(f"a marker {marker.kind} names the channels {names!r}")
            reason = str(marker.fields.get("reason", "never acquired"))
            gaps.append(Gap(marker.first_sample, marker.end, tuple(map(str, names)), reason))
    return gaps
