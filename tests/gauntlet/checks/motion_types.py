"""Check of types of motion: types of damper motion estimated from the channels, compared with the recorded truth.

Type I: one impact on the floor in each period. Type II: also one impact on the ceiling. Type III: like II, but the
damper stays at the ceiling for a time. Riding: the damper stays at rest on the floor.
"""

import numpy as np
from numpy.typing import NDArray

from analysis.core.damper_motion.impact_detection import detect_impacts
from analysis.core.damper_motion.motion_types import damper_motion
from analysis.core.responses.stepped_sine import sweeps
from rig.core.numerics.runs import runs_of
from rig.core.steady_response.motion_type import MIN_STAY_RATIO
from rig.core.system.assembly import assemble
from tests.gauntlet.checks.impacts import MAX_DISTANCE_SAMPLES, detectable, score, true_impacts
from tests.gauntlet.finite_contact import STEPS_FINITE_CONTACT
from tests.gauntlet.instant_contact import STEPS
from tests.gauntlet.result import Case, CheckResult

TYPE_NAMES = ("riding", "I", "II", "III")
# Impacts occur once a period if no interval between them deviates from the period by more than this fraction.
_MAX_PERIOD_DEVIATION = 0.1


def check(case: Case, kind: str) -> list[CheckResult]:
    """Compare the types of all dampers; points are the frequencies at which the analysis names a type."""
    if kind not in (STEPS, STEPS_FINITE_CONTACT):
        return []
    n_correct, points, n_with_type, notes = 0, 0, 0, []
    for sweep in sweeps(case.recording):
        for number, damper in enumerate(case.scene.dampers, 1):
            motions = damper_motion(case.recording, sweep, f"a{damper.body}")
            for motion, window in zip(motions, sweep.windows, strict=True):
                true = _true_type(case, number, motion.frequency, *map(int, window))
                n_with_type += true in TYPE_NAMES
                if motion.name in TYPE_NAMES:
                    points += 1
                    n_correct += motion.name == true
                    if motion.name != true:
                        notes.append(f"a{damper.body} at {motion.frequency:.4g} Hz: {motion.name}, true {true}")
    outcome = "correct" if n_correct == points else "wrong"
    notes.append(f"{points} of {n_with_type} named")
    return [CheckResult("motion_types", kind, outcome, n_correct, points, note="; ".join(notes))]


def _true_type(case: Case, number: int, frequency: float, first: int, stop: int) -> str:
    """Return the true type of motion in a window of samples, or the impacts per period if the motion has no type.

    Impacts that are too small, or too close to a larger impact, count only if they are detected.
    """
    recording = case.recording
    events = recording.events[recording.events["damper"] == number]
    starts_on_floor = recording.truth("contact")[number - 1, first] == 1
    if (
        starts_on_floor
        and not ((events["time"] >= first / recording.rate) & (events["time"] < stop / recording.rate)).any()
    ):
        return "riding"
    time, jump = true_impacts(case, number)
    is_counted = (time >= first / recording.rate) & (time < stop / recording.rate)
    detected = detect_impacts(recording, f"a{case.scene.dampers[number - 1].body}", first, stop)
    # A detection next to a larger impact belongs to that impact.
    matched = score(detected.time, time, MAX_DISTANCE_SAMPLES / recording.rate)[2]
    matched[matched] = [
        abs(jump[k]) >= abs(jump[abs(time - time[k]) < detected.min_interval]).max() for k in np.flatnonzero(matched)
    ]
    is_counted &= detectable(time, jump, detected) | matched
    floor, ceiling = time[is_counted & (jump < 0.0)], time[is_counted & (jump > 0.0)]
    periods = (stop - first) / recording.rate * frequency
    if _is_once_per_period(floor, frequency, periods) and not ceiling.size:
        return "I"
    if _is_once_per_period(floor, frequency, periods) and _is_once_per_period(ceiling, frequency, periods):
        return "III" if _stays_at_ceiling(case, number, first, stop) else "II"
    return f"{floor.size / periods:.2f} floor, {ceiling.size / periods:.2f} ceiling"


def _stays_at_ceiling(case: Case, number: int, first: int, stop: int) -> bool:
    """Return whether a damper stays at the ceiling.

    With finite-duration contact it stays if it touches the ceiling for more than `MIN_STAY_RATIO` contact durations.
    """
    at_ceiling = case.recording.truth("contact")[number - 1, first:stop] == 2
    if case.scene.dampers[number - 1].contact is None:
        return bool(at_ceiling.any())
    system = assemble(case.scene)
    [j] = np.flatnonzero(system.damper_number == number)
    longest = max((last - begin for begin, last in runs_of(at_ceiling)), default=0)
    return longest / case.recording.rate > MIN_STAY_RATIO * system.duration_and_restitution(int(j), 2)[0]


def _is_once_per_period(time: NDArray[np.float64], frequency: float, periods: float) -> bool:
    """Return whether impacts occur once a period throughout a window; one may be missing at either end."""
    intervals = np.diff(time) * frequency
    return time.size > periods - 2.0 and bool(np.all(abs(intervals - 1.0) < _MAX_PERIOD_DEVIATION))
