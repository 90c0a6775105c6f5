"""Assets edited by picture sources: one view, or as many as the surface needs."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from splatpainter.cameras import orbit_cameras
from splatpainter.gatekeeper.gatekeeper import RefusedPicture
from splatpainter.lift.options import LOCAL_DEFAULTS
from splatpainter.painter import Edit, Painter
from splatpainter.receipts import Receipt
from splatpainter.source_edits import coverage
from splatpainter.source_edits.coverage import SurfaceView, plan_views, unreached
from splatpainter.source_edits.edit import cover, edit_with_source, refine, usual_scale
from splatpainter.source_edits.view_edit import AnsweredView, SourceBrief, ask_for_edit, displayed, picture_sha256
from splatpainter.source_edits.view_sequence import edit_views_in_order
from splatpainter.sources.picture_source import Capabilities, PictureAnswer, SourceCancelled, SourceError
from splatpainter.splats import SH_C0, Splats, changed_rows
from splatpainter.view_files import normals_of
from tests.support.cli_scenes import ball
from tests.support.picture_sources import EXCHANGE, FunctionSource, exchanged, without_masks

GREY = (0.25, 0.25, 0.25)
LIFT = Painter.load("lift")


@pytest.fixture(autouse=True)
def few_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """The ball looks alike from everywhere; 14 views to choose from are enough, and half the time."""
    monkeypatch.setattr(coverage, "CANDIDATE_VIEWS", 14)


def patterned(count: int = 2500) -> Splats:
    """A ball with patches of colours that have a hue everywhere."""
    splats = ball(count, degree=0)
    x, y, z = splats.means.T
    colors = 0.45 + 0.25 * np.stack([np.sin(4 * x + y), np.sin(3 * y + 2), np.cos(3 * z - x)], 1)
    colors[:, 0] += 0.15
    return replace(splats, sh=((colors - 0.5) / SH_C0)[:, None].astype(np.float32))


def edit(splats: Splats, source: FunctionSource, prompt: str | SourceBrief = "exchange", **options):
    return edit_with_source(splats, source, prompt, painter=LIFT, size=128, **options)


def test_one_view_is_edited_and_the_receipt_says_by_whom() -> None:
    splats, source = patterned(), FunctionSource(exchanged)
    mask = np.zeros((128, 128), np.float32)
    mask[50:80, 50:80] = 1
    result = edit(splats, source, SourceBrief("exchange", seed=3), mask=mask)
    assert result.receipt is not None and result.receipt.source is not None
    (request,) = source.requests
    assert request.mask is not None and np.array_equal(request.mask, mask)
    assert request.prompt == "exchange" and request.seed == 3
    record = result.receipt.source
    (view,) = record["views"]
    assert (record["name"], record["prompt"], record["strictness"]) == ("function", "exchange", "normal")
    assert (view["model"], view["seed"], view["cost"]) == ("function-1", 7, "0.04 USD")
    assert view["request_sha256"] == picture_sha256(request.image) and len(view["answer_sha256"]) == 64
    assert view["registration"]["framing"] == "full" and view["registration"]["score"] > 0.9
    again = Receipt.from_json(result.receipt.to_json())
    assert again.source == record and result.receipt.untouched_sha256_before == result.receipt.untouched_sha256_after
    (score,) = result.receipt.views
    assert score.psnr_after is not None and score.psnr_before is not None
    assert score.psnr_after > score.psnr_before + 6
    touched = changed_rows(splats, result.splats)
    assert 0 < len(touched) < 0.1 * len(splats)
    older = replace(result.receipt, source=None)
    assert "source" not in older.to_json() and Receipt.from_json(older.to_json()).source is None
    with pytest.raises(ValueError, match="expected a receipt"):
        Receipt.from_json(replace(older, source={"name": "x" * 5000}).to_json())


def test_a_source_without_masks_is_cut_afterwards_and_maps_are_drawn_on_demand() -> None:
    splats = patterned()
    source = FunctionSource(lambda image: np.clip(exchanged(image) * 0.9 + 0.05, 0, 1), without_masks())
    (camera,) = orbit_cameras(splats, 1, size=128, background=GREY)
    mask = np.zeros((128, 128), np.float32)
    mask[40:90, 40:90] = 1
    brief = SourceBrief("x", strictness="loose")
    made = ask_for_edit(splats, camera, source, brief, progress=lambda *_: None, cancel=threading.Event(), mask=mask)
    (request,) = source.requests
    assert request.mask is None and made.request.mask is not None
    assert made.edit.mask is not None and request.depth is not None and request.normal is not None
    assert not made.edit.mask[mask == 0].any() and made.edit.mask[55:75, 55:75].all()
    render = displayed(splats, camera)[0]
    assert np.array_equal(made.edit.image[mask == 0], render[mask == 0])
    depth, normal = request.depth(), request.normal()
    assert depth[64, 64] == pytest.approx(np.linalg.norm(camera.position) - 1, abs=0.03) and depth[0, 0] == 0
    assert np.allclose(normal[64, 64], (0, 0, -1), atol=0.15) and not normal[0, 0].any()


def test_an_enlarged_answer_is_painted_at_its_size() -> None:
    splats = patterned()

    def larger(image: np.ndarray) -> np.ndarray:
        return exchanged(image).repeat(2, 0).repeat(2, 1)

    source = FunctionSource(larger, without_masks())
    (camera,) = orbit_cameras(splats, 1, size=96, background=GREY)
    made = ask_for_edit(
        splats, camera, source, SourceBrief(scale=2), progress=lambda *_: None, cancel=threading.Event()
    )
    assert made.admitted.factor == 2 and made.edit.camera.width == 192 and made.edit.image.shape == (192, 192, 3)


def test_errors_of_sources_reach_the_caller() -> None:
    splats = patterned(400)
    with pytest.raises(SourceError, match="does not take a prompt"):
        edit(splats, FunctionSource(exchanged, Capabilities(mask=True)))
    with pytest.raises(RefusedPicture, match="something other"):
        edit(splats, FunctionSource(lambda image: np.random.default_rng(0).uniform(size=image.shape)))
    with pytest.raises(RefusedPicture, match="unchanged"):
        edit(splats, FunctionSource(lambda image: image))
    with pytest.raises(SourceError, match="not in view"):
        away = orbit_cameras(splats, 1, size=64, distance=3)[0]
        turned = np.diag([-1.0, 1, -1, 1]) @ away.world_to_camera
        edit(splats, FunctionSource(exchanged), camera=replace(away, world_to_camera=turned))
    with pytest.raises(ValueError, match="views auto"):
        edit(splats, FunctionSource(exchanged), views="auto", mode="global")


def test_plans_choose_what_is_unseen_and_masks_do_not_overlap() -> None:
    splats = patterned()
    plan = plan_views(splats, size=96, max_views=12)
    assert plan.covered > 0.95 and 5 <= len(plan.cameras) <= 12 and plan.gains[0] == max(plan.gains)
    assert len(plan_views(splats, size=96, max_views=2).cameras) == 2
    (first,) = orbit_cameras(splats, 1, size=80, background=GREY)
    assert plan_views(splats, size=96, max_views=2, first=first).cameras[0] is first
    normals, earlier, painted, surely = normals_of(splats), [], np.zeros(len(splats)), np.zeros(len(splats))
    for camera in plan.cameras:
        view = SurfaceView.of(splats, camera, normals)
        mask = unreached(view, earlier)
        earlier.append((view, mask))
        facing = view.facing(splats.means.astype(np.float64), splats.means.astype(np.float64))
        pixels, _ = camera.project(splats.means)
        x, y = np.clip(pixels.astype(int), 0, 95).T
        painted += (facing > 0) & (mask[y, x] > 0.5)
        surely += (facing > 0) & (mask[y, x] > 0.75)
    assert (painted >= 1).mean() > 0.97 and (surely >= 2).mean() < 0.06


def test_views_cover_the_surface_once_and_novel_views_agree() -> None:
    splats, source = patterned(), FunctionSource(exchanged)
    plan = plan_views(splats, size=112, max_views=12, background=GREY)
    asset, steps = LIFT.encode(splats, "lift", ["local"]), []
    made = cover(
        LIFT,
        asset,
        source,
        SourceBrief("exchange"),
        plan,
        method="lift",
        progress=lambda share, words: steps.append((share, words)),
        cancel=threading.Event(),
    )
    receipt = made.asset.receipt
    assert receipt is not None and receipt.source is not None and made.refused == ()
    assert len(receipt.source["views"]) == len(receipt.views) == len(made.edits) == len(source.requests)
    assert [share for share, _ in steps] == sorted(share for share, _ in steps) and "view 2 of" in steps[1][1]
    assert receipt.asset_rows == len(splats) and receipt.appended_rows == len(made.asset.splats) - len(splats)
    assert np.array_equal(receipt.touched, changed_rows(splats, made.asset.splats))
    truth = replace(splats, sh=(splats.sh @ EXCHANGE.T).astype(np.float32))
    changed = visible = twice = 0
    before_error, after_error = [], []
    for camera in [c for e in (-35, 10, 50) for c in orbit_cameras(splats, 3, size=80, elevation=e, background=GREY)]:
        before, alpha = displayed(splats, camera)
        after, expected = displayed(made.asset.splats, camera)[0], displayed(truth, camera)[0]
        again = exchanged(expected)
        use = (alpha > 0.95) & (np.abs(before - expected).max(-1) > 0.15)
        visible += int(use.sum())
        changed += int((np.abs(after - before).max(-1) > 0.25 * np.abs(expected - before).max(-1))[use].sum())
        nearer = np.abs(after - again).max(-1) < np.abs(after - expected).max(-1)
        twice += int((nearer & (np.abs(after - before).max(-1) > 0.05))[use].sum())
        before_error.append(((before - expected)[use] ** 2).mean())
        after_error.append(((after - expected)[use] ** 2).mean())
    gain = 10 * np.log10(np.mean(before_error) / np.mean(after_error))
    assert changed > 0.97 * visible
    assert twice < 0.04 * visible
    assert gain > 8


def test_where_a_source_fails_on_the_way_what_was_painted_stays() -> None:
    class Limited(FunctionSource):
        def edit(self, request, progress, cancel) -> PictureAnswer:
            answer = super().edit(request, progress, cancel)
            if len(self.requests) > allowed:
                raise SourceError("source limited: no calls left today (429)")
            return answer

    splats, allowed = patterned(800), 1
    result = edit(splats, Limited(exchanged), views="auto", max_views=3)
    assert result.receipt is not None and len(result.receipt.views) == 1 and len(result.receipt.touched)
    assert "stopped before view 2 of" in result.receipt.note and "no calls left" in result.receipt.note
    allowed = 0
    with pytest.raises(SourceError, match="no calls left"):
        edit(splats, Limited(exchanged), views="auto", max_views=3)


def test_a_refused_view_is_noted_and_the_others_are_painted() -> None:
    splats = patterned(800)

    class Moody(FunctionSource):
        def edit(self, request, progress, cancel) -> PictureAnswer:
            answer = super().edit(request, progress, cancel)
            if len(self.requests) == 2:
                return replace(answer, image=np.random.default_rng(1).uniform(size=answer.image.shape))
            return answer

    source = Moody(exchanged)
    result = edit(splats, source, views="auto", max_views=3)
    assert result.receipt is not None and len(result.receipt.views) == 2 and len(source.requests) == 3
    (reason,) = [note for note in result.receipt.note.split("; ") if "view 2" in note]  # one note, one line
    assert "something other" in reason and reason.endswith("ask again")
    stop = threading.Event()
    stop.set()
    with pytest.raises(SourceCancelled):
        edit(splats, FunctionSource(exchanged), views="auto", cancel=stop)
    with pytest.raises(RefusedPicture, match="view 2"):
        edit(splats, FunctionSource(lambda image: image), views="auto", max_views=2)


def test_views_are_refined_from_python() -> None:
    splats = patterned(600)
    (camera,) = orbit_cameras(splats, 1, size=40, background=GREY)

    def striped(image: np.ndarray) -> np.ndarray:
        large = image.repeat(2, 0).repeat(2, 1)
        return large + 0.15 * (-1.0) ** (np.arange(large.shape[1]) // 2)[None, :, None]

    source = FunctionSource(striped, without_masks())
    brief = SourceBrief("finer", strictness="loose")
    refined = refine(splats, [camera], source=source, prompt=brief, scale=2, painter=LIFT)
    assert refined.receipt is not None and refined.receipt.source is not None
    (score,) = refined.receipt.views
    assert score.psnr_after is not None and score.psnr_before is not None
    assert score.psnr_after > score.psnr_before + 1 and refined.receipt.appended_rows > 50
    assert (source.requests[0].scale, source.requests[0].prompt) == (2, "finer")
    assert usual_scale(FunctionSource(striped, Capabilities(scales=(1, 4)))) == 1  # such as image services
    plain = refine(splats, [camera], painter=LIFT)
    assert plain.receipt is not None and plain.receipt.source is not None and plain.receipt.source["name"] == "upscale"
    with pytest.raises(ValueError, match="1 to 16 cameras"):
        refine(splats, [])
    with pytest.raises(ValueError, match="got both"):
        refine(splats, [camera], source=source, upscale="model.safetensors")


def test_a_view_that_cannot_be_painted_is_noted() -> None:
    splats = patterned(400)
    plan = plan_views(splats, size=64, max_views=3, background=GREY)
    painted: list[AnsweredView] = []

    def paint(made: AnsweredView) -> None:
        if not painted and made.edit.name == "function view 1":
            raise ValueError("edit: reaches no Gaussian")
        painted.append(made)

    quiet = {"present": lambda: splats, "progress": lambda *_: None, "cancel": threading.Event()}
    sourced_views = edit_views_in_order(splats, FunctionSource(exchanged), SourceBrief("x"), plan, paint=paint, **quiet)
    assert sourced_views.edits == tuple(painted) and len(painted) == 2
    assert sourced_views.notes == ("function view 1: not painted (edit: reaches no Gaussian)",)


def test_a_whole_asset_made_anew_is_split_and_a_part_of_it_gets_sheets() -> None:
    splats = patterned(4000)
    truth = replace(splats, sh=(splats.sh @ EXCHANGE.T).astype(np.float32))
    remade = edit(splats, FunctionSource(exchanged))
    assert remade.receipt is not None and not len(remade.receipt.replaced)
    (camera,) = orbit_cameras(splats, 1, size=128, azimuth=20, background=GREY)
    solid = displayed(splats, camera)[1] > 0.95
    error = np.abs(displayed(remade.splats, camera)[0] - displayed(truth, camera)[0]).max(-1)[solid]
    (front,) = orbit_cameras(splats, 1, size=128, background=GREY)
    sheeted = LIFT.with_settings(local_options=replace(LOCAL_DEFAULTS, fine_px=0.0))
    sheets = sheeted.apply(LIFT.encode(splats), [Edit(displayed(truth, front)[0], front)]).splats
    before = np.abs(displayed(sheets, camera)[0] - displayed(truth, camera)[0]).max(-1)[solid]
    assert error.mean() < 0.8 * before.mean()
    mask = np.zeros((128, 128), np.float32)
    mask[50:80, 50:80] = 1
    part = edit(splats, FunctionSource(exchanged), mask=mask)
    assert part.receipt is not None and len(part.receipt.replaced)
