"""Decals: where their features lie on shapes whose exponential map is exact, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import splatpainter as sp
from splatpainter.decals import decal_placement, decal_views
from splatpainter.decals.decal_placement import picture_up
from splatpainter.decals.decal_surface import SurfacePixels, is_open, lies_outdoors, stands_free
from splatpainter.decals.decals import DECALS, Decal, parse_width, rough_length_px, text_picture
from splatpainter.demo_asset import demo_asset, demo_view
from splatpainter.lift.masks import dilated
from splatpainter.painter import Painter
from splatpainter.pictures.picture_reader import Picture
from splatpainter.surface.estimate import Surface
from splatpainter.surface.unwrap import PointCells
from tests.support import surface_shapes
from tests.support.cli_scenes import Capture, run, saved

UP = (0.0, 1.0, 0.0)
RED = (0.9, 0.05, 0.05)


def looking(point: np.ndarray, normal: np.ndarray, *, distance: float = 3.0, size: int = 240) -> sp.Camera:
    return sp.look_at(point + distance * normal, point, UP, width=size, height=size, fov=30)


FRONT = looking(np.zeros(3), np.array([0, 0, 1.0]), distance=4.0)
MIDDLE = (120.0, 120.0)


def dots(centers: np.ndarray, pixels: int = 240) -> np.ndarray:
    """[pixels, pixels, 4] red dots on nothing. centers: [K, 2] in -0.5 .. 0.5, right and up."""
    y, x = np.mgrid[:pixels, :pixels] + 0.5
    picture = np.zeros((pixels, pixels, 4), np.float32)
    picture[..., :3] = RED
    for u, v in centers:
        away = np.hypot(x - (0.5 + u) * pixels, y - (0.5 - v) * pixels)
        picture[..., 3] = np.maximum(picture[..., 3], np.clip(0.035 * pixels - away + 0.5, 0, 1))
    return picture


def on_box(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    u = uv[0]
    side = 0.0 if abs(u) <= 0.5 else float(np.sign(u))
    point = np.array([np.clip(u, -0.5, 0.5), uv[1], 0.5 - max(abs(u) - 0.5, 0)])
    return point, np.array([side, 0, float(side == 0)])


def on_cylinder(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    normal = np.array([np.sin(uv[0] / 0.6), 0, np.cos(uv[0] / 0.6)])
    return 0.6 * normal + np.array([0, uv[1], 0]), normal


def on_sphere(uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    away = float(np.linalg.norm(uv))
    normal = np.array([*(np.sin(away) / max(away, 1e-12) * uv), np.cos(away)])
    return normal, normal


SHAPES: list[tuple[str, Callable, float, Callable]] = [
    ("box", lambda: surface_shapes.box(6_000), 1.6, on_box),
    ("cylinder", lambda: surface_shapes.cylinder(3_000), 1.6, on_cylinder),
    ("sphere", lambda: surface_shapes.sphere(3_000), 1.6, on_sphere),
]


def turned(uv: np.ndarray, angle: float) -> np.ndarray:
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return uv @ np.array([[c, s], [-s, c]])


@pytest.mark.parametrize(("angle", "across"), [(0.0, True), (30.0, False)])
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape[0])
def test_features_lie_where_the_exact_map_puts_them(shape, angle: float, across: bool) -> None:
    """Each dot is found in a picture from straight above where it must be; off by less than 2 % of the width."""
    _, make, width, exact = shape
    splats = make()
    values = np.array([-0.42, -0.2, 0, 0.2, 0.42])
    centers = np.array([[u, v] for u in (values if across else values / 2) for v in (-0.22, 0, 0.22)])
    painter = sp.Painter()
    asset = painter.encode(splats)
    laid = Decal(dots(centers, 120), MIDDLE, FRONT, width, angle).laid(asset)
    edited = painter.apply(asset, laid.edits)
    errors = []
    for uv in turned(centers, angle) * width:
        point, normal = exact(uv)
        camera = looking(point, normal)
        reach = int(0.065 * width * camera.fx / 3)
        window_camera = replace(camera, width=2 * reach, height=2 * reach, cx=float(reach), cy=float(reach))
        before, after = (np.clip(sp.render(s, window_camera).colors[0], 0, 1) for s in (splats, edited.splats))
        window = np.maximum((before - after)[..., 1:].mean(-1) - 0.08, 0)  # grey to red
        assert window.max() > 0.2, f"nothing painted at {uv}"
        y, x = np.mgrid[-reach:reach, -reach:reach] + 0.5
        away = np.array([(window * x).sum(), (window * y).sum()]) / window.sum()
        errors.append(np.linalg.norm(away) * 3 / camera.fx / width)
    assert laid.coverage > 0.95
    assert max(errors) < 0.02, np.round(errors, 4)


def test_what_the_decal_does_not_reach_keeps_its_bits() -> None:
    splats = surface_shapes.box(4_000)
    painter = sp.Painter()
    asset = painter.encode(splats)
    edited = painter.apply(asset, Decal(dots(np.zeros((1, 2))), MIDDLE, FRONT, 0.5).views(asset))
    behind = splats.means[:, 2] < 0.2
    assert np.array_equal(edited.splats.sh[: len(splats)][behind], splats.sh[behind])
    assert edited.receipt is not None
    assert edited.receipt.untouched_sha256_before == edited.receipt.untouched_sha256_after


def test_wrap_limit_keeps_to_one_face() -> None:
    asset = sp.Painter().encode(surface_shapes.box(4_000))
    full = np.full((60, 120, 3), 0.2, np.float32)
    limited = Decal(full, MIDDLE, FRONT, 1.6, wrap=30.0).laid(asset)
    free = Decal(full, MIDDLE, FRONT, 1.6).laid(asset)
    assert len(limited.edits) < len(free.edits)
    assert limited.coverage < 0.75 < 0.95 < free.coverage


def test_the_note_says_when_less_than_half_lies_on_the_surface() -> None:
    asset = sp.Painter().encode(surface_shapes.box(4_000))
    full = np.full((60, 120, 3), 0.2, np.float32)
    limited = Decal(full, MIDDLE, FRONT, 2.6, wrap=30.0).laid(asset)
    assert limited.coverage < 0.5
    assert "less than half" in limited.note
    assert "less than half" not in Decal(full, MIDDLE, FRONT, 0.5).laid(asset).note


def test_word_around_a_corner_of_rough_surface() -> None:
    """Gaussians that scatter about the faces by half a width, as those of captures do."""
    asset = sp.Painter().encode(surface_shapes.box(3_000, noise=0.5))
    full = np.full((60, 240, 3), 0.2, np.float32)
    laid = Decal(full, MIDDLE, FRONT, 1.4).laid(asset)
    assert laid.coverage > 0.85


@pytest.mark.parametrize(
    ("count", "word", "width"), [(10_000, "STONE", 1.6), (10_000, "PEDESTAL", 1.4), (20_000, "STONE", 1.2)]
)
def test_a_word_across_three_faces_is_whole(count: int, word: str, width: float) -> None:
    """Also where so little of it lies on the sides that few samples ask for a camera there."""
    asset = sp.Painter().encode(surface_shapes.box(count))
    laid = Decal(text_picture(word, RED), MIDDLE, FRONT, width).laid(asset)
    assert laid.coverage > 0.97
    assert "the other" not in laid.note


def test_a_letter_on_an_edge_keeps_its_shape() -> None:
    """Views that face one of both faces would see the other along itself, and colour it by a line of pixels."""
    painter = sp.Painter()
    asset = painter.encode(surface_shapes.box(6_000))
    edits = Decal(text_picture("PEDESTAL", RED), MIDDLE, FRONT, 2.2).views(asset)
    seen = sp.render(painter.apply(asset, edits).splats, looking(np.array([-0.4, 0, 0.5]), np.array([0, 0, 1.0])))
    colors = seen.colors[0]
    bluish = (colors[..., 2] > colors[..., 0] + 0.15).sum()
    assert bluish < 5  # 150 of views from the fronts alone
    assert (colors[..., 0] > colors[..., 2] + 0.4).sum() > 1000


def test_fog_is_painted_from_the_sides_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where most of what a view shows is not on the surface, as if it were so on this box."""
    asset = sp.Painter().encode(surface_shapes.box(4_000))
    decal = Decal(dots(np.zeros((1, 2))), MIDDLE, FRONT, 0.5)
    (front,) = decal.views(asset)
    monkeypatch.setattr(decal_views, "DECAL_VIEWS", replace(decal_views.DECAL_VIEWS, min_clear=1.01))
    *sides, last = decal.views(asset)
    assert np.array_equal(np.asarray(last.image), np.asarray(front.image))
    angles = [np.degrees(np.arccos(side.camera.forward @ front.camera.forward)) for side in sides]
    np.testing.assert_allclose(angles, 38, atol=3)


