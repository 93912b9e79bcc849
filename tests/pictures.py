"""Draw the pictures of README and guides again: `python -m tests.pictures [NAME.png ...]`."""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "recordings"
#: Commands for each picture; they write to the folder or file OUT, and the picture is the file that matches.
PICTURES = {
    "bench.png": ("tests.browser_picture bench OUT/bench.png", "bench.png"),
    "bracket.png": (
        "rig design OUT/bracket.yaml --budget 60g --bodies 2 --levels 4N --band 55Hz,70Hz -o OUT",
        "design-*.png",
    ),
    "compliance.png": ("analysis demo -o OUT", "fig8-*-frf-body3.png"),
    "cost.png": ("rig cost fig9 -o OUT", "cost-*.png"),
    "design.png": ("rig design fig9 --budget 100g --levels 1.5N,3N,6N -o OUT", "design-*.png"),
    "fine.png": (
        "daq record OUT/bracket.yaml -o OUT/fine.mcap --set test.from=55Hz --set test.to=70Hz --set test.points=69 "
        "--set test.spacing=linear; analysis frf OUT/fine.mcap",
        "fine-frf.png",
    ),
    "map.png": ("rig map fig9 -o OUT", "map-*.png"),
    "report.png": (
        "analysis report recordings/demo-sweep-no-damper.mcap recordings/demo-sweep-three-dampers.mcap "
        "-o OUT/report.html; tests.browser_picture OUT/report.html OUT/report.png",
        "report.png",
    ),
    "replay.png": (
        "daq record fig10b-three-dampers --set test.repeats=1 --set test.interval=1s --set recording.truth=true "
        "-o OUT/hit.mcap; "
        "daq replay OUT/hit.mcap --at 0.36 --screenshot OUT/replay.png",
        "replay.png",
    ),
    "types.png": ("tests.type_picture OUT/types.png", "types.png"),
}


def draw(name: str, folder: Path) -> Path:
    """Run the command of a picture in an empty folder; return the picture."""
    commands, pattern = PICTURES[name]
    tutorial = (ROOT / "analysis" / "guide" / "tutorial.md").read_text(encoding="utf-8")
    scene = tutorial.split("```yaml\n")[1].split("```")[0]
    (folder / "bracket.yaml").write_text(scene, encoding="utf-8")
    for command in commands.replace("OUT", str(folder)).split("; "):
        subprocess.run([sys.executable, "-m", *command.split()], cwd=ROOT, check=True)
    (picture,) = folder.glob(pattern)
    return picture


if __name__ == "__main__":
    for chosen in sys.argv[1:] or PICTURES:
        with tempfile.TemporaryDirectory() as temporary:
            shutil.copy(draw(chosen, Path(temporary)), FOLDER / chosen)
