"""Batches in the studio: planned, at work in a program of their own, cancelled, downloaded; nothing but results goes
out, and what is refused is one line."""

from __future__ import annotations

import io
import os
import shutil
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.batch.schema import Batch
from splatpainter.commands import verify
from splatpainter.commands.batch import Config as BatchConfig
from splatpainter.commands.batch import run as run_batch
from splatpainter.io import read, write
from splatpainter.rendering import render
from splatpainter.scene.placement import Placement
from splatpainter.server.batches import batch_runs as batches
from splatpainter.server.batches.batch_folder import BatchFolder
from splatpainter.server.batches.batch_runs import Batches
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.session import Session
from splatpainter.system import processes
from splatpainter.system.yamlio import read as read_yaml
from tests.support import fake_batch
from tests.support.studio_scenes import Live, ball, live, live_with_folder, make_studio, view, wire

PATIENCE_SECONDS = 900.0
RED = {"kind": "recolor", "color": "#a02020"}


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with live_with_folder(tmp_path) as one:
        yield one


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Put a program in place of the real one."""

    def use(results: str, then: str = "end") -> None:
        program = (sys.executable, "-S", str(Path(fake_batch.__file__)), results, then)
        monkeypatch.setattr(batches, "PROGRAM", program)

    return use


def splat_bytes(folder: Path, seed: int = 0) -> bytes:
    path = folder / f"asset{seed}.ply"
    write(path, ball(600, seed), overwrite=True)
    return path.read_bytes()


def paint(studio: Live) -> str:
    """A layer on the middle of the view; its id."""
    image, mask = np.clip(render(ball(), view()).colors[0], 0, 1), np.zeros((96, 96), bool)
    mask[38:58, 38:58] = True
    image[mask] = (0.1, 0.9, 0.1)
    picture, area = studio.send(png_bytes(image)), studio.send(png_bytes(mask))
    made = studio.post("edit", views=[{"camera": wire(view()), "picture": picture, "mask": area}], name="stripe")
    return made["layer"]["id"]


def planned(studio: Live, **fields: Any) -> dict[str, Any]:
    return studio.post("batch.plan", **fields)["batch"]


def refusal(studio: Live, command: str, **fields: Any) -> str:
    answer = studio.http.post(f"/api/do/{command}", json=fields)
    assert answer.status_code == 400, answer.text
    error = answer.json()["error"]
    line = f"{error['message']}; {error['hint']}" if error["hint"] else error["message"]
    assert "\n" not in line and "/tmp" not in line
    return line


def until(studio: Live, ready: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    end = time.monotonic() + PATIENCE_SECONDS
    while not ready(batch := studio.post("batch.status")["batch"]):
        assert time.monotonic() < end, batch
        time.sleep(0.02)
    return batch


def states(batch: dict[str, Any]) -> list[str]:
    return [job["state"] for job in batch["jobs"]]


def test_layers_on_other_assets_by_the_real_program_cancelled_on_the_way(
    studio: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One asset is damaged, the last one is never made; what is made is what the command makes, and is proved."""
    monkeypatch.setattr(processes, "BACKGROUND_NICE", 0)  # a machine with more to do would let it wait for minutes
    paint(studio)
    (tmp_path / "shared" / "from folder.ply").write_bytes(splat_bytes(tmp_path, 1))
    good, bad = splat_bytes(tmp_path, 0), splat_bytes(tmp_path, 2)
    late = [f"late {number}.ply" for number in range(6)]  # enough to be at work when it is cancelled
    names = ["../../Schuh ü 100%.ply", "cut.ply", *late]
    blobs = [studio.send(data, "x.ply") for data in (good, bad[:9000], *[bad] * len(late))]
    assets = [{"blob": blob, "name": name} for blob, name in zip(blobs, names, strict=True)]
    assets.insert(1, {"file": "from folder.ply"})
    batch = planned(studio, assets=assets, camera=wire(view()))
    assert [job["name"] for job in batch["jobs"]] == ["Schuh ü 100%.ply", "from folder.ply", "cut.ply", *late]
    assert batch["state"] == "planned" and {job["words"] for job in batch["jobs"]} == {"layers: stripe"}
    studio.post("batch.start", batch=batch["id"])
    assert studio.post("undo")["ok"] and studio.post("redo")["ok"], "the session can be used meanwhile"
    until(studio, lambda now: states(now)[2] == "failed")
    studio.post("batch.cancel", batch=batch["id"])
    batch = until(studio, lambda now: now["state"] == "cancelled")
    assert states(batch)[:3] == ["done", "done", "failed"] and states(batch)[-1] == "cancelled", batch
    assert batch["jobs"][2]["line"].startswith("cut.ply: truncated: 600 rows")
    assert "Gaussians unchanged" in batch["jobs"][0]["line"] and batch["jobs"][0]["line"].endswith(", verified")

    original, result = tmp_path / "asset0.ply", tmp_path / "result.ply"
    answers = [studio.http.get(batch["jobs"][0][key]) for key in ("url", "receipt_url", "before_url", "after_url")]
    assert [answer.status_code for answer in answers] == [200] * 4
    assert answers[3].headers["content-type"] == "image/webp" and answers[2].content != answers[3].content
    result.write_bytes(answers[0].content)
    result.with_name("result.ply.receipt.json").write_bytes(answers[1].content)
    assert verify.run(verify.Config(original, result)).code == 0
    alone = Session(original)
    exported = tmp_path / "stripe.splatlayer"
    studio.studio.session.files.export_layer(studio.studio.session.layers[0].id, exported)
    alone.files.import_layer(exported)
    assert np.array_equal(alone.splats.sh, read(result).sh), "as the layer on that asset by hand"
    alone.close()

    page = studio.http.get(batch["page_url"])
    for state in ("done", "cancelled"):
        assert f"{states(batch).count(state)} {state}" in page.text
    assert str(tmp_path) not in page.text
    assert str(studio.studio.scratch.path) not in page.text + answers[1].text + str(batch)
    assert "script-src" not in page.headers["content-security-policy"]
    bundle = zipfile.ZipFile(io.BytesIO(studio.http.get(batch["zip_url"]).content))
    assert bundle.testzip() is None and bundle.read("Schuh ü 100%.ply") == answers[0].content
    results = [job["name"] for job in batch["jobs"] if job["state"] == "done"]
    assert sorted(bundle.namelist()) == sorted([*results, *(f"{name}.receipt.json" for name in results), "index.html"])


