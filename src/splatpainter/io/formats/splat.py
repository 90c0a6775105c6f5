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

import numpy as np

from splatpainter.io import files
from splatpainter.io.formats import activations
from splatpainter.io.formats.reuse import row_problems, unchanged
from splatpainter.splats import Source, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_norm

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgb", "u1", 3), ("alpha", "u1"), ("quats", "u1", 4)])


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
    record = SplatFile(np.frombuffer(data, ROW, count), data[len(data) - rest :])
    rows = record.rows
    splats = Splats(
        means=rows["means"].astype(np.float32),
        quats=(rows["quats"].astype(np.float32) - 128) / 128,
        scales=rows["scales"].astype(np.float32),
        opacities=rows["alpha"] / np.float32(255),
        sh=activations.color_to_dc(rows["rgb"] / np.float64(255)).reshape(count, 1, 3),
    )
    problems = [f"the last row is cut short: {rest} trailing bytes (kept as they are)"] if rest else []
    problems += row_problems(splats)
    source = Source(str(path), "splat", splats, files.sha256(data), record, tuple(problems))
    return replace(splats, source=source, origin=np.arange(count, dtype=np.int64))


def write_splat(path: Path, splats: Splats) -> None:
    """Write a .splat file, rows in their order; SH above degree 0 is dropped.

    NaN colours and opacities, which 8 bits cannot say, become 0; such rows are not drawn anyway.
    Raises ValueError when there are no rows (such a file would be empty) or the file cannot be written.
    """
    if not len(splats):
        raise ValueError(f"{path}: a .splat file needs at least one row, got none")
    rows, after = np.zeros(len(splats), ROW), b""
    same = unchanged(splats, "splat")
    masks = {name: np.zeros(len(splats), bool) for name in ROW.names or ()}
    if same is not None and splats.source is not None:
        after, has_source = splats.source.detail.after, same.source_rows >= 0
        rows[has_source] = splats.source.detail.rows[same.source_rows[has_source]]
        masks = {"means": same.means, "scales": same.scales, "rgb": same.base}
        masks |= {"alpha": same.opacities, "quats": same.quats}
    norms = row_norm(splats.quats.astype(np.float64))[:, None]
    values = {
        "means": splats.means,
        "scales": splats.scales,
        "rgb": _to_uint8(activations.dc_to_color(splats.sh[:, 0]) * 255),
        "alpha": _to_uint8(splats.opacities * 255),
        "quats": _to_uint8(splats.quats / np.where(norms > 0, norms, 1) * 128 + 128),
    }
    for name, mask in masks.items():
        rows[name][~mask] = values[name][~mask]
    with files.writing(path) as file:
        file.write(rows.tobytes())
        file.write(after)


def _to_uint8(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(np.nan_to_num(values)), 0, 255).astype(np.uint8)
