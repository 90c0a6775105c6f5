"""Painted edits to learn a correction of the lift's colours from, and to judge it by: `lift_correction.py` reads them.

A trial holds what a network may read of an edit (`GaussianFacts`), and what novel views of the truth and the edited
view say of any change of its Gaussians' colours: a picture is linear in these, so each is a quadratic form, made once.
Kinds, each clean ("coarse") or fitted by 3DGS where it is of meshes:

- true: the edited picture shows the painted truth (`train rows --recipe paint` without zoom-ins)
- drawn: the same paint drawn over the asset's own render, shifted, bent and off in colour, as a hand does
- capture: text and strokes on a capture; other views are expected to show them where the surface's depth moves them
- case: folders of the acceptance protocol (asset.ply, paint/edit_0.png, paint/gt_*.png)

What counts is the paint and the pixels around it: within the paint alone, paint that runs over its edge looks better.
J Gaussians that may change, K neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sparse
from PIL import Image
from scipy import ndimage
from scipy.spatial import KDTree
from splatbench import scenes
from splatbench.closeups import closeup
from splatbench.local_edits import BACKGROUND
from splatbench.reprojection import reproject, surface_depth

from splatpainter import io
from splatpainter.cameras import Camera
from splatpainter.color import base_color
from splatpainter.image_files import to_uint8
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.edits import LiftedEdit
from splatpainter.lift.local.evidence import footprints
from splatpainter.lift.local.split import projected_sizes
from splatpainter.lift.masks import change_mask
from splatpainter.painter import Edit
from splatpainter.painting.asset import Asset
from splatpainter.painting.edit_methods import lift_locally
from splatpainter.painting.edit_settings import EditSettings
from splatpainter.painting.prepared_views import prepared_views
from splatpainter.pictures.drawing import over, solid_layer
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.rendering.cpu.sirt import CachedWeights
from splatpainter.splats import Splats
from splatpainter.transforms import quat_to_matrix
from splattrain import recipes
from splattrain.data.object_sources import HELD_OUT_SHARE
from splattrain.data.painted_gaussians import PaintedEdit, lifted_edit
from splattrain.data.viewpoints import turned
from splattrain.training_data import DataSettings, ResourceFolders, painted_gaussian_streams

NEIGHBOURS = 8
"""K."""
OWN_FACTS, NEIGHBOUR_FACTS, OTHER_COLORS = 22, 13, 5
"""Numbers of a Gaussian, of each neighbour; colours at hand beside the neighbours'."""
SHOWN_FACT = 9
"""Which of a Gaussian's facts says how many pixels the mask shows of it: log2(pixels + SHOWN_MARGIN) / 5."""
SHOWN_MARGIN = 0.01
TRAINING_VIEWS, TRAINING_DEGREES = 10, (10.0, 65.0)
"""Novel views of an edit that are learnt from, and their angles to the edited one."""
JUDGED_DEGREES = (20.0, 40.0, 60.0)
CHANGED = 0.02
"""Change of a colour channel from which truth counts as painted."""
RIM_PX = 3
"""Pixels around the paint that count as much as it does; those farther away FAR_WEIGHT."""
FAR_WEIGHT = 0.25
LEAST_PIXELS = 100
"""Painted pixels of all novel views, or there is nothing to learn."""
DRAWN_SHIFT_PX, DRAWN_BEND_PX, DRAWN_GAIN = 0.7, 0.5, 0.03
"""How far drawn paint is off: all of it, its parts (standard deviation), and its colours (of their own)."""
CAPTURE_PX = 256
CAPTURES = ("massa.ply", "biker.compressed.ply", "playbot_lod3.ply", "narcissus.sog", "angel.sog", "st-peter.sog")
HELD_CAPTURES = frozenset({"narcissus", "angel", "st-peter"})
WORDS = ("PAINT", "No 7", "WOW", "splat", "HELLO")
Form = tuple[Any, np.ndarray, float]
"""(H [J, J] sparse, g [J, 3], L): the mean squared error L - 2 g d + d H d of some views after the change d."""
Judged = tuple[Sequence[Camera], np.ndarray, np.ndarray]
"""(V cameras, [V, H, W, 3] what they should show, [V, H, W] bool where it counts)."""


