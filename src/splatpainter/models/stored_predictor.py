"""The predictor of unseen Gaussians (models/predictor.py) as an edit uses it: its stored weights and numpy, no torch.

    predict = predicting(weights.stored_predictor(model), splats, normals, transfer)    # None without a trained one
    lift_global(splats, views, predict=predict)

N Gaussians, F features, R of them seen and regressed on. float32, but for the regression, which is solved in float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import field

import numpy as np

from splatpainter.kernels import portable
from splatpainter.lift.colors import MIN_SEEN_PX
from splatpainter.lift.global_edit import Predict
from splatpainter.models.gaussian_facts import INPUT_CHANNELS, described, evenly_spread, gaussian_facts
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

MAX_WEIGHT_PX = 50.0
"""A huge Gaussian must not outvote a thousand small ones."""
CONTEXT_GAUSSIANS = 8192
"""Gaussians, evenly chosen, that say what kind of asset this is and under what light."""
REGRESSION_GAUSSIANS = 16_384
"""Seen Gaussians, evenly chosen, that the regression learns from."""
GAUSSIANS_PER_CHUNK = 1 << 12
"""Gaussians described at once: few enough for what they pass through to stay in the caches."""
OPPONENT = ((3**-0.5, 3**-0.5, 3**-0.5), (2**-0.5, -(2**-0.5), 0.0), (6**-0.5, 6**-0.5, -2 * 6**-0.5))
"""Orthogonal: lightness, and two channels of hue."""
EVIDENCE_GAIN = 4.0
"""Changes of colour are told this many times larger, so that they are of the order of the other numbers."""
EXPECTED_GAIN = 0.1
"""Of the layer that says what change is expected before anything is seen."""


@dataclass(frozen=True)
class StoredPredictor:
    """The weights of a trained predictor."""

    tensors: Mapping[str, np.ndarray] = field(repr=False)
    """Name in `Predictor.state_dict()` -> float32."""

    @property
    def is_untrained(self) -> bool:
        """Whether nothing has trained it yet: then the lift's own regression is better."""
        return not self.tensors["expected.weight"].any()

    @property
    def features(self) -> int:
        """F."""
        return len(self.tensors["describe.weight"]) // 2

    def predict(self, facts: np.ndarray, change: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """[N, 3] float32 predicted change of base colour of all Gaussians, as `Predictor.forward`. facts: [N, 21] of
        `gaussian_facts`; change: [N, 3] as the pictures have it; weight: [N] pixels that show each Gaussian."""
        facts, change, weight = (np.ascontiguousarray(x, np.float32) for x in (facts, change, weight))
        seen = evenly_spread(np.flatnonzero(weight > MIN_SEEN_PX), REGRESSION_GAUSSIANS)
        if len(seen) == 0:
            return np.zeros_like(change)
        opponent = np.array(OPPONENT, np.float32)
        # Bounded, and as shares: one huge Gaussian in front must not decide for all.
        counts = np.minimum(weight[seen], np.float32(MAX_WEIGHT_PX))
        share = (counts / portable.total(counts))[:, None]

        # What the asset as a whole is like, and what the pictures say of it, are two vectors that all Gaussians hear.
        inputs = described(facts[seen])
        seen_change = portable.matmul(change[seen], opponent.T)
        changed = np.concatenate([inputs, np.float32(EVIDENCE_GAIN) * seen_change], 1)
        evidence = (share * self._mlp("evidence", changed)).sum(0)
        everyone = evenly_spread(np.arange(len(facts)), CONTEXT_GAUSSIANS)
        context = self._mlp("company", self._mlp("own", described(facts[everyone]))).mean(0)
        around = np.concatenate([context, evidence])

        # The change of those that are seen is solved for on their features, lightness and hue apart, ...
        light, hue, mean = self._features(inputs, around)
        counted = share[:, 0] * np.float32(portable.exp(float(self.tensors["trust"])))
        rest = seen_change - mean
        solved = solve_ridge(light, rest[:, :1], counted), solve_ridge(hue, rest[:, 1:], counted)

        # ... and what comes out holds for all.
        answer = np.empty_like(change)
        for start in range(0, len(facts), GAUSSIANS_PER_CHUNK):
            part = slice(start, start + GAUSSIANS_PER_CHUNK)
            light, hue, mean = self._features(described(facts[part]), around)
            regressed = np.concatenate([portable.matmul(light, solved[0]), portable.matmul(hue, solved[1])], 1)
            answer[part] = portable.matmul(mean + regressed, opponent)
        return answer

    def _features(self, inputs: np.ndarray, around: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(features for lightness [M, F], for hue [M, F], change expected beforehand [M, 3], lightness and hue)."""
        # What holds for the whole asset is multiplied once, not for every Gaussian.
        alone = self._mlp("own", inputs)
        together, width = self.tensors["together.weight"], alone.shape[1]
        same = portable.matmul(around[None], together[:, width:].T) + self.tensors["together.bias"]  # for all Gaussians
        x = portable.silu(portable.matmul(alone, together[:, :width].T) + same)
        scale = np.float32(2 / math.sqrt(self.features))
        light, hue = np.split(scale * self._linear("describe", x), 2, axis=1)
        return light, hue, np.float32(EXPECTED_GAIN) * self._linear("expected", x)

    def _mlp(self, name: str, x: np.ndarray) -> np.ndarray:
        """Linear layers "name.0", "name.2", ..., each followed by SiLU."""
        layer = 0
        while f"{name}.{layer}.weight" in self.tensors:
            x = portable.silu(self._linear(f"{name}.{layer}", x))
            layer += 2
        return x

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return portable.matmul(x, self.tensors[f"{name}.weight"].T) + self.tensors[f"{name}.bias"]


def predicting(
    predictor: StoredPredictor | None, splats: Splats, normals: np.ndarray, transfer: Callable[[], np.ndarray]
) -> Predict | None:
    """The predictor's answer for edits of this asset; None where there is none or it is untrained, and then `transfer`,
    which computes [N, 10] of `prt_transfer`, is not called."""
    if predictor is None or predictor.is_untrained:
        return None
    facts = gaussian_facts(splats, normals, transfer())
    return lambda change, weight: predictor.predict(facts, change, weight)


def checked(tensors: Mapping[str, np.ndarray], where: str) -> StoredPredictor:
    """A predictor of these tensors, float32. Raises ValueError, naming `where`, for other tensors."""
    arrays = {name: np.asarray(tensor, np.float32) for name, tensor in tensors.items()}
    width = len(arrays["expected.weight"].T) if "expected.weight" in arrays else 0
    features = len(arrays["describe.weight"]) // 2 if "describe.weight" in arrays else 0
    expected = shapes(width, features)
    for name in sorted(expected.keys() | arrays.keys()):
        if name not in expected or name not in arrays or arrays[name].shape != expected[name]:
            shape = list(arrays[name].shape) if name in arrays else "none"
            raise ValueError(
                f"{where}: 'predictor.{name}': expected {expected.get(name, 'no such tensor')}, got {shape}"
            )
    return StoredPredictor(arrays)


def shapes(width: int, features: int) -> dict[str, tuple[int, ...]]:
    """Name -> shape of every tensor of a predictor of this width and number of features."""
    layers = {
        "own.0": (width, INPUT_CHANNELS),
        "own.2": (width, width),
        "company.0": (width, width),
        "evidence.0": (width, INPUT_CHANNELS + 3),
        "evidence.2": (width, width),
        "together": (width, 3 * width),
        "describe": (2 * features, width),
        "expected": (3, width),
    }
    matrices: dict[str, tuple[int, ...]] = {f"{name}.weight": shape for name, shape in layers.items()}
    return matrices | {f"{name}.bias": shape[:1] for name, shape in layers.items()} | {"trust": ()}


def solve_ridge(features: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[F, C] float32, as `nn.fast_weights.solve_ridge`: the W that minimises
    sum_n weights_n |features_n W - targets_n|^2 + |W|^2, in float64. features: [N, F]; targets: [N, C]; weights:
    [N] >= 0."""
    gram = portable.gram(features, weights) + np.eye(features.shape[1])
    right = portable.transposed_product(features, targets.astype(np.float64) * weights[:, None])
    return portable.solved(gram, right).astype(np.float32)
