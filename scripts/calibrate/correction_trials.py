"""Painted edits to learn a correction of the lift's colours from, and to judge it by: `lift_correction.py` reads them.

A trial holds what a network may read of an edit (`GaussianFacts`), and what novel views of the truth and the edited
view say of any change of its Gaussians' colours: a picture is linear in these, so each is a quadratic form, made once.
Kinds, each clean ("coarse") or fitted by 3DGS where it is of meshes:

- true: the edited picture shows the painted truth (`train rows --recipe paint` without zoom-ins)
- drawn: the same paint drawn over the asset's own render, shifted, bent and off in colour, as a hand does
- capture: text and strokes on a capture; other views are expected to show them where the surface's depth moves them
- case: folders of the acceptance protocol (asset.ply, paint/edit_0.png, paint/gt_*.png)

What counts is the paint and the pixels around it: within the paint alone, paint that runs over its edge looks better.
J Gaussians that may change.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sparse
from PIL import Image
from scipy import ndimage
from splatbench import scenes
from splatbench.closeups import closeup
from splatbench.local_edits import BACKGROUND
from splatbench.reprojection import reproject, surface_depth

from splatpainter import io
from splatpainter.cameras import Camera
from splatpainter.image_files import to_uint8
from splatpainter.lift.colors import colors_towards
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.edits import LiftedEdit
from splatpainter.lift.local.correction import MIN_OPACITY, LiftedGaussians, PaintedPictures, facing
from splatpainter.lift.masks import change_mask
from splatpainter.lift.sheets.resurface import RESURFACING
from splatpainter.painter import Edit
from splatpainter.painting.asset import Asset
from splatpainter.painting.edit_methods import lift_locally
from splatpainter.painting.edit_settings import EditSettings
from splatpainter.painting.prepared_views import prepared_views
from splatpainter.pictures.drawing import over, solid_layer
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.rendering.cpu.sirt import CachedWeights
from splatpainter.splats import Splats
from splattrain import recipes
from splattrain.data.object_sources import HELD_OUT_SHARE
from splattrain.data.painted_gaussians import PaintedEdit, lifted_edit
from splattrain.data.viewpoints import turned
from splattrain.training_data import DataSettings, ResourceFolders, painted_gaussian_streams

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
"""(H [J, J] sparse, g [J, 3], L): the squared error L - 2 g d + d H d of some views after the change d."""
Judged = tuple[Sequence[Camera], np.ndarray, np.ndarray]
"""(V cameras, [V, H, W, 3] what they should show, [V, H, W] bool where it counts)."""


@dataclass(frozen=True)
class JudgedEdit:
    """An edit to be judged by."""

    splats: Splats
    """As the lift left them."""
    view: EditView
    tests: tuple[Judged, ...]
    """One for each of JUDGED_DEGREES, or one for all views there are."""


@dataclass(frozen=True)
class Trial:
    """An edit to learn from or to be judged by."""

    kind: str
    name: str
    painted: LiftedGaussians
    counts: np.ndarray
    """[H, W] float32 what each pixel counts in the steps towards the picture."""
    novel: Form
    judged: JudgedEdit | None = None


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
    painted = lifted_gaussians(asset, lifted, view)
    if not len(painted.entries):
        return None
    h, g, e = quadratic(lifted.splats, painted.view.gaussian_ids[painted.entries], views)
    novel = h / (3 * pixels), g / (3 * pixels), e / (3 * pixels)
    judged = JudgedEdit(lifted.splats, view, tuple(tests)) if tests else None
    # As sheets count them, and where Gaussians were split.
    counts = np.where(view.mask, 1, RESURFACING.unedited_weight) if len(lifted.replaced) else painted.pictures.weights
    return Trial(kind, name, painted, counts.astype(np.float32), novel, judged)


def lifted_gaussians(asset: Splats, lifted: LiftedEdit, view: EditView) -> LiftedGaussians:
    """asset: before the edit."""
    splats, camera, count = lifted.splats, view.camera, len(lifted.splats)
    full, editable, parents = project(splats, camera), np.zeros(count, bool), np.arange(count)
    editable[lifted.ids], parents[lifted.ids] = splats.opacities[lifted.ids] > MIN_OPACITY, lifted.parents
    seen = full.part(tiles=full.tiles_of(editable))
    entries = np.flatnonzero(editable[seen.gaussian_ids])
    ids = seen.gaussian_ids[entries]
    assert view.alpha is not None and view.depth is not None
    pictures = PaintedPictures(np.ascontiguousarray(view.target, np.float32), view.mask, view.alpha, view.depth)
    _, sums = seen.mask_sums(view.mask, np.ones(view.mask.shape, bool))
    before = colors_towards(project(asset, camera), asset, parents[ids])
    fresh = (ids >= len(asset)) | np.isin(ids, lifted.replaced)
    towards = facing(splats, ids, camera)
    return LiftedGaussians(seen, entries, towards, sums.take(entries), seen.colors[entries], before, fresh, pictures)


def quadratic(splats: Splats, ids: np.ndarray, views: Sequence[tuple[Camera, np.ndarray, np.ndarray]]) -> Form:
    """The sum over views of m |target - picture|^2 as a form of a change of the colours of the Gaussians `ids`. views:
    (camera, target [H, W, 3], m [H, W])."""
    column = np.full(len(splats), -1)
    column[ids] = np.arange(len(ids))
    form: Any = sparse.csr_matrix((len(ids), len(ids)))
    gradient, total = np.zeros((len(ids), 3)), 0.0
    for camera, target, counts in views:
        more = _form(project(splats, camera), column, len(ids), target, counts)
        form, gradient, total = form + more[0], gradient + more[1], total + more[2]
    return form.tocsr().astype(np.float32), gradient.astype(np.float32), total


def edited_form(painted: LiftedGaussians, counts: np.ndarray) -> Form:
    """The same of the edited view, as the steps towards its picture count its pixels. counts: as of Trial."""
    view, pictures = painted.view, painted.pictures
    column = np.full(view.num_gaussians, -1)
    column[view.gaussian_ids[painted.entries]] = np.arange(len(painted.entries))
    counts = np.where(view.rasterize()[1] > 0, counts, 0)
    form, gradient, total = _form(view, column, len(painted.entries), pictures.target, counts)
    return form.tocsr().astype(np.float32), gradient.astype(np.float32), total


def _form(view: ProjectedView, column: np.ndarray, count: int, target: np.ndarray, counts: np.ndarray) -> Form:
    """Of one view. column: [N] number of each Gaussian among the `count` that may change, or -1; counts: [H, W] m."""
    left = target - view.rasterize()[0]
    total = float((counts[..., None] * left**2).sum())
    chosen = column[view.gaussian_ids] >= 0
    cached = CachedWeights.of(view, target, np.ones(counts.shape, np.float32), chosen)
    if not chosen.any() or cached is None:
        return sparse.csr_matrix((count, count)), np.zeros((count, 3)), total
    weights = _weights(cached, view, counts.shape, column[view.gaussian_ids[chosen]], count)
    form = weights.T @ sparse.diags(counts.ravel()) @ weights
    return form, weights.T @ (counts[..., None] * left).reshape(-1, 3), total


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
