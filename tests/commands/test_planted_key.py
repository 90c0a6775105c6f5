"""A key that is planted in the environment gets into no file, no message and no log: commands, batches and the studio,
against a service that says it back wherever it can."""

from __future__ import annotations

import base64
import io
import json
import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import orbit_cameras
from splatpainter.io import write
from splatpainter.source_edits import coverage
from tests.source_edits.test_edit import patterned
from tests.support.cli_scenes import Capture, run
from tests.support.fake_services import Call, FakeService, Reply, serving, text64
from tests.support.studio_scenes import live, make_studio, wire

KEY = "sk-planted-0123456789abcdef"
FORMS = {KEY.encode(), base64.b64encode(KEY.encode()), KEY[::-1].encode(), KEY.encode("utf-16-le")}


def answer(call: Call) -> Reply:
    """The picture with its channels exchanged; the key is said back in every field that a service fills. Prompts that
    ask for it get an error with it."""
    assert call.headers["authorization"] == f"Bearer {KEY}"
    parts = {name: content for name, file, content in call.form()}
    if parts["prompt"] == b"fail":
        return Reply({"error": {"message": f"Incorrect API key provided: {KEY}"}}, 401)
    with Image.open(io.BytesIO(parts.get("image") or parts["image[]"])) as picture:
        pixels = np.asarray(picture.convert("RGB"))[..., [2, 0, 1]]
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    entry = {"b64_json": text64(file.getvalue()), "revised_prompt": f"your key is {KEY}"}
    return Reply({"data": [entry], "model": KEY, "usage": {"total_tokens": 9, "key": KEY}})


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeService]:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setattr(coverage, "CANDIDATE_VIEWS", 8)
    with serving(answer) as server:
        monkeypatch.setenv("OPENAI_BASE_URL", f"{server.url}/v1")
        yield server


def leaks(folder: Path) -> list[str]:
    """Files under a folder that hold the key, as it is, in another form, or compressed in a PNG."""
    out = []
    for path in folder.rglob("*"):
        data = path.read_bytes() if path.is_file() else b""
        if data.startswith(b"\x89PNG"):
            with Image.open(path) as picture:
                data += repr(picture.info).encode()
        if any(form in data for form in FORMS) or KEY in path.name:
            out.append(path.name)
    return out


def test_it_is_recognised_where_it_is(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(f"key={KEY}")
    picture = Image.new("RGB", (4, 4))
    picture.save(tmp_path / "b.png", pnginfo=_text(KEY))
    assert sorted(leaks(tmp_path)) == ["a.txt", "b.png"]


def _text(words: str):
    from PIL import PngImagePlugin

    info = PngImagePlugin.PngInfo()
    info.add_text("note", words, zip=True)
    return info


def test_commands_keep_it_to_themselves(
    service: FakeService, tmp_path: Path, capfd: Capture, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    splats = patterned(400)
    write(tmp_path / "ball.ply", splats)
    (camera,) = orbit_cameras(splats, 1, size=64)
    (tmp_path / "cam.json").write_text(camera.to_json())
    source = ("--source", "openai", "--prompt")
    edit = ("edit", tmp_path / "ball.ply", "--view", tmp_path / "cam.json", *source)
    report = ("--source-report", tmp_path / "report.png")
    done = run(capfd, *edit, "moss", "--out", tmp_path / "out.ply", *report, "--json")
    assert done.code == 0, done.err
    failed = run(capfd, *edit, "fail", "--out", tmp_path / "no.ply")
    assert "refused the key in OPENAI_API_KEY" in failed.error
    listed = run(capfd, "source", "list", "openai")
    Image.new("RGB", (32, 32), "red").save(tmp_path / "view.png")
    tried = run(capfd, "source", "try", "openai", tmp_path / "view.png", "--prompt", "x", "--out", tmp_path / "try.png")
    jobs = {
        "assets": ["ball.ply"],
        "out": "made",
        "edits": [{"source": {"name": "openai", "prompt": "{variant}", "view": "cam.json"}}],
    }
    jobs["variants"] = [{"name": "moss"}, {"name": "fail"}]
    (tmp_path / "jobs.yaml").write_text(json.dumps(jobs))
    batch = run(capfd, "batch", tmp_path / "jobs.yaml")
    assert tried.code == 0 and batch.code == 1 and "refused the key" in batch.out
    words = "".join(one.out + one.err for one in (done, failed, listed, tried, batch))
    assert KEY not in words + caplog.text and "OPENAI_API_KEY" in words
    assert len(service.calls) == 5 and leaks(tmp_path) == []
    assert json.loads((tmp_path / "out.ply.receipt.json").read_text())["source"]["prompt"] == "moss"


def test_the_studio_keeps_it_to_itself(service: FakeService, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    splats = patterned(400)
    camera = wire(orbit_cameras(splats, 1, size=64)[0])
    with live(make_studio(tmp_path, splats)) as served:
        answers = [served.http.post("/api/do/source.list", json={}).text]
        fields = {"source": "openai", "prompt": "moss"}
        answers.append(json.dumps(served.post("source.cover", **fields, views=[camera], method="lift")))
        edited = served.post("source.edit", **fields, camera=camera)
        views = [{key: edited[key] for key in ("camera", "picture", "mask")}]
        answers += [json.dumps(edited), json.dumps(served.post("edit", kind="picture", views=views, method="lift"))]
        refused = served.http.post("/api/do/source.edit", json={**fields, "prompt": "fail", "camera": camera})
        assert "refused the key in OPENAI_API_KEY" in refused.text
        answers += [refused.text, served.http.get("/api/state").text, json.dumps(served.post("receipt"))]
        folder = served.studio.blobs.folder
        assert leaks(folder) == []
        served.studio.session.files.export(tmp_path / "out.ply")
        records = served.studio.session.files.receipt().source
    assert records is not None and [record["prompt"] for record in records["layers"]] == ["moss", "moss"]
    assert KEY not in "".join(answers) + caplog.text and leaks(tmp_path) == []
    assert (tmp_path / "own.splatproj").stat().st_size > 0
