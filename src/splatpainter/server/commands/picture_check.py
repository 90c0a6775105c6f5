"""A picture that comes back: its camera found, put straight, compared. Changes nothing."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from splatpainter.cameras import Camera
from splatpainter.captures import capture_of, named_views
from splatpainter.color import to_display
from splatpainter.gatekeeper.borders import BORDER_NOTE, framed_picture
from splatpainter.gatekeeper.crop_search import Crop, error_at, find_crop, find_shift, undo_shift
from splatpainter.gatekeeper.mistaken_pictures import Explanation, explain
from splatpainter.gatekeeper.photographs import carries_camera, laid_over, photograph_edit
from splatpainter.gatekeeper.strips import strip_of
from splatpainter.image_files import Alpha, find_alpha, find_camera
from splatpainter.pictures.edit_files import over_render, unmultiplied
from splatpainter.pictures.encodings import edited_in_encoded
from splatpainter.pictures.larger_views import edited_in_larger, larger_view
from splatpainter.pictures.lost_transparency import GROUND_NOTE, without_its_ground
from splatpainter.pictures.picture_reader import Picture, read_picture
from splatpainter.pictures.view_search import most_alike, same_shape, views_in
from splatpainter.server.commands.context import (
    CommandContext,
    command,
    naming_errors,
    render_alpha,
    render_display,
)
from splatpainter.server.protocol import MAX_VIEW_PIXELS, Answer, Blob, CameraInfo, Command, Message, Unit
from splatpainter.server.studio import Studio
from splatpainter.server.uploads import image_registration as registration
from splatpainter.server.uploads.storage import StoredBlob
from splatpainter.server.uploads.upload_sniffing import LIGHT_MAGIC
from splatpainter.system.quick_dataclass import dataclass

MAX_CROP_CANDIDATES = 8
"""Latest exported views that a picture without a camera may be a part of."""
LARGER_NOTE = "{0}x{1}: a larger render of its view of {2}x{3}"
MAX_CROP_ERROR_RATIO = 0.5
"""A picture of its view's shape is a part of it only where that agrees better by this factor."""
CameraSource = Literal["given", "chunk", "sidecar", "export", "capture"]


class PictureWarning(Message):
    message: str
    picture: Blob | None = None
    """PNG of the camera's size that shows where, transparent elsewhere."""


class PictureChecked(Answer):
    camera: CameraInfo
    camera_source: CameraSource
    """Where the camera came from; "export": the export that the picture resembles most; "capture": the folder that the
    asset lies in has a photograph of this name."""
    picture: Blob
    """PNG at the camera's size, put straight: use this one in `edit`."""
    mask: Blob
    """PNG of the change mask (white: changed), of the camera's size."""
    share: Unit
    """Share of the pixels that changed."""
    shift: tuple[float, float]
    """Pixels (right, down) that the picture had been moved by, and that were taken back."""
    notes: list[str]
    """What was done to the picture (resampled, converted from a colour profile), one line each."""
    warnings: list[PictureWarning]
    """E.g. that the whole picture changed, also where nothing was painted."""


class PictureCheck(Command):
    """What a dropped picture is: its camera, its size and shift corrected, what changed in it. Changes nothing."""

    NAME = "picture.check"
    ANSWER = PictureChecked
    picture: Blob
    name: str = Field(default="", max_length=300)
    """File name, for the sidecar and the exports of the watched folder."""
    camera: CameraInfo | None = None
    threshold: Unit | None = None
    """Differences (0..1) from which a pixel counts as changed; None: found from the picture's noise."""


