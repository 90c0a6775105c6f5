"""How close two pictures are: PSNR, SSIM and LPIPS, each also inside a mask. Knows no splats and no renderer."""

from __future__ import annotations

from splatpainter.metrics.images import psnr as psnr
from splatpainter.metrics.images import ssim as ssim
from splatpainter.metrics.images import ssim_map as ssim_map
from splatpainter.metrics.lpips import Lpips as Lpips
from splatpainter.metrics.lpips import LpipsUnavailable as LpipsUnavailable
from splatpainter.metrics.lpips import lpips as lpips
