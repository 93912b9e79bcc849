"""Starting values of a fit: the model with these values has the modes identified from the linear recordings."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations

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

# Standard deviations of the identified modes as targets: frequency and damping relative, shapes relative to the
# largest.
_FREQUENCY, _DAMPING, _SHAPE = 3e-4, 0.05, 0.05
# Assignments of identified modes to modes of the model: the number tried, most likely first, and the number compared.
_TRIED = 4
_MOST_ASSIGNMENTS = 2000


def start(problem: Problem, groups: Sequence[Group]) -> Array:
    """Return unknowns with which the model has the modes of some linear groups, or those of the scene without modes.

    Where the test's band contains only some of the modes, the assignment with the smallest residual is used.
    """
    shown = [(group, _modes(group.curves.frfs, group.curves.scene.structure.bodies)) for group in groups]
    seen = [(group, modes) for group, modes in shown if modes is not None]
    x = problem.start.copy()
    if not seen:
        return x
    active = [k for k, one in enumerate(problem.parameters) if one.place[0] == "structure"]
    if not active:
        return x
    assignments = [_assignments(problem.scene(x), *each) for each in seen]
    best, smallest = x, np.inf
    for turn in range(min(_TRIED, max(len(ranked) for ranked in assignments))):
        chosen = [ranked[min(turn, len(ranked) - 1)] for ranked in assignments]
        found = _fitted(problem, x, active, seen, chosen)
        cost = float(np.sum(np.minimum(abs(problem.residual(found, groups, 0.1)), 30.0) ** 2))
        if cost < smallest:
            best, smallest = found, cost
    return best


@lru_cache(maxsize=16)
def _modes(frfs: tuple[Response, ...], bodies: int) -> Modes | None:
    """Modes of curves, stored because all hypotheses about a misfit use them."""
    try:
        return identify(frfs, bodies)
    except (RecordingError, SceneError, np.linalg.LinAlgError):
        return None


def _fitted(
    problem: Problem,
    x: Array,
    active: list[int],
    seen: Sequence[tuple[Group, Modes]],
    chosen: Sequence[tuple[int, ...]],
) -> Array:
    def residual(inner: Array) -> Array:
        full = x.copy()
        full[active] = inner
        scene = problem.scene(full)
        parts = [(inner - problem.start[active]) / problem.spread[active]]
        for (group, modes), which in zip(seen, chosen, strict=True):
            frequency, damping, residue = _model_modes(scene, group)
            at = list(which)
            measured = (modes.residue * (-2.0 * 2.0 * np.pi * modes.frequency)).imag
            scale = abs(measured).max(axis=0)
            parts += [
                np.log(frequency[at] / modes.frequency) / _FREQUENCY,
                np.log(np.maximum(damping[at], 1e-9) / modes.damping) / _DAMPING,
                ((residue[:, at] - measured) / scale / _SHAPE).ravel(),
            ]
        return np.concatenate(parts)

    solution = scipy.optimize.least_squares(residual, x[active], x_scale=1.0, max_nfev=60)
    found = x.copy()
    found[active] = solution.x
    return found


def _model_modes(scene: Scene, group: Group) -> tuple[Array, Array, Array]:
    """Frequency [Hz], damping ratio, and 2 omega times the magnitude of the residue, shape (responses, modes)."""
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
    for number, which in enumerate(combinations(range(frequency.size), count)):
        if number == _MOST_ASSIGNMENTS:
            break
        distance = np.log(frequency[list(which)] / modes.frequency) / 0.1
        dissimilarity = 1.0 - shapes[list(which), range(count)]
        ranked.append((float(np.sum(distance**2 + 4.0 * dissimilarity)), which))
    return [which for _, which in sorted(ranked)]
