"""Readers of captures: cameras against the files' own definitions and COLMAP's own writer, and what bad files say."""

from __future__ import annotations

import base64
import json
import math
import os
import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera, look_at
from splatpainter.captures import CapturedView, capture_of, captured_views, is_capture, named_views, split_selector
from splatpainter.captures.colmap import read_model, read_points
from splatpainter.captures.inria import TrainingArguments, training_arguments
from splatpainter.captures.lenses import PolynomialLens
from splatpainter.captures.nerfstudio import ParserFrame
from splatpainter.image_files import write_png
from splatpainter.scene.placement import Placement
from tests.support.capture_folders import angle_of, opengl_pose, write_colmap, write_inria, write_table

POINTS = np.array([[0.1, 0.2, 0.3], [-0.4, 0.1, 0.2], [0.3, -0.3, -0.1]])
CAMERAS_BIN = (
    "AQAAAAAAAAADAAAABAAAAIACAAAAAAAA4AEAAAAAAAAAAAAAAEB/QAAAAAAA4H9AAAAAAAAQdEAAAAAAAMBtQLgehetRuL6/uB6F61G4nj/8qfHSTWJg"
    "P/p+arx0k1i/"
)
IMAGES_BIN = (
    "AgAAAAAAAAAFAAAA9k3gwQ5x7z/x9M0AcHOpP/H0zQBwc7k/tHeaAJQWw78AAAAAAADgPwAAAAAAANC/AAAAAAAAAEADAAAAbGVmdC9JTUdfMS5qcGcA"
    "AgAAAAAAAAAAAAAAAAAlQAAAAAAAQDRAAQAAAAAAAAAAAAAAAAA+QAAAAAAAAERA//////////8GAAAApCUNIYlS7z8AAAAAAAAAAHydYfdGa8m/fJ1h"
    "90ZrqT8AAAAAAADwvwAAAAAAAOA/AAAAAAAADEADAAAASU1HIDIuSlBHAAIAAAAAAAAAAAAAAAAAJUAAAAAAAEA0QP//////////AAAAAAAAPkAAAAAA"
    "AABEQAEAAAAAAAAA"
)
POINTS_BIN = "AQAAAAAAAAABAAAAAAAAAAAAAAAAANA/AAAAAAAA4L8AAAAAAAD4PwrIHgAAAAAAAPC/AgAAAAAAAAAFAAAAAAAAAAYAAAABAAAA"
CAMERAS_TXT = "# Number of cameras: 1\n3 OPENCV 640 480 500 510 321 238 -0.12 0.029999999999999999 0.002 -0.0015\n"
IMAGES_TXT = """# Number of images: 2, mean observations per image: 1
5 0.98255098215525893 0.049708843324859482 0.099417686649718964 -0.14912652997457843 0.5 -0.25 2 3 left/IMG_1.jpg
10.5 20.25 1 30 40 -1
6 0.97882515387862101 0 -0.19858634070554249 0.049646585176385621 -1 0.5 3.5 3 IMG 2.JPG

"""
POINTS_TXT = "# Number of points: 1\n1 0.25 -0.5 1.5 10 200 30 -1 5 0 6 1\n"
COLMAP_POSES = [
    [[0.935754803278, 0.302932713403, 0.180540076694, 0.5], [-0.283164960565, 0.950580617906, -0.127334574918, -0.25],
     [-0.210191705951, 0.068031316405, 0.975290308953, 2.0]],
    [[0.916197363731, -0.09719065275, -0.388762610999, -1.0], [0.09719065275, 0.995070433161, -0.019718267357, 0.5],
     [0.388762610999, -0.019718267357, 0.92112693057, 3.5]],
]  # fmt: skip
"""What pycolmap 4.2.1 wrote (Reconstruction.write_binary and write_text), and its cam_from_world."""


def some_cameras() -> list[Camera]:
    eyes = ((0.5, -1, 3), (2, 0.3, 2), (-1, 1, 2.5))
    return [look_at(eye, (0.1, 0, 0), (0, -1, 0.1), width=120, height=90, fov=50) for eye in eyes]


def same(one: Camera, other: Camera) -> None:
    assert (one.width, one.height) == (other.width, other.height)
    assert np.allclose([one.fx, one.fy, one.cx, one.cy], [other.fx, other.fy, other.cx, other.cy], atol=1e-9)
    assert abs(one.world_to_camera - other.world_to_camera).max() < 1e-9


