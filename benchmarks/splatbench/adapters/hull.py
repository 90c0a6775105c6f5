"""Voxels as a closed triangle mesh. Knows no splats."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatpainter.io import files

SIDES = (((1, 0, 0), (0, 1, 0), (0, 0, 1)), ((0, 1, 0), (0, 0, 1), (1, 0, 0)), ((0, 0, 1), (1, 0, 0), (0, 1, 0)))
"""Axis of a side, and the two axes along it, right-handed."""


def surface(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(vertices [P, 3] float64 in voxels from the volume's corner, faces [F, 3] int64, counter-clockwise seen from
    outside) of the sides between set and unset voxels of [X, Y, Z] bool: the closed surface of what is set. Corners are
    shared; faces have no area in common."""
    padded = np.pad(volume.astype(bool), 1)
    quads = []
    for axis, (normal, first, second) in enumerate(SIDES):
        for step in (1, -1):
            bare = padded & ~np.roll(padded, -step, axis)
            cells = np.argwhere(bare) - 1
            corner = cells + (np.array(normal) if step > 0 else 0)
            a, b = (np.array(first), np.array(second)) if step > 0 else (np.array(second), np.array(first))
            quads.append(np.stack([corner, corner + a, corner + a + b, corner + b], 1))
    corners = np.concatenate(quads)
    vertices, places = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    quad = places.reshape(-1, 4)
    return vertices.astype(np.float64), np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]).astype(np.int64)


def write_glb(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """A mesh without material as GLB; vertices [P, 3] as glTF wants them, y up."""
    import trimesh

    data = trimesh.Trimesh(vertices, faces, process=False).export(file_type="glb")
    assert isinstance(data, bytes)
    with files.writing(path) as file:
        file.write(data)


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray | None = None, colors: np.ndarray | None = None):
    """Vertices [P, 3], with triangles [F, 3] or without, with colours [P, 3] uint8 or without, as a binary PLY."""
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if colors is not None:
        columns += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    table = np.zeros(len(vertices), columns)
    for k, name in enumerate("xyz"):
        table[name] = vertices[:, k]
    if colors is not None:
        for k, name in enumerate(("red", "green", "blue")):
            table[name] = colors[:, k]
    kinds = {"<f4": "float", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    head += [f"property {kinds[kind]} {name}" for name, kind in columns]
    body = table.tobytes()
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        rows = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
        rows["count"], rows["corners"] = 3, faces
        body += rows.tobytes()
    with files.writing(path) as file:
        file.write("\n".join([*head, "end_header\n"]).encode() + body)
