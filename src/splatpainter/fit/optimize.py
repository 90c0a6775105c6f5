"""The loop of 3DGS: one view per step, its loss, Adam, and density control now and then.

N Gaussians at the start, N' at the end, V views.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.fit.densify import ORIGINAL_STEPS, DensityOptions, Pulls, Schedule, densify, reset_opacities
from splatpainter.fit.devices import as_numpy, copied, on_device
from splatpainter.fit.gradients import CpuPasses, Target, torch_pass
from splatpainter.fit.image_loss import WINDOW
from splatpainter.fit.parameters import Adam, RawGaussians, to_raw, with_degree
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["FitOptions", "Fitted", "TrainingView", "optimize"]


@dataclass(frozen=True)
class TrainingView:
    """One picture to match."""

    camera: Camera
    color: np.ndarray = field(repr=False)
    """[H, W, 3] float32 0..1 over the camera's background, in the splats' colour space. Where transparency is known,
    give views different backgrounds (black and white in turn): over one, Gaussians of its colour and holes look
    alike."""
    weight: float = 1.0
    """Factor on the view's loss."""
    mask: np.ndarray | None = field(default=None, repr=False)
    """[H, W] bool, or weights >= 0, of the pixels that count; None: all. Pixels of weight 0 have no influence."""


@dataclass(frozen=True)
class FitOptions:
    """How to optimise. Rates are those of 3DGS, which are meant for 30,000 steps; see rate_sh for shorter runs."""

    steps: int = 1000
    densify: bool = True
    """Clone, split and remove Gaussians on the way; needs all attributes."""
    attributes: tuple[str, ...] = ATTRIBUTES
    """Which ones are optimised; the others keep their bits."""
    sh_degree: int | None = None
    """SH degree of the result, 0 to 4; None: as the start."""
    ssim: float = 0.2
    """s in the loss (1 - s) L1 + s (1 - SSIM)."""
    seed: int = 0
    most_gaussians: int = 500_000
    """Density control adds no Gaussians beyond this."""
    rate_means: float = 1.6e-4
    """Rate at the start, in extents per step."""
    rate_means_end: float = 1.6e-6
    """Rate at the end; between them it falls exponentially."""
    rate_scales: float = 5e-3
    """Rate of log-scales."""
    rate_quats: float = 1e-3
    rate_opacities: float = 5e-2
    """Rate of logit-opacities."""
    rate_sh: float | None = None
    """Rate of the constant band; higher ones get a twentieth. None: 2.5e-3, the original's; runs of fewer than 30,000
    steps begin 30,000 / steps times higher, at most MAX_SHORT_RUN_SPEEDUP times, and fall to it exponentially. At
    2.5e-3 a colour moves by 0.0007 a step: a painted region (128 px, 48 more views) is after 300 steps 10.7 dB from its
    picture and 10.0 dB from the truth in novel views, with 0.02 all along 42.0 and 23.8, falling from 0.05 40.2 and
    24.1."""
    extent: float | None = None
    """World units that means' rates and Gaussians' sizes are measured by; None: the asset's own longest side."""
    density: DensityOptions = DensityOptions()
    schedule: Literal["scaled", "original"] | Schedule = "scaled"
    """Schedule of density control: in proportion to `steps`, or as it is for 30,000 of them."""
    device: str = "cpu"
    """"cpu" or "cuda"."""


@dataclass(frozen=True)
class Fitted:
    """Result of a fit."""

    splats: Splats = field(repr=False)
    """Numpy float32. Without density control Gaussian i is still Gaussian i, and Gaussians that did not move keep their
    bits."""
    parents: np.ndarray = field(repr=False)
    """[N'] int64 the Gaussian of the start that each Gaussian is, or comes from."""
    losses: list[float] = field(repr=False)
    """Per step, of the step's view before the step."""
    steps: int
    """Steps that were made."""


@np.errstate(all="ignore")  # Gaussians that cannot be drawn are NaN, and stay that way
def optimize(
    start: Splats,
    views: Sequence[TrainingView],
    options: FitOptions,
    *,
    gaussian_ids: np.ndarray | None = None,
    loss: Callable[[Tensor, TrainingView], Tensor] | None = None,
    watch: Callable[[int, Callable[[], Splats]], object] | None = None,
) -> Fitted:
    """Move Gaussians so that renders match the views.

    start: N Gaussians, numpy. gaussian_ids: [M] indices of those that may change, the others keep their bits (without
    density control only); None: all. loss: of a render [H, W, 3] (a torch tensor, not clamped) and its view, in place
    of L1 and SSIM; the view's mask is then the loss's own business. watch: called after every step, counted from 1,
    with a function that gives the splats as they are then. Equal arguments give equal bits on the CPU, whatever the
    threads.

    Raises ValueError for options that do not fit together, no views, and pictures of another size than their camera's.
    """
    _check(start, views, options, gaussian_ids, loss is not None)
    # One view a step, every view once a round, in a shuffled order.
    run = _Run(start.numpy(), options, gaussian_ids, len(views))
    targets = [Target.of(view.camera, view.color, view.mask, options.ssim, view.weight) for view in views]
    order = _order(len(views), options)
    losses = []
    for step in range(1, options.steps + 1):
        k = order[step - 1]
        loss_of_view = None if loss is None else lambda image, view=views[k]: loss(image, view)
        losses.append(run.step(step, targets[k], loss_of_view))
        if watch is not None:
            watch(step, run.current)
    return Fitted(run.current(), as_numpy(run.parents), losses, options.steps)