@pytest.mark.parametrize("ending", ["bin", "txt"])
def test_what_colmap_wrote(ending: str, tmp_path: Path) -> None:
    if ending == "bin":
        for name, text in (("cameras", CAMERAS_BIN), ("images", IMAGES_BIN), ("points3D", POINTS_BIN)):
            (tmp_path / f"{name}.bin").write_bytes(base64.b64decode(text))
    else:
        for name, text in (("cameras", CAMERAS_TXT), ("images", IMAGES_TXT), ("points3D", POINTS_TXT)):
            (tmp_path / f"{name}.txt").write_text(text)
    views = read_model(tmp_path)
    assert [view.name for view in views] == ["left/IMG_1.jpg", "IMG 2.JPG"]
    for view, pose in zip(views, COLMAP_POSES, strict=True):
        camera = view.camera
        assert (camera.width, camera.height, camera.fx, camera.fy) == (640, 480, 500, 510)
        assert (camera.cx, camera.cy) == (321, 238)
        assert abs(camera.world_to_camera[:3] - pose).max() < 1e-11
        assert view.lens == PolynomialLens((-0.12, 0.03), (0.002, -0.0015))
    points, colors = read_points(tmp_path)
    assert points.tolist() == [[0.25, -0.5, 1.5]] and (colors * 255).tolist() == [[10, 200, 30]]


@pytest.mark.parametrize("ending", ["bin", "txt"])
@pytest.mark.parametrize(
    "inner",
    ["sparse/0", "sparse", "", "colmap/sparse/0", "colmap/sparse", "distorted/sparse"],
)
def test_a_model_is_where_programs_put_it(ending: str, inner: str, tmp_path: Path) -> None:
    cameras, names = some_cameras(), ["a.jpg", "b.jpg", "c.jpg"]
    cloud = np.array([[1.5, -2, 3, 255, 0, 51], [0, 0.25, 1, 0, 102, 204]])
    model = write_colmap(tmp_path / inner, cameras, names, ending=ending, points=cloud)
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "b.jpg").write_bytes(b"")
    for path in (tmp_path, model, model / f"images.{ending}", model / f"cameras.{ending}"):
        views = captured_views(path)
        for view, camera in zip(views, cameras, strict=True):
            same(view.camera, camera)
        assert [view.name for view in views] == names and all(view.lens is None for view in views)
        if inner:
            assert views[1].picture() == (tmp_path / "images" / "b.jpg").absolute() and views[0].picture() is None
    points, colors = read_points(model)
    assert np.allclose(points, cloud[:, :3]) and np.allclose(colors, cloud[:, 3:] / 255)


@pytest.mark.parametrize("inner", ["dense/0", "dense", "0"])
def test_a_straightened_model_stands_for_photographs_only_alone(inner: str, tmp_path: Path) -> None:
    """COLMAP's automatic reconstruction leaves sparse/0 and dense/0, each with pictures of its own."""
    cameras, names = some_cameras(), ["a.jpg", "b.jpg", "c.jpg"]
    write_colmap(tmp_path / inner / "sparse", cameras, names, ending="bin")
    (tmp_path / inner / "images").mkdir()
    (tmp_path / inner / "images" / "a.jpg").write_bytes(b"")
    picture = (tmp_path / inner / "images" / "a.jpg").absolute()
    for path in (tmp_path, tmp_path / inner, tmp_path / inner / "sparse"):
        assert captured_views(path)[0].picture() == picture
    write_colmap(tmp_path / "sparse" / "0", cameras[:1], ["z.jpg"], ending="bin")
    assert [view.name for view in captured_views(tmp_path)] == ["z.jpg"]


@pytest.mark.parametrize(
    ("inner", "picture", "is_original"),
    [
        ("data/sparse/0", "data/images/a.jpg", True),
        ("data/sparse/0", "data/images_4/a.jpg", True),
        ("data/sparse/0", "data/a.jpg", True),
        ("data/sparse/0", "a.jpg", False),
        ("data/sparse/0", "images/a.jpg", False),
        ("data/colmap/sparse/0", "data/images/a.jpg", True),
        ("data/distorted/sparse/0", "data/input/a.jpg", True),
        ("data/model", "data/a.jpg", False),
        ("data/model", "data/images/a.jpg", True),
    ],
)
def test_photographs_are_looked_for_beside_their_model(
    inner: str, picture: str, is_original: bool, tmp_path: Path
) -> None:
    """Further away lies a copy that was painted on."""
    folder = write_colmap(tmp_path / inner, some_cameras(), ["a.jpg", "b.jpg", "c.jpg"], ending="bin")
    (tmp_path / picture).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / picture).write_bytes(b"")
    assert (read_model(folder)[0].picture() is not None) == is_original


@pytest.mark.parametrize("inner", ["sparse/1", "colmap/sparse/12", "distorted/sparse/2"])
def test_the_only_model_need_not_be_0(inner: str, tmp_path: Path) -> None:
    """COLMAP's first model is often the worse one, and deleted."""
    write_colmap(tmp_path / inner, some_cameras(), ["a.jpg", "b.jpg", "c.jpg"], ending="bin")
    for path in (tmp_path, (tmp_path / inner).parent):
        assert [view.name for view in captured_views(path)] == ["a.jpg", "b.jpg", "c.jpg"]


