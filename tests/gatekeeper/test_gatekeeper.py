"""What comes back from a source is laid over the render, corrected and cut: outside of what changed not a bit moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.color import linear_to_srgb, srgb_to_linear
from splatpainter.gatekeeper.color_drift import estimate_drift
from splatpainter.gatekeeper.gate_report import numbers, report_page
from splatpainter.gatekeeper.gatekeeper import admit, consistent, pooled
from splatpainter.pictures.picture_reader import resample
from splatpainter.sources.picture_source import PictureAnswer, PictureRequest, SourceError
from tests.support.distorted_pictures import drawn_scene, jpeg, moved, painted_over

SIZE = 200
BOX = slice(80, 130), slice(70, 120)


def scene(seed: int = 0) -> tuple[PictureRequest, np.ndarray]:
    """(the request, its picture with a blue box painted on)."""
    image, alpha = drawn_scene(SIZE, seed)
    painted = image.copy()
    painted[BOX] = 0.3 * image[BOX] + 0.7 * np.array([0.1, 0.2, 0.9])
    return PictureRequest(image, alpha), painted


def box_mask(margin: int = 6) -> np.ndarray:
    mask = np.zeros((SIZE, SIZE), np.float32)
    mask[80 - margin : 130 + margin, 70 - margin : 120 + margin] = 1
    return mask


def test_a_painted_picture_comes_through_and_all_else_stays() -> None:
    request, painted = scene()
    result = admit(painted, request)
    assert result.drift.kind == "none" and result.notes == () and result.factor == 1
    assert result.registration.is_still(SIZE, SIZE)
    inner = (slice(83, 127), slice(73, 117))
    assert np.array_equal(result.image[inner], painted[inner])
    untouched = ~result.changed
    assert np.array_equal(result.image[untouched], request.image[untouched])
    assert not result.changed[:70].any() and result.changed[inner].mean() > 0.99
    assert ((result.weight > 0) & (result.weight < 1)).any()  # soft edges


def test_a_picture_that_changed_at_every_pixel() -> None:
    request, _ = scene()
    magenta = (0.3 * request.image + 0.7 * np.array([1, 0, 1])).astype(np.float32)
    assert admit(magenta, request).changed[request.alpha > 0.5].all()


@pytest.mark.parametrize("seed", range(3))
def test_a_moved_recoloured_compressed_picture_is_put_right(seed: int) -> None:
    request, painted = scene(seed)
    picture, _ = moved(painted, scale=1.02, degrees=0.8, right=3.3, down=-2.2, size=300)
    drifted = linear_to_srgb(srgb_to_linear(picture) * np.array([1.2, 1.1, 0.9]))
    result = admit(jpeg(np.clip(drifted, 0, 1), 88), replace(request, mask=box_mask()))
    gains = 1 / np.diag(result.drift.matrix[:, :3])
    assert result.drift.kind.startswith("gain") and np.allclose(gains, [1.2, 1.1, 0.9], atol=0.03)
    outside = box_mask() == 0
    assert np.array_equal(result.image[outside], request.image[outside]) and not result.changed[outside].any()
    inner = (slice(86, 124), slice(76, 114))
    assert np.abs(result.image[inner] - painted[inner]).mean() < 0.02
    assert any("moved back" in note for note in result.notes) and any("stops" in note for note in result.notes)


def test_drift_without_a_mask_is_estimated_on_what_agrees() -> None:
    request, painted = scene(1)
    drifted = linear_to_srgb(np.clip(srgb_to_linear(painted_over(painted, 0.2, 3)) * 0.85 + 0.01, 0, 1))
    result = admit(drifted, request)
    assert result.drift.kind == "gain and offset" and result.drift.agreeing > 0.6
    assert np.allclose(result.drift.matrix[:, 3], -0.01 / 0.85, atol=0.002)
    assert result.share < 0.75
    regraded = admit(np.clip(request.image * np.array([1.1, 1.0, 0.85]), 0, 1), request, regraded=True)
    assert regraded.drift.kind == "none" and regraded.share > 0.9


def linear(image: np.ndarray, gains: tuple[float, float, float]) -> np.ndarray:
    """A picture whose light was multiplied."""
    return linear_to_srgb(np.clip(srgb_to_linear(image) * np.array(gains), 0, 1)).astype(np.float32)


WARM, NIGHT = (1.9, 1.0, 0.45), (0.05, 0.07, 0.14)
TONES = {
    "warm": lambda image: linear(image, WARM),
    "mild": lambda image: linear(image, (1.25, 1.0, 0.8)),
    "night": lambda image: linear(image, NIGHT),
    "brighter": lambda image: linear(image, (4.0, 4.0, 4.0)),
    "contrast": lambda image: np.clip(0.5 + 1.6 * (image - 0.5), 0, 1),
    "hue": lambda image: np.roll(image, 1, -1),
    "jpeg of warm": lambda image: jpeg(linear(image, WARM), 90),
    "jpeg of night": lambda image: jpeg(linear(image, NIGHT), 90),
}


@pytest.mark.parametrize("tone", TONES)
def test_a_view_whose_tone_changed_as_a_whole_is_taken_as_it_is(tone: str) -> None:
    request, _ = scene(4)
    picture = TONES[tone](request.image).astype(np.float32)
    result = admit(picture, request)
    solid = request.alpha > 0.9
    assert result.drift.kind == "none" and result.share > 0.95
    assert np.abs(result.image - picture)[solid].mean() < 0.01
    assert result.toned == any("mode global carries it" in note for note in result.notes)
    assert result.record()["colors"] == ({"kind": "tone"} if result.toned else result.drift.record())
    regraded = admit(picture, request, regraded=True)
    assert regraded.share > 0.95 and not regraded.toned


def test_a_tone_that_may_be_a_drift_is_refused_by_strict_with_the_ways_to_have_it() -> None:
    request, painted = scene(4)
    for picture in (linear(request.image, WARM), linear(request.image, NIGHT)):
        with pytest.raises(SourceError, match="changed its tone everywhere.*nothing else; mode global.*normal takes"):
            admit(picture, request, strictness="strict")
        assert admit(picture, request, strictness="loose").toned
    dark = linear(painted, (0.15, 0.15, 0.15))  # something else changed as well
    with pytest.raises(SourceError, match="drifted by 2.7 stops.*mode global takes.*strictness loose takes"):
        admit(dark, request)
    assert not admit(dark, request, strictness="loose").toned
    slight = linear(request.image, (1.04, 1.0, 0.97))
    with pytest.raises(SourceError, match="unchanged"):
        admit(slight, request)


def test_a_tone_within_a_mask_is_taken_there_and_nowhere_else() -> None:
    request, _ = scene(4)
    mask, picture = box_mask(), linear(request.image, NIGHT)
    for sent in (True, False):  # a source that takes no mask darkens everything
        result = admit(picture, replace(request, mask=mask), mask_sent=sent)
        assert result.toned and any("within the mask" in note for note in result.notes)
        assert np.array_equal(result.image[mask == 0], request.image[mask == 0])
        inner = (box_mask(-5) > 0) & (request.alpha > 0.9)
        assert np.abs(result.image - picture)[inner].max() < 0.01
    with pytest.raises(SourceError, match="changed its tone everywhere.*nothing else; strictness normal takes it"):
        admit(picture, replace(request, mask=mask), strictness="strict")


def test_a_material_that_was_recoloured_without_a_mask_changes_alone() -> None:
    request, _ = scene(5)
    material = (request.image[..., 0] > request.image[..., 2] + 0.1) & (request.alpha > 0.5)
    assert 0.1 < material.sum() / (request.alpha > 0.5).sum() < 0.6
    recoloured = np.where(material[..., None], np.roll(request.image, 1, -1), request.image)
    for picture in (recoloured, linear(recoloured, (1.1, 1.05, 0.95)), jpeg(recoloured, 95)):
        result = admit(picture.astype(np.float32), request)
        assert not result.toned and result.share < 0.75
        assert result.changed[material].mean() > 0.9


def test_a_regraded_picture_that_is_the_same_but_for_compression_is_unchanged() -> None:
    request, _ = scene(4)
    with pytest.raises(SourceError, match="unchanged"):
        admit(jpeg(request.image, 92), request, regraded=True)


def test_mixed_channels_are_unmixed() -> None:
    request, _ = scene(2)
    mix = np.array([[0.9, 0.08, 0.02], [0.05, 0.9, 0.05], [0.02, 0.1, 0.88]])
    picture = linear_to_srgb(np.clip(srgb_to_linear(request.image) @ mix.T, 0, 1)).astype(np.float32)
    drift = estimate_drift(picture, request.image, np.ones((SIZE, SIZE), bool), True)
    assert drift.kind == "matrix" and np.abs(drift.corrected(picture) - request.image).mean() < 0.5 / 255
    assert drift.corrected(picture) is not picture
    none = estimate_drift(request.image, request.image, np.ones((SIZE, SIZE), bool), True)
    assert none.kind == "none" and none.corrected(picture) is picture


def test_outside_the_mask_nothing_changes_whatever_came() -> None:
    request, painted = scene()
    ruined = painted_over(painted, 0.25, 4)
    mask = box_mask()
    result = admit(ruined, replace(request, mask=mask), strictness="loose")
    assert np.array_equal(result.image[mask == 0], request.image[mask == 0]) and result.spilled > 0.05
    assert any("put back" in note for note in result.notes)
    with pytest.raises(SourceError, match="outside the mask changed.*strict"):
        tinted = painted.copy()
        tinted[:75] = 0.7 * tinted[:75] + 0.3 * np.array([0.9, 0.2, 0.1])
        admit(tinted, replace(request, mask=mask), strictness="strict")
    soft = mask * 0.5
    half = admit(painted, replace(request, mask=soft))
    assert half.weight.max() == 0.5


def test_an_unchanged_picture_changes_nothing() -> None:
    request, _ = scene()
    for picture in (request.image, resample(request.image, 400, 400), moved(request.image, right=2.6, down=-1.2)[0]):
        with pytest.raises(SourceError, match="unchanged"):
            admit(picture, request)
    compressed = jpeg(request.image, 92)
    result = admit(compressed, request)  # saturated stripes: what is left is noise where they were stored at half size
    assert result.share < 0.06
    assert np.abs(result.image - request.image).mean() < 0.1 * np.abs(compressed - request.image).mean()


def test_wrong_pictures_are_refused_with_their_score() -> None:
    request, _ = scene()
    noise = np.random.default_rng(0).uniform(size=(SIZE, SIZE, 3)).astype(np.float32)
    for other in (drawn_scene(SIZE, 9)[0], noise, np.zeros((SIZE, SIZE, 3), np.float32)):
        with pytest.raises(SourceError, match=r"something other.*agree by -?0\.\d\d of 1, expected 0\.38"):
            admit(other, request)


def test_a_mask_the_wrong_way_round_is_recognised() -> None:
    request, _ = scene(3)
    mask = np.zeros((SIZE, SIZE), np.float32)
    mask[:, :100] = 1
    other = 1 - drawn_scene(SIZE, 8)[0]
    picture = np.where(mask[..., None] > 0, request.image, 0.5 * request.image + 0.5 * other).astype(np.float32)
    with pytest.raises(SourceError, match="wrong way round"):
        admit(picture, replace(request, mask=mask))
    assert admit(picture, replace(request, mask=1 - mask)).share > 0.2
    with pytest.raises(SourceError, match="mask is empty"):
        admit(picture, replace(request, mask=0 * mask))
    rim = np.convolve(mask[0], np.ones(7) / 7, "same").astype(np.float32)  # of a mask that was drawn at another size
    softened = (request.image + (1 - rim[:, None]) * (picture - request.image)).astype(np.float32)
    with pytest.raises(SourceError, match="wrong way round"):
        admit(softened, replace(request, mask=np.tile(rim, (SIZE, 1))))


def test_strictness_says_how_far_a_picture_may_be_off() -> None:
    request, painted = scene()
    picture, _ = moved(painted, right=5)
    assert admit(picture, request).registration.right == pytest.approx(5, abs=0.1)
    with pytest.raises(SourceError, match="moved by 2.5 %, expected at most 1 %.*strict"):
        admit(picture, request, strictness="strict")
    with pytest.raises(SourceError, match="came back cropped"):
        admit(np.ascontiguousarray(painted[20:-20]), request, strictness="strict")
    cropped = admit(np.ascontiguousarray(painted[20:-20]), request)
    assert cropped.notes == ("came back cropped",)
    assert np.array_equal(cropped.image[:18], request.image[:18]) and cropped.changed[90:120, 80:110].all()
    dark = linear_to_srgb(srgb_to_linear(painted) * 0.2).astype(np.float32)
    with pytest.raises(SourceError, match="drifted by 2.3 stops"):
        admit(dark, request)


def test_transparent_parts_of_an_answer_change_nothing() -> None:
    request, painted = scene()
    alpha = np.zeros((SIZE, SIZE, 1), np.float32)
    alpha[60:140, 60:140] = 1
    ruined = np.where(alpha > 0, painted, 0)
    result = admit(np.concatenate([ruined, alpha], -1), request)
    assert np.array_equal(result.image[alpha[..., 0] == 0], request.image[alpha[..., 0] == 0])
    assert result.changed[90:120, 80:110].all()


def test_enlarged_pictures_are_consistent_with_the_render() -> None:
    fine, alpha = drawn_scene(2 * SIZE, 5)
    render = pooled(fine, 2)
    request = PictureRequest(render, pooled(np.repeat(alpha[..., None], 3, -1), 2)[..., 0], scale=2)
    smooth = resample(render, 2 * SIZE, 2 * SIZE)
    sharp = np.clip(
        smooth + 0.8 * (smooth - resample(resample(render, SIZE // 2, SIZE // 2), 2 * SIZE, 2 * SIZE)), 0, 1
    )
    sharp[200:240, 180:220] = (0.1, 0.8, 0.2)  # and an edit
    result = admit(sharp, request, enlarged=lambda k: resample(render, SIZE * k, SIZE * k))
    assert result.factor == 2 and result.image.shape == (2 * SIZE, 2 * SIZE, 3)
    assert np.allclose(result.image[210:230, 190:210], (0.1, 0.8, 0.2), atol=0.05)
    away = np.ones((SIZE, SIZE), bool)
    away[90:130, 80:120] = False
    assert np.abs(pooled(result.aligned, 2) - render)[away].max() < 2 / 255
    rng = np.random.default_rng(0)
    blurred = np.clip(fine + rng.normal(0, 0.1, fine.shape), 0, 1).astype(np.float32)
    held = consistent(blurred, render, np.zeros((SIZE, SIZE), bool))
    assert np.abs(pooled(held, 2) - render).max() < 1e-3
    assert np.abs(held - pooled(held, 2).repeat(2, 0).repeat(2, 1)).mean() > 0.02  # detail stays


def test_a_larger_answer_that_nobody_asked_for_changes_only_what_was_edited() -> None:
    fine, alpha = drawn_scene(2 * SIZE, 5)
    render = pooled(fine, 2)
    request = PictureRequest(render, pooled(np.repeat(alpha[..., None], 3, -1), 2)[..., 0])
    larger = resample(render, 2 * SIZE, 2 * SIZE)  # softer than a render of that size everywhere
    with pytest.raises(SourceError, match="unchanged"):
        admit(larger, request, enlarged=lambda k: fine)
    larger[200:240, 180:220] = (0.1, 0.8, 0.2)
    result = admit(larger, request, enlarged=lambda k: fine)
    away = np.ones((2 * SIZE, 2 * SIZE), bool)
    away[184:256, 164:236] = False
    assert result.factor == 2 and not result.changed[away].any() and result.changed[204:236, 184:216].all()
    assert np.array_equal(result.image[away], fine[away])
    assert admit(larger, replace(request, scale=2), enlarged=lambda k: fine).changed[away].any()


def test_what_a_drift_clipped_is_no_edit() -> None:
    image, alpha = drawn_scene(SIZE, 1)
    request = PictureRequest(np.clip(2 * image, 0, 0.93).astype(np.float32), alpha)
    painted = request.image.copy()
    painted[BOX] = (0.1, 0.2, 0.9)
    drifted = linear(painted, (1.35, 1.0, 0.85))
    assert np.any(drifted > 0.999, axis=-1)[request.alpha > 0.5].mean() > 0.03
    result = admit(drifted, request)
    away = np.ones((SIZE, SIZE), bool)
    away[70:140, 60:130] = False
    assert result.drift.kind.startswith("gain") and not result.changed[away].any()
    inner = (box_mask(-5) > 0) & (alpha > 0.9)
    assert result.changed[inner].all() and np.abs(result.image - painted)[inner].max() < 0.02


def test_a_mirror_image_is_refused_as_one() -> None:
    image, alpha = drawn_scene(SIZE, 2)
    round_image = 0.5 * (image + image[:, ::-1])  # as of a turned pot: the edges of both halves are alike
    request = PictureRequest((0.5 * round_image + 0.5 * image).astype(np.float32), alpha)
    with pytest.raises(SourceError, match=r"came back mirrored: its edges agree by 0\.\d\d of 1, flipped.* by 1\.00"):
        admit(request.image[:, ::-1], request)


def test_the_report_is_one_page_of_pictures() -> None:
    request, painted = scene()
    answer = PictureAnswer(np.concatenate([painted, np.ones((SIZE, SIZE, 1), np.float32)], -1), "tool")
    admitted = admit(answer.image, replace(request, mask=box_mask()))
    page = report_page([(request, answer, admitted)], "tool: a blue box")
    assert page.dtype == np.uint8 and page.shape[1] > 4 * 360 and page.shape[0] > 2 * 360
    two = report_page([(request, answer, admitted)] * 2)
    assert two.shape[0] > 1.8 * page.shape[0]
    refused = report_page([(request, answer, admitted), (request, answer, None)])
    assert page.shape[0] < refused.shape[0] < two.shape[0]
    assert "agrees 1.00; full" in numbers(admitted) or "agrees 0.9" in numbers(admitted)


@pytest.mark.parametrize("shape", [(1, 1, 4), (3, 300, 3)])
def test_answers_of_absurd_shapes_are_refused_in_one_line(shape: tuple[int, int, int]) -> None:
    request, _ = scene()
    small = replace(request, image=request.image[60:124, 60:124], alpha=request.alpha[60:124, 60:124])
    picture = np.random.default_rng(0).uniform(size=shape).astype(np.float32)
    with pytest.raises(SourceError, match="source: the picture") as refusal:
        admit(picture, small)
    assert "\n" not in str(refusal.value)
