"""A periodic motion to forty digits: what the error of every way to the steady state is measured against.

Shooting gives the orbit to rounding. Here its start is improved by Newton's iteration in decimal arithmetic, each
event found again as the root of its own guard, until the motion meets its start in all digits; its first harmonic
is integrated by Gauss and Legendre's rule between events.
"""

from __future__ import annotations

import decimal
from dataclasses import dataclass
from decimal import Decimal
from functools import cache

import numpy as np
from numpy.typing import NDArray

from rig.errors import RunError
from rig.orbits.orbit import Orbit
from rig.orbits.orbit_equations import FORCELESS, ON_CEILING, RIDES_CEILING
from rig.scene.scene import Scene
from rig.scene.shaker import ForceShaker
from rig.system.assembly import assemble, spring_force_row
from rig.system.open_loop_drive import level_of, tone_drive
from rig.work_precision.high_precision import CHECK_DIGITS, DIGITS, DecimalMotion, Vector

#: Nodes of the rule in stretches of at most so many times the quickest rate.
NODES, STRETCH = 24, Decimal(3)
#: Steps of the difference quotients; every iteration gains so many digits.
STEP = Decimal("1e-14")
ITERATIONS = 4

Flight = dict[int, tuple[Decimal, Decimal]]


@dataclass(frozen=True)
class ExactOrbit:
    """A steady response known far beyond float64."""

    real: NDArray[np.object_]
    imag: NDArray[np.object_]
    """Compliance, m/N; Decimal, shape (bodies,)."""
    residual: float
    """By how much the motion misses its start, relative to the motion."""
    agreement: float
    """Difference to the compliance computed with fewer digits, relative."""

    def miss(self, compliance: NDArray[np.complex128]) -> float:
        """Largest error of a compliance, relative to the largest of all bodies."""
        # Decimals less doubles: the subtraction must not round the reference.
        exact = np.vectorize(Decimal, otypes=[object])
        off = np.hypot(
            (exact(compliance.real) - self.real).astype(float),
            (exact(compliance.imag) - self.imag).astype(float),
        )
        return float(off.max() / np.hypot(self.real.astype(float), self.imag.astype(float)).max())


def exact_orbit(scene: Scene, orbit: Orbit) -> ExactOrbit:
    """Improve a periodic orbit to forty digits.

    Parameters
    ----------
    scene : Scene
        With the force itself on its body where the test holds a force
        (`rig.system.open_loop_drive.with_ideal_force`).

    Raises
    ------
    RunError
        If Newton's iteration does not settle in decimal arithmetic.
    """
    coarse = _Polish(scene, orbit, CHECK_DIGITS)
    start, _ = coarse.solve(coarse.start())
    fine = _Polish(scene, orbit, DIGITS)
    better, residual = fine.solve(start)
    rough, exact = coarse.compliance(start), fine.compliance(better)
    size = max(abs(complex(re, im)) for re, im in exact)
    off = max(
        abs(complex(re - other, im - another))
        for (re, im), (other, another) in zip(exact, rough, strict=True)
    )
    real, imag = (np.array(part, dtype=object) for part in zip(*exact, strict=True))
    return ExactOrbit(real, imag, residual, off / size)


