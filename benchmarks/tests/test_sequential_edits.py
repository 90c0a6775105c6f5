"""Edits in a row: cases against the order in which they are made, figures against answers known by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splatbench import ground_truth
from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup
from splatbench.ground_truth import changes
from splatbench.methods import EditResult
from splatbench.scoring import rendered
from splatbench.tables.sequential_edits import MIN_OVERLAP, PARTS, TABLE

from splatpainter.cameras import Camera, orbit
from splatpainter.metrics import psnr
from splatpainter.splats import Splats
from tests.support.cli_scenes import ball

SETUP = Setup(truth="surfels", size=48, objects=3, base_views=2, novel_views=2, rows=500, asset_steps=0, lights=1)
ASSET = ball(1500)
CAMERAS = sorted(
    orbit([0, 0, 0], 4, 4, width=40, height=40, fov=40, background=ground_truth.BACKGROUND),
    key=lambda c: np.arctan2(c.position[0], c.position[2]),
)


def colored(splats: Splats, towards: Camera, level: float, size: float = 0.85) -> Splats:
    """A cap that faces a camera in another colour."""
    sh = splats.sh.copy()
    sh[splats.means @ (towards.position / np.linalg.norm(towards.position)) > size] = level
    return replace(splats, sh=sh)


def pictures(splats: Splats, *cameras: Camera) -> PosedImages:
    return PosedImages(tuple(cameras), rendered(splats, cameras))


def step(before: Splats, after: Splats, camera: Camera) -> EditStep:
    edited = pictures(after, camera)
    return EditStep("local", "stroke", edited, changes(rendered(before, [camera]), edited.colors))


def case(steps: list[EditStep], before: PosedImages, after: PosedImages, near: list[bool], **facts: str) -> Case:
    base = pictures(ASSET, CAMERAS[0])
    return Case("sequence", "ball", "ball", ASSET, base, tuple(steps), before, after, np.array(near), facts=dict(facts))


def answers(*splats: Splats) -> list[EditResult]:
    return [EditResult(each, 0, 0) for each in splats]


# Cases


@pytest.fixture(scope="module")
def cases() -> dict[str, Case]:
    """One of each part, and of each kind of edit in several views."""
    keys = {key.label: key for key in TABLE.keys(SETUP)}
    endings = ["0-views", "0-edits", "0-conflict", "1-views", "2-views"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ground_truth, "MIN_SURFELS", 2000)
        patch.setattr(ground_truth, "SURFELS_PER_PIXEL", 0.15)
        return {w: TABLE.make(next(k for n, k in keys.items() if n.endswith(w)), SETUP) for w in endings}


def test_every_object_has_a_case_of_each_part() -> None:
    keys = TABLE.keys(SETUP)
    assert len(keys) == 9 and len({key.label for key in keys}) == 9
    assert [key.settings["part"] for key in keys[:3]] == list(PARTS)
    views = [key.settings for key in keys if key.settings["part"] == "views"]
    assert [v["edit"] for v in views] == ["paint", "zoom", "relight"] and views[2]["target"] != views[2]["light"]
    full = TABLE.keys(replace(SETUP, size=512))
    assert [key.settings["count"] for key in full[:3]] == [4, 10, 2]
    assert [key.settings["count"] for key in keys[:3]] == [3, 3, 2]


def test_every_step_has_one_view_and_a_mask(cases: dict[str, Case]) -> None:
    for name, made in cases.items():
        assert made.facts["part"] == name.split("-")[1] and made.facts["steps"] == len(made.steps)
        assert len(made.after) == len(made.before) == len(made.near)
        for one in made.steps:
            assert len(one.edited) == 1 and one.masks.shape == (1, 48, 48) and one.masks.any()
    assert [len(cases[name].steps) for name in ("0-views", "1-views", "2-views", "0-conflict")] == [3, 3, 3, 2]
    assert [cases[name].steps[0].mode for name in ("0-views", "1-views", "2-views")] == ["local", "local", "global"]


def test_views_of_one_edit_show_one_and_the_same_truth(cases: dict[str, Case]) -> None:
    paint, zoom, relit = (cases[name] for name in ("0-views", "1-views", "2-views"))
    assert changes(paint.before.colors, paint.after.colors)[paint.near].any()
    assert (zoom.before.colors == zoom.after.colors).all() and zoom.near.tolist() == [True, False]
    assert np.abs(relit.before.colors - relit.after.colors).mean() > 0.005 and not relit.near.any()
    assert {one.kind for one in relit.steps} == {"relight"} and {one.kind for one in zoom.steps} == {"zoom"}


def test_edits_are_different_and_each_builds_on_those_before(cases: dict[str, Case]) -> None:
    made = cases["0-edits"]
    count = len(made.steps)
    assert 2 <= count <= 3 and len({one.kind for one in made.steps}) == count
    for k, one in enumerate(made.steps):
        assert made.after.cameras[k] is one.edited.cameras[0]
        changed_pixels = changes(made.before.colors[k : k + 1], one.edited.colors)
        assert (changed_pixels == one.masks).all()
    assert (made.after.colors[count - 1] == made.steps[-1].edited.colors[0]).all()  # nothing comes after the last
    assert not made.near[:count].any() and made.near[count:].any()


def test_conflicting_views_paint_one_region(cases: dict[str, Case]) -> None:
    made = cases["0-conflict"]
    first, second = made.steps
    over = changes(first.edited.colors, made.after.colors[:1])
    assert (over & first.masks).sum() >= MIN_OVERLAP * min(over.sum(), first.masks.sum())
    assert made.after.cameras[0] is first.edited.cameras[0] and not made.near[0]
    assert (changes(made.before.colors[:1], first.edited.colors) == first.masks).all()
    figures = TABLE.score(made, answers(made.asset, made.asset), None)
    assert figures["later"] is not None and figures["first"] is None
    assert TABLE.pictures(made, answers(made.asset, made.asset))["result"].shape == (48, 48, 3)
    assert second.masks.any()


def test_an_unknown_light_or_object_is_refused() -> None:
    key = TABLE.keys(SETUP)[0]
    with pytest.raises((ValueError, IndexError)):
        TABLE.make(CaseKey(key.label, "nonsense", key.settings), SETUP)


# Figures


def test_more_views_are_scored_where_the_edit_is() -> None:
    first, near = CAMERAS[0], CAMERAS[1]
    right, half = colored(ASSET, first, -1.0, 0.6), colored(ASSET, first, 0.2, 0.6)
    steps = [step(ASSET, right, first), step(ASSET, right, near)]
    before, after = pictures(ASSET, near, CAMERAS[2]), pictures(right, near, CAMERAS[2])
    sequence = case(steps, before, after, [True, False], part="views", edit="paint")
    figures = TABLE.score(sequence, answers(half, right), None)
    mask = changes(before.colors[:1], after.colors[:1])[0]
    assert figures["first"] == pytest.approx(psnr(rendered(half, [near])[0], after.colors[0], mask), abs=1e-4)
    assert figures["last"] == figures["psnr_2"] == 100 and figures["forgetting"] is None
    assert {column.key for column in TABLE.columns} <= set(figures)
    relit = replace(sequence, near=np.zeros(2, bool), facts={"part": "views", "edit": "relight"})
    everywhere = TABLE.score(relit, answers(half, right), None)["first"]
    assert everywhere is not None and everywhere > (figures["first"] or 0)  # what did not change counts too
    assert set(TABLE.pictures(sequence, answers(half, right))) == {"result", "truth", "step 1"}


def test_what_a_later_edit_spoils_is_forgotten_and_what_it_overpaints_is_not() -> None:
    a, b = CAMERAS[0], CAMERAS[2]  # opposite
    one = colored(ASSET, a, -1.0)
    two = colored(one, b, 0.9)
    steps = [step(ASSET, one, a), step(one, two, b)]
    before, after = pictures(one, a, b), pictures(two, a, b)
    sequence = case(steps, before, after, [False, False], part="edits")
    both = TABLE.score(sequence, answers(one, two), None)
    assert both["first"] == 100 and (both["last"] or 0) > 85 and both["forgetting"] is not None
    assert 0 <= both["forgetting"] < 30  # invisible: Gaussians of the one shine through in the other's view
    lost = colored(ASSET, b, 0.9)  # the first edit is gone
    figures = TABLE.score(sequence, answers(one, lost), None)
    final_db = psnr(rendered(lost, [a])[0], steps[0].edited.colors[0], steps[0].masks[0])
    assert figures["forgetting"] == pytest.approx(100 - final_db, abs=1e-3)
    assert figures["end_1"] == pytest.approx(final_db, abs=1e-3) and figures["fresh_1"] == figures["end_2"] == 100
    assert figures["psnr_2"] == figures["last"] == pytest.approx((final_db + 100) / 2, abs=1e-3)
    wiped = colored(one, a, 0.9, 0.7)  # an edit that covers the first
    steps = [step(ASSET, one, a), step(one, wiped, a)]
    over = case(steps, pictures(one, a, a), pictures(wiped, a, a), [False, False], part="edits")
    figures = TABLE.score(over, answers(one, wiped), None)
    assert figures["last"] == 100 and figures["forgetting"] is None and figures["fresh_1"] is None


def test_the_later_of_two_views_wins_or_does_not() -> None:
    a, b = CAMERAS[0], CAMERAS[1]
    one = colored(ASSET, a, -1.0, 0.7)
    two = colored(one, a, 0.9, 0.75)
    steps = [step(ASSET, one, a), step(one, two, b)]
    assert steps[1].masks.any()
    sequence = case(steps, pictures(ASSET, a), pictures(two, a), [False], part="conflict")
    won = TABLE.score(sequence, answers(one, two), None)
    assert won["winner"] == 100 and won["new"] == 100 and won["later"] == 100 and won["psnr_1"] == 100
    stuck = TABLE.score(sequence, answers(one, one), None)
    assert stuck["winner"] == 0 and stuck["old"] == 100
    assert stuck["new"] is not None and stuck["new"] < 20
    nothing = TABLE.score(sequence, answers(ASSET, ASSET), None)
    assert nothing["winner"] == 0  # nearest to the object without either
