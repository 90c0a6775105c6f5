"""Assets and layers in and out of a session: the original inside a project, the asset with the receipt of all that was
done to it, views, and single layers as files.

The original is kept as its file's bytes, or as Gaussians where there is no file. A project that only names its original
could name any file of the machine: `OriginalRule` says which of them may be opened. What is opened is a regular file,
or a folder of them. Facts of a project: name, format ("rows": no file), sha256, path (absolute; empty: the bytes are in
the project), color_space and antialiased (where there is no file), offset (Splats.offset; absent: zero), frame (that
was chosen for its numbers; absent: none was).
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.image_files import Alpha
from splatpainter.io import (
    FORMATS,
    axes_are_open,
    chosen_axes,
    files,
    format_of_name,
    option,
    read,
    write,
    written_axes,
)
from splatpainter.io.folders import inside
from splatpainter.io.formats.sog_container import META
from splatpainter.io.positions import NO_OFFSET, Offset
from splatpainter.io.write_options import AS_IT_IS, WriteOptions
from splatpainter.output_paths import receipt_of
from splatpainter.receipts import Receipt, Verification, prove, untouched_hashes
from splatpainter.rendering.profiles import Profile
from splatpainter.session.document.document import Layer
from splatpainter.session.document.scene_asset import SceneAsset
from splatpainter.session.project.project_file import Project
from splatpainter.session.project.project_opening import check_free
from splatpainter.session.project.scratch import scratch_folder
from splatpainter.session.replay import conflicts
from splatpainter.session.replay.delta import MAX_REASON, PART_BYTES, Delta, decode, encode, without_source
from splatpainter.splats import Axes, Splats, changed_rows
from splatpainter.system.atomic import MAX_NAME_BYTES, brief_name
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.view_files import Aov, PictureOptions, view_files

NO_FILE = "rows"
"""Format of an original that is no file."""
DEVICE_NAME = r"con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9\u00b9\u00b2\u00b3]"
"""Names, up to the first dot, that stand for devices on Windows."""
LAYER_SUFFIX = ".splatlayer"
LAYER_FILE_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    ValueError,
    OverflowError,
    RuntimeError,
    EOFError,
)
"""What reading a file that is no layer file raises."""
MAX_MEMBER_BYTES = 1 << 28
"""Most bytes of one picture in a layer file."""


MAX_PATH_LENGTH = 300
"""Characters of a path that a project names, in an error."""


@dataclass(frozen=True)
class OriginalRule:
    """Which file may be opened as the original of a project that names one instead of holding its bytes."""

    at: Path | None = None
    """The file, said by whoever opens the project: then nothing that the project names is opened."""
    embedded: bool = False
    """None: the project has to hold the bytes."""
    folder: Path | None = None
    """Only what lies in this folder, links followed; None: any file of this machine."""


ANY_FILE = OriginalRule()
"""Rule of projects that their user opens by name."""


def file_of(splats: Splats) -> Path | None:
    """The file that these Gaussians still are, if it is still there and the same."""
    # Asked anew, as the file may have been written over since it was read.
    if splats.source is None or splats.sha256 != splats.source.sha256:
        return None
    path = Path(splats.source.path)
    try:
        if path.is_dir() or path.name.lower() == META:
            return path if read(path).sha256 == splats.sha256 else None
        return path if files.file_sha256(path) == splats.sha256 else None
    except ValueError:
        return None


ORIGINAL_FACTS = ("sha256", "color_space", "antialiased", "offset", "frame")
"""Facts of a project that say what its original's Gaussians are; where it is kept may differ."""


def describe(splats: Splats, path: Path | None, embed: bool) -> dict[str, str]:
    """The facts of a project about its original. path: its file, if it has one that still holds them."""
    facts = {"sha256": splats.sha256, "color_space": splats.color_space, "antialiased": str(int(splats.antialiased))}
    if any(splats.offset):
        facts["offset"] = json.dumps(splats.offset)
    if path is None or splats.source is None:
        return {**facts, "name": "asset", "format": NO_FILE, "path": ""}
    if stored_axes(splats) != "auto":
        facts["frame"] = stored_axes(splats)
    name = META if path.is_dir() or path.name.lower() == META else path.name
    return {**facts, "name": name, "format": splats.source.format, "path": "" if embed else str(path.absolute())}


def stored_axes(splats: Splats) -> Axes:
    """The axes that a project keeps of its original: as chosen or, where an SPZ file does not say, as taken."""
    source = splats.source
    return option(source.axes) if source is not None and axes_are_open(source) else chosen_axes(splats)


