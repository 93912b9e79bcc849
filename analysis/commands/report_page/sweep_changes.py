"""Changes of resonance peaks from the baseline to the other recordings of a report."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from analysis.commands.figures.peak_marks import MODE_SHIFT
from analysis.commands.presentation.comparison import MeasurementPoints
from analysis.commands.report_page.measurements import Measurement, Measurements
from analysis.core.damper_motion.comparison import PeakChange, peak_changes
from analysis.core.modal.modes import Modes, mac
from analysis.core.recordings.names import sweep_name
from rig.core.base.arrays import Array


class SweepChange(NamedTuple):
    """Change of one peak from the first sweep of the baseline to a sweep of a different recording."""

    baseline: str  # label of the first sweep of the baseline
    compared: str  # label of the compared sweep
    recording: str  # label of its recording
    change: PeakChange
    modes: Mapping[float, str] = {}  # natural frequencies of all modes of the baseline [Hz], and their labels
    shown_in: tuple[str, float] = ("µm/N", 1e6)  # unit of the peaks, and the factor from SI to this unit
    mac: float = 1.0  # modal assurance criterion between the mode and that of the compared sweep; 1 if unknown

    @property
    def level(self) -> str:
        """Level and direction of the compared sweep; empty if its recording has a single sweep."""
        return sweep_name(self.compared, self.recording)


def sweep_changes(measurements: Measurements) -> list[SweepChange]:
    """Compute the change of each resonance peak from the baseline to every other recording."""
    baseline = measurements.baseline
    others = [result for result in measurements.results if result is not baseline]
    if not baseline.sweeps or baseline.sweeps[0].modes is None:
        return []
    return [
        change
        for other in others
        if other.sweeps
        for change in measurements.attempt(other.path, "Comparison", _peak_changes, baseline, other) or ()
    ]


def _peak_changes(baseline: Measurement, other: Measurement) -> list[SweepChange]:
    """Return the change of each peak from the baseline to a different recording."""
    before = baseline.sweeps[0]
    assert before.modes is not None
    points, baseline_points = (
        MeasurementPoints.of(measurement.path, measurement.rec) for measurement in (other, baseline)
    )
    points.comparable_with(baseline_points)
    same_sensors = points.same_sensors(baseline_points)
    modes = {float(frequency): before.modes.frequency_label(k) for k, frequency in enumerate(before.modes.frequency)}
    return [
        SweepChange(
            before.label,
            after.label,
            other.label,
            change,
            modes,
            before.frfs[0].shown_in,
            _mac_of_mode(before.modes, after.modes, change.mode),
        )
        for after in other.sweeps
        for change in peak_changes(before.modes, before.frfs, after.frfs, same_sensors)
    ]


def common_mac(before: Modes, after: Modes) -> Array | None:
    """Return the modal assurance criterion at the common responses of two sweeps; None for fewer than two."""
    common = [name for name in before.responses if name in after.responses]
    shapes = [modes.shapes[[modes.responses.index(name) for name in common]] for modes in (before, after)]
    return mac(*shapes) if len(common) > 1 else None


def same_mode(modes: Modes, frequency: float) -> int | None:
    """Return the index of the mode that is nearest to a frequency [Hz]; None if no mode is similar."""
    deviation = abs(modes.frequency / frequency - 1.0)
    return int(np.argmin(deviation)) if np.min(deviation, initial=np.inf) < MODE_SHIFT else None


def _mac_of_mode(before: Modes, after: Modes | None, frequency: float) -> float:
    """Return the MAC between a mode of the baseline and the mode of similar frequency of a sweep; 1 if unknown."""
    if after is None or (values := common_mac(before, after)) is None:
        return 1.0
    first, second = same_mode(before, frequency), same_mode(after, frequency)
    return 1.0 if first is None or second is None else float(values[first, second])
