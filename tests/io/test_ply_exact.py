"""The promise of io/formats/ply.py, over random files and random edits: whatever was not edited is the same bytes.

The files are made, and their values found again, by plain string and struct work that shares nothing with the package.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import splatpainter as sp
from splatpainter import io
from splatpainter.io.formats import ply as ply_files
from tests.support.io_assets import random_splats

CODES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
CODES["double"] = "f8"
FORMATS = {"<": "binary_little_endian", ">": "binary_big_endian", "=": "ascii"}
ATTRIBUTES = {
    "means": ["x", "y", "z"],
    "quats": ["rot_0", "rot_1", "rot_2", "rot_3"],
    "scales": ["scale_0", "scale_1", "scale_2"],
    "opacities": ["opacity"],
}
SMALL = settings(max_examples=60, deadline=None, database=None)


def positions(degree: int) -> dict[str, tuple[str, int]]:
    """Property name -> (attribute, index in its flattened row), from INRIA's definition."""
    columns = {name: (a, k) for a, names in ATTRIBUTES.items() for k, name in enumerate(names)}
    bands = (degree + 1) ** 2 - 1
    columns |= {f"f_dc_{c}": ("sh", c) for c in range(3)}
    columns |= {f"f_rest_{c * bands + k}": ("sh", 3 * (1 + k) + c) for c in range(3) for k in range(bands)}
    return columns


@dataclass
class Made:
    """A file, and where everything in it is."""

    order: str
    newline: str
    degree: int
    properties: list[tuple[str, str]]
    """(name, PLY type), in the file's order."""
    head: str
    """Up to the vertex count."""
    neck: str
    """From behind the vertex count to the end of the header."""
    before: bytes
    rows: list[list[bytes]]
    """Each value's bytes (binary), or each word with the blanks before it (text)."""
    after: bytes

    def data(self, rows: list[list[bytes]]) -> bytes:
        end = self.newline.encode() if self.order == "=" else b""
        body = b"".join(b"".join(row) + end for row in rows)
        return f"{self.head}{len(rows)}{self.neck}".encode() + self.before + body + self.after


@st.composite
def files(draw: st.DrawFn) -> Made:
    order = draw(st.sampled_from("<>="))
    newline = draw(st.sampled_from(["\n", "\r\n", "\r"]))
    degree = draw(st.integers(0, 4))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    doubles = draw(st.booleans())
    properties = [(n, "double" if doubles and rng.random() < 0.3 else "float") for n in positions(degree)]
    extra = draw(st.lists(st.sampled_from(sorted(CODES)), max_size=3))
    properties += [(f"extra_{k}", kind) for k, kind in enumerate(extra)]
    properties = [properties[k] for k in rng.permutation(len(properties))]
    mark = draw(st.sampled_from(["", "\ufeff"]))  # of UTF-8
    head = [f"{mark}ply", f"format {FORMATS[order]} 1.0", "comment end_header of nothing", "obj_info element vertex 12"]
    tail, before, after = [], b"", b""
    if draw(st.booleans()):
        head += ["element early 2", "property list uchar short l", "property int i"]
        before = f"2 5 6 7{newline}0 -1{newline}".encode() if order == "=" else b""
        for items in ([5, 6], []) if order != "=" else ():
            before += (
                bytes([len(items)]) + np.array(items, order + "i2").tobytes() + np.array([7], order + "i4").tobytes()
            )
    if draw(st.booleans()):
        tail = ["element late 1", "property uchar u"]
        after = f"7{newline}".encode() if order == "=" else b"\x07"
    after += draw(st.binary(max_size=9))
    count = draw(st.integers(1, 6))
    rows = [[_value(rng, order, kind) for _, kind in properties] for _ in range(count)]
    neck = newline + "".join(f"property {kind} {name}{newline}" for name, kind in properties)
    neck += "".join(line + newline for line in [*tail, "end_header"])
    return Made(
        order, newline, degree, properties, newline.join(head) + newline + "element vertex ", neck, before, rows, after
    )


