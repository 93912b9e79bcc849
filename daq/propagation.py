"""A circuit carried from sample to sample, exactly, for an input made of cubic pieces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from daq.discretisation import CUBIC, PARTS, Tables
from daq.pieces import Pieces
from rig.jit import unfused

Array = NDArray[np.float64]

# Intervals worked off together: enough to keep a processor's pipelines busy, few enough for its nearest
# memory.
STRETCH = 128


class Scratch(NamedTuple):
    """Room to work in.

    Attributes
    ----------
    vector, work, term : ndarray, shape (size,)
        Vectors carried through parts of an interval.
    course : ndarray, shape (states + 4 + disturbances, intervals of a stretch and more)
        States, input and disturbances through a stretch; zeros fill up the rows to a multiple of 8.
    sums : ndarray, shape (2, intervals of a stretch)
        What is added to the states of a section.
    """

    vector: Array
    work: Array
    term: Array
    course: Array
    sums: Array


def scratch_for(tables: Tables) -> Scratch:
    """Make room to work in for a circuit."""
    size = tables.width + 4
    # Rows a little longer than needed: at even distances they would compete for the same places in a cache.
    course = np.zeros((tables.weights.shape[1], STRETCH + 8))
    return Scratch(np.zeros(size), np.zeros(size), np.zeros(size), course, np.zeros((2, STRETCH)))


@unfused
def propagate(
    pieces: Pieces,
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
    scratch: Scratch,
) -> None:
    """Carry a circuit through the intervals of a block.

    Stretches without breaks are worked off section by section, as each section only depends on those before
    it: all but a section's own recurrence is then the same sum for many samples at a time. The order of every
    sum is fixed, so that nothing depends on where a stretch or a block ends.

    Parameters
    ----------
    pieces : Pieces
        Input.
    tables : Tables
        Of the circuit.
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
    averages : ndarray, shape (integrals, intervals or more)
        Moments of the output over each interval; filled in.
    scratch : Scratch
        Of the circuit.
    """
    vector, work, term, course, sums = scratch
    part = 0
    first = 0
    while first < pieces.start.size:
        stop = min(first + STRETCH, pieces.start.size)
        if part < pieces.broken.size:
            stop = min(stop, pieces.broken[part])
        if stop > first:
            _lay_out(pieces, held, first, stop, tables.states, course)
            _through_stretch(tables, state, rails, overload, shift, course, sums, averages, first, stop)
            if overload.size:
                for k in range(stop - first):
                    held[0, first + k] = course[tables.states + 4, k]
        else:
            stop = first + 1
            part = _in_parts(pieces, part, tables, state, vector, work, term)
            _disturb(tables, state, held[:, first], rails, overload, shift, vector)
            for j in range(tables.states):
                course[j, 1] = state[j]
            for k in range(averages.shape[0]):
                averages[k, first] = vector[tables.states + k]
        end = pieces.end[first:stop]
        for r in range(rows.shape[0]):
            out = points[r][first:stop]
            for k in range(out.size):
                out[k] = rows_input[r] * end[k]
            for j in range(tables.states):
                weight, after = rows[r, j], course[j][1:]
                for k in range(out.size):
                    out[k] += weight * after[k]
        first = stop


@unfused
def _lay_out(pieces: Pieces, held: Array, first: int, stop: int, states: int, course: Array) -> None:
    """Put input and disturbances of a stretch below the states."""
    _copy(pieces.start[first:stop], course[states])
    _copy(pieces.end[first:stop], course[states + 1])
    _copy(pieces.mean[first:stop], course[states + 2])
    _copy(pieces.moment[first:stop], course[states + 3])
    for e in range(held.shape[0]):
        _copy(held[e, first:stop], course[states + 4 + e])


@unfused
def _copy(values: Array, row: Array) -> None:
    """Copy into the beginning of a row; one row at a time, several samples are moved at once."""
    for k in range(values.size):
        row[k] = values[k]


@unfused
def _through_stretch(
    tables: Tables,
    state: Array,
    rails: Array,
    overload: Array,
    shift: Array,
    course: Array,
    sums: Array,
    averages: Array,
    first: int,
    stop: int,
) -> None:
    """Carry the circuit through intervals without breaks; `course` gets the states from start to end."""
    count, states = stop - first, tables.states
    out, second = sums[0][:count], sums[1][:count]
    if tables.watched == 0:
        _limit(tables, overload, shift, course, out)
    for section in range(tables.sections.size - 1):
        begin, end = tables.sections[section], tables.sections[section + 1]
        _gather(tables.weights[begin], course, out)
        path = course[begin]
        if end == begin + 1:
            own, limit, x = tables.step[begin, begin], rails[begin], state[begin]
            if limit == np.inf:
                for k in range(count):
                    path[k] = x
                    x = own * x + out[k]
            else:
                for k in range(count):
                    path[k] = x
                    x = own * x + out[k]
                    if x > limit:
                        x = limit
                    elif x < -limit:
                        x = -limit
            path[count] = x
            state[begin] = x
        else:
            _gather(tables.weights[begin + 1], course, second)
            aa, ab = tables.step[begin, begin], tables.step[begin + 1, begin]
            ba, bb = tables.step[begin, begin + 1], tables.step[begin + 1, begin + 1]
            x, y = state[begin], state[begin + 1]
            other = course[begin + 1]
            for k in range(count):
                path[k], other[k] = x, y
                x, y = (aa * x + ab * y) + out[k], (ba * x + bb * y) + second[k]
            path[count], other[count] = x, y
            state[begin], state[begin + 1] = x, y
        if section + 1 == tables.watched:
            _limit(tables, overload, shift, course, out)
    for m in range(averages.shape[0]):
        _gather(tables.weights[states + m], course, averages[m][first:stop])


@unfused
def _gather(weights: Array, course: Array, out: Array) -> None:
    """Sum up the rows of `course`, each times its weight; eight at a time keep a processor busy."""
    out[:] = 0.0
    for j in range(0, weights.size, 8):
        w0, w1, w2, w3 = weights[j], weights[j + 1], weights[j + 2], weights[j + 3]
        w4, w5, w6, w7 = weights[j + 4], weights[j + 5], weights[j + 6], weights[j + 7]
        c0, c1, c2, c3 = course[j], course[j + 1], course[j + 2], course[j + 3]
        c4, c5, c6, c7 = course[j + 4], course[j + 5], course[j + 6], course[j + 7]
        for k in range(out.size):
            out[k] += ((w0 * c0[k] + w1 * c1[k]) + (w2 * c2[k] + w3 * c3[k])) + (
                (w4 * c4[k] + w5 * c5[k]) + (w6 * c6[k] + w7 * c7[k])
            )


@unfused
def _limit(tables: Tables, overload: Array, shift: Array, course: Array, out: Array) -> None:
    """Find what the watched output lacks in each interval."""
    _gather(tables.weights[tables.width - 1], course, out)
    lack = course[tables.states + 4]
    if shift[0] == 0.0 and not _beyond(out, overload[0]):
        # As a rule nothing is lacking; this is what the sums below come to then.
        for k in range(out.size):
            lack[k] = -0.0
        return
    for k in range(out.size):
        lack[k] = _lack(out[k], overload, shift)


@unfused
def _beyond(values: Array, limit: float) -> bool:
    """Whether any magnitude exceeds a limit; without branches, so that several are compared at a time."""
    count = 0
    for k in range(values.size):
        count += abs(values[k]) > limit
    return count > 0


@unfused
def _lack(output: float, overload: Array, shift: Array) -> float:
    """Find what an output lacks, and let its shift go on by an interval."""
    free = output - shift[0]
    excess = free - min(max(free, -overload[0]), overload[0])
    lack = -shift[0] - excess
    shift[0] = overload[1] * shift[0] + overload[2] * excess
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
    pieces: Pieces, part: int, tables: Tables, state: Array, vector: Array, work: Array, term: Array
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
        share = pieces.length[part]
        if share > 0.0:
            scale = 1.0
            for k in range(4):
                total = 0.0
                for j in range(4):
                    total += CUBIC[k, j] * pieces.part[part, j]
                vector[width + k] = total * scale
                scale /= share
            _advance(tables, share, vector, work, term)
        for r in range(width):
            vector[r] += tables.impulse[r] * pieces.jump[part]
        part += 1
    for r in range(states, width):
        work[r] = vector[r]
        vector[r] = 0.0
    for k in range(width - states):
        for r in range(width - states):
            vector[states + r] += tables.moments[k, r] * work[states + k]
    return part


@unfused
def _advance(tables: Tables, share: float, vector: Array, work: Array, term: Array) -> None:
    """Multiply a vector by the exponential of the generator times `share` of an interval."""
    coarse = min(int(share * PARTS), PARTS)
    rest = share - coarse / PARTS
    fine = min(int(rest * PARTS * PARTS), PARTS - 1)
    rest -= fine / (PARTS * PARTS)
    if coarse > 0:
        _multiply(tables.coarse, coarse, vector, work)
    if fine > 0:
        _multiply(tables.fine, fine, vector, work)
    if rest > 0.0:
        for r in range(vector.size):
            term[r] = vector[r]
        for k in range(tables.terms):
            for r in range(vector.size):
                total = 0.0
                for e in range(tables.entry_start[r], tables.entry_start[r + 1]):
                    total += tables.entry_value[e] * term[tables.entry_column[e]]
                work[r] = total
            factor = rest / (k + 1)
            for r in range(vector.size):
                term[r] = work[r] * factor
                vector[r] += term[r]


@unfused
def _multiply(matrices: Array, index: int, vector: Array, work: Array) -> None:
    """Multiply a vector by one of several matrices, given by their columns."""
    work[:] = 0.0
    for j in range(vector.size):
        value = vector[j]
        if value != 0.0:
            for r in range(vector.size):
                work[r] += matrices[index, j, r] * value
    for r in range(vector.size):
        vector[r] = work[r]
