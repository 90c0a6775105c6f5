"""Pictures with cameras that `fit` fits to: those that carry them, and captures of other programs, straightened; and
where the first Gaussians of a fit to pictures are."""

from __future__ import annotations

from dataclasses import field, replace
from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.captures import CapturedView, captured_views, exposures_of, is_capture
from splatpainter.captures.colmap import MODEL_FILES, model_folder, other_models, photographs_of, read_points
from splatpainter.captures.inria import CAMERAS, EXPOSURES, INPUT_POINTS
from splatpainter.captures.nerfstudio import MAX_TABLE_BYTES, TABLES, splat_frame
from splatpainter.gatekeeper.photographs import (
    INVERSE_TURNS,
    carries_camera,
    photograph_mask,
    read_photograph,
    straight_picture,
)
from splatpainter.image_files import find_camera, picture_header
from splatpainter.io import files
from splatpainter.io.folders import inside
from splatpainter.io.foreign_captures import foreign_capture
from splatpainter.io.positions import NO_OFFSET, Offset, float32_step
from splatpainter.kernels.portable import inverse, matmul
from splatpainter.pictures.edit_files import has_aspect
from splatpainter.pictures.picture_reader import Picture, read_picture
from splatpainter.splats import Splats
from splatpainter.system.jsonio import load_document
from splatpainter.system.quick_dataclass import dataclass

BACKGROUNDS = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
"""Colours that stand in turn behind rendered views and transparent pictures: over one colour alone, Gaussians of that
colour may as well be holes, and holes Gaussians. The demo asset (96 px, 600 steps) lost 0.059 of its alpha over its own
dark background and the space around it gained 0.016; over these two in turn 0.005 and 0.003, held-out views 0.1 dB
better."""
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
TRIES_PER_GAUSSIAN = 20
"""Random points per first Gaussian that carving may throw away."""
MAX_STEP_OF_REACH = 1e-5
"""Distance between neighbouring float32 numbers at the cameras, as a share of what they show, from which they are moved
to an offset: a hundredth of a pixel in pictures of a thousand."""
MIN_POINTS = 16
"""Of a start."""
SAME_COLOR = 3 / 255
"""Difference up to which a pixel is of the background's colour."""
MIN_EDGE_SHARE = 0.9
"""Share of the pixels along the edges of all pictures that are of one colour, from which that is the background."""


@dataclass(frozen=True)
class PosedPicture:
    """One picture to fit to."""

    camera: Camera
    colors: np.ndarray = field(repr=False)
    """[H, W, 3] float32 0..1."""
    solid: np.ndarray = field(repr=False)
    """[H, W] bool where something may be."""
    mask: np.ndarray | None = field(default=None, repr=False)
    """[H, W] bool of the pixels that are looked at; None: all."""


def posed_pictures(folder: Path, size: int | None) -> list[PosedPicture]:
    """The pictures of a folder that have cameras, or of a capture's list of cameras, in the order of their names or of
    their table. size: pixels of the longer side; None: as they are. Raises ValueError, one line naming file and key."""
    if is_capture(folder):
        views, exposures = captured_views(folder), exposures_of(folder)
        paths = [_checked(view) for view in views]  # before the first is decoded
        turned = _turned_shapes(paths, views)[0]
        return over_common_color(
            [
                _photograph(path, view, size, k, turned, exposures.get(view.name))
                for k, (path, view) in enumerate(zip(paths, views, strict=True))
            ]
        )
    paths = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in PICTURES and path.is_file()]
    if not paths:
        foreign = foreign_capture(folder)
        what = f"is {foreign}; " if foreign else ""
        raise ValueError(
            f"{folder}: {what}expected pictures with cameras, {' or '.join(TABLES)}, or COLMAP's sparse/0; found "
            "neither"
        )
    above = folder.absolute().parent
    if is_capture(above) and not carries_camera(paths[0]):
        raise ValueError(f"{folder}: its pictures have no cameras; those of {above} may be theirs: name that folder")
    return [_picture(path, find_camera(path), size, k) for k, path in enumerate(paths)]


