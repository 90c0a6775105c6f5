"""Where a picture lies over the render that it was made from: framing, shift, scale and small rotation, below a pixel.

Three steps. Whole crops, in whole pixels (crop_search.py). Coarse turns and scales: normalised cross-correlation of
edges over a small grid of them. Then Gauss-Newton steps on a pyramid (Lucas and Kanade 1981, in the inverse form of
Baker and Matthews 2004), with Tukey's weights, so that what was painted over does not count, on brightness and edges
that are normalised by their surroundings, so that exposure does not either.
Pure. H, W: pixels of the render; colours are display sRGB 0..1; pixel centres at + 0.5.

    result = register(picture, render)
    aligned, inside = warped(picture, result.matrix, (width, height))
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator
from functools import reduce
from itertools import accumulate
from typing import Literal

import numpy as np

from splatpainter.gatekeeper.crop_search import find_crop
from splatpainter.kernels.portable import arctan2, cos, gram, hypot, matmul, sin, solved, transposed_product
from splatpainter.lift.masks import box_mean, largest_channel
from splatpainter.pictures.edit_files import MAX_ASPECT_ERROR
from splatpainter.pictures.picture_reader import resample
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class RegistrationThresholds:
    """Where a picture lies in its view. Source: taste, tried on services' pictures."""

    levels_px: tuple[int, ...] = (128, 256, 512)
    """Longer sides of the pyramid's pictures."""
    grid_px: int = 64
    """Longer side of the pictures on which turns and scales are searched."""
    grid_degrees: tuple[float, ...] = (-8.0, -6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0, 8.0)
    """Turns that are searched there, degrees."""
    sure_score: float = 0.8
    """Score from which the first answer is taken without looking further."""
    max_steps: int = 20
    """Gauss-Newton steps on one level."""
    still_px: float = 0.005
    """A step that moves no corner by more ends a level."""
    normal_radius_px: int = 4
    """Reach of the surroundings by which brightness and edges are normalised, pixels of a level."""
    min_contrast: float = 0.02
    """Added to the surroundings' deviation: flat parts say nothing."""
    tukey: float = 4.685
    """Standard deviations beyond which a pixel does not count (95 % efficient on normal noise)."""
    identity_px: float = 0.1
    """A picture whose corners moved by less, in pixels of the render, was not moved."""
    max_moved_ratio: float = 0.9
    """A picture was moved only where that leaves at most this part of 1 - score: a new style moves edges, too."""
    max_score_loss: float = 0.03
    """Fine steps may cost as much of a score: what was painted over agrees by chance."""
    score_px: int = 256
    """Longer side of the pictures that are scored."""
    score_block_px: int = 16
    """Side of a block there."""
    min_block_deviation: float = 0.008
    """Deviation of a block's edges, below which it has no texture."""
    min_blocks: int = 6
    """Blocks with texture that a score needs."""


REGISTRATION = RegistrationThresholds()


GRID_RATIO = 1.0378908155562134
"""The sixth root of 1.25: of a scale of the grid to the one before."""
GRID_SCALES = tuple(accumulate([0.8, *[GRID_RATIO] * 12], operator.mul))

FramingKind = Literal["full", "stretched", "cropped", "padded", "part"]
"""full: the picture shows what the render shows; stretched: too, at another aspect ratio; cropped: margins of the
render are missing; padded: the picture has margins of its own; part: a small window of the render."""


@dataclass(frozen=True)
class Registration:
    """Where a picture lies over a render."""

    matrix: np.ndarray
    """[2, 3] float64: point (x, y) of the render is at matrix @ (x, y, 1) in the picture; pixels of each."""
    framing: FramingKind
    scale: float
    """How much larger than its framing says the picture shows things; 1: not."""
    rotation: float
    """Degrees by which the picture is turned clockwise."""
    right: float
    """Pixels of the render by which its centre was moved in the picture."""
    down: float
    score: float
    """How well the edges agree, -1..1: their mean correlation over blocks of the picture that have any."""
    inside: bool = False
    """Whether the score had to look inside the mask, because nothing outside has texture."""

    def __post_init__(self) -> None:
        assert self.matrix.shape == (2, 3)

    def is_moved(self, width: int, height: int) -> bool:
        """Whether the picture of a render of this size was moved, turned or scaled within its framing."""
        reach = hypot(width, height) / 2
        turned = reach * max(abs(self.scale - 1), abs(math.radians(self.rotation)))
        return hypot(self.right, self.down) + turned >= REGISTRATION.identity_px

    def is_still(self, width: int, height: int) -> bool:
        """Whether the picture shows all of a render of this size, and that where it was."""
        return self.framing in ("full", "stretched") and not self.is_moved(width, height)

    @property
    def pixel_scale(self) -> float:
        """Pixels of the picture per pixel of the render."""
        return math.sqrt(abs(_determinant(self.matrix)))


