"""`bench painted`: paint on meshes that training never saw, against how the painted surface looks from other sides.

One close-up of every object is painted (painted_cases.py), every method puts it on the asset, and renders of the edited
asset are compared with the truth: in the edited view, in novel views near it, plainly and softly (a plain figure sees
little but the half pixels at the edges of strokes), where nothing was painted; and for what figures of means do not
see: specks of old colour in the paint, and cracks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from scipy import ndimage
from tyro.conf import Positional, arg

from splatbench.cases import Case, Setup, check_options
from splatbench.ground_truth import changes
from splatbench.painted_cases import AssetKind, cases
from splatbench.scoring import bounding_box, compared, decibels
from splatbench.timing import machine
from splatpainter import text_tables as tables
from splatpainter.cameras import bounding_sphere
from splatpainter.contact_sheet import Strip, sheet, write_sheet
from splatpainter.image_files import to_uint8
from splatpainter.painter import Edit, Painter
from splatpainter.pictures.drawing import gaussian_blur

if TYPE_CHECKING:
    from splatpainter.cameras import Camera
    from splatpainter.rendering import Render
    from splatpainter.splats import Splats

SOFT_PX = 2.0
"""Standard deviation of the blur of both pictures before the soft PSNR, pixels."""
PAINT_CORE_PX = 2
"""Pixels by which the true paint is eroded before specks are counted."""
MIN_PAINT_CONTRAST = 0.15
"""Distance (of display colours, 0 to 1.7) between painted and unpainted truth from which a pixel can be a speck."""
SPECK_MARGIN = 2.0
"""A speck is this many times nearer to the unpainted truth than to the painted one."""
MIN_OBJECT_ALPHA = 0.9
"""Alpha of the asset before the edit from which a pixel can crack."""
MIN_DRAWN_ALPHA = 0.02
"""Alpha of the asset before or after the edit from which a pixel is not only background."""
MAX_ALPHA_FALL = 0.2
"""Alpha that an edit may take from a pixel before it is a crack."""
MAX_DEPTH_RISE = 0.05
"""Share of the object's radius by which an edit may move a pixel's expected depth away from the camera before one sees
through the surface, to the far wall."""
PAINT_MARGIN_PX = 6
"""Pixels around the true paint that count neither as painted nor as not painted: the asset's Gaussians straddle it."""
MIN_RANKED = 6
"""Fewest edits for which a rank correlation is reported."""
CELL_PX = 224
"""Pixels of a cell of the contact sheet."""
MIN_CELL_PX = 96
"""Pixels of a view that its cell of the sheet shows, at least."""
NOTES = (
    "Means over objects. `edited`: PSNR of the edited view inside the paint; `novel`: the same in novel views 15 to 40 "
    "degrees away, against the painted truth; `soft`: after a blur of both by 2 px; `lpips`: of the paint's window in "
    "novel views. `unpainted`: PSNR against the asset before, in all these views, 6 px and more from the paint. "
    "`specks`: per cent of the true paint (2 px from its edge, where it differs from what is below) that is at least "
    "twice as near to the unpainted truth as to the painted one. `cracks`: per cent of the object's pixels whose alpha "
    "fell by more than 0.2; `see_through`: whose expected depth rose by more than 5 % of the object's radius. Both in "
    "novel views. `aside`: PSNR without truth, from +-35 degrees (lift/side_views.py). `added`: Gaussians.",
)


@dataclass(frozen=True)
class PaintedBench:
    """Paint a close-up of meshes that training never saw, by several methods, and compare with the painted truth.

    example:
      splatpainter bench painted meshes/ --objects 24 --out out/bench-painted
      splatpainter bench painted meshes/ --assets fitted --methods nothing lift
    """

    meshes: Annotated[Positional[Path | None], arg(metavar="MESHES", help_behavior_hint="")] = None
    """Folder of meshes; only those held out of training (by name) are used. None: procedural objects."""
    assets: AssetKind = "coarse"
    """coarse: as in training data; fitted: by 3DGS on views of the truth (a minute or two per object, kept on disk)."""
    methods: tuple[str, ...] = ("nothing", "rounds", "split", "lift")
    """Methods: nothing, rounds (five colour rounds), split (2 x 2, then rounds), lift, fit, auto, network."""
    objects: int = 12
    """How many objects to measure."""
    size: int = 256
    """Edge of the pictures, pixels."""
    rows: int = 20_000
    """Gaussians of every asset."""
    novel_views: int = 4
    """Novel views, besides the edited one."""
    environments: Path | None = None
    """Folder of HDRIs; none: procedural light."""
    decals: Path | None = None
    """Folder of stickers (PNG with transparency)."""
    fonts: Path | None = None
    """Folder of fonts."""
    seed: int = 0
    """Seed of objects, light and paint."""
    preset: str = "auto"
    """The painter of the methods lift, fit, auto and network."""
    perceptual_weights: Path | None = None
    """Folder of the LPIPS weights; default: that of SPLATPAINTER_PERCEPTUAL; without them no LPIPS."""
    out: Path = Path("out/bench-painted")
    """Folder for painted.csv (a line per object and method), painted.md and sheet.png; made if missing."""


