"""What a file says of its colours, as numbers: primaries and a curve that lead to light, and from there to sRGB.

PNG says it in four kinds of chunks, of which the first that is understood counts (W3C PNG, third edition, 4.3): cICP
(code points of ITU-T H.273), iCCP (an ICC profile), sRGB, gAMA with cHRM. ICC profiles of a matrix and curves (ICC.1,
8.3) are read here where a picture has more than the 8 bits of Pillow's colour management; other profiles are
Pillow's. All whites become sRGB's (Bradford). Pure, but for reading the head of a file.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np

from splatpainter.color import linear_to_srgb, srgb_to_linear
from splatpainter.image_files import PNG_MAGIC
from splatpainter.kernels.portable import determinant, interp, inverse, matmul, power
from splatpainter.system.quick_dataclass import dataclass

Curve: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""Stored value 0..1 -> light."""
MAX_CHUNKS = 1024
"""Chunks of a PNG that are looked at ahead of its pixels."""
SRGB_GAMMA, MAX_GAMMA_ERROR = 45455, 0.01
"""gAMA of files that are sRGB (its fifth decimals times 100,000), and the part by which one may differ and still say
so: programs write 45454, 45455 and 45459."""
MAX_SAME_DIFFERENCE = 2 / 255
"""Largest change of a colour up to which a statement says sRGB."""
CHROMATICITIES: dict[int, tuple[float, ...]] = {
    1: (0.3127, 0.3290, 0.640, 0.330, 0.300, 0.600, 0.150, 0.060),
    4: (0.310, 0.316, 0.67, 0.33, 0.21, 0.71, 0.14, 0.08),
    5: (0.3127, 0.3290, 0.64, 0.33, 0.29, 0.60, 0.15, 0.06),
    6: (0.3127, 0.3290, 0.630, 0.340, 0.310, 0.595, 0.155, 0.070),
    7: (0.3127, 0.3290, 0.630, 0.340, 0.310, 0.595, 0.155, 0.070),
    9: (0.3127, 0.3290, 0.708, 0.292, 0.170, 0.797, 0.131, 0.046),
    11: (0.314, 0.351, 0.680, 0.320, 0.265, 0.690, 0.150, 0.060),
    12: (0.3127, 0.3290, 0.680, 0.320, 0.265, 0.690, 0.150, 0.060),
    22: (0.3127, 0.3290, 0.630, 0.340, 0.295, 0.605, 0.155, 0.077),
}
"""ITU-T H.273, table 2: x and y of white, red, green, blue by ColourPrimaries."""
PRIMARIES_NAMES = {1: "BT.709", 9: "BT.2020", 11: "DCI-P3", 12: "Display P3"}
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
D50 = np.array([0.9642, 1.0, 0.8249])
"""White of ICC profiles, XYZ."""
MAX_CURVE = 1 << 16
"""Entries of a curve of an ICC profile."""


@dataclass(frozen=True)
class ColorStatement:
    """What a file says of its colours."""

    name: str
    """For notes: "cICP, Display P3"."""
    matrix: np.ndarray
    """[3, 3] linear light of its primaries to that of sRGB's."""
    curves: tuple[Curve, ...]
    """Of red, green, blue; one for all."""

    def to_srgb(self, colors: np.ndarray) -> np.ndarray:
        """[..., 3] stored values 0..1 as display sRGB 0..1; float32."""
        curves = self.curves if len(self.curves) == 3 else self.curves * 3
        # Curves first, then the matrix: primaries mix light, not stored values.
        light = np.stack([curve(colors[..., k].astype(np.float64)) for k, curve in enumerate(curves)], -1)
        return linear_to_srgb(np.clip(matmul(light, self.matrix.T), 0, 1)).astype(np.float32)

    def from_srgb(self, colors: np.ndarray) -> np.ndarray:
        """[..., 3] display sRGB 0..1 as stored values 0..1, cut to what can be stored; float64."""
        light = matmul(srgb_to_linear(np.clip(colors, 0, 1).astype(np.float64)), inverse(self.matrix).T)
        curves = self.curves if len(self.curves) == 3 else self.curves * 3
        levels = np.linspace(0, 1, 4096)
        # Curves rise, so that a table backwards is their inverse, to far less than a level of 8 bits.
        return np.stack([interp(light[..., k], curve(levels), levels) for k, curve in enumerate(curves)], -1)

    @property
    def is_srgb(self) -> bool:
        """Whether it leaves a ramp of colours where it was."""
        # A statement is judged by what it does, not by how it is written: there are dozens of spellings of sRGB.
        steps = np.linspace(0, 1, 9)
        ramp = np.stack(np.meshgrid(steps, steps, steps), -1)
        return bool(np.abs(self.to_srgb(ramp) - ramp).max() <= MAX_SAME_DIFFERENCE)


