"""What one view sees of a surface, and `render --aov normal,depth`, which shows it."""

import json
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import look_at
from splatpainter.image_files import find_camera
from splatpainter.io import read, write
from splatpainter.pictures.picture_reader import read_picture
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.surface.estimate import Surface, SurfacePoints
from splatpainter.surface.visible import VISIBLE, depths_along, visible_surface
from splatpainter.transforms import quat_to_matrix, turned
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


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_depths_along_lines_of_sight_are_those_of_the_formula(dtype: type):
    rng, count = np.random.default_rng(5), 300
    splats = sphere(count)
    values = {"quats": rng.normal(size=(count, 4)), "scales": np.exp(rng.normal(-3, 2, (count, 3)))}
    values |= {"means": splats.means, "opacities": splats.opacities, "sh": splats.sh}
    splats = replace(splats, **{name: np.asarray(value, dtype) for name, value in values.items()})
    camera = look_at([0.3, -0.5, 3], [0, 0, 0], width=64, height=48)
    ids, rays = rng.integers(0, count, 500), camera.sight_lines(rng.uniform(0, 48, (500, 2)))
    depth, width = depths_along(splats, ids, camera, rays)
    # As it was written in numpy.
    mean = camera.to_camera(splats.means[ids])
    axes = turned(camera.world_to_camera[:3, :3], quat_to_matrix(splats.quats[ids].astype(np.float64)))
    scales = splats.scales[ids].astype(np.float64)
    scales = np.maximum(scales, 1e-3 * scales.max(1, keepdims=True))
    along, offset = ((axes * vectors[:, :, None]).sum(1) / scales for vectors in (rays, mean))
    nearest = (along * offset).sum(1) / np.maximum((along**2).sum(1), 1e-300)
    reach, ordered = 2 * scales.max(1), np.sort(scales, 1)
    assert np.array_equal(depth, np.clip(nearest, mean[:, 2] - reach, mean[:, 2] + reach))
    assert np.array_equal(width, np.sqrt(ordered[:, 1] * ordered[:, 2]))


def test_lattice_points_have_pixels_near_their_middle_and_neighbours_on_their_plane():
    splats = sphere(2000)
    camera = look_at([0, 0, 3], [0, 0, 0], width=83, height=61)
    view, pixels = project(splats, camera), np.random.default_rng(1).random((61, 83)) < 0.7
    seen = visible_surface(Surface.of(splats), splats, view, pixels, 3)
    ys, xs = np.divmod(seen.estimates.pixels, 83)
    assert pixels[ys, xs].all() and np.array_equal(seen.index[ys // 3, xs // 3], np.arange(len(ys)))
    # A block's pixel is its middle wherever that was asked for and shows something.
    middles = (ys % 3 == 1) & (xs % 3 == 1)
    visible = pixels[1::3, 1::3] & (view.rasterize()[1][1::3, 1::3] > 0.6)
    assert middles[seen.index[: visible.shape[0], : visible.shape[1]][visible]].all() and 0.5 < middles.mean() < 1
    # Who is trusted has a neighbour on its plane.
    good = (seen.estimates.result.trust >= VISIBLE.min_trust) & (seen.points[:, 2] > 0)
    for at in range(len(ys)):
        y, x = np.argwhere(seen.index == at)[0]
        near = seen.index[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].ravel()
        near = near[(near >= 0) & (near != at)]
        near = near[good[near]]
        way, limit = (
            seen.points[near] - seen.points[at],
            VISIBLE.max_disagreement * np.minimum(seen.windows[near], seen.windows[at]),
        )
        close = (np.abs(way @ seen.normals[at]) < limit) & (np.abs((way * seen.normals[near]).sum(1)) < limit)
        assert seen.trusted[at] == (good[at] and close.sum() >= VISIBLE.min_agreeing)
    # Pixels that it was made for have what any place there has, bit for bit; so have others.
    for mask in (pixels, np.ones_like(pixels)):
        ids = np.flatnonzero(mask)
        centers = np.stack(np.divmod(ids, 83)[::-1], 1) + 0.5
        result, expected = seen.at_centers(ids), seen.at(centers)
        assert all(np.array_equal(getattr(result, f.name), getattr(expected, f.name)) for f in fields(result))
