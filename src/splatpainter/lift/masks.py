"""Which pixels of a returned picture were edited: the difference to the render, above what 8 bits and JPEG leave."""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run, threads
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class MaskThresholds:
    """When a pixel was edited, and when all of a picture was. In display values 0..1 unless said; measured on renders,
    painted renders and their JPEG and WebP copies where an entry says so, else taste."""

    max_rounding: float = 3.5 / 255
    """Differences up to here are rounding."""
    max_noise: float = 24 / 255
    """No picture is so noisy that larger differences are not edits."""
    max_lossless: float = 0.3 / 255
    """Where a picture has detail, JPEG even of quality 100 leaves a larger difference than this at all but one pixel in
    twenty."""
    max_exact: float = 1.5 / 255
    """Mean difference over 3 x 3 pixels up to which two pictures are one, decoded by two programs."""
    loss_reach_px: int = 8
    """Pixels around one in which the loss of an encoding is like its own: a block of JPEG."""
    max_loss_levels: float = 3.0
    """What is lost may exceed its mean level in that reach by this factor."""
    max_exact_loss_levels: float = 1.0
    """The same where the loss is known pixel by pixel."""
    min_loss: float = 0.5 / 255
    """Level of loss from which there is any."""
    min_exact_loss: float = 0.25
    """Share of those pixels that must be as expected for the loss to be known pixel by pixel."""
    detail_bins: int = 8
    """Levels of detail, each with its noise."""
    min_upper_change: float = 3.5 / 255
    """Upper quartile of the difference after averaging over 9 x 9 pixels: a faint drift of all colours is no detail."""
    min_smooth_share: float = 0.6
    """What averaging over 9 x 9 pixels leaves of the median difference, at least: noise averages out, other detail
    less."""
    min_smooth_share_large: float = 0.52
    """The least share where the median difference is large."""
    large_median_change: float = 4.4 / 255
    """Median difference that counts as large: larger than JPEG's mostly is."""
    rise: float = 1.1
    """Detail is added where contrast, a mean over 9 x 9 pixels, is this many times what it was."""
    min_risen_share: float = 0.75
    """Share of the asset's pixels where detail is added, from which all of the picture was made anew. JPEG takes detail
    away, or adds some to what is flat. Where the median difference is large, JPEG of quality 30 to 90 of renders and of
    painted renders has at most 0.60, close-ups of the truth whose change averages out 0.94 and more."""
    min_fine_share: float = 0.5
    """What averaging over 3 x 3 pixels leaves of the median difference, where detail is added: of noise it leaves a
    third."""


MASKS = MaskThresholds()


MIN_MEDIAN_CHANGE = 1.15 / 255
"""Median difference on the asset from which all of it may have changed; rounding leaves 0.7 / 255."""


def change_mask(edited: np.ndarray, render: np.ndarray) -> Bools:
    """[H, W] bool: pixels where `edited` differs from `render` (both [H, W, 3], 0..1) by more than the picture's noise.

    JPEG's noise grows with the detail around a pixel and is nil on a flat background: it is measured among pixels of
    like detail, in the quarter of them that agrees best. It averages out over 5x5 pixels, an edit does not. Lone specks
    are dropped, and what remains grows by one pixel (the soft rim of a stroke).

    Measured on four captures, 384 px, JPEG of quality 85 to 95: of a red rectangle nothing was missed, of a pale one
    (10 % opaque) up to 5 %; of the other pixels up to 0.5 % were taken for edits, without an edit up to 0.1 %."""
    return _change_mask(edited, render, largest_difference(edited, render))


def _change_mask(edited: np.ndarray, render: np.ndarray, apart: np.ndarray) -> Bools:
    """`change_mask`; apart: their `largest_difference`."""
    # Exact zeros for what is rounding, so that lossless pictures have a noise of 0.
    rounding = 0.51 / 255  # what rounding to 8 bits leaves
    difference = np.where(apart < rounding, apart.dtype.type(0), apart)
    near, detail = box_mean(difference, 1), contrast(np.clip(render, 0, 1))
    detailed = detail > 0.5 / 255
    # Lossless: where there is detail, some pixels agree exactly. JPEG leaves a little nearly everywhere.
    if _is_lossless(near, detailed):
        core = near > MASKS.max_rounding
    else:
        signed = np.clip(edited, 0, 1) - np.clip(render, 0, 1)
        signed[np.abs(signed) < rounding] = 0
        # JPEG: noise averages out over 5 x 5 pixels, an edit does not.
        shift = largest_channel(np.abs(box_mean(signed, 2)))
        noise = _noise(shift, box_mean(detail, 8))  # 17 x 17: the reach of JPEG's blocks
        core = (shift > np.clip(MASKS.max_rounding + 6 * noise, MASKS.max_rounding, MASKS.max_noise)) | (
            near > MASKS.max_noise
        )
    # Fewer than four set pixels of nine are a speck, not a stroke.
    core &= box_mean(core, 1) > 3.5 / 9
    # Grown by one pixel for the soft rim, but only where something differs at all.
    return (box_mean(core, 1) > 0.5 / 9) & (difference > MASKS.max_rounding)


