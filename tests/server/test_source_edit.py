"""The studio's picture sources: a list without options of the page's, a picture that comes back checked, cancel."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.server.commands import source_edit
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.source_edits import coverage
from tests.support.studio_scenes import Live, live_with_folder, view, wire

TOOL = """
import sys, time
import numpy as np
from PIL import Image
pixels = np.asarray(Image.open(sys.argv[1]).convert("RGB"))
if len(sys.argv) > 3:
    time.sleep(60)
Image.fromarray(pixels[..., [2, 0, 1]]).save(sys.argv[2])
"""


@pytest.fixture
def studio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Live]:
    (tmp_path / "tool.py").write_text(TOOL, encoding="utf-8")
    monkeypatch.setenv("SPLATPAINTER_COMMAND_RUN", f"{sys.executable} {tmp_path / 'tool.py'} {{image}} {{out}}")
    with live_with_folder(tmp_path) as served:
        yield served


def test_sources_are_listed_with_what_they_take_and_miss(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    listed = {one["name"]: one for one in studio.post("source.list")["sources"]}
    assert listed["command"]["missing"] == "" and listed["command"]["accepts"]
    assert not listed["command"]["paid"]
    monkeypatch.delenv("SPLATPAINTER_COMMAND_RUN")
    (command,) = [one for one in studio.post("source.list")["sources"] if one["name"] == "command"]
    assert "needs the option run" in command["missing"]


def test_a_view_comes_back_as_a_checked_picture_and_becomes_a_layer(studio: Live) -> None:
    mask = np.zeros((96, 96), bool)
    mask[30:66, 30:66] = True
    before = studio.studio.session.version
    answer = studio.post(
        "source.edit", source="command", camera=wire(view()), mask=studio.send(png_bytes(mask), "mask.png")
    )
    assert studio.studio.session.version == before and answer["name"] == "command"
    changed = np.asarray(Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{answer['mask']}").content))) > 127
    assert changed.shape == (96, 96) and not changed[~mask].any() and changed[40:56, 40:56].mean() > 0.9
    made = studio.post(
        "edit", kind="picture", views=[{key: answer[key] for key in ("camera", "picture", "mask")}], name="exchanged"
    )
    assert made["layer"]["name"] == "exchanged"
    again = studio.post("picture.check", picture=answer["picture"])  # it carries its camera
    assert again["camera_source"] == "chunk"


NOISY = """
import pathlib
import sys
import numpy as np
from PIL import Image
pixels, calls = np.asarray(Image.open(sys.argv[1]).convert("RGB")), pathlib.Path(__file__).with_name("calls")
noise = np.random.default_rng(0).integers(0, 255, pixels.shape, np.uint8)
Image.fromarray(pixels[..., [2, 0, 1]] if calls.read_text() == "xx" else noise).save(sys.argv[2])
calls.write_text(calls.read_text() + "x")
"""


@pytest.mark.usefixtures("few_views")
def test_refused_pictures_are_shown_with_their_reason(studio: Live, tmp_path: Path) -> None:
    """They may have been paid for: they come as dropped ones would, and are not painted until somebody does."""
    (tmp_path / "tool.py").write_text(NOISY, encoding="utf-8")
    (tmp_path / "calls").write_text("")
    answer = studio.post("source.edit", source="command", camera=wire(view()))
    (warning,) = answer["warnings"]
    assert warning["message"].startswith("Refused; shown as received: command: the picture shows something other")
    picture = np.asarray(Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{answer['picture']}").content)))
    assert picture.shape == (96, 96, 3) and np.ptp(picture) > 200 and answer["share"] > 0.2
    cameras = [one["camera"] for one in studio.post("source.plan", source="command", max_views=2)["views"]]
    made = studio.post("source.cover", source="command", views=cameras, method="lift")
    (refused,) = made["refused"]
    assert made["painted"] == 1 and "view 1: the picture shows" in refused["warnings"][0]["message"]


def test_pages_give_no_options_and_mistakes_are_one_line(studio: Live) -> None:
    fields = {"camera": wire(view()), "source": "command"}
    refused = studio.http.post("/api/do/source.edit", json=fields | {"options": {"run": "rm"}})
    assert refused.status_code in (400, 422) and "options" in refused.text
    unknown = studio.http.post("/api/do/source.edit", json=fields | {"source": "gimini"})
    assert "gimini" in unknown.json()["error"]["message"]
    seeded = studio.http.post("/api/do/source.edit", json=fields | {"seed": 4})
    assert "does not take a seed" in seeded.json()["error"]["message"]


@pytest.fixture
def few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coverage, "CANDIDATE_VIEWS", 8)
    monkeypatch.setattr(source_edit, "USUAL_PX", 64)


@pytest.mark.usefixtures("few_views")
def test_a_plan_asks_nothing_and_its_views_become_layers(studio: Live) -> None:
    version = studio.studio.session.version
    plan = studio.post("source.plan", source="command", max_views=2)
    assert len(plan["views"]) == 2 and not plan["paid"] and 0.2 < plan["covered"] <= 1
    assert plan["views"][0]["camera"]["width"] == 64
    begun = studio.post("source.plan", source="command", max_views=1, camera=wire(view(64)))
    assert begun["views"][0]["camera"]["world_to_camera"] == wire(view(64))["world_to_camera"]
    assert studio.studio.session.version == version
    cameras = [one["camera"] for one in plan["views"]]
    with studio.greeted() as browser:
        answer = browser.do("source.cover", source="command", views=cameras, method="lift")
        assert answer["painted"] == 2 and not answer["cancelled"] and answer["notes"] == []
        assert [one["name"] for one in answer["layers"]] == ["command (1)", "command (2)"]
        assert answer["layers"][0]["parameters"]["source"]["name"] == "command"
        browser.do("receipt")
        assert len(browser.state["layers"]) == 2 and browser.mirror.agrees(studio.studio.session.splats)
    again = studio.post("source.cover", source="command", views=cameras[:1], method="lift", one_layer=True)
    assert [one["name"] for one in again["layers"]] == ["command (1)"]
    wrong = studio.http.post("/api/do/source.cover", json={"source": "command", "views": []})
    assert wrong.status_code in (400, 422)


@pytest.mark.usefixtures("few_views")
def test_a_cover_outlives_its_connection_is_done_once_and_cancelled_keeps_its_layers(
    studio: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tool = f"""
