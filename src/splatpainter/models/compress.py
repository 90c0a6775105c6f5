"""Stage I: a transformer inside each voxel turns Gaussians with their LRM tokens into latents (arXiv 2512.05354, 3.1).

N Gaussians of the asset, M of them grouped (packed), K kept, B groups, P patches, D width. Nothing crosses a voxel's
border, so the Gaussians are worked through in runs of whole voxels, and any run gives what the whole would give.
"""

from __future__ import annotations

from dataclasses import field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from splatpainter.models.config import CompressConfig
from splatpainter.models.gaussian_groups import GaussianGroups, TokenLinks, attribute_features, feature_count
from splatpainter.nn.attention import CrossGroups, Groups
from splatpainter.nn.layers import CrossAttention, PackedBlock, layer_norm, linear
from splatpainter.nn.precision import exact
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

GAUSSIANS_PER_CHUNK = 1 << 13
"""Gaussians that are worked on at once without gradients: what they pass from layer to layer stays in the cache
(measured on two cores in Stage II: 65 instead of 50 GFLOP/s per core with 32,768, and 150 instead of 85 in bf16)."""


@dataclass(frozen=True)
class Latents:
    """What Stage I knows of the kept Gaussians."""

    values: Tensor = field(repr=False)
    """[K, D] of any float type, packed as `groups` says."""
    groups: GaussianGroups
    """The kept Gaussians: groups.order[i] is the Gaussian of the asset that values[i] belongs to."""

    @cached_property
    def scale(self) -> LatentScale:
        """Scale of all latents, for Stage II; worked out on first use."""
        return LatentScale.of(self.values)


@dataclass(frozen=True)
class LatentScale:
    """What Stage II with "normalised" inputs subtracts from the latents of an asset, and divides them by."""

    mean: Tensor = field(repr=False)
    """[D] float32, over all latents of the asset."""
    rms: Tensor
    """[] float32, of what is left of all of them."""

    @staticmethod
    def of(latents: Tensor) -> LatentScale:
        """latents: [K, D] of any float type."""
        count, width = max(len(latents), 1), latents.shape[1]
        zero = torch.zeros(width, dtype=torch.float64, device=latents.device)
        # In float64, as sums over a million latents lose digits; in parts, as a copy of all of them takes gigabytes.
        mean = sum((part.double().sum(0) for part in latents.split(GAUSSIANS_PER_CHUNK)), zero) / count
        power = sum(((part.double() - mean).square().sum(0) for part in latents.split(GAUSSIANS_PER_CHUNK)), zero)
        return LatentScale(mean.float(), (power.sum() / (count * width)).sqrt().clamp_min(1e-12).float())


