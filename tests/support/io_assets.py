"""Small assets for the io tests, and readers that share nothing with the package (plain struct and numpy views)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatpainter.io import write
from splatpainter.splats import Splats

SH_C0 = 0.28209479177387814


def random_splats(count: int, degree: int, seed: int = 0, log_scale: float = -4.0) -> Splats:
    """Gaussians with values of realistic size: colours 0..1, opacities 0.02..0.98, scales around e^log_scale, non-unit
    quaternions."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(0, 0.2, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = (rng.uniform(0.05, 0.95, (count, 3)) - 0.5) / SH_C0
    return Splats(
        means=rng.normal(0, 1, (count, 3)).astype(np.float32),
        quats=rng.normal(0, 1, (count, 4)).astype(np.float32),
        scales=np.exp(rng.normal(log_scale, 1, (count, 3))).astype(np.float32),
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


def float_columns(path: Path) -> dict[str, np.ndarray]:
    """Columns of a little-endian PLY file with nothing but float properties in one element."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = [line.split() for line in head.splitlines()]
    kinds = {words[1] for words in lines if words[0] == b"property"}
    assert kinds == {b"float"} and b"binary_little_endian" in head, kinds
    names = [words[2].decode() for words in lines if words[0] == b"property"]
    table = np.frombuffer(body, "<f4").reshape(-1, len(names))
    return {name: table[:, k] for k, name in enumerate(names)}


def disagreement(splats: Splats, table: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest absolute difference of `splats` from raw PLY columns, per attribute: positions, unit quaternions up to
    sign, log-scales (where > 0), opacities, base SH, SH rest. Row counts and SH degrees must be equal."""
    rest = splats.sh.shape[1] - 1
    assert len(splats) == len(table["x"])
    assert 3 * rest == sum(name.startswith("f_rest_") for name in table)

    def stack(names: list[str]) -> np.ndarray:
        return np.stack([table[name] for name in names], 1).astype(np.float64)

    ours = splats.quats / np.linalg.norm(splats.quats.astype(np.float64), axis=1, keepdims=True)
    theirs = stack([f"rot_{k}" for k in range(4)])
    theirs /= np.linalg.norm(theirs, axis=1, keepdims=True)
    positive = splats.scales > 0
    logs = np.log(splats.scales.astype(np.float64), where=positive, out=np.zeros(splats.scales.shape))
    coefficients = [table[f"f_rest_{c * rest + k}"] for k in range(rest) for c in range(3)]
    return {
        "means": np.abs(splats.means - stack(["x", "y", "z"])).max(),
        "quats": np.minimum(np.abs(ours - theirs), np.abs(ours + theirs)).max(),
        "scales": np.abs(logs - stack(["scale_0", "scale_1", "scale_2"]))[positive].max(),
        "opacities": np.abs(splats.opacities - 1 / (1 + np.exp(-table["opacity"].astype(np.float64)))).max(),
        "base": np.abs(splats.sh[:, 0] - stack(["f_dc_0", "f_dc_1", "f_dc_2"])).max(),
        "rest": np.abs(splats.sh[:, 1:].reshape(-1) - np.stack(coefficients, 1).reshape(-1)).max() if rest else 0.0,
    }
