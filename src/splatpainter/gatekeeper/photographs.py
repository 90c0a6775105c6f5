"""Photographs of a capture as pictures: turned as their cameras saw them, straightened to a pinhole's; and painted ones
as edits, of which the paint alone changes the asset.

    painted = photograph_edit(Path("DSC07956.jpg"), view)      # read and straightened
    edit = laid_over(painted, splats, "local").edit(splats)    # cut to the paint, in the asset's own exposure

A photograph is not the asset's render: its exposure differs, it is sharper, the asset has holes. Where the capture
still has the photograph as it was taken, the paint is what differs from that; else what differs from the render by more
than a photograph does. Exposure and place are taken back by the gatekeeper.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.captures import CapturedView, capture_of, choose_one, is_capture, named_views, split_selector
from splatpainter.color import to_display
from splatpainter.gatekeeper.strictness import Strictness
from splatpainter.image_files import find_camera, is_exr, picture_header, to_uint8
from splatpainter.io import files
from splatpainter.lift.masks import box_mean, change_mask, changed_throughout, dilated, largest_channel
from splatpainter.painter import Mode
from splatpainter.pictures.edit_files import MIN_MASK, Photograph, PictureFile, edit_from_files, has_aspect
from splatpainter.pictures.picture_reader import EMPTY_MASK, EXIF_STEPS, Picture, read_mask, read_picture
from splatpainter.rendering import render as render_views
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.gatekeeper.gatekeeper import AdmittedPicture
    from splatpainter.sources.picture_source import PictureRequest


@dataclass(frozen=True)
class PhotographThresholds:
    """What was painted on a photograph, told from what an asset never shows of it. Measured on six photographs of one
    capture where an entry says so, else taste."""

    max_photograph_px: int = 1600
    """Longer side, straightened, at which a painted photograph is used; INRIA's trainer and nerfstudio scale larger
    ones down to that."""
    compared_px: int = 256
    """Longer side of pictures whose turns are told apart."""
    max_turned_distance: float = 0.5
    """A photograph counts as turned upside down by hand where it is then nearer to itself as it was taken by this
    factor."""
    min_turned_likeness: float = 0.15
    """It counts as upside down where its correlation with the asset's render is higher by this once it is turned."""
    min_solid: float = 0.5
    """Alpha from which a pixel of a straightened photograph is one."""
    blur_px: int = 3
    """Reach of the means by which a photograph is compared with a render: detail that the asset lacks averages out."""
    max_residual: float = 60 / 255
    """No photograph differs from its render by more without paint."""
    residuals: float = 6.0
    """No photograph without paint differs by more times than this of what it differs by where there is as much
    detail."""
    min_residual: float = 10 / 255
    """Smaller differences of a photograph to its render are never paint."""
    detail_levels: int = 8
    """Levels of detail, each with what photographs differ by there."""
    seed_residuals: float = 4.0
    """Paint has a place where it differs by more than so many times what four fifths of the pixels differ by."""
    min_seed_residual: float = 24 / 255
    """The least such difference: of 6 photographs of an asset of 24 to 25 dB none has it without paint."""
    max_seed_residual: float = 100 / 255
    """The largest that is asked for."""
    spread_px: int = 16
    """Pixels by which paint reaches from there to what differs less, step by step."""


PHOTOGRAPHS = PhotographThresholds()
HALF_TURN = 3
"""EXIF's orientation of 180 degrees."""
INVERSE_TURNS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
"""Orientation -> the one that turns back what it turns."""
_HALF_TURNED = {1: 3, 2: 4, 3: 1, 4: 2, 5: 7, 6: 8, 7: 5, 8: 6}
"""Orientation -> the one that is as if the picture had been turned by 180 degrees besides."""


@dataclass(frozen=True)
class StraightPicture:
    """A photograph as a pinhole camera had taken it."""

    camera: Camera
    colors: np.ndarray = field(repr=False)
    """[H, W, 3] display sRGB."""
    alpha: np.ndarray | None = field(repr=False)
    """[H, W] 0..1, of the picture's transparency and of what the photograph does not show; None: all of it is there."""


