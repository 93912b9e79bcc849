"""Markers (events of a test with their samples) and contact events, as JSON on topics of a recording.

Gaps (missing samples) are determined from the markers.
"""

import json
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from daq.core.mcap_file.protobuf import Schema
from daq.core.recording.layout import EVENTS, MARKERS, WRITER_REMEDY
from daq.core.signal_chain.field_checks import (
    BOOLEAN,
    COUNT,
    MAX_SAMPLES,
    NAME,
    NAMES,
    NUMBER,
    POSITIVE,
    TEXT,
    Check,
    check,
    is_count,
    is_number,
)
from rig.core.base.errors import RecordingError

_FIELD_CHECKS = {
    **dict.fromkeys(("frequency", "from", "to", "duration"), POSITIVE),
    **dict.fromkeys(("period", "periods", "block", "number", "realisation"), COUNT),
    "level": NUMBER,
    "settled": BOOLEAN,
    **dict.fromkeys(("spacing", "direction", "reason"), TEXT),
    "channel": NAME,
    "channels": NAMES,
    "lines": Check(
        lambda value: (
            isinstance(value, list) and len(value) == 2 and all(map(is_count, value)) and value[0] <= value[1]
        ),
        "the first and the last line",
    ),
}

# Kinds of contact events: a damper leaves its floor or ceiling (separation), or hits floor or ceiling. Contacts of
# finite duration begin with touch and end with release. Sliding with friction begins with slip and ends with stop.
FRICTION_CHANGES = ("slip", "stop")
CONTACT_CHANGES = ("separation", "floor", "ceiling", "touch", "release", *FRICTION_CHANGES)
_EVENT_CHECKS = {
    "time": Check(lambda value: is_number(value) and abs(value) < 1e12, "a time in seconds"),
    "damper": Check(lambda value: is_count(value) and value < 2**31, "the number of a damper, from 1"),
    "kind": Check(lambda value: value in CONTACT_CHANGES, f"one of {', '.join(CONTACT_CHANGES)}"),
    "speed": NUMBER,
    "joint": Check(lambda value: is_count(value) and value < 2**31, "the number of a joint, from 1"),
}

_MARKER_JSON_SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": "shotrig.Marker",
    "description": "Something that happened during the test, at a sample or over a range of samples.",
    "type": "object",
    "required": ["kind", "first_sample", "last_sample"],
    "properties": {
        "kind": {
            "type": "string",
            "description": "start, pretest, settle, measure, step, hit, trigger, overload, level, gap, lost, ...",
        },
        "first_sample": {"type": "integer", "minimum": 0},
        "last_sample": {
            "type": ["integer", "null"],
            "description": "last sample of the range, inclusive; null: an instant",
        },
    },
    "additionalProperties": {"description": "further fields of the kind of marker, in SI units"},
}


def event_schema(has_friction: bool, has_joints: bool = False) -> Schema:
    """Return the schema of contact events; events of friction and joints are listed only if the scene can have them."""
    kinds = [kind for kind in CONTACT_CHANGES if has_friction or kind not in FRICTION_CHANGES]
    content: dict[str, Any] = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "shotrig.Event",
        "description": "A contact event of a damper, at its exact time.",
        "type": "object",
        "required": ["time", "damper", "kind", "speed"],
        "properties": {
            "time": {"type": "number", "description": "seconds after sample 0"},
            "damper": {"type": "integer", "description": "position in the scene's list of dampers, from 1"},
            "kind": {"enum": kinds},
            "speed": {"type": "number", "description": "closing speed before an impact, m/s"},
        },
    }
    if has_joints:
        content["description"] = "A contact event of a damper or joint, at its exact time."
        content["required"].remove("damper")
        content["properties"]["joint"] = {
            "type": "integer",
            "description": "instead of damper: position in the scene's list of joints, from 1",
        }
    return Schema("shotrig.Event", "jsonschema", json.dumps(content).encode(), "json")


MARKER_SCHEMA = Schema("shotrig.Marker", "jsonschema", json.dumps(_MARKER_JSON_SCHEMA).encode(), "json")
EVENT_TYPE = np.dtype([("time", "f8"), ("damper", "i4"), ("kind", "U10"), ("speed", "f8")])
EVENT_TYPE_WITH_JOINT = np.dtype([*EVENT_TYPE.descr, ("joint", "i4")])


