"""The nodes and the source `comfyui` with a real ComfyUI server: opt-in, see tests/support/real_comfyui.py."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter.io import read
from splatpainter.receipts import Receipt, verify
from splatpainter.sources.picture_source import PictureRequest, SourceCancelled, SourceError
from splatpainter.sources.registry import open_source
from tests.support.cli_scenes import Capture, ball, run, saved
from tests.support.picture_requests import Progressed
from tests.support.real_comfyui import PACK, RealComfyUI, running_comfyui

SIZE = 96


@pytest.fixture(scope="module")
def comfy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealComfyUI]:
    with running_comfyui(tmp_path_factory.mktemp("comfyui") / "base") as server:
        saved(server.base / "input" / "vase.ply", ball(600))
        yield server


def node(kind: str, title: str = "", **inputs: Any) -> dict[str, Any]:
    return {"class_type": kind, "inputs": inputs, "_meta": {"title": title or kind}}


def graph(steps: int = 0) -> dict[str, Any]:
    """Inverts what the mask marks; nodes of the core, but for one that takes its time, text and seed."""
    return {
        "1": node("LoadImage", "splatpainter:image", image="example.png"),
        "2": node("LoadImageMask", "splatpainter:mask", image="example.png", channel="alpha"),
        "3": node("ImageInvert", image=["1", 0]),
        "4": node("SlowImage", "splatpainter:prompt", image=["3", 0], steps=steps, seed=0, text=""),
        "5": node(
            "ImageCompositeMasked", destination=["1", 0], source=["4", 0], x=0, y=0, resize_source=False, mask=["2", 0]
        ),
        "6": node("SaveImage", "splatpainter:out", images=["5", 0], filename_prefix="answer"),
    }


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (SIZE, 64, 3)).astype(np.float32) / 255


def request(image: np.ndarray, prompt: str = "") -> PictureRequest:
    mask = np.zeros(image.shape[:2], np.float32)
    mask[:40] = 1
    return PictureRequest(image, np.ones_like(mask), mask, prompt)


def edited(
    comfy: RealComfyUI, path: Path, workflow: dict[str, Any], query: PictureRequest, stop: str = "never", **options: str
) -> tuple[np.ndarray, Progressed]:
    """What the source answers, and what it reported."""
    path.write_text(json.dumps(workflow), encoding="utf-8")
    progress = Progressed(stop)
    source = open_source("comfyui", {"url": comfy.url, "workflow": str(path), **options})
    return source.edit(query, progress, progress.cancel).image, progress


def is_inverted_above(answer: np.ndarray, image: np.ndarray) -> bool:
    """Whether the masked rows are inverted and the others are as they were, to a step of 8 bits."""
    return bool(np.abs(answer[:40] - (1 - image[:40])).max() < 0.005 and np.abs(answer[40:] - image[40:]).max() < 0.005)


def wait_until_idle(comfy: RealComfyUI) -> None:
    until = time.monotonic() + 10
    while any(comfy.get("/queue").values()):
        assert time.monotonic() < until, comfy.get("/queue")
        time.sleep(0.05)


# Nodes


def test_the_server_offers_the_nodes(comfy: RealComfyUI) -> None:
    described = comfy.get("/object_info")
    listed = {name: info for name, info in described.items() if info["category"].startswith("3d/splat/SplatPainter")}
    assert len(listed) == 8 and all(info["python_module"] == "custom_nodes.splatpainter" for info in listed.values())
    assert listed["SplatPainterLift"]["output"] == ["SPLAT", "STRING"]
    assert listed["SplatPainterNextView"]["output"][:3] == ["LOAD3D_CAMERA", "IMAGE", "MASK"]
    assert "Load3D" in described and "LOAD3D_CAMERA" in described["Load3D"]["output"]  # the core's name of cameras


def prepared(comfy: RealComfyUI, path: Path, **values: Any) -> dict[str, Any]:
    """A shipped workflow in API format, with small pictures; values: of inputs of these names."""
    workflow = comfy.api_graph(json.loads(path.read_text(encoding="utf-8")))
    for entry in workflow.values():
        chosen = {"size": 128, **values}
        widgets = {name for name, value in entry["inputs"].items() if not isinstance(value, list)}
        entry["inputs"].update({name: chosen[name] for name in chosen.keys() & widgets})
    return workflow


@pytest.mark.parametrize("name", ["paint_all_around", "global_look"])
def test_shipped_workflows_run_and_their_receipts_verify(comfy: RealComfyUI, capfd: Capture, name: str) -> None:
    workflow = prepared(comfy, PACK / "workflows" / f"{name}.json")
    history = comfy.run(workflow)
    assert history["status"]["status_str"] == "success", history["status"]["messages"][-1][1]["exception_message"]
    (saved_files,) = (output["3d"] for output in history["outputs"].values() if "3d" in output)
    original, path = comfy.base / "input" / "vase.ply", comfy.base / "output" / saved_files[0]["filename"]
    checked = run(capfd, "verify", original, path)
    assert checked.code == 0 and "verified" in checked.out.splitlines(), checked
    receipt = Receipt.from_json(path.with_name(f"{path.name}.receipt.json").read_text())
    lifts = sum(entry["class_type"] == "SplatPainterLift" for entry in workflow.values())
    assert len(receipt.views) == (lifts or 2) and len(receipt.touched) > 500
    for view in receipt.views:  # inverted: far from before, and as the picture wants it now
        assert view.psnr_before is not None and view.psnr_after is not None
        assert view.psnr_after > view.psnr_before + 8


def test_a_picture_that_was_painted_elsewhere_goes_back(comfy: RealComfyUI, capfd: Capture) -> None:
    original = comfy.base / "input" / "vase.ply"
    workflow = prepared(comfy, PACK / "workflows" / "lift_edited_file.json", file="vase.ply", image="painted.png")
    view_only = {number: entry for number, entry in workflow.items() if not entry["class_type"].startswith("LoadI")}
    view_only = {n: e for n, e in view_only.items() if e["class_type"] not in ("SplatPainterLift", "SplatPainterSave")}
    (images,) = (output["images"] for output in comfy.run(view_only)["outputs"].values())
    picture = Image.open(comfy.base / "temp" / images[0]["filename"]).convert("RGB")
    picture.paste((20, 200, 40), (50, 40, 80, 64))
    picture.save(comfy.base / "input" / "painted.png")
    for entry in workflow.values():
        if entry["class_type"] == "SplatPainterSave":
            entry["inputs"]["file"] = "shelf/patch.ply"
    history = comfy.run(workflow)
    assert history["status"]["status_str"] == "success", history["status"]["messages"][-1][1]["exception_message"]
    path = comfy.base / "output" / "shelf" / "patch.ply"
    assert verify(original, path, Receipt.from_json(path.with_name("patch.ply.receipt.json").read_text())).ok
    painted = read(path)
    green = painted.sh[:, 0, 1] - painted.sh[:, 0, 0]
    untouched = np.setdiff1d(
        np.arange(600), Receipt.from_json((path.parent / "patch.ply.receipt.json").read_text()).touched
    )
    assert 300 < len(untouched) < 595 and (painted.means[untouched] == read(original).means[untouched]).all()
    assert (green > 1).sum() > 20


def test_a_file_that_changed_is_read_again_and_one_that_is_missing_is_one_line(comfy: RealComfyUI) -> None:
    load = {"1": node("SplatPainterLoad", file="twice.ply")}
    both = {**load, "2": node("SplatPainterSave", splat=["1", 0], file="twice.spz")}
    missing = comfy.run(both)["status"]["messages"][-1]
    assert missing[0] == "execution_error" and "no 'twice.ply' in " in missing[1]["exception_message"]
    for count in (100, 200):
        saved(comfy.base / "input" / "twice.ply", ball(count))
        comfy.run(both)
        assert len(read(comfy.base / "output" / "twice.spz")) == count


# The source


@pytest.mark.parametrize("by", ["LoadImageMask", "LoadImage"])
def test_a_picture_goes_there_and_back(comfy: RealComfyUI, tmp_path: Path, by: str) -> None:
    workflow, image = graph(), picture()
    if by == "LoadImage":  # its second output is 1 - alpha
        workflow["2"] = node("LoadImage", "splatpainter:mask", image="example.png")
        workflow["5"]["inputs"]["mask"] = ["2", 1]
    answer, _ = edited(comfy, tmp_path / "w.json", workflow, request(image))
    assert is_inverted_above(answer, image)
    again, _ = edited(comfy, tmp_path / "w.json", workflow, request(image))  # from the server's cache
    assert (again == answer).all()


def test_progress_comes_by_the_socket_and_never_goes_back(comfy: RealComfyUI, tmp_path: Path) -> None:
    _, progress = edited(comfy, tmp_path / "w.json", graph(5), request(picture(1), "moss"))
    words = [text for _, text in progress.reports]
    assert "step 3 of 5" in words and "SlowImage" in words
    shares = [share for share, _ in progress.reports]
    assert shares == sorted(shares) and shares[-1] > 0.8


def test_two_at_once_get_their_own_pictures(comfy: RealComfyUI, tmp_path: Path) -> None:
    def one(k: int) -> bool:
        answer, _ = edited(comfy, tmp_path / f"{k}.json", graph(4), request(picture(k), f"prompt {k}"))
        return is_inverted_above(answer, picture(k))

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(one, (2, 3))) == [True, True]


def test_cancel_stops_the_run_and_a_waiting_one_leaves_the_queue(comfy: RealComfyUI, tmp_path: Path) -> None:
    with pytest.raises(SourceCancelled):
        edited(comfy, tmp_path / "w.json", graph(5000), request(picture(4), "long"), "step 3")
    wait_until_idle(comfy)
    with pytest.raises(SourceError, match="gave no answer within 1 seconds"):
        edited(comfy, tmp_path / "w.json", graph(5000), request(picture(4), "longer"), timeout="1")
    wait_until_idle(comfy)
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(edited, comfy, tmp_path / "1.json", graph(15), request(picture(5), "first"))
        while not comfy.get("/queue")["queue_running"]:
            time.sleep(0.05)
        with pytest.raises(SourceCancelled):
            edited(comfy, tmp_path / "2.json", graph(5000), request(picture(6), "second"), "in the queue")
        assert is_inverted_above(first.result()[0], picture(5))  # the other one was left alone
    wait_until_idle(comfy)


def broken(**changes: Any) -> dict[str, Any]:
    workflow = graph()
    for number, entry in changes.items():
        workflow[number.removeprefix("n")] = entry
    return workflow


WRONG_SCALE = node("ImageScale", image=["1", 0], upscale_method="x", width=64, height=64, crop="disabled")


@pytest.mark.parametrize(
    ("workflow", "line"),
    [
        (broken(n3=node("Rusty", image=["1", 0])), "node Rusty does not exist. (Node ID '#3')"),
        (broken(n3=WRONG_SCALE), "node 3 (ImageScale): Value not in list (upscale_method: 'x' not in ['nearest-exact'"),
        (broken(n3=node("ImageInvert")), "node 3 (ImageInvert): Required input is missing (image)"),
        (broken(n6=node("ImageInvert", "splatpainter:out", image=["5", 0])), "Prompt has no outputs"),
        (
            broken(
                n6=node("ImageInvert", "splatpainter:out", image=["5", 0]), n7=node("PreviewImage", images=["6", 0])
            ),
            "ended without a picture from splatpainter:out (node 6, ImageInvert)",
        ),
        (
            broken(n3=WRONG_SCALE, n7=node("PreviewImage", images=["1", 0])),
            "refused the workflow: node 3 (ImageScale): Value not in list",
        ),
    ],
)
def test_what_the_server_refuses_is_one_line(
    comfy: RealComfyUI, tmp_path: Path, workflow: dict[str, Any], line: str
) -> None:
    with pytest.raises(SourceError) as error:
        edited(comfy, tmp_path / "w.json", workflow, request(picture(7)))
    assert line in str(error.value) and "\n" not in str(error.value)
    wait_until_idle(comfy)


def test_a_run_that_fails_says_where_and_other_outputs_may_fail(comfy: RealComfyUI, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"stopped in node 4 \(SlowImage\): the model says no in two lines"):
        edited(comfy, tmp_path / "w.json", graph(), request(picture(8), "fail"))
    workflow = broken(n7=WRONG_SCALE, n8=node("PreviewImage", images=["7", 0]))
    answer, _ = edited(comfy, tmp_path / "w.json", workflow, request(picture(8)))
    assert is_inverted_above(answer, picture(8))


def test_the_command_edits_an_asset_by_a_workflow(comfy: RealComfyUI, tmp_path: Path, capfd: Capture) -> None:
    asset, out, path = saved(tmp_path / "vase.ply", ball(600)), tmp_path / "out.ply", tmp_path / "w.json"
    path.write_text(json.dumps(graph()), encoding="utf-8")
    options = ("--source-option", f"url={comfy.url}", f"workflow={path}")
    mask = np.zeros((128, 128, 3), np.uint8)
    mask[40:70, 50:90] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    words = ("--source", "comfyui", *options, "--prompt", "rust", "--mask", tmp_path / "mask.png", "--size", 128)
    done = run(capfd, "edit", asset, *words, "--out", out, "--json")
    assert done.code == 0, done.err
    assert done.json["receipt"]["source"]["views"][0]["model"] == "ComfyUI workflow w.json"
    assert done.json["receipt"]["views"][0]["psnr_after"] > done.json["receipt"]["views"][0]["psnr_before"] + 10
    assert run(capfd, "verify", asset, out).code == 0
