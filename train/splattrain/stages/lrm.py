"""The Gaussian LRM: views in, one Gaussian per pixel out, judged from views that it did not see.

With geometry (compact) the views are the asset's own canonical renders with depth and alpha, as when the model is used;
without (paper) they are pictures of the object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from splatpainter.cameras import Camera
from splatpainter.models.encode import asset_views, canonical_cameras
from splatpainter.models.gaussian_groups import TokenLinks, links_from_views
from splatpainter.models.lrm import AssetViews
from splatpainter.models.model import SplatPainterModel
from splatpainter.splats import Splats
from splatpainter.voxels.grid import VoxelGrid, voxelize
from splattrain.loss import PictureLoss, PictureTarget, global_target, masked_psnr, scattered_depth
from splattrain.stages.task import Task, ValidationScore, between_share, draw, freeze, tensor

if TYPE_CHECKING:
    from splattrain.data.samples import Sample

PULL = 0.1
"""Weight of the loss that pulls points into place in the first steps."""


class LrmTask(Task[SplatPainterModel]):
    """The whole model; only the LRM is trained."""

    def __init__(self, model: SplatPainterModel, loss: PictureLoss, pull_steps: int, perceptual_views: int) -> None:
        """pull_steps: first steps in which only the depths learn; ignored where geometry is given."""
        super().__init__()
        self.model, self.loss = model, loss
        self.pull_steps = 0 if model.config.lrm.geometry else pull_steps
        self.perceptual_views = perceptual_views
        freeze(model.compressor, model.refiner, model.head, model.predictor)

    def losses(self, sample: Sample, seed: int) -> dict[str, Tensor]:
        views = input_views(self.model, sample, self.device)
        with self.arithmetic():
            predicted = self.model.lrm(views).splats
        if self.step < self.pull_steps:
            pulled = PULL * scattered_depth(_distances(predicted, views), len(views.cameras))
            return {"loss": pulled, "pulled": pulled}
        cameras, target = truth(sample, self.device)
        rendered, _ = draw(_drawn(predicted, views, self.model), cameras, self.device)
        chosen = np.random.default_rng(seed).permutation(len(rendered))[: self.perceptual_views]
        return self.loss(rendered, target, sorted(chosen.tolist()))

    @torch.no_grad()
    def judge(self, sample: Sample) -> ValidationScore:
        """As `judged`, and what the pictures are worth: `strength 0` is the answer to grey ones, `another edit` that to
        the same ones shown from each other's cameras, `between Gaussians` of what the tokens say."""
        views = input_views(self.model, sample, self.device)
        with self.arithmetic():
            output = self.model.lrm(views)
        score = judged(_drawn(output.splats, views, self.model), sample, views, self.device)

        def made_of(given: AssetViews) -> Splats[Tensor]:
            with self.arithmetic():
                return _drawn(self.model.lrm(given).splats, given, self.model)

        score.numbers.update(worth_of_pictures(score, sample, views, self.device, made_of))
        score.numbers["between Gaussians"] = between_share(output.tokens)
        return score


def judged(
    predicted: Splats[Tensor],
    sample: Sample,
    views: AssetViews,
    device: torch.device,
    before: Splats[Tensor] | None = None,
) -> ValidationScore:
    """What a reconstruction looks like beside the truth, and beside what it was made of (before)."""
    cameras, target = truth(sample, device)
    drawn_views = {"asset": sample.asset, "before": before, "ours": predicted}
    pictures = {
        name: draw(gaussians, cameras, device)[0] for name, gaussians in drawn_views.items() if gaussians is not None
    }
    numbers = {name: v for name, p in pictures.items() if (v := masked_psnr(p, target)) is not None}
    strip = [("input", views.colors[0].cpu().numpy())]
    strip += [(f"{name} {numbers.get(name, float('nan')):.2f} dB", p[0].cpu().numpy()) for name, p in pictures.items()]
    strip.append(("truth", target.colors[0].cpu().numpy()))
    return ValidationScore("reconstruction", numbers, tuple(strip))


