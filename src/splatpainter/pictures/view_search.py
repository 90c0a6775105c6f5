"""Which view a picture shows that lost its camera: "save as" under a new name is the normal case, and GIMP, darktable,
ffmpeg and every file that is no PNG drop what was inside.

Views are looked for among pictures that carry a camera, or have it beside them, in folders: thumbnails of what the view
looked like are compared with the picture's. Pictures are display sRGB 0..1.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import field
from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.image_files import CAMERA_KEYWORD, exr_text, find_camera, is_exr
from splatpainter.pictures.picture_reader import MAX_PICTURE_PIXELS, Picture, declared_size, read_picture, resample
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class ViewSearchThresholds:
    """How a picture's view is recognised. Source: taste, tried on turntables and captures."""

    thumbnail_px: int = 48
    """Pixels of the thumbnails that pictures are recognised by."""
    max_thumbnail_difference: float = 0.04
    """Mean difference of the half of the thumbnails that agrees best, up to which one was made from the other."""
    min_rival_ratio: float = 1.5
    """A view is the one only where every other is worse by this factor."""
    min_rival_margin: float = 0.004
    """Every other must also be worse by this mean difference."""
    max_toned_difference: float = 0.01
    """max_thumbnail_difference, of graded pictures. Of seven grades of 48 painted views of six assets 297 of 336 find a
    view; of as many between the views 4 are taken for one beside them, where without a tone 1 is."""
    min_toned_ratio: float = 2.5
    """min_rival_ratio, of these."""
    tone_rounds: int = 4
    """Rounds in which a grade is fitted."""
    toned_share: float = 0.8
    """Share of the pixels that it is fitted to: the rest may have been painted over."""
    tone_gains: tuple[float, float] = (0.4, 2.5)
    """Gains of contrast that a grade may have: with less, any two pictures are alike."""
    min_content: float = 3 / 255
    """Difference to the background from which a pixel of a thumbnail shows something."""
    max_files: int = 2000
    """Files of a folder whose names are looked at."""
    max_views: int = 128
    """Views of it that are compared, the latest first."""
    max_decoded_pixels: int = 1 << 24
    """Larger pictures are no candidates: decoding them all takes too long."""


VIEW_SEARCH = ViewSearchThresholds()


MAX_ASPECT_ERROR = 0.01
"""A picture's aspect ratio may differ from its camera's by this part (one pixel of rounding, and some)."""


VIEW_ENDINGS = (".png", ".exr", ".webp", ".tif", ".tiff", ".jpg", ".jpeg")


@dataclass(frozen=True)
class NamedView:
    """A view that was given out to be edited elsewhere."""

    name: str
    camera: Camera
    thumbnail: np.ndarray = field(repr=False)
    """[S, S, 3] float32 what it looked like."""


def same_shape(size: tuple[int, int], target: tuple[int, int]) -> bool:
    """Whether a picture of `size` (width, height) is one of `target`, resized."""
    return abs((size[0] / size[1]) / (target[0] / target[1]) - 1) <= MAX_ASPECT_ERROR or (
        abs(size[0] - size[1] * target[0] / target[1]) <= 1
    )


def thumbnail(image: np.ndarray) -> np.ndarray:
    """[VIEW_SEARCH.thumbnail_px, VIEW_SEARCH.thumbnail_px, 3] a picture shrunk, to be recognised by."""
    return resample(np.clip(image, 0, 1), VIEW_SEARCH.thumbnail_px, VIEW_SEARCH.thumbnail_px)


def most_alike(picture: np.ndarray, views: Sequence[NamedView], stem: str = "") -> NamedView | None:
    """The view that a picture [h, w, 3] was made from, None where none is like it, or several are. stem: of the
    picture's name: of several that are like it the one whose name it begins with is meant.

    Only what one of the two shows besides their background counts, and of that the half of the pixels that agrees best:
    the other half may have been painted over."""
    pixels = thumbnail(picture)
    limits = VIEW_SEARCH.max_thumbnail_difference, VIEW_SEARCH.min_rival_ratio
    best = _likest([_unlikeness(pixels, view.thumbnail) for view in views], views, stem, *limits)
    if best is not None or not views:
        return best
    # A developed or regraded picture is like its view but for one tone over all of it, which is asked for more.
    toned = [_unlikeness(pixels, _toned(view.thumbnail, pixels)) for view in views]
    return _likest(toned, views, stem, VIEW_SEARCH.max_toned_difference, VIEW_SEARCH.min_toned_ratio)


def _likest(
    scores: Sequence[float], views: Sequence[NamedView], stem: str, max_score: float, min_ratio: float
) -> NamedView | None:
    """The view of the least score; None where that is too large, or others have nearly as little."""
    order = sorted(range(len(views)), key=lambda k: scores[k])
    if not order or scores[order[0]] > max_score:
        return None
    best = views[order[0]]
    # Two views that are nearly as alike leave a doubt, which only a name can settle.
    limit = max(min_ratio * scores[order[0]], scores[order[0]] + VIEW_SEARCH.min_rival_margin)
    rivals = [views[k] for k in order if scores[k] < limit and not same_view(views[k].camera, best.camera)]
    if not rivals:
        return best
    by_name = [view for view in (best, *rivals) if _is_named_after(stem, Path(view.name).stem)]
    return by_name[0] if len(by_name) == 1 else None


