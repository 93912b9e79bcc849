"""Judges: functions that compare one kind of result of the analysis with the truth, and return their verdicts."""

from __future__ import annotations

from collections.abc import Callable

from tests.gauntlet.judges import decays, impacts, modes, motion_types, responses, restitution
from tests.gauntlet.verdict import Case, Verdict

# A judge takes a case and its kind of test; it returns no verdict for other kinds of tests than its own.
Judge = Callable[[Case, str], list[Verdict]]
# A `ShotrigError` that a judge raises counts as refused.
JUDGES: dict[str, Judge] = {
    "responses": responses.judge,
    "modes": modes.judge,
    "impacts": impacts.judge,
    "restitution": restitution.judge,
    "motion_types": motion_types.judge,
    "decays": decays.judge,
}
