"""Small hand-made assets for the tests of voxels and rays."""

from __future__ import annotations

from typing import Any

import numpy as np

from splatpainter.splats import Splats

IDENTITY = (1.0, 0.0, 0.0, 0.0)


def make(means: Any, scales: Any = 0.01, opacities: Any = 0.9, quats: Any = IDENTITY) -> Splats:
    """Rows at means [N, 3]; the rest one value for all rows or one per row."""
    means = np.asarray(means, np.float32).reshape(-1, 3)
    n = len(means)
    return Splats(
        means,
        np.broadcast_to(np.float32(quats), (n, 4)).copy(),
        np.broadcast_to(np.float32(scales), (n, 3)).copy(),
        np.broadcast_to(np.float32(opacities), (n,)).copy(),
        np.zeros((n, 1, 3), np.float32),
    )
