"""The description of a recording: `daq.info`, the command `daq info`, and the text page of a replay."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.core.measurement.run_report import next_steps
from daq.core.recording.markers import describe_faulty_impacts
from daq.core.recording.recording import Recording
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import RecordingError, ShotrigError
from rig.core.base.escaping import code_fence, escape_markdown
from rig.core.base.figure_types import Axes
from rig.core.results import Result

if TYPE_CHECKING:
    from daq.core.drawing.rig_view import RigView
    from daq.extras.viewer.recorded_motion import RecordedMotion

# Maximum number of listed segments of lost samples; a longer list would hide the other lines.
_MAX_LISTED_SEGMENTS = 10
_SAMPLING_TEXTS = {
    "point": "instantaneous samples",
    "average": "samples averaged over the sample interval",
    "filter": "samples after a decimation filter",
}


@dataclass(frozen=True, repr=False)
class Info(Result):
    """Description of a recording.

    Attributes
    ----------
    path : Path
    lines : tuple of str
        The description, one fact in each line.
    channels : dict of str to ChannelInfo
    next_steps : tuple of str
        Commands that analyze this recording, the most informative first.
    checked : bool
        Whether every record of the file was verified.
    """

    path: Path
    lines: tuple[str, ...]
    channels: dict[str, ChannelInfo]
    next_steps: tuple[str, ...]
    checked: bool = False

    def summary(self) -> str:
        """Name the file, its duration, its size and how the test ended."""
        return self.lines[0]

    def columns(self) -> dict[str, NDArray[Any]]:
        """Name, location, quantity, unit and sensitivity (V per unit) of each channel."""
        infos = self.channels.values()
        return {
            "name": np.array(list(self.channels), dtype=np.str_),
            "at": np.array([info.at for info in infos], dtype=np.str_),
            "quantity": np.array([info.quantity for info in infos], dtype=np.str_),
            "unit": np.array([info.unit for info in infos], dtype=np.str_),
            "sensitivity": np.array([info.sensitivity for info in infos]),
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw all channels over time."""
        with Recording(self.path) as recording:
            recording.draw(ax, **style)

    def __str__(self) -> str:
        steps = [f"  {'' if number else 'next':9} {step}" for number, step in enumerate(self.next_steps)]
        checked = ["  checked   all checksums match, and all records agree with each other"] if self.checked else []
        return "\n".join([*self.lines, *steps, *checked])


def info(path: str | Path, check: bool = False) -> Info:
    """Describe a recording. Its samples are read only for `check`.

    Parameters
    ----------
    path : str or Path
        The recording.
    check : bool
        Whether to read the whole file and verify every record.

    Returns
    -------
    Info
        Channels, and the lines of `daq info`.

    Raises
    ------
    RecordingError
        If the file cannot be read, is not a recording, or is damaged.

    Examples
    --------
    >>> import tempfile, daq, rig
    >>> scene = rig.load("fig10b-no-damper", {"test.repeats": 1, "test.interval": "0.3s"})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     description = daq.info(daq.record(scene, f"{folder}/hit.mcap"))
    >>> list(description.channels), len(description.next_steps)
    (['body1', 'body2', 'body3', 'hammer'], 4)
    """
    with Recording(path) as recording:
        lines, steps = tuple(describe(recording)), tuple(next_steps(recording))
        if check:
            recording.check()
        return Info(recording.path, lines, recording.channels, steps, check)


def describe(recording: Recording) -> Iterator[str]:
    """Yield the lines that describe an open recording; lines about content that the file lacks are omitted."""
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
    name_width = max(map(len, recording.channels))
    for number, (name, channel) in enumerate(recording.channels.items()):
        label = "channels" if number == 0 else ""
        sensor = f"{channel.quantity}, {channel.sensitivity:.6g} V per {channel.unit}"
        sampling = _SAMPLING_TEXTS[channel.sampling]
        yield f"  {label:9} {name:{name_width}}  {_position(recording, channel.at)}, {sensor}, {sampling}"
    if recording.truth_points:
        points, events = ", ".join(recording.truth_points), recording.events.size
        yield f"  truth     motion of {points}; {events} contact events"
    counts = Counter(marker.kind for marker in recording.markers)
    yield f"  markers   {', '.join(f'{count} {kind}' for kind, count in counts.items()) or 'none'}"
    if faulty := describe_faulty_impacts(recording.markers):
        yield f"  impacts      {faulty}"
    lost_segments = recording.gaps
    yield f"  lost      {_count_segments(len(lost_segments))}{_lost_range_note(recording)}"
    for segment in lost_segments[:_MAX_LISTED_SEGMENTS]:
        first, last = segment.first_sample / recording.rate, (segment.last_sample + 1) / recording.rate
        yield f"            {first:.6g} s to {last:.6g} s of {', '.join(segment.channels)}: {segment.reason}"
    if len(lost_segments) > _MAX_LISTED_SEGMENTS:
        yield f"            and {len(lost_segments) - _MAX_LISTED_SEGMENTS} more"


