"""Stage I: Gaussians and tokens to latents, with the LRM frozen.

copy: what the kept latents decode to must look like the object (the paper's stage). native: nothing is dropped, so
copying would be the identity. There a share of the Gaussians lose their colours and the latents must predict them, by a
linear map that is thrown away afterwards: so latents learn to hold what the LRM's tokens saw of a Gaussian and what its
neighbours look like, which is what an edit has to carry over. It needs no renderer and is the cheapest stage.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from splatpainter.models.gaussian_groups import GaussianGroups, TokenLinks
from splatpainter.models.lrm import AssetViews
from splatpainter.models.model import SplatPainterModel
from splatpainter.splats import SH_C0, Splats
from splatpainter.system.recent import Recent
from splatpainter.voxels.grid import voxelize
from splattrain.loss import PictureLoss
from splattrain.stages.lrm import asset_tokens, input_views, judged, truth, worth_of_pictures
from splattrain.stages.task import Task, ValidationScore, between_share, draw, freeze

if TYPE_CHECKING:
    from splattrain.data.samples import Sample

HIDDEN = 0.5
"""Share of the Gaussians that lose their colours."""


class CopyTask(Task[SplatPainterModel]):
    """`copy`: Stage I and the decoder are trained to reproduce the object."""

    def __init__(self, model: SplatPainterModel, loss: PictureLoss, perceptual_views: int) -> None:
        super().__init__()
        self.model, self.loss, self.perceptual_views = model, loss, perceptual_views
        freeze(model.lrm, model.refiner, model.predictor)

    def losses(self, sample: Sample, seed: int) -> dict[str, Tensor]:
        copied, _, _ = self._copy(input_views(self.model, sample, self.device))
        cameras, target = truth(sample, self.device)
        rendered, _ = draw(copied, cameras, self.device)
        chosen = np.random.default_rng(seed).permutation(len(rendered))[: self.perceptual_views]
        return self.loss(rendered, target, sorted(chosen.tolist()))

    @torch.no_grad()
    def judge(self, sample: Sample) -> ValidationScore:
        """As `judged`, and what the pictures are worth to it (`worth_of_pictures`); `between Gaussians` of latents."""
        views = input_views(self.model, sample, self.device)
        copied, before, latents = self._copy(views)
        score = judged(copied, sample, views, self.device, before)
        score.numbers.update(worth_of_pictures(score, sample, views, self.device, lambda x: self._copy(x)[0]))
        score.numbers["between Gaussians"] = between_share(latents)
        return score

    def _copy(self, views: AssetViews) -> tuple[Splats[Tensor], Splats[Tensor], Tensor]:
        """After Stage I, the LRM's Gaussians before it, and Stage I's latents [K, D]."""
        with self.arithmetic():
            with torch.no_grad():
                copy = self.model.copied_gaussians(views)
            grid = voxelize(copy.gaussians.numpy(), self.model.config.compress.resolution)
            latents = self.model.compressor(copy.tokens, copy.gaussians, copy.links, self.model.groups(grid))
        return self.model.decode_latents(latents, copy.gaussians), copy.gaussians, latents.values


class HiddenColors(Task[SplatPainterModel]):
    """`native`: Stage I is trained to predict colours that it does not see."""

    def __init__(self, model: SplatPainterModel, objects: int = 4) -> None:
        """objects: whose tokens are kept."""
        super().__init__()
        self.model = model
        self.guess = nn.Linear(model.config.compress.dim, 3 * (model.config.sh_degree + 1) ** 2)
        self._encoded_objects: Recent[tuple[Tensor, Splats[Tensor], TokenLinks, GaussianGroups]] = Recent(objects)
        freeze(model.lrm, model.refiner, model.head, model.predictor)

    def losses(self, sample: Sample, seed: int) -> dict[str, Tensor]:
        guessed, target, _ = self._guess(sample, seed)
        loss = (guessed - target).square().mean() * SH_C0**2  # of order of squared colours
        return {"loss": loss}

    @torch.no_grad()
    def judge(self, sample: Sample) -> ValidationScore:
        """PSNR of the base colours of hidden Gaussians. `strength 0`: as guessed of a grey asset; `another edit`: of
        one in complementary colours."""
        guessed, target, visible = self._guess(sample, 0)
        # The floor is what the mean of the colours of the visible Gaussians would get.
        numbers = {
            "mean": _decibels((visible[:, :3].mean(0) - target[:, :3]) * SH_C0),
            "ours": _decibels((guessed[:, :3] - target[:, :3]) * SH_C0),
        }
        for name, factor in (("strength 0", 0.0), ("another edit", -1.0)):
            numbers[name] = _decibels((self._guess(sample, 0, factor)[0][:, :3] - target[:, :3]) * SH_C0)
        numbers["adapts"] = numbers["ours"] - numbers["strength 0"]
        numbers["between Gaussians"] = between_share(guessed)
        return ValidationScore("hidden colours", numbers, ())

    def _guess(self, sample: Sample, seed: int, factor: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
        """SH [M, 3 K] of the hidden Gaussians as guessed and as they are shown, and of the visible Gaussians. factor:
        on the SH of the asset that is shown; 0: a grey one."""
        if factor == 1:
            encoded = self._encoded_objects.get(sample.asset.sha256, lambda: self._encode_object(sample.asset.numpy()))
        else:
            asset = sample.asset.numpy()
            encoded = self._encode_object(replace(asset, sh=np.float32(factor) * asset.sh))
        tokens, gaussians, links, groups = encoded
        hidden = torch.from_numpy(np.random.default_rng(seed).random(len(gaussians)) < HIDDEN).to(self.device)
        blind = replace(gaussians, sh=torch.where(hidden[:, None, None], 0, gaussians.sh))
        with self.arithmetic():
            latents = self.model.compressor(tokens, blind, links, groups)
        order = torch.from_numpy(latents.groups.order).to(self.device)
        sh = gaussians.sh[order][:, : (self.model.config.sh_degree + 1) ** 2].flatten(1)
        sh = F.pad(sh, (0, self.guess.out_features - sh.shape[1]))
        hidden = hidden[order]
        return self.guess(F.layer_norm(latents.values, latents.values.shape[1:]))[hidden], sh[hidden], sh[~hidden]

    @torch.no_grad()
    def _encode_object(self, splats: Splats) -> tuple[Tensor, Splats[Tensor], TokenLinks, GaussianGroups]:
        grid = voxelize(splats, self.model.config.compress.resolution)
        tokens, links = asset_tokens(self, splats, grid)
        return tokens, splats.torch(str(self.device)), links, self.model.groups(grid)


def _decibels(difference: Tensor) -> float:
    return float(-10 * torch.log10(difference.square().mean().clamp_min(1e-12)))
