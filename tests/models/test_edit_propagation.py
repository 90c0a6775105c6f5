"""Stage II as the sole carrier of a global edit, and what its inputs are made of."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from splatpainter.lift.depth_normals import outward_normals
from splatpainter.lift.global_edit import regressed
from splatpainter.lighting import prt_transfer
from splatpainter.models import weights
from splatpainter.models.compress import LatentScale
from splatpainter.models.config import ModelConfig, RefineConfig
from splatpainter.models.decode import color_change
from splatpainter.models.edit_propagation import CarriedEdit, EncodedGaussians, carry
from splatpainter.models.encode import Encoded, encode_asset
from splatpainter.models.model import GaussianInputs, SplatPainterModel
from splatpainter.models.predictor import spread_evenly
from splatpainter.models.refine import position_waves, unit_rms
from splatpainter.painter import NOT_LOCAL, Edit, Method, Painter
from splatpainter.splats import Splats
from tests.lift.test_global import FRONT, MIX, SHIFT, SIDE, ball, draw, regraded
from tests.support.model_scenes import with_refine
from tests.support.train_scenes import SMALL

CARRYING = with_refine(
    SMALL, inputs="normalised", answers="teachers", facts=True, picture_tokens=False, row_tokens=64, detail=False
)
"""A tiny Stage II that only shown Gaussians teach."""
MIN_MOVED = 0.2
"""Of the rms of added colours, by which they differ without adaptation and after another edit."""
MIN_SHARE = 0.1
"""Of the power of Stage II's numbers that differs between Gaussians."""


def model(config: ModelConfig = CARRYING, seed: int = 0) -> SplatPainterModel:
    """Not trained, but with a decoder that says something."""
    torch.manual_seed(seed)
    made = SplatPainterModel(config)
    torch.nn.init.normal_(made.head.linear.weight, std=0.1)
    return made.eval()


@cache
def scene() -> tuple[SplatPainterModel, Splats, Encoded, EncodedGaussians]:
    made, splats = model(), ball(300)
    with torch.no_grad():
        encoded = encode_asset(made, splats)
    normals = outward_normals(splats)
    rows = EncodedGaussians.of(
        made, encoded.latents, encoded.latent_ids, splats, normals, prt_transfer(splats.means, normals)
    )
    return made, splats, encoded, rows


def answers_to(
    change: Tensor, weight: Tensor, strength: float | None = None, made: SplatPainterModel | None = None
) -> Tensor:
    """What the second half of the Gaussians is told by the first."""
    first, _, _, rows = scene()
    with torch.no_grad():
        return carry(made or first, rows, change, weight, torch.arange(150), torch.arange(150, 300), strength)[1]


