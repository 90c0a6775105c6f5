"""The files of a SOG asset: a .sog bundle (zip) or a folder, in with every size judged first, out all or nothing."""

from __future__ import annotations

import contextlib
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpainter.io import files
from splatpainter.io.bounded import TAIL, allow

META = "meta.json"
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
    return path.name.lower() == META or path.is_dir()


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
            if not isinstance(name, str) or name in (".", "..", META) or not _PLAIN_NAME.fullmatch(name):
                raise ValueError(f"{where}: {META} names {name!r} for {part}; expected a plain file name")
            names.append(name)
    return names


def parse(data: bytes, where: Path | str) -> dict[str, Any]:
    """meta.json as a dict. Raises ValueError where it is not one."""
    if len(data) > TAIL:
        raise ValueError(f"{where}: {META} has {len(data)} bytes; the file is damaged or hostile")
    try:
        meta = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where}: {META} is not JSON ({' '.join(str(error).split())[:80]})") from None
    if not isinstance(meta, dict):
        raise ValueError(f"{where}: expected an object in {META}, found {type(meta).__name__}")
    return meta


def _load_folder(path: Path) -> tuple[Container, dict[str, Any]]:
    folder = path if path.is_dir() else path.parent
    found = {META: files.read_all(folder / META)}
    meta = parse(found[META], folder)
    for name in named_files(meta, folder):
        found[name] = files.read_all(folder / name)
    digest = files.sha256(b"".join(name.encode() + b"\0" + found[name] for name in sorted(found)))
    return Container(found, True, digest, b""), meta


def _load_bundle(path: Path) -> tuple[Container, dict[str, Any]]:
    data = files.read_all(path)
    found: dict[str, bytes] = {}
    with _zip_errors(path):
        archive = zipfile.ZipFile(io.BytesIO(data))
        entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    allow(len(data), sum(entry.file_size for entry in entries), path, "the bundle")
    for entry in entries:
        _check_entry(entry, found, path)
        with _zip_errors(path):
            found[entry.filename] = archive.read(entry)
    if META not in found:
        raise ValueError(f"{path}: expected {META} in the bundle, found {', '.join(sorted(found)[:5]) or 'nothing'}")
    meta = parse(found[META], path)
    for name in named_files(meta, path):
        if name not in found:
            raise ValueError(f"{path}: {META} names {name}, which is not in the bundle")
    return Container(found, False, files.sha256(data), data), meta


@contextlib.contextmanager
def _zip_errors(path: Path) -> Iterator[None]:
    """zipfile answers damage with a dozen kinds of exception."""
    try:
        yield
    except (
        zipfile.BadZipFile,
        zlib.error,
        struct.error,
        EOFError,
        OSError,
        RuntimeError,
        ValueError,
        OverflowError,
    ) as e:
        raise ValueError(f"{path}: damaged bundle ({' '.join(str(e).split())[:120]})") from None


def _check_entry(entry: zipfile.ZipInfo, found: dict[str, bytes], path: Path) -> None:
    name = entry.filename
    if any(not _PLAIN_NAME.fullmatch(part) or part in (".", "..") for part in name.split("/")):
        raise ValueError(f"{path}: the bundle holds the name {name!r}, which leaves its folder")
    if name in found:
        raise ValueError(f"{path}: the bundle holds {name} twice")
    if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(
            f"{path}: {name} is encrypted or packed by method {entry.compress_type}; expected stored or deflated"
        )
