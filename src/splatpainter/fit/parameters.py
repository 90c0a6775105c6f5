"""Rows as the optimiser holds them: scales as logarithms, opacities as logits, everything else as it is.

torch tensors on one device. Means, quaternions and SH are shared with the splats that are drawn, never copied.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatpainter.splats import ATTRIBUTES, Splats

FAINTEST = 1e-4
"""Opacities are kept this far from 0 and 1, where the logit is infinite."""
THINNEST = 1e-9
"""Scales below this (world units) cannot be told from 0."""


@dataclass
class Parameters:
    """N rows; the fields are named as in Splats."""

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
    def of(splats: Splats, device: str = "cpu") -> Parameters:
        """Copies of the rows; rows that cannot be drawn come out as NaN or infinite, and stay that way."""
        own = splats.torch(device)
        values: dict[str, Any] = {name: getattr(own, name).clone().contiguous() for name in ATTRIBUTES}
        values["scales"] = torch.where(values["scales"] > 0, values["scales"].clamp_min(THINNEST), torch.nan).log()
        values["opacities"] = torch.logit(values["opacities"].clamp(FAINTEST, 1 - FAINTEST))
        return Parameters(**values)

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def splats(self, like: Splats) -> Splats:
        """The rows as splats (torch) with the settings of `like`; means, quats and sh share memory."""
        scales, opacities = self.scales.exp(), self.opacities.sigmoid()
        values = (self.means, self.quats, scales, opacities, self.sh)
        return replace(like, **dict(zip(ATTRIBUTES, values, strict=True)), source=None, origin=None)

    def take(self, rows: Tensor) -> Parameters:
        """Copies of the given rows ([M] int64)."""
        return Parameters(**{name: getattr(self, name)[rows] for name in ATTRIBUTES})

    def append(self, *more: Parameters) -> Parameters:
        """These rows followed by others."""
        parts = (self, *more)
        return Parameters(**{name: torch.cat([getattr(part, name) for part in parts]) for name in ATTRIBUTES})


def to_raw(gradients: dict[str, Tensor], splats: Splats) -> None:
    """Turn gradients of the splats' attributes into those of the parameters, in place."""
    gradients["scales"].mul_(splats.scales)
    gradients["opacities"].mul_(splats.opacities * (1 - splats.opacities))


def with_degree(splats: Splats, degree: int | None) -> Splats:
    """The same rows (numpy) with SH of another degree (None: as it is): higher bands 0, or dropped."""
    if degree is None or degree == splats.sh_degree:
        return splats
    count = (degree + 1) ** 2
    sh = np.zeros((len(splats), count, 3), np.float32)
    kept = min(count, splats.sh.shape[1])
    sh[:, :kept] = splats.sh[:, :kept]
    return replace(splats, sh=sh)
