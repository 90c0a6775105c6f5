"""What a network knows that the lift does not: a correction of the lift's colours that novel views gain by.

Run: python scripts/calibrate/lift_correction.py DATA OUT [--seconds 150] [--cases FOLDER]

DATA: a folder with meshes/, splats/, hdris/, decals/, fonts/, textures/. OUT keeps trials (some 14 MiB each),
weights and the table; what it holds is not made again. --cases: folders of the acceptance protocol, of training meshes
and of held-out ones; without it, what paint drawn at 512 px by another renderer asks for is neither learnt nor judged.

Every Gaussian that a local edit may change gets a mixture of colours that are at hand: its neighbours', the picture's
over it, its own before the edit. How much of each a small network says, of what the view shows of it and of them
(`correction_trials.facts_of`); it starts at none, which is the lift. Then rounds of the lift hold the colours against
the edited picture until it is as near as the lift had left it, so that only the freedom which the picture leaves is
spent. The loss is of novel views after these rounds, and of novel and edited view before them: without the latter,
colours beyond what can be drawn are learnt (true paint 20 degrees away -0.2 dB in place of +0.1).

Held-out objects and captures are judged, in the paint and a rim around it (docs/ADAPTATION.md has the figures).
"""

from __future__ import annotations

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
    NEIGHBOUR_FACTS,
    OTHER_COLORS,
    OWN_FACTS,
    SHOWN_FACT,
    SHOWN_MARGIN,
    Form,
    GaussianFacts,
    Trial,
    capture_trial,
    case_trial,
    mesh_streams,
    mesh_trial,
)
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional

from splatpainter.lift.colors import lift_colors
from splatpainter.lift.edits import LiftedEdit
from splatpainter.lift.local.evidence import footprints
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import SH_C0, Splats
from splatpainter.text_tables import markdown

LEAST_ERROR = 2e-4
"""Added to squared errors: 37 dB are enough."""
ROUNDS, HOLD = 2, 0.1
"""Rounds towards the edited picture in training, and the pixels' worth of weight that the correction has in them; when
judged also per pixel of a Gaussian that the view hides."""
TRIED_ROUNDS = (2, 3, 4, 6, 8, 12)
"""When judged: the first that leaves the edited view as near its picture as the lift did, or the last."""
EDITED_ALONE = 0.15
"""Of the edited view's logarithm of the error before the rounds, beside that of novel views."""
HELD_LOG, EASY_WEIGHT = 0.05, 0.03
"""After the rounds the edited view counts as much as novel ones where its logarithm of the error is above the lift's
less HELD_LOG, and by EASY_WEIGHT below: what is nearer than the lift's buys nothing."""
KIND_WEIGHTS = {"capture": 3.0, "case": 2.0}
"""How often a kind is drawn, beside 1."""
RATE, DECAY, AVERAGE, TRIALS_PER_STEP = 3e-3, 0.01, 0.01, 2
RADIUS = 5.0
"""Facts are bounded by this many standard deviations."""


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
    seconds: float = 150.0
    """CPU seconds of training."""
    width: int = 16
    """Of the network's layers."""
    neighbours: int = 4
    """Whose colours are mixed."""


class Correction(nn.Module):
    """Facts to a change of colours, zero at first."""

    def __init__(self, width: int, neighbours: int) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.scaling: Tensor
        self.register_buffer("scaling", torch.zeros(2, OWN_FACTS + NEIGHBOUR_FACTS))
        self.own, self.company, self.alone = nn.Linear(OWN_FACTS, width), nn.Linear(OWN_FACTS, width), _square(width)
        self.near, self.asked = nn.Linear(NEIGHBOUR_FACTS, width), nn.Linear(width, width, bias=False)
        self.pair, self.whole = _square(width), nn.Linear(2 * width, width)
        self.of_pair, self.of_whole = nn.Linear(width, 1, bias=False), nn.Linear(width, 1)
        self.of_both, self.of_others = nn.Linear(width, width, bias=False), nn.Linear(width, OTHER_COLORS)
        for layer in (self.of_pair, self.of_whole, self.of_both, self.of_others):
            nn.init.zeros_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)

    def forward(self, facts: GaussianFacts) -> Tensor:
        """[J, 3]."""
        around, colors = facts.around[:, : self.neighbours], facts.colors
        at_hand = torch.from_numpy(np.concatenate([colors[:, : self.neighbours], colors[:, -OTHER_COLORS:]], 1))
        mean, deviation = self.scaling
        own = ((torch.from_numpy(facts.own) - mean[:OWN_FACTS]) / deviation[:OWN_FACTS]).clamp(-RADIUS, RADIUS)
        near = ((torch.from_numpy(around) - mean[OWN_FACTS:]) / deviation[OWN_FACTS:]).clamp(-RADIUS, RADIUS)
        # What kind of asset and edit this is, all Gaussians hear.
        alone = functional.silu(self.alone(functional.silu(self.own(own) + self.company(own.mean(0)))))
        pairs = functional.silu(self.pair(functional.silu(self.near(near) + self.asked(alone)[:, None])))
        whole = functional.silu(self.whole(torch.cat([alone, pairs.mean(1)], -1)))
        shares = self.of_pair(pairs)[..., 0] + self.of_whole(whole) + (pairs * self.of_both(whole)[:, None]).sum(-1)
        return (torch.cat([shares / 4, self.of_others(whole)], 1)[..., None] * at_hand).sum(1)


