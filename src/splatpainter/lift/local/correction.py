"""What paint looks like from beside: a learnt correction of the colours that the lift gave.

An edited picture leaves freedom: Gaussians of which it shows little, and several that share a pixel, may have other
colours without its looking otherwise. A network of some thousand weights that has seen painted objects from their other
sides says of each Gaussian how much of the colours at hand to mix in: the picture's over it and around it, its own
before. Then SIRT steps pull all of them towards the picture, until it is reached as nearly as it was.

scripts/calibrate/lift_correction.py trains the weights; docs/ADAPTATION.md says what they are worth. J Gaussians that
an edit may change and its view shows. The same bits on every machine.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import field
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera
from splatpainter.kernels import portable
from splatpainter.kernels.rows import by_blocks
from splatpainter.lift.colors import MAX_COLOR
from splatpainter.lift.local.evidence import footprints
from splatpainter.lift.masks import box_mean, contrast, dilated
from splatpainter.rendering.cpu.geometry import TILE
from splatpainter.rendering.cpu.projected_view import MaskSums, ProjectedView
from splatpainter.rendering.cpu.sirt import CachedWeights, UncachedWeights
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import quat_to_matrix, row_max, row_norm

WEIGHTS = "correction.json"
HOLD = 0.1
"""Pixels' worth of weight that the correction has in the steps towards the picture, and of each pixel's worth of a
Gaussian that the view hides."""
MAX_STEPS = 6
"""Steps towards the picture at most; two do, as a rule."""
FADING = 0.3
"""Share of this weight that is left after each step. Without it colours that a capture's picture contradicts stay, and
taking back a share of all that was corrected leaves views from beside +0.1 dB in place of +0.3."""
RIM_PX, WEIGHT_BEYOND = 3, 0.1
"""Pixels around the paint that count in these steps as it does, and what those beyond count. All alike, the paint of
captures comes out 0.3 dB farther from its picture, as pixels beyond it come nearer."""
LEAST_SHARED = 1e-3
"""Pixels' worth of weight below which a Gaussian takes no step."""
MIN_OPACITY = 0.02
"""Fainter Gaussians are not corrected."""
SOLID_ALPHA = 0.5
"""Pixels that the asset covers by more show its surface."""
VISIBLE_MARGIN = 0.01
"""Pixels' worth, added to how much the paint shows of a Gaussian before the logarithm."""
BEHIND_PX = 8.0
"""Bound of the distance behind the drawn depth, in pixels' widths there."""
AROUND_PX, PAINT_PX = (1, 2), 3
"""Radii of the squares over which pictures are meant, pixels."""
MAX_DEVIATIONS = 5.0
"""Facts are bounded by this many standard deviations."""
FACTS = 20
"""Numbers that the network is told of a Gaussian."""
COLORS = 5
"""Colours at hand."""
GAUSSIANS_PER_CHUNK = 1 << 12
"""Gaussians that pass through the network at once: few enough for the caches."""


@dataclass(frozen=True)
class PaintedPictures:
    """The edited view, in the tiles in work."""

    target: Floats = field(repr=False)
    """[H, W, 3] the picture to reach: the paint, and beside it what there was."""
    mask: Bools = field(repr=False)
    """[H, W] bool painted pixels."""
    alpha: Floats = field(repr=False)
    """[H, W] before the edit."""
    depth: Floats = field(repr=False)
    """[H, W] expected z-depth before the edit."""

    @property
    def weights(self) -> Floats:
        """[H, W] float32 what each pixel counts in the steps towards the picture."""
        return np.where(dilated(self.mask, RIM_PX), 1, WEIGHT_BEYOND).astype(np.float32)


