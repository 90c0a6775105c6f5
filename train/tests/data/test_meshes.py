"""Reading meshes: what is kept, what is repaired, what is refused with one line."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splattrain.data.meshes import NORMALISED_EXTENT, Material, Mesh, joined, load_mesh, normalized, repaired

trimesh = pytest.importorskip("trimesh")
from PIL import Image  # noqa: E402
from trimesh.visual.material import PBRMaterial  # noqa: E402
from trimesh.visual.texture import TextureVisuals  # noqa: E402

QUAD = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UVS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)


def textured(**keys: Any) -> Any:
    pixels = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    material = PBRMaterial(baseColorTexture=Image.fromarray(pixels), metallicFactor=0.25, roughnessFactor=0.5, **keys)
    return trimesh.Trimesh(QUAD, FACES, visual=TextureVisuals(UVS, material=material), process=False)


def quad(**keys: Any) -> Mesh:
    values: dict[str, Any] = {
        "name": "quad",
        "vertices": QUAD.astype(np.float32),
        "faces": FACES.astype(np.int64),
        "normals": np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
        "uvs": UVS.astype(np.float32),
        "material_ids": np.zeros(2, np.int64),
        "materials": (Material(),),
    }
    return Mesh(**(values | keys))


@pytest.mark.parametrize(
    ("picture", "is_map"), [((150, 100, 220), True), ((14, 14, 14), False), ((174, 174, 174), False)]
)
def test_a_picture_of_heights_is_no_normal_map(tmp_path: Path, picture: tuple[int, int, int], is_map: bool) -> None:
    image = Image.fromarray(np.full((4, 4, 3), picture, np.uint8))
    trimesh.Scene(textured(normalTexture=image)).export(tmp_path / "one.glb")
    (material,) = load_mesh(tmp_path / "one.glb").materials
    assert (material.normal_map is not None) == is_map and material.base_color is not None


def test_a_glb_keeps_maps_factors_and_several_parts_with_their_transforms(tmp_path: Path) -> None:
    normal = Image.fromarray(np.full((4, 4, 3), (128, 128, 255), np.uint8))
    metal = Image.fromarray(np.dstack([np.full((4, 4), v, np.uint8) for v in (0, 200, 100)]))
    scene = trimesh.Scene()
    scene.add_geometry(textured(normalTexture=normal, metallicRoughnessTexture=metal), geom_name="a")
    other = textured(baseColorFactor=[0.5, 1.0, 1.0, 1.0])
    scene.add_geometry(other, geom_name="b", transform=trimesh.transformations.translation_matrix([0, 3, 0]))
    scene.export(tmp_path / "two.glb")
    mesh = load_mesh(tmp_path / "two.glb")
    assert mesh.name == "two" and len(mesh.faces) == 4 and len(mesh.materials) == 2
    np.testing.assert_allclose(
        np.ptp(mesh.vertices, axis=0), [2 * NORMALISED_EXTENT / 4, NORMALISED_EXTENT, 0], atol=1e-6
    )  # 2 x (3 + 1)
    np.testing.assert_allclose(mesh.vertices.max(0) + mesh.vertices.min(0), 0, atol=1e-6)
    first, second = sorted(mesh.materials, key=lambda material: material.normal_map is None)
    assert first.base_color is not None and first.base_color[0, 1].tolist() == [0, 255, 0]
    assert first.metallic_roughness is not None and first.metallic_roughness[0, 0].tolist() == [100, 200]
    assert first.normal_map is not None and (first.metallic, first.roughness) == (0.25, 0.5)
    assert second.normal_map is None and second.base_factor[0] == pytest.approx(0.5, abs=0.01)
    low = mesh.vertices[:, 1].argmin()
    assert mesh.uvs[low, 1] == 0  # v runs up
    assert (mesh.normals[:, 2] > 0.99).all()


def test_a_mirrored_part_keeps_its_outside_outside(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(subdivisions=1)
    scene.add_geometry(ball, transform=np.diag([-1.0, 1.0, 2.0, 1.0]))
    scene.export(tmp_path / "ball.glb")
    mesh = load_mesh(tmp_path / "ball.glb")
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((cross * corners.mean(1)).sum(1) > 0).all()
    assert ((mesh.normals * mesh.vertices).sum(1) > 0).all()


def test_an_obj_without_uvs_gets_some(tmp_path: Path) -> None:
    (tmp_path / "plain.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    mesh = load_mesh(tmp_path / "plain.obj")
    assert len(mesh.faces) == 1 and np.ptp(mesh.uvs, axis=0).min() > 0.5
    assert mesh.materials[0].base_color is None


def test_vertex_colours_are_kept(tmp_path: Path) -> None:
    body = trimesh.Trimesh(
        QUAD, FACES, vertex_colors=np.tile(np.array([188, 0, 255, 255], np.uint8), (4, 1)), process=False
    )
    body.export(tmp_path / "colours.obj")
    mesh = load_mesh(tmp_path / "colours.obj")
    assert mesh.colors is not None
    np.testing.assert_allclose(mesh.colors[0], [0.503, 0, 1], atol=0.01)  # sRGB 188 is linear 0.503


def test_a_broken_texture_gives_way_to_the_factor(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    textured().export(buffer, file_type="glb")
    data = buffer.getvalue()
    offset = data.index(b"\x89PNG")
    (tmp_path / "broken.glb").write_bytes(data[: offset + 30] + bytes(len(data) - offset - 30))
    mesh = load_mesh(tmp_path / "broken.glb")
    assert len(mesh.faces) == 2 and mesh.materials[0].base_color is None


def test_faces_with_nan_or_missing_vertices_or_no_area_are_dropped() -> None:
    vertices = np.concatenate([QUAD, [[np.nan, 0, 0], [1, 1, 0]]]).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 1, 4], [0, 1, 99], [3, 3, 1], [3, 5, 2]])
    normals = np.zeros((6, 3), np.float32)
    uvs = np.full((6, 2), np.nan, np.float32)
    mesh = repaired(quad(vertices=vertices, faces=faces, normals=normals, uvs=uvs, material_ids=np.arange(5) % 1))
    assert mesh.faces.tolist() == [[0, 1, 2]] and len(mesh.material_ids) == 1
    np.testing.assert_allclose(mesh.normals[:3], [[0, 0, 1]] * 3)
    assert np.isfinite(mesh.vertices).all() and np.isfinite(mesh.uvs).all()


def test_a_mesh_without_area_is_refused() -> None:
    with pytest.raises(ValueError, match="^quad: the mesh has no area"):
        repaired(quad(vertices=np.zeros((4, 3), np.float32)))
    with pytest.raises(ValueError, match="no vertex is finite"):
        repaired(quad(vertices=np.full((4, 3), np.nan, np.float32)))


def test_joining_keeps_a_shared_material_once() -> None:
    shared = (Material(roughness=0.1),)
    mesh = joined("both", [quad(materials=shared), quad(materials=shared), quad()])
    assert len(mesh.materials) == 2 and mesh.material_ids.tolist() == [0, 0, 0, 0, 1, 1]
    assert mesh.faces.max() == 11


def test_normalising_fits_the_longest_side() -> None:
    mesh = normalized(quad())
    np.testing.assert_allclose(
        [mesh.vertices.min(0), mesh.vertices.max(0)], [[-0.9, -0.45, 0], [0.9, 0.45, 0]], atol=1e-6
    )


def giant() -> bytes:
    """A GLB whose header promises eleven million triangles."""
    head = b'{"meshes":[{"primitives":[{"attributes":{"POSITION":0},"indices":0}]}],"accessors":[{"count":33000000}]}'
    head += b" " * (-len(head) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(head), len(head), 0x4E4F534A) + head


@pytest.mark.parametrize(
    ("name", "data", "line"),
    [
        ("none.glb", None, "no such file"),
        ("a.stl", b"", "expected a mesh"),
        ("cut.glb", b"glTF\x02\x00", "cannot be read as a mesh"),
        ("empty.obj", b"# nothing\n", "cannot be read as a mesh|holds no triangles"),
        ("giant.glb", giant(), "11,000,000 triangles"),
        ("flat.obj", b"v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n", "no area"),
    ],
)
def test_bad_files_give_one_line_that_names_them(tmp_path: Path, name: str, data: bytes | None, line: str) -> None:
    path = tmp_path / name
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(ValueError, match=line) as caught:
        load_mesh(path)
    assert name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.shared
def test_real_meshes_have_uvs_textures_and_outward_normals(shared: Path) -> None:
    for name in ("pc_statue", "gz_pr2_torso_lift", "gso_school_bus"):
        mesh = load_mesh(shared / "data" / "meshes" / f"{name}.glb")
        assert np.abs(mesh.vertices).max() == pytest.approx(NORMALISED_EXTENT / 2, abs=1e-5)
        assert any(material.base_color is not None for material in mesh.materials)
        corners = mesh.vertices[mesh.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert ((cross * mesh.normals[mesh.faces[:, 0]]).sum(1) > 0).mean() > 0.99
