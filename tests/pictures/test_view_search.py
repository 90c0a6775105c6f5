"""Views are recognised without their camera: saved under a new name, in another format, elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera, look_at
from splatpainter.image_files import write_png
from splatpainter.pictures import edit_from_files
from splatpainter.pictures.view_search import NamedView, most_alike, thumbnail, views_in
from splatpainter.rendering import render
from splatpainter.splats import SH_C0
from tests.support.cli_scenes import ball

BACKGROUND = (0.2, 0.2, 0.2)


def camera_at(angle: float) -> Camera:
    eye = 3 * np.array([np.sin(angle), -0.3, -np.cos(angle)])
    return look_at(eye, (0, 0, 0), (0, -1, 0), width=96, height=72, fov=45, background=BACKGROUND)


ANGLES = (0.0, 1.2, 2.6)
SPLATS = ball()
SPLATS.sh[:, 0] = (0.5 + 0.45 * np.sin(3 * SPLATS.means) - 0.5) / SH_C0  # another face on each side
SHOTS = [np.clip(render(SPLATS, camera_at(angle)).colors[0], 0, 1) for angle in ANGLES]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for k, (angle, shot) in enumerate(zip(ANGLES, SHOTS, strict=True)):
        write_png(tmp_path / f"view_{k:03d}.png", shot, camera_at(angle))
    return tmp_path


def painted(k: int) -> Image.Image:
    pixels = (SHOTS[k] * 255).round().astype(np.uint8)
    pixels[24:44, 36:60] = (240, 220, 20)
    return Image.fromarray(pixels)


@pytest.mark.parametrize("name", ["final.png", "a.jpg", "b.webp", "c.tif"])
@pytest.mark.parametrize("k", [0, 1, 2])
def test_saved_as_under_another_name(name: str, k: int, folder: Path) -> None:
    painted(k).save(folder / name)
    file = edit_from_files(folder / name)
    assert np.array_equal(file.camera.world_to_camera, camera_at(ANGLES[k]).world_to_camera)
    assert file.notes[0] == f"has no camera: that of view_{k:03d}.png, which it matches"


def test_saved_elsewhere_and_at_another_size(folder: Path, tmp_path: Path) -> None:
    away = tmp_path / "away"
    away.mkdir()
    painted(1).resize((192, 144)).save(away / "a.jpg")
    with pytest.raises(ValueError, match="no camera in it, in a.json, or given with --camera, and no view beside it"):
        edit_from_files(away / "a.jpg")
    for file in (edit_from_files(away / "a.jpg", None, None, [folder]), edit_from_files(away / "a.jpg", folder)):
        assert np.array_equal(file.camera.world_to_camera, camera_at(ANGLES[1]).world_to_camera)


def test_views_whose_camera_lies_beside_them(folder: Path) -> None:
    for k in range(3):
        path = folder / f"view_{k:03d}.png"
        Image.open(path).convert("RGB").save(folder / f"view_{k:03d}.tif")
        path.with_suffix(".json").write_text(camera_at(ANGLES[k]).to_json())
        path.unlink()
    painted(2).save(folder / "a.png")
    assert np.array_equal(
        edit_from_files(folder / "a.png").camera.world_to_camera, camera_at(ANGLES[2]).world_to_camera
    )


def test_a_picture_of_something_else_matches_none(folder: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (72, 96, 3), np.uint8)
    Image.fromarray(noise).save(folder / "a.png")
    with pytest.raises(ValueError, match="none of 3 views beside it is like it"):
        edit_from_files(folder / "a.png")


@pytest.mark.parametrize("k", [0, 1, 2])
def test_a_developed_picture_is_like_its_view_but_for_its_tone(k: int, folder: Path) -> None:
    """darktable drops the camera and changes all colours: no view was found for the pictures that it is for."""
    pixels = np.asarray(painted(k)) / 255
    for name, graded in (("dark.jpg", 0.75 * pixels), ("warm.jpg", pixels * [1.15, 1, 0.8])):
        Image.fromarray((graded.clip(0, 1) * 255).round().astype(np.uint8)).save(folder / name, quality=92)
        file = edit_from_files(folder / name)
        assert np.array_equal(file.camera.world_to_camera, camera_at(ANGLES[k]).world_to_camera)


def test_a_picture_without_contrast_is_like_no_view(folder: Path) -> None:
    Image.fromarray((SHOTS[0] * 20 + 100).round().astype(np.uint8)).save(folder / "fog.png")
    with pytest.raises(ValueError, match="none of 3 views beside it is like it"):
        edit_from_files(folder / "fog.png")


def test_a_cropped_picture_says_the_shape_of_the_views(folder: Path) -> None:
    painted(0).crop((0, 0, 96, 60)).save(folder / "a.png")
    with pytest.raises(ValueError, match=r"no view beside it has its shape, 96x60 \(view_.*96x72: do not crop\)"):
        edit_from_files(folder / "a.png")


def test_views_that_are_alike_are_told_by_name() -> None:
    views = [NamedView(f"view_{k:03d}.png", camera_at(0.1 * k), thumbnail(SHOTS[0])) for k in range(3)]
    assert most_alike(SHOTS[0], views) is None
    named = most_alike(SHOTS[0], views, "view_001 final")
    assert named is not None and named.name == "view_001.png"
    assert most_alike(SHOTS[0], views, "view_0011") is None
    larger = replace(views[0], camera=views[0].camera.resized(192, 144), name="large.png")
    assert most_alike(SHOTS[0], [views[0], larger]) is not None, "one view of two sizes is one view"


def test_what_only_shares_its_background_is_not_alike() -> None:
    """Most of both is background: without looking at what they show, every view is like every other."""
    small = [np.full((72, 96, 3), 0.2, np.float32) for _ in range(2)]
    small[0][30:40, 40:50], small[1][30:40, 40:50] = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)
    assert most_alike(small[0], [NamedView("b", camera_at(0), thumbnail(small[1]))]) is None
    assert most_alike(small[0], [NamedView("a", camera_at(0), thumbnail(small[0]))]) is not None


def test_hostile_folders_are_passed_over(folder: Path) -> None:
    (folder / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nsplatpainter")
    (folder / "bad.png").write_bytes((folder / "view_000.png").read_bytes()[:200])
    (folder / "bad.json").write_text("no camera")
    (folder / "folder.png").mkdir()
    views = views_in([folder, folder / "none", folder / "bad.json"], (96, 72))
    assert sorted(view.name for view in views) == ["view_000.png", "view_001.png", "view_002.png"]
    assert views_in([folder], (50, 72)) == []