def veiled_box() -> sp.Splats:
    """A rough box behind a thin veil, which draws the mean depth of a pixel towards it by four smoothing radii."""
    y, x = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.5, 0.5, 12), np.linspace(-0.5, 0.5, 12)))
    front = np.tile(np.array([0, 0, 1.0]), (len(x), 1))
    veil = surface_shapes.patches(np.stack([x, y, np.full(len(x), 1.0)], 1), front, 0.06)
    return surface_shapes.box(6_000, noise=0.5).append(replace(veil, opacities=np.full(len(x), 0.15, np.float32)))


def test_a_decal_behind_a_veil_is_shown_and_laid_whole() -> None:
    """On rough surface its pixels are found where the surface is trusted, not at their mean depth."""
    asset = sp.Painter().encode(veiled_box())
    aside = sp.look_at((1.3, 0.5, 3.6), (0, 0, 0.5), UP, width=240, height=240, fov=30)
    decal = Decal(np.full((48, 96, 3), 0.1, np.float32), MIDDLE, aside, 0.5)
    laid, placement = decal.laid(asset), decal.placed(asset)
    assert placement.patch.smoothing > 0, "rough"
    uv = placement.map_on(asset, asset.surface, aside)
    points = np.array([(u, v, 0.5) for u in (-0.25, 0.25) for v in (-0.125, 0.125)])
    (left, low), (right, high) = (f(aside.project(points)[0], 0) for f in (np.min, np.max))
    mapped = np.isfinite(uv[..., 0]).sum()
    assert mapped > 0.75 * (right - left) * (high - low), mapped
    assert laid.coverage > 0.97
    assert max(int(edit.mask.sum()) for edit in laid.edits if edit.mask is not None) > 0.9 * 96 * 48


