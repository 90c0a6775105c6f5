"""Confidence of mode spread, drawn over a view as a layer of colour, and as a picture for people."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.array_types import Bytes
from splatpainter.cameras import Camera, bounding_sphere
from splatpainter.color import luminance, to_display
from splatpainter.image_files import to_uint8
from splatpainter.kernels import portable
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats

OPACITY = 0.7
"""Opacity of the colours over the view."""
RAMP_AT = (0.0, 0.5, 1.0, 1.6)
"""Confidence over the threshold at the stops of RAMP."""
RAMP = ((40, 60, 160), (235, 70, 60), (250, 200, 40), (60, 200, 90))
"""Colours at RAMP_AT, 8-bit sRGB: blue and red are not reached, yellow is the threshold, green is sure."""


def confidence_overlay(splats: Splats, confidence: np.ndarray, threshold: float, camera: Camera) -> Bytes:
    """[H, W, 4] uint8, straight alpha: the ramp where the view shows Gaussians, transparent where confidence is 0.
    splats: numpy, N; confidence: [N] 0..1."""
    view = project(splats, replace(camera, background=(0.0, 0.0, 0.0)))
    relative = confidence[view.gaussian_ids] / max(threshold, 1e-3)
    amount = np.clip(2 * relative, 0, 1)
    ramp = [portable.interp(relative, RAMP_AT, [color[k] for color in RAMP]) for k in range(3)]
    dtype = view.projected.dtype
    # Premultiplied, then divided by what was drawn: blending Gaussians blends colours, not their alpha.
    colors = view.rasterize((np.stack(ramp, 1) * amount[:, None]).astype(dtype))[0]
    total = view.rasterize(np.repeat(amount[:, None], 3, 1).astype(dtype))[0][..., :1]
    alpha = 255 * OPACITY * np.clip(total, 0, 1)
    return np.concatenate([colors / np.maximum(total, 1e-6), alpha], 2).clip(0, 255).round().astype(np.uint8)


def confidence_picture(splats: Splats, confidence: np.ndarray, threshold: float, camera: Camera) -> Bytes:
    """[H, 2 W, 3] uint8: the overlay over the asset in grey, from the edited view and from behind."""
    views = []
    for each in (camera, behind(camera, bounding_sphere(splats)[0])):
        image = to_display(np.clip(project(splats, each).rasterize()[0], 0, 1), splats.color_space)
        layer = confidence_overlay(splats, confidence, threshold, each).astype(np.float32) / 255
        grey = np.repeat(luminance(image)[..., None], 3, 2)
        views.append(grey + layer[..., 3:] * (layer[..., :3] - grey))
    return to_uint8(np.concatenate(views, 1))


def behind(camera: Camera, center: np.ndarray) -> Camera:
    """The view turned by half a circle around the vertical of its picture through `center` [3]."""
    # Half a turn about the picture's own vertical, so that up stays up.
    turn = np.diag([-1.0, 1.0, -1.0])
    rotation = camera.world_to_camera[:3, :3]
    half = portable.matmul(portable.matmul(rotation.T, turn), rotation)  # about the camera's y, in world axes
    pose = np.eye(4)
    pose[:3, :3] = portable.matmul(rotation, half)
    shift = center - (half * center).sum(1)
    pose[:3, 3] = camera.world_to_camera[:3, 3] + (rotation * shift).sum(1)
    return replace(camera, world_to_camera=pose)
