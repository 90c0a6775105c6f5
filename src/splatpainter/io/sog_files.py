"""The files of a SOG asset: a .sog bundle (zip) or a folder, in with every size judged first, out all or nothing."""

from __future__ import annotations

import contextlib
import io
import os
import re
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpainter import jsonio
from splatpainter.io import files
from splatpainter.io.bounded import allow, inflate, zip_directory
from splatpainter.jsonio import brief

META = "meta.json"
_LOCAL = struct.Struct("<4s5H3I2H")
"""Local file header: signature, version, flags, method, time, date, CRC, sizes (2), lengths of name and extra field."""
_PLAIN_NAME = re.compile(r"[^/\\:\x00-\x1f]+")


@dataclass(frozen=True)
class Container:
    """Files by name, in order."""

    files: dict[str, bytes]
    """What meta.json names, meta.json itself, and in a bundle everything else."""
    folder: bool
    sha256: str
    whole: bytes
    """The bundle as it is on disk; b"" for a folder."""


def is_folder(path: Path) -> bool:
    """Whether `path` means a folder of planes: the folder, or its meta.json."""
    return path.name.lower() == META or os.path.isdir(path)


def load(path: Path) -> tuple[Container, dict[str, Any]]:
    """The files at `path` (.sog, folder, or a folder's meta.json) and the parsed meta.json.

    Raises ValueError: not a zip or damaged, names that leave the folder, sizes that cannot be honest, missing files.
    """
    return _load_folder(path) if is_folder(path) else _load_bundle(path)


def store(path: Path, entries: dict[str, bytes], whole: bytes = b"") -> None:
    """Write a bundle (name ending in .sog) or the files of a folder, meta.json last.

    whole: the bundle of `entries` where its bytes are known. In a folder, a bundle's entries that lie in folders of
    their own are left out. Raises ValueError for other names.
    """
    if is_folder(path):
        folder = path if path.is_dir() else path.parent
        with contextlib.suppress(OSError):
            folder.mkdir(exist_ok=True)
        with contextlib.ExitStack() as stack:
            # Files appear when the stack unwinds, the last entered first: meta.json, entered first, appears last.
            for name in sorted((name for name in entries if "/" not in name), key=lambda name: name != META):
                stack.enter_context(files.writing(folder / name)).write(entries[name])
        return
    if path.suffix.lower() != ".sog":
        raise ValueError(f"{path}: expected a name ending in .sog, or meta.json for a folder of planes")
    with files.writing(path) as target:
        target.write(whole or bundle(entries))


def bundle(entries: dict[str, bytes]) -> bytes:
    """A zip of `entries`, stored (the planes are compressed already), the same bytes for the same entries."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, data in entries.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)
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


def parse(data: bytes, where: Path | str) -> dict[str, Any]:
    """meta.json as a dict. Raises ValueError where it is not one."""
    return jsonio.load_object(data, where, META)


def declared_rows(path: Path) -> int:
    """The row count that the meta.json of a bundle speaks of; nothing else is unpacked. Raises ValueError."""
    data = files.read_all(path)
    entry = next((entry for entry in _entries(data, path) if entry.filename == META), None)
    if entry is None:
        raise ValueError(f"{path}: expected {META} in the bundle")
    if entry.file_size > jsonio.MAX_JSON_BYTES:
        raise ValueError(f"{path}: {META} claims {entry.file_size} bytes; expected {jsonio.MAX_JSON_BYTES} at most")
    return jsonio.integer(parse(_unpacked(data, entry, path), path).get("count"), path, "count")


def _load_folder(path: Path) -> tuple[Container, dict[str, Any]]:
    folder = path if os.path.isdir(path) else path.parent
    found = {META: files.read_all(folder / META)}
    meta = parse(found[META], folder)
    for name in named_files(meta, folder):
        found[name] = files.read_all(folder / name)
    digest = files.sha256(b"".join(name.encode() + b"\0" + found[name] for name in sorted(found)))
    return Container(found, True, digest, b""), meta


def _load_bundle(path: Path) -> tuple[Container, dict[str, Any]]:
    data = files.read_all(path)
    entries = _entries(data, path)
    # All claims together, before the first is unpacked; entries that lie over each other cannot all be there.
    allow(len(data), sum(entry.file_size for entry in entries), path, "the bundle")
    if sum(entry.compress_size for entry in entries) > len(data):
        raise ValueError(f"{path}: damaged bundle (its files need more bytes than it has)")
    found = {entry.filename: _unpacked(data, entry, path) for entry in entries}
    if META not in found:
        names = files.printable(", ".join(sorted(found)[:5]))
        raise ValueError(f"{path}: expected {META} in the bundle, found {names or 'nothing'}")
    meta = parse(found[META], path)
    for name in named_files(meta, path):
        if name not in found:
            raise ValueError(f"{path}: {META} names {files.printable(name)}, which is not in the bundle")
    return Container(found, False, files.sha256(data), data), meta


def _entries(data: bytes, path: Path) -> list[zipfile.ZipInfo]:
    """The files that the zip directory lists, folders left out, each of a kind that can be unpacked."""
    entries: dict[str, zipfile.ZipInfo] = {}
    for entry in zip_directory(io.BytesIO(data), path):
        name = entry.filename
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
