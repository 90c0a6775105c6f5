"""Reading and writing splat files: one module per format, `read` and `write` choose among them.

Knows no cameras, no renderer and no network. Raw file values (log-scales, logit-opacities, quantised words) become the
activated values of `Splats` in the readers and go back in the writers, nowhere else. Rows are never sorted.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from splatpainter.io import files, folders
from splatpainter.io.axes import describe, flipped_offset, to_file_axes, to_memory_axes
from splatpainter.io.foreign_captures import cameras_alone, nerfstudio_run
from splatpainter.io.foreign_files import COPY_AGAIN, check_not_foreign
from splatpainter.io.formats import sog_container
from splatpainter.io.write_options import AS_IT_IS, WriteOptions
from splatpainter.splats import ATTRIBUTES, SH_COUNTS, Axes, Source, Splats
from splatpainter.system.old_names import formerly
from splatpainter.system.quick_dataclass import dataclass

Reader = Callable[..., Splats]
Writer = Callable[..., None]


AXES_CHOICES: tuple[Axes, ...] = get_args(Axes)


@dataclass(frozen=True)
class Format:
    """One file format."""

    key: str
    """What `Source.format` says."""
    suffixes: tuple[str, ...]
    """Lower-case name endings, the one to suggest first; () for a folder."""
    read: Reader
    """read(path), and by keyword what `options` names."""
    write: Writer | None
    """None: this format can only be read."""
    description: str
    exact: str
    """What stays byte for byte when a file of this format is edited and written back, in one sentence."""
    lossy: str = ""
    """What is lost when rows of another format, or edited rows, are written; "" where nothing is."""
    options: tuple[str, ...] = ()
    """Keywords of `io.read` that `read` takes, too."""
    write_options: tuple[str, ...] = ()
    """Fields of WriteOptions that a file of this format can follow."""
    axes: str = "rdf"
    """Axes of a file's numbers unless it says otherwise (key of axes.AXES)."""
    holds_offset: bool = False
    """Whether positions are kept that float32 cannot hold (Splats.offset); others are written rounded."""
    names_axes: bool = False
    """Whether a file can say which axes its numbers have: `read` and `write` take `axes` and turn what they must. One
    that does not say may well have others, as programs differ."""


def _lazy(module: str, name: str) -> Callable[..., Any]:
    """A function of a module that is imported when it is called: most processes meet one format."""

    def call(*arguments: Any, **options: Any) -> Any:
        # Files hold floats of any bits: what overflows or is NaN is reported as a problem of rows, not as a warning.
        with np.errstate(all="ignore"):
            return getattr(importlib.import_module(f"splatpainter.io.formats.{module}"), name)(*arguments, **options)

    return call


HOLDS_SH = ("sh_degree", "antialiased")
"""Options of formats that hold SH, which all hold the mark too."""

