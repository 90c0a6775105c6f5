"""SRGS: the prior keeps its promise, patches are windows of the large view, and the loss is the published one."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from splatbench.cases import Budget, EditStep, PosedImages
from splatbench.methods import EditTask, srgs
from splatbench.methods.gs3d import mixed
from splatbench.methods.gs3d import orbit as orbit_views
from splatbench.methods.srgs_patches import TrainingPatch, loss_by_torch, patches, srgs_loss
from splatbench.methods.super_resolution import lanczos, pooled, program

from splatpainter.cameras import Camera, look_at, orbit
from splatpainter.fit.optimize import TrainingView
from splatpainter.metrics import ssim
from splatpainter.rendering import render
from splatpainter.splats import Splats
from tests.support.lift_scenes import SH_C0, db, front, sheet

BY_NAME = {method.name: method for method in srgs.METHODS}
RNG = np.random.default_rng


def means_of_blocks(picture: np.ndarray, factor: int) -> np.ndarray:
    """Written out."""
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    out = np.zeros((height, width, 3))
    for y in range(height):
        for x in range(width):
            out[y, x] = (
                picture[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor].astype(np.float64).mean((0, 1))
            )
    return out


@pytest.mark.parametrize("factor", [2, 4])
@pytest.mark.parametrize("kind", ["noise", "black and white", "smooth"])
def test_enlarged_pictures_pool_to_the_given_ones_and_stay_in_range(kind: str, factor: int) -> None:
    rng = RNG(0)
    y, x = np.mgrid[:14, :18] / 18
    picture = {
        "noise": rng.uniform(0, 1, (14, 18, 3)),
        "black and white": rng.integers(0, 2, (14, 18, 3)),
        "smooth": np.stack([0.5 + 0.4 * np.sin(5 * x), 0.5 + 0.4 * np.cos(4 * y), x * y], -1),
    }[kind].astype(np.float32)
    large = lanczos(picture, factor)
    assert large.shape == (14 * factor, 18 * factor, 3) and large.dtype == np.float32
    assert large.min() >= 0 and large.max() <= 1
    np.testing.assert_allclose(means_of_blocks(large, factor), picture, atol=2e-6)
    np.testing.assert_allclose(pooled(large, factor), means_of_blocks(large, factor), atol=1e-6)


def test_the_prior_is_where_back_projection_ends() -> None:
    picture = RNG(1).uniform(0.35, 0.65, (12, 10, 3)).astype(np.float32)  # nothing is clipped

    def enlarged(values: np.ndarray) -> np.ndarray:
        planes = [Image.fromarray(np.ascontiguousarray(values[..., c]), "F") for c in range(3)]
        return np.stack([np.asarray(p.resize((40, 48), Image.Resampling.LANCZOS)) for p in planes], -1)

    out = enlarged(picture)
    for _ in range(80):
        out = out + enlarged((picture - means_of_blocks(out, 4)).astype(np.float32))
    np.testing.assert_allclose(lanczos(picture, 4), out, atol=2e-5)


def test_a_plain_picture_stays_plain_and_a_smooth_one_is_better_than_blocks() -> None:
    plain = np.full((16, 16, 3), 0.3, np.float32)
    np.testing.assert_allclose(lanczos(plain, 4), 0.3, atol=1e-5)
    y, x = np.mgrid[:64, :64] / 64
    truth = np.stack([0.5 + 0.4 * np.sin(9 * x + 4 * y)] * 3, -1).astype(np.float32)
    low = pooled(truth, 4)
    assert db(lanczos(low, 4), truth) > db(low.repeat(4, 0).repeat(4, 1), truth) + 10


def base_of(asset: Splats, size: int = 24) -> PosedImages:
    cameras = [look_at(eye, (0, 0, 0), width=size, height=size, fov=42) for eye in [(0, 0, 3), (1, 0.5, 2.8)]]
    return PosedImages(tuple(cameras), np.clip(render(asset, cameras).colors, 0, 1))


def test_patches_are_windows_of_the_large_view() -> None:
    asset = sheet(30, half=0.4)
    base = base_of(asset, 64)
    cut = patches(base, asset, lambda low: lanczos(low, 4), 4, 64, 5, RNG(2))
    assert len(cut) == 10
    for k, patch in enumerate(cut):
        camera = base.cameras[k // 5]
        large = Camera(256, 256, camera.fx * 4, camera.fy * 4, camera.cx * 4, camera.cy * 4, camera.world_to_camera)
        x, y = round(large.cx - patch.camera.cx), round(large.cy - patch.camera.cy)
        assert x % 4 == y % 4 == 0 and 0 <= x <= 192 and 0 <= y <= 192
        assert patch.color.shape == (64, 64, 3) and patch.low.shape == (16, 16, 3) and patch.weight == 0.25
        full, window = render(asset, large), render(asset, patch.camera)
        np.testing.assert_allclose(window.colors[0], full.colors[0, y : y + 64, x : x + 64], atol=1e-5)
        assert window.alphas.max() > 0.05  # the asset fills a sixth of the picture: it is looked for
        np.testing.assert_array_equal(patch.low, base.colors[k // 5, y // 4 : y // 4 + 16, x // 4 : x // 4 + 16])
        np.testing.assert_allclose(means_of_blocks(patch.color, 4), patch.low, atol=2e-6)
    again = patches(base, asset, lambda low: lanczos(low, 4), 4, 64, 5, RNG(2))
    assert all(np.array_equal(a.color, b.color) for a, b in zip(cut, again, strict=True))


def test_a_patch_is_no_larger_than_its_view() -> None:
    asset = sheet(10)
    (patch,) = patches(base_of(asset, 12).take([0]), asset, lambda low: low.repeat(2, 0).repeat(2, 1), 2, 6, 1, RNG(0))
    assert patch.color.shape == (24, 24, 3) and patch.low.shape == (12, 12, 3) and patch.weight == 1


def published(image: np.ndarray, color: np.ndarray, low: np.ndarray, w: float) -> float:
    """0.8 L1 + 0.2 (1 - SSIM) of both resolutions, by the metrics."""

    def part(a: np.ndarray, b: np.ndarray) -> float:
        return 0.8 * float(np.abs(a - b).mean()) + 0.2 * (1 - ssim(a, b))

    return w * part(image, color) + (1 - w) * part(means_of_blocks(image, 2), low)


@pytest.mark.parametrize("w", [0.4, 0.6])
def test_the_loss_is_the_published_one(w: float) -> None:
    rng = RNG(3)
    image, color, low = (
        rng.uniform(0, 1, shape).astype(np.float32) for shape in [(32, 28, 3), (32, 28, 3), (16, 14, 3)]
    )
    patch = TrainingPatch(front(32).cropped(0, 0, 28, 32), color, low=low)
    given = torch.from_numpy(image)
    assert float(srgs_loss(w, 2, given, patch)) == pytest.approx(published(image, color, low, w), abs=2e-5)
    assert float(loss_by_torch(w, 2, given, patch)) == pytest.approx(published(image, color, low, w), abs=2e-5)
    unsaid = replace(patch, low=np.full_like(low, np.nan))
    texture = 0.8 * float(np.abs(image - color).mean()) + 0.2 * (1 - ssim(image, color))
    assert float(srgs_loss(1.0, 2, given, unsaid)) == pytest.approx(texture, abs=2e-5)
    assert float(srgs_loss(w, 2, given, TrainingView(patch.camera, color))) == pytest.approx(texture, abs=2e-5)


def test_pixels_without_weight_have_no_influence_in_either_resolution() -> None:
    rng = RNG(4)
    low_mask = np.ones((16, 16), np.float32)
    low_mask[:, 9:] = 0
    color, low = (rng.uniform(0, 1, (size, size, 3)).astype(np.float32) for size in (32, 16))
    patch = TrainingPatch(front(32), color, 1.0, low_mask.repeat(2, 0).repeat(2, 1), low, low_mask)
    image = torch.from_numpy(rng.uniform(0, 1, (32, 32, 3)).astype(np.float32)).requires_grad_()
    for view, w in [(patch, 0.4), (patch, 1.0), (replace(patch, mask=None, low_mask=None), 0.4)]:
        ours, theirs = (loss(w, 2, image, view) for loss in (srgs_loss, loss_by_torch))
        assert ours.item() == pytest.approx(theirs.item(), abs=1e-5)
        pulls = [torch.autograd.grad(3 * loss, image)[0].numpy() for loss in (ours, theirs)]
        np.testing.assert_allclose(pulls[0], pulls[1], atol=2e-6)
    (pull,) = torch.autograd.grad(srgs_loss(0.4, 2, image, patch), image)
    assert (pull[:, 18:] == 0).all() and (pull[:, :18] != 0).any(2).all()


def test_patches_of_weighted_pictures_carry_the_weights_and_are_left_out_without_any() -> None:
    asset = sheet(30)
    base = base_of(asset, 64)
    weights = np.zeros((2, 64, 64))
    weights[1] = np.linspace(0, 1, 64)
    cut = patches(base, asset, lambda low: low.repeat(4, 0).repeat(4, 1), 4, 64, 5, RNG(2), weights)
    assert len(cut) == 5
    for patch in cut:
        assert patch.mask is not None and patch.low_mask is not None
        x = round(base.cameras[1].cx - patch.camera.cx / 4)
        np.testing.assert_allclose(patch.low_mask[3], np.linspace(0, 1, 64)[x : x + 16], atol=1e-6)
        np.testing.assert_array_equal(patch.mask[::4, 3::4], patch.low_mask)


def test_a_step_down_the_loss_moves_the_colour_of_a_pixel_to_its_sub_pixels_mean() -> None:
    low = np.full((11, 11, 3), 0.25, np.float32)
    patch = TrainingPatch(front(22), np.full((22, 22, 3), 0.75, np.float32), low=low)  # a prior that drifts in colour
    value = torch.full((22, 22, 3), 0.5, requires_grad=True)
    pulls = {}
    for w in (0.0, 1.0):
        (pulls[w],) = torch.autograd.grad(srgs_loss(w, 2, value, patch), value)
    assert (pulls[0.0] > 0).all() and (pulls[1.0] < 0).all()


@pytest.mark.parametrize("up", [(0, 1, 0), (0, -1, 0)])
def test_further_views_lie_evenly_around_the_asset_with_the_optics_of_the_base(up: tuple[float, float, float]) -> None:
    asset = sheet(20)
    asset = replace(asset, means=asset.means + np.array([3, 1, -2], np.float32))
    ring = orbit((3, 1, -2), 4.0, 9, up=up, width=40, height=40, fov=35, background=(1, 1, 1))
    base = PosedImages(tuple(ring), np.zeros((9, 40, 40, 3), np.float32))
    cameras = orbit_views(asset, base, 48)
    offsets = np.array([c.position for c in cameras]) - (3, 1, -2)
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 4, rtol=0.02)
    assert np.abs(offsets.mean(0)).max() < 0.15
    closeness = (offsets @ offsets.T / 16 - 2 * np.eye(48)).max(1)
    assert np.degrees(np.arccos(closeness.max())) > 18  # 48 even points are about 29 degrees apart
    for c in cameras:
        assert (c.width, c.height, c.background) == (40, 40, (1, 1, 1))
        assert c.fx == pytest.approx(ring[0].fx) and c.fy == pytest.approx(ring[0].fy)
        assert c.forward @ ((3, 1, -2) - c.position) == pytest.approx(4, rel=0.02)
        assert -c.world_to_camera[1, :3] @ np.array(up) >= -1e-6


def test_edited_views_get_their_share_of_the_steps() -> None:
    views = [TrainingView(front(12), np.zeros((12, 12, 3), np.float32)) for _ in range(62)]
    for share in (0.1, 0.25, 0.5):
        list_ = mixed(views[:2], views[2:], share)
        assert sum(v is views[0] for v in list_) / len(list_) == pytest.approx(share / 2, abs=0.01)
    assert len(mixed(views[:30], views[30:], 0.01)) == 62


def case() -> tuple[EditTask, Splats]:
    """A sheet of coarse Gaussians, and a close-up of a finer one."""
    truth, asset = sheet(44), sheet(14)
    x, y = truth.means[:, 0], truth.means[:, 1]
    sh = truth.sh.copy()
    sh[:, 0] += (0.25 * np.sign(np.sin(14 * x) * np.sin(14 * y)) / SH_C0)[:, None].astype(np.float32)
    truth = replace(truth, sh=sh)
    zoom = look_at((0.1, 0, 3), (0.1, 0, 0), width=32, height=32, fov=16)
    edited = PosedImages((zoom,), np.clip(render(truth, zoom).colors, 0, 1))
    step = EditStep("local", "zoom", edited, np.ones((1, 32, 32), bool))
    return EditTask("refine", asset, base_of(truth), step), truth


@pytest.mark.parametrize("name", ["srgs", "srgs-released"])
def test_srgs_brings_the_close_up_into_the_asset(name: str) -> None:
    work, _ = case()
    method = BY_NAME[name]
    assert method.missing(Budget()) == "" and "Lanczos prior" in method.label and method.protocols == ("refine",)
    done = method.edit(work, Budget(steps=120, curve=True), asset_views=2)  # type: ignore[call-arg]
    view, target = work.step.edited.cameras[0], work.step.edited.colors[0]
    before, after = (db(render(s, view).colors[0], target) for s in (work.asset, done.splats))
    assert after > before + 2
    assert not done.keeps_gaussians and done.setup_seconds > 0 and done.edit_seconds > 0
    assert len(done.splats) > len(work.asset) and 4 <= done.numbers["patches"] <= 8
    assert ("0.4 L_tex + 0.6 L_sub" in done.note) == (name == "srgs")
    assert [steps for _, steps, _ in done.curve] == [10, 30, 100]


def test_a_global_edit_is_refused() -> None:
    work, _ = case()
    work = replace(work, step=replace(work.step, mode="global", kind="relight"))
    with pytest.raises(ValueError, match=r"srgs: is for local edits, got a global one \(relight\)"):
        BY_NAME["srgs"].edit(work, Budget(steps=1))


UPSCALER = """
import sys
from PIL import Image
scale = int(sys.argv[sys.argv.index("--scale") + 1])
picture = Image.open(sys.argv[-2])
print("upscaling", picture.size)
if "--fail" in sys.argv:
    sys.exit("out of memory, as it were")
