"""PlayCanvas SOG version 2: meta.json and lossless WebP images, one pixel a row, in a .sog bundle (zip) or a folder.

    means_l, means_u   R G B: low and high byte of 16-bit x y z between meta.means.mins and maxs, in log space:
                       position = sign(v) (exp(|v|) - 1)
    quats              R G B: the three smaller components, (byte / 255 * 2 - 1) / sqrt(2), in the order w x y z without
                       the largest; A: 252 + which of w x y z is the largest (and positive)
    scales             R G B: entries of a 256-entry codebook of log-scales
    sh0                R G B: entries of a 256-entry codebook of SH degree-0 coefficients; A: opacity * 255
    shN_labels         R + 256 G: entry of the palette of SH bands 1 to meta.shN.bands
    shN_centroids      the palette, 64 entries a line, one pixel per coefficient, R G B: entries of a third codebook

Rows run left to right, top to bottom; pixels beyond meta.count mean nothing. The frame is that of PLY files.
Antialiased: `antialias` true or `model` "antialiased" in meta.json. Linear colours: our own note in `extras`.

Writing over a source of this format keeps the pixels of every value that did not change, and whole files where a plane
did not change; how changed values find room in the codebooks is told in sog_encode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter import jsonio
from splatpainter.io import planes, raw, sog_files
from splatpainter.io.bounded import allow, allow_rows
from splatpainter.jsonio import brief, integer, object_at
from splatpainter.splats import Source, Splats

BANDS = {1: 3, 2: 8, 3: 15}
"""meta.shN.bands -> coefficients above degree 0."""
PALETTE_LINE = 64
MAX_PALETTE = 65536
"""Entries that a label of two bytes can name."""
BLOCK = 1 << 16
"""Rows decoded at a time, to bound the float64 intermediates."""
EXTRAS = "splatpainter"
PLANES = {
    "means": ("means_l", "means_u"),
    "quats": ("quats",),
    "scales": ("scales",),
    "sh0": ("sh0",),
    "shN": ("palette", "labels"),
}
"""Part of meta.json -> what its files are, in its order."""


@dataclass(frozen=True)
class SogFile:
    """What a SOG asset held, enough to keep what did not change."""

    container: sog_files.Container
    meta: dict[str, Any]
    pixels: dict[str, np.ndarray]
    """means_l, means_u, quats, scales, sh0, labels -> uint8 [N, 4]."""
    shape: tuple[int, int]
    """Height, width of the planes."""
    codebooks: dict[str, np.ndarray]
    """scales, sh0, shN -> float64 [<= 256]."""
    palette: np.ndarray | None
    """[P, K - 1, 3] uint8 entries of the shN codebook."""


def read_sog(path: Path) -> Splats:
    """Read a .sog bundle, a folder, or a folder's meta.json.

    Raises ValueError: damaged zip, image or JSON, sizes that do not fit together, SOG version 1.
    """
    container, meta = sog_files.load(path)
    problems: list[str] = []
    file = _parse(container, meta, path, problems)
    with np.errstate(over="ignore", invalid="ignore"):  # such rows are reported below
        rows = _decode(file, path, problems)
    problems += raw.oddities(rows)
    source = Source(str(path), "sog", rows, container.sha256, file, tuple(problems))
    return replace(rows, source=source, origin=np.arange(len(rows)))


def write_sog(path: Path, splats: Splats) -> None:
    """Write a bundle (name ending in .sog) or a folder (its meta.json, or an existing folder).

    Raises ValueError: no rows, SH above degree 3, other names.
    """
    from splatpainter.io import sog_encode
    from splatpainter.io.reuse import kept

    splats = splats.numpy()
    if not len(splats):
        raise ValueError(f"{path}: SOG cannot hold an asset of 0 rows; write .ply instead")
    if splats.sh_degree > 3:
        raise ValueError(f"{path}: SOG holds SH up to degree 3, got {splats.sh_degree}; write .ply or .spz instead")
    same = kept(splats, "sog")
    old: SogFile | None = splats.source.detail if same and splats.source else None
    if old and same and same.identity:
        sog_files.store(path, old.container.files, old.container.whole)
    else:
        sog_files.store(path, sog_encode.encode(splats, same, old))


def _parse(container: sog_files.Container, meta: dict[str, Any], path: Path, problems: list[str]) -> SogFile:
    if meta.get("version") != 2:
        found = brief(meta["version"]) if "version" in meta else "none"
        raise ValueError(f"{path}: expected SOG version 2, found {found}; convert older files with splat-transform")
    count = integer(meta.get("count"), path, "the row count in meta.json", 1)
    named = {part: _listed_files(meta, part, len(keys), path) for part, keys in PLANES.items() if part != "shN"}
    if meta.get("shN") is not None:
        named["shN"] = _listed_files(meta, "shN", len(PLANES["shN"]), path)
    # Everything that can be known without decoding an image comes first: refusing then costs nothing.
    mean_range(meta, path)
    codebooks = {part: _codebook(meta, part, path, problems) for part in ("scales", "sh0", "shN") if part in named}
    listed = {key: name for part, names in named.items() for key, name in zip(PLANES[part], names, strict=True)}
    if len(set(listed.values())) < len(listed):  # an edit of one plane would change the other
        raise ValueError(f"{path}: expected an image of its own for each plane, meta.json names one twice")
    sizes = {key: _plane_size(container, key, name, count, path) for key, name in listed.items()}
    total = sum(map(len, container.files.values()))
    coefficients = 1 + sizes["palette"][0] // PALETTE_LINE if "palette" in sizes else 1
    allow_rows(total, count, coefficients, path)
    allow(total, sum(4 * width * height for width, height in sizes.values()), path, f"{len(sizes)} images")
    bands = _palette_bands(meta, sizes["palette"], path) if "palette" in sizes else (0, 0)
    pixels = {key: planes.decode(container.files[name], f"{path}: {listed[key]}") for key, name in listed.items()}
    shape = pixels["means_l"].shape[:2]
    palette = None
    if "palette" in pixels:
        palette = pixels.pop("palette").reshape(-1, BANDS[bands[0]], 4)[: bands[1], :, :3]
    rows = {key: image.reshape(-1, 4)[:count] for key, image in pixels.items()}
    _check_entries(codebooks, rows, palette, path)
    return SogFile(container, meta, rows, shape, codebooks, palette)


def _listed_files(meta: dict[str, Any], part: str, count: int, path: Path) -> list[str]:
    listed = object_at(meta, part, path).get("files")
    if not isinstance(listed, list) or len(listed) < count:
        raise ValueError(f"{path}: expected {count} files for {part} in meta.json, found {brief(listed)}")
    return listed[:count]  # every one a name that is there: sog_files has checked


def _plane_size(container: sog_files.Container, key: str, name: str, count: int, path: Path) -> tuple[int, int]:
    """Width and height that an image declares, judged by the row count."""
    where = f"{path}: {name}"
    width, height = planes.size(container.files[name], where)
    least = 1 if key == "palette" else count
    if width * height < least:
        raise ValueError(f"{where}: expected at least {least} pixels, found {width} x {height}")
    # Planes are padded to a rectangle, not to a multiple of their size.
    if width * height > (MAX_PALETTE * BANDS[3] if key == "palette" else 4 * count + 65536):
        raise ValueError(f"{where}: {width} x {height} pixels are too many for {count} rows")
    return width, height


def _numbers(values: Any, what: str, path: Path) -> np.ndarray:
    return jsonio.finite_numbers(values, path, f"{what} in meta.json")


def _codebook(meta: dict[str, Any], part: str, path: Path, problems: list[str]) -> np.ndarray:
    values = object_at(meta, part, path).get("codebook")
    if isinstance(values, list) and len(values) == 256 and values[0] is None:
        # An early encoder wrote null there; the PlayCanvas engine extrapolates the entry in this way.
        rest = _numbers(values[1:], f"{part}.codebook", path)
        problems.append(f"the {part} codebook begins with null; its first entry is extrapolated")
        return np.concatenate([[rest[0] + (rest[0] - rest[-1]) / 255], rest])
    codebook = _numbers(values, f"{part}.codebook", path)
    if not 1 <= len(codebook) <= 256:
        raise ValueError(f"{path}: expected 256 entries in the {part} codebook, found {len(codebook)}")
    return codebook


def _palette_bands(meta: dict[str, Any], size: tuple[int, int], path: Path) -> tuple[int, int]:
    """(SH bands, entries) of a palette image of width, height, by meta.shN."""
    width, height = size
    by_width = {PALETTE_LINE * count: bands for bands, count in BANDS.items()}
    bands = meta["shN"].get("bands", by_width.get(width))
    if type(bands) is not int or bands not in BANDS or width != PALETTE_LINE * BANDS[bands]:
        raise ValueError(f"{path}: a palette of {width} pixels a line does not fit {brief(bands)} SH bands")
    count = meta["shN"].get("count", height * PALETTE_LINE)
    if type(count) is not int or not 1 <= count <= min(height * PALETTE_LINE, MAX_PALETTE):
        raise ValueError(f"{path}: a palette of {height} lines does not hold {brief(count)} entries")
    return bands, count


def _check_entries(books: dict[str, np.ndarray], pixels: dict[str, np.ndarray], palette: Any, path: Path) -> None:
    for part, codes in (("scales", pixels["scales"][:, :3]), ("sh0", pixels["sh0"][:, :3]), ("shN", palette)):
        if codes is not None and int(codes.max()) >= len(books[part]):
            found, size = int(codes.max()), len(books[part])
            raise ValueError(f"{path}: a pixel names entry {found} of the {part} codebook, which has {size}")


def _decode(file: SogFile, path: Path, problems: list[str]) -> Splats:
    low, high = mean_range(file.meta, path)
    scales, base = raw.exp(file.codebooks["scales"]), file.codebooks["sh0"].astype(np.float32)
    table = np.zeros((1, 0, 3), np.float32)
    if file.palette is not None:
        table = file.codebooks["shN"].astype(np.float32)[file.palette]
    antialiased, linear = flags(file.meta)
    count = len(file.pixels["means_l"])
    out = Splats(
        np.empty((count, 3), np.float32),
        np.empty((count, 4), np.float32),
        np.empty((count, 3), np.float32),
        np.empty(count, np.float32),
        np.empty((count, 1 + table.shape[1], 3), np.float32),
        antialiased=antialiased,
        color_space="linear" if linear else "srgb",
    )
    unturned, missing = 0, 0
    for start in range(0, count, BLOCK):
        block = slice(start, start + BLOCK)
        pixels = {key: values[block] for key, values in file.pixels.items()}
        words = pixels["means_l"][:, :3].astype(np.float64) + 256.0 * pixels["means_u"][:, :3]
        logs = low + (high - low) * (words / 65535)
        out.means[block] = np.sign(logs) * np.expm1(np.abs(logs))
        out.quats[block] = unpack_quats(pixels["quats"])
        unturned += int((pixels["quats"][:, 3] < 252).sum())
        out.scales[block] = scales[pixels["scales"][:, :3]]
        out.opacities[block] = pixels["sh0"][:, 3].astype(np.float64) / 255
        out.sh[block, 0] = base[pixels["sh0"][:, :3]]
        if file.palette is not None:
            labels = pixels["labels"][:, 0].astype(np.int64) + 256 * pixels["labels"][:, 1].astype(np.int64)
            wrong = labels >= len(table)
            out.sh[block, 1:] = table[np.where(wrong, 0, labels)]
            out.sh[block, 1:][wrong] = 0
            missing += int(wrong.sum())
    if unturned:
        problems.append(f"rows without a valid rotation, not turned: {unturned}")
    if missing:
        problems.append(f"rows that name a missing SH palette entry, bands set to 0: {missing}")
    if file.meta.get("model") not in (None, "default", "antialiased"):
        problems.append(f"made for the splat model {brief(file.meta['model'])}; shown as ordinary Gaussians")
    return out


def mean_range(meta: dict[str, Any], path: Path | str = "meta.json") -> tuple[np.ndarray, np.ndarray]:
    """[3] lowest and highest log-space position; equal ones mean a range of 1, as in other readers."""
    means = object_at(meta, "means", path)
    low, high = (_numbers(means.get(key), f"means.{key}", Path(path)) for key in ("mins", "maxs"))
    if low.shape != (3,) or high.shape != (3,):
        raise ValueError(f"{path}: expected 3 numbers in means.mins and means.maxs")
    return low, np.where(high == low, low + 1, high)


def flags(meta: dict[str, Any]) -> tuple[bool, bool]:
    """(antialiased, linear colours)."""
    extras = meta.get("extras")
    ours = extras.get(EXTRAS) if isinstance(extras, dict) else None
    linear = isinstance(ours, dict) and ours.get("color_space") == "linear"
    return meta.get("antialias") is True or meta.get("model") == "antialiased", linear


def unpack_quats(pixels: np.ndarray) -> np.ndarray:
    """[N, 4] pixels -> [N, 4] w, x, y, z; a tag below 252 is no rotation."""
    small = (pixels[:, :3].astype(np.float64) / 255 * 2 - 1) / math.sqrt(2)
    largest = np.maximum(pixels[:, 3].astype(np.int64) - 252, 0)
    quats = np.zeros((len(pixels), 4))
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    np.put_along_axis(quats, others, small, 1)
    np.put_along_axis(quats, largest[:, None], np.sqrt(np.maximum(0, 1 - (small * small).sum(1)))[:, None], 1)
    quats[pixels[:, 3] < 252] = (1, 0, 0, 0)
    return quats.astype(np.float32)
