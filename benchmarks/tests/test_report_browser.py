"""The report's page in a real browser: nothing is fetched, nothing complained of; sorting, zoom, comparison."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from splatbench.report.page import write_page

from benchmarks.tests.support.runs import METHODS, FakeTable, plain_run
from tests.support.studio_pages import browsing

ROWS = """() => [...document.querySelectorAll(".results tbody tr .name > span")]
  .map((name) => name.firstChild.textContent.trim())"""


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder: Path = tmp_path_factory.mktemp("report")
    path = write_page([plain_run(folder / "refine")], folder / "out", {"refine": FakeTable()}, METHODS)
    with browsing() as browser:
        page = browser.new_page(viewport={"width": 1400, "height": 900}, reduced_motion="reduce")
        page.set_default_timeout(90_000)
        page.problems, page.requests = [], []
        page.on("console", lambda message: page.problems.append(message.text))
        page.on("pageerror", lambda error: page.problems.append(str(error)))
        page.on("request", lambda request: page.requests.append(request.url))
        page.goto(path.as_uri())
        yield page


def test_page_is_quiet_and_stays_at_home(tab):
    tab.evaluate("document.querySelectorAll('img').forEach((i) => (i.loading = 'eager'))")
    tab.wait_for_function("[...document.images].every((i) => i.complete)")
    assert tab.evaluate("[...document.querySelectorAll('main img')].every((i) => i.naturalWidth > 0)")
    assert not tab.problems and all(url.startswith(("file:", "data:")) for url in tab.requests)


@pytest.mark.parametrize("width", [1400, 420])
def test_nothing_sticks_out_and_plots_fit(tab, width):
    tab.set_viewport_size({"width": width, "height": 900})
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    expected = 720 if width == 1400 else 372
    plot = tab.locator(".plots img").first
    for _ in range(100):  # a busy browser lays out again a moment later
        if plot.bounding_box()["width"] == expected:
            break
        tab.wait_for_timeout(50)
    assert plot.bounding_box()["width"] == expected
    tab.set_viewport_size({"width": 1400, "height": 900})


def test_columns_sort_best_first_then_worst_then_as_before(tab):
    before = tab.evaluate(ROWS)
    head = tab.get_by_role("button", name="PSNR ↑")
    head.click()
    best = tab.evaluate(ROWS)
    assert best[:5] == ["Oracle", "Ours (TTT)", "3DGS (2 of 3)", "Ours (lift)", "Asset as it is"]
    assert sorted(best) == sorted(before) and tab.locator("[aria-sort=descending]").count() == 1
    head.press("Enter")
    assert tab.evaluate(ROWS)[:5] == best[4::-1]
    head.press("Enter")
    assert tab.evaluate(ROWS) == before


def test_pictures_are_compared_with_mouse_and_keys(tab):
    tab.locator(".tiles .open").nth(2).focus()
    tab.keyboard.press("+")
    assert tab.evaluate("document.querySelector('.case').style.getPropertyValue('--zoom')") == "2"
    tab.keyboard.press("Enter")
    dialog = tab.get_by_role("dialog")
    sides = [dialog.get_by_label(name) for name in ("Left", "Right")]

    def chosen() -> list[str]:
        return [side.evaluate("(s) => s.selectedOptions[0].textContent") for side in sides]

    assert chosen() == ["Ours (lift)", "Truth"]
    tab.keyboard.press("x")
    assert chosen() == ["Truth", "Ours (lift)"]
    wipe = dialog.get_by_label("Wipe")
    wipe.press("Home")
    assert tab.evaluate("document.querySelector('.stage').style.getPropertyValue('--wipe')") == "0%"
    tab.keyboard.press("Escape")
    assert dialog.count() == 0 and not tab.problems
    tab.get_by_text("Errors", exact=True).click()
    assert (
        tab.locator(".tiles .error").first.is_visible()
        and not tab.locator("li:not(.no-error) .result").first.is_visible()
    )
