"""An edited picture from a file becomes an Edit: its camera found, its size fitted, transparent parts left alone."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.captures import choose_one, is_capture, named_views, split_selector
from splatpainter.color import from_display, to_display
from splatpainter.image_files import Alpha, find_alpha, find_camera, has_camera
from splatpainter.io.foreign_captures import foreign_capture
from splatpainter.lift.masks import change_mask, change_mask_beyond
from splatpainter.painter import Edit, Mode
from splatpainter.pictures.encodings import edited_in_encoded
from splatpainter.pictures.larger_views import edited_in_larger, larger_view
from splatpainter.pictures.picture_reader import (
    EMPTY_MASK,
    MAX_PICTURE_PIXELS,
    PICTURE_SUFFIXES,
    SIZE_LIMIT,
    Picture,
    declared_size,
    read_mask,
    read_picture,
    resample,
    unpremultiplied,
)
from splatpainter.pictures.view_search import MAX_ASPECT_ERROR, lost_camera
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.rendering.cpu.recent_views import DrawnView

MIN_MASK = 0.25
"""Value from which a resampled mask counts: a thin stroke survives being shrunk."""
MAX_CLEAR_ALPHA = 0.02
"""Alpha up to here is transparent (resampling leaves ripples around an edge)."""


@dataclass(frozen=True)
class Photograph:
    """What else is known of a picture that is a photograph of a capture, painted on (photographs.py)."""

    taken: np.ndarray | None = field(default=None, repr=False)
    """[H, W, 3] the photograph before it was painted on, straightened as the picture; None where it is not there."""
    path: Path | None = None
    """Its file."""
    half_turned: Callable[[], PictureFile] | None = field(default=None, repr=False)
    """Reads the same file turned by 180 degrees; None: it is read so."""


@dataclass(frozen=True)
class PictureFile:
    """An edited picture of a file and its camera, read but not yet compared with an asset."""

    path: Path
    picture: Picture
    """The picture at the camera's size."""
    original_size: tuple[int, int]
    """(width, height) of the file."""
    camera: Camera
    mask: np.ndarray | None
    """[H, W] bool at the camera's size, where one was given."""
    notes: tuple[str, ...]
    """One line each; of its size the last one."""
    cut_out: bool = False
    """Whether the picture was rendered without a background, so that behind it lies the background, not the asset."""
    view: Camera | None = None
    """The view that was rendered, where `camera` is a larger one of it, of the picture's size (larger_views.py)."""
    photograph: Photograph | None = None
    """What `photographs.laid_over` needs, before which there is no edit; None: a painted render."""
    drawn: DrawnView | None = field(default=None, repr=False, compare=False)
    """The view as the asset shows it, held so that nobody draws it again (recent_views.py); None: not drawn yet."""

    def at_view(self) -> PictureFile:
        """The picture at the size of the view that was rendered."""
        view = self.view
        if view is None:
            return self
        mask = self.mask
        if mask is not None:
            mask = resample(mask.astype(np.float32), view.width, view.height) > MIN_MASK
        picture = self.picture.resized(view.width, view.height)
        notes = (*self.notes[:-1], _resampled(self.original_size, view))
        return replace(self, picture=picture, camera=view, mask=mask, notes=notes, view=None)

    def relative_to(self, offset: tuple[float, float, float]) -> PictureFile:
        """The same picture for an asset with this offset (Splats.offset)."""
        view = None if self.view is None else self.view.relative_to(offset)
        return replace(self, camera=self.camera.relative_to(offset), view=view)

    def edit(self, splats: Splats, mode: Mode = "local") -> Edit:
        """The edit of this asset. Transparent pixels show the asset's own render, so they change nothing; a mode
        "global" edit does not learn from them, and takes the picture at its view's size. Renders the asset where it has
        to."""
        # A look needs no detail: the view's own size is enough, and much quicker.
        if mode == "global" and self.view is not None:
            return self.at_view().edit(splats, mode)
        if self.camera.relative_to(splats.offset) is not self.camera:
            return self.relative_to(splats.offset).edit(splats, mode)
        # A render is needed where transparent pixels show it, or where resampling or storing changed every edge.
        alpha, mask = self.picture.alpha, self.mask
        resized = self.view is not None or self.original_size != (self.camera.width, self.camera.height)
        colors = from_display(self.picture.colors, splats.color_space)
        unmasked = mask is None and (mode == "local" if resized else self.is_lossy and mode != "global")
        # A layer of paint says itself how thick it is along its soft edges, and where it is.
        thickness = None
        if mode == "spread" and alpha is not None and not self.cut_out and (alpha > MAX_CLEAR_ALPHA).any():
            thickness, unmasked = np.clip(alpha / alpha.max(), 0, 1), False
        if alpha is not None or unmasked:
            # Drawn once, for both reasons.
            render, cover = draw(splats, self.camera)
            if alpha is not None:
                behind = self.camera.background if self.cut_out else None
                colors = over_render(colors, alpha, np.clip(render, 0, 1), cover, behind)
            if unmasked:
                mask = self._changed(colors, render, cover, splats)
                if self.is_lossy and mask is not None and not mask.any():
                    assert self.picture.encoding is not None
                    raise ValueError(
                        f"{self.path}: nothing was painted: it differs from its view only as "
                        f"{self.picture.encoding.words} does"
                    )
            # What is transparent was not painted, whatever its colour.
            if alpha is not None and (mask is not None or thickness is not None or mode == "global"):
                mask = (alpha > MAX_CLEAR_ALPHA) & (True if mask is None else mask)
        return Edit(np.ascontiguousarray(colors, np.float32), self.camera, mask, str(self.path), thickness)

    @property
    def is_lossy(self) -> bool:
        """Whether it is known how its file loses something."""
        return self.picture.encoding is not None

    def _changed(self, colors: np.ndarray, render: np.ndarray, cover: np.ndarray, splats: Splats) -> np.ndarray | None:
        """Pixels that differ from a render that went through the same change of size and back, and was stored alike:
        these alone move every edge by more than an edit's tolerance. None: the painter is to say."""
        space, encoding = splats.color_space, self.picture.encoding
        picture, displayed = to_display(colors, space), np.clip(to_display(render, space), 0, 1)
        # A larger picture may have been enlarged by any kernel, so it has a test of its own.
        if self.view is not None:
            small = to_display(draw(splats, self.view)[0], space)
            mask = edited_in_larger(picture, displayed, small, cover)
            if encoding is None or mask.all():
                return mask
            return mask & change_mask_beyond(
                picture, displayed, encoding.fitted(picture, displayed, cover).applied(displayed)
            )
        camera = self.camera
        # Stored with loss: the render goes through the same loss before it is compared.
        if encoding is not None:
            if self.original_size == (camera.width, camera.height):
                return edited_in_encoded(picture, displayed, cover, encoding)
            fitted = encoding.fitted(picture, displayed, cover)
            stored = fitted.applied(resample(displayed, *self.original_size))
            expected = resample(stored, camera.width, camera.height)
            return change_mask_beyond(picture, displayed, expected)
        # Only resized: there and back, as the picture was.
        resized = resample(displayed, *self.original_size)
        return change_mask(colors, from_display(resample(resized, camera.width, camera.height), space))


