"""Finite-duration contact to 40 digits, independent of the engine: Taylor series of a switched linear system.

It shares only the scene's matrices with the engine: coordinates are absolute heights, the walls' springs and dashpots
are solved for anew, and a contact is closed exactly while the overlap and the wall's push are both positive, looked
for at many places of every short step. Driven by F sin(w t) on one body, or free.
"""

from __future__ import annotations

import decimal
import itertools
from decimal import Decimal

import mpmath
import numpy as np

import rig
from rig.scene.damper import Landing, Walls
from rig.system.structural_model import structural_model, structure_matrices

DIGITS = 40
SMALLEST = Decimal(10) ** -45
#: Rate times step, and number of times that are checked in a step.
REACH, PLACES = 1.0, 8
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
FREE, FLOOR, CEILING = 0, 1, 2


def spring_damper(wall, restitution: float, reduced: mpmath.mpf) -> tuple[Decimal, Decimal]:
    """Stiffness and damping of a wall, by integrating its definition: the force is zero again after the duration."""
    with mpmath.workdps(DIGITS):
        if not isinstance(wall, Landing):
            return Decimal(wall.stiffness), Decimal(wall.damping)
        lasts = mpmath.mpf(wall.duration)

        def span(ratio):
            """Duration times the undamped rate of a landing: the roots of the overdamped form are the damped one's."""
            root = mpmath.sqrt(mpmath.mpc(ratio * ratio - 1))
            return mpmath.re(mpmath.log((ratio + root) / (ratio - root)) / root)

        if restitution > 0:
            wanted = -mpmath.log(mpmath.mpf(restitution))
            ratio = mpmath.findroot(
                lambda z: z * span(z) - wanted, (mpmath.mpf("1e-6"), 40), solver="anderson"
            )
        elif wall.duration >= 5e-3:
            ratio = mpmath.mpf(1) + mpmath.mpf("1e-30")
        else:
            recovery = mpmath.mpf(5e-3) / lasts
            ratio = mpmath.findroot(
                lambda z: 2 * z / span(z) - recovery, (mpmath.mpf("1.01"), 80), solver="anderson"
            )
        rate = span(ratio) / lasts
        return tuple(Decimal(mpmath.nstr(v, DIGITS)) for v in (reduced * rate**2, 2 * ratio * rate * reduced))


