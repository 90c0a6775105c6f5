"""What the local network reads (models/local_network.py): patches of an edited picture, and the Gaussians that the
lift has laid out for the edit, which ask what colour they are.

    for region in picture_regions(asset, lifted, view):
        region.tokens, region.readers, lifted.ids[region.index]

The picture is cut into tiles of TILE x TILE patches, each an edit of its own: as much as a small memory holds without
blurring it. Patches and Gaussians are told of by their cell in the tile and the ring of patches around it.
numpy, no torch. T patches, R Gaussians, J = len(lifted.ids).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import field
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.color import base_color
from splatpainter.lift.features import HALF_SEEN_PX
from splatpainter.lift.local.split import projected_sizes
from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import quat_to_matrix

if TYPE_CHECKING:
    from splatpainter.lift.edit_views import EditView
    from splatpainter.lift.edits import LiftedEdit
    from splatpainter.splats import Splats

PATCH_PX = 4
"""Pixels per edge of a patch."""
BANDS = PATCH_PX**2
"""Cosines of a patch and channel, and pixels that they stand for."""
TILE = 6
"""Patches per edge of a tile."""
RING_TILE = TILE + 2
"""The same with the ring around it, whose patches say what stays and how the edit goes on."""
SLOTS = RING_TILE**2
"""Cells of a tile and its ring."""
MIN_SOLID_SHARE = 0.2
"""Share of a patch that shows the asset, from which it has a place."""
SOLID_ALPHA = 0.5
MAX_DEPTH_PX = 8.0
"""Distances before and behind the shown surface are told up to this many pixels."""
HELD_CHANNELS = 4 * BANDS
"""The first channels of a token: cosines of the picture, [BANDS, 3], and of the edit's mask."""
TOKEN_CHANNELS = HELD_CHANNELS + 3 * BANDS + 1
"""Beside these the cosines of the render before the edit, and how much of the patch shows the asset."""
READER_CHANNELS = 20
"""Numbers per Gaussian: `_facts`."""
BEHIND_FEATURE, PEAK_FEATURE, BESIDE_FEATURE, APPENDED_FEATURE = 10, 15, READER_CHANNELS - 2, READER_CHANNELS - 1
"""Which of them say how far behind the surface a Gaussian lies, the most that it makes of an edited pixel, that the
picture does not show its place, and that the lift has appended it."""


@dataclass(frozen=True)
class PatchTokens:
    """Patches of a region, float32."""

    cells: np.ndarray = field(repr=False)
    """[T] int64 below SLOTS, row by row."""
    values: np.ndarray = field(repr=False)
    """[T, TOKEN_CHANNELS] of order 1."""


@dataclass(frozen=True)
class PatchReaders:
    """Gaussians of a region, float32."""

    cells: np.ndarray = field(repr=False)
    """[R] int64 of the patch over each, below SLOTS."""
    inside: np.ndarray = field(repr=False)
    """[R, 2] place in that patch, right and down, -0.5..0.5."""
    facts: np.ndarray = field(repr=False)
    """[R, READER_CHANNELS]."""
    before: np.ndarray = field(repr=False)
    """[R, 3] base colour 0..1 of the asset's Gaussian that each is or comes from."""

    def take(self, ids: np.ndarray) -> PatchReaders:
        """Some of them. ids: [K] int64."""
        return PatchReaders(self.cells[ids], self.inside[ids], self.facts[ids], self.before[ids])


@dataclass(frozen=True)
class PictureRegion:
    """Part of an edited view that the network looks at alone."""

    tokens: PatchTokens
    readers: PatchReaders
    index: np.ndarray = field(repr=False)
    """[R] int64 which of lifted.ids they are."""


