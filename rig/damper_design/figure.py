"""A design as figures, a scene and a few lines of text."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.damper_design.choice import Choice
from rig.damper_design.design import Design
from rig.escaping import drawn
from rig.motion_map.figure import edges
from rig.output_files import replacing, stem
from rig.scene.scene import STANDARD_GRAVITY

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
BLUE, GREY, RED = "#1b4f7e", "#b0b0b0", "#c0392b"


def told(choice: Choice) -> str:
    """Say what a choice is.

    >>> told(Choice((2,), (0.0451,), (1.18e-3,)))
    '45.1 g in body 2, clearance 1.18 mm'
    """
    each = zip(choice.masses, choice.bodies, choice.clearances, strict=True)
    return "; ".join(f"{1e3 * m:.3g} g in body {b}, clearance {1e3 * c:.3g} mm" for m, b, c in each)


def summary(design: Design) -> str:
    """Say which dampers are best, what they do, what lighter ones would, and where the search found its limits."""
    best, question = design.best, design.question
    levels = ", ".join(f"{level:.3g}" for level in question.levels)
    simulated = best.peak.simulated
    lines = [
        f"{design.scene.name}: {len(design.trials)} designs at {levels} N, {question.band[0]:.4g} to "
        f"{question.band[1]:.4g} Hz"
        + (f", {len(question.scenes)} structures" if len(question.scenes) > 1 else ""),
        "",
        f"best: {told(best.choice)}",
        f"worst peak {1e6 * best.peak.size:.4g} um/N (body {best.peak.body}, {best.peak.frequency:.2f} Hz, "
        f"{best.peak.level:.3g} N): {design.reduction(best.peak):.1f} dB below the bare structure's "
        f"{1e6 * design.bare.size:.4g} um/N",
        "",
        f"{'added mass, g':>14}{'reduction, dB':>15}  dampers",
    ]
    lines += [
        f"{1e3 * trial.choice.mass:14.1f}{design.reduction(trial.peak):15.1f}  {told(trial.choice)}"
        for trial in design.front
    ]
    if simulated > 0.0:
        lines += [
            "",
            f"{simulated:.0%} of that curve is irregular motion, averaged over periods: good to some percent",
        ]
    low, high = design.space.clearance
    for clearance in best.choice.clearances:
        for bound, name in ((low, "smallest"), (high, "largest")):
            if abs(np.log(clearance / bound)) < 0.02:
                lines += ["", f"the best clearance is the {name} that was allowed: allow more (--clearance)"]
    return "\n".join(lines)


def write(design: Design, folder: Path) -> list[Path]:
    """Write the scene with the best dampers and the figures into a folder that exists.

    Raises
    ------
    SceneError
        If a file cannot be written.
    """
    name = folder / stem("design", design.scene.name)
    scene = name.with_suffix(".yaml")
    with replacing(scene) as part:
        part.write_text(design.scene.to_yaml(), encoding="utf-8")
    figure = _draw(design)
    pictures = [name.with_suffix(".png"), name.with_suffix(".svg")]
    for file in pictures:
        with replacing(file) as part:
            figure.savefig(part, dpi=160)
    return [scene, *pictures]


def next_step(scene: Path) -> str:
    """Say how to check a design."""
    recording = scene.with_suffix(".mcap")
    record, analyse = (
        f"daq record {quote(str(scene))} -o {quote(str(recording))}",
        f"analysis frf {quote(str(recording))}",
    )
    return f"check it: {record}, then: {analyse}"


def _draw(design: Design) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
    (front, chart), (master, backbone) = figure.subplots(2, 2)
    _front(front, design)
    _chart(chart, design)
    _master_curve(master, design)
    _backbone(backbone, design)
    figure.suptitle(f"{drawn(design.scene.name)}: {told(design.best.choice)}", fontsize=11)
    return figure


def _front(axes: Axes, design: Design) -> None:
    mass = np.array([1e3 * trial.choice.mass for trial in design.trials])
    size = np.array([design.reduction(trial.peak) for trial in design.trials])
    axes.plot(mass, size, "o", color=GREY, ms=3, label="tried")
    front = design.front
    axes.plot(
        [1e3 * trial.choice.mass for trial in front], [design.reduction(trial.peak) for trial in front], "o-",
        color=BLUE, ms=5, label="best for its mass",
    )  # fmt: skip
    axes.set(xlabel="added mass, g", ylabel="reduction of the worst peak, dB", xlim=(0.0, None))
    axes.legend(frameon=False, fontsize=9)


def _chart(axes: Axes, design: Design) -> None:
    reduction = np.array([[design.reduction(peak) for peak in row] for row in design.chart])
    clearance = 1e3 * design.clearance_factors * design.best.choice.clearances[0]
    mesh = axes.pcolormesh(
        edges(design.levels, True), edges(clearance, True), reduction, cmap="viridis", rasterized=True
    )
    bar = axes.figure.colorbar(mesh, ax=axes, pad=0.02)
    bar.set_label("reduction at this level, dB")
    levels = design.question.levels
    axes.plot(
        [min(levels), max(levels)], [1e3 * design.best.choice.clearances[0]] * 2, "-", color=RED, lw=2.0,
        label="chosen, at the levels asked for",
    )  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="force, N", ylabel="clearance, mm")
    if len(design.best.choice.clearances) > 1:
        axes.set_ylabel("clearance of the first damper, mm (the others in proportion)")
    for axis in (axes.xaxis, axes.yaxis):
        _plain_ticks(axis)
    axes.legend(frameon=True, fontsize=8, loc="upper left")


def _master_curve(axes: Axes, design: Design) -> None:
    """Peak reduction against the acceleration that the damper sees, for each clearance."""
    chosen = int(np.argmin(np.abs(np.log(design.clearance_factors))))
    for number in (chosen - 1, chosen, chosen + 1):
        row = design.chart[number]
        clearance = 1e3 * design.clearance_factors[number] * design.best.choice.clearances[0]
        acceleration = [peak.acceleration / STANDARD_GRAVITY for peak in row]
        axes.plot(
            acceleration, [design.bare.size / peak.size for peak in row], "o-", ms=4,
            color=BLUE if number == chosen else GREY, mfc="white" if number < chosen else None,
            label=f"clearance {clearance:.3g} mm",
        )  # fmt: skip
    axes.set(
        xscale="log", xlabel="acceleration at the peak, g", ylabel="peak without dampers / peak with them"
    )
    _plain_ticks(axes.xaxis)
    axes.set_ylim(0.0, None)
    axes.axhline(1.0, color="black", lw=0.8)
    axes.legend(frameon=False, fontsize=9)


def _backbone(axes: Axes, design: Design) -> None:
    chosen = int(np.argmin(np.abs(np.log(design.clearance_factors))))
    row = design.chart[chosen]
    axes.plot([peak.frequency for peak in row], design.levels, "o-", color=BLUE, ms=4, label="with dampers")
    axes.axvline(design.bare.frequency, color=GREY, ls="--", label="without")
    axes.set(yscale="log", xlabel="frequency of the largest peak, Hz", ylabel="force, N")
    _plain_ticks(axes.yaxis)
    axes.legend(frameon=False, fontsize=9)


def _plain_ticks(axis: Axis) -> None:
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(_label_1_2_5)


def _label_1_2_5(value: float, _: float) -> str:
    """Label 2 and 5 of each decade.

    >>> _label_1_2_5(0.5, 0), _label_1_2_5(3.0, 0)
    ('0.5', '')
    """
    leading = value / 10.0 ** np.floor(np.log10(value) + 1e-9)
    return f"{value:g}" if round(leading, 6) in (2.0, 5.0) else ""