def pieces(splats: Splats, path: Path | None) -> Iterator[tuple[str, bytes]]:
    """(file name, bytes) to be kept in the project, a piece at a time."""
    if path is None:
        # A delta on nothing: the layout that results have, with its checks, serves here as well.
        none = np.zeros(0, np.int64)
        empty = without_source(splats.take(none))
        everything = Delta(0, none, empty, without_source(splats), np.full(len(splats), -1, np.int64))
        yield from ((NO_FILE, part) for part in encode(everything))
        return
    for file in _members(path):
        name = META if file.name.lower() == META else file.name  # as the format calls it
        with files.reading(file) as source:
            yield name, b""  # an empty file is a file too
            while piece := source.read(PART_BYTES):
                yield name, piece


def restore(project: Project, rule: OriginalRule) -> Splats:
    """The original, with `origin`. rule: what may be opened where the project does not hold the bytes.
    Raises ValueError: the file is gone or may not be opened, its bytes are not those that the project was made from,
    none of its Gaussians can be drawn."""
    facts = {name: project.fact(name) or "" for name in ("name", "format", "sha256", "path", "color_space")}
    axes, offset = option(project.fact("frame") or ""), _stored_offset(project)
    if facts["format"] == NO_FILE:
        delta = decode((data for _, data in project.original()), f"{project.path}: the original")
        linear, antialiased = facts["color_space"] == "linear", project.fact("antialiased") == "1"
        splats = replace(delta.appended, color_space="linear" if linear else "srgb", antialiased=antialiased)
        splats = replace(splats, offset=offset)
    elif facts["path"]:
        # Lenient: the project was made when it opened.
        splats = read(_named_file(project.path, facts["path"], rule), axes=axes, lenient=True, offset=offset)
    else:
        splats = _unpacked(project, facts["name"], axes, offset=offset)
    # Layers name Gaussians by their index: on another original they would paint anywhere.
    if splats.sha256 != facts["sha256"]:
        raise ValueError(f"{project.path}: the original is not the one that the project was made from (sha256 differs)")
    if not splats.drawable.any():
        raise ValueError(f"{project.path}: none of the {len(splats)} Gaussians of its original can be drawn")
    return numbered(splats)


def _stored_offset(project: Project) -> Offset:
    """Of the original (Splats.offset), as it was when the project was made: layers hold positions relative to it.
    Raises ValueError: damaged."""
    try:
        x, y, z = (float(value) for value in json.loads(project.fact("offset") or "[0, 0, 0]"))
    except (ValueError, TypeError, RecursionError):
        raise ValueError(f"{project.path}: damaged project file (offset of the original)") from None
    return x, y, z


def write_original(
    path: Path, target: Path, original: Splats | None = None, added: SceneAsset | None = None
) -> tuple[Path, Axes]:
    """The original of the project at `path` as a file: `target` with the ending of its format, else PLY. Returns that
    file and the `axes` to read it with. A file's bytes stay what they are where the project holds them. original: the
    Gaussians, where they are known: then no file that a project names is opened. Without them the axes are "auto".
    added: that of an asset that was added, of a project with several. Raises ValueError."""
    with contextlib.closing(Project.open(path, readonly=True)) as project:
        facts = {name: project.fact(name) or "" for name in ("name", "format", "path", "frame")}
        if added is not None:
            format = format_of_name(Path(added.file)) or ""
            facts = {"name": added.file, "format": format, "path": "", "frame": added.axes}
        # The bytes are given back as they are wherever possible: the hash then says that nothing was lost.
        entry = FORMATS.get(facts["format"])
        turned = facts["frame"] and original is None and facts["format"] != "spz"  # of SPZ its bytes are asked, below
        if facts["path"] or entry is None or facts["name"] == META or turned:
            splats = restore(project, OriginalRule(embedded=True)) if original is None else original
            if original is None or entry is None or entry.write is None or facts["name"] == META:
                file = target.with_name(f"{target.name}.ply")
                write(file, splats, axes="rdf")
                return file, "auto"
            file = target.with_name(target.name + entry.suffixes[0])
            write(file, splats)
            return file, written_axes(splats, entry.key, "auto")
        file = target.with_name(target.name + (entry.suffixes[0] if entry.suffixes else ".ply"))
        try:
            with open(file, "xb") as stream:
                for name, data in project.original(added.folder if added is not None else ""):
                    if name != facts["name"]:
                        raise ValueError(f"{path}: damaged project file (several files as its original)")
                    stream.write(data)
        except OSError as error:
            raise ValueError(f"{file}: cannot be written ({error.strerror or error})") from None
        axes = option(facts["frame"])
        if entry.key != "spz":
            return file, axes
        # An SPZ file may not say its axes: if reading it as usual gives the same, nobody needs to be told.
        splats, plain = read(file, axes=axes, lenient=True), read(file, lenient=True)
        assert splats.source is not None and plain.source is not None
        if splats.source.axes == plain.source.axes:
            return file, "auto"
        if original is not None:
            return file, option(splats.source.axes)
        file.unlink()
        file = target.with_name(f"{target.name}.ply")
        write(file, splats, axes="rdf")
        return file, "auto"