def _square(width: int) -> nn.Linear:
    return nn.Linear(width, width)


@dataclass(frozen=True)
class Rounds:
    """ROUNDS of the lift towards the edited picture as a linear map of a correction, and its transpose."""

    edited: Form
    pull: float
    step: np.ndarray
    """[J, 1]"""

    @staticmethod
    def of(trial: Trial) -> Rounds:
        form, _, _ = trial.edited
        rows = np.asarray(form.sum(1)).ravel()
        # The form is over 3 n pixels; what the mask shows of a Gaussian says n.
        shown = 2.0 ** (5 * trial.facts.own[:, SHOWN_FACT]) - SHOWN_MARGIN
        known = (shown > 0.5) & (rows > 0)
        scale = float(np.median(rows[known] / shown[known])) if known.any() else 1.0
        step = np.where(rows > 1e-3 * scale, 1 / np.maximum(rows + HOLD * scale, 1e-12), 0)
        return Rounds(trial.edited, HOLD * scale, step.astype(np.float32)[:, None])

    def after(self, first: np.ndarray) -> np.ndarray:
        form, gradient, _ = self.edited
        change = first
        for _ in range(ROUNDS):
            change = change + self.step * (gradient - form @ change - self.pull * (change - first))
        return change

    def back(self, gradient: np.ndarray) -> np.ndarray:
        """The gradient of `first` from that of what comes after."""
        form, _, _ = self.edited
        held, passed = np.zeros_like(gradient), gradient
        for _ in range(ROUNDS):
            moved = self.step * passed
            held = held + self.pull * moved
            passed = passed - form @ moved - self.pull * moved
        return held + passed


