"""What of a source file may be kept when its edited rows are written in the same format. Knows no format.

A row keeps the bytes of one attribute when it comes from a row of the file (`origin`) and that attribute still has,
bit for bit, the value that was decoded from those bytes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatpainter.io.raw import differs
from splatpainter.splats import ATTRIBUTES, Splats


@dataclass(frozen=True)
class Kept:
    """Which of N rows keep what they were read from. `rows` and the masks: [N]; the masks imply rows >= 0."""

    rows: np.ndarray
    """int64 row of the source whose packed values each row carries, -1 for none."""
    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    base: np.ndarray
    """sh[:, 0]."""
    rest: np.ndarray
    """sh[:, 1:]; all False where the SH degree is not the source's."""
    identity: bool
    """Nothing changed at all: same rows, same order, same values, same flags."""


def kept(splats: Splats, format: str) -> Kept | None:
    """Compare `splats` with the file it came from; None where that file is not of the given format."""
    source = splats.source
    if source is None or source.format != format or splats.origin is None:
        return None
    old, rows = source.splats, np.asarray(splats.origin, np.int64)
    known, at = rows >= 0, np.maximum(rows, 0)
    if not len(old):
        known, at = np.zeros(len(splats), bool), np.zeros(len(splats), np.int64)

    in_order = len(splats) == len(old) and bool((rows == np.arange(len(rows))).all())

    def same(new: np.ndarray, before: np.ndarray) -> np.ndarray:
        mask = known.copy()
        if in_order and new is before:
            return mask
        mask[known] = ~differs(new[known], before[at[known]]).any(tuple(range(1, new.ndim)))
        return mask

    columns = {name: same(getattr(splats, name), getattr(old, name)) for name in ATTRIBUTES[:-1]}
    base = same(splats.sh[:, 0], old.sh[:, 0]) if splats.sh is not old.sh else same(splats.sh, old.sh)
    one_degree = splats.sh.shape[1] == old.sh.shape[1]
    rest = same(splats.sh[:, 1:], old.sh[:, 1:]) if one_degree else np.zeros(len(splats), bool)
    identity = (
        in_order
        and one_degree
        and all(mask.all() for mask in (*columns.values(), base, rest))
        and (splats.antialiased, splats.color_space) == (old.antialiased, old.color_space)
    )
    return Kept(rows, **columns, base=base, rest=rest, identity=identity)


def presentable(splats: Splats) -> Splats:
    """Rows that cannot be drawn (NaN, infinite, zero scale or quaternion) made finite and fully transparent.

    Quantised formats cannot say NaN; such rows are not drawn by any renderer, so opacity 0 keeps the picture and the
    row count. Opacities are cut to 0..1. Nothing is copied where every row can be drawn.
    """
    from dataclasses import replace

    if not len(splats):
        return splats
    bad = ~splats.drawable
    opacities = np.clip(np.nan_to_num(splats.opacities, nan=0.0), 0, 1)
    if not bad.any():
        return replace(splats, opacities=opacities)
    good = splats.means[~bad]
    centre = good.mean(0) if len(good) else np.zeros(3, np.float32)
    calm = {name: getattr(splats, name).copy() for name in ATTRIBUTES}
    calm["means"][bad], calm["quats"][bad], calm["scales"][bad], calm["sh"][bad] = centre, (1, 0, 0, 0), 1e-6, 0
    calm["opacities"] = np.where(bad, 0, opacities).astype(np.float32)
    return replace(splats, **calm)
