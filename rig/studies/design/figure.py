"""Output of `rig design`: text summary, figures, and a scene file with a test that checks the design."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import NamedTuple

import numpy as np

from rig.core.base.figure_style import add_page_title, cell_edges, new_figure, save_figure, set_log_scale
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.output_files import atomic_write, file_stem
from rig.core.base.palette import BASELINE, RECORDINGS
from rig.core.orbits.problem import OrbitProblem
from rig.core.results import format_decimals, format_number, format_percent
from rig.core.scene.damper import Damper
from rig.core.scene.excitation import FORCE_TOLERANCE
from rig.core.scene.scene import Scene
from rig.core.system.reference import linear_response
from rig.studies.design.check import Expected
from rig.studies.design.choice import FINE_DENSITY, Choice, mass_unit
from rig.studies.design.design import Design
from rig.studies.design.overloads import overload_lines, predict_overloads
from rig.studies.design.ranking import EQUAL_DB, IRREGULAR_RATIO, MIN_MACHINABLE_CLEARANCE
from rig.studies.design.tuned_mass import TunedMass
from rig.studies.design.worst_peak import response_at_level

#: Colors, line styles and markers of the responses with dampers, for successive levels. The numbers of each have no
#: common factor, so the styles of 60 levels differ.
LEVEL_COLORS = RECORDINGS[:3]
_LEVEL_LINES = "-", "--", "-.", ":"
_LEVEL_MARKERS = "os^Dv"
# Number of frequencies of the drawn response without dampers: about one per pixel.
_RESPONSE_POINTS = 800
#: A clearance or mass is at a limit of the search if it differs from the limit by at most this fraction.
LIMIT_TOLERANCE = 0.02
_OTHER_MOTION = (
    "At one frequency several steady-state motions may exist. The design assumes the motion with the largest "
    "response; a test that measures a smaller response has settled to a different motion."
)


def summary(design: Design) -> str:
    """Summarize the best dampers, their effect on every mode, and the best lighter designs."""
    best, objective, space = design.best, design.question, design.space
    levels = ", ".join(format_number(level) for level in objective.levels)
    smallest, largest = (format_number(1e3 * clearance) for clearance in space.clearance)
    lines = [
        f"{design.scene.name}: {len(design.trials)} designs at {levels} {objective.level.unit}, "
        f"{objective.band[0]:.4g} to {objective.band[1]:.4g} Hz"
        + (f", {len(objective.scenes)} structures" if len(objective.scenes) > 1 else ""),
        f"clearances searched: {smallest} to {largest} mm{', and no ceiling' if space.allows_no_ceiling else ''}",
        "",
        str(objective.impact_law),
        "",
        *_verdict(design),
        "",
        *_tables(design),
    ]
    shares = [100.0 * peak.irregular_share for peak in best.peaks]
    if any(shares):
        percentages = ", ".join(f"{share:.0f}" for share in shares)
        lines += [
            "",
            f"at {levels} {objective.level.unit}, the motion is irregular at {percentages} % of the frequencies; the "
            f"{objective.response_display[0]} at these frequencies is an average, accurate to a few percent",
        ]
    for searched, name in zip(space.clearance, ("smallest", "largest"), strict=True):
        if any(abs(np.log(clearance / searched)) < LIMIT_TOLERANCE for clearance in best.choice.clearances):
            lines += [
                "",
                f"the chosen clearance is the {name} of the searched range. Search a wider range with --clearance.",
            ]
    return "\n".join(lines)


def _verdict(design: Design) -> list[str]:
    """Report the dampers, their worst peak and the tolerance of the clearance, or that no dampers are effective."""
    peak, (_, unit, factor) = design.best.peak, design.question.response_display
    reduction = design.reduction(peak)
    below_or_above = "below" if reduction > 0.0 else "above"
    heading = (
        "best" if design.serves else "no design reduces the largest peak at every one of these levels; best design"
    )
    lines = [
        f"{heading}: {design.best.choice}",
        f"largest peak {factor * peak.magnitude:.4g} {unit} (body {peak.body}, {format_decimals(peak.frequency, 2)} "
        f"Hz, {format_number(peak.level)} {design.question.level.unit}): {abs(reduction):.1f} dB {below_or_above} the "
        f"bare structure's {factor * design.bare.magnitude:.4g} {unit}",
        *design.shortfall,
    ]
    if design.serves:
        lines.append(str(design.tolerance))
    if design.tuned is not None:
        lines.append(_comparison_with_tuned_mass(design, design.tuned))
    height = design.flight.height
    if 0.0 < height < max(design.best.choice.clearances):
        lines.append(
            f"a ceiling at more than {format_number(1000.0 * height)} mm has no effect, because no damper reaches it "
            "in the band"
        )
    if min(design.best.choice.clearances) < MIN_MACHINABLE_CLEARANCE:
        smallest = f"{1000.0 * MIN_MACHINABLE_CLEARANCE:g} mm"
        lines.append(
            f"clearances below {smallest} are hard to build. Designs with larger clearances are easier to build, but "
            "less effective. To exclude small clearances, give `clearance`."
        )
    return lines


def _comparison_with_tuned_mass(design: Design, tuned: TunedMass) -> str:
    """Return a sentence on the reduction by a tuned mass damper instead; it is linear, so it is equal at all levels."""
    advantages = [design.reduction(tuned.peak) - design.reduction(peak) for peak in design.best.peaks]
    low, high = (format_decimals(abs(limit), 1) for limit in (min(advantages), max(advantages)))
    if min(advantages) >= 0.0:
        difference = f"{low} to {high} dB lower" if low != high else f"{high} dB lower"
    elif max(advantages) <= 0.0:
        difference = f"{high} to {low} dB higher" if low != high else f"{low} dB higher"
    else:
        difference = f"between {low} dB higher and {high} dB lower, depending on the level,"
    return f"with a tuned mass damper of the same mass, the largest peak is {difference} than with these dampers"


def _tables(design: Design) -> list[str]:
    """Return two tables with the levels as columns: reductions by the best dampers of each mass, peaks of modes."""
    factor, unit = mass_unit(max(trial.choice.mass for trial in design.front))
    level_unit, (_, response_unit, scale) = design.question.level.unit, design.question.response_display
    levels = "".join(f"{f'{format_number(level)} {level_unit}':>9}" for level in design.question.levels)
    lines = [f"{'':14}  reduction in dB at", f"{f'added mass, {unit}':>14}{levels}  dampers"]
    for trial in design.front:
        reductions = "".join(f"{design.reduction(peak):9.1f}" for peak in trial.peaks)
        lines.append(f"{format_decimals(factor * trial.choice.mass, 1):>14}{reductions}  {trial.choice}")
    if design.tuned is not None:
        reductions = f"{design.reduction(design.tuned.peak):9.1f}" * len(design.question.levels)
        mass = format_decimals(factor * design.best.choice.mass, 1)
        lines.append(f"{mass:>14}{reductions}  for comparison, linear: {design.tuned}")
    lines.append(_accuracy_of_reductions(design))
    lines += ["", f"{'':14}  largest peak in {response_unit}", f"{'mode, Hz':>14}{'without':>10}{levels}"]
    for mode in design.modes:
        peaks = "".join(f"{scale * peak.magnitude:9.4g}" for peak in mode.damped)
        remark = "" if mode.in_band else "  outside the band"
        lines.append(f"{format_decimals(mode.frequency, 2):>14}{scale * mode.undamped.magnitude:10.4g}{peaks}{remark}")
    return lines


def _accuracy_of_reductions(design: Design) -> str:
    """Return the numerical accuracy of the reductions, and the assumptions under which it is valid."""
    is_irregular = any(peak.irregular_share for trial in design.front for peak in trial.peaks)
    averages = f", {20.0 * np.log10(IRREGULAR_RATIO):.1f} dB where the motion is irregular" if is_irregular else ""
    return (
        f"accuracy of the computed reductions: {EQUAL_DB:g} dB{averages}; for the values of the scene and beds that "
        "move as one mass"
    )


def write(design: Design, folder: Path) -> list[Path]:
    """Write scene and figures of the best dampers into an existing folder; raise `SceneError` if this fails."""
    name = folder / file_stem("design", design.scene.name)
    scene = name.with_suffix(".yaml")
    with atomic_write(scene) as temporary:
        temporary.write_text(design.scene.to_yaml(), encoding="utf-8")
        figures = save_figure(_draw(design), name)
    return [scene, *figures]


def describe_check(design: Design, scene: Path) -> str:
    """Describe the test in the scene of a design, its expected results, and the commands to run it."""
    test = design.scene.test
    assert test is not None and test.band is not None
    level, display = design.question.level, design.question.response_display
    levels = ", ".join(map(format_number, test.levels))
    bare = f"test.{level.name}={format_number(test.levels[0])}{level.kind.si}"
    overloads = predict_overloads(design.scene, design.expected, design.bare, level.unit)
    remedies = "".join(f" --set {quote(change)}" for overload in overloads for change in overload.changes)
    finite_contact = all(damper.contact is not None for damper in design.scene.dampers)
    locations = {channel.name: channel.at for channel in design.scene.channels or ()}
    added = ", ".join(f"{name} (at {locations[name]})" for name in design.added_channels)
    file, with_dampers, without_dampers = (
        quote(str(path)) for path in (scene, scene.with_suffix(".mcap"), scene.with_name(f"{scene.stem}-without.mcap"))
    )
    return "\n".join(
        [
            (
                f"{scene}: the scene with these dampers and a test of the design, a stepped sine from "
                f"{test.band[0]:.4g} to {test.band[1]:.4g} Hz at {levels} {level.unit} around the largest peaks "
                "with and without dampers"
            ),
            *([f"channels that this test has in addition to those of the scene: {added}"] if added else []),
            "",
            f"expected largest peaks in {display[1]}: for a sinusoidal {level.name}, as in the design, and in this "
            "test (with limits).",
            f"In the test, {_accuracy_of_level(design.scene)}the motion is measured when it is steady within "
            f"{format_percent(test.steady_state.tolerance)}.",
            *([_OTHER_MOTION] if any(map(_has_other_motion, design.expected)) else []),
            f"{f'{level.name}, {level.unit}':>14}{'peak of':>9}{'at Hz':>9}{'sinusoidal':>15}  this test",
            *(_expected_line(expected, display[2]) for expected in design.expected),
            *overload_lines(overloads, finite_contact),
            "",
            "to check the design, record and compare tests without and with dampers:",
            f"daq record {file} --set dampers=null --set {quote(bare)}{remedies} -o {without_dampers}",
            f"daq record {file}{remedies} -o {with_dampers}",
            f"analysis frf {without_dampers} {with_dampers}",
            f"analysis compare {without_dampers} {with_dampers}",
            "",
            *(grain_check(design.scene.dampers, design.expected, scene) if level.name == "force" else []),
        ]
    )


def _accuracy_of_level(scene: Scene) -> str:
    """Return the first clause of a sentence about the force of a test: its accuracy, and harmonics by a coil spring."""
    if scene.level_key != "force":
        return ""
    spring = None if scene.driven_shaker is None else scene.driven_shaker.coil_spring
    harmonics = "" if spring is None else "the coil spring adds harmonics to the force, "
    return f"{harmonics}the force is accurate to {format_percent(FORCE_TOLERANCE)} and "


def _has_other_motion(expected: Expected) -> bool:
    """Return whether the largest peak is above the range that the test should measure."""
    return expected.magnitudes is not None and expected.peak.magnitude > expected.magnitudes[2]


def _expected_line(expected: Expected, factor: float) -> str:
    peak = expected.peak
    in_this_test = "no steady state, so measured values scatter"
    if expected.magnitudes is not None:
        low, nominal, high = (f"{factor * magnitude:.4g}" for magnitude in expected.magnitudes)
        in_this_test = f"{nominal} ({low} to {high})"
    operating_point = f"{format_number(peak.level):>14}{f'body {peak.body}':>9}{format_decimals(peak.frequency, 2):>9}"
    return f"{operating_point}{factor * peak.magnitude:15.4g}  {in_this_test}"


def _draw(design: Design) -> Figure:
    with new_figure(6.5, 9.0) as figure:
        (front, chart), (reductions, responses) = figure.subplots(2, 2)
        design.draw(front)
        front.legend()
        _draw_chart(chart, design)
        _draw_reductions(reductions, design)
        _draw_responses(responses, design)
        levels = ", ".join(map(format_number, design.question.levels))
        is_all = design.best.choice.mass > (1.0 - LIMIT_TOLERANCE) * design.space.max_mass
        add_page_title(
            figure,
            f"Design (computed): {headline(design)}",
            # The part of the name after a comma may describe the dampers that the design replaces.
            f"{design.scene.name.partition(',')[0]}; largest peak at {levels} {design.question.level.unit} without and "
            f"with dampers; shot as one mass{'; mass at the budget' * is_all}",
        )
        return figure


def _draw_chart(axes: Axes, design: Design) -> None:
    """Draw the reduction of the worst peak against level and clearance (the chart of the design)."""
    reduction = np.array([[design.reduction(peak) for peak in row] for row in design.chart])
    choice = design.charted
    chosen = choice.clearances[choice.heaviest_index]
    clearance = design.clearance_factors * chosen
    borders = cell_edges(design.levels, True), cell_edges(clearance, True)
    mesh = axes.pcolormesh(*borders, reduction, cmap="viridis", rasterized=True)
    axes.figure.colorbar(mesh, ax=axes, pad=0.02, label=f"reduction at this {design.question.level.name} / dB")
    levels = design.question.levels
    label = "chosen" if design.best.choice.has_ceiling else "largest searched"
    axes.plot(levels, [chosen] * len(levels), "o-", color="white", lw=4.0, ms=9)
    axes.plot(
        levels, [chosen] * len(levels), "o-", color=BASELINE, lw=2.0, ms=6, label=f"{label}: {1e3 * chosen:.3g} mm"
    )
    axes.grid(False)
    axes.set(xlabel=design.question.level.label, ylabel=clearance_label(choice))
    set_log_scale(axes.xaxis)
    set_log_scale(axes.yaxis, factor=1e3)
    axes.set(xlim=borders[0][[0, -1]], ylim=borders[1][[0, -1]])
    # The legend is outside the axes, because inside it would hide cells.
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
    axes.set_title(f"Clearance and {design.question.level.name}")


def clearance_label(choice: Choice) -> str:
    """Return the label of the clearance axis, which shows the clearance of the heaviest damper."""
    if len(choice.bodies) == 1:
        return "clearance / mm"
    return f"clearance in body {choice.bodies[choice.heaviest_index]} / mm\n(other clearances in proportion)"


def _draw_reductions(axes: Axes, design: Design) -> None:
    """Draw peak reduction against excitation level, for the chosen clearance and its neighbors."""
    # The axis is the acceleration without dampers; with dampers it jumps where another peak becomes the largest.
    chosen = int(np.argmin(np.abs(np.log(design.clearance_factors))))
    plotted_rows = (chosen - 1, chosen, chosen + 1)
    bare_acceleration = design.levels / design.bare.level * design.bare.acceleration
    for row_number, color, marker in zip(plotted_rows, ("#999999", BASELINE, "#bbbbbb"), "v^o", strict=True):
        row = design.chart[row_number]
        choice = design.charted
        clearance = 1e3 * design.clearance_factors[row_number] * choice.clearances[choice.heaviest_index]
        axes.plot(
            bare_acceleration, [design.reduction(peak) for peak in row], f"{marker}-", ms=4,
            color=color, lw=1.6 if row_number == chosen else 0.8, label=f"clearance {clearance:.3g} mm",
        )  # fmt: skip
    axes.set(xlabel="acceleration at the peak without dampers / (m/s²)", ylabel="reduction of the largest peak / dB")
    set_log_scale(axes.xaxis)
    axes.axhline(0.0, color="black", lw=0.8)
    _add_legend_below(axes)
    axes.set_title("Acceleration level")


def _draw_responses(axes: Axes, design: Design) -> None:
    """Draw the largest response of the watched bodies without and with dampers, and the peaks of the modes."""
    objective = replace(design.question, density=FINE_DENSITY)
    scene, (low, high) = objective.scenes[0], objective.band
    (name, unit, factor), level_unit = design.question.response_display, design.question.level.unit
    peaks = [mode.undamped.frequency for mode in design.modes if mode.in_band]
    frequency = np.unique(np.concatenate([np.geomspace(low, high, _RESPONSE_POINTS), peaks]))
    rows = [body - 1 for body in objective.bodies]
    bare = abs(linear_response(scene.replace(dampers=[]), frequency)[rows]).max(axis=0)
    axes.plot(frequency, factor * bare, color=BASELINE, lw=1.0, label="without dampers")
    damped_scene = scene.replace(dampers=design.best.choice.dampers(objective.impact_law))
    problem, coarse = OrbitProblem(damped_scene), objective.frequencies(damped_scene)
    for number, level in enumerate(objective.levels):
        color, dashes, marker = level_style(number)
        response = response_at_level(problem, level, coarse)
        axes.plot(coarse, factor * abs(response.frf[rows]).max(axis=0), color=color, ls=dashes, lw=1.0)
        damped = [mode.damped[number] for mode in design.modes if mode.in_band]
        axes.plot(
            [peak.frequency for peak in damped], [factor * peak.magnitude for peak in damped], marker, color=color,
            mfc="white", ms=5,
        )  # fmt: skip
        axes.plot(
            [], [], ls=dashes, marker=marker, color=color, mfc="white", ms=5,
            label=f"with dampers, {format_number(level)} {level_unit}",
        )  # fmt: skip
    axes.set(xlabel="frequency / Hz", ylabel=f"largest {name} / ({unit})", xlim=(low, high))
    set_log_scale(axes.xaxis)
    set_log_scale(axes.yaxis, 5)
    _add_legend_below(axes)
    axes.set_title("Response without and with dampers")


def level_style(number: int) -> tuple[str, str, str]:
    """Return color, line style and marker of a level, by its number from 0."""
    cycles: tuple[Sequence[str], ...] = LEVEL_COLORS, _LEVEL_LINES, _LEVEL_MARKERS
    color, line, marker = (cycle[number % len(cycle)] for cycle in cycles)
    return color, line, marker


def _add_legend_below(axes: Axes) -> None:
    """Add a legend below the axes, because one inside would hide peaks."""
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.19), ncols=2, borderaxespad=0.0)


def headline(design: Design) -> str:
    """State the dampers, the largest peak without and with them, and its change in dB."""
    peak, (_, unit, factor) = design.best.peak, design.question.response_display
    heights = " to ".join(format_number(factor * each.magnitude) for each in (design.bare, peak))
    change = f"{-design.reduction(peak):+.1f}".replace("-", "−")
    return f"{design.best.choice}: {heights} {unit} ({change} dB)"


class Agreement(NamedTuple):
    """Number of operating points at which the compliances of a bed as one mass and as grains agree within 10 %."""

    agreeing: int
    settings: int


# Agreement from the table of `analysis beds`; a test compares these figures with the table.
WITHOUT_CEILING = Agreement(21, 36)
BELOW_CEILING = Agreement(6, 61)
#: Below a ceiling, the deviations of grains from one mass have this interquartile range, percent.
INTERQUARTILE_RANGE = (-50, -16)
#: Diameter of the shot in the grain simulation [m].
_SHOT_DIAMETER = 2e-3
#: Half-width of the band of the grain simulation around the peak, relative.
_BAND_HALF_WIDTH = 0.01
#: Number of frequencies in that band.
_BAND_POINTS = 3


def grain_check(dampers: Sequence[Damper], expected: Sequence[Expected], scene: Path) -> list[str]:
    """Report how well the single-mass model agrees with grains, and the command that simulates the grains.

    `dampers`: the dampers of the design; `expected`: expected results of the check; the command uses the largest peak
    among them; `scene`: file of the check.
    """
    peak = max(result.peak for result in expected)
    beds = ", ".join(_as_shot(damper) for damper in dampers)
    low, high = (f"{peak.frequency * (1.0 + offset):.4g}Hz" for offset in (-_BAND_HALF_WIDTH, _BAND_HALF_WIDTH))
    without, below = WITHOUT_CEILING, BELOW_CEILING
    largest_decrease, smallest_decrease = (-deviation for deviation in INTERQUARTILE_RANGE)
    return [
        "these results are for beds that move as one mass. Simulated beds of grains (analysis beds) had the same",
        f"compliance within 10 % in {without.agreeing} of {without.settings} cases without a ceiling, and in "
        f"{below.agreeing} of {below.settings} cases with a ceiling.",
        f"With a ceiling, the compliance with grains was typically {smallest_decrease} to {largest_decrease} % lower "
        "(interquartile range).",
        f"To simulate these dampers with shot of {format_number(1e3 * _SHOT_DIAMETER)} mm (which may take hours), run:",
        f"rig grains {quote(str(scene))} --set {quote(f'dampers=[{beds}]')} "
        f"--set test.force={format_number(peak.level)}N --from {low} --to {high} --points {_BAND_POINTS} "
        f"-o {quote(str(scene.with_name(f'{scene.stem}-grains.csv')))}",
    ]


def _as_shot(damper: Damper) -> str:
    assert damper.mass is not None  # every damper of a design has a mass
    mass, shot = (format_number(1e3 * value) for value in (damper.mass, _SHOT_DIAMETER))
    clearance = ".inf" if np.isinf(damper.clearance) else f"{format_number(1e3 * damper.clearance)} mm"
    return f"{{body: {damper.body}, mass: {mass} g, clearance: {clearance}, grains: {{diameter: {shot} mm}}}}"
