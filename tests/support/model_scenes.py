"""Small scenes and models for the model tests: made of numbers alone, without renderer or weights from anywhere."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from splatpainter.cameras import Camera, orbit
from splatpainter.models.config import CompressConfig, LrmConfig, ModelConfig, RefineConfig
from splatpainter.models.gaussian_groups import TokenLinks
from splatpainter.models.image_tokens import Pictures
from splatpainter.models.lrm import AssetViews
from splatpainter.splats import Splats
from splatpainter.voxels.grid import VoxelGrid, voxelize

SIZE = 32
"""Pixels per edge of every view."""

TINY = ModelConfig(
    preset="tiny",
    representation="native",
    sh_degree=1,
    lrm=LrmConfig(dim=24, layers=1, heads=2, hidden=48, sh_degree=1, views=2, image_size=SIZE),
    compress=CompressConfig(
        dim=32, heads=2, encoder_layers=2, decoder_layers=2, hidden=40, resolution=4, latent_queries=4
    ),
    refine=RefineConfig(
        blocks=2,
        fast_hidden=48,
        hidden=40,
        heads=2,
        image_channels=("edited", "rays", "render", "geometry", "mask"),
        mask_tokens=True,
        lift_features=True,
    ),
)
"""Every part of the model, in a hundredth of a second."""


def shell(count: int = 200, degree: int = 1, seed: int = 0) -> Splats:
    """Gaussians on a sphere of radius 1 around (3, -2, 5), numpy float32; no two opacities are equal."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    return Splats(
        means=(means + (3, -2, 5)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        scales=rng.uniform(0.01, 0.1, (count, 3)).astype(np.float32),
        opacities=rng.permutation(np.linspace(0.02, 0.98, count)).astype(np.float32),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def cameras(count: int = 2, size: int = SIZE) -> list[Camera]:
    return orbit((3, -2, 5), 3.0, count, width=size, height=size)


def pictures(count: int = 2, seed: int = 1, edited_share: float = 0.3, size: int = SIZE) -> Pictures:
    """Noise from `cameras`, with every channel; a random share of the pixels of the upper half is edited."""
    rng = np.random.default_rng(seed)

    def noise(channels: int) -> torch.Tensor:
        return torch.from_numpy(rng.random((count, size, size, channels), np.float32))

    mask = (noise(1) < edited_share).float()
    mask[:, size // 2 :] = 0
    return Pictures(cameras(count, size), noise(3), noise(3), 2 + 2 * noise(1), noise(1), mask)


def asset_views(config: ModelConfig, seed: int = 2) -> AssetViews:
    rng = np.random.default_rng(seed)
    size, count = config.lrm.image_size, config.lrm.views
    colors, depth, alpha = (torch.from_numpy(rng.random((count, size, size, c), np.float32)) for c in (3, 1, 1))
    return AssetViews(cameras(count, size), colors, 2 + 2 * depth, alpha, center=(3.0, -2.0, 5.0), half_extent=1.2)


def links(count: int, tokens: int, seed: int = 3) -> TokenLinks:
    """Three random tokens per Gaussian; every seventh Gaussian is seen by no view."""
    rng = np.random.default_rng(seed)
    weights = rng.random((count, 3), np.float32)
    weights /= weights.sum(1, keepdims=True)
    weights[::7] = 0
    return TokenLinks(rng.integers(0, tokens, (count, 3)), weights)


def grid_of(splats: Splats[Any], config: ModelConfig) -> VoxelGrid:
    return voxelize(splats, config.compress.resolution)


def with_refine(config: ModelConfig, **changes: object) -> ModelConfig:
    return replace(config, refine=replace(config.refine, **changes))  # type: ignore[arg-type]


def with_compress(config: ModelConfig, **changes: object) -> ModelConfig:
    return replace(config, compress=replace(config.compress, **changes))  # type: ignore[arg-type]


def shallow(config: ModelConfig, layers: int = 1) -> ModelConfig:
    """The same model with `layers` LRM blocks, encoder and decoder layers and refinement blocks."""
    return replace(
        config,
        lrm=replace(config.lrm, layers=layers),
        compress=replace(config.compress, encoder_layers=layers, decoder_layers=layers),
        refine=replace(config.refine, blocks=layers),
    )