def edit_from_files(
    picture: Path, camera: Path | None = None, mask: Path | None = None, folders: Sequence[Path] = ()
) -> PictureFile:
    """Read an edited picture, its camera (given: CAM.json, a PNG that carries one, or a folder of views, the one that
    it matches; else in the picture, else in its sidecar NAME.json, else that of the view that it matches, in its own
    folder and in `folders`) and its mask. A larger picture of the camera's shape is a larger render of the same view:
    the edit is made at its size. Another picture of another size but the same aspect ratio is resampled.

    Raises ValueError, one line naming the file: an unreadable, too large or animated picture, inks (CMYK), no camera or
    a broken one, an aspect ratio more than 1 % off, an empty mask."""
    # Sizes are judged by headers, before anything is decoded.
    declared = declared_size(picture)
    searched: list[Path] | None = None
    if camera is not None and camera.is_dir():
        searched, camera = [camera], None
    elif camera is None and not has_camera(picture):
        searched = [picture.parent, *folders]
    # No camera anywhere: the picture itself says which view it is.
    if searched is not None:
        recognised = read_picture(picture, inks=False)
        view, view_name = lost_camera(picture, recognised, searched)
        camera_notes = [f"has no camera: that of {view_name}, which it matches"]
    else:
        recognised, camera_notes = None, []
        view = camera_from(camera) if camera is not None else find_camera(picture)
    _check_size(view, camera or picture)
    target_size = (view.width, view.height)
    _check_declared(picture, "the picture", declared, target_size)
    decoded = recognised or read_picture(picture, inks=False)
    if decoded.alpha is not None and not decoded.alpha.any() and find_alpha(picture) is None:
        raise ValueError(
            f"{picture}: is transparent everywhere: there is no paint in it; save it with its layers shown"
        )
    notes = [*camera_notes, *decoded.notes]
    _check_aspect(picture, "the picture", decoded.size, target_size)
    # A larger picture of the view's shape is a larger render of it; others are resampled.
    larger = larger_view(view, *decoded.size)
    if larger is not None:
        lifted = "" if decoded.size == (larger.width, larger.height) else f", lifted at {larger.width}x{larger.height}"
        notes.append(
            f"{decoded.size[0]}x{decoded.size[1]}: a larger render of its view of {view.width}x{view.height}{lifted}"
        )
    elif decoded.size != target_size:
        notes.append(_resampled(decoded.size, view))
    camera_used = larger or view
    size = camera_used.width, camera_used.height
    # The mask, at the camera's size.
    marked = None
    if mask is not None:
        _check_declared(mask, "the mask", declared_size(mask), target_size)
        if decoded.alpha is None and mask.exists() and os.path.samefile(mask, picture):
            raise ValueError(f"{mask}: is the edited picture itself; expected a mask: white where it was painted")
        marked = read_mask(mask)
        _check_aspect(mask, "the mask", (marked.shape[1], marked.shape[0]), target_size)
        if not marked.any():
            raise ValueError(f"{mask}: {EMPTY_MASK}")
        if marked.shape[::-1] != size:
            marked = resample(marked.astype(np.float32), *size) > MIN_MASK
    # Rendered without a background: behind it lies the background, not the asset.
    cut_out = find_alpha(picture) or (camera and find_alpha(picture, camera))
    fitted = unmultiplied(decoded, cut_out).resized(*size)
    rendered = None if larger is None else view
    return PictureFile(picture, fitted, decoded.size, camera_used, marked, tuple(notes), bool(cut_out), rendered)


