"""The studio's "Edit with a source..." in a real browser: a view is sent, cancelled, comes back, and becomes a layer;
views all around are planned, sent and cancelled on the way; and colours from elsewhere."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.server.commands import source_edit
from splatpainter.source_edits import coverage
from tests.support import studio_scenes
from tests.support.studio_pages import Page, opened_page

TOOL = """
import pathlib, sys, time
import numpy as np
from PIL import Image
mark = pathlib.Path(sys.argv[3])
with mark.open("a") as file:
    file.write("x")
if mark.stat().st_size == 1 + mark.with_name("allowed").exists():  # this call hangs until it is cancelled
    time.sleep(600)
pixels = np.asarray(Image.open(sys.argv[1]).convert("RGB"))
Image.fromarray(pixels[..., [2, 0, 1]]).save(sys.argv[2])
"""


@pytest.fixture
def opened(browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[studio_scenes.Live, Page]]:
    (tmp_path / "tool.py").write_text(TOOL, encoding="utf-8")
    run = f"{sys.executable} {tmp_path / 'tool.py'} {{image}} {{out}} {tmp_path / 'mark'}"
    monkeypatch.setenv("SPLATPAINTER_COMMAND_RUN", run)
    monkeypatch.setattr(coverage, "CANDIDATE_VIEWS", 8)
    monkeypatch.setattr(source_edit, "USUAL_PX", 96)
    with opened_page(browser, tmp_path, resolution="0.5") as both:
        yield both


def test_a_view_is_sent_cancelled_sent_again_and_applied(
    opened: tuple[studio_scenes.Live, Page], tmp_path: Path
) -> None:
    live, page = opened
    before, version = page.pixels(), live.studio.session.version
    page.tab.get_by_role("tab", name="Pictures").click()

    def send() -> None:
        page.tab.get_by_role("button", name="Edit with a source").click()
        dialog = page.tab.get_by_role("dialog", name="Edit with a source")
        page.wait("the sources", lambda: dialog.get_by_label("Source", exact=True).count())
        dialog.get_by_label("Source", exact=True).select_option("command")
        dialog.get_by_role("button", name="Send this view").click()

    send()
    page.wait("the program", lambda: (tmp_path / "mark").exists())
    page.tab.get_by_role("button", name="Cancel").click()
    page.wait("the end of the job", lambda: page.tab.get_by_role("button", name="Cancel").count() == 0)
    assert page.names() == [] and live.studio.session.version == version
    send()
    page.wait("the picture", lambda: page.tab.get_by_role("button", name="Apply as layer").count())
    page.tab.get_by_role("button", name="Apply as layer").click()
    page.wait("the layer", lambda: page.names() == ["command"])
    page.settled()
    after, (height, width) = page.pixels(), before.shape[:2]
    middle = (slice(height // 3, 2 * height // 3), slice(width // 2 - 40, width // 2 + 40))
    expected = before[middle][..., [2, 0, 1]]
    assert abs(after[middle] - expected).mean() < 0.5 * abs(before[middle] - expected).mean()


def test_views_all_around_are_planned_and_cancelled_on_the_way_and_a_lut_becomes_a_layer(
    opened: tuple[studio_scenes.Live, Page], tmp_path: Path
) -> None:
    live, page = opened
    (tmp_path / "allowed").touch()  # one call is answered
    page.tab.get_by_role("tab", name="Pictures").click()
    page.tab.get_by_role("button", name="Edit with a source").click()
    dialog = page.tab.get_by_role("dialog", name="Edit with a source")
    page.wait("the sources", lambda: dialog.get_by_label("Source", exact=True).count())
    dialog.get_by_label("Source", exact=True).select_option("command")
    dialog.get_by_label("Send", exact=True).select_option("around")
    dialog.get_by_label("Max. views, number").fill("3")
    dialog.get_by_label("Max. views, number").press("Enter")
    page.wait("the plan", lambda: "3 calls, not paid" in dialog.get_by_role("status").inner_text())
    assert not (tmp_path / "mark").exists() and page.names() == []
    if folder := os.environ.get("SPLATPAINTER_SCREENSHOTS"):
        page.tab.screenshot(path=f"{folder}/around.png")
    dialog.get_by_role("button", name="Send 3 views").click()
    page.wait("the first layer", lambda: page.names() == ["command (1)"])  # while the second view is asked for
    page.tab.get_by_role("button", name="Cancel").click()
    page.wait(
        "what was done", lambda: "1 of 3 views painted, then cancelled" in page.tab.locator(".toasts").inner_text()
    )
    page.settled()
    assert page.names() == ["command (1)"] and live.studio.session.layers[0].operation.source["name"] == "command"  # pyright: ignore[reportAttributeAccessIssue]
    page.tab.get_by_role("button", name="Undo").first.click()
    page.wait("no layer", lambda: page.names() == [])

    inverted = "LUT_3D_SIZE 2\n" + "\n".join(f"{1 - k % 2} {1 - k // 2 % 2} {1 - k // 4}" for k in range(8))
    before = page.pixels()
    page.tab.get_by_role("tab", name="Adjust").click()
    chooser = page.tab.locator("input[type=file][accept='.cube']")
    chooser.set_input_files({"name": "inverted.cube", "mimeType": "text/plain", "buffer": inverted.encode()})
    panel = page.tab.locator(".adjustments")
    page.wait("its name", lambda: "inverted.cube in place of the sliders" in panel.inner_text())
    middle = np.s_[100:160, 200:250]
    page.wait("the preview", lambda: abs(page.pixels()[middle] - (1 - before[middle])).mean() < 0.1)
    if folder := os.environ.get("SPLATPAINTER_SCREENSHOTS"):
        page.tab.screenshot(path=f"{folder}/lut.png")
    panel.get_by_role("button", name="Apply as layer").click()
    page.wait("the layer", lambda: page.names() == ["inverted.cube"])
    assert live.studio.session.layers[0].operation.look == "lut"  # pyright: ignore[reportAttributeAccessIssue]
