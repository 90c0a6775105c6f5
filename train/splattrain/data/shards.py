"""Shards: WebDataset tar files with a JSON index, written so that a run can be killed at any moment; read by number.

    shard-00000.tar ...     the files of a sample (records.py) as KEY.NAME, KEY = SCENE_STEP (000012_03)
    index.json              what was rendered, how, from what; per shard its bytes, SHA-256 and samples
    .scenes/                finished scenes that wait for their shard to fill

A scene (one object, its samples) is written aside as soon as it is finished, whole or not at all. A shard is the next
`per_shard` scenes in order, so that shards have the same bytes however many workers there were, in whatever order they
finished, and however often the run was killed. Tar files are written by `tarfile` rather than webdataset's TarWriter:
the latter stamps the time and its user into every header.

ShardStream reads them back with the interface of samples.SampleStream. The order is decided by (seed, epoch): scenes in
a new random order each epoch, the samples of a scene one after another (they share an asset, and an asset is encoded
once). So position i alone says where to go on.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import shutil
import tarfile
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from splatpainter.io import files
from splatpainter.splats import Splats
from splatpainter.system.recent import Recent
from splattrain.data.records import Files, decode_asset, decode_sample
from splattrain.data.samples import Sample

if TYPE_CHECKING:
    from filelock import BaseFileLock

INDEX, WAITING, LOCK = "index.json", ".scenes", ".lock"
FORMAT, VERSION = "splatpainter-shards", 1
OPEN_SHARDS, ASSETS = 256, 4
"""Tables of contents, and assets, that stay in memory."""
Contents = dict[str, dict[str, tuple[int, int]]]
"""A shard's files: key -> name -> (offset, size)."""


@dataclass(frozen=True)
class RenderedScene:
    """Result of rendering one scene."""

    name: str
    """Name of its object."""
    samples: Sequence[Files] = ()
    """Samples in order."""
    kinds: Sequence[str] = ()
    """One per sample."""
    skipped: Sequence[str] = ()
    """One line for the object, or for each sample, that could not be made."""