def _value(rng: np.random.Generator, order: str, kind: str) -> bytes:
    code = CODES[kind]
    if order != "=":  # any bits at all: NaN payloads, infinities, subnormals
        return rng.integers(0, 256, int(code[1]), np.uint8).tobytes()
    blanks = [" ", "  ", "\t"][rng.integers(3)]
    if code[0] != "f":
        return f"{blanks}{rng.integers(0, 100)}".encode()
    words = ["nan", "-inf", f"{rng.normal():.3e}", f"{rng.normal():+.12f}", str(rng.integers(-9, 9))]
    return (blanks + words[rng.integers(len(words))]).encode()


@given(files())
@SMALL
def test_read_then_write_is_the_same_file(made: Made) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder, "a.ply"), Path(folder, "b.ply")
        path.write_bytes(made.data(made.rows))
        io.write(out, io.read(path))
        assert out.read_bytes() == path.read_bytes()


@given(files(), st.data())
@SMALL
def test_untouched_bytes_stay(made: Made, data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    picks = data.draw(st.lists(st.integers(0, len(made.rows) - 1), max_size=9))  # removed, repeated, reordered
    new_rows = data.draw(st.integers(0, 2))
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder, "a.ply"), Path(folder, "b.ply")
        path.write_bytes(made.data(made.rows))
        source = io.read(path)
        splats = source.take(np.array(picks, np.int64))
        for _ in range(new_rows):
            splats = splats.append(_new_row(rng, made.degree))
        splats, edited = _edit(rng, splats, data.draw(st.integers(0, 6)))
        io.write(out, splats)
        result = out.read_bytes()
    origins = picks + [-1] * new_rows
    head = f"{made.head}{len(origins)}{made.neck}".encode() + made.before
    rows = _split(made, result[len(head) :], len(origins))
    for i, (origin, row) in enumerate(zip(origins, rows, strict=True)):
        for k, (name, kind) in enumerate(made.properties):
            attribute, column = positions(made.degree).get(name, ("", 0))
            if origin >= 0 and (i, attribute, column) not in edited:
                assert row[k] == made.rows[origin][k], (i, name)
            elif attribute:
                value = float(getattr(splats, attribute)[i].reshape(-1)[column])
                value += splats.offset[column] if attribute == "means" else 0
                assert _number(made.order, kind, row[k]) == pytest.approx(_raw(attribute, value), rel=2e-6, abs=1e-7)
            else:
                assert _number(made.order, kind, row[k]) == 0
    assert made.data(rows) == result  # header, elements before and behind, trailing bytes


def _new_row(rng: np.random.Generator, degree: int) -> sp.Splats:
    means, quats, sh = (rng.normal(0, 1, s).astype(np.float32) for s in ((1, 3), (1, 4), (1, (degree + 1) ** 2, 3)))
    scales, opacities = np.exp(rng.normal(-3, 1, (1, 3))), rng.uniform(0.01, 0.99, 1)
    return sp.Splats(means, quats, scales.astype(np.float32), opacities.astype(np.float32), sh)


def _edit(rng: np.random.Generator, splats: sp.Splats, edits: int) -> tuple[sp.Splats, set[tuple[int, str, int]]]:
    """Single values set to others; (row, attribute, flattened index) of each."""
    arrays = {name: getattr(splats, name).copy() for name in (*ATTRIBUTES, "sh")}
    edited = set()
    for _ in range(edits if len(splats) else 0):
        name = rng.choice(sorted(arrays))
        values = arrays[name].reshape(len(splats), math.prod(arrays[name].shape[1:]))
        row, column = int(rng.integers(values.shape[0])), int(rng.integers(values.shape[1]))
        values[row, column] = rng.uniform(0.01, 0.99)
        edited.add((row, str(name), column))
    return replace(splats, **arrays), edited


