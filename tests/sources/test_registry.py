"""Sources by name: options, what they are held to, other packages, and no key in anything that leaves them."""

from __future__ import annotations

import importlib.metadata
import sys
import traceback
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.sources import registry
from splatpainter.sources.picture_source import (
    Capabilities,
    PictureAnswer,
    PictureRequest,
    SourceCancelled,
    SourceError,
)
from splatpainter.sources.registry import CheckedSource, describe_sources, open_source, source_names, without_secrets
from splatpainter.sources.source_options import (
    SourceDescription,
    option,
    option_words,
    options_help,
    parse_options,
)
from tests.support.picture_requests import Progressed, request

KEY = "sk-0123456789abcdef"


@dataclass(frozen=True)
class RustOptions:
    model: Path = option("A file")
    amount: float = option("Share of the rust.", 0.5, least=0, most=1)
    steps: int = option("Rounds", 4, least=1)
    quick: bool = option("No second round", False)
    kind: str = option("Of rust", "red", choices=("red", "brown"), environment=("RUST_KIND",))


class Painted:
    """A source that paints everything in one colour, or does what it is asked to instead."""

    name = "painted"

    def __init__(self, capabilities: Capabilities, answer: Any = None, error: Exception | None = None) -> None:
        self.capabilities = capabilities
        self.answer, self.error, self.requests = answer, error, []

    def edit(self, request: PictureRequest, progress: object, cancel: object) -> PictureAnswer:
        self.requests.append(request)
        if self.error is not None:
            raise self.error
        return PictureAnswer(np.full((4, 4, 3), 0.5, np.float32)) if self.answer is None else self.answer


def edit(source: CheckedSource, query: PictureRequest) -> PictureAnswer:
    progress = Progressed()
    return source.edit(query, progress, progress.cancel)


