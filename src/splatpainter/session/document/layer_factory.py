"""Edited pictures become a new layer: judged, brought to 8 bits, and given a mask that stays what it is; and the PNG
bytes in which layers keep pictures and masks. What comes back is what went in at 8 bits; sizes are judged first. Pure.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from functools import partial

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.color import from_display, to_display
from splatpainter.image_files import MAX_PICTURE_PIXELS, quick_png, to_uint8
from splatpainter.io import files
from splatpainter.kernels.parallel import beside
from splatpainter.lift.masks import edited_mask
from splatpainter.painter import MAX_VIEWS, Edit
from splatpainter.session.document.document import Layer
from splatpainter.session.document.layer_operation import LayerOperation
from splatpainter.session.document.layer_view import Blend, View
from splatpainter.splats import ColorSpace, Splats
from splatpainter.system.latest import Latest

MAX_RECENT_BYTES = 1 << 22
"""Most bytes of pixels that were encoded lately and are at hand when they are asked for, each."""
_recent = Latest[tuple[bytes, np.ndarray]](3)
"""(bytes, pixels) of the latest picture, its mask, and a third one."""
LEAST_COVERED = 128
"""Level of a mask's picture from which a pixel is in it; what lies above says how far it is covered."""
THUMBNAIL_PX = 96
"""Longer side of a thumbnail."""
THUMBNAIL_COLORS = 64
"""Colours of the thumbnails of strokes, of which a project may hold hundreds."""


def new_layer(
    splats: Splats,
    operation: LayerOperation,
    edits: Sequence[Edit],
    name: str | None,
    *,
    opacity: float = 1.0,
    blend: Blend = "normal",
    cut_out: bool = False,
) -> tuple[Layer, dict[str, bytes]]:
    """(a layer without an id, its pictures by hash). splats: the asset that is edited; cut_out: pictures are kept
    inside their masks only (strokes: what lies beside them is most of the view). Raises ValueError: no view or too
    many, no mask where one is needed, nothing edited."""
    kind = operation.kind
    # Counts are judged before any picture is encoded, which takes long.
    if not 0 <= len(edits) <= MAX_VIEWS or operation.merges:
        raise ValueError(f"layer: expected at most {MAX_VIEWS} views, and layers that exist to be merged with merge")
    if not edits and operation.needs_views:
        raise ValueError(f"layer: expected at least one edited view for kind {kind}, got none")
    if edits and not operation.takes_views:
        raise ValueError(f"layer: expected no views for kind {kind}, got {len(edits)}; limit it by a mask instead")
    blobs: dict[str, bytes] = {}

    def put(data: bytes) -> str:
        sha = files.sha256(data)
        blobs[sha] = data
        return sha

    views, small = [], None
    for edit in (edit.relative_to(splats.offset) for edit in edits):
        mask = edit.mask
        if mask is None and operation.takes_pictures and operation.needs_masks:
            # Judged once: on replay over other layers everything would differ.
            mask = changed_pixels(splats, edit)
        if mask is None and not operation.takes_pictures:
            raise ValueError(f"{edit.name}: expected a mask for a view of kind {kind}")
        # Hashed as they will be stored: replay computes from these bytes, not from the floats that came in.
        inside = mask if cut_out else None
        encoding = None
        if operation.takes_pictures:
            # Packing pixels leaves Python alone: the mask and the thumbnail are made meanwhile.
            encoding = beside(partial(encode_picture, edit.image, splats.color_space, inside))
        packed_mask, thumb = None if mask is None else encode_mask(mask, edit.cover), None
        # The first view is what people know the layer by; of one without pictures that is its mask.
        if small is None:
            image = to_display(edit.image, splats.color_space)
            if not operation.takes_pictures:
                image = np.repeat(np.asarray(mask, np.float32)[..., None], 3, -1)
            thumb = thumbnail(image, mask, few_colors=cut_out)
        picture = None if encoding is None else put(encoding())
        views.append(View(edit.camera, picture, None if packed_mask is None else put(packed_mask)))
        small = small if thumb is None else put(thumb)
    title = name or kind.capitalize()
    return Layer("", title, operation, tuple(views), opacity=opacity, blend=blend, thumbnail=small), blobs


def encode_picture(image: np.ndarray, space: ColorSpace = "srgb", mask: np.ndarray | None = None) -> bytes:
    """[H, W, 3] floats 0..1 in the asset's colour space -> PNG of display colours. Encoded fast rather than small.
    mask: [H, W] bool, what is beside it is transparent and black."""
    if mask is None:
        return _png(to_uint8(to_display(image, space)))
    # Of a stroke most of the view is left out, and is not converted first.
    at, pixels = np.flatnonzero(mask), np.zeros((*mask.shape, 4), np.uint8)
    inside = to_uint8(to_display(image.reshape(-1, 3).take(at, 0), space))
    pixels.reshape(-1, 4)[at] = np.concatenate([inside, np.full((len(at), 1), 255, np.uint8)], 1)
    return _png(pixels)


def is_cut_out(data: bytes, camera: Camera, where: str) -> bool:
    """Whether a picture is kept inside its mask only. Raises ValueError as `decode_picture`."""
    return bool((_pixels(data, camera, where, "RGBA")[..., 3] == 0).any())


def encode_mask(mask: np.ndarray, cover: np.ndarray | None = None) -> bytes:
    """[H, W] bool -> PNG of 0 and 255; with a cover ([H, W] 0..1, as of Edit) of 128 to 255 in place of 255, which is a
    mask to whoever knows none."""
    inside = 255 if cover is None else LEAST_COVERED + np.rint((255 - LEAST_COVERED) * cover)
    return _png(np.where(mask, inside, 0).astype(np.uint8))


