"""Picture sources by name: those of this package, and those of others, by entry points of `splatpainter.sources`.

    source = open_source("command", {"run": "upscale {image} {out}"})
    answer = source.edit(PictureRequest(image, alpha), progress, cancel)

What `open_source` gives holds every source to the interface: it refuses what the source would ignore, checks the
answer, makes one line of any failure, and takes keys out of everything that leaves it.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.metadata
import os
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from splatpainter.image_files import MAX_PICTURE_PIXELS
from splatpainter.sources.picture_source import (
    CancelFlag,
    PictureAnswer,
    PictureRequest,
    PictureSource,
    Progress,
    SourceCancelled,
    SourceError,
    check_request,
)
from splatpainter.sources.source_options import SourceDescription, parse_options
from splatpainter.system.quick_dataclass import dataclass

ENTRY_POINTS = "splatpainter.sources"
"""Group by which other distributions add sources: name = module:factory, factory(options) -> PictureSource."""
BUILT_IN = ("command", "gemini", "openai", "comfyui", "diffusers", "upscale", "watch")
"""Modules of splatpainter.sources.backends, imported when they are asked for: DESCRIPTION and open_source(options)."""
MAX_LINE_CHARACTERS = 600
"""Most characters of an error or a note that a source gives."""
MIN_SECRET_CHARACTERS = 6
"""Shorter keys are no keys; taking them out would take words out."""


@dataclass(frozen=True)
class SourceStatus:
    """A source and whether it can be used here."""

    description: SourceDescription
    distribution: str = ""
    """Distribution that it comes with; "": this one."""
    problem: str = ""
    """Why it cannot be loaded, or ""."""

    @property
    def missing(self) -> tuple[str, ...]:
        """What it needs and is not there, one phrase each; keys by the name of their variable."""
        # Everything at once: whoever sets up a source should not learn of one lack after another.
        lines = [self.problem] if self.problem else []
        if names := self.description.missing_modules:
            extra = self.description.extra
            install = f": pip install 'splatpainter[{extra}]'" if extra else ""
            lines.append(f"{', '.join(names)} not installed{install}")
        # Variables are named and their values never shown.
        if self.description.keys and not self.description.key_variable and not self.description.key_optional:
            lines.append(f"no key: set {' or '.join(self.description.keys)}")
        return tuple(lines)


class CheckedSource:
    """A source held to the interface; `open_source` gives these."""

    def __init__(self, source: PictureSource, name: str) -> None:
        self._source = source
        self.name = name
        self.capabilities = source.capabilities

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """The source's answer, checked. Raises SourceError: the request is more than the source takes, any failure of
        the source, an answer that is no picture; SourceCancelled."""
        # Refused before the source is asked: afterwards it would have cost time and money.
        check_request(request, self.capabilities, self.name)
        if cancel.is_set():
            raise SourceCancelled
        # Whatever another's code raises becomes one line; keys are taken out of it, for errors quote requests.
        try:
            return self._checked(self._source.edit(request, progress, cancel))
        except (SourceCancelled, MemoryError):
            raise
        except SourceError as error:
            line = str(error)
            if not line.startswith(f"source {self.name}: "):
                line = f"source {self.name}: {line}"
        except Exception as error:  # of another's code, or a case that one of ours forgot
            line = f"source {self.name}: failed ({type(error).__name__}: {error})"
        raise SourceError(without_secrets(line))  # outside of the handler: the first one may hold an address or a key

    def _checked(self, answer: PictureAnswer) -> PictureAnswer:
        # An answer may come from any distribution: its type is not taken on trust.
        image = answer.image if isinstance(answer, PictureAnswer) else None
        if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[2] not in (3, 4) or 0 in image.shape:
            actual = f"shape {list(image.shape)}" if isinstance(image, np.ndarray) else type(answer).__name__
            raise SourceError(f"source {self.name}: expected a picture [h, w, 3 or 4] as its answer, got {actual}")
        # After the shape, before any copy is made of it.
        if image.shape[0] * image.shape[1] > MAX_PICTURE_PIXELS:
            raise SourceError(f"source {self.name}: answered more than {MAX_PICTURE_PIXELS // 10**6} megapixels")
        values = image.astype(np.float32) / 255 if image.dtype == np.uint8 else image
        if values.dtype.kind != "f" or not np.isfinite(values).all():
            raise SourceError(f"source {self.name}: expected finite numbers 0..1 in its picture")
        # Words of the source's go into receipts and files, so keys are taken out of them as well.
        return replace(
            answer,
            image=np.clip(values, 0, 1).astype(np.float32),
            model=without_secrets(str(answer.model)),
            cost=without_secrets(str(answer.cost)),
            notes=tuple(without_secrets(str(note)) for note in answer.notes),
        )


def open_source(name: str, options: Mapping[str, str] | None = None) -> CheckedSource:
    """The source of that name. options: KEY -> VALUE as words; what is missing comes from the environment.

    Raises SourceError in one line: no such source (with those that there are), a library that is missing (with what to
    install), options that it does not have or that are wrong. A missing key is an error of `edit`, so that plans can be
    made without one."""
    values = dict(options or {})
    # This package's own first: another distribution cannot take the name of one of them.
    if name in BUILT_IN:
        module = importlib.import_module(f"splatpainter.sources.backends.{name}")
        description: SourceDescription = module.DESCRIPTION
        assert description.options is not None
        parsed = parse_options(description.options, name, values)
        # Options were checked before: a wrong option is worth knowing although the library is missing.
        if description.missing_modules:
            raise SourceError(f"source {name}: {SourceStatus(replace(description, keys=())).missing[0]}")
        return CheckedSource(module.open_source(parsed), name)
    points = [point for point in _entry_points() if point.name == name]
    # The names that there are, with the nearest one first: most wrong names are misspelt.
    if not points:
        names = source_names()
        near = difflib.get_close_matches(name, names, 1)
        hint = f"; perhaps you meant {near[0]}" if near else ""
        raise SourceError(f"source {name[:80]!r}: no such source{hint}; available: {', '.join(names)}")
    # With two of one name it would be chance which one gets the picture.
    if len(points) > 1:
        brought = " and ".join(sorted(_distribution(point) for point in points))
        raise SourceError(f"source {name}: comes with {brought}; uninstall one of them")
    # Another's code runs from here on; its failures are told with the distribution that they came with.
    try:
        source = points[0].load()(values)
    except SourceError as error:
        line = str(error)
    except Exception as error:
        where = _distribution(points[0])
        line = f"source {name}: cannot be opened ({type(error).__name__}: {error}); it comes with {where}"
    else:
        # Looked at now, so that a wrong object fails here and not in the middle of an edit.
        if callable(getattr(source, "edit", None)) and hasattr(source, "capabilities"):
            return CheckedSource(source, name)
        line = f"source {name}: expected an object with edit and capabilities, got {type(source).__name__}"
    raise SourceError(without_secrets(line))


def source_names() -> list[str]:
    """Names of all sources: those of this package, then others in order of their names."""
    return [*BUILT_IN, *sorted({point.name for point in _entry_points()} - {*BUILT_IN})]


def describe_sources() -> list[SourceStatus]:
    """Every source and what it needs. Raises nothing: what cannot be loaded says why."""
    statuses = [
        SourceStatus(importlib.import_module(f"splatpainter.sources.backends.{name}").DESCRIPTION) for name in BUILT_IN
    ]
    # A list must not fail for one entry: what cannot be loaded says why in its place.
    for point in sorted(_entry_points(), key=lambda point: point.name):
        distribution = _distribution(point)
        if point.name in BUILT_IN:
            taken = SourceDescription(point.name, "")
            statuses.append(SourceStatus(taken, distribution, "a source of this package has its name"))
            continue
        try:
            factory = point.load()
            description = getattr(factory, "description", None)
            # A description is optional; the first line of the docstring says enough for a list.
            if not isinstance(description, SourceDescription):
                summary = next(iter((factory.__doc__ or "").strip().splitlines()), "")
                description = SourceDescription(point.name, summary)
            statuses.append(SourceStatus(replace(description, name=point.name), distribution))
        except Exception as error:
            problem = without_secrets(f"cannot be loaded ({type(error).__name__}: {error})")
            statuses.append(SourceStatus(SourceDescription(point.name, ""), distribution, problem))
    return statuses


def secret_variables() -> set[str]:
    """Environment variables whose values are keys: those of the sources, and whatever is called so."""
    # By their usual endings too: keys of other programs may stand in an error as well.
    endings = ("_API_KEY", "_API_TOKEN", "_TOKEN", "_SECRET", "_PASSWORD", "_KEY")
    return {name for name in os.environ if name.upper().endswith(endings)}


def without_secrets(text: str) -> str:
    """One line without any key of the environment, shortened."""
    # Short values are words that may stand anywhere; taking them out would hide plain text.
    for name in secret_variables():
        value = os.environ[name].strip()
        if len(value) >= MIN_SECRET_CHARACTERS:
            text = text.replace(value, f"<{name}>")
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return line if len(line) <= MAX_LINE_CHARACTERS else line[: MAX_LINE_CHARACTERS - 3] + "..."


def _entry_points() -> list[importlib.metadata.EntryPoint]:
    return list(importlib.metadata.entry_points(group=ENTRY_POINTS))


def _distribution(point: importlib.metadata.EntryPoint) -> str:
    return point.dist.name if point.dist is not None else "an unnamed distribution"