def test_large_stickers_on_rough_surface_are_averaged_down_words_are_not() -> None:
    full = np.full((384, 384, 4), 1.0, np.float32)
    sides = [rough_length_px(Picture(full[..., :3], alpha), 384) for alpha in (None, full[..., 3])]
    assert sides[0] == sides[1]
    assert 0.95 * DECALS.max_rough_px < sides[0] ** 2 <= DECALS.max_rough_px
    assert rough_length_px(text_picture("PEDESTAL", RED), 384) == 384
    assert rough_length_px(text_picture("PEDESTAL", RED), 200) == 200


def test_letters() -> None:
    picture = text_picture("Hi", (0.1, 0.2, 0.3))
    assert picture.alpha is not None
    assert picture.alpha.max() > 0.99
    assert picture.size[0] < 2 * picture.size[1]
    with pytest.raises(ValueError, match="1 to 200 characters"):
        text_picture("  ", RED)


def test_widths() -> None:
    assert parse_width("12%") == (12, True)
    assert parse_width(0.5) == (0.5, False)
    for wrong in ("", "0", "-1", "nan", "wide", "inf%"):
        with pytest.raises(ValueError, match="width above 0"):
            parse_width(wrong)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"picture": np.zeros((0, 4, 3), np.float32)}, "no pixels"),
        ({"picture": np.zeros((4, 4), np.float32)}, "shape"),
        ({"picture": np.zeros((4, 4, 4), np.uint8)}, "transparent everywhere"),
        ({"picture": np.zeros((2, 200, 3), np.uint8)}, "40 to 1"),
        ({"picture": np.full((4, 4, 3), np.nan)}, "floats in 0..1"),
        ({"wrap": 0.0}, "wrap limit"),
        ({"wrap": 181.0}, "wrap limit"),
        ({"angle": float("nan")}, "angle"),
        ({"width": -1.0}, "width above 0"),
        ({"width": 1e6}, "too large"),
        ({"at": (2.0, 2.0)}, "no surface under pixel 2,2"),
        ({"at": (999.0, 2.0)}, "expected a pixel of the camera's 240x240"),
    ],
)
def test_bad_input(change: dict, words: str) -> None:
    asset = sp.Painter().encode(surface_shapes.box(4_000))
    settings = {"picture": dots(np.zeros((1, 2))), "at": MIDDLE, "camera": FRONT, "width": 0.5, **change}
    with pytest.raises(ValueError, match=words):
        Decal(**settings).views(asset)


