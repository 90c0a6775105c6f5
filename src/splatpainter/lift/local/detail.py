"""The detail layer: thin Gaussians on the painted surface, only where split ones cannot follow the picture.

Splitting alone needs a Gaussian per pixel *and layer* of a capture's fog for a sharp edge; once the fog has been
painted coarsely, thin Gaussians on the pixels that are wrong do the rest, and from other sides what they miss is
painted too. Each is as long as the picture has one colour along its edges there, and as wide as it has one across
them. Spawned on an unpainted surface the same Gaussians are crisp in the edited view and wrong elsewhere (docs/LOG.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.kernels import portable
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.lift.colors import recolor
from splatpainter.lift.depth_normals import VISIBLE_NORMALS, surface, surface_normals
from splatpainter.lift.masks import box_mean, dilated
from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.splats import MAX_MAGNITUDE, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import matrix_to_quat, principal_axes, turned


@dataclass(frozen=True)
class DetailThresholds:
    """Gaussians that carry detail finer than the asset's own. Measured where an entry says on what, else taste."""

    reaches_px: tuple[float, ...] = (0.4, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
    """Half lengths and half widths of what a detail Gaussian covers, pixels."""
    smallest_px: tuple[float] = (0.42,)
    """The same for pixels that are still wrong with those."""
    width: float = 0.75
    """Standard deviation of a detail Gaussian over that reach. Text and a stroke on a capture: 30.4 dB inside with
    0.75, 30.0 with 0.8, 29.6 with 0.9."""
    thickness: float = 0.15
    """Thickness / smaller width."""
    opacity: float = 0.9
    """Opaque enough to hide what is behind, and below the renderer's largest alpha."""
    offset_px: float = 0.25
    """Pixels by which detail lies before the surface: on a flat sheet, whose Gaussians all have the surface's own
    depth, it would be hidden behind them (17.7 instead of 29.1 dB there)."""
    one_color: float = 0.04
    """Colours that differ by less than this in every channel, 0..1, are one."""
    uniform_color_reaches: float = 1.7
    """Reaches of a detail Gaussian over which the picture has one colour, where the reach is not the smallest."""
    min_facing: float = 0.35
    """Cosine between line of sight and normal that a surface counts as having, at least: how far Gaussians stretch."""
    direction_px: int = 1
    """Pixels around each one whose gradients decide the direction of its edge."""


DETAIL = DetailThresholds()


@dataclass(frozen=True)
class DetailLayer:
    """Gaussians for some pixels."""

    splats: Splats
    parent_entries: np.ndarray
    """[A] entries of the view (0..M) that gave those pixels most of their colour."""


def detail_layer(
    splats: Splats,
    view: ProjectedView,
    pixels: Bools,
    target: np.ndarray,
    reaches: Sequence[float] = DETAIL.reaches_px,
) -> DetailLayer | None:
    """Gaussians that cover some pixels, of the target's colours and their parents' SH bands >= 1. pixels: [H, W] bool;
    target: [H, W, 3]; view: of `splats`; reaches: ascending, as DETAIL.reaches_px. None when no pixel has a surface."""
    camera = view.camera
    # Depth is smoothed over neighbours, so it is computed a little beyond the pixels.
    depth, host = surface(view, dilated(pixels, 2 * VISIBLE_NORMALS.smoothing_px))
    ys, xs = (np.ascontiguousarray(at) for at in np.nonzero(pixels & (depth > 0) & (host >= 0)))
    if not len(ys):
        return None
    direction = _edge_directions(target, ys, xs)
    picture, wide = readonly(target, np.float32), np.array(reaches, np.float64)
    other = np.ascontiguousarray(direction[:, ::-1] * (-1, 1))
    # How far the picture keeps its colour along and across its edge decides each Gaussian's size.
    along, across = np.empty((2, len(ys)))
    for way, size in ((direction, along), (other, across)):
        run(kernels.measure_reaches, picture, depth, ys, xs, way, wide, size)
    # A long Gaussian lies along the edge, never across it.
    across = np.minimum(across, along)
    # Largest first: they cover most pixels, and those that they cover need no Gaussian of their own.
    order = np.argsort(-along * across, kind="stable")
    chosen = np.zeros(len(ys), bool)
    kernels.choose_details(ys, xs, direction, along, across, order, np.zeros(pixels.shape, bool), chosen, 0, 1)
    ys, xs, direction, along, across = ys[chosen], xs[chosen], direction[chosen], along[chosen], across[chosen]
    # Geometry: ellipses in the surface, a little before it so that the painted fog does not hide them.
    z = depth[ys, xs].astype(np.float64)
    axes, scales = _axes(depth, ys, xs, direction, DETAIL.width * along, DETAIL.width * across, view)
    means = camera.unproject(z * (1 - DETAIL.offset_px / camera.fx), np.stack([xs, ys], 1) + 0.5)
    # A file cannot hold such numbers, and a picture that needs them shows nothing of use.
    if not max(np.abs(means).max(), scales.max()) <= MAX_MAGNITUDE:  # seen through a lens beyond all measure
        return None
    entries = host[ys, xs]
    parents = splats.take(view.gaussian_ids[entries])
    # Parents' higher bands come along: detail shines as what it lies on does.
    sh = recolor(parents.sh, view.unclamped_colors[entries], target[ys, xs], 1.0)
    dtype = splats.means.dtype
    layer = Splats(
        means.astype(dtype),
        matrix_to_quat(axes).astype(dtype),
        scales.astype(dtype),
        np.full(len(z), DETAIL.opacity, dtype),
        sh.astype(dtype),
        splats.antialiased,
        splats.color_space,
        parents.source,
        parents.origin,
        parents.offset,
    )
    return DetailLayer(layer, entries)


def _edge_directions(target: np.ndarray, ys: np.ndarray, xs: np.ndarray) -> Floats:
    """[A, 2] float64 unit x, y: along the edge at each pixel, where the picture varies least (structure tensor)."""
    height, width = target.shape[:2]
    # Only the window around the pixels: a stroke is small, a picture is not.
    margin = DETAIL.direction_px + 1
    top, left = max(int(ys.min()) - margin, 0), max(int(xs.min()) - margin, 0)
    bottom, right = min(int(ys.max()) + margin + 1, height), min(int(xs.max()) + margin + 1, width)
    window = np.pad(target[top:bottom, left:right], ((1, 1), (1, 1), (0, 0)), mode="edge").astype(np.float32)
    down, across = window[2:, 1:-1] - window[:-2, 1:-1], window[1:-1, 2:] - window[1:-1, :-2]
    products = np.stack([(a * b).sum(-1) for a, b in ((across, across), (down, down), (across, down))], 2)
    xx, yy, xy = box_mean(products, DETAIL.direction_px)[ys - top, xs - left].T
    # The tensor's larger axis crosses the edge; a quarter turn from it runs along.
    angle = 0.5 * portable.arctan2(2 * xy, xx - yy).astype(np.float64) + np.pi / 2
    return np.stack([portable.cos(angle), portable.sin(angle)], 1)


def _axes(
    depth: np.ndarray,
    ys: np.ndarray,
    xs: np.ndarray,
    direction: np.ndarray,
    along: np.ndarray,
    across: np.ndarray,
    view: ProjectedView,
) -> tuple[np.ndarray, np.ndarray]:
    """([A, 3, 3] world axes, [A, 3] standard deviations along them) of Gaussians in the surface whose projections are
    ellipses: direction: [A, 2] of the axis `along` [A]; across: [A]; both standard deviations in pixels."""
    camera = view.camera
    normal = surface_normals(depth, ys, xs, camera)
    # Near the horizon a slope would be unbounded; min_facing bounds how long a Gaussian gets.
    facing = np.where(
        normal[:, 2] < 0, np.minimum(normal[:, 2], -DETAIL.min_facing), np.maximum(normal[:, 2], DETAIL.min_facing)
    )
    slope = -normal[:, :2] / facing[:, None]  # of depth, by x and y on the surface
    other = direction[:, ::-1] * (-1, 1)
    unit = (depth[ys, xs] / camera.fx).astype(np.float64)
    ends = []
    for way, size in ((direction, along * unit), (other, across * unit)):
        ends.append(size[:, None] * np.concatenate([way, (way * slope).sum(1, keepdims=True)], 1))
    # The two ends are conjugate half-axes in the surface's plane, not yet at right angles: principal axes follow below.
    flat = np.cross(*ends)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    ends.append((DETAIL.thickness * np.minimum(along, across) * unit)[:, None] * flat)
    conjugate = np.stack(ends, 2)
    squares, axes = principal_axes(portable.matmul(conjugate, conjugate.transpose(0, 2, 1)))
    return turned(camera.world_to_camera[:3, :3].T, axes), np.sqrt(np.maximum(squares, 1e-30))
