"""`bench light`: an asset that was made in one environment, lit by another, against how the object looks there.

Truth is path traced (or, quicker, dense surfels); assets are coarse surfels of the truth (clean geometry) and fitted by
3DGS to views in the first light. Methods know both environments, but for those that estimate the first. PSNR is over
the object in novel views; specks are pixels that are much darker or lighter than those around them where the truth is
smooth, which PSNR hardly sees.

The truth has the noise of its paths, which no method can know. So it is path traced twice: the product of the errors to
both has no noise in the mean, and `noiseless` is what rows are to be compared by. Where both traces differ by specks,
and so would an asset that is fitted to such views, it is traced with more paths (`quiet_truth`). More are not needed:
with 16 times as many (1,024; one object 4,096) the gains of 12 fitted held-out assets, 2.36 dB estimated and 4.11
with the true source, become 2.45 and 4.28, on their way to the 2.48 and 4.32 that `noiseless` has without them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro.conf import Positional, arg

from splatbench.cases import Setup, check_options
from splatbench.ground_truth import GroundTruth, build_asset
from splatbench.objects import drawn_lights, environments, generator, objects
from splatbench.painted import lpips_weights
from splatbench.painted_cases import SOURCES, AssetKind
from splatbench.quiet_truth import SPECK_STEP, inside, quiet_views
from splatbench.scoring import compared
from splatbench.timing import machine
from splatpainter import text_tables as tables
from splatpainter.cameras import Camera
from splatpainter.color import base_color, linear_to_srgb, luminance, sh_from_color, to_light
from splatpainter.contact_sheet import Strip, sheet, write_sheet
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.prepared import captured_light, lit_surface
from splatpainter.lights.relight import delight, transfer
from splatpainter.lights.source_light import SourceLight
from splatpainter.splats import SH_C0, Splats
from splattrain.data.object_sources import split

MAX_TRUTH_SPECKS = 0.05
"""Share of specks in a truth that can judge: its texture's, or those of faces that lie on each other, as noise is
traced away."""
CELL_PX = 150
ROWS = (
    "nothing",
    "gain of the lights",
    "affine, other views",
    "affine",
    "no visibility",
    "albedo",
    "true source",
    "ours",
    "ours, true normals",
)
LOST = ("gain of the lights", "affine, other views", "affine", "no visibility", "albedo")
"""Rows that say nothing of the albedo."""
NOTES = (
    "`nothing`: the asset as it is. `gain of the lights`: one gain per channel, the mean of the second light over that "
    "of the first. `affine`: gain and offset per channel of linear colours that fit the truth best (an upper bound of "
    "what needs no light); `affine, other views`: fitted to the truth of the other novel views. `no visibility`, "
    "`true source`: the ratio of both true lights, without and with what the asset hides. `albedo`: colour over "
    "irradiance of the true first light, clamped to 0..1, times the second's, as other programs do. `ours`: the first "
    "light estimated. `ours, true normals`: with those of the mesh. Columns are dB over the object in novel views; "
    "`lpips`: LPIPS-Alex of its window; `albedo`: the first light taken out, dB to the albedo in linear light with the "
    "best gain per channel; `specks`: pixels in 10,000 of the object; `noiseless`: dB without the noise of the truth's "
    "paths, which is what rows are to be compared by; `noiseless_gain_error`: the standard error of its gain over "
    "`nothing`, of objects taken at random.",
)


@dataclass(frozen=True)
class LightBench:
    """Light held-out meshes anew and compare with how they look in that light.

    example:
      splatpainter bench light meshes/ --environments hdris/ --objects 6 --out out/bench-light
    """

    meshes: Annotated[Positional[Path | None], arg(metavar="MESHES", help_behavior_hint="")] = None
    """Folder of meshes; only those held out (by name) are used. None: procedural objects."""
    assets: Literal["both", "coarse", "fitted"] = "both"
    """coarse: surfels of the truth; fitted: by 3DGS to views of it."""
    objects: int = 6
    """How many objects to measure."""
    truth: Literal["traced", "surfels"] = "traced"
    """traced: by Mitsuba; surfels: of dense Gaussians, in seconds, with approximate light."""
    samples: int = 32
    """Paths per pixel of path-traced truth; up to 16 times as many where they leave specks."""
    size: int = 128
    """Edge of the pictures, pixels."""
    rows: int = 12_000
    """Gaussians of every asset."""
    novel_views: int = 4
    """Novel views, from all around."""
    environments: Path | None = None
    """Folder of HDRIs; none: procedural light."""
    perceptual_weights: Path | None = None
    """Folder of the LPIPS weights; default: that of SPLATPAINTER_PERCEPTUAL; without them no LPIPS."""
    tuning: bool = False
    """Take the meshes that settings were tuned on instead of those that are held out."""
    seed: int = 0
    """Seed of objects and lights."""
    out: Path = Path("out/bench-light")
    """Folder for light.csv (a line per object, asset and row), light.md and sheet.png; made if missing."""


@dataclass(frozen=True)
class LightCase:
    """One asset in one new light; lights are SH [9, 3] in its axes, exposed."""

    name: str
    kind: AssetKind
    asset: Splats = field(repr=False)
    before: np.ndarray = field(repr=False)
    after: np.ndarray = field(repr=False)
    cameras: tuple[Camera, ...]
    truth: np.ndarray = field(repr=False)
    """[W, H, W, 3] display colours in the new light."""
    masks: np.ndarray = field(repr=False)
    """[W, H, W] bool the object."""
    surface: tuple[np.ndarray, np.ndarray] = field(repr=False)
    """([S, 3] points of the mesh, [S, 3] their normals)."""
    albedo: np.ndarray = field(repr=False)
    """[W, H, W, 3] display colours of the base colours, without any light."""
    again: np.ndarray = field(repr=False)
    """[W, H, W, 3] the truth with noise of its own."""
    paths: tuple[int, int] = (0, 0)
    """Per pixel of the views that the asset is made of, and of the truth."""


@dataclass(frozen=True)
class LightScore:
    """One row on one case."""

    object: str
    asset: str
    row: str
    psnr: float
    noiseless: float
    lpips: float | None
    albedo: float | None
    specks: float
    seconds: float
    asset_paths: int = 0
    """Per pixel of the views that the asset is made of."""
    truth_paths: int = 0
    """Per pixel of the truth."""


@dataclass(frozen=True)
class LightMeans:
    """Means over objects."""

    asset: str
    row: str
    objects: int
    psnr: float
    gain: float
    worst_gain: float
    noiseless: float
    noiseless_gain: float
    noiseless_gain_error: float | None
    """Its standard error; None of one object."""
    lpips: float | None
    albedo: float | None
    specks: float
    seconds: float


def run(config: LightBench, report: Callable[[str], None] | None = None) -> list[LightMeans]:
    """Measure every object; write light.csv, light.md and sheet.png; return the means. report: called with a line per
    case. Raises ValueError for options that make no sense, and for data that is not there."""
    check_options("light", config, ("meshes", "environments", "perceptual_weights"))
    where = machine()
    config.out.mkdir(parents=True, exist_ok=True)
    scores: list[LightScore] = []
    strips: list[Strip] = []
    perceptual = lpips_weights(config.perceptual_weights)
    left_out: list[str] = []
    for case in cases(config, report, left_out):
        lines, pictures = measure_case(case, perceptual)
        scores += lines
        strips += pictures
        if report:
            listed = ", ".join(f"{line.row} {line.psnr:.1f}" for line in lines)
            report(f"{case.name}, {case.kind}: {listed}")
        tables.write_csv(config.out / "light.csv", scores, where)
    if not scores:
        raise ValueError("bench light: none of the objects can be seen; take more objects")
    means = mean_scores(scores)
    write_sheet(config.out / "sheet.png", sheet(strips, CELL_PX, where))
    tables.write_markdown(config.out / "light.md", means, where, (*NOTES, *_about_truth(scores, left_out)))
    return means


def _about_truth(scores: Sequence[LightScore], left_out: Sequence[str]) -> tuple[str, ...]:
    """Lines for the table: how many objects it leaves out and why, how many paths its truths took."""
    traced = {score.object: max(score.asset_paths, score.truth_paths) for score in scores}
    counts = [f"{list(traced.values()).count(paths)} with {paths}" for paths in sorted(set(traced.values())) if paths]
    lines = (f"Objects by paths per pixel: {', '.join(counts)}.",) if counts else ()
    return (*lines, f"Objects left out: {len(left_out)}{''.join(f'; {line}' for line in left_out)}.")


def cases(
    config: LightBench, report: Callable[[str], None] | None = None, left_out: list[str] | None = None
) -> Iterator[LightCase]:
    """Objects that cannot be read or seen, or whose truth cannot judge, are left out: a line of each to `report` and to
    `left_out`."""
    setup = Setup(
        data=config.meshes,
        environments=config.environments,
        objects=2 * config.objects,
        held_out=not config.tuning,
        size=config.size,
        detail=1,
        samples=config.samples,
        truth=config.truth,
        rows=config.rows,
        asset_steps=150,
        novel_views=config.novel_views,
        lights=1,
        seed=config.seed,
    )
    kinds: tuple[AssetKind, ...] = ("coarse", "fitted") if config.assets == "both" else (config.assets,)
    names = environments(setup).names
    if len(names) < 2:
        raise ValueError(f"bench light: expected at least two environments, got {len(names)}")
    made = 0
    for name in object_names(config, setup):
        if made >= config.objects:
            return
        try:
            yield from _cases_of(name, drawn_lights(names, name, 2, config.seed), setup, kinds)
        except ValueError as error:
            if left_out is not None:
                left_out.append(f"{name}: {error}")
            if report:
                report(f"{name}: left out, {error}")
            continue
        made += 1


def object_names(config: LightBench, setup: Setup) -> tuple[str, ...]:
    """Twice as many as are wanted, as some cannot be used: of those held out, or with `tuning` of the others alone."""
    names = objects(setup).names
    return tuple(split(names)[0]) if config.tuning and config.meshes is not None else names


def _cases_of(name: str, lights: Sequence[str], setup: Setup, kinds: Sequence[AssetKind]) -> Iterator[LightCase]:
    truth = GroundTruth.load(name, lights[0], setup)
    relit = truth.under(lights[1])
    rng = generator(setup.seed, "light", name)
    base_cameras, novel = truth.ring(setup.base_views, rng), truth.ring(setup.novel_views, rng)
    quiet = quiet_views(relit, novel, "novel")
    after = quiet.views
    if not after.masks.any():
        raise ValueError("nothing of it can be seen")
    share = _speckled(after.images.colors, after.masks)
    if share > MAX_TRUTH_SPECKS:
        raise ValueError(f"{share:.0%} of its truth are specks: fine texture, or faces that lie on each other")
    # The asset is to have no specks but those of its making.
    base = quiet_views(truth, base_cameras, "base")
    paths = (base.samples, quiet.samples) if truth.surfels is None else (0, 0)
    for kind in kinds:
        yield LightCase(
            name,
            kind,
            build_asset(truth, base.views, SOURCES[kind]).splats,
            _coefficients(truth),
            _coefficients(relit),
            tuple(novel),
            after.images.colors,
            after.masks,
            _surface_of(truth),
            _albedo_of(truth, novel),
            quiet.again.images.colors,
            paths,
        )


def _coefficients(truth: GroundTruth) -> np.ndarray:
    return (truth.light.coefficients * truth.light.exposure).numpy().astype(np.float64)


def _surface_of(truth: GroundTruth) -> tuple[np.ndarray, np.ndarray]:
    from splattrain.data.surfels import sample_surfels

    surfels = sample_surfels(truth.mesh, 4 * truth.setup.rows, truth.setup.seed)
    return surfels.means.numpy(), surfels.normals.numpy()


def _albedo_of(truth: GroundTruth, cameras: Sequence[Camera]) -> np.ndarray:
    from splatpainter.rendering import render
    from splattrain.data.surfels import sample_surfels, to_splats

    surfels = sample_surfels(truth.mesh, 12 * truth.setup.rows, truth.setup.seed)
    colors = linear_to_srgb(surfels.albedo.numpy())[:, None]
    flat = to_splats(surfels, surfels.albedo.new_tensor(sh_from_color(colors)))
    return np.clip(np.asarray(render(flat.numpy(), list(cameras)).colors)[..., :3], 0, 1)


def measure_case(case: LightCase, perceptual: Any | None = None) -> tuple[list[LightScore], list[Strip]]:
    """A line per row, and the rows of the contact sheet, the truth's first."""
    lines, strips = [], [Strip(f"{case.name}, {case.kind}: the truth", _cells(case.truth))]
    for row in ROWS:
        start = time.process_time()
        if row == "affine, other views":
            views = _affine_by_rest(case)
            seconds = time.process_time() - start
        else:
            edited = lit_by(row, case)
            seconds = time.process_time() - start
            views = _drawn(edited, case.cameras)
        near = compared(views, case.truth, case.masks, perceptual)["lpips"] if perceptual else None
        figures = psnr(views, case), noiseless_psnr(views, case), near, albedo_psnr(row, case), specks(views, case)
        line = LightScore(case.name, case.kind, row, *figures, seconds, *case.paths)
        lines.append(line)
        strips.append(Strip(f"{row}: {line.psnr:.1f} dB, specks {line.specks:.0f}", _cells(views)))
    return lines, strips


