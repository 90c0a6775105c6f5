"""`bench spread`: one material of an object recoloured in one view, by the local lift and by mode spread.

Every case is asked twice: with all that the view shows of the material painted, and with a stroke over 30 % of it. What
is reached is compared with what is of the material (spread_cases.py), and renders of novel views with the truth: where
they show the material and the edited view did not look, and where nothing should change.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

import numpy as np
from tyro.conf import Positional, arg

from splatbench.cases import Setup, check_options
from splatbench.painted_cases import AssetKind
from splatbench.spread_cases import SpreadCase, Stroke, cases
from splatbench.timing import machine
from splatpainter import text_tables as tables
from splatpainter.contact_sheet import Strip, sheet, write_sheet
from splatpainter.painter import Edit, EditSettings, Painter
from splatpainter.splats import Splats

SEPARABLE = 0.85
"""IoU by noisy unlit base colours from which a material counts as one that colours can tell."""
MIN_UNSEEN_PX = 50
"""Pixels of novel views that show the material where the edited view does not, for its PSNR to count."""
MAX_REST_CHANGE = 1 / 255
"""Change of the truth, display units, below which a pixel counts as one that should stay."""
CELL_PX = 160
NOTES = (
    "`iou`: intersection over union, by opacity and area, of the Gaussians that are reached (confidence at the "
    "threshold or above) and of those that are of the material (most of the surfels near them). `lift`, `spread`: PSNR "
    "in novel views against the recoloured truth, where they show the material and the edited view did not look. "
    "`rest`: PSNR of the spread asset in novel views, where the truth does not change, against the truth; `rest_lift`: "
    "of the lift. `reached_partial`: share of the cases that were taken for paint that ends in the middle of the "
    "material. Rows `separable`: materials whose unlit base colours, with noise, tell them from the rest with an IoU "
    f"of {SEPARABLE} or more; the others are asked all the same.",
)


@dataclass(frozen=True)
class SpreadBench:
    """Recolour a material of meshes in one view, and measure how well mode spread carries that on.

    example:
      splatpainter bench spread meshes/ --objects 20 --environments hdris/ --out out/bench-spread
    """

    meshes: Annotated[Positional[Path | None], arg(metavar="MESHES", help_behavior_hint="")] = None
    """Folder of meshes; only those held out (by name) are used. None: procedural objects."""
    assets: AssetKind = "coarse"
    """coarse: as in training data; fitted: by 3DGS on views of the truth (a minute or two per object)."""
    objects: int = 12
    """How many objects to measure."""
    tuning: bool = False
    """Take the meshes that settings were tuned on instead of those that are held out."""
    threshold: float | None = None
    """Threshold of mode spread; default: the program's own."""
    size: int = 256
    """Edge of the pictures, pixels."""
    rows: int = 20_000
    """Gaussians of every asset."""
    novel_views: int = 6
    """Novel views, from all around."""
    environments: Path | None = None
    """Folder of HDRIs; none: procedural light."""
    seed: int = 0
    """Seed of objects, light, materials and colours."""
    out: Path = Path("out/bench-spread")
    """Folder for spread.csv (a line per object and stroke), spread.md and sheet.png; made if missing."""


@dataclass(frozen=True)
class SpreadScore:
    """One stroke on one object; None where no pixel counts."""

    object: str
    stroke: Stroke
    materials: str
    separable: float
    iou: float
    lift: float | None
    spread: float | None
    rest: float | None
    rest_lift: float | None
    reached_partial: bool
    seconds: float


@dataclass(frozen=True)
class SpreadMeans:
    """Means over objects; columns as of SpreadScore."""

    stroke: Stroke
    cases: str
    objects: int
    iou: float
    iou_median: float
    lift: float | None
    spread: float | None
    gain: float | None
    rest: float | None
    rest_lift: float | None
    reached_partial: float
    seconds: float


def run(config: SpreadBench, report: Callable[[str], None] | None = None) -> list[SpreadMeans]:
    """Measure every object; write spread.csv, spread.md and sheet.png; return the means. report: called with a line per
    object. Raises ValueError for options that make no sense, and for data that is not there."""

    check_options("spread", config, ("meshes", "environments"))
    where = machine()
    config.out.mkdir(parents=True, exist_ok=True)
    scores: list[SpreadScore] = []
    strips: list[Strip] = []
    for case in cases(setup_of(config), config.assets, report):
        lines, pictures = measure_case(case, config.threshold)
        scores += lines
        strips += pictures
        if report:
            report(f"{case.name}: " + "; ".join(_caption(line) for line in lines))
        tables.write_csv(config.out / "spread.csv", scores, where)
    if not scores:
        raise ValueError("bench spread: no object has a material that can be recoloured; take more objects")
    means = mean_scores(scores)
    write_sheet(config.out / "sheet.png", sheet(strips, CELL_PX, where))
    tables.write_markdown(config.out / "spread.md", means, where, NOTES)
    return means