@dataclass(frozen=True)
class GaussianFacts:
    """What a network reads of an edit."""

    ids: np.ndarray = field(repr=False)
    """[J]"""
    own: np.ndarray = field(repr=False)
    """[J, OWN_FACTS]"""
    around: np.ndarray = field(repr=False)
    """[J, K, NEIGHBOUR_FACTS]"""
    colors: np.ndarray = field(repr=False)
    """[J, K + OTHER_COLORS, 3] what the colours at hand differ by from the lift's."""


@dataclass(frozen=True)
class Trial:
    """An edit to learn from, or to be judged by (`judged` is empty in the first case)."""

    kind: str
    name: str
    facts: GaussianFacts
    novel: Form
    edited: Form
    lifted: LiftedEdit
    view: EditView
    judged: tuple[Judged, ...] = ()
    """One for each of JUDGED_DEGREES, or one for all views there are."""


def mesh_streams(data: Path) -> tuple[Any, Any]:
    """(training edits, held-out edits) of DATA/meshes."""
    recipe = recipes.load("paint", "rows")
    resources = ResourceFolders(*(data / name for name in ("hdris", "decals", "fonts", "textures")))
    samples = replace(recipe.samples, kinds={**recipe.samples.kinds, "zoom": 0.0})
    settings = DataSettings(str(data / "meshes"), samples, recipe.seed, HELD_OUT_SHARE, resources)
    return painted_gaussian_streams(settings, None, 1 << 20)  # pyright: ignore[reportReturnType]


def mesh_trial(edit: PaintedEdit, seed: int, drawn: bool, judged: bool) -> Trial | None:
    """None where novel views hardly show the edit."""
    rng = np.random.default_rng([seed, 7])
    edit = _drawn_over(edit, rng) if drawn else edit
    camera, middle = edit.view.camera, _middle(edit.view)
    turns = [(rng.uniform(*TRAINING_DEGREES), rng.uniform(0, 2 * np.pi)) for _ in range(TRAINING_VIEWS)]
    cameras = [turned(camera, middle, *turn) for turn in turns]
    before, after = _truths(edit, cameras)
    changed = np.abs(after - before).max(-1) > CHANGED
    # Where nothing changed the asset's own render is wanted.
    wanted = np.where(changed[..., None], after, _drawn(edit.painted.asset, cameras))
    views = [(c, t, _counts(m)) for c, t, m in zip(cameras, wanted, changed, strict=True)]
    tests = []
    for degrees in JUDGED_DEGREES if judged else ():
        around = _ways(camera, middle, degrees)
        before, after = _truths(edit, around)
        tests.append((around, after, _rim(np.abs(after - before).max(-1) > CHANGED)))
    kind = f"{'drawn' if drawn else 'true'} {edit.painted.kind}"
    return _trial(kind, edit.name, edit.painted.asset, edit.lifted, edit.view, views, int(changed.sum()), tests)


def capture_trial(path: Path, number: int) -> Trial | None:
    """Edit `number` of a capture."""
    source, rng = io.read(path).numpy(), np.random.default_rng([number, 11])
    seen = closeup(source, CAPTURE_PX, BACKGROUND)
    camera = seen.turned(rng.uniform(-70, 70), rng.uniform(-10, 25)) if number else seen.camera
    picture, layers = _hand_painted(source, camera, rng)
    asset = Asset(source)
    (view,) = prepared_views(asset, [Edit(to_uint8(picture), camera)], "local", partly=True)
    lifted, middle, depth = lift_locally(asset, [view], EditSettings()), _middle(view), surface_depth(source, camera)

    def expected(cameras: Sequence[Camera]) -> Iterator[tuple[np.ndarray, ...]]:
        """(picture, paint [H, W] bool, where it is known, far from all paint) of each view."""
        for other, shown in zip(cameras, _drawn(source, cameras), strict=True):
            there, shape = surface_depth(source, other), shown.shape[:2]
            painted, clean = np.zeros(shape, bool), np.ones(shape, bool)
            for layer in layers:
                moved = reproject(layer, camera, depth, other, there)
                shown, painted, clean = over(shown, moved.layer), painted | moved.painted, clean & moved.clean
            everywhere = np.concatenate([np.zeros((*shape, 3)), np.ones((*shape, 1))], -1)
            plain = reproject(everywhere, camera, depth, other, there).layer[..., 3] > 0.99
            near = ndimage.binary_dilation(painted, iterations=RIM_PX + 1)
            known = np.logical_and(ndimage.minimum_filter(plain, 3), near)
            yield shown, painted, known, clean & ~known

    turns = [(rng.uniform(*TRAINING_DEGREES), rng.uniform(0, 2 * np.pi)) for _ in range(TRAINING_VIEWS)]
    cameras = [turned(camera, middle, *turn) for turn in turns]
    found = list(expected(cameras))
    views = [
        (c, shown, np.where(known, 1.0, np.where(clean, FAR_WEIGHT, 0)))
        for c, (shown, _, known, clean) in zip(cameras, found, strict=True)
    ]
    tests = []
    for degrees in JUDGED_DEGREES if (name := path.name.split(".")[0]) in HELD_CAPTURES else ():
        around = _ways(camera, middle, degrees)
        shown, _, known, _ = (np.stack(x) for x in zip(*expected(around), strict=True))
        tests.append((around, shown, known))
    count = int(sum(painted.sum() for _, painted, _, _ in found))
    return _trial("capture", name, source, lifted, view, views, count, tests)


