"""Hammer hits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.arrays import Array
from rig.scene.body_names import body_problems
from rig.scene.excitation.kind import Count, Duration, KindOfTest, Pulses, Start
from rig.scene.shaker import Body
from rig.settings.problems import Problem
from rig.settings.quantities import FORCE, RATIO
from rig.settings.quantity_field import Quantity
from rig.settings.settings import Settings


class DoubleHit(Settings):
    """Double hit: the hammer bounces, and a second, weaker pulse follows."""

    hits: tuple[Count, ...] | None = Field(None, min_length=1)
    """Numbers of the hits that bounce, from 1; None: all."""
    after: Duration = 20e-3
    """Time from the start of the first pulse to the start of the second [s]."""
    ratio: Annotated[float, Quantity(RATIO, above=0.0)] = 0.4
    """Ratio of the second pulse's peak to the first's."""


class Impulse(KindOfTest):
    """Hammer hits: half-sine pulses of force on a body."""

    kind: Literal["impulse"] = "impulse"
    recorded_as: ClassVar = "hits"
    level_keys: ClassVar = ("peak",)
    uses_shaker: ClassVar = False
    start: Start = "settled"
    body: Body
    """The body hit, by its number from 1 or its name."""
    peak: Annotated[float, Quantity(FORCE, above=0.0)]
    """Peak of the pulse [N]."""
    width: Duration
    """Duration of the half sine [s]; a softer tip makes it longer."""
    repeats: Count = 1
    """Number of hits."""
    interval: Duration = 6.0
    """Time from one hit to the next, and recording time after the last [s]."""
    double_hit: DoubleHit | None = None
    """Bounces of the hammer, each with a second, weaker pulse; None: single hits only."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that pulses do not overlap."""
        if self.width >= self.interval:
            yield Problem(
                ("width",),
                f"got {self.width:g} s, which is not shorter than the interval between hits, {self.interval:g} s. Give "
                "a shorter width or a longer interval.",
            )
        if self.double_hit is None:
            return
        if self.double_hit.after < self.width or self.double_hit.after + self.width >= self.interval:
            yield Problem(
                ("double_hit", "after"),
                f"got {self.double_hit.after:g} s, but the second pulse must lie between the first pulse and the next "
                f"hit. Give at least {self.width:g} s and less than {self.interval - self.width:g} s, or a longer "
                "interval.",
            )
        for k, hit in enumerate(self.double_hit.hits or ()):
            if hit > self.repeats:
                yield Problem(
                    ("double_hit", "hits", k),
                    f"hit {hit} does not exist; expected at most {self.repeats}, the number of repeats",
                )

    @property
    def hammer(self) -> int:
        """Number of the body hit, from 1."""
        return self.body

    @property
    def shortest(self) -> float:
        """Time of all hits, s."""
        return self.repeats * self.interval

    @property
    def simulated(self) -> float:
        """Time of all hits, s."""
        return self.shortest

    def wave(self, time: Array) -> Pulses:
        """Return the half-sine pulses, N."""
        force = np.zeros_like(time)
        for hit in range(self.repeats):
            since_hit = time - hit * self.interval
            pulse = self.peak * np.sin(np.pi * since_hit / self.width)
            force += np.where((since_hit >= 0.0) & (since_hit <= self.width), pulse, 0.0)
        return Pulses("hammer", force)

    def references(self, valid: Mapping[str, Any]) -> Iterable[Problem]:
        """Check the body."""
        return body_problems(valid, self.body, ("body",))
