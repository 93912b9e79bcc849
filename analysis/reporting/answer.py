"""Summary of a report: at most three sentences, derived from the same results as its tables."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np

from analysis.damper_motion.comparison import PeakChange
from analysis.damper_motion.dampers import Dampers
from analysis.reporting.measured import Measured
from analysis.reporting.tables import peak_height, with_bound
from rig.results import format_frequencies

# Number of sentences in the summary.
_MAX_SENTENCES = 3


def answer(measurements: Sequence[Measured], changes: Sequence[tuple[Measured, Measured, PeakChange]]) -> list[str]:
    """Summarize the results: decays, then comparisons, then resonances and dampers.

    `measurements`: all recordings of the report; `changes`: result of `Measurements.changes`.
    """
    sentences = _decays(measurements) + _comparisons(changes)
    for measured in measurements:
        if not changes:
            sentences += _resonances(measured)
        sentences += [text for result in measured.dampers for text in _dampers(measured, result)]
    return sentences[:_MAX_SENTENCES] or ["No result: see the warnings."]


def _comparisons(changes: Sequence[tuple[Measured, Measured, PeakChange]]) -> list[str]:
    """Describe, for each other recording, the change of the highest peak whose change is bounded."""
    sentences = []
    for label in dict.fromkeys(other.label for _, other, _ in changes):
        changes_of_label = [(first, change) for first, other, change in changes if other.label == label]
        bounded = [pair for pair in changes_of_label if all(map(isfinite, pair[1].decibel))]
        first, highest = max(changes_of_label, key=lambda pair: pair[1].bare.value)
        if not bounded:
            sentences.append(
                f"“{label}” against “{first.label}”: the measured points do not determine the change of the peaks."
            )
            continue
        _, change = max(bounded, key=lambda pair: pair[1].bare.value)
        best, low, high = change.decibel
        peak_text = f"the peak at {change.mode:.2f} Hz ({change.response})"
        if low <= 0.0 <= high:
            text = (
                f"“{label}” against “{first.label}”: no significant change of {peak_text}, {low:+.1f} to {high:+.1f} dB"
            )
        else:
            verb = "lowers" if best < 0.0 else "raises"
            text = (
                f"Compared with “{first.label}”, “{label}” {verb} {peak_text} by {abs(best):.1f} dB "
                f"(95 % interval {min(abs(low), abs(high)):.1f} to {max(abs(low), abs(high)):.1f} dB), "
                f"from {1e6 * change.bare.value:.4g} to {1e6 * change.damped.value:.4g} µm/N"
            )
        if highest.mode != change.mode:
            text += f"; the change of the highest peak ({highest.mode:.2f} Hz) cannot be determined"
        sentences.append(f"{text}.")
    return sentences


def _resonances(measured: Measured) -> list[str]:
    sentences = []
    for sweep in measured.passes:
        modes = sweep.modes
        if modes is None or not modes.frequency.size:
            continue
        pairs = sorted(zip(modes.frequency, modes.damping, strict=True))
        listed = ", ".join(f"{frequency:.4g} Hz ({100 * damping:.2g} % damping)" for frequency, damping in pairs)
        plural = "s" * (modes.frequency.size != 1)
        text = f"“{measured.label}”: {modes.frequency.size} resonance{plural} at {listed}"
        if sweep.highest is not None:
            curve, highest = sweep.highest
            where = f"{curve.ratio}, {highest.frequency:.4g} Hz"
            text += f"; the highest compliance is {peak_height(highest)} µm/N ({where})"
        sentences.append(f"{text}.")
    return sentences


def _dampers(measured: Measured, result: Dampers) -> list[str]:
    """State the frequencies with detected impacts, and the largest dissipated share of the supplied energy."""
    frequency = result.sweep.lines.frequency
    hit = np.zeros(frequency.size, dtype=bool)
    for motions in result.bodies:
        hit |= [motion.floor > 0 or motion.ceiling > 0 for motion in motions]
    if not result.bodies:
        return []
    if not hit.any():
        return [f"“{measured.label}”: no impact of a damper was detected at any of {frequency.size} frequencies."]
    text = (
        f"“{measured.label}”: damper impacts at {int(hit.sum())} of {frequency.size} frequencies "
        f"({format_frequencies(frequency.tolist(), hit.tolist())})"
    )
    energy = result.energy
    if energy is not None:
        share, bound = energy.dampers / energy.supplied, energy.bound / energy.supplied
        top = int(np.argmax(np.where(energy.supplied > 0, share - bound, -np.inf)))
        if share[top] > bound[top] > 0:
            value = with_bound(100 * float(share[top]), 100 * float(bound[top]))
            text += f"; they dissipate up to {value} % of the supplied energy (at {frequency[top]:.4g} Hz)"
    return [f"{text}."]


def _decays(measurements: Sequence[Measured]) -> list[str]:
    parts = []
    for measured in measurements:
        result = measured.decay
        if result is None:
            continue
        quiet = result.quiet_from
        below = "stays above 1 g" if np.isnan(quiet) else f"falls below 1 g after {quiet:.3g} s"
        falls = "" if np.isnan(result.halving) else f" and its energy level decreases by 6 dB in {result.halving:.3g} s"
        parts.append(f"“{measured.label}”: after the hit, {result.channel} {below}{falls}")
    return [f"{'; '.join(parts)}."] if parts else []
