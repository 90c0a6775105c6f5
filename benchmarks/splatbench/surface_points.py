"""Where on an object there is texture worth a closer look, found in pictures of it. Knows no protocol."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from splatbench.ground_truth import Shown, places

STEEPEST = 0.45
"""Least cosine between surface and line of sight."""
FILLED = (0.6, 0.4, 0.2, 0.0)
"""Least part of a spot's window that is object: the first of these that leaves any spot."""
BEST = 0.1
"""Share of all pixels that could be spots, those with the highest contrast, from which spots are drawn."""
JUMP = 4.0
"""Steps of depth between neighbours above this many pixel widths are edges of the object, not texture."""


@dataclass(frozen=True)
class Spot:
    """A place on the surface."""

    place: np.ndarray = field(repr=False)
    """[3] world."""
    view: int
    """Of the pictures given: one that sees it."""
    contrast: float
    """Mean step of luminance between neighbouring pixels around it, 0..1."""


def textured(shown: Shown, window: int, count: int, rng: np.random.Generator) -> list[Spot]:
    """`count` spots, drawn among those with the highest local contrast: the mean over window x window pixels of the
    luminance's steps, edges of the object left out. Spots keep about a window's distance where that can be. Raises
    ValueError where no surface faces any view."""
    maps = [_contrast(shown, k, window) for k in range(len(shown.alphas))]
    contrast, filled = (np.stack(x) for x in zip(*maps, strict=True))
    for least in FILLED:
        fit = (contrast >= 0) & (filled >= least)
        if fit.any():
            break
    else:
        raise ValueError("no part of its surface faces a view")
    floor = np.quantile(contrast[fit], 1 - BEST)
    candidates = np.argwhere(fit & (contrast >= floor))
    points = np.array([places(c, d) for c, d in zip(shown.pictures.cameras, shown.depths, strict=True)])
    found: list[Spot] = []
    for _ in range(count):
        where = points[tuple(candidates.T)]
        gaps = [np.linalg.norm(where - spot.place, axis=1) for spot in found]
        away = np.min(gaps, 0) if gaps else np.full(len(where), np.inf)
        free = np.flatnonzero(away >= _extent(shown, window))
        if not len(free):
            free = np.flatnonzero(away >= away.max())
        k, y, x = candidates[rng.choice(free)]
        found.append(Spot(points[k, y, x], int(k), float(contrast[k, y, x])))
    return found


def _contrast(shown: Shown, k: int, window: int) -> tuple[np.ndarray, np.ndarray]:
    """([H, W] contrast around each pixel, -1 where it cannot be a spot; [H, W] part of its window that is object)."""
    camera, depth = shown.pictures.cameras[k], shown.depths[k].astype(np.float64)
    solid = shown.alphas[k] > 0.99
    luma = shown.pictures.colors[k].astype(np.float64) @ [0.2126, 0.7152, 0.0722]
    width = depth / camera.fx  # of a pixel on the surface
    steps, sound = np.zeros_like(luma), np.zeros_like(luma)
    for axis in (0, 1):
        step, jump = (np.abs(np.diff(x, axis=axis, prepend=np.take(x, [0], axis))) for x in (luma, depth))
        both = solid & np.roll(solid, 1, axis) & (jump < JUMP * np.maximum(width, 1e-9))
        steps += np.where(both, step, 0) / 2
        sound += both / 2
    inside = _summed(sound, window)
    contrast = _summed(steps, window) / np.maximum(inside, 1e-9)
    fit = solid & (_cosines(places(camera, depth), camera.position, solid) >= STEEPEST) & (inside > 0.5)
    return np.where(fit, contrast, -1.0), _summed(shown.masks[k], window) / window**2


def _cosines(points: np.ndarray, eye: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """[H, W] cosine of the angle at which the surface through the points [H, W, 3] is seen; 0 at the rim."""
    down, right = np.gradient(points, axis=(0, 1))
    normal, line = np.cross(down, right), eye - points
    length = np.linalg.norm(normal, axis=-1) * np.linalg.norm(line, axis=-1)
    cosine = np.abs((normal * line).sum(-1)) / np.maximum(length, 1e-30)
    around = solid & np.roll(solid, 1, 0) & np.roll(solid, -1, 0) & np.roll(solid, 1, 1) & np.roll(solid, -1, 1)
    return np.where(around, cosine, 0)


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


def _extent(shown: Shown, window: int) -> float:
    """World units that a window shows, about."""
    depth, camera = shown.depths[0], shown.pictures.cameras[0]
    typical = float(np.median(depth[depth > 0])) if (depth > 0).any() else 0.0
    return window * typical / camera.fx
