"""Damper motion in a stepped sine, estimated from the channels: type of motion, energy dissipated per period."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.damper_motion.energy_balance import CycleEnergy, energy_per_cycle, impact_energy_per_cycle
from analysis.damper_motion.motion_types import DamperMotion, damper_motion
from analysis.presentation.expectations import expect
from analysis.presentation.output_names import check_outputs, output_stem, with_ending
from analysis.presentation.result import Progress, Result
from analysis.presentation.tables import write_table
from analysis.recordings.names import opened, relabelled, scene_labels
from analysis.responses.measurands import located
from analysis.responses.stepped_sine import Sweep, sweeps
from rig.errors import RecordingError
from rig.results import frequency_ranges, plainly, rounded

if TYPE_CHECKING:
    from analysis.responses.spectral_lines import Lines
    from daq.recording.recording import Recording

# Frequencies listed on the terminal; the CSV file holds all.
_LISTED = 5
# Kinds of motion as they are printed.
_AT_REST, _NEAR_GRAVITY = "at rest on the floor", "near 1 g"
_IRREGULAR = "irregular motion, or missed impacts,"
_NAMED_KINDS = ("type I", "type II", "type III", _AT_REST, _NEAR_GRAVITY, _IRREGULAR)
_OTHER_KINDS = "other periodic motions"
# With more kinds than this, counts of impacts that are no type share one entry.
_MAX_KINDS = 6


def present_dampers(
    paths: Sequence[Path], output: Path | None = None, progress: Progress | None = None
) -> Result:
    """List, draw and tabulate the motion of the dampers at each frequency of stepped sines.

    Parameters
    ----------
    paths : sequence of Path
        Recordings of stepped sines with dampers.
    output : Path, optional
        Folder for figures and tables; default beside the first recording.
    progress : callable, optional
        Called with (frequencies done, in all) of the lock-in, then of the search for impacts in each body.
    """
    from analysis.figures.dampers_figure import dampers_figure
    from rig.figure_style import save

    files, lines, notes = [], [], []
    for path in paths:
        check_outputs([path], output, "dampers", "csv")
    for path, label in zip(paths, scene_labels(paths), strict=True):
        with opened(path) as rec:
            expect(rec, path, "dampers")
            rows: list[tuple[str | float, ...]] = []
            drawn: list[
                tuple[list[list[DamperMotion]], CycleEnergy | None, str, Lines, np.ndarray | None]
            ] = []
            for sweep in sweeps(rec, progress=progress):
                name = relabelled(sweep.lines, rec.scene.name, label).label
                motions = []
                lines.append(name)
                for of_body, reason in motions_of_bodies(rec, sweep, progress):
                    text = [reason]
                    if of_body:
                        motions.append(of_body)
                        text = describe_motion(of_body, sweep.lines.left_out.tolist()) + describe_restitution(
                            of_body
                        )
                    lines += [f"  {line}" for line in text]
                # Frequencies that are missing here may be those that matter.
                notes += [f"{path.name}: {warning}" for warning in sweep.lines.warnings]
                try:
                    energy = energy_per_cycle(rec, sweep)
                except RecordingError as error:
                    notes.append(f"{path.name}: no energy balance: {error}")
                    energy = None
                true = impact_energy_per_cycle(rec, sweep) if rec.has_truth else None
                if energy is not None:
                    lines += [f"  {line}" for line in describe_energy(energy, true)]
                rows += _rows(name, sweep, motions, energy, true)
                drawn.append((motions, energy, name, sweep.lines, true))
        heading = [
            "scene", "frequency_Hz", "supplied_J", "structure_J", "dampers_J", "dampers_bound_J", "true_impacts_J",
            "channel", "motion", "floor_per_period", "ceiling_per_period",
        ]  # fmt: skip
        with output_stem([path], output, "dampers", "csv") as stem:
            for number, (motions, energy, name, of_sweep, true) in enumerate(drawn):
                part = stem if number == 0 else stem.with_name(f"{stem.name}-{number + 1}")
                if motions:
                    files += save(dampers_figure(motions, energy, name, of_sweep, true), part)
            files.append(write_table(with_ending(stem, "csv"), heading, rows))
    return Result(tuple(files), tuple(lines), tuple(notes))


def motions_of_bodies(
    rec: Recording, sweep: Sweep, progress: Progress | None
) -> Iterator[tuple[list[DamperMotion], str]]:
    """Estimate the motion at every frequency of each body with free dampers.

    Yields
    ------
    motions : list of DamperMotion
        Empty where there is no result.
    reason : str
        Why there is none.
    """
    for body in sorted({damper.body for damper in rec.scene.dampers if not damper.locked}):
        info = located(rec, f"body {body}")
        if info is None:
            yield [], f"{rec.scene.structure.label(body)}: no channel on it, so its impacts are not detected"
            continue
        try:
            yield damper_motion(rec, sweep, info.name, progress), ""
        except RecordingError as error:
            yield [], str(error)


def describe_restitution(motions: list[DamperMotion]) -> list[str]:
    """One line about the restitution that a body's impacts determine, if any do: weighted by its errors."""
    estimates = [one.restitution for one in motions if one.restitution is not None]
    if not estimates:
        return []
    value, weight = (
        np.array([one.value for one in estimates]),
        np.array([one.error**-2.0 for one in estimates]),
    )
    mean = float(np.sum(weight * value) / weight.sum())
    # What a sensor or the fit of jumps puts off, it does so at all frequencies; and no better than their scatter says.
    scatter = float(np.sqrt(np.sum(weight * (value - mean) ** 2) / weight.sum() / max(len(estimates) - 1, 1)))
    error = max(float(weight.mean() ** -0.5), scatter)
    return [
        f"{motions[0].channel}: restitution {mean:z.2f} ± {2.0 * error:.1g}, determined at {len(estimates)} frequencies"
    ]