def restore_added(project: Project, asset: SceneAsset) -> Splats:
    """The original of an asset that was added, with `origin`. Raises ValueError: damaged, other bytes than it had."""
    splats = _unpacked(project, asset.file, asset.axes, asset.folder, asset.offset)
    if splats.sha256 != asset.sha256:
        raise ValueError(
            f"{project.path}: the file of asset {asset.name} is not the one that was added (sha256 differs)"
        )
    if not splats.drawable.any():
        raise ValueError(f"{project.path}: none of the Gaussians of asset {asset.name} can be drawn")
    return numbered(splats)


def _named_file(project: Path, name: str, rule: OriginalRule) -> Path:
    """The original that a project names by `name`. Nothing is looked up before the name has been judged, so that what
    is refused tells nothing about the machine."""
    if rule.at is not None:
        path = rule.at
    elif rule.embedded:
        raise ValueError(
            f"{project}: names a file as its original and does not hold it; save it with embed=True, then send it"
        )
    elif rule.folder is not None:
        path = _inside(project, name, rule.folder)
    elif not is_local_path(name):
        raise ValueError(f"{project}: its original is named by a network or device path; load with original=PATH")
    else:
        path = Path(name)
    # Only now is the disk asked: what the rule refuses has been refused by its name alone.
    name = files.printable(str(path), MAX_PATH_LENGTH)
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        raise ValueError(f"{project}: its original {name} is gone; load with original=PATH if it moved") from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise ValueError(f"{project}: its original {name} is neither a file nor a folder; load with original=PATH")
    return path


def _inside(project: Path, name: str, folder: Path) -> Path:
    """What `name` stands for below `folder`. Raises ValueError, the same one whether it exists or not."""
    outside = ValueError(
        f"{project}: its original lies outside the folder {folder.name}; put both into it, or save it with embed=True"
    )
    # One error for all of it, so that a stranger's project cannot ask what exists.
    root = folder.resolve()
    path = Path(name)
    if path.is_absolute():
        if not path.is_relative_to(root):
            raise outside
        path = path.relative_to(root)
    if not path.parts or not all(is_plain_name(part) for part in path.parts):
        raise outside
    try:
        resolved = (root / path).resolve()
    except (OSError, RuntimeError):  # a circle of links
        raise outside from None
    # From Python 3.13 on a circle of links is no error there: it stays a link.
    if not resolved.is_relative_to(root) or resolved.is_symlink():
        raise outside
    return resolved


def is_plain_name(name: str, windows: bool = os.name == "nt") -> bool:
    """Whether a name stands for an entry of its folder and nothing else. windows: also of a folder there, where colons
    name streams and drives, and some words devices."""
    if name in ("", ".", "..") or re.search(r"[/\\\x00-\x1f]", name):
        return False
    if len(name.encode(errors="surrogatepass")) > MAX_NAME_BYTES:
        return False
    if not windows:
        return True
    device = re.fullmatch(DEVICE_NAME, name.split(".")[0].rstrip(), re.IGNORECASE)
    return not (":" in name or name[-1] in " ." or device)


def is_local_path(name: str, windows: bool = os.name == "nt") -> bool:
    """Whether a path names a file of this machine: no share of another one (opening it would send that one this user's
    credentials), no device."""
    if not windows:
        return PurePosixPath(name).is_absolute()
    drive = PureWindowsPath(name).drive
    return re.fullmatch(r"[A-Za-z]:", drive) is not None and PureWindowsPath(name).is_absolute()


def numbered(splats: Splats) -> Splats:
    """The Gaussians with `origin`: each its own row."""
    return splats if splats.origin is not None else replace(splats, origin=np.arange(len(splats)))