class _Run:
    """The state of one optimisation."""

    def __init__(self, start: Splats, options: FitOptions, gaussian_ids: np.ndarray | None, views: int) -> None:
        self.options = options
        self.start = with_degree(start, options.sh_degree)
        device = options.device
        self.gaussian_ids = None if gaussian_ids is None else on_device(np.asarray(gaussian_ids, np.int64), device)
        # What does not move is drawn from the start itself, and shares its memory.
        self.fixed: Splats[Any] = self.start if device == "cpu" else self.start.torch(device)
        self.full = None if gaussian_ids is None else _unshared(self.fixed, options.attributes)
        self.raw = RawGaussians.of(
            self.start if gaussian_ids is None else self.start.take(np.asarray(gaussian_ids, np.int64)), device
        )
        self.parents = on_device(np.arange(len(start)), device)
        self.adam = Adam({name: getattr(self.raw, name) for name in options.attributes})
        self.extent = options.extent or extent(start)
        scaled = Schedule.scaled(options.steps, views)
        named = {"scaled": scaled, "original": Schedule()}
        self.schedule = options.schedule if isinstance(options.schedule, Schedule) else named[options.schedule]
        self.pulls = Pulls(len(start))
        self.rng = np.random.default_rng([options.seed, 1])
        self.passes = CpuPasses("sh" in options.attributes) if device == "cpu" else torch_pass
        self.was_reset = False

    def step(self, step: int, target: Target, loss_of_view: Callable[[Tensor], Tensor] | None) -> float:
        options = self.options
        # Pulls are only looked at while Gaussians may still be added.
        growing = options.densify and step <= self.schedule.stop
        drawn = self._drawn()
        done = self.passes(drawn, target, loss_of_view, growing, options.density.absolute)
        # From activated values to raw ones (logarithms, logits), then one step of Adam.
        moving = slice(None) if self.gaussian_ids is None else self.gaussian_ids
        gradients = {name: done.gradients[name][moving] for name in options.attributes}
        to_raw(gradients, drawn.scales[moving], drawn.opacities[moving])
        values = {name: getattr(self.raw, name) for name in options.attributes}
        self.adam.step(values, gradients, self._rates(step))
        if growing and done.pull is not None:
            self.pulls.add(done.pull, target.camera)
            if self.schedule.due(step):
                self._densify()
            if self.schedule.resets(step):
                reset_opacities(self.raw, options.density.reset)
                self.adam.forget("opacities")
                self.was_reset = True
        return done.loss

    def current(self) -> Splats:
        """Numpy; new arrays. What did not move keeps the start's bits: through log and logit it might come back one
        bit off."""
        parents = as_numpy(self.parents)
        reference = self.start if self.gaussian_ids is not None else self.start.take(parents)
        gaussian_ids = slice(None) if self.gaussian_ids is None else as_numpy(self.gaussian_ids)
        before = reference if self.gaussian_ids is None else reference.take(gaussian_ids)
        # Through logarithm and back a value may change its last bit: what is as it was gets the start's own bits.
        first = RawGaussians.of(before, self.options.device)
        moved = self.raw.splats(self.start).numpy()
        out: dict[str, np.ndarray] = {}
        for name in self.options.attributes:
            same = as_numpy(getattr(first, name) == getattr(self.raw, name))
            values = np.where(same, getattr(before, name), getattr(moved, name))
            if self.gaussian_ids is not None:
                full = getattr(reference, name).copy()
                full[gaussian_ids] = values
                values = full
            out[name] = values
        return replace(reference, **out)

    def _drawn(self) -> Splats[Any]:
        """What is rendered: attributes that are not optimised come straight from the start."""
        moved = self.raw.splats(self.start)
        if self.full is None and len(self.options.attributes) == len(ATTRIBUTES):
            return moved
        if self.full is None:
            return replace(moved, **{n: getattr(self.fixed, n) for n in ATTRIBUTES if n not in self.options.attributes})
        for name in self.options.attributes:
            getattr(self.full, name)[self.gaussian_ids] = getattr(moved, name)
        return replace(self.full, source=None, origin=None)

    def _rates(self, step: int) -> dict[str, np.ndarray]:
        o = self.options
        way = (step - 1) / max(o.steps - 1, 1)
        # 3DGS's schedule: positions slow down over the run, in units of the scene.
        means = self.extent * math.exp((1 - way) * math.log(o.rate_means) + way * math.log(o.rate_means_end))
        rate_sh = short_run_rate(o.steps, way) if o.rate_sh is None else o.rate_sh
        # Higher bands learn twenty times slower: light first, then how it changes.
        bands = np.full((self.raw.sh.shape[1], 3), rate_sh / 20, np.float32)
        bands[0] = rate_sh
        flat = {"means": means, "quats": o.rate_quats, "scales": o.rate_scales, "opacities": o.rate_opacities}
        return {name: np.array([rate], np.float32) for name, rate in flat.items()} | {"sh": bands.reshape(-1)}

    def _densify(self) -> None:
        o = self.options
        done = densify(
            self.raw, self.pulls.mean(), self.extent, o.density, o.most_gaussians, self.was_reset, self.rng, o.device
        )
        self.raw = done.parameters
        self.parents = self.parents[done.source]
        self.adam.select(done.survivors, len(done.source) - len(done.survivors))
        self.pulls = Pulls(len(self.raw))


