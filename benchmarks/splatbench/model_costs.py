"""How large the model is and what it costs: parameters and floating-point operations per stage, Gaussian and view
(`python -m splatbench.model_costs` prints them for both presets).

Counts matrix products only (2 per multiply-add), which is what the time goes into. D width of a latent, F hidden width
of the fast network, T tokens, G Gaussians per voxel.
"""

from __future__ import annotations

from dataclasses import dataclass

from splatpainter.models.config import CompressConfig, LrmConfig, ModelConfig, RefineConfig
from splatpainter.models.decode import output_count
from splatpainter.models.gaussian_groups import feature_count
from splatpainter.models.refine import DRIFT_FEATURES, LIFT_FEATURES


@dataclass(frozen=True)
class ParameterCounts:
    """Numbers that training fits."""

    lrm: int
    """The Gaussian LRM with its head."""
    compress: int
    """Stage I."""
    refine: int
    """Stage II with its first fast weights and the detail layer."""
    decode: int
    """The decoder."""
    predict: int
    """The predictor of unseen Gaussians."""

    @property
    def total(self) -> int:
        return self.lrm + self.compress + self.refine + self.decode + self.predict


@dataclass(frozen=True)
class Flops:
    """Floating-point operations of each stage."""

    view: float
    """LRM, per canonical view, with config.lrm.views of them (attention grows with their number)."""
    gaussian: float
    """Stage I, per Gaussian of the asset (before the choice by opacity)."""
    picture: float
    """Stage II, per edited picture of config.lrm.image_size pixels: adapting, without what an edit costs anyway."""
    edit: float
    """Stage II, per edit whatever its size: orthogonalising the updates."""
    latent: float
    """Stage II and decoder, per latent that is read."""
    detail: float
    """Second set of a local edit, per latent; 0 without a detail layer."""


def parameters(config: ModelConfig) -> ParameterCounts:
    """Counted on the meta device: nothing is allocated."""
    import torch

    from splatpainter.models.model import SplatPainterModel

    with torch.device("meta"):
        model = SplatPainterModel(config)
    parts = (*(model.encoders or (None, None)), model.refiner, model.head, model.predictor)
    return ParameterCounts(*(sum(p.numel() for p in part.parameters()) if part else 0 for part in parts))


