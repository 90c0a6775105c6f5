"""`Frame`: one view of some splats, projected, depth-sorted and binned once; then drawn or differentiated many times.

The tool of the lift: colours change from round to round while the geometry stays. numpy only, no torch. All per-row
arrays of a frame have M entries, for the rows that it draws: entry i belongs to row `frame.rows[i]` of the splats,
front to back. Use `values[frame.rows]` to go from the N rows to these and `values[frame.rows] = ...` to go back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels import simd as lanes
from splatpainter.kernels.parallel import run, threads
from splatpainter.rendering.cpu import backproject as gather
from splatpainter.rendering.cpu import geometry, projection, raster
from splatpainter.rendering.cpu import tile_binning as bins
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import ATTRIBUTES, MAX_MAGNITUDE, Splats

TILE = lanes.TILE
MAX_PAIRS = 1 << 30
"""Row and tile pairs of one view, 12 GiB of lists; beyond 2^31 their places would not fit into int32."""


@dataclass(frozen=True)
class Sums:
    """What `Frame.accumulate` returns, per drawn row, in the order of `Frame.rows`."""

    values: np.ndarray
    """[M, 3] sum_p w_ip m_p v_p."""
    weight: np.ndarray
    """[M] sum_p w_ip m_p."""
    alpha: np.ndarray
    """[M] sum_p alpha_ip m_p, without transmittance: weight / alpha is the row's mean visibility, 0..1."""
    peak: np.ndarray
    """[M] max_p w_ip over pixels with m_p > 0."""


