"""The local network: what it reads, that a picture teaches it, and what a painter makes of what it says."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.fft import dctn

from splatpainter.cameras import Camera, look_at
from splatpainter.color import base_color, sh_from_color
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.edits import LiftedEdit
from splatpainter.lift.features import no_features
from splatpainter.models import local_edit_colors, weights
from splatpainter.models.config import RefineConfig
from splatpainter.models.local_config import LocalConfig
from splatpainter.models.local_edit_colors import (
    NetworkColors,
    applied,
    held,
    network_colors,
    patches_of,
    readers_of,
    with_colors,
)
from splatpainter.models.local_network import LocalAnswer, LocalNetwork, Patches, Readers
from splatpainter.models.picture_patches import (
    APPENDED_FEATURE,
    BANDS,
    PATCH_PX,
    SLOTS,
    cosine_basis,
    cosines,
    picture_regions,
)
from splatpainter.models.refine import RidgeMixer
from splatpainter.painter import Edit, Painter
from splatpainter.rendering import render
from splatpainter.splats import Splats

CONFIG = LocalConfig(
    content_width=75,
    refine=RefineConfig(blocks=1, mixer="ridge", fast_hidden=128, hidden=32, heads=4, patch=4, detail=True),
)
SIZE = 48


@cache
def sheet() -> tuple[Splats, Camera]:
    """A square of 1,024 flat Gaussians, grey, and the camera that looks at it."""
    count = 32
    x, y = np.meshgrid(*2 * [(np.arange(count) + 0.5) / count * 2 - 1])
    means = np.stack([x.ravel(), y.ravel(), np.zeros(count**2)], 1).astype(np.float32)
    scales = np.tile(np.array([0.045, 0.045, 0.004], np.float32), (count**2, 1))
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count**2, 1))
    sh = np.zeros((count**2, 1, 3), np.float32)
    camera = look_at((0.4, 0.3, 3.0), (0, 0, 0), width=SIZE, height=SIZE, fov=40)
    return Splats(means, quats, scales, np.full(count**2, 0.95, np.float32), sh), camera


def pattern(seed: int, points: np.ndarray) -> np.ndarray:
    """[N, 3] smooth colours 0..1 of points [N, 3] of the sheet."""
    rng = np.random.default_rng(seed)
    waves = rng.uniform(-3, 3, (3, 3))
    return (0.5 + 0.4 * np.sin(points @ waves + rng.uniform(0, 6, 3))).astype(np.float32)


def painted(seed: int) -> tuple[LiftedEdit, EditView, np.ndarray]:
    """(the sheet with all of its Gaussians to be coloured, a picture of it in a pattern, the true colours)."""
    splats, camera = sheet()
    truth = pattern(seed, splats.means)
    after = replace(splats, sh=sh_from_color(truth)[:, None].astype(np.float32))
    picture = render(after, camera).colors[0]
    mask = render(splats, camera).alphas[0, ..., 0] > 0.5
    (view,) = edit_views(splats, [camera], [picture], [mask])
    ids = np.arange(len(splats))
    return LiftedEdit(splats, ids, ids, no_features(ids)), view, truth


def network(**refine: object) -> LocalNetwork:
    torch.manual_seed(0)
    return LocalNetwork(replace(CONFIG, refine=replace(CONFIG.refine, **refine))).eval()  # type: ignore[arg-type]


def decibels(colors: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(colors - truth).mean()))


def test_cosines_are_the_dct_and_read_the_pixels_that_they_were_made_of() -> None:
    patches = np.random.default_rng(0).uniform(0, 1, (5, PATCH_PX, PATCH_PX, 3)).astype(np.float32)
    coefficients = cosines(patches)
    expected = dctn(patches, axes=(1, 2), norm="ortho").reshape(5, BANDS, 3)  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_allclose(coefficients, expected, atol=1e-6)
    # Pixel (row 2, column 1): its centre, from the patch's middle.
    (basis,) = cosine_basis(np.array([[1.5 / 4 - 0.5, 2.5 / 4 - 0.5]]))
    np.testing.assert_allclose(np.einsum("k,tkc->tc", basis, coefficients), patches[:, 2, 1], atol=1e-6)


def test_patches_are_the_pictures_and_every_gaussian_asks_the_one_over_it() -> None:
    splats, camera = sheet()
    lifted, view, _ = painted(0)
    regions = list(picture_regions(splats, lifted, view))
    assert len(regions) > 1
    np.testing.assert_array_equal(np.sort(np.concatenate([part.index for part in regions])), np.arange(len(splats)))
    pixels, _ = camera.project(splats.means.astype(np.float64))
    readable = 0
    for region in regions:
        assert len(np.unique(region.tokens.cells)) == len(region.tokens.cells) <= SLOTS
        number = np.full(SLOTS, -1)
        number[region.tokens.cells] = np.arange(len(region.tokens.cells))
        for reader, gaussian in enumerate(region.index):
            k = number[region.readers.cells[reader]]
            x, y = np.floor(pixels[gaussian]).astype(int)
            if k < 0 or not (0 <= x < SIZE and 0 <= y < SIZE):
                continue
            bands = region.tokens.values[k, : 3 * BANDS].reshape(BANDS, 3)
            # The middle of the pixel that the Gaussian lies in, read from the patch's cosines.
            (basis,) = cosine_basis(
                np.array([[(x % PATCH_PX + 0.5) / PATCH_PX, (y % PATCH_PX + 0.5) / PATCH_PX]]) - 0.5
            )
            np.testing.assert_allclose(0.5 + 2 * basis @ bands, view.target[y, x], atol=1e-5)
            readable += 1
    assert readable > 0.9 * len(splats)


def test_a_gaussian_is_told_nothing_of_the_lifts_answer() -> None:
    splats, _ = sheet()
    lifted, view, truth = painted(0)
    answered = replace(lifted, splats=replace(splats, sh=sh_from_color(truth)[:, None].astype(np.float32)))
    regions = (picture_regions(splats, edit, view) for edit in (lifted, answered))
    for one, other in zip(*regions, strict=True):
        for name in ("cells", "inside", "facts", "before"):
            np.testing.assert_array_equal(getattr(one.readers, name), getattr(other.readers, name))


@pytest.mark.parametrize("mixer", ["ttt", "ridge", "cross_attention"])
def test_an_untrained_network_reads_the_picture_under_each_gaussian(mixer: str, float32: None) -> None:
    splats, _ = sheet()
    lifted, view, truth = painted(0)
    answer = network_colors(network(mixer=mixer), splats, lifted, [view])
    assert decibels(answer.colors, truth) > 18 > 12 > decibels(base_color(splats.sh), truth)
    other = network_colors(network(mixer=mixer), splats, lifted, [painted(1)[1]])
    assert decibels(other.colors, truth) < 14
    if mixer != "cross_attention":  # which has no strength
        nothing = network_colors(network(mixer=mixer), splats, lifted, [view], strength=0.0)
        np.testing.assert_allclose(nothing.colors, np.clip(base_color(splats.sh), 0, 1), atol=0.02)  # no paint


@pytest.mark.parametrize("mixer", ["ttt", "ridge"])
def test_thirty_steps_on_pictures_leave_half_the_error_that_other_memories_do(mixer: str, float32: None) -> None:
    """A toy Stage II of pictures: what it says of a picture that it has not seen, against strength 0 and against the
    memory of another picture."""
    splats, _ = sheet()
    learner = network(mixer=mixer, detail=False).train()
    optimizer = torch.optim.AdamW(learner.parameters(), lr=1e-4)
    seen = [(picture_regions(splats, *painted(seed)[:2]), painted(seed)[2]) for seed in range(2, 6)]
    samples = [(max(regions, key=lambda region: len(region.index)), truth) for regions, truth in seen]
    for step in range(30):
        region, truth = samples[step % len(samples)]
        pick = np.random.default_rng(step).permutation(len(region.index))[:256]
        state = learner.adapt(learner.initial_state(), patches_of(region.tokens))
        answer = learner.read(state, readers_of(region.readers.take(pick)))
        loss = torch.log((answer.colors - torch.from_numpy(truth[region.index[pick]])).square().mean() + 1e-4)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    learner.eval()
    lifted, view, truth = painted(0)
    errors = [
        float(np.square(network_colors(learner, splats, lifted, [picture], strength).colors - truth).mean())
        for picture, strength in ((view, None), (view, 0.0), (painted(1)[1], None))
    ]
    assert errors[0] < 0.5 * min(errors[1:]), errors


def test_a_ridge_memory_is_the_regression_and_adds_up() -> None:
    torch.manual_seed(0)
    mixer = RidgeMixer(8, RefineConfig(mixer="ridge", fast_hidden=6), pictures=False, gaussians=False)
    torch.nn.init.normal_(mixer.keys.weight)
    torch.nn.init.zeros_(mixer.rates.weight)  # every token counts once
    tokens, queries = torch.randn(20, 8), torch.randn(5, 8)
    memory = mixer.update(mixer.initial(), tokens, None, None)
    parts = mixer.update(mixer.update(mixer.initial(), tokens[:7], None, None), tokens[7:], None, None)
    torch.testing.assert_close(memory, parts)
    with torch.no_grad():
        phi = mixer._features(mixer.keys, tokens).double().numpy()
        values = (tokens @ mixer.values.weight.T).double().numpy()
        # Ridge as least squares with the penalty as further lines.
        lines = np.concatenate([phi, np.eye(6)]), np.concatenate([values, np.zeros((6, 8))])
        solved = np.linalg.lstsq(*lines, rcond=None)[0]
        queried = mixer._features(mixer.queries["voxel"], queries).double().numpy()
        expected = queried @ solved @ mixer.out.weight.double().numpy().T
    np.testing.assert_allclose(mixer.read_gaussian_tokens(memory, queries).detach().numpy(), expected, atol=2e-5)
    nothing = mixer.update(mixer.initial(), tokens, None, 0.0)
    assert not nothing.any() and not mixer.read_gaussian_tokens(nothing, queries).any()  # pyright: ignore[reportAttributeAccessIssue]


def test_the_picture_decides_where_it_can_and_the_network_where_it_is_sure() -> None:
    splats, camera = sheet()
    lifted, view, truth = painted(0)
    wrong = np.full_like(truth, 0.5)
    errors = []
    for variance in (1e-1, 1e-9):
        answer = NetworkColors(wrong, np.full(len(wrong), variance, np.float32))
        colored = held(lifted, answer, [view])
        errors.append(np.square(render(colored.splats, camera).colors[0] - view.edited)[view.mask].mean())
    start = np.square(render(with_colors(lifted, answer).splats, camera).colors[0] - view.edited)[view.mask].mean()
    assert errors[0] < 0.05 * start and errors[0] < 0.5 * errors[1] < start
    unread = NetworkColors(np.full_like(truth, 0.9), np.full(len(wrong), np.inf, np.float32))
    np.testing.assert_array_equal(with_colors(lifted, unread).splats.sh, splats.sh)


def test_colors_that_hardly_move_keep_their_bits() -> None:
    """A picture half a thousandth brighter than the sheet asks for less than receipts are to name."""
    splats, camera = sheet()
    lifted, view, truth = painted(0)
    picture = render(splats, camera).colors[0] + np.float32(0.0005)
    (brighter,) = edit_views(splats, [camera], [picture], [view.mask])
    answer = NetworkColors(np.full_like(truth, 0.5), np.full(len(truth), 0.1, np.float32))
    np.testing.assert_array_equal(held(lifted, answer, [brighter]).splats.sh, splats.sh)


def plain_view(level: float) -> EditView:
    """The sheet painted in one grey."""
    splats, camera = sheet()
    mask = render(splats, camera).alphas[0, ..., 0] > 0.5
    (view,) = edit_views(splats, [camera], [np.full((SIZE, SIZE, 3), level, np.float32)], [mask])
    return view


class Certain:
    """Says of every Gaussian the grey of its patches, and of bright pictures that it is sure of it."""

    def initial_state(self) -> None:
        return None

    def adapt(self, state: None, patches: Patches, strength: float | None) -> float:
        return 0.2 if patches.values[:, 0].mean() < 0 else 0.8

    def read(self, state: float, readers: Readers, strength: float | None) -> LocalAnswer:
        count = len(readers.before)
        return LocalAnswer(torch.full((count, 3), state), torch.full((count,), -3.0 if state > 0.5 else -1.0))


def test_of_several_views_the_surer_ones_weigh_more() -> None:
    lifted, _, _ = painted(0)
    answer = network_colors(Certain(), sheet()[0], lifted, [plain_view(0.2), plain_view(0.8)])  # type: ignore[arg-type]
    weights_of = np.exp([1.0, 3.0])
    read = np.isfinite(answer.variance)
    assert read.mean() > 0.9
    np.testing.assert_allclose(answer.colors[read], np.average([0.2, 0.8], weights=weights_of), rtol=1e-5)
    np.testing.assert_allclose(answer.variance[read], 1 / weights_of.sum(), rtol=1e-5)


def test_of_views_that_contradict_each_other_the_latest_is_held_against() -> None:
    splats, camera = sheet()
    lifted, _, _ = painted(0)
    answer = NetworkColors(np.full((len(splats), 3), 0.5, np.float32), np.full(len(splats), 0.1, np.float32))
    levels = 0.2, 0.8
    for order in (levels, levels[::-1]):
        made = held(lifted, answer, [plain_view(level) for level in order]).splats
        drawn = render(made, camera).colors[0][plain_view(0.2).mask].mean()
        assert abs(drawn - order[1]) < 0.1 * abs(levels[1] - levels[0]), order


def test_rounds_count_pixels_by_their_variance(monkeypatch: pytest.MonkeyPatch) -> None:
    """One Gaussian that fills the picture, weight W: after many rounds (W picture + h answer) / (W + h)."""
    wide = replace(local_edit_colors.HELD_COLORS, hold=(0.01, 1e9))
    monkeypatch.setattr(local_edit_colors, "HELD_COLORS", wide)
    camera = look_at((0, 0, 3.0), (0, 0, 0), width=16, height=16, fov=40)
    one = Splats(
        *(np.array(x, np.float32) for x in ([[0, 0, 0]], [[1, 0, 0, 0]], [[9, 9, 0.01]], [0.9], [[[0, 0, 0]]]))  # pyright: ignore[reportArgumentType]
    )
    (view,) = edit_views(one, [camera], [np.full((16, 16, 3), 0.8, np.float32)], [np.ones((16, 16), bool)])
    view = replace(view, edited=np.asarray(render(replace(one, sh=np.ones((1, 1, 3), np.float32)), camera).colors[0]))
    alpha = render(one, camera).alphas[0, ..., 0].astype(np.float64)
    lifted = LiftedEdit(one, np.arange(1), np.arange(1), no_features(np.arange(1)))
    level, hold = 0.2, 40.0
    answer = NetworkColors(np.full((1, 3), level, np.float32), np.full(1, 2.5e-4 / hold, np.float32))
    colored = base_color(held(lifted, answer, [view], rounds=400).splats.sh)[0, 0]
    weight, target = (alpha**2).sum(), float(base_color(np.ones((1, 1, 3)))[0, 0])
    # Damped least squares of the colour: the rounds' divisor counts weights, their residual weights times alpha.
    assert level < colored < target
    np.testing.assert_allclose(colored, (weight * target + hold * level) / (weight + hold), atol=0.01)
    # What the view hides of it counts as further pixels of its colour.
    hidden, further = np.array([800.0]), 800 * wide.hold_hidden
    held_back = base_color(held(lifted, answer, [view], rounds=400, hidden=[hidden]).splats.sh)[0, 0]
    expected = (weight * target + (hold + further) * level) / (weight + hold + further)
    np.testing.assert_allclose(held_back, expected, atol=0.01)
    assert colored - expected > 0.03


def test_a_close_up_changes_gaussians_as_far_as_it_shows_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """One wholly in the picture, one cut in half by its edge, one behind a wall: their shares are known."""
    camera = look_at((0, 0, 3.0), (0, 0, 0), width=64, height=64, fov=40)
    edge = 3 * np.tan(np.radians(20))
    means = np.array([[-0.7, 0.7, 0], [edge, 0.6, 0], [0, -0.1, -0.1], [0, -0.1, 0]], np.float32)
    scales = np.array([[0.05] * 3, [0.05] * 3, [0.05] * 3, [0.3, 0.3, 0.001]], np.float32)
    opacities = np.array([0.3, 0.3, 0.3, 0.999], np.float32)
    quats, sh = np.tile(np.array([1, 0, 0, 0], np.float32), (4, 1)), np.zeros((4, 1, 3), np.float32)
    splats = Splats(means, quats, scales, opacities, sh)
    ids = np.arange(3)
    lifted = LiftedEdit(splats, ids, ids, no_features(ids))
    picture = np.full((64, 64, 3), 0.7, np.float32)
    (wide,) = edit_views(splats, [camera], [picture], [np.ones((64, 64), bool)])
    (part,) = edit_views(splats, [camera], [picture], [np.indices((64, 64))[1] < 20])
    seen: list[tuple[NetworkColors, list[np.ndarray]]] = []

    def watched(lifted: LiftedEdit, answer: NetworkColors, views: object, *, hidden: object = ()) -> LiftedEdit:
        seen.append((answer, list(hidden)))  # pyright: ignore[reportArgumentType, reportCallIssue]
        return lifted

    monkeypatch.setattr(local_edit_colors, "held", watched)
    answer = NetworkColors(np.full((3, 3), 0.9, np.float32), np.full(3, 0.1, np.float32))
    applied(lifted, answer, [wide])
    applied(lifted, answer, [part])
    # Opacities of 0.3 are drawn from alphas of 1 / 255 on: 1.3 per cent of the footprint is not.
    close_up, (hidden,) = seen[0]
    np.testing.assert_allclose((close_up.colors - 0.5) / 0.4, np.repeat([[1], [0.5], [0]], 3, 1), atol=0.03)
    footprint = 2 * np.pi * 0.3 * (0.05 / 3 * camera.fx) ** 2
    np.testing.assert_allclose(hidden / footprint, [0, 0.5, 1], atol=0.2)
    np.testing.assert_array_equal(seen[1][0].colors, answer.colors)
    assert not seen[1][1]


@pytest.mark.parametrize(("seed", "other"), [(0, 1), (1, 2), (2, 0)])
def test_the_shipped_weights_leave_half_the_error_that_other_memories_do(seed: int, other: int, float32: None) -> None:
    splats, _ = sheet()
    lifted, view, truth = painted(seed)
    shipped = weights.deferred_local(weights.PACKAGED / weights.LOCAL)
    assert shipped is not None
    errors = [
        float(np.square(network_colors(shipped, splats, lifted, [picture], strength).colors - truth).mean())
        for picture, strength in ((view, None), (view, 0.0), (painted(other)[1], None))
    ]
    assert errors[0] < 0.5 * min(errors[1:]), errors
    assert errors[0] < 0.5 * float(np.square(truth.mean(0) - truth).mean()), "than the mean colour, too"


def test_a_painter_makes_local_edits_by_it(tmp_path: Path, float32: None) -> None:
    splats, camera = sheet()
    made = network()
    made.save(tmp_path / "local", {"gain": {}})
    loaded = LocalNetwork.load(tmp_path / "local")
    picture = render(splats, camera).colors[0].copy()
    mask = np.zeros((SIZE, SIZE), bool)
    mask[18:30, 16:30] = True
    picture[mask] = (0.9, 0.2, 0.1)
    edits = [Edit(picture, camera, mask)]
    painter = Painter.load(str(tmp_path / "local"))
    asset = painter.encode(splats)
    result = painter.apply(asset, edits, "local", "ttt")
    assert result.receipt is not None and (result.receipt.method, result.receipt.preset) == ("ttt", "local")
    assert result.receipt.precision == "float32"
    touched = np.zeros(len(splats), bool)
    touched[result.receipt.touched] = True
    assert touched.any() and not touched.all()
    for name in ("means", "sh", "opacities"):
        np.testing.assert_array_equal(
            getattr(result.splats, name)[: len(splats)][~touched], getattr(splats, name)[~touched]
        )
    assert result.receipt.untouched_sha256_before == result.receipt.untouched_sha256_after
    lift = painter.apply(asset, edits, "local", "lift")
    assert not np.array_equal(result.splats.sh, lift.splats.sh)
    again = Painter(local=loaded).apply(asset, edits, "local", "ttt")
    np.testing.assert_array_equal(again.splats.sh, result.splats.sh)


def test_auto_takes_it_only_where_it_was_measured_to_be_better() -> None:
    made = network()
    for gain, method in (
        ({}, "corrected"),
        ({"gain": {"local": -0.1}}, "corrected"),
        ({"gain": {"local": 0.4}}, "ttt"),
    ):
        made.notes = gain
        chosen, why = Painter(local=made).choose("auto", "local")
        assert chosen == method and "preset 'local'" in why
    assert "not measured on captures" in Painter(local=network()).choose("auto", "local")[1]
    assert Painter(local=made).choose("ttt", "local") == ("ttt", "")
    made.notes = {"gain": {"local": -0.1}}
    assert "no better than the lift (-0.10 dB" in Painter(local=made).choose("ttt", "local")[1]
    with pytest.raises(ValueError, match="needs a preset with trained weights"):
        Painter(local=made).choose("ttt", "global")


def test_appended_gaussians_alone_read_a_second_set_that_the_others_teach() -> None:
    """The extra layer learns from the refined tokens of all, and only finer Gaussians are read from it."""
    net, plain = network(mixer="ttt"), network(mixer="ttt", detail=False)
    with torch.no_grad():
        torch.nn.init.normal_(net.detail_mixer.ttt.out.weight, std=0.1)
    plain.load_state_dict({name: net.state_dict()[name] for name in plain.state_dict()})
    lifted, view, _ = painted(1)
    region = next(iter(picture_regions(sheet()[0], lifted, view)))
    readers = readers_of(region.readers)
    facts = readers.facts.clone()
    facts[:, APPENDED_FEATURE] = torch.where(torch.arange(len(facts)) % 2 == 0, 1.0, -1.0)
    readers = readers._replace(facts=facts)
    with torch.no_grad():
        state = net.adapt(net.initial_state(), patches_of(region.tokens))
        both, one = net.read(state, readers).colors, plain.read(state, readers).colors
        untaught = net.read(state, readers, strength=0.0).colors
        few = net.read(state, Readers(*(part[::2] for part in readers))).colors
    assert torch.equal(both[1::2], one[1::2]) and torch.equal(untaught[1::2], both[1::2])
    moved = [(both[::2] - other).abs().amax() for other in (one[::2], untaught[::2], few)]
    assert min(moved) > 1e-4, moved
