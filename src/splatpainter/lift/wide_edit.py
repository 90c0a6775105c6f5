"""Edits of most of what their views show: zoom-ins, upscaled and restyled views. All views are lifted at once.

Paint on a part of a picture is wanted as it is; what fills whole pictures is detail, which the asset mostly has already
and should only have sharper. So the Gaussians that the views show are first moved: places, sizes, turns and opacities,
in a few steps of 3DGS towards all views at once, held by views of the asset from around. Gaussians that were fine
enough for the pictures that an asset was made from are off by pixels in close-ups, and no colour mends that. Where it
explains little of the change (another light, noise) they stay where they are. Then those over which the rest of the
change varies are split, in view after view, and all that the views show take new colours, towards all pictures
together. Two things hold these:

- a Gaussian takes the slower steps the less of it the views show, so that what shimmers through from behind, or reaches
  out of the picture, moves little in the few rounds there are;
- small views of the asset from all around count too, with the edit moved there over the surface where they see it, and
  with what they show of the asset where they do not.

Two close-ups each, dB. Clean (4 meshes sampled into 60,000 Gaussians), novel close-ups / before and after from afar:
nothing done 26.7, without moving 29.7 / 36, with it 32.9 / 46. Fitted by 3DGS (8 meshes, 160 px), novel close-ups / the
whole object: nothing 19.0 / 23.0, without 20.9 / 22.3, with it 21.5 / 22.5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.lift.colors import MAX_COLOR, MIN_CHANGE, MIN_SEEN_PX
from splatpainter.lift.depth_normals import surface
from splatpainter.lift.edit_views import EditView, errors_name
from splatpainter.lift.evidence import footprints
from splatpainter.lift.local_edit import MIN_VISIBLE_SHARE, NOTHING_THERE, split_local
from splatpainter.lift.options import LocalOptions
from splatpainter.lift.warping import ViewedChange, shrunk
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.rendering.cpu.sirt import sirt_steps
from splatpainter.splats import SH_C0, Splats, changed_rows
from splatpainter.transforms import fibonacci_sphere

GEOMETRY = ("means", "scales", "quats", "opacities")
MAX_ERROR_LEFT = 0.85
"""Squared error in the edited views that moving Gaussians may leave, against before, else they stay. Close-ups of the
truth: 0.3 to 0.84; noise finer than the Gaussians 0.98; one in other colours that moving spoilt 0.94."""
WIDTH_GOAL_PX = 1.4
"""Gaussians are halved until they are about this wide (standard deviation, pixels of the edited view)."""
TOLERANCE = 0.05
"""Standard deviation of the change over a Gaussian's footprint (0..1) above which it is halved."""
MAX_APPENDED = 40_000
"""About how many Gaussians splitting may append for each view."""
MIN_ALPHA = 0.02
"""Pixels that the asset covers by less are not its."""
SLOWNESS = 0.1
"""Pixels' worth of weight that each pixel's worth of a Gaussian that no edited view shows adds to the divisor of its
steps."""
AROUND_VIEWS = 8
"""Views from all around."""
AROUND_PX = 128
"""Pixels of their edges."""
AROUND_FOV = 40.0
"""Degrees."""
AROUND_PERCENTILES = (1.0, 99.0)
"""Of the Gaussians' coordinates: what the views from all around show."""
AROUND_WEIGHT = 2.0
"""What a pixel of theirs counts."""
MIN_SURFACE_ALPHA = 0.5
"""Pixels that the asset covers by less have no surface."""
MAX_CHANGE_PX = 256
"""Pixels of the longer side of a picture of an edit's change that is moved into other views."""


@dataclass(frozen=True)
class WideLift:
    """Result of `lift_wide`."""

    splats: Splats
    """N Gaussians at their old indices, then the appended ones."""
    touched: np.ndarray = field(repr=False)
    """[T] int64 ascending: old Gaussians of which any attribute changed."""
    parents: np.ndarray = field(repr=False)
    """[A] int64: the old Gaussian that each appended one was split from."""


def lift_wide(splats: Splats, views: Sequence[EditView], options: LocalOptions) -> WideLift:
    """Write the masked pixels of all views onto the splats together. options: `rounds` and `damping` count.

    Raises ValueError, naming the view, where no Gaussian contributes to its masked pixels."""
    around = _views_around(splats, views)
    moved = _moved(splats, views)
    split = _split(moved, views)
    movable = _visible(split.splats, views)
    pictures = [_Picture.of(split.splats, view.camera, view.target, _solid(view), movable) for view in views]
    further = [_Picture.of(split.splats, *picture, movable) for picture in around]
    result = replace(split.splats, sh=_recolored(split.splats, pictures, further, options))
    return replace(split, splats=result, touched=changed_rows(splats, result))


