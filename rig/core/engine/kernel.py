"""The kernel: compiled code that propagates a system through the regimes of its elements, such as flight and contact.

Between events the state z = (coordinates, velocities, coil current, drive) obeys z' = A z + b exactly, where A and b
depend on the configuration: which forces act in the elements. A full step of length h is one matrix product if its
matrix is tabulated; every other step is the sum of a power series. A guard is the distance of a signal, such as a gap
or a contact force, from a limit. Either every guard is proven free of zeros over the step
(`rig.core.engine.screening`), or the step ends at the first crossing (`rig.core.engine.guards`). Each proof is
rigorous, so the motion does not depend on which proof succeeded.

Terms:

- event: change of the regime of one element; discontinuity: instant at which velocities or accelerations jump;
- segment: time interval under one drive, such as a sample interval (`rig.core.engine.propagator`);
- envelope: upper bound of the magnitude of each state, for which the margins are valid;
- margin of a signal: a signal inside its limits by its margin at both ends of a full step reaches no limit in it;
- status: which quantities of the present state are already computed (`rig.core.engine.power_series`).

All numbers are float64, and no memory is allocated. The tables are described in `rig.core.engine.flow` and
`rig.core.engine.law_tables`, the ends of regimes in `rig.core.engine.resets`. The compile time is proportional to the
code. Inlined functions therefore have a single call site, and functions get only the arrays that they need: numba
passes each array as seven or more values.
"""

from __future__ import annotations

from rig.core.engine.flow import Flow, Model
from rig.core.engine.guards import bound_by_series, bound_by_tables, first_event
from rig.core.engine.law_tables import ELEMENT, FLIES, Signals
from rig.core.engine.power_series import (
    ABOVE_MARGINS,
    CONTACTS_UNCHECKED,
    STATE_ONLY,
    WITH_ACCELERATIONS,
    expand_state,
    store_accelerations,
    sum_state_series,
)
from rig.core.engine.resets import SEPARATION_MULTIPLICITY, change_force, impact, separate, separate_tensile
from rig.core.engine.screening import inside_margins, screen, widen_envelope
from rig.core.engine.state import (
    EVENTS_AT_INSTANT,
    N_DISCONTINUITIES,
    N_EVENTS,
    PRESENT_SEGMENT,
    TABLE_INDEX,
    Log,
    State,
    close_discontinuity,
    load_signals,
    open_discontinuity,
    regime_number,
)
from rig.core.engine.workspace import Workspace
from rig.core.laws.events import NO_EVENT
from rig.core.numerics.bernstein import NO_CROSSING
from rig.core.numerics.jit import inlined_kernel
from rig.core.numerics.simd import affine_product_many, copy, exceeds, unsigned

#: Why `advance` returned: segment completed; tables of the configuration missing; log full; too many events at one
#: instant.
DONE, TABLES_MISSING, LOG_FULL, STUCK = 0, 1, 2, 3
#: Maximum number of events at one instant, per element; a larger number contradicts its law.
MAX_EVENTS_AT_INSTANT = 100
#: Number of events at one instant, per element, after which each event halves the step. A shorter step resolves a
#: motion that is smaller than the rounding errors of a longer step.
STEP_HALVING_EVENTS = 8
#: What remains to be done after an event: nothing; complete the discontinuity in the log (`_CLOSE_DISCONTINUITY`); or,
#: before this completion, separate the masses with a tensile contact force (`_SEPARATE_TENSILE`).
_NOTHING, _CLOSE_DISCONTINUITY, _SEPARATE_TENSILE = 0, 1, 2


@inlined_kernel
def _advance_flights(gravity: float, state: State, signals: Signals, duration: float) -> None:
    """Propagate every flying detached mass by a duration, s, and reset the multiplicities of all signals."""
    for slot in range(signals.row.shape[0]):
        row = unsigned(signals.row[slot])
        if signals.numbers[row, FLIES] > 0.0:
            j = unsigned(signals.indices[row, ELEMENT])
            state.height[j] += duration * (state.velocity[j] - 0.5 * gravity * duration)
            state.velocity[j] -= gravity * duration
        state.multiplicity[slot] = 0


