"""Fits LEARNT of `lift/local/close_up_colors.py`: how much more of a close-up's own each Gaussian takes, and how far it
goes back to its colour before the edit.

Close-ups of the truth at two to four times the asset's scale, of training meshes (sampled, or fitted by 3DGS) and of
captures whose Gaussians are merged in voxels, so that the capture itself is the truth. A picture is linear in what the
14 numbers add, so what novel views of the truth say of them is a quadratic form, made once for each close-up by drawing
the effect of each number alone. Ridge regression on the sum of these; eight views near the close-up, four of the whole
object, and the close-up itself count. Printed: the numbers, and what novel close-ups / the whole object / the edited
view of held-out objects gain by them and by the stored ones, dB, with 95 % bootstrap intervals over close-ups.

Run: python scripts/calibrate/close_up_colors.py DATA CACHE [--count 60] [--judged 29]

DATA: a folder with meshes/, splats/, hdris/, decals/, fonts/, textures/. CACHE: keeps the close-ups; what it holds is
not made again. Five minutes of one core, 20 seconds with --count 4 --judged 2. Needs `pip install ./train`.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from splatpainter import io
from splatpainter.cameras import Camera
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.local.close_up_colors import LEARNT, gaussian_features, sharpened, ways_of_change
from splatpainter.lift.local.wide_edit import soft_lift
from splatpainter.lift.options import LOCAL_DEFAULTS
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import SH_C0, Splats
from splatpainter.transforms import matrix_to_quat, principal_axes, quat_to_matrix
from splattrain import recipes
from splattrain.data import edit_samples, viewpoints
from splattrain.data.edit_samples import SampleSpec
from splattrain.data.object_sources import HELD_OUT_SHARE
from splattrain.data.painted_gaussians import PaintedAssetKind
from splattrain.data.viewpoints import Optics
from splattrain.training_data import DataSettings, ResourceFolders, painted_gaussian_streams

RIDGE = 1.0
"""Added to the diagonal, of itself. Left-out training objects near, dB, with 0.03, 0.3, 1 and 3: clean 0.082, 0.078,
0.077, 0.072, fitted 0.036, 0.047, 0.055, 0.057, captures 0.092, 0.086, 0.082, 0.073."""
COUNTS = {"near": 1.0, "whole": 1.0, "edited": 0.2}
"""What the views of each kind count, by what they gain in dB: their squared error is over that before."""
NovelViews = tuple[Sequence[Camera], np.ndarray, np.ndarray]
"""(V cameras, [V, H, W, 3] float16 colours of the truth, [V, H, W] bool pixels that count)."""
Form = tuple[np.ndarray, np.ndarray, float]
"""([14, 14] c, [14] g, e): the mean squared error of some views, e - 2 g t + t c t of the numbers t [14]."""
LEAST_ERROR = 1e-4
"""Added to squared errors before: 40 dB are enough."""
CAPTURES = (
    {"massa.ply": 6, "biker.v4.spz": 6, "playbot_lod4_sh3.ply": 6},
    {"angel.sog": 4, "narcissus.sog": 4, "st-peter.sog": 4},
)
"""To learn from, to judge by: file -> close-ups of it."""
CELLS_PER_RADIUS = 45
"""Of the voxels in which a capture's Gaussians are merged: 6,000 to 13,000 Gaussians are left."""
FILLED = (0.2, 1.0)
"""Share of a picture that the object fills."""
THIN_EVERY, THIN_FILLED = 5, (0.15, 0.4)
"""Of every fifth object close-ups count that it fills less: thin objects are edited so."""
TRIES, MIN_PIXELS = 16, 100


@dataclass(frozen=True)
class Config:
    """What the numbers are fitted on."""

    data: Annotated[Path, tyro.conf.Positional]
    cache: Annotated[Path, tyro.conf.Positional]
    count: int = 60
    """Training meshes: sampled and fitted in turn, two close-ups each. Fewer than 20: without captures."""
    judged: int = 29
    """Held-out meshes, one close-up sampled and one fitted."""


