"""Receipts and `verify`: what a file proves, and every way in which one can be tampered with."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import splatpainter as sp
from splatpainter.cameras import Camera, orbit
from splatpainter.painter import Edit, Painter
from splatpainter.receipts import Receipt, ViewScore, from_runs, score, to_runs
from splatpainter.splats import Splats, changed_rows
from tests.support.lift_scenes import disk, front, sheet

RAW = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(9))]
RAW += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)), "confidence"]
STRIDE = 4 * len(RAW)
TAIL = b"kept as it is\x00\xff"


def write_by_hand(path: Path, splats: Splats) -> None:
    """INRIA's PLY with random normals, an extra property, a comment and trailing bytes; struct and numpy only."""
    n, rng = len(splats), np.random.default_rng(9)
    table = np.empty((n, len(RAW)), "<f4")
    table[:, :3], table[:, 3:6], table[:, 6:9] = splats.means, rng.normal(0, 1, (n, 3)), splats.sh[:, 0]
    table[:, 9:18] = splats.sh[:, 1:].transpose(0, 2, 1).reshape(n, 9)
    table[:, 18] = np.log(splats.opacities / (1 - splats.opacities))
    table[:, 19:22], table[:, 22:26], table[:, 26] = np.log(splats.scales), splats.quats, rng.uniform(size=n)
    lines = ["ply", "format binary_little_endian 1.0", "comment made by hand", f"element vertex {n}"]
    head = "\n".join([*lines, *(f"property float {name}" for name in RAW), "end_header", ""])
    path.write_bytes(head.encode() + table.tobytes() + TAIL)


def start_of_rows(data: bytes) -> int:
    return data.index(b"end_header\n") + len(b"end_header\n")


def stored_rows(path: Path) -> np.ndarray:
    """[N, STRIDE] uint8 of a PLY of the layout above."""
    data = path.read_bytes()
    begin = start_of_rows(data)
    count = (len(data) - begin) // STRIDE
    return np.frombuffer(data, np.uint8, count * STRIDE, begin).reshape(count, STRIDE)


def file_hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def edited_files(folder: Path, suffix: str = ".ply") -> tuple[Path, Path, Receipt]:
    """An original with everything a PLY can have, the same after a dab of paint, and the receipt of that."""
    original, edited = folder / "original.ply", folder / f"edited{suffix}"
    *contents, receipt = edited_bytes(suffix)
    for path, content in zip((original, edited), contents, strict=True):
        path.write_bytes(content)
    return original, edited, receipt


def paint_red(splats: Splats, camera: Camera, mask: np.ndarray, path: Path) -> Receipt:
    """Write the asset with red inside the mask to a file; the receipt names it."""
    image = np.where(mask[..., None], [0.9, 0.1, 0.1], sp.render(splats, camera).colors[0])
    painter = Painter.load("lift")
    result = painter.apply(painter.encode(splats), [Edit(image, camera, mask)])
    sp.write(path, result.splats)
    assert result.receipt is not None
    return replace(result.receipt, output_sha256=file_hash(path))


@cache
def edited_bytes(suffix: str) -> tuple[bytes, bytes, Receipt]:
    """The contents of these files, painted once for all tests."""
    with tempfile.TemporaryDirectory() as folder:
        original, edited = Path(folder, "original.ply"), Path(folder, f"edited{suffix}")
        write_by_hand(original, sheet(30, degree=1))
        splats, camera = sp.read(original), front(64)
        receipt = paint_red(splats, camera, disk(camera, 30, 34, 9), edited)
        return original.read_bytes(), edited.read_bytes(), receipt


def untouched_row(receipt: Receipt) -> int:
    return next(row for row in range(receipt.asset_rows) if row not in set(receipt.touched.tolist()))


def tamper(path: Path, change: Callable[[bytearray, int], None], receipt: Receipt) -> Receipt:
    """Change the file's bytes (given where its rows begin) and the receipt's hash of it, so that only rows can tell."""
    data = bytearray(path.read_bytes())
    change(data, start_of_rows(bytes(data)))
    path.write_bytes(data)
    return replace(receipt, output_sha256=file_hash(path))


