"""Rows -> the files of a SOG asset (layout: sog.py).

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
from typing import Any

import numpy as np

from splatpainter.io import codebooks, planes, raw, sog
from splatpainter.io.reuse import Kept, presentable
from splatpainter.io.sog_files import META, named_files
from splatpainter.splats import SH_C0, SH_COUNTS, Splats

COLOR_TOLERANCES = tuple(steps / 255 / SH_C0 for steps in (1, 2, 4))
"""How far a painted colour may be from its codebook entry, in 255ths of the display range: the tightest for which free
entries suffice, the last one when entries have to be merged."""
SCALE_TOLERANCES = tuple(math.log(ratio) for ratio in (1.03, 1.06, 1.12, 1.25))
SH_TOLERANCES = (0.01, 0.02, 0.04)
PALETTE_LIMIT = 65536
BORDER = 2.0
"""Standard deviations (its largest) by which a changed row may be moved to stay within the file's position range: a
child of a row on the border, moved this far, still lies within its parent."""


def encode(splats: Splats, same: Kept | None, old: sog.SogFile | None) -> dict[str, bytes]:
    """File names -> contents, meta.json first. same, old: the source's, where it is SOG."""
    rows = presentable(splats)
    if same is None or old is None:
        same = old = None
    meta: dict[str, Any] = copy.deepcopy(old.meta) if old else {"version": 2, "asset": {"generator": "SplatPainter"}}
    meta["count"] = len(rows)
    _set_flags(meta, splats)
    pixels = {"quats": _pack_quats(rows.quats)}
    keep = {"quats": same.quats} if same else {}
    _encode_means(rows, same, old, meta, pixels, keep)
    log_scales = raw.log(rows.scales).astype(np.float64)
    codes = _encode_scalars(log_scales, "scales", SCALE_TOLERANCES, same.scales if same else None, same, old, meta)
    pixels["scales"] = _rgba(codes)
    base = rows.sh[:, 0].astype(np.float64)
    codes = _encode_scalars(base, "sh0", COLOR_TOLERANCES, same.base if same else None, same, old, meta)
    pixels["sh0"] = _rgba(codes)
    pixels["sh0"][:, 3] = np.rint(rows.opacities.astype(np.float64) * 255)
    if same and old:
        for key, mask in keep.items():
            pixels[key][mask] = old.pixels[key][same.rows[mask]]
        pixels["sh0"][same.opacities, 3] = old.pixels["sh0"][same.rows[same.opacities], 3]
    images = {key: _image(values, old) for key, values in pixels.items()}
    if rows.sh.shape[1] > 1:
        images["labels"], images["palette"] = _encode_bands(rows.sh[:, 1:], same, old, meta)
    else:
        meta.pop("shN", None)
    return _files(images, meta, old)


def _set_flags(meta: dict[str, Any], splats: Splats) -> None:
    if sog.flags(meta) == (splats.antialiased, splats.color_space == "linear"):
        return
    if splats.antialiased:
        meta["antialias"], meta["model"] = True, "antialiased"
    else:
        meta.pop("antialias", None)
        if meta.get("model") == "antialiased":
            meta.pop("model")
    extras = meta.get("extras")
    extras = dict(extras) if isinstance(extras, dict) else {}
    ours = extras.get(sog.EXTRAS)
    ours = dict(ours) if isinstance(ours, dict) else {}
    if splats.color_space == "linear" or "color_space" in ours:
        meta["extras"] = extras | {sog.EXTRAS: ours | {"color_space": splats.color_space}}


def _encode_means(rows: Splats, same: Kept | None, old: sog.SogFile | None, meta: Any, pixels: Any, keep: Any) -> None:
    means = rows.means.astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    if same and old:
        first, last = sog.mean_range(meta)
        moved = np.sign(logs) * np.expm1(np.abs(np.clip(logs, np.minimum(first, last), np.maximum(first, last))))
        beyond = np.abs(np.where(same.means[:, None], 0, moved - means)).max(1)
        if (beyond <= BORDER * rows.scales.max(1)).all():
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
    unit = quats.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    largest = np.abs(unit).argmax(1)
    unit *= np.where(unit[np.arange(len(unit)), largest] < 0, -1, 1)[:, None]
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    small = np.take_along_axis(unit, others, 1)
    out = _rgba(np.clip(np.rint((small * math.sqrt(2) + 1) / 2 * 255), 0, 255))
    out[:, 3] = 252 + largest
    return out


