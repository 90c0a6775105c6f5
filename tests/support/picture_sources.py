"""Picture sources of the tests: functions of the picture, in this process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from splatpainter.sources.picture_source import (
    CancelFlag,
    Capabilities,
    PictureAnswer,
    PictureRequest,
    Progress,
    check_request,
)

EXCHANGE = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], np.float32)
"""Channels in another order: red, green, blue = blue, red, green."""
ALL = Capabilities(prompt=True, mask=True, references=4, seed=True, scales=(1, 2), paid=True)


class FunctionSource:
    """Answers what a function makes of the picture, within the mask; keeps what it was asked."""

    name = "function"

    def __init__(
        self, function: Callable[[np.ndarray], np.ndarray], capabilities: Capabilities = ALL, cut: bool = True
    ) -> None:
        self.function, self.capabilities, self.cut = function, capabilities, cut
        self.requests: list[PictureRequest] = []

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        check_request(request, self.capabilities, self.name)
        self.requests.append(request)
        progress(0.5, "painting")
        image = self.function(request.image)
        if request.mask is not None and self.cut:
            image = request.image + request.mask[..., None] * (image - request.image)
        return PictureAnswer(np.clip(image, 0, 1).astype(np.float32), "function-1", 7, "0.04 USD", ("done",))


def exchanged(image: np.ndarray) -> np.ndarray:
    """The picture with its channels exchanged."""
    return image @ EXCHANGE.T


def without_masks(capabilities: Capabilities = ALL) -> Capabilities:
    return replace(capabilities, mask=False)
