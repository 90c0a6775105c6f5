"""What `bench spread` asks: an object of several materials as an asset, one view in which one of them has a new colour,
and how the object really looks with that material recoloured everywhere.

A material is one of the mesh file's (or, of procedural objects, of the generator's); of a mesh with one texture for
everything it is a cluster of unlit base colours, what an artist would call one paint. The truth recolours the base
colour of dense surfels and shades them anew, so light and shade are right from every side; what a Gaussian of the asset
is made of is the share of that material among the surfels near it. Some materials cannot be told from others even
unlit (two kinds of cardboard), or look different where the view does not see them: `separable` says so of each case.
"""

from __future__ import annotations

import colorsys
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from splatbench.cases import Setup
from splatbench.ground_truth import GroundTruth, GroundTruthViews, build_asset, changed
from splatbench.objects import drawn_lights, environments, generator, objects
from splatbench.painted_cases import SOURCES, AssetKind
from splatpainter.cameras import Camera
from splatpainter.color import linear_to_srgb, luminance, oklab, sh_from_color, srgb_to_linear
from splatpainter.image_files import to_uint8
from splatpainter.splats import Splats
from splattrain.data import viewpoints
from splattrain.data.materials import Material
from splattrain.data.meshes import Mesh

if TYPE_CHECKING:
    from splattrain.data.surfels import Surfels

JUDGED_SHARE = 0.5
"""Share of the meshes with several materials, by their names: a superset of those that training keeps out. Nothing is
trained here; the other half is what settings are tuned on."""
MATERIAL_SHARE = (0.03, 0.85)
"""Part of the surface that a material may be to be recoloured: from, to."""
MIN_SEEN, MAX_SEEN = 0.1, 0.8
"""Part of that material that the edited view shows: from, to."""
MIN_PICTURE = 0.015
"""Part of the edited view that it fills, at least."""
CANDIDATE_VIEWS = 12
"""Views around the object, of which the edited one is that which shows most of the material."""
MIN_COHERENCE = 0.85
"""Share of the surfels nearest to those of a material that are of it too: else it is a pattern, not a material."""
STROKE_SHARE = 0.3
"""Part of what the view shows of the material that a partial stroke covers."""
MIN_CHANGE = 0.08
"""rms change of the recoloured pixels of the edited view, display units, at least."""
NEIGHBOURS = 6
"""Surfels that say what a Gaussian is made of."""
CLUSTERS, MIN_CLUSTER_DISTANCE = 5, 0.12
"""Most clusters of base colours; closer ones (OKLab) are one."""
MAX_CLUSTERED = 20_000
"""Surfels that clusters are found from."""
NEAREST_COLORS = 15
"""Base colours of seen surfels that decide, for `separable`, about another surfel."""
COLOR_NOISE = 0.03
"""Standard deviation (OKLab) that is added to every base colour for `separable`: light, shade, and Gaussians that are
larger than surfels, blur more than that."""
Stroke = Literal["full", "partial"]


@dataclass(frozen=True)
class SpreadCase:
    """One case: an asset and a recoloured view."""

    name: str
    asset: Splats = field(repr=False)
    camera: Camera
    picture: np.ndarray = field(repr=False)
    """[H, W, 3] uint8 the view of the recoloured truth."""
    masks: dict[Stroke, np.ndarray] = field(repr=False)
    """[H, W] bool what of it is handed in."""
    share: np.ndarray = field(repr=False)
    """[N] float32 0..1 what part of each Gaussian is of the material."""
    cameras: tuple[Camera, ...]
    """W novel views from all around."""
    before: np.ndarray = field(repr=False)
    """[W, H, W, 3] of the truth, not recoloured."""
    after: np.ndarray = field(repr=False)
    """[W, H, W, 3] of the truth, recoloured."""
    unseen: np.ndarray = field(repr=False)
    """[W, H, W] bool where they show the material, and a part of it that the edited view does not show."""
    facts: dict[str, Any] = field(default_factory=dict)


