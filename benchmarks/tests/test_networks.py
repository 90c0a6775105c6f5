"""Rows of the package itself: the lift, Stage II with trained weights, and reconstruction in one pass."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from splatbench.cases import Budget, EditStep, PosedImages
from splatbench.methods import EditResult, EditTask, Method, lift, reconstruction, ttt
from splatbench.methods.lift import painted
from splatbench.methods.weights import SHIPPED, Weights

from splatpainter.cameras import Camera, orbit
from splatpainter.lift.options import LocalOptions
from splatpainter.models import checkpoint
from splatpainter.models.config import PredictConfig
from splatpainter.models.local_network import LocalNetwork
from splatpainter.models.lrm import DEPTH_REACH, AssetViews, patchify
from splatpainter.models.model import SplatPainterModel
from splatpainter.nn.precision import autocast
from splatpainter.painter import Edit, EditSettings, Mode, Painter
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, Splats, changed_rows
from splatpainter.voxels.grid import bounding_cube
from splattrain.commands import train
from tests.models.test_local_network import CONFIG as LOCAL_CONFIG
from tests.support.lift_scenes import db
from tests.support.model_scenes import TINY, with_compress, with_refine
from tests.support.painter_scenes import BLUE, CAMERA, GREEN, LIFT, REAR, RED, built, dab, grade, thing
from tests.support.train_scenes import SMALL

ROWS = {method.name: method for method in (*lift.METHODS, *ttt.METHODS, *reconstruction.METHODS)}
AWAKE = 0.002
"""Spread of a head that says a little."""


def pictures(splats: Splats, cameras: tuple[Camera, ...]) -> PosedImages:
    return PosedImages(cameras, render(splats, list(cameras)).colors.astype(np.float32))


def work(edit: Edit, mode: Mode = "local", state: object = None, splats: Splats | None = None) -> EditTask:
    asset = thing() if splats is None else splats
    assert edit.mask is not None or mode == "global"
    mask = np.ones(edit.image.shape[:2], bool) if edit.mask is None else edit.mask
    step = EditStep(mode, "stroke", PosedImages((edit.camera,), edit.image[None]), mask[None])
    return EditTask("creative", asset, pictures(asset, (CAMERA, REAR)), step, state=state)


def saved(model: SplatPainterModel, folder: Path) -> str:
    model.save(folder, dtype="float32")
    return str(folder)


def row_of(name: str) -> Method:
    return ROWS[name]


def same(a: Splats, b: Splats) -> bool:
    return all(np.array_equal(getattr(a, n).view(np.int32), getattr(b, n).view(np.int32)) for n in ATTRIBUTES)


def test_the_lift_paints_what_is_seen_and_leaves_the_other_sheet_bit_for_bit() -> None:
    asset = thing()
    paint = dab(asset, RED)
    done = row_of("lift").edit(work(paint), Budget())
    assert paint.mask is not None and done.keeps_gaussians
    before, after = (render(s, CAMERA).colors[0] for s in (asset, done.splats))
    assert db(after, paint.image, paint.mask) > db(before, paint.image, paint.mask) + 6
    touched = changed_rows(asset, done.splats)
    assert 0 < len(touched) < 200
    assert touched.max() < 900  # the sheet behind, and Gaussians that cannot be drawn


def test_seconds_are_those_of_the_stages_without_the_proof() -> None:
    done = row_of("lift").edit(work(dab(thing(), RED)), Budget())
    stages = {name: value for name, value in done.numbers.items() if name.startswith("seconds_")}
    assert set(stages) == {"seconds_prepare", "seconds_lift", "seconds_receipt"}
    assert done.edit_seconds == pytest.approx(stages["seconds_prepare"] + stages["seconds_lift"])
    assert done.setup_seconds > 0


def test_a_second_step_starts_from_the_first() -> None:
    asset = thing()
    first = row_of("lift").edit(work(dab(asset, RED, x=20)), Budget())
    second = row_of("lift").edit(work(dab(first.splats, BLUE, x=44), state=first.state), Budget())
    assert second.setup_seconds == 0
    drawn = render(second.splats, CAMERA).colors[0]
    assert drawn[32, 20, 0] > drawn[32, 20, 2] + 0.3 and drawn[32, 44, 2] > drawn[32, 44, 0] + 0.3


@pytest.mark.parametrize("mode", ["local", "global"])
def test_untrained_weights_on_the_lift_are_the_lift(tmp_path: Path, mode: Mode) -> None:
    budget = Budget(weights={"compact": saved(built(LIFT), tmp_path)})
    assert row_of("ttt").missing(budget) == ""
    task = work(dab(thing(), GREEN) if mode == "local" else grade(thing()), mode)
    lifted = painted(
        Painter(settings=EditSettings(local_options=LocalOptions(resurface=False))), "lift", task
    )  # as networks know it
    ours = row_of("ttt").edit(task, budget)
    assert same(lifted.splats, ours.splats) and ours.keeps_gaussians
    assert {"seconds_encode", "seconds_ttt"} <= set(ours.numbers)


def test_weights_that_leave_local_edits_to_the_lift_have_no_row_there(tmp_path: Path) -> None:
    config = with_refine(LIFT, answers="teachers", picture_tokens=False, row_tokens=64, base="own")
    budget = Budget(weights={"compact": saved(built(config), tmp_path)})
    with pytest.raises(ValueError, match="for global edits only"):
        row_of("ttt").edit(work(dab(thing(), GREEN)), budget)
    assert row_of("ttt").edit(work(grade(thing()), "global"), budget).note == ""


def test_fast_weights_go_on_to_the_next_step_and_polish_comes_after_the_network(tmp_path: Path) -> None:
    budget = Budget(weights={"compact": saved(built(LIFT, awake=AWAKE), tmp_path)})
    first = row_of("ttt").edit(work(grade(thing()), "global"), budget)
    again = grade(first.splats)
    state = first.state.encoding.state.blocks[0]
    second = row_of("ttt").edit(work(again, "global", state=first.state), budget)
    assert second.setup_seconds == 0
    assert not torch.equal(second.state.encoding.state.blocks[0].w0, state.w0)
    task = work(dab(thing(), RED))
    far = Budget(weights={"compact": saved(built(LIFT, awake=25 * AWAKE), tmp_path / "far")})  # leaves much to polish
    plain, polished = (row_of(name).edit(task, far) for name in ("ttt", "ttt-polish"))
    errors = [db(render(d.splats, CAMERA).colors[0], task.step.edited.colors[0]) for d in (plain, polished)]
    assert errors[1] > errors[0] and "polished" in polished.note


def test_rows_of_the_networks_apart(tmp_path: Path) -> None:
    """Global edits by test-time training go on from the state of those before; local ones by the local network; what
    either does not make the lift does, and says so."""
    config = with_refine(LIFT, answers="teachers", picture_tokens=False, row_tokens=64, base="own")
    LocalNetwork(LOCAL_CONFIG).save(tmp_path / "local")
    weights = {"rows": saved(built(config), tmp_path / "rows"), "local": str(tmp_path / "local")}
    budget, globally, locally = Budget(weights=weights), row_of("ttt-global"), row_of("network")
    assert globally.missing(budget) == locally.missing(budget) == ""
    first = globally.edit(work(grade(thing()), "global"), budget)
    paint = globally.edit(work(dab(first.splats, GREEN), state=first.state), budget)
    assert "the lift alone" in paint.note
    second = globally.edit(work(grade(paint.splats), "global", state=paint.state), budget)
    moved = [result.state.encoding.state.so_far.moved for result in (first, paint, second)]
    assert moved[0].any() and np.array_equal(moved[0], moved[1]) and not np.array_equal(moved[1], moved[2])
    assert "earlier global edits" in second.note and "earlier" not in first.note
    done = locally.edit(work(dab(thing(), RED)), budget)
    assert done.keeps_gaussians and "seconds_ttt" in done.numbers
    assert "the lift alone" in locally.edit(work(grade(thing()), "global"), budget).note
    assert "of no model whose Stage II carries" in globally.missing(
        Budget(weights={"rows": saved(built(LIFT), tmp_path / "lift")})
    )


def test_cross_attention_wants_a_model_of_its_kind(tmp_path: Path) -> None:
    method = row_of("cross-attention")
    assert method.missing(Budget()).startswith(
        "no weights: train with `splatpainter train rows --recipe compact --model.refine.mixer"
    )
    ttt = Budget(weights={"cross-attention": saved(built(LIFT), tmp_path / "ttt")})
    assert "of no model with refine.mixer cross_attention" in method.missing(ttt)
    with pytest.raises(ValueError, match="cross_attention"):
        method.edit(work(dab(thing(), RED)), ttt)
    config = with_refine(LIFT, mixer="cross_attention")
    fit = Budget(weights={"cross-attention": saved(built(config, awake=AWAKE), tmp_path / "cross")})
    assert method.missing(fit) == ""
    done = method.edit(work(dab(thing(), RED)), fit)
    assert done.state.encoding.state.blocks[0].shape[1] == config.compress.dim  # tokens, not fast weights


def test_cross_attention_is_stage_two_beside_a_predictor(tmp_path: Path) -> None:
    """As `train rows` leaves it: global edits are those of the same Stage II in a model without a predictor."""
    config = with_refine(
        LIFT, mixer="cross_attention", answers="teachers", picture_tokens=False, row_tokens=64, base="own"
    )
    both = built(replace(config, predict=PredictConfig(features=8, hidden=16, alone=True)), awake=AWAKE)
    stage2 = SplatPainterModel(config)
    stage2.load_state_dict({k: v for k, v in both.state_dict().items() if not k.startswith("predictor.")})
    task = work(grade(thing()), "global")
    done = row_of("cross-attention").edit(task, Budget(weights={"cross-attention": saved(both, tmp_path / "both")}))
    assert "predictor" not in done.note
    assert same(done.splats, painted(Painter(model=stage2.eval()), "ttt", task).splats)
    assert not same(done.splats, row_of("lift").edit(task, Budget()).splats)
    assert not same(done.splats, painted(Painter(model=both), "ttt", task).splats), "which is the predictor's"


def test_versions_follow_the_weights_and_nothing_else(tmp_path: Path) -> None:
    model, needed = built(LIFT), SHIPPED
    budget = Budget(weights={"compact": saved(model, tmp_path)})
    first = needed.version(budget)
    model.save(tmp_path, dtype="float32", notes={"gain": {"local": 1.0}})
    assert needed.version(budget) == first
    with torch.no_grad():
        model.head.linear.bias[0] = 1e-3
    saved(model, tmp_path)
    assert needed.version(budget) != first
    assert needed.load(budget).head.linear.bias[0].item() == pytest.approx(1e-3)  # not the one read before
    text = json.loads((tmp_path / "model.json").read_text())
    text["config"]["refine"].pop("blocks")
    (tmp_path / "model.json").write_text(json.dumps(text))
    problem = needed.missing(budget)
    assert "refine.blocks" in problem and str(tmp_path) not in problem and "\n" not in problem
    assert needed.version(budget).endswith("none")
    (tmp_path / "model.json").unlink()
    assert "expected a folder with model.json" in needed.missing(budget)


def ring(count: int, size: int = 32, background: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> tuple[Camera, ...]:
    return tuple(replace(c, background=background) for c in orbit((0, 0, 0), 3.0, count, width=size, height=size))


def lrm_work(base: int = 3, size: int = 32) -> EditTask:
    asset = thing()
    near = replace(ring(1, size)[0], fx=2.0 * ring(1, size)[0].fx, fy=2.0 * ring(1, size)[0].fy)
    step = EditStep("local", "zoom", pictures(asset, (near,)), np.ones((1, size, size), bool))
    return EditTask("refine", asset, pictures(asset, ring(base, size)), step)


def test_the_lrm_puts_the_pixels_of_all_views_on_the_asset(tmp_path: Path) -> None:
    model = built(SMALL)
    budget = Budget(weights={"compact": saved(model, tmp_path)})
    task = lrm_work()
    done = row_of("lrm").edit(task, budget)
    drawn = render(task.asset, [*task.base.cameras, *task.step.edited.cameras])
    assert len(done.splats) == int((drawn.alphas > 0.1).sum()) and not done.keeps_gaussians and done.setup_seconds == 0
    # Every Gaussian lies on its ray near the depth drawn there: on one of the two sheets, or between them.
    slack = 2 * DEPTH_REACH * bounding_cube(task.asset)[1] / 2
    assert done.splats.means[:, 2].max() < slack and done.splats.means[:, 2].min() > -0.6 - slack
    # Even an untrained head shows the input: colours are told, not guessed.
    again = render(done.splats, task.base.cameras[0]).colors[0]
    solid, target = drawn.alphas[0, ..., 0] > 0.9, task.base.colors[0]
    assert db(again, target, solid) > db(np.full_like(target, 0.5), target, solid) + 4
    assert "4 views of 32 px" in done.note


def test_views_of_one_focal_length_are_the_models_own_copy() -> None:
    model = built(SMALL).eval()
    views = reconstruction.all_views(model, lrm_work(), pictures(thing(), ring(2)[1:]))
    with torch.no_grad():
        copied, ours = model.copied_gaussians(views), reconstruction.dense(model, views)
    assert np.array_equal(copied.links.patches, ours.links.patches)
    for name in ATTRIBUTES:
        torch.testing.assert_close(getattr(ours.gaussians, name), getattr(copied.gaussians, name))


def test_gaussians_of_a_close_up_are_as_small_as_its_pixels() -> None:
    model = built(SMALL).eval()
    task = lrm_work()
    views = reconstruction.all_views(model, task, task.step.edited)
    with torch.no_grad():
        predicted, ours = model.lrm(views).splats, reconstruction.dense(model, views)
    finer = torch.from_numpy(ours.links.patches[:, 0]) >= 3 * 16  # patches of the fourth view, with twice the focal
    close = ours.gaussians.scales[finer]
    assert views.alpha is not None
    alike = predicted.scales[(model.lrm.config.patch**2) * 3 * 16 :]
    alike = alike[patchify(views.alpha[3:], 8).reshape(-1) > 0.1]
    torch.testing.assert_close(2 * close, alike, rtol=1e-4, atol=0)


def test_pictures_for_the_lrm_lie_before_black_as_in_training() -> None:
    """A pixel is surface colour + (1 - alpha) background; before black, the surface's part alone remains."""
    task = lrm_work()
    views = reconstruction.all_views(built(SMALL), task, task.step.edited)
    black = render(task.asset, [replace(camera, background=(0, 0, 0)) for camera in views.cameras])
    np.testing.assert_allclose(views.colors.numpy(), np.clip(black.colors, 0, 1), atol=2e-6)


