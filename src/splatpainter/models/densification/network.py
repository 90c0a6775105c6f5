"""The network: points with features become more and finer points, level after level.

A level is attention inside windows along space-filling curves, a learned mask that says which points go on, and
children for those. All children of a row share its axes. Straight-through: the mask decides hard, and the points'
features are multiplied by 1 + m - detach(m) where they go on and by 1 - m + detach(m) where they stay, m in 0..1.

The order of the rows that come in does not matter, as long as no two lie in one cell of a curve and no two have one
chance of going on: what a row becomes is the same, up to rounding, and stands where the row stood.

M points, W width, c children per point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from splatpainter.models.decode import AttributeHead
from splatpainter.models.densification.config import DensifyConfig
from splatpainter.models.densification.curves import CURVES, along, windows
from splatpainter.models.densification.looks import Chosen, feature_count
from splatpainter.nn.attention import Groups
from splatpainter.nn.layers import EPS, Gelu, SelfAttention, linear
from splatpainter.splats import Splats

CELL = 3.0
"""Edge of a point's cell along each own axis, in its standard deviations; children stay within half of it."""
STEP = 0.6
"""Where an even split puts two children on an axis, in standard deviations of the parent ..."""
SHRINK = math.sqrt(1 - STEP**2)
"""... how wide they are there, so that the two together have the parent's variance ..."""
FAINTER = {2: (0.63, 0.09), 4: (0.395, 0.09)}
"""... and how opaque: a + b o of a parent's opacity o, fitted to the composited alpha of a parent seen along its third
axis, whose rms error is then 5 % (faint rows) to 17 % (opaque ones, 4 children)."""
OPACITY_SHIFT = -2.1792
"""Head "absolute": opacity sigmoid(raw + this), as published."""


@dataclass(frozen=True)
class Points:
    """M points on their way."""

    features: Tensor = field(repr=False)
    """[M, W]."""
    rows: Splats
    """What they would be drawn as if the head said nothing, torch."""
    axes: Tensor = field(repr=False)
    """[M, 3, 3] as Chosen.axes."""
    ranks: Tensor = field(repr=False)
    """[M, 3] as Chosen.ranks."""
    parents: Tensor = field(repr=False)
    """[M] int64 which of the chosen rows each comes from."""

    def take(self, index: Tensor) -> Points:
        picked = (getattr(self, name)[index] for name in ("axes", "ranks", "parents"))
        return Points(self.features[index], self.rows.take(index), *picked)


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
        asked = self.attention(_normal(x)[order] * (1 + gain) + shift, groups)
        x = x + torch.zeros_like(x).index_copy(0, order, asked.to(x.dtype))
        return x + self.mlp(_normal(x) * (1 + gain_mlp) + shift_mlp)


