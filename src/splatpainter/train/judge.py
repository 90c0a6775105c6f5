"""What a trained model reaches on objects that it has never seen: tables with intervals.

A checkpoint of Stage II is judged by kind of edit, relighting also by number of edited views; one of the LRM or of
Stage I by what it reproduces. Every figure is the stage's own `Task.judge`; here are only the bookkeeping and the
statistics. Means are over samples, in dB; intervals are over objects.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.data.samples import KINDS
from splatpainter.metrics.bootstrap import interval
from splatpainter.models.model import SplatPainterModel
from splatpainter.train import state
from splatpainter.train.build import make_task
from splatpainter.train.loss import PictureLoss
from splatpainter.train.recipes import Recipe
from splatpainter.train.stages.compress import HiddenColors
from splatpainter.train.stages.lrm import LrmTask
from splatpainter.train.stages.task import Task, Verdict
from splatpainter.train.trials import MANY_VIEWS, Trial, first_views

COPY, LRM, HIDDEN = "Stage I (copy)", "LRM", "Stage I (hidden colours)"


@dataclass(frozen=True)
class Finding:
    """The figures of one sample, or of one number of its edited views."""

    sample: int
    """Its number: findings of one sample share it."""
    name: str
    """Of the object."""
    mode: str
    """local, global; "" where nothing is edited."""
    kind: str
    """Kind of edit, or what is judged (LRM, ...)."""
    views: int | None
    """Edited views, where the kind is judged by their number."""
    numbers: dict[str, float]
    strip: tuple[tuple[str, np.ndarray], ...] = field(repr=False)
    """A row of the contact sheet."""


@dataclass(frozen=True)
class EditRow:
    """Means of a kind of edit: PSNR in dB, SSIM, LPIPS-Alex on novel views; of local edits near the edit and where it
    changes the object, of global ones on the object. `nothing`: the asset as it is. None: not measured."""

    kind: str
    """Or local / global: all samples of the mode, each counted once."""
    views: int | None
    samples: int
    objects: int
    nothing: float
    lift: float
    ours: float
    gain: float
    """Mean of ours - lift."""
    gain_low: float | None
    """The middle 95 % of bootstrap means over objects; None with a single object."""
    gain_high: float | None
    nothing_ssim: float | None
    lift_ssim: float | None
    ours_ssim: float | None
    nothing_lpips: float | None
    lift_lpips: float | None
    ours_lpips: float | None


@dataclass(frozen=True)
class CopyRow:
    """Means of what a stage before Stage II reproduces, PSNR in dB."""

    what: str
    samples: int
    objects: int
    reference: str
    """What it is compared with."""
    reference_psnr: float
    ours: float
    difference: float
    """Mean of ours - reference."""
    difference_low: float | None
    difference_high: float | None


def judge_edits(task: Task, trials: Iterable[Trial], views: Sequence[int]) -> Iterator[Finding | str]:
    """Findings of a Stage II task, sample by sample; a line for what could not be used. views: numbers of edited views
    that "relight" samples are judged with, as far as they have them."""
    task.eval()
    for trial in trials:
        if isinstance(trial.sample, str):
            yield f"sample {trial.number} ({trial.kind}): {trial.sample}"
            continue
        sample = trial.sample
        shown: list[int | None] = [None]
        if sample.kind == MANY_VIEWS:
            shown = [n for n in sorted(set(views)) if n <= len(sample.edited.cameras)]
        for count in shown:
            try:
                verdict = task.judge(sample if count is None else first_views(sample, count))
            except ValueError as error:
                yield f"sample {trial.number} ({trial.kind}, {sample.name}): {error}"
                continue
            if "gain" not in verdict.numbers:
                yield f"sample {trial.number} ({trial.kind}, {sample.name}): no novel view shows the edit"
                continue
            strip = verdict.strip
            if count is not None:
                strip = ((f"first of {count} edited", strip[0][1]), *strip[1:])
            yield Finding(trial.number, sample.name, sample.mode, sample.kind, count, verdict.numbers, strip)


def judge_copies(tasks: Mapping[str, Task], trials: Iterable[Trial]) -> Iterator[Finding | str]:
    """Findings of the tasks (name -> task, `looking_tasks`) on samples without edits. A copy is compared with what the
    LRM makes of the same sample."""
    for task in tasks.values():
        task.eval()
    for trial in trials:
        if isinstance(trial.sample, str):
            yield f"sample {trial.number}: {trial.sample}"
            continue
        sample = trial.sample
        try:
            verdicts = {name: task.judge(sample) for name, task in tasks.items()}
        except ValueError as error:
            yield f"sample {trial.number} ({sample.name}): {error}"
            continue
        for name, verdict in verdicts.items():
            numbers = {"reference": _reference(name, verdicts), "ours": verdict.numbers["ours"]}
            yield Finding(trial.number, sample.name, "", name, None, numbers, verdict.strip)


def refine_task(recipe: Recipe, model: SplatPainterModel, perceptual_weights: Path | None) -> Task:
    """The Stage II task of a trained model: encoder and decoder as they are."""
    return make_task(dataclasses.replace(recipe, perceptual=0.0, train_encoder="nothing"), model, perceptual_weights)


def looking_tasks(recipe: Recipe, model: SplatPainterModel, folder: Path) -> tuple[dict[str, Task], str]:
    """({name: task} for what a checkpoint of the LRM or of Stage I can be judged by, a line about what cannot, or "").
    The read-out of hidden colours is no part of a model; it is looked for in the run that wrote the folder."""
    tasks: dict[str, Task] = {LRM: LrmTask(model, PictureLoss(None, 0.0), 0, 0)}
    if recipe.stage == "lrm":
        return tasks, ""
    task = make_task(dataclasses.replace(recipe, perceptual=0.0), model, None)
    if not isinstance(task, HiddenColors):
        return tasks | {COPY: task}, ""
    found = state.read_outs(folder.parent)
    own = {name: tensor for name, tensor in found.items() if name in dict(task.named_parameters())}
    if not own:
        return tasks, f"{folder}: the read-out of hidden colours is in {state.STATE}/ beside it, which is not there"
    task.load_state_dict(own, strict=False)
    return tasks | {HIDDEN: task.to(next(model.parameters()).device)}, ""


def edit_rows(findings: Sequence[Finding], seed: int = 0) -> list[EditRow]:
    """One row per kind (relighting: and number of views) in the order of KINDS, then one per mode, in which every
    sample counts once whatever the numbers of views that it was judged with. seed: of the intervals."""
    groups: dict[tuple[str, int | None], list[Finding]] = defaultdict(list)
    for finding in findings:
        groups[finding.kind, finding.views].append(finding)
    order = sorted(groups, key=lambda key: (KINDS.index(key[0]), key[1] or 0))
    rows = [_edit_row(kind, views, groups[kind, views], seed) for kind, views in order]
    for mode in ("local", "global"):
        own = merged([f for f in findings if f.mode == mode])
        rows += [_edit_row(mode, None, own, seed)] if own else []
    return rows


def copy_rows(findings: Sequence[Finding], seed: int = 0) -> list[CopyRow]:
    """One row per task."""
    rows = []
    for name in dict.fromkeys(f.kind for f in findings):
        own = [f for f in findings if f.kind == name]
        mean = {key: float(np.mean([f.numbers[key] for f in own])) for key in ("reference", "ours")}
        differences = [f.numbers["ours"] - f.numbers["reference"] for f in own]
        low, high = interval(differences, [f.name for f in own], seed) or (None, None)
        compared = {LRM: "the asset itself", COPY: "the LRM before compression", HIDDEN: "mean of the shown colours"}
        counts = len(own), len({f.name for f in own})
        mean_difference = float(np.mean(differences))
        rows.append(CopyRow(name, *counts, compared[name], mean["reference"], mean["ours"], mean_difference, low, high))
    return rows


def merged(findings: Sequence[Finding]) -> list[Finding]:
    """One finding per sample: the means of its figures over the numbers of views that it was judged with."""
    by_sample: dict[int, list[Finding]] = defaultdict(list)
    for finding in findings:
        by_sample[finding.sample].append(finding)
    return [
        dataclasses.replace(
            own[0], views=None, numbers={k: float(np.mean([f.numbers[k] for f in own])) for k in own[0].numbers}
        )
        for own in by_sample.values()
    ]


def gains(rows: Sequence[EditRow]) -> dict[str, float]:
    """{mode: mean gain over the lift in dB}, as `Painter.choose` reads it from the notes of a checkpoint."""
    return {row.kind: row.gain for row in rows if row.kind in ("local", "global")}


def sheet_strips(findings: Sequence[Finding]) -> list[tuple[tuple[str, np.ndarray], ...]]:
    """A strip per row of the table: its first finding's."""
    first: dict[tuple[str, int | None], tuple[tuple[str, np.ndarray], ...]] = {}
    for finding in findings:
        first.setdefault((finding.kind, finding.views), finding.strip)
    return list(first.values())


