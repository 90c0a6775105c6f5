"""Edits of `splatpainter edit` whose pictures a source makes: its options, its progress and Ctrl-C, the plan of a dry
run, and the asset that comes of it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from splatpainter.atomic import brief_name, writing
from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.commands.decal_options import DecalView
from splatpainter.commands.output_paths import check_target
from splatpainter.commands.terminal import complain, count, warn, watched
from splatpainter.commands.view_options import BACKGROUND, color, given_camera
from splatpainter.gatekeeper.gatekeeper import RefusedPicture, Strictness
from splatpainter.image_files import CAMERA_KEYWORD, encode_png, quantized
from splatpainter.painter import MAX_VIEWS, Asset, Method, Mode, Painter
from splatpainter.rendering import MAX_SIDE_PX
from splatpainter.source_edits.coverage import ViewPlan, plan_views
from splatpainter.source_edits.edit import cover, edit_view
from splatpainter.source_edits.view_edit import SourceBrief, SourcedEdit
from splatpainter.sources.picture_source import (
    CancelFlag,
    PictureAnswer,
    PictureRequest,
    PictureSource,
    Progress,
    SourceError,
)
from splatpainter.splats import Splats

COMMAND = "splatpainter edit"
POLL_SECONDS = 0.1
"""Seconds between two looks at whether a source has answered."""
MAX_ANSWER_FILES = 1000
"""Names OUT.answer_1.png ... that are tried."""
CANCEL_SECONDS = 15.0
"""A source that was told to stop is waited for at most so long."""


class SourceConfig(Protocol):
    """The options of `edit` that are read here; commands/edit.py says what they mean."""

    @property
    def asset(self) -> Path: ...
    @property
    def source(self) -> str: ...
    @property
    def source_option(self) -> tuple[str, ...]: ...
    @property
    def prompt(self) -> str: ...
    @property
    def view(self) -> Path | None: ...
    @property
    def azimuth(self) -> float | None: ...
    @property
    def elevation(self) -> float | None: ...
    @property
    def size(self) -> int | None: ...
    @property
    def views(self) -> str: ...
    @property
    def max_views(self) -> int | None: ...
    @property
    def mask(self) -> tuple[Path, ...]: ...
    @property
    def reference(self) -> tuple[Path, ...]: ...
    @property
    def seed(self) -> int | None: ...
    @property
    def enlarge(self) -> int: ...
    @property
    def source_strictness(self) -> Strictness: ...
    @property
    def source_report(self) -> Path | None: ...
    @property
    def out(self) -> Path: ...
    @property
    def dry_run(self) -> bool: ...
    @property
    def mode(self) -> Mode: ...
    @property
    def method(self) -> Method: ...
    @property
    def overwrite(self) -> bool: ...


@dataclass(frozen=True)
class SourceJob:
    """A source and what it is asked, with every file read."""

    source: InterruptibleSource
    brief: SourceBrief
    camera: Camera | None
    """Camera of --view; None: of azimuth and elevation, or chosen by the plan."""
    mask: np.ndarray | None
    """[h, w] 0..1 of any size, white where the picture may change."""
    config: SourceConfig

    def view_camera(self, splats: Splats) -> Camera:
        """The view that is rendered and sent, of a single edit."""
        if self.camera is not None:
            return self.camera.relative_to(splats.offset)
        config = self.config
        return orbit_cameras(
            splats,
            1,
            size=config.size or 800,
            azimuth=config.azimuth or 0.0,
            elevation=15.0 if config.elevation is None else config.elevation,
            background=color(BACKGROUND, splats),
        )[0]

    def plan(self, splats: Splats) -> ViewPlan:
        """The views of --views auto, or the one view."""
        first = None if self.camera is None else self.camera.relative_to(splats.offset)
        if first is None and (self.config.azimuth is not None or self.config.elevation is not None):
            first = self.view_camera(splats)
        if self.config.views != "auto":
            return ViewPlan((self.view_camera(splats),), (0.0,))
        return plan_views(
            splats,
            size=self.config.size or 800,
            max_views=self.config.max_views or 8,
            first=first,
            background=color(BACKGROUND, splats),
        )


def source_from_options(config: SourceConfig) -> SourceJob | None:
    """The source and what it is asked, or None where no --source is given. Raises ValueError, one line naming the
    option: a source that is not there, files that cannot be read."""
    if not config.source:
        return None
    from splatpainter.pictures.picture_reader import read_picture
    from splatpainter.sources.registry import open_source
    from splatpainter.sources.source_options import option_words

    references = tuple(read_picture(path).colors for path in config.reference)
    brief = SourceBrief(config.prompt, references, config.seed, config.enlarge, config.source_strictness)
    camera = None if config.view is None else given_camera(config.view, config.size, config.asset)
    mask = _mask(config.mask[0]) if config.mask else None
    source = InterruptibleSource(open_source(config.source, option_words(config.source_option)))
    return SourceJob(source, brief, camera, mask, config)


def paint_from_source(splats: Splats, request: SourceJob, painter: Painter) -> tuple[Asset, list[DecalView]]:
    """(the edited asset, one entry per view of its receipt). Ctrl-C cancels the source's work before it goes on.
    Raises SourceError and what `Painter.apply` raises."""
    config, cancel = request.config, threading.Event()
    asset = painter.encode(splats, config.method, [config.mode])
    source = request.source
    try:
        with SourceBar() as bar:
            if config.views == "auto":
                plan = request.plan(asset.splats)
                sourced = cover(
                    painter,
                    asset,
                    source,
                    request.brief,
                    plan,
                    method=config.method,
                    progress=bar,
                    cancel=cancel,
                )
            else:
                camera = request.view_camera(asset.splats)
                sourced = edit_view(
                    painter,
                    asset,
                    source,
                    request.brief,
                    camera,
                    _fitted(request.mask, camera),
                    mode=config.mode,
                    method=config.method,
                    progress=bar,
                    cancel=cancel,
                )
    except ValueError:  # a refused picture is what a report is looked at for
        _write_report(request, ())
        raise
    _write_report(request, sourced.edits)
    entries = [
        DecalView(edit.edit.name, notes)
        for edit, notes in zip(sourced.edits, notes_of_views(sourced.edits), strict=True)
    ]
    answers = source.write_answers(config.out, sourced.edits)  # of views that the receipt's note names
    for line in _answers_line(answers):
        warn(line)
    return sourced.asset, entries


def notes_of_views(edits: Sequence[SourcedEdit]) -> list[tuple[str, ...]]:
    """Notes of each view; what all of several have in common is listed once."""
    common = [note for note in edits[0].notes if len(edits) > 1 and all(note in edit.notes for edit in edits)]
    notes = [tuple(note for note in edit.notes if note not in common) for edit in edits]
    return [(*(f"{note} (all {len(edits)} views)" for note in common), *notes[0]), *notes[1:]]


def plan_lines(splats: Splats, request: SourceJob) -> tuple[dict, list[str]]:
    """(record, lines) of a dry run: which views would be sent, and how many calls that are; nothing is asked."""
    plan = request.plan(splats)
    paid = request.source.capabilities.paid
    calls = count(len(plan.cameras), "paid call" if paid else "call")
    lines = [f"{request.source.name}: {calls}{'' if paid else ', not paid'}; nothing was sent"]
    record: dict = {"source": request.source.name, "calls": len(plan.cameras), "paid": paid, "views": []}
    for number, (camera, gain) in enumerate(zip(plan.cameras, plan.gains, strict=True), 1):
        eye = [round(float(value), 3) for value in camera.relative_to((0.0, 0.0, 0.0)).position]
        record["views"].append({"width": camera.width, "height": camera.height, "eye": eye, "adds": round(gain, 4)})
        adds = f", reaches {100 * gain:.1f} % of the surface for the first time" if request.config.views else ""
        lines.append(f"view {number}: {camera.width} x {camera.height} from {eye[0]:g}, {eye[1]:g}, {eye[2]:g}{adds}")
    if request.config.views:
        record["covered"] = round(plan.covered, 4)
        lines.append(f"together {100 * plan.covered:.1f} % of the surface that any direction shows")
    return record, lines


class InterruptibleSource:
    """A source that works in a thread, so that Ctrl-C reaches it as `cancel` at once. It keeps what came back: a
    picture that cannot be painted was made, and often paid for, all the same."""

    def __init__(self, source: PictureSource) -> None:
        self._source = source
        self.name, self.capabilities = source.name, source.capabilities
        self.answers: list[tuple[PictureRequest, PictureAnswer]] = []

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """Edit as the source does. An interrupt cancels it, waits for its end and goes on."""
        stop, done, outcome = threading.Event(), threading.Event(), []

        class AnyCancelFlag:
            def is_set(self) -> bool:
                return stop.is_set() or cancel.is_set()

        def work() -> None:
            try:
                outcome.append(self._source.edit(request, progress, AnyCancelFlag()))
            except BaseException as error:  # raised again below, where somebody waits for it
                outcome.append(error)
            done.set()

        threading.Thread(target=work, name=f"source {self.name}", daemon=True).start()
        try:
            while not done.wait(POLL_SECONDS):  # and not join, which forgets a thread when it is interrupted
                pass
        except BaseException:
            stop.set()
            done.wait(CANCEL_SECONDS)
            raise
        (result,) = outcome
        if isinstance(result, BaseException):
            raise result
        self.answers.append((request, result))
        return result

    def write_answers(self, out: Path, painted: Sequence[SourcedEdit] = ()) -> list[Path]:
        """Write what came back and was not painted beside OUT, as OUT.answer_1.png and so on with their cameras inside,
        over no file that is there. Returns their names; none where they cannot be written."""
        paths: list[Path] = []
        for request, answer in self.answers:
            if any(edit.answer is answer for edit in painted):
                continue
            stem = brief_name(out.name)
            names = (out.with_name(f"{stem}.answer_{number}.png") for number in range(1, MAX_ANSWER_FILES))
            path = next((name for name in names if not name.exists()), None)
            carried = {CAMERA_KEYWORD: request.camera.to_json()} if request.camera is not None else None
            with contextlib.suppress(OSError, ValueError):
                if path is not None:
                    with writing(path) as file:
                        file.write(encode_png(quantized(answer.image), carried))
                    paths.append(path)
        return paths


@contextlib.contextmanager
def keeping_answers(source: InterruptibleSource | None, out: Path) -> Iterator[None]:
    """Where the block fails, what the source answered is written beside OUT, and the error says where."""
    try:
        yield
    except BaseException as error:
        lines = [] if source is None else _answers_line(source.write_answers(out))
        if lines and type(error) in (ValueError, SourceError, RefusedPicture):
            raise type(error)(f"{error}; {lines[0]}") from None
        for line in lines:
            complain(line)
        raise


def _answers_line(paths: Sequence[Path]) -> list[str]:
    return [f"what came back is kept: {', '.join(map(str, paths))}"] if paths else []


class SourceBar:
    """Progress of a source on stderr, where a person is looking."""

    def __init__(self) -> None:
        self._bar = None

    def __enter__(self) -> SourceBar:
        if watched():
            import sys

            from tqdm import tqdm

            form = "{desc:<40} {bar} [{elapsed}]"
            self._bar = tqdm(total=1.0, leave=False, file=sys.stderr, bar_format=form)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, share: float, words: str) -> None:
        if self._bar is not None:
            self._bar.n = min(max(share, 0.0), 1.0)
            self._bar.set_description_str(words[:40])


def check_source_options(config: SourceConfig) -> None:
    """Raises ValueError, one line naming the option: options without a source, or that do not go together."""
    needed = {
        "--prompt": bool(config.prompt),
        "--view": config.view is not None,
        "--azimuth": config.azimuth is not None,
        "--elevation": config.elevation is not None,
        "--size": config.size is not None,
        "--views": bool(config.views),
        "--max-views": config.max_views is not None,
        "--reference": bool(config.reference),
        "--seed": config.seed is not None,
        "--enlarge": config.enlarge != 1,
        "--source-option": bool(config.source_option),
        "--source-report": config.source_report is not None,
        "--dry-run": config.dry_run,
    }
    if not config.source:
        for option, given in needed.items():
            if given and not (option == "--dry-run" and config.mode == "spread"):
                raise ValueError(f"{COMMAND}: {option} is for pictures that a source makes; give --source NAME too")
        return
    if config.view is not None and (config.azimuth is not None or config.elevation is not None):
        raise ValueError(f"{COMMAND}: expected --view, or --azimuth and --elevation, got both")
    if len(config.mask) > 1 or (config.mask and config.views):
        limit = "no --mask with --views auto, which makes its own" if config.views else "at most one --mask"
        raise ValueError(f"{COMMAND}: expected {limit}, got {len(config.mask)}")
    if config.views and config.mode != "local":
        raise ValueError(f"{COMMAND}: --views auto is for --mode local; one view is enough for --mode global")
    if config.max_views is not None and not (config.views and 1 <= config.max_views <= MAX_VIEWS):
        raise ValueError(f"{COMMAND}: expected --max-views from 1 to {MAX_VIEWS}, with --views auto")
    if not 16 <= (config.size or 800) <= MAX_SIDE_PX:
        raise ValueError(f"{COMMAND}: expected --size from 16 to {MAX_SIDE_PX}, got {config.size}")
    if not -90 <= (config.elevation or 0) <= 90:
        raise ValueError(f"{COMMAND}: expected --elevation from -90 to 90, got {config.elevation:g}")
    if config.source_report is not None:
        check_target(config.source_report, config.overwrite)


def _mask(path: Path) -> np.ndarray:
    """[h, w] 0..1: white, or (of a picture with transparency) what is not transparent."""
    from splatpainter.pictures.picture_reader import read_picture

    picture = read_picture(path)
    mask = picture.colors.mean(-1) if picture.alpha is None else picture.alpha
    if not (mask > 0).any():
        raise ValueError(f"{path}: empty mask; expected some pixels that are not black (or not transparent)")
    return mask


def _fitted(mask: np.ndarray | None, camera: Camera) -> np.ndarray | None:
    """The mask at the view's size. Raises ValueError for another shape."""
    if mask is None or mask.shape == (camera.height, camera.width):
        return mask
    from splatpainter.pictures.edit_files import MAX_ASPECT_ERROR
    from splatpainter.pictures.picture_reader import resample

    height, width = mask.shape
    if abs(width * camera.height / (height * camera.width) - 1) > MAX_ASPECT_ERROR:
        raise ValueError(
            f"{COMMAND}: expected --mask of the view's shape ({camera.width}x{camera.height}), got {width}x{height}"
        )
    return resample(mask, camera.width, camera.height)


def _write_report(request: SourceJob, edits: Sequence[SourcedEdit]) -> None:
    """The page of all that came back, where one is wanted."""
    from splatpainter.contact_sheet import write_sheet
    from splatpainter.gatekeeper.gate_report import report_page

    path, source = request.config.source_report, request.source
    views = []
    for sent, answer in source.answers:
        edit = next((edit for edit in edits if edit.answer is answer), None)
        views.append((sent, answer, None) if edit is None else (edit.request, answer, edit.admitted))
    if path is not None and views:
        write_sheet(path, report_page(views, f"{source.name}: {request.brief.prompt}".rstrip(": ")))
