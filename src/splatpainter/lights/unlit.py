"""Base colours as they would be without the lights that were put on an asset one after the other, so that the next one
knows what light is there: the captured one times what those before it have made of it. N Gaussians, A appended ones."""

from __future__ import annotations

import numpy as np

from splatpainter.color import base_color, linear_to_srgb, sh_from_color, to_light
from splatpainter.splats import ColorSpace, Splats

DARKEST = 1e-6
"""Linear colour below which nothing is known of the light on it."""


def light_gain(sh: np.ndarray, unlit: np.ndarray, space: ColorSpace) -> np.ndarray:
    """[N, 3] float64 how many times the captured light is on each Gaussian, by its base colours (sh: [N, K, 3]) and
    those before other lights were put on it (unlit: [N, 1, 3])."""
    now, before = (to_light(base_color(x).astype(np.float64), space) for x in (sh, unlit))
    return np.where(np.minimum(now, before) > DARKEST, now / np.maximum(before, DARKEST), 1.0)


def unlit_after(
    below: Splats,
    unlit: np.ndarray | None,
    after: Splats,
    parents: np.ndarray | None = None,
    changed: np.ndarray | None = None,
) -> np.ndarray | None:
    """[N + A, 1, 3] SH of base colours without the lights, after an edit that is none: what it painted lies in the
    light that is there. unlit: [N, 1, 3] of the Gaussians below it, None: as they are; parents: [A] of those below that
    each new one was made from, -1: none; None: not known, and they count as lit by the captured light alone; changed:
    [T] those below that may have changed, None: any."""
    if unlit is None:
        return None
    count = len(below)
    parents = np.full(len(after) - count, -1) if parents is None else parents
    source = np.concatenate([np.arange(count), parents])
    colors_unlit = np.concatenate([unlit, np.zeros((len(parents), 1, 3), np.float32)])
    ids = np.arange(count) if changed is None else changed[changed < count]
    ids = ids[(below.sh[ids, 0] != after.sh[ids, 0]).any(1)]
    rows = np.concatenate([ids, np.arange(count, len(after))])
    of = np.maximum(source[rows], 0)
    gain = light_gain(below.sh[of], unlit[of], below.color_space)
    gain[source[rows] < 0] = 1
    colors = to_light(base_color(after.sh[rows]).astype(np.float64), after.color_space) / gain
    display = colors if after.color_space == "linear" else linear_to_srgb(colors)
    colors_unlit[rows, 0] = sh_from_color(display)
    return colors_unlit
