"""Lights of USD scenes as text (.usda): UsdLux's distant, sphere, disk, rect and dome lights, cones of ShapingAPI.

A reader of what lights need, not of USD: prims with their transforms, attributes with one value. References, layers,
variants and animation are passed over. Units are UsdLux's: radiance = intensity x 2^exposure x colour, or that over the
light's area (`normalize`); a distant light's is spread over its disc of sin^2 of half its angle, times pi.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import files
from splatpainter.kernels import portable
from splatpainter.lights.lamps import PENUMBRA, Rgb, kelvin_color
from splatpainter.lights.scene_lights import SceneLight, SceneSky
from splatpainter.system.quick_dataclass import dataclass

MAX_BYTES = 64 << 20
MAX_DEPTH = 200
"""Prims inside each other."""
MAX_LIGHTS = 1000
LIGHT_KINDS = ("DistantLight", "SphereLight", "DiskLight", "RectLight", "DomeLight", "DomeLight_1")
"""Prims that are read as lights."""
TOKEN = re.compile(
    r'#[^\n]*|"""[\s\S]*?"""|\'\'\'[\s\S]*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'|@[^@\n]*@|<[^>\n]*>'
    r"|[()\[\]{}=,;]|[^\s()\[\]{}=,;#\"'@<]+"
)
SHAPED = 'prepend apiSchemas = ["ShapingAPI"]'


@dataclass
class Prim:
    kind: str
    name: str
    attributes: dict[str, Any] = field(default_factory=dict)
    children: list[Prim] = field(default_factory=list)

    def number(self, name: str, default: float, path: Path) -> float:
        value = self.attributes.get(name, default)
        if not isinstance(value, float) or not math.isfinite(value):
            raise ValueError(f"{path}: expected a number as {name} of the light {ascii(self.name)[1:-1]}")
        return value


def read_usda(path: Path) -> tuple[list[SceneLight], SceneSky | None, list[str]]:
    """(lights in axes that are y up, the environment, what was passed over). Raises ValueError: no text of USD, damaged
    or hostile."""
    data = files.read_head(path, MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise ValueError(f"{path}: expected a rig of at most {MAX_BYTES >> 20} MB")
    if data.startswith(b"PXR-USDC"):
        raise ValueError(f"{path}: this is binary USD; save it as text, for example: usdcat {path.name} -o rig.usda")
    if not data.startswith(b"#usda"):
        raise ValueError(f"{path}: expected USD as text (.usda), which begins with #usda")
    try:
        text = data.decode()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: this USD is not UTF-8 text") from None
    root = _Parser([t for t in TOKEN.findall(text) if not t.startswith("#")], path).layer()
    # All of it is y up from here on: what follows knows one convention.
    turn = np.eye(4)
    if root.attributes.get("upAxis") == "Z":
        turn[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    lights: list[SceneLight] = []
    skies: list[SceneSky] = []
    notes: list[str] = []
    for prim, matrix in _walk(root, turn, path, 0):
        if prim.kind.startswith("DomeLight"):
            skies.append(_dome(prim, matrix, path))
        elif prim.kind in LIGHT_KINDS:
            lights.append(_light(prim, matrix, path))
        # Named, not refused: the rest of the file is still worth reading.
        elif prim.kind.endswith("Light"):
            notes.append(f"{prim.kind} {ascii(prim.name)[1:-1]} passed over")
        if len(lights) > MAX_LIGHTS:
            raise ValueError(f"{path}: expected at most {MAX_LIGHTS} lights")
    if len(skies) > 1:
        notes.append(f"{len(skies) - 1} more dome lights passed over")
    return lights, skies[0] if skies else None, notes


def usda_text(lights: list[SceneLight], sky: SceneSky | None) -> str:
    """A layer of these lights, for any program that reads UsdLux."""
    out = ['#usda 1.0\n(\n    defaultPrim = "Lights"\n    upAxis = "Y"\n)\n\ndef Xform "Lights"\n{']
    for light in lights:
        kind = {"distant": "Distant", "point": "Sphere", "spot": "Sphere"}.get(light.kind, light.kind.capitalize())
        meta = f" (\n        {SHAPED}\n    )" if light.kind == "spot" else ""
        out.append(f'    def {kind}Light "{light.name}"{meta}\n    {{')
        lines = [f"color3f inputs:color = ({_list(light.color)})"]
        lines += _photometry(light)
        rows = ", ".join(f"({_list(row)})" for row in light.matrix.T)
        lines += [f"matrix4d xformOp:transform = ( {rows} )", 'uniform token[] xformOpOrder = ["xformOp:transform"]']
        out += [f"        {line}" for line in lines] + ["    }"]
    if sky is not None:
        out.append('    def DomeLight "Sky"\n    {')
        out.append(f"        float inputs:intensity = {sky.intensity:.9g}")
        if sky.file:
            out.append(f"        asset inputs:texture:file = @{sky.file}@")
            out.append('        token inputs:texture:format = "latlong"')
        out.append(f"        float xformOp:rotateY = {sky.rotate:.9g}")
        out.append('        uniform token[] xformOpOrder = ["xformOp:rotateY"]\n    }')
    return "\n".join([*out, "}", ""])


def _photometry(light: SceneLight) -> list[str]:
    """Attributes that make UsdLux's light as bright as ours."""
    if light.kind == "distant":
        return [
            f"float inputs:angle = {light.sizes[0]:.9g}",
            "bool inputs:normalize = 1",
            f"float inputs:intensity = {light.intensity * math.pi:.9g}",
        ]
    if light.kind in ("point", "spot"):  # of a sphere of radius 1, whose radiance is its intensity over its square
        lines = [
            "bool treatAsPoint = 1",
            "float inputs:radius = 1",
            f"float inputs:intensity = {light.intensity:.9g}",
        ]
        if light.kind == "spot":
            lines.append(f"float inputs:shaping:cone:angle = {light.sizes[0] / 2:.9g}")
            lines.append(f"float inputs:shaping:cone:softness = {PENUMBRA:.9g}")
        return lines
    if light.kind == "rect":
        width, height = light.sizes
        sizes = [f"float inputs:width = {width:.9g}", f"float inputs:height = {height:.9g}"]
        return [*sizes, f"float inputs:intensity = {light.intensity * math.pi / (width * height):.9g}"]
    radius = light.sizes[0]
    return [f"float inputs:radius = {radius:.9g}", f"float inputs:intensity = {light.intensity / radius**2:.9g}"]


