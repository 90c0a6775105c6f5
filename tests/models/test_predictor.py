"""The predictor of unseen Gaussians: what it is told, what it may depend on, and who asks it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpainter.lift.depth_normals import outward_normals
from splatpainter.lift.global_edit import lift_global, regressed, seen_change
from splatpainter.lift.options import LOCAL_DEFAULTS
from splatpainter.lighting import prt_transfer
from splatpainter.models import checkpoint, predictor, stored_predictor, weights
from splatpainter.models.config import PRESETS, ModelConfig, PredictConfig
from splatpainter.models.gaussian_facts import FACTS, gaussian_facts
from splatpainter.models.model import SplatPainterModel
from splatpainter.models.predictor import Predictor
from splatpainter.models.stored_predictor import predicting
from splatpainter.painter import Edit, EditSettings, Painter
from splatpainter.painting.networks import Networks
from splatpainter.splats import Splats
from tests.lift.test_global import BACK, FRONT, SIDE, ball, covered, draw, regraded
from tests.support.model_scenes import TINY

CONFIG = PredictConfig(features=8, hidden=16)
WITH = replace(TINY, predict=CONFIG)


def awake(config: PredictConfig = CONFIG, seed: int = 0) -> Predictor:
    """Not trained, but not silent either."""
    torch.manual_seed(seed)
    made = Predictor(config)
    torch.nn.init.normal_(made.expected.weight, std=0.1)
    return made


def facts_of(splats: Splats) -> np.ndarray:
    normals = outward_normals(splats)
    return gaussian_facts(splats, normals, prt_transfer(splats.means, normals))


def edit(count: int, seed: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Random facts, changes of the first half of the Gaussians, and their weights."""
    rng = np.random.default_rng(seed)
    weight = np.where(np.arange(count) < count // 2, rng.uniform(0.1, 60, count), 0)
    arrays = rng.uniform(-1, 1, (count, 21)), rng.normal(0, 0.2, (count, 3)), weight
    return tuple(torch.from_numpy(x.astype(np.float32)) for x in arrays)  # type: ignore[return-value]


def predict_edit(net: Predictor, *facts: torch.Tensor) -> np.ndarray:
    with torch.no_grad():
        return net(*facts).numpy()


def without_torch(net: Predictor, *facts: torch.Tensor) -> np.ndarray:
    """What the stored weights say in numpy."""
    return net.stored().predict(*(x.numpy() for x in facts))


@pytest.mark.parametrize("count", [1, 2, 60])
def test_stored_weights_say_what_the_module_says(count: int) -> None:
    """torch's own layers and solver are the oracle."""
    net, observed = awake(PredictConfig(features=32, hidden=24), seed=count), edit(count)
    expected = predict_edit(net, *observed)
    np.testing.assert_allclose(without_torch(net, *observed), expected, atol=2e-6)
    assert count < 2 or np.abs(expected).max() > 1e-3


def test_shipped_weights_say_the_same_without_torch() -> None:
    deferred, observed = weights.deferred("compact"), edit(300)
    assert deferred is not None
    stored, net = deferred.stored_predictor, weights.load("compact").predictor
    assert stored is not None and not stored.is_untrained and net is not None and "_model" not in vars(deferred)
    np.testing.assert_allclose(stored.predict(*(x.numpy() for x in observed)), predict_edit(net, *observed), atol=5e-6)


def test_an_edit_has_a_say_in_how_gaussians_are_described() -> None:
    """With features of the asset alone a prediction would be affine in the change; these hear what the pictures say."""
    deferred = weights.deferred("compact")
    assert deferred is not None and deferred.stored_predictor is not None
    facts, change, weight = (x.numpy() for x in edit(300))
    one, two, three = (deferred.stored_predictor.predict(facts, k * change, weight) for k in (1, 2, 3))
    bend = np.square(three - 2 * two + one).mean() / np.square(two - one).mean()
    assert bend > 1e-3, bend


def test_weights_of_another_shape_are_refused() -> None:
    tensors = dict(awake().stored().tensors)
    assert stored_predictor.checked(tensors, "here").features == CONFIG.features
    for name, array in (("own.0.weight", tensors["own.0.weight"][:, 1:]), ("strange", np.zeros(3, np.float32))):
        with pytest.raises(ValueError, match=f"here: 'predictor.{name}': expected"):
            stored_predictor.checked({**tensors, name: array}, "here")
    del tensors["trust"]
    with pytest.raises(ValueError, match="here: 'predictor.trust': expected"):
        stored_predictor.checked(tensors, "here")


def test_facts_do_not_know_size_and_place_and_leave_out_what_cannot_be_drawn() -> None:
    splats = ball(400)
    facts = facts_of(splats)
    assert facts.shape == (400, FACTS) and np.isfinite(facts).all() and np.abs(facts).max() < 6
    away = replace(splats, means=100 * splats.means + np.array([3, 4, 5], np.float32), scales=100 * splats.scales)
    np.testing.assert_allclose(facts_of(away), facts, atol=2e-3)
    odd = splats.append(replace(splats.take(np.arange(1)), means=np.full((1, 3), np.nan, np.float32)))
    held = facts_of(odd)
    np.testing.assert_allclose(held[:-1], facts, atol=1e-6)
    assert not held[-1].any()


def test_gaussians_are_a_set() -> None:
    net, observed = awake(), edit(60)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    turned = predict_edit(net, *(x[order] for x in observed))
    np.testing.assert_allclose(turned, predict_edit(net, *observed)[order], atol=1e-5)


def test_unseen_gaussians_teach_nothing_and_without_seen_ones_nothing_changes() -> None:
    net, (facts, change, weight) = awake(), edit(60)
    other = change.clone()
    other[30:] = 5.0
    np.testing.assert_array_equal(predict_edit(net, facts, other, weight), predict_edit(net, facts, change, weight))
    assert not predict_edit(net, facts, change, torch.zeros(60)).any()
    other[:30] += 0.1
    assert np.abs(predict_edit(net, facts, other, weight) - predict_edit(net, facts, change, weight)).max() > 1e-3


def test_runs_of_any_size_say_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    net, observed = awake(), edit(50)
    complete = predict_edit(net, *observed)
    for module in (predictor, stored_predictor):
        monkeypatch.setattr(module, "GAUSSIANS_PER_CHUNK", 7)
    np.testing.assert_allclose(predict_edit(net, *observed), complete, atol=1e-6)
    np.testing.assert_allclose(without_torch(net, *observed), complete, atol=1e-6)
    for module in (predictor, stored_predictor):
        monkeypatch.setattr(module, "REGRESSION_GAUSSIANS", 10)
        monkeypatch.setattr(module, "CONTEXT_GAUSSIANS", 10)
    few = predict_edit(net, *observed)
    assert np.isfinite(few).all() and np.abs(few - complete).max() > 0
    np.testing.assert_allclose(without_torch(net, *observed), few, atol=1e-6)


def test_evidence_is_believed_as_far_as_features_reach() -> None:
    net, (facts, change, weight) = awake(PredictConfig(features=32, hidden=32)), edit(40)
    away = []
    for trust in (-20.0, 6.0, 25.0):
        with torch.no_grad():
            net.trust.fill_(trust)
        away.append(float(np.abs(predict_edit(net, facts, change, weight) - change.numpy())[:20].max()))
    assert away[2] < 0.05 < away[1] < away[0]  # 20 Gaussians, 32 features


def test_gradients_reach_every_weight() -> None:
    net, observed = awake(), edit(30)
    net(*observed).square().sum().backward()
    assert all(p.grad is not None and float(p.grad.abs().max()) > 0 for p in net.parameters())


def test_an_untrained_predictor_leaves_the_lift_alone() -> None:
    splats = ball(300)
    normals = outward_normals(splats)

    def never() -> np.ndarray:
        raise AssertionError("light is looked for, and nobody needs it")

    torch.manual_seed(0)
    assert PRESETS["compact"].predict.features > 0 == PRESETS["paper"].predict.features
    assert predicting(SplatPainterModel(TINY).stored_predictor, splats, normals, never) is None
    model = SplatPainterModel(WITH)
    assert model.predictor is not None and model.predictor.stored().is_untrained
    assert predicting(model.stored_predictor, splats, normals, never) is None
    torch.nn.init.normal_(model.predictor.expected.weight, std=0.1)
    predict = predicting(model.stored_predictor, splats, normals, lambda: prt_transfer(splats.means, normals))
    assert predict is not None
    predicted = predict(np.full((300, 3), 0.1, np.float32), np.ones(300, np.float32))
    assert predicted.shape == (300, 3) and predicted.dtype == np.float32


def test_the_lift_takes_what_it_is_told_about_unseen_gaussians() -> None:
    before = ball(600)
    truth = regraded(before)
    normals = outward_normals(before)
    views = [(camera, draw(truth, camera), covered(before, camera)) for camera in (FRONT, SIDE)]
    plain = lift_global(before, views, normals=normals)
    regression = lift_global(before, views, normals=normals, predict=lambda c, w: regressed(before, normals, c, w))
    np.testing.assert_allclose(regression.splats.sh, plain.splats.sh, atol=1e-5)
    change, weight = seen_change(before, views)
    calls = []
    lift_global(before, views, normals=normals, predict=lambda c, w: calls.append((c, w)) or 0 * c)
    np.testing.assert_array_equal(calls[0][0], change)
    np.testing.assert_array_equal(calls[0][1], weight)
    # The truth for a prediction: the far side comes out right.
    true = (truth.sh[:, 0] - before.sh[:, 0]) * 0.28209479177387814
    exact = lift_global(before, views, normals=normals, predict=lambda c, w: true)
    assert np.abs(draw(exact.splats, BACK) - draw(truth, BACK)).max() < 2e-3
    # Gaussians that cannot be drawn are neither asked about nor changed.
    odd = before.append(replace(before.take(np.arange(2)), means=np.full((2, 3), np.nan, np.float32)))
    held = lift_global(odd, views, predict=lambda c, w: np.where(w[:, None] >= 0, np.concatenate([true, c[-2:]]), 0))
    np.testing.assert_allclose(held.splats.sh[:-2], exact.splats.sh, atol=1e-5)
    np.testing.assert_array_equal(held.splats.sh[-2:].view(np.int32), odd.sh[-2:].view(np.int32))


def test_the_painter_asks_the_models_predictor_for_global_edits_alone() -> None:
    splats = ball(500, degree=1)
    base = replace(WITH, refine=replace(WITH.refine, base="lift", detail=False))
    torch.manual_seed(1)
    silent, speaking = SplatPainterModel(base).eval(), SplatPainterModel(base).eval()
    speaking.load_state_dict(silent.state_dict())
    assert speaking.predictor is not None
    torch.nn.init.normal_(speaking.predictor.expected.weight, std=0.3)
    truth = regraded(splats)
    camera = replace(FRONT, width=96, height=96)
    for mode in ("global", "local"):
        made = {}
        for name, painter in {
            "lift": Painter(
                settings=EditSettings(local_options=replace(LOCAL_DEFAULTS, resurface=False))
            ),  # as networks know it
            "silent": Painter(model=silent),
            "speaking": Painter(model=speaking),
        }.items():
            method = "lift" if name == "lift" else "ttt"
            change = Edit(draw(truth, camera), camera, covered(splats, camera))
            made[name] = painter.apply(painter.encode(splats, method), [change], mode=mode, method=method)  # type: ignore[arg-type]
        np.testing.assert_array_equal(made["silent"].splats.sh, made["lift"].splats.sh)
        differs = not np.array_equal(made["speaking"].splats.sh, made["lift"].splats.sh)
        assert differs == (mode == "global")


def test_alone_it_needs_no_encoding(monkeypatch: pytest.MonkeyPatch) -> None:
    splats, base = ball(500, degree=1), replace(WITH, refine=replace(WITH.refine, base="lift", detail=False))
    torch.manual_seed(1)
    both = SplatPainterModel(base).eval()
    assert both.predictor is not None
    torch.nn.init.normal_(both.predictor.expected.weight, std=0.3)
    alone = SplatPainterModel(replace(base, predict=replace(CONFIG, alone=True))).eval()
    alone.load_state_dict(both.state_dict())
    assert alone.config.predictor_only and not both.config.predictor_only
    change = Edit(draw(regraded(splats), FRONT), FRONT, covered(splats, FRONT))
    with_stage_two = Painter(model=both)
    expected = with_stage_two.apply(with_stage_two.encode(splats), [change], mode="global", method="ttt")
    painter = Painter(model=alone)
    assert not painter.encodes("ttt", "global") and painter.encodes("ttt", "local")
    monkeypatch.setattr(Networks, "encode", None)  # whoever encodes fails
    asset = painter.encode(splats, "ttt", ["global"])
    made = painter.apply(asset, [change], mode="global", method="ttt")
    # Stage II is untrained, so it adds nothing.
    np.testing.assert_array_equal(made.splats.sh, expected.splats.sh)
    assert asset.encoding is None and made.receipt is not None and made.receipt.method == "predictor"
    assert "encode" not in made.receipt.seconds
    # While it is untrained, the lift's regression stands in.
    assert alone.predictor is not None
    torch.nn.init.zeros_(alone.predictor.expected.weight)
    again = painter.apply(asset, [change], mode="global", method="ttt")
    lifted = Painter().apply(asset, [change], mode="global")
    np.testing.assert_array_equal(again.splats.sh, lifted.splats.sh)


def test_the_predictor_is_read_where_the_networks_are_not_installed(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: ANN001
    model = SplatPainterModel(replace(WITH, preset="compact"))
    model.save(tmp_path / "compact", dtype="float32")
    index = checkpoint._index(tmp_path / "compact")
    (large,) = (shard for shard in index["shards"] if "holds" not in shard)
    (tmp_path / "compact" / large["file"]).unlink()
    arrays = checkpoint.load_arrays(tmp_path / "compact", "predictor.")
    assert model.predictor is not None and arrays.keys() == model.predictor.state_dict().keys()
    with pytest.raises(ValueError, match="no shard holds 'refiner[.]+' alone"):
        checkpoint.load_arrays(tmp_path / "compact", "refiner.")
    with pytest.raises(ValueError, match="missing; copy the whole folder"):
        SplatPainterModel.load(tmp_path / "compact")
    monkeypatch.setattr(checkpoint, "PACKAGED", tmp_path)
    monkeypatch.setattr(checkpoint, "DISTRIBUTION_PACKAGE", "not_installed_here")
    # From within a clone the folder is named by where it lies from there: `train --from src/splatpainter/weights/NAME`.
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path / "compact", Path("compact")):
        with pytest.raises(ValueError, match=r"the networks of 'compact' are not installed.*splatpainter\[networks\]"):
            SplatPainterModel.load(folder)


def test_weights_that_only_help_elsewhere_are_not_read(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: ANN001
    SplatPainterModel(replace(WITH, preset="compact")).save(
        tmp_path / "compact", notes={"gain": {"local": -0.2, "global": 0.4}}
    )
    monkeypatch.setenv(weights.VARIABLE, str(tmp_path))
    assert Painter.load().model is not None and Painter.load(modes=["global"]).model is not None
    local = Painter.load(modes=["local"])
    assert local.choose("auto", "local")[0] == "corrected" and "in local edits" in local.choose("auto", "local")[1]
    assert local.choose("ttt", "local")[0] == "ttt" and "_model" not in vars(local.model)


def test_a_checkpoint_keeps_it_and_older_ones_have_none(tmp_path) -> None:  # noqa: ANN001
    torch.manual_seed(0)
    model = SplatPainterModel(WITH)
    assert model.predictor is not None
    torch.nn.init.normal_(model.predictor.expected.weight)
    model.save(tmp_path / "new", dtype="float32")
    held = SplatPainterModel.load(tmp_path / "new")
    assert held.predictor is not None and not held.predictor.stored().is_untrained
    assert torch.equal(held.predictor.trust, model.predictor.trust)
    np.testing.assert_array_equal(predict_edit(held.predictor, *edit(30)), predict_edit(model.predictor, *edit(30)))
    SplatPainterModel(TINY).save(tmp_path / "old")
    text = TINY.to_json()
    cut = text[: text.index('"predict"')] + text[text.index('"decoder"') :]
    assert ModelConfig.from_json(cut) == TINY and "predict" not in cut


def test_weights_are_read_when_they_are_needed(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: ANN001
    config = replace(WITH, preset="compact", predict=replace(CONFIG, alone=True))
    config = replace(config, refine=replace(config.refine, base="lift", detail=False))
    torch.manual_seed(2)
    model = SplatPainterModel(config)
    assert model.predictor is not None
    torch.nn.init.normal_(model.predictor.expected.weight, std=0.3)
    model.save(tmp_path / "compact", notes={"gain": {"local": -0.2, "global": 0.4}}, dtype="float32")
    monkeypatch.setenv(weights.VARIABLE, str(tmp_path))
    read = []
    monkeypatch.setattr(SplatPainterModel, "load", staticmethod(lambda folder: read.append(folder) or model.eval()))
    painter, splats = Painter.load(), ball(500, degree=1)
    assert painter.preset == "compact"
    change = Edit(draw(regraded(splats), FRONT), FRONT, covered(splats, FRONT))
    painter.apply(painter.encode(splats), [change])
    assert not read, "local edits are the lift's"
    made = painter.apply(painter.encode(splats), [change], mode="global")
    assert made.receipt is not None and made.receipt.method == "predictor"
    painter.apply(made, [change], mode="global")
    assert not read, "global ones are the stored predictor's"
    expected = Painter(model=model).apply(Painter(model=model).encode(splats), [change], mode="global", method="ttt")
    np.testing.assert_array_equal(made.splats.sh, expected.splats.sh)
