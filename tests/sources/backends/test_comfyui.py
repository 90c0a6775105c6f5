"""The source `comfyui` against a server that speaks its interface: slots by title, uploads, the queue, progress by the
web socket and without, what a server complains of, and cancelling."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from splatpainter.sources.backends import comfyui, http
from splatpainter.sources.picture_source import PictureAnswer, PictureRequest, SourceCancelled, SourceError
from splatpainter.sources.registry import open_source
from tests.support.fake_services import Call, FakeService, Reply, pixels, png, serving
from tests.support.picture_requests import HEIGHT, WIDTH, HastyClock, Progressed, request

ID = "3a9c"


def node(kind: str, title: str = "", **inputs: Any) -> dict[str, Any]:
    return {"class_type": kind, "inputs": inputs, "_meta": {"title": title or kind}}


def graph() -> dict[str, Any]:
    """A workflow with every slot."""
    return {
        "1": node("LoadImage", "splatpainter:image", image="example.png", upload="image"),
        "2": node("LoadImageMask", "Splatpainter:Mask ", image="example.png", channel="alpha"),
        "3": node("LoadImage", "splatpainter:depth", image="example.png"),
        "4": node("LoadImage", "splatpainter:normal", image="example.png"),
        "5": node("CLIPTextEncode", "splatpainter:prompt", text="", clip=["9", 1]),
        "6": node("KSampler", "splatpainter:seed", seed=1, steps=20, positive=["5", 0]),
        "7": node("SaveImage", "splatpainter:out", images=["6", 0]),
        "8": node("PreviewImage", images=["6", 0]),
    }


class FakeComfyUI:
    """A server with a queue of one; `mode` says how a run goes."""

    def __init__(self, mode: str = "") -> None:
        self.mode = mode
        self.uploads: dict[str, bytes] = {}
        self.prompt: dict[str, Any] = {}
        self.queued = threading.Event()
        self.posts: list[tuple[str, Any]] = []
        self.answer = png(64, 48)

    def __call__(self, call: Call) -> Reply:
        path, query = urlsplit(call.path).path, parse_qs(urlsplit(call.path).query)
        if path == "/upload/image":
            parts = {name: (file, content) for name, file, content in call.form()}
            name, content = parts["image"]
            self.uploads[str(name)] = content
            return Reply({"name": name, "subfolder": "today", "type": "input"})
        if path == "/prompt":
            if self.mode == "reject":
                errors = [{"message": "Value not in list", "details": "ckpt_name: 'x' not in []"}]
                return Reply(
                    {
                        "error": {"message": "Prompt outputs failed validation"},
                        "node_errors": {"6": {"errors": errors, "class_type": "KSampler"}},
                    },
                    400,
                )
            self.prompt = call.json()
            self.queued.set()
            return Reply({"prompt_id": ID, "number": 1, "node_errors": {}})
        if path == f"/history/{ID}":
            return Reply({ID: self.history()} if self.mode != "hang" else {})
        if path == "/view":
            assert query == {"filename": ["b.png"], "subfolder": ["s p"], "type": ["output"]}
            return Reply(self.answer)
        if path == "/queue" and call.method == "GET":
            return Reply({"queue_running": [[1, ID, {}, {}, []]], "queue_pending": []})
        self.posts.append((path, call.json()))
        return Reply(b"")

    def history(self) -> dict[str, Any]:
        if self.mode == "error":
            message = {"node_id": "6", "node_type": "KSampler", "exception_message": "out of memory\n"}
            return {"outputs": {}, "status": {"status_str": "error", "messages": [["execution_error", message]]}}
        files = [{"filename": name, "subfolder": "s p", "type": "output"} for name in ("a.png", "b.png")]
        images = [] if self.mode == "no picture" else files
        return {"outputs": {"7": {"images": images}}, "status": {"status_str": "success", "completed": True}}

    def socket(self, call: Call, send: Callable[[Any], None]) -> None:
        assert parse_qs(urlsplit(call.path).query)["clientId"]
        assert self.queued.wait(10)
        send({"type": "status", "data": {"status": {"exec_info": {"queue_remaining": 3}}}})
        send(b"\0\0\0\1preview")
        send({"type": "executing", "data": {"node": "6", "prompt_id": ID}})
        send({"type": "progress", "data": {"value": 5, "max": 20, "prompt_id": ID, "node": "6"}})
        send({"type": "progress", "data": {"value": 9, "max": 10, "prompt_id": "another"}})
        if self.mode == "socket error":
            message = {"node_id": "6", "node_type": "KSampler", "exception_message": "out of memory"}
            send({"type": "execution_error", "data": {"prompt_id": ID, **message}})
        elif self.mode != "hang":
            send({"type": "executing", "data": {"node": None, "prompt_id": ID}})
        threading.Event().wait(0.3)


@pytest.fixture
def workflow(tmp_path: Path) -> Path:
    path = tmp_path / "rust.json"
    path.write_text(json.dumps(graph()), encoding="utf-8")
    return path


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[FakeService, FakeComfyUI]]:
    monkeypatch.setattr(comfyui, "HISTORY_SECONDS", 0.05)
    monkeypatch.setattr(http, "FIRST_WAIT_SECONDS", 0.01)
    comfy = FakeComfyUI()
    with serving(comfy) as service:
        service.socket = comfy.socket
        yield service, comfy


def edit(
    service: FakeService,
    workflow: Path,
    query: PictureRequest | None = None,
    progress: Progressed | None = None,
    **options: str,
) -> PictureAnswer:
    progress = progress or Progressed()
    source = open_source("comfyui", {"url": service.url, "workflow": str(workflow), **options})
    return source.edit(query or request("rust", True, 7, maps=True), progress, progress.cancel)


def test_there_and_back(server: tuple[FakeService, FakeComfyUI], workflow: Path) -> None:
    service, comfy = server
    progress = Progressed()
    answer = edit(service, workflow, progress=progress)
    assert answer.image.shape == (48, 64, 3) and (answer.seed, answer.model) == (7, "ComfyUI workflow rust.json")
    assert (0.25, "step 5 of 20") in progress.reports and (0.0, "KSampler") in progress.reports
    assert (0.0, "3 in the queue") in progress.reports and not any(share == 0.9 for share, _ in progress.reports)
    sent = comfy.prompt["prompt"]
    assert sent["5"]["inputs"] == {"text": "rust", "clip": ["9", 1]}
    assert sent["6"]["inputs"] == {"seed": 7, "steps": 20, "positive": ["5", 0]}
    assert sent["2"]["inputs"]["channel"] == "red"
    names = {slot: sent[number]["inputs"]["image"] for slot, number in zip("imdn", "1234", strict=True)}
    assert all(name.startswith("today/splatpainter_") for name in names.values())
    pictures = {slot: pixels(comfy.uploads[name.removeprefix("today/")]) for slot, name in names.items()}
    assert {slot: picture.shape[2:] for slot, picture in pictures.items()} == {"i": (3,), "m": (4,), "d": (), "n": (3,)}
    mask, half = pictures["m"], WIDTH // 2
    assert (mask[:, half:] == (255, 255, 255, 0)).all() and (mask[:, :half] == (0, 0, 0, 255)).all()
    depth, normal = pictures["d"], pictures["n"]
    assert (depth[:, :5] == 0).all() and depth[0, 10] == 255 and depth[-1, 10] == 26
    assert (normal == (128, 128, 255)).all()
    assert not comfy.posts


def test_without_a_socket(server: tuple[FakeService, FakeComfyUI], workflow: Path) -> None:
    service, _ = server
    service.socket = None
    assert edit(service, workflow).image.shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("mode", "line"),
    [
        (
            "reject",
            "failed validation node 6 (KSampler): Value not in list (ckpt_name: 'x'",
        ),
        ("error", "stopped in node 6 (KSampler): out of memory"),
        ("socket error", "stopped in node 6 (KSampler): out of memory"),
        ("no picture", "ended without a picture from splatpainter:out (node 7, SaveImage); expected a node that saves"),
    ],
)
def test_runs_that_go_wrong(server: tuple[FakeService, FakeComfyUI], workflow: Path, mode: str, line: str) -> None:
    service, comfy = server
    comfy.mode = mode
    with pytest.raises(SourceError) as error:
        edit(service, workflow)
    assert line in str(error.value) and "\n" not in str(error.value)


def test_a_server_that_is_another(workflow: Path) -> None:
    with serving(lambda call: Reply(b"<html><title>Router</title>", headers={"Content-Type": "text/html"})) as service:
        with pytest.raises(SourceError, match=r"a web page \(Router\) in place of JSON"):
            edit(service, workflow)
    with pytest.raises(SourceError, match="cannot be reached at 127.0.0.1"):
        edit(service, workflow)


def test_cancel_interrupts_this_run_alone(server: tuple[FakeService, FakeComfyUI], workflow: Path) -> None:
    service, comfy = server
    comfy.mode = "hang"
    with pytest.raises(SourceCancelled):
        edit(service, workflow, progress=Progressed("step 5"))
    assert comfy.posts == [("/queue", {"delete": [ID]}), ("/interrupt", {"prompt_id": ID})]


def test_a_run_that_takes_too_long(
    server: tuple[FakeService, FakeComfyUI], workflow: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service, comfy = server
    comfy.mode = "hang"
    clock = HastyClock("step 5")
    monkeypatch.setattr(http, "time", clock)
    with pytest.raises(SourceError, match="gave no answer within 600 seconds"):
        edit(service, workflow, progress=clock.progress(), timeout="600")
    assert comfy.posts[-1] == ("/interrupt", {"prompt_id": ID})


def test_it_takes_what_its_workflow_has(server: tuple[FakeService, FakeComfyUI], workflow: Path) -> None:
    service, comfy = server
    little = {number: graph()[number] for number in ("1", "7")}
    workflow.write_text(json.dumps({"prompt": little}), encoding="utf-8")
    for query in (request("rust"), request(mask=True), request(seed=1)):
        with pytest.raises(SourceError, match="does not take a"):
            edit(service, workflow, query)
    assert edit(service, workflow, request()).image.shape == (48, 64, 3)
    assert list(comfy.uploads) and pixels(next(iter(comfy.uploads.values()))).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("{", "expected a workflow, got no JSON"),
        ("[]", "expected a workflow in API format"),
        ('{"1": {}}', "expected a workflow in API format"),
        ('{"1": {"class_type": "A"}}', "expected nodes with inputs"),
        ('{"nodes": [], "links": []}', "is saved for the editor; export it for the API"),
        (
            json.dumps({"1": node("LoadImage", image="x"), "2": node("SaveImage", "Save it")}),
            "no node is titled splatpainter:image or splatpainter:out; there are LoadImage, Save it; give the nodes",
        ),
        (
            json.dumps({"1": node("A", "splatpainter:imag", image="x")}),
            "no slot 'splatpainter:imag'; there are ",
        ),
        (json.dumps(graph() | {"9": node("SaveImage", "splatpainter:out")}), "2 nodes are titled splatpainter:out"),
        (
            json.dumps(graph() | {"5": node("CLIPTextEncode", "splatpainter:prompt", text=["4", 0])}),
            "node 5 (CLIPTextEncode) is titled splatpainter:prompt and has no input of its own for it; expected text",
        ),
    ],
)
def test_workflows_that_are_refused(tmp_path: Path, content: str, line: str) -> None:
    path = tmp_path / "w.json"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(SourceError) as error:
        open_source("comfyui", {"workflow": str(path)})
    assert line in str(error.value)


def test_a_workflow_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such file; expected a workflow in API format"):
        open_source("comfyui", {"workflow": str(tmp_path / "w.json")})
