"""Products and functions of arrays with the same bits on every machine.

numpy's `@`, `dot`, `einsum` and `linalg` go to a BLAS and a LAPACK whose sums depend on the CPU, and so do its `exp`,
`log`, `sin` and their like, its `hypot` and `**`. Sums, products, quotients, roots, `norm(axis=...)`, `cross`,
`cumsum`, `bincount`, stable sorts, and `sum` and `mean` of up to MAX_SUMMED numbers do not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

NUMBERS_PER_THREAD = 1 << 14
"""Fewer results are not worth waking threads for."""
MAX_SUMMED = 8192
"""Numbers that numpy 2.0 to 2.2 add up in the order of later versions; more, they add up in pieces of as many."""
LN_2 = 0.6931471805599453
Number = Any
"""A number, or an array of float32 or float64."""


def matmul(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """first @ second: [..., K] by [K, J] or a vector [K], or stacks of matrices [N, I, K] by [N, K, J], either of which
    may be one matrix [K, J]. Each sum runs from the first term to the last, in the larger of the dtypes."""
    if second.ndim == 1:
        return matmul(first, second[:, None])[..., 0]
    dtype = np.result_type(first, second)
    # One matrix for all, or a stack of them; both become stacks for the kernel.
    if second.ndim == 2:
        shape = (*first.shape[:-1], second.shape[1])
        one, other = first.reshape(1, math.prod(first.shape[:-1]), first.shape[-1]), second[None]
    else:
        one, other = first if first.ndim == 3 else first[None], second
        shape = (len(other) if len(one) == 1 else len(one), one.shape[1], other.shape[2])
    if one.shape[2] != other.shape[1] or 1 not in (len(one), len(other)) and len(one) != len(other):
        raise ValueError(f"matmul: expected [..., K] and [K, J], got {first.shape} and {second.shape}")
    if 0 in (one.size, other.size):
        return np.zeros(shape, dtype)
    out = np.empty(shape, dtype)
    stack = out if second.ndim == 3 else out.reshape(1, one.shape[1], shape[-1])
    # Many rows in single precision are not copied into double first.
    by_doubles = one.dtype == np.float32 and other.dtype == np.float64
    name, kind = ("multiply_by_doubles", one.dtype) if by_doubles else ("multiply_matrices", dtype)
    _run(name, stack.size, _input(one, kind), _input(other, dtype), stack)
    return out


def gram(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[F, F] float64 sum_i w_i r_i r_i^T of rows [M, F] (float32 or float64) and weights [M]."""
    size = rows.shape[1]
    upper, weights = np.zeros((size, size)), _input(weights, np.float64)
    _run(
        "add_normal_equations", rows.size, _input(rows, rows.dtype), weights, np.zeros(len(rows)), upper, np.empty(size)
    )
    # Only the upper half is summed; the lower is its mirror, bit for bit.
    below = np.tril_indices(size, -1)
    upper[below] = upper.T[below]
    return upper


def transposed_product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[F, C] float64 first^T second of [M, F] (float32 or float64) and [M, C]."""
    out = np.zeros((first.shape[1], second.shape[1]))
    _run("add_transposed_product", first.size, _input(first, first.dtype), _input(second, np.float64), out)
    return out


def solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """[F, C] float64 matrix^-1 right of a symmetric positive matrix [F, F], by its Cholesky factor."""
    factor, out = np.array(matrix, np.float64), np.array(right, np.float64)
    _run("solve_symmetric", 0, factor, out)
    return out


def determinant(matrix: np.ndarray) -> np.ndarray:
    """[...] of matrices [..., 3, 3]."""
    return (matrix[..., 0, :] * np.cross(matrix[..., 1, :], matrix[..., 2, :])).sum(-1)


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Of a matrix [3, 3], float64, by its cofactors. Raises ValueError where it has none."""
    rows = np.asarray(matrix, np.float64)
    scale = determinant(rows)
    if not (np.isfinite(scale) and scale != 0):
        raise ValueError("inverse: the matrix is singular")
    return np.stack([np.cross(rows[1], rows[2]), np.cross(rows[2], rows[0]), np.cross(rows[0], rows[1])], 1) / scale


