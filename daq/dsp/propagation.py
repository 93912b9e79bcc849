"""A circuit carried from sample to sample, exactly, for an input made of cubic pieces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from daq.dsp.discretisation import CUBIC, PARTS, Tables
from daq.dsp.interpolation import JUMP, LENGTH, CubicInput, put
from rig.numerics.fma import WEIGHED, fused, spread, weigh
from rig.numerics.jit import unfused
from rig.numerics.simd import LANES, copy, multiply, zeros

Array = NDArray[np.float64]

# Intervals worked off together: enough to keep a processor's pipelines busy, few enough for its nearest
# memory.
STRETCH = 2 * WEIGHED
# Below this, V, what is left of an overload is gone: a number that fades for ever becomes slow to work with.
GONE = 1e-30


class CircuitWorkspace(NamedTuple):
    """Room to work in."""

    vector: Array
    term: Array
    work: Array
    nothing: Array
    """Vectors carried through parts of an interval; and zeros; shape (size,)."""
    course: Array
    """Input, disturbances and states through a stretch; shape (4 + disturbances + states, intervals of a
    stretch and more)."""
    sums: Array
    """What is added to the states of a section; shape (2, intervals of a stretch)."""


def scratch_for(tables: Tables) -> CircuitWorkspace:
    """Make room to work in for a circuit."""
    size = tables.generator.shape[1]
    # Rows a little longer than needed: the state at the end, and at even distances they would compete for the
    # same places in a cache.
    course = zeros(tables.spread.shape[0], STRETCH + LANES)
    return CircuitWorkspace(zeros(size), zeros(size), zeros(size), zeros(size), course, zeros(2, STRETCH))


@unfused
def propagate(
    pieces: CubicInput,
    tables: Tables,
    state: Array,
    held: Array,
    rails: Array,
    overload: Array,
    shift: Array,
    rows: Array,
    rows_input: Array,
    points: Array,
    averages: Array,
    scratch: CircuitWorkspace,
) -> None:
    """Carry a circuit through the intervals of a block.

    Stretches without breaks are worked off section by section, as each section only depends on those before
    it: all but a section's own recurrence is then the same sum for many samples at a time. The order of every
    sum is fixed, so that nothing depends on where a stretch or a block ends.

    Parameters
    ----------
    state : ndarray, shape (states,)
        At the last sample; updated.
    held : ndarray, shape (disturbances, intervals)
        Disturbances, constant over the interval, V. If an output is watched, the first of them is filled in
        here with what its limit takes away.
    rails : ndarray, shape (states,)
        Voltage that each state cannot exceed.
    overload : ndarray, shape (0,) or (3,)
        Limit of the watched output [V], the share of its shift that is left after an interval, and the share
        of what it lacks that enters the shift.
    shift : ndarray, shape (0,) or (1,)
        Shift of the watched output since it was overloaded, V; updated.
    rows, rows_input : ndarray, shapes (outputs, states) and (outputs,)
        Outputs at the samples, from state and input.
    points : ndarray, shape (outputs, intervals)
        These outputs; filled in.
    averages : ndarray, shape (intervals + TOGETHER, LANES), or (0, LANES) where there are no integrals
        Moments of the output over each interval; filled in, the last rows with anything.
    """
    vector, term, work, nothing, course, sums = scratch
    behind = 4 + held.shape[0]
    part = 0
    first = 0
    intervals = pieces.smooth.shape[1]
    while first < intervals:
        stop = min(first + STRETCH, intervals)
        if part < pieces.broken.size:
            stop = min(stop, pieces.broken[part])
        if stop > first:
            _lay_out(pieces, held, first, stop, course)
            _through_stretch(tables, state, rails, overload, shift, course, sums, stop - first)
            if overload.size:
                put(course[4], held[0, first:stop])
            if tables.integrals:
                spread(tables.spread, course, 0, course.shape[1], 1, averages, first, stop - first)
        else:
            stop = first + 1
            part = _in_parts(pieces, part, tables, state, vector, term, work, nothing)
            _disturb(tables, state, held[:, first], rails, overload, shift, vector)
            for j in range(tables.states):
                course[behind + j, 1] = state[j]
            for k in range(tables.integrals):
                averages[first, k] = vector[tables.states + k]
        for r in range(rows.shape[0]):
            weigh(course, behind, 1, rows[r], tables.states, sums[0], stop - first)
            for k in range(first, stop):
                points[r, k] = fused(rows_input[r], pieces.smooth[1, k], sums[0, k - first])
        first = stop


@unfused
def _lay_out(pieces: CubicInput, held: Array, first: int, stop: int, course: Array) -> None:
    """Put input and disturbances of a stretch above the states."""
    for k in range(4):
        put(pieces.smooth[k, first:stop], course[k, : stop - first])
    for e in range(held.shape[0]):
        put(held[e, first:stop], course[4 + e, : stop - first])


@unfused
def _through_stretch(
    tables: Tables,
    state: Array,
    rails: Array,
    overload: Array,
    shift: Array,
    course: Array,
    sums: Array,
    count: int,
) -> None:
    """Carry the circuit through intervals without breaks; `course` gets the states from start to end."""
    behind = course.shape[0] - tables.states
    if tables.watched == 0:
        _limit(tables, overload, shift, course, sums, behind, count)
    for section in range(tables.sections.size - 1):
        begin, end = tables.sections[section], tables.sections[section + 1]
        known = behind + begin
        weigh(course, 0, 0, tables.weights[begin], known, sums[0], count)
        if end == begin + 1:
            state[begin] = _first_order(
                tables.step[begin, begin], rails[begin], state[begin], sums[0][:count], course[known]
            )
        else:
            weigh(course, 0, 0, tables.weights[begin + 1], known, sums[1], count)
            _second_order(
                tables.step, begin, state, sums[0][:count], sums[1], course[known], course[known + 1]
            )
        if section + 1 == tables.watched:
            _limit(tables, overload, shift, course, sums, behind + end, count)


@unfused
def _first_order(own: float, limit: float, first: float, added: Array, path: Array) -> float:
    """Carry the state of a section of first order, which cannot exceed a limit; give the last one."""
    x = first
    for k in range(added.size):
        path[k] = x
        x = fused(own, x, added[k])
    path[added.size] = x
    if limit == np.inf or not _beyond(path[1 : added.size + 1], limit):
        return x
    x = first
    for k in range(added.size):
        path[k] = x
        x = min(max(fused(own, x, added[k]), -limit), limit)
    path[added.size] = x
    return x


@unfused
def _second_order(
    step: Array, begin: int, state: Array, added: Array, also: Array, path: Array, other: Array
) -> None:
    """Carry both states of a section of second order."""
    aa, ab = step[begin, begin], step[begin + 1, begin]
    ba, bb = step[begin, begin + 1], step[begin + 1, begin + 1]
    x, y = state[begin], state[begin + 1]
    for k in range(added.size):
        path[k], other[k] = x, y
        x, y = fused(aa, x, fused(ab, y, added[k])), fused(bb, y, fused(ba, x, also[k]))
    path[added.size], other[added.size] = x, y
    state[begin], state[begin + 1] = x, y


@unfused
def _limit(
    tables: Tables, overload: Array, shift: Array, course: Array, sums: Array, known: int, count: int
) -> None:
    """Find what the watched output lacks in each interval, from the rows of `course` known by then."""
    out, free, lack = sums[0], sums[1], course[4]
    weigh(course, 0, 0, tables.weights[tables.states], known, out, count)
    left = shift[0]
    for k in range(count):
        lack[k] = -left
        if left != 0.0:
            left = _relaxed(left, overload)
    for k in range(count):
        free[k] = out[k] + lack[k]
    if not _beyond(free[:count], overload[0]):
        # As a rule nothing more is lacking than the shift.
        shift[0] = left
        return
    for k in range(count):
        lack[k] = _lack(out[k], overload, shift)


@unfused
def _beyond(values: Array, limit: float) -> bool:
    """Whether any magnitude exceeds a limit; without branches, so that several are compared at a time."""
    count = 0
    for k in range(values.size):
        count += abs(values[k]) > limit
    return count > 0


@unfused
def _relaxed(shift: float, overload: Array) -> float:
    """Give what is left of a shift after an interval; less than any voltage that counts is nothing."""
    return overload[1] * shift if abs(shift) > GONE else 0.0


@unfused
def _lack(output: float, overload: Array, shift: Array) -> float:
    """Find what an output lacks, and let its shift go on by an interval."""
    free = output - shift[0]
    excess = free - min(max(free, -overload[0]), overload[0])
    lack = -shift[0] - excess
    shift[0] = fused(overload[2], excess, _relaxed(shift[0], overload))
    return lack


@unfused
def _disturb(
    tables: Tables,
    state: Array,
    held: Array,
    rails: Array,
    overload: Array,
    shift: Array,
    vector: Array,
) -> None:
    """Let limits and disturbances act at the end of an interval with breaks."""
    states, width = tables.states, tables.width
    if overload.size:
        held[0] = _lack(vector[width - 1], overload, shift)
    for e in range(held.shape[0]):
        for r in range(width):
            vector[r] += tables.step[states + 4 + e, r] * held[e]
    for j in range(states):
        state[j] = min(max(vector[j], -rails[j]), rails[j])


@unfused
def _in_parts(
    pieces: CubicInput,
    part: int,
    tables: Tables,
    state: Array,
    vector: Array,
    term: Array,
    work: Array,
    nothing: Array,
) -> int:
    """Carry the circuit through an interval with breaks; give the first part of the next.

    States and moments are left in `vector`.
    """
    states, width = tables.states, tables.width
    interval = pieces.broken[part]
    vector[:] = 0.0
    for j in range(states):
        vector[j] = state[j]
    while part < pieces.broken.size and pieces.broken[part] == interval:
        share = pieces.parts[part, LENGTH]
        if share > 0.0:
            scale = 1.0
            for k in range(4):
                total = 0.0
                for j in range(4):
                    total += CUBIC[k, j] * pieces.parts[part, j]
                vector[width + k] = total * scale
                scale /= share
            _advance(tables, share, vector, term, work, nothing)
        for r in range(width):
            vector[r] += tables.impulse[r] * pieces.parts[part, JUMP]
        part += 1
    for r in range(states, width):
        work[r] = vector[r]
        vector[r] = 0.0
    for k in range(width - states):
        for r in range(width - states):
            vector[states + r] += tables.moments[k, r] * work[states + k]
    return part


@unfused
def _advance(tables: Tables, share: float, vector: Array, term: Array, work: Array, nothing: Array) -> None:
    """Multiply a vector by the exponential of the generator times `share` of an interval."""
    coarse = min(int(share * PARTS), PARTS)
    rest = share - coarse / PARTS
    fine = min(int(rest * PARTS * PARTS), PARTS - 1)
    rest -= fine / (PARTS * PARTS)
    multiply(tables.coarse, coarse, vector, nothing, term)
    multiply(tables.fine, fine, term, nothing, vector)
    if rest > 0.0:
        # The series from its end.
        copy(vector, term)
        for k in range(tables.terms, 0, -1):
            for r in range(term.size):
                term[r] *= rest / k
            multiply(tables.generator, 0, term, vector, work)
            copy(work, term)
        copy(term, vector)