def _encode_scalars(
    values: np.ndarray,
    part: str,
    tolerances: tuple[float, ...],
    keep: np.ndarray | None,
    same: Kept | None,
    old: sog.SogFile | None,
    meta: dict[str, Any],
) -> np.ndarray:
    """[N, 3] codebook entries of `values` [N, 3]; writes the codebook into `meta`."""
    if same is None or old is None or keep is None:
        book = codebooks.fit(values)
        meta[part] = {"codebook": book.tolist(), "files": []}
        return codebooks.nearest(book, values)
    codes = np.empty(values.shape, np.uint8)
    codes[keep] = old.pixels[part][same.rows[keep], :3]
    book, moved = _adapt(old.codebooks[part], codes[keep], values[~keep], tolerances)
    if book is None:
        book = codebooks.fit(values)
        codes[:] = codebooks.nearest(book, values)
    else:
        codes[keep] = moved[codes[keep]]
        codes[~keep] = codebooks.nearest(book, values[~keep])
    meta[part]["codebook"] = book.tolist()
    return codes


def _adapt(
    book: np.ndarray, codes: np.ndarray, values: np.ndarray, tolerances: tuple[float, ...]
) -> tuple[np.ndarray | None, np.ndarray]:
    """The codebook with room for `values`, and where each entry's old users go; None where it has to be fitted anew."""
    book = np.concatenate([book, np.full(codebooks.SIZE - len(book), book[-1])])
    counts = np.bincount(codes.reshape(-1), minlength=codebooks.SIZE)
    stay = np.arange(codebooks.SIZE)
    for tolerance in tolerances:
        wider = codebooks.extend(book, counts > 0, values, tolerance)
        if wider is not None:
            return wider, stay
    moved = codebooks.make_room(book, counts, values, tolerances[-1])
    if moved is None:
        return None, stay
    used = (counts > 0) & (moved == stay)
    return codebooks.extend(book, used, values, tolerances[-1]), moved


