"""`bench spread`: its figures against what is known by hand, which objects it takes, and once from start to end."""

from __future__ import annotations

import csv
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from splatbench import spread
from splatbench.cases import Setup
from splatbench.spread import SpreadBench, SpreadScore, masked_psnr, mean_scores, measure_case, surface_iou
from splatbench.spread_cases import SpreadCase, Stroke, chosen_names, material_share, partial_stroke

from splatpainter.image_files import to_uint8
from splatpainter.rendering import render
from tests.support.spread_scenes import CAMERA, SIDE, board, left_half, painted_picture


def test_a_partial_stroke_is_round_and_covers_its_share() -> None:
    mask = left_half()
    stroke = partial_stroke(mask, np.random.default_rng(0))
    assert stroke.sum() == round(0.3 * mask.sum()) and not (stroke & ~mask).any()


def test_intersection_over_union_weighs_areas() -> None:
    splats = board()
    left = splats.means[:, 0] < 0
    assert surface_iou(splats, left, left) == 1 and surface_iou(splats, left, ~left) == 0
    larger = replace(splats, scales=np.where(left[:, None], splats.scales, 2 * splats.scales))
    assert surface_iou(larger, np.ones_like(left), left) == pytest.approx(1 / 5, abs=1e-6)


def test_psnr_is_over_all_masked_pixels_together() -> None:
    truth = np.zeros((2, 10, 10, 3))
    mask = np.ones((2, 10, 10), bool)
    assert masked_psnr(truth + 0.1, truth, mask) == pytest.approx(20)
    mask[:, 1:] = False
    assert masked_psnr(truth, truth, mask) is None


def test_pixel_shares_of_materials_are_those_of_the_nearest_surfels() -> None:
    points = np.random.default_rng(0).random((2000, 3))
    means = np.array([[0.2, 0.5, 0.5], [0.8, 0.5, 0.5]])
    np.testing.assert_array_equal(material_share(means, points, points[:, 0] < 0.5), [1, 0])


def case() -> SpreadCase:
    """The board; its truth is itself with the left material recoloured, seen from behind."""
    splats = board()
    behind = replace(CAMERA, world_to_camera=CAMERA.world_to_camera @ np.diag([-1.0, 1, -1, 1]))
    before = np.clip(render(splats, behind).colors, 0, 1)
    after = painted_picture(splats, behind)[None]
    unseen = np.abs(after - before).max(-1) > 0.1
    share = (splats.means[:, 0] < 0).astype(np.float32)
    masks: dict[Stroke, np.ndarray] = {
        "full": left_half(),
        "partial": partial_stroke(left_half(), np.random.default_rng(1)),
    }
    facts = {"materials": "of the file", "separable": 1.0}
    picture = to_uint8(painted_picture(splats))
    return SpreadCase("board", splats, CAMERA, picture, masks, share, (behind,), before, after, unseen, facts)


def test_spread_reaches_the_back_and_the_lift_does_not() -> None:
    lines, strips = measure_case(case())
    assert [line.stroke for line in lines] == ["full", "partial"] and len(strips) == 3
    for line in lines:
        assert line.iou > 0.9 and line.lift is not None and line.spread is not None
        assert line.spread > line.lift + 8 and line.reached_partial == (line.stroke == "partial")
    means = mean_scores([*lines, replace(lines[0], object="other", separable=0.5, iou=0.0)])
    assert [(row.stroke, row.cases, row.objects) for row in means] == [
        ("full", "all", 2), ("full", "separable", 1), ("partial", "all", 1), ("partial", "separable", 1),
    ]  # fmt: skip
    assert means[0].iou == pytest.approx(lines[0].iou / 2) and means[1].iou == lines[0].iou
    strict, _ = measure_case(case(), threshold=1.0)
    assert strict[0].iou < 0.1 and len(board()) == 2 * SIDE**2


def test_bench_spread_writes_its_tables(tmp_path: Path) -> None:
    config = SpreadBench(objects=1, size=64, rows=1200, novel_views=2, seed=5, out=tmp_path / "out")
    means = spread.run(config)
    assert means and means[0].stroke == "full" and 0 <= means[0].iou <= 1
    heading, *table = (tmp_path / "out" / "spread.csv").read_text().splitlines()
    rows = list(csv.DictReader(table))
    assert heading.startswith("# ") and list(rows[0]) == [field.name for field in fields(SpreadScore)]
    assert (tmp_path / "out" / "sheet.png").stat().st_size > 1000
    assert "| full | all | 1 |" in (tmp_path / "out" / "spread.md").read_text()


def test_tuning_and_held_out_meshes_are_apart(tmp_path: Path) -> None:
    for k in range(60):
        (tmp_path / f"mesh{k}.obj").write_text("v 0 0 0")
    held, tuned = (set(chosen_names(Setup(data=tmp_path, held_out=held_out))) for held_out in (True, False))
    assert held and tuned and not held & tuned and len(held | tuned) == 60


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"size": 32}, "--size of at least 64"), ({"meshes": Path("nowhere")}, "meshes: nowhere: no such folder")],
)
def test_bench_spread_refuses_what_makes_no_sense(tmp_path: Path, wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        spread.run(SpreadBench(**{"out": tmp_path / "out", **wrong}))
    assert not (tmp_path / "out").exists()