# JSON


def receipt(**fields) -> Receipt:
    views = (ViewScore(9.5, 27.123456, float("inf")), ViewScore(None, None, 40.0))
    full_receipt = Receipt(
        asset_sha256="a" * 64,
        asset_rows=10,
        output_sha256="b" * 64,
        output_rows=13,
        mode="local",
        method="lift",
        preset="lift",
        touched=np.array([0, 1, 2, 7, 9]),
        appended_rows=3,
        untouched_sha256_before="c" * 64,
        untouched_sha256_after="d" * 64,
        views=views,
        seconds={"lift": 0.12345678},
        note="why",
    )
    return replace(full_receipt, **fields)


def test_the_keys_are_the_designs():
    data = json.loads(receipt().to_json())
    design = ["asset", "output", "mode", "method", "preset", "touched_rows", "appended_rows", "replaced_rows"]
    design += ["removed_rows", "untouched_sha256_before", "untouched_sha256_after", "views", "seconds"]
    assert list(data) == [*design, "note", "touched_runs"]
    assert data["asset"] == {"sha256": "a" * 64, "rows": 10} and data["output"] == {"sha256": "b" * 64, "rows": 13}
    assert (data["touched_rows"], data["appended_rows"], data["removed_rows"]) == (5, 3, 0)
    assert data["touched_runs"] == [[0, 3], [7, 1], [9, 1]]
    assert data["views"][0] == {"psnr_before": 9.5, "psnr_after": 27.123, "psnr_outside": 999.0}
    assert data["views"][1] == {"psnr_before": None, "psnr_after": None, "psnr_outside": 40.0}
    assert data["seconds"] == {"lift": 0.1235} and data["note"] == "why"
    # Where networks ran there is one more; receipts without it are as they were.
    further = json.loads(receipt(precision="float32").to_json())
    assert list(further) == [*design, "note", "precision", "touched_runs"] and further["precision"] == "float32"
    # Sheets name the rows whose places they took, and those that they emptied.
    sheets = receipt(replaced=np.array([0, 1, 7]), removed=np.array([2]), limited_px=(1.5, 0.0))
    data = json.loads(sheets.to_json())
    assert list(data) == [*design, "note", "limited_px", "touched_runs", "replaced_runs", "removed_runs"]
    assert (data["replaced_rows"], data["removed_rows"], data["limited_px"]) == (3, 1, [1.5, 0.0])
    assert data["replaced_runs"] == [[0, 2], [7, 1]] and data["removed_runs"] == [[2, 1]]


def test_replaced_and_removed_rows_are_touched_ones():
    text = receipt(replaced=np.array([0, 1, 7]), removed=np.array([2])).to_json()
    for name, run in (("replaced_runs", "[[0,2],[7,1]]"), ("removed_runs", "[[2,1]]")):
        assert f'"{name}": {run}' in text
        with pytest.raises(ValueError, match="not among the touched"):
            Receipt.from_json(
                text.replace(f'"{name}": {run}', f'"{name}": {run.replace("2,1", "3,1").replace("7,1", "8,1")}')
            )
    with pytest.raises(ValueError, match="removed_rows is 2"):
        Receipt.from_json(text.replace('"removed_rows": 1', '"removed_rows": 2'))


