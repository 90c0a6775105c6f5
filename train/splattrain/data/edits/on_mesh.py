"""Paint on a mesh, for path traced truth: what a view shows of an edit becomes the base colour of the surface.

Textures of found meshes overlap and repeat, so paint cannot go into them. Instead the triangles that the paint reaches
are cut until their edges are about a pixel of the painting view, and those pieces carry base colours at their vertices
(the texture's colour there, under the paint). All other triangles keep material and texture. The paint takes the light
and the roughness of what it lies on, and hides metal; a single sheet shows it on both sides. Knows no light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import torch

from splatpainter.cameras import Camera
from splatpainter.color import linear_to_srgb, srgb_to_linear
from splattrain.data.edits import EditDesign
from splattrain.data.edits.on_surfels import FULL_PAINT_COSINE, MIN_COVERAGE, MIN_PAINT_COSINE, project_layer
from splattrain.data.materials import SRGB_BYTES, Material, sample_texture
from splattrain.data.mesh_visibility import MIN_DEPTH, projected, visible_points
from splattrain.data.meshes import Mesh, joined, submesh

MAX_EDGE_PX = 1.0
"""Longest edge of a painted piece, pixels of the painting view."""
MAX_PIECES = 8_000_000
"""Triangles that a mesh is cut into at most."""
MAX_STRADDLING_EDGE = 0.05
"""World units: longest edge of a triangle that reaches behind the camera before its front part is painted."""

PointPaint: TypeAlias = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(points [M, 3] world, their display base colours [M, 3]) -> (display colours [M, 3], coverage [M] 0..1). Called
once, with all points that may get paint."""


