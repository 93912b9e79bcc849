"""Motions and periodic orbits to forty digits: the reference for the error of every method.

The order of the events comes from the engine. Each event is located as the root of its guard in decimal arithmetic of
any precision, and the flow between events is a Taylor series. Only the compiled system is shared with the engine. The
difference between two precisions indicates the number of correct digits. Newton's method refines an orbit to all
digits, from the initial state computed by shooting.
"""

from __future__ import annotations

import decimal
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from operator import add, itemgetter, mul
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.errors import RunError
from rig.orbits import event_kinds as kinds
from rig.orbits.orbit import Orbit
from rig.scene.scene import Scene
from rig.scene.shaker import ForceShaker
from rig.simulation.simulate import Run
from rig.system.assembly import assemble, spring_force_row
from rig.system.hybrid_system import HybridSystem
from rig.system.open_loop_drive import ToneDrive, level_of, tone_drive
from rig.work_precision.first_order_form import CEILING, FLIGHT, FLOOR, WALLS, FirstOrderForm, solve

Vector = Any  # Decimals, as a list or an array of objects
#: Time [s], damper (from 0) and kind.
Event = tuple[float, int, str]

PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
#: Digits of the reference: 24 more than float64.
DIGITS = 40
#: Digits of the run that checks the reference.
CHECK_DIGITS = 30
#: Largest product of rate and step for which the Taylor series loses a negligible number of digits.
MAX_RATE_STEP = 3.0
#: Penetration up to which finite-duration contact counts as first touch, m; float64 rounding is 1e-18 m.
MAX_TOUCH_PENETRATION_M = 1e-13
#: Newton iterations for an event; they start within rounding of the engine, so that eight doublings of the digits
#: suffice.
EVENT_ITERATIONS = 8
#: Largest difference between an event's time and the engine's, s.
MAX_EVENT_DIFFERENCE_S = Decimal("1e-9")
#: Relative step of the difference quotients of an orbit; each Newton iteration gains the same number of digits.
ORBIT_STEP_RATIO = Decimal("1e-14")
#: Largest number of Newton iterations for an orbit; two reach forty digits from the sixteen of shooting.
ORBIT_ITERATIONS = 4


@dataclass(frozen=True)
class Exact:
    """A motion with far more digits than float64."""

    displacement: NDArray[np.object_]  # Displacements, m; Decimal, shape (coordinates, samples)
    event_time: NDArray[np.object_]  # Event times, s; Decimal, shape (events,)
    agreement: float
    """Largest difference from the same motion computed with fewer digits, relative to the motion."""


@dataclass(frozen=True)
class ExactOrbit:
    """A steady response with far more digits than float64."""

    real: NDArray[np.object_]
    imag: NDArray[np.object_]  # Compliance, m/N; Decimal, shape (bodies,)
    residual: float  # Difference between start and end of the orbit, relative to the motion
    agreement: float  # Relative difference from the compliance computed with fewer digits

    def error(self, compliance: NDArray[np.complex128]) -> float:
        """Compute the largest error of a compliance, relative to the largest compliance of all bodies."""
        # Subtract in decimal arithmetic, so that the reference is not rounded.
        exact = np.vectorize(Decimal, otypes=[object])
        deviation = np.hypot(
            (exact(compliance.real) - self.real).astype(float), (exact(compliance.imag) - self.imag).astype(float)
        )
        return float(deviation.max() / np.hypot(self.real.astype(float), self.imag.astype(float)).max())


def exact_motion(system: HybridSystem, tone: ToneDrive, run: Run, samples_per_period: int) -> Exact:
    """Recompute a run under a sinusoidal drive to forty digits.

    `run`: run of the engine with `samples_per_period` samples in each period of the drive. Raises `RunError` if an
    event of the run is not an event of the motion.
    """
    events = events_of(run.events, system)
    resting = [bool(mode) for mode in run.contact[:, -1]]

    def follow(digits: int) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
        motion = DecimalMotion(system, tone, digits)
        with decimal.localcontext(motion.context):
            step = 1 / (samples_per_period * Decimal(tone.frequency))
            motion.follow(events, resting, [k * step for k in range(len(run.time))])
        samples = np.array([z[: len(system.points)] for z in motion.samples], dtype=object)
        return samples.T, np.array(motion.times, dtype=object)

    coarse, _ = follow(CHECK_DIGITS)
    fine, times = follow(DIGITS)
    return Exact(fine, times, float(np.abs(coarse - fine).max() / np.abs(fine).max()))


