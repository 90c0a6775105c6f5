"""The Gaussian LRM against torch's transformer, the cameras' own rays, and hand-made heads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from splatpainter.cameras import Camera, look_at
from splatpainter.models.config import PRESETS, LrmConfig
from splatpainter.models.lrm import AssetViews, GaussianLrm, nearest_points, patchify, rays
from tests.support.model_scenes import shallow

TINY = LrmConfig(patch=4, dim=32, layers=2, heads=4, hidden=64, sh_degree=1, views=2, image_size=16)
SEEING = replace(TINY, geometry=True)
MIDDLE, HALF = (3.0, -1.0, 2.0), 2.5
EYES = ([9.0, 1.0, 4.0], [2.0, 3.0, -5.0], [-3.0, -2.0, 7.0])


def camera(eye: list[float], width: int = 16, height: int = 12) -> Camera:
    made = look_at(eye, MIDDLE, width=width, height=height, fov=40)
    return replace(made, cx=made.cx + 1.3, fy=made.fy * 1.1)  # nothing symmetric about it


def views(count: int = 2, seed: int = 0, **settings) -> AssetViews:
    cameras = [camera(eye, **settings) for eye in EYES[:count]]
    shape = (count, cameras[0].height, cameras[0].width)
    generator = torch.Generator().manual_seed(seed)
    alpha = torch.rand(*shape, 1, generator=generator)
    return AssetViews(
        cameras=cameras,
        colors=torch.rand(*shape, 3, generator=generator),
        depth=torch.where(alpha > 0.3, 5 + 2 * torch.rand(*shape, 1, generator=generator), 0),
        alpha=torch.where(alpha > 0.3, alpha, 0),
        center=MIDDLE,
        half_extent=HALF,
    )


def lrm(config: LrmConfig = TINY, spread: float | None = 0.15) -> GaussianLrm:
    """Weights large enough that every term shows; spread None: as at the start of training."""
    torch.manual_seed(0)
    made = GaussianLrm(config).eval()
    if spread is not None:
        for parameter in made.parameters():
            nn.init.normal_(parameter, std=spread)
    return made


def pixel_by_pixel(values: Tensor, count: int, height: int, width: int, patch: int) -> Tensor:
    """[V * H * W, ...] in the order that the module states -> [V, H, W, ...], one at a time."""
    out = torch.empty(count, height, width, *values.shape[1:])
    wide, high = width // patch, height // patch
    for i, value in enumerate(values):
        token, pixel = divmod(i, patch**2)
        view, patch_index = divmod(token, wide * high)
        row, column = divmod(patch_index, wide)
        out[view, row * patch + pixel // patch, column * patch + pixel % patch] = value
    return out


def test_rays_are_the_cameras_own_in_the_assets_cube() -> None:
    inputs = views(3)
    origins, directions = rays(inputs)
    for view, origin, direction in zip(inputs.cameras, origins, directions, strict=True):
        position, expected = view.rays()
        np.testing.assert_allclose(origin.numpy() * HALF + MIDDLE, position, atol=1e-5)
        np.testing.assert_allclose(direction.numpy(), expected, atol=1e-6)


def test_the_nearest_point_is_on_the_ray_and_square_to_it() -> None:
    origins, directions = rays(views())
    points = nearest_points(origins, directions)
    torch.testing.assert_close((points * directions).sum(-1), torch.zeros(2, 12, 16), atol=1e-5, rtol=0)
    off = torch.linalg.cross(points - origins[:, None, None], directions)
    torch.testing.assert_close(off, torch.zeros_like(off), atol=1e-5, rtol=0)


def test_patches_are_in_the_stated_order() -> None:
    images = torch.arange(2 * 8 * 12 * 3.0).view(2, 8, 12, 3)
    cut = patchify(images, 4)
    assert cut.shape == (2 * 2 * 3, 4 * 4 * 3)
    # Second view, lower row of patches, middle column; second line of the patch, fourth pixel, third channel.
    assert cut[6 + 3 + 1, (1 * 4 + 3) * 3 + 2] == images[1, 4 + 1, 4 + 3, 2]
    assert torch.equal(pixel_by_pixel(cut.reshape(-1, 3), 2, 8, 12, 4), images)


@pytest.mark.parametrize("config", [TINY, SEEING])
def test_the_transformer_is_torchs(config: LrmConfig) -> None:
    """Patches by unfolding, channels written out, torch's encoder with the same weights: the same tokens."""
    inputs, made = views(), lrm(config)
    encoder = nn.TransformerEncoder(
        nn.TransformerEncoderLayer(
            TINY.dim, TINY.heads, TINY.hidden, 0, functional.gelu, norm_first=True, batch_first=True, bias=False
        ),
        TINY.layers,
        enable_nested_tensor=False,
    )
    names = {
        "attention.qkv.weight": "self_attn.in_proj_weight",
        "attention.out.weight": "self_attn.out_proj.weight",
        "mlp.inner.weight": "linear1.weight",
        "mlp.outer.weight": "linear2.weight",
        "norm_attention.weight": "norm1.weight",
        "norm_mlp.weight": "norm2.weight",
    }
    encoder.load_state_dict(
        {
            f"layers.{i}.{name}": block.state_dict()[ours]
            for i, block in enumerate(made.blocks)
            for ours, name in names.items()
        }
    )
    images = []
    assert inputs.depth is not None and inputs.alpha is not None
    pictures = zip(inputs.cameras, inputs.colors.numpy(), inputs.depth.numpy(), inputs.alpha.numpy(), strict=True)
    for view, color, depth, alpha in pictures:
        position, direction = view.rays()
        origin = (position - np.array(MIDDLE)) / HALF
        closest = origin - (direction @ origin)[..., None] * direction
        channels = [2 * color - 1, direction, closest]
        if config.geometry:
            surface = origin + direction * depth / (direction @ view.forward)[..., None] / HALF
            along = ((surface - closest) * direction).sum(-1, keepdims=True)
            channels += [np.where(depth > 0, along.clip(-1.8, 1.8), 0), 2 * alpha - 1]
        images.append(np.concatenate(channels, -1))
    planes = torch.from_numpy(np.stack(images).astype(np.float32)).permute(0, 3, 1, 2)
    # unfold has channels slowest: [V, C * p * p, L] -> [V, L, p * p, C]
    cut = functional.unfold(planes, 4, stride=4).unflatten(1, (-1, 16)).permute(0, 3, 2, 1).flatten(2)
    x = functional.layer_norm(cut @ made.patches.weight.T, (TINY.dim,), made.norm_in.weight)
    expected = encoder(x.flatten(0, 1)[None])[0]
    torch.testing.assert_close(made.encode(inputs), expected, atol=1e-4, rtol=1e-4)


