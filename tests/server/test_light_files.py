"""Skies, rigs and pictures that the light panel is given as files: read once, held by the project; bad ones named."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import splatpainter as sp
from splatpainter.color import to_display
from splatpainter.lights.match import match_light
from splatpainter.lights.rig_files import write_rig
from splatpainter.lights.skies import SKIES, sky
from splatpainter.lights.sky_maps import write_sky
from splatpainter.lights.studio_rigs import RIGS
from splatpainter.painter import Asset, Edit
from splatpainter.rendering import render
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.session import Session
from tests.support import studio_scenes
from tests.support.studio_scenes import Live, ball, view


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with studio_scenes.live(studio_scenes.make_studio(tmp_path)) as live:
        yield live


def hdr(tmp_path: Path, name: str = "dawn") -> bytes:
    write_sky(tmp_path / f"{name}.hdr", sky(name))
    return (tmp_path / f"{name}.hdr").read_bytes()


def refusal(studio: Live, command: str, /, **fields: object) -> str:
    answer = studio.http.post(f"/api/do/{command}", json=fields)
    assert answer.status_code == 400, answer.text
    return answer.json()["error"]["message"]


def test_a_sky_from_a_file_goes_into_the_project(studio: Live, tmp_path: Path) -> None:
    answer = studio.post("light.sky", file=studio.send(hdr(tmp_path), "my dawn.hdr"))
    answer_sky = answer["sky"]
    assert answer_sky["name"] == "my dawn.hdr" and answer["note"] == ""
    picture = Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{answer_sky['picture']}").content))
    assert picture.size == (128, 64)
    held = {"hdri": answer_sky["held"]}
    made = studio.post("layer.add", operation={"kind": "light", "hdri": answer_sky["name"]}, held=held)["layer"]
    assert made["parameters"] == {"hdri": "my dawn.hdr", "held": held} and made["problem"] == ""
    direct = sp.Relight(hdri=str(tmp_path / "dawn.hdr")).apply(Asset(ball())).splats
    assert np.abs(studio.studio.session.splats.sh - direct.sh).max() < 5e-3
    listed = studio.post("light.skies")
    assert [one["name"] for one in listed["skies"]] == [*SKIES, "my dawn.hdr"] and listed["rigs"] == [*RIGS]
    # Another sky and back is two steps; the project then still has the first, whatever became of the upload.
    layer = made["id"]
    studio.post("layer.set", layer=layer, parameters={"hdri": "noon", "held": {}})
    assert studio.studio.session.layers[0].operation.record() == {"kind": "light", "hdri": "noon"}
    studio.post("undo")
    sh = studio.studio.session.splats.sh.copy()
    path = studio.studio.session.path
    assert path is not None
    copy = tmp_path / "copy.splatproj"
    studio.studio.session.files.save_as(copy)
    with Session(copy) as again:
        assert (again.splats.sh == sh).all()


def test_bad_skies_are_one_line(studio: Live, tmp_path: Path) -> None:
    data = hdr(tmp_path)
    flat = io.BytesIO()
    Image.fromarray(np.full((40, 80, 3), 200, np.uint8)).save(flat, "PNG")
    ends = studio.post("light.sky", file=studio.send(flat.getvalue(), "day.png"))
    assert ends["note"] == "day.png is a display picture: what was brighter than white is missing from its light"
    square = io.BytesIO()
    Image.fromarray(np.full((40, 40, 3), 200, np.uint8)).save(square, "PNG")
    line = refusal(studio, "light.sky", file=studio.send(square.getvalue(), "square.png"))
    assert line.startswith("square.png: expected") and "\n" not in line
    broken = refusal(studio, "light.sky", file=studio.send(data[:900], "broken.hdr"))
    assert broken.startswith("broken.hdr: ") and str(tmp_path) not in broken
    wrong = {"kind": "light", "hdri": "x.hdr"}
    assert "without files" in refusal(studio, "layer.add", operation=wrong)
    assert "no longer available" in refusal(studio, "layer.add", operation=wrong, held={"hdri": "0" * 64})
    assert "held.hdri: String should match" in refusal(studio, "layer.add", operation=wrong, held={"hdri": "/etc/x"})
    # A picture that holds no sky is no layer.
    other = studio.send(flat.getvalue(), "day.png")
    assert "expected the picture of one" in refusal(studio, "layer.add", operation=wrong, held={"hdri": other})
    assert not studio.studio.session.layers


def test_rigs_become_lights_one_by_one(studio: Live, tmp_path: Path) -> None:
    named = studio.post("light.rig", name="three-point")["operation"]
    assert len(named["sun"]) == 3 and named["fill"] == 0.12 and not named["rig"]
    assert "expected a rig of three-point" in refusal(studio, "light.rig", name="four-point")
    lights = sp.Lights(
        suns=(sp.Sun(40, 35, 25.0),), lamps=(sp.Lamp("spot", (0.0, -3.0, 0.0), target=(0, 0, 0), sizes=(40.0,)),)
    )
    for suffix in (".json", ".usda", ".glb"):
        write_rig(tmp_path / f"rig{suffix}", lights)
        sent = studio.send((tmp_path / f"rig{suffix}").read_bytes(), f"rig{suffix}")
        operation = studio.post("light.rig", file=sent)["operation"]
        assert (len(operation["sun"]), len(operation["spot"])) == (1, 1)
        numbers = [float(word) for word in operation["spot"][0].split(",")[:3]]
        assert np.allclose(numbers, (0, -3, 0), atol=1e-5)
        studio.post("layer.add", operation={name: value for name, value in operation.items() if value is not None})
    hdr(tmp_path)
    (tmp_path / "own.json").write_text(
        f'{{"sky": "{tmp_path / "dawn.hdr"}", "suns": [{{"azimuth": 1, "elevation": 2}}]}}'
    )
    outside = studio.post("light.rig", file=studio.send((tmp_path / "own.json").read_bytes(), "own.json"))
    assert outside["notes"] == ["its environment is another file and left out: dawn.hdr"]
    assert outside["operation"]["hdri"] == "", "no file of this machine is opened for a stranger's rig"
    assert "expected" in refusal(studio, "light.rig", file=studio.send(b'{"suns": 3}', "bad.json"))


def test_the_sun_at_an_hour(studio: Live) -> None:
    noon = studio.post("light.sun_at", time="2026-06-21T12:00+00:00", latitude=51.5, longitude=0.0, north=180)
    assert noon["elevation"] == pytest.approx(90 - 51.5 + 23.44, abs=0.1)
    assert abs(noon["azimuth"]) < 2, "it stands in the south, where the front is"
    where = {"latitude": 51.5, "longitude": 0.0}
    assert "below the horizon" in refusal(studio, "light.sun_at", time="2026-06-21T00:00+00:00", **where)
    assert "expected a time" in refusal(studio, "light.sun_at", time="noon", **where)


def test_the_light_of_a_picture_is_found_and_is_a_layer(studio: Live) -> None:
    before = studio.studio.session.splats
    truth = sp.Relight(hdri="sunset", rotate=120.0, exposure=0.4).apply(Asset(before)).splats
    camera = view(128)
    look = to_display(render(truth, camera).colors[0], "srgb")
    sent = studio.send(png_bytes(look, camera), "relit.png")
    answer_sky = studio.post("light.match", pictures=[sent], camera=view(64, 90).record() | {"background": [0, 0, 0]})
    operation = {
        "kind": "light",
        "hdri": answer_sky["sky"]["name"],
        "exposure": answer_sky["exposure"],
        "source_light": "before.png",
        "up": studio.studio.session.scene.up,
    }
    held = {"hdri": answer_sky["sky"]["held"], "source_light": answer_sky["source"]}
    studio.post("layer.add", operation=operation, held=held)

    def error(splats: sp.Splats) -> float:
        return float(np.abs(render(splats, camera).colors[0] - look).mean())

    assert error(studio.studio.session.splats) < 0.4 * error(before)
    direct = match_light(before, [Edit(look, camera, None, "relit")]).asset.splats
    # Where the picture shows the asset; what it does not show keeps its look there, and the layer lights all of it.
    apart = np.abs(render(studio.studio.session.splats, camera).colors[0] - render(direct, camera).colors[0])
    assert apart.mean() < 0.01, "the layer is the light that was found"
