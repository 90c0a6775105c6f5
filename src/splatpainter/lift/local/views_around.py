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
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere


@dataclass(frozen=True)
class ViewsAroundThresholds:
    """Views around an asset that hold a local edit to its place, and how much they count. Source: taste."""

    views: int = 8
    """Views whose pixels hold base colours."""
    directional_views: int = 16
    """Views whose pixels hold band 1, which more directions have to see."""
    edge_px: int = 128
    """Pixels of the views' edges."""
    fov_degrees: float = 40.0
    """Field of view, degrees: narrow, so that far and near parts are seen at about one scale."""
    bounds_percentiles: tuple[float, float] = (1.0, 99.0)
    """Percentiles of the Gaussians' coordinates: what the views show."""
    pixel_weight: float = 2.0
    """What a pixel of theirs counts beside one of the edited view."""
    directional_pixel_weight: float = 3.0
    """The same for band 1."""
    min_surface_alpha: float = 0.5
    """Pixels that the asset covers by less have no surface."""
    min_change_px: int = 8
    """Pixels to which an edit's shorter side is shrunk at most."""
    fade_degrees: tuple[float, float] = (45.0, 75.0)
    """Degrees between the lines of sight of an edit and of a view: from where to where the edit fades."""


VIEWS_AROUND = ViewsAroundThresholds()


def views_around(
    splats: Splats, edits: Sequence[EditView], *, directional: bool
) -> list[tuple[Camera, np.ndarray, np.ndarray]]:
    """(camera, picture [h, w, 3], what its pixels count [h, w]): the asset as it is, with the edits where the same
    surface is seen. directional: less of them from aside (VIEWS_AROUND.fade_degrees)."""
    cameras, pixel = _cameras(
        splats, edits[0].camera, VIEWS_AROUND.directional_views if directional else VIEWS_AROUND.views
    )
    weight = VIEWS_AROUND.directional_pixel_weight if directional else VIEWS_AROUND.pixel_weight
    # Edits at the scale of these views, once each, before the views are drawn.
    changes = [change for edit in edits if (change := _viewed_change(splats, edit, pixel)) is not None]
    pictures = []
    for camera in cameras:
        view = project(splats, camera)
        image, alpha, _ = view.rasterize()
        solid = alpha > VIEWS_AROUND.min_surface_alpha
        if not solid.any():
            continue
        # The asset's own surface says where each pixel of an edit is seen from here.
        depth = np.where(solid, surface(view, solid)[0], 0)
        moved = np.zeros((*depth.shape, 4))
        for change in changes:
            moved += change.moved(camera, depth) * (_faded(change.camera, camera, depth) if directional else 1)
        # Where several edits reach a pixel, their changes are averaged; where one reaches it in part, that part is
        # added.
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
    # Shrunk to the views' own pixels: finer changes could not be seen there and would alias.
    factor = round(pixel * max(camera.fx, camera.fy) / near)
    factor = max(min(factor, min(height, width) // VIEWS_AROUND.min_change_px), 1)
    mask = shrunk(edit.mask.astype(np.float32), factor)
    edited, before = (shrunk(image * edit.mask[..., None], factor) for image in (edit.edited, edit.before))
    height, width = mask.shape
    camera = camera.cropped(0, 0, width * factor, height * factor).resized(width, height)
    projected = project(splats, camera)
    image, alpha, _ = projected.rasterize()
    depth = surface(projected, alpha > VIEWS_AROUND.min_surface_alpha)[0]
    visible = (depth > 0)[..., None]
    # Of two ways to say what changed (against the picture, against the asset drawn as small) the smaller one.
    changes = [(edited - before) * visible, (edited - image * mask[..., None]) * visible]
    change = min(changes, key=lambda change: float(portable.total(change**2, np.float64)))
    return ViewedChange(camera, change, mask * (depth > 0), depth) if visible.any() else None


def _median_depth(splats: Splats, edit: EditView) -> float | None:
    """Median depth of the surface in the mask, world units; None where there is none."""
    _, alpha, depth = project(splats, edit.camera).rasterize()
    solid = edit.mask & (alpha > VIEWS_AROUND.min_surface_alpha)
    return float(np.median(depth[solid] / alpha[solid])) if solid.any() else None


def _faded(first: Camera, other: Camera, depth: np.ndarray) -> np.ndarray:
    """[H, W, 1] 1 where both cameras look at the surface of `other` (z-depths, 0 for none) from about the same side, 0
    where from VIEWS_AROUND.fade_degrees[1] or more aside."""
    # The angle at the surface point between both lines of sight.
    points = other.unproject(np.where(depth > 0, depth, 1))
    to_other, to_first = (camera.position - points for camera in (other, first))
    cosines = (to_other * to_first).sum(-1) / np.maximum(
        np.linalg.norm(to_other, axis=-1) * np.linalg.norm(to_first, axis=-1), 1e-12
    )
    low, high = VIEWS_AROUND.fade_degrees
    return np.clip((high - np.degrees(portable.arccos(np.clip(cosines, -1, 1)))) / (high - low), 0, 1)[..., None]


def _cameras(splats: Splats, first: Camera, count: int) -> tuple[list[Camera], float]:
    """`count` cameras on a sphere about the asset; it fills their pictures. first: whose background they have. And the
    size of their pixels at the asset's middle, world units."""
    means = splats.means[splats.drawable]
    low, high = np.percentile(means.astype(np.float64), VIEWS_AROUND.bounds_percentiles, axis=0)
    center, radius = (low + high) / 2, max(portable.length(high - low) / 2, 1e-6)
    distance = radius / portable.sin(math.radians(VIEWS_AROUND.fov_degrees / 2))
    cameras = []
    for direction in fibonacci_sphere(count):
        # The axis farthest from the line of sight: no camera is degenerate.
        up = np.eye(3)[int(np.argmin(np.abs(direction)))]
        how = {
            "width": VIEWS_AROUND.edge_px,
            "height": VIEWS_AROUND.edge_px,
            "fov": VIEWS_AROUND.fov_degrees,
            "background": first.background,
        }
        cameras.append(look_at(center + distance * direction, center, up, **how).local)
    return cameras, distance / cameras[0].fx
