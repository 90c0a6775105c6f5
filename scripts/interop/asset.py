"""The asset of the trial: three arms from a ball, which no turn and no mirror maps onto themselves, in every format."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatpainter.io import read, write
from splatpainter.io.write_options import WriteOptions
from splatpainter.splats import SH_C0, Axes, Splats

ARMS = {  # direction in the axes of PLY files (y down), length, colour
    "up": ((0.0, -1.0, 0.0), 1.0, (0.15, 0.80, 0.20)),
    "right": ((1.0, 0.0, 0.0), 0.7, (0.90, 0.15, 0.15)),
    "front": ((0.0, 0.0, 1.0), 0.45, (0.20, 0.30, 0.95)),
}
GAUSSIANS_OF_AN_ARM = 40
BALL_COLOR = (0.85, 0.80, 0.60)


@dataclass(frozen=True)
class Trial:
    """One file that is tried everywhere."""

    name: str
    says: str
    """What is special about it, for the table."""
    axes: Axes = "auto"
    options: WriteOptions = WriteOptions()


TRIALS = (
    Trial("arrow.ply", "PLY"),
    Trial("arrow.compressed.ply", "compressed PLY"),
    Trial("arrow.splat", ".splat"),
    Trial("arrow.v2.spz", "SPZ 2", options=WriteOptions(spz_version=2)),
    Trial("arrow.v3.spz", "SPZ 3"),
    Trial("arrow.v4.spz", "SPZ 4", options=WriteOptions(spz_version=4)),
    Trial("marked.v3.spz", "SPZ 3, marked", options=WriteOptions(mark_axes=True)),
    Trial("marked.v4.spz", "SPZ 4, marked", options=WriteOptions(spz_version=4, mark_axes=True)),
    Trial("rub.v3.spz", "SPZ 3, `--axes rub`", "rub"),
    Trial("rub.v4.spz", "SPZ 4, `--axes rub`", "rub", WriteOptions(spz_version=4)),
    Trial("arrow.sog", "SOG"),
    Trial("arrow.glb", "GLB"),
)


def arrow() -> Splats:
    """Flat and long Gaussians with view-dependent colours of SH degree 3."""
    rng = np.random.default_rng(3)
    means, colors = [np.zeros((1, 3))], [np.array([BALL_COLOR])]
    for direction, length, color in ARMS.values():
        along = np.linspace(0.12, length, GAUSSIANS_OF_AN_ARM)[:, None]
        thin = 0.05 * (1 - along / length) + 0.01
        means.append(along * np.array(direction) + thin * rng.normal(size=(GAUSSIANS_OF_AN_ARM, 3)))
        colors.append(np.repeat([color], GAUSSIANS_OF_AN_ARM, 0))
    count = sum(map(len, means))
    sh = rng.uniform(-0.08, 0.08, (count, 16, 3))
    sh[:, 0] = (np.concatenate(colors) - 0.5) / SH_C0
    scales = np.exp(rng.uniform(np.log(0.012), np.log(0.05), (count, 3)))
    scales[0] = 0.09
    quats = rng.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    opacities = rng.uniform(0.6, 0.97, count)
    columns = (np.concatenate(means), quats, scales, opacities, sh)
    means, quats, scales, opacities, sh = (np.ascontiguousarray(column, np.float32) for column in columns)
    return Splats(means, quats, scales, opacities, sh)


def write_trials(folder: Path) -> dict[str, Splats]:
    """All files into `folder`; their names -> the rows that we read in them, in the axes of PLY files."""
    rows = {}
    for trial in TRIALS:
        write(folder / trial.name, arrow(), overwrite=True, axes=trial.axes, options=trial.options)
        rows[trial.name] = replace(read(folder / trial.name), source=None, origin=None)
    return rows