@command(PictureCheck)
def check_picture(context: CommandContext, request: PictureCheck) -> PictureChecked:
    studio = context.studio
    blob = studio.blobs.get(request.picture, "picture")
    name = request.name or blob.name or "picture"
    # A painted photograph lies over the asset by its capture's camera; nothing below applies to it.
    photograph = _photograph(context, request, blob, name)
    if photograph is not None:
        return photograph
    picture = read_picture(blob.path, inks=False)
    # Without a camera nothing can be compared, so it is looked for first.
    camera, source = _camera(context, request, blob, name, picture)
    alpha = _alpha_kind(context, blob, name)
    picture = unmultiplied(picture, alpha)
    placed = _placed(context, picture, camera, alpha, name)
    cover = render_alpha(studio.session.splats, placed.camera)
    framed = _without_its_border(placed, cover)
    placed = _on_the_views_ground(context, placed, picture, cover) if framed is None else framed
    if blob.info.ending in LIGHT_MAGIC:
        placed = replace(placed, notes=[*placed.notes, "linear light, taken as a painted view and not as a sky"])
    mask = _edited(placed, picture, cover, request.threshold)
    # From here on only warnings: the picture may be used all the same.
    warnings = _warnings(context, placed, mask, cover)
    # The straightened picture is a new one; what made the first made this one too.
    straight = studio.blobs.put(registration.png_bytes(placed.colors), name).sha256
    studio.note_source(straight, studio.source_of([request.picture]))
    return PictureChecked(
        camera=CameraInfo.of(placed.camera),
        camera_source=source,
        picture=straight,
        mask=studio.blobs.put(registration.png_bytes(mask), "mask.png").sha256,
        share=float(mask.mean()),
        shift=placed.shift,
        notes=placed.notes,
        warnings=warnings,
    )


@dataclass(frozen=True)
class _Placed:
    """A picture as it lies over its view."""

    camera: Camera
    """Of the size at which the picture is compared: the view's, or a larger one."""
    colors: np.ndarray
    """[H, W, 3] the picture, put straight."""
    render: np.ndarray
    """[H, W, 3] what the asset shows there."""
    view_render: np.ndarray
    """[H, W, 3] the same at the view's own size."""
    shift: tuple[int, int]
    """Pixels (right, down) that were taken back."""
    notes: list[str]
    is_part: bool
    """Whether it shows a part of the view alone."""

    @property
    def is_larger(self) -> bool:
        return self.render is not self.view_render


def _placed(context: CommandContext, picture: Picture, camera: Camera, alpha: Alpha | None, name: str) -> _Placed:
    """The picture over its view, cut, resampled or moved back. Raises ValueError: it has another shape and is no part
    of the view."""
    notes, size = list(picture.notes), (camera.width, camera.height)
    render = _render(context, camera)
    crop = _crop(picture, render)
    # Another shape that is no part of the view was made for another view.
    if crop is None and not same_shape(picture.size, size):
        actual, expected = f"{picture.size[0]}x{picture.size[1]}", f"{size[0]}x{size[1]}"
        raise ValueError(
            f"{name}: expected the shape of its view ({expected}) or a part of it, got {actual}, which matches "
            "no part; resize without cropping"
        )
    # Either a part of the view, or all of it: moved, larger or smaller, but never both.
    if crop is not None:
        colors = render.copy()
        colors[crop.window] = _flat(picture, render[crop.window], (crop.width, crop.height))
        notes.append(f"a part of its view: {crop.width}x{crop.height} at {crop.x}, {crop.y}; the rest is unchanged")
        return _Placed(camera, colors, render, render, (0, 0), notes, True)
    colors = _flat(picture, render, size) if alpha is None else _cut_out(context, picture, render, camera)
    # A shift is looked for only in whole pictures; a part has its place by now.
    shift = find_shift(colors, render)
    larger = larger_view(camera, *picture.size, MAX_VIEW_PIXELS) if shift == (0, 0) and alpha is None else None
    change = "resampled from {0}x{1} to its camera's {2}x{3}" if larger is None else LARGER_NOTE
    if picture.size != size:
        notes.append(change.format(*picture.size, *size))
    # A larger picture is compared at its own size, or its detail would be lost.
    if larger is not None:
        larger_render = _render(context, larger)
        colors = _flat(picture, larger_render, (larger.width, larger.height))
        return _Placed(larger, colors, larger_render, render, shift, notes, False)
    if shift != (0, 0):
        colors = undo_shift(colors, render, *shift)
        notes.append(f"moved back by {shift[0]}, {shift[1]} pixels")
    return _Placed(camera, colors, render, render, shift, notes, False)


