"""`verify` without a receipt: every way to tamper with a file is told of in a line that says what was tampered with."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter import receipts
from splatpainter.commands import verify as verify_command
from splatpainter.io.formats.spz import write_spz
from tests.io.test_ksplat import make as make_ksplat
from tests.support.glb_files import attributes_of, build
from tests.support.io_assets import random_splats

Change = Callable[[bytes], bytes]
NAMES = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
NAMES += ["rot_0", "rot_1", "rot_2", "rot_3", "confidence"]


def ply(text: bool = False) -> bytes:
    """By hand: normals, an extra property, comments, obj_info, an element ahead and one behind, trailing bytes."""
    table = np.random.default_rng(3).normal(0, 0.5, (6, len(NAMES))).astype("<f4")
    kind = "ascii" if text else "binary_little_endian"
    lines = ["ply", f"format {kind} 1.0", "comment made by hand", "obj_info of a test", "element camera 1"]
    lines += ["property float fov", "element vertex 6", *(f"property float {name}" for name in NAMES)]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    head = "\n".join(lines).encode()
    if text:
        rows = "".join(" ".join(f"{value:.6f}" for value in row) + "\n" for row in table.tolist())
        return head + b"42.5\n" + rows.encode() + b"3 0 1 2\nthe end\n"
    return head + struct.pack("<f", 42.5) + table.tobytes() + struct.pack("<B3i", 3, 0, 1, 2) + b"the end"


def swap(old: bytes, new: bytes) -> Change:
    def change(data: bytes) -> bytes:
        assert old in data
        return data.replace(old, new, 1)

    return change


def word(row: int, name: str, change: Callable[[bytes], bytes]) -> Change:
    """One word of a row of the text file."""

    def apply(data: bytes) -> bytes:
        head, body = data.split(b"end_header\n")
        lines = body.split(b"\n")
        words = lines[1 + row].split(b" ")
        words[NAMES.index(name)] = change(words[NAMES.index(name)])
        lines[1 + row] = b" ".join(words)
        return head + b"end_header\n" + b"\n".join(lines)

    return apply


def value(row: int, name: str, number: float = 0.125) -> Change:
    """One value of a row of the binary file."""

    def apply(data: bytes) -> bytes:
        at = data.index(b"end_header\n") + 11 + 4 + 4 * (row * len(NAMES) + NAMES.index(name))
        return data[:at] + struct.pack("<f", number) + data[at + 4 :]

    return apply


def columns(names: list[str], type: str = "float", order: str = "<") -> Change:
    """The binary file with the rows stored otherwise, the same values in them."""

    def apply(data: bytes) -> bytes:
        head, body = data.split(b"end_header\n")
        old = np.frombuffer(body[4 : 4 + 6 * 4 * len(NAMES)], "<f4").reshape(6, -1)
        code = {"float": "f4", "double": "f8"}[type]
        fresh = np.stack([old[:, NAMES.index(n)] if n in NAMES else old[:, 0] * 0 for n in names], 1)
        text = re.sub(rb"(property float [a-z_0-9]+\n)+element face", b"*element face", head)
        text = text.replace(b"*", "".join(f"property {type} {name}\n" for name in names).encode())
        if order == ">":
            text = text.replace(b"little", b"big")
            body = body[:4][::-1] + body[4:-20] + struct.pack(">B3i", 3, 0, 1, 2) + b"the end"
        tail = body[4 + 6 * 4 * len(NAMES) :]
        return text + b"end_header\n" + body[:4] + fresh.astype(order + code).tobytes() + tail

    return apply


LESS = [name for name in NAMES if name != "confidence"]
PLY: dict[str, tuple[Change, str]] = {
    "a normal": (value(2, "nx"), "nx, which no edit changes, differs in 1 rows: 2"),
    "an extra property": (value(4, "confidence"), "confidence, which no edit changes, differs in 1 rows: 4"),
    "a position": (value(1, "y"), "changed rows differ in y"),
    "the sign of a zero": (lambda d: value(1, "y", -0.0)(d), "changed rows differ in y"),
    "a dropped property": (columns(LESS), "dropped properties: confidence"),
    "dropped normals": (columns([n for n in NAMES if n[0] != "n"]), "dropped properties: nx, ny, nz"),
    "an added property": (columns([*NAMES, "label"]), "added properties: label"),
    "reordered properties": (columns([*NAMES[3:], *NAMES[:3]]), "the properties stand in another order"),
    "retyped properties": (columns(NAMES, "double"), "retyped properties: x from f4 to f8"),
    "another byte order": (columns(NAMES, order=">"), "format: 'binary_little_endian' became 'binary_big_endian'"),
    "a renamed property": (swap(b"confidence", b"certainty!"), "dropped properties: confidence"),
    "another comment": (swap(b"made by hand", b"made by HAND"), "header: 'comment made by hand' is missing"),
    "a comment that changes pixels": (
        swap(b"obj_info", b"comment SplatRenderMode: mip\nobj_info"),
        "header: 'comment SplatRenderMode: mip' is new",
    ),
    "another colour space": (
        swap(b"obj_info", b"comment SplatColorSpace: linear\nobj_info"),
        "header: 'comment SplatColorSpace: linear' is new",
    ),
    "a dropped comment": (swap(b"comment made by hand\n", b""), "header: 'comment made by hand' is missing"),
    "another obj_info": (swap(b"of a test", b"of a joke"), "header: 'obj_info of a test' is missing"),
    "comments elsewhere": (
        swap(b"comment made by hand\nobj_info of a test\n", b"obj_info of a test\ncomment made by hand\n"),
        "header: its lines stand in another order",
    ),
    "CRLF": (lambda d: d[: d.index(b"end_h")].replace(b"\n", b"\r\n") + d[d.index(b"end_h") :], "line ends: "),
    "an element ahead": (swap(struct.pack("<f", 42.5), struct.pack("<f", 43)), "element camera differs at its byte"),
    "an element behind": (
        swap(struct.pack("<B3i", 3, 0, 1, 2), struct.pack("<B3i", 3, 0, 1, 5)),
        "element face differs",
    ),
    "an element's own property": (swap(b"fov", b"fox"), "header: 'property float fov' is missing"),
    "another trailing byte": (swap(b"the end", b"The end"), "trailing bytes differs at its byte 0"),
    "more trailing bytes": (lambda d: d + b"!", "trailing bytes: 7 bytes became 8"),
    "no trailing bytes": (lambda d: d[:-7], "trailing bytes: 7 bytes became 0"),
}
TEXT: dict[str, tuple[Change, str]] = {
    "a normal": (word(2, "ny", lambda w: b"9"), "ny, which no edit changes, differs in 1 rows: 2"),
    "an extra column": (word(0, "confidence", lambda w: b"7.5"), "confidence, which no edit changes, differs"),
    "more digits": (word(3, "x", lambda w: w + b"0"), "changed rows differ in x"),
    "fewer digits": (word(3, "rot_2", lambda w: w[:-1]), "changed rows differ in rot_2"),
    "digits beyond float32": (word(5, "z", lambda w: w + b"00000001"), "changed rows differ in z"),
    "white space": (word(1, "x", lambda w: w + b" "), "white space, which no edit changes, differs in 1 rows: 1"),
    "an element ahead": (swap(b"42.5\n", b"42.6\n"), "element camera differs at its byte 3"),
    "an element behind": (swap(b"3 0 1 2\n", b"3 0 2 1\n"), "element face differs"),
    "lines behind": (swap(b"the end", b"the End"), "trailing bytes differs"),
    "no last line end": (lambda d: d[:-1], "trailing bytes: 8 bytes became 7"),
    "a comment": (swap(b"made by hand", b"made by foot"), "header: 'comment made by hand' is missing"),
}


def at(position: int, byte: int | None = None) -> Change:
    """One byte (from the end if negative) is another one."""

    def apply(data: bytes) -> bytes:
        out = bytearray(data)
        out[position] = out[position] ^ 1 if byte is None else byte
        return bytes(out)

    return apply


def inside(change: Change) -> Change:
    """Inside a gzip stream."""
    return lambda data: gzip.compress(change(gzip.decompress(data)), mtime=0)


def in_json(change: Callable[[dict], None]) -> Change:
    """In the JSON of a GLB file."""

    def apply(data: bytes) -> bytes:
        size = struct.unpack_from("<I", data, 12)[0]
        doc = json.loads(data[20 : 20 + size])
        change(doc)
        text = json.dumps(doc).encode()
        text += b" " * (-len(text) % 4)
        total = struct.unpack_from("<I", data, 8)[0] + len(text) - size
        return data[:8] + struct.pack("<III", total, len(text), 0x4E4F534A) + text + data[20 + size :]

    return apply


def in_zip(change: Callable[[dict[str, bytes]], None]) -> Change:
    """Among the files of a bundle."""

    def apply(data: bytes) -> bytes:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = {name: archive.read(name) for name in archive.namelist()}
        change(entries)
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as archive:
            for name, content in entries.items():
                archive.writestr(zipfile.ZipInfo(name), content)
        return out.getvalue()

    return apply


def in_meta(change: Callable[[dict], None]) -> Change:
    def apply(entries: dict[str, bytes]) -> None:
        meta = json.loads(entries["meta.json"])
        change(meta)
        entries["meta.json"] = json.dumps(meta).encode()

    return in_zip(apply)


def chunk_extended(data: bytes) -> bytes:
    """A compressed PLY with an element that is not ours."""
    head, body = data.split(b"end_header\n")
    return head + b"element note 2\nproperty uchar letter\nend_header\n" + body + b"hi"


EXTENSION = struct.pack("<III", 0xADBE0002, 4, 7)
OTHER_CHANGES: dict[str, tuple[str, Change, str]] = {
    "compressed PLY: element": ("a.compressed.ply", lambda d: d[:-1] + b"o", "element note differs at its byte 1"),
    "compressed PLY: comment": ("a.compressed.ply", swap(b"ply\n", b"ply\ncomment x\n"), "header: 'comment x' is new"),
    "compressed PLY: tail": ("a.compressed.ply", lambda d: d + b"!", "trailing bytes: 0 bytes became 1"),
    "compressed PLY: word": ("a.compressed.ply", at(-3), "changed rows differ in f_rest_8"),
    ".splat: tail": ("a.splat", lambda d: d + b"!", "trailing bytes: 0 bytes became 1"),
    ".splat: colour": ("a.splat", at(24), "changed rows differ in rgb"),
    ".ksplat: header": ("a.ksplat", at(4095), "the files differ in bytes that are not compared: header, sections"),
    "SPZ: flag": ("a.spz", inside(at(14)), "flags: "),
    "SPZ: reserved byte": ("a.spz", inside(at(15, 9)), r"reserved bytes: b'\x00' became b'\t'"),
    "SPZ: extension": ("a.spz", inside(lambda d: d + EXTENSION), "extensions: "),
    "SPZ: tail": ("a.spz", lambda d: d + b"tail", "trailing bytes: 0 bytes became 4"),
    "SPZ: word": ("a.spz", inside(at(16)), "changed rows differ in positions byte 0"),
    "SPZ: packing": ("a.spz", lambda d: gzip.compress(gzip.decompress(d), 1, mtime=5), "how the streams are packed"),
    "SOG: unknown entry": ("a.sog", in_meta(lambda m: m.update(mine=[1])), "meta.json differs at .mine (new)"),
    "SOG: antialias": ("a.sog", in_meta(lambda m: m.update(antialias=True)), "meta.json differs at .antialias"),
    "SOG: another file": ("a.sog", in_zip(lambda e: e.update({"note.txt": b"x"})), "note.txt: 0 bytes became 1"),
    "GLB: other JSON": (
        "a.glb",
        in_json(lambda d: d["materials"][0].update(name="x")),
        "JSON differs at .materials[0].name",
    ),
    "GLB: a node": ("a.glb", in_json(lambda d: d["nodes"][0].update(name="x")), "JSON differs at .nodes[0].name (new)"),
    "GLB: colour space": (
        "a.glb",
        swap(b'"srgb_rec709_display"', b'"lin_rec709_display" '),
        ".colorSpace ('srgb_rec709_display' became 'lin_rec709_display')",
    ),
    "GLB: another chunk": ("a.glb", swap(b"more", b"mare"), "chunk 0x12345678 differs at its byte 1"),
    "GLB: tail": ("a.glb", swap(b"tail", b"tall"), "trailing bytes differs at its byte 2"),
}


def valid_file(folder: Path, name: str) -> bytes:
    """A sound file of each kind."""
    splats = random_splats(6, 1, 2)
    path = folder / f"sound-{name}"
    if name == "a.ksplat":
        return make_ksplat(folder, 1, [1, 0])[0].read_bytes()
    if name == "a.glb":
        return build(attributes_of(splats))
    if name == "a.spz":
        write_spz(path, splats, version=3)
    else:
        sp.write(path, splats)
    data = path.read_bytes()
    return chunk_extended(data) if name == "a.compressed.ply" else data


def lines_of(folder: Path, name: str, data: bytes, tampered: bytes) -> tuple[receipts.Verification, str]:
    assert data != tampered
    original, edited = folder / name, folder / f"tampered-{name}"
    original.write_bytes(data)
    edited.write_bytes(tampered)
    assert sp.verify(original, original).ok and sp.verify(original, original).changed == 0
    out = verify_command.run(verify_command.Config(original, edited))
    verified = sp.verify(original, edited)
    assert (out.code == 0) == verified.ok
    return verified, "\n".join(out.lines)


def judge(verified: receipts.Verification, text: str, line: str) -> None:
    assert line in text, text
    assert all(one.isprintable() for one in text.split("\n"))
    if line.startswith("changed rows differ"):
        assert verified.ok and verified.changed == 1
    else:
        assert not verified.ok and any(line in problem for problem in verified.problems)


@pytest.mark.parametrize("name", PLY)
def test_a_binary_ply_that_was_tampered_with(tmp_path: Path, name: str) -> None:
    change, line = PLY[name]
    judge(*lines_of(tmp_path, "a.ply", ply(), change(ply())), line)


@pytest.mark.parametrize("name", TEXT)
def test_a_text_ply_that_was_tampered_with(tmp_path: Path, name: str) -> None:
    change, line = TEXT[name]
    judge(*lines_of(tmp_path, "a.ply", ply(text=True), change(ply(text=True))), line)


@pytest.mark.parametrize("case", OTHER_CHANGES)
def test_another_file_that_was_tampered_with(tmp_path: Path, case: str) -> None:
    name, change, line = OTHER_CHANGES[case]
    data = valid_file(tmp_path, name)
    judge(*lines_of(tmp_path, name, data, change(data)), line)


def test_a_ply_as_text_is_not_the_same_file(tmp_path: Path) -> None:
    verified, text = lines_of(tmp_path, "a.ply", ply(), ply(text=True))
    assert not verified.ok and "format: 'binary_little_endian' became 'ascii'" in text
    assert "not compared: the stored bytes of the rows, whose layout differs" in text and "byte-identical" not in text


@pytest.mark.parametrize("name", ["a.ply", "text.ply", "a.compressed.ply", "a.splat", "a.spz", "a.sog", "a.glb"])
def test_recoloured_and_appended_rows_are_counted_and_nothing_else_is_wrong(tmp_path: Path, name: str) -> None:
    data = {"a.ply": ply(), "text.ply": ply(text=True)}.get(name) or valid_file(tmp_path, name)
    original, edited = tmp_path / name, tmp_path / f"edited-{name}"
    original.write_bytes(data)
    splats = sp.read(original)
    sh = splats.sh.copy()
    sh[[1, 4], 0] += 0.05
    result = replace(splats, sh=sh)
    sp.write(edited, result.append(result.take(np.array([3]))))
    verified = sp.verify(original, edited)
    assert verified.ok, verified.problems
    assert verified.appended == 1 and 2 <= verified.changed <= (6 if name in ("a.sog", "a.compressed.ply") else 2)
    sp.write(edited, result, overwrite=True)
    verified = sp.verify(original, edited)
    assert verified.ok and verified.appended == 0, verified.problems
    sp.write(edited, splats, overwrite=True)
    verified = sp.verify(original, edited)
    assert verified.ok and verified.changed == 0 and not verified.problems


def test_what_was_not_compared_is_named(tmp_path: Path) -> None:
    original, edited = tmp_path / "a.ply", tmp_path / "b.splat"
    original.write_bytes(ply())
    sp.write(edited, sp.read(original))
    verified = sp.verify(original, edited)
    assert verified.ok and verified.not_compared == (
        "header, other elements and trailing bytes, as the formats differ",
    )
    assert "converted to splat" in verified.exact


def test_other_properties_of_a_listed_row_stay_what_they_were(tmp_path: Path) -> None:
    original, edited = tmp_path / "a.ply", tmp_path / "b.ply"
    original.write_bytes(ply())
    edited.write_bytes(value(2, "nx")(value(2, "f_dc_0")(ply())))
    one, two = sp.read(original), sp.read(edited)
    rows = np.array([2])
    hashes = receipts.untouched_hashes(one, two, rows)
    proof = receipts.Receipt(one.sha256, 6, two.sha256, 6, "local", "lift", "lift", rows, 0, *hashes)
    verified = sp.verify(original, edited, proof)
    assert verified.problems == ("nx, which no edit changes, differs in 1 rows: 2",)


def test_a_lying_count_of_lines_costs_no_time(tmp_path: Path) -> None:
    """Two milliards of faces in a text file of two kilobytes: verify reads what is there."""
    one, two = tmp_path / "one.ply", tmp_path / "two.ply"
    lie = b"element face 2147483647\nproperty list uchar int vertex_indices\nend_header"
    head, body = ply(text=True).split(b"element face", 1)
    text = head + lie + body[body.index(b"end_header") + len(b"end_header") :]
    one.write_bytes(text)
    two.write_bytes(text + b"3 0 1 2\n")
    verification = sp.verify(one, two)
    assert not verification.ok and any("face" in problem for problem in verification.problems)
