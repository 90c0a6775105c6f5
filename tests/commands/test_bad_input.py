"""Bad input, through the real command line: exit code 2, one line on stderr that names the file, nothing written."""

from __future__ import annotations

import io
import json
import re
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.commands.info import Config as InfoConfig
from splatpainter.commands.parts.option_parsing import parse
from splatpainter.commands.render import Config as RenderConfig
from tests.support.cli_scenes import (
    BOX,
    Capture,
    ball,
    ball_and_painted_view,
    listing,
    paint,
    refused,
    run,
    saved,
    without_camera,
)

HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {rows}\n"
    + "".join(f"property float {name}\n" for name in ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"))
    + "{rest}"
    + "".join(f"property float {name}\n" for name in ("opacity", "scale_0", "scale_1", "scale_2"))
    + "".join(f"property float rot_{k}\n" for k in range(4))
    + "end_header\n"
)
"""14 floats a row, without SH."""
MESH = (
    "ply\nformat ascii 1.0\nelement vertex 1\n{}element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n"
)


def ply(rows: object, body: int, rest: str = "") -> bytes:
    return HEADER.format(rows=rows, rest=rest).encode() + bytes(body)


def rest(count: int) -> str:
    return "".join(f"property float f_rest_{k}\n" for k in range(count))


BROKEN: dict[str, tuple[str, bytes, str]] = {
    "truncated rows": ("a.ply", ply(10, 55 * 10), "truncated|expected|needs"),
    "truncated header": ("a.ply", ply(10, 0)[:100], "end_header|header"),
    "a count that the file does not hold": ("a.ply", ply(11, 56 * 10), "11|truncated|needs"),
    "gigabytes claimed in a tiny file": ("a.ply", ply(2_000_000_000, 56), "2000000000|truncated|needs"),
    "a negative count": ("a.ply", ply(-1, 56), "-1"),
    "a count that is no number": ("a.ply", ply("many", 56), "many"),
    "an SH count of no degree": ("a.ply", ply(1, 60 + 4 * 7, rest(7)), "f_rest"),
    "an SH coefficient missing": ("a.ply", ply(1, 60 + 4 * 44, rest(44)), "44"),
    "a mesh": ("a.ply", MESH.format("".join(f"property float {c}\n" for c in "xyz")).encode(), "opacity|splat|Gauss"),
    "an empty file": ("a.ply", b"", "a.ply"),
    "text": ("a.txt", b"hello", "unknown format"),
    "a picture": ("a.spz", b"\x89PNG\r\n\x1a\n" + bytes(100), "a.spz"),
    "a lying SPZ": ("a.spz", b"NGSP" + struct.pack("<IIBBBB", 2, 2**31, 0, 12, 0, 0) + bytes(64), "a.spz"),
    "a lying KSPLAT": (
        "a.ksplat",
        bytes([0, 1, 0, 0]) + struct.pack("<IIII", 2**31, 2**31, 2**31, 0) + bytes(4096),
        "a.ksplat",
    ),
    "a zip that is no SOG": ("a.sog", b"PK\x03\x04" + bytes(60), "a.sog"),
    "a glTF cut short": ("a.glb", b"glTF" + struct.pack("<II", 2, 2**31), "a.glb"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_files_that_are_not_what_they_say(case: str, tmp_path: Path, capfd: Capture) -> None:
    name, data, pattern = BROKEN[case]
    path = tmp_path / name
    path.write_bytes(data)
    before = listing(tmp_path)
    tracemalloc.start()
    try:
        lines = [
            run(capfd, "info", path).error,
            run(capfd, "convert", path, tmp_path / "out.ply").error,
            run(capfd, "render", path, "--out", tmp_path / "views").error,
            run(capfd, "verify", path, path).error,
        ]
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    for line in lines:
        assert str(path) in line and re.search(pattern, line), line
        assert len(line) < 400
    assert peak < 64 << 20, "nothing is allocated before a count is checked"
    assert listing(tmp_path) == before and not (tmp_path / "views").exists()


@pytest.mark.parametrize(
    "words", [["info"], ["convert"], ["render"], ["verify"], ["edit"], ["render", "X"], ["edit", "X", "Y"]]
)
def test_missing_words(words: list[str], capfd: Capture) -> None:
    line = run(capfd, *words).error
    assert line.startswith(f"splatpainter {words[0]}: ") and line.endswith(f"see splatpainter {words[0]} --help")


@pytest.mark.parametrize("words", [["--out", "OUT"], ["--out=OUT"], ["--json", "--out", "OUT"], ["OUT"]])
def test_convert_takes_its_output_as_the_other_commands_do(words: list[str], tmp_path: Path, capfd: Capture) -> None:
    asset, out = saved(tmp_path / "a.ply"), tmp_path / "b.spz"
    done = run(capfd, "convert", asset, *(word.replace("OUT", str(out)) for word in words))
    assert done.code == 0 and out.is_file()
    for wrong in (["--out"], ["--out", "b.spz", "c.spz"], []):
        line = run(capfd, "convert", asset, *wrong).error
        assert line.startswith("splatpainter convert: ") and line.endswith("see splatpainter convert --help")


def test_a_terminal_without_unicode(capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), encoding="cp1252"))  # as of a pipe on Windows
    with pytest.raises(ValueError, match=r"^splatpainter info: missing ASSET; see splatpainter info --help$"):
        parse(InfoConfig, "splatpainter info", [])
    with pytest.raises(ValueError, match=r"^splatpainter render: invalid choice 'sky' .* --help$"):
        parse(RenderConfig, "splatpainter render", ["X", "--out", "D", "--up", "sky"])


