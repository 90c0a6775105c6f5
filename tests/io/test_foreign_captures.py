"""Captures of other programs are named, with what to do about them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from splatpainter import io
from splatpainter.captures.camera_files import captured_views
from splatpainter.io.folders import asset_file
from splatpainter.pictures.edit_files import camera_from

METASHAPE = b'<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0">\n  <chunk label="Chunk 1">\n'
REALITY = b"#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
SIDECAR = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description xcr:Version="3"/></x:xmpmeta>'
POLYCAM = json.dumps({f"t_{row}{column}": 0.0 for row in range(3) for column in range(4)}).encode()
CAPTURES = {
    "cameras.xml": (METASHAPE, "Metashape", "metashape"),
    "registration.csv": (REALITY, "RealityCapture", "realitycapture"),
    "IMG_1.xmp": (SIDECAR, "RealityCapture", "realitycapture"),
    "keyframes/cameras/1.json": (POLYCAM, "Polycam", "polycam"),
    "scene.r3d": (b"PK\3\4", "Record3D", "record3d"),
}


@pytest.mark.parametrize(("name", "content", "program", "command"), [(k, *v) for k, v in CAPTURES.items()])
def test_captures_of_other_programs_are_named(
    tmp_path: Path, name: str, content: bytes, program: str, command: str
) -> None:
    file = tmp_path / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content)
    for read, path in ((asset_file, tmp_path), (captured_views, tmp_path), (camera_from, file)):
        with pytest.raises(ValueError, match=f"is .*{program}.*`ns-process-data {command}`"):
            read(path)


def test_a_run_of_nerfstudio_is_named_with_its_export(tmp_path: Path) -> None:
    """Its config.yml was "a text, not a splat file; download the file itself"."""
    config = tmp_path / "config.yml"
    config.write_text("!!python/object:nerfstudio.engine.trainer.TrainerConfig\n_target: splatfacto\n")
    (tmp_path / "nerfstudio_models").mkdir()
    words = rf"is a run of nerfstudio, .*`ns-export gaussian-splat --load-config {config} --output-dir DIR`"
    for read, path in ((io.read, config), (asset_file, tmp_path), (asset_file, tmp_path / "nerfstudio_models")):
        with pytest.raises(ValueError, match=words):
            read(path)
    (tmp_path / "splat.ply").write_bytes(b"ply\n")
    assert asset_file(tmp_path).name == "splat.ply"
    config.write_text("# how the trainer is set up\nsteps: 3\n")
    with pytest.raises(ValueError, match="is a text"):
        io.read(config)


def test_a_splat_beside_a_capture_is_what_a_folder_holds(tmp_path: Path) -> None:
    (tmp_path / "cameras.xml").write_bytes(METASHAPE)
    (tmp_path / "scene.ply").write_bytes(b"ply\n")
    with pytest.raises(ValueError, match=r"it holds scene\.ply: name one of them"):
        asset_file(tmp_path)


@pytest.mark.parametrize(
    ("name", "whose"),
    [
        *[(name, "cameras of a capture") for name in ("transforms.json", "camera_path.json", "cameras.json")],
        *[(f"{inner}images.bin", "COLMAP's cameras") for inner in ("", "sparse/0/")],
        ("sparse/images.txt", "COLMAP's cameras"),
    ],
)
def test_cameras_where_splats_are_wanted_are_named(tmp_path: Path, name: str, whose: str) -> None:
    file = tmp_path / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b'{"frames": []}')
    for path, folder in ((tmp_path, tmp_path), (file.parent, file.parent), (file, file.parent)):
        with pytest.raises(ValueError, match=rf"{whose} and no splats; .*--camera, .*: splatpainter fit {folder} "):
            io.read(path)


@pytest.mark.parametrize(
    ("name", "content"), [("notes.xml", b"<html>"), ("table.csv", b"a,b\n"), ("c.json", b"{}"), ("p.xmp", b"<x/>")]
)
def test_other_files_are_none(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match="is a folder without"):
        asset_file(tmp_path)