def test_variants_are_planned_as_a_file_that_the_command_reads(studio: Live, tmp_path: Path) -> None:
    layer = paint(studio)
    studio.post("selection.change", to="all")
    studio.post("selection.save", name="a hue=1 or b")
    cube = studio.send(b"LUT_1D_SIZE 2\n0 0 0\n1 1 1\n", "film.cube")
    rows = [
        {"name": "red", "transfer": RED, "on": "layer", "of": layer},
        {"name": "Größe 2", "transfer": {"kind": "lut", "file": cube}, "on": "selected"},
        {"name": "warm", "look": {"temperature": 0.5}, "on": "selection", "of": "a hue=1 or b"},
        {"name": "plain"},
    ]
    batch = planned(studio, variants=rows, format="spz")
    assert [job["name"] for job in batch["jobs"]] == [
        "ball-red.spz", "ball-Größe 2.spz", "ball-warm.spz", "ball-plain.spz"
    ]  # fmt: skip
    assert [job["words"] for job in batch["jobs"]] == [
        "new colour #a02020 on stripe", "LUT film.cube on what was selected", "adjustment on a hue=1 or b", "as it is"
    ]  # fmt: skip
    folder = studio.studio.batches.get(batch["id"]).folder
    written, _ = read_yaml(Batch, folder / "batch.yaml")
    assert [variant.edits[-1].kind for variant in written.variants] == ["grade", "grade", "grade", "layers"]
    assert all(variant.edits[0].kind == "layers" for variant in written.variants)
    assert written.variants[0].edits[1].step.where == (f"layer={layer}@project.splatproj",)
    with Session.load(folder / "project.splatproj", readonly=True) as session:
        for variant in written.variants[1:3]:
            (term,) = variant.edits[1].step.where
            name = term.removeprefix("selection=").removesuffix("@project.splatproj")
            assert session.selections.load(name).mean() > 0.9, "kept under a name that --where can say"
    assert np.array_equal(read(folder / "assets" / "ball.ply").means, ball().means)


