"""A workflow of ComfyUI as a source: a file in its API format whose nodes say by their titles what goes where.

    splatpainter:image   the view, into a node that loads a picture (LoadImage)
    splatpainter:mask    white may change (LoadImageMask, or LoadImage by either output)
    splatpainter:depth   near is bright; splatpainter:normal: B towards the viewer; as control networks want them
    splatpainter:prompt  into the node's text (CLIPTextEncode, or any text or prompt)
    splatpainter:seed    into its seed (KSampler, RandomNoise)
    splatpainter:out     the node whose picture is the answer (SaveImage, PreviewImage)

Interface: POST /upload/image and /prompt, progress by the web socket, GET /history/{id} and /view; a request that is
cancelled leaves the queue, or is interrupted where it is the one that runs.
"""

from __future__ import annotations

import asyncio
import contextlib
import copy
import hashlib
import json
import os
import uuid
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import numpy as np

from splatpainter.image_files import encode_png, quantized
from splatpainter.sources.answer_pictures import depth_png, image_png, normal_png, read_answer
from splatpainter.sources.backends.http import (
    MAX_FILE_BYTES,
    Service,
    at,
    check_url,
    is_open,
    node_errors,
    require_httpx,
    run,
)
from splatpainter.sources.picture_source import (
    CancelFlag,
    Capabilities,
    PictureAnswer,
    PictureRequest,
    Progress,
    SourceError,
)
from splatpainter.sources.source_options import SourceDescription, option
from splatpainter.system.quick_dataclass import dataclass

KEYS = ("COMFYUI_API_KEY",)
PREFIX = "splatpainter:"
SLOTS = ("image", "mask", "depth", "normal", "prompt", "seed", "out")
PICTURES = ("image", "mask", "depth", "normal")
SLOT_INPUTS = {
    "prompt": ("text", "prompt", "string", "value", "text_g", "text_l", "clip_l", "t5xxl"),
    "seed": ("seed", "noise_seed", "value", "int"),
}
"""Names of inputs that a slot is written to: all of them that the node has and that are no links."""
MAX_WORKFLOW_BYTES = 16 << 20
MAX_MESSAGE_BYTES = 64 << 20
"""Most bytes of a message of the socket: previews come by it too."""
HISTORY_SECONDS = 0.5
"""Seconds between looks at the history where the socket is silent or closed."""

CLOSE_SECONDS = 0.3
"""Seconds that a server has to say goodbye."""


@dataclass(frozen=True)
class ComfyUIOptions:
    """Options of the source `comfyui`."""

    workflow: Path = option(
        "Workflow in API format (File > Export (API)), with nodes titled splatpainter:image and splatpainter:out"
    )
    url: str = option("Address of the server", "http://127.0.0.1:8188")
    timeout: float = option("Seconds for one picture, its time in the queue included", 600.0, least=0.1)


DESCRIPTION = SourceDescription(
    name="comfyui",
    summary="a workflow on a ComfyUI server",
    options=ComfyUIOptions,
    takes="what its workflow has nodes for: splatpainter:image, mask, prompt, depth, normal, seed, out",
    keys=KEYS,
    key_optional=True,
    modules=("httpx", "websockets"),
    extra="comfyui",
)


def open_source(options: ComfyUIOptions) -> ComfyUISource:
    """Raises SourceError: a workflow that cannot be read or lacks its slots, no address, httpx missing."""
    return ComfyUISource(options)


