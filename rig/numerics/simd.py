"""Matrix times vector in vector registers: here, and in `rig.numerics.fma`, the instructions are chosen explicitly.

The kernel multiplies small matrices with a vector millions of times a second. Written as plain loops numba
keeps the sums in memory; as eight lanes of one register the same product costs half. The order of the sums is
fixed, so results do not depend on the number of columns handled at once, the block size or the optimiser.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rig.numerics.jit import compiled, inlined

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


def zeros(*shape: int) -> np.ndarray:
    """Zeros that begin on the boundary of a register in memory: then no register has to be read in two halves."""
    count = math.prod(shape)
    room = np.zeros(count + LANES)
    start = -(room.__array_interface__["data"][0] // room.itemsize) % LANES
    return room[start : start + count].reshape(shape)


#: A register.
WIDE = ir.VectorType(ir.DoubleType(), LANES)


def _place(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Pointer to eight lanes of an array, from a flat index on."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), WIDE.as_pointer())


def load(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Load eight lanes of an array, from a flat index on."""
    register = builder.load(_place(context, builder, kind, array, index))
    register.align = 8
    return register


def store(context: Any, builder: Any, kind: Any, array: Any, index: Any, register: Any) -> None:
    """Store eight lanes in an array, from a flat index on."""
    builder.store(register, _place(context, builder, kind, array, index)).align = 8


def broadcast(builder: Any, value: Any) -> Any:
    """Fill a register with one number."""
    undefined, lane = ir.Constant(WIDE, ir.Undefined), ir.VectorType(ir.IntType(32), LANES)
    one = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(lane, [0] * LANES))


def _lane_sums(registers: int) -> Any:
    """Make the product for a number of registers of rows, a divisor of `SUMS`.

    out[row + i] = constant[offset + i] + sum_c matrix[start + c stride + i] vector[c], flat indices, for the rows
    i of all registers. An addition takes longer than the next may be started, so `SUMS` of them run beside each
    other: of several registers, or of several columns.
    """
    beside = SUMS // registers

    @intrinsic
    def lane_sums(
        typing_context: Any, matrix: Any, start: Any, constant: Any, offset: Any, vector: Any, columns: Any,
        stride: Any, out: Any, row: Any,
    ) -> Any:  # fmt: skip
        signature = types.void(
            matrix, types.intp, constant, types.intp, vector, types.intp, types.intp, out, types.intp
        )

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            matrix, start, constant, offset, vector, columns, stride, out, row = arguments
            kinds, number = signature.args, columns.type
            zero = ir.Constant(WIDE, [0.0] * LANES)
            data = context.make_array(kinds[4])(context, builder, vector).data

            def at(index: Any, register: int) -> Any:
                return builder.add(index, ir.Constant(number, register * LANES))

            def add_column(column: Any, count: int) -> None:
                factors = broadcast(builder, builder.load(builder.gep(data, [column])))
                place = builder.add(start, builder.mul(column, stride))
                for register in range(registers):
                    total = totals[register][count]
                    rows = load(context, builder, kinds[0], matrix, at(place, register))
                    product = builder.fmul(rows, factors, flags=("contract",))
                    builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)

            totals = []
            for register in range(registers):
                first = load(context, builder, kinds[2], constant, at(offset, register))
                values = (first, *[zero] * (beside - 1))
                totals.append([cgutils.alloca_once_value(builder, value) for value in values])
            step, one = ir.Constant(number, beside), ir.Constant(number, 1)
            whole = builder.sub(columns, builder.srem(columns, step))
            with cgutils.for_range_slice(builder, ir.Constant(number, 0), whole, step, number) as (column, _):
                for count in range(beside):
                    add_column(builder.add(column, ir.Constant(number, count)), count)
            if beside > 1:
                with cgutils.for_range_slice(builder, whole, columns, one, number) as (column, _):
                    add_column(column, 0)
            for register in range(registers):
                sums = [builder.load(total) for total in totals[register]]
                while len(sums) > 1:
                    sums = [builder.fadd(*pair) for pair in zip(sums[::2], sums[1::2], strict=True)]
                store(context, builder, kinds[7], out, at(row, register), sums[0])
            return context.get_dummy_value()

        return signature, generate

    return lane_sums


_one, _four = _lane_sums(1), _lane_sums(4)


