"""Edits as an artist makes them: a point on the surface, a view of it, and a stroke, sticker, word, photo patch or
recolouring there; and points with texture worth a closer look. What shows too little, or lies beside the object, is
thrown away and tried again. What is drawn is that of the training data (splattrain.data.edits). Knows no table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from splatbench.cases import Setup
from splatbench.ground_truth import GroundTruth, GroundTruthViews, changed
from splatpainter.cameras import Camera
from splattrain.data import viewpoints
from splattrain.data.edits import MAX_EDIT_FRACTION, MIN_EDIT_FRACTION, EditDesign, layer_on_object
from splattrain.data.edits.content import Canvas, EditResources, Recoloring, list_files
from splattrain.data.edits.surface_points import (
    MIN_SOLID_ALPHA,
    MIN_VIEW_COSINE,
    SurfacePoint,
    facing_normals,
    random_surface_point,
)

KINDS = ("stroke", "sticker", "text", "photo", "recolor")
"""Kinds of edits, in turn."""
Framing = Literal["close-up", "whole"]
PAINTED_SHARE = (0.06, 0.3)
"""Part of the object in view that paint covers: from, to."""
WINDOW_RADII = (0.7, 1.7)
"""Height of a close-up, in radii of the object."""
MIN_OBJECT_FRACTION = 0.12
"""Least share of an edited view that the object fills."""
MIN_EDIT_RMS = 0.1
"""Change of display values in an edit's view, root mean square over the pixels that it changes."""
BLOCKED_SLACK = 0.02
"""World units that a surface may lie before a point and still be its own."""
DESIGN_TRIES = 24
RELAXED_AFTER = 0.75
"""Share of the tries over which the standards fall to nothing: thin objects need patience first."""
WINDOW_FRACTIONS = (0.6, 0.4, 0.2, 0.0)
"""Least part of a textured point's window that is object: the first of these that leaves any point."""
BEST_CONTRAST_SHARE = 0.1
"""Share of all pixels that could be textured points, those with the highest contrast, from which points are drawn."""
MAX_DEPTH_STEP_PX = 4.0
"""Steps of depth between neighbours above this many pixel widths are edges of the object, not texture."""


def resources(setup: Setup) -> EditResources:
    """The files that edits are made of. Raises ValueError for a folder that there is not."""
    folders = (setup.decals, setup.fonts, setup.textures)
    return EditResources(*(() if folder is None else list_files(folder) for folder in folders))


def strictness(attempt: int) -> float:
    """1 at first, 0 after RELAXED_AFTER of the tries."""
    return max(1 - attempt / (RELAXED_AFTER * DESIGN_TRIES), 0.0)


def surface_point(views: GroundTruthViews, rng: np.random.Generator) -> SurfacePoint:
    """Any that faces one of the views. Raises ValueError where there is none."""
    return random_surface_point(views.images.cameras, views.depths, views.alphas, rng)


def design_edit(
    preview: GroundTruth,
    base: GroundTruthViews,
    kind: str,
    framing: Framing,
    files: EditResources,
    rng: np.random.Generator,
    accept: Callable[[SurfacePoint, np.ndarray], bool] = lambda point, mask: True,
) -> tuple[EditDesign, SurfacePoint]:
    """An edit of a kind that shows in its view. preview: a truth that is quickly drawn (GroundTruth.preview), with
    earlier edits on it. base: views in which points are looked for. accept: whether a point and what the edit changes
    in its view ([H, W] bool) will do. Raises ValueError, naming the object, after DESIGN_TRIES."""
    for attempt in range(DESIGN_TRIES):
        point = surface_point(base, rng)
        camera = view_of(point, framing, preview.radius, preview.optics, rng)
        if preview.blocks(camera.position, point.position, BLOCKED_SLACK):
            continue
        before = preview.render([camera], "design")
        design = draw_edit(kind, camera, point, before, files, rng, strictness(attempt))
        if design is None:
            continue
        after = preview.paint(design).render([camera], "design")
        mask = changed(before, after)[0]
        visible = is_visible(before.images.colors[0], after.images.colors[0], mask, strictness(attempt))
        if visible and accept(point, mask):
            return design, point
    raise invisible(preview.name, kind)