@pytest.mark.parametrize(
    ("words", "pattern"),
    [
        (["inof", "X"], "did you mean info?"),
        (["polish"], "expected a command"),
        (["info", "X", "--jsn"], "unknown option --jsn; perhaps you meant --json"),
        (["info", "X", "Y"], "Unrecognized options: Y"),
        (["edit", "X", "Y", "--out", "Z", "--mode", "sideways"], "sideways"),
        (["edit", "X", "--out", "Z.ply"], "expected 1 to 16 pictures"),
        (["edit", "X", "Y", "--out", "Z.ply", "--camera", "a", "b"], "as many --camera files as pictures (1), got 2"),
        (["edit", "X", "Y", "--out", "Z.ply", "--mask", "a", "--mask", "b"], "--mask was given twice"),
        (["edit", "X", "Y", "--out", "Z.jpg"], "Z.jpg: unknown format"),
        (["edit", "X", "Y", "--out", "Z.ksplat"], "Z.ksplat"),
        (["render", "X", "--out", "D", "--size", "big"], "--size"),
        (["render", "X", "--out", "D", "--size", "nan"], "--size: expected a whole number, got 'nan'; see"),
        (["render", "X", "--out", "D", "--views", "1e3"], "--views: expected a whole number, got '1e3'; see"),
        (["render", "X", "--out", "D", "--fov", "40deg"], "--fov: expected a number, got '40deg'; see"),
        (["render", "X", "--out", "D", "--distance", "far"], "--distance: expected a number, got 'far'; see"),
        (["render", "X", "--out", "D", "--size", "0"], "--size from 1"),
        (["render", "X", "--out", "D", "--size", "99999"], "--size from 1"),
        (["render", "X", "--out", "D", "--views", "0"], "--views from 1"),
        (["render", "X", "--out", "D", "--fov", "180"], "--fov from 1"),
        (["render", "X", "--out", "D", "--distance", "-1"], "--distance above 0"),
        (["render", "X", "--out", "D", "--distance", "nan"], "--distance above 0"),
        (["render", "X", "--out", "D", "--background", "1,2,3"], "--background"),
        (["render", "X", "--out", "D", "--background", "#12345"], "--background"),
        (["render", "X", "--out", "D", "--up", "sky"], "sky"),
        (["bench", "taste"], "taste"),
        (["demo", "--size", "9"], "--size from 64"),
    ],
)
def test_wrong_options(
    words: list[str], pattern: str, tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert pattern in run(capfd, *words).error
    assert listing(tmp_path) == {}


def test_a_missing_file(tmp_path: Path, capfd: Capture) -> None:
    gone = tmp_path / "gone.ply"
    for words in (
        ["info", gone],
        ["convert", gone, tmp_path / "o.ply"],
        ["render", gone, "--out", tmp_path],
        ["verify", gone, gone],
    ):
        assert f"{gone}: no such file" in run(capfd, *words).error


# Pictures, cameras, masks


@pytest.fixture()
def view(tmp_path: Path, capfd: Capture) -> Path:
    """painted.png, beside ball.ply and views/."""
    return ball_and_painted_view(tmp_path, capfd)


def _camera(folder: Path, change: Callable[[dict], object] | None = None, text: str | None = None) -> Path:
    """camera.json: the view's own camera, changed, or some other text."""
    path = folder / "camera.json"
    record = json.loads((folder / "views" / "view_000.json").read_text())
    if change is not None:
        change(record)
    path.write_text(json.dumps(record) if text is None else text)
    return path


def test_no_camera(view: Path, capfd: Capture) -> None:
    bare, jpeg = (without_camera(view, view.with_name(name)) for name in ("bare.png", "bare.jpg"))
    for path in view.parent.rglob("*.png"):  # else it is recognised
        if path != bare:
            path.unlink()
    assert f"{bare}: no camera" in refused(capfd, view.parent, bare)
    assert f"{jpeg}: no camera" in refused(capfd, view.parent, jpeg)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "not JSON",
        "[]",
        "{}",
        '{"version": 2}',
        '{"version": 1, "width": 96}',
        "[" * 100_000,
        '{"version": 1' + "0" * 5000 + "}",
    ],
    ids=["empty", "text", "list", "object", "version", "fields", "deep", "digits"],
)
def test_a_camera_that_is_none(text: str, view: Path, capfd: Capture) -> None:
    camera = _camera(view.parent, text=text)
    line = refused(capfd, view.parent, view, "--camera", camera)
    assert str(camera) in line and len(line) < 600


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.update(width=0),
        lambda c: c.update(width=-96),
        lambda c: c.update(width=1e9, height=1e9),
        lambda c: c.update(fx=0.0),
        lambda c: c.update(fx="wide"),
        lambda c: c.update(fx=float("nan")),
        lambda c: c.update(fx=float("inf")),
        lambda c: c.update(width=float("inf")),
        lambda c: c.update(world_to_camera=[[1, 0], [0, 1]]),
        lambda c: c.update(world_to_camera=[[0] * 4] * 4),
        lambda c: c.update(world_to_camera="here"),
        lambda c: c["world_to_camera"][0].__setitem__(3, float("nan")),
        lambda c: c.update(background=[1]),
        lambda c: c.pop("fy"),
    ],
)  # fmt: skip
def test_a_camera_with_impossible_numbers(change: Callable[[dict], object], view: Path, capfd: Capture) -> None:
    camera = _camera(view.parent, change)
    assert str(camera) in refused(capfd, view.parent, view, "--camera", camera)


