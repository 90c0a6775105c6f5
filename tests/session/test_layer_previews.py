"""What is shown of a layer below others before these are painted anew: it is what the commit then makes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.io import write
from splatpainter.scene.placement import Placement
from splatpainter.session import Session
from splatpainter.splats import ATTRIBUTES, Splats
from tests.support.session_scenes import BLUE, GREEN, RED, FlatPainter, asset, dab, flat, load

RIGHT = Placement.of(move=(1.4, 0, 0), turn=(0, 0, 90), scale=0.5)


def calls(session: Session) -> int:
    assert isinstance(session.painter, FlatPainter)
    return len(session.painter.calls)


def covered(session: Session, layer: str) -> str:
    """The layer, under another that overlaps a part of it; colours below have been fitted to it."""
    session.layers.set(layer, opacity=0.9)
    session.layers.set(layer, opacity=1.0)
    session.layers.add("paint", [dab(BLUE, 20, radius=3)], name="above")
    return layer


def paint(session: Session) -> str:
    layer = session.layers.new("Paint")
    for color, x in ((RED, 14), (GREEN, 17)):
        session.strokes.paint(layer.id, [dab(color, x)])
    return layer.id


def masked(session: Session) -> str:
    layer = paint(session)
    weights = np.linspace(0, 1, len(session.splats)).astype(np.float32)
    session.masks.set_selection(layer, weights)
    return layer


def merged(session: Session) -> str:
    return session.layers.merge([paint(session), session.layers.add("paint", [dab(BLUE, 13, radius=3)]).id]).id


def look(session: Session) -> str:
    return session.layers.add("look", look="gain", settings={"gain": [0.5, 1, 1]}).id


def hide(session: Session) -> str:
    weights = np.zeros(len(session.splats), np.float32)
    weights[::2] = 1
    return session.layers.hide_selected(weights).id


def same_as_committed(session: Session, layer: str, **change: Any) -> int:
    """Compare a preview with what is then committed, Gaussian by Gaussian; how many the preview shows anew."""
    before, made = session.splats, calls(session)
    preview = session.layers.blend_preview(layer, **change)
    assert preview is not None and session.splats is before and calls(session) == made, "nothing is painted"
    ids, splats = preview
    assert (np.diff(ids) > 0).all() and len(ids) == len(splats)
    session.layers.set(layer, **change)
    exact = session.splats
    appended = ids >= len(before)
    assert (ids[appended] == len(before) + np.arange(int(appended.sum()))).all()
    for one, preview_row in zip(ids[~appended].tolist(), np.flatnonzero(~appended).tolist(), strict=True):
        row = exact.take([one]) if one < len(exact) else None
        gone = splats.opacities[preview_row] == 0 and (row is None or not near(row, splats.take([preview_row])))
        assert gone or (row is not None and near(row, splats.take([preview_row]))), one
    for preview_row in np.flatnonzero(appended).tolist():
        assert any(near(exact.take([k]), splats.take([preview_row])) for k in range(len(session.original), len(exact)))
    return len(ids)


def near(one: Splats, other: Splats) -> bool:
    return all(np.allclose(getattr(one, name), getattr(other, name), atol=1e-5) for name in ATTRIBUTES)


@pytest.mark.parametrize("make", [paint, masked, merged, look, hide])
@pytest.mark.parametrize("change", [{"opacity": 0.5}, {"blend": "luminosity"}, {"visible": False}])
def test_a_change_below_other_layers(make: Callable[[Session], str], change: dict[str, Any]) -> None:
    with flat() as session:
        layer = covered(session, make(session))
        assert same_as_committed(session, layer, **change) >= 10
        if "visible" not in change:
            assert same_as_committed(session, layer, opacity=0.25) >= 10, "and once more"


@pytest.mark.parametrize("make", [paint, masked, merged, look])
def test_a_layer_that_was_hidden_when_the_project_was_opened(make: Callable[[Session], str], tmp_path: Path) -> None:
    path = tmp_path / "one.splatproj"
    with flat(project=path) as session:
        layer = covered(session, make(session))
        session.layers.set(layer, visible=False)
    with load(path) as session:
        if make is masked:
            assert session.layers.blend_preview(layer, visible=True) is None, "its mask is to be measured first"
            return
        assert same_as_committed(session, layer, visible=True) >= 10


def test_a_layer_whose_result_is_not_there_has_no_preview() -> None:
    with flat() as session:
        layer = session.layers.add("paint", [dab(RED)])
        covered(session, layer.id)
        session.layers.set(layer.id, visible=False)
        session.layers.add("look", look="gain", settings={"gain": [1, 1, 0.5]})
        session.layers.move(session.layers[-1].id, 0)
        made = calls(session)
        assert session.layers.blend_preview(layer.id, visible=True) is None and calls(session) == made
        assert session.layers.blend_preview(layer.id, opacity=0.5) is None, "and a hidden one shows nothing"


@pytest.mark.parametrize("change", [{"opacity": 0.5}, {"visible": False}])
def test_of_several_assets_each_layer_where_its_asset_stands(change: dict[str, Any], tmp_path: Path) -> None:
    for name, side in (("one.ply", 10), ("two.ply", 8)):
        write(tmp_path / name, asset(side))
    with flat(tmp_path / "one.ply", tmp_path / "scene.splatproj") as session:
        second = session.scene.add(tmp_path / "two.ply", placement=RIGHT)
        lower = session.layers.add("look", look="gain", settings={"gain": [0.5, 1, 1]}, asset=second.id)
        first = covered(session, paint(session))
        assert same_as_committed(session, first, **change) >= 10
        assert session.layers.blend_preview(lower.id, **change) is None, "nothing of its asset lies above"
        weights = np.zeros(len(session.splats), np.float32)
        weights[100:130] = 1
        session.layers.hide_selected(weights)
        assert same_as_committed(session, lower.id, **change) == 34


def test_the_first_slider_loads_no_painter() -> None:
    """Counted in modules: seconds would depend on the machine."""
    program = """
import sys
import numpy as np
from splatpainter.session import Session
from splatpainter.splats import Splats
one = np.ones((1, 3), np.float32)
session = Session(Splats(one, np.ones((1, 4), np.float32), one, one[:, 0], one[:, None]))
layer = session.layers.add("look", look="gain", settings={"gain": [1, 1, 0.5]})
before = set(sys.modules)
session.layers.set(layer.id, opacity=0.5)
print(*(set(sys.modules) - before))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert len(done.stdout.split()) < 6, done.stdout
