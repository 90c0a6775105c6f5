"""Rigs in and out, and the sun by date, time and place."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from splatpainter.io.formats import gltf
from splatpainter.lights import solar
from splatpainter.lights.gltf_lights import EXTENSION
from splatpainter.lights.irradiance import LitSurface, sun_light
from splatpainter.lights.lamps import Lamp, Sun, azimuth_elevation
from splatpainter.lights.light_set import Lights, axes_of
from splatpainter.lights.relight import relight
from splatpainter.lights.rig_files import read_rig, write_rig
from splatpainter.lights.scene_lights import scene_axes
from splatpainter.lights.skies import SKIES, direction, sky
from splatpainter.lights.sky_maps import SkyMap, read_sky, write_sky
from splatpainter.lights.solar import solar_coordinates, sun_at, sun_position
from splatpainter.lights.studio_rigs import RIGS
from splatpainter.lights.usd_lights import read_usda
from tests.support.cli_scenes import ball

pytest_plugins = ["tests.support.node_oracle"]

LAMPS = (
    Lamp("point", (1.0, 2.0, 3.0), (1.0, 0.5, 0.25), 2.0),
    Lamp("spot", (0.0, -2.0, 0.0), (1.0, 1.0, 1.0), 3.0, (0.5, 0.0, 1.0), (40.0,)),
    Lamp("rect", (2.0, 0.0, -1.0), (0.5, 1.0, 1.0), 1.5, (0.0, 0.0, 0.0), (0.5, 0.25)),
    Lamp("disk", (0.0, 2.0, 0.0), (1.0, 1.0, 1.0), 0.5, (0.0, 0.0, 0.0), (0.4,)),
    Lamp("sphere", (-2.0, 0.0, 0.0), (1.0, 0.9, 0.8), 4.0, None, (0.3,)),
)
RIG = Lights(suns=(Sun(30, 40, 2.0, (1.0, 0.8, 0.6), 1.5), Sun(-100, -10)), lamps=LAMPS, up="-y")


def same_light(one: Lights, other: Lights) -> None:
    """Both light a ball alike."""
    surface = LitSurface.of(ball(400), shadows=False)
    assert len(one.suns) == len(other.suns) and [a.kind for a in one.lamps] == [b.kind for b in other.lamps]
    for pair in zip(one.suns, other.suns, strict=True):
        received = [sun_light(surface, sun, axes_of("-y"))[:, None] * sun.color * sun.intensity for sun in pair]
        np.testing.assert_allclose(received[0], received[1], atol=2e-5)
    for left, right in zip(one.lamps, other.lamps, strict=True):
        received = [surface.from_lamp(lamp)[:, None] * lamp.color * lamp.intensity for lamp in (left, right)]
        # Of a rectangle the roll about its axis is lost.
        error = np.abs(received[0] - received[1]).max()
        assert error < 2e-5 * received[0].max() + (0.01 if left.kind == "rect" else 2e-5)


@pytest.mark.parametrize("suffix", [".json", ".usda"])
def test_a_rig_comes_back(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"rig{suffix}"
    assert write_rig(path, RIG) == []
    back, notes = read_rig(path, "-y")
    assert notes == []
    same_light(RIG, back)


def test_gltf_keeps_what_it_can_hold_and_says_what_not(tmp_path: Path) -> None:
    path = tmp_path / "rig.glb"
    losses = write_rig(path, replace(RIG, fill=0.2))
    assert [loss.split(":")[0] for loss in losses] == [
        "glTF holds no environment and no fill",
        "Rect3",
        "Disk4",
        "Sphere5",
    ]
    expected = replace(RIG, lamps=LAMPS[:2], suns=tuple(replace(sun, size=0.53) for sun in RIG.suns))
    back, _ = read_rig(path, "-y")
    same_light(expected, replace(back, lamps=back.lamps[:2]))


@pytest.mark.parametrize("up", ["-y", "+y", "+z"])
def test_gltf_lights_look_along_minus_z(tmp_path: Path, up: str) -> None:
    """Khronos's own words: directional light travels along the node's local -z; lux and candela."""
    lights = Lights(suns=(Sun(0, 90, intensity=2.0),), lamps=(Lamp("point", (1.0, 2.0, 3.0)),), up=up)  # type: ignore[arg-type]
    write_rig(tmp_path / "rig.glb", lights)
    doc = gltf.parse((tmp_path / "rig.glb").read_bytes(), Path("rig.glb")).doc
    sun, point = doc["extensions"][EXTENSION]["lights"]
    matrix = np.array(doc["nodes"][0]["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(-matrix[:3, 2], [0, -1, 0], atol=1e-9, err_msg="the zenith's light falls along -y")
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
    assert sun["intensity"] == pytest.approx(2 * math.pi) and point["intensity"] == pytest.approx(math.pi)
    where = np.array(doc["nodes"][1]["matrix"]).reshape(4, 4).T[:3, 3]
    expected = {"-y": (1, -2, -3), "+y": (1, 2, 3), "+z": scene_axes("+z") @ [1, 2, 3]}[up]
    np.testing.assert_allclose(where, expected)


def test_khronos_validator_has_no_objection(tmp_path: Path, gltf_validator: Callable[[Path], list[dict]]) -> None:
    write_rig(tmp_path / "rig.glb", RIG)
    assert [message for message in gltf_validator(tmp_path / "rig.glb") if message["severity"] < 2] == []


def test_units_of_usd(tmp_path: Path) -> None:
    """By hand from UsdLux's formulas: a white surface of which the irradiance is pi is as bright as white light."""
    text = """#usda 1.0
    (
        upAxis = "Z"
    )
    # a comment with "quotes" and {
    def Xform "World" ( kind = "group" )
    {
        double3 xformOp:translate = (0, 0, 1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        def DistantLight "Sun" ( prepend apiSchemas = ["ShadowAPI"] )
        {
            float inputs:angle = 60
            float inputs:intensity = 2
            float inputs:exposure = 1
            float3 xformOp:rotateXYZ = (90, 0, 90)
            uniform token[] xformOpOrder = ["xformOp:rotateXYZ"]
        }
        def SphereLight "Ball"
        {
            float inputs:radius = 0.5
            float inputs:intensity = 8
            color3f inputs:color = (1, 0.5, 0)
            double3 xformOp:translate = (0, 0, 2)
            float3 xformOp:scale = (2, 2, 2)
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
        }
        def CylinderLight "Tube" { }
        def DomeLight "Sky" { float inputs:intensity = 0.25 }
    }
    """
    path = tmp_path / "rig.usda"
    path.write_text(text)
    (sun, ball_light), dome, notes = read_usda(path)
    assert sun.intensity == pytest.approx(2 * 2 * math.sin(math.radians(30)) ** 2)
    # -z turned by 90 about x is y, by 90 about z then -x; z up becomes y up.
    np.testing.assert_allclose(sun.direction, [-1, 0, 0], atol=1e-9)
    assert ball_light.intensity == pytest.approx(8 * 1.0**2) and ball_light.sizes == (1.0,)
    np.testing.assert_allclose(ball_light.position, [0, 3, 0], atol=1e-9)
    assert dome is not None and dome.intensity == 0.25 and notes == ["CylinderLight Tube passed over"]


