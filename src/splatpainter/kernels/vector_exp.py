"""exp of float64 numbers in a form that LLVM turns into vector code: a quarter of the time of calling `math.exp`, in
whose loops nothing else is vectorised either.

Tang's method with a table (P. T. P. Tang, "Table-Driven Implementation of the Exponential Function in IEEE
Floating-Point Arithmetic", ACM TOMS 1989): x = k ln 2 / 128 + r, exp(x) = 2^(k / 128) exp(r). The size of the table,
the polynomial's coefficients and the order of operations are those of Szabolcs Nagy's exp (Arm Optimized Routines,
MIT licence), which glibc has since 2.28: with fused multiply-adds, results down to -512 are bit for bit those of
`math.exp` there, and the same on every other system. Relative error below 0.52 units in the last place.
"""

from __future__ import annotations

from decimal import Decimal, localcontext
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from splatpainter.kernels.simd import strict

TABLE_ENTRIES, LOG2_TABLE_ENTRIES = 128, 7
"""Entries of the table, and log2 of that."""
LOWEST = -708.0
"""Below, results are 0: they would be subnormal."""
C2, C3, C4, C5 = (
    float.fromhex(text)
    for text in ("0x1.ffffffffffdbdp-2", "0x1.555555555543cp-3", "0x1.55555cf172b91p-5", "0x1.1111167a4d017p-7")
)
"""(exp(r) - 1 - r) / r^2 for |r| < ln 2 / 256."""
INVERSE_STEP = float.fromhex("0x1.71547652b82fep0") * TABLE_ENTRIES
STEP_HIGH, STEP_LOW = float.fromhex("-0x1.62e42fefa0000p-8"), float.fromhex("-0x1.cf79abc9e3b39p-47")
"""-ln 2 / 128, in two parts."""
SHIFT = float.fromhex("0x1.8p52")
"""Added and taken away again: rounds to an integer, whose bits are the lowest ones of the sum."""


def _table() -> tuple[np.ndarray, np.ndarray]:
    """([128] int64 bits of 2^(i / 128), less i << 45; [128] float64 what rounding took from it, relative)."""
    bits, tails = np.zeros(TABLE_ENTRIES, np.int64), np.zeros(TABLE_ENTRIES)
    with localcontext() as context:
        context.prec = 60
        for i in range(TABLE_ENTRIES):
            exact = Decimal(2) ** (Decimal(i) / TABLE_ENTRIES)
            rounded = float(exact)
            bits[i] = np.float64(rounded).view(np.int64) - (i << (52 - LOG2_TABLE_ENTRIES))
            tails[i] = float((exact - Decimal(rounded)) / Decimal(rounded))
    return bits, tails


TABLE_BITS, TABLE_TAILS = _table()


def _fma(typing, a, b, c):
    """a b + c, rounded once."""
    return types.float64(types.float64, types.float64, types.float64), lambda _, builder, __, args: builder.fma(*args)


fma: Any = intrinsic(_fma)


@strict
def exp64(x):
    """exp(x) for x <= 0; 0 below LOWEST; NaN stays NaN."""
    shifted = fma(INVERSE_STEP, x, SHIFT)
    number = np.float64(shifted).view(np.int64)
    steps = shifted - SHIFT
    r = fma(steps, STEP_LOW, fma(steps, STEP_HIGH, x))
    i = number & np.int64(TABLE_ENTRIES - 1)
    scale = np.int64(TABLE_BITS[i] + (number << np.int64(52 - LOG2_TABLE_ENTRIES))).view(np.float64)
    square = r * r
    rest = fma(square, fma(r, C3, C2), TABLE_TAILS[i] + r)
    rest = fma(square * square, fma(r, C5, C4), rest)
    value = fma(scale, rest, scale)
    return 0.0 if x < LOWEST else value