def change_mask_beyond(edited: np.ndarray, render: np.ndarray, expected: np.ndarray) -> Bools:
    """[H, W] bool: as `change_mask`, of a picture that was stored with loss. expected: [H, W, 3] the render after the
    same loss: what differs from both of them by more than the loss does around it was edited.

    Averaged over 5 x 5 pixels, as there: what is lost averages out, up to a few times its level around a pixel. Where
    much of the picture is exactly as expected, the loss is known, and fainter paint is told from it."""
    before, lossy = np.clip(render, 0, 1), np.clip(expected, 0, 1)
    picture = np.clip(edited, 0, 1)
    # What the same loss did to the render says how much it may have done to the picture.
    level = box_mean(largest_channel(np.abs(box_mean(lossy - before, 2))), MASKS.loss_reach_px)
    near = box_mean(largest_channel(np.abs(picture - lossy)), 1)
    lost = level > MASKS.min_loss
    levels = (
        MASKS.max_loss_levels
        if not lost.any() or exact_share(near, lost) < MASKS.min_exact_loss
        else MASKS.max_exact_loss_levels
    )
    core = near > MASKS.max_rounding
    # Different from both: paint is neither what was rendered nor what the loss made of it.
    for base in (before, lossy):
        core &= largest_channel(np.abs(box_mean(picture - base, 2))) > MASKS.max_rounding + levels * level
    core &= box_mean(core, 1) > 3.5 / 9
    return (box_mean(core, 1) > 0.5 / 9) & (largest_channel(np.abs(picture - before)) > MASKS.max_rounding)


def exact_share(near: np.ndarray, region: np.ndarray) -> float:
    """Share of the pixels of a region, both [H, W], where the mean difference over 3 x 3 pixels is no more than what
    another decoder makes; 1 of an empty one."""
    return float((near <= MASKS.max_exact)[region].mean()) if region.any() else 1.0


def edited_mask(edited: np.ndarray, render: np.ndarray, alpha: np.ndarray) -> Bools:
    """[H, W] bool: what was edited in a picture without a mask: all of it where all that it shows of the asset changed
    (`changed_throughout`), else `change_mask`. Arguments as of these."""
    apart = largest_difference(edited, render)
    if _changed_throughout(edited, render, alpha, apart):
        return np.ones(alpha.shape, bool)
    return _change_mask(edited, render, apart)


def changed_throughout(edited: np.ndarray, render: np.ndarray, alpha: np.ndarray) -> bool:
    """Whether a picture differs from the render nearly everywhere on the asset, and by more than a camera's or JPEG's
    noise: it was sharpened, upscaled, relit or made anew, not painted on. edited, render: [H, W, 3]; alpha: [H, W].

    A change of colours lasts where it is averaged over 9 x 9 pixels; detail need not, but there is more of it. Of 18
    training meshes, fitted and sampled: all close-ups of the truth (without the second rule 72 %), no painted view as
    PNG, 2 % of them as JPEG of quality 50 to 90, no render as such JPEG or with noise."""
    return _changed_throughout(edited, render, alpha, largest_difference(edited, render))


def _changed_throughout(edited: np.ndarray, render: np.ndarray, alpha: np.ndarray, apart: np.ndarray) -> bool:
    """`changed_throughout`; apart: their `largest_difference`."""
    solid = alpha > 0.9
    # Counted first: most pictures changed in a part, and no order of all pixels has to be found for that.
    if 2 * np.count_nonzero(solid & (apart < MIN_MEDIAN_CHANGE)) > np.count_nonzero(solid) + 1:
        return False
    median = float(np.median(apart[solid])) if solid.any() else 0.0
    if median < MIN_MEDIAN_CHANGE:
        return False
    edited, render = np.clip(edited, 0, 1), np.clip(render, 0, 1)
    # A new look survives averaging; noise and compression do not.
    smooth = largest_channel(np.abs(box_mean(edited - render, 4)))[solid]
    share = MASKS.min_smooth_share if median < MASKS.large_median_change else MASKS.min_smooth_share_large
    if float(np.quantile(smooth, 0.75)) > MASKS.min_upper_change and float(np.median(smooth)) > share * median:
        return True
    return median >= MASKS.large_median_change and _more_detailed(edited, render, solid, median)


def _more_detailed(edited: np.ndarray, render: np.ndarray, solid: Bools, median: float) -> bool:
    """Whether a picture has more detail than the render nearly everywhere, and more than noise. solid: [H, W] bool the
    asset's pixels; median: of the difference there."""
    fine = float(np.median(largest_channel(np.abs(box_mean(edited - render, 1)))[solid]))
    before, after = (box_mean(contrast(image), 4)[solid] for image in (render, edited))
    return fine > MASKS.min_fine_share * median and float((after > MASKS.rise * before).mean()) >= MASKS.min_risen_share


