"""Tab. 1 and 2: what their cases are made of, and that scores tell a perfect answer from none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from splatbench import ground_truth
from splatbench.cases import Case, Setup
from splatbench.ground_truth import SURFEL_SH_DEGREE, GroundTruth, build_asset
from splatbench.methods import EditResult
from splatbench.objects import environments, objects
from splatbench.scoring import object_masks, rendered
from splatbench.tables import local_refinement as refine
from splatbench.tables import relighting as relight
from splatbench.tables import table

from splatpainter.splats import Splats
from splattrain.data import viewpoints
from splattrain.data.lights import shade
from splattrain.data.surfels import to_splats

SETUP = Setup(
    objects=2, size=40, detail=3, truth="surfels", base_views=5, rows=800, asset_steps=12, novel_views=4, lights=2
)


@pytest.fixture(scope="module", autouse=True)
def few() -> Iterator[None]:
    """Coarser surfels, for speed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ground_truth, "MIN_SURFELS", 6000)
        yield


@lru_cache(maxsize=1)
def refined() -> Case:
    protocol = table("refine")
    return protocol.make(protocol.keys(SETUP)[0], SETUP)


@lru_cache(maxsize=2)
def truth_of(name: str, light: str) -> GroundTruth:
    return GroundTruth.load(name, light, SETUP)


def dense(case: Case, light: str) -> Splats:
    """The truth itself, as an asset."""
    truth = truth_of(case.name, light)
    assert truth.surfels is not None
    return to_splats(truth.surfels, shade(truth.surfels, truth.light, SURFEL_SH_DEGREE)).numpy()


def same(one: Case, other: Case) -> bool:
    pairs = [(one.base, other.base), (one.after, other.after), (one.steps[0].edited, other.steps[0].edited)]
    return all(np.array_equal(a.colors, b.colors) for a, b in pairs) and np.array_equal(one.asset.sh, other.asset.sh)


# Refine


def test_refine_has_a_case_per_object_in_one_light() -> None:
    keys = table("refine").keys(SETUP)
    assert [key.name for key in keys] == list(objects(SETUP).names)
    assert len({key.label for key in keys}) == 2 and all(key.settings["light"] for key in keys)
    assert keys == table("refine").keys(SETUP)


def test_a_refine_case_has_the_papers_parts() -> None:
    case, size = refined(), SETUP.size
    assert len(case.base) == 5 and len(case.asset) == 800 and case.setup_seconds > 0
    assert case.before is case.after and case.near.tolist() == [True, True, False, False]
    step = case.steps[0]
    assert (step.mode, step.kind, len(step.edited)) == ("local", "zoom", 2)
    assert step.masks.shape == (2, size, size) and step.masks.mean((1, 2)).min() > 0.1
    assert case.true_views is not None and len(case.true_views) == refine.TRUE_CLOSE_UPS
    assert case.facts["truth"] == "surfels" and case.facts["samples"] is None


def test_close_ups_are_tiles_of_a_larger_picture_of_the_whole_object() -> None:
    case = refined()
    full = case.base.cameras[0]
    for camera in case.steps[0].edited.cameras:
        assert (camera.width, camera.height) == (SETUP.size, SETUP.size)
        assert camera.fx == pytest.approx(SETUP.detail * full.fx)
        assert np.linalg.norm(camera.position) == pytest.approx(np.linalg.norm(full.position))
        left, top = full.cx * SETUP.detail - camera.cx, full.cy * SETUP.detail - camera.cy
        room = SETUP.size * (SETUP.detail - 1)
        assert 0 <= left <= room and 0 <= top <= room
        np.testing.assert_allclose(camera.forward, -camera.position / np.linalg.norm(camera.position), atol=1e-9)


def test_near_views_look_at_a_spot_that_they_and_a_close_up_see() -> None:
    case = refined()
    truth = truth_of(case.name, case.facts["light"])
    for k in np.flatnonzero(case.near):
        camera, zoom = case.after.cameras[k], case.steps[0].edited.cameras[k % 2]
        assert camera.fx == pytest.approx(zoom.fx)
        point = camera.position + camera.forward * float(truth.render([camera], "test").depths[0, 20, 20])
        assert not truth.blocks(camera.position, point, 0.05)
        (x, y), _ = zoom.project(point)
        assert 0 <= x <= zoom.width and 0 <= y <= zoom.height
        apart = np.degrees(np.arccos(-camera.forward @ (zoom.position - point) / np.linalg.norm(zoom.position - point)))
        assert 0 < apart < refine.NEAR_DEGREES[1] + 1
    for camera in case.after.take(np.logical_not(case.near)).cameras:
        assert camera.fx == pytest.approx(case.base.cameras[0].fx)


