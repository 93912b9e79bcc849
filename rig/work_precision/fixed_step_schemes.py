"""Fixed-step schemes for contact, compiled: penalty with RK4 or Newmark, and Moreau-Jean time stepping."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.errors import RunError
from rig.numerics.jit import stored
from rig.work_precision.first_order_form import (
    CEILING,
    FLIGHT,
    FLOOR,
    PER_PERIOD,
    WALLS,
    Array,
    FirstOrderForm,
    Outcome,
)

#: A penalty's stiffness makes a damper swing on its wall by this phase a step: as stiff as the step can follow.
SWING = 0.3
#: Contacts are iterated at most this often in a step.
ITERATIONS = 50
#: A contact of the penalty schemes is off, on the floor or at the ceiling.
SIDES = (FLIGHT, FLOOR, CEILING)


class Course(NamedTuple):
    """The drive, and the steps in which it is followed."""

    cosine: Array
    sine: Array
    """cosine, sine: what the tone's parts add to the rates; shape (states,)."""
    omega: float
    step: float
    steps: int
    every: int
    """Steps from sample to sample."""
    start: Array


class Cavities(NamedTuple):
    """Where the dampers' walls are."""

    gap: Array
    closing: Array
    """gap, closing: height above the floor and its rate as rows over the state; shape (dampers, states)."""
    clearance: Array


class Springs(NamedTuple):
    """What stands for the walls in a penalty scheme; shape (dampers,)."""

    stiffness: Array
    dashpot: Array


def penalty_runge_kutta(problem: FirstOrderForm, steps: int) -> Outcome:
    """Spring and dashpot at every wall; classical Runge-Kutta of fourth order, `steps` a period."""
    step = _step(problem, steps)
    springs = _penalty(problem, step)
    return _outcome(
        problem,
        step,
        *_runge_kutta(
            problem.flight,
            problem.constant,
            problem.push,
            _course(problem, steps, problem.cosine, problem.sine, _settled(problem, springs)),
            _cavities(problem),
            springs,
        ),
    )


def penalty_newmark(problem: FirstOrderForm, steps: int) -> Outcome:
    """Spring and dashpot at every wall; Newmark's average acceleration, `steps` a period.

    The trapezoidal rule for the whole first-order system is Newmark's rule for its mechanical part; the contacts of
    a step are iterated until they agree with its end.
    """
    step = _step(problem, steps)
    springs = _penalty(problem, step)
    stiffness, dashpot = springs
    size, dampers = problem.size, len(problem.rows)
    sets = list(product(SIDES, repeat=dampers))
    solve, explicit = np.zeros((len(sets), size, size)), np.zeros((len(sets), size, size))
    constant = np.zeros((len(sets), size))
    gap = _gap_rows(problem)
    for k, sides in enumerate(sets):
        matrix, constant[k] = problem.flight.copy(), problem.constant.copy()
        for j, side in enumerate(sides):
            if side == FLIGHT or (side == CEILING and np.isinf(problem.system.clearance[j])):
                continue
            # Force on the damper: -k gap - c closing from the floor, + k (d - gap) - c closing from the ceiling.
            matrix -= np.outer(problem.push[:, j], stiffness[j] * gap[j] + dashpot[j] * problem.closing[j])
            if side == CEILING:
                constant[k] += problem.push[:, j] * stiffness[j] * problem.system.clearance[j]
        solve[k] = np.linalg.inv(np.eye(size) - 0.5 * step * matrix)
        explicit[k] = np.eye(size) + 0.5 * step * matrix
    return _outcome(
        problem,
        step,
        *_newmark(
            solve,
            explicit,
            constant,
            _course(problem, steps, problem.cosine, problem.sine, _settled(problem, springs)),
            _cavities(problem),
            springs,
        ),
    )


def moreau_jean(problem: FirstOrderForm, steps: int) -> Outcome:
    """Time stepping on velocity level with impulses (theta = 1/2), `steps` a period."""
    step = _step(problem, steps)
    solve = np.linalg.inv(np.eye(problem.size) - 0.5 * step * problem.flight)
    advance = solve @ (np.eye(problem.size) + 0.5 * step * problem.flight)
    kicks = solve @ problem.push
    restitution = np.asarray(problem.system.restitution, dtype=np.float64)
    return _outcome(
        problem,
        step,
        *_moreau(
            advance,
            solve @ problem.constant * step,
            kicks,
            problem.closing @ kicks,
            restitution,
            _course(
                problem,
                steps,
                solve @ problem.cosine * 0.5 * step,
                solve @ problem.sine * 0.5 * step,
                problem.start,
            ),
            _cavities(problem),
        ),
    )


