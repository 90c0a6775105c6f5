"""The glTF 2.0 binary container: chunks, JSON, accessors, node transforms. Knows no splats.

12 bytes: "glTF", u32 version 2, u32 length;  then chunks: u32 size, u32 type ("JSON", "BIN\\0", others kept), content
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import files
from splatpainter.kernels import portable
from splatpainter.system import jsonio
from splatpainter.system.jsonio import brief, objects_at
from splatpainter.system.quick_dataclass import dataclass

MAGIC = b"glTF"
JSON_CHUNK, BIN_CHUNK = 0x4E4F534A, 0x004E4942
FLOAT = 5126
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
MAX_CHUNKS = 1024
"""Chunks of a file; the standard has two."""
MAX_NODE_DEPTH = 1024
"""Most nodes above each other."""
MAX_IMPLIED_ROWS_PER_BYTE = 16
"""Rows that a sparse accessor may leave at zero, for each byte of the file: as many as accessors that share bytes."""
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True)
class Glb:
    """A file's chunks."""

    doc: dict[str, Any]
    binary: bytes
    other_chunks: tuple[tuple[int, bytes], ...]
    """(type, content) of further chunks."""
    tail: bytes
    """Bytes after the declared length."""


def parse(data: bytes, path: Path) -> Glb:
    """Raises ValueError: not GLB 2, truncated, or JSON that is none."""
    head = files.take(data, 0, 12, path, "the GLB header")
    magic, version, length = struct.unpack("<4sII", head)
    if magic != MAGIC or version != 2:
        raise ValueError(f"{path}: expected a GLB file of version 2, found {magic!r} version {version}")
    if length > len(data):
        raise ValueError(f"{path}: truncated: the header says {length} bytes, the file has {len(data)}")
    chunks, at = [], 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        if len(chunks) == MAX_CHUNKS:
            raise ValueError(f"{path}: a GLB file of more than {MAX_CHUNKS} chunks; it is damaged or hostile")
        content = files.take(data, at + 8, size, path, "a GLB chunk")
        if at + 8 + size > length:
            raise ValueError(
                f"{path}: a GLB chunk of {size} bytes at byte {at} ends after the file's declared {length}"
            )
        chunks.append((kind, bytes(content)))
        at += 8 + size
    if not chunks or chunks[0][0] != JSON_CHUNK:
        raise ValueError(f"{path}: expected JSON as the first GLB chunk")
    doc = jsonio.load_object(chunks[0][1], path, "the JSON chunk")
    _check(doc, path)
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == BIN_CHUNK else b""
    other_chunks = chunks[2:] if binary else chunks[1:]
    return Glb(doc, binary, tuple(other_chunks), data[length:])


def declared_rows(path: Path) -> int:
    """The largest count of any accessor of the GLB file at `path`; nothing but its JSON is read. Raises ValueError."""
    head = files.read_head(path, 20)
    if len(head) < 20:
        raise ValueError(
            f"{path}: truncated: the GLB header and the head of its JSON need 20 bytes, it has {len(head)}"
        )
    (size,) = struct.unpack_from("<I", head, 12)
    text = files.read_head(path, 20 + min(size, jsonio.MAX_JSON_BYTES + 1))[20:]
    if len(text) < min(size, jsonio.MAX_JSON_BYTES + 1):
        raise ValueError(f"{path}: truncated: its JSON chunk is cut off")
    doc = jsonio.load_object(text, path, "the JSON chunk")
    return max((integer_at(item, "count", path, 0) for item in objects_at(doc, "accessors", path)), default=0)


def serialise(glb: Glb) -> bytes:
    """The file of `glb`, chunks padded to 4 bytes."""
    text = json.dumps(glb.doc, separators=(",", ":"), allow_nan=False).encode()
    chunks = [(JSON_CHUNK, text + b" " * (-len(text) % 4))]
    if glb.binary:
        chunks.append((BIN_CHUNK, glb.binary + b"\0" * (-len(glb.binary) % 4)))
    body = b"".join(struct.pack("<II", len(data), kind) + data for kind, data in (*chunks, *glb.other_chunks))
    return struct.pack("<4sII", MAGIC, 2, 12 + len(body)) + body + glb.tail


def _check(doc: dict[str, Any], path: Path) -> None:
    """The forms on which this module and its callers rely; what they do not name may be anything."""
    for key in ("accessors", "buffers", "bufferViews", "meshes", "nodes"):
        objects_at(doc, key, path)
    for view in doc.get("bufferViews", []):
        for key in ("buffer", "byteOffset", "byteLength"):
            integer_at(view, key, path, 0 if key == "byteOffset" else None)
    for mesh in doc.get("meshes", []):
        for primitive in objects_at(mesh, "primitives", path):
            groups = [primitive.get("attributes", {}), *objects_at(primitive, "targets", path)]
            if not all(isinstance(g, dict) and all(type(v) is int for v in g.values()) for g in groups):
                raise ValueError(f"{path}: expected accessor numbers as the attributes of a glTF primitive")
            if not isinstance(primitive.get("extensions", {}), dict):
                raise ValueError(f"{path}: expected an object as the extensions of a glTF primitive")
    if not isinstance(doc.get("extensionsUsed", []), list):
        raise ValueError(f"{path}: expected a list as glTF extensionsUsed")


