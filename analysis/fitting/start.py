"""Initial values of a fit: the model with these values has the modes identified from the linear recordings."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations
from math import comb

import numpy as np
import scipy

from analysis.fitting.predicted import scene_of_test
from analysis.fitting.problem import Group, Problem
from analysis.modal.identification import identify
from analysis.modal.modes import Modes, mac
from rig.arrays import Array
from rig.errors import RecordingError, SceneError
from rig.results.response import Response
from rig.scene.scene import Scene
from rig.system.structural_model import driven_bodies, structural_model

# Standard deviations assumed for the identified modes: of frequency and damping, relative, and of a shape, relative to
# its largest component.
_FREQUENCY_SD = 3e-4
_DAMPING_SD = 0.05
_SHAPE_SD = 0.05
# Largest number of assignments of identified modes to model modes that are ranked.
_MAX_RANKED = 2000
# Largest number of these assignments that are fitted.
_MAX_FITTED = 4
# Relative model error that is assumed when assignments are compared.
_MODEL_ERROR = 0.1
# Larger residuals are clipped in this comparison, standard deviations.
_MAX_RESIDUAL = 30.0
# Distance between an identified mode and a model mode: logarithm of the frequency ratio that counts as 1.
_LOG_FREQUENCY_SCALE = 0.1
# Weight of 1 - MAC in this distance.
_MAC_WEIGHT = 4.0


def initial_unknowns(problem: Problem, groups: Sequence[Group]) -> Array:
    """Return unknowns with which the model has the identified modes, or those of the scene if no mode is identified.

    If the band of the test contains only some of the modes, the assignment with the smallest residual is used. The
    k-th fit uses the k-th most likely assignment of every group.
    """
    identified = [(group, _identify(group.curves.frfs, group.curves.scene.structure.bodies)) for group in groups]
    modal_groups = [(group, modes) for group, modes in identified if modes is not None]
    x = problem.start.copy()
    active = [k for k, parameter in enumerate(problem.parameters) if parameter.place[0] == "structure"]
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


@lru_cache(maxsize=16)
def _identify(frfs: tuple[Response, ...], bodies: int) -> Modes | None:
    """Identify the modes of curves; cached, because every trial of `diagnosis` identifies the same curves."""
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
    """Fit the active unknowns to the identified modes, which are assigned to modes of the model."""

    def residual(values: Array) -> Array:
        unknowns = x.copy()
        unknowns[active] = values
        scene = problem.scene(unknowns)
        parts = [(values - problem.start[active]) / problem.prior_sd[active]]
        for (group, modes), assignment in zip(modal_groups, assignments, strict=True):
            frequency, damping, constants = _model_modes(scene, group)
            numbers = list(assignment)
            measured = (modes.residue * (-2.0 * 2.0 * np.pi * modes.frequency)).imag
            scale = abs(measured).max(axis=0)
            parts += [
                np.log(frequency[numbers] / modes.frequency) / _FREQUENCY_SD,
                np.log(np.maximum(damping[numbers], 1e-9) / modes.damping) / _DAMPING_SD,
                ((constants[:, numbers] - measured) / scale / _SHAPE_SD).ravel(),
            ]
        return np.concatenate(parts)

    solution = scipy.optimize.least_squares(residual, x[active], max_nfev=60)
    fitted = x.copy()
    fitted[active] = solution.x
    return fitted


def _model_modes(scene: Scene, group: Group) -> tuple[Array, Array, Array]:
    """Return frequency in Hz, damping ratio, and modal constants (Ewins), shape (responses, modes).

    A modal constant is -2 omega times the imaginary part of the residue.
    """
    bench = scene_of_test(scene, group.curves)
    spring = getattr(bench.driven_shaker, "spring", None)
    model = structural_model(bench).with_bed_masses()
    if spring is not None:
        model = model.with_ground_springs(driven_bodies(bench), spring)
    modes = model.modes
    shapes = modes.shapes / np.sqrt(modes.mass)
    hammer = bench.test is not None and bench.test.kind == "impulse"
    driven = [bench.test.body - 1] if hammer else driven_bodies(bench)  # type: ignore[union-attr]
    force = spring if group.curves.reference == "table" and spring is not None else 1.0
    constants = shapes[list(group.curves.bodies)] * shapes[driven].sum(axis=0) * force
    return np.maximum(modes.frequency, 1e-6), modes.damping_ratio, constants


def _ranked_assignments(scene: Scene, group: Group, modes: Modes) -> list[tuple[int, ...]]:
    """List the assignments of the identified modes to modes of the model, in rising order, most likely first."""
    frequency, _, constants = _model_modes(scene, group)
    count = modes.frequency.size
    similarity = mac(constants, modes.shapes)
    ranked = []
    for assignment in combinations(_nearest_modes(frequency, modes.frequency), count):
        distance = np.log(frequency[list(assignment)] / modes.frequency) / _LOG_FREQUENCY_SCALE
        dissimilarity = 1.0 - similarity[list(assignment), range(count)]
        ranked.append((float(np.sum(distance**2 + _MAC_WEIGHT * dissimilarity)), assignment))
    return [assignment for _, assignment in sorted(ranked)]


def _nearest_modes(frequency: Array, identified: Array) -> list[int]:
    """Select model modes, in rising order, for at most `_MAX_RANKED` assignments: those nearest to identified ones.

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
