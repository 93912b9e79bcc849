"""Motion with finite-duration contact to 40 digits, independent of the engine: Taylor series of a switched system.

A switched system is linear between contact events, with other matrices after each.

It shares only the matrices of the scene with the engine. The coordinates are absolute heights, and the springs and
dashpots of the walls are computed independently. A contact is closed while overlap and wall force are both positive,
which is checked at several times of every short step. The drive is F sin(w t) on some bodies, or zero. The contact of a
damper is FREE, FLOOR or CEILING. A bed is the mass of a damper.
"""

import decimal
import itertools
from decimal import Decimal

import mpmath
import numpy as np

import rig
from rig.core.scene.damper import TimedContact, Walls
from rig.core.system.structural_model import structural_model, structure_matrices

DIGITS = 40
#: The terms of a Taylor series that are smaller than this are omitted.
MAX_OMITTED_TERM = Decimal(10) ** -45
#: The product of the largest eigenvalue and the step is at most this.
MAX_RATE_TIMES_STEP = 1.0
#: Number of times in a step at which contacts are checked.
CHECKS_PER_STEP = 8
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
FREE, FLOOR, CEILING = 0, 1, 2


def spring_damper(wall, restitution: float, reduced_mass: mpmath.mpf) -> tuple[Decimal, Decimal]:
    """Return stiffness [N/m] and damping [N s/m] of a wall.

    `wall`: either both directly, or the contact duration, after which the force is zero. At restitution 0 the time
    constant damping / stiffness is 5 ms, and the damping is at least critical. `reduced_mass`: reduced mass of damper
    and body, kg.
    """
    with mpmath.workdps(DIGITS):
        if not isinstance(wall, TimedContact):
            return Decimal(wall.stiffness), Decimal(wall.damping)
        duration = mpmath.mpf(wall.duration)

        def scaled_duration(ratio):
            """Return the contact duration times the undamped angular frequency, for a damping ratio."""
            root = mpmath.sqrt(mpmath.mpc(ratio * ratio - 1))
            return mpmath.re(mpmath.log((ratio + root) / (ratio - root)) / root)

        if restitution > 0:
            target = -mpmath.log(mpmath.mpf(restitution))
            ratio = mpmath.findroot(
                lambda z: z * scaled_duration(z) - target, (mpmath.mpf("1e-6"), 40), solver="anderson"
            )
        elif wall.duration >= 5e-3:
            ratio = mpmath.mpf(1) + mpmath.mpf("1e-30")
        else:
            target = mpmath.mpf(5e-3) / duration
            ratio = mpmath.findroot(
                lambda z: 2 * z / scaled_duration(z) - target, (mpmath.mpf("1.01"), 80), solver="anderson"
            )
        omega = scaled_duration(ratio) / duration
        stiffness, damping = reduced_mass * omega**2, 2 * ratio * omega * reduced_mass
        return Decimal(mpmath.nstr(stiffness, DIGITS)), Decimal(mpmath.nstr(damping, DIGITS))


