"""`splatpainter fit`: a 3DGS asset from a mesh, from pictures with cameras, or from another asset's renders."""

from __future__ import annotations

import sys
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from splatpainter.commands import Outcome
from splatpainter.commands.info import file_size
from splatpainter.commands.parts.option_marks import Argument, Positional
from splatpainter.commands.parts.option_parsing import OutFile
from splatpainter.commands.parts.terminal import BAR_DELAY_SECONDS, count, decibels, seconds, size, warn, watched
from splatpainter.output_paths import check_target, placed, splat_format
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.commands.parts.fit_sources import FitPictures
    from splatpainter.fit.optimize import TrainingView
    from splatpainter.splats import Splats

LIMITS: dict[str, tuple[int, int]] = {
    "steps": (1, 1_000_000),
    "rows": (16, 5_000_000),
    "most_rows": (16, 20_000_000),
    "views": (2, 1000),
    "held_out": (0, 1000),
    "sh_degree": (0, 4),
    "surfels": (64, 10_000_000),
    "samples": (1, 100_000),
    "seed": (0, 2**31 - 1),
}
MIN_PICTURE_PX, MAX_PICTURE_PX = 16, 4096
"""Pixels of a picture's edge."""


@dataclass(frozen=True)
class Config:
    """Optimise a 3D Gaussian asset until its renders match pictures, as 3DGS does.

    SOURCE is a mesh (GLB, glTF, OBJ; rendered from all around), a splat file (fitted anew to its own renders), or a
    folder of pictures that carry their camera (as `splatpainter render` writes them) or have a NeRF-style
    transforms.json, COLMAP's sparse/0 or INRIA's cameras.json; or one of these lists by its name. Lens distortion is
    taken out, what mask_path has black is not looked at, and INRIA's exposure.json is undone.

    example:
      splatpainter fit chair.glb --out chair.ply --steps 2000
      splatpainter fit photos/ --out scene.ply --size 512
    """

    source: Annotated[Positional[Path], Argument(metavar="SOURCE")]
    """Mesh, splat file or folder of pictures."""
    out: OutFile
    """The splat file to write; its name says the format."""
    steps: int = 1000
    """Optimisation steps; each looks at one picture."""
    rows: int = 20_000
    """Gaussians to start with."""
    most_rows: int = 300_000
    """Most Gaussians; densification stops there."""
    fixed: bool = False
    """Keep the number of Gaussians: no densification."""
    views: int = 48
    """Views rendered around a mesh or an asset, to fit to."""
    held_out: int = 8
    """Further views that only judge the result; of a folder's pictures, at most a quarter."""
    size: Annotated[int | None, Argument(metavar="PX", help_behavior_hint="")] = None
    """Pixels of the longer side; default: 256, or what the pictures have."""
    sh_degree: int = 2
    """SH degree of the view-dependent colour, 0 to 4."""
    seed: int = 0
    """Equal seeds and options give equal Gaussians on the CPU."""
    truth: Literal["surfels", "traced"] = "surfels"
    """How a mesh is rendered: as dense Gaussians (seconds), or path traced by Mitsuba."""
    environment: Annotated[Path | None, Argument(metavar="HDR", help_behavior_hint="")] = None
    """Light on a mesh (.hdr, .exr); default: the same from everywhere."""
    surfels: int = 200_000
    """Dense Gaussians that a mesh is rendered from."""
    samples: int = 64
    """Paths per pixel (--truth traced)."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Processor that optimises."""
    overwrite: bool = False
    """Replace OUT if it exists."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Make the pictures, optimise, write, and judge."""
    from splatpainter.commands.parts.fit_sources import FitPictureSettings, fit_pictures

    # Options and the name of OUT first: fitting takes minutes, and a mistake should cost none of them.
    _check(config)
    entry = splat_format(config.out)
    check_target(config.out, config.overwrite, [config.source])
    clock = time.perf_counter()
    settings = FitPictureSettings(**{field.name: getattr(config, field.name) for field in fields(FitPictureSettings)})
    # The pictures may be rendered, read, or taken from a mesh; from here on all are alike.
    pictures = fit_pictures(config.source, settings)
    for note in pictures.notes:
        warn(note)
    # Making pictures and fitting are timed apart: either may be what takes long.
    start, prepared = pictures.start, time.perf_counter() - clock
    fitted = _fitted(config, pictures)
    fitting = time.perf_counter() - clock - prepared
    # Under its name only once it is whole.
    with placed(config.out) as partial:
        from splatpainter.io import write

        # The fit was made near the origin; the offset puts it back where the pictures' world is.
        write(partial, replace(fitted, offset=pictures.offset))
    # Training views show whether it converged, held-out ones whether that is worth anything.
    training = _psnr(fitted, pictures.views)
    held_out = _psnr(fitted, pictures.held_out) if pictures.held_out else None
    timings = {"pictures": prepared, "fit": fitting}
    record = {
        "source": {"file": config.source, "kind": pictures.kind},
        "output": {
            "file": config.out,
            "format": entry.key,
            "bytes": file_size(config.out),
            "rows": len(fitted),
            "first_rows": len(start),
        },
        "steps": config.steps,
        "views": {"training": len(pictures.views), "held_out": len(pictures.held_out)},
        "psnr": {"training": training, "held_out": held_out},
        "seconds": timings,
    }
    summary = f"training views {decibels(training)}" + (
        "" if held_out is None else f", held-out views {decibels(held_out)}"
    )
    lines = [
        f"{config.source} -> {config.out}",
        f"{count(len(fitted), 'Gaussian')} from {len(start):,}; {size(record['output']['bytes'])}",
        f"{summary} ({len(pictures.views)} and {len(pictures.held_out)} views)",
        seconds(timings),
    ]
    return Outcome(record, lines)


