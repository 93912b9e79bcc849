# The public names and where they live; `__init__.py` imports each when it is first used.

from .commands.calls import cost, grains, map, response
from .commands.compiling import warm_up
from .core.base.errors import RecordingError, RunError, RunWarning, SceneError, SceneWarning, ShotrigError
from .core.effects.explanation import Explanation, explain
from .core.orbits.branches import follow_orbits
from .core.orbits.orbit import Orbit
from .core.orbits.orbit_curve import OrbitCurve
from .core.orbits.periodic_orbit import periodic_orbit
from .core.orbits.sweep import OrbitResponse, orbit_response
from .core.results.response import Response
from .core.scene.damper import Damper
from .core.scene.loading import load, loads
from .core.scene.measurement_chain import Channel, Converter
from .core.scene.scene import Scene
from .core.scene.structure import Structure
from .core.simulation.motion import Motion
from .core.simulation.plant import Plant
from .core.simulation.simulate import Run, simulate
from .core.steady_response.frequency_response import SteadyResponse, frequency_response
from .extras.bed_response.bed_response import BedResponse
from .studies.cost.cost import Cost
from .studies.design.design import Design, design
from .studies.motion_map.motion_map import MotionMap, map_motion
from .studies.single_mode.approximate_response import Approximation, approximate_response

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