def exact_orbit(scene: Scene, orbit: Orbit) -> ExactOrbit:
    """Refine a periodic orbit to forty digits.

    `scene`: with the force applied directly to its body if the test controls a force
    (`rig.system.open_loop_drive.with_ideal_force`). Raises `RunError` if Newton's iteration does not converge in
    decimal arithmetic.
    """
    coarse, fine = _ClosedOrbit(scene, orbit, CHECK_DIGITS), _ClosedOrbit(scene, orbit, DIGITS)
    start, _ = coarse.close(coarse.start())
    coarse_compliance = coarse.compliance(start)
    start, residual = fine.close(start)
    real, imag = fine.compliance(start)
    deviation = np.hypot((real - coarse_compliance[0]).astype(float), (imag - coarse_compliance[1]).astype(float)).max()
    size = np.hypot(real.astype(float), imag.astype(float)).max()
    return ExactOrbit(real, imag, residual, float(deviation / size))


def events_of(events: Any, system: HybridSystem) -> list[Event]:
    """Convert the engine's events to time [s], damper (from 0) and kind."""
    number = {int(k): j for j, k in enumerate(system.damper_number)}
    return [(float(e["time"]), number[int(e["damper"])], str(e["kind"])) for e in events]


class DecimalMotion:
    """Motion of a system in decimal arithmetic along known events.

    `z`: current state, as in `FirstOrderForm`; `mode`: contact state of each damper; `now`: current time, s;
    `samples`: states at the sample times; `times` are the event times, s.
    """

    def __init__(self, system: HybridSystem, tone: ToneDrive, digits: int, integrals: bool = False) -> None:
        self.system, self.context = system, decimal.Context(prec=digits)
        self._smallest = Decimal(10) ** (-digits - 5)
        self._fastest = max(system.max_rate, tone.omega)
        with decimal.localcontext(self.context):
            self.form = FirstOrderForm(system, tone, 0, Decimal, PI, integrals)
        self._flows: dict[tuple[int, ...], tuple[NDArray[Any], list[Any]]] = {}
        self.begin(self.form.start, [FLOOR] * system.dampers)

    def begin(self, z: Vector, mode: Sequence[int]) -> None:
        """Start at time 0."""
        self.z, self.mode, self.now = list(z), list(mode), Decimal(0)
        self.samples: list[Vector] = []
        self.times: list[Decimal] = []

    def follow(self, events: Sequence[Event], resting: Sequence[bool], samples: Iterable[Decimal] = ()) -> None:
        """Compute the motion through the events; `resting` marks dampers at rest on a wall after the last event.

        Raises `RunError` if an event is not an event of the motion.
        """
        later_samples, previous_time = list(samples)[::-1], -1.0
        with decimal.localcontext(self.context):
            rebounds = self._rebounds(events, resting)
            for (guess, j, kind), restitution in zip(events, rebounds, strict=True):
                self._sample(later_samples, guess)
                if self.system.finite_contact[j]:
                    self._to_contact_change(Decimal(guess), j, kind)
                else:
                    self._to_event(guess, j, kind, restitution, previous_time)
                self.times.append(self.now)
                previous_time = guess
            self._sample(later_samples, float("inf"))

    def _sample(self, later_samples: list[Decimal], end_time: float) -> None:
        while later_samples and float(later_samples[-1]) < end_time:
            self.advance(later_samples.pop())
            self.samples.append(self.z)

    def _rebounds(self, events: Sequence[Event], resting: Sequence[bool]) -> Vector:
        """Return the restitution of each event; 0 for the impact that ends a sequence of bounces at rest."""
        after = dict(enumerate(resting))
        rebounds: Vector = []
        for _, j, kind in reversed(events):
            rebounds.append(Decimal(0) if after[j] else Decimal(float(self.system.restitution[j])))
            after[j] = kind == "separation"
        return rebounds[::-1]

    def _to_event(self, guess: float, j: int, kind: str, restitution: Decimal, previous_time: float) -> None:
        form, wall = self.form, WALLS.index(kind)
        if wall == FLIGHT:
            # Separations caused by an impact or by the initial state have no root of their own.
            if guess not in (previous_time, 0.0):
                matrix, _ = self._flow()
                self._to_root(Decimal(guess), form.pressing(j, self.mode[j], matrix), j, kind)
            form.separate(self.z, j, self.mode[j], self.z[self.system.coordinates + form.rows[j]])
            self.mode[j] = FLIGHT
            return
        self._to_root(Decimal(guess), form.gap(j, wall), j, kind)
        self.z = list(self.z)
        self.mode[j] = wall if form.impact(self.z, j, wall, restitution) else FLIGHT

    def _to_contact_change(self, guess: Decimal, j: int, kind: str) -> None:
        """Advance to a touch or release near `guess` in finite-duration contact, and change the contact state."""
        matrix, _ = self._flow()
        if kind != "touch":
            self._to_root(guess, self.form.pressing(j, self.mode[j], matrix), j, kind)
            self.mode[j] = FLIGHT
            return
        self.advance(guess)
        gap = float(self.z[int(self.system.bed[j])])
        wall = CEILING if gap > 0.5 * float(self.system.clearance[j]) else FLOOR
        distance = self.form.gap(j, wall)
        # If the bed has not left the wall, contact resumes where the force, not the gap, is zero.
        is_separated = float(np.dot(distance, self.z)) > -MAX_TOUCH_PENETRATION_M
        self._to_root(guess, distance if is_separated else self.form.pressing(j, wall, matrix), j, kind)
        self.mode[j] = wall

    def _to_root(self, guess: Decimal, guard: NDArray[Any], j: int, kind: str) -> None:
        """Advance to the root of a guard, a row vector over the state, near `guess`."""
        self.advance(guess)
        matrix, _ = self._flow()
        slope = guard @ matrix
        for _ in range(EVENT_ITERATIONS):
            rate = np.dot(slope, self.z)
            if rate == 0:
                break
            step = -np.dot(guard, self.z) / rate
            self.advance(self.now + step)
            if abs(step) < self._smallest * 10**4:
                break
        if abs(self.now - guess) > MAX_EVENT_DIFFERENCE_S:
            raise RunError(f"event {kind} of damper {j + 1} at {guess:.9f} s is not reproduced. Report the scene.")

    def advance(self, end_time: Decimal) -> None:
        """Advance to an earlier or later time without contact change."""
        duration, z = end_time - self.now, self.z
        _, flow = self._flow()
        steps = max(1, int(np.ceil(abs(float(duration)) * self._fastest / MAX_RATE_STEP)))
        for _ in range(steps):
            term, order = z, 0
            while order == 0 or max(map(abs, term)) >= self._smallest:
                order += 1
                factor = duration / (steps * order)
                term = [factor * sum(map(mul, values, select(term)), Decimal(0)) for values, select in flow]
                z = list(map(add, z, term))
        self.z, self.now = list(z), end_time

    def _flow(self) -> tuple[NDArray[Any], list[tuple[Vector, Callable[[Vector], Vector]]]]:
        """Return the matrix of the current mode, and its sparse rows: values, and a function that selects states."""
        mode = tuple(self.mode)
        if mode not in self._flows:
            matrix = self.form.matrix(mode)
            rows = []
            for row in matrix:
                # At least two elements, because `itemgetter` returns no tuple for a single element.
                columns = [k for k, value in enumerate(row) if value]
                columns += [0] * (2 - len(columns))
                rows.append(([row[k] if row[k] else Decimal(0) for k in columns], itemgetter(*columns)))
                if columns[-1] == columns[-2]:
                    rows[-1][0][-1] = Decimal(0)
            self._flows[mode] = matrix, rows
        return self._flows[mode]


