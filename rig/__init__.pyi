# The public names and where they live; `__init__.py` imports each when it is first used.

from .bed_response.bed_response import BedResponse
from .calls import cost, grains, map, response
from .compiling import warm_up
from .damper_design.design import Design, design
from .effects.explanation import Explanation, explain
from .errors import RecordingError, RunError, RunWarning, SceneError, SceneWarning, ShotrigError
from .motion_map.motion_map import MotionMap, map_motion
from .orbits.branches import follow_orbits
from .orbits.orbit import Orbit
from .orbits.orbit_curve import OrbitCurve
from .orbits.periodic_orbit import periodic_orbit
from .orbits.sweep import OrbitResponse, orbit_response
from .results.response import Response
from .scene.damper import Damper
from .scene.loading import load, loads
from .scene.measurement_chain import Channel, Converter
from .scene.scene import Scene
from .scene.structure import Structure
from .simulation.motion import Motion
from .simulation.plant import Plant
from .simulation.simulate import Run, simulate
from .single_mode.approximate_response import Approximation, approximate_response
from .steady_response.frequency_response import SteadyResponse, frequency_response
from .work_precision.cost import Cost

__all__ = [
    "Approximation",
    "BedResponse",
    "Channel",
    "Converter",
    "Cost",
    "Damper",
    "Design",
    "Explanation",
    "Motion",
    "MotionMap",
    "Orbit",
    "OrbitCurve",
    "OrbitResponse",
    "Plant",
    "RecordingError",
    "Response",
    "Run",
    "RunError",
    "RunWarning",
    "Scene",
    "SceneError",
    "SceneWarning",
    "ShotrigError",
    "SteadyResponse",
    "Structure",
    "approximate_response",
    "cost",
    "design",
    "explain",
    "follow_orbits",
    "frequency_response",
    "grains",
    "load",
    "loads",
    "map",
    "map_motion",
    "orbit_response",
    "periodic_orbit",
    "response",
    "simulate",
    "warm_up",
]
