"""A tone whose frequency follows a resonance: the response has a given phase relative to the force."""

from collections.abc import Iterable
from math import pi
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from rig.core.scene.excitation.constant_response import BodyLocation
from rig.core.scene.excitation.kind import (
    DrivenShaker,
    Drives,
    Forces,
    Frequency,
    KindOfTest,
    Settle,
    Start,
    check_band,
)
from rig.core.scene.excitation.stepped_sine import Measure
from rig.core.settings.problems import Problem
from rig.core.settings.quantities import ANGLE
from rig.core.settings.quantity_field import Quantity


class PhaseResonance(KindOfTest):
    """A tone whose frequency is controlled, so it follows a resonance from level to level."""

    one_of: ClassVar = (("force", "drive"),)
    kind: Literal["phase_resonance"] = "phase_resonance"
    recorded_as: ClassVar = "tones"
    single_tone: ClassVar = True
    follows_motion: ClassVar = True
    start: Start = "settled"
    frequency: Frequency
    """First frequency, near the resonance [Hz]."""
    from_: Frequency = Field(alias="from")
    """Lowest permitted frequency [Hz]."""
    to: Frequency
    """Highest permitted frequency [Hz]."""
    at: BodyLocation
    """The body whose displacement has the phase: body 3, or its name."""
    phase: Annotated[float, Quantity(ANGLE)] = -pi / 2
    """Phase of the displacement relative to the measured force [rad]; -90 deg at a resonance near the driving point, 90
    deg where the body moves in the opposite direction."""
    tolerance: Annotated[float, Quantity(ANGLE, above=0.0)] = pi / 180
    """Permitted deviation of the phase [rad]."""
    force: Forces | None = None
    """Amplitude of the spring force, or of the force of a force shaker [N]. Several levels run one after another."""
    drive: Drives | None = None
    """Instead of `force`: amplitude of the drive [V, m for a table shaker, or m/s² for a base]."""
    shaker: DrivenShaker = None
    settle: Settle = Settle()
    """Criterion for the steady state, and longest time to wait for the phase."""
    measure: Measure = Measure(periods=50)
    """Measurement time of a level."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check the limits of the frequency."""
        yield from check_band(self.from_, self.to)
        if not self.from_ <= self.frequency <= self.to:
            message = f"got {self.frequency:g} Hz; expected a frequency from {self.from_:g} to {self.to:g} Hz"
            yield Problem(("frequency",), message)

    @property
    def held_phase(self) -> tuple[str, float]:
        """Body and phase of its displacement."""
        return self.at, self.phase

    @property
    def tone(self) -> float:
        """First frequency [Hz]."""
        return self.frequency

    @property
    def shortest(self) -> float:
        """Time of all measurements [s]."""
        return len(self.levels) * self.measure.periods / self.frequency
