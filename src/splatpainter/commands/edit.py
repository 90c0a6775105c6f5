"""`splatpainter edit`: the main job. Edited pictures in; edited asset and receipt out, verified before they appear."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from splatpainter.captures import is_capture
from splatpainter.commands import Outcome
from splatpainter.commands.asset_doubts import warn_of_doubts
from splatpainter.commands.decal_options import DecalView, decal_from_options, paint_decal
from splatpainter.commands.option_parsing import AssetFile, AxesOption, CameraFiles, FrameOption, OutFile
from splatpainter.commands.output_paths import check_target
from splatpainter.commands.sourced_edit import (
    check_source_options,
    keeping_answers,
    paint_from_source,
    plan_lines,
    source_from_options,
)
from splatpainter.commands.terminal import count, decibels, seconds, stages, warn
from splatpainter.commands.verified_write import check_outputs, proved_record, write_proved
from splatpainter.commands.verify import same_words
from splatpainter.doubts import doubts_of_view
from splatpainter.gatekeeper.gatekeeper import Strictness
from splatpainter.gatekeeper.photographs import laid_over, picture_edit
from splatpainter.gatekeeper.picture_gate import checked_picture
from splatpainter.image_files import write_png
from splatpainter.io import read
from splatpainter.lift.options import LOCAL_DEFAULTS
from splatpainter.nn.precision import Precision
from splatpainter.painter import MAX_VIEWS, Asset, Method, Mode, Painter
from splatpainter.pictures import FileEdit
from splatpainter.receipts import Receipt, Verification, receipt_of
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.decals.decals import Decal


@dataclass(frozen=True)
class Config:
    """Write edited pictures of an asset onto the asset. Gaussians that the edit does not reach stay as they are, byte
    for byte where the format allows it, and the receipt proves it.

    Pictures: PNG, JPEG, WebP, TIFF, OpenEXR, PSD, OpenRaster or Krita, painted on what `splatpainter render` made, or
    on a photograph that the asset was made from. Transparent pixels mean: unchanged. Later pictures win where several
    disagree.

    example:
      splatpainter edit vase.ply views/view_000.png --out painted.ply
      splatpainter edit vase.ply warm.png --mode global --out warm.ply
      splatpainter edit garden photo.jpg --camera data/sparse/0 --out painted.ply
      splatpainter edit vase.ply red_lid.png --mode spread --spread-confidence sure.png --out red.ply
      splatpainter edit vase.ply --decal label.png --at 400,300 --camera cam.json --width 20% --out new.ply
      splatpainter edit vase.ply --source gemini --prompt "mossy stone" --views auto --out mossy.ply
    """

    asset: AssetFile
    """The splat file to edit, or a folder of INRIA's trainer (its last iteration); it is not changed."""
    out: OutFile
    """The file to write; its name says the format."""
    pictures: Annotated[Positional[tuple[Path, ...]], arg(metavar="VIEW.png ...", help_behavior_hint="")] = ()
    """1 to 16 edited pictures of ASSET; none with a decal or a source."""
    frame: FrameOption = "auto"
    """Axes of ASSET's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    axes: AxesOption = "auto"
    """Axes of OUT's numbers; auto: those of ASSET if both are of one format, else what OUT's format has."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row; what is left of the cut part is kept."""
    camera: CameraFiles = ()
    """Cameras of the pictures, in their order, where the pictures lost theirs: CAM.json, the view that was painted on,
    or a folder of views, of which the one counts that the picture matches. For photographs of a capture: cameras.json,
    transforms.json or COLMAP's sparse/0, with :N (a number or a name) where the picture has another name than the
    photograph. Default: what the picture says, or NAME.json beside it, or the capture in ASSET's folder, or the view
    beside the picture or beside ASSET that it matches."""
    mask: Annotated[tuple[Path, ...], arg(metavar="M.png ...", help_behavior_hint="")] = ()
    """Masks of the pictures, in their order: what is not black was edited. Default: what differs from the asset."""
    correct: bool = False
    """Put pictures right first: what a mistake did to all of one (another gamma, a mirror, a grade) is undone, and it
    is laid over its view, its colours corrected and cut to what was painted, as a source's picture is
    (--source-strictness)."""
    force: bool = False
    """Paint with a picture as it is, also where it differs from its view everywhere or was compressed hard."""
    mode: Mode = "local"
    """local: only what was painted changes. global: a regraded or relit picture changes the whole asset. spread: the
    painted material changes all around, also where the pictures do not show it."""
    spread_threshold: float | None = None
    """Mode spread: confidence (0 to 1) from which a Gaussian counts as the painted material; lower reaches further.
    Default: 0.5."""
    spread_confidence: Annotated[Path | None, arg(metavar="C.png", help_behavior_hint="")] = None
    """Mode spread: write a picture of this confidence, from the first edited view and from behind (green: sure, yellow:
    at the threshold, red and blue: not reached). With --dry-run nothing else is written."""
    method: Method = "auto"
    """Method of the edit: lift (analytic, under a second), fit (the lift, then some seconds of optimisation: nearer to
    the picture, local edits only), ttt (the networks of PRESET); auto: ttt where trained weights are better, else
    lift."""
    preset: Annotated[str, arg(metavar="NAME|DIR")] = "auto"
    """Weights: compact, rows, paper, a folder of weights, or lift (none); auto: compact where its weights are, else
    lift."""
    precision: Precision = "auto"
    """Arithmetic of the networks; auto: what SPLATPAINTER_PRECISION says, else bfloat16 where the machine has it."""
    angle_limit: float = LOCAL_DEFAULTS.angle_limit
    """Degrees between the line of sight and the surface's normal from which paint of a local edit fades; 0: no
    limit."""
    depth_edge_limit: float = LOCAL_DEFAULTS.depth_edge_limit
    """Pixels beside an edge in depth that a local edit leaves out; 0: none."""
    polish: bool = False
    """After the networks, two colour rounds of the lift: nearer to the picture, further from what the networks have
    learnt."""
    decal: Annotated[Path | None, arg(metavar="PICTURE", help_behavior_hint="")] = None
    """Instead of VIEW: a picture to lay on the surface, unwrapped over it; what is transparent stays as it is."""
    decal_text: Annotated[str, arg(metavar="WORD", help_behavior_hint="")] = ""
    """... or a text to lay on the surface."""
    decal_font: Annotated[Path | None, arg(metavar="F.ttf", help_behavior_hint="")] = None
    """Font of the text, TrueType or OpenType."""
    decal_color: Annotated[str, arg(metavar="#RRGGBB")] = "#202020"
    """Colour of the text."""
    at: Annotated[str, arg(metavar="X,Y", help_behavior_hint="")] = ""
    """Pixel of the camera's picture (--camera CAM.json) under which the decal's centre lies on the surface."""
    width: Annotated[str, arg(metavar="LENGTH|PERCENT", help_behavior_hint="")] = ""
    """Width of the decal along the surface: world units, or a percentage of the asset's diameter, like 12%."""
    angle: float = 0.0
    """Degrees by which the decal is turned, counter-clockwise as seen from outside; at 0 its up is the camera's."""
    wrap: float = 180.0
    """Degrees by which the surface may turn away under the decal; 180: no limit."""
    source: Annotated[str, arg(metavar="NAME", help_behavior_hint="")] = ""
    """Instead of VIEW: a view is rendered and sent to this picture source (`splatpainter source list`), whose picture
    is registered, corrected and cut to what changed."""
    prompt: Annotated[str, arg(metavar="TEXT", help_behavior_hint="")] = ""
    """What the source should do to the view."""
    view: Annotated[Path | None, arg(metavar="CAM.json", help_behavior_hint="")] = None
    """Camera of the view that is sent; default: --azimuth 0 --elevation 15, as the first picture of `render`."""
    azimuth: Annotated[float | None, arg(metavar="DEGREES", help_behavior_hint="")] = None
    """... or its direction: degrees around the asset."""
    elevation: Annotated[float | None, arg(metavar="DEGREES", help_behavior_hint="")] = None
    """... and degrees above the horizon."""
    size: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Pixels of the longer side of the views that are sent; default: 800, or what --view says."""
    views: Annotated[Literal["", "auto"], arg(metavar="auto", help_behavior_hint="")] = ""
    """auto: one view after another, each for surface that no earlier one showed, until the surface is covered."""
    max_views: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Most views of --views auto; default: 8."""
    reference: Annotated[tuple[Path, ...], arg(metavar="PICTURE ...", help_behavior_hint="")] = ()
    """Reference pictures for the source."""
    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Random seed, for sources that take one."""
    enlarge: int = 1
    """Factor by which the source enlarges the view; the edit is made at that size."""
    source_option: Annotated[tuple[str, ...], arg(metavar="KEY=VALUE ...", help_behavior_hint="")] = ()
    """Options of the source; `splatpainter source list` names them. Keys come from the environment alone."""
    source_strictness: Strictness = "normal"
    """Which pictures of a source, and painted photographs, are refused. strict: edges agree by less than 0.7 of 1,
    moved by over 1 %, turned by over 0.5 degrees, 0.25 stops off, over 10 % changed outside the mask, or cropped;
    normal: less than 0.38, over 10 %, 6 degrees, 1.5 stops; loose: less than 0.2, over 30 %, 12 degrees."""
    source_report: Annotated[Path | None, arg(metavar="REPORT.png", help_behavior_hint="")] = None
    """Write a sheet of pictures: sent, received, mask, used, difference."""
    dry_run: bool = False
    """Print which views would be sent and how many paid calls that makes (with mode spread: how far it reaches); send
    and write nothing."""
    receipt: Annotated[Path | None, arg(metavar="R.json", help_behavior_hint="")] = None
    """Where the receipt goes; default: OUT.receipt.json."""
    overwrite: bool = False
    """Replace OUT and the receipt if they exist."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Check everything that can be checked for nothing, then read, paint, write, verify."""
    receipt_path = config.receipt or receipt_of(config.out)
    _check(config, receipt_path)
    decal, source_edit = _decal(config), source_from_options(config)
    if source_edit is not None and config.dry_run:
        return Outcome(*plan_lines(read(config.asset, frame=config.frame, lenient=config.lenient).numpy(), source_edit))
    pictures = _pictures(config)
    sources: Sequence[FileEdit | DecalView]
    clock = time.perf_counter()
    answers = keeping_answers(None if source_edit is None else source_edit.source, config.out)
    with answers, stages(4) as bar:
        painter = _painter(config)
        sources = pictures = _of_size(pictures, config.mode, config.method, painter)
        bar.enter("reading")
        splats = read(config.asset, frame=config.frame, lenient=config.lenient)
        read_seconds = time.perf_counter() - clock
        doubtful = warn_of_doubts(splats, config.asset, editing=True)
        _check_views(pictures, splats)
        _warn_of_other_assets(pictures, splats)
        sources = pictures = _checked(pictures, splats, config)
        bar.enter("painting")
        if decal is not None:
            edited, sources = paint_decal(splats, decal, config.method, painter)
        elif source_edit is not None:
            edited, sources = paint_from_source(splats, source_edit, painter)
        else:
            edited = paint(splats, pictures, config.mode, config.method, painter)
        assert edited.receipt is not None
        if config.spread_confidence is not None:
            _write_confidence(config.spread_confidence, splats, edited, pictures, painter)
        if config.dry_run:
            return _reached(config, edited.receipt)
        receipt, verification = write_proved(splats, edited, config.out, receipt_path, config.axes, bar, read_seconds)
    rounded = len(receipt.touched) - len(edited.receipt.touched)
    return Outcome(
        _record(config, receipt_path, receipt, verification, sources) | {"doubts": doubtful},
        _lines(config, receipt, verification, sources, rounded),
    )


