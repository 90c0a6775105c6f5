"""The optimiser's parts: how weights decay, how the rate runs, when a step is skipped, and the weights' running mean.

Recipe of GS-LRM and LaCT: AdamW (0.9, 0.95), weight decay 0.05, cosine after a linear warm-up, gradients clipped to
norm 1. Knows no model and no data.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

BETAS = (0.9, 0.95)
NORM_DECAY = 0.98
"""Share of the running gradient norm that a step keeps."""
MIN_SPIKE_STEPS = 20
"""Steps before a gradient norm can be called a spike."""


def decays(name: str, parameter: Tensor) -> bool:
    """Whether weight decay applies: to matrices; not to norms, biases and gains (one axis), nor to the first fast
    weights w0, w1, w2, whose column norms every update restores."""
    return parameter.ndim >= 2 and name.rsplit(".", 1)[-1] not in ("w0", "w1", "w2")


def adamw(named: Iterable[tuple[str, Tensor]], rate: float, weight_decay: float) -> torch.optim.AdamW:
    """AdamW over those parameters that want gradients, in two groups."""
    trainable = [(name, p) for name, p in named if p.requires_grad]
    groups = [
        {"params": [p for n, p in trainable if decays(n, p)], "weight_decay": weight_decay},
        {"params": [p for n, p in trainable if not decays(n, p)], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW([g for g in groups if g["params"]], lr=rate, betas=BETAS, foreach=True)


def rate_at(step: int, peak: float, warmup: int, steps: int, floor: float = 0.0) -> float:
    """Learning rate of step 0, 1, ...: linear to `peak` over `warmup` steps, then a cosine to floor * peak at
    `steps`."""
    if step < warmup:
        return peak * (step + 1) / warmup
    done = min((step - warmup) / max(steps - warmup, 1), 1.0)
    return peak * (floor + (1 - floor) * 0.5 * (1 + math.cos(math.pi * done)))


@dataclass
class Guard:
    """Decides whether a step's gradients are used, from their norm alone: the same on every rank."""

    spike: float
    """A norm above this many times the running mean is a spike; 0: never."""
    typical: float = 0.0
    """Running mean of the used norms."""
    seen: int = 0
    """Steps used."""
    skipped: int = 0
    """Steps refused."""

    def admit(self, norm: float) -> str:
        """ "" to use the step, else why not ("not finite", "spike")."""
        reason = ""
        if not math.isfinite(norm):
            reason = "not finite"
        elif self.spike and self.seen >= MIN_SPIKE_STEPS and norm > self.spike * self.typical:
            reason = "spike"
            # A level that has really risen is accepted after some steps.
            self.typical *= 1.1
        if reason:
            self.skipped += 1
            return reason
        self.typical = norm if not self.seen else NORM_DECAY * self.typical + (1 - NORM_DECAY) * norm
        self.seen += 1
        return ""


@dataclass
class Average:
    """Exponential moving average of the trainable weights: what validation and the saved model use."""

    decay: float
    values: dict[str, Tensor] = field(repr=False)
    """Parameter name -> its average, float32 on the parameter's device."""

    @staticmethod
    def of(named: Iterable[tuple[str, Tensor]], decay: float) -> Average:
        return Average(decay, {name: p.detach().clone() for name, p in named if p.requires_grad})

    @torch.no_grad()
    def update(self, named: Iterable[tuple[str, Tensor]], step: int) -> None:
        """After optimiser step `step` (0, 1, ...). Early steps count for more: min(decay, (1 + t) / (10 + t))."""
        share = 1 - min(self.decay, (1 + step) / (10 + step))
        for name, parameter in named:
            if name in self.values:
                self.values[name].lerp_(parameter.detach(), share)

    @contextmanager
    def used_by(self, module: nn.Module) -> Iterator[None]:
        """Inside, the module has the averaged weights."""
        parameters = {name: p for name, p in module.named_parameters() if name in self.values}
        originals = {name: p.detach().clone() for name, p in parameters.items()}
        with torch.no_grad():
            for name, p in parameters.items():
                p.copy_(self.values[name])
        try:
            yield
        finally:
            with torch.no_grad():
                for name, p in parameters.items():
                    p.copy_(originals[name])
