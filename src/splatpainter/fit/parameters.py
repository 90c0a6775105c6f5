"""Gaussians as the optimiser holds them (scales as logarithms, opacities as logits, everything else as it is), and
Adam over Gaussians that come and go.

torch tensors on one device. Means, quaternions and SH are shared with the splats that are drawn, never copied.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from splatpainter.kernels.parallel import run
from splatpainter.splats import ATTRIBUTES, Splats

MIN_OPACITY = 1e-4
"""Opacities are kept this far from 0 and 1, where the logit is infinite."""
MIN_SCALE = 1e-9
"""Scales below this (world units) cannot be told from 0."""

BETAS = (0.9, 0.999)
EPSILON = 1e-15
"""Adam's epsilon, as 3DGS has it: gradients of single Gaussians are tiny."""
GAUSSIANS_PER_BLOCK = 1024
"""Gaussians that a thread takes at a time."""


@dataclass
class RawGaussians:
    """N Gaussians; the fields are named as in Splats."""

    means: Tensor
    """[N, 3]"""
    quats: Tensor
    """[N, 4]"""
    scales: Tensor
    """[N, 3] natural logarithms."""
    opacities: Tensor
    """[N] logits."""
    sh: Tensor
    """[N, K, 3]"""

    @staticmethod
    def of(splats: Splats, device: str = "cpu") -> RawGaussians:
        """Copies of the Gaussians; Gaussians that cannot be drawn come out as NaN or infinite, and stay that way."""
        tensors = splats.torch(device)
        values: dict[str, Any] = {name: getattr(tensors, name).clone().contiguous() for name in ATTRIBUTES}
        values["scales"] = torch.where(values["scales"] > 0, values["scales"].clamp_min(MIN_SCALE), torch.nan).log()
        values["opacities"] = torch.logit(values["opacities"].clamp(MIN_OPACITY, 1 - MIN_OPACITY))
        return RawGaussians(**values)

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def splats(self, like: Splats) -> Splats:
        """The Gaussians as splats (torch) with the settings of `like`; means, quats and sh share memory."""
        scales, opacities = self.scales.exp(), self.opacities.sigmoid()
        values = (self.means, self.quats, scales, opacities, self.sh)
        return replace(like, **dict(zip(ATTRIBUTES, values, strict=True)), source=None, origin=None)

    def take(self, ids: Tensor) -> RawGaussians:
        """Copies of the given Gaussians ([M] int64)."""
        return RawGaussians(**{name: getattr(self, name)[ids] for name in ATTRIBUTES})

    def append(self, *more: RawGaussians) -> RawGaussians:
        """These Gaussians followed by others."""
        parts = (self, *more)
        return RawGaussians(**{name: torch.cat([getattr(part, name) for part in parts]) for name in ATTRIBUTES})


def to_raw(gradients: dict[str, Tensor], scales: Tensor, opacities: Tensor) -> None:
    """Turn gradients of splats' attributes, which have these values, into those of the parameters, in place."""
    if "scales" in gradients:
        gradients["scales"].mul_(scales)
    if "opacities" in gradients:
        gradients["opacities"].mul_(opacities * (1 - opacities))


def with_degree(splats: Splats, degree: int | None) -> Splats:
    """The same Gaussians (numpy) with SH of another degree (None: as it is): higher bands 0, or dropped."""
    if degree is None or degree == splats.sh_degree:
        return splats
    count = (degree + 1) ** 2
    sh = np.zeros((len(splats), count, 3), np.float32)
    bands = min(count, splats.sh.shape[1])
    sh[:, :bands] = splats.sh[:, :bands]
    return replace(splats, sh=sh)


class Adam:
    """Moments of named tensors, each [N, ...], with a rate per column (Kingma and Ba 2015).

    torch.optim.Adam wants one rate per tensor and lets nothing in or out; SH bands have rates of their own, and
    splitting SH into two tensors would copy all of it twice per step."""

    def __init__(self, values: dict[str, Tensor]) -> None:
        self.steps = 0
        self.moments = {name: (torch.zeros_like(value), torch.zeros_like(value)) for name, value in values.items()}

    def step(self, values: dict[str, Tensor], gradients: dict[str, Tensor], rates: dict[str, Tensor]) -> None:
        """Move the values in place. rates: name -> [C] for values of C numbers per Gaussian, or [1] for all of them."""
        self.steps += 1
        first, second = (1 - beta**self.steps for beta in BETAS)
        for name, (mean, square) in self.moments.items():
            value, gradient, rate = values[name], gradients[name], rates[name] / first
            if value.device.type == "cpu":
                _step_values(value, gradient, mean, square, rate, 1 / math.sqrt(second))
            else:
                step_tensor(value, gradient, mean, square, rate, 1 / math.sqrt(second))

    def select(self, survivors: Tensor, fresh: int) -> None:
        """Only the kept Gaussians ([M] int64), followed by `fresh` Gaussians without a past."""
        for name, pair in self.moments.items():
            mean, square = (torch.cat([m[survivors], m.new_zeros(fresh, *m.shape[1:])]) for m in pair)
            self.moments[name] = (mean, square)

    def forget(self, name: str) -> None:
        """Start one tensor's moments anew."""
        for moment in self.moments[name]:
            moment.zero_()


def step_tensor(value: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, rate: Tensor, correction: float) -> None:
    """One step in torch, on any device. rate: [C] or [1], over 1 - beta1^t; correction: 1 / sqrt(1 - beta2^t)."""
    mean.lerp_(gradient, 1 - BETAS[0])
    square.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
    change = mean / square.sqrt().mul_(correction).add_(EPSILON)
    value.sub_((change.reshape(len(value), -1) * rate).reshape(value.shape))


def _step_values(
    value: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, rate: Tensor, correction: float
) -> None:
    flat = [tensor.detach().reshape(len(value), -1).numpy() for tensor in (value, gradient, mean, square)]
    columns = np.broadcast_to(rate.numpy(), flat[0].shape[1]).astype(flat[0].dtype)
    kind = flat[0].dtype.type
    # 1 - beta in full precision first: from a beta in float32 it would be off by 1e-5.
    shares = [kind(share) for beta in BETAS for share in (beta, 1 - beta)]
    run(_kernel, *flat, columns, *shares, kind(EPSILON), kind(correction))


@njit(nogil=True, cache=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy", boundscheck=False)
def _kernel(value, gradient, mean, square, rates, old1, new1, old2, new2, epsilon, correction, thread, threads):
    count, columns = value.shape
    for block in range(thread, (count + GAUSSIANS_PER_BLOCK - 1) // GAUSSIANS_PER_BLOCK, threads):
        for n in range(block * GAUSSIANS_PER_BLOCK, min(count, (block + 1) * GAUSSIANS_PER_BLOCK)):
            for c in range(columns):
                g = gradient[n, c]
                m = old1 * mean[n, c] + new1 * g
                v = old2 * square[n, c] + new2 * g * g
                mean[n, c] = m
                square[n, c] = v
                value[n, c] -= rates[c] * m / (np.sqrt(v) * correction + epsilon)
