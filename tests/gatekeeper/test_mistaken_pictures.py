"""Mistakes that change all of a picture are named; paint, however much, is none."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFilter
from scipy.ndimage import distance_transform_edt, maximum_filter

from splatpainter.cameras import orbit_cameras
from splatpainter.color import to_display
from splatpainter.gatekeeper.bent_pictures import bend_of
from splatpainter.gatekeeper.fitted_mistakes import moved_a_little
from splatpainter.gatekeeper.gatekeeper import admit
from splatpainter.gatekeeper.mistaken_pictures import explain, filtered
from splatpainter.gatekeeper.picture_gate import _beside_itself
from splatpainter.gatekeeper.small_copies import visible_after
from splatpainter.io import read
from splatpainter.lift.masks import box_mean, contrast, dilated
from splatpainter.pictures.edit_files import draw
from splatpainter.sources.picture_source import PictureRequest
from tests.support.distorted_pictures import drawn_scene, jpeg, moved
from tests.support.drawn_views import ALPHA, VIEW, decoded, eight_bits, encoded, green_dab, on_the_asset, over, top

OTHER_VIEW = drawn_scene(240, seed=5)[0]
RNG = np.random.default_rng(3)


def grey_by_pillow(colors: np.ndarray) -> np.ndarray:
    picture = Image.fromarray((colors * 255).round().astype(np.uint8)).convert("L").convert("RGB")
    return np.asarray(picture, np.float32) / 255


MISTAKES: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "mirrored": ("mirrored from left to right", lambda p: p[:, ::-1]),
    "flipped": ("mirrored from top to bottom", lambda p: p[::-1]),
    "upside down": ("turned upside down", lambda p: p[::-1, ::-1]),
    "on its side": ("turned by 90 degrees clockwise", lambda p: np.rot90(p, -1)),
    "linear": ("linear light without a profile", decoded),
    "encoded twice": ("sRGB numbers in a file of linear light", encoded),
    "gamma 1.8": ("another gamma, 1.8 for 2.2", lambda p: p ** (1.8 / 2.2)),
    "gamma 2.2": ("another gamma, 2.2 for 1.8", lambda p: p ** (2.2 / 1.8)),
    "video": ("in limited video levels", lambda p: (16 + 219 * p) / 255),
    "stretched": ("stretched as if it were video levels", lambda p: (255 * p - 16) / 219),
    "blue and red": ("red and blue exchanged", lambda p: p[..., ::-1]),
    "negative": ("inverted", lambda p: 1 - p),
    "grey": ("grey", grey_by_pillow),
    "brighter": ("graded as a whole (exposure", lambda p: encoded(1.3 * decoded(p))),
    "darker": ("graded as a whole (exposure", lambda p: encoded(0.7 * decoded(p))),
    "warmer": ("graded as a whole (exposure", lambda p: encoded(decoded(p) * np.array([1.25, 1, 0.7]))),
    "moved": ("moved, scaled or turned", lambda p: moved(p, right=15, down=-9)[0]),
    "shrunk": ("moved, scaled or turned", lambda p: moved(p, scale=0.85)[0]),
    "posterised": ("posterised: it has", lambda p: np.floor(4 * p) / 4),
    "another": ("of another asset, another view", lambda p: OTHER_VIEW),
    "mirrored JPEG": ("mirrored from left to right", lambda p: jpeg(np.ascontiguousarray(p[:, ::-1]), 50)),
    "linear JPEG": ("linear light without a profile", lambda p: jpeg(decoded(p).astype(np.float32), 80)),
}


@pytest.mark.parametrize(("words", "made"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_named(words: str, made: Callable[[np.ndarray], np.ndarray]) -> None:
    explanation = explain(eight_bits(made(VIEW)), VIEW, ALPHA)
    assert explanation is not None and words in explanation.words, explanation
    assert explanation.agreeing < 0.5


@pytest.mark.parametrize("name", ["mirrored", "linear", "encoded twice", "blue and red", "brighter", "video"])
def test_what_can_be_undone_comes_back(name: str) -> None:
    picture = eight_bits(MISTAKES[name][1](VIEW))
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and explanation.mistake is not None and explanation.mistake.undone is not None
    assert np.abs(explanation.mistake.undone(picture) - VIEW).max() < 0.05


def test_a_mistake_is_named_under_paint() -> None:
    picture = VIEW[:, ::-1].copy()
    picture[60:150, 60:150] = (0.9, 0.2, 0.1)
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and "left to right" in explanation.words


def confetti() -> np.ndarray:
    tiles = RNG.uniform(size=(20, 20, 3)).astype(np.float32)
    return tiles.repeat(12, 0).repeat(12, 1)


def blurred(colors: np.ndarray) -> np.ndarray:
    picture = Image.fromarray((colors * 255).round().astype(np.uint8)).filter(ImageFilter.GaussianBlur(3))
    return np.asarray(picture, np.float32) / 255


PAINT: dict[str, Callable[[], np.ndarray]] = {
    "nothing": lambda: VIEW,
    "a dab": lambda: over(np.hypot(*np.mgrid[-120:120, -120:120])[..., None] < 12, (0.9, 0.1, 0.1)),
    "an airbrush": lambda: over(
        np.exp(-(np.hypot(*np.mgrid[-120:120, -120:120])[..., None] ** 2) / 2000), (0.1, 0.3, 0.9), 0.3
    ),
    "a big brush": lambda: over(top(0.6), (0.2, 0.5, 0.3)),
    "a brush over nearly all": lambda: over(top(0.9), (0.2, 0.5, 0.3)),
    "all one colour": lambda: over(top(1.0), (0.2, 0.5, 0.3)),
    "a decal over 60 %": lambda: VIEW + top(0.6) * (confetti() - VIEW),
    "a decal over 90 %": lambda: VIEW + top(0.9) * (confetti() - VIEW),
    "a pattern multiplied on all": lambda: VIEW * (1 - top(1.0) * 0.6 * (1 - confetti())),
    "dodged half": lambda: VIEW * (1 + 0.3 * top(0.5)),
    "burnt half": lambda: VIEW * (1 - 0.3 * top(0.5)),
    "recoloured 70 %": lambda: VIEW + top(0.7) * (VIEW[..., ::-1] - VIEW),
    "recoloured 85 %": lambda: VIEW + top(0.85) * (VIEW[..., ::-1] - VIEW),
    "a curve on 75 %": lambda: VIEW + top(0.75) * (decoded(VIEW) - VIEW),
    "inverted 60 %": lambda: VIEW + top(0.6) * (1 - 2 * VIEW),
    "cloned": lambda: np.where(top(0.4) > 0, np.roll(VIEW, 30, 1), VIEW),
    "blurred half": lambda: np.where(top(0.5) > 0, blurred(VIEW), VIEW),
    "a grade of 80 % with a soft edge": lambda: VIEW * (1 + blurred(top(0.8).repeat(3, -1)) * np.array([0.2, 0, -0.2])),
    "a gradient on half": lambda: VIEW + top(0.5) * 0.4 * (np.linspace(0, 1, 240)[:, None] - VIEW),
    "a big brush, JPEG": lambda: jpeg(over(top(0.6), (0.2, 0.5, 0.3)), 70),
    "a dab, poor JPEG": lambda: jpeg(
        over(np.hypot(*np.mgrid[-120:120, -120:120])[..., None] < 20, (0.9, 0.1, 0.1)), 40
    ),
    "nothing, poor JPEG": lambda: jpeg(VIEW, 40),
}


@pytest.mark.parametrize("made", PAINT.values(), ids=PAINT)
def test_paint_is_no_mistake(made: Callable[[], np.ndarray]) -> None:
    explanation = explain(eight_bits(made()), VIEW, ALPHA)
    assert explanation is None or ("painted over everywhere" in explanation.words and explanation.cause == "look")
    assert (explanation is None) == (made not in (PAINT["all one colour"], PAINT["a pattern multiplied on all"]))


@pytest.mark.parametrize("name", ["linear", "encoded twice", "linear JPEG"])
@pytest.mark.parametrize("share", [0.6, 0.75])
def test_a_curve_through_all_is_named_under_much_paint(name: str, share: float) -> None:
    """What is left of it has many tones, and no paint follows a curve through them. Black behind it stays black."""
    words, made = MISTAKES[name]
    view = VIEW * ALPHA[..., None]
    picture = eight_bits(made(view + top(share) * (confetti() - view)))
    explanation = explain(picture, view, ALPHA)
    assert explanation is not None and words in explanation.words and not explanation.may_be_meant, explanation


@pytest.mark.parametrize("rest", [0.5 * VIEW, 0.8 * VIEW, VIEW * 0.6 + 0.1, decoded(VIEW) * 0.8, VIEW**1.6])
def test_paint_over_all_in_two_ways_is_no_curve(rest: np.ndarray) -> None:
    """A decal on the upper part, a glaze or a darker grade on the rest."""
    decal = top(0.6)
    explanation = explain(eight_bits(VIEW + top(1.0) * (rest - VIEW) + decal * (confetti() - rest)), VIEW, ALPHA)
    assert explanation is None or explanation.may_be_meant, explanation


def radius() -> np.ndarray:
    """[H, W, 1] 0 in the middle of the picture, 1 in its corners."""
    return (np.hypot(*np.mgrid[-119.5:120, -119.5:120]) / np.hypot(119.5, 119.5))[..., None]


def saturated(colors: np.ndarray, gain: float) -> np.ndarray:
    grey = colors @ np.array([0.299, 0.587, 0.114])
    return grey[..., None] + gain * (colors - grey[..., None])


def cropped(colors: np.ndarray, rim: int) -> np.ndarray:
    picture = Image.fromarray((colors * 255).round().astype(np.uint8)).crop((rim, rim, 240 - rim, 240 - rim))
    return np.asarray(picture.resize((240, 240), Image.Resampling.LANCZOS), np.float32) / 255


def bent(colors: np.ndarray, source: Callable[[float, float], tuple[float, float]]) -> np.ndarray:
    """By Pillow's meshes: `source` tells where in the picture a position, -1..1 of both sides, comes from."""
    cells = []
    for top_px in range(0, 240, 12):
        for left in range(0, 240, 12):
            corners = [(left, top_px), (left, top_px + 12), (left + 12, top_px + 12), (left + 12, top_px)]
            moved_to = [source(x / 120 - 1, y / 120 - 1) for x, y in corners]
            cells.append(
                ((left, top_px, left + 12, top_px + 12), [120 * (one + 1) for corner in moved_to for one in corner])
            )
    picture = Image.fromarray((colors * 255).round().astype(np.uint8))
    bent_picture = picture.transform((240, 240), Image.Transform.MESH, cells, Image.Resampling.BICUBIC)
    return np.asarray(bent_picture, np.float32) / 255


