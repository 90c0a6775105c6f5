"""Pictures of strokes as layers keep them: what they hold, and that only what was painted is converted."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from splatpainter.color import to_display
from splatpainter.image_files import to_uint8
from splatpainter.painter import Edit
from splatpainter.session.document import layer_factory
from splatpainter.session.document.layer_factory import encode_mask, encode_picture, new_layer, thumbnail
from splatpainter.session.document.layer_operation import operation_of_layer
from splatpainter.splats import ColorSpace
from tests.support.studio_scenes import ball, view

SIZE = 48


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((SIZE, SIZE, 3)).astype(np.float32)


def painted() -> np.ndarray:
    mask = np.zeros((SIZE, SIZE), bool)
    mask[10:20, 5:40] = True
    return mask


@pytest.mark.parametrize("space", ["srgb", "linear"])
def test_a_stroke_s_picture_holds_and_converts_what_was_painted(
    space: ColorSpace, monkeypatch: pytest.MonkeyPatch
) -> None:
    image, mask, converted = picture(), painted(), []

    def counted(pixels: np.ndarray) -> np.ndarray:
        converted.append(pixels.size // 3)
        return to_uint8(pixels)

    monkeypatch.setattr(layer_factory, "to_uint8", counted)
    data = encode_picture(image, space, mask)
    assert converted == [mask.sum()]
    pixels = np.asarray(Image.open(io.BytesIO(data)))
    expected = np.where(mask[..., None], to_uint8(to_display(image, space)), 0)
    np.testing.assert_array_equal(pixels[..., :3], expected)
    np.testing.assert_array_equal(pixels[..., 3], np.where(mask, 255, 0))


@pytest.mark.parametrize("threads", ["1", "2"])
@pytest.mark.parametrize("cut_out", [True, False])
def test_a_layer_holds_its_pictures_in_their_order(
    threads: str, cut_out: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    edits = [Edit(picture(k), view(SIZE), np.roll(painted(), k, 0)) for k in range(2)]
    operation = operation_of_layer({"kind": "paint"}, "stroke")
    layer, blobs = new_layer(ball(50), operation, edits, "Stroke", cut_out=cut_out)
    expected = []
    for k, edit in enumerate(edits):
        assert edit.mask is not None
        expected += [encode_picture(edit.image, mask=edit.mask if cut_out else None), encode_mask(edit.mask)]
        expected += [] if k else [thumbnail(edit.image, edit.mask, few_colors=cut_out)]
    assert [*blobs.values()] == expected
    names = [*blobs]
    assert [(one.picture, one.mask) for one in layer.views] == [(names[0], names[1]), (names[3], names[4])]
    assert layer.thumbnail == names[2]