@dataclass(frozen=True)
class PngColors:
    """The statement of a PNG that counts."""

    statement: ColorStatement | None = None
    """None: sRGB, or nothing is said, or `profiled`."""
    profiled: bool = False
    """Whether it is the ICC profile that counts."""
    notes: tuple[str, ...] = ()
    """What could not be understood."""


def png_colors(path: Path, profile: bool = True) -> PngColors:
    """What a PNG says of its colours. profile: whether an ICC profile in it counts; not where it cannot be used. Raises
    ValueError: light beyond white (PQ, HLG), which has no sRGB."""
    chunks, notes = _chunks(path), []
    bits = chunks[b"IHDR"][8] if len(chunks.get(b"IHDR", b"")) == 13 else 8
    # In the standard's order of precedence; the first kind that is understood counts.
    if b"cICP" in chunks:
        statement, note = _cicp(chunks[b"cICP"], bits, path)
        if statement is not None:
            return PngColors(None if statement.is_srgb else statement)
        notes.append(note)
    if b"iCCP" in chunks and profile:
        return PngColors(profiled=True, notes=tuple(notes))
    if b"sRGB" in chunks:
        return PngColors(notes=tuple(notes))
    statement, note = _gamma_and_primaries(chunks)
    if note:
        notes.append(note)
    return PngColors(None if statement is None or statement.is_srgb else statement, notes=tuple(notes))


def _chunks(path: Path) -> dict[bytes, bytes]:
    """The chunks of a PNG about colour ahead of its pixels, the first of each kind."""
    kinds, out = (b"IHDR", b"cICP", b"iCCP", b"sRGB", b"gAMA", b"cHRM"), {}
    with open(path, "rb") as file:
        if file.read(8) != PNG_MAGIC:
            return {}
        for _ in range(MAX_CHUNKS):
            head = file.read(8)
            if len(head) < 8:
                break
            size, kind = struct.unpack(">I4s", head)
            # Statements have to stand before the pixels; nothing behind them is looked at.
            if kind in (b"IDAT", b"IEND"):
                break
            if kind in kinds:
                # None of these chunks needs more bytes (a profile is read by Pillow); a claimed size allocates nothing.
                body = file.read(min(size, 64))
                out.setdefault(kind, body)
                file.seek(size - len(body) + 4, 1)
            else:
                file.seek(size + 4, 1)
    return out


def _cicp(body: bytes, bits: int, path: Path) -> tuple[ColorStatement | None, str]:
    if len(body) != 4:
        return None, "its cICP chunk is damaged and was left out"
    primaries, transfer, matrix, full = body
    if transfer in HDR_TRANSFERS:
        raise ValueError(
            f"{path}: its cICP chunk says {HDR_TRANSFERS[transfer]}, light beyond white; expected sRGB, save it so"
        )
    curve = TRANSFERS.get(transfer)
    if curve is None or primaries not in CHROMATICITIES or matrix != 0 or full > 1:
        code = "/".join(map(str, body))
        return None, f"its cICP chunk ({code}) says colours that are not read here and was left out"
    # Limited range: video levels, at the picture's own number of bits.
    if not full:
        step = 2.0 ** (bits - 8)
        curve = _of_range(curve, 16 * step / (2.0**bits - 1), 219 * step / (2.0**bits - 1))
    name = f"cICP, {PRIMARIES_NAMES.get(primaries, f'primaries {primaries}')}"
    return ColorStatement(name, primaries_to_srgb(CHROMATICITIES[primaries]), (curve,)), ""


