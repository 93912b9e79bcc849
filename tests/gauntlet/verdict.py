"""Input and output of a judge: the recorded random scene, and the verdict on one kind of result of the analysis."""

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
    recording: Recording
    """The recording of the scene's test, open for reading."""
    warnings: Sequence[str]
    """Warnings during the recording."""


@dataclass(frozen=True)
class Verdict:
    """Verdict of a judge on one kind of result for one scene."""

    judge: str
    """Name of the judge."""
    kind: str
    """Kind of test."""
    outcome: Outcome
    """Refused: the analysis raised an error or gave no value. Warned: it named what is affected and the cause.

    Wrong: a value is wrong, and there was no warning.
    """
    inside: int = 0
    """Number of points within their stated 95 % bound."""
    points: int = 0
    """Number of judged points."""
    width: float = np.nan
    """Median of bound / true value. A large value reveals bounds that are kept only because they are wide."""
    note: str = ""
    """Largest deviation, or the reason for a refusal."""
    scene: str = ""
    """Name of the scene. It contains the seed, number and kind, from which the scene can be drawn again."""
