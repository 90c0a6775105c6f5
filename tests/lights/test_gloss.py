"""What is taken for a reflection: balls whose look from every side is an integral over the sky, matte and glossy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.color import linear_to_srgb, luminance
from splatpainter.lights.gloss import gloss_of
from splatpainter.lights.lamps import Sun
from splatpainter.lights.light_set import Lights, turned_sky
from splatpainter.lights.prepared import captured_light, lit_surface
from splatpainter.lights.relight import delight, relight
from splatpainter.lights.skies import sky
from splatpainter.lights.source_light import SourceLight
from splatpainter.splats import Splats
from splatpainter.transforms import sh_basis
from tests.support.glossy_balls import SIGHTS, captured, looks

NOON, SUNSET = sky("noon"), sky("sunset")


def views(splats: Splats) -> tuple[np.ndarray, np.ndarray]:
    """([N, V, 3] display colours along SIGHTS, [N, V] bool from where each can be seen)."""
    colors = 0.5 + np.einsum("vk,nkc->nvc", sh_basis(SIGHTS, 2), splats.sh.astype(np.float64))
    return np.clip(colors, 0, 1), splats.means @ SIGHTS.T < -0.1


def contrast(splats: Splats) -> float:
    """Deviation of luminance over lines of sight, over its mean."""
    colors, seen = views(splats)
    level = np.where(seen, luminance(colors), np.nan)
    return float(np.nanmean(np.nanstd(level, 1) / np.maximum(np.nanmean(level, 1), 0.02)))


def flat(splats: Splats) -> Splats:
    return replace(splats, sh=np.concatenate([splats.sh[:, :1], 0 * splats.sh[:, 1:]], 1))


@pytest.mark.parametrize("target", ["low sun", "sunset", "noon"])
@pytest.mark.parametrize("given", [True, False])
def test_a_matte_ball_with_the_noise_of_a_fit_gets_no_gloss(target: str, given: bool) -> None:
    splats = captured(NOON, 0, noise=0.06)
    lights = {"low sun": Lights(suns=(Sun(120, 12, intensity=2.0),), up="+y")}.get(target)
    lights = lights or Lights(sky=sky(target), rotate=70, up="+y")
    lit = relight(splats, lights, source=NOON if given else None).splats
    assert contrast(lit) < 1.25 * contrast(splats), "noise of the view dependence became gloss"


def test_gloss_is_found_in_what_is_glossy_alone() -> None:
    before = SourceLight(turned_sky(NOON, np.eye(3)), 0.0, "known")

    def gloss_at(gloss: float, noise: float, doubt: float = 0.0) -> float:
        splats = captured(NOON, gloss, noise)
        return float(gloss_of(splats, lit_surface(splats), replace(before, uncertainty=doubt)).mean())

    matte, glossy = gloss_at(0, 0.06), gloss_at(0.15, 0.06)
    assert matte < 0.002 and 0.02 < glossy < 0.12  # of 0.09: what is in doubt counts as matte
    assert gloss_at(0.15, 0.06, doubt=0.5) < 0.75 * glossy, "a doubtful light explains less"


def test_a_glossy_ball_keeps_its_highlight_and_moves_it() -> None:
    """Nearer to the integral under the new sky than with bands that only follow the brightness, or none."""
    splats = captured(NOON, 0.15)
    normals = splats.means / np.linalg.norm(splats.means, axis=1, keepdims=True)
    truth = np.clip(linear_to_srgb(looks(normals, SUNSET, 0.15)), 0, 1)
    lit = relight(splats, Lights(sky=SUNSET, up="+y"), source=NOON).splats

    def error(other: Splats) -> float:
        colors, seen = views(other)
        return float(((colors - truth)[seen] ** 2).mean())

    matte = relight(flat(splats), Lights(sky=SUNSET, up="+y"), source=NOON).splats
    assert error(lit) < 0.75 * error(matte) and error(lit) < 0.95 * error(flat(lit))
    assert 0.7 < contrast(lit) / contrast(captured(SUNSET, 0.15)) < 1.3


def test_an_estimated_light_is_no_worse_than_no_gloss() -> None:
    splats = captured(SUNSET, 0.15, noise=0.03)
    normals = splats.means / np.linalg.norm(splats.means, axis=1, keepdims=True)
    truth = np.clip(linear_to_srgb(looks(normals, NOON, 0.15)), 0, 1)
    assert captured_light(splats, up="+y").uncertainty > 0

    def error(lit: Splats) -> float:
        colors, seen = views(lit)
        return float(((colors - truth)[seen] ** 2).mean())

    lit = relight(splats, Lights(sky=NOON, up="+y")).splats
    assert error(lit) < 1.05 * error(flat(lit))


def test_what_neighbours_disagree_on_is_chance() -> None:
    """Noise of which a regression alone makes gloss in half of the neighbourhoods."""
    splats = captured(NOON, 0, noise=0.4)
    gloss = gloss_of(splats, lit_surface(splats), SourceLight(turned_sky(NOON, np.eye(3)), 0.0, "known"))
    assert (gloss > 0).mean() < 0.1


def test_white_light_is_mirrored_as_bright_as_it_falls() -> None:
    """The level of the captured light cannot be told from the material: twice as much of it is the same look."""
    splats, light = captured(NOON, 0.3), turned_sky(NOON, np.eye(3))
    # Bright enough that what is added to irradiances before one is divided by the other counts for nothing.
    once, twice = (delight(splats, source=SourceLight(level * light, 0.0, "known"), up="+y") for level in (4, 8))
    assert np.abs(views(once.splats)[0] - views(splats)[0]).max() > 0.1
    np.testing.assert_allclose(views(twice.splats)[0], views(once.splats)[0], atol=0.01)
