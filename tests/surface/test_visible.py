"""What one view sees of a surface, and `render --aov normal,depth`, which shows it."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splatpainter.cameras import look_at
from splatpainter.image_files import find_camera
from splatpainter.io import read, write
from splatpainter.pictures.picture_reader import read_picture
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.surface.estimate import Surface, SurfacePoints
from splatpainter.surface.visible import visible_surface
from splatpainter.view_files import draw_passes, normals_of
from tests.support.cli_scenes import Capture, run
from tests.surface.test_estimate import WIDTH, angles, plane, sphere

CAMERA = look_at((0.5, 0.9, 1.8), (0, 0, 0), width=160, height=120)


def sphere_depth(camera, radius=0.5):
    """[H, W] z-depth of the sphere about the origin, NaN beside it; [H, W, 3] its normals."""
    origin, rays = camera.rays()
    along = rays @ origin
    with np.errstate(invalid="ignore"):
        distance = -along - np.sqrt(along**2 - (origin @ origin - radius**2))
    points = origin + distance[..., None] * rays
    return distance * (rays @ camera.forward), points / radius


def test_depth_and_normals_of_a_sphere_are_those_of_its_formula():
    asset = sphere(10_000)
    surface = Surface.of(asset)
    depth, normals = sphere_depth(CAMERA)
    passes = draw_passes(asset, CAMERA, ("depth", "normal"), surface=surface)
    blended = draw_passes(asset, CAMERA, ("depth", "normal"), normals=normals_of(asset))
    facing = -(normals * CAMERA.rays()[1]).sum(-1)
    inside = facing > 0.4  # NaN beside it is False
    assert inside.sum() > 1000 and passes.normal is not None and blended.normal is not None
    heights = np.abs(passes.depth - depth)[inside] * facing[inside] / WIDTH
    assert np.median(heights) < 0.05 and np.quantile(heights, 0.95) < 0.25
    assert np.median(heights) < 0.5 * np.median(np.abs(blended.depth - depth)[inside] * facing[inside] / WIDTH)
    errors = angles(passes.normal[inside], normals[inside])
    assert np.median(errors) < 2 and np.median(errors) < np.median(angles(blended.normal[inside], normals[inside]))
    assert (passes.colors == blended.colors).all() and (passes.alpha == blended.alpha).all()
    outside = passes.alpha < 0.5
    assert (passes.depth[outside] == blended.depth[outside]).all()


def test_a_view_of_nothing_has_no_surface():
    empty = plane(0)
    view = project(empty, CAMERA)
    visible = visible_surface(Surface.of(empty), empty, view, np.ones((120, 160), bool))
    assert (visible.at(np.array([[80.0, 60.0]])).depth == 0).all()


@dataclass(frozen=True)
class CountingSurface(Surface):
    """Notes how many lines of sight it is asked about."""

    counts: list[int] = field(default_factory=list)

    def at(self, points: np.ndarray, directions: np.ndarray, widths: np.ndarray) -> SurfacePoints:
        self.counts.append(len(points))
        return super().at(points, directions, widths)


def test_lines_of_sight_that_were_estimated_before_are_taken_over_bit_for_bit():
    """Also where a part of what the camera sees was edited in between: there they are estimated anew."""
    asset = sphere(4000)
    surface = CountingSurface(Surface.of(asset).samples)
    everything = np.ones((120, 160), bool)
    part = everything.copy()
    part[:, 70:] = False
    estimates = visible_surface(surface, asset, project(asset, CAMERA), part, 1).estimates
    upper = asset.means[:, 1] > 0.2
    edited = replace(asset, scales=np.where(upper[:, None], 1.2 * asset.scales, asset.scales))
    view = project(edited, CAMERA)
    fresh = visible_surface(surface, edited, view, everything, 1)
    taken = visible_surface(surface, edited, view, everything, 1, estimates)
    first, total, rest = surface.counts
    assert total - first < rest < total - 0.3 * first
    for name in ("index", "points", "normals", "windows", "residuals", "trusted"):
        assert getattr(fresh, name).tobytes() == getattr(taken, name).tobytes(), name


def test_render_writes_the_surface(tmp_path, capfd: Capture):
    path = tmp_path / "ball.ply"
    write(path, sphere(4000))
    words = ("--views", 1, "--size", 96, "--aov", "depth,normal", "--json")
    (view,) = run(capfd, "render", path, "--out", tmp_path / "views", *words).json["views"]
    asset = read(path)
    camera = find_camera(Path(view["file"]))
    passes = draw_passes(asset, camera, ("depth", "normal"), normals=normals_of(asset), surface=Surface.of(asset))
    assert passes.normal is not None
    stored = read_picture(Path(view["aov"]["normal"])).colors
    assert np.abs(stored - (0.5 + 0.5 * passes.normal)).max() < 0.51 / 255
    note = json.loads((tmp_path / "views" / "view_000.json").read_text())["aov"]["depth"]
    drawn = passes.alpha > 0
    np.testing.assert_allclose([note["near"], note["far"]], [passes.depth[drawn].min(), passes.depth[drawn].max()])
