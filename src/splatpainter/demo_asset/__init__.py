"""The bundled demo asset: a teapot, a bowl of tea and a lemon on a round board, made of Gaussians by this code alone.

Made with numpy in a few seconds; the same seed gives the same rows.
"""

from __future__ import annotations

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.splats import Splats

HERO_EYE = (0.46, 0.92, 3.6)
"""Recommended camera: where it stands ..."""
HERO_TARGET = (0.0, -0.11, 0.0)
"""... what it looks at ..."""
HERO_FOV = 33.0
"""... and its vertical field of view, degrees."""
BACKGROUND = (0.235, 0.295, 0.325)
"""A background that suits the still life, display sRGB."""
CALM = (0.335, 0.455, 0.625, 0.555)
"""Left, top, right, bottom of the pot's empty belly in the recommended view, as parts of the picture's size."""
FLATNESS = 0.1
"""Thickness of a row along the normal, of its smaller tangent size."""
LIFT = 0.45
"""The scene is built standing on y = 0 and lowered by this, so that it turns about the origin."""


def demo_asset(seed: int = 0) -> Splats:
    """The still life: 85-90 thousand surface-aligned rows of SH degree 3, y up, about 2 units across, centred near the
    origin; float32 numpy, colours display sRGB. seed: jitter and opacities of the rows; the scene itself is fixed."""
    from splatpainter.demo_asset.scene import still_life

    rng = np.random.default_rng(seed)
    rows, sh = still_life(rng)
    axes = np.stack([rows.tangents, np.cross(rows.normals, rows.tangents), rows.normals], 2)
    scales = np.concatenate([rows.sizes, FLATNESS * rows.sizes.min(1, keepdims=True)], 1)
    opacities = rng.uniform(0.88, 0.97, len(sh))
    arrays = (rows.points - [0, LIFT, 0], _quaternions(axes), scales, opacities, sh)
    means, quats, scales, opacities, sh = (np.ascontiguousarray(array, np.float32) for array in arrays)
    return Splats(means, quats, scales, opacities, sh)


def demo_view(size: int = 800) -> Camera:
    """The recommended view of the still life, size x size pixels."""
    return look_at(HERO_EYE, HERO_TARGET, width=size, height=size, fov=HERO_FOV, background=BACKGROUND)


def _quaternions(m: np.ndarray) -> np.ndarray:
    """[N, 4] unit quaternions w, x, y, z of the rotation matrices [N, 3, 3].

    The outer product 4 q q^T is linear in the matrix; its row with the largest diagonal gives q without cancellation
    (Shepperd 1978).
    """
    outer = np.empty((len(m), 4, 4))
    for i, signs in enumerate(((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))):
        outer[:, i, i] = 1 + np.einsum("njj,j->n", m, signs)
    for j, (a, b) in enumerate(((1, 2), (2, 0), (0, 1)), 1):  # w against x, y, z; then the other two of those
        outer[:, 0, j] = outer[:, j, 0] = m[:, b, a] - m[:, a, b]
        outer[:, a + 1, b + 1] = outer[:, b + 1, a + 1] = m[:, a, b] + m[:, b, a]
    best = outer[np.arange(len(m)), np.einsum("nii->ni", outer).argmax(1)]
    return best / np.linalg.norm(best, axis=1, keepdims=True)
