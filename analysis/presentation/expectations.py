"""Check that a command and its options suit the recordings; errors name a suitable command or option."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.recordings.names import opened
from analysis.responses.frequency_responses import BY_KIND, Blocks
from analysis.responses.frf_files import is_frf_file
from daq.recording.recorded_test import TestKind
from rig.errors import RecordingError, SceneError
from rig.input_files import duplicate_files

if TYPE_CHECKING:
    from daq.recording.recording import Recording


def expect(rec: Recording, path: Path, command: str) -> None:
    """Raise an error if a recording lacks the data that a command analyzes.

    `rec`: an open recording; `path`: file of the recording, for the message; `command`: 'frf', 'modes', 'decay' or
    'dampers'. Command to check. Raises `RecordingError` if the command does not suit the recording. The message
    states the content and a suitable command.
    """
    test, file = rec.test, shlex.quote(str(path))
    if command == "decay" and not test.decays and test.kind is not TestKind.NONE:
        raise RecordingError(
            f"{path}: {test.name} contains no free decay. Use `analysis frf {file}` for its frequency responses."
        )
    if command in ("frf", "modes", "dampers") and not test.drives:
        raise RecordingError(f"{path}: no force drives {test.name}. Use `analysis decay {file}` for its decay.")
    if command == "dampers":
        if not rec.scene.dampers:
            raise RecordingError(f"{path}: no dampers in its scene. Use `analysis frf {file}` for its responses.")
        if test.kind not in (TestKind.TONES, TestKind.NONE):
            suits = "decay" if test.decays else "frf"
            raise RecordingError(
                f"{path}: the motion of dampers is estimated from steady tones, not from {test.name}. Record test: "
                f"{{kind: stepped_sine, ...}} or {{kind: sine, ...}}, or use `analysis {suits} {file}`."
            )


def duplicate_warnings(paths: Sequence[Path]) -> list[str]:
    """Return a warning for each file that was given twice: equal files are not independent measurements."""
    return [
        f"{duplicate}: the same content as {first}. Give each measurement once."
        for first, duplicate in duplicate_files(paths)
    ]


def expect_all(
    paths: Sequence[Path], command: str, blocks: Blocks, theory: bool = False, unit: str | None = None
) -> list[str]:
    """Raise an error for files that do not suit a command and for options without effect on any file.

    Returns warnings: files given twice, and options that have no effect on some of the files, with the reason.
    """
    requested = {**vars(blocks), "theory": theory or None, "unit": unit}
    without_effect: dict[str, list[str]] = {name: [] for name, value in requested.items() if value is not None}
    for path in paths:
        effective: tuple[str, ...]
        if is_frf_file(path):
            effective, reason = ("unit",), "it contains estimates of another program"
        else:
            with opened(path) as rec:
                expect(rec, path, command)
                kind = rec.test.kind
            effective, reason = ("theory", *BY_KIND[kind].options), BY_KIND[kind].method
        for name in without_effect.keys() - {*effective}:
            without_effect[name].append(f"{path.name}: {reason if name != 'unit' else 'a recording states its units'}")
    for name, files in without_effect.items():
        if len(files) == len(paths):
            raise SceneError(f"--{name}: without effect ({files[0]}). Leave it out.")
    unused = [f"--{name} has no effect on {text}" for name, files in without_effect.items() for text in files]
    return [*duplicate_warnings(paths), *unused]