@dataclass(frozen=True)
class CloseUp:
    """One close-up of the truth, and how the truth looks from elsewhere."""

    kind: str
    asset: Splats
    view: EditView
    training: list[NovelViews]
    """Near, and of the whole object; so are `judged`, others."""
    judged: list[NovelViews]


def main(config: Config) -> None:
    config.cache.mkdir(parents=True, exist_ok=True)
    forms = [made for one in close_ups(config, held_out=False) if (made := forms_of(one))]
    numbers = np.round(fitted(forms), 3)
    print(f"{len(forms)} close-ups\nLEARNT = {tuple(map(tuple, numbers.tolist()))}")
    print(f"largest difference from the stored ones: {np.abs(numbers - np.array(LEARNT)).max():.3f}", flush=True)
    judge(close_ups(config, held_out=True), numbers)


def close_ups(config: Config, *, held_out: bool) -> Iterator[CloseUp]:
    """Made where the cache does not have them."""
    recipe = recipes.load("paint", "rows")
    folders = ResourceFolders(*(config.data / name for name in ("hdris", "decals", "fonts", "textures")))
    settings = DataSettings(str(config.data / "meshes"), recipe.samples, recipe.seed, HELD_OUT_SHARE, folders)
    stream: Any = painted_gaussian_streams(settings, None, 1)[held_out]
    count, part = (config.judged, "judged") if held_out else (config.count, "training")
    order = np.arange(len(stream.source)) if held_out else np.random.default_rng(5).permutation(len(stream.source))
    kinds: tuple[PaintedAssetKind, ...] = ("coarse", "fitted")
    for n, i in enumerate(order[:count].tolist()):
        filled = THIN_FILLED if not held_out and n % THIN_EVERY == THIN_EVERY - 1 else FILLED
        for kind in kinds if held_out else (kinds[n % 2],):
            make = partial(of_mesh, stream, i, kind, [n, held_out, kinds.index(kind)], 1 if held_out else 2, filled)
            yield from cached(config.cache / f"{part}-{kind}-{n:03d}.pkl", make)
    for name, many in CAPTURES[held_out].items() if config.count >= 20 else ():
        make = partial(of_capture, config.data / "splats" / name, many)
        yield from cached(config.cache / f"{part}-{name}.pkl", make)


def cached(path: Path, make: Callable[[], list[CloseUp]]) -> list[CloseUp]:
    """Those of one asset, kept; none where it raises ValueError: an object of which nothing can be made."""
    if not path.is_file():
        try:
            made = make()
        except ValueError as error:
            print(f"{path.stem} left out: {error}", file=sys.stderr)
            made = []
        path.write_bytes(pickle.dumps(made))
        print(path.stem, *(f"{one.view.mask.mean():.2f}" for one in made), "filled", file=sys.stderr, flush=True)
    return pickle.loads(path.read_bytes())


def of_mesh(stream: Any, i: int, kind: PaintedAssetKind, seed: list[int], many: int, filled: tuple) -> list[CloseUp]:
    rng, found = np.random.default_rng(seed), []
    scene = stream.scene_of(i, kind, rng).scene
    for attempt in range(many * TRIES):
        sample = edit_samples.zoom(scene, SampleSpec(stream.recipe, 1, 1 - attempt / (many * TRIES)), rng)
        if len(found) == many:
            break
        if sample is None or not filled[0] < sample.masks[0].mean() <= filled[1]:
            continue
        camera, picture = sample.edited.cameras[0], sample.edited.colors[0].numpy()
        around = viewpoints.ring(scene.object.radius, scene.optics, 8, rng)
        found += seen(
            "clean" if kind == "coarse" else kind,
            scene.asset,
            scene.truth,
            camera,
            picture,
            sample.masks[0],
            around,
            rng,
        )
    return found


