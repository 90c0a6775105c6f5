"""A light that is dragged: what is shown of it is what letting go then makes, and until then nothing has changed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.color import base_color
from splatpainter.io import write
from splatpainter.scene.placement import Placement
from splatpainter.session import Session
from tests.support.session_scenes import RED, dab
from tests.support.studio_scenes import ball

POINT = "0.3,-1.8,0.2,#ffe0b0,3"
SPHERE = "0.3,-1.8,0.2,0.4,#ffe0b0,3"


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return Session(ball(), tmp_path / "p.splatproj")


def dragged_colors(session: Session, layer: str, **change: Any) -> np.ndarray:
    """[N, 3] base colours during a drag, as its preview changes what is shown; nothing else may come of it."""
    before, steps = session.splats, len(session.history)
    preview = session.layers.color_preview(layer, **change)
    assert preview is not None
    ids, splats = preview
    assert splats.sh.shape == (len(ids), 1, 3) and (np.diff(ids) > 0).all()
    assert session.splats is before and len(session.history) == steps
    colors = base_color(before.sh[:, :1])
    colors[ids] = base_color(splats.sh)
    return colors


def off(session: Session, layer: str, **change: Any) -> float:
    """The largest difference of a base colour between a preview and what it then comes to."""
    colors, before = dragged_colors(session, layer, **change), base_color(session.splats.sh)
    session.layers.set(layer, **change)
    after = base_color(session.splats.sh)
    assert np.abs(after - before).max() > 0.02, "it is a change that can be seen"
    return float(np.abs(colors - after).max())


@pytest.mark.parametrize(
    "change",
    [
        {"rotate": 80.0},
        {"exposure": 0.7},
        {"sun": ("120,20",)},
        {"sun": ("60,30,#ff8040,3",)},
        {"point": (POINT,)},
        {"opacity": 0.4},
        {"add": True},
        {"hdri": "dawn", "opacity": 0.5, "shadows": False},
    ],
)
def test_a_drag_shows_what_letting_go_makes(session: Session, change: dict[str, Any]) -> None:
    layer = session.layers.add("light", hdri="sunset", sun=("60,30",)).id
    assert off(session, layer, **change) < 1e-5


def test_soft_shadows_come_back_when_it_is_let_go(session: Session) -> None:
    layer = session.layers.add("light", sphere=(SPHERE,), fill=0.1).id
    far = SPHERE.replace("0.3", "1.2", 1)
    assert 0 < off(session, layer, sphere=(far,)) < 0.35
    # Its soft shadow is at hand by now: what else is dragged is shown with it.
    assert off(session, layer, sphere=(far.replace("#ffe0b0,3", "#80a0ff,1"),)) < 1e-5
    wide = session.layers.add("light", sun=("60,30",), sun_size=40.0).id
    assert 0 < off(session, wide, sun=("150,30",)) < 0.35


def test_it_keeps_to_masks_selections_and_blends(session: Session) -> None:
    weights = np.linspace(0, 1, len(session.splats)).astype(np.float32)
    session.selections.save("ramp", weights)
    layer = session.layers.add("light", hdri="noon", blend="luminosity").id
    session.masks.set_selection(layer, weights)
    assert off(session, layer, sun=("30,50",), opacity=0.8) < 1e-5
    colors, below = dragged_colors(session, layer, exposure=2.0), base_color(session.layers.below(layer).sh)
    assert np.abs(colors - below)[weights == 0].max() == 0


def test_layers_above_stay_on_top(session: Session) -> None:
    layer = session.layers.add("light", hdri="noon").id
    session.layers.add("paint", [dab(RED, 20, radius=3)])
    above = session.splats
    ids, _ = session.layers.color_preview(layer, exposure=1.5) or (np.zeros(0, np.int64), None)
    session.layers.set(layer, exposure=1.5)
    same = np.flatnonzero((session.splats.sh[: len(above)] == above.sh[: len(session.splats)]).all((1, 2)))
    assert len(ids) and not np.isin(ids, same).any(), "what the stroke painted is not shown in another light"
    session.layers.add("look", look="gain", settings={"gain": [0.5, 1, 1]})
    assert session.layers.color_preview(layer, exposure=0.5) is None, "all of it is under another look"


def test_there_is_none_of_what_cannot_be_shown_at_a_glance(session: Session) -> None:
    paint = session.layers.new("Paint").id
    assert session.layers.color_preview(paint, opacity=0.5) is None
    layer = session.layers.add("light", hdri="noon").id
    session.layers.set(layer, visible=False)
    assert session.layers.color_preview(layer, exposure=1.0) is None
    with pytest.raises(ValueError, match="expected exposure from"):
        session.layers.color_preview(layer, exposure=99.0)


def test_of_a_scene_it_is_shown_where_the_asset_stands(session: Session, tmp_path: Path) -> None:
    write(tmp_path / "other.ply", ball(seed=3))
    session.scene.add(tmp_path / "other.ply", placement=Placement.of(move=(3, 0, 0), turn=(0, 0, 90), scale=0.5))
    other = session.scene.assets[1].id
    layer = session.layers.add("light", hdri="noon", asset=other).id
    ids, _ = session.layers.color_preview(layer, exposure=1.0) or (np.zeros(0, np.int64), None)
    assert set(np.round(session.splats.means[ids, 0] / 3).astype(int)) == {1}
    assert off(session, layer, exposure=1.0) < 1e-5


def test_a_project_holds_nothing_of_a_drag(session: Session, tmp_path: Path) -> None:
    layer = session.layers.add("light", hdri="noon").id
    stored = session.splats.sh.copy()
    for exposure in (0.5, 1.0, 1.5):
        dragged_colors(session, layer, exposure=exposure)
    # As after a kill: another process finds what was let go last.
    session._core.project.close()
    with Session(tmp_path / "p.splatproj") as again:
        assert (again.splats.sh == stored).all() and len(again.history) == 2
        assert "exposure" not in again.layers[0].operation.record()


def test_a_turn_of_the_lights_is_of_every_light_layer_and_stays_nowhere(session: Session) -> None:
    center = np.zeros(3)
    with pytest.raises(ValueError, match="no layer of light is visible"):
        session.layers.under_turned_lights(90.0, center)
    options = {"hdri": "sunset", "sun": ("60,30",), "point": (POINT,), "rotate": 20.0}
    layer = session.layers.add("light", **options).id
    before = session.splats
    same = session.layers.under_turned_lights(0.0, center)
    assert np.abs(same.sh - before.sh).max() < 0.01  # colours of 8 bits
    turned = session.layers.under_turned_lights(90.0, center)
    assert session.splats is before and len(session.history) == 2
    again = session.layers.under_turned_lights(360.0, center)
    assert np.abs(again.sh - same.sh).max() < 1e-4
    # By hand: y points down here, so that seen from above +x goes to +z, or to -z; the sun says which.
    x, y, z = (float(word) for word in POINT.split(",")[:3])
    hand = {"rotate": 110.0, "sun": ("150,30",), "point": (f"{-z:g},{y:g},{x:g},#ffe0b0,3",)}
    session.layers.set(layer, **hand)
    assert np.abs(session.splats.sh - turned.sh).max() < 0.01
