"""Balls whose look from every side is an integral over a sky, matte and glossy."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from splatpainter.color import linear_to_srgb
from splatpainter.lights.skies import sky
from splatpainter.lights.sky_maps import SkyMap, lat_long
from splatpainter.splats import Splats
from splatpainter.transforms import fibonacci_sphere, sh_basis
from tests.support.cli_scenes import ball

SIGHTS = fibonacci_sphere(120)
COUNT = 1200
GREY = (0.3, 0.3, 0.3)


def looks(normals: np.ndarray, picture: SkyMap, gloss: float, albedo: tuple[float, float, float] = GREY) -> np.ndarray:
    """[N, V, 3] linear radiance along SIGHTS of a ball of an albedo and a Phong lobe of exponent 12, which has no
    colour of its own, summed over the pixels of a sky."""
    towards, areas = (grid.reshape(512, -1) for grid in lat_long(16, 32))
    height, width = picture.radiance.shape[:2]
    radiance = picture.radiance.astype(np.float64).reshape(16, height // 16, 32, width // 32, 3).mean((1, 3))
    flux = radiance.reshape(-1, 3) * areas
    flux = flux / (flux.sum() / (12 * np.pi))
    matte = np.array(albedo) / np.pi * (np.maximum(normals @ towards.T, 0) @ flux)
    mirrored = SIGHTS[None] - 2 * (normals @ SIGHTS.T)[..., None] * normals[:, None]
    fourth = np.square(np.square(np.maximum(mirrored.reshape(-1, 3) @ towards.T, 0)))
    shine = (fourth * fourth * fourth @ flux * 13 / (2 * np.pi)).reshape(len(normals), -1, 3)
    return 0.6 * (matte[:, None] + gloss * shine)


def captured(picture: SkyMap, gloss: float, noise: float = 0.0, albedo: tuple[float, float, float] = GREY) -> Splats:
    """SH of degree 2 that fit such a ball from where each Gaussian can be seen; noise: deviation of its bands."""
    splats = _noiseless(picture.name, gloss, albedo)
    sh = splats.sh.copy()
    sh[:, 1:] += np.random.default_rng(0).normal(0, noise, sh[:, 1:].shape)
    return replace(splats, sh=sh)


@cache
def _noiseless(name: str, gloss: float, albedo: tuple[float, float, float]) -> Splats:
    splats, picture = ball(COUNT, degree=2), sky(name)
    normals = splats.means / np.linalg.norm(splats.means, axis=1, keepdims=True)
    display, sh = linear_to_srgb(looks(normals, picture, gloss, albedo)), np.empty(splats.sh.shape)
    basis = sh_basis(SIGHTS, 2)
    for k, normal in enumerate(normals):
        there = SIGHTS @ normal < -0.1
        seen = basis[there]
        # A little damped, as what no view holds is 0 in a fit.
        matrix = seen.T @ seen + 1e-3 * len(seen) * np.diag([0] + [1] * 8)
        sh[k] = np.linalg.solve(matrix, seen.T @ (display[k][there] - 0.5))
    return replace(splats, sh=sh.astype(np.float32))
