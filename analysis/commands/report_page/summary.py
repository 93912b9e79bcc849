"""Summary at the top of a report: at most three sentences, derived from the same results as its tables."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite

import numpy as np

from analysis.commands.presentation.damper_findings import detection_limits
from analysis.commands.report_page.measurements import Measurement, SweepChange, SweepResults
from analysis.commands.report_page.tables import change_interval, peak_height, with_bound
from analysis.core.damper_motion.comparison import Peak
from analysis.core.damper_motion.dampers import Dampers
from rig.core.results import format_decimals, format_frequencies, round_to_bound
from rig.core.results.response import Response

# Number of sentences in the summary.
_MAX_SENTENCES = 3


def summarize(measurements: Sequence[Measurement], changes: Sequence[SweepChange]) -> list[str]:
    """Return sentences about decays, then peak changes (if none, resonances) and damper impacts.

    `measurements`: all recordings of the report; `changes`: from `Measurements.changes`.
    """
    sentences = _decay_sentences(measurements) + _change_sentences(changes)
    for measurement in measurements:
        if not changes:
            sentences += _resonance_sentences(measurement)
        sentences += [text for result in measurement.dampers for text in _impact_sentences(measurement, result)]
    return sentences[:_MAX_SENTENCES] or ["No result: see the warnings."]


def _change_sentences(changes: Sequence[SweepChange]) -> list[str]:
    """Describe, for each other recording, the change of the highest peak whose change has a bound, at all levels."""
    sentences = []
    for recording in dict.fromkeys(sweep.recording for sweep in changes):
        of_recording = [sweep for sweep in changes if sweep.recording == recording]
        first, *others = (
            [sweep for sweep in of_recording if sweep.after == label]
            for label in dict.fromkeys(sweep.after for sweep in of_recording)
        )
        levels = "; ".join(map(_short_change, others))
        sentences.append(_change_sentence(first) + (f" Other levels: {levels}." if levels else ""))
    return sentences


def _largest_bounded(changes: Sequence[SweepChange]) -> SweepChange | None:
    """Return the change of the highest peak whose change has a bound."""
    bounded = [sweep for sweep in changes if all(map(isfinite, sweep.change.decibel))]
    return max(bounded, key=_initial_height, default=None)


def _short_change(changes: Sequence[SweepChange]) -> str:
    """Describe the change of the highest peak at one level, in a few words."""
    largest = _largest_bounded(changes)
    if largest is None:
        return f"{changes[0].level}, not determined"
    decimals = largest.change.decibel_decimals
    value, low, high = (f"{limit:+.{decimals}f}" for limit in largest.change.decibel)
    peak = f"{largest.change.response}, {format_decimals(largest.change.mode, 2)} Hz"
    return f"{largest.level}, {value} dB ({low} to {high} dB; {peak})"


def _change_sentence(changes: Sequence[SweepChange]) -> str:
    """Describe the change of the highest peak at one level whose change has a bound."""
    before, after = f"“{changes[0].before}”", f"“{changes[0].after}”"
    largest = _largest_bounded(changes)
    if largest is None:
        return (
            f"{after} against {before}: the measured points do not determine the change of the peaks. "
            "Measure around the peaks with a smaller frequency step, in both directions and without overloads."
        )
    change = largest.change
    change_db, low_db, high_db = change.decibel
    decimals = change.decibel_decimals
    peak_text = f"the peak at {format_decimals(change.mode, 2)} Hz ({change.response})"
    if low_db <= 0.0 <= high_db:
        interval = f"{low_db:+.{decimals}f} to {high_db:+.{decimals}f} dB"
        text = f"{after} against {before}: no significant change of {peak_text} (95 % interval {interval})"
    else:
        verb = "lowers" if change_db < 0.0 else "raises"
        smallest, largest_db = sorted((abs(low_db), abs(high_db)))
        unit, factor = largest.shown_in
        heights = [round_to_bound(factor * peak.value, factor * peak.bound) for peak in (change.bare, change.damped)]
        text = (
            f"Compared with {before}, {after} {verb} {peak_text} by {abs(change_db):.{decimals}f} dB "
            f"(95 % interval {smallest:.{decimals}f} to {largest_db:.{decimals}f} dB), "
            f"from {' to '.join(heights)} {unit}"
        )
    return f"{text}{_other_modes(changes, change.mode)}."


def _other_modes(changes: Sequence[SweepChange], stated: float) -> str:
    """Name the other modes of the reference: the change of the highest peak of each in dB, or why there is none."""
    parts = []
    highest = max(changes, key=_initial_height).change
    if highest.mode == stated and not all(map(isfinite, highest.decibel)):
        parts.append(f"{format_decimals(stated, 2)} Hz ({highest.response}, the highest), {change_interval(highest)}")
    for mode in sorted({*changes[0].modes, *(sweep.change.mode for sweep in changes)} - {stated}):
        of_mode = [sweep for sweep in changes if sweep.change.mode == mode]
        name = f"{format_decimals(mode, 2)} Hz"
        if not of_mode:
            parts.append(f"{name}, not compared, because its peak is not inside the common band")
            continue
        highest = max(of_mode, key=_initial_height).change
        parts.append(
            f"{name} ({highest.response}), {change_interval(highest)}{' dB' * all(map(isfinite, highest.decibel))}"
        )
    return f"; other peaks, 95 % intervals of the change: {'; '.join(parts)}" if parts else ""


def _initial_height(sweep: SweepChange) -> float:
    """Return the height of the peak in the first recording, m/N."""
    return sweep.change.bare.value


def _resonance_sentences(measurement: Measurement) -> list[str]:
    """List natural frequencies and damping ratios of each sweep, and its highest compliance.

    Of more sweeps than the summary has sentences, those after the first are listed with the highest compliance alone.
    """
    sweeps = [sweep for sweep in measurement.sweeps if sweep.modes is not None and sweep.modes.frequency.size]
    if len(sweeps) <= _MAX_SENTENCES:
        return [_resonance_sentence(sweep) for sweep in sweeps]
    others = "; ".join(
        f"{sweep.label.removeprefix(measurement.label).removeprefix(', ')}, {_highest_compliance(*sweep.highest)}"
        for sweep in sweeps[1:]
        if sweep.highest is not None
    )
    return [f"{_resonance_sentence(sweeps[0])} Other levels: {others}."]


def _resonance_sentence(sweep: SweepResults) -> str:
    """List natural frequencies and damping ratios of a sweep, and its highest compliance."""
    modes = sweep.modes
    assert modes is not None
    listed = ", ".join(
        f"{modes.frequency_text(k)} with a damping ratio of {modes.damping_text(k)}"
        for k in np.argsort(modes.frequency).tolist()
    )
    plural = "s" * (modes.frequency.size != 1)
    text = f"“{sweep.label}”: {modes.frequency.size} resonance{plural} at {listed}"
    if sweep.highest is not None:
        text += f"; {_highest_compliance(*sweep.highest)}"
    return f"{text}."


def _highest_compliance(curve: Response, highest: Peak) -> str:
    where = f"{curve.ratio}, {highest.frequency:.4g} Hz"
    if highest.value < highest.bound < inf:
        return f"the height of the highest peak of the {curve.name} is not determined ({where})"
    return f"the highest {curve.name} is {peak_height(highest, curve.shown_in)} {curve.shown_in[0]} ({where})"


def _impact_sentences(measurement: Measurement, result: Dampers) -> list[str]:
    """Report the frequencies with detected impacts, and the largest dissipated fraction of the supplied energy."""
    if not result.bodies:
        return []
    frequency = result.sweep.lines.frequency
    has_impacts = np.zeros(frequency.size, dtype=bool)
    for motions in result.bodies:
        has_impacts |= [motion.floor > 0 or motion.ceiling > 0 for motion in motions]
    limits = f"impacts with a velocity step below {detection_limits(result.bodies)} are not detectable"
    if not has_impacts.any():
        undetected = f"no impact of a damper was detected at any of {frequency.size} frequencies"
        return [f"“{measurement.label}”: {undetected}; {limits}."]
    text = (
        f"“{measurement.label}”: damper impacts were detected at {int(has_impacts.sum())} of {frequency.size} "
        f"frequencies ({format_frequencies(frequency.tolist(), has_impacts.tolist())}); {limits}"
    )
    energy = result.energy
    if energy is not None:
        share, bound = energy.dampers / energy.supplied, energy.bound / energy.supplied
        largest = int(np.argmax(np.where(energy.supplied > 0, share - bound, -np.inf)))
        if share[largest] > bound[largest] > 0:
            # The chart shows whole percents.
            percent, percent_bound = 100 * float(share[largest]), 100 * float(bound[largest])
            value = f"{percent:.0f}" if percent_bound < 0.5 else with_bound(percent, percent_bound)
            text += f"; the dampers dissipate up to {value} % of the supplied energy (at {frequency[largest]:.4g} Hz)"
    return [f"{text}."]


def _decay_sentences(measurements: Sequence[Measurement]) -> list[str]:
    """Return one sentence with the time to fall below 1 g and the time of a fall by 6 dB, for each free decay."""
    parts = []
    for measurement in measurements:
        result = measurement.decay
        if result is None:
            continue
        time_below_1_g, time_of_6_db = result.quiet_from, result.halving
        text = "stays above 1 g" if np.isnan(time_below_1_g) else f"falls below 1 g after {time_below_1_g:.3g} s"
        if not np.isnan(time_of_6_db):
            text += f" and its energy level decreases by 6 dB in {time_of_6_db:.3g} s"
        parts.append(f"“{measurement.label}”: after the hit, {result.channel} {text}")
    return [f"{'; '.join(parts)}."] if parts else []
