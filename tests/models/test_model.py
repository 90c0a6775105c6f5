"""The whole model: identity before training, determinism, the paper's sizes, checkpoints, clear refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from splatpainter.models.compress import Latents
from splatpainter.models.config import PRESETS, ModelConfig
from splatpainter.models.model import Decoded, Refined, SplatPainterModel
from splatpainter.splats import ATTRIBUTES, Splats
from tests.support.model_scenes import (
    TINY,
    asset_views,
    cameras,
    grid_of,
    links,
    pictures,
    shallow,
    shell,
    with_compress,
    with_refine,
)

COPY = replace(TINY, representation="copy", refine=replace(TINY.refine, lift_features=False))


def build(config: ModelConfig = TINY, seed: int = 7) -> SplatPainterModel:
    torch.manual_seed(seed)
    return SplatPainterModel(config).eval()


def wake(model: SplatPainterModel) -> SplatPainterModel:
    """As if trained: a head that says something."""
    torch.nn.init.normal_(model.head.linear.weight, std=0.05)
    return model


def encode(model: SplatPainterModel, splats: Splats) -> Latents:
    tokens = model.encode_views(asset_views(model.config))
    return model.compressor(
        tokens, splats.torch(), links(len(splats), len(tokens)), model.groups(grid_of(splats, model.config))
    )


def edit(
    model: SplatPainterModel, latents: Latents, latent_ids: np.ndarray | None = None, **options: object
) -> Refined:
    count = len(latents.values) if latent_ids is None else len(latent_ids)
    lift = torch.rand(count, 13, generator=torch.Generator().manual_seed(5))
    lift = lift if model.config.refine.lift_features else None
    return model.refine(
        model.initial_state(),
        latents,
        pictures(),
        latent_ids=latent_ids,
        lift=lift,
        **options,  # type: ignore[arg-type]
    )


def same_bits(a: Splats[Any], b: Splats[Any]) -> bool:
    """-0.0 and 0.0 differ."""
    ours, other = a.numpy(), b.numpy()
    return all((getattr(ours, n).view(np.int32) == getattr(other, n).view(np.int32)).all() for n in ATTRIBUTES)


@torch.no_grad()
def test_untrained_native_returns_the_asset_bit_for_bit() -> None:
    splats = shell(degree=3)
    signed = splats.means.copy()
    signed[5] = (-0.0, 0.0, -2.0)
    splats = replace(splats, means=signed)
    model = build()
    latents = encode(model, splats)
    refined = edit(model, latents, detail=True)
    decoded = model.decode(latents, refined, splats.torch())
    assert sorted(decoded.gaussian_ids.tolist()) == list(range(len(splats)))  # nothing is dropped
    assert same_bits(decoded.splats, splats.take(decoded.gaussian_ids))
    assert decoded.children is not None and len(decoded.children) == 0  # and nothing appended
    drawn = model.train().decode(latents, refined, splats.torch())  # but all of it is drawn where it must learn
    assert same_bits(drawn.splats, decoded.splats)
    assert drawn.children is not None and len(drawn.children) == len(splats)


@torch.no_grad()
def test_untrained_copy_returns_the_top_gaussians_of_the_lrm() -> None:
    model = build(COPY)
    copy = model.copied_gaussians(asset_views(COPY))
    output = model.lrm(asset_views(COPY)).splats
    opaque = output.opacities > COPY.compress.min_opacity
    assert same_bits(copy.gaussians, output.take(opaque))
    assert (copy.links.patches[:, 0] == (torch.arange(len(output)) // 64)[opaque].numpy()).all()
    grid = grid_of(copy.gaussians, COPY)
    latents = model.compressor(copy.tokens, copy.gaussians, copy.links, model.groups(grid))
    decoded = model.decode(latents, edit(model, latents, detail=True), copy.gaussians)
    opacities = copy.gaussians.opacities.numpy()
    expected = set()
    for b in range(len(grid.keys)):
        members = grid.order[grid.starts[b] : grid.starts[b + 1]].tolist()
        expected |= set(sorted(members, key=lambda i: (-opacities[i], i))[: max(len(members) // 4, 1)])
    assert set(decoded.gaussian_ids.tolist()) == expected and len(decoded.gaussian_ids) == len(expected)
    assert same_bits(decoded.splats, copy.gaussians.take(torch.from_numpy(decoded.gaussian_ids)))
    assert decoded.children is not None and len(decoded.children) == 0


@torch.no_grad()
def test_a_local_edit_decodes_the_chosen_gaussians_and_their_children() -> None:
    splats = shell()
    model = wake(build())
    latents = encode(model, splats)
    latent_ids = np.argsort(latents.groups.order)[[3, 50, 51, 7]]
    refined = edit(model, latents, latent_ids, detail=True)
    decoded = model.decode(latents, refined, splats.torch())
    assert decoded.gaussian_ids.tolist() == latents.groups.order[latent_ids].tolist()
    assert not same_bits(decoded.splats, splats.take(decoded.gaussian_ids))
    assert decoded.children is not None and decoded.parents is not None
    assert decoded.parents.tolist() == decoded.gaussian_ids.tolist() and len(decoded.children) == 4
    assert (decoded.children.numpy().scales < 0.9 * splats.take(decoded.parents).scales).all()
    # The same Gaussians of a global edit by the same lift features come out the same: Gaussians do not see each other.
    lift = torch.full((len(splats), 13), 0.5)
    state = model.initial_state()
    local = model.refine(state, latents, pictures(), latent_ids=latent_ids, lift=lift[:4])
    complete = model.refine(state, latents, pictures(), lift=lift)
    torch.testing.assert_close(local.values, complete.values[latent_ids], rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_copy_decodes_its_second_set_like_the_first() -> None:
    model = wake(build(COPY))
    copy = model.copied_gaussians(asset_views(COPY))
    latents = model.compressor(copy.tokens, copy.gaussians, copy.links, model.groups(grid_of(copy.gaussians, COPY)))
    refined = edit(model, latents, np.arange(10), detail=True)
    assert refined.detail_latents is not None
    decoded = model.decode(latents, refined, copy.gaussians)
    swapped = model.decode(
        latents, replace(refined, values=refined.detail_latents, detail_latents=None), copy.gaussians
    )
    assert decoded.children is not None and len(decoded.children) == 10  # the count doubles
    assert same_bits(decoded.children, swapped.splats)


@torch.no_grad()
def test_permuting_the_gaussians_permutes_the_edited_asset() -> None:
    splats, model = shell(), wake(build())
    turn = np.random.default_rng(4).permutation(len(splats))
    tokens = model.encode_views(asset_views(TINY))
    tied = links(len(splats), len(tokens))
    results = []
    for gaussians, patches, weights in (
        (splats, tied.patches, tied.weights),
        (splats.take(turn), tied.patches[turn], tied.weights[turn]),
    ):
        groups = model.groups(grid_of(gaussians, TINY))
        latents = model.compressor(tokens, gaussians.torch(), replace(tied, patches=patches, weights=weights), groups)
        refined = model.refine(model.initial_state(), latents, pictures(), lift=torch.full((len(splats), 13), 0.5))
        decoded = model.decode(latents, refined, gaussians.torch())
        back = np.argsort(decoded.gaussian_ids)
        results.append(decoded.splats.take(torch.from_numpy(back)))
    for name in ATTRIBUTES:
        one, two = (getattr(result, name) for result in results)
        torch.testing.assert_close(two, one[torch.from_numpy(turn)], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("detail", [False, True])
@pytest.mark.parametrize("latent_ids", [None, np.array([9, 2, 150, 151, 30]), np.array([], np.int64)])
@torch.no_grad()
def test_edit_is_refine_and_decode_in_runs_of_any_size(
    latent_ids: np.ndarray | None, detail: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    splats = shell().torch()
    model = wake(build())
    latents = encode(model, shell())
    lift = torch.rand(
        len(splats) if latent_ids is None else len(latent_ids), 13, generator=torch.Generator().manual_seed(5)
    )
    monkeypatch.setattr("splatpainter.models.model.LATENTS_PER_CHUNK", 16)
    first = model.initial_state()
    state, decoded = model.edit(first, latents, pictures(), splats, latent_ids=latent_ids, lift=lift, detail=detail)
    refined = model.refine(first, latents, pictures(), latent_ids=latent_ids, lift=lift, detail=detail)
    expected = model.decode(latents, refined, splats)
    assert decoded.gaussian_ids.tolist() == expected.gaussian_ids.tolist()
    assert (decoded.children is None) == (expected.children is None) == (not detail)
    for name in ATTRIBUTES:
        torch.testing.assert_close(getattr(decoded.splats, name), getattr(expected.splats, name), rtol=1e-4, atol=1e-5)
    for one, two in zip(state.blocks, refined.state.blocks, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


@torch.no_grad()
def test_bf16_stays_near_float32_and_the_identity_stays_exact() -> None:
    splats = shell()
    model = build()
    for awake in (False, True):
        if awake:
            wake(model)
        exact = model.decode_latents(encode(model, splats), splats.torch())
        with torch.autocast("cpu", torch.bfloat16):
            latents = encode(model, splats)
            rough = model.decode_latents(latents, splats.torch())
        assert latents.values.dtype == torch.float32
        base = splats.torch().take(latents.groups.order)
        if not awake:
            assert same_bits(rough, base)
            continue
        for name in ATTRIBUTES:
            moved = getattr(exact, name) - getattr(base, name)
            assert (getattr(rough, name) - getattr(exact, name)).norm() < 0.05 * moved.norm(), name


@torch.no_grad()
def test_latents_may_be_kept_in_half_precision() -> None:
    splats, model = shell(), wake(build())
    tokens = model.encode_views(asset_views(TINY))
    arguments = (tokens, splats.torch(), links(len(splats), len(tokens)), model.groups(grid_of(splats, TINY)))
    full, half = (model.compressor(*arguments, dtype=kind) for kind in (torch.float32, torch.float16))
    assert half.values.dtype == torch.float16 and torch.equal(half.values, full.values.half())
    one, two = (model.decode_latents(latents, splats.torch()) for latents in (full, half))
    with torch.autocast("cpu", torch.bfloat16):
        assert model.compressor(*arguments, dtype=torch.float16).values.dtype == torch.float16
    assert one.sh.dtype == two.sh.dtype == torch.float32
    torch.testing.assert_close(two.sh, one.sh, rtol=1e-2, atol=1e-2)


def training_step(config: ModelConfig, seed: int = 7) -> tuple[SplatPainterModel, Tensor]:
    """A forward and a backward pass through everything. Returns the model with its gradients, and the loss."""
    model = wake(build(config, seed)).train()
    if config.representation == "native":
        splats = shell().torch()
        latents = encode(model, shell())
    else:
        copy = model.copied_gaussians(asset_views(config))
        splats = copy.gaussians
        latents = model.compressor(copy.tokens, splats, copy.links, model.groups(grid_of(splats, config)))
    decoded: Decoded = model.decode(latents, edit(model, latents, detail=config.refine.detail), splats)
    parts = [decoded.splats] + ([decoded.children] if decoded.children is not None else [])
    loss = sum((getattr(part, n).square().mean() for part in parts for n in ATTRIBUTES), torch.zeros(()))
    loss.backward()
    return model, loss.detach()


def test_two_runs_with_one_seed_are_bitwise_equal() -> None:
    (one, a), (two, b) = training_step(TINY), training_step(TINY)
    assert torch.equal(a, b)
    grads = [(p.grad, q.grad) for p, q in zip(one.parameters(), two.parameters(), strict=True) if p.grad is not None]
    assert len(grads) > 40 and all(torch.equal(p, q) for p, q in grads if q is not None)


@pytest.mark.parametrize(
    "config",
    [
        COPY,
        replace(COPY, decoder="absolute"),
        with_compress(TINY, grouping="voxel_mean"),
        with_compress(COPY, grouping="latent_query"),
        with_refine(TINY, mixer="cross_attention"),
    ],
    ids=["copy", "absolute", "VoxelAtt", "latent query", "cross attention"],
)
def test_every_stage_of_an_ablation_learns(config: ModelConfig) -> None:
    model, loss = training_step(config)
    assert torch.isfinite(loss)
    for part in (model.compressor, model.refiner, model.head):
        dead = [name for name, p in part.named_parameters() if p.grad is None or not torch.isfinite(p.grad).all()]
        assert dead == []
    # The native model's LRM gives tokens only: its Gaussians' head has nothing to do.
    assert all(p.grad is not None and p.grad.any() for p in model.lrm.blocks.parameters())


def test_reduced_depth_paper_runs_forward_and_backward() -> None:
    """The paper's widths with one layer of each kind, two views of 16 px."""
    config = with_compress(shallow(PRESETS["paper"]), resolution=8)  # few Gaussians: coarse voxels, to have neighbours
    config = replace(config, lrm=replace(config.lrm, views=2, image_size=16))
    model, loss = training_step(config)
    assert torch.isfinite(loss) and model.compressor.token.weight.shape == (512, 1024)
    dead = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert dead == []


