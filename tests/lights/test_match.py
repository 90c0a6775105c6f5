"""The light of relit pictures and of other assets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter import io
from splatpainter.cameras import look_at, spherical_cameras
from splatpainter.cli import main
from splatpainter.color import base_color, sh_from_color, srgb_to_linear
from splatpainter.color import linear_to_srgb as to_display
from splatpainter.image_files import write_png
from splatpainter.lights.light_set import Lights, axes_of, turned_sky
from splatpainter.lights.match import ball_sheet, match_light, sky_of
from splatpainter.lights.prepared import captured_light, lit_surface
from splatpainter.lights.relight import relight
from splatpainter.lights.skies import sky
from splatpainter.lights.sky_maps import read_sky
from splatpainter.operations.region import Region
from splatpainter.painter import Edit
from splatpainter.rendering import render
from splatpainter.splats import SH_C0, Splats
from tests.support.cli_scenes import ball


def textured_ball(light: np.ndarray, count: int = 4000) -> Splats:
    """Albedos in stripes, lit by SH [9, 3]."""
    splats = ball(count)
    albedo = np.where(np.sin(9 * splats.means[:, :1]) > 0, [0.35, 0.2, 0.12], [0.1, 0.2, 0.35])
    received = lit_surface(splats, shadows=False).from_sky(light)
    sh = splats.sh.copy()
    sh[:, 0] = sh_from_color(to_display((albedo * received).clip(0, 1)))
    return replace(splats, sh=sh.astype(np.float32))


def pictures(splats: Splats, count: int) -> list[Edit]:
    cameras = spherical_cameras(np.zeros(3), 3.0, 5, size=96)[1 : 1 + count]
    return [Edit(np.asarray(render(splats, camera).colors)[0][..., :3].clip(0, 1), camera) for camera in cameras]


def sh_light(name: str) -> np.ndarray:
    return turned_sky(sky(name), axes_of("+y"))


def linear(splats: Splats) -> np.ndarray:
    return srgb_to_linear(base_color(splats.sh))


@pytest.mark.parametrize("count", [1, 3])
def test_the_new_light_is_found_in_pictures(count: int) -> None:
    before, after = sh_light("overcast"), 0.8 * sh_light("sunset")
    asset, truth = textured_ball(before), textured_ball(after)
    matched = match_light(asset, pictures(truth, count), shadows=False)
    error = np.abs(linear(matched.asset.splats) - linear(truth)).mean()
    assert error < (0.45 if count == 1 else 0.2) * np.abs(linear(asset) - linear(truth)).mean()
    level = matched.after[0].mean() * SH_C0
    assert level == pytest.approx(0.8, rel=0.25)
    assert matched.chosen == "light" and matched.asset.receipt is not None
    assert f"matched to {count} picture{'s' * (count > 1)} by" in matched.asset.receipt.note


def test_a_match_is_mixed_as_light_and_kept_to_its_region() -> None:
    asset, truth = textured_ball(sh_light("overcast")), textured_ball(sh_light("sunset"))
    seen = pictures(truth, 1)
    result = match_light(asset, seen, shadows=False).asset.splats
    half = match_light(asset, seen, shadows=False, mix=0.5, region=Region.parse(["y=..0"])).asset
    outside = asset.means[:, 1] > 1e-6
    np.testing.assert_array_equal(half.splats.sh[outside], asset.sh[outside])
    middle = (linear(asset) + linear(result)) / 2
    np.testing.assert_allclose(linear(half.splats)[~outside], middle[~outside], atol=2e-3)
    assert half.receipt is not None and "mix 0.5; where y=..0" in half.receipt.note
    result_again = match_light(asset, seen, shadows=False, region=Region.parse(["y=..9"])).asset.splats
    np.testing.assert_array_equal(result_again.sh, result.sh)


def test_what_one_picture_does_not_show_is_not_darkened() -> None:
    """A lamp from the front is all that the picture tells of; behind, the asset keeps its look, nearly."""
    before = sh_light("overcast")
    front = pictures(textured_ball(before), 1)[0].camera.position
    front = front / np.linalg.norm(front)
    after = 0.3 * before
    after[1:4] += np.array([-front[1], front[2], -front[0]])[:, None] * 2.0
    asset, truth = textured_ball(before), textured_ball(after)
    lit = match_light(asset, pictures(truth, 1), shadows=False).asset.splats
    cosine = asset.means @ front
    ahead, behind = cosine > 0.5, cosine < -0.5
    errors = [np.abs(linear(one) - linear(truth))[ahead].mean() for one in (lit, asset)]
    assert errors[0] < 0.3 * errors[1]
    assert linear(lit)[behind].mean() > 0.33 * linear(asset)[behind].mean(), "0.14 by the light alone"


def test_a_given_light_helps_one_picture() -> None:
    before, after = sh_light("overcast"), sh_light("sunset")
    asset, truth = textured_ball(before), textured_ball(after)
    alone, helped = (match_light(asset, pictures(truth, 1), shadows=False, target=t) for t in (None, after))
    errors = [np.abs(linear(one.asset.splats) - linear(truth)).mean() for one in (alone, helped)]
    assert errors[1] < 0.8 * errors[0]


def test_the_light_of_another_asset_is_taken_over() -> None:
    asset, other = textured_ball(sh_light("overcast")), textured_ball(sh_light("sunset"))
    captured = captured_light(other, shadows=False).coefficients
    lit = relight(asset, Lights(sky=sky_of(captured, "+y", "other"), up="+y"), shadows=False).splats
    before, after = (np.abs(linear(one) - linear(other)).mean() for one in (asset, lit))
    assert after < 0.8 * before


@pytest.mark.parametrize("up", ["+y", "-y", "+z"])
def test_a_matched_light_is_an_environment_again(up: str) -> None:
    light = turned_sky(sky("overcast"), axes_of(up))  # type: ignore[arg-type]
    again = turned_sky(sky_of(light, up, "again"), axes_of(up))  # type: ignore[arg-type]
    np.testing.assert_allclose(again, light / (light[0].mean() * SH_C0), atol=0.02)


def test_too_many_pictures_and_none_of_the_asset() -> None:
    asset = textured_ball(sh_light("overcast"), 800)
    views = pictures(asset, 1)
    for wrong in ([], views * 5):
        with pytest.raises(ValueError, match="1 to 4 pictures"):
            match_light(asset, wrong)
    away = replace(views[0], camera=look_at((0, 0, 3), (0, 0, 9), width=96, height=96))
    with pytest.raises(ValueError, match="show at least"):
        match_light(asset, [away])


def test_the_command_matches_and_writes_what_it_saw(tmp_path: Path) -> None:
    asset, truth = textured_ball(sh_light("overcast"), 2000), textured_ball(sh_light("sunset"), 2000)
    io.write(tmp_path / "a.ply", asset)
    (edit,) = pictures(truth, 1)
    Image.fromarray((edit.image * 255).round().astype(np.uint8)).save(tmp_path / "view.png")
    (tmp_path / "view.json").write_text(edit.camera.to_json())
    words = ["light", tmp_path / "a.ply", "--match", tmp_path / "view.png", "--no-painter", "--up", "+y"]
    words += ["--balls", tmp_path / "balls.png", "--save-light", tmp_path / "new.hdr", "--out", tmp_path / "b.ply"]
    assert main([str(word) for word in words]) == 0
    assert read_sky(tmp_path / "new.hdr").radiance.shape == (64, 128, 3)
    with Image.open(tmp_path / "balls.png") as picture:
        assert picture.width > 4 * 192
    words[2:4] = ["--hdri", tmp_path / "new.hdr"]
    assert main([str(word) for word in words if word != "--no-painter"]) == 2, "outputs exist"


def test_the_command_says_that_an_environment_is_not_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset, truth = textured_ball(sh_light("overcast"), 2000), textured_ball(sh_light("sunset"), 2000)
    io.write(tmp_path / "a.ply", asset)
    (edit,) = pictures(truth, 1)
    write_png(tmp_path / "view.png", edit.image, edit.camera)
    words = ["light", tmp_path / "a.ply", "--match", tmp_path / "view.png", "--no-painter", "--up", "+y"]
    for turn, refused in ((180, True), (0, False)):
        more = ["--hdri", "sunset", "--rotate", turn, "--out", tmp_path / f"{turn}.ply"]
        assert main([str(word) for word in (*words, *more)]) == 0
        assert ("--hdri sunset: not used: " in capsys.readouterr().err) is refused


def test_balls_show_where_light_comes_from(tmp_path: Path) -> None:
    ball_sheet(tmp_path / "balls.png", {"new": sh_light("overcast")}, "+y")
    picture = np.asarray(Image.open(tmp_path / "balls.png").convert("L")).astype(float)
    column = picture[:, 6 + 96]
    inside = column[-192 - 6 : -6]
    assert inside[30] > inside[160] + 30, "an overcast sky is above"
