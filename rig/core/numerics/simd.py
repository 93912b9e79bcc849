"""Products of a matrix and a vector in vector registers of the processor (SIMD), and elementwise operations.

The engine multiplies small matrices with a vector millions of times a second. In plain loops numba keeps the sums in
memory; with sums in registers of eight values (lanes) the product takes half the time. The instructions are therefore
generated explicitly with llvmlite, as in `rig.core.numerics.fma`. The order of the sums is fixed, so that results do
not depend on the number of columns, the block size or the optimizer.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rig.core.numerics.jit import inlined_kernel, kernel

#: Number of values in a register; rows are padded to a multiple of it.
LANES = 8
#: Number of sums that a product computes in parallel, a power of two.
SUMS = 4


def padded_length(count: int) -> int:
    """Round a number of rows up to full registers.

    >>> padded_length(0), padded_length(8), padded_length(9)
    (8, 8, 16)
    """
    return max(LANES, -(-count // LANES) * LANES)  # rounded up


def aligned_zeros(*shape: int) -> np.ndarray:
    """Return an array of zeros whose address is a multiple of a register's size, so that loads are not split."""
    count = math.prod(shape)
    with_margin = np.zeros(count + LANES)
    start = -(with_margin.__array_interface__["data"][0] // with_margin.itemsize) % LANES
    return with_margin[start : start + count].reshape(shape)


#: LLVM type of a register.
WIDE = ir.VectorType(ir.DoubleType(), LANES)


def broadcast(builder: Any, value: Any) -> Any:
    """Generate the code that fills a register with one number."""
    undefined, lane_numbers = ir.Constant(WIDE, ir.Undefined), ir.VectorType(ir.IntType(32), LANES)
    first = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(lane_numbers, [0] * LANES))


_DOUBLES = ir.DoubleType().as_pointer()
_INDEX = ir.IntType(64)


def _add_product(builder: Any, arguments: list[Any], row: Any, registers: int) -> None:
    """Generate the code of a product for LANES times `registers` rows; `registers` divides `SUMS`.

    out[row + i] = constant[row + i] + sum_c matrix[c rows + row + i] vector[c]. `SUMS` parallel sums, of several
    registers or of several columns, hide the latency of an addition.
    """
    matrix, constant, vector, out, columns, rows = arguments
    columns_at_once = max(1, SUMS // registers)

    def constant_index(value: int) -> Any:
        return ir.Constant(_INDEX, value)

    def lanes(pointer: Any, index: Any, register: int) -> Any:
        """Return the pointer to the lanes of a register of rows, from an index on."""
        position = builder.gep(pointer, [builder.add(index, constant_index(register * LANES))])
        return builder.bitcast(position, WIDE.as_pointer())

    def add_column(column: Any, set_number: int) -> None:
        """Add the products of a column to one of the parallel sums of each register."""
        factors = broadcast(builder, builder.load(builder.gep(vector, [column])))
        position = builder.add(builder.mul(column, rows), row)
        for register in range(registers):
            total = totals[register][set_number]
            product = builder.fmul(
                builder.load(lanes(matrix, position, register), align=8), factors, flags=("contract",)
            )
            builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)

    zero_sums = [ir.Constant(WIDE, [0.0] * LANES)] * (columns_at_once - 1)
    totals = []  # for each register the addresses of its parallel sums
    for register in range(registers):
        first = builder.load(lanes(constant, row, register), align=8)
        totals.append([cgutils.alloca_once_value(builder, value) for value in (first, *zero_sums)])
    zero, one, step = constant_index(0), constant_index(1), constant_index(columns_at_once)
    grouped_columns = builder.sub(columns, builder.srem(columns, step))
    with cgutils.for_range_slice(builder, zero, grouped_columns, step, _INDEX) as (column, _):
        for set_number in range(columns_at_once):
            add_column(builder.add(column, constant_index(set_number)), set_number)
    if columns_at_once > 1:
        with cgutils.for_range_slice(builder, grouped_columns, columns, one, _INDEX) as (column, _):
            add_column(column, 0)
    for register in range(registers):
        sums = [builder.load(total) for total in totals[register]]
        while len(sums) > 1:
            sums = [builder.fadd(*pair) for pair in zip(sums[::2], sums[1::2], strict=True)]
        builder.store(sums[0], lanes(out, row, register), align=8)


def _row_block_function(module: Any) -> Any:
    """Return the function for the rows of `SUMS` registers at a time; not inlined, because it needs all registers."""
    name = "shotrig_many_rows"
    if name not in module.globals:
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), [_DOUBLES] * 4 + [_INDEX] * 3), name)
        function.linkage = "linkonce_odr"
        function.attributes.add("noinline")
        for pointer in function.args[:4]:
            pointer.add_attribute("noalias")
        builder = ir.IRBuilder(function.append_basic_block("entry"))
        *arguments, stop = function.args
        # Blocks of twice as many sums hide more of the latency; they do not change the order of any sum.
        begin, double, step = (ir.Constant(_INDEX, rows) for rows in (0, 2 * SUMS * LANES, SUMS * LANES))
        middle = builder.sub(stop, builder.srem(stop, double))
        with cgutils.for_range_slice(builder, begin, middle, double, _INDEX) as (row, _):
            _add_product(builder, arguments, row, 2 * SUMS)
        with cgutils.for_range_slice(builder, middle, stop, step, _INDEX) as (row, _):
            _add_product(builder, arguments, row, SUMS)
        builder.ret_void()
    return module.globals[name]


