"""Where a study of a scene writes its files, and how they are named."""

from __future__ import annotations

import os
from pathlib import Path

from rig.errors import SceneError


def make_ready(folder: Path) -> None:
    """Make a folder if it does not exist, before the work whose results go there.

    Parameters
    ----------
    folder : Path

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
