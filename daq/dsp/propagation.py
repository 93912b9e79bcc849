"""Exact propagation of a circuit from sample to sample, for an input of cubic pieces."""

from __future__ import annotations

from typing import NamedTuple

from daq.dsp.broken_intervals import PartWorkspace, part_workspace, through_parts
from daq.dsp.discretization import Tables
from daq.dsp.interpolation import CubicInput, copy_into
from daq.dsp.limiting import Limits, follow_closely, within
from rig.arrays import Array
from rig.numerics.fma import factored_sums, fused, weighted_sums
from rig.numerics.jit import unfused_kernel
from rig.numerics.simd import LANES, aligned_zeros

# Intervals processed at a time, a multiple of `SUM_BLOCK` (`rig.numerics.fma`): enough to keep a processor busy, few
# enough for its nearest cache.
STRETCH = 128


class CircuitWorkspace(NamedTuple):
    """Room to work in."""

    # Input, disturbances and states through a stretch; (4 + disturbances + states, intervals of a stretch and more).
    parts: PartWorkspace
    course: Array
    sizes: Array  # magnitudes of these
    sums: Array  # contributions to the states of a section; (2, intervals of a stretch)


def scratch_for(tables: Tables) -> CircuitWorkspace:
    """Make room to work in for a circuit."""
    # Rows a little longer than needed: for the state at the end, and because at powers of two they would compete for
    # the same lines of a cache.
    course, sizes = (aligned_zeros(tables.spread.shape[0], STRETCH + LANES) for _ in range(2))
    return CircuitWorkspace(part_workspace(tables.generator.shape[1]), course, sizes, aligned_zeros(2, STRETCH))


@unfused_kernel
def propagate(
    cubics: CubicInput,
    tables: Tables,
    limits: Limits | None,
    state: Array,  # (states,) at the last sample; updated
    disturbances: Array,  # disturbances, V; (disturbances, intervals)
    rows: Array,  # outputs at the samples, from state, input and excess over the limit
    rows_input: Array,
    rows_excess: Array,
    points: Array,  # these outputs, (outputs, intervals)
    averages: Array,  # moments of the output, (intervals + SUMS_AT_ONCE or 0, LANES)
    overload: Array,  # 0, or 1 + remaining shift of zero / limit; the last of the previous block first
    scratch: CircuitWorkspace,
) -> None:
    """Propagate a circuit over the intervals of a block, and fill in points, averages and overload.

    Stretches without breaks are processed section by section, as each section only depends on those before it:
    all but a section's own recurrence is then the same sum for many samples at a time. The order of every sum is
    fixed, so that no result depends on where a stretch or a block ends. Intervals in which a limit may be
    reached, and the next intervals after an overload, are processed one by one (`daq.dsp.limiting`).
    """
    course = scratch.course
    behind = 4 + disturbances.shape[0]
    part, first, intervals = 0, 0, cubics.smooth.shape[1]
    while first < intervals:
        overload[1 + first] = 0.0
        broken = part < cubics.broken.size and cubics.broken[part] == first
        # A circuit without limits is compiled without their code.
        close = False
        if limits is not None:
            close = broken or overload[first] > 0.0
        stop, excess = first + 1, 0.0
        if not broken and not close:
            stop = min(first + STRETCH, intervals)
            if part < cubics.broken.size:
                stop = min(stop, cubics.broken[part])
            _lay_out(cubics, disturbances, first, stop, course)
            _through_stretch(tables, state, course, scratch.sums, stop - first)
            count = stop - first
            if limits is not None:
                count = within(limits, course, scratch.sizes, scratch.sums[0], count)
            if count < stop - first:
                stop = first + count
                for j in range(tables.states):
                    state[j] = course[behind + j, count]
                if count == 0:
                    close, stop = True, first + 1
            for k in range(first, stop):
                overload[1 + k] = 0.0
            if not close and tables.integrals:
                factored_sums(tables.spread, course, 0, course.shape[1], 1, averages, first, stop - first)
        if broken or close:
            if close and limits is not None:
                part, excess = follow_closely(
                    cubics, part, first, tables, limits, state, disturbances, overload, scratch.parts
                )
            else:
                part = through_parts(cubics, part, tables, state, scratch.parts)
                _disturb(tables, state, disturbances[:, first], scratch.parts.vector)
            for j in range(tables.states):
                course[behind + j, 1] = state[j]
            for k in range(tables.integrals):
                averages[first, k] = scratch.parts.vector[tables.states + k]
        for r in range(rows.shape[0]):
            weighted_sums(course, behind, 1, rows[r], tables.states, scratch.sums[0], stop - first)
            for k in range(first, stop):
                points[r, k] = fused(rows_input[r], cubics.smooth[1, k], scratch.sums[0, k - first])
            points[r, first] += rows_excess[r] * excess
        first = stop


@unfused_kernel
def _lay_out(cubics: CubicInput, disturbances: Array, first: int, stop: int, course: Array) -> None:
    """Copy input and disturbances of a stretch to the rows above the states."""
    for k in range(4):
        copy_into(cubics.smooth[k, first:stop], course[k, : stop - first])
    for e in range(disturbances.shape[0]):
        copy_into(disturbances[e, first:stop], course[4 + e, : stop - first])


@unfused_kernel
def _through_stretch(tables: Tables, state: Array, course: Array, sums: Array, count: int) -> None:
    """Propagate the circuit over intervals without breaks; `course` gets the states from start to end."""
    behind = course.shape[0] - tables.states
    for section in range(tables.sections.size - 1):
        begin, end = tables.sections[section], tables.sections[section + 1]
        n_known = behind + begin
        weighted_sums(course, 0, 0, tables.weights[begin], n_known, sums[0], count)
        if end == begin + 1:
            state[begin] = _first_order(tables.step[begin, begin], state[begin], sums[0][:count], course[n_known])
        else:
            weighted_sums(course, 0, 0, tables.weights[begin + 1], n_known, sums[1], count)
            _second_order(tables.step, begin, state, sums[0][:count], sums[1], course[n_known], course[n_known + 1])


@unfused_kernel
def _first_order(decay: float, first: float, added: Array, path: Array) -> float:
    """Propagate the state of a section of first order; return the last value."""
    x = first
    for k in range(added.size):
        path[k] = x
        x = fused(decay, x, added[k])
    path[added.size] = x
    return x


@unfused_kernel
def _second_order(step: Array, begin: int, state: Array, added: Array, also: Array, path: Array, other: Array) -> None:
    """Propagate both states of a section of second order."""
    aa, ab = step[begin, begin], step[begin + 1, begin]
    ba, bb = step[begin, begin + 1], step[begin + 1, begin + 1]
    x, y = state[begin], state[begin + 1]
    for k in range(added.size):
        path[k], other[k] = x, y
        x, y = fused(aa, x, fused(ab, y, added[k])), fused(bb, y, fused(ba, x, also[k]))
    path[added.size], other[added.size] = x, y
    state[begin], state[begin + 1] = x, y


@unfused_kernel
def _disturb(tables: Tables, state: Array, disturbances: Array, vector: Array) -> None:
    """Add the disturbances at the end of an interval with breaks."""
    for e in range(disturbances.shape[0]):
        for r in range(tables.width):
            vector[r] += tables.step[tables.states + 4 + e, r] * disturbances[e]
    for j in range(tables.states):
        state[j] = vector[j]
