"""The whole model as pure calls: views to tokens, rows to latents, edits to a next state, latents to attributes.

    tokens  = model.encode_views(views)                           once per asset: the Gaussian LRM
    latents = model.encode_rows(tokens, rows, links, groups)      once per asset: Stage I
    refined = model.refine(state, latents, pictures, ...)         per edit: Stage II, state in and state out
    decoded = model.decode(latents, refined, rows)                new attributes of the chosen rows, and further rows
    state, decoded = model.edit(state, latents, pictures, rows)   both at once, in bounded memory

In `copy` representation the rows are not the user's: `copy_rows` makes them from the views. Nothing is written into an
argument, nothing is remembered between calls. N rows, K latents, J chosen latents, D width.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from splatpainter.models import checkpoint
from splatpainter.models.compress import Compressor, Latents
from splatpainter.models.config import ModelConfig
from splatpainter.models.decode import AttributeHead, is_born, newborn
from splatpainter.models.lrm import AssetViews, GaussianLrm
from splatpainter.models.pictures import Pictures, tokenize
from splatpainter.models.refine import CHUNK, Refiner, RefineState
from splatpainter.models.rows import RowGroups, TokenLinks
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.voxels import VoxelGrid


def fast_math(device: torch.device | str = "cpu") -> torch.autocast:
    """A context in which matrix products use bf16 where this machine multiplies it faster than float32 (CUDA; CPUs with
    AVX512-BF16 or AMX: twice the speed, measured), and nothing changes elsewhere. Attributes are decoded in float32
    in any case."""
    kind = torch.device(device).type
    if kind == "cpu":
        able = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    else:
        able = kind == "cuda" and torch.cuda.is_bf16_supported()
    return torch.autocast(kind, torch.bfloat16, enabled=able)


@dataclass(frozen=True)
class Copy:
    """The LRM's own Gaussians, as rows for Stage I (`copy` representation)."""

    rows: Splats
    """N Gaussians above config.compress.min_opacity, torch."""
    tokens: Tensor = field(repr=False)
    """[P, token width]."""
    links: TokenLinks
    """Each Gaussian's own patch."""


@dataclass(frozen=True)
class Refined:
    """What an edit makes of some latents."""

    state: RefineState
    """Where the next edit starts."""
    places: np.ndarray
    """[J] int64 the chosen latents, indices into Latents.values."""
    values: Tensor = field(repr=False)
    """[J, D]."""
    second: Tensor | None = field(repr=False)
    """[J, D] the second set of a local edit, or None."""


@dataclass(frozen=True)
class Decoded:
    """New attributes."""

    splats: Splats
    """J rows, torch float32."""
    rows: np.ndarray
    """[J] int64 the rows of the asset that they replace."""
    further: Splats | None
    """Rows to append (J, or fewer: none that the decoder says nothing about), or None where there was no second set."""
    parents: np.ndarray | None
    """[len(further)] int64 the rows of the asset that they belong to."""


