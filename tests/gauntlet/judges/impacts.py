"""Impacts detected in the channels, compared with those of the engine: F1 score of detected and true impacts.

With finite-duration contact the touch counts as the impact, not the release. Only impacts above the stated
threshold count, without those that the result declares inseparable from a larger one or hidden by its ringing. A
detected impact may match any true one. The two match within two samples, the main lobe of the converter's filter;
with finite-duration contact, where wall, time and size agree within the stated errors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.damper_motion.impact_detection import Impacts, impacts, score
from analysis.responses.systematic import tolerance
from daq.signal_chain.channel import ChannelInfo
from rig.system.assembly import assemble
from tests.gauntlet.cavities import TONE
from tests.gauntlet.landings import LANDINGS
from tests.gauntlet.verdict import Case, Verdict

# Largest distance of a detected from its true impact, samples.
MAX_DISTANCE_SAMPLES = 2.0
# Margin at both ends of a window in which impacts are not judged, s: earlier ringing decays there.
_MARGIN_S = 0.05
# Largest plausible error, standard deviations.
MAX_ERROR_SIGMAS = 4.0
# Smallest F1 score: 2 hits / (detected + true).
MIN_F1_SCORE = 0.8


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare the impacts of every damper; points are detected plus true impacts, as in the F1 score."""
    if kind not in (TONE, LANDINGS):
        return []
    recording, score_hits, points, notes = case.recording, 0, 0, []
    [window] = [marker for marker in recording.markers if marker.kind == "measure"]
    low, high = window.first_sample / recording.rate + _MARGIN_S, window.stop / recording.rate - _MARGIN_S
    for number, damper in enumerate(case.scene.dampers, 1):
        detected = impacts(recording, f"a{damper.body}", window.first_sample, window.stop)
        time, jump = true_impacts(case, number)
        is_judged = (time > low) & (time < high) & detectable(time, jump, detected)
        is_judged &= ~_in_excluded_interval(time, detected.left_out)
        _, right, is_detected = score(detected.time, time, _max_distance(detected, recording.rate))
        n_false = int(np.sum(~right & (detected.time > low) & (detected.time < high)))
        if detected.contact_duration and right.any():
            right[right] = _agree(detected, right, time, jump, case.recording.channels[detected.channel])
            is_detected = score(detected.time[right], time, _max_distance(detected, recording.rate))[2]
            n_false = int(np.sum(~right & (detected.time > low) & (detected.time < high)))
        n_detected, n_missed = int(np.sum(is_detected & is_judged)), int(np.sum(~is_detected & is_judged))
        score_hits, points = score_hits + 2 * n_detected, points + 2 * n_detected + n_missed + n_false
        notes.append(f"a{damper.body}: {n_detected} detected, {n_missed} missed, {n_false} false")
    outcome = "right" if score_hits >= MIN_F1_SCORE * points else "wrong"
    return [Verdict("impacts", kind, outcome, score_hits, points, note="; ".join(notes))]


def _max_distance(detected: Impacts, rate: float) -> float:
    """Return the largest distance of a detected from its true impact, s."""
    return max(MAX_DISTANCE_SAMPLES / rate, 0.5 * detected.contact_duration)


def _agree(
    detected: Impacts,
    matched: NDArray[np.bool_],
    time: NDArray[np.float64],
    jump: NDArray[np.float64],
    info: ChannelInfo,
) -> NDArray[np.bool_]:
    """Return whether wall, time and size of matched impacts agree within the stated errors."""
    nearest = np.abs(time - detected.time[matched, None]).argmin(axis=1)
    in_time = abs(detected.time[matched] - time[nearest]) < MAX_ERROR_SIGMAS * detected.time_error[matched]
    bound = MAX_ERROR_SIGMAS * detected.jump_error[matched] + tolerance(info) * abs(detected.jump[matched])
    return in_time & (abs(detected.jump[matched] - jump[nearest]) < bound)


def _in_excluded_interval(time: NDArray[np.float64], intervals: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether each impact lies in an interval that the search excluded, or within a millisecond of it."""
    margin = 1e-3
    return ((time[:, None] > intervals[:, 0] - margin) & (time[:, None] < intervals[:, 1] + margin)).any(axis=1)


def true_impacts(case: Case, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times and velocity jumps of the body for a damper, numbered from 1; negative at the floor."""
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
    """Return whether each impact should be detected: above the threshold, and not masked by a larger one."""
    # Bouncing ends in thousands of tiny impacts, which mask no other impact.
    is_detectable = abs(jump) > detected.threshold
    time, magnitude = time[is_detectable], abs(jump[is_detectable])
    distance = abs(time - time[:, None])
    larger = (distance < detected.min_interval) & (magnitude > magnitude[:, None])
    masked = (distance < detected.ringing) & (detected.masked_share * magnitude > magnitude[:, None])
    is_detectable[is_detectable] = ~(larger | masked).any(axis=1)
    return is_detectable
