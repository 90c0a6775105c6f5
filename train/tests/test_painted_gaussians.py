"""Learning a local network on rows: what its samples are, that steps teach it, and the command."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from splatpainter.cli import main
from splatpainter.color import base_color
from splatpainter.models import checkpoint
from splatpainter.models.local_config import LocalConfig
from splatpainter.models.local_edit_colors import patches_of, readers_of
from splatpainter.models.local_network import LocalNetwork, Patches
from splatpainter.models.picture_patches import BANDS, PEAK_FEATURE, TOKEN_CHANNELS
from splatpainter.painter import Painter
from splatpainter.splats import Splats
from splattrain.data.object_sources import ProceduralSource
from splattrain.data.painted_gaussians import PaintedEdit, PaintedGaussianStream, true_colors
from splattrain.data.sample_recipes import SampleRecipe
from splattrain.stages.painted_gaussians_task import OtherPicture, PaintedGaussiansTask
from tests.models.test_local_network import CONFIG

SAMPLES = SampleRecipe(
    {"stroke": 1.0, "photo": 1.0}, size=48, rows=300, surfels=3000, sh_degree=0, base_views=1, novel_views=2,
    steps_per_object=2,
)  # fmt: skip


@cache
def stream(folder: Path | None = None) -> PaintedGaussianStream:
    return PaintedGaussianStream(ProceduralSource(3, 0), SAMPLES, 0, folder=folder, count=4, asset_kinds=("coarse",))


@cache
def example() -> PaintedEdit:
    return stream().full_edit(0)


def test_a_sample_is_the_same_in_any_order_and_from_disk(tmp_path: Path) -> None:
    first, cached = stream()[1], stream(tmp_path)
    assert cached.count == 4
    for again in (cached[1], cached[5], PaintedGaussianStream(ProceduralSource(3, 0), SAMPLES, 0, count=4,
                                                          folder=tmp_path, asset_kinds=("coarse",))[1]):  # fmt: skip
        assert (again.name, again.kind) == (first.name, first.kind)
        np.testing.assert_array_equal(again.truth, first.truth)
        for one, two in zip(again.regions, first.regions, strict=True):
            np.testing.assert_array_equal(one.index, two.index)
            np.testing.assert_array_equal(one.tokens.cells, two.tokens.cells)
            np.testing.assert_array_equal(one.tokens.values, two.tokens.values)
            np.testing.assert_array_equal(one.readers.cells, two.readers.cells)
            np.testing.assert_array_equal(one.readers.facts, two.readers.facts)
    (path,) = tmp_path.rglob("000001.npz")
    path.write_bytes(b"damaged")
    np.testing.assert_array_equal(stream(tmp_path)[1].truth, first.truth)  # made anew
    with pytest.raises(ValueError, match="expected kinds of stroke"):
        PaintedGaussianStream(ProceduralSource(3, 0), replace(SAMPLES, kinds={"relight": 1.0}))


def test_the_truth_of_a_gaussian_is_the_mean_of_the_surfels_under_it() -> None:
    points = np.array([[x, y, 0] for x in range(6) for y in range(6)], np.float32)
    colors = np.random.default_rng(0).uniform(0, 1, (36, 3)).astype(np.float32)
    count = len(points)
    truth = Splats(
        points, np.tile([1, 0, 0, 0], (count, 1)), np.full((count, 3), 0.5), np.ones(count),
        ((colors - 0.5) / 0.28209479)[:, None],
    )  # fmt: skip
    gaussian = Splats(
        *(np.array(x, np.float32) for x in ([[2.2, 3.1, 0]], [[1, 0, 0, 0]], [[0.6, 0.6, 0.01]], [1], [[[0, 0, 0]]]))  # pyright: ignore[reportArgumentType]
    )
    squared = ((points - gaussian.means) ** 2).sum(1)
    nearest = np.argsort(squared)[:16]
    weights = np.exp(-squared[nearest] / (2 * 0.6**2))
    expected = (weights[:, None] * colors[nearest]).sum(0) / weights.sum()
    np.testing.assert_allclose(true_colors(truth.torch("cpu"), gaussian)[0], expected, atol=1e-5)


def test_a_whole_edit_is_painted_where_its_truth_says() -> None:
    edit = example()
    before = np.clip(base_color(edit.painted.asset.sh[edit.lifted.parents]), 0, 1)
    lift = np.clip(base_color(edit.lifted.splats.sh[edit.lifted.ids]), 0, 1)
    changed = np.abs(edit.truth - before).max(1) > 0.1
    assert changed.sum() > 20
    # The lift, which is no part of the truth, goes the same way.
    along = ((lift - before) * (edit.truth - before))[changed].sum()
    assert along > 0.5 * np.square(edit.truth - before)[changed].sum()


def test_gaussians_count_by_what_the_picture_shows_of_them(float32: None) -> None:
    torch.manual_seed(0)
    network = LocalNetwork(CONFIG).eval()
    sample = stream()[0]
    total = weight = 0.0
    with torch.no_grad():
        for region in sample.regions:
            state = network.adapt(network.initial_state(), patches_of(region.tokens))
            colors = network.read(state, readers_of(region.readers)).colors.numpy()
            counts = 0.05 + (region.readers.facts[:, PEAK_FEATURE].astype(np.float64) + 1) / 2
            total += (counts * np.square(colors - sample.truth[region.index]).mean(1)).sum()
            weight += counts.sum()
        squared = PaintedGaussiansTask(network, readers=1 << 20).losses(sample, 0)["squared"]
    assert float(squared) == pytest.approx(total / weight, rel=1e-4)


def test_another_picture_has_its_colours_turned_and_negated() -> None:
    seen: list[Patches] = []
    network = SimpleNamespace(
        initial_state=None, read=None, adapt=lambda state, patches, strength: seen.append(patches)
    )
    values = torch.arange(3 * TOKEN_CHANNELS, dtype=torch.float32).view(3, -1) + 1
    OtherPicture(network).adapt(None, Patches(torch.arange(3), values))  # type: ignore[arg-type]
    (other,) = seen
    for patch in range(3):
        for band in range(BANDS):
            red, green, blue = values[2 - patch, 3 * band : 3 * band + 3]
            assert other.values[patch, 3 * band : 3 * band + 3].tolist() == [-blue, -green, -red]
    assert torch.equal(other.values[:, 3 * BANDS :], values[:, 3 * BANDS :])


def test_steps_lower_the_loss_and_validation_has_its_columns(float32: None) -> None:
    torch.manual_seed(0)
    task = PaintedGaussiansTask(LocalNetwork(CONFIG), readers=128)
    sample = stream()[0]
    optimizer = torch.optim.AdamW(task.parameters(), lr=2e-3)
    losses = []
    for _ in range(15):
        loss = task(sample, 0)["loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0] - 0.1
    task.eval()
    score = task.judge(example())
    figures = {"rows ours", "rows strength 0", "rows another picture", "rows lift", "edited ours", "edited held"}
    assert figures <= set(score.numbers) and 0 < score.numbers["between Gaussians"] <= 1
    assert score.numbers["adapts"] == pytest.approx(score.numbers["edited ours"] - score.numbers["edited strength 0"])
    assert [name for name, _ in score.strip][0] == "edited picture"


def test_the_command_trains_stops_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sizes = """--data procedural:4 --samples.size 48 --samples.rows 300 --samples.surfels 3000 --samples.novel-views 2
     --samples.steps-per-object 2 --edits 4 --readers 64 --steps 4 --warmup 1 --validation-samples 1 --validate-every 4
     --local.content-width 15 --local.refine.fast-hidden 72 --local.refine.hidden 16
     --local.refine.blocks 1 --device cpu --json""".split()
    words = ["train", "rows", "--recipe", "paint", *sizes, "--assets", str(tmp_path / "assets")]
    assert main([*words, "--out", str(tmp_path / "whole")]) == 0
    assert json.loads(capsys.readouterr().out)["step"] == 4
    for _ in range(2):
        assert main([*words, "--out", str(tmp_path / "parts"), "--session-steps", "2", "--resume"]) == 0
    one, two = (checkpoint.load(tmp_path / name / "model", kind=LocalConfig) for name in ("whole", "parts"))
    assert all(torch.equal(tensor, two.tensors[name]) for name, tensor in one.tensors.items())
    with open(tmp_path / "whole" / "validation.csv", encoding="utf-8") as file:
        columns = next(csv.reader(file))
    assert {"all adapts", "all edited another picture", "all between Gaussians", "all novel held"} <= set(columns)
    painter = Painter.load(str(tmp_path / "whole" / "model"))
    assert painter.model is None and painter.local is not None and painter.preset == "local"
    capsys.readouterr()
    other = [*words, "--out", str(tmp_path / "next"), "--from", str(tmp_path / "whole" / "model")]
    other[other.index("--local.content-width") + 1] = "23"
    assert main(other) == 2
    assert "weights of another model: content_width 15 there, 23 here" in capsys.readouterr().err