def test_an_inverted_operation_undoes_itself(tmp_path: Path) -> None:
    """A pivot, as hosts write it: translate there, turn, and back."""
    text = """#usda 1.0
    def SphereLight "Ball" {
        double3 xformOp:translate:pivot = (1, 2, 3)
        float xformOp:rotateY = 90
        uniform token[] xformOpOrder = ["xformOp:translate:pivot", "xformOp:rotateY", "!invert!xformOp:translate:pivot"]
    }
    """
    (tmp_path / "rig.usda").write_text(text)
    (ball_light,), _, _ = read_usda(tmp_path / "rig.usda")
    np.testing.assert_allclose(ball_light.position, [1 - 3, 0, 3 + 1], atol=1e-9)


def test_usd_reads_what_we_write(tmp_path: Path) -> None:
    """Pixar's own library, where it is installed."""
    # Through importorskip, as its modules say nothing of their classes to a type checker.
    Usd, UsdGeom, UsdLux = (pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom", "UsdLux"))
    write_rig(tmp_path / "rig.usda", replace(RIG, sky=sky("noon"), rotate=30.0))
    stage = Usd.Stage.Open(str(tmp_path / "rig.usda"))
    prims = [prim for prim in stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]
    assert len(prims) == 8
    sun = UsdGeom.XformCache().GetLocalToWorldTransform(prims[0])
    towards = np.array([sun[2][k] for k in range(3)])
    expected = scene_axes("-y") @ axes_of("-y").T @ direction(30, 40)
    np.testing.assert_allclose(towards, expected, atol=1e-6)


def test_an_environment_goes_along(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.usda", Lights(sky=sky("sunset"), rotate=40.0, sky_intensity=2.0, up="-y"))
    assert "rotateY = 220" in (tmp_path / "rig.usda").read_text(), "azimuth 0 lies at -z of the scene of a capture"
    back, _ = read_rig(tmp_path / "rig.usda", "-y")
    assert back.sky is not None and back.rotate == pytest.approx(40) and back.sky_intensity == 2
    write_rig(tmp_path / "rig.json", back)
    again, _ = read_rig(tmp_path / "rig.json")
    assert again.sky is not None
    np.testing.assert_array_equal(again.sky.radiance, back.sky.radiance)


@pytest.mark.parametrize("suffix", [".hdr", ".exr"])
def test_environments_are_written_as_others_read_them(tmp_path: Path, suffix: str) -> None:
    oiio = pytest.importorskip("OpenImageIO")
    picture = np.random.default_rng(0).lognormal(0, 3, (16, 32, 3)).astype(np.float32)
    picture[3, 4] = 0
    write_sky(tmp_path / f"sky{suffix}", SkyMap(picture, "made"))
    read = oiio.ImageBuf(str(tmp_path / f"sky{suffix}")).get_pixels("float")
    error = np.abs(read - picture) / picture.max(2, keepdims=True).clip(1e-9)
    assert error.max() < (1 / 128 if suffix == ".hdr" else 1e-6)
    assert read_sky(tmp_path / f"sky{suffix}", full_range=True).radiance.shape == (16, 32, 3)


@pytest.mark.parametrize("name", RIGS)
def test_studio_rigs_light_a_ball(name: str) -> None:
    lights, notes = read_rig(name, "+y")
    lights.check()
    lit = relight(ball(500), lights).splats
    assert notes == [] and np.isfinite(lit.sh).all()


@pytest.mark.parametrize("name", SKIES)
def test_skies_are_light(name: str) -> None:
    picture = sky(name).radiance
    assert np.isfinite(picture).all() and picture.min() > 0


DAMAGED = {
    "cut.usda": ('#usda 1.0\ndef SphereLight "A" {', "cut off"),
    "binary.usd": ("PXR-USDC\0\0", "binary USD"),
    "none.usda": ("#usda 1.0\n", "found none"),
    "other.usda": ("hello", "#usda"),
    "deep.usda": ("#usda 1.0\n" + 'def X "a" {' * 300, "deep"),
    "flat.usda": (
        '#usda 1.0\ndef SphereLight "A" { float3 xformOp:scale = (0,0,0)\n'
        'uniform token[] xformOpOrder = ["xformOp:scale"] }',
        "inverse",
    ),
    "text.usda": ('#usda 1.0\ndef SphereLight "A" { float inputs:intensity = much }', "number"),
    "rig.json": ('{"version": 2}', "version 1"),
    "key.json": ('{"lamp": []}', "unknown key"),
    "list.json": ("[1]", "object"),
    "kind.json": ('{"lamps": [{"kind": "tube", "position": [0, 0, 0]}]}', "point, spot"),
    "dark.json": ('{"suns": [{"azimuth": 0, "elevation": 10, "intensity": -1}]}', "intensity above 0"),
    "sky.json": ('{"sky": "missing.hdr"}', "no such file"),
    "link.gltf": (
        json.dumps({"asset": {"version": "2.0"}, "nodes": [{"extensions": {EXTENSION: {"light": 3}}}]}),
        "number of a light",
    ),
    "empty.gltf": ('{"asset": {"version": "2.0"}}', "found none"),
    "rig.txt": ("", "expected a rig"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_rig_is_one_line(tmp_path: Path, name: str) -> None:
    text, reason = DAMAGED[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=reason) as caught:
        read_rig(tmp_path / name)[0].check()
    assert "\n" not in str(caught.value) and (name == "sky.json" or name in str(caught.value))


def test_the_sun_of_meeus(monkeypatch: pytest.MonkeyPatch) -> None:
    """Example 25.a: 1992 October 13, 0h dynamical time; example 12.a: sidereal time of 1987 April 10, 0h."""
    monkeypatch.setattr(solar, "DELTA_T", 0.0)
    ascension, declination, _ = solar_coordinates(2448908.5)
    assert ascension == pytest.approx(198.38083, abs=2e-5) and declination == pytest.approx(-7.78507, abs=2e-5)
    assert solar_coordinates(2446895.5)[2] == pytest.approx(197.692230, abs=2e-4)


def test_the_sun_of_nrel() -> None:
    """The example of NREL's Solar Position Algorithm (Reda and Andreas 2008): azimuth 194.34024, zenith 50.11162."""
    when = datetime.fromisoformat("2003-10-17T12:30:30-07:00")
    azimuth, elevation = sun_position(when, 39.742476, -105.1786)
    assert azimuth == pytest.approx(194.34024, abs=0.01) and elevation == pytest.approx(90 - 50.11162, abs=0.01)


@pytest.mark.parametrize("north", [0.0, 90.0, -35.0])
def test_north_is_where_it_is_said_to_be(north: float) -> None:
    """At noon of the northern half the sun stands in the south; east is clockwise of north from above."""
    noon = sun_at(datetime.fromisoformat("2026-06-21T12:00+00:00"), 50, 0, north)
    assert (noon.azimuth - north - 180 + 180) % 360 - 180 == pytest.approx(0, abs=3)
    morning = sun_at(datetime.fromisoformat("2026-03-20T07:00+00:00"), 0, 0, north)
    assert (morning.azimuth - (north - 90) + 180) % 360 - 180 == pytest.approx(0, abs=3)
    assert azimuth_elevation(direction(noon.azimuth, noon.elevation)) == pytest.approx(
        ((noon.azimuth + 180) % 360 - 180, noon.elevation), abs=1e-6
    )


@pytest.mark.parametrize(
    "when, latitude, longitude, reason",
    [
        ("2026-06-21T15:00", 48.1, 11.6, "zone"),
        ("2026-06-21T23:30+02:00", 48.1, 11.6, "below the horizon"),
        ("1526-06-21T15:00+02:00", 48.1, 11.6, "year"),
        ("2026-06-21T15:00+02:00", 148.1, 11.6, "latitude"),
    ],
)
def test_no_sun_then_or_there(when: str, latitude: float, longitude: float, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        sun_at(datetime.fromisoformat(when), latitude, longitude)
