"""`bench lift`: local edits on real assets, as a person would make them: how well, how cleanly, how fast, and proven.

Every asset is converted to PLY, seen close up (closeups.py), painted with text and a brush stroke, and edited through
`Painter.apply`; the result is written, read again and verified against the original. The same paint is put a second
time where the surface is seen at a grazing angle, the hardest place for an edit.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from splatbench import scenes
from splatbench.closeups import Closeup, closeup, grazing_closeup
from splatbench.reprojection import reproject, surface_depth
from splatbench.scoring import decibels
from splatbench.timing import machine, measure
from splatpainter import text_tables as tables
from splatpainter.cameras import Camera
from splatpainter.contact_sheet import Strip, error_map, sheet, write_sheet
from splatpainter.image_files import to_uint8
from splatpainter.io import detect, format_of_name, read, write
from splatpainter.lift.masks import change_mask
from splatpainter.painter import Asset, Edit, EditSettings, Method, Painter
from splatpainter.pictures.drawing import over, solid_layer
from splatpainter.receipts import score, verify
from splatpainter.splats import Splats

BACKGROUND = (0.33, 0.35, 0.37)
OTHER_VIEWS = (("20° left", -20.0, 0.0), ("40° right", 40.0, 0.0), ("15° higher", 0.0, 15.0))
"""(label, azimuth, elevation) of the other views that are scored."""
SHEET_TURNS = (20.0, 40.0, 60.0)
"""Degrees to the left (of grazing close-ups: to the side on which the surface turns to the camera) of the views that
are shown."""
GOALS = "Goals: inside at least 28 dB, outside at least 38 dB, every untouched Gaussian exact."
NOTES = (
    GOALS,
    "`before` and `inside`: render before and after the edit against the painted picture, under the paint; `outside`: "
    "render after against render before, elsewhere. `novel inside` and `novel outside`: the same from 20° left, 40° "
    "right and 15° higher (mean, and worst), against the paint moved there through the surface's depth. `split inside` "
    "and `split outside`: Gaussians split as for the edit but no colour changed, after against before. `exact`: the "
    "edited PLY was read again, and every Gaussian that the receipt does not list has its bytes. Setup: reading the "
    "PLY and making the voxel grid; edit: the whole of `Painter.apply`, median. `grazing inside` and `grazing novel`: "
    "the same paint where the surface is seen at 60 to 75 degrees from its normal, there and 20°, 40° and 60° to the "
    "side on which it turns to the camera (mean).",
)


@dataclass(frozen=True)
class LiftBench:
    """Paint on a close-up of every given asset, edit it, and measure how well, how cleanly and how fast.

    example:
      splatpainter bench lift vase.ply assets/ --out out/bench-lift
    """

    assets: Annotated[Positional[tuple[Path, ...]], arg(metavar="ASSET ...", help_behavior_hint="")] = ()
    """Splat files, or folders of them (one file per name up to the first dot); none: the bundled demo asset."""
    without_demo: bool = False
    """Leave out the bundled demo asset, which otherwise comes first."""
    out: Path = Path("out/bench-lift")
    """Folder for lift.csv, lift.md, sheet.png and one full-size strip per asset; made if missing."""
    size: int = 512
    """Edge of the pictures, pixels."""
    text: str = "PAINT"
    """Text to paint on every asset."""
    font: Path | None = None
    """TrueType or OpenType font; default: the one that comes with Pillow, made bold."""
    repeats: int = 3
    """Timed edits per asset; the median counts."""
    preset: str = "lift"
    """The painter: "lift", or a preset or folder of weights to compare with it (method ttt)."""
    method: Literal["auto", "lift", "fit", "ttt"] | None = None
    """Method of the edits; default: lift, or ttt with a preset of weights."""


@dataclass(frozen=True)
class Lift:
    """One asset's line: PSNR in dB (None where there was no such pixel), counts of Gaussians, seconds."""

    asset: str
    rows: int
    sh_degree: int
    filled: float
    """Part of the view that the surface covers, 0..1."""
    painted: float
    """Part of the view that the paint covers, 0..1."""
    before: float | None
    inside: float | None
    outside: float | None
    novel_inside: float | None
    novel_outside: float | None
    split_inside: float | None
    split_outside: float | None
    touched: int
    appended: int
    untouched: int
    exact: bool
    setup_seconds: float
    edit_seconds: float
    grazing_inside: float | None
    grazing_novel: float | None