def files(folder: Path) -> tuple[Path, Path, Path]:
    asset = saved(folder / "box.ply", surface_shapes.box(4_000))
    camera, picture = folder / "camera.json", folder / "dot.png"
    camera.write_text(FRONT.to_json(), encoding="utf-8")
    Image.fromarray((255 * dots(np.zeros((1, 2)), 64)).astype(np.uint8), "RGBA").save(picture)
    return asset, camera, picture


def test_command_line(tmp_path: Path, capfd: Capture) -> None:
    asset, camera, picture = files(tmp_path)
    out = tmp_path / "out.ply"
    where = ("--at", "120,120", "--camera", camera, "--width", "30%")
    done = run(capfd, "edit", asset, "--decal", picture, *where, "--out", out, "--json")
    assert done.code == 0, done.err
    assert done.json["verified"]
    assert "of it on the surface" in done.json["receipt"]["note"]
    assert len(done.json["receipt"]["views"]) == 1
    receipt = json.loads(Path(f"{out}.receipt.json").read_text(encoding="utf-8"))
    assert receipt["note"] == done.json["receipt"]["note"]
    word = tmp_path / "word.ply"
    done = run(capfd, "edit", asset, "--decal-text", "AB", *where, "--out", word)
    assert done.code == 0, done.err
    assert "decal 'AB'" in done.out


def test_command_line_refuses(tmp_path: Path, capfd: Capture) -> None:
    asset, camera, picture = files(tmp_path)
    base = ("edit", asset, "--out", tmp_path / "out.ply")
    where = ("--at", "120,120", "--camera", camera)
    for words, complaint in [
        (("--decal", picture, "--at", "1,1", "--width", "1"), "one --camera"),
        (("--decal", picture, *where), "needs --width"),
        (("--decal", picture, *where, "--width", "0"), "width above 0"),
        (("--decal", picture, "--at", "here", "--camera", camera, "--width", "1"), "--at X,Y"),
        (("--decal", picture, "--decal-text", "A", *where, "--width", "1"), "got both"),
        (("--decal", picture, *where, "--width", "1", "--mode", "global"), "mode local"),
        (("--decal", picture, "--at", "1,1", "--camera", camera, "--width", "1"), "no surface under pixel"),
        (("--decal", tmp_path / "none.png", *where, "--width", "1"), "none.png"),
        (("--at", "1,1", picture), "--at is for decals"),
    ]:
        assert complaint in run(capfd, *base[:2], *base[2:], *words).error
    assert not (tmp_path / "out.ply").exists()


HERO = demo_view(256)
OBLIQUE = sp.look_at((2.6, 1.3, 1.6), (0, -0.1, 0), width=256, height=256, fov=33)


