"""The global lift: a regrade that is known exactly must come back on the sides that no view shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.lift.depth_normals import outward_normals
from splatpainter.lift.global_edit import GlobalLift, lift_global, light_share, one_sided, unexplained_by_color
from splatpainter.lift.options import GLOBAL_DEFAULTS
from splatpainter.splats import Splats
from tests.support.lift_scenes import SH_C0, base_colors, bits, db, differing, same_bits, sheet, texture

MIX = np.array([[0.8, 0.1, 0.0], [0.05, 0.6, 0.1], [0.0, 0.1, 0.7]])
SHIFT = np.array([0.1, 0.05, -0.02])


def ball(rows: int = 3000, degree: int = 0, seed: int = 0) -> Splats:
    """Flat rows over the unit sphere, their shortest axes along the radius (one in two points inwards)."""
    rng = np.random.default_rng(seed)
    i = np.arange(rows) + 0.5
    polar, turn = np.arccos(1 - 2 * i / rows), np.pi * (1 + 5**0.5) * i
    d = np.stack([np.cos(turn) * np.sin(polar), np.cos(polar), np.sin(turn) * np.sin(polar)], 1)
    axis = d * rng.choice([-1, 1], (rows, 1))
    quats = np.stack([1 + axis[:, 2], -axis[:, 1], axis[:, 0], 0 * axis[:, 0]], 1)  # turns z to the axis
    size = np.sqrt(4 * np.pi / rows)
    sh = rng.normal(0, 0.02, (rows, (degree + 1) ** 2, 3))
    sh[:, 0] = (texture(2 * d[:, 0], 2 * d[:, 1] + d[:, 2]) - 0.5) / SH_C0
    scales = np.tile([0.7 * size, 0.7 * size, 0.05 * size], (rows, 1))
    d, quats, scales, opacities, sh = (v.astype(np.float32) for v in (d, quats, scales, np.full(rows, 0.95), sh))
    return Splats(d, quats, scales, opacities, sh)


def view(eye, size: int = 96) -> Camera:
    return look_at(eye, (0, 0, 0), width=size, height=size, fov=40)


FRONT, SIDE, BACK, TOP = view((0, 0, 3.5)), view((3.5, 0, 0)), view((0, 0, -3.5)), view((0.1, 3.5, 0))
NEAR_FRONT = view((2.2, 0.3, 2.7))


def regraded(splats: Splats, mix: np.ndarray = MIX, shift: np.ndarray = SHIFT) -> Splats:
    """C' = mix C + shift in every direction: exact, as colour is linear in the coefficients."""
    sh = np.einsum("ij,nkj->nki", mix, splats.sh.astype(np.float64))
    sh[:, 0] = (base_colors(splats) @ mix.T + shift - 0.5) / SH_C0
    return replace(splats, sh=sh.astype(np.float32))


def draw(splats: Splats, camera: Camera) -> np.ndarray:
    return sp.render(splats, camera).colors[0]


def covered(splats: Splats, camera: Camera) -> np.ndarray:
    return sp.render(splats, camera).alphas[0, ..., 0] > 0.5


def lifted(splats: Splats, truth: Splats, *cameras: Camera) -> GlobalLift:
    return lift_global(splats, [(camera, draw(truth, camera), covered(splats, camera)) for camera in cameras])


def gains(splats: Splats, truth: Splats, result: Splats, *cameras: Camera) -> list[tuple[float, float]]:
    """(dB before, dB after) against the truth on the asset's pixels, per view."""
    out = []
    for camera in cameras:
        on, expected = covered(splats, camera), draw(truth, camera)
        out.append((db(draw(splats, camera), expected, on), db(draw(result, camera), expected, on)))
    return out


@pytest.mark.parametrize("degree", [0, 2])
def test_an_affine_regrade_of_one_view_reaches_every_side(degree):
    splats = ball(degree=degree)
    truth = regraded(splats)
    result = lifted(splats, truth, FRONT).splats
    for before, after in gains(splats, truth, result, FRONT, SIDE, BACK, TOP):
        assert before < 21 and after > before + 13
    hidden = splats.means[:, 2] < -0.2
    assert np.abs(base_colors(result) - base_colors(truth))[hidden].mean() < 0.02
    assert np.abs(base_colors(splats) - base_colors(truth))[hidden].mean() > 0.05
    for name in ("means", "quats", "scales", "opacities"):  # colours only
        assert getattr(result, name) is getattr(splats, name)