def _moved(splats: Splats, views: Sequence[EditView]) -> Splats:
    """The Gaussians that the views show, where steps of 3DGS towards all of them put them; the same colours. They stay
    where that leaves more than MAX_ERROR_LEFT."""
    from splatpainter.fit.edited import EditFitOptions, fit_edited

    visible, pictures, before = _visible(splats, views), [], 0.0
    if not visible.any():
        raise ValueError(NOTHING_THERE)
    for view in views:
        image = project(splats, view.camera).rasterize()[0]  # `view.before` may show the tiles of its mask alone
        pictures.append((view.camera, np.where(view.mask[..., None], view.edited, image)))
        before += _error(image, view)
    moved = fit_edited(splats, splats, pictures, np.flatnonzero(visible), EditFitOptions(attributes=GEOMETRY))
    after = sum(_error(project(moved, view.camera).rasterize()[0], view) for view in views)
    return moved if after < MAX_ERROR_LEFT * before else splats


def _error(image: np.ndarray, view: EditView) -> float:
    """Sum of squared differences from the view's edited pixels."""
    return float((_solid(view)[view.mask, None] * (image - view.edited)[view.mask] ** 2).sum(dtype=np.float64))


def _visible(splats: Splats, views: Sequence[EditView]) -> np.ndarray:
    """[N] bool: Gaussians of which some view shows more than MIN_VISIBLE_SHARE."""
    visible = np.zeros(len(splats), bool)
    for view in views:
        projected = project(splats, view.camera)
        sums = projected.backproject(view.target, _solid(view))
        visible[projected.gaussian_ids[sums.weight > MIN_VISIBLE_SHARE * sums.alpha]] = True
    return visible


def _solid(view: EditView) -> np.ndarray:
    """[H, W] float32: 1 where the picture is the asset's."""
    if view.alpha is None:
        return np.ones(view.mask.shape, np.float32)
    return (np.asarray(view.alpha) > MIN_ALPHA).astype(np.float32)


def _split(splats: Splats, views: Sequence[EditView]) -> WideLift:
    """The Gaussians over which the change of any view varies, split; colours are as they were."""
    options = LocalOptions(goal_px=WIDTH_GOAL_PX, tolerance=TOLERANCE, max_appended=MAX_APPENDED)
    count = len(splats)
    ancestry, touched = np.arange(count), np.zeros(count, bool)
    for view in views:
        with errors_name(view.name):
            part = split_local(splats, view.camera, view.target, view.mask, options)
        old = ancestry[part.touched]
        touched[old[part.touched < count]] = True
        ancestry = np.append(ancestry, ancestry[part.parents])
        splats = part.splats
    return WideLift(splats, np.flatnonzero(touched), ancestry[count:])


class _Picture:
    """One picture to reach, and what it weighs."""

    def __init__(self, view: ProjectedView, target: np.ndarray, use: np.ndarray, movable: np.ndarray) -> None:
        self.view = view
        ids = view.gaussian_ids
        here = movable[ids]
        self.ids = ids[here]
        """[C] of the Gaussians that may move, those that the view shows."""
        self.before = view.unclamped_colors[here]
        """[C, 3]"""
        self.footprints = footprints(view)[here]
        self._steps = sirt_steps(view, target, use, here)
        self.weight = self._steps.weight
        """[C] pixels' worth of each in the picture."""

    @staticmethod
    def of(splats: Splats, camera: Camera, target: np.ndarray, use: np.ndarray, movable: np.ndarray) -> _Picture:
        """target: [H, W, 3] float32; use: [H, W] float32, what each pixel counts; movable: [N] bool."""
        tiles = project(splats, camera, gaussian_mask=movable).tiles_of(movable)
        return _Picture(project(splats, camera, tiles=tiles), target, use, movable)

    def gain(self, change: np.ndarray) -> np.ndarray:
        """[C, 3] sum_p w_ip m_p (target_p - image_p) with all Gaussians' base colours changed by `change` [N, 3]."""
        ceiling = np.maximum(self.before, MAX_COLOR)
        return self._steps.residual(np.clip(self.before + change[self.ids], 0, ceiling))