@pytest.mark.parametrize(
    ("camera", "at", "width"),
    [
        (HERO, (130, 120), 0.45),
        (HERO, (190, 165), 0.22),
        (HERO, (115, 200), 0.4),
        (HERO, (128, 219), 0.4),
        (HERO, (130, 160), 0.4),
        (HERO, (187, 127), 0.35),
        (HERO, (187, 188), 0.35),
    ],
    ids=["pot", "lemon", "board", "rim of the board", "foot of the pot", "spout and pot", "lemon on board"],
)
def test_it_lies_where_its_preview_shows_it_on_the_demo_asset(camera: sp.Camera, at, width: float) -> None:
    """And nowhere else: paint over an outline used to land on what stands far behind it."""
    splats = demo_asset()
    asset, decal = Painter().encode(splats), striped(at, camera, width)
    laid = decal.laid(asset)
    edited = Painter().apply(asset, laid.edits).splats
    for view in (camera, OBLIQUE):
        uv = decal.placed(asset).map_on(asset, asset.surface, view)
        with np.errstate(invalid="ignore"):
            inside = np.asarray((np.abs(uv) < 0.5 * np.array(laid.size)).all(-1))
        before, after = (np.clip(sp.render(s, view).colors[0], 0, 1) for s in (splats, edited))
        changed = np.abs(after - before).max(-1) > 0.12
        assert not (changed & ~dilated(inside, 3)).any(), "nothing lands elsewhere"
        if view is camera:
            assert inside.sum() > 300 and changed[inside & ~dilated(~inside, 1)].mean() > 0.93
            blue = uv[..., 0] > 0
            target = np.where(blue[..., None], (0.1, 0.1, 0.7), (0.8, 0.1, 0.1))
            core = inside & ~dilated(~inside, 2) & (np.abs(uv[..., 0]) > 0.03)
            assert np.abs(after - target)[core].mean() < 0.06, "as opaque as it is shown"


@pytest.mark.parametrize(
    ("standpoint", "at", "width"),
    [((-2.6, 1.3, 2.2), (250, 475), 0.3), (None, (390, 480), 0.4)],
    ids=["lower handle", "foot of the pot"],
)
def test_no_camera_stands_in_the_hollow_of_a_pot(standpoint, at, width: float) -> None:
    """From in there the back of the wall is seen, and what is painted on it shows through, mirrored."""
    asset = Painter().encode(demo_asset())
    camera = sp.look_at(standpoint, (0, -0.1, 0), width=768, height=768, fov=33) if standpoint else demo_view(768)
    square = np.full((256, 256, 3), 0.1, np.float32)
    laid = Decal(square, at, camera, width, level=(0, 1, 0)).laid(asset)
    # Rays of our own: from the pot's middle none gets out, from each camera many do.
    for position, low, high in [(np.zeros(3), 0.0, 0.05), *((e.camera.position, 0.1, 1.0) for e in laid.edits)]:
        rays = np.random.default_rng(0).standard_normal((400, 3))
        steps = np.linspace(0.02, 3.0, 300)[:, None, None] * (rays / np.linalg.norm(rays, axis=1, keepdims=True))
        cells = np.floor((position + steps - asset.grid.min_corner) / asset.grid.voxel).astype(int)
        valid = ((cells >= 0) & (cells < asset.grid.resolution)).all(-1)
        hits = np.zeros(valid.shape, bool)
        hits[valid] = asset.grid.occupancy[tuple(cells[valid].T)]
        assert low <= 1 - hits.any(0).mean() <= high


def test_a_room_has_no_way_out_and_needs_none() -> None:
    asset = Painter().encode(surface_shapes.box(6_000))
    middle, before = np.zeros(3), np.array([0, 0, 1.5])
    assert is_open(asset, before) and not is_open(asset, middle)
    assert lies_outdoors(asset, np.array([0, 0, 0.5]), np.array([0, 0, 1.0]))
    assert not lies_outdoors(asset, np.array([0, 0, 0.5]), np.array([0, 0, -1.0]))
    assert [stands_free(asset, middle, outdoors) for outdoors in (True, False)] == [False, True]
    assert not stands_free(asset, np.array([0, 0, 0.5]), False), "in the wall"
    inside = sp.look_at((0, 0.1, -0.3), (0, 0, 0.5), UP, width=240, height=240, fov=60)
    laid = Decal(np.full((48, 96, 3), 0.1, np.float32), MIDDLE, inside, 0.3).laid(asset)
    assert laid.coverage > 0.97 and all((np.abs(e.camera.position) < 0.5).all() for e in laid.edits)