@dataclass(frozen=True)
class Marker:
    """An event of a test."""

    kind: str  # `settle`, `measure`, `hit`, `overload`, `gap`, `lost`, ...
    first_sample: int  # index of the first sample
    last_sample: int | None = None  # index of the last sample, inclusive; None for an instant
    fields: Mapping[str, Any] = field(default_factory=dict)  # further fields of this kind of marker, in SI units

    @property
    def end(self) -> int:
        """Index of the last sample."""
        return self.first_sample if self.last_sample is None else self.last_sample

    @property
    def stop(self) -> int:
        """Number of the sample after the last sample, for slices.

        >>> marker = Marker("measure", 100, 199)
        >>> marker.end, marker.stop
        (199, 200)
        """
        return self.end + 1

    @property
    def lowest_frequency(self) -> float:
        """Lowest frequency of the tone or the band in this interval [Hz]; 0 without one."""
        return min((float(self.fields[key]) for key in ("frequency", "from", "to") if key in self.fields), default=0.0)

    @property
    def repeated_samples(self) -> int:
        """Number of samples of a period, or of a block with a burst; 0 if nothing is repeated."""
        return max((int(self.fields[key]) for key in ("block", "period") if key in self.fields), default=0)

    def to_json(self) -> bytes:
        """Encode the marker as JSON.

        >>> Marker("hit", 512, fields={"peak": 50.0}).to_json()
        b'{"kind":"hit","first_sample":512,"last_sample":null,"peak":50.0}'
        """
        content = {"kind": self.kind, "first_sample": self.first_sample, "last_sample": self.last_sample}
        return _json({**content, **self.fields})

    @classmethod
    def from_json(cls, data: memoryview) -> Self:
        """Decode a marker; raise `RecordingError` if the message is malformed."""
        content = _object(data, MARKERS)
        kind, first = content.pop("kind", None), content.pop("first_sample", None)
        last = content.pop("last_sample", None)
        end = first if last is None else last
        if not isinstance(kind, str):
            raise RecordingError(f"{MARKERS}: a marker has the kind {kind!r:.80}; expected text. {WRITER_REMEDY}")
        if not (type(first) is int and type(end) is int and 0 <= first <= end <= MAX_SAMPLES):
            raise RecordingError(
                f"{MARKERS}: a marker of kind {kind!r:.80} has samples {first!r:.40} to {last!r:.40}; expected whole "
                f"numbers from 0, in ascending order. {WRITER_REMEDY}"
            )
        check(content, _FIELD_CHECKS)
        return cls(kind, first, last, _Fields(kind, content))


class _Fields(dict[str, Any]):
    """Fields of a marker from a file; access to a missing field raises `RecordingError`."""

    def __init__(self, kind: str, content: Mapping[str, Any]) -> None:
        super().__init__(content)
        self._kind = kind

    def __missing__(self, key: str) -> Any:
        raise RecordingError(f"{MARKERS}: a marker of kind {self._kind!r} lacks the field {key}. {WRITER_REMEDY}")


#: Reason of a gap between the files that `daq import` joins: another measurement begins after it.
BETWEEN_FILES = "between joined files"


@dataclass(frozen=True)
class Gap:
    """Missing samples of a recording, which read as NaN."""

    first_sample: int  # first missing sample
    last_sample: int  # last missing sample
    channels: tuple[str, ...]  # names of the channels without these samples; for true motion, names of the topics
    reason: str  # `never acquired`, or how the samples were lost


def impacts_of(markers: Iterable[Marker]) -> list[Marker]:
    """Return the markers of impacts, in order of time."""
    return sorted((marker for marker in markers if marker.kind == "hit"), key=lambda marker: marker.first_sample)


def faulty_impacts(markers: Sequence[Marker], channels: Collection[str] | None = None) -> dict[int, str]:
    """Return the faults of impacts by the number of the impact: a second pulse followed, or channels were overloaded.

    `channels`: channels whose overloads count; by default all channels.

    >>> impacts = [Marker("hit", 100, 120), Marker("hit", 900, 920, {"double": True})]
    >>> faulty_impacts([*impacts, Marker("overload", 105, 130, {"channel": "hammer"})])
    {1: 'clipped (hammer)', 2: 'double'}
    """
    impacts = impacts_of(markers)
    starts = [impact.first_sample for impact in impacts]
    faults: dict[int, dict[str, None]] = {
        number: {"double": None} for number, impact in enumerate(impacts, 1) if impact.fields.get("double")
    }
    for marker in markers:
        if marker.kind != "overload" or (channels is not None and marker.fields.get("channel") not in channels):
            continue
        # An overload is assigned to the impact in it or before it, because the response follows the impact.
        first = max(bisect_right(starts, marker.first_sample), 1)
        for number in range(first, bisect_left(starts, marker.stop) + 1):
            faults.setdefault(number, {})[f"clipped ({marker.fields.get('channel', '')})"] = None
    return {number: " and ".join(faults[number]) for number in sorted(faults)}


