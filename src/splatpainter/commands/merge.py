"""`splatpainter merge`: several assets merged into one file, each in its own range of rows."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_marks import Argument, Positional
from splatpainter.commands.parts.terminal import count, seconds, stages
from splatpainter.io import axes_news, files, read
from splatpainter.output_paths import check_target, placed, receipt_of, splat_format
from splatpainter.scene.merge import MergeVerification, Part, parts_of, write_merged
from splatpainter.scene.placement import Placement, shift_to_the_right
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config:
    """Merge splat files into one: the first one's rows, then the second one's, and so on; the name of OUT says the
    format. Rows of a .ply or .splat that are neither moved nor recoloured keep their bytes. The receipt says where
    each file lies and what was done to it: `splatpainter verify OUT --against ASSET ...` proves it, also after edits.

    TRANSFORM is move=X,Y,Z (world units), turn=X,Y,Z (degrees about x, then y, then z) and scale=S, joined by `:`, or
    none; the order is always scale, turn, move. Axes: x right, y down, z forward.

    example:
      splatpainter merge table.ply vase.ply --transform none move=0,-0.4,0:turn=0,30,0 --out scene.ply
      splatpainter merge left.ply right.spz --match-seam --out room.ply
      splatpainter verify scene.ply --against table.ply vase.ply
    """

    assets: Annotated[Positional[tuple[Path, ...]], Argument(metavar="ASSET ASSET ...")]
    """The files to merge, of any formats; they are not changed."""
    out: Annotated[Path, Argument(metavar="OUT")]
    """The file to write."""
    transform: Annotated[tuple[str, ...], Argument(metavar="TRANSFORM ...", help_behavior_hint="")] = ()
    """One TRANSFORM for each asset, in order; default: all stay as they are."""
    side_by_side: bool = False
    """Set each asset to the right of the one before it, after its transform."""
    match_seam: bool = False
    """Match the colours of every asset to the first one, where they are near to each other: a gain and an offset of
    linear light."""
    seam_falloff: float = 0.0
    """World units from the seam over which the match fades out; 0: it holds for the whole asset."""
    lenient: bool = False
    """Also open files that were cut off after their last complete row."""
    receipt: Annotated[Path | None, Argument(metavar="R.json", help_behavior_hint="")] = None
    """Where the receipt goes; default: OUT.receipt.json."""
    overwrite: bool = False
    """Replace OUT and the receipt if they exist."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Read, place, write, and prove every range."""
    # Names are checked before any file is read: OUT and the receipt must not replace what they are about.
    receipt_path = config.receipt or receipt_of(config.out)
    splat_format(config.out)
    check_target(config.out, config.overwrite, untouchable=config.assets)
    check_target(receipt_path, config.overwrite, untouchable=config.assets)
    if config.seam_falloff and not config.match_seam:
        raise ValueError("splatpainter merge: expected --match-seam with --seam-falloff")
    # Placements are read before the assets, for a misspelt one is found in no time.
    transforms = [Placement.parse(text) for text in config.transform] or None
    clock = time.perf_counter()
    with stages(3) as bar:
        bar.enter("reading")
        assets = [read(path, lenient=config.lenient) for path in config.assets]
        timings = {"read": time.perf_counter() - clock}
        # Only where there is one transform for each; a wrong number of them is refused below, with its own words.
        if config.side_by_side and 2 <= len(assets) and len(transforms or assets) == len(assets):
            transforms = side_by_side(assets, transforms or [Placement()] * len(assets))
        bar.enter("placing")
        parts = parts_of(assets, transforms, config.match_seam, config.seam_falloff)
        placing = time.perf_counter()
        # The receipt is on the disk before OUT has its name: a merged file without one could not be proved.
        with files.writing(receipt_path) as file, placed(config.out) as partial:
            bar.enter("writing")
            receipt, verification = write_merged(partial, parts)
            timings["write"] = time.perf_counter() - placing
            receipt = replace(receipt, seconds=timings)
            # Synced, as the receipt has to survive whatever stops the machine next.
            file.write(receipt.to_json().encode())
            file.flush()
            os.fsync(file.fileno())
    record = {
        "out": config.out,
        "receipt_file": receipt_path,
        "verified": verification.ok,
        "ranges": [asdict(one) for one in verification.ranges],
        "receipt": json.loads(receipt.to_json()),
    }
    lines = [
        f"{config.out}: {count(receipt.output_rows, 'Gaussian')} of {len(parts)} assets",
        *part_lines(parts, verification),
        *(line for path, asset in zip(config.assets, assets, strict=True) for line in axes_news(asset, str(path))),
        *([f"note: {receipt.note}"] if receipt.note else []),
        f"receipt: {receipt_path}",
        seconds(timings),
        "verified",
    ]
    return Outcome(record, lines)


def part_lines(parts: Sequence[Part], verification: MergeVerification) -> list[str]:
    """One line for each asset."""
    lines = []
    for part, one in zip(parts, verification.ranges, strict=True):
        seam = "" if part.seam is None else f"; colours: {part.seam.text}"
        # How each range holds its file decides what can be proved of it.
        words = {"bytes": "every byte unchanged", "values": "converted", "transformed": part.placement.text}[one.how]
        lines.append(f"  rows {one.first:,} to {one.first + one.rows - 1:,}: {one.file}, {words}{seam}")
    return lines


def side_by_side(assets: Sequence[Splats], transforms: Sequence[Placement]) -> list[Placement]:
    """Each asset moved along x to the right of the one before it."""
    # Along x, each by what the one before it reaches: assets keep their own height and depth.
    out = [transforms[0]]
    left = transforms[0].points(_visible(assets[0]).world_means)
    for splats, transform in zip(assets[1:], transforms[1:], strict=True):
        points = transform.points(_visible(splats).world_means)
        shift = shift_to_the_right(left, points)
        x, y, z = (a + b for a, b in zip(transform.move, shift, strict=True))
        out.append(replace(transform, move=(x, y, z)))
        left = out[-1].points(_visible(splats).world_means)
    return out


def _visible(splats: Splats) -> Splats:
    # What cannot be drawn takes no room; but an asset of nothing else still has to lie somewhere.
    return splats.take(splats.drawable) if splats.drawable.any() else splats
