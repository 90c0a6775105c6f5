"""Edited pictures put onto an asset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from splatpainter.kernels.parallel import alone, beside
from splatpainter.operations.operation import AS_PYTHON, ReadyOperation, Report, ReportedView, Tools, Wording, parameter
from splatpainter.operations.painting_options import GateOptions, PaintingOptions
from splatpainter.painting.edited_picture import MAX_VIEWS, Mode
from splatpainter.spread.options import SPREAD_DEFAULTS, SpreadOptions
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.ranges import same_range

if TYPE_CHECKING:
    from splatpainter.painter import Asset, Painter
    from splatpainter.pictures import PictureFile
    from splatpainter.splats import Splats


@dataclass(frozen=True)
class Paint(GateOptions, PaintingOptions):
    """Write edited pictures of an asset onto it. Later pictures win where several disagree."""

    kind: ClassVar[str] = "paint"

    pictures: tuple[Path, ...] = parameter((), metavar="VIEW.png ...", positional=True, file=True)
    """1 to 16 edited pictures of ASSET."""
    cameras: tuple[Path, ...] = parameter((), metavar="CAM.json[:N] ...", option="camera", file=True)
    """Cameras of the pictures, in their order, where the pictures lost theirs: CAM.json, the view that was painted on,
    or a folder of views, of which the one counts that the picture matches. For photographs of a capture: cameras.json,
    transforms.json or COLMAP's sparse/0, with :N (a number or a name) where the picture has another name than the
    photograph. Default: what the picture says, or NAME.json beside it, or the capture in ASSET's folder, or the view
    beside the picture or beside ASSET that it matches."""
    masks: tuple[Path, ...] = parameter((), metavar="M.png ...", option="mask", file=True)
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
    spread_threshold: float | None = same_range(SpreadOptions, "threshold", None)
    """Mode spread: confidence (0 to 1) from which a Gaussian counts as the painted material; lower reaches further.
    Default: 0.5."""
    spread_confidence: Path | None = parameter(None, metavar="C.png", output=True)
    """Mode spread: write a picture of this confidence, from the first edited view and from behind (green: sure, yellow:
    at the threshold, red and blue: not reached). With --dry-run nothing else is written."""

    def check(self, wording: Wording = AS_PYTHON) -> None:
        super().check(wording)
        name = wording.option
        # Options of one mode are refused in the others, where they would be silently without effect.
        if self.mode != "spread" and (self.spread_threshold, self.spread_confidence) != (None, None):
            threshold, confidence = name("spread_threshold"), name("spread_confidence")
            raise wording.error(self.kind, f"{threshold} and {confidence} are for {name('mode')} spread")
        if self.correct and self.force:
            raise wording.error(self.kind, f"expected one of {name('correct')} and {name('force')}")
        if not 1 <= len(self.pictures) <= MAX_VIEWS:
            count = len(self.pictures) or "none"
            raise wording.error(self.kind, f"expected 1 to {MAX_VIEWS} pictures (VIEW.png) after ASSET, got {count}")
        # Cameras and masks belong to pictures by their order, so each list is absent or complete.
        for what, given in (("cameras", self.camera_of_each), ("masks", self.masks)):
            if given and len(given) != len(self.pictures):
                expected = f"as many {name(what)} files as pictures ({len(self.pictures)})"
                raise wording.error(self.kind, f"expected {expected}, got {len(given)}")

    @property
    def camera_of_each(self) -> tuple[Path, ...]:
        """The cameras; one capture serves for all, each picture finds its view there by its name."""
        from splatpainter.captures import is_capture

        # A capture holds many views, and each picture finds its own by name; a camera file is of one picture.
        if len(self.cameras) == 1 and is_capture(self.cameras[0]):
            return self.cameras * max(len(self.pictures), 1)
        return self.cameras

    def viewpoints(self) -> tuple[Path, ...]:
        # A camera that was named is surer than one that a picture carries.
        return (*self.cameras[:1], *self.pictures[:1])

    def ready(self, tools: Tools) -> ReadyOperation:
        # Pictures are read before the painter loads its weights: a wrong file is the cheaper fault to meet.
        pictures = self._read(tools)
        painter = self.painter(self.mode, tools)
        if self.spread_threshold is not None:
            painter = painter.with_settings(spread_options=SpreadOptions(self.spread_threshold))

        def paint(asset: Asset, report: Report) -> Asset:
            return self._painted(asset, self._of_size(pictures, painter), painter, report)

        return paint

    def _read(self, tools: Tools) -> list[PictureFile]:
        from splatpainter.gatekeeper.photographs import picture_edit

        cameras = self.camera_of_each or (None,) * len(self.pictures)
        masks = self.masks or (None,) * len(self.pictures)
        # People keep edited views beside the asset or in the folder that `render` writes.
        beside = () if tools.asset is None else (tools.asset.parent, tools.asset.parent / "views")
        return [
            picture_edit(*files, tools.asset, beside)
            for files in zip(self.pictures, cameras[: len(self.pictures)], masks, strict=True)
        ]

    def _of_size(self, pictures: list[PictureFile], painter: Painter) -> list[PictureFile]:
        """The pictures at the size at which they are edited with: networks want one size, and looks need no detail."""
        if self.mode == "global" or painter.choose(self.method, self.mode)[0] == "ttt":
            return [picture.at_view() for picture in pictures]
        return pictures

    def _painted(self, asset: Asset, pictures: list[PictureFile], painter: Painter, report: Report) -> Asset:
        splats = asset.splats
        # What the edit will ask of the asset whatever the pictures hold, on another CPU while they are looked at.
        hashing, loading = beside(lambda: splats.sha256), beside(lambda: _prepare(asset, self.mode))
        # Looked at before anything is encoded: a camera that sees nothing makes an edit of nothing.
        _check_views(pictures, splats)
        # Only a warning: what differs from the other asset counts as paint, and may be meant so.
        _warn_of_other_assets(pictures, hashing, report)
        # Pictures are put right, refused or let through first; after that the painter takes them as they are.
        pictures = self._checked(pictures, splats, report)
        hashing()
        loading()
        if asset.receipt is None:
            encoded = painter.encode(splats, self.method, [self.mode])
            asset = encoded.with_surface_of(asset) if encoded.splats is asset.splats else encoded
        edits = [picture.edit(splats, self.mode) for picture in self._of_size(pictures, painter)]
        for picture, edit in zip(pictures, edits, strict=True):
            if picture.is_lossy and picture.mask is None and edit.mask is None and self.mode == "local":
                report.warn(
                    f"{picture.path}: more than its compression changed all of it, so all of it is painted anew; "
                    "save it as PNG, or give --mask M.png"
                )
        edited = painter.apply(asset, edits, self.mode, self.method)
        # The confidence belongs to the first asset's Gaussians; the edit may have appended others.
        if self.spread_confidence is not None:
            self._write_confidence(self.spread_confidence, splats, edited, pictures, painter)
        report.views += [ReportedView(str(picture.path), picture.notes) for picture in pictures]
        return edited

    def _checked(self, pictures: list[PictureFile], splats: Splats, report: Report) -> list[PictureFile]:
        """The pictures as they are painted with. Raises ValueError for one that differs from its view everywhere."""
        from splatpainter.gatekeeper.photographs import laid_over
        from splatpainter.gatekeeper.picture_gate import checked_picture

        policy = "correct" if self.correct else "force" if self.force else "refuse"
        # Photographs are laid over their views first, for the check compares picture and view pixel by pixel.
        painted = [laid_over(picture, splats, self.mode, self.strictness) for picture in pictures]
        checked = [checked_picture(picture, splats, self.mode, policy, self.strictness) for picture in painted]
        for picture in checked:
            if picture.warning:
                report.warn(picture.warning)
        return [picture.source for picture in checked]

    def _write_confidence(
        self, path: Path, splats: Splats, edited: Asset, pictures: Sequence[PictureFile], painter: Painter
    ) -> None:
        from splatpainter.image_files import write_png
        from splatpainter.spread.overlay import confidence_picture

        assert edited.confidence is not None
        arrays, threshold = splats.numpy(), (painter.settings.spread_options or SPREAD_DEFAULTS).threshold
        # Appended Gaussians have no confidence of their own, and the picture shows the asset as it was.
        confidence = edited.confidence[: len(arrays)]
        write_png(path, confidence_picture(arrays, confidence, threshold, pictures[0].camera.within(splats.offset)))


def _prepare(asset: Asset, mode: Mode) -> None:
    """Make the surface of an asset, which paint is laid on, and load what paints."""
    if mode == "global" or not asset.splats.drawable.any():
        return
    with alone():
        _ = asset.surface
        from splatpainter.lift import edits, side_views  # noqa: F401


def _warn_of_other_assets(pictures: Sequence[PictureFile], sha256: Callable[[], str], report: Report) -> None:
    """sha256: waits for the asset's."""
    for picture in pictures:
        # A picture says by its hash what it was rendered from; without one nothing can be said.
        made_for = picture.camera.asset_sha256
        if made_for is not None and made_for != sha256():
            other = f"another asset (sha256 {made_for[:12]}...)"
            report.warn(f"{picture.path}: was rendered from {other}; differences count as paint")


def _check_views(pictures: Sequence[PictureFile], splats: Splats) -> None:
    """Raises ValueError where a picture's camera sees nothing of the asset: an edit of it would reach nothing."""
    from splatpainter.doubts import doubts_of_view

    for picture in pictures:
        for doubt in doubts_of_view(splats, picture.camera, str(picture.path)):
            raise ValueError(doubt.line)