def run(config: LiftBench, report: Callable[[str], None] | None = None) -> list[Lift]:
    """Edit every asset; write lift.csv, lift.md, sheet.png and strips; return the lines. report: called with a line per
    asset. Raises ValueError for files that are missing or no splats, and for sizes under 64."""

    if config.size < 64 or config.repeats < 1:
        raise ValueError(
            f"bench lift: expected --size from 64 and --repeats from 1, got {config.size}, {config.repeats}"
        )
    paths = [*([] if config.without_demo else [None]), *find_assets(config.assets)]
    if not paths:
        raise ValueError("bench lift: expected splat files, folders of them, or the demo asset; got none of these")
    where = machine()
    config.out.mkdir(parents=True, exist_ok=True)
    lines: list[Lift] = []
    strips: list[Strip] = []
    for path, name in zip(paths, _names(paths), strict=True):
        line, pictures = measure_asset(path, name, config)
        lines.append(line)
        strips += pictures
        write_sheet(config.out / f"{line.asset}.png", sheet(pictures, config.size))
        if report:
            report(pictures[0].caption)
    write_sheet(config.out / "sheet.png", sheet(strips, min(config.size, 288), where))
    tables.write_csv(config.out / "lift.csv", lines, where)
    tables.write_markdown(config.out / "lift.md", lines, where, NOTES)
    return lines


def find_assets(paths: Sequence[Path]) -> list[Path]:
    """Files as given; of folders every splat file, but one per name up to the first dot: PLY if there is one, else the
    first by name. A folder that is itself an asset (SOG) is one. Raises ValueError for a missing file and for a folder
    without assets."""
    assets = []
    for path in paths:
        if not path.is_dir() or (path / "meta.json").is_file():
            detect(path)  # raises for what is missing or no splats
            assets.append(path)
            continue
        by_stem: dict[str, Path] = {}
        for file in sorted(path.iterdir(), key=lambda file: (file.name.split(".", 1)[-1] != "ply", file.name)):
            if (file / "meta.json").is_file() if file.is_dir() else format_of_name(file) is not None:
                by_stem.setdefault(_stem(file), file)
        if not by_stem:
            raise ValueError(f"{path}: expected splat files in this folder, found none")
        assets += [by_stem[name] for name in sorted(by_stem)]
    return assets


def _stem(path: Path) -> str:
    """The file's name up to the first dot."""
    return path.name.split(".", 1)[0]


def _names(paths: Sequence[Path | None]) -> list[str]:
    """Stems, full names where those are not unique."""
    stems = ["demo" if path is None else _stem(path) for path in paths]
    pairs = zip(paths, stems, strict=True)
    return [stem if path is None or stems.count(stem) == 1 else path.name for path, stem in pairs]


def measure_asset(path: Path | None, name: str, config: LiftBench) -> tuple[Lift, list[Strip]]:
    """Paint, edit, score and verify one asset; None: the demo asset. Strips: the close-up's, the grazing one's."""
    from splatpainter.demo_asset import demo_asset

    source = demo_asset() if path is None else read(path)
    view = closeup(source, config.size, BACKGROUND)
    with tempfile.TemporaryDirectory(prefix="splatpainter-bench-") as folder:
        ply = Path(folder) / "original.ply"
        write(ply, source)
        painter = Painter.load(config.preset)
        method = config.method or ("lift" if painter.model is None else "ttt")
        start = time.perf_counter()
        asset = painter.encode(read(ply), method)
        assert asset.grid is not None
        setup = time.perf_counter() - start
        before = CloseupViews(asset.splats, view)
        edit, layers = painted_edit(before, config)
        results: list[Asset] = []
        timing = measure(
            lambda: results.append(painter.apply(asset, [edit], method=method)),
            warmups=0,
            repeats=config.repeats,
            budget=10,
        )
        painted = results[0]
        exact = _verified(painted, ply, Path(folder) / "edited.ply")
    grazing = _grazing(source, asset, painter, method, config)
    line = _scored(name, asset, painted, exact, edit, layers, before, view, (setup, timing.seconds), grazing)
    strips = [Strip(_caption(line, method), _cells(edit, painted.splats, view))]
    if grazing.cells:
        strips.append(Strip(f"{name}, grazing: {_grazing_caption(line)}", grazing.cells))
    return line, strips


