"""`splatpainter train densify`: base views and close-ups in, finer Gaussians out, judged from views that the densifier
did not see. The command finds this module by its entry point (splattrain.recipes).

The loss is the published one, MSE + 0.5 (1 - MS-SSIM) over whole pictures: of novel views near the close-ups and around
the object, and of the close-ups themselves. Nothing but the network learns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from splatbench.densification.densifier import Densified, Densifier, densified
from splatbench.densification.densify_config import PRESETS, DensifyConfig
from splatpainter.cameras import Camera
from splatpainter.fit.image_loss import SSIM_KERNEL, WINDOW
from splatpainter.metrics.images import C1, C2
from splatpainter.models import checkpoint
from splattrain import recipes, state
from splattrain.loss import global_target, masked_psnr
from splattrain.report import figures
from splattrain.stages.task import Task, ValidationScore, draw, tensor

if TYPE_CHECKING:
    from splattrain.data.samples import Sample

MS_SSIM_WEIGHT = 0.5
"""Weight of 1 - MS-SSIM in the loss."""
MIN_ALPHA = 0.5
"""Alpha from which a pixel is the object's."""
RECIPES = Path(__file__).with_name("recipes")
"""Folder of the stage's recipes."""
MS_SSIM_EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the scales, from the finest."""
MIN_SCALE_MEAN = 1e-3
"""A scale's mean is at least this: a power of it must have a gradient."""


@dataclass(frozen=True)
class DensifyRecipe(recipes.Recipe):
    """How a densifier is trained."""

    MODEL_PRESETS: ClassVar = {"densifier": PRESETS}
    stage: recipes.Stage = "densify"
    densifier: DensifyConfig = PRESETS["compact"]
    """The model of stage densify; of the options of `model` none counts."""

    def to_dict(self) -> dict[str, Any]:
        values = super().to_dict()
        del values["model"]
        return {"stage": values.pop("stage"), "densifier": values.pop("densifier"), **values}


RECIPE_CLASS = DensifyRecipe
"""The stage's, by the name that the command goes by."""


class DensifyTask(Task[Densifier]):
    """The whole densifier is trained."""

    def __init__(self, model: Densifier, loss_views: int = 0, gaussians: int = 0) -> None:
        """loss_views: views that are rendered and compared, 0: all; gaussians: those that are replaced, at most; 0: the
        model's number. Validation replaces as many."""
        super().__init__()
        self.model, self.loss_views = model, loss_views
        self.most = min(gaussians or model.config.most, model.config.most)

    def losses(self, sample: Sample, seed: int) -> dict[str, Tensor]:
        rng = np.random.default_rng(seed)
        result = self._made(sample, rng)
        cameras, target = self._target(sample, rng)
        rendered, _ = draw(result.splats, cameras, self.device)
        squared = (rendered - target).square().mean()
        likeness = ms_ssim(rendered.clamp(0, 1), target)
        return {"squared": squared, "ms_ssim": likeness, "loss": squared + MS_SSIM_WEIGHT * (1 - likeness)}

    @torch.no_grad()
    def judge(self, sample: Sample) -> ValidationScore:
        result = self._made(sample)
        views, near = sample.novel_after, np.asarray(sample.near, bool)
        truth = tensor(views.colors, self.device)
        drawn, alpha = draw(sample.asset, views.cameras, self.device)
        pictures = {"nothing": drawn, "ours": draw(result.splats, views.cameras, self.device)[0]}
        numbers: dict[str, float] = {}
        for where, chosen in (("", near), ("around ", ~near)):
            pick = torch.from_numpy(np.flatnonzero(chosen)).to(self.device)
            if not len(pick):
                continue
            target = global_target(truth[pick], alpha[pick] > MIN_ALPHA)
            for name, picture in pictures.items():
                if not where:
                    numbers |= figures(name, picture[pick], target, None)
                elif (value := masked_psnr(picture[pick], target)) is not None:
                    numbers[where + name] = value
        if "ours" in numbers:
            numbers["gain"] = numbers["ours"] - numbers["nothing"]
        first = int(near.argmax())
        strip = [("close-up", tensor(sample.edited.colors, torch.device("cpu"))[0].numpy())]
        strip += [
            (f"{name} {numbers.get(name, float('nan')):.2f} dB", p[first].cpu().numpy()) for name, p in pictures.items()
        ]
        strip.append(("truth", truth[first].cpu().numpy()))
        return ValidationScore(sample.kind, numbers, tuple(strip))

    def _made(self, sample: Sample, rng: np.random.Generator | None = None) -> Densified:
        views = (sample.base, sample.edited)
        cameras = [camera for part in views for camera in part.cameras]
        colors = [picture for part in views for picture in torch.as_tensor(part.colors).float().cpu().numpy()]
        return densified(self.model, sample.asset.numpy(), cameras, colors, rng, most=self.most)

    def _target(self, sample: Sample, rng: np.random.Generator) -> tuple[list[Camera], Tensor]:
        """(cameras, pictures [C, H, W, 3]): a third close-ups on average, the others novel views."""
        novel, given = len(sample.novel_after.cameras), len(sample.edited.cameras)
        count = self.loss_views or novel + given
        share = int(count / 3 + rng.random()) if self.loss_views else given
        edited = rng.permutation(given)[:share]
        chosen = rng.permutation(novel)[: max(count - len(edited), 1)]
        cameras = [sample.novel_after.cameras[k] for k in chosen] + [sample.edited.cameras[k] for k in edited]
        novel_pictures = tensor(sample.novel_after.colors, self.device)[chosen.tolist()]
        return cameras, torch.cat([novel_pictures, tensor(sample.edited.colors, self.device)[edited.tolist()]])


