"""Colours matched at the seam: one gain and one offset of linear light per channel, with which an asset's surface has
the colours of another one's where the two are near to each other. Pure.

    light' = gain * light + offset

Pairs are Gaussians of both surfaces that lie within a few spacings of each other; their colours need not be of the same
point, so slopes come from spreads, not from a regression, which would go to 0 with noise. With m the means, v the
variances, r the correlation of both sides' light,

    gain^2 = (v_target + k m_target^2) / (v_source + k m_source^2),   k = SEAM.offset_pull (1 - r^2)
    offset = m_target - gain m_source

which is the line itself where the pairs lie on one, and the ratio of the means where they say nothing of a slope. Pairs
farther off the ratio of the medians than SEAM.max_deviations robust deviations do not count. Base colours
count; view-dependent bands follow by the slope of the function (color_grading.apply_to_sh).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np

from splatpainter.color import base_color, linear_to_srgb, srgb_to_linear, to_light
from splatpainter.grading.color_grading import apply_to_sh
from splatpainter.kernels import portable
from splatpainter.splats import ColorSpace, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels.neighbours import nearest_within

LIGHT = "light"
"""Name of the look: {"look": "light", "gain": [3], "offset": [3], "space": "srgb"}."""


@dataclass(frozen=True)
class SeamThresholds:
    """Colours on both sides of a seam. Source: taste."""

    min_opacity: float = 0.2
    """Least opacity of Gaussians that count as surface."""
    min_pairs: int = 24
    """Pairs of Gaussians across the seam that a match needs."""
    radii: int = 4
    """Distances at which pairs are looked for, each twice the one before, the first twice the median size of a
    Gaussian."""
    offset_pull: float = 4.0
    """How much more than the spread of uncorrelated pairs their mean counts for the gain."""
    noise_variance: float = 1e-6
    """Variance of linear light, added to both sides: black on black is no change."""
    max_deviations: float = 3.0
    """Standard deviations of the differences beyond which a pair says nothing."""
    min_gain: float = 0.1
    """The least gain that a match may ask for."""
    max_gain: float = 10.0
    """The largest gain that a match may ask for."""
    max_offset: float = 0.5
    """The largest offset that a match may ask for, linear light."""


SEAM = SeamThresholds()


MAX_NUMBER = 1e6
"""Largest absolute value of gains and offsets that a project may name."""


@dataclass(frozen=True)
class SeamMatch:
    """What brings the colours of one asset to those of another."""

    gain: tuple[float, float, float]
    """Gain on linear light, red, green, blue."""
    offset: tuple[float, float, float]
    pairs: int
    """Gaussians that it was estimated from."""
    falloff: float = 0.0
    """World units from the seam at which it ends; 0: it holds everywhere."""

    @property
    def text(self) -> str:
        """The match in words, for people."""
        gains, offsets = (" ".join(f"{value:.3g}" for value in values) for values in (self.gain, self.offset))
        reach = f", fading over {self.falloff:g}" if self.falloff else ""
        return f"light x {gains} + {offsets}{reach} (from {self.pairs} pairs)"

    def parameters(self, space: ColorSpace) -> dict[str, Any]:
        """Parameters of an adjustment layer."""
        return {"look": LIGHT, "gain": list(self.gain), "offset": list(self.offset), "space": space}

    def record(self) -> dict[str, Any]:
        return {
            "gain": list(self.gain),
            "offset": list(self.offset),
            "pairs": self.pairs,
            "falloff": self.falloff,
        }

    @staticmethod
    def from_record(data: Any) -> SeamMatch:
        """The inverse of `record`. Raises ValueError."""
        try:
            gain, offset = (_three(data[name], name) for name in ("gain", "offset"))
            pairs, falloff = int(data["pairs"]), float(data["falloff"])
            if not 0 <= falloff <= MAX_NUMBER:
                raise ValueError(f"seam: expected a falloff of 0 to {MAX_NUMBER:g}, got {falloff:g}")
            r, g, b = gain.tolist()
            dr, dg, db = offset.tolist()
            return SeamMatch((r, g, b), (dr, dg, db), pairs, falloff)
        except (KeyError, TypeError, OverflowError) as error:
            raise ValueError(f"seam: expected gain, offset, pairs and falloff ({error!r:.60})") from None

    def apply(self, moving: Splats, fixed: Splats) -> Splats:
        """`moving` with the match, which fades out from the seam with `fixed` (both as they stand in the scene)."""
        sh = light_sh(moving.sh, self.parameters(moving.color_space))
        if self.falloff:
            weights = seam_weights(moving, fixed, self.falloff)[:, None, None]
            sh = np.where(weights > 0, moving.sh + weights * (sh - moving.sh), moving.sh).astype(np.float32)
        return replace(moving, sh=sh)


def match_seam(moving: Splats, fixed: Splats, falloff: float = 0.0) -> SeamMatch:
    """The match of one asset to another, both as they stand in the scene. falloff: world units, 0: everywhere.
    Raises ValueError: they are nowhere near each other, or their colours are of two spaces."""
    if not 0 <= falloff <= MAX_NUMBER:
        raise ValueError(f"seam: expected a falloff of 0 to {MAX_NUMBER:g} world units, got {falloff:g}")
    if moving.color_space != fixed.color_space:
        raise ValueError(f"seam: colours of one asset are {moving.color_space}, of the other {fixed.color_space}")
    # Pairs near the seam only: what is far away may well have other colours.
    ids, near_ids, _ = seam_pairs(moving, fixed)
    source = to_light(np.clip(base_color(moving.sh[ids]), 0, 1), moving.color_space).astype(np.float64)
    target = to_light(np.clip(base_color(fixed.sh[near_ids]), 0, 1), fixed.color_space).astype(np.float64)
    lines = [_fitted(source[:, k], target[:, k]) for k in range(3)]
    (r, dr), (g, dg), (b, db) = lines
    return SeamMatch((r, g, b), (dr, dg, db), len(ids), float(falloff))


def seam_pairs(moving: Splats, fixed: Splats) -> tuple[np.ndarray, np.ndarray, float]:
    """([P] ids of `moving`, [P] ids of `fixed` nearest to them, the distance within which they lie). Raises ValueError
    where there are fewer than SEAM.min_pairs."""
    moving = moving.relative_to(fixed.offset)
    ids, other_ids = (np.flatnonzero(_surface(splats)) for splats in (moving, fixed))
    # From two Gaussians' width on, doubling until there are enough pairs.
    radius = 2 * max((float(np.median(s.scales[k].max(1))) for s, k in ((moving, ids), (fixed, other_ids)) if len(k)))
    touching = np.zeros(len(ids), bool)
    for _ in range(SEAM.radii):
        near, _distance = nearest_within(fixed.means[other_ids], moving.means[ids], radius)
        touching = near >= 0
        if touching.sum() >= SEAM.min_pairs:
            return ids[touching], other_ids[near[touching]], radius
        radius *= 2
    count = int(touching.sum())
    raise ValueError(
        f"seam: the assets are not near to each other: {count} pairs of Gaussians within {radius / 2:.3g} world units, "
        f"expected {SEAM.min_pairs}; move them together"
    )


def seam_weights(moving: Splats, fixed: Splats, falloff: float) -> np.ndarray:
    """[N] float32 of `moving`: 1 at the seam with `fixed`, 0 from `falloff` world units on, smooth between."""
    ids, _, _ = seam_pairs(moving, fixed)  # moving.means are compared with themselves only
    _, distance = nearest_within(moving.means[ids], moving.means, falloff)
    share = np.clip(1 - np.where(np.isfinite(distance), distance, falloff) / falloff, 0, 1)
    return (share * share * (3 - 2 * share)).astype(np.float32)


def light_sh(sh: np.ndarray, parameters: Mapping[str, Any]) -> np.ndarray:
    """[N, K, 3] float32 SH after gain and offset in linear light. Raises ValueError for what are no such parameters."""
    gain, offset = (_three(parameters.get(name), name).astype(np.float32) for name in ("gain", "offset"))
    space = parameters.get("space", "srgb")
    if space not in ("srgb", "linear"):
        raise ValueError(f"look: expected a space of srgb or linear, got {ascii(space)[:40]}")

    def function(colors: np.ndarray) -> np.ndarray:
        light = srgb_to_linear(colors) * gain + offset
        return linear_to_srgb(np.clip(light, 0, 1)).astype(np.float32)

    return apply_to_sh(sh, function, cast(ColorSpace, space))


def _surface(splats: Splats) -> np.ndarray:
    """[N] bool: Gaussians that show."""
    visible = splats.drawable & (splats.opacities >= SEAM.min_opacity)
    if not visible.any():
        raise ValueError("seam: one of the assets shows nothing")
    return visible


def _fitted(source: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """(gain, offset) of one channel."""
    # A first gain by medians throws out pairs of different things; the line is fitted to the rest.
    gain = np.clip(np.median(target) / max(float(np.median(source)), 1e-4), SEAM.min_gain, SEAM.max_gain)
    error = np.abs(target - gain * source)
    deviation = 1.4826 * float(np.median(error))
    good = error <= max(SEAM.max_deviations * deviation, 1e-4)
    gain, offset = _line(source[good], target[good])
    return gain, float(np.clip(offset, -SEAM.max_offset, SEAM.max_offset))


def _line(source: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    mean, target_mean = float(portable.mean(source)), float(portable.mean(target))
    spread, target_variance = (
        float(portable.mean(np.square(source - mean))),
        float(portable.mean(np.square(target - target_mean))),
    )
    together = float(portable.mean((source - mean) * (target - target_mean)))
    # Uncorrelated pairs say nothing of a slope: the more, the more the ratio of the means decides.
    pull = SEAM.offset_pull * (1 - min(max(together, 0.0) ** 2 / max(spread * target_variance, 1e-24), 1.0))
    square = (target_variance + pull * target_mean**2 + SEAM.noise_variance) / (
        spread + pull * mean**2 + SEAM.noise_variance
    )
    gain = float(np.clip(math.sqrt(square), SEAM.min_gain, SEAM.max_gain))
    return gain, target_mean - gain * mean


def _three(value: Any, name: str) -> np.ndarray:
    """[3] float64. Raises ValueError."""
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    flat = value if isinstance(value, list | tuple) else []
    if numbers.shape != (3,) or any(isinstance(one, bool | str) for one in flat):
        raise ValueError(f"look: expected three numbers as {name}, got {ascii(value)[:60]}")
    if not (np.abs(numbers) <= MAX_NUMBER).all():
        raise ValueError(f"look: expected finite numbers as {name}")
    return numbers
