"""glTF 2.0 binary (.glb) with KHR_gaussian_splatting (release candidate of July 2026): one POINTS primitive.

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
from splatpainter.io.json_text import brief
from splatpainter.splats import SH_C0, Source, Splats

EXTENSION = "KHR_gaussian_splatting"
SPACES = {"srgb": "srgb_rec709_display", "linear": "lin_rec709_display"}
SHARED_RATIO = 16
"""Bytes of rows in memory per byte of the file: accessors may share bytes, as of SH bands that are empty."""
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True)
class GlbFile:
    """What a file held, enough to keep it."""

    glb: gltf.Glb
    mesh: int
    primitive: int
    names: dict[str, str]
    """ROTATION, SCALE, ... -> the attribute name the file uses."""
    turn: np.ndarray
    """[3, 3] rotation from the PLY frame to the primitive's own; `scale` and `shift` [3] go with it (frames.move)."""
    scale: float
    shift: np.ndarray
    whole: bytes
    """The file."""


def read_glb(path: Path) -> Splats:
    """Read the first Gaussian primitive.

    Raises ValueError: no such primitive, compressed or external data, damaged or truncated file.
    """
    data = files.read_all(path)
    glb = gltf.parse(data, path)
    problems: list[str] = []
    mesh, number, primitive = _find(glb.doc, path, problems)
    attributes = primitive.get("attributes", {})
    names = {}
    for semantic in ("POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY", *sh_semantics(4)):
        for name in (f"{EXTENSION}:{semantic}", f"_{semantic}", semantic):
            if name in attributes:
                names[semantic] = name
                break
    turn, scale, shift = _placement(glb.doc, mesh, path, problems)
    file = GlbFile(glb, mesh, number, names, turn, scale, shift, data)
    with np.errstate(all="ignore"):  # extreme values are reported below
        local = read_local(file, path, problems)
    rows = frames.move_back(local, turn, scale, shift)
    problems += raw.oddities(rows)
    source = Source(str(path), "glb", rows, files.sha256(data), file, tuple(problems), "luf")
    return replace(rows, source=source, origin=np.arange(len(rows)))


def write_glb(path: Path, splats: Splats) -> None:
    """Write one Gaussian primitive. Raises ValueError: no rows, SH above degree 3 in a new file."""
    from splatpainter.io import glb_write
    from splatpainter.io.reuse import kept

    splats = splats.numpy()
    if not len(splats):
        raise ValueError(f"{path}: glTF cannot hold an asset of 0 rows; write .ply instead")
    same = kept(splats, "glb")
    old: GlbFile | None = splats.source.detail if same and splats.source else None
    if splats.sh_degree > 3 and not (old and f"SH_DEGREE_{splats.sh_degree}_COEF_0" in old.names):
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


