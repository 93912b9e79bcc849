"""Compilation of machine code in advance, so the first result on a machine is not delayed."""

from __future__ import annotations

from typing import Literal

from rig.core.base.errors import SceneError
from rig.core.orbits.sweep import orbit_response
from rig.core.scene.loading import load
from rig.core.simulation.simulate import simulate

Part = Literal["engine", "orbits"]


def warm_up(*parts: Part) -> None:
    """Compile the numba kernels of the given parts of the program now; without arguments, of all parts.

    Parameters
    ----------
    *parts : {"engine", "orbits"}
        Engine: time integration, which suffices for `simulate`, `frequency_response` and `daq.record`; orbits:
        periodic orbits, whose functions also need the engine.

    Raises
    ------
    SceneError
        If a part does not exist.
    """
    scene = load("fig9")
    for part in parts or ("engine", "orbits"):
        if part == "engine":
            simulate(scene, 0.01)
        elif part == "orbits":
            orbit_response(scene, [49.0])
        else:
            raise SceneError(f"warm_up: got {part!r}; expected engine or orbits")
