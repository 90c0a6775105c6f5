"""The route to the paper's sizes, as docs/TRAINING.md writes it: every command, with small models and small pictures.
What stands in its way is an error, not a run that trained nothing."""

from __future__ import annotations

import csv
import shlex
from pathlib import Path

import pytest
import torch

from splatpainter.cli import main
from splatpainter.models import checkpoint
from splattrain import recipes
from splattrain.data.object_sources import HELD_OUT_SHARE
from splattrain.data.shards import read_index
from tests.support.data_meshes import write_box

ROOT = Path(__file__).resolve().parents[3]
ROUTE = [
    shlex.split(line)[1:]
    for line in (ROOT / "docs/TRAINING.md")
    .read_text("utf-8")
    .split("## The paper's sizes\n")[1]
    .split("\n## ")[0]
    .splitlines()
    if line.startswith("    splatpainter ")
]
TINY_SIZES = """--model.lrm.dim 16 --model.lrm.layers 1 --model.lrm.heads 2 --model.lrm.hidden 16
 --model.compress.dim 16 --model.compress.heads 2 --model.compress.hidden 16
 --model.compress.encoder-layers 1 --model.compress.decoder-layers 1
 --model.compress.resolution 8 --model.compress.min-opacity 0 --model.refine.blocks 1 --model.refine.hidden 16
 --model.refine.heads 2 --model.refine.fast-hidden 16 --perceptual 0 --steps 1 --batch 1 --workers 0
 --validation-samples 1 --validate-every 1 --device cpu""".split()
TOKENIZER = ["--model.refine.tokenizer", "lrm"]
SHARDS = "--rows 80 --surfels 400 --samples 6 --novel-views 2".split()


def held_out(names: list[str]) -> set[str]:
    from splattrain.data.object_sources import split

    return set(split(names)[1])


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two objects to train on and one that is held out."""
    folder = tmp_path_factory.mktemp("route") / "objaverse"
    folder.mkdir()
    names = [f"box{k}" for k in range(40)]
    apart = held_out(names)
    chosen = [*[n for n in names if n not in apart][:2], next(n for n in names if n in apart)]
    for k, name in enumerate(chosen):
        write_box(folder / f"{name}.glb", (240, 60 + 60 * k, 40), (1, 0.6 + 0.1 * k, 0.8))
    return folder


def toy(words: list[str], size: int) -> list[str]:
    """A command of the route at toy size: its own options are kept, and others come after."""
    if words[0] == "data":
        if "--size" in words:
            at = words.index("--size")
            return [*words[: at + 1], str(size), *words[at + 2 :], *SHARDS]
        return [*words, *SHARDS, "--size", str(size), "--kinds", "plain", "stroke"]
    views = ["--samples.size", str(size), "--model.lrm.image-size", str(size)]
    return [*words, *TINY_SIZES, *views]


def test_every_command_of_the_route_runs(
    meshes: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("SPLATPAINTER_PERCEPTUAL", raising=False)
    monkeypatch.chdir(meshes.parent)
    assert [words[:2] for words in ROUTE] == [
        ["data", "render"],
        ["data", "render"],
        ["train", "lrm"],
        ["train", "lrm"],
        ["train", "compress"],
        ["train", "refine"],
    ]
    sizes = [16, 32, 16, 32, 32, 32]
    for words, size in zip(ROUTE, sizes, strict=True):
        assert main(toy(words, size)) == 0, (words, capsys.readouterr().err)
        output = capsys.readouterr()
        if words[0] == "data":
            continue
        out = Path(words[words.index("--out") + 1])
        rows = list(csv.DictReader((out / "log.csv").read_text("utf-8").splitlines()))
        assert len(rows) == 1 and not rows[0]["skipped"] and float(rows[0]["loss"]) > 0
        assert "0 samples failed" in output.out and "the warm-up of" in output.err
    # Tokens of pictures by the LRM's own tokenizer, as the paper has them: on the same Stage I.
    words = toy([*("runs/own" if word == "runs/refine" else word for word in ROUTE[-1]), *TOKENIZER], 32)
    assert main(words) == 0, capsys.readouterr().err
    made = [checkpoint.load(f"runs/{name}/model") for name in ("refine", "own")]
    assert [one.config.refine.tokenizer for one in made] == ["linear", "lrm"]
    assert [one.tensors["refiner.pictures.weight"].shape[1] for one in made] == [8 * 8 * 9, 16]
    assert torch.equal(*(one.tensors["lrm.patches.weight"] for one in made))
    spec = read_index(Path("shards"))["spec"]["recipe"]
    assert (spec["base_views"], spec["novel_views"], spec["sh_degree"]) == (16, 2, 2)
    notes = checkpoint.notes("runs/refine/model")
    assert [record["stage"] for record in notes["history"]] == ["lrm", "lrm", "compress"]
    assert notes["recipe"]["validation_share"] == HELD_OUT_SHARE


def test_shards_that_the_model_cannot_read_are_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shards = tmp_path / "shards"
    words = ["--kinds", "plain", "--size", "16", "--rows", "80", "--surfels", "400", "--samples", "1"]
    assert main(["data", "render", "procedural:1", "--out", str(shards), "--recipe", "lrm", *words]) == 0
    capsys.readouterr()
    train = ["train", "lrm", "--recipe", "paper", "--data", str(shards), "--out", str(tmp_path / "run"), *TINY_SIZES]
    assert main([*train, "--model.lrm.image-size", "16"]) == 2
    line = (
        "expected samples of 9 base views or more of 16 px, which the model reads, got 8 of 16 px; render shards with"
    )
    assert f"{line} data render --base-views 9 --size 16" in capsys.readouterr().err
    assert main([*train, "--model.lrm.views", "8", "--model.lrm.image-size", "32"]) == 2
    assert "8 base views or more of 32 px, which the model reads, got 8 of 16 px" in capsys.readouterr().err
    few = ["train", "lrm", "--recipe", "paper", "--data", "procedural:2", "--samples.base-views", "4"]
    assert main([*few, "--out", str(tmp_path / "run")]) == 2
    assert "give --samples.base-views 9 --samples.size 256" in capsys.readouterr().err
    # Shards without a sample of the kinds that the stage reads.
    refine = ["train", "refine", "--data", str(shards), "--out", str(tmp_path / "run"), "--device", "cpu"]
    assert main([*refine, "--validate-every", "0"]) == 2
    assert "holds no samples of the objects and kinds asked for" in capsys.readouterr().err
    assert not (tmp_path / "run" / "model").exists()


def test_a_recipe_of_training_says_what_is_rendered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from splattrain.commands.data import RenderConfig, job_of

    path = tmp_path / "recipe.json"
    path.write_text(recipes.load("paper512", "lrm").to_json())
    job, _ = job_of(RenderConfig("procedural:1", tmp_path, recipe=str(path), base_views=11))
    samples = job.recipe
    assert (samples.size, samples.rows, samples.base_views, samples.sh_degree) == (512, 60_000, 11, 2)
    assert {kind for kind, weight in samples.kinds.items() if weight > 0} == {"plain"}
    plain, _ = job_of(RenderConfig("procedural:1", tmp_path))
    assert (plain.recipe.size, plain.recipe.rows, plain.recipe.surfels, plain.recipe.steps_per_object) == (
        *(128, 8000, 60_000),
        8,
    )
    assert main(["data", "render", "procedural:1", "--out", str(tmp_path / "s"), "--recipe", "papers"]) == 2
    assert "expected one of local, global, unified, lrm, paper, or a JSON file of train" in capsys.readouterr().err