class ShardWriter:
    """Collects scenes 0..scenes-1 in any order into shards below `folder`; use it as a context manager.

    spec: everything that decides what the samples are (JSON values): a folder that holds shards of another spec is
    refused, one of the same is carried on, also with more scenes than before. One writer per folder at a time."""

    def __init__(self, folder: Path, spec: Mapping[str, Any], scenes: int, per_shard: int = 32) -> None:
        """Raises ValueError: another spec, another writer, a broken index, a folder that cannot be written."""
        self.folder, self.scenes = folder, scenes
        self._waiting = folder / WAITING
        try:
            self._waiting.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"{folder}: cannot be made ({error.strerror or error})") from None
        self._lock = _locked(folder)
        try:
            self.index = self._opened(json.loads(json.dumps(dict(spec))), per_shard)
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def missing(self) -> list[int]:
        """Scenes that are not finished yet."""
        waiting = {int(path.stem) for path in self._waiting.glob("[0-9]*.tar")}
        return [scene for scene in range(self.index["done"], self.scenes) if scene not in waiting]

    def add(self, number: int, scene: RenderedScene) -> None:
        """Keep a finished scene, and write every shard that is full with it. Raises ValueError when the disk will not
        take it; then nothing of the scene (or of the shard) is there."""
        about = {"scene": number, "object": scene.name, "kinds": list(scene.kinds), "skipped": list(scene.skipped)}
        with files.writing(self._waiting / f"{number:06d}.tar") as file, _tar(file) as tar:
            _put(tar, "about.json", json.dumps(about).encode())
            for step, sample in enumerate(scene.samples):
                for name, data in sample.items():
                    _put(tar, f"{number:06d}_{step:02d}.{name}", data)
        self._gather()

    def _opened(self, spec: dict[str, Any], per_shard: int) -> dict[str, Any]:
        for path in [*self._waiting.glob(".*.part"), *self.folder.glob(".*.part")]:  # of a killed run
            path.unlink(missing_ok=True)
        if not (self.folder / INDEX).exists():
            index = {"format": FORMAT, "version": VERSION, "spec": spec, "per_shard": per_shard}
            index |= {"done": 0, "scenes": self.scenes, "shards": [], "skipped": []}
            self._save(index)
            return index
        index = read_index(self.folder)
        for key in sorted({*spec, *index["spec"]}):
            if spec.get(key) != index["spec"].get(key):
                stored, requested = _short(index["spec"].get(key)), _short(spec.get(key))
                raise ValueError(
                    f"{self.folder}: holds shards of another run ({key} was {stored}, now {requested}); "
                    "use the same options to carry it on, or another folder"
                )
        self.scenes = max(self.scenes, index["done"])
        if index["scenes"] != self.scenes:
            index["scenes"] = self.scenes
            self._save(index)
        for path in self._waiting.glob("[0-9]*.tar"):
            if int(path.stem) < index["done"]:
                path.unlink()
        self.index = index
        self._gather()
        return self.index

    def _gather(self) -> None:
        """Write the shards whose scenes have all arrived."""
        while self.index["done"] < self.scenes:
            first = self.index["done"]
            last = min(first + self.index["per_shard"], self.scenes)
            waiting = [self._waiting / f"{scene:06d}.tar" for scene in range(first, last)]
            if not all(path.exists() for path in waiting):
                return
            self._merge(waiting, last)
        shutil.rmtree(self._waiting, ignore_errors=True)

    def _merge(self, waiting: list[Path], done: int) -> None:
        name = f"shard-{len(self.index['shards']):05d}.tar"
        scenes, skipped = [], []
        with files.writing(self.folder / name) as file:
            hashed = _Hashed(file)
            with _tar(hashed) as tar:
                for path in waiting:
                    about, keys = _copy(path, tar)
                    record = {
                        "scene": about["scene"],
                        "object": about["object"],
                        "samples": keys,
                        "kinds": about["kinds"],
                    }
                    scenes += [record] if keys else []
                    skipped += [
                        {"scene": about["scene"], "object": about["object"], "reason": r} for r in about["skipped"]
                    ]
        index = dict(self.index, done=done, skipped=self.index["skipped"] + skipped)
        if scenes:
            entry = {"file": name, "bytes": hashed.count, "sha256": hashed.digest.hexdigest(), "scenes": scenes}
            index["shards"] = [*index["shards"], entry]
        else:
            (self.folder / name).unlink()
        self._save(index)
        self.index = index
        for path in waiting:
            path.unlink()

    def _save(self, index: dict[str, Any]) -> None:
        with files.writing(self.folder / INDEX) as file:
            file.write(json.dumps(index, indent=1).encode() + b"\n")


def read_index(folder: Path) -> dict[str, Any]:
    """index.json of a folder of shards. Raises ValueError when it is missing, broken or of another version."""
    path = folder / INDEX
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; expected a folder of shards with {INDEX}")
    try:
        index = json.loads(files.read_all(path))
        version = (index["format"], index["version"])
        lists = [index["shards"], index["skipped"]]
        counts_read = [index["done"], index["scenes"], index["per_shard"]]
        if not all(isinstance(v, list) for v in lists) or not all(isinstance(v, int) for v in counts_read):
            raise TypeError("a field of another kind")
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: is not an index of shards ({type(error).__name__}: {error})") from None
    if version != (FORMAT, VERSION):
        raise ValueError(f"{path}: expected {FORMAT} version {VERSION}, got {version[0]!r} version {version[1]!r}")
    return index


def damage(folder: Path, entry: Mapping[str, Any], contents: bool = True) -> str | None:
    """What is wrong with a shard of the index, None if nothing. contents: also compare its checksum (reads it all)."""
    path = folder / str(entry["file"])
    if not path.is_file():
        return f"{path}: is missing"
    size = path.stat().st_size
    if size != entry["bytes"]:
        return f"{path}: has {size:,} bytes, expected {entry['bytes']:,}: cut short, or still being copied"
    if contents:
        try:
            digest = files.file_sha256(path)
        except ValueError as error:
            return str(error)
        if digest != entry["sha256"]:
            return f"{path}: has another checksum than when it was written: damaged or changed"
    return None


@dataclass(frozen=True)
class Health:
    """Result of `check`."""

    shards: int
    samples: int
    """Samples of whole shards."""
    scenes: int
    """Scenes of the run."""
    finished: int
    """Scenes that are in shards, or were skipped."""
    waiting: int
    """Finished scenes whose shard is not full yet."""
    skipped: int
    """Objects and samples that could not be made."""
    problems: tuple[str, ...]

    @property
    def complete(self) -> bool:
        return not self.problems and self.finished == self.scenes


