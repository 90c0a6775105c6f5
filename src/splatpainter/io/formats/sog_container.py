"""The files of a SOG asset, as a zip (.sog) or a folder: what may be in them, and where. Knows no planes.

A bundle that was zipped by hand has its files inside one folder, often beside the __MACOSX of macOS: it is opened, and
what is written over it keeps that form.
"""

from __future__ import annotations

import contextlib
import io
import os
import posixpath
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

from splatpainter.io import files
from splatpainter.io.bounded import allow, inflate, zip_directory
from splatpainter.io.folders import inside
from splatpainter.io.foreign_files import EXPORT_ADVICE, SPLATS, USD_SCENE
from splatpainter.system import jsonio
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass

META = "meta.json"
OTHER_ZIPS = (
    ("/data.pkl", "a checkpoint of a trainer", EXPORT_ADVICE),
    (".npy", "arrays of numpy (npz)", "save them as .ply (sp.write)"),
    *((ending, *USD_SCENE) for ending in (".usdc", ".usda", ".usd")),
    ("/mergedimage.png", "a picture in layers", SPLATS),
)
"""(ending of a name inside, what such a zip is, what to do)."""
LOD_META = "lod-meta.json"
"""What a streamed SOG has in its place."""
APPLE_FOLDER = "__MACOSX"
"""Folder of a zip that macOS made, with a shadow ._NAME of every file."""
_LOCAL = struct.Struct("<4s5H3I2H")
"""Local file header: signature, version, flags, method, time, date, CRC, sizes (2), lengths of name and extra field."""
_PLAIN_NAME = re.compile(r"[^/\\:\x00-\x1f]+")


@dataclass(frozen=True)
class Container:
    """Files by name, in order."""

    files: dict[str, bytes]
    """What meta.json names, meta.json itself, and in a bundle everything else; by names relative to meta.json's
    folder."""
    folder: bool
    sha256: str
    bundle_bytes: bytes
    """The bundle as it is on disk; b"" for a folder."""
    prefix: str = ""
    """Folder of the bundle that meta.json lies in, with a slash behind it; "": none."""


def is_folder(path: Path) -> bool:
    """Whether `path` means a folder of planes: the folder, or its meta.json."""
    return path.name.lower() == META or os.path.isdir(path)


def load(path: Path) -> tuple[Container, dict[str, Any]]:
    """The files at `path` (.sog, folder, or a folder's meta.json) and the parsed meta.json.

    Raises ValueError: not a zip or damaged, names that leave the folder, sizes that cannot be honest, missing files.
    """
    return _load_folder(path) if is_folder(path) else _load_bundle(path)


def store(path: Path, entries: dict[str, bytes], prefix: str = "", bundle_bytes: bytes = b"") -> None:
    """Write a bundle (name ending in .sog) or the files of a folder, meta.json last.

    prefix, bundle_bytes: as of Container, the bytes where those of the bundle of `entries` are known. In a folder, a
    bundle's entries that lie in folders of their own are left out. Raises ValueError for other names.
    """
    if is_folder(path):
        folder = path if path.is_dir() else path.parent
        with contextlib.suppress(OSError):
            folder.mkdir(exist_ok=True)
        with contextlib.ExitStack() as stack:
            # Files appear when the stack unwinds, the last entered first: meta.json, entered first, appears last.
            for name in sorted((name for name in entries if "/" not in name), key=lambda name: name != META):
                stack.enter_context(files.writing(inside(folder, name))).write(entries[name])
        return
    if path.suffix.lower() != ".sog":
        raise ValueError(f"{path}: expected a name ending in .sog, or meta.json for a folder of planes")
    with files.writing(path) as target:
        target.write(bundle_bytes or _bundle(entries, prefix))