def _count_segments(count: int) -> str:
    if count == 0:
        return "none marked"
    return "1 segment of samples" if count == 1 else f"{count} segments of samples"


def _lost_range_note(recording: Recording) -> str:
    """Return the error of a recording that lacks almost all samples; an empty string for any other recording."""
    try:
        recording.reject_mostly_lost(0, recording.samples)
    except RecordingError as error:
        return f"; but {error}"
    return ""


def _duration(recording: Recording) -> str:
    seconds = recording.samples / recording.rate
    if seconds < 120:
        return f"{seconds:.3f} s"
    return f"{int(seconds // 60)} min {seconds % 60:.1f} s"


def _position(recording: Recording, at: str) -> str:
    """Return the location of a channel; a body is given by its name if the scene specifies a name."""
    try:
        return recording.outline.label(at)
    except ShotrigError:
        return at


def _scene(recording: Recording) -> str:
    try:
        return recording.outline.scene_name
    except ShotrigError as error:
        return f"not usable: {str(error).splitlines()[0]}"


def markdown_page(recording: Recording, motion: RecordedMotion, view: RigView) -> str:
    """Describe a recording for a replay in Markdown: the test, the bench, and the drawing."""
    scene, rate, count = recording.scene, recording.rate, len(recording.channels)
    lines = [
        f"# {escape_markdown(scene.name)}",
        f"{recording.samples / rate:.3f} s at {rate:g} Hz, {count} channel{'s' * (count != 1)}",
        "",
        f"## Drawing: motion exaggerated {view.exaggeration:g} times",
        *[f"- {escape_markdown(source.point)}: {escape_markdown(source.sentence)}" for source in motion.sources],
    ]
    if scene.dampers:
        source = "recorded truth"
        if not motion.gaps_known:
            source = "not recorded, drawn on their floors (a scene with recording: {truth: true} records them)"
        lines.append(f"- dampers: {source}")
        lines += [
            "",
            "## Dampers",
            "| damper | body | mass | clearance | restitution | contact |",
            "|---|---|---|---|---|---|",
        ]
        for number, (damper, mass) in enumerate(zip(scene.dampers, view.damper_masses, strict=True), start=1):
            clearance = "no ceiling" if math.isinf(damper.clearance) else f"{damper.clearance * 1e3:.4g} mm"
            if damper.spring is not None:
                clearance = f"on {damper.spring:.4g} N/m, {damper.walls_text}"
            if damper.friction is not None:
                clearance += f", friction {damper.friction:.3g}"
            lines.append(
                f"| {number} | {damper.body} | {mass * 1e3:.4g} g | {clearance} | {damper.restitution:g} "
                f"| {'grains' if damper.grains else 'instantaneous' if damper.contact is None else 'finite-duration'} |"
            )
    if scene.joints:
        texts = [escape_markdown(joint.text(scene.structure.label)) for joint in scene.joints]
        lines += ["", "## Joints", *(f"{number}. {text}" for number, text in enumerate(texts, 1))]
    lines += ["", "## Channels", "| channel | at | quantity | unit | V per unit |", "|---|---|---|---|---|"]
    for name, info in recording.channels.items():
        lines.append(
            f"| {escape_markdown(name)} | {escape_markdown(info.at)} | {info.quantity} | {info.unit} "
            f"| {info.sensitivity:.4g} |"
        )
    if recording.gaps:
        lost = sum(segment.last_sample + 1 - segment.first_sample for segment in recording.gaps)
        lines += ["", f"**{lost} samples lost, in {_count_segments(len(recording.gaps))}** (see the markers)"]
    lines += ["", "## Scene", code_fence(scene.to_yaml().rstrip(), "yaml")]
    return "\n".join(lines) + "\n"
