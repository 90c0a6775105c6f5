"""Make src/splatpainter/demo_asset.sog: python -m examples.still_life, from the repository's root (some seconds).

With --check nothing is written: exit 1 where the file is not what this code makes. Powers and linear
solves may round otherwise on other processors, so that is a check for the machine that made the file, not a test.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from examples.still_life.scene import still_life
from splatpainter.demo_asset import FILE
from splatpainter.io import write
from splatpainter.splats import Splats

FLATNESS = 0.1
"""Thickness of a Gaussian along the normal, of its smaller tangent size."""
LIFT = 0.45
"""The scene is built standing on y = 0 and lowered by this, so that it turns about the origin."""


def make(seed: int = 0) -> Splats:
    """The still life, before it is packed. seed: jitter and opacities of the Gaussians; the scene itself is
    fixed."""
    rng = np.random.default_rng(seed)
    gaussians, sh = still_life(rng)
    axes = np.stack([gaussians.tangents, np.cross(gaussians.normals, gaussians.tangents), gaussians.normals], 2)
    scales = np.concatenate([gaussians.sizes, FLATNESS * gaussians.sizes.min(1, keepdims=True)], 1)
    opacities = rng.uniform(0.88, 0.97, len(sh))
    arrays = (gaussians.points - [0, LIFT, 0], quaternions(axes), scales, opacities, sh)
    means, quats, scales, opacities, sh = (np.ascontiguousarray(array, np.float32) for array in arrays)
    return Splats(means, quats, scales, opacities, sh)


def main() -> int:
    made = make()
    if "--check" in sys.argv[1:]:
        with tempfile.TemporaryDirectory() as folder:
            write(fresh := Path(folder, FILE.name), made)
            same = fresh.read_bytes() == FILE.read_bytes()
        print(f"{FILE.name}: {'the same' if same else 'other'} bytes")
        return 0 if same else 1
    write(FILE, made, overwrite=True)
    print(f"{FILE}: {len(made)} Gaussians, {FILE.stat().st_size / 1e6:.1f} MB")
    return 0


def quaternions(m: np.ndarray) -> np.ndarray:
    """[N, 4] unit quaternions w, x, y, z of the rotation matrices [N, 3, 3].

    The outer product 4 q q^T is linear in the matrix; its row with the largest diagonal gives q without
    cancellation (Shepperd 1978).
    """
    outer = np.empty((len(m), 4, 4))
    for i, signs in enumerate(((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))):
        outer[:, i, i] = 1 + np.einsum("njj,j->n", m, signs)
    for j, (a, b) in enumerate(((1, 2), (2, 0), (0, 1)), 1):  # w against x, y, z; then the other two of those
        outer[:, 0, j] = outer[:, j, 0] = m[:, b, a] - m[:, a, b]
        outer[:, a + 1, b + 1] = outer[:, b + 1, a + 1] = m[:, a, b] + m[:, b, a]
    best = outer[np.arange(len(m)), np.einsum("nii->ni", outer).argmax(1)]
    return best / np.linalg.norm(best, axis=1, keepdims=True)


if __name__ == "__main__":
    sys.exit(main())
