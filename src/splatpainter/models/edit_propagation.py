"""Stage II as the carrier of a global edit: Gaussians that a picture shows teach its memory how they changed, and
what it then says to the others is how they change.

    predict = CarriedEdit(model, encoded.latents, encoded.latent_ids, asset.splats, normals, transfer)
    lift_global(splats, views, predict=predict)
    predict.state

For a model with config.refine.answers "teachers" (`train rows`): a Gaussian that no picture shows is told nothing of
the edit but what the memory says, so that without adaptation (edit strength 0) all edits would be one. The Gaussian's
own colour does not enter the sum: what is read is a change. Where the edit is a look and no light, it is the mean of
that and of the lift's regression.

Its first fast weights are taught anew by every edit, with all pictures that go on with each other (edits_in_turn.py). N
Gaussians, R of them asked.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import field
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from splatpainter.color import base_color
from splatpainter.lift.colors import MIN_SEEN_PX
from splatpainter.lift.features import HALF_SEEN_PX
from splatpainter.lift.global_edit import light_share, regressed
from splatpainter.models.decode import color_change
from splatpainter.models.gaussian_facts import gaussian_facts
from splatpainter.models.model import GaussianInputs
from splatpainter.models.predictor import described_facts, spread_evenly
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.models.compress import Latents
    from splatpainter.models.model import SplatPainterModel
    from splatpainter.models.refine import RefineState

TEACHER_WEIGHT_SUM = 128.0
"""Sum of what the Gaussians that teach count."""
GAUSSIANS_PER_CHUNK = 1 << 12
"""Gaussians asked at once without gradients."""
MIN_TEACHER_PX = 1.0
"""Pixels that have to show a Gaussian for it to teach, where any has as many: what less than one says of its colour is
mostly its neighbours'. On a ball seen from two sides the rest is at 22.0 dB in place of 17.6 (no limit), 21.4 at 2."""
LIGHT = (0.1, 0.3)
"""`light_share` of what is shown, from which an edit is of light by degrees: then Stage II alone answers for the rest,
and the mean of it and of the lift's regression for a look. 48 graded and 40 relit samples of procedural objects, which
it has not seen: over the lift alone -0.12 dB and +0.57 by Stage II alone, -0.01 and +0.57 by this."""


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
        # What was never encoded has no latent, and guessing one would colour it by chance.
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
) -> tuple[RefineState, Tensor]:
    """(the state after adapting to the change of the Gaussians `teachers` [T], [R, 3] what it then says is the change
    of base colour of the Gaussians `readers` [R]; int64 both). change: [N, 3]; weight: [N] pixels that show each, both
    read at teachers only; strength: overrides config.refine.edit_strength. Differentiable in the weights of Stage
    II."""
    refiner, teacher_inputs = model.refiner, _inputs(gaussians, teachers, change[teachers], weight[teachers])
    tokens = model.prepared(
        gaussians.latents, gaussians.latent_ids[teachers.cpu().numpy()], teacher_inputs, teaching=True
    )
    shares = _share(weight[teachers])
    # However many teach: a plain gradient's step does not grow with their number (an orthogonalised one never does).
    shares = shares * (TEACHER_WEIGHT_SUM / shares.sum().clamp_min(1e-6))
    after = refiner.adapt(model.initial_state(), None, teacher_tokens=(tokens, shares), strength=strength)
    return after, remembered(model, gaussians, after, readers)


def remembered(model: SplatPainterModel, gaussians: EncodedGaussians, state: RefineState, readers: Tensor) -> Tensor:
    """[R, 3] the change of base colour that a state says of the Gaussians `readers` [R] int64."""
    parts = []
    for part in readers.split(max(len(readers), 1) if torch.is_grad_enabled() else GAUSSIANS_PER_CHUNK):
        values = model.refiner.read(state, reader_tokens(model, gaussians, part))
        parts.append(color_change(model.head(values), model.config.decoder))
    return torch.cat(parts)