def _write_confidence(
    path: Path, splats: Splats, edited: Asset, pictures: Sequence[FileEdit], painter: Painter
) -> None:
    from splatpainter.spread.options import SPREAD_DEFAULTS
    from splatpainter.spread.overlay import confidence_picture

    assert edited.confidence is not None
    arrays, threshold = splats.numpy(), (painter.spread_options or SPREAD_DEFAULTS).threshold
    confidence = edited.confidence[: len(arrays)]
    write_png(path, confidence_picture(arrays, confidence, threshold, pictures[0].camera.within(splats.offset)))


def _reached(config: Config, receipt: Receipt) -> Outcome:
    """What a dry run in mode spread prints."""
    record = {"touched_rows": len(receipt.touched), "rows": receipt.asset_rows, "note": receipt.note}
    lines = [f"{config.asset}: nothing is written", *(f"note: {note}" for note in receipt.note.split("; ") if note)]
    lines.append(f"{len(receipt.touched):,} of {count(receipt.asset_rows, 'Gaussian')} would change")
    return Outcome(record | {"confidence": config.spread_confidence}, lines)


def paint(splats: Splats, sources: list[FileEdit], mode: Mode, method: Method, painter: Painter | None = None) -> Asset:
    """The asset after the pictures. painter: by default that of preset "auto"."""
    painter = painter or Painter.load(modes=[mode])
    asset = painter.encode(splats, method, [mode])
    edits = [source.edit(splats, mode) for source in _of_size(sources, mode, method, painter)]
    return painter.apply(asset, edits, mode, method)


