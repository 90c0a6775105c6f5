"""Stage II: edited views in, changed attributes out, judged from views that the model did not see.

The analytic lift or the asset's own Gaussians are the start; the network adds a residual to it; the rendered result is
compared with the truth of the edited object. LRM and, unless asked otherwise, Stage I are frozen (arXiv 2512.05354).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from splatpainter.cameras import Camera
from splatpainter.lift.depth_normals import outward_normals
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.edits import LiftedEdit, lift_global_views, lift_local_views
from splatpainter.lift.global_edit import Predict
from splatpainter.lift.options import ResidualBase
from splatpainter.lighting import prt_transfer
from splatpainter.metrics.lpips import Lpips
from splatpainter.models.apply_edit import assemble, refine_edit, stage_two_inputs
from splatpainter.models.edit_propagation import CarriedEdit, reader_tokens
from splatpainter.models.encode import Encoded, encode_asset
from splatpainter.models.gaussian_facts import gaussian_facts
from splatpainter.models.gaussian_groups import GaussianGroups, TokenLinks
from splatpainter.models.model import SplatPainterModel
from splatpainter.models.predictor import described_facts, spread_evenly
from splatpainter.models.stored_predictor import predicting
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.recent import Recent
from splatpainter.voxels.grid import VoxelGrid, voxelize
from splattrain.loss import PictureLoss, PictureTarget, global_target, joined, local_target
from splattrain.report import figures
from splattrain.stages.lrm import asset_tokens
from splattrain.stages.task import Task, ValidationScore, between_share, draw, freeze, tensor

if TYPE_CHECKING:
    from splattrain.data.samples import Sample

Encoder = Literal["nothing", "compress", "all"]
MIN_VISIBLE_WEIGHT = 0.02
"""Pixels of weight from which a Gaussian counts as shown."""
MAX_INPUTS = 4096
"""Gaussians of an asset, evenly chosen, that the share of power between them is measured on."""
MIN_OBJECT_ALPHA = 0.5
"""Alpha from which a pixel is the object's."""


@dataclass(frozen=True)
class RefineOptions:
    """What of Stage II's recipe the task needs."""

    keep: float
    """Weight of a pixel that nobody edited, against 1 for an edited one."""
    sequence: float
    """Probability that a sample of several views comes as two edits, the second on the state that the first left."""
    train_encoder: Encoder
    perceptual_views: int
    """Views per sample that the perceptual term looks at."""
    loss_views: int
    """Views per sample that are rendered and compared, novel and edited ones together; 0: all."""
    gradient_rows: int
    """Gaussians per sample that gradients go through; 0: all."""
    objects: int
    """Objects whose encoding is kept."""


@dataclass(frozen=True)
class PreparedAsset:
    """What is computed once of an asset, while the data stays on it."""

    splats: Splats
    """Numpy."""
    grid: VoxelGrid
    normals: np.ndarray
    """[N, 3] outward normals of its Gaussians."""
    facts: np.ndarray | None
    """[N, 21] of `gaussian_facts`, for a model that reads them."""
    predict: Predict | None
    """What the model says of Gaussians that no view shows, in global edits."""
    encoded: Encoded | None
    """Encoding by a frozen encoder."""
    tokens: Tensor | None
    """Tokens of the frozen LRM, when Stage I is trained."""
    links: TokenLinks | None