def test_of_several_models_the_others_are_named(tmp_path: Path) -> None:
    cameras = some_cameras()
    for number in (1, 2):
        write_colmap(tmp_path / "sparse" / str(number), cameras[number : number + 1], [f"{number}.jpg"], ending="txt")
    with pytest.raises(ValueError, match=r"sparse: expected one model of COLMAP's, found 1, 2; name the folder of one"):
        captured_views(tmp_path)
    write_colmap(tmp_path / "sparse" / "0", cameras[:1], ["0.jpg"], ending="txt")
    assert [view.name for view in captured_views(tmp_path / "sparse")] == ["0.jpg"]
    with pytest.raises(ValueError, match=r"COLMAP's sparse/1, sparse/2 may have it: name that folder"):
        named_views(Path(f"{tmp_path}:2.jpg"))
    assert named_views(Path(f"{tmp_path}/sparse/2:2.jpg"))[0].name == "2.jpg"


@pytest.mark.parametrize("ending", ["bin", "txt"])
def test_rigs_and_frames_are_of_a_model(ending: str, tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, some_cameras(), ["left/a.jpg", "right/a.jpg", "c.jpg"], ending=ending)
    for name in ("rigs", "frames"):  # since COLMAP 3.12; poses of images say the same
        (folder / f"{name}.{ending}").write_bytes(bytes(8))
        assert len(captured_views(folder / f"{name}.{ending}")) == 3
    assert [view.name for view in named_views(Path(f"{folder}:right/a.jpg"))] == ["right/a.jpg"]


def test_photographs_of_one_name_are_told_by_their_folders(tmp_path: Path) -> None:
    """Cameras of a rig number theirs alike: which was painted on was not found, though its folder said it."""
    names = ["rig/cam0/0001.jpg", "rig/cam1/0001.jpg", "rig/cam1/0002.jpg"]
    folder = write_colmap(tmp_path, some_cameras(), names, ending="bin")

    def meant(picture: str) -> list[str]:
        return [view.name for view in named_views(folder, None, Path(picture))]

    assert meant("painted/cam1/0001.jpg") == meant("x/rig/CAM1/0001.png") == [names[1]]
    assert meant("cam0/0001-edit.png") == [names[0]] and meant("elsewhere/0002.jpg") == [names[2]]
    for unknown in ("0001.jpg", "cam2/0001.jpg", "cam0/0003.jpg"):
        assert meant(unknown) == names


@pytest.mark.parametrize("between", ["\n", "\n\n", "\r\n\r\n", "\n1.5 2 -1 3 4 17 5 6 -1 7 8 9\n"])
@pytest.mark.parametrize("start", ["", "# Image list\n", "\ufeff# as Notepad saves\n"])
def test_lines_of_points_may_be_missing_or_empty(start: str, between: str, tmp_path: Path) -> None:
    """Every second image was lost where a program left out the lines of points."""
    rows = [f"{k} 1 0 0 0 0 0 {k} 7 sub/IMG {k}.jpg" for k in range(1, 6)]
    (tmp_path / "cameras.txt").write_text(f"{start}7 SIMPLE_PINHOLE 120 90 100 60 45\n", encoding="utf-8")
    (tmp_path / "images.txt").write_bytes((start + between.join(rows)).encode())
    views = captured_views(tmp_path)
    assert [view.name for view in views] == [f"sub/IMG {k}.jpg" for k in range(1, 6)]
    assert [view.camera.world_to_camera[2, 3] for view in views] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("listed", "there"),
    [
        ("images/A 1.PNG", "images/a 1.png"),
        ("images/a%20b%C3%A9.png", "images/a bé.png"),
        ("images/100%.png", "images/100%.png"),
        ("file:///home/me/images/a%201.png", "images/a 1.png"),
    ],
)
def test_names_in_other_capitals_or_as_in_links(listed: str, there: str, tmp_path: Path) -> None:
    write_table(tmp_path, some_cameras()[:1], [listed])
    (tmp_path / "images").mkdir()
    (tmp_path / there).write_bytes(b"")
    picture = captured_views(tmp_path)[0].picture()
    assert picture is not None and picture.samefile(tmp_path / there)


def test_of_two_names_in_other_capitals_neither_is_taken(tmp_path: Path) -> None:
    write_table(tmp_path, some_cameras()[:1], ["IMG.PNG"])
    for name in ("img.png", "Img.png"):
        (tmp_path / name).write_bytes(b"")
    assert captured_views(tmp_path)[0].picture() is None


def test_a_lens_may_be_a_list(tmp_path: Path) -> None:
    """nerfstudio's dataparser takes distortion_params before k1 and the others."""
    cameras = some_cameras()[:1]
    write_table(tmp_path, cameras, ["a.jpg"], k1=0.5, distortion_params=[0.1, 0.02, 0.003, 0.004, 0.05, 0.06])
    assert captured_views(tmp_path)[0].lens == PolynomialLens((0.1, 0.02, 0.003, 0.004), (0.05, 0.06))
    write_table(tmp_path, cameras, ["a.jpg"], distortion_params=[0.1])
    with pytest.raises(ValueError, match="expected 6 numbers as distortion_params, got 1"):
        captured_views(tmp_path)
    write_table(tmp_path, cameras, ["a.jpg"], k1=0.1, k6=0.2)
    with pytest.raises(ValueError, match="got k6; undistort the pictures"):
        captured_views(tmp_path)


