"""The report: summaries by hand, a well-formed page without network, hostile text, contact sheets, RESULTS.md."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFont
from splatbench.report import gallery
from splatbench.report.page import write_markdown, write_page
from splatbench.report.summary import MethodNames, best_methods, blocks, read_run, summarize

from benchmarks.tests.support.runs import COLUMNS, METHODS, FakeTable, plain_run, record, write
from splatpainter.contact_sheet import _wrapped, sheet
from splatpainter.metrics.bootstrap import interval

VOID = {"meta", "link", "img", "input", "br", "source"}
TABLES = {"refine": FakeTable(), "relight": FakeTable()}


class Page(HTMLParser):
    """Elements and their texts; complains of what does not nest."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        """(innermost element, text)."""
        self.feed(text)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag, attrs):
        assert len({name for name, _ in attrs}) == len(attrs), f"<{tag}> has an attribute twice"
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data):
        if self.open and data.strip():
            self.texts.append((self.open[-1], data))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def text(self) -> str:
        return " ".join(text for tag, text in self.texts if tag not in ("script", "style"))


def page_of(folder: Path, out: Path, table: FakeTable | None = None) -> tuple[Page, Path]:
    path = write_page([folder], out, {folder.name: table or FakeTable()}, METHODS)
    return Page(path.read_text()), path


# ---- summaries


def test_summary_by_hand():
    records = [record("ttt", "ant", 20, label="ant-1", edit_seconds=1.0, rows=10, rows_equal=1.0, peak_mib=5)]
    records += [record("ttt", "ant", 22, label="ant-2", edit_seconds=9.0, rows=20, rows_equal=0.5, peak_mib=9)]
    records += [record("ttt", "bee", 25, label="bee-1", edit_seconds=2.0, rows=30, rows_equal=0.0, peak_mib=7)]
    records += [
        record("ttt", "cat", label="cat-1", error="it broke"),
        record("3dgs", "cat", label="cat-1", missing="no"),
    ]
    first, other = summarize(records)
    assert (first.method, first.state, first.cases, first.all_cases, first.objects) == ("ttt", "measured", 3, 4, 2)
    psnr = first.figures["psnr"]
    assert psnr.mean == (21 + 25) / 2  # every object counts the same, not every case
    assert (psnr.low, psnr.high) == (21, 25)  # of two objects: each alone with probability 1/4
    assert (psnr.objects, psnr.cases) == (2, 3)
    assert (first.edit_seconds, first.rows, first.rows_equal, first.peak_mib) == (2.0, 20, 0.5, 9)
    assert first.errors == (("error: it broke", 1),)
    assert (other.method, other.state, other.cases, other.all_cases) == ("3dgs", "no", 0, 4) and not other.figures


def test_summary_leaves_out_what_is_not_there():
    records = [record("ttt", "ant", 20), record("ttt", "bee", 30)]
    records[0].figures.update(lpips=None, ssim=math.nan)
    records[1].figures.update(lpips=None)
    figures = summarize(records)[0].figures
    assert "lpips" not in figures and figures["ssim"].objects == 1 and figures["ssim"].low is None


def test_interval_agrees_with_scipy_and_repeats():
    means = np.random.default_rng(1).normal(20, 3, 12)
    from scipy import stats  # 0.2 s, in every worker

    expected = stats.bootstrap((means,), np.mean, method="percentile", n_resamples=20_000, rng=0).confidence_interval
    assert interval(means) == pytest.approx((expected.low, expected.high), abs=0.12) and interval(means) == interval(
        means
    )
    assert (interval([math.inf, math.inf, 3.0]) or (0, 0))[1] == math.inf  # and not NaN
    assert interval([1.0]) is None and interval([]) is None
    # Values of one owner are drawn together: twice the same ones are no more evidence.
    assert interval(means.repeat(2), np.arange(12).repeat(2)) == pytest.approx(interval(means), abs=1e-12)


def test_blocks_are_in_order_of_numbers():
    records = [record("ttt", f"{v}", 1, facts={"views": v}) for v in (10, 2, 1)]
    assert blocks(records, "views") == ["1", "2", "10"]
    assert [row.block for row in summarize(records, "views")] == ["1", "2", "10"]
    assert blocks(records, "") == [""] and blocks([record("ttt", "a", 1)], "views") == [""]


def test_methods_keep_the_order_of_the_tables():
    records = [record(m, "a", 1) for m in ("new", "3dgs", "nothing")]
    assert [row.method for row in summarize(records, "", tuple(METHODS))] == ["nothing", "3dgs", "new"]
    names = MethodNames.of(METHODS, {"new", "3dgs", "oracle"})
    assert names.order == ("3dgs", "oracle", "new") and names.labels["new"] == "new" and "oracle" in names.unranked


def test_best_is_among_those_that_answered_everything_and_are_no_bound():
    records = [record("ttt", "a", 20), record("ttt", "b", 20), record("3dgs", "a", 40), record("3dgs", "b", error="x")]
    records += [record("oracle", n, 50) for n in "ab"] + [record("srgs", n, 10) for n in "ab"]
    names = MethodNames.of(METHODS, {r.method for r in records})
    assert best_methods(summarize(records), COLUMNS[0], names) == {"ttt"}
    assert best_methods(summarize(records), replace(COLUMNS[0], better="lower"), names) == {"srgs"}
    assert best_methods(summarize(records[:2]), COLUMNS[0], names) == set()


# ---- the page


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> tuple[Page, Path]:
    folder = tmp_path_factory.mktemp("plain")
    return page_of(plain_run(folder / "refine"), folder / "out")


def test_page_needs_no_network(plain):
    page, path = plain
    for _, attributes in page.elements:
        for name in ("src", "href", "srcset", "action", "data"):
            assert (attributes.get(name) or "#").startswith(("#", "data:")), name
    assert [file.name for file in path.parent.iterdir()] == ["index.html"]
    text = path.read_text()
    assert "http:" not in text and "https:" not in text and "url(" not in text and "@import" not in text
    policy = next(m["content"] for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None and policy.startswith("default-src 'none';")
    for tag in ("style", "script"):
        [records] = [text for name, text in page.texts if name == tag]
        digest = base64.b64encode(hashlib.sha256(records.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy


def picture_of(image: dict[str, str | None]) -> Image.Image:
    kind, _, data = (image["src"] or "").partition(";base64,")
    assert kind == "data:image/webp"
    return Image.open(io.BytesIO(base64.b64decode(data)))


def test_every_picture_is_there_and_described(plain):
    page, _ = plain
    pictures = [image for image in page.all("img") if "width" in image]
    # three cases of input, four or five answers and truth; every answer with its error
    assert len(pictures) == 2 * (2 + 2 * 5) + (2 + 2 * 4)
    for image in pictures:
        with picture_of(image) as opened:
            assert opened.format == "WEBP" and [str(v) for v in opened.size] == [image["width"], image["height"]]
        assert image["alt"] and image["alt"].split(", ")[-1] in ("ant", "bee", "cat")
    ids = [a["id"] for _, a in page.elements if "id" in a]
    assert len(ids) == len(set(ids)) and {a["href"] for a in page.all("a")} >= {"#refine"}


def test_plots_are_described_files_of_their_own_for_both_widths(plain):
    page, _ = plain
    [plot] = [image for image in page.all("img") if (image.get("src") or "").startswith("data:image/svg+xml")]
    assert plot["alt"] == "Plot: PSNR against seconds; its figures are in the table"
    sizes = []
    for uri in (plot["src"], page.all("source")[0]["srcset"]):
        root = ET.fromstring(base64.b64decode((uri or "").partition(";base64,")[2]))
        sizes.append(root.get("width"))
    assert sizes == ["720", "372"]


def test_page_says_what_was_measured_and_what_was_not(plain):
    page, path = plain
    text = page.text()
    assert "Made up (Tab. 1)" in text and "3 objects, 3 cases." in text and "two cores" in text and "load" not in text
    assert "not installed: no path in the adapters' file" in text and "3DGS (2 of 3)" in text
    assert "3DGS: error: ValueError: no splats left (1 of 3 cases)" in text and "Ours (TTT): eight views" in text
    assert "99.99" in text and "[22.00, 24.00]" in text  # never rounded up to 100; the interval of 22, 23, 24
    text = path.read_text()
    assert '<b>23.00</b><span class="unseen"> best</span>' in text  # not the 31 of what sees the truth
    assert "as published, other data" in text and "21.07" in text and "1.54 + 0.64" in text
    assert text.index("GenDen") > text.index("VoxHammer")  # rows that only the paper has, below the measured ones
    assert '<td class="published" data-value="">21.07</td>' in text, "the paper's figures are set apart"


def test_page_is_the_same_again(plain, tmp_path):
    assert page_of(plain_run(tmp_path / "refine"), tmp_path / "a")[1].read_bytes() == plain[1].read_bytes()


def test_hostile_text_stays_text(tmp_path):
    evil = "\"><img src=x onerror=alert(1)><script>alert(2)</script>'&amp;"
    records = [
        record(evil, evil, 20, label="ant", note=evil, machine=evil, facts={"views": evil}),
        record("../../../etc", "bee", 21, facts={"views": evil}),
        record("ttt", "ant", error=evil, facts={"views": evil}),
    ]
    table = FakeTable(title=evil, columns=(replace(COLUMNS[0], label=evil, group=evil),), split_by="views")
    folder = write(tmp_path / "refine", records, folders={evil: "evil", "../../../etc": "etc"})
    page, _ = page_of(folder, tmp_path / "out", table)
    assert len(page.all("script")) == 1 and not [name for _, a in page.elements for name in a if name.startswith("on")]
    assert all((image.get("src") or "data:").startswith("data:") for image in page.all("img"))
    assert page.text().count(evil) >= 6 and any(a.get("aria-label") == f"Table: {evil}" for _, a in page.elements)
    assert [path.name for path in (tmp_path / "out").rglob("*")] == ["index.html"]


def test_page_takes_only_what_the_last_run_asked_for(tmp_path):
    folder = write(tmp_path / "refine", [record("ttt", n, 20, fingerprint=f"{n}-x") for n in ("ant", "bee")])
    (folder / "run.json").write_text(json.dumps({"labels": ["ant"], "notes": ["a note of the run <b>"]}))
    page, _ = page_of(folder, tmp_path / "out")
    assert "1 object, 1 case." in page.text() and "a note of the run <b>" in page.text()
    (folder / "run.json").write_text("[]")
    with pytest.raises(ValueError, match=r"run\.json: expected what `splatpainter bench` writes"):
        page_of(folder, tmp_path / "out")


def test_page_of_nothing_and_of_strangers_is_an_error(tmp_path):
    (tmp_path / "refine").mkdir()
    with pytest.raises(ValueError, match="expected records of `splatpainter bench` in .*refine, found none"):
        page_of(tmp_path / "refine", tmp_path / "out")
    with pytest.raises(ValueError, match="stranger: expected the folder of one of refine"):
        write_page([tmp_path / "stranger"], tmp_path / "out", {"refine": FakeTable()}, METHODS)
    assert not (tmp_path / "out").exists()


def test_a_run_without_any_figure_still_has_a_page(tmp_path):
    records = [record("ttt", "ant", error="it broke"), record("voxhammer", "ant", missing="not installed: x")]
    page, _ = page_of(write(tmp_path / "refine", records), tmp_path / "out")
    assert "error: it broke" in page.text() and "PSNR: not measured" in page.text()


# ---- pictures and sheets


def test_cases_are_the_easiest_the_middle_and_the_hardest(tmp_path):
    records = [
        record(m, n, p + k)
        for k, m in enumerate(("ttt", "3dgs"))
        for n, p in zip("abcde", (3, 9, 1, 7, 5), strict=True)
    ]
    assert gallery.ranked(records, "psnr", 3) == [("b", "easiest"), ("e", "middle"), ("c", "hardest")]
    assert gallery.ranked(records, "psnr", 2) == [("b", "easiest"), ("c", "hardest")]
    assert gallery.ranked(records, "psnr", 1) == [("e", "middle")]
    assert gallery.ranked(records[:2], "psnr", 3) == [("b", ""), ("a", "")]
    rows = gallery.picture_rows(
        write(tmp_path, records), records, MethodNames.of(METHODS, {"ttt", "3dgs"}), FakeTable()
    )
    labels = [[tile.label for tile in row.tiles] for row in rows]
    assert labels == [["Input", "Asset before", "Ours (TTT)", "3DGS", "Truth"]] * 3
    assert [tile.figure for tile in rows[0].tiles] == [None, None, 9, 10, None]


def test_errors_only_against_a_truth_of_the_same_size(tmp_path):
    folder = write(tmp_path / "refine", [record("ttt", "ant", 20)])
    rows = gallery.picture_rows(folder, read_run(folder).records, MethodNames.of(METHODS, {"ttt"}), FakeTable())
    tile = next(tile for tile in rows[0].tiles if tile.method)
    wrong = np.abs(gallery.read_picture(tile.path) - gallery.read_picture(rows[0].tiles[-1].path)).max(-1)
    error = gallery.error_of(tile, gallery.read_picture(rows[0].tiles[-1].path))
    assert error is not None and np.array_equal(error.sum(-1) == 3, wrong >= 0.25)
    assert gallery.error_of(tile, np.zeros((5, 5, 3), np.float32)) is None
    assert gallery.error_of(rows[0].tiles[-1], gallery.read_picture(tile.path)) is None


def test_contact_sheet_wraps_many_methods(tmp_path):
    records = [record(f"method-{k:02}", "ant", 20 + k) for k in range(12)]
    path = gallery.write_contact_sheet(write(tmp_path / "refine", records), tmp_path / "s" / "a.png", TABLES, METHODS)
    assert path is not None
    with Image.open(path) as image:
        # 15 pictures in three lines, each with a line of errors
        cell = gallery.SHEET_SIZES.cell_px
        assert image.width == 5 * (cell + 6) + 6 and 6 * cell < image.height < 9 * cell
    (tmp_path / "relight").mkdir()
    assert gallery.write_contact_sheet(tmp_path / "relight", tmp_path / "b.png", TABLES, METHODS) is None
    with pytest.raises(ValueError, match="expected the folder of one of refine, relight"):
        gallery.write_contact_sheet(tmp_path / "s", tmp_path / "b.png")


def test_pictures_are_cut_to_their_object() -> None:
    picture = np.full((100, 80, 3), 0.5, np.float32)
    picture[40:60, 30:34] = 0.9
    rows, columns = gallery.object_window(picture)
    margin = round(gallery.SHEET_SIZES.margin * 100)
    assert (rows, columns) == (slice(40 - margin, 60 + margin), slice(30 - margin, 34 + margin))
    assert picture[gallery.object_window(np.full_like(picture, 0.5))].shape == picture.shape


def test_labels_take_two_lines_and_are_read_on_a_narrow_page(tmp_path, monkeypatch):
    """Letters of a sheet that is shown on a page of 900 px are 14 px high there."""
    sizes: list[tuple[int, int]] = []

    def watched(strips, cell, title, letters, lines):
        page = sheet(strips, cell, title, letters, lines)
        sizes.append((letters, page.shape[1]))
        return page

    monkeypatch.setattr(gallery, "sheet", watched)
    records = [record(f"method-{k:02}", "ant", 20 + k) for k in range(12)]
    gallery.write_contact_sheet(write(tmp_path / "refine", records), tmp_path / "a.png", TABLES, METHODS)
    ((letters, width),) = sizes
    assert letters * 900 / width >= 13.5
    font = ImageFont.load_default(20)
    words = "colours fitted to true views of all sides"
    lines = _wrapped(words, font, 160, 2)
    assert len(lines) == 2 and words.startswith(lines[0]) and lines[1].endswith("…")
    assert all(font.getlength(line) <= 160 for line in lines)
    assert _wrapped("truth", font, 160, 2) == ["truth"] and _wrapped("", font, 160, 2) == []


# ---- the Markdown file


def test_holds_tables_plots_and_sheets_that_are_there(tmp_path):
    folder = plain_run(tmp_path / "refine")
    out = write_markdown([folder], tmp_path / "docs" / "RESULTS.md", "# Results\n\nFive objects.", TABLES, METHODS)
    text = out.read_text()
    assert text.startswith("# Results\n\nFive objects.\n\nMeasured on:\n\n- two cores\n")
    assert "## Made up (Tab. 1)" in text and "3 objects, 3 cases" in text
    rows = [line for line in text.splitlines() if line.startswith("| VoxHammer")]
    assert len(rows) == 1 and "not installed" in rows[0] and not re.search(r"\d", rows[0].split("|")[2])
    links = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert len(links) >= 2 and all((out.parent / link).is_file() for link in links)
    for link in links:
        if link.endswith(".svg"):
            assert ET.parse(out.parent / link).getroot().tag.endswith("svg")
    assert text.count("\n\n*PSNR against seconds*\n") == 1, "a caption: pictures do not show their titles"
    (out.parent / "results" / "refine-of-an-earlier-run.svg").write_text("<svg/>")
    again = write_markdown([folder], tmp_path / "docs" / "RESULTS.md", "# Results\n\nFive objects.", TABLES, METHODS)
    assert again.read_text() == text
    assert not (out.parent / "results" / "refine-of-an-earlier-run.svg").exists()


def test_two_runs_of_a_table_stand_apart(tmp_path):
    """Each has its heading, its pictures and its anchor; runs that cannot be told apart are refused."""
    folders = [
        plain_run(tmp_path / "more-objects" / "refine"),
        write(tmp_path / "optimisers" / "refine", [record("lift", "ant", 20.0), record("3dgs", "ant", 21.0)]),
    ]
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "refine.webp").write_bytes(b"of a run that had the table for itself")
    text = write_markdown(folders, tmp_path / "RESULTS.md", "", TABLES, METHODS).read_text()
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert headings == ["## Made up (Tab. 1): more objects", "## Made up (Tab. 1): optimisers"]
    first, second = text.split(headings[1])
    assert "3 objects, 3 cases" in first and "VoxHammer" in first and "VoxHammer" not in second
    links = [re.findall(r"!\[[^\]]+\]\(results/([^)]+)\)", part) for part in (first, second)]
    assert all(link.startswith("refine-more-objects") for link in links[0]) and len(links[0]) >= 2
    assert all(link.startswith("refine-optimisers") for link in links[1]) and "refine-optimisers.webp" in links[1]
    assert {path.name for path in (tmp_path / "results").iterdir()} == {*links[0], *links[1]}
    page = Page(write_page(folders, tmp_path / "page", TABLES, METHODS).read_text())
    assert [one["id"] for one in page.all("section")] == ["refine-more-objects", "refine-optimisers"]
    twins = [write(tmp_path / part / "run" / "refine", [record("lift", "ant", 20.0)]) for part in "ab"]
    with pytest.raises(ValueError, match=r"^report: expected runs of a table in folders of different names"):
        write_page(twins, tmp_path / "page", TABLES, METHODS)


def test_folders_without_records_are_left_out_and_none_at_all_is_an_error(tmp_path):
    with pytest.raises(ValueError, match=r"^report: expected records of .* in .*relight, found none$"):
        write_markdown([tmp_path / "relight"], tmp_path / "RESULTS.md", "", TABLES, METHODS)
    folder = write(tmp_path / "refine", [record("lift", "ant", 20.0)])
    (tmp_path / "relight").mkdir()
    out = write_markdown([tmp_path / "relight", folder], tmp_path / "R.md", "", TABLES, METHODS)
    assert out.read_text().count("## ") == 1
