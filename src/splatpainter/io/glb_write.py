"""Rows -> glTF: a fresh file, or the source's with only changed values replaced (layout: glb.py).

Where rows keep their number and order and an attribute is float, changed rows are written into the source's buffer and
no other byte of it moves. Otherwise the attribute gets a buffer view of its own, as float32: rows that did not change
have there exactly the value that the old (perhaps integer) components meant. COLOR_0 follows in changed rows, and
attributes that are not ours go with the row they belonged to (0 in rows that come from nowhere).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import frames, gltf
from splatpainter.io.glb import (
    EXTENSION,
    HALF_TURN,
    SPACES,
    GaussianPrimitive,
    GlbFile,
    read_local,
    sh_semantics,
    with_bands,
)
from splatpainter.io.reuse import Kept, presentable
from splatpainter.splats import ATTRIBUTES, SH_C0, Splats

ARRAY_BUFFER = 34962


def fresh(splats: Splats) -> gltf.Glb:
    """A file with nothing but the rows, in glTF's frame, with the fallback colours the standard asks for."""
    local = _unit(frames.move(presentable(splats), HALF_TURN))
    values = _columns(local) | {"COLOR_0": _fallback(local, linear=splats.color_space == "srgb")}
    doc: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "SplatPainter"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "buffers": [{"byteLength": 0}],
        "bufferViews": [],
        "accessors": [],
        "meshes": [{"primitives": [{"attributes": {}, "mode": 0, "extensions": {}}]}],
    }
    primitive, binary = doc["meshes"][0]["primitives"][0], bytearray()
    for number, (semantic, array) in enumerate(values.items()):
        doc["accessors"].append(_accessor(doc, binary, array))
        primitive["attributes"][_name(semantic)] = number
    doc["accessors"][0] |= _range(local.means)
    _say(primitive, splats)
    doc["buffers"][0]["byteLength"] = len(binary)
    return gltf.Glb(doc, bytes(binary), (), b"")


def edited(splats: Splats, same: Kept, old: GlbFile, path: Path) -> gltf.Glb:
    """The source with the rows of `splats`. Raises ValueError: no row of a primitive is left."""
    doc, binary = copy.deepcopy(old.glb.doc), bytearray(old.glb.binary)
    work = _Work(doc, binary, _shared(doc), old.glb, path)
    rows, homes = presentable(splats), homes_of(same.rows, old.primitives)
    for number, one in enumerate(old.primitives):
        here = homes == number
        if not here.any():
            raise ValueError(
                f"{path}: glTF cannot hold a primitive of 0 rows (none of primitive {one.index} of mesh {one.mesh} "
                "is left); write .ply instead"
            )
        _edit_primitive(work, one, rows.take(here), _part_of(same, here, one))
        _say(doc["meshes"][one.mesh]["primitives"][one.index], splats)
    used = doc.setdefault("extensionsUsed", [])
    if EXTENSION not in used:
        used.append(EXTENSION)
    packed = gltf.compact(doc, binary) if len(binary) != len(old.glb.binary) else bytes(binary)
    doc["buffers"][0]["byteLength"] = len(packed)
    return replace(old.glb, doc=doc, binary=packed)


@dataclass(frozen=True)
class _Work:
    """A file that is being changed."""

    doc: dict[str, Any]
    binary: bytearray
    shared: set[int]
    """Accessors that may not be written to (`_shared`)."""
    source: gltf.Glb
    path: Path


def homes_of(rows: np.ndarray, primitives: tuple[GaussianPrimitive, ...]) -> np.ndarray:
    """[N] which of the primitives each row goes to. rows: [N] row of the source, -1 for none.

    Each to the one it came from, and new rows to the one before them, as far as the order of all rows allows: in the
    file rows are ordered by primitive, so a row behind rows of a later primitive goes there, too."""
    starts = np.array([one.first for one in primitives])
    cause = np.where(rows >= 0, np.searchsorted(starts, rows, "right") - 1, 0)
    return np.maximum.accumulate(cause) if len(cause) else cause


def _part_of(same: Kept, here: np.ndarray, one: GaussianPrimitive) -> Kept:
    """What is kept of the rows of one primitive, counted from its first."""
    rows = same.rows[here] - one.first
    inside = (same.rows[here] >= 0) & (rows >= 0) & (rows < one.rows)
    masks = {name: getattr(same, name)[here] & inside for name in (*ATTRIBUTES[:-1], "base", "rest")}
    return replace(same, rows=np.where(inside, rows, -1), **masks)


