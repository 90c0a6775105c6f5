"""The loop around a task: samples in, steps out, until the steps, the minutes or the patience of a signal run out.

Sample numbers follow from the step alone, whatever the number of processes: a batch of B is B lanes, and every lane
stays on one object of the data for as long as the data does. So a run goes on from its step with the same samples, and
W processes see the same batches as one. Knows no stage.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from tqdm import tqdm

from splatpainter.contact_sheet import Strip, sheet, write_sheet
from splattrain import state
from splattrain.distributed import Group, gathered, quiet, spread
from splattrain.optim import Average, Guard, adamw, rate_at
from splattrain.prefetch import PrefetchedSamples
from splattrain.report import SHEET_CELL_PX, Board, StepTable
from splattrain.stages.task import Task, ValidationScore

if TYPE_CHECKING:
    from splattrain.data.samples import Sample
    from splattrain.recipes import Recipe

SHEET_ROWS = 8
MAX_USELESS_STEPS = 100
"""Steps from the first of a run without one sample that could be used, after which it gives up."""


class Samples(Protocol):
    """A numbered, endless supply: the same number gives the same sample."""

    def __getitem__(self, i: int, /) -> Sample: ...


@dataclass(frozen=True)
class Limits:
    """How far one session goes."""

    minutes: float = 0.0
    """Stop after this many; 0: no limit."""
    steps: int = 0
    """Stop after this many steps of this session; 0: no limit."""


@dataclass
class Result:
    """How a session ended."""

    step: int
    """Steps done in all."""
    ended: str
    """done, minutes, session steps, or the signal's name."""
    validation: dict[str, dict[str, float]] = field(default_factory=dict)
    """Last figures, kind -> figure -> value."""
    skipped: int = 0
    failed: int = 0
    loss: float = float("nan")
    """Mean of the last hundred steps."""