@dataclass(frozen=True)
class LiftedGaussians:
    """The J Gaussians of an edit in its view, as the lift left them."""

    view: ProjectedView
    """Of them and of what is around them, at least all tiles that they touch."""
    entries: Ids = field(repr=False)
    """[J] int64 ascending entries of the view."""
    facing: Floats = field(repr=False)
    """[J] of `facing`."""
    sums: MaskSums = field(repr=False)
    """How much of each the view's pixels show."""
    colors: Floats = field(repr=False)
    """[J, 3] towards the view, by the lift."""
    before: Floats = field(repr=False)
    """[J, 3] towards the view before the edit, of what each is or was split from."""
    fresh: Bools = field(repr=False)
    """[J] bool: appended, or in the place of another."""
    pictures: PaintedPictures

    def corrected(self, weights: CorrectionWeights, steps: CachedWeights | UncachedWeights) -> Floats:
        """[J, 3] float32 their colours towards the view. steps: of the J, towards the picture."""
        change = weights.change(*self.facts())
        change[self.view.opacities[self.entries] <= MIN_OPACITY] = 0
        return _held(self.colors, self.colors + change, steps, self.hold())

    def hold(self) -> Floats:
        """[J] float32 pixels' worth of weight that the correction has in the steps."""
        hidden = np.maximum(footprints(self.view, self.entries) - self.sums.weight, 0)
        return (HOLD + HOLD * hidden).astype(np.float32)

    def facts(self) -> tuple[Floats, Floats]:
        """([J, FACTS] float32, [J, COLORS, 3] float32 what the colours at hand differ by from theirs)."""
        view, at, (height, width) = self.view, self.entries, self.pictures.mask.shape
        target, alpha, depth = self.pictures.target, self.pictures.alpha, self.pictures.depth
        visible, peak, alpha_sum = self.sums.weight, self.sums.peak, self.sums.alpha
        footprint = footprints(view, at)

        # Where each lies in the view, and how it faces it.
        means2d, depths, opacities = view.means2d[at], view.depths[at], view.opacities[at]
        outside = ((means2d < 0) | (means2d >= (width, height))).any(1)
        x = np.clip(means2d[:, 0], 0, width - 1).astype(np.int64)
        y = np.clip(means2d[:, 1], 0, height - 1).astype(np.int64)
        widths = _ellipse_widths(view.conics[at])
        solid = alpha > SOLID_ALPHA
        pixel = np.maximum(depths, 1e-6) / view.camera.fy  # its width there
        behind = np.where(solid[y, x], np.clip((depths - depth[y, x]) / pixel / BEHIND_PX, -1, 1), 0)

        # The picture around that place, in a window of it.
        rows, columns = _window(view.tiles)
        part = np.asarray(target[rows, columns], np.float32)
        surface, paint = solid[rows, columns], self.pictures.mask[rows, columns]
        v, u = y - rows.start, x - columns.start
        # Each colour goes to its place at once: here an edit needs the most memory.
        colors = np.empty((len(at), COLORS, 3), np.float32)
        colors[:, 0], mask = part[v, u], paint.astype(np.float32)
        colors[:, 1], _ = _mean_around(part, surface, v, u, AROUND_PX[0])
        colors[:, 2], surface_share = _mean_around(part, surface, v, u, AROUND_PX[1])
        of_paint, share = _mean_around(part, surface & paint, v, u, PAINT_PX)
        colors[:, 3] = np.where((share > 1e-4)[:, None], of_paint, colors[:, 2])
        del of_paint, share
        colors[:, 4] = self.before
        colors -= self.colors[:, None]
        near = [box_mean(mask, radius)[v, u] for radius in (AROUND_PX[0], PAINT_PX)]
        # How busy the picture is there, and how steep the surface.
        detail = box_mean(contrast(part), AROUND_PX[1])[v, u]
        slope = box_mean(_steps(depth[rows, columns], surface), AROUND_PX[1])[v, u] / pixel
        painted, covered = mask[v, u], alpha[y, x]
        del mask, part, surface, paint, solid, v, u, x, y

        # In double precision one by one, not all at once.
        log, numbers = portable.log, iter(range(FACTS))
        facts = np.empty((len(at), FACTS), np.float32)

        def put(*columns: Any) -> None:
            for column in columns:
                facts[:, next(numbers)] = column

        put(*(log(np.clip(w, 1e-2, 1e3)) / 4 for w in widths))
        put(self.facing, behind, 2 * opacities - 1, log(peak + np.float32(1e-3)) / 5)
        put(np.minimum(visible / np.maximum(footprint, 1e-6), 1), visible / np.maximum(alpha_sum, 1e-6))
        put(log(visible + np.float32(VISIBLE_MARGIN)) / 5, painted, *near, covered)
        put(surface_share, log(1 + slope) / 4, 4 * detail, self.fresh, outside)
        put(row_max(np.abs(colors[:, 4])), row_max(np.abs(colors[:, 0])))
        return facts, colors


