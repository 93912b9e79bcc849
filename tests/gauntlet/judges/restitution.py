"""Restitution of dampers told from the jumps of their bodies: within its stated error, or not told."""

from __future__ import annotations

from analysis.dampers.impact_detection import impacts
from analysis.dampers.restitution import restitution
from tests.gauntlet.cavities import TONE
from tests.gauntlet.verdict import Case, Verdict

# Standard deviations of the 95 % bound, and those that no honest error leaves behind.
BOUND, FAR = 2.0, 4.0


def judge(case: Case, kind: str) -> list[Verdict]:
    """Hold what is told of each damper against the scene."""
    if kind != TONE:
        return []
    rec, verdicts = case.recording, []
    [window] = [marker for marker in rec.markers if marker.kind == "measure"]
    for damper in case.scene.dampers:
        found = impacts(rec, f"a{damper.body}", window.first_sample, window.stop)
        told = restitution(rec, found, damper, window.first_sample, window.stop)
        if told is None:
            verdicts.append(Verdict("restitution", kind, "refused", note="not told"))
            continue
        off = abs(told.value - damper.restitution) / told.error
        note = f"a{damper.body}: {told.value:.3f} with standard deviation {told.error:.3f}, is {damper.restitution:.3f}"
        verdicts.append(
            Verdict("restitution", kind, "right" if off < FAR else "wrong", int(off < BOUND), 1, note=note)
        )
    return verdicts
