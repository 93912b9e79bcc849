"""Exact discretization of a circuit: transition matrices over a sample interval and over any part of the interval.

The unit of time is the sample interval. The propagated vector consists of the circuit's states, integrals of its output
that restart at every sample, and four derivatives of the input, a cubic. The integrals yield the Legendre moments of
the output over the interval. The first moment is its mean, which an averaging converter reads; a decimation filter
weighs several moments. The vector follows one linear differential equation, so matrix exponentials propagate it
over an interval. Over a part of an interval, one matrix propagates whole 64ths, another whole 4096ths, and a Taylor
series the remainder. No eigenvectors are used, because a circuit may have repeated poles.
"""

from collections.abc import Sequence
from math import comb, factorial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from daq.core.dsp.circuit import Circuit
from daq.core.dsp.interpolation import cubic_coefficients
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.numerics.simd import LANES, aligned_zeros, padded_length

# Number of coarse steps in a sample interval, and of fine steps in a coarse step.
SUBDIVISIONS = 64
# Largest norm of the generator times a fine step for which the Taylor series is used.
MAX_GENERATOR_NORM = 50.0
# Matrix from start, end, mean and moment of a cubic (see `CubicInput`) to its value and three derivatives at the start,
# for a segment as long as the unit of time.
_START, _SLOPE, _HALF_CURVATURE, _SIXTH_OF_THIRD = np.eye(4)[0], *cubic_coefficients(*np.eye(4))
CUBIC_DERIVATIVES = np.array([_START, _SLOPE, 2.0 * _HALF_CURVATURE, 6.0 * _SIXTH_OF_THIRD])

# Value, slope and curvature of the Legendre polynomials of degree 0, 1 and 2 at the start of the interval.
LEGENDRE_DERIVATIVES = np.array([[1.0, 0.0, 0.0], [-1.0, 2.0, 0.0], [1.0, -6.0, 12.0]])


class Entry(NamedTuple):
    """Point at which a disturbance (noise or offset) enters a circuit, and its variation over an interval."""

    section: int  # index of the section before which the disturbance enters
    degree: int  # the disturbance is its voltage times the Legendre polynomial of this degree, 0 to 2
    filtered: bool  # whether its direct feedthrough enters the moments


class DiscreteCircuit(NamedTuple):
    """Matrices of a circuit at a sample rate, transposed: a column of the usual matrix is a row here.

    `coarse_exponentials`, `fine_exponentials` and `generator` act on the whole propagated vector (see the module). The
    other matrices omit the input's derivatives, and yield moments instead of integrals of the output.
    """

    states: int  # number of states
    integrals: int  # number of moments of the output
    width: int  # number of states and moments
    first_states: NDArray[np.int64]  # first state of each section, and the number of states; (sections + 1,)
    # Contributions to each state over an interval: from the input's start, end, mean and moment, from 1 V of each
    # disturbance, and from the states; (states, 4 + disturbances + states).
    state_weights: Array
    # Contributions of the same quantities to the moments, padded; (4 + disturbances + states, LANES).
    moment_weights: Array
    # Contributions to states and moments over an interval: from each state, from the input's start, end, mean and
    # moment, and from 1 V of each disturbance; (states + 4 + disturbances, width).
    transition: Array
    impulse_response: Array  # jump of states and moments due to a unit impulse; (width,)
    # Exponentials of the generator over k/64 and k/4096 of the interval, k = 0 to 64. Zeros pad each row to a
    # multiple of `LANES`; (65, size, padded size).
    coarse_exponentials: Array
    fine_exponentials: Array
    generator: Array  # rate of change of the vector; (1, size, padded size)
    taylor_terms: int  # number of terms after which the Taylor series over 1/4096 is exact within rounding
    integrals_to_moments: Array  # (integrals, integrals)


def generator_matrix(circuit: Circuit, gain: float, rate: float, integrals: int) -> Array:
    """Return the matrix from the propagated vector to its rate of change per interval; shape (size, size).

    `gain`: V per unit of the input; `rate`: sample rate [Hz]; `integrals`: number of integrals of the output.
    """
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


