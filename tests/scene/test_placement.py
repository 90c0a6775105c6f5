"""Placements: what is drawn of a placed asset is what a placed camera sees of the asset; what does not move keeps its
bits; texts and records that mean nothing are refused in one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.cameras import orbit
from splatpainter.rendering import render
from splatpainter.scene.placement import Placement, shift_to_the_right
from splatpainter.transforms import quat_to_matrix, sh_basis
from tests.support.io_assets import random_splats
from tests.support.lift_scenes import same_bits

PLACED = Placement.of(move=(0.3, -0.2, 0.5), turn=(20, -75, 130), scale=1.7)


def axis(turn: tuple[float, float, float]) -> np.ndarray:
    """The rotation matrix by hand: about x, then y, then z."""
    x, y, z = np.radians(turn)
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def test_gaussians_and_their_colours_turn_with_the_asset() -> None:
    splats = random_splats(40, 3)
    scene, turn = PLACED.apply(splats), axis((20, -75, 130))
    np.testing.assert_allclose(PLACED.matrix, turn, atol=1e-12)
    np.testing.assert_allclose(scene.means, 1.7 * splats.means @ turn.T + [0.3, -0.2, 0.5], rtol=1e-5, atol=1e-6)

    def covariance(asset):
        axes = quat_to_matrix(asset.quats.astype(np.float64)) * asset.scales[:, None]
        return axes @ axes.transpose(0, 2, 1)

    np.testing.assert_allclose(covariance(scene), 1.7**2 * turn @ covariance(splats) @ turn.T, rtol=1e-4, atol=1e-9)
    directions = np.random.default_rng(1).normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->ndc", sh_basis(directions @ turn, 3), splats.sh)
    after = np.einsum("dk,nkc->ndc", sh_basis(directions, 3), scene.sh)
    np.testing.assert_allclose(after, before, atol=1e-5)
    np.testing.assert_array_equal(scene.sh[:, 0], splats.sh[:, 0])


def test_a_placed_camera_sees_the_asset_as_the_scene_shows_it() -> None:
    splats = replace(random_splats(200, 2, log_scale=-2.0), means=random_splats(200, 0).means * 0.3)
    (camera,) = orbit((0.3, -0.2, 0.5), 4.0, 1, start=30.0, width=48, height=40)
    scene = render(PLACED.apply(splats), camera)
    alone = render(splats, PLACED.camera(camera))
    assert scene.alphas.max() > 0.5
    np.testing.assert_allclose(alone.colors, scene.colors, atol=2e-3)
    np.testing.assert_allclose(alone.alphas, scene.alphas, atol=2e-3)


def test_what_is_not_moved_keeps_its_bits() -> None:
    splats = random_splats(30, 3)
    assert Placement().apply(splats) == splats
    moved = Placement.of(move=(1, 2, 3)).apply(splats)
    assert all(getattr(moved, name) is getattr(splats, name) for name in ("quats", "scales", "opacities", "sh"))
    assert Placement.of(scale=2).apply(splats).sh is splats.sh
    assert same_bits(PLACED.apply(splats), PLACED.apply(splats.take(np.arange(30))))
    assert Placement.of(turn=(360, 0, 0)).is_identity or not Placement.of(turn=(360, 0, 0)).turns


def test_texts_and_records() -> None:
    text = Placement.parse("scale=1.7:move=0.3,-.2,5e-1:turn=20,-75,130")
    assert text == PLACED == Placement.from_record(PLACED.record())
    assert Placement.parse("none").is_identity
    np.testing.assert_allclose(PLACED.turn, (20, -75, 130), atol=1e-9)
    np.testing.assert_allclose(
        Placement.of(turn=Placement.of(turn=(25, 90, 0)).turn).matrix, axis((25, 90, 0)), atol=1e-7
    )
    assert "moved by 0.3, -0.2, 0.5, turned by" in PLACED.text


@pytest.mark.parametrize(
    "text",
    ["", "move", "move=1,2", "move=1,2,3:move=1,2,3", "size=2", "scale=0", "scale=-1", "scale=1e9", "move=nan,0,0"]
    + ["move=1e30,0,0", "turn=1e9,0,0", "scale=2,2,2", "move=1,2,3;scale=2", "move=1_0,0,0", "scale=1e99999"],
)
def test_bad_texts_are_refused_in_one_line(text: str) -> None:
    with pytest.raises(ValueError, match="--transform") as refused:
        Placement.parse(text)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "record",
    [
        None,
        {},
        [],
        {"move": [0, 0, 0], "quat": [1, 0, 0], "scale": 1},
        {"move": "abc", "quat": [1, 0, 0, 0], "scale": 1},
    ]
    + [{"move": [0, 0, True], "quat": [1, 0, 0, 0], "scale": 1}, {"move": [0, 0, 0], "quat": [2, 0, 0, 0], "scale": 1}]
    + [{"move": [0, 0, float("inf")], "quat": [1, 0, 0, 0], "scale": 1}, {"move": [0, 0, 0], "quat": [1, 0, 0, 0]}],
)
def test_bad_records_are_refused(record: object) -> None:
    with pytest.raises(ValueError, match="transform"):
        Placement.from_record(record)


def test_beside_sets_one_to_the_right_of_the_other() -> None:
    rng = np.random.default_rng(0)
    left, right = rng.uniform(-1, 1, (500, 3)), rng.uniform(4, 9, (400, 3))
    left[0] = 1e6  # a stray
    moved = right + shift_to_the_right(left, right)
    assert 0.3 < moved[:, 0].min() - 1 < 0.7
