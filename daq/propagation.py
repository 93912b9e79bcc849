"""A circuit carried from sample to sample, exactly, for an input made of cubic pieces.

Time counts in sample intervals. Beside the circuit's own states there are integrals of its output, begun anew
at every sample: what a converter that averages over the interval reads, and the Legendre moments that a
decimation filter weighs. State, integrals and the input's derivatives follow one linear differential
equation, so that matrix exponentials carry them over a whole interval (one matrix) or over any part of it (a
matrix for 64ths, one for 4096ths, and a Taylor series for the rest). No eigenvectors: repeated poles at zero
are as good as any.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import comb, factorial
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import expm

from daq.circuit import Circuit
from daq.pieces import Pieces

Array = NDArray[np.float64]

PARTS = 64
# Intervals worked off together: enough to keep a processor's pipelines busy, few enough for its nearest
# memory.
STRETCH = 128
# Start, end, mean and moment of a piece (see `Pieces`) -> derivatives of the cubic at its start, when the
# piece is as long as the unit of time.
_CUBIC = np.array(
    [
        [1.0, 0.0, 0.0, 0.0],
        [-9.0, 3.0, -24.0, 60.0],
        [36.0, -24.0, 168.0, -360.0],
        [-60.0, 60.0, -360.0, 720.0],
    ]
)


class Tables(NamedTuple):
    """Matrices of a circuit at a sample rate; columns of the usual matrices are rows here.

    The vector carried is (states, integrals, four derivatives of the input). `step` leaves out of it what
    starts at zero or is not needed, and gives moments where the vector holds repeated integrals.

    Attributes
    ----------
    states, width : int
        Number of states, and of states and integrals.
    sections : ndarray of int64, shape (sections + 1,)
        First state of each section, and the number of states.
    watched : int
        Number of sections up to the watched output; -1: none is watched.
    weights : ndarray, shape (width, states + 4 + disturbances)
        The same the other way round, without what a section's own states and later ones add, and for the
        watched output without disturbances; zeros fill up the rows to a multiple of 8.
    step : ndarray, shape (states + 4 + disturbances, width)
        What each state, then the input's start, end, mean and moment, then 1 V of each disturbance become or
        add over an interval.
    impulse : ndarray, shape (width,)
        What a unit impulse adds to the vector at once.
    coarse, fine : ndarray, shape (65, size, size)
        Exponentials of the generator over k/64 and k/4096 of the interval.
    generator : ndarray, shape (size, size)
        The generator.
    place : ndarray of int64, shape (entries, 2)
        Column and row of what is not zero in the generator.
    terms : int
        Terms of the Taylor series that make it exact over 1/4096.
    moments : ndarray, shape (integrals, integrals)
        Repeated integrals to moments.
    """

    states: int
    width: int
    sections: NDArray[np.int64]
    watched: int
    weights: Array
    step: Array
    impulse: Array
    coarse: Array
    fine: Array
    generator: Array
    place: NDArray[np.int64]
    terms: int
    moments: Array


def discretise(
    circuit: Circuit,
    gain: float,
    rate: float,
    integrals: int,
    watched: Circuit | None,
    entries: Sequence[int],
    filtered: Sequence[bool],
) -> Tables:
    """Make the tables of a circuit.

    Parameters
    ----------
    circuit : Circuit
        The analogue stages of a channel.
    gain : float
        Volts per unit of the input, in front of the circuit.
    rate : float
        Sample rate, Hz.
    integrals : int
        Moments of the output to form over every interval; 0: none, 1: the average.
    watched : Circuit or None
        Leading part of the circuit whose output's average over the interval is formed as well, last of all.
    entries : sequence of int
        In front of which section each disturbance enters.
    filtered : sequence of bool
        Whether what of a disturbance passes the circuit at once goes into the moments.
    """
    states, h = circuit.c.size, 1.0 / rate
    width = states + integrals + (1 if watched is not None else 0)
    size = width + 4
    generator = np.zeros((size, size))
    generator[:states, :states] = circuit.a * h
    generator[:states, width] = circuit.b[0] * (gain * h)
    if integrals:
        generator[states, :states] = circuit.c
        generator[states, width] = circuit.d[0] * gain
        for k in range(1, integrals):
            generator[states + k, states + k - 1] = 1.0
    if watched is not None:
        generator[width - 1, : watched.c.size] = watched.c
        generator[width - 1, width] = watched.d[0] * gain
    for k in range(3):
        generator[width + k, width + k + 1] = 1.0

    to_moments = np.eye(width)
    to_moments[states : states + integrals, states : states + integrals] = _moments(integrals)
    # A constant voltage is one more state that never changes.
    constants = len(entries)
    with_constants = np.zeros((size + constants, size + constants))
    with_constants[:size, :size] = generator
    for column, (entry, through) in enumerate(zip(entries, filtered, strict=True), size):
        with_constants[:states, column] = circuit.b[entry] * h
        if through and integrals:
            with_constants[states, column] = circuit.d[entry]
    over_interval = to_moments @ expm(with_constants)[:width]
    step = np.concatenate(
        [over_interval[:, :states], over_interval[:, width:size] @ _CUBIC, over_interval[:, size:]], axis=1
    )

    # The first three terms may do no more than bring down the input's derivatives: they do not count.
    norm = np.abs(generator).sum(axis=1).max() / PARTS**2
    terms, remainder = 4, norm
    while remainder > 1e-18:
        terms += 1
        remainder *= norm / (terms - 3)
    columns = np.ascontiguousarray(generator.T)
    return Tables(
        states=states,
        width=width,
        sections=np.array(circuit.sections),
        watched=-1 if watched is None else len(watched.sections) - 1,
        weights=_weights(step, circuit.sections, watched is not None),
        step=np.ascontiguousarray(step.T),
        impulse=generator[:width, width].copy(),
        coarse=_powers(expm(generator / PARTS)),
        fine=_powers(expm(generator / PARTS**2)),
        generator=columns,
        place=np.argwhere(columns),
        terms=terms,
        moments=np.ascontiguousarray(to_moments[states:, states:].T),
    )


def _weights(step: Array, sections: Sequence[int], watched: bool) -> Array:
    """Leave out of the rows of a step what is not known when they are summed up."""
    weights = np.pad(step, [(0, 0), (0, -step.shape[1] % 8)])
    for begin, end in pairwise(sections):
        weights[begin:end, begin : sections[-1]] = 0.0
    if watched:
        weights[-1, sections[-1] + 4 :] = 0.0
    return weights


def _powers(matrix: Array) -> Array:
    """Powers 0 to 64 of a matrix, transposed; each a product of few factors, so that rounding does not pile up."""
    powers = [np.eye(len(matrix)), matrix]
    for k in range(2, PARTS + 1):
        powers.append(powers[k // 2] @ powers[k - k // 2])
    return np.ascontiguousarray(np.array(powers).transpose(0, 2, 1))


def _moments(count: int) -> Array:
    """Matrix from repeated integrals over the unit interval to moments with the Legendre polynomials.

    The (k+1)-fold integral weighs with u^k / k!, u being the time left, and in u the polynomial of order n is
    the sum of (-1)^k C(n, k) C(n+k, k) u^k.
    """
    matrix = np.zeros((count, count))
    for n in range(count):
        for k in range(n + 1):
            matrix[n, k] = (-1.0) ** k * comb(n, k) * comb(n + k, k) * factorial(k)
    return matrix


@njit(cache=True)
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
    """
    size = tables.generator.shape[0]
    vector, work, term = np.empty(size), np.empty(size), np.empty(size)
    course = np.zeros((tables.weights.shape[1], STRETCH + 8))
    sums = np.empty((2, STRETCH))
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
                held[0, first:stop] = course[tables.states + 4, : stop - first]
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


