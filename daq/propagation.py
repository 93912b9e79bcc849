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
    step : ndarray, shape (states + 4 + disturbances, width)
        What each state, then the input's start, end, mean and moment, then 1 V of each disturbance become or
        add over an interval; zeros fill up both lengths to multiples of 4.
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
    step = np.zeros((-(-(states + 4 + constants) // 4) * 4, -(-width // 4) * 4))
    step[:states, :width] = over_interval[:, :states].T
    step[states : states + 4, :width] = (over_interval[:, width:size] @ _CUBIC).T
    step[states + 4 : states + 4 + constants, :width] = over_interval[:, size:].T

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
        step=step,
        impulse=generator[:width, width].copy(),
        coarse=_powers(expm(generator / PARTS)),
        fine=_powers(expm(generator / PARTS**2)),
        generator=columns,
        place=np.argwhere(columns),
        terms=terms,
        moments=np.ascontiguousarray(to_moments[states:, states:].T),
    )


def _powers(matrix: Array) -> Array:
    """Powers 0 to 64 of a matrix, transposed; each a product of few factors, so that rounding does not pile up."""
    powers = [np.eye(len(matrix)), matrix]
    for k in range(2, PARTS + 1):
        powers.append(powers[k // 2] @ powers[k - k // 2])
    return np.ascontiguousarray(np.array(powers).transpose(0, 2, 1))


def _moments(count: int) -> Array:
    """Matrix from repeated integrals over the unit interval to moments with the Legendre polynomials.

    The (k+1)-fold integral weighs with u^k / k!, u being the time left, and in u the polynomial of order n is the
    sum of (-1)^k C(n, k) C(n+k, k) u^k.
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

    Parameters
    ----------
    pieces : Pieces
        Input.
    tables : Tables
        Of the circuit.
    state : ndarray, shape (states,)
        At the last sample; updated.
    held : ndarray, shape (intervals, disturbances)
        Disturbances, constant over the interval, V. If an output is watched, the first of them is filled in
        here with what its limit takes away.
    rails : ndarray, shape (limited states, 2)
        Index of a state and the voltage it cannot exceed.
    overload : ndarray, shape (0,) or (3,)
        Limit of the watched output [V], the share of its shift that is left after an interval, and the share
        of what it lacks that enters the shift.
    shift : ndarray, shape (0,) or (1,)
        Shift of the watched output since it was overloaded, V; updated.
    rows, rows_input : ndarray, shapes (outputs, states) and (outputs,)
        Outputs at the samples, from state and input.
    points : ndarray, shape (intervals, outputs)
        These outputs; filled in.
    averages : ndarray, shape (intervals, integrals)
        Moments of the output over each interval; filled in.
    """
    states, width = tables.states, tables.width
    padded, size = tables.step.shape[1], tables.generator.shape[0]
    columns = tables.step.shape[0]
    first_held = states + 4
    new = np.zeros(padded)
    weights = np.zeros(columns)
    vector, work, term = np.empty(size), np.empty(size), np.empty(size)
    part = 0
    for i in range(pieces.start.size):
        for d in range(held.shape[1]):
            weights[first_held + d] = held[i, d]
        if part < pieces.broken.size and pieces.broken[part] == i:
            part = _in_parts(pieces, part, tables, state, vector, work, term, new)
            weights[:first_held] = 0.0
            _combine(tables.step, weights, new)
        else:
            for j in range(states):
                weights[j] = state[j]
            weights[states] = pieces.start[i]
            weights[states + 1] = pieces.end[i]
            weights[states + 2] = pieces.mean[i]
            weights[states + 3] = pieces.moment[i]
            new[:] = 0.0
            _combine(tables.step, weights, new)
        if overload.size:
            free = new[width - 1] - shift[0]
            excess = free - min(max(free, -overload[0]), overload[0])
            lack = -shift[0] - excess
            shift[0] = overload[1] * shift[0] + overload[2] * excess
            if lack != 0.0:
                held[i, 0] = lack
                for r in range(padded):
                    new[r] += tables.step[first_held, r] * lack
        for k in range(rails.shape[0]):
            j = int(rails[k, 0])
            if abs(new[j]) > rails[k, 1]:
                new[j] = rails[k, 1] if new[j] > 0.0 else -rails[k, 1]
        for j in range(states):
            state[j] = new[j]
        for r in range(rows.shape[0]):
            total = rows_input[r] * pieces.end[i]
            for j in range(states):
                total += rows[r, j] * new[j]
            points[i, r] = total
        for k in range(averages.shape[1]):
            averages[i, k] = new[states + k]


@njit(cache=True)
def _combine(step: Array, weights: Array, out: Array) -> None:
    """Add the rows of `step`, each times its weight, four at a time."""
    for j in range(0, step.shape[0], 4):
        a, b, c, d = weights[j], weights[j + 1], weights[j + 2], weights[j + 3]
        for r in range(step.shape[1]):
            out[r] += (step[j, r] * a + step[j + 1, r] * b) + (step[j + 2, r] * c + step[j + 3, r] * d)


@njit(cache=True)
def _in_parts(
    pieces: Pieces,
    part: int,
    tables: Tables,
    state: Array,
    vector: Array,
    work: Array,
    term: Array,
    new: Array,
) -> int:
    """Carry the circuit through an interval with breaks; give the first part of the next."""
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
    new[:] = 0.0
    for j in range(states):
        new[j] = vector[j]
    for k in range(width - states):
        for r in range(width - states):
            new[states + r] += tables.moments[k, r] * vector[states + k]
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