class Compressor(nn.Module):
    """Stage I with its weights."""

    def __init__(self, config: CompressConfig, token_dim: int, degree: int, share: float) -> None:
        """token_dim: width of the LRM's tokens; degree: SH degree that it sees; share: of a voxel's Gaussians that is
        kept (1 for `native`)."""
        super().__init__()
        self.config, self.degree, self.share = config, degree, share
        dim = config.dim
        # One linear layer on the concatenation (token, attributes) is the sum of two; the first, once per patch.
        self.token_norm = layer_norm(token_dim)
        self.token = linear(token_dim, dim)
        # torch's own spread, 1 / sqrt(3 inputs): the 0.02 of wide layers would drown so few numbers.
        self.attribute = nn.Linear(feature_count(degree), dim, bias=False)
        self.encoder = nn.ModuleList(
            PackedBlock(dim, config.heads, config.hidden) for _ in range(config.encoder_layers)
        )
        self.decoder = nn.ModuleList(
            PackedBlock(dim, config.heads, config.hidden) for _ in range(config.decoder_layers)
        )
        if config.grouping != "voxel_mean":
            self.query_norm = layer_norm(dim)
            self.key_norm = layer_norm(dim)
            self.cross = CrossAttention(dim, config.heads)
        if config.grouping == "latent_query":
            empty = torch.empty(config.latent_queries, dim)
            self.queries = nn.Parameter(empty if empty.is_meta else empty.normal_() * 0.02)

    def forward(
        self,
        tokens: Tensor,
        gaussians: Splats[Tensor],
        links: TokenLinks,
        groups: GaussianGroups,
        *,
        chunk: int | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Latents:
        """Latents of the kept Gaussians. tokens: [P, token_dim] of the LRM, of any float
        type; gaussians: the asset, N of them, torch attributes on the same device; links: of the N Gaussians; groups:
        of the Gaussians; chunk: Gaussians at once (GAUSSIANS_PER_CHUNK without gradients, else all); dtype: of the
        result (a million latents of width 256 are 1 GB in float32).

        Permuting the Gaussians permutes the latents with them, up to rounding (equal opacities in a voxel excepted).
        """
        if len(links.patches) != len(gaussians):
            raise ValueError(f"encode: expected links of {len(gaussians)} Gaussians, got {len(links.patches)}")
        table = self.token(self.token_norm(tokens.float())).float()
        chosen, _ = groups.most_opaque(self.share)
        size = max(chunk or (len(groups) if torch.is_grad_enabled() else GAUSSIANS_PER_CHUNK), 1)
        parts = (self._part(table, gaussians, links, part) for part in groups.chunks(size))
        if torch.is_grad_enabled():
            return Latents(torch.cat([*parts, table.new_zeros(0, self.config.dim)]).to(dtype), chosen)
        # In place: torch.cat would need the memory twice (and refuses float16 under bf16 autocast).
        values = torch.empty(len(chosen), self.config.dim, dtype=dtype, device=table.device)
        done = 0
        for part in parts:
            values[done : done + len(part)] = part
            done += len(part)
        return Latents(values, chosen)

    def _part(self, table: Tensor, gaussians: Splats[Tensor], links: TokenLinks, groups: GaussianGroups) -> Tensor:
        """[K, D] latents of some groups. table: [P, D] projected tokens."""
        x = self._embed(table, gaussians, links, groups)
        chosen, indices = groups.most_opaque(self.share)
        if self.config.grouping == "voxel_mean":
            return self._voxel_mean(x, groups, chosen)
        within = Groups.of(groups.lengths, x.device)
        x = self._run(self.encoder, x, within)
        if self.config.grouping == "latent_query":
            ends = torch.from_numpy(chosen.starts)
            nth = torch.arange(len(chosen)) - torch.repeat_interleave(ends[:-1], ends.diff(), output_size=len(chosen))
            query = self.queries[(nth % self.config.latent_queries).to(x.device)]
        else:
            query = x if self.share == 1 else x[torch.from_numpy(indices).to(x.device)]
        cross = CrossGroups.of(chosen.lengths, groups.lengths, x.device)
        z = query + self.cross(self.query_norm(query), self.key_norm(x), cross)
        return self._run(self.decoder, z, within if self.share == 1 else Groups.of(chosen.lengths, x.device))

    def _embed(self, table: Tensor, gaussians: Splats[Tensor], links: TokenLinks, groups: GaussianGroups) -> Tensor:
        """[M, D]: W_f (weighted mean of the Gaussian's tokens) + W_g (attributes)."""
        patches = torch.from_numpy(links.patches[groups.order]).to(table.device)
        weights = torch.from_numpy(links.weights[groups.order]).to(table.device, table.dtype)
        token_mean = F.embedding_bag(patches, table, per_sample_weights=weights, mode="sum")
        # Float32 also under autocast: what the layers add up stays exact, only what they multiply is rounded.
        with exact(table.device):
            return token_mean + self.attribute(attribute_features(gaussians, groups, self.degree))

    def _voxel_mean(self, x: Tensor, groups: GaussianGroups, chosen: GaussianGroups) -> Tensor:
        """VoxelAtt: the mean token of each voxel, through layers of the same depth, handed to each of its kept
        Gaussians."""
        # No attention between Gaussians here: each voxel is one token.
        lengths = torch.from_numpy(groups.lengths).to(x.device)
        owner = torch.repeat_interleave(torch.arange(len(lengths), device=x.device), lengths, output_size=len(x))
        mean = x.new_zeros(len(lengths), x.shape[1]).index_add(0, owner, x) / lengths.clamp(min=1)[:, None].to(x.dtype)
        single = Groups.of(np.ones(len(lengths), np.int64), x.device)
        mean = self._run(self.decoder, self._run(self.encoder, mean, single), single)
        counts = torch.from_numpy(chosen.lengths).to(x.device)
        return torch.repeat_interleave(mean, counts, dim=0, output_size=len(chosen))

    def _run(self, layers: nn.ModuleList, x: Tensor, groups: Groups) -> Tensor:
        for layer in layers:
            if self.config.checkpoint_activations and torch.is_grad_enabled():
                x = checkpoint(layer, x, groups, use_reentrant=False)  # type: ignore[assignment]
            else:
                x = layer(x, groups)
        return x