def lens(k1: float, k2: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    """Brown's radial terms."""

    def source(x: float, y: float) -> tuple[float, float]:
        square = x * x + y * y
        scale = 1 + k1 * square + k2 * square * square
        return x * scale, y * scale

    return lambda p: bent(p, source)


def aberrated(colors: np.ndarray) -> np.ndarray:
    """Red and blue of other focal lengths than green."""
    larger, smaller = (bent(colors, lambda x, y, size=size: (x * size, y * size)) for size in (1.01, 0.99))
    return np.stack([larger[..., 0], colors[..., 1], smaller[..., 2]], -1)


FITTED: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "vignette": ("towards its corners", lambda p: p * (1 - 0.5 * radius() ** 2)),
    "strong vignette": ("towards its corners", lambda p: p * (1 - 0.8 * radius() ** 4)),
    "dark corners": ("towards its corners", lambda p: p * (1 - 0.6 * np.clip(2 * radius() - 0.9, 0, 1))),
    "white vignette": ("lightened towards its corners", lambda p: 1 - (1 - p) * (1 - 0.6 * radius() ** 2)),
    "gradient": ("from side to side", lambda p: p * np.linspace(1, 0.5, 240)[:, None, None]),
    "more saturation": ("of more saturation", lambda p: np.clip(saturated(p, 1.6), 0, 1)),
    "less saturation": ("of less saturation", lambda p: saturated(p, 0.4)),
    "red and green": ("channels mixed or exchanged", lambda p: p[..., [1, 0, 2]]),
    "by a pixel": ("moved, scaled or turned", lambda p: np.roll(p, 1, 1)),
    "by half a pixel": ("moved, scaled or turned", lambda p: moved(p, right=0.5, down=0.5)[0]),
    "by three pixels": ("moved, scaled or turned", lambda p: np.roll(p, (3, -1), (0, 1))),
    "turned by 3 degrees": ("moved, scaled or turned", lambda p: moved(p, degrees=3)[0]),
    "turned by half a degree": ("moved, scaled or turned", lambda p: moved(p, degrees=0.5)[0]),
    "enlarged by 2 %": ("moved, scaled or turned", lambda p: moved(p, scale=1.02)[0]),
    "cropped and enlarged": ("moved, scaled or turned", lambda p: cropped(p, 3)),
    "barrel": ("distorted by a lens", lens(0.1)),
    "pincushion": ("distorted by a lens", lens(-0.1)),
    "keystone": ("in perspective", lambda p: bent(p, lambda x, y: (x * (1 + 0.05 * y), y))),
    "stretched": ("stretched in one direction", lambda p: bent(p, lambda x, y: (x * 0.96, y))),
    "sheared": ("stretched in one direction", lambda p: bent(p, lambda x, y: (x + 0.04 * y, y))),
    "a shifted channel": (
        "colours that lie beside each other",
        lambda p: np.stack([np.roll(p[..., 0], 2, 1), p[..., 1], p[..., 2]], -1),
    ),
    "chromatic aberration": ("colours that lie beside each other", aberrated),
}
"""Mistakes of an amount that has to be found: part of the words, and how they are made."""