def lit_by(row: str, case: LightCase) -> Splats:
    """The asset in the new light by one of ROWS."""
    given = SourceLight(case.before, 0.0, "true")
    if row == "nothing":
        return case.asset
    if row == "gain of the lights":
        light = to_light(base_color(case.asset.sh), case.asset.color_space)
        return _recolored(case.asset, light * (case.after[0] / case.before[0]))
    if row.startswith("affine"):
        return _best_affine(case, range(len(case.cameras)))
    if row == "no visibility":
        return transfer(case.asset, given, case.after, shadows=False).splats
    if row == "albedo":
        return _by_albedo(case)
    if row == "true source":
        return transfer(case.asset, given, case.after).splats
    level = float(case.before[0].mean()) * SH_C0
    surface = _with_true_normals(case) if row == "ours, true normals" else None
    return transfer(case.asset, captured_light(case.asset, up="+y"), case.after / level, surface=surface).splats


def flat_by(row: str, case: LightCase) -> Splats | None:
    """The asset without its first light, as a row that says something of the albedo has it."""
    if row in LOST:
        return None
    if row == "nothing":
        return case.asset
    source = SourceLight(case.before, 0.0, "true") if row == "true source" else None
    surface = _with_true_normals(case) if row == "ours, true normals" else None
    return delight(case.asset, source=source, up="+y", surface=surface).splats


