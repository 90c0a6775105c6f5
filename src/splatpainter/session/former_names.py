"""Names that a Session had itself before it had parts. Calls that still mean the same are answered, with a warning."""

from __future__ import annotations

import operator
import warnings
from typing import Any

PRESENT_NAMES: dict[str, str] = {
    "add": "layers.add",
    "add_asset": "scene.add",
    "add_bookmark": "bookmarks.add",
    "aside": "strokes.side_scores",
    "asset": "scene.asset",
    "asset_original": "scene.original_of",
    "asset_splats": "scene.splats_of",
    "assets": "scene.assets",
    "below": "layers.below",
    "blend_preview": "layers.blend_preview",
    "blob": "files.blob",
    "confidence": "layers.confidence",
    "conflicts": "layers.conflicts",
    "coverage": "layers.coverage",
    "cursor": "history.cursor",
    "decal_map": "surface.decal_map",
    "delete": "layers.delete",
    "delete_bookmark": "bookmarks.delete",
    "delete_selection": "selections.delete",
    "duplicate": "layers.duplicate",
    "erase_more": "strokes.erase_more",
    "erases_on": "strokes.erases_on",
    "export": "files.export",
    "export_layer": "files.export_layer",
    "export_view": "files.export_view",
    "exported": "files.exported",
    "facts": "layers.facts",
    "fill": "layers.fill",
    "fill_from": "layers.fill_from",
    "filled_by": "layers.filled_by",
    "first_stroke": "strokes.paint_new",
    "front": "scene.front",
    "has_its_file": "files.is_in_place",
    "has_picture": "files.has_picture",
    "hide": "layers.hide_selected",
    "import_layer": "files.import_layer",
    "jump": "history.jump",
    "laid": "surface.laid",
    "layer": "layers.by_id",
    "left_out": "surface.left_out",
    "mask_area": "masks.set_area",
    "mask_selection": "masks.set_selection",
    "match_seam": "scene.match_seam",
    "merge": "layers.merge",
    "move": "layers.move",
    "new_layer": "layers.new",
    "oriented": "scene.is_oriented",
    "paint": "strokes.paint",
    "paint_mask": "masks.paint",
    "painted": "layers.painted",
    "painted_on": "strokes.painted_on",
    "prepare": "surface.prepare",
    "receipt": "files.receipt",
    "remove_asset": "scene.remove",
    "replace_views": "layers.replace_views",
    "resolve_conflict": "layers.resolve_conflict",
    "save_as": "files.save_as",
    "save_copy": "files.save_copy",
    "save_selection": "selections.save",
    "selected_parts": "selections.by_asset",
    "selection": "selections.load",
    "set": "layers.set",
    "set_asset": "scene.set",
    "set_front": "scene.set_front",
    "set_mask": "masks.set",
    "set_picture": "files.set_picture",
    "set_up": "scene.set_up",
    "settle": "layers.resolve_conflict",
    "shown": "snapshot",
    "surface_blocks": "surface.blocks",
    "up": "scene.up",
}
"""Old name -> where the same stands now. Not here: `copy`, which takes another value, and `bookmarks()`, `selections()`
and `surface`, whose names are parts now."""


def under_former_name(session: object, name: str) -> Any:
    """What an old name of a session stands for. Raises AttributeError for any other name; warns, at the line that
    asked the session for it, with the present spelling."""
    present = PRESENT_NAMES.get(name)
    if present is None:
        raise AttributeError(f"{type(session).__name__!r} object has no attribute {name!r}", name=name, obj=session)
    value = operator.attrgetter(present)(session)
    warnings.warn(f"session.{name} is now session.{present}", DeprecationWarning, stacklevel=3)
    return value