def test_bands_follow_the_linear_part():
    splats = ball(degree=2)
    truth = regraded(splats)
    result = lifted(splats, truth, FRONT, BACK).splats
    error = np.abs(result.sh[:, 1:] - truth.sh[:, 1:]).mean()
    assert error < 0.25 * np.abs(splats.sh[:, 1:] - truth.sh[:, 1:]).mean()
    # A regrade that only shifts colours leaves them alone.
    shifted = regraded(splats, np.eye(3), SHIFT)
    result = lifted(splats, shifted, FRONT, BACK).splats
    assert np.abs(result.sh[:, 1:] - splats.sh[:, 1:]).mean() < 0.1 * np.abs(splats.sh[:, 1:]).mean()


def test_light_from_one_side_is_learnt_from_two_views():
    splats = ball()
    light = np.array([0.6, 0.5, 0.62])
    shade = 0.5 + 0.5 * splats.means @ (light / np.linalg.norm(light))
    sh = ((base_colors(splats) * shade[:, None] - 0.5) / SH_C0).astype(np.float32)[:, None]
    truth = replace(splats, sh=sh)
    for before, after in gains(splats, truth, lifted(splats, truth, FRONT, BACK).splats, SIDE, TOP, view((-2, -2, 2))):
        assert after > before + 10


def test_views_of_one_side_and_around_are_told_apart():
    splats = ball()
    assert one_sided(splats, [FRONT]) == pytest.approx(1, abs=1e-3)
    assert one_sided(splats, [FRONT, BACK]) < 1e-3 and one_sided(splats, [FRONT, NEAR_FRONT]) > 0.8


def test_light_is_told_from_looks_by_what_normals_explain():
    """Also of assets that fit their pictures badly, whose looks are no function of colour either."""
    rng = np.random.default_rng(0)
    colors, normals, weight = rng.uniform(0, 1, (500, 3)), rng.normal(size=(500, 3)), rng.uniform(0.1, 5, 500)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    look = colors @ MIX.T + SHIFT - colors + rng.normal(0, 0.1, (500, 3))
    light = colors * np.clip(normals @ (0.3, 0.9, 0.3), 0, None)[:, None] - 0.4 * colors
    arguments = (colors.astype(np.float32), normals.astype(np.float32))
    assert light_share(*arguments, look, weight) < 0.1 < 0.5 < light_share(*arguments, light, weight) <= 1
    assert light_share(*arguments, light + rng.normal(0, 0.1, (500, 3)), weight) > 0.25
    assert light_share(*arguments, np.zeros((500, 3)), weight) <= 1, "no change is no division by zero"


def test_looks_are_told_from_light_by_what_colour_explains():
    rng = np.random.default_rng(0)
    colors, normals, weight = rng.uniform(0, 1, (500, 3)), rng.normal(size=(500, 3)), rng.uniform(0.1, 5, 500)
    assert unexplained_by_color(colors, 0.3 * colors**2 - 0.2 * colors[:, ::-1] + 0.1, weight) < 0.02
    lit = 0.3 * colors * np.tanh(normals[:, :1])
    assert unexplained_by_color(colors, lit, weight) > 0.9
    assert 0.2 < unexplained_by_color(colors, lit + 0.2, weight) < 0.5


def test_what_light_takes_from_the_front_goes_to_the_back():
    """Seen from one side; a look goes all around as it is."""
    splats = ball()
    old, lit = base_colors(splats), 0.5 + 0.5 * np.tanh(3 * splats.means[:, :1] + 1.5 * splats.means[:, 1:2])
    relit = replace(splats, sh=((old * lit - 0.5) / SH_C0).astype(np.float32)[:, None])
    without = replace(GLOBAL_DEFAULTS, far_side=0.0)
    hidden = splats.means[:, 2] < -0.3

    def moved(truth: Splats, *cameras: Camera) -> np.ndarray:
        """[M, 3] what the share of the far side changes there."""
        views = [(camera, draw(truth, camera), covered(splats, camera)) for camera in cameras]
        both = [base_colors(lift_global(splats, views, options).splats) for options in (GLOBAL_DEFAULTS, without)]
        return (both[0] - both[1])[hidden]

    darker = (base_colors(relit) - old)[splats.means[:, 2] > 0.3].mean()
    assert darker < -0.1 and moved(relit, FRONT).mean() > -0.2 * darker
    assert np.abs(moved(relit, FRONT, BACK)).max() < 0.01
    assert np.abs(moved(regraded(splats), FRONT)).max() < 0.01