def test_base_views_give_way_where_there_are_too_many() -> None:
    edited = pictures(thing(), ring(4))
    views = reconstruction.all_views(built(SMALL), lrm_work(base=15), edited)
    assert isinstance(views, AssetViews) and len(views.cameras) == 16
    np.testing.assert_array_equal(views.cameras[-1].position, edited.cameras[-1].position)
    with pytest.raises(ValueError, match="at most 16 edited views"):
        reconstruction.all_views(built(SMALL), lrm_work(), pictures(thing(), ring(17)))
    with pytest.raises(ValueError, match="32x32 and 16x16"):
        reconstruction.all_views(built(SMALL), lrm_work(), pictures(thing(), ring(1, 16)))


def test_large_pictures_are_averaged_down_with_their_cameras() -> None:
    camera = replace(ring(1, 256)[0])
    steps = np.arange(256, dtype=np.float32)
    ramp = np.broadcast_to(steps[None, None, :, None] / 256, (1, 256, 256, 3))
    small = reconstruction.sized(PosedImages((camera,), np.array(ramp)), SMALL.lrm)
    assert small.colors.shape == (1, 64, 64, 3) and small.cameras[0].fx == pytest.approx(camera.fx / 4)
    np.testing.assert_allclose(small.colors[0, 5, :, 1], (4 * np.arange(64) + 1.5) / 256, atol=1e-6)
    fits = PosedImages(ring(1, 32), np.zeros((1, 32, 32, 3), np.float32))
    assert reconstruction.sized(fits, SMALL.lrm) is fits
    odd = PosedImages((replace(camera, width=50, height=30),), np.zeros((1, 30, 50, 3), np.float32))
    assert reconstruction.sized(odd, SMALL.lrm).colors.shape == (1, 24, 48, 3)  # whole patches


