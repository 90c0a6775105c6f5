"""antimatter15 .splat: 32 bytes a row, no header, no SH above degree 0.

    offset  bytes  what
         0     12  position, 3 x float32, little endian
        12     12  scale, 3 x float32, linear
        24      4  red, green, blue, opacity, uint8: round(255 (0.5 + C0 dc)), round(255 alpha)
        28      4  rotation w x y z, uint8: round(128 q + 128) of the unit quaternion

Writing over a .splat source copies the bytes of every value that did not change.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import LiteralString

import numpy as np

from splatpainter.io import files
from splatpainter.io.formats import activations
from splatpainter.io.formats.reuse import row_problems, unchanged
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import beside, run
from splatpainter.splats import SH_C0, Source, Splats
from splatpainter.system.quick_dataclass import dataclass

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgb", "u1", 3), ("alpha", "u1"), ("quats", "u1", 4)])
BYTES = np.arange(256, dtype=np.uint8)
"""All values that colours, opacities and rotations can have: each is decoded once."""


@dataclass(frozen=True)
class SplatFile:
    """Source.detail of a .splat file."""

    rows: np.ndarray
    """[N] of ROW."""
    after: bytes
    """What is left of a last row that was cut short."""


def read_splat(path: Path, lenient: bool = False) -> Splats:
    """Read a .splat file. lenient: keep a last row that is cut short as trailing bytes.

    Raises ValueError when it cannot be read, is shorter than one row, or is not of whole rows (unless lenient).
    """
    data = files.read_all(path)
    count, rest = divmod(len(data), ROW.itemsize)
    if not count:
        raise ValueError(f"{path}: expected a .splat file of 32 bytes a row, got {rest} bytes")
    if rest and not lenient:
        raise ValueError(
            f"{path}: expected a .splat file of 32 bytes a row, got {count} rows and {rest} bytes of one more: cut "
            "off, or not a .splat file (--lenient, or lenient=True, opens it anyway)"
        )
    digest = beside(lambda: files.sha256(data))
    record = SplatFile(np.frombuffer(data, ROW, count), data[len(data) - rest :])
    rows = record.rows
    splats = Splats(
        means=rows["means"].astype(np.float32),
        quats=_looked_up(rows, "quats", (BYTES.astype(np.float32) - 128) / 128),
        scales=rows["scales"].astype(np.float32),
        opacities=_looked_up(rows, "alpha", BYTES / np.float32(255))[:, 0],
        sh=_looked_up(rows, "rgb", activations.color_to_dc(BYTES / np.float64(255))).reshape(count, 1, 3),
    )
    problems = [f"the last row is cut short: {rest} trailing bytes (kept as they are)"] if rest else []
    problems += row_problems(splats)
    source = Source(str(path), "splat", splats, digest(), record, tuple(problems))
    return replace(splats, source=source, origin=np.arange(count, dtype=np.int64))


def write_splat(path: Path, splats: Splats) -> None:
    """Write a .splat file, rows in their order; SH above degree 0 is dropped.

    NaN colours and opacities, which 8 bits cannot say, become 0; such rows are not drawn anyway.
    Raises ValueError when there are no rows (such a file would be empty) or the file cannot be written.
    """
    if not len(splats):
        raise ValueError(f"{path}: a .splat file needs at least one row, got none")
    rows, after = pack(splats), b""
    same = unchanged(splats, "splat")
    if same is not None and splats.source is not None:
        after, stored = splats.source.detail.after, splats.source.detail.rows
        masks = {"means": same.means, "scales": same.scales, "rgb": same.base}
        masks |= {"alpha": same.opacities, "quats": same.quats}
        for name, mask in masks.items():
            rows[name][mask] = stored[name][same.source_rows[mask]]
    with files.writing(path) as file:
        file.write(rows.view(np.uint8).data)
        file.write(after)


def _looked_up(rows: np.ndarray, name: LiteralString, table: np.ndarray) -> np.ndarray:
    """[N, bytes of the field] float32: for each byte its line of `table`, [256] float32."""
    kind, first = (ROW.fields or {})[name][:2]
    out = np.empty((len(rows), kind.itemsize), np.float32)
    records = readonly(rows.view(np.uint8).reshape(len(rows), ROW.itemsize), np.uint8)
    run(kernels.look_up_bytes, records, first, readonly(table, np.float32), out)
    return out


def pack(splats: Splats) -> np.ndarray:
    """[N] of ROW of numpy Gaussians."""
    records = np.empty((len(splats), ROW.itemsize), np.uint8)
    arrays = (splats.means, splats.scales, splats.sh[:, 0], splats.opacities, splats.quats)
    run(kernels.pack_splat_rows, *(readonly(values, np.float32) for values in arrays), SH_C0, records)
    return records.view(ROW)[:, 0]