def invisible(name: str, kind: str) -> ValueError:
    return ValueError(f"{name}: {DESIGN_TRIES} choices of a {kind} edit changed nothing that can be seen")


def is_visible(before: np.ndarray, after: np.ndarray, mask: np.ndarray, strict: float = 1.0) -> bool:
    """Whether an edit is worth asking about: pictures [H, W, 3], what it changes [H, W] bool; strict: times
    MIN_EDIT_RMS."""
    if not MIN_EDIT_FRACTION <= mask.mean() <= MAX_EDIT_FRACTION:
        return False
    return bool(np.sqrt(np.mean((after - before)[mask] ** 2)) >= strict * MIN_EDIT_RMS)


def draw_edit(
    kind: str,
    camera: Camera,
    point: SurfacePoint,
    view: GroundTruthViews,
    files: EditResources,
    rng: np.random.Generator,
    strict: float = 1.0,
) -> EditDesign | None:
    """An edit at a point, designed on the picture of the view; None where the object fills too little of the view, or
    too much of the edit would lie beside it. strict: times MIN_OBJECT_FRACTION and the share that lies on it."""
    extent = float(np.sqrt(rng.uniform(*PAINTED_SHARE) * view.masks[0].sum()))
    if view.masks[0].mean() < strict * MIN_OBJECT_FRACTION or extent < 2:
        return None
    pixels, depths = camera.project(point.position[None])
    (x, y), z = pixels[0].tolist(), float(depths[0])
    if kind == "recolor":
        radius, seed = 0.8 * extent * z / camera.fy, int(rng.integers(1 << 31))
        return EditDesign(kind, camera, Recoloring(point.position, radius, seed))
    canvas = Canvas(view.images.colors[0], (x, y), extent)
    layer = layer_on_object(kind, canvas, view.alphas[0], files, rng, strict)
    return None if layer is None else EditDesign(kind, camera, layer)


def view_of(
    point: SurfacePoint, framing: Framing, radius: float, optics: viewpoints.Optics, rng: np.random.Generator
) -> Camera:
    """A close-up of the point, or the whole object from its side."""
    if framing == "whole":
        return viewpoints.object_camera(radius, optics, *viewpoints.view_angles(point.normal, rng))
    return viewpoints.facing(point.position, point.normal, radius * rng.uniform(*WINDOW_RADII), optics, rng)


def views_beside(
    truth: GroundTruth,
    camera: Camera,
    position: np.ndarray,
    count: int,
    degrees: tuple[float, float],
    rng: np.random.Generator,
    *,
    nearest_degrees: float = 0.0,
    tries: int = DESIGN_TRIES,
    slack: float = BLOCKED_SLACK,
) -> list[Camera]:
    """`count` views of the point from other sides that see it, `degrees` (from, to) away from `camera` where that can
    be. nearest_degrees: what the second falls to, with every view that something stands in the way of."""
    cameras = []
    for _ in range(count):
        neighbour = camera
        for k in range(tries + 1):  # nearer and nearer to the view that sees it
            part = 1 - k / tries
            farthest = max(nearest_degrees + (degrees[1] - nearest_degrees) * part, 1.0)
            neighbour = viewpoints.neighbour(camera, position, rng, (degrees[0] * part, farthest))
            if not truth.blocks(neighbour.position, position, slack):
                break
        cameras.append(neighbour)
    return cameras


def apart(points: Sequence[SurfacePoint], distance: float) -> Callable[[SurfacePoint, np.ndarray], bool]:
    """A condition for `design_edit`: only points at least this far, world units, from all of these."""
    return lambda point, mask: all(np.linalg.norm(point.position - other.position) >= distance for other in points)


# Points with texture.


@dataclass(frozen=True)
class TexturedPoint:
    """A point on the surface that has texture around it."""

    position: np.ndarray
    """[3] world."""
    view: int
    """Index, among the pictures given, of one that sees it."""
    contrast: float
    """Mean step of luminance between neighbouring pixels around it, 0..1."""


