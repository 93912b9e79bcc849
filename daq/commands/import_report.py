"""Lines that the command `daq import` prints: the signals of files, or the result of an import."""

import json
import re
import shlex
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from daq.core.measurement.run_report import summary
from daq.core.recording.markers import impacts_of
from daq.core.recording.recording import Recording
from daq.core.recording.recording import open as open_recording
from daq.extras.importing.files import signals_of
from daq.extras.importing.import_files import import_files
from rig.core.base.console import progress
from rig.core.base.errors import RunWarning
from rig.core.base.escaping import escape_terminal
from rig.core.scene.scene import Scene

# Name of a column of frequencies, in English, German and French.
_FREQUENCY = re.compile(r"fre[qk]|fréq", re.IGNORECASE)


def listing(files: Sequence[Path]) -> Iterator[str]:
    """Yield the signals of files as lines of a table that can be edited and given to `--table`."""
    with ExitStack() as stack:
        # All files are checked before the first line is printed.
        signals_by_file = [(path, signals_of(path, stack)) for path in files]
        for path, signals in signals_by_file:
            first = signals[0]
            if first.rate is None and (first.unit == "Hz" or _FREQUENCY.match(first.name)):
                yield f"# {path} begins with frequencies. If it contains frequency responses: analysis modes {path}"
            yield f"# {path}; replace signal1, ... by the names of the scene's channels"
            for signal in signals:
                unit = f", unit: {_quoted(signal.unit)}" if signal.unit else ""
                rate = "" if signal.rate is None else f" at {signal.rate:.10g} Hz"
                column = f"{{column: {_quoted(signal.name)}{unit}}}"
                yield f"signal{signal.number}: {column}  # {signal.samples} samples{rate}"
        names = " ".join(shlex.quote(str(path)) for path in files)
        yield f"# Save these lines as table.yaml. next: daq import {names} --scene SCENE --table table.yaml"


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
    """Import files with a progress bar; print the detected impacts or dwells, and a summary."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RunWarning)
        with progress(f"importing {files[0].name}") as report_progress:
            import_files(
                files, scene, path, table=table, from_s=from_s, to_s=to_s, overwrite=overwrite, progress=report_progress
            )
    for warning in caught:
        print(f"warning: {warning.message}", file=sys.stderr)
    with open_recording(path) as recording:
        for line in _detection_lines(recording, scene):
            print(line)
    print(summary(path))


def _detection_lines(recording: Recording, scene: Scene) -> Iterator[str]:
    """Yield lines about the impacts or dwells that were detected in the samples."""
    impacts = impacts_of(recording.markers)
    if impacts:
        peaks = [float(impact.fields["peak"]) for impact in impacts]
        test, count = scene.test, len(impacts)
        # The number of impacts is compared only if the scene states it; a default is not the plan of the test.
        planned = test.hits[0] if test is not None and "repeats" in test.model_fields_set else count
        share = f"{count} of {planned} impacts" if count < planned else "1 impact" if count == 1 else f"{count} impacts"
        plan = "" if count == planned else f" (test.repeats is {planned})"
        peak_range = f"a peak of {peaks[0]:.3g} N" if count == 1 else f"peaks of {min(peaks):.3g} to {max(peaks):.3g} N"
        yield f"{share} detected in the force{plan}, with {peak_range}"
    dwells = [marker for marker in recording.markers if "settled" in marker.fields]
    if dwells:
        frequencies = [float(dwell.fields["frequency"]) for dwell in dwells]
        total_s = recording.samples / recording.rate
        settled_s = sum((dwell.stop - dwell.first_sample) / recording.rate for dwell in dwells)
        yield (
            f"{len(dwells)} dwell{'s' if len(dwells) > 1 else ''} detected, {min(frequencies):.6g} to "
            f"{max(frequencies):.6g} Hz; in steady state, and measured, for {settled_s:.4g} of {total_s:.4g} s"
        )
        unsettled_count = sum(not dwell.fields["settled"] for dwell in dwells)
        if unsettled_count:
            yield f"{unsettled_count} of these dwells did not reach steady state, and are marked"
