"""The session as clients see it: values of protocol.py from what a session says. Knows no client."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from itertools import takewhile
from typing import Any, get_args

import numpy as np
from pydantic import ValidationError

from splatpainter import cameras
from splatpainter.cameras import FRAME_MARGIN, UPS, bounding_sphere
from splatpainter.color import to_display
from splatpainter.doubts import doubts
from splatpainter.io import FORMATS, axes_are_open, axes_line
from splatpainter.server import protocol
from splatpainter.server.fine_detail import has_fine_detail
from splatpainter.session import Layer, Session
from splatpainter.session.document.document import takes_strokes
from splatpainter.session.document.layer_mask import LayerMask
from splatpainter.session.document.layer_operation import LayerOperation
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID
from splatpainter.session.project.project_file import Bookmark, Step
from splatpainter.session.replay.recent_changes import changes as changes_between
from splatpainter.splats import Splats

HOME_VIEW = {"elevation": 15.0, "fov": 40.0}
BACKGROUND = (0.16, 0.17, 0.18)
NAMED_APART = ("kind", "mode", "method", "painter")
"""Options of layers that LayerInfo has as fields, or that no page needs."""
PICTURE_PX = 96
"""Width and height of the picture of a project."""


def up_axis(session: Session) -> tuple[int, int, int]:
    """World axis that is up on the screen."""
    return UPS[session.scene.up]


def home_view(splats: Splats, up: tuple[int, int, int], start: float) -> tuple[np.ndarray, float, cameras.Camera]:
    """([3] centre and radius of nearly all opaque Gaussians, a view of their front). start: degrees around up."""
    # So far away that the sphere fits between the edges of the field of view, with a margin.
    center, radius = bounding_sphere(splats)
    distance = FRAME_MARGIN * radius / math.sin(math.radians(HOME_VIEW["fov"] / 2))
    view = cameras.orbit(
        center, distance, 1, up=up, start=start, width=800, height=800, background=BACKGROUND, **HOME_VIEW
    )[0]
    return center, radius, view.local


def small_view(info: protocol.AssetInfo) -> cameras.Camera:
    """The first view of the asset, as small as a list shows it."""
    return info.home.to_camera().resized(PICTURE_PX, PICTURE_PX)


def drawn(splats: Splats, camera: cameras.Camera) -> np.ndarray:
    """[H, W, 3] display colours 0..1."""
    from splatpainter.rendering import render

    return np.clip(to_display(render(splats, camera).colors[0], splats.color_space), 0, 1)


def asset_info(session: Session, name: str) -> protocol.AssetInfo:
    """What there is to say of the asset as it was opened; `counted` says how it is now."""
    # Counts and doubts cost a pass over all Gaussians; they are made once, and `counted` replaces what changes.
    original = session.original
    up = up_axis(session)
    center, radius, view = home_view(original, up, session.scene.front)
    source = original.source
    return protocol.AssetInfo(
        name=name,
        format="" if source is None else source.format,
        sha256=original.sha256,
        gaussians=len(original),
        gaussians_original=len(original),
        gaussians_unchanged=len(original),
        sh_coefficients=int(original.sh.shape[1]),
        color_space=original.color_space,
        antialiased=original.antialiased,
        center=center.tolist(),
        offset=list(original.offset),
        radius=radius,
        up=list(up),
        home=protocol.CameraInfo.of(view),
        axes="" if source is None else axes_line(source, hint=False),
        axes_stated=source is None or not axes_are_open(source),
        problems=[] if source is None else list(source.problems),
        doubts=[doubt.line for doubt in doubts(original)],
        fine_detail=has_fine_detail(original, view),
    )


def counted(info: protocol.AssetInfo, original: Splats, now: Splats) -> protocol.AssetInfo:
    """`info` with the present counts; every Gaussian is compared with the original."""
    same = len(original) - len(changes_between(original, now))
    return info.model_copy(update={"gaussians": len(now), "gaussians_unchanged": same})


def scene_assets(session: Session, name: str) -> list[protocol.SceneAssetInfo]:
    """All assets. name: of the one that was opened."""
    out = []
    # Centres are given in the scene: the page places its handles without the assets' Gaussians.
    for asset in session.scene.assets:
        rows = session.scene.original_of(asset.id)
        placement = asset.placement.between(rows.offset, session.original.offset)
        center = placement.points(rows.middle[None])[0]
        # The first asset has the name of the file that was opened, unless the document lists assets by name.
        is_main = asset.id == MAIN_ASSET_ID and not session.snapshot.document.assets
        out.append(
            protocol.SceneAssetInfo(
                id=asset.id,
                name=name if is_main else asset.name,
                visible=asset.visible,
                move=list(placement.move),
                moved=list(asset.placement.move),
                turn=[round(angle, 6) for angle in placement.turn],
                scale=placement.scale,
                center=center.tolist(),
                gaussians=len(rows),
                layers=sum(layer.asset == asset.id for layer in session.layers),
            )
        )
    return out


def layer_info(session: Session, layer: Layer) -> protocol.LayerInfo:
    """A layer with the figures of its last computation."""
    facts = session.layers.facts(layer.id)
    # A layer of strokes shows the view of the latest one; a view without figures yet still has its place.
    latest_views = layer.strokes[-1].views if layer.strokes else layer.views
    scores: list[dict[str, Any]] = [*facts.get("views", ()), *({} for _ in latest_views)]
    views = [
        protocol.LayerViewInfo(
            camera=protocol.CameraInfo.of(view.camera),
            picture=view.picture,
            mask=view.mask,
            **{k: score.get(k) for k in ("psnr_before", "psnr_after", "psnr_outside")},
        )
        for view, score in zip(latest_views, scores, strict=False)
    ]
    return protocol.LayerInfo(
        id=layer.id,
        name=layer.name,
        asset=layer.asset,
        kind=layer.kind,
        visible=layer.visible,
        opacity=layer.opacity,
        blend=layer.blend,
        mode=getattr(layer.operation, "mode", "global"),
        # What made the layer, where it was computed, is truer than what was asked for.
        method=facts.get("method", getattr(layer.operation, "method", "lift")),
        views=views,
        strokes=sum(len(leaf.strokes) for leaf in layer.leaves()) if takes_strokes(layer) else None,
        placed=_placed(layer),
        mask=_mask_info(layer.mask),
        parameters=page_parameters(layer.operation),
        gaussians_edited=facts.get("rows_touched", 0),
        gaussians_appended=facts.get("rows_appended", 0),
        seconds=facts.get("seconds", 0.0),
        note=facts.get("note", ""),
        problem=facts.get("problem", ""),
        thumbnail=layer.thumbnail,
    )


def latest_edit(session: Session) -> protocol.EditFigures | None:
    """Figures of the newest stroke or layer that is in effect: ids only ever go up."""
    # Layers may stand in any order, so the newest is found by its id and not by its place.
    latest: tuple[int, Layer, str, dict[str, Any]] | None = None
    for layer in (leaf for one in session.layers if one.visible for leaf in one.leaves()):
        facts = session.layers.facts(layer.id)
        newest = layer.strokes[-1] if layer.strokes else layer
        number = int(newest.id) if newest.id.isdecimal() else 0
        if "rows_touched" in facts and (latest is None or number > latest[0]):
            name = f"{newest.name} in {layer.name}" if layer.strokes else layer.name
            latest = number, layer, name, facts
    if latest is None:
        return None
    # Of a stroke its own share is shown, not the sum of the whole layer.
    _, layer, name, facts = latest
    counts = facts.get("stroke", facts)
    score = next(iter(facts.get("views", ())), {})
    return protocol.EditFigures(
        layer=layer.id,
        name=name,
        seconds=counts.get("seconds", 0.0),
        gaussians=counts.get("rows_touched", 0) + counts.get("rows_appended", 0),
        **{k: score.get(k) for k in ("psnr_before", "psnr_after", "psnr_outside")},
    )


def page_parameters(operation: LayerOperation) -> dict[str, Any]:
    """Options of a layer that are not at their defaults, JSON; the settings of an adjustment stand beside its name."""
    options = {name: value for name, value in operation.record().items() if name not in NAMED_APART}
    settings = options.pop("settings", {})
    return {**options, **settings}


def _mask_info(mask: LayerMask | None) -> protocol.MaskInfo | None:
    return None if mask is None else protocol.MaskInfo(enabled=mask.enabled, shows=mask.shows, parts=len(mask.parts))


def _placed(layer: Layer) -> protocol.Placed | None:
    """Where a text or sticker is placed; None for other layers, and where its parameters are damaged."""
    try:
        return protocol.Placed.model_validate(getattr(layer.operation, "placed", None))
    except ValidationError:
        return None


def conflict_infos(session: Session) -> list[protocol.ConflictInfo]:
    """Layers that edited the same Gaussians from different views, those inside of merged ones too."""
    names = {leaf.id: _name_in(one, leaf) for one in session.snapshot.document.layers for leaf in one.leaves()}
    return [
        protocol.ConflictInfo(
            lower=c.lower,
            upper=c.upper,
            lower_name=names[c.lower],
            upper_name=names[c.upper],
            gaussians=len(c.gaussian_ids),
            share=min(c.share, 1),
            reason=c.reason,
            policy=c.policy,
        )
        for c in session.layers.conflicts()
    ]


def _name_in(layer: Layer, leaf: Layer) -> str:
    """What a layer is called, or one that is merged into it."""
    return leaf.name if leaf is layer else f"{leaf.name} (merged into {layer.name})"


class Lists:
    """The long lists of a session. What was there before is described by the same objects as before, so that
    `history_change` and whoever else wants to know what is new need not compare what they say."""

    def __init__(self) -> None:
        self._steps: dict[Step, protocol.StepInfo] = {}
        self._bookmarks: dict[int, tuple[Bookmark, protocol.BookmarkInfo]] = {}

    def history(self, session: Session) -> list[protocol.StepInfo]:
        """The history's steps, oldest first."""
        earlier = self._steps
        self._steps = {s: earlier.get(s) or protocol.StepInfo(id=s.id, label=s.label) for s in session.history}
        return list(self._steps.values())

    def bookmarks(self, session: Session) -> list[protocol.BookmarkInfo]:
        """Views to come back to."""
        earlier = self._bookmarks
        self._bookmarks = {id(b): earlier.get(id(b)) or (b, _bookmark_info(b)) for b in session.bookmarks}
        return [info for _, info in self._bookmarks.values()]


