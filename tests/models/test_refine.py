"""Stage II against blocks written out in plain torch, with the inner gradient from autograd; state as a value."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from splatpainter.models.config import ModelConfig
from splatpainter.models.gaussian_groups import GaussianGroups
from splatpainter.models.image_tokens import Pictures, PictureTokens, tokenize
from splatpainter.models.refine import FastMixer, RefineBlock, Refiner, RefineState
from splatpainter.nn.fast_weights import FastWeights
from tests.support.model_scenes import SIZE, TINY, cameras, grid_of, pictures, shell, with_refine

DIM = TINY.compress.dim
GROUPS = GaussianGroups.of(grid_of(shell(), TINY))


def refiner(config: ModelConfig = TINY) -> Refiner:
    torch.manual_seed(7)
    made = Refiner(config.refine, config.compress.dim)
    for name, p in made.named_parameters():
        if name.rsplit(".", 1)[-1] not in ("w0", "w1", "w2"):
            torch.nn.init.normal_(p, std=0.15)
    return made


def some_latents(count: int = 60) -> Tensor:
    return torch.randn(count, DIM, generator=torch.Generator().manual_seed(13))


def some_lift(count: int = 60) -> Tensor:
    return torch.rand(count, 13, generator=torch.Generator().manual_seed(14))


def tensors(state: RefineState) -> list[Tensor]:
    memories = [*state.blocks, *([] if state.detail is None else [state.detail])]
    return [t for memory in memories for t in (memory if isinstance(memory, FastWeights) else [memory])]


def close(a: RefineState, b: RefineState, tolerance: float = 1e-4) -> bool:
    return all(
        torch.allclose(x, y, rtol=tolerance, atol=tolerance) for x, y in zip(tensors(a), tensors(b), strict=True)
    )


def fast(w0: Tensor, w1: Tensor, w2: Tensor, x: Tensor) -> Tensor:
    return (F.silu(x @ w0) * (x @ w2)) @ w1


def unit(x: Tensor) -> Tensor:
    return x / x.norm(dim=1, keepdim=True)


def mlp(layer: torch.nn.Module, x: Tensor) -> Tensor:
    gate, value = F.linear(x, layer.inner.weight).chunk(2, 1)  # type: ignore[union-attr]
    return F.linear(F.silu(gate) * value, layer.outer.weight)  # type: ignore[union-attr]


def by_formula(
    net: Refiner, tokens: PictureTokens, latents: Tensor, loss: str, weighted: bool
) -> tuple[list[Tensor], Tensor]:
    """One plain gradient step per block (no orthogonalisation), columns back to their norms; then the read."""
    strength = net.config.edit_strength
    x, z = F.linear(tokens.pixels, net.pictures.weight), latents
    share = tokens.weights if weighted else torch.ones_like(tokens.weights)
    state = []
    for block in net.blocks:
        assert isinstance(block, RefineBlock) and isinstance(block.mixer, FastMixer)
        ttt = block.mixer.ttt
        h = F.layer_norm(x, (DIM,), block.norm_pictures.weight)
        k, v = F.silu(F.linear(h, ttt.kv.weight)).detach().chunk(2, 1)
        k = unit(k)
        rates = F.softplus(F.linear(h, ttt.rates.weight) + np.log(np.expm1(0.01))) * share[:, None]
        weights = [w.detach()[0].clone().requires_grad_() for w in (ttt.w0, ttt.w1, ttt.w2)]
        moved = []
        for m, w in enumerate(weights):
            prediction = fast(weights[0], weights[1], weights[2], k)
            gain = (prediction * v).sum(1) if loss == "dot" else -0.5 * (prediction - v).square().sum(1)
            (slope,) = torch.autograd.grad((rates[:, m].detach() * gain).sum(), w)
            step = w.detach() + strength * slope
            moved.append(step * w.detach().norm(dim=0) / step.norm(dim=0))

        def read(stream: str, y: Tensor, moved: list[Tensor] = moved, ttt: torch.nn.Module = ttt) -> Tensor:
            q = unit(F.silu(F.linear(y, ttt.queries[stream].weight)))  # type: ignore[index]
            prediction = fast(moved[0], moved[1], moved[2], q)
            prediction = prediction * torch.rsqrt(prediction.square().mean(1, keepdim=True) + 1e-5) * ttt.gain  # type: ignore[operator]
            return F.linear(prediction, ttt.out.weight)  # type: ignore[union-attr]

        if not block.last:
            x = x + read("image", h)
            x = x + mlp(block.mlp_pictures, F.layer_norm(x, (DIM,), block.norm_pictures_mlp.weight))
        z = z + read("voxel", F.layer_norm(z, (DIM,), block.norm_rows.weight))
        z = z + mlp(block.mlp_rows, F.layer_norm(z, (DIM,), block.norm_rows_mlp.weight))
        state += moved
    return state, z


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("loss", ["dot", "l2"])
def test_equals_the_blocks_written_out(loss: str, masked: bool) -> None:
    config = with_refine(TINY, inner_loss=loss, newton_schulz_steps=0, mask_tokens=masked, edit_strength=30.0)
    net = refiner(config)
    tokens = tokenize(pictures(), GROUPS, config.refine)
    weights, expected = by_formula(net, tokens, some_latents(), loss, masked)
    with torch.no_grad():
        state = net.adapt(net.initial_state(), tokens)
        actual = net.read(state, some_latents())
    adapted = [w for memory in state.blocks for w in memory]
    first = [w for memory in net.initial_state().blocks for w in memory]
    assert all((a - b).abs().max() > 1e-3 for a, b in zip(adapted, first, strict=True))  # the step is not nothing
    for a, b in zip(adapted, weights, strict=True):
        torch.testing.assert_close(a[0], b, rtol=1e-4, atol=5e-5)
    torch.testing.assert_close(actual, expected, rtol=1e-3, atol=1e-4)


@torch.no_grad()
def test_cross_attention_equals_torchs_own() -> None:
    config = with_refine(TINY, mixer="cross_attention", blocks=1, detail=False)
    net = refiner(config)
    tokens = tokenize(pictures(), GROUPS, config.refine)
    state = net.adapt(net.adapt(net.initial_state(), tokens), tokenize(pictures(seed=4), GROUPS, config.refine))
    block = net.blocks[0]
    assert isinstance(block, RefineBlock)
    attention = block.mixer.rows
    memory = state.blocks[0]
    assert isinstance(memory, Tensor) and len(memory) > len(tokens.pixels)  # both edits are there
    z = some_latents()
    h = F.layer_norm(z, (DIM,), block.norm_rows.weight)
    theirs = torch.nn.MultiheadAttention(DIM, 2, bias=False)
    theirs.in_proj_weight.copy_(torch.cat([attention.q.weight, attention.kv.weight]))  # type: ignore[union-attr]
    theirs.out_proj.weight.copy_(attention.out.weight)  # type: ignore[union-attr]
    z = z + theirs(h, memory, memory)[0]
    z = z + mlp(block.mlp_rows, F.layer_norm(z, (DIM,), block.norm_rows_mlp.weight))
    torch.testing.assert_close(net.read(state, some_latents()), z, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_the_state_goes_in_and_comes_out() -> None:
    """An edit does not touch the state it starts from; the second edit starts where the first ended; going back to a
    kept state is exact."""
    net = refiner()
    first = net.initial_state()
    frozen = [t.clone() for t in tensors(first)]
    one, two = (tokenize(pictures(seed=s), GROUPS, TINY.refine) for s in (1, 4))
    after = net.adapt(first, one)
    copies = [t.clone() for t in tensors(after)]
    second = net.adapt(after, two)
    assert all(torch.equal(a, b) for a, b in zip(tensors(first), frozen, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(tensors(after), copies, strict=True))
    assert not close(second, net.adapt(first, two), 1e-3)
    again = net.adapt(after, two)
    assert all(torch.equal(a, b) for a, b in zip(tensors(again), tensors(second), strict=True))
    # Column norms survive any number of edits.
    for a, b in zip(tensors(second), frozen, strict=True):
        torch.testing.assert_close(a.norm(dim=-2), b.norm(dim=-2), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("changes", [{}, {"inner_steps": 3}, {"image_attention": True}, {"inner_loss": "l2"}])
@torch.no_grad()
def test_permuting_the_pictures_permutes_nothing_but_rounding(changes: dict) -> None:
    config = with_refine(TINY, **changes)
    net, edit = refiner(config), pictures(3)
    turn = [2, 0, 1]
    other = Pictures(
        [edit.cameras[i] for i in turn],
        *(None if x is None else x[turn] for x in (edit.edited, edit.render, edit.depth, edit.alpha, edit.mask)),  # type: ignore[arg-type]
    )
    one, two = (net.adapt(net.initial_state(), tokenize(p, GROUPS, config.refine)) for p in (edit, other))
    torch.testing.assert_close(net.read(one, some_latents()), net.read(two, some_latents()), rtol=1e-3, atol=1e-3)
    assert close(one, two, 2e-3)


@torch.no_grad()
def test_leaving_out_unedited_patches_equals_rates_of_zero() -> None:
    net, edit = refiner(), pictures(edited_share=0.02)
    few = tokenize(edit, GROUPS, TINY.refine)
    complete = tokenize(edit, GROUPS, replace(TINY.refine, mask_tokens=False))
    assert edit.mask is not None
    share = edit.mask.reshape(2, SIZE // 8, 8, SIZE // 8, 8).mean((2, 4)).flatten()
    assert 0 < len(few.pixels) < len(complete.pixels) and few.lengths.sum() == (share > 0).sum()
    padded = replace(complete, weights=share)
    assert close(net.adapt(net.initial_state(), few), net.adapt(net.initial_state(), padded), 1e-3)


@torch.no_grad()
def test_each_latent_is_read_alone_in_chunks_of_any_size() -> None:
    net = refiner()
    state = net.adapt(net.initial_state(), tokenize(pictures(), GROUPS, TINY.refine))
    latents = some_latents()
    complete = net.read(state, latents, chunk=1000)
    torch.testing.assert_close(net.read(state, latents, chunk=7), complete, rtol=1e-5, atol=1e-5)
    other = latents.clone()
    other[3] += 1
    changed = (net.read(state, other, chunk=1000) != complete).any(1)
    assert changed.nonzero().flatten().tolist() == [3]


@torch.no_grad()
def test_strength_zero_and_an_empty_edit_change_nothing() -> None:
    net, first = refiner(), refiner().initial_state()
    tokens = tokenize(pictures(), GROUPS, TINY.refine)
    calm = net.adapt(first, tokens, strength=0.0)
    empty = net.adapt(first, tokenize(pictures(edited_share=0), GROUPS, TINY.refine))
    for state in (calm, empty):
        assert all(torch.equal(a, b) for a, b in zip(tensors(state), tensors(first), strict=True))
    weak, strong = (net.adapt(first, tokens, strength=s) for s in (0.1, 1.0))
    distance = [
        sum(float((a - b).norm()) for a, b in zip(tensors(s), tensors(first), strict=True)) for s in (weak, strong)
    ]
    assert 0 < distance[0] < 0.3 * distance[1]


def second_set(net: Refiner, state: RefineState, original: Tensor, refined: Tensor) -> tuple[RefineState, Tensor]:
    state = net.learn_detail(state, refined)
    return state, net.read_detail(state, original)


@torch.no_grad()
def test_the_second_set_learns_from_the_refined_latents() -> None:
    net = refiner()
    state = net.adapt(net.initial_state(), tokenize(pictures(), GROUPS, TINY.refine))
    original = some_latents()
    refined = net.read(state, original)
    after, second = second_set(net, state, original, refined)
    assert second.shape == original.shape and not torch.allclose(second, refined, atol=1e-2)
    _, other = second_set(net, state, original, refined.flip(1))
    assert not torch.allclose(second, other, atol=1e-3)
    turn = torch.randperm(len(original), generator=torch.Generator().manual_seed(2))
    _, turned = second_set(net, state, original[turn], refined[turn])
    torch.testing.assert_close(turned, second[turn], rtol=1e-3, atol=1e-3)
    assert all(a is b for a, b in zip(after.blocks, state.blocks, strict=True)) and after.detail is not state.detail


ABLATIONS = [
    {},
    {"inner_loss": "l2", "inner_steps": 2},
    {"newton_schulz_steps": 0},
    {"image_attention": True},
    {"mixer": "cross_attention"},
    {"lift_features": False, "mask_tokens": False, "image_channels": ("edited", "rays")},
    {"detail": False},
    {"base": "lift", "detail": False},
    {"base": "lift", "detail": False, "row_tokens": 8},
]


@pytest.mark.parametrize("changes", ABLATIONS, ids=[" ".join(map(str, c)) or "compact" for c in ABLATIONS])
def test_no_parameter_of_any_configuration_is_dead(changes: dict) -> None:
    """Also no dependence is lost: the first fast weights and every slow head learn through the update."""
    config = with_refine(TINY, **changes).refine
    net = refiner(with_refine(TINY, **changes))
    gaussian_tokens = (some_latents()[:8], torch.rand(8, generator=torch.Generator().manual_seed(6)))
    teachers = gaussian_tokens if config.row_tokens else None
    state = net.adapt(net.initial_state(), tokenize(pictures(), GROUPS, config), teacher_tokens=teachers)
    drift = torch.randn(len(some_latents()), 7, generator=torch.Generator().manual_seed(4))
    original = net.prepare(some_latents(), some_lift() if config.lift_features else None, drift)
    values = net.read(state, original)
    if config.detail:
        values = torch.cat([values, second_set(net, state, original, values)[1]])
    (values * torch.randn(values.shape, generator=torch.Generator().manual_seed(3))).sum().backward()
    dead = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()]
    assert dead == []
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


def test_recomputed_activations_and_second_runs_give_the_same_gradients() -> None:
    results = []
    for again in (False, True, False):
        net = refiner(with_refine(TINY, checkpoint_activations=again))
        state = net.adapt(net.initial_state(), tokenize(pictures(), GROUPS, TINY.refine))
        net.read(state, some_latents()).square().sum().backward()
        results.append([p.grad for p in net.parameters() if p.grad is not None])
    assert len(results[0]) > 20
    assert all(torch.equal(a, b) and torch.equal(a, c) for a, b, c in zip(*results, strict=True))


@torch.no_grad()
def test_bf16_autocast_stays_near_float32() -> None:
    net, tokens = refiner(), tokenize(pictures(), GROUPS, TINY.refine)
    exact = net.read(net.adapt(net.initial_state(), tokens), some_latents())
    with torch.autocast("cpu", torch.bfloat16):
        state = net.adapt(net.initial_state(), tokens)
        rough = net.read(state, some_latents())
    assert all(t.dtype == torch.float32 for t in tensors(state))
    assert float((rough.float() - exact).norm() / exact.norm()) < 0.05


def test_gaussians_teach_like_pictures_with_heads_of_their_own() -> None:
    """One step of the fast weights on both sets is one ascent on the sum of their objectives (autograd), and Gaussians
    that count nothing, or an edit without pictures, teach nothing."""
    config = with_refine(TINY, row_tokens=6, blocks=1, newton_schulz_steps=0, inner_loss="dot").refine
    net = refiner(with_refine(TINY, row_tokens=6, blocks=1, newton_schulz_steps=0, inner_loss="dot"))
    tokens, lift = tokenize(pictures(), GROUPS, config), some_lift()
    chosen = net.teacher_ids(lift)
    assert chosen is not None and sorted(chosen.tolist()) == sorted(torch.argsort(-lift[:, 6])[:6].tolist())
    gaussian_tokens, shares = net.prepare(some_latents(), lift)[chosen].detach(), lift[chosen, 6]
    start = net.initial_state()
    (after,), (alone,) = (
        net.adapt(start, tokens, teacher_tokens=teachers).blocks for teachers in ((gaussian_tokens, shares), None)
    )
    (still,) = net.adapt(start, tokens, teacher_tokens=(gaussian_tokens, torch.zeros(6))).blocks
    assert all(torch.equal(a, b) for a, b in zip(alone, still, strict=True))
    assert not any(torch.allclose(a, b, atol=1e-6) for a, b in zip(alone, after, strict=True))

    block: Any = net.blocks[0]
    ttt = block.mixer.ttt
    weights = [w.detach().clone().requires_grad_(True) for w in start.blocks[0]]

    def outputs(kv: Any, rate: Any, x: torch.Tensor, count: torch.Tensor) -> list[torch.Tensor]:
        """<f(k), v> of every token, as often as matrices, each with its rate."""
        k, v = torch.nn.functional.silu(kv(x)).chunk(2, dim=1)
        k = k / (k.norm(dim=1, keepdim=True) + 1e-5)
        hidden = torch.nn.functional.silu(k @ weights[0][0]) * (k @ weights[2][0])
        rates = torch.nn.functional.softplus(rate(x) + np.log(np.expm1(0.01))) * count[:, None]
        return [(rates[:, m].detach() * ((hidden @ weights[1][0]) * v.detach()).sum(1)).sum() for m in (0, 1, 2)]

    seen = outputs(ttt.kv, ttt.rates, block.norm_pictures(net.pictures(tokens.pixels)), tokens.weights)
    teachers = outputs(ttt.kv_rows, ttt.rates_rows, block.norm_rows(gaussian_tokens), shares)
    for m, (weight, new) in enumerate(zip(weights, after, strict=True)):
        (way,) = torch.autograd.grad(seen[m] + teachers[m], weight, retain_graph=True)
        moved = weight + way
        expected = moved * weight.norm(dim=1, keepdim=True) / (moved.norm(dim=1, keepdim=True) + 1e-5)
        torch.testing.assert_close(new, expected, rtol=1e-3, atol=1e-4)


@torch.no_grad()
def test_normals_are_those_of_the_surface_that_is_seen() -> None:
    """A sphere's depth map: normals point from its centre to the surface, towards the camera."""
    (camera,) = cameras(1, 64)
    origin, directions = camera.rays()
    middle, radius = GROUPS.center, 0.9
    along = -((origin - middle) * directions).sum(-1)
    missed = ((origin - middle) ** 2).sum(-1) - along**2
    hit = missed < (0.85 * radius) ** 2
    reach = np.where(hit, along - np.sqrt(np.maximum(radius**2 - missed, 0)), 0)
    depth = reach * (directions @ camera.forward)
    far, solid = (torch.from_numpy(x.astype(np.float32))[None, ..., None] for x in (depth, hit))
    config = with_refine(TINY, image_channels=("edited", "normals"), mask_tokens=False).refine
    views = Pictures([camera], torch.zeros(1, 64, 64, 3), None, far, solid, None)
    pixels = tokenize(views, GROUPS, config).pixels.reshape(8, 8, 8, 8, 6).transpose(1, 2).reshape(64, 64, 6)
    expected = ((origin + reach[..., None] * directions) - middle) / radius
    inner = np.zeros((64, 64), bool)
    inner[2:-2, 2:-2] = np.lib.stride_tricks.sliding_window_view(hit, (5, 5)).all((2, 3))
    assert inner.sum() > 300
    cosine = (pixels[..., 3:].numpy() * expected).sum(-1)[inner]
    assert cosine.min() > 0.995
    assert not pixels[..., 3:][torch.from_numpy(~hit)].any()


