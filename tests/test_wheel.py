"""What `pip install splatpainter[studio]` gives, in an empty folder: the wheel, the demo, the studio. No network."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import urllib.request
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import splatpainter
from splatpainter.commands.demo import FRAMES
from splatpainter.system import processes
from splatpainter.system.user_folders import PROJECTS_VARIABLE
from tests.support.cli_scenes import Capture, ball, rows_of, run, saved

ROOT = Path(__file__).resolve().parents[1]
DEMO_FILES = {
    "asset.ply", "before.png", "before.json", "edited.png", "edited.json", "painted.ply", "painted.ply.receipt.json",
    "after.png", "after_left.png", "after_above.png", "regraded.png", "regraded.json", "evening.ply",
    "evening.ply.receipt.json", "evening.png", "overview.png", "turntable.webp",
}  # fmt: skip
BUDGETS = {"": 6_400_000, "server/static/": 1_250_000, "kernels/": 560_000, "demo_asset.sog": 3_000_000}
"""Most packed bytes of the wheel and of its largest parts; with 5.9 MB, 1.12 MB, 0.50 MB and 2.89 MB when these were
set. Who needs more raises them, and says why in the commit."""
BUILD = """import sys
from setuptools.build_meta import build_wheel
build_wheel(sys.argv[1], {"--build-option": ["--compression=stored"]})"""
"""What pip calls, without the second process in which pip asks for metadata first, and without packing 30 MB."""
PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy of the checkout, so that nothing is left in it and no old build gets in."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT / "src", source / "src", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "setup.py", "MANIFEST.in"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "native", source / "native", ignore=shutil.ignore_patterns("__pycache__"))
    # Objects of the same sources and options are not compiled again.
    objects = Path("build", "native", runpy.run_path(str(ROOT / "native" / "build.py"))["target_here"]())
    if (ROOT / objects).is_dir():
        shutil.copytree(ROOT / objects, source / objects)
    build = [sys.executable, "-c", BUILD, str(folder)]
    done = subprocess.run(build, cwd=source, capture_output=True, encoding="utf-8", errors="replace")
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that it is installed into. Its bytecode is that of the checkout, as long as the code is: compiling it
    again would take longer than all tests here."""
    folder = tmp_path_factory.mktemp("site")
    words = ["install", "--no-compile", "--no-deps", "--no-index", "--target", str(folder), str(wheel)]
    done = subprocess.run([*PIP, *words], capture_output=True, encoding="utf-8", errors="replace")
    assert done.returncode == 0, done.stderr
    checkout = Path(splatpainter.__file__).parent
    for source in checkout.rglob("*.py"):
        copy = folder / "splatpainter" / source.relative_to(checkout)
        assert copy.read_bytes() == source.read_bytes()
        os.utime(copy, ns=(source.stat().st_atime_ns, source.stat().st_mtime_ns))
    for cached in checkout.rglob("__pycache__/*.pyc"):
        target = folder / "splatpainter" / cached.relative_to(checkout)
        target.parent.mkdir(exist_ok=True)
        shutil.copy(cached, target)
    return folder


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(float)


def command(installed: Path) -> str:
    """The program that pip made."""
    program = shutil.which("splatpainter", path=os.pathsep.join([str(installed / "bin"), str(installed / "Scripts")]))
    assert program is not None, sorted(installed.iterdir())
    return program


def surroundings(installed: Path, home: Path) -> dict[str, str]:
    """Of its programs: nothing of the checkout."""
    folders = {"XDG_CACHE_HOME": str(home / "cache"), PROJECTS_VARIABLE: str(home / "projects")}
    return {**os.environ, **folders, "PYTHONPATH": str(installed)}


