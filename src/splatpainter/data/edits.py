"""Edits as changes of colour on a dense asset: a layer over one view is carried to the rows that the view shows.

The rows' places, sizes and opacities stay, so every view of the edited rows is a true picture of the edit. An edit is
a colour and a coverage per row (`Coat`); rows with coverage 0 keep their bits. Torch, one device, no host transfers.
Knows no cameras' choice and no randomness: kinds.py decides what is painted, samples.py from where.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from splatpainter.cameras import Camera
from splatpainter.sources.looks import Look, apply_look, luminance, to_display, to_linear
from splatpainter.splats import SH_C0

NEAR = 0.01
"""A row is the first that a view meets if it lies at most this part of its depth behind the rendered depth."""
GRAZING, FACING = 0.08, 0.3
"""Cosines between normal and line of sight: no paint below the first, all of it from the second on."""
LEAST = 1 / 64
"""Coverage below this is none."""
DARKEST = 0.04
"""Albedo below which the light on a surface cannot be told from its colour."""


@dataclass(frozen=True)
class Coat:
    """What an edit puts on N rows."""

    colors: Tensor
    """[N, 3] display colour 0..1."""
    coverage: Tensor
    """[N] 0..1; rows at 0 do not change."""


def seen(means: Tensor, normals: Tensor | None, camera: Camera, depth: Tensor, alpha: Tensor) -> Tensor:
    """[N] 0..1: how openly a view shows each row. 0 for rows outside the picture, behind the surface or turned away.

    means, normals: [N, 3] world (None: every row counts as facing the view); depth, alpha: [H, W] of the render of
    these rows from `camera`. Rendered depth is the mean over what a pixel shows; at a silhouette it lies between the
    surfaces, and a neighbour's is the front one's: the least of 3 x 3 pixels decides, with room for the slope that a
    surface may have between them."""
    x, y, z = _project(means, camera)
    inside = (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height) & (z > 1e-6)
    solid = torch.where(alpha > 0.5, depth, torch.inf)
    front = -F.max_pool2d(-solid[None, None], 3, 1, 1)[0, 0]
    column = x.nan_to_num(0).clamp(0, camera.width - 1).long()
    row = y.nan_to_num(0).clamp(0, camera.height - 1).long()
    origin = torch.as_tensor(camera.position, dtype=means.dtype, device=means.device)
    if normals is None:
        cosine = torch.full_like(z, 0.4)
    else:
        cosine = (normals * F.normalize(origin - means, dim=-1)).sum(-1)
    pixel = 2 * z / min(camera.fx, camera.fy)  # two pixels' width at that depth
    slack = NEAR * z + pixel / cosine.clamp(GRAZING, 1)
    open_ = inside & (z <= front[row, column] + slack)
    facing = ((cosine - GRAZING) / (FACING - GRAZING)).clamp(0, 1)
    return open_ * facing * facing * (3 - 2 * facing)


def carried(layer: Tensor, camera: Camera, means: Tensor) -> tuple[Tensor, Tensor]:
    """(colours [N, 3], coverage [N]) of a layer [H, W, 4] over a view at the rows' projections, bilinear; coverage 0
    outside the picture. Whether the view shows a row is for `seen` to say."""
    x, y, z = _project(means, camera)
    grid = torch.stack([2 * x / camera.width - 1, 2 * y / camera.height - 1], -1)
    grid = torch.where(z[:, None] > 1e-6, grid, 2.0).nan_to_num(2.0).clamp(-2, 2)
    packed = torch.cat([layer[..., :3] * layer[..., 3:], layer[..., 3:]], -1)  # mixing wants colour times coverage
    values = F.grid_sample(packed.permute(2, 0, 1)[None], grid[None, None].to(layer.dtype), align_corners=False)
    colors, coverage = values[0, :, 0].T[:, :3], values[0, 3, 0]
    return (colors / coverage[:, None].clamp(min=1e-6)).clamp(0, 1), coverage


def painted(sh: Tensor, coat: Coat) -> Tensor:
    """[N, K, 3] SH after a coat of opaque paint, flat in every direction where it covers. Uncovered rows keep their
    bits; `sh` itself does not change."""
    share = coat.coverage[:, None, None]
    paint = torch.zeros_like(sh)
    paint[:, 0] = (coat.colors - 0.5) / SH_C0
    return torch.where(share >= LEAST, sh + share * (paint - sh), sh)


def lit(colors: Tensor, sh: Tensor, albedo: Tensor) -> Tensor:
    """[N, 3] display colours of paint (display colours [N, 3]) under the light that the rows are under: the light is
    the ratio of luminances of a row's own colour (SH band 0) and its albedo [N, 3] (linear)."""
    own = luminance(to_linear(base_colors(sh)))
    light = (own / luminance(albedo).clamp(min=DARKEST)).clamp(0.02, 2.5)
    return to_display((to_linear(colors) * light[:, None]).clamp(0, 1))


def base_colors(sh: Tensor) -> Tensor:
    """[N, 3] display colour 0..1 of rows without their view dependence."""
    return (0.5 + SH_C0 * sh[:, 0]).clamp(0, 1)


def regraded(sh: Tensor, look: Look) -> Tensor:
    """[N, K, 3] SH after a look: band 0 takes the look of the row's colour; higher bands are carried through its
    derivative there (a central difference along each coefficient), so that small lobes stay true."""
    colors = 0.5 + SH_C0 * sh[:, 0]
    out = torch.empty_like(sh)
    out[:, 0] = (apply_look(colors, look) - 0.5) / SH_C0
    if sh.shape[1] > 1:
        step = 0.02
        bands = sh[:, 1:]
        size = bands.abs().amax(-1, keepdim=True).clamp(min=1e-6)
        along = step * bands / size
        middle = colors.clamp(2 * step, 1 - 2 * step)[:, None]
        change = apply_look(middle + along, look) - apply_look(middle - along, look)
        out[:, 1:] = change * (size / (2 * step))
    return out


def change_masks(before: Tensor, after: Tensor, least: float = 0.02, grow: int = 1, close: int = 0) -> Tensor:
    """[V, H, W] bool: pixels whose colours [V, H, W, 3] differ by more than `least` in a channel, and those within
    `grow` pixels. Lone pixels do not count: of the nine around a core pixel three must differ. close: gaps up to about
    twice as wide, in pixels, are closed first (an edit like grain or sharpening leaves some pixels as they were)."""
    red, green, blue = (after - before).abs().unbind(-1)
    core = (torch.maximum(torch.maximum(red, green), blue) > least).to(before.dtype)[:, None]
    kept = core * (F.avg_pool2d(core, 3, 1, 1) > 2.5 / 9)
    if close:
        kept = 1 - F.max_pool2d(1 - F.max_pool2d(kept, 2 * close + 1, 1, close), 2 * close + 1, 1, close)
    return F.max_pool2d(kept, 2 * grow + 1, 1, grow)[:, 0] > 0.5


def _project(means: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """(x, y, z) [N]: pixels and depth."""
    matrix = torch.as_tensor(camera.world_to_camera, dtype=means.dtype, device=means.device)
    local = means @ matrix[:3, :3].T + matrix[:3, 3]
    z = local[:, 2]
    return camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy, z
