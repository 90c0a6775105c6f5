"""Global edits of Stage II one after the other: of one light they make what they make together, another one wins, a
look goes on top, and what was painted in between stays."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from splatpainter.cameras import Camera, same_camera
from splatpainter.models import weights
from splatpainter.models.edits_in_turn import EditInTurn, EditsSoFar
from splatpainter.painter import Asset, Edit, Painter
from splatpainter.session.project.stored_results import _pack_state, _unpack_state
from splatpainter.splats import SH_C0, Splats
from tests.lift.test_global import BACK, FRONT, NEAR_FRONT, SIDE, TOP, ball, draw, regraded

SAME_DB = 0.3
"""Largest difference of PSNR between pictures given together and in turn."""
PAIRS = {"front and side": (FRONT, SIDE), "opposite": (FRONT, BACK), "neighbours": (FRONT, NEAR_FRONT)}


@cache
def start(degree: int = 0) -> tuple[Painter, Asset]:
    """The shipped Stage II, and a ball of 400 Gaussians encoded for it."""
    painter = Painter(model=weights.load("rows"))
    return painter, painter.encode(ball(400, degree), "ttt", ("global",))


def after(asset: Asset, *edits: Edit) -> Asset:
    return start()[0].apply(asset, edits, "global", "ttt")


def seen(truth: Splats, camera: Camera) -> Edit:
    return Edit(draw(truth, camera), camera)


def relit(splats: Splats, light: tuple[float, float, float], ambient: float = 0.3) -> Splats:
    """The ball under a lamp."""
    normals = splats.means / np.linalg.norm(splats.means, axis=1, keepdims=True)
    lit = np.clip(normals @ np.array(light), 0, None)[:, None]
    colors = np.clip((0.5 + SH_C0 * splats.sh[:, 0]) * (ambient + lit * np.array([1.2, 1.0, 0.8])), 0, 1)
    sh = splats.sh.copy()
    sh[:, 0] = (colors - 0.5) / SH_C0
    return replace(splats, sh=sh)


def decibels(splats: Splats, truth: Splats) -> float:
    """PSNR of base colours."""
    return float(-10 * np.log10(np.square(SH_C0 * (splats.sh[:, 0] - truth.sh[:, 0])).mean()))


def random_lights(count: int) -> list[tuple[float, float, float]]:
    lights = np.random.default_rng(5).normal(size=(count, 3))
    return [tuple(light / np.linalg.norm(light)) for light in lights]


@pytest.mark.parametrize("pair", PAIRS)
def test_relit_views_in_turn_make_what_they_make_together(pair: str, float32: None) -> None:
    """Whatever the light, also from behind, and whether the views show anything in common."""
    asset, (one, other) = start()[1], PAIRS[pair]
    gains = []
    for light in random_lights(6):
        truth = relit(asset.splats, light)
        once = after(asset, seen(truth, one))
        both, turns = after(asset, seen(truth, one), seen(truth, other)), after(once, seen(truth, other))
        together = decibels(both.splats, truth)
        assert abs(decibels(turns.splats, truth) - together) <= SAME_DB, light
        gains.append(together - decibels(once.splats, truth))
    assert np.mean(gains) > {"front and side": 1.5, "opposite": 8, "neighbours": 0.5}[pair], (
        "the second is worth something"
    )


def test_views_that_agree_where_both_look_go_on_however_poorly_the_rest_was_foretold(float32: None) -> None:
    """A light from behind: what the front shows of it says little of the side."""
    asset = start()[1]
    lit = relit(asset.splats, (-0.7, 0.5, 0.5))
    once = after(asset, seen(lit, FRONT))
    assert decibels(after(once, seen(lit, SIDE)).splats, lit) > decibels(once.splats, lit) + 4


@pytest.mark.parametrize("degree", [0, 2])
def test_any_number_of_views_in_turn(degree: int, float32: None) -> None:
    """Also bands of view dependence are turned once, by what all views show."""
    painter, _ = start()
    asset = painter.encode(ball(400, degree), "ttt", ("global",))
    truth = relit(asset.splats, (0.3, 0.9, 0.3))
    views = [seen(truth, camera) for camera in (FRONT, SIDE, BACK, TOP)]
    turns = asset
    for count, view in enumerate(views):
        turns = after(turns, view)
        assert turns.receipt is not None and (f"goes on from {count} earlier" in turns.receipt.note) == (count > 0)
    both = after(asset, *views)
    assert abs(decibels(turns.splats, truth) - decibels(both.splats, truth)) <= SAME_DB
    # Colours before are told to a 16-bit float.
    np.testing.assert_allclose(turns.splats.sh, both.splats.sh, atol=0.02)
    if degree:
        bands = np.abs(both.splats.sh[:, 1:] - asset.splats.sh[:, 1:]).mean()
        assert bands > 20 * np.abs(turns.splats.sh[:, 1:] - both.splats.sh[:, 1:]).mean()


def test_undo_restores(float32: None) -> None:
    asset = start()[1]
    truth = relit(asset.splats, (0.3, 0.9, 0.3))
    once = after(asset, seen(truth, FRONT))
    turns = after(once, seen(truth, SIDE))
    assert decibels(once.splats, truth) + 1 < decibels(turns.splats, truth) > 25, "26.3 measured"
    np.testing.assert_array_equal(after(asset, seen(truth, FRONT)).splats.sh, once.splats.sh)
    again, further = (after(once, seen(truth, SIDE)).splats.sh for _ in range(2))
    np.testing.assert_array_equal(again, further)


@pytest.mark.parametrize("earlier", [(FRONT,), (FRONT, SIDE)], ids=["one view", "two views"])
def test_the_latest_light_wins(earlier: tuple[Camera, ...], float32: None) -> None:
    """From where an earlier picture looked another light is as good as if that had never been."""
    asset = start()[1]
    first, second = relit(asset.splats, (0.3, 0.9, 0.3)), relit(asset.splats, (0.9, -0.3, 0.3))
    other = after(after(asset, *(seen(first, camera) for camera in earlier)), seen(second, FRONT))
    assert other.receipt is not None and "in place of earlier global edits" in other.receipt.note
    assert decibels(other.splats, second) > decibels(other.splats, first) + 1
    alone = after(asset, seen(second, FRONT))
    assert decibels(other.splats, second) >= decibels(alone.splats, second) - SAME_DB
    state = other.encoding.state.so_far  # type: ignore[union-attr]
    assert len(state.pictures) == 1, "what was contradicted is forgotten"


def test_a_picture_from_the_same_camera_replaces_the_earlier_one(float32: None) -> None:
    """A light that is a little stronger, painted over the same view: no mean of both."""
    asset = start()[1]
    first, second = (relit(asset.splats, (0.3, 0.9, 0.3), ambient) for ambient in (0.3, 0.34))
    once = after(asset, seen(first, FRONT), seen(first, SIDE))
    again = after(once, seen(second, FRONT))
    cameras = [picture.camera for picture in again.encoding.state.so_far.pictures]  # type: ignore[union-attr]
    assert sum(same_camera(camera, FRONT) for camera in cameras) == 1
    error = np.abs(draw(again.splats, FRONT) - draw(second, FRONT)).mean()
    assert error < 0.4 * np.abs(draw(once.splats, FRONT) - draw(second, FRONT)).mean()


def test_a_look_goes_on_top_of_a_light(float32: None) -> None:
    """Relit from two views, then one graded: the grade reaches what the other view shows, and its light stays."""
    asset = start()[1]
    lit = relit(asset.splats, (-0.3, 0.9, 0.3))
    graded = regraded(lit)
    once = after(asset, seen(lit, FRONT), seen(lit, BACK))
    result = after(once, seen(graded, FRONT))
    assert result.receipt is not None and "on top of earlier global edits" in result.receipt.note
    assert decibels(result.splats, graded) > decibels(after(asset, seen(graded, FRONT)).splats, graded) + 3


def test_what_was_painted_in_between_stays(float32: None) -> None:
    asset, painter = start()[1], start()[0]
    truth = relit(asset.splats, (0.3, 0.9, 0.3))
    once = after(asset, seen(truth, FRONT))
    mask = np.zeros((96, 96), bool)
    mask[40:56, 40:56] = True
    picture = np.where(mask[..., None], np.array([0.1, 0.2, 0.9], np.float32), draw(once.splats, FRONT))
    painted = painter.apply(once, [Edit(picture, FRONT, mask)], "local", "lift")
    plain, result = after(once, seen(truth, SIDE)), after(painted, seen(truth, SIDE))
    front = draw(result.splats, FRONT)
    inner = np.s_[44:52, 44:52]
    assert (
        np.abs(front[inner] - picture[inner]).mean() < 0.1 < np.abs(draw(plain.splats, FRONT) - picture)[inner].mean()
    )
    beside = np.ones((96, 96), bool)
    beside[34:62, 34:62] = False
    assert np.abs(front - draw(plain.splats, FRONT))[beside].mean() < 0.005


def test_gaussians_are_told_by_the_encoded_one_that_they_come_from(float32: None) -> None:
    """Split ones by their mean; what cannot be drawn has not moved."""
    splats = ball(300)
    odd = splats.append(replace(splats.take(np.arange(1)), means=np.full((1, 3), np.nan, np.float32)))
    twice = odd.append(splats.take(np.arange(2)))
    parents = np.append(np.arange(301), [0, 1])
    turn = EditInTurn(twice, (), parents)
    sh = twice.sh + np.float32(0.25)
    sh[0] += 0.5
    so_far = turn.after(replace(twice, sh=sh), [])
    assert so_far.moved.shape == (301, 1, 3)
    np.testing.assert_allclose(so_far.moved[[0, 1, 300]], [[[0.5] * 3], [[0.25] * 3], [[0] * 3]], atol=1e-3)
    other = EditInTurn.of(so_far, replace(twice, sh=sh), np.zeros((303, 3), np.float32), parents, [])
    np.testing.assert_allclose(other.before.sh[2:300], twice.sh[2:300], atol=1e-3)


def test_a_state_goes_through_a_file(float32: None) -> None:
    from safetensors.torch import load, save

    asset = start()[1]
    state = after(asset, seen(relit(asset.splats, (0.3, 0.9, 0.3)), FRONT)).encoding.state  # type: ignore[union-attr]
    assert state is not None and isinstance(state.so_far, EditsSoFar)
    packed = _pack_state(state)
    back = _unpack_state(packed).so_far
    assert back is not None and len(back.pictures) == 1
    one, other = back.pictures[0], state.so_far.pictures[0]
    np.testing.assert_array_equal(back.moved, state.so_far.moved)
    np.testing.assert_array_equal(one.left, other.left)
    np.testing.assert_array_equal(one.mask, other.mask)
    assert same_camera(one.camera, other.camera) and one.camera.offset == other.camera.offset
    # A file of before pictures were stored holds [E, 4]: the next edit starts from the asset as it is.
    named = load(packed)
    old = {name: tensor for name, tensor in named.items() if name.startswith("block.")}
    assert _unpack_state(save(old | {"evidence": torch.zeros(400, 4)})).so_far is None
    named["picture.0.left"] = named["picture.0.left"][:-1].clone()
    with pytest.raises(ValueError, match="the painter's state is damaged"):
        _unpack_state(save(named))