def check(folder: Path) -> Health:
    """Compare every shard with the index. Raises ValueError when there is no readable index."""
    index = read_index(folder)
    problems, samples = [], 0
    for entry in index["shards"]:
        wrong = damage(folder, entry)
        problems += [wrong] if wrong else []
        samples += 0 if wrong else sum(len(scene["samples"]) for scene in entry["scenes"])
    listed = {entry["file"] for entry in index["shards"]}
    problems += [f"{path}: is not in the index" for path in sorted(folder.glob("*.tar")) if path.name not in listed]
    waiting = len(list((folder / WAITING).glob("[0-9]*.tar")))
    counts = (len(index["shards"]), samples, index["scenes"], index["done"], waiting, len(index["skipped"]))
    return Health(*counts, tuple(problems))


@dataclass(frozen=True)
class _SceneKeys:
    shard: int
    samples: tuple[str, ...]


class ShardStream:
    """stream[i] -> Sample for every i >= 0; equal (shards, seed, i) give equal samples, in any order of access.

    names: only samples of these objects (see scenes.split); kinds: only these. strict: a damaged shard is an error;
    otherwise the samples of the next whole scene of the epoch stand in for its own, and `skipped` counts them.
    checksums: compare a shard with its SHA-256 before its first use (once per process); sizes always are."""

    def __init__(
        self,
        folder: str | Path,
        seed: int = 0,
        *,
        names: Sequence[str] | None = None,
        kinds: Sequence[str] | None = None,
        strict: bool = False,
        checksums: bool = True,
    ) -> None:
        """Raises ValueError: no index, or no samples of these names and kinds in it."""
        self.folder, self.seed, self.strict, self.checksums = Path(folder), seed, strict, checksums
        self.index = read_index(self.folder)
        self.skipped: dict[str, str] = {}
        """Damaged shard -> what is wrong with it."""
        self.replaced = 0
        """Samples asked for that others stood in for."""
        self._shards: list[dict[str, Any]] = self.index["shards"]
        self._scenes = _chosen(self._shards, names, kinds)
        self._ends: tuple[int, list[int], list[int]] | None = None
        self._contents = Recent[Contents](OPEN_SHARDS)
        self._assets = Recent[Splats](ASSETS)
        self._total = sum(len(scene.samples) for scene in self._scenes)
        if not self._total:
            raise ValueError(f"{self.folder}: holds no samples of the objects and kinds asked for")

    def __len__(self) -> int:
        """Samples per epoch."""
        return self._total

    def __getitem__(self, index: int) -> Sample:
        """Raises ValueError: a damaged shard (strict), none that is whole, or a sample that cannot be decoded."""
        files_of, key = self.files(index)
        return decode_sample(files_of, f"{self.folder}: {key}", self._asset(files_of))

    def files(self, index: int) -> tuple[Files, str]:
        """(the files of sample `index`, its key): for what a Sample leaves out, such as 16-bit pictures."""
        if index < 0:
            raise IndexError(f"shards: expected an index from 0, got {index}")
        epoch, position = divmod(index, self._total)
        order, ends = self._order(epoch)
        at = bisect_right(ends, position)
        step = position - (ends[at - 1] if at else 0)
        for further in range(len(order)):
            scene = self._scenes[order[(at + further) % len(order)]]
            contents = self._open(scene.shard)
            if contents is not None:
                self.replaced += bool(further)
                key = scene.samples[step % len(scene.samples)]
                return self._read(scene.shard, key, contents), key
        raise ValueError(f"{self.folder}: no shard is complete; the first: {next(iter(self.skipped.values()))}")

    def _order(self, epoch: int) -> tuple[list[int], list[int]]:
        """(scene numbers in the epoch's order, samples up to and with each)."""
        if self._ends is None or self._ends[0] != epoch:
            order = np.random.default_rng([self.seed, epoch]).permutation(len(self._scenes)).tolist()
            self._ends = (epoch, order, list(accumulate(len(self._scenes[k].samples) for k in order)))
        return self._ends[1], self._ends[2]

    def _open(self, shard: int) -> Contents | None:
        """The table of contents of a shard; None where it is damaged."""
        entry = self._shards[shard]
        if entry["file"] in self.skipped:
            return None
        try:
            return self._contents.get(shard, lambda: _contents(self.folder, entry, self.checksums))
        except ValueError as error:
            if self.strict:
                raise
            self.skipped[entry["file"]] = str(error)
            return None

    def _read(self, shard: int, key: str, contents: Contents) -> Files:
        path = self.folder / self._shards[shard]["file"]
        contents_read: Files = {}
        with files.reading(path) as file:
            for name, (offset, size) in contents.get(key, {}).items():
                file.seek(offset)
                contents_read[name] = file.read(size)
        return contents_read

    def _asset(self, sample: Files) -> Splats | None:
        """The asset, the same object for equal bytes: `sample.asset is before.asset` within a scene."""
        data = sample.get("asset.ply")
        if data is None:
            return None
        try:
            return self._assets.get(hashlib.sha256(data).digest(), lambda: decode_asset(data))
        except ValueError:
            return None  # decode_sample says where


