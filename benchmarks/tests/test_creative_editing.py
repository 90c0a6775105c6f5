"""The table of creative edits: cases against the truth they are made of, figures against answers known by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatbench import edit_design, ground_truth
from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup
from splatbench.edit_design import KINDS, design_edit, resources, surface_point
from splatbench.ground_truth import GroundTruth, changed, changes
from splatbench.methods import EditResult
from splatbench.objects import is_splat_folder
from splatbench.scoring import rendered
from splatbench.tables.creative_editing import TABLE, SplatTruth, changed_gaussians, splat_names

from splatpainter.cameras import orbit
from splatpainter.splats import Splats
from splattrain.data.edits import MAX_EDIT_FRACTION, MIN_EDIT_FRACTION
from splattrain.data.edits.surface_points import SurfacePoint
from tests.support.cli_scenes import ball

SETUP = Setup(truth="surfels", size=48, objects=2, base_views=3, novel_views=3, rows=600, asset_steps=0, samples=4)
GREY = ground_truth.BACKGROUND


@pytest.fixture(scope="module")
def few() -> object:
    """Coarser surfels, for speed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ground_truth, "MIN_SURFELS", 6000)
        patch.setattr(ground_truth, "SURFELS_PER_PIXEL", 0.15)
        yield


@pytest.fixture(scope="module")
def made(few: object) -> Case:
    return TABLE.make(TABLE.keys(SETUP)[0], SETUP)


@pytest.fixture(scope="module")
def truth(few: object, made: Case) -> GroundTruth:
    """The unpainted truth of `made`."""
    key = TABLE.keys(SETUP)[0]
    return GroundTruth.load(key.name, key.settings["light"], SETUP)


def colored(splats: Splats, chosen: np.ndarray, level: float) -> Splats:
    sh = splats.sh.copy()
    sh[chosen] = level
    return replace(splats, sh=sh)


# Cases


def test_kinds_and_framings_take_turns_and_labels_are_unique() -> None:
    keys = TABLE.keys(replace(SETUP, objects=10))
    assert [k.settings["kind"] for k in keys] == 2 * ["stroke", "sticker", "text", "photo", "recolor"]
    assert {(k.settings["kind"], k.settings["framing"]) for k in keys} == {
        (kind, framing) for kind in KINDS for framing in ("close-up", "whole")
    }
    assert len({k.label for k in keys}) == 10 and all("/" not in k.label for k in keys)


def test_a_case_asks_for_what_its_truth_shows(made: Case, truth: GroundTruth) -> None:
    (step,) = made.steps
    assert (made.protocol, step.mode, step.kind, len(step.edited)) == ("creative", "local", "stroke", 1)
    assert step.masks.shape == (1, 48, 48) and MIN_EDIT_FRACTION <= step.masks.mean() <= MAX_EDIT_FRACTION
    assert len(made.after) == 3 and made.near.tolist() == [True, True, False]
    assert made.true_views is not None and len(made.true_views) == 12 and len(made.asset) <= 600
    before = truth.render(step.edited.cameras, "novel").images.colors  # unpainted, path tracing would have equal noise
    differs = np.abs(before - step.edited.colors).max(-1) > 0.02
    assert not (differs & ~step.masks).sum() > 5 and (differs & step.masks).sum() > 0.5 * differs.sum()
    assert np.allclose(truth.render(made.before.cameras, "novel").images.colors, made.before.colors, atol=1e-6)
    assert np.abs(made.after.colors - made.before.colors)[:2].max() > 0.1  # the paint is on the surface
    assert made.facts["kind"] == "stroke" and made.facts["truth"] == "surfels"


def test_equal_keys_and_setups_give_equal_cases(few: object, made: Case) -> None:
    again = TABLE.make(TABLE.keys(SETUP)[0], SETUP)
    assert (again.steps[0].edited.colors == made.steps[0].edited.colors).all()
    assert (again.after.colors == made.after.colors).all() and again.asset.sha256 == made.asset.sha256


def test_both_truths_put_the_same_paint_at_the_same_place(few: object, truth: GroundTruth) -> None:
    pytest.importorskip("mitsuba")
    rng = np.random.default_rng(4)
    base = truth.render([c for c in orbit([0, 0, 0], 3.5, 2, width=48, height=48, fov=40, background=GREY)], "base")
    design, _ = design_edit(truth, base, "sticker", "whole", resources(SETUP), rng)
    traced = GroundTruth.of("x", truth.mesh, truth.light, replace(SETUP, truth="traced"))
    assert traced.surfels is None and truth.preview() is truth
    masks = []
    for each in (truth, traced):
        one, other = (t.render([design.camera], "here") for t in (each, each.paint(design)))
        masks.append(changed(one, other)[0])
    both, either = (masks[0] & masks[1]).sum(), (masks[0] | masks[1]).sum()
    assert both > 0.6 * either  # a pixel's rim, and surfels' blur
    layer = design.region & (base.alphas[0] >= 0)
    assert (masks[1] & ~np.pad(layer, 3, "edge")[3:-3, 3:-3]).sum() < 0.5 * masks[1].sum()


# Splat assets


