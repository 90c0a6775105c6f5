"""The inside of a hole in a picture, made of patches of what surrounds it: PatchMatch (Barnes et al., SIGGRAPH 2009) in
the multi-scale completion of Wexler, Shechtman and Irani (PAMI 2007). Vectorised over pixels; no order of pixels, and
one seed: equal inputs give equal bits.

What wide light and shade do is no texture: patches are compared and copied without the tone, a membrane through the
blurred surroundings, which is added back.
"""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.holes.smooth_surface import membrane
from splatpainter.kernels import portable
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class TextureThresholds:
    """Patches that continue a texture (Wexler, Shechtman and Irani 2007; PatchMatch, Barnes et al. 2009). Source:
    taste."""

    patch_px: int = 7
    """Side of a patch, pixels, odd."""
    min_level_px: int = 24
    """Shorter side of the bounding box of a hole that is not halved again."""
    vote_spread_px: float = 1.2
    """Standard deviation, pixels, of the weights of the patches over a pixel."""
    last_vote_spread_px: float = 0.6
    """The same in the last round, in which the middles of patches count for most: that keeps the grain."""
    level_rounds: tuple[int, int] = (4, 14)
    """Rounds of matching and voting: on all levels but the coarsest, on that."""
    propagation_steps_px: tuple[int, int] = (1, 4)
    """Pixels from which neighbours' matches are tried."""
    tone_share: float = 0.35
    """Width of the blur that makes the tone, in square roots of the hole's area."""
    seed: int = 7
    """Of the random numbers with which matches start: equal holes are filled alike."""
    tone_copied: float = 0.6
    """Share of the tone that is copied with patches; the rest is the membrane's."""
    cleaning_px: int = 2
    """Reach of the blur that replaces what is not clean."""
    depth_weight_base: float = 1.3
    """Each pixel deeper in the hole counts for so much less."""


TEXTURE = TextureThresholds()


TONE_VOTE = 2.0 * TEXTURE.patch_px**2
"""Weight of the difference of tones beside those of a patch's pixels."""


def complete(picture: np.ndarray, valid: np.ndarray, clean: np.ndarray, hole: Bools) -> Floats:
    """[H, W, 3] float32 the picture with its hole filled from what is valid; of that, what is not clean (shows
    something behind it) is first made of what is around it. valid, clean, hole: [H, W] bool."""
    valid = valid & ~hole
    clean = clean & valid
    picture = np.clip(picture, 0, 1).astype(np.float32)
    if clean.any():
        # Soft borders show what is behind them: their colours are taken from clean neighbours.
        near = _blurred(picture, clean, TEXTURE.cleaning_px)
        picture = np.where((valid & ~clean)[..., None], near, picture).astype(np.float32)
    # Light and shade are continued smoothly, texture by patches; a part of the tone travels with the patches.
    tone = tone_of(picture, valid, hole)
    base = (1 - TEXTURE.tone_copied) * tone
    part = np.where(valid[..., None], picture - base, 0).astype(np.float32)
    completed = base + _completed(part, tone, valid, hole, np.random.default_rng(TEXTURE.seed))
    out = picture.copy()
    out[hole] = np.clip(completed[hole], 0, 1)
    return out


def _blurred(picture: np.ndarray, weight: np.ndarray, width: int) -> np.ndarray:
    """[H, W, 3] weighted means, by two box filters; where no pixel counts, of the border of what does."""
    weights = weight.astype(np.float64)[..., None]
    sums = np.concatenate([picture * weights, weights], 2)
    for _ in range(2):
        for axis in (0, 1):
            sums = _box(sums, width, axis)
    return membrane(sums[..., :3] / np.maximum(sums[..., 3:], 1e-9), sums[..., 3] < 1e-9)


