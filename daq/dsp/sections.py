"""Recursive filter of second-order sections."""

from __future__ import annotations

from rig.arrays import Array
from rig.numerics.jit import unfused_kernel


@unfused_kernel
def filter_sections(sections: Array, state: Array, samples: Array) -> None:
    """Filter samples in place by sections in series, in the transposed direct form II.

    `sections`: the coefficients b0, b1, b2, a1 and a2 of each section (a0 is 1), shape (sections, 5); `state`: shape
    (sections, 2), zero at rest.
    """
    for s in range(len(sections)):
        b0, b1, b2, a1, a2 = sections[s]
        first, second = state[s]
        for k in range(samples.size):
            value = samples[k]
            samples[k] = b0 * value + first
            first = b1 * value - a1 * samples[k] + second
            second = b2 * value - a2 * samples[k]
        state[s, 0], state[s, 1] = first, second
