"""What the latest edit saw is there for the next one from its camera, and changes no bit of any."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.kernels import arrays
from splatpainter.painter import Asset, Edit, Painter
from splatpainter.painting import latest_view
from splatpainter.rendering.cpu import projected_view, recent_views
from splatpainter.splats import ATTRIBUTES
from tests.support.lift_scenes import disk, front
from tests.support.studio_scenes import ball

CAMERA = front(96)
PAINTER = Painter.load("lift")


@pytest.fixture
def projections(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Gaussians of whole views that were projected."""
    counts: list[int] = []
    project = projected_view.project

    def counted(splats, camera, **how):
        counts.append(len(splats))
        return project(splats, camera, **how)

    monkeypatch.setattr(recent_views, "project", counted)
    monkeypatch.setattr(latest_view, "_latest", [])
    monkeypatch.setattr(arrays, "_idle", arrays._IdleMemory())  # a command of another test may have switched it off
    return counts


def dab(asset: Asset, x: float = 48, value: float = 0.2, camera=CAMERA) -> Edit:
    mask = disk(camera, x, 48, 9)
    return Edit(np.where(mask[..., None], np.float32(value), sp.render(asset.splats, camera).colors[0]), camera)


def painted(asset: Asset, edit: Edit, **how) -> Asset:
    return PAINTER.apply(asset, [edit], **how)


def same(one: Asset, other: Asset) -> bool:
    assert one.receipt is not None and other.receipt is not None
    receipts = [str(replace(receipt, seconds={})) for receipt in (one.receipt, other.receipt)]
    bits = [b"".join(getattr(asset.splats, name).tobytes() for name in ATTRIBUTES) for asset in (one, other)]
    return receipts[0] == receipts[1] and bits[0] == bits[1]


def chain(asset: Asset) -> list[Asset]:
    """Dabs one over the other and beside each other, one anew after an undo, a look of all, a dab on that."""
    first = painted(asset, dab(asset))
    second = painted(first, dab(first, 52, 0.8))
    third = painted(second, dab(second, 30, 0.6))
    anew = painted(second, dab(second, 30, 0.1))
    brighter = np.clip(sp.render(anew.splats, CAMERA).colors[0] + 0.1, 0, 1)
    look = painted(anew, Edit(brighter, CAMERA), mode="global")
    return [first, second, third, anew, look, painted(look, dab(look, 40))]


def test_edits_in_turn_project_the_view_once_and_are_the_same_to_the_bit(
    projections: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = chain(PAINTER.encode(ball(3000)))
    assert projections == [3000]
    projections.clear()
    monkeypatch.setattr(latest_view, "MAX_VIEW_BYTES", 0)
    alone = chain(PAINTER.encode(ball(3000)))
    assert len(projections) == 6
    assert all(same(one, other) for one, other in zip(shared, alone, strict=True))


def test_nobody_else_finds_it(projections: list[int]) -> None:
    asset = PAINTER.encode(ball(3000))
    edit = dab(asset)
    result = painted(asset, edit)
    assert len(projections) == 1 and len(latest_view._latest) == 2
    drawing = latest_view.latest_view(asset, CAMERA)
    assert drawing is not None and "entries" in vars(drawing.view), "numbered anew for each edit"
    del drawing
    assert recent_views.recent_view(asset.splats, CAMERA) is None, "arrays may be written to between two edits"
    # Another camera, another asset of the same arrays, several pictures at once.
    further: Sequence[tuple[Asset, list[Edit]]] = [
        (asset, [dab(asset, camera=replace(CAMERA, fx=CAMERA.fx + 1))]),
        (PAINTER.encode(asset.splats), [edit]),
        (asset, [edit, dab(asset, 30)]),
    ]
    for other, edits in further:
        projections.clear()
        PAINTER.apply(other, edits)
        assert projections == [3000] * len(edits)
    assert same(painted(asset, edit), result)
    assert latest_view.latest_view(asset, replace(CAMERA, fx=CAMERA.fx + 1)) is None


def test_it_goes_with_its_assets_and_is_not_there_where_memory_is_dear(
    projections: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    asset = PAINTER.encode(ball(3000))
    edit = dab(asset)
    result = painted(asset, edit)
    assert [entry.asset() for entry in latest_view._latest] == [result, asset]
    del result
    gc.collect()
    assert latest_view.latest_view(asset, CAMERA) is not None
    del asset
    gc.collect()
    assert not latest_view._latest
    asset = PAINTER.encode(ball(3000))
    monkeypatch.setattr(latest_view, "MAX_VIEW_BYTES", 100_000)
    painted(asset, edit)
    assert not latest_view._latest
    monkeypatch.undo()
    monkeypatch.setattr(arrays._idle, "limits", replace(arrays.IDLE_LIMITS, most_bytes=0))
    painted(asset, edit)
    assert not latest_view._latest