@pytest.mark.parametrize("dabbed", [False, True], ids=["", "dabbed"])
@pytest.mark.parametrize("name", FITTED)
def test_a_mistake_of_unknown_amount_is_named(name: str, dabbed: bool) -> None:
    words, made = FITTED[name]
    picture = np.array(made(VIEW), np.float32)
    if dabbed:
        picture[90:130, 90:120] = (0.1, 0.6, 0.2)
    explanation = explain(eight_bits(picture), VIEW, ALPHA)
    assert explanation is not None and words in explanation.words, explanation


def in_light(colors: np.ndarray) -> np.ndarray:
    return encoded(decoded(colors) * (1 - 0.6 * radius() ** 2))


@pytest.mark.parametrize("dab", [np.s_[90:130, 90:120], np.s_[96:144, 96:144]], ids=["beside", "in the middle"])
@pytest.mark.parametrize("name", ["vignette", "strong vignette", "dark corners", "white vignette", "gradient", "light"])
def test_shades_are_taken_back_and_paint_is_left(name: str, dab: tuple[slice, slice]) -> None:
    """To rounding, also where a dab covers the middle, by which a vignette is told: nothing is painted beside it."""
    painted = VIEW.copy()
    painted[dab] = (0.1, 0.6, 0.2)
    picture = eight_bits(in_light(painted) if name == "light" else FITTED[name][1](painted))
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and explanation.cause == "shade"
    assert explanation.mistake is not None and explanation.mistake.undone is not None
    undone = np.ascontiguousarray(explanation.mistake.undone(picture), np.float32)
    beside = ALPHA > 0.5
    beside[dab] = False
    assert np.quantile(np.abs(undone - painted).max(-1)[beside], 0.99) < 3.5 / 255
    admitted = admit(undone, PictureRequest(VIEW, ALPHA), mask_sent=False)
    beside = admitted.changed.copy()
    beside[84:150, 84:150] = False
    assert admitted.changed[dab].mean() > 0.98 and beside.mean() < 0.002
    assert np.abs(admitted.image - painted)[dab].mean() < 0.015