def test_a_head_of_zeros_gives_the_start_of_training() -> None:
    """Centres at the rays' points nearest the cube's centre, in the stated order; scales, opacities by their biases."""
    inputs, made = views(), lrm()
    nn.init.zeros_(made.head.weight)
    splats = made(inputs).splats
    means = pixel_by_pixel(splats.means.detach(), 2, 12, 16, 4).numpy()
    for view, points in zip(inputs.cameras, means, strict=True):
        position, directions = view.rays()
        along = (np.array(MIDDLE) - position) @ directions.reshape(-1, 3).T
        np.testing.assert_allclose(points, position + along.reshape(12, 16, 1) * directions, atol=2e-5)
    torch.testing.assert_close(splats.scales, torch.full((384, 3), 0.100258844 * HALF))  # exp(-2.3)
    torch.testing.assert_close(splats.opacities, torch.full((384,), 0.119202922))  # 1 / (1 + e^2)
    assert splats.sh.shape == (384, 4, 3) and not splats.sh.any()


def test_with_geometry_a_head_of_zeros_paints_each_pixel_with_its_own_gaussian() -> None:
    inputs, made = views(), lrm(SEEING)
    nn.init.zeros_(made.head.weight)
    splats = made(inputs).splats
    assert inputs.alpha is not None
    order = pixel_by_pixel(torch.arange(384.0)[:, None], 2, 12, 16, 4)[..., 0].long()
    visible = inputs.alpha[..., 0] > 0.1
    colors = 0.5 + 0.28209479177387814 * splats.sh[order, 0]
    torch.testing.assert_close(colors, inputs.colors, atol=1e-6, rtol=0)
    assert not splats.sh[:, 1:].any()
    assert splats.opacities[order][visible].min() > 0.7 and splats.opacities[order][~visible].max() < 0.005
    for k, view in enumerate(inputs.cameras):
        away = np.linalg.norm(splats.means.detach()[order[k]].numpy() - view.position, axis=-1)
        pixels = splats.scales.detach()[order[k]].numpy()[..., 0] * min(view.fx, view.fy) / away
        np.testing.assert_allclose(pixels[visible[k].numpy()], 0.7, rtol=1e-4)


