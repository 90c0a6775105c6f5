"""The densifier: an asset and pictures of what it should look like in, the asset with finer Gaussians where they
differ out, in one pass; nothing is optimised.

    result = densified(model, splats, cameras, colors)

Chosen Gaussians are replaced, not added to: the result is those that were not chosen, in their order, then the new
ones. The network: points with features become more and finer points, level after level. A level is attention inside
windows along space-filling curves, a learned mask that says which points go on, and children for those. All children of
a Gaussian share its axes. Straight-through: the mask decides hard, and the points' features are multiplied by
1 + m - detach(m) where they go on and by 1 - m + detach(m) where they stay, m in 0..1.

The order of the Gaussians that come in does not matter, as long as no two lie in one cell of a curve and no two have
one chance of going on: what a Gaussian becomes is the same, up to rounding, and stands where it stood.

Curves: neighbours on a space-filling curve are neighbours in space. Z-order (Morton 1966) interleaves the bits of the
coordinates; Hilbert's curve also never jumps (Skilling 2004, "Programming the Hilbert curve"). Both come also with x
and z exchanged, which cuts space elsewhere.

M points, W width, c children per point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from splatbench.densification.densify_config import DensifyConfig
from splatbench.densification.view_features import Chosen, choose, feature_count, gather, measure_views
from splatpainter.cameras import Camera
from splatpainter.models import checkpoint
from splatpainter.models.decode import AttributeHead
from splatpainter.nn.attention import Groups
from splatpainter.nn.layers import EPS, Gelu, SelfAttention, linear
from splatpainter.splats import Splats

CURVE_BITS = 10
"""Bits of each coordinate along a curve: 1,024 cells per edge."""
CURVES = ("z", "hilbert", "z-turned", "hilbert-turned")
CELL_DEVIATIONS = 3.0
"""Edge of a point's cell along each own axis, in its standard deviations; children stay within half of it."""
CHILD_OFFSET_DEVIATIONS = 0.6
"""Where an even split puts two children on an axis, in standard deviations of the parent."""
CHILD_SCALE = math.sqrt(1 - CHILD_OFFSET_DEVIATIONS**2)
"""How wide they are there, so that the two together have the parent's variance."""
CHILD_OPACITY_FITS = {2: (0.63, 0.09), 4: (0.395, 0.09)}
"""How opaque they are there: a + b o of a parent's opacity o, fitted to the composited alpha of a parent seen along its
third axis, whose rms error is then 5 % (faint Gaussians) to 17 % (opaque ones, 4 children)."""
OPACITY_SHIFT = -2.1792
"""Head "absolute": opacity sigmoid(raw + this), as published."""
MIN_CANDIDATES = 16
"""Gaussians to choose from; with fewer there is nothing to densify."""


def cells(means: np.ndarray, lo: np.ndarray, size: float, bits: int = CURVE_BITS) -> np.ndarray:
    """[M, 3] int64 cells of the points [M, 3] in the cube of edge `size` at `lo`; points outside: the nearest cell."""
    count = 1 << bits
    index = np.floor((means.astype(np.float64) - lo) * (count / size))
    return np.clip(index, 0, count - 1).astype(np.int64)


def z_order(cell: np.ndarray, bits: int = CURVE_BITS) -> np.ndarray:
    """[M] int64 keys of cells [M, 3]: bits x y z x y z ... from the highest to the lowest."""
    key = np.zeros(len(cell), np.int64)
    for bit in range(bits - 1, -1, -1):
        for axis in range(3):
            key = key << 1 | (cell[:, axis] >> bit & 1)
    return key


def hilbert(cell: np.ndarray, bits: int = CURVE_BITS) -> np.ndarray:
    """[M] int64 keys of cells [M, 3]: each cell's distance along the curve."""
    x = [cell[:, axis].copy() for axis in range(3)]
    for bit in range(bits - 1, 0, -1):  # undo the turns of each octant, from the largest to the smallest
        low = (1 << bit) - 1
        for axis in range(3):
            mirrored = (x[axis] >> bit & 1).astype(bool)
            swap = np.where(mirrored, 0, (x[0] ^ x[axis]) & low)
            x[0] = np.where(mirrored, x[0] ^ low, x[0]) ^ swap
            x[axis] = x[axis] ^ swap
    for axis in (1, 2):  # Gray code
        x[axis] = x[axis] ^ x[axis - 1]
    turn = np.zeros(len(cell), np.int64)
    for bit in range(bits - 1, 0, -1):
        turn = np.where(x[2] >> bit & 1, turn ^ ((1 << bit) - 1), turn)
    return z_order(np.stack([axis ^ turn for axis in x], 1), bits)