def test_a_missing_or_unreadable_camera(view: Path, capfd: Capture) -> None:
    gone = view.with_name("gone.json")
    assert f"{gone}: no such file" in refused(capfd, view.parent, view, "--camera", gone)
    assert str(view.parent) in refused(capfd, view.parent, view, "--camera", view.parent)
    binary = view.with_name("camera.json")
    binary.write_bytes(bytes(range(256)))
    assert str(binary) in refused(capfd, view.parent, view, "--camera", binary)
    bare = without_camera(view, view.with_name("bare.png"))
    assert str(bare) in refused(capfd, view.parent, view, "--camera", bare)


@pytest.mark.parametrize("size", [(96, 98), (98, 96), (96, 48), (200, 100)])
def test_another_aspect_ratio(size: tuple[int, int], view: Path, capfd: Capture) -> None:
    other = view.with_name("other.png")
    with Image.open(view) as picture:
        picture.resize(size).save(other)
    camera = view.parent / "views" / "view_000.json"
    line = refused(capfd, view.parent, other, "--camera", camera)
    assert str(other) in line and "aspect ratio" in line and f"{size[0]}x{size[1]}" in line and "96x96" in line
    line = refused(capfd, view.parent, view, "--mask", other)
    assert str(other) in line and "aspect ratio" in line


@pytest.mark.parametrize("kind", ["black", "transparent"])
def test_an_empty_mask(kind: str, view: Path, capfd: Capture) -> None:
    mask = view.with_name("mask.png")
    Image.new("RGBA" if kind == "transparent" else "L", (96, 96)).save(mask)
    assert f"{mask}: empty mask" in refused(capfd, view.parent, view, "--mask", mask)


