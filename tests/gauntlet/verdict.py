"""Input and output of a judge: the recorded case, and the verdict on one kind of answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from rig import Scene

Outcome = Literal["right", "warned", "refused", "wrong"]


@dataclass(frozen=True)
class Case:
    """A random scene and its recording."""

    scene: Scene
    """As drawn."""
    recording: Recording
    """Open."""
    warnings: Sequence[str]
    """Warnings of the run."""


@dataclass(frozen=True)
class Verdict:
    """Verdict of a judge on one scene."""

    judge: str
    """Name of the judge."""
    kind: str
    """Kind of test."""
    outcome: Outcome
    """Warned: the result names the affected lines or channels and the cause. Wrong: it does not."""
    inside: int = 0
    """Points within their stated 95 % bound."""
    points: int = 0
    """Points that were judged."""
    width: float = np.nan
    """Median of bound / true value. It reveals bounds that hold only because they are wide."""
    note: str = ""
    """Largest deviation, or the reason for a refusal."""
    scene: str = ""
    """Name of the scene: seed, number and kind, from which it can be drawn again."""