def _product_intrinsic(in_blocks: bool) -> Any:
    """Return an intrinsic for a product: one register of rows from `row` on, or all blocks of rows up to `row`."""

    @intrinsic
    def product(
        typing_context: Any, matrix: Any, start: Any, constant: Any, offset: Any, vector: Any, columns: Any,
        rows: Any, out: Any, row: Any,
    ) -> Any:  # fmt: skip
        integer = types.intp
        signature = types.void(matrix, integer, constant, integer, vector, integer, integer, out, integer)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            _, start, _, offset, _, columns, rows, _, row = arguments
            matrix, constant, vector, out = (
                context.make_array(signature.args[position])(context, builder, arguments[position]).data
                for position in (0, 2, 4, 7)
            )
            operands = [builder.gep(matrix, [start]), builder.gep(constant, [offset]), vector, out, columns, rows]
            if in_blocks:
                builder.call(_row_block_function(builder.module), [*operands, row])
            else:
                _add_product(builder, operands, row, 1)
            return context.get_dummy_value()

        return signature, generate

    return product


_one_register_product, _block_product = _product_intrinsic(in_blocks=False), _product_intrinsic(in_blocks=True)


@inlined_kernel
def unsigned(index: int) -> int:
    """Return an index that is not negative as an unsigned number: a signed number would be checked in each access."""
    return np.uintp(index)  # type: ignore[return-value]


@inlined_kernel
def minimum(vector: Any) -> float:
    """Return the smallest element of a vector, none of which is NaN."""
    smallest = np.inf
    for i in range(vector.shape[0]):
        smallest = min(smallest, vector[i])
    return smallest


@inlined_kernel
def negative_bits(vector: Any) -> int:
    """Return an integer whose bits are set for the negative elements of a vector of at most 62 elements."""
    bits = 0
    for i in range(vector.shape[0]):
        bits |= int(vector[i] < 0.0) << i
    return bits


@inlined_kernel
def copy(source: Any, target: Any) -> None:
    """Copy a vector into another of the same length."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@inlined_kernel
def exceeds(vector: Any, bound: Any) -> bool:
    """Return whether the magnitude of any element exceeds its bound, or is NaN."""
    any_exceeds = False
    for i in range(bound.shape[0]):
        any_exceeds |= not abs(vector[i]) <= bound[i]
    return any_exceeds


@inlined_kernel
def transpose(buffer: Any, rows: Any, column: int) -> None:
    """Write a buffer of shape (LANES, width) into rows (width, columns) from a column on."""
    for i in range(rows.shape[0]):
        for lane in range(LANES):
            rows[i, column + lane] = buffer[lane, i]


@inlined_kernel
def affine_product(matrix: Any, constant: Any, index: int, vector: Any, columns: int, out: Any) -> None:
    """Compute out = matrix[index]^T vector[:columns] + constant[index].

    `matrix`: shape (matrices, columns, rows); `constant`: shape (matrices, rows); the number of rows is a multiple of
    LANES. The product is fastest if `columns` is a multiple of SUMS.
    """
    _affine_product_from(matrix, constant, index, vector, columns, out, 0)


@inlined_kernel
def affine_product_many(matrix: Any, constant: Any, index: int, vector: Any, columns: int, out: Any) -> None:
    """Compute `affine_product` for matrices of many rows; the code is longer, but loads the vector less often."""
    rows = constant.shape[1]
    start, rows_in_blocks = index * matrix.shape[1] * rows, rows - rows % (SUMS * LANES)
    if rows_in_blocks > 0:
        _block_product(matrix, start, constant, index * rows, vector, columns, rows, out, rows_in_blocks)
    _affine_product_from(matrix, constant, index, vector, columns, out, rows_in_blocks)


@inlined_kernel
def _affine_product_from(
    matrix: Any, constant: Any, index: int, vector: Any, columns: int, out: Any, first: int
) -> None:
    rows = constant.shape[1]
    start = index * matrix.shape[1] * rows
    for row in range(first, rows, LANES):
        _one_register_product(matrix, start, constant, index * rows, vector, columns, rows, out, row)


@kernel
def multiply(matrix: Any, index: int, vector: Any, constant: Any, out: Any) -> None:
    """Compute out = matrix[index]^T vector + constant, with the same constant for all indices.

    `constant` and `out` must be different arrays.
    """
    columns, rows = matrix.shape[1], matrix.shape[2]
    for row in range(0, rows, LANES):
        _one_register_product(matrix, index * columns * rows, constant, 0, vector, columns, rows, out, row)
