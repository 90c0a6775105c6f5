"""Surfaces out: proxy meshes, beside trimesh and the Khronos validator, and columns of PLY files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from splatpainter.cli import main
from splatpainter.io.ply_columns import add_columns
from splatpainter.lights.prepared import lit_surface
from splatpainter.splats import Splats
from splatpainter.surface.proxy_mesh import is_closed, proxy_mesh, thickness
from tests.support.cli_scenes import ball, with_bad_gaussians

trimesh = pytest.importorskip("trimesh")
pytest_plugins = ["tests.support.node_oracle"]


def sheet(side: int = 40) -> Splats:
    """A square of edge 2 across z."""
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side)))
    means = np.stack([x, y, 0 * x], 1)
    scales = np.tile([1.2 / side, 1.2 / side, 0.05 / side], (len(means), 1))
    arrays = (means, np.tile([1.0, 0, 0, 0], (len(means), 1)), scales, np.full(len(means), 0.9))
    means, quats, scales, opacities = (array.astype(np.float32) for array in arrays)
    return Splats(means, quats, scales, opacities, np.zeros((len(means), 1, 3), np.float32))


@pytest.mark.parametrize("triangles", [2000, 6000])
@pytest.mark.parametrize("asset", [ball(1500), sheet(), with_bad_gaussians(ball(800))], ids=["ball", "sheet", "bad"])
def test_a_proxy_is_closed(asset: Splats, triangles: int) -> None:
    mesh = proxy_mesh(asset, triangles)
    other = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    assert other.is_watertight and other.is_winding_consistent and other.volume > 0
    assert len(mesh.triangles) <= triangles and np.isfinite(mesh.vertices).all()
    agree = (other.vertex_normals * mesh.normals).sum(1)
    assert np.median(agree) > 0.9, "normals look outwards"


@pytest.mark.parametrize("triangles", [300, 2000])
@pytest.mark.parametrize("asset", [ball(1500), sheet(), with_bad_gaussians(ball(800))], ids=["ball", "sheet", "bad"])
def test_a_decimated_proxy_is_closed(asset: Splats, triangles: int) -> None:
    pytest.importorskip("fast_simplification")
    mesh = proxy_mesh(asset, triangles, decimate=True)
    other = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    assert other.is_watertight and other.is_winding_consistent and other.volume > 0
    assert 0.9 * triangles < len(mesh.triangles) <= triangles < mesh.cut_triangles
    assert len(mesh.colors) == len(mesh.normals) == len(mesh.vertices)


def test_decimation_shows_more_for_as_many_triangles() -> None:
    pytest.importorskip("fast_simplification")
    slabs, shells = [], []
    for decimate in (False, True):
        mesh = proxy_mesh(sheet(100), 2000, decimate=decimate)
        slabs.append(float(np.ptp(mesh.vertices[:, 2])))
        mesh = proxy_mesh(ball(6000), 2000, decimate=decimate)
        shells.append(np.abs(np.linalg.norm(mesh.vertices[mesh.triangles].mean(1), axis=1) - 1).mean())
    assert slabs[1] < 0.6 * slabs[0], "a sheet is no slab"
    assert shells[1] < 0.95 * shells[0]


def test_a_mesh_with_an_open_edge_is_not_closed() -> None:
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    assert is_closed(tetrahedron) and not is_closed(tetrahedron[:3])
    assert not is_closed(np.concatenate([tetrahedron, tetrahedron])), "edges of four triangles"
    assert not is_closed(np.concatenate([tetrahedron[:3], tetrahedron[3:, ::-1]])), "one turned over"


def test_without_the_extra_decimation_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"fast_simplification.*splatpainter\[mesh\]"):
        proxy_mesh(ball(300), decimate=True)


def test_a_proxy_lies_on_the_surface() -> None:
    mesh = proxy_mesh(ball(3000), 20_000)
    distance = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(distance - 1).mean() < 0.6 * mesh.voxel
    assert (np.abs(distance - 1) < 1.5 * mesh.voxel).all()


def test_a_proxy_throws_the_shadow_of_its_asset() -> None:
    """Rays at a ball that is full of holes of a voxel: none goes through."""
    mesh = proxy_mesh(ball(1500), 4000)
    rng = np.random.default_rng(0)
    towards = rng.normal(size=(60, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    beside = np.cross(towards, rng.normal(size=(60, 3)))
    aim = 0.8 * rng.random((60, 1)) * beside / np.linalg.norm(beside, axis=1, keepdims=True)
    # Moeller and Trumbore 1997, all rays with all triangles.
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    for start, line in zip(aim - 3 * towards, towards, strict=True):
        p = np.cross(line, c - a)
        scale = ((b - a) * p).sum(1)
        u = ((start - a) * p).sum(1) / scale
        v = np.cross(start - a, b - a) @ line / scale
        assert ((u >= 0) & (v >= 0) & (u + v <= 1)).any()


def test_thickness_is_the_way_through() -> None:
    """Of a ball along a normal twice the radius; of a sheet next to nothing."""
    splats = ball(2000)
    through = thickness(splats, splats.means / np.linalg.norm(splats.means, axis=1, keepdims=True))
    assert np.median(through) == pytest.approx(2, rel=0.06)
    thin = thickness(sheet(), np.tile(np.array([0, 0, 1], np.float32), (1600, 1)))
    assert np.median(thin) < 0.08
    assert thickness(replace(splats, opacities=splats.opacities * 0), splats.means).max() == 0


def test_khronos_validator_has_no_objection(tmp_path: Path, gltf_validator: Callable[[Path], list[dict]]) -> None:
    io.write(tmp_path / "a.ply", ball(900))
    words = ["mesh", str(tmp_path / "a.ply"), "--colors", "--overwrite", "--out", f"{tmp_path}/p.glb"]
    for more in (["--triangles", "2500"], ["--triangles", "400", "--decimate"]):
        if "--decimate" in more:
            pytest.importorskip("fast_simplification")
        assert main([*words, *more]) == 0
        assert [message for message in gltf_validator(tmp_path / "p.glb") if message["severity"] < 2] == []


def test_the_mesh_lies_where_the_glb_of_its_asset_lies(tmp_path: Path) -> None:
    splats = ball(900)
    moved = replace(splats, means=splats.means * np.array([1, 0.5, 0.25], np.float32) + np.array([0, 2, 5], np.float32))
    io.write(tmp_path / "a.ply", moved)
    assert main(["mesh", str(tmp_path / "a.ply"), "--out", str(tmp_path / "p.glb")]) == 0
    other = trimesh.load(tmp_path / "p.glb", force="mesh")
    assert other.is_watertight and other.volume > 0
    np.testing.assert_allclose(other.bounds.mean(0), [0, -2, -5], atol=0.1)


def test_normals_are_written_where_they_are_asked_for(tmp_path: Path) -> None:
    splats = ball(600)
    io.write(tmp_path / "a.ply", splats)
    words = ["convert", f"{tmp_path}/a.ply", f"{tmp_path}/b.ply", "--normals", "--thickness", "--occlusion"]
    assert main(words) == 0
    plyfile = trimesh.load(tmp_path / "b.ply", process=False)
    columns = plyfile.metadata["_ply_raw"]["vertex"]["data"]
    normals = np.stack([columns[name] for name in ("nx", "ny", "nz")], 1)
    np.testing.assert_allclose(normals, lit_surface(splats).facing.normals, atol=1e-6)
    assert ((normals * splats.means).sum(1) > 0.9).all()
    assert columns["occlusion"].max() <= 1 and np.median(columns["thickness"]) == pytest.approx(2, rel=0.1)
    again = io.read(tmp_path / "b.ply")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(again, name), getattr(io.read(tmp_path / "a.ply"), name))


def test_normals_turn_with_the_axes_of_the_file(tmp_path: Path) -> None:
    io.write(tmp_path / "a.ply", ball(300))
    assert main(["convert", f"{tmp_path}/a.ply", f"{tmp_path}/b.ply", "--normals", "--axes", "rub"]) == 0
    data = trimesh.load(tmp_path / "b.ply", process=False).metadata["_ply_raw"]["vertex"]["data"]
    positions, normals = (np.stack([data[n] for n in names], 1) for names in (("x", "y", "z"), ("nx", "ny", "nz")))
    assert ((positions * normals).sum(1) > 0.9).all()


def test_columns_are_for_ply_files_of_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    io.write(tmp_path / "a.ply", ball(300))
    assert main(["convert", f"{tmp_path}/a.ply", f"{tmp_path}/b.spz", "--normals"]) == 2
    assert "--normals is for OUT.ply" in capsys.readouterr().err
    (tmp_path / "t.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
    with pytest.raises(ValueError, match="binary PLY"):
        add_columns(tmp_path / "t.ply", {"nx": np.zeros(1, np.float32)})


@pytest.mark.parametrize(
    "words, reason",
    [(["--out", "p.obj"], "expected a mesh to write"), (["--out", "p.glb", "--triangles", "5"], "2000 or more")],
)
def test_wrong_words_for_a_mesh(tmp_path: Path, words: list[str], reason: str, capsys: pytest.CaptureFixture) -> None:
    io.write(tmp_path / "a.ply", ball(300))
    assert main(["mesh", str(tmp_path / "a.ply"), words[0], str(tmp_path / words[1]), *words[2:]]) == 2
    assert reason in capsys.readouterr().err


def test_nothing_to_mesh() -> None:
    splats = ball(300)
    with pytest.raises(ValueError, match="got none"):
        proxy_mesh(replace(splats, opacities=splats.opacities * np.float32(0.1)))