def symmetric_axes(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(eigenvalues [..., 3], ascending, unit eigenvectors [..., 3, 3], in columns) of symmetric matrices [..., 3, 3],
    float64 (Smith, Eigenvalues of a symmetric 3 x 3 matrix, 1961). Axes of equal values are any."""
    matrices = np.asarray(matrices, np.float64)
    middle = np.trace(matrices, axis1=-2, axis2=-1)[..., None] / 3
    rest = matrices - middle[..., None] * np.eye(3)
    spread = np.sqrt((rest**2).sum((-2, -1)) / 6)[..., None]
    with np.errstate(all="ignore"):
        cosine = np.nan_to_num(determinant(rest / spread[..., None]) / 2)
    # The value that stands alone, and its axis; the other two turn in the plane across it.
    alone = np.where(cosine < 0, -1.0, 1.0)[..., None]
    turn = np.asarray(arccos(np.clip(np.abs(cosine), 0, 1)))[..., None] / 3
    axis = _axis_of(matrices, (middle + alone * 2 * spread * cos(turn))[..., 0])
    one = np.cross(axis, np.eye(3)[np.abs(axis).argmin(-1)])
    one = one / np.sqrt((one**2).sum(-1, keepdims=True))
    other = np.cross(axis, one)
    lengthened = [(matrices * across[..., None, :]).sum(-1) for across in (one, other)]
    across = (one * lengthened[1]).sum(-1)
    angle = (
        np.asarray(arctan2(2 * across, (one * lengthened[0]).sum(-1) - (other * lengthened[1]).sum(-1)))[..., None] / 2
    )
    larger, smaller = cos(angle) * one + sin(angle) * other, cos(angle) * other - sin(angle) * one
    axes = np.stack(
        [np.where(alone < 0, axis, smaller), np.where(alone < 0, smaller, larger), np.where(alone < 0, larger, axis)],
        -1,
    )
    return (axes * (matrices[..., None] * axes[..., None, :, :]).sum(-2)).sum(-2), axes


def _axis_of(matrices: np.ndarray, value: np.ndarray) -> np.ndarray:
    """[..., 3] unit vectors that symmetric matrices [..., 3, 3] only lengthen, by a value [...]: square to all rows of
    what is left without it."""
    rows = matrices - value[..., None, None] * np.eye(3)
    crosses = np.stack([np.cross(rows[..., k, :], rows[..., (k + 1) % 3, :]) for k in range(3)], -2)
    sizes = (crosses**2).sum(-1)
    best = np.take_along_axis(crosses, sizes.argmax(-1)[..., None, None], -2)[..., 0, :]
    size = np.sqrt(sizes.max(-1))[..., None]
    return np.where(size > 0, best / np.where(size > 0, size, 1), np.array([0.0, 0.0, 1.0]))


def log_determinant(matrix: np.ndarray) -> float:
    """Natural logarithm of the determinant of a symmetric positive matrix [F, F], by its Cholesky factor."""
    factor = np.array(matrix, np.float64)
    _run("solve_symmetric", 0, factor, np.zeros((len(factor), 1)))
    return float(2 * log(np.diagonal(factor)).sum())


def total(values: np.ndarray, dtype: Any = None) -> Any:
    """Sum of all values, one after the other as they lie, in the order that numpy has from 2.3 on: halves of whole
    eights, down to MAX_SUMMED. dtype: of the sum (default: the values')."""
    values = np.ascontiguousarray(values).ravel()
    # What is cast is added up in pieces by every version.
    if len(values) <= MAX_SUMMED or (dtype is not None and values.dtype != dtype):
        return values.sum(dtype=dtype)
    half = len(values) // 2
    half -= half % 8
    return total(values[:half]) + total(values[half:])


def mean(values: np.ndarray) -> Any:
    """Mean of all float values, one at least, summed as by `total`."""
    return total(values) / values.dtype.type(values.size)


def dot(first: np.ndarray, second: np.ndarray) -> float:
    """Of two vectors [K]."""
    return float((first * second).sum())


def length(vector: np.ndarray) -> float:
    """Of a vector [K]; `np.linalg.norm` of one asks a BLAS."""
    return float(np.sqrt((vector * vector).sum()))


def hypot(x: Number, y: Number) -> Number:
    """The root of x^2 + y^2; of numbers whose squares overflow, too."""
    with np.errstate(all="ignore"):
        # The plain formula gives equal bits everywhere; only where squares overflow it is scaled.
        out = np.sqrt(x * x + y * y)
        if not np.isinf(out).any():
            return out
        largest = np.maximum(np.abs(x), np.abs(y))
        scaled = largest * np.sqrt((x / largest) ** 2 + (y / largest) ** 2)
    return np.where(np.isinf(out) & np.isfinite(largest), scaled, out)[()]


def interp(x: Number, points: Sequence[float] | np.ndarray, values: Sequence[float] | np.ndarray) -> Any:
    """`np.interp`: piecewise linear between points [K], ascending, whose values [K] are given; constant outside."""
    points, values = np.asarray(points, np.float64), np.asarray(values, np.float64)
    # numpy's own interp changed its rounding between versions.
    x = np.maximum(x, points[0])
    at = np.clip(np.searchsorted(points, x, side="right") - 1, 0, len(points) - 2)
    slope = (values[at + 1] - values[at]) / (points[at + 1] - points[at])
    return np.where(x >= points[-1], values[-1], slope * (x - points[at]) + values[at])


def exp(x: Number) -> Number:
    """e^x; 0 below -708."""
    return _each("exp_each", x)


def log(x: Number) -> Number:
    """Natural logarithm; -inf of 0, NaN below."""
    return _each("log_each", x)


def expm1(x: Number) -> Number:
    """e^x - 1, as precise near 0 (Kahan)."""
    with np.errstate(all="ignore"):
        up = exp(np.asarray(x, np.float64))
        near = (up - 1) * (x / log(up))
    # There the quotient is no number, or e^x is 1 to the last bit.
    return np.where(up == 1, x, np.where(np.isfinite(up) & (up > 0), near, up - 1))[()]


def log1p(x: Number) -> Number:
    """Natural logarithm of 1 + x, as precise near 0 (Kahan)."""
    with np.errstate(all="ignore"):
        up = 1 + np.asarray(x, np.float64)
        near = log(up) * (x / (up - 1))
    return np.where(up == 1, x, np.where(np.isfinite(near), near, log(up)))[()]


def sin(x: Number) -> Number:
    """Of radians, up to a million."""
    return _each("sin_each", x)


def cos(x: Number) -> Number:
    """Of radians, up to a million."""
    return _each("cos_each", x)


def tan(x: Number) -> Number:
    """Of radians, up to a million."""
    return sin(x) / cos(x)


def arccos(x: Number) -> Number:
    """0 to pi; NaN outside of -1 to 1."""
    return _each("acos_each", x)


def arctan2(y: Number, x: Number) -> Number:
    """Angle of (x, y), -pi to pi."""
    y, x = np.broadcast_arrays(y, x)
    return _each("atan2_each", y, x)


def power(x: Number, exponent: float) -> Number:
    """x^exponent of x >= 0; by logarithms, so that the relative error of x^2.4 is about 1e-15."""
    return _each("power_each", x, numbers=(exponent,))


def srgb(x: Number, to_linear: bool) -> Number:
    """The curve of display sRGB >= 0 (`splatpainter.color` has both directions), with `power`."""
    return _each("srgb_each", x, numbers=(to_linear,))


def silu(x: np.ndarray) -> np.ndarray:
    """x / (1 + exp(-x)) of float32."""
    return _each("silu_each", np.asarray(x, np.float32))


def _each(name: str, *values: Number, numbers: tuple[float | bool, ...] = ()) -> Number:
    """A kernel over stack arrays: float32 where all are, else float64; a number gives a number."""
    arrays = [np.asarray(value) for value in values]
    dtype = np.float32 if all(array.dtype == np.float32 for array in arrays) else np.float64
    out = np.empty(arrays[0].shape, dtype)
    _run(name, out.size, *(_input(array, dtype).reshape(-1) for array in arrays), *numbers, out.reshape(-1))
    return out if out.ndim else out.item()


def _input(values: np.ndarray, dtype: Any) -> np.ndarray:
    return np.require(values, dtype, ["C", "A"])


def _run(name: str, size: int, *arguments: Any) -> None:
    # Cameras and transforms are made of these functions, and start-up needs neither threads nor the library.
    from splatpainter.kernels.library import kernels
    from splatpainter.kernels.parallel import run

    if size < NUMBERS_PER_THREAD:
        getattr(kernels, name)(*arguments, 0, 1)
    else:
        run(getattr(kernels, name), *arguments)
