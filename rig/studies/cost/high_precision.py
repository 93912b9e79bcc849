"""Motions and periodic orbits to forty digits, the reference for the error of every method of `rig cost`.

The engine provides the system matrices and the order of the events. Each event is located again as the root of its
guard in decimal arithmetic, and the flow between events is a Taylor series. Newton's method refines a periodic orbit
to all digits, from the initial state computed by shooting. The difference between two precisions indicates the number
of correct digits.
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

from rig.core.base.errors import RunError
from rig.core.orbits import event_kinds as kinds
from rig.core.orbits.orbit import Orbit
from rig.core.scene.scene import Scene
from rig.core.simulation.simulate import Run
from rig.core.system.assembly import assemble, force_row
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import ToneDrive, level_of, tone_drive
from rig.studies.cost.first_order_form import CEILING, EVENT_KINDS, FLIGHT, FLOOR, FirstOrderForm, solve

Vector = Any  # Decimals, as a list or an array of objects
#: Time [s], damper (from 0) and kind.
Event = tuple[float, int, str]

PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
#: Significant digits of the reference: 24 more than float64.
DIGITS = 40
#: Significant digits of the run that checks the reference.
CHECK_DIGITS = 30
#: The Taylor series loses a negligible number of digits up to this product of rate and step.
MAX_RATE_STEP = 3.0
#: A touch is an impact, and not a resumed contact, if the penetration is at most this, m; rounding is 1e-18 m.
MAX_TOUCH_PENETRATION_M = 1e-13
#: Newton iterations for an event; they start within the rounding error of the engine, so eight doublings of the digits
#: suffice.
EVENT_ITERATIONS = 8
#: The time of an event may differ from the time in the engine by at most this, s.
MAX_EVENT_DIFFERENCE_S = Decimal("1e-9")
#: Relative step of the difference quotients of an orbit; each Newton iteration gains the same number of digits.
ORBIT_STEP_RATIO = Decimal("1e-14")
#: Maximum number of Newton iterations for an orbit; two reach forty digits from the sixteen of shooting.
ORBIT_ITERATIONS = 4


@dataclass(frozen=True)
class ExactMotion:
    """A motion with far more digits than float64."""

    displacement: NDArray[np.object_]  # m; Decimal, shape (coordinates, samples)
    event_time: NDArray[np.object_]  # s; Decimal, shape (events,)
    agreement: float
    """Largest difference from the same motion computed with fewer digits, relative to the motion."""


@dataclass(frozen=True)
class ExactOrbit:
    """A steady response with far more digits than float64."""

    real: NDArray[np.object_]  # real part of the compliance, m/N; Decimal, shape (bodies,)
    imag: NDArray[np.object_]  # imaginary part
    residual: float  # difference between start and end of the orbit, relative to the motion
    agreement: float  # relative difference from the compliance computed with fewer digits

    def error(self, compliance: NDArray[np.complex128]) -> float:
        """Compute the largest error of a compliance, relative to the largest compliance of all bodies."""
        # Subtract in decimal arithmetic, so that the reference is not rounded.
        exact = np.vectorize(Decimal, otypes=[object])
        deviation = np.hypot(
            (exact(compliance.real) - self.real).astype(float), (exact(compliance.imag) - self.imag).astype(float)
        )
        return float(deviation.max() / np.hypot(self.real.astype(float), self.imag.astype(float)).max())


def exact_motion(system: HybridSystem, tone: ToneDrive, run: Run, samples_per_period: int) -> ExactMotion:
    """Recompute a run under a sinusoidal drive to forty digits.

    `run`: run of the engine with `samples_per_period` samples in each period of the drive. Raises `RunError` if an
    event of the run is not reproduced.
    """
    events = events_of(run.events, system)
    resting = [bool(wall) for wall in run.contact[:, -1]]

    def integrate(digits: int) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
        motion = DecimalMotion(system, tone, digits)
        with decimal.localcontext(motion.context):
            step = 1 / (samples_per_period * Decimal(tone.frequency))
            motion.integrate(events, resting, [k * step for k in range(len(run.time))])
        samples = np.array([z[: len(system.points)] for z in motion.samples], dtype=object)
        return samples.T, np.array(motion.times, dtype=object)

    coarse, _ = integrate(CHECK_DIGITS)
    fine, times = integrate(DIGITS)
    return ExactMotion(fine, times, float(np.abs(coarse - fine).max() / np.abs(fine).max()))


def exact_orbit(scene: Scene, orbit: Orbit) -> ExactOrbit:
    """Refine a periodic orbit to forty digits.

    `scene`: with the force applied directly to its body if the test controls a force
    (`rig.core.system.open_loop_drive.with_ideal_force`). Raises `RunError` if Newton's iteration does not converge in
    decimal arithmetic.
    """
    coarse, fine = _ClosedOrbit(scene, orbit, CHECK_DIGITS), _ClosedOrbit(scene, orbit, DIGITS)
    start, _ = coarse.refine(coarse.start())
    coarse_real, coarse_imag = coarse.compliance(start)
    start, residual = fine.refine(start)
    real, imag = fine.compliance(start)
    deviation = np.hypot((real - coarse_real).astype(float), (imag - coarse_imag).astype(float)).max()
    largest = np.hypot(real.astype(float), imag.astype(float)).max()
    return ExactOrbit(real, imag, residual, float(deviation / largest))


def events_of(events: Any, system: HybridSystem) -> list[Event]:
    """Convert the engine's events to time [s], damper (from 0) and kind."""
    number = {int(k): j for j, k in enumerate(system.damper_number)}
    return [(float(e["time"]), number[int(e["damper"])], str(e["kind"])) for e in events]


