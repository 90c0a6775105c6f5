"""Picture files with text inside, first of all their camera: PNG of 8 and 16 bits, OpenEXR; and samples that Pillow
would cut to 8 bits.

8-bit PNG and 16-bit grey are Pillow's; 16-bit colour, 16-bit TIFF and OpenEXR are OpenImageIO's (extra `pictures`: one
library of 8 to 10 MB for all of them). Knows no splats.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import logging
import struct
import tempfile
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.system.atomic import writing
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from PIL.Image import Image

# Pillow logs what is wrong with a picture; without a handler that goes to stderr, beside the one line that is ours.
logging.getLogger("PIL").addHandler(logging.NullHandler())

EXTRA = "pictures"
"""The extra of the package that brings OpenImageIO."""
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
TEXT_CHUNKS = (b"tEXt", b"zTXt", b"iTXt")
EXR_MAGIC = b"\x76\x2f\x31\x01"
RADIANCE_MAGIC = b"#?RADIANCE"
READS = ("png", "tiff", "openexr", "hdr")
"""What OpenImageIO is given to read, of all that it could."""
TIFF_BITS = 258
"""Tag: bits of each channel."""
PICTURE_LAYERS = ("combined", "composite", "beauty", "rgba", "rgb")
"""Last words of the names of layers that are the picture, of several: those of Blender and of renderers."""
EXIF_ORIENTATION = 274
"""Tag: how a picture is turned and mirrored."""
HALF_MAX = 65504.0
"""Largest 16-bit float."""
MAX_CHANNELS = 1024
"""Channels that a header may claim; four of them are read."""
SEVERAL_PAGES = "expected one picture, got a TIFF of several pages or layers; flatten it, or save a PNG"
CAMERA_KEYWORD = "splatpainter"
"""Keyword of the PNG tEXt chunk, or name of the OpenEXR header attribute, that carries a camera."""
_CAMERA_KEY = CAMERA_KEYWORD.encode() + b"\0"
MAX_CAMERA_CHUNK = 1 << 16
"""Bytes of a camera's chunk that are compared with those of another."""
SRGB_INTENT = b"\0"
"""Contents of a PNG's sRGB chunk: colours are sRGB, to be shown perceptually."""
MAX_PICTURE_PIXELS = 1 << 26
"""Most pixels of a picture that is opened: a few hundred bytes can claim any number. 8192 x 8192."""
Alpha = Literal["straight", "premultiplied"]
"""How a picture that was rendered without a background keeps its colours: as they are, or multiplied by alpha."""
PACKED_WIDTH = 4096
"""Pixels of a row of `bytes_to_png`."""
ALPHA_KEY = "alpha"
"""Key beside the camera's own that says it."""


def quantized(image: np.ndarray, bits: int = 8) -> np.ndarray:
    """Floats 0..1 -> uint8 or uint16 levels, rounded to nearest; NaN becomes 0. Bools become the two ends."""
    top = (1 << bits) - 1
    values = image if image.dtype.kind == "f" else image.astype(np.float32)
    # Of NaN and a number the number; then in place: each array on the way would be new memory.
    levels = np.fmin(np.fmax(values, 0), 1)
    levels *= top
    levels += 0.5
    return levels.astype(np.uint8 if bits == 8 else np.uint16)


def can_do_deep() -> bool:
    """Whether OpenImageIO is installed; it is not imported to find out."""
    return importlib.util.find_spec("OpenImageIO") is not None


def require_deep(what: str) -> Any:
    """The OpenImageIO module. Raises ValueError: `what` needs it and it is not installed."""
    try:
        import OpenImageIO
    except ImportError:
        raise ValueError(f"{what} needs OpenImageIO; pip install 'splatpainter[{EXTRA}]'") from None
    return OpenImageIO