def case_trial(folder: Path) -> Trial | None:
    """A folder of the acceptance protocol; its novel views serve to learn from or to judge by."""
    source, paint = io.read(folder / "asset.ply").numpy(), folder / "paint"
    asset = Asset(source)
    edit = Edit(_picture(paint / "edit_0.png"), _camera(paint / "edit_0.json"))
    (view,) = prepared_views(asset, [edit], "local", partly=True)
    lifted = lift_locally(asset, [view], EditSettings())
    cameras, wanted, changed = [], [], []
    for path in sorted(paint.glob("gt_*.png")):
        cameras.append(_camera(path.with_suffix(".json")))
        wanted.append(_picture(path).astype(np.float32) / 255)
        changed.append(_picture(paint / path.name.replace("gt_", "gtmask_")).max(-1) > 127)
    asked = np.stack(changed)
    own = _drawn(source, cameras)
    views = [
        (c, np.where(m[..., None], t, o), _counts(m)) for c, t, o, m in zip(cameras, wanted, own, asked, strict=True)
    ]
    tests = [(cameras, np.stack(wanted), _rim(asked))]
    return _trial("case", folder.name, source, lifted, view, views, int(asked.sum()), tests)


def _trial(
    kind: str,
    name: str,
    asset: Splats,
    lifted: LiftedEdit,
    view: EditView,
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],
    pixels: int,
    tests: Sequence[Judged],
) -> Trial | None:
    if pixels < LEAST_PIXELS:
        return None
    facts = facts_of(asset, lifted, view)
    whole = [(view.camera, view.target, np.ones(view.mask.shape))]
    forms = quadratic(lifted.splats, facts.ids, views), quadratic(lifted.splats, facts.ids, whole)
    counts = pixels, float(view.mask.sum())
    novel, edited = ((h / (3 * n), g / (3 * n), e / (3 * n)) for (h, g, e), n in zip(forms, counts, strict=True))
    return Trial(kind, name, facts, novel, edited, lifted, view, tuple(tests))


