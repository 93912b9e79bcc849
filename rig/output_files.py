"""Where a study of a scene writes its files, and how they are named."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rig.errors import SceneError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def make_ready(folder: Path) -> None:
    """Make a folder if it does not exist, before the work whose results go there.

    Raises
    ------
    SceneError
        If it cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(
            f"{folder}: cannot be written ({error.strerror}); choose another place with -o"
        ) from None
    if not os.access(folder, os.W_OK):
        raise SceneError(f"{folder}: cannot be written; choose another place with -o")


def stem(study: str, scene: str) -> str:
    """Name a study's files after it and its scene.

    Examples
    --------
    >>> stem("cost", "Fig 9, a damper in body 2")
    'cost-fig-9-a-damper-in-body-2'
    """
    words = "".join(letter if letter.isalnum() else " " for letter in scene.lower()).split()
    return "-".join([study, *words])


def write_study(
    study: str, scene: str, folder: Path, figure: Figure, write_table: Callable[[Path], None]
) -> list[Path]:
    """Write a study's figure as .png and .svg, and its table.

    Parameters
    ----------
    study, scene : str
        They name the files.
    folder : Path
        Made if it does not exist.
    write_table : callable
        Writes the .csv file at the path it is given.

    Returns
    -------
    list of Path
        The .png, .svg and .csv files.

    Raises
    ------
    SceneError
        If a file cannot be written.
    """
    picture, drawing, table = (folder / f"{stem(study, scene)}.{ending}" for ending in ("png", "svg", "csv"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_table(table)
        for file in (picture, drawing):
            figure.savefig(file, dpi=160)
    except OSError as error:
        raise SceneError(f"{folder}: cannot be written ({error.strerror})") from None
    return [picture, drawing, table]