@pytest.mark.parametrize("name", ["Transforms.json", "CAMERAS.JSON"])
def test_capitals_of_names_do_not_matter(name: str, tmp_path: Path) -> None:
    """Disks of Windows and Macs do not tell them apart; a copy on Linux has what was typed there."""
    write = write_inria if name.lower().startswith("cameras") else write_table
    write(tmp_path, some_cameras(), ["a.jpg", "b.jpg", "c.jpg"])
    (tmp_path / name.lower()).rename(tmp_path / name)
    assert len(captured_views(tmp_path)) == 3 and is_capture(tmp_path)


def test_of_a_distorted_model_the_input_is_the_photograph(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "distorted" / "sparse" / "0", some_cameras(), ["a.jpg", "b", "c"], ending="bin")
    for name in ("images", "input"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.jpg").write_bytes(b"")
    assert read_model(folder)[0].picture() == (tmp_path / "input" / "a.jpg").absolute()


def test_inrias_cameras_and_its_arguments(tmp_path: Path) -> None:
    cameras = some_cameras()
    folder = write_inria(
        tmp_path / "model", cameras, ["00001", "b.JPG", "c"],
        "eval=True, images='images_4', sh_degree=3, source_path='/home/someone/data/garden', white_background=True",
    )  # fmt: skip
    (tmp_path / "garden" / "images_4").mkdir(parents=True)
    (tmp_path / "garden" / "images_4" / "00001.png").write_bytes(b"")
    views = captured_views(folder / "cameras.json")
    for view, camera in zip(views, cameras, strict=True):
        same(view.camera, camera)
        assert view.camera.background == (1, 1, 1)
    assert views[0].picture() == (tmp_path / "garden" / "images_4" / "00001.png").absolute(), (
        "moved from another machine"
    )
    assert captured_views(folder)[2].name == "c"


@pytest.mark.parametrize(
    ("source", "images", "there"),
    [
        (r"D:\\captures\\garden", "images", "garden/images"),  # trained on Windows, moved here
        (r"D:\\captures\\garden\\", r"small\\images", "garden/small/images"),
        ("data/garden", "images", "data/garden/images"),  # from the trainer's own folder, in which outputs lie
    ],
)
def test_photographs_of_a_folder_that_was_named_elsewhere(source: str, images: str, there: str, tmp_path: Path) -> None:
    arguments = f"source_path='{source}', images='{images}'"
    folder = write_inria(tmp_path / "output" / "run", some_cameras(), ["a", "b", "c"], arguments)
    (tmp_path / there).mkdir(parents=True)
    (tmp_path / there / "b.jpg").write_bytes(b"")
    assert captured_views(folder)[1].picture() == (tmp_path / there / "b.jpg").absolute()


@pytest.mark.parametrize(
    "text",
    ["", "Namespace(", "__import__('os').system('true')", "Namespace(source_path=open('x'))", "x" * 100_000, "1"],
)
def test_cfg_args_is_never_run(text: str, tmp_path: Path) -> None:
    (tmp_path / "cfg_args").write_text(text)
    assert training_arguments(tmp_path) == TrainingArguments()


def test_a_principal_point_that_cameras_json_says_counts(tmp_path: Path) -> None:
    """As forks of the trainer write it; INRIA's own means the middle."""
    write_inria(tmp_path, some_cameras(), ("a", "b", "c"))
    record = json.loads((tmp_path / "cameras.json").read_text())
    record[1] |= {"cx": 50.5, "cy": 40.0}
    (tmp_path / "cameras.json").write_text(json.dumps(record))
    centers = [(view.camera.cx, view.camera.cy) for view in captured_views(tmp_path / "cameras.json")]
    assert centers == [(60, 45), (50.5, 40), (60, 45)]


def test_umlauts_of_macs_are_those_of_others(tmp_path: Path) -> None:
    """A name of one character or two is the same name, in a selector and on disk."""
    write_inria(tmp_path, some_cameras(), ("a", "b", "c"))
    record = json.loads((tmp_path / "cameras.json").read_text())
    for k, entry in enumerate(record):
        entry["img_name"] = f"t\u00fcr {k}.png"
    (tmp_path / "cameras.json").write_text(json.dumps(record))
    (view,) = named_views(Path(f"{tmp_path / 'cameras.json'}:tu\u0308r 1.png"))
    assert view.name == "t\u00fcr 1.png" and view.picture() is None
    Image.new("RGB", (120, 90)).save(tmp_path / "tu\u0308r 1.png")
    assert view.picture() == tmp_path / "tu\u0308r 1.png"


def test_folders_of_one_letter_may_have_a_selector(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t").mkdir()
    write_inria(tmp_path / "t", some_cameras(), ("a", "b", "c"))
    assert split_selector(Path("t:1")) == ((Path("t"), "1") if os.name != "nt" else (Path("t:1"), ""))


def test_nerfs_table(tmp_path: Path) -> None:
    cameras = some_cameras()
    write_table(tmp_path, cameras, ["images\\a.jpg", "./images/b", "images/c.png"])
    for view, camera in zip(captured_views(tmp_path), cameras, strict=True):
        same(view.camera, camera)
    (tmp_path / "images_2").mkdir()
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / "images_2" / name).write_bytes(b"")
    pictures = [view.picture() for view in captured_views(tmp_path)]
    assert [path and path.name for path in pictures] == ["a.jpg", "b.jpg", None]


def test_a_table_may_say_angles_and_each_frame_its_size(tmp_path: Path) -> None:
    camera = some_cameras()[0]
    frame = {"file_path": "a.png", "transform_matrix": opengl_pose(camera)[:3].tolist(), "w": 120, "h": 90}
    record = {"camera_angle_x": angle_of(camera.fx, 120), "w": 7, "h": 7, "camera_model": "PINHOLE", "frames": [frame]}
    (tmp_path / "any_name.json").write_text(json.dumps(record))
    same(captured_views(tmp_path / "any_name.json")[0].camera, camera)


@pytest.mark.parametrize("sides", [{}, {"w": 120}, {"h": 90}])
def test_a_size_that_a_table_leaves_out_is_the_pictures(sides: dict, tmp_path: Path) -> None:
    """Of one side it says for what size its focal length is, of none it is the picture's."""
    camera, scale = some_cameras()[0], 1 if sides else 2
    Image.new("RGB", (240, 180)).save(tmp_path / "a.png")
    frame = {"file_path": "a", "transform_matrix": opengl_pose(camera).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": scale * camera.fx, **sides, "frames": [frame]}))
    same(captured_views(tmp_path)[0].camera, camera.resized(120 * scale, 90 * scale))


def test_an_asset_of_nerfstudio_lies_in_the_data_parsers_frame(tmp_path: Path) -> None:
    """p' = scale * (T p), T from the world of the capture's program; a table's own world is A p: what a camera sees at
    p it has to see at p', so much further off as the scale says."""
    rng = np.random.default_rng(3)
    turn, applied = np.linalg.qr(rng.normal(size=(3, 3)))[0], np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
    turn *= np.linalg.det(turn)
    shift, scale = rng.normal(size=3), 0.37
    transform = np.concatenate([turn, shift[:, None]], 1)
    export = tmp_path / "exports" / "splat"
    export.mkdir(parents=True)
    (tmp_path / "exports" / "dataparser_transforms.json").write_text(
        json.dumps({"transform": transform.tolist(), "scale": scale})
    )
    (export / "splat.ply").write_bytes(b"")
    cameras, names = some_cameras(), ["a.jpg", "b.jpg", "c.jpg"]
    original = POINTS  # in COLMAP's world
    in_table = original @ applied.T
    expected = scale * (original @ turn.T + shift)
    applied_rows = np.concatenate([applied, np.zeros((3, 1))], 1).tolist()
    table = write_table(tmp_path / "data", cameras, names, applied_transform=applied_rows)
    model = write_colmap(tmp_path / "data" / "sparse" / "0", cameras, names, ending="bin")
    for path, points in ((table, in_table), (model, original)):
        for asset in (export, export / "splat.ply"):
            for view, camera in zip(captured_views(path, asset), cameras, strict=True):
                pixels, depths = camera.project(points)
                moved, further = view.camera.project(expected)
                assert abs(moved - pixels).max() < 1e-9 and abs(further - scale * depths).max() < 1e-12
        same(captured_views(path)[0].camera, cameras[0])  # of nothing that lies in such a frame
    beside = table.with_name("dataparser_transforms.json")
    beside.write_text(json.dumps({"transform": transform.tolist(), "scale": 2 * scale}))
    _, depths = captured_views(table)[0].camera.project(2 * expected)
    assert abs(depths - 2 * scale * cameras[0].project(in_table)[1]).max() < 1e-12


def test_a_camera_path_is_in_the_assets_frame(tmp_path: Path) -> None:
    cameras = some_cameras()
    path = tmp_path / "camera_path.json"
    entries = [
        {"camera_to_world": opengl_pose(camera).ravel().tolist(), "fov": math.degrees(angle_of(camera.fy, 90))}
        for camera in cameras
    ]
    record = {"camera_type": "perspective", "render_width": 120, "render_height": 90, "camera_path": entries}
    path.write_text(json.dumps(record))
    (tmp_path / "dataparser_transforms.json").write_text(
        json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 5.0})
    )
    for view, camera in zip(captured_views(path, tmp_path), cameras, strict=True):
        same(view.camera, camera)
        assert view.name == ""