@torch.no_grad()
def test_tokens_hold_the_pixels_of_their_patch() -> None:
    """An odd size is padded with nothing; the channels are where the config says, in one unit-free frame."""
    views = [replace(c, width=20, height=12, cx=10, cy=6) for c in cameras(2)]
    rng = np.random.default_rng(0)
    edited, render, depth, alpha = (torch.from_numpy(rng.random((2, 12, 20, c), np.float32)) for c in (3, 3, 1, 1))
    depth = 2 + depth
    mask = torch.zeros(2, 12, 20, 1)
    mask[1, 9, 17] = 1  # patch Gaussian 1, column 2 of view 1
    tokens = tokenize(Pictures(views, edited, render, depth, alpha, mask), GROUPS, TINY.refine)
    assert tokens.lengths.tolist() == [0, 1] and tokens.weights.tolist() == [1 / 64]
    pixels = tokens.pixels.reshape(8, 8, 17)
    assert not pixels[4:].any() and not pixels[:, 4:].any()  # Gaussians 12.. and columns 20.. are padding
    inside = pixels[:4, :4]
    crop = (1, slice(8, 12), slice(16, 20))
    torch.testing.assert_close(inside[..., :3], 2 * edited[crop] - 1)
    torch.testing.assert_close(inside[..., 9:12], 2 * render[crop] - 1)
    torch.testing.assert_close(inside[..., 15:16], 2 * alpha[crop] - 1)
    assert torch.equal(inside[..., 16:], mask[crop])
    # Rays and positions against the camera's own matrices, one pixel.
    origin, directions = views[1].rays()
    direction = directions[9, 17].astype(np.float64)
    position = (origin - GROUPS.center) / GROUPS.half_extent
    np.testing.assert_allclose(inside[1, 1, 3:6], direction, atol=1e-5)
    np.testing.assert_allclose(inside[1, 1, 6:9], position - (position @ direction) * direction, atol=1e-5)
    z = float(depth[1, 9, 17, 0])
    camera_point = z * np.array([(17.5 - views[1].cx) / views[1].fx, (9.5 - views[1].cy) / views[1].fy, 1])
    world = np.linalg.inv(views[1].world_to_camera) @ [*camera_point, 1]
    expected = np.clip((world[:3] - GROUPS.center) / GROUPS.half_extent, -2, 2) * float(alpha[1, 9, 17, 0])
    np.testing.assert_allclose(inside[1, 1, 12:15], expected, atol=1e-4)


def test_pictures_that_do_not_fit_are_refused_in_one_line() -> None:
    edit = pictures(2)
    with pytest.raises(ValueError, match=r"^edit: expected 1 to 16 pictures, got 17$"):
        pictures(17)
    mixed = [cameras(1)[0], cameras(1, 64)[0]]
    with pytest.raises(ValueError, match=r"^edit: expected pictures of one size, got 32x32, 64x64; [^\n]*$"):
        Pictures(mixed, edit.edited)
    with pytest.raises(ValueError, match=r"^edit: expected mask \[2, 32, 32, 1\], got \[2, 32, 32\]$"):
        Pictures(edit.cameras, edit.edited, mask=torch.ones(2, SIZE, SIZE))
    with pytest.raises(ValueError, match=r"^edit: this model's pictures have 'render' channels; [^\n]*$"):
        tokenize(Pictures(edit.cameras, edit.edited), GROUPS, TINY.refine)
    with pytest.raises(ValueError, match=r"^refine: expected lift features \[60, 13\], got None$"):
        refiner().prepare(some_latents(), None)
