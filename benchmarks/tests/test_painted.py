"""The bench of painted meshes: its baselines and figures against what is known by hand, and once from start to end."""

from __future__ import annotations

import csv
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from splatbench import painted
from splatbench.cases import Case, EditStep, PosedImages
from splatbench.naive_edits import color_rounds, cut_in_four, split_and_color
from splatbench.painted import PaintedBench, Truth, measure_case, methods, percent, specks

from splatpainter.cameras import Camera, look_at
from splatpainter.metrics import psnr
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, Splats
from tests.support.lift_scenes import SH_C0, disk, front, row, sheet

RED = np.array([0.9, 0.1, 0.1], np.float32)


def drawn(splats: Splats, camera: Camera) -> np.ndarray:
    return np.clip(render(splats, camera).colors[0], 0, 1)


def in_red(splats: Splats, chosen: np.ndarray) -> Splats:
    """The chosen Gaussians ([N] bool) in one colour."""
    sh = splats.sh.copy()
    sh[chosen] = 0
    sh[chosen, 0] = (RED - 0.5) / SH_C0
    return replace(splats, sh=sh)


def painted_sheet() -> tuple[Case, Splats]:
    """A sheet with a red disk, as a case whose truth is the same sheet with that disk's Gaussians red; and that."""
    asset, camera = sheet(60), front(96)
    truth = in_red(asset, np.hypot(*asset.means[:, :2].T) < 0.45)
    novel = tuple(
        look_at((x, 0.3, 2.8), (0, 0, 0), width=96, height=96, fov=42, background=(0.5, 0.5, 0.5)) for x in (1, -1)
    )
    edited = PosedImages((camera,), drawn(truth, camera)[None])
    mask = disk(camera, 48, 48, 22)
    before, after = (PosedImages(novel, np.stack([drawn(s, c) for c in novel])) for s in (asset, truth))
    step = EditStep("local", "paint", edited, mask[None])
    return Case("painted", "sheet", "sheet", asset, before, (step,), before, after, np.ones(2, bool)), truth


def test_color_rounds_paint_the_mask_and_leave_other_gaussians_alone() -> None:
    splats, camera = sheet(50), front(96)
    mask = disk(camera, 48, 48, 15)
    target = np.where(mask[..., None], RED, drawn(splats, camera))
    after = color_rounds(splats, camera, target, mask)
    assert psnr(drawn(after, camera), target, mask) > psnr(drawn(splats, camera), target, mask) + 10
    far = np.hypot(*splats.means[:, :2].T) > 0.7
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(after, name)[far], getattr(splats, name)[far])


def test_cutting_in_four_keeps_indices_and_the_picture() -> None:
    splats, camera = sheet(30), front(96)
    mask = disk(camera, 48, 48, 15)
    after = cut_in_four(splats, camera, mask)
    cut = (after.scales[: len(splats)] != splats.scales).any(1)
    assert len(after) == len(splats) + 3 * cut.sum() and 20 < cut.sum() < 400
    far = np.hypot(*splats.means[:, :2].T) > 0.7
    assert not cut[far].any()
    assert psnr(drawn(after, camera), drawn(splats, camera)) > 30
    one = row((0, 0, 0), (0.4, 0.2, 0.01), (0.2, 0.4, 0.6))
    four = cut_in_four(one, camera, np.ones((96, 96), bool))
    np.testing.assert_allclose(sorted(np.abs(four.means[:, 0])), [0.22] * 4, rtol=1e-5)
    np.testing.assert_allclose(four.scales, [[0.22, 0.11, 0.01]] * 4, rtol=1e-5)


def test_fine_gaussians_follow_a_sharp_edge_better_than_coarse_ones() -> None:
    splats, camera = sheet(20), front(96)
    mask = disk(camera, 48, 48, 15)
    target = np.where(mask[..., None], RED, drawn(splats, camera))
    coarse, fine = (edit(splats, camera, target, mask) for edit in (color_rounds, split_and_color))
    assert psnr(drawn(fine, camera), target, mask) > psnr(drawn(coarse, camera), target, mask) + 1


def test_specks_are_nearer_to_the_old_colour_by_a_margin() -> None:
    old, new = np.zeros(3), np.array([0.9, 0.0, 0.0])
    colors = np.array([[0.0, 0, 0], [0.29, 0, 0], [0.31, 0, 0], [0.9, 0, 0]])
    assert specks(colors, old, new).tolist() == [True, True, False, False]
    hits, among = np.array([True, True, False, False]), np.array([True, False, True, True])
    assert percent(hits, among) == pytest.approx(100 / 3)
    assert percent(hits, among & False) is None


