"""Progress of a test during `daq record`, and its summary at the end."""

from __future__ import annotations

import shlex
import sys
import warnings
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from daq.core.measurement.impact_remedy import instantaneous_impact_remedy
from daq.core.recording.recorded_test import own_analyses, shocks_of
from rig.core.base.console import progress
from rig.core.base.errors import ShotrigError
from rig.core.results import format_frequencies
from rig.core.results.text import table_lines

if TYPE_CHECKING:
    from daq.core.recording.markers import Marker
    from daq.core.recording.recording import Recording
    from rig.core.scene.measurement_chain import Accelerometer, Hammer
    from rig.core.scene.scene import Scene

# `analysis modes` requires at least this number of frequencies.
_MIN_MODE_TONES = 8


def record_and_report(name: str, scene: Scene, path: Path, block: int | None) -> int:
    """Record the test of a scene with a progress bar and print a summary.

    `name` is the scene as the user gave it, `block` the maximum number of samples per block. Returns the exit code: 0,
    or 130 if the user interrupted the test.
    """
    import daq
    from daq.core.signal_chain.converter import describe_clock

    print(f"recording {name} to {path.absolute()}", file=sys.stderr)
    if scene.converter.sample_rate != scene.converter.rate:
        print(f"sample clock: {describe_clock(scene.converter)}", file=sys.stderr)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", daq.RunWarning)
        try:
            with progress(Path(name).stem) as report_progress:
                daq.record(scene, path, block=block, progress=report_progress)
            code = 0
        except KeyboardInterrupt as interrupt:
            if not interrupt.args:
                raise
            print("interrupted", file=sys.stderr)
            code = 130
    for warning in caught:
        print(f"warning: {warning.message}", file=sys.stderr)
    print(summary(path))
    return code


def is_recorded(scene: Scene, path: Path) -> bool:
    """Return whether a file is the complete recording of a scene's test by this version of shotrig."""
    from importlib.metadata import version

    import daq

    try:
        if not path.is_file():
            return False
        with daq.open(path) as rec:
            is_same_version = rec.metadata.get("run", {}).get("shotrig") == version("shotrig") and not rec.source
            # Live recordings that clients start have no markers of a test.
            return is_same_version and rec.status == "complete" and bool(rec.markers) and rec.scene == scene
    except (ShotrigError, OSError):
        return False


def summary(path: Path) -> str:
    """Describe a new recording: contents, problems and the next commands."""
    import daq

    with daq.open(path) as rec:
        channels = f"{len(rec.channels)} channel{'s' * (len(rec.channels) != 1)}"
        lines = [
            f"{path}: {rec.samples} samples of {channels}, {rec.samples / rec.rate:.2f} s "
            f"at {rec.rate:g} Hz, {path.stat().st_size / 1e6:.1f} MB",
            *_overloads(rec),
            *_clipped_drives(rec),
        ]
        measured = [mark for mark in rec.markers if mark.kind == "measure" and "settled" in mark.fields]
        if measured:
            tones = [mark.fields for mark in measured if "frequency" in mark.fields]
            transient = [not fields["settled"] for fields in tones]
            frequencies = ""
            if any(transient):
                frequencies = f", not at {format_frequencies([fields['frequency'] for fields in tones], transient)}"
            steady = sum(bool(mark.fields["settled"]) for mark in measured)
            if tones or steady < len(measured):
                lines.append(f"steady state reached: {steady} of {len(measured)} measurements{frequencies}")
        deviations = [mark for mark in rec.markers if mark.kind == "level"]
        if deviations:
            seconds = sum(mark.stop - mark.first_sample for mark in deviations) / rec.rate
            lines.append(f"force outside its tolerance: {seconds:.2f} s in total (see the markers 'level')")
        lines += [f"aborted: {mark.fields['reason']}" for mark in rec.markers if mark.kind == "abort"]
        lines.append(f"next: {'   or: '.join(next_steps(rec))}")
    return "\n".join(lines)


