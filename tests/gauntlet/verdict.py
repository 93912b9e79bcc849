"""What a judge has before it, and what it finds."""

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
    """A scene that was drawn and recorded."""

    scene: Scene
    """As drawn."""
    recording: Recording
    """Open."""
    said: Sequence[str]
    """What the run warned of."""


@dataclass(frozen=True)
class Verdict:
    """What a judge found in one scene."""

    judge: str
    """Whose verdict it is: what was judged."""
    kind: str
    """Kind of test."""
    outcome: Outcome
    """Warned: of lines or channels by name, with the cause. Wrong: not a word of it."""
    inside: int = 0
    """Points within their stated 95 % bound, and all points that were judged."""
    points: int = 0
    """Points within their stated 95 % bound, and all points that were judged."""
    width: float = np.nan
    """Median bound, relative to the truth: bounds that hold because they are wide show."""
    note: str = ""
    """What is off, or why it was refused."""
    scene: str = ""
    """Name of the scene: seed, number and kind draw it again."""
