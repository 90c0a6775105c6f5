"""Decals: pictures laid on the surface under a pixel and unwrapped over it, instead of projected from a camera.

    decal = Decal("label.png", at=(400, 300), camera=camera, width="12%")
    asset = painter.apply(asset, decal.views(asset))

A decal becomes one to DECALS.max_decal_views edited views from cameras that face parts of it, so everything that edits
promise holds for decals: receipts, undo, layers. Each part is painted from the camera that sees it most frontally.
"""

from __future__ import annotations

import math
import unicodedata
from dataclasses import field, replace
from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera, bounding_sphere
from splatpainter.color import from_display
from splatpainter.decals.decal_placement import MAX_DECAL_PX, PLACEMENT, DecalPlacement, decal_placement
from splatpainter.decals.decal_views import FacedPart, faced_parts
from splatpainter.painter import Asset, Edit
from splatpainter.pictures.picture_reader import MAX_PICTURE_PIXELS, SIZE_LIMIT, Picture, read_picture
from splatpainter.surface.estimate import Surface
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class DecalThresholds:
    """Limits of one decal. Measured where an entry says on what, else taste."""

    max_decal_views: int = 6
    """Edited views of one decal."""
    max_rough_px: int = 50_000
    """Opaque pixels of a decal on rough surface, where nearly every one of them needs a Gaussian: words have fewer,
    large stickers are averaged down. A sticker of 60 % of a capture's diameter: 94,000 Gaussians and 12 CPU s instead
    of 176,000 and 22; with half as many its outline crumbles."""
    min_paint_alpha: float = 0.02
    """Alpha below which a pixel of a decal paints nothing."""
    nearly_all: float = 0.97
    """Share of a decal on the surface from which its note says nothing about it."""
    max_diameters: float = 4.0
    """Width and height of a decal, at most, in diameters of the asset."""
    max_aspect: float = 40.0
    """Largest aspect ratio of a decal."""


DECALS = DecalThresholds()


LITTLE_COVERAGE = 0.5
"""Share of a decal on the surface below which its note advises."""