def encode_png(pixels: np.ndarray, text: Mapping[str, str] | None = None, level: int = 6, data: bool = False) -> bytes:
    """PNG of uint8 or uint16 levels [H, W] or [H, W, 2, 3 or 4] (grey, grey and alpha, RGB, RGBA; alpha straight).
    text: keyword -> ASCII, as tEXt chunks. level: of zlib, 1 is fast. data: the samples are no display colours, so the
    file does not say that they are sRGB. Raises ValueError: 16-bit colour without OpenImageIO."""
    # Pillow writes 16 bits of grey alone.
    if pixels.dtype == np.uint16 and pixels.ndim == 3:
        return _encode("png", pixels, text or {}, {"png:compressionLevel": level})
    from PIL import Image, PngImagePlugin

    chunks = PngImagePlugin.PngInfo()
    if not data:
        chunks.add(b"sRGB", SRGB_INTENT)
    for keyword, words in (text or {}).items():
        chunks.add_text(keyword, words)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG", pnginfo=chunks, compress_level=level)
    return file.getvalue()


def quick_png(pixels: np.ndarray) -> bytes:
    """PNG of uint8 levels [H, W] or [H, W, 2, 3 or 4] as `encode_png` has them, without a word about colours, in half
    of Pillow's time at its fastest and about as large: it tries every filter on every row."""
    height, width, channels = pixels.shape if pixels.ndim == 3 else (*pixels.shape, 1)
    row = np.ascontiguousarray(pixels).reshape(height, width * channels)
    # Each level less that of the pixel before it (filter 1, whose number begins the row).
    filtered = np.ones((height, 1 + width * channels), np.uint8)
    filtered[:, 1 : 1 + channels] = row[:, :channels]
    np.subtract(row[:, channels:], row[:, :-channels], out=filtered[:, 1 + channels :])
    head = struct.pack(">IIBBBBB", width, height, 8, (0, 4, 2, 6)[channels - 1], 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(filtered.data, 1)), (b"IEND", b""))
    parts = [PNG_MAGIC]
    for kind, data in chunks:
        parts += [struct.pack(">I", len(data)), kind, data, struct.pack(">I", zlib.crc32(data, zlib.crc32(kind)))]
    return b"".join(parts)


