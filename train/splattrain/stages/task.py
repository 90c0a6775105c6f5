"""What the loop knows of a stage: `forward` gives a sample's losses, `judge` what validation says about it.

Also here: what all stages do alike, such as drawing views.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from splatpainter.cameras import Camera
from splatpainter.models.checkpoint import CheckpointConfig
from splatpainter.nn.precision import autocast, setting
from splatpainter.rendering import render
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splattrain.data.samples import Sample


class Model(Protocol):
    """What the loop knows of a model, which is also an nn.Module."""

    @property
    def config(self) -> CheckpointConfig: ...
    @property
    def notes(self) -> dict[str, Any]: ...
    def parameters(self, recurse: bool = True) -> Iterator[nn.Parameter]: ...


_Model = TypeVar("_Model", bound=Model)


@dataclass(frozen=True)
class ValidationScore:
    """What validation says about one sample."""

    kind: str
    """Row of the report: the sample's kind."""
    numbers: dict[str, float]
    """Figure -> value (dB, SSIM, LPIPS); averaged per kind. Figures that do not apply are left out."""
    strip: tuple[tuple[str, np.ndarray], ...] = field(repr=False)
    """(label, picture [H, W, 3]) of one row of the contact sheet."""


class Task(nn.Module, Generic[_Model]):
    """A stage. Subclasses set `requires_grad` of what they do not train to False."""

    model: _Model
    """The model, with `config` and `notes`; its parameters are what OUT/model holds."""
    step: int = 0
    """Optimiser steps done; the loop sets it."""
    problem: str = ""
    """Why the last sample was of no use; empty if it was."""

    def __init__(self) -> None:
        """Raises ValueError for a precision (nn.precision) that there is not, here and not for every sample."""
        super().__init__()
        self.precision = setting()

    def losses(self, sample: Sample, seed: int) -> dict[str, Tensor]:
        """{"loss": scalar to minimise, other names: scalars to log}. seed: of this sample's random choices, so that
        they do not depend on how many processes share the work. Raises ValueError for a sample that cannot be used."""
        raise NotImplementedError

    def forward(self, sample: Sample | str, seed: int) -> dict[str, Tensor]:
        """`losses`; for a sample that could not be made (the line that says why) or used, {"loss": 0} that depends on
        every trained weight, so that all processes still meet, and `problem` is set."""
        self.problem = sample if isinstance(sample, str) else ""
        if not isinstance(sample, str):
            try:
                return self.losses(sample, seed)
            except ValueError as error:
                self.problem = f"{sample.name} ({sample.kind}): {error}"
        trained = [p for p in self.parameters() if p.requires_grad]
        return {"loss": sum((p.float().sum() * 0 for p in trained), torch.zeros((), device=self.device))}

    def judge(self, sample: Sample) -> ValidationScore:
        """Figures of a validation sample, with the weights as they are; without gradients."""
        raise NotImplementedError

    @property
    def device(self) -> torch.device:
        """Device of the model."""
        return next(self.model.parameters()).device

    def arithmetic(self) -> torch.autocast:
        """The context that the networks run in."""
        return autocast(self.device, self.precision)


def draw(splats: Splats[Any], cameras: Sequence[Camera], device: torch.device) -> tuple[Tensor, Tensor]:
    """(colours [C, H, W, 3], alpha [C, H, W]) as torch on the device; differentiable where the splats are torch."""
    tensors: Splats[Tensor] = splats if isinstance(splats.means, Tensor) else splats.torch(str(device))
    drawn = render(tensors, list(cameras))
    return drawn.colors, drawn.alphas[..., 0]


def between_share(values: Tensor) -> float:
    """Of the power of tokens or latents [K, D], the share that differs between lines, 0..1: near 0, a network is told
    of all Gaussians the same, and answers the same for all."""
    wide = values.float()
    return float((wide - wide.mean(0)).square().sum() / wide.square().sum().clamp_min(1e-12))


def tensor(values: Any, device: torch.device) -> Tensor:
    """Numbers from data (numpy or torch) as float32 on the device."""
    return torch.as_tensor(values).to(device, torch.float32)


def freeze(*modules: nn.Module | None) -> None:
    """Let these parameters learn nothing."""
    for module in modules:
        if module is not None:
            module.requires_grad_(False)
