"""Motions and periodic orbits to forty digits, the reference for the error of every method of `rig cost`.

The engine provides the system matrices and the order of the events; the laws of the elements provide the regimes
between events. Each event is located again as the root of its signal in decimal arithmetic, and the flow between events
is a Taylor series. Newton's method refines a periodic orbit to all digits, from the initial state computed by shooting.
The difference between two precisions indicates the number of correct digits.
"""

import decimal
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from operator import add, itemgetter, mul
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.errors import RunError
from rig.core.laws.events import EVENT_NAMES, NO_EVENT
from rig.core.orbits.event_sequence import regimes_from_walls
from rig.core.orbits.orbit import Orbit
from rig.core.scene.scene import Scene
from rig.core.simulation.simulate import Run
from rig.core.system.assembly import assemble, force_row
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import ToneDrive, level_of, tone_drive
from rig.studies.cost.first_order_form import End, FirstOrderForm, solve

Vector = Any  # Decimals, as a list or an array of objects
#: Time [s], element (from 0) and kind.
Event = tuple[float, int, str]

PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
#: Significant digits of the reference: 24 more than float64.
DIGITS = 40
#: Significant digits of the run that checks the reference.
CHECK_DIGITS = 30
#: The Taylor series loses a negligible number of digits up to this product of rate and step.
MAX_RATE_STEP = 3.0
#: Newton iterations for an event; they start within the rounding error of the engine, so eight doublings of the digits
#: suffice.
EVENT_ITERATIONS = 8
#: The time of an event may differ from the time in the engine by at most this [s].
MAX_EVENT_DIFFERENCE_S = Decimal("1e-9")
#: An event at the instant of another event is located by its own root if this root is within this time [s]; otherwise
#: the other event has caused it.
MAX_ROOT_DISTANCE_S = Decimal("1e-12")
#: A state does not determine the motion if no scaled derivative with respect to it exceeds this.
NEUTRAL = Decimal("1e-10")
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

    real: NDArray[np.object_]  # real part of the compliance [m/N]; Decimal, shape (bodies,)
    imag: NDArray[np.object_]  # imaginary part
    residual: float  # difference between start and end of the orbit, relative to the motion
    agreement: float  # relative difference from the compliance computed with fewer digits

    def error(self, compliance: NDArray[np.complex128]) -> float:
        """Compute the largest error of a compliance, relative to the largest compliance of all bodies."""
        # Subtract in decimal arithmetic so that the reference is not rounded.
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
    moving = [element.number - 1 for element in system.elements if not element.is_joint]
    walls = [*run.contact[moving, -1].tolist(), *[None] * (len(system.elements) - len(moving))]

    def integrate(digits: int) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
        motion = DecimalMotion(system, tone, digits)
        with decimal.localcontext(motion.context):
            step = 1 / (samples_per_period * Decimal(tone.frequency))
            motion.integrate(events, walls, [k * step for k in range(len(run.time))])
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
    """Convert the engine's events to time [s], element (from 0) and kind."""
    number = {(element.is_joint, element.number): j for j, element in enumerate(system.elements)}
    joints = events["joint"] if "joint" in events.dtype.names else np.zeros(len(events), dtype=int)
    return [
        (float(e["time"]), number[bool(joint), int(joint or e["damper"])], str(e["kind"]))
        for e, joint in zip(events, joints, strict=True)
    ]