def next_steps(rec: Recording) -> list[str]:
    """List the commands that can evaluate a recording, the most informative command first."""
    path = shlex.quote(str(rec.path))
    try:
        outline, kind = rec.outline, rec.test_kind
    except ShotrigError:
        # A recording of another program might lack a scene.
        return [f"daq replay {path}"]
    kinds, measured = {mark.kind for mark in rec.markers}, [mark for mark in rec.markers if mark.kind == "measure"]
    channels = rec.channels.values()
    has_force_channel = any(info.quantity == "force" for info in channels)
    has_force_reference = not outline.missing_force_points(channels)
    if not any(info.body and info.derivative is not None for info in channels):
        return [f"daq replay {path}"]
    steps = ["decay"] if "hit" in kinds or not kind.drives else []
    if ("hit" in kinds and has_force_channel) or ("measure" in kinds and has_force_reference):
        is_few_tones = kind.steady and len({mark.fields.get("frequency") for mark in measured}) < _MIN_MODE_TONES
        steps += ["frf"] if is_few_tones else ["frf", "modes"]
    steps = [*own_analyses(rec.markers), *(["srs"] if shocks_of(rec.markers) else steps)]
    steps += ["dampers"] if kind.steady and "measure" in kinds and outline.n_dampers else []
    return [*(f"analysis {step} {path}" for step in steps), f"daq replay {path}"]


def _overloads(rec: Recording) -> list[str]:
    """Return lines about the overloads: number of overloaded channels, and a table of times, frequencies and limits."""
    by_channel: dict[str, list[Marker]] = {}
    for mark in sorted((mark for mark in rec.markers if mark.kind == "overload"), key=lambda mark: mark.first_sample):
        by_channel.setdefault(str(mark.fields["channel"]), []).append(mark)
    if not by_channel:
        return ["overloads: none"]
    rows = [("channel", "intervals", "total / s", "first / s", "frequency / Hz", "limit")]
    for name, marks in by_channel.items():
        frequencies = sorted(
            float(tone.fields["frequency"])
            for tone in rec.markers
            if tone.kind in ("settle", "measure") and "frequency" in tone.fields
            if any(tone.first_sample < mark.stop and mark.first_sample < tone.stop for mark in marks)
        )
        lowest_and_highest = dict.fromkeys(f"{frequency:.4g}" for frequency in (frequencies[:1] + frequencies[-1:]))
        seconds = sum(mark.stop - mark.first_sample for mark in marks) / rec.rate
        first = f"{marks[0].first_sample / rec.rate:.2f}"
        frequency_range = " to ".join(lowest_and_highest)
        rows.append((name, str(len(marks)), f"{seconds:.3g}", first, frequency_range, _limit(rec, name)))
    count = f"{len(by_channel)} channel{'s' if len(by_channel) > 1 else ''}"
    return [
        f"overloads: {count}{_instantaneous_impact_note(rec, by_channel)}",
        *(f"  {line}" for line in table_lines(rows, "<>>>><")),
    ]


def _clipped_drives(rec: Recording) -> list[str]:
    """Return a line for each input whose amplifier clipped the drive."""
    seconds: dict[str, float] = {}
    for mark in (mark for mark in rec.markers if mark.kind == "clipped"):
        name = str(mark.fields["channel"])
        seconds[name] = seconds.get(name, 0.0) + (mark.stop - mark.first_sample) / rec.rate
    return [
        f"{name}: the output or its amplifier clipped the drive for {duration:.3g} s in total. Lower the level of the "
        "test, or raise the limit (shaker.amplifier.limit, shaker.output.range)."
        for name, duration in seconds.items()
    ]


def _limit(rec: Recording, name: str) -> str:
    """Return a channel's limits as text: saturation of the sensor, and range of the input in V and in the unit."""
    from rig.core.scene.presets import preset_note

    info, limits = rec.channels[name], []
    settings: dict[str, Accelerometer | Hammer | None] = {}
    with suppress(ShotrigError):
        settings = {each.name: each.accelerometer or each.hammer for each in rec.scene.channels or ()}
    for key, text in info.sensor.items():
        if key.endswith(".saturation"):
            limits.append(f"sensor {text}{preset_note(settings.get(name), 'saturation')}")
    if info.range is not None:
        max_reading = info.range / abs(info.sensitivity)
        limits.append(f"input ±{info.range:g} V, {max_reading:.4g} {info.unit}")
    return "; ".join(limits)


def _instantaneous_impact_note(rec: Recording, overloaded: Iterable[str]) -> str:
    """Return a note if impacts of zero duration, not the level, may have overloaded the sensors; otherwise ''."""
    from rig.core.scene.presets import complete_from_preset

    try:
        scene = rec.scene
    except ShotrigError:
        return ""
    sensors = {each.name: each.accelerometer for each in scene.channels or () if each.name in set(overloaded)}
    remedy = instantaneous_impact_remedy(scene)
    if all(each is None or complete_from_preset(each).saturation is None for each in sensors.values()):
        return ""
    return f". {remedy}" if remedy else ""
