"""Pictures that were cropped elsewhere: which part of a view they show. Pure.

    crop = find_crop(picture, render)      # None: no part of it

Normalised cross-correlation of small grey pictures (Lewis, "Fast Normalized Cross-Correlation", 1995) gives places to
look at; the pixels of the textured half that agree best decide between them, so that what was painted over does not
count. Colours are display sRGB 0..1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatpainter.sources.pictures import resample

SCALES = (1.0, 2.0, 4.0, 0.5)
"""How much larger than the view a cropped picture may have been made afterwards (upscalers)."""
LEAST = 24
"""Pixels of the view that a crop is wide and high, at least."""
COARSE = 320
"""Pixels of the longer side of the small pictures."""
PLACES = 6
"""Peaks that are looked at closely."""
POINTS, FEWEST = 3000, 50
"""Pixels that are compared, about and at least."""
BLOCKS = 8
"""Parts along each side of the picture from which they are taken."""
EDGE = 0.02
"""Least step to the next pixel there."""
ALIKE = 0.02
"""Mean difference of the half that agrees best, up to which it does agree: compression and resampling leave less."""
ALONE = 0.5
"""A place counts only where every other one is worse by this factor: a bare background is like any other."""


@dataclass(frozen=True)
class Crop:
    """A rectangle of a view, pixels."""

    x: int
    y: int
    width: int
    height: int
    error: float
    """Mean difference of the pixels that agree."""

    @property
    def window(self) -> tuple[slice, slice]:
        """Of an image [H, W]."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)


def find_crop(picture: np.ndarray, render: np.ndarray) -> Crop | None:
    """Where in the render [H, W, 3] the picture [h, w, 3] was cut out, at one of SCALES; None where nothing agrees."""
    height, width = render.shape[:2]
    best = None
    for scale in SCALES:
        size = round(picture.shape[1] / scale), round(picture.shape[0] / scale)
        if min(size) < LEAST or size[0] > width or size[1] > height or size == (width, height):
            continue
        own = picture if scale == 1 else resample(np.clip(picture, 0, 1), *size)
        found = _placed(own, render)
        if found is not None and (best is None or found.error < best.error):
            best = found
    return best


def error_at(picture: np.ndarray, render: np.ndarray) -> float:
    """How far two pictures [H, W, 3] of one size disagree where they agree best; comparable with Crop.error."""
    return float(_Points(picture).errors(render, np.zeros((1, 2), int))[0])


class _Points:
    """Pixels of a picture by which it is recognised: where it has edges, as many here as there, so that one busy edit
    does not outvote all the rest."""

    def __init__(self, picture: np.ndarray) -> None:
        grey = np.clip(picture, 0, 1).mean(-1)
        edges = np.hypot(np.gradient(grey, axis=0), np.gradient(grey, axis=1))
        chosen = []
        for rows in np.array_split(np.arange(grey.shape[0]), BLOCKS):
            for columns in np.array_split(np.arange(grey.shape[1]), BLOCKS):
                block = edges[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
                y, x = np.nonzero(block > max(EDGE, float(np.quantile(block, 0.8))))
                pick = slice(None, None, max(len(y) * BLOCKS**2 // POINTS, 1))
                chosen.append(np.stack([y[pick] + rows[0], x[pick] + columns[0]]))
        self.y, self.x = np.concatenate(chosen, 1)
        self.colors = np.clip(picture[self.y, self.x], 0, 1)

    def __len__(self) -> int:
        return len(self.y)

    def errors(self, render: np.ndarray, places: np.ndarray) -> np.ndarray:
        """[P] disagreement with a render whose part at (y, x) of `places` [P, 2] is shown."""
        out = np.empty(len(places))
        for k, (y, x) in enumerate(places):
            away = np.abs(render[self.y + y, self.x + x] - self.colors).mean(-1)
            out[k] = np.partition(away, len(away) // 2)[: len(away) // 2 + 1].mean()
        return out


def _placed(picture: np.ndarray, render: np.ndarray) -> Crop | None:
    height, width = picture.shape[:2]
    room = np.array([render.shape[0] - height, render.shape[1] - width])
    points = _Points(picture)
    if len(points) < FEWEST:
        return None
    shrink = max(max(render.shape[:2]) / COARSE, 1.0)
    scores = _correlation(_shrunk(picture, shrink), _shrunk(render, shrink))
    reach = int(np.ceil(1.5 * shrink))
    steps = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), -1).reshape(-1, 2)
    seen, errors = [], []
    for _ in range(PLACES):
        peak = np.array(np.unravel_index(int(scores.argmax()), scores.shape))
        if scores[tuple(peak)] <= 0:
            break
        low = np.maximum(peak - 2, 0)
        scores[low[0] : peak[0] + 3, low[1] : peak[1] + 3] = 0
        around = np.clip(np.round(peak * shrink).astype(int) + steps, 0, room)
        seen.append(around)
        errors.append(points.errors(np.clip(render, 0, 1), around))
    if not seen:
        return None
    places, found = np.concatenate(seen), np.concatenate(errors)
    y, x = places[int(found.argmin())]
    far = np.abs(places - (y, x)).max(1) > max(2, reach)
    others = np.random.default_rng(0).integers(0, room + 1, (60, 2))
    others = others[np.abs(others - (y, x)).max(1) > 2]
    rivals = np.concatenate([found[far], points.errors(np.clip(render, 0, 1), others)])
    if found.min() > ALIKE or (len(rivals) and found.min() > ALONE * rivals.min()):
        return None
    return Crop(int(x), int(y), width, height, float(found.min()))


def _shrunk(image: np.ndarray, factor: float) -> np.ndarray:
    """[h, w] grey."""
    grey = np.clip(image, 0, 1).mean(-1)
    size = (max(round(image.shape[1] / factor), 1), max(round(image.shape[0] / factor), 1))
    return grey if factor == 1 else resample(grey, *size)


def _correlation(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """[H - h + 1, W - w + 1] normalised cross-correlation of grey pictures, 0 where either is flat."""
    (h, w), (height, width) = part.shape, whole.shape
    if h > height or w > width:  # by rounding
        part = part[:height, :width]
        h, w = part.shape
    centered = part - part.mean()
    spectrum = np.fft.rfft2(whole - whole.mean()) * np.conj(np.fft.rfft2(centered, whole.shape))
    product = np.fft.irfft2(spectrum, whole.shape)[: height - h + 1, : width - w + 1]
    sums = [_window_sums(values, h, w) for values in (whole.astype(np.float64), whole.astype(np.float64) ** 2)]
    spread = np.sqrt(np.maximum(sums[1] - sums[0] ** 2 / (h * w), 0)) * np.sqrt(
        (centered.astype(np.float64) ** 2).sum()
    )
    return np.where(spread > 1e-6 * h * w, product / np.maximum(spread, 1e-12), 0)


def _window_sums(values: np.ndarray, h: int, w: int) -> np.ndarray:
    table = np.pad(values.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    return table[h:, w:] - table[:-h, w:] - table[h:, :-w] + table[:-h, :-w]
