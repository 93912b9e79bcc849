"""The kernel: it propagates a compiled system through flights, contacts and impacts.

Between contact changes the state z = (coordinates, velocities, coil current, drive) obeys z' = A z + b exactly,
with A and b of the contact configuration. A step of length h is a matrix product. Every guard (gap, contact force) is
proven free of zeros over the step (`rig.engine.screening`), or its first crossing is isolated (`rig.engine.guards`)
and the step ends there. Each proof is rigorous, so the motion does not depend on which proof succeeded.

All numbers are float64, and no memory is allocated. The tables are described in `rig.engine.flow`, the contact laws in
`rig.engine.contact`. Inlined functions have a single call site, because the compile time is proportional to the code.
"""

from __future__ import annotations

from rig.engine.contact import impact, release_tensile, separate
from rig.engine.finite_contact import FREE, change_contact
from rig.engine.flow import Flow, Model
from rig.engine.guards import bound_by_series, bound_by_tables, first_event
from rig.engine.power_series import CLEAR, CURRENT, STALE, UNSETTLED, differentiate, expand, sum_series
from rig.engine.screening import CONTACT_FORCE, above_margins, screen, widen_envelope
from rig.engine.state import EVENTS_IN_ROW, FLIGHT, SLOT, Log, State, close_break, open_break
from rig.engine.workspace import Workspace
from rig.numerics.bernstein import NO_CROSSING
from rig.numerics.jit import inlined_kernel
from rig.numerics.simd import combine_many, copy, exceeds

#: Reasons for which the kernel returns.
DONE, NEED_TABLE, LOG_FULL, STUCK = 0, 1, 2, 3
#: Largest number of events at one instant, per damper; more contradict the contact law.
MAX_EVENTS_AT_INSTANT = 100
#: Number of events at one instant, per damper, after which each event halves the step. A shorter step resolves a motion
#: that is below the rounding of a longer one.
STEP_HALVING_EVENTS = 8
#: Pending operations after the contacts of an instant have changed.
_NOTHING, _CLOSE_BREAK, _RELEASE = 0, 1, 2


@inlined_kernel
def _advance_flights(model: Model, state: State, duration: float) -> None:
    """Propagate every flying damper, and reset the multiplicities of all guards."""
    for j in range(model.mass.shape[0]):
        if state.mode[j] == FLIGHT and model.bed[j] < 0:
            state.height[j] += duration * (state.speed[j] - 0.5 * model.gravity * duration)
            state.speed[j] -= model.gravity * duration
        state.multiplicity[j] = 0


