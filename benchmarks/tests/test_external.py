"""What adapters are made of: calls of other programs, frames, hulls, results."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
from splatbench.adapters import adapters_file, coordinate_frames, datasets, systems
from splatbench.adapters.coordinate_frames import ASSET as ASSET_FRAME
from splatbench.adapters.coordinate_frames import Cube
from splatbench.process import last_log_line, run_command

from benchmarks.tests.support.blobs import ASSET, MEANS, MIDDLE, SIZE, work
from splatpainter import io
from splatpainter.system import processes
from tests.support.systems import posix_only


def has_ended(pid: int) -> bool:
    """Whether a process has ended (perhaps not yet collected by whoever inherited it)."""
    status = Path(f"/proc/{pid}/stat")
    return not status.exists() or status.read_text().rsplit(")", 1)[1].split()[0] == "Z"


@posix_only
def test_a_system_that_takes_too_long_is_ended_with_all_that_it_started(tmp_path):
    grandchild = (
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(60)"
    )
    program = f"""
import subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", {grandchild!r}])
open({str(tmp_path / "pid")!r}, "w").write(str(child.pid))
print("12% done\\r13% done", flush=True)
time.sleep(60)
"""
    start = time.monotonic()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(processes, "GRACE_SECONDS", 0.3)
        with pytest.raises(ValueError, match=r"took longer than 1 s; (13% done|up) \(log"):
            run_command([sys.executable, "-c", program], tmp_path, tmp_path / "log.txt", timeout=1)
    assert time.monotonic() - start < 30
    assert has_ended(int((tmp_path / "pid").read_text()))


@pytest.mark.skipif(not Path("/proc").exists(), reason="needs /proc")
def test_a_process_that_is_killed_takes_its_system_along(tmp_path):
    program = f"import os, time; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(600)"
    caller = f"""
