"""`splatpainter edit --source`: a view is sent, the answer painted and proved; nothing is written where that fails."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter.commands.parts.terminal import complain
from splatpainter.io import read, write
from splatpainter.operations.generate import notes_of_views
from splatpainter.operations.source_answers import InterruptibleSource, keeping_answers
from splatpainter.source_edits import coverage
from splatpainter.sources.picture_source import Capabilities, PictureAnswer, SourceCancelled
from tests.source_edits.test_edit import patterned
from tests.support.cli_scenes import Capture, listing, run
from tests.support.picture_requests import request
from tests.support.picture_sources import FunctionSource, exchanged

TOOL = """
import sys
import numpy as np
from PIL import Image
pixels = np.asarray(Image.open(sys.argv[1]).convert("RGB"))
out = pixels.copy()
kind = sys.argv[3]
if kind == "exchange":
    out = pixels[..., [2, 0, 1]]
elif kind == "noise":
    out = np.random.default_rng(0).integers(0, 255, pixels.shape, np.uint8)
elif kind == "fail":
    sys.exit("no such style")
Image.fromarray(out).save(sys.argv[2])
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(coverage, "CANDIDATE_VIEWS", 14)
    write(tmp_path / "ball.ply", patterned(900))
    (tmp_path / "tool.py").write_text(TOOL, encoding="utf-8")
    return tmp_path


def sourced(capfd: Capture, folder: Path, kind: str, *more: object):
    tool = f"run={sys.executable} {folder / 'tool.py'} {{image}} {{out}} {kind}"
    words = ("edit", folder / "ball.ply", "--source", "command", "--source-option", tool, "--size", 96)
    return run(capfd, *words, "--out", folder / "out.ply", *more)


def test_a_view_is_sent_painted_reported_and_verified(capfd: Capture, folder: Path) -> None:
    mask = np.zeros((96, 96), np.uint8)
    mask[30:70, 30:70] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    done = sourced(
        capfd, folder, "exchange", "--azimuth", 90, "--mask", folder / "mask.png",
        "--source-strictness", "loose", "--source-report", folder / "report.png", "--json",
    )  # fmt: skip
    assert done.code == 0, done.err
    record = json.loads((folder / "out.ply.receipt.json").read_text())
    assert record["source"]["name"] == "command" and len(record["source"]["views"]) == 1
    assert str(folder) not in json.dumps(record["source"])
    assert done.json["verified"] and done.json["receipt"]["source"] == record["source"]
    assert run(capfd, "verify", folder / "ball.ply", folder / "out.ply").code == 0
    with Image.open(folder / "report.png") as page:
        assert page.width > 1000 and page.height > 500
    assert len(read(folder / "out.ply")) >= 900


def test_a_dry_run_counts_the_calls_and_asks_for_nothing(capfd: Capture, folder: Path) -> None:
    before = listing(folder)
    done = sourced(capfd, folder, "fail", "--views", "auto", "--max-views", 3, "--dry-run", "--json")
    assert done.code == 0 and done.json["calls"] == 3 and done.json["paid"] is False
    assert 0.2 < done.json["covered"] < 1 and len(done.json["views"]) == 3
    text = sourced(capfd, folder, "fail", "--dry-run")
    assert "command: 1 call, not paid; nothing was sent" in text.out
    assert listing(folder) == before


def test_views_auto_writes_one_receipt(capfd: Capture, folder: Path) -> None:
    done = sourced(capfd, folder, "exchange", "--views", "auto", "--max-views", 2, "--json")
    assert done.code == 0, done.err
    receipt = done.json["receipt"]
    assert len(receipt["views"]) == len(receipt["source"]["views"]) == 2
    assert run(capfd, "verify", folder / "ball.ply", folder / "out.ply").code == 0