@pytest.mark.parametrize(("across", "down"), [(0.0, 0.02), (0.0, -0.02), (0.012, 0.0)])
def test_small_bends_are_named(across: float, down: float) -> None:
    """Keystones of 2 % and a stretch of 1 %, which leave more than half of the detail where it was."""
    picture = eight_bits(bent(VIEW, lambda x, y: (x * (1 - across + down * y), y)))
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and explanation.cause == "moved" and not explanation.may_be_meant


@pytest.mark.parametrize(("k1", "k2"), [(-0.15, 0.15), (0.15, -0.15), (0.0, -0.15), (-0.25, 0.07)])
def test_lenses_with_k2_are_named_and_put_right(k1: float, k2: float) -> None:
    """Moustaches, what bends the rim alone, an action camera: no polynomial of degree 3 is near enough."""
    picture = eight_bits(lens(k1, k2)(VIEW))
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and "distorted by a lens" in explanation.words and not explanation.may_be_meant
    assert explanation.mistake is not None and explanation.mistake.undone is not None
    before, after = (
        np.abs(one - VIEW)[ALPHA > 0.5].mean() for one in (picture, np.asarray(explanation.mistake.undone(picture)))
    )
    assert after < 0.4 * before


@pytest.mark.shared
@pytest.mark.parametrize("k1", [0.02, 0.03])
def test_bends_of_fine_detail_are_named(shared: Path, k1: float) -> None:
    """A tall asset whose detail is finer than the bend: its middle, most of its texture, lies where it was."""
    splats = read(shared / "data" / "splats" / "biker.v4.spz")
    drawn, alpha = draw(splats, orbit_cameras(splats, 1, size=240, background=(0.25, 0.25, 0.25))[0])
    view = np.clip(to_display(drawn, splats.color_space), 0, 1).astype(np.float32)
    explanation = explain(eight_bits(lens(k1)(view)), view, np.asarray(alpha, np.float32))
    assert explanation is not None and explanation.cause == "moved" and not explanation.may_be_meant


def test_what_changes_less_than_half_of_an_asset_is_only_remarked() -> None:
    """A vignette that reaches its corners alone; grey where only a quarter of the asset has a colour."""
    corners = explain(eight_bits(VIEW * (1 - 0.8 * radius() ** 6)), VIEW, ALPHA)
    assert corners is not None and corners.cause == "shade" and corners.may_be_meant
    all_of_it = explain(eight_bits(1 - (1 - VIEW) * (1 - 0.9 * radius())), VIEW, ALPHA)
    assert all_of_it is not None and all_of_it.cause == "shade" and not all_of_it.may_be_meant
    mostly_grey = np.where(top(0.75) > 0, grey_by_pillow(VIEW), VIEW)
    grey = explain(grey_by_pillow(mostly_grey), mostly_grey, ALPHA)
    assert grey is not None and grey.words == "grey" and grey.may_be_meant
    grey = explain(grey_by_pillow(VIEW), VIEW, ALPHA)
    assert grey is not None and grey.words == "grey" and not grey.may_be_meant
    # Where the background lost its colours, too, it was done to all of the picture.
    on_blue = mostly_grey + (1 - ALPHA[..., None]) * (np.array([0.1, 0.3, 0.5]) - VIEW[0, 0])
    grey = explain(grey_by_pillow(on_blue), on_blue, ALPHA)
    assert grey is not None and grey.words == "grey" and not grey.may_be_meant


