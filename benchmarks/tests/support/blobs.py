"""Five balls, an edit of one of them, and Gaussians moved into other frames by scipy, for the tests of adapters."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from splatbench.cases import EditStep, PosedImages
from splatbench.methods import EditTask

from splatpainter import io
from splatpainter.cameras import look_at, orbit
from splatpainter.rendering import render
from splatpainter.splats import SH_C0, Splats
from splatpainter.voxels.grid import bounding_cube

SIZE = 64
MEANS = np.array([[0.9, 0.1, 0.2], [-0.3, 0.7, 0.4], [0.2, -0.5, 0.9], [0.3, 0.3, -0.6], [-0.6, -0.4, -0.3]]) + (
    2,
    1,
    3,
)
COLORS = np.array([[0.9, 0.8, 0.1], [0.2, 0.7, 0.3], [0.3, 0.4, 0.9], [0.8, 0.5, 0.7], [0.5, 0.9, 0.9]])
PAINTED = 2
RED = (0.9, 0.1, 0.1)
C1 = math.sqrt(3 / (4 * math.pi))


def blobs(colors: np.ndarray = COLORS) -> Splats:
    """Five opaque balls of 31 Gaussians, no two of one colour, away from the origin."""
    k = np.arange(30)
    z, turn = 1 - (2 * k + 1) / 30, 2.4 * k
    shell = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    ball = np.concatenate([np.zeros((1, 3)), 0.12 * shell])
    means = (MEANS[:, None] + ball).reshape(-1, 3).astype(np.float32)
    sh = np.repeat((colors - 0.5) / SH_C0, len(ball), 0)[:, None].astype(np.float32)
    ones = np.ones((len(means), 1), np.float32)
    return Splats(means, ones * [1, 0, 0, 0], ones * [0.05, 0.045, 0.055], 0.95 * ones[:, 0], sh)


def canonical(splats: Splats) -> Splats:
    return io.canonical(splats)


ASSET = canonical(blobs())
MIDDLE = MEANS.mean(0)
FRONT = look_at(MIDDLE + (0, 0, 4), MIDDLE, width=SIZE, height=SIZE, fov=40)


def edited() -> Splats:
    """One ball red, with view dependence everywhere."""
    colors = COLORS.copy()
    colors[PAINTED] = RED
    splats = blobs(colors)
    bands = np.random.default_rng(4).normal(0, 0.15, (len(splats), 3, 3))
    quats = np.random.default_rng(5).normal(0, 1, (len(splats), 4))
    sh = np.concatenate([splats.sh, bands], 1).astype(np.float32)
    return canonical(replace(splats, sh=sh, quats=quats.astype(np.float32), scales=splats.scales * [1, 0.5, 0.7]))


def flat(splats: Splats) -> Splats:
    """Without view dependence, as TRELLIS's Gaussians are."""
    return replace(splats, sh=splats.sh[:, :1])


def moved(splats: Splats, turn: np.ndarray, scale: float, shift: np.ndarray) -> Splats:
    """x -> scale turn x + shift by scipy and by hand: SH of band 1 are a vector, (-c3, -c1, c2)."""
    rotations = Rotation.from_quat(splats.quats[:, [1, 2, 3, 0]])
    quats = (Rotation.from_matrix(turn) * rotations).as_quat()[:, [3, 0, 1, 2]]
    sh = splats.sh.astype(np.float64).copy()
    if sh.shape[1] == 4:
        x, y, z = turn @ np.stack([-sh[:, 3], -sh[:, 1], sh[:, 2]], 1).transpose(1, 0, 2).reshape(3, -1)
        sh[:, 1], sh[:, 2], sh[:, 3] = (part.reshape(-1, 3) for part in (-y, z, -x))
    means = scale * splats.means.astype(np.float64) @ turn.T + shift
    return canonical(replace(splats, means=means, quats=quats, scales=splats.scales * scale, sh=sh))


def work(kind: str = "stroke") -> EditTask:
    before = render(ASSET, FRONT).colors[0]
    where = FRONT.world_to_camera[:3, :3] @ MEANS[PAINTED] + FRONT.world_to_camera[:3, 3]
    x, y = FRONT.fx * where[0] / where[2] + FRONT.cx, FRONT.fy * where[1] / where[2] + FRONT.cy
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    mask = np.hypot(columns - x, rows - y) < 3
    picture = np.where(mask[..., None], np.array(RED, np.float32), before)
    step = EditStep("local", kind, PosedImages((FRONT,), picture[None]), mask[None])
    around = orbit(MIDDLE, 4, 9, width=SIZE, height=SIZE, fov=40)
    return EditTask("creative", ASSET, PosedImages(tuple(around), np.clip(render(ASSET, around).colors, 0, 1)), step)


def trellis(splats: Splats) -> Splats:
    """In TRELLIS's frame, written out: the cube's middle at 0, its edge 1, y up turned to z up."""
    lo, size = bounding_cube(ASSET)
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return moved(splats, turn, 1 / size, -turn @ (lo / size + 0.5))


def same(a: Splats, b: Splats) -> float:
    """Worst PSNR of renders from all around."""
    cameras = orbit(MIDDLE, 4, 5, elevation=20, width=SIZE, height=SIZE, fov=40)
    error = ((render(a, cameras).colors - render(b, cameras).colors) ** 2).mean((1, 2, 3)).max()
    return float(-10 * np.log10(error + 1e-12))


def answer(tmp_path: Path, splats: Splats) -> None:
    io.write(tmp_path / "rows.ply", splats, overwrite=True)
    (tmp_path / "rows.ply").rename(tmp_path / "answer")
