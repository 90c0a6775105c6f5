"""Which arithmetic networks use, who decides that, and what is never rounded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpainter.lift.features import SEEN_FEATURE
from splatpainter.models.image_tokens import tokenize
from splatpainter.models.lrm import patchify
from splatpainter.nn import precision as rule
from splatpainter.nn.precision import VARIABLE, autocast, exact, resolve, setting
from splatpainter.painter import EditSettings, Painter
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES
from splattrain.build import make_task
from tests.support.lift_scenes import same_bits
from tests.support.model_scenes import TINY, asset_views, cameras, grid_of, links, pictures, shell, with_refine
from tests.support.painter_scenes import LIFT, RED, built, dab, thing
from tests.support.train_scenes import RECIPE, model


@pytest.fixture(autouse=True)
def nobody_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)


@pytest.mark.parametrize("native", [False, True])
def test_auto_is_bf16_where_the_cpu_multiplies_it(monkeypatch: pytest.MonkeyPatch, native: bool) -> None:
    for instruction in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"):
        monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
        monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: False)
        monkeypatch.setattr(torch.cpu, instruction, lambda: native)
        assert resolve() == ("bfloat16" if native else "float32")
        assert resolve("float32") == "float32" and resolve("bfloat16") == "bfloat16"


def test_the_caller_comes_before_the_environment_and_that_before_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rule, "_multiplies_bf16", lambda device: True)
    for requested, expected in (
        ("", "bfloat16"),
        ("auto", "bfloat16"),
        ("float32", "float32"),
        ("bfloat16", "bfloat16"),
    ):
        monkeypatch.setenv(VARIABLE, requested)
        assert resolve() == expected and setting() == (requested or "auto")
        assert resolve("float32") == "float32" and resolve("bfloat16") == "bfloat16"


def test_another_word_is_one_line_that_says_where(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"^precision: expected auto, float32 or bfloat16, got 'fp8'$"):
        Painter.load("lift", precision="fp8")  # type: ignore[arg-type]
    monkeypatch.setenv(VARIABLE, "half")
    line = rf"^{VARIABLE}: expected auto, float32 or bfloat16, got 'half'$"
    for call in (resolve, Painter.load, Painter):
        with pytest.raises(ValueError, match=line):
            call()
    with pytest.raises(ValueError, match=line):  # not a bad sample, once per sample
        make_task(RECIPE, model(), None, lambda line: None)
    assert Painter.load("lift", precision="float32").settings.precision == "float32"


def test_the_context_rounds_products_or_does_not() -> None:
    x = torch.full((4, 4), 1 + 2**-12)
    with autocast("cpu", "bfloat16"):
        assert (x @ x).dtype == torch.bfloat16
        with exact("cpu"):
            assert torch.equal(x @ x, torch.full((4, 4), 4 * (1 + 2**-12) ** 2))
        with autocast("cpu", "float32"):
            assert (x @ x).dtype == torch.float32
    with autocast("cpu", "float32"):
        assert (x @ x).dtype == torch.float32


@torch.no_grad()
def test_what_the_lrm_says_of_positions_and_opacities_is_never_rounded() -> None:
    views = asset_views(TINY)
    net = built(TINY).lrm
    torch.nn.init.normal_(net.head.weight, std=0.3)
    with autocast("cpu", "bfloat16"):
        tokens = net.encode(views)
        rounded = net.decode(tokens, views)
    assert tokens.dtype == torch.float32 and not torch.equal(tokens, net.encode(views))
    plain = net.decode(tokens, views)
    assert all(torch.equal(getattr(rounded, name), getattr(plain, name)) for name in ATTRIBUTES)


@torch.no_grad()
def test_what_enters_the_lrm_is_never_rounded() -> None:
    views, net = asset_views(TINY), built(TINY).lrm
    net.blocks = torch.nn.ModuleList()
    with autocast("cpu", "bfloat16"):
        tokens = net.encode(views)
    expected = net.norm_in(patchify(net._channels(views), TINY.lrm.patch) @ net.patches.weight.mT)
    torch.testing.assert_close(tokens, expected, rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_tokens_of_any_type_enter_stage_one_at_one_door() -> None:
    net, splats = built(TINY), shell()
    tokens = net.encode_views(asset_views(TINY))
    rest = (splats.torch(), links(len(splats), len(tokens)), net.groups(grid_of(splats, TINY)))
    for kind in (torch.bfloat16, torch.float16):
        stored = tokens.to(kind)
        for context in (exact("cpu"), autocast("cpu", "bfloat16")):
            with context:
                one, two = net.compressor(stored, *rest).values, net.compressor(stored.float(), *rest).values
            assert one.dtype == torch.float32 and torch.equal(one, two)


@torch.no_grad()
def test_stage_one_tells_gaussians_apart_that_bf16_would_not() -> None:
    """Two Gaussians of one voxel, 2^-10 of a voxel apart: bf16 has 8 bits."""
    net, splats = built(TINY), shell(2)
    grid = grid_of(replace(splats, means=splats.means * 0 + np.array([[1, 1, 1], [4, 4, 4]], np.float32)), TINY)
    groups = net.groups(grid)
    means = torch.from_numpy(groups.gaussian_centers().astype(np.float32)) + 0.3 * groups.voxel
    first = replace(splats.torch(), means=means)
    second = replace(first, means=means + 2**-10 * groups.voxel)
    tie = links(2, 4)
    with autocast("cpu", "bfloat16"):
        table = torch.zeros(4, TINY.compress.dim)
        one, two = (net.compressor._embed(table, rows, tie, groups) for rows in (first, second))
    moved = net.compressor.attribute.weight[:, :3].sum(1) * 2**-10
    torch.testing.assert_close(two - one, moved.expand(2, -1), rtol=0.02, atol=2e-6)


@torch.no_grad()
def test_what_enters_stage_two_is_never_rounded() -> None:
    net = built(with_refine(TINY, base="lift", detail=False)).refiner
    generator = torch.Generator().manual_seed(3)
    latents, lift, drift = (torch.rand(40, count, generator=generator) for count in (TINY.compress.dim, 13, 7))
    assert lift.shape[1] > SEEN_FEATURE
    plain = net.prepare(latents, lift, drift)
    with autocast("cpu", "bfloat16"):
        rounded = net.prepare(latents, lift, drift)
    assert torch.equal(rounded, plain)


@torch.no_grad()
def test_what_blocks_add_to_stays_float32() -> None:
    net, splats = built(TINY), shell()
    groups = net.groups(grid_of(splats, TINY))
    tokens = tokenize(pictures(), groups, TINY.refine)
    seen: list[torch.dtype] = []
    for name in ("refiner.blocks.0.norm_pictures", "refiner.blocks.1.norm_pictures", "lrm.blocks.0.norm_mlp"):
        net.get_submodule(name).register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].dtype))
    with autocast("cpu", "bfloat16"):
        net.lrm.encode(asset_views(TINY))
        net.refiner.adapt(net.initial_state(), tokens)
    assert seen == [torch.float32] * 3


def test_pictures_and_where_gaussians_lie_in_them_are_never_rounded() -> None:
    splats, camera = shell().torch(), cameras(1)[0]
    plain = render(splats, camera, backend="reference")
    with autocast("cpu", "bfloat16"):
        rounded = render(splats, camera, backend="reference")
    assert torch.equal(rounded.colors, plain.colors) and torch.equal(rounded.depths, plain.depths)


def test_painters_of_both_keep_their_encodings_apart_and_the_receipt_says_which(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATPAINTER_CACHE", str(tmp_path))
    splats, net, results = thing(), built(LIFT, awake=0.05), {}
    for word in ("float32", "bfloat16"):
        monkeypatch.setenv(VARIABLE, "bfloat16" if word == "float32" else "float32")  # the caller comes first
        painter = Painter(model=net, settings=EditSettings(cache=True, precision=word))
        results[word] = painter.apply(painter.encode(splats), [dab(splats, RED)])
        assert results[word].receipt.precision == word
        assert f'"precision": "{word}"' in results[word].receipt.to_json()
    assert len(list(tmp_path.glob("*.safetensors"))) == 2
    assert not same_bits(results["float32"].splats, results["bfloat16"].splats)
    lifted = painter.apply(painter.encode(splats, "lift"), [dab(splats, RED)], method="lift").receipt
    assert lifted is not None and lifted.precision == "" and "precision" not in lifted.to_json()