def _resampled(size: tuple[int, int], view: Camera) -> str:
    return f"resampled from {size[0]}x{size[1]} to its camera's {view.width}x{view.height}"


def unmultiplied(picture: Picture, kind: Alpha | None) -> Picture:
    """The picture with straight colours; kind: what `find_alpha` says of its file."""
    if kind != "premultiplied" or picture.alpha is None:
        return picture
    return replace(picture, colors=np.clip(unpremultiplied(picture.colors, picture.alpha), 0, 1))


def camera_from(path: Path, asset: Path | None = None) -> Camera:
    """The camera in a JSON file, in a PNG that carries one, or that FILE:N names in a capture (without its lens).
    asset: the file or folder that it is for, as of `captured_views`. Raises ValueError naming the file; also where a
    capture has several and N does not say which."""
    file = split_selector(path)[0]
    if not file.exists():
        raise ValueError(f"{path}: no such file; expected a camera (CAM.json, or a PNG rendered by splatpainter)")
    if file != path or is_capture(file) or os.path.isdir(file):  # of a folder without, reading it says what is missing
        view = choose_one(named_views(path, asset), path)
        _check_size(view.camera, path)
        return view.camera
    if foreign := foreign_capture(file):
        raise ValueError(f"{path}: is {foreign}")
    if path.suffix.lower() in PICTURE_SUFFIXES:
        camera = find_camera(path)
    else:
        camera = find_camera(path, path)
    _check_size(camera, path)
    return camera


def _check_size(camera: Camera, where: Path) -> None:
    if camera.width * camera.height > MAX_PICTURE_PIXELS:
        raise ValueError(f"{where}: expected a camera of {SIZE_LIMIT}, got {camera.width}x{camera.height}")


def _check_declared(path: Path, what: str, size: tuple[int, int] | None, target: tuple[int, int]) -> None:
    """`_check_aspect` before anything is decoded: a kilobyte can claim megapixels. EXIF may still turn the picture."""
    if size is not None and not has_aspect((size[1], size[0]), target):
        _check_aspect(path, what, size, target)


def has_aspect(size: tuple[int, int], target: tuple[int, int]) -> bool:
    """Whether a size has the shape of another: equal sizes have; others must have the target's aspect ratio within
    MAX_ASPECT_ERROR, or be a pixel off."""
    (width, height), (w, h) = size, target
    # Small pictures are off by a whole pixel, which is more than a per cent of them.
    scale = math.sqrt(width * height / (w * h))
    rounding = abs(width - w * scale) <= 1 and abs(height - h * scale) <= 1
    return rounding or abs((width / height) / (w / h) - 1) <= MAX_ASPECT_ERROR


def _check_aspect(path: Path, what: str, size: tuple[int, int], target: tuple[int, int]) -> None:
    (width, height), (w, h) = size, target
    if not has_aspect(size, target):
        raise ValueError(
            f"{path}: expected {what} to have the aspect ratio of its camera ({w}x{h}), got {width}x{height}; "
            "resize without cropping"
        )


def over_render(
    colors: np.ndarray,
    alpha: np.ndarray,
    render: np.ndarray,
    cover: np.ndarray,
    behind: tuple[float, float, float] | None = None,
) -> np.ndarray:
    """[H, W, 3] a picture (colours [H, W, 3] straight, alpha [H, W]) over the asset's render [H, W, 3] of alpha `cover`
    [H, W], all in one space. behind: the render's background, where the picture was rendered without one: then `alpha`
    replaces the asset's own alpha up to there, and an edge that nobody touched stays what it was; what was erased
    shows the asset again."""
    share = alpha[..., None]
    if behind is None:
        return share * colors + (1 - share) * render
    # Alpha replaces the asset's own up to there, so untouched soft edges come back as they were.
    background = np.asarray(behind, np.float32)
    cover = cover[..., None]
    drawn = render - (1 - cover) * background  # multiplied by its alpha
    erased = np.maximum(cover - share, 0) / np.maximum(cover, 1e-6)
    return share * colors + erased * drawn + (1 - np.maximum(share, cover)) * background


def draw(splats: Splats, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, 3] colours, [H, W] alpha)."""
    from splatpainter.rendering.cpu.recent_views import drawn_view

    drawn = drawn_view(splats.numpy(), camera)
    return drawn.colors, drawn.alphas