import pathlib, sys, time
import numpy as np
from PIL import Image
calls = pathlib.Path({str(tmp_path / "calls")!r})
calls.open("a").write("x")
while not pathlib.Path({str(tmp_path / "go")!r}).exists() or calls.stat().st_size > 1:
    time.sleep(0.02)
pixels = np.asarray(Image.open(sys.argv[1]).convert("RGB"))
Image.fromarray(pixels[..., [2, 0, 1]]).save(sys.argv[2])
"""
    (tmp_path / "waiting.py").write_text(tool, encoding="utf-8")
    monkeypatch.setenv("SPLATPAINTER_COMMAND_RUN", f"{sys.executable} {tmp_path / 'waiting.py'} {{image}} {{out}}")
    cameras = [one["camera"] for one in studio.post("source.plan", source="command", max_views=2)["views"]]
    calls, page, number = tmp_path / "calls", "ab" * 16, 7
    fields = {"source": "command", "views": cameras, "method": "lift"}

    with studio.browser() as browser:
        browser.hello(page)
        browser.number = number - 1
        browser.send("source.cover", **fields)
        while not calls.exists():
            browser.do("receipt")
    with studio.browser() as browser:  # the page comes back and sends again what was not answered
        browser.number = 100
        browser.hello(page)
        browser.number = number - 1
        assert browser.send("source.cover", **fields) == number
        browser.number = 200
        (tmp_path / "go").touch()
        while len(calls.read_bytes()) < 2:  # the second view is being asked for
            browser.do("receipt")
        assert browser.ask("cancel", of=number)["ok"]
        answer = browser.answer(number)
        assert answer["ok"] and answer["cancelled"] and answer["painted"] == 1
        browser.do("receipt")
        assert [one["name"] for one in browser.state["layers"]] == ["command (1)"]
    assert calls.read_bytes() == b"xx"


def test_layers_of_a_source_say_so_in_the_receipt(studio: Live) -> None:
    answer = studio.post("source.edit", source="command", camera=wire(view()))
    checked = studio.post("picture.check", picture=answer["picture"], threshold=0.01)
    views = [{key: checked[key] for key in ("camera", "picture", "mask")}]
    studio.post("edit", kind="picture", views=views, method="lift")
    source = studio.studio.session.files.receipt().source
    assert source is not None and source["layers"][0]["name"] == "command"
    assert source["layers"][0]["views"][0]["request_sha256"]


def test_a_view_is_sharpened_all_over(studio: Live) -> None:
    listed = {one["name"]: one for one in studio.post("source.list")["sources"]}
    assert 2 in listed["upscale"]["scales"] and listed["command"]["scales"] == [1]
    answer = studio.post("source.edit", source="upscale", camera=wire(view(64)), enlarge=2)
    assert (answer["camera"]["width"], answer["share"]) == (128, 1)
    views = [{key: answer[key] for key in ("camera", "picture", "mask")}]
    made = studio.post("edit", kind="picture", views=views, method="lift")["layer"]
    assert made["gaussians_edited"] > 0 and made["parameters"]["source"]["views"][0]["registration"]["factor"] == 2
