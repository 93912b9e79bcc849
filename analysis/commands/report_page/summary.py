"""Summary at the top of a report: at most three texts, derived from the same results as its tables."""

from collections.abc import Sequence
from itertools import chain
from math import isfinite
from operator import le

import numpy as np
from numpy.typing import NDArray

from analysis.commands.figures.tolerance_texts import unstated_text
from analysis.commands.presentation.damper_findings import detection_limits
from analysis.commands.presentation.mode_findings import MIN_SAME_SHAPE_MAC
from analysis.commands.report_page.levels import level_headline, level_points
from analysis.commands.report_page.measurements import Measurement, SweepResults, force_deviation, missing_tolerances
from analysis.commands.report_page.sweep_changes import SweepChange
from analysis.commands.report_page.tables import change_text
from analysis.core.damper_motion.dampers import Dampers
from analysis.core.decays.free_decay import NO_INTERVAL
from analysis.core.modal.mode_warnings import MAX_LINEAR_RESIDUAL
from analysis.core.recordings.descriptions import validity_texts
from analysis.core.signals.shock_spectrum import scatter_text
from daq.core.recording.recorded_test import deviation_unit, shocks_of
from rig.core.results import format_frequencies, format_limited, format_percent
from rig.core.scene.excitation import FORCE_TOLERANCE

# Maximum number of statements: a reader takes in three; the tables contain the other results.
_MAX_TEXTS = 3


def summarize(measurements: Sequence[Measurement], changes: Sequence[SweepChange]) -> list[str]:
    """Return texts about control, decays, peak `changes` (or resonances) and impacts, with a line for each fact."""
    texts = [text for each in measurements for text in _control_texts(each)]
    texts += _change_texts(changes) + _decay_texts(measurements)
    for measurement in measurements:
        levels = level_points(measurement)
        if not changes:
            texts += [level_headline(measurement, levels)] if levels else _resonance_texts(measurement)
        texts += _impact_texts(measurement)
    texts = texts or [text for each in measurements for text in _response_texts(each)]
    return texts[:_MAX_TEXTS] or ["No result: see the warnings."]


def limitations(measurements: Sequence[Measurement]) -> list[str]:
    """Return sentences about the faults of each recording, and about errors that the intervals do not include."""
    texts = []
    for measurement in measurements:
        rec = measurement.rec
        faults = validity_texts(rec)
        if not rec.scene.is_linear and any(sweep.frfs[0].amplitude is None for sweep in measurement.sweeps):
            faults.append("the intervals assume linearity")
        residual = max(
            (sweep.modes.model_error for sweep in measurement.sweeps if sweep.modes is not None), default=0.0
        )
        if residual > MAX_LINEAR_RESIDUAL:
            faults.append(f"the modes leave a residual of {format_percent(residual)} of the peak height")
        faults += [] if measurement.profile is None else measurement.profile.excesses()
        faults += [] if measurement.tracked is None else measurement.tracked.omissions()
        if rec.gaps:
            faults.append(f"lost samples at {len(rec.gaps)} place{'s' * (len(rec.gaps) > 1)}")
        for sweep in measurement.sweeps:
            frf = sweep.frfs[0].sorted()
            if frf.unsteady is not None and frf.unsteady.any():
                where = format_frequencies(frf.frequency.tolist(), frf.unsteady.tolist())
                faults.append(f"no steady state at {where}")
            deviation = force_deviation(measurement, frf)
            if (outside := deviation > FORCE_TOLERANCE).any():
                where = format_frequencies(frf.frequency.tolist(), outside.tolist())
                faults.append(f"force up to {format_percent(float(deviation.max()))} from its level at {where}")
        if any(faults):
            texts.append(f"“{measurement.label}”: {'; '.join(dict.fromkeys(filter(None, faults)))}.")
    if missing := missing_tolerances([each for each in measurements if not each.spectra]):
        texts.append(f"The intervals do not include {unstated_text(missing)}.")
    return texts


