"""The card of the weights that ship (docs/MODEL_CARD.md), or that of one Stage II checkpoint that `train judge
--write-notes` has judged: fixed text (model_card_shipped.md, model_card_sources.md), figures from the notes beside the
weights.

Run: python scripts/model_card.py > docs/MODEL_CARD.md
     python scripts/model_card.py runs/refine/model
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import tyro

from splatpainter.models import checkpoint, weights
from splatpainter.models.config import ModelConfig
from splattrain import state
from splattrain.judge import CopyRow, EditRow, from_json, goals, table, weak_kinds

SHIPPED = Path(__file__).with_name("model_card_shipped.md")
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
    """Print the model card of the weights that ship, or of a judged Stage II checkpoint."""

    checkpoint: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="CHECKPOINT")] = None
    """Folder of weights; none: those of the packages."""
    earlier: tuple[Path, ...] = ()
    """Weights of the stages before, first one first; default: what the checkpoint's notes say of them."""
    hardware: str = "two CPU cores, no GPU"
    """What it was trained on, in words."""


def main(options: Options) -> str:
    """The card as text. Raises ValueError for weights that have not been judged."""
    if options.checkpoint is None:
        return _script("wrap_docs").wrapped(shipped_card())
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


def shipped_card() -> str:
    """Markdown of the presets that the packages hold. Raises ValueError for weights that have not been judged."""
    folders = {name: weights.PACKAGED / name for name in ("compact", "rows", "local")}
    notes = {name: checkpoint.notes(folder) for name, folder in folders.items()}
    for name, of in notes.items():
        if "judged" not in of:
            raise ValueError(f"model card: '{name}' has not been judged; run train judge {folders[name]} --write-notes")
    predictor, rows, local = (_edit_rows(notes[name]["judged"]) for name in ("compact", "rows", "local"))
    # Preset rows is compact without its predictor: what was noted of their one run lies beside compact.
    figures = {"rows": notes["compact"]["validation"]["all"], "local": notes["local"]["validation"]["all"]}
    last = [state.record(folders[name], notes[name]) for name in ("compact", "local")]
    history = [*notes["compact"].get("history", []), *last]
    recipe = {"rows": notes["compact"]["recipe"], "local": notes["local"]["recipe"]}
    judged = notes["rows"]["judged"]
    if (
        judged["samples"] != notes["compact"]["judged"]["samples"]
        or judged["seed"] != notes["compact"]["judged"]["seed"]
    ):
        raise ValueError("model card: 'compact' and 'rows' were judged on other samples; judge both alike")
    core, networks = (sum(_shard_bytes(folder, apart) for folder in folders.values()) for apart in (True, False))
    everywhere = [row for row in rows.values() if row.kind not in ("local", "global")]
    behind = [_kind(row) for row in everywhere if row.gain < 0]
    shown = {name: figures["rows"][name] for name in ("nothing", "lift", "ours", "strength 0")}
    values = {
        "core_mb": f"{core / 1e6:.1f}",
        "networks_mb": f"{networks / 1e6:.1f}",
        "sizes": _sizes(folders),
        "predictor_gain": _gain(predictor["global", None]),
        "predictor_gain_one": _gain(predictor["relight", 1]),
        "predictor_note": f"{notes['compact']['gain']['global']:+.2f}",
        "rows_gain": f"at {_gain(rows['global', None])} against the lift",
        "local_gain": _gain(local["local", None]),
        "training": judged["objects"]["training"],
        "validation": judged["objects"]["validation"],
        "sources": SOURCES.read_text(encoding="utf-8").strip(),
        "trained": _training_table(history),
        "kinds": "; ".join(f"{'Stage II' if n == 'rows' else 'local network'} {_shares(r)}" for n, r in recipe.items()),
        "samples": judged["samples"],
        "judged_objects": judged["judged_objects"],
        "size": judged["size"],
        "seed": judged["seed"],
        "global_table": _global_table(rows, predictor),
        "rows_samples": recipe["rows"]["validation_samples"],
        "rows_validation": ", ".join(f"{SAID.get(name, name)} {value:.2f} dB" for name, value in shown.items()),
        "local_samples": recipe["local"]["validation_samples"],
        "local_px": recipe["local"]["samples"]["size"],
        "local_table": _local_table(figures["local"]),
        "local_judged": notes["local"]["judged"]["samples"],
        "local_judged_objects": notes["local"]["judged"]["judged_objects"],
        "local_ours": f"{local['local', None].ours:.2f}",
        "local_lift": f"{local['local', None].lift:.2f}",
        "local_note": f"{notes['local']['gain']['local']:+.2f}",
        "rows_weak": f" and below the lift in {', '.join(behind)}" if behind else "",
        "rows_count": f"{recipe['rows']['samples']['rows']:,}",
        "steps": f"{sum(stage['step'] for stage in history):,}",
    }
    return SHIPPED.read_text(encoding="utf-8").format_map(values)


