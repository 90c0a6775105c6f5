"""SPZ: bytes built by hand, the reference implementation and splat-transform as oracles, unchanged rows, damage."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import zstandard

from splatpainter import io
from splatpainter.io.formats import spz
from splatpainter.io.formats.spz import SpzFile, read_spz, write_spz
from splatpainter.splats import Axes, Splats
from splatpainter.transforms import sh_basis
from tests.support.io_assets import disagreement, float_columns, random_splats
from tests.support.io_packed import alone, covariances, damages, quats_apart, same_bits, survives

if TYPE_CHECKING:
    from tests.support.node_oracle import SplatTransform

pytest_plugins = ["tests.support.node_oracle"]

FILES = {"biker.v4": (152746, 0, 4), "massa.v2": (58649, 0, 2), "playbot_lod3.v2": (31000, 2, 2)}
FILES["playbot_lod3.v3"] = (31000, 2, 3)
MADE_AS: Axes = "rub"
"""Axes of these files, which splat-transform 2 made; they do not say."""
STEPS = {"quats": 0.5 * np.sqrt(0.5) / 511, "scales": 1 / 32, "opacities": 1 / 510, "base": 1 / (510 * 0.15)}
"""Half of a quantisation step of each attribute (log-scales; quaternions from version 3)."""


def detail(splats: Splats) -> SpzFile:
    assert splats.source is not None
    return splats.source.detail


# Two rows by hand, in the axes of PLY files. Rotations: no turn; half a turn about y.
FIXED = ((4096, -8192, 1), (-1, 0, 8388607))  # 24-bit positions with 12 fractional bits
POSITIONS = b"".join((v & 0xFFFFFF).to_bytes(3, "little") for row in FIXED for v in row)
REST = bytes(range(100, 109)) + bytes([128] * 9)
ALPHAS, COLORS, SCALES = bytes([255, 51]), bytes([0, 128, 255, 10, 20, 30]), bytes([160, 144, 176, 0, 255, 96])
FIRST_THREE = bytes([128, 128, 128, 128, 255, 128])  # x y z as b / 127.5 - 1
SMALLEST_THREE = struct.pack("<II", 3 << 30, 1 << 30)  # index of the largest of x y z w on top, the others 0
EXTENSIONS = struct.pack("<IIf", 0x12340001, 4, 1.5) + struct.pack("<III", 0xADBE0003, 4, 6)
"""One record that nobody knows, then the coordinate system of PLY files."""


def head(version: int, flags: int = 0, rows: int = 2, degree: int = 1) -> bytes:
    return b"NGSP" + struct.pack("<IIBBBB", version, rows, degree, 12, flags, 0)


def plain(streams: list[bytes], flags: int = 0, rows: int = 2, degree: int = 1, extensions: bytes = b"") -> bytes:
    packed = [zstandard.ZstdCompressor().compress(stream) for stream in streams]
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
    top = b"NGSP" + struct.pack("<IIBBBBI", 4, rows, degree, 12, flags, len(streams), 32 + len(extensions))
    return top + bytes(12) + extensions + table + b"".join(packed)


def by_hand(version: int) -> bytes:
    rotations = FIRST_THREE if version < 3 else SMALLEST_THREE
    positions = np.array([[1, -2, 0.5], [0, 0.25, 65504]], "<f2").tobytes() if version == 1 else POSITIONS
    streams = [positions, ALPHAS, COLORS, SCALES, rotations, REST]
    return plain(streams, flags=1) if version == 4 else gzip.compress(head(version, flags=1) + b"".join(streams))


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_by_hand(version: int, tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(by_hand(version))
    splats = io.read(path)
    assert len(splats) == 2 and splats.sh_degree == 1 and splats.antialiased and splats.color_space == "srgb"
    expected = np.array(FIXED) / 4096 if version > 1 else np.array([[1, -2, 0.5], [0, 0.25, 65504]])
    assert np.array_equal(splats.means, expected.astype(np.float32))
    turned = io.read(path, axes="rub")  # y and z reversed: y up, z back
    assert np.array_equal(turned.means, (expected * (1, -1, -1)).astype(np.float32))
    assert np.array_equal(splats.opacities, np.array([1, 0.2], np.float32))
    assert np.allclose(np.log(splats.scales), np.array([[0, -1, 1], [-10, 5.9375, -4]]), atol=1e-6)
    assert np.allclose(splats.sh[0, 0], [-0.5 / 0.15, (128 / 255 - 0.5) / 0.15, 0.5 / 0.15], atol=1e-6)
    small = 128 / 127.5 - 1 if version < 3 else 0
    assert np.allclose(splats.quats, [[1, small, small, small], [small, small, 1, small]], atol=0.005)
    assert np.allclose(turned.quats, [[1, small, -small, -small], [small, small, -1, -small]], atol=0.005)
    # Degree 1 is -y, z, -x: the first two change sign with y and z.
    stored = (np.arange(100, 109).reshape(3, 3) - 128) / 128
    assert np.array_equal(splats.sh[0, 1:], stored.astype(np.float32))
    assert np.array_equal(turned.sh[0, 1:], (stored * [[-1], [-1], [1]]).astype(np.float32))
    assert not splats.sh[1, 1:].any()
    write_spz(tmp_path / "b.spz", splats)
    assert (tmp_path / "b.spz").read_bytes() == path.read_bytes()
    edited = replace(splats, opacities=np.array([1, 0.4], np.float32))
    write_spz(tmp_path / "b.spz", edited)
    back = read_spz(tmp_path / "b.spz")
    assert detail(back).version == version and same_bits(back, edited, slice(0, 1))
    assert back.opacities[1] == np.float32(102 / 255) and np.array_equal(back.means[1], splats.means[1])


@pytest.mark.parametrize("version", [3, 4])
def test_extensions_and_tail_are_kept(version: int, tmp_path: Path) -> None:
    """The named coordinate system is obeyed, the unknown record and trailing bytes are written again."""
    path, streams = tmp_path / "a.spz", [POSITIONS, ALPHAS, COLORS, SCALES, SMALLEST_THREE, REST]
    if version == 4:
        path.write_bytes(plain(streams, flags=2, extensions=EXTENSIONS) + b"tail")
    else:
        path.write_bytes(gzip.compress(head(3, flags=2) + b"".join(streams) + EXTENSIONS) + b"tail")
    splats = read_spz(path)
    assert np.array_equal(splats.means, (np.array(FIXED) / 4096).astype(np.float32))  # PLY's own axes: not turned
    write_spz(tmp_path / "b.spz", replace(splats, sh=splats.sh * np.float32(0.5)))
    data, back = (tmp_path / "b.spz").read_bytes(), read_spz(tmp_path / "b.spz")
    assert data.endswith(b"tail") and detail(back).extensions == EXTENSIONS and detail(back).flags == 2
    assert np.array_equal(back.means, splats.means)
    if version == 4:
        assert data[32 : 32 + len(EXTENSIONS)] == EXTENSIONS


def test_every_coordinate_system(tmp_path: Path, spz_reference: Callable[[list[Path]], list[Splats]]) -> None:
    """All 16 named frames, beside the reference implementation; and words survive an edit in each."""
    rng = np.random.default_rng(0)
    rows, degree = 40, 4
    widths = (9, 1, 3, 3, 4, 72)
    streams = [rng.integers(0, 256, rows * width, np.uint8) for width in widths]
    streams[4].reshape(-1, 4)[:, 1] = streams[4].reshape(-1, 4)[:, 0] = 0  # keeps three 10-bit parts in a unit sphere
    streams = [stream.tobytes() for stream in streams]
    paths = []
    for code in range(1, 17):
        extension = struct.pack("<III", 0xADBE0003, 4, code)
        paths.append(tmp_path / f"{code}.spz")
        paths[-1].write_bytes(plain(streams, flags=2, rows=rows, degree=degree, extensions=extension))
    directions = rng.normal(size=(30, 3))
    basis = sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True), degree)
    for path, truth in zip(paths, spz_reference(paths), strict=True):
        splats = read_spz(path)
        assert np.abs(splats.means - truth.means).max() == 0
        ours, theirs = covariances(splats), covariances(truth)
        assert np.abs(ours - theirs).max() <= 1e-6 * np.abs(theirs).max()
        assert np.abs(basis @ splats.sh - basis @ truth.sh).max() < 1e-4, path.stem
        write_spz(tmp_path / "b.spz", replace(splats, opacities=splats.opacities[::-1].copy()))
        back = read_spz(tmp_path / "b.spz")
        assert same_bits(back, replace(splats, opacities=back.opacities))


@pytest.mark.shared
@pytest.mark.parametrize("splat_transform", ["3"], indirect=True, scope="session")  # 2: test_axes.py
@pytest.mark.parametrize("name", FILES)
def test_real_files(name: str, shared: Path, tmp_path: Path, splat_transform: SplatTransform) -> None:
    path = shared / "data" / "splats" / f"{name}.spz"
    splats = io.read(path, axes=splat_transform.spz_axes)
    assert splats.source is not None and not splats.source.problems
    assert (len(splats), splats.sh_degree, detail(splats).version) == FILES[name]
    splat_transform(path, tmp_path / "oracle.ply")
    difference = disagreement(splats, float_columns(tmp_path / "oracle.ply"))
    # Its quaternions of version 2 have w from float32 sums; w near 0 magnifies that.
    close = {"means": 0, "quats": 5e-4, "scales": 1e-6, "opacities": 1e-5, "base": 1e-6, "rest": 0}
    assert all(difference[key] <= close[key] for key in difference), difference
    write_spz(tmp_path / "same.spz", splats)
    assert (tmp_path / "same.spz").read_bytes() == path.read_bytes()


@pytest.mark.shared
@pytest.mark.parametrize(
    ("packed", "sibling"),
    [
        ("massa.v2.spz", "massa.ply"),
        ("playbot_lod3.v2.spz", "playbot_lod3.ply"),
        ("playbot_lod3.v3.spz", "playbot_lod3.ply"),
    ],
)
def test_siblings(packed: str, sibling: str, shared: Path) -> None:
    """The same asset as PLY: the axes, the signs of SH bands, and every value within the quantisation."""
    folder = shared / "data" / "splats"
    splats, truth = io.read(folder / packed, axes=MADE_AS), io.read(folder / sibling)
    assert np.abs(splats.means - truth.means).max() <= 0.5 / 4096 + 1e-6
    assert np.abs(splats.opacities - truth.opacities).max() <= STEPS["opacities"] + 1e-6
    inside = np.clip(truth.sh[:, 0], -0.5 / 0.15, 0.5 / 0.15)  # some of playbot's colours are far beyond
    assert np.abs(splats.sh[:, 0] - inside).max() <= STEPS["base"] + 1e-5
    logs = np.maximum(np.log(truth.scales), -10)
    assert np.abs(np.log(splats.scales) - logs).max() <= STEPS["scales"] + 1e-5
    # In version 2, w comes from three bytes; near w = 0 their half steps become sqrt(3 / 127.5 * 0.87).
    assert quats_apart(splats.quats, truth.quats) <= (STEPS["quats"] * 3 if "v3" in packed else 0.15)
    if truth.sh_degree:
        coarse = packed == "playbot_lod3.v3.spz"  # written with 5 and 4 bits
        bound = np.where(np.arange(8) < 3, 4 / 128, 8 / 128)[:, None] + 0.5 / 128 if coarse else 0.5 / 128
        inside = np.clip(truth.sh[:, 1:], -1, 1)
        bound = np.where(np.abs(inside) > 127 / 128, 1 / 128, 0) + bound  # bytes reach -1, but only 127/128
        assert (np.abs(splats.sh[:, 1:] - inside) <= bound + 1e-6).all()


@pytest.mark.shared
def test_biker(shared: Path) -> None:
    """Version 4 beside PlayCanvas' own compressed PLY of the same asset; the orders differ, so rows match by place."""
    from scipy.spatial import KDTree

    folder = shared / "data" / "splats"
    packed, other = io.read(folder / "biker.v4.spz", axes=MADE_AS), io.read(folder / "biker.compressed.ply")
    distance, match = KDTree(other.means).query(packed.means)
    assert distance.max() < 4e-4
    clear = np.abs(packed.sh[:, 0] - other.sh[match, 0]).max(1) < 0.03  # some places hold more than one row
    assert clear.mean() > 0.99
    assert np.median(np.abs(packed.opacities - other.opacities[match])) < 2 / 255
    a, b = covariances(packed)[clear], covariances(other)[match][clear]
    size = np.abs(b).max((1, 2))
    assert np.median(np.abs(a - b).max((1, 2)) / size) < 0.1


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_we_write(version: int, degree: int, tmp_path: Path, splat_transform: SplatTransform) -> None:
    path, splats = tmp_path / "a.spz", replace(random_splats(500, degree), antialiased=True)
    write_spz(path, splats, version, splat_transform.spz_axes)
    splat_transform(path, tmp_path / "oracle.ply")
    table = float_columns(tmp_path / "oracle.ply")
    back = read_spz(path)
    assert detail(back).version == version and back.antialiased
    difference = disagreement(back, table)
    assert difference["means"] == difference["rest"] == 0 and max(difference.values()) < 5e-4, difference
    difference = disagreement(splats, table)
    bits = detail(back).fractional_bits
    assert bits >= 12 and difference["means"] <= 0.5 / 2**bits + 1e-6
    assert all(difference[key] <= STEPS[key] + 1e-5 for key in ("scales", "opacities", "base")), difference
    assert difference["rest"] <= 1 / 128 + 1e-6 and difference["quats"] <= (
        0.15 if version == 2 else STEPS["quats"] * 3
    )


