"""The studio's "Edit with a source…" in a real browser: a view is sent, cancelled, comes back, and becomes a layer."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support import studio_scenes
from tests.support.studio_pages import Page, browsing

TOOL = """
import pathlib, sys, time
import numpy as np
from PIL import Image
mark = pathlib.Path(sys.argv[3])
if not mark.exists():  # the first call hangs until it is cancelled
    mark.write_text("started")
    time.sleep(600)
pixels = np.asarray(Image.open(sys.argv[1]).convert("RGB"))
Image.fromarray(pixels[..., [2, 0, 1]]).save(sys.argv[2])
"""


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[studio_scenes.Live, Page]]:
    (tmp_path / "tool.py").write_text(TOOL, encoding="utf-8")
    run = f"{sys.executable} {tmp_path / 'tool.py'} {{image}} {{out}} {tmp_path / 'mark'}"
    monkeypatch.setenv("SPLATPAINTER_COMMAND_RUN", run)
    with browsing() as browser, studio_scenes.live(studio_scenes.make_studio(tmp_path)) as live:
        page = Page(browser, live.url)
        try:
            yield live, page
            assert page.problems == []
        finally:
            page.tab.close()


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
