"""Types of motion told from the channels at each frequency against the engine's events, where a type is named."""

from __future__ import annotations

import numpy as np

from analysis.dampers.impact_detection import impacts
from analysis.dampers.nonlinearity import damper_motion
from analysis.responses.stepped_sine import sweeps
from tests.gauntlet.cavities import STEPS
from tests.gauntlet.judges.impacts import seen_for_itself, true_impacts
from tests.gauntlet.verdict import Case, Verdict

NAMED = ("riding", "I", "II", "III")
# Of the points where a type is named, so many must be right.
FEWEST_RIGHT = 0.8
# Impacts per period that may be missing at the ends of a window.
_ONCE = 0.1


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare the types of all dampers; the points are those where one is named."""
    if kind != STEPS:
        return []
    right, points, notes = 0, 0, []
    for sweep in sweeps(case.recording):
        for number, damper in enumerate(case.scene.dampers, 1):
            motions = damper_motion(case.recording, sweep, f"a{damper.body}")
            for motion, window in zip(motions, sweep.windows, strict=True):
                if motion.name not in NAMED:
                    continue
                true = _true_type(case, number, motion.frequency, *map(int, window))
                points += 1
                right += motion.name == true
                if motion.name != true:
                    notes.append(f"a{damper.body} at {motion.frequency:.4g} Hz: {motion.name}, is {true}")
    outcome = "right" if right >= FEWEST_RIGHT * points else "wrong"
    return [Verdict("motion_types", kind, outcome, right, points, note="; ".join(notes))] if points else []


def _true_type(case: Case, number: int, frequency: float, first: int, stop: int) -> str:
    """Type by what struck in a window; impacts that are too small, or too near to a larger one, do not count."""
    rec = case.recording
    time, jump = true_impacts(case, number)
    inside = (time >= first / rec.rate) & (time < stop / rec.rate)
    found = impacts(rec, f"a{case.scene.dampers[number - 1].body}", first, stop)
    inside &= seen_for_itself(time, jump, found)
    periods = (stop - first) / rec.rate * frequency
    floor, ceiling = np.sum(jump[inside] < 0.0) / periods, np.sum(jump[inside] > 0.0) / periods
    if floor == ceiling == 0.0:
        return "riding"
    if abs(floor - 1.0) < _ONCE and ceiling < _ONCE:
        return "I"
    if abs(floor - 1.0) < _ONCE and abs(ceiling - 1.0) < _ONCE:
        stays = np.any(rec.truth("contact")[number - 1, first:stop] == 2)
        return "III" if stays else "II"
    return f"{floor:.2f} floor, {ceiling:.2f} ceiling"