def test_nothing_is_painted_on_the_inside_of_what_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A box with double walls; for a third of the decal the survey took the inner one, as at cracks. A camera in the
    hollow would face that and paint it."""
    outer, inner = surface_shapes.box(6_000), surface_shapes.box(6_000, (0.45, 0.45, 0.45))
    asset = Painter().encode(outer.append(inner))
    survey = decal_placement.survey

    def confused(*arguments):  # type: ignore[no-untyped-def]
        patch = survey(*arguments)
        third = patch.samples.points[:, 0] > 0.04
        points = patch.samples.points - np.where(third[:, None], (0, 0, 0.05), 0)
        normals = np.where(third[:, None], -patch.samples.normals, patch.samples.normals)
        cells = PointCells.of(points, patch.samples.cells.size)
        return replace(patch, samples=replace(patch.samples, points=points, normals=normals, cells=cells))

    monkeypatch.setattr(decal_placement, "survey", confused)
    laid = Decal(np.full((64, 64, 3), RED, np.float32), MIDDLE, FRONT, 0.2).laid(asset)
    edited = Painter().apply(asset, laid.edits).splats
    hollow = sp.look_at((0, 0, 0), (0, 0, 0.45), UP, width=120, height=120, fov=60)
    for camera, low, high in ((hollow, 0, 0), (FRONT, 350, 700)):
        before, after = (np.clip(sp.render(splats, camera).colors[0], 0, 1) for splats in (asset.splats, edited))
        assert low <= (np.abs(after - before).max(-1) > 0.1).sum() <= high


def striped(at: tuple[float, float], camera: sp.Camera, width: float) -> Decal:
    picture = np.zeros((48, 112, 3), np.float32)
    picture[:, :56], picture[:, 56:] = (0.8, 0.1, 0.1), (0.1, 0.1, 0.7)
    return Decal(picture, at, camera, width, level=(0, 1, 0))


@pytest.mark.parametrize("at", [(108, 96), (150, 130)])
def test_it_stands_upright_on_the_object_from_an_oblique_view(at: tuple[float, float]) -> None:
    asset = Painter().encode(surface_shapes.sphere(1500))
    camera = sp.look_at((1.5, 2.0, 2.5), (0, 0, 0), width=240, height=240, fov=40)
    upright = Decal(np.ones((12, 24, 3), np.float32), at, camera, 0.3, level=(0, 1, 0)).placed(asset)
    leaning = Decal(np.ones((12, 24, 3), np.float32), at, camera, 0.3).placed(asset)
    sides = [np.cross(one.up, one.normal)[1] for one in (upright, leaning)]
    assert abs(sides[0]) < 0.03 < 0.045 < abs(sides[1]), "the lower edge is level"
    flat = picture_up(camera, np.array([0.1, 0.995, 0]), 0.0, np.array([0, 1.0, 0]))
    np.testing.assert_allclose(flat, picture_up(camera, np.array([0.1, 0.995, 0]), 0.0), atol=1e-9)


def test_no_view_of_a_large_sticker_is_taken_for_a_zoom_in() -> None:
    """An edit of more than two fifths of a picture is: letters of 384 pixels were torn, as it lays no sheet."""
    asset = Painter().encode(surface_shapes.sphere(1500))
    camera = looking(np.array([0, 0, -1.0]), np.array([0, 0, -1.0]))
    laid = Decal(np.ones((300, 384, 3), np.float32), (120, 120), camera, 0.5).laid(asset)
    assert laid.coverage > 0.99
    for edit in laid.edits:
        assert edit.mask is not None and 0.1 < edit.mask.mean() < 0.4


def test_lone_pixels_of_a_decal_are_specks() -> None:
    """A patch of 24 x 24 pixels, and one pixel apart from it, as where a rim in front has the surface's mean depth."""
    ys, xs = (part.ravel() for part in np.mgrid[10:34, 10:34])
    ys, xs = np.append(ys, 50), np.append(xs, 50)
    uv = 0.01 * np.stack([xs, ys], 1).astype(np.float64)
    points = np.zeros((len(ys), 3))
    seen = SurfacePixels(ys, xs, points, points, np.zeros(len(ys), bool), None)
    speck = decal_views._specks(seen, uv, (64, 64), 0.12)
    assert speck[-1] and not speck[:-1].any()
    unmapped = np.full_like(uv, np.nan)
    assert not decal_views._specks(seen, unmapped, (64, 64), 0.12).any()