def _on_the_views_ground(context: CommandContext, placed: _Placed, picture: Picture, cover: np.ndarray) -> _Placed:
    """As it is, or with the view's background in place of that on which a program laid its transparency."""
    if picture.alpha is not None or placed.is_part:
        return placed
    space = context.studio.session.splats.color_space
    background = to_display(np.asarray(placed.camera.background, np.float32), space)
    encoding = picture.encoding if _has_its_pixels(placed, picture) else None
    colors = without_its_ground(placed.colors, placed.render, cover, background, encoding)
    if colors is None:
        return placed
    # A grade changes the background, too: that is no ground of another program's.
    explanation = explain(placed.colors, placed.render, cover)
    if explanation is not None and explanation.is_grade:
        return placed
    return replace(placed, colors=colors, notes=[*placed.notes, GROUND_NOTE])


def _without_its_border(placed: _Placed, cover: np.ndarray) -> _Placed | None:
    """As it was rendered where a border around the picture lies; None where it has none."""
    if placed.is_part:
        return None

    def why(colors: np.ndarray) -> Explanation | None:
        return explain(colors, placed.render, cover)

    framed = framed_picture(placed.colors, placed.render, cover, None, why)
    if framed is None or not framed.is_certain:
        return None
    return replace(placed, colors=framed.colors, notes=[*placed.notes, BORDER_NOTE])


def _has_its_pixels(placed: _Placed, picture: Picture) -> bool:
    """Whether the file's own pixels are compared, where compression is at home: once resampled or cut, its blocks are
    gone."""
    return picture.size == (placed.camera.width, placed.camera.height) and not placed.is_part


def _edited(placed: _Placed, picture: Picture, cover: np.ndarray, threshold: float | None) -> np.ndarray:
    """[H, W] bool: pixels that count as edited, by where the picture's noise comes from: enlarging, compression, or
    neither. cover: [H, W] alpha of the asset there."""
    colors, render = placed.colors, placed.render
    if placed.is_larger and threshold is None:
        return edited_in_larger(colors, render, placed.view_render, cover)
    mask = registration.changed_mask(colors, render, cover, threshold)
    if picture.encoding is not None and _has_its_pixels(placed, picture) and threshold is None:
        edited = edited_in_encoded(colors, render, cover, picture.encoding)
        return np.ones(mask.shape, bool) if edited is None else edited
    return mask


def _warnings(context: CommandContext, placed: _Placed, mask: np.ndarray, cover: np.ndarray) -> list[PictureWarning]:
    """What people should know of a picture before they use it."""
    studio, share, out = context.studio, float(mask.mean()), []
    if placed.camera.asset_sha256 not in (None, studio.session.opened.sha256):
        text = "The picture was rendered from another asset: every difference counts as an edit."
        out.append(PictureWarning(message=text))
    if share > registration.REGRADED_SHARE:
        text = f"{100 * share:.0f} % of the picture changed. If it was regraded as a whole, use it as a global edit."
        out.append(PictureWarning(message=text))
    elif not placed.is_larger:  # what enlarging alone changed is no drift
        # Small differences all over are a program's doing; they are left alone, and people see where.
        faint = registration.faint_changes(placed.colors, placed.render, mask)
        if faint.mean() > registration.FAINT_WARNING_SHARE * (1 - share):
            text = (
                f"{100 * faint.mean():.0f} % of the picture changed a little outside the edit; it will be left alone."
            )
            overlay = studio.blobs.put(registration.png_bytes(registration.overlay(faint)), "outside.png").sha256
            out.append(PictureWarning(message=text, picture=overlay))
    # A mistake that explains the whole difference is named: another gamma, a mirror.
    explanation = explain(placed.colors, placed.render, cover)
    if explanation is not None and explanation.cause != "look":
        differs = f"differs from its view on {100 * (1 - explanation.agreeing):.0f} % of what they show"
        out.append(PictureWarning(message=f"The picture {differs}; most likely it is {explanation.words}."))
    # A strip that a hand may have laid is painted, but seen before.
    strip = None if placed.is_part else strip_of(placed.colors, placed.render, cover)
    if strip is not None and not strip.is_certain:
        text = "One side of the picture is all of one colour. If that is a caption or a bar, take it out of the edit."
        where = studio.blobs.put(registration.png_bytes(registration.overlay(strip.outside)), "strip.png").sha256
        out.append(PictureWarning(message=text, picture=where))
    if not mask.any():
        out.append(PictureWarning(message="The picture does not differ from the asset as it is now."))
    return out


