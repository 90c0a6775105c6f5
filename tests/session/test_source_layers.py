"""Views of a picture source as layers of a session: one per view or one of all, cancelled on the way, limited to a
selection, with the source in the receipt."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import Camera
from splatpainter.receipts import Receipt
from splatpainter.session import Session
from splatpainter.session.commands.source_layers import add_source_views
from splatpainter.source_edits import coverage
from splatpainter.source_edits.coverage import plan_views
from splatpainter.source_edits.edit import edit_with_source
from splatpainter.source_edits.view_edit import SourceBrief, displayed
from splatpainter.sources.picture_source import SourceCancelled, SourceError
from splatpainter.splats import SH_C0, Splats
from tests.support.cli_scenes import ball
from tests.support.picture_sources import FunctionSource, exchanged

GREY = (0.25, 0.25, 0.25)
BRIEF = SourceBrief("exchange the colours")


@pytest.fixture(autouse=True)
def few_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coverage, "CANDIDATE_VIEWS", 8)


def exchanged_8_bit(image: np.ndarray) -> np.ndarray:
    """As layers keep it."""
    return np.round(np.clip(exchanged(image), 0, 1) * 255) / 255


def patterned(count: int = 400) -> Splats:
    splats = ball(count, degree=0)
    x, y, z = splats.means.T
    colors = 0.45 + 0.25 * np.stack([np.sin(4 * x + y), np.sin(3 * y + 2), np.cos(3 * z - x)], 1)
    colors[:, 0] += 0.15
    return replace(splats, sh=((colors - 0.5) / SH_C0)[:, None].astype(np.float32))


@pytest.fixture
def session(tmp_path: Path):
    with Session(patterned(), tmp_path / "ball.splatproj") as opened:
        yield opened


def planned(session: Session, views: int, **options):
    return plan_views(session.splats, size=64, max_views=views, background=GREY, **options)


def test_each_view_is_a_layer_and_merged_ones_show_the_same(session: Session, tmp_path: Path) -> None:
    source, plan = FunctionSource(exchanged_8_bit), planned(session, 3)
    made = add_source_views(session, source, BRIEF, plan, method="lift")
    assert [layer.name for layer in made.layers] == [f"function: exchange the colours ({k})" for k in (1, 2, 3)]
    assert tuple(session.layers) == made.layers and made.notes == () and len(source.requests) == 3
    separate, before = session.splats, displayed(session.original, plan.cameras[2])[0]
    assert not np.allclose(source.requests[2].image, before, atol=0.05)  # it shows what those before painted
    outright = edit_with_source(
        session.original,
        FunctionSource(exchanged_8_bit),
        BRIEF.prompt,
        views="auto",
        max_views=3,
        size=64,
        method="lift",
    )
    assert len(outright.splats) == len(separate)  # the same Gaussians are split, and the same pixels are mended
    error = np.abs(displayed(outright.splats, plan.cameras[0])[0] - displayed(separate, plan.cameras[0])[0])
    assert error.mean() < 0.01
    for _ in made.layers:
        session.undo()
    again = add_source_views(session, FunctionSource(exchanged_8_bit), BRIEF, plan, method="lift", one_layer=True)
    (one,) = again.layers
    assert tuple(session.layers) == (one,) and one.kind == "merged" and one.name == "function: exchange the colours"
    assert all(
        np.array_equal(getattr(separate, name), getattr(session.splats, name)) for name in ("means", "sh", "opacities")
    )
    receipt, _ = session.files.export(tmp_path / "out.ply")
    read = Receipt.from_json((tmp_path / "out.ply.receipt.json").read_text("utf-8"))
    assert read.source == receipt.source and receipt.source is not None
    records = receipt.source["layers"]
    assert [record["layer"] for record in records] == [layer.name for layer in one.layers]
    assert records[0]["prompt"] == BRIEF.prompt and records[0]["views"][0]["model"] == "function-1"
    session.layers.set(one.id, visible=False)
    assert session.files.receipt().source is None
    assert session.verify() == []


def test_cancelled_on_the_way_what_was_painted_stays(session: Session) -> None:
    stop = threading.Event()

    class Slow(FunctionSource):
        def edit(self, request, progress, cancel):
            if len(self.requests) == 1:
                stop.set()
            if cancel.is_set():
                raise SourceCancelled
            return super().edit(request, progress, cancel)

    made = add_source_views(session, Slow(exchanged), BRIEF, planned(session, 3), cancel=stop, method="lift")
    assert made.sourced_views.cancelled and len(made.layers) == 1 and tuple(session.layers) == made.layers
    with pytest.raises(SourceCancelled):
        add_source_views(session, Slow(exchanged), BRIEF, planned(session, 2), cancel=stop)
    assert tuple(session.layers) == made.layers


def test_only_what_is_allowed_is_planned_and_changed(session: Session) -> None:
    def right_half(camera: Camera) -> np.ndarray:
        """[H, W] 1 where the surface has x > 0.35."""
        bright = np.where(session.splats.means[:, :1] > 0.35, 0.5, -0.5).repeat(3, 1)[:, None] / SH_C0
        drawn = displayed(replace(session.splats, sh=bright.astype(np.float32)), camera)[0]
        return (drawn.mean(-1) > 0.6).astype(np.float32)

    everywhere, half = planned(session, 8), planned(session, 8, allowed=right_half)
    assert len(half.cameras) < len(everywhere.cameras) and half.covered > 0.8
    assert half.cameras[0].position[0] > 0.5
    made = add_source_views(
        session, FunctionSource(exchanged), BRIEF, planned(session, 2, allowed=right_half), allowed=right_half
    )
    assert made.layers
    old, new = session.original, session.splats
    changed = (old.sh != new.sh[: len(old)]).any((1, 2)) | (old.means != new.means[: len(old)]).any(1)
    assert changed[old.means[:, 0] > 0.5].any() and not changed[old.means[:, 0] < 0].any()


def test_errors_leave_no_layer(session: Session) -> None:
    class Failing(FunctionSource):
        def edit(self, request, progress, cancel):
            raise SourceError("source failing: the key has expired (401)")

    with pytest.raises(SourceError, match="expired"):
        add_source_views(session, Failing(exchanged), BRIEF, planned(session, 2))
    assert not session.layers and len(session.history) == 1
