"""What reports say about pictures: PSNR, SSIM and LPIPS-Alex over the pixels that matter. Never minimised."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatpainter.metrics import ssim
from splatpainter.metrics.lpips import SMALLEST, Lpips, LpipsUnavailable
from splatpainter.train.loss import Wanted, masked_psnr

SSIM_LEAST = 11
"""Pixels; SSIM's window."""


def alex_or_none(folder: str | Path | None, device: torch.device | str = "cpu") -> Lpips | None:
    """The network of reports, or None where its weights are not there."""
    try:
        return Lpips.load("alex", folder).to(device)
    except LpipsUnavailable:
        return None


@torch.no_grad()
def figures(name: str, rendered: Tensor, wanted: Wanted, alex: Lpips | None) -> dict[str, float]:
    """{name: PSNR in dB, "name SSIM": , "name LPIPS-Alex": } of rendered [C, H, W, 3] over wanted.focus: PSNR over all
    of its pixels together, the others as means of the views that have some. Those that do not apply are left out."""
    value = masked_psnr(rendered, wanted)
    if value is None:
        return {}
    found = {name: value}
    pictures, truth = rendered.clamp(0, 1).float(), wanted.colors.float()
    some = [i for i in range(len(pictures)) if bool(wanted.focus[i].any())]
    if min(pictures.shape[1:3]) >= SSIM_LEAST:
        trios = ((x[i].cpu().numpy() for x in (pictures, truth, wanted.focus)) for i in some)
        found[f"{name} SSIM"] = float(np.mean([ssim(*trio) for trio in trios]))
    if alex is not None and min(pictures.shape[1:3]) >= SMALLEST:
        a, b = (x[some].permute(0, 3, 1, 2) for x in (pictures, truth))
        mask = wanted.focus[some][:, None].float()
        # A small edit may lie between the pixels of the last taps.
        found[f"{name} LPIPS-Alex"] = float(alex(a, b, mask + 1e-6).mean())
    return found