REFUSED: tuple[tuple[dict[str, Any], str], ...] = (
    ({}, "batch: expected assets or variants; choose at least one asset, or fill in one row"),
    ({"assets": [{}]}, "batch: expected one of blob, recent or file for each asset"),
    ({"assets": [{"blob": "0" * 64}]}, "blob 000000000000...: no longer available; send it again to /api/blobs"),
    ({"assets": [{"blob": "PICTURE"}]}, "a.png: expected an asset, got a picture"),
    ({"assets": [{"file": "gone.ply"}]}, "gone.ply: no such file in the studio's folder shared"),
    ({"assets": [{"file": ".secret.ply"}]}, "'.secret.ply': expected a plain file name"),
    ({"assets": [{"file": "link.ply"}]}, "link.ply: lies outside the studio's folder"),
    ({"assets": [{"file": "p.splatproj"}]}, "p.splatproj: is a project; expected a splat file"),
    ({"assets": [{"recent": "../own"}]}, "project '../own': no longer among the recent ones"),
    ({"variants": [{"name": "a/b", "transfer": RED}]}, "batch: expected a name of letters, digits, space and .+-_"),
    ({"variants": [{"name": "a", "transfer": RED}, {"name": "A", "transfer": RED}]}, "batch: 'a' was given twice"),
    ({"variants": [{"name": "a", "transfer": RED, "on": "selected"}]}, "batch: a: nothing is selected; select"),
    ({"variants": [{"name": "a", "transfer": RED, "on": "selection", "of": "x"}]}, "selection: the project holds"),
    ({"variants": [{"name": "a", "transfer": {"kind": "lut"}}]}, "batch: a: expected a file: a .cube table"),
)


def test_what_cannot_be_planned_is_one_line(studio: Live, tmp_path: Path) -> None:
    paint(studio)
    splat_bytes(tmp_path)
    (tmp_path / "shared" / "link.ply").symlink_to(tmp_path / "asset0.ply")
    picture = studio.send(png_bytes(np.zeros((4, 4, 3), np.float32)), "a.png")
    for fields, line in REFUSED:
        if fields.get("assets") == [{"blob": "PICTURE"}]:
            fields = {"assets": [{"blob": picture}]}
        assert refusal(studio, "batch.plan", **fields).startswith(line), line
        assert studio.post("batch.status")["batch"] is None
        assert not [path for path in studio.studio.scratch.path.iterdir() if path.is_dir()], "nothing is left"


def test_assets_of_recent_projects_stand_as_they_do_there(tmp_path: Path) -> None:
    """One whose file has y up by choice, and one that came from no file; both are read without being told anything."""
    studio = make_studio(tmp_path)
    (tmp_path / "y-up.ply").write_bytes(splat_bytes(tmp_path, 1))
    turned = read(tmp_path / "y-up.ply", axes="rub")
    for name, splats in (("up_1", turned), ("rows_1", ball(50, 3))):
        with Session(splats, studio.projects.root / f"{name}.splatproj") as session:
            session.layers.add("look", look="grade", settings={"exposure": 0.5})
    with live(studio) as served:
        paint(served)
        recents = {entry["name"]: entry["id"] for entry in served.post("project.recent")["recent"]}
        batch = planned(served, assets=[{"recent": recents["up"]}, {"recent": recents["rows"]}])
        assert [job["name"] for job in batch["jobs"]] == ["up.ply", "rows.ply"]
        folder = studio.batches.get(batch["id"]).folder / "assets"
        assert np.allclose(read(folder / "up.ply").means, turned.means)
        assert np.array_equal(read(folder / "rows.ply").means, ball(50, 3).means)


def test_without_a_layer_there_is_nothing_to_put_onto_others(studio: Live, tmp_path: Path) -> None:
    asset = [{"blob": studio.send(splat_bytes(tmp_path), "a.ply")}]
    assert refusal(studio, "batch.plan", assets=asset).startswith("batch: no visible layer to put onto other")
    assert refusal(studio, "batch.plan", variants=[{"name": "a"}]).startswith("batch: a: changes nothing")
    assert planned(studio, variants=[{"name": "a", "transfer": RED}])["jobs"][0]["name"] == "ball-a.ply"