def _recolored(
    splats: Splats, pictures: Sequence[_Picture], around: Sequence[_Picture], options: LocalOptions
) -> np.ndarray:
    """[N, K, 3] SH after `options.rounds` towards all pictures at once (SIRT with preconditioned steps)."""
    count = len(splats)
    divisor, visible, hidden = (np.zeros(count, np.float32) for _ in range(3))
    varying = np.zeros((count, 3), np.float32)  # what bands >= 1 add in the edited views, by weight
    for picture in pictures:
        visible[picture.ids] += picture.weight
        hidden[picture.ids] += np.maximum(picture.footprints - picture.weight, 0)
        flat = 0.5 + SH_C0 * splats.sh[picture.ids, 0]
        varying[picture.ids] += picture.weight[:, None] * (picture.before - flat)
    for picture in (*pictures, *around):
        divisor[picture.ids] += picture.weight
    if not visible.any():
        raise ValueError(NOTHING_THERE)
    step = np.where(visible > MIN_SEEN_PX, 1 / np.maximum(divisor + SLOWNESS * hidden, 1e-6), 0)[:, None]
    change = np.zeros((count, 3), np.float32)
    for _ in range(options.rounds):
        gain = np.zeros_like(change)
        for picture in (*pictures, *around):
            gain[picture.ids] += picture.gain(change)
        change = np.clip(change + step * gain, -MAX_COLOR, MAX_COLOR).astype(np.float32)
    size = np.abs(change).max(1)
    moved = np.flatnonzero(size > MIN_CHANGE)
    if not len(moved):
        return splats.sh
    sh = splats.sh.copy()
    sh[moved, 0] += change[moved] / SH_C0
    if sh.shape[1] > 1:  # as in colors.recolor, with the mean over the views of what the bands add
        keep = (1 - (1 - options.damping) * np.clip(size[moved] / 0.3, 0, 1))[:, None]
        mean = varying[moved] / np.maximum(visible[moved], 1e-6)[:, None]
        sh[moved, 0] += (1 - keep) * mean / SH_C0
        sh[moved, 1:] *= keep[..., None]
    return sh


def _views_around(splats: Splats, views: Sequence[EditView]) -> list[tuple[Camera, np.ndarray, np.ndarray]]:
    """(camera, picture [h, w, 3], what its pixels count [h, w]) from all around the asset: as it is, with the edits
    where the same surface is seen."""
    edits = [change for view in views if (change := _viewed_change(splats, view)) is not None]
    pictures = []
    for camera in _cameras_around(splats, views[0].camera):
        view = project(splats, camera)
        image, alpha, _ = view.rasterize()
        solid = alpha > MIN_SURFACE_ALPHA
        if not solid.any():
            continue
        depth = np.where(solid, surface(view, solid)[0], 0)
        moved = sum((edit.moved(camera, depth) for edit in edits), np.zeros((*depth.shape, 4)))
        target = image + moved[..., :3] / np.maximum(moved[..., 3:], 1)
        pictures.append((camera, target.astype(np.float32), AROUND_WEIGHT * solid.astype(np.float32)))
    return pictures


def _viewed_change(splats: Splats, view: EditView) -> ViewedChange | None:
    """The edit's change, small; None where the asset has no surface in it."""
    height, width = view.mask.shape
    factor = -(-max(height, width) // MAX_CHANGE_PX)
    mask = shrunk(view.mask.astype(np.float32), factor)
    change = shrunk((view.edited - view.before) * view.mask[..., None], factor)
    height, width = mask.shape
    camera = view.camera.cropped(0, 0, width * factor, height * factor).resized(width, height)
    projected = project(splats, camera)
    solid = projected.rasterize()[1] > MIN_SURFACE_ALPHA
    depth = surface(projected, solid)[0]
    mask = mask * (depth > 0)
    return ViewedChange(camera, change * (depth > 0)[..., None], mask, depth) if mask.any() else None


def _cameras_around(splats: Splats, first: Camera) -> list[Camera]:
    """AROUND_VIEWS cameras on a sphere about the asset; it fills their pictures. first: whose background they have."""
    means = splats.means[splats.drawable]
    low, high = np.percentile(means.astype(np.float64), AROUND_PERCENTILES, axis=0)
    center, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    distance = radius / math.sin(math.radians(AROUND_FOV / 2))
    cameras = []
    for direction in fibonacci_sphere(AROUND_VIEWS):
        up = np.eye(3)[int(np.argmin(np.abs(direction)))]
        how = {"width": AROUND_PX, "height": AROUND_PX, "fov": AROUND_FOV, "background": first.background}
        cameras.append(look_at(center + distance * direction, center, up, **how))
    return cameras
