"""Samples out of shards, by number, as data/samples.py makes them on the fly: the same interface for whoever trains.

The order is decided by (seed, epoch): scenes in a new random order each epoch, the samples of a scene one after another
(they share an asset, and an asset is encoded once). So position i alone says where to go on.
"""

from __future__ import annotations

import tarfile
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.data.records import decode_asset, decode_sample
from splatpainter.data.samples import Sample
from splatpainter.data.shards import Files, damage, read_index
from splatpainter.io import files
from splatpainter.splats import Splats

OPEN_SHARDS, ASSETS = 256, 4
"""Tables of contents, and assets, that are kept."""


@dataclass(frozen=True)
class _Scene:
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
        self._contents: OrderedDict[int, dict[str, dict[str, tuple[int, int]]]] = OrderedDict()
        self._assets: OrderedDict[bytes, Splats] = OrderedDict()
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
        epoch, place = divmod(index, self._total)
        order, ends = self._order(epoch)
        at = bisect_right(ends, place)
        step = place - (ends[at - 1] if at else 0)
        for further in range(len(order)):
            scene = self._scenes[order[(at + further) % len(order)]]
            contents = self._open(scene.shard)
            if contents is not None:
                self.replaced += bool(further)
                key = scene.samples[step % len(scene.samples)]
                return self._read(scene.shard, key, contents), key
        raise ValueError(f"{self.folder}: no shard is whole; the first: {next(iter(self.skipped.values()))}")

    def _order(self, epoch: int) -> tuple[list[int], list[int]]:
        """(scene numbers in the epoch's order, samples up to and with each)."""
        if self._ends is None or self._ends[0] != epoch:
            order = np.random.default_rng([self.seed, epoch]).permutation(len(self._scenes)).tolist()
            self._ends = (epoch, order, list(accumulate(len(self._scenes[k].samples) for k in order)))
        return self._ends[1], self._ends[2]

    def _open(self, shard: int) -> dict[str, dict[str, tuple[int, int]]] | None:
        """Key -> name -> (offset, size) of a shard's files; None where it is damaged."""
        entry = self._shards[shard]
        if entry["file"] in self.skipped:
            return None
        if shard in self._contents:
            self._contents.move_to_end(shard)
            return self._contents[shard]
        wrong = damage(self.folder, entry, self.checksums)
        contents: dict[str, dict[str, tuple[int, int]]] = {}
        if wrong is None:
            try:
                with tarfile.open(self.folder / entry["file"]) as tar:
                    for member in tar:
                        key, _, name = member.name.partition(".")
                        contents.setdefault(key, {})[name] = (member.offset_data, member.size)
            except (tarfile.TarError, OSError) as error:
                wrong = f"{self.folder / entry['file']}: cannot be read as a tar file ({error})"
        if wrong is not None:
            if self.strict:
                raise ValueError(wrong)
            self.skipped[entry["file"]] = wrong
            return None
        self._contents[shard] = contents
        while len(self._contents) > OPEN_SHARDS:
            self._contents.popitem(last=False)
        return contents

    def _read(self, shard: int, key: str, contents: dict[str, dict[str, tuple[int, int]]]) -> Files:
        path = self.folder / self._shards[shard]["file"]
        found: Files = {}
        with files.reading(path) as file:
            for name, (offset, size) in contents.get(key, {}).items():
                file.seek(offset)
                found[name] = file.read(size)
        return found

    def _asset(self, sample: Files) -> Splats | None:
        """The asset, the same object for equal bytes: `sample.asset is before.asset` within a scene."""
        data = sample.get("asset.ply")
        if data is None:
            return None
        digest = sha256(data).digest()
        if digest not in self._assets:
            try:
                self._assets[digest] = decode_asset(data)
            except ValueError:
                return None  # decode_sample says where
            while len(self._assets) > ASSETS:
                self._assets.popitem(last=False)
        return self._assets[digest]


def _chosen(shards: list[dict[str, Any]], names: Sequence[str] | None, kinds: Sequence[str] | None) -> list[_Scene]:
    scenes = []
    for number, entry in enumerate(shards):
        for scene in entry["scenes"]:
            if names is not None and scene["object"] not in names:
                continue
            pairs = zip(scene["samples"], scene["kinds"], strict=True)
            keys = tuple(key for key, kind in pairs if kinds is None or kind in kinds)
            if keys:
                scenes.append(_Scene(number, keys))
    return scenes