def along(means: np.ndarray, lo: np.ndarray, size: float, curve: str) -> np.ndarray:
    """[M] int64 the points in the order of one of CURVES; points of one cell keep their order."""
    cell = cells(means, lo, size)
    if curve.endswith("-turned"):
        cell = cell[:, ::-1]
    key = hilbert(cell) if curve.startswith("hilbert") else z_order(cell)
    return np.argsort(key, kind="stable")


def windows(count: int, window: int) -> list[int]:
    """Lengths of the runs of `window` points that `count` points are cut into; the last one may be shorter."""
    return [window] * (count // window) + ([count % window] if count % window else [])


@dataclass(frozen=True)
class Points:
    """M points between two levels of the network."""

    features: Tensor = field(repr=False)
    """[M, W]."""
    gaussians: Splats[Tensor]
    """What they would be drawn as if the head said nothing, torch."""
    axes: Tensor = field(repr=False)
    """[M, 3, 3] as Chosen.axes."""
    ranks: Tensor = field(repr=False)
    """[M, 3] as Chosen.ranks."""
    parents: Tensor = field(repr=False)
    """[M] int64 which of the chosen Gaussians each comes from."""

    def take(self, index: Tensor) -> Points:
        taken = (getattr(self, name)[index] for name in ("axes", "ranks", "parents"))
        return Points(self.features[index], self.gaussians.take(index), *taken)


class WindowBlock(nn.Module):
    """x + Attention(norm x), then x + MLP(norm x), attention inside windows; the norms' gains and shifts come from the
    mean of all points (adaptive LayerNorm), and are 1 and 0 at first."""

    def __init__(self, dim: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.attention = SelfAttention(dim, heads)
        self.mlp = Gelu(dim, hidden)
        self.adapt = nn.Linear(dim, 4 * dim)
        nn.init.zeros_(self.adapt.weight)
        nn.init.zeros_(self.adapt.bias)

    def forward(self, x: Tensor, order: Tensor, groups: Groups) -> Tensor:
        """x: [M, W]; order: [M] int64 the points along a curve; groups: the windows of that order."""
        gain, shift, gain_mlp, shift_mlp = self.adapt(F.silu(x.mean(0, keepdim=True))).chunk(4, dim=-1)
        attended = self.attention(_normal(x)[order] * (1 + gain) + shift, groups)
        x = x + torch.zeros_like(x).index_copy(0, order, attended.to(x.dtype))
        return x + self.mlp(_normal(x) * (1 + gain_mlp) + shift_mlp)


class Level(nn.Module):
    """Points in, those that stay and the children of the others out."""

    def __init__(self, config: DensifyConfig, width: int, out: int, children: int) -> None:
        """width: W; out: of a child's features."""
        super().__init__()
        self.config, self.child_count = config, children
        self.blocks = nn.ModuleList(
            WindowBlock(width, config.heads, config.expansion * width) for _ in range(config.blocks)
        )
        self.mask = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1))
        last = nn.Linear(width, 3 * children)
        nn.init.zeros_(last.weight)
        with torch.no_grad():
            last.bias.copy_(torch.atanh(even_split(children) / (CELL_DEVIATIONS / 2)).flatten())
        self.offsets = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), last)
        self.skip = linear(width, out)
        self.lift = nn.Sequential(nn.Linear(width + 6 * config.frequencies, out), nn.GELU(), nn.Linear(out, out))

    def forward(self, points: Points, lo: np.ndarray, size: float, curves: list[str]) -> tuple[Points, Points]:
        """(leaves, children), in the order of their points. lo, size: of the asset's cube; curves: one per block."""
        x, count = points.features, len(points.features)
        means = points.gaussians.means.detach().cpu().numpy()
        groups = Groups.of(windows(count, self.config.window), x.device)
        for block, curve in zip(self.blocks, curves, strict=True):
            x = block(x, torch.from_numpy(along(means, lo, size, curve)).to(x.device), groups)
        chance = torch.sigmoid(self.mask(x)[:, 0])
        on = split_mask(chance, self.config.keep)
        gate = on.to(chance.dtype) + chance - chance.detach()  # 1 or 0 in value
        going, staying = torch.nonzero(on)[:, 0], torch.nonzero(~on)[:, 0]
        points = replace(points, features=x)
        leaves = points.take(staying)
        leaves = replace(leaves, features=leaves.features * (1 - gate[staying])[:, None])
        points = points.take(going)
        return leaves, self._children(replace(points, features=points.features * gate[going][:, None]))

    def _children(self, points: Points) -> Points:
        x = points.features
        share = 0.5 * torch.tanh(self.offsets(x).float()).unflatten(1, (self.child_count, 3))  # [M, c, 3] of the cell
        index = torch.arange(len(x), device=x.device).repeat_interleave(self.child_count)
        family, share = points.take(index), share.flatten(0, 1)
        sigma = family.gaussians.scales.gather(1, family.ranks)
        moved = torch.einsum("mk,mka->ma", CELL_DEVIATIONS * share * sigma, family.axes)
        split = x.new_tensor([CHILD_SCALE, CHILD_SCALE if self.child_count == 4 else 1.0, 1.0]).expand(len(index), 3)
        narrow = torch.ones_like(sigma).scatter(1, family.ranks, split)
        a, b = CHILD_OPACITY_FITS[self.child_count]
        gaussians = replace(
            family.gaussians,
            means=family.gaussians.means + moved,
            scales=family.gaussians.scales * narrow,
            opacities=family.gaussians.opacities * (a + b * family.gaussians.opacities),
        )
        code = torch.cat([wave_code(share, self.config.frequencies).to(x.dtype), family.features], 1)
        return replace(family, gaussians=gaussians, features=self.skip(family.features) + self.lift(code))