def bytes_to_png(data: bytes) -> bytes:
    """A grey PNG whose pixels are these bytes, row by row, and zeros after them."""
    # A picture is what project files and the page carry anyway; it is packed by zlib on the way.
    rows = -(-len(data) // PACKED_WIDTH)
    return encode_png(
        np.frombuffer(data.ljust(rows * PACKED_WIDTH, b"\0"), np.uint8).reshape(rows, PACKED_WIDTH), data=True
    )


def bytes_of_png(png: bytes, max_bytes: int) -> bytes:
    """The inverse; zeros may follow. Raises ValueError: no such picture, or of more than `max_bytes` and a row."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(png), formats=("PNG",)) as image:
            if image.mode != "L" or image.width != PACKED_WIDTH or image.height > max_bytes // PACKED_WIDTH + 1:
                raise ValueError("it has another shape")
            return np.asarray(image).tobytes()
    except Exception as error:  # decoders of damaged files raise anything
        raise ValueError(f"expected a PNG that holds data ({error})") from None


def encode_exr(
    pixels: np.ndarray, channels: tuple[str, ...], text: Mapping[str, str] | None = None, linear: bool = True
) -> bytes:
    """OpenEXR of [H, W, C] float16, float32 or uint32 samples, lossless. channels: the C names ("R", "G", "B", "A");
    "A" has been multiplied into the colours, as the format wants. text: header attributes. linear: whether the samples
    are light, not data. Raises ValueError: no OpenImageIO, NaN."""
    if pixels.shape[2:] != (len(channels),):
        raise ValueError(f"EXR: expected [H, W, {len(channels)}] samples, got {list(pixels.shape)}")
    if pixels.dtype.kind == "f" and np.isnan(pixels).any():
        raise ValueError(f"EXR: {int(np.isnan(pixels).sum())} samples are NaN")
    # Marked as Rec. 709 light, or as data, which programs must not convert.
    attributes = {"compression": "zip", "oiio:ColorSpace": "lin_rec709" if linear else "data"}
    return _encode("exr", pixels, text or {}, attributes, channels)


def _encode(
    ending: str,
    pixels: np.ndarray,
    text: Mapping[str, str],
    attributes: Mapping[str, str | int],
    channels: tuple[str, ...] = (),
) -> bytes:
    oiio = require_deep("16-bit colour PNG" if ending == "png" else "OpenEXR")
    height, width, count = pixels.shape
    kinds = {"uint16": "uint16", "float16": "half", "float32": "float", "uint32": "uint"}
    spec = oiio.ImageSpec(width, height, count, kinds[pixels.dtype.name])
    if channels:
        spec.channelnames = channels
    if ending == "png":
        spec.attribute("oiio:UnassociatedAlpha", 1)
    for name, value in {**attributes, **text}.items():
        spec.attribute(name, value)
    # By a file: its Python face writes no memory.
    with tempfile.TemporaryDirectory(prefix="splatpainter-picture-") as folder:
        path = Path(folder) / f"picture.{ending}"
        out = oiio.ImageOutput.create(str(path))
        done = out is not None and out.open(str(path), spec) and out.write_image(np.ascontiguousarray(pixels))
        problem = "" if done else (problem_of(out if out is not None else oiio))
        if out is not None:
            done = out.close() and done
        if not done:
            raise ValueError(f"{ending.upper()}: {width}x{height} samples cannot be encoded ({_short(problem)})")
        return path.read_bytes()


@dataclass(frozen=True)
class PageCodes:
    """Numbers of TIFF 6.0, and how many pages are looked at."""

    photometric: int = 262
    """Tag: what its numbers mean."""
    rgb_or_grey: tuple[int, ...] = (0, 1, 2)
    """Of that tag: grey from white, grey from black, RGB."""
    subfile: int = 254
    """Tag: which kind of page it is."""
    reduced: int = 1
    """Bit of that tag: a small copy of another page."""
    max_parts: int = 64
    """Pages of a TIFF and parts of an OpenEXR file. Source: taste."""


PAGES = PageCodes()
BIG_ENDIAN_BIGTIFF = b"MM\0+"


@dataclass(frozen=True)
class PixelSamples:
    """A picture with all its bits."""

    values: np.ndarray
    """[H, W, C] float32: integers as 0..1, floats as they are; NaN is 0."""
    channels: int
    """C: 1 grey, 2 grey and alpha, 3 RGB, 4 RGBA."""
    multiplied: bool
    """Whether colours are multiplied by alpha."""
    orientation: int = 1
    """How it is turned, as EXIF says it: 1 to 8."""
    profile: bytes | None = None
    """ICC profile, where it has one."""
    primaries: tuple[float, ...] | None = None
    """x, y of white, red, green and blue, where an OpenEXR file says them."""
    is_float: bool = False
    layer: str = ""
    """The layer of an OpenEXR file whose channels they are; "": those without one."""


def is_exr(path: Path) -> bool:
    """Whether a file begins as OpenEXR does; False for what cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read(4) == EXR_MAGIC
    except OSError:
        return False


def is_light(path: Path) -> bool:
    """Whether a file's numbers are linear light by its kind: OpenEXR, Radiance. False for what cannot be read."""
    try:
        return is_exr(path) or _begins_with(path, RADIANCE_MAGIC)
    except OSError:
        return False


def light_size(path: Path, max_pixels: int) -> tuple[int, int]:
    """(width, height) of such a file, of its display window, by its header. Raises ValueError as `read_deep`."""
    with _opened(path, max_pixels) as (_, spec):
        return spec.full_width, spec.full_height


def is_deep(path: Path, image: Image) -> bool:
    """Whether Pillow, which opened it, cuts this PNG or TIFF to 8 bits: 16-bit samples of several channels."""
    if image.format == "PNG":
        with open(path, "rb") as file:
            head = file.read(26)  # ends with the header's bit depth and colour type; 0 is grey, which Pillow can read
        return head[24:25] == b"\x10" and head[25:26] in (b"\x02", b"\x04", b"\x06")
    if image.format == "TIFF":
        bits = getattr(image, "tag_v2", {}).get(TIFF_BITS, ())
        return len(bits) > 1 and min(bits) == 16
    return False


def read_deep(path: Path, max_pixels: int) -> PixelSamples:
    """All bits of a PNG, TIFF, Radiance or OpenEXR file (of the latter R, G, B, A or Y; its whole display window, with
    nothing outside its data window). Raises ValueError naming the file: no OpenImageIO, damaged, more than
    `max_pixels`, channels that are no colour."""
    with _opened(path, max_pixels) as (source, spec):
        if spec.deep:
            raise ValueError(f"{path}: expected a flat picture, got deep samples; flatten it first")
        part, spec, layer, channels = _color_layer(source, spec, path, max_pixels)
        # One read of all that lies between the first and the last, as OpenImageIO takes a range.
        names = [str(name).upper() for name in spec.channelnames]
        positions = [names.index(f"{layer}{name}".upper()) for name in channels]
        first, last = min(positions), max(positions) + 1
        if last - first > 16:
            raise ValueError(f"{path}: expected the colour channels side by side, got {last - first - 1} between them")
        # OpenImageIO 3.2 gives back whatever was in the memory.
        side_by_side = spec.getattribute("planarconfig") != "separate"
        if source.format_name() == "tiff" and str(spec.format) == "double" and spec.tile_width and side_by_side:
            raise ValueError(f"{path}: expected floats of 16 or 32 bits, got tiles of 64 bits; save it with 32")
        pixels = source.read_image(part, 0, first, last, "float")
        if pixels is None or not isinstance(pixels, np.ndarray):
            raise ValueError(f"{path}: damaged picture ({_short(problem_of(source))})")
        pixels = pixels.reshape(spec.height, spec.width, last - first)[
            ..., [position - first for position in positions]
        ]
        associated = spec.getattribute("oiio:UnassociatedAlpha") in (None, 0) and source.format_name() != "png"
        # Beside what is drawn, 0 / 0 of an undone alpha is usual and shows nowhere; in it, black specks would be paint.
        bad = np.isnan(pixels).any(-1) & (~(pixels[..., -1] <= 0) if len(channels) in (2, 4) else True)
        if bad.any():
            raise ValueError(
                f"{path}: {int(bad.sum()):,} of {bad.size:,} pixels are NaN (no number); expected colours: repair them "
                "in the program that wrote it, or export a PNG"
            )
        values = _windowed(np.nan_to_num(pixels), spec)
        # A header may hold anything: an orientation that EXIF does not know is taken for none.
        turned = spec.getattribute("Orientation")
        orientation = turned if isinstance(turned, int) and 1 <= turned <= 8 else 1
        if source.format_name() == "tiff" and _has_further_pages(source):
            raise ValueError(f"{path}: {SEVERAL_PAGES}")
        profile, primaries = _profile(spec), _primaries(spec)
        is_float = str(spec.format) in ("half", "float", "double")
    layer = layer.removesuffix(".")
    return PixelSamples(values, len(channels), bool(associated), orientation, profile, primaries, is_float, layer)


def _color_layer(source: Any, spec: Any, path: Path, max_pixels: int) -> tuple[int, Any, str, tuple[str, ...]]:
    """(part, its spec, what stands before the channels' names, R, G, B, A or Y) of the picture in a file; the channels
    of compositing programs are R, G and B, or `beauty.R` and so on, and may lie behind a part of depths. Raises
    ValueError: none, or several layers of which none is called as the picture."""
    layouts = ("R", "G", "B", "A"), ("R", "G", "B"), ("Y", "A"), ("Y",)
    candidates: list[tuple[int, Any, str, tuple[str, ...]]] = []
    listed = list(map(str, spec.channelnames[:8]))
    parts = PAGES.max_parts if source.format_name() == "openexr" else 1
    for part in range(parts):
        if part:
            if not source.seek_subimage(part, 0):
                break
            spec = source.spec()
            _check_size(spec, path, max_pixels)
        # Names, not places, say what a channel is: OpenEXR sorts them by the alphabet.
        names = [str(name) for name in spec.channelnames]
        for layer in dict.fromkeys(name[: name.rfind(".") + 1] for name in names):
            there = {name[len(layer) :].upper() for name in names if name.startswith(layer)}
            channels = next((one for one in (layouts[:2] if layer else layouts) if {*one} <= there), None)
            if channels is not None and not layer:
                return part, spec, layer, channels
            if channels is not None:
                candidates.append((part, spec, layer, channels))
    if not candidates:
        raise ValueError(f"{path}: expected channels R, G, B or Y, got {', '.join(listed)}")
    named = [one for one in candidates if one[2].rstrip(".").rpartition(".")[2].lower() in PICTURE_LAYERS]
    if len(named or candidates) > 1:
        layers = ", ".join(one[2].removesuffix(".") for one in (named or candidates)[:4])
        raise ValueError(f"{path}: expected one picture, got several layers ({layers}); save one of them")
    (chosen,) = named or candidates
    source.seek_subimage(chosen[0], 0)
    return chosen


def _has_further_pages(source: Any) -> bool:
    """Whether a TIFF has more than its first page, small copies of it left out."""
    for page in range(1, PAGES.max_parts):
        if not source.seek_subimage(page, 0):
            return False
        kind = source.spec().getattribute("tiff:subfiletype")
        if not (isinstance(kind, int) and kind & PAGES.reduced):
            return True
    return True


def is_beyond_pillow(path: Path) -> bool:
    """Whether OpenImageIO finds a picture of RGB or grey in a TIFF that Pillow does not open: of floats, of more than
    16 bits, or of 16 with channels besides. Raises ValueError: it is not installed, and more pixels than `read_deep`
    takes."""
    try:
        with _opened(path, MAX_PICTURE_PIXELS) as (_, spec):
            # Pillow opens no BigTIFF whose numbers are big-endian, whatever their bits.
            is_foreign = str(spec.format) not in ("uint8", "int8") or _begins_with(path, BIG_ENDIAN_BIGTIFF)
            return is_foreign and spec.getattribute("tiff:PhotometricInterpretation") in PAGES.rgb_or_grey
    except ValueError as error:
        if "needs OpenImageIO" in str(error) or "megapixels" in str(error):
            raise
        return False


def _begins_with(path: Path, magic: bytes) -> bool:
    with open(path, "rb") as file:
        return file.read(len(magic)) == magic


def _profile(spec: Any) -> bytes | None:
    stored = spec.getattribute("ICCProfile")
    return None if stored is None or isinstance(stored, str | int | float) else bytes(np.asarray(stored, np.uint8))


def _primaries(spec: Any) -> tuple[float, ...] | None:
    """OpenEXR's order is red, green, blue, white."""
    stored = spec.getattribute("chromaticities")
    if stored is None or isinstance(stored, str | int | float) or len(stored) != 8:
        return None
    red_to_blue = [float(value) for value in stored]
    return (*red_to_blue[6:], *red_to_blue[:6])


def _windowed(pixels: np.ndarray, spec: Any) -> np.ndarray:
    """The display window of a picture that may hold more or less of it."""
    # Programs crop OpenEXR pictures to what is not empty; the display window says where that belongs.
    full_window = (spec.x, spec.y, spec.width, spec.height) == (
        spec.full_x,
        spec.full_y,
        spec.full_width,
        spec.full_height,
    )
    if full_window:
        return np.ascontiguousarray(pixels, np.float32)
    out = np.zeros((spec.full_height, spec.full_width, pixels.shape[2]), np.float32)
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(left + spec.width, spec.full_width), min(top + spec.height, spec.full_height)
    if x0 < x1 and y0 < y1:
        out[y0:y1, x0:x1] = pixels[y0 - top : y1 - top, x0 - left : x1 - left]
    return out


def exr_text(path: Path, keyword: str, max_pixels: int) -> str | None:
    """A text attribute of an OpenEXR header; None where it has none. Raises ValueError as `read_deep`."""
    with _opened(path, max_pixels) as (_, spec):
        value = spec.getattribute(keyword)
        return value if isinstance(value, str) else None


@contextlib.contextmanager
def _opened(path: Path, max_pixels: int) -> Iterator[tuple[Any, Any]]:
    """(input, spec) of a file whose claims were judged: nothing was decoded yet."""
    # Limits are set before the file is opened: a header can claim any number of channels and pixels.
    oiio = require_deep(f"{path}: {'OpenEXR' if is_exr(path) else 'Radiance' if is_light(path) else '16-bit colour'}")
    oiio.attribute("limits:channels", MAX_CHANNELS)
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)  # leave colours and alpha as they are stored
    source = oiio.ImageInput.open(str(path), hints)
    if source is None:
        raise ValueError(f"{path}: cannot be read as a picture ({_short(problem_of(oiio))})")
    try:
        if source.format_name() not in READS:
            raise ValueError(f"{path}: expected PNG, TIFF or OpenEXR, got {source.format_name()}")
        spec = source.spec()
        _check_size(spec, path, max_pixels)
        yield source, spec
    finally:
        source.close()


