"""Sheets: thin Gaussians on the surface under edited pixels, as many as the picture's own detail needs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.surface.visible import VisibleSurface
from splatpainter.transforms import matrix_to_quat

MAX_CELL_PX = 8
"""Edge of the largest cell of flat paint, pixels."""
FLAT_RANGE = 0.03
"""Colours within and around a cell that differ by less than this, 0..1, are one colour."""
FLAT_DEPTH_CELLS = 0.08
"""The surface may leave a cell's plane by this share of the cell's edge."""
WIDTH_CELLS = 0.5
"""Standard deviation of a sheet Gaussian, in edges of its cell: neighbours cover what lies between them."""
EDGE_CONTRAST = 0.15
"""Range of the colours around a pixel from which it lies on an edge of the picture, ..."""
EDGE_WIDTH = 0.7
"""... where its Gaussian is narrower by this factor."""
THICKNESS = 0.1
"""Of a sheet Gaussian over its width."""
SHEET_OPACITY = 0.95
MAX_STRETCH = 2.5
"""A sheet Gaussian is stretched along a slanted surface at most this much."""


@dataclass(frozen=True)
class Cells:
    """C square cells of a picture."""

    centers: np.ndarray = field(repr=False)
    """[C, 2] float64 x, y in pixels."""
    sizes: np.ndarray = field(repr=False)
    """[C] float64 edges, pixels."""


@dataclass(frozen=True)
class SheetGeometry:
    """C Gaussians on a surface, without colours."""

    means: np.ndarray = field(repr=False)
    """[C, 3] float64 world units."""
    quats: np.ndarray = field(repr=False)
    """[C, 4] float64."""
    scales: np.ndarray = field(repr=False)
    """[C, 3] float64 world units."""


def flat_cells(target: np.ndarray, covered: np.ndarray, depth: np.ndarray, fx: float) -> Cells:
    """Pixels of `covered` ([H, W] bool) in cells of 1, 2, 4 ... MAX_CELL_PX pixels: large ones where the picture
    (target [H, W, 3]) has one colour in them and around them and the inverse of the depth ([H, W], > 0 where covered)
    is linear, as it is on a plane."""
    height, width = covered.shape
    pad = [(0, -height % MAX_CELL_PX), (0, -width % MAX_CELL_PX)]
    left = np.pad(covered, pad)
    colors = np.pad(target, [*pad, (0, 0)], mode="edge").astype(np.float32)
    inverse = np.pad(np.where(covered, 1 / np.where(covered, depth, 1), 0), pad)
    solid = left.copy()
    centers, sizes = [], []
    size = MAX_CELL_PX
    while size > 1:
        half = size // 2
        low, high = _block(colors, half, np.min), _block(colors, half, np.max)
        span = (_around(high, np.maximum) - _around(low, np.minimum)).max(-1)
        full = _around(_block(solid, half, np.all)[..., None], np.minimum)[..., 0]
        unused = _block(left, size, np.all)
        flat = unused & full & (span < FLAT_RANGE) & _is_plane(inverse, size, fx)
        ys, xs = np.nonzero(flat)
        centers.append(np.stack([xs * size + half, ys * size + half], 1).astype(np.float64))
        sizes.append(np.full(len(ys), float(size)))
        left &= ~np.kron(flat, np.ones((size, size), bool))
        size = half
    ys, xs = np.nonzero(left)
    centers.append(np.stack([xs, ys], 1) + 0.5)
    sizes.append(np.ones(len(ys)))
    return Cells(np.concatenate(centers), np.concatenate(sizes))


def _block(values: np.ndarray, size: int, function) -> np.ndarray:
    """[H, W, ...] reduced over blocks of size x size."""
    height, width = values.shape[:2]
    return function(values.reshape(height // size, size, width // size, size, *values.shape[2:]), axis=(1, 3))


def _around(values: np.ndarray, combine) -> np.ndarray:
    """Of half-size blocks [2H, 2W, C]: each block of the full size with half a block around it, [H, W, C]."""
    padded = np.pad(values, [(1, 1), (1, 1), (0, 0)], mode="edge")
    height, width = values.shape[0] // 2, values.shape[1] // 2
    out = None
    for dy in range(4):
        for dx in range(4):
            part = padded[dy : dy + 2 * height : 2, dx : dx + 2 * width : 2]
            out = part if out is None else combine(out, part)
    assert out is not None
    return out


def _is_plane(inverse: np.ndarray, size: int, fx: float) -> np.ndarray:
    """[H / size, W / size] bool: 1 / depth over a cell differs from a plane by little (in cells, at its depth)."""
    height, width = inverse.shape
    blocks = inverse.reshape(height // size, size, width // size, size)
    corners = [blocks[:, a, :, b] for a in (0, -1) for b in (0, -1)]
    middle = blocks[:, size // 2 - 1 : size // 2 + 1, :, size // 2 - 1 : size // 2 + 1].mean((1, 3))
    bend = np.abs(np.stack(corners).mean(0) - middle) + np.abs(corners[0] + corners[3] - corners[1] - corners[2]) / 2
    # 1 / z bends by b where z bends by b z^2; a cell is size z / fx wide.
    return bend < FLAT_DEPTH_CELLS * size / fx * np.maximum(middle, 1e-30)


def sheet_geometry(surface: VisibleSurface, cells: Cells, target: np.ndarray) -> tuple[SheetGeometry, np.ndarray]:
    """(Gaussians on the surface under C cells that have one, [C] bool which those are). target: [H, W, 3]; those of
    single pixels are narrower where it has edges."""
    at = surface.at(cells.centers)
    valid = at.depth > 0
    xs, ys = cells.centers.astype(np.int64).T
    sharp = (cells.sizes == 1) & (_contrast(target)[ys, xs] > EDGE_CONTRAST)
    width = WIDTH_CELLS * cells.sizes * np.where(sharp, EDGE_WIDTH, 1)
    geometry = pixel_gaussians(surface.camera, cells.centers[valid], at.depth[valid], at.normals[valid], width[valid])
    return geometry, valid


def _contrast(target: np.ndarray) -> np.ndarray:
    """[H, W] range of the colours over the 3 x 3 pixels around each, largest channel."""
    padded = np.pad(target, ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = target.shape[:2]
    parts = [padded[dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3)]
    low, high = parts[0], parts[0]
    for part in parts[1:]:
        low, high = np.minimum(low, part), np.maximum(high, part)
    return (high - low).max(-1)


def pixel_gaussians(
    camera: Camera, pixels: np.ndarray, depth: np.ndarray, normals: np.ndarray, width_px: np.ndarray
) -> SheetGeometry:
    """Flat Gaussians in the planes with `normals` ([C, 3] camera space) whose projections are about round, `width_px`
    ([C], standard deviation) wide. pixels: [C, 2]; depth: [C] z."""
    rays = np.stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(pixels))], 1
    )
    lengths = np.linalg.norm(rays, axis=1)
    view = rays / lengths[:, None]
    # The axis that the slant shortens lies along the normal's part across the line of sight; the other across both.
    slant = normals - (normals * view).sum(1, keepdims=True) * view
    size = np.linalg.norm(slant, axis=1, keepdims=True)
    fallback = np.cross(view, np.where(np.abs(view[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    across = np.where(size > 1e-6, np.cross(normals, slant / np.maximum(size, 1e-12)), np.cross(normals, fallback))
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    along = np.cross(normals, across)
    facing = np.abs((normals * view).sum(1))
    rotation = np.einsum("ji,njk->nik", camera.world_to_camera[:3, :3], np.stack([across, along, normals], 2))
    flip = np.linalg.det(rotation) < 0
    rotation[flip, :, 0] *= -1
    width = width_px * depth / camera.fx
    scales = np.stack([width, width * np.minimum(1 / np.maximum(facing, 1e-3), MAX_STRETCH), width * THICKNESS], 1)
    return SheetGeometry(camera.unproject(depth, pixels), matrix_to_quat(rotation), scales)