def over_common_color(pictures: list[PosedPicture]) -> list[PosedPicture]:
    """The pictures, with the one colour that lies along the edges of all of them as the background: renders and product
    shots before white. As they are where there is no such colour, or where transparency told the background."""
    # Transparent pictures stand over black and white in turn already.
    if len({picture.camera.background for picture in pictures}) > 1:
        return pictures
    edges = [_edge(picture) for picture in pictures]
    if not all(map(len, edges)):
        return pictures
    common = np.median(np.concatenate(edges), axis=0)
    shares = [float((np.abs(edge - common).max(1) <= SAME_COLOR).mean()) for edge in edges]
    # An object may reach over the edge of a picture, but no photograph of a room has one colour along its edges.
    if float(np.mean(shares)) < MIN_EDGE_SHARE or min(shares) < MIN_EDGE_SHARE / 2:
        return pictures
    background = common[0].item(), common[1].item(), common[2].item()
    return [
        replace(
            picture,
            camera=replace(picture.camera, background=background),
            solid=np.abs(picture.colors - common).max(-1) > SAME_COLOR,
        )
        for picture in pictures
    ]


def _edge(picture: PosedPicture) -> np.ndarray:
    """[P, 3] colours along a picture's edge that are looked at."""
    seen = np.ones(picture.colors.shape[:2], bool) if picture.mask is None else picture.mask
    sides = (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1])
    return np.concatenate([picture.colors[side][seen[side]] for side in sides])


def near_zero(pictures: list[PosedPicture]) -> tuple[list[PosedPicture], Offset]:
    """(the pictures with cameras near zero, the offset that these are relative to): where float32 cannot hold what
    cameras at such world coordinates see, as of georeferenced captures; else as they are, and zero."""
    cameras = [picture.camera.relative_to(NO_OFFSET) for picture in pictures]
    eyes = np.array([camera.position for camera in cameras])
    center, reach = _common_center(cameras)
    offset = NO_OFFSET
    if float(np.median(float32_step(eyes))) > MAX_STEP_OF_REACH * reach:
        x, y, z = np.rint(center).tolist()
        offset = x, y, z
    near = [replace(camera.relative_to(offset), offset=NO_OFFSET) for camera in cameras]
    return [replace(picture, camera=camera) for picture, camera in zip(pictures, near, strict=True)], offset


def _checked(view: CapturedView) -> Path:
    """The photograph of a view. Raises ValueError: it is not there, or of another shape than its camera."""
    path = view.picture()
    if path is None:
        searched = ", ".join(str(folder) for folder in view.folders[:3])
        raise ValueError(
            f"{view.name or 'a camera'}: no such picture in {searched}; expected those that cameras are of"
        )
    width, height = picture_header(path)[0]
    expected = view.camera.width, view.camera.height
    if not has_aspect((height, width), expected):  # EXIF may still turn it
        _check_shape(path, (width, height), expected)
    if view.mask and view.mask_picture() is None:
        raise ValueError(f"{path}: its mask {view.mask} is not there; expected it, or frames without mask_path")
    return path


def _turned_shapes(paths: list[Path], views: list[CapturedView]) -> tuple[bool, int]:
    """(whether a capture's cameras are of pixels as EXIF turns them, how many photographs nothing tells it of): some
    have the camera's shape only so, and none only as it is stored. Then squares and half turns are seen so, too."""
    turned, stored, unsure = 0, 0, 0
    for path, view in zip(paths, views, strict=True):
        (width, height), orientation = picture_header(path)
        expected = view.camera.width, view.camera.height
        as_stored, lies_over = has_aspect((width, height), expected), orientation >= 5
        as_turned = has_aspect((height, width) if lies_over else (width, height), expected)
        turned += as_turned and not as_stored
        stored += as_stored and not as_turned
        unsure += orientation > 1 and as_stored and as_turned
    return turned > 0 and stored == 0, unsure if turned == stored == 0 else 0


def unsure_turns(folder: Path) -> list[str]:
    """A line about photographs that EXIF turns and whose shape does not say whether their cameras are of them so."""
    if not is_capture(folder):
        return []
    views = captured_views(folder)
    unsure = _turned_shapes([_checked(view) for view in views], views)[1]
    text = (
        f"EXIF turns {unsure:,} of the {len(views):,} photographs; they are taken as stored, as COLMAP and nerfstudio "
        "count pixels; where another program made the cameras, save them turned and without that entry"
    )
    return [text] if unsure else []


def notes_on(folder: Path) -> list[str]:
    """Lines on what a capture says of its photographs besides their cameras, and what is done with it."""
    if not is_capture(folder):
        return []
    views, exposures = captured_views(folder), exposures_of(folder)
    masked, exposed = sum(bool(view.mask) for view in views), sum(view.name in exposures for view in views)
    notes = [f"{masked:,} of the {len(views):,} photographs have a mask: what it has black is not looked at"]
    undone = f"{EXPOSURES} tells the exposure of {exposed:,} of the {len(views):,} photographs, which is taken out"
    return [*(notes if masked else []), *([undone] if exposed else [])]


