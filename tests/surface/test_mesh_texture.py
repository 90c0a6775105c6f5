"""The look of an asset baked into a picture on its proxy mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from splatpainter.cli import main
from splatpainter.color import sh_from_color
from splatpainter.splats import Splats
from splatpainter.surface.mesh_texture import MeshTexture, bake_texture
from splatpainter.surface.proxy_mesh import proxy_mesh
from tests.support.cli_scenes import ball

pytest_plugins = ["tests.support.node_oracle"]
RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)


def stripes() -> Splats:
    """A ball of red and blue slices across x."""
    splats = ball(6000)
    sh = np.zeros((len(splats), 1, 3), np.float32)
    sh[:, 0] = sh_from_color(np.where(np.floor(splats.means[:, :1] / 0.5).astype(int) % 2 == 0, RED, BLUE))
    return replace(splats, sh=sh)


def bilinear(texture: MeshTexture, uv: np.ndarray) -> np.ndarray:
    """[M, 3] as a renderer reads it, with its filter between the centres of pixels."""
    size = len(texture.picture)
    at = uv * size - 0.5
    low = np.floor(at).astype(int).clip(0, size - 2)
    x, y = (at - low).T[:, :, None]
    a, b = low.T
    rows = [texture.picture[b + j, a + i] / 255 for j in (0, 1) for i in (0, 1)]
    return (rows[0] * (1 - x) + rows[1] * x) * (1 - y) + (rows[2] * (1 - x) + rows[3] * x) * y


def test_each_triangle_shows_what_lies_at_its_place_up_to_its_edges() -> None:
    splats = stripes()
    mesh = proxy_mesh(splats, 2000)
    texture = bake_texture(splats, mesh, 512)
    assert texture.uv.shape == (len(mesh.triangles), 3, 2) and texture.uv.min() > 0 and texture.uv.max() < 1
    corners = mesh.vertices[mesh.triangles]
    share = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [1 / 3] * 3])
    points = np.einsum("kc,tcd->tkd", share, corners).reshape(-1, 3)
    colors = bilinear(texture, np.einsum("kc,tcd->tkd", share, texture.uv).reshape(-1, 2))
    slices = points[:, 0] / 0.5
    clear = np.abs(slices - np.rint(slices)) > 0.2  # a Gaussian's width from a border
    expected = np.where(np.floor(slices[:, None]).astype(int) % 2 == 0, RED, BLUE)
    error = np.abs(colors - expected).max(1)[clear]
    assert clear.mean() > 0.4 and np.quantile(error, 0.98) < 0.1 and error.mean() < 0.04


def test_finer_than_colours_at_vertices() -> None:
    """Stripes that the mesh's vertices are too far apart for."""
    splats = stripes()
    fine = replace(splats, sh=splats.sh.copy())
    fine.sh[:, 0] = sh_from_color(np.where(np.sin(24 * splats.means[:, 1:2]) > 0, RED, BLUE))
    mesh = proxy_mesh(fine, 2000)
    texture = bake_texture(fine, mesh, 1024)
    middle = mesh.vertices[mesh.triangles].mean(1)
    wave = np.sin(24 * middle[:, 1])
    clear = np.abs(wave) > 0.7
    expected = np.where(wave[:, None] > 0, RED, BLUE)
    baked = bilinear(texture, texture.uv.mean(1))
    at_vertices = mesh.colors[mesh.triangles].mean(1)
    errors = [float(np.abs(colors - expected)[clear].mean()) for colors in (baked, at_vertices)]
    assert errors[0] < 0.5 * errors[1]


def test_the_file_holds_it(tmp_path: Path, gltf_validator: Callable[[Path], list[dict]]) -> None:
    trimesh = pytest.importorskip("trimesh")
    io.write(tmp_path / "a.ply", stripes())
    words = ["mesh", str(tmp_path / "a.ply"), "--out", f"{tmp_path}/p.glb", "--triangles", "2000", "--texture", "256"]
    assert main(words) == 0
    assert [message for message in gltf_validator(tmp_path / "p.glb") if message["severity"] < 2] == []
    loaded = trimesh.load(tmp_path / "p.glb", force="mesh")
    picture = loaded.visual.material.baseColorTexture
    assert picture.size == (256, 256) and len(loaded.visual.uv) == len(loaded.vertices) == 3 * len(loaded.faces)
    # Turned about x into glTF's axes it faces outwards still, and is closed but for the seams of its picture.
    loaded.merge_vertices(merge_tex=True, merge_norm=True)
    assert loaded.is_watertight and loaded.volume > 0


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--colors", "--texture", "512"], "expected --colors or --texture, got both"),
        (["--texture", "20"], "expected --texture from 64 to 8192 pixels, got 20"),
        (["--triangles", "20000", "--texture", "128"], "expected a texture of"),
    ],
)
def test_wrong_words(tmp_path: Path, words: list[str], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    io.write(tmp_path / "a.ply", ball(900))
    assert main(["mesh", str(tmp_path / "a.ply"), "--out", str(tmp_path / "p.glb"), *words]) == 2
    error = capsys.readouterr().err
    assert reason in error and error.count("\n") == 1 and not (tmp_path / "p.glb").exists()
