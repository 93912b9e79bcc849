"""Coefficient of restitution estimated from velocity jumps, compared with the scene."""

from __future__ import annotations

from analysis.damper_motion.free_flight import BodyMotion, restitution
from tests.gauntlet.cavities import TONE
from tests.gauntlet.verdict import Case, Verdict

# Factor of the 95 % interval, and the largest plausible error, standard deviations.
BOUND, FAR = 2.0, 4.0


def judge(case: Case, kind: str) -> list[Verdict]:
    """Compare the estimate for each damper with the scene."""
    if kind != TONE:
        return []
    rec, verdicts = case.recording, []
    [window] = [marker for marker in rec.markers if marker.kind == "measure"]
    for damper in case.scene.dampers:
        motion = BodyMotion(rec, f"a{damper.body}", window.first_sample, window.stop)
        estimate = restitution(motion, damper)
        if estimate is None:
            verdicts.append(Verdict("restitution", kind, "refused", note="not determined"))
            continue
        error = abs(estimate.value - damper.restitution) / estimate.error
        estimated = f"{estimate.value:.3f}, standard uncertainty {estimate.error:.3f}"
        note = f"a{damper.body}: {estimated}, true {damper.restitution:.3f}"
        verdicts.append(
            Verdict(
                "restitution", kind, "right" if error < FAR else "wrong", int(error < BOUND), 1, note=note
            )
        )
    return verdicts
