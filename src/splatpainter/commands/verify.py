"""`splatpainter verify`: which rows of an edited asset are the same, read from the files alone."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_marks import Argument, Positional
from splatpainter.commands.parts.option_parsing import AxesOption, InAxesOption
from splatpainter.commands.parts.terminal import count, stages
from splatpainter.output_paths import receipt_of
from splatpainter.receipts import read_receipt, verify
from splatpainter.system.quick_dataclass import dataclass

RANGE_WORDS = {"bytes": "byte-identical", "values": "as converted", "transformed": "as transformed"}
"""How a range holds its source (scene/merge.py) -> what its rows are."""


@dataclass(frozen=True)
class Config:
    """Compare an edited asset with its original, part by part as stored, and with the receipt of the edit.

    Exit code 0: every row that the receipt does not list is unchanged, and so is everything else in the file (header,
    other properties and elements, trailing bytes). 1: something else differs or is missing, or the files are not those
    of the receipt. Without a receipt rows whose Gaussians differ are counted, not judged.

    With --against: a merged asset (`splatpainter merge`), also after edits of it, whose every range is compared with
    its own file.

    example:
      splatpainter verify vase.ply painted.ply
      splatpainter verify scene.ply --against table.ply vase.ply
    """

    original: Annotated[Positional[Path], Argument(metavar="ORIGINAL")]
    """The asset before the edit; with --against, the merged asset."""
    edited: Annotated[Positional[Path | None], Argument(metavar="EDITED", help_behavior_hint="")] = None
    """The edited asset."""
    against: Annotated[tuple[Path, ...], Argument(metavar="ASSET ...", help_behavior_hint="")] = ()
    """The files that a merged asset was made of, in any order."""
    receipt: Annotated[Path | None, Argument(metavar="R.json", help_behavior_hint="")] = None
    """The receipt; default: EDITED.receipt.json where it exists."""
    in_axes: InAxesOption = "auto"
    """Axes of ORIGINAL's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    axes: AxesOption = "auto"
    """Axes of EDITED's numbers; auto: those of ORIGINAL if both are of one format, else what EDITED says."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Read both files and the receipt."""
    # A merged asset has several originals, so it is proved by another way.
    if config.against:
        return _against(config)
    edited = config.edited
    if edited is None:
        raise ValueError(
            f"splatpainter verify: expected ORIGINAL and EDITED, or --against, got {config.original} alone"
        )
    # A receipt beside the file is taken without a word: it is where every command puts it.
    path = config.receipt
    if path is None and receipt_of(edited).exists():
        path = receipt_of(edited)
    receipt = read_receipt(path) if path is not None else None
    # From the files alone: nothing that a command remembers may enter the proof.
    with stages(1) as bar:
        bar.enter("comparing")
        verification = verify(config.original, edited, receipt, axes=config.in_axes, out_axes=config.axes)
    values = asdict(verification)
    # Programs read these keys, which stay.
    values["frame"], values["frame_is_news"] = values.pop("axes"), values.pop("axes_are_news")
    record = {"original": config.original, "edited": edited, "receipt": path, **values}
    # What was compared and what was not stand beside the verdict, which means nothing without them.
    lines = [
        f"{verification.same:,} of {count(verification.rows, 'Gaussian')} {verification.how_same}; "
        f"{verification.changed:,} changed, {verification.appended:,} appended",
        f"receipt: {path}" if path is not None else "no receipt: changed Gaussians are counted, not judged",
        *verification.differences,
        f"compared: {'; '.join((verification.exact, *verification.compared))}",
        *(f"not compared: {part}" for part in verification.not_compared),
        *([f"axes: {verification.axes}"] if verification.axes_are_news else []),
        *(f"wrong: {problem}" for problem in verification.problems),
        "verified" if verification.ok else "NOT verified",
    ]
    # The exit code says it to scripts.
    return Outcome(record, lines, 0 if verification.ok else 1)


def _against(config: Config) -> Outcome:
    """Every range of a merged asset."""
    from splatpainter.scene.merge import verify_merge

    merged = config.original
    # Axes of several files cannot be given by one option, so all must say their own.
    if config.edited is not None:
        raise ValueError(f"{config.edited}: expected one merged asset before --against, and its sources after it")
    if (config.in_axes, config.axes) != ("auto", "auto"):
        raise ValueError("splatpainter verify: --in-axes and --axes cannot be used with --against")
    path = config.receipt or receipt_of(merged)
    # Without a receipt nobody knows which rows are whose.
    if config.receipt is None and not path.exists():
        raise ValueError(f"{merged}: no receipt {path.name} that says where its sources lie; give one with --receipt")
    receipt = read_receipt(path)
    with stages(1) as bar:
        bar.enter("comparing")
        verification = verify_merge(merged, config.against, receipt)
    # Each range on its own line: an edit may have changed one and not the others.
    lines = [
        *(
            f"{one.file}: rows {one.first:,} to {one.first + one.rows - 1:,}: {one.same:,} of {one.rows:,} "
            f"{RANGE_WORDS[one.how]}; {one.changed:,} changed by edits"
            for one in verification.ranges
        ),
        *([f"{verification.appended:,} Gaussians appended by edits"] if verification.appended else []),
        f"receipt: {path}",
        *(f"wrong: {problem}" for problem in verification.problems),
        "verified" if verification.ok else "NOT verified",
    ]
    record = {"merged": merged, "against": config.against, "receipt": path, **asdict(verification)}
    return Outcome(record, lines, 0 if verification.ok else 1)
