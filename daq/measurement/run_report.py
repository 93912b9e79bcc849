"""What a test that has been recorded tells its user: progress while it runs, a summary when it is over."""

from __future__ import annotations

import shlex
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from daq.measurement.estimate import WORTH_SAYING_S, estimate
from daq.measurement.force_reference import force_untold
from rig.command_line import progress

if TYPE_CHECKING:
    from daq.recording.recording import Recording


def record_and_report(scene: str, path: Path, overwrite: bool, block: int | None) -> int:
    """Record a scene's test with a progress bar and say what came of it.

    Returns
    -------
    int
        Exit code: 0 done, 130 interrupted (the recording is then closed and readable).
    """
    import daq
    import rig

    setting = rig.load(scene)
    print(f"recording {scene} to {path.absolute()}", file=sys.stderr)
    taking = estimate(setting)
    if taking.seconds > WORTH_SAYING_S:
        print(taking, file=sys.stderr)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", daq.RunWarning)
        try:
            with progress(Path(scene).stem) as tell:
                daq.record(setting, path, block=block, overwrite=overwrite, progress=tell)
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
        file = shlex.quote(str(path))
        steps = [*_analysis(rec, file), f"daq replay {file}"]
        lines.append(f"next: {'   or: '.join(steps)}")
    return "\n".join(lines)


def _analysis(rec: Recording, file: str) -> list[str]:
    """Tell which analysis has something to work on, if any."""
    kind = rec.scene.test.kind if rec.scene.test is not None else ""
    if kind == "free" or (kind == "impulse" and any(mark.kind == "hit" for mark in rec.markers)):
        return [f"analysis decay {file}"]
    measured = any(mark.kind == "measure" for mark in rec.markers)
    told = force_untold(rec.scene, list(rec.channels.values())) is None
    return [f"analysis frf {file}"] if measured and told else []


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
    return f"{count} in {', '.join(names)}" if stretches else "none"