def sample_numbers(step: int, batch: int, samples_per_object: int, rank: int = 0, world: int = 1) -> list[int]:
    """Numbers of the samples of this step that are this process's. samples_per_object:
    consecutive numbers that share one."""
    lanes = range(rank * batch // world, (rank + 1) * batch // world)
    return [
        ((step // samples_per_object) * batch + lane) * samples_per_object + step % samples_per_object for lane in lanes
    ]


class Loop:
    """One session of training."""

    def __init__(
        self,
        task: Task,
        recipe: Recipe,
        samples: Samples,
        held_out: Sequence[Sample],
        out: Path,
        group: Group,
        *,
        resume: bool = False,
        compact: bool = False,
        report: Callable[[str], None] = lambda line: None,
        notes: Mapping[str, Any] | None = None,
    ) -> None:
        """task: on its device; samples: of training objects; held: fixed validation samples; out: folder of the run;
        resume: go on from there; compact: write compact states; notes: more of
        them for the checkpoint. Raises ValueError as state.load, and for a batch that
        the processes cannot share evenly."""
        if recipe.batch % group.world:
            raise ValueError(
                f"train: expected a batch that {group.world} processes can share evenly, got {recipe.batch}"
            )
        self.recipe, self.samples, self.held_out, self.out, self.group = recipe, samples, held_out, out, group
        self.compact, self.report, self.notes = compact, report, dict(notes or {})
        self.shared = spread(task, recipe.parallel, group)
        optimizer = adamw(task.named_parameters(), recipe.learning_rate, recipe.weight_decay)
        average = Average.of(task.named_parameters(), recipe.average)
        history = list(task.model.notes.get("history", []))
        self.run = state.TrainingState(task, optimizer, average, Guard(recipe.spike), state.Progress(history=history))
        self.task, self.progress = task, self.run.progress
        self.config, self.record = task.model.config, recipe.to_dict()
        if resume:
            state.load(out, self.run, self.config, self.record)
        self.progress.aim(recipe.steps)
        step = self.progress.step
        self.table = StepTable(out / "log.csv", step) if group.first else None
        self.figures = StepTable(out / "validation.csv", step) if group.first else None
        self.board = Board(out / "tensorboard", step) if group.first else None
        self.validation: dict[str, dict[str, float]] = {}
        self._stop, self._recent = "", list[float]()
        self._problem = "a sample of another process"

    def __call__(self, limits: Limits = Limits()) -> Result:
        """Train until the recipe's steps, a limit or SIGINT / SIGTERM; save; say how it ended. Raises ValueError, and
        saves nothing, where none of the samples could be used."""
        recipe, progress, begun = self.recipe, self.progress, time.monotonic()
        first, saved, ended = progress.step, time.monotonic(), "done"
        if isinstance(self.samples, PrefetchedSamples):
            self.samples.expect(self._numbers())
        bar = tqdm(
            total=recipe.steps,
            initial=progress.step,
            desc="train",
            disable=None if self.group.first else True,
            leave=False,
        )
        with _signals(self), bar:
            if first == 0 and recipe.validate_every:
                self.validate()
            while progress.step < recipe.steps:
                if reason := self._ends(limits, first, begun):
                    ended = reason
                    break
                start = time.monotonic()
                row = self.step()
                row["seconds"] = time.monotonic() - start
                progress.seconds += row["seconds"]
                self._log(row)
                if progress.step >= MAX_USELESS_STEPS:
                    self._refuse_untrained()
                bar.update(1)
                bar.set_postfix_str(f"loss {row['loss']:.4g}", refresh=False)
                if recipe.validate_every and progress.step % recipe.validate_every == 0:
                    self.validate()
                if self.group.any(self._used > 0 and time.monotonic() - saved > 60 * recipe.save_minutes):
                    self.save()
                    saved = time.monotonic()
            self._refuse_untrained()
            stale = not self._stop and recipe.validate_every and progress.step % recipe.validate_every
            if stale and ended == "done":
                self.validate()
            self.save()
        if self.board is not None:
            self.board.close()
        loss = float(np.mean(self._recent[-100:])) if self._recent else float("nan")
        return Result(progress.step, ended, self.validation, self.run.guard.skipped, progress.failed, loss)

    def step(self) -> dict[str, Any]:
        """One optimiser step, or a refused one. What is logged of it."""
        recipe, task, optimizer, step = self.recipe, self.task, self.run.optimizer, self.progress.step
        rate = rate_at(step, recipe.learning_rate, recipe.warmup, recipe.steps, recipe.final_rate)
        for parameters in optimizer.param_groups:
            parameters["lr"] = rate
        optimizer.zero_grad(set_to_none=True)
        task.train()
        task.step = step
        numbers = sample_numbers(step, recipe.batch, recipe.samples_per_object, self.group.rank, self.group.world)
        sums: dict[str, float] = defaultdict(float)
        kinds, failed = [], 0
        for k, number in enumerate(numbers):
            sample = self._sample(number)
            with quiet(self.shared, k == len(numbers) - 1):
                parts = self.shared(sample, _seed(recipe.seed, number))
                (parts["loss"] / len(numbers)).backward()
            failed += bool(task.problem)
            self._problem = task.problem or self._problem
            if task.problem and self.progress.failed + failed <= 20:
                self.report(f"step {step}: sample {number} skipped: {task.problem}")
            kinds.append(getattr(sample, "kind", "none"))
            for name, value in parts.items():
                sums[name] += float(value.detach()) / len(numbers)
        total = self.group.total(torch.tensor([float(failed), sums["loss"]], dtype=torch.float64))
        bad, loss = int(total[0]), float(total[1]) / self.group.world
        self.progress.failed += bad
        trained = [p for p in task.parameters() if p.requires_grad]
        norm = float(gathered(torch.nn.utils.clip_grad_norm_(trained, recipe.clip)))
        refused = "no sample" if bad == recipe.batch else self.run.guard.admit(norm)
        if not refused:
            optimizer.step()
            self.run.average.update(task.named_parameters(), self.run.guard.seen - 1)
        elif refused != "no sample":
            self.report(f"step {step}: skipped, gradient norm {norm:.3g} ({refused})")
        self.progress.step += 1
        rest = {name: value for name, value in sums.items() if name != "loss"}
        return {"loss": loss, **rest, "norm": norm, "rate": rate, "skipped": refused, "kind": " ".join(kinds)}

    def validate(self) -> dict[str, dict[str, float]]:
        """Judge the held samples with the averaged weights; table, board and sheet. kind -> figure -> mean."""
        if not self.held_out:
            return {}
        sharded = hasattr(self.shared, "unshard")
        if self.group.first or sharded:  # sharded weights need every process
            self.task.eval()
            with self.run.average.used_by(self.task), _unsharded(self.shared):
                scores = [score for sample in self.held_out if (score := self._judge(sample)) is not None]
            if self.group.first:
                self._report(scores)
        self.group.wait()
        return self.validation

    def save(self) -> None:
        """Write OUT/state and OUT/model."""
        state.save(self.out, self.run, self.config, self.record, self.group, compact=self.compact)
        notes = {
            "stage": self.recipe.stage,
            "step": self.progress.step,
            "seconds": round(self.progress.seconds, 1),
            "validation": self.validation,
            "recipe": self.record,
            "history": self.progress.history,
            # Weights whose schedule changed on the way are not made by their recipe's last steps alone.
            **({"lengths": self.progress.lengths} if len(self.progress.lengths) > 1 else {}),
            **self.notes,
        }
        state.save_model(self.out, self.run, self.config, self.group, notes)
        self.group.wait()

    @property
    def _used(self) -> int:
        """Samples that trained, of all sessions and processes."""
        return self.progress.step * self.recipe.batch - self.progress.failed

    def _refuse_untrained(self) -> None:
        """Raises ValueError where there were steps, and none used a sample: its weights are those it began with."""
        step, recipe = self.progress.step, self.recipe
        if step and not self._used:
            raise ValueError(
                f"splatpainter train {recipe.stage}: none of the {step * recipe.batch} samples of {step} steps could "
                f"be used, so nothing was trained or saved; the last: {self._problem}"
            )

    def _numbers(self) -> Iterator[int]:
        """Numbers of all samples to come."""
        for step in range(self.progress.step, self.recipe.steps):
            yield from sample_numbers(
                step, self.recipe.batch, self.recipe.samples_per_object, self.group.rank, self.group.world
            )

    def _sample(self, number: int) -> Sample | str:
        try:
            return self.samples[number]
        except ValueError as error:  # a broken mesh, an object that shows nothing
            return str(error)

    def _judge(self, sample: Sample) -> ValidationScore | None:
        try:
            return self.task.judge(sample)
        except ValueError as error:
            self.report(f"validation: {sample.name} ({sample.kind}) skipped: {error}")
            return None

    def _report(self, scores: Sequence[ValidationScore]) -> None:
        by_kind: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        for score in scores:
            for kind in (score.kind, "all"):
                for name, value in score.numbers.items():
                    by_kind[kind][name].append(value)
        self.validation = {k: {n: float(np.mean(v)) for n, v in f.items()} for k, f in sorted(by_kind.items())}
        flat = {f"{kind} {name}": v for kind, f in self.validation.items() for name, v in f.items()}
        step = self.progress.step
        if self.figures is not None and self.board is not None:
            self.figures.add(step, flat)
            self.board.add(step, flat, "validation")
            strips = [score.strip for score in scores if score.strip][:SHEET_ROWS]
            if strips:
                picture = sheet([Strip("", tuple(strip)) for strip in strips], SHEET_CELL_PX)
                (self.out / "sheets").mkdir(parents=True, exist_ok=True)
                write_sheet(self.out / "sheets" / f"step_{step:07d}.png", picture)
                self.board.picture(step, "validation", picture)
        for kind, f in self.validation.items():
            self.report(f"step {step}: validation {kind}: " + ", ".join(f"{n} {v:.3f}" for n, v in f.items()))

    def _log(self, row: dict[str, Any]) -> None:
        step = self.progress.step
        self._recent.append(row["loss"])
        if self.table is not None and self.board is not None:
            self.table.add(step, row)
            self.board.add(step, row, "train")
        if step % self.recipe.report_every == 0:
            recent = self._recent[-self.recipe.report_every :]
            self.report(
                f"step {step} of {self.recipe.steps}: loss {np.mean(recent):.5g}, "
                f"{self.progress.seconds / step:.2f} s per step"
            )

    def _ends(self, limits: Limits, first: int, begun: float) -> str:
        """Why this session ends now, the same in all processes; or ""."""
        if limits.steps and self.progress.step - first >= limits.steps:
            return "session steps"
        if self.group.any(bool(self._stop)):
            return self._stop or "signal"
        if limits.minutes and self.group.any(time.monotonic() - begun > 60 * limits.minutes):
            return "minutes"
        return ""

    def stop(self, name: str) -> None:
        """End after the step that is running."""
        self._stop = name


def _seed(seed: int, number: int) -> int:
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


@contextmanager
def _unsharded(shared: torch.nn.Module) -> Iterator[None]:
    """Inside, weights that FSDP sharded at the root are whole."""
    if not hasattr(shared, "unshard"):
        yield
        return
    shared.unshard()  # type: ignore[operator]
    try:
        yield
    finally:
        shared.reshard()  # type: ignore[operator]


@contextmanager
def _signals(loop: Loop) -> Iterator[None]:
    """The first SIGINT or SIGTERM ends the session after its step and saves; a second one is as usual."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before: dict[int, Any] = {}

    def stop(number: int, _: Any) -> None:
        loop.stop(signal.Signals(number).name)
        for sign, handler in before.items():
            signal.signal(sign, handler)

    signs = [signal.SIGINT, signal.SIGTERM]
    if sys.platform == "win32":
        signs.append(signal.SIGBREAK)  # what another program can send there
    for sign in signs:
        before[sign] = signal.signal(sign, stop)
    try:
        yield
    finally:
        for sign, handler in before.items():
            signal.signal(sign, handler)
