"""What an edited view says about each Gaussian: how much of it it shows, what changes there, and how sure that is.

Knows one view of a view's Gaussians (M of them) and the change of that picture; no other views, and no colours. From
the other sides a Gaussian shows what this view hides of it, so how far the view can be trusted for all of it matters.
"""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.kernels import portable
from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_mean

HOLD_PER_PIXEL = 0.1
"""Pull of a Gaussian's old colour, per hidden pixel of it and squared doubt. Two close-ups of 4x zoom of four training
meshes (dB in the edited views, on novel views near them, of the whole): nothing done 23.8, 23.2, 29.9; 0.1: 26.1, 24.0,
29.4; 0.4: 25.1, 23.7, 29.7."""
MAX_DOUBT = 2.5
"""More doubt than this counts as this much."""


@dataclass(frozen=True)
class LongGaussianThresholds:
    """Gaussians that carry paint out of what is painted, as other views show of them what this one hides. Stickers in
    the fog of captures' pedestals, changed pixels outside seen from 0 and 40 degrees: joint colours by this rule 6388
    -> 1107 and 9926 -> 3405 (angel), each view's paint too 3407 -> 146 (angel) and 4054 -> 600 (st-peter)."""

    max_px: float = 24.0
    """Half length of a Gaussian in a view, pixels, up to which it is painted however little of it lies under the paint.
    About three standard deviations of what sheets cut at their edge (`RESURFACING.max_cut_px`)."""
    min_inside: float = 0.5
    """Share of the footprint of a longer one, hidden or not, that must lie under the paint."""
    min_visible: float = 0.1
    """Share of that footprint that a view must show, for it to be split where less lies under the paint: its pieces are
    drawn at depths of their own, so that some of what was hidden would come to light."""


LONG = LongGaussianThresholds()


@dataclass(frozen=True)
class Evidence:
    """What one view says about M Gaussians: sums over pixels p of the drawn tiles, by the weights w_ip with which they
    make the picture."""

    visible: np.ndarray
    """[M] sum w: pixels' worth of the Gaussian in this view."""
    inside: np.ndarray
    """[M] the same within the mask."""
    covered: np.ndarray
    """[M] the alpha of each summed over the mask, hidden or not."""
    peak: np.ndarray
    """[M] largest w within the mask."""
    change: np.ndarray
    """[M, 3] sum w (target - rendered), which is 0 outside the mask."""
    energy: np.ndarray
    """[M] sum w |target - rendered|^2, mean over channels."""

    @staticmethod
    def of(view: ProjectedView, change: np.ndarray, mask: np.ndarray) -> Evidence:
        """change: [H, W, 3], 0 outside mask [H, W] bool."""
        everywhere = view.backproject(change, np.ones(mask.shape, np.float32))
        # Energy goes through the same back-projection as a grey picture.
        at, energy = np.flatnonzero(mask), np.zeros_like(change)
        energy.reshape(-1, 3)[at] = row_mean(change.reshape(-1, 3).take(at, 0) ** 2)[:, None]
        within = view.backproject(energy, mask.astype(np.float32))
        return Evidence(
            everywhere.weight, within.weight, within.alpha, within.peak, everywhere.values, within.values[:, 0]
        )

    @property
    def spread(self) -> np.ndarray:
        """[M] variance of the change over each Gaussian's footprint, mean over channels."""
        # Variance over the footprint, by the weights with which the pixels show the Gaussian.
        total = np.maximum(self.visible, 1e-6)
        return self.energy / total - row_mean((self.change / total[:, None]) ** 2)

    @property
    def followed(self) -> float:
        """Share of the change's energy that is left when every Gaussian takes its mean: 1 for flat paint on fine ones,
        0 for detail that is finer than they are. Over assets and edits: paint, text and stickers 0.63 to 0.96,
        close-ups 0.26 to 0.45."""
        means = row_mean(self.change**2) / np.maximum(self.inside, 1e-6)
        return float(
            np.clip(portable.total(means, np.float64) / max(portable.total(self.energy, np.float64), 1e-12), 0, 1)
        )

    @property
    def doubt(self) -> float:
        """Energy of the edit that the Gaussians cannot follow over that which they can."""
        followed = self.followed
        return (1 - followed) / max(followed, 1e-3)

    def hold(self, view: ProjectedView) -> np.ndarray:
        """[M] pixels' worth of pull towards the old colour: what the view does not show of each Gaussian (behind
        others, out of the picture), by how much the edit is to be doubted."""
        # What this view does not show of a Gaussian is what other views may show of it.
        hidden = np.maximum(footprints(view) - self.visible, 0)
        return HOLD_PER_PIXEL * min(self.doubt, MAX_DOUBT) ** 2 * hidden


def reaches_out(view: ProjectedView, covered: np.ndarray) -> Bools:
    """[M] bool: long Gaussians of a view of whose footprint little is painted (covered: [M] the alpha of each summed
    over painted pixels)."""
    return (view.extents.max(1) > LONG.max_px) & (covered < LONG.min_inside * footprints(view))


def footprints(view: ProjectedView, entries: np.ndarray | None = None) -> np.ndarray:
    """[M] pixels' worth of each Gaussian if nothing were before it and the picture had no borders: the integral of its
    alpha, 2 pi opacity / sqrt(det conic). entries: [K] int64, of these alone ([K])."""
    conics, opacities = view.conics, view.opacities
    if entries is not None:
        conics, opacities = conics[entries], opacities[entries]
    a, b, c = conics.astype(np.float64).T
    return 2 * np.pi * opacities / np.sqrt(np.maximum(a * c - b * b, 1e-12))
