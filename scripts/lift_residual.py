"""What a network knows that the lift does not: a correction of the lift's colours, trained on how painted surfaces look
from other sides.

Run: python scripts/lift_residual.py DATA OUT [--objects 47] [--seconds 150] [--captures FILE ...]

DATA: a folder with meshes/, hdris/, decals/, fonts/, textures/. Every Gaussian that a local edit may change gets a
mixture of colours that are at hand: its neighbours', the picture's over it, its own before the edit. How much of each,
a small network says of what the view shows of it and of them; it starts at none, which is the lift. A picture is linear
in the Gaussians' colours, so what novel views of the truth say of a correction is a quadratic form of it, made once for
each edit, and a step needs no renderer. Afterwards two rounds of the lift hold it against the edited picture.

Edits are those of `train rows --recipe paint` without zoom-ins; those of objects held out of training are judged, in
views 20, 40 and 60 degrees away. Captures are painted as `bench lift` does. OUT keeps the edits and the weights
(docs/ADAPTATION.md has the figures). J Gaussians that may change, K neighbours.
"""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy.sparse as sparse
import torch
import tyro
from local_carriers import Capture
from scipy import ndimage
from scipy.spatial import KDTree
from torch import Tensor, nn

from splatpainter.cameras import Camera
from splatpainter.color import base_color
from splatpainter.lift.colors import lift_colors
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.edits import LiftedEdit
from splatpainter.lift.local.evidence import footprints
from splatpainter.lift.local.split import projected_sizes
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.rendering.cpu.sirt import CachedWeights
from splatpainter.splats import SH_C0, Splats
from splatpainter.text_tables import markdown
from splatpainter.transforms import quat_to_matrix
from splattrain import recipes
from splattrain.data.object_sources import HELD_OUT_SHARE
from splattrain.data.painted_gaussians import PaintedEdit
from splattrain.data.viewpoints import Optics, _aimed, _direction, _unit, angles
from splattrain.training_data import DataSettings, ResourceFolders, painted_gaussian_streams


@dataclass(frozen=True)
class ResidualSettings:
    """Sizes and weights of the trial. Source: taste, but for the weight of the edited view: at 1 novel views of
    held-out edits gain 0.05 dB and the edited one 0.4, at 0.15 they gain 0.7 and it loses 1.9, which the rounds
    return."""

    neighbours: int = 16
    """K."""
    width: int = 48
    """Of the network's layers."""
    edited_weight: float = 0.15
    """Of the edited view's logarithm of the error, beside that of novel views."""
    novel_views: int = 10
    """Of an edit in training, at `training_degrees` from the edited one."""
    training_degrees: tuple[float, float] = (10.0, 65.0)
    judged_degrees: tuple[float, ...] = (20.0, 40.0, 60.0)
    rate: float = 3e-3
    edits_per_step: int = 2
    least_error: float = 2e-4
    """Added to squared errors: 37 dB are enough."""
    rounds: int = 2
    """Of the lift, after the correction."""
    hold: tuple[float, float] = (0.1, 0.1)
    """Pixels' worth of weight that the correction has in these, and per pixel of a Gaussian that the view hides."""
    changed: float = 0.02
    """Change of a colour channel from which truth counts as painted."""


SETTINGS = ResidualSettings()
OWN_FACTS, NEIGHBOUR_FACTS, OTHER_COLORS = 22, 13, 5
"""Numbers of a Gaussian, of each neighbour; colours at hand beside the neighbours'."""


@dataclass(frozen=True)
class Options:
    """Train a correction of the lift, and judge it."""

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DATA")]
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    captures: tuple[Path, ...] = ()
    """Splat files to paint on besides."""
    objects: int = 47
    """Training objects."""
    edits: int = 3
    """Edits of each."""
    judged: int = 29
    """Edits of held-out objects."""
    seconds: float = 150.0
    """CPU seconds of training."""


@dataclass(frozen=True)
class GaussianFacts:
    """What the network reads of an edit."""

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
    """An edit to learn from: errors of novel views and of the edited one as quadratic forms of a correction [J, 3]."""

    facts: GaussianFacts
    novel: tuple[Any, np.ndarray, float]
    edited: tuple[Any, np.ndarray, float]