SAID = {"ours": "Stage II", "lift": "the lift's regression"}
"""Figures of a validation, as people call them."""
LOCAL_ROWS = {
    "nothing": "nothing",
    "mean color": "the paint's mean colour",
    "ours": "the network alone",
    "strength 0": "... edit strength 0",
    "another picture": "... another picture's memory",
    "held": "the network, held against the picture",
    "lift": "the lift",
}
"""Figures of the local network's validation -> rows of its table."""


def _edit_rows(judged: Mapping[str, Any]) -> dict[tuple[str, int | None], EditRow]:
    """(kind, number of views) -> its row."""
    rows = from_json(judged["rows"])
    return {(row.kind, row.views): row for row in rows if not isinstance(row, CopyRow)}


def _shard_bytes(folder: Path, with_core: bool) -> int:
    """Bytes of the weights of a packaged preset that lie with the core, or in the distribution of the networks."""
    paths = [checkpoint._shard_path(folder, shard["file"]) for shard in checkpoint._index(folder)["shards"]]
    return sum(path.stat().st_size for path in paths if (path.parent == folder) == with_core)


def _sizes(folders: Mapping[str, Path]) -> str:
    """Millions of weights of each network."""
    counts: dict[str, int] = {}
    for name in ("compact", "local"):
        for tensor, entry in checkpoint._index(folders[name])["tensors"].items():
            part = "local network" if name == "local" else NETWORKS[tensor.split(".", 1)[0]]
            size = 1
            for edge in entry["shape"]:
                size *= edge
            counts[part] = counts.get(part, 0) + size
    return ", ".join(f"{part} {count / 1e6:.2f}" for part, count in counts.items())


def _gain(row: EditRow) -> str:
    between = "" if row.gain_low is None else f" ({row.gain_low:+.2f} to {row.gain_high:+.2f})"
    return f"{row.gain:+.2f} dB{between}"


def _kind(row: EditRow) -> str:
    return row.kind if row.views is None else f"{row.kind} from {row.views} view{'s' * (row.views > 1)}"


def _shares(recipe: Mapping[str, Any]) -> str:
    kinds = {kind: weight for kind, weight in recipe["samples"]["kinds"].items() if weight > 0}
    return ", ".join(f"{kind} {100 * weight / sum(kinds.values()):.0f} %" for kind, weight in kinds.items())


def _global_table(rows: Mapping[Any, EditRow], predictor: Mapping[Any, EditRow]) -> str:
    """Both carriers of global edits side by side."""
    head = ("edit", "views", "samples", "objects", "nothing", "lift", "Stage II", "gain", "interval", "strength 0")
    head += ("predictor", "its gain")
    lines = [f"| {' | '.join(head)} |", "|---|---|" + "---:|" * (len(head) - 2)]
    for key, row in rows.items():
        other = predictor[key]
        named = "all global" if row.kind == "global" else row.kind
        cells = [named, row.views or "all", row.samples, row.objects]
        cells += [f"{row.nothing:.2f}", f"{row.lift:.2f}", f"{row.ours:.2f}", *_gain(row).rstrip(")").split(" dB (")]
        cells += [_or_dash(row.strength_zero), f"{other.ours:.2f}", f"{other.gain:+.2f}"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def _local_table(figures: Mapping[str, float]) -> str:
    """The local network's validation."""
    columns = {"edited": "edited view", "novel": "novel views", "rows": "Gaussians that changed"}
    lines = [f"| | {' | '.join(columns.values())} |", "|---|" + "---:|" * len(columns)]
    for name, label in LOCAL_ROWS.items():
        cells = [_or_dash(figures.get(f"{column} {name}")) for column in columns]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _or_dash(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _script(name: str) -> ModuleType:
    """Another script of this folder."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


def _training_table(stages: Sequence[Mapping[str, Any]]) -> str:
    """One row per stage."""
    lines = [
        "| stage | steps | hours | batch | peak rate | loss, first steps | loss, last steps |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for stage in stages:
        recipe, loss = stage.get("recipe", {}), stage.get("loss", {})
        local = recipe.get("carrier") == "pictures"
        cells = (
            "local network" if local else STAGES.get(stage.get("stage", ""), "?"),
            f"{stage.get('step', 0):,}",
            f"{stage.get('seconds', 0) / 3600:.2f}",
            recipe.get("batch", "–"),
            f"{recipe['learning_rate']:g}" if "learning_rate" in recipe else "–",
            *(f"{loss[end]:.4g}" if end in loss else "–" for end in ("first", "last")),
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def _training(stages: Sequence[Mapping[str, Any]], hardware: str) -> str:
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
            _training_table(stages),
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
