"""Output of `analysis fit`: printed lines, the figure of residuals and the fitted scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isnan
from pathlib import Path

from analysis.fitting.figure import fit_figure
from analysis.fitting.fit import Fit, fit
from rig.errors import RunError, SceneError
from rig.figure_style import save_figure
from rig.output_files import atomic_write, create_folder
from rig.provenance import allow_overwriting, output_source, reject_foreign_files, relative_paths
from rig.results import format_quantity
from rig.scene.scene import Scene


def present_fit(
    recordings: Sequence[Path],
    scene: Scene,
    free: Sequence[str] | None,
    output: Path,
    overwrite: bool,
    say: Callable[[str], None],
) -> tuple[list[Path], tuple[str, ...]]:
    """Fit a scene to recordings; print the result, write the figure of residuals, and the scene if it fits.

    Raises `SceneError` if the output exists, or the fit is impossible. Raises `RunError` if the scene does not fit
    the recordings; the figure is written nevertheless.
    """
    if output.suffix not in (".yaml", ".yml"):
        raise SceneError(
            f"--output {output}: not the name of a scene file. Choose a name such as fitted.yaml."
        )
    with (
        allow_overwriting(overwrite),
        output_source("fit", scene.to_yaml(), *relative_paths(recordings, output.parent)),
    ):
        residuals = output.with_name(f"{output.stem}-residuals")
        create_folder(output.parent)
        reject_foreign_files(
            output, *(residuals.with_name(f"{residuals.name}.{ending}") for ending in ("png", "svg"))
        )
        found = fit(list(recordings), scene, free)
        files = save_figure(fit_figure(found), residuals)
        if found.misfit:
            for path in files:
                say(f"wrote {path}")
            raise RunError(
                f"{output}: not written, because the scene does not fit the recordings. {found.misfit}"
            )
        for line in describe(found):
            say(line)
        with atomic_write(output) as part:
            part.write_text(found.scene.to_yaml(), encoding="utf-8")
        return [output, *files], found.warnings


def describe(found: Fit) -> list[str]:
    """Lines with values and 95 % intervals, sensors, modes, undetermined combinations and residuals."""
    width = max(len(one.key) for one in found.parameters)
    lines = [f"{found.summary()} (95 % intervals)"]
    for one in found.parameters:
        value, tail = f"{one.value:.6g} {one.unit}".strip(), "unchanged"
        if one.status != "undetermined":
            value = format_quantity(one.value, one.half_width * abs(one.value), one.unit).strip()
            tail = f"from {one.start:.4g}"
        lines.append(f"  {one.key:{width}}  {value:30} {one.status:10} {tail}")
    for name, (deviation, bound) in found.sensitivities.items():
        lines.append(f"  sensitivity error of {name}: {format_quantity(100 * deviation, 100 * bound, '%')}")
    for number, mode in enumerate(found.modes, 1):
        lines.append(
            f"  mode {number} of the structure: {format_quantity(mode.frequency, mode.frequency_bound, 'Hz')}, "
            f"damping ratio {format_quantity(100 * mode.damping, 100 * mode.damping_bound, '%')}"
        )
    for level in found.damping:
        beneath = "with its dampers" if level.damped else "without dampers"
        values = ", ".join(
            "undetermined" if isnan(v) else f"{v:.4g} ± {b:.1g}"
            for v, b in zip(level.value, level.bound, strict=True)
        )
        lines.append(f"  {level.label}, {beneath}, up to {level.acceleration:.3g} m/s²: damping {values}")
    residuals = (
        f"{one.curves.label}: residual {one.relative:.2%} of the curves (rms)" for one in found.compared
    )
    return lines + [f"  {line}" for line in (*found.together, *residuals)]
