"""What CPU kernels share: compile options, aligned arrays, and the few operations that numba lacks.

An inner loop has 16 lanes, which LLVM turns into vector code. Kernels are generic in dtype; Python float literals would
widen float32 maths to float64, hence `F(0.5)` everywhere.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from splatpainter.kernels.arrays import aligned, readonly

__all__ = [
    "LANES",
    "FAST",
    "aligned",
    "device",
    "exp",
    "kernel",
    "prefetch",
    "readonly",
    "scratch",
    "strict",
    "sum_lanes",
]
LANES = 16
"""Lanes of one inner loop."""

# No "nnan"/"ninf": NaN must fail its tests, not be assumed away.
FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
kernel = functools.partial(njit, nogil=True, cache=True, fastmath=FAST, error_model="numpy", boundscheck=False)
"""Decorator of what `parallel.run` runs."""
device = functools.partial(njit, inline="always", fastmath=FAST, error_model="numpy", boundscheck=False)
"""Decorator of what kernels call. Inlined by numba itself, before LLVM looks for vectors: when LLVM inlines, array
arguments bring alias checks into every block, twice as slow. Footgun: numba's cache does not see edits of a function
from another file; see compile.drop_stale."""
strict = functools.partial(njit, forceinline=True, error_model="numpy", boundscheck=False)
"""As `device`, in exact IEEE arithmetic: for results that two kernels must agree on to the last bit. Inlined by LLVM,
because numba would give it the fast-math flags of its caller."""


def exp(x):
    """exp(x) for x <= 0, in a form that LLVM vectorises (float32: relative error about 1e-7, flushed below 2^-126)."""
    raise NotImplementedError


@overload(exp, jit_options={"forceinline": True, "fastmath": FAST})
def _exp(x):
    if x != types.float32:
        return lambda x: math.exp(x)
    f = np.float32
    log2e, low, half = f(1.4426950408889634), f(-126.0), f(0.5)
    # 2^f on [-0.5, 0.5], the coefficients of Cephes' exp2f
    c6, c5, c4 = f(1.535336188319500e-4), f(1.339887440266574e-3), f(9.618437357674640e-3)
    c3, c2, c1, c0 = f(5.550332471162809e-2), f(2.402264791363012e-1), f(6.931472028550421e-1), f(1.0)
    bits = np.int32(23)

    def exp32(x):
        y = max(low, x * log2e)  # in this order NaN becomes `low`: casts of NaN are undefined
        n = np.int32(y - half)  # y <= 0, so truncation rounds to the nearest
        r = y - np.float32(n)
        p = (((((c6 * r + c5) * r + c4) * r + c3) * r + c2) * r + c1) * r + c0
        return np.int32(np.float32(p).view(np.int32) + np.int32(n << bits)).view(np.float32)

    return exp32


def _scratch(typing, like, size):
    """Pointer to `size` (a constant) numbers of like's dtype on the stack, for carray(): 64-byte aligned, and known to
    LLVM not to overlap anything, which np.empty's memory is not (a quarter of the time of a kernel)."""
    if not isinstance(size, types.IntegerLiteral):
        return None
    count = size.literal_value

    def generate(context, builder, signature, arguments):
        scalar = context.get_data_type(signature.args[0].dtype)
        with builder.goto_entry_block():
            pointer = builder.alloca(ir.ArrayType(scalar, count))
            pointer.align = 64
        return builder.bitcast(pointer, scalar.as_pointer())

    return types.CPointer(like.dtype)(like, size), generate


def _prefetch(typing, array, row):
    """Ask for array[row, :] (2-D, C-contiguous) ahead of its use; lists of Gaussians jump about in memory."""

    def generate(context, builder, signature, arguments):
        ary = context.make_array(signature.args[0])(context, builder, arguments[0])
        stride = builder.extract_value(ary.shape, 1)
        i32 = ir.IntType(32)
        pointer = builder.gep(ary.data, [builder.mul(arguments[1], stride)])
        pointer = builder.bitcast(pointer, ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, i32(0), i32(3), i32(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


def _sum_lanes(typing, lanes, fields, sums, row):
    """sums[row, k] = sum_l lanes[k, l] for k < fields (a constant), 0 in its other columns (8 or 16 in all), for
    lanes [>= fields, 16]: a shuffle tree that ends with all sums in one vector, about one step per field."""
    if not isinstance(fields, types.IntegerLiteral):
        return None
    count = fields.literal_value
    width = 8 if count <= 8 else 16

    def generate(context, builder, signature, arguments):
        single = signature.args[0].dtype == types.float32
        scalar, size = (ir.FloatType(), 4) if single else (ir.DoubleType(), 8)
        vector, i32, i64 = ir.VectorType(scalar, 16), ir.IntType(32), ir.IntType(64)
        source = context.make_array(signature.args[0])(context, builder, arguments[0])
        target = context.make_array(signature.args[2])(context, builder, arguments[2])
        flags = ("reassoc", "contract", "nsz")

        def add(x, y, low, high):
            picks = [ir.Constant(ir.VectorType(i32, len(p)), [i32(j) for j in p]) for p in (low, high)]
            return builder.fadd(*(builder.shuffle_vector(x, y, p) for p in picks), flags=flags)

        def merge(x, y, half):
            """Halve x and y within groups of 2 half lanes, and interleave the halves."""
            low, high = [], []
            for base in range(0, 16, 2 * half):
                low += [*range(base, base + half), *range(16 + base, 16 + base + half)]
                high += [*range(base + half, base + 2 * half), *range(16 + base + half, 16 + base + 2 * half)]
            return add(x, y, low, high)

        nothing = ir.Constant(vector, None)
        level = [nothing] * width
        for k in range(count):
            pointer = builder.bitcast(builder.gep(source.data, [i64(16 * k)]), vector.as_pointer())
            level[k] = builder.load(pointer, align=size)
        half = 1
        while len(level) > 1:
            pairs = zip(level[::2], level[1::2], strict=True)
            level = [nothing if x is nothing and y is nothing else merge(x, y, half) for x, y in pairs]
            half *= 2
        total = level[0] if width == 16 else add(level[0], nothing, range(8), range(8, 16))
        pointer = builder.gep(target.data, [builder.mul(arguments[3], i64(width))])
        builder.store(total, builder.bitcast(pointer, total.type.as_pointer()), align=size)
        return context.get_dummy_value()

    return types.void(lanes, fields, sums, types.int64), generate


# Not as decorators: callers leave out `typing`, which type checkers do not know.
scratch: Any = intrinsic(prefer_literal=True)(_scratch)
prefetch: Any = intrinsic(_prefetch)
sum_lanes: Any = intrinsic(prefer_literal=True)(_sum_lanes)
