"""The same commands over HTTP: pictures in, layers, files out, projects, and the folder."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from PIL import Image

from splatpainter.io import read, write
from splatpainter.lights.skies import SKIES
from splatpainter.painter import Painter
from splatpainter.receipts import Receipt, verify
from splatpainter.rendering import render
from splatpainter.server import describe, frames
from splatpainter.server.app import STATUS
from splatpainter.server.commands import COMMANDS
from splatpainter.server.protocol import Problem
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.session import Session
from splatpainter.splats import changed_rows, rows_sha256
from splatpainter.video.mp4 import avif_samples
from tests.support.model_scenes import with_refine
from tests.support.painter_scenes import LIFT, built
from tests.support.studio_scenes import Live, ball, dab, live, live_with_folder, make_studio, view, wire


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with live_with_folder(tmp_path) as served:
        yield served


def test_the_network_is_offered_where_it_makes_something_of_its_own() -> None:
    carrying = with_refine(LIFT, answers="teachers", picture_tokens=False, base="own", row_tokens=64)
    predicting = replace(carrying, predict=replace(carrying.predict, features=8, alone=True))
    for config, offered in ((None, False), (LIFT, True), (carrying, True), (predicting, False)):
        painter = Painter() if config is None else Painter(model=built(config))
        with Session(ball(50), painter=painter) as session:
            assert ("ttt" in describe.methods(session)) == offered, config


def edited(studio: Live, color=(0.9, 0.1, 0.1), camera=None) -> tuple[np.ndarray, np.ndarray]:
    """(the view with a coloured square, the square's mask)."""
    camera = camera or view()
    image = np.clip(render(studio.studio.session.splats, camera).colors[0], 0, 1)
    mask = np.zeros(image.shape[:2], bool)
    mask[36:60, 36:60] = True
    image[mask] = color
    return image, mask


def test_a_regraded_picture_can_stay_within_a_selection(studio: Live) -> None:
    image, mask = edited(studio)
    session, camera = studio.studio.session, view()
    before = session.splats
    green = np.clip(image * (0.5, 1.2, 0.5), 0, 1)
    blank = {"camera": wire(camera), "picture": studio.send(png_bytes(green))}
    chosen = blank | {"mask": studio.send(png_bytes(mask))}
    other = blank | {"camera": wire(view(96, 180))}
    made = studio.post("edit", views=[chosen, other], mode="global", kind="picture", within=True, name="greener")
    changed = changed_rows(before, session.splats)
    assert 0 < len(changed) < len(before) / 4 and made["layer"]["parameters"] == {"within": True}
    assert "within=True" in made["python"] and len(made["layer"]["views"]) == 1
    alone = studio.http.post("/api/do/edit", json={"views": [blank], "mode": "global", "within": True})
    assert "select an area" in alone.json()["error"]["hint"]
    studio.post("edit", views=[blank], mode="global", name="all greener")
    assert len(changed_rows(before, session.splats)) == len(before)


def test_a_picture_becomes_a_layer_as_in_python(studio: Live) -> None:
    image, mask = edited(studio)
    camera = view()
    picture = {"camera": wire(camera), "picture": studio.send(png_bytes(image)), "mask": studio.send(png_bytes(mask))}
    made = studio.post("edit", views=[picture], name="square")
    session = studio.studio.session
    script_session = Session(ball())
    from splatpainter.painter import Edit

    stored = np.asarray(Image.open(io.BytesIO(png_bytes(image)))).astype(np.float32) / 255
    script_session.layers.add("picture", [Edit(stored, camera, mask)])
    assert rows_sha256(script_session.splats) == rows_sha256(session.splats)
    script_session.close()
    layer = made["layer"]
    assert layer["gaussians_edited"] > 0 and layer["views"][0]["mask"] and made["version"] == 2
    for blob in (layer["thumbnail"], layer["views"][0]["picture"], layer["views"][0]["mask"]):
        assert studio.http.get(f"/api/blobs/{blob}").headers["content-type"] == "image/png"


def test_transparent_and_resized_pictures_and_erasing(studio: Live) -> None:
    image, mask = edited(studio)
    before = rows_sha256(studio.studio.session.splats)
    clear = np.concatenate([image, mask[..., None]], -1)
    big = Image.fromarray((clear * 255).astype(np.uint8)).resize((192, 192), Image.Resampling.NEAREST)
    file = io.BytesIO()
    big.save(file, "PNG")
    studio.post("edit", views=[{"camera": wire(view()), "picture": studio.send(file.getvalue())}])
    after = render(studio.studio.session.splats, view()).colors[0]
    assert np.abs(after - image)[mask].mean() < 0.08 and np.abs(after - image)[~mask].mean() < 0.02
    hole = studio.send(png_bytes(np.ones(mask.shape, bool)), "all.png")
    studio.post("edit", kind="erase", views=[{"camera": wire(view()), "picture": hole}])
    erased = render(studio.studio.session.splats, view()).colors[0]
    truth = render(studio.studio.original, view()).colors[0]
    assert np.abs(erased - truth).mean() < 0.25 * np.abs(after - truth).mean()
    studio.post("jump", cursor=0)
    assert rows_sha256(studio.studio.session.splats) == before
    wrong = studio.http.post(
        "/api/do/edit",
        json={"views": [{"camera": wire(view()), "picture": studio.send(png_bytes(image[:50]))}]},
    )
    assert wrong.status_code == 400 and wrong.json()["error"]["hint"] == "resize without cropping"


def test_every_operation_on_layers(studio: Live) -> None:
    session = studio.studio.session
    ids = []
    for angle in (0, 180):
        image, _ = edited(studio, camera=view(96, angle))
        picture = {"camera": wire(view(96, angle)), "picture": studio.send(png_bytes(image))}
        ids.append(studio.post("edit", views=[picture], name=f"from {angle}")["layer"]["id"])
    before_sha256 = rows_sha256(session.splats)
    studio.post("layer.set", layer=ids[0], visible=False)
    assert rows_sha256(session.splats) != before_sha256
    studio.post("layer.set", layer=ids[0], visible=True)
    assert rows_sha256(session.splats) == before_sha256
    studio.post("layer.set", layer=ids[1], name="renamed", blend="color", opacity=0.25)
    studio.post("layer.move", layer=ids[1], to=0)
    assert [layer.name for layer in session.layers] == ["renamed", "from 0"]
    copy = studio.post("layer.duplicate", layer=ids[0])["layer"]["id"]
    merged = studio.post("layer.merge", layers=[ids[0], copy], name="both")["layer"]
    assert merged["kind"] == "merged"
    out = studio.post("layer.export", layer=merged["id"])
    data = studio.http.get(out["url"]).content
    assert len(data) == out["bytes"]
    studio.post("layer.delete", layer=merged["id"])
    studio.post("layer.import", blob=studio.send(data, "both.splatlayer"))
    assert [layer.name for layer in session.layers] == ["renamed", "both"]
    state = studio.http.get("/api/state").json()
    assert state["cursor"] == len(state["history"]) - 1 == len(session.history) - 1
    for _ in range(len(session.history)):
        studio.post("undo")
    assert rows_sha256(session.splats) == rows_sha256(session.original) and not session.layers
    assert studio.http.post("/api/do/redo").json()["ok"]


def test_conflicts_are_reported_and_settled(studio: Live) -> None:
    for angle, color in ((0, (0.9, 0.1, 0.1)), (25, (0.1, 0.1, 0.9))):
        image, _ = edited(studio, color, view(96, angle))
        studio.post("edit", views=[{"camera": wire(view(96, angle)), "picture": studio.send(png_bytes(image))}])
    result = studio.post("conflicts")["conflicts"]
    assert len(result) == 1 and result[0]["gaussians"] > 0 and result[0]["policy"] == "latest"
    studio.post("conflict.set", lower=result[0]["lower"], upper=result[0]["upper"], policy="first")
    assert studio.post("conflicts")["conflicts"][0]["policy"] == "first"


def test_exports_prove_themselves(studio: Live, tmp_path: Path) -> None:
    image, _ = edited(studio)
    studio.post("edit", views=[{"camera": wire(view()), "picture": studio.send(png_bytes(image))}])
    out = studio.post("export", file="painted.ply")
    (tmp_path / "painted.ply").write_bytes(studio.http.get(out["url"]).content)
    receipt = Receipt.from_json(studio.http.get(out["receipt_url"]).text)
    write(tmp_path / "ball.ply", studio.studio.original)
    result = verify(tmp_path / "ball.ply", tmp_path / "painted.ply")
    assert result.ok and result.changed == len(receipt.touched) and result.appended == receipt.appended_rows > 0
    summary = studio.post("receipt")
    state = studio.http.get("/api/state").json()["asset"]
    same = f"{result.same:,} of {result.rows:,} Gaussians byte-identical"
    assert (
        summary["text"].startswith(same)
        and state["gaussians_unchanged"] == result.same
        and state["gaussians"] == receipt.output_rows
    )
    proof = studio.post("verify")
    assert proof["proved"] and proof["same"] == result.same and not proof["problems"]
    wrong = studio.http.post("/api/do/export", json={"file": "painted.obj"})
    assert wrong.status_code == 400 and ".ply" in wrong.json()["error"]["message"]
    assert studio.http.get("/api/files/nokey/painted.ply").status_code == 404


def test_views_and_picking(studio: Live) -> None:
    camera = view()
    made = studio.post("view.render", camera=wire(camera))
    png = Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{made['picture']}").content))
    truth = np.clip(render(studio.studio.session.splats, camera).colors[0], 0, 1)
    assert np.abs(np.asarray(png) / 255 - truth).max() <= 0.51 / 255
    assert json.loads(png.text["splatpainter"])["fx"] == camera.fx  # type: ignore[attr-defined]
    direct = studio.http.get("/api/view.png", params={"camera": camera.to_json()})
    assert direct.content == studio.http.get(f"/api/blobs/{made['picture']}").content
    assert studio.http.get("/api/view.png", params={"camera": "{}"}).status_code == 400
    other = studio.post("view.render", camera=wire(camera), profile="playcanvas")
    assert "profile='playcanvas'" in other["python"]
    dark = np.asarray(Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{other['picture']}").content))) / 255
    expected = render(studio.studio.session.splats, camera, profile="playcanvas").colors[0]
    assert np.abs(dark - np.clip(expected, 0, 1)).max() <= 0.51 / 255 and np.abs(dark - truth).max() > 2 / 255
    assert studio.http.post("/api/do/view.render", json={"camera": wire(camera), "profile": "x"}).status_code == 400
    seen = studio.post("pick", camera=wire(camera), x=48.5, y=48.5)
    assert np.allclose(seen["color"], truth[48, 48], atol=1e-4) and seen["hit"]
    point = np.array(seen["point"])
    assert 0.8 < np.linalg.norm(point) < 1.2  # on the ball
    local = camera.world_to_camera @ [*point, 1]
    assert np.allclose(local[2], seen["depth"]) and np.allclose(local[0] / local[2] * camera.fx + camera.cx, 48.5)
    assert not studio.post("pick", camera=wire(camera), x=1, y=1)["hit"]
    assert studio.http.post("/api/do/pick", json={"camera": wire(camera), "x": 96, "y": 0}).status_code == 400
    huge = {**wire(camera), "width": 10_000, "height": 10_000}
    assert "megapixels" in studio.http.post("/api/do/view.render", json={"camera": huge}).json()["error"]["message"]
    turn = studio.post("turntable", camera=wire(view(48)), frames=5)
    data = studio.http.get(turn["url"]).content
    assert (turn["file"], turn["bytes"]) == ("turntable.webp", len(data))
    animation = Image.open(io.BytesIO(data))
    assert animation.n_frames == 5 and animation.size == (48, 48)  # type: ignore[attr-defined]
    film = studio.post("turntable", camera=wire(view(48)), format="mp4", seconds=0.2, fps=20, size=71, name="film")
    data = studio.http.get(film["url"]).content
    samples = avif_samples(data)
    assert (film["file"], len(samples.frames), samples.width) == ("film.mp4", 4, 70)
    slow = studio.http.post("/api/do/turntable", json={"camera": wire(view(48)), "frames": 2, "fps": 1e-38})
    assert slow.status_code == 400 and "from 0.05 to 600" in slow.json()["error"]["message"]
    first = np.asarray(animation.convert("RGB")) / 255
    assert np.abs(first - np.clip(render(studio.studio.session.splats, view(48)).colors[0], 0, 1)).mean() < 0.02


def test_coverage_shows_what_was_seen_and_what_was_predicted(studio: Live) -> None:
    image = np.clip(render(studio.studio.session.splats, view()).colors[0], 0, 1) ** 1.5
    studio.post("edit", mode="global", views=[{"camera": wire(view()), "picture": studio.send(png_bytes(image))}])
    result = studio.post("coverage", camera=wire(view()))
    assert result["seen"] > 50 and result["predicted"] > 50
    front = np.asarray(Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{result['picture']}").content))).astype(int)
    assert front.shape == (96, 96, 4) and front[48, 48, 1] > front[48, 48, 0] and front[2, 2, 3] == 0
    back = np.array(result["next_view"]["world_to_camera"])
    position = -back[:3, :3].T @ back[:3, 3]
    assert position[2] > 0.5  # the far side


def test_what_the_limits_leave_out_is_the_rim_of_the_ball(studio: Live) -> None:
    def picture(**fields) -> np.ndarray:
        answer = studio.post("paint.limits", camera=wire(view()), **fields)
        png = studio.http.get(f"/api/blobs/{answer['picture']}").content
        pixels = np.asarray(Image.open(io.BytesIO(png)))
        assert pixels.shape == (96, 96, 4) and (pixels[..., 3] > 0).sum() == answer["pixels"]
        return pixels[..., 3] > 0

    free, strict = picture(limits={"angle_limit": 0}), picture(limits={"angle_limit": 40})
    assert not free.any() and not strict[40:56, 40:56].any() and not strict[:5].any()
    distance = np.hypot(*(np.mgrid[:96, :96] + 0.5 - 48))
    assert strict[(distance > 28) & (distance < 32)].mean() > 0.5 > strict[distance < 20].mean()
    assert picture().sum() <= picture(limits={"angle_limit": 60}).sum() < strict.sum()
    for limits, reason in (({"angle_limit": 91}, "less than or equal to 90"), ({"angel": 1}, "Extra inputs")):
        refused = studio.http.post("/api/do/paint.limits", json={"camera": wire(view()), "limits": limits})
        assert not refused.json()["ok"] and reason in refused.text


def test_a_picture_is_limited_to_what_its_view_sees_well(studio: Live) -> None:
    image, mask = edited(studio)
    picture = {"camera": wire(view()), "picture": studio.send(png_bytes(image)), "mask": studio.send(png_bytes(mask))}
    made = studio.post("edit", views=[picture], limits={"angle_limit": 30, "depth_edge_limit": 2})
    limits = {"angle_limit": 30.0, "depth_edge_limit": 2.0}
    assert made["layer"]["parameters"] == limits and all(f"{k}={v}" in made["python"] for k, v in limits.items())
    free = studio.post("edit", views=[picture], limits={"angle_limit": None})
    assert free["layer"]["parameters"] == {} and "limit" not in free["python"]
    erased = studio.post("edit", views=[picture], kind="erase", limits=limits)
    assert erased["layer"]["parameters"] == {}


def test_projects_bookmarks_and_the_folder(studio: Live, tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    write(shared / "other.ply", ball(100, seed=5))
    (shared / "notes.txt").write_text("x")
    studio.post("bookmark.add", name="front", camera=wire(view()))
    image, _ = edited(studio)
    studio.post("edit", views=[{"camera": wire(view()), "picture": studio.send(png_bytes(image))}])
    digest = rows_sha256(studio.studio.session.splats)
    studio.post("project.save_as", file="mine")
    state = studio.http.get("/api/state").json()
    assert state["project"] == {
        "id": f"mine~{studio.studio.session.files.project_id}",
        "name": "mine",
        "file": "mine.splatproj",
        "read_only": False,
        "read_only_reason": "",
        "is_free": False,
        "noted_computer": "",
    }
    assert studio.post("project.recent")["files"] == ["mine.splatproj", "other.ply"]
    studio.post("asset.open", file="other.ply")
    again = studio.http.post("/api/do/project.save_as", json={"file": "mine"})
    assert again.status_code == 400 and "already exists" in again.json()["error"]["message"]
    assert studio.http.get("/api/state").json()["asset"]["gaussians"] == 100
    recent = studio.post("project.recent")["recent"]
    assert [entry["name"] for entry in recent] == ["other"]
    studio.post("project.open", file="mine.splatproj")
    state = studio.http.get("/api/state").json()
    assert rows_sha256(studio.studio.session.splats) == digest
    assert [mark["name"] for mark in state["bookmarks"]] == ["front"] and len(state["layers"]) == 1
    assert studio.post("project.recent")["recent"] == []  # in the other one nothing was done
    studio.post("bookmark.delete", bookmark=state["bookmarks"][0]["id"])
    copy = studio.post("project.download")
    data = studio.http.get(copy["url"]).content
    studio.post("asset.open", file="other.ply")
    studio.post("project.open", blob=studio.send(data, "back.splatproj"))
    assert rows_sha256(studio.studio.session.splats) == digest
    assert [entry["name"] for entry in studio.post("project.recent")["recent"]] == ["back"]


def test_projects_elsewhere_are_found_again_by_an_id_of_their_own(studio: Live, tmp_path: Path) -> None:
    """One that the studio was started with lies in no folder that it lists, and may have any other's name."""
    write(tmp_path / "shared" / "other.ply", ball(100, seed=5))
    layer, state = studio.post("layer.new")["layer"], studio.http.get("/api/state").json()
    path, project = studio.studio.session.path, state["project"]["id"]
    assert path is not None and project != path.stem and project.startswith(f"{path.stem}~")
    studio.post("asset.open", file="other.ply")
    listed = {entry["id"]: entry["name"] for entry in studio.post("project.recent")["recent"]}
    assert listed[project] == path.stem
    studio.post("project.open", recent=project)
    state = studio.http.get("/api/state").json()
    assert [one["id"] for one in state["layers"]] == [layer["id"]] and state["project"]["id"] == project
    with Session(ball(50), tmp_path / "shared" / path.name):
        pass
    studio.post("project.open", file=path.name)
    assert studio.http.get("/api/state").json()["project"]["id"] not in (project, path.stem)


def test_what_was_painted_before_is_offered_again(studio: Live, tmp_path: Path) -> None:
    """The same original, opened anew: its project with layers is named, with its picture; copies are no doubles."""
    write(tmp_path / "shared" / "other.ply", ball(100, seed=5))
    write(tmp_path / "shared" / "third.ply", ball(100, seed=6))
    studio.post("asset.open", file="other.ply")
    layer = studio.post("layer.new")["layer"]
    project = studio.http.get("/api/state").json()["project"]["id"]
    digest = rows_sha256(studio.studio.session.splats)
    studio.post("asset.open", file="third.ply")
    assert studio.http.get("/api/state").json()["earlier"] == []
    studio.post("asset.open", file="other.ply")
    (offer,) = studio.http.get("/api/state").json()["earlier"]
    assert (offer["id"], offer["layers"], offer["is_open"]) == (project, 1, False)
    listed = [entry for entry in studio.post("project.recent")["recent"] if entry["id"] == project]
    assert listed[0]["changed"] == offer["changed"]
    studio.post("project.open", recent=project)
    state = studio.http.get("/api/state").json()
    assert [one["id"] for one in state["layers"]] == [layer["id"]] and state["project"]["id"] == project
    assert rows_sha256(studio.studio.session.splats) == digest and state["earlier"] == []
    data = studio.http.get(studio.post("project.download")["url"]).content
    for _ in range(2):
        studio.post("project.open", blob=studio.send(data, "copy.splatproj"))
    studio.post("asset.open", file="third.ply")
    names = [entry["name"] for entry in studio.post("project.recent")["recent"]]
    assert len(names) == len(set(names)) and "copy" in names
    (begun,) = (entry for entry in studio.post("project.recent")["recent"] if entry["is_open"])
    assert begun["layers"] == 0 and begun["picture"], "also one in which nothing was done yet"
    image, _ = edited(studio)
    studio.post("asset.open", file="other.ply")
    studio.post("edit", views=[{"camera": wire(view()), "picture": studio.send(png_bytes(image))}])
    assert studio.http.get("/api/state").json()["earlier"] == []  # something was done
    (painted,) = (entry for entry in studio.post("project.recent")["recent"] if entry["is_open"])
    picture = Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{painted['picture']}").content))
    assert picture.size == (96, 96) and painted["layers"] == 1


def test_the_time_of_the_last_edit_is_not_that_of_opening(tmp_path: Path) -> None:
    from splatpainter.server.uploads.storage import Projects

    projects = Projects(tmp_path)
    for name in ("one", "two"):
        with Session(ball(50), projects.fresh(name)) as session:
            session.layers.new(name)
    times = {project.name: project.changed for project in projects.recent()}
    one = next(project for project in projects.recent() if project.name == "one")
    with Session.load(one.path):
        pass
    (tmp_path / "broken_1.splatproj").write_bytes(b"no project")
    recent = projects.recent()
    assert {project.name: project.changed for project in recent if project.summary} == times
    assert [project.name for project in recent if project.summary] == ["two", "one"]
    assert [project.name for project in recent if not project.summary] == ["broken"]


def test_turning_an_asset_over_is_kept(studio: Live, tmp_path: Path) -> None:
    """The screen's up and the first view follow, the Gaussians do not; a project in which only this was done is
    kept."""
    digest = rows_sha256(studio.studio.session.splats)
    asset = studio.http.get("/api/state").json()["asset"]
    assert asset["up"] == [0, -1, 0] and asset["axes_stated"] and asset["axes"] == ""
    write(tmp_path / "shared" / "other.ply", ball(100, seed=5))
    studio.post("asset.open", file="other.ply")
    assert studio.post("asset.up", up="+y")["python"] == "session.scene.set_up('+y')"
    turned = studio.http.get("/api/state").json()["asset"]
    assert turned["up"] == [0, 1, 0] and turned["axes"].startswith("right-down-front")
    down, eye = np.array(turned["home"]["world_to_camera"])[1, :3], turned["home"]["world_to_camera"][2][3]
    assert down[1] < -0.9 and eye > 0
    assert studio.http.post("/api/do/asset.up", json={"up": "up"}).status_code == 400
    studio.post("asset.open", demo=True)
    (entry,) = (entry for entry in studio.post("project.recent")["recent"] if entry["name"] == "other")
    studio.post("project.open", recent=entry["id"])
    assert studio.http.get("/api/state").json()["asset"]["up"] == [0, 1, 0]
    assert digest != rows_sha256(studio.studio.session.splats)


def test_everything_is_on_disk_when_the_studio_ends(tmp_path: Path) -> None:
    with live(make_studio(tmp_path)) as studio:
        image, _ = edited(studio)
        studio.post("edit", views=[{"camera": wire(view()), "picture": studio.send(png_bytes(image))}])
        digest = rows_sha256(studio.studio.session.splats)
    assert [path.name for path in tmp_path.glob("own*")] == ["own.splatproj"]
    with Session.load(tmp_path / "own.splatproj") as again:
        assert rows_sha256(again.splats) == digest


def test_the_description_names_every_command(studio: Live) -> None:
    paths = studio.http.get("/api/openapi.json").json()["paths"]
    missing = {name for name in COMMANDS if f"/api/do/{name}" not in paths}
    assert missing == {"hello", "sync", "cancel"}
    body = paths["/api/do/layer.move"]["post"]["requestBody"]["content"]["application/json"]["schema"]
    assert body == {"$ref": "#/components/schemas/LayerMove"}
    fault = studio.http.post("/api/do/layer.move", json={"layer": "1"})
    assert fault.status_code == 400 and "to: Field required" in fault.json()["error"]["message"]


def test_gaussians_over_http_and_strokes_without_a_socket(studio: Live) -> None:
    frame = frames.unpack(studio.http.get("/api/splats").content)
    assert np.array_equal(frame.splats.sh, studio.studio.session.splats.sh)
    stroke = studio.post("paint.begin", camera=wire(view()))["stroke"]
    assert studio.post("paint.dab", stroke=stroke, x=36, y=36, width=24, height=24, rgba=dab(24, (255, 0, 0, 255)))[
        "gaussians"
    ]
    assert studio.post("paint.end", stroke=stroke, name="red")["layer"]["name"] == "red"


def test_a_linear_asset_is_painted_and_graded_in_display_colours(tmp_path: Path) -> None:
    from dataclasses import replace

    asset = ball()
    sh = asset.sh.copy()
    sh[:, 1:] = 0
    with live(make_studio(tmp_path, replace(asset, sh=sh, color_space="linear"))) as studio:
        stroke = studio.post("paint.begin", camera=wire(view()))["stroke"]
        studio.post("paint.dab", stroke=stroke, x=30, y=30, width=36, height=36, rgba=dab(36, (128, 128, 128, 255)))
        studio.post("paint.end", stroke=stroke)
        seen = studio.post("pick", camera=wire(view()), x=48.0, y=48.0)["color"]
        assert np.allclose(seen, 128 / 255, atol=0.06)


def test_a_file_asset_keeps_its_name_and_format(tmp_path: Path) -> None:
    write(tmp_path / "ball.spz", ball())
    with live(make_studio(tmp_path, read(tmp_path / "ball.spz"))) as studio:
        asset = studio.http.get("/api/state").json()["asset"]
        assert asset["format"] == "spz" and asset["gaussians"] == asset["gaussians_unchanged"] == 600
        assert studio.post("verify")["proved"]


def test_the_skies_of_the_light_panel_have_pictures(studio: Live) -> None:
    skies = studio.post("light.skies")["skies"]
    assert [one["name"] for one in skies] == list(SKIES)
    blobs = [one["picture"] for one in skies]
    sizes = {Image.open(io.BytesIO(studio.http.get(f"/api/blobs/{blob}").content)).size for blob in blobs}
    assert sizes == {(128, 64)} and len(set(blobs)) == len(blobs)


def test_the_options_of_a_light_layer_change_in_gestures(studio: Live) -> None:
    made = studio.post("layer.add", operation={"kind": "light", "hdri": "dawn"}, name="Light")
    layer, steps = made["layer"]["id"], len(studio.studio.session.history)
    for turn in (10, 20, 0):  # 0 is the default, which a layer does not say
        fields = {"parameters": {"rotate": turn, "sun": ["60,10"]}, "gesture": "a drag"}
        answer = studio.post("layer.set", layer=layer, **fields)
        assert answer["layer"]["parameters"].get("rotate", 0) == turn
    assert len(studio.studio.session.history) == steps + 1
    wrong = studio.http.post("/api/do/layer.set", json={"layer": layer, "parameters": {"hdri": "sky.hdr"}})
    assert wrong.status_code == 400 and "without files" in wrong.text
    studio.post("undo")
    assert describe.page_parameters(studio.studio.session.layers.by_id(layer).operation) == {"hdri": "dawn"}


def test_an_operation_is_a_layer_by_its_own_options(studio: Live) -> None:
    before = studio.studio.session.splats
    made = studio.post("layer.add", operation={"kind": "delight", "mix": 0.5}, name="White light", opacity=0.5)
    assert made["layer"]["kind"] == "delight" and made["layer"]["parameters"] == {"mix": 0.5}
    assert made["python"] == "session.layers.add('delight', mix=0.5, name='White light', opacity=0.5)"
    assert (studio.studio.session.splats.sh != before.sh).any()
    for wrong in (
        {"kind": "light", "hdri": "/dev/zero"},
        {"kind": "light", "where": ["mask=/dev/zero"]},
        {"kind": "paint"},
    ):
        answer = studio.http.post("/api/do/layer.add", json={"operation": wrong})
        assert answer.status_code == 400 or answer.status_code == 422
    assert len(studio.studio.session.layers) == 1


def test_every_kind_of_refusal_has_a_status() -> None:
    assert set(STATUS) == set(get_args(Problem.model_fields["kind"].annotation))


def test_a_command_may_name_the_session_that_it_means(studio: Live) -> None:
    """As messages of the socket: a script that goes on after another project was opened changes nothing there."""

    def ask(name: str, session: str | None, /, **fields: object) -> tuple[int, dict]:
        params = {} if session is None else {"session": session}
        answer = studio.http.post(f"/api/do/{name}", params=params, json=fields)
        return answer.status_code, answer.json()

    meant = studio.http.get("/api/state").json()["session"]
    assert ask("bookmark.add", meant, name="mine", camera=wire(view()))[0] == 200
    assert ask("asset.open", meant, demo=True)[0] == 200
    status, refused = ask("bookmark.add", meant, name="other", camera=wire(view()))
    assert status == 409 and refused["error"]["kind"] == "project"
    state = studio.http.get("/api/state").json()
    assert state["session"] != meant and state["bookmarks"] == []
    for session in (state["session"], None):
        assert ask("bookmark.add", session, name="one", camera=wire(view()))[0] == 200
    # Commands that are bound to no session, and those of no fields.
    assert ask("asset.open", meant, demo=True)[0] == 200
    assert ask("undo", meant)[0] == 409
    parameters = studio.http.get("/api/openapi.json").json()["paths"]["/api/do/undo"]["post"]["parameters"]
    assert [one["name"] for one in parameters] == ["session"]


def test_the_open_project_by_another_name_is_not_opened_twice(studio: Live, tmp_path: Path) -> None:
    """On disks that do not tell capitals apart Work.splatproj is work.splatproj; here two links to one file are."""
    folder = tmp_path / "shared"
    with Session(ball(50), folder / "work.splatproj"):
        pass
    studio.post("project.open", file="work.splatproj")
    session = studio.http.get("/api/state").json()["session"]
    try:
        os.link(folder / "work.splatproj", folder / "Work.splatproj")
    except FileExistsError:
        pass  # it is one already
    studio.post("project.open", file="Work.splatproj")
    state = studio.http.get("/api/state").json()
    assert state["session"] == session and not state["project"]["read_only"]