def register(
    picture: np.ndarray,
    render: np.ndarray,
    weight: np.ndarray | None = None,
    valid: np.ndarray | None = None,
) -> Registration:
    """Find the render [H, W, 3] in the picture [h, w, 3], an edit of it of any size.

    weight: [H, W] 0..1, where the picture should still be as the render is (outside a mask); None: everywhere. valid:
    [h, w] 0..1, where the picture has content. Shifts and scales up to about a quarter and turns up to 10 degrees are
    looked for, and smaller windows of the render that are not turned."""
    # Most pictures come back nearly in place: a quick descent at the smallest size settles those.
    weight = np.ones(render.shape[:2], np.float32) if weight is None else weight.astype(np.float32)
    scorer = _Scorer(picture, render, weight, valid)
    best: Registration | None = None
    framings = _framings(picture.shape[:2], render.shape[:2])
    for kind, frame in framings:
        attempt = _refined(picture, render, weight, valid, frame, _NOT_MOVED, REGISTRATION.levels_px[:1])
        best = _better(best, scorer.scored(attempt, frame, kind))
    assert best is not None
    # The others: a grid of turns and scales, and windows that were cut out.
    if best.score < REGISTRATION.sure_score:
        for kind, frame in framings:
            start = _searched(picture, render, weight, valid, frame)
            attempt = _refined(picture, render, weight, valid, frame, start, REGISTRATION.levels_px[:1])
            best = _better(best, scorer.scored(attempt, frame, kind))
        crop = find_crop(np.clip(picture, 0, 1), np.clip(render, 0, 1))
        if crop is not None:
            frame = _frame(picture.shape[1] / crop.width, picture.shape[0] / crop.height, crop.x, crop.y)
            best = _better(best, scorer.scored(_NOT_MOVED, frame, "part"))
            if best.framing == "part":
                return best
    # The rest of the pyramid, from the best start alone.
    frame = next(frame for kind, frame in framings if kind == best.framing)
    start = matmul(inverse_map(frame), _square(best.matrix))
    final = scorer.scored(
        _refined(picture, render, weight, valid, frame, start, REGISTRATION.levels_px[1:]), frame, best.framing
    )
    # A move has to earn itself: a new style shifts edges a little without any motion.
    still = scorer.scored(_NOT_MOVED, frame, best.framing)
    final = final if final.score > best.score - REGISTRATION.max_score_loss else best
    gained = 1 - final.score < REGISTRATION.max_moved_ratio * (1 - still.score)
    return final if gained and not final.is_still(render.shape[1], render.shape[0]) else still


def small_motion(picture: np.ndarray, render: np.ndarray) -> np.ndarray | None:
    """[2, 3] how a picture [H, W, 3] of its render's size was moved, turned or scaled by a few pixels, as a
    Registration's matrix; None where the coarsest level of the pyramid sees no motion. Without a search and a score:
    what it says has to be judged."""
    frame = _frame(1, 1)
    weight = np.ones(render.shape[:2], np.float32)
    motion = _refined(picture, render, weight, None, frame, _NOT_MOVED, REGISTRATION.levels_px[:1])
    height, width = render.shape[:2]
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]).T
    moved = float(np.abs(matmul(motion - _NOT_MOVED, corners)).max())
    if moved * REGISTRATION.levels_px[0] / max(width, height) < REGISTRATION.still_px * 4:
        return None
    return _refined(picture, render, weight, None, frame, motion, REGISTRATION.levels_px[1:])[:2]