def _bundle(entries: dict[str, bytes], prefix: str) -> bytes:
    """A zip of `entries`, stored (the planes are compressed already), the same bytes for the same entries."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, data in entries.items():
            info = zipfile.ZipInfo(posixpath.normpath(prefix + name), (1980, 1, 1, 0, 0, 0))
            info.create_system = 3  # Unix, also on Windows, whose own number zipfile would write
            archive.writestr(info, data)
    return out.getvalue()


def named_files(meta: dict[str, Any], where: Path | str) -> list[str]:
    """The files that meta.json names, in its order. Raises ValueError for a name that is not a plain file name."""
    names = []
    for part in ("means", "scales", "quats", "sh0", "shN"):
        entry = meta.get(part)
        listed = entry.get("files") if isinstance(entry, dict) else None
        for name in listed if isinstance(listed, list) else []:
            plain = isinstance(name, str) and name.isprintable() and _PLAIN_NAME.fullmatch(name)
            if not plain or name in (".", "..", META):
                raise ValueError(f"{where}: {META} names {brief(name)} for {part}; expected a plain file name")
            names.append(name)
    return names


def _parse_meta(data: bytes, where: Path | str) -> dict[str, Any]:
    """meta.json as a dict. Raises ValueError where it is not one."""
    return jsonio.load_object(data, where, META)


def declared_rows(path: Path) -> int:
    """The row count that the meta.json of a bundle speaks of; nothing else is unpacked. Raises ValueError."""
    data = files.read_all(path)
    entries = {entry.filename: entry for entry in _entries(data, path)}
    entry = entries[_meta_entry(list(entries), path)]
    if entry.file_size > jsonio.MAX_JSON_BYTES:
        raise ValueError(f"{path}: {META} claims {entry.file_size} bytes; expected {jsonio.MAX_JSON_BYTES} at most")
    return jsonio.integer(_parse_meta(_unpacked(data, entry, path), path).get("count"), path, "count")


def _load_folder(path: Path) -> tuple[Container, dict[str, Any]]:
    folder = path if os.path.isdir(path) else path.parent
    contents = {META: files.read_all(inside(folder, META))}
    meta = _parse_meta(contents[META], folder)
    for name in named_files(meta, folder):
        contents[name] = files.read_all(inside(folder, name))
    digest = files.sha256(b"".join(name.encode() + b"\0" + contents[name] for name in sorted(contents)))
    return Container(contents, True, digest, b""), meta


def _load_bundle(path: Path) -> tuple[Container, dict[str, Any]]:
    data = files.read_all(path)
    entries = _entries(data, path)
    # All claims together, before the first is unpacked; entries that lie over each other cannot all be there.
    allow(len(data), sum(entry.file_size for entry in entries), path, "the bundle")
    if sum(entry.compress_size for entry in entries) > len(data):
        raise ValueError(f"{path}: damaged bundle (its files need more bytes than it has)")
    listed = _meta_entry([entry.filename for entry in entries], path)
    prefix = listed[: -len(META)]
    contents = {posixpath.relpath(entry.filename, prefix or "."): _unpacked(data, entry, path) for entry in entries}
    contents = _renamed(contents, META)
    meta = _parse_meta(contents[META], path)
    # From here on files are called as meta.json calls them, whatever capitals the bundle has.
    for name in named_files(meta, path):
        contents = _renamed(contents, name)
        if name not in contents:
            raise ValueError(f"{path}: {META} names {files.printable(name)}, which is not in the bundle")
    return Container(contents, False, files.sha256(data), data, prefix), meta


def _renamed(contents: dict[str, bytes], name: str) -> dict[str, bytes]:
    """The same files, in order, with that one called `name` that is called so but for capitals, if it is the only
    one."""
    alike = [] if name in contents else [one for one in contents if one.lower() == name.lower()]
    return {name if [one] == alike else one: data for one, data in contents.items()} if alike else contents


def _meta_entry(names: list[str], path: Path) -> str:
    """A bundle's meta.json, in any capitals: at the top or in the only folder that has one. Raises ValueError: none,
    several, or a streamed SOG."""
    if META in names:
        return META
    visible = [name for name in names if name.split("/")[0] != APPLE_FOLDER]
    streamed = next((name for name in visible if name.rpartition("/")[2] == LOD_META), None)
    if streamed is not None:
        raise ValueError(streamed_reason(path, f"{files.printable(streamed)} in it"))
    matches = [name for name in visible if name.lower() == META]
    matches = matches or [name for name in visible if name.lower().endswith(f"/{META}")]
    if len(matches) == 1:
        return matches[0]
    folders = [name[: -len(META)] or META for name in matches]
    listed = files.printable(", ".join(sorted(folders or visible)[:5])) or "nothing"
    expected = f"{META} in one folder of the bundle" if folders else f"{META} in the bundle"
    inside = next((name for name in visible if name.lower().endswith((".ply", ".spz", ".splat", ".ksplat"))), None)
    remedy = "" if inside is None else f"; unpack it, then open {files.printable(inside)}"
    for ending, what, advice in () if inside else OTHER_ZIPS:
        if any(name.lower().endswith(ending) for name in names):
            raise ValueError(f"{path}: is {what}, not a splat file; {advice}")
    raise ValueError(f"{path}: expected {expected}, found {listed}{remedy}")


def streamed_reason(path: Path, where: str = LOD_META) -> str:
    """Why a streamed SOG is not opened, and what can be: one line."""
    return (
        f"{path}: a streamed SOG ({where}) holds one scene in levels of detail and chunks, which cannot be edited "
        f"together; open a chunk of it alone (a folder with {META}, such as 0_0), or save the scene as one .sog or .ply"
    )


def is_streamed(path: Path) -> bool:
    """Whether a file or folder is a streamed SOG, or its lod-meta.json, by name."""
    return path.name.lower() == LOD_META or (os.path.isdir(path) and os.path.isfile(path / LOD_META))


def _entries(data: bytes, path: Path) -> list[zipfile.ZipInfo]:
    """The files that the zip directory lists, folders left out, each of a kind that can be unpacked."""
    entries: dict[str, zipfile.ZipInfo] = {}
    for entry in zip_directory(io.BytesIO(data), path):
        # Some programs for Windows write backslashes, and some others "./" before every name.
        name = entry.filename = entry.filename.replace("\\", "/").removeprefix("./")
        if name.endswith("/"):  # is_dir() of Python 3.11 fails where the name is empty
            continue
        parts = name.split("/")
        if any(not _PLAIN_NAME.fullmatch(part) or part in (".", "..") for part in parts) or not name.isprintable():
            raise ValueError(f"{path}: the bundle holds the name {brief(name)}, which leaves its folder")
        if name in entries:
            raise ValueError(f"{path}: the bundle holds {files.printable(name)} twice")
        if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(
                f"{path}: {files.printable(name)} is encrypted or packed by method {entry.compress_type}; expected "
                "stored or deflated"
            )
        entries[name] = entry
    return list(entries.values())


def _unpacked(data: bytes, entry: zipfile.ZipInfo, path: Path) -> bytes:
    """One file of a bundle: exactly the bytes that the directory declares, or ValueError.

    ZipFile.read would unpack the whole stream and then cut it to the declared size without a word.
    """
    what = f"{files.printable(entry.filename)} in the bundle"
    head = files.take(data, entry.header_offset, _LOCAL.size, path, what)
    mark, *_, name, extra = _LOCAL.unpack(head)
    if mark != b"PK\x03\x04":
        raise ValueError(f"{path}: damaged: {what} does not begin where the directory says")
    packed = files.take(data, entry.header_offset + _LOCAL.size + name + extra, entry.compress_size, path, what)
    if entry.compress_type == zipfile.ZIP_DEFLATED:
        out = inflate(packed, entry.file_size, path, what)
    elif entry.file_size != entry.compress_size:
        raise ValueError(f"{path}: damaged: {what} is stored, but its two sizes differ")
    else:
        out = bytes(packed)
    if zlib.crc32(out) != entry.CRC:
        raise ValueError(f"{path}: damaged: {what} does not fit its checksum")
    return out
