"""What light must never do, whatever it is given: specks, leaks, flicker; and bad lights in one line."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from splatpainter.cameras import orbit_cameras
from splatpainter.cli import main
from splatpainter.color import base_color, luminance, sh_from_color, srgb_to_linear
from splatpainter.lights.facing import facing
from splatpainter.lights.irradiance import LitSurface, sun_light
from splatpainter.lights.lamps import Lamp, Sun
from splatpainter.lights.light_set import Lights
from splatpainter.lights.relight import delight, relight
from splatpainter.lights.skies import SKIES, sky
from splatpainter.lights.sky_maps import SkyMap, read_sky, write_sky
from splatpainter.rendering import render
from splatpainter.splats import Splats
from tests.support.cli_scenes import ball


def walls(count: int = 40, gap: float = 0.0, seed: int = 0) -> Splats:
    """A room of four walls without a roof, 2 wide; each wall two layers, `gap` apart."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, count), np.linspace(-0.5, 0.5, count // 2)))
    means, quats = [], []
    half = math.sqrt(0.5)
    for turn in range(4):
        for side in (0.0, gap) if gap else (0.0,):
            position = np.stack([u, v, np.full_like(u, 1 + side)], 1)
            angle = turn * math.pi / 2
            c, s = math.cos(angle), math.sin(angle)
            means.append(position @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]))
            quats.append(np.tile([1.0, 0, 0, 0] if turn % 2 == 0 else [half, 0, half, 0], (len(u), 1)))
    means = np.concatenate(means)
    means = means + np.random.default_rng(seed).normal(0, 0.002, means.shape)
    scales = np.tile([1.2 / count, 1.2 / count, 0.05 / count], (len(means), 1))
    sh = np.full((len(means), 1, 3), sh_from_color(np.array([0.45])))
    arrays = (means, np.concatenate(quats), scales, np.full(len(means), 0.95), sh)
    means, quats, scales, opacities, sh = (np.asarray(array, np.float32) for array in arrays)
    return Splats(means, quats, scales, opacities, sh)


def light_of(splats: Splats) -> np.ndarray:
    return luminance(srgb_to_linear(base_color(splats.sh)))


def test_no_light_comes_through_a_wall_of_two_layers() -> None:
    """A low sun outside: the inner layer of the wall that faces it stays dark."""
    splats = walls(gap=0.12)
    surface = LitSurface.of(splats)
    received = sun_light(surface, Sun(0, 5), np.eye(3))
    x, y, z = splats.means.T
    middle = (np.abs(x) < 0.7) & (np.abs(y) < 0.3)
    inner, outer = middle & (np.abs(z - 1) < 0.02), middle & (np.abs(z - 1.12) < 0.02)
    assert received[outer].mean() > 0.9 and received[inner].max() < 0.05


def test_a_lamp_in_a_room_stays_in_it() -> None:
    splats = walls(gap=0.12)
    received = LitSurface.of(splats).from_lamp(Lamp("point", (0.0, 0.0, 0.0)))
    x, y, z = splats.means.T
    middle = (np.abs(x) < 0.7) & (np.abs(y) < 0.3)
    inner, outer = middle & (np.abs(z - 1) < 0.02), middle & (np.abs(z - 1.12) < 0.02)
    assert received[inner].min() > 0.3 and received[outer].max() < 0.02


@pytest.mark.parametrize("asset", [ball(1500), walls(gap=0.12)], ids=["ball", "walls"])
@pytest.mark.parametrize("azimuth", [0, 37, 211])
def test_a_sun_that_turns_by_a_degree_changes_little(asset: Splats, azimuth: float) -> None:
    """In what is seen: pictures of the asset, 0..1, a degree apart; also between a sharp sun and none at all."""
    camera = orbit_cameras(asset, 1, size=96, elevation=25, up="+y")[0]
    pictures = []
    for turned in (azimuth, azimuth + 1):
        lit = relight(asset, Lights(suns=(Sun(turned, 30, intensity=1.5),), up="+y")).splats
        pictures.append(np.asarray(render(lit, camera).colors)[0][..., :3])
    change = np.abs(pictures[1] - pictures[0])
    assert change.mean() < 0.005 and np.quantile(change, 0.999) < 0.25


