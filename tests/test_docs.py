"""What the documents say of the repository: files that they name are there, README's example runs, tables of keys and
variables are complete."""

from __future__ import annotations

import json
import re
import runpy
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.commands.demo import HALF_TURN
from splatpainter.demo_asset import demo_asset
from splatpainter.io.axes import flip
from splatpainter.receipts import Pixelation, Receipt, ViewScore
from tests.support.cli_scenes import Capture, run

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [
    path
    for path in [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        ROOT / "web" / "README.md",
        *ROOT.glob("benchmarks/*.md"),
        *ROOT.glob("train/*.md"),
        *ROOT.glob("examples/**/*.md"),
        ROOT / "integrations" / "comfyui" / "README.md",
    ]
    # A log speaks of its day; the reference is made from the help.
    if path.parent.name != "log" and path.name != "cli.md"
]
FOLDERS = ("src/", "tests/", "benchmarks/", "train/", "scripts/", "examples/", "docs/", "web/")
MAX_README_LINES = 120
OTHER_PROGRAMS = {"ADAPTERS.md"}
"""Documents that speak of programs of other systems."""


@cache
def programs() -> tuple[str, ...]:
    """Every Python and TypeScript file of the repository."""
    folders = (
        "src",
        "tests",
        "train",
        "benchmarks",
        "scripts",
        "native",
        "examples",
        "integrations",
        "web/src",
        "web/test",
    )
    roots = (ROOT / name for name in folders)
    files = [path for root in roots for ending in ("py", "ts", "tsx") for path in root.rglob(f"*.{ending}")]
    return tuple("/" + path.relative_to(ROOT).as_posix() for path in files)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_that_a_document_names_are_there(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    links = {link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link}
    missing = {link for link in links if not (document.parent / link).exists() and link != "reference/cli.md"}
    quoted = {name for name in re.findall(r"`([\w./-]+)`", text) if name.startswith(FOLDERS)}
    missing |= {name for name in quoted if not (ROOT / name).exists()}
    if document.name not in OTHER_PROGRAMS:
        modules = set(re.findall(r"`([\w./-]+\.(?:py|tsx?))`", text))
        missing |= {name for name in modules if not any(path.endswith("/" + name) for path in programs())}
    assert not missing


def test_the_readmes_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("demo").mkdir()
    sp.write("demo/asset.ply", flip(demo_asset(), HALF_TURN))
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    asset = names["asset"]
    assert isinstance(asset, sp.Asset) and asset.receipt is not None
    assert len(asset.receipt.touched) > 100, "the painted rectangle lies on the asset"
    assert sp.verify("demo/asset.ply", "by_hand.ply", asset.receipt).ok


def test_the_readme_shows_what_verify_prints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture) -> None:
    monkeypatch.chdir(tmp_path)
    for words in ("demo --out demo", "edit demo/asset.ply demo/edited.png --out painted.ply"):
        assert run(capfd, *words.split()).code == 0
    printed = run(capfd, "verify", "demo/asset.ply", "painted.ply").out.splitlines()
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "\n".join(f"    {line}" for line in printed) + "\n" in readme


def test_sources_cite_only_documents_of_the_repository() -> None:
    """Documents that a source speaks of are there, or the program writes them (their name is a string)."""
    sources = {
        path: path.read_text(encoding="utf-8")
        for folder in ("src", "train", "benchmarks", "tests", "scripts", "web/src")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".ts", ".tsx")
    }
    written = {name for text in sources.values() for name in re.findall(r"[\"'/]([\w{}.]+\.md)[\"']", text)}
    present = {path.name for path in DOCUMENTS} | {"cli.md"}
    cited = {(path, name) for path, text in sources.items() for name in re.findall(r"\b([A-Za-z_]+\.md)\b", text)}
    missing = {f"{path.relative_to(ROOT)}: {name}" for path, name in cited if name not in present | written}
    assert not missing


