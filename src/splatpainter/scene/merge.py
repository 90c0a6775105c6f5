"""Several assets in one file, each in its own range of rows, and the proof of every range against its own file.

    receipt = merge(["table.ply", "vase.ply"], "scene.ply", transforms=[None, Placement.of(move=(0, -0.4, 0))])
    verify_merge("scene.ply", ["table.ply", "vase.ply"], receipt)

The merged file is a function of the sources and of what the receipt says of each (placement, seam), so it is made once
more from them and compared, part by part as files of one format are. Rows of a PLY or .splat that were neither moved
nor recoloured are compared with their source's stored bytes besides.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.comparison import compare, listed
from splatpainter.io import FORMATS, files, format_of_name, read
from splatpainter.io.contents import StoredTable, contents
from splatpainter.io.formats.glb import with_bands
from splatpainter.io.formats.ply_rows import TextRows
from splatpainter.io.joining import ROWS_STAND_ALONE, concatenated, write_joined
from splatpainter.io.losses import loss_line, measure
from splatpainter.io.positions import Offset
from splatpainter.order_statistics import distinct
from splatpainter.output_paths import receipt_of
from splatpainter.receipts import MAX_CARRIED, Receipt, untouched_hashes
from splatpainter.scene.placement import Placement, check_near, scene_offset
from splatpainter.scene.seam import SeamMatch, match_seam
from splatpainter.splats import Splats, changed_rows
from splatpainter.system.atomic import brief_name
from splatpainter.system.quick_dataclass import dataclass

MODE = "merge"
"""Mode of receipts of merged assets."""
BYTES, VALUES, MADE = "bytes", "values", "transformed"
"""How a range holds its source: the stored bytes; its values, as converting it alone would; moved or recoloured."""


@dataclass(frozen=True)
class Part:
    """One asset of a merge."""

    splats: Splats
    """Gaussians as read."""
    placement: Placement = field(default_factory=Placement)
    seam: SeamMatch | None = None

    @property
    def path(self) -> str:
        """Path of its file; "asset" where it came from none."""
        return "asset" if self.splats.source is None else self.splats.source.path

    @property
    def format(self) -> str:
        """Format of its file; "rows" where it came from none."""
        return "rows" if self.splats.source is None else self.splats.source.format

    @property
    def name(self) -> str:
        """Name of the file, without folders."""
        return files.printable(Path(self.path).name, 200)

    def stored_as(self, key: str) -> str:
        """BYTES, VALUES or MADE in a file of the format `key`."""
        if not self.placement.is_identity or self.seam is not None:
            return MADE
        return BYTES if key == self.format and key in ROWS_STAND_ALONE else VALUES


@dataclass(frozen=True)
class RangeCheck:
    """The rows of one source in a merged file."""

    file: str
    first: int
    rows: int
    same: int
    """Rows that are as the merge put them."""
    changed: int
    """Rows that an edit changed since, as its receipt says."""
    how: str


@dataclass(frozen=True)
class MergeVerification:
    """Outcome of comparing a merged asset, edited or not, with its sources."""

    ok: bool
    ranges: tuple[RangeCheck, ...]
    appended: int
    """Rows behind the last range, which edits appended."""
    problems: tuple[str, ...]
    """Why it is not ok, one line each."""
    exact: str
    """How rows were compared."""


def merge(
    assets: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    transforms: Sequence[Placement | None] | None = None,
    seam: bool = False,
    seam_falloff: float = 0.0,
    overwrite: bool = False,
) -> Receipt:
    """Write several assets into one file and its receipt (OUT.receipt.json); see `parts_of` and `write_merged`."""
    target = Path(out)
    # Everything is checked before anything is written.
    parts = parts_of([read(path) for path in assets], transforms, seam, seam_falloff)
    receipt_path = receipt_of(target)
    for path in (target, receipt_path):
        if path.exists() and not overwrite:
            raise ValueError(f"{path}: already exists; choose another name or allow overwriting")
    # Written and proved beside the target, then renamed: a failure leaves what was there.
    with tempfile.TemporaryDirectory(
        prefix=f".{brief_name(target.name)}.", suffix=".part", dir=target.parent
    ) as folder:
        partial = Path(folder) / target.name
        receipt, _ = write_merged(partial, parts)
        with files.writing(receipt_path) as file:
            file.write(receipt.to_json().encode())
            files.replace(partial, target)
    return receipt


def parts_of(
    assets: Sequence[Splats],
    transforms: Sequence[Placement | None] | None = None,
    seam: bool = False,
    seam_falloff: float = 0.0,
) -> list[Part]:
    """What a merge is made of. assets: as read; transforms: one for each (None: as it is); seam: colours of every asset
    but the first are matched to the first one near which it stands, fading out over seam_falloff world units (0: all of
    it). Raises ValueError: fewer than two, too many, one without Gaussians, one twice at the same place, one that a
    transform moves out of reach, colours of two spaces, a seam between assets that are not near to each other."""
    if not 2 <= len(assets) <= MAX_CARRIED:
        raise ValueError(f"merge: expected 2 to {MAX_CARRIED} assets, got {len(assets)}")
    transforms = [None] * len(assets) if transforms is None else transforms
    if len(transforms) != len(assets):
        raise ValueError(
            f"merge: expected one transform for each of the {len(assets)} assets ('none': as it is), "
            f"got {len(transforms)}"
        )
    parts = [Part(splats, transform or Placement()) for splats, transform in zip(assets, transforms, strict=True)]
    before: dict[tuple[str, Placement], int] = {}
    offset = scene_offset([(part.splats, part.placement) for part in parts])
    for number, part in enumerate(parts, 1):
        _check(part, parts[0], offset)
        # The same file twice at one place doubles every opacity: surely a slip.
        twin = before.setdefault((part.splats.sha256, part.placement), number)
        if twin != number:
            raise ValueError(
                f"{part.path}: assets {twin} and {number} are the same Gaussians at the same place; "
                "give one of them another transform"
            )
    return _matched(parts, seam_falloff) if seam else parts


def placed(parts: Sequence[Part], splats: Sequence[Splats] | None = None) -> list[Splats]:
    """Each part's Gaussians as they are in the scene. splats: those of each part, edited; None: as read. What is not
    moved keeps its offset (Splats.offset), what is moved has that of the scene."""
    offset = scene_offset([(part.splats, part.placement) for part in parts])
    out: list[Splats] = []
    for part, rows in zip(parts, splats or [part.splats for part in parts], strict=True):
        rows = part.placement.apply(rows, rows.offset if part.placement.is_identity else offset)
        if part.seam is not None:
            rows = part.seam.apply(rows, out[0])
        out.append(rows)
    return out


def write_merged(path: Path, parts: Sequence[Part]) -> tuple[Receipt, MergeVerification]:
    """Write the file, read it again and prove it from the sources: (its receipt, the outcome). As an edit of the first
    asset, to which the others were appended, it can be verified as any other edit where the first keeps its bytes.
    Raises ValueError as `write`; RuntimeError: what was written is not what was to be."""
    key = format_of_name(path)
    assert key is not None
    # Written, read again, and proved from the sources: the receipt speaks of the file, not of memory.
    scene = placed(parts)
    write_joined(path, scene)
    merged = read(path, lenient=True, offset=scene[0].offset)
    joined = concatenated(scene)
    lost = loss_line(joined, key, measure(joined, merged))
    first, sources = 0, []
    for part, splats in zip(parts, scene, strict=True):
        # Each range against what was given to the writer: formats with loss say how many rows came back exactly.
        if splats.offset != merged.offset and FORMATS[key].holds_offset:
            merged = read(path, lenient=True, offset=splats.offset)
        splats = splats.relative_to(merged.offset)
        stored = merged.take(np.arange(first, first + len(splats)))
        bands = max(stored.sh.shape[1], splats.sh.shape[1])  # some formats hold fewer than they are given
        before, after = (replace(rows, sh=with_bands(rows.sh, bands)) for rows in (splats, stored))
        sources.append(
            {
                "name": part.name,
                "sha256": part.splats.sha256,
                "format": part.format,
                "rows": len(splats),
                "first": first,
                "sh_degree": part.splats.sh_degree,
                "how": part.stored_as(key),
                "exact_rows": len(splats) - len(changed_rows(before, after)),
                "placement": part.placement.record(),
                "seam": None if part.seam is None else part.seam.record(),
            }
        )
        first += len(splats)
    lead = parts[0].splats
    # The first asset counts as the edited one, the others as appended to it.
    stays = parts[0].stored_as(key) == BYTES and merged.sh.shape[1] == lead.sh.shape[1]
    touched = np.zeros(0, np.int64) if stays else np.arange(len(lead))
    if merged.offset != lead.offset:
        merged = read(path, lenient=True, offset=lead.offset)
    before, after = untouched_hashes(lead, merged, touched)
    receipt = Receipt(
        asset_sha256=lead.sha256,
        asset_rows=len(lead),
        output_sha256=merged.sha256,
        output_rows=len(merged),
        mode=MODE,
        method="join",
        preset="",
        touched=touched,
        appended_rows=len(merged) - len(lead),
        untouched_sha256_before=before,
        untouched_sha256_after=after,
        note="; ".join([*_notes(parts), *([f"lost in {key}: {lost}"] if lost else [])]),
        merge={"sources": sources},
    )
    # The same check that `verify` makes later, from files.
    verification = check_merge(merged, [part.splats for part in parts], receipt)
    if not verification.ok:
        raise RuntimeError(f"the merged file is not what its sources make: {'; '.join(verification.problems)}")
    return receipt, verification


def verify_merge(
    merged: str | os.PathLike[str], sources: Sequence[str | os.PathLike[str]], receipt: Receipt
) -> MergeVerification:
    """Compare every range of a merged asset, edited or not, with its own file. sources: the files, in any order.
    Raises ValueError when a file cannot be read, and for a receipt of no merge."""
    return check_merge(read(merged, lenient=True), [read(path, lenient=True) for path in sources], receipt)


def check_merge(merged: Splats, sources: Sequence[Splats], receipt: Receipt) -> MergeVerification:
    """`verify_merge` of files that were read."""
    assert merged.source is not None
    records = _records(receipt)
    problems = []
    if receipt.output_sha256 not in ("", merged.sha256):
        problems.append(f"the merged file changed since (sha256 {merged.sha256[:12]}...)")
    if receipt.dropped is not None:
        problems.append("hidden rows were removed for good, so that ranges have no rows of their own any more")
    # Sources are known by their hash, so they may have moved or been renamed.
    ordered, unused = _by_hash(records, sources)
    problems += [f"{splats.source.path}: is not a source of this file" for splats in unused if splats.source]
    problems += [
        f"range {k}: its file is missing: {record['name']} (sha256 {record['sha256'][:12]}...)"
        for k, (record, splats) in enumerate(zip(records, ordered, strict=True), 1)
        if splats is None
    ]
    parts = [
        Part(
            splats, Placement.from_record(record["placement"]), record["seam"] and SeamMatch.from_record(record["seam"])
        )
        for record, splats in zip(records, ordered, strict=True)
        if splats is not None
    ]
    # Without every source nothing can be rebuilt; say what is missing and stop.
    total = sum(record["rows"] for record in records)
    fits = all(splats is None or len(splats) == r["rows"] for r, splats in zip(records, ordered, strict=True))
    if len(parts) < len(records) or len(merged) < total or not fits:
        if len(merged) < total:
            problems.append(f"{total - len(merged)} rows are missing")
        return MergeVerification(False, (), 0, tuple(problems or ["the sources have other rows"]), "nothing")
    # The scene made once more, compared value by value.
    comparison = compare(_rebuilt(parts, merged), merged)
    problems += comparison.problems
    rows = np.zeros(total, bool)
    rows[comparison.differs] = True
    for record, part in zip(records, parts, strict=True):
        # And stored bytes against stored bytes, where a range holds its source as it was.
        differing, fields = _stored_differences(part, merged, record["first"])
        rows[record["first"] + differing] = True
        problems += [f"{part.name}: the stored bytes of {name} differ" for name in fields]
    edited = np.zeros(total, bool)
    if receipt.mode != MODE:
        for ids in (receipt.touched, receipt.merge_touched):
            edited[ids[ids < total]] = True
    # What differs has to stand in a receipt.
    unlisted = np.flatnonzero(rows & ~edited)
    if len(unlisted):
        problems.append(f"{len(unlisted)} rows differ that no receipt lists: {listed(unlisted)}")
    for name, where in comparison.unexpected_fields.items():
        problems.append(f"{name}, which no edit changes, differs in {len(where)} rows: {listed(where)}")
    ranges = []
    for record, part in zip(records, parts, strict=True):
        span = slice(record["first"], record["first"] + record["rows"])
        changed = int(rows[span].sum())
        how = part.stored_as(merged.source.format)
        ranges.append(RangeCheck(part.name, span.start, record["rows"], record["rows"] - changed, changed, how))
    return MergeVerification(
        not problems, tuple(ranges), len(merged) - total, tuple(dict.fromkeys(problems)), comparison.exact
    )


def differing_rows(parts: Sequence[Part], merged: Splats) -> np.ndarray:
    """[D] int64 ascending rows of the sources' ranges that are not as the sources make them."""
    total = sum(len(part.splats) for part in parts)
    differs = compare(_rebuilt(parts, merged), merged).differs
    return differs[differs < total]


