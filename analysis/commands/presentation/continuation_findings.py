"""Output of `analysis continuation`: response curves with folds, and the exact orbits of the scene."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from analysis.commands.presentation.figures_of_recordings import present_each
from analysis.commands.presentation.outputs import CommandOutput, with_recording_name
from analysis.core.recordings.opening import OpenRecordings, with_recordings
from analysis.core.tracking.body_motion import common_error_text, draw_common_error
from analysis.core.tracking.continuation import AmplitudeCurve, continuation
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.base.figure_style import add_legend_below
from rig.core.base.figure_types import Axes, Figure
from rig.core.orbits.branches import follow_orbits
from rig.core.orbits.orbit_curve import OrbitBranch
from rig.core.results import format_number

_EXACT_COLOR = "#777777"


class ExactBranch(NamedTuple):
    """A branch of exact orbits."""

    level: float  # level in the unit of the test
    branch: OrbitBranch
    amplitude: Array  # m, shape (orbits,)


def exact_branches(rec: Recording, result: AmplitudeCurve) -> list[ExactBranch]:
    """Compute the orbits of the recording's scene at each level of a result, over the band of its test."""
    scene, test = rec.scene, rec.scene.test
    assert test is not None and test.band is not None
    body = scene.structure.labels.index(result.body)
    branches = []
    for level in dict.fromkeys(result.level.tolist()):
        tone = {"kind": "sine", "frequency": test.band[0], test.level_key: level, "shaker": test.driven}
        curve = follow_orbits(scene.replace(test=tone, channels=None), "frequency", test.band)
        for branch in curve.branches:
            reference = np.array([orbit.reference_amplitude for orbit in branch.orbits])
            branches.append(ExactBranch(level, branch, abs(branch.frf[body]) * reference))
    return branches


@with_recordings
def present_continuation(
    recordings: OpenRecordings, paths: Sequence[Path], output: Path | None = None, theory: bool = False
) -> CommandOutput:
    """Draw and tabulate each recording; `theory`: add the exact orbits of its scene."""
    exact: list[ExactBranch] = []
    warnings: list[str] = []

    def evaluate(rec: Recording) -> AmplitudeCurve:
        result = continuation(rec)
        exact[:] = exact_branches(rec, result) if theory else []
        remedy = "Increase test.settle.longest, or reduce test.step."
        warnings.extend(with_recording_name(rec.path, [f"{text}. {remedy}" for text in result.omissions()]))
        return result

    def draw(result: AmplitudeCurve, figure: Figure, axes: Axes) -> None:
        # Exact curves show the order of the points.
        (result.draw_points if exact else result.draw)(axes)
        line: dict[str, Any] = {"color": _EXACT_COLOR, "lw": 1.0}
        for _, branch, amplitude in exact:
            for dashes, selected in (("-", branch.stable), ((0, (3, 2)), ~branch.stable)):
                # One more point at either end joins the stable and the unstable part.
                joined = selected | np.roll(selected, 1) | np.roll(selected, -1)
                axes.plot(branch.value, np.where(joined, 1e3 * amplitude, np.nan), ls=dashes, zorder=1, **line)
        for dashes, name in (("-", "exact, stable"), ((0, (3, 2)), "exact, unstable")) if exact else ():
            axes.plot([], [], ls=dashes, label=name, **line)
        omissions = [f"{text}." for text in result.omissions()]
        computed = ["Exact: computed from the scene."] * bool(exact)
        amplitudes = result.amplitude, result.amplitude_own, result.amplitude_expanded
        common = common_error_text(*amplitudes)
        draw_common_error(axes, result.frequency, *(1e3 * column for column in amplitudes))
        bar = "Gray bar: including these tolerances, at the first point." * bool(common)
        add_legend_below(figure, "Bars: 95 % intervals.", common, bar, *computed, *omissions)

    title = "Response at constant level"
    written = present_each(
        recordings, paths, output, "continuation", title, evaluate, draw, lambda result: fold_lines(result, exact)
    )
    return replace(written, warnings=tuple(warnings))


def fold_lines(result: AmplitudeCurve, exact: Sequence[ExactBranch]) -> list[str]:
    """Return a table of the folds with the nearest folds of the exact orbits, and the smallest resolved distance."""
    nearest: list[str] = []
    for fold in result.folds:
        values = [value for each in exact if each.level == fold.level for value in each.branch.folds.tolist()]
        nearest.append(f"{min(values, key=lambda value: abs(value - fold.frequency)):.5g}" if values else "")
    resolutions = {level: result.resolution(level) for level in dict.fromkeys(result.level.tolist())}
    widths = ", ".join(
        f"{resolution:.2g} Hz at {format_number(level)} {result.unit}"
        for level, resolution in resolutions.items()
        if np.isfinite(resolution)
    )
    limits = [f"  Steps do not resolve folds closer than {widths}."] if widths else []
    return [*result.table(nearest).lines("  "), *limits]