def paint_mesh(mesh: Mesh, design: EditDesign) -> Mesh:
    """The mesh with an edit on what its camera sees of it; layers are mixed in display values as painting programs do.
    Raises ValueError as `repaint_mesh`, and for a layer of another size than the camera's."""
    camera, content = design.camera, design.content
    if isinstance(content, np.ndarray) and content.shape != (camera.height, camera.width, 4):
        raise ValueError(
            f"{mesh.name}: expected a layer [{camera.height}, {camera.width}, 4] for this camera, "
            f"got {list(content.shape)}"
        )

    def paint(points: np.ndarray, base_colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        positions = torch.from_numpy(np.asarray(points, np.float32))
        if isinstance(content, np.ndarray):
            layer = torch.from_numpy(np.ascontiguousarray(content, np.float32))
            colors, coverage = project_layer(layer, camera, positions)
            return colors.numpy(), coverage.numpy()
        painted = content.paint(positions, torch.from_numpy(np.asarray(base_colors, np.float32)))
        return painted.colors.numpy(), painted.coverage.numpy()

    return repaint_mesh(mesh, camera, design.region, paint, hides_metal=isinstance(content, np.ndarray))


def repaint_mesh(
    mesh: Mesh,
    camera: Camera,
    region: np.ndarray,
    paint: PointPaint,
    hides_metal: bool = False,
) -> Mesh:
    """The mesh after `paint`, on surfaces that the camera sees within a pixel of `region` [H, W] bool; less at
    grazing angles, none from MIN_PAINT_COSINE on. The same mesh, when nothing is covered. hides_metal: pieces that are
    covered by half or more are no metal any more. Raises ValueError when it would take more than MAX_PIECES
    triangles."""
    plain = _toned(mesh)
    pieces = _cut(plain, camera, region)
    reached = np.flatnonzero(pieces.reached)
    if not len(reached):
        return mesh
    used = np.unique(pieces.mesh.faces[reached])
    visibility = np.zeros(len(pieces.mesh.vertices))
    visibility[used] = _view_visibility(plain, pieces.mesh.vertices[used], pieces.mesh.normals[used], camera)
    groups = [
        _bare(pieces.mesh, reached[pieces.mesh.material_ids[reached] == k], k)
        for k in np.unique(pieces.mesh.material_ids[reached])
    ]
    points = np.concatenate([pieces.mesh.vertices[group.used] for group in groups])
    colors, coverage = paint(points, linear_to_srgb(np.concatenate([group.base_colors for group in groups])))
    parts, covered, start = [], np.zeros(len(pieces.mesh.faces), bool), 0
    for group in groups:
        here = slice(start, start := start + len(group.used))
        share = coverage[here] * visibility[group.used]
        share = np.where(share >= MIN_COVERAGE, share, 0)
        mean = share[group.local].mean(1)
        covered[group.faces[mean > 0]] = True
        dull = hides_metal & (mean >= 0.5)
        kinds = [((mean > 0) & ~dull, group.material), (dull, replace(group.material, metallic=0.0))]
        parts += [_coated(pieces.mesh, group, colors[here], share, faces, kind) for faces, kind in kinds if faces.any()]
    if not covered.any():
        return mesh
    cut = np.zeros(len(plain.faces), bool)
    cut[pieces.parents[covered]] = True  # the others stay whole
    rest = cut[pieces.parents] & ~covered
    uncut = submesh(plain, ~cut)
    return joined(mesh.name, [part for part in (uncut, submesh(pieces.mesh, rest), *parts) if len(part.faces)])


@dataclass(frozen=True)
class _Pieces:
    """A mesh that was cut, with the same surface."""

    mesh: Mesh
    parents: np.ndarray
    """[F] the triangle that each piece is of."""
    reached: np.ndarray
    """[F] bool: in the region, and small."""


def _cut(mesh: Mesh, camera: Camera, region: np.ndarray) -> _Pieces:
    """Triangles over the region, halved across their longest edge in the picture until all edges are short enough."""
    columns = {name: getattr(mesh, name).astype(np.float64) for name in ("vertices", "normals", "uvs")}
    columns["colors"] = np.ones((len(mesh.vertices), 3)) if mesh.colors is None else mesh.colors.astype(np.float64)
    pixels, sums = projected(mesh.vertices, camera), _sums(region)
    faces, parents = mesh.faces, np.arange(len(mesh.faces))
    done: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    count = 0
    while len(faces):
        reached = _reaches(pixels[faces], sums)
        lengths, limits = _lengths(pixels[faces], columns["vertices"][faces])
        split = reached & (lengths.max(1) > limits)
        ended = ~split
        straddles = (pixels[faces][..., 2] <= MIN_DEPTH).any(1)
        done.append((faces[ended], parents[ended], (reached & ~straddles)[ended]))
        count += int(ended.sum())
        if count + 2 * int(split.sum()) > MAX_PIECES:
            raise ValueError(f"{mesh.name}: paint would need more than {MAX_PIECES:,} triangles; paint less at once")
        faces, first, second = _halved(faces[split], lengths[split].argmax(1), len(pixels))
        for name, values in columns.items():
            middle = (values[first] + values[second]) / 2
            if name == "normals":
                middle = _unit(middle, values[first])
            columns[name] = np.concatenate([values, middle])
        pixels = np.concatenate([pixels, projected(columns["vertices"][len(pixels) :], camera)])
        parents = np.tile(parents[split], 2)
    faces, parents, reached = (np.concatenate([part[k] for part in done]) for k in range(3))
    fields = {name: values.astype(np.float32) for name, values in columns.items()}
    return _Pieces(replace(mesh, faces=faces, material_ids=mesh.material_ids[parents], **fields), parents, reached)


def _halved(faces: np.ndarray, longest: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(faces [2 F, 3], first [K], second [K]): each face cut from the middle of its edge `longest` (k: corner k to
    k + 1) to the corner across; the middles are vertices from `count` on, between `first` and `second`."""
    every = np.arange(len(faces))
    a, b, c = (faces[every, (longest + k) % 3] for k in range(3))
    span = np.int64(count + 1)
    codes, middle = np.unique(np.minimum(a, b) * span + np.maximum(a, b), return_inverse=True)
    m = middle.reshape(-1) + count
    return np.concatenate([np.stack([a, m, c], 1), np.stack([m, b, c], 1)]), codes // span, codes % span


def _sums(region: np.ndarray) -> np.ndarray:
    """[H + 1, W + 1] how many pixels of the region lie above and left."""
    return np.pad(region.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))


def _reaches(corners: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """[F] bool: the box around the projected triangle [F, 3, 3], and a pixel more, holds some of the region; where the
    triangle reaches behind the camera, its box is the picture."""
    size = np.array([sums.shape[1] - 1, sums.shape[0] - 1])
    low = np.floor(corners[..., :2].min(1) - 1).clip(0, size).astype(np.int64)
    high = np.ceil(corners[..., :2].max(1) + 1).clip(0, size).astype(np.int64)
    behind = corners[..., 2] <= MIN_DEPTH
    low[behind.any(1)], high[behind.any(1)] = 0, size
    (left, top), (right, bottom) = low.T, high.T
    inside = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return (inside > 0) & ~behind.all(1)


def _lengths(pixels: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(lengths [F, 3] of the edges corner k to k + 1, limits [F]): pixels, or world units where a triangle reaches
    behind the camera."""
    behind = np.any(pixels[..., 2] <= MIN_DEPTH, axis=1)
    flat = np.linalg.norm(np.roll(pixels[..., :2], -1, 1) - pixels[..., :2], axis=2)
    world = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=2)
    return np.where(behind[:, None], world, flat), np.where(behind, MAX_STRADDLING_EDGE, MAX_EDGE_PX)


def _view_visibility(mesh: Mesh, points: np.ndarray, normals: np.ndarray, camera: Camera) -> np.ndarray:
    """[M] 0..1: how openly the camera sees each point. Which way a normal points does not matter: what looks away on a
    closed object is hidden by its front."""
    towards = camera.position - points
    cosine = np.abs((normals * towards).sum(1)) / np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
    t = np.clip((cosine - MIN_PAINT_COSINE) / (FULL_PAINT_COSINE - MIN_PAINT_COSINE), 0, 1)
    return visible_points(mesh, camera, points) * (t * t * (3 - 2 * t))


@dataclass(frozen=True)
class _Bare:
    """Faces of one material before paint."""

    faces: np.ndarray
    """[F] of the pieces."""
    used: np.ndarray
    """[M] vertices that they use."""
    local: np.ndarray
    """[F, 3] into `used`."""
    base_colors: np.ndarray
    """[M, 3] linear, 0..1."""
    material: Material


def _bare(mesh: Mesh, faces: np.ndarray, k: int) -> _Bare:
    used, local = np.unique(mesh.faces[faces], return_inverse=True)
    material = mesh.materials[k]
    return _Bare(faces, used, local.reshape(-1, 3), base_colors(mesh, used, material).clip(0, 1), material)


def _coated(
    mesh: Mesh, bare: _Bare, colors: np.ndarray, coverage: np.ndarray, faces: np.ndarray, material: Material
) -> Mesh:
    """Those faces [F] bool with the paint (colors [M, 3] display, coverage [M]) in their base colours."""
    display = linear_to_srgb(bare.base_colors)
    mixed = srgb_to_linear((display + coverage[:, None] * (colors - display)).clip(0, 1)).astype(np.float32)
    part = replace(
        mesh,
        vertices=mesh.vertices[bare.used],
        normals=mesh.normals[bare.used],
        uvs=mesh.uvs[bare.used],
        faces=bare.local,
        material_ids=np.zeros(len(bare.faces), np.int64),
        materials=(replace(material, base_color=None, base_factor=(1.0, 1.0, 1.0)),),
        colors=mixed,
    )
    return submesh(part, faces)


def base_colors(mesh: Mesh, vertices: np.ndarray, material: Material) -> np.ndarray:
    """[M, 3] linear base colours at `vertices` [M] int where they are of `material`."""
    tone = np.broadcast_to(np.asarray(material.base_factor, np.float32), (len(vertices), 3))
    if material.base_color is not None:
        tone = tone * sample_texture(material.base_color, mesh.uvs[vertices], SRGB_BYTES)
    return tone if mesh.colors is None else tone * mesh.colors[vertices]


def _toned(mesh: Mesh) -> Mesh:
    """The mesh as the path tracer sees it: vertex colours under a texture are their material's mean, here part of its
    factor, so that cutting does not change them."""
    if mesh.colors is None or all(material.base_color is None for material in mesh.materials):
        return mesh
    colors, materials = mesh.colors.copy(), list(mesh.materials)
    for k, material in enumerate(mesh.materials):
        used = np.unique(mesh.faces[mesh.material_ids == k])
        if material.base_color is not None and len(used):
            red, green, blue = (np.asarray(material.base_factor) * mesh.colors[used].mean(0)).tolist()
            materials[k] = replace(material, base_factor=(red, green, blue))
            colors[used] = 1
    return replace(mesh, colors=colors, materials=tuple(materials))


def _unit(vectors: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-6, vectors / np.maximum(length, 1e-12), otherwise)