def warped(picture: np.ndarray, matrix: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """([H, W] or [H, W, C] what the picture [h, w] or [h, w, C], 0..1, shows at each pixel of a `size` = (W, H) render,
    [H, W] bool where it shows anything). matrix: of a Registration. Bicubic (Catmull and Rom), after Lanczos where it
    shrinks."""
    height, width = picture.shape[:2]
    shrink = math.sqrt(abs(_determinant(matrix)))
    # Point samples of a much larger picture would alias.
    if shrink > 1.25:
        small = max(1, round(width / shrink)), max(1, round(height / shrink))
        picture = resample(np.clip(picture, 0, 1), *small)
        matrix = np.array([[small[0] / width], [small[1] / height]]) * matrix
    values = np.clip(_sampled(picture, matrix, size, cubic=True), 0, 1)
    inside = _sampled(np.ones(picture.shape[:2], np.float32), matrix, size, cubic=False) > 0.999
    return values, inside


def _sampled(picture: np.ndarray, matrix: np.ndarray, size: tuple[int, int], cubic: bool) -> np.ndarray:
    """[H, W(, C)] float32 values at matrix @ pixel centres; 0 outside the picture."""
    from PIL import Image

    kind = Image.Resampling.BICUBIC if cubic else Image.Resampling.BILINEAR
    planes = picture[..., None] if picture.ndim == 2 else picture
    coefficients = tuple(matrix.ravel().tolist())
    out = [
        np.asarray(Image.fromarray(plane, "F").transform(size, Image.Transform.AFFINE, coefficients, kind))
        for plane in np.ascontiguousarray(np.moveaxis(planes, -1, 0), np.float32)
    ]
    return out[0] if picture.ndim == 2 else np.stack(out, -1)


def resampled_at(picture: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, C] float32 a picture [H, W, C] at each pixel's centre + shift [H, W, 2] (right, down, pixels), [H, W]
    bool where that is inside). Bilinear; beside the picture its rim goes on."""
    height, width = picture.shape[:2]
    y, x = np.mgrid[:height, :width]
    x, y = x + shift[..., 0], y + shift[..., 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    left, top = np.minimum(x.astype(int), max(width - 2, 0)), np.minimum(y.astype(int), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    across, down = (x - left).astype(np.float32)[..., None], (y - top).astype(np.float32)[..., None]
    upper = picture[top, left] * (1 - across) + picture[top, right] * across
    lower = picture[bottom, left] * (1 - across) + picture[bottom, right] * across
    return (upper * (1 - down) + lower * down).astype(np.float32), inside


_NOT_MOVED = np.eye(3)


def _square(matrix: np.ndarray) -> np.ndarray:
    return np.vstack([matrix, [0, 0, 1]])


def _product(*matrices: np.ndarray) -> np.ndarray:
    return reduce(matmul, matrices)


def _determinant(matrix: np.ndarray) -> float:
    return float(matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0])


def inverse_map(matrix: np.ndarray) -> np.ndarray:
    """[3, 3] of an affine map [2, 3] or [3, 3], of points (x, y, 1)."""
    (a, b, right), (c, d, down) = matrix[:2].tolist()
    determinant = a * d - b * c
    return np.array(
        [
            [d / determinant, -b / determinant, (b * down - d * right) / determinant],
            [-c / determinant, a / determinant, (c * right - a * down) / determinant],
            [0, 0, 1],
        ]
    )


def _frame(across: float, along: float, left: float = 0.0, top: float = 0.0) -> np.ndarray:
    """[2, 3] from pixels of the render to those of a picture that has across x along pixels for each, from (left, top)
    of the render on."""
    return np.array([[across, 0, -across * left], [0, along, -along * top]], np.float64)


def _framings(shape: tuple[int, ...], target: tuple[int, ...]) -> list[tuple[FramingKind, np.ndarray]]:
    """How a picture of `shape` (height, width) may show a render of another shape, likeliest first."""
    (height, width), (h, w) = shape, target
    across, along = width / w, height / h
    if abs(across / along - 1) <= MAX_ASPECT_ERROR or abs(width - along * w) <= 1:
        return [("full", _frame(across, along))]
    out: list[tuple[FramingKind, np.ndarray]] = []
    kinds: tuple[FramingKind, FramingKind] = ("cropped", "padded")
    for kind, scale in zip(kinds, (max(across, along), min(across, along)), strict=True):
        out.append((kind, _frame(scale, scale, (w - width / scale) / 2, (h - height / scale) / 2)))
    return [*out, ("stretched", _frame(across, along))]


def _better(one: Registration | None, other: Registration) -> Registration:
    return other if one is None or other.score > one.score else one


@dataclass(frozen=True)
class PyramidLevel:
    """Both pictures of the pyramid at one size, as features [.., .., 2]: normalised brightness and edges."""

    render: np.ndarray
    picture: np.ndarray
    weight: np.ndarray
    """[H, W] of the render."""
    valid: np.ndarray
    """[h, w] of the picture."""
    to_render: np.ndarray
    """[3, 3] from pixels of the full render to the level's."""
    to_picture: np.ndarray
    """[3, 3] likewise of the picture."""

    @staticmethod
    def of(
        picture: np.ndarray,
        render: np.ndarray,
        weight: np.ndarray,
        valid: np.ndarray | None,
        frame: np.ndarray,
        longer_px: int,
    ) -> PyramidLevel:
        (height, width), (h, w) = render.shape[:2], picture.shape[:2]
        shrink = max(max(height, width) / longer_px, 1.0)
        size = max(round(width / shrink), 1), max(round(height / shrink), 1)
        scales = frame[0, 0] * width / size[0], frame[1, 1] * height / size[1]
        small = max(round(w / scales[0]), 8), max(round(h / scales[1]), 8)
        content = np.ones((h, w), np.float32) if valid is None else valid.astype(np.float32)
        return PyramidLevel(
            _features(_resized(render, size)),
            _features(_resized(picture, small)),
            _resized(weight, size),
            _resized(content, small),
            np.diag([size[0] / width, size[1] / height, 1]),
            np.diag([small[0] / w, small[1] / h, 1]),
        )


