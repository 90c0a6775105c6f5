"""INRIA PLY: golden bytes by hand, the variants met in the wild, and files that must be refused."""

from __future__ import annotations

import hashlib
import math
import struct
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter import io
from tests.support.io_assets import random_splats

BASE = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
BASE += ["rot_0", "rot_1", "rot_2", "rot_3"]
ROW = [1.5, -2.0, 0.25, 0.1, -0.2, 0.3, 0.0, math.log(0.5), 0.0, math.log(0.25), 1.0, 0.0, -0.5, 0.0]


def ply(names: list[str], rows: list[list[float]], *, head: str = "", tail: bytes = b"", order: str = "<") -> bytes:
    kind = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    lines = ["ply", f"format {kind} 1.0", *head.splitlines(), f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in names] + ["end_header"]
    body = b"".join(struct.pack(f"{order}{len(names)}f", *row) for row in rows)
    return "\n".join(lines).encode() + b"\n" + body + tail


def save(folder: Path, data: bytes, name: str = "chair.ply") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def check_base_row(splats: sp.Splats, row: int = 0) -> None:
    np.testing.assert_allclose(splats.means[row], [1.5, -2.0, 0.25], rtol=1e-6)
    np.testing.assert_allclose(splats.quats[row], [1, 0, -0.5, 0], rtol=1e-6)
    np.testing.assert_allclose(splats.scales[row], [0.5, 1, 0.25], rtol=1e-6)
    np.testing.assert_allclose(splats.opacities[row], 0.5, rtol=1e-6)
    np.testing.assert_allclose(splats.sh[row, 0], [0.1, -0.2, 0.3], rtol=1e-6)


def test_by_hand(tmp_path: Path) -> None:
    data = ply(BASE, [ROW])
    splats = io.read(save(tmp_path, data))
    check_base_row(splats)
    assert splats.sh.shape == (1, 1, 3) and splats.sh_degree == 0
    assert splats.source is not None and splats.source.format == "ply" and splats.source.problems == ()
    assert splats.source.sha256 == splats.sha256 == hashlib.sha256(data).hexdigest()
    assert splats.origin is not None and splats.origin.tolist() == [0]


def test_new_file_is_inria_layout(tmp_path: Path) -> None:
    splats = io.read(save(tmp_path, ply(BASE, [ROW])))
    io.write(tmp_path / "new.ply", replace(splats, source=None, origin=None))
    names = ["x", "y", "z", "nx", "ny", "nz", *BASE[3:]]
    assert (tmp_path / "new.ply").read_bytes() == ply(names, [[*ROW[:3], 0, 0, 0, *ROW[3:]]])


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_f_rest_is_channel_major(tmp_path: Path, degree: int) -> None:
    bands = (degree + 1) ** 2 - 1
    rest = [100.0 * c + k for c in range(3) for k in range(bands)]
    splats = io.read(save(tmp_path, ply(BASE + [f"f_rest_{k}" for k in range(3 * bands)], [ROW + rest])))
    assert splats.sh_degree == degree
    check_base_row(splats)
    for k in range(bands):
        assert splats.sh[0, 1 + k].tolist() == [k, 100 + k, 200 + k]


def test_any_order_of_properties(tmp_path: Path) -> None:
    names = BASE + [f"f_rest_{k}" for k in range(9)]
    values = ROW + list(range(9))
    pick = np.random.default_rng(3).permutation(len(names))
    splats = io.read(save(tmp_path, ply([names[k] for k in pick], [[values[k] for k in pick]])))
    check_base_row(splats)
    assert splats.sh[0, 1:].T.reshape(-1).tolist() == list(range(9))


def test_big_endian(tmp_path: Path) -> None:
    check_base_row(io.read(save(tmp_path, ply(BASE, [ROW], order=">"))))


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("empty", [0, 2])
def test_text(tmp_path: Path, newline: str, mark: str, empty: int) -> None:
    """With the line ends of three systems, a mark of UTF-8 ahead, and empty lines behind the header."""
    lines = [f"{mark}ply", "format ascii 1.0", "comment by hand", "element vertex 2"]
    lines += [f"property float {n}" for n in BASE] + ["end_header", *[""] * empty]
    lines += [" ".join(map(str, ROW)), "  ".join(map(repr, ROW))]
    splats = io.read(save(tmp_path, newline.join(lines).encode()))  # no line ending at the end of the file
    check_base_row(splats, 0)
    check_base_row(splats, 1)
    assert splats.source is not None
    assert splats.source.sha256 == hashlib.sha256(newline.join(lines).encode()).hexdigest()
    io.write(tmp_path / "again.ply", splats)
    assert (tmp_path / "again.ply").read_bytes() == newline.join(lines).encode()


