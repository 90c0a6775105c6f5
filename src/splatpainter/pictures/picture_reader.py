"""Picture files in: any depth, palette, alpha, orientation and colour profile become plain sRGB. Knows no asset.

Nothing is decoded before its size is judged. 16-bit PNG and TIFF keep their bits, OpenEXR its floats;
where OpenImageIO is not installed 16-bit colour is read with its upper 8 bits, and a note says so.
"""

from __future__ import annotations

import io
import os
import tempfile
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from splatpainter.color import to_display
from splatpainter.image_files import (
    EXTRA,
    MAX_PICTURE_PIXELS,
    PAGES,
    SEVERAL_PAGES,
    PixelSamples,
    can_do_deep,
    is_beyond_pillow,
    is_deep,
    is_light,
    read_deep,
)
from splatpainter.kernels.parallel import each
from splatpainter.kernels.portable import matmul
from splatpainter.pictures.color_profiles import (
    ColorStatement,
    PngColors,
    exif_colors,
    matrix_profile,
    png_colors,
    primaries_to_srgb,
)
from splatpainter.pictures.encodings import Encoding, encoding_of, stored_in
from splatpainter.pictures.foreign_pictures import READ_KINDS, is_raw_tiff, refusal
from splatpainter.pictures.layered_files import (
    first_bytes,
    is_psd,
    is_zip,
    merged_png,
    psd_size,
    read_psd,
)
from splatpainter.pictures.whole_files import TIFF_MAGICS, check_complete
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from PIL.Image import Image

SIZE_LIMIT = f"at most {MAX_PICTURE_PIXELS // 10**6} megapixels"
Kernel = Literal["nearest", "bilinear", "bicubic", "lanczos"]
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr", ".hdr", ".psd", ".psb", ".ora", ".kra")
"""Endings of files that are read as pictures."""
PICTURE_KINDS = ("PNG", "JPEG", "WEBP", "TIFF")
LOSSY_KINDS = ("JPEG", "WebP")
EMPTY_MASK = "empty mask; expected some pixels that are not black (or not transparent)"
"""What is wrong with a mask that selects nothing."""
TIFF_NOT_READ = "a TIFF packed by WebP, which few programs read; export it as PNG"
UNUSABLE = "its colour profile cannot be used"
INKS = ("CMYK", "LAB")
"""Pillow's modes whose colours depend on a profile and do not come back as they were painted."""
MAX_LOSSY_NOISE = 16
"""8-bit levels that lossy compression leaves on black."""
EXIF_STEPS = {2: (-1, 1), 3: (-1, -1), 4: (1, -1), 6: (-1, 1), 7: (-1, -1), 8: (1, -1)}
"""EXIF orientation -> steps (across, down) through the pixels, once rows and columns changed places from 5 on."""
MAX_PROFILE_DIFFERENCE = 2
"""8-bit levels by which an embedded profile may differ from sRGB and still be taken for it (there are a dozen)."""


