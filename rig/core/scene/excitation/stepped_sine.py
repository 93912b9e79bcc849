"""A series of tones, each measured in steady state."""

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from rig.core.scene.excitation.kind import (
    MAX_STEPS,
    Count,
    DrivenShaker,
    Drives,
    Forces,
    Frequency,
    KindOfTest,
    Settle,
    Spacing,
    Start,
    spaced_frequencies,
)
from rig.core.settings.problems import Problem
from rig.core.settings.settings import Settings

# Number of points in a band between two points in which dampers move: they determine a peak within it.
_POINTS_PER_BAND = 3
# A test with more than this multiple of the points takes too long; the bands are then measured in a separate test.
_MAX_DENSITY = 10


class Measure(Settings):
    """Measurement time of a dwell in steady state, in periods of the drive."""

    periods: Count = 20
    """Number of periods."""


class SteppedTest(KindOfTest):
    """A test with a series of tones; subclasses add the levels, `shaker`, `settle` and `measure`."""

    recorded_as: ClassVar = "tones"
    single_tone: ClassVar = True
    kind: str
    start: Start = "settled"
    from_: Frequency | None = Field(None, alias="from")
    """First frequency [Hz]."""
    to: Frequency | None = None
    """Last frequency [Hz], higher than the first."""
    points: Annotated[int, Field(ge=2, le=MAX_STEPS)] | None = None
    """Number of frequencies, both ends inclusive."""
    frequencies: tuple[Frequency, ...] | None = Field(None, min_length=1, max_length=MAX_STEPS)
    """Instead of `from`, `to` and `points`: the frequencies [Hz] in ascending order."""
    spacing: Spacing = "linear"
    """Whether the frequencies are evenly spaced on a linear or a logarithmic axis."""
    direction: Literal["up", "down", "both"] = "up"
    """Order of the frequencies; both: up, then down."""

    if TYPE_CHECKING:
        settle: Any
        measure: Any

    def check_consistency(self) -> Iterable[Problem]:
        """Check the range or the list of frequencies."""
        if self.frequencies is not None:
            if self.from_ is not None or self.to is not None:
                yield Problem((), "frequencies and from or to are given together. Remove frequencies, or from and to.")
            if any(b <= a for a, b in zip(self.frequencies, self.frequencies[1:], strict=False)):
                yield Problem(
                    ("frequencies",),
                    "the frequencies do not ascend. List them from low to high; direction: down reverses their order.",
                )
        elif self.from_ is None or self.to is None:
            yield Problem((), f"{'from' if self.from_ is None else 'to'} missing; expected a frequency such as 8 Hz")
        elif self.from_ >= self.to:
            message = f"got {self.from_:g} Hz, which is not below `to`, {self.to:g} Hz. Give the lower end first"
            yield Problem(("from",), f"{message}; direction: down sweeps downward.")

    @property
    def order(self) -> tuple[float, ...]:
        """The frequencies of one level in the order of the test [Hz]."""
        ascending = self.frequencies
        if ascending is None:
            ascending = spaced_frequencies(self.from_ or 0.0, self.to or 0.0, self.points or 0, self.spacing)
        descending = ascending[::-1]
        return {"up": ascending, "down": descending, "both": ascending + descending}[self.direction]

    @property
    def band(self) -> tuple[float, float]:
        """Lowest and highest frequency [Hz]."""
        return min(self.order), max(self.order)

    def remedy_between(self, bands: Sequence[tuple[float, float]]) -> str:
        """Return the instruction to add points within bands (lowest and highest frequency, Hz) without a point."""
        if self.frequencies is not None:
            added = [
                f"{low + k / (_POINTS_PER_BAND + 1) * (high - low):.5g}"
                for low, high in bands
                for k in range(1, _POINTS_PER_BAND + 1)
            ]
            return f"Add {', '.join(dict.fromkeys(added))} Hz to test.frequencies."
        lowest, highest = self.band
        coordinate = math.log if self.spacing == "log" else float
        narrowest = min(coordinate(high) - coordinate(low) for low, high in bands)
        points = 1 + math.ceil(_POINTS_PER_BAND * (coordinate(highest) - coordinate(lowest)) / narrowest)
        if points <= min(_MAX_DENSITY * len(self.order), MAX_STEPS):
            return f"Set test.points: {points} for {_POINTS_PER_BAND} points there."
        return super().remedy_between(bands)

    @property
    def details(self) -> tuple[str, ...]:
        """Number of frequencies, and their order."""
        direction = {"up": "upward", "down": "downward", "both": "up and down"}[self.direction]
        return (f"{len(self.order)} points {direction}",)

    @property
    def dwells(self) -> tuple[float, ...]:
        """The frequencies of one level in the order of the test [Hz]."""
        return self.order

    @property
    def shortest(self) -> float:
        """Time of all measurements [s]."""
        return len(self.levels) * self.measure.periods * sum(1.0 / frequency for frequency in self.order)


class SteppedSine(SteppedTest):
    """A series of tones; each is brought to the level, settles to steady state and is measured."""

    one_of: ClassVar = (("force", "drive"), ("frequencies", "points"))
    kind: Literal["stepped_sine"] = "stepped_sine"
    force: Forces | None = None
    """Amplitude of the force of the coil spring, which the controller keeps constant, or of a force shaker [N]. Several
    levels are run one after another."""
    drive: Drives | None = None
    """Instead of `force`: amplitude of the drive, open loop [V, m for a table shaker, or m/s² for a base].
    Several levels are run one after another."""
    shaker: DrivenShaker = None
    settle: Settle = Settle()
    """Criterion for the steady state of a dwell."""
    measure: Measure = Measure()
    """Measurement time of a dwell in steady state."""