def _of_size(sources: list[FileEdit], mode: Mode, method: Method, painter: Painter) -> list[FileEdit]:
    """The pictures at the size at which they are edited with: networks want one size, and looks need no detail."""
    if mode == "global" or painter.choose(method, mode)[0] == "ttt":
        return [source.at_view() for source in sources]
    return sources


def _painter(config: Config) -> Painter:
    """Before anything is read that takes time: weights that are missing or wrong are the likeliest complaint."""
    _refuse_idle_networks(config)
    painter = Painter.load(config.preset, modes=[config.mode], polish=config.polish, precision=config.precision)
    limits = {"angle_limit": config.angle_limit, "depth_edge_limit": config.depth_edge_limit}
    painter = replace(painter, aside=True, local_options=replace(LOCAL_DEFAULTS, **limits))
    if config.spread_threshold is not None:
        from splatpainter.spread.options import SpreadOptions

        painter = replace(painter, spread_options=SpreadOptions(config.spread_threshold))
    method, reason = painter.choose(config.method, config.mode)
    if method == "ttt" and painter.model is not None and painter.model.config.representation == "copy":
        raise ValueError(
            f"preset '{painter.preset}': paints on a copy of the asset (representation copy), of which no "
            "Gaussian could be verified; use it from Python, or a preset of representation native"
        )
    if config.polish and method != "ttt":
        remark = f" ({reason})" if config.method == "ttt" else ""
        raise ValueError(f"splatpainter edit: --polish is for method ttt alone: it adds rounds of the lift{remark}")
    return painter


