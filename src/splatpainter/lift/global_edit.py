"""Global lift: one to four regraded or relit views change the whole asset, also what they do not show.

The rows that the views show are lifted as in colors.py; then new colour is regressed on SH_2(normal) x (old colour, 1)
by ridge regression over them (the linear cousin of test-time training) and predicted for all others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatpainter.cameras import Camera, orbit
from splatpainter.lift.colors import BRIGHTEST
from splatpainter.lift.split import rotations
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import SH_C0, Splats


@dataclass(frozen=True)
class GlobalOptions:
    """How a global lift trusts what it saw."""

    rounds: int = 5
    """Colour rounds over all views at once."""
    last_rounds: int = 3
    """Further ones, which start from what the regression says of every row."""
    hold: float = 0.1
    """Pixels of weight with which these hold on to the regression: what views see little of is predicted. With 1, 2 and
    4 relit views 0.21, 0.03 and -0.04 dB on novel views over mixing both by `half_seen`; 0.2 where more is known."""
    ridge: float = 1e-3
    """Ridge weight of the affine part, relative to the seen rows' total weight."""
    ridge_normals: float = 1e-2
    """The same for the part that depends on the normal (light directions that no view shows stay unchanged)."""
    half_seen: float = 2.0
    """A row seen with this many pixels of weight counts as half seen, half predicted."""


Predict = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Another regression in place of this one: (change [N, 3] of base colour of rows that are seen, weight [N] pixels that
show each row) -> [N, 3] change of every row."""
RING = 8
"""Views around the asset that decide which side of a row is its outside."""


@dataclass(frozen=True)
class Regraded:
    """Result of a global lift."""

    splats: Splats
    confidence: np.ndarray
    """[N] float32 0..1: how much of each row's new colour was seen (1) rather than predicted; predictions far from
    everything seen go to 0."""
    seen: np.ndarray
    """[N] float32 0..1: the lift's share of each row's new colour; the rest is the regression's."""
    predicted: np.ndarray
    """[N, 3] float32 base colours that the regression says."""
    normals: np.ndarray
    """[N, 3] float32 unit normals, outwards (`outward_normals`); zeros for rows that cannot be drawn."""


def lift_global(
    splats: Splats,
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],
    options: GlobalOptions = GlobalOptions(),
    normals: np.ndarray | None = None,
    predict: Predict | None = None,
) -> Regraded:
    """Regrade all rows by (camera, target [H, W, 3], mask [H, W] bool) views. Pixels that the asset covers by less than
    0.9 are not learnt from (their colour is the background's too). Rows that cannot be drawn keep their bits. normals:
    [N, 3] of `outward_normals`, where they are known already. predict: says what the rows become that no view shows, in
    place of the ridge regression, which then only turns SH bands >= 1. Raises ValueError when the views show no solid
    part of the asset."""
    drawable = splats.drawable
    normals = outward_normals(splats) if normals is None else normals
    if not drawable.all():  # a NaN would spread through the regression

        def among(change: np.ndarray, weight: np.ndarray) -> np.ndarray:
            assert predict is not None
            return predict(_spread(change, drawable), _spread(weight, drawable))[drawable]

        some = lift_global(splats.take(drawable), views, options, normals[drawable], predict and among)
        sh = splats.sh.copy()
        sh[drawable] = some.splats.sh
        told = (some.confidence, some.seen, some.predicted, some.normals)
        return Regraded(replace(splats, sh=sh), *(_spread(values, drawable) for values in told))
    old = 0.5 + SH_C0 * splats.sh[:, 0]  # [N, 3] base colours
    shown, weight = _prepared(splats, views)
    change = _colored([view.frame for view in shown], shown, weight, options.rounds)
    seen = weight > SEEN
    if not seen.any():
        raise ValueError(
            "edit: the views show no solid part of the asset (alpha above 0.9); check the cameras and masks"
        )
    features = _features(np.clip(old, 0, 1), normals)
    solution, spread = _ridge(features[seen], change[seen], weight[seen], options)
    predicted = features @ solution if predict is None else predict(change, weight)  # [N, 3] change of base colour
    trust = (weight / (weight + options.half_seen))[:, None]
    new = np.clip(old + predicted, np.minimum(old, 0), np.maximum(old, BRIGHTEST))
    sh = splats.sh.copy()
    sh[:, 0] = (new - 0.5) / SH_C0
    if sh.shape[1] > 1:
        sh[:, 1:] = sh[:, 1:] @ _matrices(features, solution).transpose(0, 2, 1)
    result = replace(splats, sh=sh.astype(splats.sh.dtype))
    if options.last_rounds:
        frames = [project(result, view.camera) for view in shown]
        result.sh[:, 0] += _colored(frames, shown, weight, options.last_rounds, options.hold) / SH_C0  # its own copy
    leverage = ((features @ spread.astype(np.float32)) * features).sum(1)
    typical = np.maximum(np.average(leverage[seen], weights=weight[seen]), 1e-12)
    certain = trust[:, 0] + (1 - trust[:, 0]) * 0.5 / (1 + leverage / (4 * typical))
    told = (certain, trust[:, 0], old + predicted, normals)
    return Regraded(result, *(part.astype(np.float32) for part in told))


