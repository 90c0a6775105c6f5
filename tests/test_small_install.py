"""What the core alone can do: every job of an artist, in processes in which nothing of the extras can be imported."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.support.cli_scenes import ball, saved

ROOT = Path(__file__).resolve().parents[1]
CORE = ("numpy", "pillow", "backports.zstd", "tyro", "docstring-parser", "tqdm", "platformdirs")
"""What `pip install splatpainter` brings, besides what these bring along."""
BLOCKED = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {names}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Blocked())
from splatpainter.cli import main
sys.exit(main())
"""
EXTRAS = {
    "torch", "safetensors", "numba", "llvmlite", "scipy", "OpenImageIO", "fastapi", "uvicorn", "httpx", "yaml",
    "jinja2", "trimesh", "mitsuba", "spandrel", "splatpainter_networks",
}  # fmt: skip


def run_core(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    program = [sys.executable, "-c", BLOCKED.format(names=EXTRAS), *words]
    return subprocess.run(program, cwd=folder, capture_output=True, encoding="utf-8", timeout=300)


def done(words: str, folder: Path) -> str:
    result = run_core(words.split(), folder)
    assert result.returncode == 0, (words, result.stderr)
    return result.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With an asset and two edited pictures of it."""
    made = tmp_path_factory.mktemp("core")
    done("demo --size 160 --out demo", made)
    return made


def test_the_core_asks_for_little() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = {line.split(">")[0].split("[")[0] for line in project["dependencies"]}
    assert names == set(CORE)


@pytest.mark.parametrize(
    "words",
    [
        "edit demo/asset.ply demo/edited.png --out local.ply",
        "edit demo/asset.ply demo/regraded.png --mode global --out global.ply",
        "edit demo/asset.ply demo/edited.png --mode spread --out spread.ply",
        "grade demo/asset.ply --exposure 0.3 --out graded.ply",
        "render demo/asset.ply --views 2 --size 64 --aov normal,depth --out views",
        "convert demo/asset.ply small.spz",
        "convert demo/asset.ply small.sog",
        "convert demo/asset.ply page.html",
        "info demo/asset.ply",
        "verify demo/asset.ply demo/painted.ply",
        "turntable demo/asset.ply --size 64 --seconds 1 --fps 2 --out turn.webp",
    ],
)
def test_a_job_needs_nothing_of_the_extras(words: str, folder: Path) -> None:
    done(words, folder)


def test_a_wide_edit_moves_gaussians_without_torch(tmp_path: Path) -> None:
    """Steps of 3DGS included (lift/local/wide_edit.py), on few Gaussians."""
    saved(tmp_path / "ball.ply", ball(300))
    done("render ball.ply --views 1 --size 64 --out views", tmp_path)
    picture = "views/view_000.png"
    from PIL import Image, ImageFilter

    with Image.open(tmp_path / picture) as image:
        sharpened = image.convert("RGB").filter(ImageFilter.UnsharpMask(2, 150, 0))
    sharpened.save(tmp_path / "sharp.png")
    done("edit ball.ply sharp.png --camera views/view_000.json --method fit --out fit.ply", tmp_path)


@pytest.mark.parametrize(
    ("words", "missing", "extra"),
    [
        ("edit demo/asset.ply demo/regraded.png --mode global --preset rows --out x.ply", "torch", "networks"),
        ("train rows --out run", "torch", "networks"),
        ("studio demo/asset.ply --no-browser", "uvicorn", "studio"),
    ],
)
def test_what_is_missing_is_said_in_one_line(words: str, missing: str, extra: str, folder: Path) -> None:
    result = run_core(words.split(), folder)
    assert result.returncode == 2 and result.stderr.count("\n") == 1, result.stderr
    assert missing in result.stderr and f"pip install 'splatpainter[{extra}]'" in result.stderr
    assert not (folder / "x.ply").exists()