def picture_regions(asset: Splats, lifted: LiftedEdit, view: EditView) -> Iterator[PictureRegion]:
    """Regions of a view, whose readers together are the J Gaussians of a lifted edit, each at most once: a tile without
    a patch that shows the asset has none. asset: before the edit, numpy. Raises ValueError for a view without depth and
    alpha."""
    if view.depth is None or view.alpha is None:
        raise ValueError(f"{view.name}: expected a view with depth and alpha, which the network reads")
    patches = _Patches.of(view)
    if not patches.used.any():
        return
    splats = lifted.splats
    means = splats.means[lifted.ids].astype(np.float64)
    # Behind the camera pixels mean nothing, and infinite ones would spoil the cells.
    pixels, depths = view.camera.project(means)
    ahead = depths > 1e-6
    pixels = np.where(ahead[:, None] & np.isfinite(pixels), pixels, 0.0)
    cells = np.floor(pixels / PATCH_PX)
    before = np.clip(base_color(asset.sh[lifted.parents]), 0, 1).astype(np.float32)
    facts = _facts(splats, lifted.ids, len(asset), view, pixels, depths, before)
    inside = (pixels / PATCH_PX - cells - 0.5).astype(np.float32)
    low, high = patches.box()
    # What lies beside the box asks the nearest of its patches.
    cells = np.clip(cells, low, np.subtract(high, 1)).astype(np.int64)
    tiles = (cells - low) // TILE
    for corner in np.unique(tiles, axis=0):
        index = np.flatnonzero((tiles == corner).all(1))
        left, top = (corner * TILE + low - 1).tolist()
        tokens = patches.tokens(top, left)
        if tokens is None:
            continue
        inner = cells[index] - (left, top)
        readers = PatchReaders(inner[:, 1] * RING_TILE + inner[:, 0], inside[index], facts[index], before[index])
        yield PictureRegion(tokens, readers, index)


def cosine_basis(inside: np.ndarray) -> np.ndarray:
    """[R, BANDS] the orthonormal cosines of a patch at places [R, 2] in it, -0.5..0.5: what its coefficients
    (`cosines`) are multiplied with to read a pixel there (the DCT of type II)."""
    k = np.arange(PATCH_PX)
    size = np.where(k == 0, np.sqrt(1 / PATCH_PX), np.sqrt(2 / PATCH_PX))
    right, down = (size * np.cos(np.pi * k * (inside[:, axis, None] + 0.5)) for axis in (0, 1))
    return (down[:, :, None] * right[:, None, :]).reshape(len(inside), BANDS).astype(np.float32)


def cosines(patches: np.ndarray) -> np.ndarray:
    """[T, BANDS, C] coefficients of patches [T, PATCH_PX, PATCH_PX, C]."""
    y, x = np.divmod(np.arange(BANDS), PATCH_PX)
    centers = (np.stack([x, y], 1) + 0.5) / PATCH_PX - 0.5
    return np.einsum("pk,tpc->tkc", cosine_basis(centers), patches.reshape(len(patches), BANDS, -1))


