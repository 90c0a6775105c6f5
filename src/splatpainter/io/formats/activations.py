"""Raw values of files <-> activated values of `Splats`, in float64 and block by block, with the same
bits on every machine. Knows no format."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from splatpainter.kernels import portable
from splatpainter.kernels.parallel import each
from splatpainter.splats import SH_C0

BLOCK_VALUES = 1 << 16
"""Values at a time: float64 intermediates stay in the cache, and 1M+ rows cost no second copy in float64."""
MAX_OPACITY = 1 - 2.0**-24
"""The largest float32 below 1 (logit 16.6) stands for opacity 1, which no finite logit says."""
MIN_OPACITY = 2.0**-60
"""Stands for opacity 0 (logit -41.6: sigmoid of it renders as nothing)."""
MIN_SCALE = 2.0**-120
"""Stands for scale 0, below any pixel."""


def _blockwise(values: np.ndarray, formula: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    flat = values.reshape(-1)
    out = np.empty(flat.shape, np.float32)

    def fill(start: int) -> None:
        # Overflow to inf and NaN are the right float32 answers for such rows; they are reported, not hidden.
        with np.errstate(all="ignore"):
            out[start : start + BLOCK_VALUES] = formula(flat[start : start + BLOCK_VALUES].astype(np.float64))

    each(fill, range(0, flat.size, BLOCK_VALUES)) if flat.size > BLOCK_VALUES else fill(0)
    return out.reshape(values.shape)


def exp(values: np.ndarray) -> np.ndarray:
    """Log-scales of any shape and real dtype -> scales, float32."""
    return _blockwise(values, portable.exp)


def log(values: np.ndarray) -> np.ndarray:
    """Scales -> log-scales, float32, finite for every finite scale: those <= 0 count as MIN_SCALE."""
    return _blockwise(values, lambda x: portable.log(np.maximum(x, MIN_SCALE)))


def sigmoid(values: np.ndarray) -> np.ndarray:
    """Logits -> opacities 0..1, float32."""
    return _blockwise(values, lambda x: 1 / (1 + portable.exp(-x)))


def logit(values: np.ndarray) -> np.ndarray:
    """Opacities -> logits, float32, finite for every opacity: clamped to MIN_OPACITY..MAX_OPACITY; NaN stays NaN."""

    def formula(x: np.ndarray) -> np.ndarray:
        x = np.clip(x, MIN_OPACITY, MAX_OPACITY)
        return portable.log(x) - portable.log1p(-x)

    return _blockwise(values, formula)


def color_to_dc(colors: np.ndarray) -> np.ndarray:
    """Base colours (0..1, display) -> SH coefficient of Y_00, float32."""
    return _blockwise(colors, lambda x: (x - 0.5) / SH_C0)


def dc_to_color(dc: np.ndarray) -> np.ndarray:
    """SH coefficient of Y_00 -> base colours (0..1 where it is a display colour), float32."""
    return _blockwise(dc, lambda x: 0.5 + SH_C0 * x)
