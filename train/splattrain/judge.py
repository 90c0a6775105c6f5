"""Judging trained models on objects that they have never seen: the samples, the figures, and tables with intervals.

Which samples these are depends on the data, the sample recipe and a seed alone, never on a model: checkpoints judged
with equal ones see the same samples, and a longer list begins with the shorter one. A checkpoint of Stage II is judged
by kind of edit, relighting also by number of edited views; one of the LRM or of Stage I by what it reproduces. Every
figure is the stage's own `Task.judge`; here are only the bookkeeping and the statistics. Means are over samples, in dB;
intervals are over objects.
"""

from __future__ import annotations

import copy
import dataclasses
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from splatpainter.contact_sheet import Strip, sheet, write_sheet
from splatpainter.metrics.bootstrap import interval
from splatpainter.models.model import SplatPainterModel
from splatpainter.text_tables import markdown, write_csv, write_markdown
from splattrain import state
from splattrain.build import make_task
from splattrain.data.samples import KINDS, Sample
from splattrain.data.shards import ShardStream
from splattrain.loss import PictureLoss
from splattrain.recipes import Recipe
from splattrain.report import SHEET_CELL_PX
from splattrain.stages.compress import HiddenColors
from splattrain.stages.lrm import LrmTask
from splattrain.stages.task import Task
from splattrain.training_data import DataSettings, is_shards

if TYPE_CHECKING:
    from splattrain.data.painted_gaussians import PaintedGaussianStream
    from splattrain.stages.painted_gaussians_task import PaintedGaussiansTask

COPY, LRM, HIDDEN = "Stage I (copy)", "LRM", "Stage I (hidden colours)"
MANY_VIEWS = "relight"
"""The kind that is judged with several numbers of edited views."""
WORTH = ("strength 0", "another edit", "between Gaussians")
"""Figures of what a network makes of what it is told, in every stage."""
LOCAL_GOAL, RELIGHT_GOAL, COPY_GOAL = 0.5, 1.0, 0.3
"""dB: gain over the lift near local edits; in relighting at each number of views; loss by Stage I."""


@dataclass(frozen=True)
class JudgedSample:
    """One sample of the list."""

    number: int
    """Index in the list, from 0."""
    kind: str
    sample: Sample | str
    """Or why there is none."""