def test_lines_of_carriage_returns_before_binary_rows_that_begin_with_a_line_feed(tmp_path: Path) -> None:
    """The first byte of the first row, 10, belongs to no line end."""
    head = "\r".join(["ply", "format binary_little_endian 1.0", "element vertex 1", "property uchar label"])
    head += "".join(f"\rproperty float {name}" for name in BASE) + "\rend_header\r"
    path = save(tmp_path, head.encode() + b"\n" + struct.pack("<14f", *ROW))
    check_base_row(io.read(path))
    io.write(tmp_path / "again.ply", io.read(path))
    assert (tmp_path / "again.ply").read_bytes() == path.read_bytes()


def test_utf16_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="UTF-16; save it as ASCII or UTF-8"):
        io.read(save(tmp_path, ply(BASE, [ROW]).decode("latin-1").encode("utf-16")))


def test_doubles_other_types_lists_and_crlf(tmp_path: Path) -> None:
    lines = ["ply", "format binary_little_endian 1.0", "comment hello", "obj_info 17", "element camera 2"]
    lines += ["property list uchar int ids", "property short flag", "element vertex 1", "property uchar label"]
    lines += [f"property double {n}" for n in BASE] + ["property int64 stamp", "element tail 1", "property float32 t"]
    body = struct.pack("<B3ih", 3, 1, 2, 3, -1) + struct.pack("<Bh", 0, 5)
    body += struct.pack("<B14dq", 200, *ROW, 2**40) + struct.pack("<f", 1.0)
    data = "\r\n".join([*lines, "end_header"]).encode() + b"\r\n" + body + b"more"
    splats = io.read(save(tmp_path, data))
    check_base_row(splats)
    assert splats.source is not None
    assert splats.source.problems == (
        "4 trailing bytes (kept as they are)",
        "extra vertex properties (kept as they are): label, stamp",
        "extra elements (kept as they are): camera, tail",
    )
    io.write(tmp_path / "same.ply", splats)
    assert (tmp_path / "same.ply").read_bytes() == data


def test_colours_in_place_of_f_dc(tmp_path: Path) -> None:
    names = [n for n in BASE if not n.startswith("f_dc")]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 1", *(f"property float {n}" for n in names)]
    lines += [f"property uchar {n}" for n in ("red", "green", "blue")] + ["end_header\n"]
    values = [v for n, v in zip(BASE, ROW, strict=True) if n in names]
    data = "\n".join(lines).encode() + struct.pack("<11f3B", *values, 255, 0, 51)
    splats = io.read(save(tmp_path, data))
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * splats.sh[0, 0], [1, 0, 0.2], atol=1e-6)
    sh = splats.sh.copy()
    sh[0, 0, 1] = (102 / 255 - 0.5) / 0.28209479177387814
    io.write(tmp_path / "out.ply", replace(splats, sh=sh))
    assert (tmp_path / "out.ply").read_bytes() == data[:-2] + bytes([102, 51])


@pytest.mark.parametrize(
    ("head", "antialiased"),
    [
        ("", False),
        ("comment SplatRenderMode: mip", True),
        ("comment SplatRenderMode: default", False),
        ("comment antialiased 1", True),
        ("comment antialiased 0", False),
        ("comment antialiased", True),
        ("comment SplatRenderMode: mip\ncomment antialiased 0", False),
        ("comment not antialiased 1", False),
    ],
)
def test_antialiased_comment(tmp_path: Path, head: str, antialiased: bool) -> None:
    data = ply(BASE, [ROW], head=head)
    splats = io.read(save(tmp_path, data))
    assert splats.antialiased is antialiased
    # Said the other way, it is read back so, and the rest of the file stays.
    io.write(tmp_path / "other.ply", replace(splats, antialiased=not antialiased))
    assert io.read(tmp_path / "other.ply").antialiased is not antialiased
    mode = b"comment SplatRenderMode: " + (b"default" if antialiased else b"mip") + b"\nend_header"
    assert (tmp_path / "other.ply").read_bytes() == data.replace(b"end_header", mode)


