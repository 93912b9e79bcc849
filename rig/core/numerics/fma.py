"""Sums of products in vector registers, by fused multiply-add (FMA, a single rounding of product and sum).

Digital filters and resamplers use them. The order of every sum is fixed, so that a sample of a signal is bit-identical
at every position in a block.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rig.core.numerics.jit import inlined_kernel, kernel
from rig.core.numerics.simd import LANES, WIDE, broadcast

#: Number of parallel sums: enough to hide the latency of an addition, and few enough for the registers. Without
#: AVX-512, eight lanes need two of the sixteen registers, so that eight sums would not fit.
SUMS_AT_ONCE = 8 if get_host_cpu_features().get("avx512f") else 4
#: `weighted_sums` computes a multiple of this number of sums.
SUM_BLOCK = SUMS_AT_ONCE * LANES


@intrinsic
def _fused(typing_context: Any, factor: Any, other_factor: Any, addend: Any) -> Any:
    """Return factor * other_factor + addend."""
    signature = types.float64(types.float64, types.float64, types.float64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return signature, generate


@inlined_kernel
def fused(factor: float, other_factor: float, addend: float) -> float:
    """Return factor * other_factor + addend with a single rounding."""
    return _fused(factor, other_factor, addend)  # type: ignore[call-arg]  # numba supplies the context


def _register_pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Return a pointer to eight lanes of an array, from a flat index on; `array_type`: numba type of the array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), WIDE.as_pointer())


def _load(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Generate the code that loads eight lanes of an array, from a flat index on; `array_type`: its numba type."""
    register = builder.load(_register_pointer(context, builder, array_type, array, index))
    register.align = 8  # in bytes; arrays that are not from `aligned_zeros` have this alignment
    return register


def _store(context: Any, builder: Any, array_type: Any, array: Any, index: Any, register: Any) -> None:
    """Generate the code that stores eight lanes in an array; parameters as in `_load`."""
    builder.store(register, _register_pointer(context, builder, array_type, array, index)).align = 8


def _fused_lanes(builder: Any) -> Any:
    """Return the LLVM function for a fused multiply-add in all lanes of a register."""
    function_type = ir.FunctionType(WIDE, [WIDE] * 3)
    return cgutils.get_or_insert_function(builder.module, function_type, f"llvm.fma.v{LANES}f64")


def _sums(shared_rows: bool) -> Any:
    """Return an intrinsic for sums in several registers at a time.

    Lane i of register c adds up over the entries e, with indices of flat arrays and L = LANES: out[out_start + L c + i]
    = sum_e rows[row_start + e stride + L c + i] factors[factor_start + e step]. With `shared_rows`, all registers use
    the same rows: sum_e rows[row_start + e stride + i] factors[factor_start + e step + c sum_stride].
    """

    @intrinsic
    def sums(
        typing_context: Any, rows: Any, row_start: Any, stride: Any, factors: Any, factor_start: Any, step: Any,
        sum_stride: Any, count: Any, out: Any, out_start: Any,
    ) -> Any:  # fmt: skip
        integer = types.intp
        signature = types.void(rows, integer, integer, factors, integer, integer, integer, integer, out, integer)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            rows, row_start, stride, factors, factor_start, step, sum_stride, count, out, out_start = arguments
            types_of_arguments, index_type = signature.args, count.type
            data = context.make_array(types_of_arguments[3])(context, builder, factors).data
            fma = _fused_lanes(builder)

            def offset_by(begin: Any, c: int, distance: Any) -> Any:
                """Return the index begin + c distance."""
                return builder.add(begin, builder.mul(ir.Constant(index_type, c), distance))

            def factors_at(index: Any) -> Any:
                return broadcast(builder, builder.load(builder.gep(data, [index])))

            def rows_at(index: Any) -> Any:
                return _load(context, builder, types_of_arguments[0], rows, index)

            def entries(entry: Any) -> list[tuple[Any, Any]]:
                """Return the registers (rows, factors) of an entry e for each of the sums."""
                first = builder.add(row_start, builder.mul(entry, stride))
                start = builder.add(factor_start, builder.mul(entry, step))
                if shared_rows:
                    shared = rows_at(first)
                    return [(shared, factors_at(offset_by(start, c, sum_stride))) for c in range(SUMS_AT_ONCE)]
                shared = factors_at(start)
                lanes = ir.Constant(index_type, LANES)
                return [(rows_at(offset_by(first, c, lanes)), shared) for c in range(SUMS_AT_ONCE)]

            zero = ir.Constant(WIDE, [0.0] * LANES)
            totals = [cgutils.alloca_once_value(builder, zero) for _ in range(SUMS_AT_ONCE)]
            begin, one = ir.Constant(index_type, 0), ir.Constant(index_type, 1)
            with cgutils.for_range_slice(builder, begin, count, one, index_type) as (entry, _):
                for total, pair in zip(totals, entries(entry), strict=True):
                    builder.store(builder.call(fma, [*pair, builder.load(total)]), total)
            for c, total in enumerate(totals):
                index = builder.add(out_start, ir.Constant(index_type, c * LANES))
                _store(context, builder, types_of_arguments[8], out, index, builder.load(total))
            return context.get_dummy_value()

        return signature, generate

    return sums


