"""Markers of a recording as lines of a log, and as labeled segments of a timeline, for the viewer.

A marker labels a sample or a segment of samples: a dwell that settles or is measured, an impact, an overload, a gap.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from daq.core.recording.markers import impacts_of
from daq.core.recording.recording import Recording
from rig.core.results.text import format_decimals

# Units of the fields of markers.
FIELD_UNITS = {"frequency": "Hz", "force": "N", "peak": "N", "width": "s", "amplitude": "m"}
WARNING_KINDS = ("overload", "clipped", "gap", "lost", "abort", "double_hit", "level")
# Kinds of markers that do not form a phase of the test.
NOT_PHASE_KINDS = ("overload", "clipped", "alarm", "level")
PHASE_COLORS = {"settle": 0x55606EFF, "measure": 0x3D8B5FFF, "hit": 0x3D8B5FFF, "gap": 0xC4453BFF, "lost": 0xC4453BFF}
OTHER_PHASE_COLOR = 0x7A6AA8FF
OVERLOAD_COLOR = 0xC4453BFF
# An overload is drawn with at least this fraction of the segment's length, because it may last only one sample.
_MIN_DRAWN_PART = 0.004


class LogLine(NamedTuple):
    """A line of the log: the index of its sample, its level (INFO or WARN) and its text."""

    sample: int
    level: str
    text: str


class LabeledSegment(NamedTuple):
    """A segment of samples with its label and color (0xRRGGBBAA); `stop` is the first sample after it."""

    start: int
    stop: int
    label: str
    color: int


def log_lines(recording: Recording, start: int, stop: int) -> list[LogLine]:
    """Describe the markers within [start, stop), in order of time."""
    lines = []
    for marker in recording.markers:
        if not start <= marker.first_sample < stop:
            continue
        duration = ""
        if marker.last_sample is not None:
            duration = f"for {(marker.stop - marker.first_sample) / recording.rate:.3f} s"
        texts = f"{marker.kind} {duration}".strip(), format_fields(marker.fields)
        text = ", ".join(filter(None, texts))
        lines.append(LogLine(marker.first_sample, "WARN" if marker.kind in WARNING_KINDS else "INFO", text))
    return sorted(lines)


def phases(recording: Recording, start: int, stop: int) -> list[LabeledSegment]:
    """Return the phases of the test within [start, stop), in order of time and without overlap.

    A phase is a segment with a marker. It ends where the next phase begins. The phase of an impact includes its decay.
    Overloads, alarms and levels are not phases.
    """
    phases_so_far: list[LabeledSegment] = []
    markers = [
        marker for marker in recording.markers if marker.last_sample is not None and marker.kind not in NOT_PHASE_KINDS
    ]
    impacts = [marker.first_sample for marker in impacts_of(markers)]
    for marker in sorted(markers, key=lambda marker: marker.first_sample):
        end = marker.stop
        if marker.kind == "hit":
            next_impacts = [impact for impact in impacts if impact > marker.first_sample]
            end = min(next_impacts, default=recording.samples)
        if end <= start or marker.first_sample >= stop:
            continue
        frequency = marker.fields.get("frequency")
        label = f"{format_decimals(frequency, 2)} Hz" if isinstance(frequency, int | float) else marker.kind
        if marker.kind == "hit":
            label = f"impact {impacts.index(marker.first_sample) + 1}"
        first, last = max(start, marker.first_sample), min(stop, end)
        if phases_so_far and phases_so_far[-1].stop > first:
            phases_so_far[-1] = phases_so_far[-1]._replace(stop=first)
        phases_so_far.append(LabeledSegment(first, last, label, PHASE_COLORS.get(marker.kind, OTHER_PHASE_COLOR)))
    return [phase for phase in phases_so_far if phase.stop > phase.start]


def overloads(recording: Recording, start: int, stop: int) -> dict[str, list[LabeledSegment]]:
    """Return the drawn segments of [start, stop) in which each channel was overloaded, in order of time."""
    by_channel: dict[str, list[LabeledSegment]] = {}
    shortest = round(_MIN_DRAWN_PART * (stop - start))
    for marker in sorted(recording.overloads, key=lambda marker: marker.first_sample):
        first, last = max(start, marker.first_sample), min(stop, marker.stop)
        if first < last:
            drawn = by_channel.setdefault(str(marker.fields.get("channel", "")), [])
            if drawn and first < drawn[-1].stop:
                drawn[-1] = drawn[-1]._replace(stop=max(last, drawn[-1].stop))
            else:
                drawn.append(LabeledSegment(first, min(max(last, first + shortest), stop), " ", OVERLOAD_COLOR))
    return by_channel


def format_fields(fields: Mapping[str, Any]) -> str:
    """Format the fields of a marker with their units.

    >>> format_fields({"frequency": 13.0366, "force": 2.6, "step": 4})
    'frequency 13.0366 Hz, force 2.6 N, step 4'
    """
    texts = []
    for key, value in fields.items():
        number = f"{value:.6g}" if isinstance(value, float) else str(value)
        texts.append(f"{key.replace('_', ' ')} {number} {FIELD_UNITS.get(key, '')}".rstrip())
    return ", ".join(texts)