def read_photograph(path: Path, size: tuple[int, int], seen_turned: bool = False) -> Picture:
    """A photograph whose camera has `size` (width, height), turned as its camera counts pixels: as the file stores
    them, for COLMAP, nerfstudio and INRIA's trainer look at no EXIF orientation; as EXIF turns them where only that
    has the camera's shape, or where both have it and seen_turned says so. Raises ValueError as `read_picture`."""
    picture = read_picture(path)
    # The shape decides: a camera file knows in which turn its pixels were counted.
    orientation = _orientation(path)
    stored = unturned(picture, orientation)
    fits = has_aspect(picture.size, size)
    return picture if fits and (seen_turned or not has_aspect(stored.size, size)) else stored


def turned(picture: Picture, orientation: int) -> Picture:
    """A picture as an EXIF orientation (1 to 8) says that it is to be seen."""
    across, down = EXIF_STEPS.get(orientation, (1, 1))

    def turn(values: np.ndarray) -> np.ndarray:
        return (values.swapaxes(0, 1) if orientation >= 5 else values)[::down, ::across]

    return picture if orientation == 1 else _rearranged(picture, turn)


def unturned(picture: Picture, orientation: int) -> Picture:
    """The inverse."""
    across, down = EXIF_STEPS.get(orientation, (1, 1))

    def back(values: np.ndarray) -> np.ndarray:
        values = values[::down, ::across]
        return values.swapaxes(0, 1) if orientation >= 5 else values

    return picture if orientation == 1 else _rearranged(picture, back)


def _rearranged(picture: Picture, move: Callable[[np.ndarray], np.ndarray]) -> Picture:
    alpha = None if picture.alpha is None else np.ascontiguousarray(move(picture.alpha))
    return replace(picture, colors=np.ascontiguousarray(move(picture.colors)), alpha=alpha)


def straight_picture(picture: Picture, view: CapturedView, *, all_of_it: bool) -> StraightPicture:
    """A photograph of its view's shape, through a pinhole of its place, at the view's size."""
    from splatpainter.captures.lenses import straightened  # of photographs alone

    camera = view.camera
    picture = picture.resized(camera.width, camera.height)
    if view.lens is None:
        return StraightPicture(camera, picture.colors, picture.alpha)
    window = view.pinhole(all_of_it=all_of_it)
    if picture.alpha is None:
        colors, inside = straightened(picture.colors, camera, view.lens, window)
        return StraightPicture(window, np.clip(colors, 0, 1), None if inside.all() else inside.astype(np.float32))
    # Premultiplied, so that colours of transparent pixels do not leak into their neighbours when they are resampled.
    alpha = picture.alpha[..., None]
    straight, inside = straightened(np.concatenate([picture.colors * alpha, alpha], 2), camera, view.lens, window)
    colors = np.clip(straight[..., :3] / np.maximum(straight[..., 3:], 1e-3), 0, 1)
    return StraightPicture(window, colors, np.clip(straight[..., 3], 0, 1) * inside)


def picture_edit(
    picture: Path,
    camera: Path | None = None,
    mask: Path | None = None,
    asset: Path | None = None,
    folders: Sequence[Path] = (),
) -> PictureFile:
    """As `edit_from_files`; where `camera` is FILE[:N] of a capture, or the asset lies in a folder with one and the
    picture has no camera but the name of a photograph of it: that photograph, painted on.

    Raises ValueError, one line naming the file: as `edit_from_files`, and for a capture in which nothing says which
    view it is."""
    if camera is not None and split_selector(camera)[0] == camera and not is_capture(camera):
        return edit_from_files(picture, camera, mask, folders)
    # Read in any case: a damaged list that was named must not pass because this picture has a camera of its own.
    listed = None if camera is None else named_views(camera, asset, picture)
    if carries_camera(picture):  # a render's, painted on: no photograph
        return edit_from_files(picture, None, mask)
    if camera is not None and listed is not None:
        return photograph_edit(picture, choose_one(listed, camera), mask)
    beside = None if asset is None else capture_of(asset)
    views = [] if beside is None else named_views(beside, asset, picture)
    if len(views) == 1 and views[0].is_meant_by(picture.name):
        return photograph_edit(picture, views[0], mask)
    return edit_from_files(picture, None, mask, folders)


def carries_camera(picture: Path) -> bool:
    """Whether a picture has a camera of splatpainter's, in it or beside it."""
    try:
        find_camera(picture)
    except ValueError:
        return False
    return True


