"""The painter: pure, exact about what it did not touch, and clear about what it cannot do."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.fit.edited import EditFitOptions, fit_edited
from splatpainter.lift.local.local_edit import gaussians_in_mask
from splatpainter.painter import Asset, Edit, Painter
from splatpainter.receipts import Receipt
from splatpainter.splats import Splats
from tests.support.lift_scenes import back, bits, db, differing, disk, front, row, same_bits, sheet

NAMES = ("means", "quats", "scales", "opacities", "sh")
RED, BLUE, GREEN = (0.9, 0.1, 0.1), (0.1, 0.15, 0.9), (0.1, 0.8, 0.2)
CAMERA = front(96)


def object_() -> Splats:
    """An opaque sheet, another one some way behind it, and two rows that cannot be drawn."""
    odd = row((np.nan, 0, 0), (0.1, 0.1, 0.1), RED, degree=1).append(row((0, 0, 0), (0.1, 0, 0.1), RED, degree=1))
    return sheet(45, degree=1, opacity=0.98).append(sheet(20, z=-0.6, degree=1, opacity=0.98)).append(odd)


def draw(splats: Splats, camera: Camera = CAMERA) -> np.ndarray:
    return sp.render(splats, camera).colors[0]


def dab(splats: Splats, color, x: float = 48, y: float = 48, radius: float = 10, camera: Camera = CAMERA) -> Edit:
    """A disk of one colour painted on the render, as an 8-bit picture, with no mask."""
    mask = disk(camera, x, y, radius)
    image = np.where(mask[..., None], np.array(color, np.float32), draw(splats, camera))
    return Edit(np.floor(np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8), camera)


def apply(splats: Splats, edits: list[Edit], **how) -> Asset:
    painter = Painter.load("lift")
    return painter.apply(painter.encode(splats), edits, **how)


def receipt_of(asset: Asset) -> Receipt:
    assert asset.receipt is not None
    return asset.receipt


def hash_without(splats: Splats, skipped: np.ndarray, rows: int) -> str:
    """SHA-256 of the first `rows` rows but the skipped ones, attribute after attribute, from plain bytes."""
    keep = [k for k in range(rows) if k not in set(skipped.tolist())]
    data = b"".join(np.asarray(getattr(splats, name), "<f4")[keep].tobytes() for name in NAMES)
    return hashlib.sha256(data).hexdigest()


# What an edit does


def test_one_call_is_what_a_painter_does_and_goes_on_from_its_asset() -> None:
    splats = object_()
    dabbed = dab(splats, RED)
    by_painter = Painter().apply(Asset(splats), [dabbed])
    once = sp.edit(splats, [(dabbed.image, CAMERA)])
    assert same_bits(once.splats, by_painter.splats) and receipt_of(once).method == "corrected"
    twice = sp.edit(once, [dab(once.splats, BLUE, x=30)], method="lift")
    expected = Painter.load("lift").apply(by_painter, [dab(by_painter.splats, BLUE, x=30)])
    assert same_bits(twice.splats, expected.splats)
    with pytest.raises(ValueError, match="expected 1 to 16 edited views, got 0"):
        sp.edit(splats, [])


def test_receipts_score_whole_views_though_only_parts_are_drawn() -> None:
    splats = object_()
    free = dab(splats, RED, 40, 44)
    full, rest = draw(splats), Painter.load("lift").with_settings(proof=False)
    for edit in (free, replace(free, mask=disk(CAMERA, 40, 44, 10))):
        made, unproved = apply(splats, [edit]), rest.apply(rest.encode(splats), [edit])
        assert same_bits(made.splats, unproved.splats)
        (score,), after = receipt_of(made).views, draw(made.splats)
        mask = disk(CAMERA, 40, 44, 10)
        for value, one, two, where in (
            (score.psnr_before, full, edit.image, mask),
            (score.psnr_after, after, edit.image, mask),
            (score.psnr_outside, after, full, ~mask),
        ):
            error = (np.clip(one, 0, 1).astype(np.float64) - np.clip(two, 0, 1))[where]
            assert value == pytest.approx(-10 * math.log10((error**2).mean()), abs=1e-6)
        without = replace(receipt_of(made), asset_sha256="", untouched_sha256_before="", untouched_sha256_after="")
        assert replace(receipt_of(unproved), seconds={}).to_json() == replace(without, seconds={}).to_json()


@pytest.mark.parametrize("mode, method", [("local", "auto"), ("local", "lift"), ("local", "fit"), ("global", "lift")])
def test_an_edit_does_not_touch_its_asset(mode, method):
    splats = object_()
    copies = {name: getattr(splats, name).copy() for name in NAMES}
    for name in NAMES:
        getattr(splats, name).flags.writeable = False
    edit = dab(splats, RED)
    image = edit.image.copy()
    asset = Painter.load("lift").encode(splats)
    result = Painter.load("lift").apply(asset, [edit], mode=mode, method=method)
    assert asset.splats is splats and asset.receipt is None and asset.confidence is None
    for name in NAMES:
        np.testing.assert_array_equal(bits(getattr(splats, name)), bits(copies[name]))
    np.testing.assert_array_equal(edit.image, image)
    assert len(result.splats) >= len(splats) and differing(splats, result.splats).any()
    assert not differing(splats, result.splats)[-2:].any()  # rows that cannot be drawn


def test_an_asset_that_was_changed_in_place_is_edited_as_it_is_now():
    """Nothing that an edit made of the arrays outlives it."""
    splats, painter = object_(), Painter.load("lift")
    painter.apply(painter.encode(splats), [dab(splats, RED)])
    splats.sh[:, 0] *= 0.5
    edit = dab(splats, RED)
    anew = replace(splats, **{name: getattr(splats, name).copy() for name in NAMES})
    one, two = (painter.apply(painter.encode(asset), [edit]).splats for asset in (splats, anew))
    for name in NAMES:
        np.testing.assert_array_equal(bits(getattr(one, name)), bits(getattr(two, name)))


def test_a_local_receipt_tells_the_truth():
    splats = object_()
    edit = dab(splats, RED)
    result = apply(splats, [edit])
    receipt, n = receipt_of(result), len(splats)
    np.testing.assert_array_equal(receipt.touched, np.flatnonzero(differing(splats, result.splats)))
    assert 50 < len(receipt.touched) < 400 and (receipt.touched < 45 * 45).all()
    assert (receipt.asset_rows, receipt.output_rows) == (n, len(result.splats))
    assert receipt.appended_rows == len(result.splats) - n > 0
    assert receipt.untouched_rows == n - len(receipt.touched)
    untouched = hash_without(splats, receipt.touched, n)
    assert receipt.untouched_sha256_before == receipt.untouched_sha256_after == untouched
    assert hash_without(result.splats, receipt.touched, n) == untouched
    everything = hashlib.sha256(b"".join(getattr(splats, name).tobytes() for name in NAMES)).hexdigest()
    assert receipt.asset_sha256 == everything
    assert (receipt.mode, receipt.method, receipt.preset) == ("local", "lift", "lift")
    assert "lift" in receipt.note  # why auto chose it
    assert set(receipt.seconds) >= {"prepare", "lift"} and all(value >= 0 for value in receipt.seconds.values())

    before, after = draw(splats), draw(result.splats)
    mask = disk(CAMERA, 48, 48, 10)
    (score,) = receipt.views
    assert score.psnr_before == pytest.approx(db(before, edit.image, mask), abs=0.2)  # the mask was found, not given
    assert score.psnr_after == pytest.approx(db(after, edit.image, mask), abs=0.5)
    assert score.psnr_outside is not None and score.psnr_outside == pytest.approx(db(after, before, ~mask), abs=1.5)
    assert db(after, edit.image, mask) > db(before, edit.image, mask) + 10
    assert result.confidence is None


def test_a_given_mask_says_what_counts():
    splats = object_()
    edit = dab(splats, RED, radius=14)
    small = disk(CAMERA, 52, 48, 5)
    result = apply(splats, [Edit(edit.image, CAMERA, small.astype(np.uint8) * 200)])
    before, after = draw(splats), draw(result.splats)
    assert db(after, edit.image, small) > db(before, edit.image, small) + 8
    assert db(after, before, ~disk(CAMERA, 52, 48, 9)) > 45
    (score,) = receipt_of(result).views
    assert score.psnr_after == pytest.approx(db(np.clip(after, 0, 1), edit.image, small), abs=1e-3)
    assert score.psnr_outside == pytest.approx(db(np.clip(after, 0, 1), np.clip(before, 0, 1), ~small), abs=1e-3)


def test_a_masked_edit_of_the_whole_picture_has_no_outside():
    splats = object_()
    result = apply(splats, [Edit(dab(splats, RED).image, CAMERA, np.ones((96, 96), bool))])
    assert receipt_of(result).views[0].psnr_outside is None


def test_a_global_receipt_tells_the_truth():
    splats = object_()
    warm = np.clip(draw(splats) * [1.1, 0.8, 0.6] + [0.05, 0, 0], 0, 1)
    result = apply(splats, [Edit(warm, CAMERA)], mode="global")
    receipt = receipt_of(result)
    np.testing.assert_array_equal(receipt.touched, np.flatnonzero(differing(splats, result.splats)))
    assert receipt.appended_rows == 0 and len(result.splats) == len(splats)
    assert {len(splats) - 2, len(splats) - 1} & set(receipt.touched.tolist()) == set()
    assert receipt.untouched_sha256_before == receipt.untouched_sha256_after
    assert receipt.untouched_sha256_after == hash_without(result.splats, receipt.touched, len(splats))
    assert receipt.mode == "global"
    assert result.confidence is not None and result.confidence.shape == (len(splats),)
    seen, hidden = result.confidence[: 45 * 45], result.confidence[45 * 45 : -2]
    assert seen.mean() > hidden.mean() + 0.2
    score = receipt.views[0]
    assert score.psnr_before is not None and score.psnr_after is not None
    assert score.psnr_after > score.psnr_before + 15


def test_the_same_edit_twice_gives_the_same_bits():
    splats = object_()
    one, two = (apply(splats, [dab(splats, RED), dab(splats, BLUE, 60, 40)]) for _ in range(2))
    assert same_bits(one.splats, two.splats)
    rows = {"touched": 0, "replaced": 0, "removed": 0, "merge_touched": 0}
    assert replace(receipt_of(one), seconds={}, **rows) == replace(receipt_of(two), seconds={}, **rows)


# Several edits


@pytest.mark.parametrize("how", ["one call", "two calls"])
def test_the_latest_edit_wins_where_two_overlap(how):
    splats = object_()
    overlap = disk(CAMERA, 42, 48, 12) & disk(CAMERA, 54, 48, 12)
    only = disk(CAMERA, 42, 48, 11) & ~disk(CAMERA, 54, 48, 16)
    for first, last in ((RED, BLUE), (BLUE, RED)):
        if how == "one call":
            result = apply(splats, [dab(splats, first, 42, radius=12), dab(splats, last, 54, radius=12)]).splats
        else:
            middle = apply(splats, [dab(splats, first, 42, radius=12)]).splats
            result = apply(middle, [dab(middle, last, 54, radius=12)]).splats
        picture = draw(result)
        assert db(picture, np.array(last), overlap) > 20
        assert db(picture, np.array(first), only) > 18
        assert not differing(splats, result)[45 * 45 :].any()


def test_edits_of_different_places_commute():
    splats = object_()
    left, right = dab(splats, RED, 22, 40, 8), dab(splats, BLUE, 74, 56, 8)
    one, two = apply(splats, [left, right]), apply(splats, [right, left])
    touched = receipt_of(one).touched
    np.testing.assert_array_equal(touched, receipt_of(two).touched)
    assert len(one.splats) == len(two.splats)
    assert receipt_of(one).untouched_sha256_after == receipt_of(two).untouched_sha256_after
    assert receipt_of(one).untouched_sha256_after == hash_without(splats, touched, len(splats))
    assert db(draw(one.splats), draw(two.splats)) > 60
    # Each is what it is alone.
    alone = [apply(splats, [edit]) for edit in (left, right)]
    assert set(touched) == set(receipt_of(alone[0]).touched) | set(receipt_of(alone[1]).touched)
    assert db(draw(one.splats), draw(alone[0].splats), disk(CAMERA, 22, 40, 14)) > 60


def test_edits_of_several_views_in_one_call():
    splats = object_()
    rear = back(96)
    edits = [dab(splats, RED, 30, 48, 9), dab(splats, GREEN, 48, 48, 9, rear)]
    result = apply(splats, edits)
    receipt = receipt_of(result)
    assert len(receipt.views) == 2
    for score, camera, edit, color, x in zip(receipt.views, (CAMERA, rear), edits, (RED, GREEN), (30, 48), strict=True):
        assert db(draw(result.splats, camera), np.array(color), disk(camera, x, 48, 6)) > 16
        assert score.psnr_before is not None and score.psnr_after is not None
        assert score.psnr_after > score.psnr_before + 6
        assert edit.camera is camera
    front_rows, rear_rows = receipt.touched < 45 * 45, receipt.touched >= 45 * 45
    assert front_rows.sum() > 20 and rear_rows.sum() > 20


def test_a_second_edit_starts_from_the_first_ones_result(tmp_path):
    splats = object_()
    sp.write(tmp_path / "a.ply", splats)
    read = sp.read(tmp_path / "a.ply")
    first = apply(read, [dab(read, RED, 30)])
    second = Painter.load("lift").apply(first, [dab(first.splats, BLUE, 66)])
    one, two = receipt_of(first), receipt_of(second)
    assert one.asset_sha256 == hashlib.sha256((tmp_path / "a.ply").read_bytes()).hexdigest()
    # The second is not an edit of that file any more.
    rows = b"".join(getattr(first.splats, name).tobytes() for name in NAMES)
    assert two.asset_sha256 == hashlib.sha256(rows).hexdigest()
    assert two.asset_rows == len(first.splats) == one.output_rows
    np.testing.assert_array_equal(two.touched, np.flatnonzero(differing(first.splats, second.splats)))
    assert second.splats.origin is not None and len(second.splats.origin) == len(second.splats)
    parents = second.splats.origin[len(read) :]
    assert (parents >= 0).all() and (parents < len(read)).all()


# Plain optimisation


def test_fit_changes_reached_rows_only_and_brings_the_picture_nearer_than_the_lift():
    splats = object_()
    edit = dab(splats, RED)
    result, lifted = (apply(splats, [edit], method=method) for method in ("fit", "lift"))
    receipt = receipt_of(result)
    mask = np.abs(edit.image - draw(splats)).max(-1) > 4 / 255
    reached = gaussians_in_mask(splats, CAMERA, mask)
    assert len(result.splats) == len(lifted.splats) > len(splats) and receipt.method == "fit"
    assert set(receipt.seconds) >= {"lift", "fit"} and (receipt.touched < 45 * 45).all()
    assert np.isin(receipt.touched, np.flatnonzero(reached)).mean() > 0.8  # the others lie under the sheet
    np.testing.assert_array_equal(receipt.touched, np.flatnonzero(differing(splats, result.splats)))
    assert receipt.untouched_sha256_after == hash_without(splats, receipt.touched, len(splats))
    score = receipt.views[0]
    first = receipt_of(lifted).views[0]
    assert score.psnr_after is not None and first.psnr_after is not None and score.psnr_after > first.psnr_after
    assert score.psnr_outside is not None and first.psnr_outside is not None
    assert score.psnr_outside > first.psnr_outside + 1
    assert db(draw(result.splats, back(96)), draw(splats, back(96)), np.ones((96, 96), bool)) > 35


def test_fitted_rows_stay_valid_and_the_others_keep_their_bits():
    splats = object_()
    splats.opacities[:50] = 1.0  # logit 1 is infinite
    splats.opacities[50:60] = 0.0
    rows = np.r_[0:60, 1000:1005]
    target = np.clip(draw(splats) + 0.2, 0, 1)
    fitted = fit_edited(splats, splats, [(CAMERA, target)], rows, EditFitOptions(steps=4))
    remaining = np.delete(np.arange(len(splats)), rows)
    assert not differing(splats, fitted)[remaining].any() and differing(splats, fitted)[rows].any()
    assert fitted.drawable[rows].all() and (fitted.opacities[rows] >= 0).all() and (fitted.opacities[rows] <= 1).all()
    assert all(getattr(fitted, name).dtype == np.float32 for name in NAMES)


# What it cannot do


def grey(camera: Camera = CAMERA) -> np.ndarray:
    return np.full((camera.height, camera.width, 3), 0.3, np.float32)


def edit_once(**how) -> Callable[[Splats], object]:
    return lambda splats: apply(splats, [dab(splats, RED)], **how)


ERRORS: dict[str, tuple[Callable[[Splats], object], str]] = {
    "no edits": (lambda s: apply(s, []), "1 to 16 .* got 0"),
    "17 edits": (lambda s: apply(s, [dab(s, RED)] * 17), "1 to 16 .* got 17"),
    "nothing painted": (lambda s: apply(s, [dab(s, RED, radius=0)]), "does not differ"),
    "empty mask": (lambda s: apply(s, [Edit(grey(), CAMERA, np.zeros((96, 96)))]), "mask is empty"),
    "painted on the air": (
        lambda s: apply(s, [Edit(grey(), CAMERA, disk(CAMERA, 2, 2, 2))]),
        "no Gaussian contributes",
    ),
    "looking away": (
        lambda s: apply(s, [Edit(grey(), look_at((0, 0, 3), (0, 0, 9), width=96, height=96), np.ones((96, 96)))]),
        "no Gaussian contributes",
    ),
    "looking away, global": (
        lambda s: apply(s, [Edit(grey(), look_at((0, 0, 3), (0, 0, 9), width=96, height=96))], mode="global"),
        "not in view",
    ),
    "wrong size": (lambda s: Edit(grey()[:95], CAMERA), r"\[96, 96, 3\].*\[95, 96, 3\]"),
    "with alpha": (lambda s: Edit(np.zeros((96, 96, 4)), CAMERA), r"\[96, 96, 3\].*\[96, 96, 4\]"),
    "grey picture": (lambda s: Edit(np.zeros((96, 96)), CAMERA), r"\[96, 96, 3\].*\[96, 96\]"),
    "wrong mask": (lambda s: Edit(grey(), CAMERA, np.ones((96, 95))), r"\[96, 96\].*\[96, 95\]"),
    "NaN pixels": (lambda s: Edit(np.where(grey() > 0, np.nan, 0), CAMERA), "NaN"),
    "infinite pixels": (lambda s: Edit(np.where(grey() > 0, np.inf, 0), CAMERA), "NaN or infinite"),
    "bytes as integers": (lambda s: Edit(np.full((96, 96, 3), 200), CAMERA), "int64"),
    "bytes as floats": (lambda s: Edit(np.full((96, 96, 3), 200.0), CAMERA), "0..1.*200"),
    "inside the object": (
        lambda s: apply(s, [Edit(grey(), look_at((0.1, 0.1, 0.001), (0.1, 0.1, -1), width=96, height=96))]),
        "inside the object",
    ),
    "no weights": (edit_once(method="ttt"), "weights"),
    "unknown method": (edit_once(method="magic"), "auto, ttt, corrected, lift or fit.*'magic'"),
    "unknown mode": (edit_once(mode="everywhere"), "local, global, spread.*'everywhere'"),
    "fit is local": (edit_once(mode="global", method="fit"), "'fit' is for local"),
    "unknown preset": (lambda s: Painter.load("paper"), "'paper': no trained weights.*'lift'"),
    "nothing to draw": (
        lambda s: Painter.load("lift").encode(replace(s, opacities=np.full(len(s), np.nan, np.float32))),
        "none of the 2427 Gaussians",
    ),
}


@pytest.mark.parametrize("case", ERRORS)
def test_errors_are_one_line(case):
    call, pattern = ERRORS[case]
    splats = object_()
    with pytest.raises(ValueError, match=pattern) as error:
        call(splats)
    text = str(error.value)
    assert "\n" not in text and 10 < len(text) < 250 and text[0].islower()


def test_the_wrong_one_of_several_edits_is_named():
    splats = object_()
    good = replace(dab(splats, RED), name="good.png")
    for wrong in (
        Edit(grey(), CAMERA, np.zeros((96, 96)), name="bad.png"),
        Edit(grey(), CAMERA, disk(CAMERA, 2, 2, 2), name="bad.png"),
    ):
        with pytest.raises(ValueError, match=r"^bad\.png: ") as error:
            apply(splats, [good, wrong])
        assert "\n" not in str(error.value)


def test_tensors_become_an_asset_too():
    splats = object_()
    asset = Painter.load("lift").encode(splats.torch())
    assert same_bits(asset.splats, splats)
    assert Painter.load("lift").encode(splats).splats is splats


def test_pictures_may_be_bytes_or_floats():
    image = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)
    np.testing.assert_allclose(Edit(image, CAMERA).image, image / 255, atol=1e-7)
    for kind in (np.float16, np.float32, np.float64):
        edit = Edit((image / 255).astype(kind), CAMERA, np.eye(96) * 255)
        assert edit.image.dtype == np.float32 and edit.mask is not None and edit.mask.dtype == bool
        assert edit.mask.sum() == 96
    assert math.isclose(float(Edit(np.full((96, 96, 3), 1.3), CAMERA).image.max()), 1.3, rel_tol=1e-6)  # bright renders
