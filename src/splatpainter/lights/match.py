"""The light of relit pictures: both environments from one to four views of an asset under another light.

In a ratio of colours the material cancels: of each Gaussian that a view shows, the logarithm of what it shows there
over what it shows now is that of new over old irradiance. Both are linear in their light's SH; a robust Gauss-Newton
fit finds the new light and corrects the old one, which starts, and is held, at its estimate from the asset alone. What
lights do not explain (gloss, sharp shadows, paint) is the painter's; which of light, painter and both is best, a part
of the views that was held back decides, and with it how far a given environment is believed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import field, replace
from pathlib import Path

import numpy as np

from splatpainter.cameras import UpAxis
from splatpainter.color import base_color, linear_to_srgb, luminance, sh_from_color, to_light
from splatpainter.contact_sheet import Strip, sheet
from splatpainter.image_files import encode_png
from splatpainter.kernels import portable
from splatpainter.lights.given_light import (
    HELD,
    NEARLY,
    ROUGHLY,
    EnvironmentUse,
    LightFit,
    Trust,
    better_turn,
    chosen_trust,
)
from splatpainter.lights.given_light import LIMITS as GIVEN
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.light_set import about_up, axes_of
from splatpainter.lights.prepared import captured_light, lit_surface
from splatpainter.lights.relight import Where, color_receipt, transfer
from splatpainter.lights.sky_maps import SkyMap, lat_long
from splatpainter.lights.source_light import PRIOR_STD, SourceLight
from splatpainter.painter import Asset, Edit, Painter
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import SH_C0, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import sh_basis

MAX_MATCHED_VIEWS = 4
MIN_SHARE = 0.3
"""Pixels' worth of a Gaussian over all views, from which it is a witness."""
MIN_WITNESSES = 60
RATIO_FLOOR = 0.003
"""Added to linear colours before their ratio."""
DARK, DIM = 0.002, 0.02
"""Linear colours below which nothing is a witness, and at which it counts for a quarter."""
CHANNEL_STD = 0.4
"""Of a channel's bands about those of luminance, over those of environments."""
CLIPPED = 0.97
"""Linear colour from which a picture says "at least"."""
MIN_LIGHT = 0.04
"""Smallest irradiance that is believed, over the mean."""
FIT_ROUNDS = 25
RATIO_NOISE = 0.1
"""Of a Gaussian's ratio, natural logarithms, at least."""
WITNESS_WEIGHT = 0.02
"""Of a Gaussian: neighbours err alike."""
STEADFAST = 0.5
"""Deviation of the light before, in a match, over its reported uncertainty."""
LEVEL_STD = 1.0
"""Of the new light's mean over the old one's, times the old one's."""
PREFERENCE_DB = 0.5
"""By which a painter has to be better than light alone, which is smooth wherever nothing was seen. 16 fitted, path
traced tuning meshes, 1, 2 and 4 pictures, dB: with 0 20.89, 21.76, 22.55; with 0.5 21.03, 22.34, 22.55; with 1 21.03,
22.34, 22.40; light alone 21.01, 22.24, 22.34."""
SKY_ROWS = 64
"""Of the pictures of matched environments."""
BALL_PX = 192


@dataclass(frozen=True)
class MatchedLight:
    """Both lights, and the asset in the new one."""

    before: SourceLight
    after: np.ndarray = field(repr=False)
    """[9, 3] float64 SH in the asset's axes, over the level of the light before."""
    asset: Asset
    chosen: str
    """"light", "painter" or "light and painter"."""
    scores: dict[str, float]
    """PSNR in dB of each on the part of the views that was held back."""
    environment: EnvironmentUse | None = None
    """What was made of the given new light; None: there was none."""

    def sky(self, up: UpAxis = "auto") -> SkyMap:
        """The new environment as a picture."""
        return sky_of(self.after, up, "matched")


