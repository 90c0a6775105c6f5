"""Which capture a path means, and which of its views: FILE or FOLDER, with :N behind it an index or a picture's name.

views = named_views(Path("garden/cameras.json:DSC07956.JPG"))
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from splatpainter.captures import colmap, inria, nerfstudio
from splatpainter.captures.captured_view import CapturedView
from splatpainter.captures.nerfstudio import MAX_TABLE_BYTES, TABLES, splat_frame
from splatpainter.image_files import find_camera
from splatpainter.io import files
from splatpainter.io.folders import POINT_CLOUD, inside
from splatpainter.io.foreign_captures import foreign_capture
from splatpainter.system.jsonio import load_document

MAX_NAMES_LISTED = 3
"""Pictures of a capture that an error names."""
_BLANKS = b"\xef\xbb\xbf \t\r\n"
FRAME_LEVELS = 3
"""Folders above an asset in which its dataparser_transforms.json is looked for: exports/splat/splat.ply."""


def split_selector(path: Path) -> tuple[Path, str]:
    """(file or folder, what stands behind its last colon) of FILE:N; "" where the whole is a path, or none is."""
    if os.path.exists(path):  # Path.exists raises where a folder above may not be searched
        return path, ""
    text = str(path)
    # From the end: a folder's own name may hold colons.
    for at in range(len(text) - 1, 1 if os.name == "nt" else 0, -1):  # a drive's letter and its colon are no file
        if text[at] == ":" and os.path.exists(text[:at]):
            return Path(text[:at]), text[at + 1 :]
    return path, ""


def is_capture(path: Path) -> bool:
    """Whether a path (without selector) holds cameras of a capture: a folder of one, COLMAP's files, or JSON of
    theirs. False for a camera of splatpainter's and for anything else."""
    try:
        return _capture_file(path) is not None
    except ValueError:
        return False


def capture_of(asset: Path) -> Path | None:
    """The capture that lies with an asset: its folder's, or that of the trainer's folder in which the file is."""
    if os.path.isdir(asset):
        return asset if is_capture(asset) else None
    # INRIA's trainer puts its assets two folders below the run.
    folder = asset.absolute().parents[2] if len(asset.absolute().parents) > 2 else asset.parent
    return folder if os.path.isdir(inside(folder, POINT_CLOUD)) and is_capture(folder) else None


def captured_views(path: Path, asset: Path | None = None) -> list[CapturedView]:
    """All views of a capture, in its order. asset: the file or folder that they are for: the dataparser_transforms.json
    beside or above it says where it lies in the capture's world, else one beside the capture. Raises ValueError, one
    line naming file, entry and key: no capture, damaged, none in it."""
    capture = _capture_file(path)
    if capture is None:
        foreign = foreign_capture(path)
        what = f"is {foreign}; " if foreign else ""
        raise ValueError(
            f"{path}: {what}expected a capture: cameras.json, transforms.json, camera_path.json, or COLMAP's sparse/0"
        )
    # A folder is COLMAP's; a file says by its keys whose it is.
    if os.path.isdir(capture):
        frame = splat_frame(*_frame_folders(asset))
        views = [view if frame is None else frame.moved(view) for view in colmap.read_model(capture)]
    else:
        record = load_document(files.read_all(capture), capture, "the list of cameras", MAX_TABLE_BYTES)
        if isinstance(record, list):
            views = inria.read_cameras(capture, record)
        elif "camera_path" in record:
            views = nerfstudio.read_path(capture, record)
        else:
            views = nerfstudio.read_table(capture, record, splat_frame(*_frame_folders(asset), capture.parent))
    if not views:
        raise ValueError(f"{capture}: expected cameras, it lists none")
    return views


def exposures_of(path: Path) -> dict[str, np.ndarray]:
    """inria.read_exposures beside the cameras.json that a capture's cameras are from; {} of other captures."""
    capture = _capture_file(path)
    if capture is None or os.path.isdir(capture) or files.read_head(capture, 64).lstrip(_BLANKS)[:1] != b"[":
        return {}
    return inria.read_exposures(capture.parent / inria.EXPOSURES)


def named_views(path: Path, asset: Path | None = None, picture: Path | None = None) -> list[CapturedView]:
    """The views of a capture that FILE:N names: one, or all where no :N stands behind it. picture: a photograph, whose
    name chooses where no N does; all again where none has it. asset, Raises: as `captured_views`, and for an N that is
    no index and no name."""
    capture, selector = split_selector(path)
    if selector and _is_one_camera(capture):
        raise ValueError(f"{path}: {capture.name} holds one camera, not a list of them; leave :{selector[:40]} out")
    views = captured_views(capture, asset)
    if selector:
        return [views[_chosen(views, selector, capture)]]
    if picture is not None:
        # A picture that is called as one photograph of the capture is that photograph.
        named = [view for view in views if view.is_called(picture.name)]
        exact = [view for view in named if Path(view.name.replace("\\", "/")).name == picture.name]
        # Else the one that it was saved as another file of: the longest name, as IMG_1 may be there beside IMG_1_2.
        begun = [] if named else [view for view in views if view.is_called_on(picture.name)]
        lengths = [len(view.name.replace("\\", "/").rpartition("/")[2]) for view in begun]
        begun = [view for view, length in zip(begun, lengths, strict=True) if length == max(lengths)]
        likeliest = _in_its_folder(exact or named or begun, picture)
        if len(likeliest) == 1:
            return likeliest
    return views


