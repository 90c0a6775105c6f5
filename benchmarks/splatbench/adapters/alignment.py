"""Frames of other systems: how one is turned, scaled and shifted from the asset's, and rows brought back.

asset        the asset's own: OpenCV cameras, any axes; objects of the tables are y up, as their meshes are
trellis      TRELLIS, VoxHammer, VineDresser3D: z up, the object in the cube from -0.5 to 0.5
gltf         the same cube y up, (x, y, z) = (X, Z, -Y) of the trellis frame, as their GLB files are
nerfstudio   the dataparser's: x -> scale (R x + t), told in dataparser_transforms.json beside the config
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatpainter.io import files, frames
from splatpainter.splats import Splats

UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""y up -> z up: (x, y, z) -> (x, -z, y)."""


@dataclass(frozen=True)
class Frame:
    """x in the asset's frame -> scale * turn @ x + shift in the system's."""

    turn: np.ndarray
    """[3, 3] rotation."""
    scale: float = 1.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def points(self, points: np.ndarray) -> np.ndarray:
        """[..., 3] asset -> system."""
        return self.scale * (points @ self.turn.T) + np.array(self.shift)

    def points_back(self, points: np.ndarray) -> np.ndarray:
        """[..., 3] system -> asset."""
        return (points - np.array(self.shift)) @ self.turn / self.scale

    def rows_back(self, splats: Splats) -> Splats:
        """System -> asset, SH turned with the rows. Rows that are in the asset's frame already keep their bits."""
        if self.scale == 1 and not any(self.shift) and np.array_equal(self.turn, np.eye(3)):
            return splats
        return frames.move_back(splats, self.turn, self.scale, np.array(self.shift))


ASSET = Frame(np.eye(3))


def cube(lo: np.ndarray, size: float, *, upright: bool) -> Frame:
    """The frame in which the asset's cube (voxels.bounding_cube: corner [3], edge) is -0.5..0.5; upright: z up
    ("trellis"), else y up ("gltf")."""
    turn = UPRIGHT if upright else np.eye(3)
    shift = -(turn @ (np.asarray(lo, np.float64) + size / 2)) / size
    return Frame(turn, 1 / size, (float(shift[0]), float(shift[1]), float(shift[2])))


def nerfstudio(path: Path) -> Frame:
    """The frame that a nerfstudio dataparser chose. Raises ValueError for a file that does not tell it."""
    try:
        told = json.loads(files.read_all(path))
        matrix, scale = np.array(told["transform"], np.float64), float(told["scale"])
        turn = matrix[:3, :3]
        if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all() or not 0 < scale < np.inf:
            raise ValueError(f"shape {list(matrix.shape)}, scale {scale:g}")
        if abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
            raise ValueError("no rotation")
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{path}: expected nerfstudio's transform [3, 4] and scale ({error})") from None
    # Written as float32: the nearest rotation, so that rows are not sheared.
    left, _, right = np.linalg.svd(turn)
    shift = scale * matrix[:3, 3]
    return Frame(left @ right, scale, (float(shift[0]), float(shift[1]), float(shift[2])))
