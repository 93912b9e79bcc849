"""The one kernel: it advances a compiled system through flights, rides and impacts.

Between contact changes the state z = (coordinates, velocities, coil current, drive) obeys z' = A z + b exactly,
with A and b of the contact configuration. A step of length h is a matrix product. Every guard (gap, contact
force) is proven free of zeros over the step, or its first crossing is isolated and the step ends there:

1. Envelope: as long as no state outgrows the envelope of its size, no guard can sag by more than a margin below
   its values at the ends of a step, and while those stay above it there is nothing to examine;
2. Hermite test: the cubic through values and slopes at both ends is positive by more than its error, which a
   bound of the guard's fourth derivative limits;
3. otherwise its power series over the step goes through `rig.polynomial.first_crossing`.

Each proof is rigorous, so which of them served has no influence on the motion.

Everything is float64 and allocates nothing; the tables come from `rig.flow`, the contact laws from
`rig.contact`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.complementarity import ContactWork, contact_work
from rig.contact import (
    AMBIGUOUS,
    FLIGHT,
    FLOOR,
    IN_A_ROW,
    ROUNDING,
    SLOT,
    Log,
    State,
    close_break,
    impact,
    open_break,
    separate,
)
from rig.flow import Flow, Model
from rig.jit import compiled, inlined
from rig.lanes import combine, combine_many, copy, exceeds, padded
from rig.polynomial import BERNSTEIN, DEEPEST, LENGTH, NONE, first_crossing

Array = NDArray[np.float64]

#: Why the kernel came back.
DONE, NEED_TABLE, LOG_FULL, STUCK = 0, 1, 2, 3
#: This many events at one instant, per damper, is no motion of the system any more.
EVENTS_AT_ONE_INSTANT = 100
#: What is known of the present state: nothing; the accelerations, which stand behind it, and the margins of its
#: configuration; and also that every guard lies above its margin.
STALE, CURRENT, CLEAR = 0, 1, 2
#: An envelope is drawn this much wider than the state is large.
WIDER = 2.0
#: Guards of a damper.
FLOOR_GAP, CEILING_GAP, CONTACT_FORCE = 1, 2, 0


class Scratch(NamedTuple):
    """Work space of one running kernel."""

    new: np.ndarray
    size: np.ndarray
    envelope: np.ndarray
    margin: np.ndarray
    tableau: np.ndarray
    bound: np.ndarray
    derivative: np.ndarray
    contact: ContactWork
    series_rows: np.ndarray
    powers: np.ndarray
    nothing: np.ndarray
    series: np.ndarray
    work: np.ndarray
    spans: np.ndarray
    bernstein: np.ndarray


def scratch_for(flow: Flow, size: int) -> Scratch:
    """Allocate the work space for a flow and states of a padded size."""
    columns = flow.rates_constant.shape[1]
    tableau = np.zeros((LENGTH + 1, padded(columns)))
    envelope = np.zeros(padded(columns))
    envelope[columns:] = np.inf
    return Scratch(
        new=np.zeros(size),
        size=np.zeros(padded(columns)),
        envelope=envelope,
        margin=np.zeros(flow.margin_constant.shape[1]),
        tableau=tableau,
        series_rows=tableau[None],
        powers=np.zeros(LENGTH + 1),
        nothing=np.zeros((1, padded(columns))),
        bound=np.zeros(flow.bound_constant.shape[1]),
        derivative=np.zeros(flow.derivative_constant.shape[1]),
        contact=contact_work(flow.neighbour.shape[1], flow.derivative_constant.shape[1]),
        series=np.zeros(LENGTH),
        work=np.zeros((DEEPEST + 3, LENGTH)),
        spans=np.zeros((DEEPEST + 3, 2)),
        bernstein=BERNSTEIN,
    )


@inlined
def _expand(flow: Flow, model: Model, slot: int, z: Array, tableau: Array) -> None:
    """Power series of the state over one step: tableau[k] = (A h)^k z / k!, with what the constant adds."""
    size = flow.rates_constant.shape[1]
    if flow.tabulated:
        combine_many(flow.series, flow.series_constant, slot, z, size, tableau)
        return
    for i in range(size):
        tableau[0, i] = z[i]
    for k in range(LENGTH):
        factor = model.step / (k + 1)
        for i in range(size):
            rate = flow.rates_constant[slot, i] if k == 0 else 0.0
            for entry in range(flow.pointer[i], flow.pointer[i + 1]):
                rate += flow.rates[slot, entry] * tableau[k, flow.column[entry]]
            tableau[k + 1, i] = factor * rate


@inlined
def differentiate(flow: Flow, model: Model, slot: int, z: Array, work: Array, known: int) -> None:
    """Put behind a state its accelerations, unless they are known, and their derivatives with respect to tau.

    The derivatives of a system without tables for whole steps come from its series.
    """
    columns = flow.rates_constant.shape[1]
    points = model.first_velocity
    if flow.stepping:
        combine(flow.derivative, flow.derivative_constant, slot, z, columns, work)
        for i in range(points if known != STALE else 0, 2 * points):
            z[columns + i] = work[i]
        return
    for i in range(points, 2 * points):
        rate = flow.rates_constant[slot, i]
        for entry in range(flow.pointer[i], flow.pointer[i + 1]):
            rate += flow.rates[slot, entry] * z[flow.column[entry]]
        z[columns + i - points] = rate


@inlined
def _above_margins(
    model: Model, state: State, margin: Array, z: Array, columns: int, duration: float
) -> bool:
    """Whether every guard lies above its margin at a state with its accelerations, `duration` from now."""
    for j in range(model.mass.shape[0]):
        if state.mode[j] == FLIGHT:
            height = state.height[j] + duration * (state.speed[j] - 0.5 * model.gravity * duration)
            gap = height - z[model.position[j]]
            lowest = min(gap, model.clearance[j] - gap) - 2 * ROUNDING * abs(height)
        else:
            lowest = model.gravity + z[columns + model.position[j]]
            if state.mode[j] != FLOOR:
                lowest = -lowest
        if not lowest > margin[j]:
            return False
    return True


@inlined
def _draw_envelope(flow: Flow, slot: int, z: Array, scratch: Scratch) -> None:
    """Widen the envelope around a state, and fit the margins to it and to the configuration."""
    columns = flow.rates_constant.shape[1]
    for i in range(columns):
        scratch.envelope[i] = max(scratch.envelope[i], WIDER * abs(z[i]))
    combine(flow.margin, flow.margin_constant, slot, scratch.envelope, columns, scratch.margin)


@inlined
def fold_envelope(flow: Flow, scratch: Scratch) -> None:
    """Begin the envelope anew."""
    for i in range(flow.rates_constant.shape[1]):
        scratch.envelope[i] = 0.0


@inlined
def _bound_by_tables(flow: Flow, slot: int, z: Array, scratch: Scratch) -> None:
    """Bounds of the guards over the step, from the tables."""
    for i in range(scratch.size.shape[0]):
        scratch.size[i] = abs(z[i])
    combine(flow.bound, flow.bound_constant, slot, scratch.size, flow.rates_constant.shape[1], scratch.bound)


@compiled
def _bound_by_series(
    model: Model, mode: Array, tableau: Array, length: float, z: Array, new: Array, behind: int, bound: Array
) -> None:
    """Bounds of the guards over the step, and behind both states what riding dampers need, from the series itself."""
    dampers, points = model.mass.shape[0], model.first_velocity
    for j in range(dampers):
        rides = mode[j] != FLIGHT
        row = model.velocity[j] if rides else model.position[j]
        place = behind + model.position[j]
        shift = 1 if rides else 0
        end = 0.0
        slope = 0.0
        fourth = 0.0
        size = 0.0
        for k in range(LENGTH - 1 - shift, -1, -1):
            # The acceleration's series is (k + 1) tableau[k + 1] / h.
            term = tableau[k + 1, row] * (k + 1) / model.step if rides else tableau[k, row]
            slope = slope * length + end
            end = end * length + term
            fourth += k * (k - 1) * (k - 2) * (k - 3) * abs(term)
            size += abs(term)
            if rides and k <= 1:
                z[place + k * points] = term
        if rides:
            new[place] = end
            new[place + points] = slope
        bound[j] = fourth
        bound[dampers + j] = size


@inlined
def _sum_series(scratch: Scratch, tau: float, out: Array) -> None:
    """State at the fraction tau of the step: the tableau's rows times the powers of tau."""
    powers = scratch.powers
    square = tau * tau
    powers[0] = 1.0
    powers[1] = tau
    for k in range(2, LENGTH + 1, 2):
        powers[k] = powers[k - 2] * square
    for k in range(3, LENGTH + 1, 2):
        powers[k] = powers[k - 2] * square
    combine(scratch.series_rows, scratch.nothing, 0, powers, LENGTH + 1, out)