def _gamma_and_primaries(chunks: dict[bytes, bytes]) -> tuple[ColorStatement | None, str]:
    gamma, primaries = chunks.get(b"gAMA"), chunks.get(b"cHRM")
    names, curve, matrix, value = [], srgb_to_linear, np.eye(3), 0
    if gamma is not None:
        (value,) = struct.unpack(">I", gamma) if len(gamma) == 4 else (0,)
        if not 1000 <= value <= 10_000_000:
            return None, "its gAMA chunk makes no sense; its colours are taken as sRGB"
    if primaries is not None:
        try:
            matrix = primaries_to_srgb([value / 100_000 for value in struct.unpack(">8I", primaries)])
        except (struct.error, ValueError):
            return None, "its cHRM chunk makes no sense; its colours are taken as sRGB"
    if gamma is not None:
        # 1/2.2 in gAMA is how programs say sRGB's curve, which is no power, as Display P3's; Adobe RGB's is one.
        adobe = np.abs(matrix - adobe_rgb().matrix).max() <= MAX_SAME_DIFFERENCE
        if abs(value / SRGB_GAMMA - 1) > MAX_GAMMA_ERROR or adobe:
            names.append(f"gAMA {value}")
            curve = _power(100_000 / value)
    if primaries is not None:
        names.append("cHRM")
    return (ColorStatement(" and ".join(names), matrix, (curve,)), "") if names else (None, "")


def adobe_rgb() -> ColorStatement:
    """Adobe RGB (1998) Color Image Encoding, 4.2 and 4.3.5.2, as EXIF says it."""
    chromaticities = (0.3127, 0.3290, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06)
    return ColorStatement("EXIF, Adobe RGB", primaries_to_srgb(chromaticities), (_power(563 / 256),))


def exif_colors(color_space: object, interoperability: object) -> ColorStatement | None:
    """What EXIF says where no profile does: Adobe RGB by ColorSpace 2, or 65535 with interoperability R03 (DCF 2.0,
    option files); None: sRGB, or nothing that is understood."""
    if color_space == 2 or (color_space == 65535 and str(interoperability).strip("\0 ") == "R03"):
        return adobe_rgb()
    return None


def _power(exponent: float) -> Curve:
    return lambda values: power(np.clip(values, 0, None), exponent)


def _of_range(curve: Curve, black: float, span: float) -> Curve:
    return lambda values: curve(np.clip((values - black) / span, 0, 1))


def _bt709(values: np.ndarray) -> np.ndarray:
    """The inverse of ITU-R BT.709's curve."""
    return np.where(values < 0.081, values / 4.5, power((np.maximum(values, 0) + 0.099) / 1.099, 1 / 0.45))


TRANSFERS: dict[int, Curve] = {
    1: _bt709,
    4: _power(2.2),
    5: _power(2.8),
    6: _bt709,
    8: lambda values: values,
    13: srgb_to_linear,
    14: _bt709,
    15: _bt709,
}
"""ITU-T H.273, table 3: light by TransferCharacteristics."""


def _xyz(x: float, y: float) -> np.ndarray:
    if not (y > 1e-4 and x >= 0 and x + y <= 1.0001):
        raise ValueError("no chromaticity")
    return np.array([x / y, 1, (1 - x - y) / y])


def _to_xyz(chromaticities: tuple[float, ...] | list[float]) -> np.ndarray:
    """[3, 3] light of primaries to XYZ; white has Y = 1. chromaticities: x, y of white, red, green, blue. Raises
    ValueError: they span nothing."""
    white, *colors = (_xyz(*chromaticities[k : k + 2]) for k in range(0, 8, 2))
    # Scaled so that equal parts of all three make the stated white.
    basis = np.stack(colors, 1)
    if abs(determinant(basis)) < 1e-4:
        raise ValueError("primaries on a line")
    return basis * matmul(inverse(basis), white)