def carried(receipt: Receipt, before: Receipt | None) -> Receipt:
    """The receipt of an edit of a merged asset, with what the asset's own receipt (`before`) says of its sources."""
    # Only the receipt of exactly this file may speak for it.
    if before is None or before.merge is None or before.output_sha256 != receipt.asset_sha256:
        return receipt
    touched = before.merge_touched
    if before.mode != MODE:
        touched = np.union1d(touched, before.touched)
    return replace(receipt, merge=before.merge, merge_touched=touched[touched < receipt.asset_rows])


def _check(part: Part, first: Part, offset: Offset) -> None:
    path, splats = part.path, part.splats
    if not len(splats):
        raise ValueError(f"{path}: has no Gaussians to merge")
    visible = int(splats.drawable.sum())
    if not visible:
        raise ValueError(f"{path}: none of its {len(splats)} Gaussians can be drawn")
    if splats.color_space != first.splats.color_space:
        spaces = f"{splats.color_space}, those of {first.name} {first.splats.color_space}"
        raise ValueError(f"{path}: its colours are {spaces}; convert one of them first")
    # Far moves overflow float32: Gaussians would vanish without a word.
    inside = part.placement.apply(splats, offset)
    if inside is not splats and int(inside.drawable.sum()) < visible:
        raise ValueError(f"{path}: its transform takes Gaussians out of what can be drawn; use smaller numbers")
    check_near(path, inside)