@dataclass(frozen=True)
class _Patches:
    """All patches of a view, on its grid of [GH, GW]."""

    used: np.ndarray
    """[GH, GW] bool: edited, or beside such a one, and with a place."""
    pictures: np.ndarray
    """[GH, GW, P, P, 7] target, before, mask."""
    solid: np.ndarray
    """[GH, GW] share of pixels that show the asset."""

    @staticmethod
    def of(view: EditView) -> _Patches:
        assert view.depth is not None and view.alpha is not None
        height, width = view.mask.shape
        pad = ((0, -height % PATCH_PX), (0, -width % PATCH_PX))
        planes = np.concatenate([view.target, view.before, view.mask[..., None]], 2, dtype=np.float32)
        # The edge is repeated: black beyond it would look like an edge of the picture.
        pictures = _cut(np.pad(planes, (*pad, (0, 0)), mode="edge"))
        # What is beyond the picture is not edited and shows nothing.
        edited = _cut(np.pad(view.mask, pad)[..., None])[..., 0].mean((2, 3))
        visible = _cut(np.pad((view.alpha > SOLID_ALPHA) & (view.depth > 0), pad)[..., None])[..., 0]
        solid = visible.mean((2, 3))
        # The ring around the edit says what stays as it was.
        grown = np.pad(edited > 0, 1)
        near = np.zeros(edited.shape, bool)
        for dy in range(3):
            for dx in range(3):
                near |= grown[dy : dy + edited.shape[0], dx : dx + edited.shape[1]]
        used = near & (solid > MIN_SOLID_SHARE)
        return _Patches(used, pictures, solid)

    def box(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """First and last + 1 (x, y) of the used patches."""
        lines, columns = (np.flatnonzero(self.used.any(axis)) for axis in (1, 0))
        return (int(columns[0]), int(lines[0])), (int(columns[-1]) + 1, int(lines[-1]) + 1)

    def tokens(self, top: int, left: int) -> PatchTokens | None:
        """The used patches among the RING_TILE x RING_TILE from there on, which may be beside the picture; None where
        there is no such patch."""
        height, width = self.used.shape
        y, x = np.divmod(np.arange(SLOTS), RING_TILE) + np.array([[top], [left]])
        there = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        there[there] = self.used[y[there], x[there]]
        if not there.any():
            return None
        planes, solid = self.pictures[y[there], x[there]], self.solid[y[there], x[there]]
        target, before = (0.5 * cosines(planes[..., part] - 0.5) for part in (slice(0, 3), slice(3, 6)))
        mask, count = 0.25 * cosines(planes[..., 6:]), len(planes)
        values = [target.reshape(count, -1), mask[..., 0], before.reshape(count, -1), 2 * solid[:, None] - 1]
        return PatchTokens(np.flatnonzero(there), np.concatenate(values, 1, dtype=np.float32))


def _cut(picture: np.ndarray) -> np.ndarray:
    """[GH, GW, P, P, C] patches of a picture [H, W, C] of whole ones."""
    height, width, channels = picture.shape
    blocks = picture.reshape(height // PATCH_PX, PATCH_PX, width // PATCH_PX, PATCH_PX, channels)
    return blocks.transpose(0, 2, 1, 3, 4)


def _facts(
    splats: Splats,
    ids: np.ndarray,
    originals: int,
    view: EditView,
    pixels: np.ndarray,
    depths: np.ndarray,
    before: np.ndarray,
) -> np.ndarray:
    """[J, READER_CHANNELS] what is known of Gaussians beside their place; nothing that the lift says of colours.
    pixels: [J, 2] and depths: [J] in the view; before: [J, 3]."""
    assert view.depth is not None and view.alpha is not None
    camera, count = view.camera, len(ids)
    height, width = view.mask.shape
    x = np.clip(pixels[:, 0], 0, width - 1).astype(np.int64)
    y = np.clip(pixels[:, 1], 0, height - 1).astype(np.int64)
    beside = ((pixels < 0) | (pixels >= (width, height))).any(1) | (depths <= 1e-6)
    surface_depth, alpha = view.depth[y, x], view.alpha[y, x]
    pixel = np.maximum(depths, 1e-6) / camera.fy
    # In pixels, so that it means the same for near and far, small and large assets.
    behind = np.where(alpha > SOLID_ALPHA, np.clip((depths - surface_depth) / pixel, -MAX_DEPTH_PX, MAX_DEPTH_PX), 0)
    # Size and facing as the camera sees them, so that a turned asset gives the same numbers.
    part = splats.take(ids)
    sizes = np.sort(np.clip(projected_sizes(part, camera), 1e-3, 1e3), 1)[:, ::-1]
    axes = quat_to_matrix(np.ascontiguousarray(part.quats))
    normals = axes[np.arange(count), :, part.scales.argmin(1)]
    towards = camera.position - part.means
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    facing = (normals * towards).sum(1)
    local = np.where(facing[:, None] < 0, -normals, normals) @ camera.world_to_camera[:3, :3].T
    # Only under the mask: Gaussians elsewhere are not asked.
    projected = project(splats, camera, tiles=tiles_of_mask(view.mask))
    sums = projected.backproject(np.zeros_like(view.before), view.mask.astype(np.float32))
    weight, peak, visible = (np.zeros(len(splats), np.float32) for _ in range(3))
    weight[projected.gaussian_ids], peak[projected.gaussian_ids] = sums.weight, sums.peak
    visible[projected.gaussian_ids] = sums.weight / np.maximum(sums.alpha, 1e-6)
    seen = weight[ids] / (weight[ids] + HALF_SEEN_PX)
    columns = [
        2 * before - 1,
        np.log2(sizes) / 2,
        2 * part.opacities[:, None] - 1,
        local,
        (behind / MAX_DEPTH_PX)[:, None],
        np.where(beside, 0, view.mask[y, x])[:, None],
        np.where(beside, 0, _mean_around(view.mask)[y, x])[:, None],
        np.where(beside, 0, alpha)[:, None],
        2 * seen[:, None] - 1,
        2 * peak[ids, None] - 1,
        2 * visible[ids, None] - 1,
        np.abs(facing)[:, None],
        beside[:, None],
        (ids >= originals)[:, None],
    ]
    return np.concatenate(columns, 1, dtype=np.float32)


def _mean_around(mask: np.ndarray) -> np.ndarray:
    """[H, W] share of the 3 x 3 pixels around each that are of the mask."""
    height, width = mask.shape
    padded = np.pad(mask.astype(np.float32), 1, mode="edge")
    return np.mean([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)