def photograph_edit(
    path: Path, view: CapturedView, mask: Path | None = None, *, half_turn: bool = False
) -> PictureFile:
    """A painted photograph, straightened, at most of PHOTOGRAPHS.max_photograph_px. mask: a picture of the photograph's
    pixels. half_turn: the camera is of it turned by 180 degrees, which no shape tells.

    Raises ValueError, one line naming the file: unreadable, of another shape than its camera, an empty mask."""
    size = view.camera.width, view.camera.height
    # The photograph as it was taken, if the capture still has it, says best what was painted.
    original = view.picture()
    if original is not None and files.is_same(original, path):  # painted in its place
        original = None
    taken = None if original is None else read_photograph(original, size)
    if taken is not None and not has_aspect(taken.size, size):
        taken = None
    # Which way round the program saved it.
    picture, turn = _as_taken(path, size, taken, 1 if original is None else _orientation(original))
    by_hand = turn not in (1, _orientation(path), 1 if original is None else _orientation(original))
    if half_turn:
        picture, turn = turned(picture, HALF_TURN), _HALF_TURNED[turn]
        taken = None if taken is None else turned(taken, HALF_TURN)
    # Straightened at the size that is used, not at the file's: a phone's picture has 50 million pixels.
    window = view.resized(*picture.size).pinhole(all_of_it=True)
    scale = min(1.0, PHOTOGRAPHS.max_photograph_px / max(window.width, window.height))
    used = view.resized(*(max(1, round(side * scale)) for side in picture.size))
    straight = straight_picture(picture, used, all_of_it=True)
    notes = list(picture.notes)
    if by_hand and not half_turn:
        notes.append("turned by 180 degrees, as the photograph was taken")
    if half_turn:
        notes.append("turned by 180 degrees: only so it fits the asset seen from its camera")
    if view.lens is not None:
        notes.append("its lens's distortion was taken out")
    camera = straight.camera
    if picture.size != (used.camera.width, used.camera.height):
        size_used = f"{used.camera.width}x{used.camera.height}"
        notes.append(f"used at {size_used} of its {picture.size[0]}x{picture.size[1]} pixels")
    marked = None if mask is None else photograph_mask(mask, (turn, 1), used, all_of_it=True)
    if taken is not None:
        # The original with the loss of the painted file: what still differs is paint.
        taken = _saved_again(taken, picture, path, turn)
    before = None if taken is None else straight_picture(taken, used, all_of_it=True).colors
    other = None if half_turn else partial(photograph_edit, path, view, mask, half_turn=True)
    photograph = Photograph(before, None if before is None else original, other)
    fitted = Picture(straight.colors, straight.alpha)
    return PictureFile(path, fitted, picture.size, camera, marked, tuple(notes), photograph=photograph)


def _orientation(path: Path) -> int:
    """1 to 8; 1 of files whose header Pillow cannot read, which have none."""
    try:
        return 1 if is_exr(path) else picture_header(path)[1]
    except ValueError:
        return 1


def _as_taken(path: Path, size: tuple[int, int], taken: Picture | None, orientation: int) -> tuple[Picture, int]:
    """(a painted photograph as its camera counts pixels, the EXIF orientation that was taken back for it). Programs
    keep the orientation of the photograph, or turn its pixels and drop it: of the ways that fit, the one nearest to the
    photograph as it was taken. orientation: of that."""
    picture = read_picture(path, inks=False)
    turns = dict.fromkeys((_orientation(path), 1, orientation))
    ways = [(unturned(picture, turn), turn) for turn in turns]
    ways = [way for way in ways if has_aspect(way[0].size, size)]
    by_hand = [_HALF_TURNED[turn] for _, turn in ways if _HALF_TURNED[turn] not in turns]
    if not ways:
        width, height = picture.size
        raise ValueError(
            f"{path}: expected the aspect ratio of its camera ({size[0]}x{size[1]}), got {width}x{height}; "
            "resize without cropping"
        )
    if taken is None:
        return ways[0]
    # At this size a turn is plain and paint is not.
    small = [max(1, round(side * PHOTOGRAPHS.compared_px / max(size))) for side in size]
    like = taken.resized(*small).colors

    def distance(way: tuple[Picture, int]) -> float:
        return float(np.abs(way[0].resized(*small).colors - like).mean())

    best = min(ways, key=distance)
    # Nobody said that it was turned upside down by hand: only where that is beyond doubt.
    upright = min(((unturned(picture, turn), turn) for turn in by_hand), key=distance, default=best)
    return upright if distance(upright) < PHOTOGRAPHS.max_turned_distance * distance(best) else best


