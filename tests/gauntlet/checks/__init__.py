"""Checks: functions that compare one kind of result of the analysis with the truth, and return their results."""

from collections.abc import Callable

from tests.gauntlet.checks import (
    channels,
    controlled_tones,
    decays,
    impacts,
    modes,
    motion_types,
    profile_control,
    responses,
    restitution,
)
from tests.gauntlet.result import Case, CheckResult

# A check takes a case and its kind of test; it returns no result for other kinds of tests than its own.
Check = Callable[[Case, str], list[CheckResult]]
# A `ShotrigError` that a check raises counts as refused.
CHECKS: dict[str, Check] = {
    "responses": responses.check,
    "intact channels": channels.check,
    "modes": modes.check,
    "impacts": impacts.check,
    "restitution": restitution.check,
    "motion_types": motion_types.check,
    "decays": decays.check,
    "orbits": controlled_tones.check,
    "profile": profile_control.check,
}
