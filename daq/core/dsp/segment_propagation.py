"""Propagation of a circuit over an interval with discontinuities, segment by segment.

A discontinuity is an instant between samples at which an impact changes the input abruptly. A segment is the part of a
sample interval between two discontinuities (`daq.core.dsp.interpolation`).
"""

from typing import NamedTuple

from daq.core.dsp.discretization import CUBIC_DERIVATIVES, SUBDIVISIONS, DiscreteCircuit
from daq.core.dsp.interpolation import IMPULSE, LENGTH, CubicInput
from rig.core.base.arrays import Array
from rig.core.numerics.jit import unfused_kernel
from rig.core.numerics.simd import aligned_zeros, copy, multiply


class SegmentWorkspace(NamedTuple):
    """Working arrays of a propagation over segments of an interval; shape (size,) if not stated."""

    vector: Array  # the propagated vector (`daq.core.dsp.discretization`)
    term: Array  # a term of the Taylor series, or another intermediate vector
    work: Array  # intermediate results
    zeros: Array  # always zero
    constant_response: Array  # change of the vector due to constant disturbances over a step
    segment: Array  # a row of `CubicInput.segments`; (6,)


def segment_workspace(size: int) -> SegmentWorkspace:
    """Return working arrays for vectors of length `size`."""
    vector, term, work, zeros, constant_response = (aligned_zeros(size) for _ in range(5))
    return SegmentWorkspace(vector, term, work, zeros, constant_response, aligned_zeros(6))


@unfused_kernel
def propagate_segments(
    cubics: CubicInput, segment: int, discrete: DiscreteCircuit, state: Array, workspace: SegmentWorkspace
) -> int:
    """Propagate the circuit from `state` over all segments of an interval, the first of which is number `segment`.

    The result is in the workspace's vector. Returns the index of the first segment of the next interval.
    """
    vector, work = workspace.vector, workspace.work
    interval = cubics.segment_interval[segment]
    vector[:] = 0.0
    for j in range(discrete.states):
        vector[j] = state[j]
    while segment < cubics.segment_interval.size and cubics.segment_interval[segment] == interval:
        fraction = cubics.segments[segment, LENGTH]
        if fraction > 0.0:
            load_segment(discrete, cubics.segments[segment], vector)
            propagate_fraction(discrete, fraction, workspace)
        for r in range(discrete.width):
            vector[r] += discrete.impulse_response[r] * cubics.segments[segment, IMPULSE]
        segment += 1
    convert_integrals(discrete, vector, work)
    return segment


@unfused_kernel
def load_segment(discrete: DiscreteCircuit, segment: Array, vector: Array) -> None:
    """Write the derivatives of a segment's cubic at its start into the vector."""
    fraction, scale = segment[LENGTH], 1.0
    for k in range(4):
        total = 0.0
        for j in range(4):
            total += CUBIC_DERIVATIVES[k, j] * segment[j]
        vector[discrete.width + k] = total * scale
        scale /= fraction


@unfused_kernel
def convert_integrals(discrete: DiscreteCircuit, vector: Array, work: Array) -> None:
    """Convert the repeated integrals in the vector to moments."""
    states, width = discrete.states, discrete.width
    for r in range(states, width):
        work[r] = vector[r]
        vector[r] = 0.0
    for k in range(width - states):
        for r in range(width - states):
            vector[states + r] += discrete.integrals_to_moments[k, r] * work[states + k]


@unfused_kernel
def propagate_fraction(discrete: DiscreteCircuit, fraction: float, workspace: SegmentWorkspace) -> None:
    """Propagate the vector over `fraction` of an interval: multiply it by the exponential of the generator."""
    vector, term, work, zeros = workspace.vector, workspace.term, workspace.work, workspace.zeros
    coarse = min(int(fraction * SUBDIVISIONS), SUBDIVISIONS)
    remainder = fraction - coarse / SUBDIVISIONS
    fine = min(int(remainder * SUBDIVISIONS * SUBDIVISIONS), SUBDIVISIONS - 1)
    remainder -= fine / (SUBDIVISIONS * SUBDIVISIONS)
    multiply(discrete.coarse_exponentials, coarse, vector, zeros, term)
    multiply(discrete.fine_exponentials, fine, term, zeros, vector)
    if remainder > 0.0:
        # Taylor series, evaluated from its last term on (Horner's method).
        copy(vector, term)
        for k in range(discrete.taylor_terms, 0, -1):
            for r in range(term.size):
                term[r] *= remainder / k
            multiply(discrete.generator, 0, term, vector, work)
            copy(work, term)
        copy(term, vector)
