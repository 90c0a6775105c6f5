"""`ProjectedView`: one view of some splats, projected, depth-sorted and binned once; then rasterized or differentiated
many times.

The tool of the lift: colours change from step to step while the geometry stays. numpy only, no torch. All per-Gaussian
arrays of a view have M entries, for the Gaussians that it draws, front to back: entry i is Gaussian `gaussian_ids[i]`
of the splats. `values[view.gaussian_ids]` goes from the N Gaussians to these, `values[view.gaussian_ids] = ...` back.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from splatpainter.array_types import Bools, Ids
from splatpainter.cameras import Camera
from splatpainter.kernels.arrays import aligned, filled, readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run, run_sized, threads
from splatpainter.kernels.rows import by_blocks
from splatpainter.rendering.cpu import geometry
from splatpainter.rendering.cpu.geometry import (
    COLUMNS,
    GAUSSIANS_PER_BLOCK,
    LIST_SIZES,
    STEP_SIZES,
    SUMS,
    TILE,
)
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import ATTRIBUTES, MAX_MAGNITUDE, Splats
from splatpainter.system.quick_dataclass import dataclass

MIN_PRESELECTED = 1 << 16
"""Gaussians from which on a first pass finds those that may touch the drawn tiles, where not all tiles are."""
INT32, INT64 = np.dtype(np.int32), np.dtype(np.int64)
MAX_PAIRS = 1 << 30
"""Pairs of a Gaussian and a tile in one view, 12 GiB of lists; beyond 2^31 their numbers would not fit into int32."""


@dataclass(frozen=True)
class MaskSums:
    """How much of some pixels each drawn Gaussian makes, in the order of `gaussian_ids`."""

    weight: np.ndarray
    """[M] sum_p w_ip m_p."""
    alpha: np.ndarray
    """[M] sum_p alpha_ip m_p, without transmittance: weight / alpha is the Gaussian's mean visibility, 0..1."""
    peak: np.ndarray
    """[M] max_p w_ip over pixels with m_p > 0."""

    def take(self, entries: Ids) -> MaskSums:
        """Those of some of the M ([K] int64), in arrays of their own."""
        return MaskSums(*(values.take(entries) for values in (self.weight, self.alpha, self.peak)))


@dataclass(frozen=True)
class Backprojection(MaskSums):
    """What `ProjectedView.backproject` returns."""

    values: np.ndarray
    """[M, 3] sum_p w_ip m_p v_p."""


