"""GLB: files built by hand, splat-transform's as oracle, node transforms, integers, bytes that stay, damaged files."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter import io
from splatpainter.io.formats import gltf
from splatpainter.io.formats.glb import read_glb, write_glb
from splatpainter.splats import SH_C0, Splats
from splatpainter.transforms import sh_basis
from tests.support.glb_files import CODES, KHR, QUARTER, attributes_of, build, columns, pack, parts
from tests.support.io_assets import random_splats
from tests.support.io_packed import covariances, quats_apart, same_bits

pytest_plugins = ["tests.support.node_oracle"]

Oracle = Callable[..., str]


@pytest.mark.shared
def test_real_file(shared: Path, tmp_path: Path) -> None:
    """splat-transform made it from the asset whose PLY lies beside it: the same rows, in the same frame, exactly."""
    path = shared / "data" / "splats" / "playbot_lod4.glb"
    splats, truth = io.read(path), io.read(path.with_name("playbot_lod4_sh3.ply"))
    assert splats.source is not None and not splats.source.problems and splats.sh_degree == 2
    assert np.array_equal(splats.means, truth.means) and np.array_equal(splats.sh, truth.sh[:, :9])
    assert np.allclose(splats.scales, truth.scales, rtol=1e-6) and np.allclose(
        splats.opacities, truth.opacities, atol=1e-6
    )
    unit = truth.quats / np.linalg.norm(truth.quats, axis=1, keepdims=True)
    assert np.abs(splats.quats - unit).max() < 1e-6  # signs too
    write_glb(tmp_path / "a.glb", splats)
    assert (tmp_path / "a.glb").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_beside_splat_transform(degree: int, tmp_path: Path, splat_transform: Oracle) -> None:
    """Its GLB of our rows reads as our rows; our GLB holds what its GLB holds."""
    splats = random_splats(300, degree)
    io.write(tmp_path / "a.ply", splats)
    splat_transform(tmp_path / "a.ply", tmp_path / "theirs.glb")
    back = read_glb(tmp_path / "theirs.glb")
    assert np.array_equal(back.means, splats.means)
    assert np.abs(back.sh - splats.sh).max() < 1e-6 and quats_apart(back.quats, splats.quats) < 1e-6
    assert np.allclose(back.scales, splats.scales, rtol=1e-6) and np.allclose(
        back.opacities, splats.opacities, atol=1e-6
    )
    io.write(tmp_path / "ours.glb", splats)
    ours, theirs = columns((tmp_path / "ours.glb").read_bytes()), columns((tmp_path / "theirs.glb").read_bytes())
    assert ours.keys() == theirs.keys()
    for name in ours.keys() - {"COLOR_0", "ROTATION"}:
        assert np.allclose(ours[name], theirs[name], rtol=1e-6, atol=1e-6), name
    # It does not make quaternions unit here; the standard asks for that.
    assert np.abs(np.linalg.norm(ours["ROTATION"], axis=1) - 1).max() < 1e-6
    assert quats_apart(ours["ROTATION"], theirs["ROTATION"]) < 1e-6
    doc, _ = parts((tmp_path / "ours.glb").read_bytes())
    position = doc["accessors"][doc["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert position["min"] == ours["POSITION"].min(0).tolist() and position["max"] == ours["POSITION"].max(0).tolist()
    # Vertex colours are linear in glTF (splat-transform leaves them sRGB); alpha is the opacity.
    color = np.clip(0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64), 0, 1)
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    assert np.abs(ours["COLOR_0"][:, :3] / 255 - linear).max() <= 0.5 / 255 + 1e-6
    assert np.abs(ours["COLOR_0"][:, 3] / 255 - splats.opacities).max() <= 0.5 / 255 + 1e-6


def test_round_trip_is_exact(tmp_path: Path) -> None:
    splats = random_splats(200, 3)
    splats = replace(splats, quats=splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True))
    for flags in ({}, {"antialiased": True}, {"color_space": "linear"}):
        flagged = replace(splats, **flags)
        write_glb(tmp_path / "a.glb", flagged)
        back = read_glb(tmp_path / "a.glb")
        assert same_bits(back, splats)
        assert (back.antialiased, back.color_space) == (flagged.antialiased, flagged.color_space)
        write_glb(tmp_path / "b.glb", replace(back, antialiased=not flagged.antialiased))
        again = read_glb(tmp_path / "b.glb")
        assert again.antialiased is not flagged.antialiased and again.color_space == flagged.color_space
        assert same_bits(again, splats)


def test_by_hand(tmp_path: Path) -> None:
    """glTF's frame is half a turn about z away; everything that is not ours survives an edit."""
    rows = random_splats(4, 1)
    path = tmp_path / "a.glb"
    path.write_bytes(build(attributes_of(rows) | {"_EXTRA:ID": np.arange(4, dtype=np.uint16)[:, None]}))
    splats = read_glb(path)
    assert np.array_equal(splats.means, rows.means * np.array([-1, -1, 1], np.float32))
    turn = np.diag([-1.0, -1, 1])
    assert np.allclose(covariances(splats), turn @ covariances(rows) @ turn, rtol=1e-5, atol=1e-9)
    assert np.array_equal(splats.sh, rows.sh * np.array([1, -1, 1, -1], np.float32)[:, None])
    assert np.array_equal(splats.scales, rows.scales) and np.array_equal(splats.opacities, rows.opacities)
    opacities = splats.opacities.copy()
    opacities[2] = 0.125
    write_glb(tmp_path / "b.glb", replace(splats, opacities=opacities))
    data, before = (tmp_path / "b.glb").read_bytes(), path.read_bytes()
    (doc, binary), (old_doc, old_binary) = parts(data), parts(before)
    assert doc == old_doc and data.endswith(struct.pack("<II", 4, 0x12345678) + b"moretail")
    changed = [k for k in range(len(binary)) if binary[k] != old_binary[k]]
    start = old_doc["bufferViews"][3]["byteOffset"]
    assert changed and set(changed) <= set(range(start + 8, start + 12))  # the third float of OPACITY, nothing else
    more = splats.take(np.array([3, 0, 1, 2, 2]))
    write_glb(tmp_path / "b.glb", more)
    doc, binary = parts((tmp_path / "b.glb").read_bytes())
    assert (
        doc["asset"] == old_doc["asset"]
        and doc["materials"] == old_doc["materials"]
        and doc["nodes"] == old_doc["nodes"]
    )
    assert (
        doc["meshes"][0] == old_doc["meshes"][0]
        and len(binary) == doc["buffers"][0]["byteLength"] < len(old_binary) * 1.6
    )
    back = read_glb(tmp_path / "b.glb")
    assert same_bits(back, more)
    index = doc["meshes"][1]["primitives"][0]["attributes"]["_EXTRA:ID"]
    view = doc["bufferViews"][doc["accessors"][index]["bufferView"]]
    ids = [struct.unpack_from("<H", binary, view["byteOffset"] + k * view["byteStride"])[0] for k in range(5)]
    assert ids == [3, 0, 1, 2, 2] and doc["accessors"][index]["count"] == 5


