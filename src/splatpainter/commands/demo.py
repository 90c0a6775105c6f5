"""`splatpainter demo`: the main job on the bundled asset, done with the same commands that a person would type."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.commands import Outcome, edit
from splatpainter.commands.parts.demo_paint import evening, painted
from splatpainter.commands.parts.demo_sheet import Panel, animation, overview
from splatpainter.commands.parts.option_marks import Argument
from splatpainter.commands.parts.terminal import decibels, size, stages
from splatpainter.io import files, read, write
from splatpainter.kernels.portable import arctan2, cos, hypot, length, sin
from splatpainter.output_paths import check_folder, made_folder, save_picture
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

FRAMES = 36
DUSK = (0.150, 0.125, 0.165)
"""Background of the evening pictures, display sRGB."""
HALF_TURN = (-1, -1, 1)
"""The bundled asset is made with y up; files in the axes of captures, as every other program expects, have y down."""
_Made = TypeVar("_Made")


@dataclass(frozen=True)
class Config:
    """Paint on the bundled asset and see all results.

    Writes to DIR: asset.ply, before.png, edited.png (painted on in 2D), painted.ply with its receipt, pictures of it
    from three sides, a regraded picture and the whole asset in that light (evening.ply), overview.png, turntable.webp.

    example:
      splatpainter demo --out demo
    """

    out: Annotated[Path, Argument(metavar="DIR")] = Path("demo")
    """Folder; made if missing, files of the same names are replaced."""
    size: Annotated[int, Argument(metavar="PX")] = 800
    """Pixels of the pictures' edges."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Make, render, paint, edit, look."""
    # Imported here, as torch is: --help must stay quick.
    from splatpainter.demo_asset import BACKGROUND, demo_asset
    from splatpainter.io.axes import flip

    # The size decides how long all of it takes; a mistake is refused before anything is made.
    if not 64 <= config.size <= 2048:
        raise ValueError(f"splatpainter demo: expected --size from 64 to 2048, got {config.size}")
    check_folder(config.out)
    out, clock = config.out, _Steps()
    # Each step is timed apart, for the demo is also what people judge the speed by.
    with made_folder(config.out), stages(6) as bar:
        bar.enter("asset")
        # As files of captures lie: the demo takes the way that the user's own files take.
        asset = clock.timed("unpack the asset", lambda: flip(demo_asset(), HALF_TURN))
        clock.timed("write it", lambda: write(out / "asset.ply", asset, overwrite=True))
        splats = read(out / "asset.ply")
        # The picture knows its asset by hash, so that `edit` can find it.
        hero = replace(view(0, 0, config.size, BACKGROUND), asset_sha256=splats.sha256)
        before = clock.timed("render a view", lambda: _shot(splats, hero))
        save_picture(out / "before.png", before, hero)
        bar.enter("paint")
        # Painted in 2D alone: nothing here knows of Gaussians.
        edited = clock.timed("paint on the picture (2D)", lambda: painted(before, hero))
        save_picture(out / "edited.png", edited, hero)
        bar.enter("edit")
        # By the command itself, with its checks and receipt, and not by a way of the demo's own.
        local = _edit(out / "asset.ply", out / "edited.png", out / "painted.ply", "local")
        clock.add("local edit", local)
        after = read(out / "painted.ply")
        bar.enter("regrade")
        # Seen from the sides that the picture did not show: that is where an edit proves itself.
        renders = {
            "after": _shot(after, hero),
            "after_left": _shot(after, view(-38, 2, config.size, BACKGROUND)),
            "after_above": _shot(after, view(24, 24, config.size, BACKGROUND, 1.15)),
        }
        for name, pixels in renders.items():
            save_picture(out / f"{name}.png", pixels)
        # The second edit goes on from the first one's file, as a person would.
        regraded = evening(renders["after"])
        save_picture(out / "regraded.png", regraded, replace(hero, asset_sha256=after.sha256))
        global_edit = _edit(out / "painted.ply", out / "regraded.png", out / "evening.ply", "global")
        clock.add("global edit", global_edit)
        last = read(out / "evening.ply")
        bar.enter("overview")
        # From another side and in another light: the whole asset took the regrade.
        renders["evening"] = _shot(last, view(-62, 4, config.size, DUSK, 1.1))
        save_picture(out / "evening.png", renders["evening"])
        save_picture(out / "overview.png", overview(_panels(before, edited, regraded, renders, local["receipt"])))
        bar.enter("turntable")
        # Half the size: a turn has many views, and the file should stay small.
        frames = [_shot(last, view(360 * k / FRAMES, 4, config.size // 2, DUSK)) for k in range(FRAMES)]
        film, ending = clock.timed(f"turntable, {FRAMES} views", lambda: animation(frames))
        with files.writing(out / f"turntable{ending}") as file:
            file.write(film)
    record = {"out": out, "steps": clock.steps, "turntable_bytes": len(film), "rows": len(last)}
    lines = [*clock.table(), "", f"{out / 'overview.png'} shows it all; turntable{ending} ({size(len(film))}) turns it"]
    return Outcome(record, lines)


def view(
    azimuth: float, elevation: float, size: int, background: tuple[float, float, float], back: float = 1.0
) -> Camera:
    """The recommended view of the bundled asset, in the axes of its file, moved to the right by `azimuth` and up by
    `elevation` degrees around its target, at `back` times the distance."""
    from splatpainter.demo_asset import HERO_EYE, HERO_FOV, HERO_TARGET

    # The file's axes are turned, so the recommended camera is turned with them.
    eye, target = np.array(HERO_EYE) * HALF_TURN, np.array(HERO_TARGET) * HALF_TURN
    x, y, z = eye - target
    far = length(eye - target)
    # Moved by angles about the target, so that the asset stays in the middle.
    side = arctan2(x, z) - np.radians(azimuth)  # y points down, so right is towards -x
    rise = arctan2(-y, hypot(x, z)) + np.radians(elevation)
    moved = back * far * np.array([sin(side) * cos(rise), -sin(rise), cos(side) * cos(rise)])
    return look_at(target + moved, target, (0, -1, 0), width=size, height=size, fov=HERO_FOV, background=background)


def _shot(splats: Splats, camera: Camera) -> np.ndarray:
    from splatpainter.rendering import render

    return np.clip(render(splats, camera).colors[0], 0, 1)


def _edit(asset: Path, picture: Path, out: Path, mode: Any) -> dict[str, Any]:
    return edit.run(edit.Config(asset, pictures=(picture,), out=out, mode=mode, overwrite=True)).record


def _panels(
    before: np.ndarray, edited: np.ndarray, regraded: np.ndarray, renders: dict[str, np.ndarray], receipt: dict
) -> list[Panel]:
    # Figures come from the receipt and not from the demo: they are what was proved.
    total, touched, added = receipt["asset"]["rows"], receipt["touched_rows"], receipt["appended_rows"]
    spent = receipt["seconds"]["prepare"] + receipt["seconds"]["lift"]
    return [
        Panel(before, "1  the asset", f"{total:,} Gaussians"),
        Panel(edited, "2  a picture of it, painted on", "text, a brush stroke, a sticker: any 2D editor will do"),
        Panel(renders["after"], "3  the asset, edited", f"{touched:,} changed, {added:,} added in {spent:.1f} s"),
        Panel(renders["after_left"], "4  from the left", f"{total - touched:,} are byte for byte what they were"),
        Panel(renders["after_above"], "5  from above", "the paint lies on the surface"),
        Panel(
            renders["evening"],
            "6  one regraded picture, the whole asset",
            "the small picture was all it took",
            regraded,
        ),
    ]


class _Steps:
    """Steps of the demo: what was done, in how many seconds, with what result."""

    def __init__(self) -> None:
        self.steps: list[dict[str, Any]] = []

    def timed(self, name: str, work: Callable[[], _Made]) -> _Made:
        start = time.perf_counter()
        result = work()
        self.steps.append({"what": name, "seconds": round(time.perf_counter() - start, 3)})
        return result

    def add(self, name: str, record: dict[str, Any]) -> None:
        receipt = record["receipt"]
        keys = ("touched_rows", "appended_rows")
        self.steps.append(
            {
                "what": name,
                "seconds": round(sum(receipt["seconds"].values()), 3),
                **receipt["views"][0],
                **{key: receipt[key] for key in keys},
                "same_rows": record["same_rows"],
            }
        )

    def table(self) -> list[str]:
        lines = [
            f"{'':<26}{'seconds':>8}  {'edited part':>20}  {'elsewhere':>9}  {'changed':>8}  {'added':>8}  {'same':>8}"
        ]
        # Steps that are edits have their figures; the others only took time.
        for step in self.steps:
            line = f"{step['what']:<26}{step['seconds']:>8.2f}"
            if "same_rows" in step:
                change = f"{decibels(step['psnr_before'])} -> {decibels(step['psnr_after'])}"
                line += f"  {change:>20}  {decibels(step['psnr_outside']):>9}  {step['touched_rows']:>8,}"
                line += f"  {step['appended_rows']:>8,}  {step['same_rows']:>8,}"
            lines.append(line)
        return lines