def judged_samples(
    settings: DataSettings, kinds: Mapping[str, float], count: int, max_views: int
) -> Iterator[JudgedSample]:
    """`count` samples of objects held out of training, made one at a time. kinds: kind -> weight; max_views: edited
    views of every "relight" sample (in shards: of those that have them). Raises ValueError where no object is held
    out, or none of the kinds can be made of this data."""
    stream = _validation_stream(settings)
    if is_shards(settings.data):
        streams = {kind: stream for kind in kinds if (stream := _shards_of(settings, kind)) is not None}
    else:
        streams = {kind: _only(stream, kind, max_views) for kind in kinds if kind in stream.kinds}
    if not streams:
        raise ValueError(f"--data {settings.data}: none of the kinds {', '.join(kinds)} can be made of it")
    order = apportioned({kind: kinds[kind] for kind in streams}, count)
    done = dict.fromkeys(streams, 0)
    for number, kind in enumerate(order):
        source = streams[kind]
        # Shards hold the samples of an object one after another: strides reach other objects.
        index = done[kind] * max(len(source) // order.count(kind), 1) if isinstance(source, ShardStream) else number
        done[kind] += 1
        try:
            sample: Sample | str = source[index]
        except ValueError as error:
            sample = str(error)
        yield JudgedSample(number, kind, sample)


def apportioned(weights: Mapping[str, float], count: int) -> list[str]:
    """`count` names in proportion to their weights > 0, mixed: each next one is the name with the largest weight /
    (2 given + 1) (Webster's method), so that every beginning of the list is in proportion too."""
    given = dict.fromkeys(weights, 0)
    order = []
    for _ in range(count):
        name = max(weights, key=lambda n: weights[n] / (2 * given[n] + 1))
        given[name] += 1
        order.append(name)
    return order


def first_views(sample: Sample, count: int) -> Sample:
    """The same edit shown from `count` of its V edited views, evenly spread over them: views go around the object in
    order, so 2 of 4 face each other, and 1 is among these 2."""
    total = len(sample.edited.cameras)
    assert 1 <= count <= total
    indices = [k * total // count for k in range(count)]
    edited = dataclasses.replace(
        sample.edited, cameras=tuple(sample.edited.cameras[k] for k in indices), colors=sample.edited.colors[indices]
    )
    return dataclasses.replace(sample, edited=edited, masks=sample.masks[indices])


def _validation_stream(settings: DataSettings) -> Any:
    stream = settings.stream(validation=True)
    if stream is None:
        raise ValueError(
            f"--data {settings.data}: no object of it is held out of training "
            f"(a share of {settings.share:g} of {settings.counts()[0]}); give more objects"
        )
    return stream


def _only(stream: Any, kind: str, max_views: int) -> Any:
    """The stream with samples of one kind alone. It shares what is remembered of objects with the first one."""
    group = copy.copy(stream)
    group.kinds = {kind: 1.0}
    if kind == MANY_VIEWS:
        group.recipe = dataclasses.replace(stream.recipe, views=(0.0,) * (max_views - 1) + (1.0,))
    return group


def _shards_of(settings: DataSettings, kind: str) -> Any:
    """The samples of one kind in shards, or None where they hold none of it."""
    recipe = dataclasses.replace(settings.recipe, kinds={kind: 1.0})
    try:
        return dataclasses.replace(settings, recipe=recipe).stream(validation=True)
    except ValueError:
        return None


@dataclass(frozen=True)
class SampleScore:
    """The figures of one sample, or of one number of its edited views."""

    sample: int
    """Number of the sample: scores of one sample share it."""
    name: str
    """Name of the object."""
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
    strength_zero: float | None = None
    """Ours without adaptation (edit strength 0), dB."""
    another_edit: float | None = None
    """Ours with a memory that has learnt another edit, dB."""
    between_gaussians: float | None = None
    """Of the power of what Stage II reads, the share that differs between Gaussians, 0..1."""


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
    strength_zero: float | None = None
    """Ours of grey pictures, dB."""
    another_edit: float | None = None
    """Ours of other pictures: those of other cameras, or of complementary colours."""
    between_gaussians: float | None = None
    """Of the power of its tokens, latents or guesses, the share that differs between them, 0..1."""


Rows: TypeAlias = Sequence[EditRow] | Sequence[CopyRow]


def judge_edits(task: Task, samples: Iterable[JudgedSample], views: Sequence[int]) -> Iterator[SampleScore | str]:
    """Findings of a Stage II task, sample by sample; a line for what could not be used. views: numbers of edited views
    that "relight" samples are judged with, as far as they have them."""
    task.eval()
    for judged in samples:
        if isinstance(judged.sample, str):
            yield f"sample {judged.number} ({judged.kind}): {judged.sample}"
            continue
        sample = judged.sample
        view_counts: list[int | None] = [None]
        if sample.kind == MANY_VIEWS:
            view_counts = [n for n in sorted(set(views)) if n <= len(sample.edited.cameras)]
        for count in view_counts:
            try:
                score = task.judge(sample if count is None else first_views(sample, count))
            except ValueError as error:
                yield f"sample {judged.number} ({judged.kind}, {sample.name}): {error}"
                continue
            if "gain" not in score.numbers:
                yield f"sample {judged.number} ({judged.kind}, {sample.name}): no novel view shows the edit"
                continue
            strip = score.strip
            if count is not None:
                strip = ((f"first of {count} edited", strip[0][1]), *strip[1:])
            yield SampleScore(judged.number, sample.name, sample.mode, sample.kind, count, score.numbers, strip)


def judge_painted(task: PaintedGaussiansTask, stream: PaintedGaussianStream, count: int) -> Iterator[SampleScore | str]:
    """Findings of a local network on `count` painted close-ups of held-out objects: novel views near the edit, where it
    changes the object. `ours` is held against the picture (models/local_edit_colors.py); strength 0 and another edit
    are of the network alone, in the paint of the edited view."""
    task.eval()
    for number in range(count):
        try:
            sample = stream.full_edit(number)
            score = task.judge(sample)
        except ValueError as error:
            yield f"sample {number}: {error}"
            continue
        of = score.numbers
        if "gain" not in of:
            yield f"sample {number} ({sample.kind}, {sample.name}): no novel view shows the edit"
            continue
        numbers = {
            "lift": of["novel lift"],
            "ours": of["novel held"],
            "gain": of["gain"],
            "nothing": of["novel nothing"],
        }
        numbers |= {"strength 0": of["edited strength 0"], "another edit": of["edited another picture"]}
        numbers |= {"between Gaussians": of["between Gaussians"], "network alone": of["edited ours"]}
        kind = sample.kind.split(" ")[0]
        yield SampleScore(number, sample.name, "local", kind, None, numbers, score.strip)


def judge_copies(tasks: Mapping[str, Task], samples: Iterable[JudgedSample]) -> Iterator[SampleScore | str]:
    """Findings of the tasks (name -> task, `looking_tasks`) on samples without edits. A copy is compared with what the
    LRM makes of the same sample."""
    for task in tasks.values():
        task.eval()
    for judged in samples:
        if isinstance(judged.sample, str):
            yield f"sample {judged.number}: {judged.sample}"
            continue
        sample = judged.sample
        try:
            scores = {name: task.judge(sample) for name, task in tasks.items()}
        except ValueError as error:
            yield f"sample {judged.number} ({sample.name}): {error}"
            continue
        for name, score in scores.items():
            stage, figure = {LRM: (LRM, "asset"), COPY: (LRM, "ours"), HIDDEN: (HIDDEN, "mean")}[name]
            numbers = {"reference": scores[stage].numbers[figure], "ours": score.numbers["ours"]}
            numbers |= {key: score.numbers[key] for key in WORTH if key in score.numbers}
            yield SampleScore(judged.number, sample.name, "", name, None, numbers, score.strip)


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
    tensors = state.read_outs(folder.parent)
    group = {name: tensor for name, tensor in tensors.items() if name in dict(task.named_parameters())}
    if not group:
        return tasks, f"{folder}: the read-out of hidden colours is in {state.STATE}/ beside it, which is missing"
    task.load_state_dict(group, strict=False)
    return tasks | {HIDDEN: task.to(next(model.parameters()).device)}, ""


def edit_rows(scores: Sequence[SampleScore], seed: int = 0) -> list[EditRow]:
    """One row per kind (relighting: and number of views) in the order of KINDS, then one per mode, in which every
    sample counts once whatever the numbers of views that it was judged with. seed: of the intervals."""
    groups: dict[tuple[str, int | None], list[SampleScore]] = defaultdict(list)
    for score in scores:
        groups[score.kind, score.views].append(score)
    order = sorted(groups, key=lambda key: (KINDS.index(key[0]), key[1] or 0))
    rows = [_edit_row(kind, views, groups[kind, views], seed) for kind, views in order]
    for mode in ("local", "global"):
        group = merged([f for f in scores if f.mode == mode])
        rows += [_edit_row(mode, None, group, seed)] if group else []
    return rows


def copy_rows(scores: Sequence[SampleScore], seed: int = 0) -> list[CopyRow]:
    """One row per task."""
    rows = []
    for name in dict.fromkeys(f.kind for f in scores):
        group = [f for f in scores if f.kind == name]
        mean = {key: float(np.mean([f.numbers[key] for f in group])) for key in ("reference", "ours")}
        differences = [f.numbers["ours"] - f.numbers["reference"] for f in group]
        low, high = interval(differences, [f.name for f in group], seed) or (None, None)
        compared = {LRM: "the asset itself", COPY: "the LRM before compression", HIDDEN: "mean of the shown colours"}
        counts = len(group), len({f.name for f in group})
        figures = [mean["reference"], mean["ours"], float(np.mean(differences)), low, high]
        rows.append(CopyRow(name, *counts, compared[name], *figures, *(_mean(group, key) for key in WORTH)))
    return rows


def merged(scores: Sequence[SampleScore]) -> list[SampleScore]:
    """One score per sample: the means of its figures over the numbers of views that it was judged with."""
    by_sample: dict[int, list[SampleScore]] = defaultdict(list)
    for score in scores:
        by_sample[score.sample].append(score)
    return [
        dataclasses.replace(
            group[0], views=None, numbers={k: float(np.mean([f.numbers[k] for f in group])) for k in group[0].numbers}
        )
        for group in by_sample.values()
    ]


def gains(rows: Sequence[EditRow]) -> dict[str, float]:
    """{mode: gain over the lift in dB}, as `Painter.choose` reads it from the notes of a checkpoint: the lower end of
    the interval, so that weights whose gain may be chance are not used unasked; the mean where there is none."""
    modes = [row for row in rows if row.kind in ("local", "global")]
    return {row.kind: row.gain if row.gain_low is None else row.gain_low for row in modes}


def _edit_row(kind: str, views: int | None, group: Sequence[SampleScore], seed: int) -> EditRow:
    def means(ending: str) -> list[Any]:
        return [_mean(group, f"{name}{ending}") for name in ("nothing", "lift", "ours")]

    counts = len({f.sample for f in group}), len({f.name for f in group})
    gain = float(np.mean([f.numbers["gain"] for f in group]))
    low, high = interval([f.numbers["gain"] for f in group], [f.name for f in group], seed) or (None, None)
    figures: list[Any] = [*means(""), gain, low, high, *means(" SSIM"), *means(" LPIPS-Alex")]
    figures += [_mean(group, name) for name in WORTH]
    return EditRow(kind, views, *counts, *figures)


def _mean(group: Sequence[SampleScore], figure: str) -> float | None:
    """Of those scores that have it."""
    some = [f.numbers[figure] for f in group if figure in f.numbers]
    return float(np.mean(some)) if some else None


def table(rows: Rows) -> str:
    """Markdown: PSNR to 0.01 dB, SSIM and LPIPS as nothing / lift / ours."""
    return markdown([_cells(row) for row in rows])


def write_table(
    folder: Path, rows: Rows, scores: Sequence[SampleScore], heading: str, notes: Sequence[str]
) -> list[Path]:
    """judged.csv (numbers in full), judged.md and judged.png in the folder; the paths. Raises ValueError where it
    cannot be written."""
    paths = [folder / f"judged.{ending}" for ending in ("csv", "md", "png")]
    write_csv(paths[0], rows, heading)
    write_markdown(paths[1], [_cells(row) for row in rows], heading, notes)
    first = {(score.kind, score.views): score.strip for score in reversed(scores)}
    strips = [Strip("", strip) for key in dict.fromkeys((f.kind, f.views) for f in scores) if (strip := first[key])]
    if not strips:
        return paths[:2]
    write_sheet(paths[2], sheet(strips, SHEET_CELL_PX))
    return paths


def goals(rows: Rows) -> list[str]:
    """One line per goal that the rows say something about: what was wanted, what came, reached or missed."""
    lines = []
    edits = [row for row in rows if isinstance(row, EditRow)]
    for row in edits:
        if row.kind == "local":
            lines.append(_goal_line("local edits, novel views near the edit", LOCAL_GOAL, row.gain))
    relit = [row for row in edits if row.kind == MANY_VIEWS]
    lines += [_goal_line(f"relighting from {_view_count(row.views)}", RELIGHT_GOAL, row.gain) for row in relit]
    if len(relit) > 1:
        ours = [row.ours for row in relit]
        rising = all(a < b for a, b in zip(ours, ours[1:], strict=False))
        values = ", ".join(f"{value:.2f}" for value in ours)
        lines.append(f"relighting rises with the views: {values} dB: {'reached' if rising else 'missed'}")
    for row in rows:
        if isinstance(row, CopyRow) and row.what == COPY:
            met = "reached" if row.difference >= -COPY_GOAL else "missed"
            lines.append(f"Stage I within {COPY_GOAL} dB of the LRM: {row.difference:+.2f} dB: {met}")
    return lines


def weak_kinds(rows: Rows) -> tuple[list[str], list[str]]:
    """(kinds on which ours is below the lift, kinds whose interval holds 0 with ours above it)."""
    kinds = [row for row in rows if isinstance(row, EditRow) and row.kind not in ("local", "global")]
    below = [row for row in kinds if row.gain <= 0]
    unsure = [row for row in kinds if row.gain > 0 and (row.gain_low is None or row.gain_low <= 0)]
    return [_name(row) for row in below], [_name(row) for row in unsure]


def as_json(rows: Rows) -> list[dict[str, object]]:
    """JSON values, as checkpoints keep them in their notes."""
    return [dataclasses.asdict(row) for row in rows]


def from_json(records: Sequence[dict[str, object]]) -> Rows:
    """The rows that `as_json` made values of. Raises ValueError for other values."""
    try:
        if records and "what" in records[0]:
            return [CopyRow(**record) for record in records]  # type: ignore[arg-type]
        return [EditRow(**record) for record in records]  # type: ignore[arg-type]
    except TypeError as error:
        raise ValueError(f"notes: expected rows as train judge writes them ({error}); judge the model again") from None


def _cells(row: EditRow | CopyRow) -> dict[str, object]:
    """Cells of a row of the table, for people."""
    if isinstance(row, CopyRow):
        return {
            "what": row.what,
            "samples": row.samples,
            "objects": row.objects,
            "dB": f"{row.ours:.2f}",
            "compared with": row.reference,
            "its dB": f"{row.reference_psnr:.2f}",
            "difference dB": f"{row.difference:+.2f}",
            "interval": _range(row.difference_low, row.difference_high),
            **_worth(row),
        }
    return {
        "edit": row.kind if row.kind not in ("local", "global") else f"all {row.kind}",
        "views": "all" if row.views is None else str(row.views),
        "samples": row.samples,
        "objects": row.objects,
        "nothing dB": f"{row.nothing:.2f}",
        "lift dB": f"{row.lift:.2f}",
        "ours dB": f"{row.ours:.2f}",
        "gain dB": f"{row.gain:+.2f}",
        "interval": _range(row.gain_low, row.gain_high),
        "SSIM": _trio(row.nothing_ssim, row.lift_ssim, row.ours_ssim),
        "LPIPS": _trio(row.nothing_lpips, row.lift_lpips, row.ours_lpips),
        **_worth(row),
    }


def _worth(row: EditRow | CopyRow) -> dict[str, object]:
    """Cells of WORTH."""
    return {
        "strength 0 dB": _number(row.strength_zero),
        "another edit dB": _number(row.another_edit),
        "between Gaussians": _number(row.between_gaussians),
    }


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _range(low: float | None, high: float | None) -> str:
    return "–" if low is None or high is None else f"{low:+.2f} to {high:+.2f}"


def _trio(*values: float | None) -> str:
    return "–" if any(v is None for v in values) else " / ".join(f"{v:.3f}" for v in values)


def _goal_line(what: str, goal: float, gain: float) -> str:
    return (
        f"{what}: goal {goal:+.1f} dB over the lift, measured {gain:+.2f} dB: {'reached' if gain >= goal else 'missed'}"
    )


def _view_count(count: int | None) -> str:
    return "its views" if count is None else "1 view" if count == 1 else f"{count} views"


def _name(row: EditRow) -> str:
    return row.kind if row.views is None else f"{row.kind} from {_view_count(row.views)}"
