"""Things removed from assets whose things are known: is what goes the whole thing, the selection alone, or neither?

    python scripts/removal_survey.py --shared SHARED [--cache DIR] [--half 0|1] [--only WORD] [--json OUT]

Meshes stand on boards, on other meshes, or touch one another, so that it is known which Gaussians are whose: as even
Gaussians (clean), as few irregular ones (rough), and as 3DGS fits pictures of them (fitted; kept in --cache). Captured
statues stand on pedestals whose tops are known. In each, seeded by its name, is selected, as the studio and WHERE do:

    lasso    an outline around the thing, a little too wide, from a view; twice    the whole thing must go
    sphere   around all of it                                                      the whole thing must go
    inner    an ellipse well within its outline, from a view                       the whole thing or the selection
    large    a ball around a place on it, 15 to 45 % of it; twice                  the whole thing or the selection
    spot     the same, 2 to 8 % of it; twice                                       the selection alone
    ground   the same on what it stands on                                         the selection alone

A removal is "whole" where it takes WHOLE of the thing and no more than EXTRA of its number beside it, "part" where it
is the selection, else "neither": a cut through a surface. Figures: share of the thing that goes; Gaussians of what is
not the thing that go, over the thing's; CPU seconds. Gaussians as near to two things as to one count for nothing.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull, KDTree

import splatpainter as sp
from splatpainter import io
from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.holes.body import body_of
from splatpainter.lift.masks import dilated
from splatpainter.rendering.pixel_shares import beside_mask, share_of
from splatpainter.session.selection.selection import in_mask
from splatpainter.splats import Splats
from splattrain.data.environments import load_environment
from splattrain.data.lights import make_light, shade_all
from splattrain.data.lit_assets import fitted
from splattrain.data.lit_scenes import SceneObject
from splattrain.data.materials import Material
from splattrain.data.meshes import Mesh, joined, load_mesh
from splattrain.data.surfels import coarse_asset, sample_surfels, to_splats
from splattrain.data.viewpoints import Optics

WHOLE = 0.95
"""Least share of a thing from which it is whole."""
EXTRA = 0.06
"""Most of what is not the thing that goes with it, over the thing's number."""
SIZE_PX = 320
SURFELS = 60_000
COUNTS = {"clean": 16_000, "rough": 16_000, "fitted": 20_000}
ROUGHNESS = 0.5
EXPECTED = {
    **dict.fromkeys(("lasso", "sphere"), ("whole",)),
    **dict.fromkeys(("inner", "large"), ("whole", "part")),
    **dict.fromkeys(("spot", "ground"), ("part",)),
}

