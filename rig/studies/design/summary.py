"""Summary of `rig design`: the best dampers, their effect on every mode, and the best lighter designs."""

import numpy as np

from rig.core.results import format_decimals, format_number
from rig.studies.design.choice import mass_unit
from rig.studies.design.design import Design
from rig.studies.design.ranking import EQUAL_DB, IRREGULAR_RATIO, MIN_MACHINABLE_CLEARANCE
from rig.studies.design.tuned_mass import TunedMass

#: A clearance or mass is at a limit of the search if it differs from the limit by at most this fraction.
LIMIT_TOLERANCE = 0.02


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
        peaks = "".join(f" {scale * peak.magnitude:8.4g}" for peak in mode.damped)
        remark = "" if mode.in_band else "  outside the band"
        lines.append(f"{format_decimals(mode.frequency, 2):>14} {scale * mode.undamped.magnitude:9.4g}{peaks}{remark}")
    return lines


def _accuracy_of_reductions(design: Design) -> str:
    """Return the numerical accuracy of the reductions, and the assumptions under which it is valid."""
    is_irregular = any(peak.irregular_share for trial in design.front for peak in trial.peaks)
    averages = f", {20.0 * np.log10(IRREGULAR_RATIO):.1f} dB where the motion is irregular" if is_irregular else ""
    return (
        f"accuracy of the computed reductions: {EQUAL_DB:g} dB{averages}; for the values of the scene and beds that "
        "move as one mass"
    )
