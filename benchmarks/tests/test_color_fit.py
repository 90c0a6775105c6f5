"""Colour transfer: known maps are found again; the per-row fit is the dense least-squares answer; nothing leaks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splatbench.cases import Budget, EditStep, PosedImages
from splatbench.methods import EditTask, color_fit, unedited
from splatbench.methods.color_fit import (
    cluster_features,
    fit_affine,
    fit_clusters,
    fit_gaussians,
    kmeans,
    recolored,
    view_targets,
)

from splatpainter.cameras import Camera, look_at
from splatpainter.painter import Mode
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from tests.support.lift_scenes import SH_C0, back, bits, db, dense_weights, front, row, same_bits, sheet

BY_NAME = {method.name: method for method in (*color_fit.METHODS, *unedited.METHODS)}
WARM = np.array([[0.8, 0.1, 0.0], [0.05, 0.7, 0.1], [-0.1, 0.0, 0.6], [0.12, 0.06, 0.15]])
COLD = np.array([[0.5, 0.0, 0.1], [0.0, 0.6, 0.2], [0.1, 0.1, 0.9], [0.02, 0.05, 0.1]])


def mapped(splats: Splats, map: np.ndarray, chosen: np.ndarray) -> Splats:
    """Written out anew: every Gaussian's colour c(d) = 0.5 + sum_k Y_k(d) sh_k becomes (c, 1) @ map, for all d."""
    sh = splats.sh.astype(np.float64)
    for n in np.flatnonzero(chosen):
        sh[n] = sh[n] @ map[:3]
        sh[n, 0] += (0.5 * map[:3].sum(0) + map[3] - 0.5) / SH_C0
    return replace(splats, sh=sh.astype(np.float32))


def step(truth: Splats, cameras: list[Camera], mode: Mode = "global", masks: np.ndarray | None = None) -> EditStep:
    colors = render(truth, cameras).colors
    everywhere = np.ones(colors.shape[:3], bool)
    return EditStep(mode, "relight", PosedImages(tuple(cameras), colors), everywhere if masks is None else masks)


def work(asset: Splats, relit: EditStep) -> EditTask:
    return EditTask("relight", asset, relit.edited, relit)


def test_one_affine_map_is_found_again_and_acts_on_every_direction() -> None:
    asset = sheet(40, degree=2, opacity=0.6)  # half-transparent over grey: the background shows through
    cameras = [front(), look_at((1, 0.5, 3), (0, 0, 0), width=96, height=96, fov=42, background=(0.1, 0.6, 0.3))]
    truth = mapped(asset, WARM, np.ones(len(asset), bool))
    views = view_targets(asset, step(truth, cameras))
    assert views[0].use.mean() > 0.5
    np.testing.assert_allclose(fit_affine(views), WARM, atol=1e-3)
    done = BY_NAME["transfer-affine"].edit(work(asset, step(truth, cameras)), Budget())
    np.testing.assert_allclose(done.splats.sh, truth.sh, atol=1e-3 / SH_C0)
    other = look_at((-1.5, 1, 2), (0, 0, 0), width=64, height=64)
    seen, new = (project(splats, other) for splats in (asset, done.splats))
    np.testing.assert_allclose(new.unclamped_colors, seen.unclamped_colors @ WARM[:3] + WARM[3], atol=2e-3)
    assert done.setup_seconds == 0 and done.edit_seconds > 0 and done.keeps_gaussians


def test_a_grey_asset_has_an_answer_where_the_pictures_leave_it_open() -> None:
    asset = replace(sheet(30), sh=np.zeros((900, 1, 3), np.float32))
    truth = replace(asset, sh=np.full((900, 1, 3), 0.1 / SH_C0, np.float32))
    done = BY_NAME["transfer-affine"].edit(work(asset, step(truth, [front()])), Budget())
    np.testing.assert_allclose(done.splats.sh, truth.sh, atol=1e-3)


