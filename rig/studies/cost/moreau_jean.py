"""Compiled time stepping of Moreau and Jean, an alternative to the engine in `rig cost`.

It needs no event detection: in each step, contact acts as an impulse that corrects the velocities.

M. Jean, The non-smooth contact dynamics method, Comput. Methods Appl. Mech. Engrg. 177 (1999) 235-257.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.laws.law import GAP
from rig.core.numerics.jit import cached_njit
from rig.studies.cost.first_order_form import EVENT_KINDS, FLIGHT, SAMPLES_PER_PERIOD, ComputedMotion, FirstOrderForm

#: Maximum number of Gauss-Seidel iterations over the contacts in a step.
MAX_CONTACT_ITERATIONS = 50


class Step(NamedTuple):
    """A step of the theta method with theta = 1/2, on the state z of `FirstOrderForm` without cosine and sine."""

    transition: Array  # z at the end of a step without drive and contact, from z at its start; (size, size)
    cosine: Array  # response of z to the sum of the drive's cosine at both ends of the step, (size,)
    sine: Array  # response of z to the sum of the drive's sine at both ends of the step, (size,)
    impulse_response: Array  # change of z by a unit impulse between damper and body, (size, dampers)
    gap: Array  # row vectors whose product with z is the height above the floor, (dampers, size)
    gap_rate: Array  # row vectors for the rate of this height
    clearance: Array  # m, (dampers,)
    restitution: Array  # (dampers,)
    omega: float  # angular frequency of the drive [rad/s]
    length: float  # duration of the step [s]


def moreau_jean(problem: FirstOrderForm, steps: int) -> ComputedMotion:
    """Compute the motion with `steps` steps per period.

    Raises `RunError` if the scheme is unstable.
    """
    system, size, dampers = problem.system, problem.constant_index + 1, problem.system.dampers
    length = 1.0 / (problem.tone.frequency * steps)
    flight_matrix = problem.matrix([FLIGHT] * dampers)
    matrix, drive_columns = flight_matrix[:size, :size], flight_matrix[:size, size : size + 2]
    inverse = np.linalg.inv(np.eye(size) - 0.5 * length * matrix)
    gap, unit_impulse = np.zeros((dampers, size)), np.zeros((size, dampers))
    for j, coordinate in enumerate(problem.body):
        gap[j] = problem.row(j, GAP)[:size]
        unit_impulse[system.coordinates + coordinate, j] = -problem.inverse_mass[j]
        unit_impulse[problem.first_height + dampers + j, j] = 1.0 / system.damper_mass[j]
    cosine, sine = np.ascontiguousarray((inverse @ drive_columns * 0.5 * length).T)
    samples, walls = _integrate(
        Step(
            inverse @ (np.eye(size) + 0.5 * length * matrix),
            cosine,
            sine,
            inverse @ unit_impulse,
            gap,
            gap @ matrix,
            np.asarray(system.clearance, dtype=np.float64),
            np.asarray(system.restitution, dtype=np.float64),
            problem.omega,
            length,
        ),
        np.array(problem.start[:size]),
        problem.periods * steps,
        steps // SAMPLES_PER_PERIOD,
    )
    if not np.isfinite(samples).all():
        raise RunError(f"unstable with {steps} steps per period; more steps make it stable")
    events = [
        ((k + 1) * length, j, EVENT_KINDS[kind])
        for j in range(dampers)
        for k in np.flatnonzero(np.diff(walls[:, j])).tolist()
        for kind in ([FLIGHT] if walls[k, j] else []) + ([walls[k + 1, j]] if walls[k + 1, j] else [])
    ]
    events.sort(key=lambda event: event[0])
    return ComputedMotion(np.ascontiguousarray(samples[:, : system.coordinates].T), events)


@cached_njit
def _integrate(step: Step, start: Array, steps: int, steps_per_sample: int) -> tuple[Array, NDArray[np.int8]]:
    """Integrate; return the state after every `steps_per_sample` steps, and the wall of each damper after each step."""
    transition, cosine, sine, impulse_response, gap, gap_rate, clearance, restitution, omega, length = step
    size, dampers = start.shape[0], gap.shape[0]
    samples = np.zeros((steps // steps_per_sample + 1, size))
    walls = np.zeros((steps + 1, dampers), dtype=np.int8)
    z, z_free = start.copy(), np.zeros(size)
    wall_direction, impulse = np.zeros(dampers), np.zeros(dampers)
    velocity_before, free_velocity = np.zeros(dampers), np.zeros(dampers)
    # Delassus matrix: change of each gap rate by a unit impulse on each damper.
    delassus = gap_rate @ impulse_response
    samples[0] = z
    walls[0] = 1
    for k in range(steps):
        cosine_sum = np.cos(omega * k * length) + np.cos(omega * (k + 1) * length)
        sine_sum = np.sin(omega * k * length) + np.sin(omega * (k + 1) * length)
        for i in range(size):
            value = cosine[i] * cosine_sum + sine[i] * sine_sum
            for col in range(size):
                value += transition[i, col] * z[col]
            z_free[i] = value
        for j in range(dampers):
            height = 0.0
            velocity_before[j] = 0.0
            free_velocity[j] = 0.0
            for i in range(size):
                height += gap[j, i] * z[i]
                velocity_before[j] += gap_rate[j, i] * z[i]
                free_velocity[j] += gap_rate[j, i] * z_free[i]
            # Contact is active if the height at the middle of the step is beyond a wall.
            predicted_height = height + 0.5 * length * velocity_before[j]
            wall_direction[j] = 1.0 if predicted_height <= 0.0 else (-1.0 if predicted_height >= clearance[j] else 0.0)
            impulse[j] = 0.0
        for _ in range(MAX_CONTACT_ITERATIONS):
            change = 0.0
            for j in range(dampers):
                if wall_direction[j] == 0.0:
                    continue
                excess_velocity = free_velocity[j] + restitution[j] * velocity_before[j]
                for other in range(dampers):
                    excess_velocity += delassus[j, other] * impulse[other]
                candidate = impulse[j] - excess_velocity / delassus[j, j]
                new_impulse = wall_direction[j] * max(0.0, wall_direction[j] * candidate)
                change = max(change, abs(new_impulse - impulse[j]))
                impulse[j] = new_impulse
            if change == 0.0:
                break
        for i in range(size):
            value = z_free[i]
            for j in range(dampers):
                value += impulse_response[i, j] * impulse[j]
            z[i] = value
        for j in range(dampers):
            walls[k + 1, j] = 0 if impulse[j] == 0.0 else (1 if impulse[j] > 0.0 else 2)
        if (k + 1) % steps_per_sample == 0:
            samples[(k + 1) // steps_per_sample] = z
    return samples, walls