class Network(nn.Module):
    """All levels and their heads."""

    def __init__(self, config: DensifyConfig) -> None:
        super().__init__()
        self.config = config
        widths = (*config.widths, config.widths[-1])
        self.embed = nn.Linear(feature_count(config), widths[0])
        self.levels = nn.ModuleList(
            Level(config, widths[k], widths[k + 1], count) for k, count in enumerate(config.children)
        )
        kind = "bounded" if config.head == "relative" else "absolute"
        self.heads = nn.ModuleList(AttributeHead(width, config.sh_degree, kind) for width in widths)

    def forward(self, chosen: Chosen, rng: np.random.Generator | None = None) -> tuple[Splats[Tensor], Tensor]:
        """(fine Gaussians, [count] int64 the chosen one of each): leaves of each level, then the last level's children.
        rng: draws the curves of the blocks anew (training); None: they take turns."""
        origin = torch.arange(len(chosen.features), device=chosen.features.device)
        points = Points(self.embed(chosen.features), chosen.gaussians, chosen.axes, chosen.ranks, origin)
        parts = []
        for k, level in enumerate(self.levels):
            order = np.arange(len(CURVES)) if rng is None else rng.permutation(len(CURVES))
            curves = [CURVES[order[(k * self.config.blocks + b) % len(CURVES)]] for b in range(self.config.blocks)]
            leaves, points = level(points, chosen.lo, chosen.size, curves)  # type: ignore[operator]
            parts.append(leaves)
        parts.append(points)
        cell = chosen.size / self.config.resolution
        drawn = [self._drawn(head, part, cell) for head, part in zip(self.heads, parts, strict=True)]
        gaussians = drawn[0]
        for more in drawn[1:]:
            gaussians = gaussians.append(more)
        return gaussians, torch.cat([part.parents for part in parts])

    def _drawn(self, head: nn.Module, points: Points, cell: float) -> Splats[Tensor]:
        assert isinstance(head, AttributeHead)
        raw = head(points.features)
        if self.config.head == "absolute":
            return absolute(points.gaussians, raw, cell)
        return head.attributes(raw, points.gaussians, points.gaussians.means, math.inf)


def even_split(children: int) -> Tensor:
    """[c, 3] offsets of an even split, in standard deviations along the longest, second and third axis."""
    sides = [(-CHILD_OFFSET_DEVIATIONS, 0.0), (CHILD_OFFSET_DEVIATIONS, 0.0)]
    if children == 4:
        sides = [
            (a, b)
            for a in (-CHILD_OFFSET_DEVIATIONS, CHILD_OFFSET_DEVIATIONS)
            for b in (-CHILD_OFFSET_DEVIATIONS, CHILD_OFFSET_DEVIATIONS)
        ]
    return torch.tensor([(a, b, 0.0) for a, b in sides])


def split_mask(chance: Tensor, keep: float) -> Tensor:
    """[M] bool: the ceil(keep M) points of the largest chance; of equals the first."""
    most = math.ceil(keep * len(chance) - 1e-9)
    chosen = torch.sort(chance.detach(), descending=True, stable=True).indices[:most]
    return torch.zeros_like(chance, dtype=torch.bool).index_fill(0, chosen, True)


def wave_code(share: Tensor, frequencies: int) -> Tensor:
    """[M, 3] offsets in cells (-0.5..0.5) -> [M, 6 frequencies]: sin and cos of 2^k pi times them, k from 0."""
    angle = share[:, :, None] * (math.pi * 2.0 ** torch.arange(frequencies, device=share.device))
    return torch.cat([angle.sin(), angle.cos()], -1).flatten(1)