def _matched(parts: Sequence[Part], falloff: float) -> list[Part]:
    out = [parts[0]]
    fixed, *rest = placed(parts)
    for part, moving in zip(parts[1:], rest, strict=True):
        try:
            match = match_seam(moving, fixed, falloff)
        except ValueError as error:
            raise ValueError(f"{part.path}: {str(error).removeprefix('seam: ')}") from None
        out.append(replace(part, seam=match))
    return out


def _notes(parts: Sequence[Part]) -> list[str]:
    notes = []
    if len({part.splats.antialiased for part in parts}) > 1:
        notes.append("some sources were trained antialiased and some not; all are marked as the first is")
    for part in parts:
        held = None if part.splats.source is None else contents(part.splats.source)
        extra = [name for name, data in held.blocks.items() if data] if held is not None else []
        if extra and part.format == "ply":
            notes.append(f"{part.name}: {', '.join(files.printable(name, 60) for name in extra[:4])} left out")
    return [note[:1000] for note in notes[:3]]


def _records(receipt: Receipt) -> list[dict[str, Any]]:
    """What a receipt says of each source, checked. Raises ValueError."""
    try:
        if receipt.merge is None:
            raise ValueError("it is not of a merge")
        records, first = [], 0
        for record in receipt.merge["sources"]:
            # A receipt is a file like any other: every number in it is checked before it indexes anything.
            rows = record["rows"]
            if isinstance(rows, bool) or not isinstance(rows, int) or rows < 1 or record["first"] != first:
                raise ValueError("its ranges do not follow each other")
            if not (isinstance(record["name"], str) and isinstance(record["sha256"], str)):
                raise ValueError("a source has no name or hash")
            Placement.from_record(record["placement"])
            if record["seam"] is not None:
                SeamMatch.from_record(record["seam"])
            first += rows
            records.append(record)
        return records
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"receipt: expected one of a merge, with its sources ({str(error)[:120]})") from None