_weighted_sums, _factored_sums = _sums(shared_rows=False), _sums(shared_rows=True)


@kernel
def weighted_sums(rows: Any, first: int, column: int, weights: Any, count: int, out: Any, length: int) -> None:
    """Compute the weighted sums out[k] = sum_j weights[j] rows[first + j, column + k] for k < length.

    The length is rounded up to a multiple of `SUM_BLOCK`, for which rows and `out` must have room.
    """
    stride = rows.shape[1]
    start = first * stride + column
    for position in range(0, length, SUM_BLOCK):
        _weighted_sums(rows, start + position, stride, weights, 0, 1, 0, count, out, position)


@kernel
def factored_sums(
    rows: Any, factors: Any, start: int, step: int, sum_stride: int, out: Any, first: int, count: int
) -> None:
    """Compute sums of the same rows with different factors.

    out[LANES (first + b) + i] = sum_e rows[e, i] factors[start + e step + b sum_stride] for all lanes i and b < count;
    `factors` and `out` are indexed as flat arrays. The count is rounded up to a multiple of `SUMS_AT_ONCE`, for which
    factors and `out` must have room.

    `start`: index of the first factor; `step`, `sum_stride`: distances to the factor of the next entry and of the next
    sum; `first`, `count`: index of the first sum, and number of sums.
    """
    entries = rows.shape[0]
    for first_sum in range(0, count, SUMS_AT_ONCE):
        position, factor = LANES * (first + first_sum), start + first_sum * sum_stride
        _factored_sums(rows, 0, LANES, factors, factor, step, sum_stride, entries, out, position)


@intrinsic
def _update_states(typing_context: Any, states: Any, factors: Any, weights: Any, value: Any) -> Any:
    """Return the sum of weights times states; then states = factors states + value."""
    signature = types.float64(states, factors, weights, types.float64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        states, factors, weights, value = arguments
        types_of_arguments, fma = signature.args, _fused_lanes(builder)
        value_lanes = broadcast(builder, value)
        total = cgutils.alloca_once_value(builder, ir.Constant(WIDE, [0.0] * LANES))
        size = context.make_array(types_of_arguments[0])(context, builder, states).nitems
        begin, step = ir.Constant(size.type, 0), ir.Constant(size.type, LANES)
        with cgutils.for_range_slice(builder, begin, size, step, size.type) as (position, _):
            before = _load(context, builder, types_of_arguments[0], states, position)
            weight = _load(context, builder, types_of_arguments[2], weights, position)
            factor = _load(context, builder, types_of_arguments[1], factors, position)
            builder.store(builder.call(fma, [weight, before, builder.load(total)]), total)
            after = builder.call(fma, [factor, before, value_lanes])
            _store(context, builder, types_of_arguments[0], states, position, after)
        sums = builder.load(total)
        for distance in (4, 2, 1):
            order = [(lane + distance) % LANES for lane in range(LANES)]
            mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), order)
            sums = builder.fadd(sums, builder.shuffle_vector(sums, ir.Constant(WIDE, ir.Undefined), mask))
        return builder.extract_element(sums, ir.Constant(ir.IntType(32), 0))

    return signature, generate


@inlined_kernel
def update_states(states: Any, factors: Any, weights: Any, value: float) -> float:
    """Return the sum of weights times states; then set states = factors * states + value.

    This is a step of parallel first-order recursive filters. All arrays are float64 of shape (multiple of LANES,).
    """
    return _update_states(states, factors, weights, value)  # type: ignore[call-arg]
