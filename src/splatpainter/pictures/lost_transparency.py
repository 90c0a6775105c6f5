"""Opaque pictures of which a program laid transparency on a ground of its own: white, black, a checkerboard.

Their outline blends with that ground, not with the view's background, so all along it they would count as painted. The
ground is told by the pixels where the view shows nothing but background, and what differs by it alone is no paint.
Pure. H, W: pixels of the view; colours are display sRGB 0..1.
"""

from __future__ import annotations

import numpy as np

from splatpainter.lift.masks import box_mean, change_mask, largest_channel
from splatpainter.pictures.encodings import Encoding, edited_in_encoded
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class GroundThresholds:
    """When a picture stands on a ground of its own. Display values; source: taste."""

    max_cover: float = 1 / 512
    """Alpha up to which a pixel shows background alone."""
    min_solid: float = 0.99
    """Alpha from which no background shines through."""
    min_bare_share: float = 0.03
    """Share of the picture that must be background to tell."""
    min_other: float = 6 / 255
    """Difference from the view's background from which it is another."""
    min_other_share: float = 0.9
    """Share of the background that must be another: where a brush or a fill covers a part, the view's shows beside."""
    max_noise: float = 8 / 255
    """Difference from the ground's colours that compression leaves."""
    min_explained: float = 0.9
    """Share of the background that must have these colours, or lie between them where cells meet; the rest may be
    painted."""
    min_pure: float = 0.75
    """Share of the background that must have one of them: a vignette lies between two colours, too."""
    min_second_share: float = 0.05
    """Share of the background from which a second colour belongs to the ground."""
    min_unchanged: float = 0.3
    """Share of the asset that must be as it was rendered: a grade or a negative changes background and asset."""


GROUNDS = GroundThresholds()
GROUND_NOTE = "its transparency was lost: what shows another background than its view's is no paint"


def without_its_ground(
    picture: np.ndarray,
    render: np.ndarray,
    cover: np.ndarray,
    background: np.ndarray,
    encoding: Encoding | None,
) -> np.ndarray | None:
    """[H, W, 3] the picture with everything as it was rendered that differs by its ground alone; None where it stands
    on the view's background, or where no ground can be told. picture, render: [H, W, 3], the latter over `background`
    ([3]); cover: [H, W] alpha of the asset."""
    bare = cover <= GROUNDS.max_cover
    if bare.mean() < GROUNDS.min_bare_share:
        return None
    behind = picture[bare]
    if (np.abs(behind - background).max(1) > GROUNDS.min_other).mean() < GROUNDS.min_other_share:
        return None
    solid = cover > GROUNDS.min_solid
    unchanged = largest_channel(np.abs(box_mean(picture - render, 1))) <= GROUNDS.max_noise
    if not solid.any() or unchanged[solid].mean() < GROUNDS.min_unchanged:
        return None
    first, second = _colors_of(behind)
    apart = np.abs(behind - _between(behind, first, second)).max(1)
    pure = np.minimum(*(np.abs(behind - color).max(1) for color in (first, second))) <= GROUNDS.max_noise
    if (apart <= GROUNDS.max_noise).mean() < GROUNDS.min_explained or pure.mean() < GROUNDS.min_pure:
        return None
    clear = 1 - cover[..., None]
    drawn = render - clear * background
    expected = drawn + _between(picture - drawn, clear * first, clear * second)
    expected = np.clip(expected, 0, 1).astype(np.float32)
    mask = change_mask(picture, expected) if encoding is None else edited_in_encoded(picture, expected, cover, encoding)
    if mask is None:
        return None
    mask &= ~bare
    return np.where(mask[..., None], picture, render).astype(np.float32)


def _colors_of(behind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The two colours [3] of [P, 3]; twice the same, where there is one."""
    levels = np.clip(behind * 16, 0, 15.999).astype(np.int64)
    cells = levels[:, 0] * 256 + levels[:, 1] * 16 + levels[:, 2]
    first = np.median(behind[cells == np.bincount(cells).argmax()], axis=0)
    is_other = np.abs(behind - first).max(1) > 2 * GROUNDS.max_noise
    if is_other.mean() < GROUNDS.min_second_share:
        return first, first
    other_cells = cells[is_other]
    return first, np.median(behind[is_other][other_cells == np.bincount(other_cells).argmax()], axis=0)


def _between(values: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[..., 3] the point on the line between two colours that is nearest to each value. All [..., 3]."""
    along = second - first
    share = ((values - first) * along).sum(-1, keepdims=True) / np.maximum((along**2).sum(-1, keepdims=True), 1e-9)
    return first + np.clip(share, 0, 1) * along
