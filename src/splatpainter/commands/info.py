"""`splatpainter info`: what a file holds. Loads no torch."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from splatpainter.cameras import bounding_sphere
from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_parsing import AssetFile, InAxesOption
from splatpainter.commands.parts.terminal import count, size, stages
from splatpainter.doubts import doubts
from splatpainter.io import FORMATS, Format, asset_file, axes_line, read
from splatpainter.io.folders import iterations
from splatpainter.io.formats.sog_container import META
from splatpainter.io.positions import MAX_STEP, coarseness
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config:
    """Show what a splat file holds, and what is odd about it.

    example:
      splatpainter info vase.ply
    """

    asset: AssetFile
    """A splat file, a SOG folder, or a folder of INRIA's trainer (point_cloud/iteration_N)."""
    in_axes: InAxesOption = "auto"
    """Axes of the file's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row; what is left of the cut part is kept."""
    losses: bool = False
    """Also write the asset in every format, aside, and say what each would lose, and how large its file is."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Read the file and describe it."""
    with stages(1) as bar:
        # One stage: reading is all that takes long, and the bar shows that something is going on.
        bar.enter("reading")
        splats = read(config.asset, axes=config.in_axes, lenient=config.lenient)
        record = describe(splats, config.asset)
        # A trainer's folder holds more than one asset, and perhaps cameras beside it.
        if config.asset.is_dir():
            record |= describe_folder(config.asset)
        # Written in every format, aside, so only where it is asked for.
        if config.losses:
            record["losses"] = losses_by_format(splats)
    return Outcome(record, _lines(record))


def describe(splats: Splats, path: Path) -> dict:
    """The record of `info`: bounds are [2, 3] (min, max) of finite centres; null where there are none."""
    assert splats.source is not None
    entry = FORMATS[splats.source.format]
    # Damaged Gaussians are counted and left out of the bounds, which they would make infinite.
    with np.errstate(all="ignore"):  # of extreme or damaged Gaussians, which are counted below
        drawable = splats.drawable
        finite = splats.world_means[np.isfinite(splats.means).all(1)]
        center, radius = bounding_sphere(splats)
        center = center + np.array(splats.offset)
    # The record first and the lines from it, so that --json and text cannot disagree.
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
            "axes": splats.source.axes,
            "from": splats.source.axes_from,
            "description": axes_line(splats.source),
        },
        "bounds": [finite.min(0), finite.max(0)] if len(finite) else None,
        "offset": splats.offset,
        "float32_step_in_sizes": coarseness(splats),
        "reach": {"center": center, "radius": radius} if drawable.any() else None,
        "problems": list(splats.source.problems),
        "doubts": [doubt.line for doubt in doubts(splats)],
        "exact": entry.exact,
        "lossy": _rounding(splats, entry),
        "writable": entry.write is not None,
    }


def _rounding(splats: Splats, entry: Format) -> str:
    """What edits would lose by rounding; "" in formats that are exact or cannot be written."""
    if not entry.lossy or entry.write is None:
        return ""
    from splatpainter.io.losses import loss_of_edits  # which most files need not wait for

    return loss_of_edits(splats).line


def losses_by_format(splats: Splats) -> dict[str, dict]:
    """Name ending -> what a new file of that format has and lacks of these Gaussians, by writing it aside."""
    from splatpainter.io.losses import measured_as

    # Measured by writing and not by rules: each format loses something else.
    out = {}
    for entry in FORMATS.values():
        if entry.write is None:
            continue
        try:
            losses, written = measured_as(splats, entry.key)
            out[entry.suffixes[0]] = {**losses.record(), "line": losses.line, "bytes": written, "refused": ""}
        except ValueError as error:
            # A format that cannot hold the asset is an answer too.
            reason = str(error).partition(": ")[2]
            out[entry.suffixes[0]] = {"line": "", "bytes": 0, "refused": f"cannot hold it: {reason}"}
    return out


def describe_folder(folder: Path) -> dict:
    """What `info` says besides of a trainer's folder: its iterations, and the cameras beside them."""
    from splatpainter.captures import captured_views, is_capture  # of folders alone

    # What is beside the asset is told, and no reason to refuse it.
    record: dict = {"asset_file": asset_file(folder), "iterations": list(iterations(folder)), "capture": None}
    try:
        if is_capture(folder):
            views = captured_views(folder, folder)
            photographs = sum(view.picture() is not None for view in views)
            record["capture"] = {"cameras": len(views), "photographs": photographs}
    except ValueError as error:  # the asset is sound without it
        record["capture"] = {"problem": str(error)}
    return record


