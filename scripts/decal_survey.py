"""Decals at random places of assets: how much is laid beside what the preview shows, how much of it has holes, CPU.

    python scripts/decal_survey.py ASSET_OR_FOLDER ... [--clicks 4] [--seed 0] [--width 22%] [--pictures OUT]

Every asset is clicked at random pixels of views from around it (seeded by --seed and its file's name; a click has to
have the asset all around it). A rectangle of two stripes, in colours that the asset has not there, is previewed and
laid as the studio does it, level to the asset's up. Both are looked at from the clicked view and from 20, 40 and 60
degrees to both sides of it:

    outside   pixels that the edit changed (by more than CHANGED in a channel) farther than MARGIN_PX from what the
              preview shows, in per cent of what it shows, summed over the seven views
    holes     pixels of the preview, MARGIN_PX and more inside of it, that did not change, in per cent of those
    off       the same pixels where they changed: mean distance from the colour that the preview shows there
    preview,  CPU seconds of the process: the survey and the first preview; laying after it (what is left to find out);
    lay, edit the edit itself

A decal that is refused is a line with the reason. --pictures OUT writes one picture per decal: previews, results, and
results with what is outside (white) and holes (black), from -60 to 60 degrees. Assets whose up is not -y: --up=+y.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import splatpainter as sp
from splatpainter import io
from splatpainter.cameras import AUTO_UP, UPS, Camera, orbit_cameras
from splatpainter.decals.decals import Decal
from splatpainter.lift.masks import dilated
from splatpainter.painter import Asset, Painter
from splatpainter.splats import Splats

CHANGED = 0.12
"""Least change of a channel, 0..1, of a pixel that counts as painted. Source: taste."""
MARGIN_PX = 3
"""Pixels at the decal's edge that are not judged: paint and preview are both soft there."""
TURNS = (0, -20, 20, -40, 40, -60, 60)
"""Degrees around the up through the decal's middle from which it is looked at."""
SIZE_PX = 320
SUFFIXES = (".ply", ".sog", ".spz", ".splat", ".ksplat")
STRIPES = ((0.9, 0.05, 0.7), (0.05, 0.8, 0.15), (0.95, 0.75, 0.05), (0.1, 0.2, 0.95))
"""Colours of which the two farthest from the place are taken."""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", type=Path, nargs="+")
    parser.add_argument("--clicks", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--width", default="22%")
    parser.add_argument("--up", choices=UPS, default=AUTO_UP)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for path in _files(options.assets):
        splats = io.read(path)
        asset = Painter().encode(splats)
        _ = asset.surface, asset.grid  # what an open session has at hand
        of_asset = []
        for number, (camera, at) in enumerate(_clicks(splats, path.name, options.up, options.clicks, options.seed)):
            row: dict[str, Any] = {"asset": path.name, "click": number}
            picture = options.pictures and options.pictures / f"{path.name.split('.')[0]}_{number}.png"
            try:
                row |= _judged(asset, camera, at, options.width, np.array(UPS[options.up], float), picture)
            except ValueError as error:
                row |= {"refused": str(error)}
            of_asset.append(row)
            print(_line(row), flush=True)
        print(_line({"asset": path.name, "click": "all", **_total(of_asset)}), flush=True)
        rows += of_asset
    print(_line({"asset": "all", "click": "all", **_total(rows)}))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def _files(paths: Sequence[Path]) -> Iterator[Path]:
    for path in paths:
        if path.is_dir():
            yield from sorted(file for file in path.iterdir() if file.name.lower().endswith(SUFFIXES))
        elif path.exists():
            yield path
        else:
            sys.exit(f"{path}: no such file or folder")


def _clicks(splats: Splats, name: str, up: str, count: int, seed: int) -> Iterator[tuple[Camera, tuple[float, float]]]:
    """(view, pixel) with the asset all around it."""
    rng = np.random.default_rng([seed, *name.encode()])
    found = 0
    while found < count:
        azimuth, elevation = rng.uniform(0, 360), rng.uniform(0, 35)
        (camera,) = orbit_cameras(splats, 1, size=SIZE_PX, up=up, elevation=elevation, azimuth=azimuth)
        alpha = sp.render(splats, camera).alphas[0].reshape(SIZE_PX, SIZE_PX)
        solid = ~dilated(alpha < 0.9, 8)
        ys, xs = np.nonzero(solid)
        if not len(ys):
            continue
        k = rng.integers(len(ys))
        found += 1
        yield camera, (float(xs[k]) + 0.5, float(ys[k]) + 0.5)


def _judged(
    asset: Asset, camera: Camera, at: tuple[float, float], width: str, up: np.ndarray, file: Path | None
) -> dict[str, Any]:
    surface = asset.surface
    before = np.clip(sp.render(asset.splats, camera).colors[0], 0, 1)
    here = before[int(at[1]), int(at[0])]
    far = sorted(STRIPES, key=lambda color: -float(np.abs(np.array(color) - here).max()))[:2]
    picture = np.zeros((96, 144, 3), np.float32)
    picture[:, :72], picture[:, 72:] = far
    decal = Decal(picture, at, camera, width, level=tuple(up))
    clock = time.process_time()
    placement = decal.placed(asset, surface)
    views = [_turned(camera, placement.point, up, turn) for turn in TURNS]
    maps = [placement.map_on(asset, surface, views[0])]
    cpu = [time.process_time() - clock]
    maps += [placement.map_on(asset, surface, view) for view in views[1:]]
    clock = time.process_time()
    laid = decal.laid(asset, surface, placement)
    cpu.append(time.process_time() - clock)
    clock = time.process_time()
    edited = Painter().apply(asset, laid.edits).splats
    cpu.append(time.process_time() - clock)
    sums, rows = np.zeros(5), []
    for view, uv in zip(views, maps, strict=True):
        bare, after = (np.clip(sp.render(splats, view).colors[0], 0, 1) for splats in (asset.splats, edited))
        with np.errstate(invalid="ignore"):
            inside = np.asarray((np.abs(uv) < 0.5 * np.array(laid.size)).all(-1))
        right = np.nan_to_num(uv[..., 0]) > 0
        shown = np.where(right[..., None], far[1], far[0]).astype(np.float32)
        changed = np.abs(after - bare).max(-1) > CHANGED
        core = inside & ~dilated(~inside, MARGIN_PX)
        outside = changed & ~dilated(inside, MARGIN_PX)
        painted = core & changed & (np.abs(np.nan_to_num(uv[..., 0])) > 0.03 * laid.size[0])
        off = np.abs(after - shown).mean(-1)
        sums += [outside.sum(), inside.sum(), (core & ~changed).sum(), core.sum(), off[painted].sum()]
        rows.append((painted.sum(), bare, after, inside, shown, outside, core & ~changed))
    painted_px = max(sum(row[0] for row in rows), 1)
    if file is not None:
        _draw(rows, file)
    return {
        "outside": 100 * sums[0] / max(sums[1], 1),
        "holes": 100 * sums[2] / max(sums[3], 1),
        "off": sums[4] / painted_px,
        "inside_px": int(sums[1]),
        "on surface": placement.surface_share,
        "views": len(laid.edits),
        "rough": bool(placement.patch.smoothing),
        "new": len(edited) - len(asset.splats),
        "preview": cpu[0],
        "lay": cpu[1],
        "edit": cpu[2],
    }


def _turned(camera: Camera, point: np.ndarray, up: np.ndarray, degrees: float) -> Camera:
    """The camera after a turn around an axis through a point."""
    x, y, z = up
    across, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.radians(degrees)
    turn = np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = turn, point - turn @ point
    return Camera(
        *(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
        camera.world_to_camera @ np.linalg.inv(moved),
        offset=None,
    )


def _draw(rows: list[Any], file: Path) -> None:
    """Above: previews; in the middle: results; below: results with what is outside (white) and holes (black)."""
    columns = []
    for _, bare, after, inside, shown, outside, holes in rows:
        preview = np.where(inside[..., None], shown, bare)
        marked = 0.6 * after + 0.2
        marked[outside], marked[holes] = (1, 1, 1), (0, 0, 0)
        columns.append(np.concatenate([preview, after, marked]))
    sheet = np.concatenate([columns[k] for k in (5, 3, 1, 0, 2, 4, 6)], 1)
    Image.fromarray((255 * np.clip(sheet, 0, 1)).astype(np.uint8)).save(file)


def _total(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    laid = [row for row in rows if "refused" not in row]
    if not laid:
        return {"refused": len(rows)}
    names = [name for name in laid[0] if name not in ("asset", "click", "rough")]
    return {name: float(np.mean([row[name] for row in laid])) for name in names} | {"laid": f"{len(laid)}/{len(rows)}"}


def _line(row: dict[str, Any]) -> str:
    words = [f"{row['asset']:44s} {row['click']!s:>4s}"]
    for name, value in row.items():
        if name not in ("asset", "click"):
            words.append(f"{name} {value:.2f}" if isinstance(value, float) else f"{name} {value}")
    return "  ".join(words)


if __name__ == "__main__":
    main()
