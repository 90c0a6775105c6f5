"""What the nodes do, on ComfyUI's values: functions from a node's inputs, by name, to its outputs, in order."""

from __future__ import annotations

import contextlib
import importlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatpainter.cameras import AUTO_UP, FRAME_MARGIN, UPS, Camera, bounding_sphere, spherical_cameras
from splatpainter.color import from_display
from splatpainter.gatekeeper.gatekeeper import admit
from splatpainter.io import read, write
from splatpainter.lift.options import LOCAL_DEFAULTS
from splatpainter.operations.to_file import write_proved
from splatpainter.output_paths import receipt_of
from splatpainter.painter import Asset, Edit, Mode, Painter
from splatpainter.sources.picture_source import PictureRequest
from splatpainter.splats import Splats
from splatpainter.system.atomic import write_text

from .lineage import Lineage, asset_of, with_lineage
from .values import camera_info_of, camera_of, image_of, mask_of, picture_of, splat_class

FOV = 40.0
"""Degrees, of the views that are proposed."""
CANDIDATE_VIEWS, CANDIDATE_PX = 40, 96
"""Views among which the next one is chosen, and their pixels."""
MAX_VIEWS = 64
"""Of a list of views."""


def render_view(splat: Any, camera_info: dict, width: int, height: int, background: str = "#000000") -> tuple:
    """(IMAGE, MASK): what a view shows, exactly as edits are compared with it, and the alpha of the splat."""
    splats, camera = asset_of(splat)[0].splats, camera_of(camera_info, width, height)
    image, alpha = displayed(splats, replace(camera, background=_color(background)))
    return image_of(image), image_of(alpha)


def lift_picture(
    splat: Any,
    camera_info: dict,
    image: torch.Tensor,
    angle_limit: float = LOCAL_DEFAULTS.angle_limit,
    gatekeeper: str = "normal",
    mask: torch.Tensor | None = None,
    before: torch.Tensor | None = None,
) -> tuple:
    """(SPLAT, STRING): the splat with the edited picture on it, and the receipt as JSON."""
    picture = picture_of(image)
    camera = camera_of(camera_info, picture.shape[1], picture.shape[0])
    edit = _edit(asset_of(splat)[0].splats, camera, picture, gatekeeper, mask, before)
    options = replace(LOCAL_DEFAULTS, angle_limit=angle_limit)
    painter = Painter.load(modes=["local"]).with_settings(local_options=options, aside=True)
    return _painted(painter, splat, [edit], "local")


def global_look(splat: Any, image: torch.Tensor, camera_info: dict, **more: Any) -> tuple:
    """(SPLAT, STRING): the splat as regraded or relit pictures of it show it, unseen sides too, and the receipt."""
    splats, edits = asset_of(splat)[0].splats, []
    pairs = [(image, camera_info, more.get("before"), "image")]
    for k in (2, 3, 4):
        picture, info = more.get(f"image_{k}"), more.get(f"camera_info_{k}")
        if (picture is None) != (info is None):
            raise ValueError(f"global look: expected image_{k} and camera_info_{k} together")
        if picture is not None and info is not None:
            pairs.append((picture, info, more.get(f"before_{k}"), f"image_{k}"))
    for tensor, info, before, name in pairs:
        picture = picture_of(tensor, name)
        camera = camera_of(info, picture.shape[1], picture.shape[0])
        if before is not None:  # of another renderer: what was changed is carried over
            displayed_image, _ = displayed(splats, camera)
            picture = np.clip(displayed_image + picture - _of_size(before, picture, "before"), 0, 1)
        edits.append(Edit(from_display(picture, splats.color_space), camera, name=name))
    return _painted(Painter.load(modes=["global"]), splat, edits, "global")


