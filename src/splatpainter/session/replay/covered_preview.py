"""What is shown at once of a layer that is hidden, shown or mixed otherwise, until those above it are painted anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.session.replay.delta import Delta
from splatpainter.splats import Splats, changed_rows

Preview = tuple[np.ndarray, Splats]
"""([C] int64 ascending ids of what is shown, C Gaussians). Ids beyond the Gaussians that there are follow them."""


def hidden_layer(below: Splats, with_layer: Splats) -> Preview:
    """A layer without its effect: Gaussians that it changed as below, those that it appended with opacity 0."""
    count = len(below)
    changed = changed_rows(below, with_layer)
    appended = with_layer.take(np.arange(count, len(with_layer)))
    faded = replace(appended, opacities=np.zeros_like(appended.opacities))
    ids = np.concatenate([changed, np.arange(count, len(with_layer))])
    return ids, below.take(changed).append(faded)


def changed_layer(below: Splats, delta: Delta) -> Preview:
    """A layer as its delta leaves it."""
    tail = len(below) + np.arange(len(delta.appended))
    return np.concatenate([delta.gaussian_ids, tail]), delta.values.append(delta.appended)


def revealed_layer(below: Splats, delta: Delta, composed: Splats) -> Preview:
    """A layer that was hidden, where those above leave what is below: Gaussians that it changes, and behind all others
    those that it makes of such ones. composed: without the layer."""
    # What layers above have changed hides it: only where they did nothing is it sure what will be seen.
    free = np.ones(len(below), bool)
    free[changed_rows(below, composed)] = False
    changed = free[delta.gaussian_ids]
    tail = (delta.parent_ids >= 0) & free[np.maximum(delta.parent_ids, 0)]
    ids = np.concatenate([delta.gaussian_ids[changed], len(composed) + np.arange(int(tail.sum()))])
    return ids, delta.values.take(changed).append(delta.appended.take(tail))


def where_uncovered(preview: Preview | None, with_layer: Splats, composed: Splats) -> Preview | None:
    """The part of a preview that the layers above leave as it was; None where it has other Gaussians. composed: with
    these layers."""
    if preview is None or (preview[0] >= len(with_layer)).any():
        return None
    ids, splats = preview
    # A Gaussian that a layer above wrote is that layer's, whatever this one would make of it.
    same = np.flatnonzero(~np.isin(ids, changed_rows(with_layer, composed, ids), assume_unique=True))
    return ids[same], splats.take(same)
