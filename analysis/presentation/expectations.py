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
        raise RecordingError(
            f"{path}: no force drives {test.name}. Use `analysis decay {file}` for its decay."
        )
    if command == "dampers":
        if not rec.scene.dampers:
            raise RecordingError(
                f"{path}: no dampers in its scene. Use `analysis frf {file}` for its responses."
            )
        if test.kind not in (TestKind.TONES, TestKind.NONE):
            suits = "decay" if test.decays else "frf"
            raise RecordingError(
                f"{path}: the motion of dampers is estimated from steady tones, not from {test.name}. Record test: "
                f"{{kind: stepped_sine, ...}} or {{kind: sine, ...}}, or use `analysis {suits} {file}`."
            )


def repeats(paths: Sequence[Path]) -> list[str]:
    """Return a warning for each file that was given twice: equal files are not independent measurements."""
    return [
        f"{again}: the same content as {first}. Give each measurement once."
        for first, again in duplicate_files(paths)
    ]


def expect_all(
    paths: Sequence[Path], command: str, blocks: Blocks, theory: bool = False, unit: str | None = None
) -> list[str]:
    """Raise an error for files that do not suit a command and for options without effect on any file.

    Returns warnings: files given twice, and options that have no effect on some of the files, with the reason.
    """
    asked = {**vars(blocks), "theory": theory or None, "unit": unit}
    idle: dict[str, list[str]] = {name: [] for name, value in asked.items() if value is not None}
    for path in paths:
        acting: tuple[str, ...]
        if is_frf_file(path):
            acting, why = ("unit",), "it contains estimates of another program"
        else:
            with opened(path) as rec:
                expect(rec, path, command)
                kind = rec.test.kind
            acting, why = ("theory", *BY_KIND[kind].options), BY_KIND[kind].method
        for name in idle.keys() - {*acting}:
            idle[name].append(f"{path.name}: {why if name != 'unit' else 'a recording states its units'}")
    for name, where in idle.items():
        if len(where) == len(paths):
            raise SceneError(f"--{name}: without effect ({where[0]}). Leave it out.")
    unused = [f"--{name} has no effect on {text}" for name, where in idle.items() for text in where]
    return [*repeats(paths), *unused]
