"""Stage II as the sole carrier of a global edit: Gaussians that a picture shows teach its memory how they changed, and
what it then says to the others is how they change.

    predict = CarriedEdit(model, encoded.latents, encoded.latent_ids, asset.splats, normals, transfer, state)
    lift_global(splats, views, predict=predict)
    predict.state

For a model with config.refine.answers "teachers" (`train rows`): a Gaussian that no picture shows is told nothing of
the edit but what the memory says, so that without adaptation (edit strength 0) all edits would be one. The Gaussian's
own colour does not enter the sum: what is read is a change.

The memory is a state that keeps what its edits have shown: the next one teaches all of it anew, so that views given one
after the other make what they make together, and what it answers is the change since the first edit. A Gaussian that an
earlier edit has shown stays as that one left it where the new pictures agree with that; where they contradict it, what
was shown before is forgotten, and the latest wins. N Gaussians, R of them asked, E encoded ones.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from splatpainter.color import base_color
from splatpainter.lift.colors import MIN_SEEN_PX
from splatpainter.lift.features import HALF_SEEN_PX
from splatpainter.models.decode import color_change
from splatpainter.models.gaussian_facts import gaussian_facts
from splatpainter.models.model import GaussianInputs
from splatpainter.models.predictor import described_facts, spread_evenly
from splatpainter.splats import SH_C0, Splats
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
AGREES, CONTRADICTS = 0.3, 0.6
"""Share of the power of what new pictures show of Gaussians that the edits before do not explain: up to the first they
go on with these, from the second on they are another edit."""
FORETOLD = 0.1
"""What a Gaussian counts for that which the memory alone has foretold, against one that earlier pictures have shown."""


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
        moved: np.ndarray | None = None,
    ) -> EncodedGaussians:
        """splats: numpy, N that can be drawn; latent_ids: [N] of each; transfer: [N, 10] of `prt_transfer`, for a model
        that reads facts; moved: [N, 3] by which edits have changed their colours, which are told as they were before.
        Raises ValueError for Gaussians that were not encoded."""
        if moved is not None:
            sh = splats.sh.copy()
            sh[:, 0] -= (moved / SH_C0).astype(sh.dtype)
            splats = replace(splats, sh=sh)
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
        state: RefineState | None = None,
        parent_ids: np.ndarray | None = None,
        strength: float | None = None,
    ) -> None:
        """splats: numpy, N; latent_ids: [N] of each; transfer: computes [N, 10] of `prt_transfer`, called where the
        model reads it; state: of the edits before; parent_ids: [N] int64 the encoded Gaussian that each is or comes
        from (default: itself); strength: overrides config.refine.edit_strength. Raises ValueError for Gaussians that
        can be drawn but were not encoded."""
        self.model, self._start, self._splats, self._strength = model, state, splats, strength
        self.state = state
        """After the last call; every call goes on from the state that was given."""
        self._parents = np.arange(len(splats)) if parent_ids is None else parent_ids
        self._drawn = drawn = splats.drawable
        self._weight = np.zeros(len(splats), np.float32)
        self._agreement = 1.0
        # Of the Gaussians as they are now, by way of parents: edits in between may have split them.
        evidence = (
            None if state is None or state.evidence is None else state.evidence.cpu().numpy()[self._parents[drawn]]
        )
        self._evidence = evidence
        light = transfer()[drawn] if model.config.refine.facts else None
        # Told in the colours before all edits, as the memory counts changes from there.
        arrays = (latents, latent_ids[drawn], splats.take(drawn), normals[drawn], light)
        self.gaussians = EncodedGaussians.of(model, *arrays, None if evidence is None else evidence[:, :3])

    def __call__(self, change: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """[N, 3] change of every Gaussian. change: [N, 3] of those that are shown; weight: [N] pixels that show
        each."""
        drawn, gaussians, answer = self._drawn, self.gaussians, np.zeros_like(change)
        device = gaussians.colors.device
        arrays = (np.ascontiguousarray(x[drawn], np.float32) for x in (change, weight))
        moved, pixels = (torch.from_numpy(x).to(device) for x in arrays)
        self._weight[:] = weight
        if not (pixels > MIN_SEEN_PX).any():
            return answer
        everyone = torch.arange(len(moved), device=device)
        with torch.no_grad():
            if self._evidence is None:
                self.state, changes = self._carry(moved, pixels, everyone)
            else:
                changes = self._goes_on(moved, pixels, everyone)
        answer[drawn] = changes.cpu().numpy()
        return answer

    def at_strength(self, strength: float) -> CarriedEdit:
        """The same with another edit strength; 0: nothing adapts."""
        other = copy.copy(self)
        other._weight, other._strength = self._weight.copy(), strength
        return other

    def _goes_on(self, moved: Tensor, pixels: Tensor, everyone: Tensor) -> Tensor:
        """[N, 3] the change from here, by a memory that knows the change since the first edit."""
        assert self._evidence is not None and self._start is not None
        so_far, before = torch.from_numpy(self._evidence).to(moved.device).split([3, 1], 1)
        # The memory knows the change since the first edit, so it is taught that, and not the last step.
        total, visibility = so_far + moved, _share(before)
        self._agreement = self._agrees(total, pixels, so_far, visibility)
        # What earlier pictures showed teaches again beside what these do, as it would have with all of them at once.
        weight = pixels + self._agreement * before[:, 0]
        state, answer = self._carry(total, weight, everyone)
        self.state = replace(state, evidence=self._start.evidence)
        # What the lift did besides (the far side, its last rounds) stays with what goes on.
        old = remembered(self.model, self.gaussians, self._start, everyone)
        start = so_far + self._agreement * (old - so_far)
        return (answer - start) * (1 - self._agreement * visibility)

    def _agrees(self, total: Tensor, pixels: Tensor, so_far: Tensor, visibility: Tensor) -> float:
        """0..1: whether new pictures, by which Gaussians have changed by total [N, 3] since the first edit, go on with
        the edits before. so_far: [N, 3] change by these; visibility: [N, 1] how much of each they showed."""
        assert self._start is not None
        indices = torch.nonzero(pixels > MIN_SEEN_PX)[:, 0]
        total, so_far, visibility = total[indices], so_far[indices], visibility[indices]
        # What was shown is known; what the memory makes of the rest is a guess, and a poor one is no contradiction.
        foretold = remembered(self.model, self.gaussians, self._start, indices)
        expected = visibility * so_far + (1 - visibility) * foretold
        counts = _share(pixels[indices])[:, None] * (FORETOLD + (1 - FORETOLD) * visibility)
        unlike = float((counts * (expected - total).square()).sum() / (counts * total.square()).sum().clamp_min(1e-9))
        return min(max((CONTRADICTS - unlike) / (CONTRADICTS - AGREES), 0.0), 1.0)

    def _carry(self, change: Tensor, weight: Tensor, readers: Tensor) -> tuple[RefineState, Tensor]:
        """As `carry`, of all that weight [N] says is shown. Evenly chosen, as neighbours would teach the same thing."""
        sure = torch.nonzero(weight > MIN_TEACHER_PX)[:, 0]
        sure = sure if len(sure) else torch.nonzero(weight > MIN_SEEN_PX)[:, 0]
        teachers = spread_evenly(sure, self.model.config.refine.row_tokens)
        return carry(self.model, self.gaussians, change, weight, teachers, readers, strength=self._strength)

    def after(self, splats: Splats) -> RefineState:
        """The state that the next edit starts from. splats: the N Gaussians after this one."""
        state = self.model.initial_state() if self.state is None else self.state
        drawn, parents = self._drawn, self._parents[self._drawn]
        change = base_color(splats.sh[drawn]) - base_color(self._splats.sh[drawn])
        now = np.concatenate([change, self._weight[drawn, None]], 1)
        if self._evidence is not None:
            now[:, :3] += self._evidence[:, :3]
            now[:, 3] += self._agreement * self._evidence[:, 3]
        # Kept by encoded Gaussian: indices of the asset change with every edit.
        count = int(self._parents.max()) + 1 if state.evidence is None else len(state.evidence)
        total, number = np.zeros((count, 4)), np.zeros(count)
        np.add.at(total, parents, now)
        np.add.at(number, parents, 1)
        mean = (total / np.maximum(number, 1)[:, None]).astype(np.float32)
        return replace(state, evidence=torch.from_numpy(mean).to(self.gaussians.colors.device))


def _inputs(gaussians: EncodedGaussians, ids: Tensor, change: Tensor, weight: Tensor) -> GaussianInputs:
    """Inputs of the Gaussians `ids` [J], whose change [J, 3] and weight [J] are what the edit says of them: nothing is
    predicted, so that is the colour before."""
    before, normals = gaussians.colors[ids], gaussians.normals[ids]
    lift = torch.cat([before, before + change, _share(weight)[:, None], before, normals], 1)
    return GaussianInputs(lift, None, gaussians.means[ids], None if gaussians.facts is None else gaussians.facts[ids])


def _share(weight: Tensor) -> Tensor:
    """0..1: how much of each Gaussian was seen."""
    return weight / (weight + HALF_SEEN_PX)