def match_light(
    splats: Splats,
    edits: Sequence[Edit],
    painter: Painter | None = None,
    *,
    shadows: bool = True,
    source: np.ndarray | None = None,
    target: np.ndarray | None = None,
    up: UpAxis = "auto",
    region: Where | None = None,
    mix: float = 1.0,
) -> MatchedLight:
    """splats as the pictures show it, with its receipt. edits: 1 to 4 views in one other light; painter: explains what
    light does not, None: light alone; source, target: [9, 3] SH of the light before and of the new one, where they are
    given (the pictures still decide the new one's level, how far its shape is believed, and whether it is used at all);
    up: where light usually comes from; region, mix: where, and how much of it, 0..1, the new look is; the lights are
    found by all of the asset. Raises ValueError: no views, views that show nothing of the asset."""
    if not 1 <= len(edits) <= MAX_MATCHED_VIEWS:
        raise ValueError(f"light: expected 1 to {MAX_MATCHED_VIEWS} pictures to match, got {len(edits)}")
    clock = time.perf_counter()
    splats = splats.numpy()
    edits = [edit.relative_to(splats.offset) for edit in edits]
    # Occlusion depends on shape alone, so it is computed once for all candidates.
    surface = lit_surface(splats, shadows)
    before = captured_light(splats, shadows, up) if source is None else SourceLight(source, 0.0, "source light: given")

    def fitted(seen: Witnesses, trust: Trust | None) -> _Lights:
        return _fit_lights(surface, seen, before, source is not None, target, trust)

    def luminance_fit(trust: Trust | None, light: np.ndarray | None) -> LightFit:
        return _fitter(surface, seen, before, source is not None, light, trust)(None, None)[1]

    def lit_by(lights: _Lights) -> Asset:
        return transfer(splats, lights.before, lights.after, PicturedRegion(lights.certainty), shadows=shadows)

    # How far a given environment is believed is asked of the light alone: a painter would hide what is wrong with it.
    seen, environment = _seen(splats, edits), None
    if target is not None:
        environment = _judged(splats, surface, edits, Given(target, up), luminance_fit, fitted, lit_by)
    trust = environment.trust if environment else None

    def results(views: Sequence[Edit], seen: Witnesses, names: Sequence[str]) -> dict[str, tuple[Asset, _Lights]]:
        lights = fitted(seen, trust)
        lit = lit_by(lights)
        out = {"light": (lit, lights)} if "light" in names else {}
        if painter is not None and "painter" in names:
            out["painter"] = (painter.apply(painter.encode(splats), views, "global"), lights)
        if painter is not None and "light and painter" in names:
            out["light and painter"] = (painter.apply(painter.encode(lit.splats), views, "global"), lights)
        return out

    # With one candidate there is nothing to judge, and all of the pictures can be used.
    names = ["light"] if painter is None else ["light", "painter", "light and painter"]
    scores: dict[str, float] = {}
    if len(names) > 1:
        used, judged = _held_back(splats, edits)
        candidates = results(used, _seen(splats, used), names)
        scores = {name: _score(asset.splats, judged) for name, (asset, _) in candidates.items()}
        names = [max(scores, key=lambda name: scores[name] + (PREFERENCE_DB if name == "light" else 0))]
    # The winner is made once more of all that the pictures show, the judging part too.
    asset, lights = results(edits, seen, names)[names[0]]
    edited = _faded(splats, asset.splats, region, mix)
    where = (f"; mix {mix:g}" if mix != 1 else "") + (f"; where {region.text}" if region else "")
    listed = ", ".join(f"{name} {value:.1f}" for name, value in scores.items())
    count = "1 picture" if len(edits) == 1 else f"{len(edits)} pictures"
    note = f"light matched to {count} by {names[0]}" + (f" (held back, dB: {listed})" if listed else "")
    # The scores stand in the receipt, so that one can see how narrow the choice was.
    note += f"; {environment.text}" if environment else ""
    receipt = color_receipt(splats, edited, "light", f"{note}; {lights.before.note}{where}")
    receipt = replace(receipt, seconds={"match": time.perf_counter() - clock})
    asset = Asset(edited, receipt, original=splats)
    return MatchedLight(lights.before, lights.after, asset, names[0], scores, environment)


@dataclass(frozen=True)
class Given:
    """A new light that is given beside pictures."""

    light: np.ndarray = field(repr=False)
    """[9, 3] SH in the asset's axes."""
    up: UpAxis

    def turned(self) -> list[np.ndarray]:
        """The light as it would be if it came from elsewhere: [9, 3] at equal steps about the way up."""
        return [about_up(self.light, self.up, 360 * k / GIVEN.turns) for k in range(1, GIVEN.turns)]


