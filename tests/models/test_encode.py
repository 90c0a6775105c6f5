"""From an asset to latents: where canonical views stand, what they show, which Gaussian gets which latent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatpainter.models.config import LrmConfig
from splatpainter.models.encode import asset_views, canonical_cameras, encode_asset
from splatpainter.models.gaussian_groups import links_from_views
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.voxels.grid import bounding_cube, voxelize
from tests.models.test_edit_propagation import CARRYING
from tests.support.lift_scenes import dense_weights
from tests.support.model_scenes import TINY, with_refine
from tests.support.painter_scenes import ASSET_BASE, COPY, DRAWABLE, built, thing, uneven


@pytest.mark.parametrize("count", [1, 2, 8, 9, 16])
def test_canonical_cameras_see_the_asset_from_all_sides(count: int) -> None:
    splats = thing()
    config = LrmConfig(views=count, image_size=64)
    cameras = canonical_cameras(splats, config)
    assert len(cameras) == count and cameras == canonical_cameras(splats, config)
    lo, size = bounding_cube(splats)
    middle = lo + size / 2
    away = np.stack([camera.position - middle for camera in cameras])
    unit = away / np.linalg.norm(away, axis=1, keepdims=True)
    assert np.abs(unit[:, 1]).max() <= np.sin(np.radians(60)) + 1e-9  # none from straight above or below
    # A ball of the cube's size is inside every picture: its silhouette's sine is radius / distance.
    for camera, offset in zip(cameras, away, strict=True):
        assert (camera.width, camera.height) == (64, 64)
        edge = np.arctan(32 / camera.fy)
        assert np.arcsin(size / 2 / np.linalg.norm(offset)) < edge
        np.testing.assert_allclose(camera.forward, -offset / np.linalg.norm(offset), atol=1e-9)
        assert camera.world_to_camera[1, 1] > 0  # y of the world points down in the picture, as in the files
    if count >= 8:
        # Of any direction within their reach, some camera is near: no side of the asset is left out.
        rng = np.random.default_rng(0)
        points = rng.normal(size=(500, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        points = points[np.abs(points[:, 1]) < np.sin(np.radians(60))]
        assert np.degrees(np.arccos((points @ unit.T).max(1))).max() < 62
        assert (unit @ unit.T - 2 * np.eye(count)).max() < np.cos(np.radians(30))


def test_canonical_cameras_move_with_the_asset() -> None:
    splats = thing()
    moved = replace(splats, means=splats.means * 3 + np.array([10, -4, 2], np.float32), scales=splats.scales * 3)
    for one, two in zip(*(canonical_cameras(s, TINY.lrm) for s in (splats, moved)), strict=True):
        np.testing.assert_allclose(two.position, one.position * 3 + [10, -4, 2], rtol=1e-5, atol=1e-5)


def test_views_are_the_render_and_contributions_its_weights() -> None:
    some = thing().take(np.arange(880, DRAWABLE))
    grid = voxelize(some)
    cameras = canonical_cameras(some, LrmConfig(views=2, image_size=24))
    views, contributions = asset_views(some, cameras, grid)
    assert views.half_extent == grid.extent / 2 and contributions.shape == (2, len(some))
    assert views.depth is not None and views.alpha is not None
    for view, camera in enumerate(cameras):
        weights, left = dense_weights(some, camera)
        np.testing.assert_allclose(contributions[view], weights.sum(1), rtol=2e-3, atol=2e-2)
        alpha = 1 - left.reshape(24, 24)
        np.testing.assert_allclose(views.alpha[view, ..., 0].numpy(), alpha, atol=2e-3)
        z = (some.means @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3])[:, None]
        depth = (weights * z).sum(0).reshape(24, 24) / np.maximum(alpha, 1e-9)
        solid = alpha > 0.5
        np.testing.assert_allclose(views.depth[view, ..., 0].numpy()[solid], depth[solid], rtol=1e-3)
    assert float(views.colors.min()) >= 0 and float(views.colors.max()) <= 1


@torch.no_grad()
def test_a_native_encoding_is_lrm_links_and_stage_one_of_the_gaussians() -> None:
    splats, model = thing(), built()
    encoded = encode_asset(model, splats)
    assert all(
        np.array_equal(getattr(encoded.gaussians.numpy(), n), getattr(splats, n), equal_nan=True) for n in ATTRIBUTES
    )
    # The Gaussians that cannot be drawn have no latent, all others have one.
    assert (encoded.latent_ids[:DRAWABLE] >= 0).all() and (encoded.latent_ids[DRAWABLE:] == -1).all()
    assert (encoded.latents.groups.order[encoded.latent_ids[:DRAWABLE]] == np.arange(DRAWABLE)).all()
    # By hand, of the drawable Gaussians alone.
    some = splats.take(np.arange(DRAWABLE))
    grid = voxelize(some, TINY.compress.resolution)
    cameras = canonical_cameras(some, TINY.lrm)
    views, contributions = asset_views(some, cameras, grid)
    links = links_from_views(some.means, cameras, contributions, TINY.lrm.patch)
    latents = model.compressor(model.lrm.encode(views), some.torch(), links, model.groups(grid))
    ours, theirs = torch.empty(2, DRAWABLE, TINY.compress.dim).unbind()
    ours[encoded.latents.groups.order], theirs[latents.groups.order] = encoded.latents.values, latents.values
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
    # A grid at hand is used, one of another resolution is not.
    for grid in (voxelize(splats, TINY.compress.resolution), voxelize(splats)):
        assert torch.equal(encode_asset(model, splats, grid).latents.values, encoded.latents.values)
    assert encode_asset(model, splats, dtype=torch.float16).latents.values.dtype == torch.float16


@torch.no_grad()
def test_permuting_the_gaussians_permutes_their_latents() -> None:
    splats, model = uneven(), built()
    turn = np.random.default_rng(3).permutation(len(splats))
    one, two = encode_asset(model, splats), encode_asset(model, splats.take(turn))
    encoded = one.latent_ids[turn] >= 0
    assert (encoded == (two.latent_ids >= 0)).all()
    torch.testing.assert_close(
        two.latents.values[two.latent_ids[encoded]],
        one.latents.values[one.latent_ids[turn][encoded]],
        rtol=1e-3,
        atol=1e-4,
    )


@torch.no_grad()
def test_copy_becomes_what_stage_one_decodes() -> None:
    splats, model = thing(), built(COPY)
    encoded = encode_asset(model, splats)
    count = len(encoded.gaussians)
    assert encoded.latent_ids.tolist() == list(range(count)) and len(encoded.latents.values) == count
    # Untrained: the most opaque quarter of the LRM's Gaussians of each voxel, bit for bit.
    grid = voxelize(splats, COPY.compress.resolution)
    views, _ = asset_views(splats, canonical_cameras(splats, COPY.lrm), grid)
    gaussians = model.lrm(views).splats.numpy()
    gaussians = gaussians.take(gaussians.opacities > COPY.compress.min_opacity)
    copy_grid = voxelize(gaussians, COPY.compress.resolution)
    survivors = [
        copy_grid.order[a + k]
        for a, b in zip(copy_grid.starts[:-1], copy_grid.starts[1:], strict=True)
        for k in range(max((b - a) // 4, 1))
    ]

    def listed(splats: Splats) -> set[bytes]:
        return {b"".join(getattr(splats, name)[i].tobytes() for name in ATTRIBUTES) for i in range(len(splats))}

    assert count == len(survivors) and listed(encoded.gaussians.numpy()) == listed(gaussians.take(np.array(survivors)))
    cell = encoded.latents.groups
    assert (np.abs(encoded.gaussians.means.numpy() - cell.gaussian_centers()) <= cell.voxel * 0.5001).all()


def test_gradients_are_there_where_torch_has_them() -> None:
    model = built(ASSET_BASE)
    encoded = encode_asset(model, thing())
    encoded.latents.values.sum().backward()
    assert all(p.grad is not None for p in [*model.compressor.parameters(), *model.lrm.blocks.parameters()])
    with torch.no_grad():
        assert not encode_asset(model, thing()).latents.values.requires_grad


def test_nothing_to_draw_is_one_line() -> None:
    nothing = thing().take(np.arange(DRAWABLE, DRAWABLE + 2))
    with pytest.raises(ValueError, match="at least one Gaussian that can be drawn"):
        encode_asset(built(), nothing)


def test_a_model_without_lrm_and_stage_one_looks_at_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither network is there, no picture is drawn, and its latents take no room; every Gaussian that can be drawn has
    one."""
    monkeypatch.setattr("splatpainter.models.encode.asset_views", lambda *_: pytest.fail("drawn"))
    model, splats = built(with_refine(CARRYING, latents=False)), thing()
    assert model.encoders == () and not any(k.startswith(("lrm.", "compressor.")) for k in model.state_dict())
    encoded = encode_asset(model, splats)
    values = encoded.latents.values
    assert values.shape == (splats.drawable.sum(), model.config.compress.dim) and not values.any()
    assert values.untyped_storage().nbytes() == 4 * model.config.compress.dim
    np.testing.assert_array_equal(encoded.latent_ids >= 0, splats.drawable)
    # Places are told in the asset's cube, as they are beside latents.
    np.testing.assert_allclose(encoded.latents.groups.half_extent, bounding_cube(splats)[1] / 2)