@dataclass(frozen=True)
class PaintedScore:
    """One method on one object: dB (None where no pixel counts), per cent, Gaussians, seconds."""

    object: str
    method: str
    edited: float | None
    novel: float | None
    soft: float | None
    lpips: float | None
    unpainted: float | None
    specks: float | None
    cracks: float | None
    see_through: float | None
    aside: float | None
    added: int
    seconds: float


@dataclass(frozen=True)
class MethodMeans:
    """Means over objects; columns as of PaintedScore."""

    method: str
    objects: int
    edited: float | None
    novel: float | None
    soft: float | None
    lpips: float | None
    unpainted: float | None
    specks: float | None
    cracks: float | None
    see_through: float | None
    aside: float | None
    added: float | None
    seconds: float | None


EditFunction = Callable[["Splats", Edit], "Splats"]


def methods(preset: str) -> dict[str, EditFunction]:
    """Name -> what makes an edited asset of an asset and an edit. preset: of the painter."""
    from splatbench.naive_edits import color_rounds, split_and_color

    painter = Painter.load(preset, modes=("local",))

    def painted_by(method: Any) -> EditFunction:
        def apply(splats: Splats, edit: Edit) -> Splats:
            return painter.apply(painter.encode(splats, method, ("local",)), [edit], method=method).splats

        return apply

    def masked(edit: Edit) -> np.ndarray:
        assert edit.mask is not None
        return edit.mask

    return {
        "nothing": lambda splats, edit: splats,
        "rounds": lambda splats, edit: color_rounds(splats, edit.camera, edit.image, masked(edit)),
        "split": lambda splats, edit: split_and_color(splats, edit.camera, edit.image, masked(edit)),
        "lift": painted_by("lift"),
        "fit": painted_by("fit"),
        "auto": painted_by("auto"),
        "network": painted_by("ttt"),
    }


def run(config: PaintedBench, report: Callable[[str], None] | None = None) -> list[MethodMeans]:
    """Measure every method on every object; write painted.csv, painted.md and sheet.png; return the means. report:
    called with a line per object. Raises ValueError for options that make no sense, and for data that is not there."""

    check_options("painted", config, ("meshes", "environments", "decals", "fonts", "perceptual_weights"))
    if not config.methods:
        raise ValueError("bench painted: expected at least one of --methods")
    perceptual = lpips_weights(config.perceptual_weights)
    available = methods(config.preset)
    if unknown := [name for name in config.methods if name not in available]:
        raise ValueError(f"bench painted: expected --methods of {', '.join(available)}, got {unknown[0]!r}")
    if "network" in config.methods and Painter.load(config.preset).choose("ttt", "local")[0] != "ttt":
        raise ValueError(
            f"bench painted: no network of preset '{config.preset}' makes local edits; give --preset FOLDER"
        )
    where = machine()
    config.out.mkdir(parents=True, exist_ok=True)
    scores: list[PaintedScore] = []
    strips: list[Strip] = []
    for case in cases(setup_of(config), config.assets, report):
        lines, pictures = measure_case(case, {name: available[name] for name in config.methods}, perceptual)
        scores += lines
        strips += pictures
        if report:
            report("; ".join(f"{line.method} {decibels(line.soft)}" for line in lines) + f" dB soft: {case.name}")
        write_csv(config.out / "painted.csv", scores, where)
    if not scores:
        raise ValueError("bench painted: none of the objects could be painted")
    means = mean_scores(scores)
    write_sheet(config.out / "sheet.png", sheet(strips, CELL_PX, where))
    tables.write_markdown(config.out / "painted.md", means, where, (*NOTES, *aside_notes(scores)))
    return means