def _judged(
    splats: Splats,
    surface: LitSurface,
    edits: Sequence[Edit],
    given: Given,
    luminance_fit: Callable[[Trust | None, np.ndarray | None], LightFit],
    fitted: Callable[[Witnesses, Trust | None], _Lights],
    lit_by: Callable[[_Lights], Asset],
) -> EnvironmentUse:
    """How far a given environment is believed."""
    noise = luminance_fit(None, given.light).noise(RATIO_NOISE)
    evidence, *turned = (luminance_fit(NEARLY, light).evidence(noise) for light in (given.light, *given.turned()))
    used, judged = _held_back(splats, edits)
    half = _seen(splats, used)
    # Pictures that just show enough of the asset do not show it twice.
    enough = _trusted(surface, half).sum() >= MIN_WITNESSES
    candidates = (None, HELD, NEARLY, ROUGHLY) if enough else ()
    scores = {trust: _score(lit_by(fitted(half, trust)).splats, judged) for trust in candidates}
    return chosen_trust(scores, better_turn(evidence, turned))


def _faded(splats: Splats, edited: Splats, region: Where | None, mix: float) -> Splats:
    """The new look by a region and a mix; what has none of it keeps its bytes."""
    if region is None and mix == 1:
        return edited
    weights = np.ones(len(splats)) if region is None else region.weights(splats).astype(np.float64)
    weights = (weights * mix)[:, None]
    old, new = (to_light(base_color(sh.astype(np.float64)), splats.color_space) for sh in (splats.sh, edited.sh))
    # Base colours are mixed as light, as `relight` does; bands are slopes of display colours and mix as they are.
    light = old + weights * (new - old)
    sh = splats.sh + weights[:, :, None] * (edited.sh.astype(np.float64) - splats.sh)
    sh[:, 0] = sh_from_color(light if splats.color_space == "linear" else linear_to_srgb(light))
    mixed = np.where(weights[:, :, None] >= 1, edited.sh, sh.astype(np.float32))
    return replace(edited, sh=np.where(weights[:, :, None] > 0, mixed, splats.sh))


def sky_of(coefficients: np.ndarray, up: UpAxis, name: str) -> SkyMap:
    """An environment as a picture, from SH [9, 3] in an asset's axes. What SH has below black is black."""
    towards, _ = lat_long(SKY_ROWS, 2 * SKY_ROWS)
    basis = sh_basis(portable.matmul(towards.reshape(-1, 3), axes_of(up)), 2)
    picture = np.maximum(portable.matmul(basis, coefficients), 0).reshape(SKY_ROWS, 2 * SKY_ROWS, 3)
    if not picture.any():
        raise ValueError("light: the matched environment is black; the pictures show no light")
    return SkyMap(picture.astype(np.float32), name)


def ball_sheet(path: Path, lights: dict[str, np.ndarray], up: UpAxis = "auto") -> None:
    """A PNG of white balls in lights (SH [9, 3] in an asset's axes), seen from the front, and of their environments."""
    from splatpainter.lighting import unoccluded_transfer

    across = (np.arange(BALL_PX) + 0.5) / BALL_PX * 2.1 - 1.05
    x, y = np.meshgrid(across, -across)
    square = x * x + y * y
    z = np.sqrt(np.maximum(1 - square, 0))
    normals = np.stack([x, y, z], -1) / np.maximum(np.sqrt(square + z * z), 1e-9)[..., None]
    transfer = unoccluded_transfer(portable.matmul(normals.reshape(-1, 3), axes_of(up))) / np.pi
    cells = []
    for name, light in lights.items():
        shade = np.maximum(portable.matmul(transfer.astype(np.float64), light), 0).reshape(BALL_PX, BALL_PX, 3)
        ball = np.where(square[..., None] < 1, linear_to_srgb(0.5 * shade).clip(0, 1), 0.5)
        cells.append((name, ball.astype(np.float32)))
        picture = sky_of(light, up, name).radiance
        cells.append((f"{name}: from all around", linear_to_srgb(0.5 * picture).clip(0, 1).astype(np.float32)))
    from splatpainter.system.atomic import writing

    with writing(path) as file:
        file.write(encode_png(sheet([Strip("", tuple(cells))], BALL_PX, "Lights")))


