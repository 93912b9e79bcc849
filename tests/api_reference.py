"""The API reference: what the three packages' faces offer, from its docstrings (`make docs`)."""

import sys
from importlib import import_module
from pathlib import Path

PACKAGES = ("rig", "daq", "analysis")


def main(folder: Path) -> None:
    """Write one page for each package; a face finds its names when they are asked for, and pdoc does not ask."""
    import pdoc

    for package in map(import_module, PACKAGES):
        for name in package.__all__:
            setattr(package, name, getattr(package, name))
    pdoc.render.configure(docformat="numpy", math=True)
    pdoc.pdoc(*PACKAGES, output_directory=folder)
    print(f"open {folder / 'index.html'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
