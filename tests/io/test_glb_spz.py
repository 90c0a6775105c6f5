"""GLB whose Gaussians lie in an SPZ stream, put together by hand: where they stand, edits, damage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter import io
from splatpainter.io.axes import flip
from splatpainter.io.formats.glb import read_glb
from splatpainter.io.formats.spz import write_spz
from splatpainter.receipts import verify
from splatpainter.splats import Splats
from tests.support.glb_files import KHR, QUARTER, pack, parts
from tests.support.io_assets import random_splats
from tests.support.io_packed import damages, quats_apart, same_bits, survives

NAME = "KHR_gaussian_splatting_compression_spz_2"
DRAFT = "KHR_spz_gaussian_splats_compression"


def stream(folder: Path, splats: Splats, version: int = 2) -> bytes:
    """An SPZ file in its own axes, unmarked, as the extension's text wants it."""
    path = folder / "stream.spz"
    write_spz(path, splats, version, "rub", mark=False)
    return path.read_bytes()


def packed(data: bytes, count: int, node: dict[str, Any] | None = None, form: str = "spec") -> bytes:
    """form: spec; cesium (no kernel); draft (the name beside the base extension)."""
    inner: dict[str, Any] = {"bufferView": 0}
    base: dict[str, Any] = {} if form == "cesium" else {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    extensions: dict[str, Any] = {KHR: base | {"extensions": {NAME: inner}}} if form != "draft" else {DRAFT: inner}
    name = DRAFT if form == "draft" else NAME
    doc = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [KHR, name, "KHR_materials_unlit"],
        "extensionsRequired": [KHR, name],
        "nodes": [{"mesh": 0} | (node or {})],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "accessors": [
            {"componentType": 5126, "count": count, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]},
            {"componentType": 5121, "count": count, "type": "VEC4", "normalized": True},
            {"componentType": 5126, "count": count, "type": "VEC4"},
        ],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "COLOR_0": 1, f"{KHR}:ROTATION": 2},
                        "mode": 0,
                        "extensions": extensions,
                    }
                ]
            }
        ],
    }
    return pack(doc, data + bytes(-len(data) % 4))


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("degree", [0, 3])
def test_the_asset_is_the_one_of_the_stream(version: int, degree: int, tmp_path: Path) -> None:
    """Packed from left-up-front as the text says, in the axes of PLY files it is the asset that was packed."""
    data = stream(tmp_path, random_splats(150, degree), version)
    truth = io.read(tmp_path / "stream.spz", axes="rub")
    (tmp_path / "a.glb").write_bytes(packed(data, 150))
    splats = io.read(tmp_path / "a.glb")
    assert splats.sh_degree == degree and splats.source is not None and not splats.source.problems
    for name in ("means", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(splats, name), getattr(truth, name)), name
    assert quats_apart(splats.quats, truth.quats) < 1e-6


@pytest.mark.parametrize("form", ["cesium", "draft"])
def test_files_of_the_drafts_face_the_other_way(form: str, tmp_path: Path) -> None:
    """CesiumJS takes their numbers as they are: half a turn about the vertical, and it is said."""
    data = stream(tmp_path, random_splats(50, 1))
    truth = io.read(tmp_path / "stream.spz", axes="rub")
    (tmp_path / "a.glb").write_bytes(packed(data, 50, form=form))
    splats = io.read(tmp_path / "a.glb")
    assert np.array_equal(splats.means, flip(truth, (-1, 1, -1)).means)
    assert splats.source is not None and "as Cesium does" in splats.source.problems[0]


@pytest.mark.parametrize("form", ["spec", "cesium", "draft"])
def test_an_edit_unpacks_and_keeps_every_other_value(form: str, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(packed(stream(tmp_path, random_splats(120, 2)), 120, QUARTER, form))
    splats = io.read(path)
    io.write(tmp_path / "b.glb", splats)
    assert (tmp_path / "b.glb").read_bytes() == path.read_bytes()
    for number, edited in enumerate(
        (
            replace(splats, opacities=np.where(np.arange(120) == 7, np.float32(0.5), splats.opacities)),
            splats.append(splats.take(np.arange(5))),
        )
    ):
        io.write(tmp_path / f"c{number}.glb", edited)
        back = io.read(tmp_path / f"c{number}.glb")
        assert same_bits(back, edited) and back.source is not None and not back.source.problems
        doc, _ = parts((tmp_path / f"c{number}.glb").read_bytes())
        words = str(doc)
        assert NAME not in words and DRAFT not in words and "KHR_materials_unlit" in doc["extensionsUsed"]
        verification = verify(path, tmp_path / f"c{number}.glb")
        assert verification.ok and verification.same == 120 - (number == 0), verification


def test_refusals_and_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    data = stream(tmp_path, random_splats(40, 1))
    good = packed(data, 40)
    doc, binary = parts(good)
    cases = [
        (packed(data, 41), "the SPZ stream holds 40 rows, accessor 0 says 41"),
        (packed(b"PK\3\4" + bytes(60), 40), "not an SPZ file"),
        (packed(data[:60], 40), "gzip|truncated|damaged"),
    ]
    doc["buffers"][0]["uri"] = "0.bin"
    cases.append((pack(doc, binary), "the SPZ stream lies in an external file"))
    doc, binary = parts(good)
    doc["meshes"][0]["primitives"][0]["extensions"][KHR]["extensions"][NAME]["bufferView"] = 3
    cases.append((pack(doc, binary), r"bufferViews\[3\], which does not exist"))
    for content, message in cases:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message) as error:
            io.read(path)
        assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)
    assert sum(survives(read_glb, path, damages(good, 150, head=1500))) == 214
