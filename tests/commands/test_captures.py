"""`info`, `render`, `edit`, `studio` on folders that trainers leave, and cameras of captures by --camera FILE[:N]."""

from __future__ import annotations

import io
import json
import math
import shutil
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera, spherical_cameras
from splatpainter.image_files import find_camera, to_uint8
from splatpainter.io import read, write
from splatpainter.rendering import render
from splatpainter.session import Session
from splatpainter.splats import Splats
from tests.support.capture_folders import (
    Bend,
    angle_of,
    brown,
    opengl_pose,
    photograph,
    save_turned,
    write_colmap,
    write_inria,
    write_table,
)
from tests.support.cli_scenes import Capture, ball, listing, run

NAMES = ("IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg")
PAINTED = (56, 40, 72, 56)
"""A square on the ball, in photographs: left, top, right, bottom."""
EXPOSURE = np.array([0.7, 0.75, 0.6])
"""Of photographs, in linear light, over the asset's."""
LENS = (-0.2, 0.05, 0.004, -0.003)


def cameras_around(background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[Camera]:
    return spherical_cameras((0, 0, 0), 2.5, 3, size=128, fov=45, up=(0, -1, 0), backgrounds=[background])


def speckled() -> Splats:
    """The ball with a pattern of colours: bands and patches, by which pictures can be laid over each other."""
    splats = ball(6000, degree=0)
    x, y, z = splats.means.T
    shade = 0.25 * np.sign(np.sin(9 * x + 2) * np.sin(8 * y - 1) * np.sin(7 * z))
    sh = splats.sh.copy()
    sh[:, 0] += (shade[:, None] * [1.0, 0.7, 0.4]).astype(np.float32)
    return replace(splats, sh=sh)


def model(folder: Path, arguments: str = "sh_degree=0, white_background=False") -> Path:
    """A folder as INRIA's trainer leaves it; its last iteration is the speckled ball."""
    write_inria(folder, cameras_around(), NAMES, arguments, (900, 7000, 30000))
    for iteration in (900, 7000, 30000):
        write(
            folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply",
            ball(300) if iteration < 8000 else speckled(),
        )
    return folder


def last(folder: Path) -> Path:
    return folder / "point_cloud" / "iteration_30000" / "point_cloud.ply"


def drawn(camera: Camera) -> np.ndarray:
    return np.clip(render(speckled(), camera).colors[0], 0, 1)


def as_taken(camera: Camera, bend: Bend | None = None) -> np.ndarray:
    """uint8 [H, W, 3] what a photograph of the ball is: another exposure and balance, perhaps through a lens."""
    colors = drawn(camera) if bend is None else np.clip(photograph(drawn, camera, bend), 0, 1)
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4) * EXPOSURE
    return to_uint8(np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))


def taken_with(folder: Path, bend: Bend | None = None, orientation: int = 1) -> list[np.ndarray]:
    """Photographs, as files in a folder; their pixels as painting programs open them."""
    folder.mkdir(parents=True)
    for name, camera in zip(NAMES, cameras_around(), strict=True):
        save_turned(folder / name, as_taken(camera, bend), orientation)
    return [np.asarray(Image.open(folder / name)) for name in NAMES]


def painted(pixels: np.ndarray) -> np.ndarray:
    left, top, right, bottom = PAINTED
    out = pixels.copy()
    out[top:bottom, left:right] = (20, 90, 200)
    return out


def test_info_says_what_a_folder_holds(tmp_path: Path, capfd: Capture) -> None:
    folder = model(tmp_path / "garden", "images='images', source_path='/somewhere/data', sh_degree=3")
    taken_with(tmp_path / "data" / "images")
    by_file = run(capfd, "info", last(folder), "--json").json
    by_folder = run(capfd, "info", folder, "--json").json
    assert by_folder["sha256"] == by_file["sha256"] and by_folder["bytes"] == by_file["bytes"]
    assert by_folder["iterations"] == [900, 7000, 30000], "by number, not by name"
    assert by_folder["capture"] == {"cameras": 3, "photographs": 3}
    text = run(capfd, "info", folder)
    assert text.code == 0 and "iteration 30,000 (also there: 900, 7,000)" in text.out
    assert "3 of their photographs are there" in text.out
    (folder / "cameras.json").write_text("[7]")
    damaged = run(capfd, "info", folder)
    assert damaged.code == 0 and "cannot be read" in damaged.out and "camera 0" in damaged.out
    assert run(capfd, "info", folder / "point_cloud", "--json").json["sha256"] == by_file["sha256"]
    assert run(capfd, "info", last(folder).parent, "--json").json["sha256"] == by_file["sha256"]


