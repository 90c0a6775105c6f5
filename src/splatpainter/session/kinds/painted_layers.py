"""Layers of edited pictures that a painter puts on the asset: paint, pictures, cloned strokes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Any, ClassVar

import numpy as np

from splatpainter.lift.masked_gaussians import reached_gaussians
from splatpainter.lift.options import LOCAL_DEFAULTS, LocalOptions
from splatpainter.painter import Method, Mode, Painter
from splatpainter.painting.edited_picture import LIFTS
from splatpainter.session.document.layer_operation import LayerOperation, LayerWork
from splatpainter.session.document.layer_view import View, is_hash
from splatpainter.session.replay.delta import between
from splatpainter.session.replay.fingerprint import fingerprint
from splatpainter.session.replay.layer_blending import mixed, within
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.source_edits import view_sequence
from splatpainter.spread.options import SPREAD_DEFAULTS, SpreadOptions
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.ranges import same_range

STROKE_OPTIONS: Mapping[str, Any] = {"fine_px": 0.0}
"""LocalOptions of what is painted by hand here, however large: erasing takes a sheet away and brings the original's
bits back, which split Gaussians cannot."""
OTHER_PAINTER = "computed by another painter than it was made with"
RECEIPT_FACTS = ("method", "preset", "note", "views", "precision")
"""What a painter's receipt says that facts of a layer take over."""


