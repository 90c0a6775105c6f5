"""`splatpainter info`: what a file holds. Loads neither torch nor numba."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatpainter.cameras import bounding_sphere
from splatpainter.commands import Outcome
from splatpainter.commands.option_parsing import AssetFile, FrameOption
from splatpainter.commands.terminal import count, size, stages
from splatpainter.io import FORMATS, frame_line, read
from splatpainter.io.sog_container import META
from splatpainter.splats import Splats


@dataclass(frozen=True)
class Config:
    """Show what a splat file holds, and what is odd about it.

    example:
      splatpainter info vase.ply
    """

    asset: AssetFile
    """A splat file, or a SOG folder."""
    frame: FrameOption = "auto"
    """Axes of the file's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row; what is left of the cut part is kept."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Read the file and describe it."""
    with stages(1) as bar:
        bar.enter("reading")
        record = describe(read(config.asset, frame=config.frame, lenient=config.lenient), config.asset)
    return Outcome(record, _lines(record))


def describe(splats: Splats, path: Path) -> dict:
    """The record of `info`: bounds are [2, 3] (min, max) of finite centres; null where there are none."""
    assert splats.source is not None
    entry = FORMATS[splats.source.format]
    with np.errstate(all="ignore"):  # of extreme or damaged Gaussians, which are counted below
        drawable = splats.drawable
        finite = splats.means[np.isfinite(splats.means).all(1)]
        center, radius = bounding_sphere(splats)
    return {
        "file": path,
        "bytes": file_size(path),
        "sha256": splats.sha256,
        "format": entry.key,
        "description": entry.description,
        "rows": len(splats),
        "rows_not_drawn": int((~drawable).sum()),
        "sh_degree": splats.sh_degree,
        "color_space": splats.color_space,
        "antialiased": splats.antialiased,
        "frame": {
            "axes": splats.source.frame,
            "from": splats.source.frame_from,
            "description": frame_line(splats.source),
        },
        "bounds": [finite.min(0), finite.max(0)] if len(finite) else None,
        "reach": {"center": center, "radius": radius} if drawable.any() else None,
        "problems": list(splats.source.problems),
        "exact": entry.exact,
        "lossy": entry.lossy,
        "writable": entry.write is not None,
    }


def file_size(path: Path) -> int:
    """Bytes of a file, or of the files in a folder (of a SOG asset, by its folder or its meta.json)."""
    folder = path.parent if path.name.lower() == META else path
    if folder.is_dir():
        return sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
    return path.stat().st_size


def _lines(record: dict) -> list[str]:
    bounds, around = record["bounds"], record["reach"]
    gaussians = count(record["rows"], "Gaussian")
    if record["rows_not_drawn"]:
        gaussians += f", of which {record['rows_not_drawn']:,} cannot be drawn (NaN, infinite, or out of range)"
    fields = {
        "file": f"{record['file']} ({size(record['bytes'])})",
        "format": record["description"],
        "Gaussians": gaussians,
        "SH degree": str(record["sh_degree"]),
        "colours": f"{record['color_space']}{', antialiased (2D filter)' if record['antialiased'] else ''}",
        "frame": record["frame"]["description"],
        "bounds": f"{_point(bounds[0])} to {_point(bounds[1])}" if bounds else "no Gaussian has a finite centre",
        "most of it": f"within {around['radius']:.3g} of {_point(around['center'])}" if around else "none can be drawn",
        "sha256": record["sha256"],
        "kept": record["exact"],
        "lost": f"When written again: {record['lossy']}" if record["lossy"] else "",
    }
    lines = [f"{name:<10} {text}" for name, text in fields.items() if text]
    return lines + [f"{'problem':<10} {problem}" for problem in record["problems"]]


def _point(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"
