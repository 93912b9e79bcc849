"""Check of warnings of channels: the drawn recordings have no fault of a channel, so that no channel is blamed.

Overloads, lost samples and double hits are drawn; they are no change of gain, no failed channel and no delay.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import analysis
from tests.gauntlet.result import Case, CheckResult

if TYPE_CHECKING:
    from daq.core.recording.recording import Recording

# Parts of the warnings that blame a channel for a step of its gain, for a break, for a delay, or for its sign.
_BLAMES = ("its gain", "disconnected or failed", "seems to be", "indicates a reversed channel")


def check(case: Case, kind: str) -> list[CheckResult]:
    """Return one result for all curves of a recording; recordings of free decays have no curves."""
    if case.scene.test is None or not case.recording.test.drives:
        return []
    texts = blames(case.recording)
    return [CheckResult("intact channels", kind, "wrong" if texts else "correct", note="; ".join(texts))]


def blames(recording: Recording) -> list[str]:
    """Return the warnings that blame a channel."""
    texts = {text for group in analysis.frequency_responses(recording) for text in group.warnings}
    return sorted(text for text in texts if any(blame in text for blame in _BLAMES))
