"""glTF 2.0 binary (.glb) with KHR_gaussian_splatting: primitives of POINTS.

    POSITION                                      VEC3   float, or quantised
    KHR_gaussian_splatting:ROTATION               VEC4   x, y, z, w, unit
    KHR_gaussian_splatting:SCALE                  VEC3   linear
    KHR_gaussian_splatting:OPACITY                SCALAR 0..1
    KHR_gaussian_splatting:SH_DEGREE_l_COEF_n     VEC3   n = l + m, as INRIA; degree 0-3
    COLOR_0                                       VEC4   base colour and opacity, for renderers without the extension

Extension object: kernel "ellipse", colorSpace "srgb_rec709_display" or "lin_rec709_display"; the standard has no word
for antialiased training, so `extras.antialiased` there is ours.

Axes: glTF is y up. Rows in memory have the PLY's, half a turn about z away (x and y reversed), which is how
splat-transform writes it; so PLY -> GLB -> PLY gives back the axes. The transform of the node that shows the mesh is
applied when it is a rotation, uniform scale and translation. A translation that float32 positions could not follow
becomes the offset of the rows (Splats.offset), and the offset the translation of a new file's node. Reading is lenient:
attribute names without the prefix, or with `_`, and COLOR_0 in place of OPACITY and SH degree 0 are accepted.

Primitives whose rows lie in an SPZ stream (gltf_spz.py) are read; an edit unpacks them into attributes, which hold the
same values bit for bit.

Writing over a source of this format keeps every byte of values that did not change, all other JSON, meshes, nodes and
chunks. Where rows keep their number and order and an attribute is float, changed rows are written into the source's
buffer and no other byte of it moves. Otherwise the attribute gets a buffer view of its own, as float32: rows that did
not change have there exactly the value that the old (perhaps integer) components meant. COLOR_0 follows in changed
rows, and attributes that are not ours go with the row they belonged to (0 in rows that come from nowhere). An untouched
asset is written back byte for byte.
"""

from __future__ import annotations

import copy
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.array_types import Bytes
from splatpainter.color import srgb_to_linear
from splatpainter.io import axes, files, positions
from splatpainter.io.bounded import allow_rows
from splatpainter.io.formats import activations, gltf, gltf_spz
from splatpainter.io.formats.reuse import Unchanged, drawable_rows, row_problems, unchanged
from splatpainter.kernels import portable
from splatpainter.splats import ATTRIBUTES, SH_C0, Source, Splats
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import nearest_rotation, row_norm

EXTENSION = "KHR_gaussian_splatting"
INSTANCING = "EXT_mesh_gpu_instancing"
EXTENSIONS_DONE = (EXTENSION, *gltf_spz.NESTED, *gltf_spz.BESIDE, "KHR_mesh_quantization")
OF_MESHES = ("KHR_texture_", "EXT_texture_", "KHR_materials_", "KHR_lights_", "KHR_draco_", "EXT_meshopt_")
"""Extensions that a file may require without a word: beginnings of those that other meshes have, or that are refused
where Gaussians have them."""
COLOR_SPACES = {"srgb": "srgb_rec709_display", "linear": "lin_rec709_display"}
MAX_SHARED_RATIO = 16
"""Bytes of rows in memory per byte of the file: accessors may share bytes, as of SH bands that are empty."""
MAX_PRIMITIVES = 512
"""Gaussian primitives of a file: honest ones have a handful, and each may stand at the end of a deep tree of nodes."""
LINEAR_SCALES = (2, 7, 0)
"""Version of splat-transform from which its GLB files hold scales, not their logarithms (its pull request 268)."""
NOT_APPLIED = "the node's transform is not a rotation with uniform scale; it is kept but not applied"
"""Problem of a file whose Gaussians are shown elsewhere, or of other proportions, than it asks (`doubts.py`)."""
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
ARRAY_BUFFER = 34962
"""Target of a buffer view of vertex attributes."""


