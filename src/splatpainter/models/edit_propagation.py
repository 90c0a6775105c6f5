"""Stage II as the sole carrier of a global edit: Gaussians that a picture shows teach its memory how they changed, and
what it then says to the others is how they change.

    predict = carrying(model, encoded.latents, encoded.latent_ids, asset.splats, normals, transfer)
    lift_global(splats, views, predict=predict)

For a model with config.refine.answers "teachers" (`train rows`): a Gaussian that no picture shows is told nothing of
the edit but what the memory says, so that without adaptation (edit strength 0) all edits would be one. The Gaussian's
own colour does not enter the sum: what is read is a change. N Gaussians, R of them asked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from splatpainter.color import base_color
from splatpainter.lift.colors import MIN_SEEN_PX
from splatpainter.lift.features import HALF_SEEN_PX
from splatpainter.lift.global_edit import Predict
from splatpainter.models.decode import color_change
from splatpainter.models.gaussian_facts import gaussian_facts
from splatpainter.models.model import GaussianInputs
from splatpainter.models.predictor import described_facts, spread_evenly
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.models.compress import Latents
    from splatpainter.models.model import SplatPainterModel

TEACHER_WEIGHT_SUM = 128.0
"""Sum of what the Gaussians that teach count."""
GAUSSIANS_PER_CHUNK = 1 << 12
"""Gaussians asked at once without gradients."""


@dataclass(frozen=True)
class EncodedGaussians:
    """What Stage II knows of N encoded Gaussians, whatever is edited. On the model's device."""

    latents: Latents
    latent_ids: np.ndarray
    """[N] int64 the latent of each Gaussian."""
    colors: Tensor = field(repr=False)
    """[N, 3] base colours, 0..1."""
    normals: Tensor = field(repr=False)
    """[N, 3] unit, outwards."""
    means: Tensor = field(repr=False)
    """[N, 3] world units."""
    facts: Tensor | None = field(repr=False)
    """[N, 56] of `described_facts`, for a model that reads them."""

    @staticmethod
    def of(
        model: SplatPainterModel,
        latents: Latents,
        latent_ids: np.ndarray,
        splats: Splats,
        normals: np.ndarray,
        transfer: np.ndarray | None,
    ) -> EncodedGaussians:
        """splats: numpy, N that can be drawn; latent_ids: [N] of each; transfer: [N, 10] of `prt_transfer`, for a model
        that reads facts. Raises ValueError for Gaussians that were not encoded."""
        missing = int((latent_ids < 0).sum())
        if missing:
            raise ValueError(f"refine: {missing} of the {len(latent_ids)} Gaussians were not encoded; encode again")
        device, facts = latents.values.device, None
        if model.config.refine.facts:
            assert transfer is not None
            facts = described_facts(torch.from_numpy(gaussian_facts(splats, normals, transfer)).to(device))
        colors = np.clip(base_color(splats.sh), 0, 1)
        old, outwards, means = (
            torch.from_numpy(np.ascontiguousarray(x, np.float32)).to(device) for x in (colors, normals, splats.means)
        )
        return EncodedGaussians(latents, latent_ids, old, outwards, means, facts)


def carry(
    model: SplatPainterModel,
    gaussians: EncodedGaussians,
    change: Tensor,
    weight: Tensor,
    teachers: Tensor,
    readers: Tensor,
    strength: float | None = None,
) -> Tensor:
    """[R, 3] change of base colour of the Gaussians `readers` [R], after adapting to that of the Gaussians `teachers`
    [T] (int64 both). change: [N, 3]; weight: [N] pixels that show each, both read at teachers only; strength: overrides
    config.refine.edit_strength. Differentiable in the weights of Stage II."""
    refiner, teacher_inputs = model.refiner, _inputs(gaussians, teachers, change[teachers], weight[teachers])
    tokens = model.prepared(
        gaussians.latents, gaussians.latent_ids[teachers.cpu().numpy()], teacher_inputs, teaching=True
    )
    shares = _share(weight[teachers])
    # However many teach: a plain gradient's step does not grow with their number (an orthogonalised one never does).
    shares = shares * (TEACHER_WEIGHT_SUM / shares.sum().clamp_min(1e-6))
    state = refiner.adapt(model.initial_state(), None, teacher_tokens=(tokens, shares), strength=strength)
    parts = []
    for part in readers.split(max(len(readers), 1) if torch.is_grad_enabled() else GAUSSIANS_PER_CHUNK):
        values = refiner.read(state, reader_tokens(model, gaussians, part))
        parts.append(color_change(model.head(values), model.config.decoder))
    return torch.cat(parts)


def reader_tokens(model: SplatPainterModel, gaussians: EncodedGaussians, readers: Tensor) -> Tensor:
    """[R, D] tokens of the Gaussians `readers` [R] int64, which know nothing of an edit."""
    nothing = gaussians.colors.new_zeros(len(readers), 3)
    inputs = _inputs(gaussians, readers, nothing, nothing[:, 0])
    return model.prepared(gaussians.latents, gaussians.latent_ids[readers.cpu().numpy()], inputs)


def carrying(
    model: SplatPainterModel,
    latents: Latents,
    latent_ids: np.ndarray,
    splats: Splats,
    normals: np.ndarray,
    transfer: Callable[[], np.ndarray],
) -> Predict:
    """Stage II's answer for Gaussians that no picture shows, in place of the lift's regression. splats: numpy, N;
    latent_ids: [N] of each; transfer: computes [N, 10] of `prt_transfer`, called where the model reads it. Raises
    ValueError for Gaussians that can be drawn but were not encoded."""
    drawn = splats.drawable
    light = transfer()[drawn] if model.config.refine.facts else None
    gaussians = EncodedGaussians.of(model, latents, latent_ids[drawn], splats.take(drawn), normals[drawn], light)

    def predict(change: np.ndarray, weight: np.ndarray) -> np.ndarray:
        device, answer = gaussians.colors.device, np.zeros_like(change)
        arrays = (np.ascontiguousarray(x[drawn], np.float32) for x in (change, weight))
        moved, pixels = (torch.from_numpy(x).to(device) for x in arrays)
        seen = torch.nonzero(pixels > MIN_SEEN_PX)[:, 0]
        if len(seen):
            teachers = spread_evenly(seen, model.config.refine.row_tokens)
            with torch.no_grad():
                everyone = torch.arange(len(moved), device=device)
                answer[drawn] = carry(model, gaussians, moved, pixels, teachers, everyone).cpu().numpy()
        return answer

    return predict


def _inputs(gaussians: EncodedGaussians, ids: Tensor, change: Tensor, weight: Tensor) -> GaussianInputs:
    """Inputs of the Gaussians `ids` [J], whose change [J, 3] and weight [J] are what the edit says of them: nothing is
    predicted, so that is the colour before."""
    before, normals = gaussians.colors[ids], gaussians.normals[ids]
    lift = torch.cat([before, before + change, _share(weight)[:, None], before, normals], 1)
    return GaussianInputs(lift, None, gaussians.means[ids], None if gaussians.facts is None else gaussians.facts[ids])


def _share(weight: Tensor) -> Tensor:
    """0..1: how much of each Gaussian was seen."""
    return weight / (weight + HALF_SEEN_PX)
