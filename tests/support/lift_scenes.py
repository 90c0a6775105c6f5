"""Small scenes for the tests of the lift and the painter, and a dense float64 compositor that shares nothing with the
package: scipy's rotations, numpy's inverse, every row against every pixel."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from splatpainter.cameras import Camera, look_at
from splatpainter.splats import Splats

SH_C0 = math.sqrt(1 / (4 * math.pi))
GREY = (0.5, 0.5, 0.5)


def front(size: int = 96, background: tuple[float, float, float] = GREY) -> Camera:
    """From z = 3 on the plane z = 0; a sheet of half-width 1 fills all but a rim of the picture."""
    return look_at((0, 0, 3), (0, 0, 0), width=size, height=size, fov=42, background=background)


def back(size: int = 96, background: tuple[float, float, float] = GREY) -> Camera:
    return look_at((0, 0, -3), (0, 0, 0), width=size, height=size, fov=42, background=background)


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[N, 3] smooth colours 0.2..0.8 over the plane."""
    return 0.5 + 0.3 * np.stack([np.sin(3 * x + y), np.cos(2 * y - x), np.sin(2.5 * x * y + 1)], 1)


def sheet(side: int = 50, *, z: float = 0.0, half: float = 1.0, degree: int = 0, opacity: float = 0.9) -> Splats:
    """side x side flat rows over the square of half-width `half` in the plane at z, spun about z so that no attribute
    is trivial; higher SH bands are random and small."""
    rng = np.random.default_rng(1)
    steps = np.linspace(-half, half, side)
    x, y = (part.ravel() for part in np.meshgrid(steps, steps))
    n, spacing = len(x), 2 * half / (side - 1)
    turn = rng.uniform(0, math.pi, n)
    sh = rng.normal(0, 0.03, (n, (degree + 1) ** 2, 3))
    sh[:, 0] = (texture(x, y) - 0.5) / SH_C0
    return Splats(
        means=np.stack([x, y, np.full(n, z)], 1).astype(np.float32),
        quats=(np.stack([np.cos(turn / 2), 0 * x, 0 * x, np.sin(turn / 2)], 1) * 1.7).astype(np.float32),
        scales=(spacing * np.stack([rng.uniform(0.6, 0.9, n), rng.uniform(0.6, 0.9, n), np.full(n, 0.05)], 1)).astype(
            np.float32
        ),
        opacities=np.full(n, opacity, np.float32),
        sh=sh.astype(np.float32),
    )


def row(mean, scales, color, *, quat=(1, 0, 0, 0), opacity: float = 0.9, degree: int = 0) -> Splats:
    """One row of one colour."""
    sh = np.zeros((1, (degree + 1) ** 2, 3), np.float32)
    sh[0, 0] = (np.asarray(color) - 0.5) / SH_C0
    values = (mean, quat, scales)
    means, quats, sizes = (np.asarray(value, np.float32)[None] for value in values)
    return Splats(means, quats, sizes, np.array([opacity], np.float32), sh)


def base_colors(splats: Splats) -> np.ndarray:
    """[N, 3] float64 colours of the constant band."""
    return 0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)


def disk(camera: Camera, x: float, y: float, radius: float) -> np.ndarray:
    """[H, W] bool, pixels."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.hypot(u - x, v - y) < radius


def db(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """PSNR of two pictures, over a mask."""
    squared = (a.astype(np.float64) - b) ** 2
    error = squared.mean() if mask is None else squared[mask].mean()
    return math.inf if error == 0 else -10 * math.log10(error)


def bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values).view(np.uint32)


def differing(before: Splats, after: Splats) -> np.ndarray:
    """[N] bool: rows of `before` of which any bit is another in `after`, attribute by attribute."""
    n = len(before)
    out = np.zeros(n, bool)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        old, new = getattr(before, name), getattr(after, name)[:n]
        assert old.dtype == new.dtype == np.float32
        out |= (bits(old) != bits(new)).reshape(n, -1).any(1)
    return out


def same_bits(a: Splats, b: Splats) -> bool:
    return len(a) == len(b) and not differing(a, b).any()


def dense_weights(splats: Splats, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(w [N, P], transmittance left [P]) of 3D Gaussian splatting (Kerbl et al. 2023; 0.3 px^2 blur, alphas below 1/255
    dropped, capped at 0.999): picture = w.T @ colours + left * background. For rows inside the picture."""
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    x, y, z = (splats.means.astype(np.float64) @ turn.T + shift).T
    rotations = Rotation.from_quat(splats.quats.astype(np.float64)[:, [1, 2, 3, 0]]).as_matrix()
    v, u = (part.ravel() + 0.5 for part in np.mgrid[: camera.height, : camera.width])
    alphas = np.zeros((len(splats), u.size))
    for i in range(len(splats)):
        jacobian = np.array([[camera.fx, 0, -camera.fx * x[i] / z[i]], [0, camera.fy, -camera.fy * y[i] / z[i]]]) / z[i]
        axes = jacobian @ turn @ rotations[i] @ np.diag(splats.scales[i].astype(np.float64))
        sharp = np.linalg.inv(axes @ axes.T + 0.3 * np.eye(2))
        d = np.stack([u - camera.fx * x[i] / z[i] - camera.cx, v - camera.fy * y[i] / z[i] - camera.cy])
        alphas[i] = np.minimum(splats.opacities[i] * np.exp(-0.5 * np.einsum("ip,ij,jp->p", d, sharp, d)), 0.999)
    alphas[alphas < 1 / 255] = 0
    order = np.argsort(z, kind="stable")
    left, weights = np.ones(u.size), np.zeros_like(alphas)
    for i in order:
        weights[i] = alphas[i] * left
        left = left * (1 - alphas[i])
    return weights, left


def rod(around: int, along: int, stripes: float = 0.0) -> Splats:
    """Along x, of radius 0.15, with stripes of that strength."""
    angles, steps = np.arange(around) * 2 * np.pi / around, np.linspace(-1, 1, along)
    a, x = (part.ravel() for part in np.meshgrid(angles, steps))
    colors = 0.5 + 0.25 * np.stack([np.sin(5 * x + a), np.cos(4 * x - a), np.sin(6 * x)], 1)
    colors += stripes * np.sin(30 * x + 3 * a)[:, None]
    scales = 0.75 * np.broadcast_to([2 / along, 0.3 * np.pi / around, 0.002], (len(a), 3))
    means = np.stack([x, -0.15 * np.sin(a), 0.15 * np.cos(a)], 1)
    quats = np.stack([np.cos(a / 2), np.sin(a / 2), 0 * a, 0 * a], 1)
    sh, opacities = (colors[:, None] - 0.5) / SH_C0, np.full(len(a), 0.95, np.float32)
    means, quats, scales, sh = (values.astype(np.float32) for values in (means, quats, scales, sh))
    return Splats(means, quats, scales, opacities, sh)
