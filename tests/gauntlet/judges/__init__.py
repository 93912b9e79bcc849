"""Judges: each compares one kind of answer with the truth, and returns a verdict for each answer of its kind."""

from __future__ import annotations

from collections.abc import Callable

from tests.gauntlet.judges import decays, impacts, modes, motion_types, responses, restitution
from tests.gauntlet.verdict import Case, Verdict

# A judge takes a case and its kind. A ShotrigError that it raises counts as refused.
JUDGES: dict[str, Callable[[Case, str], list[Verdict]]] = {
    "responses": responses.judge,
    "modes": modes.judge,
    "impacts": impacts.judge,
    "restitution": restitution.judge,
    "motion_types": motion_types.judge,
    "decays": decays.judge,
}
