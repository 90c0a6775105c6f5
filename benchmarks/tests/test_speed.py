"""The benches: their measuring tools against closed forms, their paint and views on a box whose front is known, and
both benches once from start to end at sizes that only show that every number is there. Nothing asserts a speed."""

from __future__ import annotations

import csv
import math
import os
import platform
import socket
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from splatbench import local_edits as lift_bench
from splatbench import process, scenes, speed, timing
from splatbench.closeups import ViewAngles, closeup, grazing_closeup
from splatbench.reprojection import reproject
from splatbench.scenes import resampled

from splatpainter import demo_asset
from splatpainter import text_tables as tables
from splatpainter.cameras import Camera, look_at
from splatpainter.contact_sheet import Strip, error_map, sheet
from splatpainter.pictures.drawing import over
from splatpainter.splats import SH_C0, Splats


def box(per_side: int = 24) -> Splats:
    """A cube of edge 2 around the origin, opaque dull flat Gaussians; only the upper half of +x is bright and
    checked."""
    steps = (np.arange(per_side) + 0.5) / per_side * 2 - 1
    a, b = (part.ravel() for part in np.meshgrid(steps, steps))
    one, spacing = np.ones_like(a), 2 / per_side
    half = math.sqrt(0.5)
    sides = {
        (half, 0, half, 0): [(one, a, b), (-one, a, b)],  # z of the Gaussian along world x
        (half, half, 0, 0): [(a, one, b), (a, -one, b)],
        (1, 0, 0, 0): [(a, b, one), (a, b, -one)],
    }
    means = [np.stack(points, 1) for pair in sides.values() for points in pair]
    quats = [np.tile(np.array(quat), (len(a), 1)) for quat, pair in sides.items() for _ in pair]
    means, quats = np.concatenate(means), np.concatenate(quats)
    x, y, z = means.T
    checked = (np.floor(y * 4) + np.floor(z * 4)) % 2
    shade = np.where((x == 1) & (y > 0), 0.55 + 0.4 * checked, 0.3)
    scales = np.tile([0.7 * spacing, 0.7 * spacing, 0.05 * spacing], (len(x), 1))
    arrays = (means, quats, scales, np.full(len(x), 0.95), np.repeat((shade - 0.5)[:, None, None] / SH_C0, 3, 2))
    means, quats, scales, opacities, sh = (np.ascontiguousarray(array, np.float32) for array in arrays)
    return Splats(means, quats, scales, opacities, sh)


def test_measure_counts_calls_and_takes_the_median(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0, 5, 10, 11, 20, 22, 30, 39, 40, 43])  # laps of 5, 1, 2, 9, 3 seconds
    monkeypatch.setattr(timing.time, "perf_counter", lambda: next(clock))
    calls = []
    result = timing.measure(lambda: calls.append(1), warmups=2, repeats=5, budget=100)
    assert (result.seconds, result.fastest, result.repeats, len(calls)) == (3, 1, 5, 7)


def test_measure_stops_at_its_budget_but_not_before_three(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(100))
    monkeypatch.setattr(timing.time, "perf_counter", lambda: next(clock))
    assert timing.measure(lambda: None, repeats=20, budget=0.5).repeats == 3
    assert timing.measure(lambda: None, repeats=20, budget=6.5).repeats == 7
    assert timing.measure(lambda: None, repeats=2, budget=6.5).repeats == 2


def test_a_fresh_process_has_its_own_memory_and_its_own_errors() -> None:
    ballast = np.ones(int(max(280 - process.peak_mib(), 1)) << 20, np.uint8)  # that a child must not inherit
    fresh = process.in_fresh_process("json:dumps", {"obj": [1, 2]})
    assert fresh.result == "[1, 2]" and ballast[-1] == 1
    assert 4 < fresh.peak_mib < 250 < process.peak_mib()
    assert fresh.seconds > 0
    with pytest.raises(RuntimeError, match="math:sqrt failed in a fresh process: TypeError"):
        process.in_fresh_process("math:sqrt", {"x": 1})
    variables = {"SPLATPAINTER_THREADS": "7"}
    assert process.in_fresh_process("splatpainter.kernels.parallel:threads", {}, variables).result == 7


def test_the_machine_is_described_without_naming_it() -> None:
    line = timing.machine()
    assert "\n" not in line and f"Python {platform.python_version()}" in line and "GiB" in line
    assert socket.gethostname() not in line.split() and os.sep not in line.replace("x86_64", "")