def facts_of(asset: Splats, lifted: LiftedEdit, view: EditView) -> GaussianFacts:
    """asset: before the edit; view: with depth and alpha."""
    assert view.depth is not None and view.alpha is not None
    splats, camera, first = lifted.splats, view.camera, len(asset)
    count, (height, width) = len(splats), view.mask.shape
    color, parents = _towards(splats, camera), np.arange(count)
    parents[lifted.ids] = lifted.parents
    before = _towards(asset, camera)[np.minimum(parents, first - 1)]
    fresh, edited = np.arange(count) >= first, np.zeros(count, bool)
    fresh[lifted.replaced] = True
    edited[lifted.ids] = True
    weight, peak, share, visible = _shown(splats, view)
    ids = lifted.ids[splats.opacities[lifted.ids] > 0.02]

    # Where each lies in the view, and how it faces it.
    means = splats.means.astype(np.float64)
    normals = quat_to_matrix(np.ascontiguousarray(splats.quats))[np.arange(count), :, splats.scales.argmin(1)]
    towards = camera.position - means
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    facing = (normals * towards).sum(1)
    normals, facing = np.where(facing[:, None] < 0, -normals, normals), np.abs(facing)
    pixels, depths = camera.project(means)
    ahead = depths > 1e-6
    pixels = np.where(ahead[:, None] & np.isfinite(pixels), pixels, 0)
    x, y = (np.clip(pixels[:, k], 0, edge - 1).astype(np.int64) for k, edge in ((0, width), (1, height)))
    beside = ((pixels < 0) | (pixels >= (width, height))).any(1) | ~ahead
    pixel = np.maximum(depths, 1e-6) / camera.fy
    solid = view.alpha > 0.5
    behind = np.where(solid[y, x], np.clip((depths - view.depth[y, x]) / pixel, -8, 8), 0) / 8
    sizes = np.sort(np.clip(projected_sizes(splats.take(ids), camera), 1e-2, 1e3), 1)[:, ::-1]

    # The picture around that place.
    target, mask = view.target, view.mask.astype(np.float32)
    over_it = target[y, x]
    near, wide, painted = (
        _mean_around(target, where, y, x, r) for where, r in ((solid, 1), (solid, 2), (solid & view.mask, 3))
    )
    paint = np.where((painted[1] > 1e-4)[:, None], painted[0], wide[0])
    depth = np.where(solid, view.depth, view.depth.max())
    step = (ndimage.maximum_filter(depth, 5) - ndimage.minimum_filter(depth, 5))[y, x] / pixel
    contrast = (ndimage.maximum_filter(target, (5, 5, 1)) - ndimage.minimum_filter(target, (5, 5, 1))).max(-1)[y, x]
    columns = (
        *(facing, behind, 2 * splats.opacities - 1, np.log2(peak + 1e-3) / 5, share, visible),
        *(np.log2(weight + SHOWN_MARGIN) / 5, mask[y, x], ndimage.uniform_filter(mask, 3)[y, x]),
        *(ndimage.uniform_filter(mask, 7)[y, x], view.alpha[y, x], ndimage.minimum_filter(view.alpha, 5)[y, x]),
        *(np.log2(step + 1) / 4, contrast, fresh, np.arange(count) >= first, beside),
        *(np.abs(color - before).max(1), np.abs(color - over_it).max(1)),
    )
    own = np.concatenate([np.log2(sizes) / 4, np.stack(columns, 1)[ids]], 1)

    # Its neighbours, edited or not: where paint ends they say so.
    there = np.flatnonzero(splats.opacities > 0.05)
    distances, index = KDTree(means[there]).query(means[ids], k=NEIGHBOURS + 1)
    nearest = there[index]
    order = np.argsort(nearest == ids[:, None], 1, kind="stable")[:, :NEIGHBOURS]  # itself last
    nearest, distances = (np.take_along_axis(values, order, 1) for values in (nearest, distances))
    edges = np.sort(splats.scales.astype(np.float64), 1)[:, 1:].mean(1)
    size = np.maximum(edges[ids], 1e-9)[:, None]
    off = ((means[nearest] - means[ids][:, None]) * normals[ids][:, None]).sum(-1) / size
    pairs = (
        *(np.log2(distances / size + 1e-2) / 3, np.clip(off, -6, 6) / 3, share[nearest]),
        *(np.log2(weight[nearest] + SHOWN_MARGIN) / 5, facing[nearest], splats.opacities[nearest]),
        *(np.log2(edges[nearest] / size) / 3, fresh[nearest], edited[nearest]),
        *((normals[ids][:, None] * normals[nearest]).sum(-1), np.abs(color[nearest] - before[nearest]).max(-1)),
        *(np.abs(color[nearest] - color[ids][:, None]).max(-1), np.log2(peak[nearest] + 1e-3) / 5),
    )
    others = np.stack([over_it, near[0], wide[0], paint, before], 1)[ids]
    colors = np.concatenate([color[nearest], others], 1) - color[ids][:, None]
    return GaussianFacts(ids, *(values.astype(np.float32) for values in (own, np.stack(pairs, -1), colors)))


