"""Exact propagation of a circuit from sample to sample, for an input of cubic segments.

A discontinuity is an instant in a sample interval at which an impact changes the input abruptly. Disturbances are noise
and offsets. Moments are computed from the output over each interval (`daq.core.dsp.discretization`).
"""

from typing import NamedTuple

from daq.core.dsp.discretization import DiscreteCircuit
from daq.core.dsp.interpolation import CubicInput, copy_into
from daq.core.dsp.limiting import Limits, count_within_limits, propagate_with_limits
from daq.core.dsp.segment_propagation import SegmentWorkspace, propagate_segments, segment_workspace
from rig.core.base.arrays import Array
from rig.core.numerics.fma import factored_sums, fused, weighted_sums
from rig.core.numerics.jit import unfused_kernel
from rig.core.numerics.simd import LANES, aligned_zeros

# Number of intervals in a stretch, which is processed at once; a multiple of `SUM_BLOCK` (`rig.core.numerics.fma`). A
# stretch is long enough for vector instructions, and short enough for the first-level cache.
STRETCH = 128


class CircuitWorkspace(NamedTuple):
    """Working arrays of `propagate`."""

    segments: SegmentWorkspace
    # Input, disturbances and states at the start of each interval of a stretch, and at the end of the stretch; (4 +
    # disturbances + states, STRETCH + LANES).
    sources: Array
    magnitudes: Array  # magnitudes of `sources`
    sums: Array  # contributions to the states of a section; (2, STRETCH)


def circuit_workspace(discrete: DiscreteCircuit) -> CircuitWorkspace:
    """Allocate the working arrays for a circuit."""
    # The rows are longer than a stretch, because they include the state at its end. Rows whose length is a power of two
    # would also compete for the same cache lines.
    sources, magnitudes = (aligned_zeros(discrete.moment_weights.shape[0], STRETCH + LANES) for _ in range(2))
    return CircuitWorkspace(
        segment_workspace(discrete.generator.shape[2]), sources, magnitudes, aligned_zeros(2, STRETCH)
    )


@unfused_kernel
def propagate(
    cubics: CubicInput,
    discrete: DiscreteCircuit,
    limits: Limits | None,
    state: Array,  # state at the last sample, updated; (states,)
    disturbances: Array,  # V; (disturbances, intervals)
    state_rows: Array,  # weights of the states in each output; (outputs, states)
    input_weights: Array,  # weight of the input in each output; (outputs,)
    excess_weights: Array,  # weight of the excess over the limit in each output; (outputs,)
    outputs: Array,  # filled: outputs at the samples [V]; (outputs, intervals)
    moments: Array,  # filled: moments of the circuit's output; (intervals + SUMS_AT_ONCE or 0, LANES)
    # Filled: severity of each interval's overload: 0 without overload, otherwise 1 + remaining zero shift / limit. The
    # first element belongs to the last interval of the previous block; (1 + intervals,).
    overload: Array,
    workspace: CircuitWorkspace,
) -> None:
    """Propagate a circuit over the intervals of a block, and fill in outputs, moments and overload.

    Stretches of intervals without discontinuities are processed section by section, because a section depends only on
    previous sections. Each sum, except the recurrence of the section itself, is then computed for many samples at a
    time. The order of every sum is fixed, so that no result depends on the end of a stretch or a block. Intervals with
    discontinuities, intervals in which a limit may be reached, and the next intervals after an overload are processed
    one by one (`daq.core.dsp.limiting`).
    """
    sources = workspace.sources
    first_state_row = 4 + disturbances.shape[0]
    segment, first, intervals = 0, 0, cubics.interval_cubics.shape[1]
    while first < intervals:
        overload[1 + first] = 0.0
        has_discontinuities = segment < cubics.segment_interval.size and cubics.segment_interval[segment] == first
        # Whether the interval is propagated with limits. A circuit without limits is compiled without this code.
        with_limits = False
        if limits is not None:
            with_limits = has_discontinuities or overload[first] > 0.0
        stop, excess = first + 1, 0.0
        if not has_discontinuities and not with_limits:
            stop = min(first + STRETCH, intervals)
            if segment < cubics.segment_interval.size:
                stop = min(stop, cubics.segment_interval[segment])
            _copy_inputs(cubics, disturbances, first, stop, sources)
            _propagate_stretch(discrete, state, sources, workspace.sums, stop - first)
            count = stop - first
            if limits is not None:
                count = count_within_limits(limits, sources, workspace.magnitudes, workspace.sums[0], count)
            if count < stop - first:
                stop = first + count
                for j in range(discrete.states):
                    state[j] = sources[first_state_row + j, count]
                if count == 0:
                    with_limits, stop = True, first + 1
            for k in range(first, stop):
                overload[1 + k] = 0.0
            if not with_limits and discrete.integrals:
                factored_sums(discrete.moment_weights, sources, 0, sources.shape[1], 1, moments, first, stop - first)
        if has_discontinuities or with_limits:
            if with_limits and limits is not None:
                segment, excess = propagate_with_limits(
                    cubics, segment, first, discrete, limits, state, disturbances, overload, workspace.segments
                )
            else:
                segment = propagate_segments(cubics, segment, discrete, state, workspace.segments)
                _add_disturbances(discrete, state, disturbances[:, first], workspace.segments.vector)
            for j in range(discrete.states):
                sources[first_state_row + j, 1] = state[j]
            for k in range(discrete.integrals):
                moments[first, k] = workspace.segments.vector[discrete.states + k]
        for r in range(state_rows.shape[0]):
            weighted_sums(sources, first_state_row, 1, state_rows[r], discrete.states, workspace.sums[0], stop - first)
            for k in range(first, stop):
                outputs[r, k] = fused(input_weights[r], cubics.interval_cubics[1, k], workspace.sums[0, k - first])
            outputs[r, first] += excess_weights[r] * excess
        first = stop