def test_linear_colours_survive(tmp_path: Path) -> None:
    io.write(tmp_path / "a.ply", replace(random_splats(3, 0), color_space="linear"))
    assert io.read(tmp_path / "a.ply").color_space == "linear"


@pytest.mark.parametrize("order", ["<", ">"])
def test_nothing_but_a_header(tmp_path: Path, order: str) -> None:
    splats = io.read(save(tmp_path, ply(BASE, [], order=order)))
    assert len(splats) == 0 and splats.sh.shape == (0, 1, 3)
    io.write(tmp_path / "same.ply", splats)
    assert (tmp_path / "same.ply").read_bytes() == ply(BASE, [], order=order)
    more = replace(io.read(save(tmp_path, ply(BASE, [ROW]))), source=None, origin=None)
    io.write(tmp_path / "more.ply", splats.append(more))
    check_base_row(io.read(tmp_path / "more.ply"))


def test_odd_rows_are_counted(tmp_path: Path) -> None:
    nan, zero = list(ROW), list(ROW)
    nan[1], zero[10], zero[12] = float("nan"), 0.0, 0.0
    splats = io.read(save(tmp_path, ply(BASE, [ROW, nan, zero, nan])))
    assert splats.source is not None
    assert splats.source.problems == (
        "2 rows with NaN or infinite values (kept, not drawn)",
        "1 row with a zero rotation quaternion (kept, not drawn)",
    )
    assert splats.drawable.tolist() == [True, False, False, False]


@pytest.mark.parametrize("opacity", [0.0, 1.0, -3.0, 7.0])
def test_written_values_are_finite(tmp_path: Path, opacity: float) -> None:
    splats = replace(
        random_splats(2, 0), opacities=np.full(2, opacity, np.float32), scales=np.zeros((2, 3), np.float32)
    )
    io.write(tmp_path / "a.ply", splats)
    again = io.read(tmp_path / "a.ply")
    assert again.drawable.all()
    np.testing.assert_allclose(again.opacities, np.clip(opacity, 0, 1), atol=1e-7)


def mesh() -> bytes:
    lines = ["ply", "format ascii 1.0", "element vertex 1", *(f"property float {a}" for a in "xyz"), "element face 1"]
    return "\n".join([*lines, "property list uchar int vertex_indices", "end_header", "0 0 0", "3 0 0 0", ""]).encode()


def text(count: str, body: bytes) -> bytes:
    head = ply(BASE, []).replace(b"binary_little_endian", b"ascii")
    return head.replace(b"vertex 0", b"vertex " + count.encode()) + body