@pytest.mark.parametrize(
    ("selector", "index"),
    [
        ("0", 0),
        ("2", 2),
        ("a/0012.jpg", 1),
        ("0012.jpg", 1),
        ("0012", 1),
        ("a\\0012.jpg", 1),
        ("b.c.jpg", 2),
        ("b.c", 2),
    ],
)
def test_a_view_is_chosen_by_number_or_name(selector: str, index: int, tmp_path: Path) -> None:
    cameras = some_cameras()
    folder = write_inria(tmp_path, cameras, ["x.jpg", "a/0012.jpg", "b.c.jpg"])
    path = Path(f"{folder / 'cameras.json'}:{selector}")
    assert split_selector(path) == (folder / "cameras.json", selector)
    (view,) = named_views(path)
    same(view.camera, cameras[index])
    (view,) = named_views(Path(f"{folder}:{selector}"))
    same(view.camera, cameras[index])


def test_a_picture_chooses_its_view_by_its_name(tmp_path: Path) -> None:
    write_inria(tmp_path, some_cameras(), ["x.jpg", "y.jpg", "x.png"])
    table = tmp_path / "cameras.json"

    def chosen(picture: str) -> list[str]:
        return [view.name for view in named_views(table, None, Path(picture))]

    assert chosen("elsewhere/y.jpg") == ["y.jpg"] and chosen("y.tif") == ["y.jpg"]
    assert chosen("x.jpg") == ["x.jpg"], "of two with one stem"
    assert len(chosen("x.tif")) == len(chosen("z.jpg")) == 3, "nothing says which"


