"""Table of the results at several levels: natural and excitation frequency, damping, amplitude and energy."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise

import numpy as np
import scipy

from analysis.commands.figures.peak_marks import MODE_SHIFT
from analysis.commands.figures.tolerance_texts import intervals_text
from analysis.commands.report_page.measurements import Measurement, SweepResults, missing_tolerances
from analysis.core.damper_motion.dampers import Dampers
from analysis.core.modal.mode_warnings import extrapolates_damping
from analysis.core.recordings.names import sweep_name, without_common_direction
from analysis.core.tracking.body_motion import LevelPoint, quantity_ranges, table_of_levels
from rig.core.results import format_limited, format_number
from rig.core.results.response import Response
from rig.core.results.table import join_tables
from rig.core.results.uncertainty import expand

# Smallest stated uncertainty of an amplitude and of an energy, relative: no sensor is more accurate.
_LEAST_RATIO = 1e-3
# Quantities that the headline does not repeat.
_ONLY_IN_TABLE = ("excitation frequency", "phase deviation")
_MODE_CAPTION = (
    "Natural frequency and damping ratio are those of the mode; the excitation frequency, the amplitude and the energy "
    "are those of {}. The two frequencies differ where other modes contribute to the motion{}."
)


def level_points(measurement: Measurement) -> dict[str, list[LevelPoint]]:
    """Return the points at all levels of a test for each mode of its first level; empty for a single level.

    The keys name the modes; a single mode has the key "".
    """
    dampers: dict[str, list[Dampers]] = {}
    if measurement.tracked is not None:
        for result in measurement.dampers:
            dampers.setdefault(f"{format_number(result.sweep.level)} {measurement.tracked.unit}", []).append(result)
        points = measurement.tracked.level_points()
        return {"": [_with_energy(point, dampers.get(point.level, ())) for point in points]}
    sweeps = [sweep for sweep in measurement.sweeps if sweep.modes is not None and sweep.modes.frequency.size]
    if len(sweeps) < 2 or sweeps[0].modes is None:
        return {}
    for result in measurement.dampers:
        dampers.setdefault(result.label, []).append(result)
    levels = without_common_direction([sweep_name(sweep.label, measurement.label) for sweep in sweeps])
    # All levels state the response that is highest at the first level.
    ratios = ["" if highest is None else highest[0].ratio for highest in sweeps[0].peaks]
    labels = map(sweeps[0].modes.frequency_label, range(len(ratios)))
    modes = sorted(zip(sweeps[0].modes.frequency.tolist(), labels, ratios, strict=True))
    return {
        f"mode at {label}" * (len(modes) > 1): [
            _with_energy(_mode_point(measurement, sweep, level, band, ratio), dampers.get(sweep.label, ()))
            for sweep, level in zip(sweeps, levels, strict=True)
        ]
        for (_, label, ratio), band in zip(modes, _bands([frequency for frequency, *_ in modes]), strict=True)
    }


def level_headline(measurement: Measurement, groups: Mapping[str, Sequence[LevelPoint]]) -> str:
    """State each quantity over the levels, a line for each; with several modes, a line for each mode."""
    [first, *_] = groups.values()
    lines = [f"“{measurement.label}”: {len(first)} levels (95 % intervals)"]
    for title, points in groups.items():
        ranges = quantity_ranges(points)
        if title:
            ranges = {title: "; ".join(f"{name} {ranges[name]}" for name in list(ranges)[:2])}
        lines += [f"{name}: {text}" for name, text in ranges.items() if name not in _ONLY_IN_TABLE]
    remarks: dict[tuple[str, str], list[str]] = {}
    for title, points in groups.items():
        for point in points:
            if point.note:
                remarks.setdefault((title, point.note), [title] * bool(title)).append(point.level)
    return "\n".join([*lines, *(f"{', '.join(names)}: {note}" for (_, note), names in remarks.items())])


def level_table(measurements: Sequence[Measurement]) -> str:
    """Return a table of the results at each level of all tests with several levels, as HTML; empty without levels."""
    tests = {measurement.label: level_points(measurement) for measurement in measurements}
    points = [point for groups in tests.values() for group in groups.values() for point in group]
    keys = list(dict.fromkeys(key for point in points for key in point.quantities))
    tables = [
        (", ".join(filter(None, (label, title))) * (len(measurements) > 1 or bool(title)), table_of_levels(group, keys))
        for label, groups in tests.items()
        for title, group in groups.items()
    ]
    caption = f"Results at each level, with {intervals_text(missing_tolerances(measurements))}"
    if "phase deviation / °" in keys:
        caption += ". " + _MODE_CAPTION.format("phase resonance", "")
    elif "natural frequency / Hz" in keys:
        caption += ". " + _MODE_CAPTION.format(
            "the highest measured point", ", and by up to the distance of the measured frequencies"
        )
    return join_tables(tables).html(caption)


def _bands(frequencies: Sequence[float]) -> list[tuple[float, float]]:
    """Return, for each mode at the first level in ascending order, the band [Hz] in which it may be at other levels."""
    middles = [0.0, *((low + high) / 2.0 for low, high in pairwise(frequencies)), np.inf]
    return [
        (max(low, (1.0 - MODE_SHIFT) * each), min(high, (1.0 + MODE_SHIFT) * each))
        for each, (low, high) in zip(frequencies, pairwise(middles), strict=True)
    ]


def _mode_point(
    measurement: Measurement, sweep: SweepResults, level: str, band: tuple[float, float], ratio: str
) -> LevelPoint:
    """Return natural frequency and damping of the mode in a `band` [Hz], and the highest measured point of its peak."""
    # Within the band, the flank of another mode's peak may be higher; `sweep.found` contains only peaks.
    modes, test = sweep.modes, measurement.rec.scene.test
    assert modes is not None
    inside = np.flatnonzero((band[0] < modes.frequency) & (modes.frequency < band[1])).tolist()
    if not inside:
        return LevelPoint(level, np.nan, {}, "not identified")
    curve = next((frf for frf in sweep.frfs if frf.ratio == ratio), None)
    peaks = {mode: peak for mode in inside for frf, peak in sweep.found[mode] if frf.ratio == ratio}
    if peaks:
        mode = max(peaks, key=lambda each: peaks[each].value)
        center = peaks[mode].frequency
    else:
        # Two modes may describe the peak of a nonlinear response that lies between them.
        top = None if curve is None else _highest_maximum(curve, band)
        mode = min(inside, key=lambda each: abs(modes.frequency[each] - (sum(band) / 2.0 if top is None else top)))
        center = float(modes.frequency[mode]) if top is None else top
    frequency, damping = float(modes.frequency[mode]), 100.0 * float(modes.damping[mode])
    uncertainties = (float(expand(error[mode])) for error in (modes.frequency_std, 100.0 * modes.damping_std))
    quantities = {
        "natural frequency / Hz": (frequency, format_limited(frequency, next(uncertainties))),
        "damping ratio / %": (damping, format_limited(damping, next(uncertainties), 100.0)),
    }
    note = "damping extrapolated" * bool(extrapolates_damping(modes, sweep.frfs)[mode])
    if curve is None or not np.isfinite(curve.value).any():
        return LevelPoint(level, np.nan, quantities, note)
    # The highest point of a peak is one of the two next to its estimated maximum.
    distance = np.where(np.isfinite(curve.value), abs(curve.frequency - center), np.inf)
    line = int(max(np.argsort(distance)[:2], key=lambda each: np.nan_to_num(abs(curve.value[each]))))
    excited_at = float(curve.frequency[line])
    quantities["excitation frequency / Hz"] = excited_at, f"{excited_at:.4g}"
    held = None if test is None else test.held_motion
    shown = next((frf for frf in sweep.frfs if held is not None and frf.outputs[0].at == held[0]), curve)
    motion = shown.to("displacement")
    if motion.amplitude is not None and motion.reference == "force":
        force = 1e3 * float(motion.amplitude[line])
        amplitude, expanded = (force * float(values[line]) for values in (abs(motion.value), motion.expanded()))
        place = measurement.rec.scene.structure.label(shown.outputs[0].at) or shown.response
        quantities[f"amplitude of {place} / mm"] = (
            amplitude,
            format_limited(amplitude, max(expanded, _LEAST_RATIO * amplitude)),
        )
    unit, factor = curve.shown_in
    # Without an estimate of the peak, the highest point is its lower bound.
    point = factor * float(abs(curve.value[line]) - curve.expanded()[line])
    height = next(
        ((factor * peak.value, peak.height_text(factor)) for frf, peak in sweep.found[mode] if frf is curve),
        (point, f"≥ {point:.4g}" if point > 0.0 else "not determined"),
    )
    quantities[f"peak of {curve.name} at {curve.response} / ({unit})"] = height
    return LevelPoint(level, excited_at, quantities, note)


def _highest_maximum(curve: Response, band: tuple[float, float]) -> float | None:
    """Return the frequency [Hz] in a band with the highest maximum of a response's magnitude, None without maximum."""
    maxima, _ = scipy.signal.find_peaks(np.nan_to_num(abs(curve.value)))
    inside = [line for line in maxima.tolist() if band[0] < curve.frequency[line] < band[1]]
    return float(curve.frequency[max(inside, key=lambda line: abs(curve.value[line]))]) if inside else None


def _with_energy(point: LevelPoint, results: Iterable[Dampers]) -> LevelPoint:
    """Add the share of the supplied energy that the dampers dissipate at a point's frequency and level."""
    energy = next((result.energy for result in results if result.energy is not None), None)
    if energy is None or not np.isfinite(point.frequency):
        return point
    line = int(np.argmin(abs(energy.frequency - point.frequency)))
    percent, expanded = (
        100.0 * float(part[line] / energy.supplied[line]) for part in (energy.dampers, energy.expanded)
    )
    text = format_limited(percent, max(expanded, 100.0 * _LEAST_RATIO), 100.0)
    return point._replace(quantities={**point.quantities, "energy dissipated by dampers / %": (percent, text)})