def chosen_names(setup: Setup) -> tuple[str, ...]:
    """Objects, in the order of the setup's seed. Of a folder: meshes that training keeps out, and of those with several
    materials as many more as make JUDGED_SHARE; with held_out False the others."""
    if setup.data is None:
        return objects(setup).names
    from splattrain.data.object_sources import MeshFolder, split

    folder = MeshFolder(setup.data)
    names = [folder.name(i) for i in range(len(folder))]
    several = {names[i] for i in range(len(names)) if material_count(folder.files[i]) > 1}
    out = set(split(names)[1]) | (set(split(names, share=JUDGED_SHARE)[1]) & several)
    names = [name for name in names if (name in out) == setup.held_out]
    order = np.random.default_rng([setup.seed, *b"spread"]).permutation(len(names))
    return tuple(names[int(k)] for k in order)


def material_count(path: Path) -> int:
    """Materials of a GLB by its header; 0 where that does not say."""
    if path.suffix.lower() != ".glb":
        return 0
    try:
        with open(path, "rb") as file:
            _, _, _, length, _ = struct.unpack("<4sIIII", file.read(20))
            document = json.loads(file.read(min(length, 1 << 28)))
        return len({p.get("material", -1) for mesh in document["meshes"] for p in mesh["primitives"]})
    except (OSError, ValueError, KeyError, TypeError, struct.error):
        return 0


def cases(setup: Setup, kind: AssetKind, report: Any = None) -> Iterator[SpreadCase]:
    """The setup's cases; objects of which no material can be recoloured so that it shows are left out, with a line to
    `report`. Raises ValueError for data that cannot be read."""
    lights, made = environments(setup).names, 0
    for name in chosen_names(setup):
        if made >= setup.objects:
            return
        try:
            case = make_case(name, drawn_lights(lights, name, 1, setup.seed)[0], setup, kind)
        except ValueError as error:
            if report:
                report(f"{name}: left out, {error}")
            continue
        made += 1
        yield case


def make_case(name: str, light: str, setup: Setup, kind: AssetKind) -> SpreadCase:
    """Raises ValueError where its mesh cannot be read, or no material of it will do."""
    mesh = _mesh(name, setup)
    truth = GroundTruth.of(name, mesh, environments(setup).load(light), setup)
    assert truth.surfels is not None
    rng = generator(setup.seed, "spread", name)
    several = len(np.unique(mesh.material_ids)) > 1
    labels = material_labels(mesh, truth.surfels, setup) if several else color_labels(truth.surfels, rng)
    area = truth.surfels.scales[:, 0].numpy().astype(np.float64) ** 2
    shares = np.bincount(labels, area) / area.sum()
    fit = np.flatnonzero((shares >= MATERIAL_SHARE[0]) & (shares <= MATERIAL_SHARE[1]))
    points = truth.surfels.means.numpy()
    fit = [k for k in fit if material_share(points[labels == k], points, labels == k).mean() >= MIN_COHERENCE]
    for material in rng.permutation(fit):
        camera = _edited_view(truth, labels == material, area, rng)
        if camera is None:
            continue
        inside = labels == material
        recolored = replace(truth, surfels=recolored_surfels(truth.surfels, inside, rng))
        before, after = (t.render([camera], "novel") for t in (truth, recolored))
        mask = changed(before, after)[0]
        difference = (after.images.colors - before.images.colors)[0][mask]
        if mask.mean() < MIN_PICTURE or np.sqrt((difference**2).mean()) < MIN_CHANGE:
            continue
        case = _case(truth, recolored, inside, camera, mask, after, setup, kind, rng)
        facts = {"materials": "of the file" if several else "base colours", "light": light}
        facts |= {"separable": separable(truth.surfels, inside, _seen(truth, camera), area)}
        return replace(case, facts=case.facts | facts)
    raise ValueError("none of its materials shows well in a view and continues where it does not look")


