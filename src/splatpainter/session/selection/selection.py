"""A selection of Gaussians: how much each is selected, 0..1. It belongs to the asset, not to a view. Pure.

Tools give weights, [N] float32 of the composed asset; `combined` joins them. A `Selection` is what stays of them when
layers come and go: weights of the original's Gaussians, which keep their places, and points with weights for all
others. `Selection.on` gives the weights of any later state: a Gaussian of the original that is where it was has its
own weight, every other one that of the nearest point. As bytes it is a grey PNG, for layers to name by its hash.

Spatial tools (grow, connected, floaters) are in selection_space.py.
"""

from __future__ import annotations

import struct
from dataclasses import field
from typing import Literal, get_args

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.color import base_color, to_display
from splatpainter.image_files import bytes_of_png, bytes_to_png
from splatpainter.rendering.pixel_shares import MEASURING_OPACITY, before_black, footprint_mean
from splatpainter.splats import Splats
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels.neighbours import nearest_within

Combine = Literal["replace", "add", "subtract", "intersect"]
Attribute = Literal["size", "opacity", "depth", "height"]


@dataclass(frozen=True)
class SelectionThresholds:
    """What a mark in a view selects, and where the search for it ends."""

    depth_margin_sizes: float = 3.0
    """Multiple of a Gaussian's largest scale by which it may lie behind the visible surface and be selected with it."""
    visible_share: float = 0.03
    """Share of a Gaussian's light that reaches the eye, from which it belongs to the visible surface."""
    covered_alpha: float = 0.05
    """Alpha of a pixel from which it shows the asset."""
    marked_share: float = 0.5
    """Share of a pixel that is selected, below which a Gaussian there is marked as a point."""
    max_marks: int = 4000
    """Points of a view."""
    snap_weight: float = 0.02
    """Weights within so much of 0 and 1 are 0 and 1."""
    stray_quantile: float = 0.01
    """Quantile of depths and heights, below and above which strays lie."""
    max_points: int = 1 << 22
    """Most points of a stored selection."""
    search_steps: int = 6
    """Radii in which the nearest point is looked for."""
    search_factor: float = 4.0
    """Factor from one of these to the next."""


SELECTING = SelectionThresholds()
MAGIC = b"SELE"


@dataclass(frozen=True)
class Selection:
    """Weights that outlive the layers over which they were chosen."""

    weights: np.ndarray
    """[N0] uint8 of the original's Gaussians."""
    points: np.ndarray = field(repr=False)
    """[R, 3] float32 where all other Gaussians lay, and those of the original that were moved."""
    point_weights: np.ndarray = field(repr=False)
    """[R] uint8."""

    @staticmethod
    def of(weights: np.ndarray, splats: Splats, original: Splats) -> Selection:
        """weights: [N] 0..1 of `splats`, an asset made from `original`."""
        # Those that moved are kept as points: their index may belong to another place later.
        levels = np.round(np.clip(weights, 0, 1) * 255).astype(np.uint8)
        moved = moved_ids(splats, original)
        first = levels[: len(original)].copy()
        first[moved[moved < len(original)]] = 0
        return Selection(first, splats.means[moved].astype(np.float32), levels[moved])

    def on(self, splats: Splats, original: Splats) -> np.ndarray:
        """[N] float32 weights of an asset made from `original`."""
        if len(self.weights) != len(original):
            raise ValueError(f"selection: expected one of {len(original)} Gaussians, got {len(self.weights)}")
        out = np.zeros(len(splats), np.uint8)
        count = min(len(original), len(splats))
        out[:count] = self.weights[:count]
        moved = moved_ids(splats, original)
        # Emptied Gaussians lie where they were and must not be selected by their neighbours.
        moved = moved[splats.opacities[moved] > 0]
        if len(moved):
            points = np.concatenate([original.means, self.points])
            levels = np.concatenate([self.weights, self.point_weights])
            near = nearest(points, splats.means[moved], spacing(original))
            out[moved] = np.where(near >= 0, levels[np.maximum(near, 0)], 0)
        return out.astype(np.float32) / 255

    def to_png(self) -> bytes:
        """A grey PNG whose pixels are the arrays, one after the other."""
        head = MAGIC + struct.pack("<QQ", len(self.weights), len(self.points))
        return bytes_to_png(
            head + self.weights.tobytes() + self.points.astype("<f4").tobytes() + self.point_weights.tobytes()
        )

    @staticmethod
    def from_png(data: bytes, count: int, where: str = "selection") -> Selection:
        """The inverse. count: Gaussians of the original. Raises ValueError naming `where`."""
        try:
            # Bounded by what it can be: the picture may be a stranger's.
            flat = np.frombuffer(bytes_of_png(data, 20 + count + 13 * SELECTING.max_points), np.uint8)
            if flat[:4].tobytes() != MAGIC:
                raise ValueError("it is another picture")
            first, rest = struct.unpack("<QQ", flat[4:20].tobytes())
            if first != count or not 0 <= rest <= SELECTING.max_points or 20 + first + 13 * rest > len(flat):
                raise ValueError(f"it is of {first} Gaussians and {rest} points")
        except (ValueError, struct.error) as error:
            raise ValueError(f"{where}: expected the selection of {count} Gaussians ({error})") from None
        ends = np.cumsum([20, first, 12 * rest, rest])
        points = np.frombuffer(flat[ends[1] : ends[2]].tobytes(), "<f4").reshape(-1, 3).astype(np.float32)
        if not np.isfinite(points).all():
            raise ValueError(f"{where}: expected finite points")
        return Selection(flat[ends[0] : ends[1]].copy(), points, flat[ends[2] : ends[3]].copy())