def strict(text: str) -> dict:
    """JSON as the standard has it: no NaN, no Infinity."""

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"touched": np.zeros(0, np.int64)},
        {"views": (), "seconds": {}, "note": ""},
        {"precision": "bfloat16", "core": "0123456789ab"},
        {"replaced": np.array([0, 2]), "removed": np.array([7, 9]), "limited_px": (2.5, 0.0)},
        {"merge": {"sources": [{"name": "a.ply", "rows": 5}]}, "merge_touched": np.array([1, 4])},
    ],
)
def test_json_and_back_is_the_same(fields):
    text = receipt(**fields).to_json()
    strict(text)
    back = Receipt.from_json(text)
    assert back.to_json() == text
    given_, restored = vars(receipt(**fields)).copy(), vars(back).copy()
    for name in ("touched", "replaced", "removed", "merge_touched"):
        np.testing.assert_array_equal(restored.pop(name), given_.pop(name))
    rounded = {"views", "seconds"}  # and infinity is 999
    assert {k: v for k, v in restored.items() if k not in rounded} == {
        k: v for k, v in given_.items() if k not in rounded
    }
    assert back.untouched_rows == 10 - len(receipt(**fields).touched)


@given(st.sets(st.integers(0, 60)))
@settings(max_examples=80, deadline=None)
def test_runs_there_and_back(rows):
    ascending = np.array(sorted(rows), np.int64)
    runs = to_runs(ascending)
    assert [row for first, count in runs.tolist() for row in range(first, first + count)] == sorted(rows)
    assert all(first + count < later for (first, count), (later, _) in zip(runs, runs[1:], strict=False))  # few
    np.testing.assert_array_equal(from_runs(runs, 61), ascending)
    assert from_runs(runs, 61).dtype == np.int64


def changed(**fields) -> str:
    return json.dumps(json.loads(receipt().to_json()) | fields)


def without(key: str) -> str:
    data = json.loads(receipt().to_json())
    del data[key]
    return json.dumps(data)


HUGE = 10**15
BROKEN = {
    "not JSON": "{ nope\n\n",
    "a list": "[]",
    "a number": "7",
    "a camera": '{"version": 1, "width": 3}',
    "deep": "[" * 100_000,
    "a huge number": '{"asset": ' + "9" * 5000 + "}",
    "overlapping runs": changed(touched_runs=[[0, 3], [2, 2]], touched_rows=5),
    "descending runs": changed(touched_runs=[[7, 1], [0, 4]], touched_rows=5),
    "a run beyond the end": changed(touched_runs=[[6, 5]], touched_rows=5),
    "a run before the start": changed(touched_runs=[[-1, 5]], touched_rows=5),
    "an empty run": changed(touched_runs=[[0, 5], [7, 0]], touched_rows=5),
    "a run that wraps around": changed(touched_runs=[[2**62, 2**62]], touched_rows=0),
    "half runs": changed(touched_runs=[[0, 3, 1]]),
    "runs of words": changed(touched_runs=[["a", "b"]]),
    "another count": changed(touched_rows=4),
    "more rows than memory": changed(asset={"sha256": "a", "rows": HUGE}, touched_runs=[[0, HUGE]], touched_rows=HUGE),
    "rows in words": changed(asset={"sha256": "a", "rows": "many"}),
    "infinite rows": changed().replace('"appended_rows": 3', '"appended_rows": 1e999'),
    "no views": without("views"),
    "no runs": without("touched_runs"),
    "views of another kind": changed(views=[{"lpips": 1}]),
    "views that are none": changed(views=[None]),
    "seconds that are none": changed(seconds=[1, 2]),
    "seconds in words": changed(seconds={"lift": "soon"}),
    "seconds without end": changed(seconds={"lift": 1e999}),
    "views of lists": changed(views=[{"psnr_before": [1], "psnr_after": None, "psnr_outside": None}]),
    "views of pairs": changed(views=[[1, 2]]),
    "a hash of two lines": changed(output={"sha256": "a\nb", "rows": 13}),
    "a mode of escapes": changed(mode="\x1b[2J"),
    "a method that is a list": changed(method=["lift"] * 500),
}


@pytest.mark.parametrize("text", BROKEN.values(), ids=BROKEN)
def test_a_broken_receipt_is_one_line_that_says_where(text):
    with pytest.raises(ValueError, match=r"^r\.json: ") as error:
        Receipt.from_json(text, "r.json")
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


# Rows


