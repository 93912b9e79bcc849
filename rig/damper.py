"""The dampers' masses and the bodies they are in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.scene import Scene
from rig.structure import structure_matrices


def damper_masses(scene: Scene) -> NDArray[np.float64]:
    """Give the mass of each damper of a scene.

    Parameters
    ----------
    scene : Scene
        A mass ratio refers to the body's mass, with matrices to the diagonal element of the mass matrix.

    Returns
    -------
    ndarray, shape (dampers,)
        Masses [kg] in the scene's order.
    """
    if not scene.dampers:
        return np.zeros(0)
    body_masses = np.diag(structure_matrices(scene.structure)[0])
    return np.array(
        [
            damper.mass
            if damper.mass is not None
            else (damper.mass_ratio or 0.0) * body_masses[damper.body - 1]
            for damper in scene.dampers
        ]
    )


def damper_bodies(scene: Scene) -> NDArray[np.intp]:
    """Give the position (from 0) of the body of each damper, shape (dampers,)."""
    return np.array([damper.body - 1 for damper in scene.dampers], dtype=np.intp)