def write_csv(path: Path, scores: Sequence[PaintedScore], heading: str) -> None:
    """A line per object and method."""
    tables.write_csv(path, scores, heading)


def setup_of(config: PaintedBench) -> Setup:
    """Settings that decide the cases."""
    return Setup(
        data=config.meshes,
        environments=config.environments,
        decals=config.decals,
        fonts=config.fonts,
        objects=config.objects,
        held_out=True,
        size=config.size,
        detail=2,
        truth="surfels",
        rows=config.rows,
        novel_views=config.novel_views,
        lights=1,
        seed=config.seed,
    )


def measure_case(
    case: Case, chosen: dict[str, EditFunction], perceptual: Any | None
) -> tuple[list[PaintedScore], list[Strip]]:
    """Every method's line, and its row of the contact sheet, the truth's first."""
    from splatpainter.lift.edit_views import edit_views
    from splatpainter.lift.side_views import side_view_score

    truth = Truth.of(case)
    camera, picture = truth.cameras[0], case.steps[0].edited.colors[0]
    edit = Edit(to_uint8(picture), camera, case.steps[0].masks[0])
    (view,) = edit_views(case.asset, [camera], [edit.image], [case.steps[0].masks[0]])
    lines, strips = [], [Strip(f"{case.name}, {len(case.asset):,} Gaussians: the truth", truth.cells(truth.painted))]
    for name, method in chosen.items():
        start = time.perf_counter()
        after = method(case.asset, edit)
        seconds = time.perf_counter() - start
        views = _drawn(after, truth.cameras)
        figures = truth.scores(views, perceptual)
        figures["aside"] = side_view_score(case.asset, after, view).psnr
        line = PaintedScore(case.name, name, **figures, added=len(after) - len(case.asset), seconds=seconds)
        lines.append(line)
        strips.append(Strip(_caption(line), truth.cells(_colors(views))))
    return lines, strips


@dataclass(frozen=True)
class Truth:
    """What decides whether an edited asset is right; view 0 is the edited one, the others are novel."""

    cameras: list[Camera]
    before: Render
    """Render of the asset, not edited."""
    unpainted: np.ndarray
    """[V, H, W, 3] the object; of view 0 the asset's render."""
    painted: np.ndarray
    """[V, H, W, 3] the painted object."""
    masks: np.ndarray
    """[V, H, W] bool what the paint changes of the object."""
    radius: float
    """Radius of the asset, world units."""

    @staticmethod
    def of(case: Case) -> Truth:
        step = case.steps[0]
        cameras = [step.edited.cameras[0], *case.after.cameras]
        before = _drawn(case.asset, cameras)
        unpainted = np.concatenate([_colors(before)[:1], case.before.colors])
        painted = np.concatenate([step.edited.colors, case.after.colors])
        masks = np.concatenate([step.masks, changes(case.before.colors, case.after.colors)])
        return Truth(cameras, before, unpainted, painted, masks, bounding_sphere(case.asset)[1])

    def scores(self, views: Render, perceptual: Any | None) -> dict[str, float | None]:
        """{column: figure} of renders of an edited asset from all cameras."""
        colors, novel = _colors(views), slice(1, None)
        masks, target = self.masks[novel], self.painted[novel]
        near = compared(colors[novel], target, masks, perceptual)
        edited = compared(colors[:1], self.painted[:1], self.masks[:1], None)
        soft = compared(soft_views(colors[novel]), soft_views(target), masks, None)
        size = 2 * PAINT_MARGIN_PX + 1
        drawn = np.maximum(self.before.alphas, views.alphas)[..., 0] > MIN_DRAWN_ALPHA
        free = drawn & np.logical_not(ndimage.maximum_filter(self.masks, (1, size, size)))
        unpainted = compared(colors, _colors(self.before), free, None)
        solid = self.before.alphas[novel, ..., 0] > MIN_OBJECT_ALPHA
        fall = self.before.alphas[novel, ..., 0] - views.alphas[novel, ..., 0]
        rise = views.depths[novel, ..., 0] - self.before.depths[novel, ..., 0]
        return {
            "edited": edited["psnr"],
            "novel": near["psnr"],
            "soft": soft["psnr"],
            "lpips": near["lpips"],
            "unpainted": unpainted["psnr"],
            "specks": percent(specks(colors[novel], self.unpainted[novel], target), self.core[novel]),
            "cracks": percent(fall > MAX_ALPHA_FALL, solid),
            "see_through": percent(rise > MAX_DEPTH_RISE * self.radius, solid),
        }

    def cells(self, views: np.ndarray) -> tuple[tuple[str, np.ndarray], ...]:
        """(label, picture) of the part of views [V, H, W, 3] that is painted."""
        cells = []
        for k, (view, mask) in enumerate(zip(views, self.masks, strict=True)):
            wide = ndimage.maximum_filter(mask, 2 * PAINT_MARGIN_PX + 1)
            window = (slice(None), slice(None))
            if wide.any():
                sides = [part.stop - part.start for part in bounding_box(wide)]
                window = bounding_box(wide, max(*sides, MIN_CELL_PX))
            cells.append((f"novel view {k}" if k else "edited view", view[window]))
        return tuple(cells)

    @property
    def core(self) -> np.ndarray:
        """[V, H, W] bool: paint that can have specks."""
        size = 2 * PAINT_CORE_PX + 1
        inner = ndimage.minimum_filter(self.masks, (1, size, size), mode="constant", cval=0)
        return inner & (np.linalg.norm(self.painted - self.unpainted, axis=-1) > MIN_PAINT_CONTRAST)


