"""What an edited view says about each row: how much of it it shows, what it wants changed there, and how sure that is.

Knows one view of a frame's rows (M of them) and the change that is wanted in it; no other views, and no colours. From
the other sides a row shows what this view hides of it, so what the view leaves open has to be told from what it says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatpainter.rendering.cpu.projected_view import ProjectedView

HOLD = 0.1
"""Pull of a row's old colour, per hidden pixel of the row and squared doubt. Two close-ups of 4x zoom of four training
meshes (dB in the edited views, on novel views near them, of the whole): nothing done 23.8, 23.2, 29.9; 0.1: 26.1, 24.0,
29.4; 0.4: 25.1, 23.7, 29.7."""
MOST_DOUBT = 2.5
"""More doubt than this counts as this much."""


@dataclass(frozen=True)
class Evidence:
    """Of M rows; sums over pixels p of the drawn tiles, by the weights w_ip with which rows make the picture."""

    shown: np.ndarray
    """[M] sum w: pixels' worth of the row in this view."""
    inside: np.ndarray
    """[M] the same within the mask."""
    peak: np.ndarray
    """[M] largest w within the mask."""
    change: np.ndarray
    """[M, 3] sum w (wanted - rendered), which is 0 outside the mask."""
    energy: np.ndarray
    """[M] sum w |wanted - rendered|^2, mean over channels."""

    @staticmethod
    def of(frame: ProjectedView, change: np.ndarray, mask: np.ndarray) -> Evidence:
        """change: [H, W, 3], 0 outside mask [H, W] bool."""
        everywhere = frame.backproject(change, np.ones(mask.shape, np.float32))
        energy = np.repeat((change**2).mean(-1, keepdims=True), 3, 2)
        within = frame.backproject(energy, mask.astype(np.float32))
        return Evidence(everywhere.weight, within.weight, within.peak, everywhere.values, within.values[:, 0])

    @property
    def spread(self) -> np.ndarray:
        """[M] variance of the change over each row's footprint, mean over channels."""
        total = np.maximum(self.shown, 1e-6)
        return self.energy / total - ((self.change / total[:, None]) ** 2).mean(1)

    @property
    def followed(self) -> float:
        """Share of the change's energy that is left when every row takes its mean: 1 for flat paint on fine rows, 0 for
        detail that is finer than the rows. Over assets and edits: paint, text and stickers 0.63 to 0.96, close-ups
        0.26 to 0.45."""
        means = (self.change**2).mean(1) / np.maximum(self.inside, 1e-6)
        return float(np.clip(means.sum(dtype=np.float64) / max(self.energy.sum(dtype=np.float64), 1e-12), 0, 1))

    @property
    def doubt(self) -> float:
        """Of the edit, the energy that rows cannot follow over that which they can."""
        followed = self.followed
        return (1 - followed) / max(followed, 1e-3)

    def hold(self, frame: ProjectedView) -> np.ndarray:
        """[M] pixels' worth of pull towards the old colour: what the view does not show of each row (behind others, out
        of the picture), by how much the edit is to be doubted."""
        hidden = np.maximum(footprints(frame) - self.shown, 0)
        return HOLD * min(self.doubt, MOST_DOUBT) ** 2 * hidden


def footprints(frame: ProjectedView) -> np.ndarray:
    """[M] pixels' worth of each row if nothing were before it and the picture had no borders: the integral of its
    alpha, 2 pi opacity / sqrt(det conic)."""
    a, b, c = frame.conics.astype(np.float64).T
    return 2 * np.pi * frame.opacities / np.sqrt(np.maximum(a * c - b * b, 1e-12))