class SwitchedMotion:
    """Motion of a scene whose dampers all have finite-duration contact."""

    def __init__(self, scene: rig.Scene) -> None:
        self.context = decimal.Context(prec=DIGITS)
        mass, damping, stiffness = (
            [[Decimal(float(v)) for v in row] for row in part] for part in structure_matrices(scene.structure)
        )
        self.bodies = len(mass)
        self.at = [int(b) for b in structural_model(scene).bed_body]
        self.beds = [Decimal(float(m)) for m in structural_model(scene).bed_mass]
        self.gravity = Decimal(scene.gravity)
        self.clearance = [Decimal(d.clearance) if np.isfinite(d.clearance) else None for d in scene.dampers]
        self.walls = []
        for damper, body, bed in zip(scene.dampers, self.at, self.beds, strict=True):
            contact = damper.contact
            both = (contact.floor, contact.ceiling) if isinstance(contact, Walls) else (contact, contact)
            reduced = 1 / (1 / mpmath.mpf(float(bed)) + 1 / mpmath.mpf(float(mass[body][body])))
            self.walls.append([spring_damper(wall, damper.restitution, reduced) for wall in both])
        self.mass, self.damping, self.stiffness = mass, damping, stiffness
        driven = scene.shaker is not None
        self.frequency = Decimal(scene.test.frequency) if driven else Decimal(0)
        self.force = {b - 1: Decimal(scene.test.force) for b in scene.shaker.bodies} if driven else {}
        with decimal.localcontext(self.context):
            self.omega = 2 * PI * self.frequency
        self.flows: dict[tuple[int, ...], tuple[list, float]] = {}

    def flow(self, modes: tuple[int, ...]):
        """Sparse rows of the generator of (x, y, x', y', cos, sin, 1), and its fastest rate."""
        if modes not in self.flows:
            n, nd = self.bodies, len(self.beds)
            half, size = n + nd, 2 * (n + nd) + 3
            rows = [dict.fromkeys(range(size), Decimal(0)) for _ in range(size)]
            for i in range(half):
                rows[i][half + i] = Decimal(1)
            for i in range(n):
                own = self.mass[i][i]
                for k in range(n):
                    rows[half + i][k] -= self.stiffness[i][k] / own
                    rows[half + i][half + k] -= self.damping[i][k] / own
                rows[half + i][2 * half + 1] += self.force.get(i, Decimal(0)) / own
            for j, mode in enumerate(modes):
                bed, body = n + j, self.at[j]
                rows[half + bed][size - 1] -= self.gravity
                if mode == FREE:
                    continue
                k, c = self.walls[j][mode - 1]
                height = self.clearance[j] if mode == CEILING else Decimal(0)
                for row, factor in ((bed, -1 / self.beds[j]), (body, 1 / self.mass[body][body])):
                    for column, value in ((bed, k), (body, -k), (half + bed, c), (half + body, -c)):
                        rows[half + row][column] += factor * value
                    rows[half + row][size - 1] -= factor * k * height
            rows[2 * half][2 * half + 1] = -self.omega
            rows[2 * half + 1][2 * half] = self.omega
            dense = np.array([[float(row[k]) for k in range(size)] for row in rows])
            fastest = float(np.abs(np.linalg.eigvals(dense)).max())
            self.flows[modes] = [[(k, v) for k, v in row.items() if v] for row in rows], fastest
        return self.flows[modes]

    def series(self, modes: tuple[int, ...], state: list[Decimal], step: Decimal) -> list[list[Decimal]]:
        """Taylor terms of the state over a step."""
        rows, _ = self.flow(modes)
        terms = [state]
        while max(map(abs, terms[-1][:-3])) > SMALLEST or len(terms) < 4:
            part = step / len(terms)
            last = terms[-1]
            terms.append([part * sum((v * last[k] for k, v in row), Decimal(0)) for row in rows])
        return terms

    def push(self, j: int, wall: int, gap: Decimal, rate: Decimal) -> Decimal:
        """Positive exactly while a contact is closed."""
        k, c = self.walls[j][wall - 1]
        overlap, closing = (-gap, -rate) if wall == FLOOR else (gap - self.clearance[j], rate)
        return min(k * overlap, k * overlap + c * closing)

    def off(self, j: int, mode: int, gap: Decimal, rate: Decimal) -> int | None:
        """Mode that a damper should be in instead of the one that it is in; None if it is right."""
        if mode != FREE:
            return FREE if self.push(j, mode, gap, rate) < 0 else None
        for wall in (FLOOR, CEILING):
            if (wall == FLOOR or self.clearance[j] is not None) and self.push(j, wall, gap, rate) > 0:
                return wall
        return None

    def follow(self, start, samples: int, per_period: int, step: Decimal | None = None):
        """Displacements of the bodies (bodies, samples) and events (time, damper, mode after).

        `start` holds the initial state (x, y, x', y').
        """
        with decimal.localcontext(self.context):
            return self._follow(start, samples, per_period, step)

    def _follow(self, start, samples, per_period, step):
        n, nd = self.bodies, len(self.beds)
        half = n + nd
        state = [Decimal(float(v)) for v in start] + [Decimal(1), Decimal(0), Decimal(1)]
        modes, now = (FLOOR,) * nd, Decimal(0)
        step = step or 1 / (per_period * self.frequency)
        out, events = [], []
        for sample in range(samples):
            target = sample * step
            while now < target:
                fastest = max(self.flow(modes)[1], 1.0)
                length = min(target - now, Decimal(REACH / fastest))
                terms = self.series(modes, state, length)
                paths = [
                    [[t[n + j + o] - t[self.at[j] + o] for t in terms] for o in (0, half)] for j in range(nd)
                ]
                found = self._first(modes, paths)
                if found is None:
                    state = [sum(column, Decimal(0)) for column in zip(*terms, strict=True)]
                    now = target if length == target - now else now + length
                    continue
                part, j, mode = found
                powers = [part**k for k in range(len(terms))]
                state = [
                    sum((t * p for t, p in zip(column, powers, strict=True)), Decimal(0))
                    for column in zip(*terms, strict=True)
                ]
                now += part * length
                modes = (*modes[:j], mode, *modes[j + 1 :])
                events.append((now, j, mode))
            out.append(state[:n])
        return np.array(out, dtype=object).T, events

    def _first(self, modes, paths):
        """First change of a contact in a step: (part of the step, damper, mode after), or None."""
        first = None
        for place, (j, mode) in itertools.product(range(1, PLACES + 1), enumerate(modes)):
            if first is not None and place > first[0] * PLACES + 1:
                break
            right = Decimal(place) / PLACES
            after = self.off(j, mode, *(_value(path, right) for path in paths[j]))
            if after is None or (first is not None and j == first[1]):
                continue
            left = right - Decimal(1) / PLACES
            for _ in range(140):
                middle = (left + right) / 2
                if self.off(j, mode, *(_value(path, middle) for path in paths[j])) is None:
                    left = middle
                else:
                    right = middle
            if first is None or right < first[0]:
                first = (right, j, after)
        return first


def _value(series: list[Decimal], at: Decimal) -> Decimal:
    value = Decimal(0)
    for term in reversed(series):
        value = value * at + term
    return value
