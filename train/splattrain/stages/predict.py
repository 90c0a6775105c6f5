"""The predictor of unseen Gaussians: edits of Gaussians in, the change of all others out. No picture is drawn.

What is compared is close to what a global edit writes into the Gaussians: what was seen where much was seen, what is
predicted elsewhere. The loss is the logarithm of the mean squared error, so every edit counts by the dB it gains.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from splatpainter.color import base_color
from splatpainter.lift.colors import MIN_SEEN_PX
from splatpainter.lift.global_edit import regressed
from splatpainter.lift.options import GlobalOptions
from splatpainter.models.gaussian_facts import gaussian_facts
from splatpainter.models.model import SplatPainterModel
from splatpainter.models.predictor import described_facts
from splattrain.data.global_edits import GlobalEdit
from splattrain.stages.task import Task, ValidationScore, between_share, freeze

MIN_SQUARED_ERROR = 1e-5
"""Added to the squared error: 50 dB are enough."""


class PredictTask(Task[SplatPainterModel]):
    """Stage predict: of the model, the predictor is trained."""

    def __init__(self, model: SplatPainterModel) -> None:
        """Raises ValueError for a model without a predictor."""
        super().__init__()
        if model.predictor is None:
            raise ValueError("train predict: expected a model with a predictor; give --model.predict.features 64")
        self.model = model
        freeze(model)
        model.predictor.requires_grad_(True)

    def losses(self, sample: GlobalEdit, seed: int) -> dict[str, Tensor]:  # type: ignore[override]
        squared = self._squared(sample, self._predicted(sample))
        return {"loss": torch.log(squared + MIN_SQUARED_ERROR), "squared": squared}

    @torch.no_grad()
    def judge(self, sample: GlobalEdit) -> ValidationScore:  # type: ignore[override]
        """PSNR of base colours after the edit; `strength 0`: the predictor is told of no change, `another edit`: of
        another one; `between Gaussians`: of its description of each."""
        ours = self._predicted(sample)
        lift = regressed(sample.asset, sample.normals, sample.observed, sample.weight)
        # Nothing done: a change of 0 wherever a Gaussian is seen, too.
        before = np.clip(_colors(sample), 0, 1) - np.clip(_colors(sample) + sample.change, 0, 1)
        unedited = float(np.average((before**2).mean(1), weights=sample.counts))
        numbers = {
            "nothing": _decibels(unedited),
            "lift": _decibels(float(self._squared(sample, self._tensor(lift)))),
            "ours": _decibels(float(self._squared(sample, ours))),
        }
        # The same pictures' pixels decide what is seen; only what is predicted of the others is another.
        evidence = {"strength 0": 0 * sample.observed, "another edit": -sample.observed[:, ::-1]}
        for name, observed in evidence.items():
            numbers[name] = _decibels(float(self._squared(sample, self._predicted(sample, observed))))
        numbers["adapts"] = numbers["ours"] - numbers["strength 0"]
        assert self.model.predictor is not None
        numbers["between Gaussians"] = between_share(self.model.predictor.own(described_facts(self._facts(sample))))
        numbers["gain"] = numbers["ours"] - numbers["lift"]
        return ValidationScore(f"{sample.kind} {sample.views}", numbers, ())

    def _predicted(self, sample: GlobalEdit, observed: np.ndarray | None = None) -> Tensor:
        """[N, 3] change. observed: [N, 3] what the predictor is told of seen Gaussians; None: the sample's."""
        predictor = self.model.predictor
        assert predictor is not None
        if not (sample.weight > MIN_SEEN_PX).any():
            raise ValueError("the pictures show no Gaussian")
        evidence = sample.observed if observed is None else observed
        return predictor(self._facts(sample), self._tensor(evidence), self._tensor(sample.weight))

    def _facts(self, sample: GlobalEdit) -> Tensor:
        """[N, 21] of `gaussian_facts`."""
        return self._tensor(gaussian_facts(sample.asset, sample.normals, sample.transfer))

    def _squared(self, sample: GlobalEdit, predicted: Tensor) -> Tensor:
        """Mean squared error of the base colours 0..1 that a global edit would give."""
        old, weight, counts = (self._tensor(x) for x in (_colors(sample), sample.weight, sample.counts))
        trust = (weight / (weight + GlobalOptions.half_seen))[:, None]
        moved = trust * self._tensor(sample.observed) + (1 - trust) * predicted
        error = (old + moved).clamp(0, 1) - (old + self._tensor(sample.change)).clamp(0, 1)
        return (error.square().mean(1) * counts).sum() / counts.sum().clamp(min=1e-6)

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(self.device)


def _colors(sample: GlobalEdit) -> np.ndarray:
    return base_color(sample.asset.sh)


def _decibels(squared: float) -> float:
    return -10 * math.log10(max(squared, 1e-12))
