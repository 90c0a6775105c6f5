"""Pictures larger than the view that was rendered: taken as larger renders, edited where they differ from those and
from the view enlarged, whoever enlarged it; their detail arrives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.image_files import to_uint8, write_png
from splatpainter.painter import Painter
from splatpainter.pictures import edit_from_files
from splatpainter.pictures.larger_views import LARGER, larger_view
from splatpainter.rendering import render
from splatpainter.splats import SH_C0, Splats
from tests.support.cli_scenes import ball

SIDE = 96
NEAREST, LANCZOS, BOX = Image.Resampling.NEAREST, Image.Resampling.LANCZOS, Image.Resampling.BOX


@pytest.fixture(scope="module")
def splats() -> Splats:
    made = ball(1500, degree=0)
    colors = 0.5 + 0.4 * np.sign(np.sin(7 * made.means[:, :1] + 3 * made.means[:, 1:2]))
    return replace(made, sh=((colors.repeat(3, 1) - 0.5) / SH_C0)[:, None].astype(np.float32))


@pytest.fixture
def camera(splats: Splats, tmp_path: Path) -> Camera:
    (one,) = orbit_cameras(splats, 1, size=SIDE)
    (tmp_path / "cam.json").write_text(one.to_json())
    return one


def view(splats: Splats, camera: Camera) -> Image.Image:
    return Image.fromarray(to_uint8(np.clip(render(splats, camera).colors[0], 0, 1)))


def painted(picture: Image.Image) -> tuple[Image.Image, np.ndarray]:
    """(the picture with a disc of fine stripes on it, [H, W] where)."""
    pixels = np.asarray(picture).copy()
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]] / pixels.shape[0]
    disc = (y - 0.55) ** 2 + (x - 0.5) ** 2 < 0.15**2
    stripes = np.where((np.arange(pixels.shape[1]) // 2 % 2)[None, :, None] > 0, (230, 40, 20), (250, 220, 40))
    pixels[disc] = np.broadcast_to(stripes, pixels.shape)[disc]
    return Image.fromarray(pixels.astype(np.uint8)), disc


@pytest.mark.parametrize("case", [(2, NEAREST), (2, LANCZOS), (3, BOX), (1.5, LANCZOS), (2, None)])
def test_what_was_only_enlarged_counts_as_unedited(
    case: tuple[float, Image.Resampling | None], splats: Splats, camera: Camera, tmp_path: Path
) -> None:
    scale, kernel = case
    side = round(scale * SIDE)
    if kernel is None:  # a render of that size
        large = view(splats, camera.resized(side, side))
    else:
        large = view(splats, camera).resize((side, side), kernel)
    picture, disc = painted(large)
    picture.save(tmp_path / "picture.png")
    file = edit_from_files(tmp_path / "picture.png", tmp_path / "cam.json")
    assert file.notes == (f"{side}x{side}: a larger render of its view of {SIDE}x{SIDE}",)
    made = file.edit(splats)
    assert made.camera.width == side and made.camera.fx == pytest.approx(scale * camera.fx) and made.mask is not None
    assert (made.mask & disc).sum() > 0.99 * disc.sum() and (made.mask & ~disc).sum() < 0.03 * disc.sum()
    large.save(tmp_path / "same.png")
    untouched = edit_from_files(tmp_path / "same.png", tmp_path / "cam.json").edit(splats)
    assert untouched.mask is not None and not untouched.mask.any()
    with pytest.raises(ValueError, match="nothing to do"):
        Painter().apply(Painter().encode(splats), [untouched])


def test_its_detail_arrives(splats: Splats, camera: Camera, tmp_path: Path) -> None:
    picture, disc = painted(view(splats, camera).resize((2 * SIDE, 2 * SIDE), LANCZOS))
    picture.save(tmp_path / "picture.png")
    file = edit_from_files(tmp_path / "picture.png", tmp_path / "cam.json")
    asset, errors = Painter().encode(splats), []
    for source in (file, file.at_view()):
        edited = Painter().apply(asset, [source.edit(splats)]).splats
        after = np.clip(render(edited, camera.resized(2 * SIDE, 2 * SIDE)).colors[0], 0, 1)
        errors.append(((after - np.asarray(picture) / 255)[disc] ** 2).mean())
    assert errors[0] < 0.3 * errors[1]
    assert file.at_view().notes == (f"resampled from {2 * SIDE}x{2 * SIDE} to its camera's {SIDE}x{SIDE}",)
    assert file.edit(splats, "global").camera.width == SIDE  # a look has no detail


def test_masks_and_transparency_go_along(splats: Splats, camera: Camera, tmp_path: Path) -> None:
    picture, disc = painted(view(splats, camera).resize((2 * SIDE, 2 * SIDE), LANCZOS))
    layer = Image.fromarray(np.dstack([np.asarray(picture), 255 * disc.astype(np.uint8)]))
    layer.save(tmp_path / "layer.png")
    made = edit_from_files(tmp_path / "layer.png", tmp_path / "cam.json").edit(splats)
    assert made.mask is not None and not made.mask[~disc].any() and made.mask[disc].mean() > 0.97
    picture.save(tmp_path / "picture.png")
    write_png(tmp_path / "mask.png", np.full((SIDE, SIDE, 3), 1.0, np.float32))
    masked = edit_from_files(tmp_path / "picture.png", tmp_path / "cam.json", tmp_path / "mask.png")
    assert masked.mask is not None and masked.mask.shape == (2 * SIDE, 2 * SIDE) and masked.mask.all()


def test_a_picture_that_was_made_anew_is_edited_all_over(splats: Splats, camera: Camera, tmp_path: Path) -> None:
    large = np.asarray(view(splats, camera).resize((2 * SIDE, 2 * SIDE), LANCZOS)).astype(np.float32) / 255
    waves = 0.12 * np.sin(np.arange(2 * SIDE) / 5)[None, :, None]
    write_png(tmp_path / "picture.png", np.clip(large + waves, 0, 1))
    made = edit_from_files(tmp_path / "picture.png", tmp_path / "cam.json").edit(splats)
    assert made.mask is not None and made.mask.all()


def test_which_pictures_are_larger_views(camera: Camera) -> None:
    other = camera.resized(640, 360)
    for size, expected in (
        ((640, 360), None),
        ((660, 371), None),  # nearly the size: resampled
        ((320, 180), None),
        ((1280, 800), None),  # another shape
        ((1280, 720), (1280, 720)),
        ((1000, 562), (1000, 562)),
        ((1000, 563), (1000, 563)),
        ((8000, 4500), (LARGER.max_larger_px, 2304)),
    ):
        larger = larger_view(other, *size)
        assert (None if larger is None else (larger.width, larger.height)) == expected, size
    limited = larger_view(other, 1280, 720, 500_000)
    assert limited is not None and (limited.width, limited.height) == (942, 530)
    assert larger_view(other, 1280, 720, 250_000) is None
    tiny = larger_view(camera.resized(20, 20), 2000, 2000)
    assert tiny is not None and tiny.width == 160
