"""Lifted edits: which Gaussians an edit may change, their features, and how the network's answer becomes an asset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpainter.io import read, write
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.edits import LiftedEdit, lift_global_views, lift_local_views
from splatpainter.lift.global_edit import lift_global
from splatpainter.lift.local.local_edit import lift_local
from splatpainter.models.apply_edit import assemble, refine_edit
from splatpainter.models.encode import Encoded, encode_asset
from splatpainter.painter import Edit
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.voxels.grid import voxelize
from splatpainter.voxels.raycast import editable_gaussians
from tests.support.lift_scenes import base_colors, bits, dense_weights, differing, disk, front, same_bits
from tests.support.painter_scenes import (
    ASSET_BASE,
    BLUE,
    CAMERA,
    COPY,
    DRAWABLE,
    FRONT,
    GREEN,
    LIFT,
    REAR,
    RED,
    built,
    dab,
    thing,
)

SPLATS = thing()
GRID = voxelize(SPLATS)


def views_of(*edits: Edit, splats: Splats = SPLATS) -> list[EditView]:
    masks = [edit.mask for edit in edits if edit.mask is not None]
    return edit_views(splats, [edit.camera for edit in edits], [edit.image for edit in edits], masks)


def views_here() -> list[EditView]:
    return views_of(dab(SPLATS, RED))


def encoded_by(model) -> Encoded:  # noqa: ANN001
    with torch.no_grad():
        return encode_asset(model, SPLATS)


# Drafts


def test_own_gaussians_are_those_that_make_the_edited_pixels() -> None:
    (view,) = views_here()
    edit = lift_local_views(SPLATS, GRID, [view], "own")
    assert edit.splats is SPLATS and edit.detail and edit.confidence is None
    assert edit.parents.tolist() == edit.ids.tolist() == sorted(set(edit.ids.tolist()))
    weights, _ = dense_weights(SPLATS.take(np.arange(DRAWABLE)), CAMERA)
    inside = weights[:, view.mask.ravel()]
    total = inside.sum(1)
    chosen = np.zeros(DRAWABLE, bool)
    chosen[edit.ids] = True
    assert total[chosen].sum() > 0.98 * total.sum()
    assert inside[chosen].max(1).min() > 0.003  # each one contributes
    assert not chosen[FRONT:].any()  # the sheet behind is hidden
    # The features: colour before, colour after, and how many pixels of it were edited.
    np.testing.assert_allclose(edit.features[:, :3], base_colors(SPLATS)[edit.ids], atol=1e-5)
    np.testing.assert_allclose(edit.features[:, 6], total[chosen] / (total[chosen] + 2), rtol=5e-3, atol=1e-3)
    well = total[chosen] > 0.8 * weights[chosen].sum(1)
    before, after = (np.abs(edit.features[well, a : a + 3] - RED).mean() for a in (0, 3))
    assert after < 0.35 * before


def test_a_lifted_edit_is_the_lift_with_everything_that_it_changed() -> None:
    (view,) = views_here()
    edit = lift_local_views(SPLATS, GRID, [view], "lift")
    lifted = lift_local(
        SPLATS, CAMERA, view.edited, view.mask, allowed=editable_gaussians(GRID, SPLATS, CAMERA, view.mask)
    )
    assert same_bits(edit.splats, lifted.splats) and not edit.detail
    appended = np.arange(len(SPLATS), len(lifted.splats))
    assert len(appended) > 5
    assert edit.ids.tolist() == [*lifted.touched, *appended]
    assert edit.parents.tolist() == [*lifted.touched, *lifted.parents]
    assert edit.parent_ids(len(SPLATS)).tolist() == [*range(len(SPLATS)), *lifted.parents]
    np.testing.assert_allclose(edit.features[:, :3], base_colors(SPLATS)[edit.parents].clip(0, 1), atol=1e-5)
    np.testing.assert_allclose(edit.features[:, 3:6], base_colors(lifted.splats)[edit.ids].clip(0, 1), atol=1e-5)
    weights, _ = dense_weights(lifted.splats.take(lifted.splats.drawable), CAMERA)
    total = np.zeros(len(lifted.splats))
    total[lifted.splats.drawable] = weights[:, view.mask.ravel()].sum(1)
    np.testing.assert_allclose(edit.features[:, 6], (total / (total + 2))[edit.ids], rtol=2e-2, atol=2e-3)


def test_gaussians_of_a_second_view_are_traced_to_the_asset() -> None:
    views = views_of(dab(SPLATS, RED, 28), dab(SPLATS, BLUE, 36), dab(SPLATS, GREEN, camera=REAR))
    edit = lift_local_views(SPLATS, GRID, views, "lift")
    parents = SPLATS.take(edit.parents)
    away = np.linalg.norm(edit.splats.means[edit.ids] - parents.means, axis=1)
    assert (away < 4 * parents.scales.max(1)).all()  # a child lies inside its parent
    assert (edit.parents < DRAWABLE).all() and (edit.parents >= FRONT).any()
    assert set(np.flatnonzero(differing(SPLATS, edit.splats))) == set(edit.ids[edit.ids < len(SPLATS)])
    picture = render(edit.splats, CAMERA).colors[0]
    both = disk(CAMERA, 28, 32, 6) & disk(CAMERA, 36, 32, 6)
    assert np.abs(picture[both] - BLUE).mean() < 0.1  # the latest wins
    lifted = lift_local_views(SPLATS, GRID, views, "own")
    alone = [lift_local_views(SPLATS, GRID, [view], "own").ids for view in views]
    assert lifted.ids.tolist() == sorted(set(np.concatenate(alone).tolist()))


@pytest.mark.parametrize("base", ["own", "lift"])
def test_a_global_edit_holds_every_gaussian_that_can_be_drawn(base) -> None:  # noqa: ANN001
    (view,) = views_of(Edit(1 - render(SPLATS, CAMERA).colors[0].clip(0, 1), CAMERA, np.ones((64, 64))))
    edit = lift_global_views(SPLATS, [view], base)
    lifted = lift_global(SPLATS, [(CAMERA, view.edited, view.mask)])
    assert same_bits(edit.splats, lifted.splats if base == "lift" else SPLATS)
    assert edit.ids.tolist() == edit.parents.tolist() == list(range(DRAWABLE)) and not edit.detail
    np.testing.assert_array_equal(edit.confidence, lifted.confidence)
    np.testing.assert_array_equal(edit.features[:, 6], lifted.seen[:DRAWABLE])
    np.testing.assert_allclose(edit.features[:, 7:10], lifted.predicted[:DRAWABLE].clip(0, 1), atol=1e-6)
    np.testing.assert_array_equal(edit.features[:, 10:], lifted.normals[:DRAWABLE])
    np.testing.assert_allclose(edit.features[:, 3:6], base_colors(lifted.splats)[:DRAWABLE].clip(0, 1), atol=1e-5)


def test_edits_without_features_are_the_same_but_for_them() -> None:
    views = views_here()
    for base in ("own", "lift"):
        full, bare = (lift_local_views(SPLATS, GRID, views, base, features=on) for on in (True, False))
        assert same_bits(full.splats, bare.splats) and full.ids.tolist() == bare.ids.tolist()
        assert full.features.any() and not bare.features.any()
    assert lift_global_views(SPLATS, views, "own", features=False).confidence is None


def test_an_edit_that_reaches_nothing_is_named() -> None:
    views = views_of(dab(SPLATS, RED), Edit(np.zeros((64, 64, 3)), CAMERA, disk(CAMERA, 0.5, 0.5, 0.6)))
    views = [views[0], replace(views[1], name="bad.png")]
    for base in ("own", "lift"):
        with pytest.raises(ValueError, match=r"^bad\.png: no Gaussian"):
            lift_local_views(SPLATS, GRID, views, base)


# What the network makes of them


@pytest.mark.parametrize("config", [ASSET_BASE, LIFT], ids=["own", "lift"])
@torch.no_grad()
def test_an_untrained_network_returns_the_lifted_edit_bit_for_bit(config) -> None:  # noqa: ANN001
    model, views = built(config), views_here()
    base = config.refine.base
    for edit in (lift_local_views(SPLATS, GRID, views, base), lift_global_views(SPLATS, views, base)):
        _, edited, further = refine_edit(model, model.initial_state(), encoded_by(model), edit, views)
        assert further is None and same_bits(edited.numpy(), edit.splats.take(edit.ids))
        assert assemble(edit, edited, further) is edit.splats


@torch.no_grad()
def test_each_gaussian_is_a_residual_on_its_lift_from_its_own_latent() -> None:
    model, views = built(LIFT, awake=0.05), views_here()
    encoded, edit = encoded_by(model), lift_local_views(SPLATS, GRID, views_here(), "lift")
    state, edited, further = refine_edit(model, model.initial_state(), encoded, edit, views)
    assert further is None and len(edited) == len(edit.ids)
    # Another order of the Gaussians is another order of the answers.
    turn = np.random.default_rng(0).permutation(len(edit.ids))
    turned = replace(edit, ids=edit.ids[turn], parents=edit.parents[turn], features=edit.features[turn])
    again, other, _ = refine_edit(model, model.initial_state(), encoded, turned, views)
    for name in ATTRIBUTES:
        torch.testing.assert_close(getattr(other, name), getattr(edited, name)[turn], rtol=1e-4, atol=1e-5)
    for one, two in zip(state.blocks, again.blocks, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))
    # Gaussians that differ only in what the lift made of them get the same residual: one parent, features and place.
    j = int(np.flatnonzero(edit.ids >= len(SPLATS))[0])
    twice = replace(edit, ids=edit.ids[[j, j]], parents=edit.parents[[j, j]], features=edit.features[[j, j]])
    colored = replace(edit.splats, sh=edit.splats.sh + np.float32(0.25))
    answers = [
        refine_edit(model, model.initial_state(), encoded, replace(twice, splats=splats), views)[1]
        for splats in (edit.splats, colored)
    ]
    torch.testing.assert_close(answers[0].sh[0], answers[0].sh[1])
    torch.testing.assert_close(answers[1].sh - answers[0].sh, torch.full_like(answers[0].sh, 0.25))
    # Where in its parent a Gaussian lies, its features, and whose latent it reads all matter.
    elsewhere = replace(edit.splats, means=edit.splats.means + np.float32(0.1))
    changes = (
        replace(twice, splats=elsewhere),
        replace(twice, features=1 - twice.features),
        replace(twice, parents=twice.parents * 0 + 3),
    )
    for changed in changes:
        edited = refine_edit(model, model.initial_state(), encoded, changed, views)[1]
        assert not torch.allclose(edited.sh, answers[0].sh, atol=1e-4)


@torch.no_grad()
def test_in_chunks_and_with_the_second_set(monkeypatch: pytest.MonkeyPatch) -> None:
    model, views = built(ASSET_BASE, awake=0.05), views_here()
    encoded, edit = encoded_by(model), lift_local_views(SPLATS, GRID, views_here(), "own")
    complete = refine_edit(model, model.initial_state(), encoded, edit, views)
    for constant in ("model.LATENTS_PER_CHUNK", "refine.LATENTS_PER_CHUNK", "compress.GAUSSIANS_PER_CHUNK"):
        monkeypatch.setattr(f"splatpainter.models.{constant}", 16)
    parts = refine_edit(model, model.initial_state(), encoded, edit, views)
    assert complete[2] is not None and parts[2] is not None and len(parts[2]) == len(edit.ids) > 32
    for one, two in zip(complete[1:], parts[1:], strict=True):
        assert one is not None and two is not None
        for name in ATTRIBUTES:
            torch.testing.assert_close(getattr(two, name), getattr(one, name), rtol=1e-3, atol=1e-4)
    asset = assemble(edit, parts[1], parts[2])
    assert len(asset) == len(SPLATS) + len(edit.ids)
    assert set(np.flatnonzero(differing(SPLATS, asset))) <= set(edit.ids)


def test_gradients_reach_every_network() -> None:
    model, views = built(LIFT, awake=0.05), views_here()
    edit = lift_local_views(SPLATS, GRID, views, "lift")
    _, edited, further = refine_edit(model, model.initial_state(), encode_asset(model, SPLATS), edit, views)
    asset = assemble(edit, edited, further)
    assert isinstance(asset.means, torch.Tensor) and len(asset) == len(edit.splats)
    picture = render(asset, CAMERA).colors[0]
    ((picture - torch.from_numpy(views[0].target)) ** 2).mean().backward()
    parts = (model.head.linear, model.refiner.lift, model.refiner.drift, model.refiner.blocks, model.compressor)
    assert all(any(p.grad is not None and bool(p.grad.any()) for p in part.parameters()) for part in parts)
    # The same asset as without gradients.
    with torch.no_grad():
        _, plain, _ = refine_edit(model, model.initial_state(), encoded_by(model), edit, views)
        fixed = assemble(edit, plain, None)
    for name in ATTRIBUTES:
        same = getattr(asset, name).detach().numpy()
        np.testing.assert_allclose(getattr(fixed, name)[:DRAWABLE], same[:DRAWABLE], rtol=1e-3, atol=1e-4)


@torch.no_grad()
def test_a_copy_gets_only_what_the_edit_changed() -> None:
    """Its Gaussians hold what Stage I's decoder said already: an edit without strength must leave them where they
    are."""
    model = built(COPY, awake=0.05)
    encoded = encode_asset(model, SPLATS)
    asset = encoded.gaussians.numpy()
    views = views_of(Edit(np.full((64, 64, 3), 0.5), CAMERA, np.ones((64, 64), bool)), splats=asset)
    edit = lift_global_views(asset, views, "own")
    for name, weight in model.refiner.named_parameters():  # blocks that add nothing to a latent
        if name.endswith(("ttt.out.weight", "mlp_rows.outer.weight")):
            torch.nn.init.zeros_(weight)
    _, edited, _ = refine_edit(model, model.initial_state(), encoded, edit, views)
    assert same_bits(edited.numpy(), asset.take(edit.ids))


# Assets again


def test_assemble_keeps_every_bit_that_did_not_change() -> None:
    means = SPLATS.means.copy()
    means[:, 2] = np.where(np.arange(len(means)) % 2, -0.0, 0.0)  # two zeros
    splats = replace(SPLATS, means=means, origin=np.arange(len(SPLATS)))
    index = np.array([4, 9, 2])
    edit = LiftedEdit(splats, index, index, np.zeros((3, 13), np.float32), detail=True)
    edited = splats.take(index).torch()
    edited = replace(edited, sh=edited.sh + 1)
    asset = assemble(edit, edited, edited)
    assert asset.means is not splats.means and asset.origin is not None  # Gaussians were appended
    assert asset.origin.tolist() == [*range(len(splats)), *index]
    assert np.flatnonzero(differing(splats, asset)).tolist() == sorted(index)
    assert assemble(edit, edited, None).means is splats.means
    assert (bits(asset.means[: len(splats)]) == bits(means)).all()
    np.testing.assert_array_equal(asset.sh[index], splats.sh[index] + 1)
    learning = replace(edited, sh=edited.sh.clone().requires_grad_(True))
    asset = assemble(edit, learning, learning)
    asset.sh.sum().backward()
    assert learning.sh.grad is not None and (learning.sh.grad == 2).all()
    assert np.array_equal(asset.sh.detach().numpy(), assemble(edit, edited, edited).sh, equal_nan=True)


def test_what_cannot_be_refined_is_one_line() -> None:
    model, views = built(), views_here()
    edit = lift_local_views(SPLATS, GRID, views, "own")
    encoded = encoded_by(model)
    other = edit_views(SPLATS, [front(32)], [np.zeros((32, 32, 3))], [np.ones((32, 32), bool)])
    cases = [
        ([*views, *other], edit, "pictures of one size, got 32x32, 64x64"),
        (views * 17, edit, "1 to 16 pictures, got 17"),
        ([replace(views[0], depth=None)], edit, "'geometry' channels"),
        (views, replace(edit, parents=edit.parents * 0 + DRAWABLE), "were not encoded"),
    ]
    for views_given, options, pattern in cases:
        with pytest.raises(ValueError, match=pattern) as error:
            refine_edit(model, model.initial_state(), encoded, options, views_given)
        assert "\n" not in str(error.value)


@torch.no_grad()
def test_gaussians_of_a_file_keep_their_origin(tmp_path: Path) -> None:
    write(tmp_path / "a.ply", SPLATS)
    file = read(tmp_path / "a.ply")
    views = views_of(dab(file, RED), splats=file)
    for awake in (0.0, 0.05):
        model = built(ASSET_BASE, awake=awake)
        edit = lift_local_views(file, voxelize(file), views, "own")
        _, edited, further = refine_edit(model, model.initial_state(), encode_asset(model, file), edit, views)
        asset = assemble(edit, edited, further)
        assert (further is None) == (awake == 0.0)
        children = [] if further is None else edit.ids.tolist()  # they carry their parent's bytes
        assert asset.source is file.source and asset.origin is not None
        assert asset.origin.tolist() == [*range(len(file)), *children]