SCENES: tuple[tuple[str, tuple[str, ...], str], ...] = (
    # What stands on what: things side by side, the first is removed; a texture's board, or a mesh.
    ("gso_room_essentials_mug_white_yellow", (), "godot_texture_wood"),
    ("gso_schleich_hereford_bull", (), "gz_grass"),
    ("gso_sperry_topsider_psufpwqxpp3", (), "ambientcg_Marble006"),
    ("gso_bunny_racer", (), "gz_tarmac"),
    ("gso_animal_planet_foam_2headed_dragon", (), "polyhaven_fabric_pattern_07"),
    ("gso_android_figure_panda", (), "ambientcg_WoodFloor043"),
    ("gso_room_essentials_salad_plate_turquoise", (), "ambientcg_Tiles036"),
    ("aws_warehouse_bucket_01", (), "gz_plywood"),
    ("dave_hardhat_ribbed", (), "gz_grey_wall"),
    ("gso_schleich_african_black_rhino", ("gso_schleich_bald_eagle",), "godot_sand_albedo"),
    ("gso_room_essentials_mug_white_yellow", ("aws_retail_bookc_01",), "gz_wood_osb"),
    ("kk_knight", (), "polyhaven_grassy_cobblestone"),
    ("aws_residential_vase_01", (), "aws_residential_coffeetable_01"),
    ("kk_food_burger", (), "kk_table_long_decorated_c"),
    ("pc_statue", (), "godot_marble_albedo"),
    ("pcw_raccoon_head", (), "godot_texture_bricks"),
    ("gz_construction_cone", ("gz_fire_hydrant",), "gz_tarmac"),
    ("rl_painted_wooden_stool_1k", (), "ambientcg_WoodFloor043"),
    ("gso_cole_hardware_school_bell_solid_brass_38", (), "gz_wood_slats"),
    ("kh_waterbottle", (), "godot_rock_albedo"),
    ("gso_dino_5", ("gso_dino_3",), "polyhaven_rocky_trail"),
    ("kh_avocado", (), "gso_room_essentials_salad_plate_turquoise"),
    ("aws_residential_chaira_01", (), "ambientcg_WoodFloor043"),
    ("ss_desk_chair", (), "ambientcg_Marble006"),
    ("gso_schleich_s_bayala_unicorn_70432", (), "gz_grass"),
    ("gso_breyer_horse_of_the_year_2015", (), "godot_sand_albedo"),
    ("pm_zombie_1", (), "gz_tarmac"),
    ("pm_male", (), "polyhaven_grassy_cobblestone"),
    ("kk_chest_gold", (), "gz_wood_osb"),
    ("gz_cordless_drill", (), "rl_wooden_table_02_1k"),
    ("bab_vintagedeskfan_vintagefan_animated", ("aws_retail_booka_01",), "gz_plywood"),
    ("gso_school_bus", ("gso_thomas_friends_wooden_railway_porter_5jzrhmm",), "gz_tarmac"),
    ("bevy_fox", (), "gz_bark"),
    ("rl_painted_wooden_cabinet_02_1k", (), "godot_wool_albedo"),
)
FITTED = (0, 1, 4, 7, 9, 11, 15, 20, 24, 27, 31, 32)
"""Scenes that are fitted too."""
CAPTURED = {"angel.sog": 0.0, "narcissus.sog": -0.03, "st-peter.sog": 0.03, "massa.sog": 0.0}
"""Heights of pedestals' tops, y down."""
UNSURE = 0.06
"""World units about these that are not judged."""


@dataclass(frozen=True)
class Scene:
    """An asset and what is known of it."""

    name: str
    form: str
    splats: Splats
    is_thing: np.ndarray
    """[N] bool."""
    is_judged: np.ndarray
    """[N] bool."""
    up: str


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--half", type=int, choices=(0, 1))
    parser.add_argument("--only", default="")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--pictures", type=Path, help="of what is neither")
    options = parser.parse_args(arguments)
    for folder in (options.cache, options.pictures):
        if folder:
            folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for scene in _scenes(options.shared / "data", options.cache, options.half, options.only):
        for kind, number, selected, beside in _selections(scene):
            row, taken = _judged(scene, kind, selected, beside)
            rows.append(row)
            print(_line(row), flush=True)
            if options.pictures and not row["right"]:
                _draw(scene, selected, taken, options.pictures / f"{scene.name}_{scene.form}_{kind}{number}.png")
    for form in dict.fromkeys(row["form"] for row in rows):
        for kind in EXPECTED:
            print(_total(form, kind, [row for row in rows if row["form"] == form and row["kind"] == kind]))
    for kind in EXPECTED:
        print(_total("all", kind, [row for row in rows if row["kind"] == kind]))
    print(_total("all", "all", rows))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def _scenes(data: Path, cache: Path | None, half: int | None, only: str) -> Iterator[Scene]:
    for number, (thing, others, ground) in enumerate(SCENES):
        name = f"{number:02d}_{thing}"
        if (half is None or number % 2 == half) and (only in name or not only):
            for form in ("clean", "rough", "fitted"):
                if form != "fitted" or number in FITTED:
                    yield _made(data, cache, name, (thing, *others), ground, form)
    for number, (file, top) in enumerate(CAPTURED.items()):
        if (half is None or number % 2 == half) and (only in file or not only):
            splats = io.read(data / "splats" / file).numpy()
            y = splats.means[:, 1]
            judged = (np.abs(y - top) > UNSURE) & (splats.opacities > 0.05)
            yield Scene(file.split(".")[0], "captured", splats, y < top, judged, "-y")


