"""What carries a painted picture to the Gaussians under it: memories of the local network at equal cost, side by side.

Run: python scripts/local_carriers.py DATA OUT [--seconds 20] [--seeds 3] [--captures FILE ...]

DATA: a folder with meshes/, hdris/, decals/, fonts/, textures/. Every carrier trains for the same CPU seconds on the
edits that `train rows --recipe paint` draws, with its rates, from the same order, once for each seed of weights and
order; the edits that this command validates with, of held-out objects, are judged: PSNR in dB of the network alone, in
the paint of the edited view, of novel views near it, and of Gaussians that changed. Captures are painted close up as
`bench lift` does, and seen from beside against the paint moved there by the surface's depth. What OUT holds of a
carrier and seed is not trained again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from splatbench.closeups import closeup
from splatbench.local_edits import BACKGROUND, CloseupViews, LiftBench, novel_scores, painted_edit

from splatpainter import io
from splatpainter.color import base_color
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.edits import LiftedEdit
from splatpainter.models.local_edit_colors import network_colors, with_colors
from splatpainter.models.local_network import LocalNetwork
from splatpainter.painting.asset import Asset
from splatpainter.painting.edit_methods import lift_locally
from splatpainter.painting.edit_settings import EditSettings
from splatpainter.painting.prepared_views import prepared_views
from splatpainter.splats import Splats
from splatpainter.system.atomic import write_text
from splatpainter.text_tables import markdown
from splattrain import recipes
from splattrain.data.object_sources import HELD_OUT_SHARE
from splattrain.data.painted_gaussians import PaintedEdit
from splattrain.optim import Average, adamw, rate_at
from splattrain.stages.painted_gaussians_task import OtherPicture, PaintedGaussiansTask, picture_scores, row_decibels
from splattrain.training_data import DataSettings, ResourceFolders, painted_gaussian_streams

CARRIERS: dict[str, dict[str, Any]] = {
    "TTT, Muon, 1 step": {},
    "TTT, Muon, 5 steps": {"inner_steps": 5},
    "TTT, plain gradient": {"newton_schulz_steps": 0},
    "ridge (Mesa)": {"mixer": "ridge"},
    "cross-attention": {"mixer": "cross_attention"},
}
"""Carrier -> what differs from the recipe's network (RefineConfig)."""
RATE_STEPS = 1000
"""Into which the budget is divided for the learning rate's course."""
REFERENCES = ("nothing", "lift")
FIGURES = ("edited", "novel", "rows")
ON_CAPTURES = ("captures edited", "captures beside")
CAPTURE_PX = 256
"""Edge of the pictures of captures."""


@dataclass(frozen=True)
class Options:
    """Train and judge every carrier of a painted picture."""

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DATA")]
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    captures: tuple[Path, ...] = ()
    """Splat files to paint on besides."""
    seconds: float = 20.0
    """CPU seconds of training for each carrier and seed."""
    seeds: int = 3
    assets: Path | None = None
    """Folder of drawn edits (`train rows --assets`); default: OUT/edits."""
    carriers: tuple[str, ...] = tuple(CARRIERS)


def main(options: Options) -> str:
    """Markdown of the means, also in OUT/carriers.md."""
    torch.set_num_threads(1)
    recipe, folders = recipes.load("paint", "rows"), options.data
    resources = ResourceFolders(*(folders / name for name in ("hdris", "decals", "fonts", "textures")))
    settings = DataSettings(str(folders / "meshes"), recipe.samples, recipe.seed, HELD_OUT_SHARE, resources)
    training, held = painted_gaussian_streams(settings, options.assets or options.out / "edits", recipe.edits)
    assert held is not None
    captures = [Capture.of(path) for path in options.captures]
    judged = list(_first(held.full_edit, recipe.validation_samples))
    usable = [edit for edit in map(partial(_tried, training), range(recipe.edits)) if edit is not None]
    options.out.mkdir(parents=True, exist_ok=True)
    for seed in range(options.seeds):
        for name in options.carriers:
            path = options.out / f"{name.replace(', ', '-').replace(' ', '-')}-{seed}.json"
            if not path.is_file():
                write_text(path, json.dumps(_trained(name, seed, options.seconds, recipe, usable, judged, captures)))
            print(path.name, path.read_text(encoding="utf-8"), flush=True)
    results = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(options.out.glob("*.json"))]
    table = _table([*_references(judged, captures), *results])
    write_text(options.out / "carriers.md", table)
    return table


def _first(make: Any, count: int) -> Iterator[PaintedEdit]:
    """The first edits that can be made, as `train rows` takes them."""
    number = done = 0
    while done < count:
        try:
            yield make(number)
            done += 1
        except ValueError:
            pass
        number += 1


def _tried(stream: Any, number: int) -> Any:
    try:
        return stream[number]
    except ValueError:
        return None


@dataclass(frozen=True)
class Capture:
    """A painted close-up of an asset that has no truth."""

    asset: Splats
    view: EditView
    lifted: LiftedEdit
    scored: Any
    """Edited asset -> PSNR (in the edited view, in the views beside)."""

    @staticmethod
    def of(path: Path) -> Capture:
        source, config = io.read(path).numpy(), LiftBench(size=CAPTURE_PX)
        seen = closeup(source, CAPTURE_PX, BACKGROUND)
        before = CloseupViews(source, seen)
        edit, layers = painted_edit(before, config)
        asset = Asset(source)
        (view,) = prepared_views(asset, [edit], "local", partly=True)
        lifted = lift_locally(asset, [view], EditSettings())

        def scored(splats: Splats) -> tuple[float, float]:
            after = CloseupViews(splats, seen)
            squared = np.square(after.images[0] - edit.image)[view.mask].mean()
            inside, _ = novel_scores(source, layers, before, after)
            return float(-10 * np.log10(squared)), float(np.mean(inside))

        return Capture(source, view, lifted, scored)


