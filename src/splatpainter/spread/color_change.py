"""The change of colour from what a material was to what it was painted, as a function of the old colour that holds for
other light and shade on it too.

In linear light new = A old + b: A starts as "the light and shade stay, the hue is the paint's" (rank one), b as 0, and
both move away from that as far as the examples speak for it (ridge regression): flat paint over a shaded surface stays
flat, a tint keeps hues apart, paint on an evenly lit spot keeps the shade that is found elsewhere.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.color import (
    LUMA,
    base_color,
    from_display,
    linear_to_srgb,
    luminance,
    sh_from_color,
    srgb_to_linear,
    to_display,
)
from splatpainter.kernels import portable
from splatpainter.lift.colors import MAX_COLOR
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class ColorChangeThresholds:
    """The affine map between a material's old and new colours. Source: taste."""

    min_light: float = 1e-3
    """Luminance, linear, that a mean counts as at least."""
    hold_matrix: float = 0.02
    """Pull of A towards where it starts, in variances of the old colour over its mean luminance."""
    hold_offset: float = 0.05
    """Pull of b towards where it starts, in the same."""
    difference_step: float = 0.02
    """Step of the central differences along a SH coefficient, display units."""


COLOR_CHANGE = ColorChangeThresholds()


@dataclass(frozen=True)
class ColorChange:
    """A map of display colours."""

    matrix: Floats = field(repr=False)
    """[3, 3] float64 A."""
    offset: Floats = field(repr=False)
    """[3] float64 b."""

    @staticmethod
    def fit(old: np.ndarray, new: np.ndarray, weights: np.ndarray) -> ColorChange:
        """old, new: [P, 3] display colours; weights: [P] >= 0, not all 0."""
        x, y = (srgb_to_linear(colors.astype(np.float64).clip(0, 1)) for colors in (old, new))
        share = weights.astype(np.float64) / portable.total(weights, np.float64)
        light = max(float(portable.total(share * luminance(x))), COLOR_CHANGE.min_light)
        x = x / light
        # The prior: paint of the mean new colour, lit as the old surface was.
        start = np.outer((share[:, None] * y).sum(0), LUMA)  # [3, 3]
        columns = np.concatenate([x, np.ones((len(x), 1))], 1)  # [P, 4]
        gram = _summed(columns, columns, share) + np.diag([COLOR_CHANGE.hold_matrix] * 3 + [COLOR_CHANGE.hold_offset])
        solved = portable.solved(gram, _summed(columns, y - _mapped(x, start), share))  # [4, 3]
        return ColorChange((start + solved[:3].T) / light, solved[3])

    def __call__(self, colors: np.ndarray) -> np.ndarray:
        """[..., 3] display colours 0..1 -> the like, 0..MAX_COLOR."""
        linear = srgb_to_linear(colors.astype(np.float64).clip(0, None))
        new = linear_to_srgb((_mapped(linear, self.matrix) + self.offset).clip(0, None))
        return new.clip(0, MAX_COLOR).astype(np.float32)

    def applied(self, splats: Splats, ids: np.ndarray, shares: np.ndarray) -> Floats:
        """[J, K, 3] float32 SH of Gaussians `ids` after the change, mixed with what they are by shares [J] 0..1. Bands
        >= 1 are carried through its derivative, so that highlights stay in place."""
        sh, space = splats.sh[ids], splats.color_space

        def change(colors: np.ndarray) -> np.ndarray:
            return from_display(self(to_display(colors, space)), space)

        old = np.clip(base_color(sh), 0, 1)
        out = np.empty_like(sh)
        out[:, 0] = sh_from_color(change(old))
        if sh.shape[1] > 1:
            bands = sh[:, 1:]
            # Central differences along each coefficient: the map may have kinks where it clips.
            size = np.maximum(np.abs(bands).max(-1, keepdims=True), 1e-6)
            along = COLOR_CHANGE.difference_step * bands / size
            middle = old.clip(2 * COLOR_CHANGE.difference_step, 1 - 2 * COLOR_CHANGE.difference_step)[:, None]
            out[:, 1:] = (change(middle + along) - change(middle - along)) * (size / (2 * COLOR_CHANGE.difference_step))
        return (sh + shares[:, None, None] * (out - sh)).astype(np.float32)


def _summed(one: np.ndarray, other: np.ndarray, share: np.ndarray) -> np.ndarray:
    """[A, B] sum over p of share_p one_pa other_pb."""
    return np.stack([[(share * a * b).sum() for b in other.T] for a in one.T])


def _mapped(colors: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """[..., 3] matrix times each colour."""
    return sum(colors[..., k, None] * matrix[:, k] for k in range(3))  # type: ignore[return-value]