def test_save_and_load(tmp_path: Path) -> None:
    model = wake(build())
    model.save(tmp_path, dtype="float32", notes={"steps": 3})
    back = SplatPainterModel.load(tmp_path, "tiny")
    assert back.notes == {"steps": 3} and not back.training and back.config == TINY
    assert not any(t.is_meta for t in [*back.parameters(), *back.buffers()])
    splats = shell()
    with torch.no_grad():
        results = [m.decode(la, edit(m, la), splats.torch()) for m in (model, back) for la in [encode(m, splats)]]
    assert same_bits(results[0].splats, results[1].splats)
    with pytest.raises(ValueError, match="expected weights of preset 'compact', these are of preset 'tiny'"):
        SplatPainterModel.load(tmp_path, "compact")
    index = tmp_path / "model.json"
    data = json.loads(index.read_text())
    data["config"]["refine"]["hidden"] = 41
    index.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=r"mis-shaped weights: refiner\.blocks\.0\.mlp_.* instead of "):
        SplatPainterModel.load(tmp_path)


def test_what_the_model_cannot_do_is_refused_in_one_line() -> None:
    splats, model = shell(), build(with_refine(TINY, detail=False))
    with torch.no_grad():
        latents = encode(model, splats)
        with pytest.raises(ValueError, match=r"^refine: this model has no detail layer; [^\n]*$"):
            edit(model, latents, detail=True)
        with pytest.raises(ValueError, match=r"^refine: expected lift features \[3, 13\], got None$"):
            model.refine(model.initial_state(), latents, pictures(), latent_ids=np.arange(3))
        with pytest.raises(ValueError, match=r"^refine: expected lift features of 3 latents, got 200$"):
            model.edit(
                model.initial_state(),
                latents,
                pictures(),
                splats.torch(),
                latent_ids=np.arange(3),
                lift=torch.ones(200, 7),
            )
        with pytest.raises(ValueError, match=r"^encode: expected a grid of 4 voxels per edge, got 8$"):
            model.groups(grid_of(splats, with_compress(TINY, resolution=8)))
        blind = build(with_compress(COPY, min_opacity=0.99))
        with pytest.raises(ValueError, match=r"^encode: the model makes no visible Gaussian of the views; [^\n]*$"):
            blind.copied_gaussians(asset_views(COPY))
        with pytest.raises(ValueError, match="at most 16|1 to 16"):
            model.encode_views(replace(asset_views(TINY), cameras=cameras(17)))