def _saved_again(taken: Picture, picture: Picture, path: Path, turn: int) -> Picture:
    """A photograph as it was taken, with the loss that the JPEG at `path`, which it was painted in, has all over: what
    is left of a difference is paint. Itself where that is nearer, or the file is of another kind or size. picture: what
    the file holds, which was turned back by the EXIF orientation `turn` for it."""
    from PIL import Image, JpegImagePlugin

    file_turn = _orientation(path)
    # JPEG's blocks lie in the file's own orientation.
    stored = unturned(turned(taken, turn), file_turn)
    try:
        with Image.open(path, formats=("JPEG",)) as image:
            tables, sampling = getattr(image, "quantization", None), JpegImagePlugin.get_sampling(image)
            if image.mode != "RGB" or image.size != stored.size or not tables or sampling < 0:
                return taken
        buffer = io.BytesIO()
        Image.fromarray(to_uint8(stored.colors)).save(buffer, "JPEG", qtables=tables, subsampling=sampling)
        with Image.open(buffer) as again:
            lossy = replace(stored, colors=np.asarray(again, np.float32) / 255)
    except Exception:  # another kind of file, or tables that Pillow does not write
        return taken
    lossy = unturned(turned(lossy, file_turn), turn)
    before, after = (float(np.abs(picture.colors - other.colors).mean()) for other in (taken, lossy))
    return lossy if after < before else taken


def photograph_mask(path: Path, turns: Sequence[int], view: CapturedView, *, all_of_it: bool) -> np.ndarray:
    """[H, W] bool of a mask of the photograph's pixels, straightened as it is. turns: EXIF orientations that may have
    to be taken back; the first by which it has the photograph's shape is. Raises ValueError: none, or it is empty."""
    marked = read_mask(path).astype(np.float32)
    size = view.camera.width, view.camera.height
    ways = (unturned(Picture(np.repeat(marked[..., None], 3, 2), None), turn) for turn in turns)
    as_stored = next((way for way in ways if has_aspect(way.size, size)), None)
    if as_stored is None:
        raise ValueError(f"{path}: expected the mask to have the shape of its photograph, {size[0]}x{size[1]}")
    straight = straight_picture(as_stored, view, all_of_it=all_of_it)
    out = straight.colors[..., 0] > MIN_MASK
    if straight.alpha is not None:
        out &= straight.alpha > PHOTOGRAPHS.min_solid
    if not out.any():
        raise ValueError(f"{path}: {EMPTY_MASK}")
    return out


# ---- over the asset