class SwitchedMotion:
    """Motion of a scene whose dampers all have finite-duration contact."""

    def __init__(self, scene: rig.Scene) -> None:
        self.context = decimal.Context(prec=DIGITS)
        mass, damping, stiffness = (
            [[Decimal(float(v)) for v in row] for row in matrix] for matrix in structure_matrices(scene.structure)
        )
        self.bodies = len(mass)
        self.bed_body = [int(b) for b in structural_model(scene).bed_body]
        self.beds = [Decimal(float(m)) for m in structural_model(scene).bed_mass]
        self.gravity = Decimal(scene.gravity)
        self.clearance = [Decimal(d.clearance) if np.isfinite(d.clearance) else None for d in scene.dampers]
        self.walls = []
        for damper, body, bed in zip(scene.dampers, self.bed_body, self.beds, strict=True):
            contact = damper.contact
            walls = (contact.floor, contact.ceiling) if isinstance(contact, Walls) else (contact, contact)
            reduced_mass = 1 / (1 / mpmath.mpf(float(bed)) + 1 / mpmath.mpf(float(mass[body][body])))
            self.walls.append([spring_damper(wall, damper.restitution, reduced_mass) for wall in walls])
        self.mass, self.damping, self.stiffness = mass, damping, stiffness
        has_drive = scene.shaker is not None
        self.frequency = Decimal(scene.test.frequency) if has_drive else Decimal(0)
        self.force = {body - 1: Decimal(scene.test.force) for body in scene.shaker.bodies} if has_drive else {}
        with decimal.localcontext(self.context):
            self.omega = 2 * PI * self.frequency
        self.generators: dict[tuple[int, ...], tuple[list, float]] = {}

    def generator(self, contacts: tuple[int, ...]):
        """Return the system matrix as rows of (column, value), and the magnitude of its largest eigenvalue, 1/s.

        The state is (x, y, x', y', cos, sin, 1), with the heights x of the bodies and y of the beds.
        """
        if contacts not in self.generators:
            n, nd = self.bodies, len(self.beds)
            coordinates, size = n + nd, 2 * (n + nd) + 3
            rows = [dict.fromkeys(range(size), Decimal(0)) for _ in range(size)]
            for i in range(coordinates):
                rows[i][coordinates + i] = Decimal(1)
            for i in range(n):
                body_mass = self.mass[i][i]
                for k in range(n):
                    rows[coordinates + i][k] -= self.stiffness[i][k] / body_mass
                    rows[coordinates + i][coordinates + k] -= self.damping[i][k] / body_mass
                rows[coordinates + i][2 * coordinates + 1] += self.force.get(i, Decimal(0)) / body_mass
            for j, contact in enumerate(contacts):
                bed, body = n + j, self.bed_body[j]
                rows[coordinates + bed][size - 1] -= self.gravity
                if contact == FREE:
                    continue
                k, c = self.walls[j][contact - 1]
                height = self.clearance[j] if contact == CEILING else Decimal(0)
                for row, factor in ((bed, -1 / self.beds[j]), (body, 1 / self.mass[body][body])):
                    for column, value in ((bed, k), (body, -k), (coordinates + bed, c), (coordinates + body, -c)):
                        rows[coordinates + row][column] += factor * value
                    rows[coordinates + row][size - 1] -= factor * k * height
            rows[2 * coordinates][2 * coordinates + 1] = -self.omega
            rows[2 * coordinates + 1][2 * coordinates] = self.omega
            dense = np.array([[float(row[k]) for k in range(size)] for row in rows])
            max_rate = float(np.abs(np.linalg.eigvals(dense)).max())
            self.generators[contacts] = [[(k, v) for k, v in row.items() if v] for row in rows], max_rate
        return self.generators[contacts]

    def series(self, contacts: tuple[int, ...], state: list[Decimal], step: Decimal) -> list[list[Decimal]]:
        """Return the terms of the Taylor series of the state over a step [s], (terms, states)."""
        rows, _ = self.generator(contacts)
        terms = [state]
        while max(map(abs, terms[-1][:-3])) > MAX_OMITTED_TERM or len(terms) < 4:
            factor = step / len(terms)
            last = terms[-1]
            terms.append([factor * sum((v * last[k] for k, v in row), Decimal(0)) for row in rows])
        return terms

    def contact_measure(self, j: int, wall: int, gap: Decimal, rate: Decimal) -> Decimal:
        """Return a force, N, that is positive exactly while damper j is in contact with a wall.

        `gap`: height above the floor, m; `rate`: its derivative, m/s.
        """
        k, c = self.walls[j][wall - 1]
        overlap, closing = (-gap, -rate) if wall == FLOOR else (gap - self.clearance[j], rate)
        return min(k * overlap, k * overlap + c * closing)

    def contact_change(self, j: int, contact: int, gap: Decimal, rate: Decimal) -> int | None:
        """Return the contact to which a damper changes; None without a change."""
        if contact != FREE:
            return FREE if self.contact_measure(j, contact, gap, rate) < 0 else None
        for wall in (FLOOR, CEILING):
            if (wall == FLOOR or self.clearance[j] is not None) and self.contact_measure(j, wall, gap, rate) > 0:
                return wall
        return None

    def propagate(self, start, samples: int, samples_per_period: int, step: Decimal | None = None):
        """Return displacements of the bodies (bodies, samples) and events (time, damper from 0, new contact).

        `start`: initial state (x, y, x', y'); `step`: sample interval, s, instead of `samples_per_period`.
        """
        with decimal.localcontext(self.context):
            return self._propagate(start, samples, samples_per_period, step)

    def _propagate(self, start, samples, samples_per_period, step):
        n, nd = self.bodies, len(self.beds)
        coordinates = n + nd
        state = [Decimal(float(v)) for v in start] + [Decimal(1), Decimal(0), Decimal(1)]
        contacts, now = (FLOOR,) * nd, Decimal(0)
        step = step or 1 / (samples_per_period * self.frequency)
        displacements, events = [], []
        for sample in range(samples):
            target = sample * step
            while now < target:
                max_rate = max(self.generator(contacts)[1], 1.0)
                length = min(target - now, Decimal(MAX_RATE_TIMES_STEP / max_rate))
                terms = self.series(contacts, state, length)
                # Series of gap and opening speed of each damper.
                gaps = [
                    [
                        [term[n + j + offset] - term[self.bed_body[j] + offset] for term in terms]
                        for offset in (0, coordinates)
                    ]
                    for j in range(nd)
                ]
                change = self._first_change(contacts, gaps)
                if change is None:
                    state = [sum(column, Decimal(0)) for column in zip(*terms, strict=True)]
                    now = target if length == target - now else now + length
                    continue
                fraction, j, contact = change
                powers = [fraction**k for k in range(len(terms))]
                state = [
                    sum((term * power for term, power in zip(column, powers, strict=True)), Decimal(0))
                    for column in zip(*terms, strict=True)
                ]
                now += fraction * length
                contacts = (*contacts[:j], contact, *contacts[j + 1 :])
                events.append((now, j, contact))
            displacements.append(state[:n])
        return np.array(displacements, dtype=object).T, events

    def _first_change(self, contacts, gaps):
        """Return the first change of a contact in a step: (fraction of the step, damper, new contact), or None."""
        first = None
        for check, (j, contact) in itertools.product(range(1, CHECKS_PER_STEP + 1), enumerate(contacts)):
            if first is not None and check > first[0] * CHECKS_PER_STEP + 1:
                break
            right = Decimal(check) / CHECKS_PER_STEP
            new_contact = self.contact_change(j, contact, *(_value(series, right) for series in gaps[j]))
            if new_contact is None or (first is not None and j == first[1]):
                continue
            left = right - Decimal(1) / CHECKS_PER_STEP
            for _ in range(140):
                middle = (left + right) / 2
                if self.contact_change(j, contact, *(_value(series, middle) for series in gaps[j])) is None:
                    left = middle
                else:
                    right = middle
            if first is None or right < first[0]:
                first = (right, j, new_contact)
        return first


def _value(series: list[Decimal], tau: Decimal) -> Decimal:
    """Return the value of a series at a fraction of its step."""
    value = Decimal(0)
    for term in reversed(series):
        value = value * tau + term
    return value
