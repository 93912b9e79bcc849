"""Gaussian noise in a frequency band."""

from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from rig.core.scene.excitation.kind import (
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
from rig.core.settings.quantities import RATIO
from rig.core.settings.quantity_field import Quantity


class Random(KindOfTest):
    """Gaussian noise between two frequencies."""

    one_of: ClassVar = (("force", "drive"),)
    kind: Literal["random"] = "random"
    recorded_as: ClassVar = "random"
    level_name: ClassVar = "rms"
    start: Start = "settled"
    from_: Frequency = Field(alias="from")
    """Lower end of the band [Hz]."""
    to: Frequency
    """Upper end of the band [Hz]."""
    duration: Duration
    """Duration of the test [s]."""
    burst: Annotated[float, Quantity(RATIO, above=0.0, below=1.0)] | None = None
    """Fraction of each block during which the noise is on, above 0 and below 1; None: always on."""
    force: Force | None = None
    """Root mean square of the spring force, or of the force of a force shaker [N]."""
    drive: Drive | None = None
    """Instead of `force`: root mean square of the drive [V, m for a table shaker, or m/s² for a base]."""
    shaker: DrivenShaker = None
    also: Annotated[tuple[ShakerNumber, ...], Field(min_length=1)] | None = None
    """Numbers of other shakers to drive simultaneously, with uncorrelated noise of the same spectrum."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the lowest frequency is below the highest."""
        return check_band(self.from_, self.to)