def _bookmark_info(bookmark: Bookmark) -> protocol.BookmarkInfo:
    return protocol.BookmarkInfo(id=bookmark.id, name=bookmark.name, camera=protocol.CameraInfo.of(bookmark.camera))


def changes(before: protocol.State, now: protocol.State, clients: int) -> protocol.StateEvent:
    """The event for a client that was sent `before`; lists made by Lists."""
    present = protocol.Present.model_validate(
        {k: getattr(now, k) for k in protocol.Present.model_fields} | {"clients": clients}
    )
    # Long lists go as differences: they grow with a project's age, while the rest of the state is bounded.
    history = history_change(before.history, now.history)
    marks = None if _same(before.bookmarks, now.bookmarks) else now.bookmarks
    return protocol.StateEvent(state=present, history=history, bookmarks=marks)


def history_change(before: list[protocol.StepInfo], now: list[protocol.StepInfo]) -> protocol.HistoryChange | None:
    """How one list of steps (of one Lists) became the other; None: it did not change."""
    if _same(before, now):
        return None
    # Old steps fall off at the front and new ones replace the end, so two numbers and the rest say everything.
    dropped = next((k for k, step in enumerate(before) if now and step is now[0]), len(before))
    common = sum(1 for _ in takewhile(lambda pair: pair[0] is pair[1], zip(before[dropped:], now, strict=False)))
    return protocol.HistoryChange(dropped=dropped, kept=common, steps=now[common:])


def _same(before: Sequence[object], now: Sequence[object]) -> bool:
    return len(before) == len(now) and all(map(operator.is_, before, now))


def methods(session: Session) -> list[protocol.Method]:
    """Those that this session's painter has; "ttt" where it is more than what "auto" may choose anyway."""
    network = any(session.painter.encodes("ttt", mode) for mode in ("local", "global"))
    return [method for method in get_args(protocol.Method) if network or method != "ttt"]


def endings() -> list[str]:
    """File name endings that can be written."""
    return [entry.suffixes[0] for entry in FORMATS.values() if entry.write is not None]