def file_size(path: Path) -> int:
    """Bytes of a file, or of the files in a folder (of a SOG asset, by its folder or its meta.json)."""
    # SOG assets are folders of several files, by whichever of their names they are given.
    path = asset_file(path)
    folder = path.parent if path.name.lower() == META else path
    if folder.is_dir():
        return sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
    return path.stat().st_size


def _lines(record: dict) -> list[str]:
    bounds, around = record["bounds"], record["reach"]
    reach = around["radius"] if around else 0.0
    # Words for what is not there, so that every asset has the same lines.
    nowhere, unseen = "no Gaussian has a finite centre", "none can be drawn"
    gaussians = count(record["rows"], "Gaussian")
    if record["rows_not_drawn"]:
        gaussians += f", of which {record['rows_not_drawn']:,} cannot be drawn (NaN, infinite, or out of range)"
    fields = {
        "file": f"{record['file']} ({size(record['bytes'])})",
        "format": record["description"],
        "Gaussians": gaussians,
        "SH degree": str(record["sh_degree"]),
        "colours": f"{record['color_space']}{', antialiased (2D filter)' if record['antialiased'] else ''}",
        "axes": record["frame"]["description"],
        "bounds": f"{_point(bounds[0], reach)} to {_point(bounds[1], reach)}" if bounds else nowhere,
        "most of it": f"within {around['radius']:.3g} of {_point(around['center'], reach)}" if around else unseen,
        "positions": _positions(record),
        "sha256": record["sha256"],
        "kept": record["exact"],
        "lost": f"of edited Gaussians, by rounding: {record['lossy']}" if record["lossy"] else "",
    }
    # Lines without a text are left out: they would say that nothing is to be said.
    lines = [f"{name:<10} {text}" for name, text in fields.items() if text]
    lines += _folder_lines(record) if "capture" in record else []
    lines += [f"{'problem':<10} {problem}" for problem in record["problems"]]
    lines += [f"{'doubt':<10} {doubt}" for doubt in record["doubts"]]
    # What a format refuses is listed beside what it would lose: both decide which one to take.
    for ending, entry in record.get("losses", {}).items():
        what = entry["refused"] or f"{size(entry['bytes'])}; lost: {entry['line'] or 'nothing'}"
        lines.append(f"{'as ' + ending:<18} {what}")
    return lines


def _positions(record: dict) -> str:
    """What float32 makes of positions so far from 0; "" where it holds them."""
    # Only where float32 is too coarse for this asset: elsewhere the line would alarm for nothing.
    step = record["float32_step_in_sizes"]
    if step <= MAX_STEP:
        return ""
    coarse = f"float32 at this place has steps of {step:.2g} sizes of a Gaussian"
    # Without an offset the file has no finer positions either; converting would not help.
    if not any(record["offset"]):
        return f"{coarse}, and this file has no finer positions"
    offset = ", ".join(f"{value:.15g}" for value in record["offset"])
    return f"kept relative to ({offset}); {coarse}: only .ply (as double) and .glb hold them"


def _folder_lines(record: dict) -> list[str]:
    steps = record["iterations"]
    which = f"{record['asset_file'].name}, of iteration {steps[-1]:,}" if steps else record["asset_file"].name
    earlier = f" (also there: {', '.join(f'{step:,}' for step in steps[:-1])})" if steps[:-1] else ""
    lines = [f"{'opened':<10} {which}{earlier}"]
    # Cameras that cannot be read do not matter to the asset, and are told so.
    capture = record["capture"] or {}
    if "problem" in capture:
        return [*lines, f"{'cameras':<10} cannot be read: {capture['problem']}"]
    if capture:
        there = f"{capture['photographs']:,} of their photographs are there"
        lines.append(f"{'cameras':<10} {capture['cameras']:,}, for --camera {record['file']}:N; {there}")
    return lines


def _point(values: np.ndarray, reach: float = 0.0) -> str:
    """Three digits, or as many as tell points of an asset apart that is `reach` large."""
    # Far from the origin three digits are the same for all of the asset.
    if reach > 0 and np.abs(values).max() > 100 * reach:
        decimals = max(0, 2 - math.floor(math.log10(reach)))
        return "(" + ", ".join(f"{value:.{min(decimals, 12)}f}" for value in values) + ")"
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"
