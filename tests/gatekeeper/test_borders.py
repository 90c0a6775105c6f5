"""Borders around pictures are no paint, and are called what they are; strokes along a picture's rim are no border."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.color import to_display
from splatpainter.gatekeeper.borders import BORDER_NOTE, border_of, border_or_strip
from splatpainter.gatekeeper.picture_gate import CheckedPicture, checked_picture
from splatpainter.gatekeeper.strips import strip_of
from splatpainter.pictures.edit_files import PictureFile, draw
from splatpainter.pictures.picture_reader import Picture
from splatpainter.splats import SH_C0, Splats
from tests.support.cli_scenes import ball
from tests.support.drawn_views import ALPHA, VIEW, eight_bits, over, top

SIZE = 160
DAB = np.s_[70:86, 74:94]


@cache
def close_up() -> tuple[Splats, Camera, np.ndarray, np.ndarray]:
    """(A ball with detail that fills its picture but for the corners, its camera, its view [H, W, 3], its alpha)."""
    splats = ball(6000)
    splats.sh[:, 0] = np.random.default_rng(0).uniform(-0.4, 0.4, (len(splats), 3)) / SH_C0
    camera = orbit_cameras(splats, 1, size=SIZE, background=(0.25, 0.25, 0.25))[0]
    camera = replace(camera, fx=camera.fx * 1.5, fy=camera.fy * 1.5)
    drawn, alpha = draw(splats, camera)
    return splats, camera, eight_bits(to_display(drawn, splats.color_space)), np.asarray(alpha, np.float32)


def framed(
    colors: np.ndarray, width: int, color: float | tuple[float, float, float] = 1.0, sides: str = "tblr"
) -> np.ndarray:
    out = np.array(colors, np.float32)
    for side, window in {
        "t": np.s_[:width],
        "b": np.s_[-width:],
        "l": np.s_[:, :width],
        "r": np.s_[:, -width:],
    }.items():
        if side in sides:
            out[window] = color
    return out


def jpeg(colors: np.ndarray) -> np.ndarray:
    file = io.BytesIO()
    Image.fromarray((colors * 255).round().astype(np.uint8)).save(file, "JPEG", quality=85)
    return np.asarray(Image.open(file).convert("RGB"), np.float32) / 255


def noisy(colors: np.ndarray) -> np.ndarray:
    return eight_bits(colors + np.random.default_rng(1).normal(0, 0.006, colors.shape) * (colors == 1))


FRAMES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "white": lambda p: framed(p, 8),
    "wide": lambda p: framed(p, 30, (0.9, 0.9, 0.88)),
    "a line": lambda p: framed(p, 1, 0.0),
    "letterbox": lambda p: framed(p, 22, 0.0, "tb"),
    "pillars": lambda p: framed(p, 40, 0.0, "lr"),
    "a corner": lambda p: framed(p, 12, 1.0, "rb"),
    "a line within white": lambda p: framed(framed(p, 12, 0.1), 10),
    "scanned": lambda p: noisy(framed(p, 10)),
    "JPEG": lambda p: jpeg(framed(p, 16)),
}


GREY = (0.25, 0.25, 0.25)
"""The background of `close_up`."""


def written(colors: np.ndarray, side: str, width: int, color: tuple[float, float, float]) -> np.ndarray:
    """A strip with dark words on it, clear of its edges."""
    out = framed(colors, width, color, side)
    band = out if side == "t" else out[::-1]
    band[4 : width - 4, 20:90:3] = 0.05
    return out


STRIPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "a film's lower bar": lambda p: framed(p, 24, 0.0, "b"),
    "a caption": lambda p: written(p, "b", 20, (1, 1, 1)),
    "a title bar": lambda p: written(p, "t", 16, (0.93, 0.93, 0.94)),
    "a bar of tasks": lambda p: written(p, "b", 18, (0.12, 0.12, 0.13)),
    "a scan's edge": lambda p: framed(p, 5, 0.04, "l"),
    "a scan's edge as JPEG": lambda p: jpeg(framed(p, 16, 0.98, "r")),
    "a wider canvas of the background": lambda p: framed(p, 20, GREY),
    "a letterbox of the background": lambda p: framed(p, 30, GREY, "tb"),
    "pillars of the background": lambda p: framed(p, 26, GREY, "lr"),
}
"""What no hand paints, but on one side alone, or in the background's colour."""


def checked(picture: np.ndarray, **policy: str) -> CheckedPicture:
    splats, camera, _, _ = close_up()
    size = camera.width, camera.height
    source = PictureFile(Path("framed.png"), Picture(eight_bits(picture), None), size, camera, None, ("as large",))
    return checked_picture(source, splats, **policy)  # type: ignore[arg-type]