def test_edits_keep_the_other_rows(tmp_path: Path, splat_transform: Oracle) -> None:
    rows = random_splats(500, 2)
    io.write(tmp_path / "a.ply", rows)
    splat_transform(tmp_path / "a.ply", tmp_path / "a.glb")
    splats, rng = read_glb(tmp_path / "a.glb"), np.random.default_rng(0)
    touched = rng.random(500) < 0.2
    new = {name: getattr(splats, name).copy() for name in ("means", "quats", "scales", "opacities", "sh")}
    for name, values in new.items():
        values[touched] = np.clip(values[touched] * 0.9, 0, 1) if name == "opacities" else values[touched] * 0.9
    children = splats.take(np.flatnonzero(touched))
    edited = replace(splats, **new).append(replace(children, scales=children.scales * np.float32(0.5)))
    write_glb(tmp_path / "b.glb", edited)
    back = read_glb(tmp_path / "b.glb")
    assert same_bits(back, edited, np.flatnonzero(~touched))
    for name in ("means", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(back, name), getattr(edited, name))
    assert quats_apart(back.quats, edited.quats) < 1e-6
    # splat-transform's fallback colours are sRGB; those of changed rows follow its habit.
    color = columns((tmp_path / "b.glb").read_bytes())["COLOR_0"]
    expected = np.clip(0.5 + SH_C0 * edited.sh[:, 0].astype(np.float64), 0, 1)
    assert np.abs(color[:, :3] / 255 - expected).max() <= 0.51 / 255


