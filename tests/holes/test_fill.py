"""Holes filled: where the new Gaussians lie, how they look, that nothing else changes, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.cameras import look_at
from splatpainter.holes import chart, fill
from splatpainter.holes.air import in_the_air
from splatpainter.holes.border import _border, borders_of
from splatpainter.holes.fill import fill_hole
from splatpainter.io.axes import move
from splatpainter.rendering import render
from splatpainter.sources.picture_source import SourceError
from splatpainter.splats import SH_C0, Splats, changed_rows
from tests.support.cli_scenes import ball, with_bad_gaussians
from tests.support.picture_sources import FunctionSource

SPACING = 0.05


def plate(z: float = 0.0, side: int = 41, colors: tuple[float, ...] | None = None) -> Splats:
    """A square of flat Gaussians in the plane z, [-1, 1]^2, striped along x."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side)))
    count = len(x)
    stripes = np.where(np.floor((x + 1) / 0.2).astype(int) % 2 == 0, 0.75, 0.35)
    rgb = np.repeat(stripes[:, None], 3, 1) if colors is None else np.tile(colors, (count, 1))
    return Splats(
        np.stack([x, y, np.full(count, z)], 1).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.tile(np.array([0.6 * SPACING, 0.6 * SPACING, 0.003], np.float32), (count, 1)),
        np.full(count, 0.97, np.float32),
        ((rgb - 0.5) / SH_C0)[:, None].astype(np.float32),
    )


def within(splats: Splats, center: tuple[float, float, float], radius: float) -> np.ndarray:
    return ((splats.means - np.array(center)) ** 2).sum(1) < radius**2


def facing_plate(side: float = -3.0, aside: float = 0.0):
    return look_at((aside, 0, side), (0, 0, 0), (0, -1, 0), width=96, height=96, fov=30)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def test_a_plate_is_closed_in_its_plane_and_its_stripes_go_on() -> None:
    splats = plate()
    removed = within(splats, (0.05, 0.1, 0), 0.3)
    asset = sp.fill(splats, removed)
    after, receipt = asset.splats, asset.receipt
    assert receipt is not None
    np.testing.assert_array_equal(changed_rows(splats, after), np.flatnonzero(removed))
    assert (after.opacities[: len(splats)][removed] == 0).all()
    np.testing.assert_array_equal(receipt.removed, np.flatnonzero(removed))
    new = after.take(np.arange(len(splats), len(after)))
    assert receipt.appended_rows == len(new) and f"{len(new):,} Gaussians" in receipt.note
    assert 0.8 * removed.sum() < len(new) < 2.2 * removed.sum(), "about as dense as what is around"
    assert np.abs(new.means[:, 2]).max() < 0.01
    assert np.hypot(new.means[:, 0] - 0.05, new.means[:, 1] - 0.1).max() < 0.42
    for aside in (0.0, 2.0):
        camera = facing_plate(aside=aside)
        truth, closed = (render(s, camera).colors[0] for s in (splats, after))
        hole = render(replace(splats, opacities=np.where(removed, np.float32(0), splats.opacities)), camera).colors[0]
        changed = np.abs(truth - hole).max(-1) > 0.05
        mean = np.full_like(truth, truth[changed].mean())
        assert psnr(truth[changed], closed[changed]) > psnr(truth[changed], mean[changed]) + 3, "stripes, not grey"
    again = sp.fill(splats, removed).splats
    assert np.array_equal(again.means, after.means) and np.array_equal(again.sh, after.sh)


def test_a_hole_that_is_there_is_circled() -> None:
    full = plate()
    splats = full.take(np.flatnonzero(~within(full, (0, 0, 0), 0.25)))
    filled = fill_hole(splats, around=within(splats, (0, 0, 0), 0.4))
    assert np.abs(filled.appended.means[:, 2]).max() < 0.01 and filled.holes == 1
    picture = render(splats.append(filled.appended), facing_plate())
    assert picture.alphas[0, 30:66, 30:66].min() > 0.85
    with pytest.raises(ValueError, match="there is no hole"):
        fill_hole(splats, around=within(splats, (0.7, 0.7, 0), 0.25))


def test_a_ball_stays_round() -> None:
    splats = ball(4000, degree=2)
    filled = fill_hole(splats, removed=within(splats, (0, 0, -1), 0.7))
    radii = np.linalg.norm(filled.appended.means, axis=1)
    assert np.abs(radii - 1).max() < 0.06, "a flat lid would lie at 0.76"
    assert filled.appended.sh.shape[1:] == (9, 3) and not filled.appended.sh[:, 1:].any()


