"""The model card of a Stage II checkpoint that `train judge --write-notes` has judged: fixed text about the method and
its data (model_card_sources.md), figures from the checkpoint's notes.

Run: python scripts/model_card.py runs/refine/model > docs/MODEL_CARD.md
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from splatpainter.models import checkpoint
from splatpainter.models.config import ModelConfig
from splattrain import state
from splattrain.judge import from_json, goals, table, weak_kinds

SOURCES = Path(__file__).with_name("model_card_sources.md")
OBJECTS = "Single objects, mostly furniture, tools, toys, packaging, vehicles. Few plants, creatures, people; no rooms."

STAGES = {
    "lrm": "Gaussian LRM",
    "compress": "Stage I",
    "predict": "predictor",
    "rows": "Stage II on rows",
    "refine": "Stage II",
}
NETWORKS = {
    "lrm": "Gaussian LRM",
    "compressor": "Stage I",
    "predictor": "predictor",
    "refiner": "Stage II",
    "head": "decoder",
}


@dataclass(frozen=True)
class Options:
    """Print the model card of a judged Stage II checkpoint."""

    checkpoint: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CHECKPOINT")]
    """Folder of weights."""
    earlier: tuple[Path, ...] = ()
    """Weights of the stages before, first one first; default: what the checkpoint's notes say of them."""
    hardware: str = "two CPU cores, no GPU"
    """What it was trained on, in words."""


def main(options: Options) -> str:
    """The card as text. Raises ValueError for weights that have not been judged."""
    saved = checkpoint.load(options.checkpoint)
    stages = state.history(options.checkpoint, saved.notes)
    if options.earlier:
        stages = [state.record(folder, checkpoint.load(folder).notes) for folder in options.earlier] + stages[-1:]
    weights: dict[str, int] = {}
    for name, tensor in saved.tensors.items():
        part = name.split(".", 1)[0]
        weights[part] = weights.get(part, 0) + tensor.numel()
    return card(saved.config, saved.notes, weights, stages, options.hardware)


def card(
    config: ModelConfig,
    notes: Mapping[str, Any],
    weights: Mapping[str, int],
    stages: Sequence[Mapping[str, Any]],
    hardware: str,
) -> str:
    """Markdown. notes: of a Stage II checkpoint that has been judged; weights: network -> how many; stages: records of
    all stages (train/state.py), first one first; hardware: in words. Raises ValueError for notes without figures."""
    judged = notes.get("judged")
    if not isinstance(judged, dict):
        raise ValueError("model card: these weights have not been judged; run train judge with --write-notes first")
    rows = from_json(judged["rows"])
    parts = [
        _head(config, weights),
        _use(config, notes.get("gain", {})),
        _data(judged, stages),
        _training(stages, hardware),
        _figures(judged, table(rows), goals(rows)),
        *(_earlier(stage) for stage in stages[:-1] if "judged" in stage),
        _failures(judged, stages, *weak_kinds(rows)),
        LICENCE,
    ]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def _head(config: ModelConfig, weights: Mapping[str, int]) -> str:
    sizes = ", ".join(f"{NETWORKS.get(n, n)} {count / 1e6:.1f}" for n, count in weights.items())
    base = (
        "adds its change to the analytic lift" if config.refine.base == "lift" else "changes the asset's own Gaussians"
    )
    alone = ALONE if config.predictor_only else ""
    return f"""
# Model card: {config.preset}

Weights of SplatPainter's `{config.preset}` preset: they turn edited pictures of a 3D Gaussian asset into a change of
its Gaussians, in one pass, by test-time training of small fast weights (after arXiv 2512.05354). The network {base}.
{alone}{sum(weights.values()) / 1e6:.1f} million weights in half precision (millions: {sizes}).
Representation `{config.representation}`.
"""


def _use(config: ModelConfig, gain: Mapping[str, float]) -> str:
    lines = [
        f"{mode} edits: {value:+.2f} dB over the lift, so `auto` uses {_method(value)}" for mode, value in gain.items()
    ]
    if not config.edits_locally:
        lines.append("local edits are the lift's: Stage II has learnt global ones alone")
    return f"""
## Use

`Painter.load("{config.preset}")`. Method `auto` takes the network only for the mode in which it is better than the
analytic lift on objects held out of training, and says so in the receipt; `ttt` and `lift` ask for one of them.

{_listed(lines or ["no gain was measured: `auto` uses the network"])}
"""


def _method(gain: float) -> str:
    return "the network" if gain > 0 else "the lift"