def moved_ids(splats: Splats, original: Splats) -> np.ndarray:
    """[M] int64 ascending: Gaussians that are not where the original has them: moved or appended."""
    count = min(len(original), len(splats))
    moved = np.flatnonzero((splats.means[:count] != original.means[:count]).any(1))
    return np.concatenate([moved, np.arange(count, len(splats))])


def nearest(points: np.ndarray, queries: np.ndarray, radius: float) -> np.ndarray:
    """[Q] int64 nearest point to each query, looked for farther and farther from `radius` on; -1: none at all."""
    out = np.full(len(queries), -1, np.int64)
    left = np.arange(len(queries))
    for _ in range(SELECTING.search_steps):
        out[left], _ = nearest_within(points, queries[left], radius)
        left = left[out[left] < 0]
        radius *= SELECTING.search_factor
        if not len(left):
            break
    return out


def spacing(splats: Splats) -> float:
    """World units: twice the median of the largest scales of what is visible, about how far neighbours are apart."""
    visible = splats.drawable & (splats.opacities > MEASURING_OPACITY)
    sizes = splats.scales[visible if visible.any() else slice(None)].max(1)
    return max(2 * float(np.median(sizes)), 1e-9) if len(sizes) else 1e-9


def combined(before: np.ndarray | None, new: np.ndarray, how: Combine) -> np.ndarray:
    """[N] float32: `new` weights applied to those before (None: nothing was selected)."""
    if how not in get_args(Combine):
        raise ValueError(f"selection: expected {', '.join(get_args(Combine))}, got {brief(how)}")
    before = np.zeros_like(new) if before is None else before
    joined = {
        "replace": new,
        "add": np.maximum(before, new),
        "subtract": before * (1 - new),
        "intersect": before * new,
    }[how]
    return snapped_weights(joined)


def snapped_weights(weights: np.ndarray) -> np.ndarray:
    """[N] float32 0..1 with what is nearly nothing and nearly all made so."""
    out = np.clip(weights, 0, 1).astype(np.float32)
    out[out < SELECTING.snap_weight] = 0
    out[out > 1 - SELECTING.snap_weight] = 1
    return out


def in_mask(splats: Splats, camera: Camera, mask: np.ndarray, through: bool = False) -> np.ndarray:
    """[N] float32: what a mask on a view selects: the mask's mean over each Gaussian's footprint, for those of the
    visible surface and right behind it, or (through) for all along the rays. mask: [H, W] 0..1."""
    from splatpainter.rendering.cpu.projected_view import project

    out = footprint_mean(splats, camera, mask)
    out[splats.opacities <= 0] = 0
    if through:
        return snapped_weights(out)
    real = project(splats, camera)
    _, alpha, depth = real.rasterize()
    # The visible surface first, then a margin behind it: a fitted surface is a cloud some Gaussians deep.
    sums = real.backproject(np.zeros((*mask.shape, 3), np.float32), np.ones(mask.shape, np.float32))
    visible_ids = real.gaussian_ids[sums.weight > SELECTING.visible_share * sums.alpha]
    hidden = out > 0
    hidden[visible_ids] = False
    ids = np.flatnonzero(hidden)
    pixels, z = camera.project(splats.means[ids].astype(np.float64))
    column = np.clip(np.nan_to_num(pixels[:, 0]), 0, camera.width - 1).astype(np.int64)
    line = np.clip(np.nan_to_num(pixels[:, 1]), 0, camera.height - 1).astype(np.int64)
    front = np.where(alpha[line, column] > SELECTING.covered_alpha, depth[line, column], np.inf)
    out[ids[z > front + SELECTING.depth_margin_sizes * splats.scales[ids].max(1)]] = 0
    return snapped_weights(out)


