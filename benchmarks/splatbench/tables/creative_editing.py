"""Tab. 3: paint, stickers, lettering, photo patches and recolouring in one view of an asset.

As the paper: the edited region against the input edit, and all else before against after. Beyond it, for meshes: novel
views near the edit against the truth, where the paint is on the surface itself. A folder of splat assets serves too (as
in the paper); there the edit is known in its own picture alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench import assets, splat_cases
from splatbench import edit_design as designs
from splatbench import ground_truth as ground
from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup, safe
from splatbench.edit_design import KINDS
from splatbench.objects import drawn_lights, environments, generator, objects
from splatbench.painted_truth import Truth, changed, changes
from splatbench.scoring import compared, drawn, object_masks, scored
from splatbench.tables import Column, beside_truth, measures
from splatpainter.data import viewpoints

if TYPE_CHECKING:
    from splatbench.methods import EditResult
    from splatpainter.splats import Splats

FRAMINGS = ("close-up", "whole")
"""Of edited views, in turn."""
NEAR = (10.0, 35.0)
"""Degrees between the edited view and the novel views near it: least, most."""
ORACLE_NEAR, ORACLE_AROUND = 6, 6
"""True edited views for methods that are upper bounds: beside the edited view, and of the whole object."""
WIDE = (5.0, 45.0)
"""Degrees between the edited view and the first of these."""
TRIES = 3
"""Edits that are shown in full before an object is given up."""
EDITED, OUTSIDE, NOVEL, ROWS = "Edited region", "Non-edited region", "Novel views of the edit", "Rows"


class Creative:
    """See the module; one case per object, with one edited view."""

    name = "creative"
    title = "Creative editing: painted, stickered, lettered and recoloured views (Tab. 3)"
    columns = (
        *measures(EDITED),
        *measures(OUTSIDE, "_outside"),
        *measures(NOVEL, "_novel"),
        Column("touched", "touched", ROWS, "", 0),
        Column("appended", "appended", ROWS, "", 0),
        Column("equal", "bitwise equal, %", ROWS, "higher"),
    )
    split_by = ""

    def keys(self, setup: Setup) -> list[CaseKey]:
        splats = splat_cases.is_splat_folder(setup.data)
        names = splat_cases.names(setup) if splats else objects(setup).names
        lights = () if splats else environments(setup).names
        keys = []
        for k, name in enumerate(names):
            settings: dict[str, Any] = {"kind": KINDS[k % len(KINDS)], "framing": FRAMINGS[k % len(FRAMINGS)]}
            if not splats:
                settings["light"] = drawn_lights(lights, name, 1, setup.seed)[0]
            keys.append(CaseKey(f"{safe(name)}-{settings['kind']}", name, settings))
        return keys

    def make(self, key: CaseKey, setup: Setup) -> Case:
        return _of_mesh(key, setup) if "light" in key.settings else _of_splats(key, setup)

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        step, last = case.steps[-1], results[-1]
        found = scored(last.splats, step.edited, step.masks, perceptual)
        novel = changes(case.before.colors, case.after.colors)
        # What an edit may not change: views of it, and around the object where the truth says what it changed there.
        cameras = [*step.edited.cameras, *case.after.cameras]
        was = drawn(case.asset, cameras)
        outside = object_masks(PosedImages(tuple(cameras), was)) & ~np.concatenate([step.masks, novel])
        kept = compared(drawn(last.splats, cameras), was, outside, perceptual) if outside.any() else {}
        near = scored(last.splats, case.after.take(case.near), novel[case.near], perceptual)
        for name in ("psnr", "ssim", "lpips"):
            found |= {f"{name}_outside": kept.get(name), f"{name}_novel": near[name]}
        return found | rows(case.asset, last)

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        edited = case.steps[-1].edited.take([0])
        first = drawn(results[-1].splats, edited.cameras)[0]
        place = case.most_changed_view if case.near.any() else None
        if place is None:
            return {"result": first, "truth": edited.colors[0]}
        return beside_truth(case, results, place) | {"edited view": first}


def protocol() -> Creative:
    return Creative()


def rows(asset: Splats, results: EditResult) -> dict[str, float | None]:
    """{"touched": rows of the asset whose bits changed, "appended", "equal": per cent}; None for a new asset."""
    from splatbench import methods

    if not results.keeps_rows:
        return {"touched": None, "appended": None, "equal": None}
    count = int(methods.changed(asset, results.splats).sum())
    share = 100 * (1 - count / len(asset))
    return {"touched": float(count), "appended": float(len(results.splats) - len(asset)), "equal": share}


def _of_mesh(key: CaseKey, setup: Setup) -> Case:
    what = ground.subject(key.name, objects(setup).load(key.name), setup)
    light = environments(setup).load(key.settings["light"])
    truth, optics = Truth(what, light, setup), ground.optics(setup)
    rng = generator(setup.seed, "creative", key.name)
    ring = viewpoints.ring(what.radius, optics, setup.base_views, rng)
    base = truth.show(ring, "base")
    rough, files, near = truth.rough(), designs.stock(setup), (setup.novel_views + 1) // 2
    for _ in range(TRIES):
        paint, spot = designs.design(rough, base, key.settings["kind"], key.settings["framing"], files, rng)
        painted = truth.painted(paint)
        novel = designs.beside(truth, paint.camera, spot, near, NEAR, rng)
        novel += viewpoints.ring(what.radius, optics, setup.novel_views - near, rng)
        before, after = (t.show([paint.camera, *novel], "novel") for t in (truth, painted))
        masks = changed(before, after)[:1]
        if designs.shows(before.pictures.colors[0], after.pictures.colors[0], masks[0], 0.5):
            break
    else:
        raise ValueError(
            f"{key.name}: {TRIES} choices of a {key.settings['kind']} edit could not be seen in this light"
        )
    rest = range(1, 1 + len(novel))
    oracle = designs.beside(truth, paint.camera, spot, ORACLE_NEAR, WIDE, rng)
    oracle += viewpoints.ring(what.radius, optics, ORACLE_AROUND, rng)
    built = assets.build(what, light, base, setup)
    facts = {"asset": built.how, "light": light.name, "truth of the edit": "paint on the surface"}
    return Case(
        protocol="creative",
        name=key.name,
        label=key.label,
        asset=built.splats,
        base=base.pictures,
        steps=(EditStep("local", paint.kind, after.pictures.take([0]), masks),),
        before=before.pictures.take(rest),
        after=after.pictures.take(rest),
        near=np.arange(len(novel)) < near,
        true_views=painted.show(oracle, "oracle").pictures,
        setup_seconds=built.seconds,
        facts={**ground.told(setup), **facts, **_told(key, masks)},
    )


def _of_splats(key: CaseKey, setup: Setup) -> Case:
    what, optics = splat_cases.load(key.name, setup), ground.optics(setup)
    rng = generator(setup.seed, "creative", key.name)
    ring = viewpoints.ring(what.radius, optics, setup.base_views, rng)
    base = what.show([what.placed(camera) for camera in ring])
    kind, framing = key.settings["kind"], key.settings["framing"]
    made = splat_cases.painted_view(what, base, kind, framing, optics, designs.stock(setup), rng)
    none = PosedImages((), np.zeros((0, setup.size, setup.size, 3), np.float32))
    edited = PosedImages((made.paint.camera,), made.picture[None])
    return Case(
        protocol="creative",
        name=key.name,
        label=key.label,
        asset=what.splats,
        base=base.pictures,
        steps=(EditStep("local", kind, edited, made.mask[None]),),
        before=none,
        after=none,
        near=np.zeros(0, bool),
        facts={
            "truth": "asset",
            "size": setup.size,
            "asset": f"as the file has it, {len(what.splats)} rows",
            "truth of the edit": "its picture alone",
            **_told(key, made.mask[None]),
        },
    )


def _told(key: CaseKey, masks: np.ndarray) -> dict[str, Any]:
    share = round(float(masks.mean()), 4)
    return {
        "kind": key.settings["kind"],
        "framing": key.settings["framing"],
        "views": len(masks),
        "edited share": share,
    }
