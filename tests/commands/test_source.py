"""splatpainter source: what there is and what it lacks, and one picture there and back, by the real command line."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

from splatpainter.sources.registry import describe_sources, source_names
from splatpainter.sources.source_options import is_installed
from tests.support.cli_scenes import Capture, run
from tests.support.fake_services import pixels, png
from tests.support.picture_requests import script

REPOSITORY = Path(__file__).resolve().parents[2]
KEY = "AIza-0123456789-the-key"
COPY = "import shutil, sys; print('90%', flush=True); shutil.copy(sys.argv[1], sys.argv[2])"


@pytest.fixture
def view(tmp_path: Path) -> Path:
    path = tmp_path / "view.png"
    path.write_bytes(png(32, 24, (10, 200, 30)))
    return path


def copy_option(folder: Path, more: str = "") -> str:
    return f'run="{sys.executable}" "{script(folder, COPY)}" {{image}} {{out}} {more}'


def test_list(capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GEMINI_API_KEY", KEY)
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    output = run(capfd, "source", "list")
    assert output.code == 0 and KEY not in output.out
    assert all(f"\n{name:<10} " in f"\n{output.out}" for name in source_names())
    assert "key: in GEMINI_API_KEY" in output.out and "missing: no key: set OPENAI_API_KEY" in output.out
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    assert {status.description.extra for status in describe_sources()} - {""} <= {*extras}
    records = {record["name"]: record for record in run(capfd, "source", "list", "--json").json["sources"]}
    assert records["gemini"]["keys"] == {"variables": ["GEMINI_API_KEY", "GOOGLE_API_KEY"], "set": True}
    assert records["gemini"]["ready"] and records["gemini"]["paid"] and not records["openai"]["ready"]
    assert records["upscale"]["ready"] and KEY not in str(records)
    assert records["diffusers"]["ready"] == (is_installed("diffusers") and is_installed("transformers"))
    one = run(capfd, "source", "list", "openai").out
    assert "base_url=" in one and "OPENAI_BASE_URL" in one and "gemini" not in one
    assert "no source 'x'; available: command, gemini" in run(capfd, "source", "list", "x").error


def test_try(tmp_path: Path, view: Path, capfd: Capture) -> None:
    out = tmp_path / "new.png"
    words = ("source", "try", "command", view, "--source-option", copy_option(tmp_path), "--out", out)
    output = run(capfd, *words)
    assert output.code == 0, output.err
    assert output.out.splitlines()[0] == f"{view} -> {out} (32x24)"
    assert (pixels(out.read_bytes()) == (10, 200, 30)).all()
    assert f"{out}: already exists" in run(capfd, *words).error
    record = run(capfd, *words, "--overwrite", "--json").json
    assert record["size"] == [32, 24] and record["source"] == "command" and record["seed"] is None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new.png", "tool.py", "view.png"]


def test_try_with_everything(tmp_path: Path, view: Path, capfd: Capture) -> None:
    mask, out = tmp_path / "mask.png", tmp_path / "new.png"
    mask.write_bytes(png(64, 48, (255, 255, 255)))
    option = copy_option(tmp_path, "{mask} {prompt} {seed} {references} {scale}")
    words = ["source", "try", "command", view, "--source-option", option, "--mask", mask, "--prompt", "moss"]
    output = run(capfd, *words, "--seed", 4, "--reference", view, view, "--scale", 2, "--out", out, "--json")
    assert output.json["seed"] == 4 and output.json["prompt"] == "moss"
    larger = run(capfd, "source", "try", "upscale", view, "--scale", 2, "--out", tmp_path / "larger.png")
    assert larger.code == 0 and "(64x48)" in larger.out


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["nowhere"], "source 'nowhere': no such source"),
        (["upscale"], "does not take an enlargement of 1"),
        (["upscale", "--scale", 2, "--prompt", "moss"], "source upscale: does not take a prompt"),
        (["command", "--source-option", "rum=x"], "source command: no option 'rum'; perhaps you meant run"),
        (["command", "--source-option", "run"], "--source-option: expected KEY=VALUE, got 'run'"),
        (["command"], "source command: needs the option run"),
        (["gemini", "--prompt", "moss"], "source gemini: needs a key in the environment: set GEMINI_API_KEY"),
        (["gemini"], "source gemini: needs a prompt"),
    ],
)
def test_what_is_refused(
    tmp_path: Path, view: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch, words: list[object], line: str
) -> None:
    for name in ("GEMINI_API_KEY", "GOOGLE_API_KEY"):
        monkeypatch.delenv(name, raising=False)
    out = tmp_path / "new.png"
    assert line in run(capfd, "source", "try", words[0], view, *words[1:], "--out", out).error
    assert not out.exists()


def test_files_that_are_refused(tmp_path: Path, view: Path, capfd: Capture) -> None:
    def error(picture: Path, *words: object, out: Path = tmp_path / "new.png") -> str:
        return run(capfd, "source", "try", "upscale", picture, "--scale", 2, *words, "--out", out).error

    assert "expected a name ending in .png" in error(view, out=tmp_path / "new.jpg")
    assert "is an input" in error(view, "--overwrite", out=view)
    assert "no such file" in error(tmp_path / "x.png")
    (tmp_path / "mask.png").write_bytes(png(32, 32))
    assert "mask.png: expected the size of the picture (32x24)" in error(view, "--mask", tmp_path / "mask.png")
    (tmp_path / "mask.png").write_bytes(png(32, 24, (0, 0, 0)))
    assert "mask.png: empty mask" in error(view, "--mask", tmp_path / "mask.png")


def test_commands_of_source(capfd: Capture) -> None:
    assert "expected one of list, try, got 'lost'" in run(capfd, "source", "lost").error
    assert run(capfd, "source").out.startswith("usage: splatpainter source COMMAND")
    for name in ("list", "try"):
        assert run(capfd, "source", name, "--help").out.startswith(f"usage: splatpainter source {name}")
