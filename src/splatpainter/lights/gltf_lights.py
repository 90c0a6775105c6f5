"""Lights of glTF scenes: KHR_lights_punctual (directional, point and spot; lux and candela), in and out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import files
from splatpainter.io.formats import gltf
from splatpainter.lights.lamps import PENUMBRA, SUN_DEGREES, Rgb
from splatpainter.lights.scene_lights import SceneLight
from splatpainter.system import jsonio
from splatpainter.system.jsonio import object_at, objects_at

EXTENSION = "KHR_lights_punctual"
MAX_LIGHTS = 1000
MAX_BYTES = 512 << 20


def read_gltf_lights(path: Path) -> list[SceneLight]:
    """Of all nodes of a .glb or .gltf. An irradiance of pi lux, or an intensity of pi candela, is 1 here. Raises
    ValueError."""
    if path.suffix.lower() == ".gltf":
        doc = jsonio.load_object(files.read_head(path, jsonio.MAX_JSON_BYTES + 1), path, "a glTF document")
        doc.setdefault("nodes", [])
    else:
        doc = gltf.parse(files.read_head(path, MAX_BYTES), path).doc
    lights = objects_at(object_at(object_at(doc, "extensions", path), EXTENSION, path), "lights", path)
    nodes, out = objects_at(doc, "nodes", path), []
    tree = gltf.parents_of(doc)
    for index, node in enumerate(nodes):
        link = object_at(object_at(node, "extensions", path), EXTENSION, path).get("light")
        if link is None:
            continue
        if type(link) is not int or not 0 <= link < len(lights):
            raise ValueError(f"{path}: expected the number of a light at node {index}, got {jsonio.brief(link)}")
        if len(out) == MAX_LIGHTS:
            raise ValueError(f"{path}: expected at most {MAX_LIGHTS} lights")
        out.append(_light(lights[link], gltf.global_matrix(doc, index, path, tree), path))
    return out


def glb_of(lights: list[SceneLight]) -> tuple[bytes, list[str]]:
    """(a GLB of these lights and nothing else, what it cannot hold)."""
    entries, nodes, losses = [], [], []
    for light in lights:
        color = np.array(light.color, np.float64)
        level = max(float(color.max()), 1e-9)  # its colours end at 1
        item: dict[str, Any] = {
            "name": light.name,
            "color": [float(value) for value in color / level],
            "intensity": light.intensity * level * math.pi,
        }
        if light.kind == "distant":
            item["type"] = "directional"
        elif light.kind == "spot":
            outer = math.radians(min(light.sizes[0] / 2, 89.9))
            item |= {"type": "spot", "spot": {"innerConeAngle": outer * (1 - PENUMBRA), "outerConeAngle": outer}}
        # glTF has no lamps with an area: what comes nearest is written, and what is lost is said.
        elif light.kind in ("rect", "disk"):
            item |= {"type": "spot", "spot": {"innerConeAngle": 0.0, "outerConeAngle": math.radians(89.9)}}
            losses.append(f"{light.name}: a {light.kind} becomes a wide spot without area")
        else:
            item["type"] = "point"
            if light.kind == "sphere":
                losses.append(f"{light.name}: a sphere becomes a point")
        nodes.append(
            {
                "name": light.name,
                "matrix": [float(value) for value in light.matrix.T.ravel()],
                "extensions": {EXTENSION: {"light": len(entries)}},
            }
        )
        entries.append(item)
    doc = {
        "asset": {"version": "2.0", "generator": "splatpainter"},
        "extensionsUsed": [EXTENSION],
        "extensions": {EXTENSION: {"lights": entries}},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
    }
    return gltf.serialise(gltf.Glb(doc, b"", (), b"")), losses


def _light(item: dict[str, Any], matrix: np.ndarray, path: Path) -> SceneLight:
    color = jsonio.finite_numbers(item.get("color", [1, 1, 1]), path, "a light's color")
    intensity = jsonio.finite_numbers([item.get("intensity", 1)], path, "a light's intensity")[0]
    if color.shape != (3,) or color.min() < 0 or intensity < 0:
        raise ValueError(f"{path}: expected three numbers from 0 as a light's color, and an intensity from 0")
    # A node may scale what it holds; a direction must not.
    length = math.sqrt(float((matrix[:3, 2] ** 2).sum()))
    if not math.isfinite(length) or length < 1e-12:
        raise ValueError(f"{path}: a light's node has a transform without inverse")
    along, where = -matrix[:3, 2] / length, matrix[:3, 3]
    rgb: Rgb = (float(color[0]), float(color[1]), float(color[2]))
    strength, name = float(intensity) / math.pi, str(item.get("name", ""))[:100]
    kind = item.get("type")
    if kind == "directional":
        return SceneLight("distant", where, along, rgb, strength, (SUN_DEGREES,), name)
    if kind == "point":
        return SceneLight("point", where, along, rgb, strength, (), name)
    if kind == "spot":
        cone = object_at(item, "spot", path)
        outer = jsonio.finite_numbers([cone.get("outerConeAngle", math.pi / 4)], path, "a spot's outerConeAngle")[0]
        angle = min(max(2 * math.degrees(float(outer)), 1e-3), 170.0)
        return SceneLight("spot", where, along, rgb, strength, (angle,), name)
    raise ValueError(f"{path}: expected a directional, point or spot light, got {jsonio.brief(kind)}")
