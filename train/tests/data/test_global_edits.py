"""Global edits of Gaussians without pictures, and the stage that is trained on them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpainter.lift.colors import MAX_COLOR
from splatpainter.lift.global_edit import lift_global
from splatpainter.lighting import unoccluded_transfer
from splatpainter.models import checkpoint
from splatpainter.models.config import PredictConfig
from splatpainter.models.model import SplatPainterModel
from splatpainter.splats import SH_C0
from splattrain.build import make_task, start
from splattrain.data import global_edits
from splattrain.data.global_edits import GlobalEdit, GlobalEditStream
from splattrain.data.object_sources import ProceduralSource
from splattrain.data.samples import SampleRecipe, SampleStream
from splattrain.recipes import Recipe
from splattrain.stages.predict import PredictTask
from splattrain.training_data import DataSettings, ResourceFolders, open_global_edits
from tests.support.train_scenes import LIFT, FixedSamples, loop, model

SAMPLES = SampleRecipe(
    {"relight": 0.7, "regrade": 0.3}, size=48, rows=400, surfels=4000, base_views=2, novel_views=2, steps_per_object=1
)
SEEING = replace(LIFT, predict=PredictConfig(features=12, hidden=24))
RECIPE = Recipe(
    stage="predict",
    model=SEEING,
    samples=SAMPLES,
    steps=100,
    batch=2,
    learning_rate=1e-2,
    warmup=2,
    average=0.8,
    validate_every=0,
)


@pytest.fixture(autouse=True, scope="module")
def few_lights() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(global_edits, "LIGHT_COUNT", 24)
        yield


@cache
def stream() -> GlobalEditStream:
    return GlobalEditStream(SampleStream(ProceduralSource(2, seed=3), SAMPLES, seed=1), gaussians=300)


@cache
def held() -> tuple[GlobalEdit, ...]:
    return tuple(stream()[i] for i in range(1000, 1012))


def same(one: GlobalEdit, other: GlobalEdit) -> bool:
    arrays = ("normals", "transfer", "observed", "weight", "change", "counts")
    equal = all(np.array_equal(getattr(one, name), getattr(other, name)) for name in arrays)
    return equal and one.kind == other.kind and np.array_equal(one.asset.sh, other.asset.sh)


def test_edits_depend_on_their_number_alone() -> None:
    forth = [stream()[i] for i in range(4)]
    other = GlobalEditStream(SampleStream(ProceduralSource(2, seed=3), SAMPLES, seed=1), gaussians=300)
    assert all(same(forth[i], other[i]) for i in (3, 1, 0))
    assert {forth[0].name, forth[1].name} == {forth[2].name, forth[3].name} and forth[0].name != forth[1].name
    assert not any(same(one, other) for one in forth[:2] for other in forth[2:])
    with pytest.raises(IndexError):
        stream()[-1]


def test_what_they_hold() -> None:
    views, kinds = set(), set()
    for edit in [*held(), *(stream()[i] for i in range(12))]:
        views.add(edit.views)
        kinds.add(edit.kind)
        assert len(edit.asset) == 300 and edit.transfer.shape == (300, 10) and edit.normals.shape == (300, 3)
        seen = edit.weight > 0.05
        assert seen.any() and not edit.observed[~seen].any()
        colors = 0.5 + SH_C0 * edit.asset.sh[:, 0]
        assert np.abs(edit.change).max() > 0.02 and -0.1 < (colors + edit.change).min() < 1.3
        assert edit.counts.min() >= 0 and (edit.counts[seen] > 0).all()
        # What pictures tell is about what happens, but not exactly.
        error = np.abs(edit.observed - edit.change)[seen].mean()
        assert 1e-3 < error < 0.12
        # Turned worlds are turned as a whole: what little is in the way, transfer follows the normals.
        free = edit.transfer[:, 9] > 0.97
        expected = unoccluded_transfer(edit.normals[free]) / np.pi
        assert free.sum() > 20 and np.abs(edit.transfer[free, :9] - expected).mean() < 0.02
    assert views == {1, 2, 4} and kinds == {"relight", "regrade"}


def test_what_is_observed_is_what_the_lift_sees_of_a_real_picture() -> None:
    """The error that is added was measured; under the light of that measurement, the lift is what is observed."""
    prepared = stream()._object(0)
    assert prepared.visible_px.shape[:2] == (3, 4) and prepared.errors.shape[:2] == (3, 3)
    unseen = prepared.visible_px[0][0] <= 0.05  # by the first view of the ring, which one view alone is
    assert unseen.any() and not prepared.errors[0][0][unseen].any()
    assert 0.005 < np.abs(prepared.errors[prepared.errors != 0]).mean() < 0.15


def test_bad_sources() -> None:
    recipe = replace(SAMPLES, kinds={"stroke": 1.0})
    with pytest.raises(ValueError, match="relight or regrade"):
        GlobalEditStream(SampleStream(ProceduralSource(2, seed=3), recipe))
    splats = SampleStream(ProceduralSource(2, seed=3), SAMPLES)
    splats.splats = True
    with pytest.raises(ValueError, match="materials are known"):
        GlobalEditStream(splats)


def test_the_stage_trains_the_predictor_alone_and_learns(tmp_path: Path) -> None:
    run = loop(RECIPE, tmp_path / "run", samples=FixedSamples(stream()), held_out=held())
    assert {name.split(".")[1] for name, p in run.task.named_parameters() if p.requires_grad} == {"predictor"}
    before = run.validate()["all"]
    run()
    after = run.validate()["all"]
    assert after["lift"] == before["lift"] and after["nothing"] == before["nothing"]
    assert after["ours"] > before["ours"] + 0.7
    # What the pictures tell is worth something, and only what they tell of this edit.
    assert after["adapts"] == pytest.approx(after["ours"] - after["strength 0"]) and after["adapts"] > 1
    assert after["another edit"] < after["ours"] - 1 and 0 < after["between Gaussians"] < 1
    columns = (tmp_path / "run" / "validation.csv").read_text().splitlines()[0]
    assert all(f"all {name}" in columns for name in ("strength 0", "adapts", "another edit", "between Gaussians"))
    saved = checkpoint.load(tmp_path / "run" / "model")
    assert saved.notes["stage"] == "predict"
    assert "predictor.describe.weight" in saved.tensors and "refiner.pictures.weight" in saved.tensors


def test_what_it_calls_the_lift_is_the_lift() -> None:
    """The stage's baseline, row by row, against lift_global without the rounds that follow the regression."""
    from splatpainter.lift.depth_normals import outward_normals
    from splatpainter.lift.global_edit import regressed, seen_change
    from splatpainter.lift.options import GlobalOptions
    from splattrain.data.lights import shade
    from splattrain.data.lit_scenes import render_views
    from splattrain.data.surfels import to_splats
    from splattrain.data.viewpoints import Optics, ring

    subject = stream().stream.scene_object(0)
    rng = np.random.default_rng(0)
    cameras = ring(subject.radius, Optics(48), 2, rng)
    old, new = stream()._lights[0][:2], stream()._lights[1][:2]
    assets = []
    for k in range(2):
        light = replace(_uniform(), coefficients=old[k], exposure=new[k])
        assets.append(to_splats(subject.coarse, shade(subject.coarse, light, 1)).numpy())
    shots = render_views(assets[1].torch(), cameras)
    views = [
        (c, p, m) for c, p, m in zip(cameras, shots.views.colors.numpy(), (shots.alphas > 0.5).numpy(), strict=True)
    ]
    normals = outward_normals(assets[0])
    change, weight = seen_change(assets[0], views)
    moved = regressed(assets[0], normals, change, weight)
    lifted = lift_global(assets[0], views, GlobalOptions(last_rounds=0, far_side=0), normals)
    old_colors = 0.5 + SH_C0 * assets[0].sh[:, 0]
    expected = np.clip(old_colors + moved, np.minimum(old_colors, 0), np.maximum(old_colors, MAX_COLOR))
    np.testing.assert_allclose(0.5 + SH_C0 * lifted.splats.sh[:, 0], expected, atol=1e-4)


