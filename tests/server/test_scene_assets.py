"""Several assets through the studio's commands: state, Gaussians of clients, exports, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from splatpainter.io import read, write
from splatpainter.receipts import Receipt
from splatpainter.scene.merge import check_merge
from splatpainter.session import Session
from tests.support.io_assets import random_splats
from tests.support.lift_scenes import sheet
from tests.support.studio_scenes import Live, ball, live, make_studio


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with live(make_studio(tmp_path)) as served:
        yield served


def write_sheet(folder: Path, degree: int = 2) -> Path:
    write(folder / "sheet.ply", sheet(8, degree=degree))
    return folder / "sheet.ply"


def sheet_bytes(folder: Path, degree: int = 2) -> bytes:
    return write_sheet(folder, degree).read_bytes()


def refused(studio: Live, name: str, **fields: object) -> str:
    answer: httpx.Response = studio.http.post(f"/api/do/{name}", json=fields)
    assert answer.status_code == 400, answer.text
    message = answer.json()["error"]["message"]
    assert "\n" not in message and str(studio.studio.blobs.folder) not in message
    return message


def test_clients_see_assets_come_move_and_go(studio: Live, tmp_path: Path) -> None:
    blob = studio.send(sheet_bytes(tmp_path), "sheet.ply")
    with studio.greeted() as browser:
        count = len(studio.studio.session.splats)
        added = browser.do("scene.add", blob=blob)["asset"]
        first, second = studio.http.get("/api/state").json()["assets"]
        assert (first["id"], second["id"], second["name"], second["gaussians"]) == ("", added, "sheet.ply", 64)
        assert second["move"][0] > 0 and second["center"][0] > first["center"][0]
        state = studio.http.get("/api/state").json()
        assert state["asset"]["gaussians_original"] == count + 64 == state["asset"]["gaussians"]
        browser.do("scene.set", asset=added, turn=[10, 20, 30], scale=2.0, gesture="g")
        browser.do("scene.set", asset=added, move=[0, 3, 0], gesture="g")
        browser.do("scene.set", asset=added, name="Rug", visible=False)
        browser.do("scene.set", asset=added, visible=True)
        now = studio.http.get("/api/state").json()["assets"][1]
        np.testing.assert_allclose([*now["turn"], now["scale"], *now["move"]], [10, 20, 30, 2, 0, 3, 0], atol=1e-4)
        assert len(studio.studio.session.history) == 5 and now["name"] == "Rug"
        browser.do("scene.remove", asset=added)
        browser.do("undo")
        mirror, splats = browser.mirror, studio.studio.session.splats
        assert len(splats) == count + 64
        np.testing.assert_array_equal(mirror.columns["means"], splats.means)
        assert mirror.columns["sh"].shape == splats.sh.shape


def test_a_light_is_for_one_asset_or_for_each(studio: Live, tmp_path: Path) -> None:
    added = studio.post("scene.add", blob=studio.send(sheet_bytes(tmp_path), "sheet.ply"))["asset"]
    for asset, reached in ((added, [added]), ("", [""]), (None, ["", added])):
        studio.post("layer.add", operation={"kind": "light", "hdri": "dawn"}, asset=asset)
        assert [layer["asset"] for layer in studio.http.get("/api/state").json()["layers"]] == reached
        studio.post("undo")


def test_one_light_over_all_assets_is_dragged_and_set_as_one(studio: Live, tmp_path: Path) -> None:
    studio.post("scene.add", blob=studio.send(sheet_bytes(tmp_path), "sheet.ply"))
    studio.post("layer.add", operation={"kind": "light", "hdri": "dawn"}, name="Light")
    session = studio.studio.session
    layers, steps = [layer.id for layer in session.layers], len(session.history)
    with studio.greeted() as browser:
        dragged = [{"layer": layer, "parameters": {"exposure": 1.0}} for layer in layers]
        assert browser.do("layer.preview", layers=dragged)["gaussians"] == len(session.splats)
        colors = browser.mirror.columns["sh"][:, 0].copy()
        for layer in layers:
            browser.do("layer.set", layer=layer, parameters={"exposure": 1.0}, gesture="one")
        assert browser.mirror.agrees(session.splats)
        assert np.abs(colors - session.splats.sh[:, 0]).max() < 4e-3 and len(session.history) == steps + 1
        browser.do("undo")
        assert all("exposure" not in layer.operation.record() for layer in session.layers)


def test_exports_of_a_scene_and_of_one_asset(studio: Live, tmp_path: Path) -> None:
    data = sheet_bytes(tmp_path)
    added = studio.post("scene.add", blob=studio.send(data, "sheet.ply"))["asset"]
    studio.post("layer.new", asset=added, name="On the sheet")
    assert studio.http.get("/api/state").json()["layers"][0]["asset"] == added
    answer = studio.post("export", file="scene.ply")
    (tmp_path / "scene.ply").write_bytes(studio.http.get(answer["url"]).content)
    receipt = Receipt.from_json(studio.http.get(answer["receipt_url"]).text)
    outcome = check_merge(
        read(tmp_path / "scene.ply"), [studio.studio.session.opened, read(tmp_path / "sheet.ply")], receipt
    )
    assert outcome.ok, outcome.problems
    alone = studio.post("export", file="alone.ply", asset=added)
    assert studio.http.get(alone["url"]).content == data
    assert studio.post("verify")["proved"]


def test_what_is_selected_ends_with_the_assets_that_it_was_of(studio: Live, tmp_path: Path) -> None:
    session = studio.studio.session
    studio.studio.selection.choose(np.ones(len(session.splats), np.float32))
    studio.studio.refresh()
    studio.post("scene.add", demo=True)
    assert not studio.studio.selection
    assert len(session.splats) > 1000 and session.scene.assets[1].name == "demo"


def test_assets_of_recent_projects_are_added_as_they_were_read(tmp_path: Path) -> None:
    studio = make_studio(tmp_path)
    turned = read(write_sheet(tmp_path), axes="rub")
    for name, splats in (("up_1", turned), ("rows_1", ball(50, 3))):
        with Session(splats, studio.projects.root / f"{name}.splatproj") as session:
            session.layers.add("look", look="grade", settings={"exposure": 0.5})
    with live(studio) as served:
        recents = {entry["name"]: entry["id"] for entry in served.post("project.recent")["recent"]}
        for name in ("up", "rows"):
            served.post("scene.add", recent=recents[name])
        _, first, second = studio.session.scene.assets
        originals = [studio.session.scene.splats_of(asset.id) for asset in (first, second)]
    assert (first.name, second.name) == ("up", "rows")
    np.testing.assert_allclose(originals[0].means, turned.means)
    np.testing.assert_array_equal(originals[1].means, ball(50, 3).means)


def test_bad_input_is_refused_in_one_line(studio: Live, tmp_path: Path) -> None:
    assert "expected one of blob, file, recent or demo" in refused(studio, "scene.add")
    assert "without a folder" in refused(studio, "scene.add", file="x.ply")
    assert refused(studio, "scene.add", recent="nothing")
    assert studio.http.post("/api/blobs?name=x.ply", content=b"ply\n").status_code == 400
    write(tmp_path / "none.ply", random_splats(4, 0).take(np.zeros(0, np.int64)))
    blob = studio.send((tmp_path / "none.ply").read_bytes(), "none.ply")
    assert "none.ply" in refused(studio, "scene.add", blob=blob)
    assert "asset: expected one of" in refused(studio, "scene.set", asset="7", scale=2.0)
    assert "expected a scale" in refused(studio, "scene.set", asset="", scale=0.0)
    assert "is the only one" in refused(studio, "scene.set", asset="", visible=False)
    assert "is the one that was opened" in refused(studio, "scene.remove", asset="")
    assert "another one visible" in refused(studio, "scene.match", asset="")
    assert refused(studio, "scene.set", asset="")
    assert len(studio.studio.session.history) == 1
    assert len(read(tmp_path / "none.ply")) == 0