@pytest.mark.parametrize("name", [*SKIES, "sun", "lamp"])
def test_no_pixel_is_a_speck(name: str) -> None:
    """No pixel of a smooth ball differs from the median of the nine around it, inside its edge."""
    splats = ball(4000)
    splats = replace(splats, sh=np.full_like(splats.sh, sh_from_color(np.array(0.5))))
    lights = {
        "sun": Lights(suns=(Sun(50, 20, intensity=2.0),), up="+y"),
        "lamp": Lights(lamps=(Lamp("sphere", (0.5, 1.5, 2.0), intensity=4.0, sizes=(0.2,)),), up="+y"),
    }.get(name) or Lights(sky=sky(name), up="+y")
    camera = orbit_cameras(splats, 1, size=96, elevation=10, up="+y")[0]
    drawn = render(relight(splats, lights).splats, camera)
    view = luminance(np.asarray(drawn.colors)[0][..., :3].clip(0, 1))
    solid = np.asarray(drawn.alphas)[0].reshape(view.shape) > 0.99
    around = np.stack([np.roll(view, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    inside = np.logical_and.reduce([np.roll(solid, (i, j), (0, 1)) for i in (-3, 0, 3) for j in (-3, 0, 3)])
    assert inside.sum() > 500
    assert np.abs(view - np.median(around, 0))[inside].max() < 0.12


def test_a_light_in_the_object_is_one_line() -> None:
    with pytest.raises(ValueError, match="lies inside the object or looks away") as caught:
        relight(ball(1500), Lights(lamps=(Lamp("point", (0.0, 0.0, 0.0)),), up="+y"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "words, reason",
    [
        (["--sun", "0,30,0"], "intensity above 0"),
        (["--sun", "0,30,-2"], "intensity above 0"),
        (["--sun", "0,95"], "-90 to 90"),
        (["--sun", "north"], "AZIMUTH,ELEVATION"),
        (["--sun-at", "yesterday,48,11"], "expected a time"),
        (["--sun-at", "2026-06-21T15:00+02:00,48"], "TIME,LATITUDE,LONGITUDE"),
        (["--point", "0,0,3,#000000"], "not black"),
        (["--sphere", "0,0,3,-1"], "above 0"),
        (["--spot", "0,0,3,0,0,3,30"], "another place"),
        (["--hdri", "noon", "--exposure", "40"], "exposure"),
        (["--hdri", "noon", "--mix", "0"], "--mix above 0"),
        (["--hdri", "missing.hdr"], "no such file"),
        (["--rig", "softest"], "expected a rig"),
        (["--kelvin", "20", "--sun", "0,30"], "expected --kelvin from 1667"),
        (["--match", "missing.png"], "missing.png"),
        (["--hdri", "noon", "--match-asset", "a.ply"], "got both"),
        (["--hdri", "noon", "--save-rig", "rig.fbx"], "rig to write"),
        (["--hdri", "noon", "--balls", "balls.jpg"], ".png"),
        ([], "expected a light"),
    ],
)
def test_bad_words_are_one_line_and_harm_nothing(
    tmp_path: Path, words: list[str], reason: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    io.write("a.ply", ball(200))
    assert main(["light", "a.ply", *words, "--out", "b.ply"]) == 2
    complaint = capsys.readouterr().err.strip()
    assert reason in complaint and "\n" not in complaint
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply"]


@pytest.mark.parametrize("broken", ["black", "nan", "square", "cut"])
def test_broken_environments_are_one_line(tmp_path: Path, broken: str) -> None:
    pytest.importorskip("OpenImageIO")
    shape = (16, 16, 3) if broken == "square" else (16, 32, 3)
    picture = np.full(shape, 0 if broken == "black" else 1, np.float32)
    path = tmp_path / "sky.exr" if broken == "nan" else tmp_path / "sky.hdr"
    if broken == "nan":
        picture[:8] = np.inf
    write_sky(path, SkyMap(picture, "broken"))
    if broken == "cut":
        path.write_bytes(path.read_bytes()[:90])
    with pytest.raises(ValueError, match=path.name) as caught:
        read_sky(path)
    assert "\n" not in str(caught.value)


def test_no_surface_is_a_note() -> None:
    """Round Gaussians, a cloud: lit all the same, and the receipt says what that is worth."""
    rng = np.random.default_rng(0)
    splats = ball(600)
    cloud = replace(splats, means=rng.normal(size=(600, 3)).astype(np.float32), scales=np.full_like(splats.scales, 0.1))
    edited = relight(cloud, Lights(sky=sky("noon"), up="+y"))
    assert edited.receipt is not None and "little surface" in edited.receipt.note
    assert np.isfinite(edited.splats.sh).all()


def test_delight_of_what_nothing_is_known_of_is_nearly_nothing() -> None:
    splats = ball(300)
    white = replace(splats, sh=np.full_like(splats.sh, sh_from_color(np.array(1.0))))
    edited = delight(white, up="+y", shadows=False)
    assert edited.receipt is not None and "uniform grey" in edited.receipt.note
    np.testing.assert_allclose(light_of(edited.splats), light_of(white), rtol=0.03)


def test_a_sheet_of_oriented_patches_keeps_its_side() -> None:
    """Seen as much from below as from above, but all of its axes point up: it was shaded by that side."""
    side = 60
    x, z = (v.ravel() for v in np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side)))
    means = np.stack([x, 0 * x, z], 1).astype(np.float32)
    quats = np.tile(np.array([math.sqrt(0.5), -math.sqrt(0.5), 0, 0], np.float32), (len(x), 1))  # turns z to y
    scales = np.tile(np.array([1.2 / side, 1.2 / side, 0.05 / side], np.float32), (len(x), 1))
    sh = np.zeros((len(x), 1, 3), np.float32)
    sheet = Splats(means, quats, scales, np.full(len(x), 0.95, np.float32), sh)
    sides = facing(sheet)
    assert (sides.normals[:, 1] > 0.99).all() and (sides.front == 1).all()
    turned = quats * np.where(np.random.default_rng(0).random(len(x)) < 0.5, -1, 1)[:, None] ** np.array([0, 1, 1, 1])
    mixed = facing(replace(sheet, quats=turned.astype(np.float32)))
    assert np.median(mixed.front) < 0.8, "of a capture's sheet both sides count"