def test_a_picture_without_an_edit(view: Path, capfd: Capture) -> None:
    same = view.parent / "views" / "view_000.png"
    line = refused(capfd, view.parent, same)
    assert str(same) in line and "does not differ" in line


def test_an_edit_that_hits_no_gaussian(view: Path, capfd: Capture) -> None:
    """Paint in the empty corner, with and without a mask, by every method that edits locally."""
    beside = paint(view.parent / "views" / "view_000.png", view.with_name("beside.png"), (1, 1, 8, 8))
    mask = view.with_name("mask.png")
    pixels = np.zeros((96, 96), np.uint8)
    pixels[1:8, 1:8] = 255
    Image.fromarray(pixels).save(mask)
    for more in ([], ["--mask", mask], ["--method", "fit"]):
        line = refused(capfd, view.parent, beside, *more)
        assert str(beside) in line and "no Gaussian" in line
    line = refused(capfd, view.parent, beside, "--mask", mask, "--mode", "global")
    assert str(beside) in line and "no solid part" in line


def test_a_view_from_inside(view: Path, capfd: Capture) -> None:
    """The camera within the ball's shell, named in a refusal of the second picture of two, too."""
    inside = _camera(view.parent, lambda c: c["world_to_camera"][2].__setitem__(3, 1.0))
    line = refused(capfd, view.parent, view, "--camera", inside)
    assert str(view) in line and "inside" in line
    second = without_camera(view, view.with_name("second.png"))
    recorded = view.parent / "views" / "view_000.json"
    line = refused(capfd, view.parent, view, second, "--camera", recorded, inside)
    assert str(second) in line and "inside" in line


def test_methods_that_are_not_there(view: Path, capfd: Capture) -> None:
    assert "fit" in refused(capfd, view.parent, view, "--method", "fit", "--mode", "global")


def _lying_png(width: int, height: int) -> bytes:
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(b"")),
        (b"IEND", b""),
    ]
    out = b"\x89PNG\r\n\x1a\n"
    for kind, data in chunks:
        out += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return out


@pytest.mark.parametrize("size", [(20_000, 20_000), (9_000, 9_000), (2_000_000_000, 2_000_000_000), (0, 5)])
def test_pictures_of_impossible_size(size: tuple[int, int], view: Path, capfd: Capture) -> None:
    bomb = view.with_name("bomb.png")
    bomb.write_bytes(_lying_png(*size))
    line = refused(capfd, view.parent, bomb)
    assert str(bomb) in line
    assert str(bomb) in refused(capfd, view.parent, view, "--mask", bomb)