def _made(data: Path, cache: Path | None, name: str, things: Sequence[str], ground: str, form: str) -> Scene:
    key = hashlib.sha256(repr((name, things, ground, form, COUNTS, SURFELS, ROUGHNESS)).encode()).hexdigest()[:16]
    file = None if cache is None else cache / f"{key}.npz"
    if file is not None and file.exists():
        with np.load(file) as arrays:
            fields = [arrays[field] for field in ("means", "quats", "scales", "opacities", "sh")]
            return Scene(name, form, Splats(*fields), arrays["is_thing"], arrays["is_judged"], "+y")
    parts = _placed(data, things, ground)
    dense = sample_surfels(joined(name, parts), SURFELS)
    light = make_light(load_environment(sorted((data / "hdris").glob("*.hdr"))[len(name) % 20]))
    if form == "fitted":
        item = SceneObject(name, dense, dense, float(dense.means.norm(dim=1).max()))
        splats = fitted(item, light, Optics(384), COUNTS[form], np.random.default_rng(0))
    else:
        few = coarse_asset(dense, COUNTS[form], 0, ROUGHNESS if form == "rough" else 0.0)
        splats = to_splats(few, shade_all(few, light.coefficients, light.exposure, 0)).numpy()
    # Whose a Gaussian is: that of the nearest surface, where that is clear.
    distances = np.stack([KDTree(_points(part)).query(splats.means)[0] for part in parts])
    nearest = np.sort(distances, axis=0)
    clear = nearest[1] - nearest[0] > 0.5 * np.median(splats.scales.max(1))
    is_judged = clear & (splats.opacities > 0.05)
    scene = Scene(name, form, splats, distances.argmin(0) == 0, is_judged, "+y")
    if file is not None:
        arrays = {field: getattr(splats, field) for field in ("means", "quats", "scales", "opacities", "sh")}
        np.savez(file, **arrays, is_thing=scene.is_thing, is_judged=is_judged)
    return scene


def _placed(data: Path, things: Sequence[str], ground: str) -> list[Mesh]:
    """Meshes: things in a row that touch, on a board or on another mesh."""
    parts, at = [], 0.0
    for thing in things:
        mesh = load_mesh(data / "meshes" / f"{thing}.glb")
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        scale = 0.8 / float((high - low).max())
        # The first one's right side is the next one's left.
        left = 0.0 if not parts else at - scale * float(low[0])
        shift = np.array([left, -scale * float(low[1]), 0.0], np.float32)
        parts.append(replace(mesh, vertices=(mesh.vertices * scale + shift).astype(np.float32)))
        at = float(parts[-1].vertices[:, 0].max()) - 0.02
    texture = data / "textures" / f"{ground}.jpg"
    if texture.exists():
        return [*parts, _board(texture)]
    below = load_mesh(data / "meshes" / f"{ground}.glb")
    # Scaled so that the first thing has room on it; its highest level under the middle carries it.
    vertices = below.vertices * np.float32(1.1)
    points = _points(replace(below, vertices=vertices))
    middle = np.hypot(points[:, 0], points[:, 2]) < 0.1
    vertices = vertices - np.array([0, points[middle, 1].max(), 0], np.float32)
    return [*parts, replace(below, vertices=vertices.astype(np.float32))]