class ComfyUISource:
    """One workflow on one server."""

    name = "comfyui"

    def __init__(self, options: ComfyUIOptions) -> None:
        require_httpx("comfyui")
        self.options = options
        self.url = check_url("comfyui", "url", options.url)
        self.workflow = read_workflow(options.workflow)
        self.slots = find_slots(self.workflow, options.workflow.name)
        self.capabilities = Capabilities(
            prompt="prompt" in self.slots,
            mask="mask" in self.slots,
            seed="seed" in self.slots,
            maps=frozenset({"depth", "normal"} & {*self.slots}),
            max_side_px=8192,
            hint="title a node of the workflow splatpainter:prompt, mask, seed, depth or normal to let it take that",
        )

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """Run the workflow once. Raises SourceError with what the server says; SourceCancelled."""
        # The key is optional (`key_optional`): without one no header says so.
        key = os.environ.get(KEYS[0], "").strip()
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        job = ComfyJob(Service("comfyui", self.url, headers, progress, KEYS), headers, progress)
        # One loop for all of it: upload, queue, progress and answer share one timeout and one cancel.
        body = run(lambda: job.run(self.workflow, self.slots, request), "comfyui", self.options.timeout, cancel)
        image, notes = read_answer(body, "comfyui")
        notes = (*notes, *job.notes)
        # A key by plain http can be read on its way; that is said and not refused.
        if key and is_open(self.url):
            notes = (
                *notes,
                f"the key went to {job.service.host} by http, which anybody on the way can read; use https",
            )
        # Only a workflow with a node for it has used the seed.
        seed = request.seed if "seed" in self.slots else None
        return PictureAnswer(image, model=f"ComfyUI workflow {self.options.workflow.name}", seed=seed, notes=notes)


def read_workflow(path: Path) -> dict[str, Any]:
    """Node number -> node. Raises SourceError: unreadable, no JSON, the editor's format, no workflow."""
    try:
        # The size is looked at first: a workflow is JSON, and JSON of any length would fill the memory.
        if not path.is_file():
            raise SourceError(f"source comfyui: {path}: no such file; expected a workflow in API format")
        if path.stat().st_size > MAX_WORKFLOW_BYTES:
            raise SourceError(f"source comfyui: {path}: expected at most {MAX_WORKFLOW_BYTES >> 20} MiB")
        data = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SourceError(f"source comfyui: {path}: cannot be read ({error.strerror})") from None
    except SourceError:
        raise
    except (ValueError, RecursionError):
        raise SourceError(f"source comfyui: {path}: expected a workflow as JSON") from None
    # Files are saved in several shapes; what was posted to the server has the workflow one level deeper.
    if isinstance(data, dict) and isinstance(data.get("prompt"), dict) and "class_type" not in data["prompt"]:
        data = data["prompt"]  # as it was posted
    # The editor's format is what people save by habit; the line says what to export instead.
    if isinstance(data, dict) and isinstance(data.get("nodes"), list):
        raise SourceError(
            f"source comfyui: {path}: is saved for the editor; export it for the API (File > Export (API))"
        )
    nodes = data if isinstance(data, dict) else {}
    # Every node is looked at here, so that all code below may rely on class_type and inputs.
    if not nodes or not all(isinstance(at(node, "class_type"), str) for node in nodes.values()):
        raise SourceError(f"source comfyui: {path}: expected a workflow in API format (class_type, inputs)")
    if not all(isinstance(node.get("inputs"), dict) for node in nodes.values()):
        raise SourceError(f"source comfyui: {path}: expected nodes with inputs")
    return nodes


def find_slots(workflow: dict[str, Any], name: str) -> dict[str, list[str]]:
    """Slot -> the numbers of its nodes. Raises SourceError: no image or no out (with the titles that there are), a
    title that is no slot, a node that cannot take what its title says."""
    # Titles are what people can set in the editor and see again; numbers change with every export.
    titles = {number: str(at(node, "_meta", "title") or node["class_type"]) for number, node in workflow.items()}
    slots: dict[str, list[str]] = {}
    for number, title in titles.items():
        words = title.strip().lower()
        if words.startswith(PREFIX):
            slot = words.removeprefix(PREFIX).strip()
            # A title with the prefix is meant for us, so a misspelt one is an error and not a node to pass over.
            if slot not in SLOTS:
                listed = ", ".join(PREFIX + slot for slot in SLOTS)
                raise SourceError(f"source comfyui: {name}: no slot {title.strip()[:60]!r}; there are {listed}")
            slots.setdefault(slot, []).append(number)
    missing = [PREFIX + slot for slot in ("image", "out") if slot not in slots]
    if missing:
        # The titles that there are show what was misspelt or not exported.
        listed = ", ".join(dict.fromkeys(title.strip()[:40] for title in titles.values()))[:300]
        raise SourceError(
            f"source comfyui: {name}: no node is titled {' or '.join(missing)}; there are {listed}; "
            "give the nodes these titles in ComfyUI and export again"
        )
    # With two outputs it would be chance which picture is the answer.
    if len(slots["out"]) > 1:
        raise SourceError(f"source comfyui: {name}: {len(slots['out'])} nodes are titled {PREFIX}out; expected one")
    # A node that cannot take its slot would leave the picture out without a word.
    for slot, numbers in slots.items():
        for number in numbers:
            node = workflow[number]
            if slot != "out" and not _inputs(node, slot):
                listed = ", ".join(SLOT_INPUTS.get(slot, ("image",)))
                raise SourceError(
                    f"source comfyui: {name}: node {number} ({node['class_type']}) is titled {PREFIX}{slot} and has no "
                    f"input of its own for it; expected {listed}"
                )
    return slots


