"""The bundled demo asset: a teapot, a bowl of tea and a lemon on a round board (made by examples/still_life).

demo_asset.sog is a file like any other (docs/formats.md): 2.9 MB in place of the 15.7 MB of its float32 numbers, whose
picture differs by 65 dB.
"""

from __future__ import annotations

from pathlib import Path

from splatpainter.cameras import Camera, look_at
from splatpainter.io import read
from splatpainter.splats import ATTRIBUTES, Splats

FILE = Path(__file__).with_suffix(".sog")
HERO_EYE = (0.46, 0.92, 3.6)
"""Where the recommended camera stands, world units."""
HERO_TARGET = (0.0, -0.11, 0.0)
"""What it looks at, world units."""
HERO_FOV = 33.0
"""Its vertical field of view, degrees."""
BACKGROUND = (0.235, 0.295, 0.325)
"""A background that suits the still life, display sRGB."""
CALM = (0.335, 0.455, 0.625, 0.555)
"""Left, top, right, bottom of the pot's empty belly in the recommended view, as parts of the picture's size."""


def demo_asset() -> Splats:
    """The still life: 88,454 surface-aligned Gaussians of SH degree 3, y up, about 2 units across, centred near the
    origin; float32 numpy, colours display sRGB."""
    stored = read(FILE)
    return Splats(*(getattr(stored, name) for name in ATTRIBUTES))  # Gaussians of their own, not of that file


def demo_view(size: int = 800) -> Camera:
    """The recommended view of the still life, size x size pixels."""
    return look_at(HERO_EYE, HERO_TARGET, width=size, height=size, fov=HERO_FOV, background=BACKGROUND)
