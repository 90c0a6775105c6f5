"""Small meshes and samples with known answers, for the tests of path tracing, shards and the data command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from splatpainter.cameras import orbit
from splattrain.data.materials import Material
from splattrain.data.meshes import Mesh
from splattrain.data.samples import PosedViews, Sample
from tests.support.cli_scenes import ball

MATT = Material(base_factor=(1.0, 1.0, 1.0), roughness=1.0)


def sphere(material: Material = MATT, level: int = 4) -> Mesh:
    """The unit sphere, about; smooth normals."""
    import trimesh

    shape = trimesh.creation.icosphere(level)
    points, faces = np.array(shape.vertices, np.float32), np.array(shape.faces, np.int64)
    uvs = np.zeros((len(points), 2), np.float32)
    return Mesh("sphere", points, faces, points.copy(), uvs, np.zeros(len(faces), np.int64), (material,))


def quad(material: Material, uvs: list[list[float]] | None = None) -> Mesh:
    """The square -1..1 in the plane z = 0, facing +z; by default u runs along x and v along y."""
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    corners = np.array(uvs or [[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return Mesh("quad", points, np.array([[0, 1, 2], [0, 2, 3]]), normals, corners, np.zeros(2, np.int64), (material,))


def write_box(path: Path, color: tuple[int, int, int], size: tuple[float, float, float] = (1, 1, 1)) -> Path:
    """A GLB of a box with a checked texture."""
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    box = trimesh.creation.box(size)
    box.unmerge_vertices()
    checks = (np.indices((32, 32)).sum(0) // 4 % 2)[..., None] * 80 + np.array(color) // 2
    image = Image.fromarray(checks.clip(0, 255).astype(np.uint8))
    uvs = np.asarray(box.vertices)[:, :2] + 0.5
    material = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=0.7)
    box.visual = TextureVisuals(uv=uvs, material=material)
    data = box.export(file_type="glb")
    assert isinstance(data, bytes)
    path.write_bytes(data)
    return path


def random_sample(seed: int, name: str = "thing", kind: str = "stroke", edited: int = 2, size: int = 12) -> Sample:
    """Noise in every picture, other cameras for every seed; the asset is the same for equal names."""
    rng = np.random.default_rng(seed)

    def views(count: int) -> PosedViews:
        cameras = orbit([0, 0, 0], 3, count, start=seed, width=size, height=size, background=(0.5, 0.25, 0.0))
        return PosedViews(tuple(cameras), torch.from_numpy(rng.random((count, size, size, 3), np.float32)))

    before = views(3)
    after = PosedViews(before.cameras, views(3).colors)
    masks = rng.random((edited, size, size)) < 0.3
    asset = ball(40 + len(name), degree=1)
    near = np.array([True, False, False])
    return Sample(name, kind, "local", asset, views(2), views(edited), masks, before, after, near)