@unfused_kernel
def _copy_inputs(cubics: CubicInput, disturbances: Array, first: int, stop: int, sources: Array) -> None:
    """Copy input and disturbances of a stretch to the rows above the states."""
    for k in range(4):
        copy_into(cubics.interval_cubics[k, first:stop], sources[k, : stop - first])
    for e in range(disturbances.shape[0]):
        copy_into(disturbances[e, first:stop], sources[4 + e, : stop - first])


@unfused_kernel
def _propagate_stretch(discrete: DiscreteCircuit, state: Array, sources: Array, sums: Array, count: int) -> None:
    """Propagate the circuit over intervals without discontinuities; fill in the states of `sources` in order."""
    first_state_row = sources.shape[0] - discrete.states
    for section in range(discrete.first_states.size - 1):
        begin, end = discrete.first_states[section], discrete.first_states[section + 1]
        row = first_state_row + begin
        weighted_sums(sources, 0, 0, discrete.state_weights[begin], row, sums[0], count)
        if end == begin + 1:
            pole = discrete.transition[begin, begin]
            state[begin] = _propagate_first_order(pole, state[begin], sums[0][:count], sources[row])
        else:
            weighted_sums(sources, 0, 0, discrete.state_weights[begin + 1], row, sums[1], count)
            _propagate_second_order(
                discrete.transition, begin, state, sums[0][:count], sums[1], sources[row], sources[row + 1]
            )


@unfused_kernel
def _propagate_first_order(pole: float, initial: float, inputs: Array, values: Array) -> float:
    """Propagate the state of a first-order section; fill in its values at the start of each interval and at the end.

    Returns the last value. `inputs`: contributions to the state over each interval.
    """
    x = initial
    for k in range(inputs.size):
        values[k] = x
        x = fused(pole, x, inputs[k])
    values[inputs.size] = x
    return x


@unfused_kernel
def _propagate_second_order(
    transition: Array, begin: int, state: Array, inputs_x: Array, inputs_y: Array, values_x: Array, values_y: Array
) -> None:
    """Propagate both states of a second-order section, x and y; write their values like `_propagate_first_order`.

    `begin`: index of x; `inputs_x`, `inputs_y`: contributions over each interval.
    """
    xx, xy = transition[begin, begin], transition[begin + 1, begin]
    yx, yy = transition[begin, begin + 1], transition[begin + 1, begin + 1]
    x, y = state[begin], state[begin + 1]
    for k in range(inputs_x.size):
        values_x[k], values_y[k] = x, y
        x, y = fused(xx, x, fused(xy, y, inputs_x[k])), fused(yy, y, fused(yx, x, inputs_y[k]))
    values_x[inputs_x.size], values_y[inputs_x.size] = x, y
    state[begin], state[begin + 1] = x, y


@unfused_kernel
def _add_disturbances(discrete: DiscreteCircuit, state: Array, disturbances: Array, vector: Array) -> None:
    """Add the contributions of disturbances at the end of an interval with discontinuities, and copy the states."""
    for e in range(disturbances.shape[0]):
        for r in range(discrete.width):
            vector[r] += discrete.transition[discrete.states + 4 + e, r] * disturbances[e]
    for j in range(discrete.states):
        state[j] = vector[j]