def _refuse_idle_networks(config: Config) -> None:
    """Raises ValueError where networks are asked for that would leave the edit to the lift; their weights are not
    read for that."""
    from splatpainter.models import checkpoint, weights

    if config.method != "ttt" or config.mode != "local":
        return
    folder = weights.find("compact" if config.preset == "auto" else config.preset) or Path(config.preset)
    if (folder / checkpoint.INDEX).is_file() and not checkpoint.config(folder).edits_locally:
        raise ValueError(
            f"splatpainter edit: --method ttt: the networks of preset '{config.preset}' make global edits alone, so "
            "that the lift would make this one; use --method lift, or weights of train refine"
        )


def _check(config: Config, receipt_path: Path) -> None:
    check_source_options(config)
    decal = config.decal is not None or bool(config.decal_text)
    if config.source and (decal or config.pictures or config.camera):
        raise ValueError(
            "splatpainter edit: a source takes the place of pictures (VIEW.png), their --camera and decals; the view "
            "that is sent is --view CAM.json"
        )
    if decal and (config.pictures or config.mask):
        raise ValueError(
            "splatpainter edit: a decal takes the place of pictures (VIEW.png) and masks; give one or the other"
        )
    if decal and (config.mode != "local" or config.method == "ttt"):
        raise ValueError("splatpainter edit: a decal is an edit of mode local by method lift or fit")
    if config.mode != "spread" and (config.spread_threshold, config.spread_confidence) != (None, None):
        raise ValueError("splatpainter edit: --spread-threshold and --spread-confidence are for --mode spread")
    if config.source and config.mode == "spread":
        raise ValueError("splatpainter edit: a source's picture is painted in mode local or global, not spread")
    if (config.correct or config.force) and (decal or config.source):
        raise ValueError("splatpainter edit: --correct and --force are for pictures (VIEW.png), no source or decal")
    if config.correct and config.force:
        raise ValueError("splatpainter edit: expected one of --correct and --force")
    if config.spread_confidence is not None:
        check_target(config.spread_confidence, config.overwrite, [config.asset], config.pictures)
    if not (decal or config.source) and not 1 <= len(config.pictures) <= MAX_VIEWS:
        count = len(config.pictures) or "none"
        raise ValueError(f"splatpainter edit: expected 1 to {MAX_VIEWS} pictures (VIEW.png) after ASSET, got {count}")
    for name, given in (("--camera", _cameras(config)), ("--mask", config.mask)):
        if given and len(given) != len(config.pictures) and not (decal or config.source):
            expected = f"as many {name} files as pictures ({len(config.pictures)})"
            raise ValueError(f"splatpainter edit: expected {expected}, got {len(given)}")
    pictures = [*config.pictures, *config.camera, *config.mask, *config.reference]
    pictures += filter(None, [config.decal, config.decal_font, config.view])
    check_outputs(config.out, receipt_path, config.overwrite, config.asset, pictures)


