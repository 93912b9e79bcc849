"""Linear theory of a recording: the structure with its linear dampers, and with its supports in the test.

Linear dampers are masses that cannot move in their bodies, and masses on springs, whose walls are removed. Beds and
sliding masses are removed completely. The force of a shaker is measured between coil spring and structure, so the
theory excludes the coil spring. In an impact test all shakers are idle, and their coil springs remain attached. If a
table carries the structure, the modes are those with the table at rest.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.core.modal.modes import Modes
from analysis.core.responses.measurands import driven_forces
from daq.core.recording.recording import Recording
from rig.core.base.errors import SceneError
from rig.core.results.response import Response
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import ForceShaker, at_shaker
from rig.core.system.assembly import assemble, matrices_without_free_beds
from rig.core.system.natural_modes import natural_modes
from rig.core.system.open_loop_drive import riding_response

# Number of points of a theoretical curve: its resonances remain smooth when a reader enlarges the figure.
_POINTS = 3000


class TheoreticalModes(NamedTuple):
    """Modes of the scene's structure at the measured points."""

    frequency: NDArray[np.float64]  # Hz; (modes,)
    shapes: NDArray[np.float64]  # (responses, modes)


def linear_theory(rec: Recording, frf: Response) -> Response:
    """Compute the exact FRF of the structure with its linear dampers, with the response and reference of a curve."""
    frequency = np.geomspace(float(frf.frequency.min()), float(frf.frequency.max()), _POINTS)
    if frf.reference == "table":
        scene, drive = _with_linear_dampers(rec.scene), rec.scene.at_driven("shaker")
    else:
        scene, drive = _scene_under_force(rec), _force_input(rec, frf)
    system = assemble(scene)
    states = riding_response(system, drive, 2.0 * np.pi * frequency)
    if frf.reference == "table":
        states = states / states[system.points.index(rec.scene.at_driven("table"))]
    curve = Response.curve(
        frequency, states[rec.channels[frf.response].body - 1], frf.response, reference=frf.reference,
        coherence=np.ones(frequency.size), label=f"linear theory, {'linear' if scene.dampers else 'no'} dampers",
    )  # fmt: skip
    return curve.to(frf.motion).placed(frf.output_at, frf.input_at, frf.outputs[0].body)


def theoretical_modes(rec: Recording, modes: Modes) -> TheoreticalModes | None:
    """Compute the modes of the scene's structure at the measured points; None for a single point."""
    scene = _scene_under_force(rec)
    mass, _, stiffness = matrices_without_free_beds(scene)
    # In a mode, a table with prescribed displacement is at rest.
    tables = enumerate((shaker for _, shaker in scene.tables), scene.structure.bodies)
    resting = [row for row, shaker in tables if shaker.prescribed]
    mass, stiffness = (np.delete(np.delete(matrix, resting, 0), resting, 1) for matrix in (mass, stiffness))
    omega, shapes = natural_modes(mass, stiffness)
    bodies = [rec.channels[name].body - 1 for name in modes.responses]
    return TheoreticalModes(omega / (2.0 * np.pi), shapes[bodies]) if len(bodies) > 1 else None


def _with_linear_dampers(scene: Scene) -> Scene:
    """Return a scene with only its linear dampers: masses that cannot move, and masses on springs without walls."""
    linear = tuple(
        damper.without_walls() if damper.spring is not None else damper
        for damper in scene.dampers
        if damper.spring is not None or not damper.impacts
    )
    return scene.with_ideal_channels(dampers=linear, gravity=0.0)


def _scene_under_force(rec: Recording) -> Scene:
    """Return the scene on which the measured force acts: an ideal force instead of each driven shaker."""
    scene = _with_linear_dampers(rec.scene)
    if rec.test.kind.hammered or not scene.shakers:
        return scene
    driven = {rec.channels[point.name].at for point in driven_forces(rec)} or {scene.at_driven("shaker")}
    shakers = [
        ForceShaker(body=shaker.bodies)
        if shaker.bodies and at_shaker("shaker", number, len(scene.shakers)) in driven
        else shaker
        for number, shaker in enumerate(scene.shakers, 1)
    ]
    return scene.replace(shaker=shakers if len(shakers) > 1 else shakers[0], test=None)


def _force_input(rec: Recording, frf: Response) -> str:
    """Return the name of the input that is the force of a response."""
    scene = rec.scene
    if scene.hammer is not None:
        return "hammer"
    if not scene.shakers or rec.test.kind.hammered:
        raise SceneError(
            f"scene {scene.name!r} does not give the location of the force, so there is no theory. Add a shaker, or a "
            "test of kind impulse for a hammer."
        )
    [source] = frf.inputs
    driven = [point.name for point in driven_forces(rec)]
    return rec.channels[source.name].at if source.name in driven else scene.at_driven("shaker")
