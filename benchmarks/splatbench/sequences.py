"""Cases with several steps: one edit in more and more views, different edits one after another, and two that conflict.

A table's protocol scores them (protocols/sequence.py). Every step has one view. Knows no method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench import assets
from splatbench import edit_design as designs
from splatbench import ground_truth as ground
from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup
from splatbench.edit_design import KINDS, SMALLEST, Spot
from splatbench.objects import environments, generator, objects
from splatbench.painted_truth import Paint, Truth, changed
from splatpainter.cameras import Camera
from splatpainter.data import viewpoints

if TYPE_CHECKING:
    from splatbench.ground_truth import Shown
    from splatpainter.data.edits.layers import EditResources

NEAR = (10.0, 35.0)
"""Degrees between an edited view and the further views of the edit, and the novel views near it: least, most."""
CONFLICT = (5.0, 30.0)
"""Degrees between two views that conflict."""
OVERLAP = 0.2
"""Least part of the smaller of two edits that conflict which the other one covers."""
APART = (0.4, 0.2, 0.0)
"""Least distance between different edits, in radii of the object: the first of these that can be had."""
TRIES = 6
LIGHTLY = 0.25
"""Times the standards of designs.py: what an edit must still show where it was made."""


@dataclass(frozen=True)
class Scene:
    """An object that is about to be edited."""

    key: CaseKey
    setup: Setup
    truth: Truth
    base: Shown = field(repr=False)
    rng: np.random.Generator
    files: EditResources = field(repr=False)

    @property
    def optics(self) -> viewpoints.Optics:
        return ground.optics(self.setup)

    def near_and_around(self, view: Camera, spot: Spot) -> tuple[list[Camera], np.ndarray]:
        """(novel views, [W] bool near): beside an edited view first, then of the whole object."""
        count, near = self.setup.novel_views, (self.setup.novel_views + 1) // 2
        novel = designs.beside(self.truth, view, spot, near, NEAR, self.rng)
        novel += viewpoints.ring(self.truth.subject.radius, self.optics, count - near, self.rng)
        return novel, np.arange(count) < near

    def case(
        self, steps: Sequence[EditStep], before: PosedImages, after: PosedImages, near: np.ndarray, **facts: Any
    ) -> Case:
        built = assets.build(self.truth.subject, self.truth.light, self.base, self.setup)
        told = {**ground.told(self.setup), "asset": built.how, "light": self.truth.light.name, "steps": len(steps)}
        return Case(
            protocol="sequence",
            name=self.key.name,
            label=self.key.label,
            asset=built.splats,
            base=self.base.pictures,
            steps=tuple(steps),
            before=before,
            after=after,
            near=near,
            setup_seconds=built.seconds,
            facts={**told, "part": self.key.settings["part"], **facts},
        )

    def fail(self, what: str) -> ValueError:
        return ValueError(f"{self.key.name}: {TRIES} choices of {what} changed nothing that can be seen")


def scene(key: CaseKey, setup: Setup) -> Scene:
    """Raises ValueError where the object cannot be read or shown."""
    what = ground.subject(key.name, objects(setup).load(key.name), setup)
    truth = Truth(what, environments(setup).load(key.settings["light"]), setup)
    rng = generator(setup.seed, f"sequence {key.settings['part']}", key.name)
    ring = viewpoints.ring(what.radius, ground.optics(setup), setup.base_views, rng)
    return Scene(key, setup, truth, truth.show(ring, "base"), rng, designs.stock(setup))


def painted_views(at: Scene, count: int) -> Case:
    """One painted edit, in its own view first and then in others that show it."""
    kind, rough = at.key.settings["kind"], at.truth.rough()
    for _ in range(TRIES):
        paint, spot = designs.design(rough, at.base, kind, "close-up", at.files, at.rng)
        views = [paint.camera, *designs.beside(at.truth, paint.camera, spot, count - 1, NEAR, at.rng)]
        novel, near = at.near_and_around(paint.camera, spot)
        before, after = (t.show([*views, *novel], "novel") for t in (at.truth, at.truth.painted(paint)))
        masks = changed(before, after)
        parts = masks[:count].mean((1, 2))
        if parts[0] >= SMALLEST and (parts >= LIGHTLY * SMALLEST).all() and masks[count:][near].any():
            break
    else:
        raise at.fail(f"a {kind} edit in {count} views")
    steps = [EditStep("local", kind, after.pictures.take([k]), masks[k : k + 1]) for k in range(count)]
    rest = range(count, count + len(novel))
    return at.case(steps, before.pictures.take(rest), after.pictures.take(rest), near, edit="paint", kind=kind)


def zoomed_views(at: Scene, count: int) -> Case:
    """More and more close-ups of one spot, crops of pictures `setup.detail` times larger."""
    for _ in range(TRIES):
        spot = designs.any_spot(at.base, at.rng)
        whole = designs.view_of(spot, "whole", at.truth.subject.radius, at.optics, at.rng)
        if not ground.blocked(at.truth.subject.mesh, whole.position, spot.place, 0.02):
            break
    else:
        raise at.fail("a close-up")
    zoom = viewpoints.crop(whole, spot.place, at.setup.detail)
    views = [zoom, *designs.beside(at.truth, zoom, spot, count - 1, NEAR, at.rng)]
    novel, near = at.near_and_around(zoom, spot)
    shown = at.truth.show([*views, *novel], "novel")
    steps = [EditStep("local", "zoom", shown.pictures.take([k]), shown.masks[k : k + 1]) for k in range(count)]
    after = shown.pictures.take(range(count, count + len(novel)))
    return at.case(steps, after, after, near, edit="zoom", kind="zoom")


def relit_views(at: Scene, count: int) -> Case:
    """The object in another light, in more and more views around it (the paper's figure of iterative updates)."""
    target = Truth(at.truth.subject, environments(at.setup).load(at.key.settings["target"]), at.setup)
    radius = at.truth.subject.radius
    views = viewpoints.ring(radius, at.optics, count, at.rng)
    novel = viewpoints.ring(radius, at.optics, at.setup.novel_views, at.rng)
    shown = target.show([*views, *novel], "relit")
    steps = [EditStep("global", "relight", shown.pictures.take([k]), shown.masks[k : k + 1]) for k in range(count)]
    after = shown.pictures.take(range(count, count + len(novel)))
    before = at.truth.show(novel, "novel").pictures
    near = np.zeros(len(novel), bool)
    return at.case(steps, before, after, near, edit="relight", kind="relight", target=target.light.name)


def different_edits(at: Scene, count: int) -> Case:
    """Up to `count` edits of all kinds at different places, each in a close-up of its own.

    The first views of `before` and `after` are those close-ups: just before the edit made there, and after the last."""
    truth, rough = at.truth, at.truth.rough()
    steps: list[EditStep] = []
    earlier: list[PosedImages] = []
    made: list[tuple[Paint, Spot]] = []
    for k in range(count):
        paint, spot = _another(at, rough, KINDS[k % len(KINDS)], [spot for _, spot in made])
        painted = truth.painted(paint)
        before, after = (t.show([paint.camera], f"edit {k}") for t in (truth, painted))
        masks = changed(before, after)
        if masks.mean() < LIGHTLY * SMALLEST:
            continue  # seen in the rough truth alone
        truth, rough = painted, rough.painted(paint)
        made.append((paint, spot))
        earlier.append(before.pictures)
        steps.append(EditStep("local", paint.kind, after.pictures, masks))
    if len(steps) < 2:
        raise at.fail("different edits")
    last = [truth.show(step.edited.cameras, f"edit {k}").pictures for k, step in enumerate(steps)]
    novel, near = at.near_and_around(made[-1][0].camera, made[-1][1])
    before, after = (t.show(novel, "novel").pictures for t in (at.truth, truth))
    near = np.concatenate([np.zeros(len(steps), bool), near])
    return at.case(steps, joined([*earlier, before]), joined([*last, after]), near, kind="several")


def conflict(at: Scene) -> Case:
    """Two views, one after the other, paint one region differently; the second picture shows the object with the first
    edit under its own. The first view of `before` and `after` is that of the first edit."""
    rough = at.truth.rough()
    for _ in range(TRIES):
        first_kind, second_kind = (str(kind) for kind in at.rng.choice(["stroke", "text", "sticker", "photo"], 2))
        first, spot = designs.design(rough, at.base, first_kind, "close-up", at.files, at.rng)
        between = rough.painted(first)
        (view,) = designs.beside(at.truth, first.camera, spot, 1, CONFLICT, at.rng)
        seen = between.show([view], "design")
        second = designs.painting(second_kind, view, spot, seen, at.files, at.rng, 0.5)
        if second is None:
            continue
        once, twice = at.truth.painted(first), at.truth.painted(first).painted(second)
        plain, one, two = (t.show([first.camera], "first") for t in (at.truth, once, twice))
        masks, over = changed(plain, one), changed(one, two)
        least = OVERLAP * min(masks.sum(), over.sum())
        one_there, two_there = (t.show([view], "second") for t in (once, twice))
        later = changed(one_there, two_there)
        if min(m.mean() for m in (masks, over, later)) >= SMALLEST and (masks & over).sum() >= max(least, 1):
            break
    else:
        raise at.fail("edits that conflict")
    steps = [
        EditStep("local", first_kind, one.pictures, masks),
        EditStep("local", second_kind, two_there.pictures, later),
    ]
    novel, near = at.near_and_around(view, spot)
    before, after = (t.show(novel, "novel").pictures for t in (at.truth, twice))
    near = np.concatenate([[False], near])
    return at.case(steps, joined([plain.pictures, before]), joined([two.pictures, after]), near, kind="conflict")


def joined(parts: Sequence[PosedImages]) -> PosedImages:
    """All views in a row."""
    cameras = tuple(camera for part in parts for camera in part.cameras)
    return PosedImages(cameras, np.concatenate([part.colors for part in parts]))


def _another(at: Scene, rough: Truth, kind: str, spots: Sequence[Spot]) -> tuple[Paint, Spot]:
    """An edit as far from the others as can be had."""
    for least in APART:
        accept = designs.apart(spots, least * at.truth.subject.radius)
        try:
            return designs.design(rough, at.base, kind, "close-up", at.files, at.rng, accept)
        except ValueError:
            if least == APART[-1]:
                raise
    raise AssertionError