class CloseupViews:
    """The close-up of an asset and the other views, drawn."""

    def __init__(self, splats: Splats, view: Closeup, directions: Sequence[tuple[float, float]] | None = None) -> None:
        """directions: (azimuth, elevation), by default OTHER_VIEWS."""
        from splatpainter.rendering import render

        turns = [other[1:] for other in OTHER_VIEWS] if directions is None else directions
        self.cameras: list[Camera] = [view.camera, *(view.turned(azimuth, rise) for azimuth, rise in turns)]
        self.filled = view.filled
        renders = render(splats, self.cameras)
        self.images = np.clip(renders.colors, 0, 1)
        """[C, H, W, 3]"""
        self.covers = renders.alphas[..., 0]
        """[C, H, W]"""


@dataclass(frozen=True)
class Grazing:
    """The edit of the grazing close-up."""

    inside: float | None = None
    novel: float | None = None
    cells: tuple[tuple[str, np.ndarray], ...] = ()
    """Empty: the asset has no such view."""


def _grazing(source: Splats, asset: Asset, painter: Painter, method: Method, config: LiftBench) -> Grazing:
    try:
        view = grazing_closeup(source, config.size, BACKGROUND)
    except ValueError:
        return Grazing()
    turns = _sheet_turns(view)
    before = CloseupViews(asset.splats, view, turns)
    edit, layers = painted_edit(before, config)
    try:
        painted = painter.apply(asset, [edit], method=method)
    except ValueError:  # too little of it is solid
        return Grazing()
    assert painted.receipt is not None
    inside, _ = novel_scores(asset.splats, layers, before, CloseupViews(painted.splats, view, turns))
    cells = _cells(edit, painted.splats, view)
    return Grazing(painted.receipt.views[0].psnr_after, float(np.mean(inside)) if inside else None, cells)


def _sheet_turns(view: Closeup) -> list[tuple[float, float]]:
    return [(view.front_turn * degrees, 0.0) for degrees in SHEET_TURNS]


def painted_edit(before: CloseupViews, config: LiftBench) -> tuple[Edit, list[np.ndarray]]:
    """The close-up with paint on it, and the layers of the paint."""
    layers = painted_layers(before.images[0], before.covers[0], config)
    edited = before.images[0]
    for layer in layers:
        edited = over(edited, layer)
    return Edit(to_uint8(edited), before.cameras[0]), layers


def _cells(edit: Edit, painted: Splats, view: Closeup) -> tuple[tuple[str, np.ndarray], ...]:
    """The edited picture, the edited asset from there and from SHEET_TURNS, and the error."""
    after = CloseupViews(painted, view, _sheet_turns(view))
    way = "left" if view.front_turn < 0 else "right"
    labels = ["after", *(f"after, {degrees:.0f}° {way}" for degrees in SHEET_TURNS)]
    error = ("error (white: 0.25)", error_map(after.images[0], edit.image))
    return (("edited picture", edit.image), *zip(labels, after.images, strict=True), error)


def painted_layers(image: np.ndarray, cover: np.ndarray, config: LiftBench) -> list[np.ndarray]:
    """The text and, under it, the stroke, each in the colour that shows best where it lies on the picture [H, W, 3].
    Paint stays on the surface: it ends where `cover` [H, W] does."""
    shape, unit = image.shape[:2], image.shape[0] / 512
    center = (shape[1] / 2, 0.42 * shape[0])
    text = scenes.text_layer(config.text, shape, center, 90 * unit, font=config.font)
    stroke = scenes.stroke_layer(shape, scenes.wave(shape, 0.68), 30 * unit, 6 * unit)
    first = scenes.color_against(image, text[..., 3])
    second = scenes.color_against(image, stroke[..., 3], first)
    layers = [solid_layer(text[..., 3], first), solid_layer(stroke[..., 3], second)]
    for layer in layers:
        layer[..., 3] *= np.clip((cover - 0.8) / 0.15, 0, 1)
    return layers