def main(options: Options) -> str:
    """Markdown of the table, also in OUT/correction.md."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    options.out.mkdir(parents=True, exist_ok=True)
    weights, network = options.out / "correction.pt", Correction(options.width, options.neighbours)
    if weights.is_file():
        network.load_state_dict(torch.load(weights))
    else:
        train(network, list(_trials(options, held=False)), options.seconds)
        torch.save(network.state_dict(), weights)
    table = _table(network.eval(), _trials(options, held=True))
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
    """Logarithms of squared errors: of novel views and the edited one, before and after the rounds."""
    columns = np.concatenate([t.facts.own for t in trials]), np.concatenate([t.facts.around[::7] for t in trials])
    parts = [torch.from_numpy(part.reshape(-1, part.shape[-1])) for part in columns]
    mean, deviation = torch.cat([p.mean(0) for p in parts]), torch.cat([p.std(0).clamp(min=0.05) for p in parts])
    network.scaling.copy_(torch.stack([mean, deviation]))
    rounds, of_kind = [Rounds.of(trial) for trial in trials], defaultdict(list)
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
            change = network(trials[k].facts)
            change.backward(torch.from_numpy(_gradient(trials[k], rounds[k], change.detach().numpy())))
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        step += 1
        for kept, now in zip(average, network.parameters(), strict=True):
            kept.lerp_(now.detach(), AVERAGE)
    print(f"{step} steps on {len(trials)} edits", flush=True)
    with torch.no_grad():
        for kept, now in zip(average, network.parameters(), strict=True):
            now.copy_(kept)


def _gradient(trial: Trial, rounds: Rounds, first: np.ndarray) -> np.ndarray:
    """[J, 3] of the loss by the correction before the rounds."""
    after = rounds.after(first)
    lift = log_error(trial.edited, np.zeros_like(first))[0]
    (_, novel), (now, edited) = (log_error(form, after) for form in (trial.novel, trial.edited))
    held = 1.0 if now > lift - HELD_LOG else EASY_WEIGHT
    (_, novel_alone), (_, edited_alone) = (log_error(form, first) for form in (trial.novel, trial.edited))
    total = rounds.back(novel + held * edited) + novel_alone + EDITED_ALONE * edited_alone
    return total.astype(np.float32)


def log_error(form: Form, change: np.ndarray) -> tuple[float, np.ndarray]:
    """(logarithm of the squared error, its gradient [J, 3])."""
    matrix, gradient, total = form
    pulled = matrix @ change
    error = max(float(total - 2 * (gradient * change).sum() + (change * pulled).sum()), 0) + LEAST_ERROR
    return float(np.log(error)), 2 * (pulled - gradient) / error


def answers(network: Correction, trial: Trial) -> Iterator[tuple[str, Splats]]:
    """What is compared: by name."""
    lifted = trial.lifted
    with torch.no_grad():
        change = network(trial.facts).numpy()
    sh = lifted.splats.sh.copy()
    sh[trial.facts.ids, 0] += change / SH_C0
    alone = replace(lifted, splats=replace(lifted.splats, sh=sh))
    yield "the lift", lifted.splats
    yield "... and its rounds", with_rounds(lifted, trial, ROUNDS)
    yield "corrected", alone.splats
    wanted, result = _edited_error(lifted.splats, trial), alone.splats
    for rounds in TRIED_ROUNDS:
        result = with_rounds(alone, trial, rounds)
        if _edited_error(result, trial) <= wanted:
            break
    yield "corrected, held to the picture", result


def with_rounds(lifted: LiftedEdit, trial: Trial, rounds: int) -> Splats:
    """The edit after rounds towards its picture, held to what it is."""
    splats, view, count = lifted.splats, trial.view, len(lifted.splats)
    editable, hold = np.zeros(count, bool), np.zeros(count, np.float32)
    editable[lifted.ids] = True
    ones = np.ones(view.mask.shape, np.float32)
    everything = project(splats, view.camera)
    shown = everything.backproject(view.target, ones).weight
    hold[everything.gaussian_ids] = np.maximum(footprints(everything) - shown, 0)
    seen = project(splats, view.camera, tiles=everything.tiles_of(editable))
    ids = seen.gaussian_ids
    colors = lift_colors(seen, view.target, ones, editable[ids], rounds, (HOLD + HOLD * hold)[ids])
    sh = splats.sh.copy()
    sh[ids, 0] += (editable[ids, None] * (colors - np.maximum(seen.unclamped_colors, 0)) / SH_C0).astype(sh.dtype)
    return replace(splats, sh=sh)


def _edited_error(splats: Splats, trial: Trial) -> float:
    picture = np.clip(np.asarray(render(splats, [trial.view.camera]).colors[0]), 0, 1)
    return float(np.square(picture - trial.view.edited)[trial.view.mask].mean())


def _scores(trial: Trial, splats: Splats) -> list[float]:
    """PSNR of novel views at each angle, plainly and after a blur of both by a pixel; of the edited view."""
    found: list[float] = []
    for cameras, wanted, counted in trial.judged:
        drawn = np.clip(np.asarray(render(splats, list(cameras)).colors), 0, 1)
        soft = [ndimage.gaussian_filter(x, (0, 1, 1, 0)) for x in (drawn, wanted)]
        found += [_decibels(*pair, counted) for pair in ((drawn, wanted), (soft[0], soft[1]))]
    found += [np.nan] * (2 * (len(JUDGED_DEGREES) - len(trial.judged)))
    picture = np.clip(np.asarray(render(splats, [trial.view.camera]).colors[0]), 0, 1)
    return [*found, _decibels(picture, trial.view.edited, ndimage.binary_dilation(trial.view.mask, iterations=3))]


def _decibels(picture: np.ndarray, wanted: np.ndarray, counted: np.ndarray) -> float:
    if counted.sum() <= 40:
        return np.nan
    return float(-10 * np.log10(max(float(np.square(picture - wanted)[counted].mean()), 1e-9)))


def _table(network: Correction, held: Iterator[Trial]) -> str:
    """Means of the lift, and what else differs by, with standard errors, for each kind."""
    found: dict[str, dict[str, list[list[float]]]] = defaultdict(lambda: defaultdict(list))
    for trial in held:
        for name, splats in answers(network, trial):
            found[trial.kind][name].append(_scores(trial, splats))
    columns = [f"{what}{degrees:g}" for degrees in JUDGED_DEGREES for what in ("", "soft ")] + ["edited"]
    rows = []
    for kind, names in sorted(found.items()):
        lift = np.array(names.pop("the lift"))
        rows.append({"": f"{kind} ({len(lift)})", **_cells(columns, lift, "{:.2f}")})
        for name, values in names.items():
            rows.append({"": name, **_cells(columns, np.array(values) - lift, "{:+.2f} ({:.2f})")})
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