def test_figures_of_edits_whose_faults_are_known() -> None:
    case, right = painted_sheet()
    truth = Truth.of(case)

    def figures(splats: Splats) -> dict[str, Any]:
        return truth.scores(render(splats, truth.cameras), None)

    nothing, perfect = figures(case.asset), figures(right)
    assert nothing["specks"] == 100 and nothing["unpainted"] == 100 and nothing["lpips"] is None
    assert perfect["specks"] == 0 and perfect["unpainted"] == 100 and perfect["novel"] == 100
    assert all(f["cracks"] == f["see_through"] == 0 for f in (nothing, perfect))
    # Every ninth painted Gaussian left as it was: specks, and little else. The picture is soft, so is what they do.
    speckled = figures(in_red(case.asset, (np.hypot(*case.asset.means[:, :2].T) < 0.45) & (np.arange(3600) % 3 > 0)))
    assert 1 < speckled["specks"] < 60 and speckled["unpainted"] == 100
    assert speckled["soft"] > speckled["novel"]
    # A hole: the background shows. With a wall far behind it, alpha stays and the depth tells.
    hole = right.take(np.hypot(right.means[:, 0] - 0.1, right.means[:, 1]) > 0.2)
    assert figures(hole)["cracks"] > 1
    wall = sheet(60, z=-1.0, half=2.5)
    walled = Truth.of(replace(case, asset=case.asset.append(wall)))
    through: dict[str, Any] = walled.scores(render(hole.append(wall), walled.cameras), None)
    assert through["cracks"] == 0 and through["see_through"] > 1


def test_every_method_beats_nothing() -> None:
    case, _ = painted_sheet()
    chosen = {name: method for name, method in methods("lift").items() if name not in ("fit", "network")}
    lines, strips = measure_case(case, chosen, None)
    soft = {line.method: line.soft or 0.0 for line in lines}
    assert list(soft) == ["nothing", "rounds", "split", "lift", "auto"]
    assert all(soft[name] > soft["nothing"] + 8 for name in soft if name != "nothing")
    aside = {line.method: line.aside or 0.0 for line in lines}
    assert all(aside[name] > aside["nothing"] + 5 for name in aside if name != "nothing")
    assert lines[0].added == 0 and lines[2].added > 0 and all(line.seconds >= 0 for line in lines)
    assert len(strips) == 6 and all(len(strip.cells) == 3 for strip in strips)
    assert strips[0].cells[0][1].shape[:2] == (96, 96)  # the paint's window, at least MIN_CELL_PX


def test_the_note_about_the_score_from_the_side_is_its_rank_correlation() -> None:
    one = painted.PaintedScore("a", "lift", 1.0, 1.0, 1.0, None, 1.0, 0.0, 0.0, 0.0, 1.0, 0, 0.1)
    rising = [replace(one, novel=float(k), soft=-float(k), aside=float(k**3)) for k in range(6)]
    ignored = [replace(one, method="nothing", aside=99.0), replace(one, aside=None)]
    (note,) = painted.aside_notes([*rising, *ignored])
    assert note.endswith("novel 1.00, soft -1.00.")
    assert painted.aside_notes(rising[:5]) == []


def test_bench_painted_writes_its_tables_and_keeps_its_cases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatpainter.system.user_folders.cache_folder", lambda: tmp_path / "cache")
    config = PaintedBench(
        methods=("nothing", "rounds"), objects=1, size=96, rows=1500, novel_views=2, out=tmp_path / "out"
    )
    means = painted.run(config)
    assert [row.method for row in means] == ["nothing", "rounds"] and means[0].objects == 1
    assert means[1].soft is not None and means[0].soft is not None and means[1].soft > means[0].soft + 3
    heading, *table = (tmp_path / "out" / "painted.csv").read_text().splitlines()
    rows = list(csv.DictReader(table))
    assert heading.startswith("# ") and list(rows[0]) == [field.name for field in fields(painted.PaintedScore)]
    assert float(rows[1]["soft"]) == means[1].soft and math.isfinite(float(rows[1]["novel"]))
    assert "| rounds | 1 |" in (tmp_path / "out" / "painted.md").read_text()
    with Image.open(tmp_path / "out" / "sheet.png") as page:
        assert len(page.getcolors(page.width * page.height) or []) > 500
    # Again: the same case, not made anew.
    monkeypatch.setattr("splatbench.painted_cases.make_case", lambda *_: pytest.fail("was in the cache"))
    assert painted.run(replace(config, methods=("nothing",)))[0].soft == means[0].soft


@pytest.mark.parametrize(
    "wrong, message",
    [
        (
            {"methods": ("nothing", "magic")},
            "--methods of nothing, rounds, split, lift, fit, auto, network, got 'magic'",
        ),
        ({"methods": ("network",), "preset": "lift"}, "needs a preset with trained weights"),
        ({"methods": ()}, "at least one of --methods"),
        ({"size": 32}, "--size of at least 64"),
        ({"novel_views": 0}, "--novel-views"),
        ({"meshes": Path("nowhere")}, "meshes: nowhere: no such folder"),
    ],
)
def test_bench_painted_refuses_what_makes_no_sense(tmp_path: Path, wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        painted.run(PaintedBench(**{"preset": "lift", "out": tmp_path / "out", **wrong}))
    assert not (tmp_path / "out").exists()