class DecimalMotion:
    """Motion of a system in decimal arithmetic, given the order and approximate times of its events.

    `z`: current state, as in `FirstOrderForm`; `regimes`: regime of each element; `now`: current time [s]; `samples`:
    states at the sample times; `times`: event times [s].
    """

    def __init__(self, system: HybridSystem, tone: ToneDrive, digits: int, integrals: bool = False) -> None:
        self.system, self.context = system, decimal.Context(prec=digits)
        self._smallest_term = Decimal(10) ** (-digits - 5)
        self._max_rate = max(system.max_rate, tone.omega)
        with decimal.localcontext(self.context):
            self.form = FirstOrderForm(system, tone, 0, Decimal, PI, integrals)
        self._flows: dict[tuple[int, ...], tuple[NDArray[Any], list[list[End]], list[Any]]] = {}
        self.begin(self.form.start, self.form.start_regimes)

    def begin(self, z: Vector, regimes: Sequence[int]) -> None:
        """Set the state at time 0."""
        self.z, self.regimes, self.now = list(z), list(regimes), Decimal(0)
        self.samples: list[Vector] = []
        self.times: list[Decimal] = []

    def integrate(self, events: Sequence[Event], walls: Sequence[int | None], samples: Iterable[Decimal] = ()) -> None:
        """Compute the motion through the events; `walls`: contact of each element after the last event, if known.

        Raises `RunError` if an event is not reproduced.
        """
        later_samples, previous_time = list(samples)[::-1], 0.0
        later_kinds: list[list[str]] = [[kind for _, i, kind in events[::-1] if i == j] for j in range(len(walls))]
        with decimal.localcontext(self.context):
            for guess, j, kind in events:
                self._sample_until(guess, later_samples)
                later_kinds[j].pop()
                next_kind = later_kinds[j][-1] if later_kinds[j] else None
                self._to_event(Decimal(guess), j, kind, guess == previous_time, next_kind, walls[j])
                self.times.append(self.now)
                previous_time = guess
            self._sample_until(float("inf"), later_samples)

    def _sample_until(self, end_time: float, later_samples: list[Decimal]) -> None:
        """Store the states at sample times before `end_time`; `later_samples`: remaining times, latest first."""
        while later_samples and float(later_samples[-1]) < end_time:
            self.advance(later_samples.pop())
            self.samples.append(self.z)

    def _to_event(
        self, guess: Decimal, j: int, kind: str, is_simultaneous: bool, next_kind: str | None, wall: int | None
    ) -> None:
        """Advance to an event near `guess`; change the regime; `is_simultaneous`: at the instant of another event."""
        if not is_simultaneous:
            self.advance(guess)
        possible = list(self._possible_ends(j, self.regimes[j], kind))
        if not possible:
            raise self._not_reproduced(guess, j, kind)
        self.regimes[j], end = min(possible, key=lambda regime_and_end: self._root_distance(regime_and_end[1]))
        if is_simultaneous and self._root_distance(end) > MAX_ROOT_DISTANCE_S:
            # The other event has moved a signal beyond its limit.
            self.regimes[j], end = min(possible, key=lambda regime_and_end: np.dot(regime_and_end[1].row, self.z))
        else:
            self._to_root(guess, end.row, j, kind)
        candidates = self.form.numbers(j, end.transition.to)
        target = next((regime for regime in candidates if self._continues(j, regime, next_kind, wall)), candidates[-1])
        self.z = list(self.z)
        self.form.leave(self.z, j, self.regimes, end, target)

    def _possible_ends(self, j: int, regime: int, kind: str) -> Iterable[tuple[int, End]]:
        """Yield the transitions of a regime with this kind of event, or of regimes that follow without one."""
        regimes = [regime]
        for each in regimes:
            for end in self._flow([*self.regimes[:j], each, *self.regimes[j + 1 :]])[1][j]:
                if end.transition.event == NO_EVENT:
                    regimes += [number for number in self.form.numbers(j, end.transition.to) if number not in regimes]
                elif str(EVENT_NAMES[end.transition.event]) == kind:
                    yield each, end

    def _continues(self, j: int, regime: int, next_kind: str | None, wall: int | None) -> bool:
        """Return whether the element's next event, or without one its contact at the end, can follow from a regime."""
        if next_kind is not None:
            return any(True for _ in self._possible_ends(j, regime, next_kind))
        return wall is None or self.form.regime(j, [*self.regimes[:j], regime]).wall == wall

    def _root_distance(self, end: End) -> Decimal:
        """Return the time to the root of a signal by its rate [s]."""
        value, rate = np.dot(end.row, self.z), np.dot(end.row @ self._flow()[0], self.z)
        if value == 0:
            return Decimal(0)
        return abs(value / rate) if rate else Decimal("Infinity")

    def _to_root(self, guess: Decimal, signal: NDArray[Any], j: int, kind: str) -> None:
        """Advance to the root of a signal, a row vector over the state, near `guess`."""
        slope = signal @ self._flow()[0]
        for _ in range(EVENT_ITERATIONS):
            rate = np.dot(slope, self.z)
            if rate == 0:
                break
            step = -np.dot(signal, self.z) / rate
            self.advance(self.now + step)
            if abs(step) < self._smallest_term * 10**4:
                break
        if abs(self.now - guess) > MAX_EVENT_DIFFERENCE_S:
            raise self._not_reproduced(guess, j, kind)

    def _not_reproduced(self, guess: Decimal, j: int, kind: str) -> RunError:
        return RunError(
            f"event {kind} of {self.system.elements[j].name} at {guess:.9f} s could not be reproduced. Please report "
            "this as a bug and attach the scene."
        )

    def advance(self, end_time: Decimal) -> None:
        """Advance to an earlier or later time without contact event."""
        duration, z = end_time - self.now, self.z
        *_, flow = self._flow()
        steps = max(1, int(np.ceil(abs(float(duration)) * self._max_rate / MAX_RATE_STEP)))
        for _ in range(steps):
            term, order = z, 0
            while order == 0 or max(map(abs, term)) >= self._smallest_term:
                order += 1
                factor = duration / (steps * order)
                term = [factor * sum(map(mul, values, select(term)), Decimal(0)) for values, select in flow]
                z = list(map(add, z, term))
        self.z, self.now = list(z), end_time

    def _flow(
        self, regimes: Sequence[int] | None = None
    ) -> tuple[NDArray[Any], list[list[End]], list[tuple[Vector, Callable[[Vector], Vector]]]]:
        """Return matrix, ends of the regimes, and sparse rows of the matrix: values and a function that selects states.

        `regimes`: of all elements; None: the current regimes.
        """
        key = tuple(self.regimes if regimes is None else regimes)
        if key not in self._flows:
            matrix, ends = self.form.flow(key)
            rows = []
            for row in matrix:
                # At least two elements, because `itemgetter` returns no tuple for a single element.
                columns = [k for k, value in enumerate(row) if value]
                columns += [0] * (2 - len(columns))
                rows.append(([row[k] if row[k] else Decimal(0) for k in columns], itemgetter(*columns)))
                if columns[-1] == columns[-2]:
                    rows[-1][0][-1] = Decimal(0)
            self._flows[key] = matrix, ends, rows
        return self._flows[key]


