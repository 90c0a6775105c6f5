"""What light needs to know of an asset, once per asset: its surface with what each Gaussian sees, and the light that is
baked into its colours. Kept by content, so that a layer below that changes colours finds the surface again, and a panel
that moves a sun finds both."""

from __future__ import annotations

import hashlib
from threading import RLock

import numpy as np

from splatpainter.cameras import UpAxis
from splatpainter.color import base_color, to_light
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.source_light import SourceLight, estimate_source
from splatpainter.splats import Splats
from splatpainter.system.recent import Recent

SURFACES = 3
"""Of the assets used last; one of a million Gaussians takes 200 MB."""
SOURCES = 16
"""Estimated lights; small."""
MAX_CLOSED = 0.35
"""Share of a Gaussian's sky that may be hidden, for it to be a witness of the light: what comes back from what hides it
is not known well."""
_SURFACES = Recent[LitSurface](SURFACES)
_SOURCES = Recent[SourceLight](SOURCES)
_LOCK = RLock()


def lit_surface(splats: Splats, shadows: bool = True) -> LitSurface:
    """`LitSurface.of`, computed once for equal shapes. Raises ValueError."""
    with _LOCK:
        return _SURFACES.get((_shape_hash(splats), shadows), lambda: LitSurface.of(splats, shadows))


def captured_light(splats: Splats, shadows: bool = True, up: UpAxis = "auto") -> SourceLight:
    """`estimate_source` of the asset's base colours, computed once for equal assets. up: where light usually comes
    from. Raises ValueError."""
    with _LOCK:
        surface = lit_surface(splats, shadows)
        key = (_shape_hash(splats), shadows, up, splats.color_space, _hash(splats.sh[:, 0]))
        return _SOURCES.get(key, lambda: _estimate(splats, surface, up))


def linear_colors(splats: Splats) -> np.ndarray:
    """[N, 3] base colours as linear light; grey where a Gaussian cannot be drawn."""
    sh = np.where(splats.drawable[:, None, None], splats.sh[:, :1], np.float32(0))
    return to_light(base_color(sh), splats.color_space)


def _estimate(splats: Splats, surface: LitSurface, up: UpAxis) -> SourceLight:
    witnesses = surface.facing.trusted & (surface.closed < MAX_CLOSED)
    return estimate_source(linear_colors(splats), surface.transfer, surface.points, witnesses, up)


def _shape_hash(splats: Splats) -> bytes:
    return _hash(splats.means, splats.quats, splats.scales, splats.opacities, splats.drawable)


def _hash(*arrays: np.ndarray) -> bytes:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).view(np.uint8).reshape(-1).data)
    return digest.digest()
