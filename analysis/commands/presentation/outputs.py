"""Output of an `analysis` command: files, printed lines and warnings; names of the output files.

File names are derived from the names of the inputs, so that results of other inputs are not overwritten.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from analysis.core.recordings.names import require_file
from rig.core.base.errors import RunError
from rig.core.base.output_files import prepare_outputs
from rig.core.base.provenance import is_from_another_source, may_overwrite, output_source, relative_paths

# Maximum number of characters of a channel name in a file name.
_MAX_CHANNEL_LENGTH = 40
# Maximum number of characters of the combined names of several recordings.
_MAX_NAME_LENGTH = 60


@dataclass(frozen=True)
class CommandOutput:
    """Output of a command."""

    files: tuple[Path, ...]  # files written
    lines: tuple[str, ...]  # lines to print
    warnings: tuple[str, ...]  # each begins with the name of its recording


def with_recording_name(path: Path, warnings: Sequence[str]) -> list[str]:
    """Prefix each warning with the name of its recording."""
    return [f"{path.name}: {warning}" for warning in warnings]


def with_sweep_name(sweep: str, recording: str, warnings: Sequence[str], named: Sequence[str] = ()) -> list[str]:
    """Prefix each warning with the name of its sweep, if the recording has several sweeps.

    `sweep`, `recording`: labels; that of a sweep is the label of the recording, followed by the name of the sweep;
    `named`: warnings of the responses, which already name the sweep where necessary.

    >>> with_sweep_name("beam, 2 N up", "beam", ["no mode"]), with_sweep_name("beam", "beam", ["no mode"])
    (['2 N up: no mode'], ['no mode'])
    """
    name = sweep.removeprefix(recording).removeprefix(", ")
    return [f"{name}: {warning}" if name and warning not in named else warning for warning in warnings]


@contextmanager
def output_stem(paths: Sequence[Path], output: Path | None, kind: str, *extensions: str) -> Iterator[Path]:
    """Yield the common path of the output files without file extension.

    `paths`: recordings; `output`: folder, by default the folder of the first recording; `kind`: last part of the name,
    such as "frf"; `extensions`: extensions of the files that are always written.

    If files of other recordings already have the name, each name is prefixed with its folder. Files written inside the
    `with` block store the paths of the recordings as their source, and are overwritten only by results of the same
    source (`rig.core.base.provenance`).

    Raises `RunError` if files with these names exist and were made from other recordings. Raises `SceneError` if files
    with these names exist and were not written by shotrig, or were changed since.
    """
    folder = output if output is not None else paths[0].parent
    with output_source(kind, *relative_paths(paths, folder)):
        stems = [path.stem for path in paths]
        stems_with_folder = [f"{path.resolve().parent.name}-{path.stem}" for path in paths]
        for name in (join_names(stems), join_names(stems_with_folder)):
            stem = folder / f"{name}-{kind}"
            files = [with_ending(stem, extension) for extension in extensions]
            if may_overwrite() or not any(is_from_another_source(file) for file in files):
                prepare_outputs(*files)
                yield stem
                return
        raise RunError(
            f"{stem}: results of other recordings have this name. Choose another folder with --output, or pass "
            "--overwrite."
        )


def check_outputs(paths: Sequence[Path], output: Path | None, kind: str, *extensions: str) -> None:
    """Raise the errors of `output_stem` before the analysis starts; missing recordings are reported first."""
    for path in paths:
        require_file(path)
    with output_stem(paths, output, kind, *extensions):
        pass


def join_names(names: Sequence[str]) -> str:
    """Join names into one name of limited length.

    >>> join_names(["none", "three"])
    'none+three'
    >>> join_names(["a-sweep-of-a-structure-with-a-long-name", "another-one-of-the-same-kind"])
    'a-sweep-of-a-structure-with-a-long-name+1-more-0c56'
    """
    name = "+".join(names)
    if len(name) <= _MAX_NAME_LENGTH:
        return name
    # The digest distinguishes lists with the same first name and length.
    digest = _digest(name)[:4]
    return f"{names[0]}+{len(names) - 1}-more-{digest}" if len(names) > 1 else name


def with_channel_name(stem: Path, channel: str) -> Path:
    """Append a channel name; characters that are unsafe in a file name are replaced.

    >>> with_channel_name(Path("run-frf"), "body1").name, with_channel_name(Path("run-frf"), "../../etc/passwd").name
    ('run-frf-body1', 'run-frf-.._.._etc_passwd-3754')
    """
    safe = "".join(letter if letter.isalnum() or letter in " -_.+" else "_" for letter in channel)[:_MAX_CHANNEL_LENGTH]
    return stem.with_name(f"{stem.name}-{safe}" + ("" if safe == channel else f"-{_digest(channel)[:4]}"))


def with_ending(stem: Path, extension: str) -> Path:
    """Add a file extension to a name that may contain dots.

    >>> with_ending(Path("a0.5-report"), "html").name
    'a0.5-report.html'
    """
    return stem.with_name(f"{stem.name}.{extension}")


def _digest(names: str) -> str:
    # File names are not necessarily valid UTF-8.
    return hashlib.sha256(os.fsencode(names)).hexdigest()
