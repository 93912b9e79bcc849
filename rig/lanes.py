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
#: Sums that run beside each other in a product, a power of two.
SUMS = 4


def padded(count: int) -> int:
    """Round a number of rows up to full registers.

    >>> padded(0), padded(8), padded(9)
    (8, 8, 16)
    """
    return max(LANES, -(-count // LANES) * LANES)


_WIDE = ir.VectorType(ir.DoubleType(), LANES)


def _place(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Pointer to eight lanes of an array, from a flat index on."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _WIDE.as_pointer())


def _load(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    register = builder.load(_place(context, builder, kind, array, index))
    register.align = 8
    return register


def _store(context: Any, builder: Any, kind: Any, array: Any, index: Any, register: Any) -> None:
    builder.store(register, _place(context, builder, kind, array, index)).align = 8


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
        kinds = signature.args
        undefined = ir.Constant(_WIDE, ir.Undefined)
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        data = context.make_array(kinds[4])(context, builder, vector).data

        def add_column(total: Any, column: Any) -> None:
            factor = builder.load(builder.gep(data, [column]))
            one = builder.insert_element(undefined, factor, ir.Constant(ir.IntType(32), 0))
            factors = builder.shuffle_vector(one, undefined, everywhere)
            place = builder.add(start, builder.mul(column, stride))
            rows = _load(context, builder, kinds[0], matrix, place)
            product = builder.fmul(rows, factors, flags=("contract",))
            builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)

        # Several sums at a time: an addition takes longer than the next may be started.
        first = _load(context, builder, kinds[2], constant, offset)
        zero = ir.Constant(_WIDE, [0.0] * LANES)
        totals = [cgutils.alloca_once_value(builder, value) for value in (first, *[zero] * (SUMS - 1))]
        number = [ir.Constant(columns.type, count) for count in range(SUMS + 1)]
        whole = builder.sub(columns, builder.srem(columns, number[SUMS]))
        with cgutils.for_range_slice(builder, number[0], whole, number[SUMS], columns.type) as (column, _):
            for count, total in enumerate(totals):
                add_column(total, builder.add(column, number[count]))
        with cgutils.for_range_slice(builder, whole, columns, number[1], columns.type) as (column, _):
            add_column(totals[0], column)
        sums = [builder.load(total) for total in totals]
        while len(sums) > 1:
            sums = [builder.fadd(*pair) for pair in zip(sums[::2], sums[1::2], strict=True)]
        _store(context, builder, kinds[7], out, row, sums[0])
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _lanes_exceed(typing_context: Any, vector: Any, bound: Any, row: Any) -> Any:
    """Whether |vector[row + i]| > bound[row + i] for any of i = 0..7; not a number counts as exceeding."""
    signature = types.boolean(vector, bound, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector, bound = (
            _load(context, builder, kind, array, arguments[2])
            for kind, array in zip(signature.args[:2], arguments[:2], strict=True)
        )
        kind = ir.FunctionType(_WIDE, [_WIDE])
        absolute = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fabs.v{LANES}f64")
        exceeds = builder.fcmp_unordered(">", builder.call(absolute, [vector]), bound)
        mask = builder.bitcast(exceeds, ir.IntType(LANES))
        return builder.icmp_unsigned("!=", mask, ir.Constant(mask.type, 0))

    return signature, generate


@intrinsic
def _copy_lanes(typing_context: Any, source: Any, target: Any, offset: Any, row: Any) -> Any:
    """target[offset + row + 0..7] = source[row + 0..7], flat indices."""
    signature = types.void(source, target, types.intp, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, target, offset, row = arguments
        register = _load(context, builder, signature.args[0], source, row)
        _store(context, builder, signature.args[1], target, builder.add(offset, row), register)
        return context.get_dummy_value()

    return signature, generate


@inlined
def copy(source: Any, target: Any, offset: int) -> None:
    """Copy a vector of shape (multiple of LANES,) into a contiguous array, from a flat index on."""
    for row in range(0, source.shape[0], LANES):
        _copy_lanes(source, target, offset, row)  # type: ignore[call-arg]  # numba supplies the context


@intrinsic
def _transpose_tile(
    typing_context: Any, source: Any, start: Any, width: Any, target: Any, place: Any, stride: Any
) -> Any:
    """target[place + i stride + 0..7] = source[start + (0..7) width + i] for i = 0..7, flat indices."""
    signature = types.void(source, types.intp, types.intp, target, types.intp, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, start, width, target, place, stride = arguments
        number = [ir.Constant(start.type, count) for count in range(LANES)]

        def along(begin: Any, count: int, step: Any) -> Any:
            return builder.add(begin, builder.mul(number[count], step))

        def choose(one: Any, other: Any, lanes: list[int]) -> Any:
            return builder.shuffle_vector(one, other, ir.Constant(ir.VectorType(ir.IntType(32), LANES), lanes))

        tile = [
            _load(context, builder, signature.args[0], source, along(start, i, width)) for i in range(LANES)
        ]
        # Exchange blocks of one, two and four lanes across the diagonal.
        for size in (1, 2, 4):
            for i in (i for i in range(LANES) if not i & size):
                one, other = tile[i], tile[i + size]
                low = [lane if not lane & size else LANES + lane - size for lane in range(LANES)]
                high = [lane + size if not lane & size else LANES + lane for lane in range(LANES)]
                tile[i], tile[i + size] = choose(one, other, low), choose(one, other, high)
        for i, register in enumerate(tile):
            _store(context, builder, signature.args[3], target, along(place, i, stride), register)
        return context.get_dummy_value()

    return signature, generate


@inlined
def transpose(window: Any, rows: Any, column: int) -> None:
    """Write a window of shape (LANES, width) into rows (width, columns) from a column on; both contiguous."""
    width, columns = rows.shape
    for row in range(0, width, LANES):
        place = row * columns + column
        _transpose_tile(window, row, width, rows, place, columns)  # type: ignore[call-arg]


@inlined
def exceeds(vector: Any, bound: Any) -> bool:
    """Whether any element is larger than its bound in size, or not a number; shapes (multiple of LANES,)."""
    for row in range(0, bound.shape[0], LANES):
        if _lanes_exceed(vector, bound, row):  # type: ignore[call-arg]
            return True
    return False


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
