"""A board of two materials, seen from the front; its back is another sheet of the same two, in less light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.color import linear_to_srgb, srgb_to_linear
from splatpainter.splats import SH_C0, Splats

LEFT, RIGHT, PAINT = (np.array(color, np.float32) for color in ((0.75, 0.3, 0.25), (0.3, 0.4, 0.7), (0.2, 0.7, 0.3)))
"""Display colours of the materials in full light, and what the left one is painted with."""
SIDE = 26
"""Gaussians along each edge."""
CAMERA = look_at((0, 0, 3.2), (0, 0, 0), width=72, height=72, fov=42, background=(0.5, 0.5, 0.5))


def board(degree: int = 0) -> Splats:
    """2 SIDE^2 Gaussians: the front at z = 0, then the back at z = -0.6."""
    rng = np.random.default_rng(3)
    steps = np.linspace(-1, 1, SIDE)
    x, y = (part.ravel() for part in np.meshgrid(steps, steps))
    means = np.concatenate([np.stack([x, y, np.full_like(x, z)], 1) for z in (0.0, -0.6)])
    count, spacing = len(means), 2 / (SIDE - 1)
    light = np.concatenate([0.75 + 0.25 * y, 0.4 + 0.15 * y])[:, None]
    sh = rng.normal(0, 0.02, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = (lit(np.where(means[:, :1] < 0, LEFT, RIGHT), light) + rng.normal(0, 0.01, (count, 3)) - 0.5) / SH_C0
    scales = np.tile(spacing * np.array([0.6, 0.6, 0.05]), (count, 1))
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    opacities = np.full(count, 0.9)
    means, quats, scales, sh = (part.astype(np.float32) for part in (means, quats, scales, sh))
    return Splats(means, quats, scales, opacities.astype(np.float32), sh)


def lit(colors: np.ndarray, light: np.ndarray) -> np.ndarray:
    """[N, 3] display colours in this much light ([N, 1], linear)."""
    return linear_to_srgb(srgb_to_linear(colors) * light)


def painted_picture(splats: Splats, camera: Camera = CAMERA) -> np.ndarray:
    """[H, W, 3] the view with the left material in another colour, in the same light."""
    from splatpainter.rendering import render

    left = splats.means[:, 0] < 0
    new, old = srgb_to_linear(PAINT), srgb_to_linear(LEFT)
    colors = srgb_to_linear(np.clip(0.5 + SH_C0 * splats.sh[:, 0], 0, 1)) / old * new
    sh = splats.sh.copy()
    sh[left, 0] = (linear_to_srgb(colors[left]) - 0.5) / SH_C0
    return np.clip(render(replace(splats, sh=sh), camera).colors[0], 0, 1)


def left_half(camera: Camera = CAMERA) -> np.ndarray:
    """[H, W] bool: where the view shows the left material."""
    mask = np.zeros((camera.height, camera.width), bool)
    pixels, _ = camera.project(np.array([[-1.0, -1, 0], [0, 1, 0]]))
    (x0, y0), (x1, y1) = np.minimum(*pixels), np.maximum(*pixels)
    mask[round(y0) : round(y1), round(x0) : round(x1)] = True
    return mask
