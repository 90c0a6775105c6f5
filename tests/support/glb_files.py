"""GLB files for the tests: taken apart and put together without our own reader and writer."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from splatpainter.splats import Splats

KHR = "KHR_gaussian_splatting"
CODES = {"float32": 5126, "int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
QUARTER = {"rotation": [0, np.sqrt(0.5), 0, np.sqrt(0.5)], "scale": [2, 2, 2], "translation": [1, 2, 3]}


def parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """JSON and binary chunk, without the package."""
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size : 28 + size + struct.unpack_from("<I", data, 20 + size)[0]]


def columns(data: bytes) -> dict[str, np.ndarray]:
    """Every attribute of the first primitive of a file with tight buffer views, without the package."""
    doc, binary = parts(data)
    kinds, widths = {v: k for k, v in CODES.items()}, {v: k for k, v in TYPES.items()}
    out = {}
    for name, index in doc["meshes"][0]["primitives"][0]["attributes"].items():
        item = doc["accessors"][index]
        width = widths[item["type"]]
        start = doc["bufferViews"][item["bufferView"]]["byteOffset"]
        values = np.frombuffer(binary, kinds[item["componentType"]], item["count"] * width, start)
        out[name.removeprefix(f"{KHR}:")] = values.reshape(-1, width)
    return out


def build(attributes: dict[str, np.ndarray], nodes: list[dict[str, Any]] | None = None, **extension: Any) -> bytes:
    """A GLB file of one Gaussian primitive (mesh 1), a mesh without data (mesh 0), an unknown chunk and a tail."""
    accessors, views, names, binary = [], [], {}, b""
    for name, values in attributes.items():
        names[name if ":" in name or name in ("POSITION", "COLOR_0") else f"{KHR}:{name}"] = len(accessors)
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes, "name": f"view of {name}"})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": CODES[values.dtype.name], "count": len(values)}
        )
        accessors[-1] |= {"type": TYPES[values.shape[1]], "normalized": values.dtype.kind != "f"}
        binary += values.tobytes() + bytes(-values.nbytes % 4)
    khr = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"} | extension
    primitive = {"attributes": names, "mode": 0, "extensions": {KHR: khr}, "material": 0}
    doc = {
        "asset": {"version": "2.0", "extras": {"author": "by hand"}},
        "extensionsUsed": [KHR],
        "materials": [{"name": "kept"}],
        "nodes": nodes or [{"mesh": 1}],
        "scenes": [{"nodes": [0]}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [{"attributes": {}}], "name": "other"}, {"primitives": [primitive]}],
    }
    text = json.dumps(doc).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    body += struct.pack("<II", 4, 0x12345678) + b"more"
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body + b"tail"


def attributes_of(splats: Splats) -> dict[str, np.ndarray]:
    """In the primitive's own frame: the rows as they are, quaternions made unit."""
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    out = {"POSITION": splats.means, "ROTATION": unit[:, [1, 2, 3, 0]], "SCALE": splats.scales}
    out["OPACITY"] = splats.opacities[:, None]
    names = [f"SH_DEGREE_{l}_COEF_{n}" for l in range(splats.sh_degree + 1) for n in range(2 * l + 1)]
    return out | {name: np.ascontiguousarray(splats.sh[:, k]) for k, name in enumerate(names)}


def pack(doc: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(doc).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
