"""The clone stamp with relief: Gaussians copied from one place of the surface to another."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from splatpainter.cameras import Camera
from splatpainter.kernels.portable import matmul
from splatpainter.server import picking
from splatpainter.server.commands.context import CommandContext, RawExpr, command, layer_made, progress, python_line
from splatpainter.server.protocol import CameraInfo, Command, LayerMade, Name
from splatpainter.session import Session
from splatpainter.session.kinds.relief_layers import CopyAnchor, ReliefLayer


class ReliefStamp(Command):
    """Copy what lies within the brush at one pixel, with its relief, to another pixel, as a layer. What is there fades
    under it."""

    NAME = "clone.relief"
    ANSWER = LayerMade
    source_camera: CameraInfo
    source_x: float
    """Pixels of its view; the first pixel's centre is 0.5."""
    source_y: float
    camera: CameraInfo
    x: float
    y: float
    radius: float = Field(gt=0, le=16384)
    """Radius of the brush, pixels of `camera`'s view at the target."""
    name: Name = "Clone with relief"


@command(ReliefStamp, writes=True)
def stamp(context: CommandContext, request: ReliefStamp) -> LayerMade:
    session, camera = context.studio.session, request.camera.to_camera()
    # Both points on the surface as it is trusted, so that relief goes from surface to surface.
    source, _ = surface_point(session, request.source_camera.to_camera(), request.source_x, request.source_y, "source")
    target, depth = surface_point(session, camera, request.x, request.y, "target")
    # The brush is a circle on the screen; in the world it grows with depth.
    relief = ReliefLayer(source, target, request.radius * depth / camera.fx)
    with progress(context, request.name):
        layer = session.layers.copy_relief(relief, request.name)
    relief_line = RawExpr(f"ReliefLayer(source, target, {relief.radius:.4g})")
    line = python_line("session.layers.copy_relief", relief_line, request.name)
    return layer_made(context, layer.id, line)


def surface_point(session: Session, camera: Camera, x: float, y: float, what: str) -> tuple[CopyAnchor, float]:
    """(the place of the surface that a pixel shows, its depth). Where no surface is trusted it is where the Gaussian is
    that gives the pixel most of its colour, and faces the camera. Its first tangent is the view's x axis. Raises
    ValueError where the asset does not cover the pixel."""
    splats = session.splats
    _, hit = picking.pick(splats, camera, x, y)
    if hit is None:
        raise ValueError(f"copy: there is nothing of the asset at the {what}; click on the asset")
    # The trusted surface of the view; where there is none, the Gaussian itself.
    table, block = session.surface.blocks(camera)
    seen = table[min(int(y / block), len(table) - 1), min(int(x / block), table.shape[1] - 1)]
    ray = camera.sight_lines(np.array([x, y]))
    trusted = seen[0] > 0
    depth = float(seen[0]) if trusted else float(camera.to_camera(splats.means[hit.gaussian_id])[2])
    normal = seen[1:].astype(float) if trusted else -ray
    rotation = camera.world_to_camera[:3, :3]
    return CopyAnchor.of(camera.to_world(depth * ray), matmul(normal, rotation), rotation[0]), depth
