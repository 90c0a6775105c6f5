"""Files that claim more than they hold: refused in one line, before anything large is made of them."""

from __future__ import annotations

import io as python_io
import json
import os
import struct
import sys
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from splatpainter.io import bounded
from splatpainter.io.bounded import Gunzip, inflate, unzstd
from splatpainter.io.formats.ply_header import element_size, read_header
from splatpainter.server.uploads.upload_sniffing import sniff
from splatpainter.system import jsonio
from tests.io.test_ksplat import make
from tests.io.test_ply import BASE, ROW, ply, save, text
from tests.io.test_sog import bundle, by_hand, huge_webp
from tests.io.test_spz import head
from tests.support.glb_files import attributes_of, build, pack, parts
from tests.support.io_assets import random_splats
from tests.support.io_packed import damages, survives
from tests.support.systems import posix_only

MIB = 1 << 20
FILES = by_hand()
META = FILES["meta.json"]


def refused(path: Path, data: bytes, reason: str, peak: int = 16 * MIB) -> None:
    """io.read says `reason` in one line, in less than `peak` bytes of memory."""
    assert survives(io.read, path, iter([data]), peak) == (0, 1)
    with pytest.raises(ValueError, match=reason):
        io.read(path)


def lying_zip(path: Path, name: str, data: bytes, says: bytes) -> bytes:
    """A deflated bundle whose directory has the size and checksum of `says` for a file that unpacks to `data`."""
    bundle_bytes = bytearray(bundle(path, FILES | {name: data}, zipfile.ZIP_DEFLATED).read_bytes())
    at = bundle_bytes.rindex(name.encode()) - 46
    assert bundle_bytes[at : at + 4] == b"PK\x01\x02"
    struct.pack_into("<I", bundle_bytes, at + 16, zlib.crc32(says))
    struct.pack_into("<I", bundle_bytes, at + 24, len(says))
    return bytes(bundle_bytes)


def edit_entry(path: Path, files: dict[str, bytes], name: bytes, offset: int, form: str, value: int) -> bytes:
    """A stored bundle with one number of a directory entry changed."""
    bundle_bytes = bytearray(bundle(path, files).read_bytes())
    struct.pack_into(form, bundle_bytes, bundle_bytes.rindex(name) - 46 + offset, value)
    return bytes(bundle_bytes)


