"""Environments: pictures of the light from all around, as files, as spherical harmonics, and as names.

Lat-long (equirectangular), y up: column u = atan2(x, -z) / 2 pi (mod 1), row v = acos(y) / pi, so that the middle of
the picture is +z. Linear radiance. OpenImageIO reads what has more than 8 bits.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from splatpainter import image_files
from splatpainter.color import srgb_to_linear
from splatpainter.kernels import portable
from splatpainter.system.atomic import writing
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import sh_basis

DEEP = {".hdr": "hdr", ".exr": "openexr"}
"""Ending -> OpenImageIO's name of the format."""
DISPLAY = (".png", ".jpg", ".jpeg", ".webp")
"""Endings of pictures that end at white."""
MAX_PIXELS = 1 << 27
"""Most pixels of an environment; a larger size in its header is a fault of the file."""
MAX_BAD_SHARE = 0.01
"""Largest share of pixels that are not finite or negative; an environment with more is refused."""
SMALL_LAMPS = 99.9
"""Percentile of an environment's values to which the rest is limited: the few pixels of a sun or a lamp, stored by some
cameras in full and clipped by most, would else decide its whole light, which SH of degree 2 cannot hold anyway."""
MAX_ASPECT_ERROR = 0.1
"""By which a lat-long picture's width over height may miss 2."""


@dataclass(frozen=True)
class SkyMap:
    """Light from all around."""

    radiance: np.ndarray
    """[h, w, 3] float32, linear, lat-long."""
    name: str
    note: str = ""
    """What users should know of it."""
    path: str = ""
    """Its file; empty where it was computed."""

    def coefficients(self) -> np.ndarray:
        """[9, 3] float64 projection on real SH of degree 2, in the sky's axes (y up, +z in the middle), scaled so that
        the mean radiance is 1, over all channels: exposures of pictures and of environments are arbitrary. Of such
        light an open white surface sends back 1 in the mean over its directions."""
        picture = self.radiance.astype(np.float64)
        towards, areas = lat_long(*picture.shape[:2])
        # By solid angle: rows near the poles have as many pixels, and are much smaller.
        weighted = (sh_basis(towards, 2) * areas[..., None]).reshape(-1, 9)
        sums = portable.transposed_product(weighted, picture.reshape(-1, 3))
        mean = float(sums[0].mean()) / math.sqrt(4 * math.pi)
        return sums / mean


