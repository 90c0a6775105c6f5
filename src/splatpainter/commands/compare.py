"""`splatpainter compare`: two assets seen by the same cameras: side by side, their difference, dB per view."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from splatpainter.cameras import Camera, UpAxis, orbit_cameras
from splatpainter.color import from_display, to_display
from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_marks import Argument, Positional
from splatpainter.commands.parts.option_parsing import CameraFiles
from splatpainter.commands.parts.terminal import count, decibels, progress, to_json
from splatpainter.commands.parts.view_options import BACKGROUND, MAX_VIEWS, check_ranges, color, given_cameras, rgb
from splatpainter.image_files import to_uint8
from splatpainter.io import axes_news, read
from splatpainter.output_paths import check_folder, check_target, made_folder
from splatpainter.rendering import MAX_SIDE_PX, render
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import Splats
from splatpainter.system.atomic import write_text
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    import numpy as np

MIN_SIDE_PX = 16
"""Smaller pictures have no SSIM."""
COVERED = 1 / 255
"""Alpha of either asset from which a pixel counts as covered."""
MAX_SHEET_VIEWS = 12
"""Rows of the contact sheet; with more views, the worst ones."""
SHEET_CELL_PX = 360
MIN_CELL_PX = 160
"""Captions of the pictures are not readable below."""


@dataclass(frozen=True)
class Config:
    """Render two assets from the same cameras: a ring around the first, or the cameras that you give.

    Every view becomes a picture (first asset, second asset, their difference amplified); sheet.png shows all of them,
    compare.json has dB and SSIM per view. Numbers of Gaussians may differ; colours are compared as they are displayed.

    example:
      splatpainter compare vase.ply painted.ply --out compared --views 8
      splatpainter compare vase.ply vase.sog --out compared --camera views/view_003.json --profile playcanvas
    """

    first: Annotated[Positional[Path], Argument(metavar="A")]
    """The first asset."""
    second: Annotated[Positional[Path], Argument(metavar="B")]
    """The second asset."""
    out: Annotated[Path, Argument(metavar="DIR")]
    """Folder for view_000.png, ..., sheet.png and compare.json; made if missing."""
    views: int = 8
    """How many views around the first asset."""
    camera: CameraFiles = ()
    """Use these cameras instead (CAM.json, pictures that carry one, or FILE[:N] of a capture)."""
    size: Annotated[int | None, Argument(metavar="PX", help_behavior_hint="")] = None
    """Pixels of the longer side; default: 512, or what the camera says."""
    background: Annotated[str | None, Argument(metavar="R,G,B", help_behavior_hint="")] = None
    """Colour behind both, 0..1 or #rrggbb; default: 0.25,0.25,0.25, or what the camera says."""
    profile: Profile = "inria"
    """Which renderer to match, as in `render`."""
    amplify: float = 8.0
    """Factor by which the difference is amplified."""
    up: UpAxis = "auto"
    """Direction that is up in the pictures, as in `render`."""
    elevation: float = 15.0
    """Degrees above the horizon."""
    fov: float = 40.0
    """Vertical field of view, degrees."""
    overwrite: bool = False
    """Replace files that exist."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class Likeness:
    """How similar two pictures of a view are; decibels are infinite (null in JSON) for equal ones."""

    psnr: float
    """PSNR of all pixels, dB."""
    psnr_covered: float | None
    """PSNR of the pixels that either asset covers, dB; None where neither is visible."""
    ssim: float
    lpips: float | None
    """None where there are no weights for it."""
    largest_difference: float
    """Largest difference of one channel of one pixel, 0..1."""
    differing: float
    """Part of the pixels that differ by more than half an 8-bit level."""


def run(config: Config) -> Outcome:
    """Render, measure, save."""
    # All that can be refused is refused before two assets are read.
    _check(config)
    given = given_cameras(config.camera, config.size, config.first)
    for camera in given:
        if min(camera.width, camera.height) < MIN_SIDE_PX:
            raise ValueError(f"splatpainter compare: expected views of {MIN_SIDE_PX} pixels or more a side")
    # Names come before the work, so that a file that is there is refused before anything is rendered.
    total = len(given) or config.views
    names = [f"view_{k:03d}.png" for k in range(total)]
    check_folder(config.out)
    if config.out.is_dir():
        for name in (*names, "sheet.png", "compare.json"):
            check_target(config.out / name, config.overwrite, untouchable=[config.first, config.second])
    # The cameras are placed around the first asset, and both are seen by the same ones.
    first, second = read(config.first), read(config.second)
    cameras = given or orbit_cameras(
        first,
        config.views,
        size=config.size or 512,
        up=config.up,
        elevation=config.elevation,
        fov=config.fov,
        background=color(config.background or BACKGROUND, first),
    )
    # A background that is asked for holds against what cameras carry.
    if given and config.background is not None:
        cameras = [replace(camera, background=color(config.background, first)) for camera in cameras]
    with made_folder(config.out):
        results, thumbs = _compared(config, first, second, cameras, names)
    # By the views' own decibels: the sheet has room for few, and the worst are those to look at.
    worst = sorted(range(total), key=lambda k: results[k].psnr)
    _save_sheet(config, results, names, thumbs, sorted(worst[:MAX_SHEET_VIEWS]))
    # Errors are pooled before decibels: a mean of decibels would let one good view hide a bad one.
    pooled = _pooled([one.psnr for one in results])
    summary = {
        "psnr": pooled,
        "ssim": sum(one.ssim for one in results) / total,
        "worst_view": names[worst[0]],
        "identical": all(one.differing == 0 and one.largest_difference == 0 for one in results),
    }
    # Hashes say which bytes were compared, for names of files may be given to others later.
    record = {
        "a": {"file": config.first, "sha256": first.sha256, "rows": len(first)},
        "b": {"file": config.second, "sha256": second.sha256, "rows": len(second)},
        "profile": config.profile,
        "difference_amplified": config.amplify,
        **summary,
        "sheet": config.out / "sheet.png",
        "views": [
            {"file": config.out / name, "camera": camera.record(), **asdict(one)}
            for name, camera, one in zip(names, cameras, results, strict=True)
        ],
    }
    # Written last, when every picture that it names is there.
    write_text(config.out / "compare.json", to_json(record) + "\n")
    lines = [f"{name}  {_words(one)}" for name, one in zip(names, results, strict=True)]
    lines += [
        f"all {count(total, 'view')}: {decibels(pooled)}, SSIM {summary['ssim']:.4f}, worst {names[worst[0]]}",
        f"pictures, sheet.png and compare.json in {config.out}",
        # Axes are named where they are news, for the two assets may lie differently.
        *axes_news(first, str(config.first)),
        *axes_news(second, str(config.second)),
    ]
    return Outcome(record, lines)


def _compared(
    config: Config, first: Splats, second: Splats, cameras: Sequence[Camera], names: Sequence[str]
) -> tuple[list[Likeness], list[list[np.ndarray]]]:
    """(likeness per view, the three pictures per view shrunk for the sheet); saves a picture of each view."""
    from splatpainter.contact_sheet import Strip, sheet, write_sheet

    # Pictures are saved as they are made; of each only a small copy stays in memory, for the sheet.
    results, thumbs = [], []
    for camera, name in progress(zip(cameras, names, strict=True), len(names), "comparing"):
        # One background on the display, whatever the space of each asset's colours, or it would count as a difference.
        behind = to_display(np.array(camera.background), first.color_space)
        pictures, covered = [], np.zeros((camera.height, camera.width), bool)
        for splats in (first, second):
            same = replace(camera, background=tuple(from_display(behind, splats.color_space).tolist()))
            drawn = render(splats, same, profile=config.profile)
            pictures.append(np.clip(to_display(drawn.colors[0], splats.color_space), 0, 1))
            # What either asset covers: the background is the same in both and would flatter the figures.
            covered |= drawn.alphas[0, ..., 0] >= COVERED
        likeness = _likeness(pictures[0], pictures[1], covered)
        # Small differences are made visible; the factor stands in the caption.
        pictures.append(np.clip(config.amplify * np.abs(pictures[0] - pictures[1]), 0, 1))
        labels = _labels(config)
        strip = Strip(f"{name}  {_words(likeness)}", tuple(zip(labels, pictures, strict=True)))
        # Pictures that are smaller than their captions are enlarged.
        write_sheet(config.out / name, sheet([strip], max(camera.width, camera.height, MIN_CELL_PX)))
        results.append(likeness)
        thumbs.append([_thumb(picture) for picture in pictures])
    return results, thumbs


def _save_sheet(
    config: Config,
    results: Sequence[Likeness],
    names: Sequence[str],
    thumbs: Sequence[Sequence[np.ndarray]],
    chosen: Sequence[int],
) -> None:
    from splatpainter.contact_sheet import Strip, sheet, write_sheet

    labels = _labels(config)
    strips = [Strip(f"{names[k]}  {_words(results[k])}", tuple(zip(labels, thumbs[k], strict=True))) for k in chosen]
    # The same pooling as in compare.json, so that title and file agree.
    all_in = _pooled([one.psnr for one in results])
    title = f"{config.first.name} and {config.second.name}: {decibels(all_in)} over {count(len(names), 'view')}"
    # A sheet of some views says so, or it would be taken for all.
    if len(chosen) < len(names):
        title += f", the {len(chosen)} worst"
    write_sheet(config.out / "sheet.png", sheet(strips, SHEET_CELL_PX, title))


def _labels(config: Config) -> tuple[str, str, str]:
    return f"A: {config.first.name}", f"B: {config.second.name}", f"|A - B| x {config.amplify:g}"


def _likeness(a: np.ndarray, b: np.ndarray, covered: np.ndarray) -> Likeness:
    from splatpainter.metrics import LpipsUnavailable, lpips, psnr, ssim

    # Weights of LPIPS may be missing, and tiny pictures have none; the other figures are worth having alone.
    try:
        distance = lpips(a, b) if min(a.shape[:2]) >= 32 else None
    except LpipsUnavailable:
        distance = None
    # The largest channel: a pixel that differs in one only is another colour.
    difference = np.abs(a - b).max(-1)
    inside = psnr(a, b, covered) if covered.any() else None
    differing = float((difference > 0.5 / 255).mean())
    return Likeness(psnr(a, b), inside, ssim(a, b), distance, float(difference.max()), differing)


def _words(one: Likeness) -> str:
    if math.isinf(one.psnr):
        return "identical"
    return f"{one.psnr:.2f} dB, SSIM {one.ssim:.4f}" + ("" if one.lpips is None else f", LPIPS {one.lpips:.4f}")


def _pooled(values: Sequence[float]) -> float:
    """Decibels of the mean squared error of several pictures."""
    # Identical pictures have infinite decibels and no error.
    error = sum(0.0 if math.isinf(value) else 10 ** (-value / 10) for value in values) / len(values)
    return math.inf if error == 0 else -10 * math.log10(error)


def _thumb(picture: np.ndarray) -> np.ndarray:
    from PIL import Image

    # Shrunk at once: whole pictures of many views would fill the memory.
    image = Image.fromarray(to_uint8(picture))
    image.thumbnail((SHEET_CELL_PX, SHEET_CELL_PX), Image.Resampling.LANCZOS)
    return np.asarray(image)


def _check(config: Config) -> None:
    # Bounds of the options in one table, so that each refusal reads alike.
    size = 512 if config.size is None else config.size
    values = {
        "--views": (config.views, 1, MAX_VIEWS),
        "--size": (size, MIN_SIDE_PX, MAX_SIDE_PX // 3),  # three of them stand side by side
        "--elevation": (config.elevation, -90, 90),
        "--fov": (config.fov, 1, 170),
        "--amplify": (config.amplify, 1, 255),
    }
    check_ranges("compare", values)
    if config.background is not None:
        rgb(config.background)
