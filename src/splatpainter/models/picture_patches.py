"""What the local network reads (models/local_network.py): patches of an edited picture at their places on the surface,
and the Gaussians that the lift has laid out for the edit, which ask what colour they are.

    for region in picture_regions(asset, lifted, view):
        region.tokens, region.readers, lifted.ids[region.index]

Patches and Gaussians are told of in one frame, that of the box around the patches' surface points. A picture with more
than MAX_TOKENS patches is cut into regions, each an edit with a frame of its own. numpy, no torch.
T patches, R Gaussians, J = len(lifted.ids).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.color import base_color
from splatpainter.lift.features import HALF_SEEN_PX
from splatpainter.lift.local.split import projected_sizes
from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask
from splatpainter.transforms import quat_to_matrix

if TYPE_CHECKING:
    from splatpainter.cameras import Camera
    from splatpainter.lift.edit_views import EditView
    from splatpainter.lift.edits import LiftedEdit
    from splatpainter.splats import Splats

PATCH_PX = 4
"""Pixels per edge of a patch."""
BANDS = PATCH_PX**2
"""Cosines of a patch and channel, and pixels that they stand for."""
MAX_TOKENS = 1024
"""Patches of one region."""
FINEST_PX = 2.0 * PATCH_PX
"""Shortest wavelength that positions are told with: between patches there is no shorter one."""
MIN_SOLID_SHARE = 0.2
"""Share of a patch that shows the asset, from which it has a place."""
SOLID_ALPHA = 0.5
MAX_DEPTH_PX = 8.0
"""Distances before and behind the shown surface are told up to this many pixels."""
TOKEN_CHANNELS = 2 * 3 * BANDS + BANDS + 1
"""Cosines of the picture and of the render before it, what was edited, and how much of it shows the asset."""
READER_CHANNELS = 20
"""Numbers per Gaussian: `_facts`."""
BEHIND_FEATURE, PEAK_FEATURE, BESIDE_FEATURE, APPENDED_FEATURE = 10, 15, READER_CHANNELS - 2, READER_CHANNELS - 1
"""Which of them say how far behind the surface a Gaussian lies, the most that it makes of an edited pixel, that the
picture does not show its place, and that the lift has appended it."""


@dataclass(frozen=True)
class PatchTokens:
    """Patches of a region, float32."""

    positions: np.ndarray = field(repr=False)
    """[T, 3] of their middles on the surface, in the region's frame, -1..1."""
    values: np.ndarray = field(repr=False)
    """[T, TOKEN_CHANNELS] of order 1."""
    weights: np.ndarray = field(repr=False)
    """[T] share of edited pixels, 0..1; those beside the edit say what stays."""


@dataclass(frozen=True)
class PatchReaders:
    """Gaussians of a region, float32."""

    positions: np.ndarray = field(repr=False)
    """[R, 3] of the patch over each, in the region's frame; of those that are far before or behind the surface, and
    where there is no patch, where its middle would be at their depth."""
    inside: np.ndarray = field(repr=False)
    """[R, 2] place in that patch, right and down, -0.5..0.5."""
    facts: np.ndarray = field(repr=False)
    """[R, READER_CHANNELS]."""
    before: np.ndarray = field(repr=False)
    """[R, 3] base colour 0..1 of the asset's Gaussian that each is or comes from."""

    def take(self, ids: np.ndarray) -> PatchReaders:
        """Some of them. ids: [K] int64."""
        return PatchReaders(self.positions[ids], self.inside[ids], self.facts[ids], self.before[ids])


@dataclass(frozen=True)
class PictureRegion:
    """Part of an edited view that the network looks at alone."""

    tokens: PatchTokens
    readers: PatchReaders
    index: np.ndarray = field(repr=False)
    """[R] int64 which of lifted.ids they are."""
    finest: float
    """FINEST_PX in the region's frame."""


def picture_regions(asset: Splats, lifted: LiftedEdit, view: EditView) -> Iterator[PictureRegion]:
    """Regions of a view, whose readers together are the J Gaussians of a lifted edit, each once. asset: before the
    edit, numpy. Raises ValueError for a view without depth and alpha; yields nothing where the picture has no patch
    with a place."""
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
    # The middle of the patch at the Gaussian's own depth: the words in which the patch under it tells its place.
    middles = view.camera.unproject(np.maximum(depths, 1e-6), (cells + 0.5) * PATCH_PX)
    for box in patches.regions():
        # Every Gaussian belongs to one region, so that of two answers none has to win.
        index = np.flatnonzero(box.holds(cells, patches.used.shape))
        frame, tokens = patches.tokens(box)
        positions = np.clip((middles[index] - frame.center) / frame.half_extent, -2, 2).astype(np.float32)
        # Those near the surface that the picture shows ask for the patch over them by its own name.
        number = patches.numbers(box)[
            np.clip(cells[index, 1], 0, len(patches.used) - 1).astype(np.int64),
            np.clip(cells[index, 0], 0, patches.used.shape[1] - 1).astype(np.int64),
        ]
        over = (number >= 0) & (np.abs(facts[index, BEHIND_FEATURE]) < 1) & (facts[index, BESIDE_FEATURE] == 0)
        positions[over] = tokens.positions[number[over]]
        yield PictureRegion(
            tokens,
            PatchReaders(positions, inside[index], facts[index], before[index]),
            index,
            frame.finest,
        )


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
class _Frame:
    center: np.ndarray
    half_extent: float
    finest: float


