"""Types of motion told from the channels at each frequency against the engine's events, where a type is named."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.dampers.impact_detection import impacts, score
from analysis.dampers.nonlinearity import damper_motion
from analysis.responses.stepped_sine import sweeps
from rig.numerics.runs import runs_of
from rig.response.motion_type import STAY
from rig.system.assembly import assemble
from tests.gauntlet.cavities import STEPS
from tests.gauntlet.judges.impacts import APART, seen_for_itself, true_impacts
from tests.gauntlet.landings import STEPPED_LANDINGS
from tests.gauntlet.verdict import Case, Verdict

NAMED = ("riding", "I", "II", "III")
# So far from a period, relative, may be what lies between blows that come once a period.
_ONCE = 0.1


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare the types of all dampers; the points are those where one is named."""
    if kind not in (STEPS, STEPPED_LANDINGS):
        return []
    right, points, nameable, notes = 0, 0, 0, []
    for sweep in sweeps(case.recording):
        for number, damper in enumerate(case.scene.dampers, 1):
            motions = damper_motion(case.recording, sweep, f"a{damper.body}")
            for motion, window in zip(motions, sweep.windows, strict=True):
                true = _true_type(case, number, motion.frequency, *map(int, window))
                nameable += true in NAMED
                if motion.name in NAMED:
                    points += 1
                    right += motion.name == true
                    if motion.name != true:
                        notes.append(f"a{damper.body} at {motion.frequency:.4g} Hz: {motion.name}, is {true}")
    outcome = "right" if right == points else "wrong"
    notes.append(f"{points} of {nameable} named")
    return [Verdict("motion_types", kind, outcome, right, points, note="; ".join(notes))]


def _true_type(case: Case, number: int, frequency: float, first: int, stop: int) -> str:
    """Type by what the damper did in a window.

    It rides where nothing happens at all. Impacts that are too small, or too near to a larger one, count where they
    are found only.
    """
    rec = case.recording
    events = rec.events[rec.events["damper"] == number]
    riding = rec.truth("contact")[number - 1, first] == 1
    if riding and not ((events["time"] >= first / rec.rate) & (events["time"] < stop / rec.rate)).any():
        return "riding"
    time, jump = true_impacts(case, number)
    inside = (time >= first / rec.rate) & (time < stop / rec.rate)
    found = impacts(rec, f"a{case.scene.dampers[number - 1].body}", first, stop)
    # What is found beside a larger one is that one, a little late.
    matched = score(found.time, time, APART / rec.rate)[2]
    matched[matched] = [
        abs(jump[k]) >= abs(jump[abs(time - time[k]) < found.apart]).max() for k in np.flatnonzero(matched)
    ]
    inside &= seen_for_itself(time, jump, found) | matched
    floor, ceiling = time[inside & (jump < 0.0)], time[inside & (jump > 0.0)]
    periods = (stop - first) / rec.rate * frequency
    if _once(floor, frequency, periods) and not ceiling.size:
        return "I"
    if _once(floor, frequency, periods) and _once(ceiling, frequency, periods):
        stays = _stays(case, number, first, stop)
        return "III" if stays else "II"
    return f"{floor.size / periods:.2f} floor, {ceiling.size / periods:.2f} ceiling"


def _stays(case: Case, number: int, first: int, stop: int) -> bool:
    """Whether a damper stays at the ceiling: for more than two landings, where they last, else at all."""
    at_ceiling = case.recording.truth("contact")[number - 1, first:stop] == 2
    if case.scene.dampers[number - 1].contact is None:
        return bool(at_ceiling.any())
    system = assemble(case.scene)
    [j] = np.flatnonzero(system.damper_number == number)
    longest = max((last - begin for begin, last in runs_of(at_ceiling)), default=0)
    return longest / case.recording.rate > STAY * system.landing(int(j), 2)[0]


def _once(time: NDArray[np.float64], frequency: float, periods: float) -> bool:
    """Whether blows come a period apart, through all of a window; at either end none can be told."""
    between = np.diff(time) * frequency
    return time.size > periods - 2.0 and bool(np.all(abs(between - 1.0) < _ONCE))
