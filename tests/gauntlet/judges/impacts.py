"""Impacts found in the channels against those that the engine saw: each found once, and none that was not there.

A touch is an impact, where contact lasts; a release is none. Judged are impacts larger than the threshold that the
result states, but for those that it says may be seen as one with a larger one, or far smaller than one that still
rings. What is found may be any impact. Both are the same where they are less than two samples apart, in the main lobe
of the converter's filter; landings that last, where wall, time and size are as told.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.dampers.impact_detection import Impacts, impacts, score
from analysis.responses.systematic import tolerance
from daq.signal_chain.channel import ChannelInfo
from rig.system.assembly import assemble
from tests.gauntlet.cavities import TONE
from tests.gauntlet.landings import LANDINGS
from tests.gauntlet.verdict import Case, Verdict

APART = 2.0
# Where a search begins and ends, and where ringing of what was before dies out, s.
_ENDS = 0.05
# Standard deviations that no honest error leaves behind.
FAR = 4.0
# 2 hits / (found + true), at least.
LEAST_F1 = 0.8


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare impacts on every body with a damper; the points are those of F1: found and true ones."""
    if kind not in (TONE, LANDINGS):
        return []
    rec, hits, points, notes = case.recording, 0, 0, []
    [window] = [marker for marker in rec.markers if marker.kind == "measure"]
    low, high = window.first_sample / rec.rate + _ENDS, window.stop / rec.rate - _ENDS
    for number, damper in enumerate(case.scene.dampers, 1):
        found = impacts(rec, f"a{damper.body}", window.first_sample, window.stop)
        time, jump = true_impacts(case, number)
        asked = (time > low) & (time < high) & seen_for_itself(time, jump, found)
        asked &= ~_inside(time, found.left_out)
        _, right, seen = score(found.time, time, _near(found, rec.rate))
        false = int(np.sum(~right & (found.time > low) & (found.time < high)))
        if found.lasts and right.any():
            right[right] = _as_told(found, right, time, jump, case.recording.channels[found.channel])
            seen = score(found.time[right], time, _near(found, rec.rate))[2]
            false = int(np.sum(~right & (found.time > low) & (found.time < high)))
        hit, missed = int(np.sum(seen & asked)), int(np.sum(~seen & asked))
        hits, points = hits + 2 * hit, points + 2 * hit + missed + false
        notes.append(f"a{damper.body}: {hit} found, {missed} missed, {false} that are none")
    outcome = "right" if hits >= LEAST_F1 * points else "wrong"
    return [Verdict("impacts", kind, outcome, hits, points, note="; ".join(notes))]


def _near(found: Impacts, rate: float) -> float:
    """Give the distance at which two impacts are the same, s."""
    return max(APART / rate, 0.5 * found.lasts)


def _as_told(
    found: Impacts,
    matched: NDArray[np.bool_],
    time: NDArray[np.float64],
    jump: NDArray[np.float64],
    info: ChannelInfo,
) -> NDArray[np.bool_]:
    """Whether impacts that were matched are as is told: which wall, when and how hard, in standard deviations."""
    nearest = np.abs(time - found.time[matched, None]).argmin(axis=1)
    off = abs(found.time[matched] - time[nearest]) < FAR * found.time_error[matched]
    bound = FAR * found.jump_error[matched] + tolerance(info) * abs(found.jump[matched])
    return off & (abs(found.jump[matched] - jump[nearest]) < bound)


def _inside(time: NDArray[np.float64], stretches: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each impact came where the result says that none can be seen, or within a millisecond of it."""
    near = 1e-3
    return ((time[:, None] > stretches[:, 0] - near) & (time[:, None] < stretches[:, 1] + near)).any(axis=1)


def true_impacts(case: Case, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times, and velocity jumps of the body of a damper, by its number from 1: down from the floor."""
    damper, events = case.scene.dampers[number - 1], case.recording.events
    hits = events[(events["damper"] == number) & np.isin(events["kind"], ("floor", "ceiling", "touch"))]
    up = hits["kind"] == "ceiling"
    rebound = np.full(hits.size, damper.restitution)
    if damper.contact is not None:
        # Which wall is touched shows in the gap then.
        samples = np.minimum(hits["time"] * case.recording.rate, case.recording.samples - 1).astype(int)
        up = case.recording.truth("gap")[number - 1, samples] > 0.5 * damper.clearance
        system = assemble(case.scene)
        [j] = np.flatnonzero(system.damper_number == number)
        rebound[:] = system.landing(int(j), 1)[1]
    share = damper.mass_ratio / (1.0 + damper.mass_ratio) * (1.0 + rebound)
    return hits["time"], np.where(up, share, -share) * hits["speed"]


def seen_for_itself(
    time: NDArray[np.float64], jump: NDArray[np.float64], found: Impacts
) -> NDArray[np.bool_]:
    """Whether each impact is larger than what the result states may be missed, alone or beside a larger one."""
    # Bouncing ends in thousands of impacts that are too small and outshine none.
    out = abs(jump) > found.threshold
    time, size = time[out], abs(jump[out])
    apart = abs(time - time[:, None])
    larger = (apart < found.apart) & (size > size[:, None])
    outshone = (apart < found.ringing) & (found.hidden * size > size[:, None])
    out[out] = ~(larger | outshone).any(axis=1)
    return out
