"""Fast weights: a small SwiGLU network that an edit trains on the spot, as pure functions of values.

f_W(x) = (silu(x W0) * (x W2)) W1. An update is one gradient step on the whole edit, orthogonalised (Muon), added, and
the columns brought back to their norms: large-chunk test-time training, arXiv 2505.23884. No function writes into its
arguments, none knows where keys and values come from.

T tokens, D width of a head, F hidden width; every tensor may have a leading head dimension.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from splatpainter.nn.layers import gated
from splatpainter.nn.precision import exact

InnerLoss = Literal["dot", "l2"]
MUON = (3.4445, -4.7750, 2.0315)
"""Coefficients of the quintic Newton-Schulz iteration (Jordan et al. 2024, "Muon")."""


class FastWeights(NamedTuple):
    """The state that an edit changes, float32; or anything of its shape (gradients); or, in `step`, column norms."""

    w0: Tensor
    """[D, F] into the gate."""
    w1: Tensor
    """[F, D] out."""
    w2: Tensor
    """[D, F] into the value."""


def initial(
    dim: int, hidden: int, heads: int | None = None, generator: torch.Generator | None = None, device: str | None = None
) -> FastWeights:
    """Weights from N(0, 2 / fan-in): w0, w2 [D, F] and w1 [F, D], with a leading [heads] unless None."""
    lead = () if heads is None else (heads,)

    def draw(fan_in: int, fan_out: int) -> Tensor:
        empty = torch.empty(*lead, fan_in, fan_out, device=device)
        return empty if empty.is_meta else empty.normal_(generator=generator) * math.sqrt(2 / fan_in)

    return FastWeights(draw(dim, hidden), draw(hidden, dim), draw(dim, hidden))


def apply(weights: FastWeights, x: Tensor) -> Tensor:
    """f_W(x). x: [T, D] -> [T, D]."""
    if len(weights.w0) == 1 and x.ndim == 3:  # one head: plain matrices, which CPUs multiply faster than batches of one
        inner = torch.cat([weights.w0[0], weights.w2[0]], dim=-1).mT.contiguous()
        return functional.linear(gated(functional.linear(x[0], inner)), weights.w1[0].mT.contiguous())[None]
    return (functional.silu(x @ weights.w0) * (x @ weights.w2)) @ weights.w1


def ascent(weights: FastWeights, k: Tensor, v: Tensor, rates: Tensor, loss: InnerLoss = "dot") -> FastWeights:
    """The direction in which each matrix improves the edit's objective.

    k, v: [T, D]; rates: [T, 3] >= 0, weight of each token in the direction of w0, w1, w2 (0: the token is not there).
    The matrix m gets the gradient, at `weights`, of sum_t rates[t, m] <f(k_t), v_t> for "dot", and of
    -sum_t rates[t, m] |f(k_t) - v_t|^2 / 2 for "l2".
    """
    a, b = k @ weights.w0, k @ weights.w2  # [T, F]
    sigmoid = torch.sigmoid(a)
    gate = a * sigmoid  # silu(a)
    inner = gate * b
    if loss == "l2":
        v = v - inner @ weights.w1
    u = v @ weights.w1.mT  # [T, F]
    r0, r1, r2 = rates.mT.unsqueeze(-2).unbind(-3)  # [1, T] each
    slope = sigmoid * (1 + a * (1 - sigmoid))  # d silu / d a
    return FastWeights(
        w0=(k.mT * r0) @ (u * b * slope),
        w1=(inner.mT * r1) @ v,
        w2=(k.mT * r2) @ (u * gate),
    )


def newton_schulz(matrix: Tensor, steps: int = 5) -> Tensor:
    """Nearly the orthogonal factor U V^T of `matrix` = U S V^T, [..., R, C], whatever its size.

    Five steps bring singular values of 0.2 % of the Frobenius norm or more to 0.68..1.21, not to 1; lesser ones grow
    485-fold, and zero stays zero. Not the exact factor by design: the coefficients lift small values fast.
    """
    # The shorter side makes the smaller Gram matrix, and the factor of a transpose is the transpose of the factor.
    tall = matrix.shape[-2] > matrix.shape[-1]
    x = matrix.mT if tall else matrix
    x = x / (torch.linalg.matrix_norm(x, keepdim=True) + 1e-7)
    first, third, fifth = MUON
    for _ in range(steps):
        gram = x @ x.mT
        x = first * x + (third * gram + fifth * (gram @ gram)) @ x
    return x.mT if tall else x


def column_norms(weights: FastWeights) -> FastWeights:
    """The norm of every column over the input dimension: w0, w2 [1, F], w1 [1, D]. Detached."""
    return FastWeights(*(w.detach().norm(dim=-2, keepdim=True) for w in weights))


def step(
    weights: FastWeights,
    k: Tensor,
    v: Tensor,
    rates: Tensor,
    *,
    loss: InnerLoss = "dot",
    inner_steps: int = 1,
    newton_schulz_steps: int = 5,
    edit_strength: float | Tensor = 1.0,
    norms: FastWeights | None = None,
) -> FastWeights:
    """The weights after an edit with keys k [T, D], values v [T, D] and token rates [T, 3]: `advance` by `ascent`. An
    edit whose rates are all 0 returns the very same bits."""
    return advance(
        weights,
        lambda now: ascent(now, k, v, rates, loss),
        inner_steps=inner_steps,
        newton_schulz_steps=newton_schulz_steps,
        edit_strength=edit_strength,
        norms=norms,
    )


def advance(
    weights: FastWeights,
    direction: Callable[[FastWeights], FastWeights],
    *,
    inner_steps: int = 1,
    newton_schulz_steps: int = 5,
    edit_strength: float | Tensor = 1.0,
    norms: FastWeights | None = None,
) -> FastWeights:
    """inner_steps times: W_m + edit_strength * newton_schulz(direction(W)_m), then every column back to its norm.

    direction: `ascent` of the whole edit; a sum over tokens, so an edit may be summed up in parts. newton_schulz_steps:
    0 adds the plain gradient. edit_strength: 1 is the paper; offered because the orthogonalised step is equally long
    for a brush dot and for a relit view (a common factor of the rates cancels). norms: of `column_norms`, those of the
    incoming weights by default, so that they survive any number of edits.
    """
    norms = column_norms(weights) if norms is None else norms
    for _ in range(inner_steps):
        moved = []
        for w, towards, norm in zip(weights, direction(weights), norms, strict=True):
            if newton_schulz_steps:
                towards = newton_schulz(towards, newton_schulz_steps)
            w = w + edit_strength * towards
            # The reference adds 1e-5 to the divisor; a floor does the same job and keeps w where nothing moved.
            moved.append(w * (norm / w.norm(dim=-2, keepdim=True).clamp_min(1e-5)))
        weights = FastWeights(*moved)
    return weights


def solve_ridge(features: Tensor, targets: Tensor, weights: Tensor) -> Tensor:
    """[F, C] a linear map that one edit solves for exactly: the W that minimises
    sum_n weights_n |features_n W - targets_n|^2 + |W|^2; worked out in float64, differentiable in everything.

    features: [N, F]; targets: [N, C]; weights: [N] >= 0 (0: left out). Without any weight W is 0. The penalty is fixed:
    features that learn their size learn how much each is trusted. Where a TTT layer takes a step towards lower error,
    this goes to the minimum (a "Mesa" layer, arXiv 2309.05858; on learned features "ALPaCA", arXiv 1807.08912).
    """
    with exact(features.device):
        phi = features.double()
        scaled = phi * weights.to(phi)[:, None]
        # The penalty keeps the matrix positive definite, so that it has a Cholesky factor even where no features count.
        gram = phi.mT @ scaled + torch.eye(phi.shape[1], dtype=phi.dtype, device=phi.device)
        factor = torch.linalg.cholesky(gram)
        return torch.cholesky_solve(scaled.mT @ targets.to(phi), factor).to(targets.dtype)
