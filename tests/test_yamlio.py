"""YAML of people: what is read, and that every mistake is said with its line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from splatpainter.system import yamlio


@dataclass(frozen=True)
class Step:
    amount: float = 1.0
    words: tuple[str, ...] = ()


@dataclass(frozen=True)
class Document:
    out: Path
    name: str = ""
    on: bool = False
    count: int = 0
    mode: Literal["fast", "slow"] = "fast"
    steps: tuple[Step, ...] = ()


def written(folder: Path, text: str) -> Path:
    path = folder / "a.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_values_and_lines(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        'out: painted\nname: "12"\non: yes\ncount: 1_000\nmode: slow\nsteps:\n  - amount: 1e-3\n'
        "  - &two\n    words: [x=..0.5, 1:30, '7']\n  - *two\n",
    )
    document, lines = yamlio.read(Document, path)
    two = Step(1.0, ("x=..0.5", "1:30", "7"))
    assert document == Document(Path("painted"), "12", True, 1000, "slow", (Step(0.001), two, two))
    assert lines.at("steps[0].amount") == f"{path}:7" and lines.at("steps[1].words[2]") == f"{path}:9"
    assert lines.at("steps[1].amount") == f"{path}:8" and lines.at("steps") == f"{path}:6"
    assert lines.at("elsewhere.deep[3].down") == f"{path}:1" and lines.at("") == f"{path}:1"


@pytest.mark.parametrize(
    "text, line",
    [
        ("", " is empty"),
        ("name: x\n", "1: missing key 'out'"),
        ("- 1\n", "1: expected an object as a mapping of keys and values, got a list of 1"),
        ("out: a\nsteps:\n  - amout: 2\n", "3: unknown key 'steps[0].amout'; known there: amount, words"),
        ("out: a\nsteps:\n  - amount: much\n", "3: expected float as 'steps[0].amount', got 'much'"),
        ("out: a\nsteps:\n  - amount: .inf\n", "3: expected float as 'steps[0].amount', got '.inf'"),
        ("out: a\nname: yes\n", "2: expected str as 'name', got True"),
        ("out: a\nmode: faster\n", "2: expected one of fast, slow as 'mode', got 'faster'"),
        ("out: a\n\ncount: 1.5\n", "3: expected int as 'count', got 1.5"),
        ("out: a\nout: b\n", "2: 'out' was given twice"),
        ("out: a\nname: 2026-11-23\n", "2: expected text, a number or true or false, got '2026-11-23'; put it in"),
        ("out: a\nname: !!python/name:os.system x\n", "2: expected text, a number or true or false"),
        ("out: a\nsteps: !!python/object/apply:os.system [ls]\n", "2: expected plain YAML, got the tag "),
        ("out: a\nsteps: [\n", "3: is not YAML (expected the node content, but found"),
        ("out: a\n\tname: b\n", "2: is not YAML (found character '\\t'"),
        ("a: &a {b: 1}\nc:\n  <<: *a\n", "3: expected the keys themselves in place of <<"),
        ("? [1]\n: 2\n", "1: expected text as a key"),
        ("out: a\nsteps: &a [*a]\n", "2: expected at most 40 mappings and lists inside each other"),
        ("out: a\n--- \nout: b\n", "2: is not YAML (but found another document)"),
    ],
)
def test_a_mistake_is_one_line_with_its_place(tmp_path: Path, text: str, line: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ValueError) as caught:
        yamlio.read(Document, path)
    assert str(caught.value).startswith(f"{path}:{line}"), caught.value
    assert "\n" not in str(caught.value)


def test_hostile_files_cost_nothing(tmp_path: Path) -> None:
    laughs = "a: &a [x,x,x,x,x,x,x,x,x,x]\n"
    for one, two in zip("abcdefgh", "bcdefghi", strict=True):
        laughs += f"{two}: &{two} [{','.join([f'*{one}'] * 10)}]\n"
    with pytest.raises(ValueError, match="expected at most 50000 values"):
        yamlio.read(Document, written(tmp_path, laughs))
    with pytest.raises(ValueError, match="is not YAML"):
        yamlio.read(Document, written(tmp_path, "a: " + "[" * 20_000))
    with pytest.raises(ValueError, match="expected at most 1 MiB of YAML, got more"):
        yamlio.read(Document, written(tmp_path, "#" * ((1 << 20) + 1)))
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(ValueError, match="expected YAML"):
        yamlio.read(Document, tmp_path / "a.yaml")
    with pytest.raises(ValueError, match="none.yaml: no such file"):
        yamlio.read(Document, tmp_path / "none.yaml")