def test_pixels_outside_the_mask_and_beside_the_asset_are_not_learnt_from() -> None:
    asset = sheet(40, half=0.6)
    relit = step(mapped(asset, WARM, np.ones(len(asset), bool)), [front()])
    beside = render(asset, front()).alphas[0, ..., 0] < 0.1
    assert beside.sum() > 1000
    relit.edited.colors[0, beside] = (1, 0, 1)
    masks = np.ones((1, 96, 96), bool)
    masks[0, 48:] = False
    relit.edited.colors[0, 48:] = (0, 1, 0)
    np.testing.assert_allclose(fit_affine(view_targets(asset, replace(relit, masks=masks))), WARM, atol=1e-3)


def test_each_cluster_has_its_own_map_and_one_out_of_view_the_common_one() -> None:
    left = sheet(30, degree=1)
    asset = left.append(sheet(20, z=-0.5, degree=1))
    side = (asset.means[:, 0] > 0).astype(np.int64)
    labels = np.where(np.arange(len(asset)) < 900, side, 2)  # 0: left, 1: right, 2: a sheet behind
    truth = mapped(mapped(asset, WARM, labels == 0), COLD, labels == 1)
    far = front()
    views = view_targets(asset, step(truth, [far]))
    hidden = project(asset, far).backproject(views[0].target, views[0].use.astype(np.float32))
    assert (
        hidden.weight[project(asset, far).gaussian_ids >= 900].sum() > 0
    )  # it shines through: then it is no exception
    maps, _ = fit_clusters(views, labels, 1e-9)
    np.testing.assert_allclose(maps[0], WARM, atol=5e-3)
    np.testing.assert_allclose(maps[1], COLD, atol=5e-3)
    away = asset.take(np.arange(900)).append(replace(sheet(20, degree=1), means=sheet(20).means + (50, 0, 0)))
    away = replace(away, means=away.means.astype(np.float32))
    views = view_targets(away, step(mapped(mapped(away, WARM, labels == 0), COLD, labels == 1), [far]))
    maps, seen = fit_clusters(views, labels, 0.01)
    assert seen[2] == 0 and (seen[:2] > 100).all()
    np.testing.assert_allclose(maps[2], fit_affine(views), atol=1e-12)
    stiff, _ = fit_clusters(views, labels, 1e9)
    np.testing.assert_allclose(stiff, np.stack([fit_affine(views)] * 3), atol=1e-5)


def test_clusters_beat_one_map_where_light_falls_from_a_side() -> None:
    asset = sheet(40)
    truth = mapped(mapped(asset, WARM, asset.means[:, 0] < 0), COLD, asset.means[:, 0] >= 0)
    given = work(asset, step(truth, [front()]))
    view = look_at((0.6, 0.4, 2.8), (0, 0, 0), width=96, height=96, fov=42, background=(0.5, 0.5, 0.5))
    shows = {name: BY_NAME[name].edit(given, Budget()).splats for name in BY_NAME}
    scores = {name: db(render(s, view).colors, render(truth, view).colors) for name, s in shows.items()}
    assert scores["transfer-affine"] > scores["nothing"] + 3
    assert scores["transfer-clusters"] > scores["transfer-affine"] + 3
    assert scores["transfer-rows"] > scores["transfer-affine"] + 3


def test_kmeans_finds_blobs_alike_for_alike_seeds_and_makes_no_more_clusters_than_rows_differ() -> None:
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 5, 400)
    blobs = (rng.normal(0, 3, (5, 9))[truth] + rng.normal(0, 0.05, (400, 9))).astype(np.float32)
    labels = kmeans(blobs, 5, seed=3)
    pairs = {(int(a), int(b)) for a, b in zip(truth, labels, strict=True)}
    assert len(pairs) == 5 and len({b for _, b in pairs}) == 5
    assert np.array_equal(labels, kmeans(blobs, 5, seed=3))
    assert kmeans(blobs[[0, 0, 0, 1, 1]], 4, seed=0).max() == 1
    from scipy.cluster.vq import kmeans2

    cloud = rng.uniform(size=(600, 9)).astype(np.float32)
    ours = kmeans(cloud, 12, seed=0)
    theirs = kmeans2(cloud, 12, minit="++", rng=0)[1]
    spread = [sum(((cloud[l == k] - cloud[l == k].mean(0)) ** 2).sum() for k in np.unique(l)) for l in (ours, theirs)]
    assert spread[0] < 1.05 * spread[1]