@dataclass(frozen=True)
class _Box:
    """Patches of rows top to bottom and columns left to right, without the last ones."""

    top: int
    left: int
    bottom: int
    right: int
    outer: tuple[int, int, int, int]
    """The box of all regions: what lies beside it belongs to the nearest of them."""

    def holds(self, cells: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """[R] bool of cells [R, 2] (x, y)."""
        top, left, bottom, right = self.outer
        x, y = np.clip(cells[:, 0], left, right - 1), np.clip(cells[:, 1], top, bottom - 1)
        return (x >= self.left) & (x < self.right) & (y >= self.top) & (y < self.bottom)

    def halves(self) -> tuple[_Box, _Box]:
        if self.bottom - self.top >= self.right - self.left:
            middle = (self.top + self.bottom) // 2
            return (
                _Box(self.top, self.left, middle, self.right, self.outer),
                _Box(middle, self.left, self.bottom, self.right, self.outer),
            )
        middle = (self.left + self.right) // 2
        return (
            _Box(self.top, self.left, self.bottom, middle, self.outer),
            _Box(self.top, middle, self.bottom, self.right, self.outer),
        )


@dataclass(frozen=True)
class _Patches:
    """All patches of a view, on its grid of [GH, GW]."""

    camera: Camera
    used: np.ndarray
    """[GH, GW] bool: edited, or beside such a one, and with a place."""
    edited: np.ndarray
    """[GH, GW] share of edited pixels."""
    pictures: np.ndarray
    """[GH, GW, P, P, 7] target, before, mask."""
    solid: np.ndarray
    """[GH, GW] share of pixels that show the asset."""
    points: np.ndarray
    """[GH, GW, 3] world points of their middles."""
    depths: np.ndarray
    """[GH, GW]."""

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
        depths = _cut(np.pad(view.depth, pad)[..., None])[..., 0]
        solid = visible.mean((2, 3))
        # The mean over what is visible alone: background would pull a patch at a silhouette behind the asset.
        depth = (depths * visible).sum((2, 3)) / np.maximum(visible.sum((2, 3)), 1)
        # The ring around the edit says what stays as it was.
        grown = np.pad(edited > 0, 1)
        near = np.zeros(edited.shape, bool)
        for dy in range(3):
            for dx in range(3):
                near |= grown[dy : dy + edited.shape[0], dx : dx + edited.shape[1]]
        y, x = np.indices(edited.shape)
        middles = (np.stack([x, y], -1) + 0.5) * PATCH_PX
        points = view.camera.unproject(np.maximum(depth.astype(np.float64), 1e-6), middles)
        used = near & (solid > MIN_SOLID_SHARE)
        return _Patches(view.camera, used, edited, pictures, solid, points, depth)

    def regions(self) -> Iterator[_Box]:
        """Boxes that together hold all used patches, none with more than MAX_TOKENS."""
        lines, columns = (np.flatnonzero(self.used.any(axis)) for axis in (1, 0))
        outer = (int(lines[0]), int(columns[0]), int(lines[-1]) + 1, int(columns[-1]) + 1)
        # Halved until each fits: a large edit becomes several, and no patch is looked at more coarsely.
        open_boxes = [_Box(*outer, outer)]
        while open_boxes:
            box = open_boxes.pop()
            if self._chosen(box).sum() > MAX_TOKENS:
                open_boxes += box.halves()
            else:
                yield box

    def _chosen(self, box: _Box) -> np.ndarray:
        """[GH, GW] bool: the used patches of a box and of the ring around it; where there are none, the nearest
        ones."""
        around = np.zeros(self.used.shape, bool)
        around[max(box.top - 1, 0) : box.bottom + 1, max(box.left - 1, 0) : box.right + 1] = True
        chosen = self.used & around
        if chosen.any():
            return chosen
        # A region without patches of its own may still have Gaussians, which need something to ask.
        ys, xs = np.nonzero(self.used)
        away = (ys - (box.top + box.bottom) / 2) ** 2 + (xs - (box.left + box.right) / 2) ** 2
        nearest = np.argsort(away, kind="stable")[:BANDS]
        chosen[ys[nearest], xs[nearest]] = True
        return chosen

    def numbers(self, box: _Box) -> np.ndarray:
        """[GH, GW] int64 which of a region's patches each is, -1: none."""
        chosen = self._chosen(box)
        numbers = np.full(chosen.shape, -1, np.int64)
        numbers[chosen] = np.arange(int(chosen.sum()))
        return numbers

    def tokens(self, box: _Box) -> tuple[_Frame, PatchTokens]:
        """(the frame of a region, its patches)."""
        chosen = self._chosen(box)
        points = self.points[chosen]
        low, high = points.min(0), points.max(0)
        pixel = float(np.median(self.depths[chosen])) / self.camera.fy
        # At least a patch wide: a single one has no extent, and places would be divided by nothing.
        half_extent = max(float((high - low).max()) / 2, PATCH_PX * pixel)
        frame = _Frame((low + high) / 2, half_extent, FINEST_PX * pixel / half_extent)
        planes = self.pictures[chosen]
        target, before = (0.5 * cosines(planes[..., part] - 0.5) for part in (slice(0, 3), slice(3, 6)))
        count = len(planes)
        values = [target.reshape(count, -1), before.reshape(count, -1), planes[..., 6].reshape(count, -1)]
        values.append(2 * self.solid[chosen][:, None] - 1)
        positions = (points - frame.center) / half_extent
        return frame, PatchTokens(
            positions.astype(np.float32),
            np.concatenate(values, 1, dtype=np.float32),
            self.edited[chosen].astype(np.float32),
        )


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
