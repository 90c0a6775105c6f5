"""ComfyUI's values and ours: SPLAT, camera_info, IMAGE and MASK.

SPLAT (comfy_api/latest/_util/geometry_types.py) is a batch of activated Gaussians, tensors [B, N, ...]: positions,
scales (standard deviations), rotations (w, x, y, z), opacities [B, N, 1], sh [B, N, K, 3] and counts [B] or None, in
the axes of 3DGS files (y down), as here. camera_info is three.js's: right-handed, y up, looking down -z, so its points
are ours turned half around x; fov spans the shorter side. IMAGE is [B, H, W, 3], MASK [B, H, W], floats 0..1; a mask
is 1 where something is to change. Versions before 2026 have no class for SPLAT: there `SplatBatch` stands for it.

ComfyUI's RenderSplat evaluates pixel j at j, not at j + 0.5; cameras made here say so in their principal point, so that
pictures of both lie over each other.
"""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from splatpainter.cameras import Camera
from splatpainter.splats import Splats
from splatpainter.transforms import matrix_to_quat, quat_to_matrix

DEFAULT_FOV = 35.0
"""Degrees, of a camera_info without one, as in RenderSplat."""
TURN = np.diag([1.0, -1.0, -1.0])
"""World of three.js <-> axes of splats; its own inverse."""
CAMERA_TURN = np.diag([1.0, -1.0, -1.0])
"""Axes of a three.js camera (x right, y up, z back) <-> ours (x right, y down, z forward)."""
PIXEL_SHIFT = 0.5
"""Of the principal point, see above."""


@dataclass
class SplatBatch:
    """A SPLAT of ComfyUI versions that have none in their core: the same names, the same tensors."""

    positions: torch.Tensor
    scales: torch.Tensor
    rotations: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor
    counts: torch.Tensor | None = None


def splat_class() -> Any:
    """The core's class of SPLAT, or SplatBatch where this ComfyUI has none."""
    try:
        types = importlib.import_module("comfy_api.latest").Types
    except (ImportError, AttributeError):
        return SplatBatch
    return getattr(types, "SPLAT", SplatBatch)


def splats_of(splat: Any) -> Splats:
    """The Gaussians of a SPLAT of one item. Raises ValueError for a batch of several."""
    count = int(splat.positions.shape[0])
    if count != 1:
        raise ValueError(f"splat: expected one splat, got a batch of {count}; edit them one after the other")
    rows = int(splat.counts[0]) if splat.counts is not None else splat.positions.shape[1]

    def array(tensor: torch.Tensor) -> np.ndarray:
        return np.ascontiguousarray(tensor[0, :rows].detach().cpu().numpy(), np.float32)

    opacities = array(splat.opacities).reshape(rows)
    return Splats(array(splat.positions), array(splat.rotations), array(splat.scales), opacities, array(splat.sh))


def splat_of(splats: Splats, kind: Any, device: Any = "cpu") -> Any:
    """A SPLAT of one item, of a class that takes the tensors in their order."""
    arrays = splats.numpy()

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.array(values, np.float32))[None].to(device)

    return kind(
        tensor(arrays.means),
        tensor(arrays.scales),
        tensor(arrays.quats),
        tensor(arrays.opacities[:, None]),
        tensor(arrays.sh),
    )


