"""Losses as numbers: against sums by hand, against files decoded by hand, and what is said of them."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from splatpainter.io.formats.packing import morton_order
from splatpainter.io.losses import (
    Losses,
    better_format,
    loss_of_edits,
    measure,
    measured_as,
    moved_share_sorted,
)
from splatpainter.session import Session
from splatpainter.splats import SH_C0, Splats
from tests.support.cli_scenes import Capture, ball, run, saved
from tests.support.far_assets import far_ply
from tests.support.io_assets import random_splats


def same_sized(count: int = 400, size: float = 0.05, degree: int = 1) -> Splats:
    """Round Gaussians of one size, opaque, at random points, of colours within 0.2 to 0.8."""
    rng = np.random.default_rng(3)
    sh = np.zeros((count, (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = rng.uniform(-0.3, 0.3, (count, 3)) / SH_C0
    sh[:, 1:] = rng.uniform(-0.2, 0.2, sh[:, 1:].shape)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    means = rng.uniform(-1, 1, (count, 3)).astype(np.float32)
    return Splats(means, quats, np.full((count, 3), size, np.float32), np.full(count, 0.8, np.float32), sh)


def scattered_sky(count: int = 5000, far: int = 40) -> Splats:
    """A ball with a few large far Gaussians among its rows, as a sky is after training."""
    splats, rng = ball(count, degree=0), np.random.default_rng(1)
    means, scales = splats.means.copy(), splats.scales.copy()
    rows = rng.choice(count, far, replace=False)
    directions = rng.normal(size=(far, 3))
    means[rows] = 400 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    scales[rows] = 20
    return replace(splats, means=means, scales=scales)


def test_nothing_is_lost_of_what_is_equal() -> None:
    splats = same_sized()
    assert measure(splats, splats).line == "" and measure(splats, splats).severity == 0
    assert measure(splats.take(np.zeros(0, int)), splats.take(np.zeros(0, int))) == Losses()


def test_by_hand() -> None:
    before = same_sized(100, size=0.05)
    means, sh = before.means.copy(), before.sh.copy()
    scales, opacities, quats = before.scales.copy(), before.opacities.copy(), before.quats.copy()
    means[4] += np.array([0.3, 0.0, 0.4], np.float32)  # 0.5: ten sizes
    means[5, 1] += np.float32(0.02)  # 0.4 sizes
    sh[6, 0, 1] += np.float32(0.1 / SH_C0)
    sh[7, 2, 0] += np.float32(0.3)
    sh[7, 3, 0] -= np.float32(0.4)
    opacities[8] -= np.float32(0.1)
    scales[9, 1] *= np.float32(1.25)
    after = replace(before, means=means, sh=sh, scales=scales, opacities=opacities, quats=quats)
    losses = measure(before, after)
    assert losses.compared == 100
    assert losses.move_largest == pytest.approx(10, rel=1e-4) and losses.moved_share == pytest.approx(0.01)
    assert losses.color_largest == pytest.approx(0.1, rel=1e-4)
    assert losses.color_rms == pytest.approx(0.1 / 10, rel=1e-4)
    assert losses.sh_largest == pytest.approx(0.5 / math.sqrt(4 * math.pi), rel=1e-4)
    assert losses.opacity_largest == pytest.approx(0.1, rel=1e-4)
    assert losses.scale_largest == pytest.approx(0.25, rel=1e-4)
    assert losses.line.startswith("positions move by up to 10 sizes of a Gaussian (1 % of them by more than one)")


def test_by_any_number_of_threads_and_without_rows_that_cannot_be_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    before = same_sized(300, degree=2)
    rng = np.random.default_rng(6)
    after = replace(
        before,
        means=before.means + rng.normal(0, 0.01, before.means.shape).astype(np.float32),
        scales=before.scales * rng.uniform(0.9, 1.1, before.scales.shape).astype(np.float32),
        sh=before.sh[:, :4] * np.float32(0.5),
    )
    after.means[::7] = np.nan
    drawn = np.flatnonzero(np.arange(300) % 7)
    results = []
    for threads in ("1", "3"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
        results.append(measure(before, after))
    assert results[0] == results[1] == measure(before.take(drawn), after.take(drawn))
    difference = (after.means[drawn].astype(np.float64) - before.means[drawn]) / np.float64(before.scales[0, 0])
    ratios = np.abs(np.log(after.scales[drawn].astype(np.float64) / before.scales[drawn]))
    assert results[0].compared == len(drawn)
    assert results[0].move_largest == pytest.approx(np.linalg.norm(difference, axis=1).max())
    assert results[0].scale_rms == pytest.approx(np.sqrt((ratios.max(1) ** 2).mean()))
    assert results[0].sh_range == (before.sh[drawn, 1:].min(), before.sh[drawn, 1:].max())
    assert results[0].color_range_after[1] == pytest.approx(0.5 + SH_C0 * after.sh[drawn, 0].max())


def test_the_error_by_sh_is_the_mean_over_directions() -> None:
    """Against a sum over many directions with the basis functions themselves."""
    from splatpainter.transforms import fibonacci_sphere, sh_basis

    before = same_sized(50, degree=3)
    rng = np.random.default_rng(5)
    after = replace(before, sh=before.sh + rng.normal(0, 0.02, before.sh.shape).astype(np.float32))
    difference = (after.sh - before.sh).astype(np.float64)
    seen = np.einsum("dk,nkc->ndc", sh_basis(fibonacci_sphere(4000), 3)[:, 1:], difference[:, 1:])
    truth = np.sqrt((seen**2).mean(1)).max(1)
    losses = measure(before, after)
    assert losses.sh_largest == pytest.approx(truth.max(), rel=1e-3)
    assert losses.sh_rms == pytest.approx(np.sqrt((truth**2).mean()), rel=1e-3)


def test_turned_flat_gaussians_count_and_round_ones_do_not() -> None:
    before = same_sized(10)
    turned = before.quats.copy()
    turned[3] = (math.cos(math.radians(2.5)), 0, math.sin(math.radians(2.5)), 0)  # 5 degrees
    turned[4] = -turned[4]
    assert measure(before, replace(before, quats=turned)).rotation_largest == 0
    flat = replace(before, scales=before.scales * np.array([1, 1, 0.1], np.float32))
    losses = measure(flat, replace(flat, quats=turned))
    assert losses.rotation_largest == pytest.approx(5, abs=0.01)


def test_a_flat_axis_that_becomes_flatter_is_no_loss() -> None:
    before = same_sized(10)
    scales = before.scales.copy()
    scales[:, 2] = 1e-9
    flat = replace(before, scales=scales)
    thinner = scales.copy()
    thinner[:, 2] = 1e-5
    assert measure(flat, replace(flat, scales=thinner)).scale_largest == 0


def test_hidden_and_broken_gaussians_do_not_count() -> None:
    before = same_sized(10)
    opacities, means, quats = before.opacities.copy(), before.means.copy(), before.quats.copy()
    opacities[0], quats[1] = 0, 0
    before = replace(before, opacities=opacities, quats=quats)
    means[:2] += 5
    means[2] = np.nan
    losses = measure(before, replace(before, means=means))
    assert losses.compared == 7 and losses.move_largest == 0


def test_sh_beyond_what_spz_holds_is_said_to_be_cut(tmp_path: Path) -> None:
    """After a grade SH reach +-1.39; a byte of SPZ holds byte / 128 - 1."""
    sh = same_sized().sh.copy()
    sh[:40, 1, 0], sh[40:50, 2, 1] = 1.39, -1.39
    splats = replace(same_sized(), sh=sh)
    io.write(tmp_path / "a.spz", splats)
    losses = measure(splats, io.read(tmp_path / "a.spz"))
    assert losses.sh_cut_share == pytest.approx(50 / 400)
    assert losses.sh_range == pytest.approx((-1.39, 1.39))
    assert sorted(map(abs, losses.sh_range_after)) == [127 / 128, 1], "which of them by the axes of the file"
    assert losses.line.startswith("SH of 12 % of the Gaussians are cut (from -1.39..1.39 to "), losses.line
    assert losses.sh_largest == pytest.approx(0.39 / math.sqrt(4 * math.pi), abs=5e-3)
    assert measured_as(same_sized(), "spz")[0].sh_cut_share == 0


@pytest.mark.parametrize(("name", "low", "high"), [("spz", 0.5 - 0.94, 0.5 + 0.94), ("splat", 0.0, 1.0)])
def test_colours_beyond_the_range_of_a_format_are_cut(name: str, low: float, high: float, tmp_path: Path) -> None:
    sh = same_sized(degree=0).sh.copy()
    sh[:4, 0, 2] = (1.8 - 0.5) / SH_C0
    splats = replace(same_sized(degree=0), sh=sh)
    io.write(tmp_path / f"a.{name}", splats)
    losses = measure(splats, io.read(tmp_path / f"a.{name}"))
    assert losses.color_cut_share == pytest.approx(0.01) and losses.color_range[1] == pytest.approx(1.8)
    assert losses.color_range_after[1] == pytest.approx(high, abs=0.01) and losses.color_range_after[0] > low
    assert "colours of 1 % of the Gaussians are cut" in losses.line


def chunked_positions(path: Path, count: int) -> np.ndarray:
    """[count, 3] positions of a compressed PLY, by hand from its chunks and words: 11, 10 and 11 bits."""
    body = path.read_bytes().split(b"end_header\n", 1)[1]
    chunks, out = -(-count // 256), []
    for row in range(count):
        ends = struct.unpack_from("<6f", body, 72 * (row // 256))
        (word,) = struct.unpack_from("<I", body, 72 * chunks + 16 * row)
        fractions = (word >> 21) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047
        out.append([ends[k] + fractions[k] * (ends[3 + k] - ends[k]) for k in range(3)])
    return np.array(out)


def test_scattered_sky_in_compressed_ply(tmp_path: Path) -> None:
    splats = scattered_sky()
    io.write(tmp_path / "a.compressed.ply", splats)
    losses = measure(splats, io.read(tmp_path / "a.compressed.ply"))
    there = chunked_positions(tmp_path / "a.compressed.ply", len(splats))
    moves = np.linalg.norm(there - splats.means, axis=1) / splats.scales.max(1)
    assert losses.moved_share == pytest.approx((moves > 1).mean(), abs=1e-3) and losses.moved_share > 0.2
    assert losses.move_largest == pytest.approx(moves.max(), rel=1e-3)
    assert losses.worst_first[0].what == "positions" and losses.severity > 100
    assert better_format(splats, "compressed.ply", losses) == ".sog"


def test_what_reading_has_rounded_counts_as_lost(tmp_path: Path) -> None:
    """Doubles of a few Gaussians far from the others: an offset serves the others alone."""
    positions = far_ply(tmp_path / "near.ply", same_sized(500, degree=0), (0.0, 0.0, 0.0))
    head, body = (tmp_path / "near.ply").read_bytes().split(b"end_header\n", 1)
    rows = np.frombuffer(body, np.uint8).reshape(500, -1).copy()
    positions[:5, 0] = 1e7 + 0.3 + np.arange(5)  # six sizes from what float32 has there
    rows[:, :24] = positions.view(np.uint8).reshape(500, 24)
    (tmp_path / "a.ply").write_bytes(head + b"end_header\n" + rows.tobytes())
    splats = io.read(tmp_path / "a.ply")
    assert splats.source is not None and any("5 Gaussians lie so far" in line for line in splats.source.problems)
    moves = np.abs(positions[:5, 0] - positions[:5, 0].astype(np.float32)) / 0.05
    for key, suffix in (("glb", "glb"), ("splat", "splat")):
        io.write(tmp_path / f"b.{suffix}", splats)
        losses = measure(splats, io.read(tmp_path / f"b.{suffix}"))
        assert losses.move_largest == pytest.approx(moves.max(), rel=1e-3) and losses.moved_share == 0.01
        assert better_format(splats, key, losses) == ".ply"
    io.write(tmp_path / "b.ply", splats)
    assert measure(splats, io.read(tmp_path / "b.ply")).move_largest == 0
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()


def test_a_format_that_holds_all_well_needs_no_better_one() -> None:
    splats = random_splats(300, 1)
    for key in ("ply", "glb", "sog"):
        losses, size = measured_as(splats, key)
        assert better_format(splats, key, losses) == "" and size > 1000
    assert measured_as(splats, "ply")[0].line == "" == measured_as(splats, "glb")[0].line


def test_what_no_small_format_holds_names_the_large_one() -> None:
    """Positions that float32 cannot hold: only GLB's node and doubles of PLY do."""
    far = replace(ball(500, degree=0), offset=(5e5, 5.4e6, 300.0))
    losses, _ = measured_as(far, "spz")
    assert losses.moved_share > 0.9 and better_format(far, "spz", losses) == ".glb"
    assert measured_as(far, "glb")[0].line == "" == measured_as(far, "ply")[0].line