def _encode_bands(
    rest: np.ndarray, same: Kept | None, old: sog.SogFile | None, meta: dict[str, Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Label image [H, W, 4] and palette image of SH bands >= 1, `rest` [N, K - 1, 3]; writes meta.shN."""
    coefficients = rest.shape[1]
    adapted = None
    if same and old and old.palette is not None and old.palette.shape[1] == coefficients:
        adapted = _adapt_palette(rest, same, old)
    if adapted is not None:
        labels, codes, book, pixels = adapted
    else:
        # As splat-transform: the power of two between half of the rows and all of them.
        size = int(np.clip(2 ** math.floor(math.log2(len(rest))), 1024, PALETTE_LIMIT))
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
    lines = -(-len(codes) // sog.PALETTE_LINE)
    table = np.full((lines * sog.PALETTE_LINE, coefficients, 4), 255, np.uint8)
    table[: len(codes), :, :3] = codes
    pixels[:, :2] = np.stack([labels & 255, labels >> 8], 1)
    return _image(pixels, old), table.reshape(lines, sog.PALETTE_LINE * coefficients, 4)


def _adapt_palette(rest: np.ndarray, same: Kept, old: sog.SogFile) -> Any:
    """(labels [N], codes [P, K - 1, 3], codebook, label pixels [N, 4]) with the source's entries where rows kept them.

    None where the new vectors need more room than there is, or the codebook would have to change for old ones.
    """
    assert old.palette is not None
    pixels = _rgba(np.zeros((len(rest), 3)))
    pixels[same.rest] = old.pixels["labels"][same.rows[same.rest]]
    labels = pixels[:, 0].astype(np.int64) + 256 * pixels[:, 1].astype(np.int64)
    codes, fresh = old.palette, np.flatnonzero(~same.rest)
    if not len(fresh):
        return labels, codes, old.codebooks["shN"], pixels
    busy = np.zeros(PALETTE_LIMIT, bool)
    busy[labels[same.rest]] = True
    free = np.flatnonzero(~busy)
    vectors, mine = codebooks.palette(rest[fresh].reshape(len(fresh), -1), max(len(free), 1))
    if len(free) < min(len(np.unique(mine)), 1024):
        return None
    used = np.zeros(codebooks.SIZE, bool)
    used[np.unique(codes[busy[: len(codes)]])] = True
    book = np.concatenate([old.codebooks["shN"], np.zeros(codebooks.SIZE - len(old.codebooks["shN"]))])
    wider = next((w for t in SH_TOLERANCES if (w := codebooks.extend(book, used, vectors, t)) is not None), None)
    if wider is None:
        return None
    # Entries beyond the old palette come after free ones within it, so that the palette grows as little as it can.
    place = free[: len(vectors)]
    grown = np.zeros((max(len(codes), int(place.max()) + 1), *codes.shape[1:]), np.uint8)
    grown[: len(codes)] = codes
    grown[place] = codebooks.nearest(wider, vectors).reshape(-1, *codes.shape[1:])
    labels[fresh] = place[mine]
    return labels, grown, wider, pixels


def _rgba(values: np.ndarray) -> np.ndarray:
    """[N, 3] -> [N, 4] uint8 with alpha 255."""
    out = np.full((len(values), 4), 255, np.uint8)
    out[:, :3] = values
    return out


def _image(pixels: np.ndarray, old: sog.SogFile | None) -> np.ndarray:
    """[N, 4] -> [H, W, 4]: the source's shape where the rows still fit, else nearly square with sides in fours."""
    count = len(pixels)
    height, width = old.shape if old else (0, 0)
    if not 0 <= height * width - count < max(width, 1) * 4:
        width = math.ceil(math.sqrt(count) / 4) * 4
        height = math.ceil(count / width / 4) * 4
    out = np.zeros((height * width, 4), np.uint8)
    out[:count] = pixels
    return out.reshape(height, width, 4)


def _files(images: dict[str, np.ndarray], meta: dict[str, Any], old: sog.SogFile | None) -> dict[str, bytes]:
    parts = {"means": ("means_l", "means_u"), "scales": ("scales",), "quats": ("quats",), "sh0": ("sh0",)}
    names = {"palette": "shN_centroids", "labels": "shN_labels"}
    if "palette" in images:
        parts["shN"] = ("palette", "labels")
    # Pixels after the last row or palette entry mean nothing, and need not be the same.
    used = {key: int(meta["count"]) for key in images}
    if "palette" in images:
        used["palette"] = meta["shN"]["count"] * images["palette"].shape[1] // sog.PALETTE_LINE
    contents: dict[str, bytes] = {}
    for part, keys in parts.items():
        listed = meta.setdefault(part, {}).get("files") or []
        listed = [listed[i] if i < len(listed) else f"{names.get(key, key)}.webp" for i, key in enumerate(keys)]
        for i, key in enumerate(keys):
            before = old.container.files.get(listed[i]) if old else None
            if before is None or not _same_image(before, images[key], used[key]):
                if not listed[i].lower().endswith(".webp"):
                    listed[i] = f"{names.get(key, key)}.webp"
                before = planes.encode(images[key])
            contents[listed[i]] = before
        meta[part]["files"] = listed
    out = {META: json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()}
    if old and not old.container.folder:
        # Keep a bundle's order and whatever else it holds; planes that are no longer named go.
        gone = set(named_files(old.meta, "source")) - set(contents)
        both = out | contents
        order = [name for name in old.container.files if name not in gone]
        merged = {name: both.get(name, old.container.files[name]) for name in order}
        return merged | {name: data for name, data in both.items() if name not in merged}
    return out | contents


def _same_image(data: bytes, image: np.ndarray, used: int) -> bool:
    width, height = planes.size(data, "source")
    if (height, width) != image.shape[:2]:
        return False
    before = planes.decode(data, "source").reshape(-1, 4)
    return np.array_equal(before[:used], image.reshape(-1, 4)[:used])