def test_tables_hold_every_value(tmp_path: Path) -> None:
    rows = [
        speed.Speed("a", 1000, None, 0.123456, 0.1, 1e9, None, 3),
        speed.Speed("b|c", None, 64, 1234.5, 1.0, None, 2.0, 1, math.inf),
    ]
    tables.write_csv(tmp_path / "t.csv", rows, "machine")
    first, *rest = (tmp_path / "t.csv").read_text().splitlines()
    assert first == "# machine"
    read = list(csv.DictReader(rest))
    assert list(read[0]) == [field.name for field in fields(speed.Speed)]
    assert float(read[0]["milliseconds"]) == 0.123456 and read[0]["size"] == "" and read[1]["reference_ratio"] == "inf"
    tables.write_markdown(tmp_path / "t.md", rows, "machine", ["note"])
    text = (tmp_path / "t.md").read_text()
    assert text.startswith("machine\n\n| operation |") and text.endswith("note\n")
    assert "| a | 1,000 | – | 0.123 | 0.100 | 1,000,000,000 | – | 3 | – |" in text
    assert "| b/c | – | 64 | 1,234 |" in text  # a bar would begin another cell
    cells = [tables.cell_text(value) for value in (True, False, 0.0, 12.345, 0.012345, math.nan)]
    assert cells == ["yes", "NO", "0", "12.3", "0.0123", "–"]


def test_a_disc_has_its_area_and_text_its_height() -> None:
    disc = scenes.stroke_layer((100, 120), np.array([[60.0, 50.0]]), 60, 10)
    # Coverage 3t^2 - 2t^3 over the outer s of radius R: 2 pi times its integral is pi (R^2 - R s + 0.3 s^2).
    assert disc[..., 3].sum() == pytest.approx(math.pi * (30**2 - 30 * 10 + 0.3 * 10**2), rel=2e-3)
    assert disc[50, 60, 3] == 1 and disc[50, 92, 3] == 0 and disc[10, 60, 3] == 0
    line = scenes.stroke_layer((100, 200), np.array([[50.0, 50.0], [150.0, 50.0]]), 20, 1e-3)
    assert line[..., 3].sum() == pytest.approx(100 * 20 + math.pi * 10**2, rel=5e-3)

    text = scenes.text_layer("HIT", (200, 400), (200, 100), 90)[..., 3]
    lines, columns = np.nonzero(text > 0.5)
    assert np.ptp(lines) + 1 == pytest.approx(90, abs=9)  # and a bold rim
    assert lines.mean() == pytest.approx(100, abs=3) and columns.mean() == pytest.approx(200, abs=15)
    assert ((text > 0.1) & (text < 0.9)).sum() > 50  # antialiased
    with pytest.raises(ValueError, match="missing.ttf: expected a TrueType"):
        scenes.text_layer("A", (20, 20), (10, 10), 9, font=Path("missing.ttf"))


def test_paint_covers_and_shows() -> None:
    image = np.full((4, 4, 3), 0.5, np.float32)
    layer = np.zeros((4, 4, 4), np.float32)
    layer[1, 2] = (1, 0, 0, 0.25)
    expected = image.copy()
    expected[1, 2] = (0.625, 0.375, 0.375)
    np.testing.assert_allclose(over(image, layer), expected)
    everywhere = np.ones((4, 4))
    for color in scenes.PALETTE:  # never a colour on itself
        assert scenes.color_against(np.tile(np.array(color), (4, 4, 1)), everywhere) != color
    best = scenes.color_against(np.zeros((4, 4, 3)), everywhere)
    assert best == (0.94, 0.95, 0.93) != scenes.color_against(np.zeros((4, 4, 3)), everywhere, best)


def test_paint_moves_with_the_camera() -> None:
    """A wall at z = 4 seen by two cameras 0.5 apart: everything moves by f t / z pixels."""
    first = look_at((0, 0, 0), (0, 0, 1), width=100, height=80, fov=50)
    second = look_at((0.5, 0, 0), (0.5, 0, 1), width=100, height=80, fov=50)
    side = float((first.world_to_camera @ [0.5, 0, 0, 1])[0])  # which way +x is in the picture
    shift = round(first.fx * side / 4)
    layer = scenes.stroke_layer((80, 100), np.array([[50.0, 40.0]]), 30, 4)
    wall = np.full((80, 100), 4.0)
    moved = reproject(layer, first, wall, second, wall)
    expected = np.roll(layer[..., 3], -shift, 1)
    assert abs(shift) >= 10
    assert np.abs(moved.layer[..., 3] - expected).max() < 0.2  # the shift is not whole
    assert moved.painted[40, 50 - shift] and not moved.clean[40, 50 - shift]
    assert moved.clean[40, 50 - shift + 25] and moved.clean[5, 5]
    assert not (moved.painted & (expected < 0.1)).any()

    hidden = wall.copy()
    hidden[:, :50] = 2.0  # another thing in front of the painted view's left half
    before_it = reproject(layer, first, hidden, first, wall)
    assert not before_it.painted[:, :49].any() and before_it.painted[40, 53]


