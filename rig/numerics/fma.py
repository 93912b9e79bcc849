"""Sums of products in vector registers, each product rounded once with its sum.

For signals that come in blocks: every sum has one fixed order, so that a sample comes out the same to the last bit
wherever in a block it is.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rig.numerics.jit import compiled, inlined
from rig.numerics.simd import LANES, WIDE, broadcast, load, store

#: Registers in use at a time: enough that no sum waits for another, and no more than the processor has. Where eight
#: lanes take two of its sixteen, eight sums would be in memory, which takes three times as long.
TOGETHER = 8 if get_host_cpu_features().get("avx512f") else 4
#: Sums that `weigh` forms at least.
WEIGHED = TOGETHER * LANES


@intrinsic
def _fused(typing_context: Any, one: Any, other: Any, third: Any) -> Any:
    """One times other plus third."""
    signature = types.float64(types.float64, types.float64, types.float64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return signature, generate


@inlined
def fused(one: float, other: float, third: float) -> float:
    """Multiply two numbers and add a third."""
    return _fused(one, other, third)  # type: ignore[call-arg]  # numba supplies the context


def _fused_lanes(builder: Any) -> Any:
    """Return the function of LLVM that does this in all lanes of a register."""
    kind = ir.FunctionType(WIDE, [WIDE] * 3)
    return cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{LANES}f64")


def _sums(same_rows: bool) -> Any:
    """Make sums for several registers at a time.

    out[place + 8 c + i] = sum_e rows[row + e stride + 8 c + i] factors[factor + e step] for the lanes i of all
    registers c; or, where all have the same rows and each its factors,
    sum_e rows[row + e stride + i] factors[factor + e step + c apart]. Flat indices.
    """

    @intrinsic
    def sums(
        typing_context: Any, rows: Any, row: Any, stride: Any, factors: Any, factor: Any, step: Any, apart: Any,
        count: Any, out: Any, place: Any,
    ) -> Any:  # fmt: skip
        whole = types.intp
        signature = types.void(rows, whole, whole, factors, whole, whole, whole, whole, out, whole)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            rows, row, stride, factors, factor, step, apart, count, out, place = arguments
            kinds, number = signature.args, count.type
            data = context.make_array(kinds[3])(context, builder, factors).data
            fma = _fused_lanes(builder)

            def along(begin: Any, c: int, distance: Any) -> Any:
                return builder.add(begin, builder.mul(ir.Constant(number, c), distance))

            def factors_at(index: Any) -> Any:
                return broadcast(builder, builder.load(builder.gep(data, [index])))

            def rows_at(index: Any) -> Any:
                return load(context, builder, kinds[0], rows, index)

            def entries(entry: Any) -> list[tuple[Any, Any]]:
                first = builder.add(row, builder.mul(entry, stride))
                start = builder.add(factor, builder.mul(entry, step))
                if same_rows:
                    shared = rows_at(first)
                    return [(shared, factors_at(along(start, c, apart))) for c in range(TOGETHER)]
                shared = factors_at(start)
                lanes = ir.Constant(number, LANES)
                return [(rows_at(along(first, c, lanes)), shared) for c in range(TOGETHER)]

            zero = ir.Constant(WIDE, [0.0] * LANES)
            totals = [cgutils.alloca_once_value(builder, zero) for _ in range(TOGETHER)]
            begin, one = ir.Constant(number, 0), ir.Constant(number, 1)
            with cgutils.for_range_slice(builder, begin, count, one, number) as (entry, _):
                for total, pair in zip(totals, entries(entry), strict=True):
                    builder.store(builder.call(fma, [*pair, builder.load(total)]), total)
            for c, total in enumerate(totals):
                end = builder.add(place, ir.Constant(number, c * LANES))
                store(context, builder, kinds[8], out, end, builder.load(total))
            return context.get_dummy_value()

        return signature, generate

    return sums


_weigh, _spread = _sums(same_rows=False), _sums(same_rows=True)


@compiled
def weigh(rows: Any, first: int, column: int, weights: Any, count: int, out: Any, length: int) -> None:
    """Sum up rows, each times its weight: out[k] = sum_j weights[j] rows[first + j, column + k] for k < length.

    The length is rounded up to a multiple of `WEIGHED`: rows and `out` must have that much room.

    `first`, `column`: where to begin.
    """
    stride = rows.shape[1]
    start = first * stride + column
    for place in range(0, length, WEIGHED):
        _weigh(rows, start + place, stride, weights, 0, 1, 0, count, out, place)


@compiled
def spread(
    rows: Any, factors: Any, start: int, step: int, apart: int, out: Any, first: int, count: int
) -> None:
    """Sum up the same rows with factors that differ from sum to sum.

    out[8 (first + b) + i] = sum_e rows[e, i] factors[start + e step + b apart] for all lanes i and b < count;
    flat indices of `factors` and `out`. The count is rounded up to a multiple of `TOGETHER`: factors and `out`
    must have that much room.

    `start`, `step`, `apart`: place of the first factor; how far it is to that of the next entry, and of the next
    sum; `first`, `count`: number of the first sum, and how many there are.
    """
    entries = rows.shape[0]
    for done in range(0, count, TOGETHER):
        place, factor = LANES * (first + done), start + done * apart
        _spread(rows, 0, LANES, factors, factor, step, apart, entries, out, place)


@intrinsic
def _follow(typing_context: Any, states: Any, keep: Any, weights: Any, value: Any) -> Any:
    """Sum up weights times states; states = keep states + value."""
    signature = types.float64(states, keep, weights, types.float64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        states, keep, weights, value = arguments
        kinds, fma = signature.args, _fused_lanes(builder)
        everywhere = broadcast(builder, value)
        total = cgutils.alloca_once_value(builder, ir.Constant(WIDE, [0.0] * LANES))
        size = context.make_array(kinds[0])(context, builder, states).nitems
        begin, step = ir.Constant(size.type, 0), ir.Constant(size.type, LANES)
        with cgutils.for_range_slice(builder, begin, size, step, size.type) as (place, _):
            before = load(context, builder, kinds[0], states, place)
            weight = load(context, builder, kinds[2], weights, place)
            kept = load(context, builder, kinds[1], keep, place)
            builder.store(builder.call(fma, [weight, before, builder.load(total)]), total)
            store(context, builder, kinds[0], states, place, builder.call(fma, [kept, before, everywhere]))
        sums = builder.load(total)
        for distance in (4, 2, 1):
            order = [(lane + distance) % LANES for lane in range(LANES)]
            mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), order)
            sums = builder.fadd(sums, builder.shuffle_vector(sums, ir.Constant(WIDE, ir.Undefined), mask))
        return builder.extract_element(sums, ir.Constant(ir.IntType(32), 0))

    return signature, generate


@inlined
def follow(states: Any, keep: Any, weights: Any, value: float) -> float:
    """Sum up weights times states; then each state keeps its share of itself and adds a value.

    All are float64 of shape (multiple of LANES,); `states` is updated.
    """
    return _follow(states, keep, weights, value)  # type: ignore[call-arg]