def _check_size(spec: Any, path: Path, max_pixels: int) -> None:
    for width, height in ((spec.width, spec.height), (spec.full_width, spec.full_height)):
        if not 0 < width * height <= max_pixels:
            raise ValueError(
                f"{path}: expected at most {max_pixels // 10**6} megapixels, got {width}x{height}; scale it down"
            )


def problem_of(source: Any) -> str:
    """The last error of OpenImageIO, or of one of its inputs or outputs. It quotes bytes of damaged files, which need
    not be text; its Python face then fails."""
    try:
        return source.geterror()
    except UnicodeDecodeError as error:
        return error.object.decode("ascii", "replace")


def _short(problem: str) -> str:
    return " ".join(problem.split())[:120] or "no reason given"


def picture_header(path: Path) -> tuple[tuple[int, int], int]:
    """((width, height) as stored, EXIF orientation 1 to 8) of a picture that Pillow reads; nothing is decoded. Raises
    ValueError naming the file."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's remarks about damaged tags
            with Image.open(path) as image:
                turned = image.getexif().get(EXIF_ORIENTATION, 1)
                return image.size, turned if isinstance(turned, int) and 1 <= turned <= 8 else 1
    except Exception as error:  # decoders of damaged files raise anything
        raise ValueError(f"{path}: cannot be read as a picture ({_reason(error)})") from None


# ---- cameras in pictures


def write_png(path: str | Path, image: np.ndarray, camera: Camera | None = None) -> None:
    """Write [H, W, 3] colours (float 0..1, or uint8) as an 8-bit PNG, with its camera in the tEXt chunk if given.
    It appears whole or not at all. Raises ValueError where it cannot be written."""
    data = encode_png(to_uint8(image), None if camera is None else {CAMERA_KEYWORD: camera.to_json()})
    with writing(Path(path)) as file:
        file.write(data)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Float 0..1 -> 0..255, rounded to nearest; uint8 passes through."""
    return image if image.dtype == np.uint8 else quantized(image)