FORMATS: dict[str, Format] = {
    entry.key: entry
    for entry in (
        # .compressed.ply stands before .ply: the first suffix that fits a name wins.
        Format(
            "compressed.ply",
            (".compressed.ply",),
            _lazy("compressed_ply", "read_compressed_ply"),
            _lazy("compressed_ply", "write_compressed_ply"),
            "PlayCanvas compressed PLY: chunks of 256 rows, 16 bytes a row",
            "Chunks without a changed row keep their bytes; in a changed chunk, unchanged values do where the chunk's "
            "range of them still fits.",
            "Positions, scales, colours, rotations and SH are quantised to 8-11 bits within each chunk of 256 rows.",
            write_options=HOLDS_SH,
        ),
        Format(
            "ply",
            (".ply",),
            _lazy("ply", "read_ply"),
            _lazy("ply", "write_ply"),
            "INRIA PLY: little or big endian or text, any property order, SH degree 0-4",
            "Every byte outside the values that changed: header, property order, extra properties and elements, "
            "trailing bytes.",
            options=("lenient", "offset"),
            write_options=HOLDS_SH,
            holds_offset=True,
        ),
        Format(
            "splat",
            (".splat",),
            _lazy("splat", "read_splat"),
            _lazy("splat", "write_splat"),
            "antimatter15 .splat: 32 bytes a row",
            "Every byte outside the values that changed.",
            "SH above degree 0 is dropped; colours, opacities and rotations are rounded to 8 bits.",
            options=("lenient",),
        ),
        Format(
            "ksplat",
            (".ksplat",),
            _lazy("ksplat", "read_ksplat"),
            None,
            "GaussianSplats3D .ksplat, compression levels 0-2 (read only)",
            "Cannot be written; convert to PLY.",
        ),
        Format(
            "spz",
            (".spz",),
            _lazy("spz", "read_spz"),
            _lazy("spz", "write_spz"),
            "Niantic SPZ, versions 1-4",
            "The quantised values of rows that did not change.",
            "Positions are fixed-point; scales, colours, opacities, rotations and SH have 8 bits or fewer.",
            write_options=(*HOLDS_SH, "spz_version", "sh_bits", "mark_axes"),
            names_axes=True,
        ),
        Format(
            "sog",
            (".sog", "meta.json"),
            _lazy("sog", "read_sog"),
            _lazy("sog", "write_sog"),
            "PlayCanvas SOG version 2: a .sog bundle, or a folder with meta.json and WebP planes",
            "The quantised values of rows that did not change.",
            "Positions have 16 bits; scales, colours and SH come from codebooks of 256 values; SH from a palette.",
            write_options=(*HOLDS_SH, "sh_palette"),
        ),
        Format(
            "glb",
            (".glb",),
            _lazy("glb", "read_glb"),
            _lazy("glb", "write_glb"),
            "glTF 2.0 binary with KHR_gaussian_splatting",
            "Every byte outside the values that changed.",
            options=("offset",),
            axes="luf",
            write_options=HOLDS_SH,
            holds_offset=True,
        ),
    )
}

_MAGIC = {b"glTF": "glb", b"PK\x03\x04": "sog", b"NGSP": "spz"}


@formerly(axes="frame")
def read(
    path: str | os.PathLike[str],
    *,
    axes: Axes = "auto",
    lenient: bool = False,
    offset: tuple[float, float, float] | None = None,
) -> Splats:
    """Read a splat file (or a SOG folder, or the last iteration in a folder of INRIA's trainer) in any of FORMATS;
    `source` and `origin` are filled in.

    The content decides where it is unmistakable (PLY, compressed PLY, GLB, SOG bundle, SPZ), the name otherwise.
    axes: of the file's numbers, "rub" (right-up-back) or "rdf" (right-down-front), whatever the file or its
    format says; "auto" believes them. Rows always come out right-down-front, so that an asset is upright; `source`
    says how the file was taken, and writing the same format turns them back (signs only, so every bit survives).
    lenient: also open files that were cut off after their last complete row (a .splat of 33 bytes, a PLY without the
    end of a later element); what is left of the cut part is kept and reported in `source.problems`.
    offset: world coordinates that `means` shall be relative to, in formats that hold such (PLY, GLB); None: zero, or,
    where float32 cannot hold the positions, a point amid them (`Splats.offset`).
    Raises ValueError with one line: no such file, unknown format, truncated or contradictory content.
    """
    # A folder stands for a file in it; the content says which format that is.
    check_axes(axes)
    location = asset_file(Path(path))
    key = detect(location)
    entry = FORMATS[key]
    options: dict[str, Any] = {"lenient": lenient} if "lenient" in entry.options else {}
    # An offset is in memory's axes, and the reader works in the file's.
    if offset is not None and "offset" in entry.options:
        options["offset"] = flipped_offset(offset, entry.axes, axes)
    try:
        if entry.names_axes:
            return entry.read(location, axes=axes)
        return to_memory_axes(entry.read(location, **options), axes)
    except ValueError as error:
        if os.path.isfile(location) and not os.path.getsize(location):
            raise ValueError(f"{error}; it is empty (0 bytes): {COPY_AGAIN}") from None
        raise


