"""The API reference, from the docstrings of the three packages' faces, and that of scene files (`make docs`)."""

import sys
from importlib import import_module
from pathlib import Path

PACKAGES = ("rig", "daq", "analysis")


def main(folder: Path) -> None:
    """Write one page for each package; a face finds its names when they are asked for, and pdoc does not ask."""
    import pdoc
    from pdoc.render_helpers import to_html

    from rig.scene.reference import page

    for package in map(import_module, PACKAGES):
        for name in package.__all__:
            setattr(package, name, getattr(package, name))
    pdoc.render.configure(docformat="numpy", math=True)
    pdoc.pdoc(*PACKAGES, output_directory=folder)
    scenes = folder / "scenes.html"
    scenes.write_text(f"<!doctype html><title>Scene files</title>{to_html(page())}", encoding="utf-8")
    print(f"open {folder / 'index.html'} and {scenes}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
