"""Stage rows with pictures as the carrier: patches of an edited picture teach the local network's fast weights, and the
Gaussians that the lift has laid out ask what colour they are. No renderer in a step; validation is in pictures too.

The loss is the logarithm of the mean squared error of the colours, so every edit counts by the dB it gains, and the
likelihood of what the network says of its own error.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from splatpainter.color import base_color
from splatpainter.lift.edits import LiftedEdit
from splatpainter.models.local_edit_colors import (
    NetworkColors,
    applied,
    network_colors,
    patches_of,
    readers_of,
    with_colors,
)
from splatpainter.models.local_network import LocalNetwork, Patches
from splatpainter.models.picture_patches import BANDS, PEAK_FEATURE, picture_regions
from splatpainter.rendering import render
from splattrain.data.painted_gaussians import PaintedEdit, PaintedGaussians
from splattrain.stages.task import Task, ValidationScore, between_share

MIN_SQUARED_ERROR = 2e-4
"""Added to the squared error: 37 dB are enough for a start of the lift's rounds."""
LEAST_COUNT = 0.05
"""What a Gaussian counts that the picture does not show; one that makes a pixel alone counts 1 more."""
SPREAD_WEIGHT = 0.1
"""Weight of the likelihood of the error."""
LEARNT = ("mix.", "last.", "gaussian.", "norm_out.", "blocks.0.mlp_rows.", "blocks.1.mlp_rows.")
"""Beginnings of the names of what is trained: what Gaussians make of what they read. The memory stays as it is set:
305 steps of AdamW on all of it lowered 20 held-out edits from 25.9 to 24.0 dB, 349 steps on these raised them to 26.3
(docs/ADAPTATION.md)."""
CHANGED = 0.02
"""Change of a colour channel from which truth counts as painted."""


class PaintedGaussiansTask(Task[LocalNetwork]):
    """Trains a local network."""

    def __init__(self, network: LocalNetwork, readers: int = 512) -> None:
        """readers: Gaussians of an edit that a step looks at, a random choice."""
        super().__init__()
        self.model, self.readers = network, readers
        for name, weight in network.named_parameters():
            weight.requires_grad_(name.startswith(LEARNT))

    def losses(self, sample: PaintedGaussians, seed: int) -> dict[str, Tensor]:  # type: ignore[override]
        rng = np.random.default_rng(seed)
        share = self.readers // len(sample.regions)
        colors, variances, facts, rows = [], [], [], []
        for region in sample.regions:
            pick = np.sort(rng.permutation(len(region.index))[: max(share, 1)])
            readers = readers_of(region.readers.take(pick), self.device)
            # In float32: what a patch holds is small beside the marker of its cell, and bf16 would round it away.
            state = self.model.adapt(self.model.initial_state(), patches_of(region.tokens, self.device))
            answer = self.model.read(state, readers)
            colors.append(answer.colors)
            variances.append(answer.log_variance)
            facts.append(readers.facts)
            rows.append(region.index[pick])
        truth = torch.from_numpy(sample.truth[np.concatenate(rows)]).to(self.device)
        squared, variance = (torch.cat(colors) - truth).square().mean(1), torch.cat(variances)
        # What pictures show of each: hidden ones are many and make no picture.
        counts = LEAST_COUNT + (torch.cat(facts)[:, PEAK_FEATURE] + 1) / 2
        mean = (counts * squared).sum() / counts.sum()
        spread = (squared.detach() * torch.exp(-variance) + variance).mean()
        return {"loss": torch.log(mean + MIN_SQUARED_ERROR) + SPREAD_WEIGHT * spread, "squared": mean, "spread": spread}

    @torch.no_grad()
    def judge(self, sample: PaintedEdit) -> ValidationScore:  # type: ignore[override]
        """PSNR in the paint of the edited view (`edited`) and of novel views near it (`novel`), of the network alone,
        held, of the paint's mean colour, and of the lift; and of Gaussians whose true colour changed (`rows`)."""
        network, asset, lifted = self.model, sample.painted.asset, sample.lifted
        before = np.clip(base_color(asset.sh[lifted.parents]), 0, 1)
        answer = network_colors(network, asset, lifted, [sample.view])
        nothing = network_colors(network, asset, lifted, [sample.view], strength=0.0)
        other = self._of_another_picture(sample)
        answers = {"ours": answer, "strength 0": nothing, "another picture": other}
        # What is known without places: whoever does not beat it has read no picture.
        paint = sample.view.edited[sample.view.mask].mean(0)
        answers["mean color"] = replace(answer, colors=np.broadcast_to(paint, answer.colors.shape).astype(np.float32))
        numbers: dict[str, float] = {}
        named = {name: colored.colors for name, colored in answers.items()}
        named |= {"nothing": before, "lift": np.clip(base_color(lifted.splats.sh[lifted.ids]), 0, 1)}
        for name, colors in named.items():
            if (value := row_decibels(sample, colors)) is not None:
                numbers[f"rows {name}"] = value
        edits: dict[str, LiftedEdit] = {name: with_colors(lifted, colored) for name, colored in answers.items()}
        edits |= {"held": applied(lifted, answer, [sample.view], len(asset)), "lift": lifted}
        edits["nothing"] = replace(lifted, splats=asset)
        strip = [("edited picture", sample.view.edited)]
        for name, edit in edits.items():
            edited, novel, picture = picture_scores(sample, edit)
            numbers |= {f"edited {name}": edited} if edited is not None else {}
            numbers |= {f"novel {name}": novel} if novel is not None else {}
            if picture is not None:
                strip.append((name, picture))
        near = np.flatnonzero(sample.sample.near)
        strip.append(("truth", sample.sample.after.colors[near[0]].numpy()))
        if "edited ours" in numbers:
            numbers["adapts"] = numbers["edited ours"] - numbers["edited strength 0"]
        if "novel held" in numbers and "novel lift" in numbers:
            numbers["gain"] = numbers["novel held"] - numbers["novel lift"]
        regions = list(picture_regions(asset, lifted, sample.view))
        if regions:
            numbers["between Gaussians"] = between_share(
                torch.cat([network.tokens_of(readers_of(r.readers, self.device)) for r in regions])
            )
        return ValidationScore(sample.kind, numbers, tuple(strip))

    def _of_another_picture(self, sample: PaintedEdit) -> NetworkColors:
        """The answer with the patches of a picture that shows something else there: its colours turned and negated."""
        network = OtherPicture(self.model)
        return network_colors(network, sample.painted.asset, sample.lifted, [sample.view])  # type: ignore[arg-type]


