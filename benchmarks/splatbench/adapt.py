"""`bench adapt`: does test-time training adapt? What carries an edit from Gaussians that are shown to those that are
not, at equal cost, without a renderer.

Every carrier is trained for the same processor time on the same edits of training objects (adapt_carriers.py), with the
edit known exactly on the Gaussians that 1, 2 or 4 views show; figures are of the Gaussians that none of them shows, of
objects that training never saw: PSNR of base colours, each Gaussian by the pixels that show it from all around. Stage
II is also asked without adaptation (edit strength 0), and with the memory of another edit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor
from tyro.conf import Positional, arg

from splatbench import adapt_carriers as carriers
from splatbench.adapt_carriers import MESA, STAGE2, TRAINED, CarrierTraining
from splatbench.report.plots import HorizontalLine, Plot, Point, Series, draw
from splatbench.timing import machine
from splatpainter import text_tables as tables
from splatpainter.metrics.bootstrap import interval
from splatpainter.models.cache import cache_folder
from splatpainter.system.atomic import write_text
from splattrain.data.gaussian_edits import EditKind, GaussianEdit, GaussianEditStream
from splattrain.data.lit_assets import ASSET_KINDS, AssetKind
from splattrain.recipes import Carrier
from splattrain.stages.gaussian_edit_task import GaussianEditTask, fixed_ridge, unseen

VIEW_COUNTS = (1, 2, 4)
JUDGED = (("relight", 2), ("recolor", 1))
"""(kind, how many) edits of every held-out asset and number of views."""
MIN_UNSEEN = 24
"""Fewest Gaussians that no view shows for an edit to be judged."""
STOPS = (0.05, 0.15, 0.4, 0.7, 1.0)
"""Shares of the budget after which all carriers are judged, for the curve."""
CURVE_EVERY = 6
"""Every so many relit edits are judged for the curve."""
CHANGED = (("strength 0", 0.0, False), ("another edit", None, True))
"""(label, edit strength, whether the memory is another edit's) of what Stage II is asked besides."""
SHIPPED, SHIPPED_STAGE2 = "predictor, shipped", "TTT, shipped"
CURVE_WIDTH_PX = 900
NOTES = (
    "PSNR in dB of base colours of the Gaussians that no picture shows, means over edits of held-out objects. "
    "`nothing`: no change. `ridge on fixed features`: the lift's regression, untrained, on all Gaussians that are "
    "shown; the others are shown 512 of them. `Mesa`: the predictor's network. "
    "`shipped`: the predictor and Stage II of the package, trained elsewhere and longer. Carriers of Stage II are one "
    "network with another memory each. `strength 0`: the same weights without adaptation; `another edit`: with the "
    "memory that another light on the same asset leaves. `low`, `high`: middle 95 % of bootstrap means over objects, "
    "of all relit edits. CPU seconds: of training steps, one thread.",
)
Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]


@dataclass(frozen=True)
class AdaptBench:
    """Train every carrier of an edit for the same CPU time, and judge it on held-out objects.

    example:
      splatpainter bench adapt meshes/ --environments hdris/ --seconds 120 --objects 12 --out out/bench-adapt
    """

    meshes: Annotated[Positional[Path | None], arg(metavar="MESHES", help_behavior_hint="")] = None
    """Folder of meshes; those held out of training (by name) are judged. None: procedural objects."""
    environments: Folder = None
    """Folder of HDRIs; none: procedural light."""
    seconds: float = 120.0
    """CPU seconds that each carrier trains for."""
    objects: int = 12
    """Held-out objects that are judged."""
    training_objects: int = 0
    """Objects to train on, the first of a fixed order; 0: all."""
    encoder: Folder = None
    """Checkpoint whose LRM and Stage I encode assets; none: the package's."""
    assets: Folder = None
    """Folder in which assets are kept, so that they are fitted once; default: the user's cache."""
    carriers: tuple[str, ...] = TRAINED
    """Carriers (ways to carry an edit to unseen Gaussians) to train."""
    seed: int = 0
    """Seed of edits, weights and confidence intervals."""
    out: Path = Path("out/bench-adapt")
    """Folder for adapt.md, adapt.csv (a line per edit), curve.csv, curve.svg and weights/; made if missing."""


