"""What is shown at once of a layer that is hidden or fades, until that is exact and those above it are painted anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.session.appearance import base_of_parents
from splatpainter.session.delta import Delta
from splatpainter.session.document import Layer
from splatpainter.session.layer_blending import blend_delta
from splatpainter.splats import Splats, changed_rows

Preview = tuple[np.ndarray, Splats]
"""([C] int64 ascending ids of what is shown, C Gaussians)."""


def hidden_layer(below: Splats, with_layer: Splats) -> Preview:
    """A layer without its effect: Gaussians that it changed as below, those that it appended with opacity 0."""
    count = len(below)
    changed = changed_rows(below, with_layer)
    appended = with_layer.take(np.arange(count, len(with_layer)))
    faded = replace(appended, opacities=np.zeros_like(appended.opacities))
    ids = np.concatenate([changed, np.arange(count, len(with_layer))])
    return ids, below.take(changed).append(faded)


def mixed_layer(below: Splats, delta: Delta, layer: Layer) -> Preview:
    """A layer's opacity and blend over the colours of parents."""
    mixed = blend_delta(below, replace(delta, base=base_of_parents(below, delta)), layer.opacity, layer.blend)
    tail = len(below) + np.arange(len(mixed.appended))
    return np.concatenate([mixed.gaussian_ids, tail]), mixed.values.append(mixed.appended)


def where_uncovered(preview: Preview | None, with_layer: Splats, composed: Splats) -> Preview | None:
    """The part of a preview that the layers above leave as it was; None where it has other Gaussians. composed: with
    these layers."""
    if preview is None or (preview[0] >= len(with_layer)).any():
        return None
    ids, splats = preview
    same = np.flatnonzero(~np.isin(ids, changed_rows(with_layer, composed, ids), assume_unique=True))
    return ids[same], splats.take(same)