def test_a_dropped_sh_degree_is_an_error_of_sh() -> None:
    before = same_sized(20)
    losses = measure(before, replace(before, sh=before.sh[:, :1]))
    truth = np.sqrt((before.sh[:, 1:].astype(float) ** 2).sum(1) / (4 * np.pi)).max(1)
    assert losses.sh_largest == pytest.approx(truth.max(), rel=1e-5)


def test_the_share_that_moves_once_sorted_is_that_of_a_file() -> None:
    sky = scattered_sky()
    sky = replace(sky, scales=sky.scales / 20)
    share = moved_share_sorted(sky)
    assert 0.05 < share < 1
    assert share == measured_as(sky.take(morton_order(sky.means)), "compressed.ply")[0].moved_share
    lost = sky.opacities.copy()
    lost[::2] = 0
    hidden = replace(sky, opacities=lost)
    in_order = hidden.take(morton_order(hidden.means))
    assert moved_share_sorted(hidden) == measured_as(in_order, "compressed.ply")[0].moved_share
    # Far from zero it is float32 that moves them, which no order helps.
    far = replace(sky, offset=(448262.0, 5411932.0, 2312.0))
    in_order = far.take(morton_order(far.means))
    assert moved_share_sorted(far) == measured_as(in_order, "compressed.ply")[0].moved_share > 0.5