def _case(
    truth: GroundTruth,
    recolored: GroundTruth,
    inside: np.ndarray,
    camera: Camera,
    mask: np.ndarray,
    edited: GroundTruthViews,
    setup: Setup,
    kind: AssetKind,
    rng: np.random.Generator,
) -> SpreadCase:
    assert truth.surfels is not None
    base = truth.render(truth.ring(setup.base_views, rng), "base")
    asset = build_asset(truth, base, SOURCES[kind])
    novel = truth.ring(setup.novel_views, rng)
    before, after = (t.render(novel, "novel") for t in (truth, recolored))
    seen = _seen(truth, camera)
    unseen = _indicator(truth, inside & ~seen, novel) & _indicator(truth, inside, novel)
    return SpreadCase(
        truth.name,
        asset.splats,
        camera,
        to_uint8(edited.images.colors[0]),
        {"full": mask, "partial": partial_stroke(mask, rng)},
        material_share(asset.splats.means, truth.surfels.means.numpy(), inside),
        tuple(novel),
        before.images.colors,
        after.images.colors,
        unseen,
        {"asset": asset.method, "share": float(inside.mean())},
    )


def _mesh(name: str, setup: Setup) -> Mesh:
    if setup.data is None:
        return objects(setup).load(name)
    from splattrain.data.object_sources import MeshFolder

    return MeshFolder(setup.data, [name]).mesh(0)


def material_labels(mesh: Mesh, surfels: Surfels, setup: Setup) -> np.ndarray:
    """[S] int64 the material of each surfel: of the same points, sampled from a mesh whose base colours are numbers."""
    from splattrain.data.surfels import sample_surfels

    count = len(mesh.materials)
    coded = tuple(
        Material(base_factor=((k + 0.5) / count, 0.0, 0.0), alpha=material.alpha)
        for k, material in enumerate(mesh.materials)
    )
    numbered = sample_surfels(replace(mesh, materials=coded, colors=None), len(surfels), setup.seed)
    if not np.array_equal(numbered.means.numpy(), surfels.means.numpy()):
        raise ValueError("its points depend on its materials")
    return np.floor(numbered.albedo[:, 0].numpy() * count).astype(np.int64).clip(0, count - 1)


def color_labels(surfels: Surfels, rng: np.random.Generator) -> np.ndarray:
    """[S] int64 clusters of the unlit base colours (k-means in OKLab), near ones joined."""
    from scipy.cluster.vq import kmeans2, vq

    colors = _lab(surfels)
    some = colors[rng.permutation(len(colors))[:MAX_CLUSTERED]]
    centers, nearest = kmeans2(some, CLUSTERS, minit="++", rng=rng)
    order = np.argsort(-np.bincount(nearest, minlength=CLUSTERS))
    heads: list[np.ndarray] = []
    for k in order:
        if not heads or np.linalg.norm(np.array(heads) - centers[k], axis=1).min() > MIN_CLUSTER_DISTANCE:
            heads.append(centers[k])
    return vq(colors, np.array(heads))[0].astype(np.int64)


def separable(surfels: Surfels, inside: np.ndarray, seen: np.ndarray, area: np.ndarray) -> float:
    """0..1: intersection over union of the material and of what the unlit base colours of seen surfels would say is
    that material (most of the NEAREST_COLORS nearest ones, each class weighing the same), with COLOR_NOISE in all."""
    from scipy.spatial import KDTree

    given = np.flatnonzero(seen)
    colors = _lab(surfels) + COLOR_NOISE * np.random.default_rng(0).standard_normal((len(surfels), 3))
    weight = np.where(inside[given], 1 / max(inside[given].sum(), 1), 1 / max((~inside[given]).sum(), 1))
    _, ids = KDTree(colors[given]).query(colors, NEAREST_COLORS)
    votes = np.where(inside[given], weight, -weight)[ids].sum(1) > 0
    return float(area[votes & inside].sum() / area[votes | inside].sum())