def worth_of_pictures(
    score: ValidationScore,
    sample: Sample,
    views: AssetViews,
    device: torch.device,
    made_of: Callable[[AssetViews], Splats[Tensor]],
) -> dict[str, float]:
    """What a reconstruction is without its pictures, dB: of grey ones, and of the same ones shown from each other's
    cameras. made_of: reconstructs. Figures of which nothing comes out are left out."""
    numbers: dict[str, float] = {}
    if "ours" not in score.numbers:
        return numbers
    cameras, target = truth(sample, device)
    inputs = {"strength 0": torch.full_like(views.colors, 0.5), "another edit": views.colors.roll(1, 0)}
    for name, colors in inputs.items():
        try:
            predicted = made_of(replace(views, colors=colors))
        except ValueError:  # of such pictures it makes no Gaussian that can be seen
            continue
        value = masked_psnr(draw(predicted, cameras, device)[0], target)
        assert value is not None  # as of "ours", over the same pixels
        numbers[name] = value
    if "strength 0" in numbers:
        numbers["adapts"] = score.numbers["ours"] - numbers["strength 0"]
    return numbers


@torch.no_grad()
def input_views(model: SplatPainterModel, sample: Sample, device: torch.device) -> AssetViews:
    """What the LRM is shown of a sample. Raises ValueError where a sample has fewer base views than the model wants."""
    config = model.config.lrm
    asset = sample.asset.numpy()
    grid = voxelize(asset, model.config.compress.resolution)
    if config.geometry:
        gaussians = asset.torch(str(device)) if device.type == "cuda" else asset
        views, _ = asset_views(gaussians, canonical_cameras(asset, config), grid)
        return views
    cameras = list(sample.base.cameras)[: config.views]
    if len(cameras) < config.views:
        raise ValueError(
            f"expected {config.views} base views per sample, got {len(cameras)}; give --samples.base-views "
            f"{config.views}, or render the shards with data render --base-views {config.views}"
        )
    colors = tensor(sample.base.colors, device)[: config.views]
    return AssetViews(cameras, colors, center=grid.min_corner + grid.extent / 2, half_extent=grid.extent / 2)


def asset_tokens(task: Task[SplatPainterModel], splats: Splats, grid: VoxelGrid) -> tuple[Tensor, TokenLinks]:
    """What the task's LRM sees of an asset in its canonical views, and which token shows which Gaussian."""
    config = task.model.config.lrm
    cameras = canonical_cameras(splats, config)
    views, seen = asset_views(splats.torch(str(task.device)), cameras, grid)
    with task.arithmetic():
        tokens = task.model.encode_views(views)
    return tokens, links_from_views(splats.means, cameras, seen, config.patch)


def truth(sample: Sample, device: torch.device) -> tuple[list[Camera], PictureTarget]:
    """The unedited object from the sample's novel views."""
    colors = tensor(sample.novel_before.colors, device)
    with torch.no_grad():
        _, alpha = draw(sample.asset, sample.novel_before.cameras, device)
    return list(sample.novel_before.cameras), global_target(colors, alpha > 0.5)


def _drawn(predicted: Splats[Tensor], views: AssetViews, model: SplatPainterModel) -> Splats[Tensor]:
    return predicted.take(torch.nonzero(model.lrm.on_surface(views, predicted))[:, 0])


def _distances(predicted: Splats[Tensor], views: AssetViews) -> Tensor:
    """[V * H * W] distance from the camera minus the camera's from the middle, half cubes."""
    eyes = np.stack([camera.position for camera in views.cameras])
    far = np.linalg.norm(eyes - np.asarray(views.center), axis=1)
    per_view = predicted.means.view(len(eyes), -1, 3)
    eye = tensor(eyes, predicted.means.device)[:, None]
    return (((per_view - eye).norm(dim=-1) - tensor(far, predicted.means.device)[:, None]) / views.half_extent).reshape(
        -1
    )
