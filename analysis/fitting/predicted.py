"""Predicted response of a scene to the test of a recording, with all dampers at rest, in closed form."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.fitting.measured import Curves
from rig.arrays import Array, ComplexArray
from rig.errors import SceneError
from rig.scene.scene import Scene
from rig.system.assembly import assemble, matrices_without_free_beds
from rig.system.open_loop_drive import riding_equations, riding_response


def scene_of_test(model: Scene, curves: Curves) -> Scene:
    """Give the model the shaker and test of a recording, and those of its dampers that were in the recording.

    Raises `SceneError` if the recording has bodies or dampers that the model lacks.
    """
    recorded = curves.scene
    bodies = model.structure.bodies
    if recorded.structure.bodies != bodies or max(curves.bodies) >= bodies:
        n_bodies = max(recorded.structure.bodies, max(curves.bodies) + 1)
        raise SceneError(
            f"{curves.label}: recorded on {n_bodies} bodies; the scene to fit has {bodies}. "
            "Fit a scene with these bodies."
        )
    remaining = list(enumerate(model.dampers))
    dampers = []
    for number, damper in enumerate(recorded.dampers, 1):
        match = next((pair for pair in remaining if pair[1].body == damper.body), None)
        if match is None:
            raise SceneError(
                f"{curves.label}: recorded with a damper in body {damper.body} (number {number} in its scene), which "
                "the scene to fit lacks. Add it there, with its known values."
            )
        remaining.remove(match)
        dampers.append(match[1].with_valid(locked=damper.locked))
    # Both scenes are valid and have the same bodies, so this one is.
    return model.with_valid(shaker=recorded.shaker, test=recorded.test, dampers=tuple(dampers), channels=None)


def linear_response(bench: Scene, curves: Curves, frequency: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return displacement / reference with all dampers at rest: of the bodies, and of the beds that could lift off.

    A bed with finite-duration contact moves on the spring of its floor, so that it lifts off at another acceleration.

    Returns `bodies`, shape (bodies, frequencies); `beds`, shape (beds, frequencies).
    """
    system = assemble(bench)
    states = riding_response(system, _drive(bench), 2.0 * np.pi * frequency)
    if curves.reference == "table":
        states = states / states[system.points.index(bench.at_driven("table"))]
    beds = states[system.damper_coordinate]
    beds[system.finite_contact] += states[system.bed[system.finite_contact]]
    return states[: bench.structure.bodies], beds[system.clearance > 0.0]


def linear_slopes(
    bench: Scene, curves: Curves, frequency: Array, changed: Sequence[tuple[Scene, Scene, float]]
) -> tuple[ComplexArray, ComplexArray]:
    """Return the derivatives of the bodies' displacement with respect to values of the scene, and to the frequency.

    They follow from the derivatives of the matrices, in which masses and springs are linear. Differences of the
    response itself are too inaccurate near narrow resonances for combinations of values that hardly change it.

    `changed`: for each value: the scene with a larger and with a smaller value, and their difference. Returns
    `by_value`, shape (values, bodies, frequencies); `by_frequency`, shape (bodies, frequencies), per Hz.
    """
    system = assemble(bench)
    inertia, matrix, _ = riding_equations(system, _drive(bench))
    omega = 2.0 * np.pi * frequency
    states = riding_response(system, _drive(bench), omega)
    right_sides = [-1j * (inertia @ states)]
    for larger, smaller, distance in changed:
        if bench.dampers:
            by_inertia, by_matrix, by_inflow = _equation_slopes(larger, smaller, distance)
        else:
            by_inertia, by_matrix, by_inflow = _matrix_slopes(larger, smaller, distance, system.states)
        right_sides.append(by_matrix @ states + by_inflow[:, None] - 1j * omega * (by_inertia @ states))
    dynamic = 1j * omega[:, None, None] * inertia - matrix
    solution = np.linalg.solve(dynamic, np.array(right_sides).transpose(2, 1, 0)).transpose(2, 1, 0)
    bodies = bench.structure.bodies
    slopes = solution[:, :bodies]
    if curves.reference == "table":
        table = system.points.index(bench.at_driven("table"))
        ratio = states[:bodies] / states[table]
        slopes = (slopes - ratio * solution[:, table, None]) / states[table]
    return np.asarray(slopes[1:]), np.asarray(2.0 * np.pi * slopes[0])


def _equation_slopes(larger: Scene, smaller: Scene, distance: float) -> tuple[Array, Array, Array]:
    """Differentiate the result of `riding_equations` with respect to a value."""
    pairs = zip(*(riding_equations(assemble(scene), _drive(scene)) for scene in (larger, smaller)), strict=True)
    by_inertia, by_matrix, by_inflow = ((high - low) / distance for high, low in pairs)
    return by_inertia, by_matrix, by_inflow


def _matrix_slopes(larger: Scene, smaller: Scene, distance: float, states: int) -> tuple[Array, Array, Array]:
    """Do the same without dampers, in less time: only the matrices of the equations depend on fitted values."""
    pairs = zip(matrices_without_free_beds(larger), matrices_without_free_beds(smaller), strict=True)
    by_mass, by_damping, by_stiffness = ((high - low) / distance for high, low in pairs)
    n = len(by_mass)
    by_inertia, by_matrix = np.zeros((2, states, states))
    by_inertia[n : 2 * n, n : 2 * n] = by_mass
    by_matrix[n : 2 * n, :n], by_matrix[n : 2 * n, n : 2 * n] = -by_stiffness, -by_damping
    return by_inertia, by_matrix, np.zeros(states)


def _drive(bench: Scene) -> str:
    hammer = bench.test is not None and bench.test.kind == "impulse"
    return "hammer" if hammer else bench.at_driven("shaker")
