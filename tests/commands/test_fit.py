"""`splatpainter fit` from every kind of source, and what it says to bad ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import spherical_cameras
from splatpainter.image_files import to_uint8, write_png
from splatpainter.io import read
from splatpainter.rendering import render
from tests.support.cli_scenes import Capture, ball, listing, run, saved
from tests.support.far_assets import UTM, far_ply, moved_camera

SMALL = ("--steps", 60, "--rows", 400, "--size", 40, "--sh-degree", 0, "--json")
FEW = (*SMALL, "--views", 6, "--held-out", 2)


def cone(path: Path) -> Path:
    """An OBJ: wide at the bottom (y = -1), a tip at the top (y = 1)."""
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    lines = ["v 0 1 0", "v 0 -1 0", *(f"v {0.7 * np.cos(t):.5f} -1 {0.7 * np.sin(t):.5f}" for t in turns)]
    for k in range(24):
        a, b = 3 + k, 3 + (k + 1) % 24
        lines += [f"f 1 {b} {a}", f"f 2 {a} {b}"]
    path.write_text("\n".join(lines) + "\n")
    return path


def pictures(folder: Path, count: int = 10) -> list:
    """Cameras around the ball, and its pictures with the camera inside."""
    folder.mkdir()
    cameras = spherical_cameras((0, 0, 0), 4, count, size=40, fov=40, up=(0, -1, 0), backgrounds=[(0.1, 0.2, 0.3)])
    for k, camera in enumerate(cameras):
        write_png(folder / f"view_{k:03d}.png", render(ball(), camera).colors[0], camera)
    return cameras


def upper_cap_is_red(path: Path) -> bool:
    """As on the ball: around -y, and nowhere else."""
    splats = read(path)
    red = splats.sh[:, 0, 0] - splats.sh[:, 0, 1] > 0.5
    return bool(red.any()) and splats.means[red & (splats.opacities > 0.3), 1].max() < -0.3


def test_an_asset_is_fitted_to_its_own_renders(tmp_path: Path, capfd: Capture) -> None:
    asset = saved(tmp_path / "ball.ply")
    done = run(capfd, "fit", asset, "--out", tmp_path / "again.ply", *FEW).json
    assert done["source"]["kind"] == "asset" and done["views"] == {"training": 6, "held_out": 2}
    assert done["psnr"]["training"] > 16 and done["psnr"]["held_out"] > 19  # the first Gaussians: 14.1 and 17
    splats = read(tmp_path / "again.ply")
    assert len(splats) == done["output"]["rows"] and done["output"]["first_rows"] == 400 and splats.sh_degree == 0
    assert upper_cap_is_red(tmp_path / "again.ply")
    fixed = run(capfd, "fit", asset, "--out", tmp_path / "fixed.splat", *FEW, "--fixed").json
    assert fixed["output"]["rows"] == 400 and fixed["output"]["format"] == "splat"


@pytest.mark.parametrize("truth", ["surfels", "traced"])
def test_a_mesh_is_turned_to_y_down(truth: str, tmp_path: Path, capfd: Capture) -> None:
    if truth == "traced":
        pytest.importorskip("mitsuba")
    mesh = cone(tmp_path / "cone.obj")
    more = ("--surfels", 4000, "--truth", truth, "--samples", 4)
    done = run(capfd, "fit", mesh, "--out", tmp_path / "cone.ply", *FEW, *more).json
    assert done["source"]["kind"] == "mesh" and done["psnr"]["training"] > 15
    means = read(tmp_path / "cone.ply").means
    tip, foot = (np.hypot(*means[side][:, [0, 2]].T) for side in (means[:, 1] < -0.5, means[:, 1] > 0.5))
    assert len(tip) and np.quantile(tip, 0.8) < 0.5 * np.quantile(foot, 0.8)


def test_pictures_that_carry_their_camera(tmp_path: Path, capfd: Capture) -> None:
    pictures(tmp_path / "views")
    done = run(capfd, "fit", tmp_path / "views", "--out", tmp_path / "ball.ply", *SMALL)
    assert done.code == 0 and "random points" in done.err
    record = json.loads(done.out)
    assert record["source"]["kind"] == "pictures" and record["views"] == {"training": 8, "held_out": 2}
    assert record["psnr"]["training"] > 18
    first = read(tmp_path / "ball.ply").means
    assert np.quantile(np.linalg.norm(first, axis=1), 0.9) < 1.4, "carved to about the ball of radius 1"


@pytest.mark.parametrize("optics", ["angle", "focal", "white"])
def test_a_nerf_style_table(optics: str, tmp_path: Path, capfd: Capture) -> None:
    """Matrices written here from their definition: columns right, up, backward, eye; pictures with transparency,
    or before one colour, which is no fog of that colour then."""
    cameras = pictures(tmp_path / "views")
    frames = []
    for k, camera in enumerate(cameras):
        right, down, forward = camera.world_to_camera[:3, :3]
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, -down, -forward, camera.position], 1)
        drawn = render(ball(), camera)
        alpha = drawn.alphas[0]
        colors = np.clip((drawn.colors[0] - (1 - alpha) * camera.background) / np.maximum(alpha, 1e-3), 0, 1)
        (tmp_path / "views" / f"view_{k:03d}.png").unlink()
        parts = [colors * alpha + 1 - alpha] if optics == "white" else [colors, alpha]
        Image.fromarray(to_uint8(np.concatenate(parts, 2))).save(tmp_path / "views" / f"r_{k}.png")
        frames.append({"file_path": f"./r_{k}", "transform_matrix": matrix.tolist()})
    focal = cameras[0].fx
    angle = {"camera_angle_x": 2 * np.arctan(20 / focal)}
    lens = {"fl_x": 2 * focal, "fl_y": 2 * focal, "cx": 40, "cy": 40, "w": 80, "h": 80}  # of twice the size
    table = {**(angle if optics == "angle" else lens), "frames": frames}
    (tmp_path / "views" / "transforms.json").write_text(json.dumps(table))
    done = run(capfd, "fit", tmp_path / "views", "--out", tmp_path / "ball.ply", *SMALL)
    assert done.code == 0 and json.loads(done.out)["psnr"]["training"] > 18
    assert upper_cap_is_red(tmp_path / "ball.ply")
    corners = render(read(tmp_path / "ball.ply"), cameras).alphas[:, ::39, ::39]
    assert corners.shape[1:3] == (2, 2) and corners.mean() < 0.1, "no fog"


def test_people_get_lines(tmp_path: Path, capfd: Capture) -> None:
    asset = saved(tmp_path / "ball.ply")
    words = [word for word in FEW if word != "--json"]
    done = run(capfd, "fit", asset, "--out", tmp_path / "again.spz", *words)
    assert (done.code, done.err) == (0, "")
    assert "Gaussians from 400" in done.out and "training views" in done.out and "held-out views" in done.out


def test_bad_input_is_one_line_and_writes_nothing(tmp_path: Path, capfd: Capture) -> None:
    asset = saved(tmp_path / "ball.ply")
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.obj").write_text("no faces here\n")
    cameras = pictures(tmp_path / "views", 2)
    shutil.copytree(tmp_path / "views", tmp_path / "one")
    (tmp_path / "one" / "view_001.png").unlink()
    (tmp_path / "bare").mkdir()
    Image.new("RGB", (40, 40)).save(tmp_path / "bare" / "a.png")
    for name, text in {
        "broken": "{",
        "frameless": "{}",
        "listed": "[1]",
        "missing": json.dumps({"frames": [{}]}),
    }.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "transforms.json").write_text(text)
    (tmp_path / "bent").mkdir()
    write_png(tmp_path / "bent" / "a.png", np.zeros((8, 8, 3)))
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "camera_model": "ORTHOPHOTO"}
    (tmp_path / "bent" / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": [frame, frame]}))
    wide = tmp_path / "wide"
    wide.mkdir()
    write_png(wide / "a.png", np.zeros((40, 60, 3)), cameras[0])
    before = listing(tmp_path)
    for source, more, pattern in (
        ("nothing.glb", (), "no such file or folder"),
        ("empty", (), "expected pictures with cameras"),
        ("text.obj", (), "text.obj"),
        ("one", (), "at least two pictures"),
        ("bare", (), "no camera"),
        ("broken", (), "transforms.json: the list of cameras is not JSON"),
        ("frameless", (), "no 'frames'"),
        ("listed", (), "transforms.json: camera 0: expected an object"),
        ("missing", (), "frame 0: has no file_path"),
        ("bent", (), "camera_model is ORTHOPHOTO, which no pinhole camera replaces"),
        ("wide", (), "aspect ratio"),
        ("ball.ply", ("--steps", 0), "--steps from 1"),
        ("ball.ply", ("--sh-degree", 5), "--sh-degree from 0 to 4"),
        ("ball.ply", ("--size", 8), "--size from 16"),
        ("ball.ply", ("--most-rows", 100), "--most-rows of at least"),
    ):
        assert pattern in run(capfd, "fit", tmp_path / source, "--out", tmp_path / "out.ply", *more).error, source
    assert "already exists" in run(capfd, "fit", tmp_path / "views", "--out", asset).error
    assert "unknown format" in run(capfd, "fit", asset, "--out", tmp_path / "out.txt").error
    assert listing(tmp_path) == before


def test_an_asset_far_from_zero_is_fitted_as_beside_zero(tmp_path: Path, capfd: Capture) -> None:
    far_ply(tmp_path / "far.ply", ball())
    options = (*FEW, "--fixed")
    done = [
        run(capfd, "fit", tmp_path / f"{name}.ply", "--out", tmp_path / f"{name}.out.ply", *options).json
        for name in ("far", "near_far")
    ]
    assert done[0]["psnr"]["held_out"] == pytest.approx(done[1]["psnr"]["held_out"], abs=0.3)
    far, near = read(tmp_path / "far.out.ply"), read(tmp_path / "near_far.out.ply")
    assert far.offset == UTM and abs(far.means - near.means).max() < 0.05


def test_pictures_of_georeferenced_cameras_are_fitted_in_their_world(tmp_path: Path, capfd: Capture) -> None:
    cameras = pictures(tmp_path / "near")
    (tmp_path / "far").mkdir()
    for k, camera in enumerate(cameras):
        picture = np.asarray(Image.open(tmp_path / "near" / f"view_{k:03d}.png").convert("RGB")) / 255
        write_png(tmp_path / "far" / f"view_{k:03d}.png", picture, moved_camera(camera, UTM))
    for name in ("near", "far"):
        assert run(capfd, "fit", tmp_path / name, "--out", tmp_path / f"{name}.ply", *SMALL, "--fixed").code == 0
    far, near = read(tmp_path / "far.ply"), read(tmp_path / "near.ply")
    assert abs(far.world_means - np.array(UTM) - near.means).max() < 0.05
