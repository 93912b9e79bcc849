"""Output of `analysis frf`: frequency responses as text, figures and tables."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from analysis.commands.figures.tolerance_texts import unstated_text, unstated_tolerances
from analysis.commands.presentation.inputs import check_inputs, labels, read_curves
from analysis.commands.presentation.outputs import (
    CommandOutput,
    check_outputs,
    output_stem,
    with_channel_name,
    with_ending,
    with_recording_name,
)
from analysis.core.damper_motion.comparison import Peak, is_next_to_omitted, may_be_higher, resonance_peaks
from analysis.core.recordings.descriptions import acquisition_text, excitation_text, validity_texts
from analysis.core.recordings.names import baseline_label, belongs_to, relabel, sweep_name, without_common_direction
from analysis.core.recordings.opening import OpenRecordings, with_recordings
from analysis.core.responses.checks.curve_checks import find_jumps
from analysis.core.responses.errors.systematic import side_errors, tolerance_text
from analysis.core.responses.estimator import Blocks, estimator_of
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.extras.formats.frf_files import is_frf_file
from daq.core.recording.recording import Recording
from rig.core.base.palette import recording_styles
from rig.core.base.progress import CountProgress
from rig.core.results import format_percent
from rig.core.results.resonances import MIN_LINES, Resonance
from rig.core.results.response import MOTIONS, Response
from rig.core.results.table import join_tables
from rig.core.results.uncertainty import SENSITIVITY, SYSTEMATIC
from rig.core.scene.presets import preset_note

# Maximum number of resonances that are listed individually; a longer list would hide the other lines.
_MAX_LISTED = 8
# The interpolated peak is reported if it exceeds the highest point by more than this fraction.
_MAX_PEAK_DEVIATION = 0.01


@with_recordings
def present_frf(
    recordings: OpenRecordings,
    paths: Sequence[Path],
    output: Path | None = None,
    response: Sequence[str] | None = None,
    reference: str | None = None,
    motion: str = "displacement",
    estimator: str | None = None,
    block: float | None = None,
    theory: bool = False,
    progress: CountProgress | None = None,
    overlap: float | None = None,
    window: str | None = None,
    unit: str | None = None,
) -> CommandOutput:
    """Draw and tabulate frequency responses; several files are overlaid in one figure for each response.

    `output`: folder, by default the folder of the first file; `theory`: add the linear theory; `unit`: unit for files
    that state none; the other options are as in `frequency_responses`.
    """
    from analysis.commands.presentation.tables import frf_table

    curves: list[Response] = []
    theory_curves: list[Response] = []
    blocks = Blocks(estimator, block, overlap, window)
    warnings = check_inputs(recordings, paths, "frf", blocks, theory, unit)
    stem = output_stem(paths, output, "frf")
    table = with_ending(stem, "csv")
    check_outputs(paths, table)
    tolerance_remarks: list[str] = []
    moving: dict[str, bool] = {}
    # Names by rig: changes (`--set`) change the rig of a scene, but not its name.
    scenes: dict[str, str] = {}
    excitations: dict[str, str] = {}
    acquisitions: set[str] = set()
    validity: dict[str, list[str]] = {}
    for path, label in zip(paths, labels(recordings, paths), strict=True):
        if is_frf_file(path):
            file_curves = read_curves(path, reference, response, unit)
            curves += [replace(frf.to(motion), label=label) for frf in file_curves]
            moving[label], excitations[label] = True, ""
            scenes[label] = label
            warnings += with_recording_name(path, file_curves[0].warnings)
            continue
        rec = recordings.of(path)
        options = vars(blocks.for_kind(rec.test.kind))
        groups = frequency_responses(rec, response, reference, motion, progress=progress, **options)
        scenes[repr(rec.scene.model_dump(exclude={"test"}))] = rec.scene.name
        curves += [relabel(frf, rec.scene.name, label) for group in groups for frf in group]
        moving[label], excitations[label] = not rec.scene.is_linear, excitation_text(rec)
        if texts := validity_texts(rec):
            validity.setdefault(f"{'; '.join(texts)}.", []).append(label)
        acquisitions.add(acquisition_text(rec, groups[0][0], blocks.title(rec.test.kind)))
        warnings += with_recording_name(path, [warning for group in groups for warning in group[0].warnings])
        tolerance_remarks += stated_tolerances(rec, [frf for group in groups for frf in group])
        if theory:
            from analysis.commands.presentation.theory import linear_theory

            theory_curves += [linear_theory(rec, frf) for frf in groups[0]]
    remarks = [
        text[0].upper() + text[1:] if len(named) == len(paths) else f"{', '.join(named)}: {text}"
        for text, named in validity.items()
    ]
    baseline = baseline_label(moving)
    files = _draw_figures(curves, theory_curves, stem, baseline, excitations, acquisitions, remarks, [*scenes.values()])
    files.append(frf_table(table, curves))
    lines = (*describe_frfs(curves), *dict.fromkeys(tolerance_remarks), *missing_tolerances(curves))
    return CommandOutput(tuple(files), lines, tuple(warnings))


def missing_tolerances(frfs: Sequence[Response]) -> list[str]:
    """Return a sentence about the errors that the intervals of results lack; empty if they contain all."""
    missing = unstated_tolerances(frfs)
    return [f"intervals without {unstated_text(missing)}"] if missing else []


def describe_frfs(curves: Sequence[Response]) -> list[str]:
    """Return a table of the highest value of each response; responses of one sweep and band share a heading."""
    lines: list[str] = []

    def heading(frf: Response) -> str:
        points, lowest, highest = frf.frequency.size, frf.frequency.min(), frf.frequency.max()
        return f"{frf.label}, {frf.name}, {frf.input}: {points} points, {lowest:.4g} to {highest:.4g} Hz"

    for title, group in groupby(curves, heading):
        frfs = list(group)
        remarks: dict[str, list[str]] = {}
        for frf in (frf for frf in frfs if np.isfinite(frf.value).any()):
            for text in (*frf.uncertain_peak(), *_peaks_between_points(frf)):
                remarks.setdefault(text, []).append(frf.response)
        notes = [f"{', '.join(names)}: {text}" for text, names in remarks.items()]
        table = join_tables(("", frf.table()) for frf in frfs)
        lines += [title, *table.lines("  "), *(f"  {note}" for note in notes)]
    return lines


def _peaks_between_points(frf: Response) -> list[str]:
    """Report the highest interpolated peak of a response, and resonances whose points are too far apart."""
    line = frf.peak_line()
    frequency, height = float(frf.frequency[line]), float(abs(frf.value[line]))
    if not np.isfinite(frf.expanded()[line]) or frf.resolution > 0.0:
        return []
    if is_next_to_omitted(frf, frequency):
        return [
            f"the highest point, at {frequency:.4g} Hz, is next to omitted frequencies, where the peak may be. Remove "
            "the cause of the omission (see the warnings), and measure again"
        ]
    # `resonance_peaks` estimates displacement.
    n_derivatives = MOTIONS.index(frf.motion)
    peaks = [(r, p, (2.0 * np.pi * p.frequency) ** n_derivatives) for r, p in resonance_peaks(frf)]
    uncertain = {r for r, p, _ in peaks if not p.is_determined}
    value, scale, highest = max(
        ((scale * p.value, scale, None if r in uncertain else p) for r, p, scale in peaks),
        default=(0.0, 1.0, None),
        key=lambda peak: peak[0],
    )
    # The tolerances of the sensors change the peak and the highest point by the same factor.
    point = (1.0 + _MAX_PEAK_DEVIATION) * height + float(frf.without(SENSITIVITY, SYSTEMATIC).expanded()[line])
    remarks = []
    if highest is not None and value + scale * highest.interpolation_expanded > point:
        unit, factor = frf.shown_in
        remarks.append(
            f"the peak between the points, at {highest.label(highest.frequency)}, is "
            f"{highest.height_text(factor * scale, unit)}"
        )
    elif frequency in (frf.frequency.min(), frf.frequency.max()):
        remarks.append(
            f"the highest point, at {frequency:.4g} Hz, is at the end of the band, so the peak may be outside. Measure "
            "a wider band"
        )
    coarse = [r for r, p, _ in peaks if not p.loading and may_be_higher(r, p)]
    remarks += [
        f"the response jumps near {jump:.4g} Hz, next to its peak: compare sweeps up and down (test.direction: both)"
        for resonance in coarse
        for jump in _jumps_next_to(frf, resonance)
    ]
    remarks += [_take_off_remark(frf, r, p) for r, p, _ in peaks if p.loading]
    unresolved = [resonance for resonance in coarse if not _jumps_next_to(frf, resonance)]
    # An undetermined curve has no known width, and its peak no known frequency.
    few = [r for r in unresolved if r.lines < MIN_LINES and r.expanded <= r.value]
    others = [replace(r, frequency=float(frf.frequency[r.line])) for r in unresolved if r not in few]
    causes = (
        (f"the half-power width at {{}} has fewer than {MIN_LINES} points", few),
        ("the points at {} do not determine the curve between them", others),
    )
    return remarks + [_spacing_remark(frf, cause, group) for cause, group in causes if group]


def _jumps_next_to(frf: Response, resonance: Resonance) -> list[float]:
    """Return the frequencies of the jumps between the highest point of a resonance and its neighbors [Hz]."""
    points = frf.frequency[max(resonance.line - 1, 0) : resonance.line + 2]
    return [jump for jump, _ in _jump_marks([frf]) if points.min() < jump < points.max()]


def _take_off_remark(frf: Response, resonance: Resonance, peak: Peak) -> str:
    """Return the advice on a peak whose points do not show whether a damper moves at the peak."""
    assert frf.loading is not None
    lines = (frf.frequency >= peak.lowest_frequency) & (frf.frequency <= peak.highest_frequency)
    where = f"between {peak.lowest_frequency:.4g} and {peak.highest_frequency:.4g} Hz"
    remedy = estimator_of(frf.test).peak_remedy(resonance.needed_spacing)
    if (frf.loading[lines] > 1.0).any():
        return (
            f"the peak {where} may be higher than measured: a damper or joint acts at some of these points only (a bed "
            f"acts above 1 g). {remedy}"
        )
    return (
        f"the peak {where} may be higher than measured. All points show linear motion, but the motion at the peak "
        f"would be {peak.loading:.2g} times that at which a damper or joint begins to act (a bed: 1 g). {remedy}, or "
        f"divide the level by {peak.loading:.2g}"
    )


def _spacing_remark(frf: Response, cause: str, coarse: Sequence[Resonance]) -> str:
    """Return the advice on resonances with too few points; `cause`: sentence with a place for their frequencies."""
    *frequencies, last = (f"{resonance.frequency:.4g}" for resonance in coarse[:_MAX_LISTED])
    where = f"{', '.join(frequencies)} and {last}" if frequencies else last
    more = f", and {len(coarse) - _MAX_LISTED} others" if len(coarse) > _MAX_LISTED else ""
    needed = min(resonance.needed_spacing for resonance in coarse)
    remedy = estimator_of(frf.test).peak_remedy(needed)
    return f"{cause.format(f'{where} Hz{more}')}: a peak there may be higher than measured. {remedy}"


def _draw_figures(
    curves: Sequence[Response],
    theory: Sequence[Response],
    stem: Path,
    baseline: str,
    excitations: Mapping[str, str],
    acquisitions: Collection[str] = (),
    remarks: Sequence[str] = (),
    scenes: Collection[str] = (),
) -> list[Path]:
    """Draw one figure for a single sweep, or one figure for each response of several sweeps; return the files.

    `baseline`: label of the recording with which all others are compared; `excitations`: test and level by recording;
    `acquisitions`: averages, lines and sample rates of all recordings; `remarks`: sentences for the captions;
    `scenes`: names of the scenes, one for each rig.
    """
    from analysis.commands.figures.frf_figure import frf_figure
    from rig.core.base.figure_style import save_figure

    sweep_labels = list(dict.fromkeys(frf.label for frf in curves))
    quantity = curves[0].name.capitalize()
    groups = _by_ratio(curves)
    tests = set(excitations.values())
    acquisition = ", ".join(["", *acquisitions]) if len(acquisitions) == 1 else ""
    test = f"{tests.pop()}{acquisition}" if len(tests) == 1 and "" not in tests else ""
    if len(sweep_labels) == 1:
        inputs = {frf.input for frf in curves}
        labeled = [replace(frf, label=frf.response if len(inputs) == 1 else frf.ratio) for frf in curves]
        if test and len(inputs) == 1:
            test = f"{test}; {inputs.pop()}"
        return save_figure(
            frf_figure(
                labeled,
                f"{quantity}: {sweep_labels[0]}{f' ({test})' * bool(test)}",
                _without_duplicates(theory),
                _jump_marks(labeled),
                remarks=remarks,
            ),
            stem,
        )
    inputs = {labeled[0].input for labeled in groups}
    files = []
    subjects = list(excitations) if len(excitations) == 1 else list(scenes)
    subject = f": {subjects[0]}" if len(subjects) == 1 else ""
    kinds, levels = zip(*(text.rpartition(", ")[::2] for text in excitations.values()), strict=True)
    # Recordings of one scene that differ only in their level are named by it.
    has_levels = len(scenes) == 1 < len(levels) == len(set(levels)) and len(set(kinds)) == 1 and all(kinds)
    if has_levels:
        test = f"{kinds[0]}{acquisition}"
    for labeled in groups:
        first = labeled[0]
        same_frf = [frf for frf in theory if (frf.response, frf.input) == (first.response, first.input)]
        name = first.response if len(inputs) == 1 else first.ratio.replace(" / ", "-by-").replace(" ", "-")
        title = f"{quantity}, {first.ratio}{subject}{f' ({test})' * bool(test)}"
        styles = recording_styles([belongs_to(curve.label, baseline) for curve in labeled])
        named = [_with_test(curve, {} if test else excitations) for curve in labeled]
        if has_levels:
            named = [
                relabel(curve, label, level)
                for curve in labeled
                for label, level in zip(excitations, levels, strict=True)
                if belongs_to(curve.label, label)
            ]
        if len(excitations) == 1:
            # The title names the recording.
            names = without_common_direction([sweep_name(curve.label, subjects[0]) for curve in named])
            named = [replace(curve, label=name) for curve, name in zip(named, names, strict=True)]
        figure_stem = stem if len(groups) == 1 else with_channel_name(stem, name)
        files += save_figure(
            frf_figure(named, title, _without_duplicates(same_frf), _jump_marks(labeled), styles, remarks), figure_stem
        )
    return files


def _with_test(curve: Response, excitations: Mapping[str, str]) -> Response:
    """Add test and level of its recording to the label of a curve."""
    text = next((text for label, text in excitations.items() if text and belongs_to(curve.label, label)), "")
    return replace(curve, label=f"{curve.label} ({text})") if text else curve


def _by_ratio(curves: Sequence[Response]) -> list[list[Response]]:
    """Group curves by output and input; a curve without an input joins the first group of its output."""
    groups: dict[tuple[str, str], list[Response]] = {}
    for curve in sorted(curves, key=lambda response: not response.input_at):
        existing = next((key for key in groups if key[0] == curve.response and not curve.input_at), None)
        groups.setdefault(existing or (curve.response, curve.input), []).append(curve)
    return list(groups.values())


def _jump_marks(curves: Sequence[Response]) -> list[tuple[float, str]]:
    """List the jumps of curves, without duplicates, for stepped and swept tests and for files (test unknown)."""
    # In other tests the level does not depend on the frequency, so dampers do not jump at one frequency.
    jumping = [curve for curve in curves if estimator_of(curve.test).jumps]
    return sorted({(round(frequency, 6), text) for curve in jumping for frequency, text in find_jumps(curve)})


def _without_duplicates(curves: Sequence[Response]) -> list[Response]:
    """Keep one theoretical curve for each output and input, with one legend entry for all such curves."""
    distinct: list[Response] = []
    for curve in curves:
        if all(curve.ratio != other.ratio for other in distinct):
            distinct.append(replace(curve, label=curve.label if not distinct else ""))
    return distinct


def stated_tolerances(rec: Recording, frfs: Sequence[Response]) -> list[str]:
    """Report the sensor tolerances and their source if the tolerances are the largest contribution at most points."""
    largest_contributions = [name for frf in frfs for name in frf.largest_contributions()]
    if 2 * largest_contributions.count(SENSITIVITY) < len(largest_contributions):
        return []
    groups: dict[str, list[str]] = {}
    has_preset = False
    settings = {channel.name: channel.accelerometer or channel.hammer for channel in rec.scene.channels or ()}
    for name, info in rec.channels.items():
        if limit := tolerance_text(rec, name):
            source = preset_note(settings.get(name), "sensitivity_tolerance")
            has_preset |= bool(source)
            parts = "".join(f", {format_percent(part)} of it by {cause}" for cause, part in side_errors(info).items())
            groups.setdefault(f"{limit}{parts}{source}", []).append(name)
    stated = "; ".join(f"{', '.join(names)} {text}" for text, names in groups.items())
    remark = (
        f"{rec.scene.name}: at most frequencies, the tolerance of the sensors ({stated}) is the largest "
        "contribution to the uncertainty"
    )
    advice = (
        ". If the sensors were calibrated, state the calibrated tolerance in the scene, such as sensitivity_tolerance: "
        "1 %"
    )
    return [remark + advice * has_preset]
