"""Draw the motion of a damper of each type in two periods: `python -m tests.type_picture PICTURE.png`."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import rig
from rig.core.base.figure_style import save_figure, use_style
from rig.core.base.palette import BODIES, DAMPER

# A frequency of each type at 3.3 N, Hz.
FREQUENCIES = (48.0, 50.0, 49.0)
# Largest gap in contact, mm: rounding errors are smaller.
CONTACT_MM = 1e-6


def draw(picture: str) -> None:
    """Draw floor, damper and ceiling over two periods for each frequency."""
    use_style()
    scene = rig.load("fig9", {"shaker": {"kind": "force", "body": 1}, "channels": None})
    body, clearance = scene.dampers[0].body, scene.dampers[0].clearance
    panels = plt.subplots(1, 3, sharey=True, figsize=(7.2, 2.6), layout="constrained")[1]
    for axes, frequency in zip(panels, FREQUENCIES, strict=True):
        orbit = rig.periodic_orbit(scene, frequency)
        columns = orbit.columns()
        first = columns["time_s"] - columns["time_s"][0]
        time = 1e3 * np.append(first, first + 1.0 / frequency)
        floor, gap = (1e3 * np.tile(columns[name], 2) for name in (f"body {body}_m", "gap 1_m"))
        axes.fill_between(
            time, floor - 0.2, floor, color=BODIES[body - 1], lw=0, alpha=0.55, label="floor and ceiling of the body"
        )
        axes.fill_between(
            time, floor + 1e3 * clearance, floor + 1e3 * clearance + 0.2, color=BODIES[body - 1], lw=0, alpha=0.55
        )
        axes.plot(time, floor + gap, color=DAMPER, lw=2.0, label="damper in flight")
        touches = np.minimum(gap, 1e3 * clearance - gap) < CONTACT_MM
        axes.plot(time, np.where(touches, floor + gap, np.nan), "k", lw=3.5, label="damper in contact")
        axes.set(title=f"Type {orbit.motion_type}: {frequency:g} Hz, 3.3 N", xlabel="time / ms")
    panels[0].set_ylabel("height / mm")
    panels[0].figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    save_figure(panels[0].figure, Path(picture).with_suffix(""))


if __name__ == "__main__":
    draw(sys.argv[1])
