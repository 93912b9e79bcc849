"""Summary at the top of a report: at most three sentences, derived from the same results as its tables."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite

import numpy as np

from analysis.commands.presentation.damper_findings import detection_limits
from analysis.commands.report_page.measurements import Measurement
from analysis.commands.report_page.tables import peak_height, with_bound
from analysis.core.damper_motion.comparison import PeakChange
from analysis.core.damper_motion.dampers import Dampers
from rig.core.results import format_decimals, format_frequencies, round_to_bound

# Number of sentences in the summary.
_MAX_SENTENCES = 3


def summarize(
    measurements: Sequence[Measurement], changes: Sequence[tuple[Measurement, Measurement, PeakChange]]
) -> list[str]:
    """Return sentences about decays, then peak changes (if none, resonances) and damper impacts.

    `measurements`: all recordings of the report; `changes`: first recording, other recording and the change of one
    peak between them, from `Measurements.changes`.
    """
    sentences = _decay_sentences(measurements) + _change_sentences(changes)
    for measurement in measurements:
        if not changes:
            sentences += _resonance_sentences(measurement)
        sentences += [text for result in measurement.dampers for text in _impact_sentences(measurement, result)]
    return sentences[:_MAX_SENTENCES] or ["No result: see the warnings."]


def _change_sentences(changes: Sequence[tuple[Measurement, Measurement, PeakChange]]) -> list[str]:
    """Describe, for each other recording, the change of the highest peak whose change has a bound."""
    sentences = []
    for label in dict.fromkeys(other.label for _, other, _ in changes):
        first = changes[0][0]
        changes_of_label = [change for _, other, change in changes if other.label == label]
        bounded = [change for change in changes_of_label if all(map(isfinite, change.decibel))]
        if not bounded:
            sentences.append(
                f"“{label}” against “{first.label}”: the measured points do not determine the change of the peaks. "
                "Measure around the peaks with a smaller frequency step, in both directions and without overloads."
            )
            continue
        change = max(bounded, key=_initial_height)
        change_db, low_db, high_db = change.decibel
        decimals = change.decibel_decimals
        peak_text = f"the peak at {format_decimals(change.mode, 2)} Hz ({change.response})"
        if low_db <= 0.0 <= high_db:
            interval = f"{low_db:+.{decimals}f} to {high_db:+.{decimals}f} dB"
            text = f"“{label}” against “{first.label}”: no significant change of {peak_text} (95 % interval {interval})"
        else:
            verb = "lowers" if change_db < 0.0 else "raises"
            smallest, largest = sorted((abs(low_db), abs(high_db)))
            heights = [round_to_bound(1e6 * peak.value, 1e6 * peak.bound) for peak in (change.bare, change.damped)]
            text = (
                f"Compared with “{first.label}”, “{label}” {verb} {peak_text} by {abs(change_db):.{decimals}f} dB "
                f"(95 % interval {smallest:.{decimals}f} to {largest:.{decimals}f} dB), "
                f"from {' to '.join(heights)} µm/N"
            )
        highest = max(changes_of_label, key=_initial_height)
        if highest.mode != change.mode:
            text += f"; the change of the highest peak ({format_decimals(highest.mode, 2)} Hz) cannot be determined"
        sentences.append(f"{text}.")
    return sentences


def _initial_height(change: PeakChange) -> float:
    """Return the height of the peak in the first recording, m/N."""
    return change.bare.value


def _resonance_sentences(measurement: Measurement) -> list[str]:
    """List natural frequencies and damping ratios of each sweep, and its highest compliance."""
    sentences = []
    for sweep in measurement.sweeps:
        modes = sweep.modes
        if modes is None or not modes.frequency.size:
            continue
        listed = ", ".join(
            f"{modes.frequency_text(k)} with a damping ratio of {modes.damping_text(k)}"
            for k in np.argsort(modes.frequency).tolist()
        )
        plural = "s" * (modes.frequency.size != 1)
        label = modes.label if len(measurement.sweeps) > 1 else measurement.label
        text = f"“{label}”: {modes.frequency.size} resonance{plural} at {listed}"
        if sweep.highest is not None:
            curve, highest = sweep.highest
            where = f"{curve.ratio}, {highest.frequency:.4g} Hz"
            if highest.value < highest.bound < inf:
                text += f"; the height of the highest peak of the compliance is not determined ({where})"
            else:
                text += f"; the highest compliance is {peak_height(highest)} µm/N ({where})"
        sentences.append(f"{text}.")
    return sentences


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
            value = with_bound(100 * float(share[largest]), 100 * float(bound[largest]))
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
