"""PlayCanvas SOG version 2: meta.json and lossless WebP images, one pixel a row, in a .sog bundle (zip) or a folder.

    means_l, means_u   R G B: low and high byte of 16-bit x y z between meta.means.mins and maxs, in log space:
                       position = sign(v) (exp(|v|) - 1)
    quats              R G B: the three smaller components, (byte / 255 * 2 - 1) / sqrt(2), in the order w x y z without
                       the largest; A: 252 + which of w x y z is the largest (and positive)
    scales             R G B: entries of a 256-entry codebook of log-scales
    sh0                R G B: entries of a 256-entry codebook of SH degree-0 coefficients; A: opacity * 255
    shN_labels         R + 256 G: entry of the palette of SH bands 1 to meta.shN.bands
    shN_centroids      the palette, 64 entries a line, one pixel per coefficient, R G B: entries of a third codebook

Rows run left to right, top to bottom; pixels beyond meta.count mean nothing. The axes are those of PLY files.
Antialiased: `antialias` true or `model` "antialiased" in meta.json. Linear colours: our own note in `extras`.

New assets: positions take the range of the rows; scales, sh0 and the palette get fitted codebooks; SH vectors get a
palette of at least half as many entries as rows (at most 65536). Rows stay in their order, which we promise; rows in no
order at all pack 5-16 % worse than the Morton order that other encoders sort into.

Edited SOG assets: unchanged values keep their pixels, so they decode to the same bits. Changed values must find room in
what the file has:

- Positions use the file's range. Rows that leave it by less than two of their standard deviations are set on its
  border.
- Scales and sh0 use the file's codebook where an entry is near enough; entries that no unchanged pixel uses are moved
  to the values that lack one.
- SH vectors get new palette entries (a palette may have 65536) or take over unused ones.

Where that is not enough, the new values win, because painted colours that are lost cannot be brought back:
the codebook entries whose merging does least harm are merged, and only the rows that used them shift, to the next
entry; failing that, the codebook is fitted anew, and every row of that attribute is re-quantised. Positions outside of
the range re-quantise all positions (by less than a 65535th of the extent), too many new SH vectors re-fit the palette.
`verify` counts such rows as changed. Write PLY where every untouched row has to stay.
"""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.array_types import Bytes
from splatpainter.io.bounded import allow, allow_rows
from splatpainter.io.formats import activations, codebooks, packing
from splatpainter.io.formats.reuse import Unchanged, drawable_rows, row_problems, unchanged
from splatpainter.io.formats.sog_container import META, Container, load, named_files, store
from splatpainter.kernels import portable
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run, threads
from splatpainter.splats import SH_C0, SH_COUNTS, Source, Splats
from splatpainter.system import jsonio
from splatpainter.system.jsonio import brief, integer, object_at
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_norm

BANDS = {1: 3, 2: 8, 3: 15}
"""meta.shN.bands -> coefficients above degree 0."""
PALETTE_LINE = 64
MAX_PALETTE = 65536
"""Entries that a label of two bytes can name."""
MIN_ROWS_BY_WORD = 1 << 16
"""Rows beyond which positions are taken from a table of all 16-bit words."""
EXTRAS = "splatpainter"
PLANES = {
    "means": ("means_l", "means_u"),
    "quats": ("quats",),
    "scales": ("scales",),
    "sh0": ("sh0",),
    "shN": ("palette", "labels"),
}
"""Part of meta.json -> what its files are, in its order."""
COLOR_TOLERANCES = tuple(steps / 255 / SH_C0 for steps in (1, 2, 4))
"""How far a painted colour may be from its codebook entry, in 255ths of the display range: the tightest for which free
entries suffice, the last one when entries have to be merged."""
SCALE_TOLERANCES = tuple(math.log(ratio) for ratio in (1.03, 1.06, 1.12, 1.25))
SH_TOLERANCES = (0.01, 0.02, 0.04)
MAX_BORDER_SHIFT = 2.0
"""Standard deviations (its largest) by which a changed row may be moved to stay within the file's position range: a
child of a row on the border, moved this far, still lies within its parent."""


@dataclass(frozen=True)
class SogFile:
    """The contents of a SOG asset, enough to keep what did not change."""

    container: Container
    meta: dict[str, Any]
    pixels: dict[str, np.ndarray]
    """means_l, means_u, quats, scales, sh0, labels -> uint8 [N, 4]."""
    shape: tuple[int, int]
    """Height, width of the planes."""
    codebooks: dict[str, np.ndarray]
    """scales, sh0, shN -> float64 [<= 256]."""
    palette: Bytes | None
    """[P, K - 1, 3] uint8 entries of the shN codebook."""


