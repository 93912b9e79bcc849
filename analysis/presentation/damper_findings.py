"""Damper motion in a stepped sine, estimated from the channels: type of motion, energy dissipated per period."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.damper_motion.nonlinearity import (
    DamperMotion,
    damper_motion,
    describe_motion,
    describe_restitution,
)
from analysis.damper_motion.performance import CycleEnergy, energy_per_cycle, impact_energy_per_cycle
from analysis.presentation.expectations import expect
from analysis.presentation.output_names import check_outputs, output_stem, with_ending
from analysis.presentation.result import Progress, Result
from analysis.presentation.tables import write_table
from analysis.recordings.names import opened, relabelled, scene_labels
from analysis.responses.measurands import located
from analysis.responses.stepped_sine import Sweep, sweeps
from rig.errors import RecordingError
from rig.results import plainly, rounded

if TYPE_CHECKING:
    from analysis.responses.spectral_lines import Lines
    from daq.recording.recording import Recording

# Frequencies listed on the terminal; the CSV file holds all.
_LISTED = 5


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
