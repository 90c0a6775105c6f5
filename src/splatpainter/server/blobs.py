"""Uploaded and made bytes by their hash, in a folder of their own that goes with the studio. Bounded, oldest out first.

What comes in is written as it comes, stopped where it is too long, and judged (claims.py) before anything decodes it.
"""

from __future__ import annotations

import hashlib
import secrets
import threading
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

from splatpainter.io import files
from splatpainter.server.claims import Claim, claim_of
from splatpainter.server.problems import TooLarge
from splatpainter.session.scratch import ScratchFolder


@dataclass(frozen=True)
class Limits:
    """Of uploads."""

    upload: int = 2 << 30
    """Bytes of one upload."""
    picture: int = 256 << 20
    """Bytes of one picture."""
    total: int = 4 << 30
    """Bytes kept; beyond that the oldest go. No more than that may be on their way in either."""
    rows: int = 20_000_000
    """Rows that an uploaded asset may claim."""


@dataclass(frozen=True)
class Blob:
    """One thing that is kept."""

    sha256: str
    path: Path
    name: str
    """What its owner called it, for messages only; it never becomes a path."""
    size: int
    claim: Claim


class Blobs:
    """A store; may be used from several threads."""

    def __init__(self, limits: Limits = Limits()) -> None:
        self.limits = limits
        self._scratch = ScratchFolder("blobs")
        self.folder = self._scratch.path
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, Blob] = OrderedDict()
        self._incoming = 0
        """Bytes of uploads that have not ended."""

    def receive(self, name: str = "") -> Incoming:
        """A thing to be written piece by piece. Raises ValueError where nothing can be written."""
        return Incoming(self, name)

    def put(self, data: bytes, name: str = "") -> Blob:
        """Keep bytes. Raises ValueError as Incoming."""
        with self.receive(name) as incoming:
            incoming.write(data)
            return incoming.finish()

    def get(self, sha256: str, kind: str | None = None) -> Blob:
        """What was put. Raises ValueError where it is not (or no longer) here, or of another kind."""
        with self._lock:
            blob = self._kept.get(sha256)
            if blob is not None:
                self._kept.move_to_end(sha256)
        if blob is None:
            raise ValueError(f"blob {sha256[:12]}...: not here (any more); send it again to /api/blobs")
        if kind is not None and blob.claim.kind != kind:
            raise ValueError(f"{blob.name or 'blob'}: expected a {kind}, got a {blob.claim.kind}")
        return blob

    @property
    def size(self) -> int:
        """Bytes kept."""
        with self._lock:
            return sum(blob.size for blob in self._kept.values())

    def close(self) -> None:
        """Remove everything."""
        with self._lock:
            self._kept.clear()
        self._scratch.close()

    def _partial(self) -> Path:
        return self.folder / f"{secrets.token_hex(8)}.part"

    def _take_in(self, count: int, name: str) -> None:
        """Count bytes on their way in (negative: they have ended). Raises TooLarge where there are too many."""
        with self._lock:
            if count > 0 and self._incoming + count > self.limits.total:
                raise TooLarge(f"{name}: expected at most {self.limits.total >> 20} MiB on their way in at a time")
            self._incoming += count

    def _keep(self, partial: Path, sha256: str, name: str, size: int) -> Blob:
        try:
            claim = claim_of(partial, name, self.limits.rows)
        except ValueError as error:
            raise ValueError(str(error).replace(str(partial), name or "the upload")) from None
        if claim.kind == "picture" and size > self.limits.picture:
            raise TooLarge(f"{name or 'picture'}: expected at most {self.limits.picture >> 20} MiB, got {size >> 20}")
        blob = Blob(sha256, self.folder / (sha256 + claim.ending), name, size, claim)
        with self._lock:
            if not blob.path.exists():  # the same bytes; and Windows replaces no file that is being read
                files.replace(partial, blob.path)
            self._kept[sha256] = blob
            self._kept.move_to_end(sha256)
            total = sum(kept.size for kept in self._kept.values())
            while total > self.limits.total and len(self._kept) > 1:
                _, oldest = self._kept.popitem(last=False)
                total -= oldest.size
                files.remove(oldest.path)
        return blob


class Incoming:
    """Bytes on their way in; leaving the block without `finish` drops them."""

    def __init__(self, store: Blobs, name: str) -> None:
        self._store, self._name = store, name[:200].encode("utf-8", "replace").decode()
        self._partial = store._partial()
        self._digest, self._size = hashlib.sha256(), 0
        try:
            self._file = open(self._partial, "wb")
        except OSError as error:
            raise self._unwritable(error) from None

    def __enter__(self) -> Incoming:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._file.close()
        except OSError:
            pass  # a full disk: what was written is dropped
        files.remove(self._partial)
        self._store._take_in(-self._size, self._name)
        self._size = 0

    def write(self, piece: bytes) -> None:
        """Raises TooLarge where it gets too long, ValueError where the disk is full."""
        limit = self._store.limits.upload
        if self._size + len(piece) > limit:
            raise TooLarge(f"{self._name or 'upload'}: expected at most {limit >> 20} MiB; use a file in the folder")
        self._store._take_in(len(piece), self._name or "uploads")
        self._size += len(piece)
        self._digest.update(piece)
        try:
            self._file.write(piece)
        except OSError as error:
            raise self._unwritable(error) from None

    def finish(self) -> Blob:
        """Judge and keep. Raises ValueError: empty, or nothing that the studio can use."""
        if not self._size:
            raise ValueError(f"{self._name or 'upload'}: is empty")
        try:
            self._file.close()
            return self._store._keep(self._partial, self._digest.hexdigest(), self._name, self._size)
        except OSError as error:
            raise self._unwritable(error) from None

    def _unwritable(self, error: OSError) -> ValueError:
        return ValueError(f"{self._name or 'upload'}: cannot be kept ({error.strerror or 'disk error'})")
