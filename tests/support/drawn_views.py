"""One drawn view, and what hands and sliders do to it."""

from __future__ import annotations

import numpy as np

from tests.support.distorted_pictures import drawn_scene

VIEW, ALPHA = drawn_scene(240)


def decoded(colors: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, written out."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def encoded(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def eight_bits(colors: np.ndarray) -> np.ndarray:
    return (np.round(np.clip(colors, 0, 1) * 255) / 255).astype(np.float32)


def top(share: float) -> np.ndarray:
    """[H, W, 1] the upper part of the asset, so much of it."""
    order = np.flatnonzero(ALPHA.ravel() > 0.5)
    mask = np.zeros(ALPHA.size, np.float32)
    mask[order[: round(share * len(order))]] = 1
    return mask.reshape(*ALPHA.shape, 1)


def over(mask: np.ndarray, color: tuple[float, float, float], opacity: float = 1.0) -> np.ndarray:
    return VIEW + opacity * mask * (np.array(color) - VIEW)


def green_dab(painted: np.ndarray) -> np.ndarray:
    """The picture with a green rectangle on the asset."""
    dabbed = np.array(painted)
    dabbed[90:130, 90:120] = (0.1, 0.6, 0.2)
    return dabbed


def on_the_asset(graded: np.ndarray) -> np.ndarray:
    return eight_bits(np.where(ALPHA[..., None] > 0, graded, VIEW))
