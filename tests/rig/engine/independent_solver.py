"""Independent simulation of a scene by scipy's DOP853, restarted at each contact event.

It is slow, and as accurate as its tolerances, but shares only the matrices of the scene with the engine. A guard is a
function that becomes negative at an event: a gap in flight, a contact force in contact.
"""

import math
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

import rig
from rig.core.system.structural_model import structural_model, structure_matrices

FLIGHT, FLOOR, CEILING = 0, 1, 2
#: After a separation the gap is at rounding level, so the guard of this wall is ignored for this time, s.
GUARD_DELAY_S = 2e-5


class IndependentSolver:
    """Motion under F sin(w t), from rest at x = 0 with all dampers on their floors."""

    def __init__(self, scene: rig.Scene) -> None:
        self.mass, self.damping, self.stiffness = structure_matrices(scene.structure)
        self.n = len(self.mass)
        model = structural_model(scene)
        self.body, self.damper_mass = model.bed_body, model.bed_mass
        self.clearance = np.array([damper.clearance for damper in scene.dampers])
        self.restitution = np.array([damper.restitution for damper in scene.dampers])
        self.gravity = scene.gravity
        self.omega = 2 * np.pi * scene.test.frequency
        self.force = np.zeros(self.n)
        self.force[[body - 1 for body in scene.shaker.bodies]] = scene.test.force
        self.contact = np.full(len(self.damper_mass), FLOOR)

    def _derivative(self) -> Callable[[float, np.ndarray], np.ndarray]:
        """Return the time derivative of the state with the present contacts, A z + b sin w t + c: see `events`."""
        n, d = self.n, len(self.damper_mass)
        mass = self.mass.copy()
        weight = np.zeros(n)
        in_contact = self.contact != FLIGHT
        mass[self.body[in_contact], self.body[in_contact]] += self.damper_mass[in_contact]
        weight[self.body[in_contact]] = self.damper_mass[in_contact] * self.gravity
        matrix = np.zeros((2 * n + 2 * d, 2 * n + 2 * d))
        matrix[:n, n : 2 * n] = np.eye(n)
        matrix[n : 2 * n, : 2 * n] = -np.linalg.solve(mass, np.hstack([self.stiffness, self.damping]))
        drive, constant = np.zeros(len(matrix)), np.zeros(len(matrix))
        drive[n : 2 * n], constant[n : 2 * n] = np.linalg.solve(mass, self.force), -np.linalg.solve(mass, weight)
        for j, body in enumerate(self.body):
            height, speed = 2 * n + j, 2 * n + d + j
            if self.contact[j] == FLIGHT:
                matrix[height, speed], constant[speed] = 1.0, -self.gravity
            else:
                matrix[height, n + body] = 1.0
                matrix[speed], drive[speed], constant[speed] = matrix[n + body], drive[n + body], constant[n + body]
        return lambda t, state: matrix @ state + drive * math.sin(self.omega * t) + constant

    def _guards(self, ignored_until: dict[tuple[int, int], float]) -> list[tuple[int, int, object]]:
        """Return the guards of all dampers: (damper from 0, contact after the event, function of time and state).

        `ignored_until`: time until which the guard of a damper and wall is ignored, s.
        """
        n, derivative = self.n, self._derivative()
        guards: list[tuple[int, int, object]] = []
        for j, body in enumerate(self.body):
            if self.contact[j] == FLIGHT:
                guards.append(
                    (
                        j,
                        FLOOR,
                        lambda t, s, j=j, b=body: s[2 * n + j] - s[b] if t > ignored_until.get((j, FLOOR), -1) else 1.0,
                    )
                )
                if np.isfinite(self.clearance[j]):
                    guards.append(
                        (
                            j,
                            CEILING,
                            lambda t, s, j=j, b=body: (
                                self.clearance[j] - s[2 * n + j] + s[b]
                                if t > ignored_until.get((j, CEILING), -1)
                                else 1.0
                            ),
                        )
                    )
            else:
                sign = 1.0 if self.contact[j] == FLOOR else -1.0
                guards.append(
                    (j, FLIGHT, lambda t, s, i=n + body, sign=sign: sign * (derivative(t, s)[i] + self.gravity))
                )
        for _, _, guard in guards:
            guard.terminal, guard.direction = True, -1
        return guards

    def events(self, duration: float) -> list[tuple[float, int, str]]:
        """Return the events up to a time: (time, damper from 1, kind)."""
        n, d = self.n, len(self.damper_mass)
        # State: displacements and velocities of the bodies, heights and velocities of the dampers.
        state, t, events = np.zeros(2 * n + 2 * d), 0.0, []
        ignored_until: dict[tuple[int, int], float] = {}
        while t < duration:
            guards = self._guards(ignored_until)
            solution = solve_ivp(
                self._derivative(), (t, duration), state, method="DOP853", rtol=1e-12, atol=1e-15,
                max_step=2 * np.pi / max(self.omega, 300.0) / 20, events=[guard for _, _, guard in guards],
            )  # fmt: skip
            t, state = solution.t[-1], solution.y[:, -1].copy()
            if solution.status != 1:
                break
            for (j, wall, _), crossings in zip(guards, solution.t_events, strict=True):
                if len(crossings):
                    self._apply_event(t, state, j, wall, ignored_until, events)
        return events

    def _apply_event(self, t, state, j, wall, ignored_until, events) -> None:
        """Apply a separation (wall FLIGHT) or an impact of damper j, with the separations that follow.

        Changes the state, the contacts, `ignored_until` and `events`.
        """
        n, d = self.n, len(self.damper_mass)
        body = self.body[j]
        if wall == FLIGHT:
            self._separate(t, state, j, ignored_until)
            events.append((t, j + 1, "separation"))
            return
        closing_speed = state[2 * n + d + j] - state[n + body]
        impulse = (1 + self.restitution[j]) * closing_speed / (1 / self.mass[body, body] + 1 / self.damper_mass[j])
        state[n + body] += impulse / self.mass[body, body]
        events.append((t, j + 1, "floor" if wall == FLOOR else "ceiling"))
        self.contact[j] = wall
        if self.restitution[j] > 0:
            self._separate(t, state, j, ignored_until)
            state[2 * n + d + j] = state[n + body] - self.restitution[j] * closing_speed
        for i in range(d):
            if self.contact[i] != FLIGHT:
                sign = 1.0 if self.contact[i] == FLOOR else -1.0
                if sign * (self._derivative()(t, state)[n + self.body[i]] + self.gravity) < 0:
                    self._separate(t, state, i, ignored_until)
                    events.append((t, i + 1, "separation"))

    def _separate(self, t, state, j, ignored_until) -> None:
        """Let damper j leave its wall with the velocity of the body."""
        n, d = self.n, len(self.damper_mass)
        body, wall = self.body[j], self.contact[j]
        state[2 * n + j] = state[body] + (self.clearance[j] if wall == CEILING else 0.0)
        state[2 * n + d + j] = state[n + body]
        self.contact[j] = FLIGHT
        ignored_until[(j, wall)] = t + GUARD_DELAY_S
