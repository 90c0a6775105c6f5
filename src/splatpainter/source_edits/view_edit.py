"""One view of an asset, edited by a picture source: rendered, sent, admitted, and made an Edit.

result = ask_for_edit(splats, camera, source, SourceBrief("rusty iron"), progress=progress, cancel=cancel)
asset = painter.apply(asset, [result.edit])
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.color import from_display, to_display
from splatpainter.gatekeeper.gatekeeper import AdmittedPicture, RefusedPicture, admit
from splatpainter.gatekeeper.strictness import Strictness
from splatpainter.image_files import to_uint8
from splatpainter.kernels.portable import matmul
from splatpainter.painter import Edit, Mode
from splatpainter.sources.picture_source import (
    CancelFlag,
    PictureAnswer,
    PictureRequest,
    PictureSource,
    Progress,
    SourceError,
)
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.surface.estimate import Surface


@dataclass(frozen=True)
class SourceBrief:
    """What is wanted of a source, for every view that it gets."""

    prompt: str = ""
    """What it should do, in words."""
    references: tuple[np.ndarray, ...] = field(default=(), repr=False)
    """Pictures [h, w, 3], display sRGB 0..1, that show what is meant."""
    seed: int | None = None
    scale: int = 1
    """How many times larger than the view the answer is to be; the edit is then made at that size."""
    strictness: Strictness = "normal"
    """How much its pictures may differ from what was sent."""

    @staticmethod
    def of(prompt: str | SourceBrief) -> SourceBrief:
        """The brief, also of words alone."""
        return SourceBrief(prompt) if isinstance(prompt, str) else prompt


@dataclass(frozen=True)
class AnsweredView:
    """A view that a source answered: the edit that became of it, and how."""

    edit: Edit
    request: PictureRequest = field(repr=False)
    """What was sent; its mask is what the picture was cut to, even where the source takes none."""
    answer: PictureAnswer = field(repr=False)
    admitted: AdmittedPicture = field(repr=False)

    @property
    def notes(self) -> tuple[str, ...]:
        """One line each: the source's, then what was corrected."""
        return (*self.answer.notes, *self.admitted.notes)

    def record(self) -> dict[str, Any]:
        """What a receipt says of the view: who made the picture, of what, and what was corrected."""
        return {
            "model": self.answer.model,
            "seed": self.answer.seed if self.answer.seed is not None else self.request.seed,
            "cost": self.answer.cost,
            "request_sha256": picture_sha256(self.request.image),
            "answer_sha256": picture_sha256(self.answer.image),
            "registration": self.admitted.record(),
        }


def ask_for_edit(
    splats: Splats,
    camera: Camera,
    source: PictureSource,
    brief: SourceBrief,
    *,
    progress: Progress,
    cancel: CancelFlag,
    mask: np.ndarray | None = None,
    mode: Mode = "local",
    surface: Callable[[], Surface] | None = None,
    name: str = "",
) -> AnsweredView:
    """Render the asset (numpy) from the camera, send that to the source, and make an Edit of what comes back.

    mask: [H, W] 0..1, where the picture may change; a source that takes no masks does not get it, and its picture is
    cut to it afterwards. mode: in mode "global" the picture may be regraded as a whole. surface: gives the asset's
    surface, where it is at hand, for the maps that a source takes. name: of the edit, in errors and reports.
    Raises SourceError: the asset is not in view, more is asked than the source takes, the source fails, its picture is
    refused; SourceCancelled."""
    # A view of nothing would be paid for and could not be painted.
    name = name or source.name
    image, alpha = displayed(splats, camera)
    if not (alpha > 0.5).any():
        raise SourceError(f"{name}: the asset is not in view; choose another --view, or --azimuth and --elevation")
    maps = _Maps(splats, camera, surface)
    request = PictureRequest(
        image,
        alpha,
        None if mask is None else np.clip(mask, 0, 1).astype(np.float32),
        brief.prompt,
        brief.references,
        brief.seed,
        brief.scale,
        camera,
        maps.depth,
        maps.normal,
    )
    # Judged by the whole request afterwards: a source that takes no mask is held to it all the same.
    sent = request if source.capabilities.mask else replace(request, mask=None)
    answer = source.edit(sent, progress, cancel)
    # A refusal carries what was sent and what came back, for people to look at.
    try:
        admitted = admit(
            answer.image,
            request,
            strictness=brief.strictness,
            regraded=mode == "global",
            mask_sent=source.capabilities.mask,
            enlarged=lambda factor: displayed(splats, _times(camera, factor))[0],
            name=name,
        )
    except RefusedPicture as refusal:
        refusal.request, refusal.answer = request, answer
        raise
    colors = from_display(admitted.image, splats.color_space)
    return AnsweredView(
        Edit(np.ascontiguousarray(colors, np.float32), _times(camera, admitted.factor), admitted.changed, name),
        request,
        answer,
        admitted,
    )


def displayed(splats: Splats, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, 3] what a view shows, display sRGB 0..1, [H, W] its alpha), float32."""
    from splatpainter.rendering import render

    drawn = render(splats, camera)
    image = np.clip(to_display(drawn.colors[0], splats.color_space), 0, 1)
    return image.astype(np.float32), drawn.alphas[0, ..., 0].astype(np.float32)


def picture_sha256(image: np.ndarray) -> str:
    """Hash of a picture [h, w, C]: its width, height and channels as text, then its pixels with 8 bits, row by row."""
    height, width, channels = image.shape
    return hashlib.sha256(f"{width} {height} {channels}\n".encode() + to_uint8(image).tobytes()).hexdigest()


def _times(camera: Camera, factor: int) -> Camera:
    return camera if factor == 1 else camera.resized(camera.width * factor, camera.height * factor)


class _Maps:
    """Depth and normals of a view, drawn once when a source takes one of them."""

    def __init__(self, splats: Splats, camera: Camera, surface: Callable[[], Surface] | None) -> None:
        self._splats, self._camera, self._surface = splats, camera, surface
        self._drawn: tuple[np.ndarray, np.ndarray] | None = None

    def _draw(self) -> tuple[np.ndarray, np.ndarray]:
        if self._drawn is None:
            from splatpainter.view_files import draw_passes

            surface = None if self._surface is None else self._surface()
            passes = draw_passes(self._splats, self._camera, ("depth", "normal"), surface=surface)
            assert passes.normal is not None
            solid = passes.alpha > 0.5
            turned = matmul(passes.normal, self._camera.world_to_camera[:3, :3].T)
            self._drawn = (
                np.where(solid, passes.depth, 0).astype(np.float32),
                np.where(solid[..., None], turned, 0).astype(np.float32),
            )
        return self._drawn

    def depth(self) -> np.ndarray:
        """[H, W] as PictureRequest has it."""
        return self._draw()[0]

    def normal(self) -> np.ndarray:
        """[H, W, 3] as PictureRequest has it."""
        return self._draw()[1]