def _lab(surfels: Surfels) -> np.ndarray:
    """[S, 3] OKLab of the base colours."""
    return oklab(linear_to_srgb(surfels.albedo.numpy().clip(0, 1)))


def recolored_surfels(surfels: Surfels, inside: np.ndarray, rng: np.random.Generator) -> Surfels:
    """One material in another hue: every base colour keeps its luminance over the material's mean (texture stays), and
    takes the hue and saturation of the new colour, whose luminance is near the old mean's."""
    import torch

    albedo = surfels.albedo.numpy().copy()
    old = albedo[inside]
    light = luminance(old)
    mean = float(light.mean())
    hue = colorsys.rgb_to_hsv(*old.mean(0).clip(0, 1).tolist())[0]
    turned = (hue + rng.uniform(0.25, 0.75)) % 1
    paint = srgb_to_linear(np.array(colorsys.hsv_to_rgb(turned, rng.uniform(0.55, 0.9), 1.0), np.float32))
    paint *= np.clip(mean, 0.08, 0.5) / max(float(luminance(paint)), 1e-3)
    albedo[inside] = (light[:, None] / max(mean, 1e-3) * paint).clip(0, 1)
    return replace(surfels, albedo=torch.from_numpy(albedo.astype(np.float32)))


def _edited_view(truth: GroundTruth, inside: np.ndarray, area: np.ndarray, rng: np.random.Generator) -> Camera | None:
    """The one of CANDIDATE_VIEWS that shows most of the material, and not all; None where none will do."""
    best, most = None, MIN_SEEN
    for _ in range(CANDIDATE_VIEWS):
        camera = viewpoints.object_camera(truth.radius, truth.optics, rng.uniform(0, 360), rng.uniform(-10, 40))
        seen = float(area[inside & _seen(truth, camera)].sum() / area[inside].sum())
        if most <= seen <= MAX_SEEN and _indicator(truth, inside, [camera]).mean() >= MIN_PICTURE:
            best, most = camera, seen
    return best


def _seen(truth: GroundTruth, camera: Camera) -> np.ndarray:
    """[S] bool surfels that a view shows."""
    import torch

    from splattrain.data.edits.on_surfels import view_visibility

    assert truth.surfels is not None
    view = truth.render([camera], "design")
    depth, alpha = torch.from_numpy(view.depths[0]), torch.from_numpy(view.alphas[0])
    visible = view_visibility(truth.surfels.means, truth.surfels.normals, camera, depth, alpha)
    return visible.numpy() > 0.1


def _indicator(truth: GroundTruth, chosen: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """[V, H, W] bool: pixels that show mostly the chosen surfels ([S] bool)."""
    import torch

    from splattrain.data.lit_scenes import render_views
    from splattrain.data.surfels import to_splats

    assert truth.surfels is not None
    white = torch.from_numpy(np.repeat(chosen[:, None], 3, 1).astype(np.float32))
    black = [replace(camera, background=(0.0, 0.0, 0.0)) for camera in cameras]
    views = render_views(to_splats(truth.surfels, sh_from_color(white)[:, None]), black)
    return views.views.colors[..., 0].numpy() > 0.6


def material_share(means: np.ndarray, points: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """[N] float32: of the NEIGHBOURS surfels nearest to each of `means` [N, 3], those of the material."""
    from scipy.spatial import KDTree

    _, ids = KDTree(points).query(means, NEIGHBOURS)
    return inside[ids].mean(1).astype(np.float32)


def partial_stroke(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[H, W] bool: the STROKE_SHARE of a mask's pixels that are nearest to one of them."""
    pixels = np.argwhere(mask)
    middle = pixels[int(rng.integers(len(pixels)))]
    nearest = np.argsort(((pixels - middle) ** 2).sum(1), kind="stable")[: round(STROKE_SHARE * len(pixels))]
    out = np.zeros_like(mask)
    out[tuple(pixels[nearest].T)] = True
    return out