def find_camera(png: str | Path, explicit: str | Path | None = None) -> Camera:
    """The camera of a picture: the explicit JSON file, else the PNG's chunk, else the sidecar NAME.json beside it.
    Raises ValueError when none is there or the one found is broken."""
    text, where = _camera_text(Path(png), None if explicit is None else Path(explicit))
    if text is None:
        where = f"in the PNG ({CAMERA_KEYWORD} chunk), in {Path(png).with_suffix('.json').name}, or given with --camera"
        raise ValueError(f"{png}: no camera; expected one {where}")
    return Camera.from_json(text, where)


def has_camera(picture: str | Path) -> bool:
    """Whether a picture says its camera, or has NAME.json beside it. Raises ValueError as `find_camera`, of a picture
    that cannot be read."""
    return _camera_text(Path(picture), None)[0] is not None


def find_alpha(png: str | Path, explicit: str | Path | None = None) -> Alpha | None:
    """How a picture that was rendered without a background keeps its colours, as it says beside its camera, looked for
    as by `find_camera`; None for other pictures. OpenEXR is "straight": its readers take the alpha out again."""
    try:
        text, _ = _camera_text(Path(png), None if explicit is None else Path(explicit))
        data = json.loads(text or "{}")
    except (ValueError, RecursionError):
        return None
    stated = data.get(ALPHA_KEY) if isinstance(data, dict) else None
    if stated not in get_args(Alpha):
        return None
    return "straight" if is_exr(Path(png)) else stated


