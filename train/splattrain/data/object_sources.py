"""Where training objects come from, behind one interface: procedural objects, folders of meshes, folders of splats."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from splatpainter.splats import Splats
from splattrain.data.meshes import SUFFIXES, Mesh, load_mesh


@runtime_checkable
class ObjectSource(Protocol):
    """A numbered list of objects. `skipped` is filled as bad files are met: name -> the one line that says why."""

    skipped: dict[str, str]

    def __len__(self) -> int: ...

    def name(self, i: int) -> str:
        """A name that stays the same wherever the object stands in the list."""
        ...


@runtime_checkable
class MeshSource(ObjectSource, Protocol):
    def mesh(self, i: int) -> Mesh:
        """Object i, normalised (data/meshes.py). Raises ValueError (and notes it in `skipped`) for a bad file."""
        ...


@runtime_checkable
class SplatSource(ObjectSource, Protocol):
    def splats(self, i: int) -> Splats:
        """Asset i as read, numpy. Raises ValueError (and notes it in `skipped`) for a bad file."""
        ...


class ProceduralSource:
    """`count` composed objects (data/procedural.py); needs no files. textures: a folder of photos used now and then."""

    def __init__(self, count: int, seed: int = 0, textures: str | Path | None = None) -> None:
        if count < 1:
            raise ValueError(f"procedural: expected at least one object, got {count}")
        self.count, self.seed, self.textures = count, seed, textures
        self.skipped: dict[str, str] = {}

    def __len__(self) -> int:
        return self.count

    def name(self, i: int) -> str:
        return f"procedural-{self.seed}-{i}"

    def mesh(self, i: int) -> Mesh:
        from splattrain.data.procedural import random_mesh

        if not 0 <= i < self.count:
            raise IndexError(i)
        return random_mesh(object_seed(self.seed, i), self.textures)


class MeshFolder:
    """The meshes in a folder (recursive, by relative path in name order). names: only these, with or without suffix."""

    def __init__(self, path: str | Path, names: Sequence[str] | None = None) -> None:
        self.path = Path(path)
        self.files = _files(self.path, SUFFIXES, names, "mesh")
        self.skipped: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self.files)

    def name(self, i: int) -> str:
        return _name(self.files[i], self.path)

    def mesh(self, i: int) -> Mesh:
        try:
            return load_mesh(self.files[i])
        except ValueError as error:
            self.skipped[self.name(i)] = str(error)
            raise


class SplatFolder:
    """The splat assets in a folder, of any format that the package reads (not recursive; names as in MeshFolder)."""

    def __init__(self, path: str | Path, names: Sequence[str] | None = None) -> None:
        self.path = Path(path)
        self.files = _files(self.path, SPLAT_SUFFIXES, names, "splat asset", recursive=False)
        self.skipped: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self.files)

    def name(self, i: int) -> str:
        return self.files[i].name

    def splats(self, i: int) -> Splats:
        from splatpainter.io import read

        try:
            return read(self.files[i])
        except ValueError as error:
            self.skipped[self.name(i)] = str(error)
            raise


HELD_OUT_SHARE = 0.1
"""Share of the objects that no training sees unless it is told otherwise, and that benches measure."""
SPLAT_SUFFIXES = (".ply", ".splat", ".spz", ".sog", ".ksplat", ".glb")


def split(names: Sequence[str], seed: int = 0, share: float = HELD_OUT_SHARE) -> tuple[list[str], list[str]]:
    """(train, validation) names, each in the given order. A name's side depends on the name and the seed alone, so that
    adding objects moves none; `share` of many names lands in validation."""
    if not 0 <= share < 1:
        raise ValueError(f"split: expected a share of 0 up to 1 for validation, got {share}")
    digests = [hashlib.sha256(f"{seed}:{name}".encode()).digest() for name in names]
    validation = [int.from_bytes(digest[:8], "little") / 2.0**64 < share for digest in digests]
    train = [name for name, out in zip(names, validation, strict=True) if not out]
    return train, [name for name, out in zip(names, validation, strict=True) if out]


def object_seed(seed: int, i: int) -> int:
    """A 63-bit seed for object i of a source: neighbouring seeds and numbers give unrelated objects."""
    return int.from_bytes(hashlib.sha256(f"object:{seed}:{i}".encode()).digest()[:8], "little") >> 1


def _name(file: Path, folder: Path) -> str:
    return file.relative_to(folder).with_suffix("").as_posix()


def _files(
    folder: Path, suffixes: tuple[str, ...], names: Sequence[str] | None, what: str, recursive: bool = True
) -> list[Path]:
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; expected a folder of {what} files")
    paths = sorted(folder.rglob("*") if recursive else folder.iterdir())
    files = [file for file in paths if file.suffix.lower() in suffixes and file.is_file()]
    if names is not None:
        by_name = {_name(file, folder): file for file in files} | {f.relative_to(folder).as_posix(): f for f in files}
        missing = [name for name in names if name not in by_name]
        if missing:
            raise ValueError(f"{folder}: holds no {what} named {missing[0]!r} ({len(missing)} names are missing)")
        files = [by_name[name] for name in names]
    if not files:
        raise ValueError(f"{folder}: holds no {what} files ({', '.join(suffixes)})")
    return files
