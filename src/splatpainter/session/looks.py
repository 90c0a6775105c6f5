"""Looks: layers that are a pure function of each row's own colour. Knows no views and no neighbours.

A look is `f(sh [N, K, 3], parameters) -> sh [N, K, 3]`; a session takes a table of them by name, and the layer's
parameters say which ({"look": name, ...}). They are cheap, so their results are not stored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from splatpainter.sources.grade import NAME, grade
from splatpainter.splats import SH_C0

LookFunction = Callable[[np.ndarray, Mapping[str, Any]], np.ndarray]


def gain(sh: np.ndarray, parameters: Mapping[str, Any]) -> np.ndarray:
    """colour -> gain * colour + offset, exact for every direction. parameters: gain and offset, three numbers each
    (default: ones, zeros)."""
    factor, offset = (_three(parameters, name, value) for name, value in (("gain", 1.0), ("offset", 0.0)))
    out = sh * factor
    out[:, 0] += (0.5 * factor + offset - 0.5) / np.float32(SH_C0)
    return out.astype(np.float32)


LOOKS: dict[str, LookFunction] = {"gain": gain, NAME: grade}
"""The looks that a session knows without being told."""


def look_of(parameters: Mapping[str, Any], looks: Mapping[str, LookFunction]) -> LookFunction:
    """The function that a layer's parameters name. Raises ValueError for one that this session does not have."""
    name = parameters.get("look")
    if not isinstance(name, str) or name not in looks:
        raise ValueError(f"look: expected parameters with a look of {', '.join(sorted(looks))}, got {name!r}")
    return looks[name]


def recolored(sh: np.ndarray, parameters: Mapping[str, Any], looks: Mapping[str, LookFunction]) -> np.ndarray:
    """[N, K, 3] float32 after the look. Raises ValueError for an unknown one, and where it gives another shape."""
    out = np.asarray(look_of(parameters, looks)(sh, parameters), np.float32)
    if out.shape != sh.shape:
        raise ValueError(f"look: expected SH of shape {list(sh.shape)} back, got {list(out.shape)}")
    return out


def _three(parameters: Mapping[str, Any], name: str, default: float) -> np.ndarray:
    try:
        values = np.asarray(parameters.get(name, [default] * 3), np.float32)
    except (TypeError, ValueError, OverflowError):
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"look: expected three numbers as {name}, got {parameters.get(name)!r}")
    return values