def test_pictures_that_are_none(view: Path, capfd: Capture) -> None:
    folder = view.parent
    complete = view.read_bytes()
    (folder / "half.png").write_bytes(complete[: len(complete) // 2])
    (folder / "text.png").write_text("hello")
    (folder / "empty.png").write_bytes(b"")
    buffer = io.BytesIO()
    Image.new("RGB", (96, 96)).save(buffer, "BMP")
    (folder / "other.png").write_bytes(buffer.getvalue())
    for name in ("half.png", "text.png", "empty.png", "other.png", "gone.png", "views"):
        assert str(folder / name) in refused(capfd, folder, folder / name)
        assert str(folder / name) in refused(capfd, folder, view, "--mask", folder / name)


def test_too_many_pictures(view: Path, capfd: Capture) -> None:
    done = run(capfd, "edit", view.parent / "ball.ply", *[view] * 17, "--out", view.parent / "out.ply")
    assert "expected 1 to 16 pictures" in done.error


def test_a_receipt_that_is_none(view: Path, capfd: Capture) -> None:
    folder = view.parent
    for name, data in (("r.json", b"{}"), ("bin.json", bytes(range(256))), ("list.json", b"[]"), ("gone.json", None)):
        if data is not None:
            (folder / name).write_bytes(data)
        line = run(capfd, "verify", folder / "ball.ply", folder / "ball.ply", "--receipt", folder / name).error
        assert str(folder / name) in line
    runs = {"touched_runs": [[0, 10**12]], "touched_rows": 10**12, "asset": {"rows": 10**12, "sha256": ""}}
    (folder / "huge.json").write_text(json.dumps(runs))
    line = run(capfd, "verify", folder / "ball.ply", folder / "ball.ply", "--receipt", folder / "huge.json").error
    assert str(folder / "huge.json") in line


def test_nothing_to_draw(tmp_path: Path, capfd: Capture) -> None:
    """No Gaussians at all, and none that can be drawn: rendered as background, refused by edit."""
    for name, splats in (
        ("none", ball(10).take(np.zeros(0, np.int64))),
        ("nan", replace(ball(10), means=np.full((10, 3), np.nan, np.float32))),
    ):
        asset = saved(tmp_path / f"{name}.ply", splats)
        assert run(capfd, "info", asset).code == 0
        done = run(capfd, "render", asset, "--out", tmp_path / name, "--views", 1, "--size", 32)
        assert done.code == 0, done.err
        painted = paint(tmp_path / name / "view_000.png", tmp_path / f"{name}.png", (5, 5, 20, 20))
        line = run(capfd, "edit", asset, painted, "--out", tmp_path / "out.ply").error
        assert "can be drawn" in line and not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize("value", [1e38, -1e38, 1e-38, 3e4])
def test_numbers_at_the_edge_of_float(value: float, tmp_path: Path, capfd: Capture) -> None:
    """Extreme but finite values: no warning, no fault, at most a refusal."""
    splats = ball(200)
    means, scales = splats.means.copy(), splats.scales.copy()
    means[::7] = value
    scales[::11] = abs(value)
    asset = saved(tmp_path / "edge.ply", replace(splats, means=means, scales=scales))
    for words in (["info", asset], ["render", asset, "--out", tmp_path, "--views", 1, "--size", 32]):
        done = run(capfd, *words)
        assert done.code in (0, 2) and done.err.count("\n") == (done.code == 2), done.err


def test_an_edited_picture_is_no_mask_of_itself(view: Path, capfd: Capture) -> None:
    painted = paint(view, view.with_name("painted.png"), BOX)
    assert "is the edited picture itself" in refused(capfd, view.parent, painted, "--mask", painted)


def test_a_mask_of_a_region_that_selects_nothing_is_named(view: Path, capfd: Capture) -> None:
    black = view.with_name("black.png")
    Image.new("L", (96, 96)).save(black)
    folder = view.parent
    words = (
        "grade",
        folder / "ball.ply",
        "--exposure",
        1,
        "--where",
        f"mask={black}@{view}",
        "--out",
        folder / "o.ply",
    )
    assert f"{black}: empty mask; expected some pixels that are not black" in run(capfd, *words).error


def test_a_camera_of_a_capture_beyond_what_is_drawn_leaves_no_folder(view: Path, capfd: Capture) -> None:
    cameras = view.with_name("cameras.json")
    pose = {"position": [0, 0, -4], "rotation": np.eye(3).tolist()}
    cameras.write_text(
        json.dumps([{"id": 0, "img_name": "a", "width": 10**9, "height": 64, "fx": 80, "fy": 80} | pose])
    )
    before = listing(view.parent)
    out = view.with_name("wide")
    line = run(capfd, "render", view.parent / "ball.ply", "--camera", cameras, "--out", out).error
    assert "1000000000 x 64" in line and listing(view.parent) == before and not out.exists()


def test_cameras_that_cannot_be_read_say_what_was_expected(view: Path, capfd: Capture) -> None:
    """A table of views that is no JSON is no camera of another version; a model without images is no damaged camera."""
    table, model = view.with_name("transforms.json"), view.with_name("0")
    table.write_text('{"frames": [{"transform_matrix": [[NaN]]}]}')
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 64 64 80 80 32 32\n")
    words = ("render", view.parent / "ball.ply", "--out", view.with_name("views2"), "--camera")
    assert "transforms.json: the list of cameras is not JSON (NaN" in run(capfd, *words, table).error
    assert f"{model}: expected a capture: " in run(capfd, *words, model).error


def test_an_output_below_a_file(view: Path, capfd: Capture) -> None:
    line = run(capfd, "convert", view.parent / "ball.ply", view / "out.ply").error
    assert f"{view} is a file, not a folder" in line


def test_a_receipt_that_is_no_json_is_told_without_names_of_python(view: Path, capfd: Capture) -> None:
    text, asset = view.with_name("text.json"), view.parent / "ball.ply"
    text.write_text("hello")
    line = run(capfd, "verify", asset, asset, "--receipt", text).error
    assert f"{text}: expected a receipt of splatpainter, as JSON (Expecting value" in line
