"""Opacity and blend modes: exact at both ends, and the written-out formulas in between."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.painter import Painter
from splatpainter.session import Session
from splatpainter.session.replay.appearance import with_base
from splatpainter.session.replay.delta import Delta, between
from splatpainter.session.replay.layer_blending import ADJUSTMENTS, adjust_sh, blend_delta, blend_sh, mix_sh
from splatpainter.splats import MAX_MAGNITUDE, Splats
from tests.support.lift_scenes import bits, db, differing, disk, front, same_bits, sheet
from tests.support.session_scenes import BLUE, RED, asset, dab

Y0 = 0.28209479177387814


def changed_asset() -> tuple[Splats, Delta]:
    """An asset and a delta that recolours rows 3..9, moves row 3, fades row 4, and appends two rows."""
    below, rng = asset(5), np.random.default_rng(3)
    after = replace(below, **{k: getattr(below, k).copy() for k in ("means", "opacities", "sh")})
    after.sh[3:10] += rng.normal(0, 0.5, after.sh[3:10].shape)
    after.means[3] += 0.1
    after.opacities[[3, 4]] = 0.2
    tail = after.take(np.array([3, 3]))
    tail.sh[:, 0] += 0.3
    return below, between(below, after.append(tail), np.array([3, -1]))


def test_full_normal_opacity_is_the_delta_itself():
    below, delta = changed_asset()
    assert blend_delta(below, delta, 1.0) is delta
    same = blend_delta(below, delta, 1.0, "normal", np.ones(len(below)))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(bits(getattr(same.values, name)), bits(getattr(delta.values, name)))
        np.testing.assert_array_equal(bits(getattr(same.appended, name)), bits(getattr(delta.appended, name)))


def test_rows_without_strength_are_left_out_and_so_are_their_children():
    below, delta = changed_asset()
    strength = np.ones(len(below))
    strength[:6] = 0
    left = blend_delta(below, delta, 0.7, "normal", strength)
    assert left.gaussian_ids.tolist() == [6, 7, 8, 9]
    assert left.parent_ids.tolist() == [-1]
    after = left.apply(below)
    assert np.flatnonzero(differing(below, after)).tolist() == [6, 7, 8, 9]


def test_opacities_that_are_no_numbers_are_blended_without_a_warning():
    below, delta = changed_asset()
    odd = replace(below, opacities=np.full(len(below), np.inf, np.float32))
    values = replace(delta.values, opacities=np.full(len(delta.values), -np.inf, np.float32))
    assert len(blend_delta(odd, replace(delta, values=values), 0.5).values) == len(delta.values)


def test_half_opacity_mixes_colours_and_takes_the_new_geometry():
    below, delta = changed_asset()
    half = blend_delta(below, delta, 0.5)
    old = below.sh[delta.gaussian_ids].astype(np.float64)
    np.testing.assert_allclose(half.values.sh, (old + delta.values.sh) / 2, atol=1e-6)
    np.testing.assert_array_equal(half.values.means, delta.values.means)
    at = delta.gaussian_ids.tolist().index
    assert half.values.opacities[at(3)] == np.float32(0.2)  # its geometry is new: the opacity belongs to that
    assert half.values.opacities[at(4)] == pytest.approx((0.9 + 0.2) / 2)
    parent = below.sh[3].astype(np.float64)
    np.testing.assert_allclose(half.appended.sh[0], (parent + delta.appended.sh[0]) / 2, atol=1e-6)
    np.testing.assert_array_equal(half.appended.sh[1], delta.appended.sh[1])  # no parent: no colour to start from


def w3c(below: np.ndarray, above: np.ndarray, mode: str) -> np.ndarray:
    """Compositing and Blending Level 1, section 10.2, one colour at a time in float64."""

    def lum(c):
        return 0.3 * c[0] + 0.59 * c[1] + 0.11 * c[2]

    def clip_color(c):
        light, low, high = lum(c), min(c), max(c)
        if low < 0:
            c = [light + (x - light) * light / (light - low) for x in c]
        if high > 1:
            c = [light + (x - light) * (1 - light) / (high - light) for x in c]
        return c

    def set_lum(c, light):
        d = light - lum(c)
        return clip_color([x + d for x in c])

    if mode == "color":
        return np.array(set_lum(above, lum(below)))
    if mode == "luminosity":
        return np.array(set_lum(below, lum(above)))
    return np.minimum(below, above) if mode == "darken" else np.maximum(below, above)


@pytest.mark.parametrize("mode", ["color", "luminosity", "darken", "lighten"])
def test_base_colours_follow_the_w3c(mode):
    rng = np.random.default_rng(7)
    old, new = rng.uniform(0, 1, (2, 200, 3))
    out = blend_sh(((old - 0.5) / Y0)[:, None], ((new - 0.5) / Y0)[:, None], mode)
    expected = np.array([w3c(b, a, mode) for b, a in zip(old, new, strict=True)])
    np.testing.assert_allclose(0.5 + Y0 * out[:, 0], expected, atol=2e-6)


def test_bands_follow_the_linear_part():
    rng = np.random.default_rng(8)
    old, new = rng.normal(0, 0.2, (2, 50, 4, 3)).astype(np.float32)
    luma = np.array([0.3, 0.59, 0.11])
    hue = blend_sh(old, new, "color")
    np.testing.assert_allclose(hue[:, 1:] @ luma, old[:, 1:] @ luma, atol=1e-6)
    np.testing.assert_allclose(hue[:, 1:, 0] - hue[:, 1:, 1], new[:, 1:, 0] - new[:, 1:, 1], atol=1e-6)
    dark = blend_sh(old, new, "darken")
    takes = new[:, 0] < old[:, 0]
    np.testing.assert_array_equal(dark, np.where(takes[:, None], new, old))


@pytest.mark.parametrize("mode", ["color", "luminosity", "darken", "lighten"])
def test_partial_blends_lie_between(mode):
    rng = np.random.default_rng(9)
    old, new = rng.normal(0, 0.2, (2, 20, 4, 3)).astype(np.float32)
    full = mix_sh(old, new, np.ones(20, np.float32), mode)
    quarter = mix_sh(old, new, np.full(20, 0.25, np.float32), mode)
    np.testing.assert_allclose(quarter, 0.75 * old + 0.25 * full, atol=1e-6)
    np.testing.assert_array_equal(full, blend_sh(old, new, mode))


def test_a_picture_at_half_opacity_is_half_way():
    """With the real painter, which splits rows: the mean of both pictures within what splitting itself moves."""
    splats = sheet(16, opacity=0.95)
    camera = front(64)
    edit = dab(RED, 32, 32, 10, camera)
    painter = Painter.load("lift")
    done = painter.apply(painter.encode(replace(splats, origin=np.arange(len(splats)))), [edit])
    assert done.splats.origin is not None and len(done.splats) > len(splats)
    delta = between(splats, done.splats, done.splats.origin[len(splats) :])
    assert (delta.parent_ids >= 0).all() and delta.base is None
    delta = with_base(splats, delta, [camera])
    assert delta.base is not None and len(delta.base) == len(delta.gaussian_ids) + len(delta.appended)
    pictures = [sp.render(blend_delta(splats, delta, o).apply(splats), camera).colors[0] for o in (1e-6, 0.5, 1.0)]
    nothing = sp.render(splats, camera).colors[0]
    inside = edit.mask
    assert db(pictures[0], nothing, inside) > 38 and db(pictures[0], nothing) > 38
    assert db(pictures[1], (nothing + pictures[2]) / 2, inside) > 38
    assert db(pictures[2], nothing) < 22
    assert same_bits(blend_delta(splats, delta, 1.0).apply(splats), done.splats)
    # From the colours of parents the sheet would start blocky.
    blocky = sp.render(blend_delta(splats, replace(delta, base=None), 1e-6).apply(splats), camera).colors[0]
    assert db(blocky, nothing, inside) < db(pictures[0], nothing, inside) - 3


def test_blend_modes_of_a_sheet_act_on_the_picture_below():
    splats, camera = sheet(16, opacity=0.95), front(64)
    edit = dab(RED, 32, 32, 10, camera)
    with Session(splats, painter=Painter.load("lift")) as session:
        layer = session.layers.add("paint", [edit], blend="luminosity")
        below, paint = (sp.render(each, camera).colors[0] for each in (splats, session.splats))
        inside = disk(camera, 32, 32, 8)
        luma = np.array([0.3, 0.59, 0.11])
        np.testing.assert_allclose((paint @ luma)[inside].mean(), np.array(RED) @ luma, atol=0.02)
        chroma = [picture[inside] - (picture @ luma)[inside][:, None] for picture in (paint, below)]
        assert np.abs(chroma[0] - chroma[1]).mean() < 0.02 and np.abs(chroma[0] - chroma[1]).max() < 0.1
        session.layers.set(layer.id, blend="normal", opacity=0.5)
        half, rows = session.splats, len(session.splats)
        session.layers.set(layer.id, opacity=1.0)
        full = sp.render(session.splats, camera).colors[0]
        assert db(sp.render(half, camera).colors[0], (below + full) / 2, inside) > 38
        merged = session.layers.merge([layer.id, session.layers.add("paint", [dab(BLUE, 36, 34, 7, camera)]).id])
        both = sp.render(session.splats, camera).colors[0]
        session.layers.set(merged.id, opacity=0.5)
        wide = disk(camera, 34, 33, 12)
        assert db(sp.render(session.splats, camera).colors[0], (below + both) / 2, wide) > 36
        assert session.verify(repaint=True) == []
        for _ in range(4):
            session.undo()
        assert same_bits(session.splats, half) and rows == len(half)


@pytest.mark.parametrize(
    "parameters",
    [
        {"look": "gain", "gain": [3e38, 1e30, -1e30]},
        {"look": "gain", "gain": [3e38] * 3, "offset": [-3e38] * 3},
    ],
    ids=["gain", "gain and offset"],
)
@pytest.mark.filterwarnings("error")
def test_an_adjustment_that_overflows_stops_where_gaussians_are_drawn(parameters):
    splats = asset()
    splats.sh[2:4] = [[[3e38]], [[-np.inf]]]  # of a file's rows that cannot be drawn
    drawable = splats.drawable
    assert (~drawable).sum() == 2
    edited = replace(splats, sh=adjust_sh(splats.sh, parameters, ADJUSTMENTS))
    assert (edited.drawable == drawable).all() and np.abs(edited.sh[drawable]).max() == np.float32(MAX_MAGNITUDE / 100)
    for mode in ("normal", "color"):
        half = blend_delta(splats, between(splats, edited), 0.5, mode).apply(splats)
        assert (half.drawable == drawable).all()


@pytest.mark.filterwarnings("error")
def test_an_ordinary_adjustment_is_not_limited():
    sh = asset().sh.copy()
    sh[0, 0] = 9e14  # drawn, and beyond what an overflow is limited to
    out = adjust_sh(sh, {"look": "gain", "gain": [1, 0.5, 2]}, ADJUSTMENTS)
    np.testing.assert_array_equal(out[:, 1:], sh[:, 1:] * np.array([1, 0.5, 2], np.float32))
    assert out[0, 0, 1] == pytest.approx(4.5e14)


@pytest.mark.parametrize(
    "parameters",
    [
        {"look": [[[["deep"] * 500]]]},
        {"look": "x" * 5000},
        {"look": "gain", "gain": ["x" * 5000] * 3},
        {"look": "gain", "gain": [1e300, 1, 1]},
        {"look": "grade", "exposure": 1e300},
    ],
)
@pytest.mark.filterwarnings("error")
def test_wrong_parameters_of_an_adjustment_are_one_short_line(parameters):
    with pytest.raises(ValueError, match="^look: expected") as caught:
        adjust_sh(asset().sh, parameters, ADJUSTMENTS)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 150