def laid_over(
    edit: PictureFile, splats: Splats, mode: Mode = "local", strictness: Strictness = "normal"
) -> PictureFile:
    """A painted photograph over the asset's render: the render's pixels, and the paint in the render's exposure; a file
    of another kind as it is. In mode "global" all of the picture, by as much as it was changed.

    Raises ValueError: nothing was painted, or everything; RefusedPicture: it shows something else."""
    photograph = edit.photograph
    if photograph is None:
        return edit
    from splatpainter.sources.picture_source import PictureRequest  # of photographs alone

    # Georeferenced captures: camera and asset in the same small numbers.
    edit = edit.relative_to(splats.offset)
    drawn = render_views(splats, edit.camera)
    space = splats.color_space
    render, cover = np.clip(to_display(drawn.colors[0], space), 0, 1).astype(np.float32), drawn.alphas[0, ..., 0]
    colors, taken = edit.picture.colors, photograph.taken
    solid = np.ones(cover.shape, bool) if edit.picture.alpha is None else edit.picture.alpha > PHOTOGRAPHS.min_solid
    if photograph.half_turned is not None and _is_upside_down(
        colors if taken is None else taken, render, solid & (cover > PHOTOGRAPHS.min_solid)
    ):
        return laid_over(photograph.half_turned(), splats, mode, strictness)
    # The file's name may be a photograph's while its pixels are a render's.
    if taken is not None and _nearer(colors, render, taken, solid & (cover > PHOTOGRAPHS.min_solid)):
        taken = None  # not the photograph was painted on, but a render that lost its camera
    if mode == "global" and edit.mask is None:
        return _regraded(edit, render, taken, solid)
    # Without the original nothing else tells a vignette from paint.
    if taken is None and edit.mask is None:
        edit = _with_even_light(edit, render, cover)
    # Everything else is the gatekeeper's: place, exposure, cut.
    request = PictureRequest(render, cover, None if edit.mask is None else edit.mask.astype(np.float32))
    if taken is not None and edit.mask is None:
        request = replace(request, mask=_painted(edit, taken, solid).astype(np.float32))
    admitted = _admitted(edit, request, strictness)
    notes = edit.notes
    if request.mask is None:
        # Without the original a second pass is needed: first lay it over, then ask what no photograph does by itself.
        paint = _beyond_a_photograph(admitted, render, solid & (cover > PHOTOGRAPHS.min_solid))
        if not paint.any():
            raise ValueError(f"{edit.path}: no paint: it differs from the asset's render by what photographs do")
        request = replace(request, mask=paint.astype(np.float32))
        admitted = _admitted(edit, request, strictness)
        notes += (
            "what is paint was told from the render, as the photograph is not there; --mask M.png says it better",
        )
    notes += tuple(note for note in admitted.notes if "outside the mask" not in note)
    picture = Picture(admitted.image, None)
    return replace(edit, picture=picture, mask=admitted.changed, notes=notes, photograph=None)


def _with_even_light(edit: PictureFile, render: np.ndarray, cover: np.ndarray) -> PictureFile:
    """A photograph whose corners are as bright as its middle."""
    from splatpainter.gatekeeper.shades import darker_corners  # of photographs alone

    alpha = edit.picture.alpha
    undone = darker_corners(edit.picture.colors, render, cover if alpha is None else np.minimum(cover, alpha))
    if undone is None:
        return edit
    colors = np.ascontiguousarray(undone(edit.picture.colors), np.float32)
    notes = (*edit.notes, "its vignette was taken back")
    return replace(edit, picture=replace(edit.picture, colors=colors), notes=notes)


def _admitted(edit: PictureFile, request: PictureRequest, strictness: Strictness) -> AdmittedPicture:
    from splatpainter.gatekeeper.gatekeeper import RefusedPicture, admit  # of photographs alone

    colors, alpha = edit.picture.colors, edit.picture.alpha
    painted = colors if alpha is None else np.dstack([colors, alpha])
    try:
        return admit(painted, request, strictness=strictness, tones=False, name=str(edit.path))
    except RefusedPicture as error:
        hint = "it was laid over the asset seen from its camera: is it of that view, and the asset of that capture?"
        raise RefusedPicture(f"{error}; {hint}") from None


def _is_upside_down(colors: np.ndarray, render: np.ndarray, where: np.ndarray) -> bool:
    """Whether a photograph fits a render much better once it is turned by 180 degrees."""
    both = where & where[::-1, ::-1]  # the same pixels in both
    if not both.any():
        return False
    blurred = [box_mean(values.mean(-1), PHOTOGRAPHS.blur_px) for values in (colors, render)]
    as_it_is, turned_round = (
        _correlation(seen[both], blurred[1][both]) for seen in (blurred[0], blurred[0][::-1, ::-1])
    )
    return turned_round > as_it_is + PHOTOGRAPHS.min_turned_likeness


