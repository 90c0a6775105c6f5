"""Surfels: a mesh as dense flat Gaussians with material and visibility, the on-the-fly ground truth of training.

Edits change albedo, lights change shading (data/lights.py), and the renderer of this package draws every view.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.lighting import unoccluded_transfer, visibility
from splatpainter.splats import Splats
from splattrain.data import poisson_disk
from splattrain.data.materials import SRGB_BYTES, sample_texture
from splattrain.data.meshes import Mesh

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Surfels:
    """N flat Gaussians, torch float32 on one device, world axes y up. All fields have length N: see `take`."""

    means: Any
    """[N, 3] centres, world units."""
    normals: Any
    """[N, 3] unit, outwards, normal map applied (shading normals)."""
    quats: Any
    """[N, 4] w, x, y, z; the third rotated axis is the surface's own normal."""
    scales: Any
    """[N, 3] standard deviations, world units; the third is thin."""
    opacities: Any
    """[N] 0..1."""
    albedo: Any
    """[N, 3] base colour, linear, 0..1."""
    metallic: Any
    """[N] 0..1."""
    roughness: Any
    """[N] 0..1 perceptual."""
    occlusion: Any
    """[N] 0..1: share of the cosine-weighted hemisphere that is open (1: nothing in the way)."""
    transfer: Any
    """[N, 9] irradiance per SH coefficient of the environment, shadows included (precomputed radiance transfer, Sloan
    et al. 2002): E = transfer . L."""

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def take(self, ids: Any) -> Surfels:
        """The given surfels: [M] int64 indices or [N] bool."""
        return replace(self, **{f.name: getattr(self, f.name)[ids] for f in fields(self)})

    def to(self, device: Any) -> Surfels:
        """The same surfels on another device."""
        return replace(self, **{f.name: getattr(self, f.name).to(device) for f in fields(self)})


CANDIDATES_PER_SURFEL = 2.0
"""Candidates per surfel before the even ones are selected."""
SIGMA_PER_SPACING = 0.62
"""In-plane standard deviation over the mean distance to the five nearest: closed surfaces, sharp texture."""
THICKNESS_RATIO = 0.12
"""Third standard deviation over the other two."""
OPACITY = 0.99
MIN_VISIBLE_SHARE = 0.01
"""Points that see a smaller share of both hemispheres lie inside the object and are left out."""
MAX_INVERTED_SHARE = 0.1
"""Points that see less than this above and more below have a normal that points into a closed object."""


def sample_surfels(mesh: Mesh, count: int, seed: int = 0, device: str = "cpu") -> Surfels:
    """`count` surfels evenly (blue noise) over all of the mesh that light can reach; normals that point inwards are
    turned. Deterministic in the seed, on every device.

    Raises ValueError when count is not positive or nothing of the mesh can be seen.
    """
    if count < 1:
        raise ValueError(f"{mesh.name}: expected at least one surfel, got {count}")
    rng = np.random.default_rng([seed, count])
    candidates = _candidates(mesh, count, rng)
    chosen = poisson_disk.select(candidates.points, candidates.normals, count, candidates.spacing, rng)
    part = candidates.take(chosen)
    gap = poisson_disk.spacing_around(part.points, part.normals, candidates.spacing)
    width = SIGMA_PER_SPACING * np.clip(gap, 0.5 * candidates.spacing, 1.5 * candidates.spacing)
    look = _materials(mesh, part.face, part.weights, part.normals, width)
    normals = _upright(look.pop("normals"), part.normals)
    transfer = unoccluded_transfer(normals) - part.blocked
    attributes = {
        "means": part.points,
        "normals": normals,
        "quats": facing(part.normals, rng.uniform(0, 2 * np.pi, count)),
        "scales": np.stack([width, width, THICKNESS_RATIO * width], 1),
        "opacities": np.full(count, OPACITY),
        "occlusion": part.openness,
        "transfer": transfer,
        **look,
    }
    return _as_surfels(attributes, device)


def to_splats(surfels: Surfels, sh: Tensor) -> Splats[Tensor]:
    """Splats (torch, same device) of surfels with colours sh [N, K, 3] (display sRGB, as lights.shade gives)."""
    return Splats(surfels.means, surfels.quats, surfels.scales, surfels.opacities, sh)