picture.resize((picture.width * scale, picture.height * scale), Image.Resampling.NEAREST).save(sys.argv[-1])
"""


def adapters(folder: Path, *words: str, device: str = "cpu") -> Path:
    script = folder / "upscale.py"
    script.write_text(UPSCALER)
    command = ", ".join(f"'{word}'" for word in (sys.executable, str(script), *words))
    file = folder / "adapters.toml"
    file.write_text(f"[super-resolution]\ncommand = [{command}]\ndevice = '{device}'\n")
    return file


def test_a_program_of_the_user_makes_the_large_pictures(tmp_path: Path) -> None:
    file = adapters(tmp_path, "--scale", "3")
    prior = program(file, 3, tmp_path / "work")
    picture = RNG(5).integers(0, 256, (8, 6, 3)).astype(np.float32) / 255
    np.testing.assert_allclose(prior(picture), picture.repeat(3, 0).repeat(3, 1), atol=1e-6)
    assert [path.name for path in (tmp_path / "work").iterdir()] == ["log.txt"]
    work, _ = case()
    work = replace(work, base=work.base.take([0]))
    method, budget = BY_NAME["srgs-program"], Budget(steps=4, adapters=file, scratch=tmp_path)
    assert method.missing(budget) == "" and method.version(budget) != method.version(Budget())
    done = method.edit(work, budget, factor=3, asset_views=0)  # type: ignore[call-arg]
    assert "adapters file's program" in done.note
    assert not list(tmp_path.glob("super-resolution-*"))


def test_a_program_that_is_missing_or_fails_is_said_in_one_line(tmp_path: Path) -> None:
    method = BY_NAME["srgs-program-released"]
    assert method.missing(Budget()).startswith("not installed: add [super-resolution]")
    empty = tmp_path / "empty.toml"
    empty.write_text("[super-resolution]\n")
    assert "has no `command`" in method.missing(Budget(adapters=empty))
    empty.write_text("[super-resolution]\ncommand = 3\n")
    assert "expected a list as 'command', got 3" in method.missing(Budget(adapters=empty))
    with pytest.raises(ValueError, match="expected a list as 'command', got 3"):
        program(empty, 4, tmp_path)
    picture = np.zeros((4, 4, 3), np.float32)
    with pytest.raises(ValueError, match=r"ended with status 1; out of memory, as it were \(log: .*log.txt\)"):
        program(adapters(tmp_path, "--scale", "4", "--fail"), 4, tmp_path)(picture)
    with pytest.raises(ValueError, match="expected a picture of 16x16 pixels, got 8x8"):
        program(adapters(tmp_path, "--scale", "2"), 4, tmp_path)(picture)
    quiet = tmp_path / "quiet.toml"
    quiet.write_text("[super-resolution]\ncommand = ['true']\ndevice = 'cpu'\n")
    with pytest.raises(ValueError, match="ended without an error but wrote no"):
        program(quiet, 4, tmp_path)(picture)