def test_options_from_words_the_environment_and_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLATPAINTER_RUST_STEPS", "9")
    monkeypatch.setenv("SPLATPAINTER_RUST_AMOUNT", "0.1")
    monkeypatch.setenv("RUST_KIND", "brown")
    given = option_words(["amount=0.8", "quick=yes", "model=~/a=b.safetensors"])
    options = parse_options(RustOptions, "rust", given)
    assert options == RustOptions(Path("~/a=b.safetensors").expanduser(), 0.8, 9, True, "brown")
    monkeypatch.setenv("SPLATPAINTER_RUST_KIND", "red")
    assert parse_options(RustOptions, "rust", given).kind == "red"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["model=a", "amout=1"], "no option 'amout'; perhaps you meant amount; it has model, amount, steps, quick"),
        ([], "needs the option model (A file): --source-option model=..., or SPLATPAINTER_RUST_MODEL"),
        (["model="], "option model: expected a path, got nothing"),
        (["model=a", "amount=2"], "option amount: expected a number of at least 0 and at most 1, got '2'"),
        (["model=a", "amount=nan"], "expected a number of at least 0 and at most 1, got 'nan'"),
        (["model=a", "steps=1.5"], "option steps: expected a whole number of at least 1, got '1.5'"),
        (["model=a", "quick=maybe"], "option quick: expected yes or no, got 'maybe'"),
        (["model=a", "kind=blue"], "option kind: expected red or brown, got 'blue'"),
        (["model=a\0"], "none of them NUL"),
        (["model"], "expected KEY=VALUE, got 'model'"),
        (["model=a", "model=b"], "model was given twice"),
    ],
)
def test_options_that_are_wrong(words: list[str], line: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_options(RustOptions, "rust", option_words(words))
    assert line in str(error.value) and "\n" not in str(error.value)


def test_help_of_options() -> None:
    first, second, *_, last = options_help(SourceDescription("rust", "", RustOptions))
    assert first.required and first.environment == ("SPLATPAINTER_RUST_MODEL",)
    assert (second.default, second.meaning) == ("0.5", "Share of the rust.")
    assert last.environment == ("SPLATPAINTER_RUST_KIND", "RUST_KIND")


@pytest.mark.parametrize(
    ("excess", "line"),
    [
        (request("rust"), "does not take a prompt"),
        (request(mask=True), "does not take a mask"),
        (request(seed=1), "does not take a seed"),
        (request(references=2), "does not take 2 reference pictures"),
        (request(scale=4), "does not take an enlargement of 4"),
        (replace(request(), image=np.zeros((2, 65, 3), np.float32)), "does not take a picture of 65 x 2 pixels"),
    ],
)
def test_more_than_a_source_takes_is_refused(excess: PictureRequest, line: str) -> None:
    inner = Painted(Capabilities(references=1, max_side_px=64))
    with pytest.raises(SourceError, match=line) as error:
        edit(CheckedSource(inner, "painted"), excess)
    assert "it takes up to 1 reference pictures, pictures of up to 64 pixels a side" in str(error.value)
    assert not inner.requests


def test_seeds_and_what_would_help() -> None:
    able = Capabilities(seed=True, max_seed=9, scales=(2,), hint="say --scale 2")
    source = CheckedSource(Painted(able), "painted")
    for seed in (-1, 10):
        with pytest.raises(SourceError, match=rf"expected a seed of 0 to 9, got {seed}$"):
            edit(source, request(seed=seed, scale=2))
    with pytest.raises(SourceError, match=r"an enlargement of 1; .*a side; say --scale 2$"):
        edit(source, request(seed=9))


def test_a_prompt_that_is_needed() -> None:
    source = CheckedSource(Painted(Capabilities(prompt=True, needs_prompt=True)), "painted")
    with pytest.raises(SourceError, match="needs a prompt"):
        edit(source, request("  "))
    assert edit(source, request("rust")).image.shape == (4, 4, 3)


@pytest.mark.parametrize(
    "image", [None, np.zeros((4, 4)), np.zeros((0, 4, 3)), np.full((2, 2, 3), np.nan), np.zeros((2, 2, 3), int), "a"]
)
def test_answers_that_are_no_pictures(image: Any) -> None:
    with pytest.raises(SourceError, match="^source painted: expected"):
        edit(CheckedSource(Painted(Capabilities(), PictureAnswer(image)), "painted"), request())
    with pytest.raises(SourceError, match="got str"):
        edit(CheckedSource(Painted(Capabilities(), "a picture"), "painted"), request())


def test_answers_are_made_alike() -> None:
    bytes_of = PictureAnswer(np.full((2, 2, 4), 255, np.uint8), model="a\nb", notes=("two\nlines",))
    answer = edit(CheckedSource(Painted(Capabilities(), bytes_of), "painted"), request())
    assert answer.image.dtype == np.float32 and (answer.image == 1).all()
    assert (answer.model, answer.notes) == ("a b", ("two lines",))


@pytest.mark.parametrize("error", [RuntimeError(f"401 for {KEY}\nat once"), SourceError(f"bad key {KEY}")])
def test_no_key_leaves_a_source(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUST_API_KEY", KEY)
    inner = Painted(Capabilities(), error=error)
    with pytest.raises(SourceError) as raised:
        edit(CheckedSource(inner, "painted"), request())
    text = "".join(traceback.format_exception(raised.value))
    assert KEY not in text and "<RUST_API_KEY>" in str(raised.value) and "\n" not in str(raised.value)
    assert raised.value.__context__ is None
    noted = PictureAnswer(np.zeros((2, 2, 3)), KEY, None, f"for {KEY}", (f"with {KEY}",))
    answer = edit(CheckedSource(Painted(Capabilities(), noted), "painted"), request())
    assert KEY not in repr(answer) and without_secrets(f"a{KEY}b") == "a<RUST_API_KEY>b"


def test_every_line_says_which_source_it_is_of() -> None:
    progress = Progressed()
    source = open_source("command", {"run": f"{sys.executable} {{depth}} {{out}}"})
    with pytest.raises(SourceError, match="^source command: depth: this view has no depth map; give an asset"):
        source.edit(request(), progress, progress.cancel)


def test_cancelled_before_it_starts() -> None:
    inner, progress = Painted(Capabilities()), Progressed()
    progress.cancel.set()
    with pytest.raises(SourceCancelled):
        CheckedSource(inner, "painted").edit(request(), progress, progress.cancel)
    assert not inner.requests


def rusty(options: dict[str, str]) -> Painted:
    """Rust on everything."""
    parse_options(RustOptions, "rusty", options)
    return Painted(Capabilities())


def broken(options: dict[str, str]) -> Painted:
    raise ImportError("no module of mine")


def no_source(options: dict[str, str]) -> object:
    return options


def add_sources(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    points = [
        importlib.metadata.EntryPoint(name.split(":")[0], f"{__name__}:{name.split(':')[-1]}", registry.ENTRY_POINTS)
        for name in names
    ]
    monkeypatch.setattr(registry, "_entry_points", lambda: points)
    monkeypatch.setattr(importlib.metadata.EntryPoint, "load", lambda point: globals()[point.attr])


def test_sources_of_other_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    add_sources(monkeypatch, "rusty", "broken", "no_source", "absent", "command:rusty")
    assert source_names()[-4:] == ["absent", "broken", "no_source", "rusty"]
    assert edit(open_source("rusty", {"model": "a"}), request()).image.shape == (4, 4, 3)
    with pytest.raises(SourceError, match="no option 'colour'; perhaps you meant model; it has|no option 'colour'"):
        open_source("rusty", {"colour": "a"})
    with pytest.raises(SourceError, match=r"cannot be opened \(ImportError: no module of mine\); it comes with"):
        open_source("broken")
    with pytest.raises(SourceError, match="expected an object with edit and capabilities, got dict"):
        open_source("no_source")
    statuses = {(status.description.name, status.distribution): status for status in describe_sources()}
    other = "an unnamed distribution"
    assert (
        statuses["rusty", other].description.summary == "Rust on everything." and not statuses["rusty", other].missing
    )
    assert "cannot be loaded (KeyError" in statuses["absent", other].problem
    assert "a source of this package has its name" in statuses["command", other].problem


def test_two_sources_of_one_name(monkeypatch: pytest.MonkeyPatch) -> None:
    add_sources(monkeypatch, "rusty", "rusty:broken")
    with pytest.raises(SourceError, match="uninstall one of them"):
        open_source("rusty")


def test_a_name_that_there_is_not() -> None:
    with pytest.raises(SourceError, match="'comand': no such source; perhaps you meant command; available:"):
        open_source("comand")


def test_what_the_sources_here_need() -> None:
    statuses = {status.description.name: status for status in describe_sources()}
    assert list(statuses)[: len(registry.BUILT_IN)] == list(registry.BUILT_IN)
    for name in registry.BUILT_IN:
        description = statuses[name].description
        assert description.name == name and description.summary and description.accepts and options_help(description)
