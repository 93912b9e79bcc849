"""Free vibration from an initial state."""

from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.core.base.arrays import Array
from rig.core.scene.excitation.kind import Duration, KindOfTest, Rest, Start
from rig.core.settings.problems import Problem
from rig.core.settings.quantities import LENGTH, VELOCITY
from rig.core.settings.quantity_field import Quantity


class Free(KindOfTest):
    """Free vibration from given displacements and velocities, with zero drive."""

    kind: Literal["free"] = "free"
    recorded_as: ClassVar = "free"
    level_keys: ClassVar = ()
    uses_shaker: ClassVar = False
    start: Start = "settled"
    displacement: tuple[Annotated[float, Quantity(LENGTH)], ...] | None = Field(None, min_length=1)
    """One initial displacement for each body, relative to the start position [m]."""
    velocity: tuple[Annotated[float, Quantity(VELOCITY)], ...] | None = Field(None, min_length=1)
    """One initial velocity for each body [m/s]."""
    mode: Annotated[int, Field(ge=1)] | None = None
    """Instead of displacement and velocity: number of the mode whose shape is the initial displacement, from 1."""
    amplitude: Annotated[float, Quantity(LENGTH, above=0.0)] | None = None
    """Initial displacement at the largest component of the mode shape [m]; only with `mode`."""
    duration: Duration = 6.0
    """Duration of the test [s]."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the initial state is given in exactly one form."""
        if (self.mode is None) != (self.amplitude is None):
            given_key, missing_key = ("mode", "amplitude") if self.amplitude is None else ("amplitude", "mode")
            yield Problem((given_key,), f"given without {missing_key}. Add {missing_key}, or remove {given_key}.")
        if self.mode is not None and (self.displacement is not None or self.velocity is not None):
            yield Problem(("mode",), "mode is given together with displacement or velocity. Remove one of the two.")
        if self.mode is None and self.displacement is None and self.velocity is None:
            yield Problem((), "no initial state; expected displacement, velocity, or mode and amplitude")

    def initial_motion(self, bodies: int, shapes: Callable[[], Array]) -> tuple[Array, Array]:
        """Return initial displacement [m] and velocity [m/s], (bodies,); `shapes` computes the mode shapes."""
        displacement = np.zeros(bodies) if self.displacement is None else np.array(self.displacement)
        if self.mode is not None:
            displacement = (self.amplitude or 0.0) * shapes()[:, self.mode - 1]
        return displacement, np.zeros(bodies) if self.velocity is None else np.array(self.velocity)

    def wave(self, samples: int, rate: float) -> Rest:
        """Return a zero drive."""
        return Rest()

    def references(self, valid: Mapping[str, Any]) -> Iterable[Problem]:
        """Check the number of values, and the mode."""
        if "structure" not in valid:
            return
        n_bodies = valid["structure"].bodies
        for key, values in (("displacement", self.displacement), ("velocity", self.velocity)):
            if values is not None and len(values) != n_bodies:
                yield Problem((key,), f"got {len(values)} values; expected {n_bodies}, one for each body")
        if self.mode is not None and self.mode > n_bodies:
            yield Problem(("mode",), f"mode {self.mode} does not exist; expected 1 to {n_bodies}")