def _camera_text(picture: Path, explicit: Path | None) -> tuple[str | None, str]:
    """(the JSON of a camera or None, where it was found)."""
    from PIL import Image, UnidentifiedImageError

    # Whoever names a file means it; then what travels inside of the picture, which cannot be left behind; the sidecar
    # last.
    if explicit is not None:
        return _read_text(explicit), str(explicit)
    if is_exr(picture):
        text, kind = exr_text(picture, CAMERA_KEYWORD, MAX_PICTURE_PIXELS), "EXR header"
    else:
        kind = "PNG chunk"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Pillow's remarks about damaged tags
                with Image.open(picture) as image:
                    # `text` decodes the picture, to look for chunks behind it: only where some stand there alone.
                    text = image.info.get(CAMERA_KEYWORD)
                    if image.format == "PNG" and _may_say_more(picture) and not text:
                        text = getattr(image, "text", {}).get(CAMERA_KEYWORD)
        except UnidentifiedImageError:  # of layers, or of floats: it may have a sidecar
            if not picture.is_file():
                raise ValueError(f"{picture}: cannot be read as a picture (no regular file)") from None
            text = None
        except Exception as error:  # decoders of damaged files raise anything
            if type(error) is ValueError and str(picture) in str(error):
                raise
            raise ValueError(f"{picture}: cannot be read as a picture ({_reason(error)})") from None
    if text:
        return text, f"{picture} ({kind})"
    sidecar = picture.with_suffix(".json")
    return (_read_text(sidecar), str(sidecar)) if sidecar.exists() else (None, "")