def test_saturation_is_taken_back() -> None:
    explanation = explain(eight_bits(saturated(VIEW, 0.5)), VIEW, ALPHA)
    assert explanation is not None and explanation.mistake is not None and explanation.mistake.undone is not None
    assert np.abs(explanation.mistake.undone(eight_bits(saturated(VIEW, 0.5))) - VIEW).max() < 0.05


@pytest.mark.parametrize("name", ["barrel", "pincushion", "keystone", "stretched", "a shifted channel"])
def test_what_was_bent_is_put_right(name: str) -> None:
    """Within the picture: what was pushed over its rim is gone."""
    picture = eight_bits(FITTED[name][1](VIEW))
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and explanation.mistake is not None and explanation.mistake.undone is not None
    asset = ALPHA > 0.5
    before, after = (
        np.abs(one - VIEW)[asset].mean() for one in (picture, np.asarray(explanation.mistake.undone(picture)))
    )
    assert after < 0.4 * before


def taken_beside_a_dab(view: np.ndarray, name: str) -> dict[str, int]:
    """Pixels that are taken for paint beside a dab on a view that was bent and put right: with nothing known of the
    resampling, with the render as it was in the place of a resampled one, and with that."""
    painted, dab = view.copy(), np.zeros(view.shape[:2], bool)
    dab[100:130, 110:140] = True
    painted[dab] = (0.9, 0.1, 0.1)
    picture = eight_bits(FITTED[name][1](painted))
    explanation = explain(picture, view, ALPHA)
    assert explanation is not None and explanation.cause == "moved" and explanation.mistake is not None
    mistake = explanation.mistake
    assert mistake.undone is not None
    colors = np.ascontiguousarray(mistake.undone(picture), np.float32)
    resampled = np.ascontiguousarray(mistake.undone(mistake.made(view)), np.float32)
    request, beside = PictureRequest(view, ALPHA), {}
    for word, like in {"unknown": None, "as it was": view, "resampled": resampled}.items():
        changed = admit(colors, request, mask_sent=False, resampled=like).changed
        assert changed[dab].mean() > 0.98
        beside[word] = int((changed & ~np.asarray(maximum_filter(dab, 9), bool)).sum())
    return beside


@pytest.mark.parametrize("name", ["barrel", "keystone", "stretched", "a shifted channel"])
def test_what_was_resampled_to_put_it_right_is_no_paint(name: str) -> None:
    """A dab on a picture that was bent: only the dab is taken, as resampling alone changes every edge."""
    beside = taken_beside_a_dab(VIEW, name)
    assert beside["resampled"] <= 0.2 * beside["unknown"] + 20, beside


def test_what_was_pushed_over_the_rim_is_not_known() -> None:
    """A pincushion's rim is not in the picture any more; what stands there repeats its last pixels."""
    explanation = explain(eight_bits(lens(-0.1)(VIEW)), VIEW, ALPHA)
    assert explanation is not None and explanation.mistake is not None and explanation.mistake.undone is not None
    visible = visible_after(explanation.mistake.undone, VIEW.shape)
    # Its first term moves the corners by a fifth of their distance, the middles of the sides by a tenth.
    assert visible[40:200, 40:200].all() and not visible[:4].any() and not visible[:, -4:].any()
    assert 0.6 < visible.mean() < 0.9


@pytest.mark.parametrize("name", ["barrel", "keystone", "stretched"])
def test_detail_that_resampling_blurs_is_no_paint(name: str) -> None:
    grain = np.random.default_rng(3).normal(0, 0.06, VIEW.shape) * (ALPHA[..., None] > 0.5)
    beside = taken_beside_a_dab(np.clip(VIEW + grain, 0, 1).astype(np.float32), name)
    assert beside["resampled"] < 0.5 * beside["as it was"], beside


