"""What must hold of every splat file, however bent: rows or one line; what opens can be told, drawn, saved."""

from __future__ import annotations

import random
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera, orbit
from splatpainter.commands import info
from splatpainter.io import FORMATS, read
from splatpainter.splats import ATTRIBUTES, SH_COUNTS, Splats

from .target import Fault, Target, Verdict, refusal

DRAWN, DESCRIBED, EDITED = 1 / 48, 1 / 6, 1 / 6
"""Parts of the files that open which are drawn, described and edited."""


class FileTarget(Target):
    """A splat file: `make` gives one file (or the files of a folder)."""

    entry = ""
    """Name of the file that is opened; "" for the only one."""

    def check(self, files: dict[str, bytes], rng: random.Random) -> Verdict:
        for name, data in files.items():
            (self.folder / name).write_bytes(data)
        name = self.entry or next(iter(files))
        try:
            splats = read(self.folder / name)
        except ValueError as error:
            refusal(error, str(self.folder))
            return Verdict(refused=1)
        check_rows(splats)
        back = self.folder / "back"
        back.mkdir(exist_ok=True)
        self.check_saved(splats, files, back)
        if rng.random() < DESCRIBED:
            check_described(splats, self.folder / name)
        if rng.random() < EDITED:
            check_edited(splats, back / name, rng)
        if rng.random() < DRAWN:
            draw(splats)
        return Verdict(opened=1)

    def check_saved(self, splats: Splats, files: dict[str, bytes], back: Path) -> None:
        """Saved untouched, it is the same byte for byte."""
        assert splats.source is not None
        writer = FORMATS[splats.source.format].write
        if writer is None:
            return
        (name, data), *_ = files.items()
        path = back / name
        try:
            writer(path, splats)
        except ValueError as error:
            raise Fault(f"what was read is not written: {str(error)[:300]}") from error
        if path.read_bytes() != data:
            raise Fault(f"saved untouched, the {splats.source.format} file is not the same byte for byte")

    def warm_up(self) -> None:
        draw(_few_rows())


def check_rows(splats: Splats) -> None:
    """Shapes, types, and that rows which cannot be drawn were counted."""
    rows = len(splats)
    assert splats.source is not None
    if splats.sh.ndim != 3 or splats.sh.shape[1] not in SH_COUNTS:
        raise Fault(f"SH of shape {splats.sh.shape}")
    shapes = {"means": (rows, 3), "quats": (rows, 4), "scales": (rows, 3), "opacities": (rows,)}
    for name, shape in {**shapes, "sh": (rows, splats.sh.shape[1], 3)}.items():
        values = getattr(splats, name)
        if values.shape != shape or values.dtype != np.float32:
            raise Fault(f"{name}: {values.dtype} {values.shape}, expected float32 {shape}")
    if not splats.drawable.all() and not splats.source.problems:
        raise Fault(f"{int((~splats.drawable).sum())} rows cannot be drawn, and nothing says so")
    for line in splats.source.problems:
        if not line.isprintable() or len(line) > 600:
            raise Fault(f"a problem that is not one printable line: {line[:200]!r}")


def check_described(splats: Splats, path: Path) -> None:
    """`info` has lines and a record."""
    lines = info._lines(info.describe(splats, path))
    if not all(line.isprintable() for line in lines):
        raise Fault(f"info prints what is not printable: {[x for x in lines if not x.isprintable()][0][:200]!r}")


def check_edited(splats: Splats, path: Path, rng: random.Random) -> None:
    """A recoloured row and an appended one: the file has one more row, and where nothing rounds the others are same."""
    assert splats.source is not None
    key = splats.source.format
    writer = FORMATS[key].write
    if writer is None or not len(splats):
        return
    row = rng.randrange(len(splats))
    sh = splats.sh.copy()
    sh[row, 0] = (0.25, -0.25, 0.5)
    edited = replace(splats, sh=sh)
    if rng.random() < 0.5:
        edited = edited.append(edited.take(np.array([row])))
    try:
        writer(path, edited)
    except ValueError as error:
        refusal(error)
        return
    again = read(path)
    if len(again) != len(edited):
        raise Fault(f"{len(edited)} rows were written, {len(again)} are read")
    if key not in ("ply", "spz", "splat") or again.source is None or again.source.format != key:
        return
    rest = np.delete(np.arange(len(splats)), row)
    for name in ATTRIBUTES:
        old, new = (getattr(rows, name)[rest].view(np.uint32) for rows in (splats, again))
        if not np.array_equal(old, new):
            raise Fault(f"{name} of untouched rows changed when row {row} was recoloured")


@cache
def _camera() -> Camera:
    return orbit((0.0, 0.0, 0.0), 3.0, 1, width=16, height=16)[0]


def _few_rows() -> Splats:
    ones = np.ones((3, 3), np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1))
    return Splats(ones * 0, quats, ones / 10, ones[:, 0] / 2, np.zeros((3, 4, 3), np.float32))


def draw(splats: Splats) -> None:
    """A small picture: pixels are finite, whatever the rows."""
    from splatpainter.rendering import render

    if len(splats) and not np.isfinite(render(splats, _camera()).colors[0]).all():
        raise Fault("the picture has pixels that are not finite")