def _photograph(context: CommandContext, request: PictureCheck, blob: StoredBlob, name: str) -> PictureChecked | None:
    """A painted photograph of the capture in whose folder the asset lies, laid over the asset; None where the picture
    has a camera of another kind, or no photograph's name. Raises ValueError: nothing is painted on it."""
    studio = context.studio
    opened = studio.session.opened.source
    capture = None if opened is None or request.camera is not None else capture_of(Path(opened.path))
    # A camera in the picture is surer than a name, and without a capture there is no photograph.
    if opened is None or capture is None or carries_camera(blob.path):
        return None
    views = named_views(capture, Path(opened.path), Path(Path(name).name or "picture"))
    # The name has to be that of one photograph exactly.
    if len(views) != 1 or not views[0].is_meant_by(Path(name).name):
        return None
    with naming_errors(blob.path, name):
        edit = laid_over(photograph_edit(blob.path, views[0]), studio.session.splats)
    assert edit.mask is not None
    picture = studio.blobs.put(registration.png_bytes(edit.picture.colors), name).sha256
    studio.note_source(picture, studio.source_of([request.picture]))
    return PictureChecked(
        camera=CameraInfo.of(edit.camera),
        camera_source="capture",
        picture=picture,
        mask=studio.blobs.put(registration.png_bytes(edit.mask), "mask.png").sha256,
        share=float(edit.mask.mean()),
        shift=(0, 0),
        notes=list(edit.notes),
        warnings=[],
    )


def _camera(
    context: CommandContext, request: PictureCheck, blob: StoredBlob, name: str, picture: Picture
) -> tuple[Camera, CameraSource]:
    """The camera of a picture and where that came from. Raises ValueError where there is none."""
    camera, source = _find_camera(context, request, blob, name, picture)
    camera = camera.relative_to(context.studio.session.original.offset)
    pixels = camera.width * camera.height
    # Larger than may be painted: picture and view shrink together.
    if pixels > MAX_VIEW_PIXELS:  # a view that was exported larger than one is painted: the picture is shrunk with it
        scale = (MAX_VIEW_PIXELS / pixels) ** 0.5
        camera = camera.resized(max(1, int(scale * camera.width)), max(1, int(scale * camera.height)))
    return camera, source


def _alpha_kind(context: CommandContext, blob: StoredBlob, name: str) -> Alpha | None:
    """How a picture that was exported without a background keeps its colours, as it or its sidecar says."""
    kind = find_alpha(blob.path)
    # Painting programs drop what a picture says of itself; the sidecar beside the export still says it.
    for sidecar in _sidecars(context.studio, name) if kind is None else ():
        with contextlib.suppress(ValueError):
            kind = kind or find_alpha(blob.path, sidecar)
    return kind


def _sidecars(studio: Studio, name: str) -> list[Path]:
    """Files of the watched folder that may say the camera of a picture of it: beside it, then of the same name in the
    folder itself, where views are exported to."""
    if studio.folder is None:
        return []
    folder, _, last = name.rpartition("/")
    stem, out = Path(Path(last).name).stem, []
    for sidecar in dict.fromkeys((f"{folder}/{stem}.json" if folder else "", f"{stem}.json")):
        with contextlib.suppress(ValueError):
            out.append(studio.folder.within(sidecar))
    return out


