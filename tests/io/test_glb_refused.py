"""GLB files that are refused: no splats, contradictions, damage; each in one line."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter import io
from splatpainter.doubts import doubts
from splatpainter.io.formats.glb import read_glb, write_glb
from splatpainter.splats import Splats
from tests.support.glb_files import KHR, QUARTER, attributes_of, build, pack, parts
from tests.support.io_assets import random_splats
from tests.support.io_packed import alone, damages, survives


@pytest.mark.shared
def test_meshes_are_refused(shared: Path) -> None:
    for path in sorted((shared / "data" / "meshes").glob("kh_*.glb"))[:3]:
        with pytest.raises(ValueError, match="this glTF file holds no Gaussians"):
            io.read(path)


def edited_json(change: Callable[[dict[str, Any]], Any]) -> bytes:
    data = build(attributes_of(random_splats(4, 0)))
    doc, binary = parts(data)
    change(doc)
    return pack(doc, binary)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "truncated"),
        (b"glTF" + bytes(8), "expected a GLB file of version 2"),
        (struct.pack("<4sII", b"glTF", 2, 12), "expected JSON as the first GLB chunk"),
        (struct.pack("<4sII", b"glTF", 2, 1 << 31), "truncated: the header says 2147483648 bytes"),
        (struct.pack("<4sIIII", b"glTF", 2, 20, 1 << 30, 0x4E4F534A), "truncated: a GLB chunk"),
        (pack({}, b""), "holds no Gaussians"),
        (edited_json(lambda d: d["accessors"][0].update(count=1 << 40)), "does not fit its buffer view"),
        (edited_json(lambda d: d["accessors"][0].update(count=-1)), "expected a non-negative integer for glTF 'count'"),
        (edited_json(lambda d: d["accessors"][1].update(count=3)), "expected ROTATION of 4 x 4 numbers"),
        (edited_json(lambda d: d["accessors"][0].update(sparse={})), "is of a kind that splats do not use"),
        (edited_json(lambda d: d["accessors"][0].update(bufferView=99)), r"bufferViews\[99\], which does not exist"),
        (edited_json(lambda d: d["bufferViews"][0].update(byteLength=1 << 40)), "truncated: buffer view 0"),
        (edited_json(lambda d: d["bufferViews"][0].update(byteStride=1)), "does not fit its buffer view"),
        (
            edited_json(lambda d: d["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}})),
            "is compressed",
        ),
        (edited_json(lambda d: d["buffers"][0].update(uri="other.bin")), "lies in an external file"),
        (
            edited_json(lambda d: d["meshes"][1]["primitives"][0]["attributes"].pop(f"{KHR}:SCALE")),
            "no attribute .*:SCALE",
        ),
        (
            edited_json(lambda d: d["meshes"][1]["primitives"][0]["attributes"].pop(f"{KHR}:OPACITY")),
            r"no attribute .*:OPACITY \(and no COLOR_0 in its place\)",
        ),
        (
            edited_json(lambda d: d["meshes"][1]["primitives"][0]["attributes"].pop(f"{KHR}:SH_DEGREE_0_COEF_0")),
            r"no attribute .*:SH_DEGREE_0_COEF_0 \(and no COLOR_0",
        ),
        (
            edited_json(lambda d: d["meshes"][1]["primitives"][0]["extensions"][KHR].update(extensions={"X_spz": {}})),
            "stored by X_spz, which is not supported",
        ),
        (edited_json(lambda d: d["nodes"][0].update(children=[0])), "glTF node 0 is its own ancestor"),
        (edited_json(lambda d: d["nodes"][0].update(translation=[1, 2])), "expected 3 numbers as a node's translation"),
        (edited_json(lambda d: d.update(meshes=[[]])), "expected a list of objects as 'meshes'"),
    ],
)
def test_refusals(data: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    assert survives(read_glb, path, iter([data]), peak=1 << 20) == (0, 1)
    with pytest.raises(ValueError, match=message):
        read_glb(path)


def test_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    data = build(attributes_of(random_splats(10, 1)), [{"mesh": 1} | QUARTER])
    assert sum(survives(read_glb, path, damages(data, 300, head=5000))) == 364
    # JSON of the right form with wrong values in it: any leaf or branch replaced.
    doc, binary = parts(data)
    rng = np.random.default_rng(0)

    def wrong(item: Any) -> Any:
        if rng.random() < 0.01:
            return [None, -1, 10**30, 1.5, "x", [], {}, [[]], True, 99][rng.integers(0, 10)]
        if isinstance(item, dict):
            return {key: wrong(value) for key, value in item.items() if rng.random() > 0.003}
        return [wrong(value) for value in item] if isinstance(item, list) else item

    def both(path: Path) -> Splats:
        splats = read_glb(path)
        if len(splats):  # whatever can be read can be written with an edit
            write_glb(path.with_name("b.glb"), alone(splats))
            write_glb(path.with_name("b.glb"), splats.take(np.arange(len(splats))[::-1]))
        return splats

    assert sum(survives(both, path, (pack(wrong(doc), binary) for _ in range(200)))) == 200


def test_what_moves_gaussians_in_time_is_told(tmp_path: Path) -> None:
    def change(doc: dict[str, Any]) -> None:
        doc["animations"] = [{"channels": [], "samplers": []}]
        doc["meshes"][1]["primitives"][0]["targets"] = [{"POSITION": 0}]

    (tmp_path / "a.glb").write_bytes(edited_json(change))
    source = read_glb(tmp_path / "a.glb").source
    assert source is not None and "it has animations" in "; ".join(source.problems)
    assert "morph targets" in "; ".join(source.problems)


@pytest.mark.parametrize(("scale", "is_doubtful"), [([2, 1, 1], True), ([-1, 1, 1], True), ([2, 2, 2], False)])
def test_a_transform_that_is_not_applied_is_a_doubt(scale: list[float], is_doubtful: bool, tmp_path: Path) -> None:
    """Commands warn of doubts, and pictures of such a file are not as it asks."""
    data = build(attributes_of(random_splats(40, 0)), [{"mesh": 1, "scale": scale}])
    (tmp_path / "a.glb").write_bytes(data)
    assert any("other proportions" in one.line for one in doubts(read_glb(tmp_path / "a.glb"))) == is_doubtful