def test_what_stood_on_a_plate_goes_and_the_plate_is_whole() -> None:
    """The plate has a hole where a box stood on it, larger above than at its foot."""
    full = plate()
    ground = full.take(np.flatnonzero(~(np.abs(full.means[:, :2]) < 0.22).all(1)))
    rng = np.random.default_rng(0)
    foot = rng.uniform((-0.25, -0.25, -0.2), (0.25, 0.25, 0), (600, 3))
    top = rng.uniform((-0.5, -0.5, -0.6), (0.5, 0.5, -0.2), (1200, 3))
    means = np.concatenate([foot, top]).astype(np.float32)
    box = Splats(
        means,
        np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1)),
        np.full((len(means), 3), 0.03, np.float32),
        np.full(len(means), 0.9, np.float32),
        np.full((len(means), 1, 3), 1.0, np.float32),
    )
    splats = ground.append(box)
    asset = sp.fill(splats, np.arange(len(splats)) >= len(ground))
    new = asset.splats.take(np.arange(len(splats), len(asset.splats)))
    assert np.abs(new.means[:, 2]).max() < 0.02 and np.abs(new.means[:, :2]).max() < 0.35
    assert render(asset.splats, facing_plate()).alphas[0, 28:68, 28:68].min() > 0.85


def test_both_sides_of_a_wall_are_closed_in_their_own_colours() -> None:
    front, back = plate(-0.2, colors=(0.8, 0.3, 0.3)), plate(0.2, colors=(0.3, 0.3, 0.8))
    splats = front.append(back)
    filled = fill_hole(splats, removed=within(splats, (0, 0, 0), 0.35))
    heights, colors = filled.appended.means[:, 2], 0.5 + SH_C0 * filled.appended.sh[:, 0]
    assert filled.holes == 2 and (np.abs(np.abs(heights) - 0.2) < 0.02).all()
    assert (colors[heights < 0, 0] > 0.6).all() and (colors[heights > 0, 2] > 0.6).all()


def test_a_stump_gets_a_lid() -> None:
    angle, along = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 2 * np.pi, 60, endpoint=False), np.arange(40)))
    means = np.stack([0.3 * np.cos(angle), 0.04 * along, 0.3 * np.sin(angle)], 1).astype(np.float32)
    quats = np.stack([np.cos(angle / 2), 0 * angle, -np.sin(angle / 2), 0 * angle], 1).astype(np.float32)
    scales = np.tile(np.array([0.003, 0.022, 0.022], np.float32), (len(means), 1))
    rod = Splats(means, quats, scales, np.full(len(means), 0.97, np.float32), np.zeros((len(means), 1, 3), np.float32))
    filled = fill_hole(rod, removed=means[:, 1] > 0.8)
    lid = filled.appended.means
    assert np.hypot(lid[:, 0], lid[:, 2]).max() < 0.35 and np.abs(lid[:, 1] - 0.8).max() < 0.12
    assert np.hypot(lid[:, 0], lid[:, 2]).min() < 0.05


def test_no_fill_stands_where_there_was_air(monkeypatch: pytest.MonkeyPatch) -> None:
    """A smooth surface over the corner between a wall and a floor would cut it off."""
    wall, half = plate(), np.float32(0.5**0.5)
    lying = np.tile(np.array([half, half, 0, 0], np.float32), (len(wall), 1))
    floor = replace(wall, means=wall.means[:, [0, 2, 1]] + np.array([0, 1, -1], np.float32), quats=lying)
    splats = wall.append(floor)
    removed = within(splats, (0, 1, 0), 0.7)
    emptied = replace(splats, opacities=np.where(removed, np.float32(0), splats.opacities))
    new = fill_hole(emptied, removed=removed).appended.means
    assert len(new) > 0.5 * removed.sum()
    assert np.minimum(np.abs(new[:, 2]), np.abs(new[:, 1] - 1)).max() < 0.125, "two cells and a pixel"
    # The inside of a thing that stood there, and the ground below it, are no air; what is beside it is.
    (border,) = borders_of(splats, ~removed, within(splats, (0, 1, 0), 0.8) & ~removed)
    means = np.array([[0, 0.7, -0.3], [0, 1, -0.3], [0, 0.7, -0.75], [0.6, 0.7, -0.3]], np.float32)
    thing = ball(2_000, radius=0.3, degree=0)
    thing = replace(thing, means=thing.means + np.array([0, 0.7, -0.3], np.float32))
    np.testing.assert_array_equal(in_the_air(splats.append(thing), means, border), [False, False, True, True])
    assert in_the_air(thing, means[3:], border).all(), "nothing behind it either"
    monkeypatch.setattr(fill, "in_the_air", lambda splats, points, border: np.ones(len(points), bool))
    assert fill_hole(emptied, removed=removed).note.endswith("what goes on from there would stand in the air")


