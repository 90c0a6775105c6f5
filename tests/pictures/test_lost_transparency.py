"""Opaque pictures over a ground of another program: their outline is no paint, what was painted is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.color import to_display
from splatpainter.gatekeeper.picture_gate import checked_picture
from splatpainter.pictures.edit_files import edit_from_files
from splatpainter.pictures.lost_transparency import GROUND_NOTE, without_its_ground
from splatpainter.splats import Splats
from tests.support.cli_scenes import ball

SIZE = 128
Y, X = np.mgrid[:SIZE, :SIZE]
GROUNDS = {
    "white": np.ones(3),
    "black": np.zeros(3),
    "checkerboard": np.where(((X // 8 + Y // 8) % 2 == 0)[..., None], 1.0, 0.8),
    "fine checkerboard": np.where(((X // 5 + (Y + 2) // 5) % 2 == 0)[..., None], 0.6, 0.4),
}
DAB = np.hypot(X - 60, Y - 66) < 12
CAMERA = look_at((0, 0, 4), (0, 0, 0), width=SIZE, height=SIZE, fov=40, background=(0.25, 0.25, 0.25))


@pytest.fixture(scope="module")
def asset() -> Splats:
    return ball(500)


def drawn(asset: Splats, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    out = sp.render(asset, camera)
    return np.clip(to_display(out.colors[0], asset.color_space), 0, 1), out.alphas[0].reshape(SIZE, SIZE)


def painted_over(asset: Splats, ground: np.ndarray) -> np.ndarray:
    """[H, W, 3] the view with a dab, flattened."""
    render, cover = drawn(asset, CAMERA)
    flat = render + (1 - cover[..., None]) * (ground - 0.25)
    return np.where(DAB[..., None], (0.9, 0.1, 0.6), flat)


@pytest.mark.parametrize("ground", GROUNDS.values(), ids=GROUNDS)
@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_what_a_flattened_picture_shows_of_its_ground_is_no_paint(
    tmp_path: Path, asset: Splats, ground: np.ndarray, ending: str
) -> None:
    path = tmp_path / f"a.{ending}"
    picture = painted_over(asset, ground)
    assert 0.02 < np.logical_and(drawn(asset, CAMERA)[1] > 0.02, drawn(asset, CAMERA)[1] < 0.98).mean()
    Image.fromarray((255 * picture + 0.5).astype(np.uint8)).save(path, quality=95)
    path.with_suffix(".json").write_text(CAMERA.to_json())
    source = checked_picture(edit_from_files(path), asset).source
    assert GROUND_NOTE in source.notes
    edit = source.edit(asset)
    changed = edit.mask if edit.mask is not None else np.abs(edit.image - drawn(asset, CAMERA)[0]).max(-1) > 0.02
    assert changed[DAB].mean() > 0.95 and changed[~DAB].mean() < 0.02


def test_other_backgrounds_are_what_they_were(asset: Splats) -> None:
    """The view's own, one that shades from side to side, and those of a negative and of a grade."""
    render, cover = drawn(asset, CAMERA)
    shaded = render + (1 - cover[..., None]) * (X / SIZE - 0.5)[..., None] * 0.4
    filled = np.where((Y > 80)[..., None], 0, render)  # its lower third painted black, asset and background
    background = np.asarray(CAMERA.background, np.float32)
    for picture in (painted_over(asset, np.full(3, 0.25)), shaded, filled, 1 - render, 0.5 * render + 0.4):
        assert without_its_ground(picture.astype(np.float32), render, cover, background, None) is None


def half_dark(asset: Splats) -> Splats:
    """A pale asset with a black lower half, as a bust on its pedestal."""
    sh = asset.sh.copy()
    sh[:] = 1.2
    sh[asset.means[:, 1] > 0] = -1.6
    return replace(asset, sh=sh)


@pytest.mark.parametrize(
    "graded",
    [lambda p: p * np.array([1.06, 1, 0.88]), lambda p: 0.06 + 0.94 * p, lambda p: np.clip(1.06 * p - 0.04, 0, 1)],
    ids=["warmer", "faded", "more contrast"],
)
def test_a_grade_is_no_lost_transparency(tmp_path: Path, asset: Splats, graded: Callable) -> None:
    """Dark parts hardly change, so that only the background seemed to be another."""
    splats = half_dark(asset)
    camera = look_at((0, 0, 4), (0, 0, 0), width=SIZE, height=SIZE, fov=40, background=(0.1, 0.3, 0.5))
    render = drawn(splats, camera)[0]
    path = tmp_path / "a.png"
    for dab in (np.zeros_like(DAB), DAB):
        picture = np.where(dab[..., None], (0.9, 0.1, 0.6), graded(render))
        Image.fromarray((255 * picture + 0.5).astype(np.uint8)).save(path)
        path.with_suffix(".json").write_text(camera.to_json())
        with pytest.raises(ValueError, match="most likely it is"):
            checked_picture(edit_from_files(path), splats)