def test_a_part_that_was_pushed_by_hand_is_paint() -> None:
    """A smudge over half of the asset, with a soft edge: what it did not reach is as it was rendered."""
    share = blurred(top(0.5).repeat(3, -1))
    pushed = bent(VIEW, lambda x, y: (x + 0.03 * np.sin(4 * y), y + 0.03 * np.sin(4 * x)))
    assert explain(eight_bits(VIEW + share * (pushed - VIEW)), VIEW, ALPHA) is None


def test_a_part_that_was_moved_by_hand_is_paint() -> None:
    for part in (top(0.4), top(0.8)):
        assert explain(eight_bits(np.where(part > 0, np.roll(VIEW, 3, 1), VIEW)), VIEW, ALPHA) is None


@pytest.mark.parametrize("name", PAINT)
def test_paint_does_not_lie_beside_its_view(name: str) -> None:
    assert moved_a_little(eight_bits(PAINT[name]()), VIEW, ALPHA, 0.0) is None


PLAIN_ALPHA = np.clip(70 - np.hypot(*(np.mgrid[:240, :240] - 115.5)), 0, 1).astype(np.float32)
LIGHT = (0.8 + 0.2 * np.linspace(-1, 1, 240))[:, None, None] * np.array([0.7, 0.5, 0.2])
PLAIN = (0.25 + PLAIN_ALPHA[..., None] * (LIGHT - 0.25)).astype(np.float32)
"""A ball of one colour: all that tells where it lies is its outline."""


def padded(colors: np.ndarray, rim: int) -> np.ndarray:
    picture = Image.fromarray((colors * 255).round().astype(np.uint8))
    larger = Image.new("RGB", (240 + 2 * rim, 240 + 2 * rim))
    larger.paste(picture, (rim, rim))
    return np.asarray(larger.resize((240, 240), Image.Resampling.LANCZOS), np.float32) / 255


@pytest.mark.parametrize(
    "made",
    [
        lambda p: cropped(p, 4),
        lambda p: cropped(p, 2),
        lambda p: padded(p, 4),
        lambda p: np.roll(p, 3, 1),
    ],
    ids=["cropped by 4", "cropped by 2", "padded by 4", "shifted by 3"],
)
def test_a_plain_asset_that_was_moved_is_told_by_its_outline(made: Callable[[np.ndarray], np.ndarray]) -> None:
    explanation = explain(eight_bits(made(PLAIN)), PLAIN, PLAIN_ALPHA)
    assert explanation is not None and explanation.cause == "moved" and not explanation.may_be_meant


@pytest.mark.parametrize("width", [4, 8, 12])
def test_paint_along_the_outline_of_a_plain_asset_is_no_move(width: int) -> None:
    """A line all around and half of it; the asset's own colour, and the background's, drawn over its edge."""
    away = np.hypot(*(np.mgrid[:240, :240] - 115.5)) - 70
    ring = (np.abs(away) < width)[..., None]
    left = np.arange(240)[None, :, None] < 115
    for picture in (
        np.where(ring, (0.1, 0.5, 0.2), PLAIN),
        np.where(ring & left, (0.1, 0.5, 0.2), PLAIN),
        np.where(ring & left, LIGHT, PLAIN),
        np.where(ring & left, 0.25, PLAIN),
        np.where(ring, 0.25, PLAIN),
    ):
        explanation = explain(eight_bits(picture), PLAIN, PLAIN_ALPHA)
        assert explanation is None or explanation.may_be_meant, explanation


def test_a_soft_brush_over_the_background_is_no_other_asset() -> None:
    """It darkens a third of the background and all of the asset, more in the middle."""
    brush = np.exp(-((np.hypot(*np.mgrid[-120:120, -120:120]) / 130) ** 2))[..., None]
    explanation = explain(eight_bits(VIEW * (1 - 0.4 * brush)), VIEW, ALPHA)
    assert explanation is not None and explanation.cause == "look" and "softly" in explanation.words


def test_a_picture_multiplied_by_its_transparency_is_no_brush() -> None:
    """Half of it transparent, and its colours halved: three quarters of the view are left, and a painted square."""
    picture = 0.75 * VIEW
    picture[90:130, 90:150] = (0.5, 0.3, 0.1)
    explanation = explain(eight_bits(picture), VIEW, ALPHA)
    assert explanation is not None and not explanation.may_be_meant


def test_a_negative_of_the_asset_alone_is_no_glaze() -> None:
    explanation = explain(on_the_asset(1 - VIEW), VIEW, ALPHA)
    assert explanation is not None and not explanation.may_be_meant


def test_a_dark_glaze_in_the_background_s_colour_is_no_other_asset() -> None:
    explanation = explain(on_the_asset(VIEW + 0.7 * (0.25 - VIEW)), VIEW, ALPHA)
    assert explanation is not None and explanation.cause == "look" and "glazed" in explanation.words


