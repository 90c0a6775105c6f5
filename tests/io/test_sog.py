"""SOG: a file built by hand, splat-transform as oracle, unchanged rows, room for painted colours, damaged files."""

from __future__ import annotations

import io as python_io
import json
import math
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter import io
from splatpainter.io.formats import sog, sog_container
from splatpainter.io.formats.sog import SogFile, read_sog, write_sog
from splatpainter.receipts import verify
from splatpainter.splats import SH_C0, Splats
from tests.support.io_assets import disagreement, float_columns, random_splats
from tests.support.io_packed import alone, damages, quats_apart, same_bits, survives

pytest_plugins = ["tests.support.node_oracle"]

Oracle = Callable[..., str]
REAL = {"angel.sog": (71359, 0), "massa.sog": (58649, 0), "narcissus.sog": (101275, 0), "playbot_lod3.sog": (31000, 2)}
REAL |= {"st-peter.sog": (133618, 0), "playbot_lod3": (31000, 2), "playbot_lod2": (125000, 2)}


def detail(splats: Splats) -> SogFile:
    assert splats.source is not None
    return splats.source.detail


def image(pixels: list[Any] | np.ndarray, width: int, kind: str = "WEBP") -> bytes:
    rows = np.array(pixels, np.uint8).reshape(-1, width, 4)
    out = python_io.BytesIO()
    Image.fromarray(rows).save(out, kind, **({"lossless": True, "exact": True} if kind == "WEBP" else {}))
    return out.getvalue()


def by_hand(kind: str = "WEBP") -> dict[str, bytes]:
    """Three rows in planes of 2 x 2, SH degree 1, a palette of two entries; codebooks are easy to follow."""
    scales, colors, bands = (
        [k / 16 - 12 for k in range(256)],
        [k / 64 - 2 for k in range(256)],
        [k / 100 for k in range(256)],
    )
    palette = np.full((64, 3, 4), [0, 0, 0, 255], np.uint8)
    palette[1] = [[1, 2, 3, 255], [4, 5, 6, 255], [7, 8, 9, 255]]
    meta = {
        "version": 2,
        "asset": {"generator": "by hand"},
        "count": 3,
        "means": {"mins": [-1, 0, -2], "maxs": [1, 2, 2], "files": ["lo.x", "hi.x"]},
        "scales": {"codebook": scales, "files": ["scales.x"]},
        "quats": {"files": ["quats.x"]},
        "sh0": {"codebook": colors, "files": ["sh0.x"]},
        "shN": {"count": 2, "bands": 1, "codebook": bands, "files": ["palette.x", "labels.x"]},
        "note": "kept",
    }
    end = [9, 9, 9, 9]  # beyond the last row: means nothing
    return {
        "meta.json": json.dumps(meta).encode(),
        "lo.x": image([[255, 0, 0, 255], [0, 0, 255, 255], [1, 2, 3, 255], end], 2, kind),
        "hi.x": image([[255, 0, 128, 255], [0, 0, 255, 255], [4, 5, 6, 255], end], 2, kind),
        "quats.x": image([[128, 128, 128, 252], [255, 0, 0, 255], [200, 100, 50, 251], end], 2, kind),
        "scales.x": image([[192, 176, 160, 255], [0, 255, 1, 255], [5, 6, 7, 255], end], 2, kind),
        "sh0.x": image([[128, 64, 192, 255], [0, 1, 255, 51], [9, 8, 7, 0], end], 2, kind),
        "palette.x": image(palette, 192, kind),
        "labels.x": image([[1, 0, 0, 255], [0, 0, 0, 255], [0, 1, 0, 255], end], 2, kind),
    }


