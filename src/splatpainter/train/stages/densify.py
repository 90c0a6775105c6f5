"""The densifier: base views and close-ups in, finer rows out, judged from views that it did not see.

The loss is the published one, MSE + 0.5 (1 - MS-SSIM) over whole pictures: of novel views near the close-ups and around
the object, and of the close-ups themselves. Nothing but the network learns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from splatpainter.cameras import Camera
from splatpainter.models.densification.densifier import Densified, Densifier, densified
from splatpainter.train.loss import global_target, masked_psnr, ms_ssim
from splatpainter.train.report import figures
from splatpainter.train.stages.task import Task, Verdict, draw, tensor

if TYPE_CHECKING:
    from splatpainter.data.samples import Sample

SHARE = 0.5
"""Of 1 - MS-SSIM in the loss."""
SOLID = 0.5
"""Alpha from which a pixel is the object's."""


class DensifyTask(Task[Densifier]):
    """The whole densifier is trained."""

    def __init__(self, model: Densifier, loss_views: int = 0, rows: int = 0) -> None:
        """loss_views: views that are rendered and compared, 0: all; rows: that are replaced, at most; 0: the model's
        number. Validation replaces as many."""
        super().__init__()
        self.model, self.loss_views = model, loss_views
        self.most = min(rows or model.config.most, model.config.most)

    def losses(self, sample: Sample, seed: int) -> dict[str, Tensor]:
        rng = np.random.default_rng(seed)
        made = self._made(sample, rng)
        cameras, target = self._target(sample, rng)
        rendered, _ = draw(made.splats, cameras, self.device)
        squared = (rendered - target).square().mean()
        likeness = ms_ssim(rendered.clamp(0, 1), target)
        return {"squared": squared, "ms_ssim": likeness, "loss": squared + SHARE * (1 - likeness)}

    @torch.no_grad()
    def judge(self, sample: Sample) -> Verdict:
        made = self._made(sample)
        views, near = sample.novel_after, np.asarray(sample.near, bool)
        truth = tensor(views.colors, self.device)
        drawn, alpha = draw(sample.asset, views.cameras, self.device)
        pictures = {"nothing": drawn, "ours": draw(made.splats, views.cameras, self.device)[0]}
        numbers: dict[str, float] = {}
        for where, chosen in (("", near), ("around ", ~near)):
            pick = torch.from_numpy(np.flatnonzero(chosen)).to(self.device)
            if not len(pick):
                continue
            target = global_target(truth[pick], alpha[pick] > SOLID)
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
        return Verdict(sample.kind, numbers, tuple(strip))

    def _made(self, sample: Sample, rng: np.random.Generator | None = None) -> Densified:
        views = (sample.base, sample.edited)
        cameras = [camera for part in views for camera in part.cameras]
        colors = [picture for part in views for picture in torch.as_tensor(part.colors).float().cpu().numpy()]
        return densified(self.model, sample.asset.numpy(), cameras, colors, rng, most=self.most)

    def _target(self, sample: Sample, rng: np.random.Generator) -> tuple[list[Camera], Tensor]:
        """(cameras, pictures [C, H, W, 3]): a third close-ups on average, the others novel views."""
        novel, given = len(sample.novel_after.cameras), len(sample.edited.cameras)
        most = self.loss_views or novel + given
        share = int(most / 3 + rng.random()) if self.loss_views else given
        edited = rng.permutation(given)[:share]
        chosen = rng.permutation(novel)[: max(most - len(edited), 1)]
        cameras = [sample.novel_after.cameras[k] for k in chosen] + [sample.edited.cameras[k] for k in edited]
        shown = tensor(sample.novel_after.colors, self.device)[chosen.tolist()]
        return cameras, torch.cat([shown, tensor(sample.edited.colors, self.device)[edited.tolist()]])