def test_stage_one_keeps_a_quarter_of_every_voxel_and_later_steps_see_earlier_views(
    tmp_path: Path, precision: str
) -> None:
    config = replace(with_refine(SMALL, lift_features=False), representation="copy")
    model = built(config)
    budget = Budget(weights={"copy": saved(model, tmp_path)})
    method, task = row_of("stage-1"), lrm_work()
    done = method.edit(task, budget)
    views = reconstruction.all_views(model, task, task.step.edited)
    with torch.no_grad(), autocast("cpu", precision):
        gaussians = reconstruction.dense(model, views).gaussians.numpy()
    lo, size = bounding_cube(gaussians)
    cells = np.clip(
        np.floor((gaussians.means - lo) / size * config.compress.resolution), 0, config.compress.resolution - 1
    )
    _, counts = np.unique(cells.astype(int), axis=0, return_counts=True)
    count = int(np.maximum(counts // 4, 1).sum())
    assert done.numbers["gaussians_before"] == len(gaussians) and done.numbers["voxels"] == len(counts)
    assert done.numbers["gaussians_kept"] == done.numbers["latents"] == len(done.splats) == count
    more = replace(task, state=done.state)
    assert len(method.edit(more, budget).state) == 2


def test_native_weights_are_no_copy(tmp_path: Path) -> None:
    native = Budget(weights={"copy": saved(built(TINY), tmp_path)})
    assert "of no model of representation copy" in row_of("stage-1").missing(native)


@pytest.mark.parametrize(
    "needed",
    [
        ttt.CROSS,
        reconstruction.COPY,
        *map(reconstruction.grouping_weights, reconstruction.GROUPINGS),
    ],
    ids=lambda n: n.names[0],
)
def test_how_to_train_what_is_missing_is_a_command_line_that_works(needed: Weights) -> None:
    trains(needed.train)


def trains(words: str) -> None:
    """Everything about it is right but that no data is named."""
    with pytest.raises(ValueError, match="--data is missing"):
        train.dispatch(words.replace("STAGE_ONE", "somewhere").split())


def test_groupings_are_told_apart(tmp_path: Path) -> None:
    copy = replace(with_refine(SMALL, lift_features=False), representation="copy")
    folder = saved(built(with_compress(copy, grouping="voxel_mean")), tmp_path)
    assert reconstruction.grouping_weights("voxel-att").missing(Budget(weights={"voxel-att": folder})) == ""
    wrong = reconstruction.grouping_weights("latent-query").missing(Budget(weights={"latent-query": folder}))
    assert "of no model of representation copy with compress.grouping latent_query" in wrong


def test_results_are_plain_splats() -> None:
    done = row_of("lift").edit(work(dab(thing(), RED)), Budget())
    assert isinstance(done, EditResult) and isinstance(done.splats.means, np.ndarray)


def test_a_row_is_named_by_what_makes_its_edits(tmp_path: Path) -> None:
    """The predictor's row is no test-time training, and such a row takes no weights whose global edits are theirs."""
    alone = with_refine(replace(LIFT, predict=PredictConfig(features=8, hidden=16, alone=True)))
    budget = Budget(weights={"compact": saved(built(alone), tmp_path / "alone")})
    task = work(grade(thing()), "global")
    assert "test-time" not in row_of("predictor").edit(task, budget).note
    with pytest.raises(ValueError, match="by their predictor"):
        row_of("ttt").edit(task, budget)
    other_budget = Budget(weights={"compact": saved(built(LIFT), tmp_path / "whole")})
    assert "of no model whose predictor makes global edits" in row_of("predictor").missing(other_budget)
    # The default edit goes by the notes: here no gain was measured, and below it is a loss.
    assert "seconds_ttt" in row_of("auto").edit(task, other_budget).numbers
    checkpoint.add_notes(tmp_path / "whole", {"gain": {"global": -0.1}})
    lifted = row_of("auto").edit(task, Budget(weights={"compact": str(tmp_path / "whole")}))
    assert same(lifted.splats, row_of("lift").edit(task, Budget()).splats)
