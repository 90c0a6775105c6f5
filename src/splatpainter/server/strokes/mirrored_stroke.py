"""The other half of a stroke under symmetry: the same pixels on the mirrored view, left and right exchanged."""

from __future__ import annotations

import numpy as np

from splatpainter.color import to_display
from splatpainter.server.strokes.stroke import Box, Stroke
from splatpainter.splats import Splats


class MirroredStroke(Stroke):
    """A stroke that follows another one."""

    keep = 0.0
    """How far colours are differences from what is below (0..1): paint that keeps the shading of the one side has the
    shading of the other side there."""

    def follow(self, first: Stroke, box: Box, splats: Splats, original: Splats, version: int) -> Box:
        """Take over new pixels of the first stroke; returns where they lie here."""
        left, top, right, bottom = box
        # The same pixels as the first half, so that both sides are one stroke.
        rgba = first.rgba[top:bottom, left:right]
        # Paint that keeps shading is a difference to what is below; the other side has other shading.
        if self.keep > 0:
            first.prepare(splats, original, version)
            self.prepare(splats, original, version)
            here = (slice(top, bottom), slice(self.camera.width - right, self.camera.width - left))
            window = (slice(top, bottom), slice(left, right))
            base = to_display(self.base[here], splats.color_space)[:, ::-1] - to_display(
                first.base[window], splats.color_space
            )
            moved = np.clip(rgba[..., :3] + 255 * self.keep * base, 0, 255).round()
            rgba = np.concatenate([moved.astype(np.uint8), rgba[..., 3:]], -1)
        # Left and right change places: the mirrored view sees it from the other side.
        flipped = np.ascontiguousarray(rgba[:, ::-1])
        return self.patch(self.camera.width - right, top, right - left, bottom - top, flipped.tobytes())


def merged(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Two previews ([C] ascending Gaussians, [C, K, 3] their SH) as one; where both have a Gaussian, the first's."""
    ids = np.concatenate([first[0], second[0]])
    # unique keeps the first of each: on the plane itself both halves have the same Gaussians.
    unique, index = np.unique(ids, return_index=True)
    return unique, np.concatenate([first[1], second[1]])[index]
