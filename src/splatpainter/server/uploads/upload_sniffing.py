"""What uploaded bytes claim to be (kind, pixels, Gaussians), from headers alone: nothing is decoded to find out."""

from __future__ import annotations

import contextlib
import struct
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Literal

from splatpainter.grading.cube_lut import MAX_CUBE_BYTES
from splatpainter.image_files import CAMERA_KEYWORD, EXR_MAGIC, exr_text, light_size
from splatpainter.io import FORMATS, detect
from splatpainter.io.bounded import Gunzip, zip_directory
from splatpainter.io.files import read_head, reading
from splatpainter.io.formats import gltf, sog_container
from splatpainter.io.formats.ply_header import read_header
from splatpainter.lights.rig_files import MAX_RIG_BYTES, RIG_SUFFIXES
from splatpainter.pictures.foreign_pictures import READ_KINDS, advice_for, foreign_kind
from splatpainter.pictures.layered_files import holds_merged, is_psd, psd_size
from splatpainter.pictures.picture_reader import MAX_PICTURE_PIXELS, PICTURE_KINDS, SIZE_LIMIT, declared_size
from splatpainter.system.quick_dataclass import dataclass

Kind = Literal["picture", "asset", "project", "layer", "lut", "sky", "rig"]
CUBE_ENDING = ".cube"
SQLITE, ZIP = b"SQLite format 3\0", b"PK\x03\x04"
LIGHT_MAGIC = {".hdr": b"#?R", ".exr": EXR_MAGIC}
"""Of Radiance and OpenEXR: environments, and pictures of views."""
SKY_ASPECT = 2.0
"""Width over height of an environment."""
MEDIA = {"PNG": "image/png", "JPEG": "image/jpeg", "WEBP": "image/webp", "TIFF": "image/tiff"}
ENDINGS = {"PNG": ".png", "JPEG": ".jpg", "WEBP": ".webp", "TIFF": ".tif"}


@dataclass(frozen=True)
class UploadInfo:
    """What a file's header says of it."""

    kind: Kind
    ending: str
    """File name ending that fits the content."""
    media: str
    """Content type that it is served with; of pictures only, for nothing else may be opened by a browser."""
    width: int = 0
    height: int = 0
    gaussians: int = 0


def sniff(path: Path, name: str, max_gaussians: int) -> UploadInfo:
    """Judge the file at `path`; `name` is what its owner called it (splat formats without a magic need its ending).
    Raises ValueError: neither picture, splat file nor project, or more pixels or Gaussians than are allowed."""
    # From what is surest to what needs the name: some formats have nothing at their beginning to know them by.
    head = read_head(path, 16)
    if head == SQLITE:
        return UploadInfo("project", ".splatproj", "application/octet-stream")
    picture = _picture(path, name) or _layered(path, name)
    if picture is not None:
        return picture
    # Many formats are ZIP files; what is inside says which one.
    if head[:4] == ZIP and _is_layer(path):
        return UploadInfo("layer", ".splatlayer", "application/octet-stream")
    title = name or "the upload"
    # A table is text without a magic, so its name has to say it.
    if name.lower().endswith(CUBE_ENDING) and b"\0" not in head:
        if path.stat().st_size > MAX_CUBE_BYTES:
            raise ValueError(f"{title}: expected a .cube table of at most {MAX_CUBE_BYTES >> 20} MiB, got more")
        return UploadInfo("lut", CUBE_ENDING, "application/octet-stream")
    if light := _light(path, name, head):
        return light
    key = _detected(path, name)
    if key is None:
        foreign = foreign_kind(path, name)
        what = f", got {foreign}; {advice_for(foreign)}" if foreign else ""
        raise ValueError(f"{title}: expected a picture ({READ_KINDS}), a splat file or a project{what}")

    # The count is read from the header: a small file may claim more than any memory holds.
    try:
        count = _declared_count(path, key)
        if count < 0:
            raise ValueError(f"{path}: {count} Gaussians")
    except (ValueError, struct.error, OSError) as error:
        reason = " ".join(str(error).replace(str(path), title).split())
        raise ValueError(f"{title}: damaged ({reason.removeprefix(f'{title}: ')[:200]})") from None
    if count > max_gaussians:
        raise ValueError(f"{title}: expected at most {max_gaussians:,} Gaussians, it claims {count:,}")
    return UploadInfo("asset", FORMATS[key].suffixes[0], "application/octet-stream", gaussians=count)


