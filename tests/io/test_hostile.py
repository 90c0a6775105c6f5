"""Hostile values inside sound files: JSON of any shape, floats of any bits. Rows, or a ValueError in one line; no
warning reaches the user (pytest makes every warning an error)."""

from __future__ import annotations

import copy
import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import splatpainter as sp
from splatpainter import io
from splatpainter.commands.info import describe
from splatpainter.session import Session
from splatpainter.system.jsonio import brief
from tests.io.test_compressed_ply import CHUNK, compressed
from tests.io.test_compressed_ply import ROW as PACKED_ROW
from tests.io.test_ksplat import make
from tests.io.test_ply import BASE, ROW, ply, text
from tests.io.test_sog import bundle, by_hand
from tests.io.test_spz import COLORS, POSITIONS, REST, SCALES, head
from tests.support.cli_scenes import Capture, listing, run
from tests.support.glb_files import attributes_of, build, pack, parts
from tests.support.io_assets import random_splats

WORDS = [0x7F800001, 0x7FC00000, 0xFFFFFFFF, 0x7F800000, 0xFF800000, 0x7F7FFFFF, 0xFF7FFFFF, 1, 0x80000000, 0x42F00000]
"""float32: NaNs (the first one signals), infinities, the largest and smallest numbers, -0, 120."""
FLOATS = np.array(WORDS, np.uint32).view(np.float32)
STRANGE: list[Any] = [
    None,
    True,
    -1,
    0.5,
    1e300,
    10**30,
    -(10**400),
    "x",
    "\ud800\n",
    "",
    [],
    {},
    [[[]]],
    ["a"],
    {"a": 1},
]


def look(path: Path) -> None:
    """What `info` and `convert` do with a file; refusals are one line of ours."""
    try:
        splats = io.read(path)
        describe(splats, path)
    except ValueError as error:
        assert str(error).startswith(str(path.parent)) and len(str(error).splitlines()) == 1 and len(str(error)) < 400
        return
    for entry in io.FORMATS.values():
        if entry.write is not None:
            out = path.parent / f"out{entry.suffixes[0]}"
            try:
                io.write(out, splats, overwrite=True)
                describe(io.read(out), out)
            except ValueError as error:
                assert len(str(error).splitlines()) == 1
    assert splats.source is not None
    if io.FORMATS[splats.source.format].write is not None:
        same = path.with_name(f"same{path.suffix}")
        io.FORMATS[splats.source.format].write(same, splats)  # type: ignore[misc]
        assert same.read_bytes() == path.read_bytes()


def mutants(doc: Any) -> Iterator[Any]:
    """`doc` with one value after another removed or replaced by each of STRANGE."""
    value_paths: list[tuple[Any, ...]] = []

    def walk(item: Any, value_path: tuple[Any, ...]) -> None:
        children = item.items() if isinstance(item, dict) else enumerate(item[:2]) if isinstance(item, list) else ()
        for key, child in children:
            value_paths.append((*value_path, key))
            walk(child, (*value_path, key))

    walk(doc, ())
    for k, value_path in enumerate(value_paths):
        for value in [..., *STRANGE][k % 2 :: 2]:
            changed = copy.deepcopy(doc)
            holder = changed
            for key in value_path[:-1]:
                holder = holder[key]
            if value is ...:
                del holder[value_path[-1]]
            else:
                holder[value_path[-1]] = value
            yield changed


def open_or_refuse(path: Path) -> int:
    try:
        io.read(path)
    except ValueError as error:
        message = str(error)
        assert (
            message.startswith(str(path))
            and len(message.splitlines()) == 1
            and message.isprintable()
            and len(message) < 500
        )
        return 0
    return 1