@dataclass(frozen=True)
class GaussianPrimitive:
    """One primitive whose rows are open: where it is in the file, and where its rows are among all."""

    mesh: int
    index: int
    """Index among the mesh's primitives."""
    names: dict[str, str]
    """ROTATION, SCALE, ... -> the attribute name the file uses."""
    turn: np.ndarray
    """[3, 3] rotation from the PLY's axes to the primitive's own; `scale` and `shift` [3] go with it (axes.move)."""
    scale: float
    shift: np.ndarray
    first: int = 0
    """Row of the asset that is this primitive's row 0."""
    rows: int = 0


@dataclass(frozen=True)
class GlbFile:
    """What a file held, enough to keep it."""

    glb: gltf.Glb
    primitives: tuple[GaussianPrimitive, ...]
    """Primitives in file order, which is the order of their rows."""
    data: bytes
    """The file."""
    log_scales: str = ""
    """The generator, where it stored logarithms as SCALE; "" where SCALE is what the standard says."""


def read_glb(path: Path, offset: positions.Offset | None = None) -> Splats:
    """Read all Gaussian primitives, in the order of meshes and of primitives in them, each where its node puts it.
    offset: of the means; None: where the first one's node stands, if float32 does not hold positions there.

    Raises ValueError: no such primitive, compressed or external data, damaged or truncated file.
    """
    data = files.read_all(path)
    glb = gltf.parse(data, path)
    problems: list[str] = []
    placements: dict[int, tuple[np.ndarray, float, np.ndarray]] = {}
    primitives, pieces, first = [], [], 0
    opened = _primitives_to_open(glb.doc, path, problems)
    semantics = [_names(glb.doc["meshes"][mesh]["primitives"][index]) for mesh, index in opened]
    bands = max(sum(name.startswith("SH_") for name in names) for names in semantics)
    parents, log_scales = gltf.parents_of(glb.doc), _stores_log_scales(glb.doc)
    for (mesh, index), names in zip(opened, semantics, strict=True):
        if mesh not in placements:
            turn, scale, shift = placement = _placement(glb.doc, mesh, parents, path, problems)
            if offset is None:
                one = GaussianPrimitive(mesh, index, names, *placement)
                offset = _offset(glb, one, path, Bound(len(data), bands), bool(log_scales))
            placements[mesh] = (
                turn,
                scale,
                shift + portable.matmul(np.array(offset), turn.T) * scale if any(offset) else shift,
            )
        one = GaussianPrimitive(mesh, index, names, *placements[mesh], first)
        with np.errstate(all="ignore"):  # extreme values are reported below
            local = read_local(glb, one, path, problems, Bound(len(data), bands))
            local = replace(local, scales=activations.exp(local.scales)) if log_scales else local
        if not pieces or local.color_space == pieces[0].color_space:
            pieces.append(axes.move_back(local, one.turn, one.scale, one.shift))
            primitives.append(replace(one, rows=len(local)))
            first += len(local)
        else:  # rows of one asset have one colour space, and turning one into the other is not exact
            problems.append(f"primitive {index} of mesh {mesh} has another colour space; it is not opened, but kept")
    rows = replace(_joined(pieces), offset=offset or positions.NO_OFFSET)
    problems = list(dict.fromkeys(problems)) + row_problems(rows)
    file = GlbFile(glb, tuple(primitives), data, log_scales)
    source = Source(str(path), "glb", rows, files.sha256(data), file, tuple(problems), "luf")
    return replace(rows, source=source, origin=np.arange(len(rows)))


def _stores_log_scales(doc: dict[str, Any]) -> str:
    """`asset.generator`, where it is a splat-transform that stored logarithms as SCALE: all before LINEAR_SCALES. What
    they say of scales above 1 looks sound."""
    asset = doc.get("asset")
    generator = asset.get("generator") if isinstance(asset, dict) else None
    words = generator if isinstance(generator, str) else ""
    version = re.match(r"splat-transform v?(\d{1,4})\.(\d{1,4})\.(\d{1,4})", words)
    if version is None or tuple(map(int, version.groups())) >= LINEAR_SCALES:
        return ""
    return files.printable(version[0])