def _inputs(node: dict[str, Any], slot: str) -> list[str]:
    """Inputs of a node that a slot is written to; links, which are lists, are left alone."""
    # A picture's input holds a file name; a link in its place says that another node feeds it.
    if slot in PICTURES:
        return [name for name in ("image",) if isinstance(node["inputs"].get(name), str)]
    kinds = (str,) if slot == "prompt" else (int, float)
    return [name for name in SLOT_INPUTS[slot] if isinstance(node["inputs"].get(name), kinds)]


class ComfyJob:
    """One run of a workflow, within the loop of `run`."""

    def __init__(self, service: Service, headers: dict[str, str], progress: Progress) -> None:
        self.service, self._headers, self._progress = service, headers, progress
        self._prompt_id = ""
        self._nodes, self._done, self._node = 1, 0, ""
        self.notes: tuple[str, ...] = ()
        """What the server complained of that the answer does not depend on."""

    async def run(self, workflow: dict[str, Any], slots: dict[str, list[str]], request: PictureRequest) -> bytes:
        """The picture file of the slot `out`."""
        try:
            # Pictures are uploaded first: the graph names them by what the server called them.
            self._progress(0.0, f"sending to {self.service.host}")
            graph = await self._filled(workflow, slots, request)
            client = uuid.uuid4().hex
            # The socket is open before the run is queued, or its first messages would be missed.
            async with self._socket(client) as socket:
                answer = await self.service.json("POST", "/prompt", json={"prompt": graph, "client_id": client})
                self._prompt_id, self._nodes = str(at(answer, "prompt_id") or ""), len(graph)
                # Taken or not is known at once; waiting for a run that was refused would last until the timeout.
                await self._check_taken(answer, slots["out"][0])
                history = await self._finished(socket, graph)
        except asyncio.CancelledError:
            # A run that nobody waits for would still hold the server's GPU.
            if self._prompt_id:
                with contextlib.suppress(Exception):
                    await self._give_up()
            raise
        return await self._picture(history, slots["out"][0], graph)

    async def _check_taken(self, answer: Any, out: str) -> None:
        """A server runs what it can of a workflow: where only other outputs have errors, the answer comes all the same.
        Raises SourceError: it did not take the part of `out`; the rest is taken back."""
        errors = node_errors(answer)
        entries = at(answer, "node_errors")
        # Only errors that the output depends on matter; the server leaves out the rest of the workflow.
        taken = self._prompt_id and not any(
            number == out or out in (at(entry, "dependent_outputs") or [out])
            for number, entry in (entries.items() if isinstance(entries, dict) else ())
        )
        if not taken:
            # A part that was taken although the output was not is taken back.
            if self._prompt_id:
                await self._give_up()
            raise self.service.error(f"refused the workflow: {errors or 'it gave no number'}")
        if errors:
            self.notes = (f"the server left out a part of the workflow: {errors}",)

    async def _filled(
        self, workflow: dict[str, Any], slots: dict[str, list[str]], request: PictureRequest
    ) -> dict[str, Any]:
        # A copy: one workflow serves many requests.
        graph = copy.deepcopy(workflow)
        contents = {
            "image": lambda: image_png(request),
            "mask": lambda: mask_rgba_png(request),
            "depth": lambda: depth_png(request),
            "normal": lambda: normal_png(request),
        }
        # Each picture is uploaded once, however many nodes want it.
        for slot, numbers in slots.items():
            name = await self._upload(contents[slot](), slot) if slot in PICTURES else ""
            for number in numbers:
                inputs = graph[number]["inputs"]
                for key in _inputs(graph[number], slot) if slot != "out" else ():
                    if slot in PICTURES:
                        inputs[key] = name
                    elif slot == "prompt":
                        inputs[key] = request.prompt
                    elif request.seed is not None:
                        # Without a seed the workflow keeps its own.
                        inputs[key] = request.seed
                # Grey is the same in every channel but alpha, where it is the other way round.
                if slot == "mask" and isinstance(inputs.get("channel"), str):
                    inputs["channel"] = "red"
        return graph

    async def _upload(self, png: bytes, slot: str) -> str:
        # Named by its contents: the same picture sent again takes no further room on the server.
        name = f"splatpainter_{slot}_{hashlib.sha256(png).hexdigest()[:16]}.png"
        files = {"image": (name, png, "image/png")}
        answer = await self.service.json("POST", "/upload/image", files=files, data={"overwrite": "true"})
        stored, folder = at(answer, "name"), at(answer, "subfolder")
        # The server may store under another name; what it says is what nodes have to name.
        if not isinstance(stored, str) or not stored:
            raise self.service.error("accepted a picture without naming it; is this a ComfyUI server?")
        return f"{folder}/{stored}" if isinstance(folder, str) and folder else stored

    @contextlib.asynccontextmanager
    async def _socket(self, client: str) -> AsyncIterator[Any]:
        """The web socket, or None where there is none: then only the history says how far it is."""
        # Progress is a comfort: without the library or the socket the history still says when it ends.
        try:
            from websockets.asyncio.client import connect
        except ImportError:
            yield None
            return
        url = "ws" + self.service.base_url.removeprefix("http") + f"/ws?clientId={client}"
        try:
            # A socket that does not open in time must not hold up the run.
            connection = await connect(
                url,
                max_size=MAX_MESSAGE_BYTES,
                open_timeout=10,
                close_timeout=CLOSE_SECONDS,
                proxy=None,
                additional_headers=self._headers,
            )
        except Exception:  # refused, no socket behind this proxy, not in time: the history answers as well
            yield None
            return
        try:
            yield connection
        finally:
            # A server that does not say goodbye must not hold the answer back.
            try:
                with contextlib.suppress(Exception):
                    await connection.close()
            finally:
                connection.transport.abort()  # nothing, where it is closed

    async def _finished(self, socket: Any, graph: dict[str, Any]) -> Any:
        """The history of the run once it ended well."""
        while True:
            if socket is not None:
                # Messages say when to look; only the history says what came of it.
                try:
                    message = await asyncio.wait_for(socket.recv(), HISTORY_SECONDS)
                except TimeoutError:
                    message = ""
                except Exception:  # closed by the server or on the way
                    socket, message = None, ""
                if message and not self.is_end(message, graph):
                    continue
            else:
                await asyncio.sleep(HISTORY_SECONDS)
            # Looked at after silence too: a message of the end may have been lost on the way.
            entry = at(await self.service.json("GET", f"/history/{quote(self._prompt_id)}"), self._prompt_id)
            if isinstance(entry, dict):
                status = at(entry, "status", "status_str")
                if status == "error":
                    raise self.service.error(f"stopped{_history_error(entry)}")
                # Servers differ in what they say of success; outputs are proof enough.
                if status == "success" or at(entry, "status", "completed") or entry.get("outputs"):
                    return entry

    def is_end(self, message: str | bytes, graph: dict[str, Any]) -> bool:
        """Whether a message ends the run. Reports progress; raises SourceError where it says that the run failed."""
        # Binary messages are previews.
        try:
            data = json.loads(message) if isinstance(message, str) else None
        except (ValueError, RecursionError):
            return False
        kind, content = at(data, "type"), at(data, "data")
        # Other clients' runs pass by on the same socket.
        if at(content, "prompt_id") not in (None, self._prompt_id):
            return False
        # Failures are raised as they come and not when the history has them.
        if kind == "execution_error":
            raise self.service.error(f"stopped{_execution_error(content)}")
        if kind == "execution_interrupted":
            raise self.service.error("was interrupted on the server")
        # A run ends by success or by a node that is none; either has to name this run.
        if kind == "execution_success" or (kind == "executing" and at(content, "node") is None):
            return at(content, "prompt_id") is not None
        # What is cached is done already, so the bar does not begin at nothing.
        if kind == "execution_cached":
            cached = at(content, "nodes")
            self._done = len(cached) if isinstance(cached, list) else 0
        elif kind == "progress":
            value, most = at(content, "value"), at(content, "max")
            if isinstance(value, int | float) and isinstance(most, int | float) and most > 0:
                self._report(min(max(value / most, 0.0), 1.0), f"step {value:g} of {most:g}")
        elif kind == "executing":
            # A node that begins ends the one before.
            self._done += bool(self._node)
            self._node = str(at(content, "node"))
            self._report(0.0, str(graph.get(self._node, {}).get("class_type", "working")))
        elif kind == "status" and not self._node:
            # Only before it begins: afterwards the queue is of others.
            waiting = at(content, "status", "exec_info", "queue_remaining")
            if isinstance(waiting, int) and waiting > 1:
                self._progress(0.0, f"{waiting} in the queue")
        return False

    def _report(self, share: float, words: str) -> None:
        """share: of the node that runs, 0..1; nodes count alike."""
        self._progress(min((self._done + share) / self._nodes, 1.0), words)

    async def _picture(self, history: Any, number: str, graph: dict[str, Any]) -> bytes:
        # A node may save several pictures or another kind of file; only those with a name can be fetched.
        pictures = at(history, "outputs", number, "images")
        files = (
            [entry for entry in pictures if isinstance(at(entry, "filename"), str)]
            if isinstance(pictures, list)
            else []
        )
        if not files:
            kind = graph[number]["class_type"]
            raise self.service.error(
                f"ended without a picture from {PREFIX}out (node {number}, {kind}); expected a node that saves or "
                "previews one"
            )
        # One picture is the answer; of several, the last.
        query = {key: str(files[-1].get(key) or "") for key in ("filename", "subfolder", "type")}
        url = f"{self.service.base_url}/view?{urlencode(query)}"
        body, _ = await self.service.send("GET", url, MAX_FILE_BYTES)
        return body

    async def _give_up(self) -> None:
        """Take the run out of the queue; interrupt it where it is the one that runs, and no other."""
        # Out of the queue first: were it looked at before, it could begin in between.
        await self._post("/queue", {"delete": [self._prompt_id]})
        queue = await self.service.json("GET", "/queue")
        running = at(queue, "queue_running")
        # Only ours is interrupted: the server may be shared.
        if isinstance(running, list) and any(at(item, 1) == self._prompt_id for item in running):
            await self._post("/interrupt", {"prompt_id": self._prompt_id})

    async def _post(self, path: str, content: dict[str, Any]) -> None:
        await self.service.send("POST", self.service.base_url + path, 1 << 20, json=content)


def mask_rgba_png(request: PictureRequest) -> bytes:
    """White where it may change, in grey; transparent there as well, so that LoadImage's MASK, which is 1 - alpha, says
    the same."""
    mask = np.ones(request.image.shape[:2], np.float32) if request.mask is None else request.mask
    return encode_png(quantized(np.stack([mask, mask, mask, 1 - mask], -1)), data=True)


def _execution_error(content: Any) -> str:
    return f" in node {at(content, 'node_id')} ({at(content, 'node_type')}): {at(content, 'exception_message')}"[:400]


def _history_error(entry: Any) -> str:
    # The history keeps messages in their order; the first that explains the end is the reason.
    messages = at(entry, "status", "messages")
    for message in messages if isinstance(messages, list) else ():
        if at(message, 0) == "execution_error":
            return _execution_error(at(message, 1))
        if at(message, 0) == "execution_interrupted":
            return ": it was interrupted on the server"
    return ""
