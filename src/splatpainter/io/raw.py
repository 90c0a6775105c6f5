"""Raw <-> activated values, in float64 and block by block, and what is odd about decoded rows. Knows no format."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from splatpainter.splats import ATTRIBUTES, MAX_MAGNITUDE, SH_C0, Splats

BLOCK = 1 << 16
"""Values per block: float64 intermediates stay in the cache, and 1M+ rows cost no second copy in float64."""
LARGEST = 1 - 2.0**-24
"""The largest float32 below 1 (logit 16.6) stands for opacity 1, which no finite logit says."""
SMALLEST = 2.0**-60
"""Stands for opacity 0 (logit -41.6: sigmoid of it renders as nothing) and, squared, for scale 0."""


def _blockwise(values: np.ndarray, formula: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    flat = values.reshape(-1)
    out = np.empty(flat.shape, np.float32)
    # Overflow to inf and NaN are the right float32 answers for such rows; they are reported, not hidden.
    with np.errstate(all="ignore"):
        for start in range(0, flat.size, BLOCK):
            out[start : start + BLOCK] = formula(flat[start : start + BLOCK].astype(np.float64))
    return out.reshape(values.shape)


def exp(values: np.ndarray) -> np.ndarray:
    """Log-scales of any shape and real dtype -> scales, float32."""
    return _blockwise(values, np.exp)


def log(values: np.ndarray) -> np.ndarray:
    """Scales -> log-scales, float32, finite for every finite scale: those <= 0 count as 2^-120, below any pixel."""
    return _blockwise(values, lambda x: np.log(np.maximum(x, SMALLEST**2)))


def sigmoid(values: np.ndarray) -> np.ndarray:
    """Logits -> opacities 0..1, float32."""
    return _blockwise(values, lambda x: 1 / (1 + np.exp(-x)))


def logit(values: np.ndarray) -> np.ndarray:
    """Opacities -> logits, float32, finite for every opacity: clamped to SMALLEST..LARGEST first; NaN stays NaN."""

    def formula(x: np.ndarray) -> np.ndarray:
        x = np.clip(x, SMALLEST, LARGEST)
        return np.log(x) - np.log1p(-x)

    return _blockwise(values, formula)


def color_to_dc(colors: np.ndarray) -> np.ndarray:
    """Base colours (0..1, display) -> SH coefficient of Y_00, float32."""
    return _blockwise(colors, lambda x: (x - 0.5) / SH_C0)


def dc_to_color(dc: np.ndarray) -> np.ndarray:
    """SH coefficient of Y_00 -> base colours (0..1 where it is a display colour), float32."""
    return _blockwise(dc, lambda x: 0.5 + SH_C0 * x)


def differs(new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """Where two float32 arrays of one shape differ bit for bit (bool, same shape): NaN payloads and -0.0 count."""
    if new is old:
        return np.zeros(new.shape, bool)
    return np.ascontiguousarray(new).view(np.uint32) != np.ascontiguousarray(old).view(np.uint32)


def oddities(splats: Splats) -> list[str]:
    """One line for each kind of row that cannot be drawn as it stands."""
    lines = []
    finite = np.ones(len(splats), bool)
    with np.errstate(all="ignore"):  # signalling NaNs raise floating-point flags wherever they are touched
        for name in ATTRIBUTES:
            values = getattr(splats, name)
            # One NaN or infinity makes the sum NaN or infinite: one cheap pass settles the usual, clean file.
            if not np.isfinite(values.sum()):
                finite &= np.isfinite(values.reshape(len(splats), -1)).all(1)
        hidden = (
            (~finite, "with NaN or infinite values"),
            (~splats.quats.any(1), "with a zero rotation quaternion"),
            ((splats.scales <= 0).any(1), "with a scale that is not positive"),
            ((splats.opacities < 0) | (splats.opacities > 1), "with an opacity outside 0..1"),
        )
        beyond = ~splats.drawable & ~np.any([rows for rows, _ in hidden], 0)
    for rows, text in (*hidden, (beyond, f"with values beyond +-{MAX_MAGNITUDE:g}, or a quaternion near zero")):
        if count := np.count_nonzero(rows):
            lines.append(f"{count} {'row' if count == 1 else 'rows'} {text} (kept, not drawn)")
    return lines