def entry(doc: dict[str, Any], kind: str, index: Any, path: Path) -> dict[str, Any]:
    """doc[kind][index], checked. Raises ValueError where there is none."""
    items = doc.get(kind)
    if items is None or type(index) is not int or not 0 <= index < len(items):
        raise ValueError(f"{path}: glTF names {kind}[{brief(index)}], which does not exist")
    return items[index]


def integer_at(item: dict[str, Any], key: str, path: Path, default: int | None = None) -> int:
    """A non-negative integer property."""
    return jsonio.integer(item.get(key, default), path, f"glTF {key!r}")


def accessor(glb: Glb, binary: bytes | bytearray, index: Any, path: Path) -> np.ndarray:
    """[count, width] in the stored component type: a view into `binary` (the file's, or a copy of it); of a sparse
    accessor a copy.

    Raises ValueError: compressed or external data, unknown types, bytes outside of the buffer, sparse elements that are
    out of order or beside the others.
    """
    item = entry(glb.doc, "accessors", index, path)
    kind, width = COMPONENTS.get(integer_at(item, "componentType", path)), WIDTHS.get(str(item.get("type")))
    count, sparse = integer_at(item, "count", path), item.get("sparse")
    if kind is None or width is None or ("bufferView" not in item and not sparse) or not _is_sparse(sparse):
        raise ValueError(
            f"{path}: accessor {index} is of a kind that splats do not use (empty, malformed or "
            f"{brief(item.get('type'))})"
        )
    if sparse is None:
        return _elements(glb, binary, item, count, (kind, width), f"accessor {index}", path)
    if "bufferView" in item:
        values = _elements(glb, binary, item, count, (kind, width), f"accessor {index}", path).copy()
    elif count > MAX_IMPLIED_ROWS_PER_BYTE * len(binary):
        raise ValueError(f"{path}: sparse accessor {index} of {count} elements in a file of {len(binary)} bytes")
    else:
        values = np.zeros((count, width), kind)
    changed = integer_at(sparse, "count", path)
    where = f"sparse accessor {index}"
    index_kind = COMPONENTS.get(integer_at(sparse["indices"], "componentType", path))
    if index_kind not in ("u1", "<u2", "<u4"):
        raise ValueError(f"{path}: {where}: expected unsigned integers as its indices")
    rows = _elements(glb, binary, sparse["indices"], changed, (index_kind, 1), where, path)[:, 0].astype(np.int64)
    if len(rows) and (rows[-1] >= count or (np.diff(rows) <= 0).any()):
        raise ValueError(f"{path}: {where}: expected rising indices below {count}")
    values[rows] = _elements(glb, binary, sparse["values"], changed, (kind, width), where, path)
    return values


def _is_sparse(sparse: Any) -> bool:
    """Whether it is what an accessor may say of its sparse elements; None says nothing."""
    if sparse is None:
        return True
    parts = [sparse.get(key) for key in ("indices", "values")] if isinstance(sparse, dict) else [None]
    return all(isinstance(part, dict) and "bufferView" in part for part in parts)


def _elements(
    glb: Glb,
    binary: bytes | bytearray,
    item: dict[str, Any],
    count: int,
    kind_and_width: tuple[str, int],
    name: str,
    path: Path,
) -> np.ndarray:
    """[count, width] view of what an accessor, or a part of a sparse one, has in its buffer view."""
    kind, width = kind_and_width
    view = entry(glb.doc, "bufferViews", item["bufferView"], path)
    if view.get("extensions"):
        extensions = view["extensions"]
        names = files.printable(", ".join(extensions)) if isinstance(extensions, dict) else brief(extensions)
        raise ValueError(
            f"{path}: buffer view {item['bufferView']} is compressed ({names}); decompress it with gltf-transform"
        )
    if integer_at(view, "buffer", path) != 0 or "uri" in entry(glb.doc, "buffers", 0, path):
        raise ValueError(f"{path}: {name} lies in an external file; expected all data inside the GLB")
    size = np.dtype(kind).itemsize
    start, length = (
        integer_at(view, "byteOffset", path, 0),
        integer_at(view, "byteLength", path),
    )
    stride, offset = integer_at(view, "byteStride", path, width * size), integer_at(item, "byteOffset", path, 0)
    files.take(memoryview(binary), start, length, path, f"buffer view {item['bufferView']}")
    stride = stride if count > 1 else width * size  # of one element it means nothing
    if stride < width * size or offset + (max(count, 1) - 1) * stride + (width * size if count else 0) > length:
        raise ValueError(f"{path}: {name} with {count} elements does not fit its buffer view of {length} bytes")
    return np.ndarray((count, width), kind, binary, start + offset, (stride, size))


def decode(values: np.ndarray, normalized: Any) -> np.ndarray:
    """Stored components -> float32; normalised integers as glTF 2.0 section 3.11 says."""
    if values.dtype.kind == "f":
        return np.ascontiguousarray(values, np.float32)
    wide = values.astype(np.float64)
    if normalized is True:
        wide = np.maximum(wide / np.iinfo(values.dtype).max, -1)
    return wide.astype(np.float32)


