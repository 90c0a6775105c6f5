"""Enlarged pictures: by a super-resolution model of a file, as spandrel loads them, or by nothing but arithmetic.

A model sees tiles that overlap, blended where they do. Files of the safetensors format alone are opened, unless the
option `pickles` says otherwise: a pickle can run anything. Without a model: Lanczos and a gentle unsharp mask that
stays within the colours around each pixel, so that no edge gets a halo.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.image_files import MAX_PICTURE_PIXELS
from splatpainter.pictures.picture_reader import resample
from splatpainter.sources.picture_source import (
    CancelFlag,
    Capabilities,
    PictureAnswer,
    PictureRequest,
    Progress,
    SourceCancelled,
    SourceError,
)
from splatpainter.sources.source_options import SourceDescription, option
from splatpainter.system.quick_dataclass import dataclass

PICKLES = (".pth", ".pt", ".ckpt", ".bin", ".pkl")
SCALES = (2, 4)
MODEL_SCALES = (1, *SCALES)
"""A model may also be one that restores and does not enlarge."""
MAX_PASSES = 3
"""Most passes of a model, to reach a scale."""


@dataclass(frozen=True)
class UpscaleOptions:
    """Options of the source `upscale`."""

    model: Path | None = option("Model file (.safetensors); without one: Lanczos and sharpening", None)
    pickles: bool = option("Also open .pth and .pt files, which can run code: only for files you trust", False)
    tile: int = option("Pixels of a tile's edge, before it is enlarged", 256, least=32, most=4096)
    overlap: int = option("Pixels by which tiles overlap on each side", 16, least=0, most=256)
    device: str = option("cpu, cuda or auto", "auto", choices=("auto", "cpu", "cuda"))
    sharpen: float = option("Without a model: how much, 0 to 1", 0.4, least=0, most=1)


DESCRIPTION = SourceDescription(
    name="upscale",
    summary="enlarges and sharpens: with a model file (spandrel), or without one",
    options=UpscaleOptions,
    takes="enlargements of 2, 4; with a model also 1; the library spandrel is for models alone",
)


def open_source(options: UpscaleOptions) -> UpscaleSource:
    """Raises SourceError: a model that is missing, is a pickle, or needs spandrel where that is not installed."""
    return UpscaleSource(options)


class UpscaleSource:
    """A model, or none."""

    name = "upscale"

    def __init__(self, options: UpscaleOptions) -> None:
        self.options = options
        # The file is looked at before a view is rendered; the model is loaded when it is first used.
        if options.model is not None:
            check_model_file(options.model, options.pickles)
        self.capabilities = Capabilities(
            scales=SCALES if options.model is None else MODEL_SCALES,
            max_side_px=8192 // 2,
            hint="set the factor: --enlarge in edit, --scale in refine and source try",
        )

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """The picture, `request.scale` times wider and higher. Looks at `cancel` between tiles. Raises SourceError: too
        many pixels, a model that cannot be used; SourceCancelled."""
        height, width = request.image.shape[:2]
        # Bounded before anything is enlarged.
        if height * width * request.scale**2 > MAX_PICTURE_PIXELS:
            raise SourceError(
                f"source upscale: {width}x{height} enlarged by {request.scale} is more than "
                f"{MAX_PICTURE_PIXELS // 10**6} megapixels"
            )
        image = np.ascontiguousarray(request.image, np.float32)
        if self.options.model is None:
            progress(0.0, "Lanczos")
            return PictureAnswer(enlarge(image, request.scale, self.options.sharpen), model="Lanczos and sharpening")
        progress(0.0, f"loading {self.options.model.name}")
        model = self.model
        result = image
        # A model has one factor; a larger one is reached by several passes.
        for _ in range(MAX_PASSES):
            result = model(result, self.options, progress, cancel)
            if result.shape[0] >= height * request.scale or model.scale == 1:
                break
        # A model of another factor is brought to the size that was asked for.
        if result.shape[:2] != (height * request.scale, width * request.scale):
            result = resample(result, width * request.scale, height * request.scale)
        # That code could have run belongs into the receipt.
        notes = ("opened as a pickle",) if self.options.model.suffix.lower() in PICKLES else ()
        return PictureAnswer(result, model=f"{self.options.model.name} ({model.kind})", notes=notes)

    @cached_property
    def model(self) -> UpscaleModel:
        """Loaded when it is first used."""
        assert self.options.model is not None
        return load_model(self.options.model, self.options.device)


@dataclass(frozen=True)
class UpscaleModel:
    """A model that maps tiles [h, w, 3] to [h * scale, w * scale, 3]."""

    run: Callable[[np.ndarray], np.ndarray]
    scale: int
    kind: str
    """The model's architecture."""

    def __call__(
        self, image: np.ndarray, options: UpscaleOptions, progress: Progress, cancel: CancelFlag
    ) -> np.ndarray:
        """[H, W, 3] enlarged by `scale`, tile by tile."""
        height, width = image.shape[:2]
        # Not more than a quarter of a tile, or tiles would be mostly overlap.
        overlap = min(options.overlap, options.tile // 4)
        boxes = [(y, x) for y in tile_starts(height, options.tile) for x in tile_starts(width, options.tile)]
        # Sums and weights: where tiles overlap, both count, fading into each other.
        total = np.zeros((height * self.scale, width * self.scale, 3), np.float32)
        weight = np.zeros((*total.shape[:2], 1), np.float32)
        for index, (y, x) in enumerate(boxes):
            if cancel.is_set():
                raise SourceCancelled
            progress(index / len(boxes), f"tile {index + 1} of {len(boxes)}")
            # Each tile sees more than it has to give, so that the model knows what lies around.
            top, left = max(y - overlap, 0), max(x - overlap, 0)
            bottom, right = min(y + options.tile + overlap, height), min(x + options.tile + overlap, width)
            tile = self.run(image[top:bottom, left:right])
            rows, columns = (bottom - top) * self.scale, (right - left) * self.scale
            # A model's answer is looked at before it is blended: one NaN would spread to the neighbours.
            if tile.shape != (rows, columns, 3) or not np.isfinite(tile).all():
                raise SourceError(
                    f"source upscale: the model answered {list(tile.shape)}, not finite [{rows}, {columns}, 3]"
                )
            # No fading at the picture's own edges: there is no other tile.
            feather = np.outer(
                _ramp(rows, overlap * self.scale, top > 0, bottom < height),
                _ramp(columns, overlap * self.scale, left > 0, right < width),
            )[..., None]
            window = slice(top * self.scale, bottom * self.scale), slice(left * self.scale, right * self.scale)
            total[window] += tile * feather
            weight[window] += feather
        return np.clip(total / weight, 0, 1)


def load_model(path: Path, device: str) -> UpscaleModel:
    """Raises SourceError: spandrel missing, a file that it cannot load, a model of another kind."""
    try:
        import spandrel  # type: ignore[import-not-found]
        import torch
    except ImportError:
        raise SourceError("source upscale: models need spandrel; pip install 'splatpainter[upscale]'") from None
    except Exception as error:  # torchvision of another torch
        raise SourceError(f"source upscale: spandrel cannot be used here ({type(error).__name__}: {error})") from None
    # Chosen here and not before: torch is imported with the model alone.
    chosen = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    try:
        descriptor = spandrel.ModelLoader(device=torch.device(chosen)).load_from_file(str(path))
    except Exception as error:
        raise SourceError(f"source upscale: {path}: cannot be loaded ({type(error).__name__}: {error})") from None
    # spandrel opens other kinds of models too, whose answers are no enlarged view.
    if not isinstance(descriptor, spandrel.ImageModelDescriptor):
        raise SourceError(
            f"source upscale: {path}: expected a model that enlarges or restores pictures, got another kind"
        )
    if (descriptor.input_channels, descriptor.output_channels) != (3, 3):
        actual = f"{descriptor.input_channels} to {descriptor.output_channels} channels"
        raise SourceError(f"source upscale: {path}: expected a model of RGB pictures, got {actual}")
    descriptor.eval()

    def run(tile: np.ndarray) -> np.ndarray:
        batch = torch.from_numpy(np.ascontiguousarray(tile.transpose(2, 0, 1)))[None]
        # No gradients: they would hold the memory of every layer.
        with torch.inference_mode():
            out: Any = descriptor(batch.to(device=descriptor.device, dtype=descriptor.dtype))
        return out[0].float().cpu().numpy().transpose(1, 2, 0)

    return UpscaleModel(run, int(descriptor.scale), str(getattr(descriptor.architecture, "name", "model")))


def check_model_file(path: Path, pickles: bool) -> None:
    """Raises SourceError: not there, a pickle that was not allowed, another kind of file."""
    if not path.is_file():
        raise SourceError(f"source upscale: {path}: no such file; expected a model (.safetensors)")
    ending = path.suffix.lower()
    # A pickle can run any code: only with a word of the user's.
    if ending in PICKLES and not pickles:
        raise SourceError(
            f"source upscale: {path}: is a pickle, which can run any code; use a .safetensors file, or set "
            "--source-option pickles=yes if you trust where it comes from"
        )
    if ending not in (".safetensors", *PICKLES):
        raise SourceError(f"source upscale: {path}: expected a model (.safetensors), got {ending or 'no ending'}")


def enlarge(image: np.ndarray, scale: int, amount: float) -> np.ndarray:
    """[H, W, 3] by Lanczos, `scale` times wider and higher, then sharpened: x + amount (x - blur(x)), within the range
    of the 3 x 3 pixels around each (bilinear between them)."""
    from PIL import Image

    height, width = image.shape[0] * scale, image.shape[1] * scale
    large = resample(image, width, height)
    # Nothing to sharpen: Lanczos alone.
    if amount <= 0:
        return large
    # An unsharp mask, held within the colours around each pixel, so that no edge gets a halo.
    sharp = large + amount * (large - _blurred(large, 0.5 * scale))
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), "edge")
    around = [padded[y : y + image.shape[0], x : x + image.shape[1]] for y in range(3) for x in range(3)]

    def smooth(values: np.ndarray) -> np.ndarray:
        planes = [
            np.asarray(Image.fromarray(plane, "F").resize((width, height), Image.Resampling.BILINEAR))
            for plane in np.ascontiguousarray(np.moveaxis(values, -1, 0), np.float32)
        ]
        return np.stack(planes, -1)

    low, high = smooth(np.minimum.reduce(around)), smooth(np.maximum.reduce(around))
    return np.clip(np.clip(sharp, low, high), 0, 1).astype(np.float32)


