"""Fast weights that one edit solves for exactly: a linear map, by ridge regression on learned features.

Where a TTT layer takes a step towards lower error, this one goes to the minimum (a "Mesa" layer, arXiv 2309.05858; on
learned features "ALPaCA", arXiv 1807.08912). Differentiable in everything. N rows, F features, C channels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splatpainter.nn.precision import exact


def solve(features: Tensor, wanted: Tensor, weights: Tensor) -> Tensor:
    """[F, C]: the W that minimises sum_n weights_n |features_n W - wanted_n|^2 + |W|^2; worked out in float64.

    features: [N, F]; wanted: [N, C]; weights: [N] >= 0 (0: the row is not there). Without any weight W is 0. The
    penalty is fixed: features that learn their own size learn how much each is trusted."""
    with exact(features.device):
        phi = features.double()
        scaled = phi * weights.to(phi)[:, None]
        gram = phi.mT @ scaled + torch.eye(phi.shape[1], dtype=phi.dtype, device=phi.device)
        factor = torch.linalg.cholesky(gram)
        return torch.cholesky_solve(scaled.mT @ wanted.to(phi), factor).to(wanted.dtype)