def _cut_out(context: CommandContext, picture: Picture, render: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W, 3] a picture that was exported without a background, with the view's background."""
    resized = picture.resized(camera.width, camera.height)
    if resized.alpha is None:
        return resized.colors
    splats = context.studio.session.splats
    # Over the view where the asset is half transparent, or the edge would show a seam.
    cover = render_alpha(splats, camera)
    red, green, blue = to_display(np.array(camera.background), splats.color_space).tolist()
    return over_render(resized.colors, resized.alpha, render, cover, (red, green, blue))


def _find_camera(
    context: CommandContext, request: PictureCheck, blob: StoredBlob, name: str, picture: Picture
) -> tuple[Camera, CameraSource]:
    studio = context.studio
    # From the surest to the vaguest: given, in the picture, beside it, by name, by likeness, as a part of a view.
    if request.camera is not None:
        return request.camera.to_camera(), "given"
    with contextlib.suppress(ValueError):
        return find_camera(blob.path), "chunk"
    stem = Path(Path(name).name).stem
    for sidecar in _sidecars(studio, name):
        with contextlib.suppress(ValueError):
            return find_camera(blob.path, sidecar), "sidecar"
    # An export of this name is meant, unless it is the name that all exports have.
    candidates = [e for e in studio.exports if same_shape(picture.size, (e.camera.width, e.camera.height))]
    for export in reversed(candidates):
        if Path(export.name).stem == stem and stem != "view":
            return export.camera, "export"
    colors = _flat(picture, 0.0, picture.size)
    best = most_alike(colors, candidates, stem)
    if best is None and studio.folder is not None:
        root = studio.folder.root
        at = root / Path(name).name
        with contextlib.suppress(ValueError):  # dropped, of whatever name
            at = studio.folder.within(name, new=True)
        best = most_alike(colors, views_in([at.parent, root], picture.size, besides=at), stem)
    # Last: it may be a part of a view, which is the slowest to find.
    if best is None:
        camera = _cropped_from(context, colors)
        if camera is not None:
            return camera, "export"
        is_sky = "; a sky is for Light, Sky from a file" if blob.info.kind == "sky" else ""
        raise ValueError(
            f"{name}: it has no camera and matches no exported view; go to its view and drop it there{is_sky}"
        )
    return best.camera, "export"


def _crop(picture: Picture, render: np.ndarray) -> Crop | None:
    """The part of the view that the picture shows; None where it shows all of it, or none that can be told."""
    height, width = render.shape[:2]
    if picture.size == (width, height):
        return None
    # A picture of the view's shape may still be a part of it, but only if that fits far better.
    crop = find_crop(_flat(picture, 0.0, picture.size), render)
    if crop is not None and same_shape(picture.size, (width, height)):
        uncropped_error = error_at(_flat(picture, 0.0, (width, height)), render)
        return crop if crop.error < MAX_CROP_ERROR_RATIO * uncropped_error else None
    return crop


def _cropped_from(context: CommandContext, colors: np.ndarray) -> Camera | None:
    """The latest exported view that a picture is a part of."""
    # The latest first, for what comes back went out not long ago.
    for export in list(context.studio.exports)[: -MAX_CROP_CANDIDATES - 1 : -1]:
        context.ticket.check()
        if find_crop(colors, _render(context, export.camera)) is not None:
            return export.camera
    return None


def _render(context: CommandContext, camera: Camera) -> np.ndarray:
    return np.clip(render_display(context.studio.session.splats, camera), 0, 1)


def _flat(picture: Picture, background: np.ndarray | float, size: tuple[int, int]) -> np.ndarray:
    """[H, W, 3] the picture at a size, over the background where it is transparent."""
    resized = picture.resized(*size)
    if resized.alpha is None:
        return resized.colors
    alpha = resized.alpha[..., None]
    return alpha * resized.colors + (1 - alpha) * background
