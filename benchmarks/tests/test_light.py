"""`bench light`: its figures against what is known by hand, and once from start to end."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatbench import light
from splatbench.cases import Setup
from splatbench.light import (
    ROWS,
    LightBench,
    LightCase,
    LightScore,
    albedo_psnr,
    lit_by,
    mean_scores,
    noiseless_psnr,
    object_names,
    psnr,
    specks,
)

from splatpainter.cameras import spherical_cameras
from splatpainter.color import sh_from_color
from splatpainter.lights.relight import transfer
from splatpainter.lights.source_light import SourceLight, uniform_coefficients
from splatpainter.rendering import render
from tests.support.cli_scenes import ball


def case() -> LightCase:
    """A grey ball under uniform light, and under twice as much."""
    splats = ball(900)
    grey = np.full((900, 3), 0.4)
    splats = replace(splats, sh=sh_from_color(grey)[:, None].astype(np.float32))
    cameras = tuple(spherical_cameras(np.zeros(3), 3.0, 2, size=64))
    drawn = render(splats, list(cameras))
    masks = np.asarray(drawn.alphas)[..., 0] > 0.9 if np.asarray(drawn.alphas).ndim == 4 else drawn.alphas > 0.9
    before = uniform_coefficients()
    truth = np.asarray(drawn.colors)[..., :3].clip(0, 1)
    return LightCase(
        "ball", "coarse", splats, before, 2 * before, cameras, truth, masks, (splats.means, splats.means), truth, truth
    )


def test_psnr_is_over_the_object() -> None:
    one = case()
    assert psnr(one.truth + 0.1 * one.masks[..., None], one) == pytest.approx(20, abs=1e-4)


def test_noise_of_the_truth_is_no_error() -> None:
    """An error of 0.05 under noise of 0.2 in both truths: 26 dB, where PSNR sees 13.7."""
    one, rng = case(), np.random.default_rng(0)
    views = one.truth + 0.05
    noisy = replace(one, **{name: one.truth + rng.normal(0, 0.2, one.truth.shape) for name in ("truth", "again")})
    assert noiseless_psnr(views, one) == pytest.approx(psnr(views, one), abs=1e-4)
    assert psnr(views, noisy) == pytest.approx(-10 * np.log10(0.05**2 + 0.2**2), abs=0.3)
    assert noiseless_psnr(views, noisy) == pytest.approx(-20 * np.log10(0.05), abs=1)


def test_noiseless_is_a_mean_of_views_as_psnr_is() -> None:
    """Two views, 20 and 40 dB off: 30 dB, where all their pixels as one have 23."""
    one = case()
    views = one.truth + np.array([0.1, 0.01])[:, None, None, None]
    assert noiseless_psnr(views, one) == pytest.approx(30, abs=1e-4)
    assert noiseless_psnr(views, one) == psnr(views, one)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_specks_are_counted_where_the_truth_is_smooth(value: float) -> None:
    one = case()
    views = one.truth.copy()
    assert specks(views, one) == 0
    views[0, 32, 32] = value
    assert specks(views, one) > 0
    assert specks(views, replace(one, truth=views)) == 0, "what the truth has is none"


def test_the_ratio_of_true_lights_is_their_ratio() -> None:
    one = case()
    lit = lit_by("true source", one)
    linear = (((np.array([0.4, 0.8]) + 0.055) / 1.055) ** 2.4)[0]
    display = 0.5 + 0.28209479 * lit.sh[:, 0]
    expected = 1.055 * (2 * linear) ** (1 / 2.4) - 0.055
    np.testing.assert_allclose(np.median(display, 0), expected, atol=0.01)


def test_albedo_counts_up_to_a_gain_and_without_the_light() -> None:
    """Under a light from one side a grey ball is grey once the light is taken out, and not before."""
    one = case()
    before = one.before.copy()
    before[2] = 1.2 * before[0]
    lit = transfer(one.asset, SourceLight(one.before, 0.0, ""), before, shadows=False).splats
    shaded = replace(one, asset=lit, before=before, albedo=0.5 * one.truth)
    nothing, given = albedo_psnr("nothing", shaded), albedo_psnr("true source", shaded)
    assert nothing is not None and given is not None and given > nothing + 6
    assert albedo_psnr("affine", shaded) is None


def test_an_affine_change_of_all_is_found_from_the_other_views() -> None:
    one = case()
    brighter = transfer(one.asset, SourceLight(one.before, 0.0, ""), 1.5 * one.before).splats
    truth = np.asarray(render(brighter, list(one.cameras)).colors)[..., :3].clip(0, 1)
    changed = replace(one, truth=truth)
    assert psnr(light._affine_by_rest(changed), changed) > psnr(one.truth, changed) + 10


@pytest.mark.parametrize("row", ROWS)
def test_every_row_gives_the_asset_back(row: str) -> None:
    one = case()
    lit = lit_by(row, one)
    assert len(lit) == len(one.asset) and np.isfinite(lit.sh).all()


def test_means_compare_with_the_same_objects() -> None:
    scores = [
        LightScore(name, "coarse", row, value, 2 * value, 0.2, value + 1 if row == "ours" else None, 1.0, 0.1)
        for name, values in (("a", (10.0, 14.0)), ("b", (20.0, 21.0)))
        for row, value in zip(("nothing", "ours"), values, strict=True)
    ]
    nothing, ours = mean_scores(scores)
    assert (nothing.albedo, ours.albedo, ours.lpips) == (None, 18.5, 0.2)
    assert (ours.psnr, ours.gain, ours.worst_gain, ours.objects) == (17.5, 2.5, 1.0, 2)
    assert (ours.noiseless, ours.noiseless_gain) == (35, 5)
    assert ours.noiseless_gain_error == pytest.approx(3)  # gains of 8 and 2
    assert mean_scores([score for score in scores if score.object == "a"])[1].noiseless_gain_error is None


def test_from_start_to_end(tmp_path: Path) -> None:
    config = LightBench(truth="surfels", objects=1, size=64, rows=1000, novel_views=2, out=tmp_path / "out")
    lines: list[str] = []
    means = light.run(config, lines.append)
    assert len(means) == 2 * len(ROWS) and len(lines) == 2
    by_row = {(line.asset, line.row): line for line in means}
    assert by_row["coarse", "true source"].gain > 0.5
    with open(tmp_path / "out" / "light.csv", newline="") as file:
        assert len(list(csv.reader(file))) >= 2 * len(ROWS)
    assert (tmp_path / "out" / "sheet.png").stat().st_size > 1000


def test_tuning_takes_no_mesh_that_is_held_out(tmp_path: Path) -> None:
    for k in range(60):
        (tmp_path / f"mesh{k}.obj").write_text("v 0 0 0")
    held, tuned = (
        set(object_names(LightBench(meshes=tmp_path, tuning=tuning), Setup(data=tmp_path, objects=60, held_out=held)))
        for tuning, held in ((False, True), (True, False))
    )
    assert held and tuned and not held & tuned and len(held | tuned) == 60


def test_options_that_make_no_sense(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--objects of at least 1"):
        light.run(LightBench(objects=0))
    with pytest.raises(ValueError, match="no such folder"):
        light.run(LightBench(meshes=tmp_path / "missing"))
