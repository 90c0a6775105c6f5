"""What of a source file may be kept when its edited rows are written in the same format, and which rows no file can
show. Knows no format.

A row keeps the bytes of one attribute when it comes from a row of the file (`origin`) and that attribute still has,
bit for bit, the value that was decoded from those bytes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.array_types import Ids
from splatpainter.splats import ATTRIBUTES, MAX_MAGNITUDE, Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Unchanged:
    """Which of N rows keep what they were read from. The masks [N] imply source_rows >= 0."""

    source_rows: Ids
    """[N] int64 row of the source whose packed values each row carries, -1 for none."""
    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    base: np.ndarray
    """sh[:, 0]."""
    rest: np.ndarray
    """sh[:, 1:], of a lower SH degree than the source's too; all False where it is higher."""
    identity: bool
    """Nothing changed at all: same rows, same order, same values, same flags."""


def unchanged(splats: Splats, format: str) -> Unchanged | None:
    """Compare `splats` with the file it came from; None where that file is not of the given format."""
    source = splats.source
    if source is None or source.format != format or splats.origin is None:
        return None
    old, rows = source.splats, np.asarray(splats.origin, np.int64)
    has_source, indices = rows >= 0, np.maximum(rows, 0)
    if not len(old):
        has_source, indices = np.zeros(len(splats), bool), np.zeros(len(splats), np.int64)

    in_order = len(splats) == len(old) and bool((rows == np.arange(len(rows))).all())

    def same(new: np.ndarray, before: np.ndarray) -> np.ndarray:
        mask = has_source.copy()
        if in_order and new is before:
            return mask
        mask[has_source] = ~differs(new[has_source], before[indices[has_source]]).any(tuple(range(1, new.ndim)))
        return mask

    masks = {name: same(getattr(splats, name), getattr(old, name)) for name in ATTRIBUTES[:-1]}
    base = same(splats.sh[:, 0], old.sh[:, 0]) if splats.sh is not old.sh else same(splats.sh, old.sh)
    bands, one_degree = splats.sh.shape[1], splats.sh.shape[1] == old.sh.shape[1]
    fewer = bands <= old.sh.shape[1]
    rest = same(splats.sh[:, 1:], old.sh[:, 1:bands]) if fewer else np.zeros(len(splats), bool)
    identity = (
        in_order
        and one_degree
        and all(mask.all() for mask in (*masks.values(), base, rest))
        and (splats.antialiased, splats.color_space) == (old.antialiased, old.color_space)
    )
    return Unchanged(rows, **masks, base=base, rest=rest, identity=identity)


def drawable_rows(splats: Splats, row_by_row: bool = False) -> Splats:
    """Rows that cannot be drawn (NaN, infinite, zero scale or quaternion) made finite and fully transparent.

    Quantised formats cannot say NaN; such rows are not drawn by any renderer, so opacity 0 keeps the picture and the
    row count. Opacities are cut to 0..1. Nothing is copied where every row can be drawn. Their means become the mean of
    the other rows, so that no range to be quantised grows. row_by_row: no row depends on another one, so that the same
    row is the same in an edited asset: means stay where they are, coordinates that are not within MAX_MAGNITUDE become
    0; for formats of floats.
    """
    if not len(splats):
        return splats
    bad = ~splats.drawable
    opacities = np.clip(np.nan_to_num(splats.opacities, nan=0.0), 0, 1)
    if not bad.any():
        return replace(splats, opacities=opacities)
    if row_by_row:
        means = splats.means[bad]
        with np.errstate(invalid="ignore"):  # signalling NaNs
            center = np.where(np.abs(means) <= MAX_MAGNITUDE, means, np.float32(0))
    else:
        good = splats.means[~bad]
        center = good.mean(0) if len(good) else np.zeros(3, np.float32)
    values = {name: getattr(splats, name).copy() for name in ATTRIBUTES}
    values["means"][bad], values["quats"][bad], values["scales"][bad], values["sh"][bad] = center, (1, 0, 0, 0), 1e-6, 0
    values["opacities"] = np.where(bad, 0, opacities).astype(np.float32)
    return replace(splats, **values)


def differs(new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """Where two float32 arrays of one shape differ bit for bit (bool, same shape): NaN payloads and -0.0 count."""
    if new is old:
        return np.zeros(new.shape, bool)
    return np.ascontiguousarray(new).view(np.uint32) != np.ascontiguousarray(old).view(np.uint32)


def row_problems(splats: Splats) -> list[str]:
    """One line for each kind of row that cannot be drawn as it stands."""
    checks = splats.row_checks
    kinds = (
        (checks.not_finite, "with NaN or infinite values"),
        (checks.zero_rotation, "with a zero rotation quaternion"),
        (checks.flat_scale, "with a scale that is not positive"),
        (checks.opacity_outside, "with an opacity outside 0..1"),
        (checks.beyond, f"with values beyond +-{MAX_MAGNITUDE:g}, or a quaternion near zero"),
    )
    return [f"{count} {'row' if count == 1 else 'rows'} {text} (kept, not drawn)" for count, text in kinds if count]