class Level(nn.Module):
    """Points in, those that stay and the children of the others out."""

    def __init__(self, config: DensifyConfig, width: int, out: int, children: int) -> None:
        """width: W; out: of a child's features."""
        super().__init__()
        self.config, self.born = config, children
        self.blocks = nn.ModuleList(
            WindowBlock(width, config.heads, config.expansion * width) for _ in range(config.blocks)
        )
        self.mask = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1))
        last = nn.Linear(width, 3 * children)
        nn.init.zeros_(last.weight)
        with torch.no_grad():
            last.bias.copy_(torch.atanh(even_split(children) / (CELL / 2)).flatten())
        self.offsets = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), last)
        self.skip = linear(width, out)
        self.lift = nn.Sequential(nn.Linear(width + 6 * config.frequencies, out), nn.GELU(), nn.Linear(out, out))

    def forward(self, points: Points, lo: np.ndarray, size: float, curves: list[str]) -> tuple[Points, Points]:
        """(leaves, children), in the order of their points. lo, size: of the asset's cube; curves: one per block."""
        x, count = points.features, len(points.features)
        means = points.rows.means.detach().cpu().numpy()
        groups = Groups.of(windows(count, self.config.window), x.device)
        for block, curve in zip(self.blocks, curves, strict=True):
            x = block(x, torch.from_numpy(along(means, lo, size, curve)).to(x.device), groups)
        chance = torch.sigmoid(self.mask(x)[:, 0])
        on = going_on(chance, self.config.keep)
        gate = on.to(chance.dtype) + chance - chance.detach()  # 1 or 0 in value
        going, staying = torch.nonzero(on)[:, 0], torch.nonzero(~on)[:, 0]
        points = replace(points, features=x)
        leaves = points.take(staying)
        leaves = replace(leaves, features=leaves.features * (1 - gate[staying])[:, None])
        points = points.take(going)
        return leaves, self._children(replace(points, features=points.features * gate[going][:, None]))

    def _children(self, points: Points) -> Points:
        x = points.features
        share = 0.5 * torch.tanh(self.offsets(x).float()).unflatten(1, (self.born, 3))  # [M, c, 3] of the cell
        index = torch.arange(len(x), device=x.device).repeat_interleave(self.born)
        family, share = points.take(index), share.flatten(0, 1)
        sigma = family.rows.scales.gather(1, family.ranks)
        moved = torch.einsum("mk,mka->ma", CELL * share * sigma, family.axes)
        split = x.new_tensor([SHRINK, SHRINK if self.born == 4 else 1.0, 1.0]).expand(len(index), 3)
        narrow = torch.ones_like(sigma).scatter(1, family.ranks, split)
        a, b = FAINTER[self.born]
        rows = replace(
            family.rows,
            means=family.rows.means + moved,
            scales=family.rows.scales * narrow,
            opacities=family.rows.opacities * (a + b * family.rows.opacities),
        )
        told = torch.cat([wave_code(share, self.config.frequencies).to(x.dtype), family.features], 1)
        return replace(family, rows=rows, features=self.skip(family.features) + self.lift(told))


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

    def forward(self, chosen: Chosen, rng: np.random.Generator | None = None) -> tuple[Splats, Tensor]:
        """(fine rows, [count] int64 the chosen row of each): leaves of each level, then the last level's children. rng:
        draws the curves of the blocks anew (training); None: they take turns."""
        origin = torch.arange(len(chosen.features), device=chosen.features.device)
        points = Points(self.embed(chosen.features), chosen.rows, chosen.axes, chosen.ranks, origin)
        found = []
        for k, level in enumerate(self.levels):
            order = np.arange(len(CURVES)) if rng is None else rng.permutation(len(CURVES))
            curves = [CURVES[order[(k * self.config.blocks + b) % len(CURVES)]] for b in range(self.config.blocks)]
            leaves, points = level(points, chosen.lo, chosen.size, curves)  # type: ignore[operator]
            found.append(leaves)
        found.append(points)
        cell = chosen.size / self.config.resolution
        drawn = [self._drawn(head, part, cell) for head, part in zip(self.heads, found, strict=True)]
        rows = drawn[0]
        for more in drawn[1:]:
            rows = rows.append(more)
        return rows, torch.cat([part.parents for part in found])

    def _drawn(self, head: nn.Module, points: Points, cell: float) -> Splats:
        assert isinstance(head, AttributeHead)
        raw = head(points.features)
        if self.config.head == "absolute":
            return absolute(points.rows, raw, cell)
        return head.attributes(raw, points.rows, points.rows.means, math.inf)


def even_split(children: int) -> Tensor:
    """[c, 3] offsets of an even split, in standard deviations along the longest, second and third axis."""
    sides = [(-STEP, 0.0), (STEP, 0.0)]
    if children == 4:
        sides = [(a, b) for a in (-STEP, STEP) for b in (-STEP, STEP)]
    return torch.tensor([(a, b, 0.0) for a, b in sides])


def going_on(chance: Tensor, keep: float) -> Tensor:
    """[M] bool: the ceil(keep M) points of the largest chance; of equals the first."""
    most = math.ceil(keep * len(chance) - 1e-9)
    chosen = torch.sort(chance.detach(), descending=True, stable=True).indices[:most]
    return torch.zeros_like(chance, dtype=torch.bool).index_fill(0, chosen, True)


def wave_code(share: Tensor, frequencies: int) -> Tensor:
    """[M, 3] offsets in cells (-0.5..0.5) -> [M, 6 frequencies]: sin and cos of 2^k pi times them, k = 0, 1, ..."""
    angle = share[:, :, None] * (math.pi * 2.0 ** torch.arange(frequencies, device=share.device))
    return torch.cat([angle.sin(), angle.cos()], -1).flatten(1)


def absolute(rows: Splats, raw: Tensor, cell: float) -> Splats:
    """Rows where the points are, with the published constants: opacity sigmoid(raw - 2.1792), scale 0.5 cell / (8 * 3)
    times exp(raw). raw: [M, C] as AttributeHead; its three numbers for the centre are not used."""
    _, scale, turn, opacity, sh = raw.split([3, 3, 4, 1, raw.shape[1] - 11], dim=1)
    bands = rows.sh.shape[1]
    low = sh.unflatten(1, (-1, 3))[:, :bands]
    return replace(
        rows,
        scales=0.5 * cell / (8 * 3) * torch.exp(scale.clamp(-8, 8)),
        quats=turn + turn.new_tensor([1.0, 0.0, 0.0, 0.0]),
        opacities=torch.sigmoid(opacity[:, 0] + OPACITY_SHIFT),
        sh=F.pad(low, (0, 0, 0, bands - low.shape[1])),
    )


def _normal(x: Tensor) -> Tensor:
    """LayerNorm without gain and shift."""
    return F.layer_norm(x, x.shape[-1:], eps=EPS)
