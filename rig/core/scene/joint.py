"""Settings of a joint, which acts between two bodies, or between a body and the ground."""

from collections.abc import Callable, Iterable
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, WithJsonSchema

from rig.core.scene.body_names import GROUND
from rig.core.settings.alternatives import Alternatives, by_key
from rig.core.settings.problems import Problem
from rig.core.settings.quantities import DASHPOT, FORCE, LENGTH, RATIO, STIFFNESS
from rig.core.settings.quantity_field import Quantity, unexpected_value_error
from rig.core.settings.settings import Settings


def _end(value: Any) -> int | str:
    """Check one end of a joint; `Scene` has replaced names of bodies by their numbers."""
    if value == GROUND:
        return GROUND
    number = int(value) if isinstance(value, str) and value.isdecimal() else value
    if not isinstance(number, int) or isinstance(number, bool) or number < 1:
        raise unexpected_value_error(value, "a body by its number from 1 or its name, or ground")
    return number


def _ends(value: Any) -> Any:
    """Check that a joint has two ends."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise unexpected_value_error(value, "two items, such as [1, 2] or [ground, 1]")
    return tuple(value)


_END_SCHEMA: dict[str, Any] = {"anyOf": [{"type": "integer", "minimum": 1}, {"type": "string"}]}
_End = Annotated[int | str, BeforeValidator(_end), WithJsonSchema(_END_SCHEMA)]
_Ends = Annotated[
    tuple[_End, _End],
    BeforeValidator(_ends),
    WithJsonSchema({"type": "array", "items": _END_SCHEMA, "minItems": 2, "maxItems": 2}),
]


class _Joint(Settings):
    """Settings that all kinds of joints have; `action`: what a joint does at a high level, and at a low level."""

    action: ClassVar[tuple[str, str]]
    between: _Ends
    """The lower and the upper of two bodies, by number from 1 or name; one of them may be ground."""

    @property
    def ends(self) -> tuple[int | None, int | None]:
        """Indices (from 0) of the lower and of the upper body; None for the ground."""
        lower, upper = (None if end == GROUND else int(end) - 1 for end in self.between)
        return lower, upper

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the joint connects two places."""
        if self.between[0] == self.between[1]:
            yield Problem(("between",), f"both ends are {self.between[0]}; expected two bodies, or a body and ground")

    def locations(self, label: Callable[[int], str]) -> str:
        """Name both ends; `label`: returns the name of a body for its number."""
        lower, upper = (end if isinstance(end, str) else label(end) for end in self.between)
        return f"between {lower} and {upper}"


class Stop(_Joint):
    """A stop: spring and dashpot that act between two bodies, or a body and the ground, while its gap is closed."""

    slip_force: ClassVar[float | None] = None
    action: ClassVar = ("closes", "stays open")
    gap: Annotated[float, Quantity(LENGTH, at_least=0.0)]
    """Distance of the two contact points at rest, before the weight of the dampers deforms the structure [m]; 0: they
    touch without force."""
    stiffness: Annotated[float, Quantity(STIFFNESS, above=0.0)]
    """Contact stiffness: force per penetration depth [N/m]."""
    damping: Annotated[float, Quantity(DASHPOT, at_least=0.0)] = 0.0
    """Viscous damping coefficient of the contact [N s/m]; the stop never pulls."""
    restitution: Annotated[float, Quantity(RATIO, above=0.0, below=1.0)] | None = None
    """Instead of damping: ratio of rebound speed to closing speed, if no other force acts on the two bodies."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check the ends, and that the dashpot is given once."""
        yield from super().check_consistency()
        if self.restitution is not None and self.damping:
            yield Problem(("restitution",), "restitution and damping are given together. Remove one of them.")

    @property
    def short_text(self) -> str:
        """Text next to the drawing of the joint."""
        return f"{1e3 * self.gap:.4g} mm"

    def text(self, label: Callable[[int], str]) -> str:
        """Describe the joint; `label`: returns the name of a body for its number."""
        dashpot = f", {self.damping:.4g} N s/m" if self.damping else ""
        if self.restitution is not None:
            dashpot = f", restitution {self.restitution:.4g}"
        return f"stop {self.locations(label)}, gap {self.short_text}, {self.stiffness:.4g} N/m{dashpot}"


class FrictionJoint(_Joint):
    """A joint with friction between two bodies, or a body and the ground: a spring in series with a slider."""

    gap: ClassVar[float] = 0.0
    damping: ClassVar[float] = 0.0
    restitution: ClassVar[float | None] = None
    action: ClassVar = ("slips", "sticks")
    slip_force: Annotated[float, Quantity(FORCE, above=0.0)]
    """Force at which the slider moves [N]; at rest the joint has no force."""
    stiffness: Annotated[float, Quantity(STIFFNESS, above=0.0)]
    """Stiffness of the spring in series with the slider [N/m]."""

    @property
    def short_text(self) -> str:
        """Text next to the drawing of the joint."""
        return f"slips at {self.slip_force:.4g} N"

    def text(self, label: Callable[[int], str]) -> str:
        """Describe the joint; `label`: returns the name of a body for its number."""
        return f"friction joint {self.locations(label)}, {self.short_text}, {self.stiffness:.4g} N/m"


Joint = Annotated[Stop | FrictionJoint, Alternatives(by_key)]