def _joined(pieces: list[Splats]) -> Splats:
    """All rows, with zeros for the SH bands that a primitive does not have; flags are those of the first."""
    if len(pieces) == 1:
        return pieces[0]
    bands = max(piece.sh.shape[1] for piece in pieces)
    columns = {name: np.concatenate([getattr(p, name) for p in pieces]) for name in ATTRIBUTES if name != "sh"}
    return replace(pieces[0], **columns, sh=np.concatenate([with_bands(piece.sh, bands) for piece in pieces]))


def with_bands(sh: np.ndarray, bands: int) -> np.ndarray:
    """[N, K, 3] -> [N, bands, 3]: cut, or filled up with zeros."""
    if sh.shape[1] >= bands:
        return sh[:, :bands]
    return np.concatenate([sh, np.zeros((len(sh), bands - sh.shape[1], 3), np.float32)], 1)


def sh_semantics(degree: int) -> list[str]:
    """SH_DEGREE_l_COEF_n in the order of `Splats.sh`."""
    return [f"SH_DEGREE_{l}_COEF_{n}" for l in range(degree + 1) for n in range(2 * l + 1)]


@dataclass(frozen=True)
class Bound:
    """Limit that the rows of all primitives together count against."""

    size: int
    """Bytes of the file."""
    bands: int
    """SH coefficients a row at most."""


def read_local(
    glb: gltf.Glb, one: GaussianPrimitive, path: Path, problems: list[str], bound: Bound | None = None
) -> Splats:
    """The rows in the primitive's own axes, bit for bit what the file says (integers as float32). bound: of rows that
    were not read before."""
    # What the extension says of all rows.
    primitive = glb.doc["meshes"][one.mesh]["primitives"][one.index]
    attributes = primitive.get("attributes", {})
    extension = _extension(primitive)
    flags: dict[str, Any] = {
        "antialiased": isinstance(extension.get("extras"), dict) and extension["extras"].get("antialiased") is True,
        "color_space": "linear" if extension.get("colorSpace") == COLOR_SPACES["linear"] else "srgb",
    }
    # A stream of SPZ inside of the buffer is a file of its own, with its own limits.
    if gltf_spz.is_packed(primitive):
        rows = gltf_spz.unpack(glb, primitive, path, problems)
        if bound is not None:
            allow_rows(bound.size, one.first + len(rows), max(bound.bands, rows.sh.shape[1]), path)
        if rows.antialiased and not flags["antialiased"]:
            problems.append("the SPZ stream is marked antialiased, for which glTF has no word; it is read without")
        return replace(rows, **flags)
    count: int | None = None

    def read(semantic: str, width: int) -> np.ndarray:
        nonlocal count
        if semantic not in one.names:
            # COLOR_0 is looked for where one of these is missing.
            missing = {"COLOR_0": "SH_DEGREE_0_COEF_0" if "OPACITY" in one.names else "OPACITY"}.get(semantic, semantic)
            instead = " (and no COLOR_0 in its place)" if missing != semantic else ""
            raise ValueError(f"{path}: the Gaussian primitive has no attribute {EXTENSION}:{missing}{instead}")
        index = attributes[one.names[semantic]]
        values = gltf.accessor(glb, glb.binary, index, path)
        if count is None:
            count = len(values)
        if values.shape != (count, width) and not (semantic == "COLOR_0" and values.shape == (count, 3)):
            raise ValueError(f"{path}: expected {semantic} of {count} x {width} numbers, found {values.shape}")
        if bound is not None:  # all primitives together, and as many SH bands for each as any has
            allow_rows(bound.size, one.first + len(values), bound.bands, path, MAX_SHARED_RATIO)
        return gltf.decode(values, glb.doc["accessors"][index].get("normalized"))

    # The first attribute sets the count that the others are held to. Older drafts of the extension had neither
    # opacities nor SH: their colours were COLOR_0.
    means, xyzw, scales = read("POSITION", 3), read("ROTATION", 4), read("SCALE", 3)
    if "OPACITY" in one.names:
        opacities = read("OPACITY", 1)[:, 0]
    else:
        color = read("COLOR_0", 4)
        opacities = color[:, 3].copy() if color.shape[1] == 4 else np.ones(len(color), np.float32)
        problems.append("no opacities; taken from the alpha of COLOR_0")
    degree = max((l for l in range(5) if set(sh_semantics(l)) <= set(one.names)), default=-1)
    if degree < 0:
        sh = (read("COLOR_0", 4)[:, None, :3] - np.float32(0.5)) / np.float32(SH_C0)
        problems.append("no SH degree 0; colours taken from COLOR_0")
    else:
        sh = np.stack([read(semantic, 3) for semantic in sh_semantics(degree)], 1)
        if any(name.startswith("SH_") for name in set(one.names) - set(sh_semantics(degree))):
            problems.append(f"SH above degree {degree} is incomplete and not read")
    return Splats(means, np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]]), scales, opacities, sh, **flags)