def _split(made: Made, body: bytes, count: int) -> list[list[bytes]]:
    """The values of the rows at the start of `body`, cut out by position."""
    if made.order == "=":
        return [_words(line) for line in body.split(made.newline.encode())[:count]]
    cuts = np.cumsum([0, *(int(CODES[kind][1]) for _, kind in made.properties)])
    starts = cuts[-1] * np.arange(count)
    return [[body[start + a : start + b] for a, b in zip(cuts[:-1], cuts[1:], strict=True)] for start in starts]


def _words(line: bytes) -> list[bytes]:
    """A text line cut so that blanks stay with the word behind them."""
    words, current = [], b""
    for k in range(len(line)):
        letter = line[k : k + 1]
        if letter in b" \t" and current.strip():
            words.append(current)
            current = b""
        current += letter
    return [*words, current]


def _number(order: str, kind: str, value: bytes) -> float:
    return float(value) if order == "=" else float(np.frombuffer(value, order + CODES[kind])[0])


def _raw(attribute: str, value: float) -> float:
    if attribute == "scales":
        return math.log(value)
    return math.log(value / (1 - value)) if attribute == "opacities" else value


@given(files(), st.integers(0, 4))
@SMALL
def test_another_sh_degree(made: Made, degree: int) -> None:
    """Only the f_rest_* are made anew: shared coefficients keep their values, everything else keeps its bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder, "a.ply"), Path(folder, "b.ply")
        path.write_bytes(made.data(made.rows))
        source = io.read(path)
        sh = np.zeros((len(source), (degree + 1) ** 2, 3), np.float32)
        shared = min(sh.shape[1], source.sh.shape[1])
        sh[:, :shared] = source.sh[:, :shared]
        io.write(out, replace(source, sh=sh))
        np.testing.assert_array_equal(io.read(out).sh, sh)
        result = out.read_bytes()
    if degree == made.degree:
        return
    end = made.newline + "end_header" + made.newline
    cut = result.index(end.encode()) + len(end)
    lines = [line.split() for line in result[:cut].decode().splitlines()]
    start = lines.index(["element", "vertex", str(len(made.rows))]) + 1
    properties = [(w[2], w[1]) for w in lines[start : start + len(made.properties) + 75] if w[0] == "property"]
    properties = properties[: len(properties) - (["element", "late", "1"] in lines)]
    remaining = [p for p in made.properties if not p[0].startswith("f_rest_")]
    assert [p for p in properties if not p[0].startswith("f_rest_")] == remaining
    assert len(properties) - len(remaining) == 3 * (degree + 1) ** 2 - 3
    body = result[cut:]
    assert body.startswith(made.before) and body.endswith(made.after)
    rows = _split(replace(made, properties=properties), body[len(made.before) :], len(made.rows))
    for before, after in zip(made.rows, rows, strict=True):
        for name, kind in remaining:
            old, new = before[made.properties.index((name, kind))], after[properties.index((name, kind))]
            assert (old.strip() == new.strip()) if made.order == "=" else (old == new)


@pytest.mark.parametrize("rows", [list(range(30)), list(range(10, 40)), [5, 4, *range(20, 35)], list(range(40))])
def test_rows_of_many_blocks(rows: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is written block by block is what the bytes of each row say."""
    monkeypatch.setattr(ply_files, "BLOCK_ROWS", 7)
    path, out = tmp_path / "a.ply", tmp_path / "b.ply"
    io.write(path, random_splats(40, 1))
    splats = io.read(path).take(np.array(rows))
    sh, opacities = splats.sh.copy(), splats.opacities.copy()
    sh[3, 0, 1], opacities[9] = 0.25, 0.5
    io.write(out, replace(splats, sh=sh, opacities=opacities))
    body, names = path.read_bytes().split(b"end_header\n", 1)[1], [*"xyz", "nx", "ny", "nz"]
    table = np.frombuffer(body, "<f4").reshape(40, -1)[rows].copy()
    names += [f"f_dc_{k}" for k in range(3)] + [f"f_rest_{k}" for k in range(9)] + ["opacity"]
    table[3, names.index("f_dc_1")], table[9, names.index("opacity")] = 0.25, 0.0
    assert out.read_bytes().split(b"end_header\n", 1)[1] == table.tobytes()