def _color(prim: Prim, path: Path) -> Rgb:
    value = prim.attributes.get("inputs:color", (1.0, 1.0, 1.0))
    color = _vector(value, 3, path, "inputs:color")
    if prim.attributes.get("inputs:enableColorTemperature") in (1.0, "true"):
        color = color * np.array(kelvin_color(prim.number("inputs:colorTemperature", 6500.0, path)))
    red, green, blue = (max(float(c), 0.0) for c in color)
    return red, green, blue


def _light(prim: Prim, matrix: np.ndarray, path: Path) -> SceneLight:
    # USD counts radiance, or power where it is normalised; ours is what a white surface receives at a unit's distance.
    intensity = prim.number("inputs:intensity", 50000.0 if prim.kind == "DistantLight" else 1.0, path)
    intensity *= float(portable.exp(prim.number("inputs:exposure", 0.0, path) * portable.log(2.0)))
    normalized = prim.attributes.get("inputs:normalize") in (1.0, "true")
    # A transform may scale a light, which changes its area and so what it sends.
    scales = np.sqrt((matrix[:3, :3] ** 2).sum(0))
    if not np.isfinite(matrix).all() or not scales.min() > 1e-12:
        raise ValueError(f"{path}: the light {ascii(prim.name)[1:-1]} has a transform without inverse")
    along, where, color = -matrix[:3, 2] / scales[2], matrix[:3, 3], _color(prim, path)
    if prim.kind == "DistantLight":
        angle = min(max(prim.number("inputs:angle", 0.53, path), 0.0), 90.0)
        disc = portable.sin(math.radians(angle / 2)) ** 2
        strength = intensity / math.pi if normalized or angle == 0 else intensity * disc
        return SceneLight("distant", where, along, color, strength, (angle,), prim.name)
    if prim.kind == "RectLight":
        width = prim.number("inputs:width", 1.0, path) * scales[0]
        height = prim.number("inputs:height", 1.0, path) * scales[1]
        strength = intensity / math.pi * (1.0 if normalized else width * height)
        return SceneLight("rect", where, along, color, strength, (float(width), float(height)), prim.name)
    radius = prim.number("inputs:radius", 0.5, path) * float(scales[0])
    if prim.kind == "DiskLight":
        strength = intensity / math.pi if normalized else intensity * radius**2
        return SceneLight("disk", where, along, color, strength, (radius,), prim.name)
    strength = intensity / (4 * math.pi) if normalized else intensity * radius**2
    # A cone of nearly a half sphere shapes nothing: USD gives 90 degrees to lights without one.
    cone = prim.number("inputs:shaping:cone:angle", 90.0, path)
    if cone < 85:
        return SceneLight("spot", where, along, color, strength, (2 * cone,), prim.name)
    if prim.attributes.get("treatAsPoint") in (1.0, "true") or radius <= 0:
        return SceneLight("point", where, along, color, strength, (), prim.name)
    return SceneLight("sphere", where, along, color, strength, (radius,), prim.name)