def _extension(primitive: dict[str, Any]) -> dict[str, Any]:
    extension = primitive.get("extensions", {}).get(EXTENSION)
    return extension if isinstance(extension, dict) else {}


def _names(primitive: dict[str, Any]) -> dict[str, str]:
    """Semantic -> attribute of the primitive that holds it; of one that lies in a stream none does."""
    names: dict[str, str] = {}
    attributes = {} if gltf_spz.is_packed(primitive) else primitive.get("attributes", {})
    for semantic in ("POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY", *sh_semantics(4)):
        for name in (f"{EXTENSION}:{semantic}", f"_{semantic}", semantic):
            if name in attributes:
                names[semantic] = name
                break
    return names


def _primitives_to_open(doc: dict[str, Any], path: Path, problems: list[str]) -> list[tuple[int, int]]:
    """(mesh, primitive) of the Gaussian primitives to open, in file order.

    Where nodes show some of them, the others are no part of any picture: they are kept and reported."""
    # Files of several versions of the extension: it marks primitives, or only their attributes.
    candidates = []
    for mesh, item in enumerate(doc.get("meshes", [])):
        for index, primitive in enumerate(item.get("primitives", [])):
            names = primitive.get("attributes", {})
            marked = EXTENSION in primitive.get("extensions", {}) or gltf_spz.is_packed(primitive)
            if marked or any(name.startswith(f"{EXTENSION}:") for name in names):
                candidates.append((mesh, index))
    if not candidates:
        raise ValueError(f"{path}: expected a primitive with {EXTENSION}; this glTF file holds no Gaussians")
    meshes = {node.get("mesh") for node in doc.get("nodes", []) if type(node.get("mesh")) is int}
    visible = set(gltf.parents_of(doc).showing)
    to_open = [one for one in candidates if one[0] in visible] or candidates
    elsewhere = sum(mesh in meshes for mesh, _ in candidates) if visible else 0
    elsewhere -= sum(mesh in meshes for mesh, _ in to_open) if elsewhere else 0
    hidden = len(candidates) - len(to_open) - elsewhere
    if hidden:
        problems.append(f"{hidden} Gaussian primitives that no node shows; they are not opened, but kept")
    if elsewhere:
        problems.append(
            f"{elsewhere} Gaussian primitives that only other scenes of the file show; they are not opened, but kept"
        )
    if len(to_open) > MAX_PRIMITIVES:
        raise ValueError(f"{path}: expected at most {MAX_PRIMITIVES} Gaussian primitives, found {len(to_open)}")
    for mesh, index in to_open:
        _check_primitive(doc["meshes"][mesh]["primitives"][index], path, problems)
    _check_scene(doc, {mesh for mesh, _ in to_open}, problems)
    return to_open