def edit(seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return 0.3 * torch.randn(300, 3, generator=generator), 5 * torch.rand(300, generator=generator)


def between(values: Tensor) -> float:
    """Share of the power of [K, D] that differs between lines."""
    return float((values - values.mean(0)).square().sum() / values.square().sum())


def test_a_reader_knows_of_the_edit_what_the_memory_says() -> None:
    change, weight = edit()
    answer = answers_to(change, weight)
    other = change.clone()
    other[150:] = 7.0
    torch.testing.assert_close(answers_to(other, weight * torch.where(torch.arange(300) < 150, 1, 3)), answer)
    other[:150] = change[:150].roll(1, 1)
    assert float((answers_to(other, weight) - answer).abs().max()) > 1e-3


@pytest.mark.parametrize("mixer", ["ttt", "cross_attention"])
def test_without_adaptation_all_edits_are_one(mixer: str) -> None:
    made = model(with_refine(CARRYING, mixer=mixer))
    first, second = (answers_to(*edit(seed), made=made) for seed in (0, 1))
    assert float((first - second).abs().max()) > 1e-4
    if mixer == "ttt":
        torch.testing.assert_close(
            answers_to(*edit(0), strength=0.0), answers_to(*edit(1), strength=0.0), atol=0, rtol=0
        )


def test_the_number_of_teachers_does_not_set_the_step() -> None:
    made, _, _, rows = scene()
    plain = model(with_refine(CARRYING, newton_schulz_steps=0))
    plain.load_state_dict(made.state_dict())
    change, weight = edit()
    once, readers = torch.arange(150), torch.arange(150, 300)
    with torch.no_grad():
        answers = [carry(plain, rows, change, weight, ids, readers)[1] for ids in (once, once.repeat(3))]
    torch.testing.assert_close(*answers, atol=1e-5, rtol=1e-4)


def test_gaussians_are_asked_one_by_one() -> None:
    made, _, _, rows = scene()
    change, weight = edit()
    readers = torch.tensor([280, 151, 200])
    with torch.no_grad():
        few = carry(made, rows, change, weight, torch.arange(150), readers)[1]
    torch.testing.assert_close(few, answers_to(change, weight)[readers - 150], atol=1e-5, rtol=1e-4)


def test_what_cannot_be_drawn_is_left_out_and_what_was_not_encoded_is_named() -> None:
    made, splats, encoded, _ = scene()
    odd = splats.append(replace(splats.take(np.arange(1)), means=np.full((1, 3), np.nan, np.float32)))
    normals = np.append(outward_normals(splats), np.zeros((1, 3), np.float32), 0)
    transfer = np.append(prt_transfer(splats.means, normals[:300]), np.zeros((1, 10), np.float32), 0)
    change, weight = (x.numpy() for x in edit())
    change, weight = np.append(change, np.zeros((1, 3), np.float32), 0), np.append(weight, np.float32(0))
    predict = CarriedEdit(made, encoded.latents, np.append(encoded.latent_ids, -1), odd, normals, lambda: transfer)
    answer = predict(change, weight)
    assert answer.shape == (301, 3) and not answer[300].any() and np.abs(answer[:300]).max() > 1e-4
    assert not predict(change, np.zeros(301, np.float32)).any()
    with pytest.raises(ValueError, match="1 of the 300 Gaussians were not encoded"):
        ids = np.where(np.arange(300) == 7, -1, encoded.latent_ids)
        CarriedEdit(made, encoded.latents, ids, splats, normals[:300], lambda: transfer[:300])


def test_a_painter_predicts_what_no_view_shows_by_stage_two() -> None:
    splats = ball(300)
    view = Edit(draw(regraded(splats), FRONT), FRONT)
    made = model()
    results = []
    for strength in (1.0, 0.0):
        made.config = with_refine(CARRYING, edit_strength=strength)
        for block in made.refiner.blocks:
            block.mixer.ttt.edit_strength = strength  # type: ignore[union-attr]
        painter = Painter(model=made)
        results.append(painter.apply(painter.encode(splats, "ttt", ("global",)), [view], "global", "ttt"))
    lift = Painter().apply(Painter().encode(splats), [view], "global", "lift")
    adapted, fixed = results
    seen = lift.confidence > np.quantile(lift.confidence, 0.8)  # type: ignore[operator]
    moved = np.abs(adapted.splats.sh - fixed.splats.sh).max((1, 2))
    assert moved[~seen].mean() > 1.4 * moved[seen].mean() > 0
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_array_equal(getattr(adapted.splats, name), getattr(splats, name))
    assert adapted.receipt is not None and adapted.receipt.method == "ttt"


def test_a_look_is_the_mean_with_the_lifts_regression_and_light_is_stage_twos(float32: None) -> None:
    """Light: what colour leaves unexplained normals explain."""
    made, splats, encoded, rows = scene()
    normals = outward_normals(splats)
    transfer = prt_transfer(splats.means, normals)
    predict = CarriedEdit(made, encoded.latents, encoded.latent_ids, splats, normals, lambda: transfer)
    weight = np.where(splats.means[:, 2] > 0, 5, 0).astype(np.float32)
    colors = rows.colors.numpy()
    changes = {
        "look": colors @ MIX.T + SHIFT - colors,
        "light": colors * np.clip(normals @ (0.3, 0.9, 0.3), 0, None)[:, None] - 0.4 * colors,
    }
    for name, change in changes.items():
        change = np.where(weight[:, None] > 0, change, 0).astype(np.float32)
        ids = torch.nonzero(torch.from_numpy(weight) > 0)[:, 0]
        with torch.no_grad():
            arrays = (torch.from_numpy(change), torch.from_numpy(weight))
            alone = carry(made, rows, *arrays, spread_evenly(ids, 64), torch.arange(300))[1].numpy()
        lift = regressed(splats, normals, change, weight)
        expected = alone if name == "light" else (alone + lift) / 2
        np.testing.assert_allclose(predict(change, weight), expected, atol=1e-5)
        assert np.abs(alone - lift).max() > 0.05


def test_terms_have_rms_one() -> None:
    positions = 2 * torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 1
    for dim in (32, 36, 256):
        waves = position_waves(positions, dim)
        assert waves.shape == (50, dim)
        torch.testing.assert_close(waves.square().mean(1), torch.ones(50), atol=1e-4, rtol=0)
    assert between(position_waves(positions, 256)) > 0.5
    term = torch.randn(50, 8, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(unit_rms(30 * term).square().mean(1), torch.ones(50), atol=1e-3, rtol=0)
    assert float(unit_rms(1e-6 * term).abs().max()) < 1e-3 and not unit_rms(torch.zeros(2, 8)).any()


def test_latents_are_centred_and_scaled_over_the_asset() -> None:
    latents = 5 + 0.01 * torch.randn(9000, 4, generator=torch.Generator().manual_seed(0))
    scale = LatentScale.of(latents)
    values = (latents - scale.mean) / scale.rms
    assert float(values.mean(0).abs().max()) < 1e-3 and abs(float(values.square().mean()) - 1) < 1e-3
    made, splats, encoded, _ = scene()
    with pytest.raises(ValueError, match="expected the means of the Gaussians"):
        made.prepared(encoded.latents, np.arange(3), GaussianInputs(torch.zeros(3, 13), None, None, torch.zeros(3, 56)))
    with pytest.raises(ValueError, match=r"expected facts \[3, 56\], got None"):
        means = torch.from_numpy(splats.means[:3])
        made.prepared(encoded.latents, np.arange(3), GaussianInputs(torch.zeros(3, 13), None, means, None))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"answers": "teachers"}, "expected row_tokens above 0"),
        ({"picture_tokens": False}, "expected row_tokens above 0"),
        ({"row_tokens": 8}, "only with lift_features"),
        ({"row_tokens": 8, "lift_features": True, "mixer": "cross_attention"}, "or without picture_tokens"),
    ],
)
def test_settings_that_make_no_sense(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RefineConfig(**settings)


def test_an_absolute_decoder_tells_no_change() -> None:
    raw = torch.arange(20.0)[None]
    torch.testing.assert_close(color_change(raw, "residual"), 0.28209479 * raw[:, 11:14])
    with pytest.raises(ValueError, match="absolute"):
        color_change(raw, "absolute")


@cache
def shipped() -> tuple[SplatPainterModel, EncodedGaussians]:
    """The weights of the package, and a ball of 400 Gaussians encoded for them."""
    made, splats = weights.load("compact"), ball(400)
    with torch.no_grad():
        encoded = encode_asset(made, splats)
    normals = outward_normals(splats)
    transfer = prt_transfer(splats.means, normals)
    return made, EncodedGaussians.of(made, encoded.latents, encoded.latent_ids, splats, normals, transfer)


def test_gaussians_differ_in_what_the_shipped_stage_two_reads(float32: None) -> None:
    made, gaussians = shipped()
    assert made.config.refine.inputs == "normalised" and made.config.refine.answers == "teachers"
    unseen = torch.zeros(len(gaussians.colors), 1)
    lift = torch.cat([gaussians.colors, gaussians.colors, unseen, gaussians.colors, gaussians.normals], 1)
    inputs = GaussianInputs(lift, None, gaussians.means, gaussians.facts)
    with torch.no_grad():
        values, shares = made.prepared(gaussians.latents, gaussians.latent_ids, inputs), []
        for block, memory in zip(made.refiner.blocks, made.initial_state().blocks, strict=True):
            queries = block.mixer.ttt.queries["voxel"](block.norm_rows(values))  # type: ignore[union-attr]
            shares += [between(values), between(queries)]
            values = block.read(memory, values)  # type: ignore[operator]
    assert min(shares) >= MIN_SHARE, shares


def test_adaptation_of_the_shipped_stage_two_moves_what_it_adds(float32: None) -> None:
    """Without adaptation, and after another edit, the added colours are others."""
    made, gaussians = shipped()
    facing = gaussians.normals[:, 2]
    seen, hidden = torch.nonzero(facing > 0)[:, 0], torch.nonzero(facing <= 0)[:, 0]
    pixels = torch.full((len(facing),), 9.0)
    answers = []
    for light, strength in (((0.3, 0.9, 0.3), None), ((0.3, 0.9, 0.3), 0.0), ((-0.9, -0.3, 0.3), None)):
        lit = (gaussians.normals @ torch.tensor(light)).clamp_min(0)[:, None]
        change = gaussians.colors * (0.3 + lit * torch.tensor([1.2, 1.0, 0.8])) - gaussians.colors
        with torch.no_grad():
            answers.append(carry(made, gaussians, change, pixels, seen, hidden, strength)[1])
    for other in answers[1:]:
        share = float((other - answers[0]).square().mean().sqrt() / answers[0].square().mean().sqrt())
        assert share >= MIN_MOVED, share


def test_preset_rows_is_compact_without_its_predictor() -> None:
    compact, rows = shipped()[0], weights.load("rows")
    assert rows.config == replace(compact.config, preset="rows", predict=rows.config.predict)
    assert rows.config.carries and rows.predictor is None and compact.config.predictor_only
    parts = compact.state_dict()
    assert all(torch.equal(tensor, parts[name]) for name, tensor in rows.state_dict().items())
    assert not list((weights.PACKAGED / "rows").glob("weights-*")), "no tensor of its own"


def test_global_edits_of_the_shipped_weights_are_the_predictors_or_stage_twos() -> None:
    """`auto` does not read Stage II; preset "rows" reads nothing else beyond the lift."""
    splats = ball(300)
    view = Edit(draw(regraded(splats), FRONT), FRONT)
    colors = {}
    for preset in ("compact", "rows"):
        made = weights.load(preset)
        for awake in (True, False):
            if not awake:
                torch.nn.init.zeros_(made.head.linear.weight)
            painter = Painter(model=made)
            result = painter.apply(painter.encode(splats, "ttt", ("global",)), [view], "global", "ttt")
            ran = "predictor" if preset == "compact" else "ttt"
            assert result.receipt is not None and (result.receipt.method, result.receipt.preset) == (ran, preset)
            assert ran == "ttt" or "test-time" not in result.receipt.note
            colors[preset, awake] = result.splats.sh
    np.testing.assert_array_equal(colors["compact", True], colors["compact", False])
    assert np.abs(colors["rows", True] - colors["rows", False]).max() > 0.01
    assert np.abs(colors["rows", True] - colors["compact", True]).max() > 0.01


@pytest.mark.parametrize("preset", ["compact", "rows"])
def test_local_edits_of_the_shipped_weights_are_the_lifts(preset: str) -> None:
    splats = ball(300)
    view = Edit(draw(regraded(splats), SIDE), SIDE, np.pad(np.ones((16, 16), bool), 40))
    painter = Painter(model=weights.load(preset))
    methods: list[tuple[Method, Method]] = [("ttt", "lift"), ("auto", "corrected")]
    for method, made in methods:
        lift = Painter().apply(Painter().encode(splats), [view], "local", made)
        asset = painter.encode(splats, method, ("local",))
        result = painter.apply(asset, [view], "local", method)
        assert asset.encoding is None and result.receipt is not None and result.receipt.method == made
        assert NOT_LOCAL in result.receipt.note and "\n" not in result.receipt.note
        for name in ("means", "quats", "scales", "opacities", "sh"):
            np.testing.assert_array_equal(getattr(result.splats, name), getattr(lift.splats, name))
