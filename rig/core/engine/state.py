"""State of a system in motion, which the kernel updates, and the log of events and discontinuities.

An event is a change of the regime of one element, such as the bed of a damper. A discontinuity is an instant at which
velocities or accelerations jump. The configuration specifies which forces act in the elements. A segment is a time
interval under one drive, such as a sample interval.
"""

from typing import NamedTuple

import numpy as np

from rig.core.engine.flow import Model
from rig.core.engine.law_tables import Ints, LawTables, Records
from rig.core.numerics.jit import inlined_kernel
from rig.core.numerics.simd import aligned_zeros, unsigned
from rig.core.system.hybrid_system import HybridSystem

#: Entries of `State.counters`: index of the configuration's tables in `Flow` (-1: not yet computed), the configuration,
#: the number of events at the present instant, and the number of decisions so far that depended on rounding.
TABLE_INDEX, CONFIGURATION, EVENTS_AT_INSTANT, AMBIGUOUS_CROSSINGS = 0, 1, 2, 3
#: Entries of `Log.counts`: numbers of events and of discontinuities, and the segment of the present instant.
N_EVENTS, N_DISCONTINUITIES, PRESENT_SEGMENT = 0, 1, 2


class State(NamedTuple):
    """State of a system in motion; every field is an array, so that the kernel can update it.

    `z`: coordinates, velocities, further states and drive states in SI units, padded; accelerations may follow.
    `height`, `velocity`: position and velocity of each flying detached mass, m and m/s. `regime`: of each element, in
    the order of `Law.regimes`.

    `multiplicity[slot]` is the number of leading terms of the power series of a signal minus its limit that are exactly
    zero at this instant: 1 after a rebound, 2 after a separation under tension, 3 after a separation at zero contact
    force. The value is negative for the upper limit.
    """

    z: np.ndarray
    height: np.ndarray
    velocity: np.ndarray
    regime: np.ndarray
    multiplicity: np.ndarray
    counters: np.ndarray


#: Fields of a logged event. damper: number of the element, from 0. speed: closing speed [m/s].
EVENT_FIELDS = np.dtype(
    [("segment", np.int64), ("offset", np.float64), ("damper", np.int64), ("kind", np.int64), ("speed", np.float64)]
)
#: Fields of a logged discontinuity.
DISCONTINUITY_FIELDS = np.dtype([("segment", np.int64), ("offset", np.float64)])
#: Index of the state before and after a discontinuity.
BEFORE, AFTER = 0, 1


class Log(NamedTuple):
    """Events and discontinuities in chronological order, one row each.

    The time of an event or discontinuity is the number of its segment, and an offset, the time after the segment's
    start [s]. `present_offset`: the offset of the present instant. `events`, `discontinuities`: records
    (`EVENT_FIELDS`, `DISCONTINUITY_FIELDS`). `state`, `damper_velocity` [m/s], `configuration`: before and after each
    discontinuity, shape (discontinuities, 2, ...).
    """

    counts: np.ndarray
    present_offset: np.ndarray
    events: Records
    discontinuities: Records
    state: np.ndarray
    damper_velocity: np.ndarray
    configuration: np.ndarray


def state_at_rest(system: HybridSystem, size: int, slots: int) -> State:
    """Return the state of a system at rest, with every element in the regime at its start.

    `size`: padded length of `z`; `slots`: number of slots of `rig.core.engine.law_tables.Signals`.
    """
    laws = [element.law for element in system.elements]
    state = State(
        z=aligned_zeros(size),
        height=np.zeros(len(laws)),
        velocity=np.zeros(len(laws)),
        regime=np.array([list(law.regimes).index(law.start) for law in laws], dtype=np.int64),
        multiplicity=np.zeros(slots, dtype=np.int64),
        counters=np.zeros(4, dtype=np.int64),
    )
    state.counters[CONFIGURATION] = system.start
    return state


