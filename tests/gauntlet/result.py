"""Input and output of a check: the recorded random scene, and whether one kind of result of the analysis is correct."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from daq.core.recording.recording import Recording
    from rig import Scene

Outcome = Literal["correct", "warned", "refused", "wrong"]


@dataclass(frozen=True)
class Case:
    """A random scene and its recording."""

    scene: Scene
    recording: Recording
    """The recording of the scene's test, open for reading."""
    warnings: Sequence[str]
    """Warnings during the recording."""


@dataclass(frozen=True)
class CheckResult:
    """Outcome of one check for one scene."""

    check: str
    """Name of the check."""
    kind: str
    """Kind of test."""
    outcome: Outcome
    """Refused: the analysis raised an error or gave no value. Warned: it named what is affected and the cause.

    Wrong: a value is wrong, and there was no warning.
    """
    inside: int = 0
    """Number of points within their stated 95 % bound."""
    points: int = 0
    """Number of compared points."""
    relative_bound: float = np.nan
    """Median of bound / true value. A large value shows that the bounds are kept only because they are wide."""
    note: str = ""
    """Largest deviation, or the reason for a refusal."""
    scene: str = ""
    """Name of the scene. The name contains the seed, number and kind, from which the scene can be drawn again."""