class _Polish:
    """One orbit in decimal arithmetic of so many digits."""

    def __init__(self, scene: Scene, orbit: Orbit, digits: int) -> None:
        self.scene, self.orbit, self.system = scene, orbit, assemble(scene)
        tone = tone_drive(scene, self.system, orbit.frequency)
        assert tone is not None
        self.motion = DecimalMotion(self.system, tone, digits)
        self.context = self.motion.context
        number = {int(k): j for j, k in enumerate(self.system.damper_number)}
        self.events = [(float(e["time"]), number[int(e["damper"])], str(e["kind"])) for e in orbit.events]
        begin = orbit.plan.sequence.wall[0]
        self.flying = orbit.plan.flying.tolist()
        self.released = np.flatnonzero(begin == FORCELESS).tolist()
        self.walls = ["ceiling" if wall in (RIDES_CEILING, ON_CEILING) else "floor" for wall in begin]
        with decimal.localcontext(self.context):
            self.end = Decimal(orbit.repetition) / Decimal(orbit.frequency)
        riding = [j not in self.flying for j in range(self.system.dampers)]
        self.rebounds = self.motion.rebounds(self.events, riding)

    def start(self) -> Vector:
        """Unknowns as shooting found them: states, then height and speed of each damper in flight."""
        unknowns = self.orbit.unknowns[: self.system.states + 2 * len(self.flying)]
        return [Decimal(float(value)) for value in unknowns]

    def solve(self, start: Vector) -> tuple[Vector, float]:
        """Newton's iteration from a start nearby; the residual is relative to the motion."""
        with decimal.localcontext(self.context):
            scale = [max(abs(value), max(map(abs, start)) * Decimal("1e-6")) for value in start]
            jacobian: list[Vector] | None = None
            left = np.inf
            for _ in range(ITERATIONS):
                miss = self._miss(start)
                now = max(float(abs(off) / size) for off, size in zip(miss, scale, strict=True))
                # The last digits of the precision are rounding.
                if now < 10.0 ** (5 - self.context.prec) or now > 0.1 * left:
                    left = min(now, left)
                    break
                left = now
                if jacobian is None:
                    jacobian = self._jacobian(start, scale, miss)
                start = [value - step for value, step in zip(start, _solve(jacobian, miss), strict=True)]
            if left > 10.0 ** (12 - self.context.prec):
                raise RunError(f"the orbit in decimal arithmetic still misses its start by {left:.0e}")
            return start, left

    def _jacobian(self, start: Vector, scale: Vector, miss: Vector) -> list[Vector]:
        columns = []
        for k, size in enumerate(scale):
            moved = list(start)
            moved[k] += STEP * size
            other = self._miss(moved)
            columns.append([(b - a) / (STEP * size) for a, b in zip(miss, other, strict=True)])
        return [list(row) for row in zip(*columns, strict=True)]

    def _miss(self, start: Vector) -> Vector:
        state, flight = self._follow(start, None)
        ends = state[: self.system.states] + [value for j in self.flying for value in flight[j]]
        return [end - begin for end, begin in zip(ends, start, strict=True)]

    def compliance(self, start: Vector) -> list[tuple[Decimal, Decimal]]:
        """First harmonics of the bodies over that of the force, real and imaginary part."""
        with decimal.localcontext(self.context):
            sums = [[Decimal(0)] * self.system.states for _ in range(2)]
            self._follow(start, sums)
            harmonic = [(2 * c / self.end, -2 * s / self.end) for c, s in zip(*sums, strict=True)]
            if isinstance(self.scene.driven_shaker, ForceShaker):
                force = Decimal(0), Decimal(-level_of(self.scene))
            else:
                row = [Decimal(float(value)) for value in spring_force_row(self.scene, self.system)]
                force = (
                    sum((k * re for k, (re, _) in zip(row, harmonic, strict=True)), Decimal(0)),
                    sum((k * im for k, (_, im) in zip(row, harmonic, strict=True)), Decimal(0)),
                )
            return [_ratio(value, force) for value in harmonic[: self.scene.structure.bodies]]

    def _follow(self, start: Vector, sums: list[Vector] | None) -> tuple[Vector, Flight]:
        """Follow one repetition; where `sums` are given, add up the integrals of the states times cosine and sine."""
        with decimal.localcontext(self.context):
            motion, n, ns = self.motion, self.system.coordinates, self.system.states
            state = [*start[:ns], Decimal(1), Decimal(0), Decimal(1)]
            flight: Flight = {
                j: (start[ns + 2 * k], start[ns + 2 * k + 1]) for k, j in enumerate(self.flying)
            }
            flight |= dict.fromkeys(self.released, (Decimal(0), Decimal(0)))
            motion.walls = list(self.walls)
            wall, now, last = list(self.walls), Decimal(0), -1.0
            for (guess, j, kind), restitution in zip(self.events, self.rebounds, strict=True):
                before = state, flight, now
                # Separations that an impact brings about have no root of their own.
                if self.system.lasting[j]:
                    state, flight, now = motion.to_change(state, flight, now, Decimal(guess), j, kind)
                elif not (kind == "separation" and guess == last):
                    state, flight, now = motion.to_event(state, flight, now, Decimal(guess), j, kind, wall[j])
                if sums is not None:
                    self._integrate(*before[:2], now - before[2], sums)
                last = guess
                if self.system.lasting[j]:
                    continue
                if kind == "separation":
                    row = motion.row(j)
                    flight[j] = (state[row] + motion.lift(j, wall[j]), state[n + row])
                    continue
                motion.collide(state, flight, j, kind, restitution)
                if j not in flight:
                    wall[j] = kind
            if sums is not None:
                self._integrate(state, flight, self.end - now, sums)
            return motion.carry(state, flight, self.end - now)

    def _integrate(self, state: Vector, flight: Flight, duration: Decimal, sums: list[Vector]) -> None:
        """Add the integrals over a stretch without events."""
        ns = self.system.states
        fastest = Decimal(max(self.system.fastest, float(self.motion.omega)))
        parts = int(duration * fastest / STRETCH) + 1
        length = duration / parts
        for _ in range(parts):
            at = Decimal(0)
            for node, weight in _rule(self.context.prec):
                state, flight = self.motion.carry(state, flight, length * node - at)
                at = length * node
                for total, wave in zip(sums, (state[ns], state[ns + 1]), strict=True):
                    factor = weight * length * wave
                    for k in range(ns):
                        total[k] += factor * state[k]
            state, flight = self.motion.carry(state, flight, length - at)