def albedo_psnr(row: str, case: LightCase) -> float | None:
    """dB of the asset without its light to the albedo, in linear light and up to a gain per channel, as the level and
    colour of light and material cannot be told apart; mean of the novel views. None where the row has no albedo."""
    from splatpainter.color import srgb_to_linear

    flat = flat_by(row, case)
    if flat is None:
        return None
    views, truth = (srgb_to_linear(v)[case.masks].astype(np.float64) for v in (_drawn(flat, case.cameras), case.albedo))
    gain = (views * truth).sum(0) / np.maximum((views * views).sum(0), 1e-12)
    return float(-10 * np.log10(max(float(((gain * views - truth) ** 2).mean()), 1e-8)))


def psnr(views: np.ndarray, case: LightCase) -> float:
    """dB over the object, mean of the novel views."""
    return _mean_psnr(views, case, case.truth)


def noiseless_psnr(views: np.ndarray, case: LightCase) -> float:
    """The same without the noise of the truth: errors to two truths whose noise is independent, multiplied, are in the
    mean the square of the error to what they are the mean of."""
    return _mean_psnr(views, case, case.again)


def _mean_psnr(views: np.ndarray, case: LightCase, other: np.ndarray) -> float:
    """dB by the product of the errors to the truth and to another one, over the object; mean of the novel views."""
    values = []
    for view, truth, again, mask in zip(views, case.truth, other, case.masks, strict=True):
        if mask.any():
            drawn = view[mask].astype(np.float64)
            error = float(((drawn - truth[mask]) * (drawn - again[mask])).mean())
            values.append(-10 * np.log10(max(error, 1e-8)))
    return float(np.mean(values))


