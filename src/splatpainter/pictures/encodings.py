"""What a lossy encoding makes of a picture: the same is made of a render, to tell paint from what storing it did.

JPEG files say their tables of quantisation, palettes their colours; of lossy WebP, and of pictures that were stored so
before they became a PNG, the settings that agree best are looked for. Pure, but for Pillow's encoders in memory.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from splatpainter.lift.masks import (
    MASKS,
    box_mean,
    change_mask_beyond,
    changed_throughout,
    contrast,
    exact_share,
    largest_channel,
)
from splatpainter.order_statistics import distinct, median
from splatpainter.pictures.color_profiles import ColorStatement
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from PIL.Image import Image as PillowImage

EncodingKind = Literal["JPEG", "WebP", "palette", "blur", "rounding"]
MAX_PALETTE = 256
"""Colours of a palette."""


@dataclass(frozen=True)
class EncodingThresholds:
    """How a picture was compressed, guessed from what is left unpainted. Measured on painted renders where an entry
    says so, else taste."""

    jpeg_qualities: tuple[int, ...] = (95, 90, 85, 80, 75, 70, 60, 50, 40, 30, 20, 15, 10, 5)
    """Qualities of JPEG that are tried."""
    webp_qualities: tuple[int, ...] = (95, 90, 80, 70, 60, 50, 40, 30, 20, 10)
    """Qualities of WebP that are tried."""
    webp_steps: tuple[int, ...] = (5, 2, 1)
    """Steps by which the best of them is then improved, where a file is known to be one: 8 or 15 left more of an
    unpainted picture than any paint would."""
    webp_starts: int = 3
    """How many of the best the first step goes out from."""
    blurs_px: tuple[float, ...] = (0.6, 1.0, 1.5, 2.0)
    """Standard deviations of blurs that are tried."""
    rank_filters: tuple[tuple[str, str, tuple[int, ...]], ...] = (
        ("MedianFilter", "a median filter", (3, 5, 7)),
        ("ModeFilter", "a filter of the most common value", (3, 5, 7)),
        ("MinFilter", "a filter that darkens (erosion)", (3, 5)),
        ("MaxFilter", "a filter that lightens (dilation)", (3, 5)),
    )
    """Pillow's filters that are tried, how they are called, and their sizes in pixels."""
    search_px: int = 256
    """Side of the part of a picture on which settings of JPEG are looked for; its blocks do not depend on each
    other."""
    search_webp_px: int = 1024
    """The same for WebP, which spreads its bits over the whole picture."""
    unpainted_share: float = 0.25
    """Share of the asset's pixels that is left unpainted, at least, where settings are looked for."""
    half_level: float = 0.51 / 255
    """What rounding to 8 bits leaves."""
    min_lossless: float = 0.05
    """Share of the asset's pixels that agree so far with the render from which a picture may have been stored without
    loss."""
    min_rounded: float = 0.8
    """Their least part of those that agree nearly."""
    tie_share: float = 1e-3
    """Part of the mean error that decides between settings that leave what agrees best alike: flat parts."""
    max_error_ratio: float = 0.7
    """Error of a guessed encoding in parts of that of none, where it is not met exactly. WebP of quality 30 to 80 of
    painted renders has 0.53 to 0.60, noise and sharpening 0.88 and more."""
    min_exact: float = 0.5
    """Share of the asset's pixels that a guessed encoding must meet exactly."""
    min_exact_filter: float = 0.9
    """The same of a rank filter, which may have been used on a part on purpose."""
    min_gain: float = 0.25
    """Its least gain over none."""
    min_left_alone: float = 0.1
    """Share of the asset's pixels that paint leaves alone, at least; else all of a picture was made anew."""


ENCODINGS = EncodingThresholds()


STANDARD_LUMA_MEAN = 57.625
"""Mean of JPEG's example table of luminance (ITU-T T.81, table K.1)."""