def quadratic(splats: Splats, ids: np.ndarray, views: Sequence[tuple[Camera, np.ndarray, np.ndarray]]) -> Form:
    """The sum over views of m |target - picture|^2 as a form of a change of the colours of the Gaussians `ids`. views:
    (camera, target [H, W, 3], m [H, W])."""
    movable, column = np.zeros(len(splats), bool), np.full(len(splats), -1)
    movable[ids], column[ids] = True, np.arange(len(ids))
    form: Any = sparse.csr_matrix((len(ids), len(ids)))
    gradient, total = np.zeros((len(ids), 3)), 0.0
    for camera, target, counts in views:
        left = target - np.asarray(render(splats, camera).colors[0])
        total += float((counts[..., None] * left**2).sum())
        seen = project(splats, camera)
        chosen = movable[seen.gaussian_ids]
        cached = CachedWeights.of(seen, target, np.ones(counts.shape, np.float32), chosen)
        if not chosen.any() or cached is None:
            continue
        weights = _weights(cached, seen, counts.shape, column[seen.gaussian_ids[chosen]], len(ids))
        form += weights.T @ sparse.diags(counts.ravel()) @ weights
        gradient += weights.T @ (counts[..., None] * left).reshape(-1, 3)
    return form.tocsr().astype(np.float32), gradient.astype(np.float32), total