def _uniform():  # noqa: ANN202
    from splattrain.data.lights import uniform_light

    return uniform_light()


def test_a_model_without_predictor_and_data_without_meshes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="features"):
        make_task(replace(RECIPE, model=LIFT), model(LIFT), None)
    small = replace(SAMPLES, size=24, rows=90, surfels=600)
    data = open_global_edits(DataSettings("procedural:4", small, 0, 0.5, ResourceFolders()), 3)
    assert len(data.validation) == 3 and all(len(edit.asset) == 90 for edit in data.validation)
    names = {edit.name for edit in data.validation}
    assert data.training[0].name not in names


def test_training_it_keeps_the_rest_and_later_stages_keep_it(tmp_path: Path) -> None:
    torch.manual_seed(0)
    held = SplatPainterModel(LIFT)
    torch.nn.init.normal_(held.head.linear.weight, std=0.01)
    held.save(tmp_path / "refined", notes={"stage": "refine"}, dtype="float32")
    torch.manual_seed(5)
    begun = start(RECIPE, tmp_path / "refined", lambda line: None)
    assert torch.equal(begun.head.linear.weight, held.head.linear.weight)
    assert begun.predictor is not None and begun.predictor.stored().is_untrained
    torch.nn.init.normal_(begun.predictor.expected.weight)
    begun.save(tmp_path / "predicting", notes={"stage": "predict"}, dtype="float32")
    again = start(replace(RECIPE, stage="refine"), tmp_path / "predicting", lambda line: None)
    assert again.predictor is not None
    assert torch.equal(again.predictor.expected.weight, begun.predictor.expected.weight)
    assert torch.equal(again.head.linear.weight, held.head.linear.weight)
    # Whether it works alone is a setting: no weight depends on it, and none is lost.
    other = replace(SEEING, predict=replace(SEEING.predict, alone=True))
    for stage in ("refine", "predict"):
        resumed = start(replace(RECIPE, stage=stage, model=other), tmp_path / "predicting", lambda line: None)
        assert resumed.predictor is not None and resumed.config.predictor_only
        assert torch.equal(resumed.predictor.expected.weight, begun.predictor.expected.weight)
    compress = start(replace(RECIPE, stage="compress"), tmp_path / "predicting", lambda line: None)
    assert torch.equal(compress.lrm.patches.weight, held.lrm.patches.weight)
    assert not torch.equal(compress.compressor.attribute.weight, held.compressor.attribute.weight)


def test_stage_two_starts_from_what_it_predicts() -> None:
    samples = SampleStream(ProceduralSource(2, seed=3), replace(SAMPLES, kinds={"regrade": 1.0}, sh_degree=1), seed=1)
    sample = samples[0]
    torch.manual_seed(0)
    net = SplatPainterModel(SEEING)
    task = make_task(replace(RECIPE, stage="refine", perceptual=0.0), net, None)
    assert not isinstance(task, PredictTask) and task.eval().judge(sample).numbers["gain"] == 0
    assert net.predictor is not None
    torch.nn.init.normal_(net.predictor.expected.weight, std=0.2)
    fresh = make_task(replace(RECIPE, stage="refine", perceptual=0.0), net, None).eval()
    numbers = fresh.judge(sample).numbers
    assert numbers["gain"] != 0 and numbers["lift"] == task.judge(sample).numbers["lift"]