def _board(texture: Path) -> Mesh:
    """2 by 2, a little thick, its top at 0."""
    corners, faces, normals, uvs = [], [], [], []
    low, high = np.array([-1, -0.08, -1]), np.array([1, 0, 1])
    for axis in range(3):
        for side in (0, 1):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            first = len(corners)
            for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
                corner = np.zeros(3)
                corner[axis] = (low, high)[side][axis]
                corner[u], corner[v] = (low, high)[a][u], (low, high)[b][v]
                normal = np.zeros(3)
                normal[axis] = 2 * side - 1
                corners.append(corner)
                normals.append(normal)
                uvs.append((corner[u], corner[v]))
            quad = [(first, first + 1, first + 2), (first, first + 2, first + 3)]
            faces += quad if side else [face[::-1] for face in quad]
    material = Material(np.asarray(Image.open(texture).convert("RGB")))
    arrays = [np.array(part, np.float32) for part in (corners, normals, uvs)]
    return Mesh("board", arrays[0], np.array(faces), arrays[1], arrays[2], np.zeros(len(faces), np.int64), (material,))


def _points(mesh: Mesh, count: int = 60_000) -> np.ndarray:
    """[P, 3] evenly over a mesh."""
    rng = np.random.default_rng(1)
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(corners), count, p=area / area.sum())]
    a, b = rng.uniform(size=(2, count))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    return chosen[:, 0] + a[:, None] * (chosen[:, 1] - chosen[:, 0]) + b[:, None] * (chosen[:, 2] - chosen[:, 0])


def _selections(scene: Scene) -> Iterator[tuple[str, int, np.ndarray, np.ndarray | None]]:
    """(kind, number, [N] bool, [N] bool what an outline leaves beside it)."""
    splats = scene.splats
    rng = np.random.default_rng([*scene.name.encode(), *scene.form.encode()])
    means = splats.means.astype(np.float64)
    sure = scene.is_thing & scene.is_judged & splats.drawable
    for number in range(2):
        yield "lasso", number, *_lassoed(scene, rng, sure, False)
    yield "inner", 0, *_lassoed(scene, rng, sure, True)
    low, high = means[sure].min(0), means[sure].max(0)
    middle = (low + high) / 2
    yield "sphere", 0, np.linalg.norm(means - middle, axis=1) < np.linalg.norm(means[sure] - middle, axis=1).max(), None
    kinds = (("large", 2, (0.15, 0.45), sure), ("spot", 2, (0.02, 0.08), sure))
    for kind, count, shares, of in kinds:
        for number in range(count):
            center = means[rng.choice(np.flatnonzero(of))]
            away = np.linalg.norm(means - center, axis=1)
            yield kind, number, away < np.quantile(away[of], rng.uniform(*shares)), None
    ground = ~scene.is_thing & scene.is_judged & splats.drawable
    center = means[rng.choice(np.flatnonzero(ground))]
    away = np.linalg.norm(means - center, axis=1)
    yield "ground", 0, (away < np.quantile(away[ground], rng.uniform(0.02, 0.06))) & ~sure, None


def _lassoed(scene: Scene, rng: np.random.Generator, sure: np.ndarray, is_inner: bool) -> tuple[np.ndarray, np.ndarray]:
    """([N] bool: what of the visible surface lies within an outline, from a view that shows the thing; [N] bool: what
    lies beside it)."""
    splats = scene.splats
    (camera,) = orbit_cameras(
        splats.take(np.flatnonzero(sure)),
        1,
        size=SIZE_PX,
        up=scene.up,
        elevation=rng.uniform(5, 35),
        azimuth=rng.uniform(0, 360),
    )
    shown = share_of(splats, camera, sure) > 0.5
    ys, xs = np.nonzero(shown)
    mask = Image.new("L", (SIZE_PX, SIZE_PX))
    pen = ImageDraw.Draw(mask)
    if is_inner:
        x, y, w, h = np.median(xs), np.median(ys), 0.3 * np.ptp(xs), 0.3 * np.ptp(ys)
        pen.ellipse((x - w, y - h, x + w, y + h), fill=255)
    else:
        corners = np.stack([xs, ys], 1)[ConvexHull(np.stack([xs, ys], 1)).vertices]
        pen.polygon([tuple(corner) for corner in corners.tolist()], fill=255)
    drawn = np.asarray(mask) > 0
    drawn = drawn if is_inner else dilated(drawn, int(rng.integers(2, 9)))
    mask = drawn.astype(np.float32)
    return in_mask(splats, camera, mask) > 0.5, beside_mask(splats, camera, mask)