@dataclass(frozen=True)
class PaintedLayer(LayerOperation):
    """Edited pictures on the asset, by a painter."""

    by_hand: ClassVar[bool] = True
    """Whether it is painted by strokes, and not with whole pictures."""
    lays_paint: ClassVar[bool] = True

    mode: Mode = "local"
    """local: only what was painted changes. global: a regraded or relit picture changes the whole asset. spread: the
    painted material changes all around, also where the pictures do not show it."""
    method: Method = "auto"
    """Method of the painter."""
    painter: str = ""
    """What of the painter decides the result (fingerprint.py), as it was when the layer was made."""
    angle_limit: float | None = same_range(LocalOptions, "angle_limit", None)
    """Degrees between the line of sight and the surface's normal from which paint fades, 0: no limit; None: as the
    painter has it. Of modes local and spread."""
    depth_edge_limit: float | None = same_range(LocalOptions, "depth_edge_limit", None)
    """Pixels beside an edge in depth that are not painted, 0: none; None: as the painter has it. Of modes local and
    spread."""
    spread_threshold: float | None = same_range(SpreadOptions, "threshold", None)
    """Mode spread: confidence (0..1) from which a Gaussian counts as the painted material; lower reaches further. None:
    0.5."""
    split_only: bool = False
    """Split and recolour Gaussians, lay no sheets: for views that are painted one after the other."""
    within: bool = False
    """Mode global: only Gaussians that the masks of its views reach change."""
    selection: str | None = field(default=None, metadata={"blob": True})
    """Hash of the selection (Selection.to_png) that it keeps to, in modes global and spread; None: everything."""
    placed: dict[str, Any] | None = None
    """What a text or a sticker is and where it stands, so that it can be changed; its "image" is the hash of a
    picture."""
    source: dict[str, Any] | None = None
    """Who made its pictures: what receipts say of a picture source."""

    def __post_init__(self) -> None:
        if self.spreads and self.spread_threshold is None:
            object.__setattr__(self, "spread_threshold", self.spread_options().threshold)  # as people are to see it
        super().__post_init__()

    def check(self) -> None:
        # Refused here: in a layer of mode global they would be stored and mean nothing.
        if self.limits() and self.regrades:
            raise ValueError("expected angle_limit and depth_edge_limit with pictures in modes local and spread only")
        if self.limits():
            replace(LOCAL_DEFAULTS, **self.limits())  # judges them
        if self.spread_threshold is not None:
            self.spread_options()

    def blobs(self) -> set[str]:
        image = (self.placed or {}).get("image")
        return super().blobs() | ({str(image)} if is_hash(image) else set())

    def limits(self) -> dict[str, float]:
        """What one view may paint, where that is not as the painter has it: fields of its LocalOptions."""
        limits = {"angle_limit": self.angle_limit, "depth_edge_limit": self.depth_edge_limit}
        return {name: value for name, value in limits.items() if value is not None}

    def spread_options(self) -> SpreadOptions:
        """How far a layer of mode spread reaches. Raises ValueError: out of range."""
        return SPREAD_DEFAULTS if self.spread_threshold is None else SpreadOptions(self.spread_threshold)

    # ---- what the mode means, and what composing and painting ask

    @property
    def regrades(self) -> bool:
        """Whether its pictures change the whole asset."""
        return self.mode == "global"

    @property
    def spreads(self) -> bool:
        """Whether the painted material changes all around."""
        return self.mode == "spread"

    @property
    def takes_views(self) -> bool:
        return True

    @property
    def takes_pictures(self) -> bool:
        return True

    @property
    def needs_masks(self) -> bool:
        return not self.regrades

    @property
    def is_local_paint(self) -> bool:
        return self.mode == "local"

    @property
    def is_stroke(self) -> bool:
        return self.by_hand and self.is_local_paint

    @property
    def reads_locally(self) -> bool:
        return self.is_local_paint and self.method in LIFTS

    @property
    def certain_confidence(self) -> int:
        return 254 if self.spreads else super().certain_confidence  # spread: what was painted, and no more

    def for_strokes(self) -> LayerOperation | None:
        if not self.is_stroke:
            return None
        if self.placed is not None:
            raise ValueError("is a text or a picture that can be changed; paint into another layer")
        return PaintLayer(method=self.method, painter=self.painter)

    def repainted(self, painter: Painter, method: Method | None = None) -> LayerOperation:
        # "auto" is decided once: a painter that gains a network later must not change layers that are there.
        request = self.method if method is None else method
        method = painter.choose(request, self.mode)[0]
        if request == "auto" and method == "corrected" and self.by_hand:
            method = "lift"  # a stroke is to be there at once
        return replace(self, method=method, painter=fingerprint(painter, method, self.mode))

    # ---- what it does

    def result(self, work: LayerWork) -> LayerResult:
        # All views go to the painter together, as they were given.
        below = work.splats
        spread = self.spread_options() if self.spreads else None
        numbered, asset = work.paint(self.mode, self.method, self._local_options(), spread)
        facts = self._facts(work, asset.receipt)
        confidence = asset.confidence
        if confidence is not None:
            confidence = (np.clip(confidence, 0, 1) * 255 + 0.5).astype(np.uint8)
        # What is not meant stays as it was: beside the masks, and beside the selection.
        splats = asset.splats
        if self.regrades and self.within:
            masked = [(view.camera, work.mask(view)) for view in work.views if view.mask is not None]
            if not masked:
                raise ValueError(f"{work.title}: expected a mask in one of its views to stay within")
            splats = within(reached_gaussians(below, masked), below, splats)
        # A local layer keeps to its masks already; these modes reach Gaussians that no view shows.
        if self.selection is not None and not self.is_local_paint:
            splats = mixed(work.selected(self.selection), below, splats)
        # A receipt lists what changed: comparing every value again takes as long as a stroke.
        proved = asset.receipt is not None and splats is asset.splats and work.proves_changes
        # Parents are counted in the numbered asset below, so that later layers can follow splits.
        parent_ids = None if asset.splats.origin is None else asset.splats.origin[len(numbered) :]
        delta = between(numbered, splats, parent_ids, asset.receipt.touched if proved and asset.receipt else None)
        painter_state = None if asset.encoding is None else asset.encoding.state
        return LayerResult(delta, facts, confidence, painter_state).with_computed(below, splats)

    def _local_options(self) -> dict[str, Any]:
        """What of the painter's LocalOptions is another one for this layer."""
        if self.regrades or self.method == "ttt":  # networks paint without limits
            return {}
        # The layer's own limits first; how it is painted by hand is no choice of the layer's.
        options: dict[str, Any] = dict(self.limits())
        if self.by_hand:
            options |= STROKE_OPTIONS
        if self.split_only:
            options |= view_sequence.WITHOUT_SHEETS
        return options

    def _facts(self, work: LayerWork, receipt: Any) -> dict[str, Any]:
        facts: dict[str, Any] = {}
        if receipt is not None:
            record = receipt.summary()
            facts = {name: record[name] for name in RECEIPT_FACTS if name in record}
            facts["stages"] = record["seconds"]
        # Said and not refused: the layer is there, though perhaps not as its maker saw it.
        if self.painter != work.fingerprint(self.method, self.mode):
            facts["note"] = "; ".join(filter(None, (facts.get("note"), OTHER_PAINTER)))
        return facts


@dataclass(frozen=True)
class PaintLayer(PaintedLayer):
    """Paint: strokes, or views that were painted on."""

    kind: ClassVar[str] = "paint"

    @property
    def holds_strokes(self) -> bool:
        return self.is_local_paint


@dataclass(frozen=True)
class CloneLayer(PaintedLayer):
    """Paint that a clone stamp or a healing brush took from elsewhere in its view."""

    kind: ClassVar[str] = "clone"

    def check(self) -> None:
        super().check()
        _refuse_spread(self)


@dataclass(frozen=True)
class PictureLayer(PaintedLayer):
    """Whole edited pictures."""

    kind: ClassVar[str] = "picture"
    by_hand: ClassVar[bool] = False


def _refuse_spread(operation: PaintedLayer) -> None:
    if operation.spreads:
        raise ValueError(f"expected kind paint or picture with mode spread, got {operation.kind}")


def views_with_pictures(views: tuple[View, ...]) -> bool:
    """Whether one of them has a picture: masks alone limit what changes."""
    return any(view.picture for view in views)
