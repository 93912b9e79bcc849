"""Filter of second-order sections in series, as `scipy.signal.sosfilt`; the import of scipy.signal takes longer."""

from rig.core.base.arrays import Array
from rig.core.numerics.jit import unfused_kernel


@unfused_kernel
def filter_sections(sections: Array, state: Array, samples: Array, result: Array) -> None:
    """Filter samples in the transposed direct form II, and update the state.

    `sections`, shape (sections, 6): numerator b0, b1, b2 and denominator 1, a1, a2; `state`, shape (sections, 2).
    """
    for i in range(samples.size):
        output = samples[i]
        for section in range(len(sections)):
            value = output
            output = sections[section, 0] * value + state[section, 0]
            state[section, 0] = sections[section, 1] * value - sections[section, 4] * output + state[section, 1]
            state[section, 1] = sections[section, 2] * value - sections[section, 5] * output
        result[i] = output