class DecimalMotion:
    """Motion of a system in decimal arithmetic, given the order and approximate times of its events.

    `z`: current state, as in `FirstOrderForm`; `contact_states`: contact states of each damper; `now`: current time, s;
    `samples`: states at the sample times; `times`: event times, s.
    """

    def __init__(self, system: HybridSystem, tone: ToneDrive, digits: int, integrals: bool = False) -> None:
        self.system, self.context = system, decimal.Context(prec=digits)
        self._smallest_term = Decimal(10) ** (-digits - 5)
        self._max_rate = max(system.max_rate, tone.omega)
        with decimal.localcontext(self.context):
            self.form = FirstOrderForm(system, tone, 0, Decimal, PI, integrals)
        self._flows: dict[tuple[int, ...], tuple[NDArray[Any], list[Any]]] = {}
        self.begin(self.form.start, [FLOOR] * system.dampers)

    def begin(self, z: Vector, contact_states: Sequence[int]) -> None:
        """Set the state at time 0."""
        self.z, self.contact_states, self.now = list(z), list(contact_states), Decimal(0)
        self.samples: list[Vector] = []
        self.times: list[Decimal] = []

    def integrate(self, events: Sequence[Event], resting: Sequence[bool], samples: Iterable[Decimal] = ()) -> None:
        """Compute the motion through the events; `resting` marks dampers at rest on a wall after the last event.

        Raises `RunError` if an event is not reproduced.
        """
        later_samples, previous_time = list(samples)[::-1], -1.0
        with decimal.localcontext(self.context):
            restitutions = self._restitutions(events, resting)
            for (guess, j, kind), restitution in zip(events, restitutions, strict=True):
                self._sample_until(guess, later_samples)
                if self.system.finite_contact[j]:
                    self._to_contact_change(Decimal(guess), j, kind)
                else:
                    self._to_event(guess, j, kind, restitution, previous_time)
                self.times.append(self.now)
                previous_time = guess
            self._sample_until(float("inf"), later_samples)

    def _sample_until(self, end_time: float, later_samples: list[Decimal]) -> None:
        """Store the states at sample times before `end_time`; `later_samples`: remaining times, latest first."""
        while later_samples and float(later_samples[-1]) < end_time:
            self.advance(later_samples.pop())
            self.samples.append(self.z)

    def _restitutions(self, events: Sequence[Event], resting: Sequence[bool]) -> Vector:
        """Return the restitution of each event; 0 for an impact after which the damper stays on the wall."""
        stays_on_wall = dict(enumerate(resting))
        restitutions: Vector = []
        for _, j, kind in reversed(events):
            restitutions.append(Decimal(0) if stays_on_wall[j] else Decimal(float(self.system.restitution[j])))
            stays_on_wall[j] = kind == "separation"
        return restitutions[::-1]

    def _to_event(self, guess: float, j: int, kind: str, restitution: Decimal, previous_time: float) -> None:
        form, wall = self.form, EVENT_KINDS.index(kind)
        if wall == FLIGHT:
            # Separations caused by an impact or by the initial state have no root of their own.
            if guess not in (previous_time, 0.0):
                matrix, _ = self._flow()
                self._to_root(Decimal(guess), form.contact_force_row(j, self.contact_states[j], matrix), j, kind)
            form.separate(
                self.z, j, self.contact_states[j], self.z[self.system.coordinates + form.damper_coordinate[j]]
            )
            self.contact_states[j] = FLIGHT
            return
        self._to_root(Decimal(guess), form.gap_row(j, wall), j, kind)
        self.z = list(self.z)
        self.contact_states[j] = wall if form.impact(self.z, j, wall, restitution) else FLIGHT

    def _to_contact_change(self, guess: Decimal, j: int, kind: str) -> None:
        """Advance to a touch or release near `guess` in finite-duration contact, and change the contact state."""
        matrix, _ = self._flow()
        if kind != "touch":
            self._to_root(guess, self.form.contact_force_row(j, self.contact_states[j], matrix), j, kind)
            self.contact_states[j] = FLIGHT
            return
        self.advance(guess)
        gap = float(self.z[int(self.system.gap_coordinate[j])])
        wall = CEILING if gap > 0.5 * float(self.system.clearance[j]) else FLOOR
        distance = self.form.gap_row(j, wall)
        # If the bed has not left the wall, contact resumes where the force, not the gap, is zero.
        is_separated = float(np.dot(distance, self.z)) > -MAX_TOUCH_PENETRATION_M
        self._to_root(guess, distance if is_separated else self.form.contact_force_row(j, wall, matrix), j, kind)
        self.contact_states[j] = wall

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
            if abs(step) < self._smallest_term * 10**4:
                break
        if abs(self.now - guess) > MAX_EVENT_DIFFERENCE_S:
            raise RunError(
                f"event {kind} of damper {j + 1} at {guess:.9f} s could not be reproduced. Please report this as a bug "
                "and attach the scene."
            )

    def advance(self, end_time: Decimal) -> None:
        """Advance to an earlier or later time without contact event."""
        duration, z = end_time - self.now, self.z
        _, flow = self._flow()
        steps = max(1, int(np.ceil(abs(float(duration)) * self._max_rate / MAX_RATE_STEP)))
        for _ in range(steps):
            term, order = z, 0
            while order == 0 or max(map(abs, term)) >= self._smallest_term:
                order += 1
                factor = duration / (steps * order)
                term = [factor * sum(map(mul, values, select(term)), Decimal(0)) for values, select in flow]
                z = list(map(add, z, term))
        self.z, self.now = list(z), end_time

    def _flow(self) -> tuple[NDArray[Any], list[tuple[Vector, Callable[[Vector], Vector]]]]:
        """Return the current matrix and its sparse rows: values, and a function that selects the states."""
        contact_states = tuple(self.contact_states)
        if contact_states not in self._flows:
            matrix = self.form.matrix(contact_states)
            rows = []
            for row in matrix:
                # At least two elements, because `itemgetter` returns no tuple for a single element.
                columns = [k for k, value in enumerate(row) if value]
                columns += [0] * (2 - len(columns))
                rows.append(([row[k] if row[k] else Decimal(0) for k in columns], itemgetter(*columns)))
                if columns[-1] == columns[-2]:
                    rows[-1][0][-1] = Decimal(0)
            self._flows[contact_states] = matrix, rows
        return self._flows[contact_states]


