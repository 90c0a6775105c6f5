"""The runner of the paper's tables on a toy table: what is made once, what is made again, and what becomes of methods
that raise, die, cheat or are not there. Figures are known by hand (support/stubs.py)."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatbench import cases, runner
from splatbench.cases import (
    Budget,
    CaseKey,
    CaseStore,
    Record,
    RunConfig,
    Setup,
    fingerprint,
    records,
    to_json,
)
from splatbench.runner import RunResult

from benchmarks.tests.support import stubs as paper_stubs
from benchmarks.tests.support.stubs import counted
from splatpainter.system import jsonio
from tests.support.systems import posix_only

STUBS = Path(paper_stubs.__file__)


@pytest.fixture()
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunConfig:
    """Two objects, the method that works."""
    (tmp_path / "trouble").mkdir()
    monkeypatch.setenv(paper_stubs.VARIABLE, str(tmp_path / "trouble"))
    monkeypatch.setattr(runner, "WORKER", (sys.executable, str(STUBS)))
    paper_stubs.register(monkeypatch)
    return RunConfig("toy", Setup(objects=2, truth="surfels"), ("grow",), Budget(), tmp_path / "out")


def run(config: RunConfig) -> RunResult:
    return runner.run(config, lambda _: None)


def ask_for(config: RunConfig, trouble: str) -> None:
    (config.out.parent / "trouble" / trouble).touch()


def records_of(config: RunConfig, method: str) -> dict[str, Record]:
    return {r.label: r for r in records(config.out / "toy") if r.method == method}


def sums(config: RunConfig) -> dict[str, float | None]:
    return {label: r.figures["sum"] for label, r in records_of(config, "grow").items()}


def table(config: RunConfig) -> str:
    return (config.out / "toy" / "table.md").read_text()


def test_figures_seconds_rows_and_pictures(config: RunConfig) -> None:
    done = run(replace(config, methods=("grow", "bound"), budget=Budget(curve=True)))
    grown = records_of(config, "grow")
    assert list(grown) == ["toy-0-1", "toy-0-2", "toy-1-1", "toy-1-2"]
    one, two = grown["toy-0-1"], grown["toy-1-2"]
    # An edit makes one of eight rows heavier by 1; the second one begins from the first one's answer and memory.
    assert (one.figures["sum"], two.figures["sum"]) == (1.0, 2.0)
    assert (one.rows, one.rows_equal, one.appended) == (8, 7 / 8, 0)
    assert (two.rows_equal, two.setup_seconds, two.edit_seconds) == (6 / 8, 0.5, 2.0)
    assert (two.numbers, two.note, two.facts) == ({"edits": 2.0}, "grows", {"edits": 2, "number": 1})
    assert [(p["seconds"], p["steps"], p["sum"]) for p in two.curve] == [(0.5, 10, 1.5), (1.0, 20, 2.0)]
    assert one.peak_mib is not None and 10 < one.peak_mib < 4000
    line = "Grow, on the way: best Sum (edits 2) 2.00 after 20 steps (1.00 s), 2.00 at the end (2.00 s)"
    assert line in done.notes and not any("Bound, on the way" in note for note in done.notes)
    bound = records_of(config, "bound")["toy-0-1"]
    assert (bound.rows, bound.rows_equal, bound.appended) == (16, None, None)
    rows = {(row.method, row.block): row for row in done.rows}
    assert rows["grow", "1"].figures["sum"].mean == 1 and rows["grow", "2"].figures["sum"].mean == 2
    assert not done.complete and any(line.startswith("LPIPS: n/a") for line in done.notes)
    case = config.out / "toy" / "cases" / "toy-0-1"
    levels = {name: int(_pixels(case / f"{name}.png")[0, 0, 0]) for name in ("input", "before", "truth")}
    assert levels == {"input": 191, "before": 64, "truth": 255}
    assert _pixels(config.out / "toy" / "records" / "grow" / "toy-0-1.png").shape == (4, 4, 3)
    assert "methods may print" in (config.out / "toy" / "logs" / "grow.log").read_text()


def test_nothing_is_done_twice(config: RunConfig) -> None:
    first = run(config)
    text, made = table(config), counted("grow")
    assert (made, counted("make-*")) == (2 * (1 + 2), 4)
    again = run(config)
    assert (counted("grow"), counted("make-*")) == (made, 4)
    assert table(config) == text and again.rows == first.rows
    run(replace(config, redo="all"))
    assert counted("grow") == 2 * made
    assert _figures(table(config)) == _figures(text)


def test_what_changes_is_made_again(config: RunConfig) -> None:
    run(config)
    run(replace(config, budget=Budget(weights={"grow": "2"})))
    assert (counted("grow"), counted("make-*")) == (12, 4), "a method of another version answers anew"
    edited = replace(config, setup=replace(config.setup, seed=1))
    with pytest.raises(
        ValueError, match=r"^bench toy: .*toy holds cases of another setup \(seed 0, not 1\); take another"
    ):
        run(edited)
    (config.out / "toy" / "setup.json").unlink()  # a folder of an older version: what its last run says counts
    with pytest.raises(ValueError, match=r"another setup \(seed 0, not 1\)"):
        run(edited)
    assert (counted("grow"), counted("make-*")) == (12, 4), "refused before any work"
    run(replace(edited, redo="all"))
    assert (counted("grow"), counted("make-*")) == (18, 8), "another setup makes new cases"
    run(replace(edited, setup=replace(edited.setup, objects=3)))
    assert (counted("grow"), counted("make-*")) == (21, 10), "one more object makes no other one new"


def test_a_method_run_alone_keeps_the_rows_of_others(config: RunConfig) -> None:
    run(config)
    done = run(replace(config, methods=("bound",), budget=Budget(steps=5)))
    assert {row.method for row in done.rows} == {"grow", "bound"}
    assert "Grow: 4 answers come from an earlier run with another budget or weights" in done.notes
    run(replace(config, setup=replace(config.setup, seed=1), methods=("bound",), redo="all"))
    assert "| Grow" not in table(config), "but not those on other cases"


def test_methods_files_lie_beside_the_logs(config: RunConfig) -> None:
    blank = Record("toy", "grow", "toy-0-1", "toy-0", "f")
    logs = config.out / "toy" / "logs"
    scratches = {}
    for scratch in (None, config.out / "own"):
        local = replace(config, budget=replace(config.budget, scratch=scratch))
        plan = runner.edit_job(local, CaseStore(local.out, "toy"), paper_stubs.METHODS[0], "1", [blank], "", False)
        scratches[scratch] = jsonio.build(Budget, plan.values["budget"], "budget").scratch
        assert plan.log == logs / "grow.log"
    assert scratches == {None: logs, config.out / "own": config.out / "own"}


def test_errors_are_rows(config: RunConfig) -> None:
    done = run(replace(config, methods=("raising", "cheating", "dying", "absent", "grow")))
    reasons = {r.method: (r.error, r.missing) for r in records(done.folder) if r.method != "grow"}
    assert reasons == {
        "raising": ("RuntimeError: no such thing as two lines", ""),
        "cheating": ("cheating: changed the asset in place; its answer cannot be compared", ""),
        "dying": ("its process ended with exit code 3", ""),
        "absent": ("", "not installed: put it there"),
    }
    assert not done.complete
    rows = {line.split("|")[1].strip(): line for line in table(config).splitlines() if line.startswith("| ")}
    assert "| error: RuntimeError: no such thing as two lines | – |" in rows["Raising"]
    assert "| not installed | – |" in rows["Absent"] and "| 1.00" not in rows["Absent"]
    assert "| 2.00 " in rows["Grow"]  # the last block's
    assert "Raising: error in 4 of 4 cases: RuntimeError: no such thing as two lines" in done.notes
    assert records_of(config, "raising")["toy-0-1"].facts == {"edits": 1, "number": 0}
    assert "raise RuntimeError" in (done.folder / "logs" / "raising.log").read_text()


@posix_only
def test_a_killed_worker_costs_the_case_in_hand(config: RunConfig) -> None:
    ask_for(config, "kill")
    done = run(config)
    after_crash = records_of(config, "grow")
    assert after_crash["toy-0-1"].error == "its process ended by SIGKILL; out of memory?"
    assert [r.has_figures for r in after_crash.values()] == [False, True, True, True]
    assert "| Grow (1 of 2) |" in table(config) and not done.complete
    run(config)
    assert records_of(config, "grow") == after_crash, "errors stay ..."
    run(replace(config, redo="errors"))
    assert all(r.has_figures for r in records_of(config, "grow").values()), "... until asked for anew"
    assert counted("grow") == 6 + 1 + 0


def test_weights_that_change_during_a_run_mix_no_rows(config: RunConfig) -> None:
    ask_for(config, "swap")
    run(replace(config, setup=replace(config.setup, objects=1)))
    message = "grow: its weights or settings changed since the run began; start it again"
    assert [r.error for r in records_of(config, "grow").values()] == ["", message]
    run(replace(config, setup=replace(config.setup, objects=1)))
    assert [r.error for r in records_of(config, "grow").values()] == ["", ""] and counted("grow") == 1 + 3


@posix_only
def test_a_broken_object_is_a_note(config: RunConfig) -> None:
    ask_for(config, "broken-toy-1")
    ask_for(config, "kill-make-toy-0-2")
    done = run(replace(config, setup=replace(config.setup, objects=7)))
    assert "left out: toy-1: a broken mesh" in done.notes
    assert "left out: toy-0: its process ended by SIGKILL; out of memory?" in done.notes
    assert "7 objects were asked for, 5 are there" in done.notes and not done.complete
    assert sorted(records_of(config, "grow")) == ["toy-0-1"] + [f"toy-{k}-{e}" for k in (2, 3, 4) for e in (1, 2)]
    (config.out.parent / "trouble" / "broken-toy-1").unlink()
    done = run(replace(config, setup=replace(config.setup, objects=5)))
    assert len(records_of(config, "grow")) == 10 and not any("left out" in note for note in done.notes)


def test_shards_and_processes_fill_one_folder(config: RunConfig) -> None:
    config = replace(config, setup=replace(config.setup, objects=3))
    run(replace(config, shard=(1, 2)))
    assert sorted(records_of(config, "grow")) == ["toy-1-1", "toy-1-2"]
    done = run(replace(config, shard=(0, 2), processes=2, methods=("grow", "bound"), parallel_methods=True))
    assert "this run did part 0 of 2; the table has what all parts have done so far" in done.notes
    assert any("side by side" in note for note in done.notes)
    assert sums(config) == {f"toy-{k}-{edits}": float(edits) for k in (0, 1, 2) for edits in (1, 2)}
    assert len(records_of(config, "bound")) == 4
    assert "| Bound (2 of 3) |" in table(config) and "Bound: 2 of 6 cases have not been run" in done.notes


@posix_only
@pytest.mark.parametrize("number", [signal.SIGINT, 9])
def test_interrupting_and_resuming_gives_the_same_table(config: RunConfig, number: int) -> None:
    ask_for(config, "slow")
    program = (
        "import signal, sys; from pathlib import Path; import benchmarks.tests.support.stubs as paper_stubs\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's background jobs ignore it
        "from splatbench import runner\n"
        "from splatbench.cases import Budget, RunConfig, Setup\n"
        "paper_stubs.register(); runner.WORKER = (sys.executable, paper_stubs.__file__)\n"
        f"out = Path({str(config.out)!r}); setup = Setup(objects=2, truth='surfels')\n"
        "runner.run(RunConfig('toy', setup, ('grow',), Budget(), out), print)\n"
    )
    path = os.pathsep.join([str(STUBS.parents[3]), os.environ.get("PYTHONPATH", "")])
    variables = {**os.environ, "PYTHONPATH": path}
    parent = subprocess.Popen([sys.executable, "-c", program], env=variables, stdout=-3, stderr=-3)
    _wait_for(lambda: counted("grow") > 0)  # the method's process is in its long sleep
    (child,) = _children(parent.pid)
    parent.send_signal(number)
    assert parent.wait(20) != 0
    _wait_for(lambda: not _alive(child))
    assert records_of(config, "grow") == {}, "nothing half done"
    done = run(config)
    assert counted("make-*") == 4 and sums(config) == {"toy-0-1": 1, "toy-0-2": 2, "toy-1-1": 1, "toy-1-2": 2}
    assert [(row.block, row.figures["sum"].mean, row.cases) for row in done.rows] == [("1", 1, 2), ("2", 2, 2)]
    assert _pixels(config.out / "toy" / "records" / "grow" / "toy-1-2.png").shape == (4, 4, 3)


def test_fingerprints_and_shards() -> None:
    budget = Budget()
    first = fingerprint("d" * 16, "1", budget, False)
    variants = [
        fingerprint("e" * 16, "1", budget, False),
        fingerprint("d" * 16, "2", budget, False),
        fingerprint("d" * 16, "1", replace(budget, steps=1), False),
        fingerprint("d" * 16, "1", replace(budget, seed=1), False),
        fingerprint("d" * 16, "1", replace(budget, curve=True), False),
        fingerprint("d" * 16, "1", budget, True),
    ]
    assert first.startswith("d" * 16) and len({first, *variants}) == 7
    assert first == fingerprint("d" * 16, "1", replace(budget, scratch=Path("elsewhere")), False)
    keys = [CaseKey(f"{name}{k}", name, {}) for name in "abc" for k in (0, 1)]
    assert [key.label for key in runner.of_shard(keys, (0, 2))] == ["a0", "a1", "c0", "c1"]
    assert [key.label for key in runner.of_shard(keys, (1, 2))] == ["b0", "b1"]


def test_a_stamp_counts_files_and_not_where_they_are(tmp_path: Path) -> None:
    stamp = CaseStore(tmp_path / "out", "toy").stamp
    for folder, size in (("one", 3), ("two", 3), ("three", 4)):
        (tmp_path / folder / "a").mkdir(parents=True)
        (tmp_path / folder / "a" / "x.glb").write_bytes(bytes(size))
        (tmp_path / folder / "a" / "y.glb").write_bytes(bytes(size + 1))
    key = CaseKey("x-toy", "a/x", {})
    stamps = [stamp(key, Setup(data=tmp_path / folder)) for folder in ("one", "two", "three")]
    assert stamps[0] == stamps[1] != stamps[2]
    (tmp_path / "two" / "z.glb").write_bytes(b"more")
    cases._listing.cache_clear()
    assert stamp(key, Setup(data=tmp_path / "two")) == stamps[0], "another object's file"
    assert stamp(key, Setup(data=tmp_path / "two", size=64)) != stamps[0]
    assert stamp(key, Setup(textures=tmp_path / "two")) != stamp(key, Setup())


def test_equal_rows_are_counted_over_all_attributes() -> None:
    before = paper_stubs.asset(0)
    means, sh = before.means.copy(), before.sh.copy()
    means[2] += 1
    sh[2, 0, 1] += 1
    sh[5, 0, 2] = np.nextafter(sh[5, 0, 2], np.float32(2))
    after = replace(before, means=means, sh=sh).append(paper_stubs.asset(1))
    assert runner.share_equal(before, after) == 6 / 8
    assert runner.share_equal(before, before) == 1
    more = replace(before, sh=np.concatenate([before.sh, np.zeros((8, 3, 3), np.float32)], 1))
    assert runner.share_equal(before, more) == 0, "another number of coefficients is another row"
    with pytest.raises(ValueError, match="7 of the asset's 8"):
        runner.share_equal(before, before.take(np.arange(7)))


def test_setups_and_budgets_travel_as_json(tmp_path: Path) -> None:
    setup = Setup(data=tmp_path, fonts=tmp_path / "fonts", size=7)
    budget = Budget(steps=3, adapters=tmp_path / "a.toml", weights={"x": "y"})
    assert jsonio.build(Setup, json.loads(json.dumps(to_json(setup))), "setup") == setup
    assert jsonio.build(Budget, json.loads(json.dumps(to_json(budget))), "budget") == budget


def _figures(text: str) -> list[list[str]]:
    """Cells of a table in Markdown but those that are measured anew every time (memory)."""
    lines = [line.split("|") for line in text.splitlines() if line.startswith("|")]
    skipped = [k for k, head in enumerate(lines[0]) if "MiB" in head]
    return [[cell for k, cell in enumerate(line) if k not in skipped] for line in lines]


def _pixels(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image)


def _wait_for(what) -> None:
    start = time.monotonic()
    while not what():
        assert time.monotonic() - start < 60, "it never came"
        time.sleep(0.05)


def _children(process: int) -> list[int]:
    done = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process)], capture_output=True, text=True)
    return [int(line) for line in done.stdout.split()]


def _alive(process: int) -> bool:
    done = subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True)
    return done.stdout.strip() not in ("", "Z")
