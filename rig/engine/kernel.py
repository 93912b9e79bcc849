"""The kernel: it advances a compiled system through flights, contacts and impacts.

Between contact changes the state z = (coordinates, velocities, coil current, drive) obeys z' = A z + b exactly,
with A and b of the contact configuration. A step of length h is a matrix product. Every guard (gap, contact force) is
proven free of zeros over the step (`rig.engine.screening`), or its first crossing is isolated (`rig.engine.guards`)
and the step ends there. Each proof is rigorous, so which of them succeeded has no influence on the motion.

Everything is float64 and allocates nothing; the tables come from `rig.engine.flow`, the contact laws from
`rig.engine.contact`. What is inlined here has one call site: compiling takes in proportion to the code.
"""

from __future__ import annotations

from rig.engine.contact import impact, release_tensile, separate
from rig.engine.flow import Flow, Model
from rig.engine.guards import bound_by_series, bound_by_tables, first_event
from rig.engine.lasting import FREE, change_lasting
from rig.engine.power_series import CLEAR, CURRENT, STALE, UNSETTLED, differentiate, expand, sum_series
from rig.engine.screening import CONTACT_FORCE, above_margins, draw_envelope, screen
from rig.engine.state import FLIGHT, IN_A_ROW, SLOT, Log, State, close_break, open_break
from rig.engine.workspace import Workspace
from rig.numerics.bernstein import NONE
from rig.numerics.jit import inlined
from rig.numerics.simd import combine_many, copy, exceeds

#: Why the kernel came back.
DONE, NEED_TABLE, LOG_FULL, STUCK = 0, 1, 2, 3
#: Events at one instant, per damper, beyond which the contact law is contradicted.
EVENTS_AT_ONE_INSTANT = 100
#: Events at one instant, per damper, from which each halves the step: a motion that rounding hides then shows itself.
MANY_AT_ONE_INSTANT = 8
#: What is left to do after the contacts of an instant have changed.
_NOTHING, _CLOSE_BREAK, _RELEASE = 0, 1, 2


@inlined
def _fly(model: Model, state: State, duration: float) -> None:
    """Free flight of every damper in the air; the guards' multiplicities end with a motion of any length."""
    for j in range(model.mass.shape[0]):
        if state.mode[j] == FLIGHT and model.bed[j] < 0:
            state.height[j] += duration * (state.speed[j] - 0.5 * model.gravity * duration)
            state.speed[j] -= model.gravity * duration
        state.multiplicity[j] = 0