def absolute(gaussians: Splats[Tensor], raw: Tensor, cell: float) -> Splats[Tensor]:
    """Gaussians where the points are, with the published constants: opacity sigmoid(raw - 2.1792), scale
    0.5 cell / (8 * 3) times exp(raw). raw: [M, C] as AttributeHead; its three numbers for the centre are not used."""
    _, scale, turn, opacity, sh = raw.split([3, 3, 4, 1, raw.shape[1] - 11], dim=1)
    bands = gaussians.sh.shape[1]
    low = sh.unflatten(1, (-1, 3))[:, :bands]
    return replace(
        gaussians,
        scales=0.5 * cell / (8 * 3) * torch.exp(scale.clamp(-8, 8)),
        quats=turn + turn.new_tensor([1.0, 0.0, 0.0, 0.0]),
        opacities=torch.sigmoid(opacity[:, 0] + OPACITY_SHIFT),
        sh=F.pad(low, (0, 0, 0, bands - low.shape[1])),
    )


def _normal(x: Tensor) -> Tensor:
    """LayerNorm without gain and shift."""
    return F.layer_norm(x, x.shape[-1:], eps=EPS)


class Densifier(nn.Module):
    """The network with its weights."""

    notes: dict[str, Any]
    """What the checkpoint said about these weights; empty for untrained ones."""

    def __init__(self, config: DensifyConfig) -> None:
        """Untrained; seed torch before for reproducible weights."""
        super().__init__()
        self.config, self.notes = config, {}
        self.network = Network(config)

    @staticmethod
    def load(folder: Path | str) -> Densifier:
        """The model of a checkpoint, float32 on the CPU, ready to use (eval). Raises ValueError as checkpoint.load and
        checkpoint.fill."""
        saved = checkpoint.load(folder, kind=DensifyConfig)
        model = Densifier(saved.config)
        checkpoint.fill(model, saved.tensors, str(folder))
        model.notes = saved.notes
        return model.eval()

    def save(self, folder: Path | str, notes: dict[str, Any] | None = None) -> None:
        """Write a checkpoint in half precision, all or nothing. Raises ValueError as checkpoint.save."""
        checkpoint.save(folder, self.config, self.state_dict(), notes=self.notes if notes is None else notes)

    def forward(self, chosen: Chosen, rng: np.random.Generator | None = None) -> tuple[Splats[Tensor], Tensor]:
        """As Network.forward, for Gaussians and features on any device."""
        device = next(self.parameters()).device
        tensors = {name: getattr(chosen, name).to(device) for name in ("axes", "ranks", "features")}
        return self.network(replace(chosen, gaussians=chosen.gaussians.torch(str(device)), **tensors), rng)


@dataclass(frozen=True)
class Densified:
    """Finer Gaussians that came out. Torch."""

    splats: Splats[Tensor]
    """Gaussians that stayed, then the new ones; differentiable in the weights."""
    chosen: np.ndarray = field(repr=False)
    """[S] int64 ascending: Gaussians of the asset that were replaced."""
    parents: np.ndarray = field(repr=False)
    """[new Gaussians] int64: the Gaussian of the asset that each replaces a part of."""


def prepared(
    config: DensifyConfig,
    splats: Splats,
    cameras: Sequence[Camera],
    colors: Sequence[np.ndarray],
    device: str = "cpu",
) -> tuple[np.ndarray, Chosen]:
    """(Gaussians to be replaced [S], the same as the network takes them). splats: numpy; colors: V pictures [H, W, 3]
    over their cameras' backgrounds, sizes may differ. Raises ValueError without views, for a picture of another size
    than its camera's, and where the views pull at fewer than MIN_CANDIDATES."""
    if not cameras or len(cameras) != len(colors):
        raise ValueError(f"densify: expected a picture for each camera, got {len(colors)} for {len(cameras)}")
    for camera, color in zip(cameras, colors, strict=True):
        if color.shape != (camera.height, camera.width, 3):
            raise ValueError(f"densify: expected {camera.width}x{camera.height} RGB pictures, got {list(color.shape)}")
    measured = measure_views(splats, cameras, colors, device)
    chosen = choose(splats, measured.pull, config)
    if len(chosen) < MIN_CANDIDATES:
        raise ValueError(f"densify: expected views that show at least {MIN_CANDIDATES} Gaussians, got {len(chosen)}")
    return chosen, gather(splats, chosen, measured, cameras, colors, config)


def densified(
    model: Densifier,
    splats: Splats,
    cameras: Sequence[Camera],
    colors: Sequence[np.ndarray],
    rng: np.random.Generator | None = None,
    most: int = 0,
) -> Densified:
    """One pass. Arguments and errors as `prepared`; rng as Network.forward; most: Gaussians to be replaced, 0:
    as the config says."""
    device = str(next(model.parameters()).device)
    config = replace(model.config, most=most or model.config.most)
    chosen, inputs = prepared(config, splats, cameras, colors, "cuda" if device.startswith("cuda") else device)
    fine, parents = model(inputs, rng)
    remaining = np.ones(len(splats), bool)
    remaining[chosen] = False
    coarse = replace(splats.take(remaining), source=None, origin=None).torch(device)
    return Densified(coarse.append(fine), chosen, chosen[parents.cpu().numpy()])
