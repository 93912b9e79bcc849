"""What a scene answers to the test of a recording, its dampers riding: in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.fitting.measured import Curves
from rig.errors import SceneError
from rig.scene.scene import Scene
from rig.system.assembly import assemble
from rig.system.open_loop_drive import riding_response

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def on_the_bench(model: Scene, curves: Curves) -> Scene:
    """Put the model on the bench of a recording: its shaker, its test, and those of the model's dampers it had.

    Raises
    ------
    SceneError
        If the recording has bodies or dampers that the model lacks.
    """
    recorded = curves.scene
    bodies = model.structure.bodies
    if recorded.structure.bodies != bodies or max(curves.bodies) >= bodies:
        most = max(recorded.structure.bodies, max(curves.bodies) + 1)
        raise SceneError(f"{curves.label} was recorded on {most} bodies; the scene to fit has {bodies}")
    left = list(enumerate(model.dampers))
    dampers = []
    for number, damper in enumerate(recorded.dampers, 1):
        mine = next((pair for pair in left if pair[1].body == damper.body), None)
        if mine is None:
            raise SceneError(
                f"{curves.label} was recorded with a damper in body {damper.body} (number {number} in its scene), "
                "where the scene to fit has none; add it there, with what is known of it"
            )
        left.remove(mine)
        dampers.append(mine[1].replace(locked=damper.locked))
    return model.replace(shaker=recorded.shaker, test=recorded.test, dampers=tuple(dampers), channels=None)


def linear(bench: Scene, curves: Curves, frequency: Array) -> ComplexArray:
    """Displacement of the bodies over the reference, all dampers riding, shape (bodies, frequencies)."""
    system = assemble(bench)
    hammer = bench.test is not None and bench.test.kind == "impulse"
    drive = "hammer" if hammer else bench.at_driven("shaker")
    states = riding_response(system, drive, 2.0 * np.pi * frequency)
    bodies = bench.structure.bodies
    if curves.reference == "table":
        return states[:bodies] / states[system.points.index(bench.at_driven("table"))]
    return states[:bodies]
