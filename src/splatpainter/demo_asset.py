"""The bundled demo asset: a teapot, a bowl of tea and a lemon on a round board (made by examples/still_life).

demo_asset.npz holds each attribute as uint8 [4, ..., N]: the bytes of its float32 numbers, lowest first, each byte by
itself, deflated to four fifths (LZMA saves 3 % more and takes a second to unpack). Numbers are those of the generator
with one BLAS thread.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.splats import ATTRIBUTES, Splats

FILE = Path(__file__).with_suffix(".npz")
HERO_EYE = (0.46, 0.92, 3.6)
"""Recommended camera: where it stands ..."""
HERO_TARGET = (0.0, -0.11, 0.0)
"""... what it looks at ..."""
HERO_FOV = 33.0
"""... and its vertical field of view, degrees."""
BACKGROUND = (0.235, 0.295, 0.325)
"""A background that suits the still life, display sRGB."""
CALM = (0.335, 0.455, 0.625, 0.555)
"""Left, top, right, bottom of the pot's empty belly in the recommended view, as parts of the picture's size."""


def demo_asset() -> Splats:
    """The still life: 88,454 surface-aligned Gaussians of SH degree 3, y up, about 2 units across, centred near the
    origin; float32 numpy, colours display sRGB."""
    with np.load(FILE) as file:
        means, quats, scales, opacities, sh = (_joined(file[name]) for name in ATTRIBUTES)
    return Splats(means, quats, scales, opacities, sh)


def demo_view(size: int = 800) -> Camera:
    """The recommended view of the still life, size x size pixels."""
    return look_at(HERO_EYE, HERO_TARGET, width=size, height=size, fov=HERO_FOV, background=BACKGROUND)


def _joined(planes: np.ndarray) -> np.ndarray:
    """uint8 [4, ..., N] -> float32 [N, ...]."""
    values = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view("<f4")[..., 0]
    return np.ascontiguousarray(np.moveaxis(values, -1, 0), np.float32)