def _check_scene(doc: dict[str, Any], meshes: set[int], problems: list[str]) -> None:
    """What a file asks for that is not done here, and that moves or multiplies what is seen."""
    required = doc.get("extensionsRequired")
    names = required if isinstance(required, list) else []
    unknown = [str(name) for name in names if name not in EXTENSIONS_DONE and not str(name).startswith(OF_MESHES)]
    if unknown:
        problems.append(
            f"it requires {files.printable(', '.join(unknown))}, which is not done here: it may look otherwise"
        )
    nodes = [node for node in doc.get("nodes", []) if type(node.get("mesh")) is int and node["mesh"] in meshes]
    if any(INSTANCING in node["extensions"] for node in nodes if isinstance(node.get("extensions"), dict)):
        problems.append(f"{INSTANCING}: its Gaussians are opened once, where their node puts them, without instances")
    if any("skin" in node for node in nodes):
        problems.append("the Gaussians have a skin; they are shown at rest, without its bones")
    if doc.get("animations"):
        problems.append("it has animations; the Gaussians are shown at rest, where their nodes put them")


def _check_primitive(primitive: dict[str, Any], path: Path, problems: list[str]) -> None:
    # What cannot be shown as the file asks is told; only what cannot be read is refused.
    extension = _extension(primitive)
    packed = extension.get("extensions")
    if isinstance(packed, dict) and packed and not gltf_spz.is_packed(primitive):
        names = files.printable(", ".join(packed))
        raise ValueError(
            f"{path}: the Gaussians are stored by {names}, which is not supported; decompress the file first"
        )
    if primitive.get("mode", 4) != 0:
        problems.append(f"primitive mode {brief(primitive.get('mode', 4))} in place of 0 (points)")
    if "indices" in primitive:
        problems.append("the primitive's indices are not used; every row is shown")
    if primitive.get("targets"):
        problems.append("the primitive has morph targets; its Gaussians are shown without them")
    for key, value in (("kernel", "ellipse"), ("projection", "perspective"), ("sortingMethod", "cameraDistance")):
        if extension.get(key, value) != value:
            problems.append(f"{key} {brief(extension[key])} is shown as {value!r}")
    if extension.get("colorSpace", COLOR_SPACES["srgb"]) not in COLOR_SPACES.values():
        problems.append(f"colour space {brief(extension['colorSpace'])} is treated as sRGB")


def _placement(
    doc: dict[str, Any], mesh: int, parents: gltf.Parents, path: Path, problems: list[str]
) -> tuple[np.ndarray, float, np.ndarray]:
    """Rotation, scale and shift from the PLY's axes to the mesh's own, by the node that shows it."""
    # Rows are opened where the first node puts them, and written back the way they came.
    showing = parents.showing.get(mesh, [])
    nothing = HALF_TURN, 1.0, np.zeros(3)
    if len(showing) > 1:
        problems.append(
            f"{len(showing)} nodes show mesh {mesh}; its rows are opened once, where the first puts them, and an edit "
            "shows in all"
        )
    if not showing:
        return nothing
    with np.errstate(all="ignore"):
        matrix = gltf.global_matrix(doc, showing[0], path, parents)
        determinant = portable.dot(np.cross(*matrix[:2, :3]), matrix[2, :3]) if np.isfinite(matrix).all() else 0.0
        scale = float(np.sign(determinant) * portable.power(abs(determinant), 1 / 3))
        turn = matrix[:3, :3] / scale if scale > 0 else np.zeros((3, 3))
    if not 1e-12 < scale < 1e12 or not np.allclose(portable.matmul(turn, turn.T), np.eye(3), atol=1e-3):
        problems.append(NOT_APPLIED)
        return nothing
    if np.array_equal(matrix, np.eye(4)):
        return nothing
    # The nearest rotation, as a matrix of a file is rounded.
    turn = nearest_rotation(turn).T
    return portable.matmul(turn, HALF_TURN), 1 / scale, -portable.matmul(matrix[:3, 3], turn.T) / scale