@inlined_kernel
def advance(
    flow: Flow, model: Model, state: State, workspace: Workspace, log: Log, segment: int, steps: float,
    remaining: float, status: int, accelerations: bool,
) -> tuple[int, float, int]:  # fmt: skip
    """Propagate to the end of a segment, or return earlier if the caller must act.

    `segment`: number of the segment, for the log. `steps`, `remaining`: duration of the segment and of its part still
    to be propagated, in step lengths (not necessarily integers). Event times are computed from these two alone, so that
    they are bitwise identical however often the kernel returns within the segment. `status`: `CONTACTS_UNCHECKED`,
    `STATE_ONLY` (no accelerations), `WITH_ACCELERATIONS`, or `ABOVE_MARGINS` (with accelerations, and every signal
    inside its margins). `accelerations`: whether the accelerations at the end are needed; they are stored after the
    state.

    Returns (reason, remaining, status). `reason`: `DONE`, `TABLES_MISSING`, `LOG_FULL` or `STUCK`. After missing tables
    are computed or the log is enlarged, call again with the remaining steps.
    """
    columns = flow.rates_constant.shape[1]  # number of states, including the drive
    elements, signals = model.laws.elements.shape[0], workspace.signals
    # Whether a full step also computes the derivatives of the accelerations.
    has_derivatives = columns + 2 * model.first_velocity <= flow.step_matrix_constant.shape[1]
    pending = _NOTHING
    if status == CONTACTS_UNCHECKED:
        pending = _SEPARATE_TENSILE
    while True:
        if pending != _NOTHING:
            if pending == _SEPARATE_TENSILE:
                separate_tensile(flow.after, model, state, log, workspace.contact)
            if status != CONTACTS_UNCHECKED:
                close_discontinuity(model, state, log)
            pending = _NOTHING
            status = STATE_ONLY
        finished = remaining <= 0.0
        if finished and not (accelerations and status == STATE_ONLY):
            return DONE, 0.0, status
        table_index = state.counters[TABLE_INDEX]
        if table_index < 0:
            return TABLES_MISSING, remaining, STATE_ONLY
        if status <= STATE_ONLY:
            load_signals(model.laws, state.regime, signals.row)
        length = min(remaining, 1.0)
        halvings = state.counters[EVENTS_AT_INSTANT] - STEP_HALVING_EVENTS * elements
        if halvings > 0:
            length *= 0.5**halvings
        duration = length * model.step
        full_step = flow.has_step_matrix and length == 1.0
        if full_step:
            padded_columns = flow.step_matrix.shape[1]
            affine_product_many(
                flow.step_matrix, flow.step_matrix_constant, table_index, state.z, padded_columns, workspace.end_state
            )
            if (
                status == ABOVE_MARGINS
                and not exceeds(state.z, workspace.envelope)
                and inside_margins(model.gravity, state, signals, workspace.end_state, duration)
            ):
                copy(workspace.end_state, state.z)
                _advance_flights(model.gravity, state, signals, duration)
                remaining -= 1.0
                continue
        if not finished and (
            log.counts[N_EVENTS] + 4 * elements > log.events.shape[0]
            or log.counts[N_DISCONTINUITIES] == log.discontinuities.shape[0]
        ):
            return LOG_FULL, remaining, STATE_ONLY
        if finished or (flow.has_step_matrix and (status == STATE_ONLY or not flow.drive_is_smooth)):
            store_accelerations(flow, model.first_velocity, table_index, state.z, workspace.derivative, status)
        if finished:
            return DONE, 0.0, STATE_ONLY
        if not full_step:
            expand_state(flow, model.step, table_index, state.z, workspace.state_series)
            sum_state_series(workspace, length, workspace.end_state)
        if flow.has_step_matrix:
            # After a full step the accelerations at its end are known, but their derivatives only with
            # `has_derivatives`.
            if not (full_step and has_derivatives):
                end_status = WITH_ACCELERATIONS if full_step else STATE_ONLY
                store_accelerations(
                    flow, model.first_velocity, table_index, workspace.end_state, workspace.derivative, end_status
                )
            bound_by_tables(flow, table_index, state.z, workspace)
        else:
            bound_by_series(
                model, signals, workspace.state_series, length, state.z, workspace.end_state, workspace.bound
            )
        unproven_low, unproven_high = screen(model.gravity, state, workspace, length, duration)
        if full_step and unproven_low | unproven_high != 0:
            expand_state(flow, model.step, table_index, state.z, workspace.state_series)
        tau, slot, end = first_event(model, state, workspace, length, unproven_low, unproven_high)
        if tau == NO_CROSSING:
            copy(workspace.end_state, state.z)
            _advance_flights(model.gravity, state, signals, duration)
            state.counters[EVENTS_AT_INSTANT] = 0
            remaining -= length
            if flow.has_step_matrix and not flow.uses_envelope:
                status = WITH_ACCELERATIONS
            elif flow.has_step_matrix:
                if status == STATE_ONLY or exceeds(state.z, workspace.envelope):
                    widen_envelope(flow, table_index, state.z, workspace)
                is_inside = inside_margins(model.gravity, state, signals, state.z, 0.0)
                status = ABOVE_MARGINS if is_inside else WITH_ACCELERATIONS
            continue
        status = STATE_ONLY
        if tau > 0.0:
            sum_state_series(workspace, tau * length, workspace.end_state)
            copy(workspace.end_state, state.z)
            _advance_flights(model.gravity, state, signals, tau * duration)
            remaining -= tau * length
            state.counters[EVENTS_AT_INSTANT] = 0
        else:
            state.counters[EVENTS_AT_INSTANT] += 1
            if state.counters[EVENTS_AT_INSTANT] > MAX_EVENTS_AT_INSTANT * elements:
                return STUCK, remaining, status
        log.counts[PRESENT_SEGMENT] = segment
        log.present_offset[0] = (steps - remaining) * model.step
        j = unsigned(signals.indices[unsigned(signals.row[slot]), ELEMENT])
        m = regime_number(model.laws.elements, state.regime, j)
        x = unsigned(model.laws.transition[m, slot - model.laws.elements[j].first_slot, end])
        if model.laws.transitions[x].event != NO_EVENT:
            open_discontinuity(model, state, log)
            pending = _CLOSE_DISCONTINUITY
        if model.laws.transitions[x].restitution >= 0.0:
            impact(flow.after, model, state, log, j, m, x, end, workspace.contact)
            pending = _SEPARATE_TENSILE
        elif model.laws.regimes[m].is_held:
            separate(flow.after, model, state, log, j, m, end, SEPARATION_MULTIPLICITY)
        else:
            change_force(flow.after, model, state, log, j, x)
            if model.laws.transitions[x].event != NO_EVENT:
                # The gap differs in order of magnitude between contact and flight.
                gap = model.laws.elements[j].gap_coordinate
                workspace.envelope[gap] = workspace.envelope[model.first_velocity + gap] = 0.0
                if model.coupled:
                    pending = _SEPARATE_TENSILE