def of_capture(path: Path, many: int) -> list[CloseUp]:
    truth = io.read(path).numpy()
    low, high = np.percentile(truth.means, (2, 98), axis=0)
    radius = float(np.linalg.norm(high - low) / 2)
    truth = replace(truth, means=(truth.means - (low + high) / 2).astype(np.float32))
    truth = truth.take(np.flatnonzero(truth.opacities > 0.005))
    asset = merged(truth, radius / CELLS_PER_RADIUS)
    rng, found, optics = np.random.default_rng([9, many]), [], Optics(160)
    for _ in range(many * TRIES):
        if len(found) == many:
            break
        overview = viewpoints.object_camera(radius, optics, rng.uniform(0, 360), rng.uniform(0, 40))
        drawn = render(truth, overview)
        y, x = np.nonzero(np.asarray(drawn.alphas)[0, ..., 0] > 0.8)
        if len(y) < MIN_PIXELS:
            continue
        depth, j = np.asarray(drawn.depths)[0].reshape(optics.size, optics.size), int(rng.integers(len(y)))
        target = overview.unproject(depth[y[j : j + 1], x[j]], np.array([[x[j], y[j]]]) + 0.5)[0]
        camera = viewpoints.crop(overview, target, rng.uniform(2, 4))
        _, (picture,), (mask,) = novel_views(truth, [camera])
        if FILLED[0] < mask.mean() <= FILLED[1]:
            around = viewpoints.ring(radius, optics, 8, rng)
            found += seen("captures", asset, truth, camera, picture, mask, around, rng)
    return found


def seen(kind: str, asset: Splats, truth: Any, camera: Camera, picture, mask, around, rng) -> list[CloseUp]:
    """[close-up]; [] where hardly a pixel of it is the asset's."""
    (view,) = edit_views(asset, [camera], [picture], [mask])
    assert view.depth is not None and view.alpha is not None
    y, x = np.nonzero(view.mask & (view.alpha > 0.5))
    if len(y) < MIN_PIXELS:
        return []
    j = int(np.argmin((x - x.mean()) ** 2 + (y - y.mean()) ** 2))  # a place on it near the middle
    target = camera.unproject(view.depth[y[j : j + 1], x[j]], np.array([[x[j], y[j]]]) + 0.5)[0]
    near = [viewpoints.neighbour(camera, target, rng, (8, 45)) for _ in range(8)]
    others = [viewpoints.neighbour(camera, target, rng, (15, 40)) for _ in range(4)]
    pairs = (near, around[:4]), (others, around[4:])
    training, judged = ([novel_views(truth, some) for some in pair] for pair in pairs)
    return [CloseUp(kind, asset, replace(view, projected=None), training, judged)]


def merged(splats: Splats, edge: float) -> Splats:
    """One Gaussian for those of each voxel, `edge` world units wide: their moments, weighed by opacity and area."""
    turns, squares = quat_to_matrix(splats.quats.astype(np.float64)), splats.scales.astype(np.float64) ** 2
    cell = np.unique(np.floor(splats.means / edge).astype(np.int64), axis=0, return_inverse=True)[1].ravel()

    weight = splats.opacities * np.sort(splats.scales, 1)[:, 1:].astype(np.float64).prod(1) + 1e-12
    total = np.bincount(cell, weight)

    def mean(values: np.ndarray) -> np.ndarray:
        columns = values.reshape(len(values), -1).T
        sums = np.stack([np.bincount(cell, weight * column) for column in columns], 1) / total[:, None]
        return sums.reshape(len(total), *values.shape[1:])

    means = mean(splats.means.astype(np.float64))
    off = splats.means - means[cell]
    inside = np.einsum("nij,nj,nkj->nik", turns, squares, turns)
    variances, axes = principal_axes(mean(inside + off[:, :, None] * off[:, None, :]))
    scales = np.sqrt(np.maximum(variances, 1e-14))
    opacities = np.minimum(total / np.maximum(scales[:, 1] * scales[:, 2], 1e-12), 0.95)
    arrays = means, matrix_to_quat(axes), scales, opacities, mean(splats.sh)
    return Splats(*(values.astype(np.float32) for values in arrays), antialiased=splats.antialiased)


def novel_views(splats: Any, cameras: Sequence[Camera]) -> NovelViews:
    drawn = render(splats, list(cameras))
    colors = np.clip(np.asarray(drawn.colors), 0, 1).astype(np.float16)
    return cameras, colors, np.asarray(drawn.alphas)[..., 0] > 0.5