def _step(problem: FirstOrderForm, steps: int) -> float:
    return 1.0 / (problem.tone.frequency * steps)


def _course(problem: FirstOrderForm, steps: int, cosine: Array, sine: Array, start: Array) -> Course:
    step = _step(problem, steps)
    return Course(cosine, sine, problem.omega, step, problem.periods * steps, steps // PER_PERIOD, start)


def _cavities(problem: FirstOrderForm) -> Cavities:
    clearance = np.asarray(problem.system.clearance, dtype=np.float64)
    return Cavities(_gap_rows(problem), problem.closing, clearance)


def _gap_rows(problem: FirstOrderForm) -> Array:
    rows = np.zeros((len(problem.rows), problem.size))
    for j, row in enumerate(problem.rows):
        rows[j, row], rows[j, problem.system.states + j] = -1.0, 1.0
    return rows


def _penalty(problem: FirstOrderForm, step: float) -> Springs:
    """Stiffness that the step can follow, and the dashpot that gives the restitution in a free impact.

    The dashpot acts as long as the wall is dented: were its pull cut off, plastic impacts would rebound by 13 %
    however stiff the wall.
    """
    mass = 1.0 / (problem.inverse_mass + 1.0 / problem.system.damper_mass)
    rate = SWING / step
    restitution = np.asarray(problem.system.restitution, dtype=np.float64)
    logs = np.log(np.maximum(restitution, 1e-300))
    ratio = np.where(restitution > 0.0, -logs / np.hypot(np.pi, logs), 1.0)
    return Springs(mass * rate**2, 2.0 * ratio * mass * rate)


def _settled(problem: FirstOrderForm, springs: Springs) -> Array:
    """Start with every damper sunk into its floor by its weight."""
    start, system = problem.start.copy(), problem.system
    sunk = system.damper_mass * system.gravity / springs.stiffness
    start[system.states : system.states + system.dampers] -= sunk
    return start


def _outcome(problem: FirstOrderForm, step: float, samples: Array, sides: NDArray[np.int8]) -> Outcome:
    """Collect samples, and events from the changes of the contacts between steps."""
    if not np.isfinite(samples).all():
        raise RunError("unstable with this step")
    events: list[tuple[float, int, str]] = []
    for j in range(sides.shape[1]):
        before, after = sides[:-1, j], sides[1:, j]
        for k in np.flatnonzero(before != after):
            if before[k] != FLIGHT:
                events.append(((k + 1) * step, j, WALLS[FLIGHT]))
            if after[k] != FLIGHT:
                events.append(((k + 1) * step, j, WALLS[after[k]]))
    events.sort(key=lambda event: event[0])
    return Outcome(np.ascontiguousarray(samples[:, : problem.system.coordinates].T), events)


@stored
def _forces(z: Array, cavities: Cavities, springs: Springs, out: Array, sides: NDArray[np.int8]) -> None:
    gap, closing, clearance = cavities
    stiffness, dashpot = springs
    for j in range(gap.shape[0]):
        height = 0.0
        speed = 0.0
        for i in range(z.shape[0]):
            height += gap[j, i] * z[i]
            speed += closing[j, i] * z[i]
        out[j] = 0.0
        sides[j] = 0
        if height < 0.0:
            out[j] = -stiffness[j] * height - dashpot[j] * speed
            sides[j] = 1
        elif height > clearance[j]:
            out[j] = stiffness[j] * (clearance[j] - height) - dashpot[j] * speed
            sides[j] = 2


@stored
def _runge_kutta(
    matrix: Array, constant: Array, push: Array, course: Course, cavities: Cavities, springs: Springs
) -> tuple[Array, NDArray[np.int8]]:
    cosine, sine, omega, step, steps, every, start = course
    size, dampers = start.shape[0], cavities.gap.shape[0]
    samples = np.zeros((steps // every + 1, size))
    history = np.zeros((steps + 1, dampers), dtype=np.int8)
    z, stage, total = start.copy(), np.zeros(size), np.zeros(size)
    slope, force, sides = np.zeros(size), np.zeros(dampers), np.zeros(dampers, dtype=np.int8)
    samples[0] = z
    history[0] = 1
    for k in range(steps):
        total[:] = 0.0
        for part in range(4):
            share = 0.0 if part == 0 else (1.0 if part == 3 else 0.5)
            for i in range(size):
                stage[i] = z[i] + share * step * slope[i] if part > 0 else z[i]
            phase = omega * (k + share) * step
            c, s = np.cos(phase), np.sin(phase)
            _forces(stage, cavities, springs, force, sides)
            for i in range(size):
                rate = constant[i] + cosine[i] * c + sine[i] * s
                for col in range(size):
                    rate += matrix[i, col] * stage[col]
                for j in range(dampers):
                    rate += push[i, j] * force[j]
                slope[i] = rate
                total[i] += rate * (1.0 if part == 0 or part == 3 else 2.0)
        for i in range(size):
            z[i] += step / 6.0 * total[i]
        _forces(z, cavities, springs, force, sides)
        history[k + 1] = sides
        if (k + 1) % every == 0:
            samples[(k + 1) // every] = z
    return samples, history


@stored
def _newmark(
    solve: Array, explicit: Array, constant: Array, course: Course, cavities: Cavities, springs: Springs
) -> tuple[Array, NDArray[np.int8]]:
    cosine, sine, omega, step, steps, every, start = course
    size, dampers = start.shape[0], cavities.gap.shape[0]
    samples = np.zeros((steps // every + 1, size))
    history = np.zeros((steps + 1, dampers), dtype=np.int8)
    z, new, right = start.copy(), np.zeros(size), np.zeros(size)
    force, sides = np.zeros(dampers), np.ones(dampers, dtype=np.int8)
    samples[0] = z
    history[0] = 1
    # Base-3 number of the contacts; all ones: every damper on its floor.
    old = (3**dampers - 1) // 2
    chosen = old
    for k in range(steps):
        c = np.cos(omega * k * step) + np.cos(omega * (k + 1) * step)
        s = np.sin(omega * k * step) + np.sin(omega * (k + 1) * step)
        for _ in range(ITERATIONS):
            for i in range(size):
                value = 0.5 * step * (constant[old, i] + constant[chosen, i] + cosine[i] * c + sine[i] * s)
                for col in range(size):
                    value += explicit[old, i, col] * z[col]
                right[i] = value
            for i in range(size):
                value = 0.0
                for col in range(size):
                    value += solve[chosen, i, col] * right[col]
                new[i] = value
            _forces(new, cavities, springs, force, sides)
            found = 0
            for j in range(dampers):
                found = 3 * found + sides[j]
            if found == chosen:
                break
            chosen = found
        z[:] = new
        old = chosen
        history[k + 1] = sides
        if (k + 1) % every == 0:
            samples[(k + 1) // every] = z
    return samples, history


@stored
def _moreau(
    advance: Array, constant: Array, kicks: Array, delassus: Array, restitution: Array, course: Course,
    cavities: Cavities,
) -> tuple[Array, NDArray[np.int8]]:  # fmt: skip
    cosine, sine, omega, step, steps, every, start = course
    gap, closing, clearance = cavities
    size, dampers = start.shape[0], gap.shape[0]
    samples = np.zeros((steps // every + 1, size))
    history = np.zeros((steps + 1, dampers), dtype=np.int8)
    z, new = start.copy(), np.zeros(size)
    wall, before, free, impulse = np.zeros(dampers), np.zeros(dampers), np.zeros(dampers), np.zeros(dampers)
    samples[0] = z
    history[0] = 1
    for k in range(steps):
        c = np.cos(omega * k * step) + np.cos(omega * (k + 1) * step)
        s = np.sin(omega * k * step) + np.sin(omega * (k + 1) * step)
        for i in range(size):
            value = constant[i] + cosine[i] * c + sine[i] * s
            for col in range(size):
                value += advance[i, col] * z[col]
            new[i] = value
        for j in range(dampers):
            height = 0.0
            before[j] = 0.0
            free[j] = 0.0
            for i in range(size):
                height += gap[j, i] * z[i]
                before[j] += closing[j, i] * z[i]
                free[j] += closing[j, i] * new[i]
            ahead = height + 0.5 * step * before[j]
            wall[j] = 1.0 if ahead <= 0.0 else (-1.0 if ahead >= clearance[j] else 0.0)
            impulse[j] = 0.0
        for _ in range(ITERATIONS):
            change = 0.0
            for j in range(dampers):
                if wall[j] == 0.0:
                    continue
                value = free[j] + restitution[j] * before[j]
                for other in range(dampers):
                    value += delassus[j, other] * impulse[other]
                wanted = wall[j] * max(0.0, wall[j] * (impulse[j] - value / delassus[j, j]))
                change = max(change, abs(wanted - impulse[j]))
                impulse[j] = wanted
            if change == 0.0:
                break
        for i in range(size):
            value = new[i]
            for j in range(dampers):
                value += kicks[i, j] * impulse[j]
            z[i] = value
        for j in range(dampers):
            history[k + 1, j] = 0 if impulse[j] == 0.0 else (1 if impulse[j] > 0.0 else 2)
        if (k + 1) % every == 0:
            samples[(k + 1) // every] = z
    return samples, history
