"""The layers with torch's own weights give what torch's own transformer layers give."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from splatpainter.nn.attention import CrossGroups, Groups
from splatpainter.nn.layers import CrossAttention, PackedBlock, SelfAttention, SwiGLU

LENGTHS = [5, 1, 0, 9, 10, 5]
DIM, HEADS, HIDDEN = 24, 4, 40


def tokens(count: int, seed: int = 0) -> Tensor:
    return torch.randn(count, DIM, generator=torch.Generator().manual_seed(seed))


def enlarged(module: nn.Module) -> nn.Module:
    """With weights large enough that every term shows."""
    generator = torch.Generator().manual_seed(3)
    for parameter in module.parameters():
        nn.init.normal_(parameter, std=0.3, generator=generator)
    return module


@pytest.mark.parametrize("heads", [1, 4])
def test_a_gelu_block_is_torchs_pre_norm_encoder_layer(heads: int) -> None:
    torch.manual_seed(0)
    ours = PackedBlock(DIM, heads, HIDDEN, mlp="gelu")
    enlarged(ours)
    theirs = nn.TransformerEncoderLayer(
        DIM, heads, HIDDEN, dropout=0, activation=functional.gelu, norm_first=True, batch_first=True, bias=False
    )
    theirs.load_state_dict(
        {
            "self_attn.in_proj_weight": ours.attention.qkv.weight,
            "self_attn.out_proj.weight": ours.attention.out.weight,
            "linear1.weight": ours.mlp.inner.weight,
            "linear2.weight": ours.mlp.outer.weight,
            "norm1.weight": ours.norm_attention.weight,
            "norm2.weight": ours.norm_mlp.weight,
        }
    )
    x = tokens(sum(LENGTHS))
    parts = [theirs(part[None])[0] for part in x.split(LENGTHS) if len(part)]
    torch.testing.assert_close(ours(x, Groups.of(LENGTHS)), torch.cat(parts), atol=2e-5, rtol=1e-5)


def test_cross_attention_is_torchs_multi_head_attention() -> None:
    lq, lk = [2, 3, 1, 4], [7, 1, 8, 3]
    ours = CrossAttention(DIM, HEADS)
    enlarged(ours)
    theirs = nn.MultiheadAttention(DIM, HEADS, bias=False, batch_first=True)
    theirs.load_state_dict(
        {"in_proj_weight": torch.cat([ours.q.weight, ours.kv.weight]), "out_proj.weight": ours.out.weight}
    )
    x, context = tokens(sum(lq)), tokens(sum(lk), 1)
    parts = [
        theirs(a[None], b[None], b[None], need_weights=False)[0][0]
        for a, b in zip(x.split(lq), context.split(lk), strict=True)
    ]
    torch.testing.assert_close(ours(x, context, CrossGroups.of(lq, lk)), torch.cat(parts), atol=2e-5, rtol=1e-5)


def test_swiglu_by_hand() -> None:
    layer = SwiGLU(2, 1)
    with torch.no_grad():
        layer.inner.weight.copy_(torch.tensor([[1.0, 2.0], [3.0, -1.0]]))  # gate, value
        layer.outer.weight.copy_(torch.tensor([[0.5], [-2.0]]))
    # x = (1, 1): gate 3, silu(3) = 3 / (1 + e^-3) = 2.857722; value 2; product 5.715445.
    torch.testing.assert_close(layer(torch.ones(2)), torch.tensor([2.8577224, -11.4308896]))


def test_a_swiglu_block_adds_attention_then_mlp() -> None:
    block = PackedBlock(DIM, HEADS, HIDDEN)
    enlarged(block)
    x, groups = tokens(sum(LENGTHS)), Groups.of(LENGTHS)
    between = x + block.attention(functional.layer_norm(x, (DIM,), block.norm_attention.weight), groups)
    inner = functional.layer_norm(between, (DIM,), block.norm_mlp.weight) @ block.mlp.inner.weight.T
    gate, value = inner.split(HIDDEN, 1)
    expected = between + (gate * torch.sigmoid(gate) * value) @ block.mlp.outer.weight.T
    torch.testing.assert_close(block(x, groups), expected, atol=2e-5, rtol=1e-5)


def test_permuting_tokens_of_a_group_permutes_the_result() -> None:
    block = PackedBlock(DIM, HEADS, HIDDEN)
    enlarged(block)
    x, groups = tokens(sum(LENGTHS)), Groups.of(LENGTHS)
    generator = torch.Generator().manual_seed(5)
    starts = torch.tensor([0, *LENGTHS[:-1]]).cumsum(0).tolist()
    order = torch.cat([s + torch.randperm(n, generator=generator) for s, n in zip(starts, LENGTHS, strict=True)])
    torch.testing.assert_close(block(x[order], groups), block(x, groups)[order], atol=2e-5, rtol=1e-5)


def test_no_biases_and_the_spread_of_the_first_weights() -> None:
    block = PackedBlock(256, 4, 512)
    assert not [name for name, _ in block.named_parameters() if name.endswith("bias")]
    for name, parameter in block.named_parameters():
        if "norm" in name:
            assert (parameter == 1).all()
        else:  # 65,536 draws or more: the standard deviation is known to 0.3 %
            assert abs(parameter.std().item() / 0.02 - 1) < 0.02


def test_a_block_under_bf16_autocast_follows_float32() -> None:
    block, x, groups = PackedBlock(64, 4, 128), torch.randn(30, 64), Groups.of([10, 20])
    with torch.autocast("cpu", torch.bfloat16):
        half = block(x, groups)
    assert half.dtype == torch.float32  # the residual stream stays wide
    torch.testing.assert_close(half, block(x, groups), atol=0.02, rtol=0.02)


@pytest.mark.parametrize("kind", [SelfAttention, CrossAttention])
def test_heads_must_divide_the_width(kind: type) -> None:
    with pytest.raises(ValueError, match="got 10 and 4"):
        kind(10, 4)
