"""Output of `analysis fit`: printed lines, the figure of residuals and the fitted scene."""

import warnings
from collections.abc import Callable, Sequence
from math import isnan
from pathlib import Path

from analysis.commands.figures.fit_figure import fit_figure
from analysis.core.fitting.fit import Fit, fit
from rig.core.base.console import show_activity
from rig.core.base.errors import RunError, SceneError
from rig.core.base.figure_style import save_figure
from rig.core.base.output_files import allow_overwriting, atomic_write, prepare_outputs
from rig.core.results.table import Table
from rig.core.results.text import format_interval
from rig.core.scene.scene import Scene


def present_fit(
    recordings: Sequence[Path],
    scene: Scene,
    free: Sequence[str] | None,
    output: Path,
    overwrite: bool,
    print_line: Callable[[str], None],
) -> tuple[list[Path], tuple[str, ...]]:
    """Fit a scene to recordings; print the result, write the figure of residuals and, if the fit agrees, the scene.

    Raises `SceneError` if the output exists, or the fit is impossible. Raises `RunError` if the scene does not fit
    the recordings; the figure is written nevertheless.
    """
    if output.suffix not in (".yaml", ".yml"):
        raise SceneError(f"--output {output}: not the name of a scene file. Give a name such as fitted.yaml.")
    with allow_overwriting(overwrite):
        residuals = output.with_name(f"{output.stem}-residuals")
        prepare_outputs(output, *(residuals.with_name(f"{residuals.name}.{ending}") for ending in ("png", "svg")))
        with show_activity() as report:
            result = fit(list(recordings), scene, free, report)
        # The figure of residuals shows where the scene fails, so it is written before the error.
        files = save_figure(fit_figure(result), residuals)
        if result.misfit:
            for warning in result.warnings:
                warnings.warn(warning, stacklevel=2)
            for path in files:
                print_line(f"wrote {path}")
            raise RunError(f"{output}: not written, because the scene does not fit the recordings. {result.misfit}")
        for line in describe(result):
            print_line(line)
        with atomic_write(output) as part:
            part.write_text(result.scene.to_yaml(), encoding="utf-8")
        return [output, *files], result.warnings


def describe(result: Fit) -> list[str]:
    """Return the printed lines: fitted values, sensors, modes and residuals, with 95 % intervals."""
    sensors = [("sensor", "sensitivity deviation / %")] + [
        (name, format_interval(100 * deviation, 100 * expanded))
        for name, (deviation, expanded) in result.sensitivities.items()
    ]
    modes = [("mode of the structure", "frequency / Hz", "damping ratio / %")] + [
        (
            str(number),
            format_interval(mode.frequency, mode.frequency_expanded),
            format_interval(100 * mode.damping, 100 * mode.damping_expanded),
        )
        for number, mode in enumerate(result.modes, 1)
    ]
    levels = [("sweep", "dampers", "largest acceleration / (m/s²)", "damping")]
    for level in result.damping:
        damping = ", ".join(
            "undetermined" if isnan(value) else format_interval(value, expanded)
            for value, expanded in zip(level.value, level.expanded, strict=True)
        )
        levels.append(
            (level.label, "can move" if level.dampers_move else "cannot move", f"{level.acceleration:.3g}", damping)
        )
    residuals = [("sweep", "residual / % of the curves, rms")] + [
        (comparison.curves.label, f"{100 * comparison.relative:.2g}") for comparison in result.compared
    ]
    tables = ((sensors, "<>"), (modes, "<>>"), (levels, "<<>>"), (residuals, "<>"))
    lines = [f"{result.summary()} (95 % intervals)", *result.table().lines("  ")]
    for (heading, *rows), alignment in tables:
        lines += Table(heading, alignment, rows).lines("  ")
    return lines + [f"  {line}" for line in result.together]