def painted() -> np.ndarray:
    picture = close_up()[2].copy()
    picture[DAB] = (0.1, 0.8, 0.2)
    return picture


@pytest.mark.parametrize("name", FRAMES)
def test_a_border_is_named_before_anything_is_painted(name: str) -> None:
    with pytest.raises(ValueError, match=r"framed by a border of one colour.*--correct puts it right"):
        checked(FRAMES[name](painted()))


@pytest.mark.parametrize("name", FRAMES)
def test_correct_paints_what_it_frames(name: str) -> None:
    source = checked(FRAMES[name](painted()), policy="correct").source
    assert source.mask is not None and BORDER_NOTE in source.notes
    assert source.mask[DAB].mean() > 0.95
    dab = np.zeros(source.mask.shape, bool)
    dab[66:90, 70:98] = True
    different = np.abs(source.picture.colors - close_up()[2]).max(-1) > 0.03
    # The loss of JPEG on so much detail is another matter: what it alone changes is as much without a border.
    plain = 0.0
    if name == "JPEG":
        alone = checked(jpeg(painted()), policy="correct").source
        assert alone.mask is not None
        plain = ((np.abs(alone.picture.colors - close_up()[2]).max(-1) > 0.03) & alone.mask & ~dab).mean()
    assert (different & source.mask & ~dab).mean() < 0.005 + plain
    border = border_of(FRAMES[name](painted()), close_up()[2], close_up()[3])
    assert border is not None and not (different & source.mask)[border].any()


@pytest.mark.parametrize("name", STRIPS)
def test_a_strip_is_named_before_anything_is_painted(name: str) -> None:
    with pytest.raises(ValueError, match=r"framed by a border of one colour.*--correct puts it right"):
        checked(STRIPS[name](painted()))


@pytest.mark.parametrize("name", STRIPS)
def test_correct_leaves_a_strip_out(name: str) -> None:
    source = checked(STRIPS[name](painted()), policy="correct").source
    _, _, view, alpha = close_up()
    assert source.mask is not None and BORDER_NOTE in source.notes and source.mask[DAB].mean() > 0.95
    strip = strip_of(STRIPS[name](painted()), view, alpha)
    different = np.abs(source.picture.colors - view).max(-1) > 0.03
    assert strip is not None and strip.is_certain and not (different & source.mask)[strip.outside].any()


@pytest.mark.parametrize(
    ("color", "side", "is_remarked"),
    [(GREY, "t", True), (GREY, "l", True), ((0.6, 0.6, 0.62), "r", True), ((0.2, 0.5, 0.3), "b", False)],
)
def test_what_a_selection_of_one_side_fills_is_painted(
    color: tuple[float, float, float], side: str, is_remarked: bool
) -> None:
    """In a grey, as the background's, with a remark; a pigment is paint."""
    splats, _, view, _ = close_up()
    picture = framed(painted(), 24, color, side)
    out = checked(picture)
    assert bool(out.warning) == ("--correct leaves that out" in out.warning) == is_remarked
    assert BORDER_NOTE not in out.source.notes
    left_out = checked(picture, policy="correct").source.mask
    assert left_out is not None and left_out[DAB].mean() > 0.95
    edit = out.source.edit(splats)
    band = (np.abs(picture - view).max(-1) > 0.1) & (framed(np.zeros_like(view), 24, 1, side)[..., 0] > 0)
    assert edit.mask is None or edit.mask[band].mean() > 0.9
    assert (left_out[band].mean() < 0.1) == is_remarked


def test_a_band_whose_neighbourhood_is_painted_too_is_no_strip() -> None:
    """Black along one side, which goes on in strokes: somebody painted there."""
    _, _, view, alpha = close_up()
    picture = framed(view, 24, 0.0, "b")
    assert strip_of(picture, view, alpha) is not None
    picture[SIZE - 24 - 12 : SIZE - 24] = (0.8, 0.1, 0.1)
    assert strip_of(picture, view, alpha) is None


def test_force_paints_a_border() -> None:
    splats, _, _, alpha = close_up()
    mask = checked(framed(painted(), 8), policy="force").source.edit(splats).mask
    border = border_of(framed(painted(), 8), close_up()[2], alpha)
    assert border is not None and (mask is None or mask[border].mean() > 0.9)


