"""Starting values of a fit: the model with these values has the modes identified from the linear recordings."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations, islice

import numpy as np
import scipy

from analysis.fitting.predicted import on_the_bench
from analysis.fitting.problem import Group, Problem
from analysis.modal.identification import identify
from analysis.modal.modes import Modes, mac
from rig.arrays import Array
from rig.errors import RecordingError, SceneError
from rig.results.response import Response
from rig.scene.scene import Scene
from rig.system.structural_model import driven_bodies, structural_model

# Assumed standard deviations of the identified modes: frequency and damping relative, shapes relative to the largest.
_FREQUENCY_SD = 3e-4
_DAMPING_SD = 0.05
_SHAPE_SD = 0.05
# Maximum number of assignments of identified modes to modes of the model that are fitted, and that are ranked.
_MAX_FITTED_ASSIGNMENTS = 4
_MAX_RANKED_ASSIGNMENTS = 2000


def start(problem: Problem, groups: Sequence[Group]) -> Array:
    """Return unknowns for which the model has the modes of linear groups; the scene's values if none are identified.

    If the test's band contains only some of the modes, the assignment with the smallest residual is used. All groups
    use assignments of the same rank.
    """
    by_group = [(group, _modes(group.curves.frfs, group.curves.scene.structure.bodies)) for group in groups]
    identified = [(group, modes) for group, modes in by_group if modes is not None]
    x = problem.start.copy()
    active = [k for k, parameter in enumerate(problem.parameters) if parameter.place[0] == "structure"]
    if not identified or not active:
        return x
    assignments = [_assignments(problem.scene(x), *each) for each in identified]
    best, smallest = x, np.inf
    for rank in range(min(_MAX_FITTED_ASSIGNMENTS, max(len(ranked) for ranked in assignments))):
        chosen = [ranked[min(rank, len(ranked) - 1)] for ranked in assignments]
        trial = _fit_modes(problem, x, active, identified, chosen)
        cost = float(np.sum(np.minimum(abs(problem.residual(trial, groups, 0.1)), 30.0) ** 2))
        if cost < smallest:
            best, smallest = trial, cost
    return best


@lru_cache(maxsize=16)
def _modes(frfs: tuple[Response, ...], bodies: int) -> Modes | None:
    """Modes of curves, cached because every trial of `diagnosis` identifies the same curves."""
    try:
        return identify(frfs, bodies)
    except (RecordingError, SceneError, np.linalg.LinAlgError):
        return None


def _fit_modes(
    problem: Problem,
    x: Array,
    active: list[int],
    identified: Sequence[tuple[Group, Modes]],
    chosen: Sequence[tuple[int, ...]],
) -> Array:
    """Fit the active unknowns to the identified modes, which are assigned to the `chosen` modes of the model."""

    def residual(inner: Array) -> Array:
        full = x.copy()
        full[active] = inner
        scene = problem.scene(full)
        parts = [(inner - problem.start[active]) / problem.spread[active]]
        for (group, modes), assignment in zip(identified, chosen, strict=True):
            frequency, damping, residue = _model_modes(scene, group)
            at = list(assignment)
            measured = (modes.residue * (-2.0 * 2.0 * np.pi * modes.frequency)).imag
            scale = abs(measured).max(axis=0)
            parts += [
                np.log(frequency[at] / modes.frequency) / _FREQUENCY_SD,
                np.log(np.maximum(damping[at], 1e-9) / modes.damping) / _DAMPING_SD,
                ((residue[:, at] - measured) / scale / _SHAPE_SD).ravel(),
            ]
        return np.concatenate(parts)

    solution = scipy.optimize.least_squares(residual, x[active], max_nfev=60)
    fitted = x.copy()
    fitted[active] = solution.x
    return fitted


def _model_modes(scene: Scene, group: Group) -> tuple[Array, Array, Array]:
    """Frequency [Hz], damping ratio, and modal constants, shape (responses, modes)."""
    bench = on_the_bench(scene, group.curves)
    spring = getattr(bench.driven_shaker, "spring", None)
    model = structural_model(bench).with_bed_masses()
    if spring is not None:
        model = model.with_ground_springs(driven_bodies(bench), spring)
    modes = model.modes
    shapes = modes.shapes / np.sqrt(modes.mass)
    hammer = bench.test is not None and bench.test.kind == "impulse"
    driven = [bench.test.body - 1] if hammer else driven_bodies(bench)  # type: ignore[union-attr]
    force = spring if group.curves.reference == "table" and spring is not None else 1.0
    residue = shapes[list(group.curves.bodies)] * shapes[driven].sum(axis=0) * force
    return np.maximum(modes.frequency, 1e-6), modes.damping_ratio, residue


def _assignments(scene: Scene, group: Group, modes: Modes) -> list[tuple[int, ...]]:
    """List the assignments of the identified modes to modes of the model, in rising order, most likely first."""
    frequency, _, residue = _model_modes(scene, group)
    count = modes.frequency.size
    shapes = mac(residue, modes.shapes)
    ranked = []
    for assignment in islice(combinations(range(frequency.size), count), _MAX_RANKED_ASSIGNMENTS):
        distance = np.log(frequency[list(assignment)] / modes.frequency) / 0.1
        dissimilarity = 1.0 - shapes[list(assignment), range(count)]
        ranked.append((float(np.sum(distance**2 + 4.0 * dissimilarity)), assignment))
    return [assignment for _, assignment in sorted(ranked)]