def empty_log(rows: int, size: int, dampers: int) -> Log:
    """Return a log with room for events and discontinuities; `size` is the number of states, with the drive."""
    return Log(
        counts=np.zeros(3, dtype=np.int64),
        present_offset=np.zeros(1),
        events=np.zeros(rows, dtype=EVENT_FIELDS).view(np.recarray),
        discontinuities=np.zeros(rows, dtype=DISCONTINUITY_FIELDS).view(np.recarray),
        state=np.zeros((rows, 2, size)),
        damper_velocity=np.zeros((rows, 2, dampers)),
        configuration=np.zeros((rows, 2), dtype=np.int64),
    )


@inlined_kernel
def log_event(log: Log, damper: int, kind: int, closing_speed: float) -> None:
    """Log an event of the present instant."""
    event = log.events[unsigned(log.counts[N_EVENTS])]
    event.segment = log.counts[PRESENT_SEGMENT]
    event.offset = log.present_offset[0]
    event.damper = damper
    event.kind = kind
    event.speed = max(closing_speed, 0.0)
    log.counts[N_EVENTS] += 1


@inlined_kernel
def regime_number(elements: Records, regime: Ints, j: int) -> int:
    """Return the number of the present regime of element j in the tables of the laws; `regime`: see `State`."""
    return unsigned(elements[j].first_regime + regime[j])


@inlined_kernel
def change_regime(after: Ints, laws: LawTables, state: State, j: int, present: int, regime: int) -> None:
    """Change the regime of element j, which has the number `present`: update the configuration and its table index.

    `after`: see `Flow`.
    """
    m = unsigned(laws.elements[j].first_regime + regime)
    force_change = laws.regimes[m].force_index - laws.regimes[present].force_index
    state.regime[j] = regime
    state.counters[CONFIGURATION] += laws.elements[j].stride * force_change
    if force_change != 0 and state.counters[TABLE_INDEX] >= 0:
        state.counters[TABLE_INDEX] = after[unsigned(state.counters[TABLE_INDEX]), m]


@inlined_kernel
def load_signals(laws: LawTables, regime: Ints, rows: Ints) -> None:
    """Set the rows of the signals of the present regimes (`State.regime`)."""
    for j in range(unsigned(laws.elements.shape[0])):
        element, row = laws.elements[j], regime_number(laws.elements, regime, j) * unsigned(laws.numbers.shape[1])
        for k in range(element.slots):
            rows[element.first_slot + k] = row + k


@inlined_kernel
def _store_side(model: Model, state: State, log: Log, side: int) -> None:
    """Store the present state, configuration and damper velocities as `BEFORE` or `AFTER` the present discontinuity."""
    row = unsigned(log.counts[N_DISCONTINUITIES])
    velocity = log.damper_velocity[row, side]
    for j in range(unsigned(velocity.shape[0])):
        element = model.laws.elements[j]
        velocity[j] = state.z[element.velocity_index]
        if element.gap_coordinate >= 0:
            velocity[j] += state.z[model.first_velocity + element.gap_coordinate]
        elif model.laws.regimes[regime_number(model.laws.elements, state.regime, j)].flies > 0.0:
            velocity[j] = state.velocity[j]
    log.configuration[row, side] = state.counters[CONFIGURATION]
    for i in range(log.state.shape[2]):
        log.state[row, side, i] = state.z[i]


@inlined_kernel
def open_discontinuity(model: Model, state: State, log: Log) -> None:
    """Log a discontinuity of the present instant: the state before the contacts change."""
    present = log.discontinuities[unsigned(log.counts[N_DISCONTINUITIES])]
    present.segment = log.counts[PRESENT_SEGMENT]
    present.offset = log.present_offset[0]
    _store_side(model, state, log, BEFORE)


@inlined_kernel
def close_discontinuity(model: Model, state: State, log: Log) -> None:
    """Complete the discontinuity that `open_discontinuity` has begun: log the state after the contacts have changed."""
    _store_side(model, state, log, AFTER)
    log.counts[N_DISCONTINUITIES] += 1