def test_another_asset_of_the_very_outline_is_named() -> None:
    other = eight_bits(VIEW + ALPHA[..., None] * (OTHER_VIEW - VIEW))
    explanation = explain(other, VIEW, ALPHA)
    assert explanation is not None and "another" in explanation.words


def pillow(colors: np.ndarray, filter: ImageFilter.Filter) -> np.ndarray:
    picture = Image.fromarray((np.clip(colors, 0, 1) * 255).round().astype(np.uint8)).filter(filter)
    return np.asarray(picture, np.float32) / 255


def pixels(colors: np.ndarray) -> np.ndarray:
    return colors.reshape(40, 6, 40, 6, 3).mean((1, 3)).repeat(6, 0).repeat(6, 1)


@pytest.mark.parametrize(
    ("cause", "made"),
    [
        ("filter", lambda p: pillow(p, ImageFilter.GaussianBlur(4))),
        ("filter", lambda p: pillow(p, ImageFilter.MedianFilter(9))),
        ("filter", pixels),
        ("detail", lambda p: pillow(p, ImageFilter.UnsharpMask(2, 200, 0))),
        ("detail", lambda p: eight_bits(p + RNG.normal(size=p.shape) * 0.08)),
        ("detail", lambda p: eight_bits(p + RNG.normal(size=p.shape) * 0.02)),
        ("detail", lambda p: eight_bits(p + RNG.normal(size=(*p.shape[:2], 1)) * 0.02)),
    ],
)
@pytest.mark.parametrize("dabbed", [False, True])
def test_filters_over_all_of_it_are_named(cause: str, made: Callable[[np.ndarray], np.ndarray], dabbed: bool) -> None:
    picture = made(PAINT["a dab"]() if dabbed else VIEW)
    explanation = filtered(picture, VIEW, ALPHA)
    assert explanation is not None and explanation.cause == cause


@pytest.mark.parametrize("name", PAINT)
def test_paint_is_no_filter(name: str) -> None:
    if "JPEG" not in name:  # compared with what JPEG makes of the render
        assert filtered(eight_bits(PAINT[name]()), VIEW, ALPHA) is None


def test_other_axes_are_asked_for_last() -> None:
    sizes: list[tuple[int, int]] = []

    def other(size: tuple[int, int]) -> list[tuple[str, np.ndarray]]:
        sizes.append(size)
        small = Image.fromarray((OTHER_VIEW * 255).round().astype(np.uint8)).resize(size, Image.Resampling.LANCZOS)
        return [("of the asset with other axes", np.asarray(small, np.float32) / 255)]

    explanation = explain(OTHER_VIEW, VIEW, ALPHA, other)
    assert explanation is not None and explanation.cause == "axes" and sizes == [(160, 160)]
    sizes.clear()
    assert explain(VIEW[:, ::-1], VIEW, ALPHA, other) is not None and not sizes


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (3, 5), (8, 8), (600, 2), (33, 47)])
def test_pictures_of_a_few_pixels_are_judged(size: tuple[int, int]) -> None:
    picture, view = RNG.uniform(size=(2, *size, 3)).astype(np.float32)
    for alpha in (np.zeros(size, np.float32), np.ones(size, np.float32)):
        for one in (picture, view, np.zeros_like(view)):
            explain(one, view, alpha)
    assert explain(view, view, np.ones(size, np.float32)) is None


