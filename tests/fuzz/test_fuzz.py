"""The fuzzing: a short run over every target, and that it notices what it is there to notice."""

from __future__ import annotations

import json
import sys
import tempfile
import warnings
from pathlib import Path

import pytest

from tests.fuzz import mutations
from tests.fuzz.specimens import BAD_SEED
from tests.fuzz.supervisor import Plan, faults, run, summary
from tests.fuzz.target import make_target, names, refusal, rng_of
from tests.fuzz.worker import FIELDS, attempt, scratch_root

COUNTS = {"ply": 100, "text-ply": 100, "compressed-ply": 80, "splat": 100, "ksplat": 100, "spz": 60, "glb": 80}
COUNTS |= {"sog": 50, "sog-folder": 30, "picture": 50, "capture": 100, "project": 10, "verify": 60, "studio": 3}
"""Inputs of the short run; `make fuzz` makes the long ones."""


@pytest.mark.parametrize("name", names())
def test_hostile_inputs_open_or_are_refused_in_one_line(name: str) -> None:
    with tempfile.TemporaryDirectory(dir=scratch_root(), prefix="splatpainter-fuzz-") as folder:
        target = make_target(name, Path(folder))
        target.warm_up()
        shared, indices = [0] * len(FIELDS), {field: k for k, field in enumerate(FIELDS)}
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                for seed in range(COUNTS[name]):
                    fault = attempt(target, name, seed, shared, indices)
                    assert fault is None, (
                        f"python -m tests.fuzz --targets {name} --replay {seed}: {fault[0]}\n{fault[1]}"
                    )
        finally:
            target.close()
        assert shared[indices["opened"]] and shared[indices["refused"]]


@pytest.mark.parametrize("name", [name for name in names() if name not in ("project", "studio")])
def test_an_input_is_a_function_of_its_seed(name: str, tmp_path: Path) -> None:
    one, two = (make_target(name, folder) for folder in (tmp_path / "a", tmp_path / "b") if folder.mkdir() is None)
    made = [one.make(rng_of(name, seed)) for seed in range(30)]
    assert made == [two.make(rng_of(name, seed)) for seed in range(30)]
    assert len({json.dumps({k: v.hex() for k, v in files.items()}) for files in made}) > 20


def test_crashes_hangs_warnings_and_memory_are_noticed(tmp_path: Path) -> None:
    kinds = ["raises", "warns", "dies", "hangs", "late"] + (["swells"] if sys.platform.startswith("linux") else [])
    tallies = {}
    for some, hang_seconds in ((["hangs"], 3), ([kind for kind in kinds if kind != "hangs"], 300)):
        plan = Plan(some, 600, 2, most_inputs=6, out=tmp_path, hang_seconds=hang_seconds)
        tallies |= run(plan, say=lambda *_, **__: None)
    for kind in kinds:
        tally = tallies[kind]
        assert (tally.inputs, tally.failures) == (6, 1), (kind, tally)
        record = json.loads((tmp_path / f"{kind}-{BAD_SEED}" / "fault.json").read_text())
        expected = {"raises": "IndexError", "warns": "RuntimeWarning", "dies": "died", "hangs": "hang", "late": "slow"}
        assert {**expected, "swells": "memory"}[kind] in record["fault"]
        made = make_target(kind, tmp_path).make(rng_of(kind, BAD_SEED))
        assert (tmp_path / f"{kind}-{BAD_SEED}" / "chance").read_bytes() == made["chance"]
    assert len(faults(tmp_path)) == len(kinds) and summary(tallies).count("\n") == len(kinds) + 1


@pytest.mark.parametrize(
    "message", ["two\nlines", "x" * 700, "an escape \x1b[2J", "a surrogate \ud800", "", "a.ply: fine"]
)
def test_messages_are_judged(message: str) -> None:
    if message.endswith("fine"):
        refusal(ValueError(message), "a.ply")
        return
    with pytest.raises(AssertionError):
        refusal(ValueError(message))


def test_subclasses_and_messages_without_the_file_are_faults() -> None:
    with pytest.raises(AssertionError, match="UnicodeDecodeError"):
        refusal(UnicodeDecodeError("utf-8", b"", 0, 1, "bad"))
    with pytest.raises(AssertionError, match="names none"):
        refusal(ValueError("something is wrong"), "a.ply")


def test_bent_trees_stay_trees() -> None:
    for seed in range(300):
        rng = rng_of("tree", seed)
        tree = mutations.bend_json(rng, {"a": [1, 2, {"b": "text"}], "c": None, "d": 1.5})
        json.dumps(tree)