def specks(colors: np.ndarray, unpainted: np.ndarray, painted: np.ndarray) -> np.ndarray:
    """[...] bool: colours [..., 3] that are SPECK_MARGIN times nearer to the unpainted than to the painted ones."""
    left = np.linalg.norm(colors - unpainted, axis=-1)
    return SPECK_MARGIN * left < np.linalg.norm(colors - painted, axis=-1)


def percent(hits: np.ndarray, among: np.ndarray) -> float | None:
    """Per cent of the pixels `among` that are hits; None without any."""
    total = int(among.sum())
    return 100 * int((hits & among).sum()) / total if total else None


def soft_views(views: np.ndarray) -> np.ndarray:
    """[V, H, W, 3] pictures blurred by SOFT_PX."""
    return np.stack([gaussian_blur(view, SOFT_PX) for view in views])


def mean_scores(scores: Sequence[PaintedScore]) -> list[MethodMeans]:
    """One line per method, in the order in which they come."""
    columns = [field.name for field in fields(MethodMeans) if field.name not in ("method", "objects")]
    rows = []
    for name in dict.fromkeys(score.method for score in scores):
        group = [score for score in scores if score.method == name]
        means: dict[str, float | None] = {}
        for column in columns:
            values = [value for score in group if (value := getattr(score, column)) is not None]
            means[column] = float(np.mean(values)) if values else None
        rows.append(MethodMeans(name, len({score.object for score in group}), **means))
    return rows


def aside_notes(scores: Sequence[PaintedScore]) -> list[str]:
    """How well `aside`, which needs no truth, ranks edits as true novel views do; nothing where there are too few."""
    from scipy.stats import rankdata

    edits = [score for score in scores if score.method != "nothing" and score.aside is not None]
    notes = []
    for column in ("novel", "soft"):
        pairs = np.array([(score.aside, value) for score in edits if (value := getattr(score, column)) is not None])
        if len(pairs) >= MIN_RANKED and (np.ptp(pairs, axis=0) > 0).all():
            ranks = rankdata(pairs, axis=0)
            notes.append(f"{column} {np.corrcoef(ranks.T)[0, 1]:.2f}")
    return [f"Rank correlation of `aside` over objects and methods: {', '.join(notes)}."] if notes else []


def lpips_weights(folder: Path | None) -> Any | None:
    """LPIPS-Alex; None where its weights are not there and were not asked for."""
    from splatpainter.metrics import Lpips, LpipsUnavailable

    try:
        return Lpips.load("alex", folder)
    except LpipsUnavailable:
        if folder is not None:
            raise
        return None


def _drawn(splats: Splats, cameras: Sequence[Camera]) -> Render:
    from splatpainter.rendering import render

    return render(splats, list(cameras))


def _colors(views: Render) -> np.ndarray:
    """[V, H, W, 3] as a screen shows them."""
    return np.clip(views.colors, 0, 1)


def _caption(line: PaintedScore) -> str:
    cells = ", ".join(
        f"{name} {tables.cell_text(getattr(line, name))}" for name in ("soft", "novel", "specks", "cracks", "added")
    )
    return f"{line.method}: {cells}; {line.seconds:.2f} s"