@pytest.mark.parametrize(
    ("nodes", "matrix"),
    [
        ([{"mesh": 1, "translation": [1, 2, 3]}], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]]),
        ([{"mesh": 1} | QUARTER], [[0, 0, 2, 1], [0, 2, 0, 2], [-2, 0, 0, 3]]),
        ([{"children": [1]} | QUARTER, {"mesh": 1, "matrix": [1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 5, 0, 0, 1]}],
         [[0, 2, 0, 1], [0, 0, -2, 2], [-2, 0, 0, -7]]),
    ],
)  # fmt: skip
def test_node_transforms(nodes: list[dict[str, Any]], matrix: list[list[float]], tmp_path: Path) -> None:
    """The rows are where the node shows them, and go back to where they were."""
    rows, path, m = random_splats(40, 2), tmp_path / "a.glb", np.array(matrix, float)
    path.write_bytes(build(attributes_of(rows), nodes))
    splats = read_glb(path)
    assert splats.source is not None and not splats.source.problems
    half = np.diag([-1.0, -1, 1])
    linear, scale = half @ m[:, :3], np.cbrt(np.linalg.det(m[:, :3]))
    assert np.allclose(splats.means, rows.means @ linear.T + half @ m[:, 3], atol=1e-5)
    assert np.allclose(covariances(splats), linear @ covariances(rows) @ linear.T, rtol=1e-4, atol=1e-7)
    d = np.random.default_rng(0).normal(size=(20, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    assert np.abs(sh_basis(d @ (linear / scale).T, 2) @ splats.sh - sh_basis(d, 2) @ rows.sh).max() < 1e-5
    means = splats.means.copy()
    means[5] += 0.25
    write_glb(tmp_path / "b.glb", replace(splats, means=means))
    back = read_glb(tmp_path / "b.glb")
    assert same_bits(back, splats, np.delete(np.arange(40), 5)) and np.abs(back.means - means).max() < 1e-5
    assert parts((tmp_path / "b.glb").read_bytes())[0]["nodes"] == nodes


def test_transform_that_rows_cannot_follow(tmp_path: Path) -> None:
    rows, path = random_splats(5, 1), tmp_path / "a.glb"
    for bad in ({"scale": [1, 2, 1]}, {"scale": [-1, 1, 1]}, {"scale": [0, 0, 0]}):
        path.write_bytes(build(attributes_of(rows), [{"mesh": 1} | bad]))
        splats = read_glb(path)
        assert splats.source is not None and "not a rotation with uniform scale" in splats.source.problems[0]
        assert np.array_equal(splats.means, rows.means * np.array([-1, -1, 1], np.float32))


def test_integers(tmp_path: Path) -> None:
    """Quantised attributes mean what glTF says; an edit keeps those values in every row that it did not touch."""
    rng, path = np.random.default_rng(0), tmp_path / "a.glb"
    attributes = attributes_of(random_splats(30, 0))
    attributes["ROTATION"] = np.rint(attributes["ROTATION"] * 127).astype(np.int8)
    attributes["SCALE"] = rng.integers(1, 65536, (30, 3)).astype(np.uint16)
    attributes["OPACITY"] = rng.integers(0, 256, (30, 1)).astype(np.uint8)
    path.write_bytes(build(attributes))
    splats = read_glb(path)
    assert np.allclose(splats.scales, attributes["SCALE"] / 65535, atol=1e-7)
    assert np.allclose(splats.opacities, attributes["OPACITY"][:, 0] / 255, atol=1e-7)
    x, y, z, w = np.maximum(attributes["ROTATION"] / 127, -1).T
    assert quats_apart(splats.quats, np.stack([-z, -y, x, w], 1)) < 1e-6  # half a turn about z, then the stored one
    edited = replace(
        splats,
        opacities=splats.opacities.copy(),
        scales=splats.scales * np.where(np.arange(30) == 7, 3, 1)[:, None].astype(np.float32),
    )
    edited.opacities[4] = 0.3
    write_glb(tmp_path / "b.glb", edited)
    back = read_glb(tmp_path / "b.glb")
    assert same_bits(back, edited) and back.opacities[4] == np.float32(0.3)
    doc, _ = parts((tmp_path / "b.glb").read_bytes())
    kinds = {
        name: doc["accessors"][i]["componentType"]
        for name, i in doc["meshes"][1]["primitives"][0]["attributes"].items()
    }
    assert (
        kinds[f"{KHR}:ROTATION"] == CODES["int8"]
        and kinds[f"{KHR}:SCALE"] == kinds[f"{KHR}:OPACITY"] == CODES["float32"]
    )


def test_interleaved(tmp_path: Path) -> None:
    """All attributes in one buffer view, a row after the other: an edit changes four bytes of it."""
    rows, path = random_splats(6, 0), tmp_path / "a.glb"
    names = attributes_of(rows)
    table = np.concatenate(list(names.values()), 1).astype("<f4")
    data = build(names)
    doc, _ = parts(data)
    offset = 0
    for values, item in zip(names.values(), doc["accessors"], strict=True):
        item |= {"bufferView": 0, "byteOffset": offset}
        offset += values.shape[1] * 4
    doc["bufferViews"] = [{"buffer": 0, "byteLength": table.nbytes, "byteStride": table.shape[1] * 4}]
    doc["buffers"] = [{"byteLength": table.nbytes}]
    text = json.dumps(doc).encode()
    text += b" " * (-len(text) % 4)
    body = (
        struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", table.nbytes, 0x004E4942)
        + table.tobytes()
    )
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    splats = read_glb(path)
    assert np.array_equal(splats.opacities, rows.opacities)
    edited = replace(splats, opacities=np.where(np.arange(6) == 3, np.float32(0.5), splats.opacities))
    write_glb(tmp_path / "b.glb", edited)
    new, old = parts((tmp_path / "b.glb").read_bytes())[1], parts(path.read_bytes())[1]
    assert len(new) == len(old) and 0 < sum(a != b for a, b in zip(new, old, strict=True)) <= 4
    grown = edited.append(edited.take(np.array([0])))
    write_glb(tmp_path / "b.glb", grown)
    assert same_bits(read_glb(tmp_path / "b.glb"), grown)


def test_lenient_names(tmp_path: Path) -> None:
    """Early files: names with an underscore or bare, colours and opacities only in COLOR_0."""
    rows, path = random_splats(8, 0), tmp_path / "a.glb"
    full = attributes_of(rows)
    color = np.concatenate([0.5 + SH_C0 * rows.sh[:, 0], rows.opacities[:, None]], 1).astype(np.float32)
    data = build({"POSITION": full["POSITION"], "x:R": full["ROTATION"], "x:S": full["SCALE"], "COLOR_0": color})
    path.write_bytes(data.replace(b'"x:R"', b'"_ROTATION"').replace(b'"x:S"', b'"SCALE"'))
    text = data.replace(b'"x:R":', b'"_ROTATION":').replace(b'"x:S":', b'"SCALE":')
    size = struct.unpack_from("<I", data, 12)[0] + len(text) - len(data)
    pad = -size % 4
    text = text[: 20 + size] + b" " * pad + text[20 + size :]
    head = struct.pack("<4sIII", b"glTF", 2, struct.unpack_from("<I", data, 8)[0] + len(text) - len(data), size + pad)
    path.write_bytes(head + text[16:])
    splats = read_glb(path)
    assert splats.source is not None and len(splats.source.problems) == 2
    assert np.allclose(splats.sh, rows.sh, atol=1e-5) and np.array_equal(splats.opacities, rows.opacities)
    assert np.array_equal(splats.scales, rows.scales)
    write_glb(tmp_path / "b.glb", replace(splats, opacities=splats.opacities * np.float32(0.5)))
    back = read_glb(tmp_path / "b.glb")
    assert np.array_equal(back.opacities, splats.opacities * np.float32(0.5)) and np.array_equal(back.sh, splats.sh)


def test_other_degrees(tmp_path: Path) -> None:
    write_glb(tmp_path / "a.glb", random_splats(30, 1))
    splats = read_glb(tmp_path / "a.glb")
    for degree in (0, 3):
        sh = np.zeros((30, (degree + 1) ** 2, 3), np.float32)
        sh[:, :4] = splats.sh[:, : sh.shape[1]]
        write_glb(tmp_path / "b.glb", replace(splats, sh=sh))
        assert same_bits(read_glb(tmp_path / "b.glb"), replace(splats, sh=sh))
    with pytest.raises(ValueError, match="SH up to degree 3, got 4"):
        write_glb(tmp_path / "b.glb", random_splats(5, 4))
    with pytest.raises(ValueError, match="0 rows"):
        write_glb(tmp_path / "b.glb", random_splats(0, 0))


def test_rows_that_cannot_be_drawn(tmp_path: Path) -> None:
    splats = random_splats(50, 1)
    splats.means[3], splats.scales[4, 1], splats.quats[5], splats.sh[6] = np.nan, 0, 0, np.inf
    write_glb(tmp_path / "a.glb", splats)
    back = read_glb(tmp_path / "a.glb")
    rest = np.delete(np.arange(50), [3, 4, 5, 6])
    assert back.drawable.all() and not back.opacities[3:7].any()
    assert same_bits(replace(back, quats=splats.quats), splats, rest)
    # Already in a file, they keep their bytes when other rows change.
    broken = attributes_of(random_splats(20, 0))
    broken["POSITION"][4] = np.nan
    (tmp_path / "b.glb").write_bytes(build(broken))
    source = read_glb(tmp_path / "b.glb")
    edited = replace(source, opacities=np.full(20, 0.5, np.float32))
    write_glb(tmp_path / "c.glb", edited.append(edited.take(np.array([0]))))
    assert same_bits(read_glb(tmp_path / "c.glb"), edited, np.delete(np.arange(20), 4))
    assert np.isnan(read_glb(tmp_path / "c.glb").means[4]).any()


def several(sizes: list[int], degrees: list[int], nodes: list[dict[str, Any]]) -> tuple[bytes, list[Splats]]:
    """A file of several Gaussian primitives: one mesh each, the first two in one mesh; and their rows."""
    doc: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [KHR],
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "bufferViews": [],
        "accessors": [],
        "meshes": [],
    }
    pieces, binary = [], b""
    for number, (rows, degree) in enumerate(zip(sizes, degrees, strict=True)):
        splats = random_splats(rows, degree, seed=number)
        unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
        pieces.append(replace(splats, quats=unit))
        names = {}
        for name, values in attributes_of(splats).items():
            names[name if name == "POSITION" else f"{KHR}:{name}"] = len(doc["accessors"])
            doc["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes})
            item = {"bufferView": len(doc["accessors"]), "componentType": 5126, "count": rows}
            doc["accessors"].append(item | {"type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]})
            binary += values.tobytes()
        khr = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "extras": {"number": number}}
        primitive = {"attributes": names, "mode": 0, "extensions": {KHR: khr}}
        if number == 1:
            doc["meshes"][0]["primitives"].append(primitive)
        else:
            doc["meshes"].append({"primitives": [primitive]})
    doc["buffers"] = [{"byteLength": len(binary)}]
    return pack(doc, binary), pieces


NODES = [{"mesh": 0}, {"mesh": 1, "translation": [0, 5, 0], "rotation": [0, np.sqrt(0.5), 0, np.sqrt(0.5)]}]


def test_several_primitives_and_nodes(tmp_path: Path) -> None:
    """All are opened, in file order, each where its node puts it; an edit changes the bytes of its values alone."""
    data, pieces = several([30, 20, 25], [0, 0, 2], NODES)
    (tmp_path / "a.glb").write_bytes(data)
    splats = io.read(tmp_path / "a.glb")
    assert len(splats) == 75 and splats.sh_degree == 2 and splats.source is not None and not splats.source.problems
    half = np.array([-1, -1, 1], np.float32)  # glTF is y up; half a turn about z is the PLY frame
    assert np.array_equal(splats.means[:30], pieces[0].means * half)
    assert np.array_equal(splats.means[30:50], pieces[1].means * half)
    turned = pieces[2].means.astype(np.float64)[:, [2, 1, 0]] * (1, 1, -1) + (0, 5, 0)  # a quarter turn about y
    assert np.abs(splats.means[50:] - turned * half).max() < 1e-5
    assert not splats.sh[:50, 1:].any() and splats.sh[50:, 1:].any()
    assert np.array_equal(splats.sh[:50, 0], np.concatenate([p.sh[:, 0] for p in pieces[:2]]))
    io.write(tmp_path / "b.glb", splats)
    assert (tmp_path / "b.glb").read_bytes() == data
    opacities = splats.opacities.copy()
    opacities[[3, 40, 60]] = 0.125
    io.write(tmp_path / "c.glb", replace(splats, opacities=opacities))
    assert same_bits(io.read(tmp_path / "c.glb"), replace(splats, opacities=opacities))
    before, after = (
        np.frombuffer(parts(data)[1], "<f4"),
        np.frombuffer(parts((tmp_path / "c.glb").read_bytes())[1], "<f4"),
    )
    assert len(before) == len(after) and np.count_nonzero(before != after) == 3 and (after == 0.125).sum() >= 3
    doc = parts((tmp_path / "c.glb").read_bytes())[0]
    extras = [p["extensions"][KHR]["extras"] for mesh in doc["meshes"] for p in mesh["primitives"]]
    assert extras == [{"number": 0}, {"number": 1}, {"number": 2}]


def test_rows_join_and_leave_several_primitives(tmp_path: Path) -> None:
    """Rows keep their order: new ones go last, into the last primitive; the others keep their bits."""
    data, _ = several([30, 20, 25], [1, 1, 1], NODES)
    (tmp_path / "a.glb").write_bytes(data)
    splats = io.read(tmp_path / "a.glb")
    fewer = splats.take(np.delete(np.arange(75), [2, 33, 74]))
    edited = fewer.append(fewer.take(np.array([0, 1])))
    io.write(tmp_path / "b.glb", edited)
    back = io.read(tmp_path / "b.glb")
    assert len(back) == 74 and same_bits(back, edited, np.arange(72))
    assert np.abs(back.means[72:] - edited.means[72:]).max() < 1e-5
    doc = parts((tmp_path / "b.glb").read_bytes())[0]
    counts = [
        doc["accessors"][p["attributes"]["POSITION"]]["count"] for mesh in doc["meshes"] for p in mesh["primitives"]
    ]
    assert counts == [29, 19, 26]
    mixed = splats.take(np.r_[30:75, 0:30])  # rows of the first behind those of the last: their values stay near
    with pytest.raises(ValueError, match="cannot hold a primitive of 0 rows"):
        io.write(tmp_path / "c.glb", mixed)
    mixed = splats.take(np.r_[0:10, 30:75, 10:30])
    io.write(tmp_path / "c.glb", mixed)
    back = io.read(tmp_path / "c.glb")
    assert same_bits(back, mixed, np.arange(55)) and np.abs(back.means - mixed.means).max() < 1e-5


def test_bands_of_one_primitive_are_not_given_to_another(tmp_path: Path) -> None:
    data, _ = several([10, 10], [0, 1], [{"mesh": 0}])
    (tmp_path / "a.glb").write_bytes(data)
    splats = io.read(tmp_path / "a.glb")
    sh = splats.sh.copy()
    sh[:, 0] += np.float32(0.25)
    io.write(tmp_path / "b.glb", replace(splats, sh=sh))
    names = [p["attributes"] for p in parts((tmp_path / "b.glb").read_bytes())[0]["meshes"][0]["primitives"]]
    assert f"{KHR}:SH_DEGREE_1_COEF_0" not in names[0] and f"{KHR}:SH_DEGREE_1_COEF_0" in names[1]
    sh[4, 2] = 0.5  # now it has some of its own
    io.write(tmp_path / "c.glb", replace(splats, sh=sh))
    assert same_bits(io.read(tmp_path / "c.glb"), replace(splats, sh=sh))


def test_primitives_that_are_not_opened(tmp_path: Path) -> None:
    """What no node shows, and another colour space, stay as they are; a mesh shown twice is opened once."""
    data, _ = several([30, 20, 25], [0, 0, 0], [{"mesh": 0}, {"mesh": 0, "translation": [9, 0, 0]}])
    doc, binary = parts(data)
    doc["meshes"][0]["primitives"][1]["extensions"][KHR]["colorSpace"] = "lin_rec709_display"
    (tmp_path / "a.glb").write_bytes(pack(doc, binary))
    splats = io.read(tmp_path / "a.glb")
    assert len(splats) == 30 and splats.source is not None
    text = "; ".join(splats.source.problems)
    assert "1 Gaussian primitives that no node shows" in text and "primitive 1 of mesh 0 has another colour" in text
    assert "2 nodes show mesh 0; its rows are opened once" in text
    io.write(tmp_path / "b.glb", replace(splats, opacities=np.full(30, 0.5, np.float32)))
    new, packed = parts((tmp_path / "b.glb").read_bytes())
    assert new["nodes"] == doc["nodes"] and new["meshes"] == doc["meshes"]
    floats, old = np.frombuffer(packed, "<f4"), np.frombuffer(binary, "<f4")
    assert (
        np.flatnonzero(floats != old).max() < sum(v.nbytes for v in attributes_of(random_splats(30, 0)).values()) // 4
    )


def test_primitives_that_share_accessors(tmp_path: Path) -> None:
    """An edit of one primitive's rows does not change the other's."""
    path = tmp_path / "a.glb"
    write_glb(path, random_splats(30, 0))
    doc, binary = parts(path.read_bytes())
    doc["meshes"].append(doc["meshes"][0])
    doc["nodes"].append({"mesh": 1, "translation": [3, 0, 0]})
    path.write_bytes(pack(doc, binary))
    splats = read_glb(path)
    assert len(splats) == 60
    opacities = splats.opacities.copy()
    opacities[:30] = 0.5
    write_glb(tmp_path / "b.glb", replace(splats, opacities=opacities))
    assert same_bits(read_glb(tmp_path / "b.glb"), replace(splats, opacities=opacities))


def test_many_primitives_that_share_accessors_are_counted_together(tmp_path: Path) -> None:
    """Each is honest alone; a file of a few bytes for each, and all rows again, is not."""
    write_glb(tmp_path / "a.glb", random_splats(20_000, 3))
    doc, binary = parts((tmp_path / "a.glb").read_bytes())
    doc["meshes"][0]["primitives"] *= 200
    (tmp_path / "b.glb").write_bytes(pack(doc, binary))
    with pytest.raises(ValueError, match="rows would take .* damaged or hostile"):
        io.read(tmp_path / "b.glb")
    doc["meshes"][0]["primitives"] = doc["meshes"][0]["primitives"][:1] * 600
    (tmp_path / "b.glb").write_bytes(pack(doc, binary))
    with pytest.raises(ValueError, match="at most 512 Gaussian primitives, found 600"):
        io.read(tmp_path / "b.glb")


def test_only_the_scene_that_a_file_opens_with_is_read(tmp_path: Path) -> None:
    """Other programs show `scene`, else the first; what others hold is no part of the picture."""
    data, rows = several([20, 30, 40], [0, 0, 0], [{"mesh": 0}, {"name": "nothing"}])
    doc, binary = parts(data)
    doc["nodes"] += [{"children": [3]}, {"mesh": 1, "translation": [0, 5, 0]}]
    doc["scenes"] = [{"nodes": [0]}, {"nodes": [2]}]
    path = tmp_path / "a.glb"
    for scene, pieces, move in ((None, rows[:2], 0), (0, rows[:2], 0), (1, rows[2:], 5)):
        path.write_bytes(pack(doc if scene is None else doc | {"scene": scene}, binary))
        splats = io.read(path)
        expected = np.concatenate([one.means for one in pieces]) + np.array([0, move, 0], np.float32)
        assert np.allclose(splats.means, expected * np.array([-1, -1, 1], np.float32), atol=1e-6)
        text = " ".join(splats.source.problems) if splats.source is not None else ""
        assert f"{3 - len(pieces)} Gaussian primitives that only other scenes of the file show" in text
        io.write(tmp_path / "b.glb", replace(splats, sh=splats.sh + np.float32(0.5)), overwrite=True)
        again = io.read(tmp_path / "b.glb")
        assert np.array_equal(again.means, splats.means) and np.abs(again.sh - splats.sh - 0.5).max() < 1e-6
    for scenes in ([{"nodes": [99]}], [{}], [7], "none", []):
        path.write_bytes(pack(doc | {"scenes": scenes, "scene": 0}, binary))
        assert len(io.read(path)) == 90, "no scene says which"


def test_what_a_file_asks_for_beyond_its_gaussians_is_told(tmp_path: Path) -> None:
    doc, binary = parts(build(attributes_of(random_splats(20, 0)), [{"mesh": 1}]))
    path = tmp_path / "a.glb"
    for change, words in (
        ({"extensionsRequired": ["ACME_bend", KHR]}, "it requires ACME_bend"),
        ({"nodes": [{"mesh": 1, "skin": 0}]}, "have a skin"),
        ({"nodes": [{"mesh": 1, "extensions": {"EXT_mesh_gpu_instancing": {}}}]}, "without instances"),
        ({"extensionsRequired": ["KHR_texture_basisu", "KHR_mesh_quantization"]}, ""),
        ({"extensionsRequired": 3, "nodes": [{"mesh": 1, "extensions": None}]}, ""),
    ):
        path.write_bytes(pack(doc | change, binary))
        source = io.read(path).source
        assert source is not None and words in " ".join(source.problems) and (words or not source.problems)


def sparse_glb(splats: Splats, semantic: str, rows: list[int], based: bool) -> bytes:
    """A file of which one attribute holds some rows as sparse elements, over what it held or over zeros."""
    doc, binary = parts(build(attributes_of(splats)))
    name = next(key for key in doc["meshes"][1]["primitives"][0]["attributes"] if key.endswith(semantic))
    item = doc["accessors"][doc["meshes"][1]["primitives"][0]["attributes"][name]]
    view = doc["bufferViews"][item["bufferView"]]
    width = view["byteLength"] // item["count"]
    values = binary[view["byteOffset"] :][: view["byteLength"]]
    picked = b"".join(values[row * width :][:width] for row in rows)
    if based:  # what stands below is not what counts
        dense = bytearray(values)
        for row in rows:
            dense[row * width : row * width + width] = bytes(width)
        start = view["byteOffset"]
        binary = binary[:start] + bytes(dense) + binary[start + len(dense) :]
    else:
        del item["bufferView"]
    indices = np.array(rows, np.uint16).tobytes()
    indices += bytes(-len(indices) % 4)
    for content in (indices, picked):
        doc["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(content)})
        binary += content
    last = len(doc["bufferViews"]) - 1
    item["sparse"] = {"count": len(rows), "indices": {"bufferView": last - 1, "componentType": 5123}}
    item["sparse"]["values"] = {"bufferView": last}
    doc["buffers"][0]["byteLength"] = len(binary)
    return pack(doc, binary)


@pytest.mark.parametrize(("rows", "based"), [([1, 4], True), (list(range(6)), False)])
def test_sparse_accessors_are_read_and_edited(tmp_path: Path, rows: list[int], based: bool) -> None:
    """glTF 2.0, 3.6.2.3: elements that stand over others, or over zeros."""
    splats = random_splats(6, 0)
    (tmp_path / "plain.glb").write_bytes(build(attributes_of(splats)))
    (tmp_path / "sparse.glb").write_bytes(sparse_glb(splats, "OPACITY", rows, based))
    plain, sparse = (io.read(tmp_path / f"{name}.glb") for name in ("plain", "sparse"))
    assert same_bits(sparse, plain)
    write_glb(tmp_path / "again.glb", sparse)
    assert (tmp_path / "again.glb").read_bytes() == (tmp_path / "sparse.glb").read_bytes()
    opacities = sparse.opacities.copy()
    opacities[2] = 0.25
    write_glb(tmp_path / "edited.glb", replace(sparse, opacities=opacities))
    np.testing.assert_array_equal(io.read(tmp_path / "edited.glb").opacities, opacities)


def test_sparse_rows_without_bytes_are_bounded(tmp_path: Path) -> None:
    doc, binary = parts(sparse_glb(random_splats(6, 0), "OPACITY", [0], False))
    item = next(one for one in doc["accessors"] if "sparse" in one)
    item["count"] = 1 << 40
    (tmp_path / "bomb.glb").write_bytes(pack(doc, binary))
    glb = gltf.parse((tmp_path / "bomb.glb").read_bytes(), tmp_path / "bomb.glb")
    with pytest.raises(ValueError, match="sparse accessor . of 1099511627776 elements in a file of"):
        gltf.accessor(glb, binary, doc["accessors"].index(item), tmp_path / "bomb.glb")
    item["count"] = 6
    item["sparse"]["indices"]["componentType"] = 5126
    (tmp_path / "bomb.glb").write_bytes(pack(doc, binary))
    with pytest.raises(ValueError, match="expected unsigned integers as its indices"):
        io.read(tmp_path / "bomb.glb")