@dataclass(frozen=True)
class PicturedRegion:
    """A region: as far as pictures tell what light comes to each Gaussian."""

    shares: np.ndarray = field(repr=False)
    """[N] float32 0..1."""

    @property
    def text(self) -> str:
        return "what the pictures tell of"

    def weights(self, splats: Splats) -> np.ndarray:
        return self.shares


@dataclass(frozen=True)
class Witnesses:
    """Gaussians as all views see them."""

    now: np.ndarray = field(repr=False)
    """[N, 3] linear colours of the asset."""
    then: np.ndarray = field(repr=False)
    """[N, 3] of the pictures."""
    pixels: np.ndarray = field(repr=False)
    """[N] pixels' worth."""


@dataclass(frozen=True)
class _Lights:
    """Both lights as fitted."""

    before: SourceLight
    """Corrected."""
    after: np.ndarray = field(repr=False)
    """[9, 3]."""
    certainty: np.ndarray = field(repr=False)
    """[N] float32 0..1 how far the pictures tell what each Gaussian gets of the new light."""


def _fit_lights(
    surface: LitSurface,
    seen: Witnesses,
    before: SourceLight,
    given: bool,
    target: np.ndarray | None,
    trust: Trust | None,
) -> _Lights:
    """given: the light before is; target: [9, 3] the new one, if it is given; trust: how far, None: not at all."""
    old, new = before.coefficients.copy(), np.empty((9, 3))
    # Luminance first: a channel that a material hardly has says little, and stays near it.
    fit_of = _fitter(surface, seen, before, given, target, trust)
    guess, luminance_fit, usable = fit_of(None, None)
    doubts = portable.solved(luminance_fit.precision, np.eye(17))[9:, 9:]
    for channel in range(3):
        level = max(float(_channel(before.coefficients, channel)[0]), 1e-6)
        fitted, _, usable = fit_of(channel, guess)
        old[1:, channel], new[:, channel] = fitted[:8] * level / SH_C0, fitted[8:] * level / SH_C0
    transfer = surface.transfer / SH_C0
    # Of light on sides that no picture shows nothing is known but what is usual: as doubted after as before. A given
    # light is known everywhere.
    certainty = np.ones(len(transfer), np.float32)
    if trust is None:
        slopes = transfer[:, 1:]
        after = (portable.matmul(slopes, doubts) * slopes).sum(1)
        usual = (slopes * slopes * PRIOR_STD * PRIOR_STD).sum(1)
        share = np.clip(1 - after / np.maximum(usual, 1e-9), 0, 1)
        # What pictures show counts as known, or they would not be met themselves: demo and narcissus, pictured view
        # +0.5 and +0.3 dB for -0.4 and +0.1 behind, after the figures below.
        share = np.minimum(share / max(float(np.median(share[usable])), 1e-9), 1)
        # Squared, as pictures are less sure than the fit believes: one of 19 assets in other views, dB: nothing 19.2
        # and 20.7 (clean, fitted), all of the light 19.6 and 20.8, by the share 19.7 and 21.2, squared 19.8 and 21.3.
        certainty = (share * share).astype(np.float32)
    return _Lights(replace(before, coefficients=old), new, certainty)


