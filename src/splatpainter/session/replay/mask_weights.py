"""The weights of layers' masks on what the layers made, cached part after part: painting on goes on from there."""

from __future__ import annotations

import json

import numpy as np

from splatpainter.session.document.document import Layer, digest
from splatpainter.session.document.layer_factory import decode_mask_part
from splatpainter.session.document.layer_mask import LayerMask, changed_weights
from splatpainter.session.replay.conflicts import coverage
from splatpainter.session.replay.delta import Delta
from splatpainter.session.replay.layer_state import LayerState, ResultStore
from splatpainter.session.selection.selection import Selection
from splatpainter.splats import Splats
from splatpainter.system.recent import Recent

MAX_CACHED = 16
"""Weights of all Gaussians, after some part of some mask."""


class MaskWeights:
    """Weights of the masks of one session, cached."""

    def __init__(self, store: ResultStore, original: Splats) -> None:
        self._store, self._original = store, original
        self._cache = Recent[np.ndarray](MAX_CACHED)

    def weights(self, below: LayerState, delta: Delta, layer: Layer, result_key: str) -> np.ndarray | None:
        """[T + A] float32 of what a layer changed and appended; None: it has no mask, or one that is off. result_key:
        names the state below and the delta. Raises ValueError where a picture is damaged."""
        mask = layer.mask
        if mask is None or not mask.enabled:
            return None
        # A key for every part: a further dab starts from the weights before it.
        keys = _keys(mask, result_key)
        # Found in the step that asks, for another thread may drop them in between.
        cached = ((k, self._cache.find(keys[k])) for k in range(len(keys) - 1, -1, -1))
        start, weights = next((entry for entry in cached if entry[1] is not None), (0, None))
        # Masks are evaluated on what the layer made, which may be finer than what it lies on.
        splats = delta.apply(below.splats)
        if weights is None:
            weights = self._cache.put(keys[0], np.full(len(splats), 1.0 if mask.shows else 0.0, np.float32))
        for k in range(start, len(mask.parts)):
            part = mask.parts[k]
            picture = None
            if part.picture is not None and part.camera is not None:
                picture = decode_mask_part(self._store.blob(part.picture), part.camera, layer.title)
            if part.selection is not None:
                selection = Selection.from_png(self._store.blob(part.selection), len(self._original), layer.title)
                weights = self._cache.put(keys[k + 1], weights * selection.on(splats, self._original))
                continue
            seen = coverage(below.edited, len(splats)) if part.rule == "coverage" else np.zeros(0, np.uint8)
            weights = changed_weights(weights, splats, part, picture, seen)
            self._cache.put(keys[k + 1], weights)
        # Weights are of all Gaussians, as rules compare heights over all of them; a layer mixes only its own.
        return np.concatenate([weights[delta.gaussian_ids], weights[delta.count :]])

    def cached(self, delta: Delta, layer: Layer, result_key: str) -> np.ndarray | None:
        """`weights` where they were asked for lately; None else."""
        assert layer.mask is not None
        weights = self._cache.find(_keys(layer.mask, result_key)[-1])
        return None if weights is None else np.concatenate([weights[delta.gaussian_ids], weights[delta.count :]])


def _keys(mask: LayerMask, result_key: str) -> list[str]:
    """Names of the weights before the first part, after it, after the second, and so on."""
    keys = [digest(f"{result_key} {mask.shows}")]
    for part in mask.parts:
        keys.append(digest(f"{keys[-1]} {json.dumps(part.record(), sort_keys=True)}"))
    return keys