class Residual(nn.Module):
    """Facts to a correction, zero at first."""

    def __init__(self) -> None:
        super().__init__()
        width = SETTINGS.width
        self.scaling: Tensor
        self.register_buffer("scaling", torch.zeros(2, OWN_FACTS + NEIGHBOUR_FACTS))
        self.own = nn.Sequential(nn.Linear(OWN_FACTS, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        pair = nn.Linear(NEIGHBOUR_FACTS + width, width)
        self.pairs = nn.Sequential(pair, nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.mix = nn.Sequential(nn.Linear(2 * width, width), nn.SiLU())
        self.of_neighbours, self.of_others = nn.Linear(2 * width, 1), nn.Linear(width, OTHER_COLORS)
        for layer in (self.of_neighbours, self.of_others):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, facts: GaussianFacts) -> Tensor:
        """[J, 3]."""
        own, around, colors = (torch.from_numpy(x) for x in (facts.own, facts.around, facts.colors))
        mean, deviation = self.scaling
        own = ((own - mean[:OWN_FACTS]) / deviation[:OWN_FACTS]).clamp(-5, 5)
        around = ((around - mean[OWN_FACTS:]) / deviation[OWN_FACTS:]).clamp(-5, 5)
        own, count = self.own(own), around.shape[1]
        pairs = self.pairs(torch.cat([around, own[:, None].expand(-1, count, -1)], -1))
        whole = self.mix(torch.cat([own, pairs.mean(1)], -1))
        shares = self.of_neighbours(torch.cat([pairs, whole[:, None].expand_as(pairs)], -1))[..., 0] * (4 / count)
        return (torch.cat([shares, self.of_others(whole)], 1)[..., None] * colors).sum(1)


def main(options: Options) -> str:
    """Markdown of the means, also in OUT/residual.md."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    recipe, folder = recipes.load("paint", "rows"), options.data
    resources = ResourceFolders(*(folder / name for name in ("hdris", "decals", "fonts", "textures")))
    samples = replace(recipe.samples, kinds={**recipe.samples.kinds, "zoom": 0.0})
    settings = DataSettings(str(folder / "meshes"), samples, recipe.seed, HELD_OUT_SHARE, resources)
    training, held = painted_gaussian_streams(settings, None, 1 << 20)
    assert held is not None
    options.out.mkdir(parents=True, exist_ok=True)
    weights, network = options.out / "residual.pt", Residual()
    if weights.is_file():
        network.load_state_dict(torch.load(weights))
    else:
        numbers = [k * training.samples_per_object + j for k in range(options.objects) for j in range(options.edits)]
        train(network, list(_trials(training, numbers, options.out / "trials")), options.seconds)
        torch.save(network.state_dict(), weights)
    table = _table(network.eval(), held, options)
    (options.out / "residual.md").write_text(table, encoding="utf-8")
    return table


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
    over = target[y, x]
    near, wide, painted = (
        _mean_around(target, where, y, x, r) for where, r in ((solid, 1), (solid, 2), (solid & view.mask, 3))
    )
    paint = np.where((painted[1] > 1e-4)[:, None], painted[0], wide[0])
    depth = np.where(solid, view.depth, view.depth.max())
    step = (ndimage.maximum_filter(depth, 5) - ndimage.minimum_filter(depth, 5))[y, x] / pixel
    contrast = (ndimage.maximum_filter(target, (5, 5, 1)) - ndimage.minimum_filter(target, (5, 5, 1))).max(-1)[y, x]
    columns = (
        *(facing, behind, 2 * splats.opacities - 1, np.log2(peak + 1e-3) / 5, share, visible),
        *(np.log2(weight + 0.01) / 5, mask[y, x], ndimage.uniform_filter(mask, 3)[y, x]),
        *(ndimage.uniform_filter(mask, 7)[y, x], view.alpha[y, x], ndimage.minimum_filter(view.alpha, 5)[y, x]),
        *(np.log2(step + 1) / 4, contrast, fresh, np.arange(count) >= first, beside),
        *(np.abs(color - before).max(1), np.abs(color - over).max(1)),
    )
    own = np.concatenate([np.log2(sizes) / 4, np.stack(columns, 1)[ids]], 1)

    # Its neighbours, edited or not: where paint ends they say so.
    there = np.flatnonzero(splats.opacities > 0.05)
    distances, index = KDTree(means[there]).query(means[ids], k=SETTINGS.neighbours + 1)
    nearest = there[index]
    order = np.argsort(nearest == ids[:, None], 1, kind="stable")[:, : SETTINGS.neighbours]  # itself last
    nearest, distances = (np.take_along_axis(values, order, 1) for values in (nearest, distances))
    edges = np.sort(splats.scales.astype(np.float64), 1)[:, 1:].mean(1)
    size = np.maximum(edges[ids], 1e-9)[:, None]
    off = ((means[nearest] - means[ids][:, None]) * normals[ids][:, None]).sum(-1) / size
    pairs = (
        *(np.log2(distances / size + 1e-2) / 3, np.clip(off, -6, 6) / 3, share[nearest]),
        *(np.log2(weight[nearest] + 0.01) / 5, facing[nearest], splats.opacities[nearest]),
        *(np.log2(edges[nearest] / size) / 3, fresh[nearest], edited[nearest]),
        *((normals[ids][:, None] * normals[nearest]).sum(-1), np.abs(color[nearest] - before[nearest]).max(-1)),
        *(np.abs(color[nearest] - color[ids][:, None]).max(-1), np.log2(peak[nearest] + 1e-3) / 5),
    )
    others = np.stack([over, near[0], wide[0], paint, before], 1)[ids]
    colors = np.concatenate([color[nearest], others], 1) - color[ids][:, None]
    return GaussianFacts(ids, *(x.astype(np.float32) for x in (own, np.stack(pairs, -1), colors)))


def quadratic(splats: Splats, ids: np.ndarray, views: Sequence[tuple[Camera, np.ndarray, np.ndarray]]) -> Any:
    """(H [J, J] sparse, g [J, 3], L) of the sum L - 2 g d + d H d over views of m |target - picture|^2, d a change of
    the colours of the Gaussians `ids`. views: (camera, target [H, W, 3], m [H, W])."""
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


def trial_of(edit: PaintedEdit, rng: np.random.Generator) -> Trial | None:
    """None where novel views hardly show the edit."""
    splats, view = edit.lifted.splats, edit.view
    facts = facts_of(edit.painted.asset, edit.lifted, view)
    middle = _middle(view)
    turns = [(rng.uniform(*SETTINGS.training_degrees), rng.uniform(0, 2 * np.pi)) for _ in range(SETTINGS.novel_views)]
    cameras = [turned(view.camera, middle, *turn) for turn in turns]
    before, after, changed = _truth(edit, cameras)
    if changed.sum() < 100:
        return None
    asset = _drawn(edit.painted.asset, cameras)
    # Where nothing changed the asset's own render is wanted, and counts less the farther it is from the paint.
    views = [
        (c, np.where(m[..., None], a, b), np.where(ndimage.binary_dilation(m, iterations=3), 1.0, 0.25))
        for c, a, b, m in zip(cameras, after, asset, changed, strict=True)
    ]
    whole = [(view.camera, view.target, np.ones(view.mask.shape))]
    forms = quadratic(splats, facts.ids, views), quadratic(splats, facts.ids, whole)
    pixels = float(changed.sum()), float(view.mask.sum())
    novel, edited = (tuple(part / (3 * n) for part in form) for form, n in zip(forms, pixels, strict=True))
    return Trial(facts, novel, edited)  # pyright: ignore[reportArgumentType]


def _trials(stream: Any, numbers: Sequence[int], folder: Path) -> Iterator[Trial]:
    """Made once and kept."""
    folder.mkdir(exist_ok=True)
    for number in numbers:
        path = folder / f"{number:06d}.pkl"
        if not path.is_file():
            try:
                made = trial_of(stream.full_edit(number), np.random.default_rng([number, 7]))
            except ValueError:  # said of many a thin object: no edit of it can be seen
                made = None
            path.write_bytes(pickle.dumps(made))
        if (trial := pickle.loads(path.read_bytes())) is not None:
            yield trial


def train(network: Residual, trials: Sequence[Trial], seconds: float) -> None:
    """Logarithms of the squared error of novel views, and of the edited one by its weight."""
    parts = [[t.facts.own for t in trials], [t.facts.around[::7].reshape(-1, NEIGHBOUR_FACTS) for t in trials]]
    joined = [torch.from_numpy(np.concatenate(part)) for part in parts]
    mean, deviation = (torch.cat(x) for x in zip(*((j.mean(0), j.std(0).clamp(min=0.05)) for j in joined), strict=True))
    network.scaling.copy_(torch.stack([mean, deviation]))  # pyright: ignore[reportCallIssue]
    forms = [[(_csr(h), torch.from_numpy(g).float(), v) for h, g, v in (t.novel, t.edited)] for t in trials]
    optimizer = torch.optim.AdamW(network.parameters(), lr=SETTINGS.rate, weight_decay=0.01)
    average, rng = [p.detach().clone() for p in network.parameters()], np.random.default_rng(0)
    begun, step = time.process_time(), 0
    while (spent := (time.process_time() - begun) / seconds) < 1:
        for group in optimizer.param_groups:
            course = max(0.02, 0.5 + 0.5 * math.cos(math.pi * spent))
            group["lr"] = SETTINGS.rate * min(1, (step + 1) / 100) * course
        optimizer.zero_grad()
        for k in rng.integers(len(trials), size=SETTINGS.edits_per_step):
            change = network(trials[k].facts)
            novel, edited = (torch.log(_value(form, change) + SETTINGS.least_error) for form in forms[k])
            (novel + SETTINGS.edited_weight * edited).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        step += 1
        for kept, now in zip(average, network.parameters(), strict=True):
            kept.lerp_(now.detach(), 0.01)
    print(f"{step} steps on {len(trials)} edits", flush=True)
    with torch.no_grad():
        for kept, now in zip(average, network.parameters(), strict=True):
            now.copy_(kept)


def corrected(network: Residual, asset: Splats, lifted: LiftedEdit, view: EditView) -> tuple[LiftedEdit, LiftedEdit]:
    """(the lifted edit corrected, the same after rounds of the lift that are held to it)."""
    facts = facts_of(asset, lifted, view)
    with torch.no_grad():
        change = network(facts).numpy()
    sh = lifted.splats.sh.copy()
    sh[facts.ids, 0] += change / SH_C0
    alone = replace(lifted, splats=replace(lifted.splats, sh=sh))
    return alone, with_rounds(alone, view)


def with_rounds(lifted: LiftedEdit, view: EditView) -> LiftedEdit:
    """The lifted edit after SETTINGS.rounds towards its picture, held to what it is."""
    splats, count = lifted.splats, len(lifted.splats)
    editable, hold = np.zeros(count, bool), np.zeros(count, np.float32)
    editable[lifted.ids] = True
    everything = project(splats, view.camera)
    shown = everything.backproject(view.target, np.ones(view.mask.shape, np.float32)).weight
    hold[everything.gaussian_ids] = np.maximum(footprints(everything) - shown, 0)
    hold = SETTINGS.hold[0] + SETTINGS.hold[1] * hold
    seen = project(splats, view.camera, tiles=everything.tiles_of(editable))
    ids = seen.gaussian_ids
    ones = np.ones(view.mask.shape, np.float32)
    colors = lift_colors(seen, view.target, ones, editable[ids], SETTINGS.rounds, hold[ids])
    sh = splats.sh.copy()
    sh[ids, 0] += (editable[ids, None] * (colors - np.maximum(seen.unclamped_colors, 0)) / SH_C0).astype(sh.dtype)
    return replace(lifted, splats=replace(splats, sh=sh))


def _table(network: Residual, held: Any, options: Options) -> str:
    """Means, and what each differs by from the lift's, over held-out edits and over captures."""
    found: dict[str, list[list[float]]] = {}
    number = done = 0
    while done < options.judged:
        try:
            edit, number = held.full_edit(number), number + 1
        except ValueError:
            number += 1
            continue
        done += 1
        for name, splats in _answers(network, edit.painted.asset, edit.lifted, edit.view):
            found.setdefault(name, []).append(_scores(edit, splats))
    columns = [f"{what} {d:g}" for d in SETTINGS.judged_degrees for what in ("novel", "soft")] + ["edited"]
    beside = {}
    for path in options.captures:
        one = Capture.of(path)
        for name, splats in _answers(network, one.asset, one.lifted, one.view):
            beside.setdefault(name, []).append(one.scored(splats))
    rows = []
    for name, values in found.items():
        cells = dict(zip(columns, (f"{v:.2f}" for v in np.nanmean(values, 0)), strict=True))
        if beside:
            means = np.mean(beside[name], 0)
            cells |= {"captures edited": f"{means[0]:.2f}", "captures beside": f"{means[1]:.2f}"}
        rows.append({"": name, **cells})
    return markdown(rows)


def _answers(network: Residual, asset: Splats, lifted: LiftedEdit, view: EditView) -> Iterator[tuple[str, Splats]]:
    alone, result = corrected(network, asset, lifted, view)
    yield "nothing", asset
    yield "lift", lifted.splats
    yield "lift, the same rounds", with_rounds(lifted, view).splats
    yield "correction alone", alone.splats
    yield "correction, rounds", result.splats


def _scores(edit: PaintedEdit, splats: Splats) -> list[float]:
    """PSNR in the paint: of novel views at each angle, plainly and after a blur of both by a pixel; of the edited."""
    found = []
    for degrees in SETTINGS.judged_degrees:
        ways = np.arange(4) * np.pi / 2 + 0.3
        cameras = [turned(edit.view.camera, _middle(edit.view), degrees, way) for way in ways]
        _, after, changed = _truth(edit, cameras)
        drawn = _drawn(splats, cameras)
        soft = [ndimage.gaussian_filter(x, (0, 1, 1, 0)) for x in (drawn, after)]
        enough = changed.sum() > 40
        pairs = ((drawn, after), (soft[0], soft[1]))
        found += [_decibels(one, other, changed) if enough else math.nan for one, other in pairs]
    return [*found, _decibels(_drawn(splats, [edit.view.camera])[0], edit.view.edited, edit.view.mask)]


def turned(camera: Camera, target: np.ndarray, degrees: float, way: float) -> Camera:
    """The target from `degrees` away in the direction `way`, radians around the line of sight."""
    offset = camera.position - target
    forward = _unit(offset)
    side = _unit(np.cross(_direction(angles(offset)[0] + 90, 0.0), forward))
    across = math.cos(way) * side + math.sin(way) * np.cross(forward, side)
    line = math.cos(math.radians(degrees)) * forward + math.sin(math.radians(degrees)) * across
    field_of_view = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
    optics = Optics(camera.height, field_of_view, camera.background)
    return _aimed(target + np.linalg.norm(offset) * line, target, optics)


def _middle(view: EditView) -> np.ndarray:
    """[3] of the painted surface."""
    assert view.depth is not None and view.alpha is not None
    y, x = np.nonzero(view.mask & (view.alpha > 0.5))
    return view.camera.unproject(view.depth[y, x], np.stack([x, y], 1) + 0.5).mean(0)


def _truth(edit: PaintedEdit, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(before, after, [V, H, W] bool where it changed)."""
    before, after = (_drawn(truth, cameras) for truth in (edit.painted.scene.truth, edit.sample.truth))
    return before, after, np.abs(after - before).max(-1) > SETTINGS.changed


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


def _csr(form: Any) -> Tensor:
    begins, columns = (torch.from_numpy(x.astype(np.int64)) for x in (form.indptr, form.indices))
    return torch.sparse_csr_tensor(begins, columns, torch.from_numpy(form.data.astype(np.float32)), form.shape)


def _value(form: Any, change: Tensor) -> Tensor:
    matrix, gradient, total = form
    return total - 2 * (gradient * change).sum() + (change * (matrix @ change)).sum()


def _decibels(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    return -10 * math.log10(max(float(np.square(picture - truth)[mask].mean()), 1e-9))


if __name__ == "__main__":
    print(main(tyro.cli(Options, description=Options.__doc__)))
