"""Tokens of edited pictures by the LRM's own frozen tokenizer, the paper's way."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from torch.nn import functional as F

from splatpainter.models.config import PRESETS, ModelConfig
from splatpainter.models.image_tokens import Pictures, tokenize
from splatpainter.models.lrm import AssetViews, nearest_points, rays
from tests.models.test_model import build, encode
from tests.support.model_scenes import SIZE, TINY, cameras, pictures, shell, with_refine

CONFIG = with_refine(TINY, tokenizer="lrm", lift_features=False)


def by_hand(model: torch.nn.Module, views: Pictures, center: object, half: float) -> torch.Tensor:
    """[V, L, D]: pixels of patches and their rays, a linear map, a norm; written out."""
    origins, directions = rays(AssetViews(views.cameras, views.edited, center=center, half_extent=half))  # type: ignore[arg-type]
    x = torch.cat([2 * views.edited - 1, directions, nearest_points(origins, directions)], -1)
    patch, count = CONFIG.lrm.patch, SIZE // CONFIG.lrm.patch
    x = x.reshape(len(x), count, patch, count, patch, 9).permute(0, 1, 3, 2, 4, 5).reshape(len(x), count**2, -1)
    lrm = model.lrm
    return F.layer_norm(F.linear(x, lrm.patches.weight), (CONFIG.lrm.dim,), lrm.norm_in.weight)  # type: ignore


def test_tokens_are_the_lrms_before_its_blocks() -> None:
    model = build(CONFIG)
    latents, edit = encode(model, shell()), pictures()
    groups = latents.groups
    with torch.no_grad():
        expected = by_hand(model, edit, groups.center, groups.half_extent)
        every = tokenize(edit, groups, replace(CONFIG.refine, mask_tokens=False), model.lrm)
        some = tokenize(edit, groups, CONFIG.refine, model.lrm)
    torch.testing.assert_close(every.pixels, expected.flatten(0, 1), rtol=1e-5, atol=1e-5)
    assert edit.mask is not None
    edited = F.avg_pool2d(edit.mask.permute(0, 3, 1, 2), CONFIG.lrm.patch).flatten(1) > 0
    assert 0 < int(edited.sum()) < edited.numel()
    assert torch.equal(some.pixels, every.pixels[edited.flatten()]) and some.lengths.tolist() == edited.sum(1).tolist()


def test_an_edit_adapts_by_them_and_leaves_the_lrm_frozen() -> None:
    model = build(CONFIG)
    with torch.no_grad():
        latents = encode(model, shell())
        first = model.refine(model.initial_state(), latents, pictures()).values
        other = model.refine(model.initial_state(), latents, pictures(seed=9)).values
        none = model.refine(model.initial_state(), latents, pictures(), strength=0.0).values
    assert float((first - other).abs().max()) > 1e-3 and float((first - none).abs().max()) > 1e-3
    model.refine(model.initial_state(), latents, pictures()).values.square().sum().backward()
    assert all(p.grad is None for p in model.lrm.parameters())
    assert model.refiner.pictures.weight.shape == (TINY.compress.dim, TINY.lrm.dim)
    assert float(model.refiner.pictures.weight.grad.abs().max()) > 0  # type: ignore[union-attr]


def test_pictures_of_any_size_are_padded_and_known_geometry_is_read() -> None:
    model = build(replace(CONFIG, lrm=replace(CONFIG.lrm, geometry=True)))
    groups = encode(model, shell()).groups
    size = SIZE + 3
    edit, config = pictures(size=size), replace(CONFIG.refine, mask_tokens=False)
    with torch.no_grad():
        tokens = tokenize(edit, groups, config, model.lrm)
        moved = tokenize(replace(edit, depth=edit.depth + 0.1), groups, config, model.lrm)  # type: ignore[operator]
    per_edge = -(-size // CONFIG.lrm.patch)
    assert tokens.lengths.tolist() == [per_edge**2] * 2 and bool(torch.isfinite(tokens.pixels).all())
    assert float((tokens.pixels - moved.pixels).abs().max()) > 1e-3
    with pytest.raises(ValueError, match="needs depth and alpha"):
        tokenize(Pictures(cameras(2, size), edit.edited), groups, config, model.lrm)


def test_a_model_without_an_lrm_has_no_such_tokens_and_older_ones_are_linear() -> None:
    compact = PRESETS["compact"]
    for changes in ({"latents": False, "inputs": "normalised"}, {"patch": 4}):
        with pytest.raises(ValueError, match="with tokenizer='lrm'"):
            with_refine(compact, tokenizer="lrm", **changes)
    assert with_refine(PRESETS["paper"], tokenizer="lrm").refine.tokenizer == "lrm"
    text = json.loads(compact.to_json())
    del text["refine"]["tokenizer"]
    assert ModelConfig.from_json(json.dumps(text)) == compact and compact.refine.tokenizer == "linear"
