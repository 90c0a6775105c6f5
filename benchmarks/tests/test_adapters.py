"""Rows for systems outside the package: config -> files -> command -> read back, against support/fake_systems.py."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from splatbench.adapters import adapters_file, coordinate_frames, systems
from splatbench.cases import Budget
from splatbench.methods import external as adapters
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from benchmarks.tests.support.blobs import ASSET, answer, edited, flat, moved, same, trellis, work
from benchmarks.tests.support.fake_systems import installed as installed
from benchmarks.tests.support.fake_systems import write
from splatpainter.cameras import look_at
from splatpainter.rendering import render
from splatpainter.voxels.grid import bounding_cube

METHODS = {method.name: method for method in adapters.METHODS}


# ---- whole rows


def test_voxhammer_gets_renders_pictures_and_region_and_its_mesh_comes_back_in_place(installed, tmp_path, monkeypatch):
    monkeypatch.setattr(coordinate_frames, "MESH_SURFELS", 6000)
    lo, size = bounding_cube(ASSET)
    colors = {(0, 1): (1, 0, 0), (0, -1): (0, 1, 0), (1, 1): (0, 0, 1), (1, -1): (1, 1, 0), (2, 1): (0, 1, 1)}
    scene = trimesh.Scene()
    for axis in range(3):
        for side in (1, -1):
            # glTF's frame, y up: a plate 0.36 before the cube's middle; base colour factors are linear.
            extents, middle = np.full(3, 0.6), np.zeros(3)
            extents[axis], middle[axis] = 0.02, 0.36 * side
            plate = trimesh.creation.box(extents)
            plate.apply_translation(middle + (0.05, 0, 0))
            factor = [*(255 * np.array(colors.get((axis, side), (1, 0, 1)))), 255]
            material = PBRMaterial(baseColorFactor=np.array(factor, np.uint8), metallicFactor=0.0)
            plate.visual = TextureVisuals(uv=np.zeros((len(plate.vertices), 2)), material=material)
            scene.add_geometry(plate)
    (tmp_path / "answer").write_bytes(scene.export(file_type="glb"))  # type: ignore[arg-type]

    done = METHODS["voxhammer"].edit(work(), installed("voxhammer"))
    assert len(done.splats) == 6000 and not done.keeps_gaussians and done.edit_seconds > 0 and done.setup_seconds > 0
    for axis in range(3):
        for side in (1, -1):
            direction = np.zeros(3)
            direction[axis] = side
            target = lo + size * (0.5 + np.array([0.05, 0, 0]))
            camera = look_at(target + 4 * size * direction, target, width=9, height=9, fov=3)
            drawn = render(done.splats, camera)
            assert abs(drawn.colors[0, 4, 4] - colors.get((axis, side), (1, 0, 1))).max() < 0.03, (axis, side)
            assert abs(drawn.depths[0, 4, 4, 0] - (4 - 0.37) * size) < 0.02 * size
    assert "region in 3D" in done.note and done.numbers["rows"] == 6000 and done.numbers["unmasked_db"] < 30


def test_vinedresser_runs_in_a_linked_checkout_and_its_latents_are_decoded(installed, tmp_path, monkeypatch):
    assert systems.TRELLIS_VIEWS == 150, "main.py reads so many"
    monkeypatch.setattr(systems, "TRELLIS_VIEWS", 11)
    monkeypatch.setenv("VIEWS", "11")
    answer(tmp_path, trellis(flat(edited())))
    before = sorted(path for path in (tmp_path / "vine").rglob("*") if "__pycache__" not in path.parts)
    done = METHODS["vinedresser3d"].edit(work(), installed("vinedresser3d"))
    assert same(done.splats, flat(edited())) > 40
    after = sorted(path for path in (tmp_path / "vine").rglob("*") if "__pycache__" not in path.parts)
    assert before == after, "the checkout itself is not written to"
    assert done.numbers["export_seconds"] > 0 and 10 < done.numbers["unmasked_db"] < 30


def test_dge_gets_a_colmap_scene_and_gives_back_the_assets_frame(installed, tmp_path):
    answer(tmp_path, edited())
    done = METHODS["dge"].edit(work(), installed("dge"))
    assert same(done.splats, edited()) > 90
    assert np.array_equal(done.splats.means, edited().means), "the asset's own frame: no number changes"
    assert "text" in done.note and "not the edited view" in done.note


def test_instruct_gs2gs_is_brought_back_from_nerfstudios_frame(installed, tmp_path, monkeypatch):
    turn = Rotation.from_euler("xyz", (70, 20, -130), degrees=True).as_matrix()
    shift, scale = np.array([0.4, -1.2, 0.3]), 0.31
    parser = {"transform": np.c_[turn, shift].astype(np.float32).tolist(), "scale": scale}
    (tmp_path / "parser.json").write_text(json.dumps(parser))
    monkeypatch.setenv("PARSER", str(tmp_path / "parser.json"))
    answer(tmp_path, moved(edited(), turn, scale, scale * shift))
    plugin = f"environment = {{ PYTHONPATH = '{tmp_path / 'plugin'}' }}"
    done = METHODS["instruct-gs2gs"].edit(work(), installed("instruct-gs2gs", more=plugin))
    assert same(done.splats, edited()) > 60
    assert abs(done.splats.sh - edited().sh).max() < 1e-4, "view dependence turns with the Gaussians"
    assert done.setup_seconds > 0 and done.edit_seconds > 0

    monkeypatch.setenv("STEPS", "0")
    with pytest.raises(ValueError, match=r"took no step \(last checkpoints: set-up 19999, edit 19999\).*27500"):
        METHODS["instruct-gs2gs"].edit(work(), installed("instruct-gs2gs", more=plugin))


def test_relitlrm_runs_a_command_of_the_users_own(installed, tmp_path):
    program = """
        base, edits, out, literal = sys.argv[1:]
        frames = json.loads(Path(base, "transforms.json").read_text())["frames"]
        assert len(frames) == 4
        for frame in frames:
            picture = np.array(Image.open(Path(base) / frame["file_path"]))
            lens = (frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"])
            shows(picture, *seen_opengl(np.array(BLOBS["means"]), frame["transform_matrix"], *lens))
        check_edit(*(Path(edits) / f"{name}_000.png" for name in ("render", "edited", "mask")))
        assert literal == "{}{Not one}" and not os.path.exists("main.py")
        answer(Path(out) / "relit.ply")
    """
    path = write(tmp_path / "mine.py", program)
    answer(tmp_path, edited())
    more = f"command = ['{{python}}', '{path}', '{{base}}', '{{edits}}', '{{out}}', '{{}}{{Not one}}']\n"
    done = METHODS["relitlrm"].edit(
        work("relight"), installed("relitlrm", more=more + "result = 'relit.ply'\nviews = 4")
    )
    assert same(done.splats, edited()) > 90
    assert "4 views" in done.note and "no environment map" in done.note and "command" in done.note


def test_a_users_command_may_answer_in_another_frame(installed, tmp_path):
    answer(tmp_path, trellis(ASSET))
    more = "command = ['{python}', '-c', 'import os, shutil, sys; shutil.copy(os.environ[\"ANSWER\"], sys.argv[1])', "
    more += "'{out}/a.ply']\nresult = 'a.ply'\n"
    done = METHODS["dge"].edit(work(), installed("dge", more=more + "frame = 'trellis'"))
    assert same(done.splats, ASSET) > 60 and done.numbers["unmasked_db"] > 60
    # The same numbers taken as the asset's own frame lie elsewhere: no figure, but a line that says so.
    with pytest.raises(ValueError, match=r"times as large as the asset and .* does `frame`"):
        METHODS["dge"].edit(work(), installed("dge", more=more))


# ---- what goes wrong


@pytest.mark.parametrize(
    ("program", "line"),
    [
        ("raise RuntimeError('CUDA out of memory')", r"status 1; RuntimeError: CUDA out of memory \(log: .*log\.txt\)"),
        ("import sys; sys.exit(3)", r"ended with status 3; it said nothing \(log"),
        ("pass", r"ended without an error but wrote no dge/edit/save/last\.ply in"),
        ("answer(Path(words['exp_root_dir']) / 'dge/edit/save/last.ply')", r"last\.ply.*(PLY|ply|header)"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "ended by signal 9"),
    ],
)
def test_a_failing_system_is_one_line_with_its_log(installed, tmp_path, program, line):
    (tmp_path / "answer").write_bytes(b"ply\nthis is none")
    words = "words = {w.split('=', 1)[0]: json.loads(w.split('=', 1)[1]) for w in sys.argv[4:]}\n"
    write(tmp_path / "dge" / "launch.py", words + program if "words" in program else program, "words" in program)
    budget = installed("dge", views=1)
    with pytest.raises(ValueError, match=line) as caught:
        METHODS["dge"].edit(work(), budget)
    assert "\n" not in str(caught.value)
    (log,) = (tmp_path / "scratch").glob("dge-*/log.txt")
    assert "launch.py --config configs/dge.yaml" in log.read_text()


def test_what_is_kept_of_a_job(installed, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    answer(tmp_path, edited())
    budget = replace(installed("dge"), scratch=None)
    METHODS["dge"].edit(work(), budget)
    assert not list((tmp_path / "temporary").iterdir())
    METHODS["dge"].edit(work(), installed("dge"))
    (folder,) = (tmp_path / "scratch").glob("dge-*")
    assert [path.name for path in folder.iterdir()] == ["log.txt"], "renders and results are large"
    write(tmp_path / "dge" / "launch.py", "raise SystemExit('not today')", checks=False)
    with pytest.raises(ValueError, match="not today"):
        METHODS["dge"].edit(work(), budget)
    assert len(list((tmp_path / "temporary").glob("dge-*/log.txt"))) == 1


# ---- the adapters file


def test_nothing_installed_is_said_for_every_system(tmp_path):
    for name, method in METHODS.items():
        assert method.missing(Budget()) == f"not installed: add [{name}] to the adapters file (docs/ADAPTERS.md)"
        with pytest.raises(ValueError, match="not installed"):
            method.edit(work(), Budget())
    assert list(METHODS) == list(adapters_file.SYSTEMS)
    assert {n: m.protocols for n, m in METHODS.items()} == dict.fromkeys(METHODS, ("creative",)) | {
        "relitlrm": ("relight",)
    }
    path = tmp_path / "adapters.toml"
    path.write_text("[voxhamer]\n")
    assert "[voxhamer] is not one of voxhammer" in METHODS["voxhammer"].missing(Budget(adapters=path))


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("repository = 'nowhere'\npython = 'python3'", "repository: no folder .*nowhere"),
        ("repository = '.'\npython = 'python3'", "has no launch.py; is it a checkout of dge"),
        ("python = 'python3'", "has no `repository`"),
        ("repository = 'dge'", "has no `python`"),
        ("repository = 'dge'\npython = './none/python'", "python: no program .*none/python"),
        ("repository = 'dge'\npython = 'python3'\nenviroment = {}", "unknown key 'enviroment'; known there: "),
        ("repository = 'dge'\npython = 'python3'\nviews = 2.5", r"\[dge\]: expected int as 'views', got 2.5"),
        ("repository = 'dge'\npython = 'python3'\ntimeout_seconds = -1", "timeout_seconds: expected seconds above 0"),
        ("repository = 'dge'\npython = 'python3'\narguments = 'a b'", "expected a list as 'arguments'"),
        ("repository = 'dge'\npython = 'python3'\nenvironment = { A = 1 }", "expected str as 'environment.A', got 1"),
        ("repository = 'dge'\npython = 'python3'\ndevice = 'tpu'", "expected one of cuda, cpu as 'device'"),
        ("repository = 3", "expected a path as 'repository'"),
        ("repository = 'dge", "cannot be read as the adapters file"),
        ("repository = 'dge'\npython = 'python3'", "needs a CUDA GPU"),
    ],
)
def test_what_is_wrong_with_a_section_is_said(installed, tmp_path, monkeypatch, text, line):
    monkeypatch.setattr(adapters_file, "has_cuda_gpu", lambda: False)
    path = tmp_path / "bad.toml"
    path.write_text(f"[dge]\n{text}\n")
    method = METHODS["dge"]
    why = method.missing(Budget(adapters=path))
    assert re.search(line, why) and "\n" not in why
    assert method.version(Budget(adapters=path))
    with pytest.raises(ValueError, match=line):
        method.edit(work(), Budget(adapters=path))


def test_systems_say_what_else_they_need(installed, tmp_path, monkeypatch):
    budget = installed("relitlrm")
    assert METHODS["relitlrm"].missing(budget).startswith("no code is public: [relitlrm] needs a `command`")
    budget = installed("relitlrm", more="command = ['x', '{environment_map}']")
    assert "environment map is not among" in METHODS["relitlrm"].missing(budget)
    budget = installed("relitlrm", more="command = ['{python}', '{nothing}']")
    with pytest.raises(ValueError, match=r"unknown placeholder \{nothing\}; known here: asset, base"):
        METHODS["relitlrm"].edit(work("relight"), budget)
    assert METHODS["vinedresser3d"].missing(installed("vinedresser3d")) == ""
    assert "reads 150, got 20" in METHODS["vinedresser3d"].missing(installed("vinedresser3d", more="views = 20"))
    monkeypatch.delenv("GEMINI_API_KEY")
    monkeypatch.delenv("GOOGLE_API_KEY", raising=False)
    assert "GEMINI_API_KEY or GOOGLE_API_KEY" in METHODS["vinedresser3d"].missing(installed("vinedresser3d"))
    missing_file = Budget(adapters=tmp_path / "none.toml")
    assert "none.toml: cannot be read as the adapters file (No such file" in METHODS["dge"].missing(missing_file)


def test_a_version_changes_with_what_may_change_results(installed, tmp_path):
    version = METHODS["dge"].version
    first = version(installed("dge"))
    assert first == version(installed("dge", more="environment = { API_KEY = 'x' }"))
    assert first != version(installed("dge", more="prompt = 'another'"))
    assert first != version(Budget())
    git = tmp_path / "dge" / ".git"
    (git / "refs" / "heads").mkdir(parents=True)
    (git / "HEAD").write_text("ref: refs/heads/main\n")
    (git / "refs" / "heads" / "main").write_text("7eed0bc57824\n")
    assert version(installed("dge")) != first
    section = adapters_file.section(installed("dge").adapters, "dge")
    assert section is not None and adapters_file.commit(section.repository) == "7eed0bc57824"
    assert section.instruction("stroke") == 'Paint it: "red"' and section.instruction("recolor") == "recolor"


def test_a_gpu_is_looked_for_on_the_machine(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert not adapters_file.has_cuda_gpu()
    monkeypatch.setattr(Path, "glob", lambda self, pattern: iter([Path("/dev/nvidia0")]))
    assert not adapters_file.has_cuda_gpu()
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert adapters_file.has_cuda_gpu()