def make_task(recipe: DensifyRecipe, weights: Path | None, report: Callable[[str], None] = print) -> DensifyTask:
    """The task with a new model (seed torch before) or that of a checkpoint. Raises ValueError naming what differs
    where the checkpoint is of another densifier."""
    model = Densifier(recipe.densifier)
    if weights is not None:
        saved = checkpoint.load(weights, kind=DensifyConfig)
        differing = state.differing_config(
            saved.config, recipe.densifier, lambda key: key in ("preset", "most", "min_opacity")
        )
        if differing:
            raise ValueError(f"{weights}: weights of another model: {'; '.join(differing[:3])}")
        checkpoint.fill(model, saved.tensors, str(weights))
        model.notes = {"history": state.history(weights, saved.notes)}
        report(f"starting from {weights}")
    return DensifyTask(model, recipe.loss_views, recipe.gradient_rows)


def ms_ssim(a: Tensor, b: Tensor) -> Tensor:
    """Scalar, at most 1: multi-scale structural similarity, differentiable (Wang, Simoncelli & Bovik 2003), the mean
    over pictures and channels.

        MS-SSIM = prod_k mean(c_k)^w_k over the finer scales * mean(S_K)^w_K at the coarsest

    c: SSIM's contrast and structure term, S: all of SSIM, both over pixels whose window lies in the picture
    (metrics/images). Small pictures have fewer scales than the paper's five: those where a window still fits; their
    exponents are divided by their sum. a, b: [C, H, W, 3] in 0..1, of at least 11 x 11 pixels.
    Raises ValueError for smaller ones."""
    if min(a.shape[1:3]) < WINDOW:
        raise ValueError(f"MS-SSIM: expected pictures of at least {WINDOW}x{WINDOW}, got {a.shape[2]}x{a.shape[1]}")
    first, second = (x.permute(0, 3, 1, 2) for x in (a, b))
    count = 1
    while count < len(MS_SSIM_EXPONENTS) and min(a.shape[1:3]) >> count >= WINDOW:
        count += 1
    total = sum(MS_SSIM_EXPONENTS[:count])
    value = torch.ones_like(first[:, :, 0, 0])
    for k in range(count):
        structure, ssim = _ssim_terms(first, second)
        value = value * (ssim if k == count - 1 else structure).clamp_min(MIN_SCALE_MEAN) ** (
            MS_SSIM_EXPONENTS[k] / total
        )
        first, second = F.avg_pool2d(first, 2), F.avg_pool2d(second, 2)
    return value.mean()


def _ssim_terms(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """[C, 3] means of c and of S, of pictures [C, 3, H, W]."""
    count = a.shape[0] * a.shape[1]
    stack = torch.stack([a, b, a * a, b * b, a * b]).reshape(5 * count, 1, *a.shape[2:])
    taps = torch.as_tensor(SSIM_KERNEL, dtype=a.dtype, device=a.device)
    blurred = F.conv2d(F.conv2d(stack, taps.view(1, 1, WINDOW, 1)), taps.view(1, 1, 1, WINDOW))
    mean_a, mean_b, aa, bb, ab = blurred.reshape(5, *a.shape[:2], *blurred.shape[2:]).unbind(0)
    structure = (2 * (ab - mean_a * mean_b) + C2) / (aa - mean_a**2 + bb - mean_b**2 + C2)
    light = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return structure.mean((2, 3)), (light * structure).mean((2, 3))