def test_every_environment_variable_is_documented() -> None:
    sources = (path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    names = {name for text in sources for name in re.findall(r'"(SPLATPAINTER_[A-Z]+)"', text)}
    page = (ROOT / "docs" / "guide" / "environment.md").read_text(encoding="utf-8")
    assert len(names) > 5 and {name for name in names if f"| `{name}` |" not in page} == set()


def test_every_key_of_a_receipt_is_documented() -> None:
    rows, none = np.arange(1), np.zeros(0, np.int64)
    everything = Receipt(
        *("", 1, "", 1, "local", "lift", "lift", rows, 0, "", ""),
        views=(ViewScore(None, None, None),),
        replaced=rows,
        removed=none,
        aside=((None, 0.0),),
        limited_px=(1.0,),
        precision="float32",
        dropped={},
        source={},
        merge={},
        merge_touched=rows,
        options=sp.WriteOptions(sh_degree=1),
        core="0123456789ab",
        pixelation=Pixelation(rows, 1, 1, "cells", 0.1, 0, False),
        operations=({"kind": "grade"},),
    )
    record = json.loads(everything.to_json())
    keys = {*record, *record["views"][0], *record["aside"][0], *record["pixelation"], *record["operations"][0]}
    page = (ROOT / "docs" / "guide" / "receipts.md").read_text(encoding="utf-8")
    assert {key for key in keys if f"`{key}`" not in page} == set()


def test_prose_is_in_lines_that_a_diff_can_show() -> None:
    """scripts/wrap_docs.py wraps them; tables and code may be longer."""
    script = runpy.run_path(str(ROOT / "scripts" / "wrap_docs.py"))
    texts = {path: path.read_text(encoding="utf-8") for path in script["documents"]()}
    long = {path.relative_to(ROOT).as_posix() for path, text in texts.items() if script["wrapped"](text) != text}
    assert long == set()


def figures(pattern: str, document: str) -> list[float]:
    """Of the last column, in the first table that has such a line."""
    line, *_ = re.findall(rf"^\| {pattern}.*$", (ROOT / document).read_text(encoding="utf-8"), re.MULTILINE)
    return [float(figure) for figure in re.findall(r"\d+\.?\d*", line.split("|")[-2])]


@pytest.mark.parametrize(
    ("readme", "rows", "unit"),
    [
        (r"render, 512 px", ("render \\|", "render and gradients of every attribute \\|"), 1),
        (r"a dab of 64 px", ("local edit, dab of 64 px",), 1000),
        (r"one regraded view", ("global edit from one view \\|",), 1000),
        (r"`splatpainter edit` above", ("the demo's `splatpainter edit`",), 1),
    ],
)
def test_the_readmes_figures_are_those_of_the_page_of_numbers(readme: str, rows: tuple[str, ...], unit: int) -> None:
    """Rounded."""
    stated = figures(readme, "README.md")
    measured = [figures(row, "docs/numbers.md")[0] / unit for row in rows]
    assert len(stated) == len(measured)
    for short, exact in zip(stated, measured, strict=True):
        assert abs(short - exact) <= 0.06 * exact + 0.005


def test_the_readme_and_the_first_page_say_the_same() -> None:
    readme, index = (
        " ".join((ROOT / name).read_text(encoding="utf-8").split()) for name in ("README.md", "docs/index.md")
    )
    for sentence in ("in about a second", "two CPU cores open a capture"):
        assert sentence in readme and sentence in index


def test_the_readmes_extras_are_the_packages() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    extras = set(
        re.findall(r"^(\w+) = \[", text.split("[project.optional-dependencies]")[1].split("\n\n")[0], re.MULTILINE)
    )
    install = (ROOT / "README.md").read_text(encoding="utf-8").split("## Install")[1].split("Nothing is on")[0]
    assert len(extras) > 8 and set(re.findall(r"`(\w+)`", install)) <= extras


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < MAX_README_LINES
