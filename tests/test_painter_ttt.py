"""Painting with networks: identity before training, exact locality, a state that goes in and comes out."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpainter.lift.edit_views import edit_views
from splatpainter.lift.edits import lift_local_views
from splatpainter.lift.options import LocalOptions
from splatpainter.models import checkpoint
from splatpainter.models.config import COMPACT, PAPER, ModelConfig
from splatpainter.models.encode import asset_views, canonical_cameras, encode_asset
from splatpainter.models.model import SplatPainterModel
from splatpainter.models.weights import _Deferred
from splatpainter.nn.precision import Arithmetic, autocast
from splatpainter.painter import Asset, Edit, EditSettings, Mode, Painter
from splatpainter.receipts import Receipt
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.voxels.grid import voxelize
from tests.support.lift_scenes import db, differing, disk, front, same_bits
from tests.support.model_scenes import shallow
from tests.support.painter_scenes import (
    ASSET_BASE,
    BLUE,
    CAMERA,
    COPY,
    DRAWABLE,
    GREEN,
    LIFT,
    REAR,
    RED,
    SIZE,
    built,
    dab,
    grade,
    thing,
    uneven,
)

SPLATS = thing()
MODES: list[Mode] = ["local", "global"]


def receipt_of(asset: Asset) -> Receipt:
    assert asset.receipt is not None
    return asset.receipt


def fast_weights(asset: Asset) -> list[torch.Tensor]:
    """Of all blocks and the detail layer."""
    assert asset.encoding is not None and asset.encoding.state is not None
    state = asset.encoding.state
    memories = [*state.blocks, *([] if state.detail is None else [state.detail])]
    return [weight for memory in memories for weight in memory]


def same_state(one: Asset, two: Asset) -> bool:
    return all(torch.equal(a, b) for a, b in zip(fast_weights(one), fast_weights(two), strict=True))


def edits_of(mode: Mode, splats: Splats = SPLATS) -> list[Edit]:
    return [dab(splats, RED)] if mode == "local" else [grade(splats)]


# Before training


@pytest.mark.parametrize("mode", MODES)
def test_an_untrained_network_on_own_rows_returns_the_asset_bit_for_bit(mode: Mode, precision: str) -> None:
    painter = Painter(model=built(ASSET_BASE))
    asset = painter.encode(SPLATS)
    result = painter.apply(asset, edits_of(mode), mode=mode)
    receipt = receipt_of(result)
    assert same_bits(result.splats, SPLATS) and result.splats is SPLATS
    assert (receipt.method, receipt.preset, receipt.appended_rows, len(receipt.touched)) == ("ttt", "tiny", 0, 0)
    assert receipt.precision == precision
    assert "tiny" in receipt.note and set(receipt.seconds) >= {"encode", "prepare", "lift", "ttt", "receipt"}
    assert receipt.untouched_sha256_before == receipt.untouched_sha256_after
    assert (result.confidence is not None) == (mode == "global")
    # It has learnt all the same.
    first = built(ASSET_BASE).initial_state().blocks[0]
    assert not torch.equal(fast_weights(result)[0], first[0])


@pytest.mark.parametrize("mode", MODES)
def test_an_untrained_network_on_the_lift_returns_the_lift_bit_for_bit(mode: Mode, precision: str) -> None:
    edits = [*edits_of(mode), dab(SPLATS, BLUE, 40), dab(SPLATS, GREEN, camera=REAR)]
    painter, lift = (
        Painter(model=built(LIFT)),
        Painter(settings=EditSettings(local_options=LocalOptions(resurface=False))),
    )
    result = painter.apply(painter.encode(SPLATS), edits, mode=mode)
    plain = lift.apply(lift.encode(SPLATS), edits, mode=mode)
    assert same_bits(result.splats, plain.splats) and not same_bits(result.splats, SPLATS)
    one, two = receipt_of(result), receipt_of(plain)
    assert one.touched.tolist() == two.touched.tolist() and one.views == two.views
    assert (one.method, two.method) == ("ttt", "lift")
    assert (one.precision, two.precision) == (precision, "")


@pytest.mark.parametrize("mode", MODES)
def test_presets_with_one_layer_run_from_end_to_end(mode: Mode) -> None:
    """All switches as the presets have them; compact is as wide as it is."""
    small = shallow(PAPER)
    paper = replace(
        small,
        lrm=replace(small.lrm, dim=64, heads=4, hidden=64, views=2, image_size=32),
        compress=replace(small.compress, dim=64, hidden=64),
        refine=replace(small.refine, fast_hidden=128, hidden=64),
    )
    for config in (shallow(replace(COMPACT, lrm=replace(COMPACT.lrm, views=2, image_size=32))), paper):
        painter = Painter(model=built(config))
        asset = painter.encode(SPLATS)
        result = painter.apply(asset, edits_of(mode, asset.splats), mode=mode)
        alone = mode == "global" and config.predictor_only  # by an untrained predictor: the lift
        expected = Painter().apply(asset, edits_of(mode, asset.splats), mode=mode) if alone else asset
        assert same_bits(result.splats, expected.splats)
        copied = config.representation == "copy"
        assert (asset.splats is SPLATS) != copied and ("copy" in receipt_of(result).note) == copied


def test_copy_is_the_most_opaque_rows_of_what_the_lrm_saw(precision: str) -> None:
    model = built(COPY)
    painter = Painter(model=model)
    asset = painter.encode(SPLATS)
    with torch.no_grad(), autocast("cpu", precision):
        encoded = encode_asset(model, SPLATS)
        views, _ = asset_views(SPLATS, canonical_cameras(SPLATS, COPY.lrm), voxelize(SPLATS, 4))
        seen = model.copied_gaussians(views).gaussians
    # Rounded to 8 bits, hundreds of opacities would be equal, and the order of the rows would decide in their place.
    assert len(np.unique(seen.opacities.numpy())) > 0.95 * len(seen)
    assert same_bits(asset.splats, encoded.gaussians.numpy())  # test_encode.py says which rows these are
    # A lift of a copy: its further rows stand behind it, and the next edit with the network knows whose they are.
    lifted = painter.apply(asset, [dab(asset.splats, RED)], method="lift")
    again = painter.apply(lifted, [dab(lifted.splats, BLUE)])
    assert same_bits(again.splats, lifted.splats) and len(lifted.splats) > len(asset.splats)


# What an edit may touch


@pytest.mark.parametrize("config", [ASSET_BASE, LIFT], ids=["own", "lift"])
def test_rows_outside_the_selection_keep_their_bits(config: ModelConfig, precision: str) -> None:
    painter = Painter(model=built(config, awake=0.05))
    edit = dab(SPLATS, RED)
    asset = painter.encode(SPLATS)
    result = painter.apply(asset, [edit])
    receipt = receipt_of(result)
    assert receipt.precision == precision
    grid = voxelize(SPLATS)
    views = edit_views(SPLATS, [CAMERA], [edit.image], [disk(CAMERA, 32, 32, 7)])
    base_ids = lift_local_views(SPLATS, grid, views, "own").ids
    changed = np.flatnonzero(differing(SPLATS, result.splats))
    assert 0 < len(changed) and set(changed) <= set(base_ids) and receipt.touched.tolist() == changed.tolist()
    assert receipt.untouched_sha256_before == receipt.untouched_sha256_after
    # Own: every chosen row moved and has one child; lift: the children are the lift's.
    children = (
        len(base_ids)
        if config is ASSET_BASE
        else len(lift_local_views(SPLATS, grid, views, "lift").splats) - len(SPLATS)
    )
    assert receipt.appended_rows == children == len(result.splats) - len(SPLATS)
    if config is ASSET_BASE:
        assert changed.tolist() == base_ids.tolist()
    assert result.splats.drawable[:DRAWABLE].all() and result.splats.drawable[len(SPLATS) :].all()


def test_a_global_edit_leaves_rows_that_cannot_be_drawn() -> None:
    painter = Painter(model=built(ASSET_BASE, awake=0.05))
    result = painter.apply(painter.encode(SPLATS), [grade(SPLATS), grade(SPLATS, REAR)], mode="global")
    assert differing(SPLATS, result.splats).tolist() == [True] * DRAWABLE + [False] * 2
    assert len(result.splats) == len(SPLATS) and result.confidence is not None


def test_permuting_rows_or_views_permutes_the_result_and_nothing_else(precision: Arithmetic) -> None:
    splats, model = uneven(), built(ASSET_BASE, awake=0.08)
    edits = [grade(splats), grade(splats, REAR)]

    def painted(splats: Splats, edits: list[Edit], precision: Arithmetic) -> Splats:
        painter = Painter(model=model, settings=EditSettings(precision=precision))
        return painter.apply(painter.encode(splats), edits, mode="global").splats

    turn = np.random.default_rng(5).permutation(len(splats))
    result = painted(splats, edits, precision)
    turned = painted(splats.take(turn), edits, precision)
    swapped = painted(splats, edits[::-1], precision)
    exact = painted(splats, edits, "float32") if precision == "bfloat16" else None
    for name in ATTRIBUTES:
        before, after = getattr(splats, name), getattr(result, name)
        tolerance = 5e-4 if exact is None else _rounding(after, getattr(exact, name))
        np.testing.assert_allclose(getattr(turned, name), after[turn], rtol=0, atol=tolerance)
        np.testing.assert_allclose(getattr(swapped, name), after, rtol=0, atol=tolerance)
        # Gaussians that took each other's values would differ by as much as the edit changes them.
        assert max(0.01, 10 * tolerance) < np.nanmax(np.abs(before - after)), name


def _rounding(rounded: np.ndarray, exact: np.ndarray) -> float:
    """What another order of rounding may move a number by: a third of what rounding to bf16 moved any by. Sums differ
    in their last of 24 bits then; where such a sum lies between two numbers of 8 bits, it falls to the other one, 2^-8
    to 2^-7 of itself away, and the layers after it do with that what they do with any of their rounding errors, of
    which each number has hundreds and a changed order flips few."""
    return float(np.nanmax(np.abs(rounded - exact))) / 3


def test_two_runs_are_bitwise_equal(precision: str) -> None:
    results = []
    for _ in range(2):
        painter = Painter(model=built(LIFT, awake=0.05))
        results.append(painter.apply(painter.encode(SPLATS), [dab(SPLATS, RED), dab(SPLATS, BLUE, 36)]))
    assert same_bits(results[0].splats, results[1].splats) and same_state(*results)


# State and history


@pytest.mark.parametrize("config", [ASSET_BASE, LIFT], ids=["own", "lift"])
def test_apply_is_pure_and_undo_is_the_old_asset(config: ModelConfig, precision: str) -> None:
    model = built(config, awake=0.05)
    weights = [parameter.clone() for parameter in model.parameters()]
    painter = Painter(model=model)
    asset = painter.encode(SPLATS)
    first = painter.apply(asset, [dab(SPLATS, RED)])
    copies = {name: getattr(first.splats, name).copy() for name in ATTRIBUTES}
    state = [weight.clone() for weight in fast_weights(first)]
    second = painter.apply(first, [dab(first.splats, BLUE, 24)])
    assert all(np.array_equal(getattr(first.splats, n), copies[n], equal_nan=True) for n in ATTRIBUTES)
    assert all(torch.equal(a, b) for a, b in zip(fast_weights(first), state, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(model.parameters(), weights, strict=True))
    assert asset.splats is SPLATS and asset.encoding is not None and asset.encoding.state is None
    # Going on from the undone edit is as if the other had never been.
    redone = painter.apply(first, [dab(first.splats, BLUE, 24)])
    assert same_bits(redone.splats, second.splats) and same_state(redone, second)


def test_the_second_edit_starts_from_the_state_and_the_rows_of_the_first() -> None:
    painter = Painter(model=built(ASSET_BASE, awake=0.05))
    asset = painter.encode(SPLATS)
    first = painter.apply(asset, [dab(SPLATS, RED, 26)])
    assert first.encoding is not None and len(first.encoding.parent_ids) == len(first.splats) > len(SPLATS)
    # Children read their parent's latent: here child i belongs to touched row i.
    assert first.encoding.parent_ids[len(SPLATS) :].tolist() == receipt_of(first).touched.tolist()
    edit = dab(first.splats, BLUE, 32)
    second = painter.apply(first, [edit])
    forgetful = replace(first, encoding=replace(first.encoding, state=None))
    fresh = painter.apply(forgetful, [edit])
    assert receipt_of(second).touched.tolist() == receipt_of(fresh).touched.tolist()
    assert (receipt_of(second).touched >= len(SPLATS)).any()  # it reached children of the first
    assert not same_bits(second.splats, fresh.splats) and not same_state(second, fresh)
    assert second.encoding is not None and first.encoding.encoded is second.encoding.encoded
    parents = second.encoding.parent_ids
    assert len(parents) == len(second.splats) and (parents < DRAWABLE).all() or (parents[: len(SPLATS)] >= 0).all()


def test_lift_and_network_take_turns_on_one_asset() -> None:
    painter = Painter(model=built(LIFT, awake=0.05))
    asset = painter.encode(SPLATS)
    lifted = painter.apply(asset, [dab(SPLATS, RED, 28)], method="lift")
    assert lifted.encoding is not None and lifted.encoding.state is None
    assert receipt_of(lifted).preset == "lift" and receipt_of(lifted).method == "lift"
    refined = painter.apply(lifted, [dab(lifted.splats, BLUE, 32)])
    assert refined.encoding is not None and len(refined.encoding.parent_ids) == len(refined.splats)
    appended = np.arange(len(SPLATS), len(refined.splats))
    parents = refined.encoding.parent_ids[appended]
    away = np.linalg.norm(refined.splats.means[appended] - SPLATS.means[parents], axis=1)
    assert (parents < DRAWABLE).all() and np.median(away) < 4 * SPLATS.scales.max()
    # An asset that another painter made is encoded on the way.
    other = Painter().apply(Asset(SPLATS), [dab(SPLATS, RED, 28)])
    taken = painter.apply(other, [dab(other.splats, BLUE, 32)])
    assert taken.encoding is not None and len(taken.encoding.encoded.gaussians) == len(other.splats)


def test_the_models_own_mode_comes_back_and_counts_for_nothing() -> None:
    model = built(ASSET_BASE, awake=0.05)
    painter = Painter(model=model)
    quiet = painter.apply(painter.encode(SPLATS), [dab(SPLATS, RED)])
    model.train()
    loud = painter.apply(painter.encode(SPLATS), [dab(SPLATS, RED)])
    assert model.training and same_bits(quiet.splats, loud.splats)
    with pytest.raises(ValueError, match="no Gaussian"):
        painter.apply(painter.encode(SPLATS), [Edit(np.zeros((SIZE, SIZE, 3)), CAMERA, disk(CAMERA, 0.5, 0.5, 0.6))])
    assert model.training


# Polish


@pytest.mark.parametrize(("awake", "gain_db"), [(0.05, 0.5), (0.02, 0.0)])  # near the lift little is left to mend
@pytest.mark.parametrize("mode", MODES)
def test_polish_brings_the_picture_nearer_and_reaches_no_other_row(
    mode: Mode, awake: float, gain_db: float, precision: str
) -> None:
    model = built(LIFT, awake=awake)
    edits = edits_of(mode)
    plain, polished = (
        painter.apply(painter.encode(SPLATS), edits, mode=mode)
        for painter in (Painter(model=model), Painter(model=model, settings=EditSettings(polish=True)))
    )
    inside = disk(CAMERA, 32, 32, 7) if mode == "local" else np.ones((SIZE, SIZE), bool)
    scores = [db(render(a.splats, CAMERA).colors[0], edits[0].image, inside) for a in (plain, polished)]
    assert scores[1] >= scores[0] + gain_db
    assert set(receipt_of(polished).touched) <= set(receipt_of(plain).touched)
    assert len(plain.splats) == len(polished.splats)
    assert "polish" in receipt_of(polished).note and "polish" in receipt_of(polished).seconds
    assert "polish" not in receipt_of(plain).note and "polish" not in receipt_of(plain).seconds


# Weights


def saved(folder: Path, config: ModelConfig = ASSET_BASE, seed: int = 7) -> None:
    built(config, seed=seed).save(folder, dtype="float32")


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of presets, empty; and an empty cache."""
    monkeypatch.setenv("SPLATPAINTER_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("SPLATPAINTER_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setattr("splatpainter.models.weights.PACKAGED", tmp_path / "packaged")
    return tmp_path / "weights"


def test_auto_is_compact_where_its_weights_are_else_the_lift(weights: Path) -> None:
    plain = Painter.load()
    assert plain.model is None and plain.preset == "lift"
    assert "no trained weights" in receipt_of(plain.apply(plain.encode(SPLATS), [dab(SPLATS, RED)])).note
    for folder in (weights.parent / "packaged" / "compact", weights / "compact"):
        saved(folder, replace(ASSET_BASE, preset="compact"), seed=len(folder.parts))
        painter = Painter.load()
        assert painter.model is not None and painter.preset == "compact" and painter.settings.cache
        stored = SplatPainterModel.load(folder)
        assert torch.equal(painter.model.head.norm.weight, stored.head.norm.weight)
        name = "compressor.attribute.weight"
        assert torch.equal(painter.model.get_parameter(name), stored.get_parameter(name))  # the named folder wins
    assert Painter.load("lift").model is None
    assert not Painter.load("compact", cache=False).settings.cache
    assert Painter.load("compact", polish=True).settings.polish


def test_auto_is_the_lift_in_the_mode_where_the_weights_do_not_beat_it() -> None:
    model = built(LIFT)
    model.notes = {"gain": {"local": -0.02, "global": 0.4}}
    painter = Painter(model=model)
    local = receipt_of(painter.apply(painter.encode(SPLATS), [dab(SPLATS, RED)]))
    assert local.method == "corrected" and "-0.02 dB" in local.note
    assert receipt_of(painter.apply(Asset(SPLATS), [dab(SPLATS, RED)], method="ttt")).method == "ttt"
    everywhere = receipt_of(painter.apply(Asset(SPLATS), [dab(SPLATS, RED)], mode="global"))
    assert everywhere.method == "ttt" and "+0.40 dB" in everywhere.note


def test_weights_that_beat_the_lift_nowhere_are_not_even_read(weights: Path) -> None:
    saved(weights / "compact", replace(LIFT, preset="compact"))
    checkpoint.add_notes(weights / "compact", {"gain": {"local": -5.0, "global": 0.1}})
    assert Painter.load().model is not None
    checkpoint.add_notes(weights / "compact", {"gain": {"local": -5.0, "global": -0.1}})
    painter = Painter.load()
    assert isinstance(painter.model, _Deferred) and "measured no better" in str(painter.why)
    done = receipt_of(painter.apply(painter.encode(SPLATS), [dab(SPLATS, RED)]))
    assert (done.method, done.preset, done.precision) == ("corrected", "lift", "") and str(painter.why) in done.note
    assert "_model" not in vars(painter.model)
    # ... unless they are asked for.
    chosen = receipt_of(painter.apply(painter.encode(SPLATS, "ttt"), [dab(SPLATS, RED)], method="ttt"))
    assert (chosen.method, chosen.preset) == ("ttt", "compact") and "_model" in vars(painter.model)
    compact = Painter.load("compact")
    assert compact.model is not None and compact.choose("auto", "local")[0] == "corrected"
    assert compact.choose("ttt", "local")[0] == "ttt"


def test_a_checkpoints_own_config_wins(weights: Path) -> None:
    saved(weights / "compact", replace(LIFT, preset="compact"))
    painter = Painter.load("compact")
    assert painter.model is not None and painter.model.config == replace(LIFT, preset="compact")
    somewhere = weights.parent / "somewhere"
    saved(somewhere, replace(ASSET_BASE, preset="mine"))
    assert Painter.load(str(somewhere)).preset == "mine"
    result = Painter.load(str(somewhere)).apply(Asset(SPLATS), [dab(SPLATS, RED)])
    assert receipt_of(result).preset == "mine" and receipt_of(result).method == "ttt"


def test_weights_that_cannot_be_used_are_one_line(weights: Path) -> None:
    saved(weights / "paper", replace(ASSET_BASE, preset="compact"))
    newer = weights.parent / "newer"
    saved(newer)
    index = newer / "model.json"
    index.write_text(index.read_text().replace('"version": 1', '"version": 2'))
    torn = weights.parent / "torn"
    shutil.copytree(weights / "paper", torn)
    next(torn.glob("weights-*")).unlink()
    (weights.parent / "empty").mkdir()
    for preset, pattern in {
        "compact": "preset 'compact': no trained weights; put model.json",
        "paper": "expected weights of preset 'paper', these are of preset 'compact'",
        str(newer): "newer SplatPainter",
        str(torn): "missing",
        str(weights.parent / "empty"): "no weights there",
        "huge": "expected one of auto, lift, paper, compact, rows, local, or a folder of weights, got 'huge'",
    }.items():
        with pytest.raises(ValueError, match=pattern) as error:
            Painter.load(preset)
        assert "\n" not in str(error.value)


# What it cannot do


def test_errors_are_one_line_and_leave_the_asset_alone() -> None:
    painter = Painter(model=built(ASSET_BASE, awake=0.05))
    asset = painter.apply(painter.encode(SPLATS), [dab(SPLATS, RED)])
    before = [weight.clone() for weight in fast_weights(asset)]
    small = front(32)
    other = Edit(np.zeros((32, 32, 3)), small, np.ones((32, 32)), name="small.png")
    cases = {
        "17": ([dab(SPLATS, RED)] * 17, "1 to 16"),
        "sizes": ([dab(SPLATS, RED), other], "one size, got 32x32, 64x64"),
        "air": (
            [Edit(np.zeros((SIZE, SIZE, 3)), CAMERA, disk(CAMERA, 0.5, 0.5, 0.6), name="air.png")],
            "^air.png: no Gaussian",
        ),
    }
    for edits, pattern in cases.values():
        with pytest.raises(ValueError, match=pattern) as error:
            painter.apply(asset, edits)
        assert "\n" not in str(error.value)
    assert all(torch.equal(a, b) for a, b in zip(fast_weights(asset), before, strict=True))
    # The lift takes pictures of several sizes.
    assert len(receipt_of(painter.apply(asset, [dab(SPLATS, RED), other], method="lift")).views) == 2
    with pytest.raises(ValueError, match="'ttt' needs a preset with trained weights"):
        Painter().apply(Asset(SPLATS), [dab(SPLATS, RED)], method="ttt")
    with pytest.raises(ValueError, match="none of the 2 Gaussians"):
        painter.encode(SPLATS.take(np.arange(DRAWABLE, DRAWABLE + 2)))
    assert len(canonical_cameras(SPLATS, ASSET_BASE.lrm)) == ASSET_BASE.lrm.views


def test_who_asks_for_adaptation_is_told_where_another_method_answers_or_none() -> None:
    compact = Painter.load("compact")
    assert compact.choose("ttt", "global") == (
        "ttt",
        "preset 'compact' makes global edits by its predictor; preset 'rows' adapts to them",
    )
    assert Painter.load("rows").choose("ttt", "global") == ("ttt", "")
    with pytest.raises(ValueError, match="weights for mode global, and 'local' has those for local edits alone; use"):
        Painter.load("local").choose("ttt", "global")