def _edit_primitive(work: _Work, one: GaussianPrimitive, rows: Splats, same: Kept) -> None:
    """The primitive with `rows` (PLY frame) as its rows."""
    before = read_local(work.source, one, work.path, [])
    local = _unit(frames.move(rows, one.turn, one.scale, one.shift))
    bands = before.sh.shape[1]
    opened = rows.source.splats.sh.shape[1] if rows.source else 0
    if local.sh.shape[1] != opened or local.sh[:, bands:].any():  # else the zeros behind are for other primitives
        bands = local.sh.shape[1]
    own = before.sh.shape[1]
    local, before = (replace(s, sh=with_bands(s.sh, bands)) for s in (local, before))
    restored = _restore(local, before, same)
    restored.sh[:, own:] = local.sh[:, own:]  # not in the file yet, the sign of zero included
    local = restored
    primitive = work.doc["meshes"][one.mesh]["primitives"][one.index]
    attributes = primitive["attributes"]
    in_place = len(local) == len(before) and bool((same.rows == np.arange(len(local))).all())
    masks = {"POSITION": same.means, "ROTATION": same.quats, "SCALE": same.scales, "OPACITY": same.opacities}
    columns = _columns(local)
    for semantic, array in columns.items():
        keep = masks.get(semantic, same.base if semantic == "SH_DEGREE_0_COEF_0" else same.rest)
        _put(work, attributes, one.names.get(semantic, _name(semantic)), array, ~keep, in_place)
    for semantic in set(one.names) & set(sh_semantics(4)) - set(columns):
        attributes.pop(one.names[semantic])
    ours = {one.names.get(semantic, _name(semantic)) for semantic in columns}
    for name in [name for name in attributes if name not in ours]:
        try:
            values = np.array(gltf.accessor(work.source, work.source.binary, attributes[name], work.path))
        except ValueError:
            values = np.zeros((0, 0))
        if len(values) != len(before):  # of a kind that cannot be followed: stays if rows do, goes if they do not
            if not in_place:
                attributes.pop(name)
            continue
        moved = np.zeros((len(local), values.shape[1]), values.dtype)
        moved[same.rows >= 0] = values[same.rows[same.rows >= 0]]
        changed = np.zeros(len(local), bool)
        if name == "COLOR_0" and values.shape[1] in (3, 4):
            changed = ~(same.base & same.opacities)
            moved[changed] = _fallback_like(values, before, local)[changed]
        _put(work, attributes, name, moved, changed, in_place)
    if not in_place:
        for key in ("indices", "targets"):  # they count rows that are no longer there
            primitive.pop(key, None)


def _columns(local: Splats) -> dict[str, np.ndarray]:
    """Semantic -> [N, width] float32, in the order that files are written."""
    out = {
        "POSITION": local.means,
        "ROTATION": local.quats[:, [1, 2, 3, 0]],
        "SCALE": np.maximum(local.scales, 0),
        "OPACITY": local.opacities[:, None],
    }
    out |= {semantic: local.sh[:, k] for k, semantic in enumerate(sh_semantics(local.sh_degree))}
    return out


def _name(semantic: str) -> str:
    return semantic if semantic in ("POSITION", "COLOR_0") else f"{EXTENSION}:{semantic}"


def _unit(local: Splats) -> Splats:
    """Quaternions of norm 1, which the standard asks for; those that have it to float32 rounding keep their bits."""
    norms = np.linalg.norm(local.quats.astype(np.float64), axis=1, keepdims=True)
    quats = np.where(np.abs(norms - 1) < 1e-6, local.quats, local.quats / norms)
    return replace(local, quats=quats.astype(np.float32))


def _restore(local: Splats, before: Splats, same: Kept) -> Splats:
    """`local` with the file's own bits in every value that did not change."""
    out = {name: getattr(local, name).copy() for name in ("means", "quats", "scales", "opacities", "sh")}
    for name in ("means", "quats", "scales", "opacities"):
        mask = getattr(same, name)
        out[name][mask] = getattr(before, name)[same.rows[mask]]
    out["sh"][same.base, 0] = before.sh[same.rows[same.base], 0]
    if same.rest.any():  # else the degrees may differ
        out["sh"][same.rest, 1:] = before.sh[same.rows[same.rest], 1:]
    return replace(local, **out)


def _put(
    work: _Work, attributes: dict[str, Any], name: str, array: np.ndarray, changed: np.ndarray, in_place: bool
) -> None:
    """Make attribute `name` hold `array`: not at all where nothing changed, into the buffer where that is possible."""
    doc, binary, shared = work.doc, work.binary, work.shared
    index = attributes.get(name)
    if index is not None and in_place:
        if not changed.any():
            return
        target = gltf.accessor(replace(work.source, doc=doc), binary, index, work.path)
        # Integers take only values that are integers already; everything else would be rounded.
        if index not in shared and target.dtype == array.dtype and target.shape == array.shape:
            target[changed] = array[changed]
            if name == "POSITION" or "min" in doc["accessors"][index]:
                doc["accessors"][index] |= _range(array)
            return
    item = _accessor(doc, binary, array)
    if index is not None and array.dtype.kind != "f" and doc["accessors"][index].get("normalized") is not True:
        item.pop("normalized", None)
    if name == "POSITION":
        item |= _range(array)
    if index is not None and index not in shared:
        doc["accessors"][index] = item
    else:
        doc["accessors"].append(item)
        attributes[name] = len(doc["accessors"]) - 1