def test_of_several_assets_the_chosen_one_makes_batches(studio: Live, tmp_path: Path) -> None:
    """Its layers go onto others, and its variants are of its own file; a layer of another asset stays out."""
    session, data = studio.studio.session, splat_bytes(tmp_path, 3)
    rug = studio.post("scene.add", blob=studio.send(data, "rug.ply"))["asset"]
    session.scene.set(rug, placement=Placement.of(move=(0, 9, 0), scale=2))
    bright = session.layers.add("look", look="grade", settings={"exposure": 1.0}, name="bright", asset=rug)
    session.layers.add("look", look="grade", settings={"saturation": -1.0}, name="grey", asset="")
    other = [{"blob": studio.send(splat_bytes(tmp_path, 4), "mat.ply")}]
    line = refusal(studio, "batch.plan", assets=other)
    assert line == "batch: several assets are open (asset, rug.ply); choose the one that is meant"
    assert refusal(studio, "batch.plan", assets=other, asset="nobody").startswith("asset: expected one of '', '")

    def made(**fields: Any) -> list[Path]:
        batch = planned(studio, asset=rug, **fields)
        assert "rug.ply" in batch["title"]
        folder = studio.studio.batches.get(batch["id"]).folder
        assert (outcome := run_batch(BatchConfig(folder / "batch.yaml"))).code == 0, outcome.lines
        return sorted((folder / "out").glob("*.ply"))

    (mat,) = made(assets=other)
    with Session(tmp_path / "asset4.ply") as alone:
        alone.layers.add("look", look="grade", settings={"exposure": 1.0})
        assert np.array_equal(read(mat).sh, alone.splats.sh)
    unnamed = mat.parents[1] / "unnamed.yaml"
    text = (mat.parents[1] / "batch.yaml").read_text().replace('"asset": "2"', '"asset": ""')
    unnamed.write_text(text.replace('"out": "out"', '"out": "unnamed"'))
    assert "expected asset to be one of 'asset', 'rug.ply', got ''" in run_batch(BatchConfig(unnamed)).lines[1]
    session.selections.save("all", np.ones(len(session.splats), np.float32))
    rows: list[dict[str, Any]] = [{"name": "plain"}, {"name": "red", "transfer": RED, "on": "selection", "of": "all"}]
    plain, red = made(variants=rows)
    assert plain.name == "rug-plain.ply" and np.array_equal(read(plain).sh, session.scene.splats_of(rug).sh)
    assert (read(red).sh[:, 0, 0] > read(red).sh[:, 0, 2]).all() and np.array_equal(read(red).means, read(plain).means)
    studio.post("layer.set", layer=bright.id, visible=False)
    assert "no visible layer of rug.ply to put" in refusal(studio, "batch.plan", assets=other, asset=rug)


def test_a_full_disk_and_too_many_results_are_one_line(
    studio: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paint(studio)
    blob = studio.send(splat_bytes(tmp_path), "a.ply")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "link", full)
        patch.setattr(shutil, "copyfile", full)
        line = refusal(studio, "batch.plan", assets=[{"blob": blob, "name": "a.ply"}])
        assert line == "a.ply: cannot be kept (No space left on device)"
    monkeypatch.setattr("splatpainter.server.batches.batch_folder.MAX_JOBS", 1)
    assert "expected at most 1 results, got 2" in refusal(studio, "batch.plan", assets=[{"blob": blob}] * 2)


def test_one_at_a_time_found_again_and_cancelled(studio: Live, tmp_path: Path, fake: Callable[..., None]) -> None:
    fake("d", "hang")
    variants = [{"name": name, "transfer": RED} for name in ("a", "b", "c")]
    with studio.greeted() as first:
        batch = planned(studio, variants=variants)
        studio.post("batch.start", batch=batch["id"])
        until(studio, lambda now: states(now) == ["done", "running", "queued"])
        assert refusal(studio, "batch.plan", variants=variants).startswith("batch: another one is running; cancel it")
        assert refusal(studio, "batch.start", batch=batch["id"]).startswith("batch: is running already")
        assert refusal(studio, "batch.discard", batch=batch["id"]).startswith("batch: is at work")
        batch = until(studio, lambda now: True)
        assert (
            batch["page_url"] is None
            and batch["jobs"][0]["line"] == "559 of 600 Gaussians unchanged, 7 appended, verified"
        )
        assert zipfile.ZipFile(io.BytesIO(studio.http.get(batch["zip_url"]).content)).namelist() == [
            "ball-a.ply", "ball-a.ply.receipt.json"
        ]  # fmt: skip
        with studio.greeted() as second:  # a page that was loaded again
            assert second.do("batch.status")["batch"] == batch
        first.do("batch.cancel", batch=batch["id"])
        batch = until(studio, lambda now: now["state"] == "cancelled")
        assert states(batch) == ["done", "cancelled", "cancelled"] and batch["page_url"]
        assert refusal(studio, "batch.cancel", batch=batch["id"]).startswith("batch: is cancelled; there is nothing")
        events = [event for event in first.events if event.get("event") == "batch"]
    assert [event["batch"]["state"] for event in events if event["batch"]][:2] == ["planned", "running"]
    assert {event["job"]["state"] for event in events if event["job"]} == {"running", "done"}
    again = planned(studio, variants=variants[:1])
    assert again["id"] != batch["id"] and studio.http.get(batch["zip_url"]).status_code == 404, "old results are gone"
    studio.post("batch.discard", batch=again["id"])
    assert studio.post("batch.status")["batch"] is None
    assert refusal(studio, "batch.start", batch=again["id"]) == "batch: no longer available; make it again"


