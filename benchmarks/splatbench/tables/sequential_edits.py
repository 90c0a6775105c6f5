"""Edits in a row (the paper's figures on iterative updates and on conflicting inputs, as a table).

Part "views": one edit in 1 to 4 views, one after another (paint, close-ups, another light in turn); novel views after
each. Part "edits": up to 10 different edits; what is left of the earlier ones. Part "conflict": two views paint one
region differently, and the later one must win.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench import sequences
from splatbench.cases import Case, CaseKey, Setup, safe
from splatbench.edit_design import KINDS
from splatbench.objects import drawn_lights, environments, objects
from splatbench.painted_truth import changes
from splatbench.scoring import compared, drawn, object_masks, scored
from splatbench.tables import Column, beside_truth

if TYPE_CHECKING:
    from splatbench.methods import EditResult

PARTS = ("views", "edits", "conflict")
EDITS = ("paint", "zoom", "relight")
"""Of part "views", in turn."""
MOST_VIEWS, MOST_EDITS = 4, 10
SMALL = 128
"""Pixels: up to here fewer steps are asked, for a quick look."""
SMALL_VIEWS, SMALL_EDITS = 3, 3
ROW, CONFLICT = "Steps in a row, PSNR", "Conflicts, PSNR"


class InARow:
    """See the module; a case of each part per object."""

    name = "sequence"
    title = "Edits in a row: more views, further edits, conflicts"
    columns = (
        Column("first", "after the first", ROW, "higher"),
        Column("last", "after the last", ROW, "higher"),
        Column("forgetting", "lost of earlier edits", ROW, "lower"),
        Column("later", "later view", CONFLICT, "higher"),
        Column("new", "earlier view, later edit", CONFLICT, "higher"),
        Column("old", "earlier view, earlier edit", CONFLICT, "lower"),
        Column("winner", "later wins, %", CONFLICT, "higher", 0),
    )
    split_by = "part"

    def keys(self, setup: Setup) -> list[CaseKey]:
        lights = environments(setup).names
        small = setup.size <= SMALL
        keys = []
        for k, name in enumerate(objects(setup).names):
            own = drawn_lights(lights, name, 2, setup.seed)
            edit = EDITS[k % len(EDITS)]
            if edit == "relight" and len(own) < 2:
                edit = EDITS[0]
            told: dict[str, dict[str, Any]] = {
                "views": {"edit": edit, "kind": KINDS[k % len(KINDS)], "count": SMALL_VIEWS if small else MOST_VIEWS},
                "edits": {"count": SMALL_EDITS if small else MOST_EDITS},
                "conflict": {"count": 2},
            }
            if edit == "relight":
                told["views"]["target"] = own[1]
            for part in PARTS:
                settings = {"part": part, "light": own[0], **told[part]}
                keys.append(CaseKey(f"{safe(name)}-{part}", name, settings))
        return keys

    def make(self, key: CaseKey, setup: Setup) -> Case:
        at, count = sequences.scene(key, setup), key.settings["count"]
        if key.settings["part"] == "edits":
            return sequences.different_edits(at, count)
        if key.settings["part"] == "conflict":
            return sequences.conflict(at)
        ways = {"paint": sequences.painted_views, "zoom": sequences.zoomed_views, "relight": sequences.relit_views}
        return ways[key.settings["edit"]](at, count)

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        ways = {"views": _views, "edits": _edits, "conflict": _conflict}
        found: dict[str, float | None] = {column.key: None for column in self.columns}
        return found | ways[case.facts["part"]](case, results, perceptual)

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        last = results[-1].splats
        if case.facts["part"] == "conflict":
            earlier = drawn(last, case.after.take([0]).cameras)[0]
            return {"result": earlier, "truth": case.after.colors[0], "first edit": case.steps[0].edited.colors[0]}
        place = case.most_changed_view
        assert place is not None  # every part has novel views
        camera = case.after.cameras[place]
        earlier = {f"step {k + 1}": drawn(d.splats, [camera])[0] for k, d in enumerate(results[:-1])}
        return beside_truth(case, results, place) | earlier


def protocol() -> InARow:
    return InARow()


def _views(case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
    """psnr_k, ssim_k, lpips_k after k views: novel views near the edit, where it changed the object (of close-ups: the
    object there); of another light, the whole object in all of them."""
    if case.facts["edit"] == "relight":
        chosen = np.ones(len(case.after), bool)
        masks = object_masks(case.after)
    else:
        chosen = case.near
        zoom = case.facts["edit"] == "zoom"
        masks = object_masks(case.after) if zoom else changes(case.before.colors, case.after.colors)
    found: dict[str, float | None] = {}
    for k, each in enumerate(results, 1):
        figures = scored(each.splats, case.after.take(chosen), masks[chosen], perceptual)
        found |= {f"{name}_{k}": value for name, value in figures.items()}
    return found | {"first": found.get("psnr_1"), "last": found.get(f"psnr_{len(results)}")}


def _edits(case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
    """fresh_k: PSNR of edit k in its own view right after it, where later edits leave it alone; end_k: after the last;
    psnr_k: mean over the edits so far, after k of them. forgetting: mean of fresh - end of all but the last, dB."""
    edited = sequences.joined([step.edited for step in case.steps])
    masks = np.concatenate([step.masks for step in case.steps])
    count = len(case.steps)
    masks &= np.logical_not(changes(edited.colors, case.after.colors[:count]))
    told = np.full((count, count), np.nan)  # [after, edit]
    for k, each in enumerate(results):
        made = drawn(each.splats, edited.cameras[: k + 1])
        for j in range(k + 1):
            value = compared(made[j : j + 1], edited.colors[j : j + 1], masks[j : j + 1], None)["psnr"]
            told[k, j] = np.nan if value is None else value
    found: dict[str, float | None] = {}
    for k in range(count):
        found |= {f"fresh_{k + 1}": _mean(told[k, k]), f"end_{k + 1}": _mean(told[-1, k])}
        found[f"psnr_{k + 1}"] = _mean(told[k, : k + 1])
    lost = np.diagonal(told)[:-1] - told[-1, :-1]
    return found | {"first": found["psnr_1"], "last": found[f"psnr_{count}"], "forgetting": _mean(lost)}


def _conflict(case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
    """later: the second view, where its edit is. new and old: the first view where both edits painted it, against the
    truth after the second and against the first picture. winner: 100 where the render is nearer to the truth after the
    second than to the first picture and to the unedited object, else 0."""
    first, second = case.steps
    last = results[-1].splats
    truth = case.after.take([0])
    both = first.masks & changes(first.edited.colors, truth.colors)
    later = scored(last, second.edited, second.masks, perceptual)
    versions = (truth, first.edited, case.before.take([0]))
    new, old, plain = (scored(last, pictures, both, None)["psnr"] for pictures in versions)
    winner = None if new is None or old is None or plain is None else 100.0 * (new > max(old, plain))
    fresh = scored(results[0].splats, first.edited, first.masks, None)["psnr"]
    found = {"later": later["psnr"], "new": new, "old": old, "winner": winner, "psnr_1": fresh, "psnr_2": later["psnr"]}
    return found | {"ssim_later": later["ssim"], "lpips_later": later["lpips"]}


def _mean(values: Any) -> float | None:
    known = np.atleast_1d(values)
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) else None