def read_sog(path: Path) -> Splats:
    """Read a .sog bundle, a folder, or a folder's meta.json.

    Raises ValueError: damaged zip, image or JSON, sizes that do not fit together, SOG version 1.
    """
    container, meta = load(path)
    problems: list[str] = []
    if container.prefix:
        problems.append(f"the bundle's files lie in its folder {brief(container.prefix[:-1])}, where few programs look")
    file = _parse(container, meta, path, problems)
    with np.errstate(over="ignore", invalid="ignore"):  # such rows are reported below
        rows = _decode(file, path, problems)
    problems += row_problems(rows)
    source = Source(str(path), "sog", rows, container.sha256, file, tuple(problems))
    return replace(rows, source=source, origin=np.arange(len(rows)))


def _parse(container: Container, meta: dict[str, Any], path: Path, problems: list[str]) -> SogFile:
    if meta.get("version") != 2:
        version = brief(meta["version"]) if "version" in meta else "none"
        raise ValueError(f"{path}: expected SOG version 2, found {version}; convert older files with splat-transform")
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
    # A row has the same place in every plane; a plane that a program resized holds other rows' numbers there.
    by_size = {size: key for key, size in sizes.items() if key != "palette"}
    if len(by_size) > 1:
        two = ", ".join(f"{listed[key]} {width} x {height}" for (width, height), key in list(by_size.items())[:2])
        raise ValueError(f"{path}: expected planes of one size, found {two}; export it again")
    total = sum(map(len, container.files.values()))
    coefficients = 1 + sizes["palette"][0] // PALETTE_LINE if "palette" in sizes else 1
    allow_rows(total, count, coefficients, path)
    allow(total, sum(4 * width * height for width, height in sizes.values()), path, f"{len(sizes)} images")
    bands = _palette_bands(meta, sizes["palette"], path) if "palette" in sizes else (0, 0)
    images = packing.decode_images([(container.files[name], f"{path}: {name}") for name in listed.values()])
    pixels = dict(zip(listed, images, strict=True))
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
    return listed[:count]  # every one a name that is there: named_files has checked


def _plane_size(container: Container, key: str, name: str, count: int, path: Path) -> tuple[int, int]:
    """Width and height that an image declares, judged by the row count."""
    where = f"{path}: {name}"
    width, height = packing.image_size(container.files[name], where)
    min_pixels = 1 if key == "palette" else count
    if width * height < min_pixels:
        raise ValueError(f"{where}: expected at least {min_pixels} pixels, found {width} x {height}")
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
            highest, size = int(codes.max()), len(books[part])
            raise ValueError(f"{path}: a pixel names entry {highest} of the {part} codebook, which has {size}")


def _decode(file: SogFile, path: Path, problems: list[str]) -> Splats:
    # Codebooks are decoded once, their 256 entries instead of every row.
    low, high = mean_range(file.meta, path)
    scales, base = activations.exp(file.codebooks["scales"]), file.codebooks["sh0"].astype(np.float32)
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

    def positions(words: np.ndarray) -> np.ndarray:  # [N, 3] of 0..65535, signed logarithms
        logs = low + (high - low) * (words / 65535)
        with np.errstate(over="ignore", invalid="ignore"):  # such rows are reported by who reads
            return (np.sign(logs) * portable.expm1(np.abs(logs))).astype(np.float32)

    pixels = {key: readonly(values, np.uint8) for key, values in file.pixels.items()}
    # Of many rows every word comes again and again: all of them are decoded once.
    by_word = np.empty((0, 0), np.float32)
    if count > MIN_ROWS_BY_WORD:
        by_word = positions(np.arange(1 << 16, dtype=np.float64)[:, None]).T.copy()
    else:
        low_bytes, high_bytes = (pixels[key][:, :3].astype(np.int64) for key in ("means_l", "means_u"))
        out.means[:] = positions(low_bytes + 256 * high_bytes)
    # Rows without a rotation, and rows that name an entry which the palette of a damaged file has not.
    guessed = np.zeros((threads(), 2), np.int64)
    run(
        kernels.unpack_sog_rows,
        *(pixels[key] for key in ("means_l", "means_u", "quats", "scales", "sh0")),
        pixels.get("labels", np.empty((0, 4), np.uint8)),
        by_word, scales, base, table.reshape(len(table), -1),
        out.means, out.quats, out.scales, out.opacities, out.sh.reshape(count, -1), guessed,
    )  # fmt: skip
    invalid_rotations, missing = (int(number) for number in guessed.sum(0))
    # What had to be guessed is told; the rows stay.
    if invalid_rotations:
        problems.append(f"rows without a valid rotation, not turned: {invalid_rotations}")
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