@dataclass(frozen=True)
class Encoding:
    """A lossy way to store a picture, with its settings."""

    kind: EncodingKind
    words: str
    """How it is called: "JPEG of quality 60"."""
    settings: dict[str, Any] = field(default_factory=dict, repr=False)
    """JPEG and WebP: arguments of Pillow's encoder; none of WebP: to be distinct. blur: `radius` or
    `size` of a `filter`, pixels, or the `factor` by which it was shrunk."""
    palette: np.ndarray | None = field(default=None, repr=False)
    """[K, 3] uint8, of a palette."""
    statement: ColorStatement | None = field(default=None, repr=False)
    """In which colours it was stored; None: sRGB's."""

    def applied(self, colors: np.ndarray) -> np.ndarray:
        """[H, W, 3] colours 0..1 as they come back after being stored so."""
        from PIL import Image, ImageFilter

        if self.statement is not None:
            # The view that went out was rounded already, and a level more or less can be ten after the second time.
            sent = np.round(np.clip(np.nan_to_num(colors), 0, 1) * 255) / 255
            stored = replace(self, statement=None).applied(self.statement.from_srgb(sent))
            return self.statement.to_srgb(stored)
        # Through Pillow's own encoders, in memory: what they lose is what files lose.
        image = Image.fromarray((np.clip(np.nan_to_num(colors), 0, 1) * 255 + 0.5).astype(np.uint8))
        if self.kind == "palette":
            assert self.palette is not None
            flat = np.resize(self.palette, (MAX_PALETTE, 3))  # repeats: no colour that is not there
            holder = Image.new("P", (1, 1))
            holder.putpalette(flat.tobytes())
            image = image.quantize(palette=holder, dither=Image.Dither.NONE)
        elif self.kind == "blur":
            if "filter" in self.settings:
                image = image.filter(getattr(ImageFilter, self.settings["filter"])(self.settings["size"]))
            elif "factor" in self.settings:
                size, factor = image.size, self.settings["factor"]
                smaller = image.resize((-(-size[0] // factor), -(-size[1] // factor)), Image.Resampling.LANCZOS)
                image = smaller.resize(size, Image.Resampling.BICUBIC)
            else:
                image = image.filter(ImageFilter.GaussianBlur(self.settings["radius"]))
        elif self.kind != "rounding":
            file = io.BytesIO()
            grey = self.settings.get("grey")
            settings = {key: value for key, value in self.settings.items() if key != "grey"}
            (image.convert("L") if grey else image).save(file, self.kind, **settings)
            image = Image.open(file)
        return np.asarray(image.convert("RGB"), np.float32) / 255

    def fitted(self, picture: np.ndarray, render: np.ndarray, alpha: np.ndarray) -> Encoding:
        """The encoding with settings that make a render [H, W, 3] most like the picture [H, W, 3], where its file does
        not say them (WebP). alpha: [H, W] of the render."""
        if self.kind != "WebP" or self.settings:
            return self
        # Trying ten qualities on all of a large picture would take seconds.
        part = busiest(alpha, ENCODINGS.search_webp_px)
        seen, before, solid = picture[part], render[part], alpha[part] > 0.5

        def error(quality: int) -> float:
            return _low_error(seen, _webp(quality).applied(before), solid)

        errors = {quality: error(quality) for quality in ENCODINGS.webp_qualities}
        # What is lost does not fall evenly with the quality: the first step goes out from several.
        starts = sorted(errors, key=lambda quality: errors[quality])[: ENCODINGS.webp_starts]
        for step in ENCODINGS.webp_steps:
            for quality in [start + way * step for start in starts for way in (-1, 1)]:
                if 0 <= quality <= 100 and quality not in errors:
                    errors[quality] = error(quality)
            starts = [min(errors, key=lambda quality: errors[quality])]
        return _webp(starts[0])


def stored_in(encoding: Encoding | None, statement: ColorStatement) -> Encoding:
    """An encoding of colours that a statement says: without loss it is that of rounding them to 8 bits, in saturated
    colours of wide primaries up to ten levels of sRGB's."""
    other = encoding or Encoding("rounding", f"rounding in its colours ({statement.name})")
    return replace(other, statement=statement)


def encoding_of(image: PillowImage) -> Encoding | None:
    """How the file of an opened picture was stored; None: without loss, or as nobody can say."""
    if image.format == "JPEG":
        # A JPEG carries its tables: nothing has to be guessed.
        tables = getattr(image, "quantization", None)
        if not tables:
            return None
        return _jpeg(image, tables)
    if image.format == "WEBP":
        return None if _is_lossless_webp(image) else Encoding("WebP", "lossy WebP")
    if image.mode == "P" and image.palette is not None:
        palette = np.frombuffer(image.palette.tobytes(), np.uint8)
        channels = len(image.palette.mode) or 3
        colors = palette[: len(palette) // channels * channels].reshape(-1, channels)[:, :3]
        return palette_of(colors) if len(colors) else None
    return None


def palette_of(colors: np.ndarray) -> Encoding:
    """colors: [K, 3] uint8, at most MAX_PALETTE of them."""
    return Encoding("palette", f"a palette of {len(colors)} colours", palette=np.ascontiguousarray(colors))


def _jpeg(image: PillowImage, tables: dict[int, list[int]]) -> Encoding:
    from PIL import JpegImagePlugin

    # The quality as libjpeg scales its example table; only for words.
    scale = 100 * float(np.mean(tables[min(tables)])) / STANDARD_LUMA_MEAN
    quality = 5000 / scale if scale > 100 else (200 - scale) / 2
    settings: dict[str, Any] = {"qtables": [list(tables[key]) for key in sorted(tables)][:2]}
    if image.mode == "L":
        settings["grey"] = True
    else:
        sampling = JpegImagePlugin.get_sampling(image)
        settings["subsampling"] = sampling if sampling in (0, 1, 2) else 2
    return Encoding("JPEG", f"JPEG of quality {max(1, round(quality))}", settings)


def _is_lossless_webp(image: PillowImage) -> bool:
    """By the kind of its first picture chunk."""
    file = getattr(image, "filename", "")
    if not file:
        return False
    try:
        with open(file, "rb") as stream:
            head = stream.read(1 << 16)
    except OSError:
        return False
    lossless, lossy = head.find(b"VP8L"), head.find(b"VP8 ")
    return lossless >= 0 and (lossy < 0 or lossless < lossy)


def edited_in_encoded(
    picture: np.ndarray, render: np.ndarray, alpha: np.ndarray, encoding: Encoding
) -> np.ndarray | None:
    """[H, W] bool: what was edited in a picture [H, W, 3] that was stored so; None where all of it was made anew, so
    that nothing is as storing the render [H, W, 3] would have made it. alpha: [H, W] of the render."""
    # What storing the unpainted render would have left.
    expected = encoding.fitted(picture, render, alpha).applied(render)
    mask = change_mask_beyond(picture, render, expected)
    if changed_throughout(picture, render, alpha) and changed_throughout(picture, expected, alpha):
        rest = np.where(mask, 0, alpha)  # paint leaves something alone, beyond what storing it did
        if (rest > 0.9).sum() < ENCODINGS.min_left_alone * (alpha > 0.9).sum() or changed_throughout(
            picture, expected, rest
        ):
            return None
    return mask


def _webp_options() -> list[Encoding]:
    return [_webp(quality) for quality in ENCODINGS.webp_qualities]


def _webp(quality: int) -> Encoding:
    return Encoding("WebP", f"WebP of quality {quality}", {"quality": quality})


def guessed_encoding(picture: np.ndarray, render: np.ndarray, alpha: np.ndarray) -> Encoding | None:
    """How a picture [H, W, 3] was stored before, or softened, as far as it agrees with its render [H, W, 3] after the
    same; None where it agrees without, or with nothing that is tried. alpha: [H, W] of the render."""
    # Few colours are a palette, whatever the file says.
    colors = few_colors(picture)
    if colors is not None:
        return palette_of(colors)
    best, plain = None, 1.0
    errors: list[tuple[float, Encoding]] = []
    for options, side in ((_guesses(), ENCODINGS.search_px), (_webp_options(), ENCODINGS.search_webp_px)):
        part = busiest(alpha, side)
        seen, before = picture[part], np.clip(render[part], 0, 1)
        # Flat pixels survive every encoding, so only detailed ones can tell.
        solid = detailed(before, alpha[part] > 0.5)
        if best is not None or _is_lossless(seen, before, solid):
            break
        share = max(ENCODINGS.min_exact, _exact_share(seen, before, solid) + ENCODINGS.min_gain)
        plain = min(plain, _low_error(seen, before, solid))
        for option in options:
            expected = option.applied(before)
            ranks = "filter" in option.settings
            if not ranks:  # darkening by hand comes near an erosion
                errors.append((_low_error(seen, expected, solid), option))
            # A guess must meet unpainted pixels exactly; being nearer on average is not enough.
            exact = _exact_share(seen, expected, solid)
            if exact > max(share, ENCODINGS.min_exact_filter if ranks else 0):
                best, share = option, exact
    if best is None and errors:  # paint changes all of a WebP a little: then that which comes nearest
        error, nearest = min(errors, key=lambda pair: pair[0])
        return nearest if error < ENCODINGS.max_error_ratio * plain else None
    return best


def _guesses() -> Iterator[Encoding]:
    for radius in ENCODINGS.blurs_px:
        yield Encoding("blur", "blurring or resampling", {"radius": radius})
    yield Encoding("blur", "shrinking and enlarging", {"factor": 2})
    for name, words, sizes in ENCODINGS.rank_filters:
        for size in sizes:
            yield Encoding("blur", words, {"filter": name, "size": size})
    for quality in ENCODINGS.jpeg_qualities:
        for subsampling in (2, 0):
            yield Encoding("JPEG", f"JPEG of quality {quality}", {"quality": quality, "subsampling": subsampling})


def few_colors(picture: np.ndarray) -> np.ndarray | None:
    """[K, 3] uint8 all colours of a picture; None where they are more than a palette holds."""
    pixels = picture.reshape(-1, 3)
    for part in (pixels[:: max(1, len(pixels) // 4096)], pixels):  # most pictures have more in a few thousand
        levels = np.round(np.clip(part, 0, 1) * 255).astype(np.uint32)
        colors = distinct(levels[:, 0] << 16 | levels[:, 1] << 8 | levels[:, 2])
        if len(colors) > MAX_PALETTE:
            return None
    return np.stack([colors >> 16, colors >> 8 & 255, colors & 255], -1).astype(np.uint8)


def detailed(render: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """[H, W] bool: the half of the asset's pixels with more detail: flat ones survive every encoding."""
    if not solid.any():
        return solid
    detail = box_mean(contrast(render), 1)
    return solid & (detail >= median(detail[solid]))


def busiest(alpha: np.ndarray, side: int) -> tuple[slice, slice]:
    """The part of a view with most of the asset, of at most `side` pixels a side; it begins with a whole block."""
    out = []
    for axis in (1, 0):
        # The window with most of the asset, starting on a block of JPEG or WebP.
        weight = np.concatenate([[0], np.cumsum(alpha.sum(axis, dtype=np.float64))])
        size = min(side, len(weight) - 1)
        starts = np.arange(0, len(weight) - size, 16)
        start = int(starts[np.argmax(weight[starts + size] - weight[starts])])
        out.append(slice(start, start + size))
    return out[0], out[1]


def _exact_share(picture: np.ndarray, expected: np.ndarray, region: np.ndarray) -> float:
    return exact_share(box_mean(largest_channel(np.abs(picture - expected)), 1), region)


def _is_lossless(picture: np.ndarray, render: np.ndarray, solid: np.ndarray) -> bool:
    """Whether what agrees at all agrees to the rounding of 8 bits: it was painted on, and stored without loss."""
    near = box_mean(largest_channel(np.abs(picture - render)), 1)[solid]
    if not len(near):
        return True
    return bool(
        (near <= ENCODINGS.half_level).mean()
        >= max(ENCODINGS.min_lossless, ENCODINGS.min_rounded * (near <= MASKS.max_exact).mean())
    )


def _low_error(picture: np.ndarray, expected: np.ndarray, solid: np.ndarray) -> float:
    """The error of what agrees best: the rest may be painted over."""
    error = box_mean(largest_channel(np.abs(picture - expected)), 1)
    values = error[solid] if solid.any() else error.ravel()
    return float(np.quantile(values, ENCODINGS.unpainted_share) + ENCODINGS.tie_share * values.mean())