def specks(views: np.ndarray, case: LightCase) -> float:
    """Pixels in 10,000 of the object's inside."""
    count = total = 0
    for view, truth, mask in zip(views, case.truth, case.masks, strict=True):
        middle = inside(mask)
        step = np.abs(_beyond_median(view)) - np.abs(_beyond_median(truth))
        count += int((step[middle] > SPECK_STEP).sum())
        total += int(middle.sum())
    return 1e4 * count / max(total, 1)


def _speckled(views: np.ndarray, masks: np.ndarray) -> float:
    """Share of pixels inside the object that differ by a speck's step from those around them."""
    steps = [np.abs(_beyond_median(view))[inside(mask)] for view, mask in zip(views, masks, strict=True)]
    every = np.concatenate(steps)
    return float((every > SPECK_STEP).mean()) if every.size else 0.0


def _beyond_median(view: np.ndarray) -> np.ndarray:
    """[H, W] luminance less the median of the nine pixels around."""
    light = luminance(view.astype(np.float64))
    padded = np.pad(light, 1, mode="edge")
    height, width = light.shape
    around = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    return light - np.median(around, axis=0)


def _best_affine(case: LightCase, views: Sequence[int]) -> Splats:
    """Fitted in linear light to the truth of some of the novel views."""
    from splatpainter.color import srgb_to_linear

    chosen = list(views)
    masks = case.masks[chosen]
    drawn = srgb_to_linear(_drawn(case.asset, [case.cameras[k] for k in chosen]))[masks]
    truth = srgb_to_linear(case.truth[chosen])[masks]
    light = to_light(base_color(case.asset.sh), case.asset.color_space)
    out = np.empty_like(light)
    for channel in range(3):
        gain, offset = np.polyfit(drawn[:, channel], truth[:, channel], 1)
        out[:, channel] = gain * light[:, channel] + offset
    return _recolored(case.asset, out)