def _unpacked(project: Project, name: str, axes: Axes, stored_under: str = "", offset: Offset = NO_OFFSET) -> Splats:
    if not is_plain_name(name):
        raise ValueError(f"{project.path}: damaged project file (name of the original {name[:40]!r})")
    # In a folder of its own, under plain names: the project decides about no path.
    with scratch_folder("original") as folder:
        try:
            for file, data in project.original(stored_under):
                if not is_plain_name(file):
                    raise ValueError(f"{project.path}: damaged project file (name of the original {file[:40]!r})")
                with open(folder / file, "ab") as target:
                    target.write(data)
            splats = read(folder / name, axes=axes, lenient=True, offset=offset)
        except OSError as error:
            raise ValueError(f"{project.path}: its original cannot be unpacked ({error.strerror or error})") from None
        except ValueError as error:
            raise ValueError(str(error).replace(f"{folder}{os.sep}", "")) from None
    assert splats.source is not None
    return replace(splats, source=replace(splats.source, path=name))


def _members(path: Path) -> list[Path]:
    """The files of an asset: itself, or meta.json and the planes beside it."""
    if path.is_dir():
        path = inside(path, META)
    if path.name.lower() != META:
        return [path]
    return [path, *sorted(plane for plane in path.parent.iterdir() if plane.suffix.lower() == ".webp")]


def receipt_between(
    original: Splats, edited: Splats, preset: str, note: str, precision: str = "", options: WriteOptions = AS_IT_IS
) -> Receipt:
    """The receipt of a whole session: original against edited, as a file with these options holds them. No file yet, so
    `output_sha256` is empty. Rows of which mean, rotation and scales are all others count as replaced."""
    asset_sha256, original, edited = original.sha256, options.applied(original), options.applied(edited)
    touched = changed_rows(original, edited)
    before, after = untouched_hashes(original, edited, touched)
    empty = (edited.opacities[touched] == 0) & (original.opacities[touched] > 0)
    taken = ~empty
    for name in ("means", "quats", "scales"):
        taken &= (getattr(original, name)[touched] != getattr(edited, name)[touched]).any(1)
    return Receipt(
        asset_sha256=asset_sha256,
        asset_rows=len(original),
        output_sha256="",
        output_rows=len(edited),
        mode="session",
        method="layers",
        preset=preset,
        touched=touched,
        replaced=touched[taken],
        removed=touched[empty],
        appended_rows=len(edited) - len(original),
        untouched_sha256_before=before,
        untouched_sha256_after=after,
        note=note,
        precision=precision,
        options=options,
    )


def export_asset(
    original: Splats, edited: Splats, receipt: Receipt, path: Path, overwrite: bool, axes: Axes = "auto"
) -> tuple[Receipt, Verification]:
    """Write an asset in the format that the name says, with the receipt's options and its numbers in `axes`, read it
    again, compare it with the original, and only then let it and its receipt (NAME.receipt.json) appear. Raises
    ValueError: the name, an existing file, a full disk; RuntimeError: what was written does not prove the receipt."""
    check_target(path, overwrite)
    receipt_path = receipt_of(path)
    with partial_folder(path) as folder:
        partial = Path(folder) / path.name
        write(partial, edited, axes=axes, options=receipt.options)
        proved, verification = prove(original, partial, receipt, axes, edited)
        with files.writing(receipt_path) as file:
            file.write(proved.to_json().encode())
            files.replace(partial, path)
    files.sync_folder(path.parent)
    return proved, verification


def export_visible(
    original: Splats, edited: Splats, receipt: Receipt, path: Path, overwrite: bool, axes: Axes = "auto"
) -> tuple[Receipt, Verification]:
    """`export_asset` without the Gaussians of opacity 0. receipt: of the asset with them. What remains is compared with
    what remains of the original, in the same order. Raises ValueError where nothing is visible."""
    visible = np.flatnonzero(edited.opacities > 0)
    if not len(visible):
        raise ValueError(f"{path}: expected something visible to export, everything is hidden")
    base, rest = without_source(original).take(visible[visible < len(original)]), without_source(edited).take(visible)
    gone, appended = len(original) - len(base), len(edited) - len(original) - (len(rest) - len(base))
    dropped = {"asset": original.sha256, "rows": len(original), "left_out": gone, "appended_left_out": appended}
    note = f"{receipt.note}; {gone + appended} hidden Gaussians were removed for good"
    remaining = receipt_between(base, rest, receipt.preset, note, receipt.precision, receipt.options)
    return export_asset(base, rest, replace(remaining, dropped=dropped), path, overwrite, axes)