def describe_motion(motions: list[DamperMotion], left_out: Sequence[float] = ()) -> list[str]:
    """Describe the motion of a body's dampers in one line: each kind with its frequencies, and the detection limit.

    Parameters
    ----------
    motions : list of DamperMotion
        Of one channel.
    left_out : sequence of float
        Hz: frequencies without a result, at which a range ends.

    Examples
    --------
    >>> hit = DamperMotion(30.0, "body2", 1.0, 0.0, False, 1.6e-3, False)
    >>> at_rest = DamperMotion(31.0, "body2", 0.0, 0.0, False, 1.6e-3, True)
    >>> describe_motion([hit, at_rest])
    ['body2: type I at 30 Hz; no impact detected elsewhere (limit 1.6 mm/s)']
    """
    every = [(one.frequency, _kind(one)) for one in motions] + [(f, "") for f in left_out]
    frequency = [f for f, _ in every]
    kinds = dict.fromkeys(kind for _, kind in every if kind)
    if len(kinds) > _MAX_KINDS:
        every = [(f, kind if kind in _NAMED_KINDS or not kind else _OTHER_KINDS) for f, kind in every]
        kinds = dict.fromkeys(kind for _, kind in every if kind)
    parts = [
        f"{kind} at {frequency_ranges(frequency, [kind == other for _, other in every])}"
        for kind in kinds
        if kind not in (_AT_REST, _NEAR_GRAVITY)
    ]
    limit = f"limit {1e3 * max(one.threshold for one in motions):.2g} mm/s"
    if _AT_REST in kinds or _NEAR_GRAVITY in kinds:
        parts.append(f"no impact detected{' elsewhere' if parts else ''} ({limit})")
    else:
        parts[-1] += f" ({limit})"
    if _NEAR_GRAVITY in kinds:
        near = [kind == _NEAR_GRAVITY for _, kind in every]
        parts.append(f"near 1 g, where the damper may fly, at {frequency_ranges(frequency, near)}")
    return [f"{motions[0].channel}: {'; '.join(parts)}"]


def _kind(one: DamperMotion) -> str:
    """Name the kind of motion for people."""
    kind, _, counts = one.name.partition(": ")
    if kind == "riding":
        return _AT_REST
    if kind == "unseen":
        return _NEAR_GRAVITY
    if kind == "unsure":
        return _IRREGULAR
    return counts if kind == "other" else f"type {kind}"


def describe_energy(energy: CycleEnergy, true: np.ndarray | None = None) -> list[str]:
    """Table of the energy per period, at the frequencies at which most is supplied.

    The last columns: change of the dampers' share if the scene's damping is 10 % too high; true share, if recorded.
    """
    chosen = np.sort(np.argsort(energy.supplied, kind="stable")[::-1][:_LISTED])
    heading = ["frequency / Hz", "supplied / mJ", "into dampers / %", "per 10 % of scene damping / %"]
    rows = [heading if true is None else [*heading, "true impact loss / %"]]
    for i in chosen:
        share, bound = (100.0 * each[i] / energy.supplied[i] for each in (energy.dampers, energy.bound))
        into = (
            f"{rounded(share, bound)} ± {rounded(bound, bound)}"
            if not abs(share) <= bound
            else f"below {plainly(share + bound)}"
        )
        own = 10.0 * energy.structure[i] / energy.supplied[i]
        row = [f"{energy.frequency[i]:.4g}", plainly(1e3 * energy.supplied[i]), into, f"{own:+.2g}"]
        rows.append(row if true is None else [*row, f"{100.0 * true[i] / energy.supplied[i]:.3g}"])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    table = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return ["Energy per period where most is supplied:", *table]


def _rows(
    name: str,
    sweep: Sweep,
    motions: list[list[DamperMotion]],
    energy: CycleEnergy | None,
    true: np.ndarray | None,
) -> list[tuple[str | float, ...]]:
    nothing = np.full(sweep.lines.frequency.size, np.nan)
    columns = [nothing] * 4
    if energy is not None:
        columns = [energy.supplied, energy.structure, energy.dampers, energy.bound]
    columns.append(nothing if true is None else true)
    return [
        (
            name,
            frequency,
            *(float(column[i]) for column in columns),
            body[i].channel,
            body[i].name,
            # What impacts that are missed leave of the others is no count.
            body[i].floor if body[i].repeats else np.nan,
            body[i].ceiling if body[i].repeats else np.nan,
        )
        for i, frequency in enumerate(sweep.lines.frequency)
        for body in motions
    ]
