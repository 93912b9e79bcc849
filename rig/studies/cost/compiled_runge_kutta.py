"""Compiled Runge-Kutta solver of Dormand and Prince, order 5(4), with event location: an alternative in `rig cost`.

It is the fastest general-purpose alternative to the engine. Right-hand side, step size control, dense output, event
location and contact events are compiled. The right-hand side has a matrix for each configuration, the set of dampers
at rest on a wall. Unlike the engine, the solver can miss a guard that crosses zero twice within a step.

E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 2nd ed., 1993: step size in II.4.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import RK45

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.numerics.jit import inlined_kernel, kernel
from rig.studies.cost.adaptive_solvers import ENDLESS_EVENTS, MAX_EVENTS_PER_PERIOD
from rig.studies.cost.first_order_form import CEILING, EVENT_KINDS, FLIGHT, FLOOR, ComputedMotion, FirstOrderForm

#: Weights of the stages, from scipy.
STAGE_WEIGHTS = np.vstack([np.hstack([RK45.A, np.zeros((6, 1))]), RK45.B])
#: Weights of the error estimate.
ERROR_WEIGHTS = np.array(RK45.E)
#: Weights of the dense output.
DENSE_WEIGHTS = np.ascontiguousarray(RK45.P)
#: Maximum number of iterations for the root of a guard.
MAX_ROOT_ITERATIONS = 60
#: Tolerance of a root, as a share of the step.
ROOT_TOLERANCE = 1e-15
#: A solver is stopped after this number of steps in a period, because it alternates around one instant.
MAX_STEPS_PER_PERIOD = 10_000
#: Maximum number of dampers; each additional damper doubles the number of matrices.
MAX_DAMPERS = 8


class Tables(NamedTuple):
    """Scene data of the compiled kernel, as in `FirstOrderForm`."""

    # M of z' = M z, (configurations, size, size); bit j of the configuration is 1 if damper j is at rest on a wall.
    matrix: Array
    damper_coordinate: NDArray[np.int64]
    inverse_mass: Array
    mass: Array
    clearance: Array
    restitution: Array
    gravity: float
    coordinates: int
    first_height: int
    constant_index: int


class Contacts(NamedTuple):
    """Contact state of the dampers, and the event log."""

    state: NDArray[np.int64]  # `FLIGHT`, `FLOOR` or `CEILING`, (dampers,)
    disabled_until: Array  # time at which the guard of each wall is enabled again [s], (dampers, 3)
    time: Array  # of each event in the log [s]
    damper: NDArray[np.int64]  # of each event
    kind: NDArray[np.int64]  # of each event, an index of `EVENT_KINDS`
    logged_events: NDArray[np.int64]  # number of events in the log, an array of one element


class DormandPrince:
    """The solver, reusable for any number of runs.

    Raises `RunError` if there are too many dampers.
    """

    def __init__(self, problem: FirstOrderForm) -> None:
        self._problem, self._tables = problem, _tables(problem)
        size = problem.size
        self._work = (np.zeros((7, size)), np.zeros(size), np.zeros(size))

    def integrate(self, rtol: float, guard_pause: float, max_step: float) -> ComputedMotion:
        """Compute the motion.

        `rtol`: relative tolerance; the absolute tolerance is a thousandth of `rtol`, as for the other adaptive solvers;
        `guard_pause`: time for which a guard is disabled after the damper leaves the wall [s]; `max_step`: s. Raises
        `RunError` if events repeat endlessly, or there are too many steps.
        """
        problem = self._problem
        dampers, max_events = problem.system.dampers, MAX_EVENTS_PER_PERIOD * problem.periods
        contacts = Contacts(
            state=np.full(dampers, FLOOR, dtype=np.int64),
            disabled_until=np.full((dampers, 3), -1.0),
            time=np.zeros(max_events),
            damper=np.zeros(max_events, dtype=np.int64),
            kind=np.zeros(max_events, dtype=np.int64),
            logged_events=np.zeros(1, dtype=np.int64),
        )
        motion = np.zeros((problem.samples, problem.system.coordinates))
        start, times = np.array(problem.start), problem.times
        steps = MAX_STEPS_PER_PERIOD * problem.periods
        if not _integrate(
            self._tables, contacts, start, times, motion, rtol, guard_pause, max_step, steps, *self._work
        ):
            if contacts.logged_events[0] < max_events:
                raise RunError(f"not completed within {steps} steps; a larger tolerance takes fewer steps")
            raise RunError(ENDLESS_EVENTS.format(contacts.time[-1]))
        events = slice(contacts.logged_events[0])
        log = zip(contacts.time[events], contacts.damper[events], contacts.kind[events], strict=True)
        return ComputedMotion(motion.T, [(float(t), int(j), EVENT_KINDS[k]) for t, j, k in log])


def _tables(problem: FirstOrderForm) -> Tables:
    system, dampers = problem.system, problem.system.dampers
    if dampers > MAX_DAMPERS:
        raise RunError(
            f"{dampers} dampers have {2**dampers} combinations of contact, each of which needs a matrix; expected at "
            f"most {MAX_DAMPERS} dampers"
        )
    return Tables(
        matrix=np.array(
            [problem.matrix([configuration >> j & 1 for j in range(dampers)]) for configuration in range(2**dampers)]
        ),
        damper_coordinate=problem.body,
        inverse_mass=problem.inverse_mass,
        mass=np.asarray(system.damper_mass, dtype=np.float64),
        clearance=np.asarray(system.clearance, dtype=np.float64),
        restitution=np.asarray(system.restitution, dtype=np.float64),
        gravity=system.gravity,
        coordinates=system.coordinates,
        first_height=problem.first_height,
        constant_index=problem.constant_index,
    )


@inlined_kernel
def _derivative(tables: Tables, configuration: int, z: Array, out: Array) -> None:
    for i in range(z.shape[0]):
        total = 0.0
        for k in range(z.shape[0]):
            total += tables.matrix[configuration, i, k] * z[k]
        out[i] = total


@inlined_kernel
def _trial_step(
    tables: Tables, configuration: int, h: float, z: Array, new: Array, stages: Array, rtol: float
) -> float:
    """Compute a trial step from its first stage; return the RMS error relative to the tolerance (II.4)."""
    for k in range(1, 7):
        for i in range(z.shape[0]):
            total = 0.0
            for m in range(k):
                total += STAGE_WEIGHTS[k, m] * stages[m, i]
            new[i] = z[i] + h * total
        _derivative(tables, configuration, new, stages[k])
    error_ratio = 0.0
    for i in range(z.shape[0]):
        total = 0.0
        for k in range(7):
            total += ERROR_WEIGHTS[k] * stages[k, i]
        error_ratio += (h * total / (rtol * (1e-3 + max(abs(z[i]), abs(new[i]))))) ** 2
    return np.sqrt(error_ratio / z.shape[0])


@inlined_kernel
def _interpolate(z: Array, stages: Array, h: float, theta: float, out: Array) -> None:
    """Interpolate the state at the share theta of the step, to fourth order."""
    for i in range(z.shape[0]):
        out[i] = z[i]
    for k in range(7):
        weight = 0.0
        for power in range(3, -1, -1):
            weight = theta * (weight + DENSE_WEIGHTS[k, power])
        for i in range(z.shape[0]):
            out[i] += h * weight * stages[k, i]


@inlined_kernel
def _guard(tables: Tables, contacts: Contacts, configuration: int, j: int, wall: int, t: float, z: Array) -> float:
    """Return the gap of a damper in flight, or contact force over mass of a damper at rest; 1 if none or disabled."""
    if contacts.state[j] == FLIGHT:
        if t <= contacts.disabled_until[j, wall]:
            return 1.0
        gap = z[tables.first_height + j] - z[tables.damper_coordinate[j]]
        return gap if wall == FLOOR else tables.clearance[j] - gap
    if wall != contacts.state[j]:
        return 1.0
    contact_acceleration = tables.gravity
    for k in range(z.shape[0]):
        contact_acceleration += tables.matrix[configuration, tables.coordinates + tables.damper_coordinate[j], k] * z[k]
    return contact_acceleration if wall == FLOOR else -contact_acceleration


@inlined_kernel
def _first_event(
    tables: Tables,
    contacts: Contacts,
    configuration: int,
    t: float,
    h: float,
    z: Array,
    new: Array,
    stages: Array,
    work: Array,
) -> tuple[float, int, int]:
    """Locate the first guard that is negative at the end of a step: share of the step, damper (-1: none), wall."""
    first_share, first_damper, first_wall = 1.0, -1, FLIGHT
    for j in range(contacts.state.shape[0]):
        for wall in (FLOOR, CEILING):
            negative_value = _guard(tables, contacts, configuration, j, wall, t + h, new)
            if negative_value >= 0.0:
                continue
            low, high = 0.0, 1.0
            positive_value = max(_guard(tables, contacts, configuration, j, wall, t, z), 0.0)
            # False position, Illinois variant: the value at an end that is retained is halved.
            for _ in range(MAX_ROOT_ITERATIONS):
                if high - low < ROOT_TOLERANCE:
                    break
                theta = low + (high - low) * positive_value / (positive_value - negative_value)
                _interpolate(z, stages, h, theta, work)
                value = _guard(tables, contacts, configuration, j, wall, t + theta * h, work)
                if value < 0.0:
                    high, negative_value, positive_value = theta, value, 0.5 * positive_value
                else:
                    low, positive_value, negative_value = theta, value, 0.5 * negative_value
                if value == 0.0:
                    high = theta
            if high < first_share or first_damper < 0:
                first_share, first_damper, first_wall = high, j, wall
    return first_share, first_damper, first_wall


@inlined_kernel
def _log_event(contacts: Contacts, t: float, j: int, kind: int) -> None:
    k = contacts.logged_events[0]
    contacts.time[k], contacts.damper[k], contacts.kind[k] = t, j, kind
    contacts.logged_events[0] = k + 1


@inlined_kernel
def _separate(tables: Tables, contacts: Contacts, t: float, z: Array, j: int, speed: float, guard_pause: float) -> None:
    """Separate a damper from its wall; `speed`: its velocity afterwards [m/s]."""
    wall = contacts.state[j]
    z[tables.first_height + j] = z[tables.damper_coordinate[j]] + (tables.clearance[j] if wall == CEILING else 0.0)
    z[tables.first_height + contacts.state.shape[0] + j] = speed
    contacts.disabled_until[j, wall] = t + guard_pause
    contacts.state[j] = FLIGHT


@inlined_kernel
def _change(tables: Tables, contacts: Contacts, t: float, z: Array, j: int, wall: int, guard_pause: float) -> None:
    """Separate a damper at rest from its wall, or apply an impact of a damper in flight (Newton's restitution)."""
    body_velocity = tables.coordinates + tables.damper_coordinate[j]
    if contacts.state[j] != FLIGHT:
        _log_event(contacts, t, j, FLIGHT)
        _separate(tables, contacts, t, z, j, z[body_velocity], guard_pause)
        return
    _log_event(contacts, t, j, wall)
    damper_velocity = tables.first_height + contacts.state.shape[0] + j
    closing_speed = z[damper_velocity] - z[body_velocity]
    restitution = tables.restitution[j]
    mass_factor = 1.0 + 1.0 / (tables.inverse_mass[j] * tables.mass[j])
    z[body_velocity] += (1.0 + restitution) * closing_speed / mass_factor
    contacts.state[j] = wall
    z[damper_velocity] = z[body_velocity]
    z[tables.first_height + j] = z[tables.damper_coordinate[j]] + (tables.clearance[j] if wall == CEILING else 0.0)
    if restitution > 0.0:
        _separate(tables, contacts, t, z, j, z[body_velocity] - restitution * closing_speed, guard_pause)


@inlined_kernel
def _release(tables: Tables, contacts: Contacts, t: float, z: Array, guard_pause: float) -> int:
    """Separate dampers with a tensile contact force, one by one; return the configuration, or -1 if the log is full."""
    # Through damping, a velocity jump changes the contact forces in adjacent bodies, so one separation may cause
    # another.
    while contacts.logged_events[0] < contacts.time.shape[0]:
        configuration = 0
        for j in range(contacts.state.shape[0]):
            configuration |= (contacts.state[j] != FLIGHT) << j
        tensile = -1
        for j in range(contacts.state.shape[0]):
            wall = contacts.state[j]
            if tensile < 0 and wall != FLIGHT and _guard(tables, contacts, configuration, j, wall, t, z) < 0.0:
                tensile = j
        if tensile < 0:
            return configuration
        _change(tables, contacts, t, z, tensile, FLIGHT, guard_pause)
    return -1


@inlined_kernel
def _store(motion: Array, row: int, z: Array) -> None:
    for i in range(motion.shape[1]):
        motion[row, i] = z[i]


@kernel
def _integrate(
    tables: Tables, contacts: Contacts, z: Array, times: Array, motion: Array, rtol: float, guard_pause: float,
    max_step: float, max_steps: int, stages: Array, new: Array, work: Array,
) -> bool:  # fmt: skip
    """Integrate with event location; return False if the number of events or steps exceeds its limit."""
    _store(motion, 0, z)
    t, sample, h = 0.0, 1, min(max_step, 1e-3 * (times[1] - times[0]))
    configuration = _release(tables, contacts, t, z, guard_pause)
    _derivative(tables, configuration, z, stages[0])
    for _ in range(max_steps):
        if sample == times.shape[0]:
            return True
        h = min(h, max_step)
        error_ratio = _trial_step(tables, configuration, h, z, new, stages, rtol)
        factor = 5.0 if error_ratio == 0.0 else min(5.0, max(0.2, 0.9 * error_ratio**-0.2))
        if error_ratio > 1.0:
            h *= factor
            continue
        step_fraction, damper, wall = _first_event(tables, contacts, configuration, t, h, z, new, stages, work)
        while sample < times.shape[0] and times[sample] <= t + step_fraction * h:
            _interpolate(z, stages, h, (times[sample] - t) / h, work)
            _store(motion, sample, work)
            sample += 1
        if damper < 0:
            t += h
            for i in range(z.shape[0]):
                z[i], stages[0, i] = new[i], stages[6, i]
            h *= factor
            continue
        _interpolate(z, stages, h, step_fraction, work)
        t += step_fraction * h
        for i in range(z.shape[0]):
            z[i] = work[i]
        _change(tables, contacts, t, z, damper, wall, guard_pause)
        configuration = _release(tables, contacts, t, z, guard_pause)
        if configuration < 0:
            return False
        _derivative(tables, configuration, z, stages[0])
    return False
