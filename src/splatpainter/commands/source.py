"""`splatpainter source`: where edited pictures can come from, and one picture through one of them."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np

from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_marks import Argument, Positional
from splatpainter.commands.parts.option_parsing import parse
from splatpainter.commands.parts.terminal import BAR_DELAY_SECONDS, watched
from splatpainter.image_files import encode_png, find_camera, quantized
from splatpainter.output_paths import check_target
from splatpainter.pictures.picture_reader import read_mask, read_picture, resample
from splatpainter.sources.picture_source import PictureRequest, Progress
from splatpainter.sources.registry import SourceStatus, describe_sources, open_source
from splatpainter.sources.source_options import option_words, options_help
from splatpainter.system.atomic import writing
from splatpainter.system.quick_dataclass import dataclass

SUMMARIES = {
    "list": "list the sources, what each takes, and what each still needs",
    "try": "send one picture through a source, and write the result",
}
SourceName: TypeAlias = Annotated[Positional[str], Argument(metavar="NAME")]
SourceOptions: TypeAlias = Annotated[tuple[str, ...], Argument(metavar="KEY=VALUE ...", help_behavior_hint="")]
Pictures: TypeAlias = Annotated[tuple[Path, ...], Argument(metavar="PICTURE ...", help_behavior_hint="")]


def dispatch(words: Sequence[str]) -> Outcome:
    """`source NAME ...`. Raises ValueError for another NAME."""
    # Help by hand: two subcommands do not need a parser above theirs.
    if not words or words[0] in ("-h", "--help"):
        rows = [f"  {name:<5} {line}" for name, line in SUMMARIES.items()]
        head = ["usage: splatpainter source COMMAND ...", "", "Where edited pictures come from.", "", "commands:"]
        tail = ["", "example:", "  splatpainter source list"]
        return Outcome({"source": SUMMARIES}, [*head, *rows, *tail])
    if words[0] not in SUMMARIES:
        raise ValueError(f"splatpainter source: expected one of {', '.join(SUMMARIES)}, got {words[0]!r}")
    kind, run = {"list": (SourceListConfig, listing), "try": (SourceTryConfig, attempt)}[words[0]]
    config = parse(kind, f"splatpainter source {words[0]}", words[1:])
    outcome = run(config)
    return outcome.as_json() if config.json else outcome


@dataclass(frozen=True)
class SourceListConfig:
    """Show every source: what it takes, its options, what it needs and whether that is here. Keys are looked for in the
    environment and never shown.

    example:
      splatpainter source list
      splatpainter source list openai
    """

    names: Annotated[Positional[tuple[str, ...]], Argument(metavar="NAME ...", help_behavior_hint="")] = ()
    """Only these, with their options."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class SourceTryConfig:
    """Send one picture through a source and write the result unchanged: not registered, corrected or masked.

    example:
      splatpainter source try gemini views/view_000.png --prompt "covered in rust" --out rusty.png
      splatpainter source try upscale view.png --scale 2 --out larger.png
      splatpainter source try command view.png --source-option "run=tool {image} {out}" --out new.png
    """

    name: SourceName
    """Name of the source (splatpainter source list)."""
    picture: Annotated[Positional[Path], Argument(metavar="PICTURE")]
    """The picture to be edited: PNG, JPEG, WebP, TIFF or OpenEXR."""
    out: Annotated[Path, Argument(metavar="OUT.png")]
    """The file to write, a PNG."""
    prompt: Annotated[str, Argument(metavar="TEXT")] = ""
    """What the source should do to the picture."""
    mask: Annotated[Path | None, Argument(metavar="M.png", help_behavior_hint="")] = None
    """Mask: only what is not black may change."""
    reference: Pictures = ()
    """Reference pictures for the source."""
    seed: Annotated[int | None, Argument(metavar="INT", help_behavior_hint="")] = None
    """Seed of the source's random numbers."""
    scale: int = 1
    """Factor by which the source enlarges the picture."""
    source_option: SourceOptions = ()
    """Options of the source, see splatpainter source list NAME."""
    overwrite: bool = False
    """Replace OUT if it exists."""
    json: bool = False
    """Print one JSON object instead of text."""


def listing(config: SourceListConfig) -> Outcome:
    """All sources, or those that were named. Raises ValueError for a name that there is not."""
    # Each source says for itself what it lacks; one that cannot be loaded does not hide the others.
    statuses = describe_sources()
    names = [status.description.name for status in statuses]
    # A misspelt name is answered with those that there are.
    for name in config.names:
        if name not in names:
            raise ValueError(f"splatpainter source list: no source {name!r}; available: {', '.join(names)}")
    chosen = [status for status in statuses if not config.names or status.description.name in config.names]
    lines = [line for status in chosen for line in _lines(status, bool(config.names))]
    hint = [] if config.names else ["", "splatpainter source list NAME shows the options of a source."]
    return Outcome({"sources": [_record(status) for status in chosen]}, [*lines, *hint])