def test_cluster_features_are_scaled_alike_and_undrawable_rows_are_in_the_middle() -> None:
    asset = sheet(20)
    broken = replace(asset, scales=np.where(np.arange(400)[:, None] == 7, 0, asset.scales).astype(np.float32))
    features = cluster_features(broken)
    assert (features[7] == 0).all()
    rest = np.delete(features, 7, 0)
    for group in (rest[:, :3], rest[:, 3:6], rest[:, 6:]):
        np.testing.assert_allclose((group**2).sum(1).mean(), 1, rtol=1e-3)
    assert (rest[:, 6:8] == 0).all()  # a flat sheet faces +z or -z


def tiny(degree: int) -> Splats:
    """Five overlapping Gaussians before the origin and one behind both cameras."""
    rng = np.random.default_rng(4)
    asset = None
    for mean in [(-0.3, 0, 0), (0.2, 0.1, 0.2), (0, -0.3, -0.2), (0.1, 0.3, 0.1), (-0.1, 0.1, 0.3), (0, 0, 20)]:
        one = row(mean, rng.uniform(0.15, 0.3, 3), rng.uniform(0.4, 0.6, 3), opacity=rng.uniform(0.5, 0.95), degree=1)
        asset = one if asset is None else asset.append(one)
    assert asset is not None
    sh = asset.sh[:, : (degree + 1) ** 2].copy()
    sh[:, 1:] = rng.normal(0, 0.05, sh[:, 1:].shape)
    return replace(asset, sh=sh)


def basis(means: np.ndarray, eye: np.ndarray, count: int) -> np.ndarray:
    x, y, z = ((means - eye) / np.linalg.norm(means - eye, axis=1, keepdims=True)).T
    c1 = np.sqrt(3 / (4 * np.pi))
    return np.stack([np.full(len(x), SH_C0), -c1 * y, c1 * z, -c1 * x], 1)[:, :count]


@pytest.mark.parametrize(("degree", "rounds", "damping"), [(0, 1, 100.0), (1, 1, 0.05), (1, 4, 0.5), (1, 3, 100.0)])
def test_rows_are_the_dense_least_squares_solution(degree: int, rounds: int, damping: float) -> None:
    asset = tiny(degree)
    size, count = 24, (degree + 1) ** 2
    cameras = [look_at(eye, (0, 0, 0), width=size, height=size, fov=24) for eye in [(0, 0, 3), (1.5, 0.4, 2.5)]]
    rng = np.random.default_rng(8)
    targets = np.clip(render(asset, cameras).colors + rng.uniform(-0.1, 0.3, (2, size, size, 3)), 0, 1)
    targets = targets.astype(np.float32)
    relit = EditStep("global", "relight", PosedImages(tuple(cameras), targets), np.ones((2, size, size), bool))
    views = [replace(view, use=np.ones((size, size), bool)) for view in view_targets(asset, relit)]

    inside = asset.take(np.arange(5))
    dense = [dense_weights(inside, camera) for camera in cameras]
    towards = [basis(inside.means.astype(np.float64), camera.position, count) for camera in cameras]
    start = inside.sh.astype(np.float64)
    sh, errors = start.copy(), []
    for _ in range(rounds):
        colors = [0.5 + np.einsum("nk,nkj->nj", b, sh) for b in towards]
        residuals = [targets[v].reshape(-1, 3) - dense[v][0].T @ colors[v] for v in range(2)]
        errors.append(sum((r**2).sum() for r in residuals))
        new = sh.copy()
        for i in range(5):
            total = sum(dense[v][0][i].sum() for v in range(2))
            rows, wishes = [], []
            for v in range(2):
                root = np.sqrt(dense[v][0][i])[:, None]
                rows.append(root * towards[v][i])
                wishes.append(root * residuals[v])
            strength = np.sqrt(total * damping) * SH_C0 * np.eye(count)[1:]
            rows.append(strength)
            wishes.append(-strength @ (sh[i] - start[i]))
            new[i] += np.linalg.lstsq(np.concatenate(rows), np.concatenate(wishes), rcond=None)[0]
        sh = new
    fitted, seen = fit_gaussians(asset, views, rounds, damping, degree)
    assert seen.tolist() == [True] * 5 + [False]
    np.testing.assert_allclose(fitted.sh[:5], sh, atol=2e-4)
    assert np.abs(fitted.sh[:5] - asset.sh[:5]).max() > 0.05
    assert np.array_equal(bits(fitted.sh[5]), bits(asset.sh[5]))
    assert errors == sorted(errors, reverse=True)