def test_a_zip_directory_that_lies_about_sizes(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    says = b"short"
    bomb = lying_zip(path, "zeros", says + bytes(40 * MIB), says)
    assert len(bomb) < MIB
    refused(path, bomb, "zeros in the bundle should unpack to 5 bytes")
    refused(path, lying_zip(path, "meta.json", META + b" " * 20, META), "should unpack to")
    refused(path, edit_entry(path, FILES, b"lo.x", 24, "<I", 3), "its two sizes differ")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_uploads_do_not_unpack_what_a_bundle_may_not_hold(method: int, tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("meta.json", META + b" " * (24 * MIB))
    data = edit_sizes(path.read_bytes())
    assert len(data) < 100_000

    def claimed(bundle_path: Path) -> object:
        return sniff(bundle_path, str(bundle_path), 10**6)

    assert survives(claimed, path, iter([data]), 8 * MIB) == (0, 1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=f"packed by method {method}"):
        sniff(path, "a.sog", 10**6)
    refused(path, data, f"packed by method {method}")


def edit_sizes(data: bytes) -> bytes:
    """The directory says 1000 bytes of meta.json, whatever it unpacks to."""
    out = bytearray(data)
    struct.pack_into("<I", out, out.rindex(b"meta.json") - 46 + 24, 1000)
    return bytes(out)


def test_uploads_are_judged_by_their_headers(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    bundle(path, FILES)
    assert sniff(path, "a.sog", 10).gaussians == 3
    bundle(path, FILES | {"meta.json": b'{"count": "3"}'})
    with pytest.raises(ValueError, match=r"^a.sog: damaged .*expected a non-negative integer for count, found '3'"):
        sniff(path, "a.sog", 10)
    path.write_bytes(build(attributes_of(random_splats(4, 0))))
    assert sniff(path, "a.glb", 10).gaussians == 4
    doc, binary = parts(path.read_bytes())
    for accessors in ({"count": 3}, ["x"], [{"count": "9"}], [{"count": 1e300}], 7):
        path.write_bytes(pack(doc | {"accessors": accessors}, binary))
        with pytest.raises(ValueError, match=r"^a.glb: damaged"):
            sniff(path, "a.glb", 10)
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12))
    with pytest.raises(ValueError, match="truncated"):
        sniff(path, "a.glb", 10)


def test_entries_that_cannot_all_be_there(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    big = os.urandom(MIB)
    bundle_bytes = bytearray(bundle(path, FILES | {"one": big, "two": big, "six": big}).read_bytes())
    name_offset = bundle_bytes.index(b"one") - 30
    for name in (b"two", b"six"):  # all three lie over each other, as in a zip bomb of overlapping files
        struct.pack_into("<I", bundle_bytes, bundle_bytes.rindex(name) - 46 + 42, name_offset)
    del bundle_bytes[bundle_bytes.index(b"two") - 30 : bundle_bytes.index(b"PK\x01\x02")]
    at = bundle_bytes.rindex(b"PK\x05\x06")
    struct.pack_into("<I", bundle_bytes, at + 16, bundle_bytes.index(b"PK\x01\x02"))
    refused(path, bytes(bundle_bytes), "its files need more bytes than it has")


@pytest.mark.parametrize(
    ("offset", "form", "value", "reason"),
    [
        (6, "<H", 99, "damaged zip .*zip file version"),  # needed to unpack: NotImplementedError of zipfile
        (8, "<H", 1, "encrypted or packed"),
        (10, "<H", 8, "deflate stream|damaged"),
        (10, "<H", 14, "packed by method 14"),
        (16, "<I", 1, "checksum"),
        (20, "<I", 2**31, "more bytes than it has"),
        (28, "<H", 0, "the bundle holds the name ''"),  # an empty name: IndexError of zipfile
        (42, "<I", 1, "does not begin where"),
        (42, "<I", 2**32 - 2, "truncated"),
    ],
)
def test_hostile_entries(offset: int, form: str, value: int, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    data = edit_entry(path, FILES | {"last": b"x"}, b"last", offset, form, value)
    if offset == 28:  # the name's bytes become the extra field, so that the directory keeps its length
        at = data.rindex(b"last") - 46
        data = data[: at + 30] + struct.pack("<H", 4) + data[at + 32 :]
        data = data.replace(b"last", struct.pack("<HH", 0x9999, 0))
    refused(path, data, reason)


def test_directories_of_many_files(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    many = {f"{k}": b"" for k in range(bounded.BOUNDS.max_entries)}
    refused(path, bundle(path, FILES | many).read_bytes(), "more than 4096 files", peak=4 * MIB)


def test_planes_are_judged_together(tmp_path: Path) -> None:
    """Every one of the images within its limit, all of them far beyond what a file of this size may unpack to."""
    meta = json.dumps(json.loads(META) | {"count": 700_000}).encode()
    planes = {name: huge_webp(1000, 1400) for name in FILES if name not in ("meta.json", "palette.x")}
    refused(tmp_path / "a.sog", bundle(tmp_path / "a.sog", FILES | planes | {"meta.json": meta}).read_bytes(), "claims")


def test_rows_of_a_padded_file(tmp_path: Path) -> None:
    """3 million equal rows: bytes that the file does not need do not buy them."""
    rows = 3_000_000
    compressor = zlib.compressobj(9, wbits=31)
    packed = compressor.compress(head(2, rows=rows, degree=0)) + compressor.compress(bytes(19 * rows))
    data = packed + compressor.flush() + bytes(700_000)
    refused(tmp_path / "a.spz", data, "3000000 rows would take 168000000 bytes")


def test_json_is_limited_before_it_is_parsed(tmp_path: Path) -> None:
    doc, binary = parts(build(attributes_of(random_splats(4, 0))))
    doc["extras"] = 0
    bomb = pack(doc, binary).replace(b'"extras": 0', b'"extras": [' + b"{}," * (6 * MIB) + b"0]")
    at = bomb.index(b"{")
    size = bomb.rindex(b"}", 0, bomb.index(b"BIN\0")) + 1 - at
    bomb = bomb[:8] + struct.pack("<II", len(bomb), size) + bomb[16:at] + bomb[at:]
    refused(tmp_path / "a.glb", bomb, "expected at most 16777216", peak=80 * MIB)
    spaces = {"meta.json": META[:-1] + b" " * (17 * MIB) + b"}"}
    refused(tmp_path / "a.sog", bundle(tmp_path / "a.sog", FILES | spaces).read_bytes(), "at most 16777216", 80 * MIB)


def test_chunks_nodes_and_sections_are_limited(tmp_path: Path) -> None:
    data = build(attributes_of(random_splats(4, 0)))
    chunks = data[:-4] + struct.pack("<II", 0, 7) * 20_000
    refused(tmp_path / "a.glb", chunks[:8] + struct.pack("<I", len(chunks)) + chunks[12:], "more than 1024 chunks")
    doc, binary = parts(data)
    doc["nodes"] = [{"mesh": 1}, *({"children": [k]} for k in range(3000))]
    refused(tmp_path / "b.glb", pack(doc, binary), "more than 1024 deep")
    sections = bytearray(make(tmp_path, 1, [1])[0].read_bytes()[:4096] + bytes(1024 * 5000))
    struct.pack_into("<I", sections, 4, 5000)
    refused(tmp_path / "a.ksplat", bytes(sections), "at most 4096 sections", peak=24 * MIB)


def test_accessors_that_share_their_bytes(tmp_path: Path) -> None:
    rows = 700_000
    doc, binary = parts(build(attributes_of(random_splats(4, 3))))
    doc["bufferViews"] = [{"buffer": 0, "byteOffset": 0, "byteLength": 4 * rows}]
    doc["buffers"][0]["byteLength"] = 4 * rows
    for item in doc["accessors"]:
        item |= {"bufferView": 0, "byteOffset": 0, "componentType": 5121, "count": rows}
    refused(tmp_path / "a.glb", pack(doc, bytes(4 * rows)), "700000 rows would take", peak=40 * MIB)


class Counted(python_io.BytesIO):
    """A file that counts how often it is read."""

    reads = 0

    def read(self, size: int | None = -1, /) -> bytes:
        self.reads += 1
        return super().read(size)


def element(count: int, properties: str, body: bytes) -> tuple[Counted, int]:
    """(what `element_size` read from, what it found) of an element of a little-endian file."""
    lines = f"ply\nformat binary_little_endian 1.0\nelement a {count}\n{properties}end_header\n"
    file = Counted(lines.encode() + body)
    header = read_header(file, Path("a.ply"))
    file.reads = 0
    return file, element_size(file, header, header.elements[0], len(body), Path("a.ply"))


@pytest.mark.parametrize("even", [True, False])
def test_lists_are_measured_as_a_row_by_row_walk_does(even: bool) -> None:
    rng = np.random.default_rng(3)
    lengths = np.repeat(rng.integers(0, 4, (40, 2)), 500, 0) if even else rng.integers(-1, 4, (20_000, 2))
    lengths = np.concatenate([lengths, [[3, 2]], lengths[:7]])
    body = b"".join(
        struct.pack("<H", abs(a)) + bytes(4 * abs(a)) + bytes(4) + struct.pack("<b", b) + bytes(8 * max(b, 0))
        for a, b in lengths.tolist()
    )
    properties = "property list ushort int q\nproperty float x\nproperty list char double r\n"
    assert element(len(lengths), properties, body)[1] == len(body)
    with pytest.raises(ValueError, match="truncated: .* rows of element 'a' need more bytes"):
        element(len(lengths), properties, body[:-1])
    with pytest.raises(ValueError, match="truncated"):
        element(10**14, properties, body)


def test_many_lists_are_read_in_few_pieces() -> None:
    """A million lists of nothing, and a mesh of triangles: a handful of reads, not one for each list."""
    file, size = element(1_000_000, "property list uchar uchar q\n", bytes(1_000_000))
    assert size == 1_000_000 and file.reads < 10
    mesh = (b"\x03" + bytes(12)) * 100_000
    file, size = element(100_000, "property list uchar int vertex_indices\n", mesh)
    assert size == len(mesh) and file.reads < 10
    uneven = b"".join(bytes([k % 3]) + bytes(k % 3) for k in range(100_000))
    file, size = element(100_000, "property list uchar uchar q\n", uneven)
    assert size == len(uneven) and file.reads < 10


def test_uneven_lists_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatpainter.io.formats.ply_header.MAX_UNEVEN_LISTS", 1000)
    uneven = b"".join(bytes([k % 3]) + bytes(k % 3) for k in range(3000))
    with pytest.raises(ValueError, match="more than 1000 lists of uneven length"):
        element(3000, "property list uchar uchar q\n", uneven)
    assert element(10**5, "property list uchar uchar q\n", bytes(10**5))[1] == 10**5


def test_text_of_newlines(tmp_path: Path) -> None:
    row = b" ".join(str(value).encode() for value in ROW) + b"\n"
    path = save(tmp_path, text("1", row + b"\n" * (4 * MIB)))
    assert survives(io.read, path, iter([path.read_bytes()]), peak=24 * MIB) == (1, 0)
    refused(path, text("2", b"\n" * (4 * MIB)), "expected 14 values, found 0", peak=24 * MIB)
    refused(path, text("9000000", b"\n" * (4 * MIB)), "truncated: 9000000 lines", peak=24 * MIB)


def test_text_of_one_line_or_one_word(tmp_path: Path) -> None:
    refused(tmp_path / "a.ply", text("1", b"0 " * (2 * MIB) + b"\n"), "expected 14 values, found 2097152", 48 * MIB)
    word = b"1" * (2 * MIB)
    refused(
        tmp_path / "a.ply", text("1", b"0 " * 13 + word + b"\n"), r"row 0: expected a number, got '1{40}'", 32 * MIB
    )
    lines = save(tmp_path, text("3", b"0 " * 13 + b"1e0\n" + b"\t0" * 14 + b"\r\n" + b" " + b"7 " * 14 + b"\n"))
    assert io.read(lines).means.tolist() == [[0, 0, 0], [0, 0, 0], [7, 7, 7]]


def test_what_is_unpacked_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where it is unpacked twice: whole, cut short, and more than was said."""
    import gzip

    import zstandard

    data = np.random.default_rng(0).integers(0, 3, 300_000, np.uint8).tobytes()
    zipped, deflated = gzip.compress(data), zlib.compress(data)[2:-4]
    zst = zstandard.ZstdCompressor(write_content_size=False).compress(data)
    for limit in (bounded.BOUNDS.two_pass_bytes, 1000):
        small = replace(bounded.BOUNDS, two_pass_bytes=limit, piece_bytes=5000)
        monkeypatch.setattr(bounded, "BOUNDS", small)
        stream = Gunzip(zipped + b"tail", "f")
        assert stream.take(200, "a") + stream.take(len(data) - 205, "b") == data[:-5]
        assert stream.rest() == (data[-5:], b"tail")
        with pytest.raises(ValueError, match=f"needs {len(data) + 1} bytes, the gzip stream holds {len(data)}"):
            Gunzip(zipped, "f").take(len(data) + 1, "a")
        with pytest.raises(ValueError, match="truncated"):
            Gunzip(zipped[:-2000], "f").take(len(data), "a")
        assert unzstd(zst, len(data), "f", "a") == data
        for wrong in (len(data) - 1, len(data) + 1):
            with pytest.raises(ValueError, match="should unpack to|damaged zstd"):
                unzstd(zst, wrong, "f", "a")
    assert inflate(deflated, len(data), "f", "a") == data
    assert inflate(zlib.compress(b"")[2:-4], 0, "f", "a") == b""
    for packed, size in ((deflated, len(data) - 1), (deflated, len(data) + 1), (deflated + b"x", len(data))):
        with pytest.raises(ValueError, match="should unpack to"):
            inflate(packed, size, "f", "a")
    with pytest.raises(ValueError, match="damaged"):
        inflate(b"\xff" * 50, 10, "f", "a")


@pytest.mark.parametrize("bad", [b"\xff{}", b"[]", b"{", b'{"a": NaN}', b'{"a": -1e999}', b"{" * 5000, b"1" * 9000])
def test_json_that_is_none(bad: bytes) -> None:
    with pytest.raises(ValueError, match="^f: ") as refusal:
        jsonio.load_object(bad, "f", "x")
    assert "\n" not in str(refusal.value) and len(str(refusal.value)) < 200
    deep = b'{"a":' * 63 + b"{}" + b"}" * 63
    assert jsonio.load_object(deep, "f", "x")
    with pytest.raises(ValueError, match="nested deeper than 64"):
        jsonio.load_object(b'{"a":' + deep + b"}", "f", "x")


@posix_only
def test_pipes_and_devices_are_not_opened(tmp_path: Path) -> None:
    """Opening a pipe that nobody writes to would wait for ever."""
    assert sys.platform != "win32"
    for name in ("a.ply", "a.splat", "a.sog", "meta.json"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(ValueError, match="is a pipe or device"):
            io.read(tmp_path / name)
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "meta.json").write_bytes(META)
    for name, data in FILES.items():
        (folder / name).write_bytes(data)
    assert len(io.read(folder)) == 3
    (folder / "lo.x").unlink()
    os.mkfifo(folder / "lo.x")
    with pytest.raises(ValueError, match=r"lo\.x: is a pipe or device"):
        io.read(folder)


def test_the_rule_leaves_room_for_small_synthetic_files(tmp_path: Path) -> None:
    """A hundred thousand equal rows pack to next to nothing, and are no bomb."""
    one = random_splats(1, 1)
    equal = one.take(np.zeros(100_000, np.int64))
    for name in ("a.spz", "a.sog"):
        io.write(tmp_path / name, equal)
        assert (tmp_path / name).stat().st_size < 100_000
        assert len(io.read(tmp_path / name)) == 100_000


def test_headers_of_many_elements(tmp_path: Path) -> None:
    """A header is at most 1 MiB: names of any length and number do not blow up lines, and rows without bytes none."""
    many = "".join(f"element e{k} 999999999999999\n" for k in range(20_000))
    path = save(tmp_path, ply(BASE, [ROW], head=many))
    splats = io.read(path)
    assert splats.source is not None and all(len(problem) < 600 for problem in splats.source.problems)
    data = ply(BASE, [ROW], head="element NAME 99\nproperty list uchar uchar q")
    refused(path, data.replace(b"NAME", b"n\x85" * 100_000), r"'(n\?){40}' need more bytes, 56 are left")


def test_damaged_bundles_that_are_deflated(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    data = bundle(path, FILES, zipfile.ZIP_DEFLATED).read_bytes()
    assert sum(survives(io.read, path, damages(data, 80, 5))) == 144
    # Where the directory is: everything behind the last file.
    tail = data.index(b"PK\x01\x02")
    hurt = (data[:tail] + piece for piece in damages(data[tail:], 120, 6, head=10_000, cuts=8))
    assert sum(survives(io.read, path, hurt)) == 128
