"""Small sound files made by our own writers, and rows to make them of. No file of the corpus is kept anywhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatpainter.io import write
from splatpainter.splats import SH_C0, Splats


def rows(count: int, degree: int, seed: int = 0) -> Splats:
    """Random rows with values of realistic size."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(0, 0.2, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = (rng.uniform(0.05, 0.95, (count, 3)) - 0.5) / SH_C0
    return Splats(
        means=rng.normal(0, 1, (count, 3)).astype(np.float32),
        quats=rng.normal(0, 1, (count, 4)).astype(np.float32),
        scales=np.exp(rng.normal(-2, 1, (count, 3))).astype(np.float32),
        opacities=rng.uniform(0.02, 0.98, count).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def written(folder: Path, name: str, splats: Splats) -> bytes:
    """The bytes of a file that `write` makes."""
    path = folder / name
    path.unlink(missing_ok=True)
    write(path, splats)
    data = path.read_bytes()
    path.unlink()
    return data