def test_a_view_that_is_not_edited_changes_next_to_nothing():
    splats = ball(degree=1)
    result = lifted(splats, splats, FRONT).splats
    for camera in (FRONT, SIDE, BACK):
        assert db(draw(result, camera), draw(splats, camera)) > 50


def test_rows_that_were_seen_are_trusted_more_than_predicted_ones():
    splats = ball()
    confidence = lifted(splats, regraded(splats), FRONT).confidence
    assert confidence.shape == (len(splats),) and confidence.dtype == np.float32
    assert (confidence >= 0).all() and (confidence <= 1).all()
    z = splats.means[:, 2]
    seen, rim, unseen = confidence[z > 0.6], confidence[(z > 0.1) & (z < 0.3)], confidence[z < -0.1]
    assert seen.min() > unseen.max() and seen.mean() > rim.mean() > unseen.mean()
    assert seen.mean() > 0.8 and unseen.mean() < 0.4
    # Another view adds to it.
    assert lifted(splats, regraded(splats), FRONT, BACK).confidence[z < -0.6].min() > unseen.max()


@pytest.mark.parametrize("swapped", [False, True])
def test_the_later_of_two_conflicting_views_wins_where_both_see(swapped):
    splats = ball()
    red, blue = (regraded(splats, 0.2 * np.eye(3), np.array(shift)) for shift in ([0.7, 0.1, 0.1], [0.1, 0.1, 0.7]))
    first, last = (blue, red) if swapped else (red, blue)
    views = [
        (camera, draw(truth, camera), covered(splats, camera)) for camera, truth in ((FRONT, first), (NEAR_FRONT, last))
    ]
    result = lift_global(splats, views).splats
    weights = sp.render(splats, [FRONT, NEAR_FRONT], contributions=True).contributions
    assert weights is not None
    both = (weights > 3).all(0)
    assert both.sum() > 200
    expected, other = (np.abs(base_colors(result) - base_colors(truth))[both] for truth in (last, first))
    assert expected.mean() < 0.05 and (expected.max(1) < other.max(1)).mean() > 0.99
    on = covered(splats, NEAR_FRONT)
    assert db(draw(result, NEAR_FRONT), draw(last, NEAR_FRONT), on) > 21  # its rim is the first's too
    # What only the first view shows is still the first one's.
    only = (weights[0] > 3) & (weights[1] < 0.1)
    assert only.sum() > 50
    assert np.abs(base_colors(result) - base_colors(first))[only].mean() < 0.05


def test_views_that_agree_are_better_than_one():
    splats = ball()
    truth = regraded(splats)
    one = gains(splats, truth, lifted(splats, truth, FRONT).splats, BACK)[0][1]
    two = gains(splats, truth, lifted(splats, truth, FRONT, SIDE).splats, BACK)[0][1]
    four = gains(splats, truth, lifted(splats, truth, FRONT, SIDE, BACK, TOP).splats, BACK)[0][1]
    assert one < two < four


def odd(splats: Splats) -> tuple[Splats, np.ndarray]:
    """The same with rows of every kind that cannot be drawn, and which those are."""
    copies = {name: getattr(splats, name).copy() for name in ("means", "quats", "scales", "opacities", "sh")}
    rows = np.arange(5, 2005, 200)
    for row, (name, value) in zip(
        rows,
        [
            ("means", np.nan),
            ("means", np.inf),
            ("quats", np.nan),
            ("quats", np.inf),
            ("quats", 0),
            ("scales", 0),
            ("scales", np.inf),
            ("opacities", np.nan),
            ("sh", np.nan),
            ("sh", -np.inf),
        ],
        strict=True,
    ):
        copies[name][row] = value
    return replace(splats, **copies), rows