def _fitted(config: Config, pictures: FitPictures) -> Splats:
    from tqdm import tqdm

    from splatpainter.fit.optimize import FitOptions, optimize

    # Densification is what makes the number of Gaussians unforeseen, so it can be left out.
    options = FitOptions(
        steps=config.steps,
        densify=not config.fixed,
        seed=config.seed,
        most_gaussians=config.most_rows,
        device=config.device,
    )
    # The bar appears only where a person looks and after some seconds.
    with tqdm(
        total=config.steps, desc="fitting", delay=BAR_DELAY_SECONDS, leave=False, file=sys.stderr, disable=not watched()
    ) as bar:
        return optimize(pictures.start, pictures.views, options, watch=lambda step, _: bar.update(step - bar.n)).splats


def _psnr(splats: Splats, views: list[TrainingView]) -> float:
    """Mean over views, each where it is looked at, dB."""
    import numpy as np

    from splatpainter.metrics import psnr
    from splatpainter.rendering import render

    drawn = (np.clip(render(splats, view.camera).colors[0], 0, 1) for view in views)
    return float(np.mean([psnr(colors, view.color, view.mask) for colors, view in zip(drawn, views, strict=True)]))


def _check(config: Config) -> None:
    # All bounds in one table; each refusal names the option as it is typed.
    for name, (low, high) in LIMITS.items():
        value = getattr(config, name)
        if not low <= value <= high:
            option = name.replace("_", "-")
            raise ValueError(f"splatpainter fit: expected --{option} from {low:,} to {high:,}, got {value:,}")
    if config.size is not None and not MIN_PICTURE_PX <= config.size <= MAX_PICTURE_PX:
        raise ValueError(
            f"splatpainter fit: expected --size from {MIN_PICTURE_PX} to {MAX_PICTURE_PX}, got {config.size}"
        )
    # Fewer at most than at the start could not be.
    if config.most_rows < config.rows:
        raise ValueError(f"splatpainter fit: expected --most-rows of at least --rows, {config.rows:,}")
    # A missing GPU is told before pictures are made.
    if config.device == "cuda":
        from splatpainter.rendering.cuda import require

        require()
