"""The physics: a scene becomes a hybrid linear system, the system becomes motion."""

from __future__ import annotations

from importlib import import_module
from typing import Any

# Each public name and the module it lives in; a module is imported when one of its names is first used, so
# that `import rig` stays quick (numba alone takes longer to import than a whole impulse test takes to run).
_HOME: dict[str, str] = {
    "Motion": "rig.simulation.motion",
    "MotionMap": "rig.motion_map.motion_map",
    "Plant": "rig.simulation.plant",
    "Response": "rig.response.frequency_response",
    "Run": "rig.simulation.simulate",
    "Approximation": "rig.single_mode.approximate_response",
    "Orbit": "rig.orbits.orbit",
    "OrbitCurve": "rig.orbits.branches",
    "OrbitResponse": "rig.orbits.sweep",
    "Explanation": "rig.effects.explanation",
    "approximate_response": "rig.single_mode.approximate_response",
    "explain": "rig.effects.explanation",
    "follow_orbits": "rig.orbits.branches",
    "frequency_response": "rig.response.frequency_response",
    "map_motion": "rig.motion_map.motion_map",
    "orbit_response": "rig.orbits.sweep",
    "periodic_orbit": "rig.orbits.periodic_orbit",
    "simulate": "rig.simulation.simulate",
    "Scene": "rig.scene.scene",
    "load": "rig.scene.loading",
    "loads": "rig.scene.loading",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'rig' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
