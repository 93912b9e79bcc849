"""Names of the files that a command writes: made from its inputs' names, and never those of other inputs' files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rig.errors import RunError
from rig.provenance import is_from_another_source, made_from, may_overwrite, refuse_others, relative

# Letters of a channel's name in that of a file.
_LONGEST_PART = 40
# Longest name of a file made of the names of several recordings.
_LONGEST_NAME = 60


@contextmanager
def output_stem(paths: Sequence[Path], output: Path | None, kind: str, *endings: str) -> Iterator[Path]:
    """Name the files made from some recordings, next to the first one unless a folder is given.

    Recordings of one name in different folders get their folder's name before it. What is written inside the `with`
    follows the rule of `rig.provenance`: the source is the recordings, by their places relative to the folder.

    Parameters
    ----------
    endings : str
        Of the files that will be written in any case.

    Raises
    ------
    RunError
        If the names are taken by files made from other recordings.
    SceneError
        If they are taken by files that are not of our making, or were changed since.
    """
    folder = output if output is not None else paths[0].parent
    with made_from(kind, *relative(paths, folder)):
        for name in (joined([path.stem for path in paths]), joined([_with_folder(path) for path in paths])):
            stem = folder / f"{name}-{kind}"
            files = [with_ending(stem, ending) for ending in endings]
            if may_overwrite() or not any(is_from_another_source(file) for file in files):
                refuse_others(*files)
                yield stem
                return
        raise RunError(
            f"{stem} was made from other recordings of that name. Choose another folder with --output, or pass "
            "--overwrite"
        )


def check_outputs(paths: Sequence[Path], output: Path | None, kind: str, *endings: str) -> None:
    """Raise the errors of `output_stem` before the work, not after it."""
    with output_stem(paths, output, kind, *endings):
        pass


def joined(names: Sequence[str]) -> str:
    """Join names to one that is not too long.

    Examples
    --------
    >>> joined(["none", "three"])
    'none+three'
    >>> joined(["a-sweep-of-a-structure-with-a-long-name", "another-one-of-the-same-kind"])
    'a-sweep-of-a-structure-with-a-long-name+1-more-0c56'
    """
    name = "+".join(names)
    if len(name) <= _LONGEST_NAME:
        return name
    # A digest of the omitted names distinguishes sets that begin alike.
    rest = _digest(name)[:4]
    return f"{names[0]}+{len(names) - 1}-more-{rest}" if len(names) > 1 else name


def of_part(stem: Path, part: str) -> Path:
    """Add the name of a channel, which a file may have made anything but a name of files.

    Examples
    --------
    >>> of_part(Path("run-frf"), "body1").name, of_part(Path("run-frf"), "../../etc/passwd").name
    ('run-frf-body1', 'run-frf-.._.._etc_passwd-3754')
    """
    plain = "".join(letter if letter.isalnum() or letter in " -_.+" else "_" for letter in part)[
        :_LONGEST_PART
    ]
    return stem.with_name(f"{stem.name}-{plain}" + ("" if plain == part else f"-{_digest(part)[:4]}"))


def with_ending(stem: Path, ending: str) -> Path:
    """Add an ending to a name, which may hold dots of its own.

    Examples
    --------
    >>> with_ending(Path("a0.5-report"), "html").name
    'a0.5-report.html'
    """
    return stem.with_name(f"{stem.name}.{ending}")


def _digest(names: str) -> str:
    # Names of files need not be UTF-8.
    return hashlib.sha256(os.fsencode(names)).hexdigest()


def _with_folder(path: Path) -> str:
    return f"{path.resolve().parent.name}-{path.stem}"