def _dome(prim: Prim, matrix: np.ndarray, path: Path) -> SceneSky:
    gain = float(portable.exp(prim.number("inputs:exposure", 0.0, path) * portable.log(2.0)))
    file = prim.attributes.get("inputs:texture:file", "")
    turned = math.degrees(portable.arctan2(float(matrix[0, 2]), float(matrix[2, 2])))
    return SceneSky(str(file), prim.number("inputs:intensity", 1.0, path) * gain, turned)


def _walk(prim: Prim, above: np.ndarray, path: Path, depth: int) -> Iterator[tuple[Prim, np.ndarray]]:
    for child in prim.children:
        local = _transform(child, path)
        order = child.attributes.get("xformOpOrder", ())
        # USD lets a prim ignore those above it.
        reset = isinstance(order, tuple) and "!resetXformStack!" in order
        matrix = local if reset else portable.matmul(above, local)
        yield child, matrix
        yield from _walk(child, matrix, path, depth + 1)


def _transform(prim: Prim, path: Path) -> np.ndarray:
    """[4, 4] of columns: the product of the operations in their order."""
    matrix = np.eye(4)
    order = prim.attributes.get("xformOpOrder", ())
    for name in order if isinstance(order, tuple) else (order,):
        if not isinstance(name, str) or name == "!resetXformStack!":
            continue
        inverse = name.startswith("!invert!")
        name = name.removeprefix("!invert!")
        step = _operation(name, prim.attributes.get(name), path)
        if inverse:
            step = portable.solved(portable.gram(step, np.ones(4)), np.ascontiguousarray(step.T))
        matrix = portable.matmul(matrix, step)
    return matrix


