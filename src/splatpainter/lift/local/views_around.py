"""Small views of an asset from all around, with edits moved there over the surface: what holds an edit's far sides.

An edit is moved as it looks at the views' own scale: shrunk to their pixels, against the asset drawn as small. An asset
fitted to pictures is right at their scale, and drawn larger its Gaussians leave gaps and specks. Against that a
close-up's change is that it mends them, which would spoil views in which there are none: warped over the *true* surface
into views of the whole object (8 meshes fitted by 3DGS, 160 px, close-ups at four times the scale), it took 23.0 dB to
22.3, the change at their scale to 22.8.

Where colours may change with the direction (`directional`), edits count less the further a view is turned away from
them. The same change, PSNR in those views where they see the surface of a close-up from 0 to 30, 30 to 60, and more
degrees aside: nothing done 23.5, 21.7, 19.5, moved there 26.7, 23.7, 18.0. More views of more weight then cost nothing
near the close-ups (21.4 dB; 0.4 dB where a colour is the same from all sides).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.kernels import portable
from splatpainter.lift.depth_normals import surface
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.warping import ViewedChange, shrunk
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.transforms import fibonacci_sphere

NUM_VIEWS, NUM_DIRECTIONAL_VIEWS = 8, 16
VIEW_PX = 128
"""Pixels of the views' edges."""
FOV_DEGREES = 40.0
BOUNDS_PERCENTILES = (1.0, 99.0)
"""Percentiles of the Gaussians' coordinates: what the views show."""
PIXEL_WEIGHT, DIRECTIONAL_PIXEL_WEIGHT = 2.0, 3.0
"""What a pixel of theirs counts."""
MIN_SURFACE_ALPHA = 0.5
"""Pixels that the asset covers by less have no surface."""
MIN_CHANGE_PX = 8
"""Pixels to which an edit's shorter side is shrunk at most."""
FADE_DEGREES = (45.0, 75.0)
"""Degrees between the lines of sight of an edit and of a view: from where to where the edit fades."""


def views_around(
    splats: Splats, edits: Sequence[EditView], *, directional: bool
) -> list[tuple[Camera, np.ndarray, np.ndarray]]:
    """(camera, picture [h, w, 3], what its pixels count [h, w]): the asset as it is, with the edits where the same
    surface is seen. directional: less of them from aside (FADE_DEGREES)."""
    cameras, pixel = _cameras(splats, edits[0].camera, NUM_DIRECTIONAL_VIEWS if directional else NUM_VIEWS)
    weight = DIRECTIONAL_PIXEL_WEIGHT if directional else PIXEL_WEIGHT
    changes = [change for edit in edits if (change := _viewed_change(splats, edit, pixel)) is not None]
    pictures = []
    for camera in cameras:
        view = project(splats, camera)
        image, alpha, _ = view.rasterize()
        solid = alpha > MIN_SURFACE_ALPHA
        if not solid.any():
            continue
        depth = np.where(solid, surface(view, solid)[0], 0)
        moved = np.zeros((*depth.shape, 4))
        for change in changes:
            moved += change.moved(camera, depth) * (_faded(change.camera, camera, depth) if directional else 1)
        target = image + moved[..., :3] / np.maximum(moved[..., 3:], 1)
        pictures.append((camera, target.astype(np.float32), weight * solid.astype(np.float32)))
    return pictures


def _viewed_change(splats: Splats, edit: EditView, pixel: float) -> ViewedChange | None:
    """The edit's change in pixels of about `pixel` (world units on the surface), never in smaller ones than its own;
    None where the asset has no surface in it."""
    near = _median_depth(splats, edit)
    if near is None:
        return None
    camera, (height, width) = edit.camera, edit.mask.shape
    factor = round(pixel * max(camera.fx, camera.fy) / near)
    factor = max(min(factor, min(height, width) // MIN_CHANGE_PX), 1)
    mask = shrunk(edit.mask.astype(np.float32), factor)
    edited, before = (shrunk(image * edit.mask[..., None], factor) for image in (edit.edited, edit.before))
    height, width = mask.shape
    camera = camera.cropped(0, 0, width * factor, height * factor).resized(width, height)
    projected = project(splats, camera)
    image, alpha, _ = projected.rasterize()
    depth = surface(projected, alpha > MIN_SURFACE_ALPHA)[0]
    visible = (depth > 0)[..., None]
    changes = [(edited - before) * visible, (edited - image * mask[..., None]) * visible]
    change = min(changes, key=lambda change: float((change**2).sum(dtype=np.float64)))
    return ViewedChange(camera, change, mask * (depth > 0), depth) if visible.any() else None


def _median_depth(splats: Splats, edit: EditView) -> float | None:
    """Median depth of the surface in the mask, world units; None where there is none."""
    _, alpha, depth = project(splats, edit.camera).rasterize()
    solid = edit.mask & (alpha > MIN_SURFACE_ALPHA)
    return float(np.median(depth[solid] / alpha[solid])) if solid.any() else None


def _faded(first: Camera, other: Camera, depth: np.ndarray) -> np.ndarray:
    """[H, W, 1] 1 where both cameras look at the surface of `other` (z-depths, 0 for none) from about the same side, 0
    where from FADE_DEGREES[1] or more aside."""
    points = other.unproject(np.where(depth > 0, depth, 1))
    to_other, to_first = (camera.position - points for camera in (other, first))
    cosines = (to_other * to_first).sum(-1) / np.maximum(
        np.linalg.norm(to_other, axis=-1) * np.linalg.norm(to_first, axis=-1), 1e-12
    )
    low, high = FADE_DEGREES
    return np.clip((high - np.degrees(portable.arccos(np.clip(cosines, -1, 1)))) / (high - low), 0, 1)[..., None]


def _cameras(splats: Splats, first: Camera, count: int) -> tuple[list[Camera], float]:
    """`count` cameras on a sphere about the asset; it fills their pictures. first: whose background they have. And the
    size of their pixels at the asset's middle, world units."""
    means = splats.means[splats.drawable]
    low, high = np.percentile(means.astype(np.float64), BOUNDS_PERCENTILES, axis=0)
    center, radius = (low + high) / 2, max(portable.length(high - low) / 2, 1e-6)
    distance = radius / portable.sin(math.radians(FOV_DEGREES / 2))
    cameras = []
    for direction in fibonacci_sphere(count):
        up = np.eye(3)[int(np.argmin(np.abs(direction)))]
        how = {"width": VIEW_PX, "height": VIEW_PX, "fov": FOV_DEGREES, "background": first.background}
        cameras.append(look_at(center + distance * direction, center, up, **how).local)
    return cameras, distance / cameras[0].fx
