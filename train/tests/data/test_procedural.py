"""Procedural objects: closed and oriented shapes, exact cuts, patterns that tile, all repeating from the seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splattrain.data import procedural, shapes
from splattrain.data.meshes import NORMALISED_EXTENT
from splattrain.data.procedural import Odds, random_mesh, rotation

VOLUMES = {"box": 8, "ellipsoid": 4 / 3 * np.pi, "cylinder": 2 * np.pi, "cone": 2 / 3 * np.pi}


def cross(solid: shapes.Solid) -> np.ndarray:
    corners = solid.vertices[solid.faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def volume(solid: shapes.Solid) -> float:
    return float(np.einsum("ni,ni->n", solid.vertices[solid.faces[:, 0]], cross(solid)).sum() / 6)


def open_edges(solid: shapes.Solid) -> int:
    """Directed edges (by place) without their opposite: 0 for a closed, consistently oriented surface."""
    _, vertex = np.unique(np.round(solid.vertices, 6), axis=0, return_inverse=True)
    faces = vertex.ravel()[solid.faces]
    edges = [(int(f[i]), int(f[(i + 1) % 3])) for f in faces for i in range(3) if f[i] != f[(i + 1) % 3]]
    return sum((b, a) not in set_edges for set_edges in [set(edges)] for a, b in edges)


class Straight:
    """Draws that make the plainest primitive."""

    def random(self) -> float:
        return 1.0

    def uniform(self, low: float, high: float) -> float:
        return 0.3


@pytest.mark.parametrize("kind", shapes.PRIMITIVES)
def test_primitives_are_closed_with_the_outside_out(kind: str) -> None:
    solid = shapes.primitive(kind, Straight())  # pyright: ignore[reportArgumentType]
    expected = VOLUMES.get(kind, 2 * np.pi**2 * 0.7 * 0.3**2)
    assert volume(solid) == pytest.approx(expected, rel=0.03)
    assert np.abs(solid.vertices).max() <= 1 + 1e-9
    assert ((solid.normals[solid.faces].sum(1) * cross(solid)).sum(1) > 0).all()
    if kind != "cone":  # its tip is a pinhole
        assert open_edges(solid) == 0


def test_bumps_leave_a_solid_closed() -> None:
    solid = shapes.primitive("box", np.random.default_rng(1), bumpy=True)
    assert open_edges(solid) == 0
    plain = shapes.primitive("box", np.random.default_rng(1))
    assert np.abs(solid.vertices - plain.vertices).max() > 0.05


def test_a_cut_ball_is_a_shell_of_the_wanted_thickness() -> None:
    ball = shapes.primitive("ellipsoid", np.random.default_rng(0))
    shell = shapes.cut(ball, lambda p: p[:, 1] - 0.4, 0.05)  # only above y = 0.4 remains
    assert open_edges(shell) == 0
    assert shell.vertices[np.unique(shell.faces), 1].min() > 0.4 * 0.94  # the inner edge lies below by the wall
    cap = 2 * np.pi * (1 - 0.4)  # Archimedes: area of a cap by its height
    assert volume(shell) == pytest.approx(cap * 0.05 * 0.95, rel=0.05)
    assert shapes.cut(ball, lambda p: np.ones(len(p)), 0.05) is ball


def test_wires_are_thin() -> None:
    frame = shapes.wires("box", 0.02)
    inside = np.abs(frame.vertices).max(1)
    assert inside.max() < 1.03 and inside.min() > 0.95  # all on the box's surface
    assert volume(frame) < 0.2


@pytest.mark.parametrize("kind", shapes.PRIMITIVES)
def test_distances_are_negative_inside(kind: str) -> None:
    measure = shapes.distance(kind)
    surface = shapes.primitive(kind, Straight()).vertices  # pyright: ignore[reportArgumentType]
    assert np.abs(measure(surface)).max() < 0.02
    assert (measure(3 * np.eye(3)) > 0).all()


@pytest.mark.parametrize("kind", procedural.PATTERNS)
def test_patterns_are_pictures_that_tile(kind: str) -> None:
    color, relief = procedural.pattern(kind, np.random.default_rng(3))
    assert color.shape == (procedural.SIDE_PX, procedural.SIDE_PX, 3) and relief.shape == color.shape[:2]
    assert np.isfinite(color).all() and color.min() >= -1e-9 and color.max() <= 1 + 1e-9
    inner = np.abs(np.diff(color, axis=0)).mean((1, 2))
    seam = np.abs(color[0] - color[-1]).mean()
    assert seam <= inner.max() + 0.05


def test_normals_of_a_relief_point_up_the_slope() -> None:
    x = np.arange(64) / 64 * 2 * np.pi
    normal = procedural.relief_normals(np.tile(np.sin(x), (64, 1)), 64 / (2 * np.pi)) / 127.5 - 1
    np.testing.assert_allclose(normal[5, 0], [-np.sqrt(0.5), 0, np.sqrt(0.5)], atol=0.01)  # height = x there
    steep = procedural.relief_normals(np.tile(np.sin(x), (64, 1)).T, 64 / (2 * np.pi)) / 127.5 - 1
    assert steep[0, 5, 1] > 0.7  # rows run down and v up: height falls with v


def test_objects_repeat_from_the_seed_and_differ_between_seeds() -> None:
    first, again, other = random_mesh(11), random_mesh(11), random_mesh(12)
    for name in ("vertices", "faces", "normals", "uvs", "material_ids"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    for a, b in zip(first.materials, again.materials, strict=True):
        np.testing.assert_array_equal(a.base_color, b.base_color)
    assert len(first.faces) != len(other.faces) or not np.array_equal(first.vertices, other.vertices)


def test_objects_are_varied_and_sound() -> None:
    parts = []
    for seed in range(10):
        mesh = random_mesh(seed, odds=Odds(bumpy=0.5, cut=0.5, wires=0.2))
        assert np.abs(mesh.vertices).max() == pytest.approx(NORMALISED_EXTENT / 2, abs=1e-5)
        assert np.isfinite(mesh.vertices).all() and np.isfinite(mesh.uvs).all()
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
        assert mesh.material_ids.max() < len(mesh.materials)
        parts.append(len(mesh.materials))
    assert len(set(parts)) >= 4 and 1 <= min(parts) and max(parts) <= 9


def test_rotations_are_rotations() -> None:
    turn = rotation(np.random.default_rng(0))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_photos_are_used_and_a_folder_without_them_is_refused(tmp_path: Path) -> None:
    from PIL import Image

    with pytest.raises(ValueError, match="no such folder"):
        random_mesh(0, tmp_path / "none")
    with pytest.raises(ValueError, match="holds no pictures"):
        for seed in range(20):
            random_mesh(seed, tmp_path)
    Image.new("RGB", (8, 8), (12, 200, 90)).save(tmp_path / "green.png")
    (tmp_path / "torn.jpg").write_bytes(b"\xff\xd8")
    rng = np.random.default_rng(0)
    seen = [procedural.random_material(rng, tmp_path).base_color for _ in range(12)]
    assert any(color is not None and (color == [12, 200, 90]).all() for color in seen)
