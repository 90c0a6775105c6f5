"""A triangle mesh as GLB: positions, normals, colours or a picture, indices."""

from __future__ import annotations

from typing import Any

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.io.formats import gltf

UNSIGNED_INT = 5125
LINEAR, CLAMP = 9729, 33071
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


def mesh_glb(
    vertices: np.ndarray,
    triangles: np.ndarray,
    normals: Floats,
    colors: np.ndarray | None = None,
    *,
    texture: tuple[np.ndarray, bytes] | None = None,
    name: str = "proxy",
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> bytes:
    """vertices, normals: [V, 3] float32 in glTF's axes; triangles: [T, 3]; colors: [V, 3] linear 0..1, or none;
    texture: [V, 2] where on a picture they lie, 0..1 from its upper left corner, and its PNG, or none."""
    arrays: list[tuple[str, np.ndarray, int]] = [
        ("POSITION", np.ascontiguousarray(vertices, "<f4"), ARRAY_BUFFER),
        ("NORMAL", np.ascontiguousarray(normals, "<f4"), ARRAY_BUFFER),
    ]
    if colors is not None:
        arrays.append(("COLOR_0", np.ascontiguousarray(colors, "<f4"), ARRAY_BUFFER))
    if texture is not None:
        arrays.append(("TEXCOORD_0", np.ascontiguousarray(texture[0], "<f4"), ARRAY_BUFFER))
    arrays.append(("", np.ascontiguousarray(triangles.reshape(-1), "<u4"), ELEMENT_ARRAY_BUFFER))
    # One buffer; each array is a view of it and an accessor that says what its numbers are.
    binary, views, accessors, attributes = bytearray(), [], [], {}
    for semantic, values, target in arrays:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes, "target": target})
        binary += values.tobytes()
        entry: dict[str, Any] = {"bufferView": len(views) - 1, "count": len(values)}
        entry["componentType"] = gltf.FLOAT if semantic else UNSIGNED_INT
        if semantic:
            entry["type"] = f"VEC{values.shape[1]}"
        entry.setdefault("type", "SCALAR")
        # The standard asks for the range of positions, and of nothing else.
        if semantic == "POSITION":
            entry |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        if semantic:
            attributes[semantic] = len(accessors)
        accessors.append(entry)
    # Rough: viewers then show the vertices' colours as they are.
    primitive = {"attributes": attributes, "indices": len(accessors) - 1, "material": 0}
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    picture: dict[str, Any] = {}
    if texture is not None:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(texture[1])})
        binary += texture[1] + bytes(-len(texture[1]) % 4)
        surface["baseColorTexture"] = {"index": 0}
        picture = {
            "images": [{"bufferView": len(views) - 1, "mimeType": "image/png"}],
            # Without smaller copies of the picture, in which neighbours would run into each other.
            "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP, "wrapT": CLAMP}],
            "textures": [{"source": 0, "sampler": 0}],
        }
    node: dict[str, Any] = {"mesh": 0, "name": name}
    if any(translation):
        node["translation"] = list(translation)
    doc = {
        "asset": {"version": "2.0", "generator": "splatpainter"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": surface}],
        **picture,
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return gltf.serialise(gltf.Glb(doc, bytes(binary), (), b""))
