"""The axes of files: rows turned from one kind of axes into another by axis flips (exact) and rotations.

Every asset in memory has the axes of INRIA PLY files (usually x right, y down, z forward). Formats that store others
convert here, in their reader, and back in their writer. Knows no format.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from splatpainter.kernels import portable
from splatpainter.splats import SH_COUNTS, Axes, Source, Splats
from splatpainter.transforms import matrix_to_quat, sh_rotations, snapped

_LETTERS = {"l": "left", "r": "right", "u": "up", "d": "down", "f": "front", "b": "back"}
AXES = {
    across + up + depth: (1 if across == "r" else -1, 1 if up == "d" else -1, 1 if depth == "f" else -1)
    for across in "lr"
    for up in "du"
    for depth in "bf"
}
"""Where x, y and z point -> the sign of each axis in the PLY's axes, "rdf"."""
NO_FLIP = (1, 1, 1)


def flip(splats: Splats, signs: tuple[int, int, int]) -> Splats:
    """float32 rows with the axes whose sign is -1 reversed; flipping twice restores every bit, of NaN too.

    A rotation R becomes F R F, which keeps w and gives the same ellipsoid (a diagonal F commutes with the scales).
    """
    axes = np.array(signs, np.float32)
    turn = np.array([1, axes[1] * axes[2], axes[0] * axes[2], axes[0] * axes[1]], np.float32)
    bands = sh_flip_signs(splats.sh.shape[1], signs)
    return replace(
        splats,
        means=_with_signs(splats.means, axes),
        quats=_with_signs(splats.quats, turn),
        sh=_with_signs(splats.sh, bands[:, None]),
        offset=_signed(splats.offset, signs),
    )


def flipped_offset(offset: tuple[float, float, float], natural: str, axes: Axes) -> tuple[float, float, float]:
    """What a reader of numbers in the axes `natural` takes as the offset that is asked for in memory's axes, where
    `to_memory_axes` follows."""
    return _signed(offset, NO_FLIP if axes == "auto" else _between(natural, axes))


def _signed(offset: tuple[float, float, float], signs: tuple[int, int, int]) -> tuple[float, float, float]:
    x, y, z = (value * sign if value else 0.0 for value, sign in zip(offset, signs, strict=True))
    return x, y, z


def _with_signs(values: np.ndarray, signs: np.ndarray) -> np.ndarray:
    # The sign bit itself: multiplying would make a signalling NaN a quiet one.
    if (signs > 0).all():
        return np.ascontiguousarray(values, np.float32)
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return (bits ^ np.where(signs < 0, np.uint32(1 << 31), np.uint32(0))).view(np.float32)


def describe(name: str) -> str:
    """ "rub" -> "right-up-back"."""
    return "-".join(_LETTERS[letter] for letter in name)


def to_memory_axes(splats: Splats, axes: Axes) -> Splats:
    """Rows as a reader gave them -> as they are when the file's numbers are in `axes`, whatever the reader thought.

    Signs only; `source` follows, so that `to_file_axes` gives back every bit. Nothing happens for "auto".
    """
    source = splats.source
    if axes == "auto" or source is None:
        return splats
    flips = _between(source.axes, axes)
    if flips != NO_FLIP:
        splats = flip(splats, flips)
    rows = replace(splats, source=None, origin=None)
    return replace(splats, source=replace(source, splats=rows, axes=axes, axes_from="choice", flips=flips))


def to_file_axes(splats: Splats, format: str, axes: Axes, natural: str) -> Splats:
    """The inverse of `to_memory_axes`, for the writer of `format`, whose numbers are by default in axes `natural`.

    axes: of the file's numbers; "auto": what the source's were if it is of that format, else `natural`.
    """
    source = splats.source
    before = source if source is not None and source.format == format else None
    plain = natural if before is None else _before(before)
    flips = before.flips if before is not None and axes == "auto" else NO_FLIP
    if axes != "auto":
        flips = _between(plain, axes)
    if before is not None and before.flips != NO_FLIP:
        rows = flip(before.splats, before.flips)
        splats = replace(splats, source=replace(before, splats=rows, axes=plain, flips=NO_FLIP))
    return splats if flips == NO_FLIP else flip(splats, flips)