def _weights(cached: CachedWeights, view: Any, shape: tuple[int, ...], column: np.ndarray, count: int) -> Any:
    """[pixels, J] sparse: what each Gaussian makes of a pixel."""
    begins, boxes, offsets, entries, _, weights = cached._lists
    tile = np.repeat(view.tile_ids, np.diff(begins))
    pair = np.repeat(np.arange(len(boxes)), np.diff(offsets))
    block, across = np.arange(len(pair)) - offsets[pair], np.maximum(boxes[pair, 3] - boxes[pair, 2], 1)
    row, lane = np.divmod(tile[pair], view.tiles.shape[1]), np.arange(16)
    y = (row[0] * 16 + (boxes[pair, 0] + block // across) * 4)[:, None] + lane // 4
    x = (row[1] * 16 + (boxes[pair, 2] + block % across) * 4)[:, None] + lane % 4
    values = weights[: len(pair)]
    there = (y < shape[0]) & (x < shape[1]) & (values > 1e-4)
    columns = np.broadcast_to(column[entries[pair]][:, None], there.shape)[there]
    size = (shape[0] * shape[1], count)
    return sparse.csr_matrix((values[there], ((y * shape[1] + x)[there], columns)), shape=size)


def _ways(camera: Camera, middle: np.ndarray, degrees: float) -> list[Camera]:
    return [turned(camera, middle, degrees, way) for way in np.arange(4) * np.pi / 2 + 0.3]


def _drawn_over(edit: PaintedEdit, rng: np.random.Generator) -> PaintedEdit:
    """The same paint drawn over the asset's own render, lifted again."""
    camera = edit.view.camera
    own = _drawn(edit.painted.asset, [camera])[0]
    before, after = (x[0] for x in _truths(edit, [camera]))
    share = np.clip(np.abs(after - before).max(-1) / 0.1, 0, 1)
    layer = _bent(np.concatenate([after, share[..., None]], -1), rng)
    colors = np.clip(layer[..., :3] * (1 + rng.normal(size=3) * DRAWN_GAIN), 0, 1)
    mixed = own * (1 - layer[..., 3:]) + colors * layer[..., 3:]
    picture = to_uint8(mixed.astype(np.float32)).astype(np.float32) / 255
    (view,) = edit_views(edit.painted.asset, [camera], [picture], [change_mask(picture, own)])
    return replace(edit, view=view, lifted=lifted_edit(edit.painted, view))


def _bent(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[H, W, C] seen through a field of shifts."""
    shape = picture.shape[:2]
    fields = [ndimage.gaussian_filter(rng.normal(size=shape), 12) for _ in range(2)]
    way = rng.uniform(0, 2 * np.pi)
    shifts = [DRAWN_SHIFT_PX * part for part in (math.sin(way), math.cos(way))]
    bends = [shift + DRAWN_BEND_PX * f / max(f.std(), 1e-9) for f, shift in zip(fields, shifts, strict=True)]
    at = [grid + bend for grid, bend in zip(np.mgrid[: shape[0], : shape[1]], bends, strict=True)]
    planes = (ndimage.map_coordinates(picture[..., c], at, order=1, mode="nearest") for c in range(picture.shape[-1]))
    return np.stack(list(planes), -1)


def _hand_painted(source: Splats, camera: Camera, rng: np.random.Generator) -> tuple[np.ndarray, list[np.ndarray]]:
    """(a capture's picture with one or two strokes or words on it, their layers)."""
    seen = render(source, [camera])
    picture, cover = np.clip(np.asarray(seen.colors[0]), 0, 1), np.asarray(seen.alphas[0, ..., 0])
    shape, unit, layers = picture.shape[:2], CAPTURE_PX / 512, []
    for _ in range(int(rng.integers(1, 3))):
        center = (rng.uniform(0.3, 0.7) * CAPTURE_PX, rng.uniform(0.3, 0.7) * CAPTURE_PX)
        if rng.uniform() < 0.5:
            layer = scenes.text_layer(str(rng.choice(WORDS)), shape, center, rng.uniform(50, 100) * unit)
        else:
            wave = scenes.wave(shape, center[1] / CAPTURE_PX)
            layer = scenes.stroke_layer(shape, wave, rng.uniform(14, 40) * unit, 6 * unit)
        strong = scenes.color_against(picture, layer[..., 3])
        layer = solid_layer(layer[..., 3], strong if rng.uniform() < 0.5 else tuple(rng.uniform(0, 1, 3)))
        layer[..., 3] *= np.clip((cover - 0.8) / 0.15, 0, 1)
        layers.append(layer)
    for layer in layers:
        picture = over(picture, layer)
    return picture, layers


def _camera(path: Path) -> Camera:
    return Camera.from_json(path.read_text(encoding="utf-8"), path.name)


def _picture(path: Path) -> np.ndarray:
    """[H, W, 3] uint8."""
    return np.asarray(Image.open(path).convert("RGB"))


def _counts(changed: np.ndarray) -> np.ndarray:
    """[H, W] what each pixel counts."""
    return np.where(ndimage.binary_dilation(changed, iterations=RIM_PX), 1.0, FAR_WEIGHT)


def _rim(changed: np.ndarray) -> np.ndarray:
    """[V, H, W] bool the paint and what is around it."""
    return np.stack([ndimage.binary_dilation(one, iterations=RIM_PX) for one in changed])


def _middle(view: EditView) -> np.ndarray:
    """[3] of the painted surface."""
    assert view.depth is not None and view.alpha is not None
    y, x = np.nonzero(view.mask & (view.alpha > 0.5))
    return view.camera.unproject(view.depth[y, x], np.stack([x, y], 1) + 0.5).mean(0)


def _truths(edit: PaintedEdit, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """[V, H, W, 3] before, after."""
    return _drawn(edit.painted.scene.truth, cameras), _drawn(edit.sample.truth, cameras)


def _drawn(splats: Any, cameras: Sequence[Camera]) -> np.ndarray:
    return np.clip(np.asarray(render(splats, list(cameras)).colors), 0, 1)


def _towards(splats: Splats, camera: Camera) -> np.ndarray:
    """[N, 3] colours towards a view; base colours of those that are not in it."""
    seen, out = project(splats, camera), base_color(splats.sh).copy()
    out[seen.gaussian_ids] = seen.unclamped_colors
    return out


def _shown(splats: Splats, view: EditView) -> tuple[np.ndarray, ...]:
    """[N] each: pixels' worth that the mask shows, the largest of one pixel, the share of its footprint, of alpha."""
    seen = project(splats, view.camera)
    sums = seen.backproject(view.target, view.mask.astype(np.float32))
    shares = np.minimum(sums.weight / np.maximum(footprints(seen), 1e-6), 1), sums.weight / np.maximum(sums.alpha, 1e-6)
    found = []
    for values in (sums.weight, sums.peak, *shares):
        full = np.zeros(len(splats))
        full[seen.gaussian_ids] = values
        found.append(full)
    return tuple(found)


def _mean_around(picture: np.ndarray, where: np.ndarray, y: np.ndarray, x: np.ndarray, radius: int) -> Any:
    """([N, 3] mean of the pixels `where` around places, [N] their share)."""
    size, counted = 2 * radius + 1, where.astype(np.float32)
    share = ndimage.uniform_filter(counted, size)
    planes = [ndimage.uniform_filter(picture[..., c] * counted, size) for c in range(3)]
    return (np.stack(planes, -1) / np.maximum(share, 1e-6)[..., None])[y, x], share[y, x]