def test_an_export_of_nerfstudio_is_its_ply(tmp_path: Path, capfd: Capture) -> None:
    (tmp_path / "splat").mkdir()
    write(tmp_path / "splat" / "splat.ply", ball(300))
    assert run(capfd, "info", tmp_path / "splat", "--json").json["rows"] == 300


@pytest.mark.parametrize(
    "name",
    [
        "point_cloud/iteration_best/point_cloud.ply",  # the only one, without a number
        "Point_Cloud/Iteration_7/Point_Cloud.PLY",
        "Splat.PLY",
        "Meta.json",
    ],
)
def test_an_assets_name_may_have_capitals(name: str, tmp_path: Path, capfd: Capture) -> None:
    """As disks of Windows and Macs take it."""
    file, rows = tmp_path / "run" / name, 300
    file.parent.mkdir(parents=True)
    if name == "Meta.json":
        write(tmp_path / "run" / "meta.json", ball(rows))
        (tmp_path / "run" / "meta.json").rename(file)
    else:
        write(tmp_path / "asset.ply", ball(rows))
        (tmp_path / "asset.ply").rename(file)
    assert run(capfd, "info", tmp_path / "run", "--json").json["rows"] == rows
    picture = tmp_path / "view.png"
    assert run(capfd, "render", tmp_path / "run", "--out", picture, "--size", "32").code == 0 and picture.exists()
    for embed in (True, False):
        project = tmp_path / f"own{embed}.splatproj"
        Session(tmp_path / "run", project, embed=embed).close()
        with Session(project) as session:
            assert len(session.splats) == rows


def test_folders_of_something_else_say_what_they_hold(tmp_path: Path, capfd: Capture) -> None:
    (tmp_path / "point_cloud" / "iteration_7").mkdir(parents=True)  # no PLY in it
    write(tmp_path / "b.ply", ball(300))
    line = run(capfd, "info", tmp_path).error
    assert "is a folder without meta.json" in line and "it holds b.ply: name one of them" in line
    (tmp_path / "project" / "exports" / "splat").mkdir(parents=True)
    write(tmp_path / "project" / "exports" / "splat" / "splat.ply", ball(300))
    assert "it holds exports/splat/splat.ply" in run(capfd, "info", tmp_path / "project").error


def test_a_folder_of_gsplats_trainer_means_its_last_ply(tmp_path: Path, capfd: Capture) -> None:
    """simple_trainer.py: RESULTS/ply/point_cloud_STEP.ply."""
    (tmp_path / "results" / "ply").mkdir(parents=True)
    for step in (6999, 29999, 899):
        write(tmp_path / "results" / "ply" / f"point_cloud_{step}.ply", ball(300 + step // 100))
    for path in (tmp_path / "results", tmp_path / "results" / "ply"):
        record = run(capfd, "info", path, "--json").json
        assert record["rows"] == 599 and record["iterations"] == [899, 6999, 29999]


Written = Callable[[Path], Path]


def by_inria(folder: Path) -> Path:
    return folder / "cameras.json"


def by_table(folder: Path) -> Path:
    return write_table(folder.with_name("data"), cameras_around(), NAMES)


def by_model(ending: str) -> Written:
    return lambda folder: write_colmap(
        folder.with_name("data") / "sparse" / "0", cameras_around(), NAMES, ending=ending
    )


def by_path(folder: Path) -> Path:
    path = folder.with_name("camera_path.json")
    entries = [
        {"camera_to_world": opengl_pose(c).ravel().tolist(), "fov": math.degrees(angle_of(c.fy, c.height))}
        for c in cameras_around()
    ]
    record = {"camera_type": "perspective", "render_width": 128, "render_height": 128, "camera_path": entries}
    path.write_text(json.dumps(record))
    return path


def in_a_parsers_frame(folder: Path) -> Path:
    """The asset turned, shifted and scaled as nerfstudio does, its table in the capture's own world."""
    turn = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]], float)
    turn[:, 3] = (0.5, -1, 2)
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": turn.tolist(), "scale": 0.25}))
    splats = read(last(folder))
    half = np.array([0.5, 0.5, 0.5, 0.5], np.float32)  # the quaternion of that turn
    w, x, y, z = half
    a, b, c, d = splats.quats.T
    quats = [w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c, w * c - x * d + y * a + z * b,
             w * d + x * c - y * b + z * a]  # fmt: skip
    moved = replace(
        splats,
        means=(0.25 * (splats.means @ turn[:, :3].T + turn[:, 3])).astype(np.float32),
        quats=np.stack(quats, 1).astype(np.float32),
        scales=0.25 * splats.scales,
    )
    write(last(folder), moved, overwrite=True)
    return by_table(folder)


