"""The whole model as pure calls: views to tokens, Gaussians to latents, edits to a next state, latents to attributes.

    tokens  = model.encode_views(views)                           once per asset: the Gaussian LRM
    latents = model.compressor(tokens, gaussians, links, groups)  once per asset: Stage I
    refined = model.refine(state, latents, pictures, ...)         per edit: Stage II, state in and state out
    decoded = model.decode(latents, refined, gaussians)           new attributes of the chosen Gaussians, and children
    state, decoded = model.edit(state, latents, pictures, gaussians)   both at once, in bounded memory

In `copy` representation the Gaussians are not the user's: `copied_gaussians` makes them from the views. Nothing is
written into an argument, nothing is remembered between calls. N Gaussians, K latents, J chosen latents, D width.
"""

from __future__ import annotations

from dataclasses import field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from splatpainter.lift.features import SEEN_FEATURE
from splatpainter.models import checkpoint
from splatpainter.models.compress import Compressor, Latents
from splatpainter.models.config import ModelConfig
from splatpainter.models.decode import AttributeHead, init_children
from splatpainter.models.gaussian_groups import GaussianGroups, TokenLinks
from splatpainter.models.image_tokens import Pictures, PictureTokens, tokenize
from splatpainter.models.lrm import AssetViews, GaussianLrm
from splatpainter.models.predictor import Predictor
from splatpainter.models.refine import LATENTS_PER_CHUNK, Refiner, RefineState
from splatpainter.models.stored_predictor import StoredPredictor
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels.grid import VoxelGrid


@dataclass(frozen=True)
class Copy:
    """The LRM's own Gaussians, as Stage I reads them (`copy` representation)."""

    gaussians: Splats[Tensor]
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
    latent_ids: np.ndarray
    """[J] int64 the chosen latents, indices into Latents.values."""
    values: Tensor = field(repr=False)
    """[J, D]."""
    detail_latents: Tensor | None = field(repr=False)
    """[J, D] the second set of a local edit, or None."""


@dataclass(frozen=True)
class Decoded:
    """New attributes of the decoded Gaussians."""

    splats: Splats[Tensor]
    """J Gaussians, torch float32."""
    gaussian_ids: np.ndarray
    """[J] int64 the asset's Gaussians that they replace."""
    children: Splats[Tensor] | None
    """Gaussians to append: J; none from an untrained decoder; or None where there were no detail latents."""
    parents: np.ndarray | None
    """[len(children)] int64 the Gaussians of the asset that they belong to."""


@dataclass(frozen=True)
class GaussianInputs:
    """What is known of J Gaussians beyond their latents, as far as a model asks for it."""

    lift: Tensor | None
    """[J, 13] of lift/features.py."""
    drift: Tensor | None
    """[J, 7] of gaussian_groups.drift_features."""
    means: Tensor | None
    """[J, 3] world units."""
    facts: Tensor | None
    """[J, 56] of predictor.described_facts."""

    def take(self, run: slice | np.ndarray) -> GaussianInputs:
        """The inputs of some of the Gaussians."""
        return GaussianInputs(*(None if values is None else values[run] for values in vars(self).values()))

    def check(self, count: int) -> None:
        """Raises ValueError for values of another number of Gaussians."""
        names = {"lift": "lift features", "drift": "drift", "means": "means", "facts": "facts"}
        for name, values in vars(self).items():
            if values is not None and len(values) != count:
                raise ValueError(f"refine: expected {names[name]} of {count} latents, got {len(values)}")