@dataclass(frozen=True)
class CorrectionWeights:
    """The network: facts to shares of the colours at hand."""

    tensors: Mapping[str, np.ndarray] = field(repr=False)
    """Name in the trained module's `state_dict()` -> float32."""

    @staticmethod
    def read(text: str) -> CorrectionWeights:
        """text: JSON, name -> nested lists."""
        return CorrectionWeights({name: np.array(values, np.float32) for name, values in json.loads(text).items()})

    def change(self, facts: Floats, colors: Floats) -> Floats:
        """[J, 3] float32. facts: [J, FACTS] float32; colors: [J, COLORS, 3] float32 differences."""
        # What kind of asset and edit this is, all Gaussians hear.
        chunks = [slice(at, at + GAUSSIANS_PER_CHUNK) for at in range(0, len(facts), GAUSSIANS_PER_CHUNK)]
        total = np.zeros(facts.shape[1])
        for part in chunks:
            scaled = self._scaled(facts[part])
            total += portable.transposed_product(scaled, np.ones((len(scaled), 1)))[:, 0]
        heard = self._linear("company", (total / max(len(facts), 1)).astype(np.float32)[None])
        out = np.empty((len(facts), 3), np.float32)
        for part in chunks:
            x = portable.silu(self._linear("first", self._scaled(facts[part])) + heard)
            for layer in ("second", "third"):
                x = portable.silu(self._linear(layer, x))
            shares = self._linear("shares", x)
            mixed = shares[:, :1] * colors[part, 0]
            for k in range(1, COLORS):
                mixed += shares[:, k : k + 1] * colors[part, k]
            out[part] = mixed
        return out

    def _scaled(self, facts: Floats) -> Floats:
        mean, deviation = self.tensors["scaling"]
        return np.clip((facts - mean) / deviation, -MAX_DEVIATIONS, MAX_DEVIATIONS)

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return portable.matmul(x, self.tensors[f"{name}.weight"].T) + self.tensors[f"{name}.bias"]


def facing(splats: Splats, ids: Ids, camera: Camera) -> Floats:
    """[J] float32 cosine between the shortest axis of some Gaussians and the line of sight, 0..1."""
    out = np.empty(len(ids), np.float32)

    def fill(block: slice) -> None:
        some = ids[block]
        axes = quat_to_matrix(splats.quats[some])
        normals = axes[np.arange(len(some)), :, splats.scales[some].argmin(1)]
        towards = camera.position - splats.means[some].astype(np.float64)
        out[block] = np.abs((normals * towards).sum(1) / np.maximum(row_norm(towards), 1e-12))

    by_blocks(fill, len(ids))
    return out


@cache
def digest() -> str:
    """SHA-256 of the weights' file."""
    return hashlib.sha256(_text().encode()).hexdigest()


@cache
def weights() -> CorrectionWeights:
    """Those that training left (scripts/calibrate/lift_correction.py)."""
    return CorrectionWeights.read(_text())


def _text() -> str:
    return files("splatpainter.lift.local").joinpath(WEIGHTS).read_text(encoding="utf-8")