@dataclass(frozen=True)
class Picture:
    """A decoded picture."""

    colors: np.ndarray
    """[H, W, 3] float32 sRGB 0..1, not multiplied by alpha."""
    alpha: np.ndarray | None
    """[H, W] float32 0..1; None where every pixel is opaque."""
    notes: tuple[str, ...] = ()
    """What was done to it that its owner may want to know, one line each."""
    encoding: Encoding | None = None
    """How its file loses something; None: not, or nobody can say how."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.colors.shape[1], self.colors.shape[0]

    def resized(self, width: int, height: int) -> Picture:
        """The same picture at another size; colours that show nowhere (alpha 0) do not bleed in."""
        if self.size == (width, height):
            return self
        if self.alpha is None:
            return replace(self, colors=resample(self.colors, width, height))
        alpha = resample(self.alpha, width, height)
        # Premultiplied while resampling: colours under transparent pixels are anything.
        solid = resample(self.colors * self.alpha[..., None], width, height) / np.maximum(alpha, 1e-3)[..., None]
        return replace(self, colors=np.clip(solid, 0, 1).astype(np.float32), alpha=alpha)


def read_picture(path: Path, *, inks: bool = True) -> Picture:
    """Decode a PNG, JPEG, WebP or TIFF file as its owner sees it: turned as EXIF says, converted from its embedded
    profile, or from what a PNG or EXIF says of its colours, to sRGB; or an OpenEXR or Radiance file of linear light; or
    the flattened picture of a PSD, OpenRaster or Krita file. inks: whether colours may be of INKS, not in pictures that
    are compared with a render. Raises ValueError: missing, unreadable, damaged, another kind of file, animated, more
    than MAX_PICTURE_PIXELS pixels, OpenEXR without OpenImageIO."""
    # Kinds that Pillow does not read, or not with all their bits, go first.
    if is_light(path):
        samples = read_deep(path, MAX_PICTURE_PIXELS)
        return replace(_light(samples), notes=(f"its layer {samples.layer} was read",) if samples.layer else ())
    if is_zip(path):
        with _merged_file(path) as merged:
            return read_picture(merged, inks=inks)
    if is_psd(path):
        return _composite(path)
    _check_developed(path)
    check_complete(path)
    if _is_tiff_beyond_pillow(path):
        return _beyond_pillow(read_deep(path, MAX_PICTURE_PIXELS))
    with _opened(path) as image:
        from PIL import ImageOps

        if not inks and image.mode in INKS:
            raise ValueError(f"{path}: expected RGB colours, got {image.mode}; save it as RGB")
        # Turned before anything is measured: everybody else sees it so, too.
        turned = ImageOps.exif_transpose(image)
        stated = png_colors(path) if image.format == "PNG" else PngColors(profiled=True)
        stated, unusable = _without_unusable_profile(path, image, stated)
        notes = [*unusable, *stated.notes]
        if turned.mode.startswith("I") or turned.mode == "F":
            white_is_zero = image.format == "TIFF" and getattr(image, "tag_v2", {}).get(PAGES.photometric) == 0
            return _in_srgb(Picture(*_deep_grey(turned, white_is_zero), notes=tuple(notes)), stated.statement)
        # Pillow's colour management is 8 bits; deep pictures take the matrix way below where they can.
        profile = image.info.get("icc_profile") if stated.profiled else None
        alpha = _alpha(turned)
        colors, note = _srgb(turned, profile)
        if is_deep(path, image):
            statement = matrix_profile(profile) if note and profile else None
            # All bits, where the reader is there and the colours can be brought to sRGB without losing them.
            if can_do_deep() and (statement is not None or not note):
                picture = replace(_deep(read_deep(path, MAX_PICTURE_PIXELS)), notes=tuple(notes))
                if statement is None:
                    return _in_srgb(picture, stated.statement)
                return replace(picture, colors=statement.to_srgb(picture.colors), notes=(*notes, note))
            if not note:
                notes.append(f"read with 8 of its 16 bits; pip install 'splatpainter[{EXTRA}]' to read all")
        notes += [note] if note else []
        embedded = matrix_profile(profile) if note and profile else None
        pixels = np.asarray(colors if embedded is None else turned.convert("RGBA").convert("RGB"), np.float32)
        pixels = np.divide(pixels, 255, out=pixels if pixels.flags.writeable else None)
        if embedded is not None:
            pixels = embedded.to_srgb(pixels)
        # What the file was rounded to, or compressed in, were its own colours.
        statement, encoding = embedded or stated.statement, encoding_of(image)
        encoding = encoding if statement is None else stored_in(encoding, statement)
        return _in_srgb(Picture(pixels, alpha, tuple(notes), encoding), stated.statement)


def _check_developed(path: Path) -> None:
    """Raises ValueError: a raw photograph in a TIFF, whose first page is a preview, or what a sensor counted."""
    if is_raw_tiff(path):
        raise ValueError(f"{path}: {refusal(path)}")


def _without_unusable_profile(path: Path, image: Image, stated: PngColors) -> tuple[PngColors, tuple[str, ...]]:
    """(what counts, notes): what a file says of its colours otherwise, where it has no profile or none that is read."""
    if not stated.profiled:
        return stated, ()
    profile = image.info.get("icc_profile")
    if profile and _is_profile(profile):
        return stated, ()
    other = png_colors(path, profile=False) if image.format == "PNG" else PngColors(_exif_statement(path))
    if not profile and image.format != "PNG":  # none was promised
        return other, ()
    return other, (UNUSABLE if other.statement is not None else f"{UNUSABLE}; its colours are taken as sRGB",)


def _exif_statement(path: Path) -> ColorStatement | None:
    from PIL import ExifTags, Image

    with Image.open(path, formats=PICTURE_KINDS) as image:  # a decoded TIFF can no longer be asked
        exif = image.getexif()
        details, interop = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.Interop)
        return exif_colors(details.get(ExifTags.Base.ColorSpace), interop.get(ExifTags.Interop.InteropIndex))


def _is_profile(profile: bytes) -> bool:
    from PIL import ImageCms

    try:
        ImageCms.ImageCmsProfile(io.BytesIO(profile))
    except (ImageCms.PyCMSError, ValueError, TypeError, OSError):
        return False
    return True


def declared_size(path: Path) -> tuple[int, int] | None:
    """(width, height) by a picture's header, before EXIF turns it: nothing is decoded. None for OpenEXR, Radiance
    and TIFF of floats, whose windows the reader judges. Raises ValueError as `read_picture`."""
    _check_developed(path)
    if is_light(path) or _is_tiff_beyond_pillow(path):
        return None
    if is_psd(path):
        return psd_size(path)
    if is_zip(path):
        with _merged_file(path) as merged:
            return declared_size(merged)
    with _opened(path, decode=False) as image:
        return image.size


def read_mask(path: Path) -> np.ndarray:
    """[H, W] bool: where a mask picture is not black or, if any of it is transparent, where it is not transparent.
    Raises ValueError as `read_picture`."""
    picture = read_picture(path)
    # Black that went through JPEG is not quite black.
    lossy = picture.encoding is not None and picture.encoding.kind in LOSSY_KINDS
    if picture.alpha is not None:
        return picture.alpha > 0
    return picture.colors.max(-1) > (MAX_LOSSY_NOISE / 255 if lossy else 0)


def resample(values: np.ndarray, width: int, height: int, kernel: Kernel = "lanczos") -> np.ndarray:
    """[H, W] or [H, W, 3] float32 0..1 at another size, by Lanczos (which averages when it shrinks) or another."""
    from PIL import Image

    planes = values[..., None] if values.ndim == 2 else values

    def resized(plane: np.ndarray) -> np.ndarray:
        return np.asarray(Image.fromarray(plane, "F").resize((width, height), Image.Resampling[kernel.upper()]))

    # Float planes one by one: Pillow resamples a colour picture in 8 bits only.
    out = each(resized, list(np.ascontiguousarray(np.moveaxis(planes, -1, 0), np.float32)))
    stacked = np.clip(np.stack(out, -1), 0, 1)
    return stacked[..., 0] if values.ndim == 2 else stacked


@contextmanager
def _opened(path: Path, decode: bool = True) -> Iterator[Image]:
    """The picture, its size judged and its pixels decoded (decode). Decoders of damaged files raise anything: all of it
    becomes one line."""
    from PIL import Image, UnidentifiedImageError

    # Each cause its own line; a FIFO or a device would block for ever.
    if not path.exists():
        raise ValueError(f"{path}: no such file")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; expected a picture")
    if not path.is_file():
        raise ValueError(f"{path}: is not a regular file; expected a picture")
    if not path.stat().st_size:
        raise ValueError(f"{path}: is empty (0 bytes); expected a picture: save it again")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's own size warning and remarks about EXIF: judged here or harmless
        try:
            image = Image.open(path, formats=PICTURE_KINDS)
        except UnidentifiedImageError:
            raise ValueError(f"{path}: {refusal(path)}") from None
        except Image.DecompressionBombError:
            raise ValueError(f"{path}: expected {SIZE_LIMIT}; scale it down") from None
        except Exception as error:
            raise ValueError(f"{path}: cannot be read as a picture ({_short(error)})") from None
        with image:
            # Pillow has read the header alone: nothing is decoded yet.
            if image.width * image.height > MAX_PICTURE_PIXELS:
                actual = f"{image.width}x{image.height}"
                raise ValueError(f"{path}: expected {SIZE_LIMIT}, got {actual}; scale it down")
            _check_still(path, image)
            if image.format == "TIFF" and image.info.get("compression") == "webp":  # libtiff would print its regrets
                raise ValueError(f"{path}: expected a {READ_KINDS} picture, got {TIFF_NOT_READ}")
            try:
                if decode:
                    with _quiet_libtiff(image):
                        image.load()
            except Exception as error:
                raise ValueError(f"{path}: damaged picture ({_short(error)})") from None
            try:
                yield image
            except Exception as error:  # palettes, EXIF and profiles are only looked at when they are used
                if isinstance(error, MemoryError) or (type(error) is ValueError and str(path) in str(error)):
                    raise
                raise ValueError(f"{path}: damaged picture ({_short(error)})") from None


@contextmanager
def _quiet_libtiff(image: Image) -> Iterator[None]:
    """libtiff prints what is wrong with a TIFF past Python; the one line that is raised says it. In the main thread
    alone, which is that of commands: standard error is the process's, and a server's other threads write to it."""
    if image.format != "TIFF" or threading.current_thread() is not threading.main_thread():
        yield
        return
    try:
        stderr = os.dup(2)
    except OSError:  # a process without one
        yield
        return
    try:
        with open(os.devnull, "wb") as nothing:
            os.dup2(nothing.fileno(), 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


@contextmanager
def _merged_file(path: Path) -> Iterator[Path]:
    """The flattened picture of an OpenRaster or Krita file, as a file; errors name the file that it lies in."""
    data = merged_png(path)
    with tempfile.TemporaryDirectory(prefix="splatpainter-merged-") as folder:
        merged = Path(folder) / "merged.png"
        merged.write_bytes(data)
        try:
            yield merged
        except ValueError as error:
            raise ValueError(str(error).replace(str(merged), str(path))) from None


def _composite(path: Path) -> Picture:
    """The flattened picture of a PSD in sRGB."""
    composite = read_psd(path)
    picture = Picture(composite.colors, composite.alpha)
    if composite.profile is None:
        return picture
    statement = matrix_profile(composite.profile)
    if statement is None:
        return replace(picture, notes=(f"{UNUSABLE}; its colours are taken as sRGB",))
    return picture if statement.is_srgb else _in_srgb(picture, statement)


def _is_tiff_beyond_pillow(path: Path) -> bool:
    """Whether it is a TIFF that Pillow cannot open: floats or 32-bit integers of several channels, or 16 bits with a
    saved selection."""
    if first_bytes(path, 4) not in TIFF_MAGICS:
        return False
    from PIL import Image, UnidentifiedImageError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(path, formats=("TIFF",)):
                return False
        except UnidentifiedImageError:
            return is_beyond_pillow(path)
        except Exception:  # decoders of damaged files raise anything; the reader says what
            return False


def _beyond_pillow(samples: PixelSamples) -> Picture:
    """A TIFF of floats, in sRGB: by its profile, else its numbers are taken as they are, which a note says."""
    picture = _deep(samples)
    statement = None if samples.profile is None else matrix_profile(samples.profile)
    if statement is not None:
        return picture if statement.is_srgb else _in_srgb(picture, statement)
    if samples.is_float:
        note = "floats without a colour profile that is read here: taken as sRGB numbers; save linear light as OpenEXR"
        return replace(picture, notes=(note,))
    return picture


def _in_srgb(picture: Picture, statement: ColorStatement | None) -> Picture:
    """A picture whose stored values mean what a statement says; None: sRGB already."""
    if statement is None:
        return picture
    note = f"converted from its colours ({statement.name}) to sRGB"
    return replace(picture, colors=statement.to_srgb(picture.colors), notes=(*picture.notes, note))


def _check_still(path: Path, image: Image) -> None:
    """Raises ValueError: frames, or pages (GIMP's layers in a TIFF), of which the first alone would count. The second
    picture in JPEG files of phones is a preview."""
    kind = image.format
    # The first frame alone would be painted with, and the rest lost without a word.
    if kind in ("PNG", "WEBP") and getattr(image, "is_animated", False):
        actual = f"{kind} with {getattr(image, 'n_frames', 'several')} frames"
        raise ValueError(f"{path}: expected a still picture, got {actual}; save one of them as PNG")
    if kind == "TIFF" and getattr(getattr(image, "tag_v2", None), "next", 0) and not _is_with_thumbnails(path):
        raise ValueError(f"{path}: {SEVERAL_PAGES}")


def _is_with_thumbnails(path: Path) -> bool:
    """Whether all pages of a TIFF but the first are small copies of it, as raw converters write them."""
    from PIL import Image

    with Image.open(path, formats=("TIFF",)) as image:
        try:
            for page in range(1, PAGES.max_parts):
                image.seek(page)
                if not int(getattr(image, "tag_v2", {}).get(PAGES.subfile, 0)) & PAGES.reduced:
                    return False
        except EOFError:
            return True
        except Exception:  # decoders of damaged files raise anything
            return False
    return False


def _short(error: Exception) -> str:
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(reason.split())[:120]


def _deep_grey(image: Image, white_is_zero: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """16-bit integers of 0..65535, floats of 0..1; and where a PNG's one transparent level is not."""
    values = np.asarray(image).astype(np.float32)
    grey = np.clip(np.nan_to_num(values if image.mode == "F" else values / 65535), 0, 1)
    clear = image.info.get("transparency")
    alpha = (values != clear).astype(np.float32) if isinstance(clear, int) else None
    return np.repeat((1 - grey if white_is_zero else grey)[..., None], 3, -1), alpha


def _deep(samples: PixelSamples) -> Picture:
    """16-bit samples in display colours, turned as EXIF says."""
    values = samples.values
    # OpenImageIO leaves the orientation to its caller.
    if samples.orientation >= 5:
        values = values.swapaxes(0, 1)
    across, down = EXIF_STEPS.get(samples.orientation, (1, 1))
    values = values[::down, ::across]
    alpha = values[..., -1] if samples.channels in (2, 4) else None
    colors = values[..., :3] if samples.channels >= 3 else np.repeat(values[..., :1], 3, -1)
    colors = np.clip(unpremultiplied(colors, alpha) if alpha is not None and samples.multiplied else colors, 0, 1)
    if alpha is not None and alpha.min() == 1:
        alpha = None
    return Picture(np.ascontiguousarray(colors), None if alpha is None else np.ascontiguousarray(alpha))


def _light(samples: PixelSamples) -> Picture:
    """Linear light, multiplied by alpha, as display colours."""
    values = samples.values
    alpha = np.clip(values[..., -1], 0, 1) if samples.channels in (2, 4) else None
    light = values[..., :3] if samples.channels >= 3 else np.repeat(values[..., :1], 3, -1)
    # EXR is scene light: primaries first, then the display curve.
    light = _of_srgb_primaries(light, samples.primaries)
    colors = to_display(light if alpha is None else unpremultiplied(light, alpha), "linear")
    opaque = alpha is None or alpha.min() == 1
    return Picture(colors.astype(np.float32), None if opaque else alpha)


def _of_srgb_primaries(light: np.ndarray, primaries: tuple[float, ...] | None) -> np.ndarray:
    """[H, W, 3] linear light of other primaries, as an OpenEXR file names them, in those of sRGB."""
    if primaries is None:
        return light
    try:
        matrix = primaries_to_srgb(primaries)
    except ValueError:  # they make no sense
        return light
    return light if np.abs(matrix - np.eye(3)).max() < 1e-3 else (matmul(light, matrix.T)).astype(np.float32)


def unpremultiplied(colors: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """[H, W, 3] colours that were multiplied by alpha [H, W], without it; 0 where alpha is 0."""
    return np.where(alpha[..., None] > 0, colors / np.maximum(alpha, 1e-6)[..., None], 0).astype(colors.dtype)


def _alpha(image: Image) -> np.ndarray | None:
    if not image.has_transparency_data:
        return None
    alpha = np.asarray(image.convert("RGBA").getchannel("A"), np.float32) / 255
    return None if alpha.min() == 1 else alpha


def _srgb(image: Image, profile: bytes | None) -> tuple[Image, str]:
    """(8-bit RGB picture, a note or "")."""
    kinds = {"RGB": "RGB", "L": "L", "CMYK": "CMYK", "LAB": "LAB", "LA": "L", "La": "L", "1": "L", "YCbCr": "YCbCr"}
    if image.mode in ("LA", "La", "RGBA", "RGBa", "PA", "P"):
        # Straight colours first: what lies under transparent pixels does not matter, half-transparent ones do.
        image = image.convert("RGBA")
    base = image.convert(kinds.get(image.mode, "RGB"))
    if not profile:
        return base.convert("RGB"), ""
    from PIL import ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if getattr(source.profile, "xcolor_space", "").strip() == "GRAY":
            base = base.convert("L")
        intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
        flags = ImageCms.Flags.BLACKPOINTCOMPENSATION
        turn = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), base.mode, "RGB", intent, flags)
        # Profiles of sRGB come in many spellings; converting would only round.
        if base.mode == "RGB" and _same(turn):
            return base, ""
        converted = ImageCms.applyTransform(base, turn)
    except (ImageCms.PyCMSError, ValueError, TypeError, OSError):
        return base.convert("RGB"), f"{UNUSABLE}; its colours are taken as sRGB"
    assert converted is not None
    name = ImageCms.getProfileDescription(source).strip() or "embedded"
    return converted, f"converted from its colour profile ({name}) to sRGB"


def _same(turn: object) -> bool:
    """Whether a transform to sRGB leaves a ramp of colours where it was."""
    from PIL import Image, ImageCms

    steps = np.linspace(0, 255, 9).astype(np.uint8)
    ramp = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(27, 27, 3)
    out = ImageCms.applyTransform(Image.fromarray(ramp), turn)  # type: ignore[arg-type]
    return bool(np.abs(np.asarray(out).astype(int) - ramp).max() <= MAX_PROFILE_DIFFERENCE)