def test_a_better_picture_of_a_coarse_asset_is_not_taken_for_a_smoothed_one():
    """A close-up of few Gaussians blurs true edges and is full of their own; the true picture has less contrast."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:240, :240]
    rings = np.where(np.hypot(x - 90, y - 80) % 30 < 15, 0.3, 0.7)
    truth = np.repeat(rings[..., None], 3, -1).astype(np.float32)
    noise = box_mean(rng.normal(0, 0.1, (240, 240, 3)).astype(np.float32), 1)
    render = box_mean(box_mean(truth, 4), 4) + noise
    alpha = np.ones(render.shape[:2], np.float32)
    explanation = filtered(box_mean(box_mean(render, 2), 2), render, alpha)
    assert explanation is not None and explanation.cause == "filter"
    contrast_ratio = np.median(contrast(truth)) / np.median(contrast(render))
    assert contrast_ratio < 0.85, "it would be one by its contrast"
    assert filtered(truth, render, alpha) is None
    # The edges of blocks are no detail: JPEG's of low quality, and large pixels.
    for blocks in (jpeg(blurred(render), 5), pixels(render)):
        explanation = filtered(blocks, render, alpha)
        assert explanation is not None and explanation.cause == "filter"


def test_noise_and_other_detail_are_no_bend() -> None:
    """What no displacement explains is not looked into further, however well twenty unknowns fit some of it."""
    assert bend_of(eight_bits(lens(0.1)(VIEW)), VIEW) is not None
    for other in (VIEW + RNG.normal(size=VIEW.shape) * 0.1, confetti(), OTHER_VIEW):
        assert bend_of(eight_bits(other), VIEW) is None


def plain_box(size: int = 160) -> tuple[np.ndarray, np.ndarray]:
    """(view, alpha) of a box without texture: three faces of one colour each on white."""
    image, cover = Image.new("RGB", (size, size), "white"), Image.new("L", (size, size), 0)
    left, middle, right, top, low = 32, 88, 128, 52, 118
    faces = {
        (150, 138, 125): [(left, top), (middle, top + 12), (middle, low + 12), (left, low)],
        (176, 161, 147): [(middle, top + 12), (right, top), (right, low), (middle, low + 12)],
        (195, 180, 163): [(left, top), (middle - 12, top - 14), (right, top), (middle, top + 12)],
    }
    for color, corners in faces.items():
        ImageDraw.Draw(image).polygon(corners, fill=color)
        ImageDraw.Draw(cover).polygon(corners, fill=255)
    return np.asarray(image, np.float32) / 255, np.asarray(cover, np.float32) / 255


@pytest.mark.parametrize("color", [(1.0, 0.8, 0.2), (0.2, 0.4, 1.0), (1.0, 0.2, 0.2)])
def test_a_glow_along_a_plain_outline_is_no_move(color: tuple[float, float, float]) -> None:
    """Twelve pixels to both sides: it was refused as a small move."""
    view, alpha = plain_box()
    solid = alpha > 0.5
    away = np.asarray(distance_transform_edt(solid)) + np.asarray(distance_transform_edt(~solid))
    for width in (4, 5, 6, 7):
        share = (0.8 * np.exp(-0.5 * (away / width) ** 2))[..., None]
        explanation = explain(eight_bits(view + share * (np.array(color) - view)), view, alpha)
        assert explanation is None or explanation.may_be_meant, width
    shifted = np.roll(view, (22, 20), (0, 1))
    shifted[60:90, 60:90] = color
    explanation = explain(eight_bits(shifted), view, alpha)
    assert explanation is not None and explanation.cause == "moved"


def test_what_lies_beside_itself_after_it_was_moved_back_is_no_paint() -> None:
    """A lens put right leaves parts of a pixel; paint, also a faint dab, is none of it."""
    half = 0.5 * (VIEW + np.roll(VIEW, 1, 1))
    dab = np.hypot(*(np.mgrid[:240, :240] - 120)) < 15
    picture = np.where(dab[..., None], half + 0.2 * (np.array([0.9, 0.1, 0.6]) - half), half).astype(np.float32)
    beside = _beside_itself(picture, VIEW)
    around = dilated(dab, 4)
    assert beside[~around].mean() > 0.95 and beside[dab].mean() < 0.02
    differs = np.abs(half - VIEW).max(-1) > 0.03
    assert differs.mean() > 0.02 and beside[differs & ~around].mean() > 0.8


def pale() -> np.ndarray:
    """The view as a pale asset: its colours near grey, on the same background."""
    grey = VIEW.mean(-1, keepdims=True)
    return eight_bits(np.where(ALPHA[..., None] > 0, 0.3 + 0.5 * grey + 0.25 * (VIEW - grey), VIEW))


def adobe_numbers(colors: np.ndarray) -> np.ndarray:
    """Adobe RGB (1998), annex: its primaries, and a gamma of 563 / 256."""
    from_srgb = [[0.71512, 0.28488, 0], [0, 1, 0], [0, 0.04116, 0.95884]]
    return eight_bits((decoded(colors) @ np.transpose(from_srgb)).clip(0, 1) ** (256 / 563))


def test_adobe_numbers_of_a_pale_asset_are_no_grade() -> None:
    """They change it little, as a curve does; but its paint much, which a curve does not take back."""
    view = pale()
    painted = green_dab(view)
    explanation = explain(adobe_numbers(painted), view, ALPHA)
    assert explanation is not None and "Adobe RGB numbers without their profile" in explanation.words, explanation
    assert explanation.mistake is not None and explanation.mistake.undone is not None
    assert np.abs(explanation.mistake.undone(adobe_numbers(painted)) - painted).max() < 0.02


@pytest.mark.parametrize("gain", [0.85, 0.8, 0.7, 1.15])
def test_an_exposure_under_a_dab_is_no_gamma(gain: float) -> None:
    """Video levels, and gamma 1.8 for 2.2, explain two thirds of it, and were taken back in its place."""
    explanation = explain(eight_bits(green_dab(VIEW) * gain), VIEW, ALPHA)
    assert explanation is not None and explanation.cause == "tone" and "graded as a whole" in explanation.words