def faults_of_impacts(markers: Sequence[Marker], channels: Collection[str] | None = None) -> str:
    """List the result of `faulty_impacts` as text, equal faults together; an empty string without faults.

    >>> faults_of_impacts([Marker("hit", 100 * n, 100 * n + 9, {"double": n > 1}) for n in range(4)])
    'impacts 3, 4 double'
    """
    faults: dict[str, list[str]] = {}
    for number, text in faulty_impacts(markers, channels).items():
        faults.setdefault(text, []).append(str(number))
    return "; ".join(
        f"impact{'s' * (len(impacts) > 1)} {', '.join(impacts)} {text}" for text, impacts in faults.items()
    )


def describe_faulty_impacts(markers: Sequence[Marker], channels: Collection[str] | None = None) -> str:
    """Describe the result of `faulty_impacts` in one sentence; an empty string without faults."""
    faults = faults_of_impacts(markers, channels)
    return f"Faulty impacts: {faults}." if faults else ""


def gaps_of(markers: Iterable[Marker], channels: Sequence[str]) -> list[Gap]:
    """Return the gaps that markers report, in order of time; a marker without channel names is for all `channels`."""
    gaps = []
    for marker in markers:
        if marker.kind in ("gap", "lost"):
            names = marker.fields.get("channels", channels)
            if not isinstance(names, list):
                raise RecordingError(
                    f"{MARKERS}: a marker of kind {marker.kind!r} has channels {names!r}; expected a list such as "
                    f'["a1"]. {WRITER_REMEDY}'
                )
            reason = str(marker.fields.get("reason", "never acquired"))
            gaps.append(Gap(marker.first_sample, marker.end, tuple(map(str, names)), reason))
    return gaps


def unmarked_ranges(missing: Iterable[tuple[int, int]], gaps: Sequence[Gap]) -> Iterator[tuple[int, int]]:
    """Yield the missing ranges [first, stop) without the parts at their starts that are already marked as gaps.

    `missing` and `gaps` are in ascending order. A gap that starts inside a range is not subtracted from this range.

    >>> list(unmarked_ranges([(10, 20), (30, 40)], [Gap(12, 15, ("a1",), "lost"), Gap(30, 39, ("a1",), "lost")]))
    [(10, 20)]
    """
    index = 0
    for first, stop in missing:
        while first < stop and index < len(gaps) and gaps[index].first_sample <= first:
            end = gaps[index].last_sample + 1
            first = max(first, end)
            index += end <= stop
        if first < stop:
            yield first, stop


def event_to_json(time: float, damper: int, kind: str, speed: float, joint: int = 0) -> bytes:
    """Encode a contact event as JSON.

    `time`: s after sample 0; `damper`, `joint`: number of the damper or the joint, from 1 (the other is 0); `kind`:
    from `CONTACT_CHANGES`; `speed`: closing speed [m/s].
    """
    return _json({"time": time, **({"joint": joint} if joint else {"damper": damper}), "kind": kind, "speed": speed})


def event_from_json(data: memoryview) -> tuple[float, int, str, float, int]:
    """Return the arguments of `event_to_json` from its message; raise `RecordingError` if it is malformed."""
    given = _object(data, EVENTS)
    absent = "damper" if "joint" in given else "joint"
    content: dict[str, Any] = dict.fromkeys(_EVENT_CHECKS) | given
    try:
        check(content, {key: value for key, value in _EVENT_CHECKS.items() if key != absent})
    except RecordingError as error:
        raise RecordingError(f"{EVENTS}: a message is not a valid contact event ({error}). {WRITER_REMEDY}") from error
    content[absent] = 0
    return float(content["time"]), content["damper"], content["kind"], float(content["speed"]), content["joint"]


def _json(content: Mapping[str, Any]) -> bytes:
    """Encode a value, also from numpy, as compact JSON; raise `ValueError` for NaN and infinity, which JSON lacks."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False, default=_to_python, ensure_ascii=False).encode()


def _to_python(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"a marker has a field {value!r}; expected numbers, strings, lists or objects.")


def _object(data: memoryview, topic: str) -> dict[str, Any]:
    """Decode a JSON object; raise `RecordingError` if the message of the topic is not a JSON object."""
    try:
        content = json.loads(bytes(data))
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{topic}: a message is not JSON ({error}). {WRITER_REMEDY}") from error
    if not isinstance(content, dict):
        raise RecordingError(f"{topic}: a message is not a JSON object (named fields in braces). {WRITER_REMEDY}")
    return content