def _range(array: np.ndarray) -> dict[str, list[float]]:
    finite = array[np.isfinite(array).all(1)] if array.dtype.kind == "f" else array
    return {"min": finite.min(0).tolist(), "max": finite.max(0).tolist()} if len(finite) else {}


def _accessor(doc: dict[str, Any], binary: bytearray, array: np.ndarray) -> dict[str, Any]:
    """An accessor (not yet listed) of a new buffer view at the end of `binary`; integers are normalised."""
    width = array.shape[1] * array.dtype.itemsize
    padded = np.zeros((len(array), width + -width % 4), np.uint8)  # glTF wants elements on multiples of 4 bytes
    padded[:, :width] = np.ascontiguousarray(array).view(np.uint8).reshape(len(array), width)
    binary += b"\0" * (-len(binary) % 4)
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": padded.size, "target": ARRAY_BUFFER}
    if padded.shape[1] != width:
        view["byteStride"] = padded.shape[1]
    binary += padded.tobytes()
    doc["bufferViews"].append(view)
    kinds = {np.dtype(kind): code for code, kind in gltf.COMPONENTS.items()}
    types = {width: name for name, width in gltf.WIDTHS.items()}
    item = {"bufferView": len(doc["bufferViews"]) - 1, "byteOffset": 0, "componentType": kinds[array.dtype]}
    item |= {"count": len(array), "type": types[array.shape[1]]}
    if array.dtype.kind != "f":
        item["normalized"] = True
    return item


def _shared(doc: dict[str, Any]) -> set[int]:
    """Accessors that more than one attribute, index list or target names."""
    seen: list[Any] = []
    for mesh in doc["meshes"]:
        for primitive in mesh.get("primitives", []):
            for group in (primitive.get("attributes", {}), *primitive.get("targets", [])):
                seen += group.values()
            seen.append(primitive.get("indices"))
    return {index for index in seen if isinstance(index, int) and seen.count(index) > 1}


def _say(primitive: dict[str, Any], splats: Splats) -> None:
    """Colour space and antialiasing into the extension object, which is made where it is missing; an antialiasing that
    was not changed stays what the primitive says."""
    extensions = primitive.setdefault("extensions", {})
    extension = extensions.get(EXTENSION)
    if not isinstance(extension, dict):
        extension = extensions[EXTENSION] = {}
    extension.setdefault("kernel", "ellipse")
    linear = extension.get("colorSpace") == SPACES["linear"]  # anything else is read as sRGB, and may stay
    if linear != (splats.color_space == "linear") or "colorSpace" not in extension:
        extension["colorSpace"] = SPACES[splats.color_space]
    extras = extension.get("extras")
    said = isinstance(extras, dict) and extras.get("antialiased") is True
    source = splats.source if splats.source is not None and splats.source.format == "glb" else None
    changed = source is None or source.splats.antialiased != splats.antialiased
    if changed and said != splats.antialiased:
        extension["extras"] = {**(extras if isinstance(extras, dict) else {}), "antialiased": splats.antialiased}


def _fallback(local: Splats, linear: bool) -> np.ndarray:
    """[N, 4] uint8 COLOR_0. linear: decode sRGB first, since glTF vertex colours are linear."""
    color = np.clip(0.5 + SH_C0 * np.nan_to_num(local.sh[:, 0].astype(np.float64)), 0, 1)
    if linear:
        color = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    opacity = np.clip(np.nan_to_num(local.opacities.astype(np.float64)), 0, 1)
    return np.rint(np.concatenate([color, opacity[:, None]], 1) * 255).astype(np.uint8)


def _fallback_like(values: np.ndarray, before: Splats, local: Splats) -> np.ndarray:
    """COLOR_0 of `local` in the kind of the file's `values` [N, 3 or 4]; linear or not as the file's own rows are."""
    width, scale = values.shape[1], 1.0 if values.dtype.kind == "f" else np.iinfo(values.dtype).max
    errors = {
        linear: np.abs(_fallback(before, linear)[:, :3] / 255 - values[:, :3].astype(np.float64) / scale).mean()
        for linear in (True, False)
    }
    best = _fallback(local, errors[True] <= errors[False])[:, :width].astype(np.float64) / 255 * scale
    return (best if values.dtype.kind == "f" else np.rint(best)).astype(values.dtype)
