"""Merged assets: every range holds its own file, and `verify_merge` says so, and says when it does not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.io import read, write
from splatpainter.io.formats.ply import read_ply
from splatpainter.receipts import Receipt, verify
from splatpainter.scene.merge import carried, merge, verify_merge
from splatpainter.scene.placement import Placement
from splatpainter.splats import Splats
from tests.support.cli_scenes import ball, run
from tests.support.io_assets import float_columns, random_splats
from tests.support.lift_scenes import same_bits

MOVED = Placement.of(move=(2.5, 0, 0), turn=(0, 30, 0), scale=0.5)


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """Two PLY files of SH degree 3 and 1, the second one big endian and in another order, with one more property."""
    one, two = tmp_path / "one.ply", tmp_path / "two.ply"
    write(one, random_splats(300, 3, seed=1))
    write(tmp_path / "plain.ply", random_splats(200, 1, seed=2))
    record = read_ply(tmp_path / "plain.ply").source.detail  # type: ignore[union-attr]
    names = [*reversed(record.rows.records.dtype.names)]
    table = np.zeros(200, [(name, ">f4") for name in [*names, "confidence"]])
    for name in names:
        table[name] = record.rows.records[name]
    table["confidence"] = np.arange(200)
    head = ["ply", "format binary_big_endian 1.0", "element vertex 200"]
    head += [*(f"property float {name}" for name in table.dtype.names or ()), "end_header", ""]
    two.write_bytes("\n".join(head).encode() + table.tobytes())
    return one, two


def saved(receipt: Receipt) -> Receipt:
    """As it comes back from its file."""
    return Receipt.from_json(receipt.to_json())


def test_every_range_holds_the_stored_words_of_its_file(pair: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "scene.ply"
    receipt = merge(pair, out)
    assert saved(receipt).to_json() == out.with_name("scene.ply.receipt.json").read_text(encoding="utf-8")
    merged = float_columns(out)
    assert len(merged["x"]) == 500
    for path, span in zip(pair, (slice(0, 300), slice(300, 500)), strict=True):
        source = read(path)
        assert source.source is not None
        rows = source.source.detail.rows.records
        names = [name for name in rows.dtype.names if not name.startswith("f_rest_")]
        for name in names:
            np.testing.assert_array_equal(
                merged[name][span].view(np.uint32), rows[name].astype("<f4").view(np.uint32), err_msg=name
            )
        scene = read(out).take(np.arange(500)[span])
        np.testing.assert_array_equal(scene.sh[:, : source.sh.shape[1]], source.sh)
        assert not scene.sh[:, source.sh.shape[1] :].any()
    assert not merged["confidence"][:300].any()
    verification = verify_merge(out, pair[::-1], saved(receipt))
    assert verification.ok, verification.problems
    assert [(r.first, r.rows, r.same, r.changed, r.how) for r in verification.ranges] == [
        (0, 300, 300, 0, "bytes"),
        (300, 200, 200, 0, "bytes"),
    ]


def test_with_one_layout_it_is_an_edit_of_the_first_one(tmp_path: Path) -> None:
    paths = [tmp_path / "a.ply", tmp_path / "b.ply"]
    for k, path in enumerate(paths):
        write(path, random_splats(50 + k, 2, seed=k))
    receipt = merge(paths, tmp_path / "scene.ply")
    verification = verify(paths[0], tmp_path / "scene.ply", saved(receipt))
    assert verification.ok and (verification.same, verification.appended) == (50, 51)
    both = (tmp_path / "scene.ply").read_bytes()
    rows = b"".join(path.read_bytes().split(b"end_header\n", 1)[1] for path in paths)
    assert both.split(b"end_header\n", 1)[1] == rows


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".spz", ".sog", ".glb", ".compressed.ply"])
def test_all_formats_and_transforms_are_proved(suffix: str, tmp_path: Path) -> None:
    one, two = tmp_path / f"one{suffix}", tmp_path / "two.ply"
    write(one, random_splats(300, 2, seed=3))
    write(two, random_splats(260, 0, seed=4))
    out = tmp_path / f"scene{suffix}"
    receipt = merge([one, two, one], out, transforms=[None, MOVED, Placement.of(scale=2)])
    verification = verify_merge(out, [one, two], saved(receipt))
    assert verification.ok, verification.problems
    assert [r.rows for r in verification.ranges] == [300, 260, 300]
    assert verification.ranges[0].how == ("bytes" if suffix in (".ply", ".splat") else "values")
    scene = read(out)
    expected = MOVED.apply(read(two)).means
    tolerance = 1e-6 if suffix in (".ply", ".splat", ".glb") else 0.01 * float(np.ptp(scene.means))
    np.testing.assert_allclose(scene.means[300:560], expected, atol=tolerance)


def test_a_changed_byte_of_any_range_is_noticed(pair: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "scene.ply"
    receipt = replace(saved(merge(pair, out, transforms=[None, MOVED])), output_sha256="")
    data = bytearray(out.read_bytes())
    start = data.index(b"end_header\n") + 11
    stride = (len(data) - start) // 500
    for row in (7, 407):
        other = data.copy()
        other[start + row * stride + 2] ^= 1
        out.write_bytes(other)
        verification = verify_merge(out, pair, receipt)
        assert not verification.ok
        assert f"1 rows differ that no receipt lists: {row}" in verification.problems
        assert [r.changed for r in verification.ranges] == ([1, 0] if row < 300 else [0, 1])
    out.write_bytes(data[:-stride])
    with pytest.raises(ValueError, match="truncated|expected"):
        verify_merge(out, pair, receipt)


def test_the_receipt_knows_its_sources(pair: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "scene.ply"
    receipt = saved(merge(pair, out))
    write(tmp_path / "other.ply", random_splats(200, 1, seed=9))
    verification = verify_merge(out, [pair[0], tmp_path / "other.ply"], receipt)
    assert not verification.ok
    assert any("other.ply: is not a source" in line for line in verification.problems)
    assert any("range 2: its file is missing: two.ply" in line for line in verification.problems)
    with pytest.raises(ValueError, match="one of a merge"):
        verify_merge(out, pair, replace(receipt, merge=None))
    for change in ({"first": 5}, {"rows": True}, {"rows": 10**12}, {"placement": None}, {"seam": {"gain": 1}}):
        record = json.loads(receipt.to_json())
        record["merge"]["sources"][1].update(change)
        damaged = Receipt.from_json(json.dumps(record))
        try:
            assert not verify_merge(out, pair, damaged).ok
        except ValueError as error:
            assert "receipt: expected one of a merge" in str(error)


def test_edits_of_a_merged_asset_are_told_from_its_ranges(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    left, right = tmp_path / "left.ply", tmp_path / "right.ply"
    write(left, ball(400))
    write(right, ball(300))
    scene, once, twice = (tmp_path / f"{name}.ply" for name in ("scene", "once", "twice"))
    ran = run(capfd, "merge", left, right, "--side-by-side", "--out", scene, "--json")
    assert ran.code == 0 and ran.json["verified"]
    assert run(capfd, "grade", scene, "--exposure", 1, "--where", "x=1..", "--out", once).code == 0
    assert run(capfd, "grade", once, "--hue", 90, "--where", "x=..0", "--out", twice).code == 0
    ran = run(capfd, "verify", twice, "--against", right, left, "--json")
    first, second = ran.json["ranges"]
    assert ran.code == 0 and ran.json["ok"]
    assert first["changed"] > 100 and second["same"] == 0 and second["file"] == "right.ply"
    assert "verified" in run(capfd, "verify", once, twice).out
    data = bytearray(twice.read_bytes())
    data[-3] ^= 1
    twice.write_bytes(data)
    assert run(capfd, "verify", twice, "--against", right, left).code == 1
    receipt = Receipt.from_json(once.with_name("once.ply.receipt.json").read_text(encoding="utf-8"))
    assert carried(receipt, None) is receipt


def test_colours_at_the_seam_are_in_the_receipt(tmp_path: Path) -> None:
    one, two = tmp_path / "one.ply", tmp_path / "two.ply"
    surface = ball(3000, degree=2)
    write(one, surface)
    write(two, replace(surface, sh=surface.sh * np.float32(0.6) - np.float32(0.3)))
    out = tmp_path / "scene.ply"
    with pytest.raises(ValueError, match="not near to each other"):
        merge([one, two], out, transforms=[None, Placement.of(move=(40, 0, 0))], seam=True)
    assert not out.exists()
    receipt = saved(merge([one, two], out, seam=True, transforms=[None, Placement.of(move=(0.05, 0, 0))]))
    assert receipt.merge is not None and receipt.merge["sources"][1]["seam"]["pairs"] > 1000
    verification = verify_merge(out, [one, two], receipt)
    assert verification.ok and verification.ranges[1].how == "transformed"
    scene = read(out)
    assert same_bits(scene.take(np.arange(3000)), read(one))
    assert np.abs(scene.sh[3000:, 0] - surface.sh[:, 0]).mean() < np.abs(read(two).sh[:, 0] - surface.sh[:, 0]).mean()


def bad(path: Path, splats: Splats) -> Path:
    write(path, splats)
    return path


def test_bad_input_is_refused_in_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    one, two = bad(tmp_path / "one.ply", ball(50)), bad(tmp_path / "two.ply", ball(60))
    none = bad(tmp_path / "none.ply", ball(50).take(np.zeros(0, np.int64)))
    linear = bad(tmp_path / "linear.ply", replace(ball(50), color_space="linear"))
    far = bad(tmp_path / "far.ply", replace(ball(50), means=ball(50).means * np.float32(5e14)))
    hidden = bad(tmp_path / "nan.ply", replace(ball(50), means=np.full((50, 3), np.nan, np.float32)))
    out = tmp_path / "out.ply"
    cases = (
        ([one], "expected 2 to 100 assets"),
        ([one, one], "the same Gaussians at the same place"),
        ([one, none], "has no Gaussians to merge"),
        ([one, hidden], "none of its 50 Gaussians can be drawn"),
        ([one, linear], "its colours are linear"),
        ([one, far, "--transform", "none", "scale=1000"], "out of what can be drawn"),
        ([one, two, "--transform", "none"], "one transform for each"),
        ([one, two, "--transform", "none", "turn=a,b,c"], "expected numbers as turn"),
        ([one, two, "--seam-falloff", "1"], "expected --match-seam"),
        ([one, two, "--match-seam", "--seam-falloff", "-1"], "expected a falloff"),
        ([one, tmp_path / "missing.ply"], "no such file"),
    )
    for words, reason in cases:
        assert reason in run(capfd, "merge", *words, "--out", out).error
        assert not out.exists() and not out.with_name("out.ply.receipt.json").exists()
    assert "is an input" in run(capfd, "merge", one, two, "--out", one, "--overwrite").error
    assert "expected ORIGINAL and EDITED" in run(capfd, "verify", one).error
    assert "no receipt" in run(capfd, "verify", one, "--against", one, two).error
    assert sp.merge is merge and sp.verify_merge is verify_merge
