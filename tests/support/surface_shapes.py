"""Gaussians on shapes whose exponential map is exact: a sphere, a cylinder, a box. Grey; y is up."""

from __future__ import annotations

import numpy as np

from splatpainter.splats import Splats
from splatpainter.transforms import matrix_to_quat

GREY = 0.55


def patches(points: np.ndarray, normals: np.ndarray, width: float, seed: int = 0, noise: float = 0.0) -> Splats:
    """Flat round Gaussians of a standard deviation. noise: rms height off the surface, in widths."""
    rng = np.random.default_rng(seed)
    side = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.8, (1.0, 0, 0), (0, 1.0, 0)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    rotation = np.stack([side, np.cross(normals, side), normals], 2)
    count = len(points)
    points = points + noise * width * rng.standard_normal((count, 1)) * normals
    scales = np.tile(np.array([width, width, 0.1 * width]), (count, 1)) * rng.uniform(0.8, 1.2, (count, 1))
    sh = np.full((count, 1, 3), (GREY - 0.5) / 0.28209479177387814)
    sh = sh + 0.03 * rng.standard_normal((count, 1, 3))
    arrays = (points, matrix_to_quat(rotation), scales, np.full(count, 0.95), sh)
    means, quats, scales, opacities, sh = (np.ascontiguousarray(a, np.float32) for a in arrays)
    return Splats(means, quats, scales, opacities, sh)


def _even(count: int) -> np.ndarray:
    """[count, 2] in 0..1: Roberts' R2 sequence."""
    k = np.arange(1, count + 1)[:, None]
    return (0.5 + k * np.array([0.7548776662466927, 0.5698402909980532])) % 1


def sphere(count: int = 40_000, radius: float = 1.0, noise: float = 0.0) -> Splats:
    uv = _even(count)
    height, angle = 2 * uv[:, 0] - 1, 2 * np.pi * uv[:, 1]
    ring = np.sqrt(1 - height**2)
    normals = np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], 1)
    return patches(radius * normals, normals, 0.7 * radius * np.sqrt(4 * np.pi / count), noise=noise)


def cylinder(count: int = 40_000, radius: float = 0.6, height: float = 2.0, noise: float = 0.0) -> Splats:
    """Around y, without caps."""
    uv = _even(count)
    angle = 2 * np.pi * uv[:, 0]
    normals = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], 1)
    points = radius * normals + np.stack([0 * angle, height * (uv[:, 1] - 0.5), 0 * angle], 1)
    return patches(points, normals, 0.7 * np.sqrt(2 * np.pi * radius * height / count), noise=noise)


def box(count: int = 60_000, half: tuple[float, float, float] = (0.5, 0.5, 0.5), noise: float = 0.0) -> Splats:
    """Around 0, all six faces."""
    areas = [4 * half[(a + 1) % 3] * half[(a + 2) % 3] for a in range(3)]
    total = 2 * sum(areas)
    points, normals = [], []
    for a in range(3):
        for sign in (-1, 1):
            n = round(count * areas[a] / total)
            uv = 2 * _even(n) - 1
            p, m = np.zeros((n, 3)), np.zeros((n, 3))
            p[:, a], m[:, a] = sign * half[a], sign
            p[:, (a + 1) % 3], p[:, (a + 2) % 3] = uv[:, 0] * half[(a + 1) % 3], uv[:, 1] * half[(a + 2) % 3]
            points.append(p)
            normals.append(m)
    return patches(np.concatenate(points), np.concatenate(normals), 0.7 * np.sqrt(total / count), noise=noise)