def _verified(painted: Asset, original: Path, target: Path) -> bool:
    """Write the edited asset and compare the files, Gaussian by Gaussian and against the receipt."""
    write(target, painted.splats)
    assert painted.receipt is not None
    receipt = replace(painted.receipt, output_sha256=read(target).sha256)
    return verify(original, target, receipt).ok


def _scored(
    name: str,
    asset: Asset,
    painted: Asset,
    exact: bool,
    edit: Edit,
    layers: Sequence[np.ndarray],
    before: CloseupViews,
    closeup_view: Closeup,
    seconds: tuple[float, float],
    grazing: Grazing,
) -> Lift:
    receipt = painted.receipt
    assert receipt is not None
    view = receipt.views[0]
    inside, outside = novel_scores(asset.splats, layers, before, CloseupViews(painted.splats, closeup_view))
    return Lift(
        asset=name,
        rows=len(asset.splats),
        sh_degree=asset.splats.sh_degree,
        filled=before.filled,
        painted=float((np.stack(layers)[..., 3].max(0) > 0).mean()),
        before=view.psnr_before,
        inside=view.psnr_after,
        outside=view.psnr_outside,
        novel_inside=float(np.mean(inside)) if inside else None,
        novel_outside=min(outside) if outside else None,
        **_split_alone(asset, edit, before.images[0]),
        touched=len(receipt.touched),
        appended=receipt.appended_rows,
        untouched=receipt.untouched_rows,
        exact=exact,
        setup_seconds=seconds[0],
        edit_seconds=seconds[1],
        grazing_inside=grazing.inside,
        grazing_novel=grazing.novel,
    )


def _grazing_caption(line: Lift) -> str:
    return f"inside {decibels(line.grazing_inside)}, other views {decibels(line.grazing_novel)} dB"


def _caption(line: Lift, method: Method) -> str:
    proof = "the rest exact" if line.exact else "UNTOUCHED GAUSSIANS DIFFER"
    return (
        f"{line.asset}, {line.rows:,} Gaussians, {method}: "
        f"inside {decibels(line.before)} -> {decibels(line.inside)} dB, outside {decibels(line.outside)}, "
        f"other views {decibels(line.novel_inside)} / {decibels(line.novel_outside)}, "
        f"splitting alone {decibels(line.split_inside)} / {decibels(line.split_outside)}; "
        f"{line.touched:,} touched, {line.appended:,} appended, {proof}; {line.edit_seconds:.2f} s"
    )


def novel_scores(
    splats: Splats, layers: Sequence[np.ndarray], before: CloseupViews, after: CloseupViews
) -> tuple[list[float], list[float]]:
    """PSNR per other view: (under the paint against the expected picture, elsewhere against the render before)."""
    inside, outside = [], []
    depths = [surface_depth(splats, camera) for camera in before.cameras]
    for k in range(1, len(before.cameras)):
        expected = before.images[k]
        painted, clean = np.zeros(expected.shape[:2], bool), np.ones(expected.shape[:2], bool)
        for layer in layers:
            moved = reproject(layer, before.cameras[0], depths[0], before.cameras[k], depths[k])
            expected = over(expected, moved.layer)
            painted, clean = painted | moved.painted, clean & moved.clean
        inside.append(score(after.images[k], expected, painted))
        outside.append(score(after.images[k], before.images[k], clean))
    return [v for v in inside if v is not None], [v for v in outside if v is not None]


def _split_alone(asset: Asset, edit: Edit, before: np.ndarray) -> dict[str, float | None]:
    """Scores of a lift that splits but paints nothing."""
    from splatpainter.lift.options import LocalOptions
    from splatpainter.rendering import render

    split = Painter(settings=EditSettings(local_options=LocalOptions(rounds=0))).apply(asset, [edit])
    assert split.receipt is not None
    mask = change_mask(edit.image, before)
    image = render(split.splats, edit.camera).colors[0]
    return {"split_inside": score(image, before, mask), "split_outside": score(image, before, ~mask)}