def _by_hash(records: Sequence[dict[str, Any]], sources: Sequence[Splats]) -> tuple[list[Splats | None], list[Splats]]:
    """(the source of each record, those of none). One file may be the source of several ranges."""
    by_hash = {splats.sha256: splats for splats in sources}
    names = {record["sha256"] for record in records}
    return [by_hash.get(record["sha256"]) for record in records], [s for s in sources if s.sha256 not in names]


def _rebuilt(parts: Sequence[Part], merged: Splats) -> Splats:
    """The merged file, made once more from its sources."""
    assert merged.source is not None
    with tempfile.TemporaryDirectory() as folder:
        # Formats are told by their names.
        name = {"sog": "merged.sog", "compressed.ply": "merged.compressed.ply"}.get(merged.source.format)
        path = Path(folder) / (name or f"merged.{merged.source.format}")
        write_joined(path, placed(parts))
        return read(path, lenient=True, offset=merged.offset)


def _stored_differences(part: Part, merged: Splats, first: int) -> tuple[np.ndarray, list[str]]:
    """([D] rows of the source whose own file's bytes the merged file does not hold, names of other properties that
    differ); nothing where bytes are no measure."""
    none = np.zeros(0, np.int64)
    assert merged.source is not None
    if part.stored_as(merged.source.format) != BYTES:
        return none, []
    assert part.splats.source is not None
    old, new = contents(part.splats.source), contents(merged.source)
    if old is None or new is None or isinstance(old.tables[0].records, TextRows):
        return none, []
    differing, names = [none], []
    bands = (part.splats.sh.shape[1] - 1, merged.sh.shape[1] - 1)
    for name, _ in old.tables[0].fields:
        rows = _field_differs(old.tables[0], new.tables[0], name, _name_at(name, *bands), first)
        if name in old.tables[0].edited:
            differing.append(rows)
        elif len(rows):
            names.append(name)
    return distinct(np.concatenate(differing)), names