def _offset(glb: gltf.Glb, one: GaussianPrimitive, path: Path, bound: Bound, log_scales: bool) -> positions.Offset:
    """Where a node puts the zero of its mesh, if float32 is too coarse there for the primitive's Gaussians, in the axes
    of PLY files; else no offset."""
    origin = -portable.matmul(one.shift, one.turn) / one.scale
    if not origin.any():
        return positions.NO_OFFSET
    with np.errstate(all="ignore"):
        local = read_local(glb, one, path, [], bound)
        scales = activations.exp(local.scales) if log_scales else local.scales
        if not positions.is_coarse(origin + np.zeros(local.means.shape), scales / one.scale):
            return positions.NO_OFFSET
    x, y, z = (origin + 0.0).tolist()
    return x, y, z


# ---- writing


def write_glb(path: Path, splats: Splats) -> None:
    """Write one Gaussian primitive. Raises ValueError: no rows, SH above degree 3 in a new file."""
    # A file that nothing changed is written as the bytes that were read.
    splats = splats.numpy()
    if not len(splats):
        raise ValueError(f"{path}: glTF cannot hold an asset of 0 rows; write .ply instead")
    same = unchanged(splats, "glb")
    old: GlbFile | None = splats.source.detail if same and splats.source else None
    names = [name for one in old.primitives for name in one.names] if old else []
    if splats.sh_degree > 3 and f"SH_DEGREE_{splats.sh_degree}_COEF_0" not in names:
        raise ValueError(f"{path}: glTF holds SH up to degree 3, got {splats.sh_degree}; write .ply or .spz instead")
    if old and same and same.identity:
        out = old.data
    elif old and same:
        out = gltf.serialise(_edited(splats, same, old, path))
    else:
        out = gltf.serialise(_fresh(splats))
    with files.writing(path) as target:
        target.write(out)


def _fresh(splats: Splats) -> gltf.Glb:
    """A file with nothing but the rows, in glTF's axes, with the fallback colours the standard asks for."""
    # The standard allows no NaN and asks for unit quaternions.
    local = _unit(axes.move(drawable_rows(splats, row_by_row=True), HALF_TURN))
    local = replace(local, scales=np.maximum(local.scales, 0))
    values = attribute_columns(local) | {"COLOR_0": _fallback(local, linear=splats.color_space == "srgb")}
    doc: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "SplatPainter"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | _translation(splats.offset)],
        "buffers": [{"byteLength": 0}],
        "bufferViews": [],
        "accessors": [],
        "meshes": [{"primitives": [{"attributes": {}, "mode": 0, "extensions": {}}]}],
    }
    primitive, binary = doc["meshes"][0]["primitives"][0], bytearray()
    for number, (semantic, array) in enumerate(values.items()):
        doc["accessors"].append(_accessor(doc, binary, array))
        primitive["attributes"][attribute_name(semantic)] = number
    doc["accessors"][0] |= _range(local.means)
    _set_flags(primitive, splats)
    doc["buffers"][0]["byteLength"] = len(binary)
    return gltf.Glb(doc, bytes(binary), (), b"")


def _translation(offset: positions.Offset) -> dict[str, list[float]]:
    """Of the node of a new file: JSON holds what the float32 positions of an accessor cannot."""
    return (
        {"translation": (portable.matmul(np.array(offset, np.float64), HALF_TURN.T) + 0.0).tolist()}
        if any(offset)
        else {}
    )


def _edited(splats: Splats, same: Unchanged, old: GlbFile, path: Path) -> gltf.Glb:
    """The source with the rows of `splats`. Raises ValueError: no row of a primitive is left."""
    # On a copy, as the file that was opened may be saved again under another name.
    doc, binary = copy.deepcopy(old.glb.doc), bytearray(old.glb.binary)
    work = _Work(doc, binary, _shared(doc), old.glb, path)
    rows = drawable_rows(splats, row_by_row=True)
    primitive_of_rows = _primitive_of_rows(same.source_rows, old.primitives)
    for number, one in enumerate(old.primitives):
        in_primitive = primitive_of_rows == number
        if not in_primitive.any():
            raise ValueError(
                f"{path}: glTF cannot hold a primitive of 0 rows (none of primitive {one.index} of mesh {one.mesh} "
                "is left); write .ply instead"
            )
        part = rows.take(in_primitive)
        _edit_primitive(work, one, part, _part_of(same, in_primitive, one), bool(old.log_scales))
        _set_flags(doc["meshes"][one.mesh]["primitives"][one.index], splats)
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