WAYS: dict[str, Written] = {
    "inria": by_inria,
    "nerfstudio": by_table,
    "parsers frame": in_a_parsers_frame,
    "camera path": by_path,
    "colmap bin": by_model("bin"),
    "colmap txt": by_model("txt"),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_captures_cameras_see_what_the_cameras_themselves_see(way: str, tmp_path: Path, capfd: Capture) -> None:
    folder = model(tmp_path / "garden")
    file = WAYS[way](folder)
    done = run(capfd, "render", folder, "--out", tmp_path / "views", "--camera", file, "--json")
    assert done.code == 0, done.err
    assert len(done.json["views"]) == 3, "all of them"
    for k, camera in enumerate(cameras_around()):
        seen = np.asarray(Image.open(tmp_path / "views" / f"view_{k:03d}.png"), int)
        assert abs(seen - to_uint8(drawn(camera))).max() <= 1
        if way != "parsers frame":
            assert np.allclose(
                find_camera(tmp_path / "views" / f"view_{k:03d}.png").world_to_camera, camera.world_to_camera
            )
    one = run(capfd, "render", last(folder), "--out", tmp_path / "one", "--camera", f"{file}:2", "--size", 64, "--json")
    assert one.code == 0 and one.json["views"][0]["width"] == 64 and len(one.json["views"]) == 1


def test_a_white_background_is_that_of_the_training(tmp_path: Path, capfd: Capture) -> None:
    folder = model(tmp_path / "garden", "white_background=True")
    run(capfd, "render", folder, "--out", tmp_path / "v", "--camera", f"{folder}:IMG_2")
    assert np.asarray(Image.open(tmp_path / "v" / "view_000.png"))[0, 0].tolist() == [255, 255, 255]


def test_commands_of_one_view_say_how_to_choose(tmp_path: Path, capfd: Capture) -> None:
    folder = model(tmp_path / "garden")
    (tmp_path / "d.png").write_bytes(b"")
    cameras = folder / "cameras.json"
    before = listing(tmp_path)
    for words in (
        ("turntable", folder, "--out", tmp_path / "t.webp", "--camera", cameras),
        ("edit", folder, "--out", tmp_path / "o.ply", "--decal", tmp_path / "d.png", "--at", "9,9", "--width", "9%",
         "--camera", cameras),
        ("edit", folder, tmp_path / "d.png", "--out", tmp_path / "o.ply", "--camera", cameras),
    ):  # fmt: skip
        line = run(capfd, *words).error
        assert "has 3 cameras; choose one: cameras.json:N, N from 0 to 2 or a name (IMG_1.jpg" in line
    assert (
        "expected a view from 0 to 2"
        in run(capfd, "render", folder, "--out", tmp_path / "v", "--camera", f"{cameras}:9").error
    )
    assert "no such file" in run(capfd, "render", folder, "--out", tmp_path / "v", "--camera", "nothing.json:9").error
    assert listing(tmp_path) == before


def test_the_ply_in_a_folder_is_not_overwritten_by_its_folders_name(tmp_path: Path, capfd: Capture) -> None:
    folder = model(tmp_path / "garden")
    run(capfd, "render", folder, "--out", tmp_path / "v", "--views", 1)
    done = run(capfd, "edit", folder, tmp_path / "v" / "view_000.png", "--out", last(folder))
    assert "is the input itself" in done.error


# ---- photographs, painted on


def reached(before: Path, after: Path, camera: Camera) -> tuple[int, int]:
    """(pixels that changed in the painted square of a view, pixels that changed outside a margin around it: Gaussians
    of the ball reach over five pixels)."""
    one, other = (np.clip(render(read(path), camera).colors[0], 0, 1) for path in (before, after))
    moved = abs(one - other).max(-1) > 10 / 255
    left, top, right, bottom = PAINTED
    inside = moved[top:bottom, left:right].sum()
    moved[top - 12 : bottom + 12, left - 12 : right + 12] = False
    return int(inside), int(moved.sum())


@pytest.mark.parametrize("lens", ["none", "brown"])
@pytest.mark.parametrize("original", [True, False])
def test_only_the_paint_on_a_photograph_changes_the_asset(
    lens: str, original: bool, tmp_path: Path, capfd: Capture
) -> None:
    """The photograph has three quarters of the asset's light: none of that is painted, nor is the paint darkened."""
    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    bend = None if lens == "none" else brown(*LENS)
    pixels = taken_with(tmp_path / "data" / "images", bend)
    Image.fromarray(painted(pixels[0])).save(tmp_path / "IMG_1.jpg", quality=95)
    if not original:
        shutil.rmtree(tmp_path / "data" / "images")
    words: list[object] = ["edit", folder, tmp_path / "IMG_1.jpg", "--out", tmp_path / "new.ply", "--method", "lift"]
    if bend is not None:
        sparse = tmp_path / "data" / "sparse" / "0"
        words += [
            "--camera",
            write_colmap(sparse, cameras_around(), NAMES, ending="bin", model=(4, "OPENCV"), bend=LENS),
        ]
    done = run(capfd, *words, "--json")
    assert done.code == 0, done.err
    record = done.json
    assert record["verified"] and any("colours corrected by" in note for note in record["notes"])
    assert any("distortion" in note for note in record["notes"]) == (bend is not None)
    assert any("told from the render" in note for note in record["notes"]) != original
    inside, outside = reached(last(folder), tmp_path / "new.ply", cameras_around()[0])
    assert inside > 200 and outside == 0
    # the paint is 20, 90, 200 in the photograph: as bright as that of the asset would have been taken
    blue = np.clip(render(read(tmp_path / "new.ply"), cameras_around()[0]).colors[0], 0, 1)[44:52, 60:68].mean((0, 1))
    linear = ((np.array([20, 90, 200]) / 255 + 0.055) / 1.055) ** 2.4 / EXPOSURE
    expected = 1.055 * np.minimum(linear, 1) ** (1 / 2.4) - 0.055
    assert abs(blue - expected).max() < 0.06


@pytest.mark.parametrize("size", [64, 128, 256])
@pytest.mark.parametrize("strength", [0.5, 0.3])
def test_a_vignette_without_its_photograph_is_no_paint(
    size: int, strength: float, tmp_path: Path, capfd: Capture
) -> None:
    """Of a resized one 5,000 of 16,384 pixels were painted beside the paint; of one at half the size, without a
    vignette, 70 to 96 are, along edges."""
    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    picture = painted(taken_with(tmp_path / "data" / "images")[0]).astype(float)
    y, x = (np.mgrid[:128, :128] - 63.5) / 63.5
    shaded = Image.fromarray(to_uint8(picture / 255 * (1 - strength * (x * x + y * y) / 2)[..., None]))
    shaded.resize((size, size), Image.Resampling.LANCZOS).save(tmp_path / "IMG_1.jpg", quality=92)
    shutil.rmtree(tmp_path / "data" / "images")
    out = tmp_path / "new.ply"
    done = run(capfd, "edit", folder, tmp_path / "IMG_1.jpg", "--out", out, "--method", "lift", "--json")
    assert done.code == 0, done.err
    assert any("its vignette was taken back" in note for note in done.json["notes"])
    inside, outside = reached(last(folder), out, cameras_around()[0])
    assert inside > 200 and outside < (200 if size < 128 else 100)


def test_a_photograph_of_even_light_has_no_vignette(tmp_path: Path, capfd: Capture) -> None:
    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    picture = painted(taken_with(tmp_path / "data" / "images")[0])
    picture[:, 96:] = (picture[:, 96:] * 0.8).astype(np.uint8)  # a shadow along one side
    Image.fromarray(picture).save(tmp_path / "IMG_1.jpg", quality=92)
    shutil.rmtree(tmp_path / "data" / "images")
    out = tmp_path / "new.ply"
    done = run(capfd, "edit", folder, tmp_path / "IMG_1.jpg", "--out", out, "--method", "lift", "--json")
    assert done.code == 0 and not any("vignette" in note for note in done.json["notes"])


@pytest.mark.parametrize("saved_as", ["IMG_1.png", "IMG_1.jpg"])
def test_thin_strokes_on_a_photograph_are_no_tone(saved_as: str, tmp_path: Path, capfd: Capture) -> None:
    """Lines leave nearly all of it to one function of colour, its exposure: which is not what was painted."""
    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    pixels = taken_with(tmp_path / "data" / "images")
    lines = pixels[0].copy()
    lines[62:64, 44:84] = (20, 90, 200)
    Image.fromarray(lines).save(tmp_path / saved_as, quality=92)  # which PNG ignores
    done = run(capfd, "edit", folder, tmp_path / saved_as, "--out", tmp_path / "new.ply", "--json")
    assert done.code == 0, done.err
    notes = done.json["notes"]
    assert any("colours corrected by" in note for note in notes) and not any("tone" in note for note in notes)
    before, after = (
        np.clip(render(read(path), cameras_around()[0]).colors[0], 0, 1)
        for path in (last(folder), tmp_path / "new.ply")
    )
    moved = abs(before - after).max(-1) > 10 / 255
    assert moved[62:64, 50:78].mean() > 0.9 and not moved[:34].any() and not moved[92:].any()


def test_a_mask_on_the_photograph_says_what_is_paint(tmp_path: Path, capfd: Capture) -> None:
    folder = model(tmp_path / "garden")
    pixels = as_taken(cameras_around()[1], brown(*LENS))
    Image.fromarray(painted(pixels)).save(tmp_path / "other name.png")
    marked = np.zeros((128, 128), np.uint8)
    left, top, right, bottom = PAINTED
    marked[top:bottom, left:right] = 255
    Image.fromarray(marked).save(tmp_path / "mask.png")
    sparse = tmp_path / "data" / "sparse" / "0"
    write_colmap(sparse, cameras_around(), NAMES, ending="txt", model=(4, "OPENCV"), bend=LENS)
    done = run(
        capfd, "edit", folder, tmp_path / "other name.png", "--camera", f"{sparse}:IMG_2.jpg", "--mask",
        tmp_path / "mask.png", "--out", tmp_path / "new.ply", "--json",
    )  # fmt: skip
    assert done.code == 0, done.err
    inside, outside = reached(last(folder), tmp_path / "new.ply", cameras_around()[1])
    assert inside > 200 and outside == 0


@pytest.mark.parametrize("exif_stays", [True, False])
def test_a_photograph_that_exif_turns(exif_stays: bool, tmp_path: Path, capfd: Capture) -> None:
    """A program turns the pixels and drops the orientation (False), or leaves both as they are (True)."""
    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    pixels = taken_with(tmp_path / "data" / "images", orientation=6)
    if exif_stays:
        save_turned(tmp_path / "IMG_1.jpg", painted(pixels[0]), 6)
    else:
        Image.fromarray(np.ascontiguousarray(np.rot90(painted(pixels[0]), -1))).save(tmp_path / "IMG_1.jpg", quality=95)
    done = run(capfd, "edit", folder, tmp_path / "IMG_1.jpg", "--out", tmp_path / "new.ply", "--json")
    assert done.code == 0, done.err
    inside, outside = reached(last(folder), tmp_path / "new.ply", cameras_around()[0])
    assert inside > 200 and outside == 0


@pytest.mark.parametrize("mode", ["local", "global"])
@pytest.mark.parametrize("original", ["none", "as seen", "turned"])
def test_a_photograph_that_is_upside_down_is_turned(original: str, mode: str, tmp_path: Path, capfd: Capture) -> None:
    """No shape and no EXIF tells a half turn: the photograph as it was taken does, or the asset. "turned": a program
    turned the capture's photographs before it looked for their cameras."""
    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    images = tmp_path / "data" / "images"
    pixels = taken_with(images)[0]
    if original == "turned":
        save_turned(images / NAMES[0], np.ascontiguousarray(pixels[::-1, ::-1]), 3)
        pixels = np.asarray(Image.open(images / NAMES[0]))[::-1, ::-1]
    picture = painted(pixels) if mode == "local" else (pixels * np.array([0.8, 0.9, 1.0])).astype(np.uint8)
    saved = picture if original == "turned" else np.ascontiguousarray(picture[::-1, ::-1])
    Image.fromarray(saved).save(tmp_path / "IMG_1.png")
    if original == "none":
        shutil.rmtree(images)
    words = ("edit", folder, tmp_path / "IMG_1.png", "--mode", mode, "--method", "lift", "--json")
    done = run(capfd, *words, "--out", tmp_path / "new.ply")
    assert done.code == 0, done.err
    turned = [note for note in done.json["notes"] if "turned by 180 degrees" in note]
    assert len(turned) == 1 and ("as the photograph was taken" in turned[0]) == (original == "as seen")
    camera = cameras_around()[0]
    if mode == "local":
        inside, outside = reached(last(folder), tmp_path / "new.ply", camera)
        assert inside > 200 and outside == 0
    elif original != "none":
        before, after = (np.clip(render(read(p), camera).colors[0], 0, 1) for p in (last(folder), tmp_path / "new.ply"))
        seen = before.max(-1) > 0.2
        assert abs(after[seen].mean(0) / before[seen].mean(0) - [0.8, 0.9, 1.0]).max() < 0.05


def test_a_regraded_photograph_is_a_look_of_its_change_alone(tmp_path: Path, capfd: Capture) -> None:
    """Twice as blue as the photograph was: that, and not the photograph's own exposure, becomes the asset's."""
    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    pixels = taken_with(tmp_path / "data" / "images")
    bluer = pixels[0] * np.array([0.8, 0.9, 1.0])
    Image.fromarray(bluer.astype(np.uint8)).save(tmp_path / "IMG_1.jpg", quality=97)
    words = ("--mode", "global", "--method", "lift", "--json")
    done = run(capfd, "edit", folder, tmp_path / "IMG_1.jpg", "--out", tmp_path / "new.ply", *words)
    assert done.code == 0, done.err
    camera = cameras_around()[0]
    before, after = (np.clip(render(read(p), camera).colors[0], 0, 1) for p in (last(folder), tmp_path / "new.ply"))
    ball_pixels = before.max(-1) > 0.2
    ratio = after[ball_pixels].mean(0) / before[ball_pixels].mean(0)
    assert abs(ratio - [0.8, 0.9, 1.0]).max() < 0.05


def test_one_capture_serves_several_photographs(tmp_path: Path, capfd: Capture) -> None:
    folder = model(tmp_path / "garden")
    for k, camera in enumerate(cameras_around()[:2]):
        Image.fromarray(painted(as_taken(camera))).save(tmp_path / f"IMG_{k + 1}.png")
    both = [tmp_path / "IMG_2.png", tmp_path / "IMG_1.png"]
    done = run(capfd, "edit", folder, *both, "--camera", by_table(folder), "--out", tmp_path / "new.ply", "--json")
    assert done.code == 0, done.err
    for camera in cameras_around()[:2]:
        assert reached(last(folder), tmp_path / "new.ply", camera)[0] > 200


def test_what_is_no_painted_photograph_is_refused_in_a_line(tmp_path: Path, capfd: Capture) -> None:
    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    pixels = taken_with(tmp_path / "data" / "images")
    for name in ("IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg", "stranger.jpg", "wide.jpg"):
        shutil.copy(tmp_path / "data" / "images" / "IMG_1.jpg", tmp_path / name)
    Image.fromarray(pixels[1]).save(tmp_path / "IMG_2.jpg", quality=60)
    Image.fromarray((pixels[2] * 0.8).astype(np.uint8)).save(tmp_path / "IMG_3.jpg", quality=95)
    Image.fromarray(painted(pixels[0])[:60]).save(tmp_path / "wide.jpg")
    before = listing(tmp_path)
    for name, more, problem in (
        ("IMG_1.jpg", (), "as it was taken; nothing is painted on it"),
        ("IMG_2.jpg", (), "as it was taken; nothing is painted on it"),
        ("IMG_3.jpg", (), "nearly everywhere"),
        ("stranger.jpg", (), "no camera"),
        ("wide.jpg", ("--camera", f"{folder}:0"), "aspect ratio of its camera (128x128), got 128x60"),
    ):
        line = run(capfd, "edit", folder, tmp_path / name, "--out", tmp_path / "new.ply", *more).error
        assert problem in line, (name, line)
    shutil.rmtree(tmp_path / "data")
    noise = np.random.default_rng(1).integers(0, 256, (16, 16, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    Image.fromarray(noise).save(tmp_path / "IMG_2.jpg")
    line = run(capfd, "edit", folder, tmp_path / "IMG_2.jpg", "--out", tmp_path / "new.ply").error
    assert "its edges agree by" in line and "is it of that view" in line
    assert "no paint" in run(capfd, "edit", folder, tmp_path / "IMG_1.jpg", "--out", tmp_path / "new.ply").error
    assert [name for name in before if "data" not in str(name)] == list(listing(tmp_path))


def test_a_painted_render_of_a_captures_camera_stays_one(tmp_path: Path, capfd: Capture) -> None:
    """Also after a program that keeps no camera: what is nearer to the render than to the photograph was painted on
    it."""
    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    taken_with(tmp_path / "data" / "images")
    run(capfd, "render", folder, "--out", tmp_path / "v", "--camera", f"{folder}:0")
    with Image.open(tmp_path / "v" / "view_000.png") as image:
        pixels = painted(np.asarray(image.convert("RGB")))
    Image.fromarray(pixels).save(tmp_path / "IMG_1.png")
    done = run(capfd, "edit", folder, tmp_path / "IMG_1.png", "--out", tmp_path / "new.ply", "--json")
    assert done.code == 0, done.err
    assert not any("corrected" in note for note in done.json["notes"])
    inside, outside = reached(last(folder), tmp_path / "new.ply", cameras_around()[0])
    assert inside > 200 and outside == 0
    seen = np.clip(render(read(tmp_path / "new.ply"), cameras_around()[0]).colors[0], 0, 1)[44:52, 60:68].mean((0, 1))
    assert abs(seen - np.array([20, 90, 200]) / 255).max() < 0.04


def test_the_studio_opens_a_folder(tmp_path: Path) -> None:
    pytest.importorskip("uvicorn")
    from splatpainter.server.launch import open_session

    folder = model(tmp_path / "garden")
    session, name = open_session(folder, tmp_path / "projects")
    with session:
        assert name == "garden" and len(session.splats) == 6000
        assert session.splats.sha256 == read(last(folder)).sha256


def test_the_studio_takes_a_painted_photograph_by_its_name(tmp_path: Path) -> None:
    pytest.importorskip("uvicorn")
    from splatpainter.server.launch import open_session
    from splatpainter.server.studio import Studio, StudioOptions
    from tests.support.studio_scenes import live

    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    pixels = taken_with(tmp_path / "data" / "images")
    buffers = [io.BytesIO(), io.BytesIO()]
    for picture, buffer in zip((painted(pixels[0]), pixels[0]), buffers, strict=True):
        Image.fromarray(picture).save(buffer, "JPEG", quality=95)
    session, name = open_session(folder, tmp_path / "projects")
    with live(Studio(session, name, StudioOptions(None, tmp_path / "projects"))) as studio:
        checked = studio.post("picture.check", picture=studio.send(buffers[0].getvalue(), "IMG_1.jpg"))
        assert checked["camera_source"] == "capture" and 0.01 < checked["share"] < 0.05
        assert any("colours corrected by" in note for note in checked["notes"])
        assert np.allclose(checked["camera"]["world_to_camera"], cameras_around()[0].world_to_camera)
        bare = studio.http.post(
            "/api/do/picture.check", json={"picture": studio.send(buffers[1].getvalue(), "IMG_1.jpg")}
        )
        assert bare.status_code == 400 and "IMG_1.jpg: is" in bare.text and "nothing is painted on it" in bare.text


def test_a_photograph_saved_into_a_watched_folder_is_lifted(tmp_path: Path, capfd: Capture) -> None:
    folder = model(tmp_path / "garden", "source_path='/somewhere/data'")
    pixels = taken_with(tmp_path / "data" / "images")
    (tmp_path / "saved").mkdir()
    timer = threading.Timer(
        0.5, lambda: Image.fromarray(painted(pixels[0])).save(tmp_path / "saved" / "IMG_1.jpg", quality=95)
    )
    timer.start()
    out = tmp_path / "new.ply"
    done = run(capfd, "watch", tmp_path / "saved", "--asset", folder, "--out", out, "--once", "--timeout", 60)
    timer.join()
    assert done.code == 0, done.err
    inside, outside = reached(last(folder), out, cameras_around()[0])
    assert inside > 200 and outside == 0
