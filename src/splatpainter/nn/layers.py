"""Transformer layers over packed tokens: every linear map and LayerNorm without bias, weights from N(0, 0.02).

T packed tokens, D width, H heads. The groups say which tokens see each other (nn.attention). All of it runs under bf16
autocast: what blocks add to stays float32 as it came, only what they multiply is rounded.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from splatpainter.nn.attention import CrossGroups, Groups, packed_attention

INITIAL_WEIGHT_STD = 0.02
"""Standard deviation of the weights at first, as GS-LRM has it (arXiv 2404.19702)."""
EPS = 1e-5
"""Added to the variance by LayerNorm and to the mean square by RMSNorm."""


def linear(inputs: int, outputs: int) -> nn.Linear:
    """A map without bias, weights from N(0, 0.02)."""
    layer = nn.Linear(inputs, outputs, bias=False)
    if not layer.weight.is_meta:  # to be filled by a checkpoint; drawing nothing would import half of torch, 1.6 s
        nn.init.normal_(layer.weight, std=INITIAL_WEIGHT_STD)
    return layer


def layer_norm(dim: int) -> nn.LayerNorm:
    """LayerNorm with a gain and no bias."""
    return nn.LayerNorm(dim, eps=EPS, bias=False)


def gated(x: Tensor) -> Tensor:
    """silu(a) * b of x = [a, b], [..., 2 F] -> [..., F]. x is the caller's to lose: without gradients it is
    overwritten, which saves a third of the memory traffic."""
    gate, value = x.chunk(2, dim=-1)
    if torch.is_grad_enabled():
        return functional.silu(gate) * value
    return functional.silu(gate, inplace=True).mul_(value)


class SwiGLU(nn.Module):
    """(silu(x A) * (x B)) C, arXiv 2002.05202. x: [..., D] -> [..., D]."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.inner = linear(dim, 2 * hidden)
        self.outer = linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.outer(gated(self.inner(x)))


class Gelu(nn.Module):
    """gelu(x A) B, the MLP of GS-LRM. x: [..., D] -> [..., D]."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.inner = linear(dim, hidden)
        self.outer = linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.outer(functional.gelu(self.inner(x)))


class SelfAttention(nn.Module):
    """Every token asks the tokens of its own group."""

    def __init__(self, dim: int, heads: int) -> None:
        """dim: D, a multiple of heads. Raises ValueError otherwise."""
        super().__init__()
        self.heads = _checked_heads(dim, heads)
        self.qkv = linear(dim, 3 * dim)
        self.out = linear(dim, dim)

    def forward(self, x: Tensor, groups: Groups) -> Tensor:
        """x: [T, D] -> [T, D]."""
        # One map makes all three: one large product instead of three small ones.
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).unbind(1)
        return self.out(packed_attention(q, k, v, groups).flatten(1))


class CrossAttention(nn.Module):
    """Every query token asks the context tokens of its own group."""

    def __init__(self, dim: int, heads: int) -> None:
        """dim: D of both, a multiple of heads. Raises ValueError otherwise."""
        super().__init__()
        self.heads = _checked_heads(dim, heads)
        self.q = linear(dim, dim)
        self.kv = linear(dim, 2 * dim)
        self.out = linear(dim, dim)

    def forward(self, x: Tensor, context: Tensor, groups: CrossGroups) -> Tensor:
        """x: [Tq, D], context: [Tk, D] -> [Tq, D]; zeros for queries without context."""
        q = self.q(x).unflatten(-1, (self.heads, -1))
        k, v = self.kv(context).unflatten(-1, (2, self.heads, -1)).unbind(1)
        return self.out(packed_attention(q, k, v, groups).flatten(1))


class PackedBlock(nn.Module):
    """A pre-norm transformer block: x + SelfAttention(LN x), then x + MLP(LN x)."""

    def __init__(self, dim: int, heads: int, hidden: int, mlp: Literal["swiglu", "gelu"] = "swiglu") -> None:
        """hidden: width inside the MLP. Raises ValueError where dim is not a multiple of heads."""
        super().__init__()
        self.norm_attention = layer_norm(dim)
        self.attention = SelfAttention(dim, heads)
        self.norm_mlp = layer_norm(dim)
        self.mlp = SwiGLU(dim, hidden) if mlp == "swiglu" else Gelu(dim, hidden)

    def forward(self, x: Tensor, groups: Groups) -> Tensor:
        """x: [T, D] -> [T, D]."""
        x = x + self.attention(self.norm_attention(x), groups)
        return x + self.mlp(self.norm_mlp(x))


def _checked_heads(dim: int, heads: int) -> int:
    if heads < 1 or dim % heads:
        raise ValueError(f"attention: expected a width that is a multiple of the heads, got {dim} and {heads}")
    return heads