def _primitive_of_rows(rows: np.ndarray, primitives: tuple[GaussianPrimitive, ...]) -> np.ndarray:
    """[N] which of the primitives each row goes to. rows: [N] row of the source, -1 for none.

    Each to the one it came from, and new rows to the one before them, as far as the order of all rows allows: in the
    file rows are ordered by primitive, so a row behind rows of a later primitive goes there, too."""
    # Rows of one primitive stand together, so that the number of a row tells its primitive.
    starts = np.array([one.first for one in primitives])
    cause = np.where(rows >= 0, np.searchsorted(starts, rows, "right") - 1, 0)
    return np.maximum.accumulate(cause) if len(cause) else cause


def _part_of(same: Unchanged, mask: np.ndarray, one: GaussianPrimitive) -> Unchanged:
    """What is kept of the rows of one primitive, counted from its first."""
    rows = same.source_rows[mask] - one.first
    inside = (same.source_rows[mask] >= 0) & (rows >= 0) & (rows < one.rows)
    masks = {name: getattr(same, name)[mask] & inside for name in (*ATTRIBUTES[:-1], "base", "rest")}
    return replace(same, source_rows=np.where(inside, rows, -1), **masks)


def _edit_primitive(
    work: _Work, one: GaussianPrimitive, rows: Splats, same: Unchanged, log_scales: bool = False
) -> None:
    """The primitive with `rows` (PLY's axes) as its rows. log_scales: the file holds logarithms as SCALE."""
    # In the primitive's own axes and place, where unchanged values have the file's own bits.
    before = read_local(work.source, one, work.path, [])
    local = _unit(axes.move(rows, one.turn, one.scale, one.shift))
    local = replace(local, scales=activations.log(local.scales) if log_scales else np.maximum(local.scales, 0))
    bands = before.sh.shape[1]
    opened = rows.source.splats.sh.shape[1] if rows.source else 0
    if local.sh.shape[1] != opened or local.sh[:, bands:].any():  # else the zeros behind are for other primitives
        bands = local.sh.shape[1]
    stored_bands = before.sh.shape[1]
    local, before = (replace(s, sh=with_bands(s.sh, bands)) for s in (local, before))
    restored = _restore(local, before, same)
    restored.sh[:, stored_bands:] = local.sh[:, stored_bands:]  # not in the file yet, the sign of zero included
    local = restored
    primitive = work.doc["meshes"][one.mesh]["primitives"][one.index]
    attributes = primitive.setdefault("attributes", {})
    if gltf_spz.is_packed(primitive):  # the accessors that stand for the stream's values go with it
        for name in gltf_spz.drop(work.doc, primitive):
            attributes.pop(name)
    # Where no row was added or lost, arrays are overwritten where they lie.
    in_place = len(local) == len(before) and bool((same.source_rows == np.arange(len(local))).all())
    masks = {"POSITION": same.means, "ROTATION": same.quats, "SCALE": same.scales, "OPACITY": same.opacities}
    columns = attribute_columns(local)
    for semantic, array in columns.items():
        keep = masks.get(semantic, same.base if semantic == "SH_DEGREE_0_COEF_0" else same.rest)
        _put(work, attributes, one.names.get(semantic, attribute_name(semantic)), array, ~keep, in_place)
    for semantic in set(one.names) & set(sh_semantics(4)) - set(columns):
        attributes.pop(one.names[semantic])
    # Attributes of others follow their rows; the fallback colour follows the Gaussian's.
    ours = {one.names.get(semantic, attribute_name(semantic)) for semantic in columns}
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
        moved[same.source_rows >= 0] = values[same.source_rows[same.source_rows >= 0]]
        changed = np.zeros(len(local), bool)
        if name == "COLOR_0" and values.shape[1] in (3, 4):
            changed = ~(same.base & same.opacities)
            moved[changed] = _fallback_like(values, before, local)[changed]
        _put(work, attributes, name, moved, changed, in_place)
    if not in_place:
        for key in ("indices", "targets"):  # they count rows that are no longer there
            primitive.pop(key, None)


