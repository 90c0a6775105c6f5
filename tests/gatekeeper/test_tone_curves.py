"""Curves of tone over all of a picture are told and taken back; what cannot be taken back is compared with itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.color import to_display
from splatpainter.demo_asset import demo_asset
from splatpainter.gatekeeper.mistaken_pictures import explain
from splatpainter.gatekeeper.picture_gate import CheckedPicture, checked_picture
from splatpainter.gatekeeper.small_copies import SmallView
from splatpainter.gatekeeper.tone_curves import CURVES, curves_of
from splatpainter.lift.masks import box_mean, dilated
from splatpainter.pictures.edit_files import PictureFile, draw
from splatpainter.pictures.encodings import Encoding, palette_of
from splatpainter.pictures.picture_reader import Picture
from splatpainter.splats import SH_C0, Splats
from tests.support.cli_scenes import ball
from tests.support.distorted_pictures import jpeg
from tests.support.drawn_views import ALPHA, VIEW, decoded, eight_bits, encoded, green_dab, top

GREY = np.array([0.2126, 0.7152, 0.0722])


def filmic(colors: np.ndarray) -> np.ndarray:
    """Hejl and Burgess-Dawson's, as games have it."""
    light = np.maximum(decoded(colors) - 0.004, 0)
    return light * (6.2 * light + 0.5) / (light * (6.2 * light + 1.7) + 0.06)


def rec709(colors: np.ndarray) -> np.ndarray:
    light = decoded(colors)
    return np.where(light < 0.018, 4.5 * light, 1.099 * np.maximum(light, 1e-9) ** 0.45 - 0.099)


GRADES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "gamma 1.4": lambda p: p**1.4,
    "Rec. 709": rec709,
    "faded": lambda p: 0.12 + 0.8 * p,
    "filmic": filmic,
    "tone mapped": lambda p: encoded(decoded(p) * 1.6 * (1 + 0.4 * decoded(p)) / (1 + 1.6 * decoded(p))),
    "a look": lambda p: (0.5 + 0.5 * np.tanh(2.6 * (p - 0.48)) / np.tanh(1.3)) * np.array([1, 0.96, 0.9]),
    "a look, JPEG": lambda p: jpeg(eight_bits(p**1.3 * np.array([1, 0.95, 0.85])), 70),
}


@pytest.mark.parametrize("name", GRADES)
def test_a_curve_is_taken_back_from_the_paint_too(name: str) -> None:
    """A gain, or the nearest known gamma, left up to 13 % of a picture painted, and the paint 11 of 255 off."""
    painted = green_dab(VIEW)
    picture = eight_bits(GRADES[name](painted))
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and explanation.is_grade and not explanation.may_be_meant
    assert explanation.mistake is not None and explanation.mistake.undone is not None
    left = np.abs(box_mean(np.asarray(explanation.mistake.undone(picture), np.float32) - painted, 2)).max(-1)
    assert np.quantile(left[ALPHA > 0.5], 0.9) < (12 if "JPEG" in name else 4) / 255


@pytest.mark.parametrize("made", [lambda p: np.maximum(p, 0.35), lambda p: np.abs(p - 0.3) + 0.2])
def test_curves_rise_so_that_they_can_be_taken_back(made: Callable[[np.ndarray], np.ndarray]) -> None:
    """Blacks that all became one grey, and a solarised picture: what comes back is what the curves make these of."""
    curves = curves_of(SmallView.of(eight_bits(made(VIEW)), VIEW, ALPHA))
    assert curves is not None and np.diff(curves.values).min() > 0.99 * CURVES.min_rise
    greys = np.linspace(0.05, 0.95, 40)[:, None].repeat(3, 1)
    np.testing.assert_allclose(curves.undone(curves.made(greys)), greys, atol=1e-4)


def test_prophoto_numbers_are_named() -> None:
    """They were called a gamma, and paint kept a tenth of its colour."""
    to_prophoto = [[0.5293, 0.3301, 0.1406], [0.0984, 0.8735, 0.0282], [0.0169, 0.1177, 0.8654]]
    painted = green_dab(VIEW)
    picture = eight_bits((decoded(painted) @ np.transpose(to_prophoto)).clip(0, 1) ** (1 / 1.8))
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and "ProPhoto" in explanation.words
    assert explanation.mistake is not None and explanation.mistake.undone is not None
    assert np.quantile(np.abs(explanation.mistake.undone(picture) - painted), 0.99) < 0.02


@cache
def statue() -> np.ndarray:
    """The view as a nearly grey asset, one sixth of it coloured."""
    grey = VIEW.mean(-1, keepdims=True)
    pale = grey + 0.2 * (VIEW - grey)
    return eight_bits(np.where(ALPHA[..., None] > 0, np.where(top(0.16) > 0, VIEW, pale), 0.25))


def test_a_nearly_grey_asset_made_grey_is_refused_and_grey_paint_is_not() -> None:
    """Only what nobody sees, a level or two of colour in the rest of it, tells one from the other."""
    view = statue()
    desaturated = np.repeat((green_dab(view) @ GREY)[..., None], 3, -1)
    explanation = explain(eight_bits(desaturated), view, ALPHA)
    assert explanation is not None and "grey" in explanation.words and not explanation.may_be_meant
    by_hand = np.where(top(0.16) > 0, (view @ GREY)[..., None], view)
    explanation = explain(eight_bits(by_hand), view, ALPHA)
    assert explanation is None or explanation.may_be_meant


