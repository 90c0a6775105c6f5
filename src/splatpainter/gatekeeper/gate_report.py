"""One page of pictures that says what came back from a source and what was made of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.contact_sheet import Strip, error_map, sheet
from splatpainter.gatekeeper.gatekeeper import AdmittedPicture
from splatpainter.pictures.picture_reader import resample
from splatpainter.sources.picture_source import PictureAnswer, PictureRequest

CELL_PX = 360
"""Side of a picture on the page."""


def report_page(
    views: Sequence[tuple[PictureRequest, PictureAnswer, AdmittedPicture | None]], title: str = ""
) -> np.ndarray:
    """[H, W, 3] uint8: for each view the render, the answer as it came, the answer over the render, its difference to
    the render, the mask, what was taken (red), and the picture that is painted with, under a line of numbers. None: the
    picture was not taken; then the first two and the mask."""
    strips = []
    for number, (request, answer, admitted) in enumerate(views, 1):
        size = request.image.shape[1], request.image.shape[0]
        name = f"{number}. " if len(views) > 1 else ""
        mask = np.ones(size[::-1], np.float32) if request.mask is None else request.mask
        words = "mask: white may change" if request.mask is not None else "no mask"
        mask_cell = (words, np.repeat(mask[..., None], 3, -1))
        height, width = answer.image.shape[:2]
        came = (("sent", request.image), (f"came back, {width} x {height}", over_grey(answer.image)))
        if admitted is None:
            strips.append(Strip(f"{name}not taken", (*came, mask_cell)))
            continue
        image, aligned = (_fitted(picture, size) for picture in (admitted.image, admitted.aligned))
        weight = _fitted(admitted.weight, size)
        # An enlarged picture is the enlarged render outside of what was taken, which is no difference.
        painted = np.where(weight[..., None] > 0, image, request.image) if admitted.factor > 1 else image
        # Red on a faded render: what was taken stands out on any asset.
        tinted = 0.6 * request.image + 0.4 * request.image.mean(-1, keepdims=True)
        tinted = tinted + 0.6 * weight[..., None] * (np.array([1.0, 0.15, 0.1]) - tinted)
        cells = (
            *came,
            ("over the render, colours corrected", aligned),
            ("difference to the render", error_map(aligned, request.image)),
        )
        lower = (
            mask_cell,
            (f"taken: {100 * admitted.share:.1f} % of the asset", np.clip(tinted, 0, 1)),
            ("painted with", image),
            ("its difference to the render", error_map(painted, request.image)),
        )
        strips += [Strip(name + numbers(admitted), cells), Strip("", lower)]
    return sheet(strips, CELL_PX, title)


def numbers(admitted: AdmittedPicture) -> str:
    """The measurements in one line."""
    laid = admitted.registration
    moved = f"shift {laid.right:+.2f}, {laid.down:+.2f} px, scale {laid.scale:.4f}, turn {laid.rotation:+.2f} deg"
    colors = f"colours {admitted.drift.strength:.2f} stops ({admitted.drift.kind})"
    return f"agrees {laid.score:.2f}; {laid.framing}, {moved}; {colors}; {100 * admitted.spilled:.1f} % put back"


def over_grey(picture: np.ndarray) -> np.ndarray:
    """[h, w, 3] of a picture [h, w, 3 or 4], over grey where it is transparent."""
    if picture.shape[2] == 3:
        return picture
    alpha = picture[..., 3:]
    return picture[..., :3] * alpha + 0.5 * (1 - alpha)


def _fitted(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return picture if picture.shape[1::-1] == size else resample(picture, *size)
