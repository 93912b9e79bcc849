"""Propagation of a circuit over part of an interval, and over an interval in which its input breaks."""

from __future__ import annotations

from typing import NamedTuple

from daq.dsp.discretization import CUBIC, PARTS, Tables
from daq.dsp.interpolation import JUMP, LENGTH, CubicInput
from rig.arrays import Array
from rig.numerics.jit import unfused_kernel
from rig.numerics.simd import aligned_zeros, copy, multiply


class PartWorkspace(NamedTuple):
    """Working arrays of a propagation over parts of an interval."""

    # The vector, two work vectors of its size, zeros, and the contribution of disturbances; (size,).
    vector: Array
    term: Array
    work: Array
    zeros: Array
    steady: Array
    full_part: Array  # A part; (6,)


def part_workspace(size: int) -> PartWorkspace:
    """Return working arrays for vectors of a size."""
    vector, term, work, zeros, steady = (aligned_zeros(size) for _ in range(5))
    return PartWorkspace(vector, term, work, zeros, steady, aligned_zeros(6))


@unfused_kernel
def through_parts(cubics: CubicInput, part: int, tables: Tables, state: Array, workspace: PartWorkspace) -> int:
    """Propagate the circuit's vector in the workspace over an interval with breaks; return the next part."""
    vector, work = workspace.vector, workspace.work
    interval = cubics.broken[part]
    vector[:] = 0.0
    for j in range(tables.states):
        vector[j] = state[j]
    while part < cubics.broken.size and cubics.broken[part] == interval:
        share = cubics.parts[part, LENGTH]
        if share > 0.0:
            begin_part(tables, cubics.parts[part], vector)
            advance(tables, share, workspace)
        for r in range(tables.width):
            vector[r] += tables.impulse[r] * cubics.parts[part, JUMP]
        part += 1
    form_moments(tables, vector, work)
    return part


@unfused_kernel
def begin_part(tables: Tables, part: Array, vector: Array) -> None:
    """Put the derivatives of a part's cubic at its start into the vector."""
    share, scale = part[LENGTH], 1.0
    for k in range(4):
        total = 0.0
        for j in range(4):
            total += CUBIC[k, j] * part[j]
        vector[tables.width + k] = total * scale
        scale /= share


@unfused_kernel
def form_moments(tables: Tables, vector: Array, work: Array) -> None:
    """Turn the repeated integrals in the vector into moments."""
    states, width = tables.states, tables.width
    for r in range(states, width):
        work[r] = vector[r]
        vector[r] = 0.0
    for k in range(width - states):
        for r in range(width - states):
            vector[states + r] += tables.moments[k, r] * work[states + k]


@unfused_kernel
def advance(tables: Tables, share: float, workspace: PartWorkspace) -> None:
    """Multiply the vector by the exponential of the generator times `share` of an interval."""
    vector, term, work, zeros = workspace.vector, workspace.term, workspace.work, workspace.zeros
    coarse = min(int(share * PARTS), PARTS)
    remainder = share - coarse / PARTS
    fine = min(int(remainder * PARTS * PARTS), PARTS - 1)
    remainder -= fine / (PARTS * PARTS)
    multiply(tables.coarse, coarse, vector, zeros, term)
    multiply(tables.fine, fine, term, zeros, vector)
    if remainder > 0.0:
        # The series from its end.
        copy(vector, term)
        for k in range(tables.terms, 0, -1):
            for r in range(term.size):
                term[r] *= remainder / k
            multiply(tables.generator, 0, term, vector, work)
            copy(work, term)
        copy(term, vector)
