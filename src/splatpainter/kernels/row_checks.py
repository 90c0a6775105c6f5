"""Which rows of an asset can be drawn, and how many cannot for which reason: one look at each. Knows no `Splats`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run, threads


class RowChecks(NamedTuple):
    """What was found; a row may count in several."""

    drawable: Bools
    """[N] as `Splats.drawable`."""
    not_finite: int
    """With values that are NaN or infinite."""
    zero_rotation: int
    """With a rotation of zeros."""
    flat_scale: int
    """With a scale that is not positive."""
    opacity_outside: int
    """With an opacity outside 0..1."""
    beyond: int
    """Not drawable for another reason."""


def checked(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    sh: np.ndarray,
    most: float,
    least_quat: float,
) -> RowChecks:
    """Of attributes as `Splats` has them, by all threads. most: largest magnitude; least_quat: that of a rotation's
    largest component."""
    count, bands = sh.shape[:2]
    with np.errstate(all="ignore"):  # float64 beyond float32 is infinite there, and not drawn either
        arrays = [readonly(values, np.float32) for values in (means, quats, scales, opacities, sh)]
    arrays[4] = arrays[4].reshape(count, 3 * bands)
    drawable, counts = np.empty(count, bool), np.zeros((threads(), 5), np.int64)
    run(kernels.check_rows, *arrays, most, least_quat, drawable, counts)
    return RowChecks(drawable, *(int(number) for number in counts.sum(0)))