def _control_texts(measurement: Measurement) -> list[str]:
    """Return a sentence on the controlled motion of a test: its profile, or its shocks."""
    if measurement.profile is not None:
        return [measurement.profile.agreement().replace("; ", "\n")]
    shocks = shocks_of(measurement.rec.markers)
    if not shocks:
        return []
    factor, unit = deviation_unit(shocks[0])
    deviations, tolerances = (
        [factor * float(shock.fields[key]) for shock in shocks] for key in ("deviation", "tolerance")
    )
    within = sum(map(le, deviations, tolerances))
    text = (
        f"“{measurement.label}”: {within} of {len(shocks)} shocks within the tolerance of {tolerances[0]:.3g} {unit}; "
        f"largest deviation {max(deviations):.3g} {unit}."
    )
    if measurement.spectra:
        details = f"Q = {measurement.spectra[0][0].q:g}, {scatter_text(measurement.spectra)}"
        text += f" Largest values of the shock response spectra of the first shock, {details}:"
    for each, *_ in measurement.spectra:
        peak = int(np.argmax(each.maximax))
        text += f"\n{each.channel}: {each.maximax[peak]:.3g} {each.unit} at {each.frequency[peak]:.3g} Hz"
    return [text]


def _change_texts(changes: Sequence[SweepChange]) -> list[str]:
    """List, for each other recording and level, the change of the highest peak of each mode."""
    texts = []
    for recording in dict.fromkeys(change.recording for change in changes):
        of_recording = [change for change in changes if change.recording == recording]
        first, *others = (
            [change for change in of_recording if change.compared == label]
            for label in dict.fromkeys(change.compared for change in of_recording)
        )
        levels = [f"{level[0].level}: {_change_line(_best_determined(level)[0])}" for level in others]
        texts.append("\n".join([_change_text(first), *levels]))
    return texts


def _best_determined(changes: Sequence[SweepChange]) -> list[SweepChange]:
    """Return the change of the highest peak of each mode, the best determined first, unbounded changes last."""
    highest: dict[float, SweepChange] = {}
    for each in sorted(changes, key=_baseline_height):
        highest[each.change.mode] = each

    def rank(each: SweepChange) -> tuple[bool, float]:
        _, low, high = each.change.decibel
        # Of the unbounded changes, the highest peak is first.
        return not (isfinite(low) and isfinite(high)), high - low if isfinite(high - low) else -_baseline_height(each)

    return sorted(highest.values(), key=rank)


def _change_text(changes: Sequence[SweepChange]) -> str:
    """Describe the changes at one level: a line for each mode of the baseline."""
    lines = [
        f"“{changes[0].compared}” compared with “{changes[0].baseline}”, highest peak of each mode (95 % interval):"
    ]
    compared = {each.change.mode: _change_line(each) for each in _best_determined(changes)}
    not_compared = "not compared, because its peak is not inside the common band"
    labels = {each.change.mode: each.change.mode_label for each in changes} | dict(changes[0].modes)
    lines += [compared.get(mode) or f"{labels[mode]}: {not_compared}" for mode in sorted(labels)]
    if not any(isfinite(limit) for each in changes for limit in each.change.decibel[1:]):
        lines.append(
            "Measure around the peaks with a smaller frequency spacing, upward and downward, without overloads."
        )
    return "\n".join(lines)


def _change_line(described: SweepChange) -> str:
    """Describe the change of one peak, with its heights if both are known."""
    change, (unit, factor) = described.change, described.shown_in
    differs = f"; mode shapes differ, MAC {described.mac:.2f}" * (described.mac < MIN_SAME_SHAPE_MAC)
    text = f"{change.mode_label} ({change.response}): {change_text(change)}"
    text += ", not significant" * (change.significance == "no")
    return f"{text}, {' → '.join(change.height_texts(factor))} {unit}{differs}"


def _baseline_height(change: SweepChange) -> float:
    """Return the height of the peak in the baseline [m/N]."""
    return change.change.baseline.value


def _response_texts(measurement: Measurement) -> list[str]:
    """For each sweep without an identified mode, describe the response with the highest value."""
    known = ([frf for frf in sweep.frfs if np.isfinite(frf.value).any()] for sweep in measurement.sweeps)
    return [f"{max(frfs, key=lambda frf: abs(frf.value[frf.peak_line()])).summary()}." for frfs in known if frfs]