@inlined
def advance(
    flow: Flow,
    model: Model,
    state: State,
    workspace: Workspace,
    log: Log,
    segment: int,
    steps: float,
    left: float,
    known: int,
    shown: bool,
) -> tuple[int, float, int]:
    """Advance to the end of a segment of `steps` step lengths (a real number), or come back earlier.

    `segment`: label for the log: events get it, and their time since the start of the segment in seconds; `steps`,
    `left`: step lengths in the segment, and those left. The times of events are computed from both, so that they
    have the same bits wherever the kernel came back in between; `known`: `UNSETTLED`, `STALE`, `CURRENT` or `CLEAR`:
    what is known of the state; `shown`: whether the accelerations at the end are needed, behind the state. Returns
    `status`, `DONE`, or `NEED_TABLE`, `LOG_FULL`, `STUCK`: call again with what is left when that is handled;
    `left`, step lengths left; `known`, what is known of the state now.
    """
    columns = flow.rates_constant.shape[1]
    dampers = model.mass.shape[0]
    has_room = columns + 2 * model.first_velocity <= flow.propagate_constant.shape[1]
    pending = _NOTHING
    if known == UNSETTLED:
        pending = _RELEASE
    while True:
        if pending != _NOTHING:
            if pending == _RELEASE:
                release_tensile(flow, model, state, log, workspace.contact)
            if known != UNSETTLED:
                close_break(model, state, log)
            pending = _NOTHING
            known = STALE
        finished = left <= 0.0
        if finished and not (shown and known == STALE):
            return DONE, 0.0, known
        slot = state.counters[SLOT]
        if slot < 0:
            return NEED_TABLE, left, STALE
        length = min(left, 1.0)
        repeated = state.counters[IN_A_ROW] - MANY_AT_ONE_INSTANT * dampers
        if repeated > 0:
            length *= 0.5**repeated
        duration = length * model.step
        whole = flow.stepping and length == 1.0
        if whole:
            filled = flow.propagate.shape[1]
            combine_many(flow.propagate, flow.propagate_constant, slot, state.z, filled, workspace.new)
            if (
                known == CLEAR
                and not exceeds(state.z, workspace.envelope)
                and above_margins(model, state, workspace.margin, workspace.new, columns, duration)
            ):
                copy(workspace.new, state.z)
                _fly(model, state, duration)
                left -= 1.0
                continue
        if not finished and (
            log.filled[0] + 4 * dampers > log.segment.shape[0] or log.filled[1] == log.before.shape[0]
        ):
            return LOG_FULL, left, STALE
        if finished:
            differentiate(flow, model, slot, state.z, workspace.derivative, STALE)
            return DONE, 0.0, STALE
        if not whole:
            expand(flow, model, slot, state.z, workspace.tableau)
            sum_series(workspace, length, workspace.new)
        if flow.stepping:
            if known == STALE or not flow.smooth:
                differentiate(flow, model, slot, state.z, workspace.derivative, known)
            if not (whole and has_room):
                differentiate(
                    flow, model, slot, workspace.new, workspace.derivative, CURRENT if whole else STALE
                )
            bound_by_tables(flow, slot, state.z, workspace)
        else:
            bound_by_series(
                model, state.mode, workspace.tableau, length, state.z, workspace.new, columns, workspace.bound
            )
        near, ceilings = screen(model, state, workspace, columns, length, duration)
        if whole and near | ceilings != 0:
            expand(flow, model, slot, state.z, workspace.tableau)
        tau, j, guard = first_event(model, state, workspace, length, near, ceilings)
        if tau == NONE:
            copy(workspace.new, state.z)
            _fly(model, state, duration)
            state.counters[IN_A_ROW] = 0
            left -= length
            if flow.stepping and not flow.enveloping:
                known = CURRENT
            elif flow.stepping:
                if known == STALE or exceeds(state.z, workspace.envelope):
                    draw_envelope(flow, slot, state.z, workspace)
                clear = above_margins(model, state, workspace.margin, state.z, columns, 0.0)
                known = CLEAR if clear else CURRENT
            continue
        known = STALE
        if tau > 0.0:
            sum_series(workspace, tau * length, workspace.new)
            copy(workspace.new, state.z)
            _fly(model, state, tau * duration)
            left -= tau * length
            state.counters[IN_A_ROW] = 0
        else:
            state.counters[IN_A_ROW] += 1
            if state.counters[IN_A_ROW] > EVENTS_AT_ONE_INSTANT * dampers:
                return STUCK, left, known
        log.filled[2] = segment
        log.now[0] = (steps - left) * model.step
        lasting = model.bed[j] >= 0
        if not (lasting and guard == FREE):
            open_break(model, state, log)
            pending = _CLOSE_BREAK
        if lasting:
            change_lasting(flow, model, state, log, j, guard)
            if guard != FREE:
                # The gap is of another size in contact.
                workspace.envelope[model.bed[j]] = workspace.envelope[model.first_velocity + model.bed[j]] = (
                    0.0
                )
                if model.coupled:
                    pending = _RELEASE
        elif guard == CONTACT_FORCE:
            separate(flow, model, state, log, j, 3)
        else:
            impact(flow, model, state, log, j, guard, workspace.contact)
            pending = _RELEASE