@dataclass(frozen=True)
class Parents:
    """The tree of nodes, from below."""

    above: dict[int, int]
    """Node -> its parent."""
    showing: dict[int, list[int]]
    """Mesh -> the nodes that show it."""


def parents_of(doc: dict[str, Any]) -> Parents:
    """One look at all nodes; those of other scenes than the one it opens with show nothing."""
    above: dict[int, int] = {}
    showing: dict[int, list[int]] = {}
    nodes = scene_nodes(doc)
    for index, item in enumerate(doc.get("nodes", [])):
        if type(item.get("mesh")) is int and index in nodes:
            showing.setdefault(item["mesh"], []).append(index)
        children = item.get("children")
        for child in children if isinstance(children, list) else []:
            if type(child) is int:
                above.setdefault(child, index)
    return Parents(above, showing)


def scene_nodes(doc: dict[str, Any]) -> set[int]:
    """All nodes but those that only other scenes have than the one that a file opens with: `scene`, else the first."""
    everything = set(range(len(doc.get("nodes", []))))
    scenes, opened = doc.get("scenes"), doc.get("scene", 0)
    if not isinstance(scenes, list) or type(opened) is not int or not 0 <= opened < len(scenes):
        return everything
    roots = [scene.get("nodes") if isinstance(scene, dict) else None for scene in scenes]
    visible = _nodes_below(doc, [roots[opened]], everything)
    return everything - (_nodes_below(doc, roots, everything) - visible) if visible else everything


def _nodes_below(doc: dict[str, Any], left: list[Any], everything: set[int]) -> set[int]:
    nodes: set[int] = set()
    left = list(left)
    while left:  # children of damaged files may be anything, and name each other
        named = left.pop()
        for node in named if isinstance(named, list) else []:
            if type(node) is int and node in everything and node not in nodes:
                nodes.add(node)
                left.append(doc["nodes"][node].get("children"))
    return nodes


def global_matrix(doc: dict[str, Any], node: int, path: Path, tree: Parents) -> np.ndarray:
    """[4, 4] float64 transform of a node, its ancestors' included."""
    parents = tree.above
    matrix, seen = np.eye(4), set()
    while node not in seen:
        if len(seen) == MAX_NODE_DEPTH:
            raise ValueError(f"{path}: glTF nodes lie more than {MAX_NODE_DEPTH} deep in each other")
        seen.add(node)
        matrix = portable.matmul(_local_matrix(entry(doc, "nodes", node, path), path), matrix)
        if node not in parents:
            return matrix
        node = parents[node]
    raise ValueError(f"{path}: glTF node {node} is its own ancestor")


def _local_matrix(node: dict[str, Any], path: Path) -> np.ndarray:
    defaults = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
    parts = {}
    for key, default in (*defaults.items(), ("matrix", np.eye(4).T.ravel().tolist())):
        value = node.get(key, default)
        if not isinstance(value, list) or len(value) != len(default) or not all(type(v) in (int, float) for v in value):
            raise ValueError(f"{path}: expected {len(default)} numbers as a node's {key}, found {brief(value)}")
        try:
            parts[key] = np.array(value, np.float64)
        except OverflowError:
            raise ValueError(f"{path}: a node's {key} is out of range") from None
    if "matrix" in node:
        return parts["matrix"].reshape(4, 4).T
    x, y, z, w = parts["rotation"] / max(portable.length(parts["rotation"]), 1e-30)
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, :3] *= parts["scale"]
    out[:3, 3] = parts["translation"]
    return out


def compact(doc: dict[str, Any], binary: bytes | bytearray) -> bytes:
    """The binary chunk with only the buffer views that something still names; `doc` is renumbered in place.

    Views that an extension packs point into the buffer in ways unknown here; then everything stays where it is.
    """
    views = doc["bufferViews"]
    if any(view.get("extensions") for view in views):
        return bytes(binary)
    named = {holder["bufferView"] for holder in view_holders(doc)}
    used = [i for i, view in enumerate(views) if i in named or view["buffer"] != 0]
    new_index = {old: new for new, old in enumerate(used)}
    for holder in view_holders(doc):
        holder["bufferView"] = new_index.get(holder["bufferView"], len(views))  # what named nothing still does
    out = bytearray()
    for index in used:
        view = views[index]
        if view["buffer"] == 0:
            start = view.get("byteOffset", 0)
            view["byteOffset"] = len(out)
            out += binary[start : start + view["byteLength"]]
            out += b"\0" * (-len(out) % 4)
    doc["bufferViews"] = [views[index] for index in used]
    return bytes(out)


def view_holders(item: Any) -> Iterator[dict[str, Any]]:
    """Every object of a glTF document with a `bufferView`, wherever an extension may have put it."""
    if isinstance(item, dict):
        if type(item.get("bufferView")) is int:
            yield item
        for value in item.values():
            yield from view_holders(value)
    elif isinstance(item, list):
        for value in item:
            yield from view_holders(value)
