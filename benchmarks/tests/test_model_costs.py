"""Parameter counts pinned to the design's table; operations against torch's own counter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from splatbench.model_costs import flops, parameters, table
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from splatpainter.models.config import PRESETS, ModelConfig
from splatpainter.models.gaussian_groups import GaussianGroups
from splatpainter.models.image_tokens import tokenize
from splatpainter.models.model import SplatPainterModel
from tests.support.model_scenes import TINY, asset_views, grid_of, links, pictures, shell, with_refine


def test_the_paper_has_300_million_in_the_lrm_and_about_100_in_the_rest() -> None:
    size = parameters(PRESETS["paper"])
    # By hand: 24 blocks of 12 d^2 (attention 4, MLP 8), patches in and 59 numbers per pixel out, 50 gains of d.
    assert size.lrm == 24 * 12 * 1024**2 + 64 * (9 + 59) * 1024 + 50 * 1024 == 306_497_536
    d, hidden, fast = 512, 1344, 2048
    layer = 4 * d**2 + 3 * d * hidden + 2 * d
    # ... and the cross-attention with two norms, the norm and projection of tokens, the projection of 62 attributes.
    assert size.compress == 12 * layer + 4 * d**2 + 2 * d + 1024 + 1024 * d + 62 * d == 38_974_464
    # k, v, out, two queries; rates and gain; fast weights; two MLPs; four norms.
    block = 5 * d**2 + 4 * d + 3 * d * fast + 2 * 3 * d * hidden + 4 * d
    unread = d**2 + 3 * d * hidden + d  # what would make the last block's picture tokens
    detail = 4 * d**2 + 4 * d + 3 * d * fast + 2 * d
    assert size.refine == 8 * block - unread + detail + 64 * 9 * d == 70_879_744
    assert size.decode == 59 * d + 59 + 2 * d
    assert 90e6 < size.compress + size.refine + size.decode < 115e6


def test_compact_ships_within_its_budget() -> None:
    size = parameters(PRESETS["compact"])
    assert size.total <= 12_000_000 and 2 * size.total <= 25_000_000
    assert flops(PRESETS["compact"]).latent <= 8e6  # design: about 8 MFLOP per Gaussian in Stage II


@pytest.mark.parametrize("loss", ["dot", "l2"])
@pytest.mark.parametrize("representation", ["native", "copy"])
@torch.no_grad()
def test_operations_equal_what_torch_counts(loss: str, representation: str) -> None:
    config = replace(
        with_refine(TINY, inner_loss=loss, inner_steps=2, mask_tokens=False, blocks=3), representation=representation
    )
    torch.manual_seed(0)
    model = SplatPainterModel(config).eval()
    cost = flops(config, gaussians_per_voxel=4.0)
    views = asset_views(config)

    def counted(call) -> tuple[float, object]:  # noqa: ANN001
        # Attention by plain products: the counter does not know the CPU's fused kernel.
        with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
            result = call()
        return float(counter.get_total_flops()), result

    native = representation == "native"
    total, tokens = counted(lambda: model.encode_views(views) if native else model.lrm(views).tokens)
    assert total == pytest.approx(2 * cost.view, rel=1e-6)

    # Voxels of exactly four Gaussians each.
    splats = shell(200)
    full = GaussianGroups.of(grid_of(splats, config))
    groups = replace(full, starts=np.arange(0, 201, 4), centers=np.repeat(full.centers[:1], 50, axis=0))
    assert isinstance(tokens, torch.Tensor)
    tied, gaussians = links(200, len(tokens)), splats.torch()
    total, latents = counted(lambda: model.compressor(tokens, gaussians, tied, groups))
    projection = 2 * len(tokens) * config.lrm.dim * config.compress.dim
    # A kept Gaussian alone in its group needs no products for its attention.
    alone = 0 if native else config.compress.decoder_layers * 0.25 * 4 * config.compress.dim
    assert total == pytest.approx(200 * (cost.gaussian - alone) + projection, rel=1e-6)

    edit = tokenize(pictures(2), groups, config.refine)
    total, state = counted(lambda: model.refiner.adapt(model.initial_state(), edit))
    assert total == pytest.approx(2 * cost.picture + cost.edit, rel=1e-6)

    values = latents.values  # type: ignore[attr-defined]
    lift = torch.rand(len(values), 13)
    total, refined = counted(lambda: model.refiner.read(state, model.refiner.prepare(values, lift)))  # type: ignore[arg-type]
    head, _ = counted(lambda: model.head(values))
    assert total + head == pytest.approx(len(values) * cost.latent, rel=1e-6)
    total, _ = counted(lambda: model.refiner.read_detail(model.refiner.learn_detail(state, refined), values))  # type: ignore[arg-type]
    one_layer = cost.edit / config.refine.blocks
    assert total + head == pytest.approx(len(values) * cost.detail + one_layer, rel=1e-6)


@pytest.mark.parametrize("name", PRESETS)
def test_the_table_is_for_people(name: str) -> None:
    text = table(PRESETS[name])
    assert (
        name in text
        and len(text.splitlines()) == 5 + (PRESETS[name].predict.features > 0)
        and max(map(len, text.splitlines())) < 110
    )


def test_cross_attention_has_no_fixed_cost() -> None:
    config: ModelConfig = with_refine(TINY, mixer="cross_attention")
    with pytest.raises(ValueError, match="expected mixer 'ttt'"):
        flops(config)