def next_view(splat: Any, size: int = 1024, background: str = "#000000", views: list | None = None) -> tuple:
    """(camera_info, IMAGE, MASK, views, FLOAT): the view that shows most of what earlier ones have not, its picture,
    the mask of what is left to paint in it, all views with this one, and the share of its surface that is left."""
    from splatpainter.source_edits.coverage import SurfaceView, unreached
    from splatpainter.view_files import normals_of

    splats = asset_of(splat)[0].splats
    center, radius = bounding_sphere(splats)
    distance = FRAME_MARGIN * radius / np.sin(np.radians(FOV / 2))
    normals = normals_of(splats)
    earlier = _surface_views(splats, normals, views)
    best, most = None, -1.0
    for camera in spherical_cameras(center, distance, CANDIDATE_VIEWS, size=CANDIDATE_PX, fov=FOV, up=UPS[AUTO_UP]):
        view = SurfaceView.of(splats, camera, normals)
        gain = float((unreached(view, earlier) * view.reached).sum())
        if gain > most:
            best, most = camera, gain
    assert best is not None
    info = camera_info_of(best.resized(size, size), float(distance))
    camera = replace(camera_of(info, size, size), background=_color(background))
    image, _ = displayed(splats, camera)
    view = SurfaceView.of(splats, camera, normals)
    left = unreached(view, earlier)
    share = float((left > 0.5).sum() / max((view.depth > 0).sum(), 1))
    return info, image_of(image), image_of(left), [*(views or []), _view(info, size, size)], share


def coverage(splat: Any, views: list, camera_info: dict, width: int, height: int) -> tuple:
    """(MASK, MASK, FLOAT): in a view, what the others have painted and what is left, and the painted share of it."""
    from splatpainter.source_edits.coverage import SurfaceView, unreached
    from splatpainter.view_files import normals_of

    splats = asset_of(splat)[0].splats
    normals = normals_of(splats)
    view = SurfaceView.of(splats, camera_of(camera_info, width, height), normals)
    earlier = _surface_views(splats, normals, views)
    paintable = view.reached
    left = unreached(view, earlier)
    painted = np.clip(paintable - left, 0, 1)
    share = float(painted.sum() / max(paintable.sum(), 1e-6))
    return image_of(painted), image_of(left), share


def add_view(camera_info: dict, width: int, height: int, views: list | None = None) -> tuple:
    """(views,): a list of views with one more."""
    return ([*_views(views), _view(camera_info, width, height)],)


def load_splat(file: str) -> tuple:
    """(SPLAT,): a splat file of ComfyUI's input folder, in any format that SplatPainter reads."""
    splats = read(input_file(file))
    return (with_lineage(splats, Lineage(splats, Asset(splats)), splat_class()),)


def splat_file_state(file: str) -> str:
    """Changes when the file does, so that ComfyUI reads it again and does not give the splat of an earlier run."""
    with contextlib.suppress(OSError, ValueError):
        entry = input_file(file).stat()
        return f"{entry.st_mtime_ns} {entry.st_size}"
    return ""