@pytest.mark.parametrize(
    ("picture", "chosen"),
    [
        ("IMG_1-Edit.tif", "left/IMG_1.jpg"),
        ("img_1 painted.png", "left/IMG_1.jpg"),
        ("IMG_1.2.jpg", "left/IMG_1.jpg"),
        ("IMG_1_2 copy.png", "IMG_1_2.JPG"),  # the longest
        ("IMG_12-Edit.tif", ""),  # no photograph of these: 12 is not 1
        ("my IMG_1.png", ""),
    ],
)
def test_a_photograph_that_was_saved_as_another_file(picture: str, chosen: str, tmp_path: Path) -> None:
    write_table(tmp_path, some_cameras(), ["left/IMG_1.jpg", "IMG_1_2.JPG", "c.v2"])
    views = named_views(tmp_path, picture=Path(picture))
    assert [view.name for view in views] == ([chosen] if chosen else ["left/IMG_1.jpg", "IMG_1_2.JPG", "c.v2"])


def test_of_two_photographs_of_a_name_neither_was_saved_again(tmp_path: Path) -> None:
    write_table(tmp_path, some_cameras(), ["left/a.jpg", "right/a.jpg", "b.jpg"])
    assert len(named_views(tmp_path, picture=Path("a-Edit.jpg"))) == 3


def test_names_with_a_colon_are_files_first(tmp_path: Path) -> None:
    try:
        (tmp_path / "take:2.json").write_text("{}")
    except OSError:
        pytest.skip("this system has no such names")
    assert split_selector(tmp_path / "take:2.json") == (tmp_path / "take:2.json", "")
    assert split_selector(tmp_path / "take:2.json:3") == (tmp_path / "take:2.json", "3")


def test_what_is_a_capture(tmp_path: Path) -> None:
    write_inria(tmp_path / "model", some_cameras(), ["a", "b", "c"], iterations=(7,))
    (tmp_path / "model" / "point_cloud" / "iteration_7" / "point_cloud.ply").write_bytes(b"")
    (tmp_path / "own.json").write_text(some_cameras()[0].to_json())
    (tmp_path / "damaged.json").write_text("{")
    (tmp_path / "empty").mkdir()
    assert is_capture(tmp_path / "model") and is_capture(tmp_path / "model" / "cameras.json")
    for name in ("own.json", "damaged.json", "empty", "nothing"):
        assert not is_capture(tmp_path / name), name
    assert capture_of(tmp_path / "model") == tmp_path / "model"
    assert capture_of(tmp_path / "model" / "point_cloud" / "iteration_7" / "point_cloud.ply") == tmp_path / "model"
    assert capture_of(tmp_path / "own.json") is None and capture_of(tmp_path / "empty") is None


def table_of(**changes: object) -> bytes:
    camera = some_cameras()[0]
    frame = {"file_path": "a.png", "transform_matrix": opengl_pose(camera).tolist()}
    record = {"fl_x": 100, "w": 120, "h": 90, "frames": [{**frame, **changes}]}
    return json.dumps(record).encode()