def flops(config: ModelConfig, gaussians_per_voxel: float = 8.0, views: int | None = None) -> Flops:
    """gaussians_per_voxel: mean length of the groups of Stage I (a Gaussian meets this many); views: canonical views,
    by default config.lrm.views. The mixer must be "ttt"."""
    if config.refine.mixer != "ttt":
        raise ValueError(f"count: expected mixer 'ttt', got '{config.refine.mixer}': its cost depends on past edits")
    native = config.representation == "native"
    tokens = (config.lrm.image_size // config.refine.patch) ** 2
    dim = config.compress.dim
    keep = 1.0 if native else config.compress.keep
    decode = 2 * dim * output_count(config.sh_degree)
    return Flops(
        view=_lrm(config.lrm, views or config.lrm.views, head=not native) if config.refine.latents else 0.0,
        gaussian=_compress(config.compress, config.sh_degree, gaussians_per_voxel, keep)
        if config.refine.latents
        else 0.0,
        picture=tokens * _adapt(config.refine, dim),
        edit=config.refine.blocks * _orthogonalise(config.refine, dim)
        + config.refine.row_tokens * _teach(config.refine, dim),
        latent=_read(config.refine, dim) + decode,
        detail=_detail(config.refine, dim) + decode if config.refine.detail else 0.0,
    )


def table(config: ModelConfig) -> str:
    """Lines of text for people: parameters in millions, operations in units that fit."""
    size, cost = parameters(config), flops(config)
    return "\n".join(
        [
            f"preset {config.preset}: {size.total / 1e6:.2f} M parameters, {2 * size.total / 1e6:.1f} MB as float16",
            f"  LRM      {size.lrm / 1e6:8.2f} M   {cost.view / 1e9:10.1f} GFLOP per view ({config.lrm.views} views of"
            f" {config.lrm.image_size} px)",
            f"  Stage I  {size.compress / 1e6:8.2f} M   {cost.gaussian / 1e6:10.2f} MFLOP per Gaussian",
            f"  Stage II {size.refine / 1e6:8.2f} M   {cost.picture / 1e9:10.1f} GFLOP per picture"
            f" + {cost.edit / 1e9:.1f} GFLOP per edit",
            f"  decoder  {size.decode / 1e6:8.2f} M   {cost.latent / 1e6:10.2f} MFLOP per latent (with Stage II)"
            f" + {cost.detail / 1e6:.2f} for detail",
            *([f"  predictor{size.predict / 1e6:7.2f} M"] if size.predict else []),
        ]
    )


def _lrm(config: LrmConfig, views: int, head: bool) -> float:
    """Flops of the LRM per view."""
    area = config.patch**2
    per_view = (config.image_size // config.patch) ** 2
    dim = config.dim
    block = 2 * (4 * dim**2 + 2 * dim * config.hidden) + 4 * views * per_view * dim
    ends = 2 * area * dim * (11 if config.geometry else 9)
    if head:
        ends += 2 * area * dim * output_count(config.sh_degree)
    return float(per_view * (ends + config.layers * block))


def _compress(config: CompressConfig, degree: int, group: float, keep: float) -> float:
    """Per Gaussian, without the projection of the LRM's tokens (per patch). The mean of N_k^2 is taken as group^2."""
    dim = config.dim
    linear = 2 * (4 * dim**2 + 3 * dim * config.hidden)
    inputs = 2 * feature_count(degree) * dim
    if config.grouping == "voxel_mean":
        return inputs + (config.encoder_layers + config.decoder_layers) * (linear + 4 * dim) / group
    encoder = config.encoder_layers * (linear + 4 * group * dim)
    cross = 4 * dim**2 + keep * (4 * dim**2 + 4 * group * dim)
    decoder = config.decoder_layers * keep * (linear + 4 * keep * group * dim)
    return inputs + encoder + cross + decoder


def _adapt(config: RefineConfig, dim: int) -> float:
    """Flops of adaptation per picture token."""
    last = _learn(config, dim)
    block = last + 4 * dim**2 + 6 * dim * config.fast_hidden + 6 * dim * config.hidden
    total = 2 * config.patch**2 * config.channels * dim + (config.blocks - 1) * block + last
    if config.image_attention:
        total += config.blocks * 2 * 4 * dim**2  # without the products of its T^2 pairs
    return float(total)


def _learn(config: RefineConfig, dim: int) -> int:
    """Keys, values, rates, and the directions of the three matrices, per token."""
    products = 6 + (config.inner_loss == "l2")
    return 4 * dim**2 + 6 * dim + config.inner_steps * products * 2 * dim * config.fast_hidden


def _orthogonalise(config: RefineConfig, dim: int) -> float:
    """Newton-Schulz on the three matrices of one layer."""
    small, large = sorted((dim, config.fast_hidden))
    return 3.0 * config.inner_steps * config.newton_schulz_steps * (4 * small**2 * large + 2 * small**3)


def _read(config: RefineConfig, dim: int) -> float:
    """Flops of reading the memory per latent."""
    return float(_input_features(config, dim) + config.blocks * _read_block(config, dim))


def _read_block(config: RefineConfig, dim: int) -> int:
    return 4 * dim**2 + 6 * dim * config.fast_hidden + 6 * dim * config.hidden


def _input_features(config: RefineConfig, dim: int) -> int:
    return 2 * dim * (LIFT_FEATURES * config.lift_features + DRIFT_FEATURES * (config.base == "lift"))


def _teach(config: RefineConfig, dim: int) -> int:
    """Per Gaussian that teaches along: like a latent up to the last block, and as much as a picture token in each."""
    blocks = (config.blocks - 1) * _read_block(config, dim) + config.blocks * _learn(config, dim)
    return _input_features(config, dim) + blocks


def _detail(config: RefineConfig, dim: int) -> float:
    """Flops of the detail layer per latent."""
    return float(_learn(config, dim) + 4 * dim**2 + 6 * dim * config.fast_hidden)


if __name__ == "__main__":
    from splatpainter.models.config import PRESETS

    print("\n".join(table(config) for config in PRESETS.values()))
