"""A circuit at a sample rate: exact transition matrices over an interval, and over part of one.

Time counts in sample intervals. In addition to the circuit's states there are integrals of its output that restart at
every sample: the reading of a converter that averages over the interval, and the Legendre moments that a decimation
filter weighs. State, integrals and the input's derivatives follow one linear differential equation, so that matrix
exponentials propagate them over a whole interval (one matrix) or over any part of it (a matrix for 64ths, one for
4096ths, and a Taylor series for the rest). No eigenvectors: repeated poles at zero are as good as any.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb, factorial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from daq.dsp.circuit import Circuit
from rig.arrays import Array
from rig.errors import SceneError
from rig.numerics.simd import LANES, aligned_zeros, padded_length

# A sample interval has this number of coarse parts, and a coarse part the same number of fine parts.
PARTS = 64
# Size of the generator over the smallest part of a sample interval up to which its series is summed.
MOST_NORM = 50.0
# Start, end, mean and moment of a piece (see `Pieces`) -> derivatives of the cubic at its start, when the
# piece is as long as the unit of time.
CUBIC = np.array(
    [[1.0, 0.0, 0.0, 0.0], [-9.0, 3.0, -24.0, 60.0], [36.0, -24.0, 168.0, -360.0], [-60.0, 60.0, -360.0, 720.0]]
)


# Legendre polynomials over the interval -> value, slope and curvature at its start.
LEGENDRE = np.array([[1.0, 0.0, 0.0], [-1.0, 2.0, 0.0], [1.0, -6.0, 12.0]])


class Entry(NamedTuple):
    """How a disturbance enters a circuit."""

    section: int  # in front of which section
    # its course over an interval: the Legendre polynomial of this degree, up to 2, times its voltage
    degree: int
    filtered: bool  # whether its direct feedthrough enters the moments


class Tables(NamedTuple):
    """Matrices of a circuit at a sample rate; columns of the usual matrices are rows here.

    The vector is (states, integrals, four derivatives of the input). `step` omits its entries that start at zero or are
    not needed, and gives moments where the vector holds repeated integrals.
    """

    # Number of states, of moments of the output, and of both.
    states: int
    integrals: int
    width: int
    # first state of each section, and the number of states; int64; (sections + 1,)
    sections: NDArray[np.int64]
    # Contributions of the input's start, end, mean and moment, then of 1 V of each disturbance, then of the states of
    # the sections before its own to each state over an interval; (states, 4 + disturbances + states).
    weights: Array
    spread: Array  # their contributions to the moments, and zeros; (4 + disturbances + states, LANES)
    # Transition of each state, then contributions of the input's start, end, mean and moment, then of 1 V of each
    # disturbance over an interval; (states + 4 + disturbances, width).
    step: Array
    impulse: Array  # jump of the vector by a unit impulse; (width,)
    # Exponentials of the generator over k/64 and k/4096 of the interval. Here and in `generator` zeros fill up the
    # size to whole registers. Shape (65, size, size).
    coarse: Array
    fine: Array
    generator: Array  # rate of change of the vector; (1, size, size)
    terms: int  # terms of the Taylor series that make it exact over 1/4096
    moments: Array  # repeated integrals to moments; (integrals, integrals)


def rate_of_change(circuit: Circuit, gain: float, rate: float, integrals: int) -> Array:
    """Return the generator of the vector that `Tables` carries, shape (size, size), per interval."""
    states = circuit.c.size
    width = states + integrals
    generator = np.zeros((width + 4, width + 4))
    generator[:states, :states] = circuit.a / rate
    generator[:states, width] = circuit.b[0] * (gain / rate)
    if integrals:
        generator[states, :states] = circuit.c
        generator[states, width] = circuit.d[0] * gain
        for k in range(1, integrals):
            generator[states + k, states + k - 1] = 1.0
    for k in range(3):
        generator[width + k, width + k + 1] = 1.0
    return generator


def with_disturbances(
    generator: Array, circuit: Circuit, rate: float, integrals: int, entries: Sequence[Entry]
) -> tuple[Array, Array]:
    """Extend generator and start of the vector by value, slope and curvature of each disturbance.

    Rows of the start are the extended vector at the start of an interval, from the states, the input's start,
    end, mean and moment, and 1 V of each disturbance.
    """
    states, size = circuit.c.size, len(generator)
    places = list(dict.fromkeys((entry.section, entry.filtered) for entry in entries))
    bigger = np.zeros((size + 3 * len(places),) * 2)
    bigger[:size, :size] = generator
    for column, (section, filtered) in zip(range(size, len(bigger), 3), places, strict=True):
        bigger[:states, column] = circuit.b[section] / rate
        if filtered and integrals:
            bigger[states, column] = circuit.d[section]
        bigger[column, column + 1] = bigger[column + 1, column + 2] = 1.0
    start = np.zeros((len(bigger), states + 4 + len(entries)))
    start[:states, :states] = np.eye(states)
    start[size - 4 : size, states : states + 4] = CUBIC
    for row, entry in enumerate(entries):
        column = size + 3 * places.index((entry.section, entry.filtered))
        start[column : column + 3, states + 4 + row] = LEGENDRE[entry.degree]
    return bigger, start


def discretize(circuit: Circuit, gain: float, rate: float, integrals: int, entries: Sequence[Entry]) -> Tables:
    """Return the tables of a circuit behind a gain in V per unit, with moments of the output (1: the average)."""
    states = circuit.c.size
    width = states + integrals
    generator = rate_of_change(circuit, gain, rate, integrals)
    to_moments = np.eye(width)
    to_moments[states:, states:] = _moments(integrals)
    augmented, start = with_disturbances(generator, circuit, rate, integrals, entries)
    step = to_moments @ expm(augmented)[:width] @ start

    # The first three terms may do no more than bring down the input's derivatives: they do not count.
    norm = np.abs(generator).sum(axis=1).max() / PARTS**2
    if not norm <= MOST_NORM:
        fastest = np.abs(np.linalg.eigvals(circuit.a)).max(initial=0.0) / (2.0 * np.pi)
        raise SceneError(
            f"channels: a corner or resonance frequency of {fastest:.3g} Hz is too high for a sample rate of "
            f"{rate:.6g} Hz. Remove its key (for an ideal component), or choose a higher sample rate."
        )
    terms, remainder = 4, norm
    while remainder > 1e-18:
        terms += 1
        remainder *= norm / (terms - 3)
    spread = aligned_zeros(step.shape[1], LANES)
    spread[:, :integrals] = input_first(step[states:], states).T
    return Tables(
        states=states,
        integrals=integrals,
        width=width,
        sections=np.array(circuit.sections),
        weights=np.ascontiguousarray(input_first(step[:states], states)),
        spread=spread,
        step=np.ascontiguousarray(step.T),
        impulse=generator[:width, width].copy(),
        coarse=laid_out(_powers(expm(generator / PARTS))),
        fine=laid_out(_powers(expm(generator / PARTS**2))),
        generator=laid_out(generator[None]),
        terms=terms,
        moments=np.ascontiguousarray(to_moments[states:, states:].T),
    )


def input_first(rows: Array, states: int) -> Array:
    """Put the columns of the states behind those of input and disturbances."""
    return np.roll(rows, -states, axis=1)


def _powers(matrix: Array) -> Array:
    """Powers 0 to 64 of a matrix; each a product of few factors, so that rounding does not pile up."""
    powers = [np.eye(len(matrix)), matrix]
    for k in range(2, PARTS + 1):
        powers.append(powers[k // 2] @ powers[k - k // 2])
    return np.array(powers)


def laid_out(matrices: Array) -> Array:
    """Transpose matrices of shape (count, size, size) and fill them up to whole registers."""
    count, size, _ = matrices.shape
    room = aligned_zeros(count, padded_length(size), padded_length(size))
    room[:, :size, :size] = matrices.transpose(0, 2, 1)
    return room


def _moments(count: int) -> Array:
    """Return the matrix from repeated integrals over the unit interval to moments with the Legendre polynomials.

    The (k+1)-fold integral weighs with u^k / k!, u being the time left; the polynomial of order n is the sum of
    (-1)^k C(n, k) C(n+k, k) u^k.
    """
    matrix = np.zeros((count, count))
    for n in range(count):
        for k in range(n + 1):
            matrix[n, k] = (-1.0) ** k * comb(n, k) * comb(n + k, k) * factorial(k)
    return matrix
