"""The densifier: curves, selection, sampling, windows, masks, children, and the whole against hand-made cases."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from splatbench.densification import densifier, training, view_features
from splatbench.densification.densifier import Densifier, densified, prepared
from splatbench.densification.densify_config import COMPACT, PRESETS, DensifyConfig
from splatbench.densification.training import ms_ssim
from torch.nn import functional as F

from splatpainter.cameras import Camera, orbit
from splatpainter.cli import main
from splatpainter.metrics import psnr, ssim
from splatpainter.models import checkpoint
from splatpainter.models.model import SplatPainterModel
from splatpainter.nn.attention import Groups
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, Splats
from splattrain import recipes
from splattrain.data.object_sources import ProceduralSource
from splattrain.data.samples import SampleRecipe, SampleStream
from splattrain.distributed import Group
from splattrain.loop import Loop
from tests.support.model_scenes import TINY
from tests.support.train_scenes import RECIPE

SMALL = replace(COMPACT, most=100, widths=(16, 24), heads=2, window=16, frequencies=2)
CAMERA = Camera(64, 64, 80.0, 80.0, 32.0, 32.0, np.eye(4))


def sphere(count: int = 300, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    return Splats(
        means.astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.uniform(0.05, 0.15, (count, 3)).astype(np.float32),
        rng.uniform(0.3, 0.9, count).astype(np.float32),
        (0.5 * rng.normal(size=(count, 4, 3))).astype(np.float32),
    )


def views(splats: Splats, count: int = 3) -> tuple[list[Camera], list[np.ndarray]]:
    """Pictures that differ from the renders: darker, so that every Gaussian is pulled at."""
    cameras = orbit((0, 0, 0), 4.0, count, width=48, height=48)
    return cameras, [0.6 * picture.clip(0, 1) for picture in render(splats, cameras).colors]


def model(config: DensifyConfig = SMALL, awake: float = 0.0) -> Densifier:
    """awake: spread of what the heads and masks say."""
    torch.manual_seed(1)
    made = Densifier(config)
    if awake:
        for head in made.network.heads:
            torch.nn.init.normal_(head.linear.weight, std=awake)  # type: ignore[union-attr]
    return made.eval()


def test_curves_by_hand_and_by_what_defines_them() -> None:
    """Z-order: x y z bits from the top. Hilbert: every cell once, each next to the one before."""
    cell = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0], [3, 1, 2], [7, 7, 7]])
    # 3, 1, 2 = 011, 001, 010 -> 000 101 110 = 46
    assert densifier.z_order(cell, 3).tolist() == [4, 2, 1, 32, 46, 511]
    every = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3)
    key = densifier.hilbert(every, 3)
    assert sorted(key.tolist()) == list(range(512))
    assert (np.abs(np.diff(every[np.argsort(key)], axis=0)).sum(1) == 1).all()
    assert (
        densifier.windows(100, 48) == [48, 48, 4]
        and densifier.windows(96, 48) == [48, 48]
        and densifier.windows(0, 48) == []
    )
    lo, points = np.zeros(3), np.array([[0.9, 0.1, 0.1], [0.1, 0.1, 0.9], [0.1, 0.1, 0.1], [5, -3, 0]])
    assert densifier.along(points, lo, 1.0, "z").tolist() == [2, 1, 0, 3]  # x weighs most; outside: the nearest cell
    assert densifier.along(points, lo, 1.0, "z-turned").tolist() == [2, 3, 0, 1]  # z weighs most
    same = np.full((5, 3), 0.3)
    assert all(densifier.along(same, lo, 1.0, curve).tolist() == [0, 1, 2, 3, 4] for curve in densifier.CURVES)


def test_pull_grows_where_the_picture_differs_and_the_hardest_are_chosen() -> None:
    asset = sphere(4)
    means = np.array([[-0.5, 0, 3], [0.5, 0, 3], [0.5, 0.5, 3], [-0.5, 0.5, 3]], np.float32)
    asset = replace(asset, means=means, scales=np.full((4, 3), 0.08, np.float32), opacities=np.full(4, 0.8, np.float32))
    picture = render(asset, CAMERA).colors[0].clip(0, 1)
    changed = picture.copy()
    changed[:, 32:] = 1 - changed[:, 32:]  # around Gaussians 1 and 2 alone
    measured = view_features.measure_views(asset, [CAMERA], [changed])
    assert measured.pull[[1, 2]].min() > 10 * measured.pull[[0, 3]].max()
    assert measured.coverage.shape == (1, 4) and measured.coverage.min() > 1
    assert np.allclose(measured.renders[0], picture, atol=1e-6)
    pull = np.array([3.0, 5.0, 0.0, 5.0], np.float32)
    assert view_features.choose(asset, pull, replace(SMALL, most=2)).tolist() == [1, 3]
    assert view_features.choose(asset, pull, SMALL).tolist() == [0, 1, 3]  # nothing pulls at Gaussian 2
    faint = replace(asset, opacities=np.array([0.8, 0.005, 0.8, 0.006], np.float32))
    assert view_features.choose(faint, pull, SMALL).tolist() == [0, 3]


def test_pictures_are_sampled_where_gaussians_lie() -> None:
    point = np.array([[0.3, -0.2, 2.0], [0, 0, -1.0]])
    at = view_features.project(point, CAMERA)
    assert np.allclose(at[0], [80 * 0.15 + 32, 80 * -0.1 + 32]) and at[1].max() < 0
    ramp = np.stack(np.meshgrid(np.arange(8) + 0.5, np.arange(8) + 0.5), -1).astype(np.float32)  # its own x, y
    positions = np.array([[2.5, 3.5], [4.0, 2.25], [6.1, 6.9]])
    assert np.allclose(view_features.sample(ramp, positions, np.zeros(3, int)), positions, atol=1e-5)
    assert np.allclose(
        view_features.sample(ramp, positions, np.ones(3, int)), positions, atol=1e-5
    )  # means of a ramp are a ramp
    checker = (np.indices((8, 8)).sum(0) % 2).astype(np.float32)[..., None]
    assert np.allclose(view_features.sample(checker, positions, np.full(3, 1)), 0.5)  # 2 x 2 pixels: grey
    assert np.allclose(
        view_features.sample(ramp, np.array([[-9.0, 4.0]]), np.zeros(1, int)), [[0.5, 4.0]]
    )  # the edge's


def test_features_say_what_was_put_in() -> None:
    asset, (cameras, colors) = sphere(), views(sphere())
    measured = view_features.measure_views(asset, cameras, colors)
    gaussian_ids = view_features.choose(asset, measured.pull, SMALL)
    inputs = view_features.gather(asset, gaussian_ids, measured, cameras, colors, SMALL)
    assert inputs.features.shape == (100, view_features.feature_count(SMALL)) and torch.isfinite(inputs.features).all()
    assert inputs.features.abs().max() < 8
    sigma = inputs.gaussians.scales.gather(1, inputs.ranks)
    assert (sigma[:, 0] >= sigma[:, 1]).all() and (sigma[:, 1] >= sigma[:, 2]).all()
    # Axes: the covariance R S^2 R^T, from the Gaussian's own quaternion by hand, has them as eigenvectors.
    w, x, y, z = F.normalize(inputs.gaussians.quats, dim=1).double().unbind(1)
    first = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)  # image of the x axis
    k = (inputs.ranks == 0).nonzero()[:, 1]
    assert torch.allclose(inputs.axes[torch.arange(100), k].double(), first, atol=1e-5)
    # Of a picture that is exactly the render there is no difference to see.
    plain = [picture.clip(0, 1) for picture in render(asset, cameras).colors]
    same = view_features.gather(
        asset, gaussian_ids, view_features.measure_views(asset, cameras, plain), cameras, plain, SMALL
    ).features
    harmonics = 3 * (SMALL.sh_degree + 1) ** 2
    changes = same[:, 13 + harmonics + 3 : 13 + harmonics + 9 + 27]
    assert changes.abs().max() < 1e-5
    assert inputs.features[:, 13 + harmonics + 3 : 13 + harmonics + 9 + 27].abs().max() > 0.05


def test_attention_is_dense_attention_inside_windows_along_the_curve() -> None:
    torch.manual_seed(0)
    block = densifier.WindowBlock(8, 2, 16).double()
    torch.nn.init.normal_(block.adapt.weight, std=0.1)
    x, order = torch.randn(10, 8, dtype=torch.float64), torch.randperm(10)
    actual = block(x, order, Groups.of(densifier.windows(10, 4)))
    gain, shift, gain_mlp, shift_mlp = block.adapt(F.silu(x.mean(0))).split(8)
    centred = (x - x.mean(1, keepdim=True)) / (x.var(1, unbiased=False, keepdim=True) + 1e-5).sqrt()
    y = centred * (1 + gain) + shift
    hand = torch.zeros_like(x)
    for a, b in pairwise([0, 4, 8, 10]):
        window = order[a:b]
        q, k, v = (y[window] @ block.attention.qkv.weight.T).chunk(3, 1)
        for head in (slice(0, 4), slice(4, 8)):
            weights = torch.softmax(q[:, head] @ k[:, head].T / 2, 1)  # sqrt(4) wide
            hand[window, head] = weights @ v[:, head]
    z = x + hand @ block.attention.out.weight.T
    centred = (z - z.mean(1, keepdim=True)) / (z.var(1, unbiased=False, keepdim=True) + 1e-5).sqrt()
    assert torch.allclose(actual, z + block.mlp(centred * (1 + gain_mlp) + shift_mlp), atol=1e-10)


def test_masks_codes_and_even_splits_by_hand() -> None:
    chance = torch.tensor([0.2, 0.9, 0.5, 0.5, 0.1])
    assert densifier.split_mask(chance, 0.4).tolist() == [False, True, True, False, False]  # of equals the first
    assert densifier.split_mask(chance, 0.8).sum() == 4 and densifier.split_mask(chance, 1.0).all()
    code = densifier.wave_code(torch.tensor([[0.5, 0.25, 0.0]]), 2)[0].tolist()
    half = math.sqrt(0.5)
    assert np.allclose(code, [1, 0, 0, -1, half, 1, half, 0, 0, 0, 1, 1], atol=1e-6)
    for count in (2, 4):
        offsets = densifier.even_split(count).double()
        assert offsets.shape == (count, 3) and torch.allclose(offsets.sum(0), torch.zeros(3).double())
        spread = offsets.square().mean(0) + torch.tensor([1.0, float(count == 4), 0.0]) * densifier.CHILD_SCALE**2
        assert torch.allclose(spread[: count // 2], torch.ones(count // 2).double(), atol=1e-6)  # the parent's variance


@pytest.mark.parametrize("count", [2, 4])
def test_a_split_gaussian_looks_like_its_parent(count: int) -> None:
    """Composited alpha over the plane of the two long axes, integrated numerically."""
    line = torch.linspace(-4, 4, 161, dtype=torch.float64)
    x, y = torch.meshgrid(line, line, indexing="ij")
    narrow = densifier.CHILD_SCALE
    for opacity in (0.1, 0.5, 0.95):
        a, b = densifier.CHILD_OPACITY_FITS[count]
        clear = torch.ones_like(x)
        for u, v, _ in densifier.even_split(count).tolist():
            tall = narrow if count == 4 else 1.0
            clear *= 1 - opacity * (a + b * opacity) * torch.exp(-(((x - u) / narrow) ** 2 + ((y - v) / tall) ** 2) / 2)
        parent = opacity * torch.exp(-(x * x + y * y) / 2)
        error = ((1 - clear - parent).square().sum() / parent.square().sum()).sqrt()
        assert error < 0.18, (opacity, error)


def test_an_untrained_densifier_stays_near_the_asset_and_keeps_what_it_does_not_choose() -> None:
    asset, (cameras, colors) = sphere(), views(sphere())
    made = densified(model(), asset, cameras, colors)
    assert len(made.chosen) == 100 and made.splats.sh_degree == asset.sh_degree
    # ceil(0.8 100) = 80 go on, 20 stay; 160 children, 128 go on, 32 stay; 512 grandchildren.
    assert len(made.parents) == 20 + 32 + 512 and len(made.splats) == 300 - 100 + len(made.parents)
    stay = np.setdiff1d(np.arange(300), made.chosen)
    out = made.splats.numpy()
    for name in ATTRIBUTES:
        assert np.array_equal(getattr(out, name)[:200], getattr(asset, name)[stay])
    assert set(made.parents.tolist()) == set(made.chosen.tolist())
    # New Gaussians lie within their parents, and colours are the parents' own.
    assert (
        np.linalg.norm(out.means[200:] - asset.means[made.parents], axis=1) < asset.scales[made.parents].max(1) * 2
    ).all()
    assert np.array_equal(out.sh[200:], asset.sh[made.parents])
    before, after = (render(s, cameras).colors.astype(np.float64).clip(0, 1) for s in (asset, out))
    without = render(asset.take(stay), cameras).colors.astype(np.float64).clip(0, 1)
    assert psnr(after[0], before[0]) > max(25.0, psnr(without[0], before[0]) + 6)
    absolute = densified(model(replace(SMALL, head="absolute")), asset, cameras, colors)
    new = absolute.splats.opacities[200:]
    assert torch.allclose(new, torch.full_like(new, 1 / (1 + math.exp(2.1792))), atol=0.05)


def test_the_order_of_gaussians_does_not_matter() -> None:
    """The network is equivariant: what a Gaussian becomes does not depend on where in the list it stands."""
    asset, (cameras, colors) = sphere(), views(sphere())
    net = model(awake=0.3)
    order = np.random.default_rng(3).permutation(300)
    here, there = (densified(net, s, cameras, colors) for s in (asset, asset.take(order)))
    assert set(order[there.chosen].tolist()) == set(here.chosen.tolist())

    def sorted_rows(splats: Splats) -> np.ndarray:
        values = np.concatenate([splats.means, splats.scales, splats.sh.reshape(len(splats), -1)], 1)
        return values[np.lexsort(values[:, :3].round(3).T)]

    assert np.allclose(sorted_rows(here.splats.numpy()), sorted_rows(there.splats.numpy()), atol=2e-3)


def test_gradients_reach_every_weight_and_one_scene_is_learnt() -> None:
    asset, (cameras, colors) = sphere(), views(sphere())
    net = model(awake=0.01).train()
    rng = np.random.default_rng(0)
    rate, losses = torch.optim.Adam(net.parameters(), 3e-3), []
    truth = torch.from_numpy(np.stack(colors))
    for step in range(12):
        made = densified(net, asset, cameras, colors, rng)
        loss = (render(made.splats, cameras).colors - truth).square().mean()
        rate.zero_grad()
        loss.backward()
        if step == 1:
            dead = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()]
            assert not dead, dead
        rate.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.6 * losses[0]


def test_checkpoints_are_of_their_own_format(tmp_path: Path) -> None:
    net = model(awake=0.1)
    net.save(tmp_path, {"step": 3})
    back = Densifier.load(tmp_path)
    assert back.config == SMALL and back.notes == {"step": 3}
    for name, value in net.state_dict().items():
        assert torch.equal(back.state_dict()[name], value.half().float()), name
    with pytest.raises(ValueError, match="expected format 'splatpainter model'; this is 'splatpainter densifier'"):
        SplatPainterModel.load(tmp_path)
    assert checkpoint.notes(tmp_path) == {"step": 3}
    torch.manual_seed(0)
    SplatPainterModel(TINY).save(tmp_path / "other")
    with pytest.raises(ValueError, match="expected format 'splatpainter densifier'; this is 'splatpainter model'"):
        Densifier.load(tmp_path / "other")
    for preset in PRESETS.values():
        assert DensifyConfig.from_json(preset.to_json()) == preset
    with pytest.raises(ValueError, match=r"where: unknown key 'mots'"):
        DensifyConfig.from_json(json.dumps({"mots": 1}), "where")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"most": 0}, "most of at least 1"),
        ({"widths": (16,)}, "as many widths as children"),
        ({"widths": (16, 25)}, "multiples of the 2 heads"),
        ({"children": (2, 3)}, "2 or 4 children"),
        ({"keep": 0.0}, "keep above 0"),
    ],
)
def test_settings_that_make_no_sense(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **change)  # type: ignore[arg-type]


def test_bad_input_is_one_line() -> None:
    asset, (cameras, colors) = sphere(), views(sphere())
    with pytest.raises(ValueError, match="a picture for each camera, got 2 for 3"):
        prepared(SMALL, asset, cameras, colors[:2])
    with pytest.raises(ValueError, match=r"expected 48x48 RGB pictures, got \[24, 24, 3\]"):
        prepared(SMALL, asset, cameras, [picture[:24, :24] for picture in colors])
    with pytest.raises(ValueError, match="views that show at least 16 Gaussians, got 8"):
        prepared(replace(SMALL, most=8), asset, cameras, colors)


def test_ms_ssim_against_the_metric() -> None:
    """One scale is SSIM itself; equal pictures are 1; at two scales the finer has no luminance term."""
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 1, 20, 20, 3))
    first, second = torch.from_numpy(a), torch.from_numpy(b)
    near = 0.8 * first + 0.2 * second
    assert np.isclose(float(ms_ssim(near, first)), ssim(near[0].numpy(), a[0]), atol=1e-6)
    large = torch.from_numpy(rng.random((2, 64, 48, 3)))
    assert np.isclose(float(ms_ssim(large, large)), 1)
    # Half the contrast, two scales (24 px: 24 and 12): c is (s + C2) / (1.25 s + C2) of the local variance s = 0.
    flat, other = torch.full((1, 24, 24, 3), 0.5), torch.full((1, 24, 24, 3), 0.25)
    light = (2 * 0.125 + 1e-4) / (0.25 + 0.0625 + 1e-4)
    assert np.isclose(float(ms_ssim(flat, other)), light ** (0.2856 / (0.0448 + 0.2856)), atol=1e-4)
    with pytest.raises(ValueError, match="at least 11x11, got 8x8"):
        ms_ssim(torch.zeros(1, 8, 8, 3), torch.zeros(1, 8, 8, 3))


def test_the_command_finds_the_stage_and_its_recipes(capsys: pytest.CaptureFixture[str]) -> None:
    for path in training.RECIPES.glob("*.json"):
        recipe = recipes.load(path.stem.removesuffix("-densify"), "densify")
        assert isinstance(recipe, training.DensifyRecipe) and recipes.parse(recipe.to_json(), "densify") == recipe
    assert recipes.load("paper", "densify").densifier == PRESETS["paper"]  # type: ignore[attr-defined]
    assert main(["train", "densify", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert (
        "--densifier.head" in text and "Optimiser steps; the learning rate's cosine ends there. (default: 4000)" in text
    )
    assert main(["train", "densify"]) == 2
    assert "splatpainter train densify: --data is missing" in capsys.readouterr().err


def test_the_trainer_trains_it(tmp_path: Path) -> None:
    samples = SampleRecipe(
        {"zoom": 1.0}, size=32, rows=200, surfels=1500, base_views=2, novel_views=2, steps_per_object=2
    )
    base = {field.name: getattr(RECIPE, field.name) for field in fields(RECIPE) if field.name != "stage"}
    recipe = replace(
        training.DensifyRecipe(**base),
        densifier=SMALL,
        samples=samples,
        steps=3,
        batch=1,
        loss_views=2,
        gradient_rows=60,
        validate_every=3,
    )
    stored = recipe.to_dict()
    assert "model" not in stored and stored["densifier"]["most"] == 100
    assert recipes.parse(recipe.to_json(), "densify") == replace(recipe, model=recipes.Recipe().model)
    stream = SampleStream(ProceduralSource(2, seed=3), samples, seed=1)
    lines: list[str] = []
    torch.manual_seed(0)
    loop = Loop(training.make_task(recipe, None), recipe, stream, [stream[4]], tmp_path, Group(), report=lines.append)
    result = loop()
    assert result.step == 3 and result.failed == 0 and result.ended == "done"
    assert {"nothing", "ours", "gain", "around ours"} <= result.validation["zoom"].keys()
    trained = Densifier.load(tmp_path / "model")
    assert trained.config == SMALL and trained.notes["stage"] == "densify"
    # Going on, and starting from it.
    again = Loop(training.make_task(recipe, None), recipe, stream, [], tmp_path, Group(), resume=True)
    assert again.progress.step == 3
    followed = training.make_task(recipe, tmp_path / "model", lines.append)
    assert torch.equal(followed.model.network.embed.weight, trained.network.embed.weight)
    with pytest.raises(ValueError, match="weights of another model: window 16 there, 8 here"):
        training.make_task(replace(recipe, densifier=replace(SMALL, window=8)), tmp_path / "model")
