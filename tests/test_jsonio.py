"""JSON to dataclasses and back: what may be left out, how older files spell things, and what is refused in one line."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from splatpainter.system import jsonio


@dataclass(frozen=True)
class Layer:
    width: int
    mixer: Literal["ttt", "attention"] = "ttt"
    rate: float = 0.5


@dataclass(frozen=True)
class Model:
    name: str
    layer: Layer
    layers: tuple[Layer, ...] = ()
    size: tuple[int, float] = (1, 2.0)
    kinds: dict[str, float] = field(default_factory=dict)
    folder: Path | None = None
    fast: bool = False

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("expected a name")


MODEL = Model("m", Layer(3), (Layer(1), Layer(2, "attention", 1.5)), (4, 5.0), {"dab": 1.0}, Path("a/b"), True)


def build(values: Any, **options: Any) -> Model:
    return jsonio.build(Model, values, "file", what="a model", **options)


def changed(path: str, value: Any) -> dict[str, Any]:
    """MODEL as JSON values with another value at a dotted path."""
    values = jsonio.plain(MODEL)
    *parents, last = path.split(".")
    holder = values
    for name in parents:
        holder = holder[name]
    holder[last] = value
    return values


def test_what_was_written_is_read() -> None:
    assert build(json.loads(json.dumps(jsonio.plain(MODEL)))) == MODEL
    assert type(build(changed("layer.rate", 2)).layer.rate) is float


def test_missing_keys_come_from_the_base_or_are_named() -> None:
    assert build({"layer": {"rate": 2}}, base=MODEL).layer == Layer(3, "ttt", 2.0)
    assert build({"layers": [{"width": 7}]}, base=MODEL).layers == (Layer(7),)
    assert build({}, base=MODEL) == MODEL
    values = jsonio.plain(MODEL)
    del values["layer"]["mixer"]
    with pytest.raises(ValueError, match="^file: missing key 'layer.mixer'$"):
        build(values)
    assert build(values, older={"layer.mixer": "attention"}).layer.mixer == "attention"


def test_older_spellings_are_read() -> None:
    values = changed("layer.mixer", "fast")
    values["layer"]["dim"] = values["layer"].pop("width")
    aliases = {"layer.dim": "width", "layer.mixer=fast": "ttt"}
    assert build(values, aliases=aliases) == MODEL
    values["layer"]["width"] = 3
    with pytest.raises(ValueError, match="^file: two values for 'layer.width'$"):
        build(values, aliases=aliases)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("colour\n", 1, "unknown key 'colour?'; known there: name, layer"),
        ("layer.depth", 1, "unknown key 'layer.depth'; known there: width, mixer, rate"),
        ("layer", [1], "expected an object as 'layer', got a list of 1"),
        ("layer.width", 2.5, "expected int as 'layer.width', got 2.5"),
        ("layer.width", True, "expected int as 'layer.width', got True"),
        ("layer.rate", "1", "expected float as 'layer.rate', got '1'"),
        ("layer.rate", float("inf"), "expected a finite number as 'layer.rate', got inf"),
        ("layer.rate", 10**400, "expected a finite number as 'layer.rate', got an integer of 1329 bits"),
        ("layer.mixer", "x" * 999, "expected one of ttt, attention as 'layer.mixer', got 'xxx"),
        ("layers", "ab", "expected a list as 'layers', got 'ab'"),
        ("layers", [jsonio.plain(Layer(1)), {"width": 1}], "missing key 'layers[1].mixer'"),
        ("size", [1], "expected 2 values as 'size', got a list of 1"),
        ("kinds", {"dab": "a"}, "expected float as 'kinds.dab', got 'a'"),
        ("folder", 3, "expected a path as 'folder', got 3"),
        ("fast", 1, "expected bool as 'fast', got 1"),
        ("name", None, "expected str as 'name', got None"),
        ("name", "", "expected a name"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(path: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError) as caught:
        build(changed(path, value))
    line = str(caught.value)
    assert line.startswith(f"file: {message}") and line.isprintable() and len(line) < 200


def test_a_document_has_to_be_an_object() -> None:
    with pytest.raises(ValueError, match="^file: expected an object as a model, got a list of 0$"):
        build([])
    for text in ("[]", "{", '{"a": NaN}', '{"a": 1e999}', '{"a": ' * 70 + "1" + "}" * 70, "[" * 100_000):
        with pytest.raises(ValueError, match=r"^file: [^\n]*a model[^\n]*$"):
            jsonio.load_object(text, "file", "a model")
    with pytest.raises(ValueError, match="^file: a model has 9 bytes; expected at most 8$"):
        jsonio.load_object('{"a": 10}', "file", "a model", max_bytes=8)


def test_numbers_of_numpy_are_numbers() -> None:
    assert build(changed("layer.rate", np.float32(0.25))).layer.rate == 0.25
    assert type(build(changed("layer.width", np.int64(4))).layer.width) is int
