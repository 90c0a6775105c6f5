"""Layers of light over one another: they add as light does, and fade as dimmers do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.color import base_color, sh_from_color, srgb_to_linear
from splatpainter.session import Session
from tests.support.session_scenes import RED, dab
from tests.support.studio_scenes import ball

SUN: dict[str, Any] = {"sun": ("60,30,#ffd0a0,0.4",), "fill": 0.0, "add": True}
LAMP: dict[str, Any] = {"point": ("0.3,-1.8,0.2,#a0c0ff,0.5",), "fill": 0.0, "add": True}
BRIGHT_SUN: dict[str, Any] = {**SUN, "sun": ("60,30,#ffd0a0,2",)}
EXACT = 2e-5
"""Of linear light: what float32 colours are read back to."""


@pytest.fixture
def session(tmp_path: Path) -> Session:
    """A grey ball that no light takes beyond what is limited."""
    dark = ball()
    sh = dark.sh.copy()
    sh[:, 0] = sh_from_color(0.25 + 0.1 * np.sin(3 * dark.means))
    return Session(replace(dark, sh=sh), tmp_path / "p.splatproj")


def light(session: Session) -> np.ndarray:
    """[N, 3] linear base colours."""
    return srgb_to_linear(np.maximum(base_color(session.splats.sh).astype(np.float64), 0))


def test_lights_that_are_added_are_the_sum_of_each(session: Session) -> None:
    dark = light(session)
    sun = session.layers.add("light", **SUN).id
    with_sun = light(session)
    lamp = session.layers.add("light", **LAMP).id
    both = light(session)
    session.layers.set(sun, visible=False)
    with_lamp = light(session)
    assert min(float((lit - dark).max()) for lit in (with_sun, with_lamp)) > 0.01
    np.testing.assert_allclose(both, with_sun + with_lamp - dark, atol=EXACT)
    # In the other order it is the same.
    session.layers.set(sun, visible=True)
    session.layers.move(lamp, 0)
    np.testing.assert_allclose(light(session), both, atol=EXACT)


def test_a_slider_of_a_light_is_a_dimmer(session: Session) -> None:
    dark = light(session)
    sun = session.layers.add("light", **SUN).id
    lamp = session.layers.add("light", **LAMP).id
    both = light(session)
    session.layers.set(sun, visible=False)
    with_lamp = light(session)
    session.layers.set(sun, visible=True, opacity=0.3)
    np.testing.assert_allclose(light(session), with_lamp + 0.3 * (both - with_lamp), atol=EXACT)
    # Masked, it is as much light as its weight says, whatever lies above.
    weights = np.linspace(0, 1, len(session.splats)).astype(np.float32)
    session.layers.set(sun, opacity=1.0)
    session.selections.save("ramp", weights)
    session.masks.set_selection(sun, weights)
    stored = np.round(weights * 255) / 255
    np.testing.assert_allclose(light(session), with_lamp + stored[:, None] * (both - with_lamp), atol=1e-3)
    session.layers.set(lamp, visible=False)
    np.testing.assert_allclose(light(session) - dark, stored[:, None] * (both - with_lamp), atol=1e-3)


def test_a_sky_takes_the_place_of_what_shines_below(session: Session) -> None:
    sky = session.layers.add("light", hdri="dawn", exposure=-1.0).id
    alone = light(session)
    sun = session.layers.add("light", **SUN).id
    session.layers.move(sun, 0)
    assert [layer.id for layer in session.layers] == [sun, sky]
    np.testing.assert_allclose(light(session), alone, atol=EXACT)


def test_what_is_changed_in_a_light_is_lit_further_as_the_rest_is(session: Session) -> None:
    """Looks and paint are seen as they were made, in the light below; another light then falls on them, too."""
    sun = session.layers.add("light", **BRIGHT_SUN).id
    with_sun = light(session)
    lamp = session.layers.add("light", **LAMP).id
    brighter = light(session) / with_sun
    look = session.layers.add("look", look="gain", settings={"gain": [0.8, 1, 1]}).id
    session.layers.move(look, 1)
    assert [layer.id for layer in session.layers] == [sun, look, lamp]
    lit = light(session)
    session.layers.set(lamp, visible=False)
    looked = light(session)
    assert float(np.abs(looked - with_sun).max()) > 0.01
    # The light before is estimated of other colours now, which moves it a little.
    gained, expected = lit - looked, looked * (brighter - 1)
    assert float(expected.max()) > 0.02
    assert float(np.abs(gained - expected).max()) < 0.1 * float(expected.max())
    assert float(np.abs(gained - expected).mean()) < 0.05 * float(expected.mean())
    # New Gaussians stand in the light of those that they were made of.
    paint = session.layers.new("Paint").id
    session.strokes.paint(paint, [dab(RED, 20, radius=3)])
    painted = light(session)
    assert len(painted) > len(lit)
    before_it = ",".join(f"{value:.4f}" for value in 2 * session.splats.means[len(lit) :].mean(0))
    above = session.layers.add("light", **{**LAMP, "point": (f"{before_it},#ffffff,0.5",)}).id
    gained = light(session) - painted
    assert float(gained[len(lit) :].max()) > 0.001 and gained.min() > -1e-4 and gained.max() < 1
    assert "on top of other lights" in session.layers.facts(above)["note"]


def test_a_drag_above_another_light_shows_what_letting_go_makes(session: Session) -> None:
    session.layers.add("light", **SUN)
    lamp = session.layers.add("light", **LAMP).id
    change = {"point": ("-0.3,-1.8,0.2,#a0c0ff,0.8",), "opacity": 0.6}
    preview = session.layers.color_preview(lamp, **change)
    assert preview is not None
    colors = base_color(session.splats.sh[:, :1])
    colors[preview[0]] = base_color(preview[1].sh)
    session.layers.set(lamp, **change)
    np.testing.assert_allclose(colors, base_color(session.splats.sh), atol=1e-5)


def test_lights_that_were_merged_fade_as_light(session: Session) -> None:
    dark = light(session)
    ids = [session.layers.add("light", **options).id for options in (SUN, LAMP)]
    both = light(session)
    merged = session.layers.merge(ids)
    session.layers.set(merged if isinstance(merged, str) else merged.id, opacity=0.5)
    np.testing.assert_allclose(light(session), (dark + both) / 2, atol=EXACT)
