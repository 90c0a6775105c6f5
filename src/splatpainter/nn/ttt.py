"""The test-time-training layer: slow heads that turn tokens into keys, values, queries and rates for fast weights.

The state is a value: `update` takes one and returns the next, the layer holds only the learned first one. So undo is
keeping the old value, and the second edit starts where the first ended. T tokens, D width, H heads of D / H.
"""

from __future__ import annotations

import math
from functools import reduce
from itertools import chain
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from splatpainter.nn import fast_weights
from splatpainter.nn.fast_weights import FastWeights, InnerLoss
from splatpainter.nn.layers import EPS, linear
from splatpainter.nn.precision import exact

Stream = Literal["image", "voxel"]
BASE_RATE = 0.01
"""Rate of a token whose head says 0."""
RATE_OFFSET = math.log(math.expm1(BASE_RATE))
"""softplus of this is BASE_RATE."""


class TTTLayer(nn.Module):
    """One fast network per head, trained by image tokens and read by image and voxel tokens (arXiv 2512.05354, 3.2).

    No norm before and no residual around it: the block has them.
    """

    def __init__(
        self,
        dim: int,
        fast_hidden: int,
        *,
        heads: int = 1,
        inner_loss: InnerLoss = "dot",
        inner_steps: int = 1,
        newton_schulz_steps: int = 5,
        edit_strength: float = 1.0,
        streams: tuple[Stream, ...] = ("image", "voxel"),
        teachers: tuple[Stream, ...] = ("image",),
    ) -> None:
        """dim: D, a multiple of heads. fast_hidden: hidden width of a head's fast network. streams: who may read; each
        has its own query head. teachers: who may train the fast weights; each has its own key, value and rate heads.
        The other settings: as in fast_weights.step."""
        super().__init__()
        if heads < 1 or dim % heads:
            raise ValueError(f"ttt: expected a width that is a multiple of the heads, got {dim} and {heads}")
        self.heads, self.teachers = heads, teachers
        self.inner_loss: InnerLoss = inner_loss
        self.inner_steps = inner_steps
        self.newton_schulz_steps = newton_schulz_steps
        self.edit_strength = edit_strength
        if "image" in teachers:
            self.kv = linear(dim, 2 * dim)
        self.queries = nn.ModuleDict({stream: linear(dim, dim) for stream in streams})
        if "image" in teachers:
            self.rates = linear(dim, 3 * heads)
        if "voxel" in teachers:
            self.kv_rows = linear(dim, 2 * dim)
            self.rates_rows = linear(dim, 3 * heads)
            if "voxel" in streams:
                start_alike(self.queries["voxel"], self.kv_rows)
        self.gain = nn.Parameter(torch.ones(dim // heads))
        self.out = linear(dim, dim)
        first = fast_weights.initial(dim // heads, fast_hidden, heads)
        self.w0, self.w1, self.w2 = (nn.Parameter(w) for w in first)

    def initial_state(self) -> FastWeights:
        """The learned first state: w0, w2 [H, D/H, F], w1 [H, F, D/H]. The parameters themselves: do not write."""
        return FastWeights(self.w0, self.w1, self.w2)

    def update(
        self,
        state: FastWeights,
        tokens: Tensor,
        mask: Tensor | None = None,
        *,
        teacher_tokens: tuple[Tensor, Tensor] | None = None,
        edit_strength: float | Tensor | None = None,
        chunk: int | None = None,
    ) -> FastWeights:
        """The state after an edit; the given one stays as it is.

        tokens: [T, D] of the whole edit, normalised. mask: [T] bool or 0..1, how much each token counts; 0 leaves it
        out exactly, and an edit of none returns the same bits. teacher_tokens: ([R, D] voxel tokens, normalised, [R]
        0..1 how much each counts), which teach along with the image tokens, in a layer with that teacher.
        edit_strength: overrides the layer's. chunk: tokens in work at once, which bounds the memory; the same up to
        rounding, since the direction is a sum over tokens.
        """
        size = chunk or max(len(tokens), 1)
        parts = tokens.split(size) if "image" in self.teachers else ()
        masks = [None] * len(parts) if mask is None or not parts else mask.split(size)
        # One part is kept over the inner steps, many are made again in each.
        single = self._keys_values_rates(tokens, mask, "image") if len(parts) == 1 else None
        voxels = () if teacher_tokens is None else (self._keys_values_rates(*teacher_tokens, "voxel"),)
        if not parts and not voxels:
            return state

        def direction(weights: FastWeights) -> FastWeights:
            pairs = zip(parts, masks, strict=True)
            images = (self._keys_values_rates(*pair, "image") for pair in pairs) if single is None else (single,)
            steps = (fast_weights.ascent(weights, *part, self.inner_loss) for part in chain(images, voxels))
            return reduce(lambda one, two: FastWeights(*(a + b for a, b in zip(one, two, strict=True))), steps)

        return fast_weights.advance(
            state,
            direction,
            inner_steps=self.inner_steps,
            newton_schulz_steps=self.newton_schulz_steps,
            edit_strength=self.edit_strength if edit_strength is None else edit_strength,
        )

    def read(self, state: FastWeights, tokens: Tensor, stream: Stream) -> Tensor:
        """What the fast network says to tokens [T, D] of a stream, -> [T, D]."""
        q = functional.silu(self.queries[stream](tokens)).unflatten(-1, (self.heads, -1))
        answer = fast_weights.apply(state, _unit(q).transpose(0, 1)).transpose(0, 1)  # [T, H, D/H]
        answer = functional.rms_norm(answer.float(), answer.shape[-1:], self.gain.float(), EPS)
        return self.out(answer.flatten(1))

    def _keys_values_rates(self, tokens: Tensor, mask: Tensor | None, stream: Stream) -> tuple[Tensor, Tensor, Tensor]:
        """Keys and values [H, T, D/H] and rates [H, T, 3] of a stream's tokens [T, D]; mask as in `update`."""
        kv, rate = (self.kv, self.rates) if stream == "image" else (self.kv_rows, self.rates_rows)
        # Keys and values under the caller's autocast, the state and its norms in float32.
        k, v = functional.silu(kv(tokens)).unflatten(-1, (2, self.heads, -1)).unbind(1)
        rates = self._rates(tokens, rate)
        if mask is not None:
            # where, not a product: a token that is left out may hold anything.
            seen = (mask > 0)[:, None]
            rates = torch.where(seen, rates * mask.to(rates.dtype)[:, None], 0)
            k, v = (torch.where(seen[..., None], x, 0) for x in (k, v))
        return _unit(k).transpose(0, 1), v.transpose(0, 1), rates

    def _rates(self, tokens: Tensor, head: nn.Linear) -> Tensor:
        """[H, T, 3] rates of the tokens, in float32 also under autocast: bf16 would round them by 0.4 %."""
        with exact(tokens.device):
            raw = functional.linear(tokens.float(), head.weight.float())
            return functional.softplus(raw + RATE_OFFSET).unflatten(-1, (self.heads, 3)).transpose(0, 1)


def start_alike(queries: nn.Module, keys_values: nn.Linear) -> None:
    """First weights with which tokens ask in the words in which tokens of the same kind teach: the queries' are the
    keys'. Drawn apart, a memory answers at random until both have learnt a common tongue: 30 CPU seconds of learning on
    rows gave 19.5 dB from apart (strength 0: 19.1), 22.0 alike (18.8)."""
    weight = keys_values.weight
    if not weight.is_meta:
        with torch.no_grad():
            next(queries.parameters()).copy_(weight[: len(weight) // 2])


def _unit(x: Tensor) -> Tensor:
    """x over its norm in the last dimension, in x's dtype."""
    wide = x.float()
    return (wide / (wide.norm(dim=-1, keepdim=True) + EPS)).to(x.dtype)
