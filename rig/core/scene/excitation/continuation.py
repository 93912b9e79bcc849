"""A tone that follows the response at constant force through its folds, even where the motion is unstable."""

from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from rig.core.scene.excitation.constant_response import BodyLocation
from rig.core.scene.excitation.kind import MAX_STEPS, DrivenShaker, Drives, Forces, Frequency, KindOfTest, Settle, Start
from rig.core.scene.excitation.stepped_sine import Measure
from rig.core.scene.shaker import Shaker
from rig.core.settings.problems import Problem
from rig.core.settings.quantities import RATIO
from rig.core.settings.quantity_field import Quantity


class Continuation(KindOfTest):
    """A tone whose frequency and motion are controlled, so it follows the response curve of each level."""

    one_of: ClassVar = (("force", "drive"),)
    kind: Literal["continuation"] = "continuation"
    recorded_as: ClassVar = "tones"
    single_tone: ClassVar = True
    follows_motion: ClassVar = True
    start: Start = "settled"
    from_: Frequency = Field(alias="from")
    """Frequency at which each curve begins, outside the resonance [Hz]."""
    to: Frequency
    """Frequency at which each curve ends, above or below the first [Hz]."""
    at: BodyLocation
    """The body whose motion is controlled: body 3, or its name."""
    step: Annotated[float, Quantity(RATIO, above=0.0, below=1.0)] = 0.2
    """Relative change of the complex response from one point to the next."""
    points: Annotated[int, Field(ge=3, le=MAX_STEPS)] = 200
    """Largest number of points of a curve."""
    force: Forces | None = None
    """Amplitude of the spring force, or of the force of a force shaker [N]. Several levels run one after another."""
    drive: Drives | None = None
    """Instead of `force`: amplitude of the drive [V, m for a table shaker, or m/s² for a base]."""
    shaker: DrivenShaker = None
    settle: Settle = Settle()
    """Criterion for the steady state of a point."""
    measure: Measure = Measure()
    """Measurement time of a point in steady state."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the ends of the band differ."""
        if self.from_ == self.to:
            yield Problem(("to",), f"got {self.to:g} Hz, the same as `from`. Give the other end of the band.")

    @property
    def tone(self) -> float:
        """First frequency [Hz]."""
        return self.from_

    def controlled_terms(self, shaker: Shaker, table: str) -> dict[str, float]:
        """Return the location of the controlled motion."""
        return {self.at: 1.0}