def _in_its_folder(views: list[CapturedView], picture: Path) -> list[CapturedView]:
    """Those of several views whose photograph lies in a folder of the same name as the picture: cameras of a rig number
    their photographs alike, cam0/0001.jpg and cam1/0001.jpg."""
    folders = [part.casefold() for part in picture.absolute().parts[-2::-1]]
    inner = [view.name.replace("\\", "/").casefold().split("/")[-2::-1] for view in views]
    depths = [len(os.path.commonprefix([names, folders])) for names in inner]
    return [view for view, depth in zip(views, depths, strict=True) if depth == max(depths)]


def _is_one_camera(path: Path) -> bool:
    """Whether a file is a camera of splatpainter's, or a picture that carries one."""
    try:
        if not os.path.isfile(path) or is_capture(path):
            return False
        is_text = path.suffix.lower() == ".json"
        find_camera(path, path if is_text else None)
        return True
    except ValueError:
        return False


def _chosen(views: list[CapturedView], selector: str, capture: Path) -> int:
    if selector.isascii() and selector.isdigit() and (selector == "0" or selector[0] != "0"):  # 0012 is a name
        if int(selector) < len(views):
            return int(selector)
        raise ValueError(f"{capture}: expected a view from 0 to {len(views) - 1}, got {selector[:40]}")
    # Exact names first: with 1.jpg and 01.jpg both in a capture neither may stand for the other.
    name = selector.replace("\\", "/")
    exact = [k for k, view in enumerate(views) if view.name.replace("\\", "/") == name]
    named = exact or [k for k, view in enumerate(views) if view.is_called(name)]
    if len(named) == 1:
        return named[0]
    raise ValueError(
        f"{capture}: {'several' if named else 'no'} views of a picture called {files.printable(selector, 60)!r}; "
        f"expected a number from 0 to {len(views) - 1}{_names(views)}{_other_models(capture)}"
    )


def _other_models(capture: Path) -> str:
    """That COLMAP made several models of the photographs, of which the one that was looked at is the first."""
    model = colmap.model_folder(capture) if os.path.isdir(capture) else None
    models = [] if model is None else [f"{one.parent.name}/{one.name}" for one in colmap.other_models(model)]
    return f"; COLMAP's {', '.join(models)} may have it: name that folder" if models else ""


def _names(views: list[CapturedView]) -> str:
    names = [files.printable(view.name, 60) for view in views[:MAX_NAMES_LISTED] if view.name]
    more = ", ..." if len(views) > len(names) else ""
    return f" or a name ({', '.join(names)}{more})" if names else ""


def choose_one(views: list[CapturedView], path: Path) -> CapturedView:
    """The view, where there is one. Raises ValueError: there are several, with how to choose."""
    if len(views) != 1:
        raise ValueError(
            f"{path}: has {len(views)} cameras; choose one: {path.name}:N, N from 0 to {len(views) - 1}{_names(views)}"
        )
    return views[0]


def _capture_file(path: Path) -> Path | None:
    """A capture's JSON file, or the folder of a COLMAP model; None where there is neither."""
    if os.path.isdir(path):
        for name in (inria.CAMERAS, *TABLES):
            if os.path.isfile(inside(path, name)):
                return inside(path, name)
        return colmap.model_folder(path)
    if not os.path.isfile(path):
        return None
    if path.name in colmap.MODEL_FILES:
        return colmap.model_folder(path)
    # The first bytes tell JSON from anything else before a large file is read whole.
    first = files.read_head(path, 64).lstrip(_BLANKS)[:1]
    # A list is one of cameras: nothing of splatpainter's begins so, and reading it says what is wrong with it.
    if first == b"[":
        return path
    if first != b"{":
        return None
    # By its name a table is one, also where NaN or a cut end makes it no JSON: reading it says so.
    if path.name in TABLES:
        return path
    record = load_document(files.read_all(path), path, "the list of cameras", MAX_TABLE_BYTES)
    return path if "frames" in record or "camera_path" in record else None


def _frame_folders(asset: Path | None) -> list[Path]:
    if asset is None:
        return []
    here = asset.absolute()
    return [*([here] if os.path.isdir(here) else []), *here.parents[:FRAME_LEVELS]]