def _name_at(name: str, bands: int, merged_bands: int) -> str:
    """A property of a PLY with so many bands >= 1 as it is called where there are more: f_rest_* go channel by
    channel."""
    if not name.startswith("f_rest_") or bands == merged_bands:
        return name
    channel, k = divmod(int(name.removeprefix("f_rest_")), bands)
    return f"f_rest_{channel * merged_bands + k}"


def _field_differs(old: StoredTable, new: StoredTable, name: str, merged_name: str, first: int) -> np.ndarray:
    """[D] rows in which a property of the source has other bytes in the merged file, byte orders aside."""
    if isinstance(new.records, TextRows) or merged_name not in (new.records.dtype.names or ()):
        return np.arange(len(old)) if name in old.edited else np.zeros(0, np.int64)
    theirs = new.records[merged_name][first : first + len(old)]
    values = old.records[name]
    # Big and little endian files hold the same values in other bytes.
    if values.dtype.newbyteorder("<") != theirs.dtype.newbyteorder("<"):
        return np.zeros(0, np.int64)  # another type: compared by value
    one, two = (np.ascontiguousarray(v.astype(v.dtype.newbyteorder("<"))) for v in (values, theirs))
    size = len(one)
    return np.flatnonzero((one.view(np.uint8).reshape(size, -1) != two.view(np.uint8).reshape(size, -1)).any(1))