def _fitter(
    surface: LitSurface,
    seen: Witnesses,
    before: SourceLight,
    given: bool,
    target: np.ndarray | None,
    trust: Trust | None,
) -> Callable[[int | None, np.ndarray | None], tuple[np.ndarray, LightFit, np.ndarray]]:
    """Arguments as of `_fit_lights`. What it returns takes a channel (None: luminance) and the fit to luminance that a
    channel starts from, and gives ([17] as `_fit_channel`, the fit, [N] bool witnesses). Raises ValueError."""
    now, then, total = seen.now, seen.then, seen.pixels
    transfer = surface.transfer / SH_C0
    trusted = _trusted(surface, seen)
    if trusted.sum() < MIN_WITNESSES:
        raise ValueError(
            f"light: expected pictures that show at least {MIN_WITNESSES} Gaussians of a surface, got {trusted.sum()}"
        )
    # How far the estimate before may move: what it is doubted by at worst would let pictures of one side turn it.
    held = given or (trust is not None and trust.holds_before)
    doubt = 0.0 if held else min(max(STEADFAST * before.uncertainty, 0.05), 0.6)
    spread = np.concatenate([PRIOR_STD * doubt, [LEVEL_STD], PRIOR_STD]) + 1e-6

    def fit(channel: int | None, guess: np.ndarray | None) -> tuple[np.ndarray, LightFit, np.ndarray]:
        visible, pictured = (luminance(v) if channel is None else v[:, channel] for v in (now, then))
        start = _channel(before.coefficients, channel)
        level = max(float(start[0]), 1e-6)
        # Near black the ratio is noise, and what is clipped says only "at least".
        usable = trusted & (visible > DARK) & (pictured > DARK) & (now.max(1) < CLIPPED) & (then.max(1) < CLIPPED)
        if usable.sum() < MIN_WITNESSES:
            usable = trusted
        # The floor keeps dark Gaussians from ruling the fit: their ratios are the largest and the least sure.
        ratio = portable.log((pictured[usable] + RATIO_FLOOR) / (visible[usable] + RATIO_FLOOR))
        # In units of the old light's level, so that what is expected holds for any exposure.
        center = np.concatenate([start[1:] / level, [1.0], np.zeros(8)])
        deviation, shape = spread, np.zeros(8)
        if target is not None and trust is not None:
            given_light = _channel(target, channel)
            shape = given_light[1:] / max(float(given_light[0]), 1e-6)
            # By the median ratio, so that it is as loose for pictures of any exposure.
            reach = trust.deviation * _first_level(ratio)
            deviation = np.concatenate([spread[:9], np.full(8, reach)])
        elif guess is not None:
            center[8:] = guess[8:]
            deviation = np.concatenate([spread[:9], CHANNEL_STD * PRIOR_STD])
        brightness = visible[usable] / (visible[usable] + DIM)
        weights = np.minimum(total[usable], 1.0) * WITNESS_WEIGHT * brightness * brightness
        return *_fit_channel(transfer[usable], ratio, weights, center, shape, deviation), usable

    return fit


def _trusted(surface: LitSurface, seen: Witnesses) -> np.ndarray:
    """[N] bool. A Gaussian that faces both ways has two irradiances, and its ratio is that of neither."""
    return surface.facing.trusted & (seen.pixels > MIN_SHARE)


def _channel(coefficients: np.ndarray, channel: int | None) -> np.ndarray:
    """[9] of one channel, or of luminance, so that uniform light of radiance 1 has 1 in the first place."""
    return SH_C0 * (luminance(coefficients) if channel is None else coefficients[:, channel])


def _fit_channel(
    transfer: np.ndarray,
    ratio: np.ndarray,
    weights: np.ndarray,
    center: np.ndarray,
    shape: np.ndarray,
    deviation: np.ndarray,
) -> tuple[np.ndarray, LightFit]:
    """([17] bands 1 and 2 of the light before and all of the new one, over the mean of the light before, the fit).
    transfer: [M, 9] over that of an open surface under uniform light; ratio: [M] natural logarithms;
    weights: [M]; center, deviation: [17] what is expected; shape: [8] what the new light's bands are besides, over its
    own mean."""
    tied = np.eye(17)
    tied[9:, 8] = -shape
    scaled = tied / deviation[:, None]
    expected = portable.gram(scaled, np.ones(17))
    estimate, matrix, error, away = center.copy(), np.eye(17), ratio, np.zeros(17)
    # The median ratio starts it near the right level; Gauss-Newton on logarithms goes astray from far away.
    estimate[8] = _first_level(ratio)
    for _ in range(FIT_ROUNDS):
        old = transfer[:, 0] + portable.matmul(transfer[:, 1:], estimate[:8, None])[:, 0]
        new = portable.matmul(transfer, estimate[8:, None])[:, 0]
        low = MIN_LIGHT * max(float(estimate[8]), 0.1)
        dim, lit = np.maximum(old, MIN_LIGHT), np.maximum(new, low)
        error = ratio - portable.log(lit) + portable.log(dim)
        # The scale is the residuals' own, with a floor: a perfect fit would otherwise call its last errors outliers.
        noise = max(1.4826 * float(np.median(np.abs(error))), RATIO_NOISE)
        robust = weights * np.minimum(1, GIVEN.huber * noise / np.maximum(np.abs(error), 1e-9))
        # Where irradiance was held at its floor it does not depend on the light, so its slope is zero.
        before = -transfer[:, 1:] / dim[:, None] * (old > MIN_LIGHT)[:, None]
        after = transfer / lit[:, None] * (new > low)[:, None]
        jacobian = np.concatenate([before, after], 1)
        matrix = portable.gram(jacobian, robust) / noise**2
        # What is expected counts as one more observation of each band: bands that no Gaussian tells about stay there.
        matrix += expected
        right = portable.transposed_product(jacobian, (robust * error)[:, None])[:, 0] / noise**2
        away = (portable.matmul(tied, estimate[:, None])[:, 0] - center) / deviation
        right -= portable.transposed_product(scaled, away[:, None])[:, 0]
        estimate = estimate + 0.6 * portable.solved(matrix, right[:, None])[:, 0]
        estimate[8] = max(float(estimate[8]), 0.02)
    return estimate, LightFit(error, weights, float((away * away).sum()), deviation, matrix)


