"""Further columns of a PLY of Gaussians, such as normals, for programs that ask for them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from splatpainter.io import files
from splatpainter.io.formats.ply_header import read_header
from splatpainter.io.formats.ply_rows import BinaryRows


def add_columns(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Put float32 values [N] into the properties of these names of a binary PLY's vertices, which are added behind the
    others where they are missing; nothing else changes. Raises ValueError: a PLY of text, with lists, or without such
    vertices."""
    with files.reading(path) as file:
        header = read_header(file, path)
        body = file.read()
    vertex = header.elements[0] if header.elements else None
    if vertex is None or vertex.name != "vertex" or vertex.has_lists or header.format == "ascii":
        raise ValueError(f"{path}: expected a binary PLY whose first element is its vertices, to add columns to")
    dtype = vertex.dtype(header.order)
    table = np.frombuffer(body, dtype, vertex.count)
    added = [name for name in columns if name not in vertex.names]
    changed = header.with_properties("vertex", (), [("float", name) for name in added], vertex.names[-1])
    out = np.empty(vertex.count, changed.elements[0].dtype(header.order))
    for name in vertex.names:
        out[name] = table[name]
    for name, values in columns.items():
        if values.shape != (vertex.count,):
            raise ValueError(f"{path}: expected {vertex.count} values of {name}, got {list(values.shape)}")
        out[name] = values
    with files.writing(path) as file:
        file.write(changed.raw)
        file.write(BinaryRows(out, header.order).stored())
        file.write(body[vertex.count * dtype.itemsize :])