def reader_tokens(model: SplatPainterModel, gaussians: EncodedGaussians, readers: Tensor) -> Tensor:
    """[R, D] tokens of the Gaussians `readers` [R] int64, which know nothing of an edit."""
    nothing = gaussians.colors.new_zeros(len(readers), 3)
    inputs = _inputs(gaussians, readers, nothing, nothing[:, 0])
    return model.prepared(gaussians.latents, gaussians.latent_ids[readers.cpu().numpy()], inputs)


class CarriedEdit:
    """Stage II's answer for Gaussians that no picture shows, in place of the lift's regression (lift.Predict), and the
    state that it leaves."""

    def __init__(
        self,
        model: SplatPainterModel,
        latents: Latents,
        latent_ids: np.ndarray,
        splats: Splats,
        normals: np.ndarray,
        transfer: Callable[[], np.ndarray],
        strength: float | None = None,
    ) -> None:
        """splats: numpy, N; latent_ids: [N] of each; transfer: computes [N, 10] of `prt_transfer`, called where the
        model reads it; strength: overrides config.refine.edit_strength. Raises ValueError for Gaussians that can be
        drawn but were not encoded."""
        self.model, self._strength = model, strength
        self.state: RefineState | None = None
        """After the last call."""
        self._drawn = drawn = splats.drawable
        light = transfer()[drawn] if model.config.refine.facts else None
        self._splats, self._normals = splats.take(drawn), normals[drawn]
        self.gaussians = EncodedGaussians.of(model, latents, latent_ids[drawn], self._splats, self._normals, light)

    def __call__(self, change: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """[N, 3] change of every Gaussian. change: [N, 3] of those that are shown; weight: [N] pixels that show
        each."""
        drawn, answer = self._drawn, np.zeros_like(change)
        device = self.gaussians.colors.device
        arrays = (np.ascontiguousarray(x[drawn], np.float32) for x in (change, weight))
        moved, pixels = (torch.from_numpy(x).to(device) for x in arrays)
        # Evenly chosen, as neighbours would teach the same thing.
        sure = torch.nonzero(pixels > MIN_TEACHER_PX)[:, 0]
        sure = sure if len(sure) else torch.nonzero(pixels > MIN_SEEN_PX)[:, 0]
        if not len(sure):
            return answer
        teachers = spread_evenly(sure, self.model.config.refine.row_tokens)
        everyone = torch.arange(len(moved), device=device)
        with torch.no_grad():
            arrays = (moved, pixels, teachers, everyone)
            self.state, changes = carry(self.model, self.gaussians, *arrays, strength=self._strength)
        answer[drawn] = self._mixed(changes.cpu().numpy(), change[drawn], weight[drawn], sure.cpu().numpy())
        return answer

    def _mixed(self, answer: np.ndarray, change: np.ndarray, weight: np.ndarray, sure: np.ndarray) -> np.ndarray:
        """[M, 3] Stage II's answer [M, 3], or its mean with the lift's regression for looks (LIGHT). change, weight: of
        the M that can be drawn; sure: indices of those that say what kind of edit it is."""
        colors = base_color(self._splats.sh[sure])
        light = light_share(colors, self._normals[sure], change[sure], weight[sure])
        share = 0.5 + 0.5 * min(max((light - LIGHT[0]) / (LIGHT[1] - LIGHT[0]), 0.0), 1.0)
        if share == 1:
            return answer
        return share * answer + (1 - share) * regressed(self._splats, self._normals, change, weight)

    def at_strength(self, strength: float) -> CarriedEdit:
        """The same with another edit strength; 0: nothing adapts."""
        other = copy.copy(self)
        other._strength = strength
        return other


def _inputs(gaussians: EncodedGaussians, ids: Tensor, change: Tensor, weight: Tensor) -> GaussianInputs:
    """Inputs of the Gaussians `ids` [J], whose change [J, 3] and weight [J] are what the edit says of them: nothing is
    predicted, so that is the colour before."""
    before, normals = gaussians.colors[ids], gaussians.normals[ids]
    lift = torch.cat([before, before + change, _share(weight)[:, None], before, normals], 1)
    return GaussianInputs(lift, None, gaussians.means[ids], None if gaussians.facts is None else gaussians.facts[ids])


def _share(weight: Tensor) -> Tensor:
    """0..1: how much of each Gaussian was seen."""
    return weight / (weight + HALF_SEEN_PX)