def by_color(
    splats: Splats, camera: Camera, color: np.ndarray, tolerance: float, everywhere: bool = True
) -> np.ndarray:
    """[N] float32 0 or 1: Gaussians that look like `color` ([3] display 0..1), no channel farther off than `tolerance`.
    One that the view shows looks as its pixels do; others (everywhere) as their base colour."""
    from splatpainter.rendering.cpu.projected_view import project

    view = project(splats, camera)
    image, _, _ = view.rasterize()
    seen = view.backproject(np.ascontiguousarray(image), np.ones(image.shape[:2], np.float32))
    in_view = seen.weight > 0.05 * seen.alpha + 1e-6
    # As pixels show it, where they do: base colours of shiny Gaussians are not what a user points at.
    looks = base_color(splats.sh)
    ids = view.gaussian_ids[in_view]
    looks[ids] = seen.values[in_view] / seen.weight[in_view, None]
    like = np.abs(to_display(np.clip(looks, 0, 1), splats.color_space) - color).max(1) <= tolerance
    if not everywhere:
        visible = np.zeros(len(splats), bool)
        visible[ids] = True
        like &= visible
    return (like & (splats.opacities > 0)).astype(np.float32)


def attribute_values(splats: Splats, attribute: Attribute, camera: Camera, up: np.ndarray) -> np.ndarray:
    """[N] float64 0..1: size: rank of the largest scale; opacity: itself; depth from the camera and height along `up`:
    share of the way from the nearest (lowest) to the farthest (highest), strays beside."""
    visible = splats.drawable & (splats.opacities > 0)
    if attribute == "opacity":
        return splats.opacities.astype(np.float64)
    if attribute == "size":
        out, sizes = np.zeros(len(splats)), splats.scales.max(1)
        ids = np.flatnonzero(visible)
        out[ids[np.argsort(sizes[ids], kind="stable")]] = (np.arange(len(ids)) + 1) / max(len(ids), 1)
        return out
    means = splats.means.astype(np.float64)
    raw = camera.project(means)[1] if attribute == "depth" else (means * np.asarray(up, np.float64)).sum(1)
    if not visible.any():
        return np.zeros(len(splats))
    # A few strays far off would push everything else to one end.
    low, high = np.quantile(raw[visible], [SELECTING.stray_quantile, 1 - SELECTING.stray_quantile])
    return np.clip((raw - low) / max(high - low, 1e-12), 0, 1)


def by_attribute(
    splats: Splats, attribute: Attribute, low: float, high: float, camera: Camera, up: np.ndarray
) -> np.ndarray:
    """[N] float32 0 or 1: Gaussians whose value (attribute_values) lies in low..high."""
    if attribute not in get_args(Attribute):
        raise ValueError(f"selection: expected {', '.join(get_args(Attribute))}, got {brief(attribute)}")
    values = attribute_values(splats, attribute, camera, up)
    return ((values >= low) & (values <= high) & splats.drawable & (splats.opacities > 0)).astype(np.float32)


def in_box(splats: Splats, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[N] float32 0 or 1: Gaussians whose means lie in a box along the world's axes. low, high: [3]."""
    inside = ((splats.means >= low) & (splats.means <= high)).all(1)
    return (inside & (splats.opacities > 0)).astype(np.float32)


def inverted(splats: Splats, weights: np.ndarray) -> np.ndarray:
    """[N] float32: the rest of what is visible."""
    return np.where(splats.opacities > 0, 1 - weights, 0).astype(np.float32)


def view_of(splats: Splats, weights: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W] float32 0..1: how much of what each pixel shows is selected; 0 beside the asset."""
    return _viewed(splats, weights, camera)[0]


def view_and_points(splats: Splats, weights: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(`view_of`, [M, 2] float32 pixels of selected Gaussians that it hardly shows, as they are too faint or too small,
    and that nothing covers). M: at most `max_marks`, evenly chosen."""
    shares, alpha, depth = _viewed(splats, weights, camera)
    ids = np.flatnonzero((weights >= 0.5) & splats.drawable & (splats.opacities > 0))
    pixels, z = camera.project(splats.means[ids].astype(np.float64))
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
    ids, pixels, z = ids[inside], pixels[inside], z[inside]
    column, line = pixels.astype(np.int64).T
    front = np.where(alpha[line, column] > SELECTING.covered_alpha, depth[line, column], np.inf)
    # What is covered stays unmarked: a point in front of it would seem to be of the surface.
    free = z < front + SELECTING.depth_margin_sizes * splats.scales[ids].max(1)
    points = pixels[free & (shares[line, column] < SELECTING.marked_share)].astype(np.float32)
    return shares, points[:: max(-(-len(points) // SELECTING.max_marks), 1)]


def _viewed(splats: Splats, weights: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(`view_of`, [H, W] alpha, [H, W] depth)."""
    view = before_black(splats, camera)
    selected = np.repeat(weights[view.gaussian_ids, None], 3, 1).astype(np.float32)
    image, alpha, depth = view.rasterize(np.ascontiguousarray(selected))
    shares = np.where(alpha > SELECTING.covered_alpha, np.clip(image[..., 0] / np.maximum(alpha, 1e-6), 0, 1), 0)
    return shares, alpha, depth