def setup_of(config: SpreadBench) -> Setup:
    """Settings that decide the cases."""
    return Setup(
        data=config.meshes,
        environments=config.environments,
        objects=config.objects,
        held_out=not config.tuning,
        size=config.size,
        detail=1,
        truth="surfels",
        rows=config.rows,
        novel_views=config.novel_views,
        lights=1,
        seed=config.seed,
    )


def measure_case(case: SpreadCase, threshold: float | None = None) -> tuple[list[SpreadScore], list[Strip]]:
    """A line per stroke, and the rows of the contact sheet, the truth's first."""
    from splatpainter.spread.options import SPREAD_DEFAULTS, SpreadOptions

    options = SPREAD_DEFAULTS if threshold is None else SpreadOptions(threshold)
    painter = Painter(settings=EditSettings(spread_options=options))
    asset = painter.encode(case.asset, "lift", ("local",))
    lines = []
    strips = [Strip(f"{case.name}: the truth", _cells(case.picture / 255, case.after))]
    for stroke in get_args(Stroke):
        edit = Edit(case.picture, case.camera, case.masks[stroke])
        lifted = painter.apply(asset, [edit]).splats
        start = time.process_time()
        result = painter.apply(asset, [edit], "spread")
        seconds = time.process_time() - start
        assert result.confidence is not None and result.receipt is not None
        reached = result.confidence[: len(case.asset)] >= options.threshold
        views, lift_views = drawn(result.splats, case), drawn(lifted, case)
        same = (np.abs(case.after - case.before).max(-1) < MAX_REST_CHANGE) & _object(case)
        line = SpreadScore(
            case.name,
            stroke,
            case.facts["materials"],
            case.facts["separable"],
            surface_iou(case.asset, reached, case.share > 0.5),
            masked_psnr(lift_views[1:], case.after, case.unseen),
            masked_psnr(views[1:], case.after, case.unseen),
            masked_psnr(views[1:], case.after, same),
            masked_psnr(lift_views[1:], case.after, same),
            "middle of the material" in result.receipt.note,
            seconds,
        )
        lines.append(line)
        strips.append(Strip(_caption(line), _cells(views[0], views[1:])))
    return lines, strips


def surface_iou(splats: Splats, reached: np.ndarray, truth: np.ndarray) -> float:
    """0..1 intersection over union of two sets of Gaussians ([N] bool), each weighing its opacity times its area."""
    scales = np.sort(splats.scales.astype(np.float64), axis=1)
    area = splats.opacities * scales[:, 1] * scales[:, 2]
    return float(area[reached & truth].sum() / max(area[reached | truth].sum(), 1e-300))


def masked_psnr(views: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float | None:
    """dB over all masked pixels of all views together; None for fewer than MIN_UNSEEN_PX."""
    if mask.sum() < MIN_UNSEEN_PX:
        return None
    error = float(((views[mask].astype(np.float64) - truth[mask]) ** 2).mean())
    return -10 * float(np.log10(max(error, 1e-10)))


def drawn(splats: Splats, case: SpreadCase) -> np.ndarray:
    """[1 + W, H, W, 3] the edited view and the novel ones, 0..1."""
    from splatpainter.rendering import render

    return np.clip(render(splats, [case.camera, *case.cameras]).colors, 0, 1)


def _object(case: SpreadCase) -> np.ndarray:
    """[W, H, W] bool: what is not exactly background."""
    background = np.array([camera.background for camera in case.cameras], np.float32)[:, None, None]
    return np.asarray((np.abs(case.before - background) > 1e-3).any(-1))


def mean_scores(scores: Sequence[SpreadScore]) -> list[SpreadMeans]:
    """A line per stroke: all, and those of separable materials."""
    rows = []
    for stroke in get_args(Stroke):
        for name, least in (("all", 0.0), ("separable", SEPARABLE)):
            group = [score for score in scores if score.stroke == stroke and score.separable >= least]
            if not group:
                continue
            means: dict[str, float | None] = {}
            for column in ("iou", "lift", "spread", "rest", "rest_lift", "reached_partial", "seconds"):
                values = [float(value) for score in group if (value := getattr(score, column)) is not None]
                means[column] = float(np.mean(values)) if values else None
            pairs = [s.spread - s.lift for s in group if s.spread is not None and s.lift is not None]
            gain = float(np.mean(pairs)) if pairs else None
            median = float(np.median([score.iou for score in group]))
            rows.append(SpreadMeans(stroke, name, len(group), iou_median=median, gain=gain, **means))  # type: ignore[arg-type]
    return rows


def _cells(edited: np.ndarray, novel: np.ndarray) -> tuple[tuple[str, np.ndarray], ...]:
    return (("edited view", edited), *((f"novel view {k + 1}", view) for k, view in enumerate(novel)))


def _caption(line: SpreadScore) -> str:
    cells = ", ".join(f"{name} {tables.cell_text(getattr(line, name))}" for name in ("iou", "lift", "spread", "rest"))
    return f"{line.stroke}: {cells}"
