"""Output of `analysis compare`: changes of resonance peaks relative to the first recording."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby, product
from math import isfinite, isinf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.commands.presentation.inputs import check_recording, duplicate_warnings
from analysis.commands.presentation.outputs import (
    CommandOutput,
    check_outputs,
    output_stem,
    with_ending,
    with_recording_name,
    with_sweep_name,
)
from analysis.commands.presentation.tables import write_table
from analysis.core.damper_motion.comparison import (
    PeakChange,
    by_name,
    coarse_step_warnings,
    covers,
    peak_bands,
    peak_changes,
    uncompared_highest_peaks,
)
from analysis.core.modal.identification import identify
from analysis.core.modal.modes import Modes
from analysis.core.recordings.names import relabel, scene_labels
from analysis.core.recordings.opening import OpenRecordings, with_recordings
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.core.responses.measurands import default_reference, reference_of, response_channels
from daq.core.recording.recording import Recording
from rig.core.base.errors import SceneError
from rig.core.base.figure_types import Axes
from rig.core.base.progress import CountProgress
from rig.core.results import format_decimals
from rig.core.results.response import Response
from rig.core.results.result import Result, complete_style
from rig.core.results.table import Table, join_tables
from rig.core.results.uncertainty import SENSITIVITY

_HEADING = (
    "from", "to", "response", "reference", "mode_Hz", "change_dB", "change_low_dB", "change_high_dB", "shift_Hz",
    "shift_low_Hz", "shift_high_Hz", "peak_from m/N", "bound_from m/N", "peak_to m/N", "bound_to m/N",
)  # fmt: skip

# Cell of the table for a value that is not determined.
_NO_VALUE = "–"
# Warning if the 95 % interval of a peak is unbounded.
_UNBOUNDED_PEAKS = (
    "Some peaks may be higher than measured. Possible causes: only three points; a jump, a gap or the end of the curve "
    "next to the highest point; dampers or joints that begin to act between the points. Measure there with a smaller "
    "frequency spacing and without overloads, and sweep in both directions."
)
# Warning if the uncertainty of a peak is large.
_UNDETERMINED_PEAKS = (
    "The uncertainty of some peaks exceeds 50 %: only the lower ends of their 95 % intervals are stated."
)


@dataclass(frozen=True, repr=False)
class Comparison(Result):
    """Changes of resonance peaks from the first recording to the others.

    Attributes
    ----------
    changes : tuple of (Response, Response, PeakChange)
        Response of the first recording, response of the other recording, and the change of one peak.
    lines : tuple of str
        Description of the changes, and the peaks that are not compared.
    warnings : tuple of str
        Warnings about the recordings and the comparison.
    """

    changes: tuple[tuple[Response, Response, PeakChange], ...]
    lines: tuple[str, ...]
    warnings: tuple[str, ...]

    def table(self) -> Table:
        """Return the changes of each pair of sweeps, as `analysis compare` prints them."""
        return join_tables(
            (f"{first.label} → {other.label}", change_table([change for *_, change in group], first.shown_in))
            for (first, other), group in groupby(self.changes, lambda each: each[:2])
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return one row for each peak, as in the table of `analysis compare`."""
        rows = list(zip(*(_row(*change) for change in self.changes), strict=True)) or [()] * len(_HEADING)
        return {name: np.array(column) for name, column in zip(_HEADING, rows, strict=True)}

    def summary(self) -> str:
        """Count the significant changes: their 95 % interval excludes zero."""
        changed = sum(change.significance == "yes" for _, _, change in self.changes)
        return f"{changed} of {len(self.changes)} resonance peaks changed significantly (95 %)"

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the change of each peak with its 95 % interval against natural frequency."""
        groups: dict[str, list[PeakChange]] = {}
        for _, after, change in self.changes:
            groups.setdefault(f"{after.label}: {change.response}", []).append(change)
        for label, changes in groups.items():
            value, low, high = np.array([change.decibel for change in changes]).T
            bars = np.where(np.isfinite([low, high]), abs(np.array([low, high]) - value), 0.0)
            mode = [change.mode for change in changes]
            ax.errorbar(mode, value, yerr=bars, **complete_style(style, label=label, fmt="o", capsize=3))
        ax.set(xlabel="natural frequency / Hz", ylabel="change of the peak / dB")


@with_recordings
def compare_peaks(
    recordings: OpenRecordings, paths: Sequence[Path], progress: CountProgress | None = None
) -> Comparison:
    """Compare each resonance peak of the first recording with the same peak of the other recordings.

    `paths`: recordings with frequency responses of one structure. The first sweep (level, direction) of the first
    recording is the baseline; all sweeps of the other recordings are compared with it. Raises `SceneError` if there
    is only one recording, or if the recordings have no response in common.
    """
    if len(paths) < 2:
        raise SceneError("compare: only one recording. Give two or more; the first is the baseline.")
    sweeps: list[list[list[Response]]] = []
    measured_points: list[MeasurementPoints] = []
    names = scene_labels(recordings, paths)
    for path, label in zip(paths, names, strict=True):
        rec = recordings.of(path)
        check_recording(rec, path, "frf")
        measured_points.append(MeasurementPoints.of(path, rec))
        measured_points[-1].comparable_with(measured_points[0])
        groups = frequency_responses(rec, progress=progress)
        sweeps.append([[relabel(frf, rec.scene.name, label) for frf in group] for group in groups])
    first_frfs = sweeps[0][0]
    modes = identify(first_frfs)
    baseline, notes = first_frfs[0], [*modes.warnings, *uncompared_highest_peaks(modes, first_frfs)]
    warnings = duplicate_warnings(paths) + with_recording_name(
        paths[0], with_sweep_name(baseline.label, names[0], notes, baseline.warnings)
    )
    lines: list[str] = []
    all_changes: list[tuple[Response, Response, PeakChange]] = []
    others = zip(measured_points[1:], names[1:], sweeps[1:], strict=True)
    for points, name, frfs in ((points, name, frfs) for points, name, groups in others for frfs in groups):
        path, same_sensors = points.path, points.same_sensors(measured_points[0])
        changes = peak_changes(modes, first_frfs, frfs, same_sensors)
        before = coarse_step_warnings([(change.mode, change.response, change.baseline) for change in changes])
        after = coarse_step_warnings([(change.mode, change.response, change.damped) for change in changes])
        warnings += with_recording_name(path, frfs[0].warnings)
        warnings += with_recording_name(paths[0], with_sweep_name(baseline.label, names[0], before))
        warnings += with_recording_name(path, with_sweep_name(frfs[0].label, name, after))
        lines.append(f"{first_frfs[0].label} -> {frfs[0].label}, {first_frfs[0].input}")
        lines += [f"  {line}" for line in describe_changes(changes, first_frfs[0].shown_in)]
        if any(SENSITIVITY in frf.limits for frf in frfs if frf.response in same_sensors):
            lines.append(
                f"  {', '.join(same_sensors)}: measured with the same sensors, whose sensitivity errors cancel in "
                "these changes"
            )
        lines += _uncompared_peaks(changes, ((paths[0], first_frfs), (path, frfs)), modes)
        peaks = [peak for change in changes for peak in (change.baseline, change.damped)]
        if any(isinf(peak.expanded) for peak in peaks):
            warnings.append(_UNBOUNDED_PEAKS)
        if any(isfinite(peak.expanded) and not peak.is_determined for peak in peaks):
            warnings.append(_UNDETERMINED_PEAKS)
        all_changes += [(first_frfs[0], frfs[0], change) for change in changes]
    return Comparison(
        tuple(all_changes),
        tuple(lines),
        tuple(dict.fromkeys(warnings)),
    )


def change_table(changes: Sequence[PeakChange], shown_in: tuple[str, float]) -> Table:
    """Return a row for each compared peak; `shown_in`: unit of the peaks, and the factor from SI to this unit."""
    rows: list[tuple[str, ...]] = []
    for change in changes:
        before, after = change.height_texts(shown_in[1])
        cells = change.response, change.mode_label.removesuffix(" Hz")
        if change.damped.at_end:
            rows.append((*cells, _NO_VALUE, _NO_VALUE, before, "none", _NO_VALUE, _NO_VALUE, _NO_VALUE))
            continue
        is_determined = change.baseline.is_determined and change.damped.is_determined
        rows.append((
            *cells, *_format_change(change.decibel, change.decibel_decimals, is_determined), before, after,
            *_format_change(change.shift, change.shift_decimals),
            f"{100 * change.equivalent_damping:.2g}" if is_determined else _NO_VALUE,
        ))  # fmt: skip
    heading = (
        "response", "mode / Hz", "change / dB", "95 % interval / dB", f"before / ({shown_in[0]})",
        f"after / ({shown_in[0]})", "peak shift / Hz", "95 % interval / Hz", "equivalent ζ / %",
    )  # fmt: skip
    return Table(heading, "<>>>>>>>>", rows)


def describe_changes(changes: Sequence[PeakChange], shown_in: tuple[str, float]) -> list[str]:
    """Return a table of the compared peaks, and the bands whose peak has vanished; `shown_in`: see `change_table`."""
    unit, factor = shown_in
    remarks = [
        f"{change.response}, mode at {change.mode_label}: no peak is left between "
        f"{format_decimals(change.damped.lowest_frequency, 2)} and "
        f"{format_decimals(change.damped.highest_frequency, 2)} Hz, where the curve reaches "
        f"{change.height_texts(factor)[1]} {unit}"
        for change in changes
        if change.damped.at_end
    ]
    return [*change_table(changes, shown_in).lines(), *remarks]


def _format_change(value: tuple[float, float, float], digits: int, is_determined: bool = True) -> tuple[str, str]:
    """Format a change, dB or Hz, and its interval; if one limit is infinite, only the other limit is given.

    `is_determined`: whether both peaks are; otherwise only the interval is given.
    """
    estimate, low, high = (f"{number:+.{digits}f}" for number in value)
    if isinf(value[1]) and isinf(value[2]):
        return "unknown", _NO_VALUE
    if isinf(value[1]):
        return _NO_VALUE, f"below {high}"
    if isinf(value[2]):
        return _NO_VALUE, f"above {low}"
    return estimate if is_determined else _NO_VALUE, f"{low} to {high}"


def present_compare(
    paths: Sequence[Path], output: Path | None = None, progress: CountProgress | None = None
) -> CommandOutput:
    """Print and tabulate the results of `compare_peaks`; `output`: folder, by default that of the first recording."""
    table = with_ending(output_stem(paths, output, "compare"), "csv")
    check_outputs(paths, table)
    comparison = compare_peaks(paths, progress)
    write_table(table, _HEADING, (_row(*change) for change in comparison.changes))
    return CommandOutput((table,), comparison.lines, comparison.warnings)


def _uncompared_peaks(
    changes: Sequence[PeakChange], measured: Sequence[tuple[Path, Sequence[Response]]], modes: Modes
) -> list[str]:
    """List the modes and responses that are not compared, with the reason."""
    compared = {(change.response, change.mode) for change in changes}
    curves = [by_name(group) for _, group in measured]
    lines = []
    labels = [modes.frequency_label(k) for k in np.argsort(modes.frequency).tolist()]
    bands = list(zip(labels, *peak_bands(modes), strict=True))
    for name, (label, mode, low, high) in product([name for name in curves[1] if name in curves[0]], bands):
        if (name, float(mode)) in compared:
            continue
        causes = []
        for (path, _), curves_by_name in zip(measured, curves, strict=True):
            curve = curves_by_name[name]
            if not covers(curve, float(mode)):
                causes.append(
                    f"{path.name} was measured from {curve.frequency.min():.4g} to {curve.frequency.max():.4g} Hz"
                )
            elif np.any((curve.omitted > low) & (curve.omitted < high)):
                causes.append(f"frequencies near this mode were omitted in {path.name} (see the warnings)")
        reason = "; ".join(causes) or "no separate peak in the first recording, or too few points around it"
        lines.append(f"  {name}, mode at {label}: not compared: {reason}")
    return lines


@dataclass(frozen=True)
class MeasurementPoints:
    """Measurement points of a recording: the bodies that are driven, and the location of each response."""

    path: Path
    force_on: tuple[int, ...]  # numbers of the driven bodies
    channels: dict[str, str]  # location of each response channel, by its name
    # Identifier of the sensors of each response and of its reference; empty if several sensors measure the reference.
    sensors: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, path: Path, rec: Recording) -> MeasurementPoints:
        """Return the measurement points of a recording."""
        names = response_channels(rec)
        reference_channels, sensors = reference_of(rec, default_reference(rec)).channels, {}
        if len(reference_channels) == 1:
            for name in names:
                sensor_data = [rec.channels[channel].to_metadata() for channel in (name, *reference_channels)]
                sensors[name] = json.dumps([rec.scene.seed, *sensor_data], sort_keys=True)
        return cls(path, rec.scene.force_on, {name: rec.channels[name].at for name in names}, sensors)

    def same_sensors(self, first: MeasurementPoints) -> list[str]:
        """Return the responses that were measured with the same response and force sensors in both recordings."""
        return [name for name, sensor in self.sensors.items() if first.sensors.get(name) == sensor]

    def comparable_with(self, first: MeasurementPoints) -> None:
        """Raise `SceneError` if the recordings share no response, or if equal names denote different points."""
        if self.force_on != first.force_on:
            raise SceneError(
                f"{self.path}: driven at {_bodies(self.force_on)}, {first.path} at {_bodies(first.force_on)}, so "
                "their responses cannot be compared. Give recordings with the force on the same body."
            )
        common = [name for name in first.channels if name in self.channels]
        for name in common:
            if self.channels[name] != first.channels[name]:
                raise SceneError(
                    f"{self.path}: {name} is at {self.channels[name]}, but at {first.channels[name]} in {first.path}. "
                    "Give the same names to channels on the same bodies."
                )
        if not common:
            raise SceneError(
                f"{self.path}: its responses are {_channel_list(self.channels)}, but those of {first.path} are "
                f"{_channel_list(first.channels)}. Give the same names to channels on the same bodies."
            )


def _bodies(numbers: Sequence[int]) -> str:
    return " and ".join(f"body {number}" for number in numbers) or "no body"


def _channel_list(channels: dict[str, str]) -> str:
    return ", ".join(f"{name} (at {at})" for name, at in channels.items()) or "none"


def _row(before: Response, after: Response, change: PeakChange) -> tuple[str | float, ...]:
    peaks = (change.baseline.value, change.baseline.expanded, change.damped.value, change.damped.expanded)
    labels = (before.label, after.label, change.response, before.input, change.mode)
    return (*labels, *change.decibel, *change.shift, *peaks)