class OtherPicture:
    """A network that is shown another picture than it is given."""

    def __init__(self, network: LocalNetwork) -> None:
        self.network = network
        self.initial_state, self.read = network.initial_state, network.read

    def adapt(self, state, patches: Patches, strength: float | None = None):  # type: ignore[no-untyped-def]
        values = patches.values.clone()
        bands = values[:, : 3 * BANDS].unflatten(1, (BANDS, 3))
        values[:, : 3 * BANDS] = -bands.flip(2).flip(0).flatten(1)
        return self.network.adapt(state, patches._replace(values=values), strength)


def row_decibels(sample: PaintedEdit, colors: np.ndarray) -> float | None:
    """PSNR of the base colours [J, 3] of the Gaussians whose true colour changed; None where none did."""
    before = np.clip(base_color(sample.painted.asset.sh[sample.lifted.parents]), 0, 1)
    changed = np.abs(sample.truth - before).max(1) > CHANGED
    return _decibels(np.clip(colors, 0, 1), sample.truth, changed)


def picture_scores(sample: PaintedEdit, edit: LiftedEdit) -> tuple[float | None, float | None, np.ndarray | None]:
    """(PSNR in the paint of the edited view, of the novel views near it, the first of these)."""
    view, views = sample.view, sample.sample
    drawn = np.clip(render(edit.splats, view.camera).colors[0], 0, 1)
    edited = _decibels(drawn, view.edited, view.mask)
    near = np.flatnonzero(views.near)
    if not len(near):
        return edited, None, None
    cameras = [views.after.cameras[k] for k in near]
    novel = np.clip(render(edit.splats, cameras).colors, 0, 1)
    before, after = (part.colors[near].numpy() for part in (views.before, views.after))
    return edited, _decibels(novel, after, np.abs(after - before).max(-1) > CHANGED), novel[0]


def _decibels(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float | None:
    if not mask.any():
        return None
    return -10 * math.log10(max(float(np.square(picture - truth)[mask].mean()), 1e-9))
