"""Paint on meshes: against the layer that was painted, the unpainted trace, and ray casting by another library."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.cameras import Camera, look_at
from splatpainter.color import linear_to_srgb
from splatpainter.metrics import psnr
from splattrain.data.edits import EditDesign
from splattrain.data.edits.on_mesh import paint_mesh, repaint_mesh
from splattrain.data.materials import Material
from splattrain.data.mesh_visibility import projected, visible_points
from splattrain.data.meshes import Mesh, joined
from tests.support.data_meshes import MATT, quad, sphere

WHITE = np.ones((8, 16, 3), np.float32)
TEXTURE = np.kron(
    np.random.default_rng(0).integers(40, 220, (16, 16, 3)).astype(np.uint8), np.ones((4, 4, 1), np.uint8)
)


def view(eye: tuple[float, float, float] = (0.3, 0.2, 4.0), size: int = 40) -> Camera:
    return look_at(eye, [0, 0, 0], width=size, height=size, fov=30)


def checks(size: int = 40, cell: int = 5, rim: int = 10) -> np.ndarray:
    y, x = np.mgrid[:size, :size]
    layer = np.zeros((size, size, 4), np.float32)
    layer[..., :3] = np.where(((y // cell + x // cell) % 2)[..., None], [0.9, 0.1, 0.1], [0.1, 0.2, 0.7])
    layer[rim:-rim, rim:-rim, 3] = 1
    return layer


def paint_layer(mesh: Mesh, layer: np.ndarray, camera: Camera) -> Mesh:
    return paint_mesh(mesh, EditDesign("layer", camera, layer))


def area(mesh: Mesh) -> float:
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(cross, axis=1).sum()) / 2


def painted_faces(before: Mesh, after: Mesh) -> np.ndarray:
    """[F] bool of `after`: faces of a material that `before` does not have."""
    new = np.array([not any(m is other for other in before.materials) for m in after.materials])
    return new[after.material_ids]


# Path traced


def traced(mesh: Mesh, cameras: list[Camera], samples: int = 8) -> tuple[np.ndarray, np.ndarray]:
    from splattrain.data.pathtrace import PathOptions, display, path_trace

    done = path_trace(mesh, WHITE, cameras, PathOptions(samples, variant="scalar_rgb", model="diffuse"))
    return display(done, 1.0, cameras), done.alphas


def test_a_painted_plane_shows_the_layer_and_nothing_else_changes() -> None:
    pytest.importorskip("mitsuba")
    mesh, layer, camera = quad(Material(base_color=TEXTURE, roughness=1.0)), checks(), view()
    painted = paint_layer(mesh, layer, camera)
    before, alphas = traced(mesh, [camera])
    after, _ = traced(painted, [camera])
    y, x = np.mgrid[:40, :40]
    inner = (layer[..., 3] > 0) & (y % 5 > 0) & (y % 5 < 4) & (x % 5 > 0) & (x % 5 < 4)
    inner[[10, 29]] = False
    assert psnr(after[0], layer[..., :3], inner) > 30  # measured 34
    outer = np.ones((40, 40), bool)
    outer[8:-8, 8:-8] = False
    assert (alphas[0][outer] > 0).sum() > 100
    assert np.abs(after - before)[0][outer].max() < 1e-4
    assert np.abs(after - before)[0][~outer].max() > 0.2


def test_paint_on_a_ball_stays_off_its_far_side_and_off_what_stands_behind() -> None:
    pytest.importorskip("mitsuba")
    wall = quad(replace(MATT, base_factor=(0.5, 0.5, 0.5)))
    wall = replace(wall, vertices=(1.5 * wall.vertices - [0, 0, 2]).astype(np.float32))
    mesh = joined("both", [sphere(level=3), wall])
    camera = view((0, 0, 5), 32)
    layer = np.zeros((32, 32, 4), np.float32)
    layer[12:20, 12:20] = (0.8, 0.1, 0.1, 1)
    painted = paint_layer(mesh, layer, camera)
    faces = painted_faces(mesh, painted)
    assert faces.any() and painted.vertices[painted.faces[faces]][..., 2].min() > 0.5
    behind = look_at([3.5, 0.5, -3], [0, 0, -1], width=32, height=32, fov=40)
    (before, after), (unpainted, same) = traced(painted, [camera, behind])[0], traced(mesh, [camera, behind])[0]
    assert np.allclose(before[13:19, 13:19].mean((0, 1)), (0.8, 0.1, 0.1), atol=0.03)
    assert np.abs(before - unpainted)[:9].max() < 0.1  # further bounces alone
    assert np.abs(after - same).mean() < 0.01


# The cut mesh


def test_the_surface_stays_and_only_paint_gets_vertex_colours() -> None:
    mesh, layer, camera = quad(Material(base_color=TEXTURE)), checks(), view()
    painted = paint_layer(mesh, layer, camera)
    assert abs(area(painted) - area(mesh)) < 1e-5
    assert np.abs(painted.vertices[:, 2]).max() == 0 and np.allclose(painted.normals, [0, 0, 1])
    assert np.allclose(painted.uvs, painted.vertices[:, :2] / 2 + 0.5, atol=1e-6)  # as quad lays them
    faces = painted_faces(mesh, painted)
    flat = projected(painted.vertices, camera)[painted.faces[faces]][..., :2]
    assert np.linalg.norm(np.roll(flat, -1, 1) - flat, axis=2).max() <= 1.0 + 1e-5
    assert 8 < flat.min() and flat.max() < 32  # a pixel around the layer, and a piece
    assert painted.colors is not None
    assert (painted.colors[np.unique(painted.faces[~faces])] == 1).all()
    assert all(painted.materials[k].base_color is None for k in np.unique(painted.material_ids[faces]))


def test_vertices_have_the_layer_mixed_with_the_texture_by_hand() -> None:
    mesh = quad(Material(base_color=np.full((4, 4, 3), 128, np.uint8)))
    layer = np.zeros((40, 40, 4), np.float32)
    layer[10:30, 10:30] = (0.8, 0.2, 0.0, 0.25)
    camera = view((0, 0, 4))
    painted = paint_layer(mesh, layer, camera)
    assert painted.colors is not None
    points = projected(painted.vertices, camera)
    inside = np.all(np.abs(points[:, :2] - 20) < 8, axis=1)
    inside[np.unique(painted.faces[~painted_faces(mesh, painted)])] = False
    assert inside.any()
    expected = 0.75 * 128 / 255 + 0.25 * np.array([0.8, 0.2, 0.0])
    assert np.allclose(linear_to_srgb(painted.colors[inside]), expected, atol=1e-3)


def test_metal_is_hidden_by_paint_and_kept_by_a_recolouring() -> None:
    mesh, camera = quad(Material(metallic=1.0)), view()
    painted = paint_layer(mesh, checks(), camera)
    assert {m.metallic for m in painted.materials} == {0.0, 1.0}  # the soft rim keeps it
    tinted = repaint_mesh(
        mesh, camera, checks()[..., 3] > 0, lambda points, colors: (colors * 0.5, np.ones(len(points)))
    )
    assert {m.metallic for m in tinted.materials} == {1.0} and painted_faces(mesh, tinted).any()


def test_vertex_colours_under_a_texture_stay_what_the_path_tracer_makes_of_them() -> None:
    mesh = quad(Material(base_color=TEXTURE))
    colored = replace(mesh, colors=np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], np.float32))
    painted = paint_layer(colored, checks(), view())
    unpainted = painted.material_ids[~painted_faces(colored, painted)]
    factors = [painted.materials[k].base_factor for k in np.unique(unpainted)]
    assert np.allclose(factors, 0.5) and painted.colors is not None  # the mean of the four


def test_paint_again_goes_over_paint() -> None:
    mesh, camera = quad(MATT), view((0, 0, 4))
    layer = np.zeros((40, 40, 4), np.float32)
    layer[10:30, 10:30] = (0.8, 0.2, 0.0, 1)
    small = np.zeros((40, 40, 4), np.float32)
    small[15:25, 15:25] = (0.1, 0.9, 0.3, 1)
    twice = paint_layer(paint_layer(mesh, layer, camera), small, camera)
    assert twice.colors is not None
    corners = projected(twice.vertices, camera)[twice.faces][..., :2]
    middle, tones = corners.mean(1), linear_to_srgb(twice.colors[twice.faces].mean(1))
    distance = np.abs(middle - 20).max(1)
    assert np.allclose(tones[distance < 4], (0.1, 0.9, 0.3), atol=1e-3)
    assert np.allclose(tones[(distance > 6.5) & (distance < 9)], (0.8, 0.2, 0.0), atol=1e-3)
    assert abs(area(twice) - 4) < 1e-5


def test_what_is_not_reached_is_the_same_mesh_and_bad_layers_are_refused() -> None:
    mesh, camera = quad(MATT), view()
    assert paint_layer(mesh, np.zeros((40, 40, 4), np.float32), camera) is mesh
    assert paint_layer(mesh, checks(), look_at([0, 0, 4], [0, 0, 8], width=40, height=40)) is mesh  # looks away
    with pytest.raises(ValueError, match=r"quad: expected a layer \[40, 40, 4\]"):
        paint_layer(mesh, checks(48), camera)


def test_a_surface_seen_aslant_gets_no_paint_and_one_behind_the_camera_none_either() -> None:
    flat = quad(MATT)
    aslant = look_at([0, -4, 0.2], [0, 0, 0], up=(0, 0, 1), width=40, height=40, fov=30)
    layer = np.ones((40, 40, 4), np.float32)
    assert paint_layer(flat, layer, aslant) is flat  # cosine 0.05
    large = replace(flat, vertices=100 * flat.vertices)
    over = look_at([0, -1, 1], [0, 0, 0], up=(0, 0, 1), width=40, height=40, fov=30)
    painted = paint_layer(large, layer, over)  # the plane goes on behind the camera
    faces = painted_faces(large, painted)
    assert faces.any() and projected(painted.vertices[np.unique(painted.faces[faces])], over)[:, 2].min() > 0.5
    assert abs(area(painted) / area(large) - 1) < 1e-4


# Sight


def test_what_is_seen_is_what_solving_every_line_and_triangle_says() -> None:
    rng = np.random.default_rng(3)
    balls = [sphere(level=1) for _ in range(6)]
    parts = [replace(b, vertices=(0.35 * b.vertices + rng.uniform(-0.6, 0.6, 3)).astype(np.float32)) for b in balls]
    mesh, camera = joined("balls", parts), view((1.0, 2.0, 3.0), 48)
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    points = corners.mean(1)[rng.permutation(len(mesh.faces))[:150]]
    lines = points - camera.position
    systems = np.empty((len(points), len(corners), 3, 3))  # corner + u e1 + v e2 = eye + t line
    systems[..., 0], systems[..., 1] = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    systems[..., 2] = -lines[:, None]
    sides = np.broadcast_to((camera.position - corners[:, 0])[None, ..., None], (*systems.shape[:2], 3, 1))
    u, v, t = np.moveaxis(np.linalg.solve(systems, sides)[..., 0], -1, 0)
    hidden = ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1 - 1e-4)).any(1)
    assert (visible_points(mesh, camera, points) == ~hidden).all() and 20 < hidden.sum() < 130


def test_holes_of_cutouts_hide_nothing_and_what_is_outside_the_picture_is_not_seen() -> None:
    alpha = np.zeros((16, 16), np.uint8)
    alpha[:8] = 255  # v > 1/2: y > 0
    screen = quad(replace(MATT, alpha=alpha))
    behind = np.array([[0, 0.5, -0.5], [0, -0.5, -0.5], [0.5, 0.4, 0.0], [9, 0, 0], [0, 0, 9]])
    camera = view((0, 0, 4))
    assert visible_points(screen, camera, behind).tolist() == [False, True, True, False, False]
    assert visible_points(quad(MATT), camera, behind).tolist() == [False, False, True, False, False]