def extend_by_disturbances(
    generator: Array, circuit: Circuit, rate: float, integrals: int, entries: Sequence[Entry]
) -> tuple[Array, Array]:
    """Extend the propagated vector by value, slope and curvature of the disturbances at each point of entry.

    Returns the generator of the extended vector, and its initial value. The columns of the initial value are the
    contributions of each state, of the input's start, end, mean and moment, and of 1 V of each disturbance.
    """
    states, size = circuit.c.size, len(generator)
    entry_points = list(dict.fromkeys((entry.section, entry.filtered) for entry in entries))
    extended = np.zeros((size + 3 * len(entry_points),) * 2)
    extended[:size, :size] = generator
    for column, (section, filtered) in zip(range(size, len(extended), 3), entry_points, strict=True):
        extended[:states, column] = circuit.b[section] / rate
        if filtered and integrals:
            extended[states, column] = circuit.d[section]
        extended[column, column + 1] = extended[column + 1, column + 2] = 1.0
    start = np.zeros((len(extended), states + 4 + len(entries)))
    start[:states, :states] = np.eye(states)
    start[size - 4 : size, states : states + 4] = CUBIC_DERIVATIVES
    for row, entry in enumerate(entries):
        column = size + 3 * entry_points.index((entry.section, entry.filtered))
        start[column : column + 3, states + 4 + row] = LEGENDRE_DERIVATIVES[entry.degree]
    return extended, start


def discretize(circuit: Circuit, gain: float, rate: float, integrals: int, entries: Sequence[Entry]) -> DiscreteCircuit:
    """Return the matrices of a circuit after a gain in V per unit of the input.

    `integrals`: number of moments of the output; 1 yields only its mean. Raises `SceneError` if a pole is too fast.
    """
    states = circuit.c.size
    width = states + integrals
    generator = generator_matrix(circuit, gain, rate, integrals)
    to_moments = np.eye(width)
    to_moments[states:, states:] = _integrals_to_moments(integrals)
    extended, start = extend_by_disturbances(generator, circuit, rate, integrals, entries)
    transition = to_moments @ expm(extended)[:width] @ start

    # The first three terms of the Taylor series may contain only the input's derivatives. The convergence of the series
    # is therefore estimated from the fourth term on.
    norm = np.abs(generator).sum(axis=1).max() / SUBDIVISIONS**2
    if not norm <= MAX_GENERATOR_NORM:
        fastest = np.abs(np.linalg.eigvals(circuit.a)).max(initial=0.0) / (2.0 * np.pi)
        raise SceneError(
            f"channels: a corner or resonance frequency of {fastest:.3g} Hz is too high for a sample rate of "
            f"{rate:.6g} Hz. Remove the key of this frequency (for an ideal component), or choose a higher rate."
        )
    terms, remainder = 4, norm
    while remainder > 1e-18:
        terms += 1
        remainder *= norm / (terms - 3)
    moment_weights = aligned_zeros(transition.shape[1], LANES)
    moment_weights[:, :integrals] = input_first(transition[states:], states).T
    return DiscreteCircuit(
        states=states,
        integrals=integrals,
        width=width,
        first_states=np.array(circuit.sections),
        state_weights=np.ascontiguousarray(input_first(transition[:states], states)),
        moment_weights=moment_weights,
        transition=np.ascontiguousarray(transition.T),
        impulse_response=generator[:width, width].copy(),
        coarse_exponentials=transpose_and_pad(_powers(expm(generator / SUBDIVISIONS))),
        fine_exponentials=transpose_and_pad(_powers(expm(generator / SUBDIVISIONS**2))),
        generator=transpose_and_pad(generator[None]),
        taylor_terms=terms,
        integrals_to_moments=np.ascontiguousarray(to_moments[states:, states:].T),
    )


def input_first(rows: Array, states: int) -> Array:
    """Return `rows` with the columns of the `states` states after the columns of input and disturbances."""
    return np.roll(rows, -states, axis=1)


def _powers(matrix: Array) -> Array:
    """Return powers 0 to 64 of a matrix, each a product of few factors, so few rounding errors accumulate."""
    powers = [np.eye(len(matrix)), matrix]
    for k in range(2, SUBDIVISIONS + 1):
        powers.append(powers[k // 2] @ powers[k - k // 2])
    return np.array(powers)


def transpose_and_pad(matrices: Array) -> Array:
    """Transpose matrices of shape (count, size, size), and pad their rows with zeros to a multiple of `LANES`."""
    count, size, _ = matrices.shape
    padded = aligned_zeros(count, size, padded_length(size))
    padded[:, :size, :size] = matrices.transpose(0, 2, 1)
    return padded


def _integrals_to_moments(count: int) -> Array:
    """Return the matrix from repeated integrals over the unit interval to moments with the Legendre polynomials.

    The (k+1)-fold integral has the weight u^k / k!, where u is the remaining time. The polynomial of order n is the
    sum of (-1)^k C(n, k) C(n+k, k) u^k.
    """
    matrix = np.zeros((count, count))
    for n in range(count):
        for k in range(n + 1):
            matrix[n, k] = (-1.0) ** k * comb(n, k) * comb(n + k, k) * factorial(k)
    return matrix