def test_rows_out_of_view_keep_their_bits_and_no_sh_band_beyond_the_degree_moves() -> None:
    asset = sheet(30, degree=2).append(sheet(30, z=-1.5, degree=2))
    truth = mapped(asset, WARM, np.ones(len(asset), bool))
    relit = step(truth, [front()])
    fitted, seen = fit_gaussians(asset, view_targets(asset, relit), 3, 1.0, 1)
    assert seen.any() and not seen.all()
    assert np.array_equal(bits(fitted.sh[~seen]), bits(asset.sh[~seen]))
    assert np.array_equal(bits(fitted.sh[:, 4:]), bits(asset.sh[:, 4:]))
    assert fitted.means is asset.means and fitted.opacities is asset.opacities
    before, after = (db(render(s, front()).colors[0], relit.edited.colors[0]) for s in (asset, fitted))
    assert after > before + 10
    hidden = db(render(fitted, back()).colors[0], render(asset, back()).colors[0])
    assert hidden > 20


@pytest.mark.parametrize("name", ["transfer-affine", "transfer-clusters", "transfer-rows"])
def test_undrawable_rows_keep_their_bits(name: str) -> None:
    asset = sheet(24, degree=1)
    sh = asset.sh.copy()
    sh[5] = np.nan
    asset = replace(asset, sh=sh)
    rest = asset.take(np.arange(len(asset)) != 5)
    relit = step(mapped(rest, WARM, np.ones(len(rest), bool)), [front()])
    done = BY_NAME[name].edit(work(asset, relit), Budget())
    assert np.array_equal(bits(done.splats.sh[5]), bits(asset.sh[5]))
    assert np.isfinite(np.delete(done.splats.sh, 5, 0)).all()


@pytest.mark.parametrize("name", ["transfer-affine", "transfer-clusters", "transfer-rows"])
def test_what_cannot_be_done_is_said_in_one_line(name: str) -> None:
    asset = sheet(20)
    with pytest.raises(ValueError, match="is for global edits, got a local one"):
        BY_NAME[name].edit(work(asset, step(asset, [front()], "local")), Budget())
    nowhere = np.zeros((1, 96, 96), bool)
    with pytest.raises(ValueError, match="no masked pixel shows the asset"):
        BY_NAME[name].edit(work(asset, step(asset, [front()], masks=nowhere)), Budget())
    method = BY_NAME[name]
    assert method.protocols == ("relight",) and method.missing(Budget()) == "" and method.version(Budget())


def test_nothing_is_nothing() -> None:
    asset = sheet(10)
    done = BY_NAME["nothing"].edit(work(asset, step(asset, [front()])), Budget())
    assert same_bits(done.splats, asset) and done.setup_seconds == done.edit_seconds == 0
    assert recolored(asset, np.eye(4)[None, :, :3]).sh.dtype == np.float32
