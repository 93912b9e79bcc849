"""Files that shadow modules: Python searches the folder of a script first."""

from __future__ import annotations

import sys
from contextlib import suppress
from importlib.machinery import PathFinder
from pathlib import Path


def shadowing_files(folder: Path) -> list[str]:
    """Return the files of a folder that shadow installed or standard modules.

    `folder`: folder of the script, or the first folder of the module search path.
    """
    out = []
    elsewhere = [entry for entry in sys.path if entry and Path(entry).absolute() != folder.absolute()]
    with suppress(OSError):
        for file in sorted(folder.iterdir()):
            inside = file / "__init__.py"
            if not (file.suffix == ".py" or inside.is_file()) or not file.stem.isidentifier():
                continue
            meant = PathFinder.find_spec(file.stem, elsewhere)
            places = [] if meant is None else [meant.origin, *(meant.submodule_search_locations or ())]
            if not any(places) or any(Path(place) in (file, inside) for place in places if place):
                continue
            out.append(
                f"{file} is found in the place of the module {file.stem} ({next(filter(None, places))}): rename it"
            )
    return out
