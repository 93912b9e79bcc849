"""Names of the files that a command writes: made from its inputs' names, and never those of other inputs' files."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

from rig.errors import RunError
from rig.output_files import make_ready

# Letters of a channel's name in that of a file.
_LONGEST_PART = 40
# Longest name of a file made of the names of several recordings.
_LONGEST_NAME = 60
# Which inputs the files in a folder were made from.
_INDEX = ".made-from.json"


def output_stem(paths: Sequence[Path], output: Path | None, kind: str) -> Path:
    """Name the files made from some recordings, beside the first one unless told otherwise.

    Recordings of one name in different folders get their folder's name before it.

    Raises
    ------
    RunError
        If the names are taken by files made from other recordings, or the folder cannot be written.
    """
    folder = output if output is not None else paths[0].parent
    key = _digest("\n".join(str(path.resolve()) for path in paths))
    made = _made(folder)
    for name in (joined([path.stem for path in paths]), joined([_with_folder(path) for path in paths])):
        stem = f"{name}-{kind}"
        free = not any(file.name.startswith((f"{stem}.", f"{stem}-")) for file in _files(folder))
        if made.get(stem, key) == key or free:
            _note(folder, made | {stem: key})
            return folder / stem
    raise RunError(
        f"{folder / stem} was made from other recordings of that name; choose another folder with --output"
    )


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
    # What is left out tells sets apart that begin alike.
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


def _files(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def _made(folder: Path) -> dict[str, str]:
    try:
        found = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {str(name): str(key) for name, key in found.items()} if isinstance(found, dict) else {}


def _note(folder: Path, made: dict[str, str]) -> None:
    make_ready(folder)
    try:
        (folder / _INDEX).write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise RunError(
            f"cannot write {folder}: {error.strerror}; choose another place with --output"
        ) from None
