"""Detection of user files that shadow modules, such as numpy.py: Python searches the folder of a script first."""

from __future__ import annotations

import sys
from contextlib import suppress
from importlib.machinery import PathFinder
from pathlib import Path


def shadowing_files(folder: Path) -> list[str]:
    """Return a message for each file of a folder that shadows an installed or standard module.

    `folder`: folder of the script, or the first folder of the module search path.
    """
    messages = []
    search_path = [entry for entry in sys.path if entry and Path(entry).absolute() != folder.absolute()]
    with suppress(OSError):
        for file in sorted(folder.iterdir()):
            package_file = file / "__init__.py"
            if not (file.suffix == ".py" or package_file.is_file()) or not file.stem.isidentifier():
                continue
            module = PathFinder.find_spec(file.stem, search_path)
            locations = [] if module is None else [module.origin, *(module.submodule_search_locations or ())]
            paths = [Path(location) for location in locations if location]
            if not paths or file in paths or package_file in paths:
                continue
            messages.append(f"{file} is imported instead of the module {file.stem} ({paths[0]}). Rename the file.")
    return messages