@pytest.mark.parametrize(
    ("kind", "more", "message"),
    [
        ("fail", (), "no such style"),
        ("exchange", ("--seed", 3), "a seed"),
        ("exchange", ("--view", "missing.json"), "no such file"),
        ("exchange", ("--max-views", 3), "--max-views is for --views auto"),
        ("exchange", ("--views", "auto", "--mode", "global"), "--views auto is for --mode local"),
        ("exchange", ("--decal-text", "A"), "a source takes the place of pictures"),
    ],
)
def test_nothing_is_written_where_it_fails(capfd: Capture, folder: Path, kind: str, more: tuple, message: str) -> None:
    before = listing(folder)
    assert message in sourced(capfd, folder, kind, *more).error
    assert listing(folder) == before


def test_what_came_back_is_kept_where_it_is_refused(capfd: Capture, folder: Path) -> None:
    """It may have been paid for: the picture, with its camera, and the page are there; painting it asks nobody."""
    before = listing(folder)
    done = sourced(capfd, folder, "noise", "--source-report", folder / "report.png")
    first, second = (folder / f"out.ply.answer_{number}.png" for number in (1, 2))
    assert "shows something other than what was sent" in done.error and f"what came back is kept: {first}" in done.error
    assert {*listing(folder)} - {*before} == {first.name, "report.png"}
    noise = np.random.default_rng(0).integers(0, 255, (96, 96, 3), np.uint8)
    with Image.open(first) as picture:
        assert np.array_equal(np.asarray(picture), noise)
    with Image.open(folder / "report.png") as page:
        assert page.width > 1000 and page.height > 360
    assert str(second) in sourced(capfd, folder, "same").error
    assert run(capfd, "edit", folder / "ball.ply", first, "--out", folder / "out.ply", "--force").code == 0


def test_what_came_back_is_kept_after_an_interrupt(tmp_path: Path, capfd: Capture) -> None:
    source, out = InterruptibleSource(FunctionSource(exchanged)), tmp_path / "out.ply"
    with pytest.raises(KeyboardInterrupt), keeping_answers([source], out, complain):
        answer = source.edit(request("moss"), lambda *_: None, threading.Event())
        raise KeyboardInterrupt  # while it is painted
    with Image.open(tmp_path / "out.ply.answer_1.png") as picture:
        assert np.abs(np.asarray(picture) / 255 - answer.image).max() < 0.01
    assert f"what came back is kept: {out}.answer_1.png" in capfd.readouterr().err
    assert source.write_answers(out, [answer]) == []
    out.with_name("folder").touch()
    assert source.write_answers(tmp_path / "folder" / "out.ply") == [], "a full disk hides no error"


def test_what_all_views_have_in_common_is_said_once() -> None:
    notes = [("no mask", "moved"), ("no mask",)]
    edits: list[Any] = [SimpleNamespace(notes=entry) for entry in notes]
    assert notes_of_views(edits) == [("no mask (all 2 views)", "moved"), ()]
    assert notes_of_views(edits[:1]) == notes[:1]


def test_options_of_sources_need_a_source(capfd: Capture, folder: Path) -> None:
    done = run(capfd, "edit", folder / "ball.ply", "--prompt", "moss", "--out", folder / "out.ply")
    assert "--prompt is for pictures that a source makes; give --source NAME too" in done.error
    unknown = run(capfd, "edit", folder / "ball.ply", "--source", "gimini", "--out", folder / "out.ply")
    assert "'gimini'" in unknown.error


def test_an_interrupt_cancels_the_source() -> None:
    class Slow:
        name, capabilities = "slow", Capabilities(prompt=True)
        cancelled = False

        def edit(self, request, progress, cancel) -> PictureAnswer:
            threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
            while not cancel.is_set():
                time.sleep(0.01)
            self.cancelled = True
            raise SourceCancelled

    slow = Slow()
    with pytest.raises(KeyboardInterrupt):
        InterruptibleSource(slow).edit(request("x"), lambda *_: None, threading.Event())
    assert slow.cancelled