def test_a_folder_of_splats_gives_cases_with_no_truth_but_the_picture(tmp_path: Path) -> None:
    from splatpainter.io import write

    asset = replace(ball(2500), means=(3 * ball(2500).means + [5, 1, 2]).astype(np.float32))
    asset = replace(asset, scales=(3 * asset.scales).astype(np.float32))
    write(tmp_path / "one.ply", asset)
    write(tmp_path / "two.ply", asset)
    setup = replace(SETUP, data=tmp_path, objects=1)
    (key,) = TABLE.keys(setup)
    case = TABLE.make(key, setup)
    assert case.true_views is None and len(case.after) == 0 and case.near.shape == (0,)
    (step,) = case.steps
    was = rendered(case.asset, step.edited.cameras)
    assert (was != GREY).any(-1).mean() > 0.1  # the camera finds the asset where the file has it
    assert np.abs(was - step.edited.colors)[~step.masks].max() < 0.021
    assert np.abs(was - step.edited.colors)[step.masks].max() > 0.2
    figures = TABLE.score(case, [EditResult(case.asset, 0, 0)], None)
    assert figures["psnr_novel"] is None and figures["psnr_outside"] == 100 and figures["psnr"] is not None
    assert set(TABLE.pictures(case, [EditResult(case.asset, 0, 0)])) == {"result", "truth"}


def test_cameras_of_the_frame_show_the_asset_where_it_is() -> None:
    what = SplatTruth("x", ball(10), np.array([5.0, 1, 2]), 0.25, 1.0)
    camera = orbit([0, 0, 0], 3, 1, start=30, elevation=20, width=48, height=40, fov=40)[0]
    there = what.placed(camera)
    spot = SurfacePoint(np.array([5.4, 0.2, 2.3]), np.array([0.0, 1, 0]))
    framed = what.framed(spot)
    assert np.allclose(framed.position, 0.25 * np.array([0.4, 0.8, -0.3]))  # y and z turn over
    (one, depth), (other, framed_depth) = there.project(spot.position), camera.project(framed.position)
    assert np.allclose(one, other) and np.isclose(depth, 4 * framed_depth)


def test_folders_are_told_apart_by_what_is_in_them(tmp_path: Path) -> None:
    for name in ("a.ply", "b.sog", "c.glb"):
        (tmp_path / name).touch()
    assert is_splat_folder(tmp_path)
    (tmp_path / "d.obj").touch()
    assert not is_splat_folder(tmp_path) and not is_splat_folder(tmp_path / "none")
    with pytest.raises(ValueError, match="holds no splat asset"):
        splat_names(replace(SETUP, data=_empty(tmp_path)))


def _empty(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


# Figures


def test_figures_of_answers_known_by_hand() -> None:
    asset = ball(1500)
    cap = np.flatnonzero(asset.means[:, 2] > 0.8)
    edited = colored(asset, cap, -1.0)
    front, side, back = orbit([0, 0, 0], 4, 3, width=48, height=48, fov=40, background=GREY, start=0)
    cameras = sorted((front, side, back), key=lambda c: -c.position[2])  # the cap is at +z

    def pictures(splats: Splats, views: list) -> PosedImages:
        return PosedImages(tuple(views), rendered(splats, views))

    first = pictures(edited, cameras[:1])
    masks = changes(rendered(asset, cameras[:1]), first.colors)
    assert masks.any()
    step = EditStep("local", "stroke", first, masks)
    before, after = pictures(asset, cameras), pictures(edited, cameras)
    near = np.array([True, False, False])
    case = Case("creative", "ball", "ball", asset, before, (step,), before, after, near)

    right = TABLE.score(case, [EditResult(edited, 0, 0)], None)
    assert right["psnr"] == right["psnr_novel"] == 100 and right["ssim"] == pytest.approx(1)
    assert right["psnr_outside"] is not None and right["psnr_outside"] > 40  # what is below the mask's threshold
    assert (right["touched"], right["appended"]) == (len(cap), 0)
    assert right["equal"] == pytest.approx(100 * (1 - len(cap) / 1500))

    none = TABLE.score(case, [EditResult(asset, 0, 0)], None)
    assert none["psnr_outside"] == 100 and none["touched"] == 0 and none["equal"] == 100
    error = ((before.colors[0] - first.colors[0]) ** 2)[masks[0]].mean()
    assert none["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-4)

    everything = colored(asset, np.arange(1500), -1.0)
    spoiled = TABLE.score(case, [EditResult(everything, 0, 0, keeps_gaussians=False)], None)
    assert spoiled["psnr_outside"] is not None and spoiled["psnr_outside"] < 20
    assert spoiled["touched"] is None and spoiled["equal"] is None
    assert TABLE.pictures(case, [EditResult(edited, 0, 0)])["truth"].shape == (48, 48, 3)
    assert {column.key for column in TABLE.columns} <= set(right)


def test_rows_count_any_attribute_and_appended_rows() -> None:
    asset = ball(50)
    opacities = asset.opacities.copy()
    opacities[7] = np.nextafter(opacities[7], 0)
    scales = asset.scales.copy()
    scales[[7, 9], 0] *= 2
    made = replace(asset, opacities=opacities, scales=scales).append(asset.take(np.arange(3)))
    assert changed_gaussians(asset, EditResult(made, 0, 0)) == {
        "touched": 2.0,
        "appended": 3.0,
        "equal": pytest.approx(96.0),
    }


def test_an_object_that_no_edit_shows_on_is_refused_by_name(truth: GroundTruth) -> None:
    cameras = orbit([0, 0, 0], 3.5, 1, width=48, height=48, fov=40, background=GREY)
    base = truth.render(cameras, "base")
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"procedural-.*: 2 choices of a text edit changed nothing that can be seen"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(edit_design, "DESIGN_TRIES", 2)
            design_edit(truth, base, "text", "whole", resources(SETUP), rng, lambda point, mask: False)
    empty = replace(base, alphas=np.zeros_like(base.alphas))
    with pytest.raises(ValueError, match="no part of its surface faces a view"):
        surface_point(empty, rng)


def test_keys_without_a_light_are_of_splats() -> None:
    with pytest.raises(AssertionError):
        TABLE.make(CaseKey("x", "x", {"kind": "text", "framing": "whole"}), SETUP)  # no folder