class _ClosedOrbit:
    """A periodic orbit in decimal arithmetic with a given number of digits."""

    def __init__(self, scene: Scene, orbit: Orbit, digits: int) -> None:
        self._scene, self._orbit, self._system = scene, orbit, assemble(scene)
        tone = tone_drive(scene, self._system, orbit.frequency)
        assert tone is not None
        self._motion = DecimalMotion(self._system, tone, digits, integrals=True)
        self._events = events_of(orbit.events, self._system)
        self._flying = orbit.plan.flying.tolist()
        self._regimes = regimes_from_walls(
            orbit.plan.sequence.wall[0], orbit.unknowns[: self._system.states], self._system
        )
        self._walls = [self._motion.form.regime(j, self._regimes).wall for j in range(len(self._regimes))]
        first_height, elements = self._motion.form.first_height, len(self._system.elements)
        self._unknown_indices = list(range(self._system.states))
        self._unknown_indices += [k for j in self._flying for k in (first_height + j, first_height + elements + j)]
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
                    scaled = np.abs(jacobian * scale / scale[:, None])
                    # The motion of a mass without suspension does not depend on its gap, and a mass that sticks keeps
                    # its gap.
                    determined = np.flatnonzero((scaled.max(axis=0) > NEUTRAL) & (scaled.max(axis=1) > NEUTRAL))
                part = jacobian[np.ix_(determined, determined)]
                values[determined] -= solve(part, closure_error[determined, None])[:, 0]
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
        motion.begin(z, self._regimes)
        motion.integrate(self._events, self._walls)
        motion.advance(self._end)
        return motion.z

    def compliance(self, start: Vector) -> tuple[NDArray[Any], NDArray[Any]]:
        """Compute the compliance of the bodies from first harmonics; return the real and imaginary parts [m/N]."""
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