@formerly(axes="frame")
def write(
    path: str | os.PathLike[str],
    splats: Splats[Any],
    *,
    overwrite: bool = False,
    axes: Axes = "auto",
    options: WriteOptions = AS_IT_IS,
) -> None:
    """Write `splats` (numpy or torch attributes) in the format that the name of `path` says.

    Where `splats.source` is of that format, everything that did not change keeps its bytes (see Format.exact).
    axes: of the file's numbers, "rub" or "rdf"; "auto": those of `splats.source` if it is of that format, else
    the format's own. SPZ files of other axes than the PLY's say it; other formats cannot, and need
    `read(path, axes=...)`.
    options: what the file shall hold less or otherwise; `Format.write_options` says which a format has.
    Raises ValueError: the target exists and overwrite is False, unknown or read-only format, inconsistent shapes, an
    option that the format has not.
    """
    # Refused by name and option before anything is computed or made.
    check_axes(axes)
    location = Path(path)
    key = format_of_name(location)
    if key is None:
        raise ValueError(f"{location}: unknown format; expected a name ending in {_suffixes(writable=True)}")
    writer = FORMATS[key].write
    if writer is None:
        raise ValueError(f"{location}: {FORMATS[key].description}; write one of {_suffixes(writable=True)} instead")
    if location.exists() and not overwrite:
        raise ValueError(f"{location}: already exists; choose another name or allow overwriting")
    options.check(FORMATS[key].write_options, str(location))
    # Rows as this format has them: whole arrays, options, offset, and last the axes.
    rows = canonical(splats)
    applied = options.applied(rows)
    rows = _at_offset(rows if applied is rows else canonical(applied), FORMATS[key])
    if FORMATS[key].names_axes:
        writer(location, rows, axes=axes, **options.keywords())
    else:
        writer(location, to_file_axes(rows, key, axes, FORMATS[key].axes), **options.keywords())


def _at_offset(rows: Splats, entry: Format) -> Splats:
    """Rows with means relative to what they are in a file of this format: its source's offset, or none where the format
    has none."""
    if rows.source is not None and rows.source.format == entry.key:
        return rows.relative_to(rows.source.splats.offset)
    return rows if entry.holds_offset else rows.relative_to((0.0, 0.0, 0.0))


def check_axes(axes: str) -> None:
    """Raises ValueError for anything but the values of Axes."""
    if axes not in AXES_CHOICES:
        raise ValueError(f"axes: expected one of {', '.join(AXES_CHOICES)}, got {str(axes)[:40]!r}")


def chosen_axes(splats: Splats) -> Axes:
    """What `read` and `write` need to be told for rows in the axes of this source: "auto" where there is no need."""
    source = splats.source
    return option(source.axes) if source is not None and source.axes_from == "choice" else "auto"


def option(axes: str) -> Axes:
    """The value of Axes that names these axes; "auto" where none does."""
    return "rub" if axes == "rub" else "rdf" if axes == "rdf" else "auto"


def written_axes(splats: Splats, key: str, axes: Axes) -> Axes:
    """What `read` needs to be told of the file of format `key` that `write(..., splats, axes=axes)` made."""
    if axes != "auto":
        return axes
    return chosen_axes(splats) if splats.source is not None and splats.source.format == key else "auto"


def axes_line(source: Source, hint: bool = True) -> str:
    """One line for people: which axes the file's numbers have, and who says so. hint: also how to turn a file that
    might have others."""
    reasons = {
        "file": "as the file says",
        "choice": "as chosen",
        "format": "the default of this format; the file does not say",
    }
    line = f"{describe(source.axes)}, {reasons[source.axes_from]}"
    if not axes_are_open(source):
        return line
    line = f"{describe(source.axes)}, as in PLY files; the file does not say"
    return f"{line} (--in-axes rub, if it stands upside down)" if hint else line


def axes_are_open(source: Source) -> bool:
    """Whether a file may well have other axes than those that it was taken to have: it could say, and does not."""
    return source.axes_from == "format" and FORMATS[source.format].names_axes


def axes_are_news(source: Source) -> bool:
    """Whether people should hear of a file's axes: programs differ about the format, or somebody chose them."""
    return source.axes_from != "format" or FORMATS[source.format].names_axes


