"""What can be done to a document: pure functions from document to document, for the session to commit and to undo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

from splatpainter.session.layers import Document, Layer, Policy


def added(document: Document, layer: Layer, place: int | None = None) -> tuple[Document, Layer]:
    """With a new layer at `place` (0 the lowest; None: on top). The layer and those inside it get ids of their own."""
    new, following = _numbered(layer, document.next_id)
    layers = list(document.layers)
    at = len(layers) if place is None else _place(place, len(layers) + 1)
    layers.insert(at, new)
    return replace(document, layers=tuple(layers), next_id=following), new


def changed(document: Document, layer: str, **fields: Any) -> Document:
    """With other values of a layer's fields (Layer's names)."""
    at = document.index(layer)
    layers = list(document.layers)
    layers[at] = replace(layers[at], **fields)
    return replace(document, layers=tuple(layers))


def moved(document: Document, layer: str, place: int) -> Document:
    """With a layer at another place, 0 the lowest."""
    layers = list(document.layers)
    layers.insert(_place(place, len(layers)), layers.pop(document.index(layer)))
    return replace(document, layers=tuple(layers))


def deleted(document: Document, layer: str) -> Document:
    layers = list(document.layers)
    layers.pop(document.index(layer))
    return _pruned(replace(document, layers=tuple(layers)))


def duplicated(document: Document, layer: str) -> tuple[Document, Layer]:
    """With a copy of a layer right above it."""
    at = document.index(layer)
    own = document.layers[at]
    return added(document, replace(own, name=f"{own.name} copy"), at + 1)


def merged(document: Document, layers: Sequence[str], name: str | None = None) -> tuple[Document, Layer]:
    """With neighbouring layers as one, which shows what they showed. They stay inside it, with their ids, opacities and
    pictures, so it is still replayed when something below changes. Raises ValueError: fewer than two, gaps between."""
    places = sorted({document.index(layer) for layer in layers})
    if len(places) < 2 or places != list(range(places[0], places[-1] + 1)):
        raise ValueError("merge: expected two or more layers that lie next to each other; move them together first")
    inner = document.layers[places[0] : places[-1] + 1]
    one = Layer(str(document.next_id), name or inner[-1].name, "merged", layers=inner, thumbnail=inner[-1].thumbnail)
    all_ = (*document.layers[: places[0]], one, *document.layers[places[-1] + 1 :])
    return replace(document, layers=all_, next_id=document.next_id + 1), one


def settled(document: Document, lower: str, upper: str, policy: Policy) -> Document:
    """With another winner where two layers wrote the same rows ("latest" is what happens anyway)."""
    if policy not in get_args(Policy):
        raise ValueError(f"conflict: expected latest, first or blend, got {policy!r}")
    known = document.leaf_ids()
    if lower not in known or upper not in known or lower == upper:
        raise ValueError(f"conflict: expected two of the layers {', '.join(sorted(known))}, got {lower!r}, {upper!r}")
    rest = [entry for entry in document.policies if entry[:2] != (lower, upper)]
    new = [] if policy == "latest" else [(lower, upper, policy)]
    return replace(document, policies=tuple(rest + new))


def _numbered(layer: Layer, start: int) -> tuple[Layer, int]:
    inner, following = [], start + 1
    for child in layer.layers:
        own, following = _numbered(child, following)
        inner.append(own)
    return replace(layer, id=str(start), layers=tuple(inner)), following


def _pruned(document: Document) -> Document:
    known = document.leaf_ids()
    return replace(document, policies=tuple(p for p in document.policies if p[0] in known and p[1] in known))


def _place(place: int, count: int) -> int:
    if not 0 <= place < count:
        raise ValueError(f"layer: expected a place of 0 to {count - 1}, got {place}")
    return place
