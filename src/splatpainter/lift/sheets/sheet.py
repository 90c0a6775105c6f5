"""Sheets: thin Gaussians on the surface under edited pixels, as many as the picture's own detail needs."""

from __future__ import annotations

import functools
from dataclasses import field

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.cameras import Camera
from splatpainter.kernels.arrays import readonly, set_pixels
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.lift.sheets.fringe import FringedSurface
from splatpainter.surface.visible import PixelSurface, VisibleSurface
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_norm


@dataclass(frozen=True)
class SheetThresholds:
    """Cells of a sheet and the Gaussians in them. Measured where an entry says so, else taste."""

    max_cell_px: int = 8
    """Edge of the largest cell of flat paint, pixels."""
    flat_range: float = 0.03
    """Colours within and around a cell that differ by less than this, 0..1, are one colour."""
    flat_depth_cells: float = 0.08
    """The surface may leave a cell's plane by this share of the cell's edge."""
    pixel_width: float = 0.55
    """Standard deviation of a sheet Gaussian of one pixel, in edges of its cell; the renderer widens it by half a
    pixel."""
    cell_width: float = 0.65
    """The same of larger cells: four Gaussians stop 95 % of the light at the corner between them."""
    edge_contrast: float = 0.15
    """Range of the colours around a pixel, 0..1, from which it lies on an edge of the picture."""
    edge_width: float = 0.6
    """Factor by which the Gaussian of such a pixel is narrower."""
    thickness_ratio: float = 0.1
    """Thickness of a sheet Gaussian over its width."""
    opacity: float = 0.97
    """Opaque enough to hide what was there, and below the renderer's largest alpha."""
    max_stretch: float = 2.0
    """A sheet Gaussian is stretched along a slanted surface at most this much."""
    max_gaussians_per_cell: int = 4
    """Where the surface is steeper, up to so many Gaussians share the cell, one behind the other."""
    max_length_apart: float = 1.2
    """Length of the surface under a cell over its distance to that under the next one along the slant, at most."""
    max_open_stretch: float = 2.0
    """Stretch beside a place without a surface, at most."""


SHEET = SheetThresholds()


@dataclass(frozen=True)
class Cells:
    """C square cells of a picture."""

    centers: Floats = field(repr=False)
    """[C, 2] float64 x, y in pixels."""
    sizes: Floats = field(repr=False)
    """[C] float64 edges, pixels."""


@dataclass(frozen=True)
class SheetGeometry:
    """C Gaussians on a surface, without colours."""

    means: Floats = field(repr=False)
    """[C, 3] float64 world units."""
    quats: Floats = field(repr=False)
    """[C, 4] float64."""
    scales: Floats = field(repr=False)
    """[C, 3] float64 world units."""


