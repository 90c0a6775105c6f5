"""Checkpoints that an earlier version wrote open today, and the model computes what it computed then.

`checkpoints_v1/` holds two tiny models, written by the code of commit 7d7b8ea, with every parameter set to some value
other than its first one:

    native/      TTT, detail layer, predictor, every channel of an image token
    copy/        cross-attention, absolute decoder; its config has no "predict", as before there were predictors
    NAME.npz     what that commit computed with NAME/ from the inputs below: float32, see `outputs`

The inputs are exact arithmetic of integers, so that they are the same in every version of numpy.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from splatpainter.cameras import orbit
from splatpainter.models.gaussian_groups import TokenLinks
from splatpainter.models.image_tokens import Pictures
from splatpainter.models.lrm import AssetViews
from splatpainter.models.model import SplatPainterModel
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.voxels.grid import voxelize

FOLDER = Path(__file__).with_name("checkpoints_v1")
GAUSSIANS = 20
SIZE_PX = 8
MAX_ERROR = 1e-5
"""Of every value, relative where it is above 1."""


def numbers(*shape: int, salt: int) -> np.ndarray:
    """float32 in 0..1 without visible order: 24 bits of a multiplicative hash of their index."""
    index = np.arange(1, np.prod(shape) + 1, dtype=np.uint64) + np.uint64(1000 * salt)
    mixed = index * np.uint64(2654435761) % np.uint64(1 << 32)
    mixed = (mixed ^ (mixed >> np.uint64(15))) * np.uint64(2246822519) % np.uint64(1 << 32)
    return ((mixed >> np.uint64(8)) / np.float64(1 << 24)).astype(np.float32).reshape(shape)


def asset() -> Splats:
    return Splats(
        means=2 * numbers(GAUSSIANS, 3, salt=1) - 1,
        quats=numbers(GAUSSIANS, 4, salt=2) - np.float32(0.3),
        scales=np.float32(0.01) + np.float32(0.2) * numbers(GAUSSIANS, 3, salt=3),
        opacities=numbers(GAUSSIANS, salt=4),
        sh=2 * numbers(GAUSSIANS, 4, 3, salt=5) - 1,
    )


def image(channels: int, salt: int) -> torch.Tensor:
    """[2, H, W, channels] for two cameras."""
    return torch.from_numpy(numbers(2, SIZE_PX, SIZE_PX, channels, salt=salt))


def outputs(model: SplatPainterModel) -> dict[str, np.ndarray]:
    """Name -> values of every part of the model, from the tokens of the LRM to decoded Gaussians."""
    cameras = orbit((0, 0, 0), 3.0, 2, width=SIZE_PX, height=SIZE_PX)
    views = AssetViews(cameras, image(3, 10), 2 + 2 * image(1, 11), image(1, 12), half_extent=1.2)
    pictures = Pictures(
        cameras, image(3, 20), image(3, 21), 2 + 2 * image(1, 22), image(1, 23), (image(1, 24) < 0.4).float()
    )
    gaussians, lift = asset(), None
    weights = numbers(GAUSSIANS, 3, salt=7)
    links = TokenLinks((8 * numbers(GAUSSIANS, 3, salt=6)).astype(np.int64), weights / weights.sum(1, keepdims=True))
    tokens = model.encode_views(views)
    named: dict[str, torch.Tensor] = {"tokens": tokens}
    if model.config.representation == "copy":
        copy = model.copied_gaussians(views)
        tokens, gaussians, links = copy.tokens, copy.gaussians, copy.links
        named |= {f"copy_{name}": getattr(gaussians, name)[:GAUSSIANS] for name in ATTRIBUTES}
    if model.config.refine.lift_features:
        lift = torch.from_numpy(numbers(GAUSSIANS, 13, salt=8))
    grid = voxelize(gaussians, model.config.compress.resolution)
    latents = model.compressor(tokens, gaussians.torch(), links, model.groups(grid))
    refined = model.refine(model.initial_state(), latents, pictures, lift=lift, detail=True)
    decoded = model.decode(latents, refined, gaussians.torch())
    assert refined.detail_latents is not None and decoded.children is not None
    named |= {"latents": latents.values, "refined": refined.values, "detail": refined.detail_latents}
    named |= {f"decoded_{name}": getattr(decoded.splats, name) for name in ATTRIBUTES}
    named |= {f"children_{name}": getattr(decoded.children, name) for name in ATTRIBUTES}
    if model.predictor is not None:
        facts, change = (torch.from_numpy(2 * numbers(GAUSSIANS, n, salt=30 + n) - 1) for n in (21, 3))
        named["predicted"] = model.predictor(facts, change, torch.from_numpy(9 * numbers(GAUSSIANS, salt=40)))
    return {name: values.detach().numpy() for name, values in named.items()}


@pytest.mark.parametrize("name", ["native", "copy"])
@torch.no_grad()
def test_an_old_checkpoint_opens_and_computes_what_it_did(name: str, float32: None) -> None:
    with np.load(FOLDER / f"{name}.npz") as file:
        expected = {key: file[key] for key in file.files}
    computed = outputs(SplatPainterModel.load(FOLDER / name, f"tiny {name}"))
    assert computed.keys() == expected.keys()
    for key, values in expected.items():
        assert computed[key].dtype == values.dtype == np.float32 and np.ptp(values) > 0
        np.testing.assert_allclose(computed[key], values, rtol=MAX_ERROR, atol=MAX_ERROR, err_msg=key)