# ---- writing


def write_sog(path: Path, splats: Splats, sh_palette: int | None = None) -> None:
    """Write a bundle (name ending in .sog) or a folder (its meta.json, or an existing folder). sh_palette: SH vectors
    that stand for those of all rows, at most; the palette is then fitted anew.

    Raises ValueError: no rows, SH above degree 3, other names.
    """
    # A file that nothing changed is written as the bytes that were read.
    splats = splats.numpy()
    if not len(splats):
        raise ValueError(f"{path}: SOG cannot hold an asset of 0 rows; write .ply instead")
    if splats.sh_degree > 3:
        raise ValueError(f"{path}: SOG holds SH up to degree 3, got {splats.sh_degree}; write .ply or .spz instead")
    same = unchanged(splats, "sog")
    old: SogFile | None = splats.source.detail if same and splats.source else None
    if old and same and same.identity and sh_palette is None:
        store(path, old.container.files, old.container.prefix, old.container.bundle_bytes)
    else:
        store(path, _encode(splats, same, old, sh_palette), old.container.prefix if old else "")


def _encode(
    splats: Splats, same: Unchanged | None, old: SogFile | None, sh_palette: int | None = None
) -> dict[str, bytes]:
    """File names -> contents, meta.json first. same, old: the source's, where it is SOG."""
    # Every plane is encoded, then pixels of values that did not change are put back.
    rows = drawable_rows(splats)
    if same is None or old is None:
        same = old = None
    meta: dict[str, Any] = copy.deepcopy(old.meta) if old else {"version": 2, "asset": {"generator": "SplatPainter"}}
    meta["count"] = len(rows)
    _set_flags(meta, splats)
    pixels = {"quats": _pack_quats(rows.quats)}
    keep = {"quats": same.quats} if same else {}
    _encode_means(rows, same, old, meta, pixels, keep)
    log_scales = activations.log(rows.scales).astype(np.float64)
    codes = _encode_scalars(log_scales, "scales", SCALE_TOLERANCES, same.scales if same else None, same, old, meta)
    pixels["scales"] = _rgba(codes)
    base = rows.sh[:, 0].astype(np.float64)
    codes = _encode_scalars(base, "sh0", COLOR_TOLERANCES, same.base if same else None, same, old, meta)
    pixels["sh0"] = _rgba(codes)
    pixels["sh0"][:, 3] = np.rint(rows.opacities.astype(np.float64) * 255)
    # After all planes, as their codebooks may have moved.
    if same and old:
        for key, mask in keep.items():
            pixels[key][mask] = old.pixels[key][same.source_rows[mask]]
        pixels["sh0"][same.opacities, 3] = old.pixels["sh0"][same.source_rows[same.opacities], 3]
    # Higher bands go by a palette of whole vectors and not by single values.
    images = {key: _image(values, old) for key, values in pixels.items()}
    if rows.sh.shape[1] > 1:
        images["labels"], images["palette"] = _encode_bands(rows.sh[:, 1:], same, old, meta, sh_palette)
    else:
        meta.pop("shN", None)
    return _image_files(images, meta, old)


def _set_flags(meta: dict[str, Any], splats: Splats) -> None:
    if flags(meta) == (splats.antialiased, splats.color_space == "linear"):
        return
    if splats.antialiased:
        meta["antialias"], meta["model"] = True, "antialiased"
    else:
        meta.pop("antialias", None)
        if meta.get("model") == "antialiased":
            meta.pop("model")
    extras = meta.get("extras")
    extras = dict(extras) if isinstance(extras, dict) else {}
    ours = extras.get(EXTRAS)
    ours = dict(ours) if isinstance(ours, dict) else {}
    if splats.color_space == "linear" or "color_space" in ours:
        meta["extras"] = extras | {EXTRAS: ours | {"color_space": splats.color_space}}