@dataclass(frozen=True)
class Decal:
    """A picture that is to lie on the surface, its centre under a pixel of a camera."""

    picture: np.ndarray | Picture | str | Path = field(repr=False)
    """[H, W, 3] or [H, W, 4] sRGB (float 0..1 or uint8; the last channel is alpha, not multiplied in), or a file. What
    is transparent leaves the asset as it is."""
    at: tuple[float, float]
    """Pixel (x, y) of the camera; centres at + 0.5."""
    camera: Camera
    width: float | str
    """Along the surface: world units, or "12%" of the diameter of the asset's bounding sphere."""
    angle: float = 0.0
    """Degrees, counter-clockwise as seen from outside; at 0 the picture's up is `level`, laid on the surface."""
    wrap: float = 180.0
    """Degrees by which the surface may turn away from where it faces under the pixel, 0 to 180; 180: no limit."""
    name: str = "decal"
    """What errors call it."""
    level: tuple[float, float, float] | None = None
    """World direction that is up of the object, on which pictures stand upright; None, and on what lies flat: the
    camera's."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "picture", _picture(self.picture))
        if len(self.at) != 2 or not all(map(math.isfinite, self.at)):
            raise ValueError(f"decal: expected a pixel (x, y), got {self.at}")
        parse_width(self.width)
        if not math.isfinite(self.angle):
            raise ValueError(f"decal: expected an angle in degrees, got {self.angle}")
        if not 0 < self.wrap <= 180:
            raise ValueError(f"decal: expected a wrap limit above 0 and up to 180 degrees, got {self.wrap:g}")
        if self.level is not None and not (np.isfinite(self.level).all() and np.any(self.level)):
            raise ValueError(f"decal: expected a direction that is up, got {self.level}")

    def size(self, asset: Asset) -> tuple[float, float]:
        """(width, height) on this asset, world units. Raises ValueError where it is far larger than the asset."""
        value, percent = parse_width(self.width)
        diameter = 2 * bounding_sphere(asset.splats)[1]
        width = value / 100 * diameter if percent else value
        assert isinstance(self.picture, Picture)
        columns, rows = self.picture.size
        height = width * rows / columns
        if not 0 < max(width, height) <= DECALS.max_diameters * diameter:
            raise ValueError(
                f"decal: {width:g} x {height:g} is too large; expected at most {DECALS.max_diameters:g} times the "
                f"diameter of the asset, {diameter:g}"
            )
        return width, height

    def views(self, asset: Asset, surface: Surface | None = None) -> list[Edit]:
        """The decal as edited views, for `Painter.apply` in mode "local". surface: of the asset, if at hand.

        Raises ValueError: no surface under the pixel, nothing of the decal on the asset, too large a decal."""
        return list(self.laid(asset, surface).edits)

    def laid(self, asset: Asset, surface: Surface | None = None, placement: DecalPlacement | None = None) -> LaidDecal:
        """`views`, with what there is to say about them. placement: of `placed`, if at hand."""
        assert isinstance(self.picture, Picture)
        surface = surface or Surface.of(asset.splats)
        # Where it lies, in how many pixels, and which samples it paints at all.
        placement = placement or self.placed(asset, surface)
        patch, up, (width, height) = placement.patch, placement.up, placement.size
        pixel = max(width, height) / self.longer_px
        if patch.smoothing:
            pixel = max(width, height) / rough_length_px(self.picture, self.longer_px)
        texture = _texture(self.picture, max(round(width / pixel), 1), max(round(height / pixel), 1))
        alpha = _sampled(texture, patch.samples.uv, (width, height), soft=2 * placement.spacing)[:, 3]
        painted = patch.under & (alpha > DECALS.min_paint_alpha)
        painted[0] |= not painted.any()
        # From here on a decal is ordinary edits: receipts, undo and layers need nothing new.
        parts = faced_parts(asset, surface, patch, painted, up, pixel, DECALS.max_decal_views)
        edits = [self._edit(asset, part, texture, (width, height)) for part in parts]
        edits = [edit for edit in edits if edit is not None]
        if not edits:
            raise ValueError("decal: no part of it lies on the asset; choose another pixel, or make it larger")
        edits = [
            replace(edit, name=f"{self.name}, view {k + 1} of {len(edits)}" if len(edits) > 1 else self.name)
            for k, edit in enumerate(edits)
        ]
        cover = _coverage(parts, texture, (width, height))
        return LaidDecal(tuple(edits), (width, height), placement.point, placement.normal, cover)

    def placed(self, asset: Asset, surface: Surface | None = None) -> DecalPlacement:
        """Where it lies, before anything is painted; raises ValueError as `views`."""
        assert isinstance(self.picture, Picture)
        surface = surface or Surface.of(asset.splats)
        level = None if self.level is None else np.array(self.level, np.float64)
        camera = self.camera.within(asset.splats.offset)
        size, turns = self.size(asset), {"angle": self.angle, "wrap": self.wrap}
        return decal_placement(asset, surface, camera, self.at, size, self.longer_px, level=level, **turns)

    @property
    def longer_px(self) -> int:
        """Pixels of its longer side in the views that paint it, but on rough surface."""
        assert isinstance(self.picture, Picture)
        return int(np.clip(max(self.picture.size), PLACEMENT.min_decal_px, MAX_DECAL_PX))

    def _edit(self, asset: Asset, part: FacedPart, texture: np.ndarray, size: tuple[float, float]) -> Edit | None:
        layer = _sampled(texture, part.uv, size)
        ys, xs = part.ys, part.xs
        painted = layer[:, 3] > DECALS.min_paint_alpha
        if not painted.any():
            return None
        ys, xs, layer = ys[painted], xs[painted], layer[painted]
        # At an outline the background shows through the paint, too.
        colors = from_display(layer[:, :3], asset.splats.color_space) * part.alpha[ys, xs, None]
        image = np.clip(part.before, 0, 1)
        image[ys, xs] += layer[:, 3:] * (colors - image[ys, xs])
        mask = np.zeros(image.shape[:2], bool)
        mask[ys, xs] = True
        return Edit(image, part.camera, mask, self.name)


@dataclass(frozen=True)
class LaidDecal:
    """A decal that was laid on an asset."""

    edits: tuple[Edit, ...]
    size: tuple[float, float]
    """(width, height), world units."""
    point: np.ndarray
    """[3] of the surface under the decal's centre."""
    normal: np.ndarray
    """[3] there, unit, outwards."""
    coverage: float
    """Share of the decal's opaque pixels that lie on the surface, 0..1: the rest hangs over its edges."""

    @property
    def note(self) -> str:
        """One line for people."""
        views = f"painted from {len(self.edits)} view{'s' if len(self.edits) > 1 else ''}"
        text = f"decal {self.size[0]:.4g} x {self.size[1]:.4g}, {self.coverage:.0%} of it on the surface, {views}"
        if self.coverage < LITTLE_COVERAGE:
            text += "; less than half of it found a surface: choose another pixel or a smaller width"
        elif self.coverage < DECALS.nearly_all:
            text += f"; the other {1 - self.coverage:.0%} hangs over edges of the surface or the wrap limit"
        return text


