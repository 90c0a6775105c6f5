"""`splatpainter edit`: the main job. An asset and operations in; edited asset and receipt out, verified before they
appear.

    splatpainter edit a.ply paint view.png decal logo.png --at 200,180 ... grade --exposure 0.3 --out b.ply

Words up to the first operation's name belong to `paint`, whose name may be left out; options of the file may stand
anywhere. Older spellings (`--decal`, `--source`) are read by edit_shorthand.py.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

from splatpainter.commands import Outcome
from splatpainter.commands.parts.edited_file import (
    AssetArguments,
    EditArguments,
    operation_from,
    plan_operations,
    run_operations,
    spoken,
)
from splatpainter.commands.parts.option_parsing import OLD_OPTIONS, option_name, parse
from splatpainter.kernels.arrays import keep_no_idle_memory
from splatpainter.operations.operation import KINDS, Operation, Wording, kinds, operation_class
from splatpainter.operations.paint import Paint
from splatpainter.system.memory import return_large_arrays
from splatpainter.system.quick_dataclass import dataclass

PROGRAM = "splatpainter edit"


@dataclass(frozen=True)
class Arguments(EditArguments, AssetArguments):
    """The options of `edit` itself, without those of operations."""


@dataclass(frozen=True)
class Config(EditArguments, Paint, AssetArguments):
    """Apply operations to an asset, in order: edited pictures, decals, colours, light. Gaussians that they do not reach
    stay as they are, byte for byte where the format allows it, and one receipt proves it.

    OPERATION is paint, decal, grade, fill, refine, generate, light, delight, pixelate or replay, each with its options
    behind it; `splatpainter edit OPERATION --help` shows them. Pictures alone are painted: the options of paint are
    below. A picture that is called like an operation is given as ./paint.

    Pictures: PNG, JPEG, WebP, TIFF, OpenEXR, PSD, OpenRaster or Krita, painted on what `splatpainter render` made, or
    on a photograph that the asset was made from. Transparent pixels mean: unchanged. Later pictures win where several
    disagree.

    example:
      splatpainter edit vase.ply views/view_000.png --out painted.ply
      splatpainter edit vase.ply warm.png --mode global --out warm.ply
      splatpainter edit vase.ply paint view.png grade --exposure 0.3 --where y=..0 --out new.ply
      splatpainter edit garden photo.jpg --camera data/sparse/0 --out painted.ply
      splatpainter edit vase.ply decal label.png --at 400,300 --camera cam.json --width 20% --out new.ply
      splatpainter edit vase.ply generate --source gemini --prompt "mossy stone" --views auto --out mossy.ply
    """


@dataclass(frozen=True)
class Segment:
    """The words of one operation."""

    kind: str
    words: tuple[str, ...] = ()
    is_named: bool = True
    """Whether its name was given; only `paint`'s may be left out."""

    @property
    def program(self) -> str:
        return f"{PROGRAM} {self.kind}" if self.is_named else PROGRAM


def dispatch(words: Sequence[str]) -> Outcome:
    """Run a command line. Raises ValueError, SystemExit as `option_parsing.parse`."""
    # Help of an operation by its name, wherever the name stands.
    helped = {"--help", "-h"} & {*words}
    if helped and words[0] in KINDS:
        parse(operation_class(words[0]), f"{PROGRAM} {words[0]}", ["--help"])
    # Words are split before anything is parsed, for each operation has options of its own.
    of_files, segments = split_words(words)
    named = [segment for segment in segments if segment.is_named]
    if helped and named:
        parse(operation_class(named[-1].kind), named[-1].program, ["--help"])
    # With a name the list is meant; each part is parsed by its operation's fields.
    if named:
        config = parse(Arguments, PROGRAM, of_files)
        classes = [operation_class(segment.kind) for segment in segments]
        pairs = zip(classes, segments, strict=True)
        operations = [operation_from(parse(kind, segment.program, segment.words), kind) for kind, segment in pairs]
        # Errors name the part of the line that they are about, in the words of the command line.
        wordings = [spoken(kind, f"{segment.program}: ") for kind, segment in zip(classes, segments, strict=True)]
    elif is_shorthand(words, [option_name(field) for field in dataclasses.fields(Config)]):
        # Without a name, but with options that paint does not have: the older spelling.
        from splatpainter.commands.parts.edit_shorthand import (
            parse_shorthand,  # which loads what sources and decals need
        )

        config, operation, wording = parse_shorthand(words, PROGRAM, EditArguments, AssetArguments)
        operations, wordings = [operation], [wording]
    else:
        # Pictures alone are painted, and then all options are on one help page.
        config = parse(Config, PROGRAM, words)
        operations, wordings = [operation_from(config, Paint)], [spoken(Paint, f"{PROGRAM}: ")]
    return_large_arrays()
    keep_no_idle_memory()
    outcome = _ran(config, operations, wordings)
    return outcome.as_json() if config.json else outcome


