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
APART = 2.0
# Margin at both ends of a window in which impacts are not judged, s: earlier ringing decays there.
_ENDS = 0.05
# Largest plausible error, standard deviations.
FAR = 4.0
# Smallest F1 score: 2 hits / (detected + true).
LEAST_F1 = 0.8


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare the impacts of every damper; points are detected plus true impacts, as in the F1 score."""
    if kind not in (TONE, LANDINGS):
        return []
    rec, hits, points, notes = case.recording, 0, 0, []
    [window] = [marker for marker in rec.markers if marker.kind == "measure"]
    low, high = window.first_sample / rec.rate + _ENDS, window.stop / rec.rate - _ENDS
    for number, damper in enumerate(case.scene.dampers, 1):
        found = impacts(rec, f"a{damper.body}", window.first_sample, window.stop)
        time, jump = true_impacts(case, number)
        asked = (time > low) & (time < high) & detectable(time, jump, found)
        asked &= ~_inside(time, found.left_out)
        _, right, seen = score(found.time, time, _near(found, rec.rate))
        false = int(np.sum(~right & (found.time > low) & (found.time < high)))
        if found.contact_duration and right.any():
            right[right] = _agrees(found, right, time, jump, case.recording.channels[found.channel])
            seen = score(found.time[right], time, _near(found, rec.rate))[2]
            false = int(np.sum(~right & (found.time > low) & (found.time < high)))
        hit, missed = int(np.sum(seen & asked)), int(np.sum(~seen & asked))
        hits, points = hits + 2 * hit, points + 2 * hit + missed + false
        notes.append(f"a{damper.body}: {hit} detected, {missed} missed, {false} false")
    outcome = "right" if hits >= LEAST_F1 * points else "wrong"
    return [Verdict("impacts", kind, outcome, hits, points, note="; ".join(notes))]


def _near(found: Impacts, rate: float) -> float:
    """Return the largest distance of a detected from its true impact, s."""
    return max(APART / rate, 0.5 * found.contact_duration)


def _agrees(
    found: Impacts,
    matched: NDArray[np.bool_],
    time: NDArray[np.float64],
    jump: NDArray[np.float64],
    info: ChannelInfo,
) -> NDArray[np.bool_]:
    """Whether wall, time and size of matched impacts agree within the stated errors."""
    nearest = np.abs(time - found.time[matched, None]).argmin(axis=1)
    in_time = abs(found.time[matched] - time[nearest]) < FAR * found.time_error[matched]
    bound = FAR * found.jump_error[matched] + tolerance(info) * abs(found.jump[matched])
    return in_time & (abs(found.jump[matched] - jump[nearest]) < bound)


def _inside(time: NDArray[np.float64], stretches: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each impact lies in an interval that the search left out, or within a millisecond of it."""
    near = 1e-3
    return ((time[:, None] > stretches[:, 0] - near) & (time[:, None] < stretches[:, 1] + near)).any(axis=1)


def true_impacts(case: Case, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times and velocity jumps of the body for a damper, numbered from 1; negative at the floor."""
    damper, events = case.scene.dampers[number - 1], case.recording.events
    hits = events[(events["damper"] == number) & np.isin(events["kind"], ("floor", "ceiling", "touch"))]
    up = hits["kind"] == "ceiling"
    rebound = np.full(hits.size, damper.restitution)
    if damper.contact is not None:
        # The gap shows which wall is touched.
        samples = np.minimum(hits["time"] * case.recording.rate, case.recording.samples - 1).astype(int)
        up = case.recording.truth("gap")[number - 1, samples] > 0.5 * damper.clearance
        system = assemble(case.scene)
        [j] = np.flatnonzero(system.damper_number == number)
        rebound[:] = system.duration_and_restitution(int(j), 1)[1]
    share = damper.mass_ratio / (1.0 + damper.mass_ratio) * (1.0 + rebound)
    return hits["time"], np.where(up, share, -share) * hits["speed"]


def detectable(time: NDArray[np.float64], jump: NDArray[np.float64], found: Impacts) -> NDArray[np.bool_]:
    """Whether each impact should be detected: above the threshold, and not hidden by a larger one."""
    # Bouncing ends in thousands of tiny impacts, which hide no other.
    out = abs(jump) > found.threshold
    time, size = time[out], abs(jump[out])
    apart = abs(time - time[:, None])
    larger = (apart < found.min_interval) & (size > size[:, None])
    outshone = (apart < found.ringing) & (found.masked_share * size > size[:, None])
    out[out] = ~(larger | outshone).any(axis=1)
    return out
