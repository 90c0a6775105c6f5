"""A picture source in 30 lines: pip install this folder, then splatpainter edit ASSET --source sepia ..."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatpainter.sources.picture_source import CancelFlag, Capabilities, PictureAnswer, PictureRequest, Progress
from splatpainter.sources.source_options import SourceDescription, option, parse_options


@dataclass(frozen=True)
class SepiaOptions:
    amount: float = option("How old the photograph is, 0 to 1", 1.0, least=0, most=1)


class SepiaSource:
    name = "sepia"
    capabilities = Capabilities(mask=True)
    description = SourceDescription("sepia", "the view as an old photograph", SepiaOptions, capabilities)

    def __init__(self, options: dict[str, str]) -> None:
        self.amount = parse_options(SepiaOptions, "sepia", options).amount

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        grey = request.image @ np.array([0.2126, 0.7152, 0.0722], np.float32)
        sepia = np.clip(grey[..., None] * np.array([1.08, 0.92, 0.68], np.float32), 0, 1)
        share = self.amount * (1.0 if request.mask is None else request.mask[..., None])
        return PictureAnswer(request.image + share * (sepia - request.image), model="sepia 1.0")
