"""State of a system in motion, which the kernel updates, and the log of events and breaks.

An event is a change of the mode of one element, such as the bed of a damper. A break is an instant at which velocities
or accelerations jump. The configuration specifies which forces act in the elements. A segment is a time interval under
one drive, such as a sample interval.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rig.core.base.arrays import Array
from rig.core.engine.flow import Flow, Model
from rig.core.engine.law_tables import ELEMENT, MODE, Signals
from rig.core.numerics.jit import inlined_kernel
from rig.core.numerics.simd import aligned_zeros, unsigned
from rig.core.system.hybrid_system import HybridSystem

#: Entries of `State.counters`: index of the configuration's tables in `Flow` (-1: not yet computed), the configuration,
#: the number of events at the present instant, and the number of decisions so far that depended on rounding.
TABLE_INDEX, CONFIGURATION, EVENTS_AT_INSTANT, AMBIGUOUS_CROSSINGS = 0, 1, 2, 3
#: Entries of `Log.counts`: numbers of events and of breaks, and the segment of the present instant.
N_EVENTS, N_BREAKS, PRESENT_SEGMENT = 0, 1, 2


class State(NamedTuple):
    """State of a system in motion; every field is an array, so that the kernel can update it.

    `z`: coordinates, velocities, further states and drive states in SI units, padded; accelerations may follow.
    `height`, `velocity`: position and velocity of each flying detached mass, m and m/s. `mode`: of each element, in the
    order of `Law.modes`.

    `multiplicity[lane]` is the number of leading terms of the power series of a signal minus its limit that are exactly
    zero at this instant: 1 after a rebound, 2 after a separation under tension, 3 after a separation at zero contact
    force. The value is negative for the upper limit.
    """

    z: np.ndarray
    height: np.ndarray
    velocity: np.ndarray
    mode: np.ndarray
    multiplicity: np.ndarray
    counters: np.ndarray


class Log(NamedTuple):
    """Events and breaks in chronological order, one row each.

    The time of an event or break is the number of its segment, and an offset, the time after the segment's start, s.
    `present_offset`: the offset of the present instant. `event_damper`: number of the element, from 0. `event_speed`:
    closing speed, m/s.

    A break is logged with the state, the velocities of the dampers (m/s) and the configuration before and after it.
    """

    counts: np.ndarray
    present_offset: np.ndarray
    event_segment: np.ndarray
    event_offset: np.ndarray
    event_damper: np.ndarray
    event_kind: np.ndarray
    event_speed: np.ndarray
    break_segment: np.ndarray
    break_offset: np.ndarray
    state_before: np.ndarray
    state_after: np.ndarray
    damper_velocity_before: np.ndarray
    damper_velocity_after: np.ndarray
    configuration: np.ndarray


def state_at_rest(system: HybridSystem, size: int, lanes: int) -> State:
    """Return the state of a system at rest, with every element in the mode at its start.

    `size`: padded length of `z`; `lanes`: number of lanes of `rig.core.engine.law_tables.Signals`.
    """
    laws = [element.law for element in system.elements]
    state = State(
        z=aligned_zeros(size),
        height=np.zeros(len(laws)),
        velocity=np.zeros(len(laws)),
        mode=np.array([list(law.modes).index(law.start) for law in laws], dtype=np.int64),
        multiplicity=np.zeros(lanes, dtype=np.int64),
        counters=np.zeros(4, dtype=np.int64),
    )
    state.counters[CONFIGURATION] = system.start
    return state


def empty_log(rows: int, size: int, dampers: int) -> Log:
    """Return a log with room for a number of events and breaks; `size` is the number of states, with the drive."""
    return Log(
        counts=np.zeros(3, dtype=np.int64),
        present_offset=np.zeros(1),
        event_segment=np.zeros(rows, dtype=np.int64),
        event_offset=np.zeros(rows),
        event_damper=np.zeros(rows, dtype=np.int64),
        event_kind=np.zeros(rows, dtype=np.int64),
        event_speed=np.zeros(rows),
        break_segment=np.zeros(rows, dtype=np.int64),
        break_offset=np.zeros(rows),
        state_before=np.zeros((rows, size)),
        state_after=np.zeros((rows, size)),
        damper_velocity_before=np.zeros((rows, dampers)),
        damper_velocity_after=np.zeros((rows, dampers)),
        configuration=np.zeros((rows, 2), dtype=np.int64),
    )


@inlined_kernel
def log_event(log: Log, damper: int, kind: int, closing_speed: float) -> None:
    """Log an event of the present instant."""
    row = log.counts[N_EVENTS]
    log.event_segment[row] = log.counts[PRESENT_SEGMENT]
    log.event_offset[row] = log.present_offset[0]
    log.event_damper[row] = damper
    log.event_kind[row] = kind
    log.event_speed[row] = max(closing_speed, 0.0)
    log.counts[N_EVENTS] = row + 1


@inlined_kernel
def mode_number(model: Model, state: State, j: int) -> int:
    """Return the number of the present mode of element j in the tables of the laws."""
    return unsigned(model.laws.first_mode[j] + state.mode[j])


@inlined_kernel
def change_mode(flow: Flow, model: Model, state: State, j: int, mode: int) -> None:
    """Change the mode of element j: update the configuration and its table index."""
    before, after = mode_number(model, state, j), unsigned(model.laws.first_mode[j] + mode)
    force_change = model.laws.force_index[after] - model.laws.force_index[before]
    state.mode[j] = mode
    state.counters[CONFIGURATION] += model.laws.stride[j] * force_change
    if force_change != 0 and state.counters[TABLE_INDEX] >= 0:
        state.counters[TABLE_INDEX] = flow.after[state.counters[TABLE_INDEX], after]


@inlined_kernel
def load_signals(model: Model, state: State, signals: Signals) -> None:
    """Copy the signals of new modes from the tables of the laws."""
    laws = model.laws
    for lane in range(signals.indices.shape[0]):
        j = unsigned(signals.indices[lane, ELEMENT])
        m, k = mode_number(model, state, j), lane - laws.first_lane[j]
        if unsigned(signals.indices[lane, MODE]) != m:
            for column in range(signals.indices.shape[1]):
                signals.indices[lane, column] = laws.indices[m, k, column]
            for column in range(signals.numbers.shape[1]):
                signals.numbers[lane, column] = laws.numbers[m, k, column]


@inlined_kernel
def _store_damper_velocities(model: Model, state: State, out: Array) -> None:
    """Store the velocity of each damper in `out`, m/s, positive upwards."""
    for j in range(out.shape[0]):
        out[j] = state.z[unsigned(model.velocity_index[j])]
        if model.gap_coordinate[j] >= 0:
            out[j] += state.z[model.first_velocity + model.gap_coordinate[j]]
        elif model.laws.flies[mode_number(model, state, j)] > 0.0:
            out[j] = state.velocity[j]


@inlined_kernel
def open_break(model: Model, state: State, log: Log) -> None:
    """Log a break of the present instant: the state before the contacts change."""
    row = log.counts[N_BREAKS]
    _store_damper_velocities(model, state, log.damper_velocity_before[row])
    log.break_segment[row] = log.counts[PRESENT_SEGMENT]
    log.break_offset[row] = log.present_offset[0]
    log.configuration[row, 0] = state.counters[CONFIGURATION]
    for i in range(log.state_before.shape[1]):
        log.state_before[row, i] = state.z[i]


@inlined_kernel
def close_break(model: Model, state: State, log: Log) -> None:
    """Complete the break that `open_break` has begun: log the state after the contacts have changed."""
    row = log.counts[N_BREAKS]
    _store_damper_velocities(model, state, log.damper_velocity_after[row])
    log.configuration[row, 1] = state.counters[CONFIGURATION]
    for i in range(log.state_after.shape[1]):
        log.state_after[row, i] = state.z[i]
    log.counts[N_BREAKS] = row + 1
