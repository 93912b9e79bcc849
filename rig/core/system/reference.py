"""The reference (denominator) of steady responses: a force, or the displacement of the table."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rig.core.base.arrays import Array, ComplexArray
from rig.core.scene.scene import Scene
from rig.core.system.assembly import force_row
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.structural_model import receptance, transmissibility


@dataclass(frozen=True)
class Reference:
    """Force on the structure [N], or displacement of the table [m].

    `row`: reference = row @ state; None if the drive is the force, which is then not in the state.
    """

    name: Literal["force", "table"]
    row: Array | None

    def amplitude(self, level: float, harmonic: ComplexArray) -> complex:
        """Return the complex amplitude of the reference; `harmonic`: first harmonic of each state."""
        if self.row is None:
            return -1j * level  # a sine: Re(-i F e^{i w t}) = F sin(w t)
        return complex(self.row @ harmonic)


def reference_of(scene: Scene, system: HybridSystem) -> Reference:
    """Return the force if the test gives its level, otherwise the first reference of the driven shaker."""
    shaker = scene.driven_shaker
    if shaker is None or shaker.drive_is_force:
        return Reference("force", None)
    if scene.level_key == "force" or shaker.references[0] == "force":
        return Reference("force", force_row(scene, system))
    row = np.zeros(system.states)
    row[system.points.index(scene.at_driven("table"))] = 1.0
    return Reference("table", row)


def linear_response(scene: Scene, frequency: ArrayLike) -> ComplexArray:
    """Return the linear response of each body over the default reference of a scene, shape (bodies, frequencies).

    The response is the transmissibility if the table carries the structure, otherwise the compliance. `frequency`: Hz.
    """
    return transmissibility(scene, frequency) if scene.reference == "table" else receptance(scene, frequency)


def reference_per_level(scene: Scene, frequency: float) -> float:
    """Return the amplitude of the default reference per unit of level: 1 for a force; `frequency`: Hz."""
    shaker = scene.driven_shaker
    if shaker is None or scene.reference == "force":
        return 1.0
    drive_per_displacement, _ = shaker.required_drive(np.array(2j * np.pi * frequency))
    return float(1.0 / abs(drive_per_displacement))