def _correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Of two lists of numbers; 0 where one is constant."""
    one, other = first - first.mean(), second - second.mean()
    size = math.sqrt(float((one * one).sum()) * float((other * other).sum()))
    return float((one * other).sum()) / size if size > 0 else 0.0


def _nearer(colors: np.ndarray, render: np.ndarray, taken: np.ndarray, where: np.ndarray) -> bool:
    """Whether a picture is a painted render, and no painted photograph."""
    if not where.any():
        return False
    to_render, to_taken = (float(np.median(np.abs(colors - other).mean(-1)[where])) for other in (render, taken))
    return to_render < 0.5 * to_taken


def _painted(edit: PictureFile, taken: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """[H, W] bool: where a photograph differs from itself as it was taken."""
    from splatpainter.gatekeeper.gatekeeper import GATE  # of photographs alone

    assert edit.photograph is not None
    colors, name = edit.picture.colors, edit.photograph.path
    if changed_throughout(colors, taken, solid.astype(np.float32)):
        raise ValueError(
            f"{edit.path}: differs from {name} nearly everywhere (regraded, sharpened, another photograph); give "
            "--mode global for a look, or --mask M.png for what was painted"
        )
    paint, difference = change_mask(colors, taken) & solid, largest_channel(np.abs(colors - taken))
    if paint.any() and not paint.all() and np.quantile(difference[~paint], 0.9) > GATE.max_lossless:
        paint &= box_mean(paint, GATE.speck_px) > GATE.speck_share  # saved again with another loss
    if not paint.any():
        raise ValueError(f"{edit.path}: is {name} as it was taken; nothing is painted on it")
    return paint


def _beyond_a_photograph(admitted: AdmittedPicture, render: np.ndarray, where: np.ndarray) -> np.ndarray:
    """[H, W] bool: where a photograph, its exposure corrected, differs from the render by more than photographs do
    where there is as much detail."""
    # Blurred: a photograph is sharper than its asset, which is no paint.
    shift = largest_channel(np.abs(box_mean(admitted.aligned - render, PHOTOGRAPHS.blur_px)))
    grey = render.mean(-1)
    detail = box_mean(np.abs(np.gradient(grey, axis=0)) + np.abs(np.gradient(grey, axis=1)), 2 * PHOTOGRAPHS.blur_px)
    if not where.any():
        return where
    # How much photographs differ depends on how much detail there is; each level has its own limit.
    edges = np.quantile(detail[where], np.linspace(0, 1, PHOTOGRAPHS.detail_levels + 1)[1:-1])
    level = np.searchsorted(edges, detail)
    limits = np.zeros(PHOTOGRAPHS.detail_levels)
    for k in range(PHOTOGRAPHS.detail_levels):
        values = shift[where & (level == k)]
        limits[k] = PHOTOGRAPHS.residuals * float(np.quantile(values, 0.35)) if len(values) else 0.0
    different = (shift > np.clip(limits, PHOTOGRAPHS.min_residual, PHOTOGRAPHS.max_residual)[level]) & where
    different &= box_mean(different, PHOTOGRAPHS.blur_px) > 0.4  # areas, no lines along edges
    # Paint starts where the difference is beyond doubt and spreads to what is merely different.
    largest = PHOTOGRAPHS.seed_residuals * float(np.quantile(shift[where], 0.8))
    paint = different & (shift > np.clip(largest, PHOTOGRAPHS.min_seed_residual, PHOTOGRAPHS.max_seed_residual))
    for _ in range(max(shift.shape) // PHOTOGRAPHS.spread_px + 1):
        more = dilated(paint, PHOTOGRAPHS.spread_px) & different
        if more.sum() == paint.sum():
            break
        paint = more
    painted = largest_channel(np.abs(admitted.aligned - render)) > PHOTOGRAPHS.min_residual / 2
    return (box_mean(paint, PHOTOGRAPHS.blur_px) > 0) & where & painted


def _regraded(edit: PictureFile, render: np.ndarray, taken: np.ndarray | None, solid: np.ndarray) -> PictureFile:
    """The render, changed by as much as the photograph was; without the photograph as it was taken, the picture."""
    if taken is None:
        note = "the photograph before it is not there: its exposure counts as part of the look"
        return replace(edit, notes=(*edit.notes, note), photograph=None)
    # Both photographs brought to the render's exposure; their difference is the look.
    from splatpainter.gatekeeper.color_drift import estimate_drift  # of photographs alone

    drift = estimate_drift(taken, render, solid, True)
    change = drift.corrected(edit.picture.colors) - drift.corrected(taken)
    colors = np.clip(render + change, 0, 1).astype(np.float32)
    notes = edit.notes
    if drift.kind != "none":
        notes += (f"colours corrected by {drift.strength:.2f} stops ({drift.kind})",)
    return replace(edit, picture=replace(edit.picture, colors=colors), notes=notes, photograph=None)