def test_with_geometry_a_head_of_zeros_gives_the_rendered_surface() -> None:
    inputs, made = views(), lrm(SEEING)
    nn.init.zeros_(made.head.weight)
    means = pixel_by_pixel(made(inputs).splats.means.detach(), 2, 12, 16, 4).numpy()
    assert inputs.depth is not None
    for view, points, depth in zip(inputs.cameras, means, inputs.depth.numpy(), strict=True):
        # Back into the picture: the pixel's centre, at its depth.
        local = points @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
        u, v = np.meshgrid(np.arange(16) + 0.5, np.arange(12) + 0.5)
        np.testing.assert_allclose(view.fx * local[..., 0] / local[..., 2] + view.cx, u, atol=1e-3)
        np.testing.assert_allclose(view.fy * local[..., 1] / local[..., 2] + view.cy, v, atol=1e-3)
        seen = depth[..., 0] > 0
        assert 0.2 < seen.mean() < 0.95
        near = np.linalg.norm(points - MIDDLE, axis=-1) < 1.79 * HALF  # the others were pulled to the cube
        np.testing.assert_allclose(local[..., 2][seen & near], depth[..., 0][seen & near], atol=1e-4)
        assert (seen & near).mean() > 0.1
        # Unknown depth: the nearest point to the middle, where the ray is square to the way there.
        turn = points - view.position
        across = (turn * (points - MIDDLE)).sum(-1) / np.linalg.norm(turn, axis=-1)
        np.testing.assert_allclose(across[~seen], 0, atol=1e-4)