def attribute_columns(local: Splats) -> dict[str, np.ndarray]:
    """Semantic -> [N, width] float32, in the order that files are written."""
    out = {
        "POSITION": local.means,
        "ROTATION": local.quats[:, [1, 2, 3, 0]],
        "SCALE": local.scales,
        "OPACITY": local.opacities[:, None],
    }
    out |= {semantic: local.sh[:, k] for k, semantic in enumerate(sh_semantics(local.sh_degree))}
    return out


def attribute_name(semantic: str) -> str:
    return semantic if semantic in ("POSITION", "COLOR_0") else f"{EXTENSION}:{semantic}"


def _unit(local: Splats) -> Splats:
    """Quaternions of norm 1, which the standard asks for; those that have it to float32 rounding keep their bits."""
    norms = row_norm(local.quats.astype(np.float64))[:, None]
    quats = np.where(np.abs(norms - 1) < 1e-6, local.quats, local.quats / norms)
    return replace(local, quats=quats.astype(np.float32))


def _restore(local: Splats, before: Splats, same: Unchanged) -> Splats:
    """`local` with the file's own bits in every value that did not change."""
    out = {name: getattr(local, name).copy() for name in ("means", "quats", "scales", "opacities", "sh")}
    for name in ("means", "quats", "scales", "opacities"):
        mask = getattr(same, name)
        out[name][mask] = getattr(before, name)[same.source_rows[mask]]
    out["sh"][same.base, 0] = before.sh[same.source_rows[same.base], 0]
    if same.rest.any():  # else the degrees may differ
        out["sh"][same.rest, 1:] = before.sh[same.source_rows[same.rest], 1:]
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
        dense = "sparse" not in doc["accessors"][index]  # else the target is a copy
        if index not in shared and dense and target.dtype == array.dtype and target.shape == array.shape:
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


def _set_flags(primitive: dict[str, Any], splats: Splats) -> None:
    """Colour space and antialiasing into the extension object, which is made where it is missing; an antialiasing that
    was not changed stays what the primitive says."""
    extensions = primitive.setdefault("extensions", {})
    extension = extensions.get(EXTENSION)
    if not isinstance(extension, dict):
        extension = extensions[EXTENSION] = {}
    extension.setdefault("kernel", "ellipse")
    linear = extension.get("colorSpace") == COLOR_SPACES["linear"]  # anything else is read as sRGB, and may stay
    if linear != (splats.color_space == "linear") or "colorSpace" not in extension:
        extension["colorSpace"] = COLOR_SPACES[splats.color_space]
    extras = extension.get("extras")
    stated = isinstance(extras, dict) and extras.get("antialiased") is True
    source = splats.source if splats.source is not None and splats.source.format == "glb" else None
    changed = source is None or source.splats.antialiased != splats.antialiased
    if changed and stated != splats.antialiased:
        extension["extras"] = {**(extras if isinstance(extras, dict) else {}), "antialiased": splats.antialiased}


def _fallback(local: Splats, linear: bool) -> Bytes:
    """[N, 4] uint8 COLOR_0. linear: decode sRGB first, since glTF vertex colours are linear."""
    color = np.clip(0.5 + SH_C0 * np.nan_to_num(local.sh[:, 0].astype(np.float64)), 0, 1)
    if linear:
        color = srgb_to_linear(color)
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