def _judged(
    scene: Scene, kind: str, selected: np.ndarray, beside: np.ndarray | None
) -> tuple[dict[str, Any], np.ndarray]:
    clock = time.process_time()
    body = body_of(scene.splats, selected, beside)
    cpu = time.process_time() - clock
    taken = selected if body is None else body
    thing, other = scene.is_thing & scene.is_judged, ~scene.is_thing & scene.is_judged
    share, extra = float(taken[thing].mean()), float((taken & other).sum() / thing.sum())
    is_whole = share >= WHOLE and extra <= EXTRA
    came_out = "part" if body is None else "whole" if is_whole else "neither"
    # A selection that is the whole thing by itself (a ball around a thing in the air) is whole as well.
    right = came_out in EXPECTED[kind] or (body is None and is_whole)
    row = {"scene": scene.name, "form": scene.form, "kind": kind, "came out": came_out, "right": right}
    row |= {"selected": float(selected[thing].mean()), "share": share, "extra": extra, "cpu": cpu}
    return row, taken


def _total(form: str, kind: str, rows: Sequence[dict[str, Any]]) -> str:
    if not rows:
        return f"{form:9s} {kind:7s} none"
    count = {word: sum(row["came out"] == word for row in rows) for word in ("whole", "part", "neither")}
    whole = [row for row in rows if "whole" in EXPECTED[row["kind"]] and row["came out"] != "part"]
    share = np.mean([row["share"] for row in whole]) if whole else np.nan
    extra = np.mean([row["extra"] for row in whole]) if whole else np.nan
    return (
        f"{form:9s} {kind:7s} right {sum(row['right'] for row in rows):3d} of {len(rows):3d}  whole {count['whole']:3d}"
        f"  part {count['part']:3d}  neither {count['neither']:3d}  of bodies: thing {100 * share:5.1f} %"
        f"  beside {100 * extra:5.1f} %  cpu {np.mean([row['cpu'] for row in rows]):.2f}"
    )


def _line(row: dict[str, Any]) -> str:
    mark = " " if row["right"] else "*"
    return (
        f"{mark} {row['scene'][:36]:36s} {row['form']:8s} {row['kind']:7s} {row['came out']:7s}"
        f"  selected {row['selected']:.2f}  thing {row['share']:.2f}  beside {row['extra']:.2f}  cpu {row['cpu']:.2f}"
    )


def _draw(scene: Scene, selected: np.ndarray, taken: np.ndarray, file: Path) -> None:
    """The asset, without the selection, without what goes, from 0, 90 and 180 degrees."""
    cameras = [
        orbit_cameras(scene.splats, 1, size=SIZE_PX, up=scene.up, elevation=15, azimuth=azimuth)[0]
        for azimuth in (0, 90, 180)
    ]
    rows = []
    for gone in (np.zeros_like(taken), selected, taken):
        left = replace(scene.splats, opacities=np.where(gone, np.float32(0), scene.splats.opacities))
        rows.append(np.concatenate([_shown(left, camera) for camera in cameras], 1))
    Image.fromarray((255 * np.concatenate(rows)).astype(np.uint8)).save(file)


def _shown(splats: Splats, camera: Camera) -> np.ndarray:
    return np.clip(sp.render(splats, camera).colors[0], 0, 1)


if __name__ == "__main__":
    main()