def _spread(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """values [M, ...] in the M places of rows [N] bool, zeros elsewhere."""
    whole = np.zeros((len(rows), *values.shape[1:]), values.dtype)
    whole[rows] = values
    return whole


def seen_change(
    splats: Splats,
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],
    options: GlobalOptions = GlobalOptions(),
) -> tuple[np.ndarray, np.ndarray]:
    """What a global lift learns from: ([N, 3] float32 change of base colour of the rows that the views show, zeros for
    others, [N] float32 pixels that show each). splats: drawable rows; views: as in `lift_global`."""
    shown, weight = _prepared(splats, views)
    return _colored([view.frame for view in shown], shown, weight, options.rounds), weight


def regressed(
    splats: Splats,
    normals: np.ndarray,
    change: np.ndarray,
    weight: np.ndarray,
    options: GlobalOptions = GlobalOptions(),
) -> np.ndarray:
    """[N, 3] change of base colour of all rows, by the lift's ridge regression on those that are seen (at least one).
    splats: drawable rows; normals: [N, 3]; change, weight: of `seen_change`."""
    features = _features(np.clip(0.5 + SH_C0 * splats.sh[:, 0], 0, 1), normals)
    seen = weight > SEEN
    return features @ _ridge(features[seen], change[seen], weight[seen], options)[0]


SEEN = 0.05
"""Pixels of weight from which a row counts as seen."""
CONFLICT = 0.15
"""Wanted changes of one row that differ by more than this between views are a conflict: the later view decides."""


@dataclass(frozen=True)
class _Shown:
    """One view of the edit."""

    camera: Camera
    target: np.ndarray
    use: np.ndarray
    """[H, W] float32: 1 where pixels count."""
    weight: np.ndarray
    """[N] float32 pixels that show each row; 0 where a later view contradicts."""
    frame: ProjectedView
    """The asset before the edit, in this view."""


def _prepared(
    splats: Splats, views: Sequence[tuple[Camera, np.ndarray, np.ndarray]]
) -> tuple[list[_Shown], np.ndarray]:
    """(views, [N] summed weight); where views conflict about a row, only the latest that sees it counts."""
    n = len(splats)
    shown: list[_Shown] = []
    last, decided = np.zeros((n, 3), np.float32), np.zeros(n, bool)
    for camera, target, mask in reversed(views):  # latest first
        frame = project(splats, camera)
        _, alpha, _ = frame.rasterize()
        use = (mask & (alpha > 0.9)).astype(np.float32)
        weight, rows = frame.backproject(target, use).weight, frame.gaussian_ids
        gain, _ = frame.sirt_step(target, use, np.maximum(frame.unclamped_colors, 0))
        wish = gain / np.maximum(weight, 1e-6)[:, None]
        weight[decided[rows] & (np.abs(wish - last[rows]).max(1) > CONFLICT)] = 0
        fresh = (weight > 1) & ~decided[rows]
        last[rows[fresh]], decided[rows[fresh]] = wish[fresh], True
        whole = np.zeros(n, np.float32)
        whole[rows] = weight
        shown.append(_Shown(camera, target, use, whole, frame))
    shown.reverse()
    return shown, np.sum([view.weight for view in shown], axis=0)