def _photograph(
    path: Path, view: CapturedView, size: int | None, k: int, turned: bool, exposure: np.ndarray | None
) -> PosedPicture:
    """Photograph k of a capture, as large as it is there, without its lens's distortion. turned: whether its camera is
    of it as EXIF turns it, where its shape fits so. exposure: [3, 4] of inria.read_exposures, which is taken out."""
    expected = view.camera.width, view.camera.height
    picture = read_photograph(path, expected, turned)
    _check_shape(path, picture.size, expected)
    view = view.resized(*picture.size)
    if size is not None:
        view = replace(view, camera=view.camera.with_longest_side(size))
    straight = straight_picture(picture, view, all_of_it=False)
    alpha, colors = straight.alpha if picture.alpha is not None else None, straight.colors
    if exposure is not None:
        colors = np.clip(matmul(colors - exposure[:, 3], inverse(exposure[:, :3])), 0, 1).astype(np.float32)
    posed = _posed(straight.camera, Picture(colors, alpha), k)
    masked = view.mask_picture() if view.mask else None
    if masked is None:
        return posed
    stored, orientation = picture_header(path)
    if not has_aspect(stored, expected):
        # The camera is of the turned photograph: a mask of the stored one is turned as it was, not back.
        orientation = INVERSE_TURNS[orientation]
    mask = photograph_mask(masked, (1, orientation), view, all_of_it=False)
    return replace(posed, mask=None if mask.all() else mask)


def _picture(path: Path, camera: Camera, size: int | None, k: int) -> PosedPicture:
    """Picture k, of its own camera."""
    if size is not None:
        camera = camera.with_longest_side(size)
    picture = read_picture(path)
    _check_shape(path, picture.size, (camera.width, camera.height))
    return _posed(camera, picture.resized(camera.width, camera.height), k)


def _check_shape(path: Path, size: tuple[int, int], expected: tuple[int, int]) -> None:
    if not has_aspect(size, expected):
        (width, height), (w, h) = size, expected
        raise ValueError(f"{path}: expected the aspect ratio of its camera, {w}x{h}, got {width}x{height}")


def _posed(camera: Camera, picture: Picture, k: int) -> PosedPicture:
    """Transparent pixels show one of BACKGROUNDS; in pictures without any, those of exactly the camera's background
    count as empty."""
    if picture.alpha is not None:
        camera = replace(camera, background=BACKGROUNDS[k % len(BACKGROUNDS)])
        alpha, background = picture.alpha[..., None], np.array(camera.background, np.float32)
        return PosedPicture(camera, picture.colors * alpha + background * (1 - alpha), picture.alpha > 0.02)
    background = np.array(camera.background, np.float32)
    return PosedPicture(camera, picture.colors, np.abs(picture.colors - background).max(-1) > SAME_COLOR)


def first_gaussians(
    folder: Path, pictures: list[PosedPicture], rows: int, sh_degree: int, seed: int, offset: Offset = NO_OFFSET
) -> tuple[Splats, str]:
    """(at most `rows` Gaussians to start with, a line that says where they come from): the points of COLMAP's
    reconstruction where the folder's cameras are its, or of the point cloud that lies with the folder's list of cameras
    (point_cloud_of), as 3DGS starts, else random points that no picture shows empty. offset: what the pictures'
    cameras, and what comes out, are relative to.
    Raises ValueError: no such point, or a point cloud that cannot be read."""
    from splatpainter.fit.start import from_points
    from splatpainter.io.formats.ply import read_ply_points

    model = _model_of(folder)
    cloud = point_cloud_of(folder) if model is None else None
    points, colors, name = np.zeros((0, 3)), np.zeros((0, 3)), ""
    if model is not None:
        (points, colors), name = read_points(model), f"{model.absolute().parent.name}/{model.name}"
    elif cloud is not None:
        (points, colors), name = read_ply_points(cloud), cloud.name
    if len(points) >= MIN_POINTS:
        chosen = np.random.default_rng(seed).permutation(len(points))[:rows]
        line = f"the first Gaussians are {len(chosen):,} of the {len(points):,} points of {name}"
        return from_points(points[chosen] - np.array(offset), colors[chosen], sh_degree), line
    line = "no depth maps: the first Gaussians are random points where no picture shows empty space"
    return _carved(pictures, rows, sh_degree, seed), line


