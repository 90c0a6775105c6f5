"""Assets at places that float32 cannot hold, as files written without the package."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpainter import io
from splatpainter.cameras import Camera
from splatpainter.splats import Splats
from tests.support.cli_scenes import ball, saved

UTM = (500_000.0, 5_400_000.0, 300.0)
ECEF = (4e6, 5e5, 4.9e6)


def far_ply(path: Path, splats: Splats, site: tuple[float, float, float] = UTM, order: str = "<") -> np.ndarray:
    """`splats` around `site` as a PLY with double x y z (order "=": as text); returns the [N, 3] positions in it."""
    kind = {"<": "binary_little_endian", ">": "binary_big_endian", "=": "ascii"}[order]
    near = path.with_name(f"near_{path.name}")
    saved(near, splats)
    head, body = near.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2].decode() for line in head.splitlines() if line.startswith(b"property")]
    rows = np.frombuffer(body, "<f4").reshape(len(splats), len(names))
    # Not from float32: the last digits of a double are used too.
    positions = splats.means.astype(np.float64) + np.array(site) + 1e-9 * np.arange(len(splats))[:, None]
    lines = ["ply", f"format {kind} 1.0", "comment surveyed", f"element vertex {len(splats)}"]
    lines += [f"property {'double' if name in ('x', 'y', 'z') else 'float'} {name}" for name in names]
    data = ("\n".join([*lines, "end_header"]) + "\n").encode()
    for point, row in zip(positions.tolist(), rows[:, 3:].tolist(), strict=True):
        values = (*point, *row)
        if order == "=":
            data += (" ".join(map(repr, values)) + "\n").encode()
        else:
            data += struct.pack(f"{order}3d{len(row)}f", *values)
    path.write_bytes(data)
    return positions


def doubles_of(path: Path, count: int) -> np.ndarray:
    """[count, 3] float64 the first three properties of a little-endian PLY that begin as doubles, read by hand."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    kinds = [line.split()[1] for line in head.splitlines() if line.startswith(b"property")]
    assert kinds[:3] == [b"double"] * 3
    width = sum(8 if kind == b"double" else 4 for kind in kinds)
    rows = np.frombuffer(body[: count * width], np.uint8).reshape(count, width)
    return np.ascontiguousarray(rows[:, :24]).view("<f8")


def moved_camera(camera: Camera, site: tuple[float, float, float]) -> Camera:
    """The camera in world coordinates that sees an asset at `site` as this one sees it at 0."""
    matrix = np.array(camera.world_to_camera)
    matrix[:3, 3] -= matrix[:3, :3] @ np.array(site)
    return replace(camera, world_to_camera=matrix)


def far_ball(path: Path, site: tuple[float, float, float] = UTM, count: int = 2000) -> tuple[Splats, np.ndarray]:
    """A ball around `site` as read from a file, and the positions in that file."""
    positions = far_ply(path, ball(count, degree=0), site)
    return io.read(path), positions