def _light(path: Path, name: str, head: bytes) -> UploadInfo | None:
    """A picture of linear light, which may be an environment, or a rig of lights."""
    for ending, magic in LIGHT_MAGIC.items():
        if head.startswith(magic):
            return _picture_of_light(path, ending)
    # Rigs are small; a GLB is one if it says so, and else an asset.
    suffix = Path(name.lower()).suffix
    if suffix not in RIG_SUFFIXES or path.stat().st_size > MAX_RIG_BYTES:
        return None
    if suffix in (".glb", ".gltf") and b"KHR_lights_punctual" not in read_head(path, MAX_RIG_BYTES):
        return None
    return UploadInfo("rig", suffix, "application/octet-stream")


def _picture_of_light(path: Path, ending: str) -> UploadInfo:
    """A sky where it is twice as wide as high and carries no view's camera; what cannot be told is one, too."""
    info, carries_camera = UploadInfo("sky", ending, "application/octet-stream"), False
    with contextlib.suppress(ValueError):  # without OpenImageIO, or damaged: reading it says so
        width, height = light_size(path, MAX_PICTURE_PIXELS)
        info = replace(info, width=width, height=height)
        carries_camera = ending == ".exr" and exr_text(path, CAMERA_KEYWORD, MAX_PICTURE_PIXELS) is not None
    is_sky = info.width == SKY_ASPECT * info.height and not carries_camera
    return info if is_sky else replace(info, kind="picture")


def _is_layer(path: Path) -> bool:
    try:
        with reading(path) as file:
            return any(entry.filename == "layer.json" for entry in zip_directory(file, path))
    except ValueError:
        return False


def _detected(path: Path, name: str) -> str | None:
    """Key of the format by content, or by the ending for the two formats that have no magic."""
    try:
        return detect(path)
    except Exception:  # of a damaged file
        return {".splat": "splat", ".ksplat": "ksplat"}.get(Path(name.lower()).suffix)


def _picture(path: Path, name: str) -> UploadInfo | None:
    from PIL import Image, UnidentifiedImageError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's own size warning: judged here
        # Opened with the kinds that are meant alone: Pillow knows many more, each with a decoder.
        try:
            with Image.open(path, formats=PICTURE_KINDS) as image:
                width, height, kind = image.width, image.height, str(image.format)
        except UnidentifiedImageError:
            return None
        except Image.DecompressionBombError:
            raise ValueError(f"{name or 'picture'}: expected {SIZE_LIMIT}") from None
        except Exception as error:  # decoders of damaged files raise anything
            raise ValueError(f"{name or 'picture'}: cannot be read as a picture ({str(error)[:120]})") from None
    # By the header's size, before a pixel is decoded.
    if width * height > MAX_PICTURE_PIXELS:
        raise ValueError(f"{name or 'picture'}: expected {SIZE_LIMIT}, got {width}x{height}")
    return UploadInfo("picture", ENDINGS[kind], MEDIA[kind], width, height)


def _layered(path: Path, name: str) -> UploadInfo | None:
    """A PSD, OpenRaster or Krita file, which browsers do not show."""
    psd = is_psd(path)
    if not psd and not holds_merged(path):
        return None
    # Such files go to the reader and never to a browser, which is why they have no picture's content type.
    try:
        width, height = (psd_size(path) if psd else declared_size(path)) or (0, 0)
    except ValueError as error:
        raise ValueError(str(error).replace(str(path), name or "picture")) from None
    return UploadInfo("picture", ".psd" if psd else ".ora", "application/octet-stream", width, height)


def _declared_count(path: Path, key: str) -> int:
    """Gaussians that the header declares."""
    size = path.stat().st_size
    # Each format says its number in another place; none has to be unpacked for it.
    if key in ("ply", "compressed.ply"):
        with reading(path) as file:
            vertex = read_header(file, path).element("vertex")
        return 0 if vertex is None else vertex.count
    if key == "splat":
        return size // 32
    if key == "ksplat":
        return struct.unpack_from("<I", read_head(path, 20), 16)[0]
    if key == "spz":
        head = read_head(path, 4096)
        if head[:2] == b"\x1f\x8b":
            head = Gunzip(head, path).take(16, "the header")
        return struct.unpack_from("<I", head, 8)[0]
    if key == "sog":
        return sog_container.declared_rows(path)

    return gltf.declared_rows(path)