def test_glb_json_of_any_shape(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    doc, binary = parts(build(attributes_of(random_splats(4, 0)), [{"mesh": 1, "children": [1]}, {"scale": [1, 1, 1]}]))
    opened = refused = 0
    for changed in mutants(doc):
        path.write_bytes(pack(changed, binary))
        opened, refused = opened + 1, refused + 1 - open_or_refuse(path)
    assert opened > 500 and refused > 150


def test_sog_json_of_any_shape(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    files = by_hand()
    opened = refused = 0
    for changed in mutants(json.loads(files["meta.json"])):
        bundle(path, files | {"meta.json": json.dumps(changed).encode()})
        opened, refused = opened + 1, refused + 1 - open_or_refuse(path)
    assert opened > 200 and refused > 100


def test_json_values_in_errors_are_short() -> None:
    assert brief(10**9000).startswith("an integer of ") and brief([0] * 10**6) == "a list of 1000000"
    assert all(len(brief(value)) <= 60 and brief(value).isprintable() for value in STRANGE)


def test_views_beyond_their_buffer(tmp_path: Path) -> None:
    """Numbers that numpy itself would refuse in words of its own, or with OverflowError."""
    path = tmp_path / "a.glb"
    for rows in (0, 1, 4):
        doc, binary = parts(build(attributes_of(random_splats(4, 0))))
        for item in doc["accessors"]:
            item["count"] = rows
        for key, kind in (("byteStride", "bufferViews"), ("byteOffset", "bufferViews"), ("byteOffset", "accessors")):
            for value in (10**30, 2**63, 2**53 - 1, 10**6, 3):
                changed = copy.deepcopy(doc)
                changed[kind][1][key] = value
                path.write_bytes(pack(changed, binary))
                open_or_refuse(path)


@pytest.mark.parametrize("column", range(len(ROW)))
def test_ply_of_any_floats(column: int, tmp_path: Path) -> None:
    rows = np.tile(np.array(ROW, np.float32), (len(FLOATS) + 1, 1))
    rows[1:, column] = FLOATS
    data = ply(BASE, []).replace(b"vertex 0", b"vertex %d" % len(rows))
    (tmp_path / "a.ply").write_bytes(data + rows.tobytes())
    look(tmp_path / "a.ply")
    wide = data.replace(b"property float", b"property double")
    (tmp_path / "b.ply").write_bytes(wide + np.array([[1e300, -1e300][k % 2] for k in range(14 * len(rows))]).tobytes())
    look(tmp_path / "b.ply")


def test_text_ply_of_any_floats(tmp_path: Path) -> None:
    for word in (b"nan", b"-inf", b"1e400", b"-1e39", b"1e-400", b"3.4e38", b"nan(0)", b"1_0", b"0x1p3"):
        (tmp_path / "a.ply").write_bytes(text("1", b" ".join([word] * 14) + b"\n"))
        look(tmp_path / "a.ply")


def test_colours_of_any_floats(tmp_path: Path) -> None:
    names = [name.replace("f_dc_0", "red").replace("f_dc_1", "green").replace("f_dc_2", "blue") for name in BASE]
    data = ply(names, []).replace(b"vertex 0", b"vertex %d" % len(FLOATS))
    (tmp_path / "a.ply").write_bytes(data + np.repeat(FLOATS[:, None], 14, 1).tobytes())
    look(tmp_path / "a.ply")


def test_splat_of_any_floats(tmp_path: Path) -> None:
    rows = [np.roll(FLOATS, k)[:6].tobytes() + bytes(range(8 * k % 200, 8 * k % 200 + 8)) for k in range(30)]
    (tmp_path / "a.splat").write_bytes(b"".join(rows))
    look(tmp_path / "a.splat")


@pytest.mark.parametrize("width", [12, 18])
def test_compressed_ply_of_any_ranges(width: int, tmp_path: Path) -> None:
    """NaN and infinite ranges, too: such a file is saved byte for byte when nothing was touched."""
    for value in FLOATS:
        for column in (0, 3, 6, 11, width - 1):
            chunk: list[float] = list(CHUNK[:width])
            chunk[column] = float(value)
            data = bytearray(compressed([chunk], [PACKED_ROW] * 3, [[0] * 9] * 3))
            at = data.index(b"end_header\n") + 11 + 4 * column
            data[at : at + 4] = value.tobytes()  # the NaN that signals does not survive struct
            path = tmp_path / "a.compressed.ply"
            path.write_bytes(data)
            splats = io.read(path)
            describe(splats, path)
            io.write(tmp_path / "b.compressed.ply", splats, overwrite=True)
            assert (tmp_path / "b.compressed.ply").read_bytes() == data
            moved = replace(splats, opacities=splats.opacities * np.float32(0.5))
            io.write(tmp_path / "b.compressed.ply", moved, overwrite=True)
            io.write(tmp_path / "b.splat", splats, overwrite=True)


def test_ksplat_of_any_floats(tmp_path: Path) -> None:
    for level in (0, 1, 2):
        data = make(tmp_path, level, [1])[0].read_bytes()
        for at in (36, 40, 4096 + 16, *range(5120, 5120 + 64, 4)):
            for word in WORDS:
                hurt = bytearray(data)
                struct.pack_into("<I", hurt, at, word)
                (tmp_path / "b.ksplat").write_bytes(hurt)
                open_or_refuse(tmp_path / "b.ksplat")
    look(tmp_path / "b.ksplat")


def test_spz_of_any_words(tmp_path: Path) -> None:
    import gzip

    halves = np.array([0x7C01, 0x7E00, 0x7C00, 0xFC00, 0x7BFF, 1], "<u2").tobytes()
    for fill in (0, 127, 255):
        body = bytes([fill] * 2) + bytes([fill] * 6) * 2 + bytes([fill] * 6) + bytes([fill] * 18)
        (tmp_path / "a.spz").write_bytes(gzip.compress(head(1) + halves + body))
        look(tmp_path / "a.spz")


@pytest.mark.parametrize(("low", "high"), [(-1e308, 1e308), (1e308, -1e308), (-800, 800), (1e-320, 0), (88.7, 88.8)])
def test_sog_of_any_ranges(low: float, high: float, tmp_path: Path) -> None:
    files = by_hand()
    meta = json.loads(files["meta.json"])
    meta["means"] |= {"mins": [low] * 3, "maxs": [high] * 3}
    for part in ("scales", "sh0", "shN"):
        meta[part]["codebook"] = np.linspace(low / 2, high / 2, 256).tolist()
    bundle(tmp_path / "a.sog", files | {"meta.json": json.dumps(meta).encode()})
    look(tmp_path / "a.sog")


def test_glb_of_any_floats(tmp_path: Path) -> None:
    rows = random_splats(len(FLOATS), 1)
    columns = attributes_of(rows)
    for name, values in columns.items():
        (tmp_path / "a.glb").write_bytes(build(columns | {name: np.repeat(FLOATS[:, None], values.shape[1], 1)}))
        look(tmp_path / "a.glb")
    color = {"COLOR_0": np.repeat(FLOATS[:, None], 4, 1)}
    bare = {name: columns[name] for name in ("POSITION", "ROTATION", "SCALE")}
    huge = (
        {"scale": [1e30] * 3},
        {"translation": [1e300, -1e300, 1e38]},
        {"matrix": [1e200] * 16},
        {"rotation": [0] * 4},
    )
    for node in huge:
        (tmp_path / "a.glb").write_bytes(build(bare | color, [{"mesh": 1} | node]))
        look(tmp_path / "a.glb")


def test_spz_of_version_2_and_degree_4_is_saved_as_it_is(tmp_path: Path) -> None:
    import gzip

    body = POSITIONS + bytes(2) + COLORS + SCALES + bytes(6) + bytes(range(72)) * 2
    data = gzip.compress(head(2, degree=4) + body)
    (tmp_path / "a.spz").write_bytes(data)
    splats = io.read(tmp_path / "a.spz")
    assert splats.sh_degree == 4 and len(REST) == 18
    io.write(tmp_path / "b.spz", splats)
    assert (tmp_path / "b.spz").read_bytes() == data
    moved = replace(splats, means=splats.means - np.float32(1))
    io.write(tmp_path / "c.spz", moved)  # edited, it needs the version that holds degree 4
    assert (tmp_path / "c.spz").read_bytes()[:8] == b"NGSP\4\0\0\0"
    assert np.array_equal(io.read(tmp_path / "c.spz").sh, splats.sh)


def test_cut_files_open_only_leniently(tmp_path: Path, capfd: Capture) -> None:
    cut = tmp_path / "cut.splat"
    io.write(cut, random_splats(1, 0))
    cut.write_bytes(cut.read_bytes() + b"\x07")
    before = listing(tmp_path)
    for words in (("info", cut), ("convert", cut, tmp_path / "a.ply")):
        ran = run(capfd, *words)
        assert ran.code == 2 and "cut.splat" in ran.error and "--lenient" in ran.error, ran
        assert listing(tmp_path) == before
    with pytest.raises(ValueError, match="1 rows and 1 bytes of one more"):
        sp.read(cut)
    splats = sp.read(cut, lenient=True)
    assert splats.source is not None and "cut short: 1 trailing bytes" in splats.source.problems[0]
    assert "cut short" in str(run(capfd, "info", cut, "--lenient", "--json").json["problems"])
    assert run(capfd, "convert", cut, tmp_path / "b.splat", "--lenient").code == 0
    assert (tmp_path / "b.splat").read_bytes() == cut.read_bytes()
    assert sp.verify(cut, tmp_path / "b.splat").ok


@pytest.mark.parametrize("form", ["binary", "text"])
def test_cut_elements_behind_the_rows(form: str, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    more = b"element camera 3\nproperty float a\nend_header"
    if form == "binary":
        data = ply(BASE, [ROW]).replace(b"end_header", more) + struct.pack("<3f", 1, 2, 3)
        cut = data[:-2]
    else:
        data = text("1", b" ".join(str(v).encode() for v in ROW) + b"\n1\n2\n3").replace(b"end_header", more)
        cut = data[:-2]
    path.write_bytes(data)
    assert len(io.read(path)) == 1
    path.write_bytes(cut)
    with pytest.raises(ValueError, match="is cut short; all rows are there"):
        io.read(path)
    splats = io.read(path, lenient=True)
    assert splats.source is not None and "cut short" in " ".join(splats.source.problems)
    io.write(tmp_path / "b.ply", splats)
    assert (tmp_path / "b.ply").read_bytes() == cut


def test_projects_of_cut_files_still_open(tmp_path: Path) -> None:
    cut = tmp_path / "cut.splat"
    io.write(cut, random_splats(50, 0))
    cut.write_bytes(cut.read_bytes() + b"\x07\x08")
    for embed in (True, False):
        Session(sp.read(cut, lenient=True), tmp_path / f"{embed}.splatproj", embed=embed).close()
        with Session.load(tmp_path / f"{embed}.splatproj") as again:
            assert len(again.splats) == 50


def test_untouched_by_turned_axes(tmp_path: Path) -> None:
    """`lenient` goes together with `axes`."""
    cut = tmp_path / "cut.splat"
    io.write(cut, random_splats(2, 0))
    cut.write_bytes(cut.read_bytes() + b"\x07")
    turned = io.read(cut, axes="rub", lenient=True)
    io.write(tmp_path / "b.splat", turned)
    assert (tmp_path / "b.splat").read_bytes() == cut.read_bytes()


@pytest.mark.parametrize("part", ["means", "shN"])
def test_planes_of_sog_do_not_share_an_image(part: str, tmp_path: Path) -> None:
    """Saving an edit of one plane would have changed the other: the file could not be read again."""
    files = by_hand()
    meta = json.loads(files["meta.json"])
    names = meta[part]["files"]
    meta[part]["files"] = [names[0], *names]
    bundle(tmp_path / "a.sog", files | {"meta.json": json.dumps(meta).encode()})
    with pytest.raises(ValueError, match="an image of its own for each plane"):
        io.read(tmp_path / "a.sog")
