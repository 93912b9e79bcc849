"""Matrix times vector in vector registers: the one place where numba is told which instructions to use.

The kernel multiplies small matrices with a vector millions of times a second. Written as plain loops numba
keeps the sums in memory; as eight lanes of one register the same product costs half. The order of the sums is
fixed, so results do not depend on the number of columns handled at once, the block size or the optimiser.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rig.jit import inlined

#: Rows are padded to a multiple of this.
LANES = 8


def padded(count: int) -> int:
    """Round a number of rows up to full registers.

    >>> padded(0), padded(8), padded(9)
    (8, 8, 16)
    """
    return max(LANES, -(-count // LANES) * LANES)


@intrinsic
def _lane_sums(
    typing_context: Any, matrix: Any, start: Any, constant: Any, offset: Any, vector: Any, columns: Any,
    stride: Any, out: Any, row: Any,
) -> Any:  # fmt: skip
    """out[row + 0..7] = constant[offset + 0..7] + sum_c matrix[start + c stride + 0..7] vector[c], flat indices."""
    signature = types.void(
        matrix, types.intp, constant, types.intp, vector, types.intp, types.intp, out, types.intp
    )

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        matrix, start, constant, offset, vector, columns, stride, out, row = arguments
        double, lanes = ir.DoubleType(), ir.VectorType(ir.DoubleType(), LANES)
        undefined = ir.Constant(lanes, ir.Undefined)
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)

        def pointer(position: int, value: Any, index: Any, kind: Any) -> Any:
            array = context.make_array(signature.args[position])(context, builder, value)
            return builder.bitcast(builder.gep(array.data, [index]), kind.as_pointer())

        def load(position: int, value: Any, index: Any) -> Any:
            register = builder.load(pointer(position, value, index, lanes))
            register.align = 8
            return register

        def add_column(total: Any, column: Any) -> None:
            factor = builder.load(pointer(4, vector, column, double))
            one = builder.insert_element(undefined, factor, ir.Constant(ir.IntType(32), 0))
            factors = builder.shuffle_vector(one, undefined, everywhere)
            rows = load(0, matrix, builder.add(start, builder.mul(column, stride)))
            product = builder.fmul(rows, factors, flags=("contract",))
            builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)

        # Two sums at a time, even and odd columns: an addition takes longer than two may be started.
        even = cgutils.alloca_once_value(builder, load(2, constant, offset))
        odd = cgutils.alloca_once_value(builder, ir.Constant(lanes, [0.0] * LANES))
        one, two = (ir.Constant(columns.type, count) for count in (1, 2))
        with cgutils.for_range_slice(builder, one, columns, two, columns.type) as (column, _):
            add_column(even, builder.sub(column, one))
            add_column(odd, column)
        is_left_over = builder.icmp_signed("==", builder.and_(columns, one), one)
        with builder.if_then(is_left_over):
            add_column(even, builder.sub(columns, one))
        total = builder.fadd(builder.load(even), builder.load(odd))
        store = builder.store(total, pointer(7, out, row, lanes))
        store.align = 8
        return context.get_dummy_value()

    return signature, generate


@inlined
def combine(matrix: Any, constant: Any, slot: int, vector: Any, columns: int, out: Any) -> None:
    """Out = matrix[slot]^T vector + constant[slot].

    Parameters
    ----------
    matrix : float64 (slots, columns, rows), C-contiguous, rows a multiple of LANES
    constant : float64 (slots, rows)
    slot : int
    vector : float64 (at least columns,)
    columns : int
    out : float64 (rows,), or any contiguous array of that size
    """
    rows = constant.shape[1]
    for row in range(0, rows, LANES):
        _lane_sums(  # type: ignore[call-arg]  # numba supplies the typing context
            matrix, slot * columns * rows + row, constant, slot * rows + row, vector, columns, rows, out, row
        )