def test_rows_that_cannot_be_drawn_keep_their_bits():
    splats, rows = odd(ball(degree=1))
    truth = regraded(ball(degree=1))
    result = lifted(splats, truth, FRONT)
    assert not differing(splats, result.splats)[rows].any()
    np.testing.assert_array_equal(bits(result.splats.sh[rows]), bits(splats.sh[rows]))
    assert (result.confidence[rows] == 0).all() and np.isfinite(result.confidence).all()
    good = np.delete(np.arange(len(splats)), rows)
    assert np.isfinite(result.splats.sh[good]).all()
    before, after = gains(splats, truth, result.splats, BACK)[0]
    assert after > before + 10


@pytest.mark.parametrize("opacity", [0.8, 0.95])
def test_normals_point_outwards(opacity):
    # The bottom is seen from nowhere outside, but at 0.8 a hundredth of the light comes through from within.
    splats = replace(ball(), opacities=np.full(3000, opacity, np.float32))
    normals = outward_normals(splats)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert ((normals * splats.means).sum(1) > 0.99).all()
    # A single sheet has no inside: both sides are seen, and each row still gets a unit normal across it.
    flat = outward_normals(sheet(20))
    np.testing.assert_allclose(np.abs(flat[:, 2]), 1, atol=1e-5)


def test_the_same_bits_on_any_number_of_threads(monkeypatch):
    splats = ball(degree=1)
    truth, results = regraded(splats), []
    for count in ("1", "2", "3"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", count)
        results.append(lifted(splats, truth, FRONT, TOP))
    for other in results[1:]:
        assert same_bits(results[0].splats, other.splats)
        np.testing.assert_array_equal(results[0].confidence, other.confidence)


@pytest.mark.parametrize("case", ["empty mask", "on the background", "looking away", "a mist"])
def test_views_that_show_nothing_solid_are_an_error(case):
    splats, camera = ball(), FRONT
    mask = covered(splats, camera)
    if case == "empty mask":
        mask = np.zeros_like(mask)
    elif case == "on the background":
        mask = ~mask
    elif case == "looking away":
        camera = look_at((0, 0, 3.5), (0, 0, 9), width=96, height=96)
    else:
        splats = replace(splats, opacities=np.full(len(splats), 0.1, np.float32))
    with pytest.raises(ValueError, match="edit: ") as error:
        lift_global(splats, [(camera, np.full((96, 96, 3), 0.5, np.float32), mask)])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("count", [1, 3, 7, 64])
def test_leverage_and_turned_bands_are_those_of_their_formulas(count: int):
    rng = np.random.default_rng(count)
    features, matrix = rng.normal(size=(count, 36)).astype(np.float32), rng.normal(size=(36, 36)).astype(np.float32)
    linear, sh = rng.normal(size=(9, 9)).astype(np.float32), rng.normal(size=(count, 4, 3)).astype(np.float32)
    leverage, turned = np.empty(count, np.float32), sh.copy()
    run(kernels.measure_leverage, features, matrix, leverage)
    run(kernels.turn_bands, features, linear, turned)
    wide = features.astype(np.float64)
    assert np.allclose(leverage, np.einsum("ni,ij,nj->n", wide, matrix, wide), rtol=1e-4, atol=1e-3)
    # The sums' order is numpy's, so that products of whole arrays gave the same bits.
    products = np.zeros((count, 36), np.float32)
    for k in range(36):
        products = products + features[:, k : k + 1] * matrix[k]
    assert np.array_equal(leverage, (products * features).sum(1))
    maps = np.einsum("nk,kj->nj", features.reshape(count, 9, 4)[:, :, 3], linear).reshape(count, 3, 3) + np.eye(3)
    maps[:, range(3), range(3)] = np.clip(maps[:, range(3), range(3)], 0, 2)
    assert np.allclose(turned[:, 1:], np.einsum("nij,nkj->nki", maps, sh[:, 1:]), atol=1e-5)
    assert np.array_equal(turned[:, 0], sh[:, 0])