def median_change(edited: np.ndarray, render: np.ndarray, alpha: np.ndarray) -> float:
    """Median over the asset's pixels of the largest difference of a channel; 0 where there is no asset. Arguments as of
    `changed_throughout`."""
    solid = alpha > 0.9
    if not solid.any():
        return 0.0
    return float(np.median(largest_difference(edited, render)[solid]))


def window_around(mask: np.ndarray, reach: int) -> tuple[slice, slice]:
    """Rows and columns of the rectangle of pixels within `reach` of a set one ([H, W] bool); none where none is set."""
    rows = np.flatnonzero(mask.any(1))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    columns = np.flatnonzero(mask[rows[0] : rows[-1] + 1].any(0))
    top, bottom, left, right = (int(at) for at in (rows[0], rows[-1], columns[0], columns[-1]))
    return slice(max(top - reach, 0), bottom + reach + 1), slice(max(left - reach, 0), right + reach + 1)


def dilated(mask: np.ndarray, reach: int) -> Bools:
    """[H, W] bool: pixels within `reach` of a set one along x and y."""
    out, window = mask.copy(), window_around(mask, reach)
    # Only around the set pixels; most masks are small.
    for axis in (0, 1):
        source, target = np.moveaxis(out[window].copy(), axis, 0), np.moveaxis(out[window], axis, 0)
        # Along one axis, then along the other: a square, in 2 reach steps an axis.
        for step in range(1, min(reach, len(source) - 1) + 1):
            target[step:] |= source[:-step]
            target[:-step] |= source[step:]
    return out


def paste(picture: np.ndarray, other: np.ndarray, mask: Bools) -> None:
    """Write the set pixels of a mask ([H, W] bool) of another picture to a C-contiguous one ([H, W, 3] both)."""
    at = np.flatnonzero(mask)
    # By rows of three numbers: numpy copies these much faster than it chooses among single ones.
    picture.reshape(-1, 3)[at] = other.reshape(-1, 3).take(at, 0)


def contrast(image: np.ndarray) -> np.ndarray:
    """[H, W] difference of each pixel's grey to its right and lower neighbours'."""
    # In one array: of large pictures each further one would be fresh pages, which the system clears first.
    grey = image[..., 0] + image[..., 1]
    grey += image[..., 2]
    grey *= np.asarray(1 / 3, image.dtype)
    out = np.empty(grey.shape, grey.dtype)
    run(kernels.measure_contrast, readonly(grey, grey.dtype), out)
    return out


def largest_difference(edited: np.ndarray, render: np.ndarray) -> np.ndarray:
    """[H, W] of the channel that differs most, of two pictures [H, W, 3] clipped to 0..1."""
    dtype = np.result_type(edited, render)
    out = np.empty(edited.shape[:2], dtype)
    run(kernels.compare_pictures, readonly(edited, dtype), readonly(render, dtype), out)
    return out


def _is_lossless(near: np.ndarray, detailed: Bools) -> bool:
    """Whether one pixel in twenty of those with detail ([H, W] bool) hardly differs. near: [H, W] differences."""
    count = np.count_nonzero(detailed)
    # Counted first, as the quantile, which lies between two of the values, needs an order of them.
    if np.count_nonzero(detailed & (near <= MASKS.max_lossless)) >= 0.05 * count + 2:
        return True
    return not count or bool(np.quantile(near[detailed], 0.05) <= MASKS.max_lossless)


def largest_channel(values: np.ndarray) -> np.ndarray:
    """[H, W, 3] -> [H, W]; numpy's own max over so short an axis is several times slower."""
    out = np.maximum(values[..., 0], values[..., 1])
    return np.maximum(out, values[..., 2], out=out)


def _noise(values: np.ndarray, detail: np.ndarray) -> np.ndarray:
    """[H, W]: the lower quartile of `values` [H, W] over the pixels of about the same detail; 0 where there is none."""
    # Bins of equal count, so that every level of detail has enough pixels for a quartile.
    busy = detail > 1e-4
    edges = np.quantile(detail[busy], np.linspace(0, 1, MASKS.detail_bins + 1)[1:-1])
    label = np.where(busy, 1 + np.searchsorted(edges, detail), 0)
    levels = [
        np.quantile(values[label == k], 0.25) if k and (label == k).any() else 0.0 for k in range(MASKS.detail_bins + 1)
    ]
    return np.array(levels)[label]


def box_mean(values: np.ndarray, radius: int) -> Floats:
    """[H, W, ...] float32 mean over the square of 2 radius + 1 around each pixel; edges are repeated."""
    pixels = readonly(values, np.float32)
    out = np.empty(pixels.shape, np.float32)
    if not out.size:
        return out
    height, width = pixels.shape[:2]
    channels = out.size // (height * width)
    space = np.empty((threads(), (width + 2 * radius) * channels), np.float32)
    flat = (height, width * channels)
    run(kernels.mean_over_boxes, pixels.reshape(flat), channels, radius, space, out.reshape(flat))
    return out
