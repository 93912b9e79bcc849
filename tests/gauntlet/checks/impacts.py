"""Check of impacts: F1 score of the impacts detected in the channels, compared with the true impacts.

True impacts count only above the detection limit of the result. They do not count if, according to the result, they
cannot be separated from a larger impact or are masked by its ringing. A detected impact may match any true impact
within two samples (the main lobe of the converter's filter). With finite-duration contact, the impact is the start of
the contact; wall, time and velocity jump must agree within the errors that the result gives.
"""

import numpy as np
from numpy.typing import NDArray

from analysis.core.damper_motion.impact_detection import Impacts, detect_impacts
from analysis.core.responses.errors.systematic import stated_tolerance
from rig.core.base.arrays import Array
from rig.core.system.assembly import assemble
from tests.gauntlet.finite_contact import TONE_FINITE_CONTACT
from tests.gauntlet.instant_contact import TONE
from tests.gauntlet.result import Case, CheckResult

# A detected impact matches a true impact if their times differ by at most this, samples.
MAX_DISTANCE_SAMPLES = 2.0
# Impacts are not compared within this time of the ends of a window, because the ringing of earlier impacts decays
# there.
_MARGIN_S = 0.05
# An error is plausible up to this number of standard uncertainties.
MAX_ERROR_SIGMAS = 4.0
# The result is correct if the F1 score, 2 matched / (detected + true), is at least this.
MIN_F1_SCORE = 0.8


def check(case: Case, kind: str) -> list[CheckResult]:
    """Compare the impacts of every damper; a detected and a true impact count as two points, as in the F1 score."""
    if kind not in (TONE, TONE_FINITE_CONTACT):
        return []
    recording, matched_points, points, notes = case.recording, 0, 0, []
    [window] = [marker for marker in recording.markers if marker.kind == "measure"]
    low, high = window.first_sample / recording.rate + _MARGIN_S, window.stop / recording.rate - _MARGIN_S
    for number, damper in enumerate(case.scene.dampers, 1):
        detected = detect_impacts(recording, f"a{damper.body}", window.first_sample, window.stop)
        time, jump = true_impacts(case, number)
        is_compared = (time > low) & (time < high) & detectable(time, jump, detected)
        is_compared &= ~_is_in_excluded_interval(time, detected.unsearched)
        _, is_match, is_detected = score(detected.time, time, _max_distance(detected, recording.rate))
        n_false = int(np.sum(~is_match & (detected.time > low) & (detected.time < high)))
        if detected.contact_duration and is_match.any():
            is_match[is_match] = _agrees_within_errors(
                detected, is_match, time, jump, recording.channels[detected.channel]
            )
            is_detected = score(detected.time[is_match], time, _max_distance(detected, recording.rate))[2]
            n_false = int(np.sum(~is_match & (detected.time > low) & (detected.time < high)))
        n_detected, n_missed = int(np.sum(is_detected & is_compared)), int(np.sum(~is_detected & is_compared))
        matched_points += 2 * n_detected
        points += 2 * n_detected + n_missed + n_false
        notes.append(f"a{damper.body}: {n_detected} detected, {n_missed} missed, {n_false} false")
    outcome = "correct" if matched_points >= MIN_F1_SCORE * points else "wrong"
    return [CheckResult("impacts", kind, outcome, matched_points, points, note="; ".join(notes))]


def score(detected: Array, true: Array, tolerance: float) -> tuple[float, NDArray[np.bool_], NDArray[np.bool_]]:
    """Match detected with true times, each at most once, the closest pairs first.

    `detected`, `true`: detected and true times, s; `tolerance`: maximum distance of a pair, s. Returns the F1 score, 2
    × matches / (detected + true), and whether each detected and each true time is matched. The score is 1 if both are
    empty.
    """
    detected_matched, true_matched = np.zeros(detected.size, dtype=bool), np.zeros(true.size, dtype=bool)
    if not detected.size and not true.size:
        return 1.0, detected_matched, true_matched
    if detected.size and true.size:
        pairs = []
        for i, time in enumerate(detected):
            low, high = np.searchsorted(true, [time - tolerance, time + tolerance])
            pairs += [(abs(true[j] - time), i, j) for j in range(low, high)]
        for _, i, j in sorted(pairs):
            if not detected_matched[i] and not true_matched[j]:
                detected_matched[i] = true_matched[j] = True
    return float(2 * detected_matched.sum() / (detected.size + true.size)), detected_matched, true_matched


def _max_distance(detected: Impacts, rate: float) -> float:
    """Return the largest time between a detected impact and its true impact, s."""
    return max(MAX_DISTANCE_SAMPLES / rate, 0.5 * detected.contact_duration)


def _agrees_within_errors(detected, matched, time, jump, info):
    """Return whether the walls, times and velocity jumps of matched impacts agree within the stated errors.

    A jump is positive at the ceiling and negative at the floor.
    """
    nearest = np.abs(time - detected.time[matched, None]).argmin(axis=1)
    time_bound = MAX_ERROR_SIGMAS * detected.time_std[matched]
    jump_bound = MAX_ERROR_SIGMAS * detected.jump_std[matched] + stated_tolerance(info) * abs(detected.jump[matched])
    time_error, jump_error = detected.time[matched] - time[nearest], detected.jump[matched] - jump[nearest]
    return (abs(time_error) < time_bound) & (abs(jump_error) < jump_bound)


def _is_in_excluded_interval(time: NDArray[np.float64], intervals: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether each impact lies in an interval that the search excluded, or within a millisecond of it."""
    margin_s = 1e-3
    return ((time[:, None] > intervals[:, 0] - margin_s) & (time[:, None] < intervals[:, 1] + margin_s)).any(axis=1)


def true_impacts(case: Case, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times [s] and velocity jumps [m/s] of a damper's body; the damper is numbered from 1.

    The body's velocity jumps downward (negative) at the floor.
    """
    damper, events = case.scene.dampers[number - 1], case.recording.events
    contacts = events[(events["damper"] == number) & np.isin(events["kind"], ("floor", "ceiling", "touch"))]
    at_ceiling = contacts["kind"] == "ceiling"
    restitution = np.full(contacts.size, damper.restitution)
    if damper.contact is not None:
        # The gap shows which wall is touched.
        samples = np.minimum(contacts["time"] * case.recording.rate, case.recording.samples - 1).astype(int)
        at_ceiling = case.recording.truth("gap")[number - 1, samples] > 0.5 * damper.clearance
        system = assemble(case.scene)
        [j] = np.flatnonzero(system.damper_number == number)
        restitution[:] = system.duration_and_restitution(int(j), 1)[1]
    impulse_ratio = damper.mass_ratio / (1.0 + damper.mass_ratio) * (1.0 + restitution)
    return contacts["time"], np.where(at_ceiling, impulse_ratio, -impulse_ratio) * contacts["speed"]


def detectable(time: NDArray[np.float64], jump: NDArray[np.float64], detected: Impacts) -> NDArray[np.bool_]:
    """Return whether each impact should be detected: above the detection limit, and not masked by a larger impact."""
    # Omit the thousands of tiny impacts at the end of bouncing: they mask no other impact.
    is_detectable = abs(jump) > detected.detection_limit
    time, magnitude = time[is_detectable], abs(jump[is_detectable])
    distance = abs(time - time[:, None])
    larger = (distance < detected.min_interval) & (magnitude > magnitude[:, None])
    masked = (distance < detected.ringing) & (detected.masked_share * magnitude > magnitude[:, None])
    is_detectable[is_detectable] = ~(larger | masked).any(axis=1)
    return is_detectable