def _before(source: Source) -> str:
    """The axes that the reader took the file's numbers to be in, before some were chosen."""
    signs = tuple(a * b for a, b in zip(AXES[source.axes], source.flips, strict=True))
    return next(name for name, axes in AXES.items() if axes == signs)


def _between(one: str, other: str) -> tuple[int, int, int]:
    x, y, z = (a * b for a, b in zip(AXES[one], AXES[other], strict=True))
    return x, y, z


def sh_flip_signs(count: int, signs: tuple[int, int, int]) -> np.ndarray:
    """[count] factors of the SH coefficients under an axis flip, from the parity of each basis function in x, y, z.

    Y_lm is even or odd in every axis: of order l - |m| in z; for m < 0 (sines) odd in y and of order |m| - 1 in x; for
    m >= 0 (cosines) even in y and of order m in x.
    """
    factors = []
    for l in range(SH_COUNTS[count] + 1):
        for m in range(-l, l + 1):
            powers = (abs(m) - (m < 0), int(m < 0), l - abs(m))
            factors.append(math.prod(sign**power for sign, power in zip(signs, powers, strict=True)))
    return np.array(factors, np.float32)


def move(splats: Splats, matrix: np.ndarray, scale: float = 1.0, shift: np.ndarray | None = None) -> Splats:
    """Rows under x -> scale * matrix @ x + shift, computed in float64.

    matrix: [3, 3] rotation; scale > 0; shift: [3] or None. A half turn about an axis only permutes and negates numbers.
    """
    with np.errstate(all="ignore"):  # rows may hold NaN or overflow; they are reported where they are read
        means = scale * portable.matmul(splats.means.astype(np.float64), snapped(matrix).T)
        return _turned(splats, means if shift is None else means + shift, matrix, _quat(matrix), scale)


def move_back(splats: Splats, matrix: np.ndarray, scale: float = 1.0, shift: np.ndarray | None = None) -> Splats:
    """The inverse of `move` with the same arguments; after a half turn every bit is back, quaternion signs included."""
    turn = _quat(matrix) * (1, -1, -1, -1)
    with np.errstate(all="ignore"):
        means = splats.means.astype(np.float64) - (0 if shift is None else shift)
        return _turned(splats, portable.matmul(means, snapped(matrix)) / scale, matrix.T, turn, 1 / scale)


def _turned(splats: Splats, means: np.ndarray, matrix: np.ndarray, turn: np.ndarray, scale: float) -> Splats:
    rotations = sh_rotations(matrix, SH_COUNTS[splats.sh.shape[1]])
    if all(np.array_equal(rotation, np.diag(np.diag(rotation))) for rotation in rotations):  # only signs: half turns
        sh = splats.sh * np.concatenate([np.diag(rotation) for rotation in rotations]).astype(np.float32)[:, None]
    else:
        sh = splats.sh.astype(np.float64)
        for l, rotation in enumerate(rotations):
            band = slice(l * l, (l + 1) * (l + 1))
            sh[:, band] = portable.matmul(sh[:, band].transpose(0, 2, 1), rotation.T).transpose(0, 2, 1)
    return replace(
        splats,
        means=means.astype(np.float32),
        quats=_multiply(turn, splats.quats.astype(np.float64)).astype(np.float32),
        scales=(splats.scales.astype(np.float64) * scale).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product of one quaternion [4] with quaternions [N, 4]."""
    w, x, y, z = a
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return portable.matmul(b, left.T)


def _quat(matrix: np.ndarray) -> np.ndarray:
    """[4] unit quaternion of a rotation [3, 3]."""
    return snapped(matrix_to_quat(np.asarray(matrix, np.float64)[None])[0])