def test_changed_rows_are_those_of_which_any_bit_differs():
    before = sheet(4, degree=1)
    after = replace(before, **{name: getattr(before, name).copy() for name in ("means", "sh", "opacities", "quats")})
    before.means[2, 1] = 0.0
    after.means[2, 1] = -0.0
    after.sh[5, 3, 2] = np.nextafter(after.sh[5, 3, 2], np.float32(9))
    before.opacities[7] = after.opacities[7] = np.nan
    before.opacities[8] = np.array(0x7FC00000, np.uint32).view(np.float32)
    after.opacities[8] = np.array(0x7FC00001, np.uint32).view(np.float32)
    after.quats[15, 0] += 1
    assert changed_rows(before, after).tolist() == [2, 5, 8, 15]
    assert changed_rows(before, after.append(after)).tolist() == [2, 5, 8, 15]
    assert changed_rows(before, before).tolist() == []
    lower = replace(before, sh=before.sh[:, :1])
    assert changed_rows(before, lower).tolist() == list(range(16))


def test_scores_are_decibels_over_the_mask():
    dark, light = np.zeros((4, 5, 3), np.float32), np.full((4, 5, 3), 0.1, np.float32)
    mask = np.zeros((4, 5), bool)
    assert score(dark, light, mask) is None
    mask[1:3, 2] = True
    assert score(dark, light, mask) == pytest.approx(20)
    light[~mask] = 7
    assert score(dark, light, mask) == pytest.approx(20)
    assert score(dark + 1, light * 0 + 3, mask) == float("inf")  # both are white on a screen
    assert score(dark, dark, mask) == float("inf")


# Files


def test_an_edited_ply_is_the_same_but_for_the_listed_rows(tmp_path):
    original, edited, proof = edited_files(tmp_path)
    old, new = stored_rows(original), stored_rows(edited)
    n = proof.asset_rows
    assert len(old) == n and len(new) == n + proof.appended_rows and proof.appended_rows > 0
    differing = np.flatnonzero((old != new[:n]).any(1))
    np.testing.assert_array_equal(differing, proof.touched)
    before, after = original.read_bytes(), edited.read_bytes()
    head = before[: start_of_rows(before)].replace(b"vertex %d" % n, b"vertex %d" % (n + proof.appended_rows))
    assert after[: start_of_rows(after)] == head and after.endswith(TAIL)
    verification = sp.verify(original, edited, proof)
    assert verification.ok and verification.problems == () and "byte" in verification.exact
    assert (verification.rows, verification.changed, verification.appended) == (
        n,
        len(proof.touched),
        proof.appended_rows,
    )
    assert verification.same == n - len(proof.touched)
    again = sp.verify(original, edited, Receipt.from_json(proof.to_json()))
    assert again == verification
    assert sp.verify(original, edited).ok  # without a receipt rows are only counted
    assert sp.verify(original, edited).changed == len(proof.touched)


def test_a_file_is_the_same_as_itself(tmp_path):
    original, _, _ = edited_files(tmp_path)
    verification = sp.verify(original, original)
    assert verification.ok and (verification.same, verification.changed, verification.appended) == (900, 0, 0)


@pytest.mark.parametrize("column", RAW)
def test_one_flipped_bit_in_an_untouched_row_is_found(tmp_path, column):
    original, edited, proof = edited_files(tmp_path)
    victim = untouched_row(proof)

    def flip(data: bytearray, begin: int) -> None:
        data[begin + victim * STRIDE + 4 * RAW.index(column)] ^= 1

    forged = tamper(edited, flip, proof)
    verification = sp.verify(original, edited, forged)
    assert not verification.ok and len(verification.problems) == 1
    assert f"1 rows differ that the receipt does not list: {victim}" in verification.problems[0]
    assert verification.changed == len(proof.touched) + 1 == sp.verify(original, edited).changed
    # With the true receipt the file's own hash is wrong as well.
    assert len(sp.verify(original, edited, proof).problems) == 2


