"""Train and judge the correction of the lift's colours (src/splatpainter/lift/local/correction.py).

Run: python scripts/calibrate/lift_correction.py DATA OUT [--seconds 240] [--cases FOLDER]

DATA: a folder with meshes/, splats/, hdris/, decals/, fonts/, textures/. OUT keeps trials (some 14 MiB each), weights
(correction.json: to be copied beside correction.py) and the table; what it holds is not made again. --cases: folders of
the acceptance protocol, of training meshes and of held-out ones; without it, what paint drawn at 512 px by another
renderer asks for is neither learnt nor judged.

The loss is of novel views, after the steps that bring the edited view as near to its picture as the lift had left it:
so only the freedom that the picture leaves is spent. Novel and edited view before these steps count, too: without them,
colours beyond what can be drawn are learnt.

Held-out objects and captures are judged by edits as the package makes them, with these weights and without any, in the
paint and a rim around it (docs/ADAPTATION.md has the figures).
"""

from __future__ import annotations

import json
import pickle
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from correction_trials import (
    CAPTURES,
    HELD_CAPTURES,
    JUDGED_DEGREES,
    RIM_PX,
    Form,
    JudgedEdit,
    Trial,
    capture_trial,
    case_trial,
    edited_form,
    mesh_streams,
    mesh_trial,
)
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional

from splatpainter.lift.local.correction import (
    COLORS,
    FACTS,
    FADING,
    LEAST_SHARED,
    MAX_DEVIATIONS,
    MAX_STEPS,
    CorrectionWeights,
    LiftedGaussians,
    borne,
    first_root,
    halfway,
)
from splatpainter.rendering import render
from splatpainter.rendering.cpu.sirt import sirt_steps
from splatpainter.splats import SH_C0, Splats
from splatpainter.text_tables import markdown

LEAST_ERROR = 2e-4
"""Added to squared errors: 37 dB are enough."""
BEFORE = 0.3
"""Weight of novel and edited view before the steps."""
EDITED_ALONE = 0.15
"""Of the edited view's logarithm of the error before them, beside that of novel views."""
EASY_WEIGHT = 0.03
"""Of the edited view's after them: it is as near its picture as with the lift."""
KIND_WEIGHTS = {"capture": 3.0, "case": 2.0}
"""How often a kind is drawn, beside 1."""
RATE, DECAY, AVERAGE, TRIALS_PER_STEP = 3e-3, 0.01, 0.01, 2


@dataclass(frozen=True)
class Options:
    """Train a correction of the lift, and judge it."""

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DATA")]
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    cases: Path | None = None
    """Folder of folders of the acceptance protocol."""
    objects: int = 70
    """Training objects whose paint is true; of two thirds as many it is drawn, too."""
    judged: int = 29
    """Held-out edits of either sort."""
    captures: int = 6
    """Edits of each capture."""
    seconds: float = 240.0
    """CPU seconds of training."""
    width: int = 16
    """Of the network's layers."""


@dataclass(frozen=True)
class GaussianFacts:
    """What is read of the J Gaussians of an edit."""

    values: Tensor
    """[J, FACTS]"""
    colors: Tensor
    """[J, COLORS, 3]"""

    @staticmethod
    def of(painted: LiftedGaussians) -> GaussianFacts:
        """Of an edit."""
        values, colors = painted.facts()
        return GaussianFacts(torch.from_numpy(values), torch.from_numpy(colors))


