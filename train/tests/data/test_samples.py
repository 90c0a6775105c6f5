"""Samples of a textured ball and box made by hand: every kind, the same in any order, true from every side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpainter.rendering import render
from splatpainter.splats import Splats
from splattrain.data import edit_samples, viewpoints
from splattrain.data.edit_samples import SampleSpec
from splattrain.data.edits import MIN_EDIT_FRACTION, content
from splattrain.data.edits.content import EditResources, PaintCoverage, list_files
from splattrain.data.edits.on_surfels import display_colors
from splattrain.data.lit_scenes import Renders
from splattrain.data.materials import Material
from splattrain.data.meshes import Mesh
from splattrain.data.object_sources import SplatFolder
from splattrain.data.samples import GLOBAL, KINDS, LOCAL, RECIPES, Sample, SampleRecipe, SampleStream

SMALL = SampleRecipe(size=48, rows=200, surfels=2500, base_views=2, novel_views=4, steps_per_object=3)


def ball(name: str, squash: float) -> Mesh:
    """A closed surface over a (latitude, longitude) grid with a two-coloured texture."""
    v, u = np.meshgrid(np.linspace(0, 1, 17), np.linspace(0, 1, 33), indexing="ij")
    normals = np.stack([np.sin(np.pi * v) * np.sin(2 * np.pi * u), np.cos(np.pi * v)], -1)
    normals = np.concatenate([normals, (np.sin(np.pi * v) * np.cos(2 * np.pi * u))[..., None]], -1).reshape(-1, 3)
    corner = (np.arange(16)[:, None] * 33 + np.arange(32)).reshape(-1)
    faces = np.concatenate(
        [np.stack([corner, corner + 33, corner + 1], 1), np.stack([corner + 1, corner + 33, corner + 34], 1)]
    )
    texture = np.random.default_rng(len(name)).integers(40, 220, (8, 8, 3)).repeat(4, 0).repeat(4, 1).astype(np.uint8)
    uvs = np.stack([2 * u, 1 - v], -1).reshape(-1, 2).astype(np.float32)
    vertices = (0.9 * normals * [1, squash, 1]).astype(np.float32)
    ids = np.zeros(len(faces), np.int64)
    return Mesh(name, vertices, faces, normals.astype(np.float32), uvs, ids, (Material(texture),))


class Balls:
    """Two good objects and a bad one between them."""

    def __init__(self, broken: tuple[int, ...] = (1,)) -> None:
        self.skipped: dict[str, str] = {}
        self.broken = broken

    def __len__(self) -> int:
        return 3

    def name(self, i: int) -> str:
        return f"ball-{i}"

    def mesh(self, i: int) -> Mesh:
        if i in self.broken:
            self.skipped[self.name(i)] = "no triangles"
            raise ValueError(f"{self.name(i)}: no triangles")
        return ball(self.name(i), 1 - 0.2 * i)


@pytest.fixture(scope="module")
def samples() -> dict[str, Sample]:
    """One of each kind."""
    return {kind: SampleStream(Balls(), replace(SMALL, kinds={kind: 1.0}), 5)[1] for kind in KINDS}


def equal(a: Sample, b: Sample) -> bool:
    views = [
        (x, y) for n in ("base", "edited", "novel_before", "novel_after") for x, y in [(getattr(a, n), getattr(b, n))]
    ]
    same = all(
        torch.equal(x.colors, y.colors)
        and all(
            (p.world_to_camera == q.world_to_camera).all() and p == q for p, q in zip(x.cameras, y.cameras, strict=True)
        )
        for x, y in views
    )
    arrays = all(
        (getattr(a.asset, n) == getattr(b.asset, n)).all() for n in ("means", "quats", "scales", "opacities", "sh")
    )
    labels = (a.name, a.kind, a.mode) == (b.name, b.kind, b.mode)
    return same and arrays and labels and (a.masks == b.masks).all() and bool((a.near == b.near).all())


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_its_shapes_and_a_mask_that_covers_something(samples: dict[str, Sample], kind: str) -> None:
    sample = samples[kind]
    views = len(sample.edited)
    assert sample.kind == kind and sample.mode == ("global" if kind in GLOBAL else "local")
    assert sample.edited.colors.shape == (views, 48, 48, 3) and sample.masks.shape == (views, 48, 48)
    assert sample.masks.dtype == bool and sample.near.dtype == bool and len(sample.near) == 4
    assert sample.novel_before.cameras == sample.novel_after.cameras
    for drawn in (sample.base, sample.edited, sample.novel_before, sample.novel_after):
        assert drawn.colors.dtype == torch.float32 and len(drawn.cameras) == len(drawn.colors)
        assert len(drawn) == 0 or (drawn.colors.min() >= 0 and drawn.colors.max() <= 1)
    assert isinstance(sample.asset.means, np.ndarray) and len(sample.asset) == 200 and sample.asset.drawable.all()
    if kind == "plain":
        assert views == 0 and not sample.near.any()
        return
    assert 1 <= views <= 4 and sample.near.tolist() == [True, True, False, False]
    assert (sample.masks.mean((1, 2)) >= edit_samples.MIN_FURTHER_FRACTION).all() and sample.masks[
        0
    ].mean() >= MIN_EDIT_FRACTION
    changed = (sample.novel_after.colors - sample.novel_before.colors).abs().amax(-1) > 0.02
    assert changed[:2].float().mean() > 0.001  # views near the edit see it


@pytest.mark.parametrize("kind", [*LOCAL, "regrade"])
def test_masks_cover_what_differs_from_the_unedited_truth(kind: str) -> None:
    stream = SampleStream(Balls(), replace(SMALL, kinds={kind: 1.0}, views=(0.0, 1.0)), 2)
    sample = stream[0]
    truth = next(iter(stream._scenes.items.values())).truth
    before = render(truth, list(sample.edited.cameras)).colors.clamp(0, 1)
    difference = (sample.edited.colors - before).abs().amax(-1).numpy()
    if kind == "conflict":
        difference = difference[:1]
    if kind == "zoom":
        assert difference.max() == 0  # the detail is the truth's own
        return
    for mask, change in zip(sample.masks, difference, strict=False):
        rim = 0.03 if kind == "regrade" else 0.01  # its mask is where the object covers more than half a pixel
        assert (change[~mask] > 0.02).mean() < rim and change[mask].mean() > 5 * change[~mask].mean()


def test_the_truth_changes_where_paint_is_and_nowhere_else() -> None:
    stream = SampleStream(Balls(), replace(SMALL, kinds={"sticker": 1.0}), 0)
    scene = stream._scene(0)
    drawn: list[Splats[torch.Tensor]] = []
    render_views = edit_samples.render_views

    def watch(splats: Splats[torch.Tensor], cameras: list) -> Renders:
        drawn.append(splats)
        return render_views(splats, cameras)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(edit_samples, "render_views", watch)
        edit = next(
            filter(
                None,
                (
                    edit_samples.paint(
                        scene, "sticker", SampleSpec(SMALL, 2), EditResources(), np.random.default_rng(s)
                    )
                    for s in range(9)
                ),
            )
        )
    after = drawn[-1]
    assert torch.equal(edit.edited.colors, render(after, list(edit.edited.cameras)).colors.clamp(0, 1))
    assert torch.equal(edit.after.colors, render(after, list(edit.after.cameras)).colors.clamp(0, 1))
    changed = (after.sh != scene.truth.sh).flatten(1).any(1)
    assert 0 < changed.float().mean() < 0.5
    assert all(getattr(after, n) is getattr(scene.truth, n) for n in ("means", "quats", "scales", "opacities"))
    camera = edit.edited.cameras[0]
    facing = ((torch.from_numpy(camera.position).float() - after.means) * scene.object.surfels.normals).sum(1)
    assert (facing[changed] > 0).all()  # no paint on the far side


def test_in_a_conflict_the_later_view_is_the_truth() -> None:
    stream = SampleStream(Balls(), replace(SMALL, kinds={"conflict": 1.0}, lit_paint=0.0), 1)
    scene = stream._scene(0)
    spec = SampleSpec(replace(SMALL, lit_paint=0.0), 2)
    made = []
    apply_paint = edit_samples.apply_paint

    def watch(sh: torch.Tensor, paint: PaintCoverage) -> torch.Tensor:
        made.append((paint, apply_paint(sh, paint)))
        return made[-1][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(edit_samples, "apply_paint", watch)
        for seed in range(20):
            made.clear()
            edit = edit_samples.conflict(scene, spec, EditResources(), np.random.default_rng(seed))
            if edit is not None:
                break
    assert edit is not None
    (first, _), (second, last) = made
    both = (first.coverage > 0.9) & (second.coverage > 0.99)
    assert both.sum() >= 2
    np.testing.assert_allclose(display_colors(last)[both], second.colors[both], atol=1e-2)
    final = replace(scene.truth, sh=last)
    assert torch.equal(edit.edited.colors[1], render(final, edit.edited.cameras[1]).colors[0].clamp(0, 1))
    assert not torch.equal(edit.edited.colors[0], render(final, edit.edited.cameras[0]).colors[0].clamp(0, 1))
    assert torch.equal(edit.after.colors, render(final, list(edit.after.cameras)).colors.clamp(0, 1))


def test_equal_numbers_give_equal_samples_in_any_order() -> None:
    recipe = replace(SMALL, kinds=RECIPES["unified"].kinds)
    first, second = SampleStream(Balls(), recipe, 7), SampleStream(Balls(), recipe, 7)
    forward = [first[i] for i in range(8)]
    for i in (6, 1, 7, 3):
        assert equal(second[i], forward[i])
    assert not equal(SampleStream(Balls(), recipe, 8)[1], forward[1])
    assert len({sample.kind for sample in forward}) > 3


def test_detail_is_drawn_per_object_and_scales_pixels_gaussians_and_surfels_alike() -> None:
    recipe = replace(SMALL, kinds={"plain": 1.0}, detail=(1.0, 3.0), steps_per_object=1)
    stream = SampleStream(Balls(()), recipe, 3)
    by_name = {sample.name: sample for sample in (stream[i] for i in range(6))}
    assert len(by_name) == 3
    factors = {name: sample.base.colors.shape[1] / 48 for name, sample in by_name.items()}
    assert len(set(factors.values())) == 3 and all(1 <= f <= 3 for f in factors.values())
    for name, sample in by_name.items():
        assert len(sample.asset) == pytest.approx(200 * factors[name] ** 2, rel=0.08)
    assert equal(stream[4], SampleStream(Balls(()), recipe, 3)[4])


def test_a_stage_lasts_its_steps_and_bad_objects_give_way() -> None:
    source = Balls()
    stream = SampleStream(source, replace(SMALL, kinds={"plain": 1.0}), 0)
    actual = [stream[i] for i in range(9)]
    for block in range(3):
        assert all(sample.asset is actual[3 * block].asset for sample in actual[3 * block : 3 * block + 3])
    assert actual[0].asset is not actual[3].asset
    assert {sample.name for sample in actual} == {"ball-0", "ball-2"} and source.skipped == {"ball-1": "no triangles"}


def test_nothing_usable_and_nothing_visible_are_said_with_names(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"none of the 3 objects can be used; the first: ball-\d: no triangles"):
        SampleStream(Balls((0, 1, 2)), SMALL)[0]
    monkeypatch.setattr(edit_samples, "paint", lambda *_: None)
    stream = SampleStream(Balls(), SMALL)
    with pytest.raises(ValueError, match=r"ball-\d: 20 choices of a stroke edit changed nothing"):
        stream[0]
    assert stream.retries == {"stroke": 20}
    with pytest.raises(IndexError):
        stream[-1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kinds": {"storke": 1.0}}, "expected kinds of"),
        ({"kinds": {}}, "expected kinds of"),
        ({"kinds": {"text": -1.0}}, "weights >= 0"),
        ({"size": 4}, "size of at least 16, got 4"),
        ({"novel_views": 0}, "novel_views of at least 1"),
        ({"views": (0.0, 0.0)}, "expected odds"),
        ({"sh_degree": 3}, "sh_degree 0, 1 or 2"),
        ({"backgrounds": ()}, "at least one background"),
    ],
)
def test_bad_recipes_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **change)


def test_files_are_listed_by_name_and_missing_folders_named(tmp_path: Path) -> None:
    for name in ("b.png", "a.jpg", "note.txt", "c.ttf"):
        (tmp_path / name).touch()
    assert [path.name for path in list_files(tmp_path)] == ["a.jpg", "b.png", "c.ttf"]
    with pytest.raises(ValueError, match="no such folder"):
        SampleStream(Balls(), SMALL, decals=tmp_path / "none")
    stream = SampleStream(Balls(), replace(SMALL, kinds={"sticker": 1.0}), decals=[tmp_path / "b.png"])
    with pytest.raises(ValueError, match=r"b\.png: expected a picture"):
        stream[0]


def test_a_splat_asset_is_its_own_truth(tmp_path: Path) -> None:
    from splatpainter.io import write

    stream = SampleStream(Balls(), replace(SMALL, kinds={"plain": 1.0}))
    truth = stream._scene(0).truth.numpy()
    turned = replace(
        truth,
        means=truth.means * np.array([3, -3, -3], np.float32) + np.array([5, 0, 1], np.float32),
        scales=3 * truth.scales,
    )
    write(tmp_path / "ball.ply", turned)
    splats = SampleStream(SplatFolder(tmp_path), replace(SMALL, kinds={"stroke": 1.0, "relight": 9.0, "zoom": 9.0}), 1)
    sample = splats[0]
    assert sample.kind == "stroke" and len(sample.asset) == len(truth) and sample.masks.any()
    assert np.abs(sample.asset.means).max() < 1.1
    with pytest.raises(ValueError, match="can be made of splat assets"):
        SampleStream(SplatFolder(tmp_path), replace(SMALL, kinds={"relight": 1.0}))


def test_a_crop_is_a_window_of_the_larger_picture() -> None:
    optics = viewpoints.Optics(64)
    camera = viewpoints.object_camera(1.0, optics, 30, 20)
    part = viewpoints.crop(camera, np.array([0.3, 0.2, 0.1]), 3.0)
    assert (part.width, part.height) == (64, 64) and np.isclose(part.fx, 3 * camera.fx)
    point = part.world_to_camera @ np.array([0.3, 0.2, 0.1, 1])
    x, y = part.fx * point[0] / point[2] + part.cx, part.fy * point[1] / point[2] + part.cy
    assert abs(x - 32) < 1 and abs(y - 32) < 1
    edge = viewpoints.crop(camera, np.array([5.0, 0, 0]), 3.0)  # clamped to the large picture
    assert 3 * 64 - 64 == round(3 * camera.cx - edge.cx) or edge.cx == 3 * camera.cx


def test_neighbours_keep_looking_at_the_target_from_the_angles_asked_for() -> None:
    target, rng = np.array([0.2, 0.1, 0.3]), np.random.default_rng(0)
    camera = viewpoints.facing(target, np.array([0.0, 0, 1]), 1.0, viewpoints.Optics(64), rng)
    for _ in range(20):
        other = viewpoints.neighbour(camera, target, rng)
        lines = [(c.position - target) / np.linalg.norm(c.position - target) for c in (camera, other)]
        assert 14.9 < np.degrees(np.arccos(lines[0] @ lines[1])) < 40.1
        assert np.allclose(other.forward, -lines[1], atol=1e-6)


def test_recipes_name_the_kinds_that_there_are() -> None:
    from splattrain.data import sample_recipes

    assert tuple(content.LAYER_MAKERS) == sample_recipes.PAINTED
    for name, recipe in RECIPES.items():
        local_share, global_share = (sum(recipe.kinds.get(kind, 0) for kind in group) for group in (LOCAL, GLOBAL))
        expected = {"local": (1, 0), "global": (0, 1), "unified": (1, 1), "lrm": (0, 0), "paper": (1, 0)}[name]
        assert np.allclose((local_share, global_share), expected)
