"""Gaussians of a glTF primitive that lie in an SPZ stream: KHR_gaussian_splatting_compression_spz_2, and its drafts.

    primitive.extensions.KHR_gaussian_splatting.extensions.KHR_gaussian_splatting_compression_spz_2.bufferView
    primitive.extensions.KHR_spz_gaussian_splats_compression.bufferView                        (Cesium, 2025)

The buffer view is an SPZ file; the primitive's accessors only say types and counts. The text of the extension (Khronos'
draft) packs and unpacks the numbers as left-up-front, glTF's own axes, so that the words are right-up-back as SPZ
defines them. Cesium's files from before KHR_gaussian_splatting had a kernel and a colour space hold glTF's numbers as
they are; both stand upright and face opposite ways. A stream that names its axes is believed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import axes, files
from splatpainter.io.formats import gltf
from splatpainter.io.formats.spz import unpack_spz
from splatpainter.splats import Splats

BASE = "KHR_gaussian_splatting"
NESTED = ("KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz")
"""Names within the object of BASE."""
BESIDE = ("KHR_spz_gaussian_splats_compression",)
"""Names beside it, in the primitive's extensions."""
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""About z: between the PLY's axes and left-up-front."""


def _holder(primitive: dict[str, Any]) -> tuple[dict[str, Any], str] | None:
    """(object, key) under which the stream's object stands in the primitive; None where it has none."""
    extensions = primitive.get("extensions", {})
    base = extensions.get(BASE)
    nested = base.get("extensions") if isinstance(base, dict) else None
    parents = [(nested, name) for name in NESTED] + [(extensions, name) for name in BESIDE]
    return next(((parent, name) for parent, name in parents if isinstance(parent, dict) and name in parent), None)


def is_packed(primitive: dict[str, Any]) -> bool:
    """Whether the primitive's Gaussians lie in an SPZ stream."""
    return _holder(primitive) is not None


def unpack(glb: gltf.Glb, primitive: dict[str, Any], path: Path, problems: list[str]) -> Splats:
    """The rows in the primitive's own axes. Raises ValueError: no such stream, a damaged one, a wrong count."""
    parent, name = _holder(primitive) or ({}, "")
    stream = parent.get(name)
    index = stream.get("bufferView") if isinstance(stream, dict) else None
    view = gltf.entry(glb.doc, "bufferViews", index, path)
    if gltf.integer_at(view, "buffer", path) != 0 or "uri" in gltf.entry(glb.doc, "buffers", 0, path):
        raise ValueError(f"{path}: the SPZ stream lies in an external file; expected all data inside the GLB")
    start, length = gltf.integer_at(view, "byteOffset", path, 0), gltf.integer_at(view, "byteLength", path)
    data = bytes(files.take(memoryview(glb.binary), start, length, path, f"the SPZ stream in buffer view {index}"))
    base = primitive.get("extensions", {}).get(BASE)
    draft = not (isinstance(base, dict) and "kernel" in base)
    rows = unpack_spz(data, path, "luf" if draft else "rub")
    if draft:
        problems.append(f"{name} of a draft without kernel: its numbers are taken as they are, as Cesium does")
    for accessor in primitive.get("attributes", {}).values():
        count = gltf.integer_at(gltf.entry(glb.doc, "accessors", accessor, path), "count", path)
        if count != len(rows):
            raise ValueError(f"{path}: the SPZ stream holds {len(rows)} rows, accessor {accessor} says {count}")
    return axes.move(rows, HALF_TURN)


def drop(doc: dict[str, Any], primitive: dict[str, Any]) -> list[str]:
    """Make of a primitive one that has its values in attributes, which the caller adds: without the stream's object,
    and without its name in the lists of extensions once no other has it.
    Returns the names of the attributes that stood for its values."""
    holder = _holder(primitive)
    if holder is None:
        return []
    parent, name = holder
    del parent[name]
    base = primitive["extensions"].setdefault(BASE, {})
    if base.get("extensions") == {}:
        del base["extensions"]
    base.setdefault("kernel", "ellipse")  # the drafts had neither
    base.setdefault("colorSpace", "srgb_rec709_display")
    primitives = [one for mesh in doc.get("meshes", []) for one in mesh.get("primitives", [])]
    if not any((_holder(one) or (None, ""))[1] == name for one in primitives):
        for key in ("extensionsUsed", "extensionsRequired"):
            if isinstance(doc.get(key), list) and name in doc[key]:
                doc[key] = [entry for entry in doc[key] if entry != name]
                if not doc[key]:
                    del doc[key]
    return [name for name in primitive.get("attributes", {}) if is_of_gaussians(name)]


def is_of_gaussians(name: str) -> bool:
    """Whether the attribute of a packed primitive stands for values of its stream."""
    bare = name.removeprefix(f"{BASE}:").removeprefix("_")
    return bare in ("POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY") or bare.startswith("SH_DEGREE_")