def unused_models(folder: Path) -> list[str]:
    """A line that names COLMAP's other models of a folder, whose photographs are not fitted to; none where there is no
    other."""
    model = _model_of(folder)
    unused = [] if model is None else other_models(model)
    if model is None or not unused:
        return []
    counts = ", ".join(f"{one.parent.name}/{one.name} ({photographs_of(one):,} photographs)" for one in unused)
    used = f"{model.absolute().parent.name}/{model.name} ({photographs_of(model):,})"
    return [
        f"of COLMAP's models only {used} is fitted to; not used, as each has a world of its own: {counts}; to take one "
        "of them, name its folder"
    ]


def _model_of(folder: Path) -> Path | None:
    """COLMAP's model whose cameras a folder's pictures have; None where a table has them."""
    named = not folder.is_dir() and folder.name not in MODEL_FILES
    uses_table = named or any(inside(folder, name).is_file() for name in TABLES)
    return None if uses_table else model_folder(folder)


def point_cloud_of(source: Path) -> Path | None:
    """The point cloud in the world of a list of cameras (its file, or the folder of it): input.ply beside INRIA's
    cameras.json, what nerfstudio's transforms.json names as ply_file_path; None where there is none, or where a
    dataparser_transforms.json moves the cameras."""
    table = source
    if source.is_dir():
        table = next((one for name in (CAMERAS, *TABLES) if (one := inside(source, name)).is_file()), source)
    if not table.is_file():
        return None
    cloud = inside(table.parent, INPUT_POINTS) if table.name == CAMERAS else None
    if table.name in TABLES and splat_frame(table.parent) is None:
        named = load_document(files.read_all(table), table, "the list of cameras", MAX_TABLE_BYTES)
        path = named.get("ply_file_path") if isinstance(named, dict) else None
        cloud = table.parent / path.replace("\\", "/") if isinstance(path, str) and path else None
    return cloud if cloud is not None and cloud.is_file() else None


def _carved(pictures: list[PosedPicture], rows: int, sh_degree: int, seed: int) -> Splats:
    """Random points that lie before something in every picture that they fall into (a visual hull, where backgrounds
    are known), with their mean colour in the pictures."""
    from splatpainter.fit.start import from_points

    rng = np.random.default_rng(seed)
    center, reach = _common_center([picture.camera for picture in pictures])
    candidates: list[np.ndarray] = []
    for _ in range(TRIES_PER_GAUSSIAN):
        points = center + reach * rng.uniform(-1, 1, (rows, 3))
        count, good = np.zeros(len(points)), np.ones(len(points), bool)
        total = np.zeros((len(points), 3))
        for picture in pictures:
            camera = picture.camera
            pixels, z = camera.project(points)
            x, y = np.floor(np.where(z[:, None] > 1e-3, pixels, -1)).astype(np.int64).T
            seen = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            if picture.mask is not None:
                seen[seen] = picture.mask[y[seen], x[seen]]
            good[seen] &= picture.solid[y[seen], x[seen]]
            total[seen] += picture.colors[y[seen], x[seen]]
            count[seen] += 1
        good &= count >= min(2, len(pictures))
        candidates.append(np.concatenate([points[good], total[good] / count[good, None]], 1))
        if sum(map(len, candidates)) >= rows:
            break
    both = np.concatenate(candidates)[:rows]
    if len(both) < MIN_POINTS:
        raise ValueError("pictures: no point in space is covered in two of them and empty in none; check their cameras")
    return from_points(both[:, :3], both[:, 3:], sh_degree)


def _common_center(cameras: list[Camera]) -> tuple[np.ndarray, float]:
    """([3] the point nearest to all lines of sight, half the edge of a cube around it that the pictures show)."""
    lines = np.array([camera.forward for camera in cameras])
    eyes = np.array([camera.position for camera in cameras])
    across = np.eye(3) - lines[:, :, None] * lines[:, None, :]
    system = across.sum(0) + 1e-6 * np.eye(3)
    center = np.linalg.solve(system, np.einsum("vij,vj->i", across, eyes) + 1e-6 * eyes.mean(0))
    away = np.linalg.norm(eyes - center, axis=1)
    half = [max(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]
    return center, float(np.median(away * np.array(half)))
