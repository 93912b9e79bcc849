"""What a recording holds, in words, for the command `daq info`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from daq.recording.recording import Recording
from rig.errors import RecordingError, ShotrigError

MOST_LINES = 10
_SAMPLING = {
    "point": "samples at instants",
    "average": "samples are averages over their intervals",
    "filter": "samples behind a decimation filter",
}


def describe(recording: Recording) -> Iterator[str]:
    """Yield lines that describe an open recording; none of them needs its samples to be read.

    Parameters
    ----------
    recording : Recording
        Any recording; what another program left out is left out here.
    """
    size = recording.path.stat().st_size
    run, outcome = recording.metadata.get("run", {}), recording.metadata.get("outcome", {})
    yield f"{recording.path}: {_duration(recording)}, {size / 1e6:.1f} MB, {recording.status}"
    if outcome.get("reason"):
        yield f"  reason    {outcome['reason']}"
    yield f"  scene     {_scene(recording)}"
    if run:
        test, seed, version = (run.get(key, "?") for key in ("test", "seed", "shotrig"))
        yield f"  run       test {test}, seed {seed}, shotrig {version}"
    if recording.source:
        yield f"  imported  from {recording.source}"
    yield f"  rate      {recording.rate:.10g} Hz, stored as {recording.stored}"
    wide = max(map(len, recording.channels))
    for place, (name, info) in enumerate(recording.channels.items()):
        label = "channels" if place == 0 else ""
        sensor = f"{info.quantity}, {info.sensitivity:.6g} V per {info.unit}"
        yield f"  {label:9} {name:{wide}}  {_place(recording, info.at)}, {sensor}, {_SAMPLING[info.sampling]}"
    if recording.truth_points:
        points, events = ", ".join(recording.truth_points), recording.events.size
        yield f"  truth     of {points}; {events} changes of contact"
    counts = Counter(marker.kind for marker in recording.markers)
    yield f"  markers   {', '.join(f'{count} {kind}' for kind, count in counts.items()) or 'none'}"
    gaps = recording.gaps
    yield f"  lost      {_stretches(len(gaps))}{_void(recording)}"
    for gap in gaps[:MOST_LINES]:
        first, last = gap.first_sample / recording.rate, (gap.last_sample + 1) / recording.rate
        yield f"            {first:.6g} s to {last:.6g} s of {', '.join(gap.channels)}: {gap.reason}"
    if len(gaps) > MOST_LINES:
        yield f"            and {len(gaps) - MOST_LINES} more"


def _stretches(count: int) -> str:
    if count == 0:
        return "none noted"
    return "1 stretch of samples" if count == 1 else f"{count} stretches of samples"


def _void(recording: Recording) -> str:
    try:
        recording.refuse_void(0, recording.samples)
    except RecordingError as error:
        return f"; but {error}"
    return ""


def _duration(recording: Recording) -> str:
    seconds = recording.samples / recording.rate
    if seconds < 120:
        return f"{seconds:.3f} s"
    return f"{int(seconds // 60)} min {seconds % 60:.1f} s"


def _place(recording: Recording, at: str) -> str:
    """Name the place of a channel, a body by its name if the scene has one."""
    try:
        return recording.outline.label(at)
    except ShotrigError:
        return at


def _scene(recording: Recording) -> str:
    try:
        return recording.outline.scene
    except ShotrigError as error:
        return f"not usable: {str(error).splitlines()[0]}"