def _reference(name: str, verdicts: Mapping[str, Verdict]) -> float:
    if name == COPY:
        return verdicts[LRM].numbers["ours"]
    return verdicts[name].numbers["asset" if name == LRM else "mean"]


def _edit_row(kind: str, views: int | None, own: Sequence[Finding], seed: int) -> EditRow:
    def mean(figure: str) -> float | None:
        some = [f.numbers[figure] for f in own if figure in f.numbers]
        return float(np.mean(some)) if some else None

    def means(ending: str) -> list[Any]:
        return [mean(f"{name}{ending}") for name in ("nothing", "lift", "ours")]

    psnr, ssim, lpips = means(""), means(" SSIM"), means(" LPIPS-Alex")
    low, high = interval([f.numbers["gain"] for f in own], [f.name for f in own], seed) or (None, None)
    return EditRow(
        kind=kind,
        views=views,
        samples=len({f.sample for f in own}),
        objects=len({f.name for f in own}),
        nothing=psnr[0],
        lift=psnr[1],
        ours=psnr[2],
        gain=float(np.mean([f.numbers["gain"] for f in own])),
        gain_low=low,
        gain_high=high,
        nothing_ssim=ssim[0],
        lift_ssim=ssim[1],
        ours_ssim=ssim[2],
        nothing_lpips=lpips[0],
        lift_lpips=lpips[1],
        ours_lpips=lpips[2],
    )
