"""A periodic sum of tones with random phases."""

import math
from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from rig.core.scene.excitation.kind import (
    MAX_STEPS,
    Count,
    Drive,
    DrivenShaker,
    Duration,
    Force,
    Frequency,
    KindOfTest,
    ShakerNumber,
    Start,
    check_band,
)
from rig.core.settings.problems import Problem


class Multisine(KindOfTest):
    """A periodic sum of tones with random phases."""

    one_of: ClassVar = (("force", "drive"), ("lines", "period"))
    kind: Literal["multisine"] = "multisine"
    recorded_as: ClassVar = "multisine"
    level_name: ClassVar = "rms"
    start: Start = "settled"
    from_: Frequency = Field(alias="from")
    """Lower end of the band [Hz]."""
    to: Frequency
    """Upper end of the band [Hz]."""
    lines: Annotated[int, Field(ge=2, le=MAX_STEPS)] | None = None
    """Number of tones in the band."""
    period: Duration | None = None
    """Instead of `lines`: the period of the signal [s]; the tones are multiples of its reciprocal."""
    periods: Count = 8
    """Number of measured periods of each realization."""
    realisations: Count = 4
    """Number of realizations: sets of random phases."""
    force: Force | None = None
    """Root mean square of the spring force, or of the force of a force shaker [N]."""
    drive: Drive | None = None
    """Instead of `force`: root mean square of the drive [V, m for a table shaker, or m/s² for a base]."""
    shaker: DrivenShaker = None
    also: Annotated[tuple[ShakerNumber, ...], Field(min_length=1)] | None = None
    """Numbers of other shakers to drive simultaneously: each realization then has one experiment per shaker,
    with orthogonal phases."""

    @property
    def period_s(self) -> float:
        """Period of the signal [s], as given or from the number of lines."""
        return self.period if self.period is not None else (self.lines or 2) / (self.to - self.from_)

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the lowest frequency is below the highest, and that a line lies between them."""
        yield from check_band(self.from_, self.to)
        if self.period is not None and math.floor(self.to * self.period) < math.ceil(self.from_ * self.period):
            message = f"no line of the multisine (multiple of {1.0 / self.period:g} Hz) lies between from and to"
            yield Problem(("period",), f"{message}. Give a longer period.")

    @property
    def details(self) -> tuple[str, ...]:
        """Numbers of averaged realizations and periods."""
        return (f"{self.realisations} × {self.periods} periods",)

    @property
    def shortest(self) -> float:
        """Time of all measured periods [s]."""
        return self.realisations * self.periods * self.period_s