@inlined
def _examine_flight(
    model: Model, state: State, scratch: Scratch, j: int, length: float, near_floor: bool, near_ceiling: bool
) -> tuple[float, int, int]:
    """First wall that damper j meets in flight, of those it may: (fraction of the step, wall, ambiguous)."""
    series = scratch.series
    row = model.position[j]
    flown = model.step * length
    power = 1.0
    for k in range(LENGTH):
        series[k] = -scratch.tableau[k, row] * power
        power *= length
    series[0] += state.height[j]
    series[1] += state.speed[j] * flown
    series[2] -= 0.5 * model.gravity * flown * flown
    size = abs(state.height[j]) + flown * (abs(state.speed[j]) + model.gravity * flown)
    size += scratch.bound[model.mass.shape[0] + j]
    tau = NONE
    wall = FLOOR_GAP
    ambiguous = 0
    if near_floor:
        tau, ambiguous = first_crossing(
            series,
            max(state.multiplicity[j], 0),
            ROUNDING * size,
            scratch.work,
            scratch.spans,
            scratch.bernstein,
        )
    if near_ceiling:
        clearance = model.clearance[j]
        for k in range(LENGTH):
            series[k] = -series[k]
        series[0] += clearance
        tau_ceiling, more = first_crossing(
            series,
            max(-state.multiplicity[j], 0),
            ROUNDING * (size + clearance),
            scratch.work,
            scratch.spans,
            scratch.bernstein,
        )
        ambiguous += more
        if tau_ceiling < tau:
            tau = tau_ceiling
            wall = CEILING_GAP
    return tau, wall, ambiguous


