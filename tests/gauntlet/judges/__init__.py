"""Judges: one file per kind of answer.

Each tells what it found in a case: one verdict or several, none where it is not concerned.
"""

from __future__ import annotations

from collections.abc import Callable

from tests.gauntlet.judges import decays, impacts, modes, motion_types, responses, restitution
from tests.gauntlet.verdict import Case, Verdict

# A judge takes a case and the kind it was drawn as. What it raises as ShotrigError counts as refused.
JUDGES: dict[str, Callable[[Case, str], list[Verdict]]] = {
    "responses": responses.judge,
    "modes": modes.judge,
    "impacts": impacts.judge,
    "restitution": restitution.judge,
    "motion_types": motion_types.judge,
    "decays": decays.judge,
}
