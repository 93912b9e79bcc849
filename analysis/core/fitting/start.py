"""Initial values of a fit: the model is first fitted to the modes of the linear recordings.

A test band may contain only some of the model's modes, so the identified modes are assigned to model modes first.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import combinations
from math import comb

import numpy as np
import scipy

from analysis.core.fitting.measured import Curves
from analysis.core.fitting.predicted import scene_of_test
from analysis.core.fitting.problem import Group, Problem
from analysis.core.modal.identification import identify
from analysis.core.modal.modes import Modes, mac
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, SceneError
from rig.core.results.response import Response
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import driven_bodies, ground_connection, structural_model

# Assumed relative standard deviation of identified frequencies.
_FREQUENCY_SD = 3e-4
# Assumed relative standard deviation of identified damping ratios.
_DAMPING_SD = 0.05
# Assumed standard deviation of a modal constant, relative to the largest constant of its mode.
_CONSTANT_SD = 0.05
# Maximum number of ranked assignments of identified modes to model modes.
_MAX_RANKED = 2000
# Maximum number of assignments that are fitted, in the order of their ranks; each requires a fit.
_MAX_FITTED = 4
# Assignments are compared with this assumed model error, relative to the local peak.
_MODEL_ERROR = 0.1
# Limit of normalized residuals in the comparison of assignments: one wrong mode must not decide.
_MAX_RESIDUAL = 30.0
# The distance of an identified mode from a model mode is the difference of their ln(frequency) in units of this value.
_LOG_FREQUENCY_SCALE = 0.1
# In the squared distance, 1 - MAC (modal assurance criterion, `mac`) has this weight.
_MAC_WEIGHT = 4.0
# Maximum number of evaluations of the model in the fit to the modes.
_MAX_EVALUATIONS = 60
# The fit to the modes ends when the relative decrease of the cost is smaller.
_COST_TOLERANCE = 1e-3


def initial_unknowns(problem: Problem, groups: Sequence[Group]) -> Array:
    """Return unknowns for which the modes of the model are the identified modes, or `problem.start` without modes.

    The k-th fit uses the k-th most likely assignment of every group; the fit with the smallest residual is returned.
    """
    modal_groups = [(group, modes) for group in groups if (modes := _identify(group.curves)) is not None]
    x = problem.start.copy()
    active = [k for k, parameter in enumerate(problem.parameters) if parameter.key_path[0] == "structure"]
    if not modal_groups or not active:
        return x
    ranked = [_ranked_assignments(problem.scene(x), *pair) for pair in modal_groups]
    best, smallest = x, np.inf
    for rank in range(min(_MAX_FITTED, max(map(len, ranked)))):
        assignments = [candidates[min(rank, len(candidates) - 1)] for candidates in ranked]
        fitted = _fit_modes(problem, x, active, modal_groups, assignments)
        residuals = abs(problem.residual(fitted, groups, _MODEL_ERROR))
        cost = float(np.sum(np.minimum(residuals, _MAX_RESIDUAL) ** 2))
        if cost < smallest:
            best, smallest = fitted, cost
    return best


def _identify(curves: Curves) -> Modes | None:
    """Identify the modes of the measured responses and correct their residues, or return None."""
    modes = _identify_measured(curves.frfs, curves.scene.structure.bodies)
    if modes is None:
        return None
    order = np.argsort(curves.frequency, kind="stable")
    correction = [np.interp(modes.frequency, curves.frequency[order], row[order]) for row in curves.correction]
    return replace(modes, residue=modes.residue * np.array(correction))


@lru_cache(maxsize=16)
def _identify_measured(frfs: tuple[Response, ...], bodies: int) -> Modes | None:
    """Identify the modes of responses, or return None; cached, because most trials of `diagnosis` use the same."""
    try:
        return identify(frfs, bodies)
    except (RecordingError, SceneError, np.linalg.LinAlgError):
        return None


def _fit_modes(
    problem: Problem,
    x: Array,
    active: list[int],
    modal_groups: Sequence[tuple[Group, Modes]],
    assignments: Sequence[tuple[int, ...]],
) -> Array:
    """Fit the active unknowns, initially `x`, to the modes; `assignments`: model mode of each mode, for each group."""

    def residual(values: Array) -> Array:
        unknowns = x.copy()
        unknowns[active] = values
        scene = problem.scene(unknowns)
        residuals = [(values - problem.start[active]) / problem.prior_sd[active]]
        for (group, modes), assignment in zip(modal_groups, assignments, strict=True):
            frequency, damping, constants = _model_modes(scene, group)
            assigned = list(assignment)
            measured_constants = (modes.residue * (-2.0 * 2.0 * np.pi * modes.frequency)).imag
            largest = abs(measured_constants).max(axis=0)
            residuals += [
                np.log(frequency[assigned] / modes.frequency) / _FREQUENCY_SD,
                np.log(np.maximum(damping[assigned], 1e-9) / modes.damping) / _DAMPING_SD,
                ((constants[:, assigned] - measured_constants) / largest / _CONSTANT_SD).ravel(),
            ]
        return np.concatenate(residuals)

    solution = scipy.optimize.least_squares(residual, x[active], max_nfev=_MAX_EVALUATIONS, ftol=_COST_TOLERANCE)
    fitted = x.copy()
    fitted[active] = solution.x
    return fitted


def _model_modes(scene: Scene, group: Group) -> tuple[Array, Array, Array]:
    """Return frequencies [Hz], damping ratios, and modal constants (-2 omega Im(residue)), (responses, modes)."""
    test_scene = scene_of_test(scene, group.curves)
    spring = None if test_scene.driven_shaker is None else test_scene.driven_shaker.coil_spring
    model = structural_model(test_scene).with_damper_masses()
    if spring is not None:
        model = model.with_ground_springs(driven_bodies(test_scene), spring)
    modes = model.modes
    shapes = modes.shapes / np.sqrt(modes.mass)
    if test_scene.reference == "table":
        # Force on each body per displacement of the table that carries the structure [N/m].
        participation = ground_connection(test_scene.structure, model).stiffness @ shapes
    else:
        driven = driven_bodies(test_scene) if test_scene.hammer is None else [test_scene.hammer - 1]
        force_per_reference = spring if group.curves.reference == "table" and spring is not None else 1.0  # N/m or 1
        participation = shapes[driven].sum(axis=0) * force_per_reference
    constants = shapes[list(group.curves.bodies)] * participation
    return np.maximum(modes.frequency, 1e-6), modes.damping_ratio, constants


def _ranked_assignments(scene: Scene, group: Group, modes: Modes) -> list[tuple[int, ...]]:
    """List the assignments (the model mode of each identified mode, ascending), the most likely first."""
    frequency, _, constants = _model_modes(scene, group)
    count = modes.frequency.size
    mac_values = mac(constants, modes.shapes)
    ranked = []
    for assignment in combinations(_nearest_modes(frequency, modes.frequency), count):
        distance = np.log(frequency[list(assignment)] / modes.frequency) / _LOG_FREQUENCY_SCALE
        mac_distance = _MAC_WEIGHT * (1.0 - mac_values[list(assignment), range(count)])
        ranked.append((float(np.sum(distance**2 + mac_distance)), assignment))
    return [assignment for _, assignment in sorted(ranked)]


def _nearest_modes(frequency: Array, identified: Array) -> list[int]:
    """Return the model modes nearest to the identified modes, ascending: as many as `_MAX_RANKED` assignments allow.

    >>> _nearest_modes(np.array([1.0, 2.0, 3.0]), np.array([2.1]))
    [0, 1, 2]
    >>> _nearest_modes(np.arange(1.0, 41.0), np.arange(25.0, 33.0))
    [22, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32, 33, 34]
    """
    distance = abs(np.log(frequency[:, None] / identified)).min(axis=1)
    count = max(
        size
        for size in range(identified.size, frequency.size + 1)
        if size == identified.size or comb(size, identified.size) <= _MAX_RANKED
    )
    return sorted(np.argsort(distance, kind="stable")[:count].tolist())