LONG = "comment " + "x" * 1000 + "\n"
REFUSED = {
    "empty": (b"", "beginning with 'ply', got b''"),
    "not a ply": (b"plyx\n", "beginning with 'ply'"),
    "no end": (b"ply\nformat ascii 1.0\nelement vertex 0\n", "closed by 'end_header'"),
    "end without line end": (ply(BASE, [])[:-1], "closed by 'end_header'"),
    "header over 1 MiB": (ply(BASE, [ROW], head=LONG * 1100), "found none in the first 1 MiB"),
    "mesh": (mesh(), "a mesh: its vertices lack rot_0"),
    "CloudCompare": (
        ply([*BASE[:3], *(f"scalar_{name}" for name in BASE[3:])], [ROW]),
        "as CloudCompare saves them; take scalar_ off the names in its header",
    ),
    "points": (ply(["x", "y", "z"], [[0, 0, 0]]), "not a Gaussian splat file: its vertices lack rot_0"),
    "44 rest": (
        ply(BASE + [f"f_rest_{k}" for k in range(44)], [ROW + [0] * 44]),
        "chair.ply: expected 45 f_rest_* properties for SH degree 3, found 44",
    ),
    "73 rest": (ply(BASE + [f"f_rest_{k}" for k in range(73)], []), "expected 72 f_rest_* properties for SH degree 4"),
    "gap": (ply(BASE + [f"f_rest_{k}" for k in range(1, 10)], []), "but f_rest_0 is missing"),
    "2D Gaussians": (ply([n for n in BASE if n != "scale_2"], []), "no scale_2"),
    "truncated": (ply(BASE, [ROW, ROW])[:-1], "truncated: 2 rows of element 'vertex' need 112 bytes, 111 are left"),
    "type": (ply(BASE, []).replace(b"float x", b"half x"), "unknown property type 'half'"),
    "format": (ply(BASE, []).replace(b"little", b"middle"), "expected format ascii, "),
    "no format": (ply(BASE, []).replace(b"format binary_little_endian 1.0\n", b""), "no format line"),
    "negative": (ply(BASE, []).replace(b"vertex 0", b"vertex -5"), "with a count of 1 to 15 digits"),
    "digits": (ply(BASE, []).replace(b"vertex 0", b"vertex " + b"9" * 5000), "with a count of 1 to 15 digits"),
    "twice": (ply([*BASE, "x"], []), "property 'x' occurs twice"),
    "stray property": (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "a property before any element"),
    "stray line": (ply(BASE, [], head="colour red"), "expected format, comment, obj_info"),
    "no vertex": (b"ply\nformat ascii 1.0\nelement point 0\nend_header\n", "without element 'vertex'"),
    "vertex list": (ply(BASE, []).replace(b"end_", b"property list int int q\nend_"), "has a list property"),
    "lying list": (
        ply(BASE, [ROW], head="element camera 99999999999\nproperty list uint8 int32 ids"),
        "truncated: 99999999999 rows of element 'camera'",
    ),
    "words": (text("1", b"1 2" + b" " * 40 + b"\n"), "row 0 of element 'vertex': expected 14 values, found 2"),
    "no number": (text("1", b"1 " * 13 + b"no\n"), "row 0: expected a number, got 'no'"),
    "text truncated": (text("9999999999", b""), "truncated: 9999999999 lines of data expected"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_in_one_line(tmp_path: Path, name: str) -> None:
    data, reason = REFUSED[name]
    path = save(tmp_path, data)
    with pytest.raises(ValueError) as error:
        io.read(path)
    message = str(error.value)
    assert reason in message and message.startswith(str(path)) and "\n" not in message


@pytest.mark.parametrize("rows", [10**9, 10**15 - 1])
def test_lying_count_allocates_nothing(tmp_path: Path, rows: int) -> None:
    path = save(tmp_path, ply(BASE, [ROW]).replace(b"vertex 1", b"vertex %d" % rows))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="truncated"):
            io.read(path)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    data = ply(BASE, [ROW, ROW], head="comment x\nelement pre 1\nproperty list uchar float w")
    body = data.index(b"end_header\n") + len(b"end_header\n")
    data = data[:body] + struct.pack("<B2f", 2, 0.5, 0.5) + data[body:]
    assert len(io.read(save(tmp_path, data))) == 2
    for size in range(len(data)):
        with pytest.raises(ValueError):
            io.read(save(tmp_path, data[:size]))


def test_integers_of_a_text_beyond_their_type_are_told(tmp_path: Path) -> None:
    """Other programs wrap or cut them, so that they show another colour."""
    names = ["x", "y", "z", "red", "green", "blue", "opacity", *(f"scale_{k}" for k in range(3))]
    names += [f"rot_{k}" for k in range(4)]
    kinds = {name: "uchar" if name in ("red", "green", "blue") else "float" for name in names}
    head = ["ply", "format ascii 1.0", "element vertex 3", *(f"property {kinds[name]} {name}" for name in names)]
    rows = [[k, 0, 0, 10, 255, 0, 1, -3, -3, -3, 1, 0, 0, 0] for k in range(3)]
    path = tmp_path / "a.ply"

    def problems() -> str:
        body = [" ".join(map(str, row)) for row in rows]
        path.write_text("\n".join([*head, "end_header", *body, ""]))
        return " ".join(io.read(path).source.problems)  # type: ignore[union-attr]

    assert "beyond" not in problems()
    rows[1][4], rows[2][5] = 300, -1
    assert "2 integers beyond their type (row 1: green is 300, expected 0 to 255): read as they stand" in problems()