def textured_points(views: GroundTruthViews, window: int, count: int, rng: np.random.Generator) -> list[TexturedPoint]:
    """`count` points, drawn among those with the highest local contrast: the mean over window x window pixels of the
    luminance's steps, edges of the object left out. They keep about a window's distance where that can be. Raises
    ValueError where no surface faces any view."""
    maps = [_contrast(views, k, window) for k in range(len(views.alphas))]
    contrast, filled = (np.stack(x) for x in zip(*maps, strict=True))
    for fraction in WINDOW_FRACTIONS:
        fit = (contrast >= 0) & (filled >= fraction)
        if fit.any():
            break
    else:
        raise ValueError("no part of its surface faces a view")
    floor = np.quantile(contrast[fit], 1 - BEST_CONTRAST_SHARE)
    candidates = np.argwhere(fit & (contrast >= floor))
    points = np.array([c.unproject(d) for c, d in zip(views.images.cameras, views.depths, strict=True)])
    chosen: list[TexturedPoint] = []
    for _ in range(count):
        positions = points[tuple(candidates.T)]
        gaps = [np.linalg.norm(positions - point.position, axis=1) for point in chosen]
        away = np.min(gaps, 0) if gaps else np.full(len(positions), np.inf)
        free = np.flatnonzero(away >= _extent(views, window))
        if not len(free):
            free = np.flatnonzero(away >= away.max())
        k, y, x = candidates[rng.choice(free)]
        chosen.append(TexturedPoint(points[k, y, x], int(k), float(contrast[k, y, x])))
    return chosen


def _contrast(views: GroundTruthViews, k: int, window: int) -> tuple[np.ndarray, np.ndarray]:
    """([H, W] contrast around each pixel, -1 where it cannot be a point; [H, W] part of its window that is object)."""
    camera, depth = views.images.cameras[k], views.depths[k].astype(np.float64)
    solid = views.alphas[k] > MIN_SOLID_ALPHA
    luma = views.images.colors[k].astype(np.float64) @ [0.2126, 0.7152, 0.0722]
    width = depth / camera.fx  # of a pixel on the surface
    steps, valid = np.zeros_like(luma), np.zeros_like(luma)
    for axis in (0, 1):
        step, jump = (np.abs(np.diff(x, axis=axis, prepend=np.take(x, [0], axis))) for x in (luma, depth))
        both = solid & np.roll(solid, 1, axis) & (jump < MAX_DEPTH_STEP_PX * np.maximum(width, 1e-9))
        steps += np.where(both, step, 0) / 2
        valid += both / 2
    inside = _summed(valid, window)
    contrast = _summed(steps, window) / np.maximum(inside, 1e-9)
    _, cosines = facing_normals(camera.unproject(depth), camera.position)
    around = solid & np.roll(solid, 1, 0) & np.roll(solid, -1, 0) & np.roll(solid, 1, 1) & np.roll(solid, -1, 1)
    fit = around & (cosines >= MIN_VIEW_COSINE) & (inside > 0.5)
    return np.where(fit, contrast, -1.0), _summed(views.masks[k], window) / window**2


def _summed(values: np.ndarray, window: int) -> np.ndarray:
    """[H, W] sums over the window x window pixels around each pixel, less at the picture's edges."""
    before, after = window // 2, window - window // 2 - 1
    total = np.pad(values.astype(np.float64), ((before + 1, after), (before + 1, after))).cumsum(0).cumsum(1)
    h, w = values.shape
    return (
        total[window : window + h, window : window + w]
        - total[:h, window : window + w]
        - total[window : window + h, :w]
        + total[:h, :w]
    )


def _extent(views: GroundTruthViews, window: int) -> float:
    """World units that a window shows, about."""
    depth, camera = views.depths[0], views.images.cameras[0]
    typical = float(np.median(depth[depth > 0])) if (depth > 0).any() else 0.0
    return window * typical / camera.fx