@dataclass(frozen=True)
class EditScore:
    """One carrier on one edit."""

    carrier: str
    edit: int
    """Number of the edit in the list."""
    object: str
    asset: AssetKind
    kind: EditKind
    views: int
    psnr: float
    """dB over the Gaussians that no picture shows."""
    moved: float | None
    """Rms difference from the answer with adaptation to its own edit, over the rms of that answer; None: this is that
    answer."""


@dataclass(frozen=True)
class CarrierPoint:
    """A carrier partway through its training."""

    carrier: str
    cpu_seconds: float
    steps: int
    psnr: float
    """dB, mean over some of the relit edits."""


@dataclass(frozen=True)
class CarrierRow:
    """Means of a carrier, dB; columns: asset, number of views of a relighting; recolouring."""

    carrier: str
    cpu_seconds: float | None
    coarse_1: float | None
    coarse_2: float | None
    coarse_4: float | None
    fitted_1: float | None
    fitted_2: float | None
    fitted_4: float | None
    relight: float | None
    """All relit edits."""
    low: float | None
    high: float | None
    recolor: float | None


def run(config: AdaptBench, report: Callable[[str], None] | None = None) -> list[CarrierRow]:
    """Train, judge, write; return the means. Carriers that OUT/weights holds with as much training are not trained
    again. report: called with a line now and then. Raises ValueError for options
    that make no sense, and for data that is not there."""
    report = report or (lambda line: None)
    _check(config)
    where = machine()
    training, held = streams(config)
    edits = held_edits(held, config.objects, config.seed)
    if not edits:
        raise ValueError("bench adapt: no held-out object has Gaussians that its views do not show")
    report(
        f"{len(edits)} edits of {len({e.edit.name for e in edits})} held-out objects, {len(training.order)} to train on"
    )
    config.out.mkdir(parents=True, exist_ok=True)
    carriers_in_training = [carriers.carrier_training(name, config.encoder, config.seed) for name in config.carriers]
    carriers.share_rows(carriers_in_training)
    chosen = [held for held in edits if held.edit.kind == "relight"][::CURVE_EVERY]
    points: list[CarrierPoint] = []
    for one in carriers_in_training:
        carriers.load_trained(one, config.out / "weights" / _slug(one.name), config.seconds)
    trained = all(one.seconds >= config.seconds for one in carriers_in_training)
    stops = (
        () if trained else chain([0.0], carriers.side_by_side(carriers_in_training, training, config.seconds, STOPS))
    )
    for stop in stops:
        for one in carriers_in_training:
            value = carriers.judged(
                one, lambda task: float(np.mean([task.decibels(e.edit, e.ask(task)) for e in chosen]))
            )
            points.append(CarrierPoint(one.name, round(one.seconds, 2), one.steps, value))
            if stop:
                carriers.save(one, config.out / "weights" / _slug(one.name))
        report(f"{stop:.0%}: " + ", ".join(f"{p.carrier} {p.psnr:.2f}" for p in points[-len(carriers_in_training) :]))
        tables.write_csv(config.out / "curve.csv", points, where)
        _write_curve(config.out / "curve.svg", points, chosen, carriers_in_training[0].task)
    scores = all_scores(edits, carriers_in_training)
    tables.write_csv(config.out / "adapt.csv", scores, where)
    rows = means(scores, {one.name: one.seconds for one in carriers_in_training}, config.seed)
    tables.write_markdown(config.out / "adapt.md", rows, where, (*NOTES, *remarks(scores, carriers_in_training)))
    return rows


@dataclass(frozen=True)
class HeldEdit:
    """An edit that is judged, and another one of the same asset, shown by the same Gaussians."""

    edit: GaussianEdit
    other: GaussianEdit

    def ask(self, task: GaussianEditTask, strength: float | None = None, swapped: bool = False) -> Tensor:
        """[U, 3] the answer of a carrier."""
        return task.answer(self.edit, strength, self.other if swapped else None)


