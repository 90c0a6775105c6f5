"""Edited pictures of a scene as edits of each of its assets: whose surface each pixel shows, cameras in that asset's
own space. Pure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.painter import Edit
from splatpainter.rendering.pixel_shares import before_black
from splatpainter.session.document.layer_factory import changed_pixels
from splatpainter.session.replay.scene_replay import Scene, ScenePart

MIN_ALPHA = 0.02
"""Alpha of a pixel from which it shows an asset."""
MIN_PIXELS, MIN_SHARE = 24, 0.05
"""Pixels of an edit, or their share of what it covers, from which an asset takes part in it: the rim of a stroke on
one asset mixes with what is behind."""


def split_edits(scene: Scene, edits: Sequence[Edit], masked: bool = True) -> list[tuple[ScenePart, list[Edit]]]:
    """The assets that edits reach, those with the most pixels first, and what each is painted with. masked: edits
    without a mask get that of what they changed (else all of an asset is theirs). Raises ValueError where no edit
    reaches any."""
    pixels = np.zeros(len(scene.parts))
    owners, masks = [], []
    for edit in edits:
        mask = edit.mask
        if mask is None and masked:
            mask = changed_pixels(scene.state.splats, edit)
        mask = np.ones((edit.camera.height, edit.camera.width), bool) if mask is None else mask
        owner = asset_numbers(scene, edit.camera)
        pixels += np.bincount(owner[mask & (owner >= 0)], minlength=len(scene.parts))
        owners.append(owner)
        masks.append(mask)
    if not pixels.any():
        raise ValueError("edit: nothing to do, no asset is under the mask")
    # The rim of a stroke mixes with what is behind: a few pixels there are no wish to paint it.
    reached = [k for k in np.argsort(-pixels, kind="stable") if pixels[k] >= min(MIN_PIXELS, MIN_SHARE * pixels.sum())]
    out = []
    for k in reached:
        part, pieces = scene.parts[k], []
        for edit, owner, mask in zip(edits, owners, masks, strict=True):
            # Pixels of no asset stay with each: paint may reach a little beyond a silhouette.
            inside = mask & ((owner == k) | (owner < 0))
            if (inside & (owner == k)).any():
                pieces.append(Edit(edit.image, part.camera(edit.camera), inside, edit.name, edit.cover))
        out.append((part, pieces))
    return out


def asset_numbers(scene: Scene, camera: Camera) -> np.ndarray:
    """[H, W] int64 index in `scene.parts` of the asset that most of each pixel is of; -1: of none."""
    view = before_black(scene.state.splats, camera)
    numbers = scene.asset_numbers[view.gaussian_ids]
    best = np.full((camera.height, camera.width), MIN_ALPHA, np.float32)
    out = np.full(best.shape, -1, np.int64)
    # Three assets at a time, one per colour channel: the renderer then says each one's share.
    for first in range(0, len(scene.parts), 3):
        colors = (numbers[:, None] == np.arange(first, first + 3)).astype(np.float32)
        shares = view.rasterize(np.ascontiguousarray(colors))[0]
        for channel in range(min(3, len(scene.parts) - first)):
            more = shares[..., channel] > best
            best[more], out[more] = shares[..., channel][more], first + channel
    return out
