"""Markers of a recording for a viewer: a log of lines, and a lane of phases."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from daq.recording.recording import Recording

UNITS = {"frequency": "Hz", "force": "N", "peak": "N", "width": "s", "amplitude": "m"}
WARNINGS = ("overload", "gap", "lost", "abort", "double_hit", "level")
NOT_PHASES = ("overload", "alarm", "level")
COLORS = {"settle": 0x55606EFF, "measure": 0x3D8B5FFF, "hit": 0x3D8B5FFF, "gap": 0xC4453BFF, "lost": 0xC4453BFF}
OTHER_COLOR = 0x7A6AA8FF
OVERLOAD_COLOR = 0xC4453BFF


class Line(NamedTuple):
    """One line of the log: the sample it belongs to, its level and its text."""

    sample: int
    level: str
    text: str


class MarkedSlice(NamedTuple):
    """A segment of samples with its label and color (0xRRGGBBAA); `stop` is the first sample after it."""

    start: int
    stop: int
    label: str
    color: int


def log_lines(recording: Recording, start: int, stop: int) -> list[Line]:
    """Describe the markers within [start, stop), in order of time."""
    lines = []
    for mark in recording.markers:
        if not start <= mark.first_sample < stop:
            continue
        duration = ""
        if mark.last_sample is not None:
            duration = f"for {(mark.stop - mark.first_sample) / recording.rate:.3f} s"
        text = ", ".join(part for part in (f"{mark.kind} {duration}".strip(), format_fields(mark.fields)) if part)
        lines.append(Line(mark.first_sample, "WARN" if mark.kind in WARNINGS else "INFO", text))
    return sorted(lines)


def phases(recording: Recording, start: int, stop: int) -> list[MarkedSlice]:
    """Return the markers of segments, cut to [start, stop), in order of time and without overlap.

    Of two overlapping segments the later is shown from its start on. A hit is shown with its decay, to the next hit.
    Overloads, alarms and levels are not phases of the test.
    """
    slices: list[MarkedSlice] = []
    segments = [mark for mark in recording.markers if mark.last_sample is not None and mark.kind not in NOT_PHASES]
    hits = sorted(mark.first_sample for mark in segments if mark.kind == "hit")
    for mark in sorted(segments, key=lambda mark: mark.first_sample):
        end = mark.stop
        if mark.kind == "hit":
            end = min((hit for hit in hits if hit > mark.first_sample), default=recording.samples)
        if end <= start or mark.first_sample >= stop:
            continue
        frequency = mark.fields.get("frequency")
        label = f"{frequency:.2f} Hz" if isinstance(frequency, int | float) else mark.kind
        if mark.kind == "hit":
            label = f"hit {hits.index(mark.first_sample) + 1}"
        first, last = max(start, mark.first_sample), min(stop, end)
        if slices and slices[-1].stop > first:
            slices[-1] = slices[-1]._replace(stop=first)
        slices.append(MarkedSlice(first, last, label, COLORS.get(mark.kind, OTHER_COLOR)))
    return [phase for phase in slices if phase.stop > phase.start]


def overloads(recording: Recording, start: int, stop: int) -> dict[str, list[MarkedSlice]]:
    """Return the segments of [start, stop) in which each channel was overloaded, in order of time."""
    by_channel: dict[str, list[MarkedSlice]] = {}
    for mark in sorted(recording.overloads, key=lambda mark: mark.first_sample):
        first, last = max(start, mark.first_sample), min(stop, mark.stop)
        if first < last:
            name = str(mark.fields.get("channel", ""))
            by_channel.setdefault(name, []).append(MarkedSlice(first, last, f"{name} overloaded", OVERLOAD_COLOR))
    return by_channel


def format_fields(fields: Mapping[str, Any]) -> str:
    """Format the fields of a marker with their units.

    >>> format_fields({"frequency": 13.0366, "force": 2.6, "step": 4})
    'frequency 13.0366 Hz, force 2.6 N, step 4'
    """
    parts = []
    for key, value in fields.items():
        number = f"{value:.6g}" if isinstance(value, float) else str(value)
        parts.append(f"{key.replace('_', ' ')} {number} {UNITS.get(key, '')}".rstrip())
    return ", ".join(parts)
