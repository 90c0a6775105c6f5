"""One edited picture of an asset, as every way of editing gives it, and the words for what to do with it."""

from __future__ import annotations

from dataclasses import field, replace
from typing import Literal

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.system.quick_dataclass import dataclass

Mode = Literal["local", "global", "spread"]
Method = Literal["auto", "ttt", "corrected", "lift", "fit"]
LayerMethod = Literal["auto", "ttt", "corrected", "lift", "fit", "predictor"]
"""What is asked of a layer, or, once it was made, what made it, as receipts have it."""
LIFTS: tuple[Method, ...] = ("lift", "corrected")
"""Of local edits: those that look at nothing beside the mask, nor at Gaussians beyond its tiles."""
MAX_VIEWS = 16
"""Most edited pictures of one edit."""
MAX_PIXEL_VALUE = 16.0
"""Of an edited picture: a little over 1 is what renders do, 255 is a forgotten division."""


@dataclass(frozen=True)
class Edit:
    """One edited picture of an asset."""

    image: np.ndarray = field(repr=False)
    """[H, W, 3] the edited view, float 0..1 (or uint8), of the camera's size."""
    camera: Camera
    mask: np.ndarray | None = field(default=None, repr=False)
    """[H, W] pixels that were edited: bool, or floats or uint8 above 0, kept as bool. None: found by comparing with the
    current render."""
    name: str = "edit"
    """What errors call it, e.g. its file."""
    cover: np.ndarray | None = field(default=None, repr=False)
    """[H, W] 0..1 how far the paint covers what was there, 1 where it does so as far as anywhere: less along the edge
    of a soft brush. Kept as float32. None: not known, taken for all. What spreads is asked of it."""

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        size = (self.camera.height, self.camera.width)
        if image.ndim != 3 or image.shape[2] != 3 or image.shape[:2] != size:
            raise ValueError(
                f"edit: expected a picture of shape [{size[0]}, {size[1]}, 3] for its camera, got {list(image.shape)}"
            )
        if image.dtype == np.uint8:
            image = image.astype(np.float32) / 255
        if image.dtype.kind != "f":
            raise ValueError(f"edit: expected a picture of floats in 0..1 or of uint8, got {image.dtype}")
        # Both ends say all of it, without a second picture: a NaN is both.
        largest = max(-image.min(), image.max())
        if not np.isfinite(largest):
            raise ValueError("edit: the picture has NaN or infinite pixels")
        if largest > MAX_PIXEL_VALUE:
            raise ValueError(f"edit: expected a picture of floats in 0..1, got values up to {largest:g}")
        object.__setattr__(self, "image", np.ascontiguousarray(image, np.float32))
        if self.mask is not None:
            mask = np.asarray(self.mask)
            if mask.shape != size:
                raise ValueError(f"edit: expected a mask of shape {list(size)}, got {list(mask.shape)}")
            object.__setattr__(self, "mask", mask > 0)
        if self.cover is not None:
            cover = np.asarray(self.cover, np.float32)
            if cover.shape != size or not ((cover >= 0) & (cover <= 1)).all():
                raise ValueError(f"edit: expected a cover of shape {list(size)}, each 0..1")
            object.__setattr__(self, "cover", cover)

    def relative_to(self, offset: tuple[float, float, float]) -> Edit:
        """This edit with its camera relative to the offset of an asset (Splats.offset)."""
        camera = self.camera.within(offset)
        return self if camera is self.camera else replace(self, camera=camera)