def read_local(file: GlbFile, path: Path, problems: list[str]) -> Splats:
    """The rows in the primitive's own frame, bit for bit what the file says (integers as float32)."""
    attributes = file.glb.doc["meshes"][file.mesh]["primitives"][file.primitive].get("attributes", {})
    count: int | None = None

    def read(semantic: str, width: int) -> np.ndarray:
        nonlocal count
        if semantic not in file.names:
            raise ValueError(f"{path}: the Gaussian primitive has no attribute {EXTENSION}:{semantic}")
        index = attributes[file.names[semantic]]
        values = gltf.accessor(file.glb, file.glb.binary, index, path)
        if count is None:
            count = len(values)
        if values.shape != (count, width) and not (semantic == "COLOR_0" and values.shape == (count, 3)):
            raise ValueError(f"{path}: expected {semantic} of {count} x {width} numbers, found {values.shape}")
        bands = sum(name.startswith("SH_") for name in file.names)
        allow_rows(len(file.whole), len(values), bands, path, SHARED_RATIO)
        return gltf.decode(values, file.glb.doc["accessors"][index].get("normalized"))

    means, xyzw, scales = read("POSITION", 3), read("ROTATION", 4), read("SCALE", 3)
    if "OPACITY" in file.names:
        opacities = read("OPACITY", 1)[:, 0]
    else:
        color = read("COLOR_0", 4)
        opacities = color[:, 3].copy() if color.shape[1] == 4 else np.ones(len(color), np.float32)
        problems.append("no opacities; taken from the alpha of COLOR_0")
    degree = max((l for l in range(5) if set(sh_semantics(l)) <= set(file.names)), default=-1)
    if degree < 0:
        sh = (read("COLOR_0", 4)[:, None, :3] - np.float32(0.5)) / np.float32(SH_C0)
        problems.append("no SH degree 0; colours taken from COLOR_0")
    else:
        sh = np.stack([read(semantic, 3) for semantic in sh_semantics(degree)], 1)
        if any(name.startswith("SH_") for name in set(file.names) - set(sh_semantics(degree))):
            problems.append(f"SH above degree {degree} is incomplete and not read")
    extension = extension_of(file)
    return Splats(
        means,
        np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]]),
        scales,
        opacities,
        sh,
        antialiased=isinstance(extension.get("extras"), dict) and extension["extras"].get("antialiased") is True,
        color_space="linear" if extension.get("colorSpace") == SPACES["linear"] else "srgb",
    )


def extension_of(file: GlbFile) -> dict[str, Any]:
    """The primitive's extension object; {} where it has none."""
    return _extension(file.glb.doc["meshes"][file.mesh]["primitives"][file.primitive])


def _extension(primitive: dict[str, Any]) -> dict[str, Any]:
    found = primitive.get("extensions", {}).get(EXTENSION)
    return found if isinstance(found, dict) else {}


def _find(doc: dict[str, Any], path: Path, problems: list[str]) -> tuple[int, int, dict[str, Any]]:
    """(mesh, primitive, its object) of the first Gaussian primitive."""
    found = []
    for mesh, item in enumerate(doc.get("meshes", [])):
        for number, primitive in enumerate(item.get("primitives", [])):
            names = primitive.get("attributes", {})
            if EXTENSION in primitive.get("extensions", {}) or any(name.startswith(f"{EXTENSION}:") for name in names):
                found.append((mesh, number, primitive))
    if not found:
        raise ValueError(f"{path}: expected a primitive with {EXTENSION}; this glTF file holds no Gaussians")
    if len(found) > 1:
        problems.append(f"{len(found)} Gaussian primitives; only the first is opened, the others stay as they are")
    extension = _extension(found[0][2])
    packed = extension.get("extensions")
    if isinstance(packed, dict) and packed:
        names = files.printable(", ".join(packed))
        raise ValueError(
            f"{path}: the Gaussians are stored by {names}, which is not supported; decompress the file first"
        )
    if found[0][2].get("mode", 4) != 0:
        problems.append(f"primitive mode {brief(found[0][2].get('mode', 4))} in place of 0 (points)")
    if "indices" in found[0][2]:
        problems.append("the primitive's indices are not used; every row is shown")
    if extension.get("kernel", "ellipse") != "ellipse":
        problems.append(f"kernel {brief(extension['kernel'])} is shown as 'ellipse'")
    if extension.get("colorSpace", SPACES["srgb"]) not in SPACES.values():
        problems.append(f"colour space {brief(extension['colorSpace'])} is treated as sRGB")
    return found[0]


def _placement(doc: dict[str, Any], mesh: int, path: Path, problems: list[str]) -> tuple[np.ndarray, float, np.ndarray]:
    """Rotation, scale and shift from the PLY frame to the mesh's own, by the node that shows it."""
    showing = [number for number, node in enumerate(doc.get("nodes", [])) if node.get("mesh") == mesh]
    nothing = HALF_TURN, 1.0, np.zeros(3)
    if len(showing) > 1:
        problems.append(f"{len(showing)} nodes show the Gaussians; the place of the first is used")
    if not showing:
        return nothing
    with np.errstate(all="ignore"):
        matrix = gltf.global_matrix(doc, showing[0], path)
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
