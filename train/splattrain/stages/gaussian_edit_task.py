"""Learning on rows: an edit is known exactly on the Gaussians that some pictures show, and what becomes of the others
is learnt. No renderer, no picture: a step takes tens of milliseconds.

Either Stage II learns it (config.refine.answers "teachers": its memory is all that carries the edit,
models/edit_propagation.py), or the predictor. The loss is the logarithm of the mean squared error of Gaussians that
were not shown, so every edit counts by the dB it gains.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from splatpainter.lift.colors import MAX_COLOR
from splatpainter.lift.global_edit import regressed
from splatpainter.models.cache import encode_cached
from splatpainter.models.edit_propagation import EncodedGaussians, carry, reader_tokens
from splatpainter.models.encode import encode_asset
from splatpainter.models.gaussian_facts import gaussian_facts
from splatpainter.models.model import SplatPainterModel
from splatpainter.models.predictor import described_facts
from splatpainter.system.recent import Recent
from splattrain.data.gaussian_edits import GaussianEdit
from splattrain.data.lit_assets import LitAsset
from splattrain.recipes import Carrier
from splattrain.stages.task import Task, ValidationScore, between_share, freeze

MIN_SQUARED_ERROR = 1e-5
"""Added to the squared error: 50 dB are enough."""
JUDGED_TEACHERS, JUDGED_READERS = 512, 384
"""Gaussians of an edit that teach, and that are asked, in validation and tables."""
MIN_VISIBLE = 16
"""Gaussians that pictures show, below which an edit says nothing."""


@dataclass(frozen=True)
class GaussianEditOptions:
    """How much of an edit a step looks at."""

    carrier: Carrier = "stage2"
    """What learns."""
    teachers: int = 256
    """Gaussians that are shown, a random choice."""
    readers: int = 256
    """Gaussians that are not shown and count in the loss, a random choice."""
    objects: int = 64
    """Encoded assets kept in memory."""
    cached: bool = True
    """Keep encoded assets on disk (models/cache.py)."""


class GaussianEditTask(Task[SplatPainterModel]):
    """Stage rows: of the model, Stage II and the decoder are trained, or the predictor."""

    def __init__(self, model: SplatPainterModel, options: GaussianEditOptions = GaussianEditOptions()) -> None:
        """Raises ValueError for a model that has no such carrier."""
        super().__init__()
        self.model, self.options = model, options
        refine = model.config.refine
        if options.carrier == "predictor" and model.predictor is None:
            raise ValueError("train rows: expected a model with a predictor; give --model.predict.features 64")
        if options.carrier == "stage2" and (refine.answers != "teachers" or refine.picture_tokens):
            raise ValueError(
                "train rows: expected a Stage II that only shown Gaussians teach; give --model.refine.answers teachers "
                "--model.refine.no-picture-tokens --model.refine.row-tokens 2048"
            )
        if model.config.representation != "native" or model.config.decoder == "absolute":
            raise ValueError("train rows: expected representation native and a residual decoder")
        freeze(model)
        if options.carrier == "predictor":
            assert model.predictor is not None
            model.predictor.requires_grad_(True)
        else:
            model.refiner.requires_grad_(True)
            model.head.requires_grad_(True)
        self._rows: Recent[EncodedGaussians] = Recent(options.objects)
        self._frozen = _digest(model)

    def losses(self, sample: GaussianEdit, seed: int) -> dict[str, Tensor]:  # type: ignore[override]
        rng = np.random.default_rng(seed)
        seen = np.flatnonzero(sample.seen)
        hidden = unseen(sample)
        if len(seen) < MIN_VISIBLE or not len(hidden):
            raise ValueError("the pictures show no Gaussian, or all of them")
        order = rng.permutation(seen)
        count = min(self.options.teachers, len(seen) - len(seen) // 4)
        # Where few are hidden, some that are shown but do not teach fill up.
        teachers, spare = order[:count], order[count:]
        readers = np.concatenate([rng.permutation(hidden), spare])[: self.options.readers]
        squared = self.squared(sample, self.predicted(sample, teachers, readers), readers)
        return {"loss": torch.log(squared + MIN_SQUARED_ERROR), "squared": squared}

    @torch.no_grad()
    def judge(self, sample: GaussianEdit) -> ValidationScore:  # type: ignore[override]
        numbers = {"nothing": self.decibels(sample, None), "lift": self.decibels(sample, fixed_ridge(sample))}
        numbers["ours"] = self.decibels(sample, self.answer(sample))
        # The predictor does not adapt: without strength it is told of no change.
        silent = None if self.options.carrier == "stage2" else replace(sample, change=0 * sample.change)
        numbers["strength 0"] = self.decibels(sample, self.answer(sample, strength=0.0, evidence=silent))
        numbers["adapts"] = numbers["ours"] - numbers["strength 0"]
        other = replace(sample, change=-sample.change[:, ::-1])
        numbers["another edit"] = self.decibels(sample, self.answer(sample, evidence=other))
        numbers["between Gaussians"] = between_share(self._read_inputs(sample))
        numbers["gain"] = numbers["ours"] - numbers["lift"]
        return ValidationScore(f"{sample.kind} {sample.views} {sample.item.kind}", numbers, ())

    @torch.no_grad()
    def answer(
        self, sample: GaussianEdit, strength: float | None = None, evidence: GaussianEdit | None = None
    ) -> Tensor:
        """[U, 3] change of Gaussians that no picture shows (`judged`), after JUDGED_TEACHERS of those that are shown
        have taught. evidence: another edit of the same asset, whose changes of these Gaussians are shown
        instead."""
        teachers = evenly(np.flatnonzero(sample.seen), JUDGED_TEACHERS)
        return self.predicted(sample, teachers, judged(sample), strength, evidence)

    def predicted(
        self,
        sample: GaussianEdit,
        teachers: np.ndarray,
        readers: np.ndarray,
        strength: float | None = None,
        evidence: GaussianEdit | None = None,
    ) -> Tensor:
        """[R, 3] change of the Gaussians `readers`, which know nothing of it, learnt from `teachers` (indices)."""
        change = (sample if evidence is None else evidence).change
        if self.options.carrier == "stage2":
            rows = self.rows(sample.item)
            arrays = (self._tensor(change), self._tensor(sample.weight))
            ids = (torch.from_numpy(teachers), torch.from_numpy(readers))
            with self.arithmetic():
                return carry(self.model, rows, *arrays, *(x.to(self.device) for x in ids), strength=strength)[1]
        predictor = self.model.predictor
        assert predictor is not None
        facts = gaussian_facts(sample.item.asset, sample.item.normals, sample.item.transfer)
        ids = np.concatenate([teachers, readers])
        weight = np.concatenate([sample.weight[teachers], np.zeros(len(readers), np.float32)])
        visible = np.where(weight[:, None] > 0, change[ids], 0)
        return predictor(*(self._tensor(x) for x in (facts[ids], visible, weight)))[len(teachers) :]

    def squared(self, sample: GaussianEdit, answer: Tensor | None, readers: np.ndarray) -> Tensor:
        """[] mean squared error of base colours 0..1 over the Gaussians `readers`, each by how much it counts. answer:
        [R, 3] their change; None: none."""
        before, change = (self._tensor(x[readers]) for x in (sample.colors, sample.change))
        counts = self._tensor(sample.counts[readers])
        after = before if answer is None else (before + answer).clamp(0, MAX_COLOR)
        return ((after - before - change).square().mean(1) * counts).sum() / counts.sum().clamp(min=1e-6)

    def decibels(self, sample: GaussianEdit, answer: Tensor | None) -> float:
        """PSNR over Gaussians that no picture shows (`judged`). answer: [U, 3] of these; None: no change."""
        return -10 * math.log10(max(float(self.squared(sample, answer, judged(sample))), 1e-12))

    def _read_inputs(self, sample: GaussianEdit) -> Tensor:
        """[U, D] what Stage II reads of the Gaussians `judged`, before any block; or how the predictor describes
        each."""
        if self.options.carrier == "predictor":
            assert self.model.predictor is not None
            facts = gaussian_facts(sample.item.asset, sample.item.normals, sample.item.transfer)
            return self.model.predictor.own(described_facts(self._tensor(facts[judged(sample)])))
        with self.arithmetic():
            return reader_tokens(self.model, self.rows(sample.item), torch.from_numpy(judged(sample)).to(self.device))

    def rows(self, item: LitAsset) -> EncodedGaussians:
        """What Stage II knows of an asset, encoded on first use."""
        return self._rows.get((item.name, item.kind), lambda: self._encoded(item))

    def share_rows(self, other: GaussianEditTask) -> None:
        """Use the assets that another task has encoded or will encode, with the same LRM and Stage I."""
        assert self._frozen == other._frozen, "other encoders"
        self._rows = other._rows

    def _encoded(self, item: LitAsset) -> EncodedGaussians:
        with torch.no_grad(), self.arithmetic():
            if self.options.cached:
                encoded = encode_cached(self.model, item.asset, weights=self._frozen)
            else:
                encoded = encode_asset(self.model, item.asset)
        held = (item.asset, item.normals, item.transfer)
        return EncodedGaussians.of(self.model, encoded.latents, encoded.latent_ids, *held)

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(self.device)


def unseen(sample: GaussianEdit) -> np.ndarray:
    """[U] int64 the Gaussians that no picture of the edit shows, and that can be seen from somewhere."""
    return np.flatnonzero(~sample.seen & (sample.counts > 0))


def judged(sample: GaussianEdit) -> np.ndarray:
    """[U] int64 at most JUDGED_READERS of `unseen`, evenly over their order."""
    return evenly(unseen(sample), JUDGED_READERS)


def evenly(values: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of these values, evenly over their order."""
    return values if len(values) <= most else values[np.linspace(0, len(values) - 1, most).astype(np.int64)]


def fixed_ridge(sample: GaussianEdit) -> Tensor:
    """[U, 3] what the lift's regression on fixed features says of the Gaussians `judged`, learnt from all that are
    shown."""
    item = sample.item
    visible = np.where(sample.seen[:, None], sample.change, 0)
    return torch.from_numpy(
        regressed(item.asset, item.normals, visible, sample.weight)[judged(sample)].astype(np.float32)
    )


def _digest(model: SplatPainterModel) -> str:
    """Hash of what encodes an asset: LRM and Stage I."""
    config = model.config
    sizes = (config.refine.latents, config.lrm, config.compress, config.sh_degree)
    sha = hashlib.sha256(repr(sizes).encode())
    for part in model.encoders:
        for name, tensor in sorted(part.state_dict().items()):
            sha.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return sha.hexdigest()