def tone_of(picture: np.ndarray, valid: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """[H, W, 3] what is left of a picture without its texture; in the hole it is continued from the rim."""
    width = max(int(TEXTURE.tone_share * np.sqrt(hole.sum())), 2)
    valid = valid & ~hole
    return membrane(_blurred(picture, valid, width), ~valid)


def _box(values: np.ndarray, reach: int, axis: int) -> np.ndarray:
    """Means over 2 reach + 1 pixels along an axis, zeros beyond the edge."""
    pad = [(0, 0)] * values.ndim
    pad[axis] = (reach + 1, reach)
    total = np.cumsum(np.pad(values, pad), axis)
    length = values.shape[axis]
    upper = np.take(total, np.arange(2 * reach + 1, 2 * reach + 1 + length), axis)
    return (upper - np.take(total, np.arange(length), axis)) / (2 * reach + 1)


def _completed(
    detail: np.ndarray, tone: np.ndarray, valid: np.ndarray, hole: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """[H, W, 3] detail with the hole made of patches; coarse levels first."""
    ys, xs = np.nonzero(hole)
    if not len(ys) or not _sources(valid).any():
        return np.where(valid[..., None], detail, 0)
    # Coarse to fine: large structures are decided where a patch is as large as they are.
    smallest = min(np.ptp(ys), np.ptp(xs)) + 1
    if smallest > TEXTURE.min_level_px and min(hole.shape) >= 6 * TEXTURE.patch_px:
        coarse, coarse_valid = _halved(detail, valid)
        coarse_hole = _any_block(hole)
        below = _completed(coarse, _halved(tone, np.ones_like(valid))[0], coarse_valid & ~coarse_hole, coarse_hole, rng)
        first = below.repeat(2, 0).repeat(2, 1)[: hole.shape[0], : hole.shape[1]]
        rounds = TEXTURE.level_rounds[0]
    else:
        first, rounds = None, TEXTURE.level_rounds[1]
    out = np.where(valid[..., None], detail, 0).astype(np.float32)
    if first is None:  # from anywhere: patches that fit best between nothing and nothing are plain ones
        values = detail[valid]
        out[hole] = values[rng.integers(len(values), size=int(hole.sum()))]
    else:
        out[hole] = first[hole]
    return _matched(out, tone, valid, hole, rounds, rng)


def _matched(
    picture: np.ndarray, tone: np.ndarray, valid: np.ndarray, hole: np.ndarray, rounds: int, rng
) -> np.ndarray:
    height, width = hole.shape
    half = TEXTURE.patch_px // 2
    sources = np.flatnonzero(_sources(valid))
    if not len(sources):
        return picture
    # Patches are named by the flat index of their middle: neighbours differ by 1 or by a row.
    allowed = np.zeros(height * width, bool)
    allowed[sources] = True
    # Patches that reach into the hole.
    reach = hole.copy()
    for axis in (0, 1):
        reach = _box(reach.astype(np.float64), half, axis) > 1e-9
    inner = np.zeros_like(reach)
    inner[half : height - half, half : width - half] = True
    centers = np.flatnonzero(reach & inner)
    if not len(centers):
        return picture
    offsets = np.array([dy * width + dx for dy in range(-half, half + 1) for dx in range(-half, half + 1)])
    flat = picture.reshape(-1, 3).copy()
    inside = hole.reshape(-1)
    confidence = _confidence(valid, hole)
    # Pixels near the rim are surer than those in the middle, and count for more in a comparison.
    covered = confidence.reshape(-1)[centers[:, None] + offsets].astype(np.float32)
    covered *= len(offsets) / np.maximum(covered.sum(1, keepdims=True), 1e-6)
    trust = confidence.reshape(-1)[centers] + 1e-3
    position = np.full(height * width, -1, np.int64)
    position[centers] = np.arange(len(centers))
    match = sources[rng.integers(len(sources), size=len(centers))]
    source_patches = flat[sources[:, None] + offsets]  # valid pixels only: they stay
    patch_of = np.full(height * width, -1, np.int64)
    patch_of[sources] = np.arange(len(sources))

    def distance(patches: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        gap = source_patches[patch_of[candidates]] - patches
        apart = tones[candidates] - tones[centers]
        return ((gap * gap).sum(2) * covered).sum(1) + TONE_VOTE * (apart * apart).sum(1)

    tones = tone.reshape(-1, 3).astype(np.float32)

    for turn in range(rounds):
        patches = flat[centers[:, None] + offsets]
        best = distance(patches, match)

        def improve(candidates: np.ndarray, best=best, patches=patches) -> None:
            fits = allowed[candidates]
            candidates = np.where(fits, candidates, match)
            score = distance(patches, candidates)
            better = score < best
            match[better] = candidates[better]
            best[better] = score[better]

        # Propagation: what fits my neighbour, moved by as much, may fit me.
        for jump in TEXTURE.propagation_steps_px if turn else (1, 4, 16):
            for step in (-jump, jump, -jump * width, jump * width):
                neighbour = np.clip(centers + step, 0, height * width - 1)
                neighbour_position = position[neighbour]
                candidates = np.where(neighbour_position >= 0, match[np.maximum(neighbour_position, 0)] - step, match)
                improve(np.clip(candidates, 0, height * width - 1))
        # Random search around the best match, closer and closer, and once anywhere.
        radius = max(height, width) // 2
        while radius >= 1:
            dy = rng.integers(-radius, radius + 1, len(centers))
            dx = rng.integers(-radius, radius + 1, len(centers))
            improve(np.clip(match + dy * width + dx, 0, height * width - 1))
            radius //= 3
        improve(sources[rng.integers(len(sources), size=len(centers))])
        _vote(flat, inside, centers, offsets, match, best, trust, last=turn == rounds - 1)
    return flat.reshape(picture.shape)


def _confidence(valid: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """[H, W] 1 of what is valid, less and less towards the middle of the hole, 0 elsewhere."""
    out = np.where(valid, 1.0, 0.0)
    left, trust = hole.copy(), 1.0
    while left.any():
        trust /= TEXTURE.depth_weight_base
        inner = left.copy()
        for axis in (0, 1):
            inner &= _box(left.astype(np.float64), 1, axis) > 1 - 1e-9
        out[left & ~inner] = max(trust, 1e-3)
        left = inner
    return out


def _vote(flat, inside, centers, offsets, match, best, trust, last: bool) -> None:
    """Every pixel of the hole becomes the mean of what the patches over it say."""
    # Weights relative to what matches usually reach on this texture.
    scale = max(float(np.quantile(best, 0.75)), 1e-9)
    quality = (portable.exp(-best / (2 * scale)) + 1e-4) * trust
    sums, weights = np.zeros((len(flat), 3)), np.zeros(len(flat))
    half = TEXTURE.patch_px // 2
    for k, offset in enumerate(offsets):
        dy, dx = k // TEXTURE.patch_px - half, k % TEXTURE.patch_px - half
        share = quality * portable.exp(
            -(dy * dy + dx * dx) / (2 * (TEXTURE.last_vote_spread_px if last else TEXTURE.vote_spread_px) ** 2)
        )
        weights += np.bincount(centers + offset, share, len(flat))
        for c in range(3):
            sums[:, c] += np.bincount(centers + offset, share * flat[match + offset, c], len(flat))
    written = inside & (weights > 0)
    flat[written] = (sums[written] / weights[written, None]).astype(np.float32)


def _sources(valid: np.ndarray) -> Bools:
    """[H, W] bool: middles of patches of which every pixel is valid."""
    half = TEXTURE.patch_px // 2
    out = valid.astype(np.float64)
    for axis in (0, 1):
        out = _box(out, half, axis)
    return out > 1 - 1e-6


def _halved(detail: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pad = ((0, valid.shape[0] % 2), (0, valid.shape[1] % 2))
    weight = np.pad(valid, pad).astype(np.float32)
    values = np.pad(detail, (*pad, (0, 0))) * weight[..., None]
    counts, sums = _sum_block(weight), _sum_block(values)
    return sums / np.maximum(counts, 1)[..., None], counts >= 2


def _any_block(mask: np.ndarray) -> np.ndarray:
    pad = ((0, mask.shape[0] % 2), (0, mask.shape[1] % 2))
    return _sum_block(np.pad(mask, pad).astype(np.float32)) > 0


def _sum_block(values: np.ndarray) -> np.ndarray:
    return values[::2, ::2] + values[1::2, ::2] + values[::2, 1::2] + values[1::2, 1::2]
