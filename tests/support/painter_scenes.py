"""A small asset, dabs of paint on it, and tiny models, for the tests of painting with networks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from splatpainter.cameras import Camera
from splatpainter.models.config import ModelConfig
from splatpainter.models.model import SplatPainterModel
from splatpainter.painter import Edit
from splatpainter.rendering import render
from splatpainter.splats import Splats
from tests.support.lift_scenes import back, disk, front, row, sheet
from tests.support.model_scenes import TINY, with_refine

RED, BLUE, GREEN = (0.9, 0.1, 0.1), (0.1, 0.15, 0.9), (0.1, 0.8, 0.2)
SIZE = 64
CAMERA, REAR = front(SIZE), back(SIZE)
FRONT, DRAWABLE = 30 * 30, 30 * 30 + 14 * 14
"""Rows of the front sheet come first; the two last rows cannot be drawn."""

ASSET_BASE = with_refine(TINY, base="own")
LIFT = with_refine(TINY, base="lift", detail=False)
COPY = replace(with_refine(TINY, lift_features=False), representation="copy")


def thing() -> Splats:
    """An opaque sheet, another one some way behind it, and two rows that cannot be drawn."""
    odd = row((np.nan, 0, 0), (0.1, 0.1, 0.1), RED, degree=1).append(row((0, 0, 0), (0.1, 0, 0.1), RED, degree=1))
    return sheet(30, degree=1, opacity=0.98).append(sheet(14, z=-0.6, degree=1, opacity=0.98)).append(odd)


def uneven() -> Splats:
    """The same with no two rows at one depth in any view: there the order of the rows decides which is in front."""
    splats = thing()
    noise = np.random.default_rng(2).normal(0, 0.003, splats.means.shape).astype(np.float32)
    return replace(splats, means=splats.means + noise, opacities=splats.opacities - np.abs(noise[:, 0]))


def built(config: ModelConfig = ASSET_BASE, *, awake: float = 0.0, seed: int = 7) -> SplatPainterModel:
    """An untrained model, or one whose head says something: N(0, awake)."""
    torch.manual_seed(seed)
    model = SplatPainterModel(config).eval()
    if awake:
        torch.nn.init.normal_(model.head.linear.weight, std=awake)
    return model


def dab(splats: Splats, color: tuple, x: float = 32, y: float = 32, radius: float = 7, camera: Camera = CAMERA) -> Edit:
    """A disk of one colour painted on the render."""
    mask = disk(camera, x, y, radius)
    return Edit(np.where(mask[..., None], np.array(color, np.float32), render(splats, camera).colors[0]), camera, mask)


def grade(splats: Splats, camera: Camera = CAMERA) -> Edit:
    """The whole view warmer and darker."""
    return Edit(
        np.clip(render(splats, camera).colors[0], 0, 1) ** 1.3 * np.array([1.05, 0.92, 0.78], np.float32), camera
    )
