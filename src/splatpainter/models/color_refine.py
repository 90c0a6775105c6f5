"""Colour rounds of the lift after the network: what it left of the edited pictures' error, on chosen rows only.

Numpy only. N rows, W views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.splats import Splats

ROUNDS = 2
DAMPING = 0.3
"""What is left of SH bands >= 1 in a fully repainted row (as LocalOptions.damping)."""


def repaint(splats: Splats, camera: Camera, wanted: np.ndarray, rows: np.ndarray, rounds: int = ROUNDS) -> Splats:
    """One view's colours on the rows. wanted: [H, W, 3] the whole picture to reach, also where nothing was edited: it
    holds rows that straddle the edit's edge; rows: [N] bool that may change. Others keep their bits."""
    from splatpainter.lift.colors import lift_colors, recolor
    from splatpainter.rendering.cpu.projected_view import project

    around = project(splats, camera, gaussian_mask=rows).tiles_of(rows)
    frame = project(splats, camera, tiles=around)
    movable = rows[frame.gaussian_ids]
    colors = lift_colors(frame, wanted, np.ones(wanted.shape[:2], np.float32), movable, rounds)
    seen = frame.unclamped_colors
    moved = movable & (np.abs(colors - np.maximum(seen, 0)).max(1) > 1 / 1024)
    if not moved.any():
        return splats
    sh = splats.sh.copy()
    sh[frame.gaussian_ids[moved]] = recolor(sh[frame.gaussian_ids[moved]], seen[moved], colors[moved], DAMPING)
    return replace(splats, sh=sh)


def polish_local(
    splats: Splats, pictures: Sequence[tuple[Camera, np.ndarray]], rows: np.ndarray, rounds: int = ROUNDS
) -> Splats:
    """(camera, wanted picture [H, W, 3]) after one another: where they disagree, the latest wins. rows: [N] bool."""
    for camera, wanted in pictures:
        splats = repaint(splats, camera, wanted, rows, rounds)
    return splats


def polish_global(
    splats: Splats, views: Sequence[tuple[Camera, np.ndarray, np.ndarray]], rounds: int = ROUNDS
) -> Splats:
    """All rows that the views show, from all of them at once. views: (camera, target [H, W, 3], mask [H, W] bool);
    pixels that the asset covers by less than 0.9 do not count."""
    from splatpainter.lift.colors import BRIGHTEST
    from splatpainter.rendering.cpu.projected_view import project
    from splatpainter.splats import SH_C0

    frames = []
    total, change = np.zeros(len(splats), np.float32), np.zeros((len(splats), 3), np.float32)
    for camera, target, mask in views:
        frame = project(splats, camera)
        _, alpha, _ = frame.rasterize()
        use = (mask & (alpha > 0.9)).astype(np.float32)
        total[frame.gaussian_ids] += frame.backproject(target, use).weight
        frames.append((frame, target, use))
    for _ in range(rounds):
        gain = np.zeros_like(change)
        for frame, target, use in frames:
            colors = np.clip(
                frame.unclamped_colors + change[frame.gaussian_ids], 0, np.maximum(frame.unclamped_colors, BRIGHTEST)
            )
            gain[frame.gaussian_ids] += frame.sirt_step(target, use, colors)[0]
        change += gain / np.maximum(total, 1e-6)[:, None]
    moved = (total > 0.05) & (np.abs(change).max(1) > 1 / 1024)
    if not moved.any():
        return splats
    sh = splats.sh.copy()
    sh[moved, 0] += change[moved] / SH_C0
    return replace(splats, sh=sh)