@inlined
def _examine_ride(
    flow: Flow, model: Model, state: State, scratch: Scratch, slot: int, j: int, length: float
) -> tuple[float, int]:
    """First instant at which the contact force of damper j falls through zero: (fraction of the step, ambiguous)."""
    series = scratch.series
    row = model.velocity[j]
    sign = 1.0 if state.mode[j] == FLOOR else -1.0
    power = sign / model.step
    for k in range(LENGTH):
        series[k] = (k + 1) * scratch.tableau[k + 1, row] * power
        power *= length
    series[0] += sign * model.gravity
    size = model.gravity + scratch.bound[model.mass.shape[0] + j]
    return first_crossing(
        series, np.int64(0), ROUNDING * size, scratch.work, scratch.spans, scratch.bernstein
    )


@inlined
def _margin(
    value: float, slope: float, value_new: float, slope_new: float, error: float, multiplicity: int
) -> float:
    """Positive if a guard with these values and slopes at both ends has no zero on (0, 1].

    The cubic Hermite interpolant differs from the guard by at most tau^2 (1 - tau)^2 / 24 times the bound
    `error` of its fourth derivative; its Bernstein coefficients bound it from below. A guard that starts as a
    double zero or higher has the first two coefficients zero, and tau^2 can be divided out.
    """
    inner = value_new - slope_new / 3.0
    end = value_new - error / 384.0
    if multiplicity >= 2:
        return min(inner - error / 72.0, end)
    return min(min(value, value + slope / 3.0), inner) - error / 384.0 if end > 0.0 else end


@inlined
def _first_event(
    flow: Flow,
    model: Model,
    state: State,
    scratch: Scratch,
    slot: int,
    length: float,
    duration: float,
    expanded: bool,
) -> tuple[float, int, int]:
    """Earliest event of the step over all guards that fail the Hermite test.

    Returns (fraction of `length` or NONE, damper, guard). The tableau is filled if anything is examined.
    """
    first = NONE
    which = -1
    what = 0
    behind = flow.rates_constant.shape[1]
    for j in range(model.mass.shape[0]):
        error = scratch.bound[j] * length**4
        mode = state.mode[j]
        multiplicity = 0
        near_ceiling = False
        if mode == FLIGHT:
            position, velocity = model.position[j], model.velocity[j]
            fall = model.gravity * duration
            value = state.height[j] - state.z[position]
            slope = (state.speed[j] - state.z[velocity]) * duration
            value_new = state.height[j] + duration * (state.speed[j] - 0.5 * fall) - scratch.new[position]
            slope_new = (state.speed[j] - fall - scratch.new[velocity]) * duration
            multiplicity = state.multiplicity[j]
            clearance = model.clearance[j]
            if clearance < np.inf:
                near_ceiling = (
                    _margin(
                        clearance - value, -slope, clearance - value_new, -slope_new, error, -multiplicity
                    )
                    <= 0.0
                )
        else:
            place = behind + model.position[j]
            value = model.gravity + state.z[place]
            value_new = model.gravity + scratch.new[place]
            slope = state.z[place + model.first_velocity] * length
            slope_new = scratch.new[place + model.first_velocity] * length
            if mode != FLOOR:
                value, slope, value_new, slope_new = -value, -slope, -value_new, -slope_new
        near = _margin(value, slope, value_new, slope_new, error, multiplicity) <= 0.0
        if not (near or near_ceiling):
            continue
        if not expanded:
            _expand(flow, model, slot, state.z, scratch.tableau)
            expanded = True
        if mode == FLIGHT:
            tau, guard, ambiguous = _examine_flight(model, state, scratch, j, length, near, near_ceiling)
        else:
            tau, ambiguous = _examine_ride(flow, model, state, scratch, slot, j, length)
            guard = CONTACT_FORCE
        state.counters[AMBIGUOUS] += ambiguous
        if tau < first:
            first = tau
            which = j
            what = guard
    return first, which, what