@cache
def _rule(digits: int) -> tuple[tuple[Decimal, Decimal], ...]:
    """Nodes and weights of Gauss and Legendre's rule on (0, 1), in order."""
    with decimal.localcontext(decimal.Context(prec=digits)):
        rule = []
        for guess in np.polynomial.legendre.leggauss(NODES)[0]:
            x = Decimal(float(guess))
            for _ in range(4):
                value, slope = _legendre(x)
                x -= value / slope
            _, slope = _legendre(x)
            rule.append(((1 + x) / 2, 1 / ((1 - x * x) * slope * slope)))
        return tuple(rule)


def _legendre(x: Decimal) -> tuple[Decimal, Decimal]:
    """Value and slope of Legendre's polynomial of degree `NODES`."""
    before, value = Decimal(1), x
    for k in range(2, NODES + 1):
        before, value = value, ((2 * k - 1) * x * value - (k - 1) * before) / k
    return value, NODES * (x * value - before) / (x * x - 1)


def _ratio(above: tuple[Decimal, Decimal], below: tuple[Decimal, Decimal]) -> tuple[Decimal, Decimal]:
    (a, b), (c, d) = above, below
    size = c * c + d * d
    return (a * c + b * d) / size, (b * c - a * d) / size


def _solve(matrix: list[Vector], right: Vector) -> Vector:
    """Gaussian elimination with partial pivoting."""
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    count = len(rows)
    for i in range(count):
        pivot = max(range(i, count), key=lambda r: abs(rows[r][i]))
        rows[i], rows[pivot] = rows[pivot], rows[i]
        for r in range(i + 1, count):
            factor = rows[r][i] / rows[i][i]
            rows[r] = [a - factor * b for a, b in zip(rows[r], rows[i], strict=True)]
    found = [Decimal(0)] * count
    for i in reversed(range(count)):
        rest = sum((rows[i][k] * found[k] for k in range(i + 1, count)), Decimal(0))
        found[i] = (rows[i][count] - rest) / rows[i][i]
    return found
