"""The output of `daq import`: the contents of files, and the result of an import."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from daq.importing.files import signals_of
from daq.importing.import_files import import_files
from daq.measurement.run_report import summary
from daq.recording.recording import Recording
from daq.recording.recording import open as open_recording
from rig.console import progress
from rig.errors import RunWarning
from rig.escaping import escape_terminal
from rig.scene.scene import Scene


def listing(files: Sequence[Path]) -> Iterator[str]:
    """List the signals of files, in the form of a table for `--table`."""
    with ExitStack() as stack:
        for path in files:
            yield f"# {path}; replace signal1, ... by the names of the scene's channels"
            for signal in signals_of(path, stack):
                unit = f", unit: {_quoted(signal.unit)}" if signal.unit else ""
                rate = "" if signal.rate is None else f" at {signal.rate:.10g} Hz"
                column = f"{{column: {_quoted(signal.name)}{unit}}}"
                yield f"signal{signal.number}: {column}  # {signal.samples} samples{rate}"


def _quoted(text: str) -> str:
    return escape_terminal(json.dumps(text, ensure_ascii=False))


def import_and_report(
    files: Sequence[Path],
    scene: Scene,
    path: Path,
    table: Path | None,
    from_s: float | None,
    to_s: float | None,
    overwrite: bool,
) -> None:
    """Import files with a progress bar, and print a summary."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RunWarning)
        with progress(f"importing {files[0].name}") as report_progress:
            import_files(
                files, scene, path, table=table, from_s=from_s, to_s=to_s, overwrite=overwrite, progress=report_progress
            )
    for warning in caught:
        print(f"warning: {warning.message}", file=sys.stderr)
    with open_recording(path) as recording:
        for line in _detected_lines(recording):
            print(line)
    print(summary(path))


def _detected_lines(recording: Recording) -> Iterator[str]:
    """Describe the hits or steps that were detected in the samples."""
    hits = [marker for marker in recording.markers if marker.kind == "hit"]
    if hits:
        peaks = [float(hit.fields["peak"]) for hit in hits]
        yield f"{len(hits)} hits detected in the force, of {min(peaks):.3g} to {max(peaks):.3g} N"
    steps = [marker for marker in recording.markers if "settled" in marker.fields]
    if steps:
        at = [float(step.fields["frequency"]) for step in steps]
        settled = sum((step.stop - step.first_sample) / recording.rate for step in steps)
        yield (
            f"{len(steps)} steps detected, {min(at):.6g} to {max(at):.6g} Hz; settled, and measured, for {settled:.4g} "
            f"of {recording.samples / recording.rate:.4g} s"
        )
        moving = sum(not step.fields["settled"] for step in steps)
        if moving:
            yield f"{moving} of them did not reach steady state: marked as such"