def _first_level(ratio: np.ndarray) -> float:
    """Of the new light over the old one's, by logarithms [M] of what is seen in it over what was seen."""
    return max(float(portable.exp(float(np.median(ratio)))), 0.02)


def _seen(splats: Splats, views: Sequence[Edit]) -> Witnesses:
    """What all views see of each Gaussian. Both looks are gathered alike, so that what covers it cancels."""
    sums = np.zeros((2, len(splats), 3))
    total = np.zeros(len(splats))
    for view in views:
        drawn = render(splats, view.camera)
        alphas = np.asarray(drawn.alphas)[0].reshape(view.image.shape[:2])
        # At silhouettes a pixel is partly background, of which an edited picture may show another.
        solid = (alphas > 0.9) & (np.ones_like(alphas, bool) if view.mask is None else view.mask)
        weight = solid.astype(np.float32)
        projected = project(splats, view.camera.within(splats.offset).local)
        for row, picture in enumerate((np.asarray(drawn.colors)[0][..., :3], view.image)):
            light = to_light(np.clip(picture, 0, 1), splats.color_space).astype(np.float32)
            gathered = projected.backproject(np.ascontiguousarray(light), weight)
            sums[row, projected.gaussian_ids] += gathered.values
            if row == 0:  # the weight is the view's, whatever is gathered
                total[projected.gaussian_ids] += gathered.weight
    level = np.maximum(total, 1e-9)[:, None]
    return Witnesses(sums[0] / level, sums[1] / level, total)


def _held_back(splats: Splats, edits: Sequence[Edit]) -> tuple[list[Edit], list[Edit]]:
    """(what is used, what judges): one half of the asset in each view, in turn the left and the right one. What lies
    between pixels that a picture shows would be no test of what it does not show."""
    used, judged = [], []
    for number, edit in enumerate(edits):
        alphas = np.asarray(render(splats, edit.camera).alphas)[0].reshape(edit.image.shape[:2])
        _, column = np.indices(alphas.shape)
        # The median column halves the asset's pixels, wherever it stands in the picture.
        middle = np.median(column[alphas > 0.5]) if (alphas > 0.5).any() else edit.camera.width / 2
        half = (column < middle) == (number % 2 == 0)
        used.append(_masked(edit, alphas, half))
        judged.append(_masked(edit, alphas, ~half))
    return used, judged


def _masked(edit: Edit, alphas: np.ndarray, part: np.ndarray) -> Edit:
    mask = (alphas > 0.5) & part if edit.mask is None else (alphas > 0.5) & part & edit.mask
    return replace(edit, mask=mask)


def _score(splats: Splats, views: Sequence[Edit]) -> float:
    squares, count = 0.0, 0
    for view in views:
        assert view.mask is not None
        error = np.asarray(render(splats, view.camera).colors)[0][..., :3].clip(0, 1) - view.image
        squares += float(portable.total(error[view.mask].astype(np.float64) ** 2))
        count += 3 * int(view.mask.sum())
    return float(-10 * portable.log(max(squares / max(count, 1), 1e-8)) / portable.log(10.0))
