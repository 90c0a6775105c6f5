"""How opacity and blend mode act on rows: exactly defined, pure, and exact at both ends.

A layer wants new values for the rows it touches (a delta). With opacity o = 1 and blend "normal" the delta is taken bit
for bit; with o = 0 the layer does not exist. Otherwise, with b the SH coefficients of a row below and p those wanted,

    sh = b + o (m - b),   m = what the blend mode makes of b and p

and *geometry is the layer's* for every o > 0: means, quaternions and scales are those wanted. An appended row takes
as b the colours of the row that it was split from. So a row that was split stays covered by its children, which start
in its own colour: scaling their opacity instead would tear holes, because the row itself has shrunk. Pictures are
linear in colours, so the picture at o is the linear mix of the one at 0+ and the one at 1; what is not continuous is
only the small difference between a row and its children of the same colour. The opacity of a row whose geometry is
unchanged is mixed like a colour (an eraser fades the rows it hides); of another it is the layer's.

Modes act on the constant band's display colour 0.5 + Y_0 sh_0, and on bands >= 1 by the same linear formula:

    normal      m = p
    color       hue and saturation of p, luminosity of b: m = p + (L(b) - L(p))
    luminosity  the other way round: m = b + (L(p) - L(b))
    darken      per channel the darker one of both base colours, with its bands
    lighten     per channel the lighter one

L(c) = 0.3 r + 0.59 g + 0.11 b, and the base colour is pulled into 0..1 as in "Compositing and Blending Level 1" (W3C,
2015, non-separable blend modes: SetLum, ClipColor).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.session.deltas import Delta
from splatpainter.session.layers import Blend
from splatpainter.splats import SH_C0, Splats


def _luminosity(colors: np.ndarray) -> np.ndarray:
    """[..., 3] -> [...]. Written out: a matrix product may round differently on another machine."""
    r, g, b = np.moveaxis(colors, -1, 0)
    return np.float32(0.3) * r + np.float32(0.59) * g + np.float32(0.11) * b


def mixed(
    below: Splats, delta: Delta, opacity: float, blend: Blend = "normal", strength: np.ndarray | None = None
) -> Delta:
    """What is left of a delta at an opacity of 0..1. strength: [N] 0..1, a factor of the opacity per row (appended rows
    take their parents'); rows and appended rows without any are left out."""
    if opacity == 1 and blend == "normal" and strength is None:
        return delta
    factor = np.ones(len(below), np.float32) if strength is None else strength.astype(np.float32)
    host = np.maximum(delta.parents, 0)
    share = np.float32(opacity) * factor[delta.rows]
    share_new = np.float32(opacity) * np.where(delta.parents >= 0, factor[host], 1)
    stay, come = share > 0, share_new > 0
    rows, parents = delta.rows[stay], delta.parents[come]
    old, new = below.take(rows), delta.values.take(stay)
    moved = np.zeros(len(rows), bool)
    for name in ("means", "quats", "scales"):
        moved |= (getattr(old, name) != getattr(new, name)).any(1)
    faded = old.opacities + share[stay] * (new.opacities - old.opacities)
    exact = moved | (share[stay] == 1)
    opacities = np.where(exact, new.opacities, faded).astype(np.float32)
    values = replace(new, opacities=opacities, sh=mix(old.sh, new.sh, share[stay], blend))
    tail = delta.appended.take(come)
    hosts = np.where((parents >= 0)[:, None, None], below.sh[np.maximum(parents, 0)], tail.sh)
    tail = replace(tail, sh=mix(hosts, tail.sh, share_new[come], blend))
    return Delta(delta.count, rows, values, tail, parents)


def mix(old: np.ndarray, new: np.ndarray, share: np.ndarray, blend: Blend) -> np.ndarray:
    """[M, K, 3] SH between `old` and the blend of both, by `share` [M] of 0..1."""
    aim = blended(old, new, blend)
    part = share[:, None, None]
    return np.where(part == 1, aim, old + part * (aim - old)).astype(np.float32)


def blended(old: np.ndarray, new: np.ndarray, blend: Blend) -> np.ndarray:
    """[M, K, 3] SH of `new` over `old` in full."""
    if blend == "normal":
        return new
    below, above = 0.5 + SH_C0 * old[:, 0], 0.5 + SH_C0 * new[:, 0]
    if blend in ("darken", "lighten"):
        takes = above < below if blend == "darken" else above > below
        return np.where(takes[:, None], new, old)
    hue, light = (new, old) if blend == "color" else (old, new)
    out = hue + _luminosity(light - hue)[..., None]
    colors, lights = (above, below) if blend == "color" else (below, above)
    out[:, 0] = (_with_luminosity(np.clip(colors, 0, 1), _luminosity(np.clip(lights, 0, 1))) - 0.5) / SH_C0
    return out.astype(np.float32)


def _with_luminosity(colors: np.ndarray, luminosity: np.ndarray) -> np.ndarray:
    """SetLum and ClipColor: [M, 3] colours with the luminosity [M], pulled towards grey until they fit 0..1."""
    out = colors + (luminosity - _luminosity(colors))[:, None]
    grey = luminosity[:, None]
    low, high = out.min(1, keepdims=True), out.max(1, keepdims=True)
    shrink = np.where(low < 0, grey / np.maximum(grey - low, 1e-12), 1)
    out = grey + (out - grey) * shrink
    high = np.where(low < 0, out.max(1, keepdims=True), high)
    shrink = np.where(high > 1, (1 - grey) / np.maximum(high - grey, 1e-12), 1)
    return grey + (out - grey) * shrink