class SplatPainterModel(nn.Module):
    """The four networks with their weights."""

    notes: dict[str, Any]
    """What the checkpoint said about these weights; empty for untrained ones."""

    def __init__(self, config: ModelConfig) -> None:
        """Untrained: with the residual decoder every edit is the identity, in eval mode. Seed torch before for
        reproducible weights; under torch.device("meta") nothing is allocated."""
        super().__init__()
        self.config, self.notes = config, {}
        share = 1.0 if config.representation == "native" else config.compress.keep
        self.lrm = GaussianLrm(config.lrm)
        self.compressor = Compressor(config.compress, config.lrm.dim, config.sh_degree, share)
        self.refiner = Refiner(config.refine, config.compress.dim)
        self.head = AttributeHead(config.compress.dim, config.sh_degree, config.decoder)

    @staticmethod
    def load(folder: Path | str, preset: str | None = None) -> SplatPainterModel:
        """The model of a checkpoint, float32 on the CPU, ready to use (eval). Raises ValueError as checkpoint.load and
        checkpoint.fill."""
        held = checkpoint.load(folder, preset)
        with torch.device("meta"):
            model = SplatPainterModel(held.config)
        checkpoint.fill(model, held.tensors, str(folder))
        model.notes = held.notes
        return model.eval()

    def save(
        self,
        folder: Path | str,
        *,
        dtype: Literal["float16", "bfloat16", "float32"] = "float16",
        notes: dict[str, Any] | None = None,
    ) -> None:
        """Write a checkpoint, all or nothing. Raises ValueError as checkpoint.save."""
        checkpoint.save(
            folder, self.config, self.state_dict(), dtype=dtype, notes=self.notes if notes is None else notes
        )

    def groups(self, grid: VoxelGrid) -> RowGroups:
        """The rows of a grid, grouped as Stage I wants them. Raises ValueError for a grid of another resolution."""
        if grid.resolution != self.config.compress.resolution:
            raise ValueError(
                f"encode: expected a grid of {self.config.compress.resolution} voxels per edge, got {grid.resolution}"
            )
        return RowGroups.of(grid, self.config.compress.largest_group)

    def encode_views(self, views: AssetViews) -> Tensor:
        """[P, token width] tokens of an asset's canonical views. Raises ValueError as GaussianLrm."""
        return self.lrm.encode(views)

    def copy_rows(self, views: AssetViews) -> Copy:
        """The LRM's Gaussians that can be seen, with their tokens. Raises ValueError when there are none."""
        output = self.lrm(views)
        shown = torch.nonzero(output.splats.opacities > self.config.compress.min_opacity)[:, 0]
        if len(shown) == 0:
            raise ValueError("encode: the model sees nothing in the views; check that they show the asset")
        patches = (shown // self.config.lrm.patch**2).cpu().numpy()[:, None]
        links = TokenLinks(patches, np.ones(patches.shape, np.float32))
        return Copy(output.splats.take(shown), output.tokens, links)

    def encode_rows(
        self,
        tokens: Tensor,
        rows: Splats,
        links: TokenLinks,
        groups: RowGroups,
        *,
        chunk: int | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Latents:
        """Stage I. tokens: [P, token width]; rows: N, torch, on the tokens' device; links: of the N rows; groups: of
        them (`self.groups`); chunk: rows at once; dtype: how latents are kept. Raises ValueError where links and rows
        do not fit."""
        return self.compressor(tokens, rows, links, groups, chunk=chunk, dtype=dtype)

    def initial_state(self) -> RefineState:
        """Before any edit: the learned first fast weights (the parameters themselves: do not write)."""
        return self.refiner.initial_state()

    def refine(
        self,
        state: RefineState,
        latents: Latents,
        pictures: Pictures,
        *,
        places: np.ndarray | None = None,
        lift: Tensor | None = None,
        detail: bool = False,
        strength: float | None = None,
        chunk: int | None = None,
    ) -> Refined:
        """Stage II: adapt to the pictures of one edit, then read the chosen latents.

        places: [J] int64 latents that may change (local), None: all (global); lift: [J, 7] what the analytic lift says
        about their rows (`Refiner.prepare`); detail: also make the second set; strength: overrides
        config.refine.edit_strength; chunk: latents at once. The same edit in other batches gives the same values up to
        rounding. Raises ValueError for pictures or features that this model cannot use.
        """
        if detail and not self.config.refine.detail:
            raise ValueError("refine: this model has no detail layer; use detail=False")
        state = self.refiner.adapt(state, tokenize(pictures, latents.groups, self.config.refine), strength=strength)
        chosen, original = self._chosen(latents, places)
        original = self.refiner.prepare(original, lift)
        values = self.refiner.read(state, original, chunk=chunk)
        second = None
        if detail:
            state, second = self.refiner.detail(state, original, values, strength=strength)
        return Refined(state, chosen, values, second)

    def edit(
        self,
        state: RefineState,
        latents: Latents,
        pictures: Pictures,
        rows: Splats,
        *,
        places: np.ndarray | None = None,
        lift: Tensor | None = None,
        detail: bool = False,
        strength: float | None = None,
    ) -> tuple[RefineState, Decoded]:
        """`refine` and `decode` in one. Without a second set the latents are read and decoded run by run, so that a
        million rows need little more than themselves."""
        if detail or torch.is_grad_enabled():
            refined = self.refine(state, latents, pictures, places=places, lift=lift, detail=detail, strength=strength)
            return refined.state, self.decode(latents, refined, rows)
        state = self.refiner.adapt(state, tokenize(pictures, latents.groups, self.config.refine), strength=strength)
        chosen = np.arange(len(latents.values)) if places is None else np.asarray(places, np.int64)
        if lift is not None and len(lift) != len(chosen):
            raise ValueError(f"refine: expected lift features of {len(chosen)} latents, got {len(lift)}")
        index = latents.groups.order[chosen]
        parts: dict[str, list[Tensor]] = {name: [] for name in ATTRIBUTES}
        for first in range(0, max(len(chosen), 1), CHUNK):
            run = chosen[first : first + CHUNK]
            told = None if lift is None else lift[first : first + CHUNK]
            values = self.refiner.read(state, self.refiner.prepare(self._chosen(latents, run)[1], told))
            part = self._decoded(latents, values, run, rows, children=False)[0]
            for name in ATTRIBUTES:
                parts[name].append(getattr(part, name))
        origin = None if rows.origin is None else rows.origin[index]
        splats = replace(rows, **{name: torch.cat(parts[name]) for name in ATTRIBUTES}, origin=origin)
        return state, Decoded(splats, index, None, None)

    def decode(self, latents: Latents, refined: Refined, rows: Splats) -> Decoded:
        """Attributes of refined latents. rows: the N rows of the asset that the latents belong to, torch float32.

        `native` decodes the second set as children, on a smaller and fainter copy of their row; `copy` like the first.
        A residual that is exactly zero returns a row's bits and, unless in training mode, appends nothing."""
        splats, index, _ = self._decoded(latents, refined.values, refined.places, rows, children=False)
        if refined.second is None:
            return Decoded(splats, index, None, None)
        native = self.config.representation == "native"
        further, _, born = self._decoded(latents, refined.second, refined.places, rows, children=native)
        if self.config.decoder == "absolute" or self.training:
            # In training mode all are drawn: what is never drawn never learns.
            return Decoded(splats, index, further, index)
        alive = born.cpu().numpy()
        return Decoded(splats, index, further.take(alive), index[alive])

    def decode_latents(self, latents: Latents, rows: Splats, places: np.ndarray | None = None) -> Splats:
        """What Stage I alone says: the chosen latents (all by default), decoded as they are. J rows."""
        chosen, values = self._chosen(latents, places)
        return self._decoded(latents, values, chosen, rows, children=False)[0]

    def _chosen(self, latents: Latents, places: np.ndarray | None) -> tuple[np.ndarray, Tensor]:
        """([J] indices, [J, D] float32 latents)."""
        if places is None:
            return np.arange(len(latents.values)), latents.values.float()
        chosen = np.asarray(places, np.int64)
        return chosen, latents.values[torch.from_numpy(chosen).to(latents.values.device)].float()

    def _decoded(
        self, latents: Latents, values: Tensor, places: np.ndarray, rows: Splats, *, children: bool
    ) -> tuple[Splats, np.ndarray, Tensor]:
        """(J rows, [J] the rows of the asset, [J] bool whether the decoder says anything)."""
        index = latents.groups.order[places]
        base = rows.take(index)
        centers = torch.from_numpy(latents.groups.row_centers(places)).to(base.means)
        raw = self.head(values)
        base = newborn(base) if children else base
        return self.head.attributes(raw, base, centers, latents.groups.voxel), index, is_born(raw)
