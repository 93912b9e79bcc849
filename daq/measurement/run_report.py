"""What a test that has been recorded tells its user: progress while it runs, a summary when it is over."""

from __future__ import annotations

import shlex
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from daq.measurement.estimate import WORTH_SAYING_S, estimate
from daq.measurement.force_reference import force_untold
from rig.console import progress
from rig.errors import ShotrigError
from rig.scene.presets import filled_in

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from rig.scene.scene import Scene


def record_and_report(name: str, scene: Scene, path: Path, overwrite: bool, block: int | None) -> int:
    """Record a scene's test with a progress bar and say what came of it.

    Parameters
    ----------
    name : str
        What the user calls the scene.
    scene : Scene
    path, overwrite, block
        As `daq.record` takes them.

    Returns
    -------
    int
        Exit code: 0 done, 130 interrupted (the recording is then closed and readable).
    """
    import daq

    print(f"recording {name} to {path.absolute()}", file=sys.stderr)
    taking = estimate(scene)
    if taking.seconds > WORTH_SAYING_S:
        print(taking, file=sys.stderr)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", daq.RunWarning)
        try:
            with progress(Path(name).stem) as tell:
                daq.record(scene, path, block=block, overwrite=overwrite, progress=tell)
            code = 0
        except KeyboardInterrupt as interrupt:
            if not interrupt.args:
                raise
            print("interrupted", file=sys.stderr)
            code = 130
    for warning in heard:
        print(f"warning: {warning.message}", file=sys.stderr)
    print(summary(path))
    return code


def summary(path: Path) -> str:
    """Describe a recording just made: what it holds, what went wrong in it, what to type next."""
    import daq

    with daq.open(path) as rec:
        lines = [
            f"{path}: {rec.samples} samples of {len(rec.channels)} channels, {rec.samples / rec.rate:.2f} s "
            f"at {rec.rate:g} Hz, {path.stat().st_size / 1e6:.1f} MB",
            f"overloads: {_overloads(rec)}",
        ]
        measured = [mark for mark in rec.markers if mark.kind == "measure" and "settled" in mark.fields]
        if measured:
            unsettled = [mark for mark in measured if not mark.fields["settled"]]
            lines.append(f"not settled: {len(unsettled) or 'none'} of {len(measured)} measurements")
        lines += _levels(rec)
        lines += [f"aborted: {mark.fields['reason']}" for mark in rec.markers if mark.kind == "abort"]
        lines.append(f"next: {'   or: '.join(next_steps(rec))}")
    return "\n".join(lines)


def next_steps(rec: Recording) -> list[str]:
    """List the commands that have something to work on in a recording, the most telling first."""
    try:
        scene = rec.scene
    except ShotrigError:
        # Another program's recording need not say what was on its bench.
        return [f"daq replay {shlex.quote(str(rec.path))}"]
    kinds = {mark.kind for mark in rec.markers}
    tones = any(mark.kind == "measure" and "frequency" in mark.fields for mark in rec.markers)
    channels = list(rec.channels.values())
    steps = ["decay"] if "hit" in kinds or (scene.test is not None and scene.test.kind == "free") else []
    struck = "hit" in kinds and any(info.quantity == "force" for info in channels)
    if struck or ("measure" in kinds and force_untold(scene, channels) is None):
        steps += ["frf"] if getattr(scene.test, "kind", "") == "sine" else ["frf", "modes"]
    steps += ["dampers"] if tones and scene.dampers else []
    return [
        f"{command} {shlex.quote(str(rec.path))}"
        for command in (*(f"analysis {step}" for step in steps), "daq replay")
    ]


def _levels(rec: Recording) -> list[str]:
    """Say where a swept force was off its level, one line or none."""
    off = [mark for mark in rec.markers if mark.kind == "level"]
    if not off:
        return []
    seconds = sum(mark.stop - mark.first_sample for mark in off) / rec.rate
    return [f"force off its level: {seconds:.2f} s in all (markers 'level' say where and by how much)"]


def _overloads(rec: Recording) -> str:
    stretches = [mark for mark in rec.markers if mark.kind == "overload"]
    names = sorted({str(mark.fields["channel"]) for mark in stretches})
    count = "1 stretch" if len(stretches) == 1 else f"{len(stretches)} stretches"
    return f"{count} in {', '.join(names)}{_sudden_landings(rec, names)}" if stretches else "none"


def _sudden_landings(rec: Recording, overloaded: Sequence[str]) -> str:
    """Tell a real sensor that is struck by landings of no duration, which none withstands, from too high a level."""
    try:
        scene = rec.scene
    except ShotrigError:
        return ""
    sudden = [number for number, damper in enumerate(scene.dampers, 1) if damper.contact is None]
    limited = {
        each.name
        for each in scene.channels or ()
        if each.accelerometer is not None and filled_in(each.accelerometer).saturation is not None
    }
    if not sudden or limited.isdisjoint(overloaded):
        return ""
    return (
        f"; a landing of no duration overloads most real sensors: with dampers[{sudden[0]}].contact: "
        "{duration: 2 ms} it lasts, as that of shot does"
    )