def coarse_asset(surfels: Surfels, count: int, seed: int = 0, roughness: float = 0.3) -> Surfels:
    """`count` larger, irregular Gaussians as a captured or generated asset has them.

    Each stands for a patch of surfels: materials and transfer are means over the patch, so that shading them agrees
    with the dense truth under any light; shape is the patch's own covariance. roughness, 0..1, of the asset: opacity
    down to 0.99 - 0.49 roughness, jitter of position, size and orientation, and 0.3 roughness of the Gaussians spent on
    faint layers above and below the surface. Raises ValueError when count exceeds the surfels or roughness its
    range.
    """
    from splattrain.data.degrade import coarsened

    if not 1 <= count <= len(surfels):
        raise ValueError(f"coarse_asset: expected 1 to {len(surfels)} Gaussians (the surfels there are), got {count}")
    if not 0 <= roughness <= 1:
        raise ValueError(f"coarse_asset: expected a roughness of 0..1, got {roughness}")
    arrays = {f.name: getattr(surfels, f.name).detach().cpu().numpy() for f in fields(surfels)}
    return _as_surfels(coarsened(arrays, count, seed, roughness), surfels.means.device)


def _as_surfels(attributes: dict[str, np.ndarray], device: Any) -> Surfels:
    import torch

    return Surfels(
        **{k: torch.from_numpy(np.ascontiguousarray(v, np.float32)).to(device) for k, v in attributes.items()}
    )


@dataclass(frozen=True)
class _Candidates:
    """M points on the surface that light can reach, and the spacing that the wanted number of surfels will have."""

    points: np.ndarray
    normals: np.ndarray
    face: np.ndarray
    weights: np.ndarray
    openness: np.ndarray
    blocked: np.ndarray
    spacing: float

    def take(self, ids: np.ndarray) -> _Candidates:
        visible = {f.name: getattr(self, f.name)[ids] for f in fields(self) if f.name != "spacing"}
        return _Candidates(**visible, spacing=self.spacing)