def tile_starts(length: int, tile: int) -> list[int]:
    """Where tiles of that edge begin."""
    return list(range(0, length, tile)) or [0]


def _ramp(length: int, overlap: int, rises: bool, falls: bool) -> np.ndarray:
    """[length] weights above 0: 1, linear over both sides' overlap where another tile lies there."""
    # Over both tiles' share of the overlap, so that the sum of both is smooth.
    ends = min(2 * overlap, length)
    slope = (np.arange(ends, dtype=np.float32) + 0.5) / max(ends, 1)
    weights = np.ones(length, np.float32)
    if rises and ends:
        weights[:ends] = np.minimum(weights[:ends], slope)
    if falls and ends:
        weights[-ends:] = np.minimum(weights[-ends:], slope[::-1])
    return weights


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """[H, W, 3] by a separable Gaussian."""
    radius = max(1, round(3 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2).astype(np.float32)
    kernel /= kernel.sum()
    for axis in (0, 1):
        pad = [(radius, radius) if side == axis else (0, 0) for side in range(3)]
        padded = np.pad(image, pad, "edge")
        taps = [np.take(padded, np.arange(image.shape[axis]) + shift, axis) for shift in range(2 * radius + 1)]
        image = sum((weight * tap for weight, tap in zip(kernel, taps, strict=True)), np.zeros_like(image))
    return image
