"""What Gaussians that no edited picture shows become under a new light or look: learned features, an edit solved
exactly.

A network describes every Gaussian (its colour, normal, place, and the light that reaches it: precomputed transfer) in
the company of all others; the change of those that the pictures show is regressed on that description, and what comes
out holds for all. It takes the place of the lift's fixed features and keeps its principle. This is the module that
training fills; edits run its stored weights without torch (stored_predictor.py). N Gaussians, F features.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from splatpainter.lift.colors import MIN_SEEN_PX
from splatpainter.models.config import PredictConfig
from splatpainter.models.gaussian_facts import INPUT_CHANNELS, evenly_spread
from splatpainter.models.stored_predictor import (
    CONTEXT_GAUSSIANS,
    EVIDENCE_GAIN,
    EXPECTED_GAIN,
    GAUSSIANS_PER_CHUNK,
    MAX_WEIGHT_PX,
    OPPONENT,
    REGRESSION_GAUSSIANS,
    StoredPredictor,
)
from splatpainter.nn.fast_weights import solve_ridge
from splatpainter.nn.precision import exact


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
        # Untrained it expects no change: zeros say so, and mark it as untrained.
        if not self.expected.weight.is_meta:
            nn.init.zeros_(self.expected.weight)
            nn.init.zeros_(self.expected.bias)

    def stored(self) -> StoredPredictor:
        """Its weights as an edit uses them; a copy."""
        return StoredPredictor({name: t.detach().float().cpu().numpy().copy() for name, t in self.state_dict().items()})

    def forward(self, facts: Tensor, change: Tensor, weight: Tensor) -> Tensor:
        """[N, 3] predicted change of base colour of all Gaussians. facts: [N, 21] of `gaussian_facts`; change: [N, 3]
        as the pictures have it; weight: [N] pixels that show each Gaussian. Without a seen Gaussian nothing is
        predicted: zeros."""
        with exact(facts.device):
            seen = spread_evenly(torch.nonzero(weight > MIN_SEEN_PX)[:, 0], REGRESSION_GAUSSIANS)
            if len(seen) == 0:
                return torch.zeros_like(change)
            opponent = facts.new_tensor(OPPONENT)
            # The same steps as StoredPredictor.predict, with gradients.
            counts = weight[seen].clamp(max=MAX_WEIGHT_PX)
            share = (counts / counts.sum())[:, None]
            inputs = described_facts(facts[seen])
            seen_change = change[seen] @ opponent.mT
            evidence = (share * self.evidence(torch.cat([inputs, EVIDENCE_GAIN * seen_change], 1))).sum(0)
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
        return light, hue, EXPECTED_GAIN * self.expected(x)


def described_facts(facts: Tensor) -> Tensor:
    """[N, INPUT_CHANNELS] what networks see of Gaussians. facts: [N, 21] of `gaussian_facts`."""
    x, y, z = facts[:, 3:6].unbind(1)
    # Products of the normal are what light of degree 2 multiplies with: spelled out, the network need not learn them.
    turns = torch.stack([x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y, x * x, y * y, z * z], 1)
    lit = facts[:, 11:20, None] * (facts[:, None, :3] + 1) / 2
    return torch.cat([facts, turns, lit.flatten(1)], 1)


def spread_evenly(values: Tensor, most: int) -> Tensor:
    """At most `most` of these Gaussians, evenly over their order."""
    if len(values) <= most:
        return values
    return values[torch.from_numpy(evenly_spread(np.arange(len(values)), most)).to(values.device)]
