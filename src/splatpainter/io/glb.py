"""glTF 2.0 binary (.glb) with KHR_gaussian_splatting: primitives of POINTS.

    POSITION                                      VEC3   float, or quantised
    KHR_gaussian_splatting:ROTATION               VEC4   x, y, z, w, unit
    KHR_gaussian_splatting:SCALE                  VEC3   linear
    KHR_gaussian_splatting:OPACITY                SCALAR 0..1
    KHR_gaussian_splatting:SH_DEGREE_l_COEF_n     VEC3   n = l + m, as INRIA; degree 0-3
    COLOR_0                                       VEC4   base colour and opacity, for renderers without the extension

Extension object: kernel "ellipse", colorSpace "srgb_rec709_display" or "lin_rec709_display"; the standard has no word
for antialiased training, so `extras.antialiased` there is ours.

Frame: glTF is y up. Rows in memory are in the PLY frame, half a turn about z away (x and y reversed), which is how
splat-transform writes it; so PLY -> GLB -> PLY gives back the frame. The transform of the node that shows the mesh is
applied when it is a rotation, uniform scale and translation. Reading is lenient: attribute names without the prefix, or
with `_`, and COLOR_0 in place of OPACITY and SH degree 0 are accepted; log-scales are not guessed. One primitive is
opened, the first.

Writing over a source of this format keeps every byte of values that did not change, all other JSON, meshes, nodes and
chunks (see glb_write). An untouched asset is written back byte for byte.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import files, frames, gltf, raw
from splatpainter.io.bounded import allow_rows
from splatpainter.jsonio import brief
from splatpainter.splats import ATTRIBUTES, SH_C0, Source, Splats

EXTENSION = "KHR_gaussian_splatting"
SPACES = {"srgb": "srgb_rec709_display", "linear": "lin_rec709_display"}
SHARED_RATIO = 16
"""Bytes of rows in memory per byte of the file: accessors may share bytes, as of SH bands that are empty."""
MAX_PRIMITIVES = 512
"""Gaussian primitives of a file: honest ones have a handful, and each may stand at the end of a deep tree of nodes."""
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True)
class GaussianPrimitive:
    """One primitive whose rows are open: where it is in the file, and where its rows are among all."""

    mesh: int
    index: int
    """Of the mesh's primitives."""
    names: dict[str, str]
    """ROTATION, SCALE, ... -> the attribute name the file uses."""
    turn: np.ndarray
    """[3, 3] rotation from the PLY frame to the primitive's own; `scale` and `shift` [3] go with it (frames.move)."""
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
    """In file order, which is the order of their rows."""
    whole: bytes
    """The file."""


def read_glb(path: Path) -> Splats:
    """Read all Gaussian primitives, in the order of meshes and of primitives in them, each where its node puts it.

    Raises ValueError: no such primitive, compressed or external data, damaged or truncated file.
    """
    data = files.read_all(path)
    glb = gltf.parse(data, path)
    problems: list[str] = []
    placements: dict[int, tuple[np.ndarray, float, np.ndarray]] = {}
    primitives, pieces, first = [], [], 0
    found = _find(glb.doc, path, problems)
    every = [_names(glb.doc["meshes"][mesh]["primitives"][index].get("attributes", {})) for mesh, index in found]
    bands = max(sum(name.startswith("SH_") for name in names) for names in every)
    parents = gltf.parents_of(glb.doc)
    for (mesh, index), names in zip(found, every, strict=True):
        if mesh not in placements:
            placements[mesh] = _placement(glb.doc, mesh, parents, path, problems)
        one = GaussianPrimitive(mesh, index, names, *placements[mesh], first)
        with np.errstate(all="ignore"):  # extreme values are reported below
            local = read_local(glb, one, path, problems, Bound(len(data), bands))
        if not pieces or local.color_space == pieces[0].color_space:
            pieces.append(frames.move_back(local, one.turn, one.scale, one.shift))
            primitives.append(replace(one, rows=len(local)))
            first += len(local)
        else:  # rows of one asset have one colour space, and turning one into the other is not exact
            problems.append(f"primitive {index} of mesh {mesh} has another colour space; it is not opened, but kept")
    rows = _joined(pieces)
    problems = list(dict.fromkeys(problems)) + raw.oddities(rows)
    file = GlbFile(glb, tuple(primitives), data)
    source = Source(str(path), "glb", rows, files.sha256(data), file, tuple(problems), "luf")
    return replace(rows, source=source, origin=np.arange(len(rows)))


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


def write_glb(path: Path, splats: Splats) -> None:
    """Write one Gaussian primitive. Raises ValueError: no rows, SH above degree 3 in a new file."""
    from splatpainter.io import glb_write
    from splatpainter.io.reuse import kept

    splats = splats.numpy()
    if not len(splats):
        raise ValueError(f"{path}: glTF cannot hold an asset of 0 rows; write .ply instead")
    same = kept(splats, "glb")
    old: GlbFile | None = splats.source.detail if same and splats.source else None
    names = [name for one in old.primitives for name in one.names] if old else []
    if splats.sh_degree > 3 and f"SH_DEGREE_{splats.sh_degree}_COEF_0" not in names:
        raise ValueError(f"{path}: glTF holds SH up to degree 3, got {splats.sh_degree}; write .ply or .spz instead")
    if old and same and same.identity:
        out = old.whole
    elif old and same:
        out = gltf.serialise(glb_write.edited(splats, same, old, path))
    else:
        out = gltf.serialise(glb_write.fresh(splats))
    with files.writing(path) as target:
        target.write(out)


def sh_semantics(degree: int) -> list[str]:
    """SH_DEGREE_l_COEF_n in the order of `Splats.sh`."""
    return [f"SH_DEGREE_{l}_COEF_{n}" for l in range(degree + 1) for n in range(2 * l + 1)]