@njit(cache=True)
def _lay_out(pieces: Pieces, held: Array, first: int, stop: int, states: int, course: Array) -> None:
    """Put input and disturbances of a stretch below the states."""
    count = stop - first
    course[states, :count] = pieces.start[first:stop]
    course[states + 1, :count] = pieces.end[first:stop]
    course[states + 2, :count] = pieces.mean[first:stop]
    course[states + 3, :count] = pieces.moment[first:stop]
    for e in range(held.shape[0]):
        course[states + 4 + e, :count] = held[e, first:stop]


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
def _limit(tables: Tables, overload: Array, shift: Array, course: Array, out: Array) -> None:
    """Find what the watched output lacks in each interval."""
    _gather(tables.weights[tables.width - 1], course, out)
    lack = course[tables.states + 4]
    for k in range(out.size):
        lack[k] = _lack(out[k], overload, shift)


@njit(cache=True)
def _lack(output: float, overload: Array, shift: Array) -> float:
    """Find what an output lacks, and let its shift go on by an interval."""
    free = output - shift[0]
    excess = free - min(max(free, -overload[0]), overload[0])
    lack = -shift[0] - excess
    shift[0] = overload[1] * shift[0] + overload[2] * excess
    return lack


@njit(cache=True)
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


@njit(cache=True)
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
                    total += _CUBIC[k, j] * pieces.part[j, part]
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


@njit(cache=True)
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
        term[:] = vector
        for k in range(tables.terms):
            work[:] = 0.0
            for e in range(tables.place.shape[0]):
                j, r = tables.place[e, 0], tables.place[e, 1]
                work[r] += tables.generator[j, r] * term[j]
            factor = rest / (k + 1)
            for r in range(vector.size):
                term[r] = work[r] * factor
                vector[r] += term[r]


@njit(cache=True)
def _multiply(matrices: Array, index: int, vector: Array, work: Array) -> None:
    """Multiply a vector by one of several matrices, given by their columns."""
    work[:] = 0.0
    for j in range(vector.size):
        value = vector[j]
        if value != 0.0:
            for r in range(vector.size):
                work[r] += matrices[index, j, r] * value
    vector[:] = work