@dataclass(frozen=True)
class ProjectedView:
    """Made by `project`; immutable, and safe to use from several threads at once."""

    camera: Camera
    num_gaussians: int
    """N, of the splats that were projected."""
    tiles: Bools
    """[TH, TW] bool: the 16 x 16 tiles that are drawn."""
    gaussian_ids: Ids
    """[M] int64 Gaussians that touch a drawn tile, front to back."""
    projected: np.ndarray
    """[M, 16] columns as named in geometry.py; not to be written."""
    pair_offsets: Ids
    """[M + 1] int64: entry i's pairs (one per tile that it touches) are pair_offsets[i] .. pair_offsets[i + 1] of P."""
    flatten_ids: Ids
    """[P] int32 entries (0..M) of each drawn tile, tile after tile, front to back."""
    pair_ids: Ids
    """[P] int32 which pair each of `flatten_ids` is."""
    tile_ids: Ids
    """[T] int32 drawn tiles, numbered row by row over [TH, TW]."""
    isect_offsets: Ids
    """[T + 1] int64 where each drawn tile begins in `flatten_ids`."""

    def __len__(self) -> int:
        """M, Gaussians drawn."""
        return len(self.gaussian_ids)

    @property
    def means2d(self) -> np.ndarray:
        """[M, 2] projected means, pixels."""
        return self.projected[:, geometry.MEAN_X : geometry.MEAN_Y + 1]

    @property
    def extents(self) -> np.ndarray:
        """[M, 2] half width and height of the drawn ellipse (alpha >= 1/255), pixels."""
        return self.projected[:, [geometry.EXTENT_X, geometry.EXTENT_Y]]

    @property
    def conics(self) -> np.ndarray:
        """[M, 3] A, B, C of the inverse 2D covariance: sigma = (A dx^2 + C dy^2) / 2 + B dx dy, per px^2."""
        return self.projected[:, geometry.CONIC_A : geometry.CONIC_C + 1]

    @property
    def opacities(self) -> np.ndarray:
        """[M] peak alpha in this view (antialiased splats: compensated for the blur)."""
        return self.projected[:, geometry.OPACITY]

    @property
    def depths(self) -> np.ndarray:
        """[M] z, world units, ascending."""
        return self.projected[:, geometry.DEPTH]

    @property
    def colors(self) -> np.ndarray:
        """[M, 3] colours that rasterize(None) uses: SH towards this view, clamped at 0."""
        return self.projected[:, geometry.RED : geometry.BLUE + 1]

    @property
    def unclamped_colors(self) -> np.ndarray:
        """[M, 3] the same, not clamped."""
        return self.projected[:, geometry.UNCLAMPED_RED :]

    def unclamped_of(self, entries: np.ndarray) -> np.ndarray:
        """[K, 3] `unclamped_colors` of some entries ([K] int64): whole rows are taken several times as fast as parts of
        them."""
        return self.projected.take(entries, 0)[:, geometry.UNCLAMPED_RED :]

    def colors_of(self, entries: np.ndarray) -> np.ndarray:
        """[K, 3] `colors` of some entries ([K] int64), in an array of their own."""
        return np.ascontiguousarray(self.projected.take(entries, 0)[:, geometry.RED : geometry.BLUE + 1])

    def tiles_of(self, gaussian_mask: np.ndarray) -> Bools:
        """[TH, TW] bool: drawn tiles that the ellipses of these Gaussians ([N] bool) touch."""
        selected = gaussian_mask[self.gaussian_ids][self.flatten_ids]  # [P]
        hit = np.zeros(len(self.tile_ids), bool)
        hit[np.searchsorted(self.isect_offsets, np.flatnonzero(selected), side="right") - 1] = True
        out = np.zeros(self.tiles.size, bool)
        out[self.tile_ids[hit]] = True
        return out.reshape(self.tiles.shape)

    @cached_property
    def entries(self) -> Ids:
        """[N] int32 entry of each Gaussian, -1: it is not in the view."""
        entries = np.full(self.num_gaussians, -1, np.int32)
        entries[self.gaussian_ids] = np.arange(len(self), dtype=np.int32)
        return entries

    def twin(self) -> ProjectedView:
        """The same view as an object of its own, which nobody finds who looks for this one (recent_views.py)."""
        twin = replace(self)
        if "entries" in vars(self):
            vars(twin)["entries"] = self.entries
        return twin

    def touched_tiles(self, entries: np.ndarray) -> Bools:
        """[TH, TW] bool: all tiles, drawn or not, that the ellipses of these entries ([M] bool, or [K] int64 their
        numbers) touch."""
        entries = np.flatnonzero(entries) if entries.dtype == bool else entries
        grid = np.array([0, self.tiles.shape[1], 0, self.tiles.shape[0]])
        hit = np.zeros((threads(), self.tiles.size), bool)
        run_sized(COLUMNS * len(entries), kernels.mark_tiles, self.projected, readonly(entries, np.int64), grid, hit)
        return np.any(hit, axis=0).reshape(self.tiles.shape)

    def part(self, *, tiles: np.ndarray | None = None, gaussian_mask: np.ndarray | None = None) -> ProjectedView:
        """What `project` would give for some of the drawn tiles ([TH, TW] bool; None: all of them) and for some of the
        Gaussians ([N] bool; None: all of them), bit for bit, without those that touch none of these tiles."""
        at, part = self._lists_of(tiles, None if gaussian_mask is None else gaussian_mask.take(self.gaussian_ids))
        if part is self:
            return self
        projected, gaussian_ids = aligned((len(at), COLUMNS), self.projected.dtype), aligned((len(at),), INT64)
        run(kernels.put_entries, at, None, self.projected, self.gaussian_ids, projected, gaussian_ids)
        return replace(part, gaussian_ids=gaussian_ids, projected=readonly(projected, projected.dtype))

    def _lists_of(self, tiles: np.ndarray | None, selected: np.ndarray | None) -> tuple[np.ndarray, ProjectedView]:
        """([M'] int64 entries of a part, the lists of the part beside the entries of this view). selected: [M] bool,
        entries that it may have; None: all of them."""
        tiles = self.tiles if tiles is None else tiles & self.tiles
        if selected is None and np.array_equal(tiles, self.tiles) and (np.diff(self.pair_offsets) > 0).all():
            return np.arange(len(self)), self
        used = tiles.ravel()[self.tile_ids]  # [T]
        lists = (self.flatten_ids, self.isect_offsets, used)
        words, per_tile = -(-len(self) // 64), np.empty(len(used), np.int64)
        some, counts = np.empty(words, np.uint64), aligned((len(self),), INT32)
        kernels.count_pairs(*lists, selected, some, counts, per_tile, 0, 1)
        total = int(per_tile.sum())
        at, pair_offsets = aligned((2, min(len(self), total) + 1), INT64)
        before, number = np.empty(words, np.int32), np.empty(1, np.int64)
        kernels.number_entries(some, counts, before, at, pair_offsets, number, 0, 1)
        at, pair_offsets = at[: number[0]], pair_offsets[: number[0] + 1]
        flatten_ids, pair_ids = aligned((2, total), INT32)
        kernels.take_pairs(*lists, some, before, counts, flatten_ids, pair_ids, 0, 1)
        part = replace(
            self,
            tiles=tiles,
            pair_offsets=pair_offsets,
            flatten_ids=flatten_ids,
            pair_ids=pair_ids,
            tile_ids=self.tile_ids[used],
            isect_offsets=np.append(0, np.cumsum(per_tile[used])),
        )
        return at, part

    def merged(
        self,
        other: ProjectedView,
        *,
        tiles: np.ndarray | None = None,
        without: np.ndarray | None = None,
        ties: np.ndarray | None = None,
    ) -> ProjectedView:
        """What `project` would give for a part of this view (its entries are copied once) and for the Gaussians of
        another one, bit for bit. other: of other Gaussians, numbered from the same N or beyond, with the same camera
        and tiles; tiles: as of `part`; without: [K] int64 Gaussians of this view that are left out; ties: [M2]
        ascending where depths are equal, what stands for its `gaussian_ids` where one of each view lie at equal
        depths."""
        selected = None
        if without is not None:
            left_out, selected = self.entries.take(without), np.ones(len(self), bool)
            selected[left_out[left_out >= 0]] = False
        at, part = self._lists_of(tiles, selected)
        m, dtype = len(at) + len(other), self.projected.dtype
        entry, entry2 = aligned((len(at),), INT32), aligned((len(other),), INT32)
        pair_offsets = aligned((m + 1,), INT64)
        first_entries = (self.projected, self.gaussian_ids, at, part.pair_offsets)
        other_entries = (other.projected, other.gaussian_ids if ties is None else ties, other.pair_offsets)
        kernels.merge_entries(*first_entries, *other_entries, entry, entry2, pair_offsets, 0, 1)
        projected, gaussian_ids = aligned((m, COLUMNS), dtype), aligned((m,), INT64)
        for view, taken, numbers in ((self, at, entry), (other, np.arange(len(other)), entry2)):
            run(kernels.put_entries, taken, numbers, view.projected, view.gaussian_ids, projected, gaussian_ids)
        flatten_ids, pair_ids = aligned((2, len(part.flatten_ids) + len(other.flatten_ids)), INT32)
        lists = [(v.flatten_ids, v.pair_ids, v.isect_offsets, v.pair_offsets) for v in (part, other)]
        run(kernels.merge_pairs, *lists[0], entry, *lists[1], entry2, pair_offsets, flatten_ids, pair_ids)
        return replace(
            part,
            num_gaussians=max(self.num_gaussians, other.num_gaussians),
            gaussian_ids=gaussian_ids,
            projected=readonly(projected, dtype),
            pair_offsets=pair_offsets,
            flatten_ids=flatten_ids,
            pair_ids=pair_ids,
            isect_offsets=part.isect_offsets + other.isect_offsets,
        )

    def rasterize(
        self, colors: np.ndarray | None = None, tiles: Bools | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Composite the drawn tiles: (image [H, W, 3] over the camera's background, alpha [H, W], expected z-depth
        [H, W]). colors: [M, 3] in place of the SH colours, used as they are; tiles: [TH, TW] bool, of the drawn tiles
        only these. Other tiles stay background, 0 and 0."""
        if tiles is not None and (self.tiles & ~tiles).any():
            return self._with_tiles(tiles & self.tiles).rasterize(colors)
        # Zeros that nobody writes cost nothing: the system hands out pages when they are touched.
        everywhere, shape = len(self.tile_ids) == self.tiles.size, (self.camera.height, self.camera.width)
        dtype = self.projected.dtype
        image = np.zeros((*shape, 3), dtype) if everywhere else self.empty_picture()
        alpha, depth = np.zeros(shape, dtype), np.zeros(shape, dtype)
        self.rasterize_into(image, alpha, depth, colors, empty=True)
        return image, alpha, depth

    def empty_picture(self) -> np.ndarray:
        """[H, W, 3] its background."""
        shape = (self.camera.height, self.camera.width, 3)
        if not any(self.camera.background):
            return np.zeros(shape, self.projected.dtype)
        image = aligned(shape, self.projected.dtype)
        self._fill(image)
        return image

    def redraw(self, tiles: Bools, image: np.ndarray, alpha: np.ndarray, depth: np.ndarray) -> None:
        """Some of the drawn tiles ([TH, TW] bool) drawn anew into given pictures, whose other pixels stay."""
        view = self._with_tiles(tiles & self.tiles) if (self.tiles & ~tiles).any() else self
        view.rasterize_into(image, alpha, depth, empty=True)

    def rasterize_into(
        self,
        image: np.ndarray,
        alpha: np.ndarray,
        depth: np.ndarray,
        colors: np.ndarray | None = None,
        profile: Profile = "inria",
        *,
        empty: bool = False,
    ) -> Ids:
        """`rasterize` into given C-contiguous arrays. empty: they hold what undrawn tiles show already. Returns
        [T] int64 where in `flatten_ids` each drawn tile stopped, for `rasterize_backward`."""
        background = self._background()
        if len(self.tile_ids) < self.tiles.size and not empty:
            self._fill(image)
            alpha[:], depth[:] = 0, 0
        ends = np.empty(len(self.tile_ids), np.int64)
        if colors is not None:
            assert colors.shape == (len(self), 3), f"colors: expected [{len(self)}, 3], got {colors.shape}"
            colors = readonly(colors, self.projected.dtype)
        lists = (self.projected, colors, self.flatten_ids, self.tile_ids, self.isect_offsets)
        run(kernels.rasterize_tiles, *lists, background, image, alpha, depth, ends, _profile_number(profile))
        return ends

    def rasterize_backward(self, ends: np.ndarray, *pictures: np.ndarray) -> np.ndarray:
        """[P, 16] sums of backward.h, from what `rasterize_into` returned. pictures: image [H, W, 3], alpha and depth
        [H, W] as they were rasterized, then their gradients."""
        dtype = self.projected.dtype
        sums = aligned((len(self.flatten_ids), COLUMNS), dtype)
        inputs = [readonly(picture, dtype) for picture in pictures]
        run(kernels.rasterize_backward_tiles, *self.tile_lists(self.projected), ends, *inputs, sums)
        return sums

    def project_backward(
        self, splats: Splats, sums: np.ndarray, out: tuple[np.ndarray, ...], *, overwrite: bool = True
    ) -> None:
        """Write (or add) this view's gradients to `out`: arrays shaped as the splats' attributes, in ATTRIBUTES' order;
        that of `sh` may have no rows, and is then left out. splats: those that were projected; sums: of
        `rasterize_backward`."""
        attributes = [readonly(getattr(splats, name), sums.dtype) for name in ATTRIBUTES]
        camera = geometry.camera_vector(self.camera, np.zeros(4), sums.dtype)
        settings = (splats.sh_degree, camera, bool(splats.antialiased))
        run(
            kernels.project_gaussians_backward,
            *attributes,
            *settings,
            self.entries,
            self.projected,
            self.pair_offsets,
            sums,
            overwrite,
            *out,
        )

    def backproject(self, values: np.ndarray, mask: np.ndarray, profile: Profile = "inria") -> Backprojection:
        """The adjoint of compositing over the drawn tiles, with w_ip = alpha_ip T_ip (0 below 1/255 and behind the
        stop). values: [H, W, 3]; mask: [H, W] weights m_p >= 0."""
        dtype = self.projected.dtype
        sums = aligned((len(self.flatten_ids), SUMS), dtype)
        values, mask = self._readonly_pictures(values, mask)
        run(
            kernels.backproject_tiles,
            *self.tile_lists(self.projected),
            values,
            mask,
            sums,
            _profile_number(profile),
        )
        out = self._reduce(sums)
        return Backprojection(out[:, 3], out[:, 4], out[:, 5], out[:, :3])

    def mask_sums(self, mask: np.ndarray, mask2: np.ndarray) -> tuple[MaskSums, MaskSums]:
        """`backproject` for two masks ([H, W] bool, or weights m_p >= 0), without values, in the time of one."""
        return self.reduced_masks(self.pair_mask_sums(mask, mask2))

    def pair_mask_sums(self, mask: np.ndarray, mask2: np.ndarray) -> np.ndarray:
        """[P, 8] what `mask_sums` adds up, of each pair of a Gaussian and a tile."""
        sums = aligned((len(self.flatten_ids), SUMS), self.projected.dtype)
        masks = [readonly(one, sums.dtype) for one in (mask, mask2)]
        run(kernels.mask_sums_tiles, *self.tile_lists(self.projected), *masks, sums)
        return sums

    def sum_again(self, sums: np.ndarray, mask: np.ndarray, mask2: np.ndarray, tiles: Bools) -> None:
        """Write `pair_mask_sums` of some drawn tiles ([TH, TW] bool) to those of all."""
        if (tiles & self.tiles).any():
            masks = [readonly(one, sums.dtype) for one in (mask, mask2)]
            run(kernels.mask_sums_tiles, *self._lists_in(tiles), *masks, sums)

    def reduced_masks(self, sums: np.ndarray) -> tuple[MaskSums, MaskSums]:
        """`mask_sums` from what it adds up."""
        out = aligned((len(self), 6), sums.dtype)
        run_sized(sums.size, kernels.reduce_mask_sums, self.pair_offsets, sums, out)
        return MaskSums(out[:, 3], out[:, 4], out[:, 5]), MaskSums(out[:, 0], out[:, 1], out[:, 2])

    def sirt_step(
        self, target: np.ndarray, mask: np.ndarray, colors: np.ndarray | None = None
    ) -> tuple[np.ndarray, float]:
        """One step of the lift, fused: rasterize with `colors` [M, 3], and return sum_p w_ip m_p (target_p - image_p)
        [M, 3] and sum_p m_p |target_p - image_p|^2 over pixels and channels. target: [H, W, 3]; mask: [H, W] >= 0.
        Costs time in proportion to the drawn tiles under the mask."""
        gain = np.zeros((len(self), 3), self.projected.dtype)
        sums, errors = self.step_sums(target, mask, self.with_colors(colors))
        run(kernels.add_gains, self.pair_offsets, sums, None, None, gain)
        return gain, float(errors.sum(dtype=np.float64))

    def step_sums(
        self, target: np.ndarray, mask: np.ndarray, projected: np.ndarray, sums: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """What `sirt_step` adds up: ([P, 4] per pair of a Gaussian and a tile, [T] squared errors). projected: [M, 16]
        as of `with_colors`; sums: to be written to in place of new ones."""
        dtype = self.projected.dtype
        sums = aligned((len(self.flatten_ids), STEP_SIZES.sums), dtype) if sums is None else sums
        errors = np.empty(len(self.tile_ids), dtype)
        pictures = self._readonly_pictures(target, mask)
        space, groups = (
            aligned((threads(), STEP_SIZES.tile_weights), dtype),
            np.empty((threads(), STEP_SIZES.tile_groups), np.int64),
        )
        lists = (*self.tile_lists(projected), self._background())
        run(kernels.sirt_tiles, *lists, *pictures, sums, errors, space, groups)
        return sums, errors

    def heaviest_gaussians(self, profile: Profile = "inria") -> Ids:
        """[H, W] int64: the Gaussian with the largest weight w = alpha T in each pixel, of equal ones the front one; -1
        where nothing is drawn, as in tiles that are not."""
        entries = filled((self.camera.height, self.camera.width), -1, INT32)
        lists = (self.projected, self.flatten_ids, self.tile_ids, self.isect_offsets)
        run(kernels.heaviest_tiles, *lists, entries, _profile_number(profile))
        # Only around the drawn tiles: a sheet's hosts are looked for in a few of them.
        out = filled(entries.shape, -1, INT64)
        rows, columns = (np.flatnonzero(self.tiles.any(axis)) for axis in (1, 0))
        if len(rows):
            box = tuple(slice(TILE * at[0], TILE * (at[-1] + 1)) for at in (rows, columns))
            out[box] = np.append(self.gaussian_ids, -1)[entries[box]]
        return out

    def with_colors(self, colors: np.ndarray | None) -> np.ndarray:
        """`projected` with [M, 3] colours in place of the SH colours (None: as it is)."""
        if colors is None:
            return self.projected
        assert colors.shape == (len(self), 3), f"colors: expected [{len(self)}, 3], got {colors.shape}"
        projected = aligned(self.projected.shape, self.projected.dtype)

        def fill(block: slice) -> None:
            projected[block] = self.projected[block]
            projected[block, geometry.RED : geometry.BLUE + 1] = colors[block]

        by_blocks(fill, len(self))
        return readonly(projected, projected.dtype)

    def recolored(self, splats: Splats, space: np.ndarray | None = None) -> ProjectedView | None:
        """This view of the splats with other SH coefficients: what `project` would give, bit for bit, where it draws
        the same Gaussians. None where coefficients of a drawn one are out of range. space: [M, 16] this view's
        `projected` in any colours, to be written to in place of a copy."""
        assert len(splats) == self.num_gaussians, f"{len(splats)} Gaussians in place of {self.num_gaussians}"
        projected, beyond = space, np.zeros(threads(), bool)
        if projected is None:
            projected = aligned(self.projected.shape, self.projected.dtype)
            projected[:] = self.projected
        means, sh = (readonly(values, projected.dtype) for values in (splats.means, splats.sh))
        camera = geometry.camera_vector(self.camera, np.zeros(4), projected.dtype)
        where = (camera, self.gaussian_ids, projected, beyond)
        run(kernels.shade_entries, means, sh.reshape(len(sh), -1), splats.sh_degree, *where)
        return None if beyond.any() else replace(self, projected=readonly(projected, projected.dtype))

    def _with_tiles(self, tiles: np.ndarray) -> ProjectedView:
        """This view for rasterizing some drawn tiles alone: all Gaussians, in no pairs."""
        _, flatten_ids, _, tile_ids, offsets = self._lists_in(tiles)
        lists = {"flatten_ids": flatten_ids, "pair_ids": self.pair_ids[:0]}
        return replace(self, tiles=tiles, tile_ids=tile_ids, isect_offsets=offsets, **lists)

    def _lists_in(self, tiles: Bools) -> tuple[np.ndarray, ...]:
        """`tile_lists` of some drawn tiles alone."""
        used = tiles.ravel()[self.tile_ids]
        spans = list(zip(self.isect_offsets[:-1][used], self.isect_offsets[1:][used], strict=True))
        offsets = np.cumsum([0, *(end - begin for begin, end in spans)])
        lists = [
            np.concatenate([pairs[:0], *(pairs[begin:end] for begin, end in spans)])
            for pairs in (self.flatten_ids, self.pair_ids)
        ]
        return self.projected, *lists, self.tile_ids[used], offsets

    def tile_lists(self, projected: np.ndarray) -> tuple[np.ndarray, ...]:
        """What every kernel over pairs begins with."""
        return projected, self.flatten_ids, self.pair_ids, self.tile_ids, self.isect_offsets

    def _fill(self, image: np.ndarray) -> None:
        """Background everywhere. Row by row: numpy copies long rows, and three numbers one by one."""
        image[:] = np.tile(self._background(), (image.shape[1], 1))

    def _background(self) -> np.ndarray:
        return readonly(np.array(self.camera.background), self.projected.dtype)

    def _readonly_pictures(self, values: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shape = (self.camera.height, self.camera.width)
        assert values.shape == (*shape, 3) and mask.shape == shape, f"{values.shape}, {mask.shape}: picture is {shape}"
        return readonly(values, self.projected.dtype), readonly(mask, self.projected.dtype)

    def _reduce(self, sums: np.ndarray) -> np.ndarray:
        out = aligned((len(self), 6), sums.dtype)
        run_sized(sums.size, kernels.reduce_pairs, self.pair_offsets, sums, out)
        return out


def tile_shape(camera: Camera) -> tuple[int, int]:
    """(TH, TW) tiles that cover a picture."""
    return -(-camera.height // TILE), -(-camera.width // TILE)


def tiles_of_mask(mask: np.ndarray) -> Bools:
    """[TH, TW] bool: tiles in which a [H, W] mask has any pixel > 0."""
    height, width = mask.shape
    padded = np.zeros((-(-height // TILE) * TILE, -(-width // TILE) * TILE), bool)
    padded[:height, :width] = mask if mask.dtype == bool else mask > 0
    # Rows first, then eight pixels at a time as one number.
    lines = np.logical_or.reduce(padded.reshape(-1, TILE, padded.shape[1]), 1).view(np.uint64)
    return (lines[:, ::2] | lines[:, 1::2]) != 0


def pixels_of_tiles(tiles: Bools, shape: tuple[int, ...]) -> Bools:
    """[H, W] bool: the pixels of some tiles ([TH, TW] bool) of a picture."""
    return np.kron(tiles, np.ones((TILE, TILE), bool))[: shape[0], : shape[1]]


def copy_tiles(picture: np.ndarray, other: np.ndarray, tiles: Bools) -> None:
    """Write some tiles ([TH, TW] bool) of another picture to one ([H, W, ...] both)."""
    edges = np.diff(np.pad(tiles, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    # Tiles beside each other at once: most edits are in one piece.
    ends = np.argwhere(edges < 0)[:, 1]
    for (y, x), end in zip(np.argwhere(edges > 0).tolist(), ends.tolist(), strict=True):
        rows, columns = slice(TILE * y, TILE * (y + 1)), slice(TILE * x, TILE * end)
        picture[rows, columns] = other[rows, columns]


def project(
    splats: Splats, camera: Camera, *, gaussian_mask: Bools | None = None, tiles: Bools | None = None
) -> ProjectedView:
    """Geometry of one view. splats: numpy attributes (float32; float64 works too). gaussian_mask: [N] bool, only these
    Gaussians exist. tiles: [TH, TW] bool, only these 16 x 16 tiles are drawn, and what misses them is dropped early."""
    dtype, camera = np.dtype(splats.means.dtype), camera.within(splats.offset)
    n, shape = len(splats), tile_shape(camera)
    tiles = np.ones(shape, bool) if tiles is None else np.asarray(tiles, bool)
    assert tiles.shape == shape, f"tiles: expected {shape}, got {tiles.shape}"
    assert gaussian_mask is None or gaussian_mask.shape == (n,), (
        f"gaussian_mask: expected [{n}] bool, got {gaussian_mask}"
    )
    # Only drawn tiles have slots: a stroke's view costs what lies under the brush.
    tile_ids = np.flatnonzero(tiles).astype(np.int32)
    tile_slots, grid, window = _tile_layout(tiles, tile_ids, camera)
    attributes = [readonly(getattr(splats, name), dtype) for name in ATTRIBUTES]
    cam = geometry.camera_vector(camera, window, dtype)
    # For a small part of a large asset a coarse test of each Gaussian is cheaper than its projection.
    if gaussian_mask is None:
        gaussian_mask = np.empty(n if len(tile_ids) < tiles.size and n >= MIN_PRESELECTED else 0, bool)
        if len(gaussian_mask):
            run(kernels.select_near_window, *(attributes[k] for k in (0, 2, 3)), cam, gaussian_mask)
    selected = readonly(gaussian_mask, np.bool_)

    # Each block of Gaussians writes to its own place, so that threads need no lock and the order is always the same.
    blocks = -(-n // GAUSSIANS_PER_BLOCK)
    size = blocks * GAUSSIANS_PER_BLOCK
    block_projected, keys = aligned((size, COLUMNS), dtype), aligned((size,), dtype)
    (block_ids, block_tiles), counts = aligned((2, size), INT32), np.empty(blocks, np.int32)
    if len(tile_ids) and n and np.abs(camera.position).max() <= MAX_MAGNITUDE:
        settings = (splats.sh_degree, selected, cam, bool(splats.antialiased), grid, tile_slots)
        arguments = (*attributes[:4], attributes[4].reshape(n, -1), *settings)
        run(kernels.project_gaussians, *arguments, block_projected, keys, block_ids, block_tiles, counts)
    else:
        counts[:] = 0

    # Sorted once by depth; lists of tiles made in this order are sorted as well.
    order, share_tiles = _depth_order(keys, counts, block_tiles)
    m, shares = len(order), len(share_tiles)

    # Pairs of Gaussian and tile become memory: judged before they are made.
    max_pairs = int(share_tiles.sum())
    if max_pairs > MAX_PAIRS:
        size = f"{camera.width} x {camera.height}"
        limit = f"Gaussians that touch at most {MAX_PAIRS:,} tiles of {TILE} x {TILE} pixels in all"
        raise ValueError(f"render: expected {limit}, got {max_pairs:,} at {size}; render a smaller picture")
    # Counted first and placed then: the sums of counts say where each thread's pairs go.
    begins = np.append(0, np.cumsum(share_tiles + LIST_SIZES.pairs_at_once))
    pairs, histogram = aligned((int(begins[-1]),), INT64), np.zeros((shares, len(tile_ids)), np.int64)
    projected, gaussian_ids = aligned((m, COLUMNS), dtype), aligned((m,), INT64)
    pair_offsets = aligned((m + 1,), INT64)
    pair_offsets[0] = 0
    sorted_entries = (projected, gaussian_ids, pairs, pair_offsets, histogram)
    run(kernels.list_pairs, order, block_projected, block_ids, begins, grid, tile_slots, *sorted_entries)
    del block_projected
    totals, isect_offsets = np.zeros(shares + 1, np.int64), np.zeros(len(tile_ids) + 1, np.int64)
    np.cumsum(histogram.sum(1), out=totals[1:])
    np.cumsum(histogram.sum(0), out=isect_offsets[1:])
    first = np.cumsum(histogram, 0) - histogram + isect_offsets[:-1]
    flatten_ids, pair_ids = aligned((2, int(totals[-1])), INT32)
    run_sized(2 * len(pairs), kernels.place_pairs, pairs, begins, totals, first, pair_offsets, flatten_ids, pair_ids)
    return ProjectedView(
        camera=camera,
        num_gaussians=n,
        tiles=tiles,
        gaussian_ids=gaussian_ids,
        projected=readonly(projected, dtype),
        pair_offsets=pair_offsets,
        flatten_ids=flatten_ids,
        pair_ids=pair_ids,
        tile_ids=tile_ids,
        isect_offsets=isect_offsets,
    )


def _depth_order(keys: np.ndarray, counts: np.ndarray, tile_counts: np.ndarray) -> tuple[Ids, Ids]:
    """([M] int32 slots of what the blocks wrote, front to back, ties in the order of the Gaussians; [threads] int64
    tiles that each thread's share of these touches, at most)."""
    total, shares = int(counts.sum()), threads()
    if keys.dtype == np.float32:
        order, spare = aligned((2, total), INT32)
        value, value2 = aligned((2, total), np.dtype(np.uint32))
        share_tiles = np.empty((shares, shares), np.int64)
        run(kernels.sort_depths, keys, counts, tile_counts, order, spare, value, value2, share_tiles)
        return order, share_tiles.sum(0)
    slots = np.concatenate(
        [np.arange(c) + b * GAUSSIANS_PER_BLOCK for b, c in enumerate(counts)] or [np.empty(0, np.int64)]
    )
    order = slots[np.argsort(keys[slots], kind="stable")].astype(np.int32)
    edges = np.arange(shares + 1) * total // shares
    return order, np.diff(np.append(0, np.cumsum(tile_counts[order], dtype=np.int64))[edges])


def _profile_number(profile: Profile) -> int:
    """What kernels take for a profile; see compositing.h."""
    return 0 if profile == "inria" else 1


def _tile_layout(tiles: np.ndarray, tile_ids: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(tile_slots, grid, window) for project_gaussians, of the tiles in use."""
    height, width = tiles.shape
    if len(tile_ids) == tiles.size:
        empty = readonly(np.empty((0, 0)), np.int32)
        return empty, np.array([0, width, 0, height]), np.array([0, camera.width, 0, camera.height])
    tile_slots = np.full(tiles.size, -1, np.int32)
    tile_slots[tile_ids] = np.arange(len(tile_ids))
    across, down = np.flatnonzero(tiles.any(0)), np.flatnonzero(tiles.any(1))
    grid = np.array([across[0], across[-1] + 1, down[0], down[-1] + 1] if len(tile_ids) else [0, 0, 0, 0])
    edge = np.minimum(grid * TILE, [camera.width, camera.width, camera.height, camera.height])
    return readonly(tile_slots.reshape(tiles.shape), np.int32), grid, edge
