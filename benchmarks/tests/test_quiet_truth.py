"""Truth is traced until it can judge: counts of paths, and what is refused, by pictures whose noise is known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from splatbench import light
from splatbench.cases import PosedImages, Setup
from splatbench.ground_truth import GroundTruthViews
from splatbench.light import LightScore
from splatbench.quiet_truth import MAX_NOISE, SPECK_STEP, inside, noise, quiet_views

from splatpainter.cameras import spherical_cameras

CAMERAS = tuple(spherical_cameras(np.zeros(3), 3.0, 2, size=40))


@dataclass(frozen=True)
class NoisyTruth:
    """Grey pictures whose noise falls with the root of the paths; in place of a GroundTruth."""

    deviation: float
    """Display units, at one path."""
    setup: Setup
    traces: list[tuple[str, int]] = field(default_factory=list)

    def render(self, cameras: tuple, purpose: str) -> GroundTruthViews:
        self.traces.append((purpose, self.setup.samples))
        rng = np.random.default_rng([self.setup.samples, *purpose.encode()])
        shape = (len(cameras), 40, 40)
        grey = 0.5 + rng.normal(0, self.deviation / np.sqrt(self.setup.samples), (*shape, 1))
        colors = np.broadcast_to(grey, (*shape, 3)).astype(np.float32)
        return GroundTruthViews(PosedImages(cameras, colors), np.ones(shape, np.float32), np.ones(shape, np.float32))


@pytest.mark.parametrize(("deviation", "samples"), [(0.1, 16), (0.2, 64), (0.4, 256)])
def test_truth_is_traced_with_as_many_paths_as_it_wants(deviation: float, samples: int) -> None:
    truth = NoisyTruth(deviation, Setup(samples=16))
    result = quiet_views(truth, CAMERAS, "novel")  # type: ignore[arg-type]
    assert result.samples == samples
    one, other = result.views.images.colors, result.again.images.colors
    assert (one != other).any(), "noise of its own"
    assert noise(one, other, result.views.masks) <= MAX_NOISE
    assert {purpose for purpose, _ in truth.traces} == {"novel", "novel again"}


def test_truth_that_stays_noisy_does_not_judge() -> None:
    with pytest.raises(ValueError, match=r"% of its pixels differ between two truths of 256 paths"):
        quiet_views(NoisyTruth(3.0, Setup(samples=16)), CAMERAS, "novel")  # type: ignore[arg-type]


def test_noise_is_of_pixels_that_differ_by_a_speck_inside_the_object() -> None:
    mask = np.zeros((1, 20, 20), bool)
    mask[0, 5:15, 5:15] = True
    assert inside(mask[0]).sum() == 36
    one = np.full((1, 20, 20, 3), 0.5, np.float32)
    other = one.copy()
    other[0, 5] += 1  # on the outline
    other[0, 0] += 1  # beside the object
    other[0, 10, 10:12] -= SPECK_STEP * np.array([[0.9], [1.1]], np.float32)
    assert noise(one, other, mask) == pytest.approx(1 / 36)
    assert noise(one, one, np.zeros_like(mask)) == 0


def test_the_table_says_how_many_objects_it_leaves_out_and_how_finely_truth_was_traced() -> None:
    scores = [
        LightScore(name, kind, row, 20.0, 20.0, None, None, 1.0, 0.1, *paths)
        for name, paths in (("a", (16, 64)), ("b", (16, 16)), ("c", (64, 16)))
        for kind in ("coarse", "fitted")
        for row in ("nothing", "ours")
    ]
    result = light._about_truth(scores, ["d: 9.1% of its pixels differ", "e: nothing of it can be seen"])
    assert result == (
        "Objects by paths per pixel: 1 with 16, 2 with 64.",
        "Objects left out: 2; d: 9.1% of its pixels differ; e: nothing of it can be seen.",
    )