def test_sheets_show_what_they_were_given() -> None:
    red, blue = np.zeros((32, 32, 3)), np.zeros((32, 32, 3), np.uint8)
    red[..., 0], blue[..., 2] = 1, 255
    page = sheet([Strip("one", (("a", red), ("b", blue))), Strip("two", (("c", blue),))], 32, "title")
    assert page.dtype == np.uint8 and page.shape[2] == 3
    assert (page == (255, 0, 0)).all(2).sum() == 32 * 32 and (page == (0, 0, 255)).all(2).sum() == 2 * 32 * 32
    np.testing.assert_allclose(error_map(red, red), 0)
    np.testing.assert_allclose(error_map(red, red * 0.75), 1)


def test_the_closeup_faces_the_rich_side_and_is_filled() -> None:
    splats = box()
    view = closeup(splats, 64)
    assert view.target[0] == pytest.approx(1, abs=0.1) and view.target[1] > 0  # upper half of +x
    assert view.camera.forward[0] < -0.6 and view.filled > 0.9
    assert (view.camera.width, view.camera.height) == (64, 64)
    np.testing.assert_array_equal(view.camera.world_to_camera, closeup(splats, 64).camera.world_to_camera)

    eye, turned = view.camera.position - view.target, view.turned(30.0)
    spun = turned.position - view.target
    assert np.linalg.norm(spun) == pytest.approx(np.linalg.norm(eye)) and spun[1] == pytest.approx(eye[1])
    flat = eye * [1, 0, 1] @ (spun * [1, 0, 1]) / (eye[0] ** 2 + eye[2] ** 2)
    assert math.degrees(math.acos(flat)) == pytest.approx(30)
    assert (view.turned(0, 15).position - view.target)[1] > eye[1]
    with pytest.raises(ValueError, match="found no part"):
        closeup(replace(splats, opacities=splats.opacities * 0.1))


def test_the_grazing_closeup_sees_a_side_of_the_box_at_its_angle() -> None:
    splats = box()
    view = grazing_closeup(splats, 96)
    normal = np.zeros(3)
    axis = np.abs(view.target).argmax()  # of a cube's side
    normal[axis] = np.sign(view.target[axis])

    def degrees(camera: Camera) -> float:
        eye = camera.position - view.target
        return math.degrees(math.acos(normal @ eye / np.linalg.norm(eye)))

    assert 55 < degrees(view.camera) < 80 and view.filled >= 0.5
    angles = ViewAngles.of(splats, view.camera)
    middle = (slice(40, 56), slice(40, 56))
    assert angles.valid[middle].mean() > 0.9
    assert np.median(angles.degrees[middle][angles.valid[middle]]) == pytest.approx(degrees(view.camera), abs=8)
    # From the side on which it turns to the camera, more and more of it.
    turned = [degrees(view.turned(view.front_turn * turn)) for turn in (0, 20, 40)]
    assert turned[0] > turned[1] > turned[2]
    with pytest.raises(ValueError, match="grazing angle"):
        grazing_closeup(replace(splats, opacities=splats.opacities * 0.1))


@pytest.mark.parametrize("count", [500, 3456, 9000])
def test_scenes_of_any_size_show_the_same_surface(count: int) -> None:
    from splatpainter.metrics import psnr
    from splatpainter.rendering import render

    splats = box()
    other = resampled(splats, count, 0)
    assert len(other) == count and other.sh.shape == (count, 1, 3)
    camera = look_at((5, 1.5, 2), (0, 0, 0), width=64, height=64)
    area = [(s.scales[:, 0] * s.scales[:, 1]).sum() for s in (splats, other)]
    assert area[1] == pytest.approx(area[0], rel=1e-3)
    assert psnr(render(other, camera).colors[0], render(splats, camera).colors[0]) > 20


def test_bench_speed_writes_its_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo_asset, "demo_asset", box)  # unpacking the demo takes as long as all the rest
    monkeypatch.setattr(speed, "REFERENCE_GAUSSIANS", 300)
    monkeypatch.setattr(speed, "REFERENCE_PX", 32)
    words = ("voxel", "open PLY", "small scene")
    messages: list[str] = []
    lines = speed.run(speed.SpeedBench(tmp_path / "out", only=words, quick=True), messages.append)
    names = [line.operation for line in lines]
    assert names[:3] == ["rays to voxels", "voxels", "open PLY"] and len(messages) == len(lines)
    assert all(math.isfinite(line.milliseconds) and 0 < line.fastest <= line.milliseconds for line in lines)
    small = [line for line in lines if line.operation.startswith("small scene")]
    assert len(small) == 4 and all(line.reference_ratio is not None and line.reference_ratio > 0 for line in small)
    assert (lines[0].rows, lines[0].size, lines[1].size) == (2000, 64, None)
    parts = {round(line.fastest / line.calibrated, 6) for line in lines if line.calibrated}
    assert len(parts) == 1 and parts.pop() > 0.1, "one calibration for all, in milliseconds"
    assert all(line.peak_mib is None or line.peak_mib > 4 for line in lines)
    heading, *table = (tmp_path / "out" / "speed.csv").read_text().splitlines()
    assert "cores" in heading and [row["operation"] for row in csv.DictReader(table)] == names
    assert (tmp_path / "out" / "speed.md").read_text().startswith(heading.removeprefix("# "))


