"""Light of the still life: shadows and ambient occlusion through a distance field, a glaze that mirrors a studio, and
the spherical harmonics that carry what depends on the view. Knows surfaces as points, normals, albedo and gloss only.

Everything is computed in linear light and fitted as display sRGB, which is what the Gaussians store.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from examples.still_life.shapes import GOLDEN, unit

KEY = unit(np.array([-0.60, 0.74, 0.62])).astype(np.float32)
"""Direction towards the main light, a large warm window high on the left."""
KEY_COLOUR = np.array([1.00, 0.93, 0.82]) * 2.05
SKY_TOP, SKY_SIDE = np.array([0.80, 0.86, 0.95]), np.array([0.66, 0.69, 0.73])
BOUNCE = np.array([0.54, 0.37, 0.24])
"""Light that comes back from the board."""
WINDOW, STRIP = KEY_COLOUR * 15, np.array([3.0, 3.7, 4.5])
"""Mirror images of the two lights; brighter than life, since SH spread what they show."""
SIDE = unit(np.array([0.90, 0.28, 0.10])).astype(np.float32)
"""Direction of the cool strip light that outlines the right-hand side."""

RIDGE = 0.002
"""Weight that pulls the view-dependent coefficients to 0, against wild colours where no viewpoint looks from."""


@dataclass(frozen=True)
class Field:
    """Signed distances to the whole scene, sampled on a grid and read back trilinearly."""

    low: np.ndarray
    """[3] the corner of the grid, world units."""
    cell: float
    """World units between samples."""
    values: np.ndarray
    """[X, Y, Z] float32 distance, negative inside."""

    @staticmethod
    def sample(distance: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, cell: float) -> Field:
        """distance: [N, 3] -> [N]."""
        axes = [np.arange(a, b + cell, cell) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        return Field(
            np.asarray(low, np.float32), cell, distance(grid.reshape(-1, 3)).reshape(grid.shape[:3]).astype("f4")
        )

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """[N] distance; outside the grid the value at its nearest face."""
        nx, ny, nz = self.values.shape
        at = (points - self.low) * np.float32(1 / self.cell)
        at = np.clip(at, 0, np.array([nx - 1.001, ny - 1.001, nz - 1.001], np.float32))
        i = at.astype(np.int32)
        fx, fy, fz = (at - i).T
        flat = self.values.ravel()
        first = (i[:, 0] * ny + i[:, 1]) * nz + i[:, 2]

        def along_z(offset: int) -> np.ndarray:
            near = flat[first + offset]
            return near + (flat[first + offset + 1] - near) * fz

        a, b = along_z(0), along_z(ny * nz)
        c, d = along_z(nz), along_z(ny * nz + nz)
        a = a + (b - a) * fx
        return a + (c + (d - c) * fx - a) * fy


def shadow(field: Field, points: np.ndarray, normals: np.ndarray, towards: np.ndarray, sharpness: float) -> np.ndarray:
    """[N] 0..1: how much of a round light around the direction `towards` is seen. sharpness: 1 / tan of the light's
    half-angle. One ray per point, the narrowest clearance along it (Quilez's soft shadows, with negative clearance)."""
    start = points + 0.014 * normals
    clear = np.full(len(points), 1.0, np.float32)
    t = np.full(len(points), 0.015, np.float32)
    for _ in range(22):
        gap = field(start + t[:, None] * towards)
        clear = np.minimum(clear, sharpness * gap / t)
        t = t + np.clip(gap, 0.018, 0.12)
    clear = np.clip(0.5 + 0.5 * clear, 0, 1)
    return clear * clear * (3 - 2 * clear)


def ambient(field: Field, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(light [N, 3], openness [N] 0..1): what reaches each point from the sky and, where something far off hides
    it, from the sunlit board (what is close by is dark itself). Seven wide cones around the normal, six steps each."""
    helper = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]]).astype(np.float32)
    side = unit(np.cross(helper, normals))
    other = np.cross(normals, side)
    light, openness = np.zeros_like(points), np.zeros(len(points), np.float32)
    returned = np.zeros(len(points), np.float32)
    for k in range(7):
        turn = 2 * np.pi * k / 6
        tilt, weight = (0.0, 0.28) if k == 6 else (np.radians(58), 0.12)
        towards = np.cos(tilt) * normals + np.sin(tilt) * (np.cos(turn) * side + np.sin(turn) * other)
        clear, distant = np.ones(len(points), np.float32), np.zeros(len(points), np.float32)
        for t in (0.03, 0.06, 0.12, 0.22, 0.36, 0.56):
            gap = field(points + 0.01 * normals + t * towards)
            less = np.clip(np.minimum(clear, 1.9 * gap / t), 0, 1)
            distant += (clear - less) * min(1.0, t / 0.3)
            clear = less
        up = 0.5 + 0.5 * towards[:, 1:2]
        light += weight * clear[:, None] * (SKY_SIDE + (SKY_TOP - SKY_SIDE) * up) * (0.35 + 0.65 * up)
        openness += weight * clear
        returned += weight * distant
    sunny = 0.75 + 0.25 * (normals @ unit(KEY * [1, 0, 1]).astype(np.float32))
    return light + BOUNCE * (returned * sunny)[:, None], openness


def mirrored(normals: np.ndarray, views: np.ndarray, cosine: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """[N, D, 3] linear light of the studio that N mirrors show to D views: a window, a strip, a soft room, the board.

    normals [N, 3], views [D, 3]: unit vectors, the latter towards the camera; cosine [N, D] between them; blur [N]: 0
    (mirror) .. 1. The mirrored direction is 2 cosine normal - view; only its dot products with fixed ones are needed.
    """

    def along(axis: np.ndarray) -> np.ndarray:
        return 2 * cosine * (normals @ axis)[:, None] - views @ axis

    soft = (0.10 + 0.50 * blur)[:, None]
    strength = 0.1 / (0.05 + 0.5 * soft)  # a blurred light is spread, not brighter

    def lamp(axis: np.ndarray, rim: float) -> np.ndarray:
        t = np.clip((along(axis) - (rim - soft)) / soft, 0, 1)
        return t * t * (3 - 2 * t) * strength

    y = along(np.array([0, 1, 0], np.float32))
    up, below = np.clip(0.5 + 0.5 * y, 0, 1), np.clip(-3 * y, 0, 1)
    room = up * (1 - below)
    parts = np.stack([room, room * up * up, below, lamp(KEY, 0.93), lamp(SIDE, 0.95)], -1)
    return parts @ np.stack([0.45 * SKY_SIDE, 0.55 * SKY_TOP, 0.7 * BOUNCE, WINDOW, STRIP]).astype(np.float32)


def display(light: np.ndarray) -> np.ndarray:
    """Linear light, >= 0 -> display sRGB, highlights rolled off above 0.7 so that the window never clips hard."""
    over = np.maximum(light - 0.70, 0)
    rolled = np.minimum(light, 0.70) + over / (1 + over / 0.55)
    rolled = np.maximum(rolled, 0)
    return np.where(rolled < 0.0031308, 12.92 * rolled, 1.055 * np.power(np.maximum(rolled, 1e-6), 1 / 2.4) - 0.055)


def linear(srgb: np.ndarray) -> np.ndarray:
    """Display sRGB 0..1 -> linear light."""
    c = np.clip(srgb, 0, 1)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def sh_basis(directions: np.ndarray) -> np.ndarray:
    """[..., 16] real spherical harmonics of degree 0-3 with INRIA's signs and order. directions [..., 3]: unit vectors
    from the camera to the Gaussian, as 3D Gaussian Splatting defines them."""
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    xx, yy, zz = x * x, y * y, z * z
    terms = [
        np.full_like(x, 0.28209479177387814),
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (3 * zz - 1),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (5 * zz - 1),
        0.3731763325901154 * z * (5 * zz - 3),
        -0.4570457994644658 * x * (5 * zz - 1),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack(terms, -1)


def viewpoints(count: int) -> np.ndarray:
    """[count, 3] unit vectors from the scene towards the cameras it is made for: all around, from a little below the
    horizon to steeply above."""
    i = np.arange(count) + 0.5
    y = 0.90 - 1.0 * i / count
    ring = np.sqrt(1 - y * y)
    return np.stack([ring * np.cos(i * GOLDEN), y, ring * np.sin(i * GOLDEN)], 1).astype(np.float32)


def fit_sh(
    normals: np.ndarray, diffuse: np.ndarray, gloss: np.ndarray, openness: np.ndarray, count: int = 80
) -> np.ndarray:
    """[N, 16, 3] degree-3 SH of what each Gaussian shows, by weighted least squares over `count` viewpoints.

    normals [N, 3]; diffuse [N, 3] linear light that leaves equally in all directions; gloss [N] 0 matt .. 1 glazed;
    openness [N] 0..1 scales reflections. Only viewpoints on the Gaussian's own side count (a Gaussian is not seen from
    behind), which leaves the coefficients free to draw a tighter highlight than a fit over the whole sphere could.
    """
    views = viewpoints(count)
    basis = sh_basis(-views).astype(np.float32)
    size = basis.shape[1]
    pairs = (basis[:, :, None] * basis[:, None, :]).reshape(count, size * size)
    ridge = np.diag(np.r_[1e-4, np.full(size - 1, RIDGE)]).astype(np.float32)
    out = np.empty((len(normals), size, 3), np.float32)
    for start in range(0, len(normals), 4096):  # blocks small enough for the cache
        part = slice(start, start + 4096)
        n, shine = normals[part], gloss[part, None]
        facing = n @ views.T
        cosine = np.maximum(facing, 0.02)
        fresnel = 0.045 + 0.60 * (1 - cosine) ** 5
        reflected = (fresnel * shine * openness[part, None])[..., None] * mirrored(n, views, cosine, 1 - shine[:, 0])
        seen = display(diffuse[part, None] + reflected) - 0.5
        weight = np.clip((facing + 0.05) / 0.25, 0.004, 1)
        left = (weight @ pairs).reshape(-1, size, size) / count + ridge
        right = basis.T @ (weight[..., None] * seen) / count
        out[part] = np.linalg.solve(left, right)
    return out