def lat_long(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """([h, w, 3] float64 unit directions of the centres of a lat-long picture's pixels, [h, w] their solid angles)."""
    edges = portable.cos(np.linspace(0, math.pi, height + 1))
    areas = np.repeat(((edges[:-1] - edges[1:]) * (2 * math.pi / width))[:, None], width, 1)
    polar = (np.arange(height) + 0.5) * (math.pi / height)
    turn = (np.arange(width) + 0.5) * (2 * math.pi / width)
    ring = portable.sin(polar)[:, None]
    x, y, z = ring * portable.sin(turn), np.repeat(portable.cos(polar)[:, None], width, 1), -ring * portable.cos(turn)
    return np.stack([x, y, z], -1), areas


def read_sky(path: str | Path, full_range: bool = False) -> SkyMap:
    """An environment of a file: .hdr or .exr, or a display picture (PNG, JPEG, WebP), with a note that it ends at
    white. full_range: with suns and lamps as bright as they are stored, beyond SMALL_LAMPS.

    Raises ValueError, one line that names the file: none of these, damaged, not twice as wide as high, black, more than
    MAX_BAD_SHARE pixels that are NaN, infinite or negative."""
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in (*DEEP, *DISPLAY):
        kinds = ", ".join((*DEEP, *DISPLAY))
        raise ValueError(f"{path}: expected an environment ({kinds}), got {path.suffix or 'no suffix'}")
    note = ""
    if ending in DEEP:
        picture = read_radiance(path)
        # Some cameras clip a sun and some store it in full: the light should not depend on which.
        limit = np.percentile(picture, SMALL_LAMPS)
        if limit > 0 and not full_range:
            picture = np.minimum(picture, np.float32(limit))
    else:
        from splatpainter.pictures.picture_reader import read_picture

        picture = srgb_to_linear(read_picture(path).colors.clip(0, 1)).astype(np.float32)
        note = f"{path.name} is a display picture: what was brighter than white is missing from its light"
        if not picture.any():
            raise ValueError(f"{path}: the environment is black")
    height, width = picture.shape[:2]
    if abs(width / height - 2) > 2 * MAX_ASPECT_ERROR:
        raise ValueError(f"{path}: expected a lat-long picture, twice as wide as high, got {width}x{height}")
    return SkyMap(picture, path.name, note, str(path))


def write_sky(path: str | Path, environment: SkyMap) -> None:
    """Writes .hdr (Radiance, 8 bits with an exponent for each pixel) or .exr (float32, needs OpenImageIO). Raises
    ValueError: another suffix."""
    path = Path(path)
    suffix, picture = path.suffix.lower(), np.maximum(environment.radiance.astype(np.float32), 0)
    height, width = picture.shape[:2]
    if suffix == ".exr":
        image_files.require_deep(f"{path}: writing light")
        data = image_files.encode_exr(picture, ("R", "G", "B"))
        with writing(path) as file:
            file.write(data)
        return
    if suffix != ".hdr":
        raise ValueError(f"{path}: expected an environment (.hdr, .exr), got {suffix or 'no suffix'}")
    # RGBE of G. Ward, "Real Pixels" (Graphics Gems II, 1991), pixels one after the other.
    _, exponent = np.frexp(picture.max(2))
    scale = np.where(picture.max(2) > 1e-32, np.ldexp(np.float32(256), -exponent), 0)
    pixels = np.empty((height, width, 4), np.uint8)
    pixels[..., :3] = np.minimum(picture * scale[..., None], 255)
    pixels[..., 3] = np.where(scale > 0, exponent + 128, 0)
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    with writing(path) as file:
        file.write(head.encode() + pixels.tobytes())


def read_radiance(path: Path) -> np.ndarray:
    """[h, w, 3] float32, linear, from .hdr (Radiance) or .exr. Pixels that are not finite or negative become 0.

    Raises ValueError, one line that names the file: more than MAX_BAD_SHARE such pixels, all black, no such picture."""
    if path.suffix.lower() not in DEEP:
        raise ValueError(f"{path}: expected an environment (.hdr or .exr), got {path.suffix or 'no suffix'}")
    pixels = read_samples(path, str(path))
    pixels = np.repeat(pixels, 3, 2) if pixels.shape[2] < 3 else pixels[..., :3]
    # A few bad pixels are a fault of the camera, many are one of the file.
    bad = ~np.all(np.isfinite(pixels) & (pixels >= 0), axis=-1)
    if bad.mean() > MAX_BAD_SHARE:
        raise ValueError(
            f"{path}: {int(bad.sum())} of {bad.size} pixels are NaN, infinite or negative; repair the picture"
        )
    pixels = np.where(bad[..., None], np.float32(0), pixels).astype(np.float32)
    if not pixels.any():
        raise ValueError(f"{path}: the environment is black")
    return pixels


def read_samples(path: Path, where: str) -> np.ndarray:
    """[h, w, C] float32. Only the header is read before its size was judged."""
    if not path.is_file():
        raise ValueError(f"{where}: no such file")
    oiio = image_files.require_deep(f"{where}: reading light")
    format_name = DEEP[path.suffix.lower()]
    source = oiio.ImageInput.open(str(path))
    if source is None or source.format_name() != format_name:
        kind = "a Radiance .hdr" if format_name == "hdr" else "an OpenEXR"
        raise ValueError(f"{where}: is not {kind} picture ({_one_line(image_files.problem_of(oiio), path)})")
    try:
        # The header is judged before pixels are read: its size may be a lie of terabytes.
        spec = source.spec()
        if not 0 < spec.width * spec.height <= MAX_PIXELS:
            raise ValueError(
                f"{where}: expected 1 to {MAX_PIXELS:,} pixels, the header says {spec.width} x {spec.height}"
            )
        pixels = source.read_image(0, 0, 0, min(spec.nchannels, 4), "float")
        if pixels is None:
            raise ValueError(f"{where}: damaged picture ({_one_line(image_files.problem_of(source), path)})")
        return np.asarray(pixels, np.float32).reshape(spec.height, spec.width, -1)
    finally:
        source.close()


def _one_line(problem: str, path: Path) -> str:
    return " ".join(problem.replace(str(path), "").split())[:120] or "no reason given"
