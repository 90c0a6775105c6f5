"""Edits as changes of colour of surfels: a layer over one view is projected onto those that the view shows.

Positions, sizes and opacities stay, so every view of the edited surfels is a true picture of the edit. An edit is a
colour and a coverage of each (`PaintCoverage`); surfels with coverage 0 keep their bits. Torch, on one device.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from splatpainter.cameras import Camera
from splatpainter.color import base_color, linear_to_srgb, luminance, sh_from_color, srgb_to_linear
from splatpainter.grading.color_grading import ColorGrade, apply_grade
from splattrain.data.edits import EditDesign
from splattrain.data.edits.content import PaintCoverage
from splattrain.data.surfels import Surfels

DEPTH_TOLERANCE = 0.01
"""A surfel is the first that a view meets if it lies at most this part of its depth behind the rendered depth."""
MIN_PAINT_COSINE, FULL_PAINT_COSINE = 0.08, 0.3
"""Cosine between normal and line of sight: no paint below the first, all of it from the second on."""
MIN_COVERAGE = 1 / 64
"""Least coverage that counts."""
MIN_LIT_ALBEDO = 0.04
"""Luminance below which the light on a surface cannot be told from its colour."""


def paint_coverage(
    design: EditDesign,
    surfels: Surfels,
    sh: Tensor,
    depth: Tensor,
    alpha: Tensor,
    *,
    unpainted_sh: Tensor | None = None,
    two_sided: bool = False,
) -> PaintCoverage:
    """What the view of an edit shows of it on surfels whose colours are `sh` [N, K, 3].

    depth, alpha: [H, W] of their render from the design's camera. unpainted_sh: [N, K, 3] colours that say how much
    light falls on a layer; None: it shows as it was painted. two_sided: the sign of the normals means nothing."""
    if isinstance(design.content, np.ndarray):
        layer = torch.from_numpy(np.ascontiguousarray(design.content, np.float32)).to(sh.device)
        colors, coverage = project_layer(layer, design.camera, surfels.means)
        if unpainted_sh is not None:
            colors = shade_paint(colors, unpainted_sh, surfels.albedo)
    else:
        painted = design.content.paint(surfels.means, display_colors(sh))
        colors, coverage = painted.colors, painted.coverage
    covered = (coverage >= MIN_COVERAGE).nonzero()[:, 0]
    normals = None if two_sided else surfels.normals[covered]
    visibility = view_visibility(surfels.means[covered], normals, design.camera, depth, alpha)
    visible = torch.zeros_like(coverage)
    visible[covered] = coverage[covered] * visibility
    return PaintCoverage(colors, visible)


def view_visibility(means: Tensor, normals: Tensor | None, camera: Camera, depth: Tensor, alpha: Tensor) -> Tensor:
    """[N] 0..1: how openly a view shows each surfel. 0 outside the picture, behind the surface or turned away.

    means, normals: [N, 3] world (None: all count as facing the view); depth, alpha: [H, W] of the render of
    these surfels from `camera`. Rendered depth is the mean over what a pixel shows; at a silhouette it lies between the
    surfaces, and a neighbour's is the front one's: the nearest of 3 x 3 pixels decides, with room for the slope that a
    surface may have between them."""
    pixels, z = camera.project(means)
    x, y = pixels.unbind(-1)
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
    slack = DEPTH_TOLERANCE * z + pixel / cosine.clamp(MIN_PAINT_COSINE, 1)
    unhidden = inside & (z <= front[row, column] + slack)
    facing = ((cosine - MIN_PAINT_COSINE) / (FULL_PAINT_COSINE - MIN_PAINT_COSINE)).clamp(0, 1)
    return unhidden * facing * facing * (3 - 2 * facing)


def project_layer(layer: Tensor, camera: Camera, means: Tensor) -> tuple[Tensor, Tensor]:
    """(colours [N, 3], coverage [N]) of a layer [H, W, 4] over a view at the projections of `means` [N, 3], bilinear;
    coverage 0 outside the picture. Whether the view shows them is for `view_visibility` to say."""
    pixels, z = camera.project(means)
    grid = torch.stack([2 * pixels[..., 0] / camera.width - 1, 2 * pixels[..., 1] / camera.height - 1], -1)
    grid = torch.where(z[:, None] > 1e-6, grid, 2.0).nan_to_num(2.0).clamp(-2, 2)
    packed = torch.cat([layer[..., :3] * layer[..., 3:], layer[..., 3:]], -1)  # mixing needs colour times coverage
    values = F.grid_sample(packed.permute(2, 0, 1)[None], grid[None, None].to(layer.dtype), align_corners=False)
    colors, coverage = values[0, :, 0].T[:, :3], values[0, 3, 0]
    return (colors / coverage[:, None].clamp(min=1e-6)).clamp(0, 1), coverage


def apply_paint(sh: Tensor, paint: PaintCoverage) -> Tensor:
    """[N, K, 3] SH under opaque paint, flat in every direction where it covers. What is not covered keeps its bits;
    `sh` itself does not change."""
    coverage = paint.coverage[:, None, None]
    flat = torch.zeros_like(sh)
    flat[:, 0] = sh_from_color(paint.colors)
    return torch.where(coverage >= MIN_COVERAGE, sh + coverage * (flat - sh), sh)


def shade_paint(colors: Tensor, sh: Tensor, albedo: Tensor) -> Tensor:
    """[N, 3] display colours of paint (display colours [N, 3]) under the light that falls on surfels: the ratio of
    the luminances of their colour (SH band 0) and their albedo [N, 3] (linear)."""
    reflected = luminance(srgb_to_linear(display_colors(sh)))
    light = (reflected / luminance(albedo).clamp(min=MIN_LIT_ALBEDO)).clamp(0.02, 2.5)
    return linear_to_srgb((srgb_to_linear(colors) * light[:, None]).clamp(0, 1))


def display_colors(sh: Tensor) -> Tensor:
    """[N, 3] display colour 0..1 without its view dependence."""
    return base_color(sh).clamp(0, 1)


def grade_sh(sh: Tensor, look: ColorGrade) -> Tensor:
    """[N, K, 3] SH after a look: band 0 takes the look of the base colour; higher bands are carried through its
    derivative there (a central difference along each coefficient), so that small lobes stay true."""
    colors = base_color(sh)
    out = torch.empty_like(sh)
    out[:, 0] = sh_from_color(apply_grade(colors, look))
    if sh.shape[1] > 1:
        step = 0.02
        bands = sh[:, 1:]
        size = bands.abs().amax(-1, keepdim=True).clamp(min=1e-6)
        along = step * bands / size
        middle = colors.clamp(2 * step, 1 - 2 * step)[:, None]
        change = apply_grade(middle + along, look) - apply_grade(middle - along, look)
        out[:, 1:] = change * (size / (2 * step))
    return out
