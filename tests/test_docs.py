"""What the documents say of the repository: files that they name are there; README's example runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [
    path
    for path in [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        ROOT / "web" / "README.md",
        *ROOT.glob("benchmarks/*.md"),
    ]
    if path.name not in ("LOG.md", "cli.md")  # a log speaks of its day; the reference is made from the help
]
FOLDERS = ("src/", "tests/", "benchmarks/", "scripts/", "examples/", "docs/", "web/")
MAX_README_LINES = 120


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_that_a_document_names_are_there(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    links = {link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link}
    missing = {link for link in links if not (document.parent / link).exists() and link != "reference/cli.md"}
    quoted = {name for name in re.findall(r"`([\w./-]+)`", text) if name.startswith(FOLDERS)}
    missing |= {name for name in quoted if not (ROOT / name).exists()}
    assert not missing


def test_sources_cite_only_documents_of_the_repository() -> None:
    """Documents that a source speaks of are there, or the program writes them (their name is a string)."""
    sources = {
        path: path.read_text(encoding="utf-8")
        for folder in ("src", "benchmarks", "tests", "scripts", "web/src")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".ts", ".tsx")
    }
    written = {name for text in sources.values() for name in re.findall(r"[\"'/]([\w{}.]+\.md)[\"']", text)}
    present = {path.name for path in DOCUMENTS} | {"LOG.md", "cli.md"}
    cited = {(path, name) for path, text in sources.items() for name in re.findall(r"\b([A-Za-z_]+\.md)\b", text)}
    missing = {f"{path.relative_to(ROOT)}: {name}" for path, name in cited if name not in present | written}
    assert not missing


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < MAX_README_LINES