def _resized(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    clipped = np.clip(values, 0, 1).astype(np.float32)
    return clipped if size == clipped.shape[1::-1] else resample(clipped, *size)


def _features(image: np.ndarray) -> np.ndarray:
    """[H, W, 2] brightness and edges, each less the mean of its surroundings and over their deviation."""
    edges = edge_strength(image)
    return np.stack([_normalised(image.mean(-1)), _normalised(box_mean(edges, 1))], -1)


def edge_strength(image: np.ndarray) -> np.ndarray:
    """[H, W] length of the gradient in the channel where it is steepest."""
    steps = hypot(np.gradient(image, axis=0), np.gradient(image, axis=1))
    return largest_channel(steps)


def _normalised(values: np.ndarray) -> np.ndarray:
    mean = box_mean(values, REGISTRATION.normal_radius_px)
    spread = np.sqrt(np.maximum(box_mean(values**2, REGISTRATION.normal_radius_px) - mean**2, 0))
    return (values - mean) / (spread + REGISTRATION.min_contrast)


def _refined(
    picture: np.ndarray,
    render: np.ndarray,
    weight: np.ndarray,
    valid: np.ndarray | None,
    frame: np.ndarray,
    start: np.ndarray,
    levels_px: tuple[int, ...],
) -> np.ndarray:
    """[3, 3] the similarity in the render's pixels that lies before `frame`, from `start` on."""
    motion = start
    for longer_px in levels_px:
        if longer_px > levels_px[0] and max(render.shape[:2]) <= longer_px / 2:
            break
        motion = _descended(PyramidLevel.of(picture, render, weight, valid, frame, longer_px), frame, motion)
    return motion


def _descended(level: PyramidLevel, frame: np.ndarray, motion: np.ndarray) -> np.ndarray:
    height, width = level.weight.shape
    target, reach = level.render, max(width, height) / 2
    y, x = np.mgrid[:height, :width] + 0.5
    x, y = x - width / 2, y - height / 2
    # Inverse form: the render's slopes do not change from step to step, only the picture is warped.
    slopes = []  # of each channel by (scale, turn, right, down); scale and turn in pixels at `reach`
    for channel in range(target.shape[2]):
        down, across = np.gradient(target[..., channel])
        slopes.append(np.stack([(across * x + down * y) / reach, (down * x - across * y) / reach, across, down], -1))
    strong = [(slope[..., 2:] ** 2).sum(-1) > 0.01 for slope in slopes]
    to_level = inverse_map(level.to_render)
    full = matmul(level.to_picture, _square(frame))
    rim = np.zeros((height, width), bool)
    rim[1:-1, 1:-1] = True
    for _ in range(REGISTRATION.max_steps):
        matrix = _product(full, motion, to_level)[:2]
        # Where the picture shows nothing, and at its rim, nothing can be compared.
        seen = _sampled(level.valid, matrix, (width, height), cubic=False) > 0.9
        trust = np.where(seen & rim, level.weight, 0)
        image = _sampled(level.picture, matrix, (width, height), cubic=False)
        normal, gain = np.zeros((4, 4)), np.zeros((4, 1))
        for channel, slope in enumerate(slopes):
            error = image[..., channel] - target[..., channel]
            steep = strong[channel] & (trust > 0.5)
            if steep.sum() < 32:
                continue
            # Scale from steep pixels: flat ones agree whatever the motion.
            spread = 1.4826 * float(np.median(np.abs(error[steep]))) + 1e-3
            share = trust * np.maximum(1 - (error / (REGISTRATION.tukey * spread)) ** 2, 0) ** 2 / spread**2
            flat = slope.reshape(-1, 4)
            normal += gram(flat, share.ravel())
            gain += transposed_product(flat, (share * error).reshape(-1, 1))
        if not np.trace(normal) > 0:
            break
        # A weak ridge where texture leaves a direction open, and a bound on a step from a bad start.
        step = solved(normal + 1e-6 * np.trace(normal) * np.eye(4), gain)[:, 0]
        step = np.clip(step, -8, 8)
        about = np.array([[1, 0, width / 2], [0, 1, height / 2], [0, 0, 1]], np.float64)
        grow, turn = step[0] / reach, step[1] / reach
        change = np.array([[1 + grow, -turn, step[2]], [turn, 1 + grow, step[3]], [0, 0, 1]])
        change = _product(about, change, inverse_map(about))
        # Composed inversely: the step was found on the render's side.
        motion = _product(motion, to_level, inverse_map(change), level.to_render)
        if np.abs(step).max() < REGISTRATION.still_px:
            break
    return motion


def _searched(
    picture: np.ndarray, render: np.ndarray, weight: np.ndarray, valid: np.ndarray | None, frame: np.ndarray
) -> np.ndarray:
    """[3, 3] the best similarity on a grid of scales and turns, its shift by correlation of the edges."""
    level = PyramidLevel.of(picture, render, weight, valid, frame, REGISTRATION.grid_px)
    height, width = level.weight.shape
    # Correlation over all shifts at once, by Fourier transform, for every turn and scale of the grid.
    target = np.maximum(level.render[..., 1], 0) * level.weight
    padded = (2 * height, 2 * width)
    spectrum = np.conj(np.fft.rfft2(target, padded))
    energy = np.conj(np.fft.rfft2(level.weight, padded))
    to_level, full = inverse_map(level.to_render), matmul(level.to_picture, _square(frame))
    best, motion = -math.inf, _NOT_MOVED
    for similarity in _grid(width, height):
        edges = np.maximum(
            _sampled(level.picture[..., 1], _product(full, to_level, similarity)[:2], (width, height), False), 0
        )
        # correlation over shifts of the picture: sum_p target(p) edges(p + shift) / its length under the weight
        product = np.fft.irfft2(np.fft.rfft2(edges, padded) * spectrum, padded)
        length = np.sqrt(np.maximum(np.fft.irfft2(np.fft.rfft2(edges**2, padded) * energy, padded), 1e-6))
        # Damped where there are few edges, or an empty corner would score best.
        scores = product / (length + 0.25 * length.max())
        down, right = np.unravel_index(int(scores.argmax()), scores.shape)
        if scores[down, right] > best:
            best = float(scores[down, right])
            down, right = (v - 2 * size if v > size else v for v, size in ((down, height), (right, width)))
            shift = np.array([[1, 0, right], [0, 1, down], [0, 0, 1]], np.float64)
            motion = _product(to_level, similarity, shift, level.to_render)
    return motion


def _grid(width: int, height: int) -> Iterator[np.ndarray]:
    """[3, 3] scales and turns about the centre of a picture."""
    about = np.array([[1, 0, width / 2], [0, 1, height / 2], [0, 0, 1]], np.float64)
    for scale in GRID_SCALES:
        for degrees in REGISTRATION.grid_degrees:
            sine, cosine = (scale * of(math.radians(degrees)) for of in (sin, cos))
            turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
            yield _product(about, turn, inverse_map(about))


def _block_shares(mask: np.ndarray) -> np.ndarray:
    """Share of True pixels of each block of REGISTRATION.score_block_px, those at the right and the lower border
    smaller."""
    starts = [np.arange(0, size, REGISTRATION.score_block_px) for size in mask.shape]
    counts, areas = (
        np.add.reduceat(np.add.reduceat(values, starts[0], 0, np.int64), starts[1], 1)
        for values in (mask, np.ones_like(mask))
    )
    return counts / areas


class _Scorer:
    """Judges where a picture was said to lie, by the edges of both."""

    def __init__(self, picture: np.ndarray, render: np.ndarray, weight: np.ndarray, valid: np.ndarray | None) -> None:
        height, width = render.shape[:2]
        shrink = max(max(height, width) / REGISTRATION.score_px, 1.0)
        self.size = max(round(width / shrink), 1), max(round(height / shrink), 1)
        self.to_full = np.diag([width / self.size[0], height / self.size[1], 1])
        self.center = np.array([width / 2, height / 2, 1.0])
        self.picture = np.clip(picture, 0, 1)
        self.valid = valid
        self.edges = box_mean(edge_strength(_resized(render, self.size)), 1)
        outside = _resized(weight, self.size) > 0.5
        self.blocks = self._blocks(outside)
        # Nothing outside the mask has texture: then look inside, and say so.
        self.inside = len(self.blocks) < REGISTRATION.min_blocks
        if self.inside:
            self.blocks = self._blocks(np.ones_like(outside))
        self.counted = np.ones_like(outside) if self.inside else outside

    def _blocks(self, counted: np.ndarray) -> list[tuple[slice, slice]]:
        """Those with texture, half of which counts at least."""
        out = []
        for down, across in np.argwhere(_block_shares(counted) > 0.5) * REGISTRATION.score_block_px:
            block = slice(down, down + REGISTRATION.score_block_px), slice(across, across + REGISTRATION.score_block_px)
            if self.edges[block].std() > REGISTRATION.min_block_deviation:
                out.append(block)
        return out

    def scored(self, motion: np.ndarray, frame: np.ndarray, framing: FramingKind) -> Registration:
        matrix = matmul(_square(frame), motion)[:2]
        image, inside = warped(self.picture, matmul(_square(matrix), self.to_full)[:2], self.size)
        content = np.ones_like(inside)
        if self.valid is not None:
            content = warped(self.valid, matmul(_square(matrix), self.to_full)[:2], self.size)[0] > 0.9
        edges = box_mean(edge_strength(image), 1)
        usable, scores = self.counted & inside & content, []
        empty, used = _block_shares(inside & ~content), _block_shares(usable)
        for block in self.blocks:
            at = block[0].start // REGISTRATION.score_block_px, block[1].start // REGISTRATION.score_block_px
            if empty[at] > 0.5:  # says nothing, neither good nor bad
                continue
            # A block that the motion pushed out of sight counts against it.
            if used[at] < 0.4:
                scores.append(0.0)
                continue
            use = usable[block]
            one, other = self.edges[block][use], edges[block][use]
            one, other = one - one.mean(), other - other.mean()
            scores.append(float((one * other).sum() / max(math.sqrt((one**2).sum() * (other**2).sum()), 1e-9)))
        moved = matmul(motion, self.center[:, None])[:, 0] - self.center
        scale = math.sqrt(abs(_determinant(motion)))
        turn = math.degrees(arctan2(motion[1, 0], motion[0, 0]))
        return Registration(
            matrix,
            framing,
            scale,
            turn,
            float(moved[0]),
            float(moved[1]),
            float(np.mean(scores)) if scores else 0.0,
            self.inside,
        )
