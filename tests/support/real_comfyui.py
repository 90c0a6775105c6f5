"""A real ComfyUI server for opt-in tests: SPLATPAINTER_COMFYUI names a checkout of it, SPLATPAINTER_COMFYUI_PYTHON the
interpreter that it runs in (else the one of its folder venv or .venv, else this one).

The server gets a base directory of its own (--base-directory), so nothing is written into the checkout."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

FOLDER, PYTHON = "SPLATPAINTER_COMFYUI", "SPLATPAINTER_COMFYUI_PYTHON"
START_SECONDS, RUN_SECONDS = 180, 120
REPOSITORY = Path(__file__).parents[2]
PACK = REPOSITORY / "integrations" / "comfyui"
SLOW_NODE = '''
import time
import comfy.utils
from comfy.model_management import throw_exception_if_processing_interrupted


class SlowImage:
    """Hands a picture on after some steps of a tenth of a second."""

    INPUT_TYPES = classmethod(lambda cls: {"required": {
        "image": ("IMAGE",),
        "steps": ("INT", {"default": 10, "min": 0, "max": 10000}),
        "seed": ("INT", {"default": 0, "min": 0, "max": 2**63}),
        "text": ("STRING", {"default": ""}),
    }})
    RETURN_TYPES, FUNCTION, CATEGORY = ("IMAGE",), "run", "test"

    def run(self, image, steps, seed, text):
        if text == "fail":
            raise RuntimeError("the model says no\\nin two lines")
        bar = comfy.utils.ProgressBar(steps)
        for _ in range(steps):
            throw_exception_if_processing_interrupted()
            time.sleep(0.1)
            bar.update(1)
        return (image,)


NODE_CLASS_MAPPINGS = {"SlowImage": SlowImage}
'''


class RealComfyUI:
    """A running server; base: its folder, with input, output, temp and custom_nodes."""

    def __init__(self, url: str, base: Path, log: Path) -> None:
        self.url, self.base, self.log = url, base, log

    def get(self, path: str) -> Any:
        with urllib.request.urlopen(self.url + path, timeout=30) as response:
            return json.load(response)

    def post(self, path: str, content: Any) -> tuple[int, Any]:
        """(status, JSON of the answer or None)."""
        headers = {"Content-Type": "application/json"}
        request = urllib.request.Request(self.url + path, json.dumps(content).encode(), headers)
        try:
            with urllib.request.urlopen(request, timeout=60) as response:
                status, body = response.status, response.read()
        except urllib.error.HTTPError as error:
            status, body = error.code, error.read()
        return status, json.loads(body) if body else None

    def run(self, graph: dict[str, Any]) -> dict[str, Any]:
        """The history of a workflow in API format once it ended."""
        status, answer = self.post("/prompt", {"prompt": graph})
        assert status == 200, answer
        until = time.monotonic() + RUN_SECONDS
        while time.monotonic() < until:
            history = self.get(f"/history/{answer['prompt_id']}")
            if history:
                return history[answer["prompt_id"]]
            time.sleep(0.1)
        raise AssertionError(f"no end within {RUN_SECONDS} s: {self.log.read_text()[-2000:]}")

    def api_graph(self, document: dict[str, Any]) -> dict[str, Any]:
        """A workflow of the page's format in API format, as the page exports it: values of widgets in the order of the
        server's own descriptions."""
        described = self.get("/object_info")
        links = {link[0]: [str(link[1]), link[2]] for link in document["links"]}
        graph = {}
        for node in document["nodes"]:
            if node["type"] == "Note":
                continue
            info = described[node["type"]]
            inputs = {slot["name"]: links[slot["link"]] for slot in node["inputs"] if slot["link"] is not None}
            values = iter(node["widgets_values"])
            for group in ("required", "optional"):
                for name in info["input_order"].get(group, ()):
                    kind, *options = info["input"][group][name]
                    forced = bool(options) and options[0].get("forceInput", False)
                    if not forced and (
                        isinstance(kind, list) or kind in ("STRING", "INT", "FLOAT", "BOOLEAN", "COMBO")
                    ):
                        inputs[name] = next(values)
            graph[str(node["id"])] = {"class_type": node["type"], "inputs": inputs, "_meta": {"title": node["type"]}}
        return graph


@contextlib.contextmanager
def running_comfyui(base: Path) -> Iterator[RealComfyUI]:
    """A server with this repository's node pack, as long as the block lasts; skips the test where there is none."""
    folder = os.environ.get(FOLDER, "")
    if not folder:
        pytest.skip(f"set {FOLDER} to a ComfyUI checkout to run this")
    candidates = [os.environ.get(PYTHON, ""), f"{folder}/venv/bin/python", f"{folder}/.venv/bin/python"]
    python = next((name for name in candidates if name and Path(name).exists()), sys.executable)
    for name in ("custom_nodes", "input", "output", "temp", "user", "models"):
        (base / name).mkdir(parents=True)
    shutil.copytree(PACK, base / "custom_nodes" / "splatpainter", ignore=shutil.ignore_patterns("__pycache__"))
    (base / "custom_nodes" / "slow_image.py").write_text(SLOW_NODE, encoding="utf-8")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = ["--cpu", "--base-directory", str(base), "--port", str(port), "--disable-api-nodes"]
    variables = {**os.environ, "PYTHONPATH": str(REPOSITORY / "src")}
    server = RealComfyUI(f"http://127.0.0.1:{port}", base, base / "log.txt")
    with server.log.open("wb") as log:
        process = subprocess.Popen(
            [python, "main.py", *words], cwd=folder, env=variables, stdout=log, stderr=subprocess.STDOUT
        )
    try:
        until = time.monotonic() + START_SECONDS
        while True:
            with contextlib.suppress(OSError):
                server.get("/system_stats")
                break
            assert process.poll() is None and time.monotonic() < until, server.log.read_text()[-4000:]
            time.sleep(0.2)
        yield server
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(20)
