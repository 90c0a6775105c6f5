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


FAILURE = {"node_id": "6", "node_type": "KSampler", "executed": [], "exception_message": "out of\nmemory\n"}
INTERRUPTION = {"node_id": "6", "node_type": "KSampler", "executed": []}


def invalid(outputs: list[str]) -> dict[str, Any]:
    """node_errors of a KSampler without its sampler, by which these outputs are not made."""
    details = "sampler_name: 'x' not in ['euler']"
    error = {"type": "value_not_in_list", "message": "Value not in list", "details": details, "extra_info": {}}
    return {"6": {"errors": [error], "dependent_outputs": outputs, "class_type": "KSampler"}}


class FakeComfyUI:
    """A server with a queue of one, which says what ComfyUI 0.3.64 said in tests/integrations/test_real_comfyui.py;
    `mode` says how a run goes."""

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
                message = "Prompt outputs failed validation"
                error = {"type": "prompt_outputs_failed_validation", "message": message, "details": ""}
                return Reply({"error": {**error, "extra_info": {}}, "node_errors": invalid(["7", "8"])}, 400)
            if self.mode == "no such node":
                message = "Cannot execute because node Rusty does not exist."
                error = {"type": "invalid_prompt", "message": message, "details": "Node ID '#6'", "extra_info": {}}
                return Reply({"error": error, "node_errors": {}}, 400)
            self.prompt = call.json()
            self.queued.set()
            parts = {"other part": ["8"], "our part": ["7"]}
            errors = invalid(parts[self.mode]) if self.mode in parts else {}
            return Reply({"prompt_id": ID, "number": 1, "node_errors": errors})
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
        messages: list[Any] = [["execution_start", {"prompt_id": ID}], ["execution_cached", {"nodes": ["1"]}]]
        failed = {"status_str": "error", "completed": False}
        if self.mode == "error":
            return {"outputs": {}, "status": {**failed, "messages": [*messages, ["execution_error", FAILURE]]}}
        if self.mode == "interrupted":
            last = ["execution_interrupted", INTERRUPTION]
            return {"outputs": {}, "status": {**failed, "messages": [*messages, last]}}
        files = [{"filename": name, "subfolder": "s p", "type": "output"} for name in ("a.png", "b.png")]
        images = [] if self.mode == "no picture" else files
        status = {"status_str": "success", "completed": True, "messages": [*messages, ["execution_success", {}]]}
        return {"prompt": [1, ID, {}, {}, ["7"]], "outputs": {"7": {"images": images}}, "status": status, "meta": {}}

    def socket(self, call: Call, send: Callable[[Any], None]) -> None:
        """The messages of a run, in their order; those of a progress_state repeat what the others say."""
        client = parse_qs(urlsplit(call.path).query)["clientId"][0]

        def say(kind: str, **data: Any) -> None:
            send({"type": kind, "data": data})

        def node_runs(number: str) -> None:
            say("progress_state", prompt_id=ID, nodes={number: {"value": 0.0, "max": 1.0, "state": "running"}})
            say("executing", node=number, display_node=number, prompt_id=ID)

        say("status", status={"exec_info": {"queue_remaining": 2}}, sid=client)
        assert self.queued.wait(10)
        say("status", status={"exec_info": {"queue_remaining": 3}})
        say("execution_start", prompt_id=ID, timestamp=1795421195679)
        say("execution_cached", nodes=["1", "2", "3", "4"], prompt_id=ID, timestamp=1795421195681)
        node_runs("5")
        node_runs("6")
        send(b"\0\0\0\1preview")
        say("status", status={"exec_info": {"queue_remaining": 9}})
        say("progress", value=5, max=20, prompt_id=ID, node="6")
        say("progress", value=9, max=10, prompt_id="another", node="6")
        if self.mode == "socket error":
            say("execution_error", prompt_id=ID, **FAILURE)
        elif self.mode == "socket interrupted":
            say("execution_interrupted", prompt_id=ID, **INTERRUPTION)
        elif self.mode != "hang":
            say("executed", node="7", display_node="7", output={"images": []}, prompt_id=ID)
            say("execution_success", prompt_id=ID, timestamp=1795421195919)
            say("status", status={"exec_info": {"queue_remaining": 0}})
            say("executing", node=None, prompt_id=ID)
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
    assert progress.reports[1:] == [
        (0.0, "2 in the queue"),
        (0.0, "3 in the queue"),
        (4 / 8, "CLIPTextEncode"),
        (5 / 8, "KSampler"),
        (5.25 / 8, "step 5 of 20"),
    ]
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
            "failed validation: node 6 (KSampler): Value not in list (sampler_name: 'x'",
        ),
        ("no such node", "refused the request (400: Cannot execute because node Rusty does not exist. (Node ID '#6'))"),
        ("our part", "refused the workflow: node 6 (KSampler): Value not in list (sampler_name: 'x'"),
        ("interrupted", "stopped: it was interrupted on the server"),
        ("socket interrupted", "was interrupted on the server"),
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


def test_a_part_that_the_answer_does_not_need_may_fail(server: tuple[FakeService, FakeComfyUI], workflow: Path) -> None:
    service, comfy = server
    comfy.mode = "other part"
    answer = edit(service, workflow)
    assert answer.notes[0].startswith("the server left out a part of the workflow: node 6 (KSampler): Value not")
    comfy.mode = "our part"
    with pytest.raises(SourceError):
        edit(service, workflow)
    assert comfy.posts == [("/queue", {"delete": [ID]}), ("/interrupt", {"prompt_id": ID})]  # nothing runs on


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
        ("{", "expected a workflow as JSON"),
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