@pytest.mark.parametrize("gain", [0.4, 1.6])
def test_saturation_of_a_nearly_grey_asset_is_refused_and_of_its_colours_is_not(gain: float) -> None:
    view = statue()

    def saturated(colors: np.ndarray) -> np.ndarray:
        grey = (colors @ GREY)[..., None]
        return np.clip(grey + gain * (colors - grey), 0, 1)

    explanation = explain(eight_bits(saturated(green_dab(view))), view, ALPHA)
    assert explanation is not None and "saturation" in explanation.words and not explanation.may_be_meant
    explanation = explain(eight_bits(np.where(top(0.16) > 0, saturated(view), view)), view, ALPHA)
    assert explanation is None or explanation.may_be_meant


# ---- what is lost, by --correct

SIZE, DAB = 160, np.s_[70:86, 74:94]


@cache
def scene() -> tuple[Splats, Camera, np.ndarray]:
    """(A ball of bands, its camera, its view [H, W, 3])."""
    splats = ball(6000, degree=0)
    x, y, z = splats.means.T
    bands = 0.5 + 0.3 * np.sign(np.sin(9 * x + 2) * np.sin(8 * y - 1) * np.sin(7 * z))[:, None] * [1, 0.7, 0.4]
    splats = Splats(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh.copy())
    splats.sh[:, 0] = ((bands - 0.5) / SH_C0).astype(np.float32)
    camera = orbit_cameras(splats, 1, size=SIZE, background=(0.25, 0.25, 0.25))[0]
    return splats, camera, eight_bits(to_display(draw(splats, camera)[0], splats.color_space))


def corrected(picture: np.ndarray, encoding: Encoding | None = None) -> CheckedPicture:
    splats, camera, _ = scene()
    read = Picture(eight_bits(picture), None, (), encoding)
    return checked_picture(
        PictureFile(Path("a.png"), read, (SIZE, SIZE), camera, None, ("as large",)), splats, "local", "correct"
    )


def painted_beside(out: CheckedPicture) -> tuple[float, float]:
    """(Share of the dab that is painted, share of the picture beside it)."""
    assert out.source.mask is not None
    near = np.zeros((SIZE, SIZE), bool)
    near[DAB] = True
    # Colours that were stored at half the size bleed over a block.
    return float(out.source.mask[DAB].mean()), float(out.source.mask[~dilated(near, 16)].mean())


def dabbed() -> np.ndarray:
    picture = scene()[2].copy()
    picture[DAB] = (0.1, 0.8, 0.2)
    return picture


def test_of_a_grey_picture_the_paint_is_kept_and_nothing_else() -> None:
    """All of it was painted grey, under words that said it had been put right."""
    out = corrected(np.repeat((dabbed() @ GREY)[..., None], 3, -1))
    dab, beside = painted_beside(out)
    assert dab > 0.4 and beside < 0.005
    assert any("grey, which cannot be taken back" in note for note in out.source.notes)


@pytest.mark.parametrize("colors", [16, 64])
def test_what_a_palette_loses_is_no_paint(colors: int) -> None:
    """The gatekeeper knew of no palette, and painted 7 to 28 % of such pictures."""
    image = Image.fromarray((dabbed() * 255).round().astype(np.uint8)).quantize(colors)
    palette = np.reshape(image.getpalette() or [], (-1, 3))[:colors].astype(np.uint8)
    picture = np.asarray(image.convert("RGB"), np.float32) / 255
    for encoding in (palette_of(palette), None):
        dab, beside = painted_beside(corrected(picture, encoding))
        assert dab > 0.95 and beside < 0.005


@pytest.mark.parametrize(("step", "quality"), [(1, 40), (1, 70), (-1, 70)], ids=["40", "70", "mirrored"])
def test_what_jpeg_loses_is_no_paint(step: int, quality: int) -> None:
    dab, beside = painted_beside(corrected(jpeg(np.ascontiguousarray(dabbed()[:, ::step]), quality)))
    assert dab > 0.95 and beside < 0.005


def test_another_view_is_not_put_right() -> None:
    """Its edges agree by a little more than the gatekeeper asks for; a fifth of the picture was painted with it."""
    splats = demo_asset()
    cameras = orbit_cameras(splats, 7, size=SIZE, background=(0.25, 0.25, 0.25))
    views = [eight_bits(to_display(draw(splats, camera)[0], splats.color_space)) for camera in cameras[::3]]

    def put_right(picture: np.ndarray) -> CheckedPicture:
        file = PictureFile(Path("a.png"), Picture(picture, None), (SIZE, SIZE), cameras[0], None, ("as large",))
        return checked_picture(file, splats, "local", "correct")

    for other in views[1:]:
        with pytest.raises(ValueError, match="of another asset, another view|shows something other"):
            put_right(other)
    # The view itself, graded and moved, comes back.
    painted = views[0].copy()
    painted[DAB] = (0.1, 0.8, 0.2)
    dab, _ = painted_beside(put_right(eight_bits(np.roll(filmic(painted), (1, 1), (0, 1)))))
    assert dab > 0.9