def is_shorthand(words: Sequence[str], names: Sequence[str]) -> bool:
    """Whether a command line has options besides these (without dashes), --help and the old names of options."""
    # Options that paint has itself say nothing about the spelling; --help shows the present one.
    options = {word.split("=", 1)[0].replace("_", "-") for word in words if word.startswith("--") and len(word) > 2}
    plain = {f"--{dash}{name}" for name in names for dash in ("", "no-")} | {"--help", *OLD_OPTIONS.values()}
    return "--help" not in options and "-h" not in words and not options <= plain


def run(config: Config) -> Outcome:
    """Paint with pictures, as the command line does where it names no operation."""
    return _ran(config, [operation_from(config, Paint)], [spoken(Paint, f"{PROGRAM}: ")])


def _ran(config: Any, operations: Sequence[Operation], wordings: Sequence[Wording]) -> Outcome:
    # By identity: two operations of a list may be equal and stand in different places.
    by_id = {id(operation): wording for operation, wording in zip(operations, wordings, strict=True)}
    act = plan_operations if config.dry_run else run_operations
    return act(config, operations, lambda operation: by_id[id(operation)])


def split_words(words: Sequence[str]) -> tuple[list[str], list[Segment]]:
    """(the words of the file's options and of ASSET, the operations' words in order). The word right behind an option
    that takes a value is its value, whatever it is called."""
    # Options of the file may stand anywhere, so they are known by name before the rest is dealt out.
    flags, valued = _options_of(Arguments)
    of_files: list[str] = []
    segments: list[tuple[str, list[str], bool]] = []
    leading: list[str] = []
    current, has_asset, value_of = leading, False, None
    # One word after the other with a note of whose value comes next, so that a value may look like a name.
    for word in words:
        option = word.split("=", 1)[0].replace("_", "-") if word.startswith("--") else ""
        if value_of is not None and not option:
            value_of.append(word)
            value_of = None
        elif option in flags or option in valued:
            of_files.append(word)
            value_of = of_files if option in valued and "=" not in word else None
        elif option:
            # Options belong to the operation before them, or to paint at the beginning.
            current.append(word)
            kind = segments[-1][0] if segments else "paint"
            is_flag = option in _options_of(operation_class(kind))[0]
            value_of = None if is_flag or "=" in word else current
        elif not has_asset:
            # The first free word is the asset, and only after it may an operation's name come.
            of_files.append(word)
            has_asset = True
        elif is_kind(word):
            current = []
            segments.append((word, current, True))
        else:
            current.append(word)
    if leading:
        segments.insert(0, ("paint", leading, False))
    return of_files, [Segment(kind, tuple(given), named) for kind, given, named in segments]


def is_kind(word: str) -> bool:
    """Whether a word names an operation. Those of other distributions are looked for only where it may be one."""
    # Entry points cost a look at all that is installed, so only likely words pay for it.
    return word in KINDS or (word.isidentifier() and word in kinds())


@functools.cache
def _options_of(kind: type) -> tuple[frozenset[str], frozenset[str]]:
    """(flags, options with values) of a dataclass."""
    names = {option_name(field): field.type in ("bool", bool) for field in dataclasses.fields(kind)}
    flags = {f"--{dash}{name}" for name, is_flag in names.items() if is_flag for dash in ("", "no-")}
    valued = {f"--{name}" for name, is_flag in names.items() if not is_flag}
    old = {OLD_OPTIONS[option] for option in valued & set(OLD_OPTIONS)}
    return frozenset({*flags, "--help"}), frozenset(valued | old)