def bundle(path: Path, files: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize("layout", ["stored", "deflated", "folder", "png"])
def test_by_hand(layout: str, tmp_path: Path) -> None:
    files = by_hand("PNG" if layout == "png" else "WEBP")
    path = tmp_path / "a.sog"
    if layout == "folder":
        path = tmp_path / "folder"
        path.mkdir()
        for name, data in files.items():
            (path / name).write_bytes(data)
    else:
        bundle(path, files | {"docs/readme.txt": b"hello"}, 8 if layout == "deflated" else 0)
    splats = io.read(path)
    assert len(splats) == 3 and splats.sh_degree == 1 and splats.source is not None

    def decoded(low: float, high: float, word: int) -> float:
        v = low + (high - low) * word / 65535
        return math.copysign(math.exp(abs(v)) - 1, v)

    words = [[65535, 0, 32768], [0, 0, 65535], [1025, 1282, 1539]]
    ranges = [(-1, 1), (0, 2), (-2, 2)]
    expected = [[decoded(*ranges[a], row[a]) for a in range(3)] for row in words]
    assert np.allclose(splats.means, expected, rtol=1e-6, atol=1e-7)
    small, root = (128 / 255 * 2 - 1) / math.sqrt(2), 1 / math.sqrt(2)
    assert np.allclose(splats.quats[0], [math.sqrt(1 - 3 * small**2), small, small, small], atol=1e-6)
    assert np.allclose(splats.quats[1], [root, -root, -root, 0], atol=1e-6)  # the sum of squares leaves nothing for z
    assert splats.quats[2].tolist() == [1, 0, 0, 0]
    logs = [[0, -1, -2], [-12, 3.9375, -11.9375], [5 / 16 - 12, 6 / 16 - 12, 7 / 16 - 12]]
    assert np.allclose(np.log(splats.scales), logs, atol=1e-5)
    assert np.allclose(splats.sh[:2, 0], [[0, -1, 1], [-2, 1 / 64 - 2, 255 / 64 - 2]])
    assert np.array_equal(splats.opacities, np.array([1, 0.2, 0], np.float32))
    assert np.allclose(splats.sh[0, 1:], np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]]) / 100)
    assert not splats.sh[1:, 1:].any()
    assert splats.source.problems == (
        "rows without a valid rotation, not turned: 1",
        "rows that name a missing SH palette entry, bands set to 0: 1",
    )
    target = tmp_path / "b.sog"
    sh = splats.sh.copy()
    sh[0, 0] = 0.5
    write_sog(target, replace(splats, sh=sh))
    back = read_sog(target)
    assert np.array_equal(back.sh, sh) and same_bits(replace(back, sh=sh), replace(splats, sh=sh))
    assert detail(back).meta["note"] == "kept"
    members = detail(back).container.files
    assert all(members[name] == files[name] for name in files if name not in ("meta.json", "sh0.x"))
    assert layout == "folder" or members["docs/readme.txt"] == b"hello"


@pytest.mark.shared
@pytest.mark.parametrize("splat_transform", ["3"], indirect=True, scope="session")  # 2: what we write
@pytest.mark.parametrize("name", REAL)
def test_real_files(name: str, shared: Path, tmp_path: Path, splat_transform: Oracle) -> None:
    path = shared / "data" / "splats" / name
    splats = io.read(path)
    assert splats.source is not None and not splats.source.problems
    assert (len(splats), splats.sh_degree) == REAL[name]
    splat_transform(path / "meta.json" if path.is_dir() else path, tmp_path / "oracle.ply")
    difference = disagreement(splats, float_columns(tmp_path / "oracle.ply"))
    # Both decode in float64 and round once.
    close = {"means": 1e-6, "quats": 1e-6, "scales": 2e-6, "opacities": 2e-6, "base": 0, "rest": 0}
    assert all(difference[key] <= close[key] for key in difference), difference
    write_sog(tmp_path / ("meta.json" if path.is_dir() else "same.sog"), splats)
    if path.is_dir():
        assert all((tmp_path / file.name).read_bytes() == file.read_bytes() for file in path.iterdir())
    else:
        assert (tmp_path / "same.sog").read_bytes() == path.read_bytes()