def _decal(config: Config) -> Decal | None:
    text = (config.decal_text, config.decal_font, config.decal_color)
    return decal_from_options(
        config.decal, *text, config.at, config.camera, config.width, config.angle, config.wrap, config.asset
    )  # fmt: skip


def _cameras(config: Config) -> tuple[Path, ...]:
    """--camera of each picture; one capture serves for all, each finds its view there by its name."""
    if len(config.camera) == 1 and is_capture(config.camera[0]):
        return config.camera * max(len(config.pictures), 1)
    return config.camera


def _pictures(config: Config) -> list[FileEdit]:
    if config.source:  # its mask is that of the view that is sent
        return []
    cameras = _cameras(config) or (None,) * len(config.pictures)
    masks = config.mask or (None,) * len(config.pictures)
    folders = (config.asset.parent, config.asset.parent / "views")  # where `render` was likely told to put them
    return [
        picture_edit(*files, config.asset, folders)
        for files in zip(config.pictures, cameras[: len(config.pictures)], masks, strict=True)
    ]


def _checked(pictures: list[FileEdit], splats: Splats, config: Config) -> list[FileEdit]:
    """The pictures as they are painted with. Raises ValueError for one that differs from its view everywhere."""
    policy = "correct" if config.correct else "force" if config.force else "refuse"
    painted = [laid_over(picture, splats, config.mode, config.source_strictness) for picture in pictures]
    checked = [checked_picture(picture, splats, config.mode, policy, config.source_strictness) for picture in painted]
    for picture in checked:
        if picture.warning:
            warn(picture.warning)
    return [picture.source for picture in checked]


def _warn_of_other_assets(sources: list[FileEdit], splats: Splats) -> None:
    for source in sources:
        made_for = source.camera.asset_sha256
        if made_for is not None and made_for != splats.sha256:
            other = f"another asset (sha256 {made_for[:12]}...)"
            warn(f"{source.path}: was rendered from {other}; differences count as paint")


def _check_views(sources: list[FileEdit], splats: Splats) -> None:
    """Raises ValueError where a picture's camera sees nothing of the asset: an edit of it would reach nothing."""
    for source in sources:
        for doubt in doubts_of_view(splats, source.camera, str(source.path)):
            raise ValueError(doubt.line)


def _record(
    config: Config, path: Path, receipt: Receipt, verification: Verification, sources: Sequence[FileEdit | DecalView]
) -> dict:
    notes = [f"{source.path}: {note}" for source in sources for note in source.notes]
    return {**proved_record(config.out, path, receipt, verification), "notes": notes}


def _lines(
    config: Config,
    receipt: Receipt,
    verification: Verification,
    sources: Sequence[FileEdit | DecalView],
    rounded: int,
) -> list[str]:
    lines = [f"{config.asset} -> {config.out}"]
    lines += [f"{source.path}: {note}" for source in sources for note in source.notes]
    lines += [f"frame: {verification.frame}"] if verification.frame_is_news else []
    weights = f" with preset {receipt.preset}" if receipt.preset != "lift" else ""
    rounding = f", in {receipt.precision}" if receipt.precision else ""
    lines.append(f"method {receipt.method}{weights}, mode {receipt.mode}{rounding}")
    lines += [f"note: {note}" for note in receipt.note.split("; ") if note]
    for source, view in zip(sources, receipt.views, strict=True):
        inside = f"{decibels(view.psnr_before)} -> {decibels(view.psnr_after)} against the picture, where it was edited"
        lines.append(f"{source.path}: {inside}; elsewhere {decibels(view.psnr_outside)} against before")
    for source, (psnr, share) in zip(sources, receipt.aside, strict=False):
        if psnr is not None:
            lines.append(f"{source.path}: {decibels(psnr)} seen from the side, {100 * share:.0f} % of the paint")
    again = f", {rounded:,} more rounded anew by the format" if rounded else ""
    sheet = (
        f" (of them {len(receipt.replaced):,} replaced and {len(receipt.removed):,} removed under a sheet)"
        if len(receipt.replaced) + len(receipt.removed)
        else ""
    )
    changed = count(len(receipt.touched) - rounded, "Gaussian")
    lines.append(f"{changed} changed{sheet}{again}, {receipt.appended_rows:,} appended")
    lines.append(
        f"{verification.same:,} of {count(verification.rows, 'Gaussian')} {same_words(verification)}, verified"
    )
    lines.append(seconds(receipt.seconds))
    return lines