def _adapted(white: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[3, 3] XYZ under a white to XYZ under another one."""
    # Von Kries in Bradford's cone space, as ICC and CSS adapt whites.
    gains = matmul(BRADFORD, target) / matmul(BRADFORD, white)
    return matmul(inverse(BRADFORD), gains[:, None] * BRADFORD)


def primaries_to_srgb(chromaticities: tuple[float, ...] | list[float]) -> np.ndarray:
    srgb = CHROMATICITIES[1]
    adapted = _adapted(_xyz(*chromaticities[:2]), _xyz(*srgb[:2]))
    return matmul(matmul(inverse(_to_xyz(srgb)), adapted), _to_xyz(chromaticities))


# ---- ICC profiles of a matrix and curves


def matrix_profile(profile: bytes) -> ColorStatement | None:
    """An ICC profile of RGB that is a matrix and three curves; None of any other, or a damaged one."""
    try:
        if profile[16:20] != b"RGB " or profile[20:24] != b"XYZ ":
            return None
        tags = _tags(profile)
        # A profile with tables means these, not its matrix.
        if any(tag in tags for tag in (b"A2B0", b"A2B1")):
            return None
        columns = [np.array(struct.unpack_from(">3i", tags[name], 8)) / 65536 for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
        curves = tuple(_icc_curve(tags[name]) for name in (b"rTRC", b"gTRC", b"bTRC"))
        srgb = CHROMATICITIES[1]
        to_srgb = matmul(inverse(_to_xyz(srgb)), _adapted(D50, _xyz(*srgb[:2])))
        matrix = matmul(to_srgb, np.stack(columns, 1))
        return ColorStatement("embedded", matrix, curves) if np.isfinite(matrix).all() else None
    except (KeyError, struct.error, ValueError, IndexError):
        return None


def _tags(profile: bytes) -> dict[bytes, bytes]:
    (count,) = struct.unpack_from(">I", profile, 128)
    out = {}
    # A count from the file bounds nothing by itself.
    for k in range(min(count, 100)):
        name, offset, size = struct.unpack_from(">4sII", profile, 132 + 12 * k)
        out[name] = profile[offset : offset + size]
    return out


def _icc_curve(tag: bytes) -> Curve:
    """ICC.1, 10.6 and 10.18. Raises ValueError, struct.error: none of them."""
    kind = tag[:4]
    if kind == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if count == 0:
            return lambda values: values
        if count == 1:
            return _power(struct.unpack_from(">H", tag, 12)[0] / 256)
        if count > MAX_CURVE:
            raise ValueError("a curve of too many entries")
        table = np.array(struct.unpack_from(f">{count}H", tag, 12)) / 65535
        positions = np.linspace(0, 1, count)
        return lambda values: interp(values, positions, table)
    if kind != b"para":
        raise ValueError("no curve")
    (function,) = struct.unpack_from(">H", tag, 8)
    # Parameters in the order of the standard; types 0 to 4 have 1, 3, 4, 5 and 7 of them.
    g, *rest = (value / 65536 for value in struct.unpack_from(f">{(1, 3, 4, 5, 7)[function]}i", tag, 12))
    a, b, c, d, e, f = (*rest, *(1, 0, 0, 0, 0, 0)[len(rest) :])
    if function == 0:
        return _power(g)
    if function in (1, 2):
        offset = c if function == 2 else 0.0
        return lambda values: np.where(a * values + b >= 0, power(np.maximum(a * values + b, 0), g), 0) + offset
    e, f = (e, f) if function == 4 else (0.0, 0.0)
    return lambda values: np.where(values >= d, power(np.maximum(a * values + b, 0), g) + e, c * values + f)
