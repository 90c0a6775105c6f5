"""Who touched which rows: conflicts between layers, and what of the asset was seen and what predicted. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from splatpainter.session.layers import Document, Layer, Policy

ORIGINAL, SEEN, PREDICTED = 0, 1, 2
"""Values of a coverage."""
STRENGTH: dict[Policy, float] = {"latest": 1.0, "first": 0.0, "blend": 0.5}
"""What is left of the upper layer's opacity on rows in conflict."""


@dataclass(frozen=True)
class Touch:
    """What one layer did to the rows below it."""

    layer: Layer
    key: str
    """Of its result."""
    rows: np.ndarray = field(repr=False)
    """[T] int64 ascending rows that were there and that it wants to change (a policy may give them to another)."""
    appended: tuple[int, int] = (0, 0)
    """First of the rows that it appended, and the one after the last."""
    confidence: np.ndarray | None = field(default=None, repr=False)
    """[N + A] uint8 of a global layer: 255 was seen, towards 0 predicted; None: its views showed what it changed."""

    @property
    def local(self) -> bool:
        """Whether it paints a place, and so can be in conflict."""
        return self.layer.mode == "local" and self.layer.kind in ("paint", "picture", "clone")


@dataclass(frozen=True)
class Conflict:
    """Rows that two local layers wrote from different views."""

    lower: str
    upper: str
    """Layer ids."""
    rows: np.ndarray = field(repr=False)
    """[C] int64 ascending."""
    share: float
    """Of the rows that the lower layer changed or appended, 0..1."""
    policy: Policy

    @property
    def winner(self) -> str | None:
        """Id of the layer that shows; None: a blend of both."""
        return {"latest": self.upper, "first": self.lower, "blend": None}[self.policy]


def conflicts(touches: Sequence[Touch], document: Document) -> list[Conflict]:
    """All pairs of layers, lower ones first, that wrote the same rows from different views. Looks, global layers and
    the eraser are in no conflict: they mean to change what is below them."""
    chosen: dict[tuple[str, str], Policy] = {(low, high): policy for low, high, policy in document.policies}
    out = []
    for k, upper in enumerate(touches):
        for lower in touches[:k]:
            if not (upper.local and lower.local) or same_views(upper.layer, lower.layer):
                continue
            rows = shared(lower, upper.rows)
            if len(rows):
                total = len(lower.rows) + lower.appended[1] - lower.appended[0]
                pair = (lower.layer.id, upper.layer.id)
                out.append(Conflict(*pair, rows, len(rows) / total, chosen.get(pair, "latest")))
    return out


def strengths(touches: Sequence[Touch], layer: Layer, document: Document, count: int) -> tuple[np.ndarray | None, list]:
    """([N] factor of a layer's opacity per row where policies say so, else None; what that depends on, for its key).
    touches: of the layers below."""
    factor, depends = None, []
    below = {touch.layer.id: touch for touch in touches}
    for lower, upper, policy in document.policies:
        if upper == layer.id and lower in below and not same_views(below[lower].layer, layer):
            factor = np.ones(count, np.float32) if factor is None else factor
            rows = shared(below[lower], np.arange(count))
            factor[rows] = np.minimum(factor[rows], STRENGTH[policy])
            depends.append([below[lower].key, policy])
    return factor, depends


def shared(lower: Touch, rows: np.ndarray) -> np.ndarray:
    """[C] int64 ascending: those of `rows` (ascending) that a layer changed or appended."""
    first, end = lower.appended
    return rows[np.isin(rows, lower.rows, assume_unique=True) | ((rows >= first) & (rows < end))]


def same_views(a: Layer, b: Layer) -> bool:
    """Whether every view of `a` looks from where one of `b` does."""
    return all(
        any(np.allclose(v.camera.world_to_camera, w.camera.world_to_camera, atol=1e-6) for w in b.views)
        for v in a.views
    )


def coverage(touches: Sequence[Touch], count: int) -> np.ndarray:
    """[N] uint8 per row: ORIGINAL, SEEN (an edited view showed it) or PREDICTED (a global layer changed it without
    having seen it). Looks and the eraser invent nothing: what they change stays as it was, or is the original again."""
    out = np.zeros(count, np.uint8)
    for touch in touches:
        new = np.arange(*touch.appended)
        if touch.layer.kind == "erase":
            out[touch.rows] = ORIGINAL
        elif touch.confidence is not None:
            rows = np.concatenate([touch.rows, new])
            certain = touch.confidence[rows] > 127
            out[rows] = np.where(certain | (out[rows] == SEEN), SEEN, PREDICTED)
        elif touch.layer.kind != "look":
            out[touch.rows] = SEEN
            out[new] = SEEN
    return out
