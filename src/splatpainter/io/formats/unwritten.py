"""Rows of an asset's file that were never written: zeros, where a download or a copy ended for which disk space was set
aside before. Formats with checksums or streams of their own (SOG, SPZ) do not open so.

N rows. Honest files have zeros, too: bands of SH that an asset lacks are zero in all its rows, or in its last ones, and
what counts here is only what no program writes.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.io.formats.compressed_ply import CompressedPlyFile
    from splatpainter.io.formats.gltf import Glb

MIN_ROWS = 16
"""Rows of zeros from which they are said to be unwritten. Source: taste."""


def unwritten_rows(splats: Splats) -> int:
    """How many rows of the file that an asset was read from hold zeros in place of values; 0: none, or too few to
    say."""
    source = splats.source
    if source is None:
        return 0
    if source.format == "compressed.ply":
        count = _of_compressed_ply(source.detail)
    elif source.format == "glb":
        file = source.detail
        count = sum(_of_primitive(file.glb, one.mesh, one.index) for one in file.primitives)
    elif source.format in ("ply", "splat") and not any(splats.offset):
        # No such row can be drawn, and of most assets every one can.
        arrays, rows = splats.numpy(), np.flatnonzero(~splats.drawable)
        means, quats, scales = (values.take(rows, 0) == 0 for values in (arrays.means, arrays.quats, arrays.scales))
        empty = means.all(1) & (quats.all(1) | scales.all(1))
        count = int(empty.sum())
    else:
        count = 0
    return count if count >= MIN_ROWS else 0


def _of_compressed_ply(record: CompressedPlyFile) -> int:
    # Words of zeros: transparent, and three components of a rotation that are too long to be of one; bytes of zeros:
    # each coefficient of SH as far below 0 as there is.
    empty = np.zeros(len(record.tables["vertex"]), bool)
    for name in ("vertex", "sh"):
        table = record.tables.get(name)
        if table is not None and len(table) == len(empty) and table.dtype.itemsize:
            empty |= ~table.view(np.uint8).reshape(len(table), -1).any(1)
    return int(empty.sum())


def _of_primitive(glb: Glb, mesh: int, index: int) -> int:
    from splatpainter.io.formats import gltf, gltf_spz  # of GLB alone

    primitive: dict[str, Any] = glb.doc["meshes"][mesh]["primitives"][index]
    if gltf_spz.is_packed(primitive):
        return 0
    written: list[tuple[int, int]] = []
    count = 0
    for accessor in primitive.get("attributes", {}).values():
        item = glb.doc["accessors"][accessor]
        if item.get("sparse") is not None:
            continue
        view = glb.doc["bufferViews"][item["bufferView"]]
        values = gltf.accessor(glb, glb.binary, accessor, Path())
        count = len(values)
        written.append((view.get("byteOffset", 0) + item.get("byteOffset", 0), _written(values)))
    rows = [last for _, last in sorted(written)]
    # Rows of all attributes side by side: all end at one row.
    if rows and max(rows) == min(rows):
        return count - rows[0]
    # One after the other: behind the one in which they end all are zero, and the one before it goes on.
    for at, last in enumerate(rows):
        if 0 < last <= count - MIN_ROWS and not any(rows[at + 1 :]) and (not at or rows[at - 1] > last):
            return count - last
    return 0


def _written(values: np.ndarray) -> int:
    """Rows of [N, width] up to the last that is not all zero."""
    for end in range(len(values), 0, -1 << 14):
        start = max(end - (1 << 14), 0)
        filled = np.flatnonzero((values[start:end] != 0).any(1))
        if len(filled):
            return start + int(filled[-1]) + 1
    return 0
