"""Draw the pictures of README and guides again: `python -m tests.pictures [NAME.png ...]`."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "recordings"
#: Command for each picture; the command writes to the folder or file OUT, and the picture is the file that matches.
PICTURES = {
    "compliance.png": ("analysis demo -o OUT", "fig8-*-frf-body3.png"),
    "cost.png": ("rig cost fig9 -o OUT", "cost-*.png"),
    "design.png": ("rig design fig9 --budget 100g --levels 1.5N,3N,6N -o OUT", "design-*.png"),
    "map.png": ("rig map fig9 -o OUT", "map-*.png"),
    "replay.png": ("daq replay DEMO --screenshot OUT/replay.png", "replay.png"),
}


def draw(name: str, folder: Path) -> Path:
    """Run the command of a picture in an empty folder; return the picture."""
    command, pattern = PICTURES[name]
    demo = FOLDER / "demo-impulse-three-dampers.mcap"
    program, *arguments = command.replace("OUT", str(folder)).replace("DEMO", str(demo)).split()
    subprocess.run([sys.executable, "-m", program, *arguments], cwd=ROOT, check=True)
    (picture,) = folder.glob(pattern)
    return picture


if __name__ == "__main__":
    for chosen in sys.argv[1:] or PICTURES:
        with tempfile.TemporaryDirectory() as temporary:
            shutil.copy(draw(chosen, Path(temporary)), FOLDER / chosen)
