"""What Gaussians that no edited picture shows become under a new light or look: learned features, an edit solved
exactly.

    predict = predicting(model.predictor, splats, normals, transfer)      # None without a trained one
    lift_global(splats, views, predict=predict)

A network describes every Gaussian (its colour, normal, place, and the light that reaches it: precomputed transfer) in
the company of all others; the change of those that the pictures show is regressed on that description, and what comes
out holds for all. It takes the place of the lift's fixed features and keeps its principle. N Gaussians, F features.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from splatpainter.lift.colors import MIN_SEEN_PX
from splatpainter.lift.global_edit import Predict
from splatpainter.models.config import PredictConfig
from splatpainter.nn.fast_weights import solve_ridge
from splatpainter.nn.precision import exact
from splatpainter.splats import SH_C0, Splats

FACTS = 21
"""Numbers per Gaussian: `gaussian_facts`."""
INPUT_CHANNELS = FACTS + 8 + 27
"""Facts, eight polynomials of the normal, and transfer times colour."""
MAX_WEIGHT_PX = 50.0
"""A huge Gaussian must not outvote a thousand small ones."""
CONTEXT_GAUSSIANS = 8192
"""Gaussians, evenly chosen, that say what kind of asset this is and under what light."""
REGRESSION_GAUSSIANS = 16_384
"""Seen Gaussians, evenly chosen, that the regression learns from."""
GAUSSIANS_PER_CHUNK = 1 << 12
"""Gaussians described at once without gradients: few enough for what they pass through to stay in the caches."""
OPPONENT = ((3**-0.5, 3**-0.5, 3**-0.5), (2**-0.5, -(2**-0.5), 0.0), (6**-0.5, 6**-0.5, -2 * 6**-0.5))
"""Orthogonal: lightness, and two channels of hue."""


def gaussian_facts(splats: Splats, normals: np.ndarray, transfer: np.ndarray) -> np.ndarray:
    """[N, 21] float32: base colour - 0..1 as -1..1 -, normal, place in the asset's ball, opacity, log of the mean scale
    over the ball's radius, transfer and open share. splats: numpy; normals: [N, 3] of `outward_normals`; transfer:
    [N, 10] of `prt_transfer`. Gaussians that cannot be drawn get zeros. At least one Gaussian must be drawable."""
    drawn = splats.drawable
    means = splats.means[drawn]
    middle = np.median(means, 0)
    away = (means - middle).astype(np.float64)
    radius = max(float(np.quantile(np.linalg.norm(away, axis=1), 0.98)), 1e-12)
    size = np.log(np.maximum(splats.scales[drawn].mean(1, dtype=np.float64) / radius, 1e-9))
    facts = np.zeros((len(splats), FACTS), np.float32)
    facts[drawn] = np.concatenate(
        [
            2 * np.clip(0.5 + SH_C0 * splats.sh[drawn, 0], 0, 1) - 1,
            normals[drawn],
            np.clip(away / radius, -3, 3),
            2 * splats.opacities[drawn, None] - 1,
            size[:, None] / 2 + 2,
            transfer[drawn, :9],
            2 * transfer[drawn, 9:] - 1,
        ],
        1,
    )
    return facts


class Predictor(nn.Module):
    """Features of Gaussians, the colours that are expected before anything is seen, and how much evidence counts."""

    def __init__(self, config: PredictConfig) -> None:
        """Trained on Gaussians alone, without pictures (train/stages/predict.py)."""
        super().__init__()
        width, self.features = config.hidden, config.features
        # Attribute names are keys of stored weights; `own`: of a Gaussian alone, `company`: of the asset.
        self.own = nn.Sequential(nn.Linear(INPUT_CHANNELS, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.company = nn.Sequential(nn.Linear(width, width), nn.SiLU())
        self.evidence = nn.Sequential(
            nn.Linear(INPUT_CHANNELS + 3, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )
        self.together = nn.Linear(3 * width, width)
        self.describe = nn.Linear(width, 2 * config.features)
        self.expected = nn.Linear(width, 3)
        self.trust = nn.Parameter(torch.tensor(6.0))
        if not self.expected.weight.is_meta:
            nn.init.zeros_(self.expected.weight)
            nn.init.zeros_(self.expected.bias)

    @property
    def is_untrained(self) -> bool:
        """Whether nothing has trained it yet: then the lift's own regression is better."""
        return not bool(self.expected.weight.any())

    def forward(self, facts: Tensor, change: Tensor, weight: Tensor) -> Tensor:
        """[N, 3] predicted change of base colour of all Gaussians. facts: [N, 21] of `gaussian_facts`; change: [N, 3]
        as the pictures have it; weight: [N] pixels that show each Gaussian. Without a seen Gaussian nothing is
        predicted: zeros."""
        with exact(facts.device):
            seen = spread_evenly(torch.nonzero(weight > MIN_SEEN_PX)[:, 0], REGRESSION_GAUSSIANS)
            if len(seen) == 0:
                return torch.zeros_like(change)
            opponent = facts.new_tensor(OPPONENT)
            counts = weight[seen].clamp(max=MAX_WEIGHT_PX)
            share = (counts / counts.sum())[:, None]
            inputs = described_facts(facts[seen])
            seen_change = change[seen] @ opponent.mT
            evidence = (share * self.evidence(torch.cat([inputs, 4 * seen_change], 1))).sum(0)
            everyone = spread_evenly(torch.arange(len(facts), device=facts.device), CONTEXT_GAUSSIANS)
            context = self.company(self.own(described_facts(facts[everyone]))).mean(0)
            around = torch.cat([context, evidence])
            light, hue, mean = self._described(inputs, around)
            counted = share[:, 0] * self.trust.exp()
            rest = seen_change - mean
            solved = solve_ridge(light, rest[:, :1], counted), solve_ridge(hue, rest[:, 1:], counted)
            size = len(facts) if torch.is_grad_enabled() else GAUSSIANS_PER_CHUNK
            parts = []
            for some in facts.split(size):
                light, hue, mean = self._described(described_facts(some), around)
                parts.append((mean + torch.cat([light @ solved[0], hue @ solved[1]], 1)) @ opponent)
            return torch.cat(parts)

    def _described(self, inputs: Tensor, around: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(features for lightness [M, F], for hue [M, F], change expected beforehand [M, 3], lightness and hue)."""
        gaussian_weight, context_weight = self.together.weight.split([self.expected.in_features, len(around)], dim=1)
        same = functional.linear(around, context_weight, self.together.bias)  # for all Gaussians
        x = functional.silu(functional.linear(self.own(inputs), gaussian_weight) + same)
        light, hue = (2 * self.features**-0.5 * self.describe(x)).chunk(2, dim=1)
        return light, hue, 0.1 * self.expected(x)


def predicting(
    predictor: Predictor | None, splats: Splats, normals: np.ndarray, transfer: Callable[[], np.ndarray]
) -> Predict | None:
    """The predictor's answer for edits of this asset, on its device; None where there is none or it is untrained, and
    then `transfer`, which computes [N, 10] of `prt_transfer`, is not called."""
    if predictor is None or predictor.is_untrained:
        return None
    facts = gaussian_facts(splats, normals, transfer())

    def predict(change: np.ndarray, weight: np.ndarray) -> np.ndarray:
        device = predictor.trust.device
        inputs = (torch.from_numpy(np.ascontiguousarray(x, np.float32)).to(device) for x in (facts, change, weight))
        with torch.no_grad():
            return predictor(*inputs).cpu().numpy()

    return predict


def described_facts(facts: Tensor) -> Tensor:
    """[N, INPUT_CHANNELS] what networks see of Gaussians. facts: [N, 21] of `gaussian_facts`."""
    x, y, z = facts[:, 3:6].unbind(1)
    turns = torch.stack([x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y, x * x, y * y, z * z], 1)
    lit = facts[:, 11:20, None] * (facts[:, None, :3] + 1) / 2
    return torch.cat([facts, turns, lit.flatten(1)], 1)


def spread_evenly(values: Tensor, most: int) -> Tensor:
    """At most `most` of these Gaussians, evenly over their order."""
    if len(values) <= most:
        return values
    return values[torch.linspace(0, len(values) - 1, most, device=values.device).long()]
