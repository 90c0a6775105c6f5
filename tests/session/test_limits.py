"""Limits of what one view may paint as parameters of layers, and which pixels of a view they leave out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.lift.options import LocalOptions
from splatpainter.lift.sheets import view_limits
from splatpainter.painter import Edit, EditSettings, Painter
from splatpainter.session import Session
from splatpainter.session.replay import compose
from splatpainter.splats import Splats
from splatpainter.transforms import fibonacci_sphere, matrix_to_quat
from tests.support.lift_scenes import disk, front, same_bits

CAMERA = front(96)


def ball(count: int = 4000) -> Splats:
    """A sphere of radius 1 of flat grey Gaussians."""
    normals = fibonacci_sphere(count)
    side = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.9, (1.0, 0, 0), (0, 1.0, 0)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    axes = np.stack([side, np.cross(normals, side), normals], 2)
    width = 0.6 * np.sqrt(4 * np.pi / count)
    scales = np.tile([width, width, 0.1 * width], (count, 1))
    opacities, sh = np.full(count, 0.95, np.float32), np.zeros((count, 1, 3), np.float32)
    means, quats, scales = (array.astype(np.float32) for array in (normals, matrix_to_quat(axes), scales))
    return Splats(means, quats, scales, opacities, sh)


def off_centre(splats: Splats) -> Edit:
    """A red disk that reaches from the middle of the ball to its rim."""
    image = sp.render(splats, CAMERA).colors[0].copy()
    mask = disk(CAMERA, 66, 48, 14)
    image[mask] = (0.9, 0.1, 0.1)
    return Edit(image, CAMERA, mask)


def painted(parameters: dict[str, Any] | None, painter: Painter | None = None) -> Splats:
    splats = ball()
    with Session(splats, painter=painter or Painter.load("lift")) as session:
        session.layers.add("paint", [off_centre(splats)], **(parameters or {}))
        assert session.verify(repaint=True) == []
        return session.splats


def test_a_layer_carries_its_limits():
    free, limited = painted({"angle_limit": 0}), painted({"angle_limit": 40, "depth_edge_limit": 0})
    assert not same_bits(free, limited)
    red = [sp.render(splats, CAMERA).colors[0] for splats in (free, limited)]
    edge, middle = (48, 78), (48, 56)
    assert red[0][edge][0] > 0.85 > 0.75 > red[1][edge][0]
    assert min(image[middle][0] for image in red) > 0.8


def test_without_parameters_the_painters_limits_hold():
    strict = Painter(settings=EditSettings(local_options=LocalOptions(angle_limit=40)))
    assert same_bits(painted(None, strict), painted({"angle_limit": 40, "depth_edge_limit": 0}))
    assert same_bits(painted({"angle_limit": 80.0}, strict), painted({}))


def test_limits_are_set_anew_and_undone():
    splats = ball()
    with Session(splats, painter=Painter.load("lift")) as session:
        layer = session.layers.add("paint", [off_centre(splats)], angle_limit=0).id
        free = session.splats
        session.layers.set(layer, angle_limit=40)
        assert (
            same_bits(session.splats, painted({"angle_limit": 40})) and "angle" in session.layers.facts(layer)["note"]
        )
        session.undo()
        assert same_bits(session.splats, free)


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"angle_limit": 91}, "expected angle_limit from 0 to 90"),
        ({"angle_limit": "60"}, "layer: expected float as 'angle_limit', got '60'"),
        ({"angle_limit": True}, "expected float as 'angle_limit', got True"),
        ({"depth_edge_limit": -1}, "expected depth_edge_limit from 0 to 16"),
        ({"depth_edge_limit": 10**400}, "layer: "),
        ({"depth_edge_limit": [3]}, "expected float as 'depth_edge_limit', got a list of 1"),
    ],
)
def test_bad_limits_are_refused(parameters: dict[str, Any], reason: str):
    splats = ball(500)
    with Session(splats, painter=Painter.load("lift")) as session:
        edit = off_centre(splats)
        with pytest.raises(ValueError, match=reason):
            session.layers.add("paint", [edit], **parameters)
        layer = session.layers.add("paint", [edit]).id
        with pytest.raises(ValueError, match=reason):
            session.layers.set(layer, **parameters)
        assert session.layers.by_id(layer).operation.limits() == {} and len(session.history) == 2  # pyright: ignore[reportAttributeAccessIssue]
        with pytest.raises(ValueError, match="with pictures in modes local and spread only"):
            session.layers.add("picture", [edit], mode="global", angle_limit=60)
        with pytest.raises(ValueError, match="layer: unknown key 'angle_limit'"):
            session.layers.add("erase", [edit], angle_limit=60)


def test_what_will_not_be_painted_is_the_rim_of_a_ball():
    splats, camera = ball(), front(256)
    with Session(splats, painter=Painter.load("lift")) as session:
        masks = {limit: session.surface.left_out(camera, angle_limit=limit) for limit in (0, 40, 60)}
        strip = session.surface.left_out(camera, angle_limit=0, depth_edge_limit=8)
        with pytest.raises(ValueError, match="expected angle_limit from 0 to 90"):
            session.surface.left_out(camera, angle_limit=100)
    ys, xs = np.mgrid[:256, :256] + 0.5
    rays = np.stack([(xs - camera.cx) / camera.fx, (ys - camera.cy) / camera.fy, np.ones_like(xs)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    center = camera.to_camera(np.zeros((1, 3)))[0]
    # On a sphere of radius 1 the distance of the ray from its centre is the sine of the angle.
    sine = np.linalg.norm(center - (rays @ center)[..., None] * rays, axis=-1)
    angle = np.degrees(np.arcsin(np.clip(sine, 0, 1)))
    assert not masks[0].any() and strip.mean() < 0.1
    for limit in (40, 60):  # half of the paint is left five degrees later
        assert masks[limit].shape == (256, 256) and masks[limit].dtype == bool
        assert not masks[limit][(angle < limit) | (sine > 1.05)].any()
        assert masks[limit][(angle > limit + 10) & (angle < 75)].mean() > 0.95


def test_what_will_not_be_painted_follows_the_painter_and_odd_views():
    with Session(
        ball(500), painter=Painter(settings=EditSettings(local_options=LocalOptions(angle_limit=30)))
    ) as session:
        assert session.surface.left_out(CAMERA).sum() > session.surface.left_out(CAMERA, angle_limit=60).sum() > 0
        wide = sp.look_at((0, 0, -3), (0, 0, 0), width=333, height=7, fov=40)
        assert session.surface.left_out(wide).shape == (7, 333)
        away = sp.look_at((0, 0, -3), (0, 0, -9), width=40, height=30, fov=40)
        assert not session.surface.left_out(away).any()


def test_limits_and_the_surface_beneath_them_are_both_estimated_once(monkeypatch: pytest.MonkeyPatch):
    with Session(ball(500), painter=Painter.load("lift")) as session:
        session.layers.add("paint", [off_centre(session.splats)])
        calls, estimate = [], view_limits.coarse_surface
        monkeypatch.setattr(compose, "coarse_surface", lambda *a: calls.append(1) or estimate(*a))
        first = session.surface.left_out(CAMERA, angle_limit=40)
        session.surface.blocks(CAMERA)
        assert np.array_equal(session.surface.left_out(CAMERA, angle_limit=40), first)
        session.surface.blocks(CAMERA)
        assert len(calls) == 2