def _affine_by_rest(case: LightCase) -> np.ndarray:
    """[W, H, W, 3] each novel view by what fits the others best."""
    count = len(case.cameras)
    views = []
    for k in range(count):
        rest = [other for other in range(count) if other != k and case.masks[other].any()] or [k]
        views.append(_drawn(_best_affine(case, rest), [case.cameras[k]])[0])
    return np.stack(views)


def _by_albedo(case: LightCase) -> Splats:
    surface = lit_surface(case.asset, shadows=False)
    light = to_light(base_color(case.asset.sh), case.asset.color_space)
    albedo = np.clip(light / np.maximum(surface.from_sky(case.before), 1e-2), 0, 1)
    return _recolored(case.asset, albedo * surface.from_sky(case.after))


def _recolored(splats: Splats, light: np.ndarray) -> Splats:
    """With linear base colours [N, 3]; higher bands go along by the display colour's gain."""
    display = linear_to_srgb(np.clip(light, 0, None))
    before = np.maximum(base_color(splats.sh), 0.05)
    sh = splats.sh * np.clip(display / before, 0, 4)[:, None].astype(np.float32)
    sh[:, 0] = sh_from_color(display)
    return replace(splats, sh=sh.astype(np.float32))


def _with_true_normals(case: LightCase) -> LitSurface:
    """The asset's surface with the normals of the mesh's nearest points."""
    from scipy.spatial import KDTree

    points, normals = case.surface
    _, nearest = KDTree(points).query(case.asset.means)
    sides = lit_surface(case.asset).facing
    sides = replace(sides, normals=normals[nearest].astype(np.float32), front=np.ones_like(sides.front))
    return LitSurface.of(case.asset, sides=sides)


def _drawn(splats: Splats, cameras: Sequence[Camera]) -> np.ndarray:
    from splatpainter.rendering import render

    return np.clip(np.asarray(render(splats, list(cameras)).colors)[..., :3], 0, 1)


def _cells(views: np.ndarray) -> tuple[tuple[str, np.ndarray], ...]:
    return tuple((f"novel view {k + 1}", view) for k, view in enumerate(views))


def mean_scores(scores: Sequence[LightScore]) -> list[LightMeans]:
    """A line per kind of asset and row."""
    out = []
    for kind in dict.fromkeys(score.asset for score in scores):
        base = {s.object: s for s in scores if s.asset == kind and s.row == "nothing"}
        for row in dict.fromkeys(score.row for score in scores):
            group = [score for score in scores if score.asset == kind and score.row == row]
            gains = [score.psnr - base[score.object].psnr for score in group]
            clear = [score.noiseless - base[score.object].noiseless for score in group]

            def mean(values: Sequence[Any]) -> float:
                return float(np.mean(values))

            def mean_of_some(values: Sequence[float | None]) -> float | None:
                there = [value for value in values if value is not None]
                return mean(there) if there else None

            dB = mean([s.psnr for s in group]), mean(gains), float(np.min(gains))
            error = float(np.std(clear, ddof=1) / len(clear) ** 0.5) if len(clear) > 1 else None
            noiseless = mean([s.noiseless for s in group]), mean(clear), error
            near = mean_of_some([s.lpips for s in group]), mean_of_some([s.albedo for s in group])
            costs = mean([s.specks for s in group]), mean([s.seconds for s in group])
            out.append(LightMeans(kind, row, len(group), *dB, *noiseless, *near, *costs))
    return out
