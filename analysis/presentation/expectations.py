"""Which command and which options suit a recording: wrong ones are refused in words that say what suits."""

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
from rig.input_files import repeated

if TYPE_CHECKING:
    from daq.recording.recording import Recording


def expect(rec: Recording, path: Path, command: str) -> None:
    """Refuse a recording that does not hold what a command is about.

    Parameters
    ----------
    rec : daq.recording.recording.Recording
        Open.
    path : Path
        Its file.
    command : {'frf', 'modes', 'decay', 'dampers'}

    Raises
    ------
    RecordingError
        Stating what the recording contains, and which command suits it.
    """
    test, file = rec.test, shlex.quote(str(path))
    held = f"{path} holds {test.name}"
    if command == "decay" and not test.decays and test.kind is not TestKind.NONE:
        raise RecordingError(f"{held} and no free decay: `analysis frf {file}` shows its frequency responses")
    if command in ("frf", "modes", "dampers") and not test.drives:
        raise RecordingError(f"{held}, which no force drives: `analysis decay {file}` shows how it dies away")
    if command == "dampers":
        if not rec.scene.dampers:
            raise RecordingError(
                f"{path}: its scene has no dampers; `analysis frf {file}` shows its responses"
            )
        if test.kind not in (TestKind.TONES, TestKind.NONE):
            suits = "decay" if test.decays else "frf"
            raise RecordingError(
                f"{held}: the motion of dampers needs held tones, test: {{kind: stepped_sine, ...}} or "
                f"{{kind: sine, ...}}; `analysis {suits} {file}` shows what this recording contains"
            )


def repeats(paths: Sequence[Path]) -> list[str]:
    """Warn of files that were given twice: what they show is right, but is one measurement."""
    return [
        f"{again}: the same content as {first}. Give each measurement once; these are no two results."
        for first, again in repeated(paths)
    ]


def expect_all(
    paths: Sequence[Path], command: str, blocks: Blocks, theory: bool = False, unit: str | None = None
) -> list[str]:
    """Refuse files that do not suit a command, and options that act on none of them.

    Returns
    -------
    list of str
        Files given twice; of options that act on some of the files, on which they do not, and why.
    """
    asked = {**vars(blocks), "theory": theory or None, "unit": unit}
    idle: dict[str, list[str]] = {name: [] for name, value in asked.items() if value is not None}
    for path in paths:
        acting: tuple[str, ...]
        if is_frf_file(path):
            acting, why = ("unit",), "it holds what another program has estimated"
        else:
            with opened(path) as rec:
                expect(rec, path, command)
                kind = rec.test.kind
            acting, why = ("theory", *BY_KIND[kind].options), BY_KIND[kind].method
        for name in idle.keys() - {*acting}:
            idle[name].append(f"{path.name}: {why if name != 'unit' else 'a recording knows its units'}")
    for name, where in idle.items():
        if len(where) == len(paths):
            raise SceneError(f"--{name} would change nothing; leave it out ({where[0]})")
    unused = [f"--{name} changes nothing in {text}" for name, where in idle.items() for text in where]
    return [*repeats(paths), *unused]
