"""The studio's "Batch..." in a real browser: assets are sent, planned and made beside the painting, found again after a
reload, cancelled and downloaded; variants come from a table and from CSV. The program behind it is a stand-in; the real
one is run in test_batch.py."""

from __future__ import annotations

import io
import os
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from splatpainter.io import write
from splatpainter.server.batches import batch_runs as batches
from tests.support import fake_batch, studio_scenes
from tests.support.studio_pages import PATIENCE, Page, opened_page


@pytest.fixture
def opened(browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[studio_scenes.Live, Page]]:
    monkeypatch.setattr(batches, "PROGRAM", (sys.executable, "-S", str(Path(fake_batch.__file__)), "df", "hang"))
    with opened_page(browser, tmp_path, still=True) as both:
        yield both


def files(*named: tuple[str, bytes]) -> list[dict[str, Any]]:
    return [{"name": name, "mimeType": "application/octet-stream", "buffer": data} for name, data in named]


def picture(page: Page, name: str) -> None:
    """Into the folder that SPLATPAINTER_SCREENSHOTS names, to be looked at."""
    if folder := os.environ.get("SPLATPAINTER_SCREENSHOTS"):
        page.tab.screenshot(path=f"{folder}/batch-{name}.png")


def test_assets_are_sent_planned_made_found_again_and_downloaded(
    opened: tuple[studio_scenes.Live, Page], tmp_path: Path
) -> None:
    live, page = opened
    tab, dialog = page.tab, page.tab.get_by_role("dialog", name="Batch")
    tab.get_by_role("button", name="Batch").click()
    assert "No visible layer yet" in dialog.inner_text() and page.serious() == []
    tab.keyboard.press("Escape")
    page.drag((0.45, 0.5), (0.55, 0.5))
    page.wait("the layer", lambda: page.names() == ["Paint"])
    page.settled()
    tab.keyboard.press("Control+b")
    write(tmp_path / "a.ply", studio_scenes.ball(50))
    data = (tmp_path / "a.ply").read_bytes()
    chooser = dialog.locator("input[type=file]")
    chooser.set_input_files(files(("shoe.ply", data), ("shoe.ply", data), ("hat.ply", data), ("note.txt", b"hello")))
    page.wait("the answers", lambda: dialog.get_by_text("ready").count() == 3)
    page.wait("what is wrong", lambda: "note.txt: expected a picture" in dialog.inner_text())
    assert page.problems.pop().startswith("Failed to load resource"), "the browser's own line about the refusal"
    picture(page, "assets")
    dialog.get_by_role("button", name="Plan").click()
    page.wait("the plan", lambda: dialog.get_by_role("button", name="Make 3 results").count())
    assert [row.split("\t")[0] for row in dialog.locator("tbody tr").all_inner_texts()] == [
        "shoe.ply", "shoe-2.ply", "hat.ply"
    ]  # fmt: skip
    assert "Nothing was made yet" in dialog.inner_text() and page.serious() == []
    dialog.get_by_role("button", name="Make 3 results").click()
    page.wait("the third job", lambda: dialog.locator("tr.running", has_text="hat.ply").count())
    assert "expected something else" in dialog.locator("tr.failed").inner_text() and page.serious() == []
    picture(page, "running")

    page.open()  # loaded again
    chip = page.wait("the batch", lambda: tab.get_by_role("button", name="Batch: 2 of 3").count())
    page.drag((0.45, 0.6), (0.55, 0.6))  # painting goes on
    page.wait("the stroke", lambda: "Paint" in page.names() and page.state()["cursor"] == 2)
    assert chip
    tab.get_by_role("button", name="Batch: 2 of 3").click()
    page.wait("its jobs", dialog.locator("tr.running").count)
    dialog.get_by_role("button", name="Cancel").press("Enter")  # its rows still move the button
    page.wait("the end", lambda: "Cancelled; 1 of 3 done." in dialog.inner_text())
    assert page.serious() == []
    picture(page, "cancelled")
    with tab.expect_download(timeout=1000 * PATIENCE) as download:
        dialog.get_by_role("button", name="Download all").click()
    bundle = zipfile.ZipFile(io.BytesIO(Path(download.value.path()).read_bytes()))
    assert bundle.namelist() == ["shoe.ply", "shoe.ply.receipt.json", "index.html"]
    dialog.get_by_role("button", name="New batch").click()
    page.wait("the beginning", lambda: dialog.get_by_role("button", name="Plan").count())
    live.post("scene.add", blob=live.send(data, "hat.ply"))  # then one of both makes batches
    page.wait("the choice", lambda: dialog.get_by_label("Asset", exact=True).count())
    assert "The visible layers (Paint" in dialog.inner_text()
    dialog.get_by_label("Asset", exact=True).select_option(label="hat.ply")
    page.wait("the other's layers", lambda: "No visible layer yet" in dialog.inner_text())
    assert page.serious() == []
    picture(page, "several")


def test_variants_from_a_table_and_from_csv(opened: tuple[studio_scenes.Live, Page]) -> None:
    live, page = opened
    tab, dialog = page.tab, page.tab.get_by_role("dialog", name="Batch")
    live.post("selection.change", to="all")
    live.post("selection.save", name="sole")
    page.wait("the selection", lambda: page.state()["selection"]["names"] == ["sole"])
    tab.keyboard.press("Control+b")
    dialog.get_by_label("Variants of this asset").check()
    dialog.get_by_role("button", name="Plan").click()
    page.wait("what is missing", lambda: "Every row needs a name." in dialog.inner_text())
    dialog.get_by_role("button", name="From CSV").click()
    text = dialog.get_by_label("CSV: a name and a colour in each line")
    text.fill("name,colour\nnavy,#1f2a44\nbrick,red")
    dialog.get_by_role("button", name="Make rows").click()
    assert 'Line 3: expected a colour like #2040a0, got "red".' in dialog.get_by_role("alert").first.inner_text()
    text.fill("name,colour,what\nnavy,#1f2a44\nbrick;A0432C;sole\n\nmoss\t3f6b35\n")
    dialog.get_by_role("button", name="Make rows").click()
    assert [dialog.get_by_label(f"Name {k}", exact=True).input_value() for k in (1, 2, 3)] == ["navy", "brick", "moss"]
    assert dialog.get_by_label("What changes 2").input_value() == "selection:sole"
    dialog.get_by_role("button", name="Row", exact=True).click()
    dialog.get_by_label("Name 4", exact=True).fill("moss")
    dialog.get_by_label("Change 4", exact=True).select_option("sliders")
    dialog.get_by_label("Hue, degrees").fill("90")
    assert page.serious() == []
    picture(page, "variants")
    dialog.get_by_role("button", name="Plan").click()
    page.wait("the name given twice", lambda: "'moss' was given twice" in dialog.inner_text())
    dialog.get_by_label("Name 4", exact=True).fill("green")
    dialog.get_by_role("button", name="Plan").click()
    page.wait("the plan", lambda: dialog.get_by_role("button", name="Make 4 results").count())
    words = [row.split("\t") for row in dialog.locator("tbody tr").all_inner_texts()]
    assert words[1] == ["ball-brick.ply", "new colour #a0432c on sole"]
    assert words[3] == ["ball-green.ply", "adjustment on everything"], "a new row takes what the row above changes"
    dialog.get_by_role("button", name="Back").click()
    page.wait("the table", lambda: dialog.get_by_label("Name 4", exact=True).count())
