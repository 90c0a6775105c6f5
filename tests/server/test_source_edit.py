"""The studio's picture sources: a list without options of the page's, a picture that comes back checked, cancel."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.server.image_registration import png_bytes
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


def test_pages_give_no_options_and_mistakes_are_one_line(studio: Live) -> None:
    fields = {"camera": wire(view()), "source": "command"}
    refused = studio.http.post("/api/do/source.edit", json=fields | {"options": {"run": "rm"}})
    assert refused.status_code in (400, 422) and "options" in refused.text
    unknown = studio.http.post("/api/do/source.edit", json=fields | {"source": "gimini"})
    assert "gimini" in unknown.json()["error"]["message"]
    seeded = studio.http.post("/api/do/source.edit", json=fields | {"seed": 4})
    assert "does not take a seed" in seeded.json()["error"]["message"]