def _operation(name: str, value: Any, path: Path) -> np.ndarray:
    out, kind = np.eye(4), name.split(":")[1] if name.count(":") else ""
    if kind == "translate":
        out[:3, 3] = _vector(value, 3, path, name)
    elif kind == "scale":
        out[:3, :3] = np.diag(_vector(value, 3, path, name))
    elif kind == "transform":
        rows = value if isinstance(value, tuple) and len(value) == 4 else ((),)
        out = np.stack([_vector(row, 4, path, name) for row in rows]).T
    elif kind == "orient":
        w, x, y, z = _vector(value, 4, path, name)
        out[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    elif re.fullmatch(r"rotate[XYZ]{1,3}", kind):
        axes = kind.removeprefix("rotate")
        angles = _vector(value, 3, path, name) if len(axes) == 3 else [value]
        for axis in axes:  # the first is applied first
            angle = angles["XYZ".index(axis)] if len(axes) == 3 else angles[0]
            if not isinstance(angle, float):
                raise ValueError(f"{path}: expected degrees as {name}")
            out = portable.matmul(_turn("XYZ".index(axis), math.radians(angle)), out)
    else:
        raise ValueError(f"{path}: expected translate, rotate, scale, orient or transform, got {ascii(name[:60])}")
    return out


def _turn(axis: int, angle: float) -> np.ndarray:
    out, (i, j) = np.eye(4), ((1, 2), (2, 0), (0, 1))[axis]
    out[i, i] = out[j, j] = portable.cos(angle)
    out[j, i] = portable.sin(angle)
    out[i, j] = -out[j, i]
    return out


def _vector(value: Any, count: int, path: Path, name: str) -> np.ndarray:
    if not isinstance(value, tuple) or len(value) != count or not all(isinstance(v, float) for v in value):
        raise ValueError(f"{path}: expected {count} numbers as {ascii(name[:60])[1:-1]}")
    return np.array(value, np.float64)


def _list(values: Any) -> str:
    return ", ".join(f"{float(value):.9g}" for value in values)


class _Parser:
    """Prims of a layer, by its tokens."""

    def __init__(self, tokens: list[str], path: Path) -> None:
        self.tokens, self.path, self.at = tokens, path, 0

    def layer(self) -> Prim:
        root = Prim("", "")
        if self._peek() == "(":
            root.attributes.update(self._metadata())
        while self.at < len(self.tokens):
            self._statement(root, 0)
        return root

    def _peek(self) -> str:
        return self.tokens[self.at] if self.at < len(self.tokens) else ""

    def _next(self) -> str:
        if self.at >= len(self.tokens):
            raise ValueError(f"{self.path}: this USD is cut off")
        self.at += 1
        return self.tokens[self.at - 1]

    def _statement(self, prim: Prim, depth: int) -> None:
        word = self._next()
        if word in ("def", "over", "class"):
            self._prim(prim, word, depth)
        elif word in ("{", "(", "["):  # of what is not read here: variants, dictionaries
            self._skip(word)
        elif self._peek() == "=":
            self.at += 1
            prim.attributes[word.removesuffix(".connect")] = self._value(0)

    def _prim(self, parent: Prim, word: str, depth: int) -> None:
        if depth > MAX_DEPTH:
            raise ValueError(f"{self.path}: expected prims at most {MAX_DEPTH} deep in each other")
        kind = "" if self._peek().startswith('"') else self._next()
        prim = Prim(kind if word == "def" else "", self._next().strip('"'))
        if self._peek() == "(":
            self._metadata()
        if self._next() != "{":
            raise ValueError(f"{self.path}: damaged USD at the prim {ascii(prim.name[:60])}")
        while self._peek() != "}":
            self._statement(prim, depth + 1)
        self.at += 1
        parent.children.append(prim)

    def _metadata(self) -> dict[str, Any]:
        self.at += 1
        out: dict[str, Any] = {}
        while (word := self._next()) != ")":
            if word in ("(", "[", "{"):
                self._skip(word)
            elif self._peek() == "=":
                self.at += 1
                out[word] = self._value(0)
        return out

    def _skip(self, opening: str) -> None:
        closing = [{"(": ")", "[": "]", "{": "}"}[opening]]
        while closing:
            word = self._next()
            if word in ("(", "[", "{"):
                closing.append({"(": ")", "[": "]", "{": "}"}[word])
            elif word == closing[-1]:
                closing.pop()

    def _value(self, depth: int) -> Any:
        """A number, text, or a tuple of values; None of what lights do not need."""
        word = self._next()
        if word in ("(", "["):
            if depth > 3:
                self._skip(word)
                return None
            values = []
            while self._peek() not in (")", "]"):
                if self._peek() == ",":
                    self.at += 1
                    continue
                values.append(self._value(depth + 1))
            self.at += 1
            return tuple(values)
        if word == "{":
            self._skip(word)
            return None
        if word[0] in "\"'@":
            return word.strip("\"'@")
        try:
            return float(word)
        except ValueError:
            return word
