"""A series of tones at which the amplitude of a response is constant."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field, WithJsonSchema

from rig.core.scene.excitation.kind import DrivenShaker, Settle
from rig.core.scene.excitation.stepped_sine import Measure, SteppedTest
from rig.core.scene.shaker import Shaker
from rig.core.settings.quantities import ACCELERATION, LENGTH, VELOCITY
from rig.core.settings.quantity_field import Quantity

# A body. The schema also allows its name, which `Scene` replaces by its number.
BodyLocation = Annotated[str, Field(pattern=r"^body [1-9][0-9]{0,5}$"), WithJsonSchema({"type": "string"})]
# Unit of each derivative of a displacement.
_UNITS = ("m", "m/s", "m/s^2")


class ConstantResponse(SteppedTest):
    """A series of tones with a body's motion at the level, also where the response to a constant force jumps."""

    level_keys: ClassVar = ("displacement", "velocity", "acceleration")
    one_of: ClassVar = (level_keys, ("frequencies", "points"))
    follows_motion: ClassVar = True
    kind: Literal["constant_response"] = "constant_response"
    at: BodyLocation
    """The body whose motion has the constant amplitude: body 3, or its name."""
    displacement: Annotated[float | tuple[float, ...] | None, Quantity(LENGTH, above=0.0, listed=True)] = None
    """Amplitude of the displacement of the body [m]. Several levels are run one after another."""
    velocity: Annotated[float | tuple[float, ...] | None, Quantity(VELOCITY, above=0.0, listed=True)] = None
    """Instead of `displacement`: amplitude of the velocity of the body [m/s]."""
    acceleration: Annotated[float | tuple[float, ...] | None, Quantity(ACCELERATION, above=0.0, listed=True)] = None
    """Instead of `displacement`: amplitude of the acceleration of the body [m/s²]."""
    shaker: DrivenShaker = None
    settle: Settle = Settle()
    """Criterion for the steady state of a dwell."""
    measure: Measure = Measure()
    """Measurement time of a dwell in steady state."""

    @property
    def held_motion(self) -> tuple[str, int]:
        """Body and order of the derivative whose amplitude is the level."""
        return self.at, self.level_keys.index(self.level_key)

    def level_unit(self, shaker: Shaker | None) -> str:
        """Return the unit of the motion."""
        return _UNITS[self.held_motion[1]]

    @property
    def tone(self) -> None:
        """None: the drive depends on measured values."""
