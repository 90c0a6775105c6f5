"""Lights in words of a command line: `120,35,#ffe0b0,2.0`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np

from splatpainter.color import from_hex, linear_to_srgb, srgb_to_linear
from splatpainter.lights.lamps import Lamp, LampKind, Rgb, Sun, kelvin_color
from splatpainter.lights.skies import SKIES, sky
from splatpainter.lights.sky_maps import SkyMap, read_sky
from splatpainter.lights.solar import sun_at

FORMS: dict[LampKind, tuple[str, int, int]] = {
    "point": ("X,Y,Z", 0, 0),
    "spot": ("X,Y,Z,TX,TY,TZ,ANGLE", 3, 1),
    "rect": ("X,Y,Z,TX,TY,TZ,WIDTH,HEIGHT", 3, 2),
    "disk": ("X,Y,Z,TX,TY,TZ,RADIUS", 3, 1),
    "sphere": ("X,Y,Z,RADIUS", 0, 1),
}
"""Kind -> its numbers, how many of them are where it looks to, and how many are sizes."""
SUN_FORM = "AZIMUTH,ELEVATION"
SUN_AT_FORM = "TIME,LATITUDE,LONGITUDE"
SIZED_SUN = f"{SUN_FORM},#RRGGBB,INTENSITY,SIZE"
"""A sun of a rig: its angular diameter, degrees, is its own."""
WHITE: Rgb = (1.0, 1.0, 1.0)


def parse_sky(text: str, full_range: bool = False) -> SkyMap:
    """A name of SKIES, or a file (`read_sky`). Raises ValueError."""
    if text in SKIES:
        return sky(text)
    if not Path(text).suffix and not Path(text).exists():
        raise ValueError(f"--hdri: expected {', '.join(SKIES)} or a file (.hdr, .exr, .png), got {ascii(text[:60])}")
    return read_sky(text, full_range)


def parse_sun(text: str, size: float, white: Rgb = WHITE) -> Sun:
    """white: linear colour where the words have none. Raises ValueError."""
    words, _, last = text.rpartition(",") if text.count(",") == SIZED_SUN.count(",") else (text, "", "")
    # A sun of a rig has a size of its own, the last of its words.
    sizes = _numbers([last]) if last else [size]
    if sizes is None:
        raise _wrong("sun", SUN_FORM, text)
    numbers, color, intensity = _split("sun", SUN_FORM, words, white)
    return Sun(numbers[0], numbers[1], sizes[0], color, intensity)


def parse_sun_at(text: str, north: float, size: float, white: Rgb = WHITE) -> Sun:
    """The sun of TIME,LATITUDE,LONGITUDE. Raises ValueError."""
    # The time is no number, and goes before the rest is read as numbers.
    moment, _, rest = text.partition(",")
    try:
        when = datetime.fromisoformat(moment)
    except ValueError:
        raise ValueError(f"--sun-at: expected a time as 2026-06-21T15:00+02:00, got {ascii(moment[:60])}") from None
    numbers, color, intensity = _split("sun-at", SUN_AT_FORM, f"0,{rest}", white)
    try:
        sun = sun_at(when, numbers[1], numbers[2], north, color=color, intensity=intensity)
    except ValueError as error:
        raise ValueError(f"--sun-at: {error}") from None
    return replace(sun, size=size)


def parse_lamp(kind: LampKind, text: str, white: Rgb = WHITE) -> Lamp:
    """Raises ValueError."""
    form, targets, sizes = FORMS[kind]
    numbers, color, intensity = _split(kind, form, text, white)
    x, y, z, *rest = numbers
    target = (rest[0], rest[1], rest[2]) if targets else None
    return Lamp(kind, (x, y, z), color, intensity, target, tuple(rest[len(rest) - sizes :] if sizes else ()))


def white_of(kelvin: float | None) -> Rgb:
    """Linear colour of lights that say none. Raises ValueError."""
    try:
        return WHITE if kelvin is None else kelvin_color(kelvin)
    except ValueError as error:
        raise ValueError(f"--kelvin: {error}") from None


def sun_words(sun: Sun) -> str:
    """What `parse_sun` reads, with the sun's size."""
    return ",".join([_short(sun.azimuth), _short(sun.elevation), *_color_words(sun), _short(sun.size)])


def lamp_words(lamp: Lamp) -> str:
    """What `parse_lamp` reads."""
    positions = [*lamp.position, *(lamp.target or ())]
    return ",".join([*(f"{value:.12g}" for value in positions), *map(_short, lamp.sizes), *_color_words(lamp)])


def _color_words(light: Sun | Lamp) -> list[str]:
    # The colour as bright as hexadecimal digits can say it, and the rest in the intensity.
    most = max(light.color)
    levels = [round(255 * float(linear_to_srgb(np.array(value / most)))) for value in light.color]
    return ["#" + "".join(f"{level:02x}" for level in levels), _short(light.intensity * most)]


def _short(value: float) -> str:
    return f"{value:.6g}"


def _split(option: str, form: str, text: str, white: Rgb) -> tuple[list[float], Rgb, float]:
    """(numbers as `form` names them, linear colour, intensity)."""
    parts = text.split(",")
    count = len(form.split(","))
    # Colour and intensity are optional and told apart by the #, so that neither needs a name.
    head, tail = parts[:count], parts[count:]
    color, intensity = white, 1.0
    if tail and tail[0].startswith("#"):
        display = from_hex(tail.pop(0))
        if display is None:
            raise _wrong(option, form, text)
        color = _linear(display)
    elif tail and tail[0].endswith("K"):
        kelvin = _numbers([tail.pop(0)[:-1]])
        if kelvin is None:
            raise _wrong(option, form, text)
        try:
            color = kelvin_color(kelvin[0])
        except ValueError as error:
            raise ValueError(f"--{option}: {error}") from None
    numbers = _numbers([*head, *tail])
    if numbers is None or len(head) < count or len(tail) > 1:
        raise _wrong(option, form, text)
    if tail:
        intensity = numbers.pop()
    return numbers, color, intensity


def _numbers(words: Sequence[str]) -> list[float] | None:
    try:
        values = [float(word) for word in words]
    except ValueError:
        return None
    return values if all(map(math.isfinite, values)) else None


def _linear(display: Rgb) -> Rgb:
    red, green, blue = (float(value) for value in srgb_to_linear(np.array(display)))
    return red, green, blue


def _wrong(option: str, form: str, text: str) -> ValueError:
    return ValueError(f"--{option}: expected {form}[,#RRGGBB or 2700K[,INTENSITY]], got {ascii(text[:80])}")