PLAIN = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"[{}, 1]", "camera 0: has no width"),
        (b"[]", "expected cameras, it lists none"),
        (b'[{"id": 0}]', "camera 0: has no width, height, fx, fy, position, rotation"),
        (json.dumps([{"width": 9, "height": 9, "fx": 1, "fy": 1, "position": [0, 0], "rotation": 1}]).encode(), "3x3"),
        (b'{"frames": []}', "it lists none"),
        (b'{"frames": [{}]}', "frame 0: has no file_path"),
        (b'{"frames": 7}', "expected a list of objects as 'frames'"),
        (table_of(transform_matrix=[[1, 2], [3, 4]]), "expected a 4x4 or 3x4 matrix"),
        (table_of(transform_matrix=[[-1, 0, 0, 0], *PLAIN[1:]]), "flat or mirrored"),
        (table_of(transform_matrix=[[0, 0, 0, 0], *PLAIN[1:]]), "flat or mirrored"),
        (table_of(transform_matrix=[[1, 0.5, 0, 0], *PLAIN[1:]]), "expected a rotation"),
        (table_of(fl_x="long"), "expected finite numbers for fl_x, found 'long'"),
        (table_of(fl_x="100.5"), "expected finite numbers for fl_x, found '100.5'"),
        (table_of(w="120"), "expected finite numbers for w, found '120'"),
        (table_of(transform_matrix=[["1", 0, 0, 0], *PLAIN[1:]]), "finite numbers for a row, found '1'"),
        (table_of(transform_matrix=sum(PLAIN, [])), "expected a 4x4 or 3x4 matrix, got a list of 16"),
        (table_of(fl_x=-3), "must be positive"),
        (table_of(w=12.5), "expected whole pixels as w"),
        (table_of(w=None), "the picture is not there"),
        (table_of(fl_x=None), "neither fl_x nor camera_angle_x"),
        (table_of(fl_x=None, camera_angle_x=4.0), "between 0 and pi"),
        (table_of(k1=[1]), "expected finite numbers for k1"),
        (table_of(camera_model="EQUIRECTANGULAR"), "camera_model is EQUIRECTANGULAR, which no pinhole camera replaces"),
        (table_of(camera_model="ORTHOPHOTO"), "ORTHOPHOTO"),
        (table_of(camera_model="OMNIDIRECTIONALSTEREO_L"), "OMNIDIRECTIONALSTEREO_L"),
        (table_of(camera_model="FISHEYE624"), "FISHEYE624"),
        (table_of(camera_model=5), "expected a name as camera_model"),
        (table_of(latlong=True), "latlong is set"),
        (table_of(ftheta_p0=0.1), "ftheta_p0 is set"),
        (b'{"camera_path": [], "camera_type": "equirectangular"}', "expected camera_type perspective"),
        (b'{"camera_path": [{}]}', "no render_width"),
        (b'{"camera_path": [{}], "render_width": 9, "render_height": 9}', "camera_to_world"),
    ],
)  # fmt: skip
def test_bad_tables_are_one_line(content: bytes, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    path.write_bytes(content)
    with pytest.raises(ValueError) as refused:
        captured_views(path)
    line = str(refused.value)
    assert problem in line and str(path) in line and "\n" not in line and len(line) < 600


def test_fisheyes_are_modelled_by_either_name(tmp_path: Path) -> None:
    for changes in ({"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}):
        (tmp_path / "t.json").write_bytes(table_of(k1=0.1, k2=-0.05, **changes))
        assert captured_views(tmp_path / "t.json")[0].lens == PolynomialLens((0.1, -0.05, 0, 0), fisheye=True)
    (tmp_path / "t.json").write_bytes(table_of(k1=0.1, k3=0.2, p2=0.3))
    assert captured_views(tmp_path / "t.json")[0].lens == PolynomialLens((0.1, 0, 0.2, 0), (0, 0.3))


@pytest.mark.parametrize(
    ("record", "problem"),
    [
        ({"transform": PLAIN[:3], "scale": 0}, "scale above 0"),
        ({"scale": 1}, "4x4 or 3x4 matrix"),
        ({"transform": [[2, 0, 0, 0], *PLAIN[1:3]], "scale": 1}, "expected a rotation and a shift"),
        ({"transform": PLAIN[:3], "scale": "1"}, "finite numbers for scale, found '1'"),
    ],
)
def test_a_bad_frame_is_one_line(record: dict, problem: str, tmp_path: Path) -> None:
    (tmp_path / "t.json").write_bytes(table_of())
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(record))
    with pytest.raises(ValueError, match=problem):
        captured_views(tmp_path / "t.json")


Change = Callable[[Path], object]


def cut(name: str, size: int) -> Change:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:size])