@inlined_kernel
def advance(
    flow: Flow,
    model: Model,
    state: State,
    workspace: Workspace,
    log: Log,
    segment: int,
    steps: float,
    remaining: float,
    status: int,
    accelerations: bool,
) -> tuple[int, float, int]:
    """Propagate to the end of a segment, or return earlier if the caller must act.

    `segment`: number of the segment, for the log.
    `steps`, `remaining`: step lengths in the segment (a real number), and those not yet done. The times of events are
    computed from both, so that they have the same bits wherever the kernel returned in between.
    `status`: `UNSETTLED`, `STALE`, `CURRENT` or `CLEAR` of the state.
    `accelerations`: whether the accelerations at the end are needed; they are stored after the state.

    Returns `reason`, `DONE`, or `NEED_TABLE`, `LOG_FULL`, `STUCK`: after the caller has acted, call again with the
    remaining steps; `remaining`; `status` of the state now.
    """
    columns = flow.rates_constant.shape[1]
    dampers = model.mass.shape[0]
    has_room = columns + 2 * model.first_velocity <= flow.propagate_constant.shape[1]
    pending = _NOTHING
    if status == UNSETTLED:
        pending = _RELEASE
    while True:
        if pending != _NOTHING:
            if pending == _RELEASE:
                release_tensile(flow, model, state, log, workspace.contact)
            if status != UNSETTLED:
                close_break(model, state, log)
            pending = _NOTHING
            status = STALE
        finished = remaining <= 0.0
        if finished and not (accelerations and status == STALE):
            return DONE, 0.0, status
        slot = state.counters[SLOT]
        if slot < 0:
            return NEED_TABLE, remaining, STALE
        length = min(remaining, 1.0)
        halvings = state.counters[EVENTS_IN_ROW] - STEP_HALVING_EVENTS * dampers
        if halvings > 0:
            length *= 0.5**halvings
        duration = length * model.step
        full_step = flow.stepping and length == 1.0
        if full_step:
            padded_columns = flow.propagate.shape[1]
            combine_many(flow.propagate, flow.propagate_constant, slot, state.z, padded_columns, workspace.new)
            if (
                status == CLEAR
                and not exceeds(state.z, workspace.envelope)
                and above_margins(model, state, workspace.margin, workspace.new, columns, duration)
            ):
                copy(workspace.new, state.z)
                _advance_flights(model, state, duration)
                remaining -= 1.0
                continue
        if not finished and (
            log.filled[0] + 4 * dampers > log.segment.shape[0] or log.filled[1] == log.before.shape[0]
        ):
            return LOG_FULL, remaining, STALE
        if finished:
            differentiate(flow, model, slot, state.z, workspace.derivative, STALE)
            return DONE, 0.0, STALE
        if not full_step:
            expand(flow, model, slot, state.z, workspace.tableau)
            sum_series(workspace, length, workspace.new)
        if flow.stepping:
            if status == STALE or not flow.smooth:
                differentiate(flow, model, slot, state.z, workspace.derivative, status)
            if not (full_step and has_room):
                differentiate(flow, model, slot, workspace.new, workspace.derivative, CURRENT if full_step else STALE)
            bound_by_tables(flow, slot, state.z, workspace)
        else:
            bound_by_series(
                model, state.mode, workspace.tableau, length, state.z, workspace.new, columns, workspace.bound
            )
        unproven, unproven_ceilings = screen(model, state, workspace, columns, length, duration)
        if full_step and unproven | unproven_ceilings != 0:
            expand(flow, model, slot, state.z, workspace.tableau)
        tau, j, guard = first_event(model, state, workspace, length, unproven, unproven_ceilings)
        if tau == NO_CROSSING:
            copy(workspace.new, state.z)
            _advance_flights(model, state, duration)
            state.counters[EVENTS_IN_ROW] = 0
            remaining -= length
            if flow.stepping and not flow.enveloping:
                status = CURRENT
            elif flow.stepping:
                if status == STALE or exceeds(state.z, workspace.envelope):
                    widen_envelope(flow, slot, state.z, workspace)
                clear = above_margins(model, state, workspace.margin, state.z, columns, 0.0)
                status = CLEAR if clear else CURRENT
            continue
        status = STALE
        if tau > 0.0:
            sum_series(workspace, tau * length, workspace.new)
            copy(workspace.new, state.z)
            _advance_flights(model, state, tau * duration)
            remaining -= tau * length
            state.counters[EVENTS_IN_ROW] = 0
        else:
            state.counters[EVENTS_IN_ROW] += 1
            if state.counters[EVENTS_IN_ROW] > MAX_EVENTS_AT_INSTANT * dampers:
                return STUCK, remaining, status
        log.filled[2] = segment
        log.now[0] = (steps - remaining) * model.step
        finite_contact = model.bed[j] >= 0
        if not (finite_contact and guard == FREE):
            open_break(model, state, log)
            pending = _CLOSE_BREAK
        if finite_contact:
            change_contact(flow, model, state, log, j, guard)
            if guard != FREE:
                # In contact the gap has another magnitude.
                workspace.envelope[model.bed[j]] = workspace.envelope[model.first_velocity + model.bed[j]] = 0.0
                if model.coupled:
                    pending = _RELEASE
        elif guard == CONTACT_FORCE:
            separate(flow, model, state, log, j, 3)
        else:
            impact(flow, model, state, log, j, guard, workspace.contact)
            pending = _RELEASE
