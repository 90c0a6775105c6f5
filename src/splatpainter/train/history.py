"""How weights came to be: one short record per stage, kept in the notes of the checkpoints that build on it."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

LOG = "log.csv"
FIRST, LAST = 20, 100
"""Steps whose mean loss is recorded, at both ends of a run."""
KEPT = ("learning_rate", "batch", "perceptual", "seed", "train_encoder")
"""Keys of the recipe that a record keeps."""
KEPT_SAMPLES = ("size", "rows", "surfels", "kinds")


def of(folder: Path, notes: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Records of all stages up to the checkpoint in `folder`, which has these notes."""
    return [*notes.get("history", []), record(folder, notes)]


def record(folder: Path, notes: Mapping[str, Any]) -> dict[str, Any]:
    """{"stage", "step", "seconds", "recipe": some of it, "loss": {"first", "last"} from the log beside the folder where
    it is there, "judged" where `train judge` has noted it}. JSON values."""
    recipe = notes.get("recipe", {})
    kept = {key: recipe[key] for key in KEPT if key in recipe}
    samples = recipe.get("samples", {})
    kept["samples"] = {key: samples[key] for key in KEPT_SAMPLES if key in samples}
    found = {key: notes[key] for key in ("stage", "step", "seconds", "judged") if key in notes}
    losses = _losses(folder.parent / LOG)
    return found | {"recipe": kept} | ({"loss": losses} if losses else {})


def _losses(path: Path) -> dict[str, float] | None:
    if not path.is_file():
        return None
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    values = np.array([float(row["loss"]) for row in rows if row.get("loss") and not row.get("skipped")])
    values = values[np.isfinite(values)]
    return {"first": float(values[:FIRST].mean()), "last": float(values[-LAST:].mean())} if len(values) else None
