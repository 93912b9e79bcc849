"""Response that a scene predicts for the test of a recording, in closed form, with *resting* dampers.

A resting damper lies on the floor of its cavity, and moves with its body.
"""

from collections.abc import Sequence

import numpy as np

from analysis.core.fitting.measured import Curves
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.scene.scene import Scene
from rig.core.system.assembly import assemble, matrices_without_free_beds
from rig.core.system.open_loop_drive import riding_equations, riding_response, solve_harmonic


def scene_of_test(model: Scene, curves: Curves) -> Scene:
    """Return the model with the shaker, the test and the dampers of a recording.

    The returned dampers have the properties of the dampers of the model. Raises `SceneError` if the recording has
    bodies or dampers that the model lacks.
    """
    recorded = curves.scene
    bodies = model.structure.bodies
    if recorded.structure.bodies != bodies or max(curves.bodies) >= bodies:
        n_bodies = max(recorded.structure.bodies, max(curves.bodies) + 1)
        raise SceneError(
            f"{curves.label}: recorded on {n_bodies} bodies; the scene to fit has {bodies}. "
            f"Fit a scene with {n_bodies} bodies."
        )
    remaining = list(enumerate(model.dampers))
    dampers = []
    for number, damper in enumerate(recorded.dampers, 1):
        match = next((pair for pair in remaining if pair[1].body == damper.body), None)
        if match is None:
            raise SceneError(
                f"{curves.label}: recorded with a damper in body {damper.body} (number {number} in its scene). The "
                "scene to fit lacks this damper. Add the damper with its known properties to the scene to fit."
            )
        remaining.remove(match)
        dampers.append(match[1].with_valid(locked=damper.locked))
    # Both scenes are valid and have the same bodies, so the combined scene is valid.
    return model.with_valid(shaker=recorded.shaker, test=recorded.test, dampers=tuple(dampers), channels=None)


def linear_response(test_scene: Scene, curves: Curves, frequency: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return displacement / reference of the bodies and of all beds that could leave their floors.

    A bed with finite-duration contact moves on the spring of its floor. Whether the bed leaves the floor depends on the
    motion of the bed, not on the motion of the body. Shapes: (bodies, frequencies) and (beds, frequencies).
    """
    system = assemble(test_scene)
    states = riding_response(system, _excitation_point(test_scene), 2.0 * np.pi * frequency)
    if curves.reference == "table":
        states = states / states[system.points.index(test_scene.at_driven("table"))]
    beds, gaps = states[system.damper_coordinate], system.gap_coordinate[: system.dampers]
    beds[gaps >= 0] += states[gaps[gaps >= 0]]
    return states[: test_scene.structure.bodies], beds[np.isfinite(system.separation_acceleration)]


def linear_derivatives(
    test_scene: Scene, curves: Curves, frequency: Array, changed_scenes: Sequence[tuple[Scene, float]]
) -> tuple[ComplexArray, ComplexArray]:
    """Return the sensitivities of displacement / reference to the parameters of a scene, and to the frequency.

    The sensitivities are computed from the derivatives of the matrices, which are linear in masses and springs. Finite
    differences of the response would be too inaccurate: near a narrow resonance, some combinations of parameters have a
    negligible effect on the response.

    `changed_scenes`: for each parameter, the scene with a slightly larger parameter, and the change of the parameter.
    Shapes: (parameters, bodies, frequencies), and (bodies, frequencies) for the derivative per Hz.
    """
    system = assemble(test_scene)
    equations = riding_equations(system, _excitation_point(test_scene))
    descriptor_matrix, state_matrix, _ = equations
    omega = 2.0 * np.pi * frequency
    states = riding_response(system, _excitation_point(test_scene), omega)
    # Derivatives of the equations (j omega E - G) x = b: first with respect to omega, then to each parameter.
    right_sides = [-1j * (descriptor_matrix @ states)]
    if not test_scene.dampers:
        equations = _structure_equations(test_scene, system.states)
    for changed_scene, change in changed_scenes:
        if test_scene.dampers:
            changed_equations = riding_equations(assemble(changed_scene), _excitation_point(changed_scene))
        else:
            changed_equations = _structure_equations(changed_scene, system.states)
        pairs = zip(equations, changed_equations, strict=True)
        d_descriptor, d_state, d_input = ((new - old) / change for old, new in pairs)
        right_sides.append(d_state @ states + d_input[:, None] - 1j * omega * (d_descriptor @ states))
    right_side = np.array(right_sides).transpose(2, 1, 0)
    solution = solve_harmonic(descriptor_matrix, state_matrix, right_side, omega).transpose(2, 1, 0)
    bodies = test_scene.structure.bodies
    derivatives = solution[:, :bodies]
    if curves.reference == "table":
        table = system.points.index(test_scene.at_driven("table"))
        transmissibility = states[:bodies] / states[table]
        derivatives = (derivatives - transmissibility * solution[:, table, None]) / states[table]
    return np.asarray(derivatives[1:]), np.asarray(2.0 * np.pi * derivatives[0])


def _structure_equations(test_scene: Scene, states: int) -> tuple[Array, Array, Array]:
    """Return `riding_equations` of a scene without dampers; only the blocks with parameters are filled, for speed."""
    mass, damping, stiffness = matrices_without_free_beds(test_scene)
    n = len(mass)
    descriptor_matrix, state_matrix = np.zeros((2, states, states))
    descriptor_matrix[n : 2 * n, n : 2 * n] = mass
    state_matrix[n : 2 * n, :n], state_matrix[n : 2 * n, n : 2 * n] = -stiffness, -damping
    return descriptor_matrix, state_matrix, np.zeros(states)


def _excitation_point(test_scene: Scene) -> str:
    """Return the excitation point: the hammer, or the driven shaker of the test."""
    return "hammer" if test_scene.hammer is not None else test_scene.at_driven("shaker")