def test_a_border_beside_the_asset_alone_costs_nothing() -> None:
    """It is left out with a note, in every mode: there was nothing to paint."""
    splats, camera, _, _ = close_up()
    far = replace(camera, fx=camera.fx / 2, fy=camera.fy / 2)
    drawn, _ = draw(splats, far)
    picture = eight_bits(to_display(drawn, splats.color_space))
    picture[76:84, 76:84] = (0.1, 0.8, 0.2)
    picture = framed(picture, 12)
    source = PictureFile(Path("framed.png"), Picture(picture, None), (SIZE, SIZE), far, None, ("as large",))
    for mode in ("local", "spread", "global"):
        out = checked_picture(source, splats, mode)
        assert not out.warning and BORDER_NOTE in out.source.notes
        edit = out.source.edit(splats, mode)
        assert edit.cover is None and np.abs(edit.image[:10] - edit.image[0, 0]).max() < 0.01
        assert np.abs(edit.image[0, 0] - 1).min() > 0.5
        assert mode != "global" or (edit.mask is not None and not edit.mask[:10].any() and edit.mask[80, 80])


def test_a_border_around_a_larger_picture_is_no_paint() -> None:
    splats, camera, _, _ = close_up()
    larger = camera.resized(2 * SIZE, 2 * SIZE)
    drawn, _ = draw(splats, larger)
    picture = framed(eight_bits(to_display(drawn, splats.color_space)), 24)
    picture[140:172, 148:188] = (0.1, 0.8, 0.2)
    source = PictureFile(
        Path("framed.png"), Picture(picture, None), (2 * SIZE, 2 * SIZE), larger, None, ("as large",), view=camera
    )
    with pytest.raises(ValueError, match="framed by a border"):
        checked_picture(source, splats)
    mask = checked_picture(source, splats, policy="correct").source.mask
    assert mask is not None and mask[SIZE // 2, SIZE // 2] and not mask[:8].any() and not mask[:, -8:].any()


PAINT: dict[str, np.ndarray] = {
    "nothing": VIEW,
    "a band along one side": framed(VIEW, 30, (0.2, 0.5, 0.3), "t"),
    "all one colour": np.full_like(VIEW, 0.4),
    "most of it": framed(VIEW, 100, (0.2, 0.5, 0.3)),
    "the background of another colour": np.where(ALPHA[..., None] > 0, VIEW, 1),
    "the asset alone": over(top(1.0), (0.2, 0.5, 0.3)),
    "bands of two colours": framed(framed(VIEW, 20, 0.9, "t"), 20, 0.1, "b"),
    "a stroke around the rim that stops": np.where(
        (np.arange(240) < 200)[None, :, None], framed(VIEW, 10, 0.9, "tb"), VIEW
    ),
    "graded": VIEW * 0.8,
    "a wavy stroke along one side": np.where(
        (np.arange(240)[:, None] < 26 + 5 * np.sin(np.arange(240) / 9))[..., None], 0.02, VIEW
    ),
    "a soft stroke along one side": VIEW * np.clip(np.abs(np.arange(240) - 20) / 14 - 0.4, 0, 1)[:, None, None],
    "black around": np.where((np.hypot(*(np.mgrid[:240, :240] - 120)) > 110)[..., None], 0.0, VIEW),
    "stripes": np.where((np.arange(240) % 40 < 20)[:, None, None], 0.95, VIEW),
    "the lower half black": framed(VIEW, 110, 0.0, "b"),
    "a band of pigment with words": written(VIEW, "b", 30, (0.5, 0.35, 0.1)),
}


@pytest.mark.parametrize("name", PAINT)
def test_paint_is_no_border(name: str) -> None:
    assert border_or_strip(eight_bits(PAINT[name]), VIEW, ALPHA) is None


def test_two_ends_that_were_erased_may_be_meant() -> None:
    erased = np.where((top(0.1) > 0) | ((top(1.0) > 0) & (top(0.8) == 0)), 0.25, VIEW)
    strip = border_or_strip(eight_bits(erased), VIEW, ALPHA)
    assert strip is None or not strip.is_certain


def test_handles_that_were_erased_are_no_border() -> None:
    """Each ends where the body begins, by itself."""
    y, x = np.mgrid[:240, :240]
    body = np.hypot(x - 120, y - 120) < 70
    handle = np.abs(np.hypot(np.abs(x - 120) - 66, y - 120) - 34) < 6
    cover = (body | handle).astype(np.float32)
    noise = np.random.default_rng(2).uniform(0.4, 0.9, (240, 240, 3))
    render = eight_bits(np.where(cover[..., None] > 0, noise, 0.25))
    erased = render.copy()
    erased[:, :50] = erased[:, -50:] = render[0, 0]
    assert (erased != render).any() and border_or_strip(erased, render, cover) is None


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (3, 3)])
def test_pictures_of_a_few_pixels(size: tuple[int, int]) -> None:
    for one, other in ((0.0, 1.0), (1.0, 1.0)):
        picture, render = np.full((*size, 3), one, np.float32), np.full((*size, 3), other, np.float32)
        assert border_or_strip(picture, render, np.ones(size, np.float32)) is None