def axes_news(splats: Splats, of: str = "") -> list[str]:
    """What commands say of a file's axes: one line, or none where there is no news. of: the file, where a command has
    no --in-axes of its own."""
    source = splats.source
    if source is None or not axes_are_news(source):
        return []
    return [f"axes of {of}: {axes_line(source, hint=False)}" if of else f"axes: {axes_line(source)}"]


def asset_file(path: Path) -> Path:
    """The file (or SOG folder) that a path means, as of folders.asset_file. Raises ValueError: a folder of something
    else, or of streamed SOG."""
    if os.path.isdir(path) and not os.path.isfile(path / folders.SOG_META) and sog_container.is_streamed(path):
        raise ValueError(sog_container.streamed_reason(path))
    return folders.asset_file(path)


def detect(path: Path) -> str:
    """Key of FORMATS that the file at `path` holds. Raises ValueError when it is missing, unreadable or unknown."""
    path = asset_file(path)
    if os.path.isdir(path):  # Path.is_dir raises where a folder above may not be searched
        return "sog"
    # The content before the name: files are renamed, and downloads lose their ending.
    head = files.read_head(path, files.MAX_HEADER_BYTES if path.suffix.lower() == ".ply" else 65536)
    # Two formats begin as PLY; the header tells them apart.
    if files.begins_as_ply(head):
        end = head.find(b"end_header")
        return "compressed.ply" if b"packed_position" in head[: None if end < 0 else end] else "ply"
    if head[:4] in _MAGIC:
        return _MAGIC[head[:4]]
    if run := nerfstudio_run(path):
        raise ValueError(f"{path}: is {run}")
    if cameras := cameras_alone(path):
        raise ValueError(f"{path}: {cameras}")
    check_not_foreign(head, path)
    key = format_of_name(path)
    if key is not None:
        return key
    if sog_container.is_streamed(path):
        raise ValueError(sog_container.streamed_reason(path))
    # Two bytes are too few to overrule a name (a .splat may begin with them), but they decide where there is none.
    if head[:2] == b"\x1f\x8b":
        return "spz"
    raise ValueError(f"{path}: unknown format; expected a splat file ({_suffixes(writable=False)})")


def format_of_name(path: Path) -> str | None:
    """Key of FORMATS by the ending of the name, None where it says nothing."""
    name = path.name.lower()
    for entry in FORMATS.values():
        if any(name == suffix or (suffix[0] == "." and name.endswith(suffix)) for suffix in entry.suffixes):
            return entry.key
    return None


def canonical(splats: Splats[Any]) -> Splats:
    """`splats` with C-contiguous float32 numpy attributes; raises ValueError where shapes do not fit together."""
    # Shapes are judged here, once for all formats.
    converted = splats.numpy()
    arrays = {name: np.ascontiguousarray(getattr(converted, name), np.float32) for name in ATTRIBUTES}
    rows = len(converted)
    bands = arrays["sh"].shape[1] if arrays["sh"].ndim == 3 else 0
    shapes = {"means": (rows, 3), "quats": (rows, 4), "scales": (rows, 3), "opacities": (rows,), "sh": (rows, bands, 3)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"write: expected {name} of shape {list(shape)}, got {list(arrays[name].shape)}")
    if bands not in SH_COUNTS:
        raise ValueError(f"write: expected 1, 4, 9, 16 or 25 SH coefficients, got {bands}")
    # Origins point into the source, whose bytes are copied: a wild one would copy something else.
    origin = splats.origin
    if origin is not None and splats.source is not None:
        origin = np.asarray(origin)
        limit = len(splats.source.splats)
        if origin.shape != (rows,):
            raise ValueError(f"write: expected origin of shape {[rows]}, got {list(origin.shape)}")
        if rows and not (-1 <= origin.min() and origin.max() < limit):
            raise ValueError(
                f"write: expected origins from -1 to {limit - 1} (rows of {splats.source.path}), "
                f"got {origin.min()} to {origin.max()}"
            )
    unchanged = all(arrays[name] is getattr(splats, name) for name in ATTRIBUTES)
    return splats if unchanged else replace(converted, **arrays)


def _suffixes(*, writable: bool) -> str:
    return ", ".join(e.suffixes[0] for e in FORMATS.values() if not writable or e.write is not None)