class _ClosedOrbit:
    """A periodic orbit in decimal arithmetic of given precision."""

    def __init__(self, scene: Scene, orbit: Orbit, digits: int) -> None:
        self._scene, self._orbit, self._system = scene, orbit, assemble(scene)
        tone = tone_drive(scene, self._system, orbit.frequency)
        assert tone is not None
        self._motion = DecimalMotion(self._system, tone, digits, integrals=True)
        self._events = events_of(orbit.events, self._system)
        self._flying = orbit.plan.flying.tolist()
        self._mode = [
            FLIGHT if j in self._flying or wall == kinds.FORCELESS
            else CEILING if wall in (kinds.RIDES_CEILING, kinds.ON_CEILING) else FLOOR
            for j, wall in enumerate(orbit.plan.sequence.wall[0])
        ]  # fmt: skip
        height = self._motion.form.first
        self._free = list(range(self._system.states))
        self._free += [k for j in self._flying for k in (height + j, height + self._system.dampers + j)]
        with decimal.localcontext(self._motion.context):
            self._end = Decimal(orbit.repetition) / Decimal(orbit.frequency)

    def start(self) -> Vector:
        """Return the unknowns from shooting: states, then height and speed of each damper in flight."""
        return [Decimal(float(value)) for value in self._orbit.unknowns[: len(self._free)]]

    def close(self, start: Vector) -> tuple[Vector, float]:
        """Refine an initial state by Newton's method; return it, and the residual relative to the motion."""
        digits = self._motion.context.prec
        with decimal.localcontext(self._motion.context):
            largest = max(map(abs, start))
            scale = np.array([max(abs(value), largest * Decimal("1e-6")) for value in start])
            values, jacobian, residual = np.array(start), None, np.inf
            for _ in range(ORBIT_ITERATIONS):
                gap = self._residual(values)
                relative_gap = float(np.max(np.abs(gap / scale)))
                # The last digits are rounding errors.
                if relative_gap < 10.0 ** (5 - digits) or relative_gap > 0.1 * residual:
                    residual = min(relative_gap, residual)
                    break
                residual = relative_gap
                if jacobian is None:
                    steps = ORBIT_STEP_RATIO * scale
                    shifted = [self._residual(values + step) for step in np.diag(steps)]
                    jacobian = ((np.array(shifted) - gap) / steps[:, None]).T
                values = values - solve(jacobian, gap[:, None])[:, 0]
            if residual > 10.0 ** (12 - digits):
                raise RunError(
                    f"the orbit in decimal arithmetic does not close: residual {residual:.0e}. Report the scene."
                )
            return list(values), residual

    def _residual(self, start: NDArray[Any]) -> NDArray[Any]:
        end = self._follow(start)
        return np.array([end[k] for k in self._free]) - start

    def _follow(self, start: Iterable[Decimal]) -> Vector:
        motion = self._motion
        z = list(motion.form.start)
        for k, value in zip(self._free, start, strict=True):
            z[k] = value
        motion.begin(z, self._mode)
        motion.follow(self._events, [j not in self._flying for j in range(self._system.dampers)])
        motion.advance(self._end)
        return motion.z

    def compliance(self, start: Vector) -> tuple[NDArray[Any], NDArray[Any]]:
        """Compute the compliance of the bodies from first harmonics, real and imaginary part."""
        with decimal.localcontext(self._motion.context):
            n, bodies = self._system.coordinates, self._scene.structure.bodies
            end, first = self._follow(start), self._motion.form.constant_index + 3
            real, imag = (2 * np.array(end[k : k + n]) / self._end for k in (first, first + n))
            if isinstance(self._scene.driven_shaker, ForceShaker):
                c, d = Decimal(0), Decimal(-level_of(self._scene))
            else:
                row = np.array([Decimal(float(k)) for k in spring_force_row(self._scene, self._system)[:n]])
                c, d = np.dot(row, real), np.dot(row, imag)
            a, b, size = real[:bodies], imag[:bodies], c * c + d * d
            return (a * c + b * d) / size, (b * c - a * d) / size