def _resonance_texts(measurement: Measurement) -> list[str]:
    """List natural frequencies, damping ratios and the highest response of a test at one level."""
    for sweep in measurement.sweeps:
        if sweep.modes is not None and (count := sweep.modes.frequency.size):
            lines = [
                f"{sweep.modes.frequency_text(k)}: damping ratio {sweep.damping_text(k)}"
                for k in np.argsort(sweep.modes.frequency).tolist()
            ]
            uncertain = sweep.modes.uncertain_count_text()
            heading = f"“{sweep.label}”: {count} resonance{'s' * (count != 1)}{uncertain} (95 % intervals)"
            return ["\n".join(filter(None, [heading, *lines, _highest_peak(sweep)]))]
    return []


def _highest_peak(sweep: SweepResults) -> str:
    """Write the highest peak, at the natural frequency of its mode if it is known; empty without a peak."""
    if sweep.highest is None:
        return ""
    curve, highest = sweep.highest
    mode = next((k for k, peak in enumerate(sweep.peaks) if peak is not None and peak[1] is highest), None)
    where = f"{highest.frequency:.4g} Hz"
    if mode is not None and sweep.modes is not None:
        where = f"mode at {sweep.modes.frequency_label(mode)}"
    unit, factor = curve.shown_in
    return f"highest {curve.name}: {highest.height_text(factor, unit)} ({curve.ratio}, {where})"


def _impact_texts(measurement: Measurement) -> list[str]:
    """Report the detected impacts of all sweeps, the detection limit, and the energy of a test at one level."""
    results = [result for result in measurement.dampers if result.bodies]
    if not results:
        return []
    motions = [[*chain(*of_body)] for of_body in zip(*(each.bodies for each in results), strict=True)]
    frequency = np.concatenate([result.sweep.lines.frequency for result in results])
    has_impacts = np.any([[each.floor > 0 or each.ceiling > 0 for each in of_body] for of_body in motions], axis=0)
    text = f"no damper impact was detected at any of {frequency.size} measured points"
    energy = ""
    if has_impacts.any():
        listed = format_frequencies(frequency.tolist(), has_impacts.tolist())
        text = f"damper impacts were detected at {has_impacts.sum()} of {frequency.size} measured points ({listed})"
        energy = _largest_share(results[0], has_impacts) if len(results) == 1 else ""
    limits = detection_limits(motions)
    return [f"“{measurement.label}”: {text}; impacts with a velocity jump below {limits} are not detectable{energy}."]


def _largest_share(result: Dampers, has_impacts: NDArray[np.bool_]) -> str:
    """Write the largest dissipated share of the supplied energy; empty if it is not determined."""
    frequency, energy = result.sweep.lines.frequency, result.energy
    if energy is None:
        return ""
    share, expanded = energy.dampers / energy.supplied, energy.expanded / energy.supplied
    largest = int(np.argmax(np.where(energy.supplied > 0, share - expanded, -np.inf)))
    if not share[largest] > expanded[largest] > 0:
        return ""
    # The chart shows whole percents.
    percent, percent_expanded = 100.0 * float(share[largest]), 100.0 * float(expanded[largest])
    value = f"{percent:.0f}" if percent_expanded < 0.5 else format_limited(percent, percent_expanded, 100.0)
    unseen = "" if has_impacts[largest] else ", where the impacts are below the detection limit"
    return f"; the dampers dissipate up to {value} % of the supplied energy (at {frequency[largest]:.4g} Hz{unseen})"


def _decay_texts(measurements: Sequence[Measurement]) -> list[str]:
    """Compare the times after which free decays are below 1 g, where no damper leaves its floor, and 6 dB lower."""
    decays = {each.label: each.decay for each in measurements if each.decay is not None}
    if not decays:
        return []
    channels = ", ".join(dict.fromkeys(result.channel for result in decays.values()))
    names = f": {' → '.join(f'“{label}”' for label in decays)}" if len(decays) > 1 else ""
    lines = [f"Free decay of {channels}; {NO_INTERVAL}{names}"]
    for name, definition, times in (
        ("below 1 g after", "", [result.quiet_from for result in decays.values()]),
        ("6 dB lower after", " (from the slope between -1 and -11 dB)", [result.halving for result in decays.values()]),
    ):
        texts = " → ".join("–" if np.isnan(time) else f"{time:.2g} s" for time in times)
        lines.append(f"{name}: about {texts}{definition}")
    return ["\n".join(lines)]