def streams(config: AdaptBench) -> tuple[GaussianEditStream, GaussianEditStream]:
    """(edits of training objects, of held-out ones). Raises ValueError for data that is not there, or has no object to
    hold out."""
    from splattrain.training_data import DataSettings, ResourceFolders, gaussian_edit_streams

    settings = carriers.recipe()
    data = "procedural:200" if config.meshes is None else str(config.meshes)
    resources = ResourceFolders(environments=config.environments)
    data_settings = DataSettings(data, settings.samples, config.seed, settings.validation_share, resources)
    training, held = gaussian_edit_streams(data_settings, config.assets or cache_folder() / "rows", settings.fitted)
    if held is None:
        raise ValueError(f"bench adapt: {data}: no object is held out of training; give more")
    few = GaussianEditStream(
        training.assets, training.kinds, ASSET_KINDS, config.seed, training.samples_per_object, config.training_objects
    )
    return few, held


def held_edits(stream: GaussianEditStream, objects: int, seed: int) -> list[HeldEdit]:
    """The edits that are judged, the same for equal arguments: of the first objects that can be used, on both kinds of
    assets, from 1, 2 and 4 views."""
    edits: list[HeldEdit] = []
    done = 0
    for i in stream.order:
        if done == objects:
            break
        try:
            items = [stream.assets[int(i), kind] for kind in ASSET_KINDS]
        except ValueError:
            continue
        done += 1
        for item in items:
            for views in VIEW_COUNTS:
                for kind, count in JUDGED:
                    for k in range(count):
                        rng = np.random.default_rng([seed, int(i), ASSET_KINDS.index(item.kind), views, k, len(kind)])
                        edit, other = (stream.edit(item, kind, views, rng) for _ in range(2))  # type: ignore[arg-type]
                        if len(unseen(edit)) >= MIN_UNSEEN and edit.seen.any():
                            edits.append(HeldEdit(edit, in_views_of(other, edit)))
    return edits


def in_views_of(other: GaussianEdit, edit: GaussianEdit) -> GaussianEdit:
    """Another edit, shown in the views of this one."""
    return GaussianEdit(other.item, other.kind, edit.views, other.change, edit.weight, edit.counts)


def all_scores(edits: Sequence[HeldEdit], carriers_in_training: Sequence[CarrierTraining]) -> list[EditScore]:
    """Every carrier on every edit."""
    scores: list[EditScore] = []
    task, shipped, adapting = carriers_in_training[0].task, _shipped("predictor"), _shipped("stage2")

    def add(carrier: str, number: int, answer: Tensor | None, moved: float | None = None) -> None:
        edit = edits[number].edit
        psnr = task.decibels(edit, answer)
        scores.append(EditScore(carrier, number, edit.name, edit.item.kind, edit.kind, edit.views, psnr, moved))

    for number, held in enumerate(edits):
        add("nothing", number, None)
        add("ridge on fixed features", number, fixed_ridge(held.edit))
        if shipped is not None:
            add(SHIPPED, number, shipped.answer(held.edit))

    def add_all(carrier: str, carrier_task: GaussianEditTask) -> None:
        for number, held in enumerate(edits):
            answer = held.ask(carrier_task)
            add(carrier, number, answer)
            for label, strength, swapped in CHANGED:
                # The predictor has no strength, and without its memory cross-attention has nothing to read.
                if carrier == MESA or held.edit.kind != "relight":
                    continue
                if carrier == "cross-attention" and not swapped:
                    continue
                changed = held.ask(carrier_task, strength, swapped)
                add(f"{carrier}: {label}", number, changed, relative(changed, answer))

    if adapting is not None:
        add_all(SHIPPED_STAGE2, adapting)
    for one in carriers_in_training:
        one.task.eval()
        with one.average.used_by(one.task), torch.no_grad():
            add_all(one.name, one.task)
    return scores


def relative(changed: Tensor, answer: Tensor) -> float:
    """Rms of the difference over the rms of the answer."""
    return float((changed - answer).square().mean().sqrt() / answer.square().mean().sqrt().clamp_min(1e-9))


