"""Plain command lines are read without tyro, and as tyro reads them."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import MISSING, fields
from itertools import chain
from pathlib import Path
from random import Random
from typing import Any, get_type_hints

import pytest

from splatpainter import cli
from splatpainter.commands import DISTRIBUTIONS, SUMMARIES
from splatpainter.commands.parts.option_parsing import option_name, parse, parsed_by_tyro
from splatpainter.commands.parts.quick_options import quick_config
from splatpainter.operations.operation import KINDS, operation_class

CONFIGS: dict[str, type] = {
    name: module.Config
    for name in SUMMARIES
    if name not in DISTRIBUTIONS and hasattr(module := cli._module(name), "Config")
} | {f"edit {name}": operation_class(name) for name in KINDS}
WORDS: tuple[str, ...] = (
    "a.ply", "views/b.png", "3", "0.25", "1e3", "007", "-1", "-0.5", "auto", "rub", "local", "ttt", "None", "none",
    "true", "16", "1,2", "", " ", "ä b", "nan", "_", "1_000", "+1", "@file", "=", "a=b", ".5", "--", "-", "yes",
)  # fmt: skip


TEXT_OF_TYPES = re.compile(r"Literal\[([^\]]*)\]")
LEFT_TO_TYRO = ("batch",)
"""Commands with an option of a kind that is not read here."""


def words_of(hint: Any, random: Random) -> list[str]:
    """Values of an option: often such as its type has, else any."""
    text = str(hint)
    if random.random() < 0.3:
        return random.choices(WORDS, k=random.choice([0, 1, 1, 2]))
    if hint is bool:
        return []
    if choices := TEXT_OF_TYPES.search(text):
        return [random.choice(choices[1].split(", ")).strip("'")]
    if "float" in text or "int" in text:
        return [random.choice(["0", "1", "7", "0.5", "12.25", "400"])]
    return random.choices(WORDS[:3], k=random.randint(1, 3) if "tuple" in text else 1)


def lines_of(kind: type, hints: dict[str, Any], random: Random, count: int) -> list[list[str]]:
    """Command lines of options that the class has, with values that may fit or not."""
    named = {f"--{option_name(field)}": field for field in fields(kind)}
    needed = [name for name, field in named.items() if field.default is MISSING and field.default_factory is MISSING]
    positions = sum("ByPosition" in str(hints[field.name]) for field in fields(kind))
    lines = []
    for _ in range(count):
        parts = [random.choices(WORDS[:3], k=random.choice([positions, positions, random.randint(0, 3)]))]
        names = {
            *random.sample([*named], min(len(named), random.randint(0, 3))),
            *(needed if random.random() < 0.8 else []),
        }
        for name in sorted(names):
            if "ByPosition" not in str(hints[named[name].name]) or random.random() < 0.1:
                parts.append([name, *words_of(named[name].metadata.get("words") or hints[named[name].name], random)])
        random.shuffle(parts)
        lines.append([*chain(*parts)])
    return lines


def values_of(config: Any) -> dict[str, Any]:
    return {name: getattr(config, name) for name in sorted(field.name for field in fields(config))}


@pytest.mark.parametrize("name", CONFIGS)
def test_what_is_read_is_what_tyro_reads(name: str) -> None:
    kind = CONFIGS[name]
    hints, read = get_type_hints(kind, include_extras=True), 0
    for words in lines_of(kind, hints, Random(name), 150):
        config = quick_config(kind, words, hints)
        if config is None:
            continue
        read += 1
        theirs = parsed_by_tyro(kind, name, words)
        assert repr(values_of(config)) == repr(values_of(theirs)), words
        assert type(config) is kind
    assert read >= 8 or name in LEFT_TO_TYRO, "few lines were plain"


@pytest.mark.parametrize(
    "line",
    [
        "info ball.ply", "info ball.ply --json --in-axes rub", "info ball.ply --frame rdf", "convert a.ply b.spz",
        "convert a.ply b.spz --sh-degree 1 --spz-version 4", "verify a.ply b.ply --receipt r.json",
        "edit a.ply v.png --out b.ply", "edit a.ply v.png w.png --camera c.json d.json --out b.ply --overwrite",
        "edit a.ply v.png --mask m.png --mode global --method lift --angle-limit 60 --out b.ply",
        "render a.ply --out views --size 800 --background 1,1,1", "merge a.ply b.ply --out c.ply",
        "studio", "studio a.ply --port 8000",
    ],
)  # fmt: skip
def test_lines_of_every_day_are_plain(line: str) -> None:
    name, *words = line.split()
    kind = CONFIGS[name]
    config = quick_config(kind, words, get_type_hints(kind, include_extras=True))
    assert config is not None
    assert repr(values_of(config)) == repr(values_of(parsed_by_tyro(kind, name, words)))


@pytest.mark.parametrize(
    "words",
    [["a.ply", "--help"], ["-h"], ["a.ply", "--json", "--json"], ["a.ply", "--in-axes=rub"], ["a.ply", "b.ply"],
     ["a.ply", "--in_axes", "rub"], ["a.ply", "--in-axes", "up"], ["a.ply", "--no-json"], [], ["a.ply", "--", "b"]],
)  # fmt: skip
def test_doubtful_lines_are_left_to_tyro(words: list[str]) -> None:
    kind = CONFIGS["info"]
    assert quick_config(kind, words, get_type_hints(kind, include_extras=True)) is None


def test_numbers_below_nothing_and_signs_are_read_by_tyro() -> None:
    kind = operation_class("grade")
    config = parse(kind, "grade", ["--exposure", "-0.5"])
    assert config.exposure == -0.5


def test_plain_lines_load_no_tyro(tmp_path: Path) -> None:
    program = (
        "import sys\nfrom splatpainter.cli import main\n"
        f"main(['info', {str(tmp_path / 'none.ply')!r}, '--json'])\n"
        f"main(['edit', 'a.ply', 'v.png', '--out', {str(tmp_path)!r}])\n"
        "print('tyro' in sys.modules, 'PIL' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False False\n"
