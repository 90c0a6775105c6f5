"""The loop: against a plain torch oracle, on what must not change, and on a toy that must improve.

Not run here, measured: the demo asset from 20,000 points unprojected from 24 views of 256 px, 1,000 steps with density
control (54,542 Gaussians): 36.3 dB on those views, 33.6 on 8 others, over black and white in turn; over its own
background alone 37.5 and 34.1, but with holes and haze of that colour (mean error of alpha 0.044, not 0.004). With the
original's rate of SH all along 33.6 and 32.4. About 75 ms of one core a step.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatpainter.cameras import look_at
from splatpainter.fit.densify import DensityOptions, Schedule
from splatpainter.fit.optimize import FitOptions, Fitted, TrainingView, optimize
from splatpainter.fit.start import from_depths
from splatpainter.metrics import psnr
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, Splats
from tests.support.lift_scenes import SH_C0, bits, differing, front, same_bits, sheet
from tests.support.render_scenes import cameras, scene, with_odd_gaussians

NO_DENSITY = FitOptions(steps=4, densify=False)


def views_of(splats: Splats, views) -> list[TrainingView]:
    return [TrainingView(camera, np.clip(render(splats, camera).colors[0], 0, 1)) for camera in views]


def small(count: int = 30, degree: int = 1) -> Splats:
    """Ellipsoids of a few pixels, in view."""
    splats, rng = scene(count, degree, 3, dtype=np.float32), np.random.default_rng(3)
    scales = rng.uniform(0.04, 0.2, (count, 3)).astype(np.float32)
    return replace(splats, scales=scales, opacities=np.clip(splats.opacities, 0.1, 0.9))


def oracle(start: Splats, views: list[TrainingView], options: FitOptions, extent: float) -> list[torch.Tensor]:
    """3DGS's step written out: reference renderer, L1 and SSIM by unfolded windows, torch.optim.Adam, float64."""
    splats = start.torch(dtype=torch.float64)
    raw = [
        splats.means,
        splats.quats,
        splats.scales.log(),
        torch.logit(splats.opacities),
        splats.sh[:, :1],
        splats.sh[:, 1:],
    ]
    raw = [value.clone().requires_grad_() for value in raw]
    rates = [1.6e-4 * extent, 1e-3, 5e-3, 5e-2, 2.5e-3, 2.5e-3 / 20]
    adam = torch.optim.Adam([{"params": [p], "lr": r} for p, r in zip(raw, rates, strict=True)], eps=1e-15)
    taps = torch.exp(-0.5 * (torch.arange(-5.0, 6.0, dtype=torch.float64) / 1.5) ** 2)
    window = torch.outer(taps, taps).reshape(-1) / taps.sum() ** 2

    def mean(picture: torch.Tensor) -> torch.Tensor:
        patches = torch.nn.functional.unfold(picture.permute(2, 0, 1)[:, None], 11)  # [3, 121, L]
        return torch.einsum("ckl,k->cl", patches, window)

    for step in range(options.steps):
        adam.param_groups[0]["lr"] = rates[0] * math.exp(step / (options.steps - 1) * math.log(0.01))
        means, quats, scales, opacities, first, rest = raw
        now = Splats(means, quats, scales.exp(), opacities.sigmoid(), torch.cat([first, rest], 1))
        a, b = render(now, views[0].camera, backend="reference").colors[0], torch.tensor(views[0].color).double()
        ma, mb = mean(a), mean(b)
        va, vb, c = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
        ssim = (2 * ma * mb + 1e-4) * (2 * c + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
        loss = 0.8 * (a - b).abs().mean() + 0.2 * (1 - ssim.mean())
        adam.zero_grad()
        loss.backward()
        adam.step()
    means, quats, scales, opacities, first, rest = (value.detach() for value in raw)
    return [means, quats, scales.exp(), opacities.sigmoid(), torch.cat([first, rest], 1)]


def test_three_steps_are_those_of_a_plain_torch_oracle() -> None:
    start, camera = small(), cameras(40, 32)[0]
    target = [TrainingView(camera, np.random.default_rng(5).random((32, 40, 3)).astype(np.float32))]
    options = FitOptions(steps=3, densify=False, extent=2.0, rate_sh=2.5e-3)
    ours = optimize(start, target, options).splats
    for name, expected in zip(ATTRIBUTES, oracle(start, target, options, 2.0), strict=True):
        before, after, reference = getattr(start, name), getattr(ours, name), expected.numpy()
        moved = np.abs(reference - before).max()
        wrong = np.abs(after - reference) > 0.03 * moved
        # Adam's first steps are signs of the gradient: one of 1e-10 may take the other sign in float32.
        assert moved > 0 and wrong.mean() < 0.01, name


def test_equal_arguments_give_equal_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    start, target = small(200), views_of(small(60), cameras(40, 32, count=3))
    done = []
    for threads in ("1", "3"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
        done.append(optimize(start, target, FitOptions(steps=12)))
    assert same_bits(done[0].splats, done[1].splats) and done[0].losses == done[1].losses
    assert np.array_equal(done[0].parents, done[1].parents)


def toy() -> tuple[Splats, list[TrainingView]]:
    """A sheet whose left half is plain and whose right half is striped, and 300 Gaussians unprojected from views of
    it."""
    truth = sheet(70, opacity=0.95)
    x, y = truth.means[:, :1], truth.means[:, 1:2]
    stripes = 0.5 + 0.4 * np.sign(np.sin(14 * x + 4.2 * y))
    truth.sh[:, 0] = (np.where(x > 0, stripes, [[0.6, 0.5, 0.4]]) - 0.5) / SH_C0
    around = [look_at((x, y, 3), (0, 0, 0), width=48, height=48, fov=42) for x, y in ((0, 0), (1, 0.3), (-1, -0.3))]
    drawn = render(truth, around)
    maps = (drawn.colors, drawn.depths[..., 0], drawn.alphas[..., 0])
    return from_depths(around, *maps, 300, sh_degree=0, opacity=0.9), views_of(truth, around)


def score(splats: Splats, target: list[TrainingView]) -> float:
    return float(np.mean([psnr(render(splats, view.camera).colors[0], view.color) for view in target]))


def test_the_loss_falls_and_gaussians_are_added_where_they_are_needed() -> None:
    """Two rounds of control, with a threshold that suits pictures of 48 px."""
    start, target = toy()
    density = DensityOptions(threshold=3e-3)
    done = optimize(
        start, target, FitOptions(steps=60, rate_sh=0.02, density=density, schedule=Schedule(20, 20, 40, 0))
    )
    assert np.mean(done.losses[-6:]) < 0.7 * np.mean(done.losses[:6])
    assert score(done.splats, target) > score(start, target) + 2
    children = np.bincount(done.parents, minlength=len(start))
    striped, plain = children[start.means[:, 0] > 0.05].mean(), children[start.means[:, 0] < -0.05].mean()
    assert striped > 1.5 * plain and len(done.splats) > 1.5 * len(start)
    assert done.steps == 60 and len(done.losses) == 60 and done.splats.drawable.all()


def test_gaussians_that_are_not_named_keep_their_bits() -> None:
    start = with_odd_gaussians(small(60))
    target = views_of(small(40), cameras(40, 32, count=2))
    gaussian_ids = np.flatnonzero(np.random.default_rng(0).random(len(start)) < 0.4)
    copy = replace(start, **{name: getattr(start, name).copy() for name in ATTRIBUTES})
    done = optimize(start, target, NO_DENSITY, gaussian_ids=gaussian_ids)
    assert same_bits(start, copy), "the caller's arrays are not written to"
    changed = differing(start, done.splats)
    assert not np.delete(changed, gaussian_ids).any() and changed[gaussian_ids].sum() > 10
    assert np.array_equal(done.parents, np.arange(len(start)))


def test_attributes_that_are_not_named_and_gaussians_out_of_view_keep_their_bits() -> None:
    start = with_odd_gaussians(small(60))
    start.means[30] = (0, 0, 30)  # behind all cameras
    target = views_of(small(40), cameras(40, 32, count=2))
    done = optimize(start, target, replace(NO_DENSITY, attributes=("sh", "opacities"))).splats
    for name in ("means", "quats", "scales"):
        assert np.array_equal(bits(getattr(start, name)), bits(getattr(done, name))), name
    assert not np.array_equal(start.sh, done.sh) and not np.array_equal(start.opacities, done.opacities)
    assert not differing(start, optimize(start, target, NO_DENSITY).splats)[30]


def test_steps_nobody_asked_for_are_not_made() -> None:
    start = small()
    done = optimize(start, views_of(start, cameras(40, 32)), FitOptions(steps=0))
    assert same_bits(done.splats, start) and done.losses == []


def test_a_loss_of_ones_own_and_a_watcher() -> None:
    start, target = small(), views_of(small(60), cameras(40, 32, count=2))
    seen: list[tuple[int, float]] = []

    def loss(image: torch.Tensor, view: TrainingView) -> torch.Tensor:
        assert image.shape == (32, 40, 3)
        return (image - torch.from_numpy(view.color)).square().mean()

    def watch(step: int, current) -> None:
        seen.append((step, float(current().sh.sum())))

    done = optimize(start, target, replace(NO_DENSITY, rate_sh=0.05), loss=loss, watch=watch)
    assert [step for step, _ in seen] == [1, 2, 3, 4] and len({value for _, value in seen}) == 4
    first = [float(((render(start, v.camera).colors[0] - v.color) ** 2).mean()) for v in target]
    assert min(abs(done.losses[0] - value) for value in first) < 1e-6
    assert float(done.splats.sh.sum()) == seen[-1][1]


def test_masked_pixels_pull_nothing() -> None:
    """Two Gaussians side by side; only the left half of the picture counts."""
    pair = small(2)
    pair = replace(
        pair, means=np.array([[-0.6, 0, 0], [0.6, 0, 0]], np.float32), scales=np.full((2, 3), 0.08, np.float32)
    )
    camera = front(48)
    mask = np.zeros((48, 48), bool)
    mask[:, :20] = True
    done = optimize(pair, [TrainingView(camera, np.zeros((48, 48, 3), np.float32), mask=mask)], NO_DENSITY)
    assert differing(pair, done.splats).tolist() == [True, False]


def test_sh_of_another_degree() -> None:
    start, target = small(degree=1), views_of(small(), cameras(40, 32))
    more = optimize(start, target, replace(NO_DENSITY, sh_degree=2)).splats
    less = optimize(start, target, replace(NO_DENSITY, sh_degree=0)).splats
    assert (more.sh_degree, less.sh_degree) == (2, 0) and more.sh[:, 4:].any()


def test_origins_follow_the_gaussians() -> None:
    start, target = toy()
    start = replace(start, origin=np.arange(len(start))[::-1].copy())
    done = optimize(start, target, FitOptions(steps=30, schedule=Schedule(10, 10, 20, 0)))
    assert start.origin is not None and done.splats.origin is not None
    assert np.array_equal(done.splats.origin, start.origin[done.parents])


def fit(options: FitOptions = NO_DENSITY, **how) -> Fitted:
    start = small()
    return optimize(start, how.pop("views", views_of(start, cameras(40, 32))), options, **how)


def test_what_does_not_fit_together() -> None:
    camera = cameras(40, 32)[0]
    grey = np.full((32, 40, 3), 0.5, np.float32)
    for error, call in {
        "at least one view": lambda: fit(views=[]),
        "set densify=False": lambda: fit(FitOptions(steps=1), gaussian_ids=np.arange(3)),
        "attributes of means": lambda: fit(replace(NO_DENSITY, attributes=("colour",))),
        "np.flatnonzero": lambda: fit(gaussian_ids=np.ones(30, bool)),
        r"view 0: expected colours \[32, 40, 3\]": lambda: fit(views=[TrainingView(camera, grey[:31])]),
        "a mask": lambda: fit(views=[TrainingView(camera, grey, mask=np.ones((31, 40)))]),
        "finite colours": lambda: fit(views=[TrainingView(camera, np.full_like(grey, np.nan))]),
        "11x11": lambda: fit(views=[TrainingView(cameras(9, 9)[0], grey[:9, :9])]),
        "sh_degree 0 to 4": lambda: fit(replace(NO_DENSITY, sh_degree=5)),
        "steps >= 0": lambda: fit(replace(NO_DENSITY, steps=-1)),
        "at least one Gaussian": lambda: optimize(small().take(np.arange(0)), [TrainingView(camera, grey)], NO_DENSITY),
    }.items():
        with pytest.raises(ValueError, match=error):
            call()