def test_a_view_asks_which_of_its_pixels_are_specks(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is called a speck is neither mapped nor filled from its neighbours."""
    asset = Painter().encode(surface_shapes.sphere(1500))
    surface = Surface.of(asset.splats)
    placed = Decal(np.ones((64, 64, 3), np.float32), MIDDLE, FRONT, 0.4).placed(asset, surface)
    patch, pixel = placed.patch, 0.4 / 64

    def mapped() -> np.ndarray:
        view = decal_views.mapped_view(asset, surface, patch, patch.under, FRONT, pixel)
        out = np.zeros((FRONT.height, FRONT.width), bool)
        out[view.ys, view.xs] = True
        return out

    expected = mapped()
    ys, xs = np.nonzero(expected)
    block = np.zeros_like(expected)
    block[int(ys.mean()) - 4 : int(ys.mean()) + 4, int(xs.mean()) - 4 : int(xs.mean()) + 4] = True
    assert expected[block].all()
    monkeypatch.setattr(decal_views, "_specks", lambda seen, *_: block[seen.ys, seen.xs])
    assert not mapped()[block].any() and (mapped() | block)[expected].all()


@pytest.mark.parametrize(("seen", "paints"), [(1.0, True), (0.4, True), (0.15, False)])
def test_a_camera_that_sees_little_of_what_it_is_for_paints_nothing(
    seen: float, paints: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A decal over the edge of a box; of its right side the camera that faces it sees this share, as where another body
    stands close before it."""
    asset = Painter().encode(surface_shapes.box(6_000))
    edge = looking(np.array([0.5, 0, 0.5]), np.array([0.75, 0, 1.0]) / 1.25)
    decal = Decal(np.ones((64, 64, 3), np.float32), MIDDLE, edge, 0.5)
    view_of = decal_views._view

    def hidden(asset, surface, patch, painted, direction, members, up, pixel):  # type: ignore[no-untyped-def]
        view = view_of(asset, surface, patch, painted, direction, members, up, pixel)
        if direction[0] > 0.9:
            rows = members[view.cosines[members] > 0]
            view.cosines[rows[round(seen * len(members)) :]] = 0
        return view

    monkeypatch.setattr(decal_views, "_view", hidden)
    # How far each camera looks along -x, onto the right side.
    facing = [-float(edit.camera.world_to_camera[2, 0]) for edit in decal.laid(asset).edits]
    assert (max(facing) > 0.9) == paints, facing


def test_letters_that_the_font_lacks_are_named_and_not_drawn_as_boxes(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r"the built-in font has no letter for 'é', '本'; give a font that has: --font"
    ):
        text_picture("A\u00e9 \u672c", RED)
    with pytest.raises(ValueError, match="no letter for 'é'"):
        text_picture("Ae\u0301", RED)
    text_picture('"Hello, World!" (~{|}) \u00a0 \n 0123456789', RED)
    with pytest.raises(ValueError, match=r"gone.ttf: expected a TrueType or OpenType font \(no such file"):
        text_picture("a", RED, tmp_path / "gone.ttf")