@pytest.mark.parametrize("victim", [0, 16_383, 16_384, 39_999])
def test_rows_of_an_odd_number_of_bytes_are_compared_to_the_last(tmp_path, victim):
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{k}" for k in range(3))]
    names += [f"rot_{k}" for k in range(4)]
    table = np.ones(40_000, [*((name, ">f4") for name in names), ("label", "u1")])
    head = f"ply\nformat binary_big_endian 1.0\nelement vertex {len(table)}\n"
    head += "".join(f"property float {name}\n" for name in names) + "property uchar label\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + table.tobytes())
    table["label"][victim] = 2
    (tmp_path / "b.ply").write_bytes(head.encode() + table.tobytes())
    verification = sp.verify(tmp_path / "a.ply", tmp_path / "b.ply")
    assert (verification.same, verification.changed) == (39_999, 1)


def test_a_flipped_bit_in_a_touched_row_is_only_seen_by_the_files_hash(tmp_path):
    original, edited, proof = edited_files(tmp_path)
    victim = int(proof.touched[3])

    def flip(data: bytearray, begin: int) -> None:
        data[begin + victim * STRIDE + 3] ^= 1

    forged = tamper(edited, flip, proof)
    assert sp.verify(original, edited, forged).ok
    verification = sp.verify(original, edited, proof)
    assert not verification.ok and "changed since" in verification.problems[0]


def test_a_changed_comment_is_seen_by_the_files_hash(tmp_path):
    original, edited, proof = edited_files(tmp_path)
    edited.write_bytes(edited.read_bytes().replace(b"made by hand", b"made by HAND"))
    assert not sp.verify(original, edited, proof).ok


def test_a_removed_row_is_found(tmp_path):
    original, edited, proof = edited_files(tmp_path)
    short = sp.read(edited)
    sp.write(edited, short.take(np.arange(len(short) - 1)), overwrite=True)
    verification = sp.verify(original, edited, replace(proof, output_sha256=file_hash(edited)))
    assert not verification.ok and "appended" in verification.problems[0]
    sp.write(edited, short.take(np.delete(np.arange(900), 17)), overwrite=True)
    verification = sp.verify(original, edited, replace(proof, output_sha256=file_hash(edited)))
    assert not verification.ok and "1 rows are missing" in " ".join(verification.problems)
    assert not sp.verify(original, edited).ok


def test_two_rows_that_changed_places_are_found(tmp_path):
    original, edited, proof = edited_files(tmp_path)
    a, b = [row for row in range(900) if row not in set(proof.touched.tolist())][10:12]

    def swap(data: bytearray, begin: int) -> None:
        one, two = (slice(begin + row * STRIDE, begin + (row + 1) * STRIDE) for row in (a, b))
        data[one], data[two] = data[two], data[one]

    verification = sp.verify(original, edited, tamper(edited, swap, proof))
    assert not verification.ok and f": {a}, {b}" in verification.problems[0]


def test_the_receipt_of_another_file_is_refused(tmp_path):
    original, edited, proof = edited_files(tmp_path)
    other = tmp_path / "other.ply"
    other.write_bytes(original.read_bytes()[:-1] + b"\xfe")  # one trailing byte
    verification = sp.verify(other, edited, proof)
    assert not verification.ok and "another original" in verification.problems[0]
    assert verification.changed == len(proof.touched)
    assert not sp.verify(original, edited, replace(proof, touched=proof.touched[1:])).ok
    assert not sp.verify(original, edited, replace(proof, appended_rows=0)).ok
    numbers = json.loads(proof.to_json()) | {"asset": {"sha256": 5, "rows": 900}}
    assert not sp.verify(original, edited, Receipt.from_json(json.dumps(numbers))).ok


def test_another_degree_is_found(tmp_path):
    original, edited, proof = edited_files(tmp_path)
    read_back = sp.read(edited)
    sp.write(edited, replace(read_back, sh=read_back.sh[:, :1]), overwrite=True)
    verification = sp.verify(original, edited, replace(proof, output_sha256=file_hash(edited)))
    assert not verification.ok and any("degree 1 became 0" in problem for problem in verification.problems)


