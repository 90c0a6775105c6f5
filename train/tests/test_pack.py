"""Training in short leases: what is packed, what comes back, and a round of it with a shell."""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts" / "pack_training.py"


def call(*words: object, code: int = 0) -> str:
    done = subprocess.run([sys.executable, str(SCRIPT), *map(str, words)], capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    return done.stdout + done.stderr


def textured_glb(edge: int) -> bytes:
    """One triangle with a picture of noise."""
    noise = np.random.default_rng(0).integers(0, 255, (edge, edge, 3), np.uint8)
    picture = io.BytesIO()
    Image.fromarray(noise).save(picture, "PNG")
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    uvs = np.array([[0, 0], [1, 0], [0, 1]], "<f4").tobytes()
    parts = [corners, uvs, picture.getvalue()]
    views, body = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(part)})
        body += part + b"\0" * (-len(part) % 4)
    scene = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "scene": 0,
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 2, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(body), len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(body), 0x004E4942) + body


def test_packed_meshes_have_small_pictures_and_the_same_corners(tmp_path: Path) -> None:
    from splattrain.data.meshes import load_mesh

    meshes = tmp_path / "meshes"
    meshes.mkdir()
    (meshes / "one.glb").write_bytes(textured_glb(256))
    (meshes / "broken.glb").write_bytes(b"glTF but no more")
    call("pack", "--out", tmp_path / "lease.tar", "--meshes", meshes, "--texture", 32)
    with tarfile.open(tmp_path / "lease.tar") as tar:
        names = tar.getnames()
        tar.extractall(tmp_path / "there", filter="data")
    assert {"run.sh", "scripts/pack_training.py", "meshes/one.glb", "src/splatpainter/cli.py"} <= set(names)
    assert not any("__pycache__" in name for name in names)
    assert (tmp_path / "there/meshes/broken.glb").read_bytes() == b"glTF but no more"
    small, original = load_mesh(tmp_path / "there/meshes/one.glb"), load_mesh(meshes / "one.glb")
    np.testing.assert_array_equal(small.vertices, original.vertices)
    pictures = [mesh.materials[0].base_color for mesh in (small, original)]
    assert [p.shape for p in pictures if p is not None] == [(32, 32, 3), (256, 256, 3)]
    assert "expected at most 0.1 MiB" in call("pack", "--out", tmp_path / "l.tar", "--limit", 0.1, code=1)
    assert not (tmp_path / "l.tar").exists()


def test_a_run_comes_back_whole_or_not_at_all(tmp_path: Path) -> None:
    run, back, home = tmp_path / "run", tmp_path / "back", tmp_path / "home"
    (run / "state").mkdir(parents=True)
    data = np.random.default_rng(0).bytes(300_000)
    (run / "state" / "weights.safetensors").write_bytes(data)
    (run / "log.csv").write_text("step,loss\n1,2\n")
    call("split", run, "--out", back, "--size", 0.1)
    parts = sorted(back.iterdir())
    assert len(parts) == 3 and max(p.stat().st_size for p in parts) <= 0.1 * 2**20
    assert "train with --compact-state" in call("split", run, "--out", back, "--size", 0.1, "--files", 2, code=1)
    (home / "state").mkdir(parents=True)
    (home / "state" / "old").write_text("old")
    parts[2].rename(tmp_path / "lost")
    assert "missing or damaged" in call("unpack", back, "--run", home, code=1)
    assert (home / "state" / "old").read_text() == "old"
    (tmp_path / "lost").rename(parts[2])
    call("unpack", back, "--run", home)
    assert [p.name for p in (home / "state").iterdir()] == ["weights.safetensors"]
    assert (home / "state" / "weights.safetensors").read_bytes() == data
    assert (home / "log.csv").read_text() == "step,loss\n1,2\n"


@pytest.mark.skipif(os.name == "nt", reason="run.sh is for the lent machine, which has bash")
def test_a_lease_trains_and_brings_its_state_home(tmp_path: Path) -> None:
    from tests.support.train_scenes import RECIPE

    recipe = tmp_path / "tiny.json"
    recipe.write_text(json.dumps(RECIPE.to_dict() | {"steps": 2, "batch": 1}))
    home, there = tmp_path / "home", tmp_path / "there"
    call("pack", "--out", tmp_path / "lease.tar")
    with tarfile.open(tmp_path / "lease.tar") as tar:
        tar.extractall(there, filter="data")
    shutil.rmtree(there / "src")
    (there / "src").symlink_to(ROOT / "src")  # the same code, with its compiled kernels: a minute less
    folder = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "OUT": str(there / "back")}
    words = ["refine", "--recipe", str(recipe), "--data", "procedural:1", "--session-steps", "1", "--device", "cpu"]
    done = subprocess.run(
        ["bash", "run.sh", *words], cwd=there, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    call("unpack", there / "back", "--run", home)
    assert [line.split(",")[0] for line in (home / "log.csv").read_text().splitlines()] == ["step", "1"]
    assert (home / "model" / "model.json").is_file() and "step 1 of 2" in (home / "train.log").read_text()
    # The next lease takes the state along.
    call("pack", "--out", tmp_path / "next.tar", "--run", home)
    with tarfile.open(tmp_path / "next.tar") as tar:
        state = tar.extractfile("run/state/model.json")
        assert state is not None and json.load(state)["notes"]["progress"]["step"] == 1
