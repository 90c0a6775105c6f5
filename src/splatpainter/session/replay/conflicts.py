"""Which layer edited which Gaussians: conflicts, and what of the asset was seen and what predicted. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import Literal

import numpy as np

from splatpainter.session.document.document import Document, Layer, Policy
from splatpainter.system.quick_dataclass import dataclass

ORIGINAL, SEEN, PREDICTED = 0, 1, 2
"""Values of a coverage."""
POLICY_STRENGTH: dict[Policy, float] = {"latest": 1.0, "first": 0.0, "blend": 0.5}
"""What is left of the upper layer's opacity on Gaussians in conflict."""

MIN_COVERED_SHARE = 0.5
"""Share, 0..1, of the smaller layer's Gaussians from which a layer counts as covered by another one. On the demo asset,
views 25 degrees apart: a spot that replaces another of its size shares 0.85; one of half its width, anywhere within it
(paint on a decal), at most 0.39."""
MIN_STALE_SHARE = 0.1
"""The same where the lower layer was painted on after the upper one: which of its strokes lie there is not known.
There, spots that only touch share at most 0.06, those that lie over each other by a fifth of their width 0.2."""
Reason = Literal["", "stale", "covered"]


@dataclass(frozen=True)
class EditedIds:
    """Which Gaussians one layer edited."""

    layer: Layer
    key: str
    """Key of the layer's result."""
    changed: np.ndarray = field(repr=False)
    """[T] int64 ascending: those that were there and that it wants to change (a policy may give them to another)."""
    appended: tuple[int, int] = (0, 0)
    """First of those that it appended, and the one after the last."""
    confidence: np.ndarray | None = field(default=None, repr=False)
    """[N + A] uint8 of a global layer: 255 was seen, towards 0 predicted; of a spread one: 255 was painted, else
    how sure it is that it is of the painted material; None: its views showed what it changed."""

    @property
    def count(self) -> int:
        """How many it changed or appended."""
        return len(self.changed) + self.appended[1] - self.appended[0]

    @property
    def local(self) -> bool:
        """Whether it paints a part of the surface, and so can be in conflict."""
        return self.layer.operation.is_local_paint


@dataclass(frozen=True)
class Conflict:
    """Gaussians that two local layers changed from different views."""

    lower: str
    upper: str
    """Layer ids."""
    gaussian_ids: np.ndarray = field(repr=False)
    """[C] int64 ascending."""
    share: float
    """Share of the Gaussians that the lower layer changed or appended, 0..1."""
    share_of_smaller: float
    """Share of those of the layer that has fewer of them, 0..1."""
    is_stale: bool
    """Whether the lower layer was painted on after the upper one: pictures of the upper one show it as it was."""
    policy: Policy

    @property
    def reason(self) -> Reason:
        """Why a user should know of it: "stale" pictures, or a layer that is "covered" largely; "": layers of different
        views that share their edges, or paint on a larger layer."""
        if self.is_stale and self.share_of_smaller >= MIN_STALE_SHARE:
            return "stale"
        return "covered" if self.share_of_smaller >= MIN_COVERED_SHARE else ""

    @property
    def winner(self) -> str | None:
        """Id of the layer that is visible there; None: a blend of both."""
        return {"latest": self.upper, "first": self.lower, "blend": None}[self.policy]


def find_conflicts(edited: Sequence[EditedIds], document: Document) -> list[Conflict]:
    """All pairs of layers, lower ones first, that changed the same Gaussians from different views. Adjustment layers,
    global layers and the eraser are in no conflict: they mean to change what is below them."""
    chosen: dict[tuple[str, str], Policy] = {(low, high): policy for low, high, policy in document.policies}
    out = []
    for k, upper in enumerate(edited):
        for lower in edited[:k]:
            if not (upper.local and lower.local) or same_views(upper.layer, lower.layer):
                continue
            # From one view two layers are strokes one over the other, as a user sees them: no conflict.
            common = overlap(lower, upper.changed)
            if len(common):
                pair = (lower.layer.id, upper.layer.id)
                shares = (len(common) / lower.count, len(common) / min(lower.count, upper.count))
                is_stale = max(_numbers(lower.layer)) > min(_numbers(upper.layer))
                out.append(Conflict(*pair, common, *shares, is_stale, chosen.get(pair, "latest")))
    return out


def _numbers(layer: Layer) -> list[int]:
    """Ids of a layer's strokes, or its id where it has none: they only ever go up. 0: of a damaged project."""
    return [int(one.id) if one.id.isdecimal() else 0 for one in layer.strokes or (layer,)]


def policy_strength(
    edited: Sequence[EditedIds], layer: Layer, document: Document, count: int
) -> tuple[np.ndarray | None, list]:
    """([N] factor of a layer's opacity per Gaussian where policies say so, else None; what that depends on, for its
    key). edited: of the layers below."""
    factor, depends = None, []
    below = {entry.layer.id: entry for entry in edited}
    for lower, upper, policy in document.policies:
        if upper == layer.id and lower in below and not same_views(below[lower].layer, layer):
            factor = np.ones(count, np.float32) if factor is None else factor
            common = overlap(below[lower], np.arange(count))
            # Of several policies the strictest: what a lower layer keeps, no other pair gives away.
            factor[common] = np.minimum(factor[common], POLICY_STRENGTH[policy])
            # The key of the lower result, as the factor holds for the Gaussians that it changed.
            depends.append([below[lower].key, policy])
    return factor, depends


def overlap(lower: EditedIds, ids: np.ndarray) -> np.ndarray:
    """[C] int64 ascending: those of `ids` (ascending) that a layer changed or appended."""
    first, end = lower.appended
    return ids[np.isin(ids, lower.changed, assume_unique=True) | ((ids >= first) & (ids < end))]


def same_views(a: Layer, b: Layer) -> bool:
    """Whether every view of `a` looks from where one of `b` does."""
    if not a.cameras or not b.cameras:
        return not a.cameras
    first, second = (np.stack([camera.world_to_camera for camera in layer.cameras]) for layer in (a, b))
    return all(np.isclose(one, second, atol=1e-6).all((1, 2)).any() for one in first)


def coverage(edited: Sequence[EditedIds], count: int) -> np.ndarray:
    """[N] uint8 per Gaussian: ORIGINAL, SEEN (an edited view showed it) or PREDICTED (a global or spread layer changed
    it without having seen it). Adjustments and the eraser invent nothing: what they change stays as it was, or is the
    original again."""
    out = np.zeros(count, np.uint8)
    for entry in edited:
        ids = np.concatenate([entry.changed, np.arange(*entry.appended)])
        operation = entry.layer.operation
        # In the order of the layers: what is seen later covers what was predicted before.
        if operation.covers == "original":
            out[entry.changed] = ORIGINAL
        elif entry.confidence is not None:
            certain = entry.confidence[ids] > operation.certain_confidence
            out[ids] = np.where(certain | (out[ids] == SEEN), SEEN, PREDICTED)
        elif operation.covers == "seen":
            out[ids] = SEEN
    return out