def _may_say_more(png: Path) -> bool:
    """Whether chunks of text stand behind a PNG's first pixels; also where the chunks do not end as they should. Raises
    ValueError: it has several cameras, of which a reader would take any one."""
    has_pixels = says_more = False
    cameras: set[bytes] = set()
    with open(png, "rb") as file:
        file.seek(len(PNG_MAGIC))
        while len(head := file.read(8)) == 8:
            size, kind = struct.unpack(">I4s", head)
            if kind == b"IEND":
                return says_more
            after = file.tell() + size + 4
            if kind in TEXT_CHUNKS:
                says_more = says_more or has_pixels
                if file.read(len(_CAMERA_KEY)) == _CAMERA_KEY:
                    cameras.add(_chunk_text(kind, file.read(min(size - len(_CAMERA_KEY), MAX_CAMERA_CHUNK))))
                if len(cameras) > 1:
                    actual = f"{len(cameras)} cameras that differ ({CAMERA_KEYWORD} chunks)"
                    raise ValueError(f"{png}: expected one camera, got {actual}; say which is meant with --camera")
            has_pixels = has_pixels or kind == b"IDAT"
            file.seek(after)
    return True


def _chunk_text(kind: bytes, rest: bytes) -> bytes:
    """What a chunk of text says behind its keyword, unpacked; what cannot be is left as it is."""
    packed = kind == b"zTXt"
    if kind == b"iTXt":
        packed, rest = rest[:1] == b"\1", b"\0" + rest[2:].split(b"\0", 2)[-1]
    if not packed:
        return rest.removeprefix(b"\0")
    try:
        return zlib.decompressobj().decompress(rest[1:], MAX_CAMERA_CHUNK)
    except zlib.error:
        return rest


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")  # editors of Windows begin files with a mark
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read as a camera ({_reason(error)})") from None


def _reason(error: BaseException) -> str:
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(reason.split())[:200]