class RefineTask(Task[SplatPainterModel]):
    """The whole model; Stage II is trained, and in `native` the head, which nothing has trained before."""

    def __init__(
        self,
        model: SplatPainterModel,
        options: RefineOptions,
        loss: PictureLoss,
        modes: Sequence[str] = ("local", "global"),
        alex: Lpips | None = None,
    ) -> None:
        """modes: those that samples have; weights that none of them uses are frozen. alex: for reports. Raises
        ValueError for what `copy` cannot do."""
        super().__init__()
        self.model, self.options, self.loss, self.alex = model, options, loss, alex
        self.base: ResidualBase = model.config.refine.base
        self.copies = model.config.representation == "copy"
        if self.copies:
            if options.train_encoder != "nothing":
                raise ValueError("train: expected train_encoder nothing with 'copy': the Gaussians would move")
            freeze(model.head)  # the paper trains the decoder in Stage I and freezes it with that
        self._prepared: Recent[PreparedAsset] = Recent(options.objects)
        freeze(model.predictor)
        if options.train_encoder == "nothing":
            freeze(*model.encoders)
        elif not model.encoders:
            raise ValueError("train: expected train_encoder nothing for a model without LRM and Stage I")
        else:
            freeze(model.lrm if options.train_encoder == "compress" else None, model.lrm.head, model.lrm.norm_out)
        if self.base == "lift" or "local" not in modes:
            refiner = model.refiner
            freeze(*(getattr(refiner, n, None) for n in ("detail_mixer", "norm_refined", "norm_original")))

    def losses(self, sample: Sample, seed: int) -> dict[str, Tensor]:
        if sample.mode == "global" and self.model.config.predictor_only:
            raise ValueError("this model's global edits use the predictor alone: Stage II cannot be trained on them")
        if not self.model.config.refine.picture_tokens:
            raise ValueError("this model's Stage II learns without pictures: use train rows")
        rng = np.random.default_rng(seed)
        prepared = self._remembered(sample)
        views = self._edits(sample, prepared)
        start = self._start(sample, prepared, views)
        cameras, target = self._target(sample, prepared, views, rng)
        start = self._visible(start, cameras)
        with self.arithmetic():
            edited = self._refined(prepared, start, views, self._first(sample, rng), rng)
        rendered, _ = draw(edited, cameras, self.device)
        chosen = rng.permutation(len(rendered))[: self.options.perceptual_views]
        return self.loss(rendered, target, sorted(chosen.tolist()))

    @torch.no_grad()
    def judge(self, sample: Sample) -> ValidationScore:
        prepared = self._remembered(sample)
        views = self._edits(sample, prepared)
        lifted = self._start(sample, prepared, views, analytic=True)
        same = self.base == "lift" and (sample.mode == "local" or prepared.predict is None)
        with self.arithmetic():  # a Stage II that carries edits answers within the lift, as in `Painter.apply`
            start = lifted if same else self._start(sample, prepared, views)
            edited = start.splats if self._predicted(sample) else self._refined(prepared, start, views)
        target = self._novel(sample, prepared, range(len(sample.novel_after.cameras)))
        near = np.flatnonzero(np.asarray(sample.near)) if sample.mode == "local" else np.arange(len(target.colors))
        if not len(near):
            near = np.arange(len(target.colors))
        pick = torch.from_numpy(near)
        cameras = [sample.novel_after.cameras[i] for i in near]
        aim = PictureTarget(*(getattr(target, name)[pick] for name in ("colors", "weights", "focus")))
        drawn = {"nothing": prepared.splats, "lift": lifted.splats, "ours": edited}
        if not self._predicted(sample) and self.model.config.refine.mixer == "ttt":
            drawn |= self._not_adapted(prepared, start, views)
        elif self._predicted(sample) and prepared.predict is not None:
            drawn |= self._not_carried(prepared, prepared.predict, views)
        pictures = {name: draw(splats, cameras, self.device)[0] for name, splats in drawn.items()}
        numbers: dict[str, float] = {}
        for name, picture in pictures.items():
            measured = figures(name, picture, aim, self.alex)
            numbers |= (
                measured if name in ("nothing", "lift", "ours") else {k: measured[k] for k in measured if k == name}
            )
        if "lift" in numbers:
            numbers["gain"] = numbers["ours"] - numbers["lift"]
        if "strength 0" in numbers:
            numbers["adapts"] = numbers["ours"] - numbers["strength 0"]
        if (inputs := self._network_inputs(sample, prepared, start)) is not None:
            numbers["between Gaussians"] = between_share(inputs)
        best = int(aim.focus.flatten(1).sum(1).argmax())  # the view that shows most of the edit
        strip = [("edited view", tensor(sample.edited.colors, torch.device("cpu"))[0].numpy())]
        strip += [
            (f"{name} {numbers.get(name, float('nan')):.2f} dB", pictures[name][best].cpu().numpy())
            for name in ("nothing", "lift", "ours")
        ]
        strip.append((f"truth ({sample.kind})", aim.colors[best].cpu().numpy()))
        return ValidationScore(sample.kind, numbers, tuple(strip))

    def _not_adapted(self, prepared: PreparedAsset, start: LiftedEdit, views: Sequence[EditView]) -> dict[str, Splats]:
        """What comes of the edit where the memory has learnt nothing, and where it has learnt other pictures (these,
        complementary): as good as ours, and the network does not adapt."""
        encoded, facts = self._encoded(prepared, start.parents), None
        if prepared.facts is not None:
            facts = prepared.facts[start.parents]
        complements = [replace(view, edited=(1 - view.edited).astype(np.float32)) for view in views]
        initial = self.model.initial_state()
        edits = {}
        with self.arithmetic():
            one = None if facts is None else facts[:1]
            learnt, _, _ = refine_edit(self.model, initial, encoded, part_of(start, np.arange(1)), complements, one)
            for name, state in (("strength 0", initial), ("another edit", learnt)):
                _, edited, further = refine_edit(self.model, state, encoded, start, views, facts, strength=0.0)
                edits[name] = assemble(start, edited, further)
        return edits

    def _network_inputs(self, sample: Sample, prepared: PreparedAsset, start: LiftedEdit) -> Tensor | None:
        """[J, D] what the network is told of Gaussians, before any block: those that may change, or, where it answers
        within the lift, those of the asset. None where no network answers."""
        with self.arithmetic():
            if not self._predicted(sample):
                facts = None if prepared.facts is None else prepared.facts[start.parents]
                return stage_two_inputs(self.model, self._encoded(prepared, start.parents), start, facts)
            predict, predictor = prepared.predict, self.model.predictor
            if isinstance(predict, CarriedEdit):
                everyone = torch.arange(len(predict.gaussians.colors), device=self.device)
                return reader_tokens(self.model, predict.gaussians, spread_evenly(everyone, MAX_INPUTS))
            if predict is None or predictor is None:
                return None
            splats, normals = prepared.splats, prepared.normals
            facts = gaussian_facts(splats, normals, prt_transfer(splats.means, normals))
            return predictor.own(described_facts(torch.from_numpy(facts).to(self.device)))

    def _not_carried(self, prepared: PreparedAsset, predict: Predict, views: Sequence[EditView]) -> dict[str, Splats]:
        """As `_not_adapted`, of edits that the lift makes with the network's answer where no view shows a Gaussian; the
        other edit is this one reversed and negated. The predictor does not adapt: it is told of no change."""

        def another(change: np.ndarray, weight: np.ndarray) -> np.ndarray:
            return predict(np.ascontiguousarray(-change[:, ::-1]), weight)

        still = predict.at_strength(0.0) if isinstance(predict, CarriedEdit) else lambda c, w: predict(0 * c, w)
        answers: dict[str, Predict] = {"strength 0": still, "another edit": another}
        normals = prepared.normals
        with self.arithmetic():
            return {
                name: lift_global_views(prepared.splats, views, "lift", normals=normals, predict=answer).splats
                for name, answer in answers.items()
            }

    def _remembered(self, sample: Sample) -> PreparedAsset:
        return self._prepared.get(sample.asset.sha256, lambda: self._prepare(sample.asset.numpy()))

    @torch.no_grad()
    def _prepare(self, splats: Splats) -> PreparedAsset:
        resolution = self.model.config.compress.resolution
        grid = voxelize(splats, resolution)
        if self.options.train_encoder == "nothing":
            with self.arithmetic():
                encoded = encode_asset(self.model, splats, grid)
            if self.copies:  # what is edited is what Stage I decodes
                splats = encoded.gaussians.numpy()
                grid = voxelize(splats, resolution)
            normals, facts, predict = self._aside(splats)
            if self.model.config.carries:
                predict = CarriedEdit(
                    self.model,
                    encoded.latents,
                    encoded.latent_ids,
                    splats,
                    normals,
                    lambda: prt_transfer(splats.means, normals),
                )
            return PreparedAsset(splats, grid, normals, facts, predict, encoded, None, None)
        if self.options.train_encoder == "all":
            return PreparedAsset(splats, grid, *self._aside(splats), None, None, None)
        return PreparedAsset(splats, grid, *self._aside(splats), None, *asset_tokens(self, splats, grid))

    def _aside(self, splats: Splats) -> tuple[np.ndarray, np.ndarray | None, Predict | None]:
        """Normals, facts, and what the predictor says."""
        normals, facts = outward_normals(splats), None
        transfer = cache(lambda: prt_transfer(splats.means, normals))
        if self.model.config.refine.facts:
            facts = gaussian_facts(splats, normals, transfer())
        return normals, facts, predicting(self.model.stored_predictor, splats, normals, transfer)

    def _encoded(self, prepared: PreparedAsset, parents: np.ndarray) -> Encoded:
        """The asset's latents, those of the given Gaussians at least."""
        if prepared.encoded is not None:
            return prepared.encoded
        if prepared.tokens is None or prepared.links is None:
            return encode_asset(self.model, prepared.splats, prepared.grid)
        gaussians = prepared.splats.torch(str(self.device))
        groups = holding(self.model.groups(prepared.grid), parents, len(gaussians))
        return Encoded(self.model.compressor(prepared.tokens, gaussians, prepared.links, groups), gaussians)

    def _edits(self, sample: Sample, prepared: PreparedAsset) -> list[EditView]:
        targets = [np.asarray(c, np.float32) for c in torch.as_tensor(sample.edited.colors).cpu().numpy()]
        return edit_views(prepared.splats, sample.edited.cameras, targets, list(np.asarray(sample.masks, bool)))

    def _start(
        self, sample: Sample, prepared: PreparedAsset, views: Sequence[EditView], analytic: bool = False
    ) -> LiftedEdit:
        """What the network starts from; or (analytic) the lift's own answer."""
        base = "lift" if analytic else self.base
        if sample.mode == "global":
            predict = None if analytic else prepared.predict
            base = "lift" if self._predicted(sample) else base
            return lift_global_views(prepared.splats, views, base, normals=prepared.normals, predict=predict)
        return lift_local_views(prepared.splats, prepared.grid, views, base)

    def _predicted(self, sample: Sample) -> bool:
        """Whether the edit is the lift's with the model's prediction in place of its regression, and no more."""
        return sample.mode == "global" and (self.model.config.predictor_only or self.model.config.carries)

    def _first(self, sample: Sample, rng: np.random.Generator) -> int:
        """How many of the views are an edit of their own, before the others."""
        count, cut = len(sample.edited.cameras), rng.random() < self.options.sequence
        return int(rng.integers(1, count)) if count > 1 and cut else 0

    def _refined(
        self,
        prepared: PreparedAsset,
        start: LiftedEdit,
        views: Sequence[EditView],
        first: int = 0,
        rng: np.random.Generator | None = None,
    ) -> Splats:
        """The edited asset. first: views whose only trace is the state that they leave; rng: chooses the Gaussians that
        gradients go through, where they are limited."""
        encoded, state = self._encoded(prepared, start.parents), self.model.initial_state()
        if first:  # only its state is wanted, so one Gaussian is read
            state, _, _ = refine_edit(self.model, state, encoded, part_of(start, np.arange(1)), views[:first])
        count, most = len(start.ids), self.options.gradient_rows
        if rng is None or not most or count <= most or start.detail:
            facts = None if prepared.facts is None else prepared.facts[start.parents]
            _, edited, further = refine_edit(self.model, state, encoded, start, views[first:], facts)
            return assemble(start, edited, further)
        order, views = rng.permutation(count), views[first:]
        after, sampled, _ = refine_edit(self.model, state, encoded, part_of(start, order[:most]), views)
        if self.model.config.refine.mask_tokens:  # an edit without edited pixels adapts nothing: it only reads
            state, views = after, [replace(views[0], mask=np.zeros_like(views[0].mask))]
        with torch.no_grad():
            _, rest, _ = refine_edit(self.model, state, encoded, part_of(start, order[most:]), views)
        both = {n: torch.cat([_louder(getattr(sampled, n), count / most), getattr(rest, n)]) for n in ATTRIBUTES}
        return assemble(part_of(start, order), replace(sampled, **both), None)

    def _visible(self, start: LiftedEdit, cameras: Sequence[Camera]) -> LiftedEdit:
        """`start` with only those Gaussians to change that the views show: the others would get no gradient."""
        splats = start.splats if self.device.type == "cpu" else start.splats.torch(str(self.device))
        with torch.no_grad():
            weights = torch.as_tensor(render(splats, list(cameras), contributions=True).contributions).sum(0)
        visible = weights.cpu().numpy()[start.ids] > MIN_VISIBLE_WEIGHT
        if not visible.any():
            raise ValueError("the chosen views show nothing of the edit")
        return part_of(start, np.flatnonzero(visible))

    def _target(
        self, sample: Sample, prepared: PreparedAsset, views: Sequence[EditView], rng: np.random.Generator
    ) -> tuple[list[Camera], PictureTarget]:
        """(views to draw, what they should show): some novel ones, then some of the edited."""
        novel, given = len(sample.novel_after.cameras), self._true_edits(sample)
        same = sample.novel_after.colors.shape[1:] == sample.edited.colors.shape[1:]
        most = self.options.loss_views or novel + len(given)
        share = int(most / 3 + rng.random()) if self.options.loss_views else len(given)  # a third on average
        edited = sorted(rng.permutation(given)[:share].tolist()) if same else []
        odds = self._odds(sample)
        chosen = sorted(rng.choice(novel, min(most - len(edited), novel), replace=False, p=odds).tolist())
        parts = [self._novel(sample, prepared, chosen)]
        if edited:
            colors = tensor(sample.edited.colors, self.device)[edited]
            masks = torch.from_numpy(np.asarray(sample.masks, bool)).to(self.device)[edited]
            if sample.mode == "global":
                parts.append(global_target(colors, masks))
            else:
                drawn = torch.stack([tensor(views[i].before, self.device) for i in edited])
                # The truth before the edit is not known here: the mask alone says what was edited.
                truth = torch.where(masks[..., None], colors, drawn)
                parts.append(local_target(truth, drawn, drawn, self.options.keep, 0.0))
        cameras = [sample.novel_after.cameras[i] for i in chosen] + [sample.edited.cameras[i] for i in edited]
        return cameras, joined(parts)

    def _true_edits(self, sample: Sample) -> list[int]:
        """Edited views that show the object as it is in the end: of a conflict, the last."""
        count = len(sample.edited.cameras)
        return [count - 1] if sample.kind == "conflict" else list(range(count))

    def _odds(self, sample: Sample) -> np.ndarray:
        """[W] of drawing each novel view: by how much of the edit it shows, a tenth for all alike."""
        if sample.mode == "global":
            return np.full(len(sample.novel_after.cameras), 1 / len(sample.novel_after.cameras))
        after, before = torch.as_tensor(sample.novel_after.colors), torch.as_tensor(sample.novel_before.colors)
        area = ((after - before).abs().amax(-1) > 0.02).double().mean((1, 2)).cpu().numpy() + 1e-3
        area = area + 0.1 * area.max()
        return area / area.sum()

    def _novel(self, sample: Sample, prepared: PreparedAsset, chosen: Sequence[int]) -> PictureTarget:
        pick = list(chosen)
        after = tensor(sample.novel_after.colors, self.device)[pick]
        with torch.no_grad():
            drawn, alpha = draw(prepared.splats, [sample.novel_after.cameras[i] for i in pick], self.device)
        if sample.mode == "global":
            return global_target(after, alpha > MIN_OBJECT_ALPHA)
        return local_target(after, tensor(sample.novel_before.colors, self.device)[pick], drawn, self.options.keep)


def part_of(start: LiftedEdit, positions: np.ndarray) -> LiftedEdit:
    """`start` with only these of its changeable Gaussians (indices into start.ids), in this order."""
    return replace(
        start, ids=start.ids[positions], parents=start.parents[positions], features=start.features[positions]
    )


def _louder(values: Tensor, factor: float) -> Tensor:
    """The same values with gradients times a factor: a random share of Gaussians then gives the expected gradient of
    all."""
    return values.detach() + factor * (values - values.detach())


def holding(groups: GaussianGroups, gaussian_ids: np.ndarray, count: int) -> GaussianGroups:
    """Those groups that hold any of the given Gaussians, whole: nothing crosses a voxel's border, so Stage I gives
    their Gaussians the same latents. count: N Gaussians of the asset."""
    target = np.zeros(count, bool)
    target[gaussian_ids] = True
    owner = np.repeat(np.arange(len(groups.lengths)), groups.lengths)
    selected = np.bincount(owner, target[groups.order], len(groups.lengths)) > 0
    starts = np.concatenate([[0], np.cumsum(groups.lengths[selected])]).astype(np.int64)
    return replace(groups, order=groups.order[selected[owner]], starts=starts, centers=groups.centers[selected])