def test_an_original_that_the_other_format_cannot_hold_is_named(tmp_path):
    far = sheet(5)
    far.means[3, 0] = 1e8
    sp.write(tmp_path / "far.ply", far)
    sp.write(tmp_path / "near.spz", sheet(5))
    with pytest.raises(ValueError, match=r"far\.ply: cannot be compared with .*near\.spz as spz: row 3 at") as refused:
        sp.verify(tmp_path / "far.ply", tmp_path / "near.spz")
    assert "converted" not in str(refused.value) and "write .ply" not in str(refused.value)


def test_a_ply_edited_into_another_format(tmp_path):
    original, edited, proof = edited_files(tmp_path, ".splat")
    verification = sp.verify(original, edited, proof)
    assert verification.ok, verification.problems
    assert "converted to splat" in verification.exact and verification.appended == proof.appended_rows
    # 32 bytes a row: every row that is not listed is what converting the original alone gives.
    sp.write(tmp_path / "plain.splat", sp.read(original))
    old, new = (
        np.frombuffer(path.read_bytes(), np.uint8).reshape(-1, 32) for path in (tmp_path / "plain.splat", edited)
    )
    differing = np.flatnonzero((old != new[: len(old)]).any(1))
    assert set(differing) <= set(proof.touched.tolist()) and len(differing) > 10
    assert verification.changed == len(differing)
    data = bytearray(edited.read_bytes())
    data[32 * untouched_row(proof) + 24] ^= 1  # red
    edited.write_bytes(data)
    assert not sp.verify(original, edited, replace(proof, output_sha256=file_hash(edited))).ok


def test_a_file_that_cannot_be_read_is_an_error(tmp_path):
    original, edited, proof = edited_files(tmp_path)
    edited.write_bytes(edited.read_bytes()[:2000])
    with pytest.raises(ValueError, match="edited.ply"):
        sp.verify(original, edited, proof)
    with pytest.raises(ValueError, match="absent.ply"):
        sp.verify(tmp_path / "absent.ply", original)


@pytest.mark.parametrize("name", ["massa.ply", "playbot_lod4_sh3.ply"])
def test_a_capture_keeps_every_byte_that_was_not_painted(shared, tmp_path, name):
    original, edited = shared / "data" / "splats" / name, tmp_path / "edited.ply"
    splats = sp.read(original)
    center = np.median(splats.means, 0)
    radius = float(np.quantile(np.linalg.norm(splats.means - center, axis=1), 0.9))
    camera = orbit(center, 2.2 * radius, 1, width=192, height=192)[0]
    proof = paint_red(splats, camera, disk(camera, 96, 96, 12), edited)
    assert proof.asset_sha256 == file_hash(original)

    old, new = original.read_bytes(), edited.read_bytes()
    stride = (len(old) - start_of_rows(old)) // len(splats)
    begins = start_of_rows(old), start_of_rows(new)
    touched = set(proof.touched.tolist())
    assert 0 < len(touched) < 0.5 * len(splats)
    for row in range(len(splats)):
        one, two = (data[b + row * stride : b + (row + 1) * stride] for data, b in zip((old, new), begins, strict=True))
        assert (one != two) == (row in touched)
    assert sp.verify(original, edited, proof).ok


def test_hashes_of_what_was_left_alone_differ_where_it_was_not() -> None:
    """A row that changed without being named makes the two hashes different; named, they are one."""
    from splatpainter.demo_asset import demo_asset
    from splatpainter.receipts import untouched_hashes

    before = demo_asset().take(np.arange(50))
    opacities = before.opacities.copy()
    opacities[7] = 0.123
    after = dataclasses.replace(before, opacities=opacities)
    first, second = untouched_hashes(before, after, np.array([3]))
    assert first != second
    first, second = untouched_hashes(before, after, np.array([3, 7]))
    assert first == second
