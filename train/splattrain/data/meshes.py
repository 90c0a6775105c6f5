"""Textured triangle meshes: the frozen types, reading GLB/glTF/OBJ through trimesh, and repair of what files get wrong.

World axes as glTF has them: y up. Knows no splats, no light.
"""

from __future__ import annotations

import json
import struct
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.color import srgb_to_linear
from splattrain.data.materials import Material, convert_material

NORMALISED_EXTENT = 1.8
"""Longest side of a normalised mesh's bounding box, world units; the box is centred, so all lies within -0.9..0.9."""
MAX_TRIANGLES = 10_000_000
SUFFIXES = (".glb", ".gltf", ".obj")


@dataclass(frozen=True)
class Mesh:
    """V vertices, F triangles. Vertices with different UVs or normals are different vertices."""

    name: str
    vertices: np.ndarray
    """[V, 3] float32, world units."""
    faces: np.ndarray
    """[F, 3] int64, counter-clockwise seen from outside."""
    normals: np.ndarray
    """[V, 3] float32, unit."""
    uvs: np.ndarray
    """[V, 2] float32, v up (v = 0 is the picture's last row), any range: maps repeat."""
    material_ids: np.ndarray
    """[F] int64 into materials."""
    materials: tuple[Material, ...]
    colors: np.ndarray | None = field(default=None)
    """[V, 3] float32 linear vertex colours that multiply the base colour, or None."""


def load_mesh(path: str | Path) -> Mesh:
    """The mesh in a GLB, glTF or OBJ file: all its parts, transforms applied, normalised to NORMALISED_EXTENT.

    Kept: base colour, metallic-roughness and normal maps, factors, vertex colours, cut-out alpha. Repaired: faces with
    NaN or out-of-range vertices and without area are dropped, missing normals are computed, missing UVs are projected
    from the nearest side of a box, textures that cannot be decoded give way to the factor, as do other pictures in the
    place of normal maps.

    Raises ValueError, one line that names the file: no such file, not a mesh, no faces left, too many triangles.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: expected a mesh ({', '.join(SUFFIXES)}), got {path.suffix or 'no suffix'}")
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    _refuse_too_many(_announced_triangles(path), path)
    import trimesh

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded: Any = trimesh.load(path, force="scene", process=False)
    except Exception as error:  # the readers below trimesh raise whatever their formats make them
        raise ValueError(f"{path}: cannot be read as a mesh ({_first_line(error)})") from None
    parts = []
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        geometry = loaded.geometry[name]
        if getattr(geometry, "faces", None) is not None and len(geometry.faces):
            parts.append(_part(geometry, np.asarray(transform, np.float64)))
    if not parts:
        raise ValueError(f"{path}: holds no triangles; a point cloud or an empty scene cannot be sampled")
    _refuse_too_many(sum(len(part.faces) for part in parts), path)
    return normalized(repaired(joined(path.stem, parts), where=str(path)))


def joined(name: str, parts: list[Mesh]) -> Mesh:
    """One mesh of several; materials that are the same object are kept once."""
    materials: list[Material] = []
    columns: dict[str, list[np.ndarray]] = {"faces": [], "material_ids": []}
    start = 0
    for part in parts:
        table = []
        for material in part.materials:
            same = [k for k, other in enumerate(materials) if other is material]
            table.append(same[0] if same else len(materials))
            if not same:
                materials.append(material)
        columns["faces"].append(part.faces + start)
        columns["material_ids"].append(np.asarray(table, np.int64)[part.material_ids])
        start += len(part.vertices)
    colors = None
    if any(part.colors is not None for part in parts):
        white = [np.ones((len(p.vertices), 3), np.float32) if p.colors is None else p.colors for p in parts]
        colors = np.concatenate(white)
    return Mesh(
        name,
        np.concatenate([part.vertices for part in parts]).astype(np.float32),
        np.concatenate(columns["faces"]).astype(np.int64),
        np.concatenate([part.normals for part in parts]).astype(np.float32),
        np.concatenate([part.uvs for part in parts]).astype(np.float32),
        np.concatenate(columns["material_ids"]),
        tuple(materials),
        colors,
    )


def repaired(mesh: Mesh, where: str = "") -> Mesh:
    """Without faces that have NaN or missing vertices or no area, and with unit normals everywhere. Raises ValueError
    (naming `where`) when nothing is left."""
    where = where or mesh.name
    faces = mesh.faces
    inside = ((faces >= 0) & (faces < len(mesh.vertices))).all(1)
    faces, ids = faces[inside], mesh.material_ids[inside]
    finite = np.all(np.isfinite(mesh.vertices), axis=1)
    if not finite.any():
        raise ValueError(f"{where}: no vertex is finite")
    middle = mesh.vertices[finite].mean(0)
    vertices = np.where(finite[:, None], mesh.vertices, middle).astype(np.float32)
    corners = vertices.astype(np.float64)[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(cross, axis=1)
    span = float(np.ptp(vertices[finite], axis=0).max())
    keep = finite[faces].all(1) & (twice > 1e-14 * span * span)
    if span <= 0 or not keep.any():
        raise ValueError(f"{where}: the mesh has no area ({len(mesh.faces)} faces, none of them usable)")
    faces, ids, cross = faces[keep], ids[keep], cross[keep]
    normals = mesh.normals.astype(np.float64)
    length = np.linalg.norm(np.nan_to_num(normals), axis=1)
    lost = ~np.all(np.isfinite(normals), axis=1) | (length < 1e-6)
    if lost.any():
        normals = np.where(lost[:, None], vertex_normals(len(vertices), faces, cross), normals)
        length = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(length, 1e-12)[:, None]
    uvs = np.where(np.isfinite(mesh.uvs), mesh.uvs, 0)
    colors = None if mesh.colors is None else np.clip(np.nan_to_num(mesh.colors), 0, 1).astype(np.float32)
    return replace(
        mesh,
        vertices=vertices,
        faces=faces,
        material_ids=ids,
        normals=normals.astype(np.float32),
        uvs=uvs.astype(np.float32),
        colors=colors,
    )


def normalized(mesh: Mesh, extent: float = NORMALISED_EXTENT) -> Mesh:
    """Centred on the bounding box of what the faces use, longest side `extent`."""
    used = mesh.vertices[np.unique(mesh.faces)].astype(np.float64)
    low, high = used.min(0), used.max(0)
    scaled = (mesh.vertices - (low + high) / 2) * (extent / max(float((high - low).max()), 1e-30))
    return replace(mesh, vertices=scaled.astype(np.float32))


def submesh(mesh: Mesh, faces: np.ndarray) -> Mesh:
    """These faces ([F] bool) and the vertices that they use."""
    used, local = np.unique(mesh.faces[faces], return_inverse=True)
    columns = {name: getattr(mesh, name)[used] for name in ("vertices", "normals", "uvs")}
    colors = None if mesh.colors is None else mesh.colors[used]
    ids = mesh.material_ids[faces]
    return replace(mesh, faces=local.reshape(-1, 3), material_ids=ids, colors=colors, **columns)


def vertex_normals(count: int, faces: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """[count, 3] float64 unit normals: faces' cross products [F, 3] (area-weighted) summed at their corners."""
    total = np.zeros((count, 3))
    for corner in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, corner], cross[:, axis], count)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-30, total / np.maximum(length, 1e-30), [0.0, 1.0, 0.0])


