"""The physics: a scene becomes a hybrid linear system, the system becomes motion."""

from __future__ import annotations

from importlib import import_module
from typing import Any

# Each public name and the module it lives in; a module is imported when one of its names is first used, so
# that `import rig` stays quick (numba alone takes longer to import than a whole impulse test takes to run).
_HOME: dict[str, str] = {
    "Motion": "rig.motion",
    "MotionMap": "rig.motion_map",
    "Plant": "rig.plant",
    "Response": "rig.response",
    "Run": "rig.simulation",
    "Approximation": "rig.approximate",
    "Orbit": "rig.orbit_following",
    "OrbitCurve": "rig.orbit_curve",
    "OrbitResponse": "rig.orbit_sweep",
    "Explanation": "rig.effects",
    "approximate_response": "rig.approximate",
    "explain": "rig.effects",
    "follow_orbits": "rig.orbit_curve",
    "frequency_response": "rig.response",
    "map_motion": "rig.motion_map",
    "orbit_response": "rig.orbit_sweep",
    "periodic_orbit": "rig.orbit",
    "simulate": "rig.simulation",
    "Scene": "rig.scene",
    "load": "rig.scene_file",
    "loads": "rig.scene_file",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'rig' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