def test_the_heads_numbers_are_read_in_their_order() -> None:
    """A head that says the same for every pixel: three depth logits, SH, log-scales, quaternion, opacity."""
    raw = torch.cat([torch.tensor([0.3, -0.1, 1.0]), torch.arange(12) / 10, torch.tensor([-1.0, 0.5, 3.0])])
    raw = torch.cat([raw, torch.tensor([0.9, 0.1, -0.2, 0.3, 1.5])])
    inputs, made = views(1), lrm()
    # LayerNorm of a token that is 1 in one place is not constant; so let the token be the same everywhere.
    token = torch.zeros(1, TINY.dim)
    token[0, 0] = 1
    normed = functional.layer_norm(token, (TINY.dim,), made.norm_out.weight)
    with torch.no_grad():
        made.head.weight.copy_((raw.repeat(16)[:, None] @ normed) / (normed @ normed.T))
    splats = made.decode(token.expand(12, -1), inputs)
    position, directions = inputs.cameras[0].rays()
    offset = np.array(MIDDLE) - position
    # s = sigmoid((0.3 - 0.1 + 1) / 3) = 0.598688; distance = nearest + (2 s - 1) * 1.8 half cubes
    along = directions.reshape(-1, 3) @ offset + (2 * 0.59868766 - 1) * 1.8 * HALF
    expected = position + along.reshape(12, 16, 1) * directions
    np.testing.assert_allclose(pixel_by_pixel(splats.means.detach(), 1, 12, 16, 4)[0].numpy(), expected, atol=1e-4)
    torch.testing.assert_close(splats.sh[5], (torch.arange(12) / 10).view(4, 3), atol=1e-5, rtol=1e-4)
    # exp(-1 - 2.3), exp(0.5 - 2.3), and the cap exp(-1.2) in place of exp(0.7)
    scales = HALF * torch.tensor([0.03688317, 0.16529889, 0.30119421])
    torch.testing.assert_close(splats.scales[7], scales, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(splats.quats[7], torch.tensor([0.9, 0.1, -0.2, 0.3]), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(splats.opacities[7].item(), 0.37754067, atol=1e-5, rtol=1e-4)  # sigmoid(1.5 - 2)


def test_centres_stay_in_their_reach_and_in_training_in_the_cube() -> None:
    inputs, made = views(), lrm(spread=2.0)
    with torch.no_grad():
        made.head.weight.mul_(20)  # saturates the depth
        free = made(inputs).splats.means
        held = made.train()(inputs).splats.means
    middle = torch.tensor(MIDDLE)
    assert ((free - middle).abs() > 1.01 * HALF).any()
    torch.testing.assert_close(held, middle + (free - middle).clamp(-HALF, HALF))
    origins, directions = rays(inputs)
    centre = nearest_points(origins, directions) * HALF + middle
    away = (pixel_by_pixel(free, 2, 12, 16, 4) - centre).norm(dim=-1)
    assert away.max() <= 1.8001 * HALF and away.max() > 1.7 * HALF


@pytest.mark.parametrize("config", [TINY, SEEING])
def test_permuting_views_permutes_tokens_and_gaussians(config: LrmConfig) -> None:
    inputs, made = views(3), lrm(config)
    order = [2, 0, 1]
    assert inputs.depth is not None and inputs.alpha is not None
    turned = replace(
        inputs,
        cameras=[inputs.cameras[i] for i in order],
        colors=inputs.colors[order],
        depth=inputs.depth[order],
        alpha=inputs.alpha[order],
    )
    a, b = made(inputs), made(turned)
    torch.testing.assert_close(b.tokens, a.tokens.unflatten(0, (3, 12))[order].flatten(0, 1), atol=1e-4, rtol=1e-4)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        expected = getattr(a.splats, name).unflatten(0, (3, 192))[order].flatten(0, 1)
        torch.testing.assert_close(getattr(b.splats, name), expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("config", [TINY, SEEING])
def test_world_units_do_not_matter(config: LrmConfig) -> None:
    """The asset moved and enlarged, its cameras with it: the same tokens, the Gaussians moved and enlarged."""
    inputs, made, shift = views(), lrm(config), np.array([40.0, -7.0, 11.0])
    moved = []
    for view in inputs.cameras:
        matrix = view.world_to_camera.copy()
        matrix[:3, 3] = -matrix[:3, :3] @ (4 * view.position + shift)
        moved.append(replace(view, world_to_camera=matrix))
    assert inputs.depth is not None
    there = replace(
        inputs, cameras=moved, depth=4 * inputs.depth, center=4 * np.array(MIDDLE) + shift, half_extent=4 * HALF
    )
    a, b = made(inputs), made(there)
    torch.testing.assert_close(b.tokens, a.tokens, atol=1e-3, rtol=1e-3)
    expected = 4 * a.splats.means + torch.from_numpy(shift).float()
    torch.testing.assert_close(b.splats.means, expected, atol=0.02, rtol=0)
    torch.testing.assert_close(b.splats.scales, 4 * a.splats.scales, atol=0.01, rtol=1e-3)


def test_unknown_depth_is_never_read() -> None:
    inputs, made = views(), lrm(SEEING)
    assert inputs.depth is not None and inputs.alpha is not None
    ill = replace(inputs, depth=torch.where(inputs.alpha > 0, inputs.depth, torch.nan))
    assert torch.equal(made.encode(inputs), made.encode(ill))
    faint = replace(inputs, alpha=torch.full_like(inputs.alpha, 0.05), depth=inputs.depth.clamp_min(5))
    assert torch.equal(made.encode(faint), made.encode(replace(faint, depth=torch.zeros_like(inputs.depth))))
    behind = replace(inputs, depth=torch.full_like(inputs.depth, 1e6), alpha=torch.ones_like(inputs.alpha))
    means = made(behind).splats.means
    assert means.isfinite().all() and (means - torch.tensor(MIDDLE)).norm(dim=1).max() < 4 * HALF


def test_recomputing_activations_changes_no_gradient() -> None:
    inputs = views()
    grads = []
    for again in (False, True):
        made = lrm(replace(TINY, checkpoint_activations=again)).train()
        out = made(inputs)
        (out.tokens.square().mean() + out.splats.means.mean() + out.splats.sh.square().mean()).backward()
        grads.append([parameter.grad for parameter in made.parameters()])
    for a, b in zip(*grads, strict=True):
        assert a is not None and b is not None and torch.equal(a, b) and a.isfinite().all()


def test_two_runs_agree_bit_for_bit() -> None:
    outputs = [lrm(SEEING)(views()) for _ in range(2)]
    assert torch.equal(outputs[0].tokens, outputs[1].tokens)
    assert outputs[0].splats.sha256 == outputs[1].splats.sha256


def test_bf16_autocast_follows_float32() -> None:
    inputs, made = views(), lrm(spread=None)
    exact = made(inputs)
    with torch.autocast("cpu", torch.bfloat16):
        half = made(inputs)
    assert half.splats.means.dtype == torch.float32
    assert (half.tokens - exact.tokens).norm() < 0.02 * exact.tokens.norm()
    assert (half.splats.means - exact.splats.means).abs().max() < 0.05 * HALF


def test_the_first_weights_have_their_spread_and_no_biases() -> None:
    made = GaussianLrm(replace(TINY, dim=128, hidden=512))
    assert not [name for name, _ in made.named_parameters() if name.endswith("bias")]
    for module in made.modules():
        if isinstance(module, nn.Linear):
            assert abs(module.weight.std().item() / 0.02 - 1) < 0.03  # 16,384 draws or more: known to 0.6 %


def test_the_papers_lrm_has_its_parameters() -> None:
    with torch.device("meta"):
        made = GaussianLrm(PRESETS["paper"].lrm)
    d, area = 1024, 64
    expected = 9 * area * d + 24 * (4 * d * d + 8 * d * d + 2 * d) + 2 * d + d * area * 59
    assert sum(parameter.numel() for parameter in made.parameters()) == expected
    assert 2.9e8 < expected < 3.2e8


def test_a_shallow_paper_lrm_runs_forward_and_backward() -> None:
    made = GaussianLrm(shallow(PRESETS["paper"]).lrm)
    out = made(views(width=32, height=32))
    assert out.tokens.shape == (2 * 16, 1024) and out.splats.sh.shape == (2 * 1024, 16, 3)
    splats = out.splats
    (splats.means.mean() + splats.sh.square().mean() + splats.scales.mean() + splats.opacities.mean()).backward()
    for name, parameter in made.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all() and parameter.grad.any(), name


def bad_views() -> dict[str, tuple[dict, str]]:
    one = camera(EYES[0])
    return {
        "sizes": ({"cameras": [one, camera(EYES[1], width=20)]}, "views of one size, got 16x12, 20x12"),
        "many": ({"cameras": [one] * 17}, "1 to 16 views, got 17"),
        "none": ({"cameras": []}, "1 to 16 views, got 0"),
        "colors": ({"colors": torch.rand(2, 3, 12, 16)}, r"colors \[2, 12, 16, 3\], got \[2, 3, 12, 16\]"),
        "depth": ({"depth": torch.rand(2, 12, 16)}, r"depth \[2, 12, 16, 1\], got \[2, 12, 16\]"),
        "cube": ({"half_extent": 0.0}, "half > 0, got 0.0"),
    }


@pytest.mark.parametrize("case", list(bad_views()))
def test_impossible_views_are_refused_in_one_line(case: str) -> None:
    changes, message = bad_views()[case]
    with pytest.raises(ValueError, match=f"^encode: expected .*{message}[^\n]*$"):
        replace(views(), **changes)


def test_views_that_do_not_fit_the_model_are_refused() -> None:
    with pytest.raises(ValueError, match="multiple of 4 pixels, got 18x12"):
        lrm()(views(width=18))
    with pytest.raises(ValueError, match="needs depth and alpha"):
        lrm(SEEING)(replace(views(), depth=None))