def _data(judged: Mapping[str, Any], stages: Sequence[Mapping[str, Any]]) -> str:
    train, held = judged["objects"]["training"], judged["objects"]["validation"]
    samples = stages[-1].get("recipe", {}).get("samples", {})
    rows, size = samples.get("rows", 0), samples.get("size", 0)
    kinds = {k: w for k, w in samples.get("kinds", {}).items() if w > 0}
    shares = ", ".join(f"{k} {100 * w / sum(kinds.values()):.0f} %" for k, w in kinds.items())
    sources = PROCEDURAL if _procedural(judged) else SOURCES.read_text(encoding="utf-8").strip()
    return f"""
## Data

{train} objects for training, {held} others held out (by a hash of the name; the same ones in every stage and in every
table here). Each object becomes dense surfels (the truth) and an irregular asset of about {rows:,} Gaussians under a
random light; edits and lights change the surfels' colours, and all views ({size} px) are renders of them. Nothing is
path traced.
Stage II's samples by kind: {shares}.

{sources}
"""


def _procedural(judged: Mapping[str, Any]) -> bool:
    return str(judged.get("data", "")).startswith("procedural:")


def _training(stages: Sequence[Mapping[str, Any]], hardware: str) -> str:
    lines = [
        "| stage | steps | hours | batch | peak rate | loss, first steps | loss, last steps |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for stage in stages:
        recipe, loss = stage.get("recipe", {}), stage.get("loss", {})
        cells = (
            STAGES.get(stage.get("stage", ""), "?"),
            f"{stage.get('step', 0):,}",
            f"{stage.get('seconds', 0) / 3600:.2f}",
            recipe.get("batch", "–"),
            f"{recipe['learning_rate']:g}" if "learning_rate" in recipe else "–",
            *(f"{loss[end]:.4g}" if end in loss else "–" for end in ("first", "last")),
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    seconds = sum(stage.get("seconds", 0) for stage in stages)
    return "\n".join(
        [
            "## Training",
            "",
            f"Hardware: {hardware}; {seconds / 3600:.1f} hours in all. AdamW, cosine rate with warm-up, mean of the",
            "weights; see docs/TRAINING.md. Losses are means over the first 20 and the last 100 steps; stages minimise",
            "different things, so compare them within a row only. (The paper: 80,000 steps of Stage I and 200,000 of",
            "Stage II at 512 px on 16 GPUs.)",
            "",
            *lines,
        ]
    )


def _figures(judged: Mapping[str, Any], rows: str, reached: Sequence[str]) -> str:
    return f"""
## Figures

On held-out objects only: {judged["samples"]} samples of {judged["judged_objects"]} objects, {judged["size"]} px, seed
{judged["seed"]}; {judged["skipped"]} could not be used. PSNR in dB on novel views: of local edits on views near it,
where it changes the object; of global ones on the whole object. `nothing` is the asset as it was, `gain` the mean of
ours - lift, the interval the middle 95 % of a bootstrap over objects. SSIM (higher is better) and LPIPS-Alex (lower is
better): nothing / lift / ours. Relighting is the same samples with some of their edited views.

{rows}

What was wanted, and what came:

{_listed(reached or ["nothing that the table says anything about"])}
"""


def _earlier(stage: Mapping[str, Any]) -> str:
    return f"""
### {STAGES.get(stage["stage"], "earlier stage")}, before the next one was trained

{table(from_json(stage["judged"]["rows"]))}
"""


def _failures(
    judged: Mapping[str, Any], stages: Sequence[Mapping[str, Any]], below: Sequence[str], unsure: Sequence[str]
) -> str:
    steps = sum(stage.get("step", 0) for stage in stages)
    objects = [] if _procedural(judged) else [OBJECTS]
    few = [f"Below the lift in the table: {', '.join(below)}."] if below else []
    few += [f"Above the lift, but with an interval that holds 0: {', '.join(unsure)}."] if unsure else []
    return f"""
## Known failures

{_listed([*few, f"Trained for {steps:,} steps in all, the paper's models for 280,000. {SHORT}", *objects, *FAILURES])}
"""


def _listed(lines: Sequence[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


ALONE = """\
Global edits are a second, small network's alone: it describes every Gaussian, and an edit solves a ridge regression on
these descriptions exactly, in place of the lift's fixed ones: what a picture says about sides that it does not show.
They need no encoding.
"""
SHORT = "More steps, larger pictures and more objects are the first things to try."
FAILURES = (
    "Small pictures, small assets: larger ones are accepted, but none was trained on (sizes above).",
    "Captures, with fog, floaters and baked-in light, were neither trained on nor measured: every asset is a mesh's.",
    "Relighting from one view: sides that it does not show are guessed from colours, normals and what light can reach.",
    "The truth is shaded surfels: soft shadows, one blurred highlight; no mirrors, no glass, no light between parts.",
    "The network adds no Gaussians of its own: detail finer than the asset comes from the lift's splitting alone.",
    "Edits that contradict each other in different views: the later view is meant to win; borders can blur.",
)
PROCEDURAL = "All objects are procedural (composed primitives with made-up textures); no one else's data was used."
LICENCE = """
## Licence

Apache-2.0, as the code. The data keeps its own licences (above); none of it is part of the package.
"""


if __name__ == "__main__":
    print(main(tyro.cli(Options)), end="")
