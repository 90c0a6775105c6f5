"""Edited pictures become a new layer: judged, brought to 8 bits, and given a mask that stays what it is. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from splatpainter.io import files
from splatpainter.painter import MAX_VIEWS, Edit
from splatpainter.session import pictures
from splatpainter.session.layers import Kind, Layer, View
from splatpainter.sources.color import to_display
from splatpainter.splats import Splats


def new_layer(
    splats: Splats,
    kind: Kind,
    edits: Sequence[Edit],
    name: str | None,
    parameters: dict[str, Any],
    settings: Mapping[str, Any],
) -> tuple[Layer, dict[str, bytes]]:
    """(a layer without an id, its pictures by hash). splats: the asset that is edited; settings: mode (None: what the
    kind suggests), method, opacity, blend. Raises ValueError: no view or too many, no mask where one is needed, nothing
    edited, unknown settings."""
    if not 0 <= len(edits) <= MAX_VIEWS or kind == "merged":
        raise ValueError(f"layer: expected at most {MAX_VIEWS} views, and layers that exist to be merged with merge")
    mode = settings["mode"] or ("global" if kind == "look" else "local")
    by_name = kind == "look" and "look" in parameters
    if not edits and not by_name:
        raise ValueError(f"layer: expected at least one edited view for kind {kind}, got none")
    pictured = kind != "erase" and not by_name
    blobs: dict[str, bytes] = {}

    def put(data: bytes) -> str:
        blobs[files.sha256(data)] = data
        return files.sha256(data)

    views, small = [], None
    for edit in edits:
        mask = edit.mask
        if mask is None and pictured and mode == "local":
            # Found once: on replay over other layers everything would differ.
            mask = _changed(splats, edit)
        if mask is None and not pictured:
            raise ValueError(f"{edit.name}: expected a mask for a view of kind {kind}")
        picture = put(pictures.encode_picture(edit.image, splats.color_space)) if pictured else None
        views.append(View(edit.camera, picture, None if mask is None else put(pictures.encode_mask(mask))))
        if small is None:
            shown = (
                to_display(edit.image, splats.color_space)
                if pictured
                else np.repeat(np.asarray(mask, np.float32)[..., None], 3, -1)
            )
            small = put(pictures.thumbnail(shown, mask))
    own = {**settings, "mode": mode}
    title = name or str(kind).capitalize()
    return Layer("", title, kind, tuple(views), parameters, **own, thumbnail=small), blobs


def _changed(splats: Splats, edit: Edit) -> np.ndarray:
    from splatpainter.lift.masks import change_mask
    from splatpainter.rendering import render

    mask = change_mask(edit.image, render(splats, edit.camera).colors[0])
    if not mask.any():
        raise ValueError(f"{edit.name}: nothing to do, the picture does not differ from the render")
    return mask
