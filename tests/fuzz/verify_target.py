"""Receipts bent as JSON trees, and edited files bent as files: `verify` says what differs, or one line."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpainter.io import read, write
from splatpainter.receipts import Receipt, Verification, read_receipt, untouched_hashes, verify
from tests.support.io_assets import random_splats, written

from .mutations import bend_bytes, bend_floats, bend_json, json_bytes, maybe
from .packed_targets import GlbTarget, SplatTarget, SpzTarget
from .ply_targets import CompressedPlyTarget, PlyTarget, TextPlyTarget
from .reader_oracle import FileTarget
from .target import Fault, Target, Verdict, refusal


class VerifyTarget(Target):
    """original, edited file and receipt; each may be bent."""

    name = "verify"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        kinds = (PlyTarget, TextPlyTarget, CompressedPlyTarget, SplatTarget, SpzTarget, GlbTarget)
        self.targets: list[FileTarget] = [kind(folder) for kind in kinds]
        self.pairs = []
        for name in ("a.ply", "a.splat", "a.spz", "a.glb", "a.compressed.ply"):
            before = written(folder, name, random_splats(8, 1, log_scale=-2))
            (folder / name).write_bytes(before)
            splats = read(folder / name)
            sh = splats.sh.copy()
            sh[[1, 5], 0] = 0.3
            edited = replace(splats, sh=sh).append(splats.take(np.array([2])))
            write(folder / f"edited-{name}", edited)
            after = read(folder / f"edited-{name}")
            touched = np.array([1, 5])
            hashes = untouched_hashes(splats, after, touched)
            receipt = Receipt(splats.sha256, 8, after.sha256, 9, "local", "lift", "lift", touched, 1, *hashes)
            record = json.loads(receipt.to_json())
            self.pairs.append((name, before, (folder / f"edited-{name}").read_bytes(), record))

    def make(self, rng: random.Random) -> dict[str, bytes]:
        if maybe(rng, 0.5):  # two files of one bent kind, no receipt
            target = rng.choice(self.targets)
            (name, before), *_ = target.make(rng).items()
            kind = rng.randrange(4)
            after = before
            if kind == 0:
                after = bend_bytes(rng, before, moves=False)
            elif kind == 1:
                after = bend_bytes(rng, before, 0, 600)
            elif kind == 2:
                after = bend_floats(rng, before)
            else:
                (_, after), *_ = target.make(rng).items()
            return {name: before, f"edited-{name}": after}
        name, before, after, record = rng.choice(self.pairs)
        tree = json.loads(json.dumps(record))
        text = json_bytes(rng, bend_json(rng, tree)) if maybe(rng, 0.7) else json.dumps(tree).encode()
        if maybe(rng, 0.3):
            after = bend_bytes(rng, after)
        return {name: before, f"edited-{name}": after, "r.json": text}

    def check(self, files: dict[str, bytes], rng: random.Random) -> Verdict:
        for name, data in files.items():
            (self.folder / name).write_bytes(data)
        original, edited = (self.folder / name for name in list(files)[:2])
        receipt = None
        if "r.json" in files:
            try:
                receipt = read_receipt(self.folder / "r.json")
                json.loads(receipt.to_json())
            except ValueError as error:
                refusal(error, "r.json")
                return Verdict(refused=1)
        try:
            verification = verify(original, edited, receipt)
        except ValueError as error:
            refusal(error, str(self.folder))
            return Verdict(refused=1)
        self._lines(verification)
        if receipt is None:
            self._judge(verification, files[original.name] == files[edited.name])
        return Verdict(opened=1)

    def _lines(self, verification: Verification) -> None:
        for line in (*verification.problems, verification.exact):
            if not line.isprintable() or len(line) > 1000:
                raise Fault(f"a line that is not printable, or too long: {line[:200]!r}")

    def _judge(self, verification: Verification, equal: bool) -> None:
        """Equal files are equal; where bytes differ, something is said to differ."""
        if equal and (not verification.ok or verification.changed or verification.appended):
            raise Fault(f"a file is not the same as itself: {verification.problems}, {verification.changed} changed")
        if not equal and verification.ok and not (verification.changed or verification.appended):
            raise Fault(f"files that differ pass as the same: {verification.exact}")


TARGETS = {"verify": VerifyTarget}