@inlined
def _fly(model: Model, state: State, duration: float) -> None:
    """Free flight of every damper in the air; the guards' multiplicities end with a motion of any length."""
    for j in range(model.mass.shape[0]):
        if state.mode[j] == FLIGHT:
            state.height[j] += duration * (state.speed[j] - 0.5 * model.gravity * duration)
            state.speed[j] -= model.gravity * duration
        state.multiplicity[j] = 0


@inlined
def advance(
    flow: Flow,
    model: Model,
    state: State,
    scratch: Scratch,
    log: Log,
    segment: int,
    steps: float,
    left: float,
    coupling: bool | None,
    known: int,
) -> tuple[int, float, int]:
    """Advance to the end of a segment of `steps` step lengths (a real number), or come back earlier.

    Parameters
    ----------
    segment : int
        Label for the log: events get it, and their time since the start of the segment in seconds.
    steps, left : float
        Step lengths in the segment, and how many of them are still to go. The times of events are made of both,
        so that they have the same bits wherever the kernel came back in between.
    coupling : bool or None
        None where the mass matrix couples no dampers at an impact.
    known : int
        STALE, CURRENT or CLEAR: what is known of the state.

    Returns
    -------
    status : int
        DONE, or NEED_TABLE / LOG_FULL / STUCK: call again with what is left when that is seen to.
    left : float
        Steps still to go.
    known : int
        Of the state now.
    """
    columns = flow.rates_constant.shape[1]
    has_room = columns + 2 * model.first_velocity <= flow.propagate_constant.shape[1]
    while left > 0.0:
        slot = state.counters[SLOT]
        if slot < 0:
            return NEED_TABLE, left, STALE
        length = min(left, 1.0)
        duration = length * model.step
        whole = flow.stepping and length == 1.0
        if whole:
            combine_many(flow.propagate, flow.propagate_constant, slot, state.z, columns, scratch.new)
            if (
                known == CLEAR
                and not exceeds(state.z, scratch.envelope)
                and _above_margins(model, state, scratch.margin, scratch.new, columns, duration)
            ):
                copy(scratch.new, state.z, 0)
                _fly(model, state, duration)
                left -= 1.0
                continue
        if (
            log.filled[0] + 4 * model.mass.shape[0] > log.segment.shape[0]
            or log.filled[1] == log.before.shape[0]
        ):
            return LOG_FULL, left, STALE
        if not whole:
            _expand(flow, model, slot, state.z, scratch.tableau)
            _sum_series(scratch, length, scratch.new)
        if flow.stepping:
            if known == STALE or not flow.smooth:
                differentiate(flow, model, slot, state.z, scratch.derivative, known)
            if not (whole and has_room):
                differentiate(flow, model, slot, scratch.new, scratch.derivative, CURRENT if whole else STALE)
            _bound_by_tables(flow, slot, state.z, scratch)
        else:
            _bound_by_series(
                model, state.mode, scratch.tableau, length, state.z, scratch.new, columns, scratch.bound
            )
        tau, j, guard = _first_event(flow, model, state, scratch, slot, length, duration, not whole)
        if tau == NONE:
            copy(scratch.new, state.z, 0)
            _fly(model, state, duration)
            state.counters[IN_A_ROW] = 0
            left -= length
            if flow.stepping and flow.smooth:
                known = CURRENT
            elif flow.stepping:
                if known == STALE or exceeds(state.z, scratch.envelope):
                    _draw_envelope(flow, slot, state.z, scratch)
                clear = _above_margins(model, state, scratch.margin, state.z, columns, 0.0)
                known = CLEAR if clear else CURRENT
            continue
        known = STALE
        if tau > 0.0:
            _sum_series(scratch, tau * length, scratch.new)
            copy(scratch.new, state.z, 0)
            _fly(model, state, tau * duration)
            left -= tau * length
            state.counters[IN_A_ROW] = 0
        else:
            state.counters[IN_A_ROW] += 1
            if state.counters[IN_A_ROW] > EVENTS_AT_ONE_INSTANT * model.mass.shape[0]:
                return STUCK, left, known
        offset = (steps - left) * model.step
        open_break(model, state, log, segment, offset)
        if guard == CONTACT_FORCE:
            separate(flow, model, state, log, segment, offset, j, 3)
        else:
            impact(flow, model, state, log, segment, offset, j, guard, scratch.contact, coupling)
        close_break(model, state, log)
    return DONE, 0.0, known