def _encode_means(rows: Splats, same: Unchanged | None, old: SogFile | None, meta: Any, pixels: Any, keep: Any) -> None:
    # A logarithm, so that steps are fine near zero and coarse far out.
    means = rows.means.astype(np.float64)
    logs = np.sign(means) * portable.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    # The old range stays where new rows lie in it, or so little outside that nobody sees them moved to its border.
    # Another range would move every row.
    if same and old:
        first, last = mean_range(meta)
        moved = np.sign(logs) * portable.expm1(np.abs(np.clip(logs, np.minimum(first, last), np.maximum(first, last))))
        beyond = np.abs(np.where(same.means[:, None], 0, moved - means)).max(1)
        if (beyond <= MAX_BORDER_SHIFT * rows.scales.max(1)).all():
            low, high = first, last
            keep["means_l"] = keep["means_u"] = same.means
    # Written only when new: equal mins and maxs in the source must stay what they are.
    if "means_l" not in keep:
        files = meta["means"]["files"] if old else []
        meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": files}
    span = np.where(high == low, 1, high - low)
    words = np.clip(np.rint((logs - low) / span * 65535), 0, 65535).astype(np.int64)
    pixels["means_l"], pixels["means_u"] = _rgba(words & 255), _rgba(words >> 8)


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    # q and -q are one rotation: the sign is chosen so that the component left out is positive.
    unit = quats.astype(np.float64)
    unit /= row_norm(unit)[:, None]
    largest = np.abs(unit).argmax(1)
    unit *= np.where(unit[np.arange(len(unit)), largest] < 0, -1, 1)[:, None]
    smaller = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    small = np.take_along_axis(unit, smaller, 1)
    out = _rgba(np.clip(np.rint((small * math.sqrt(2) + 1) / 2 * 255), 0, 255))
    out[:, 3] = 252 + largest
    return out


def _encode_scalars(
    values: np.ndarray,
    part: str,
    tolerances: tuple[float, ...],
    keep: np.ndarray | None,
    same: Unchanged | None,
    old: SogFile | None,
    meta: dict[str, Any],
) -> np.ndarray:
    """[N, 3] codebook entries of `values` [N, 3]; writes the codebook into `meta`."""
    # A new file has a codebook of its own values.
    if same is None or old is None or keep is None:
        book = codebooks.fit(values)
        meta[part] = {"codebook": book.tolist(), "files": []}
        return codebooks.nearest(book, values)
    # Else entries that rows use stay, and free ones may be spent on new values.
    codes = np.empty(values.shape, np.uint8)
    codes[keep] = old.pixels[part][same.source_rows[keep], :3]
    book, moved = codebooks.adapt(old.codebooks[part], codes[keep], values[~keep], tolerances)
    # No room for the new values: all are encoded anew, and rows that did not change lose their exact words.
    if book is None:
        book = codebooks.fit(values)
        codes[:] = codebooks.nearest(book, values)
    else:
        codes[keep] = moved[codes[keep]]
        codes[~keep] = codebooks.nearest(book, values[~keep])
    meta[part]["codebook"] = book.tolist()
    return codes