@dataclass(frozen=True)
class Frame:
    """Made by `project`; immutable, and safe to use from several threads at once."""

    camera: Camera
    count: int
    """N, rows of the splats that were projected."""
    tiles: np.ndarray
    """[TH, TW] bool: the 16 x 16 tiles that are drawn."""
    rows: np.ndarray
    """[M] int64 rows of the splats that touch a drawn tile, front to back."""
    records: np.ndarray
    """[M, 16] columns as named in lanes.py; not to be written."""
    offsets: np.ndarray
    """[M + 1] int64: entry i's pairs (one per tile that it touches) are offsets[i] .. offsets[i + 1] of P."""
    members: np.ndarray
    """[P] int32 entries (0..M) of each drawn tile, tile after tile, front to back."""
    homes: np.ndarray
    """[P] int32 which pair each of `members` is."""
    tile_ids: np.ndarray
    """[T] int32 drawn tiles, numbered row by row over [TH, TW]."""
    starts: np.ndarray
    """[T + 1] int64 where each drawn tile begins in `members`."""

    def __len__(self) -> int:
        """M, rows drawn."""
        return len(self.rows)

    @property
    def centers(self) -> np.ndarray:
        """[M, 2] projected means, pixels."""
        return self.records[:, lanes.MX : lanes.MY + 1]

    @property
    def extents(self) -> np.ndarray:
        """[M, 2] half width and height of the drawn ellipse (alpha >= 1/255), pixels."""
        return self.records[:, [lanes.XE, lanes.YE]]

    @property
    def conics(self) -> np.ndarray:
        """[M, 3] A, B, C of the inverse 2D covariance: sigma = (A dx^2 + C dy^2) / 2 + B dx dy, per px^2."""
        return self.records[:, lanes.CA : lanes.CC + 1]

    @property
    def opacities(self) -> np.ndarray:
        """[M] peak alpha in this view (antialiased splats: compensated for the blur)."""
        return self.records[:, lanes.OP]

    @property
    def depths(self) -> np.ndarray:
        """[M] z, world units, ascending."""
        return self.records[:, lanes.DEPTH]

    @property
    def colors(self) -> np.ndarray:
        """[M, 3] colours that draw(None) uses: SH towards this view, clamped at 0."""
        return self.records[:, lanes.RED : lanes.BLUE + 1]

    @property
    def raw_colors(self) -> np.ndarray:
        """[M, 3] the same, not clamped."""
        return self.records[:, lanes.RAW : lanes.RAW + 3]

    def visible_rows(self) -> np.ndarray:
        """[N] bool: rows that touch a drawn tile (hidden behind others or not)."""
        seen = np.zeros(self.count, bool)
        seen[self.rows] = True
        return seen

    def tiles_of(self, rows: np.ndarray) -> np.ndarray:
        """[TH, TW] bool: drawn tiles that the ellipses of these rows ([N] bool) touch."""
        chosen = rows[self.rows][self.members]  # [P]
        hit = np.zeros(len(self.tile_ids), bool)
        hit[np.searchsorted(self.starts, np.flatnonzero(chosen), side="right") - 1] = True
        out = np.zeros(self.tiles.size, bool)
        out[self.tile_ids[hit]] = True
        return out.reshape(self.tiles.shape)

    def draw(self, colors: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Composite the drawn tiles: (image [H, W, 3] over the camera's background, alpha [H, W], expected z-depth
        [H, W]). colors: [M, 3] in place of the SH colours, used as they are. Other tiles stay background, 0 and 0."""
        dtype, shape = self.records.dtype, (self.camera.height, self.camera.width)
        image, alpha, depth = np.empty((*shape, 3), dtype), np.empty(shape, dtype), np.empty(shape, dtype)
        self.draw_into(image, alpha, depth, colors)
        return image, alpha, depth

    def draw_into(
        self,
        image: np.ndarray,
        alpha: np.ndarray,
        depth: np.ndarray,
        colors: np.ndarray | None = None,
        profile: Profile = "inria",
    ) -> np.ndarray:
        """`draw` into given C-contiguous arrays. Returns [T] int64 where in `members` each drawn tile stopped, which
        the backward pass wants."""
        background = self._background()
        if len(self.tile_ids) < self.tiles.size:
            image[:], alpha[:], depth[:] = background, 0, 0
        ends = np.empty(len(self.tile_ids), np.int64)
        lists = (self._painted(colors), self.members, self.tile_ids, self.starts)
        run(raster.draw_tiles, *lists, background, image, alpha, depth, ends, _selector(profile))
        return ends

    def accumulate(self, values: np.ndarray, mask: np.ndarray, profile: Profile = "inria") -> Sums:
        """The adjoint of compositing over the drawn tiles, with w_ip = alpha_ip T_ip (0 below 1/255 and behind the
        stop). values: [H, W, 3]; mask: [H, W] weights m_p >= 0."""
        dtype = self.records.dtype
        sums = lanes.aligned((len(self.members), gather.SUMS), dtype)
        values, mask = lanes.readonly(values, dtype), lanes.readonly(mask, dtype)
        self._check(values, mask)
        run(gather.accumulate_tiles, *self.lists(self.records), values, mask, sums, _selector(profile))
        out = self._reduce(sums)
        return Sums(out[:, :3], out[:, 3], out[:, 4], out[:, 5])

    def residual_round(
        self, target: np.ndarray, mask: np.ndarray, colors: np.ndarray | None = None
    ) -> tuple[np.ndarray, float]:
        """One round of the lift, fused: draw with `colors` [M, 3], and return sum_p w_ip m_p (target_p - image_p)
        [M, 3] and sum_p m_p |target_p - image_p|^2 over pixels and channels. target: [H, W, 3]; mask: [H, W] >= 0.
        Costs time in proportion to the drawn tiles under the mask."""
        dtype = self.records.dtype
        sums, errors = lanes.aligned((len(self.members), gather.SUMS), dtype), np.empty(len(self.tile_ids), dtype)
        target, mask = lanes.readonly(target, dtype), lanes.readonly(mask, dtype)
        self._check(target, mask)
        run(gather.residual_tiles, *self.lists(self._painted(colors)), self._background(), target, mask, sums, errors)
        return self._reduce(sums)[:, :3], float(errors.sum(dtype=np.float64))

    def _painted(self, colors: np.ndarray | None) -> np.ndarray:
        if colors is None:
            return self.records
        assert colors.shape == (len(self), 3), f"colors: expected [{len(self)}, 3], got {colors.shape}"
        records = lanes.aligned(self.records.shape, self.records.dtype)
        records[:] = self.records
        records[:, lanes.RED : lanes.BLUE + 1] = colors
        return lanes.readonly(records, records.dtype)

    def lists(self, records: np.ndarray) -> tuple[np.ndarray, ...]:
        """What every kernel over tiles begins with."""
        return records, self.members, self.homes, self.tile_ids, self.starts

    def _background(self) -> np.ndarray:
        return lanes.readonly(np.array(self.camera.background), self.records.dtype)

    def _check(self, values: np.ndarray, mask: np.ndarray) -> None:
        shape = (self.camera.height, self.camera.width)
        assert values.shape == (*shape, 3) and mask.shape == shape, f"{values.shape}, {mask.shape}: picture is {shape}"

    def _reduce(self, sums: np.ndarray) -> np.ndarray:
        out = np.empty((len(self), 6), sums.dtype)
        run(gather.reduce_pairs, self.offsets, sums, out)
        return out


def tile_shape(camera: Camera) -> tuple[int, int]:
    """(TH, TW) tiles that cover a picture."""
    return -(-camera.height // TILE), -(-camera.width // TILE)


def tiles_of_mask(mask: np.ndarray) -> np.ndarray:
    """[TH, TW] bool: tiles in which a [H, W] mask has any pixel > 0."""
    height, width = mask.shape
    padded = np.zeros((-(-height // TILE) * TILE, -(-width // TILE) * TILE), bool)
    padded[:height, :width] = mask > 0
    return np.any(padded.reshape(padded.shape[0] // TILE, TILE, -1, TILE), axis=(1, 3))


def project(
    splats: Splats, camera: Camera, *, rows: np.ndarray | None = None, tiles: np.ndarray | None = None
) -> Frame:
    """Geometry of one view. splats: numpy attributes (float32; float64 works too). rows: [N] bool, only these exist.
    tiles: [TH, TW] bool, only these 16 x 16 tiles are drawn, and rows that miss them are dropped early."""
    dtype = np.dtype(splats.means.dtype)
    n, shape = len(splats), tile_shape(camera)
    tiles = np.ones(shape, bool) if tiles is None else np.asarray(tiles, bool)
    assert tiles.shape == shape, f"tiles: expected {shape}, got {tiles.shape}"
    assert rows is None or rows.shape == (n,), f"rows: expected [{n}] bool, got {rows}"
    tile_ids = np.flatnonzero(tiles).astype(np.int32)
    slots, grid, window = _layout(tiles, tile_ids, camera)
    attributes = [lanes.readonly(getattr(splats, name), dtype) for name in ATTRIBUTES]
    keep = lanes.readonly(np.empty(0, bool) if rows is None else rows, np.bool_)
    cam = geometry.camera_vector(camera, window, dtype)

    blocks = -(-n // projection.BLOCK)
    size = blocks * projection.BLOCK
    records, keys = lanes.aligned((size, lanes.RECORD), dtype), np.empty(size, dtype)
    (row, room), counts = np.empty((2, size), np.int32), np.empty(blocks, np.int32)
    if len(tile_ids) and n and np.abs(camera.position).max() <= MAX_MAGNITUDE:
        settings = (splats.sh_degree, keep, cam, bool(splats.antialiased), grid, slots)
        arguments = (*attributes, attributes[4].reshape(n, -1), *settings)
        run(projection.project_rows, *arguments, records, keys, row, room, counts)
    else:
        counts[:] = 0

    order = bins.depth_order(keys, counts)
    m = len(order)
    sorted_records, sorted_rows, sorted_room = lanes.aligned((m, lanes.RECORD), dtype), *np.empty((2, m), np.int32)
    run(bins.gather_records, order, records, row, room, sorted_records, sorted_rows, sorted_room)
    del records
    begins = np.cumsum(sorted_room, dtype=np.int64) - sorted_room

    room_in_all = int(sorted_room.sum(dtype=np.int64))
    if room_in_all > MAX_PAIRS:
        size = f"{camera.width} x {camera.height}"
        limit = f"rows that touch at most {MAX_PAIRS:,} tiles of {TILE} x {TILE} pixels in all"
        raise ValueError(f"render: expected {limit}, got {room_in_all:,} at {size}; render a smaller picture")
    ends, spots = np.empty(m, np.int64), np.empty(room_in_all, np.int32)
    histogram = np.zeros((threads(), len(tile_ids)), np.int64)
    run(bins.list_pairs, sorted_records, begins, sorted_room, grid, slots, ends, spots, histogram)
    offsets, starts = np.zeros(m + 1, np.int64), np.zeros(len(tile_ids) + 1, np.int64)
    np.cumsum(ends - begins, out=offsets[1:])
    np.cumsum(histogram.sum(0), out=starts[1:])
    first = np.cumsum(histogram, 0) - histogram + starts[:-1]
    members, homes = np.empty((2, int(starts[-1])), np.int32)
    run(bins.place_pairs, begins, ends, spots, offsets, first, members, homes)
    sealed = lanes.readonly(sorted_records, dtype)
    return Frame(camera, n, tiles, sorted_rows.astype(np.int64), sealed, offsets, members, homes, tile_ids, starts)


def _selector(profile: Profile) -> bool | None:
    """What kernels take for a profile; see raster.draw_tiles."""
    return None if profile == "inria" else True


def _layout(tiles: np.ndarray, tile_ids: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(slots, grid, window) as project_rows wants them, for the tiles in use."""
    height, width = tiles.shape
    if len(tile_ids) == tiles.size:
        empty = lanes.readonly(np.empty((0, 0)), np.int32)
        return empty, np.array([0, width, 0, height]), np.array([0, camera.width, 0, camera.height])
    slots = np.full(tiles.size, -1, np.int32)
    slots[tile_ids] = np.arange(len(tile_ids))
    across, down = np.flatnonzero(tiles.any(0)), np.flatnonzero(tiles.any(1))
    grid = np.array([across[0], across[-1] + 1, down[0], down[-1] + 1] if len(tile_ids) else [0, 0, 0, 0])
    edge = np.minimum(grid * TILE, [camera.width, camera.width, camera.height, camera.height])
    return lanes.readonly(slots.reshape(tiles.shape), np.int32), grid, edge
