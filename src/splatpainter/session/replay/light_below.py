"""Layers of light over one another: light adds as light, whatever the order, and whatever lies between.

A light layer is lit by the ratio of light now and before. Where other light layers lie below, the light before is the
captured one times what these have made of it, so that what they give stays and is not taken for the asset's own. For
that each state keeps its base colours as they would be without light layers (lights/unlit.py): two lamps that are added
then give the sum of what each gives alone, and a sky over a sky gives what it gives alone. Opacity and masks mix linear
light, as a dimmer does. Pure. N Gaussians, K SH coefficients.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.color import base_color, display_slope, linear_to_srgb, sh_from_color, to_light
from splatpainter.session.document.layer_view import Blend
from splatpainter.session.replay.delta import Delta
from splatpainter.session.replay.layer_blending import mix_sh
from splatpainter.splats import ColorSpace


def recolored(delta: Delta, sh: np.ndarray) -> Delta:
    """A delta of N Gaussians with other colours, [N + A, 1, 3] SH of the Gaussians after it."""
    values, appended = sh[delta.gaussian_ids], sh[delta.count :]
    return replace(
        delta, values=replace(delta.values, sh=values), appended=replace(delta.appended, sh=appended), base=None
    )


@np.errstate(over="ignore", invalid="ignore")  # of Gaussians that cannot be drawn
def mix_light(old: np.ndarray, new: np.ndarray, share: np.ndarray, blend: Blend, space: ColorSpace) -> np.ndarray:
    """[M, K, 3] SH between `old` and `new` by `share` [M] of 0..1, in linear light; other blends as `mix_sh`."""
    if blend != "normal":
        return mix_sh(old, new, share, blend)
    part = share.astype(np.float64)[:, None]
    before, after = (to_light(base_color(x).astype(np.float64), space) for x in (old, new))
    light = before + part * (after - before)
    display = light if space == "linear" else linear_to_srgb(light)
    out = np.empty(new.shape, np.float64)
    out[:, 0] = sh_from_color(display)
    # Bands are in display colours; as light they are these over the curve's slope.
    slope_before, slope_after, slope = (display_slope(level, space)[:, None] for level in (before, after, light))
    bands = (1 - part[..., None]) * (old[:, 1:] / slope_before) + part[..., None] * (new[:, 1:] / slope_after)
    out[:, 1:] = slope * bands
    part = part[..., None]
    steady = (old == new).all((1, 2), keepdims=True)
    return np.where((part == 1) | steady, new, np.where(part == 0, old, out)).astype(np.float32)
