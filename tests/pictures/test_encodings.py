"""What storing a picture with loss does to it is no paint, and paint is told from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from splatpainter.pictures.encodings import Encoding, edited_in_encoded, guessed_encoding
from splatpainter.pictures.picture_reader import read_picture
from tests.support.distorted_pictures import drawn_scene

VIEW, ALPHA = drawn_scene(240)
LEVELS = (VIEW * 255).round().astype(np.uint8)
PAINT = np.hypot(*np.mgrid[-120:120, -120:120]) < 14
FILES = {
    "JPEG of quality 95": ("a.jpg", {"quality": 95}),
    "JPEG of quality 60": ("a.jpg", {"quality": 60}),
    "JPEG of quality 30, 4:4:4": ("a.jpg", {"quality": 30, "subsampling": 0}),
    "WebP of quality 80": ("a.webp", {"quality": 80}),
    "WebP of quality 20": ("a.webp", {"quality": 20}),
}
OTHER_WEBP = (8, 13, 15, 27, 45, 84)
"""Qualities between those that are tried first."""


def stored(folder: Path, name: str, pixels: np.ndarray, **settings: object) -> Path:
    Image.fromarray(pixels).save(folder / name, **settings)  # type: ignore[arg-type]
    return folder / name


def painted(color: tuple[int, int, int] = (230, 40, 30), opacity: float = 1.0) -> np.ndarray:
    mixed = LEVELS + opacity * PAINT[..., None] * (np.array(color) - LEVELS)
    return mixed.round().astype(np.uint8)


@pytest.mark.parametrize(("name", "settings"), FILES.values(), ids=FILES)
def test_loss_is_no_paint(name: str, settings: dict, tmp_path: Path) -> None:
    picture = read_picture(stored(tmp_path, name, LEVELS, **settings))
    assert picture.encoding is not None
    mask = edited_in_encoded(picture.colors, VIEW, ALPHA, picture.encoding)
    assert mask is not None and not mask.any()


@pytest.mark.parametrize("quality", OTHER_WEBP)
def test_a_webp_of_any_quality_is_no_paint(quality: int, tmp_path: Path) -> None:
    picture = read_picture(stored(tmp_path, "a.webp", LEVELS, quality=quality))
    assert picture.encoding is not None
    if quality < 50:  # above, what is lost hardly depends on it
        fitted = picture.encoding.fitted(picture.colors, VIEW, ALPHA)
        assert np.abs(picture.colors - fitted.applied(VIEW)).max() < 1e-6
    mask = edited_in_encoded(picture.colors, VIEW, ALPHA, picture.encoding)
    assert mask is not None and not mask.any()


@pytest.mark.parametrize(("name", "settings"), FILES.values(), ids=FILES)
@pytest.mark.parametrize(("opacity", "least"), [(1.0, 0.99), (0.3, 0.9)])
def test_paint_is_told_from_loss(name: str, settings: dict, opacity: float, least: float, tmp_path: Path) -> None:
    picture = read_picture(stored(tmp_path, name, painted(opacity=opacity), **settings))
    assert picture.encoding is not None
    mask = edited_in_encoded(picture.colors, VIEW, ALPHA, picture.encoding)
    assert mask is not None and mask[PAINT].mean() > least
    assert mask[~PAINT & (ALPHA > 0.5)].mean() < 0.03, "the blocks that the stroke shares with the rest"


def test_paint_over_most_of_a_view_leaves_the_rest(tmp_path: Path) -> None:
    order = np.flatnonzero(ALPHA.ravel() > 0.5)
    brush = np.zeros(ALPHA.size, bool)
    brush[order[: int(0.7 * len(order))]] = True
    brush = brush.reshape(ALPHA.shape)
    pixels = LEVELS.copy()
    pixels[brush] = (60, 140, 90)
    picture = read_picture(stored(tmp_path, "a.jpg", pixels, quality=70))
    assert picture.encoding is not None
    mask = edited_in_encoded(picture.colors, VIEW, ALPHA, picture.encoding)
    assert mask is not None and mask[brush].mean() > 0.99 and mask[~brush & (ALPHA > 0.5)].mean() < 0.1


@pytest.mark.parametrize("colors", [256, 48])
def test_a_palette_is_no_paint(colors: int, tmp_path: Path) -> None:
    Image.fromarray(LEVELS).quantize(colors).save(tmp_path / "a.png")
    picture = read_picture(tmp_path / "a.png")
    assert picture.encoding is not None and picture.encoding.kind == "palette"
    mask = edited_in_encoded(picture.colors, VIEW, ALPHA, picture.encoding)
    assert mask is not None and not mask.any()
    Image.fromarray(painted()).quantize(colors).save(tmp_path / "b.png")
    picture = read_picture(tmp_path / "b.png")
    assert picture.encoding is not None
    mask = edited_in_encoded(picture.colors, VIEW, ALPHA, picture.encoding)
    assert mask is not None and mask[PAINT].mean() > 0.99 and mask[~PAINT].mean() < 0.01


def again(name: str, folder: Path, **settings: object) -> np.ndarray:
    return read_picture(stored(folder, name, painted(), **settings)).colors


def test_loss_is_guessed_where_the_file_is_a_png(tmp_path: Path) -> None:
    """Saved as JPEG or WebP, opened, and saved as PNG; or shrunk and enlarged."""
    for picture, kind in (
        (again("a.jpg", tmp_path, quality=60), "JPEG"),
        (again("a.webp", tmp_path, quality=30), "WebP"),
        (Encoding("blur", "", {"radius": 1.0}).applied(painted() / 255), "blur"),
        (Encoding("blur", "", {"factor": 2}).applied(painted() / 255), "blur"),
    ):
        encoding = guessed_encoding(picture, VIEW, ALPHA)
        assert encoding is not None and encoding.kind == kind
        mask = edited_in_encoded(picture, VIEW, ALPHA, encoding)
        assert mask is not None and mask[PAINT].mean() > 0.95 and mask[~PAINT & (ALPHA > 0.5)].mean() < 0.04


def test_a_picture_without_loss_is_guessed_to_have_none() -> None:
    for colors in (LEVELS, painted()):
        assert guessed_encoding(colors.astype(np.float32) / 255, VIEW, ALPHA) is None


def test_what_was_made_anew_is_all_changed() -> None:
    """Strong colours everywhere: nothing is as storing the view would have made it."""
    anew = np.clip(1.2 - VIEW[..., ::-1], 0, 1).astype(np.float32)
    encoding = Encoding("JPEG", "JPEG of quality 80", {"quality": 80})
    assert edited_in_encoded(encoding.applied(anew), VIEW, ALPHA, encoding) is None


def test_lossless_webp_and_png_say_so(tmp_path: Path) -> None:
    assert read_picture(stored(tmp_path, "a.webp", LEVELS, lossless=True)).encoding is None
    assert read_picture(stored(tmp_path, "a.png", LEVELS)).encoding is None


@pytest.mark.parametrize(
    "filter",
    [ImageFilter.MedianFilter(5), ImageFilter.ModeFilter(5), ImageFilter.MinFilter(3), ImageFilter.MaxFilter(3)],
)
def test_a_rank_filter_over_all_of_it_is_no_paint(filter: ImageFilter.Filter) -> None:
    """Beside a dab; over a part it is meant."""
    picture = np.asarray(Image.fromarray(painted()).filter(filter), np.float32) / 255
    guess = guessed_encoding(picture, VIEW, ALPHA)
    assert guess is not None and guess.settings["size"] == filter.size  # type: ignore[attr-defined]
    upper = (np.arange(240) < 100)[:, None, None]
    part = np.where(upper, picture, LEVELS / np.float32(255))
    assert guessed_encoding(part.astype(np.float32), VIEW, ALPHA) is None


def test_a_median_over_three_fifths_was_used_by_hand() -> None:
    median = np.asarray(Image.fromarray(LEVELS).filter(ImageFilter.MedianFilter(3)), np.float32) / 255
    part = np.where((np.arange(240) < 150)[:, None, None], median, LEVELS / np.float32(255)).astype(np.float32)
    guess = guessed_encoding(part, VIEW, ALPHA)
    assert guess is None or "filter" not in guess.settings


@pytest.mark.parametrize("left", [0.5, 0.7, 0.9])
def test_burning_most_of_a_view_is_no_filter(left: float) -> None:
    """With a soft edge; darkening comes nearer to an erosion than to the render."""
    reach = np.clip((np.arange(240) - 75) / 12, 0, 1)[:, None, None]
    burnt = np.round(VIEW * (1 - (1 - left) * reach) * 255) / 255
    guess = guessed_encoding(burnt.astype(np.float32), VIEW, ALPHA)
    assert guess is None or "filter" not in guess.settings