def decode_picture(data: bytes, camera: Camera, where: str, space: ColorSpace = "srgb") -> np.ndarray:
    """[H, W, 3] float32 0..1 in the asset's colour space. Raises ValueError naming `where`: no PNG, damaged, not of the
    camera's size."""
    pixels = _pixels(data, camera, where, "RGB")
    if space == "srgb":
        return np.divide(pixels, np.float32(255), dtype=np.float32)
    # A table of 256 levels: the same conversion for every pixel, and much quicker than one for each.
    levels = from_display(np.arange(256, dtype=np.float32) / 255, space)
    return levels.take(pixels, mode="clip")  # twice as quick as an index


def encode_mask_part(shows: np.ndarray, share: np.ndarray) -> bytes:
    """[H, W] 0..1 each -> PNG of two channels: what a mask shows, and how far it goes there."""
    return _png(to_uint8(np.stack([np.where(share > 0, shows, 0), share], 2)))


def decode_mask_part(data: bytes, camera: Camera, where: str) -> np.ndarray:
    """[H, W, 2] float32 0..1. Raises ValueError as `decode_picture`."""
    return _pixels(data, camera, where, "LA").astype(np.float32) / 255


def decode_mask(data: bytes, camera: Camera, where: str) -> np.ndarray:
    """[H, W] bool. Raises ValueError as `decode_picture`."""
    return _pixels(data, camera, where, "L") >= LEAST_COVERED


def decode_cover(data: bytes, camera: Camera, where: str) -> np.ndarray | None:
    """[H, W] float32 0..1, 1 beside the mask, too; None where it covers fully. Raises ValueError as
    `decode_picture`."""
    levels = _pixels(data, camera, where, "L")
    inside = levels >= LEAST_COVERED
    if (levels[inside] == 255).all():
        return None
    part = (levels.astype(np.float32) - LEAST_COVERED) / (255 - LEAST_COVERED)
    return np.where(inside, part, 1).astype(np.float32)


def thumbnail(image: np.ndarray, mask: np.ndarray | None, few_colors: bool = False) -> bytes:
    """PNG of the part of a picture that was edited, THUMBNAIL_PX pixels on its longer side at most. few_colors: of
    THUMBNAIL_COLORS, a third of the bytes."""
    from PIL import Image

    if mask is not None and mask.any():
        ys, xs = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        # Some of the surroundings too: a stroke alone says little about where it lies.
        margin = 4 + max(np.ptp(ys), np.ptp(xs)) // 4
        top, left = max(ys[0] - margin, 0), max(xs[0] - margin, 0)
        image = image[top : ys[-1] + margin + 1, left : xs[-1] + margin + 1]
    small = Image.fromarray(to_uint8(image))
    small.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
    file = io.BytesIO()
    small = small.convert("RGB").quantize(THUMBNAIL_COLORS) if few_colors else small
    small.save(file, "PNG", compress_level=1)
    return file.getvalue()


def changed_pixels(splats: Splats, edit: Edit) -> np.ndarray:
    """[H, W] bool: where an edited picture differs from the render. Raises ValueError where it does not."""
    from splatpainter.rendering import render

    drawn = render(splats, edit.camera)
    mask = edited_mask(edit.image, drawn.colors[0], drawn.alphas[0, ..., 0])
    if not mask.any():
        raise ValueError(f"{edit.name}: nothing to do, the picture does not differ from the render")
    return mask


def _png(pixels: np.ndarray) -> bytes:
    data = quick_png(pixels)
    if pixels.nbytes <= MAX_RECENT_BYTES:
        # Frozen, as whoever reads it later gets this array itself.
        copy = pixels.copy()
        copy.flags.writeable = False
        _recent.note((data, copy))
    return data


def _recently_encoded(data: bytes, camera: Camera, mode: str) -> np.ndarray | None:
    """What `_pixels` would read of bytes that `_png` has just made of an array; None where it has not."""
    for png, pixels in _recent:
        # By identity of the bytes: equal ones from a file would have to be compared, which costs more than it saves.
        if png is data and pixels.shape[:2] == (camera.height, camera.width):
            channels = 1 if pixels.ndim == 2 else pixels.shape[2]
            if (mode, channels) in (("L", 1), ("LA", 2), ("RGB", 3), ("RGBA", 4)):
                return pixels
            if (mode, channels) == ("RGB", 4):
                return pixels[..., :3]
    return None


def _pixels(data: bytes, camera: Camera, where: str, mode: str) -> np.ndarray:
    from PIL import Image

    recent = _recently_encoded(data, camera, mode)
    if recent is not None:
        return recent
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's own size warning: judged here
        try:
            # One format alone is tried: a stranger's file must not choose its decoder. Sizes are judged before pixels.
            with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
                if image.width * image.height > MAX_PICTURE_PIXELS:
                    raise ValueError(f"more than {MAX_PICTURE_PIXELS // 10**6} megapixels")
                if image.size != (camera.width, camera.height):
                    expected = f"{camera.width}x{camera.height}"
                    raise ValueError(f"is {image.width}x{image.height}, its camera {expected}")
                return np.asarray(image.convert(mode))
        except Exception as error:  # decoders of damaged files raise anything
            raise ValueError(f"{where}: expected a PNG of its camera's size ({error})") from None