@dataclass(frozen=True)
class Bound:
    """What all rows together are counted against."""

    size: int
    """Bytes of the file."""
    bands: int
    """SH coefficients a row at most."""


def read_local(
    glb: gltf.Glb, one: GaussianPrimitive, path: Path, problems: list[str], bound: Bound | None = None
) -> Splats:
    """The rows in the primitive's own frame, bit for bit what the file says (integers as float32). bound: of rows that
    were not read before."""
    primitive = glb.doc["meshes"][one.mesh]["primitives"][one.index]
    attributes = primitive.get("attributes", {})
    count: int | None = None

    def read(semantic: str, width: int) -> np.ndarray:
        nonlocal count
        if semantic not in one.names:
            raise ValueError(f"{path}: the Gaussian primitive has no attribute {EXTENSION}:{semantic}")
        index = attributes[one.names[semantic]]
        values = gltf.accessor(glb, glb.binary, index, path)
        if count is None:
            count = len(values)
        if values.shape != (count, width) and not (semantic == "COLOR_0" and values.shape == (count, 3)):
            raise ValueError(f"{path}: expected {semantic} of {count} x {width} numbers, found {values.shape}")
        if bound is not None:  # all primitives together, and as many SH bands for each as any has
            allow_rows(bound.size, one.first + len(values), bound.bands, path, SHARED_RATIO)
        return gltf.decode(values, glb.doc["accessors"][index].get("normalized"))

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
    extension = _extension(primitive)
    return Splats(
        means,
        np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]]),
        scales,
        opacities,
        sh,
        antialiased=isinstance(extension.get("extras"), dict) and extension["extras"].get("antialiased") is True,
        color_space="linear" if extension.get("colorSpace") == SPACES["linear"] else "srgb",
    )


def _extension(primitive: dict[str, Any]) -> dict[str, Any]:
    found = primitive.get("extensions", {}).get(EXTENSION)
    return found if isinstance(found, dict) else {}


def _names(attributes: dict[str, Any]) -> dict[str, str]:
    found = {}
    for semantic in ("POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY", *sh_semantics(4)):
        for name in (f"{EXTENSION}:{semantic}", f"_{semantic}", semantic):
            if name in attributes:
                found[semantic] = name
                break
    return found


def _find(doc: dict[str, Any], path: Path, problems: list[str]) -> list[tuple[int, int]]:
    """(mesh, primitive) of the Gaussian primitives to open, in file order.

    Where nodes show some of them, the others are no part of any picture: they are kept and reported."""
    found = []
    for mesh, item in enumerate(doc.get("meshes", [])):
        for index, primitive in enumerate(item.get("primitives", [])):
            names = primitive.get("attributes", {})
            if EXTENSION in primitive.get("extensions", {}) or any(name.startswith(f"{EXTENSION}:") for name in names):
                found.append((mesh, index))
    if not found:
        raise ValueError(f"{path}: expected a primitive with {EXTENSION}; this glTF file holds no Gaussians")
    visible = {node.get("mesh") for node in doc.get("nodes", []) if type(node.get("mesh")) is int}
    opened = [one for one in found if one[0] in visible] or found
    if len(opened) < len(found):
        hidden = len(found) - len(opened)
        problems.append(f"{hidden} Gaussian primitives that no node shows; they are not opened, but kept")
    if len(opened) > MAX_PRIMITIVES:
        raise ValueError(f"{path}: expected at most {MAX_PRIMITIVES} Gaussian primitives, found {len(opened)}")
    for mesh, index in opened:
        _check_primitive(doc["meshes"][mesh]["primitives"][index], path, problems)
    return opened


def _check_primitive(primitive: dict[str, Any], path: Path, problems: list[str]) -> None:
    extension = _extension(primitive)
    packed = extension.get("extensions")
    if isinstance(packed, dict) and packed:
        names = files.printable(", ".join(packed))
        raise ValueError(
            f"{path}: the Gaussians are stored by {names}, which is not supported; decompress the file first"
        )
    if primitive.get("mode", 4) != 0:
        problems.append(f"primitive mode {brief(primitive.get('mode', 4))} in place of 0 (points)")
    if "indices" in primitive:
        problems.append("the primitive's indices are not used; every row is shown")
    for key, value in (("kernel", "ellipse"), ("projection", "perspective"), ("sortingMethod", "cameraDistance")):
        if extension.get(key, value) != value:
            problems.append(f"{key} {brief(extension[key])} is shown as {value!r}")
    if extension.get("colorSpace", SPACES["srgb"]) not in SPACES.values():
        problems.append(f"colour space {brief(extension['colorSpace'])} is treated as sRGB")


def _placement(
    doc: dict[str, Any], mesh: int, parents: gltf.Parents, path: Path, problems: list[str]
) -> tuple[np.ndarray, float, np.ndarray]:
    """Rotation, scale and shift from the PLY frame to the mesh's own, by the node that shows it."""
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
        determinant = float(np.linalg.det(matrix[:3, :3])) if np.isfinite(matrix).all() else 0.0
        scale = float(np.cbrt(determinant))
        turn = matrix[:3, :3] / scale if scale > 0 else np.zeros((3, 3))
    if not 1e-12 < scale < 1e12 or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3):
        problems.append("the node's transform is not a rotation with uniform scale; it is kept but not applied")
        return nothing
    if np.array_equal(matrix, np.eye(4)):
        return nothing
    left, _, right = np.linalg.svd(turn)
    turn = (left @ right).T
    return turn @ HALF_TURN, 1 / scale, -turn @ matrix[:3, 3] / scale