@contextlib.contextmanager
def partial_folder(path: Path) -> Iterator[str]:
    """A folder beside `path` for what is not complete yet (scratch.sweep_folder knows its name). What goes wrong in the
    block is said of `path`, never of what is in the folder."""
    folder = None
    try:
        with tempfile.TemporaryDirectory(
            prefix=f".{brief_name(path.name)}.", suffix=".part", dir=path.parent
        ) as folder:
            yield folder
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror or error})") from None
    except ValueError as error:
        hidden = f"{folder}{os.sep}"
        if folder is None or hidden not in str(error):
            raise
        raise ValueError(str(error).replace(hidden, f"{path.parent}{os.sep}")) from None


def check_target(path: Path, overwrite: bool) -> None:
    key = format_of_name(path)
    if key is None or FORMATS[key].write is None or path.name.lower() == META:
        endings = ", ".join(entry.suffixes[0] for entry in FORMATS.values() if entry.write is not None)
        raise ValueError(f"{path}: expected a name ending in {endings}")
    check_free(path, overwrite)
    if not path.parent.is_dir():
        raise ValueError(f"{path}: no such folder: {path.parent}; make it first")


def view_options(
    path: Path, bits: int | None, transparent: Alpha | None, aovs: tuple[Aov, ...], profile: Profile
) -> PictureOptions:
    """What the ending of a picture's name and the rest ask for. Raises ValueError."""
    ending = path.suffix.lower()
    if ending not in (".png", ".exr"):
        raise ValueError(f"{path}: expected a name ending in .png or .exr")
    return PictureOptions("png" if ending == ".png" else "exr", bits, transparent, aovs, profile)


def view_files_of(
    splats: Splats, edited: Sequence[conflicts.EditedIds], camera: Camera, stem: str, options: PictureOptions
) -> dict[str, bytes]:
    """A view of a session's asset as files (name -> bytes); its coverage comes from what its layers edited."""
    coverage = None
    if "coverage" in options.aovs:
        kinds = conflicts.coverage(edited, len(splats))
        coverage = (kinds == conflicts.PREDICTED, kinds == conflicts.SEEN)
    return view_files(splats, camera, stem, options, coverage=coverage)


def write_files(folder: Path, contents: Mapping[str, bytes], overwrite: bool) -> list[Path]:
    """Write files into a folder, each complete or not at all; their paths. Raises ValueError: one exists
    and overwrite is False, or cannot be written."""
    paths = [folder / name for name in contents]
    for path in paths:
        check_free(path, overwrite)
    for path, data in zip(paths, contents.values(), strict=True):
        with files.writing(path) as file:
            file.write(data)
    return paths


def write_layer(path: Path, layer: Layer, blob: Callable[[str], bytes], overwrite: bool) -> None:
    """A layer with its pictures as one file: a zip of layer.json and HASH.png. Raises ValueError: it exists
    and overwrite is False, or cannot be written."""
    check_free(path, overwrite)
    with files.writing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as bundle:
        bundle.writestr("layer.json", json.dumps({"version": 1, "layer": layer.record()}))
        for name in sorted(layer.blobs()):
            bundle.writestr(f"{name}.png", blob(name))


def read_layer(path: Path) -> tuple[Layer, dict[str, bytes]]:
    """(layer, its pictures by hash) of a layer file. Raises ValueError naming the file and what is wrong with it."""
    try:
        # Members are judged by what they claim before any is unpacked.
        data = files.read_all(path)
        with zipfile.ZipFile(io.BytesIO(data)) as bundle:
            if sum(info.file_size for info in bundle.infolist()) > len(data):  # they may lie over each other
                raise ValueError("its members claim more bytes than the file has")
            record = json.loads(_member(bundle, "layer.json"))
            if not isinstance(record, dict) or record.get("version") != 1:
                raise ValueError("expected a layer of version 1")
            layer = Layer.parse(record.get("layer") or {}, str(path))
            blobs = {name: _member(bundle, f"{name}.png") for name in layer.blobs()}
    except LAYER_FILE_ERRORS as error:
        reason = files.printable(str(error).removeprefix(f"{path}: "), MAX_REASON)
        raise ValueError(f"{path}: expected a {LAYER_SUFFIX} file ({reason})") from None
    for name, data in blobs.items():
        if files.sha256(data) != name:
            raise ValueError(f"{path}: damaged (picture {name[:12]}...)")
    return layer, blobs


def _member(bundle: zipfile.ZipFile, name: str) -> bytes:
    info = bundle.getinfo(name)
    if info.file_size > MAX_MEMBER_BYTES or info.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is too large or compressed")
    return bundle.read(info)