def test_convert_says_the_worst_first_and_what_would_be_better(tmp_path: Path, capfd: Capture) -> None:
    asset = saved(tmp_path / "sky.ply", scattered_sky())
    done = run(capfd, "convert", asset, tmp_path / "a.compressed.ply")
    assert "lost: positions move by up to" in done.out and "(.sog would hold them)" in done.out
    assert "(with --sort " in done.out
    assert "lost: nothing" in run(capfd, "convert", asset, tmp_path / "a.glb").out
    there = run(capfd, "convert", asset, tmp_path / "d.compressed.ply", "--sort", "--json").json
    assert there["losses"]["moved_share"] < 0.1 and "the order of the rows" in there["lost"]
    rows, again = io.read(asset), io.read(tmp_path / "d.compressed.ply")
    near = np.abs(rows.means).max(1) < 2
    assert abs(np.sort(again.means[np.abs(again.means).max(1) < 2, 0]) - np.sort(rows.means[near, 0])).mean() < 0.05
    record = run(capfd, "convert", asset, tmp_path / "b.compressed.ply", "--json").json
    assert record["losses"]["moved_share"] > 0.2 and len(record["lost"]) == 1
    same = run(capfd, "convert", tmp_path / "a.compressed.ply", tmp_path / "c.compressed.ply", "--json").json
    assert same["lost"] == []


