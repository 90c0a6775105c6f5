"""Which part of a render a picture shows, in whole pixels: a shift, or the crop that was cut out.

Normalised cross-correlation of small grey pictures (Lewis, "Fast Normalized Cross-Correlation", 1995) gives positions
to look at, and the pixels of the textured half that agree best decide. Pure. H, W: pixels of the render; colours are
display sRGB 0..1.
"""

from __future__ import annotations

import numpy as np

from splatpainter.kernels import portable
from splatpainter.pictures.picture_reader import resample
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class CropThresholds:
    """The search for the part of a view that a picture shows. Source: taste."""

    max_shift_fraction: float = 0.04
    """Part of the picture's size by which it may have been moved."""
    crop_scales: tuple[float, ...] = (1.0, 2.0, 4.0, 0.5)
    """How much larger than the view a cropped picture may have been made afterwards (upscalers)."""
    min_crop_px: int = 24
    """Pixels of the view that a crop is wide and high, at least."""
    coarse_px: int = 320
    """Pixels of the longer side of the small pictures."""
    max_peaks: int = 6
    """Peaks that are looked at closely."""
    target_points: int = 3000
    """Pixels that are compared, about."""
    min_points: int = 50
    """Pixels that are compared, at least."""
    point_blocks: int = 8
    """Parts along each side of the picture from which they are taken."""
    min_edge_step: float = 0.02
    """Least step to the next pixel there."""
    max_crop_error: float = 0.02
    """Mean difference of the half that agrees best, up to which it does agree: compression and resampling leave
    less."""
    max_rival_ratio: float = 0.5
    """A place counts only where every other one is worse by this factor: a bare background is like any other."""


CROPS = CropThresholds()


