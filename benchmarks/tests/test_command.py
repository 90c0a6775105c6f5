"""`splatpainter bench` with the paper's tables: words in, files and exit codes out."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest
from splatbench import command, runner
from splatbench import tables as protocols
from splatbench.command import TableOptions

from benchmarks.tests.support import stubs as paper_stubs
from splatpainter.cli import main


@pytest.fixture()
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The toy table in place of the paper's first; the folder for results."""
    (tmp_path / "trouble").mkdir()
    monkeypatch.setenv(paper_stubs.VARIABLE, str(tmp_path / "trouble"))
    monkeypatch.delenv("SPLATPAINTER_PERCEPTUAL", raising=False)
    monkeypatch.setattr(runner, "WORKER", (sys.executable, paper_stubs.__file__))
    monkeypatch.setattr(protocols, "NAMES", ("toy",))
    monkeypatch.setitem(command.TABLES, "toy", "for the tests")
    paper_stubs.register(monkeypatch)
    return tmp_path / "out"


def test_a_table_from_words_to_files(toy: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "toy", "--objects", "2", "--methods", "grow", "bound", "--out", str(toy), "--json"]
    assert main(words) == 1, "LPIPS is lacking"
    answer = json.loads(capfd.readouterr().out)
    assert [row["method"] for row in answer["rows"]] == ["grow", "bound"] * 2
    assert not answer["complete"] and any("LPIPS: n/a" in note for note in answer["notes"])
    assert answer["sheet"] == str(toy / "toy" / "sheet.png")
    there = {path.name for path in (toy / "toy").iterdir() if path.is_file()}
    assert there == {"results.csv", "summary.csv", "table.md", "table.tex", "sheet.png", "run.json", "setup.json"}
    assert main(["bench", "report", str(toy), "--out", str(toy.parent / "page")]) == 0
    assert "Grow" in (toy.parent / "page" / "index.html").read_text()


def test_exit_codes(toy: Path, tmp_path: Path, shared: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "toy", "--objects", "1", "--out", str(toy), "--perceptual-weights", str(shared / "perceptual")]
    assert main([*words, "--methods", "grow"]) == 0
    assert main([*words, "--methods", "absent"]) == 1, "asked for by name, and not there"
    assert "| Absent | not installed |" in capfd.readouterr().out
    assert main([*words, "--methods", "list"]) == 0
    assert "cheating                 Cheating (not by default)" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--data", "/nowhere"], "--data: /nowhere: no such folder"),
        (["--environments", "/nowhere"], "--environments: /nowhere: no such folder"),
        (["--adapters", "/nowhere.toml"], "--adapters: /nowhere.toml: no such file"),
        (["--perceptual-weights", "/"], "/: holds no lpips_alex.safetensors"),
        (["--weights", "genden"], "expected --weights NAME=FOLDER, got 'genden'"),
        (["--weights", "genden=/nowhere"], "--weights: genden: /nowhere: no such folder"),
        (["--weights", "a=/", "a=/"], "--weights: a was given twice"),
        (["--shard", "4/4"], "expected --shard K/N with K from 0 to N - 1, got '4/4'"),
        (["--size", "16"], "expected --size of at least 32, got 16"),
        (["--objects", "0"], "expected --objects of at least 1, got 0"),
        (["--quick", "--full"], "expected --quick or --full, got both"),
        (["--truth", "painted"], "painted"),
        (["--methods", "magic"], "expected --methods of grow, raising, cheating, dying, absent, bound, got 'magic'"),
    ],
)
def test_bad_words(words: list[str], message: str, toy: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "toy", "--out", str(toy), *words]) == 2
    output = capfd.readouterr()
    assert message in output.err and output.err.count("\n") == 1 and output.out == ""
    assert not toy.exists()


def test_report_wants_folders_of_benches(toy: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for folder, message in ((tmp_path / "gone", "no such folder"), (tmp_path, "holds no table that a bench wrote")):
        assert main(["bench", "report", str(folder), "--out", str(tmp_path / "page")]) == 2
        assert message in capfd.readouterr().err
    (tmp_path / "x" / "toy" / "records").mkdir(parents=True)
    folder = tmp_path / "x" / "toy"
    assert command.table_folders([tmp_path / "x"], "") == command.table_folders([folder], "") == [folder]


def test_presets_give_way_to_words() -> None:
    quick = command.preset(TableOptions(quick=True, size=64), ["--quick", "--size", "64", "--held-out"], "refine")
    assert (quick.objects, quick.size, quick.held_out, quick.truth) == (2, 64, True, "surfels")
    assert quick.out != TableOptions.out, "its cases are of another setup"
    assert command.preset(TableOptions(quick=True), ["--quick"], "ablate").objects == 1
    full = command.preset(TableOptions(full=True, novel_views=5), ["--full", "--novel-views=5"], "refine")
    assert (full.objects, full.size, full.base_views, full.lights, full.novel_views) == (370, 512, 9, 24, 5)
    assert command.preset(TableOptions(), [], "refine") == TableOptions()


def test_help_is_light() -> None:
    program = (
        "import sys\nfrom splatpainter.cli import main\n"
        "code = main(['bench']) or main(['bench', 'relight', '--help'])\n"
        "print([name for name in ('torch', 'mitsuba', 'PIL') if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "[]\n")
    assert "--perceptual-weights DIR" in done.stdout
    assert all(f"  {name:<8} {line}" in done.stdout for name, line in command.TABLES.items())


def test_weights_that_saw_the_held_out_objects_are_refused(tmp_path: Path) -> None:
    from splatbench.command import bench

    from splatpainter.models.config import COMPACT
    from splatpainter.models.model import SplatPainterModel

    data, weights = tmp_path / "meshes", tmp_path / "weights"
    data.mkdir()
    (data / "a.obj").write_text("v 0 0 0\n")
    names = tmp_path / "names.txt"
    names.write_text("a\n")
    small = dataclasses.replace(COMPACT.lrm, dim=16, heads=2, layers=1, hidden=16)
    config = dataclasses.replace(COMPACT, lrm=small)
    SplatPainterModel(config).save(weights, notes={"stage": "refine", "held_out": {"share": 0.02}})
    words = ["--data", str(data), "--out", str(tmp_path / "out"), "--weights", f"compact={weights}"]
    with pytest.raises(ValueError, match="held out a share of 0.02, here 0.1 is held out; --no-held-out measures"):
        bench("refine", words)
    with pytest.raises(ValueError, match="1 of the 1 names were trained on"):
        bench("refine", [*words, "--names", str(names)])
    with pytest.raises(ValueError, match="--names needs --data"):
        bench("refine", ["--names", str(names)])
    assert not (tmp_path / "out").exists()
