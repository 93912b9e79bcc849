"""State of a system in motion, which the kernel updates, and its log of events and breaks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rig.arrays import Array
from rig.engine.flow import Flow, Model
from rig.numerics.jit import inlined_kernel
from rig.numerics.simd import aligned_zeros

#: Modes of a damper.
FLIGHT, FLOOR, CEILING = 0, 1, 2
#: Event kinds in the log.
SEPARATION, FLOOR_IMPACT, CEILING_IMPACT, FLOOR_TOUCH, CEILING_TOUCH, RELEASE = 0, 1, 2, 3, 4, 5
#: Entries of `State.counters`.
SLOT, CONFIGURATION, EVENTS_IN_ROW, AMBIGUOUS = 0, 1, 2, 3


class State(NamedTuple):
    """State of a system in motion; every field is an array, so that the kernel can update it.

    `multiplicity[j]` counts the leading coefficients of damper j's guard that are exactly zero at this instant:
    1 after a rebound, 2 after a release, 3 after a separation at zero contact force; negative for the ceiling.
    `recovering[j]` is the wall that has released a bed with finite-duration contact while they still overlap.
    """

    z: np.ndarray
    height: np.ndarray
    speed: np.ndarray
    mode: np.ndarray
    multiplicity: np.ndarray
    recovering: np.ndarray
    counters: np.ndarray


class Log(NamedTuple):
    """Events and breaks in chronological order.

    `filled`: number of events, number of breaks, and segment of the present instant. `now`: time of the present instant
    after the start of its segment, s.

    A break is an instant at which velocities or accelerations jump. It is logged with the state and the speeds of the
    dampers before and after it.
    """

    filled: np.ndarray
    now: np.ndarray
    segment: np.ndarray
    offset: np.ndarray
    damper: np.ndarray
    kind: np.ndarray
    closing: np.ndarray
    break_segment: np.ndarray
    break_offset: np.ndarray
    before: np.ndarray
    after: np.ndarray
    speed_before: np.ndarray
    speed_after: np.ndarray
    configuration: np.ndarray


def state_at_rest(size: int, dampers: int) -> State:
    """Return the state of a system at rest, with every damper on its floor; `size` is padded."""
    return State(
        z=aligned_zeros(size),
        height=np.zeros(dampers),
        speed=np.zeros(dampers),
        mode=np.full(dampers, FLOOR, dtype=np.int64),
        multiplicity=np.zeros(dampers, dtype=np.int64),
        recovering=np.zeros(dampers, dtype=np.int64),
        counters=np.zeros(4, dtype=np.int64),
    )


def empty_log(rows: int, size: int, dampers: int) -> Log:
    """Return a log with room for a number of rows."""
    return Log(
        filled=np.zeros(3, dtype=np.int64),
        now=np.zeros(1),
        segment=np.zeros(rows, dtype=np.int64),
        offset=np.zeros(rows),
        damper=np.zeros(rows, dtype=np.int64),
        kind=np.zeros(rows, dtype=np.int64),
        closing=np.zeros(rows),
        break_segment=np.zeros(rows, dtype=np.int64),
        break_offset=np.zeros(rows),
        before=np.zeros((rows, size)),
        after=np.zeros((rows, size)),
        speed_before=np.zeros((rows, dampers)),
        speed_after=np.zeros((rows, dampers)),
        configuration=np.zeros((rows, 2), dtype=np.int64),
    )


@inlined_kernel
def log_event(log: Log, damper: int, kind: int, closing: float) -> None:
    """Log an event of the present instant."""
    row = log.filled[0]
    log.segment[row] = log.filled[2]
    log.offset[row] = log.now[0]
    log.damper[row] = damper
    log.kind[row] = kind
    log.closing[row] = max(closing, 0.0)
    log.filled[0] = row + 1


@inlined_kernel
def toggle_contact(flow: Flow, model: Model, state: State, contact: int) -> None:
    """Open or close a contact: update the configuration, and the slot of its table."""
    state.counters[CONFIGURATION] ^= model.toggles[contact]
    if state.counters[SLOT] >= 0:
        state.counters[SLOT] = flow.neighbor[state.counters[SLOT], contact]


@inlined_kernel
def _damper_speeds(model: Model, state: State, out: Array) -> None:
    for j in range(model.mass.shape[0]):
        if model.bed[j] >= 0:
            out[j] = state.z[model.velocity[j]] + state.z[model.first_velocity + model.bed[j]]
        else:
            out[j] = state.speed[j] if state.mode[j] == FLIGHT else state.z[model.velocity[j]]


@inlined_kernel
def open_break(model: Model, state: State, log: Log) -> None:
    """Log the state before the contacts change."""
    row = log.filled[1]
    _damper_speeds(model, state, log.speed_before[row])
    log.break_segment[row] = log.filled[2]
    log.break_offset[row] = log.now[0]
    log.configuration[row, 0] = state.counters[CONFIGURATION]
    for i in range(state.z.shape[0]):
        log.before[row, i] = state.z[i]


@inlined_kernel
def close_break(model: Model, state: State, log: Log) -> None:
    """Log the state after the contacts have changed."""
    row = log.filled[1]
    _damper_speeds(model, state, log.speed_after[row])
    log.configuration[row, 1] = state.counters[CONFIGURATION]
    for i in range(state.z.shape[0]):
        log.after[row, i] = state.z[i]
    log.filled[1] = row + 1