def _contents(folder: Path, entry: Mapping[str, Any], checksums: bool) -> Contents:
    """Contents of a shard of the index. Raises ValueError: what is wrong with it."""
    if wrong := damage(folder, entry, checksums):
        raise ValueError(wrong)
    contents: Contents = {}
    try:
        with tarfile.open(folder / entry["file"]) as tar:
            for member in tar:
                key, _, name = member.name.partition(".")
                contents.setdefault(key, {})[name] = (member.offset_data, member.size)
    except (tarfile.TarError, OSError) as error:
        raise ValueError(f"{folder / entry['file']}: cannot be read as a tar file ({error})") from None
    return contents


def _chosen(shards: list[dict[str, Any]], names: Sequence[str] | None, kinds: Sequence[str] | None) -> list[_SceneKeys]:
    scenes = []
    for number, entry in enumerate(shards):
        for scene in entry["scenes"]:
            if names is not None and scene["object"] not in names:
                continue
            pairs = zip(scene["samples"], scene["kinds"], strict=True)
            keys = tuple(key for key, kind in pairs if kinds is None or kind in kinds)
            if keys:
                scenes.append(_SceneKeys(number, keys))
    return scenes


class _Hashed(io.RawIOBase):
    """A file that counts and hashes what is written through it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.digest, self.count = file, hashlib.sha256(), 0

    def writable(self) -> bool:
        return True

    def write(self, data: Any, /) -> int:
        self._file.write(data)
        self.digest.update(data)
        self.count += len(data)
        return len(data)


@contextlib.contextmanager
def _tar(file: Any) -> Iterator[tarfile.TarFile]:
    with tarfile.open(fileobj=file, mode="w|", format=tarfile.USTAR_FORMAT) as tar:
        yield tar


def _put(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    """A member without time or user: equal contents are equal bytes."""
    info = tarfile.TarInfo(name)
    info.size, info.mode = len(data), 0o644
    tar.addfile(info, io.BytesIO(data))


def _copy(path: Path, target: tarfile.TarFile) -> tuple[dict[str, Any], list[str]]:
    """Move a waiting scene's samples into a shard; (its description, its samples' keys)."""
    about: dict[str, Any] = {}
    keys: dict[str, None] = {}
    try:
        with tarfile.open(path) as tar:
            for member in tar:
                content = tar.extractfile(member)
                data = b"" if content is None else content.read()
                if member.name == "about.json":
                    about = json.loads(data)
                    continue
                _put(target, member.name, data)
                keys[member.name.split(".", 1)[0]] = None
    except (tarfile.TarError, ValueError) as error:
        raise ValueError(f"{path}: is damaged ({error}); delete it, and the scene is made again") from None
    return about, list(keys)


def _locked(folder: Path) -> BaseFileLock:
    """A lock that no other writer of the folder holds; it goes with its process. Raises ValueError."""
    try:
        from filelock import FileLock, Timeout
    except ImportError as error:
        raise ValueError(f"shards need {error.name}; pip install 'splatpainter[train]'") from None
    lock = FileLock(folder / LOCK, timeout=0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        raise ValueError(f"{folder}: another run is writing shards here; wait for it, or use another folder") from None
    except (OSError, NotImplementedError) as error:
        raise ValueError(f"{folder}: cannot be locked ({getattr(error, 'strerror', None) or error})") from None
    return lock


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