def attempt(config: SourceTryConfig) -> Outcome:
    """One picture there and back."""
    # One picture as it came, so one format, which loses nothing of it.
    if config.out.suffix.lower() != ".png":
        raise ValueError(f"{config.out}: expected a name ending in .png")
    inputs = [config.picture, *config.reference, *([config.mask] if config.mask else [])]
    check_target(config.out, config.overwrite, [], inputs)
    # The source first, then the picture: a missing key or library is the likelier fault.
    source = open_source(config.name, option_words(config.source_option))
    request = _request(config)
    with source_progress() as progress:
        answer = source.edit(request, progress, threading.Event())
    # Unchanged: this command is there to see what a source does by itself.
    with writing(config.out) as file:
        file.write(encode_png(quantized(answer.image)))
    height, width = answer.image.shape[:2]
    record = {
        "out": config.out,
        "source": config.name,
        "model": answer.model,
        "prompt": config.prompt,
        "seed": answer.seed,
        "cost": answer.cost,
        "notes": list(answer.notes),
        "size": [width, height],
    }
    # What a source does not say is left out and not shown as unknown.
    facts = [answer.model, f"seed {answer.seed}" if answer.seed is not None else "", answer.cost]
    summary = ", ".join(filter(None, [config.name, *facts]))
    lines = [
        f"{config.picture} -> {config.out} ({width}x{height})",
        summary,
        *(f"note: {note}" for note in answer.notes),
    ]
    return Outcome(record, lines)


@contextlib.contextmanager
def source_progress() -> Iterator[Progress]:
    """Shows what a source reports, in one line on stderr after BAR_DELAY_SECONDS, where a person is looking."""
    # Where nobody looks, lines of progress would only fill a log.
    if not watched():
        yield lambda share, words: None
        return
    from tqdm import tqdm

    form = "{desc:<40.40} {bar} {percentage:3.0f} % [{elapsed}]"
    bar = tqdm(total=1.0, delay=BAR_DELAY_SECONDS, leave=False, file=sys.stderr, bar_format=form)
    lock = threading.Lock()  # services report from their thread

    # Sources report from threads, at any rate and in any order.
    def report(share: float, words: str) -> None:
        with lock:
            bar.n = max(0.0, min(share, 1.0))
            bar.set_description_str(words, refresh=False)
            bar.update(0)
            bar.refresh()

    try:
        yield report
    finally:
        bar.close()


def _request(config: SourceTryConfig) -> PictureRequest:
    picture = read_picture(config.picture)
    width, height = picture.size
    mask = None
    if config.mask is not None:
        # A mask of another size is resampled, one of another shape was made for another picture.
        mask = read_mask(config.mask).astype(np.float32)
        if abs((mask.shape[1] / mask.shape[0]) / (width / height) - 1) > 0.01:
            raise ValueError(f"{config.mask}: expected the size of the picture ({width}x{height})")
        if mask.shape != (height, width):
            mask = (resample(mask, width, height) > 0.25).astype(np.float32)
        if not mask.any():
            raise ValueError(f"{config.mask}: empty mask; expected some pixels that are not black")
    # A camera is welcome and not needed here.
    camera = None
    with contextlib.suppress(ValueError):  # any picture can be tried
        camera = find_camera(config.picture)
    alpha = np.ones((height, width), np.float32) if picture.alpha is None else picture.alpha
    references = tuple(read_picture(path).colors for path in config.reference)
    # Sources get colours over black, with the alpha beside them.
    colors = picture.colors * alpha[..., None]
    return PictureRequest(colors, alpha, mask, config.prompt, references, config.seed, config.scale, camera)


def _record(status: SourceStatus) -> dict[str, Any]:
    description = status.description
    return {
        "name": description.name,
        "summary": description.summary,
        "takes": description.accepts,
        "paid": bool(description.capabilities and description.capabilities.paid),
        "options": [
            {
                "name": option.name,
                "meaning": option.meaning,
                "default": option.default,
                "required": option.required,
                "environment": list(option.environment),
            }
            for option in options_help(description)
        ],
        # Which variables are looked at, and whether one is set; never a value.
        "keys": {"variables": list(description.keys), "set": bool(description.key_variable)},
        "distribution": status.distribution or "splatpainter",
        "ready": not status.missing,
        "missing": list(status.missing),
    }


def _lines(status: SourceStatus, full: bool) -> list[str]:
    description = status.description
    origin = f" (of {status.distribution})" if status.distribution else ""
    lines = [f"{description.name:<10} {description.summary}{origin}"]
    lines += [f"{'':<10} takes {description.accepts}"] if description.accepts else []
    lines += [f"{'':<10} missing: {line}" for line in status.missing] or [f"{'':<10} ready"]
    if description.keys:
        optional = ", not needed everywhere" if description.key_optional else ""
        state = f"in {description.key_variable}" if description.key_variable else "none"
        lines.append(f"{'':<10} key: {state} ({' or '.join(description.keys)}{optional})")
    # Options make the list long, so they are shown for those that were named.
    for option in options_help(description) if full else ():
        default = "required" if option.required else f"default {option.default}" if option.default else "default: none"
        lines.append(
            f"{'':<10} {option.name}= {option.meaning.rstrip('.')} ({default}; {', '.join(option.environment)})"
        )
    return lines