RATE_SH = 2.5e-3
"""Rate of the original."""
MAX_SHORT_RUN_SPEEDUP = 20.0
"""Short runs begin at most this many times faster."""


def short_run_rate(steps: int, way: float) -> float:
    """FitOptions.rate_sh where none is given. way: 0 at the first step, 1 at the last."""
    return RATE_SH * min(max(ORIGINAL_STEPS / max(steps, 1), 1.0), MAX_SHORT_RUN_SPEEDUP) ** (1 - way)


def extent(splats: Splats) -> float:
    """The longest side of the box around the middle 98 % of the Gaussians that can be drawn, world units; 1 for
    none."""
    arrays = splats.numpy()
    means = arrays.means[splats.drawable]
    if not len(means):
        return 1.0
    # Strays must not set the scale of every step.
    low, high = np.quantile(means, [0.01, 0.99], axis=0)
    return max(float((high - low).max()), float(np.median(arrays.scales[splats.drawable].max(1))), 1e-6)


def _unshared(splats: Splats[Any], names: tuple[str, ...]) -> Splats[Any]:
    """Copies of these attributes: they are written to, and share memory with the caller's arrays."""
    return replace(splats, **{name: copied(getattr(splats, name)) for name in names})


def _order(views: int, options: FitOptions) -> np.ndarray:
    """[steps] which view each step takes: all of them, shuffled, again and again."""
    # Every view once before any comes a second time.
    rng = np.random.default_rng(options.seed)
    rounds = -(-options.steps // views)
    return np.concatenate([rng.permutation(views) for _ in range(max(rounds, 1))])[: options.steps]


def _check(
    start: Splats, views: Sequence[TrainingView], options: FitOptions, gaussian_ids: Any, custom_loss: bool
) -> None:
    if not views:
        raise ValueError("fit: expected at least one view, got none")
    unknown = sorted(set(options.attributes) - set(ATTRIBUTES))
    if unknown or not options.attributes or len(set(options.attributes)) < len(options.attributes):
        raise ValueError(f"fit: expected attributes of {', '.join(ATTRIBUTES)}, each once, got {options.attributes}")
    if options.densify and (gaussian_ids is not None or set(options.attributes) != set(ATTRIBUTES)):
        raise ValueError("fit: density control changes all Gaussians and attributes; set densify=False to keep some")
    if options.steps < 0 or not 0 <= options.ssim <= 1 or options.most_gaussians < 1:
        raise ValueError(
            f"fit: expected steps >= 0, ssim 0..1 and most_gaussians >= 1, got {options.steps}, {options.ssim}, "
            f"{options.most_gaussians}"
        )
    if options.sh_degree is not None and (options.sh_degree not in range(5) or gaussian_ids is not None):
        raise ValueError(f"fit: expected sh_degree 0 to 4, and None where only some move, got {options.sh_degree}")
    if len(start) == 0:
        raise ValueError("fit: expected at least one Gaussian to start from, got none")
    if gaussian_ids is not None and (
        np.asarray(gaussian_ids).dtype.kind not in "iu" or np.asarray(gaussian_ids).ndim != 1
    ):
        raise ValueError("fit: expected gaussian_ids as a list of indices [M]; of a mask take np.flatnonzero")
    for k, view in enumerate(views):
        shape = (view.camera.height, view.camera.width)
        if tuple(view.color.shape) != (*shape, 3) or (view.mask is not None and view.mask.shape != shape):
            raise ValueError(
                f"fit: view {k}: expected colours {[*shape, 3]} and a mask {list(shape)} as its camera says, got "
                f"{list(view.color.shape)}" + ("" if view.mask is None else f" and {list(view.mask.shape)}")
            )
        if options.ssim > 0 and min(shape) < WINDOW and not custom_loss:
            raise ValueError(
                f"fit: view {k}: expected {WINDOW}x{WINDOW} pixels or more, got {shape[1]}x{shape[0]}; or ssim=0"
            )
        if not (np.isfinite(view.color).all() and view.weight >= 0):
            raise ValueError(f"fit: view {k}: expected finite colours and a weight >= 0")