def camera_of(info: dict[str, Any], width: int, height: int) -> Camera:
    """A camera_info for a picture of so many pixels. Raises ValueError: numbers that make no camera, and orthographic
    ones, which 3DGS has not."""
    if str(info.get("cameraType", "perspective")).lower().startswith("ortho"):
        raise ValueError("camera_info: expected a perspective camera, got an orthographic one")
    eye = TURN @ _vector(info, "position")
    quaternion = info.get("quaternion")
    if quaternion:
        wxyz = np.array([[float(quaternion.get(axis, 1.0 if axis == "w" else 0.0)) for axis in "wxyz"]])
        if not np.linalg.norm(wxyz) > 1e-6:
            raise ValueError("camera_info: expected a quaternion that is not 0")
        rotation = quat_to_matrix(wxyz)[0]
    else:
        rotation = _facing(_vector(info, "position") - _vector(info, "target"))
    axes = TURN @ rotation @ CAMERA_TURN  # columns: our camera's axes in the axes of splats
    matrix = np.eye(4)
    matrix[:3, :3] = axes.T
    matrix[:3, 3] = -axes.T @ eye
    fov, zoom = float(info.get("fov") or DEFAULT_FOV), float(info.get("zoom") or 1.0)
    if not (0 < fov < 180 and 0 < zoom < math.inf):
        raise ValueError(
            f"camera_info: expected a fov of 0 to 180 degrees and a zoom above 0, got {fov:g} and {zoom:g}"
        )
    focal = min(width, height) / 2 / math.tan(math.radians(fov) / 2) * zoom
    return Camera(width, height, focal, focal, width / 2 + PIXEL_SHIFT, height / 2 + PIXEL_SHIFT, matrix)


def camera_info_of(camera: Camera, target_distance: float) -> dict[str, Any]:
    """The inverse of `camera_of`; target_distance: of the point that an orbit turns around, world units."""
    rotation = TURN @ camera.world_to_camera[:3, :3].T @ CAMERA_TURN
    position = TURN @ camera.position
    target = position - target_distance * rotation[:, 2]
    w, x, y, z = matrix_to_quat(rotation[None])[0].tolist()
    focal = min(camera.width, camera.height) / 2 / camera.fx
    return {
        "position": dict(zip("xyz", position.tolist(), strict=True)),
        "target": dict(zip("xyz", target.tolist(), strict=True)),
        "quaternion": {"x": x, "y": y, "z": z, "w": w},
        "fov": math.degrees(2 * math.atan(focal)),
        "zoom": 1.0,
        "cameraType": "perspective",
    }


def picture_of(image: torch.Tensor, what: str = "image") -> np.ndarray:
    """[H, W, 3] float32 0..1 of an IMAGE of one picture. Raises ValueError for several."""
    if image.ndim != 4 or image.shape[0] != 1 or image.shape[3] < 3:
        raise ValueError(f"{what}: expected one picture [1, H, W, 3], got {list(image.shape)}")
    return np.ascontiguousarray(image[0, :, :, :3].detach().cpu().numpy(), np.float32).clip(0, 1)


def mask_of(mask: torch.Tensor, width: int, height: int, what: str = "mask") -> np.ndarray:
    """[H, W] float32 0..1 of a MASK of one picture, at another size where it has one."""
    planes = mask[None] if mask.ndim == 2 else mask
    if planes.ndim != 3 or planes.shape[0] != 1:
        raise ValueError(f"{what}: expected one mask [1, H, W], got {list(mask.shape)}")
    if tuple(planes.shape[1:]) != (height, width):
        planes = torch.nn.functional.interpolate(planes[None].float(), (height, width), mode="area")[0]
    return np.ascontiguousarray(planes[0].detach().cpu().numpy(), np.float32).clip(0, 1)


def image_of(picture: np.ndarray) -> torch.Tensor:
    """[H, W, 3] or [H, W] -> IMAGE [1, H, W, 3] or MASK [1, H, W]."""
    return torch.from_numpy(np.array(picture, np.float32).clip(0, 1))[None]


def _vector(info: dict[str, Any], name: str) -> np.ndarray:
    point = info.get(name) or {}
    values = np.array([float(point.get(axis, 0.0)) for axis in "xyz"])
    if not np.isfinite(values).all():
        raise ValueError(f"camera_info: expected finite numbers as {name}, got {values.tolist()}")
    return values


def _facing(back: np.ndarray) -> np.ndarray:
    """[3, 3] columns: axes of a three.js camera whose z points along `back`, upright in its world."""
    length = np.linalg.norm(back)
    if not length > 1e-9:
        raise ValueError("camera_info: expected a position and a target that differ, or a quaternion")
    z = back / length
    up = np.array([0.0, 1.0, 0.0]) if abs(z[1]) < 0.999 else np.array([0.0, 0.0, 1.0])
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], 1)