def _candidates(mesh: Mesh, count: int, rng: np.random.Generator) -> _Candidates:
    """Rather more than `count` points. A sparse first round tells how much of the mesh is hidden inside."""
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = float(np.linalg.norm(cross, axis=1).sum()) / 2
    number = min(max(count // 4, 4000), 16000)
    candidates, share = _round(mesh, number, _unit(cross), area, rng)
    for _ in range(3):
        if len(candidates.points) >= 1.4 * count:
            break
        number = int(1.1 * CANDIDATES_PER_SURFEL * count / max(share, 0.05)) + 64
        candidates, share = _round(mesh, number, _unit(cross), area, rng)
    if len(candidates.points) < count:
        raise ValueError(f"{mesh.name}: only a part too small for {count} surfels can be seen from outside")
    return replace(candidates, spacing=float(np.sqrt(area * share / count)))


def _round(
    mesh: Mesh, number: int, flats: np.ndarray, area: float, rng: np.random.Generator
) -> tuple[_Candidates, float]:
    """(those of `number` points that light can reach, their share). flats: [F, 3] unit normals of the faces."""
    face, weights = poisson_disk.scatter(mesh.vertices, mesh.faces, number, rng)
    solid = _covered(mesh, face, weights)
    if not solid.any():
        raise ValueError(f"{mesh.name}: its materials are transparent everywhere")
    face, weights = face[solid], weights[solid]
    corner = mesh.faces[face]
    points = np.einsum("nk,nkc->nc", weights, mesh.vertices[corner])
    flat = flats[face]
    normals = _unit(np.einsum("nk,nkc->nc", weights, mesh.normals[corner]))
    # Smooth normals that leave the triangle by more than a right angle are a fault of the file.
    normals = np.where(((normals * flat).sum(1) > 0.1)[:, None], normals, flat).astype(np.float32)
    sees = visibility(points, normals, float(np.sqrt(area / number)))
    turn = (sees.front < MAX_INVERTED_SHARE) & (sees.front < 0.3 * sees.back)
    openness = np.where(turn, sees.back, sees.front)
    blocked = np.where(turn[:, None], sees.blocked_back, sees.blocked_front)
    normals = np.where(turn[:, None], -normals, normals)
    visible = openness > MIN_VISIBLE_SHARE
    candidates = _Candidates(points, normals, face, weights, openness, blocked, 0.0).take(visible)
    return candidates, float(visible.sum()) / number


def _covered(mesh: Mesh, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[M] bool: not in a hole of a cut-out texture."""
    solid = np.ones(len(face), bool)
    ids = mesh.material_ids[face]
    for k, material in enumerate(mesh.materials):
        if material.alpha is not None and (used := ids == k).any():
            uvs = np.einsum("nk,nkc->nc", weights[used], mesh.uvs[mesh.faces[face[used]]])
            solid[used] = sample_texture(material.alpha[..., None], uvs)[:, 0] > 0.5
    return solid


TEXTURE_TAPS = np.array([[0.0, 0.0], [0.6, 0.3], [-0.3, 0.6], [-0.6, -0.3], [0.3, -0.6]], np.float32)
"""[T, 2] where a surfel looks at its texture, in its standard deviations: fine texture is averaged, not picked."""


def _materials(
    mesh: Mesh, face: np.ndarray, weights: np.ndarray, normals: np.ndarray, width: np.ndarray
) -> dict[str, np.ndarray]:
    """albedo [N, 3], metallic [N], roughness [N], normals [N, 3] (normal map applied) at points of faces."""
    count = len(face)
    albedo, normal = np.empty((count, 3), np.float32), normals.copy()
    metallic, roughness = np.empty(count, np.float32), np.empty(count, np.float32)
    ids = mesh.material_ids[face]
    for k, material in enumerate(mesh.materials):
        used = np.flatnonzero(ids == k)
        if not len(used):
            continue
        corner = mesh.faces[face[used]]
        corners, uv = mesh.vertices[corner], mesh.uvs[corner]
        middle = np.einsum("nk,nkc->nc", weights[used], uv)
        along_u, along_v, steps = _tangents(corners, uv)
        tone = np.broadcast_to(np.asarray(material.base_factor, np.float32), (len(used), 3))
        if material.base_color is not None:
            reach = _footprint(steps, width[used], material.base_color.shape)
            taps = [sample_texture(material.base_color, middle + t @ reach, SRGB_BYTES) for t in TEXTURE_TAPS]
            tone = tone * np.mean(taps, 0)
        if mesh.colors is not None:
            tone = tone * np.einsum("nk,nkc->nc", weights[used], mesh.colors[corner])
        albedo[used] = tone
        shine = np.ones((len(used), 2), np.float32)
        if material.metallic_roughness is not None:
            shine = sample_texture(material.metallic_roughness, middle)
        metallic[used] = material.metallic * shine[:, 0]
        roughness[used] = material.roughness * shine[:, 1]
        if material.normal_map is not None:
            bump = 2 * sample_texture(material.normal_map, middle) - 1
            n = normals[used]
            t = _unit(along_u - (along_u * n).sum(1, keepdims=True) * n)
            b = np.cross(n, t)
            b = np.where(((b * along_v).sum(1) < 0)[:, None], -b, b)
            bent = bump[:, :1] * t + bump[:, 1:2] * b + np.maximum(bump[:, 2:], 0.2) * n
            normal[used] = np.where(np.all(np.isfinite(bent), axis=1)[:, None], _unit(bent), n)
    return {"albedo": albedo, "metallic": metallic, "roughness": roughness, "normals": normal}


def _tangents(corners: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(dP/du [N, 3], dP/dv [N, 3], [N, 2, 2] change of uv per world unit along two orthonormal axes of each face)."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (a, b), (c, d) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    det = a * d - b * c
    safe = np.where(np.abs(det) > 1e-12, det, 1e-12)[:, None]
    along_u = (d[:, None] * first - b[:, None] * second) / safe
    along_v = (a[:, None] * second - c[:, None] * first) / safe
    x = _unit(first)
    y = _unit(second - (second * x).sum(1, keepdims=True) * x)
    local = np.stack([(first * x).sum(1), (second * x).sum(1), (second * y).sum(1)])  # upper triangle of edges in x, y
    along_x = np.stack([a, b], 1) / np.maximum(local[0], 1e-12)[:, None]
    along_y = (np.stack([c, d], 1) - local[1][:, None] * along_x) / np.maximum(local[2], 1e-12)[:, None]
    return along_u, along_v, np.stack([along_x, along_y], 1)


def _footprint(steps: np.ndarray, width: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """[N, 2, 2] uv per standard deviation, at most 12 pixels of the map (a torn UV must not fetch from afar)."""
    reach = steps * width[:, None, None]
    pixels = np.linalg.norm(reach * np.array([shape[1], shape[0]]), axis=2, keepdims=True)
    return (reach * np.minimum(1, 12 / np.maximum(pixels, 1e-9))).astype(np.float32)


def facing(normals: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """[N, 4] quaternions w, x, y, z that turn z to the normals [N, 3], after a turn about z by `turns` [N] radians."""
    x, y, z = np.asarray(normals, np.float64).T
    # The shortest arc from z to n is (1 + z, -y, x, 0) normalised; at n = -z half a turn about x.
    arc = np.stack([1 + z, -y, x, np.zeros_like(z)], 1)
    arc[z < -0.999999] = (0, 1, 0, 0)
    arc /= np.linalg.norm(arc, axis=1, keepdims=True)
    c, s = np.cos(turns / 2), np.sin(turns / 2)
    w, i, j, _ = arc.T
    return np.stack([w * c, i * c + j * s, j * c - i * s, w * s], 1).astype(np.float32)


def _upright(normals: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Normals kept at least a little on the outer side of the surface."""
    side = (normals * surface).sum(1, keepdims=True)
    return np.where(side > 0.05, normals, _unit(normals + (0.05 - side) * surface)).astype(np.float32)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-20)