def parse_width(text: float | str) -> tuple[float, bool]:
    """(number, whether it is per cent of the asset's diameter). Raises ValueError where it is not above 0."""
    words = str(text).strip()
    percent = words.endswith("%")
    try:
        value = float(words.removesuffix("%"))
    except ValueError:
        value = math.nan
    if not (value > 0 and math.isfinite(value)):
        raise ValueError(f"decal: expected a width above 0, in world units or like 12%, got {text!r}")
    return value, percent


def text_picture(text: str, color: tuple[float, float, float], font: Path | None = None) -> Picture:
    """A word as a picture that is cut to its letters. color: 0..1; font: as `draw_text`. Raises ValueError for a text
    without letters, or one too long to be drawn, and for a font that cannot be read or lacks letters of it."""
    from splatpainter.pictures.drawing import draw_text, load_font, missing_letters

    capital = 96.0
    if not text.strip() or len(text) > 200:
        raise ValueError(f"decal: expected a text of 1 to 200 characters, got {text[:40]!r}")
    text = unicodedata.normalize("NFC", text)  # Macs write letters and their accents apart, which no font joins here
    letters = load_font(font, capital)
    missing = missing_letters(text, letters)
    if missing:  # a font draws boxes in their place
        name = "the built-in font" if font is None else str(font)
        raise ValueError(
            f"decal: {name} has no letter for {', '.join(map(repr, missing[:5]))}; give a font that has: --font F.ttf"
        )
    left, top, right, bottom = letters.getbbox(text, anchor="ls")
    shape = (math.ceil(bottom - top) + 32, math.ceil(right - left) + 32)
    layer = draw_text(shape, text, (shape[1] / 2, shape[0] / 2), capital, color, font)
    ys, xs = np.nonzero(layer[..., 3] > DECALS.min_paint_alpha)
    if not len(ys):
        raise ValueError(f"decal: nothing of the text {text[:40]!r} can be drawn with this font")
    return _picture(layer[ys.min() : ys.max() + 1, xs.min() : xs.max() + 1])


def _picture(source: np.ndarray | Picture | str | Path) -> Picture:
    """The picture, checked. Raises ValueError, one line."""
    if isinstance(source, (str, Path)):
        picture = read_picture(Path(source))
    elif isinstance(source, Picture):
        picture = source
    else:
        pixels = np.asarray(source)
        if pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
            raise ValueError(f"decal: expected a picture of shape [H, W, 3] or [H, W, 4], got {list(pixels.shape)}")
        if not pixels.size:
            raise ValueError("decal: the picture has no pixels")
        if pixels.dtype == np.uint8:
            pixels = pixels.astype(np.float32) / 255
        if pixels.dtype.kind != "f" or not np.isfinite(pixels).all() or pixels.min() < -0.01 or pixels.max() > 1.01:
            raise ValueError("decal: expected a picture of floats in 0..1 or of uint8")
        pixels = np.clip(pixels, 0, 1).astype(np.float32)
        picture = Picture(pixels[..., :3], pixels[..., 3] if pixels.shape[2] == 4 else None)
    columns, rows = picture.size
    if columns * rows > MAX_PICTURE_PIXELS:
        raise ValueError(f"decal: expected a picture of {SIZE_LIMIT}, got {columns}x{rows}")
    if max(columns, rows) > DECALS.max_aspect * min(columns, rows):
        raise ValueError(f"decal: expected sides of at most {DECALS.max_aspect:g} to 1, got {columns}x{rows}")
    if picture.alpha is not None and picture.alpha.max() <= DECALS.min_paint_alpha:
        raise ValueError("decal: the picture is transparent everywhere")
    return picture


