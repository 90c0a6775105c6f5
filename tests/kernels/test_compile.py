"""Kernels are compiled once, found again, and never stale."""

from __future__ import annotations

import subprocess
import sys

import pytest

from splatpainter.kernels import compile as warmup


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of two kernel files and one unrelated file, with caches as numba names them."""
    home = tmp_path / "package"
    for name in ("rendering/cpu/projection.py", "rendering/cpu/geometry.py", "voxels/raycast.py", "cli.py"):
        file = home / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("# code\n")
        (file.parent / "__pycache__").mkdir(exist_ok=True)
        for suffix in ("walk-3.py311.nbi", "walk-3.py311.1.nbc"):
            (file.parent / "__pycache__" / f"{file.stem}.{suffix}").write_text("compiled")
    registry = {"package.a:warm": ("rendering/cpu",), "package.b:warm": ("voxels/raycast.py",)}
    monkeypatch.setattr(warmup, "PACKAGE", home)
    monkeypatch.setattr(warmup, "WARMUPS", registry)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return home


def cached(home):
    return sorted(path.name.split(".")[0] for path in home.rglob("*.nbi"))


def test_an_edit_drops_the_kernels_that_may_use_it_and_no_others(package):
    warmup.drop_stale()  # never seen before: nothing is known about these caches
    assert cached(package) == ["cli"]
    for name in ("projection", "geometry"):
        (package / "rendering/cpu/__pycache__" / f"{name}.walk-3.py311.nbi").write_text("compiled")
    (package / "voxels/__pycache__/raycast.walk-3.py311.nbi").write_text("compiled")
    warmup.drop_stale()
    assert cached(package) == ["cli", "geometry", "projection", "raycast"]
    (package / "rendering/cpu/geometry.py").write_text("# edited\n")
    warmup.drop_stale()
    assert cached(package) == ["cli", "raycast"]


def test_compiles_once_per_source_and_machine(package, monkeypatch, capsys):
    runs = []
    monkeypatch.setattr(warmup, "_compile", runs.append)
    warmup.ensure_compiled()
    line = capsys.readouterr().err
    assert line.startswith("splatpainter: compiling CPU kernels") and line.count("\n") == 1 and len(runs) == 1
    warmup.ensure_compiled()
    assert len(runs) == 1 and capsys.readouterr().err == ""
    (package / "cli.py").write_text("# edited\n")
    warmup.ensure_compiled()
    assert len(runs) == 1
    (package / "voxels/raycast.py").write_text("# edited\n")
    warmup.ensure_compiled(progress=False)
    assert len(runs) == 2 and capsys.readouterr().err == ""
    monkeypatch.setattr(warmup, "_machine", lambda: "another")
    warmup.ensure_compiled(progress=False)
    assert len(runs) == 3


def test_a_folder_that_cannot_be_written(package, monkeypatch, tmp_path):
    blocked = package / "rendering/cpu/__pycache__"
    for file in blocked.iterdir():
        file.unlink()
    blocked.rmdir()
    blocked.write_text("a file where the folder should be")
    runs = []
    monkeypatch.setattr(warmup, "_compile", runs.append)
    warmup.ensure_compiled(progress=False)
    warmup.ensure_compiled(progress=False)
    assert len(runs) == 1 and list((tmp_path / "cache").rglob(warmup.STAMP))


def test_failure_is_one_line_and_is_not_remembered(package, monkeypatch):
    monkeypatch.setattr(warmup, "COMMAND", "raise ValueError('no such kernel')  # {!r}")
    for _ in range(2):
        with pytest.raises(RuntimeError, match="compiling CPU kernels failed: ValueError: no such kernel"):
            warmup.ensure_compiled(progress=False)


def test_afterwards_nothing_is_compiled_and_numba_is_not_imported():
    """The real thing, in fresh interpreters: the first may have to compile, the others only load."""
    first = "from splatpainter.kernels.compile import ensure_compiled; ensure_compiled()"
    again = first + "; import sys; assert 'numba' not in sys.modules and 'torch' not in sys.modules"
    use = (
        "import numpy as np, splatpainter as sp\n"
        "from splatpainter.rendering.cpu import backproject, backward, projection, rasterize, sirt, tile_binning\n"
        "from splatpainter.rendering.cpu.projected_view import project as project\n"
        "from splatpainter.rendering.cpu.views import render_views, render_views_backward\n"
        "v = np.full((3, 3), 0.3, np.float32)\n"
        "s = sp.Splats(v, np.ones((3, 4), np.float32), v, v[:, 0], v[:, None])\n"
        "c = sp.look_at([0, 0, 3], [0, 0, 0], width=40, height=30)\n"
        "d = render_views(s, [c, c], contributions=True, keep_views=True)\n"
        "render_views_backward(s, d, d.colors, d.alphas, d.depths)\n"
        "f = project(s, c, gaussian_mask=np.ones(3, bool), tiles=np.eye(2, 3) > 0)\n"
        "f.sirt_step(f.rasterize(f.colors)[0], np.ones((30, 40)), f.colors)\n"
        "sirt.sirt_steps(f, f.rasterize()[0], np.ones((30, 40)), np.ones(len(f), bool))\n"
        "kernels = [projection.project_gaussians, tile_binning.sort_depths, tile_binning.gather_sorted,\n"
        "           tile_binning.list_pairs, tile_binning.place_pairs, rasterize.rasterize_tiles,\n"
        "           backproject.backproject_tiles, backproject.sirt_tiles, backproject.reduce_pairs,\n"
        "           sirt.cache_tiles, sirt.cached_step_tiles,\n"
        "           backward.rasterize_backward_tiles, projection.project_gaussians_backward]\n"
        "for k in kernels:\n"
        "    assert len(k.signatures) == 1, (k, k.signatures)\n"
        "    assert not k.stats.cache_misses and k.stats.cache_hits, (k, k.stats)\n"
    )
    for script in (first, again, use):
        result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
        assert result.returncode == 0, result.stderr
