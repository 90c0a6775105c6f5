"""Gaussians as the optimiser holds them (scales as logarithms, opacities as logits, everything else as it is), and
Adam over Gaussians that come and go.

numpy arrays on the CPU, torch tensors on another device. Means, quaternions and SH are shared with the splats that are
drawn, never copied.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from splatpainter.fit.devices import DeviceArray, exp, joined, log, on_device, sigmoid, zeros_like
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass

MIN_OPACITY = 1e-4
"""Opacities are kept this far from 0 and 1, where the logit is infinite."""
MIN_SCALE = 1e-9
"""Scales below this (world units) cannot be told from 0."""

BETAS = (0.9, 0.999)
EPSILON = 1e-15
"""Adam's epsilon, as 3DGS has it: gradients of single Gaussians are tiny."""


@dataclass
class RawGaussians:
    """N Gaussians; the fields are named as in Splats."""

    means: DeviceArray
    """[N, 3]"""
    quats: DeviceArray
    """[N, 4]"""
    scales: DeviceArray
    """[N, 3] natural logarithms."""
    opacities: DeviceArray
    """[N] logits."""
    sh: DeviceArray
    """[N, K, 3]"""

    @staticmethod
    def of(splats: Splats, device: str = "cpu") -> RawGaussians:
        """Copies of the Gaussians; Gaussians that cannot be drawn come out as NaN or infinite, and stay that way."""
        values = {name: np.array(getattr(splats.numpy(), name), np.float32) for name in ATTRIBUTES}
        scales, opacities = values["scales"], np.clip(values["opacities"], MIN_OPACITY, 1 - MIN_OPACITY)
        # Negative scales become NaN on purpose: they cannot be drawn, and must not come back as something that can.
        values["scales"] = log(np.where(scales > 0, np.maximum(scales, np.float32(MIN_SCALE)), np.float32(np.nan)))
        values["opacities"] = log(opacities / (1 - opacities))
        return RawGaussians(**{name: on_device(value, device) for name, value in values.items()})

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def splats(self, like: Splats) -> Splats:
        """The Gaussians as splats with the settings of `like`; means, quats and sh share memory."""
        scales, opacities = exp(self.scales), sigmoid(self.opacities)
        values = (self.means, self.quats, scales, opacities, self.sh)
        return replace(like, **dict(zip(ATTRIBUTES, values, strict=True)), source=None, origin=None)

    def take(self, ids: DeviceArray) -> RawGaussians:
        """Copies of the given Gaussians ([M] int64, on the same device)."""
        return RawGaussians(**{name: getattr(self, name)[ids] for name in ATTRIBUTES})

    def append(self, *more: RawGaussians) -> RawGaussians:
        """These Gaussians followed by others."""
        parts = (self, *more)
        return RawGaussians(**{name: joined([getattr(part, name) for part in parts]) for name in ATTRIBUTES})


def to_raw(gradients: dict[str, DeviceArray], scales: DeviceArray, opacities: DeviceArray) -> None:
    """Turn gradients of splats' attributes, which have these values, into those of the parameters, in place."""
    if "scales" in gradients:
        gradients["scales"] *= scales
    if "opacities" in gradients:
        gradients["opacities"] *= opacities * (1 - opacities)


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

    def __init__(self, values: dict[str, DeviceArray]) -> None:
        self.steps = 0
        self.moments = {name: (zeros_like(value), zeros_like(value)) for name, value in values.items()}

    def step(
        self, values: dict[str, DeviceArray], gradients: dict[str, DeviceArray], rates: dict[str, DeviceArray]
    ) -> None:
        """Move the values in place. rates: name -> [C] numpy for values of C numbers per Gaussian, or [1] for all of
        them."""
        self.steps += 1
        # Bias correction, folded into rate and root so that the kernel sees two numbers.
        first, second = (1 - beta**self.steps for beta in BETAS)
        for name, (mean, square) in self.moments.items():
            value, gradient, rate = values[name], gradients[name], rates[name] / first
            if isinstance(value, np.ndarray):
                _step_values(value, gradient, mean, square, rate, 1 / math.sqrt(second))
            else:
                rate = value.new_tensor(rate)
                step_tensor(value, gradient, mean, square, rate, 1 / math.sqrt(second))

    def select(self, survivors: DeviceArray, fresh: int) -> None:
        """Only the kept Gaussians ([M] int64), followed by `fresh` Gaussians without a past."""
        for name, pair in self.moments.items():
            mean, square = (joined([m[survivors], zeros_like(m, fresh)]) for m in pair)
            self.moments[name] = (mean, square)

    def forget(self, name: str) -> None:
        """Start one tensor's moments anew."""
        for moment in self.moments[name]:
            moment[:] = 0


def step_tensor(value: Any, gradient: Any, mean: Any, square: Any, rate: Any, correction: float) -> None:
    """One step in torch, of tensors on any device, in place. rate: [C] or [1], over 1 - beta1^t; correction:
    1 / sqrt(1 - beta2^t)."""
    mean.lerp_(gradient, 1 - BETAS[0])
    square.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
    change = mean / square.sqrt().mul_(correction).add_(EPSILON)
    value.sub_((change.reshape(len(value), -1) * rate).reshape(value.shape))


def _step_values(
    value: np.ndarray, gradient: np.ndarray, mean: np.ndarray, square: np.ndarray, rate: np.ndarray, correction: float
) -> None:
    flat = [array.reshape(len(value), -1) for array in (value, gradient, mean, square)]
    columns = np.broadcast_to(rate, flat[0].shape[1]).astype(flat[0].dtype)
    kind = flat[0].dtype.type
    # 1 - beta in full precision first: from a beta in float32 it would be off by 1e-5.
    shares = [kind(share) for beta in BETAS for share in (beta, 1 - beta)]
    run(kernels.adam_step, *flat, columns, *shares, kind(EPSILON), kind(correction))
