"""Looks on assets: what they promise, and that nothing beyond the region changes by a bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import look_at
from splatpainter.color import base_color, luminance, oklab, srgb_to_linear
from splatpainter.grading.color_grading import GradeSettings, grade_sh
from splatpainter.grading.color_match import ColorMatch, Recolor, monge_kantorovitch, seen_weights, statistics
from splatpainter.grading.cube_lut import parse_cube
from splatpainter.image_files import write_png
from splatpainter.operations.grade import describe, grade
from splatpainter.operations.region import Region, hues
from splatpainter.painter import Edit, Painter
from splatpainter.pictures.picture_reader import Picture
from splatpainter.rendering import render
from splatpainter.session import Session
from splatpainter.session.selection.selection import moved_ids
from splatpainter.splats import SH_C0, Splats
from tests.support.cli_scenes import ball, with_bad_gaussians


def shaded_ball() -> Splats:
    """The ball with colours of many shades, and red around its top."""
    splats = ball(1200)
    sh = splats.sh.copy()
    sh[:, 0] += np.random.default_rng(0).normal(0, 0.25, (len(splats), 1)).astype(np.float32)
    return replace(splats, sh=sh)


def red_cap(splats: Splats) -> np.ndarray:
    return splats.means[:, 1] < -0.8


def test_sliders_are_those_of_an_adjustment_layer() -> None:
    splats, sliders = shaded_ball(), GradeSettings(exposure=0.5, temperature=0.4, saturation=-0.2)
    edited = grade(splats, sliders)
    assert (edited.splats.sh == grade_sh(splats.sh, sliders.to_dict())).all()
    assert edited.receipt is not None and edited.receipt.note == "exposure 0.5, temperature 0.4, saturation -0.2"


def test_outside_the_region_nothing_changes_by_a_bit() -> None:
    splats = with_bad_gaussians(shaded_ball())
    edited = grade(splats, GradeSettings(exposure=1.0), Region.parse(["hue=340..20", "y=..0"]))
    assert edited.receipt is not None
    outside = np.ones(len(splats), bool)
    outside[edited.receipt.touched] = False
    assert edited.receipt.untouched_sha256_before == edited.receipt.untouched_sha256_after
    assert (edited.splats.sh[outside].view(np.uint32) == splats.sh[outside].view(np.uint32)).all()
    drawable_cap = red_cap(splats) & splats.drawable
    assert (~outside)[drawable_cap].mean() > 0.95 and not (~outside)[~red_cap(splats)].any()
    for name in ("means", "quats", "scales", "opacities"):
        assert getattr(edited.splats, name) is getattr(splats, name)


def test_half_the_strength_is_half_of_the_change() -> None:
    splats, look = shaded_ball(), GradeSettings(exposure=0.4)
    full, half = grade(splats, look).splats, grade(splats, look, strength=0.5).splats
    expected = (base_color(splats.sh).clip(0, 1) + base_color(full.sh)) / 2
    inside = ((base_color(splats.sh) > 0) & (base_color(splats.sh) < 1)).all(1)
    np.testing.assert_allclose(base_color(half.sh)[inside], expected[inside], atol=1e-5)


def test_a_table_acts_on_display_colours() -> None:
    inverted = parse_cube("LUT_1D_SIZE 2\n1 1 1\n0 0 0\n", "negative.cube")
    splats = ball(300)
    edited = grade(splats, inverted)
    np.testing.assert_allclose(base_color(edited.splats.sh), 1 - base_color(splats.sh), atol=1e-6)
    np.testing.assert_allclose(edited.splats.sh[:, 1:], -splats.sh[:, 1:], atol=1e-4)
    assert edited.receipt is not None and edited.receipt.note == "LUT negative.cube"


def test_of_linear_assets_a_table_sees_the_display_colours_too() -> None:
    splats = ball(300)
    light = replace(
        splats, sh=srgb_to_linear(base_color(splats.sh))[:, None] / SH_C0 - 0.5 / SH_C0, color_space="linear"
    )
    edited = grade(light, parse_cube("LUT_1D_SIZE 2\n1 1 1\n0 0 0\n", "negative.cube")).splats
    np.testing.assert_allclose(base_color(edited.sh), srgb_to_linear(1 - base_color(splats.sh)), atol=1e-4)


# References


def test_the_map_carries_one_covariance_into_the_other() -> None:
    """T A T = B for symmetric T, which is what makes it the map of optimal transport (Monge-Kantorovitch)."""
    rng = np.random.default_rng(0)
    a, b = (m @ m.T * 0.05 for m in rng.normal(size=(2, 3, 3)))
    noise = (4 / 255) ** 2 * np.eye(3)
    matrix = monge_kantorovitch(a, b)
    np.testing.assert_allclose(matrix @ (a + noise) @ matrix, b + noise, atol=1e-9)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-9)
    assert (np.linalg.eigvalsh(matrix) > 0).all()


def test_a_match_gives_what_is_seen_the_colours_of_the_picture() -> None:
    splats = shaded_ball()
    pixels = np.random.default_rng(2).normal([0.6, 0.45, 0.3], [0.08, 0.05, 0.03], (40, 50, 3)).clip(0, 1)
    edited = grade(splats, ColorMatch(Picture(pixels.astype(np.float32), None), "evening.png")).splats
    weights = seen_weights(splats)
    mean, covariance = statistics(base_color(edited.sh), weights)
    target_mean, target_covariance = statistics(pixels.reshape(-1, 3), np.ones(2000))
    np.testing.assert_allclose(mean, target_mean, atol=0.02)
    np.testing.assert_allclose(covariance, target_covariance, atol=3e-3)


def test_what_lies_inside_counts_for_nothing() -> None:
    """A ball with a second, green one hidden inside it: a match is the one of the outer ball alone."""
    outer, inner = ball(3000), ball(500, radius=0.3)
    sh = inner.sh.copy()
    sh[:, 0] = (np.array([0, 1, 0]) - 0.5) / SH_C0
    names = ("means", "quats", "scales", "opacities")
    arrays = [np.concatenate([getattr(outer, name), getattr(inner, name)]) for name in names]
    both = Splats(arrays[0], arrays[1], arrays[2], arrays[3], np.concatenate([outer.sh, sh]))
    assert seen_weights(both)[3000:].sum() < 1e-3 * seen_weights(outer).sum()
    look = ColorMatch(Picture(np.full((4, 4, 3), 0.4, np.float32), None))
    alone, together = (base_color(grade(splats, look).splats.sh)[:3000] for splats in (outer, both))
    np.testing.assert_allclose(together, alone, atol=0.01)


def test_a_clear_picture_is_no_reference() -> None:
    picture = Picture(np.ones((4, 4, 3), np.float32), np.zeros((4, 4), np.float32))
    with pytest.raises(ValueError, match="of which something is opaque"):
        grade(ball(300), ColorMatch(picture))


def test_a_new_colour_keeps_light_and_shade() -> None:
    splats = shaded_ball()
    edited = grade(splats, Recolor((0.13, 0.25, 0.63)), Region.parse(["hue=330..30"])).splats
    cap = np.flatnonzero(red_cap(splats) & ((base_color(splats.sh) > 0.02) & (base_color(splats.sh) < 0.98)).all(1))
    new = base_color(edited.sh[cap])
    assert np.abs(hues(new) - hues(np.array([[0.13, 0.25, 0.63]]))).max() < 2
    before, after = (luminance(srgb_to_linear(base_color(s.sh[cap]).clip(0, 1))) for s in (splats, edited))
    unclipped = new.max(1) < 0.99
    assert np.corrcoef(before[unclipped], after[unclipped])[0, 1] > 0.99
    assert (edited.sh[~red_cap(splats)] == splats.sh[~red_cap(splats)]).all()


def test_black_has_no_shade_to_keep() -> None:
    splats = ball(300)
    black = replace(splats, sh=np.full_like(splats.sh, -0.5 / SH_C0))
    with pytest.raises(ValueError, match="something brighter than black"):
        grade(black, Recolor((1.0, 0.0, 0.0)))


def test_nothing_to_do_is_said() -> None:
    with pytest.raises(ValueError, match="^grade: nothing to do, neutral sliders changes no Gaussian$"):
        grade(ball(300), GradeSettings())
    with pytest.raises(ValueError, match="a strength above 0, up to 1, got 2"):
        grade(ball(300), GradeSettings(exposure=1.0), strength=2)
    with pytest.raises(ValueError, match="^expected exposure from -10 to 10, got 100000.0$"):
        GradeSettings(exposure=1e5)


def test_a_look_is_described_in_one_line() -> None:
    look = GradeSettings.from_dict({"curve": [[0, 0.1], [1, 0.9]], "hues": [{"hue": 10.0, "shift": 5.0}]})
    assert describe(look) == "curve of 2, hues of 1"
    assert describe(Recolor((1.0, 0.5, 0.0))) == "colour #ff8000"


# Regions


@pytest.mark.parametrize(
    "words, expected",
    [
        ("y=..-0.8", lambda m: m[:, 1] <= -0.8),
        ("not:y=..-0.8", lambda m: m[:, 1] > -0.8),
        ("x=0.. y=0..", lambda m: (m[:, 0] >= 0) & (m[:, 1] >= 0)),
        ("x=0.5.. or z=0.5..", lambda m: (m[:, 0] >= 0.5) | (m[:, 2] >= 0.5)),
        ("box=0,0,0,2,2,-2", lambda m: (m[:, 0] >= 0) & (m[:, 1] >= 0) & (m[:, 2] <= 0)),
        ("sphere=0,-1,0,0.5", lambda m: np.linalg.norm(m - [0, -1, 0], axis=1) <= 0.5),
        ("opacity=0.9..1 size=..9", lambda m: np.ones(len(m), bool)),
        ("hue=340..20", lambda m: m[:, 1] < -0.8),
        ("color=#e61919", lambda m: m[:, 1] < -0.8),
        ("saturation=0.5..", lambda m: m[:, 1] < -0.8),
        ("lightness=0.6..", lambda m: m[:, 1] >= -0.8),
    ],
)
def test_regions_are_what_they_say(words: str, expected) -> None:  # noqa: ANN001
    splats = ball(1200)
    np.testing.assert_array_equal(Region.parse([words]).weights(splats), expected(splats.means))


def test_colours_fade_out_beyond_a_range() -> None:
    splats = ball(4)
    angles = np.radians([0, 20, 27.5, 60])
    wheel = 0.5 + 0.3 * np.stack([np.cos(angles), np.cos(angles - 2.0944), np.cos(angles + 2.0944)], 1)
    graded = replace(splats, sh=np.repeat(((wheel - 0.5) / SH_C0)[:, None], 4, 1).astype(np.float32))
    weights = Region.parse(["hue=340..20"]).weights(graded)
    assert weights[0] == 1 and 0.5 < weights[1] <= 1 and 0 < weights[2] < weights[1] and weights[3] == 0


def test_oklab_of_white_and_of_a_published_colour() -> None:
    np.testing.assert_allclose(oklab(np.ones((1, 3))), [[1, 0, 0]], atol=1e-3)
    red = oklab(np.array([[1.0, 0, 0]]))
    np.testing.assert_allclose(red, [[0.62796, 0.22486, 0.12585]], atol=1e-4)  # as CSS Color 4 has it


def test_a_mask_drawn_on_a_view_reaches_what_it_shows(tmp_path: Path) -> None:
    splats = ball(1200)
    camera = look_at((0, 0, -3.5), (0, 0, 0), (0, -1, 0), width=96, height=96)
    (tmp_path / "cam.json").write_text(camera.to_json())
    pixels = np.zeros((48, 48), np.uint8)
    pixels[:24] = 255
    Image.fromarray(pixels).save(tmp_path / "mask.png")  # half the camera's size
    weights = Region.parse([f"mask={tmp_path / 'mask.png'}@{tmp_path / 'cam.json'}"]).weights(splats)
    assert weights[(splats.means[:, 1] < -0.2) & (splats.means[:, 2] < -0.3)].all()
    assert not weights[splats.means[:, 1] > 0.1].any()
    mask = f"mask={tmp_path / 'mask.png'}@{tmp_path / 'cam.json'}"
    beside = Region.parse([mask]).beside(splats)
    assert beside is not None and np.array_equal(beside, splats.means[:, 1] > 0), "in front and behind"
    for more in ([mask, "x=-9..9"], [mask, "or", mask], [f"not:{mask}"], ["x=-9..9"]):
        assert Region.parse(more).beside(splats) is None
    write_png(tmp_path / "own.png", np.repeat(pixels.repeat(2, 0).repeat(2, 1)[..., None], 3, -1) / 255.0, camera)
    again = Region.parse([f"mask={tmp_path / 'own.png'}"]).weights(splats)
    np.testing.assert_array_equal(again, weights)
    Image.fromarray(np.zeros((30, 90), np.uint8)).save(tmp_path / "wide.png")
    with pytest.raises(ValueError, match=r"wide\.png: expected a mask of its camera's shape \(96x96\), got 90x30"):
        Region.parse([f"mask={tmp_path / 'wide.png'}@{tmp_path / 'cam.json'}"])


@pytest.mark.parametrize(
    "words, line",
    [
        (["red"], "--where: expected NAME=VALUE with one of hue, saturation, "),
        (["hue="], "--where: expected NAME=VALUE with one of "),
        (["weight=1..2"], "--where: expected NAME=VALUE with one of "),
        (["hue=20"], "--where hue: expected A..B, ..B or A.., got '20'"),
        (["hue=20.."], "--where hue: expected A..B, two angles, got '20..'"),
        (["x=1..0"], "--where x: expected a range from its lower to its higher end, got '1..0'"),
        (["x=a..1"], "--where x: expected a number, got 'a'"),
        (["x=nan.."], "--where x: expected a number, got 'nan'"),
        (["box=1,2,3"], "--where box: expected 6 numbers with commas between, got '1,2,3'"),
        (["sphere=0,0,0,-1"], "--where sphere: expected a radius above 0, got '0,0,0,-1'"),
        (["color=red"], "--where color: expected #RRGGBB or #RRGGBB~DISTANCE, got 'red'"),
        (["color=#ff0000~0"], "--where color: expected a distance above 0, got '#ff0000~0'"),
        (["x=0..", "or"], "--where: expected a term on both sides of or"),
        (["x=0.."] * 65, "--where: expected 1 to 64 terms, got 65"),
        (["mask=missing.png@cam.json"], "cam.json: no such file; expected a camera"),
    ],
)
def test_a_region_that_means_nothing_is_one_line(words: list[str], line: str) -> None:
    with pytest.raises(ValueError) as caught:
        Region.parse(words)
    assert str(caught.value).startswith(line)


def test_a_region_that_reaches_nothing_says_so() -> None:
    with pytest.raises(ValueError, match=r"^--where x=5\.\.: reaches none of 300 Gaussians; widen it$"):
        grade(ball(300), GradeSettings(exposure=1.0), Region.parse(["x=5.."]))


def test_what_a_project_selects_and_paints(tmp_path: Path) -> None:
    """On the asset that its layers made, on the original, and on no other asset."""
    splats = shaded_ball()
    chosen = (splats.means[:, 0] > np.median(splats.means[:, 0])).astype(np.float32)
    camera = look_at((0, 0, -4), (0, 0, 0), (0, -1, 0), width=64, height=64)
    picture = np.clip(render(splats, camera).colors[0], 0, 1).copy()
    mask = np.zeros((64, 64), bool)
    mask[28:36, 28:36] = True
    picture[mask] = (0.1, 0.9, 0.1)
    project = tmp_path / "p.splatproj"
    with Session(splats, project, painter=Painter()) as session:
        session.selections.save("left half", chosen)
        layer = session.layers.add("paint", [Edit(picture, camera, mask)], name="logo")
        edited, touched = session.splats, session.layers.painted("logo")
        assert np.array_equal(session.layers.painted(layer.id), touched)
    weights = Region.parse([f"selection=left half@{project}"]).weights(edited)
    there = np.setdiff1d(np.arange(len(splats)), moved_ids(edited, splats))
    assert np.array_equal(weights[there], chosen[there])
    assert np.array_equal(Region.parse([f"layer=logo@{project}"]).weights(edited), touched * edited.drawable)
    assert 0 < touched[: len(splats)].sum() < len(splats) and len(edited) > len(splats)
    both = Region.parse([f"not:selection=left half@{project} or layer=logo@{project}"])
    assert both.weights(splats)[chosen == 0].all()
    moved = replace(splats, means=splats.means + 5)
    for term, asset, line in (
        (f"selection=gone@{project}", splats, "p.splatproj: selection: expected one of left half, got"),
        (f"layer=gone@{project}", splats, "p.splatproj: layer: expected the name of a visible layer that paints, got"),
        (f"selection=left half@{project}", moved, "expected the asset of .*p.splatproj, or one made from it"),
        (f"layer=logo@{project}", splats.take(np.arange(5)), "expected the asset of"),
        ("selection=left", splats, "--where selection: expected NAME@PROJECT.splatproj, got"),
    ):
        with pytest.raises(ValueError, match=line):
            Region.parse([term]).weights(asset)