import sys
from pathlib import Path
from splatbench.process import run_command
here = Path({str(tmp_path)!r})
run_command([sys.executable, "-c", {program!r}], here, here / "log.txt", timeout=600)
"""
    parent = subprocess.Popen([sys.executable, "-c", caller])
    pid = tmp_path / "pid"
    until = time.monotonic() + 60
    while not (pid.exists() and pid.read_text()) and time.monotonic() < until:
        time.sleep(0.05)
    system = int(pid.read_text())
    assert not has_ended(system)
    parent.kill()
    assert parent.wait(30) == -9
    until = time.monotonic() + 60
    while not has_ended(system) and time.monotonic() < until:
        time.sleep(0.05)
    assert has_ended(system)


def test_a_call_has_the_environment_that_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/of/this/process")
    program = (
        "import os, sys; print(os.environ.get('PYTHONPATH'), os.environ['MINE'], os.environ['PATH'].split(':')[0])"
    )
    program += "; print(repr(sys.stdin.read())); print(os.getcwd())"
    log = tmp_path / "log.txt"
    seconds = run_command(
        [sys.executable, "-c", program],
        tmp_path,
        log,
        timeout=30,
        environment={"MINE": "yes"},
        python=sys.executable,
    )
    lines = log.read_text().splitlines()[-3:]
    assert lines == [f"None yes {os.path.dirname(sys.executable)}", "''", str(tmp_path)] and 0 < seconds < 30
    with pytest.raises(ValueError, match=r"program x: cannot be started \(No such file"):
        run_command(["/no/such/program", "x"], tmp_path, log, timeout=1)


def test_the_last_line_of_a_log_is_one_that_says_something(tmp_path):
    log = tmp_path / "log"
    log.write_bytes(b"$ python x\n  File a\n\x1b[31mValueError: bad \xff thing\x1b[0m\n    ^^^^^\n\n---\n")
    assert last_log_line(log).startswith("ValueError: bad ")
    log.write_bytes(b"first\n 10%|#   |\r 50%|##  |\r\n$ python y\n")
    assert last_log_line(log) == "", "what the command before said is not this one's"
    log.write_bytes(b"first\n 10%|#   |\r 50%|##  |\r\n")
    assert last_log_line(log) == "50%|##  |"


# ---- parts


def test_a_hull_is_closed_and_holds_its_voxels():
    vertices, faces = datasets.voxel_surface(np.ones((1, 1, 1), bool))
    assert len(vertices) == 8 and len(faces) == 12
    volume = np.random.default_rng(0).random((5, 6, 7)) < 0.4
    vertices, faces = datasets.voxel_surface(volume)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert abs(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 - volume.sum()) < 1e-9  # divergence theorem
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth = {tuple(edge): 0 for edge in directed.tolist()}
    for x, y in directed.tolist():
        forth[x, y] = forth[x, y] + 1
    assert all(count == forth.get((y, x)) for (x, y), count in forth.items()), "every edge is used both ways"


def test_frames_go_there_and_back(tmp_path):
    cube = Cube.of(ASSET)
    lo, size = cube.min_corner, cube.extent
    for upright in (True, False):
        frame = cube.frame(upright=upright)
        corners = frame.points(np.array([lo, lo + size, lo + size / 2]))
        assert abs(np.sort(corners[:2], 0) - [[-0.5] * 3, [0.5] * 3]).max() < 1e-12 and abs(corners[2]).max() < 1e-12
        back = (frame.points(MEANS) - np.array(frame.shift)) @ frame.rotation / frame.scale
        assert abs(back - MEANS).max() < 1e-12
    up = cube.frame(upright=True)
    assert up.points(MIDDLE + (0, 0.1, 0))[2] > up.points(MIDDLE)[2], "y up becomes z up"
    # glTF -> Blender, which VoxHammer's mask takes: (x, y, z) -> (x, -z, y).
    x, y, z = cube.frame(upright=False).points(MEANS).T
    assert abs(np.stack([x, -z, y], 1) - up.points(MEANS)).max() < 1e-12
    for text in ("{}", "[]", '{"transform": [[1, 0, 0, 0]], "scale": 1}', '{"transform": 1, "scale": 0}', "no"):
        (tmp_path / "t.json").write_text(text)
        with pytest.raises(ValueError, match="expected nerfstudio's transform"):
            coordinate_frames.nerfstudio_frame(tmp_path / "t.json")


def test_upright_voxels_agree_with_the_frame():
    cube = Cube.of(ASSET)
    volume = datasets.upright(datasets.occupied(ASSET, cube))
    frame = cube.frame(upright=True)
    cells = np.floor((frame.points(MEANS) + 0.5) * 64).astype(int)
    assert volume[tuple(cells.T)].all() and volume.sum() < 0.1 * volume.size


def test_an_edit_that_reaches_nothing_has_no_region():
    mask = np.zeros((1, SIZE, SIZE), bool)
    mask[0, 0, 0] = True
    with pytest.raises(ValueError, match="reaches nothing"):
        datasets.edit_region(ASSET, Cube.of(ASSET), work().step.edited, mask)


def test_results_are_refused_where_they_are_no_asset(tmp_path):
    with pytest.raises(ValueError, match="the system wrote no such file"):
        coordinate_frames.read_result(tmp_path / "none.ply", ASSET_FRAME)
    broken = replace(ASSET, means=np.full_like(ASSET.means, np.nan))
    io.write(tmp_path / "nan.ply", broken)
    with pytest.raises(ValueError, match="holds nothing that can be drawn"):
        coordinate_frames.read_result(tmp_path / "nan.ply", ASSET_FRAME)
    # A GLB of Gaussians keeps its file's own axes, as meshes do.
    io.write(tmp_path / "rows.glb", ASSET)
    result = coordinate_frames.read_result(tmp_path / "rows.glb", ASSET_FRAME)
    assert abs(result.means - ASSET.means * [-1, -1, 1]).max() < 1e-6


def test_the_guide_names_every_key_and_placeholder():
    guide = (Path(__file__).parents[2] / adapters_file.GUIDE).read_text()
    for field in dataclasses.fields(adapters_file.AdapterSection):
        assert field.name == "name" or f"`{field.name}`" in guide, field.name
    for name in systems.PLACEHOLDERS:
        assert name in ("python", "repository") or f"`{{{name}}}`" in guide, name
    for system in adapters_file.SYSTEMS:
        assert f"[{system}]" in guide or system.replace("-", "") in guide.lower().replace("-", ""), system
    for frame in get_args(get_type_hints(adapters_file.AdapterSection)["frame"]):
        assert frame == "" or f"| `{frame}` |" in guide, frame