def find_shift(picture: np.ndarray, render: np.ndarray) -> tuple[int, int]:
    """(right, down) whole pixels that the picture [H, W, 3] was moved by against the render, (0, 0) where that does not
    make them agree much better. By phase correlation of their gradients."""
    height, width = render.shape[:2]
    # Edges, not colours: a service changes exposure before it moves anything.
    spectra = [np.fft.rfft2(_edges(image)) for image in (picture, render)]
    cross = spectra[0] * np.conj(spectra[1])
    # Phase correlation: only phases count, so one strong edge does not decide.
    peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-12), (height, width))
    down, right = np.unravel_index(int(peak.argmax()), peak.shape)
    down, right = (int(v - size if v > size // 2 else v) for v, size in ((down, height), (right, width)))
    if (
        (right, down) == (0, 0)
        or abs(right) > CROPS.max_shift_fraction * width
        or abs(down) > CROPS.max_shift_fraction * height
    ):
        return 0, 0
    # The peak is only a guess; what counts is that the pixels then agree.
    still, moved = _disagreement(picture, render), _disagreement(undo_shift(picture, render, right, down), render)
    return (right, down) if moved < 0.5 * still else (0, 0)


def undo_shift(picture: np.ndarray, render: np.ndarray, right: int, down: int) -> np.ndarray:
    """The picture moved back by (right, down) pixels; what it does not show then is as in the render."""
    height, width = render.shape[:2]
    out = render.copy()
    x0, x1, y0, y1 = max(-right, 0), min(width - right, width), max(-down, 0), min(height - down, height)
    out[y0:y1, x0:x1] = picture[y0 + down : y1 + down, x0 + right : x1 + right]
    return out


def _edges(image: np.ndarray) -> np.ndarray:
    grey = np.clip(image, 0, 1).mean(-1)
    return portable.hypot(np.diff(grey, axis=1, prepend=grey[:, :1]), np.diff(grey, axis=0, prepend=grey[:1]))


def _disagreement(picture: np.ndarray, render: np.ndarray) -> float:
    """Mean difference, of the half of the textured pixels that agrees best."""
    difference = np.abs(np.clip(picture, 0, 1) - np.clip(render, 0, 1)).mean(-1)
    edges = _edges(render)
    # Textured pixels say where a picture lies; the half that agrees best is what was left unpainted.
    values = np.sort(difference[edges >= np.quantile(edges, 0.8)])
    return float(values[: len(values) // 2 + 1].mean()) + 1e-4


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
        """The crop as slices of an image [H, W]."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)


def find_crop(picture: np.ndarray, render: np.ndarray) -> Crop | None:
    """Where in the render [H, W, 3] the picture [h, w, 3] was cut out, at one of CROPS.crop_scales; None: nowhere."""
    height, width = render.shape[:2]
    best = None
    # Upscalers return whole multiples, so few scales have to be tried.
    for scale in CROPS.crop_scales:
        size = round(picture.shape[1] / scale), round(picture.shape[0] / scale)
        if min(size) < CROPS.min_crop_px or size[0] > width or size[1] > height or size == (width, height):
            continue
        resized = picture if scale == 1 else resample(np.clip(picture, 0, 1), *size)
        crop = _locate(resized, render)
        if crop is not None and (best is None or crop.error < best.error):
            best = crop
    return best


def error_at(picture: np.ndarray, render: np.ndarray) -> float:
    """How far two pictures [H, W, 3] of one size disagree where they agree best; comparable with Crop.error."""
    return float(_EdgePoints(picture).errors(render, np.zeros((1, 2), int))[0])


class _EdgePoints:
    """Pixels of a picture by which it is recognised: where it has edges, as many here as there, so that one busy edit
    does not outvote all the rest."""

    def __init__(self, picture: np.ndarray) -> None:
        grey = np.clip(picture, 0, 1).mean(-1)
        edges = portable.hypot(np.gradient(grey, axis=0), np.gradient(grey, axis=1))
        chosen = []
        for lines in np.array_split(np.arange(grey.shape[0]), CROPS.point_blocks):
            for columns in np.array_split(np.arange(grey.shape[1]), CROPS.point_blocks):
                block = edges[lines[0] : lines[-1] + 1, columns[0] : columns[-1] + 1]
                # The strongest edges of each block, so that every part of the picture has its say.
                y, x = np.nonzero(block > max(CROPS.min_edge_step, float(np.quantile(block, 0.8))))
                pick = slice(None, None, max(len(y) * CROPS.point_blocks**2 // CROPS.target_points, 1))
                chosen.append(np.stack([y[pick] + lines[0], x[pick] + columns[0]]))
        self.y, self.x = np.concatenate(chosen, 1)
        self.colors = np.clip(picture[self.y, self.x], 0, 1)

    def __len__(self) -> int:
        return len(self.y)

    def errors(self, render: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """[P] disagreement with a render whose part at (y, x) of `offsets` [P, 2] is shown."""
        out = np.empty(len(offsets))
        for k, (y, x) in enumerate(offsets):
            away = np.abs(render[self.y + y, self.x + x] - self.colors).mean(-1)
            # Half of the points may be painted over.
            out[k] = np.partition(away, len(away) // 2)[: len(away) // 2 + 1].mean()
        return out


def _locate(picture: np.ndarray, render: np.ndarray) -> Crop | None:
    height, width = picture.shape[:2]
    max_offset = np.array([render.shape[0] - height, render.shape[1] - width])
    points = _EdgePoints(picture)
    if len(points) < CROPS.min_points:
        return None
    # Coarse to fine: correlation at a few hundred pixels names peaks, whole pixels around them are then tried.
    shrink = max(max(render.shape[:2]) / CROPS.coarse_px, 1.0)
    scores = _correlation(_shrunk(picture, shrink), _shrunk(render, shrink))
    reach = int(np.ceil(1.5 * shrink))
    steps = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"), -1).reshape(-1, 2)
    offsets, errors = [], []
    for _ in range(CROPS.max_peaks):
        peak = np.array(np.unravel_index(int(scores.argmax()), scores.shape))
        if scores[tuple(peak)] <= 0:
            break
        # The surroundings of a peak that was looked at are no peak of their own.
        low = np.maximum(peak - 2, 0)
        scores[low[0] : peak[0] + 3, low[1] : peak[1] + 3] = 0
        around = np.clip(np.round(peak * shrink).astype(int) + steps, 0, max_offset)
        offsets.append(around)
        errors.append(points.errors(np.clip(render, 0, 1), around))
    if not offsets:
        return None
    tried, tried_errors = np.concatenate(offsets), np.concatenate(errors)
    y, x = tried[int(tried_errors.argmin())]
    # Rivals: the other peaks, and places drawn at random. Only a place that beats all of them clearly is believed.
    far = np.abs(tried - (y, x)).max(1) > max(2, reach)
    elsewhere = np.random.default_rng(0).integers(0, max_offset + 1, (60, 2))
    elsewhere = elsewhere[np.abs(elsewhere - (y, x)).max(1) > 2]
    rivals = np.concatenate([tried_errors[far], points.errors(np.clip(render, 0, 1), elsewhere)])
    error = tried_errors.min()
    if error > CROPS.max_crop_error or (len(rivals) and error > CROPS.max_rival_ratio * rivals.min()):
        return None
    return Crop(int(x), int(y), width, height, float(error))


def _shrunk(image: np.ndarray, factor: float) -> np.ndarray:
    """[h, w] grey."""
    grey = np.clip(image, 0, 1).mean(-1)
    size = (max(round(image.shape[1] / factor), 1), max(round(image.shape[0] / factor), 1))
    return grey if factor == 1 else resample(grey, *size)


def _correlation(part: np.ndarray, image: np.ndarray) -> np.ndarray:
    """[H - h + 1, W - w + 1] normalised cross-correlation of grey pictures, 0 where either is flat."""
    (h, w), (height, width) = part.shape, image.shape
    if h > height or w > width:  # by rounding
        part = part[:height, :width]
        h, w = part.shape
    # Zero mean makes the product a correlation; window sums give its length without a loop over positions.
    centered = part - part.mean()
    spectrum = np.fft.rfft2(image - image.mean()) * np.conj(np.fft.rfft2(centered, image.shape))
    product = np.fft.irfft2(spectrum, image.shape)[: height - h + 1, : width - w + 1]
    sums = [_window_sums(values, h, w) for values in (image.astype(np.float64), image.astype(np.float64) ** 2)]
    spread = np.sqrt(np.maximum(sums[1] - sums[0] ** 2 / (h * w), 0)) * np.sqrt(
        (centered.astype(np.float64) ** 2).sum()
    )
    return np.where(spread > 1e-6 * h * w, product / np.maximum(spread, 1e-12), 0)


def _window_sums(values: np.ndarray, h: int, w: int) -> np.ndarray:
    table = np.pad(values.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    return table[h:, w:] - table[:-h, w:] - table[h:, :-w] + table[:-h, :-w]