def test_degree_4_beside_the_reference(tmp_path: Path, spz_reference: Callable[[list[Path]], list[Splats]]) -> None:
    """Band 4 needs version 4; splat-transform stops at band 3, the reference reads it."""
    splats = random_splats(300, 4)
    write_spz(tmp_path / "a.spz", splats, axes="rub")  # the reference takes it so, marked or not
    (truth,) = spz_reference([tmp_path / "a.spz"])
    back = read_spz(tmp_path / "a.spz")
    assert detail(back).version == 4
    assert np.array_equal(back.means, truth.means) and np.array_equal(back.sh[:, 1:], truth.sh[:, 1:])
    assert np.allclose(back.sh[:, 0], truth.sh[:, 0], atol=1e-6)
    assert np.abs(back.sh[:, 1:] - splats.sh[:, 1:]).max() <= 1 / 128 + 1e-6
    assert quats_apart(back.quats, truth.quats) < 1e-6 and np.allclose(back.scales, truth.scales, rtol=1e-5)
    with pytest.raises(ValueError, match="SH up to degree 3, got 4; use version 4"):
        write_spz(tmp_path / "a.spz", splats, 3)


@pytest.mark.shared
@pytest.mark.parametrize("name", FILES)
def test_unchanged_rows(name: str, shared: Path, tmp_path: Path) -> None:
    """Repaint some rows, append children, remove others: every row that did not change has the packed words it had."""
    splats = read_spz(shared / "data" / "splats" / f"{name}.spz")
    rng = np.random.default_rng(1)
    touched = rng.random(len(splats)) < 0.1
    sh = splats.sh.copy()
    sh[touched, 0] = rng.uniform(-1.7, 1.7, (int(touched.sum()), 3))
    children = splats.take(np.flatnonzero(touched)[:500])
    children = replace(children, scales=children.scales * np.float32(0.5), means=children.means + children.scales)
    edited = replace(splats, sh=sh).append(children)
    write_spz(tmp_path / "a.spz", edited)
    back = read_spz(tmp_path / "a.spz")
    assert same_bits(back, splats.append(children), np.flatnonzero(~touched))
    for key, words in detail(back).streams.items():
        rows = slice(0, len(splats)) if key != "colors" else np.flatnonzero(~touched)
        assert np.array_equal(words[rows], detail(splats).streams[key][rows]), key
    assert np.abs(back.sh[: len(splats), 0] - sh[:, 0]).max() <= STEPS["base"] + 1e-5
    order = np.flatnonzero(rng.random(len(splats)) < 0.5)[::-1]
    write_spz(tmp_path / "a.spz", splats.take(order))
    assert same_bits(read_spz(tmp_path / "a.spz"), splats.take(order))