def test_info_measures_what_edits_lose_and_all_formats_where_asked(tmp_path: Path, capfd: Capture) -> None:
    asset = saved(tmp_path / "ball.spz", ball(500))
    done = run(capfd, "info", asset, "--losses")
    assert "of edited Gaussians, by rounding: " in done.out
    lines = {line.split()[1]: line for line in done.out.splitlines() if line.startswith("as ")}
    assert set(lines) == {".compressed.ply", ".ply", ".splat", ".spz", ".sog", ".glb"}
    assert lines[".glb"].endswith("lost: nothing") and "colours off by up to 0.5/255" in lines[".splat"]
    assert loss_of_edits(io.read(asset)).move_largest > 0


def test_exports_measure_and_the_receipt_says_it(tmp_path: Path) -> None:
    with Session(scattered_sky(2000, 30)) as session:
        receipt, proof = session.files.export(tmp_path / "a.compressed.ply")
        assert (
            proof.lost.startswith("positions move by up to") and f"lost in compressed.ply: {proof.lost}" in receipt.note
        )
        _, proof = session.files.export(tmp_path / "a.glb")
        assert proof.lost == ""
        session.scene.add(saved(tmp_path / "b.ply", ball(500, degree=0)))
        receipt, proof = session.files.export(tmp_path / "both.compressed.ply")
        assert proof.lost.startswith("positions move by up to") and proof.lost in receipt.note
