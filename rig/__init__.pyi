# The public names and where they live; `__init__.py` imports each when it is first used.

from .compiling import warm_up
from .damper_design.design import Design, design
from .effects.explanation import Explanation, explain
from .motion_map.motion_map import MotionMap, map_motion
from .orbits.branches import follow_orbits
from .orbits.orbit import Orbit
from .orbits.orbit_curve import OrbitCurve
from .orbits.periodic_orbit import periodic_orbit
from .orbits.sweep import OrbitResponse, orbit_response
from .response.frequency_response import Response, frequency_response
from .scene.loading import load, loads
from .scene.scene import Scene
from .simulation.motion import Motion
from .simulation.plant import Plant
from .simulation.simulate import Run, simulate
from .single_mode.approximate_response import Approximation, approximate_response

__all__ = [
    "Approximation",
    "Design",
    "Explanation",
    "Motion",
    "MotionMap",
    "Orbit",
    "OrbitCurve",
    "OrbitResponse",
    "Plant",
    "Response",
    "Run",
    "Scene",
    "approximate_response",
    "design",
    "explain",
    "follow_orbits",
    "frequency_response",
    "load",
    "loads",
    "map_motion",
    "orbit_response",
    "periodic_orbit",
    "simulate",
    "warm_up",
]