def _toned(view: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """A view's thumbnail [S, S, 3] in the exposure, contrast and balance of a picture's; as it is where no such grade
    leads from the one to the other."""
    before, after = view.reshape(-1, 3).astype(np.float64), picture.reshape(-1, 3).astype(np.float64)
    unpainted, out = np.ones(len(before), bool), before
    for _ in range(VIEW_SEARCH.tone_rounds):
        low, high = before[unpainted].mean(0), after[unpainted].mean(0)
        spread = ((before[unpainted] - low) ** 2).sum(0)
        gain = ((before[unpainted] - low) * (after[unpainted] - high)).sum(0) / np.maximum(spread, 1e-6)
        if gain.min() < VIEW_SEARCH.tone_gains[0] or gain.max() > VIEW_SEARCH.tone_gains[1]:
            return view
        out = high + gain * (before - low)
        error = np.abs(out - after).mean(1)
        # What was painted over is in no tone.
        unpainted = error <= np.sort(error)[int(VIEW_SEARCH.toned_share * (len(error) - 1))]
    return np.clip(out, 0, 1).reshape(view.shape).astype(np.float32)


def _unlikeness(picture: np.ndarray, other: np.ndarray) -> float:
    # A view's border is mostly background; bare pixels agree in any two views and say nothing.
    border = np.concatenate([other[0], other[-1], other[:, 0], other[:, -1]])
    background = np.median(border, 0)
    shows = (
        np.maximum(np.abs(picture - background).max(-1), np.abs(other - background).max(-1)) > VIEW_SEARCH.min_content
    )
    difference = np.abs(picture - other).mean(-1)
    values = np.sort(difference[shows] if shows.any() else difference, axis=None)
    return float(values[: len(values) // 2 + 1].mean())


def same_view(one: Camera, other: Camera) -> bool:
    """Of any size."""
    shape = one.fx * other.width / (other.fx * one.width)
    return bool(np.allclose(one.world_to_camera, other.world_to_camera, atol=1e-6) and abs(shape - 1) < 1e-3)


def _is_named_after(stem: str, view: str) -> bool:
    """ "view_000 final" is named after view_000, "view_0001" is not."""
    return bool(view) and stem.startswith(view) and not stem[len(view) : len(view) + 1].isalnum()


def views_in(folders: Iterable[Path], size: tuple[int, int] | None, besides: Path | None = None) -> list[NamedView]:
    """Views of the shape of a picture of `size` (None: of any shape) that lie in folders as pictures with a camera in
    them or beside them. Folders and files that cannot be read are passed over. besides: a file that is none of them."""
    out: list[NamedView] = []
    # The latest first, and a bounded number: a folder may hold years of pictures.
    for folder in dict.fromkeys(Path(folder) for folder in folders):
        for path in _pictures(folder):
            if len(out) >= VIEW_SEARCH.max_views:
                return out
            if besides is not None and path.name == besides.name and path.parent == besides.parent:
                continue
            if (view := _view_of(path, size)) is not None:
                out.append(view)
    return out


def _pictures(folder: Path) -> list[Path]:
    """The latest first."""
    dated = []
    try:
        for count, path in enumerate(folder.iterdir()):
            if count >= VIEW_SEARCH.max_files:
                break
            if path.suffix.lower() in VIEW_ENDINGS and not path.name.startswith(".") and path.is_file():
                dated.append((-path.stat().st_mtime_ns, path.name, path))
    except OSError:
        return []
    return [path for _, _, path in sorted(dated)]


def _view_of(path: Path, size: tuple[int, int] | None) -> NamedView | None:
    try:
        # Cheap tests first; decoding comes last.
        if not (path.with_suffix(".json").is_file() or _says_camera(path)):
            return None
        camera = find_camera(path)
        declared = declared_size(path) or (camera.width, camera.height)
        if (size is not None and not same_shape(size, (camera.width, camera.height))) or declared[0] * declared[
            1
        ] > VIEW_SEARCH.max_decoded_pixels:
            return None
        picture = read_picture(path)
    except ValueError:
        return None
    return NamedView(path.name, camera, thumbnail(_flat(picture, camera)))


def _says_camera(path: Path) -> bool:
    """Whether a file names the keyword near its beginning, before it is opened as a picture."""
    if is_exr(path):
        return exr_text(path, CAMERA_KEYWORD, MAX_PICTURE_PIXELS) is not None
    try:
        with open(path, "rb") as file:
            return CAMERA_KEYWORD.encode() in file.read(1 << 16)
    except OSError:
        return False


def _flat(picture: Picture, camera: Camera) -> np.ndarray:
    """[H, W, 3] over the view's background, where it was rendered without one."""
    if picture.alpha is None:
        return picture.colors
    return picture.colors * picture.alpha[..., None] + (1 - picture.alpha[..., None]) * np.asarray(camera.background)


def lost_camera(path: Path, picture: Picture, folders: Iterable[Path]) -> tuple[Camera, str]:
    """(the camera of a picture that carries none, the name of the view that it was made from), looked for in folders.
    Raises ValueError: the picture matches no view there, or several."""
    views = views_in(folders, picture.size, besides=path)
    background = views[0].camera if views else None
    colors = picture.colors if background is None else _flat(picture, background)
    best = most_alike(colors, views, path.stem)
    if best is None:
        actual = f"none of {len(views)} views beside it is like it, or several are" if views else "no view beside it"
        if not views and (of_any_shape := views_in(folders, None, besides=path)):
            view, (width, height) = of_any_shape[0], picture.size
            shape = f"{view.camera.width}x{view.camera.height}"
            actual += f" has its shape, {width}x{height} ({view.name} is of {shape}: do not crop)"
        raise ValueError(
            f"{path}: no camera in it, in {path.with_suffix('.json').name}, or given with --camera, and {actual}; give "
            "--camera CAM.json, the view that it was painted on, or the folder of the views"
        )
    return best.camera, best.name