def test_bench_speed_knows_the_networks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from splatbench.scenes import SavedScene, save_scene
    from splatbench.speed_cases import OPERATIONS

    from splatpainter.models import config
    from tests.support.model_scenes import TINY

    monkeypatch.setattr(config, "COMPACT", TINY)
    monkeypatch.setattr(demo_asset, "demo_asset", box)
    save_scene(tmp_path / "scene", resampled(box(), 2000, 1))
    scene = SavedScene(tmp_path / "scene", 64)
    encoded, local, graded = (
        OPERATIONS[name].prepare(scene)()
        for name in ("encode, compact", "local edit ttt, compact", "global edit ttt, compact")
    )
    assert encoded.encoding is not None and encoded.receipt is None
    assert (local.receipt.method, local.receipt.mode) == ("ttt", "local") and local.receipt.appended_rows > 0
    assert (graded.receipt.method, graded.receipt.mode) == ("ttt", "global") and len(graded.receipt.touched) == 2000
    # Only on scenes that are large enough.
    folder = tmp_path / "out"
    assert not speed.run(speed.SpeedBench(folder, only=("ttt",), rows=(2000,), sizes=(64,)))


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"rows": (5,)}, "--rows"),
        ({"sizes": ()}, "--sizes"),
        ({"sh_degree": 4}, "--sh-degree"),
        ({"only": ("x y",)}, "--only"),
    ],
)
def test_bench_speed_refuses_what_makes_no_sense(tmp_path: Path, wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        speed.run(speed.SpeedBench(tmp_path / "out", **wrong))
    assert not (tmp_path / "out").exists()


def test_bench_lift_paints_scores_and_proves(tmp_path: Path) -> None:
    from splatpainter.io import write

    write(tmp_path / "box.ply", box(32))
    config = lift_bench.LiftBench((tmp_path / "box.ply",), True, tmp_path / "out", size=128, repeats=1)
    (line,) = lift_bench.run(config)
    numbers = (line.before, line.inside, line.outside, line.novel_inside, line.novel_outside, line.split_outside)
    finite = [value for value in numbers if value is not None and math.isfinite(value)]
    assert len(finite) == 6
    assert line.exact and line.rows == line.touched + line.untouched == 6 * 32**2
    assert finite[1] > finite[0] + 3 and 0.02 < line.painted < 0.4
    assert line.grazing_inside is not None and line.grazing_inside > finite[0] + 3 and line.grazing_novel is not None
    heading, *table = (tmp_path / "out" / "lift.csv").read_text().splitlines()
    (row,) = csv.DictReader(table)
    assert heading.startswith("# ") and list(row) == [field.name for field in fields(lift_bench.Lift)]
    assert float(row["inside"]) == line.inside and row["asset"] == "box"
    assert "| box | 6,144 |" in (tmp_path / "out" / "lift.md").read_text()
    for name, cell in (("sheet.png", 128), ("box.png", 128)):
        with Image.open(tmp_path / "out" / name) as page:
            assert page.width >= 6 * cell and page.height > 2 * cell  # from the front and grazing
            assert len(page.getcolors(page.width * page.height) or []) > 500  # pictures, not an empty page


def test_bench_lift_finds_assets(tmp_path: Path) -> None:
    for name in ("a.splat", "a.ply", "a.sog", "b.v2.spz", "b.compressed.ply", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / "meta.json").write_text("{}")
    paths = lift_bench.find_assets([tmp_path])
    assert [path.name for path in paths] == ["a.ply", "b.compressed.ply", "tree"]
    assert lift_bench.find_assets([tmp_path / "tree"]) == [tmp_path / "tree"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="empty: expected splat files"):
        lift_bench.find_assets([tmp_path / "empty"])
    with pytest.raises(ValueError, match="got none of these"):
        lift_bench.run(lift_bench.LiftBench(without_demo=True, out=tmp_path / "out"))
    with pytest.raises(ValueError, match="nothing.ply: no such file"):
        lift_bench.find_assets([tmp_path / "nothing.ply"])