def _held(lift: Floats, corrected: Floats, steps: CachedWeights | UncachedWeights, hold: Floats) -> Floats:
    """[J, 3] corrected colours, moved towards the picture until its squared error is no larger than with the lift's.
    lift, corrected: [J, 3]; hold: [J] what the correction weighs beside the pixels."""
    ceiling = np.maximum(lift, MAX_COLOR)
    first = colors = np.clip(corrected, 0, ceiling)
    gain_of_lift, gain = steps.residual(lift), steps.residual(colors)
    # What is drawn beside the J does not move, so their steps may be as long as they alone allow.
    shared = (gain_of_lift - steps.residual(lift + np.float32(1)))[:, :1]
    excess, pull = _rise(lift, colors, gain_of_lift, gain), hold[:, None]
    for _ in range(MAX_STEPS):
        if excess <= 0:
            return colors
        step = np.where(shared > LEAST_SHARED, 1 / np.maximum(shared + pull, 1e-6), 0).astype(colors.dtype)
        following = np.clip(colors + step * (gain - pull * (colors - first)), 0, ceiling)
        next_gain = steps.residual(following)
        left = _rise(lift, following, gain_of_lift, next_gain)
        if left <= 0:
            # Only as far as it must: the error along the way is a parabola, of which three numbers are known.
            slope = -2 * portable.dot(gain.ravel().astype(np.float64), (following - colors).ravel().astype(np.float64))
            share = halfway(first_root(left - excess - slope, slope, excess))
            return colors + np.float32(share) * (following - colors)
        colors, gain, excess, pull = following, next_gain, left, np.float32(FADING) * pull
    slope = -2 * portable.dot(gain_of_lift.ravel().astype(np.float64), (colors - lift).ravel().astype(np.float64))
    return lift + np.float32(borne(excess, slope)) * (colors - lift)


def halfway(share: float) -> float:
    """Of a step after a share of which the picture is as near as with the lift: halfway from there to its end."""
    return (1 + share) / 2


def borne(excess: float, slope: float) -> float:
    """Share of a change that the picture bears, by how much it raises the error, > 0, and by the slope of that where it
    begins: the lift is not where the picture is nearest, so error falls at first, and is as high again at twice that
    place. Halfway between these two."""
    return 1.5 * min(-slope / (2 * (excess - slope)), 0.5) if slope < 0 else 0.0


def _rise(lift: Floats, colors: Floats, gain_of_lift: Floats, gain: Floats) -> float:
    """By how much the squared error of the picture is larger with these colours than with the lift's. gain...: [J, 3]
    what pixels ask for, sum_p w_ip (target - picture), with either: the error is quadratic, so they say it all."""
    both = (gain_of_lift + gain).ravel().astype(np.float64)
    return -portable.dot(both, (colors - lift).ravel().astype(np.float64))


def first_root(a: float, b: float, c: float) -> float:
    """The first s in 0..1 at which a s^2 + b s + c is 0, of one that is positive at 0 and not at 1."""
    if abs(a) < 1e-12 * abs(b):
        return min(-c / b, 1.0)
    return min(max(2 * c / (-b + math.sqrt(max(b * b - 4 * a * c, 0.0))), 0.0), 1.0)


def _ellipse_widths(conics: Floats) -> tuple[Floats, Floats]:
    """([J], [J]) longer and shorter standard deviation, pixels, of conics [J, 3]."""
    a, b, c = conics.astype(np.float64).T
    middle, reach = (a + c) / 2, np.sqrt(((a - c) / 2) ** 2 + b * b)
    return 1 / np.sqrt(np.maximum(middle - reach, 1e-9)), 1 / np.sqrt(np.maximum(middle + reach, 1e-9))


def _window(tiles: Bools) -> tuple[slice, slice]:
    """Rows and columns of the pixels of some tiles."""
    rows, columns = (np.flatnonzero(tiles.any(axis)) for axis in (1, 0))
    down, across = (slice(TILE * int(at[0]), TILE * int(at[-1] + 1)) for at in (rows, columns))
    return down, across


def _steps(depth: Floats, solid: Bools) -> Floats:
    """[H, W] by how much depth differs from that of the right and the lower neighbour, where both show the surface."""
    out = np.zeros(depth.shape, np.float32)
    for near, seen, steps in ((depth, solid, out), (depth.T, solid.T, out.T)):
        steps[:-1] += np.abs(near[1:] - near[:-1]) * (seen[1:] & seen[:-1])
    return out


def _mean_around(picture: Floats, where: Bools, y: Ids, x: Ids, radius: int) -> tuple[Floats, Floats]:
    """([J, 3] mean of the pixels `where` within `radius` of places, 0 without any, [J] their share)."""
    counted = where.astype(np.float32)
    share, out = box_mean(counted, radius)[y, x], np.empty((len(y), 3), np.float32)
    # Channel after channel: three pictures at once are three times the memory.
    for channel in range(3):
        out[:, channel] = box_mean(picture[..., channel] * counted, radius)[y, x]
    return out / np.maximum(share, np.float32(1e-6))[:, None], share