def save_splat(splat: Any, file: str, receipt: str = "") -> tuple:
    """(STRING,): writes the splat, in the format that the name says, and the receipt beside it; gives its path.

    A splat that these nodes loaded and edited is proved against its file before it is there, and its receipt is of all
    edits together; of others the text `receipt` is written as it is."""
    path = _inside(_folder("output"), file)
    asset, lineage = asset_of(splat)
    beside = receipt_of(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if lineage is not None and lineage.receipts:
        write_proved(lineage.file, replace(asset, receipt=lineage.receipt), path, beside)
    else:
        write(path, asset.splats, overwrite=True)
        if receipt.strip():
            write_text(beside, receipt)
        else:
            beside.unlink(missing_ok=True)  # of a file that is gone
    return (str(path),)


def saved_files(result: tuple) -> dict[str, list[dict[str, str]]]:
    """What `save_splat` wrote, as the history of a run lists files (GET /view gives them)."""
    path = Path(result[0]).relative_to(_folder("output").resolve())
    subfolder = path.parent.as_posix().removeprefix(".")
    return {"3d": [{"filename": path.name, "subfolder": subfolder, "type": "output"}]}


def displayed(splats: Splats, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, 3] display colours 0..1, [H, W] alpha) of a view."""
    from splatpainter.rendering import render

    drawn = render(splats, camera)
    return np.clip(drawn.colors[0], 0, 1).astype(np.float32), drawn.alphas[0, ..., 0].astype(np.float32)


def _edit(
    splats: Splats,
    camera: Camera,
    picture: np.ndarray,
    gatekeeper: str,
    mask: torch.Tensor | None,
    before: torch.Tensor | None,
) -> Edit:
    """The picture as an edit: registered, corrected and cut to what changed, unless the gatekeeper is off; changes
    against `before` (a picture of another renderer) are carried over to the renderer of edits."""
    displayed_image, alpha = displayed(splats, camera)
    base = displayed_image if before is None else _of_size(before, picture, "before")
    soft = None if mask is None else mask_of(mask, camera.width, camera.height)
    if gatekeeper == "off":
        changed = None if soft is None else soft > 0.5
        if before is not None:
            from splatpainter.lift.masks import change_mask

            where = change_mask(picture, base)
            changed = where if changed is None else where & changed
        weight = np.ones(alpha.shape, np.float32) if changed is None else changed.astype(np.float32)
        edited = picture
    else:
        request = PictureRequest(base, alpha, soft)
        admitted = admit(picture, request, strictness=gatekeeper, name="lift")  # type: ignore[arg-type]
        changed, weight, edited = admitted.changed, admitted.weight, admitted.image
        if before is not None:  # `image` is the mix already, over another render
            edited = admitted.aligned
            weight = admitted.weight
        else:
            weight = np.ones_like(weight)
    mixed = displayed_image + weight[..., None] * (edited - displayed_image)
    return Edit(from_display(np.clip(mixed, 0, 1), splats.color_space), camera, changed, "image")


def _painted(painter: Painter, splat: Any, edits: list[Edit], mode: Mode) -> tuple:
    asset, lineage = asset_of(splat)
    if lineage is None or not lineage.receipts:
        asset = painter.encode(asset.splats, modes=[mode])
    result = painter.apply(asset, edits, mode)
    assert result.receipt is not None
    line = None if lineage is None else lineage.edited(result)
    return with_lineage(result.splats, line, type(splat), splat.positions.device), result.receipt.to_json()


def _of_size(image: torch.Tensor, like: np.ndarray, what: str) -> np.ndarray:
    from splatpainter.pictures.picture_reader import resample

    picture = picture_of(image, what)
    return picture if picture.shape == like.shape else resample(picture, like.shape[1], like.shape[0])


def _surface_views(splats: Splats, normals: np.ndarray, views: list | None) -> list[tuple[Any, np.ndarray]]:
    from splatpainter.source_edits.coverage import SurfaceView

    earlier = []
    for entry in _views(views):
        camera = camera_of(entry["camera_info"], int(entry["width"]), int(entry["height"]))
        scale = 2 * CANDIDATE_PX / max(camera.width, camera.height)
        if scale < 1:
            camera = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        view = SurfaceView.of(splats, camera, normals)
        earlier.append((view, view.reached))
    return earlier


def _views(views: list | None) -> list:
    if views is not None and len(views) > MAX_VIEWS:
        raise ValueError(f"views: expected at most {MAX_VIEWS}, got {len(views)}")
    return list(views or [])


def _view(camera_info: dict, width: int, height: int) -> dict:
    return {"camera_info": json.loads(json.dumps(camera_info)), "width": int(width), "height": int(height)}


def _folder(kind: str) -> Path:
    """ComfyUI's folder for input or output."""
    return Path(getattr(importlib.import_module("folder_paths"), f"get_{kind}_directory")())


def input_file(name: str) -> Path:
    """Raises ValueError: outside of the input folder, not there."""
    folder = _folder("input")
    path = _inside(folder, name)
    if not path.is_file():
        raise ValueError(f"file: no {name.strip()!r:.80} in {folder}; put the splat there, or in a folder below it")
    return path


def _inside(folder: Path, name: str) -> Path:
    """A path below a folder. Raises ValueError for one that leaves it."""
    path = (folder / name).resolve()
    if not name.strip() or not path.is_relative_to(folder.resolve()):
        raise ValueError(f"file: expected a name inside {folder}, got {name!r:.80}")
    return path


def _color(text: str) -> tuple[float, float, float]:
    digits = text.removeprefix("#")
    if len(digits) != 6 or any(c not in "0123456789abcdefABCDEF" for c in digits):
        raise ValueError(f"background: expected a colour like #404040, got {text!r:.40}")
    red, green, blue = (int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4))
    return red, green, blue