def _part(geometry: Any, transform: np.ndarray) -> Mesh:
    """A trimesh geometry placed by `transform` [4, 4]."""
    turn = transform[:3, :3]
    vertices = np.asarray(geometry.vertices, np.float64) @ turn.T + transform[:3, 3]
    faces = np.asarray(geometry.faces, np.int64)
    if np.linalg.det(turn) < 0:  # a mirrored instance: keep the outside outside
        faces = faces[:, ::-1]
    given = geometry._cache.cache.get("vertex_normals")  # the file's own; the property would compute its own
    safe = np.clip(faces, 0, len(vertices) - 1)
    if given is not None and np.shape(given) == vertices.shape:
        normals = np.asarray(given, np.float64) @ np.linalg.pinv(turn)
    else:
        corners = np.nan_to_num(vertices[safe])
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = vertex_normals(len(vertices), safe, cross)
    visual = geometry.visual
    uvs = getattr(visual, "uv", None)
    colors = None
    if visual.kind == "vertex":
        colors = srgb_to_linear(np.asarray(visual.vertex_colors, np.float64)[:, :3] / 255)
    else:
        stored = getattr(visual, "vertex_attributes", {}).get("color")
        if stored is not None and np.shape(stored)[0] == len(vertices):
            scale = 255.0 if np.asarray(stored).dtype == np.uint8 else 1.0
            colors = np.asarray(stored, np.float64)[:, :3] / scale
    if uvs is None or np.shape(uvs) != (len(vertices), 2):
        uvs = box_uvs(vertices, normals)
    material = convert_material(getattr(visual, "material", None))
    ids = np.zeros(len(faces), np.int64)
    return Mesh(geometry.metadata.get("name", ""), vertices, faces, normals, np.asarray(uvs), ids, (material,), colors)


def box_uvs(vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[V, 2] UVs for a mesh that has none: the two coordinates across each vertex normal's largest axis, one unit of UV
    per longest side of the mesh."""
    side = np.abs(np.nan_to_num(normals)).argmax(1)
    span = max(float(np.ptp(np.nan_to_num(vertices), axis=0).max()), 1e-30)
    columns = np.array([[2, 1], [0, 2], [0, 1]])[side]
    return (np.take_along_axis(vertices, columns, 1) / span).astype(np.float32)


def _announced_triangles(path: Path) -> int:
    """Triangles that a GLB's header promises, so that a giant is refused before it is read; 0 where that is unknown."""
    if path.suffix.lower() != ".glb":
        return 0
    try:
        with open(path, "rb") as file:
            magic, _, _, length, kind = struct.unpack("<4sIIII", file.read(20))
            if magic != b"glTF" or kind != 0x4E4F534A or length > 1 << 28:
                return 0
            document = json.loads(file.read(length))
        primitives = [p for mesh in document.get("meshes", ()) for p in mesh.get("primitives", ())]
        accessors = [p.get("indices", p["attributes"]["POSITION"]) for p in primitives if p.get("mode", 4) == 4]
        return sum(int(document["accessors"][index]["count"]) for index in accessors) // 3
    except (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error):
        return 0  # the reader will say what is wrong


def _refuse_too_many(triangles: int, path: Path) -> None:
    if triangles > MAX_TRIANGLES:
        raise ValueError(
            f"{path}: {triangles:,} triangles, at most {MAX_TRIANGLES:,} are read; simplify the mesh first"
        )


def _first_line(error: BaseException) -> str:
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0][:160]}" if text else type(error).__name__