def _colored(
    frames: Sequence[ProjectedView], shown: Sequence[_Shown], total: np.ndarray, rounds: int, hold: float = 0.0
) -> np.ndarray:
    """[N, 3] change of base colour that takes all views' error down, all at once. frames: of the asset, per view;
    hold: pixels of weight that pull every row back to no change."""
    change = np.zeros((len(total), 3), np.float32)
    for _ in range(rounds):
        gain = np.zeros_like(change)
        for frame, view in zip(frames, shown, strict=True):
            rows = frame.gaussian_ids
            colors = np.clip(frame.unclamped_colors + change[rows], 0, np.maximum(frame.unclamped_colors, BRIGHTEST))
            own = frame.sirt_step(view.target, view.use, colors)[0]
            gain[rows] += np.where(view.weight[rows, None] > 0, own, 0)
        change += (gain - hold * change) / np.maximum(total + hold, 1e-6)[:, None]
        np.clip(change, -BRIGHTEST, BRIGHTEST, out=change)
    return np.where(total[:, None] > SEEN, change, 0)


def outward_normals(splats: Splats, ring: int = RING) -> np.ndarray:
    """[N, 3] float32 unit shortest axes, turned towards the side from which a ring of views sees the row (else away
    from the asset's centre); zeros for rows that cannot be drawn. Colours have no part in them. At least one row must
    be drawable."""
    drawable = splats.drawable
    if not drawable.all():
        return _spread(outward_normals(splats.take(drawable), ring), drawable)
    n = len(splats)
    shortest = splats.scales.argmin(1)
    normal = rotations(splats.quats)[np.arange(n), :, shortest]
    center = np.median(splats.means, 0)
    radius = float(np.quantile(np.linalg.norm(splats.means - center, axis=1), 0.98))
    towards = 1e-3 * (splats.means - center) / max(radius, 1e-9)  # [N, 3] mean direction to the views that see it
    for k in range(ring):
        tilt = 35.0 if k % 2 else -20.0
        camera = orbit(center, 2.8 * radius, 1, elevation=tilt, start=360.0 * k / ring, width=160, height=160)[0]
        frame = project(splats, camera)
        sums = frame.backproject(np.zeros((160, 160, 3), np.float32), np.ones((160, 160), np.float32))
        away = camera.position.astype(np.float32) - splats.means[frame.gaussian_ids]
        # What shimmers through the far wall is seen from within.
        weight = np.where(sums.weight > 0.1 * sums.alpha, sums.weight, 0)
        towards[frame.gaussian_ids] += weight[:, None] * away / np.linalg.norm(away, axis=1, keepdims=True)
    side = np.einsum("ni,ni->n", normal, towards)
    normal = np.where(side[:, None] < 0, -normal, normal)
    return normal.astype(np.float32)


def _features(colors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[N, 36]: nine real spherical harmonics of the normal, each times (r, g, b, 1); the constant one's four first."""
    x, y, z = normals.T
    basis = np.stack([np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], 1)
    rgb1 = np.concatenate([colors, np.ones((len(colors), 1), colors.dtype)], 1)
    return (basis[:, :, None] * rgb1[:, None]).reshape(len(colors), 36).astype(np.float32)


def _ridge(
    features: np.ndarray, change: np.ndarray, weight: np.ndarray, options: GlobalOptions
) -> tuple[np.ndarray, np.ndarray]:
    """(solution [36, 3], inverse normal matrix [36, 36]) in float64."""
    capped = np.minimum(weight, 50.0).astype(np.float64)  # a huge row must not outvote a thousand small ones
    scaled = features * np.sqrt(capped).astype(np.float32)[:, None]
    gram = (scaled.T @ scaled).astype(np.float64)
    penalty = np.full(36, options.ridge_normals)
    penalty[:4] = options.ridge
    inverse = np.linalg.inv(gram + np.diag(penalty * capped.sum()))
    return inverse @ (scaled.T @ (change * np.sqrt(capped)[:, None]).astype(np.float32)), inverse


def _matrices(features: np.ndarray, solution: np.ndarray) -> np.ndarray:
    """[N, 3, 3] d new colour / d old colour of the regression, which acts on SH bands >= 1 too; kept within 0..2 on the
    diagonal so that an extrapolation never inverts a highlight."""
    basis = features.reshape(-1, 9, 4)[:, :, 3]  # the SH of the normal (the feature that multiplies 1)
    linear = solution.reshape(9, 4, 3)[:, :3]  # [9, in, out]
    matrix = (basis @ linear.transpose(0, 2, 1).reshape(9, 9).astype(np.float32)).reshape(-1, 3, 3) + np.eye(3)
    diagonal = np.clip(np.einsum("nii->ni", matrix), 0, 2)
    matrix[:, [0, 1, 2], [0, 1, 2]] = diagonal
    return matrix.astype(np.float32)
