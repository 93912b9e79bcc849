"""Output of `analysis dampers`: damper motion in stepped-sine tests as text, figures and tables."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from analysis.commands.presentation.inputs import check_recording
from analysis.commands.presentation.outputs import (
    CommandOutput,
    check_outputs,
    separate_stems,
    with_ending,
    with_recording_name,
)
from analysis.commands.presentation.tables import write_table
from analysis.core.damper_motion.dampers import Dampers, dampers_in
from analysis.core.damper_motion.energy_balance import EnergyBalance
from analysis.core.damper_motion.motion_types import DamperMotion, motion_table
from analysis.core.recordings.descriptions import full_test_text
from analysis.core.recordings.names import scene_labels
from analysis.core.recordings.opening import OpenRecordings, with_recordings
from rig.core.base.progress import CountProgress
from rig.core.results import format_interval, format_limited, format_number
from rig.core.results.table import Table
from rig.core.results.uncertainty import expand

# Number of frequencies in the printed energy table, which must stay short; the CSV file contains all frequencies.
_PRINTED_FREQUENCIES = 2
_HEADING = (
    "scene", "frequency_Hz", "supplied_J", "structure_J", "dampers_J", "dampers_bound_J", "true_impacts_J",
    "channel", "motion", "floor_per_period", "ceiling_per_period",
)  # fmt: skip


@with_recordings
def present_dampers(
    recordings: OpenRecordings, paths: Sequence[Path], output: Path | None = None, progress: CountProgress | None = None
) -> CommandOutput:
    """Report the motion of the dampers at each frequency of stepped-sine tests as text, figures and tables.

    `paths`: recordings of stepped-sine tests with dampers; `output`: folder for figures and tables; default: the
    folder of the first recording.
    """
    from analysis.commands.figures.dampers_figure import dampers_figure
    from rig.core.base.figure_style import save_figure

    files: list[Path] = []
    lines: list[str] = []
    warnings: list[str] = []
    stems = separate_stems(paths, output, "dampers")
    check_outputs(paths, *(with_ending(stem, "csv") for stem in stems))
    for path, stem, label in zip(paths, stems, scene_labels(recordings, paths), strict=True):
        rec = recordings.of(path)
        check_recording(rec, path, "dampers")
        results, excitation = dampers_in(rec, label, progress), full_test_text(rec)
        warnings += with_recording_name(path, [warning for dampers in results for warning in dampers.warnings])
        lines += [line for dampers in results for line in describe(dampers)]
        for number, dampers in enumerate(results, 1):
            numbered = stem if number == 1 else stem.with_name(f"{stem.name}-{number}")
            if dampers.bodies:
                files += save_figure(dampers_figure(dampers, f"Dampers: {dampers.label} ({excitation})"), numbered)
        rows = chain.from_iterable(map(_rows, results))
        files.append(write_table(with_ending(stem, "csv"), _HEADING, rows))
    return CommandOutput(tuple(files), tuple(lines), tuple(warnings))


def _rows(dampers: Dampers) -> list[tuple[str | float, ...]]:
    if not dampers.bodies:
        return []
    columns = [column.tolist() for column in dampers.columns().values()]
    return [(dampers.label, *row) for row in zip(*columns, strict=True)]


def describe(dampers: Dampers) -> list[str]:
    """Return the printed lines for one sweep: motions, restitution, detection limits and energies."""
    lines = [dampers.label, *(f"  {reason}" for reason in dampers.missing)]
    if dampers.bodies:
        lines += [f"  {line}" for line in describe_motions(dampers.bodies, dampers.sweep.lines.omitted.tolist())]
    if dampers.energy is not None:
        lines += [f"  {line}" for line in describe_energy(dampers.energy, dampers.true_impact_energy)]
    return lines


def describe_motions(bodies: Sequence[list[DamperMotion]], omitted: Sequence[float] = ()) -> list[str]:
    r"""Return a table of the motions in each body with their frequencies, then restitution and detection limits.

    `bodies`: the motions of each body, from one channel; `omitted`: frequencies without a result [Hz], where printed
    frequency ranges are interrupted.

    >>> impact = DamperMotion(30.0, "body2", 1.0, 0.0, False, 1.6e-3, False)
    >>> at_rest = DamperMotion(31.0, "body2", 0.0, 0.0, False, 1.6e-3, True)
    >>> print(*describe_motions([[impact, at_rest]]), sep="\n")
    channel  motion                frequency
    body2    Type I                30 Hz
             at rest on the floor  elsewhere
    Damper impacts with a velocity jump below 1.6 mm/s (body2) are not detected.
    """
    restitutions = [text for motions in bodies for text in _restitution(motions)]
    return [
        *motion_table(bodies, omitted).lines(),
        *([f"Restitution: {'; '.join(restitutions)}."] if restitutions else []),
        f"Damper impacts with a velocity jump below {detection_limits(bodies)} are not detected.",
    ]


def detection_limits(bodies: Sequence[list[DamperMotion]]) -> str:
    """List the detection limit of each body, the largest over all frequencies."""
    limits = [(max(motion.detection_limit for motion in body), body[0].channel) for body in bodies]
    return ", ".join(f"{float(f'{1e3 * limit:.2g}'):.10g} mm/s ({channel})" for limit, channel in limits)


def _restitution(motions: list[DamperMotion]) -> list[str]:
    """Return the text on the mean restitution of one body; an empty list if it was not determined."""
    estimates = [motion.restitution for motion in motions if motion.restitution is not None]
    if not estimates:
        return []
    value = np.array([estimate.value for estimate in estimates])
    weight = np.array([estimate.error**-2.0 for estimate in estimates])
    mean = float(np.sum(weight * value) / weight.sum())
    # Errors of the sensor and of the fitted velocity jumps are common to all frequencies, so averaging does not
    # reduce them. The stated uncertainty is at least the observed scatter.
    scatter = float(np.sqrt(np.sum(weight * (value - mean) ** 2) / weight.sum() / max(len(estimates) - 1, 1)))
    expanded = float(expand(max(float(weight.mean() ** -0.5), scatter)))
    text = format_interval(mean, expanded).replace("-0.000", "0.000")
    return [f"{text} ({motions[0].channel}, {len(estimates)} frequencies)"]


def describe_energy(energy: EnergyBalance, true_loss: np.ndarray | None = None) -> list[str]:
    """Return a table of the energy per period at the frequencies with the largest supplied energy.

    The fourth column is the change of the dampers' share if the structural damping in the scene is 10 % too high. If
    the recording contains `true_loss`, the last column is the true share of the impacts.
    """
    rows = []
    for i in np.sort(np.argsort(energy.supplied, kind="stable")[::-1][:_PRINTED_FREQUENCIES]):
        percent, expanded = 100.0 / energy.supplied[i], energy.expanded[i]
        rows.append((
            f"{energy.frequency[i]:.4g}",
            format_number(1e3 * energy.supplied[i]),
            format_limited(percent * energy.dampers[i], percent * expanded, 100.0)
            + " (uncertainty unknown)" * bool(np.isnan(expanded)),
            f"{0.1 * percent * energy.structure[i]:+.2g}",
            "" if true_loss is None else f"{percent * true_loss[i]:.3g}",
        ))  # fmt: skip
    heading = (
        "frequency / Hz", "supplied / mJ", "into dampers / %", "change if scene damping 10 % too high / %",
        "true impact loss / %",
    )  # fmt: skip
    title = "Energy per period, at the frequencies where the force supplies most energy:"
    return [title, *Table(heading, ">>>>>", rows).lines()]