def test_the_truth_itself_scores_far_above_the_asset_in_refine() -> None:
    case, protocol = refined(), table("refine")
    best = protocol.score(case, [EditResult(dense(case, case.facts["light"]), 0, 0)], None)
    nothing = protocol.score(case, [EditResult(case.asset, 0, 0)], None)
    assert set(best) >= {column.key for column in protocol.columns}
    for key in ("psnr", "psnr_around"):
        one, other = best[key], nothing[key]
        assert one is not None and other is not None and one > 45 and 10 < other < one - 8
    assert best["lpips"] is None
    pictures = protocol.pictures(case, [EditResult(case.asset, 0, 0)])
    assert list(pictures)[:2] == ["result", "truth"] and pictures["result"].shape == pictures["truth"].shape


def test_a_case_survives_the_disk_and_is_made_again_alike(tmp_path: Path) -> None:
    case = refined()
    case.save(tmp_path)
    stored = Case.load(tmp_path)
    assert np.array_equal(object_masks(stored.after), object_masks(case.after)) and stored.facts == case.facts
    protocol = table("refine")
    assert same(protocol.make(protocol.keys(SETUP)[0], SETUP), case)


def test_a_mesh_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad_thing.glb").write_bytes(b"glTF\2\0\0\0\x0c\0\0\0")
    setup = replace(SETUP, data=tmp_path, held_out=False)
    for name in ("refine", "relight"):
        protocol = table(name)
        with pytest.raises(ValueError, match="bad_thing"):
            protocol.make(protocol.keys(setup)[0], setup)


# Assets


def test_an_asset_of_base_views_is_nearer_to_them_after_some_steps() -> None:
    truth = truth_of(objects(SETUP).names[0], environments(SETUP).names[0])
    base = truth.render(truth.ring(4, np.random.default_rng(0)), "base")
    errors = []
    for steps in (0, 60):
        built = build_asset(replace(truth, setup=replace(SETUP, asset_steps=steps)), base)
        errors.append(float(((rendered(built.splats, base.images.cameras) - base.images.colors) ** 2).mean()))
        assert isinstance(built.splats.means, np.ndarray) and str(steps) in built.method
    assert errors[1] < 0.6 * errors[0]
    thin = build_asset(truth, base, "surfels")
    assert len(thin.splats) == SETUP.rows


# Relight


def test_relight_has_a_case_per_object_light_and_number_of_views_in_an_order_that_shares_pictures() -> None:
    keys = table("relight").keys(SETUP)
    assert len(keys) == 2 * 2 * 3 == len({key.label for key in keys})
    assert [key.settings["views"] for key in keys[:3]] == [1, 2, 4]
    assert len({key.settings["target"] for key in keys[:3]}) == 1
    for key in keys:
        assert key.settings["target"] != key.settings["source"]


@lru_cache(maxsize=1)
def relit() -> tuple[Case, ...]:
    protocol = table("relight")
    return tuple(protocol.make(key, SETUP) for key in protocol.keys(SETUP)[:3])


def test_relit_views_are_nested_and_evenly_around() -> None:
    one, two, four = (case.steps[0].edited for case in relit())
    assert [len(views) for views in (one, two, four)] == [1, 2, 4]
    assert np.array_equal(two.colors[:1], one.colors) and np.array_equal(four.colors[:2], two.colors)
    turns = [viewpoints.angles(camera.position)[0] % 360 for camera in four.cameras]
    assert (turns[1] - turns[0]) % 360 == pytest.approx(180)
    assert np.diff(sorted(turns)).round(6).tolist() == [90, 90, 90]


def test_a_relight_case_has_the_papers_parts() -> None:
    cases = relit()
    first = cases[0]
    assert first.before is cases[1].before and first.after is cases[2].after and first.asset is cases[1].asset
    assert first.near.all() and len(first.after) == SETUP.novel_views and first.true_views is not None
    assert first.steps[0].mode == "global" and first.steps[0].masks.any()
    assert np.abs(first.after.colors - first.before.colors).mean() > 0.005
    assert [case.facts["views"] for case in cases] == [1, 2, 4] and len({c.facts["environment"] for c in cases}) == 1
    input_positions = {
        camera.position.round(6).tobytes() for p in (first.base, cases[2].steps[0].edited) for camera in p.cameras
    }
    assert not input_positions & {camera.position.round(6).tobytes() for camera in first.after.cameras}


def test_the_relit_truth_scores_far_above_the_asset_in_relight() -> None:
    case, protocol = relit()[0], table("relight")
    best = protocol.score(case, [EditResult(dense(case, case.facts["environment"]), 0, 0)], None)
    nothing = protocol.score(case, [EditResult(case.asset, 0, 0)], None)
    one, other = best["psnr"], nothing["psnr"]
    assert one is not None and other is not None and one > 45 and other < one - 8
    assert set(best) == {column.key for column in protocol.columns} and protocol.split_by in case.facts


def test_relight_is_made_again_alike_in_any_order() -> None:
    protocol, before = table("relight"), relit()[1]
    relight._source.cache_clear()
    relight._target.cache_clear()
    assert same(protocol.make(protocol.keys(SETUP)[1], SETUP), before)


def test_relight_needs_two_lights() -> None:
    with pytest.raises(ValueError, match="at least two environments, got 1"):
        table("relight").keys(replace(SETUP, lights=0))