def patched(name: str, at: int, data: bytes) -> Change:
    def change(folder: Path) -> None:
        content = bytearray((folder / name).read_bytes())
        content[at : at + len(data)] = data
        (folder / name).write_bytes(content)

    return change


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (cut("cameras.bin", 40), "truncated"),
        (cut("images.bin", 90), "truncated"),
        (cut("images.bin", 7), "truncated"),
        (patched("images.bin", 0, b"\xff" * 8), "expected at most"),
        (patched("cameras.bin", 12, struct.pack("<i", 99)), "unknown camera model 99"),
        (patched("cameras.bin", 12, struct.pack("<i", 17)), "EQUIRECTANGULAR"),
        (patched("cameras.bin", 8, struct.pack("<i", 8)), "camera 7, which cameras.bin does not list"),
        (patched("cameras.bin", 32, struct.pack("<d", math.nan)), "camera 7"),
        (patched("images.bin", 12, bytes(32)), "no finite pose"),
        (patched("images.bin", 79, struct.pack("<Q", 1 << 60)), "truncated"),
    ],
)
def test_a_damaged_model_is_one_line(change: Change, problem: str, tmp_path: Path) -> None:
    write_colmap(tmp_path, some_cameras(), ["abcdef", "b", "c"], ending="bin")
    assert (tmp_path / "images.bin").read_bytes()[72:79] == b"abcdef\0"
    change(tmp_path)
    with pytest.raises(ValueError) as refused:
        read_model(tmp_path)
    assert problem in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("cameras.txt", "7 PINHOLE 120\n", "line 1: expected CAMERA_ID"),
        ("cameras.txt", "7 PINHOLE 120 90 1 2 3\n", "expected 4 parameters of PINHOLE, got 3"),
        ("cameras.txt", "7 PINHOLE 120 90 a b c d\n", "expected numbers"),
        ("images.txt", "1 1 0 0 0\n", "line 1: expected ID"),
        ("cameras.txt", "7 EQUIRECTANGULAR 120 90 120 90\n", "no pinhole camera replaces"),
    ],
)
def test_a_damaged_text_model_is_one_line(name: str, text: str, problem: str, tmp_path: Path) -> None:
    write_colmap(tmp_path, some_cameras(), ["a", "b", "c"], ending="txt")
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=problem):
        read_model(tmp_path)


def test_a_missing_name_lists_what_there_is(tmp_path: Path) -> None:
    write_inria(tmp_path, some_cameras(), ["a.jpg", "b.jpg", "c.jpg"])
    for selector, problem in (
        ("3", "expected a view from 0 to 2, got 3"),
        ("d", "no views of a picture called 'd'; expected a number from 0 to 2 or a name (a.jpg, b.jpg, c.jpg)"),
    ):
        with pytest.raises(ValueError) as refused:
            named_views(tmp_path / f"cameras.json:{selector}")
        assert problem in str(refused.value)


def test_a_name_in_other_capitals_is_the_same_photograph(tmp_path: Path) -> None:
    """Where two differ in capitals alone, the exact one is meant."""
    write_inria(tmp_path, some_cameras(), ["IMG_1.JPG", "img_2.jpg", "IMG_2.JPG"])
    (view,) = named_views(tmp_path / "cameras.json:img_1.jpg")
    assert view.name.startswith("IMG_1")
    (view,) = named_views(tmp_path / "cameras.json", picture=Path("Img_1.jpg"))
    assert view.name.startswith("IMG_1")
    for name in ("img_2.jpg", "IMG_2.JPG"):
        (view,) = named_views(tmp_path / "cameras.json", picture=Path(name))
        assert view.name == name
    with pytest.raises(ValueError, match="several views of a picture called 'Img_2.JPG'"):
        named_views(tmp_path / "cameras.json:Img_2.JPG")


@pytest.mark.parametrize("name", ["cam.json", "view.png"])
def test_one_camera_takes_no_selector(name: str, tmp_path: Path) -> None:
    """It was called no capture, where leaving :0 out is all that helps."""
    camera = some_cameras()[0]
    (tmp_path / "cam.json").write_text(camera.to_json())
    write_png(tmp_path / "view.png", np.zeros((camera.height, camera.width, 3)), camera)
    with pytest.raises(ValueError, match=rf"{name}:0: {name} holds one camera, not a list of them; leave :0 out"):
        named_views(tmp_path / f"{name}:0")
    write_inria(tmp_path, some_cameras(), ["a.jpg", "b.jpg", "c.jpg"])
    assert named_views(tmp_path / "cameras.json:0")


def test_a_view_of_another_size_sees_the_same() -> None:
    view = CapturedView("a", some_cameras()[0]).resized(60, 45)
    assert abs(view.camera.project(POINTS)[0] * 2 - some_cameras()[0].project(POINTS)[0]).max() < 1e-9


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[]", "expected cameras, it lists none"),
        ("[{", "the list of cameras is not JSON"),
        ('[{"fx": NaN}]', "NaN is not a JSON number"),
        ("[1, 2]", "camera 0: expected an object"),
    ],
)
def test_a_damaged_list_of_cameras_says_what_is_wrong_with_it(text: str, problem: str, tmp_path: Path) -> None:
    """And not that it is no camera of splatpainter's."""
    path = tmp_path / "cameras.json"
    path.write_text(text)
    assert is_capture(path)
    with pytest.raises(ValueError, match=re.escape(problem)):
        captured_views(path)


def test_a_frame_takes_back_what_was_applied_to_a_table() -> None:
    """A turn, a shift and a scale of a table's poses, undone before the data parser's own."""
    turn = Placement.of(turn=(20.0, 30.0, -50.0)).matrix
    applied, parser = np.eye(4), np.eye(4)
    applied[:3, :3], applied[:3, 3] = turn, (0.4, -1.2, 3.0)
    parser[:3, :3], parser[:3, 3] = turn.T, (1.0, 2.0, -0.5)
    frame = ParserFrame(parser, 0.5).after(applied, 2.0)
    np.testing.assert_allclose(frame.transform, parser @ np.linalg.inv(applied), atol=1e-12)
    assert frame.scale == 0.25