@pytest.mark.shared
@pytest.mark.parametrize("name", ["massa", "playbot_lod3"])
def test_siblings(name: str, shared: Path) -> None:
    """The PLY files were made from these: the same rows in the same frame."""
    splats, truth = (io.read(shared / "data" / "splats" / f"{name}.{kind}") for kind in ("sog", "ply"))
    assert np.allclose(splats.means, truth.means, atol=1e-6) and np.allclose(splats.sh, truth.sh, atol=1e-6)
    assert np.allclose(splats.scales, truth.scales, rtol=1e-5) and quats_apart(splats.quats, truth.quats) < 1e-6
    assert np.allclose(splats.opacities, truth.opacities, atol=2e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("name", ["a.sog", "folder/meta.json"])
def test_what_we_write(name: str, degree: int, tmp_path: Path, splat_transform: Oracle) -> None:
    path, splats = tmp_path / name, random_splats(3000, degree)
    io.write(path, splats)
    back = io.read(path)
    splat_transform(path, tmp_path / "oracle.ply")
    table = float_columns(tmp_path / "oracle.ply")
    difference = disagreement(back, table)
    assert max(difference.values()) < 3e-6, difference
    difference = disagreement(splats, table)
    extent = np.log1p(np.abs(splats.means)).max() * 2 / 65535 * (1 + np.abs(splats.means).max())
    assert difference["means"] <= extent / 2 and difference["quats"] <= 1.5 / 255 * math.sqrt(2), difference
    assert difference["opacities"] <= 0.5 / 255 + 1e-6 and difference["base"] < 0.01 and difference["scales"] < 0.12, (
        difference
    )
    if degree:
        wrong = back.sh[:, 1:] - splats.sh[:, 1:]
        # 3,000 different vectors in 2,048 entries: noise, the worst case.
        assert back.source is not None and 1024 < len(back.source.detail.palette) <= 2048
        assert math.sqrt((wrong**2).mean()) < 0.5 * splats.sh[:, 1:].std()


@pytest.mark.shared
def test_as_good_as_its_encoder(shared: Path, tmp_path: Path, splat_transform: Oracle) -> None:
    """The same rows through splat-transform's encoder (which sorts them) and ours: errors of the same size."""
    from scipy.spatial import KDTree

    rows = alone(read_sog(shared / "data" / "splats" / "playbot_lod3.sog")).take(np.arange(0, 31000, 62))
    rng = np.random.default_rng(0)
    blurred = {name: getattr(rows, name) for name in ("scales", "sh")}
    blurred["scales"] = blurred["scales"] * np.exp(rng.normal(0, 0.05, rows.scales.shape)).astype(np.float32)
    blurred["sh"] = blurred["sh"] + rng.normal(0, 0.02, rows.sh.shape).astype(np.float32)
    rows = replace(rows, **blurred)
    io.write(tmp_path / "a.ply", rows)
    write_sog(tmp_path / "ours.sog", rows)
    splat_transform("-g", "cpu", "-i", 10, "--max-workers", 0, tmp_path / "a.ply", tmp_path / "theirs.sog")
    ours, theirs = read_sog(tmp_path / "ours.sog"), read_sog(tmp_path / "theirs.sog")
    _, match = KDTree(rows.means).query(theirs.means)
    assert len(np.unique(match)) == len(rows)

    def rms(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.sqrt(((a.astype(np.float64) - b) ** 2).mean()))

    assert rms(ours.sh[:, 1:], rows.sh[:, 1:]) < 1.1 * rms(theirs.sh[:, 1:], rows.sh[match, 1:])
    assert rms(ours.sh[:, 0], rows.sh[:, 0]) < 1.1 * rms(theirs.sh[:, 0], rows.sh[match, 0])
    logs = np.log(rows.scales)
    assert rms(np.log(ours.scales), logs) < 1.1 * rms(np.log(theirs.scales), logs[match])
    assert rms(ours.means, rows.means) <= rms(theirs.means, rows.means[match])
    assert quats_apart(ours.quats, rows.quats) <= quats_apart(theirs.quats, rows.quats[match])


@pytest.mark.shared
@pytest.mark.parametrize("name", ["playbot_lod3.sog", "massa.sog"])
def test_painting_keeps_the_other_rows(name: str, shared: Path, tmp_path: Path) -> None:
    """Any colours of the display range, halved bands, opacity edits, split rows: the rest decodes to the same bits."""
    splats, rng = read_sog(shared / "data" / "splats" / name), np.random.default_rng(0)
    touched = rng.random(len(splats)) < 0.1
    sh, opacities = splats.sh.copy(), splats.opacities.copy()
    sh[touched, 0] = (rng.random((int(touched.sum()), 3)) - 0.5) / SH_C0
    sh[touched, 1:] *= np.float32(0.5)
    opacities[touched] = 0.3
    children = splats.take(np.flatnonzero(touched)[:400])
    children = replace(children, scales=children.scales * np.float32(0.5), means=children.means + children.scales)
    edited = replace(splats, sh=sh, opacities=opacities).append(children)
    write_sog(tmp_path / "a.sog", edited)
    back = read_sog(tmp_path / "a.sog")
    assert same_bits(back, edited, np.flatnonzero(~touched))
    off = SH_C0 * 255 * np.abs(back.sh[:, 0] - edited.sh[:, 0]).max(1)
    assert off.max() <= 4 and np.sqrt((off**2).mean()) < 1
    assert not splats.sh_degree or np.abs(back.sh[:, 1:] - edited.sh[:, 1:]).max() < 0.04
    assert np.abs(back.opacities - edited.opacities).max() <= 0.5 / 255 + 1e-6
    assert np.abs(np.log(back.scales / edited.scales)).max() <= math.log(1.25)
    # Only children of rows on the border of the range may have moved, and then by less than two of their sizes.
    assert (np.abs(back.means - edited.means).max(1) <= 2 * edited.scales.max(1) + 1e-4).all()
    # A plane that holds nothing new is the same file.
    write_sog(tmp_path / "b.sog", replace(splats, opacities=opacities))
    members, before = detail(read_sog(tmp_path / "b.sog")).container.files, detail(splats).container.files
    assert {key for key in before if members[key] != before[key]} <= {"sh0.webp", "meta.json"}
    assert list(members) == list(before)


@pytest.mark.shared
def test_colours_beyond_the_codebook(shared: Path, tmp_path: Path) -> None:
    """massa's codebook is full and ends at the display range: to hold brighter colours, few rows shift by one entry."""
    splats, rng = read_sog(shared / "data" / "splats" / "massa.sog"), np.random.default_rng(0)
    touched = rng.random(len(splats)) < 0.1
    sh = splats.sh.copy()
    sh[touched, 0] = (rng.random((int(touched.sum()), 3)) * 1.4 - 0.7) / SH_C0
    write_sog(tmp_path / "a.sog", replace(splats, sh=sh))
    back = read_sog(tmp_path / "a.sog")
    assert SH_C0 * 255 * np.abs(back.sh[touched] - sh[touched]).max() <= 4.001
    shifted = (back.sh != splats.sh).any((1, 2)) & ~touched
    assert shifted.mean() < 0.1 and SH_C0 * 255 * np.abs(back.sh - splats.sh)[shifted].max() < 1.5
    assert same_bits(replace(back, sh=splats.sh), splats)


def test_full_codebook_of_evenly_used_values(tmp_path: Path) -> None:
    """No room and too much to add: the codebook is fitted anew, colours stay, other planes do not change."""
    rng = np.random.default_rng(0)
    grid = np.repeat(np.linspace(0.45, 0.55, 256), 12).reshape(-1, 3)
    splats = random_splats(len(grid), 0)
    splats.sh[:, 0] = ((grid - 0.5) / SH_C0)[rng.permutation(len(grid))]
    write_sog(tmp_path / "a.sog", splats)
    source = read_sog(tmp_path / "a.sog")
    sh = source.sh.copy()
    sh[:300, 0] = (rng.uniform(-1, 2, (300, 3)) - 0.5) / SH_C0
    write_sog(tmp_path / "b.sog", replace(source, sh=sh))
    back = read_sog(tmp_path / "b.sog")
    assert SH_C0 * 255 * np.abs(back.sh - sh).max() < 6
    assert same_bits(replace(back, sh=source.sh), source)


def test_rows_beyond_the_range(tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", random_splats(500, 0))
    source = read_sog(tmp_path / "a.sog")
    means = source.means.copy()
    means[7] = [50, -60, 70]
    write_sog(tmp_path / "b.sog", replace(source, means=means))
    back = read_sog(tmp_path / "b.sog")
    assert np.abs(back.means[7] - means[7]).max() < 0.02  # 120 units of extent in 65535 logarithmic steps
    assert np.abs(np.delete(back.means - source.means, 7, 0)).max() < 1e-3
    assert same_bits(replace(back, means=source.means), source)


def test_rows_leave_and_move(tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", random_splats(700, 2))
    source = read_sog(tmp_path / "a.sog")
    chosen = np.random.default_rng(0).permutation(700)[:333]
    write_sog(tmp_path / "b.sog", source.take(chosen))
    assert same_bits(read_sog(tmp_path / "b.sog"), source.take(chosen))
    fewer = replace(source, sh=source.sh[:, :4])  # another SH degree: only the bands are encoded anew
    write_sog(tmp_path / "b.sog", fewer)
    back = read_sog(tmp_path / "b.sog")
    assert same_bits(replace(back, sh=fewer.sh), fewer) and np.array_equal(back.sh[:, 0], fewer.sh[:, 0])
    write_sog(tmp_path / "b.sog", replace(source, sh=source.sh[:, :1]))
    assert same_bits(read_sog(tmp_path / "b.sog"), replace(source, sh=source.sh[:, :1]))


def test_many_rows_are_decoded_as_few_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of many rows the words are decoded, not the rows."""
    write_sog(tmp_path / "a.sog", random_splats(300, 1))
    expected = read_sog(tmp_path / "a.sog")
    monkeypatch.setattr(sog, "MIN_ROWS_BY_WORD", 64)
    assert same_bits(read_sog(tmp_path / "a.sog"), expected)


def test_flags(tmp_path: Path) -> None:
    splats = replace(random_splats(20, 0), antialiased=True, color_space="linear")
    write_sog(tmp_path / "a.sog", splats)
    back = read_sog(tmp_path / "a.sog")
    assert back.antialiased and back.color_space == "linear"
    write_sog(tmp_path / "b.sog", replace(back, antialiased=False, color_space="srgb"))
    again = read_sog(tmp_path / "b.sog")
    assert not again.antialiased and again.color_space == "srgb" and same_bits(again, back)
    files = by_hand()
    for change in ({"antialias": True}, {"model": "antialiased"}):
        files["meta.json"] = json.dumps(json.loads(files["meta.json"]) | change).encode()
        assert read_sog(bundle(tmp_path / "c.sog", files)).antialiased


def test_codebook_that_begins_with_null(tmp_path: Path) -> None:
    files = by_hand()
    meta = json.loads(files["meta.json"])
    meta["sh0"]["codebook"][0] = None
    splats = read_sog(bundle(tmp_path / "a.sog", files | {"meta.json": json.dumps(meta).encode()}))
    entry = (1 / 64 - 2) + ((1 / 64 - 2) - (255 / 64 - 2)) / 255
    assert splats.sh[1, 0, 0] == np.float32(entry)


def test_rows_that_cannot_be_drawn(tmp_path: Path) -> None:
    splats = random_splats(50, 1)
    splats.means[3], splats.scales[4, 1], splats.quats[5], splats.sh[6] = np.nan, 0, 0, np.inf
    write_sog(tmp_path / "a.sog", splats)
    back = read_sog(tmp_path / "a.sog")
    rest = np.delete(np.arange(50), [3, 4, 5, 6])
    assert back.drawable.all() and not back.opacities[3:7].any()
    assert np.abs(back.means - splats.means)[rest].max() < 1e-3 and np.abs(back.sh - splats.sh)[rest].max() < 0.01


def zipped(files: dict[str, bytes]) -> bytes:
    out = python_io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return out.getvalue()


@pytest.mark.parametrize("folder", ["scene/", "my scene/export 2/", ""])
@pytest.mark.parametrize("shadows", [False, True])
def test_zipped_by_hand(folder: str, shadows: bool, tmp_path: Path) -> None:
    """A folder of planes zipped by Finder or Explorer, the folder and macOS's shadow files included: opened, said, and
    edited in its own form."""
    io.write(tmp_path / "a.sog", random_splats(200, 1))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        planes = {name: archive.read(name) for name in archive.namelist()}
    files = {f"{folder}{name}": data for name, data in planes.items()}
    if shadows:
        files |= {f"__MACOSX/{folder}._{name}": b"\0\5\x16\7" + bytes(100) for name in planes}
    path = tmp_path / "b.sog"
    path.write_bytes(zipped(files))
    splats, truth = io.read(path), io.read(tmp_path / "a.sog")
    assert same_bits(splats, truth) and splats.source is not None and sog_container.declared_rows(path) == 200
    assert any("lie in its folder" in problem for problem in splats.source.problems) == bool(folder)
    io.write(tmp_path / "c.sog", splats)
    assert (tmp_path / "c.sog").read_bytes() == path.read_bytes()
    edited = replace(splats, opacities=splats.opacities[::-1].copy())
    io.write(tmp_path / "d.sog", edited)
    with zipfile.ZipFile(tmp_path / "d.sog") as archive:
        assert archive.namelist() == list(files)
        shadow = f"__MACOSX/{folder}._meta.json"
        assert not shadows or archive.read(shadow) == files[shadow]
    assert same_bits(replace(io.read(tmp_path / "d.sog"), opacities=splats.opacities), splats)
    (tmp_path / "e").mkdir()
    io.write(tmp_path / "e" / "meta.json", edited)
    assert sorted(file.name for file in (tmp_path / "e").iterdir()) == sorted(planes)
    assert verify(path, tmp_path / "d.sog").ok


@pytest.mark.parametrize("begin", ["./", "scene\\", "scene\\export\\"])
def test_names_as_other_packers_write_them(begin: str, tmp_path: Path) -> None:
    """Backslashes of some programs for Windows, and names that begin in the folder itself."""
    io.write(tmp_path / "a.sog", random_splats(200, 1))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        planes = {f"{begin}{name}": archive.read(name) for name in archive.namelist()}
    (tmp_path / "b.sog").write_bytes(zipped(planes))
    splats = io.read(tmp_path / "b.sog")
    assert same_bits(splats, io.read(tmp_path / "a.sog")) and sog_container.declared_rows(tmp_path / "b.sog") == 200
    io.write(tmp_path / "c.sog", replace(splats, opacities=splats.opacities[::-1].copy()))
    assert len(io.read(tmp_path / "c.sog")) == 200


@pytest.mark.parametrize("begin", ["", "Scene/"])
@pytest.mark.parametrize("capitals", [("META.JSON",), ("META.JSON", "MEANS_L.WEBP", "SH0.WEBP"), ("Quats.webp",)])
def test_capitals_of_other_disks(begin: str, capitals: tuple[str, ...], tmp_path: Path) -> None:
    """FAT and some sync programs change them; meta.json names the planes as they were."""
    io.write(tmp_path / "a.sog", random_splats(200, 1))
    called = {name.lower(): name for name in capitals}
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        planes = {called.get(name, name): archive.read(name) for name in archive.namelist()}
    (tmp_path / "b.sog").write_bytes(zipped({begin + name: data for name, data in planes.items()}))
    (tmp_path / "planes").mkdir()
    for name, data in planes.items():
        (tmp_path / "planes" / name).write_bytes(data)
    expected = io.read(tmp_path / "a.sog")
    for path in (tmp_path / "b.sog", tmp_path / "planes"):
        splats = io.read(path)
        assert same_bits(splats, expected), path
    assert sog_container.declared_rows(tmp_path / "b.sog") == 200
    # Written over, nothing is there twice.
    changed = replace(expected, opacities=expected.opacities[::-1].copy())
    io.write(tmp_path / "planes" / called.get("meta.json", "meta.json"), changed, overwrite=True)
    assert sorted(path.name for path in (tmp_path / "planes").iterdir()) == sorted(planes)
    assert not same_bits(io.read(tmp_path / "planes"), expected)


def test_a_zipped_ply_is_named(tmp_path: Path) -> None:
    (tmp_path / "b.zip").write_bytes(zipped({"scene/point_cloud.ply": b"ply"}))
    with pytest.raises(ValueError, match="unpack it, then open scene/point_cloud.ply"):
        io.read(tmp_path / "b.zip")


@pytest.mark.parametrize("name", ["lod-meta.json", "LOD-meta.json", "lod", "lod.sog", "nested.sog"])
def test_streamed_sog_is_refused_with_the_reason(name: str, tmp_path: Path) -> None:
    record = b'{"lodLevels":3,"filenames":["0_0/meta.json"],"tree":{}}'
    path = tmp_path / name
    if path.suffix == ".json":
        path.write_bytes(record)
    elif path.suffix == ".sog":
        inside = "lod-meta.json" if name == "lod.sog" else "scene/lod-meta.json"
        path.write_bytes(zipped({inside: record, "0_0/meta.json": b"{}"}))
    else:
        path.mkdir()
        (path / "lod-meta.json").write_bytes(record)
    with pytest.raises(ValueError, match=r"a streamed SOG \(.*lod-meta.json.*\) holds one scene in levels") as error:
        io.read(path)
    assert str(error.value).startswith(f"{path}: ") and "open a chunk of it alone" in str(error.value)


def test_two_folders_of_planes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.sog").write_bytes(zipped({"one/meta.json": b"{}", "two/meta.json": b"{}"}))
    with pytest.raises(ValueError, match="expected meta.json in one folder of the bundle, found one/, two/"):
        io.read(tmp_path / "a.sog")


def test_refused_to_write(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="0 rows"):
        write_sog(tmp_path / "a.sog", random_splats(0, 0))
    with pytest.raises(ValueError, match="SH up to degree 3, got 4"):
        write_sog(tmp_path / "a.sog", random_splats(5, 4))
    with pytest.raises(ValueError, match="name ending in .sog"):
        write_sog(tmp_path / "a.zip", random_splats(5, 0))
    assert not any(tmp_path.iterdir())


def change(**changes: Any) -> dict[str, bytes]:
    files = by_hand()
    meta = json.loads(files["meta.json"])
    for key, value in changes.items():
        part, _, field = key.partition("__")
        if field:
            meta[part][field] = value
        else:
            meta[part] = value
    return files | {"meta.json": json.dumps(meta).encode()}


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "expected meta.json in the bundle, found nothing"),
        ({"meta.json": b"{"}, "meta.json is not JSON"),
        ({"meta.json": b"[" * 100000}, "meta.json is nested deeper than 64"),
        ({"meta.json": b"[]"}, "expected an object as meta.json"),
        ({"meta.json": b"{}"}, "expected SOG version 2, found none"),
        (change(count=0), "expected a positive integer for the row count"),
        (change(count=10**12), "expected at least 1000000000000 pixels"),
        (change(count=5), "expected at least 5 pixels, found 2 x 2"),
        (change(means__files=["../lo.x", "hi.x"]), "names '../lo.x' for means; expected a plain file name"),
        (change(means__files=["gone.x", "hi.x"]), "names gone.x, which is not in the bundle"),
        (change(means__mins=[0, 0]), "expected 3 numbers"),
        (change(means__mins=[0, 0, "x"]), "expected finite numbers for means.mins"),
        (change(means__mins=[0, 0, float("inf")]), "meta.json is not JSON \\(Infinity"),
        (change(sh0__codebook=[0, 1]), "a pixel names entry 255 of the sh0 codebook, which has 2"),
        (change(sh0__codebook=[]), "expected 256 entries"),
        (change(shN__bands=2), "a palette of 192 pixels a line does not fit 2 SH bands"),
        (change(shN__count=70000), "does not hold 70000 entries"),
        (change(quats={"files": []}), "expected 1 files for quats"),
        (by_hand() | {"/etc/passwd": b""}, "leaves its folder"),
        (by_hand() | {"a/../../b": b""}, "leaves its folder"),
        (by_hand() | {"lo.x": b"RIFF1234WEBPVP8L"}, "lo.x: truncated image"),
        (by_hand() | {"lo.x": b"GIF89a" + bytes(50)}, "lo.x: expected a WebP or PNG image"),
    ],
)
def test_refusals(files: dict[str, bytes], message: str, tmp_path: Path) -> None:
    assert survives(read_sog, bundle(tmp_path / "a.sog", files), iter([(tmp_path / "a.sog").read_bytes()])) == (0, 1)
    with pytest.raises(ValueError, match=message):
        read_sog(tmp_path / "a.sog")


def test_a_bundle_that_was_cut_off_says_so(tmp_path: Path) -> None:
    path = bundle(tmp_path / "a.sog", by_hand())
    for length in (len(path.read_bytes()) // 2, len(path.read_bytes()) - 1):
        path.write_bytes(path.read_bytes()[:length])
        with pytest.raises(ValueError, match="damaged zip: it is cut off before its directory; get the file again"):
            read_sog(path)


def test_a_plane_of_another_size_is_refused(tmp_path: Path) -> None:
    """Its pixels would be taken for those of other rows."""
    write_sog(tmp_path / "meta.json", random_splats(300, 0))
    low = tmp_path / "means_l.webp"
    with Image.open(low) as image:
        wide = image.convert("RGBA").resize((2 * image.width, image.height))
    wide.save(low, "WEBP", lossless=True, exact=True)
    with pytest.raises(ValueError, match=r"expected planes of one size, found means_l.webp 40 x 16"):
        read_sog(tmp_path / "meta.json")


def huge_webp(width: int, height: int) -> bytes:
    """A header that claims a canvas of any size."""
    extended = b"VP8X" + (10).to_bytes(4, "little") + bytes(4)
    extended += (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return b"RIFF" + (len(extended) + 4).to_bytes(4, "little") + b"WEBP" + extended


def test_bombs(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    zeros = bytes(100 << 20)
    bombs = [
        bundle(path, by_hand() | {"zeros": zeros}, zipfile.ZIP_DEFLATED).read_bytes(),
        bundle(path, by_hand() | {"lo.x": huge_webp(16384, 16384)}).read_bytes(),
        bundle(path, by_hand() | {"palette.x": huge_webp(192, 1 << 24)}).read_bytes(),
        bundle(path, change(count=10**7) | {"lo.x": huge_webp(4000, 4000)}).read_bytes(),
    ]
    del zeros
    assert survives(read_sog, path, iter(bombs), peak=8 << 20) == (0, 4)


def test_damaged(tmp_path: Path) -> None:
    """Anywhere in the bundle; then in one file of it, under a checksum that is right."""
    path = tmp_path / "a.sog"
    write_sog(path, random_splats(30, 1))
    assert sum(survives(read_sog, path, damages(path.read_bytes(), 60))) == 124
    files = detail(read_sog(bundle(path, by_hand()))).container.files

    def inside() -> Iterator[bytes]:
        for seed, name in enumerate(files):
            rounds = 120 if name == "meta.json" else 20
            for data in damages(files[name], rounds, seed, head=60 if name != "meta.json" else 10000, cuts=8):
                yield bundle(tmp_path / "b.sog", files | {name: data}).read_bytes()

    assert sum(survives(read_sog, path, inside())) == 8 * 8 + 120 + 7 * 20