def test_a_source_colours_the_fill_and_nothing_else() -> None:
    splats = plate()
    removed = within(splats, (0, 0, 0), 0.3)
    source = FunctionSource(lambda image: np.clip(image * (0.6, 1.1, 0.6), 0, 1))
    by_source = sp.fill(splats, removed, source=source, prompt=sp.SourceBrief("moss", strictness="loose"))
    plain = sp.fill(splats, removed)
    (request,) = source.requests
    assert request.mask is not None and 0.02 < request.mask.mean() < 0.5 and request.prompt == "moss"
    first, second = by_source.splats, plain.splats
    assert np.array_equal(first.means, second.means) and np.array_equal(first.sh[: len(splats)], splats.sh)
    tints = [(0.5 + SH_C0 * s.sh[len(splats) :, 0]).mean(0) for s in (first, second)]
    assert tints[0][1] - tints[0][0] > 0.15 > abs(tints[1][1] - tints[1][0])
    assert by_source.receipt is not None and by_source.receipt.source is not None
    assert by_source.receipt.source["prompt"] == "moss" and len(by_source.receipt.source["views"]) == 1
    away = look_at((0, 0, -3), (0, 0, -6), (0, -1, 0), width=64, height=64)
    with pytest.raises(SourceError, match="does not show the hole"):
        sp.fill(splats, removed, source=source, camera=away)


def test_bad_input_is_one_line() -> None:
    splats, none = plate(), np.zeros(41 * 41, bool)
    rng = np.random.default_rng(1)
    fog = replace(splats, means=rng.uniform(-1, 1, (len(splats), 3)).astype(np.float32))
    fog = replace(fog, opacities=np.full(len(fog), 0.06, np.float32), scales=np.full_like(fog.scales, 0.1))
    middle = within(fog, (0, 0, 0), 0.4)
    cases = [
        (splats, {"removed": none}, "nothing was removed"),
        (splats, {"around": none}, "nothing is selected"),
        (splats, {"removed": ~none}, "nothing is left there"),
        (splats, {"removed": ~within(splats, (-1, -1, 0), 0.12)}, "nothing is left there"),
        (fog, {"around": middle}, "fill: "),
    ]
    for asset, where, words in cases:
        with pytest.raises(ValueError, match=words) as error:
            fill_hole(asset, **where)
        assert "\n" not in str(error.value)
    for asset, gone, words in ((fog, middle, "not a surface"), (splats, within(splats, (-1, -1, 0), 0.02), "")):
        unfilled = fill_hole(asset, removed=gone)
        assert words in unfilled.note and len(unfilled.appended) == unfilled.holes == 0
    bad = with_bad_gaussians(splats.take(np.arange(len(splats))))
    filled = fill_hole(bad, removed=within(splats, (0.05, 0.1, 0), 0.3) | ~bad.drawable)
    assert np.isfinite(filled.appended.means).all() and filled.appended.drawable.all()
    for weights, words in ((none, "nothing was removed"), (none[:-1], "expected .1681. weights"), (None, "or those")):
        with pytest.raises(ValueError, match=words):
            sp.fill(splats, weights)


def test_a_huge_hole_is_filled_more_coarsely(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chart, "CHART", replace(chart.CHART, max_side_px=60))
    splats = plate()
    removed = within(splats, (0, 0, 0), 0.6)
    filled = fill_hole(splats, removed=removed)
    assert filled.coarse and 20 < len(filled.appended) < removed.sum() / 2 and "coarser" in filled.note
    assert np.abs(filled.appended.means[:, 2]).max() < 0.02


@pytest.mark.parametrize("turn", range(3))
def test_a_ball_stays_round_however_it_is_turned(turn: int) -> None:
    """Its border has noise, whose bends were carried on into the hole: by 0.05 to 0.12 of the radius."""
    rng = np.random.default_rng(7 + turn)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes *= np.sign(np.linalg.det(axes))
    splats = move(ball(4000, degree=2), axes)
    filled = fill_hole(splats, removed=((splats.means - axes @ (0, 0, -1)) ** 2).sum(1) < 0.7**2)
    assert np.abs(np.linalg.norm(filled.appended.means, axis=1) - 1).max() < 0.02


def test_the_normal_of_a_border_is_what_its_gaussians_agree_on() -> None:
    """Not its shortest extent: they face z, and lie along y and z."""
    rng = np.random.default_rng(2)
    splats = plate().take(np.arange(300))
    means = (rng.uniform(-1, 1, (300, 3)) * (0.1, 2, 1)).astype(np.float32)
    border = _border(replace(splats, means=means), np.arange(300))
    assert border.aligned and abs(border.normal[2]) > 0.999 and abs(border.across[1]) > 0.99