class SplatPainterModel(nn.Module):
    """The networks with their weights: LRM and Stage I (where config.refine.latents), Stage II, decoder, and, where
    there is one, the predictor."""

    lrm: GaussianLrm
    compressor: Compressor
    notes: dict[str, Any]
    """What the checkpoint said about these weights; empty for untrained ones."""

    def __init__(self, config: ModelConfig) -> None:
        """Untrained: with the residual decoder every edit is the identity, in eval mode. Seed torch before for
        reproducible weights; under torch.device("meta") nothing is allocated."""
        super().__init__()
        self.config, self.notes = config, {}
        # Native Gaussians are the user's, and every one keeps its latent; of a copy the model may choose.
        share = 1.0 if config.representation == "native" else config.compress.keep
        if config.refine.latents:
            self.lrm = GaussianLrm(config.lrm)
            self.compressor = Compressor(config.compress, config.lrm.dim, config.sh_degree, share)
        self.refiner = Refiner(config.refine, config.compress.dim, config.lrm.dim)
        self.head = AttributeHead(config.compress.dim, config.sh_degree, config.decoder)
        self.predictor = Predictor(config.predict) if config.predict.features else None

    @staticmethod
    def load(folder: Path | str, preset: str | None = None) -> SplatPainterModel:
        """The model of a checkpoint, float32 on the CPU, ready to use (eval). Raises ValueError as checkpoint.load and
        checkpoint.fill."""
        # On the meta device: weights that the checkpoint replaces at once need neither be drawn nor held.
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
        base: str = "",
        shared: tuple[str, ...] = (),
    ) -> None:
        """Write a checkpoint, all or nothing; the predictor gets a shard of its own. base, shared: as of
        checkpoint.save. Raises ValueError as that."""
        # The predictor apart, so that a global edit can read it without torch and the rest.
        stored = self.notes if notes is None else notes
        apart = ("predictor.",) if self.predictor is not None else ()
        checkpoint.save(
            folder, self.config, self.state_dict(), dtype=dtype, notes=stored, base=base, shared=shared, apart=apart
        )

    def groups(self, grid: VoxelGrid) -> GaussianGroups:
        """The Gaussians of a grid, grouped as Stage I wants them. Raises ValueError for a grid of another
        resolution."""
        if grid.resolution != self.config.compress.resolution:
            raise ValueError(
                f"encode: expected a grid of {self.config.compress.resolution} voxels per edge, got {grid.resolution}"
            )
        return GaussianGroups.of(grid, self.config.compress.largest_group)

    @property
    def encoders(self) -> tuple[nn.Module, ...]:
        """LRM and Stage I; () for a model without."""
        return (self.lrm, self.compressor) if self.config.refine.latents else ()

    @property
    def stored_predictor(self) -> StoredPredictor | None:
        """A copy of the predictor's weights, as an edit uses them; None for a model without."""
        return None if self.predictor is None else self.predictor.stored()

    def encode_views(self, views: AssetViews) -> Tensor:
        """[P, token width] tokens of an asset's canonical views. Raises ValueError as GaussianLrm."""
        return self.lrm.encode(views)

    def copied_gaussians(self, views: AssetViews) -> Copy:
        """The LRM's Gaussians that can be seen, with their tokens. Raises ValueError when there are none."""
        output = self.lrm(views)
        # What cannot be seen has nothing to teach, and would fill voxels.
        opaque = output.splats.opacities > self.config.compress.min_opacity
        ids = torch.nonzero(opaque & self.lrm.on_surface(views, output.splats))[:, 0]
        if len(ids) == 0:
            raise ValueError("encode: the model makes no visible Gaussian of the views; check that they show the asset")
        patches = (ids // self.config.lrm.patch**2).cpu().numpy()[:, None]
        links = TokenLinks(patches, np.ones(patches.shape, np.float32))
        return Copy(output.splats.take(ids), output.tokens, links)

    def initial_state(self) -> RefineState:
        """Before any edit: the learned first fast weights (the parameters themselves: do not write)."""
        return self.refiner.initial_state()

    def refine(
        self,
        state: RefineState,
        latents: Latents,
        pictures: Pictures,
        *,
        latent_ids: np.ndarray | None = None,
        lift: Tensor | None = None,
        drift: Tensor | None = None,
        means: Tensor | None = None,
        facts: Tensor | None = None,
        detail: bool = False,
        strength: float | None = None,
        chunk: int | None = None,
    ) -> Refined:
        """Stage II: adapt to the pictures of one edit, then read the chosen latents.

        latent_ids: [J] int64 latents to read, repeated where several Gaussians read one (local), None: all (global);
        lift: [J, 13] what the analytic lift says about their Gaussians, drift: [J, 7] how these differ from the encoded
        ones (`Refiner.prepare`); means: [J, 3] where they are, for "normalised" inputs; facts: [J, 56] of
        `predictor.described_facts`, for a model that reads them; detail: also make the second set; strength: overrides
        config.refine.edit_strength; chunk: latents at once. The same edit in other batches gives the same values up to
        rounding. Raises ValueError for pictures or features that this model cannot use.
        """
        if detail and not self.config.refine.detail:
            raise ValueError("refine: this model has no detail layer; use detail=False")
        chosen = np.arange(len(latents.values)) if latent_ids is None else np.asarray(latent_ids, np.int64)
        inputs = GaussianInputs(lift, drift, means, facts)
        inputs.check(len(chosen))
        original = self.prepared(latents, chosen, inputs)
        teacher_tokens = self._teacher_tokens(latents, chosen, inputs)
        tokens = self._picture_tokens(pictures, latents)
        state = self.refiner.adapt(state, tokens, teacher_tokens=teacher_tokens, strength=strength)
        values = self.refiner.read(state, original, chunk=chunk)
        detail_latents = None
        if detail:
            state = self.refiner.learn_detail(state, values, strength=strength)
            detail_latents = self.refiner.read_detail(state, original)
        return Refined(state, chosen, values, detail_latents)

    def edit(
        self,
        state: RefineState,
        latents: Latents,
        pictures: Pictures,
        gaussians: Splats[Tensor],
        *,
        latent_ids: np.ndarray | None = None,
        lift: Tensor | None = None,
        drift: Tensor | None = None,
        facts: Tensor | None = None,
        base: Splats[Tensor] | None = None,
        detail: bool = False,
        strength: float | None = None,
    ) -> tuple[RefineState, Decoded]:
        """`refine` and `decode` in one. Without gradients the latents are read and decoded run by run, so that a
        million Gaussians need little more than themselves."""
        chosen = np.arange(len(latents.values)) if latent_ids is None else np.asarray(latent_ids, np.int64)
        # Positions are those of the Gaussians as they are now, which the lift may have moved.
        means = None
        if self.config.refine.inputs == "normalised":
            means = gaussians.take(latents.groups.order[chosen]).means if base is None else base.means
        # With gradients all at once: runs would keep their activations anyway.
        if torch.is_grad_enabled():
            refined = self.refine(
                state,
                latents,
                pictures,
                latent_ids=latent_ids,
                lift=lift,
                drift=drift,
                means=means,
                facts=facts,
                detail=detail,
                strength=strength,
            )
            return refined.state, self.decode(latents, refined, gaussians, base)
        if detail and not self.config.refine.detail:
            raise ValueError("refine: this model has no detail layer; use detail=False")
        inputs = GaussianInputs(lift, drift, means, facts)
        inputs.check(len(chosen))

        def original(run: slice) -> Tensor:
            return self.prepared(latents, chosen[run], inputs.take(run))

        teacher_tokens = self._teacher_tokens(latents, chosen, inputs)
        tokens = self._picture_tokens(pictures, latents)
        state = self.refiner.adapt(state, tokens, teacher_tokens=teacher_tokens, strength=strength)
        runs = [slice(first, first + LATENTS_PER_CHUNK) for first in range(0, max(len(chosen), 1), LATENTS_PER_CHUNK)]

        def decoded(values: Tensor, detail_latents: Tensor | None, run: slice) -> Decoded:
            part = None if base is None else base.take(np.arange(len(chosen))[run])
            return self.decode(latents, Refined(state, chosen[run], values, detail_latents), gaussians, part)

        if not detail:
            return state, _joined([decoded(self.refiner.read(state, original(run)), None, run) for run in runs])
        # The extra layer learns from all refined latents before any is read again.
        values = torch.cat([self.refiner.read(state, original(run)) for run in runs])
        state = self.refiner.learn_detail(state, values, strength=strength)
        detail_parts = ((run, self.refiner.read_detail(state, original(run))) for run in runs)
        return state, _joined([decoded(values[run], detail_latents, run) for run, detail_latents in detail_parts])

    def decode(
        self, latents: Latents, refined: Refined, gaussians: Splats[Tensor], base: Splats[Tensor] | None = None
    ) -> Decoded:
        """Attributes of refined latents. gaussians: the N Gaussians of the asset that the latents belong to, torch
        float32; base: J Gaussians that the residuals are added to (the lift's answer), by default the latents' own of
        `gaussians`.

        `native` decodes the second set as children, on a smaller and fainter copy of their Gaussian; `copy` like the
        first. Where `base` Gaussians are given and Stage I has decoded them before (`copy`), they get only what
        changed: the residual of the refined latent minus that of the latent before. A residual that is exactly zero
        returns a Gaussian's bits and, unless in training mode, appends nothing."""
        index = latents.groups.order[refined.latent_ids]
        native = self.config.representation == "native"
        base_gaussians = gaussians.take(index) if base is None else base
        # Such a base is decoded already, so that adding the residual in full would count it twice.
        again = base is not None and not native and self.config.decoder != "absolute"
        before = self.head(self._chosen(latents, refined.latent_ids)[1]) if again else None
        splats = self._decoded(latents, refined.values, refined.latent_ids, base_gaussians, before)
        if refined.detail_latents is None:
            return Decoded(splats, index, None, None)
        # Children of native start fainter than their Gaussian, so that appending them hardly changes a picture.
        parents = init_children(base_gaussians) if native else base_gaussians
        children = self._decoded(latents, refined.detail_latents, refined.latent_ids, parents, before)
        if self.head.is_untrained and not self.training:
            # In training mode all are drawn: what is never drawn never learns.
            return Decoded(splats, index, children.take(index[:0]), index[:0])
        return Decoded(splats, index, children, index)

    def decode_latents(self, latents: Latents, gaussians: Splats[Tensor]) -> Splats[Tensor]:
        """What Stage I alone says: all latents, decoded as they are."""
        chosen, values = self._chosen(latents, None)
        return self._decoded(latents, values, chosen, gaussians.take(latents.groups.order[chosen]))

    def prepared(self, latents: Latents, chosen: np.ndarray, inputs: GaussianInputs, teaching: bool = False) -> Tensor:
        """[J, D] what Stage II reads of these latents; teaching: what it learns from."""
        values, positions, scale = self._chosen(latents, chosen)[1], None, None
        if self.config.refine.inputs == "normalised":
            if inputs.means is None:
                raise ValueError("refine: expected the means of the Gaussians, for 'normalised' inputs")
            # In the asset's cube: places mean the same for assets of any size.
            center = torch.from_numpy(np.asarray(latents.groups.center, np.float32)).to(values)
            positions, scale = (inputs.means.to(values) - center) / latents.groups.half_extent, latents.scale
        more = {"scale": scale, "positions": positions, "facts": inputs.facts, "teaching": teaching}
        return self.refiner.prepare(values, inputs.lift, inputs.drift, **more)

    def _picture_tokens(self, pictures: Pictures, latents: Latents) -> PictureTokens | None:
        """None for a model that pictures do not teach. Raises ValueError as `tokenize`."""
        refine = self.config.refine
        if not refine.picture_tokens:
            return None
        return tokenize(pictures, latents.groups, refine, self.lrm if refine.tokenizer == "lrm" else None)

    def _teacher_tokens(
        self, latents: Latents, chosen: np.ndarray, inputs: GaussianInputs
    ) -> tuple[Tensor, Tensor] | None:
        """([R, D], [R] how much each counts) of the Gaussians that teach, if any do."""
        # Those that the edit shows most teach, weighed by how much it shows of them.
        ids = self.refiner.teacher_ids(inputs.lift)
        if ids is None or inputs.lift is None:
            return None
        indices = ids.cpu().numpy()
        return self.prepared(latents, chosen[indices], inputs.take(indices), True), inputs.lift[ids, SEEN_FEATURE]

    def _chosen(self, latents: Latents, latent_ids: np.ndarray | None) -> tuple[np.ndarray, Tensor]:
        """([J] indices, [J, D] float32 latents)."""
        if latent_ids is None:
            return np.arange(len(latents.values)), latents.values.float()
        chosen = np.asarray(latent_ids, np.int64)
        return chosen, latents.values[torch.from_numpy(chosen).to(latents.values.device)].float()

    def _decoded(
        self,
        latents: Latents,
        values: Tensor,
        latent_ids: np.ndarray,
        base: Splats[Tensor],
        before: Tensor | None = None,
    ) -> Splats[Tensor]:
        """J Gaussians. values: [J, D]; base: J Gaussians; before: [J, C] what the decoder said about them before the
        edit."""
        centers = torch.from_numpy(latents.groups.gaussian_centers(latent_ids)).to(base.means)
        raw = self.head(values)
        raw = raw if before is None else raw - before
        return self.head.attributes(raw, base, centers, latents.groups.voxel)


def _joined(parts: list[Decoded]) -> Decoded:
    """Batches of inputs, one after the other."""
    if len(parts) == 1:
        return parts[0]
    # A run may have none, though others have: only those that are there are joined.
    children = [part.children for part in parts if part.children is not None]
    parents = [part.parents for part in parts if part.parents is not None]
    return Decoded(
        _stacked([part.splats for part in parts]),
        np.concatenate([part.gaussian_ids for part in parts]),
        _stacked(children) if children else None,
        np.concatenate(parents) if parents else None,
    )


def _stacked(parts: list[Splats[Tensor]]) -> Splats[Tensor]:
    joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in ATTRIBUTES}
    origins = [part.origin for part in parts if part.origin is not None]
    return replace(parts[0], **joined, origin=np.concatenate(origins) if origins else None)
