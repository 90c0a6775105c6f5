"""What of a painter decides the results of layers, as text: it stands in their keys."""

from __future__ import annotations

from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from splatpainter.nn.precision import resolve
from splatpainter.painter import Method, Painter

if TYPE_CHECKING:
    from splatpainter.models.model import SplatPainterModel

RECORDED_NAMES = {
    "goal_px": "goal",
    "min_share": "share",
    "max_halvings": "levels",
    "max_appended": "budget",
    "max_error": "detail",
    "rim_px": "rim",
}
"""Fields of LocalOptions -> their names in projects: results of layers are found by them."""
SHEETS = "sheets-7"
"""What stands in the fingerprints of painters that lay sheets. Layers of painters that knew none are lifted as they
were made: split, without sheets, blended and erased from the colours of parents."""
OLDER_SHEETS = ("sheets-2", "sheets-3", "sheets-4", "sheets-5", "sheets-6")
"""Names of earlier ways to lay sheets: their results are kept; where one is computed anew it is laid as now."""


def fingerprint(painter: Painter, method: Method) -> str:
    """What of a painter decides the results of a method, as text: its settings, the hash of its weights, and bf16 where
    its networks are rounded to that. method: not "auto"."""
    settings = f"{painter.local_options!r} {painter.global_options!r} {SHEETS}"
    for name, recorded in RECORDED_NAMES.items():
        settings = settings.replace(f"{name}=", f"{recorded}=")
    if method != "ttt" or painter.model is None:
        return f"{method} {settings}"
    if painter.model not in _DIGESTS:
        from splatpainter.models.cache import digest

        _DIGESTS[painter.model] = digest(painter.model)
    device = next(painter.model.parameters()).device
    rounded = " bfloat16" if resolve(painter.precision, device) == "bfloat16" else ""
    return f"ttt {settings} polish={painter.polish} {_DIGESTS[painter.model]}{rounded}"


def lays_sheets(painter: str) -> bool:
    """Whether a painter of this fingerprint knows sheets."""
    return not {SHEETS, *OLDER_SHEETS}.isdisjoint(painter.split())


_DIGESTS: WeakKeyDictionary[SplatPainterModel, str] = WeakKeyDictionary()
"""Digests of the models in use, whose weights do not change meanwhile; hashing one takes longer than a small edit."""
