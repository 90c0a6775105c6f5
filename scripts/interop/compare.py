"""What another program's numbers are beside ours: which way they point, and where they differ. Knows no program."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatpainter.io.axes import flip
from splatpainter.splats import SH_C0, Splats
from splatpainter.transforms import quat_to_matrix

Signs = tuple[int, int, int]
TURNS = {
    (1, 1, 1): "same",
    (1, -1, -1): "upside down",
    (-1, -1, 1): "turned about z",
    (-1, 1, -1): "turned about y",
}
TOLERANCES = {"positions": 2e-3, "shapes": 0.1, "opacities": 0.012, "colours": 0.012, "SH": 0.03}
"""Largest difference that passes for the format's own rounding, and the program's (positions: of the asset's length;
shapes: of the largest entry of a covariance). Beyond it the table names it."""


@dataclass(frozen=True)
class Cell:
    """One file in one program."""

    error: str = ""
    signs: Signs = (1, 1, 1)
    """Signs that lead from the axes of PLY files to the program's world."""
    differences: tuple[str, ...] = ()


def compared(ours: Splats, answer: Mapping[str, Any]) -> Cell:
    """answer: positions [N, 3] (flat or not) and, where the program tells them, scales and quats (w x y z) or
    covariances, opacities, base and rest or colors (0..1)."""
    if "error" in answer:
        return Cell(str(answer["error"]))
    theirs = np.asarray(answer["positions"], np.float64).reshape(-1, 3)
    if len(theirs) == 0:
        return Cell("no Gaussians")
    signs, nearest, gap = _axes(ours.means.astype(np.float64), theirs)
    rows = flip(ours, signs).take(nearest)
    gaps = {"positions": gap}
    gaps["opacities"] = _gap(answer, "opacities", rows.opacities[:, None], 1)
    if "base" in answer:
        gaps["colours"] = SH_C0 * _gap(answer, "base", rows.sh[:, 0], 3)
    else:
        gaps["colours"] = _gap(answer, "colors", np.clip(0.5 + SH_C0 * rows.sh[:, 0], 0, 1), 3)
    if "rest" in answer:
        rest = np.asarray(answer["rest"], np.float64).reshape(len(theirs), -1, 3)
        bands = min(rest.shape[1], rows.sh.shape[1] - 1)
        gaps["SH"] = float(np.abs(rest[:, :bands] - rows.sh[:, 1 : 1 + bands]).max(initial=0))
    gaps["shapes"] = _shape_gap(rows, answer)
    differences = [f"{name} {gap:.2g}" for name, gap in gaps.items() if gap > TOLERANCES[name]]
    if len(theirs) != len(ours):
        differences.insert(0, f"{len(theirs)} of {len(ours)} Gaussians")
    return Cell("", signs, tuple(differences))


def turned(cell: Cell, ply: Cell) -> str:
    """How the asset stands beside the program's own PLY."""
    signs = tuple(a * b for a, b in zip(cell.signs, ply.signs, strict=True))
    return TURNS.get(signs, "mirrored")  # type: ignore[arg-type]


def _axes(ours: np.ndarray, theirs: np.ndarray) -> tuple[Signs, np.ndarray, float]:
    """(signs, [N] our row for each of theirs, largest distance as a part of the asset's length)."""
    best = None
    for signs in itertools.product((1, -1), repeat=3):
        distances = np.linalg.norm(theirs[:, None] - ours[None] * signs, axis=2)
        total = float(distances.min(1).mean())
        if best is None or total < best[0]:
            best = total, signs, distances.argmin(1), float(distances.min(1).max())
    assert best is not None
    return best[1], best[2], best[3] / float(np.ptp(ours, axis=0).max())  # type: ignore[return-value]


def _gap(answer: Mapping[str, Any], name: str, ours: np.ndarray, width: int) -> float:
    if name not in answer or not len(answer[name]):
        return 0.0
    return float(np.abs(np.asarray(answer[name], np.float64).reshape(-1, width) - ours).max())


def _shape_gap(rows: Splats, answer: Mapping[str, Any]) -> float:
    ours = _covariances(rows.quats, rows.scales)
    if "covariances" in answer:
        xx, xy, xz, yy, yz, zz = np.asarray(answer["covariances"], np.float64).reshape(-1, 6).T
        theirs = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], 1).reshape(-1, 3, 3)
    elif len(answer.get("scales", ())) and len(answer.get("quats", ())):
        scales = np.asarray(answer["scales"], np.float64).reshape(-1, 3)
        theirs = _covariances(np.asarray(answer["quats"], np.float64).reshape(-1, 4), scales)
    else:
        return 0.0
    size = np.abs(ours).max((1, 2))
    return float((np.abs(theirs - ours).max((1, 2)) / size).max())


def _covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    half = quat_to_matrix(unit.astype(np.float64)) * scales[:, None].astype(np.float64)
    return half @ half.transpose(0, 2, 1)