class _ClosedOrbit:
    """A periodic orbit in decimal arithmetic with a given number of digits."""

    def __init__(self, scene: Scene, orbit: Orbit, digits: int) -> None:
        self._scene, self._orbit, self._system = scene, orbit, assemble(scene)
        tone = tone_drive(scene, self._system, orbit.frequency)
        assert tone is not None
        self._motion = DecimalMotion(self._system, tone, digits, integrals=True)
        self._events = events_of(orbit.events, self._system)
        self._flying = orbit.plan.flying.tolist()
        self._contact_states = [
            FLIGHT if j in self._flying or wall == kinds.WITHOUT_FORCE
            else CEILING if wall in (kinds.RIDES_CEILING, kinds.ON_CEILING) else FLOOR
            for j, wall in enumerate(orbit.plan.sequence.wall[0])
        ]  # fmt: skip
        first_height, dampers = self._motion.form.first_height, self._system.dampers
        self._unknown_indices = list(range(self._system.states))
        self._unknown_indices += [k for j in self._flying for k in (first_height + j, first_height + dampers + j)]
        with decimal.localcontext(self._motion.context):
            self._end = Decimal(orbit.repetition) / Decimal(orbit.frequency)

    def start(self) -> Vector:
        """Return the unknowns from shooting: states, then height and speed of each damper in flight."""
        return [Decimal(float(value)) for value in self._orbit.unknowns[: len(self._unknown_indices)]]

    def refine(self, start: Vector) -> tuple[Vector, float]:
        """Refine an initial state by Newton's method; return it, and the residual relative to the motion."""
        digits = self._motion.context.prec
        with decimal.localcontext(self._motion.context):
            smallest_scale = max(map(abs, start)) * Decimal("1e-6")
            scale = np.array([max(abs(value), smallest_scale) for value in start])
            values, jacobian, residual = np.array(start), None, np.inf
            for _ in range(ORBIT_ITERATIONS):
                closure_error = self._residual(values)
                relative_error = float(np.max(np.abs(closure_error / scale)))
                # Stop at rounding level, or where an iteration gains less than a digit.
                if relative_error < 10.0 ** (5 - digits) or relative_error > 0.1 * residual:
                    residual = min(relative_error, residual)
                    break
                residual = relative_error
                if jacobian is None:
                    steps = ORBIT_STEP_RATIO * scale
                    shifted = [self._residual(values + step) for step in np.diag(steps)]
                    jacobian = ((np.array(shifted) - closure_error) / steps[:, None]).T
                values = values - solve(jacobian, closure_error[:, None])[:, 0]
            if residual > 10.0 ** (12 - digits):
                raise RunError(
                    f"the orbit in decimal arithmetic has a residual of {residual:.0e}. Please report this as a bug "
                    "and attach the scene."
                )
            return list(values), residual

    def _residual(self, start: NDArray[Any]) -> NDArray[Any]:
        """Return the state after one repetition minus the initial state, for the unknowns."""
        end = self._integrate(start)
        return np.array([end[k] for k in self._unknown_indices]) - start

    def _integrate(self, start: Iterable[Decimal]) -> Vector:
        """Return z after one repetition of the motion, from initial values of the unknowns."""
        motion = self._motion
        z = list(motion.form.start)
        for k, value in zip(self._unknown_indices, start, strict=True):
            z[k] = value
        motion.begin(z, self._contact_states)
        motion.integrate(self._events, [j not in self._flying for j in range(self._system.dampers)])
        motion.advance(self._end)
        return motion.z

    def compliance(self, start: Vector) -> tuple[NDArray[Any], NDArray[Any]]:
        """Compute the compliance of the bodies from first harmonics; return real and imaginary part, m/N."""
        with decimal.localcontext(self._motion.context):
            n, bodies = self._system.coordinates, self._scene.structure.bodies
            end, first = self._integrate(start), self._motion.form.constant_index + 3
            x_real, x_imag = (2 * np.array(end[k : k + n]) / self._end for k in (first, first + n))
            if self._scene.driven_shaker is None or self._scene.driven_shaker.drive_is_force:
                force_real, force_imag = Decimal(0), Decimal(-level_of(self._scene))
            else:
                row = np.array([Decimal(float(k)) for k in force_row(self._scene, self._system)[:n]])
                force_real, force_imag = np.dot(row, x_real), np.dot(row, x_imag)
            x_real, x_imag = x_real[:bodies], x_imag[:bodies]
            force_squared = force_real * force_real + force_imag * force_imag
            real = (x_real * force_real + x_imag * force_imag) / force_squared
            return real, (x_imag * force_real - x_real * force_imag) / force_squared