def _encode_bands(
    rest: np.ndarray, same: Unchanged | None, old: SogFile | None, meta: dict[str, Any], max_entries: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """Label image [H, W, 4] and palette image of SH bands >= 1, `rest` [N, K - 1, 3]; writes meta.shN."""
    coefficients = rest.shape[1]
    adapted = None
    if same and old and old.palette is not None and old.palette.shape[1] >= coefficients and max_entries is None:
        adapted = _adapt_palette(rest, same, replace(old, palette=old.palette[:, :coefficients]))
    if adapted is not None:
        labels, codes, book, pixels = adapted
    else:
        # As splat-transform: the power of two between half of the rows and all of them.
        size = max_entries or int(np.clip(1 << len(rest).bit_length() - 1, 1024, MAX_PALETTE))
        vectors, labels = codebooks.palette(rest.reshape(len(rest), -1), size)
        book = codebooks.fit(vectors)
        codes = codebooks.nearest(book, vectors).reshape(-1, coefficients, 3)
        pixels = _rgba(np.zeros((len(rest), 3)))
    files = meta["shN"]["files"] if old and meta.get("shN") else []
    meta["shN"] = {
        **(meta.get("shN") or {}),
        "count": len(codes),
        "bands": SH_COUNTS[coefficients + 1],
        "codebook": book.tolist(),
        "files": files,
    }
    # The palette is a picture of so many entries a line, as other readers compute their place.
    lines = -(-len(codes) // PALETTE_LINE)
    table = np.full((lines * PALETTE_LINE, coefficients, 4), 255, np.uint8)
    table[: len(codes), :, :3] = codes
    pixels[:, :2] = np.stack([labels & 255, labels >> 8], 1)
    return _image(pixels, old), table.reshape(lines, PALETTE_LINE * coefficients, 4)


def _adapt_palette(rest: np.ndarray, same: Unchanged, old: SogFile) -> Any:
    """(labels [N], codes [P, K - 1, 3], codebook, label pixels [N, 4]) with the source's entries where rows kept them.

    None where the new vectors need more room than there is, or the codebook would have to change for old ones.
    """
    assert old.palette is not None
    # Labels of rows that kept their bands, then entries for those that did not.
    pixels = _rgba(np.zeros((len(rest), 3)))
    pixels[same.rest] = old.pixels["labels"][same.source_rows[same.rest]]
    labels = pixels[:, 0].astype(np.int64) + 256 * pixels[:, 1].astype(np.int64)
    new_rows = np.flatnonzero(~same.rest)
    if not len(new_rows):
        return labels, old.palette, old.codebooks["shN"], pixels
    in_use = np.zeros(MAX_PALETTE, bool)
    in_use[labels[same.rest]] = True
    vectors = rest[new_rows].reshape(len(new_rows), -1)
    adapted = codebooks.adapt_palette(old.palette, old.codebooks["shN"], in_use, vectors, SH_TOLERANCES)
    if adapted is None:
        return None
    codes, book, labels[new_rows] = adapted
    return labels, codes, book, pixels


def _rgba(values: np.ndarray) -> Bytes:
    """[N, 3] -> [N, 4] uint8 with alpha 255."""
    out = np.full((len(values), 4), 255, np.uint8)
    out[:, :3] = values
    return out


def _image(pixels: np.ndarray, old: SogFile | None) -> np.ndarray:
    """[N, 4] -> [H, W, 4]: the source's shape where the rows still fit, else nearly square with sides in fours."""
    count = len(pixels)
    height, width = old.shape if old else (0, 0)
    if not 0 <= height * width - count < max(width, 1) * 4:
        width = math.ceil(math.sqrt(count) / 4) * 4
        height = math.ceil(count / width / 4) * 4
    out = np.zeros((height * width, 4), np.uint8)
    out[:count] = pixels
    return out.reshape(height, width, 4)


def _image_files(images: dict[str, np.ndarray], meta: dict[str, Any], old: SogFile | None) -> dict[str, bytes]:
    # A plane whose pixels did not change keeps its file: WebP of the same pixels may be other bytes.
    parts = {"means": ("means_l", "means_u"), "scales": ("scales",), "quats": ("quats",), "sh0": ("sh0",)}
    names = {"palette": "shN_centroids", "labels": "shN_labels"}
    if "palette" in images:
        parts["shN"] = ("palette", "labels")
    # Pixels after the last row or palette entry mean nothing, and need not be the same.
    used = {key: int(meta["count"]) for key in images}
    if "palette" in images:
        used["palette"] = meta["shN"]["count"] * images["palette"].shape[1] // PALETTE_LINE
    contents: dict[str, bytes] = {}
    for part, keys in parts.items():
        listed = meta.setdefault(part, {}).get("files") or []
        listed = [listed[i] if i < len(listed) else f"{names.get(key, key)}.webp" for i, key in enumerate(keys)]
        for i, key in enumerate(keys):
            before = old.container.files.get(listed[i]) if old else None
            if before is None or not _same_image(before, images[key], used[key]):
                if not listed[i].lower().endswith(".webp"):
                    listed[i] = f"{names.get(key, key)}.webp"
                before = packing.encode_image(images[key])
            contents[listed[i]] = before
        meta[part]["files"] = listed
    out = {META: json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()}
    if old and not old.container.folder:
        # Keep a bundle's order and whatever else it holds; planes that are no longer named go.
        dropped = set(named_files(old.meta, "source")) - set(contents)
        both = out | contents
        order = [name for name in old.container.files if name not in dropped]
        merged = {name: both.get(name, old.container.files[name]) for name in order}
        return merged | {name: data for name, data in both.items() if name not in merged}
    return out | contents


def _same_image(data: bytes, image: np.ndarray, used: int) -> bool:
    width, height = packing.image_size(data, "source")
    if (height, width) != image.shape[:2]:
        return False
    before = packing.decode_image(data, "source").reshape(-1, 4)
    return np.array_equal(before[:used], image.reshape(-1, 4)[:used])
