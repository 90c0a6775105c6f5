"""What layers do to Gaussians without a painter: opacity and blend modes, named adjustments. Pure.

*Opacity and blend* are exactly defined, and exact at both ends. A layer gives new values to some Gaussians (a delta).
With opacity o = 1 and blend "normal" the delta is taken bit for bit; with o = 0 the layer does not exist. Otherwise,
with b the SH coefficients of a Gaussian below and p the new ones,

    sh = b + o (m - b),   m = what the blend mode makes of b and p

and *geometry is the layer's* for every o > 0: means, quaternions and scales are the new ones, and what it emptied is
empty. Gaussians that moved (one of a sheet may have taken the index of any) or were appended take as b the colours with
which they look, from the layer's views, as the Gaussians below did (appearance.with_base); where
nothing moved, those of the same index and of the one that each was split from. So a Gaussian that was split stays
covered by its children, which start in its colour: scaling their opacity instead would tear holes, because it has
shrunk itself. Pictures are linear in colours, so the picture at o is the linear mix of the one at 0+ and the one at 1;
what is not continuous is only the small difference between a Gaussian and its children of the same colour. The opacity
of one whose geometry is unchanged is mixed like a colour (an eraser fades what it hides); of another it is the layer's.

Modes act on the constant band's display colour 0.5 + Y_0 sh_0, and on bands >= 1 by the same linear formula:

    normal      m = p
    color       hue and saturation of p, luminosity of b: m = p + (L(b) - L(p))
    luminosity  the other way round: m = b + (L(p) - L(b))
    darken      per channel the darker one of both base colours, with its bands
    lighten     per channel the lighter one

L(c) = 0.3 r + 0.59 g + 0.11 b, and the base colour is pulled into 0..1 as in "Compositing and Blending Level 1" (W3C,
2015, non-separable blend modes: SetLum, ClipColor).

*Adjustments* (layers of kind "look") are pure functions of each Gaussian's colour, which know no views and no
neighbours: `f(sh [N, K, 3], parameters) -> sh [N, K, 3]`. A session takes a table of them by name, and the layer's
parameters say which ({"look": name, ...}). They are cheap, so their results are not stored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from splatpainter.color import base_color, sh_from_color
from splatpainter.grading.color_grading import GRADE, grade_sh
from splatpainter.grading.color_transfer import TRANSFERS, transfer_sh
from splatpainter.scene.seam import LIGHT, light_sh
from splatpainter.session.document.layer_view import Blend
from splatpainter.session.replay.delta import Delta, no_delta
from splatpainter.splats import ATTRIBUTES, MAX_MAGNITUDE, SH_C0, Splats
from splatpainter.system.jsonio import brief

AdjustmentFunction = Callable[[np.ndarray, Mapping[str, Any]], np.ndarray]


def blend_delta(
    below: Splats,
    delta: Delta,
    opacity: float,
    blend: Blend = "normal",
    strength: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    mixing: Callable[[np.ndarray, np.ndarray, np.ndarray, Blend], np.ndarray] | None = None,
) -> Delta:
    """What is left of a delta at an opacity of 0..1. strength: [N] 0..1, a factor of the opacity per Gaussian
    (appended ones take their parents'); those without any are left out. mask: [T + A] 0..1, another factor, of the
    changed and the appended Gaussians themselves: where it is 0 their geometry stays and looks as what is below.
    mixing: of colours, as `mix_sh`, which is the default."""
    if opacity == 1 and blend == "normal" and strength is None and mask is None:
        return delta
    if mask is not None and not mask.any():
        return no_delta(below)
    # Each Gaussian has its own share: the layer's opacity, what a policy leaves of it, what its mask shows.
    delta = delta.complete(below)
    factor = np.ones(len(below), np.float32) if strength is None else strength.astype(np.float32)
    parent_factor = np.where(delta.parent_ids >= 0, factor[np.maximum(delta.parent_ids, 0)], 1)
    share, tail_share = np.float32(opacity) * factor[delta.gaussian_ids], np.float32(opacity) * parent_factor
    some, some_tail = share > 0, tail_share > 0
    if mask is not None:
        share, tail_share = share * mask[: len(share)], tail_share * mask[len(share) :]
    gaussian_ids, parent_ids = delta.gaussian_ids[some], delta.parent_ids[some_tail]
    old, new = below.take(gaussian_ids), delta.values.take(some)
    # Geometry is the layer's wherever it shows at all; opacity is mixed only where nothing moved.
    moved = np.zeros(len(gaussian_ids), bool)
    for name in ("means", "quats", "scales"):
        moved |= (getattr(old, name) != getattr(new, name)).any(1)
    with np.errstate(over="ignore", invalid="ignore"):  # of Gaussians that cannot be drawn
        faded = old.opacities + share[some] * (new.opacities - old.opacities)
    if delta.base is not None:
        moved |= new.opacities == 0
    exact = moved | (share[some] == 1)
    opacities = np.where(exact, new.opacities, faded).astype(np.float32)
    count = len(delta.gaussian_ids)
    old_sh = old.sh if delta.base is None else delta.base[:count][some]
    mixing = mixing or mix_sh
    values = replace(new, opacities=opacities, sh=mixing(old_sh, new.sh, share[some], blend))
    # New Gaussians start from the look of what they were made from: at a small share they are hardly seen.
    tail = delta.appended.take(some_tail)
    if delta.base is not None:
        parent_sh = delta.base[count:][some_tail]
    else:
        parent_sh = np.where((parent_ids >= 0)[:, None, None], below.sh[np.maximum(parent_ids, 0)], tail.sh)
    tail = replace(tail, sh=mixing(parent_sh, tail.sh, tail_share[some_tail], blend))
    return Delta(delta.count, gaussian_ids, values, tail, parent_ids)


@np.errstate(over="ignore", invalid="ignore")  # of Gaussians that cannot be drawn
def mix_sh(old: np.ndarray, new: np.ndarray, share: np.ndarray, blend: Blend) -> np.ndarray:
    """[M, K, 3] SH between `old` and the blend of both, by `share` [M] of 0..1."""
    full = blend_sh(old, new, blend)
    part = share[:, None, None]
    return np.where(part == 1, full, old + part * (full - old)).astype(np.float32)


@np.errstate(over="ignore", invalid="ignore")  # of Gaussians that cannot be drawn
def blend_sh(old: np.ndarray, new: np.ndarray, blend: Blend) -> np.ndarray:
    """[M, K, 3] SH of `new` over `old` in full."""
    if blend == "normal":
        return new
    below, above = base_color(old), base_color(new)
    if blend in ("darken", "lighten"):
        replaced = above < below if blend == "darken" else above > below
        return np.where(replaced[:, None], new, old)
    # Bands above the first follow the linear formula alone: only base colours can be clipped to what is shown.
    hue, light = (new, old) if blend == "color" else (old, new)
    out = hue + _luminosity(light - hue)[..., None]
    colors, lights = (above, below) if blend == "color" else (below, above)
    out[:, 0] = sh_from_color(_with_luminosity(np.clip(colors, 0, 1), _luminosity(np.clip(lights, 0, 1))))
    return out.astype(np.float32)


def _luminosity(colors: np.ndarray) -> np.ndarray:
    """[..., 3] -> [...]. Written out: a matrix product may round differently on another machine."""
    r, g, b = np.moveaxis(colors, -1, 0)
    return np.float32(0.3) * r + np.float32(0.59) * g + np.float32(0.11) * b


def _with_luminosity(colors: np.ndarray, luminosity: np.ndarray) -> np.ndarray:
    """SetLum and ClipColor: [M, 3] colours with the luminosity [M], pulled towards grey until they fit 0..1."""
    out = colors + (luminosity - _luminosity(colors))[:, None]
    grey = luminosity[:, None]
    low, high = out.min(1, keepdims=True), out.max(1, keepdims=True)
    # First from below, then from above, as the standard has it.
    shrink = np.where(low < 0, grey / np.maximum(grey - low, 1e-12), 1)
    out = grey + (out - grey) * shrink
    high = np.where(low < 0, out.max(1, keepdims=True), high)
    shrink = np.where(high > 1, (1 - grey) / np.maximum(high - grey, 1e-12), 1)
    return grey + (out - grey) * shrink


def within(mask: np.ndarray, below: Splats, above: Splats) -> Splats:
    """`above` for some Gaussians ([N] bool), `below` for the rest; attributes in which nothing differs are shared."""
    values = {}
    for name in ATTRIBUTES:
        old, new = getattr(below, name), getattr(above, name)
        values[name] = old if old is new else np.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)
    return replace(above, **values)


def mixed(weights: np.ndarray, below: Splats, above: Splats) -> Splats:
    """Between `below` (weight 0, bit for bit) and `above` (1), [N] float32; attributes in which nothing differs are
    shared, and places are those of the nearer one. Gaussians that `above` appended stay as they are."""
    values, appended = {}, len(above) - len(below)
    weights = np.pad(weights, (0, appended), constant_values=1)
    for name in ATTRIBUTES:
        old, new = getattr(below, name), getattr(above, name)
        old = np.concatenate([old, new[len(old) :]]) if appended else old
        share = weights.reshape(-1, *[1] * (old.ndim - 1))
        # Halfway between two places nothing was ever seen, so geometry is one or the other.
        if name in ("means", "quats", "scales"):
            values[name] = old if old is new else np.where(share >= 0.5, new, old)
        elif old is not new:
            part = np.where(share == 1, new, old + share * (new - old))
            values[name] = np.where(share == 0, old, part).astype(np.float32)
    return replace(above, **values)


def gain(sh: np.ndarray, parameters: Mapping[str, Any]) -> np.ndarray:
    """colour -> gain * colour + offset, exact for every direction. parameters: gain and offset, three numbers each
    (default: ones, zeros)."""
    factor, offset = (_three(parameters, name, value) for name, value in (("gain", 1.0), ("offset", 0.0)))
    out = sh * factor
    out[:, 0] += (0.5 * factor + offset - 0.5) / np.float32(SH_C0)
    return out.astype(np.float32)


ADJUSTMENTS: dict[str, AdjustmentFunction] = {
    "gain": gain,
    GRADE: grade_sh,
    LIGHT: light_sh,
    **dict.fromkeys(TRANSFERS, transfer_sh),
}
"""Adjustments that every session has."""


def adjust_sh(
    sh: np.ndarray, parameters: Mapping[str, Any], adjustments: Mapping[str, AdjustmentFunction]
) -> np.ndarray:
    """[N, K, 3] float32 after the function that a layer's parameters name. A coefficient that it would take so far that
    its Gaussian could not be drawn any more (MAX_MAGNITUDE) stops before, and one that it makes NaN becomes 0; those
    that were beyond already are taken as they come. Raises ValueError for a function that this session does not have,
    parameters whose powers overflow, and where it gives another shape."""
    # The name comes out of a file, so it is looked up in this session's table and nowhere else.
    name = parameters.get("look")
    if not isinstance(name, str) or name not in adjustments:
        listed = ", ".join(sorted(adjustments))
        raise ValueError(f"look: expected parameters with a look of {listed}, got {brief(name)}")
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            out = np.asarray(adjustments[name](sh, parameters), np.float32)
        except OverflowError as error:  # of Python's own floats
            raise ValueError(f"look: expected smaller parameters ({error})") from None
        if out.shape != sh.shape:
            raise ValueError(f"look: expected SH of shape {list(sh.shape)} back, got {list(out.shape)}")
        limit = MAX_MAGNITUDE / 100  # no sum over 25 coefficients of three channels exceeds MAX_MAGNITUDE
        if out.size and not (-limit <= out.min() and out.max() <= limit):
            # Only what this function took out of bounds is held: an asset's own odd values are not its business.
            leaving = ~(np.abs(out) <= limit) & (np.abs(sh) <= limit)
            out = np.where(leaving, np.nan_to_num(np.clip(out, -limit, limit)), out).astype(np.float32)
    return out


def _three(parameters: Mapping[str, Any], name: str, default: float) -> np.ndarray:
    try:
        values = np.asarray(parameters.get(name, [default] * 3), np.float32)
    except (TypeError, ValueError, OverflowError):
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"look: expected three float32 numbers as {name}, got {brief(parameters.get(name))}")
    return values