def forms_of(close_up: CloseUp) -> list[Form] | None:
    """In the order of COUNTS, of what the numbers add to the lift; None where no Gaussian was moved."""
    view = close_up.view
    lifted, shown = soft_lift(close_up.asset, [view], LOCAL_DEFAULTS)
    if shown is None:
        return None
    ids = np.flatnonzero(shown.movable)
    facts, ways = gaussian_features(lifted.splats, [view], ids), ways_of_change(lifted.splats, shown, ids)
    changes = np.zeros((14, len(lifted.splats), 3), np.float32)
    changes[:, ids] = SH_C0 * np.concatenate([facts.T[:, :, None] * way for way in ways])
    views = *close_up.training, ([view.camera], view.target[None], view.mask[None])
    return [form_of(lifted.splats, changes, some) for some in views]


def form_of(splats: Splats, changes: np.ndarray, views: NovelViews) -> Form:
    """changes: [14, N, 3] of the colours."""
    curvature, gain, error = np.zeros((14, 14)), np.zeros(14), 0.0
    for camera, color, solid in zip(*views, strict=True):
        left = (color.astype(np.float32) - project(splats, camera).rasterize()[0])[solid].ravel().astype(np.float64)
        dark = project(splats, replace(camera, background=(0.0, 0.0, 0.0)))
        drawn = [dark.rasterize(change[dark.gaussian_ids])[0][solid].ravel() for change in changes]
        effects = np.stack(drawn).astype(np.float64)
        curvature, gain, error = curvature + effects @ effects.T, gain + effects @ left, error + left @ left
    pixels = 3 * views[2].sum()
    return curvature / pixels, gain / pixels, float(error / pixels)


def fitted(close_ups: Sequence[list[Form]]) -> np.ndarray:
    """[2, 7] numbers of LEARNT."""
    curvature, gain = np.zeros((14, 14)), np.zeros(14)
    for forms in close_ups:
        for count, (curve, slope, error) in zip(COUNTS.values(), forms, strict=True):
            weight = count / (error + LEAST_ERROR) / len(close_ups)
            curvature, gain = curvature + weight * curve, gain + weight * slope
    ridge = RIDGE * np.diag(np.diag(curvature)) + 1e-9 * np.eye(14)
    return np.linalg.solve(curvature + ridge, gain).reshape(2, 7)


def judge(close_ups: Iterable[CloseUp], numbers: np.ndarray) -> None:
    found: dict[str, list[list[list[float]]]] = {}
    for one in close_ups:
        lifted, shown = soft_lift(one.asset, [one.view], LOCAL_DEFAULTS)
        soft = lifted.splats
        sharp = [replace(soft, sh=sharpened(soft, shown, way)) if shown else soft for way in (LEARNT, numbers.tolist())]
        found.setdefault(one.kind, []).append([decibels(one, splats) for splats in (one.asset, soft, *sharp)])
    print(f"PSNR, dB, of {' / '.join(COUNTS)}")
    for kind, values in found.items():
        scores = np.array(values)
        drawn = np.random.default_rng(0).choice(len(scores), (4000, len(scores)))
        for k, name in enumerate(("nothing", "before", "stored", "fitted here")):
            gains = scores[:, k] - scores[:, 1]
            low, high = np.percentile(gains[drawn].mean(1), (2.5, 97.5), axis=0)
            parts = (f"{m:+.3f} ({a:+.3f} to {b:+.3f})" for m, a, b in zip(gains.mean(0), low, high, strict=True))
            line = " / ".join(f"{mean:.2f}" for mean in scores[:, k].mean(0))
            print(f"{kind} ({len(scores)}), {name}: {line}" + ("; over before " + ", ".join(parts) if k > 1 else ""))


def decibels(close_up: CloseUp, splats: Splats) -> list[float]:
    """PSNR of COUNTS."""
    view, errors = close_up.view, []
    for cameras, colors, solid in (*close_up.judged, ([view.camera], view.edited[None], view.mask[None])):
        drawn = np.clip(np.asarray(render(splats, list(cameras)).colors), 0, 1)
        errors.append(np.square(drawn - colors.astype(np.float32))[solid].mean())
    return (-10 * np.log10(np.maximum(errors, 1e-9))).tolist()


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
