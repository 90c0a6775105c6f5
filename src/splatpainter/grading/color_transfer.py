"""Colours of a layer by a LUT, by those of a reference picture, or one new colour: as parameters that a project keeps,
and their effect on SH. What was fitted to an asset is kept as numbers, so that the layer shows the same for ever.

    {"look": "lut", "table": hash of CubeLut.to_png, "name": ..., "strength": 0..1, "space": "srgb"}
    {"look": "match", "matrix": [3, 3], "start": [3], "end": [3], "name": ..., ...}
    {"look": "recolor", "target": [3], "mean": luminance, ...}
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, cast

import numpy as np

from splatpainter.grading.color_grading import apply_to_sh
from splatpainter.grading.color_match import AffineMap, ColorMap, NewColor
from splatpainter.grading.cube_lut import CubeLut
from splatpainter.io import files
from splatpainter.splats import ColorSpace

LUT, MATCH, RECOLOR = "lut", "match", "recolor"
TRANSFERS = (LUT, MATCH, RECOLOR)
TABLE = "table"
"""Name of the parameter that names a LUT's PNG by its hash; `transfer_sh` wants the PNG itself there."""
MAX_NUMBER = 1e6
"""Largest absolute value in matrices and colours."""
MAX_TABLES = 4
"""Most tables that stay decoded."""


def transfer_parameters(
    function: CubeLut | AffineMap | NewColor, name: str, strength: float, space: ColorSpace
) -> tuple[dict[str, Any], list[bytes]]:
    """(parameters of a layer, the pictures that it has to keep). name: of the file that it came from, for people."""
    shared = {"name": name[:200], "strength": float(strength), "space": space}
    if isinstance(function, CubeLut):
        # A project stores blobs by their hash; parameters only name it.
        png = function.to_png()
        return {"look": LUT, TABLE: files.sha256(png), **shared}, [png]
    if isinstance(function, AffineMap):
        numbers = {key: getattr(function, key).astype(float).tolist() for key in ("matrix", "start", "end")}
        return {"look": MATCH, **numbers, **shared}, []
    return {"look": RECOLOR, "target": [float(value) for value in function.target], "mean": function.mean, **shared}, []


def with_table(parameters: Mapping[str, Any], blob: Callable[[str], bytes]) -> Mapping[str, Any]:
    """The parameters of a layer with its LUT's PNG in place of the hash. blob: gives the bytes of a hash, or raises
    ValueError."""
    name = parameters.get(TABLE)
    if parameters.get("look") != LUT or not isinstance(name, str):
        return parameters
    return {**parameters, TABLE: blob(name)}


def transfer_sh(sh: np.ndarray, parameters: Mapping[str, Any]) -> np.ndarray:
    """[N, K, 3] float32 SH after a transfer; Gaussians that do not change keep their bits. Raises ValueError for what
    are no such parameters."""
    function, strength = transfer_function(parameters), _numbers(parameters, "strength", ())
    if not 0 <= strength <= 1:
        raise ValueError(f"look: expected a strength of 0 to 1, got {strength:g}")
    if not strength:
        return sh

    def mixed(colors: np.ndarray) -> np.ndarray:
        return colors + np.float32(strength) * (function(colors) - colors)

    space = parameters.get("space", "srgb")
    if space not in ("srgb", "linear"):
        raise ValueError(f"look: expected a space of srgb or linear, got {ascii(space)[:40]}")
    return apply_to_sh(sh, function if strength == 1 else mixed, cast(ColorSpace, space))


def transfer_function(parameters: Mapping[str, Any]) -> ColorMap:
    """The function of display colours. Raises ValueError as `transfer_sh`."""
    kind = parameters.get("look")
    if kind == LUT:
        table = parameters.get(TABLE)
        if not isinstance(table, bytes):
            raise ValueError("look: expected a LUT with its table")
        return _decoded(table)
    if kind == MATCH:
        matrix, start, end = (
            _numbers(parameters, name, shape) for name, shape in (("matrix", (3, 3)), ("start", (3,)), ("end", (3,)))
        )
        return AffineMap(matrix, start, end)
    red, green, blue = _numbers(parameters, "target", (3,)).tolist()
    mean = float(_numbers(parameters, "mean", ()))
    if mean <= 0:
        raise ValueError(f"look: expected a mean luminance above 0, got {mean:g}")
    return NewColor((red, green, blue), mean)


@lru_cache(maxsize=MAX_TABLES)
def _decoded(png: bytes) -> CubeLut:
    return CubeLut.from_png(png, "LUT")


def _numbers(parameters: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    value = parameters.get(name)
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    # True and "1" convert to numbers; they are not meant as such.
    flat = [value] if not isinstance(value, list) else np.ravel(np.array(value, object)).tolist()
    if numbers.shape != shape or any(isinstance(one, bool | str) for one in flat):
        raise ValueError(f"look: expected {name} of {list(shape) or 'one number'}, got {ascii(value)[:60]}")
    if not (np.abs(numbers) <= MAX_NUMBER).all():
        raise ValueError(f"look: expected finite numbers as {name}")
    return numbers