class Correction(nn.Module):
    """Facts to shares of the colours at hand, none at first: `CorrectionWeights` as a module."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scaling: Tensor
        self.register_buffer("scaling", torch.zeros(2, FACTS))
        self.first, self.company = nn.Linear(FACTS, width), nn.Linear(FACTS, width)
        self.second, self.third, self.shares = (
            nn.Linear(width, width),
            nn.Linear(width, width),
            nn.Linear(width, COLORS),
        )
        nn.init.zeros_(self.shares.weight)
        nn.init.zeros_(self.shares.bias)

    def forward(self, facts: GaussianFacts) -> Tensor:
        """[J, 3] changes of colours."""
        mean, deviation = self.scaling
        own = ((facts.values - mean) / deviation).clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS)
        x = functional.silu(self.first(own) + self.company(own.mean(0)))
        x = functional.silu(self.third(functional.silu(self.second(x))))
        return (self.shares(x)[..., None] * facts.colors).sum(1)

    def stored(self) -> dict[str, list[Any]]:
        """What correction.json holds."""
        return {name: _rounded(tensor) for name, tensor in self.state_dict().items()}


def _rounded(tensor: Tensor) -> list[Any]:
    """To four digits: a file of some ten kilobytes."""
    return json.loads(json.dumps(tensor.tolist()), parse_float=lambda text: float(f"{float(text):.4g}"))


@dataclass(frozen=True)
class Steps:
    """The product's steps towards the edited picture (`correction._held`) as linear maps, without its limits on
    colours."""

    edited: Form
    """Its squared error."""
    shared: np.ndarray
    """[J, 1] pixels' worth of each that is its own and of the others that may change."""
    hold: np.ndarray
    """[J, 1]"""

    @staticmethod
    def of(trial: Trial) -> Steps:
        edited, painted = edited_form(trial.painted, trial.counts), trial.painted
        shared = np.asarray(edited[0].sum(1), np.float32)
        return Steps(edited, shared, painted.hold()[:, None])

    @property
    def lift(self) -> float:
        """Its error with the lift's colours."""
        return self.edited[2]

    def _pull(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """([J, 1] length, [J, 1] hold) of a step."""
        pull = self.hold * np.float32(FADING**number)
        return np.where(self.shared > LEAST_SHARED, 1 / np.maximum(self.shared + pull, 1e-6), 0), pull

    def after(self, first: np.ndarray) -> tuple[np.ndarray, int, float, float]:
        """(a correction after them, how many they were, share of the last one that was taken, share of it all that
        was)."""
        form, gradient, _ = self.edited
        change, excess = first, self.error(first) - self.lift
        for number in range(MAX_STEPS):
            if excess <= 0:
                return change, number, 1.0, 1.0
            pulled, (step, pull) = gradient - form @ change, self._pull(number)
            following = change + step * (pulled - pull * (change - first))
            left, slope = self.error(following) - self.lift, -2 * float((pulled * (following - change)).sum())
            if left <= 0:
                share = halfway(first_root(left - excess - slope, slope, excess))
                return change + np.float32(share) * (following - change), number + 1, share, 1.0
            change, excess = following, left
        scale = borne(excess, -2 * float((gradient * change).sum()))
        return np.float32(scale) * change, MAX_STEPS, 1.0, scale

    def error(self, change: np.ndarray) -> float:
        """Squared error of the edited view after a change."""
        form, gradient, total = self.edited
        return float(total - 2 * (gradient * change).sum() + (change * (form @ change)).sum())

    def back(self, gradient: np.ndarray, count: int, share: float, scale: float) -> np.ndarray:
        """The gradient of `first` from that of what comes after; both shares are taken as given."""
        gradient = scale * gradient
        if not count:
            return gradient
        return share * self._back(gradient, count) + (1 - share) * self._back(gradient, count - 1)

    def _back(self, gradient: np.ndarray, count: int) -> np.ndarray:
        form, _, _ = self.edited
        held, passed = np.zeros_like(gradient), gradient
        for number in reversed(range(count)):
            step, pull = self._pull(number)
            moved = step * passed
            held = held + pull * moved
            passed = passed - form @ moved - pull * moved
        return held + passed


def main(options: Options) -> str:
    """Markdown of the table, also in OUT/correction.md."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "correction.json"
    if not path.is_file():
        network = Correction(options.width)
        train(network, list(_trials(options, held=False)), options.seconds)
        path.write_text(json.dumps(network.stored(), separators=(",", ":")) + "\n", encoding="utf-8")
    weights = CorrectionWeights.read(path.read_text(encoding="utf-8"))
    table = _table(weights, _trials(options, held=True))
    (options.out / "correction.md").write_text(table, encoding="utf-8")
    return table


def _trials(options: Options, held: bool) -> Iterator[Trial]:
    """Made once and kept."""
    folder, streams = options.out / "trials", mesh_streams(options.data)
    folder.mkdir(exist_ok=True)
    for name, make in _makers(options, streams[held], held):
        path = folder / f"{name}.pkl"
        if not path.is_file():
            try:
                made = make()
            except ValueError:  # said of many a thin object: no edit of it can be seen
                made = None
            path.write_bytes(pickle.dumps(made))
        if (trial := pickle.loads(path.read_bytes())) is not None:
            yield trial


def _makers(options: Options, stream: Any, held: bool) -> Iterator[tuple[str, Callable[[], Trial | None]]]:
    where, per = "held" if held else "train", stream.samples_per_object
    for drawn in (False, True):
        objects = options.judged if held else options.objects * 2 // 3 if drawn else options.objects
        for number in (k * per + j for k in range(objects) for j in range(1 if held else 2)):
            name = f"{'drawn' if drawn else 'true'}-{where}-{number:06d}"
            yield name, partial(_mesh_trial, stream, number, drawn, held)
    for name in CAPTURES:
        if (name.split(".")[0] in HELD_CAPTURES) == held:
            for k in range(options.captures):
                yield f"capture-{name.split('.')[0]}-{k}", partial(capture_trial, options.data / "splats" / name, k)
    names = {stream.source.name(k) for k in range(len(stream.source))}
    for case in sorted(options.cases.iterdir()) if options.cases else ():
        if case.name in names and (case / "done").is_file():
            yield f"case-{case.name}", partial(case_trial, case)


def _mesh_trial(stream: Any, number: int, drawn: bool, held: bool) -> Trial | None:
    return mesh_trial(stream.full_edit(number), number, drawn, held)


def train(network: Correction, trials: Sequence[Trial], seconds: float) -> None:
    """Logarithms of squared errors: of novel views and the edited one, before and after the steps."""
    facts = [GaussianFacts.of(trial.painted) for trial in trials]
    values = torch.cat([one.values for one in facts])
    network.scaling.copy_(torch.stack([values.mean(0), values.std(0).clamp(min=0.05)]))
    steps, of_kind = [Steps.of(trial) for trial in trials], defaultdict(list)
    for k, trial in enumerate(trials):
        of_kind[trial.kind].append(k)
    kinds = sorted(of_kind)
    odds = np.array([KIND_WEIGHTS.get(kind, 1.0) for kind in kinds])
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    average, rng = [p.detach().clone() for p in network.parameters()], np.random.default_rng(0)
    begun, step = time.process_time(), 0
    while (spent := (time.process_time() - begun) / seconds) < 1:
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / 100) * max(0.02, 0.5 + 0.5 * np.cos(np.pi * spent))
        optimizer.zero_grad()
        for _ in range(TRIALS_PER_STEP):
            chosen = of_kind[kinds[rng.choice(len(kinds), p=odds / odds.sum())]]
            k = chosen[rng.integers(len(chosen))]
            change = network(facts[k])
            change.backward(torch.from_numpy(_gradient(trials[k], steps[k], change.detach().numpy())))
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        step += 1
        for kept, now in zip(average, network.parameters(), strict=True):
            kept.lerp_(now.detach(), AVERAGE)
    print(f"{step} steps on {len(trials)} edits", flush=True)
    with torch.no_grad():
        for kept, now in zip(average, network.parameters(), strict=True):
            now.copy_(kept)


def _gradient(trial: Trial, steps: Steps, first: np.ndarray) -> np.ndarray:
    """[J, 3] of the loss by the correction before the steps."""
    after, count, share, scale = steps.after(first)
    floor = 3 * float(trial.painted.pictures.mask.sum()) * LEAST_ERROR
    novel, edited = (trial.novel, LEAST_ERROR), (steps.edited, floor)
    total = steps.back(_rise(*novel, after) + EASY_WEIGHT * _rise(*edited, after), count, share, scale)
    return (total + BEFORE * (_rise(*novel, first) + EDITED_ALONE * _rise(*edited, first))).astype(np.float32)


def _rise(form: Form, floor: float, change: np.ndarray) -> np.ndarray:
    """[J, 3] gradient of the logarithm of a squared error and the floor."""
    matrix, gradient, total = form
    pulled = matrix @ change
    error = max(float(total - 2 * (gradient * change).sum() + (change * pulled).sum()), 0) + floor
    return 2 * (pulled - gradient) / error


def corrected(trial: Trial, weights: CorrectionWeights) -> Splats:
    """A held-out edit with its colours corrected as the package corrects them."""
    assert trial.judged is not None
    splats = trial.judged.splats
    painted, sh = trial.painted, splats.sh.copy()
    view, movable = painted.view, np.zeros(len(painted.view), bool)
    movable[painted.entries] = True
    steps = sirt_steps(view, painted.pictures.target, trial.counts, movable)
    change = painted.corrected(weights, steps) - view.unclamped_of(painted.entries)
    sh[view.gaussian_ids[painted.entries], 0] += change / SH_C0
    return replace(splats, sh=sh)


def _scores(edit: JudgedEdit, splats: Splats) -> list[float]:
    """PSNR of novel views at each angle, plainly and after a blur of both by a pixel; of the edited view."""
    found: list[float] = []
    for cameras, wanted, counted in edit.tests:
        drawn = np.clip(np.asarray(render(splats, list(cameras)).colors), 0, 1)
        soft = [ndimage.gaussian_filter(x, (0, 1, 1, 0)) for x in (drawn, wanted)]
        found += [_decibels(*pair, counted) for pair in ((drawn, wanted), (soft[0], soft[1]))]
    found += [np.nan] * (2 * (len(JUDGED_DEGREES) - len(edit.tests)))
    picture = np.clip(np.asarray(render(splats, [edit.view.camera]).colors[0]), 0, 1)
    around = ndimage.binary_dilation(edit.view.mask, iterations=RIM_PX)
    return [*found, _decibels(picture, edit.view.edited, around)]


def _decibels(picture: np.ndarray, wanted: np.ndarray, counted: np.ndarray) -> float:
    if counted.sum() <= 40:
        return np.nan
    return float(-10 * np.log10(max(float(np.square(picture - wanted)[counted].mean()), 1e-9)))


def _table(weights: CorrectionWeights, held: Iterator[Trial]) -> str:
    """Means of the lift, and what the correction adds, with standard errors, for each kind."""
    found: dict[str, list[tuple[list[float], list[float]]]] = defaultdict(list)
    for trial in held:
        if (edit := trial.judged) is not None:
            scores = _scores(edit, edit.splats), _scores(edit, corrected(trial, weights))
            found[trial.kind].append(scores)
    columns = [f"{what}{degrees:g}" for degrees in JUDGED_DEGREES for what in ("", "soft ")] + ["edited"]
    rows = []
    for kind, scores in sorted(found.items()):
        lift, better = (np.array(values) for values in zip(*scores, strict=True))
        rows.append({"": f"{kind} ({len(lift)}): the lift", **_cells(columns, lift, "{:.2f}")})
        rows.append({"": "... corrected", **_cells(columns, better - lift, "{:+.2f} ({:.2f})")})
    return markdown(rows)


def _cells(columns: Sequence[str], values: np.ndarray, text: str) -> dict[str, str]:
    """Mean and standard error of each column of [edits, columns] where there are any."""
    cells = {}
    for column, all_of_it in zip(columns, values.T, strict=True):
        known = all_of_it[~np.isnan(all_of_it)]
        cells[column] = text.format(known.mean(), known.std() / np.sqrt(len(known))) if len(known) else "–"
    return cells


if __name__ == "__main__":
    print(main(tyro.cli(Options, description=Options.__doc__)))
