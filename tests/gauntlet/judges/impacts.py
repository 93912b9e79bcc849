"""Impacts found in the channels against those that the engine saw: each found once, and none that was not there.

Judged are impacts larger than the threshold that the result states, but for those within its resolution of a larger
one, or far smaller than one that still rings. What is found may be any impact. Both are the same where they are less
than two samples apart: in the main lobe of the converter's filter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.dampers.impact_detection import Impacts, impacts, score
from analysis.dampers.jump_search import LEFT_OVER
from tests.gauntlet.cavities import TONE
from tests.gauntlet.verdict import Case, Verdict

APART = 2.0
# Where a search begins and ends, and where ringing of what was before dies out, s.
_ENDS = 0.05
# 2 hits / (found + true), at least.
LEAST_F1 = 0.8


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare impacts on every body with a damper; the points are those of F1: found and true ones."""
    if kind != TONE:
        return []
    rec, hits, points, notes = case.recording, 0, 0, []
    [window] = [marker for marker in rec.markers if marker.kind == "measure"]
    low, high = window.first_sample / rec.rate + _ENDS, window.stop / rec.rate - _ENDS
    for number, damper in enumerate(case.scene.dampers, 1):
        found = impacts(rec, f"a{damper.body}", window.first_sample, window.stop)
        time, jump = true_impacts(case, number)
        asked = (time > low) & (time < high) & seen_for_itself(time, jump, found)
        asked &= ~_inside(time, found.left_out)
        _, right, seen = score(found.time, time, APART / rec.rate)
        false = int(np.sum(~right & (found.time > low) & (found.time < high)))
        hit, missed = int(np.sum(seen & asked)), int(np.sum(~seen & asked))
        hits, points = hits + 2 * hit, points + 2 * hit + missed + false
        notes.append(f"a{damper.body}: {hit} found, {missed} missed, {false} that are none")
    outcome = "right" if hits >= LEAST_F1 * points else "wrong"
    return [Verdict("impacts", kind, outcome, hits, points, note="; ".join(notes))]


def _inside(time: NDArray[np.float64], stretches: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each impact came where the result says that none can be seen, or within a millisecond of it."""
    near = 1e-3
    return ((time[:, None] > stretches[:, 0] - near) & (time[:, None] < stretches[:, 1] + near)).any(axis=1)


def true_impacts(case: Case, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times, and velocity jumps of the body of a damper, by its number from 1: down from the floor."""
    damper, events = case.scene.dampers[number - 1], case.recording.events
    hits = events[(events["damper"] == number) & (events["kind"] != "separation")]
    share = damper.mass_ratio / (1.0 + damper.mass_ratio) * (1.0 + damper.restitution)
    return hits["time"], np.where(hits["kind"] == "floor", -share, share) * hits["speed"]


def seen_for_itself(
    time: NDArray[np.float64], jump: NDArray[np.float64], found: Impacts
) -> NDArray[np.bool_]:
    """Whether each impact is larger than what the result states may be missed, alone or beside a larger one."""
    # Bouncing ends in thousands of impacts that are too small and outshine none.
    out = abs(jump) > found.threshold
    time, size = time[out], abs(jump[out])
    apart = abs(time - time[:, None])
    larger = (apart < found.resolution) & (size > size[:, None])
    outshone = (apart < found.ringing) & (LEFT_OVER * size > size[:, None])
    out[out] = ~(larger | outshone).any(axis=1)
    return out