def flat_cells(target: np.ndarray, covered: np.ndarray, depth: np.ndarray, fx: float) -> Cells:
    """Pixels of `covered` ([H, W] bool) in cells of 1, 2, 4 ... SHEET.max_cell_px pixels: large ones where the picture
    (target [H, W, 3]) has one colour in them and around them and the inverse of the depth ([H, W], > 0 where covered)
    is linear, as it is on a plane."""
    rows, columns = np.flatnonzero(covered.any(1)), np.flatnonzero(covered.any(0))
    top, x_first = (int(lines[0]) // SHEET.max_cell_px * SHEET.max_cell_px for lines in (rows, columns))
    window = (slice(top, int(rows[-1]) + 1), slice(x_first, int(columns[-1]) + 1))
    cells = _cells_of_window(target[window], covered[window], depth[window], fx)
    return Cells(cells.centers + (x_first, top), cells.sizes)


def _cells_of_window(target: np.ndarray, covered: np.ndarray, depth: np.ndarray, fx: float) -> Cells:
    edges = np.zeros(covered.shape, np.uint8)
    inputs = (readonly(target, np.float32), readonly(covered, np.bool_), readonly(depth, np.float64))
    run(kernels.choose_cells, *inputs, SHEET.flat_range, SHEET.flat_depth_cells, fx, edges)
    # The largest first, as their Gaussians have always been listed.
    sizes = [SHEET.max_cell_px >> k for k in range(SHEET.max_cell_px.bit_length())]
    firsts = [set_pixels(edges == size) for size in sizes]
    centers = [np.stack([xs, ys], 1) + size / 2 for size, (ys, xs) in zip(sizes, firsts, strict=True)]
    return Cells(np.concatenate(centers), np.repeat(np.array(sizes, np.float64), [len(ys) for ys, _ in firsts]))


def sheet_geometry(
    surface: VisibleSurface | FringedSurface, cells: Cells, target: np.ndarray
) -> tuple[SheetGeometry, np.ndarray]:
    """(G Gaussians on the surface under C cells, [G] int64 the cell of each; cells without a surface have none).
    target: [H, W, 3]; Gaussians of single pixels are narrower where it has edges."""
    at = surface.at(cells.centers)
    xs, ys = cells.centers.astype(np.int64).T
    single = cells.sizes == 1
    # Narrower at edges of the picture, which the renderer's own blur would soften.
    sharp = single & (_contrast(target, ys, xs) > SHEET.edge_contrast)
    width = cells.sizes * np.where(single, SHEET.pixel_width, SHEET.cell_width) * np.where(sharp, SHEET.edge_width, 1)
    chosen = np.flatnonzero(at.depth > 0)
    stretch = _stretch(surface, cells, at, chosen)
    # On steep surfaces several share a cell, one behind the other: one alone would be too long to bend.
    count = np.clip(np.ceil(stretch / SHEET.max_stretch), 1, SHEET.max_gaussians_per_cell).astype(np.int64)
    source = np.repeat(np.arange(len(chosen)), count)
    step = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
    shift = (step + 0.5) / count[source] - 0.5
    index = chosen[source]
    # Each of several is moved along the slant by its part of the cell.
    geometry = pixel_gaussians(
        surface.camera,
        cells.centers[index],
        at.depth[index],
        at.normals[index],
        width[index],
        cells.sizes[index],
        np.minimum(stretch, SHEET.max_stretch * count)[source],
        count[source],
        shift,
    )
    return geometry, index


def _stretch(
    surface: VisibleSurface | FringedSurface, cells: Cells, at: PixelSurface, chosen: np.ndarray
) -> np.ndarray:
    """[G] >= 1 how much longer than its projection the surface is under each chosen cell, along its slant: by its
    normal, but no farther than its neighbours on both sides along the slant are apart, as a round surface turns away
    from its tangent plane; next to where there is no surface, hardly."""
    camera, centers, sizes = surface.camera, cells.centers[chosen], cells.sizes[chosen]
    points = camera.to_camera(camera.unproject(at.depth[chosen], centers))
    facing = -(points * at.normals[chosen]).sum(1) / np.maximum(row_norm(points), 1e-30)
    # By its normal alone a plane seen edge-on would be endless.
    length = 1 / np.maximum(facing, 1e-3)
    across = at.normals[chosen, :2]
    way = across / np.maximum(row_norm(across)[:, None], 1e-12) * sizes[:, None]
    unit = sizes * at.depth[chosen] / camera.fx
    limits = []
    for sign in (-1, 1):
        pixels = centers + sign * way
        # The neighbours along the slant say how far the surface really goes on.
        beside = surface.at(pixels)
        apart = row_norm(camera.to_camera(camera.unproject(beside.depth, pixels)) - points)
        limits.append(np.where(beside.depth > 0, SHEET.max_length_apart * apart / unit, SHEET.max_open_stretch))
    return np.clip(np.minimum(length, np.minimum(*limits)), 1, None)


def _contrast(target: np.ndarray, ys: np.ndarray, xs: np.ndarray) -> np.ndarray:
    """[C] range of the colours over the 3 x 3 pixels around each of some pixels, largest channel."""
    if not len(ys):
        return np.zeros(0, target.dtype)
    height, width = target.shape[:2]
    top, left = max(int(ys.min()) - 1, 0), max(int(xs.min()) - 1, 0)
    window = target[top : min(int(ys.max()) + 2, height), left : min(int(xs.max()) + 2, width)]
    padded = np.pad(window, ((1, 1), (1, 1), (0, 0)), mode="edge")
    low, high = padded, padded
    for axis in (0, 1):  # the range over a square is that over columns of the ranges over rows
        parts = [[slice(None)] * axis + [slice(k, -2 + k or None)] for k in range(3)]
        low = functools.reduce(np.minimum, [low[tuple(part)] for part in parts])
        high = functools.reduce(np.maximum, [high[tuple(part)] for part in parts])
    span = (high - low)[ys - top, xs - left]
    return np.maximum(np.maximum(span[:, 0], span[:, 1]), span[:, 2])


def pixel_gaussians(
    camera: Camera,
    pixels: np.ndarray,
    depth: np.ndarray,
    normals: np.ndarray,
    width_px: np.ndarray,
    cell_px: np.ndarray,
    stretch: np.ndarray,
    count: np.ndarray,
    shift: np.ndarray,
) -> SheetGeometry:
    """Flat Gaussians in the planes with `normals` ([G, 3] camera space) whose projections are about round, `width_px`
    ([G], standard deviation) wide and `stretch` [G] times as long on the surface, or shorter where `count` [G] of them
    share a cell of edge `cell_px` [G], each moved by `shift` [G] (-0.5..0.5) of the cell along the slant. pixels:
    [G, 2]; depth: [G] z."""
    geometry = SheetGeometry(*(np.empty((len(pixels), columns)) for columns in (3, 4, 3)))
    layout = np.stack([width_px, cell_px, stretch, count, shift], 1, dtype=np.float64)
    lines = [readonly(values, np.float64) for values in (camera.sight_lines(pixels), depth, normals)]
    lens = (readonly(camera.world_to_camera, np.float64), camera.fx)
    out = (geometry.means, geometry.quats, geometry.scales)
    run(kernels.lay_gaussians, *lines, layout, *lens, SHEET.thickness_ratio, *out)
    return geometry