@intrinsic
def _lanes_exceed(typing_context: Any, vector: Any, bound: Any, row: Any) -> Any:
    """Whether |vector[row + i]| > bound[row + i] for any of i = 0..7; not a number counts as exceeding."""
    signature = types.boolean(vector, bound, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector, bound = (
            load(context, builder, kind, array, arguments[2])
            for kind, array in zip(signature.args[:2], arguments[:2], strict=True)
        )
        kind = ir.FunctionType(WIDE, [WIDE])
        absolute = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fabs.v{LANES}f64")
        exceeds = builder.fcmp_unordered(">", builder.call(absolute, [vector]), bound)
        mask = builder.bitcast(exceeds, ir.IntType(LANES))
        return builder.icmp_unsigned("!=", mask, ir.Constant(mask.type, 0))

    return signature, generate


@intrinsic
def _lane_minimum(typing_context: Any, vector: Any, row: Any) -> Any:
    """Smallest of vector[row + 0..7], none of which is not a number."""
    signature = types.float64(vector, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.DoubleType(), [WIDE])
        minimum = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.fmin.v{LANES}f64")
        register = load(context, builder, signature.args[0], *arguments)
        return builder.call(minimum, [register], fastmath=("nnan",))

    return signature, generate


@intrinsic
def _negative_lanes(typing_context: Any, vector: Any, row: Any) -> Any:
    """Bit i is set where vector[row + i] is below zero."""
    signature = types.int64(vector, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        register = load(context, builder, signature.args[0], *arguments)
        below = builder.fcmp_ordered("<", register, ir.Constant(WIDE, [0.0] * LANES))
        return builder.zext(builder.bitcast(below, ir.IntType(LANES)), ir.IntType(64))

    return signature, generate


@inlined
def lowest(vector: Any) -> float:
    """Smallest element of a vector of shape (multiple of LANES,)."""
    least = np.inf
    for row in range(0, vector.shape[0], LANES):
        least = min(least, _lane_minimum(vector, row))  # type: ignore[call-arg]  # numba supplies the context
    return least


@inlined
def negatives(vector: Any) -> int:
    """Bit i is set where element i of a vector of shape (multiple of LANES, at most 56,) is below zero."""
    found = 0
    for row in range(0, vector.shape[0], LANES):
        found |= _negative_lanes(vector, row) << row  # type: ignore[call-arg]
    return found


@intrinsic
def _copy_lanes(typing_context: Any, source: Any, target: Any, row: Any) -> Any:
    """target[row + 0..7] = source[row + 0..7]."""
    signature = types.void(source, target, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, target, row = arguments
        register = load(context, builder, signature.args[0], source, row)
        store(context, builder, signature.args[1], target, row, register)
        return context.get_dummy_value()

    return signature, generate


@inlined
def copy(source: Any, target: Any) -> None:
    """Copy a vector of shape (multiple of LANES,) into another."""
    for row in range(0, source.shape[0], LANES):
        _copy_lanes(source, target, row)  # type: ignore[call-arg]  # numba supplies the context


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
            return builder.shuffle_vector(
                one, other, ir.Constant(ir.VectorType(ir.IntType(32), LANES), lanes)
            )

        tile = [
            load(context, builder, signature.args[0], source, along(start, i, width)) for i in range(LANES)
        ]
        # Exchange blocks of one, two and four lanes across the diagonal.
        for size in (1, 2, 4):
            for i in (i for i in range(LANES) if not i & size):
                one, other = tile[i], tile[i + size]
                low = [lane if not lane & size else LANES + lane - size for lane in range(LANES)]
                high = [lane + size if not lane & size else LANES + lane for lane in range(LANES)]
                tile[i], tile[i + size] = choose(one, other, low), choose(one, other, high)
        for i, register in enumerate(tile):
            store(context, builder, signature.args[3], target, along(place, i, stride), register)
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
    found = False
    for row in range(0, bound.shape[0], LANES):
        found |= _lanes_exceed(vector, bound, row)  # type: ignore[call-arg]
    return found


@inlined
def combine(matrix: Any, constant: Any, slot: int, vector: Any, columns: int, out: Any) -> None:
    """Out = matrix[slot]^T vector + constant[slot].

    Parameters
    ----------
    matrix : float64 (slots, at least columns, rows), C-contiguous, rows a multiple of LANES
    constant : float64 (slots, rows)
    vector : float64 (at least columns,)
    columns : int
        A multiple of SUMS is quickest.
    out : float64 (rows,), or any contiguous array of that size
    """
    _combine_from(matrix, constant, slot, vector, columns, out, 0)


@inlined
def combine_many(matrix: Any, constant: Any, slot: int, vector: Any, columns: int, out: Any) -> None:
    """Do the same for many rows: longer code, which reads the vector a quarter as often."""
    rows = constant.shape[1]
    most = rows - rows % (4 * LANES)
    for row in range(0, most, 4 * LANES):
        place = slot * matrix.shape[1] * rows + row
        _four(matrix, place, constant, slot * rows + row, vector, columns, rows, out, row)
    _combine_from(matrix, constant, slot, vector, columns, out, most)


@inlined
def _combine_from(
    matrix: Any, constant: Any, slot: int, vector: Any, columns: int, out: Any, first: int
) -> None:
    rows = constant.shape[1]
    for row in range(first, rows, LANES):
        place = slot * matrix.shape[1] * rows + row
        _one(matrix, place, constant, slot * rows + row, vector, columns, rows, out, row)


@compiled
def multiply(matrix: Any, slot: int, vector: Any, constant: Any, out: Any) -> None:
    """Out = matrix[slot]^T vector + constant, the same for all slots.

    Parameters
    ----------
    matrix : float64 (slots, columns, rows), C-contiguous, rows a multiple of LANES
    vector : float64 (columns,)
    constant, out : float64 (rows,)
        Not the same array.
    """
    columns, rows = matrix.shape[1], matrix.shape[2]
    for row in range(0, rows, LANES):
        _one(matrix, slot * columns * rows + row, constant, row, vector, columns, rows, out, row)