def test_the_wheel_has_what_the_package_needs_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as bundle:
        names = set(bundle.namelist())
        (entry_points,) = (bundle.read(name).decode() for name in names if name.endswith("/entry_points.txt"))
    expected = {
        path.relative_to(ROOT / "src").as_posix()
        for path in (ROOT / "src" / "splatpainter").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    scripts = {name for name in expected if "/server/static/" in name and name.endswith((".js", ".css"))}
    expected = expected - scripts | {f"{name}.gz" for name in scripts}
    packed = {name for name in names if ".dist-info/" not in name}
    assert packed == expected
    assert "splatpainter.cli:main" in entry_points and "bench" not in entry_points, "benches are another distribution"
    for part in ("server/static/index.html", "server/static/studio.js", "weights/", "py.typed"):
        assert any(name.startswith(f"splatpainter/{part}") for name in packed), part
    assert any(name.endswith(".safetensors") for name in packed)
    assert not any("test" in Path(name).name.split("_") or name.startswith(("tests", "web")) for name in names)


@pytest.mark.parametrize("part", BUDGETS)
def test_the_wheel_stays_small(wheel: Path, part: str) -> None:
    with zipfile.ZipFile(wheel) as bundle:
        names = [name for name in bundle.namelist() if name.startswith(f"splatpainter/{part}")]
        packed = sum(len(zlib.compress(bundle.read(name))) for name in names)
    assert 0.7 * BUDGETS[part] < packed < BUDGETS[part]


def test_the_demo_makes_everything_it_promises_in_an_empty_folder(
    installed: Path, tmp_path: Path, capfd: Capture
) -> None:
    """Small, so that it is quick."""
    (tmp_path / "empty").mkdir()
    program = "import splatpainter, sys; print(splatpainter.__file__, 'torch' in sys.modules)"
    variables = surroundings(installed, tmp_path)
    where = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=variables, capture_output=True, encoding="utf-8"
    )
    assert where.stdout.startswith(str(installed)), where
    done = subprocess.run(
        [command(installed), "demo", "--size", "160", "--json"],
        cwd=tmp_path / "empty",
        env=variables,
        capture_output=True,
        encoding="utf-8",
        timeout=600,
    )
    assert (done.returncode, done.stderr) == (0, "")
    out = tmp_path / "empty" / "demo"
    assert {path.name for path in out.iterdir()} == DEMO_FILES
    steps = {step["what"]: step for step in json.loads(done.stdout)["steps"]}

    # The paint is where it was painted, and nowhere else.
    before, edited, after = (pixels(out / f"{name}.png") for name in ("before", "edited", "after"))
    mask = np.abs(edited - before).max(-1) > 12
    assert 0.01 < mask.mean() < 0.2
    assert np.abs(after - edited)[mask].mean() < 0.5 * np.abs(before - edited)[mask].mean()
    assert np.abs(after - before)[~mask].mean() < 1.5
    local = steps["local edit"]
    assert local["psnr_after"] > local["psnr_before"] + 8 and local["psnr_outside"] > 35

    # The proof holds against the files' own bytes.
    old, new = rows_of(out / "asset.ply"), rows_of(out / "painted.ply")
    same = (old == new[: len(old)]).all(1)
    receipt = json.loads((out / "painted.ply.receipt.json").read_text())
    assert int(same.sum()) == local["same_rows"] >= len(old) - receipt["touched_rows"] > 0.9 * len(old)
    assert len(new) - len(old) == receipt["appended_rows"]
    assert run(capfd, "verify", out / "asset.ply", out / "painted.ply").code == 0
    assert run(capfd, "verify", out / "painted.ply", out / "evening.ply").code == 0

    # The regrade is warm: red gains on blue, also from a side that no picture showed.
    day, dusk = (pixels(out / f"{name}.png") for name in ("after_left", "evening"))
    middle = (slice(60, 110), slice(50, 110))
    assert (dusk[middle][..., 0] / dusk[middle][..., 2]).mean() > 1.2 * (
        day[middle][..., 0] / day[middle][..., 2]
    ).mean()

    with Image.open(out / "turntable.webp") as film:
        assert (film.n_frames, film.size) == (FRAMES, (80, 80))  # type: ignore[attr-defined]
    with Image.open(out / "edited.png") as picture:
        stored = json.loads(picture.text["splatpainter"])  # type: ignore[attr-defined]
    assert stored["asset_sha256"] == json.loads((out / "painted.ply.receipt.json").read_text())["asset"]["sha256"]
    assert pixels(out / "overview.png").shape[1] == 1600


def test_the_studio_serves_its_page(installed: Path, tmp_path: Path) -> None:
    """On a small asset, to be quick."""
    (tmp_path / "empty").mkdir()
    asset = saved(tmp_path / "ball.ply", ball(200))
    words = [command(installed), "studio", str(asset), "--no-browser", "--port", "0"]
    pipe = subprocess.PIPE
    server = processes.begin(
        words, cwd=tmp_path / "empty", env=surroundings(installed, tmp_path), stdout=subprocess.DEVNULL, stderr=pipe
    )
    assert server.stderr is not None
    try:
        output: list[bytes] = []
        url = None
        for line in server.stderr:
            output.append(line)
            if url := re.search(rb"http://\S+/", line):
                break
        assert url is not None, output
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        for path, kind in (("", "text/html"), ("studio.js", "text/javascript"), ("api/state", "application/json")):
            with opener.open(url.group().decode() + path, timeout=60) as answer:
                assert answer.status == 200 and answer.headers["content-type"].startswith(kind), path
        processes.interrupt(server)
        server.communicate(timeout=60)
        if sys.platform != "win32":
            assert server.returncode == 0
    finally:
        processes.end(server)
        server.stderr.close()
    assert not list((tmp_path / "empty").iterdir()), "nothing is left where it was started"