def _texture(picture: Picture, columns: int, rows: int) -> np.ndarray:
    """[rows' + 2, columns' + 2, 4] float32 of at most that size, colours multiplied by alpha, a transparent rim."""
    width, height = picture.size
    small = picture.resized(min(columns, width), min(rows, height))
    alpha = np.ones(small.colors.shape[:2], np.float32) if small.alpha is None else np.clip(small.alpha, 0, 1)
    # Premultiplied and with a transparent rim: bilinear sampling leaks no colour at edges.
    layer = np.concatenate([np.clip(small.colors, 0, 1) * alpha[..., None], alpha[..., None]], -1)
    return np.pad(layer, [(1, 1), (1, 1), (0, 0)]).astype(np.float32)


def rough_length_px(picture: Picture, longest: int) -> int:
    """Pixels of a picture's longer side, up to `longest`, with which at most DECALS.max_rough_px of all are opaque."""
    opaque = 1.0 if picture.alpha is None else float((picture.alpha > 0.5).mean())
    shape = min(picture.size) / max(picture.size)
    return int(min(max(math.sqrt(DECALS.max_rough_px / max(opaque * shape, 1e-9)), PLACEMENT.min_decal_px), longest))


def _sampled(texture: np.ndarray, uv: np.ndarray, size: tuple[float, float], soft: float = 0.0) -> np.ndarray:
    """[Q, 4] straight colours and alpha at (u, v) [Q, 2] of a decal of a size, bilinear; nothing beyond its rectangle
    and where (u, v) is NaN. soft: world units over which the largest alpha counts."""
    rows, columns = texture.shape[0] - 2, texture.shape[1] - 2
    if soft:
        reach = [max(math.ceil(soft / s * n), 1) for s, n in ((size[0], columns), (size[1], rows))]
        texture = _spread_alpha(texture, *reach)
    u, v = np.nan_to_num(uv[:, 0], nan=np.inf), np.nan_to_num(uv[:, 1], nan=np.inf)
    x = np.clip((u / size[0] + 0.5) * columns + 0.5, 0, columns + 1 - 1e-6)
    y = np.clip((0.5 - v / size[1]) * rows + 0.5, 0, rows + 1 - 1e-6)
    ix, iy = x.astype(int), y.astype(int)
    fx, fy = (x - ix)[:, None].astype(np.float32), (y - iy)[:, None].astype(np.float32)
    top = texture[iy, ix] * (1 - fx) + texture[iy, ix + 1] * fx
    low = texture[iy + 1, ix] * (1 - fx) + texture[iy + 1, ix + 1] * fx
    out = top * (1 - fy) + low * fy
    out[:, :3] /= np.maximum(out[:, 3:], 1e-6)
    out[:, :3] = np.clip(out[:, :3], 0, 1)
    return out


def _spread_alpha(texture: np.ndarray, across: int, down: int) -> np.ndarray:
    """The texture with the largest alpha of a window around each pixel, which makes it a little wider."""
    out = texture.copy()
    for axis, reach in ((1, across), (0, down)):
        alpha = out[..., 3]
        spread, done = alpha, 0
        while done < reach:  # windows of 1, 2, 4 ... steps
            step = min(max(done, 1), reach - done)
            grown = spread.copy()
            ahead = [slice(None)] * 2
            back = [slice(None)] * 2
            ahead[axis], back[axis] = slice(step, None), slice(None, -step)
            grown[tuple(ahead)] = np.maximum(grown[tuple(ahead)], spread[tuple(back)])
            grown[tuple(back)] = np.maximum(grown[tuple(back)], spread[tuple(ahead)])
            spread, done = grown, done + step
        out[..., 3] = spread
    return out


def _coverage(parts: list[FacedPart], texture: np.ndarray, size: tuple[float, float]) -> float:
    """Share of the decal's opaque area that the parts show, by cells of about 1/48 of its longer side."""
    longer = max(size)
    columns, rows = (max(round(48 * s / longer), 1) for s in size)
    # Coverage by a coarse grid: a note needs per cents, not pixels.
    middle = np.stack(np.meshgrid((np.arange(columns) + 0.5) / columns - 0.5, 0.5 - (np.arange(rows) + 0.5) / rows), -1)
    opaque = _sampled(texture, (middle * size).reshape(-1, 2), size)[:, 3] > 0.5
    if not opaque.any():
        return 1.0
    hit = np.zeros((rows, columns), bool)
    for part in parts:
        x = np.floor((part.uv[:, 0] / size[0] + 0.5) * columns).astype(int)
        y = np.floor((0.5 - part.uv[:, 1] / size[1]) * rows).astype(int)
        valid = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        hit[y[valid], x[valid]] = True
    return float(hit.ravel()[opaque].mean())
