"""The exact motion of a scene between two contact events, to 40 digits, independent of the engine.

It shares only the matrices of the scene with the engine. The state z is augmented: displacements and velocities of the
bodies, cos w t, sin w t, 1. It obeys z' = A z; A is called the generator.
"""

import mpmath
from mpmath import mp, mpf

import rig
from rig.core.system.structural_model import structural_model, structure_matrices

DIGITS = 40
SCALE = 2**200


def matrix_of(array) -> mpmath.matrix:
    return mpmath.matrix([[mpf(float(value)) for value in row] for row in array])


class Segment:
    """Motion under F sin(w t) while the dampers `on_floor` (numbered from 0) are at rest on their floors."""

    def __init__(self, scene: rig.Scene, on_floor: tuple[int, ...]) -> None:
        mp.dps = DIGITS
        mass, damping, stiffness = (matrix_of(part) for part in structure_matrices(scene.structure))
        n = self.n = mass.rows
        self.gravity = mpf(scene.gravity)
        self.omega = mpf(2.0 * 3.141592653589793 * scene.test.frequency) if scene.shaker else mpf(0)
        load = mpmath.matrix(n, 1)
        for j in on_floor:
            body = int(structural_model(scene).damper_body[j])
            damper_mass = mpf(float(structural_model(scene).damper_mass[j]))
            mass[body, body] += damper_mass
            load[body] -= damper_mass * self.gravity
        inverse_mass = mass**-1
        force = mpmath.matrix(n, 1)
        for body in scene.shaker.bodies if scene.shaker else ():
            force[body - 1] = mpf(scene.test.force)
        self.generator = mpmath.zeros(2 * n + 3)
        for i in range(n):
            self.generator[i, n + i] = 1
        for part, column in ((-inverse_mass * stiffness, 0), (-inverse_mass * damping, n)):
            for i in range(n):
                for k in range(n):
                    self.generator[n + i, column + k] = part[i, k]
        drive_acceleration, constant_acceleration = inverse_mass * force, inverse_mass * load
        for i in range(n):
            self.generator[n + i, 2 * n + 1] = drive_acceleration[i]
            self.generator[n + i, 2 * n + 2] = constant_acceleration[i]
        self.generator[2 * n, 2 * n + 1] = -self.omega
        self.generator[2 * n + 1, 2 * n] = self.omega

    def initial_state(self, displacements=None, velocities=None) -> mpmath.matrix:
        """Return the state at t = 0."""
        state = mpmath.zeros(2 * self.n + 3, 1)
        for offset, values in ((0, displacements), (self.n, velocities)):
            for i, value in enumerate(values if values is not None else ()):
                state[offset + i] = mpf(float(value))
        state[2 * self.n] = state[2 * self.n + 2] = 1
        return state

    def propagate(self, state: mpmath.matrix, duration: mpf) -> mpmath.matrix:
        """Return the state after a time, s, by Taylor series over steps that are short enough to lose no digits.

        The series are computed with integers, in units of 1 / SCALE: much faster than with floating point.
        """
        rate = mpmath.sqrt(mpmath.mnorm(self.generator, 1))
        steps = max(1, int(mpmath.ceil(abs(duration) * rate / 4)))
        scaled = self.generator * (duration / steps * SCALE)
        # Nonzero elements of each row with their columns.
        size = scaled.rows
        rows = [[(int(scaled[i, k]), k) for k in range(size) if scaled[i, k]] for i in range(size)]
        values = [int(value * SCALE) for value in state]
        for _ in range(steps):
            term, order = values, 0
            while max(map(abs, term)) > SCALE // 10 ** (DIGITS + 5):
                order += 1
                term = [sum(value * term[k] for value, k in row) // (SCALE * order) for row in rows]
                values = [value + change for value, change in zip(values, term, strict=True)]
        return mpmath.matrix(values) / SCALE

    def acceleration(self, state: mpmath.matrix, body: int) -> mpf:
        """Return the acceleration of a body, numbered from 0."""
        return (self.generator[self.n + body, :] * state)[0]

    def jerk(self, state: mpmath.matrix, body: int) -> mpf:
        """Return the time derivative of the acceleration of a body, numbered from 0."""
        return (self.generator[self.n + body, :] * (self.generator * state))[0]
