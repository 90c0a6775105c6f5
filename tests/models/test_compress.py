"""Stage I against a loop over voxels written out in plain torch, and what must not change it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from splatpainter.models.compress import Compressor
from splatpainter.models.config import CompressConfig, ModelConfig
from splatpainter.models.gaussian_groups import GaussianGroups, TokenLinks, attribute_features, links_from_views
from splatpainter.nn.layers import PackedBlock
from splatpainter.splats import ATTRIBUTES, Splats
from tests.support.model_scenes import TINY, cameras, grid_of, links, shell, with_compress

TOKENS = 50


def stage(config: ModelConfig, share: float = 1.0) -> Compressor:
    torch.manual_seed(7)
    made = Compressor(config.compress, config.lrm.dim, config.sh_degree, share)
    for p in made.parameters():  # larger than the first spread, so that attention is not uniform
        torch.nn.init.normal_(p, std=0.15)
    return made


def lrm_tokens(dim: int = TINY.lrm.dim) -> Tensor:
    return torch.randn(TOKENS, dim, generator=torch.Generator().manual_seed(11))


def attend(q: Tensor, k: Tensor, v: Tensor, heads: int) -> Tensor:
    """Softmax attention of one voxel by its formula. [n, D] each."""
    parts = []
    for a, b, c in zip(q.chunk(heads, 1), k.chunk(heads, 1), v.chunk(heads, 1), strict=True):
        parts.append(torch.softmax(a @ b.T / a.shape[1] ** 0.5, dim=1) @ c)
    return torch.cat(parts, 1)


def block(layer: PackedBlock, x: Tensor) -> Tensor:
    """x + MHA(LN x), x + SwiGLU(LN x) of one voxel."""
    h = layer.norm_attention(x)
    q, k, v = F.linear(h, layer.attention.qkv.weight).chunk(3, 1)
    x = x + F.linear(attend(q, k, v, layer.attention.heads), layer.attention.out.weight)
    h = layer.norm_mlp(x)
    gate, value = F.linear(h, layer.mlp.inner.weight).chunk(2, 1)
    return x + F.linear(F.silu(gate) * value, layer.mlp.outer.weight)


def by_voxel(
    net: Compressor, tokens: Tensor, gaussians: Splats[Tensor], tied: TokenLinks, groups: GaussianGroups, share: float
) -> dict[int, Tensor]:
    """Gaussian -> latent: one voxel at a time, the token and the attributes concatenated as in the paper."""
    features = attribute_features(gaussians, groups, net.degree)
    weight = torch.cat([net.token.weight, net.attribute.weight], 1)
    seen = F.layer_norm(tokens, tokens.shape[1:], net.token_norm.weight)
    latents: dict[int, Tensor] = {}
    at = 0
    for length in groups.lengths.tolist():
        members = groups.order[at : at + length].tolist()
        mean = torch.stack(
            [
                sum(
                    (float(w) * seen[p] for p, w in zip(tied.patches[i], tied.weights[i], strict=True)), torch.zeros(())
                )
                + torch.zeros_like(seen[0])
                for i in members
            ]
        )
        x = torch.cat([mean, features[at : at + length]], 1) @ weight.T
        at += length
        ranked = sorted(range(length), key=lambda j: (-float(gaussians.opacities[members[j]]), members[j]))
        survivors = ranked[: max(int(share * length), 1)]
        if net.config.grouping == "voxel_mean":
            z = x.mean(0, keepdim=True)
            for layer in [*net.encoder, *net.decoder]:
                assert isinstance(layer, PackedBlock)
                z = block(layer, z)
            z = z.expand(len(survivors), -1)
        else:
            for layer in net.encoder:
                assert isinstance(layer, PackedBlock)
                x = block(layer, x)
            query = x[survivors]
            if net.config.grouping == "latent_query":
                query = torch.stack([net.queries[k % len(net.queries)] for k in range(len(survivors))])
            k, v = F.linear(net.key_norm(x), net.cross.kv.weight).chunk(2, 1)
            q = F.linear(net.query_norm(query), net.cross.q.weight)
            z = query + F.linear(attend(q, k, v, net.cross.heads), net.cross.out.weight)
            for layer in net.decoder:
                assert isinstance(layer, PackedBlock)
                z = block(layer, z)
        latents |= {members[j]: z[n] for n, j in enumerate(survivors)}
    return latents


@pytest.mark.parametrize("share", [1.0, 0.25])
@pytest.mark.parametrize("grouping", ["feats_query", "latent_query", "voxel_mean"])
@torch.no_grad()
def test_equals_a_loop_over_voxels(grouping: str, share: float) -> None:
    config = with_compress(TINY, grouping=grouping)
    splats = shell()
    grid = grid_of(splats, config)
    groups = GaussianGroups.of(grid)
    assert groups.lengths.max() >= 5  # some voxels are worth attending in
    net, tied, tokens, gaussians = stage(config, share), links(len(splats), TOKENS), lrm_tokens(), splats.torch()
    latents = net(tokens, gaussians, tied, groups)
    expected = by_voxel(net, tokens, gaussians, tied, groups, share)
    assert sorted(latents.groups.order.tolist()) == sorted(expected)
    for gaussian_id, value in zip(latents.groups.order.tolist(), latents.values, strict=True):
        torch.testing.assert_close(value, expected[gaussian_id], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("grouping", ["feats_query", "voxel_mean"])
@torch.no_grad()
def test_permuting_the_gaussians_permutes_the_latents(grouping: str) -> None:
    config = with_compress(TINY, grouping=grouping)
    splats = shell()
    turn = np.random.default_rng(5).permutation(len(splats))
    net, tied, tokens = stage(config, 0.5), links(len(splats), TOKENS), lrm_tokens()
    other = TokenLinks(tied.patches[turn], tied.weights[turn])
    one = net(tokens, splats.torch(), tied, GaussianGroups.of(grid_of(splats, config)))
    two = net(tokens, splats.take(turn).torch(), other, GaussianGroups.of(grid_of(splats.take(turn), config)))
    index = {gaussian_id: n for n, gaussian_id in enumerate(one.groups.order.tolist())}
    match = [index[int(turn[gaussian_id])] for gaussian_id in two.groups.order.tolist()]
    assert len(match) == len(index)
    torch.testing.assert_close(two.values, one.values[match], rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_chunks_of_any_size_give_the_same() -> None:
    splats = shell()
    groups = GaussianGroups.of(grid_of(splats, TINY))
    net, tied, tokens, gaussians = stage(TINY, 0.25), links(len(splats), TOKENS), lrm_tokens(), splats.torch()
    complete = net(tokens, gaussians, tied, groups, chunk=len(splats))
    for chunk in (9, 128):
        part = net(tokens, gaussians, tied, groups, chunk=chunk)
        assert (part.groups.order == complete.groups.order).all() and (
            part.groups.starts == complete.groups.starts
        ).all()
        torch.testing.assert_close(part.values, complete.values, rtol=1e-4, atol=1e-5)


def test_two_runs_are_bitwise_equal_with_their_gradients() -> None:
    splats = shell()
    groups = GaussianGroups.of(grid_of(splats, TINY))
    results = []
    for _ in range(2):
        net, tokens = stage(TINY), lrm_tokens().requires_grad_()
        values = net(tokens, splats.torch(), links(len(splats), TOKENS), groups).values
        values.square().sum().backward()
        assert tokens.grad is not None
        results.append([values, tokens.grad, *(p.grad for p in net.parameters())])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_recomputed_activations_give_the_same_gradients() -> None:
    splats = shell()
    groups = GaussianGroups.of(grid_of(splats, TINY))
    grads = []
    for again in (False, True):
        net = stage(with_compress(TINY, checkpoint_activations=again))
        net(lrm_tokens(), splats.torch(), links(len(splats), TOKENS), groups).values.square().sum().backward()
        grads.append([p.grad for p in net.parameters()])
    assert all(g is not None and g.any() for g in grads[0])
    assert all(torch.equal(a, b) for a, b in zip(*grads, strict=True))


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_kept_gaussians_are_the_most_opaque_with_stable_ties(share: float) -> None:
    """Against sorted(): K = max(floor(share N_k), 1), equal opacities by Gaussian."""
    splats = shell(400)
    coarse = (np.round(splats.opacities * 4) / 4).astype(np.float32)  # many ties
    splats = replace(splats, opacities=coarse)
    groups = GaussianGroups.of(grid_of(splats, TINY))
    survivors, positions = groups.most_opaque(share)
    assert (groups.order[positions] == survivors.order).all()
    for b, length in enumerate(groups.lengths.tolist()):
        members = groups.order[groups.starts[b] : groups.starts[b + 1]].tolist()
        expected = sorted(members, key=lambda i: (-coarse[i], i))[: max(int(share * length), 1)]
        assert survivors.order[survivors.starts[b] : survivors.starts[b + 1]].tolist() == expected


@pytest.mark.parametrize("largest", [1, 3, 7, 10_000])
def test_cut_groups_hold_the_gaussians_of_one_voxel_in_its_order(largest: int) -> None:
    grid = grid_of(shell(), TINY)
    cut = GaussianGroups.of(grid, largest)
    pieces = {tuple(cut.order[a:b].tolist()) for a, b in pairwise(cut.starts.tolist())}
    voxels = [grid.order[a:b].tolist() for a, b in pairwise(grid.starts.tolist())]
    assert pieces == {tuple(members[k : k + largest]) for members in voxels for k in range(0, len(members), largest)}
    assert len(pieces) == len(cut.lengths) and (np.diff(cut.lengths) >= 0).all()  # shorter ones first
    centers = grid.centers(grid.index[cut.order])  # by each Gaussian's own key
    assert np.array_equal(cut.gaussian_centers(), centers)
    some = np.random.default_rng(0).integers(0, len(cut), 50)
    assert np.array_equal(cut.gaussian_centers(some), centers[some])


@pytest.mark.parametrize("chunk", [1, 5, 64, 1000])
def test_chunks_cover_all_groups_once(chunk: int) -> None:
    groups = GaussianGroups.of(grid_of(shell(), TINY))
    parts = list(groups.chunks(chunk))
    assert np.array_equal(np.concatenate([p.order for p in parts]), groups.order)
    assert np.array_equal(np.concatenate([p.lengths for p in parts]), groups.lengths)
    assert all(len(p) <= chunk or len(p.lengths) == 1 for p in parts)


def test_features_of_one_gaussian_by_hand() -> None:
    """A Gaussian whose numbers can be read off: a cube of 2 voxels of edge 0.5 around the origin."""
    gaussians = Splats(
        means=torch.tensor([[0.375, -0.25, 0.125]]),
        quats=torch.tensor([[-2.0, 0.0, 0.0, 0.0]]),
        scales=torch.tensor([[0.5, 0.5 * np.e**4, 0.5 / np.e**4]]).float(),
        opacities=torch.tensor([0.5]),
        sh=torch.arange(3.0).reshape(1, 1, 3),
    )
    center = np.array([[0.25, -0.25, 0.25]])
    groups = GaussianGroups(np.array([0]), np.array([0, 1]), center, voxel=0.5, center=np.zeros(3), half_extent=0.5)
    actual = attribute_features(gaussians, groups, degree=1)[0]
    offset, mean, scale, quat = [0.25, 0, -0.25], [0.5, -0.5, 0.5], [0, 1, -1], [1, 0, 0, 0]
    expected = torch.tensor([*offset, *mean, *scale, *quat, 0.0, 0, 1, 2, *[0] * 9])
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-6)


def test_features_do_not_depend_on_units_or_origin_and_are_bounded() -> None:
    splats = shell()
    far = splats.means.copy()
    far[0] += 1e6  # a stray
    splats = replace(splats, means=far)
    # Powers of two, so that scaling is exact in float32.
    larger = replace(splats, means=splats.means * 64, scales=splats.scales * 64)
    one, two = (attribute_features(s.torch(), GaussianGroups.of(grid_of(s, TINY)), 3) for s in (splats, larger))
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-5)
    assert torch.isfinite(one).all() and one.abs().max() <= 16


def test_gaussians_without_a_view_have_no_token() -> None:
    """Their latents do not move when the tokens do; those of the voxels beside them do."""
    splats = shell()
    alone = GaussianGroups.of(grid_of(splats, TINY), max_size=1)
    tied = links(len(splats), TOKENS)
    net, gaussians = stage(TINY), splats.torch()
    with torch.no_grad():
        one = net(lrm_tokens(), gaussians, tied, alone).values
        two = net(lrm_tokens().flip(0), gaussians, tied, alone).values
    moved = (one != two).any(1).numpy()
    assert (moved == (tied.weights[alone.order].sum(1) > 0)).all()


def test_links_against_one_gaussian_at_a_time() -> None:
    splats = shell(200)
    views = cameras(5)
    rng = np.random.default_rng(8)
    contributions = rng.random((5, 200), np.float32)
    contributions[:, ::9] = 0
    tied = links_from_views(splats.means, views, contributions, patch=8, max_links=3)
    assert tied.patches.shape == (200, 3)
    for i in range(200):
        best = []
        for v, camera in enumerate(views):
            x, y, z, _ = camera.world_to_camera @ [*splats.means[i].astype(np.float64), 1.0]
            u, w = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            if z > 0 and 0 <= u < 32 and 0 <= w < 32 and contributions[v, i] > 0:
                best.append((float(contributions[v, i]), v * 16 + int(w // 8) * 4 + int(u // 8)))
        best = sorted(best, key=lambda pair: -pair[0])[:3]
        total = sum(weight for weight, _ in best)
        actual = [(float(w), int(p)) for w, p in zip(tied.weights[i], tied.patches[i], strict=True) if w > 0]
        assert [p for _, p in actual] == [p for _, p in best]
        assert [w for w, _ in actual] == pytest.approx([w / total for w, _ in best], rel=1e-5)


def test_a_camera_inside_the_asset_links_nothing_behind_it() -> None:
    means = np.array([[3, -2, 6], [3, -2, 4], [3, -2, 5]], np.float32)  # ahead, behind, at the camera itself
    matrix = np.eye(4)
    matrix[:3, 3] = (-3, 2, -5)
    inside = replace(cameras(1)[0], world_to_camera=matrix)
    tied = links_from_views(means, [inside], np.ones((1, 3), np.float32), patch=8)
    assert tied.weights[:, 0].tolist() == [1, 0, 0]


def test_what_does_not_fit_is_refused() -> None:
    splats = shell(20)
    with pytest.raises(ValueError, match=r"expected contributions \[2, 20\], got \[3, 20\]"):
        links_from_views(splats.means, cameras(2), np.ones((3, 20), np.float32), 8)
    with pytest.raises(ValueError, match="expected links of 20 Gaussians, got 19"):
        stage(TINY)(lrm_tokens(), splats.torch(), links(19, TOKENS), GaussianGroups.of(grid_of(splats, TINY)))
    with pytest.raises(ValueError, match="expected two"):
        TokenLinks(np.zeros((3, 2), np.int64), np.zeros((3, 1), np.float32))
    with pytest.raises(ValueError, match="expected keep above 0"):
        CompressConfig(keep=0)


def test_the_asset_is_not_written_to() -> None:
    splats = shell().torch()
    before = {n: getattr(splats, n).clone() for n in ATTRIBUTES}
    stage(TINY)(lrm_tokens(), splats, links(len(splats), TOKENS), GaussianGroups.of(grid_of(splats, TINY)))
    assert all(torch.equal(getattr(splats, n), before[n]) for n in ATTRIBUTES)