def means(scores: Sequence[EditScore], seconds: dict[str, float], seed: int = 0) -> list[CarrierRow]:
    """A row per carrier, in the order in which they come."""
    rows = []
    for carrier in dict.fromkeys(score.carrier for score in scores):
        part = [score for score in scores if score.carrier == carrier]

        def mean(kind: EditKind, asset: str = "", views: int = 0, part: list[EditScore] = part) -> float | None:
            fits = [s.psnr for s in part if s.kind == kind and s.asset in (asset or s.asset) and views in (0, s.views)]
            return float(np.mean(fits)) if fits else None

        relit = [score for score in part if score.kind == "relight"]
        low, high = interval([s.psnr for s in relit], [s.object for s in relit], seed) or (None, None)
        spent = seconds.get(carrier)
        spent = None if spent is None else round(spent, 1)
        columns = {f"{asset}_{views}": mean("relight", asset, views) for asset in ASSET_KINDS for views in VIEW_COUNTS}
        ends = {"relight": mean("relight"), "low": low, "high": high, "recolor": mean("recolor")}
        rows.append(CarrierRow(carrier, spent, **columns, **ends))
    return rows


def remarks(scores: Sequence[EditScore], carriers_in_training: Sequence[CarrierTraining]) -> list[str]:
    """What the figures say about adaptation, and what the training was."""
    lines = []
    for name in (SHIPPED_STAGE2, *STAGE2):
        adapted = {s.edit: s.psnr for s in scores if s.carrier == name and s.kind == "relight"}
        for label, _, _ in CHANGED:
            part = [s for s in scores if s.carrier == f"{name}: {label}" and s.kind == "relight"]
            if not part:
                continue
            gain = float(np.mean([adapted[s.edit] - s.psnr for s in part]))
            moved = float(np.mean([s.moved for s in part if s.moved is not None]))
            lines.append(
                f"{name}: adapting is worth {gain:+.2f} dB against {label}, which moves the added colours by "
                f"{moved:.0%} (relit edits)."
            )
    for one in carriers_in_training:
        cost = 1000 * one.seconds / max(one.steps, 1)
        lines.append(f"{one.name}: {one.steps:,} steps of {cost:.0f} CPU ms.")
    return lines


def _shipped(carrier: Carrier) -> GaussianEditTask | None:
    """The predictor or Stage II of the package; None where there is none that is asked row by row."""
    from splatpainter.models import weights
    from splatpainter.models.model import SplatPainterModel
    from splattrain.stages.gaussian_edit_task import GaussianEditOptions

    folder = weights.find("compact")
    model = None if folder is None else SplatPainterModel.load(folder)
    if model is None or (model.predictor is None if carrier == "predictor" else model.config.edits_locally):
        return None
    return GaussianEditTask(model, GaussianEditOptions(carrier)).eval()


def _check(config: AdaptBench) -> None:
    """Raises ValueError for what cannot be."""
    if not config.seconds > 0 or config.objects < 1 or config.training_objects < 0 or config.seed < 0:
        raise ValueError("bench adapt: expected --seconds above 0, --objects of at least 1, and no negative number")
    if unknown := [name for name in config.carriers if name not in TRAINED]:
        raise ValueError(f"bench adapt: expected --carriers of {', '.join(TRAINED)}, got {unknown[0]!r}")
    if not config.carriers:
        raise ValueError("bench adapt: expected at least one of --carriers")


def _slug(name: str) -> str:
    return "-".join("".join(c if c.isalnum() else " " for c in name.lower()).split())


def _write_curve(
    path: Path, points: Sequence[CarrierPoint], chosen: Sequence[HeldEdit], task: GaussianEditTask
) -> None:
    """PSNR over processor time, with what needs no training as levels."""
    nothing = float(np.mean([task.decibels(held.edit, None) for held in chosen]))
    ridge = float(np.mean([task.decibels(held.edit, fixed_ridge(held.edit)) for held in chosen]))
    series = []
    for k, name in enumerate(dict.fromkeys(point.carrier for point in points)):
        line = [Point(p.cpu_seconds, p.psnr) for p in points if p.carrier == name and p.cpu_seconds > 0]
        series.append(Series(name, k, tuple(line), joined=True))
    levels = (HorizontalLine("nothing", nothing), HorizontalLine("ridge on fixed features", ridge, 5))
    title = "Gaussians that no picture shows, under a new light"
    chart = Plot(title, "CPU seconds of training", "PSNR, dB", tuple(series), levels, log_x=True)
    write_text(path, draw(chart, CURVE_WIDTH_PX))