def _trained(
    name: str,
    seed: int,
    seconds: float,
    recipe: Any,
    usable: Sequence[Any],
    judged: Sequence[PaintedEdit],
    captures: Sequence[Capture],
) -> Any:
    """Figures of a carrier before and after its training."""
    torch.manual_seed(seed)
    network = LocalNetwork(replace(recipe.local, refine=replace(recipe.local.refine, **CARRIERS[name])))
    task = PaintedGaussiansTask(network, recipe.readers)
    ask = partial(scores, judged=judged, captures=())
    result: dict[str, Any] = {"carrier": name, "seed": seed, "untrained": ask(network)}
    parameters = [(key, weight) for key, weight in task.named_parameters() if weight.requires_grad]
    optimizer, average = (
        adamw(parameters, recipe.learning_rate, recipe.weight_decay),
        Average.of(parameters, recipe.average),
    )
    order, spent, steps = np.random.default_rng(seed), 0.0, 0
    while spent < seconds:
        sample = usable[int(order.integers(len(usable)))]
        begun = time.process_time()
        rate = rate_at(int(spent / seconds * RATE_STEPS), recipe.learning_rate, 100, RATE_STEPS, recipe.final_rate)
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.zero_grad(set_to_none=True)
        task.losses(sample, steps)["loss"].backward()
        torch.nn.utils.clip_grad_norm_([weight for _, weight in parameters], recipe.clip)
        optimizer.step()
        average.update(parameters, steps)
        steps += 1
        spent += time.process_time() - begun
    with average.used_by(task):
        result |= {
            "steps": steps,
            "seconds": round(spent, 1),
            "trained": ask(network.eval(), captures=[] if seed else captures),
        }
        if not seed and network.config.refine.mixer != "cross_attention":  # which has no strength
            result["strength 0"] = ask(network, strength=0.0)
        if not seed:  # one of them says it, and asking takes as long as training
            result["another picture"] = ask(OtherPicture(network))  # type: ignore[arg-type]
    return result


def scores(
    network: LocalNetwork, judged: Sequence[PaintedEdit], captures: Sequence[Capture], strength: float | None = None
) -> dict[str, float]:
    """Means over the edits of the network alone."""
    found: dict[str, list[float]] = {figure: [] for figure in FIGURES}
    for sample in judged:
        answer = network_colors(network, sample.painted.asset, sample.lifted, [sample.view], strength)
        edited, novel, _ = picture_scores(sample, with_colors(sample.lifted, answer))
        for figure, value in zip(FIGURES, (edited, novel, row_decibels(sample, answer.colors)), strict=True):
            if value is not None:
                found[figure].append(value)
    means = {figure: float(np.mean(values)) for figure, values in found.items()}
    if captures:
        answers = [network_colors(network, one.asset, one.lifted, [one.view], strength) for one in captures]
        pairs = [one.scored(with_colors(one.lifted, a).splats) for one, a in zip(captures, answers, strict=True)]
        means |= dict(zip(ON_CAPTURES, np.mean(pairs, 0).tolist(), strict=True))
    return means


def _references(judged: Sequence[PaintedEdit], captures: Sequence[Capture]) -> list[dict[str, Any]]:
    """What needs no memory: nothing done, and the lift."""
    found = []
    for name in REFERENCES:
        figures: dict[str, list[float]] = {}
        for sample in judged:
            lifted = sample.lifted if name == "lift" else replace(sample.lifted, splats=sample.painted.asset)
            colors = base_color((lifted.splats if name == "lift" else lifted.splats.take(lifted.parents)).sh)
            colors = colors[sample.lifted.ids] if name == "lift" else colors
            edited, novel, _ = picture_scores(sample, lifted)
            for figure, value in zip(FIGURES, (edited, novel, row_decibels(sample, colors)), strict=True):
                figures.setdefault(figure, []).extend([] if value is None else [value])
        means = {figure: float(np.mean(values)) for figure, values in figures.items()}
        if captures:
            pairs = [one.scored(one.lifted.splats if name == "lift" else one.asset) for one in captures]
            means |= dict(zip(ON_CAPTURES, np.mean(pairs, 0).tolist(), strict=True))
        found.append({"carrier": name, "untrained": means})
    return found


def _table(results: Sequence[dict[str, Any]]) -> str:
    """One row per carrier and what was asked of it: mean over seeds, and the least and the largest."""
    rows = []
    for name in (*REFERENCES, *CARRIERS):
        of = [result for result in results if result["carrier"] == name]
        for what in ("untrained", "trained", "strength 0", "another picture"):
            values = [result[what] for result in of if what in result]
            if not values:
                continue
            cells = {f: [value[f] for value in values if f in value] for f in (*FIGURES, *ON_CAPTURES)}
            steps = f"{np.mean([r['steps'] for r in of]):.0f}" if what == "trained" else ""
            shown = {figure: _spread(numbers) for figure, numbers in cells.items()}
            rows.append({"carrier": name if what == "untrained" else f"... {what}", "steps": steps, **shown})
    return markdown(rows)


def _spread(numbers: Sequence[float]) -> str:
    """Mean, and the least and the largest where there are several."""
    between = f" ({min(numbers):.2f} to {max(numbers):.2f})" if len(numbers) > 1 else ""
    return f"{np.mean(numbers):.2f}{between}" if numbers else "–"


if __name__ == "__main__":
    print(main(tyro.cli(Options, description=Options.__doc__)))