def test_other_degrees(tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", random_splats(30, 1))
    splats = read_spz(tmp_path / "a.spz")
    for degree in (0, 3, 4):
        sh = np.zeros((30, (degree + 1) ** 2, 3), np.float32)
        sh[:, :4] = splats.sh[:, : sh.shape[1]]
        write_spz(tmp_path / "b.spz", replace(splats, sh=sh))
        back = read_spz(tmp_path / "b.spz")
        assert same_bits(replace(back, sh=sh), replace(splats, sh=sh)) and np.array_equal(back.sh, sh)
        assert detail(back).version == (4 if degree == 4 else 3)


def test_version_2_and_3_share_words(tmp_path: Path) -> None:
    """Asked for another version, rows still keep the words that both have."""
    write_spz(tmp_path / "a.spz", random_splats(200, 2), 2)
    splats = read_spz(tmp_path / "a.spz")
    write_spz(tmp_path / "b.spz", splats, 4)
    back = read_spz(tmp_path / "b.spz")
    assert same_bits(replace(back, quats=splats.quats), splats)
    assert quats_apart(back.quats, splats.quats) <= STEPS["quats"] * 3


def test_rows_that_cannot_be_drawn(tmp_path: Path) -> None:
    """NaN has no word in SPZ: such rows stay, finite and transparent, and disturb no other row."""
    splats = random_splats(50, 1)
    splats.means[3], splats.scales[4, 1], splats.quats[5], splats.sh[6] = np.nan, 0, 0, np.inf
    write_spz(tmp_path / "a.spz", splats)
    back = read_spz(tmp_path / "a.spz")
    assert back.drawable.all() and not back.opacities[3:7].any() and back.opacities[[2, 7]].all()
    rest = np.delete(np.arange(50), [3, 4, 5, 6])
    assert np.abs(back.means - splats.means)[rest].max() < 1e-3


def test_far_rows(tmp_path: Path) -> None:
    """Large scenes get fewer fractional bits; what no choice of bits can hold is refused in one line."""
    splats = random_splats(20, 0)
    wide = replace(splats, means=splats.means * np.float32(1e5))
    write_spz(tmp_path / "a.spz", wide)
    back = read_spz(tmp_path / "a.spz")
    step = 2.0 ** -detail(back).fractional_bits
    assert np.abs(back.means - wide.means).max() <= 0.51 * step and step < 0.1
    with pytest.raises(ValueError, match=r"row \d+ at .* lies outside .* write .ply instead"):
        write_spz(tmp_path / "b.spz", replace(splats, means=splats.means * np.float32(1e8)))
    moved = replace(back, means=back.means + np.array([1e7, 0, 0], np.float32))
    with pytest.raises(ValueError, match="lies outside"):
        write_spz(tmp_path / "a.spz", moved)
    assert same_bits(read_spz(tmp_path / "a.spz"), alone(back))  # the old file is still there


def test_no_rows(tmp_path: Path) -> None:
    for version in (2, 3, 4):
        write_spz(tmp_path / "a.spz", random_splats(0, 1), version)
        back = read_spz(tmp_path / "a.spz")
        assert len(back) == 0 and back.sh.shape[1] == 4


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_damaged(version: int, tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    if version == 1:
        path.write_bytes(by_hand(1))
    else:
        write_spz(path, random_splats(40, 2), version)
    data = path.read_bytes()
    good, bad = survives(read_spz, path, damages(data, 100, seed=version))
    assert bad > 64 and good + bad == 164
    if version < 4:  # damage inside the compressed stream, past its checksum
        inside = (gzip.compress(piece, 1) for piece in damages(gzip.decompress(data), 100, head=20))
        assert sum(survives(read_spz, path, inside)) == 164


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not an SPZ file"),
        (b"NGSP", "truncated"),
        (b"NGSP" + struct.pack("<IIBBBB", 3, 1, 0, 12, 0, 0) + bytes(40), "unpacked on its way here"),
        (gzip.compress(b"NGSP"), "the gzip stream holds 4"),
        (gzip.compress(b"PGSN" + bytes(12)), "expected 'NGSP' inside the gzip stream"),
        (gzip.compress(head(5) + bytes(100)), "expected SPZ version 1-3 in a gzip stream, found 5"),
        (gzip.compress(head(2, degree=5) + bytes(100)), "expected SH degree 0-4, found 5"),
        (gzip.compress(head(2, rows=1 << 31) + bytes(100)), "2147483648 rows would take"),
        (gzip.compress(head(2, rows=100) + bytes(1000)), "truncated: 100 rows of SPZ version 2"),
        (gzip.compress(head(2, rows=0) + bytes(17 << 20), 1), "more than 16777216 bytes follow"),
        (b"NGSP" + struct.pack("<IIBBBBI", 4, 1 << 30, 0, 12, 0, 5, 32) + bytes(200), "table says 0"),
        (plain([POSITIONS, ALPHAS], degree=0), "expected 5 streams for SH degree 0, found 2"),
        (plain([POSITIONS, ALPHAS, COLORS, SCALES, SMALLEST_THREE], degree=0)[:-3], "truncated: the streams need"),
    ],
)
def test_refusals(data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(data)
    with pytest.raises(ValueError, match=message):
        read_spz(tmp_path / "a.spz")


def test_bombs(tmp_path: Path) -> None:
    """Rows that truly are there, a thousand to a byte: refused before they are unpacked."""
    rows = 6_000_000
    compressor = zlib.compressobj(9, wbits=31)
    bomb = compressor.compress(head(2, rows=rows, degree=0))
    for _ in range(19 * rows // (1 << 20) + 1):
        bomb += compressor.compress(bytes(1 << 20))
    bomb += compressor.flush()
    assert len(bomb) < 1 << 20
    sizes = [9 * rows, rows, 3 * rows, 3 * rows, 4 * rows]
    frame = zstandard.ZstdCompressor().compress(bytes(1 << 20))
    table = b"".join(struct.pack("<QQ", len(frame), size) for size in sizes)
    lie = b"NGSP" + struct.pack("<IIBBBBI", 4, rows, 0, 12, 0, 5, 32) + bytes(12) + table + 5 * frame
    assert survives(read_spz, tmp_path / "a.spz", iter([bomb, lie]), peak=4 << 20) == (0, 2)


@pytest.mark.parametrize("size", [0, 1, 999, 1000, 1001, 150_000])
def test_pieces_are_one_gzip_member_for_any_number_of_threads(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spz, "GZIP_PIECE_BYTES", 1000)
    body, packed = np.random.default_rng(0).integers(0, 9, size, np.uint8).tobytes(), set()
    for threads in ("1", "3"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
        packed.add(spz._gzip_member(body))
    (member,) = packed
    reader = zlib.decompressobj(wbits=31)
    assert reader.decompress(member) + reader.flush() == body == gzip.decompress(member)
    assert reader.eof and not reader.unused_data, "one member"


@pytest.mark.parametrize(
    ("scale", "extent", "bits"),
    [
        (0.1, 1, 12),
        (2.0**-11, 1, 13),
        (1.1 * 2.0**-11, 1, 13),
        (0.9 * 2.0**-11, 1, 14),
        (2.0**-16, 1023, 12),
        (2.0**-16, 1025, 11),
    ],
)
def test_positions_have_steps_of_a_quarter_of_small_rows_and_room_for_twice_the_extent(
    tmp_path: Path, scale: float, extent: float, bits: int
) -> None:
    splats = random_splats(50, 0)
    means = np.clip(splats.means, -0.5, 0.5)
    means[0] = extent
    path = tmp_path / "a.spz"
    write_spz(path, replace(splats, means=means, scales=np.full_like(splats.scales, scale), source=None))
    source = read_spz(path).source
    assert source is not None and source.detail.fractional_bits == bits
