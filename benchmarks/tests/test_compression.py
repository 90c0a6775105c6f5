"""Tab. 4: Stage I's rows and how they are scored."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatbench.cases import Budget, Case, EditStep, PosedImages, Setup
from splatbench.methods import EditResult, EditTask, reconstruction
from splatbench.tables import compression as compress

from splatpainter.cameras import orbit
from splatpainter.models.config import ModelConfig
from splatpainter.rendering import render
from splatpainter.splats import SH_C0
from tests.support.lift_scenes import sheet
from tests.support.painter_scenes import built
from tests.support.train_scenes import SMALL

ROWS = {method.name: method for method in reconstruction.METHODS}
COPY = replace(SMALL, representation="copy", refine=replace(SMALL.refine, lift_features=False))
TABLE = compress.TABLE


def case() -> Case:
    """A sheet whose truth is its own render, 0.1 brighter."""
    asset = sheet(20, degree=1)
    cameras = tuple(replace(c, background=(0.5, 0.5, 0.5)) for c in orbit((0, 0, 0), 3.0, 2, width=32, height=32))
    drawn = render(asset, list(cameras))
    base = PosedImages(cameras, drawn.colors)
    truth = PosedImages(cameras, np.where(drawn.alphas > 0, drawn.colors + np.float32(0.1), 0.5).astype(np.float32))
    step = EditStep("global", "plain", base, drawn.alphas[..., 0] > 0.5)
    near = np.zeros(len(cameras), bool)
    return Case("compress", "sheet", "sheet-compress", asset, base, (step,), truth, truth, near)


def work(sheet_case: Case) -> EditTask:
    return EditTask(sheet_case.protocol, sheet_case.asset, sheet_case.base, sheet_case.steps[0])


def weights(folder: Path, config: ModelConfig) -> str:
    built(config).save(folder, dtype="float32")
    return str(folder)


def test_scores_are_against_the_truth_and_against_the_asset() -> None:
    sheet_case = case()
    numbers = {"gaussians_before": 8000.0, "gaussians_kept": 2000.0, "voxels": 900.0}
    figures = TABLE.score(sheet_case, [EditResult(sheet_case.asset, 0, 0, numbers=numbers)], None)
    assert figures["psnr"] == pytest.approx(20.0, abs=1e-3)  # 0.1 everywhere on the object: -20 log10 0.1
    assert figures["psnr_asset"] == 100.0 and figures["lpips"] is None  # its own render
    assert figures["ssim"] is not None and 0.5 < figures["ssim"] < 1
    assert {name: figures[name] for name in numbers} == numbers and figures["share_kept"] == 0.25
    # Colours that are 0.1 brighter where Gaussians are opaque: the truth is met, the asset no longer.
    sh = sheet_case.asset.sh.copy()
    sh[:, 0] += np.float32(0.1 / SH_C0)
    brighter = TABLE.score(sheet_case, [EditResult(replace(sheet_case.asset, sh=sh), 0, 0)], None)
    assert brighter["psnr"] is not None and brighter["psnr"] > 25 and brighter["psnr_asset"] == pytest.approx(20, abs=2)
    assert brighter["voxels"] is None and brighter["share_kept"] is None
    assert {column.key for column in TABLE.columns} <= set(figures)


def test_the_sheet_shows_a_view_beside_its_truth() -> None:
    sheet_case = case()
    pictures = TABLE.pictures(sheet_case, [EditResult(sheet_case.asset, 0, 0)])
    assert list(pictures) == ["result", "truth"]
    np.testing.assert_allclose(pictures["result"], np.clip(sheet_case.base.colors[0], 0, 1), atol=1e-6)


def test_without_weights_the_rows_say_how_to_get_them() -> None:
    for name in ("voxel-att", "latent-query", "feats-query"):
        line = ROWS[f"stage1-{name}"].missing(Budget())
        assert line.startswith("no weights: train with `splatpainter train compress --model.representation copy")
        assert line.endswith(f"--weights {name}=FOLDER")


@pytest.mark.parametrize("name", reconstruction.GROUPINGS)
def test_each_grouping_keeps_a_quarter_of_each_voxel(tmp_path: Path, name: str) -> None:
    grouping = reconstruction.GROUPINGS[name][0]
    config = replace(COPY, compress=replace(COPY.compress, grouping=grouping, keep=0.25))
    budget = Budget(weights={name: weights(tmp_path, config)})
    row = ROWS[f"stage1-{name}"]
    assert row.missing(budget) == ""
    done = row.edit(work(case()), budget)
    before, count, voxels = (done.numbers[n] for n in ("gaussians_before", "gaussians_kept", "voxels"))
    assert len(done.splats) == count == done.numbers["latents"] and not done.keeps_gaussians
    assert voxels <= count <= max(before / 4 + voxels, voxels) < before  # max(floor(N / 4), 1) of each
    assert done.edit_seconds == 0 < done.setup_seconds
    assert done.note == f"from 2 canonical renders of 32 px; weights '{name}'"


def test_before_compression_is_the_lrm_of_the_rows_beside_it(tmp_path: Path) -> None:
    config = replace(COPY, compress=replace(COPY.compress, keep=0.25))
    folder = weights(tmp_path, config)
    before = ROWS["stage1-before"].edit(work(case()), Budget(weights={"feats-query": folder}))
    after = ROWS["stage1-feats-query"].edit(work(case()), Budget(weights={"feats-query": folder}))
    # An untrained residual decoder leaves the kept Gaussians as they are: the most opaque of each voxel.
    means = {mean.tobytes() for mean in before.splats.means}
    unchanged = [mean.tobytes() in means for mean in after.splats.means]
    faint = float(after.splats.opacities.max())
    assert np.mean(unchanged) > 0.9 and faint == pytest.approx(float(before.splats.opacities.max()))
    assert before.numbers["gaussians_before"] == before.numbers["gaussians_kept"] == len(before.splats)
    assert before.numbers["voxels"] <= len(before.splats)
    with_shipped = ROWS["stage1-before"].edit(work(case()), Budget(weights={"compact": folder}))
    assert len(with_shipped.splats) == len(before.splats) and "'compact'" in with_shipped.note


def test_lrms_without_geometry_are_shown_the_base_views(tmp_path: Path) -> None:
    config = replace(COPY, lrm=replace(COPY.lrm, geometry=False, views=2))
    budget = Budget(weights={"feats-query": weights(tmp_path, config)})
    done = ROWS["stage1-before"].edit(work(case()), budget)
    assert done.note.startswith("from 2 base views of 32 px")
    few = replace(work(case()), base=case().base.take([0]))
    with pytest.raises(ValueError, match="expected 2 base views"):
        ROWS["stage1-before"].edit(few, budget)


def test_a_case_is_made_of_a_held_out_object_and_nothing_is_edited() -> None:
    setup = Setup(
        objects=1, size=32, detail=1, truth="surfels", base_views=3, rows=300, asset_steps=0, novel_views=2, lights=1
    )
    (key,) = TABLE.keys(setup)
    made = TABLE.make(key, setup)
    assert made.name == key.name and made.label == key.label and len(made.asset) <= 300
    assert made.after is made.before and len(made.after) == 2 and not made.near.any()
    step = made.steps[0]
    assert step.mode == "global" and step.kind == "plain" and step.edited is made.base and len(step.edited) == 3
    assert 0.02 < step.masks.mean() < 0.95
    # What the asset shows from new sides is like the truth: the conventions of both agree.
    figures = TABLE.score(made, [EditResult(made.asset, 0, 0)], None)
    grey = TABLE.score(made, [EditResult(replace(made.asset, sh=np.zeros_like(made.asset.sh)), 0, 0)], None)
    assert figures["psnr"] is not None and grey["psnr"] is not None and figures["psnr_asset"] == 100.0
    again = TABLE.make(key, setup)
    assert np.array_equal(again.asset.means, made.asset.means) and np.array_equal(again.base.colors, made.base.colors)
