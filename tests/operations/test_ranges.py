"""A range is stated once, where a number is declared: command line, files, Python, messages and page hold to it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import pytest
from pydantic import ValidationError

import splatpainter as sp
from splatpainter.operations.operation import Operation, Wording, kinds, operation_class, operation_of
from splatpainter.server import schema
from splatpainter.server.commands.color_grading import GradeSliders, HueSliders
from splatpainter.server.commands.source_edit import SourceEdit, SourcePlan
from splatpainter.system.ranges import bounds_of, in_words, out_of_range, ranged


@dataclass(frozen=True)
class Numbers:
    both: float = ranged(0.5, ge=0, le=1)
    open: float | None = ranged(None, gt=0, lt=10)
    above: int = ranged(3, gt=2)
    least: int = ranged(3, ge=1)
    pairs: tuple[tuple[float, float], ...] = ranged((), ge=0, le=1)
    free: float = 7.0


@pytest.mark.parametrize(
    "values, line",
    [
        ({}, None),
        ({"both": 1.0, "open": 9.99, "pairs": ((0.0, 1.0),), "free": -1e9}, None),
        ({"both": 1.01}, "expected both from 0 to 1, got 1.01"),
        ({"both": math.nan}, "expected both from 0 to 1, got nan"),
        ({"open": 0}, "expected open above 0, below 10, got 0"),
        ({"open": 10.0}, "expected open above 0, below 10, got 10.0"),
        ({"above": 2}, "expected above above 2, got 2"),
        ({"least": 0}, "expected least from 1 on, got 0"),
        ({"pairs": ((0.0, 0.5), (0.7, 1.5))}, "expected pairs from 0 to 1, got 1.5"),
    ],
)
def test_the_first_number_beyond_its_range_is_named(values: dict, line: str | None) -> None:
    assert out_of_range(Numbers(**values)) == line


def test_ranges_in_words() -> None:
    assert in_words({"gt": 0, "le": 180}) == "above 0, up to 180" and in_words({"le": 3}) == "up to 3"
    assert in_words({"ge": 0, "le": 2**64 - 1}) == "from 0 to 18446744073709551615"


@pytest.mark.parametrize("kind", [kind for kind in kinds() if kind not in ("light", "delight", "pixelate")])
def test_every_range_of_an_operation_is_checked(kind: str) -> None:
    """By the command line's names, before anything that else is wrong with it."""
    operation, wording = operation_class(kind), Wording("", "--")
    for entry in fields(operation):
        for word, bound in bounds_of(entry).items():
            values = {entry.name: bound - 1 if word in ("ge", "gt") else bound + 1}
            # The two that `generate` asks for first.
            values |= {"source": "x", "views": "auto"} if kind == "generate" else {}
            value = operation(**values)
            with pytest.raises(ValueError) as error:
                value.check(wording)
            assert str(error.value) == out_of_range(value, wording.option)


def test_the_same_range_in_every_form() -> None:
    line = "expected exposure from -10 to 10, got 10.5"
    with pytest.raises(ValueError, match=line):
        sp.Grade(exposure=10.5).check()
    with pytest.raises(ValueError, match=line):
        operation_of({"kind": "grade", "exposure": 10.5}, "x")
    with pytest.raises(ValueError, match=line):
        sp.GradeSettings(exposure=10.5)
    with pytest.raises(ValidationError, match="exposure"):
        GradeSliders(exposure=10.5)
    text = schema.typescript()
    assert "  GradeSliders: { exposure: [-10, 10], temperature: [-1, 1]," in text
    assert "seed: [0, 9007199254740991]" in text, "no larger integer than TypeScript holds"


def test_messages_hold_to_the_ranges_of_operations() -> None:
    camera: dict[str, Any] = {"camera": None}
    refused: tuple[tuple[Any, dict[str, Any]], ...] = (
        (HueSliders, {"hue": 360}),
        (GradeSliders, {"curve": [[0, 1.5]]}),
        (GradeSliders, {"curve": [[0, 0]] * 17}),
        (GradeSliders, {"hues": [{"hue": 10, "lightness": 2}]}),
        (SourceEdit, {"source": "x", "enlarge": 0, **camera}),
        (SourceEdit, {"source": "x", "prompt": "p" * 4001, **camera}),
        (SourcePlan, {"source": "x", "max_views": 17}),
        (SourcePlan, {"source": ""}),
    )
    for message, values in refused:
        with pytest.raises(ValidationError):
            message(**values)
    sliders = GradeSliders(curve=((0, 0), (1, 1)), hues=(HueSliders(hue=359.9),))
    assert sp.GradeSettings.from_dict(sliders.model_dump()).hues[0].hue == 359.9
    assert SourcePlan(source="x").max_views is None and isinstance(sp.Grade(), Operation)