def test_a_program_that_dies_fails_what_is_left(studio: Live, fake: Callable[..., None]) -> None:
    fake("df", "crash")
    batch = planned(studio, variants=[{"name": name, "transfer": RED} for name in ("a", "b", "c")])
    studio.post("batch.start", batch=batch["id"])
    batch = until(studio, lambda now: now["state"] == "done")
    assert states(batch) == ["done", "failed", "failed"]
    assert batch["jobs"][1]["line"] == "ball-b.ply: expected something else"
    assert batch["jobs"][2]["line"] == "the batch ended too early; it said: no memory left"


def test_nothing_but_results_can_be_downloaded(studio: Live, fake: Callable[..., None]) -> None:
    fake("df")
    batch = planned(studio, variants=[{"name": name, "transfer": RED} for name in ("a", "b")])
    root = f"/api/batch/{batch['id']}"
    assert studio.http.get(f"{root}/out/ball-a.ply").status_code == 404, "before it is made"
    studio.post("batch.start", batch=batch["id"])
    batch = until(studio, lambda now: now["state"] == "done")
    assert studio.http.get(batch["jobs"][0]["url"]).text == "out/ball-a.ply"
    assert batch["jobs"][1]["url"] is None
    hidden = [
        "batch.yaml",
        "project.splatproj",
        "summary.json",
        "..%2Fbatch.yaml",
        "%2e%2e/batch.yaml",
        "jobs",
        ".batch",
    ]
    for name in [
        *(f"out/{name}" for name in hidden),
        "out/ball-b.ply",
        "1/after.webp",
        "0/record.json",
        "-1/after.webp",
    ]:
        assert studio.http.get(f"{root}/{name}").status_code in (404, 422), name
    assert studio.http.get("/api/batch/0123456789abcdef/all.zip").status_code == 404
    foreign = {"origin": "http://evil.example"}
    assert studio.http.get(batch["zip_url"], headers=foreign).status_code == 403


def test_closing_the_studio_ends_the_program_and_removes_everything(tmp_path: Path, fake: Callable[..., None]) -> None:
    fake("d", "hang")
    studio = make_studio(tmp_path)
    with live(studio) as served:
        batch = planned(served, variants=[{"name": name, "transfer": RED} for name in ("a", "b")])
        served.post("batch.start", batch=batch["id"])
        until(served, lambda now: states(now) == ["done", "running"])
        child = studio.batches.get(batch["id"]).child
        folder = studio.batches.get(batch["id"]).folder
    assert child is not None and child.poll() is not None and not folder.exists() and not studio.scratch.path.exists()


def test_a_program_that_cannot_be_started_is_one_line(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = planned(studio, variants=[{"name": "a", "transfer": RED}])
    monkeypatch.setattr(batches, "PROGRAM", ("no-such-program",))
    assert refusal(studio, "batch.start", batch=batch["id"]).startswith("batch: cannot be started (No such file")


def test_one_that_does_not_end_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "PROGRAM", (sys.executable, "-S", "-c", "import time; time.sleep(600)"))
    monkeypatch.setattr(batches, "CANCEL_SECONDS", 0.1)
    room = Batches(tmp_path)
    folder_of = []

    def prepare(folder: Path):
        filled = BatchFolder(folder)
        write(filled.stem("a").with_suffix(".ply"), ball())
        filled.assets.append(folder / "assets" / "a.ply")
        filled.edits = [{"grade": {"exposure": 1}}]
        folder_of.append(folder)
        return filled.plan("", None), [""], "one"

    batch = room.make(prepare)
    room.start(batch.id)
    room.cancel(batch.id)
    assert batch.follower is not None
    batch.follower.join(PATIENCE_SECONDS)
    assert batch.state == "cancelled" and [job.state for job in batch.jobs] == ["cancelled"]
    room.close()
    assert not folder_of[0].exists()


def test_names_of_assets_become_plain_and_different(tmp_path: Path) -> None:
    folder = BatchFolder(tmp_path / "batch")
    given = [
        "a.ply",
        "x/../a.ply",
        "C:\\b\\A.ply",
        "..",
        "",
        "shoe[1]*{asset}.ply",
        "\u202enul\x00.ply",
        "con.ply",
        "é" * 99,
    ]
    names = [folder.stem(name, ".ply").name for name in given]
    assert names[:6] == ["a", "a-2", "A-3", "asset", "asset-2", "shoe(1)-(asset)"]
    assert names[6] == "-nul-" and names[7] == "asset-con" and names[8] == "é" * 50
    assert all(folder.stem(name).parent == tmp_path / "batch" / "assets" for name in given)
